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
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property, partial
from pathlib import Path
from types import CodeType
from typing import Any, NamedTuple

import numpy as np

from coursekit.arrays import Floats
from coursekit.lessons import questions
from coursekit.lessons.questions import Verdict

Step = Callable[..., Any]
Steps = Mapping[str, Step]
Model = Callable[..., Any]


@dataclass(frozen=True)
class Mistake:
    """One wrong step: what it says to the learner, and a question that leads on.

    One that stands `alone` is not tried together with others (one of a long family, say). Without
    a step, `wrong` is what is made of the whole function. One of the `device` is not listed;
    one `of_result` needs nothing but what the function gives.
    """

    name: str
    says: str
    ask: str
    step: str = ""
    wrong: Step = field(default=lambda: None)
    alone: bool = False
    device: bool = False
    of_result: bool = False


@dataclass(frozen=True)
class Core:
    """The part of an exercise that comes first, where the rest may wait.

    It uses the first so many `arguments`; the cases that have no more belong to it, and as many
    are `beyond` it. The verdict calls them "the cases <which>", and what may wait `rest`.
    """

    arguments: int
    which: str
    rest: str
    beyond: int = 0


@dataclass(kw_only=True)
class Exercise:
    """A function the learner writes, and all that is known about getting it wrong.

    build(steps, *args) is the model that uses these steps. Cases go from small to large, and the
    first one that fails is shown: `describe(args)` and `show(row)` put it into words. Where a
    result has rows and the first `per_row` arguments have the same, one row of them is shown;
    otherwise (a result that is one number, say) the whole case. parts: what the columns of a
    result, or its numbers, are called; seen: names in formulas of the text. Results agree within
    `tolerance` (in `unit`) or a millionth of their size, as float32 does, and NaN with NaN. Where
    `nan_answers`, NaN is an answer like any other; otherwise a wrong model that comes to NaN or
    infinity has overflowed. ways: other right answers, what each does and the steps that do it;
    `way` is what the model does, and `another_way` says that it is one of them. styles: the whole
    function as learners write it, for the device to edit. An attempt that leaves out what is beyond
    the `core` is judged by the core cases alone: by an exercise that has only those, and is
    `part_of` the whole.
    """

    name: str
    build: Model
    steps: dict[str, Step]
    cases: list[tuple[Any, ...]]
    unit: str
    describe: Callable[[tuple[Any, ...]], str]
    show: Callable[[Floats], str]
    parts: Sequence[str] = ()
    seen: str = ""
    per_row: int = 0
    tolerance: float = 1e-6
    nan_answers: bool = False
    way: str = ""
    ways: list[tuple[str, dict[str, Step]]] = field(default_factory=list)
    core: Core | None = None
    styles: list[Model] = field(default_factory=list)
    mistakes: list[Mistake] = field(default_factory=list)
    part_of: Core | None = None
    another_way: bool = False
    _known: dict[tuple[int, ...], Floats | None] = field(
        default_factory=dict, init=False, repr=False
    )

    @classmethod
    def told(cls, name: str, cases: Sequence[tuple[Any, ...]] = (), **own: Any) -> Exercise:
        """An exercise of which the lesson's TOML file tells the rest; `cases` follow those there.

        A list there is an array, and a name in a case is what stands under it in [given].
        """
        texts = questions.lesson_texts(name.partition(".")[0])
        facts = dict(texts["exercises"][name.partition(".")[2]])

        def argument(value: Any) -> Any:
            value = texts["given"][value] if isinstance(value, str) else value
            return np.array(value) if isinstance(value, list) else value

        written = [tuple(map(argument, case)) for case in facts.pop("cases", ())]
        if "core" in facts:
            facts["core"] = Core(**facts["core"])
        if "show" in facts:
            facts["show"] = partial(in_digits, facts["show"])
        return cls(name=name, cases=[*written, *cases], **facts, **own)

    @property
    def function(self) -> str:
        """The learner's function's name."""
        return self.name.rpartition(".")[2]

    def add_mistakes(self, *wrong: tuple[str, str, *tuple[Step, ...]], alone: bool = False) -> None:
        """Add wrong steps: the step, the misconception's name, and what is done in its place.

        Other ways to write the same misconception follow, there or under its name once more. What
        the student reads stands under it in the lesson's TOML file: what is wrong, and a question
        that leads on. Without a step, the wrong one is made of the whole function, and stands
        alone.
        """
        texts = questions.lesson_texts(self.name.partition(".")[0])["mistakes"]
        for step, name, *ways in wrong:
            says, ask = (" ".join(text.split()) for text in texts[name])
            for way in ways:
                self.mistakes.append(Mistake(name, says, ask, step, way, alone or not step))

    def model(self, *mistakes: Mistake) -> Model:
        """The right function with these mistakes built in."""
        model = partial(self.build, self.steps | {m.step: m.wrong for m in mistakes if m.step})
        for mistake in mistakes:
            model = model if mistake.step else mistake.wrong(model)
        return model

    def judge(self, function: Callable[..., Any]) -> Verdict:
        """The verdict on a learner's function; never raises."""
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            verdicts = [one._verdict(function) for one in (self, *reversed(self._others))]
        known = ("right", *(m.name for m in self.mistakes))
        return min(verdicts, key=lambda v: (v.kind != "right", (v.named or v.kind) not in known))

    @cached_property
    def _others(self) -> list[Exercise]:
        """The exercise as those see it who answer it in another right way.

        The device edits their results only.
        """
        also = partial(replace, self, ways=[], another_way=True)
        return [also(way=way, steps=self.steps | own) for way, own in self.ways]

    def _verdict(self, function: Callable[..., Any]) -> Verdict:
        if not callable(function):
            return self._say("not attempted", f"got a {type(function).__name__}, not a function.")
        runs = [_run(function, args) for args in self.cases]
        if self.core and self._leaves_the_rest(self.core, function, runs):
            return self._core_alone._verdict(function)
        unfinished = self._unfinished(function, runs)
        if unfinished:
            return unfinished
        expected = [np.asarray(self._answer((), args)) for args in self.cases]
        known = {*inspect.signature(self.model()).parameters, *self.seen.split()}
        again = _as_numbers(_run(function, self.cases[0]).value)
        first = _as_numbers(runs[0].value)
        if again is None or first is None or not np.array_equal(again, first, equal_nan=True):
            return self._one(RANDOM, "", self._given(self.cases[0]))
        return self._compare(runs, expected, known | _names_in(getattr(function, "__code__", None)))

    @cached_property
    def _core_alone(self) -> Exercise:
        cases = [args for args in self.cases if self.is_core(args)]
        core = self.core and replace(self.core, beyond=len(self.cases) - len(cases))
        return replace(self, cases=cases, core=None, part_of=core)

    def is_core(self, args: tuple[Any, ...]) -> bool:
        return self.core is None or len(args) <= self.core.arguments

    def _leaves_the_rest(self, core: Core, function: Callable[..., Any], runs: list[Run]) -> bool:
        """Whether every case beyond the core gets nothing, or what it gets without the rest."""
        for run, args in zip(runs, self.cases, strict=True):
            if self.is_core(args) or isinstance(run.error, NotImplementedError):
                continue
            if run.error is not None:
                return False
            if run.value is not None:
                value = _as_numbers(run.value)
                bare = _as_numbers(_run(function, args[: core.arguments]).value)
                if value is None or bare is None or not np.array_equal(value, bare, equal_nan=True):
                    return False
        return True

    def _unfinished(self, function: Callable[..., Any], runs: list[Run]) -> Verdict | None:
        """Not attempted, raised, or something that is not an array of the right shape."""
        if all(r.value is None and r.error is None for r in runs):
            code = getattr(function, "__code__", None)
            if code is None or len(code.co_code) <= len(_nothing.__code__.co_code):
                return self._say("not attempted", "not attempted yet: it returns None.")
            return self._say("wrong", "it returns None: is there a `return`?", FOUND["no_return"])
        for run, args in zip(runs, self.cases, strict=True):
            if isinstance(run.error, NotImplementedError):
                return self._say("not attempted", "not attempted yet.")
            kind, text = "wrong", "it returns None here; is a `return` missing?"
            if run.error is not None:
                hint = " (a power is **)" if " for ^:" in run.said else ""
                kind, text = "raised", f"your function raised {run.said}{hint}"
            elif run.value is not None:
                if _as_numbers(run.value) is not None:
                    continue
                text = f"it returns a {type(run.value).__name__} that is not an array of numbers."
                if isinstance(run.value, tuple | list):
                    text += f" Its parts: {', '.join(map(_form, run.value))}."
            return self._say(kind, text, self._given(args))
        return None

    def _compare(self, runs: list[Run], expected: list[Floats], known: set[str]) -> Verdict:
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
        return self._judged(values, expected, formal, known)

    def _right(self, formal: list[Mistake]) -> Verdict:
        if formal:
            right = f"The numbers are right.{self._later}"
            return self._one(formal[0], right) if len(formal) == 1 else self._several(formal[0])
        count = len(self.cases)
        if core := self.part_of:
            text = f"the core is right: all {count} cases {core.which} agree."
            deeper = f"Deeper: the other {core.beyond} use {core.rest}."
            return self._say("core right", f"{text} {deeper}")
        way = f", {self.way}" if self.way else ""
        within = f"{self.tolerance:g} {self.unit} or a millionth of their size"
        text = f"right{way}. All {count} cases agree to {within}."
        return self._say("right", text)

    def _judged(
        self, values: list[Floats], expected: list[Floats], formal: list[Mistake], known: set[str]
    ) -> Verdict:
        """The verdict on results of the right shape; formal: what else is wrong with them.

        known: the names in the template and in the learner's code; no other one is printed.
        """
        agree = [self._agrees(v, e) for v, e in zip(values, expected, strict=True)]
        if all(agree):
            return self._right(formal)
        core = self.part_of
        cases = f"the {len(agree)} cases {core.which}" if core else f"{len(agree)} cases"
        count = f"{sum(agree)} of {cases} agree.{self._later}"
        relation = self._relation(values, expected)
        if relation == "runs_away":  # show one that does
            both = zip(agree, values, strict=True)
            first = [bool(ok or (np.abs(v) < 1e6).all()) for ok, v in both].index(False)
        else:
            first = agree.index(False)
        evidence = self._evidence(first, values[first], expected[first])
        if formal:
            return self._several(formal[0], count, evidence)
        mistakes = self._found(values, relation in FOUND["told"])
        if len(mistakes) == 1 and FOUND["unseen"] in _in_words(mistakes[0], known).says:
            lines = (m for m in self._edits[1] if FOUND["line"] in m.says)
            clearer = (m for m in lines if self._explains((m,), values))
            mistakes = (next(clearer, mistakes[0]),)
        if self.core and not mistakes:  # what is wrong there may hide behind the rest
            of_core = [i for i, args in enumerate(self.cases) if self.is_core(args)]
            ours, wanted = ([of[i] for i in of_core] for of in (values, expected))
            verdict = self._core_alone._judged(ours, wanted, [], known)
            if verdict.named:
                return verdict
        where = self._parts_off(values, expected)
        if relation and not mistakes:
            mistakes = (_device(relation, "your result", "", replace),)
        mistakes = mistakes or self._turned_too(values, expected)
        if not mistakes and (mistakes := self._by_part(values, expected)):  # show most of them
            off = (np.abs(v - e) > self.tolerance for v, e in zip(values, expected, strict=True))
            first = int(np.argmax([np.count_nonzero(one) for one in off]))
            evidence = self._evidence(first, values[first], expected[first])
        if len({m.name.partition(",")[0] for m in mistakes}) > 1:
            seen = self._seen_in(first, mistakes, expected[first])
            return self._several(_in_words(seen, known), count, evidence)
        if mistakes:
            where = where * mistakes[0].device
            return self._one(_in_words(mistakes[0], known), count + where, evidence)
        where += self._factors_off(values, expected)
        return self._say("wrong", f"not right yet. {count}{where}", evidence, FOUND["by_hand"])

    def _turned_too(self, values: list[Floats], expected: list[Floats]) -> tuple[Mistake, ...]:
        """Two mistakes at once: what can be said of square results once they are transposed."""
        turned = [v.T for v in values]
        square = all(v.shape == e.shape for v, e in zip(turned, expected, strict=True))
        relation = self._relation(turned, expected) if square else None
        if relation is None:
            return ()
        first, then = (
            _device(kind, "your result", "", replace) for kind in ("transposed", relation)
        )
        says = FOUND["both"].format(first=first.says, then=then.says)
        return (replace(then, name=f"transposed and {relation}", says=says),)

    def _part(self, i: int) -> Any:
        """The index of a part of a result: of a column, or of a number."""
        return (..., i) if self.per_row else i

    def _by_part(self, values: list[Floats], expected: list[Floats]) -> tuple[Mistake, ...]:
        """What gives the numbers of each wrong part of the result, where something does."""
        singles = [*self.single_mistakes(), *self._edits[1]]
        found: list[Mistake] = []
        for name, at in self._off(values, expected):
            some = any(v[at].any() for v in values)  # of nothing but 0 only that can be said
            alike = (m for m in singles if some or m.of_result)
            mistake = next((m for m in alike if self._explains((m,), values, at)), None)
            if mistake:
                says = mistake.says if name in mistake.says else f"in {name}: {mistake.says}"
                found.append(replace(mistake, says=says, name=f"{mistake.name}, in {name}"))
        return tuple(found)

    def _off(self, values: list[Floats], expected: list[Floats]) -> list[tuple[str, Any]]:
        """The parts of the result that are not right in all cases, each with its place."""
        both = list(zip(values, expected, strict=True))
        parts = [(name, self._part(i)) for i, name in enumerate(self.parts)]
        return [
            (name, at) for name, at in parts if not all(self._agrees(v[at], e[at]) for v, e in both)
        ]

    def _parts_off(self, values: list[Floats], expected: list[Floats]) -> str:
        """Says which parts of the result are wrong, where others are right."""
        off = [name for name, _ in self._off(values, expected)]
        return f" Look at {_listed(off)}: all else is right." if len(off) < len(self.parts) else ""

    def _factors_off(self, values: list[Floats], expected: list[Floats]) -> str:
        """Says which parts of the result are off by one factor in every case."""
        text = ""
        for name, at in self._off(values, expected):
            got, want = (np.concatenate([np.ravel(v[at]) for v in of]) for of in (values, expected))
            factor = np.vdot(want, got) / np.vdot(want, want)
            if factor and np.allclose(got, factor * want, 1e-5, 1e-9):
                text += f" In every case {name} is {factor:.4g} times what it should be."
        return text

    def _found(self, values: list[Floats], told: bool) -> tuple[Mistake, ...]:
        """The first mistakes that give these values; told: without the device's."""
        for mistakes in self._combinations():
            if not (told and mistakes[-1].device) and self._explains(mistakes, values):
                return mistakes
        return ()

    def _relation(self, values: list[Floats], expected: list[Floats]) -> str | None:
        """What can be said of numbers that no model gives: they run away, or are proportional."""
        both = list(zip(values, expected, strict=True))
        factors = np.array([np.vdot(e, v) / np.vdot(e, e) for v, e in both])
        k = abs(factors[0])
        straight = k > 0 and np.allclose(np.abs(factors), k, 1e-6, 0)
        straight &= all(
            np.allclose(v, f * e, 1e-6, self.tolerance / 10)
            for f, (v, e) in zip(factors, both, strict=True)
        )
        square = expected[0].shape == (3, 3)
        right = [self._agrees(v, e) for v, e in both]
        mirrors = [
            square and np.linalg.det(v) < 0 and self._agrees(v @ v.T, np.eye(3)) for v in values
        ]
        wild = [not (np.abs(v) <= 1e6 * (1 + np.nanmax(np.abs(e)))).all() for v, e in both]
        holes = [bool(np.isnan(v).any()) for v in values]
        same = all(np.array_equal(v, values[0], equal_nan=True) for v in values)
        holds = {
            "digits": all(np.allclose(v, e, 1e-5, 10 * self.tolerance, True) for v, e in both),
            "rows_lost": all(self._right_or_nothing(v, e) for v, e in both)
            and any(np.nan_to_num(v).any() and self._agrees(v, e) for v, e in both),
            "mirrored": any(mirrors) and sum(map(max, right, mirrors)) >= len(both) - 1,
            "sign_of_all": square
            and all(
                ok or abs(np.vdot(e, v) + 1) < 1e-6 for ok, (v, e) in zip(right, both, strict=True)
            ),
            "hole_spreads": 0 < sum(holes) < len(both)
            and holes == list(map(_has_hole, self.cases)),
            "runs_away": all(wild) or (any(wild) and not self.nan_answers),
            "nothing": same and not values[0].any(),
            "constant": same,
            "signs": straight and abs(k - 1) < 1e-6 and len(set(np.sign(factors))) > 1,
            "factor_and_signs": straight and len(set(np.sign(factors))) > 1,
            "factor": straight,
        }
        return next((kind for kind, true in holds.items() if true), None)

    def _right_or_nothing(self, value: Floats, want: Floats) -> bool:
        """Whether each row, or a result without rows, is right or nothing: 0 or NaN."""
        rows = zip(value, want, strict=True) if want.ndim and self.per_row else [(value, want)]
        return all(self._agrees(v, e) or not np.nan_to_num(v).any() for v, e in rows)

    def _seen_in(self, case: int, mistakes: tuple[Mistake, ...], want: Floats) -> Mistake:
        """The first of several mistakes that by itself shows in this case."""
        for mistake in mistakes:
            value = self._answer((mistake,), self.cases[case])
            if value is None or value.shape != want.shape or not self._agrees(value, want):
                return mistake
        return mistakes[0]

    @property
    def _later(self) -> str:
        """Says in a verdict on the core what may wait."""
        return f" ({self.part_of.rest} can wait.)" if self.part_of else ""

    def _one(self, mistake: Mistake, count: str, *lines: str) -> Verdict:
        text = f"{mistake.says}{'.' * (mistake.says[-1] != '?')} {count}".strip()
        return self._say("wrong", text, *lines, mistake.ask, named=mistake.name)

    def _several(self, first: Mistake, *lines: str) -> Verdict:
        text = f"{FOUND['more']}{first.says}{'.' * (first.says[-1] != '?')}"
        return self._say("wrong", text, *lines, first.ask, named=f"several, first {first.name}")

    def _combinations(self) -> Iterator[tuple[Mistake, ...]]:
        """Each mistake alone, and in one part of the result; each pair of different steps, earlier
        step first; the device's edits; a mistake and an edit of the result, or two of those."""
        yield from ((m,) for m in self.single_mistakes())
        of_result, single, double = self._edits
        order = list(self.steps)
        listed = [m for m in self.mistakes if not m.alone]
        for a, b in itertools.combinations(listed, 2):
            if a.step != b.step:
                yield (a, b) if order.index(a.step) < order.index(b.step) else (b, a)
        yield from ((m,) for m in (*single, *double))
        common = [m for m in of_result if m.name in FOUND["common"] and "each of" not in m.says]
        yield from itertools.product(self.mistakes, common)
        for a, b in itertools.combinations(listed, 2):
            if a.name == b.name and a.step != b.step:
                yield from ((a, b, edit) for edit in common)
        yield from itertools.combinations(common, 2)

    def single_mistakes(self) -> list[Mistake]:
        """Those listed, the device's edits of the result, and those in one part of it."""
        return [*self.mistakes, *self._edits[0], *self._partial]

    @cached_property
    def _edits(self) -> tuple[list[Mistake], list[Mistake], list[Mistake]]:
        """The device's: of the result, all else, and pairs within one step's source."""
        return ([], _result_edits(self), []) if self.another_way else _all_edits(self)

    @cached_property
    def _partial(self) -> list[Mistake]:
        """Each mistake in each part of the result alone."""
        parts = range(len(self.parts))
        return [self._in_part(m, i) for m in self.mistakes for i in parts]

    def _in_part(self, mistake: Mistake, i: int) -> Mistake:
        """The mistake in one part of the result only."""
        at, wrong = self._part(i), self.model(mistake)

        def mixed(right: Model) -> Model:
            def model(*args: Any) -> Floats:
                result = np.array(right(*args))
                result[at] = np.asarray(wrong(*args))[at]
                return result

            return model

        says = f"in {self.parts[i]}: {mistake.says}"
        return replace(mistake, says=says, step="", wrong=mixed, of_result=True)

    def _explains(self, mistakes: tuple[Mistake, ...], values: list[Floats], at: Any = ...) -> bool:
        """Whether a wrong model gives exactly these values, or what stands `at` a place in them.

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
            if value.shape != wrong.shape or not self._agrees(value[at], wrong[at]):
                return False
            size = np.nanmax(np.abs(wrong[at]), initial=0)
            off = np.nanmax(np.abs(value[at] - wrong[at]), initial=0)
            if mistakes[-1].device and off > max(1e-3 * size, 1e-12):
                return False  # next to nothing is not nothing
            right = self._answer((), args)
            shown = shown or right is None or not self._agrees(wrong[at], right[at])
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
            model = self.model(*mistakes)
            if mistakes and mistakes[-1].of_result:
                given = self._answer(mistakes[:-1], args)
                model = mistakes[-1].wrong(lambda *_: given)
            own = [np.array(a) if isinstance(a, np.ndarray) else a for a in args]
            try:
                value = _as_numbers(model(*own))
            except Exception:  # an edit of the device may come to nothing
                value = None
            overflows = value is not None and not self.nan_answers and not np.isfinite(value).all()
            self._known[key] = None if overflows else value
        return self._known[key]

    def _agrees(self, value: Floats, want: Floats) -> bool:
        """As np.allclose says with equal_nan, in a third of its time: checks ask this often."""
        off = np.abs(value - want)
        if (off > self.tolerance + 1e-6 * np.abs(want)).any():
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


def in_digits(form: str, values: Any) -> str:
    """Numbers by a format, such as ".3f", or "(.3f)" with brackets around them."""
    digits = form.strip("()")
    return form.replace(digits, ", ".join(f"{v:{digits}}" for v in np.ravel(values)))


def _has_hole(args: tuple[Any, ...]) -> bool:
    return any(a.dtype.kind == "f" and np.isnan(a).any() for a in args if isinstance(a, np.ndarray))


def _nothing() -> None:
    return None


FOUND = questions.lesson_texts("exercises")
IN_PLACE, TRANSPOSED, RANDOM = (Mistake(name, *texts) for name, texts in FOUND["formal"].items())


class Run(NamedTuple):
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


def _names_in(code: Any) -> set[str]:
    """The names in a function's code and in the functions inside it."""
    if not isinstance(code, CodeType):
        return set()
    inside = [_names_in(part) for part in code.co_consts]
    return {*code.co_varnames, *code.co_cellvars, *code.co_names}.union(*inside)


