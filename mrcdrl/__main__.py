"""`python -m mrcdrl …`: the same as `mrcdrl …`."""

import sys

from mrcdrl.cli import main

if __name__ == "__main__":
    sys.exit(main())
