"""Checks of a learner's function that name the mistake.

The right answer is written as a few named *steps*. A misconception replaces one step by what a
learner who holds it would write, so a wrong function can be compared with each wrong model on the
same cases, and with each pair of them. Only an exact match is named: the nearest wrong model
misleads as soon as there are two mistakes. To add a misconception, write the wrong step in the
lesson's module, and in its TOML file, under [mistakes], what the student will read:

    PROJECT.add_mistakes(("read", "p1_p2_swapped", lambda k1, k2, p1, p2, k3: (k1, k2, p2, p1, k3)))

    p1_p2_swapped = ["your p1 and p2 are swapped", "Which of the two multiplies r² + 2x²?"]

What nobody listed is left to a general device: it edits what goes into the right answer, into each
of its steps and out of them (a sign, a factor, a column for another), and the source of each step
(an operator, a bracket, a name for another), and keeps the first edit that alone gives the same
numbers. Its words are in exercises.toml.
"""

from __future__ import annotations

import ast
import inspect
import itertools
import re
import traceback
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.lessons import questions
from coursekit.lessons.questions import Verdict

Step = Callable[..., Any]
Model = Callable[..., Any]


@dataclass(frozen=True)
class Mistake:
    """One wrong step: what it says to the learner, and a question that leads on.

    One that stands `alone` is not tried together with others (one of a long family, say). Without
    a step, `wrong` is what is made of the whole function. One of the `device` is not listed.
    """

    name: str
    says: str
    ask: str
    step: str = ""
    wrong: Step = field(default=lambda: None)
    alone: bool = False
    device: bool = False


@dataclass(frozen=True)
class Core:
    """The part of an exercise that comes first, where the rest may wait.

    of(args) is a case without the rest; the cases that it leaves as they are belong to the core.
    The verdict calls them "the cases <which>", and what may wait `rest`.
    """

    of: Callable[[tuple[Any, ...]], tuple[Any, ...]]
    which: str
    rest: str


