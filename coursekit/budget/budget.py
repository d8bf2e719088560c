"""The error budget: every error at the object, in millimetres, bias and noise apart.

A term has k components (two pixels, three angles, one depth). `matrix` says where one unit of each
moves the object in the base: dp = M n, M (3, k). What is known of the components differs by kind:

- noise: each component has standard deviation `high`, independent of the others; it averages down
  and adds in quadrature.
- bias: the components are m n, with a length m between `low` and `high` and an unknown direction n
  (an unknown sign where k = 1), about their `mean` where that was measured; it repeats, so
  averaging does nothing to it.

How biases add is a question of what is asked:

- worst case: how far off can it be, if every bias has its largest size and all point one way?
- quadrature: how far off is it typically, if their directions have nothing to do with each other?
- Monte Carlo: how often is it off by more than a tolerance, if sizes and directions are drawn?

First the terms, then their table and its sums.
"""

from __future__ import annotations

import html
import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, get_args

import numpy as np

from coursekit import checks, words
from coursekit.arrays import Bools, Floats, Interval
from coursekit.budget.view import AXES, GraspAxes, View
from coursekit.checks import want
from coursekit.geometry import cross_matrix
from coursekit.results import ErrorKind
from coursekit.stereo.law import depth_slope
from coursekit.words import html_list, html_table, say, wrapped

Along = Literal["image", "ray", "disparity", "depth", "turn", "shift", "intrinsics"]
Directions = Literal["own", "isotropic"]
MOST_ALIKE = 0.9999  # two frames; beyond it an autocorrelation says nothing more
SIGMAS = 2.0  # a bias known by its standard deviation is taken to reach so many of them


# --- a term ---


def _ray(view: View) -> Floats:
    return (view.R_base_camera @ view.ray)[:, None]


def _turn(view: View) -> Floats:
    return -cross_matrix(view.lever_base)


def _disparity(view: View) -> Floats:
    return float(depth_slope(view.distance_m, view.intrinsics.fx, view.baseline_m)) * _ray(view)


def _depth(view: View) -> Floats:
    return np.hstack([view.distance_m * _ray(view), _disparity(view)])


@dataclass(frozen=True)
class _Conversion:
    """How a kind of term reaches the object: unit and factor of each component for people, in
    words (`per`: mm at the object for one such unit), and M (3, k) from a view."""

    shown: tuple[tuple[str, float], ...]
    words: str
    matrix: Callable[[View], Floats]


PX, MM, DEG = (("px", 1.0),), (("mm", 1e3),), (("deg", math.degrees(1.0)),)
_CONVERSIONS: dict[str, _Conversion] = {
    "image": _Conversion(PX, "Z/f: {per:.2f} mm/px", lambda v: v.R_base_camera @ v.by_pixel),
    "ray": _Conversion(MM, "along the ray", _ray),
    "disparity": _Conversion(PX, "Z²/(fB): {per:.1f} mm/px", _disparity),
    "depth": _Conversion((("%", 1e2), ("px", 1.0)), "sZ - oZ²/(fB)", _depth),
    "turn": _Conversion(DEG, "lever {lever:.2f} m: {per:.1f} mm/deg", _turn),
    "shift": _Conversion(MM, "direct", lambda _: np.eye(3)),
    "intrinsics": _Conversion(
        (("σ", 1.0),), "by K and lens", lambda v: v.R_base_camera @ v.by_parameter
    ),
}
FACTORED = ("depth", "intrinsics")  # their components have different units


