"""All lessons together: every checkpoint and exercise by name, and where a student stands."""

from __future__ import annotations

import html
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from coursekit import results
from coursekit.lessons import depth_noise, error_budget, hand_eye, intrinsics, pinhole
from coursekit.lessons import questions as record
from coursekit.lessons.exercises import Exercise
from coursekit.lessons.questions import Checkpoint, Objective, Verdict, load_questions
from coursekit.words import html_table, table

LESSONS = ("pinhole", "depth_noise", "intrinsics", "hand_eye", "error_budget")  # by notebook

_LOADED = {lesson: load_questions(lesson) for lesson in LESSONS}
CHECKPOINTS: dict[str, Checkpoint] = {c.name: c for asked, _ in _LOADED.values() for c in asked}
EXERCISES: dict[str, Exercise] = {
    found.name: found
    for lesson in (pinhole, depth_noise, intrinsics, hand_eye, error_budget)
    for found in vars(lesson).values()
    if isinstance(found, Exercise)
}
DONE = {"right", "core right"}
STANDING_WORDS = {"wrong": "not right yet", "raised": "raised an error"}


def checkpoint(name: str) -> Checkpoint:
    """The checkpoint `lesson.topic`, as the notebooks write it: `ck.checkpoint("pinhole.zoom")`.

    Raises ValueError, with all names, for one that there is not.

    >>> checkpoint("pinhole.pitch")
    Checkpoint: commit your answer with ck.checkpoint("pinhole.pitch").answer(...)
    """
    return _find("name", "checkpoint", name, CHECKPOINTS)


def check(name: str, function: Callable[..., Any]) -> Verdict:
    """What is right or wrong with a learner's function: `ck.check("pinhole.project", project)`.

    Raises ValueError, with all names, for an exercise that there is not; whatever the function
    does is told in the verdict.

    >>> check("pinhole.project", lambda points, K, dist=None: None)
    project: not attempted yet: it returns None.
    """
    return record.noted(_find("name", "exercise", name, EXERCISES).judge(function))


def evidence(lesson: str) -> Evidence:
    """The objectives of a lesson and the student's own evidence: `ck.evidence("pinhole")`.

    Raises ValueError, with all names, for a lesson that there is not.

    >>> evidence("pinhole").objectives[3].names
    ('pinhole.range',)
    """
    return Evidence(_find("lesson", "lesson", lesson, _LOADED)[1])


def _find(argument: str, kind: str, name: str, known: dict[str, Any]) -> Any:
    if name not in known:
        raise ValueError(f"{argument}: there is no {kind} {name!r}; there are {', '.join(known)}")
    return known[name]


@dataclass(frozen=True)
class Evidence:
    """The objectives of a lesson, each with how its checkpoints and exercises stand."""

    objectives: tuple[Objective, ...]

    def rows(self) -> list[tuple[str, str]]:
        """(objective, evidence) as text; a later attempt counts, the first one is mentioned."""
        attempts = record.read_attempts()

        def state(name: str) -> str:
            nothing = "not attempted yet" if name in EXERCISES else "not answered yet"
            topic = name.partition(".")[2].replace("_", " ")
            return f"{topic}: {_state(attempts.get(name, [])) or nothing}"

        return [(o.text, "; ".join(map(state, o.names))) for o in self.objectives]

    def __repr__(self) -> str:
        return "\n".join(f"- {text}\n  {evidence}" for text, evidence in self.rows())

    def _repr_html_(self) -> str:
        return html_table(("I can", "what shows it"), self.rows())


def _state(attempts: list[dict[str, str]]) -> str:
    """The best that there was: right, and when; the core right; else how the last one stands."""
    kinds = [a["kind"] for a in attempts]
    if "right" in kinds:
        tries = kinds.index("right") + 1
        return "right" if tries == 1 else f"right at try {tries}"
    if "core right" in kinds:
        return "core right"
    return STANDING_WORDS.get(kinds[-1], kinds[-1]) if kinds else ""


