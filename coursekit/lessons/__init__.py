"""Checkpoints, checks of a learner's functions, and how a student stands.

Each lesson has a module with its exercises and the mistakes that people make in them, and a TOML
file with its questions and objectives, facts of its exercises, and what is said of each mistake.
`questions` and `exercises` are what judges an answer; `overview` finds everything by name.
"""

from __future__ import annotations

from coursekit.lessons.overview import CHECKPOINTS, EXERCISES, LESSONS, check, checkpoint, evidence

__all__ = ["CHECKPOINTS", "EXERCISES", "LESSONS", "check", "checkpoint", "evidence"]