@dataclass(frozen=True)
class ErrorTerm:
    """One row of a budget.

    kind: "bias" or "noise". low, high: the range of its magnitude, in the unit of `along` (px, m,
    rad, or sigmas for "depth" and "intrinsics"); a noise has one standard deviation, low = high.
    along: "image" (px of the detection), "ray" (m of depth), "disparity" (px), "depth" (the law
    s Z - o Z²/(f B); needs a `factor` of two rows: s, and o in px), "turn" (rad of the camera about
    its own centre), "shift" (m, any direction), "intrinsics" (needs a `factor` of nine rows: fx,
    fy, cx, cy, k1, k2, p1, p2, k3). source: whose number this is.
    normal: a bias known by its standard deviation, high / 2 for each component.
    factor (k, k'): a square root of the components' covariance; the magnitude then counts sigmas.
    mean (k): what a normal bias was measured to be; the magnitude says how well that is known.
    stated_m: (low, high) at the object as somebody else has converted it; used instead of the
    conversion, with any direction. floor: the part of a noise that repeats, in the same unit.
    Raises ValueError for a kind or direction that is not known, and for a range that is none.

    >>> ErrorTerm("depth bias", "bias", 0.002, 0.005, "ray", "the lesson").magnitude
    '2 to 5 mm'
    """

    name: str
    kind: ErrorKind
    low: float
    high: float
    along: Along
    source: str
    normal: bool = False
    factor: tuple[tuple[float, ...], ...] | None = None
    mean: tuple[float, ...] | None = None
    stated_m: Interval | None = None
    floor: float = 0.0

    def __post_init__(self) -> None:
        checks.choice("kind", self.kind, get_args(ErrorKind))
        checks.choice("along", self.along, get_args(Along))
        for name, pair in (("low, high", (self.low, self.high)), ("stated_m", self.stated_m)):
            ordered = pair is None or 0 <= pair[0] <= pair[1] < math.inf
            want(ordered, name, pair, "0 <= low <= high, finite")
        one_sigma = self.kind == "bias" or self.low == self.high
        want(one_sigma, "low", self.low, f"one standard deviation, {self.high}")
        most = math.inf if self.kind == "noise" else 0.0
        checks.number("floor", self.floor, "0 or more, and 0 for a bias", least=0.0, most=most)
        rooted = self.along not in FACTORED or self.factor is not None
        want(rooted, "factor", self.factor, "a square root of the components' covariance")
        want(self.mean is None or self.normal, "mean", self.mean, "None, or normal=True")

    def conversion(self, view: View) -> str:
        """In words, how the magnitude reaches the object, such as "Z/f: 1.01 mm/px"."""
        how = _CONVERSIONS[self.along]
        per = 1e3 / how.shown[0][1] * float(np.linalg.norm(how.matrix(view), 2))
        return how.words.format(per=per, lever=np.linalg.norm(view.lever_base))

    @property
    def magnitude(self) -> str:
        """The range of the magnitude for people, such as "2 to 5 mm"; the mean where there is one.

        A factor's magnitude counts sigmas.
        """
        shown = _CONVERSIONS[self.along].shown
        if self.mean is not None:
            pairs = zip(itertools.cycle(shown), self.mean, strict=False)
            return ", ".join(f"{factor * value:+z.2g} {unit}" for (unit, factor), value in pairs)
        unit, factor = ("σ", 1.0) if self.factor else shown[0]
        low, high = (f"{factor * value:.2g}" for value in (self.low, self.high))
        repeats = f", {factor * self.floor:.2g} stays" if self.floor else ""
        return f"{high} {unit}{repeats}" if low == high else f"{low} to {high} {unit}"

    @property
    def range(self) -> Interval:
        """(low, high) in the unit of the components of `matrix`."""
        return self.stated_m or (self.low, self.high)

    def matrix(self, view: View) -> Floats:
        """M (3, k): where one unit of each component moves the object, base axes, m a unit."""
        if self.stated_m is not None:
            return np.eye(3)
        matrix = _CONVERSIONS[self.along].matrix(view)
        if self.factor is None:
            return matrix
        return np.asarray(matrix @ checks.array("factor", self.factor, (matrix.shape[1], None)))

    def middle_m(self, view: View) -> Floats:
        """Where the mean moves the object, base axes, (3,), m; zero where there is none."""
        if self.mean is None:
            return np.zeros(3)
        matrix = _CONVERSIONS[self.along].matrix(view)
        return np.asarray(matrix @ checks.array("mean", self.mean, (matrix.shape[1],)))

    def ends_m(self, view: View, matrix: Floats, direction: Floats) -> Interval:
        """(low, high) of a term's part along a direction (3,), each with its greatest effect there.

        matrix: that of this view, known already. For noise both are a single frame's, what repeats
        included.
        """
        gain, middle = float(np.linalg.norm(direction @ matrix)), direction @ self.middle_m(view)
        (low, high), off = self.range, abs(float(middle))
        if self.kind == "noise":
            low = high = math.hypot(high, self.floor)
        return max(low * gain, off - high * gain), off + high * gain

    def at_object_m(self, view: View) -> Interval:
        """(low, high) of the length of the displacement at the object, m.

        From the least magnitude in the direction that moves the object least, to the greatest in
        the one that moves it most: a turn about the line of sight moves it not at all. For noise
        both are the standard deviation in a single frame, what repeats included, along the
        direction in which it is largest.
        """
        gains = np.linalg.svd(self.matrix(view), compute_uv=False)
        (low, high), middle = self.range, float(np.linalg.norm(self.middle_m(view)))
        if self.kind == "noise":
            single = math.hypot(high, self.floor) * float(gains[0])
            return single, single
        most = high * float(gains[0])
        return max(low * float(gains[-1]), middle - most), middle + most

    def scaled(self, factor: float) -> ErrorTerm:
        """The same row with `factor` times the magnitude."""
        checks.number("factor", factor, "0 or more", least=0.0)
        stated = self.stated_m and (factor * self.stated_m[0], factor * self.stated_m[1])
        low, high, floor = (factor * value for value in (self.low, self.high, self.floor))
        mean = self.mean and tuple(factor * value for value in self.mean)
        return replace(self, low=low, high=high, stated_m=stated, floor=floor, mean=mean)


