"""JupyterLab as `course.py lab` starts it, without what takes a third of its start: `jsonschema`
reads a grammar of international web addresses where there is one, and no file here holds such.
"""

import sys

sys.modules["rfc3987_syntax"] = None  # type: ignore[assignment]  # as if it was not installed
if __name__ == "__main__":
    from jupyterlab.labapp import main

    sys.exit(main())