@dataclass
class Exercise:
    """A function the learner writes, and all that is known about getting it wrong.

    build(steps) returns the model that uses these steps. Cases go from small to large, and the
    first one that fails is shown: `describe(args)` and `show(row)` put it into words. Where a
    result has rows and the first `per_row` arguments have the same, one row of them is shown;
    otherwise (a result that is one number, say) the whole case. Results agree within `tolerance`
    (in `unit`) or 1e-9 of their size, and NaN with NaN. Where `nan_answers`, NaN is an answer
    like any other; otherwise a wrong model that comes to NaN or infinity has overflowed. An
    attempt that leaves out what is beyond the `core` is judged by the core cases alone: by an
    exercise that has only those, and is `part_of` this one.
    """

    name: str
    build: Callable[[Mapping[str, Step]], Model]
    steps: dict[str, Step]
    cases: list[tuple[Any, ...]]
    per_row: int
    unit: str
    tolerance: float
    describe: Callable[[tuple[Any, ...]], str]
    show: Callable[[Floats], str]
    nan_answers: bool = False
    core: Core | None = None
    mistakes: list[Mistake] = field(default_factory=list)
    part_of: Exercise | None = field(default=None, repr=False)
    _known: dict[tuple[int, ...], Floats | None] = field(
        default_factory=dict, init=False, repr=False
    )
    _edits: list[list[Mistake]] = field(default_factory=list, init=False, repr=False)
    _alone: list[Exercise] = field(default_factory=list, init=False, repr=False)  # the core

    @property
    def function(self) -> str:
        """The learner's function's name."""
        return self.name.rpartition(".")[2]

    def add_mistakes(self, *wrong: tuple[str, str, Step], alone: bool = False) -> None:
        """Add wrong steps: the step, the misconception's name, and what is done in its place.

        One name may come several times: other ways to write the same misconception. What the
        student reads stands under it in the lesson's TOML file: what is wrong, and a question that
        leads on. Without a step, the wrong one is made of the whole function, and stands alone.
        """
        texts = self._written("mistakes")
        for step, name, instead in wrong:
            says, ask = (" ".join(text.split()) for text in texts[name])
            self.mistakes.append(Mistake(name, says, ask, step, instead, alone or not step))

    def read_mistakes(self, names: dict[str, Any]) -> None:
        """Add the wrong steps that stand in the TOML file; names: what their Python may use."""
        for name, ways in self._written("wrong")[self.function].items():
            self.add_mistakes(*((step, name, eval(code, names)) for step, code in ways))

    def _written(self, table: str) -> dict[str, Any]:
        return dict(questions.lesson_texts(self.name.partition(".")[0])[table])

    def model(self, *mistakes: Mistake) -> Model:
        """The right function with these mistakes built in."""
        model = self.build(self.steps | {m.step: m.wrong for m in mistakes if m.step})
        for mistake in mistakes:
            model = model if mistake.step else mistake.wrong(model)
        return model

    def check(self, function: Callable[..., Any]) -> Verdict:
        """The verdict on a learner's function; never raises, and notes the attempt."""
        return questions.noted(self.judge(function))

    def judge(self, function: Callable[..., Any]) -> Verdict:
        """The verdict on a learner's function, without noting it."""
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return self._verdict(function)

    def _verdict(self, function: Callable[..., Any]) -> Verdict:
        if not callable(function):
            return self._say("not attempted", f"got a {type(function).__name__}, not a function.")
        runs = [_run(function, args) for args in self.cases]
        if self.core and self._leaves_the_rest(self.core, function, runs):
            return self._core_alone()._verdict(function)
        unfinished = self._unfinished(function, runs)
        if unfinished:
            return unfinished
        expected = [np.asarray(self._answer((), args)) for args in self.cases]
        return self._compare(runs, expected)

    def _core_alone(self) -> Exercise:
        if not self._alone:
            cases = [args for args in self.cases if self.is_core(args)]
            self._alone.append(replace(self, cases=cases, core=None, part_of=self))
        return self._alone[0]

    def is_core(self, args: tuple[Any, ...]) -> bool:
        return self.core is None or len(self.core.of(args)) == len(args)

    def _leaves_the_rest(self, core: Core, function: Callable[..., Any], runs: list[Run]) -> bool:
        """Whether every case beyond the core gets nothing, or what it gets without the rest."""
        for run, args in zip(runs, self.cases, strict=True):
            if self.is_core(args) or isinstance(run.error, NotImplementedError):
                continue
            if run.error is not None:
                return False
            if run.value is not None:
                value = _as_numbers(run.value)
                bare = _as_numbers(_run(function, core.of(args)).value)
                if value is None or bare is None or not np.array_equal(value, bare, equal_nan=True):
                    return False
        return True

    def _unfinished(self, function: Callable[..., Any], runs: list[Run]) -> Verdict | None:
        """Not attempted, raised, or something that is not an array of the right shape."""
        if all(r.value is None and r.error is None for r in runs):
            code = getattr(function, "__code__", None)
            if code is None or len(code.co_code) <= len(_nothing.__code__.co_code):
                return self._say("not attempted", "not attempted yet: it returns None.")
            return self._say("wrong", "it returns None: is there a `return`?", NO_RETURN)
        for run, args in zip(runs, self.cases, strict=True):
            if isinstance(run.error, NotImplementedError):
                return self._say("not attempted", "not attempted yet.")
            kind, text = "wrong", "it returns None here; is a `return` missing?"
            if run.error is not None:
                kind, text = "raised", f"your function raised {run.said}"
            elif run.value is not None:
                if _as_numbers(run.value) is not None:
                    continue
                text = f"it returns a {type(run.value).__name__} that is not an array of numbers."
            return self._say(kind, text, self._given(args))
        return None

    def _compare(self, runs: list[Run], expected: list[Floats]) -> Verdict:
        values = [v for r in runs if (v := _as_numbers(r.value)) is not None]
        both = list(zip(values, expected, strict=True))
        formal = [IN_PLACE] if any(r.changed_input for r in runs) else []
        turned = [v.shape == e.T.shape for v, e in both if e.shape != e.T.shape]
        if turned and all(turned):
            formal.append(TRANSPOSED)
            values = [v.T if v.shape == e.T.shape else v for v, e in both]
        for value, want, args in zip(values, expected, self.cases, strict=True):
            if value.shape != want.shape:
                got, wanted = _shape(value), _shape(want)
                text = f"wrong shape: it returns {got}, and {wanted} is wanted."
                if self.per_row and 0 < value.ndim == want.ndim and len(value) < len(want):
                    text += f" Every row of the input has one in the result: {len(want)} of them."
                return self._say("wrong", text, self._given(args))
        return self._judged(values, expected, formal)

    def _right(self) -> Verdict:
        count = len(self.cases)
        if self.part_of and self.part_of.core:
            core, others = self.part_of.core, len(self.part_of.cases) - count
            text = f"the core is right: all {count} cases {core.which} agree."
            return self._say("core right", f"{text} Deeper: the other {others} use {core.rest}.")
        text = f"right. All {count} cases agree to {self.tolerance:g} {self.unit}."
        return self._say("right", text)

    def _judged(
        self, values: list[Floats], expected: list[Floats], formal: list[Mistake]
    ) -> Verdict:
        """The verdict on results of the right shape; formal: what else is wrong with them."""
        agree = [self._agrees(v, e) for v, e in zip(values, expected, strict=True)]
        if all(agree) and formal:
            right = f"The numbers are right.{self._later}"
            return self._one(formal[0], right) if len(formal) == 1 else self._several(formal[0])
        if all(agree):
            return self._right()
        count = f"{sum(agree)} of {self._all_cases} agree.{self._later}"
        first = agree.index(False)
        evidence = self._evidence(first, values[first], expected[first])
        if formal:
            return self._several(formal[0], count, evidence)
        relation = self._relation(values, expected)
        told = relation and relation[0] in ("runs_away", "constant")
        for mistakes in self._combinations():
            if told and mistakes[-1].device:
                break
            if self._explains(mistakes, values):
                if len(mistakes) > 1:
                    seen = self._seen_in(first, mistakes, expected[first])
                    return self._several(seen, count, evidence)
                return self._one(mistakes[0], count, evidence)
        if self.core:  # what goes wrong there may hide behind the rest
            rows = zip(values, expected, map(self.is_core, self.cases), strict=True)
            of_core = [(value, want) for value, want, core in rows if core]
            verdict = self._core_alone()._judged(*map(list, zip(*of_core, strict=True)), [])
            if verdict.named:
                return verdict
        if relation:
            return self._one(_device(*relation, "", replace), count, evidence)
        text = f"not right yet. {count}"
        return self._say("wrong", text, evidence, *self._right_parts(values, expected), BY_HAND)

    def _relation(self, values: list[Floats], expected: list[Floats]) -> tuple[str, str] | None:
        """What can be said of numbers that no model gives: they run away, or are proportional."""
        if all(np.array_equal(v, values[0], equal_nan=True) for v in values):
            return "constant", "your result"
        both = list(zip(values, expected, strict=True))
        if self.per_row and all(self._agrees_but_for_rows(v, e) for v, e in both):
            return "rows_lost", "your result"
        if expected[0].shape == (3, 3) and all(
            self._agrees(v, e) or (self._agrees(v @ v.T, np.eye(3)) and np.linalg.det(v) < 0)
            for v, e in both
        ):
            return "mirrored", "your result"
        if not self.nan_answers and not all(
            (np.abs(v) <= 1e6 * (1 + np.abs(e).max())).all() for v, e in both
        ):
            return "runs_away", "your result"
        factors = [float(np.vdot(e, v) / np.vdot(e, e)) for v, e in both]
        first, off = factors[0], self.tolerance / 10
        if not first or not all(
            abs(abs(k) - abs(first)) < 1e-6 * abs(first) and np.allclose(v, k * e, 1e-6, off)
            for k, (v, e) in zip(factors, both, strict=True)
        ):
            return None
        if len({k > 0 for k in factors}) == 1:
            return "factor", f"{first:.5g}"
        return ("signs", "") if abs(abs(first) - 1) < 1e-6 else ("factor_and_signs", f"{first:.5g}")

    def _agrees_but_for_rows(self, value: Floats, want: Floats) -> bool:
        """Whether of several rows some are right, and all others nothing: 0 or NaN."""
        if not want.ndim or len(want) == 1:
            return self._agrees(value, want)
        right = [self._agrees(v, e) for v, e in zip(value, want, strict=True)]
        return any(right) and all(
            r or not np.nan_to_num(v).any() for r, v in zip(right, value, strict=True)
        )

    def _right_parts(self, values: list[Floats], expected: list[Floats]) -> list[str]:
        """Says which columns or numbers of the result are right in all cases, if some are."""
        if min(e.ndim for e in expected) < 1 + bool(self.per_row):
            return []
        split = [[np.moveaxis(a, -bool(self.per_row), 0) for a in of] for of in (values, expected)]
        pairs = (zip(v, e, strict=True) for v, e in zip(*split, strict=True))
        right = [all(self._agrees(v, e) for v, e in part) for part in zip(*pairs, strict=True)]
        if not any(right):
            return []
        good = _listed(ORDINALS[i] for i, fine in enumerate(right) if fine)
        kind = "columns" if self.per_row else "parts"
        return [f"Of the {kind} of your result the {good} agrees in every case, the others do not."]

    def _seen_in(self, case: int, mistakes: tuple[Mistake, ...], want: Floats) -> Mistake:
        """The first of several mistakes that by itself shows in this case."""
        for mistake in mistakes:
            value = self._answer((mistake,), self.cases[case])
            if value is None or value.shape != want.shape or not self._agrees(value, want):
                return mistake
        return mistakes[0]

    @property
    def _all_cases(self) -> str:
        count = len(self.cases)
        if self.part_of and self.part_of.core:
            return f"the {count} cases {self.part_of.core.which}"
        return f"{count} cases"

    @property
    def _later(self) -> str:
        """Says in a verdict on the core what may wait."""
        if self.part_of and self.part_of.core:
            return f" ({self.part_of.core.rest} can wait.)"
        return ""

    def _one(self, mistake: Mistake, count: str, *lines: str) -> Verdict:
        text = f"{mistake.says}. {count}"
        return self._say("wrong", text, *lines, mistake.ask, named=mistake.name)

    def _several(self, first: Mistake, *lines: str) -> Verdict:
        text = f"more than one mistake. Look first at this: {first.says}."
        return self._say("wrong", text, *lines, first.ask, named=f"several, first {first.name}")

    def _combinations(self) -> Iterator[tuple[Mistake, ...]]:
        """Each mistake alone, then each pair of different steps, earlier step first; the device's
        edits; a mistake and an edit of the whole."""
        order = list(self.steps)
        yield from ((m,) for m in self.mistakes)
        listed = [m for m in self.mistakes if not m.alone]
        for a, b in itertools.combinations(listed, 2):
            if a.step != b.step:
                yield (a, b) if order.index(a.step) < order.index(b.step) else (b, a)
        if not self._edits:
            self._edits += _all_edits(self)
        single, double = self._edits
        yield from ((m,) for m in single)
        yield from ((m,) for m in double)
        common = [m for m in single if not m.step and m.name in COMMON and "result" in m.says]
        yield from itertools.product(listed, common)

    def _explains(self, mistakes: tuple[Mistake, ...], values: list[Floats]) -> bool:
        """Whether a wrong model gives exactly these values.

        Where the model itself overflows (an iteration that diverges, say) nobody's arithmetic
        agrees, and the case is left out; so one case at least must show that the model is wrong.
        """
        shown = False
        for value, args in self._telling(values):
            wrong = self._answer(mistakes, args)
            if wrong is None:
                if mistakes[-1].device:
                    return False
                continue
            if value.shape != wrong.shape or not self._agrees(value, wrong):
                return False
            right = self._answer((), args)
            shown = shown or right is None or not self._agrees(wrong, right)
        return shown

    def _telling(self, values: list[Floats]) -> list[tuple[Floats, tuple[Any, ...]]]:
        """Results with their cases, such as tell most first: the last one of the core, the last."""
        both = list(zip(values, self.cases, strict=True))[::-1]
        first = next(i for i, (_, args) in enumerate(both) if self.is_core(args))
        return [both.pop(first), *both]

    def _answer(self, mistakes: tuple[Mistake, ...], args: tuple[Any, ...]) -> Floats | None:
        """What a wrong model makes of a case, None where it overflows.

        It is kept, because every check asks all of them.
        """
        key = (*map(id, mistakes), id(args))
        if key not in self._known:
            try:
                value = _as_numbers(self.model(*mistakes)(*args))
            except Exception:  # an edit of the device may come to nothing
                value = None
            overflows = value is not None and not self.nan_answers and not np.isfinite(value).all()
            self._known[key] = None if overflows else value
        return self._known[key]

    def _agrees(self, value: Floats, want: Floats) -> bool:
        """As np.allclose says with equal_nan, in a third of its time: checks ask this often."""
        off = np.abs(value - want)
        if (off > self.tolerance + 1e-9 * np.abs(want)).any():
            return False
        equal = (value == want) | (np.isnan(value) & np.isnan(want))
        return bool((np.isfinite(off) | equal).all())

    def _evidence(self, index: int, value: Floats, want: Floats) -> str:
        """The first failing case, or its row that is furthest off, with its input."""
        args = self.cases[index]
        if want.ndim and self.per_row:
            off = np.abs(value - want).reshape(len(want), -1).max(axis=1)
            row = int(np.nan_to_num(off, nan=np.inf).argmax())
            args = tuple(a[row : row + 1] for a in args[: self.per_row]) + args[self.per_row :]
            value, want = value[row], want[row]
        both = f"expected {self.show(want)}, yours {self.show(value)} {self.unit}."
        return f"{self._given(args)} {both}"

    def _given(self, args: tuple[Any, ...]) -> str:
        return f"The case: {self.describe(args)}."

    def _say(self, kind: Any, text: str, *lines: str, named: str | None = None) -> Verdict:
        return Verdict(self.name, kind, f"{self.function}: {text}", lines, named)


