"""What a worker process of the grader does: read one bundle, grade it, write its page.

Importing this loads all that grading needs; nothing is loaded on first use, when memory is limited.
"""

from __future__ import annotations

from pathlib import Path

import scipy.optimize
import scipy.special
import scipy.stats  # noqa: F401 - `stereo` would load these three while it grades the first bundle

from coursekit.submission.reader import Refused, read_bundle
from coursekit.submission.report import Line, graded, not_graded, student_page
from coursekit.submission.rubric import grade


def grade_file(path: str, name: str, page: str) -> tuple[Line, str]:
    """The line of the bundle at `path` in the class, and its student's page; empty if refused.

    name: what to call the file, page: the link to the page.
    """
    try:
        submission = read_bundle(Path(path))
        found = grade(submission)
        return graded(name, found, submission, page), student_page(found, submission)
    except Refused as refused:
        return not_graded(name, refused.reason, str(refused)), ""
    except MemoryError:
        return out_of_memory(name), ""


def out_of_memory(name: str) -> Line:
    """The line of a bundle that wants more memory than a process may have."""
    return not_graded(
        name, "memory", "It takes more memory than a bundle may. Ask for it again, or look inside."
    )
