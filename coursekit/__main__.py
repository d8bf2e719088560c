"""`python -m coursekit`: the command line where `coursekit` is not on PATH."""

import sys

from coursekit.cli import main

sys.exit(main())