def independent_frames(frames: int, autocorrelation: float = 0.0) -> float:
    """How many independent frames N frames are worth, if noise is correlated as an AR(1) process.

    autocorrelation: of one frame with the next, rho. The variance of the mean of N frames is that
    of one, times [1 + 2 sum_k (1 - k/N) rho^k] / N. Raises ValueError for frames under 1 and rho
    outside (-1, 1). What does not average at all is a term's `floor`.
    """
    checks.whole("frames", frames)
    rho = autocorrelation
    want(-1 < rho < 1, "autocorrelation", rho, "between -1 and 1")
    inflation = (1 + rho) / (1 - rho) - 2 * rho * (1 - rho**frames) / (frames * (1 - rho) ** 2)
    return frames / inflation


def autocorrelation(frames: int, effective: float) -> float:
    """The rho with which N frames are worth `effective` ones: `independent_frames` undone.

    0 where they are worth all N. Raises ValueError for fewer than two frames, and for an effective
    number that is not above 1 and at most N.

    >>> round(autocorrelation(100, 33.7), 2)
    0.5
    """
    from scipy.optimize import brentq

    checks.whole("frames", frames, least=2)
    checks.number("effective", effective, f"above 1 and at most {frames}", above=1, most=frames)
    if effective <= independent_frames(frames, MOST_ALIKE):
        return MOST_ALIKE
    return float(brentq(lambda rho: independent_frames(frames, rho) - effective, 0.0, MOST_ALIKE))


# --- the table and its sums ---


@dataclass(frozen=True)
class Row:
    """A term at the object, of single frames: low and high of its length, m.

    along_m: the most it does along closing, approach and lateral, (3,) m.
    """

    term: ErrorTerm
    low_m: float
    high_m: float
    along_m: tuple[float, float, float]


@dataclass(frozen=True)
class AxisBudget:
    """What adds up along one axis of the grasp, m: one standard deviation of noise, bias ranges."""

    axis: str
    tolerance_m: float
    noise_m: float
    worst_case_m: Interval
    quadrature_m: Interval


