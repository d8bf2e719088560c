"""Where a student stands in the whole course: `ck.progress()`."""

from __future__ import annotations

import html
from dataclasses import dataclass

from coursekit import results
from coursekit.lessons import progress as record

DONE = ("right", "core right")


@dataclass(frozen=True)
class Standing:
    """One notebook: how many checkpoints and exercises it has, and how the student's stand.

    first_try, later: checkpoints answered rightly; exercises: those that are right. open: names of
    what is not right yet, in the notebook's order. result: what `results/` holds of it, in words.
    """

    notebook: str
    checkpoints: int
    first_try: int
    later: int
    exercises: tuple[int, int]
    open: tuple[str, ...]
    result: str


@dataclass(frozen=True)
class Overview:
    """All notebooks, and what to do next."""

    standings: tuple[Standing, ...]

    @property
    def next(self) -> str:
        """One sentence."""
        begun = [s for s in self.standings if s.result or s.first_try or s.later or s.exercises[0]]
        for standing in self.standings:
            if not standing.result.startswith("from"):
                what = (
                    "Begin with" if not begun else "Next: finish" if standing in begun else "Next:"
                )
                return f"{what} notebook {standing.notebook}; its last section keeps your results."
        for standing in self.standings:
            if standing.open:
                words = standing.open[0].replace("_", " ")
                return f"All results are kept. Still open: {words} in notebook {standing.notebook}."
        return "All five notebooks are done."

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Notebook, checkpoints, exercises and results of each, as text."""
        return [
            (
                s.notebook,
                f"{s.first_try + s.later} of {s.checkpoints}"
                + (f" ({s.first_try} at first try)" if s.later else ""),
                f"{s.exercises[0]} of {s.exercises[1]}",
                s.result or "-",
            )
            for s in self.standings
        ]

    def __repr__(self) -> str:
        rows = [("notebook", "checkpoints", "exercises", "results"), *self.rows()]
        widths = [max(len(row[i]) for row in rows) for i in range(4)]
        lines = [
            "  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip()
            for row in rows
        ]
        return "\n".join([*lines, self.next])

    def _repr_html_(self) -> str:
        def row(tag: str, cells: tuple[str, ...]) -> str:
            texts = (f"<{tag} style='text-align:left'>{html.escape(c)}</{tag}>" for c in cells)
            return f"<tr>{''.join(texts)}</tr>"

        head = row("th", ("notebook", "right checkpoints", "right exercises", "results"))
        body = "".join(row("td", cells) for cells in self.rows())
        return f"<table>{head}{body}</table><p>{html.escape(self.next)}</p>"


def progress() -> Overview:
    """What was answered and what is in `results/`, over all notebooks."""
    from coursekit import lessons  # which imports this module

    attempts = record.read()
    kinds = {name: [attempt["kind"] for attempt in tries] for name, tries in attempts.items()}
    standings = []
    for number, lesson in enumerate(lessons.LESSONS, start=1):
        questions, tasks = (
            [name for name in found if name.startswith(f"{lesson}.")]
            for found in (lessons.checkpoints(), lessons.exercises())
        )
        done = [name for name in questions if "right" in kinds.get(name, ())]
        first = [name for name in done if kinds[name][0] == "right"]
        solved = [name for name in tasks if set(DONE) & set(kinds.get(name, ()))]
        left = (name for name in (*questions, *tasks) if name not in (*done, *solved))
        standings.append(
            Standing(
                notebook=f"{number:02d}_{lesson}",
                checkpoints=len(questions),
                first_try=len(first),
                later=len(done) - len(first),
                exercises=(len(solved), len(tasks)),
                open=tuple(name.partition(".")[2] for name in left),
                result=_result(f"{number:02d}_{lesson}"),
            )
        )
    return Overview(tuple(standings))


def _result(notebook: str) -> str:
    """Whose result `results/` holds, empty where there is none."""
    try:
        result = results.load(notebook)
    except FileNotFoundError:
        return ""
    except (ValueError, OSError) as error:
        return f"cannot be read: {error}"
    return f"from {result.camera} ({result.source}), {result.date[:10]}"
