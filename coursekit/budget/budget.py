"""The error budget: every error at the object, in millimetres, bias and noise apart.

A term has k components (two pixels, three angles, one depth). `matrix` says where one unit of each
moves the object in the base: dp = M n, M (3, k). What is known of the components differs by kind:

- noise: each component has standard deviation `high`, independent of the others; it averages down
  and adds in quadrature.
- bias: the components are m n, with a length m between `low` and `high` and an unknown direction n
  (an unknown sign where k = 1); it repeats, so averaging does nothing to it.

How biases add is a question of what is asked:

- worst case: how far off can it be, if every bias has its largest size and all point one way?
- quadrature: how far off is it typically, if their directions have nothing to do with each other?
- Monte Carlo: how often is it off by more than a tolerance, if sizes and directions are drawn?

First the terms, then their table and its sums, then two tables side by side.
"""

from __future__ import annotations

import html
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
from coursekit.words import html_list, html_table, wrapped

Along = Literal["image", "ray", "scale", "disparity", "turn", "shift", "intrinsics"]
Directions = Literal["own", "isotropic"]
MOST_ALIKE = 0.9999  # two frames; beyond it an autocorrelation says nothing more
SIGMAS = 2.0  # a bias known by its standard deviation is taken to reach so many of them
QUESTIONS = {
    "worst case": "how far off can it be, if all point one way?",
    "quadrature": "how far off is it, if the directions are unrelated?",
}


# --- a term ---


def _ray(view: View) -> Floats:
    return (view.R_base_camera @ view.ray)[:, None]


def _across(view: View) -> Floats:
    return view.R_base_camera @ view.by_pixel


def _turn(view: View) -> Floats:
    return -cross_matrix(view.lever_base)


def _by_K(view: View) -> Floats:
    return view.R_base_camera @ view.by_parameter


def _disparity(view: View) -> Floats:
    return float(depth_slope(view.distance_m, view.intrinsics.fx, view.baseline_m)) * _ray(view)


@dataclass(frozen=True)
class _Conversion:
    """How a kind of term reaches the object: unit and factor of its magnitude for people, in
    words, and M (3, k) from a view."""

    shown: tuple[str, float]
    words: str
    matrix: Callable[[View], Floats]


_CONVERSIONS: dict[str, _Conversion] = {
    "image": _Conversion(("px", 1.0), "times Z/f, across the view", _across),
    "ray": _Conversion(("mm", 1e3), "along the ray, leaks sideways by tan", _ray),
    "scale": _Conversion(("%", 1e2), "times Z along the ray", lambda v: v.distance_m * _ray(v)),
    "disparity": _Conversion(("px", 1.0), "times Z²/(f B), along the ray", _disparity),
    "turn": _Conversion(("deg", math.degrees(1.0)), "times the lever arm, across it", _turn),
    "shift": _Conversion(("mm", 1e3), "direct", lambda _: np.eye(3)),
    "intrinsics": _Conversion(("σ", 1.0), "through the derivatives by K and lens", _by_K),
}


