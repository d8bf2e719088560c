"""Answers to the exercises, right and wrong, as texts that students write.

solutions.toml has a right one in each style that turns up (vectorised, loops over lists, matrix
products); by_change.toml has what is replaced in its text, and what must be said then. by_text.toml
has attempts that are no solution with a mistake in it.

What must be said is the name of a misconception, or a kind of verdict, or "no name" for an attempt
that is wrong in a way that has none. All are written without a look at coursekit's wrong models.
"""

import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

SOLUTIONS, BY_CHANGE, BY_TEXT = (
    tomllib.loads(Path(__file__).with_name(f"{name}.toml").read_text(encoding="utf-8"))
    for name in ("solutions", "by_change", "by_text")
)


@dataclass(frozen=True)
class WrongAnswer:
    """An attempt, and the verdict that it must get: (kind, name of the misconception)."""

    name: str
    attempt: Callable[..., Any]
    verdict: tuple[str, str | None]


def written(exercise: str, name: str, code: str, said: str, shared: str = "") -> WrongAnswer:
    """The answer that a text defines, once what the exercise's texts share is run."""
    namespace = {"np": np}
    exec(shared, namespace)
    exec(code, namespace)
    kinds = ("right", "core right", "raised", "not attempted")
    verdict = (said, None) if said in kinds else ("wrong", None if said == "no name" else said)
    return WrongAnswer(name, namespace[exercise.rpartition(".")[2]], verdict)


def changed(text: str, change: str) -> str:
    """A right solution with a mistake in it. Each old expression must stand exactly once in it."""
    for one in change.split(" and "):
        old, _, new = one.partition(" -> ")
        assert text.count(old) == 1, f"{old!r} of {change!r}"
        text = text.replace(old, new)
    return text


def attempts(exercise: str) -> list[WrongAnswer]:
    """The wrong answers to the exercise `lesson.function`, and the solutions they come from."""
    found, texts = [], dict(SOLUTIONS[exercise])
    shared = texts.pop("shared", "")
    for style, text in texts.items():
        found.append(written(exercise, style, text, "right", shared))
        for said, changes in BY_CHANGE[exercise].get(style, {}).items():
            for one in changes:
                name, code = f"{style}, {one}", changed(text, one)
                found.append(written(exercise, name, code, said, shared))
    for one in BY_TEXT.get(exercise, ()):
        found.append(written(exercise, one["what"], one["code"], one["named"]))
    return found