def _in_words(mistake: Mistake, known: set[str]) -> Mistake:
    """The device's words without names that the learner has not seen, and without many."""
    names = set(re.findall(r"`(\w+)`", mistake.says))
    seen = len(names) <= MOST_NAMES and known.issuperset(names)
    if not mistake.device or FOUND["line"] in mistake.says or seen:
        return mistake
    return replace(mistake, says=_NAMED.sub(FOUND["unseen"], mistake.says))


def _form(part: Any) -> str:
    array = _as_numbers(part)
    return f"a {type(part).__name__}" if array is None else _shape(array)


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
Way = tuple[str | int, ...]
EDITS: dict[str, Edit] = {
    kind: eval(f"lambda v: {formula}", {"np": np}) for kind, formula in FOUND["edits"].items()
}
ORDINALS = ("first", "second", "third", "fourth", "fifth", "sixth", "seventh")
NUMERIC = (int, float, np.generic, np.ndarray)
_ONE = r"(the \w+ (part|number|column) of )?(what is made of )?`\w+`"
_NAMED = re.compile(rf"(each of )?{_ONE}((, | and | of ){_ONE})*")
LINES = (ast.Assign, ast.AugAssign, ast.Return, ast.Expr, ast.For, ast.If)
MOST_PARTS = 5  # of more parts no two are edited alike
MOST_NAMES = 3  # of more of them no learner finds the place
MOST_SITES = 55  # of more of them in one step no two are tried together


