"""A lesson's objectives with what the student has done about each."""

from __future__ import annotations

import html
from dataclasses import dataclass

from coursekit.lessons import progress

WORDS = {"wrong": "not right yet", "raised": "raised an error"}


@dataclass(frozen=True)
class Objective:
    """What a student can do after a lesson, and the checkpoints and exercises that show it."""

    text: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class Evidence:
    """The objectives of a lesson, each with how its checkpoints and exercises stand."""

    objectives: tuple[Objective, ...]

    def rows(self) -> list[tuple[str, str]]:
        """(objective, evidence) as text; a later attempt counts, the first one is mentioned."""
        from coursekit import lessons  # which imports this module

        attempts, exercises = progress.read(), lessons.exercises()

        def state(name: str) -> str:
            nothing = "not attempted yet" if name in exercises else "not answered yet"
            return f"{_words(name)}: {_state(attempts.get(name, [])) or nothing}"

        return [(o.text, "; ".join(map(state, o.names))) for o in self.objectives]

    def __repr__(self) -> str:
        return "\n".join(f"- {text}\n  {evidence}" for text, evidence in self.rows())

    def _repr_html_(self) -> str:
        body = "".join(
            f'<tr><td style="text-align: left">{html.escape(text)}</td>'
            f'<td style="text-align: left">{html.escape(evidence)}</td></tr>'
            for text, evidence in self.rows()
        )
        head = "".join(f'<th style="text-align: left">{h}</th>' for h in ("I can", "what shows it"))
        return f"<table><tr>{head}</tr>{body}</table>"


def _words(name: str) -> str:
    return name.partition(".")[2].replace("_", " ")


def _state(attempts: list[dict[str, str]]) -> str:
    """The best that there was: right, and when; the core right; else how the last one stands."""
    kinds = [a["kind"] for a in attempts]
    if "right" in kinds:
        tries = kinds.index("right") + 1
        return "right" if tries == 1 else f"right at try {tries}"
    if "core right" in kinds:
        return "core right"
    return WORDS.get(kinds[-1], kinds[-1]) if kinds else ""