@dataclass(frozen=True, eq=False)
class Draws:
    """Displacements drawn from a budget, (n, 3), m, in the base; axes (3, 3): rows of the grasp."""

    displacements_m: Floats
    axes: Floats
    tolerance_m: tuple[float, float, float]

    @property
    def norm_m(self) -> Floats:
        """Their lengths, (n,)."""
        return np.linalg.norm(self.displacements_m, axis=1)

    @property
    def along_m(self) -> Floats:
        """Along closing, approach and lateral, (n, 3)."""
        return np.asarray(self.displacements_m @ self.axes.T)

    @property
    def mean_m(self) -> float:
        """The mean length."""
        return float(self.norm_m.mean())

    def percentile_m(self, percent: float = 95) -> float:
        """The length that so many percent stay below."""
        return float(np.percentile(self.norm_m, percent))

    def share_over(self, tolerance_m: float, axis: str | None = None) -> float:
        """The share that is off by more than this, in length or to either side along an axis."""
        if axis is None:
            return float((self.norm_m > tolerance_m).mean())
        return float((np.abs(self.along_m[:, axis_index(axis)]) > tolerance_m).mean())

    def within(self) -> Bools:
        """Which stay within the tolerance along each axis, (n, 3)."""
        return np.abs(self.along_m) <= np.array(self.tolerance_m)

    def success(self) -> float:
        """The share that stays within the tolerance along all three axes."""
        return float(self.within().all(axis=1).mean())


