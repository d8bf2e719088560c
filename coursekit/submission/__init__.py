"""Handing in and grading the studio exercise: a bundle is packed, read safely, graded, reported.

A bundle holds raw measurements and what a student claims of them; FORMAT.md describes the file, and
`format` reads it. The grader computes everything again from the raw measurements (`recompute`),
compares (`rubric`), looks for what cannot be (`flags`), and writes pages (`report`); it runs
nothing that came with a bundle, and reads it in memory. Students want `keep` and `submit`; graders
want `coursekit.submission.batch.grade_folder`.
"""

from coursekit.submission.format import Stack, Submission
from coursekit.submission.submit import Handed, keep, stack

__all__ = ["Handed", "Stack", "Submission", "keep", "stack"]