def _split(exercise: Exercise, result: Any) -> Any:
    """The result of one case: its rows have columns, or it has a few parts."""
    array = np.asarray(result)
    return array if exercise.per_row or not array.ndim else tuple(array)


def _result_edits(exercise: Exercise) -> list[Mistake]:
    found = []
    result = _split(exercise, exercise.model()(*exercise.cases[-1]))
    for kind, where, edit in _edits_of(result, "your result", exercise.parts):

        def wrong(model: Model, edit: Edit = edit) -> Model:
            return lambda *args: edit(_split(exercise, model(*args)))

        found.append(replace(_device(kind, where, "", wrong), of_result=True))
    return found


def _all_edits(exercise: Exercise) -> tuple[list[Mistake], list[Mistake], list[Mistake]]:
    """Single edits of the result, of all else, and pairs within one step's source."""
    args, steps = exercise.cases[-1], exercise.steps
    seen: dict[str, tuple[tuple[Any, ...], Any]] = {}

    def watched(name: str, *values: Any) -> Any:
        seen[name] = values, steps[name](*values)
        return seen[name][1]

    split = partial(_split, exercise)
    result = split(exercise.build({name: partial(watched, name) for name in steps}, *args))
    inputs = [f"`{name}`" for name in inspect.signature(exercise.model()).parameters]
    rewritten = [(name, *edit) for name, step in steps.items() for edit in _rewritten(step)]
    found = [(kind, where, name, new) for name, n, kind, where, new in rewritten if n == 1]
    double = [(kind, where, name, new) for name, n, kind, where, new in rewritten if n == 2]
    whole = [edit for style in exercise.styles for edit in _rewritten(style, whole=True)]
    lines = [(kind, where, "", lambda _, new=new: new) for _, kind, where, new in whole]
    for kind, where, edit in _edits_of(args, _listed(inputs), inputs):
        found.append((kind, where, "", lambda f, e=edit: lambda *a: f(*e(a))))
    for kind, where, by in _factors(args, inputs, result):
        found.append((kind, where, "", lambda f, by=by: lambda *a: by(a, split(f(*a)))))
    for name, (values, given) in seen.items():
        step, own = steps[name], _argument_names(steps[name], len(values))
        for kind, where, edit in _edits_of(values, _listed(own), own, deep=False):
            found.append((kind, where, name, lambda *a, e=edit, f=step: f(*e(a))))
        for kind, where, edit in _edits_of(given, f"what is made of {_listed(own)}", deep=False):
            found.append((kind, where, name, lambda *a, e=edit, f=step: e(f(*a))))
    lines.sort(key=lambda edit: edit[0] in FOUND["wrapped"])
    pairs = [_device(*edit, before=FOUND["more"]) for edit in double]
    return _result_edits(exercise), [_device(*edit) for edit in (*found, *lines)], pairs


