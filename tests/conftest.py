"""Set before torch is imported: its threads wait for one another when tests share the cores."""

import os

from hypothesis import settings

os.environ.setdefault("OMP_NUM_THREADS", "1")
settings.register_profile("shared cores", deadline=None)  # a wait for a core is no slow example
settings.load_profile("shared cores")
