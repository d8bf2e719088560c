"""Checks of a learner's function that name the mistake.

The right answer is written as a few named *steps*. A misconception replaces one step by what a
learner who holds it would write, so a wrong function can be compared with each wrong model on the
same cases, and with each pair of them. Only an exact match is named: the nearest wrong model
misleads as soon as there are two mistakes. To add a misconception, write the wrong step in the
lesson's module, and in its TOML file, under [mistakes], what the student will read:

    PROJECT.add_mistakes(("read", "p1_p2_swapped", lambda k1, k2, p1, p2, k3: (k1, k2, p2, p1, k3)))

    p1_p2_swapped = ["your p1 and p2 are swapped", "Which of the two multiplies r² + 2x²?"]
"""

from __future__ import annotations

import itertools
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
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

    One that stands `alone` is not tried together with others (one of a long family, say).
    """

    name: str
    says: str
    ask: str
    step: str = ""
    wrong: Step = field(default=lambda: None)
    alone: bool = False


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
    like any other; otherwise a wrong model that comes to NaN or infinity has overflowed. ways:
    other right answers, what each does and the steps that do it; `way` is what the model does. An
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
    way: str = ""
    ways: list[tuple[str, dict[str, Step]]] = field(default_factory=list)
    core: Core | None = None
    mistakes: list[Mistake] = field(default_factory=list)
    part_of: Exercise | None = field(default=None, repr=False)
    _known: dict[tuple[int, ...], Floats | None] = field(
        default_factory=dict, init=False, repr=False
    )

    @property
    def function(self) -> str:
        """The learner's function's name."""
        return self.name.rpartition(".")[2]

    def add_mistakes(self, *wrong: tuple[str, str, Step], alone: bool = False) -> None:
        """Add wrong steps: the step, the misconception's name, and what is done in its place.

        One name may come several times: other ways to write the same misconception. What the
        student reads stands under it in the lesson's TOML file: what is wrong, and a question that
        leads on.
        """
        texts = questions.lesson_texts(self.name.partition(".")[0])["mistakes"]
        for step, name, instead in wrong:
            says, ask = (" ".join(text.split()) for text in texts[name])
            self.mistakes.append(Mistake(name, says, ask, step, instead, alone))

    def model(self, *mistakes: Mistake) -> Model:
        """The right function with these mistakes built in."""
        return self.build(self.steps | {m.step: m.wrong for m in mistakes})

    def check(self, function: Callable[..., Any]) -> Verdict:
        """The verdict on a learner's function; never raises, and notes the attempt."""
        return questions.noted(self.judge(function))

    def judge(self, function: Callable[..., Any]) -> Verdict:
        """The verdict on a learner's function, without noting it."""
        verdicts = (exercise._judge(function) for exercise in (self, *self._others))
        return min(verdicts, key=lambda v: (v.kind != "right", not v.named, "," in (v.named or "")))

    @cached_property
    def _others(self) -> list[Exercise]:
        """The exercise as those see it who answer it in another right way."""
        ways = self.ways
        return [replace(self, way=way, steps=self.steps | own, ways=[]) for way, own in ways]

    def _judge(self, function: Callable[..., Any]) -> Verdict:
        if not callable(function):
            return self._say("not attempted", f"got a {type(function).__name__}, not a function.")
        runs = [_run(function, args) for args in self.cases]
        if self.core and self._leaves_the_rest(self.core, function, runs):
            cases = [args for args in self.cases if self.is_core(args)]
            return replace(self, cases=cases, core=None, part_of=self).judge(function)
        unfinished = self._unfinished(runs)
        if unfinished:
            return unfinished
        expected = [np.asarray(self._answer((), args)) for args in self.cases]
        return self._compare(runs, expected)

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

    def _unfinished(self, runs: list[Run]) -> Verdict | None:
        """Not attempted, raised, or something that is not an array of the right shape."""
        if all(r.value is None and r.error is None for r in runs):
            return self._say("not attempted", "not attempted yet: it returns None.")
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
                return self._say("wrong", text, self._given(args))
        return self._judged(values, expected, formal)

    def _right(self) -> Verdict:
        count = len(self.cases)
        if self.part_of and self.part_of.core:
            core, others = self.part_of.core, len(self.part_of.cases) - count
            text = f"the core is right: all {count} cases {core.which} agree."
            return self._say("core right", f"{text} Deeper: the other {others} use {core.rest}.")
        way = f", {self.way}" if self.way else ""
        text = f"right{way}. All {count} cases agree to {self.tolerance:g} {self.unit}."
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
        for mistakes in self._combinations():
            if self._explains(mistakes, values):
                if len(mistakes) > 1:
                    seen = self._seen_in(first, mistakes, expected[first])
                    return self._several(seen, count, evidence)
                return self._one(mistakes[0], count, evidence)
        return self._say(
            "wrong",
            f"not right yet. {count}",
            evidence,
            "No single mistake that this check knows gives these numbers. Work this "
            "case by hand, one step at a time, and compare.",
        )

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
        """Each mistake alone, then each pair of different steps, earlier step first."""
        order = list(self.steps)
        yield from ((m,) for m in self.mistakes)
        for a, b in itertools.combinations([m for m in self.mistakes if not m.alone], 2):
            if a.step != b.step:
                yield (a, b) if order.index(a.step) < order.index(b.step) else (b, a)

    def _explains(self, mistakes: tuple[Mistake, ...], values: list[Floats]) -> bool:
        """Whether a wrong model gives exactly these values.

        Where the model itself overflows (an iteration that diverges, say) nobody's arithmetic
        agrees, and the case is left out; so one case at least must show that the model is wrong.
        """
        shown = False
        for value, args in zip(values[::-1], self.cases[::-1], strict=True):  # the last tell most
            wrong = self._answer(mistakes, args)
            if wrong is None:
                continue
            if not self._agrees(value, wrong):
                return False
            right = self._answer((), args)
            shown = shown or right is None or not self._agrees(wrong, right)
        return shown

    def _answer(self, mistakes: tuple[Mistake, ...], args: tuple[Any, ...]) -> Floats | None:
        """What a wrong model makes of a case, None where it overflows.

        It is kept, because every check asks all of them.
        """
        key = (*map(id, mistakes), id(args))
        if key not in self._known:
            value = _as_numbers(_run(self.model(*mistakes), args).value)
            overflows = value is not None and not self.nan_answers and not np.isfinite(value).all()
            self._known[key] = None if overflows else value
        return self._known[key]

    def _agrees(self, value: Floats, want: Floats) -> bool:
        """As np.allclose says with equal_nan, in a third of its time: checks ask this often."""
        with np.errstate(all="ignore"):
            off = np.abs(value - want)
            if (off > self.tolerance + 1e-9 * np.abs(want)).any():
                return False
        equal = (value == want) | (np.isnan(value) & np.isnan(want))
        return bool((np.isfinite(off) | equal).all())

    def _evidence(self, index: int, value: Floats, want: Floats) -> str:
        """The first failing case, or its row that is furthest off, with its input."""
        args = self.cases[index]
        if want.ndim and self.per_row:
            with np.errstate(all="ignore"):
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
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
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