def _device(kind: str, where: str, step: str, wrong: Step, before: str = "") -> Mistake:
    says, ask = (" ".join(text.split()) for text in FOUND["kinds"][kind])
    says = before + says.replace("WHERE", where or FOUND["unseen"])
    return Mistake(kind, says, ask, step, wrong, device=True)


def _listed(names: Iterable[str]) -> str:
    *others, last = dict.fromkeys(names) or ["the code"]
    return f"{', '.join(others)} and {last}" if others else last


def _argument_names(step: Step, count: int) -> list[str]:
    code = getattr(step, "__code__", None)
    names = [f"`{name}`" for name in code.co_varnames] if code else []
    return (names + ["an intermediate result"] * count)[:count]


def _edits_of(
    value: Any, whole: str, names: Sequence[str] = (), deep: bool = True
) -> Iterator[tuple[str, str, Edit]]:
    """Edits of all of a value and of its parts: a kind, where it is, and what it does.

    whole: what the value is called; names: its parts, if they have names of their own; not deep:
    only tuples have parts.
    """
    if isinstance(value, NUMERIC):
        yield from ((kind, whole, edit) for kind, edit in EDITS.items())
    parts = _parts(value, whole, names) if deep or isinstance(value, tuple) else []
    for label, i, part in parts:
        for kind, where, edit in _edits_of(part, label, deep=deep):
            yield kind, where, partial(_put, [(i, i)], edit)
    numbers = [part for part in parts if isinstance(part[2], NUMERIC)]
    groups = [g for n in range(2, MOST_PARTS) for g in itertools.combinations(numbers, n)]
    for group in groups if len(numbers) < MOST_PARTS else ():
        where = whole if len(group) == len(parts) else f"each of {_listed(n for n, _, _ in group)}"
        if len({np.shape(part) for _, _, part in group}) == 1:
            for kind, label, edit in _edits_of(group[0][2], where, deep=deep):
                yield kind, label, partial(_put, [(i, i) for _, i, _ in group], edit)
    for turn in (1, 2) if len(numbers) == len(parts) == 3 else ():
        new = [(parts[i][1], parts[i - turn][1]) for i in range(3)]
        yield "exchanged", f"the parts of {whole}", partial(_put, new, lambda v: v)
    for (a, i, x), (b, j, y) in itertools.permutations(numbers, 2):
        if np.shape(x) == np.shape(y):
            yield "copied", _listed((a, b)), partial(_put, [(i, j)], lambda v: v)
            yield "exchanged", _listed((a, b)), partial(_put, [(i, j), (j, i)], lambda v: v)