def _nothing() -> None:
    return None


NO_RETURN = (
    "Printing or keeping a result does not give it back: `return` does. And the template's own "
    "`return None` has to go."
)
BY_HAND = (
    "No single mistake that this check knows gives these numbers. Work this case by hand, one "
    "step at a time, and compare."
)
IN_PLACE = Mistake(
    "in_place",
    "your function changes the array it is given",
    "Whoever calls it loses the original. Which line writes into an argument?",
)
TRANSPOSED = Mistake(
    "transposed",
    "your result is transposed: one column a point, and one row a point is wanted",
    "Print the shape of what you return. Which axis counts the points?",
)


@dataclass(frozen=True)
class Run:
    """One call of a function on copies of its arguments."""

    value: Any
    error: BaseException | None = None
    said: str = ""
    changed_input: bool = False


def _run(function: Callable[..., Any], args: tuple[Any, ...]) -> Run:
    own = tuple(np.array(a) if isinstance(a, np.ndarray) else a for a in args)
    try:
        value = function(*own)
    except (Exception, SystemExit) as error:  # whatever a learner's code does, the check goes on
        return Run(None, error, _what_was_raised(error, function))
    changed = any(
        isinstance(a, np.ndarray) and not np.array_equal(a, b, equal_nan=True)
        for a, b in zip(args, own, strict=True)
    )
    return Run(value, changed_input=changed)


