"""Set before torch is imported: its threads wait for one another when tests share the cores."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