def _parts(value: Any, whole: str, names: Sequence[str]) -> list[tuple[str, Any, Any]]:
    """What each part is called, its index and itself: of a tuple, of columns, of a pose."""
    indices: list[Any] = []
    array: tuple[int, ...] = value.shape if isinstance(value, np.ndarray) else ()
    kinds: Sequence[str] = [f"{n} column" for n in ORDINALS]
    if isinstance(value, tuple):
        kind = "part" if any(isinstance(v, np.ndarray) and v.ndim for v in value) else "number"
        kinds = [f"{n} {kind}" for n in ORDINALS]
        indices = list(range(len(value)))
    elif array == (4, 4):
        kinds = "translation", "rotation", "last row"
        indices = [(slice(3), 3), (slice(3), slice(3)), 3]
    elif len(array) == 2 and array[1] < min(4, array[0]):
        indices = [(..., i) for i in range(array[1])]
    labels = names or [f"the {kind} of {whole}" for kind in kinds]
    return [(label, i, value[i]) for label, i in zip(labels, indices, strict=False)]


def _put(places: list[tuple[Any, Any]], edit: Edit, value: Any) -> Any:
    """The value with an edit of what stands at the second of each two places at the first."""
    new = list(value) if isinstance(value, tuple) else np.array(value, float)
    for i, j in places:
        new[i] = edit(value[j])
    return tuple(new) if isinstance(value, tuple) else new