def _what_was_raised(error: BaseException, function: Callable[..., Any]) -> str:
    """The exception in words, with the learner's own line that it came from."""
    said = f"`{type(error).__name__}: {error}`"
    file = getattr(getattr(function, "__code__", None), "co_filename", None)
    lines = [f.line for f in traceback.extract_tb(error.__traceback__) if f.filename == file]
    return f"{said} at `{lines[-1]}`" if lines and lines[-1] else said


def _shape(array: Floats) -> str:
    return f"an array of shape {array.shape}" if array.ndim else "one number"


def _as_numbers(value: Any) -> Floats | None:
    try:
        array = np.asarray(value)
        return array.astype(float) if array.dtype.kind in "fiub" else None
    except (TypeError, ValueError):
        return None


# --- the general device ---

Edit = Callable[[Any], Any]
Place = tuple[Any, Any]  # a node of a syntax tree, or a list of them, and a field or an index of it
Way = tuple[tuple[str, int], ...]
Swap = tuple[Place, ast.AST]

EDITS: dict[str, Edit] = {
    "negative": np.negative,
    "absolute": np.abs,
    "reciprocal": lambda v: 1 / np.asarray(v),
    "twice": lambda v: 2 * v,
    "half": lambda v: v / 2,
    "root_of_two": lambda v: np.sqrt(2) * v,
    "root_of_two_missing": lambda v: v / np.sqrt(2),
    "thousand": lambda v: 1000 * v,
    "thousandth": lambda v: v / 1000,
    "hundred": lambda v: 100 * v,
    "hundredth": lambda v: v / 100,
    "degrees": np.degrees,
    "radians": np.radians,
    "squared": np.square,
    "rooted": np.sqrt,
    "angle": np.arctan,
    "sine": lambda v: v / np.sqrt(1 + np.square(v)),
    "cosine": lambda v: 1 / np.sqrt(1 + np.square(v)),
    "tangent": np.tan,
    "truncated": np.trunc,
    "rounded": np.rint,
    "one_more": lambda v: v + 1,
    "one_less": lambda v: v - 1,
    "zero": np.zeros_like,
    "one": np.ones_like,
    "first_only": lambda v: np.broadcast_to(v[:1], v.shape),
    "backwards": lambda v: v[::-1],
    "transposed": lambda v: np.swapaxes(v, -1, -2),
    "inverted": np.linalg.inv,
    "normalised": lambda v: v / np.linalg.norm(v),
}
COMMON = ("negative", "twice", "half", "thousand", "hundred", "truncated", "exchanged", "copied")
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh")


