"""Questions that the student answers before the notebook shows the answer.

All texts come from the lesson's TOML file. The question and its options stand in the notebook's
Markdown as well, where they can be read without a kernel; a test keeps both equal. An answer is
committed by clicking, or by a plain call: `ck.checkpoint("pinhole.zoom").answer("B")`.
"""

from __future__ import annotations

import html
import math
import re
import tomllib
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

from coursekit import checks, results, words

EXAMPLES = "0.37 or 150"  # of numbers, and no checkpoint's answer
LENGTHS = {"mm": 1e-3, "cm": 1e-2, "m": 1.0}
LETTERS = "ABCDEFGH"
OTHERWISE = "Why not another answer?"


class Option(NamedTuple):
    """One option of a choice: its text and why it is right or wrong."""

    text: str
    why: str
    right: bool = False


class Classic(NamedTuple):
    """A wrong number that a known slip leads to, and what that slip is."""

    value: float
    why: str


class Objective(NamedTuple):
    """What a student can do after a lesson, and the checkpoints and exercises that show it."""

    text: str
    names: tuple[str, ...]


@dataclass(frozen=True)
class Checkpoint:
    """A question; `answer` commits one answer and says why it is right or wrong.

    example: what a plain call would pass, as source.
    """

    name: str
    question: str
    example: ClassVar[str]

    def answer(self, given: Any) -> Verdict:
        """The verdict on an answer; the first one given is what `progress` keeps as first try."""
        return noted(self.judge(given), str(given))

    def judge(self, given: Any) -> Verdict:
        """The verdict on an answer, without noting it."""
        raise NotImplementedError

    def input_widget(self) -> Any:
        """The ipywidget whose `value` is the answer."""
        raise NotImplementedError

    def __repr__(self) -> str:
        return f'Checkpoint: commit your answer with ck.checkpoint("{self.name}").answer(...)'

    def explanation(self) -> Verdict:
        """The verdict on the right answer, which says why every other one is wrong."""
        return self.judge(self.solution())

    def solution(self) -> Any:
        """The right answer."""
        raise NotImplementedError

    def without_kernel(self) -> str:
        """What a page shows on which nothing runs, as HTML."""
        call = f'ck.checkpoint("{self.name}").answer({self.example})'
        return (
            f"<em>Run this cell to answer here, or call <code>{call}</code>.</em>"
            "<details><summary>Reading without a kernel? Decide first, then open the answer."
            f"</summary>{self.explanation()._repr_html_()}</details>"
        )

    def _ipython_display_(self) -> None:
        """Two outputs: the widget, and what is said back, which is still there when that is not."""
        from IPython.display import DisplayHandle, display

        said = DisplayHandle()
        shown = panel(self, lambda text: said.update({"text/html": text}, raw=True))
        # ipywidgets 7 has no such method: then there is the text
        widget: dict[str, Any] = getattr(shown, "_repr_mimebundle_", dict)()
        without = {"text/plain": repr(self), "text/html": self.without_kernel()}
        display(widget | without, raw=True)
        said.display({"text/html": self._before()}, raw=True)

    def _before(self) -> str:
        """What was said when this was answered last, collapsed; empty if that has not been."""
        given = [a["answer"] for a in read_attempts().get(self.name, [])]
        if not given:
            return ""
        verdict = self.judge(given[-1])
        answered = f"You have answered this one before ({html.escape(verdict.kind)})."
        return f"<details><summary>{answered}</summary>{verdict._repr_html_()}</details>"


@dataclass(frozen=True, repr=False)
class Choice(Checkpoint):
    """A question with options A, B, C, ..., exactly one of them right.

    >>> near = Option("nearer", "The farther one is smaller.", right=True)
    >>> choice = Choice("a.b", "Which is larger?", (near, Option("farther", "It looks smaller.")))
    >>> choice.judge("B")
    B, farther: not this one.
    It looks smaller.
    Think again, and choose another.
    """

    options: tuple[Option, ...]
    example = '"A"'

    def lettered(self) -> dict[str, Option]:
        """The options by letter."""
        return dict(zip(LETTERS, self.options, strict=False))

    def judge(self, given: Any) -> Verdict:
        """The verdict on a letter; a right one also says why each other option is wrong."""
        options = self.lettered()
        letter = str(given).strip().upper().rstrip(".")
        if letter not in options:
            want = f"one of {', '.join(options)}"
            return Verdict(self.name, "not attempted", f"Choose {want}; got {given!r}.")
        chosen = options[letter]
        if not chosen.right:
            again = "Think again, and choose another."
            headline = f"{letter}, {chosen.text}: not this one."
            return Verdict(self.name, "wrong", headline, (chosen.why, again), named=letter)
        others = tuple(f"{k}, {o.text}: {o.why}" for k, o in options.items() if not o.right)
        headline = f"{letter}, {chosen.text}: right."
        return Verdict(self.name, "right", headline, (chosen.why,), others=others)

    def solution(self) -> str:
        return next(k for k, o in self.lettered().items() if o.right)

    def input_widget(self) -> Any:
        import ipywidgets

        return ipywidgets.RadioButtons(
            options=list(self.lettered()),  # their texts stand above
            value=None,
            description="Your answer",
            orientation="horizontal",
            layout=ipywidgets.Layout(width="max-content"),
        )


