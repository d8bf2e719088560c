"""The rows of an error budget: what is wrong, by how much, and what that does at the object.

A term has k components (two pixels, three angles, one depth). `matrix` says where one unit of each
moves the object in the base: dp = M n, M (3, k). What is known of the components differs by kind:

- noise: each component has standard deviation `high`, independent of the others; it averages down.
- bias: the components are m n, with a length m between `low` and `high` and an unknown direction n
  (an unknown sign where k = 1); it repeats, so averaging does nothing to it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from coursekit.results import Kind
from coursekit.stereo.law import depth_slope

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.budget.view import View

    Floats = NDArray[np.float64]

Along = Literal["image", "ray", "scale", "disparity", "turn", "shift", "intrinsics"]
MOST_ALIKE = 0.9999  # two frames; beyond it an autocorrelation says nothing more
SIGMAS = 2.0  # a bias known by its standard deviation is taken to reach so many of them


def skew(vector: Floats) -> Floats:
    """The (3, 3) matrix of a cross product: skew(a) @ b = a x b."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def _image(view: View) -> Floats:
    from coursekit.budget.propagate import pixel_jacobian

    return view.R_base_camera @ pixel_jacobian(view)


def _ray(view: View) -> Floats:
    return (view.R_base_camera @ view.ray)[:, None]


def _disparity(view: View) -> Floats:
    slope = depth_slope(view.distance_m, view.intrinsics.fx, view.baseline_m)
    return float(slope) * _ray(view)


def _intrinsics(view: View) -> Floats:
    from coursekit.budget.propagate import intrinsics_jacobian

    return view.R_base_camera @ intrinsics_jacobian(view)


@dataclass(frozen=True)
class _Conversion:
    """How a kind of term reaches the object: unit of its magnitude, in words, and M (3, k)."""

    unit: str
    shown: tuple[str, float]  # unit and factor for people
    words: str
    matrix: Callable[[View], Floats]


_CONVERSIONS: dict[str, _Conversion] = {
    "image": _Conversion("px", ("px", 1.0), "times Z/f, across the view", _image),
    "ray": _Conversion("m", ("mm", 1e3), "along the ray, leaks sideways by tan", _ray),
    "scale": _Conversion(
        "1", ("%", 1e2), "times Z along the ray", lambda view: view.distance_m * _ray(view)
    ),
    "disparity": _Conversion("px", ("px", 1.0), "times Z²/(f B), along the ray", _disparity),
    "turn": _Conversion(
        "rad",
        ("deg", math.degrees(1.0)),
        "times the lever arm, across it",
        lambda view: -skew(view.lever_base),
    ),
    "shift": _Conversion("m", ("mm", 1e3), "direct", lambda view: np.eye(3)),
    "intrinsics": _Conversion(
        "1", ("σ", 1.0), "through the derivatives by K and lens", _intrinsics
    ),
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
    """

    name: str
    kind: Kind
    low: float
    high: float
    along: Along
    source: str
    normal: bool = False
    factor: tuple[tuple[float, ...], ...] | None = None
    stated_m: tuple[float, float] | None = None
    floor: float = 0.0

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind: got {self.kind!r}, want 'bias' or 'noise'")
        if self.along not in _CONVERSIONS:
            raise ValueError(f"along: got {self.along!r}, want one of {', '.join(_CONVERSIONS)}")
        for name, pair in (("low, high", (self.low, self.high)), ("stated_m", self.stated_m)):
            if pair is not None and not (0 <= pair[0] <= pair[1] < math.inf):
                raise ValueError(f"{name}: got {pair}, want 0 <= low <= high, finite")
        if self.kind == "noise" and self.low != self.high:
            raise ValueError(f"low: got {self.low}, want one standard deviation, {self.high}")
        if not 0 <= self.floor < math.inf or (self.floor and self.kind == "bias"):
            raise ValueError(f"floor: got {self.floor!r}, want 0 or more, and 0 for a bias")
        if self.along == "intrinsics" and self.factor is None:
            raise ValueError("factor: 'intrinsics' wants a square root of the covariance of K")

    @property
    def unit(self) -> str:
        """Of low and high: "px", "m", "rad" or "1"."""
        return _CONVERSIONS[self.along].unit

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
    def range(self) -> tuple[float, float]:
        """(low, high) in the unit of the components of `matrix`."""
        return self.stated_m or (self.low, self.high)

    def matrix(self, view: View) -> Floats:
        """M (3, k): where one unit of each component moves the object, base axes, m a unit."""
        if self.stated_m is not None:
            return np.eye(3)
        matrix = _CONVERSIONS[self.along].matrix(view)
        if self.factor is None:
            return matrix
        factor = np.asarray(self.factor, dtype=np.float64)
        if factor.ndim != 2 or factor.shape[0] != matrix.shape[1]:
            raise ValueError(f"factor: got {factor.shape}, want ({matrix.shape[1]}, any number)")
        return np.asarray(matrix @ factor)

    def at_object_m(self, view: View) -> tuple[float, float]:
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
        from dataclasses import replace

        if not 0 <= factor < math.inf:
            raise ValueError(f"factor: got {factor!r}, want 0 or more")
        stated = self.stated_m and (factor * self.stated_m[0], factor * self.stated_m[1])
        return replace(
            self,
            low=factor * self.low,
            high=factor * self.high,
            stated_m=stated,
            floor=factor * self.floor,
        )


def effective_frames(frames: int, autocorrelation: float = 0.0) -> float:
    """How many independent frames N frames are worth, if noise is correlated as an AR(1) process.

    autocorrelation: of one frame with the next, rho. The variance of the mean of N frames is that
    of one, times [1 + 2 sum_k (1 - k/N) rho^k] / N. Raises ValueError for frames under 1 and rho
    outside (-1, 1). What does not average at all is a term's `floor`.
    """
    if not isinstance(frames, (int, np.integer)) or frames < 1:
        raise ValueError(f"frames: got {frames!r}, want a whole number, 1 or more")
    rho = autocorrelation
    if not -1 < rho < 1:
        raise ValueError(f"autocorrelation: got {rho!r}, want between -1 and 1")
    inflation = (1 + rho) / (1 - rho) - 2 * rho * (1 - rho**frames) / (frames * (1 - rho) ** 2)
    return frames / inflation


def autocorrelation(frames: int, effective: float) -> float:
    """The rho with which N frames are worth `effective` ones: `effective_frames` undone.

    0 where they are worth all N. Raises ValueError for fewer than two frames, and for an effective
    number that is not above 1 and at most N.
    """
    from scipy.optimize import brentq

    if not isinstance(frames, (int, np.integer)) or frames < 2:
        raise ValueError(f"frames: got {frames!r}, want a whole number, 2 or more")
    if not 1 < effective <= frames:
        raise ValueError(f"effective: got {effective!r}, want above 1 and at most {frames}")
    least = effective_frames(frames, MOST_ALIKE)
    if effective <= least:
        return MOST_ALIKE
    return float(brentq(lambda rho: effective_frames(frames, rho) - effective, 0.0, MOST_ALIKE))