def _all_edits(exercise: Exercise) -> tuple[list[Mistake], list[Mistake]]:
    """Single edits of the whole function and of its steps, and pairs within one step's source."""
    args, steps = exercise.cases[-1], exercise.steps
    seen: dict[str, tuple[tuple[Any, ...], Any]] = {}

    def watched(name: str) -> Step:
        def step(*values: Any) -> Any:
            seen[name] = values, steps[name](*values)
            return seen[name][1]

        return step

    def parts(result: Any) -> Any:  # of one case: its rows have columns, or it has a few parts
        array = np.asarray(result)
        return array if exercise.per_row or not array.ndim else tuple(array)

    result = parts(exercise.build({name: watched(name) for name in steps})(*args))
    names = [f"`{name}`" for name in inspect.signature(exercise.model()).parameters]
    found, pairs = [], []
    for kind, where, edit in _edits_of(result, "your result"):
        found.append((kind, where, "", lambda f, e=edit: lambda *a: e(parts(f(*a)))))
    for name, step in steps.items():
        for count, (kind, where, wrong) in _rewritten(step):
            (found if count == 1 else pairs).append((kind, where, name, wrong))
    for kind, where, edit in _edits_of(args, names):
        found.append((kind, where, "", lambda f, e=edit: lambda *a: f(*e(a))))
    for kind, where, edit in _scaled(args, names, result, "your result"):
        found.append((kind, where, "", lambda f, e=edit: lambda *a: e(a, parts(f(*a)))))
    for name, (values, given) in seen.items():
        step, own = steps[name], _argument_names(steps[name], len(values))
        made = f"what is made of {_listed(own)}"
        for kind, where, edit in _edits_of(given, made, deep=False):
            found.append((kind, where, name, lambda *a, e=edit, f=step: e(f(*a))))
        for kind, where, edit in _edits_of(values, own, deep=False):
            found.append((kind, where, name, lambda *a, e=edit, f=step: f(*e(a))))
        for kind, where, edit in _scaled(values, own, given, made):
            found.append((kind, where, name, lambda *a, e=edit, f=step: e(a, f(*a))))
    return [_device(*edit) for edit in found], [_device(*edit, several=True) for edit in pairs]


