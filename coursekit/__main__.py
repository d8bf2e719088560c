"""`python -m coursekit`: the command line where `coursekit` is not on PATH."""

import sys

from coursekit.cli import main

if __name__ == "__main__":
    sys.exit(main())