@dataclass(frozen=True, repr=False)
class Number(Checkpoint):
    """A question whose answer is a number; classic wrong numbers are recognised.

    value, and those of the classics: in `unit`. why: said with the right answer. hint: said with a
    wrong one that is no classic. tolerance: relative, of the right one and of each classic.
    """

    value: float
    unit: str
    why: str
    hint: str
    classics: tuple[Classic, ...]
    tolerance: float = 0.02
    example = "1.0"

    def judge(self, given: Any) -> Verdict:
        """The verdict on a number, or on text such as "2.4" or "2,4 mm"."""
        number = self._meant(_readings(given, self.unit))
        if number is None:
            say = f"Type a number in {self.unit}, such as {EXAMPLES}; got {given!r}."
            return Verdict(self.name, "not attempted", say)
        said = f"{number:g} {self.unit}"
        if self._close(number, self.value):
            others = tuple(f"{_short(c.value)} {self.unit}: {c.why}" for c in self.classics)
            return Verdict(self.name, "right", f"{said}: right.", (self.why,), others=others)
        slip = next((c for c in self.classics if self._close(number, c.value)), None)
        if not slip and any(self._close(number * factor, self.value) for factor in (1e-3, 1e3)):
            say = f"The digits are right. The answer is wanted in {self.unit}."
            return Verdict(self.name, "not attempted", say)
        lines = (slip.why if slip else self.hint, "Think again, and try another number.")
        named = f"{slip.value:g}" if slip else None
        return Verdict(self.name, "wrong", f"{said}: not this.", lines, named)

    def _meant(self, readings: list[float]) -> float | None:
        """The only reading, or else the one that is right or a known slip."""
        for value in (self.value, *(c.value for c in self.classics)):
            for number in readings:
                if self._close(number, value):
                    return number
        return readings[0] if len(readings) == 1 else None

    def _close(self, number: float, value: float) -> bool:
        return math.isclose(number, value, rel_tol=self.tolerance, abs_tol=1e-12)

    def solution(self) -> float:
        return float(_short(self.value))

    def input_widget(self) -> Any:
        import ipywidgets

        says = f"Your answer ({self.unit})" if self.unit != "1" else "Your answer"
        style = {"description_width": "initial"}
        whole = {"continuous_update": False, "style": style}  # no half of a number is judged
        return ipywidgets.Text(placeholder="a number", description=says, **whole)


def _short(value: float) -> str:
    """A number with four digits, or all of a large one."""
    return f"{value:.4g}" if abs(value) < 1e4 else f"{value:g}"


def _readings(given: Any, unit: str) -> list[float]:
    """The number in the student's answer, in `unit`; none for what is no number.

    A decimal comma, spaces between digits and a unit (of length, if `unit` is one) are accepted.
    "2,000" has two readings: it is two to some writers and two thousand to others.
    """
    text = str(given).strip().replace("\N{MINUS SIGN}", "-")
    match = re.fullmatch(r"([-+\d.,\s]+(?:[eE][-+]?\d+)?)\s*([a-zA-Zµ]*)", text)
    if match is None:
        return []
    digits, given_unit = re.sub(r"(?<=\d)\s(?=\d{3}\b)", "", match[1]).strip(), match[2] or unit
    written = [digits.replace(",", ".")] if re.fullmatch(r"[-+]?\d+,\d+", digits) else [digits]
    if re.fullmatch(r"[-+]?\d{1,3},000", digits):
        written.append(digits.replace(",", ""))
    factor = (
        1.0 if given_unit == unit else LENGTHS.get(given_unit, 0.0) / LENGTHS.get(unit, math.inf)
    )
    try:
        numbers = [float(text) * factor for text in written]
    except ValueError:
        return []
    return [number for number in numbers if math.isfinite(number) and factor]


def panel(checkpoint: Checkpoint, say: Callable[[str], None]) -> Any:
    """The widget: input, and a button that commits; `say` shows what is said back, as HTML."""
    import ipywidgets

    field = checkpoint.input_widget()
    button = ipywidgets.Button(description="Commit", tooltip="Commit this answer")
    judged, waiting = "", False  # Enter is told before the number that it commits

    def commit(*_: Any) -> None:
        nonlocal judged, waiting
        judged, waiting = field.value, False
        said = "<em>Choose or type an answer first.</em>"
        if field.value not in (None, ""):
            said = checkpoint.answer(field.value)._repr_html_()
        say(f'<div role="alert">{said}</div>')  # which is read out

    def pressed(_: Any) -> None:
        nonlocal waiting
        again = bool(judged) and field.value == judged
        if not again:
            commit()
        waiting = again and isinstance(checkpoint, Number)  # a busy kernel is told the press first

    def entered(_: Any, told: dict[str, Any], __: Any) -> None:
        nonlocal waiting
        if told.get("event") == "submit":
            waiting = field.value == judged
            if not waiting:  # it came when the field was left
                commit()

    def changed(_: Any) -> None:
        if waiting:
            commit()

    button.on_click(pressed)
    field.on_msg(entered)
    field.observe(changed, "value")
    return words.stacked(field, button)


