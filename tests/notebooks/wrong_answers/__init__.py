"""Wrong answers to the exercises, written as students write them: `<lesson>_<exercise>.py`.

A solution stands there once in each style that turns up (vectorised, loops over lists, matrix
products); by_change.toml has what is replaced in its text, and what must be said then. Attempts
that are no solution with a mistake in it are functions of their own, below a `@wrong(...)`, or
stand as text in by_text.toml.

What must be said is the name of a misconception, or a kind of verdict, or "no name" for an attempt
that is wrong in a way that has none. All are written without a look at coursekit's wrong models.
"""

from __future__ import annotations

import importlib
import inspect
import math
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

Attempt = Callable[..., Any]
BY_TEXT, BY_CHANGE = (
    tomllib.loads(Path(__file__).with_name(name).read_text(encoding="utf-8"))
    for name in ("by_text.toml", "by_change.toml")
)


@dataclass(frozen=True)
class WrongAnswer:
    """An attempt, and the verdict that it must get: (kind, name of the misconception)."""

    name: str
    attempt: Attempt
    verdict: tuple[str, str | None]


def expected(said: str) -> tuple[str, str | None]:
    kinds = ("right", "core right", "raised", "not attempted")
    return (said, None) if said in kinds else ("wrong", None if said == "no name" else said)


def wrong(said: str) -> Callable[[Attempt], Attempt]:
    """Mark a function as an attempt of its own style."""

    def mark(attempt: Attempt) -> Attempt:
        attempt.wrong_answers = [WrongAnswer(attempt.__name__, attempt, expected(said))]
        return attempt

    return mark


def changed(solution: Attempt, change: str, said: str) -> WrongAnswer:
    """A right solution with a mistake in it. Each old expression must stand exactly once in it."""
    text = inspect.getsource(solution)
    for one in change.split(" and "):
        old, _, new = one.partition(" -> ")
        assert text.count(old) == 1, f"{solution.__name__}: {old!r} of {change!r}"
        text = text.replace(old, new)
    namespace = {"math": math} | solution.__globals__
    exec(text, namespace)
    attempt = namespace[solution.__name__]
    return WrongAnswer(f"{solution.__name__}, {change}", attempt, expected(said))


def attempts(exercise: str) -> list[WrongAnswer]:
    """The wrong answers to the exercise `lesson.function`, and the solutions they come from."""
    module = importlib.import_module(f"wrong_answers.{exercise.replace('.', '_')}")
    found = [one for f in vars(module).values() for one in getattr(f, "wrong_answers", ())]
    for style, changes in BY_CHANGE.get(exercise, {}).items():
        solution = getattr(module, style)
        found.append(WrongAnswer(style, solution, expected("right")))
        found += [changed(solution, one, said) for said, all_ in changes.items() for one in all_]
    for written in BY_TEXT.get(exercise, ()):
        namespace = {"np": np}
        exec(written["code"], namespace)
        attempt = namespace[exercise.rpartition(".")[2]]
        found.append(WrongAnswer(written["what"], attempt, expected(written["named"])))
    return found