def _factors(
    args: tuple[Any, ...], names: list[str], result: Any
) -> Iterator[tuple[str, str, Step]]:
    """Edits by which the result, or parts of it, are multiplied or divided by an input."""
    every = [n for _, n, _ in _parts(result, "", ())] or [...]
    groups = [[n] for n in every] + [every, every[:-1]] * (len(every) > 2)
    for (i, given), group in itertools.product(enumerate(args), groups):
        if isinstance(given, (float, np.ndarray)) and np.ndim(given) < 2:
            for kind, by in (("factor_too_many", np.multiply), ("factor_missing", np.divide)):

                def edit(a: Any, v: Any, i: int = i, by: Any = by, group: Any = group) -> Any:
                    return _put([(n, n) for n in group], lambda x: by(x, a[i]), v)

                yield kind, names[i], edit


@cache
def _rewritten(step: Step, whole: bool = False) -> list[tuple[int, str, str, Step]]:
    """The step with one edit of its source, or the like in several places; then with two.

    Before each stands 1 or 2. A step without a source has none. Of a `whole` function more is
    edited, one at a time, and the line that is edited is shown.
    """
    tree = _source(step)
    if tree is None:
        return []
    space = {**step.__globals__, **inspect.getclosurevars(step).nonlocals}
    names = {n.arg for n in ast.walk(tree) if isinstance(n, ast.arg)}
    names |= {n.id for n in ast.walk(tree) if isinstance(n, ast.Name) and type(n.ctx) is ast.Store}
    sites: list[tuple[int, str, str, dict[int, ast.AST]]] = []
    groups: dict[Any, tuple[str, str, dict[int, ast.AST]]] = {}
    lines = {id(n): line for line in ast.walk(tree) for n in ast.walk(line) if type(line) in LINES}
    for node, around, path in _walk(tree):
        fields = tuple(field for field in path if isinstance(field, str))
        beside = tuple(field for field in path if field not in ("left", "right"))
        more = _wrapped(node) if whole else ()
        for kind, detail, new in itertools.chain(_alternatives(node, names), more):
            where = _named_in(node) or _named_in(around)
            if kind == "function_dropped":
                where = f"`{detail}` of {where}"
            where = detail[1] if kind == "name" else where
            if whole and id(node) in lines:
                line = _rebuilt(lines[id(node)], {id(node): new})
                text = ast.unparse(ast.fix_missing_locations(line)).splitlines()[0]
                where = f"{where or FOUND['value']} {FOUND['line']} `{text}`"
            sites.append((1, kind, where, {id(node): new}))
            for like in ((), fields, beside, where):
                groups.setdefault((kind, detail, like), (kind, where, {}))[2][id(node)] = new
    pools: list[list[Any]] = [sites, [site for site in sites if site[1] == "name"], []]
    pool = [] if whole else next(pool for pool in pools if len(pool) <= MOST_SITES)
    pairs = itertools.combinations(pool, 2)
    several = [(1, *group) for group in groups.values() if len(group[2]) > 1]
    double = [(2, kind, where, a | b) for (_, kind, where, a), (*_, b) in pairs]
    edits = [
        (n, kind, where, _compiled(_rebuilt(tree, swaps), space))
        for n, kind, where, swaps in sites + several + double
    ]
    return [edit for edit in edits if edit[3] is not None]


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