class Standing(NamedTuple):
    """One notebook: how many checkpoints and exercises it has, and how the student's stand.

    first_try, later: checkpoints answered rightly; exercises: those that are right, and all.
    open: names of what is not right yet, in the notebook's order. result: what `results/` holds of
    it, in words.
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
    """All notebooks, the studio exercise's hand-in in words, and what to do next."""

    standings: tuple[Standing, ...]
    hand_in: str

    @property
    def next(self) -> str:
        """What to do next, in one sentence."""
        begun = [s for s in self.standings if s.result or s.first_try or s.later or s.exercises[0]]
        for standing in self.standings:
            if not standing.result.startswith("from"):
                again = "Next: finish" if standing in begun else "Next:"
                what = again if begun else "Begin with"
                return f"{what} notebook {standing.notebook}; its last section keeps your results."
        for standing in self.standings:
            if standing.open:
                words = standing.open[0].replace("_", " ")
                return f"All results are kept. Still open: {words} in notebook {standing.notebook}."
        return "All five notebooks are done."

    def rows(self) -> list[tuple[str, str, str, str]]:
        """Notebook, checkpoints, exercises and results of each, as text."""
        rows = []
        for s in self.standings:
            first = f" ({s.first_try} at first try)" if s.later else ""
            answered = f"{s.first_try + s.later} of {s.checkpoints}{first}"
            rows.append((s.notebook, answered, "{} of {}".format(*s.exercises), s.result or "-"))
        return rows

    def __repr__(self) -> str:
        head = ("notebook", "checkpoints", "exercises", "results")
        return f"{table(head, self.rows())}\nHand-in: {self.hand_in}.\n{self.next}"

    def _repr_html_(self) -> str:
        head = ("notebook", "right checkpoints", "right exercises", "results")
        says = f"Hand-in: {self.hand_in}."
        texts = "".join(f"<p>{html.escape(text)}</p>" for text in (says, self.next))
        return f"{html_table(head, self.rows())}{texts}"


def progress() -> Overview:
    """What was answered and what is in `results/`, over all notebooks.

    >>> [standing.notebook for standing in progress().standings][:2]
    ['01_pinhole', '02_depth_noise']
    """
    kinds = {name: [a["kind"] for a in tries] for name, tries in record.read_attempts().items()}

    def standing(notebook: str, prefix: str) -> Standing:
        questions = [name for name in CHECKPOINTS if name.startswith(prefix)]
        tasks = [name for name in EXERCISES if name.startswith(prefix)]
        done = [name for name in questions if "right" in kinds.get(name, ())]
        first = [name for name in done if kinds[name][0] == "right"]
        solved = [name for name in tasks if DONE.intersection(kinds.get(name, ()))]
        left = (name for name in (*questions, *tasks) if name not in (*done, *solved))
        return Standing(
            notebook,
            checkpoints=len(questions),
            first_try=len(first),
            later=len(done) - len(first),
            exercises=(len(solved), len(tasks)),
            open=tuple(name.partition(".")[2] for name in left),
            result=_result(notebook),
        )

    numbered = enumerate(LESSONS, start=1)
    standings = tuple(standing(f"{n:02d}_{name}", f"{name}.") for n, name in numbered)
    return Overview(standings, _hand_in())


def _hand_in() -> str:
    """What `results/` holds of the studio exercise."""
    kept = results.folder() / "studio_1.measured"
    if not (packed := sorted(results.folder().glob("studio_1_*.zip"))):
        measured = "measured, and not packed yet (notebook 02, its last section)"
        return measured if kept.exists() else "nothing measured yet (notebook 02, studio exercise)"
    says = ", ".join(path.name for path in packed) + " in results/"
    newest = max(path.stat().st_mtime for path in packed)
    later = kept.exists() and kept.stat().st_mtime > newest
    return f"{says}, older than what you measured: pack again" if later else says


def _result(notebook: str) -> str:
    """Whose result `results/` holds, empty where there is none."""
    try:
        result = results.load(notebook)
    except FileNotFoundError:
        return ""
    except (ValueError, OSError) as error:
        return f"cannot be read: {error}"
    return f"from {result.camera} ({result.source}), {result.date[:10]}"