@dataclass(frozen=True, eq=False)
class ErrorBudget:
    """Error terms seen from one place, and a grasp with its tolerances.

    frames: how many frames are averaged; autocorrelation: of one frame's noise with the next's.
    title: of the table. Raises ValueError for no terms or two of one name, and for frames or
    autocorrelation as `independent_frames` does.
    """

    terms: tuple[ErrorTerm, ...]
    view: View
    grasp: GraspAxes = field(default_factory=GraspAxes)
    frames: int = 1
    autocorrelation: float = 0.0
    title: str = "Error budget"

    def __post_init__(self) -> None:
        checks.settle(self, terms=tuple(self.terms))
        want(self.terms, "terms", self.terms, "at least one")
        different = len(set(self.names)) == len(self.names)
        want(different, "terms", self.names, "different names")
        independent_frames(self.frames, self.autocorrelation)  # says what is wrong with them
        _ = self._matrices  # says so now if a factor does not fit

    # the same budget otherwise

    def at(self, **changes: Any) -> ErrorBudget:
        """The budget from another place or with more frames: distance_m, u, v, off_axis_deg,
        baseline_m, intrinsics and T_base_camera of the view; grasp, frames, autocorrelation, title.

        Raises ValueError where the view changes and a row holds only where it was stated.
        """
        own = {k: changes.pop(k) for k in tuple(changes) if k in self.__dataclass_fields__}
        if changes:
            stated = [term.name for term in self.terms if term.stated_m is not None]
            if stated:
                raise ValueError(say("budget.elsewhere", what=next(iter(changes)), row=stated[0]))
            own["view"] = self.view.moved(**changes)
        return replace(self, **own)

    def with_term(self, term: ErrorTerm) -> ErrorBudget:
        """The budget with this term in the place of the one of the same name, or added."""
        named = {known.name: known for known in self.terms} | {term.name: term}
        return replace(self, terms=tuple(named.values()))

    def scaled(self, name: str, factor: float) -> ErrorBudget:
        """The budget with one term's magnitude times `factor`."""
        return self.with_term(self[name].scaled(factor))

    @property
    def names(self) -> tuple[str, ...]:
        """Of the terms, in order."""
        return tuple(term.name for term in self.terms)

    def __getitem__(self, name: str) -> ErrorTerm:
        return self.terms[self.names.index(checks.choice("name", name, self.names))]

    # what adds up

    @property
    def rows(self) -> tuple[Row, ...]:
        """Each term at the object, of single frames."""
        axes, found = self.grasp.directions, []
        for term, matrix in zip(self.terms, self._matrices, strict=True):
            closing, approach, lateral = (term.ends_m(self.view, matrix, a)[1] for a in axes)
            ends = term.at_object_m(self.view)
            found.append(Row(term, *ends, (closing, approach, lateral)))
        return tuple(found)

    @property
    def noise_m(self) -> float:
        """One standard deviation: the noise rows in quadrature, after averaging.

        Each row along the direction in which it is largest, as tables do; `noise_covariance` says
        what is true of all three directions.
        """
        return math.hypot(*self.averaged_m.values())

    @property
    def averaged_m(self) -> dict[str, float]:
        """Each noise row by name after averaging: its sigma where it is largest, m."""
        return {
            term.name: self._sigma(term) * float(np.linalg.norm(matrix, 2))
            for term, matrix in self._of("noise")
        }

    @property
    def noise_covariance(self) -> Floats:
        """Of the object's position by noise, after averaging, base axes, (3, 3), m²."""
        total = np.zeros((3, 3))
        for term, matrix in self._of("noise"):
            total += self._sigma(term) ** 2 * matrix @ matrix.T
        return total

    @property
    def worst_case_m(self) -> Interval:
        """(low, high) of the biases if all point one way."""
        return _added(self._bias_ends)[0]

    @property
    def quadrature_m(self) -> Interval:
        """(low, high) of the biases if their directions are unrelated."""
        return _added(self._bias_ends)[1]

    def along(self, axis: str) -> AxisBudget:
        """Along "closing", "approach" or "lateral": each term with its greatest effect there."""
        i = axis_index(axis)
        direction = self.grasp.directions[i]
        ends = [term.ends_m(self.view, matrix, direction) for term, matrix in self._of("bias")]
        noise = float(np.sqrt(direction @ self.noise_covariance @ direction))
        return AxisBudget(axis, self.grasp.tolerance_m[i], noise, *_added(ends))

    # how often

    def closing_rows(self) -> dict[str, tuple[float, float, tuple[int, int, int] | None, str]]:
        """The rows as the exercise `add_up` takes them: low and high, mm, toward, kind, by name.

        What a calibration found counts with its sigma along closing, any other row lies any way.
        """
        rows = {}
        for row in self.rows:
            sigma, ends = 500 * row.along_m[0], (1000 * row.low_m, 1000 * row.high_m)
            known = (sigma, sigma, (1, 0, 0)) if row.term.normal else (*ends, None)
            rows[row.term.name] = (*known, row.term.kind)
        return rows

    def draw(
        self, n: int = 1_000_000, seed: int = 0, directions: Directions = "own", noise: bool = False
    ) -> Draws:
        """n rigs: each bias with a magnitude from its range and a direction, all independent.

        directions: "own", each as its term can point (depth along the ray, a turn across it), or
        "isotropic", each with its length at the object and any direction in space, which is what
        a table of lengths alone says. Magnitudes are uniform in their ranges, or normal where the
        term says so. noise: add it, after averaging, as at one grasp of each rig.
        The same seed draws the same numbers term by term, so a budget with one term changed
        differs by that term only.
        """
        checks.whole("n", n)
        checks.choice("directions", directions, get_args(Directions))
        total = np.zeros((3, n))
        for i, term in enumerate(self.terms):
            if noise or term.kind == "bias":
                total += self._part(i, n, seed, directions)
        return self.as_draws(total)

    def parts(self, n: int, seed: int = 0) -> Iterator[Floats]:
        """What each term, noise included, does in n draws, (3, n) m in the base, in their order.

        `draw` is their sum. A part is proportional to its term's magnitude.
        """
        return (self._part(i, n, seed, "own") for i in range(len(self.terms)))

    def as_draws(self, displacements: Floats) -> Draws:
        """Displacements (3, n), m in the base, with the axes and tolerances of the grasp."""
        return Draws(displacements.T, self.grasp.directions, self.grasp.tolerance_m)

    def _part(self, i: int, n: int, seed: int, directions: Directions) -> Floats:
        """What term i does in n draws, (3, n): noise, or a bias of some length and direction."""
        term, matrix = self.terms[i], self._matrices[i]
        own = directions == "own" or term.kind == "noise"
        rng = np.random.default_rng([seed, i])
        drawn = rng.standard_normal((matrix.shape[1] if own else 3, n))
        low, high = term.range if own else term.at_object_m(self.view)
        if term.kind == "noise":
            drawn *= self._sigma(term)
        elif term.normal and (own or term.mean is None):
            drawn *= high / SIGMAS
        else:
            drawn *= rng.uniform(low, high, n) / np.linalg.norm(drawn, axis=0)
        return np.asarray(matrix @ drawn + term.middle_m(self.view)[:, None]) if own else drawn

    @cached_property
    def _matrices(self) -> tuple[Floats, ...]:
        return tuple(term.matrix(self.view) for term in self.terms)

    def _of(self, kind: str) -> Iterator[tuple[ErrorTerm, Floats]]:
        pairs = zip(self.terms, self._matrices, strict=True)
        return ((term, matrix) for term, matrix in pairs if term.kind == kind)

    def _sigma(self, term: ErrorTerm) -> float:
        """Of a noise after averaging; its floor stays."""
        effective = independent_frames(self.frames, self.autocorrelation)
        return math.hypot(term.range[1] / math.sqrt(effective), term.floor)

    @property
    def _bias_ends(self) -> list[Interval]:
        return [term.at_object_m(self.view) for term, _ in self._of("bias")]

    # for people

    def table(self) -> tuple[Sequence[str], list[Sequence[str]]]:
        """Heading and one line of text a term; along closing: the most that it does there."""
        head = ("error", "kind", "magnitude", "conversion", "at the object", "closing")
        lines: list[Sequence[str]] = []
        for row in self.rows:
            term, at = row.term, span(row.low_m, row.high_m)
            closing = "" if self._stated else f"{1e3 * row.along_m[0]:.1f} mm"
            what = term.name, term.kind, term.magnitude, term.conversion(self.view)
            lines.append((*what, at, closing))
        return (head[:-1], [line[:-1] for line in lines]) if self._stated else (head, lines)

    def sources(self) -> list[str]:
        """Whose numbers the rows are, a line for each source; none where all are from one."""
        rows: dict[str, list[str]] = {}
        for term in self.terms:
            rows.setdefault(term.source, []).append(term.name)
        lines = [f"from {source}: {', '.join(names)}" for source, names in rows.items()]
        return lines if len(lines) > 1 else []

    def summary(self) -> list[str]:
        """The sums, a line each, with the question each answers."""
        averaged = f", {self.frames} frames" if self.frames > 1 else ""
        text = [say("budget.noise", averaged=averaged, mm=1e3 * self.noise_m)]
        text.append(say("budget.worst_case", ends=span(*self.worst_case_m)))
        text.append(say("budget.quadrature", ends=span(*self.quadrature_m)))
        if self._stated:
            return text
        for axis in AXES:
            a = self.along(axis)
            lengths = a.worst_case_m[1], a.quadrature_m[1], a.noise_m, a.tolerance_m
            names = ("worst", "quadrature", "noise", "tolerance")
            mm = {name: 1e3 * length for name, length in zip(names, lengths, strict=True)}
            text.append(say("budget.axis", axis=axis, **mm))
        return text

    def _heading(self) -> str:
        baseline_mm = 1e3 * self.view.baseline_m
        return say("budget.heading", title=self.title, view=self.view, baseline_mm=baseline_mm)

    @property
    def _stated(self) -> bool:
        """Whether all rows are stated at the object: lengths alone, which know no direction."""
        return all(term.stated_m is not None for term in self.terms)

    def __repr__(self) -> str:
        whose = (wrapped(line, 84) for line in self.sources())
        table = words.table(*self.table())
        return "\n".join([self._heading(), table, *self.summary(), *whose])

    def _repr_html_(self) -> str:
        heading, sums = html.escape(self._heading()), [*self.summary(), *self.sources()]
        return f"<p><b>{heading}</b></p>{html_table(*self.table())}{html_list(sums)}"


def _added(ends: list[Interval]) -> tuple[Interval, Interval]:
    """(low, high) of lengths that have such ends: all in one direction, and in quadrature."""
    lows, highs = [low for low, _ in ends], [high for _, high in ends]
    return (sum(lows), sum(highs)), (math.hypot(*lows), math.hypot(*highs))


def axis_index(axis: str) -> int:
    """Of "closing", "approach", "lateral"; ValueError for any other name."""
    return AXES.index(checks.choice("axis", axis, AXES))


def span(low_m: float, high_m: float, digits: int = 1) -> str:
    """A range of lengths for people, such as "2.0 to 6.0 mm"."""
    low, high = f"{1e3 * low_m:.{digits}f}", f"{1e3 * high_m:.{digits}f}"
    return f"{high} mm" if low == high else f"{low} to {high} mm"