@dataclass(frozen=True)
class ErrorTerm:
    """One row of a budget.

    kind: "bias" or "noise". low, high: the range of its magnitude, in the unit of `along` (px, m,
    rad, or 1 for "scale" and "intrinsics"); a noise has one standard deviation, low = high.
    along: "image" (px of the detection), "ray" (m of depth), "scale" (relative depth), "disparity"
    (px), "turn" (rad of the camera about its own centre), "shift" (m, any direction), "intrinsics"
    (in sigmas; needs a `factor` of nine rows: fx, fy, cx, cy, k1, k2, p1, p2, k3). source: whose
    number this is.
    normal: a bias known by its standard deviation, high / 2 for each component.
    factor (k, k'): a square root of the components' covariance; the magnitude then counts sigmas.
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
        rooted = self.along != "intrinsics" or self.factor is not None
        want(rooted, "factor", self.factor, "a square root of the covariance of K")

    @property
    def conversion(self) -> str:
        """In words, how the magnitude reaches the object."""
        return _CONVERSIONS[self.along].words

    @property
    def magnitude(self) -> str:
        """The range of the magnitude for people, such as "2 to 5 mm"."""
        unit, factor = _CONVERSIONS[self.along].shown
        low, high = (f"{factor * value:.2g}" for value in (self.low, self.high))
        repeats = f", {factor * self.floor:.2g} repeats" if self.floor else ""
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

    def at_object_m(self, view: View) -> Interval:
        """(low, high) of the length of the displacement at the object, m.

        From the least magnitude in the direction that moves the object least, to the greatest in
        the one that moves it most: a turn about the line of sight moves it not at all. For noise
        both are the standard deviation in a single frame, what repeats included, along the
        direction in which it is largest.
        """
        gains = np.linalg.svd(self.matrix(view), compute_uv=False)
        low, high = self.range
        if self.kind == "noise":
            single = math.hypot(high, self.floor) * float(gains[0])
            return single, single
        return low * float(gains[-1]), high * float(gains[0])

    def scaled(self, factor: float) -> ErrorTerm:
        """The same row with `factor` times the magnitude."""
        checks.number("factor", factor, "0 or more", least=0.0)
        stated = self.stated_m and (factor * self.stated_m[0], factor * self.stated_m[1])
        low, high, floor = (factor * value for value in (self.low, self.high, self.floor))
        return replace(self, low=low, high=high, stated_m=stated, floor=floor)


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
        object.__setattr__(self, "terms", tuple(self.terms))
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
                raise ValueError(
                    f"{next(iter(changes))}: {stated[0]!r} is stated at the object and knows no "
                    "other place; take a budget whose rows are converted"
                )
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
            along = term.range[1] * np.linalg.norm(axes @ matrix, axis=1)
            found.append(Row(term, *term.at_object_m(self.view), tuple(along.tolist())))
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
        lows, highs = self._bias_lengths
        return sum(lows), sum(highs)

    @property
    def quadrature_m(self) -> Interval:
        """(low, high) of the biases if their directions are unrelated."""
        lows, highs = self._bias_lengths
        return math.hypot(*lows), math.hypot(*highs)

    def along(self, axis: str) -> AxisBudget:
        """Along "closing", "approach" or "lateral": each term with its greatest effect there."""
        i = axis_index(axis)
        direction = self.grasp.directions[i]
        lows, highs = [], []
        for term, matrix in self._of("bias"):
            gain = float(np.linalg.norm(direction @ matrix))
            lows.append(term.range[0] * gain)
            highs.append(term.range[1] * gain)
        noise = float(np.sqrt(direction @ self.noise_covariance @ direction))
        worst, quadrature = (sum(lows), sum(highs)), (math.hypot(*lows), math.hypot(*highs))
        return AxisBudget(axis, self.grasp.tolerance_m[i], noise, worst, quadrature)

    # how often

    def draw(
        self,
        n: int = 1_000_000,
        seed: int = 0,
        directions: Directions = "own",
        noise: bool = False,
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
        elif term.normal:
            drawn *= high / SIGMAS
        else:
            drawn *= rng.uniform(low, high, n) / np.linalg.norm(drawn, axis=0)
        return np.asarray(matrix @ drawn) if own else drawn

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
    def _bias_lengths(self) -> tuple[list[float], list[float]]:
        ranges = [term.at_object_m(self.view) for term, _ in self._of("bias")]
        return [low for low, _ in ranges], [high for _, high in ranges]

    # for people

    def table(self) -> tuple[Sequence[str], list[Sequence[str]]]:
        """Heading and one line of text a term."""
        head = ("error", "kind", "magnitude", "conversion", "at the object", "whose number")
        lines: list[Sequence[str]] = []
        for row in self.rows:
            term, at = row.term, span(row.low_m, row.high_m)
            lines.append((term.name, term.kind, term.magnitude, term.conversion, at, term.source))
        return head, lines

    def summary(self) -> list[str]:
        """The sums, a line each, with the question each answers."""
        averaged = f", {self.frames} frames" if self.frames > 1 else ""
        text = [f"noise in quadrature{averaged}: {1e3 * self.noise_m:.2f} mm (one sigma)"]
        sums = {"worst case": self.worst_case_m, "quadrature": self.quadrature_m}
        for name, ends in sums.items():
            text.append(f"bias, {name}: {span(*ends)} ({QUESTIONS[name]})")
        if all(term.stated_m is not None for term in self.terms):
            return text  # lengths alone know no direction
        for axis in AXES:
            a = self.along(axis)
            text.append(
                f"{axis}: bias up to {1e3 * a.worst_case_m[1]:.1f} mm, in quadrature "
                f"{1e3 * a.quadrature_m[1]:.1f}, noise {1e3 * a.noise_m:.2f}; "
                f"tolerance ±{1e3 * a.tolerance_m:.1f}"
            )
        return text

    def _heading(self) -> str:
        view = self.view
        return (
            f"{self.title}: Z = {view.distance_m:.2f} m, {view.off_axis_deg:.0f}° off axis, "
            f"f = {view.intrinsics.fx:.0f} px, baseline {1e3 * view.baseline_m:.0f} mm"
        )

    def __repr__(self) -> str:
        head, *lines = ([*cells[:3], cells[4]] for cells in (self.table()[0], *self.table()[1]))
        return "\n".join([self._heading(), words.table(head, lines), *self.summary()])

    def _repr_html_(self) -> str:
        heading = html.escape(self._heading())
        return f"<p><b>{heading}</b></p>{html_table(*self.table())}{html_list(self.summary())}"


def axis_index(axis: str) -> int:
    """Of "closing", "approach", "lateral"; ValueError for any other name."""
    return AXES.index(checks.choice("axis", axis, AXES))


def span(low_m: float, high_m: float, digits: int = 1) -> str:
    """A range of lengths for people, such as "2.0 to 6.0 mm"."""
    low, high = f"{1e3 * low_m:.{digits}f}", f"{1e3 * high_m:.{digits}f}"
    return f"{high} mm" if low == high else f"{low} to {high} mm"


# --- two tables side by side ---


@dataclass(frozen=True, eq=False, repr=False)
class Beside:
    """The lesson's budget, or any other, beside the student's own."""

    theirs: ErrorBudget
    yours: ErrorBudget

    def lines(self) -> list[tuple[str, ...]]:
        """Name, kind, theirs and yours of every row, in their order; then the sums."""
        budgets = (self.theirs, self.yours)
        tables = [{row.term.name: row for row in budget.rows} for budget in budgets]
        lines: list[tuple[str, ...]] = []
        for name in dict.fromkeys(name for table in tables for name in table):
            rows = [table.get(name) for table in tables]
            kind = next(row.term.kind for row in rows if row)
            lines.append((name, kind, *(_cell(row) for row in rows)))
        closing = [budget.along("closing").worst_case_m for budget in budgets]
        return [
            *lines,
            ("sum, quadrature", "noise", *(span(b.noise_m, b.noise_m, 2) for b in budgets)),
            ("sum, quadrature", "bias", *(span(*b.quadrature_m) for b in budgets)),
            ("sum, worst case", "bias", *(span(*b.worst_case_m) for b in budgets)),
            ("worst along closing", "bias", *(span(*ends) for ends in closing)),
        ]

    @property
    def heading(self) -> tuple[str, ...]:
        """Of the columns."""
        return ("error", "kind", self.theirs.title, self.yours.title)

    def sources(self) -> list[str]:
        """Whose numbers your rows use, a line for each source."""
        rows: dict[str, list[str]] = {}
        for term in self.yours.terms:
            rows.setdefault(term.source, []).append(term.name)
        return [
            wrapped(f"  {', '.join(names)}: {source}", 84, indent="    ")
            for source, names in rows.items()
        ]

    def __repr__(self) -> str:
        whose = "Whose numbers the right-hand column uses:"
        return "\n".join([words.table(self.heading, self.lines()), whose, *self.sources()])

    def _repr_html_(self) -> str:
        whose = "<p>Whose numbers the right-hand column uses:</p>"
        return f"{html_table(self.heading, self.lines())}{whose}{html_list(self.sources())}"


def beside(theirs: ErrorBudget, yours: ErrorBudget) -> Beside:
    """Two budgets row by row: the magnitude, and what it makes at the object."""
    return Beside(theirs, yours)


def _cell(row: Row | None) -> str:
    if row is None:
        return "-"
    return f"{row.term.magnitude}: {span(row.low_m, row.high_m)}".replace(" to ", "–")
