"""Handing in and grading the studio exercise: a bundle is packed, read safely, graded, reported.

A bundle holds raw measurements and what a student claims of them; FORMAT.md describes the file. The
grader computes everything again from the raw measurements, runs nothing that came with a bundle,
and reads it in memory. Graders want `coursekit.submission.batch.grade_folder`.
"""

from coursekit.submission.contents import Stack, Submission
from coursekit.submission.submit import Handed, keep, stack

__all__ = ["Handed", "Stack", "Submission", "keep", "stack"]
