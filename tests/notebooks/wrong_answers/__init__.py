"""Wrong answers to the exercises, written as students write them: `<lesson>_<exercise>.py`.

Each function below a `@wrong(...)` is one attempt, written without a look at coursekit's own wrong
models and in the styles that turn up: vectorised, loops over lists, matrix products.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

Attempt = Callable[..., Any]


@dataclass(frozen=True)
class WrongAnswer:
    """An attempt and the verdict that it must get."""

    attempt: Attempt
    kind: str
    named: str | None
    style: str


def wrong(named: str | None, style: str, kind: str = "wrong") -> Callable[[Attempt], Attempt]:
    """Mark a function as an attempt; `named` is the misconception, None where none can be named."""

    def mark(attempt: Attempt) -> Attempt:
        attempt.wrong_answer = WrongAnswer(attempt, kind, named, style)
        return attempt

    return mark


def attempts(exercise: str) -> list[WrongAnswer]:
    """The wrong answers to the exercise `lesson.function`."""
    module = importlib.import_module(f"wrong_answers.{exercise.replace('.', '_')}")
    return [f.wrong_answer for f in vars(module).values() if hasattr(f, "wrong_answer")]
