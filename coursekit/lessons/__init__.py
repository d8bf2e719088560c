"""Checkpoints, exercise checks and the misconceptions they know, one module a notebook."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

from coursekit.lessons.checkpoints import Checkpoint
from coursekit.lessons.exercises import Exercise
from coursekit.lessons.objectives import Evidence
from coursekit.lessons.verdict import Verdict

__all__ = ["LESSONS", "check", "checkpoint", "checkpoints", "evidence", "exercises"]

LESSONS = ("pinhole", "depth_noise", "intrinsics", "hand_eye", "error_budget")


def checkpoint(name: str) -> Checkpoint:
    """The checkpoint `lesson.topic`, as the notebooks write it: `ck.checkpoint("pinhole.zoom")`."""
    return _find(name, "checkpoint", checkpoints())


def check(name: str, function: Callable[..., Any]) -> Verdict:
    """What is right or wrong with a learner's function: `ck.check("pinhole.project", project)`."""
    return _find(name, "exercise", exercises()).check(function)


def evidence(lesson: str) -> Evidence:
    """The objectives of a lesson and the student's own evidence: `ck.evidence("pinhole")`."""
    if lesson not in LESSONS:
        raise ValueError(f"lesson: there is no {lesson!r}; there are {', '.join(LESSONS)}")
    return Evidence(importlib.import_module(f"coursekit.lessons.{lesson}").OBJECTIVES)


def checkpoints() -> dict[str, Checkpoint]:
    """All checkpoints by name, in the order of the course."""
    return {c.name: c for lesson in _lessons() for c in lesson.CHECKPOINTS}


def exercises() -> dict[str, Exercise]:
    """All exercises by name, in the order of the course."""
    return {e.name: e for lesson in _lessons() for e in lesson.EXERCISES}


def _lessons() -> list[Any]:
    return [importlib.import_module(f"coursekit.lessons.{name}") for name in LESSONS]


def _find(name: str, kind: str, known: dict[str, Any]) -> Any:
    if name not in known:
        raise ValueError(f"name: there is no {kind} {name!r}; there are {', '.join(known)}")
    return known[name]