@cache
def lesson_texts(lesson: str) -> dict[str, Any]:
    """What the TOML file of a lesson holds: checkpoints, objectives, exercises and mistakes."""
    text = Path(__file__).with_name(f"{lesson}.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)


def load_questions(lesson: str) -> tuple[tuple[Checkpoint, ...], tuple[Objective, ...]]:
    """The checkpoints and the objectives of a lesson, in the order of its TOML file.

    A choice has its options under A, B, C, ..., each with why it is right or wrong, and the right
    letter; a number has slips, each a wrong number with what leads to it. Names in the file are
    without the lesson's.
    """
    content = lesson_texts(lesson)

    def checkpoint(name: str, asked: dict[str, Any]) -> Checkpoint:
        question = _single_spaced(asked["question"])
        if "right" in asked:
            texts = {k: map(_single_spaced, asked[k]) for k in LETTERS if k in asked}
            options = (Option(next(t), next(t), k == asked["right"]) for k, t in texts.items())
            return Choice(name, question, tuple(options))
        slips = tuple(Classic(value, _single_spaced(why)) for value, why in asked["slips"])
        why, hint = _single_spaced(asked["why"]), _single_spaced(asked["hint"])
        return Number(name, question, asked["value"], asked["unit"], why, hint, slips)

    asked = (checkpoint(f"{lesson}.{key}", told) for key, told in content["checkpoints"].items())
    objectives = (
        Objective(_single_spaced(o["text"]), tuple(f"{lesson}.{n}" for n in o["shown_by"]))
        for o in content["objectives"]
    )
    return tuple(asked), tuple(objectives)


def _single_spaced(text: str) -> str:
    return " ".join(text.split())


# --- what is said back, and the record of it: progress.json in results/; no lesson prints it ---

RECORD = "progress.json"
VerdictKind = Literal["right", "core right", "wrong", "raised", "not attempted"]

# Okabe-Ito; the word beside it says the same, so nothing hangs on the colour.
SIDE_COLORS = {
    "right": "#009E73",
    "core right": "#009E73",
    "wrong": "#D55E00",
    "raised": "#D55E00",
    "not attempted": "#56B4E9",
}


@dataclass(frozen=True)
class Verdict:
    """A headline and a few lines; `named` is the misconception that was recognised, if one was.

    others: why other answers are not right, collapsed on a page. In the texts *asterisks* set
    emphasis and `backticks` code.
    """

    subject: str
    kind: VerdictKind
    headline: str
    lines: tuple[str, ...] = ()
    named: str | None = None
    others: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return "\n".join([self.headline, *self.lines, *self.others])

    def _repr_html_(self) -> str:
        body = "".join(f"<div>{_markup(line)}</div>" for line in self.lines)
        if self.others:
            others = "".join(f"<p>{_markup(line)}</p>" for line in self.others)
            body += f"<details><summary>{OTHERWISE}</summary>{others}</details>"
        return (
            f'<div style="border-left: 4px solid {SIDE_COLORS[self.kind]}; padding: 2px 0 2px 12px;'
            f' line-height: 1.4; max-width: 52em">'
            f"<b>{_markup(self.headline)}</b>{body}</div>"
        )


def _markup(text: str) -> str:
    """The text as HTML, all else escaped; within `code` stars are stars."""
    return re.sub(
        r"`([^`]+)`|\*([^*\s][^*]*)\*",
        lambda found: f"<code>{found[1]}</code>" if found[1] else f"<em>{found[2]}</em>",
        html.escape(text, quote=False),
    )


def noted(verdict: Verdict, answer: str = "") -> Verdict:
    """Add an attempt to the record, unless the verdict says that there was none.

    A verdict that cannot be saved says so in its last line.
    """
    if verdict.kind == "not attempted":
        return verdict
    attempt = {"kind": verdict.kind, "answer": answer, "date": results.now()}
    try:
        attempts = read_attempts()
        attempts.setdefault(verdict.subject, []).append(attempt)
        results.write_json(results.folder() / RECORD, attempts)
    except OSError as error:
        return replace(verdict, lines=(*verdict.lines, f"(Your progress is not saved: {error})"))
    return verdict


def read_attempts() -> dict[str, list[dict[str, Any]]]:
    """All attempts by name, oldest first; a damaged file is set aside, not overwritten.

    Each attempt has the keys kind (as in `Verdict`), answer and date.
    """
    path = results.folder() / RECORD
    if not path.is_file():
        return {}
    try:
        found: dict[str, list[dict[str, Any]]] = results.read_json(path)
        for name, tries in found.items():
            for attempt in checks.instance(name, tries, list):
                for key in ("kind", "answer", "date"):
                    checks.instance(key, attempt[key], str)
        return found
    except (KeyError, TypeError, ValueError) as error:
        aside = path.replace(path.with_suffix(".damaged.json")).name
        warnings.warn(f"{RECORD} is damaged ({error}): set aside as {aside}", stacklevel=2)
        return {}