def _device(kind: str, where: str, step: str, wrong: Step, several: bool = False) -> Mistake:
    says, ask = (" ".join(text.split()) for text in _kinds()[kind])
    says = says.replace("WHERE", where)
    if several:
        says = f"more than one mistake. Look first at this: {says}"
    return Mistake(kind, says, ask, step, wrong, device=True)


@cache
def _kinds() -> dict[str, list[str]]:
    return dict(questions.lesson_texts("exercises")["kinds"])


def _listed(names: Iterable[str]) -> str:
    *others, last = dict.fromkeys(names) or ["the code"]
    return f"{', '.join(others)} and {last}" if others else last


def _argument_names(step: Step, count: int) -> list[str]:
    try:
        parameters = inspect.signature(step).parameters.values()
    except ValueError:  # some functions written in C say none
        return ["the input"] * count
    own = [f"`{p.name}`" for p in parameters if p.kind is not p.VAR_POSITIONAL]
    rest = [f"`{p.name}`" for p in parameters if p.kind is p.VAR_POSITIONAL]
    return (own + rest * count)[:count]


# Edits of a value: of all of it, and of its parts. Each is a kind, where it is, and what it does.


def _edits_of(
    value: Any, named: str | list[str], deep: bool = True
) -> Iterator[tuple[str, str, Edit]]:
    """named: what the value is called, or each part of a tuple; not deep: only a tuple has parts."""
    whole = named if isinstance(named, str) else _listed(named)
    if isinstance(value, (int, float, np.generic, np.ndarray)):
        yield from ((kind, whole, edit) for kind, edit in EDITS.items())
    parts = _parts(value, named) if deep or isinstance(value, tuple) else []
    for label, index, part in parts:
        for kind, where, edit in _edits_of(part, label, deep):
            yield kind, where, partial(_at, [index], edit)
    arrays = [(i, part) for _, i, part in parts if isinstance(part, (np.generic, np.ndarray))]
    if len(arrays) > 1 and len({part.shape for _, part in arrays}) == 1:
        for kind, where, edit in _edits_of(arrays[0][1], whole, deep):
            yield kind, where, partial(_at, [i for i, _ in arrays], edit)
    for (a, i, x), (b, j, y) in itertools.permutations(parts, 2):
        if np.shape(x) == np.shape(y) and not callable(x):
            yield "copied", _listed((a, b)), partial(_taken, [(i, j)])
            yield "exchanged", _listed((a, b)), partial(_taken, [(i, j), (j, i)])


def _parts(value: Any, named: str | list[str]) -> list[tuple[str, Any, Any]]:
    """What each part is called, its index and itself: of a tuple, of columns, of a pose."""
    labels = named if isinstance(named, list) else []
    indices: list[Any] = []
    if isinstance(value, tuple):
        kind = "part" if any(map(np.ndim, value)) else "number"
        labels = labels or [f"the {n} {kind} of {named}" for n in ORDINALS]
        indices = list(range(len(value)))
    elif isinstance(value, np.ndarray) and value.shape == (4, 4):
        labels = [f"the {part} of {named}" for part in ("translation", "rotation", "last row")]
        indices = [(slice(3), 3), (slice(3), slice(3)), 3]
    elif isinstance(value, np.ndarray) and value.ndim == 2 and value.shape[1] < min(4, len(value)):
        labels = [f"the {n} column of {named}" for n in ORDINALS]
        indices = [(..., i) for i in range(value.shape[1])]
    return [(label, i, value[i]) for label, i in zip(labels, indices)]  # noqa: B905


def _scaled(
    inputs: tuple[Any, ...], names: list[str], value: Any, named: str
) -> Iterator[tuple[str, str, Callable[..., Any]]]:
    """Edits that multiply or divide a value, or a part of it, by one of the inputs."""
    indices = [index for _, index, _ in _parts(value, named)] or [None]
    for (i, given), index in itertools.product(enumerate(inputs), indices):
        if isinstance(given, (float, np.generic)) or np.ndim(given) == 1:
            for kind, by in (("factor_too_many", np.multiply), ("factor_missing", np.divide)):
                if index is None:
                    yield kind, names[i], lambda a, v, i=i, by=by: by(v, a[i])
                else:
                    yield (
                        kind,
                        names[i],
                        lambda a, v, i=i, by=by, n=index: _at([n], lambda x: by(x, a[i]), v),
                    )


def _at(indices: list[Any], edit: Edit, value: Any) -> Any:
    new = list(value) if isinstance(value, tuple) else np.array(value, float)
    for i in indices:
        new[i] = edit(value[i])
    return tuple(new) if isinstance(value, tuple) else new


def _taken(pairs: list[tuple[Any, Any]], value: Any) -> Any:
    new = list(value) if isinstance(value, tuple) else np.array(value, float)
    for i, j in pairs:
        new[i] = value[j]
    return tuple(new) if isinstance(value, tuple) else new


# Edits of the source of a step.