def _walk(holder: ast.AST, path: Way = ()) -> Iterator[tuple[ast.AST, ast.AST, Way]]:
    """Each node, the one that holds it, and the way to it: fields, and places in a list."""
    for name, child in ast.iter_fields(holder):
        for i, part in enumerate(child if isinstance(child, list) else [child]):
            if isinstance(part, ast.AST) and not isinstance(part, ast.arguments):
                way = (*path, name, i) if isinstance(child, list) else (*path, name)
                yield part, holder, way
                yield from _walk(part, way)


def _other_operators(node: Any) -> Iterator[tuple[str, Any, ast.AST]]:
    for kind, old, other in FOUND["operators"]:
        new = getattr(ast, other)()
        if isinstance(node, ast.BinOp) and type(node.op).__name__ == old:
            yield kind, other, ast.BinOp(node.left, new, node.right)
        if isinstance(node, ast.Compare) and type(node.ops[0]).__name__ == old:
            yield kind, other, ast.Compare(node.left, [new], node.comparators)
    if isinstance(node, ast.BinOp):
        left, op, right = node.left, node.op, node.right
        yield "dropped", ast.dump(right), left
        yield "dropped", ast.dump(left), right
        yield "turned_round", type(op), ast.BinOp(right, op, left)
        if isinstance(op, ast.Mult):
            yield "divided", "turned", ast.BinOp(right, ast.Div(), left)
        if isinstance(left, ast.BinOp) and _rank(left.op) < _rank(op):  # (a + b) * c
            yield "bracket", 0, ast.BinOp(left.left, left.op, ast.BinOp(left.right, op, right))
            yield "bracket", 1, ast.BinOp(ast.BinOp(left.left, op, right), left.op, left.right)
        if isinstance(right, ast.BinOp) and _rank(right.op) < _rank(op) + isinstance(op, ast.Div):
            yield "bracket", 0, ast.BinOp(ast.BinOp(left, op, right.left), right.op, right.right)
        if isinstance(right, ast.BinOp) and _rank(right.op) > _rank(op):  # a * b**c
            yield "bracket", 2, ast.BinOp(ast.BinOp(left, op, right.left), right.op, right.right)


