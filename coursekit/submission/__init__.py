"""Handing in and grading the studio exercise: a bundle is packed, read safely, graded, reported.

A bundle holds raw measurements and what a student claims of them; FORMAT.md describes the file, and
`format` reads it. The grader computes everything again from the raw measurements (`recompute`),
compares (`rubric`), looks for what cannot be (`flags`), and writes pages (`report`); it runs
nothing that came with a bundle, and reads it in memory. Students want `keep` and `submit`; graders
want `coursekit.submission.batch.grade_folder`.
"""

from typing import Any

from coursekit.submission.format import Stack, Submission

__all__ = ["Handed", "Stack", "Submission", "keep", "stack"]


def __getattr__(name: str) -> Any:
    """Of a student's side, when asked: a grader needs no cameras and no lessons."""
    if name not in ("Handed", "keep", "stack"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from coursekit.submission import submit

    return getattr(submit, name)