OPERATORS: dict[type[ast.operator], dict[str, type[ast.operator]]] = {
    ast.Add: {"subtracted": ast.Sub, "product_for_sum": ast.Mult},
    ast.Sub: {"added": ast.Add},
    ast.Mult: {"divided": ast.Div, "sum_for_product": ast.Add},
    ast.Div: {"multiplied": ast.Mult, "difference_for_quotient": ast.Sub},
    ast.Pow: {"power_as_product": ast.Mult},
    ast.MatMult: {"elementwise": ast.Mult},
}
# Functions that are taken for each other, by family.
FUNCTIONS = (
    ("mean", "median", "sum", "max", "min", "std", "var"),
    ("sin", "cos", "tan", "arctan", "arcsin", "arctan2", "hypot"),
    ("inv", "transpose"),
    ("sqrt", "square", "abs"),
    ("round", "int"),
)
COMPARED: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.GtE: (ast.Gt, ast.Eq),
    ast.Gt: (ast.GtE,),
    ast.LtE: (ast.Lt,),
    ast.Lt: (ast.LtE,),
    ast.Eq: (ast.NotEq,),
    ast.NotEq: (ast.Eq, ast.Gt),
}
MOST_SITES = 45  # a step with more of them is not tried with two edits


@cache
def _rewritten(step: Step) -> list[tuple[int, tuple[str, str, Step]]]:
    """The step with one edit of its source, or the like in several places; then with two.

    Before each stands 1 or 2. A step without a source has none.
    """
    tree = _source(step)
    if tree is None:
        return []
    space = step.__globals__ | inspect.getclosurevars(step).nonlocals
    names = {n.arg for n in ast.walk(tree) if isinstance(n, ast.arg)}
    names |= {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and type(n.ctx) is ast.Store}
    sites, groups = [], defaultdict(list)
    for place, node, path in _walk(tree):
        around = node if isinstance(node, ast.expr) and _named_in(node) else place[0]
        for kind, detail, new in _alternatives(node, names):
            where = _named_in(around) if isinstance(around, ast.AST) else "the code"
            if kind == "name":
                where = detail[1]
            elif kind == "function_dropped":
                where = f"`{ast.unparse(node.func).rpartition('.')[2]}` of {where}"
            sites.append((kind, where or "the code", [(place, new)]))
            beside = tuple(step for step in path if step[0] not in ("left", "right"))
            for like in ((), tuple(name for name, _ in path), beside, where):
                groups[kind, detail, like].append((where, (place, new)))
    sites = [*_copied_lines(tree), *sites]
    pairs = []
    if len(sites) <= MOST_SITES:
        pairs = [
            (kind, where, a + b) for (kind, where, a), (*_, b) in itertools.combinations(sites, 2)
        ]
    for (kind, *_), swaps in groups.items():
        if len(swaps) > 1:
            sites.append((kind, swaps[0][0], [swap for _, swap in swaps]))
    found = [(1, "bracket", said, _compiled(new, space)) for said, new in _unbracketed(tree)]
    for count, edits in ((1, sites), (2, pairs)):
        for kind, where, swaps in edits:
            found.append((count, kind, where, _compiled(tree, space, swaps)))
    return [(count, (kind, said, new)) for count, kind, said, new in found if new is not None]


@cache
def _module(file: str) -> ast.Module:
    return ast.parse(Path(file).read_text(encoding="utf-8"))


def _source(step: Step) -> ast.Lambda | ast.FunctionDef | None:
    """The lambda or the definition that a step was made by."""
    code = getattr(step, "__code__", None)
    if code is None or not Path(code.co_filename).exists():
        return None
    places = set(code.co_positions())
    for node in ast.walk(_module(code.co_filename)):
        if isinstance(node, ast.FunctionDef) and node.lineno == code.co_firstlineno:
            return node
        if isinstance(node, ast.Lambda):
            body = node.body
            if (body.lineno, body.end_lineno, body.col_offset, body.end_col_offset) in places:
                return node
    return None


def _walk(holder: ast.AST, path: Way = ()) -> Iterator[tuple[Place, ast.AST, Way]]:
    """Each node: its place, itself and the way to it, fields with the number in a list of nodes."""
    for name, child in ast.iter_fields(holder):
        for i, part in enumerate(child if isinstance(child, list) else [child]):
            if isinstance(part, ast.AST) and not isinstance(part, ast.arguments):
                place = (child, i) if isinstance(child, list) else (holder, name)
                yield place, part, (*path, (name, i))
                yield from _walk(part, (*path, (name, i)))