def _alternatives(node: Any, names: set[str]) -> Iterator[tuple[str, Any, ast.AST]]:
    """What may stand in a node's place: the kind of edit, what tells it from others, the node."""
    yield from _other_operators(node)
    match node:
        case ast.Constant(int() | float() as value) if not isinstance(value, bool):
            for number in (value + 1, value - 1, -value, 2 * value, 1 / (value or 1)):
                yield "number", (value, number), ast.Constant(number)
        case ast.Name(name, ast.Load()) if name in names:
            for other in sorted(names - {name}):
                yield "name", (name, f"`{other}`"), ast.Name(other, ast.Load())
        case ast.Call(function, [first, *_] as arguments, keywords):
            *module, name = ast.unparse(function).split(".")
            yield "function_dropped", name, first
            for other in (n for f in FOUND["functions"] if name in f for n in f if n != name):
                new = ast.parse(".".join((*module, other)), mode="eval").body
                yield "function", (name, other), ast.Call(new, arguments, keywords)
        case ast.Attribute(value, "T"):
            yield "transpose_missing", 0, value
        case ast.UnaryOp(_, operand):
            yield "sign_missing", 0, operand


def _wrapped(node: Any) -> Iterator[tuple[str, Any, ast.AST]]:
    """A value with a function too many, several in another order, a call without an argument."""
    match node:
        case ast.BinOp() | ast.Call() | ast.Name(_, ast.Load()) | ast.Subscript(_, _, ast.Load()):
            for kind in FOUND["wrapped"]:
                form = ast.parse(FOUND["edits"][kind], mode="eval").body
                here = {
                    id(n): node for n in ast.walk(form) if isinstance(n, ast.Name) and n.id == "v"
                }
                yield kind, 0, _rebuilt(form, here)
        case ast.AugAssign(target, _, value):
            yield "kept_only_last", 0, ast.Assign([target], value)
    match node:
        case ast.Call(function, arguments, [*keywords]) if keywords:
            for keyword in keywords:
                rest = [k for k in keywords if k is not keyword]
                yield "argument_missing", keyword.arg, ast.Call(function, arguments, rest)
        case ast.Tuple([_, _, *rest] as parts, context) if len(rest) < MOST_NAMES - 1:
            for order in list(itertools.permutations(parts))[1:]:
                yield "exchanged", 0, ast.Tuple(list(order), context)
        case ast.Call(function, [ast.BinOp(left, op, right)], []):  # f(a * b): f(a) * b
            yield "bracket", 0, ast.BinOp(ast.Call(function, [left], []), op, right)
            yield "bracket", 0, ast.BinOp(left, op, ast.Call(function, [right], []))
        case ast.BinOp(
            left, op, ast.Call(function, [ast.BinOp(a, ast.Mult() | ast.Div() as by, b)], [])
        ):
            yield "bracket", 0, ast.BinOp(ast.BinOp(left, op, ast.Call(function, [a], [])), by, b)
        case ast.Call(function, [first, second, *rest], keywords):
            yield "exchanged", 0, ast.Call(function, [second, first, *rest], keywords)


def _rank(op: ast.operator) -> int:
    return 0 if isinstance(op, (ast.Add, ast.Sub)) else 1 + isinstance(op, ast.Pow)


def _named_in(*nodes: ast.AST) -> str:
    """The first three names of quantities in some source, none for a number."""
    inside = [n for node in nodes for n in ast.walk(node)]
    called = {id(n.func) for n in inside if isinstance(n, ast.Call)}
    names = [n.id for n in inside if isinstance(n, ast.Name) and id(n) not in called]
    found = list(dict.fromkeys(f"`{name}`" for name in names if name not in ("np", "math")))
    return _listed(found[:3]) if found else ""


def _rebuilt(node: Any, swaps: Mapping[int, ast.AST]) -> Any:
    """A copy of a syntax tree in which some nodes are others."""
    if id(node) in swaps:
        return swaps[id(node)]
    if isinstance(node, list):
        return [_rebuilt(part, swaps) for part in node]
    if not isinstance(node, ast.AST):
        return node
    return type(node)(**{name: _rebuilt(part, swaps) for name, part in ast.iter_fields(node)})


def _compiled(tree: Any, space: dict[str, Any]) -> Any:
    """The function that a lambda or a definition makes; None for an edit that is no Python."""
    own: dict[str, Any] = {}
    if isinstance(tree, ast.Lambda):
        tree = ast.Assign([ast.Name("step", ast.Store())], tree)
    module = ast.fix_missing_locations(ast.Module([tree], []))
    try:
        exec(compile(module, "<edit>", "exec"), space, own)
    except SyntaxError:
        return None
    return next(iter(own.values()))