def _alternatives(node: ast.AST, names: set[str]) -> Iterator[tuple[str, Any, ast.AST]]:
    """What may be written in a node's place: the kind of edit, what tells it from others, the new."""
    match node:
        case ast.BinOp(left, op, right):
            for kind, other in OPERATORS.get(type(op), {}).items():
                yield kind, None, ast.BinOp(left, other(), right)
                if other is ast.Div:
                    yield kind, "turned", ast.BinOp(right, other(), left)
            yield "dropped", ast.dump(right), left
            yield "dropped", ast.dump(left), right
            if isinstance(op, (ast.Sub, ast.Div, ast.MatMult)):
                yield "turned_round", type(op), ast.BinOp(right, op, left)
        case ast.Constant(value) if type(value) in (int, float):
            for other in (value + 1, value - 1, -value):
                yield "number", (value, other), ast.Constant(other)
        case ast.Name(name, ast.Load()) if name in names:
            for other in sorted(names - {name}):
                yield "name", (name, f"`{other}`"), ast.Name(other, ast.Load())
        case ast.Call(function, [first, *_] as arguments, keywords):
            yield "function_dropped", ast.dump(function), first
            name = getattr(function, "attr", getattr(function, "id", ""))
            for other in (n for f in FUNCTIONS if name in f for n in f if n != name):
                new = ast.parse(ast.unparse(function)[: -len(name)] + other, mode="eval").body
                yield "function", (name, other), ast.Call(new, arguments, keywords)
        case ast.Attribute(value, "T"):
            yield "transpose_missing", None, value
        case ast.UnaryOp(_, operand):
            yield "sign_missing", None, operand
        case ast.Compare(left, [op], rights):
            for other in COMPARED.get(type(op), ()):
                yield "comparison", None, ast.Compare(left, [other()], rights)


def _copied_lines(tree: ast.AST) -> Iterator[tuple[str, str, list[Swap]]]:
    """A line that repeats another one of the like form, and is not adapted everywhere."""
    for node in ast.walk(tree):
        lines = getattr(node, "elts", None) or getattr(node, "body", None)
        for a, b in itertools.permutations(lines if isinstance(lines, list) else [], 2):
            ours, theirs = (list(_walk(ast.Module([line], []))) for line in (a, b))
            if [type(x) for _, x, _ in ours] == [type(y) for _, y, _ in theirs]:
                swaps = [
                    (place, x)
                    for (_, x, _), (place, y, _) in zip(ours, theirs, strict=True)
                    if isinstance(x, (ast.Name, ast.Constant)) and ast.dump(x) != ast.dump(y)
                ][:5]
                for n in range(1, len(swaps) + 1):
                    for some in itertools.combinations(swaps, n):
                        yield "line_copied", _named_in(*(x for _, x in some)), list(some)


def _unbracketed(tree: ast.AST) -> Iterator[tuple[str, ast.AST]]:
    """The source without one, two or all of its brackets."""
    text, opened, brackets = ast.unparse(tree), [], []
    for i, sign in enumerate(text):
        if sign == "(":
            opened.append(i)
        elif sign == ")":
            start = opened.pop()
            if not re.match(r"[\w)\]]", text[start - 1 : start] or " "):
                brackets.append((start, i))
    chosen = [c for n in (1, 2, len(brackets)) for c in itertools.combinations(brackets, n)]
    for some in dict.fromkeys(c for c in chosen if c):
        gone = {i for pair in some for i in pair}
        try:
            new = ast.parse("".join(" " if i in gone else s for i, s in enumerate(text))).body[0]
        except SyntaxError:
            continue
        new = new.value if isinstance(new, ast.Expr) else new
        if type(new) is type(tree) and ast.dump(new) != ast.dump(tree):
            yield _named_in(ast.parse(text[some[0][0] : some[0][1] + 1])), new


def _named_in(*nodes: ast.AST) -> str:
    """The first three names of quantities in some source, none for a number."""
    inside = [n for node in nodes for n in ast.walk(node)]
    called = {id(n.func) for n in inside if isinstance(n, ast.Call)}
    names = [n.id for n in inside if isinstance(n, ast.Name) and id(n) not in called]
    found = list(dict.fromkeys(f"`{name}`" for name in names if name not in ("np", "math")))
    return _listed(found[:3]) if found else ""


def _compiled(tree: Any, space: dict[str, Any], swaps: Iterable[Swap] = ()) -> Step | None:
    """The function that a lambda or a definition makes with some of its nodes replaced; None for
    what is no Python."""
    old = [((holder, key), _put(holder, key, new)) for (holder, key), new in swaps]
    own: dict[str, Step] = {}
    body = (
        ast.Assign([ast.Name("step", ast.Store())], tree) if isinstance(tree, ast.Lambda) else tree
    )
    try:
        exec(
            compile(ast.fix_missing_locations(ast.Module([body], [])), "<edit>", "exec"), space, own
        )
    except SyntaxError:
        return None
    finally:
        for (holder, key), node in reversed(old):
            _put(holder, key, node)
    return next(iter(own.values()))


def _put(holder: Any, key: Any, new: ast.AST) -> ast.AST:
    """Sets a node in its place and gives the one that stood there."""
    if isinstance(holder, list):
        holder[key], new = new, holder[key]
        return new
    old = getattr(holder, key)
    setattr(holder, key, new)
    return old
