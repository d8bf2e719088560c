"""Does the grasp succeed, what to fix first, and how far away to mount the camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from coursekit.arrays import Floats
from coursekit.budget.budget import ErrorBudget
from coursekit.budget.view import AXES, GraspAxes, positive
from coursekit.results import Kind

DRAWS = 20_000  # of a probability that is redrawn while dragging: a standard error of 0.4 % at most
DISTANCES = 200
LARGEST_M = 1.0  # of a gripper or an object; more was meant in millimetres
FEW_DRAWS = 10  # a gain of so many draws says nothing about which row is first


@dataclass(frozen=True)
class Gripper:
    """Two fingers that open opening_m wide; source: who says so."""

    opening_m: float
    source: str = ""

    def __post_init__(self) -> None:
        _check_length("opening_m", self.opening_m)


@dataclass(frozen=True)
class Target:
    """What is to be grasped: its width between the fingers, m."""

    width_m: float

    def __post_init__(self) -> None:
        _check_length("width_m", self.width_m)


def _check_length(name: str, value: float) -> None:
    if not positive(value):
        raise ValueError(f"{name}: got {value!r}, want a positive length, m")
    if value > LARGEST_M:
        raise ValueError(f"{name}: got {value!r} m; metres are wanted: 60 mm is 0.060")


LESSON_GRIPPER = Gripper(0.040, "the lesson; it is the travel of one finger")
WIDOWX_GRIPPER = Gripper(0.080, "the arm's published model, which opens 80 to 88 mm: the lower end")
CUBE = Target(0.025)


def centring_tolerance_m(gripper: Gripper, target: Target) -> float:
    """How far the object may be from the middle between the fingers, to either side, m.

    (opening - width) / 2. Raises ValueError for an object that does not fit.
    """
    room = (gripper.opening_m - target.width_m) / 2
    if room <= 0:
        raise ValueError(
            f"target: {1e3 * target.width_m:.0f} mm does not fit between fingers that open "
            f"{1e3 * gripper.opening_m:.0f} mm"
        )
    return room


def with_gripper(budget: ErrorBudget, gripper: Gripper, target: Target) -> ErrorBudget:
    """The budget with the tolerance along the closing axis that this gripper leaves."""
    grasp: GraspAxes = budget.grasp
    room = centring_tolerance_m(gripper, target)
    return budget.at(grasp=replace(grasp, tolerance_m=(room, *grasp.tolerance_m[1:])))


@dataclass(frozen=True)
class Success:
    """How often a grasp succeeds.

    probability: of one grasp with a rig drawn from the budget, and its standard error. rigs: the
    share of rigs whose bias alone leaves them within the tolerance: what no number of tries, and
    no averaging, helps the others to. by_axis (3,): of one grasp along closing, approach, lateral.
    """

    probability: float
    error: float
    rigs: float
    by_axis: tuple[float, float, float]

    @property
    def weakest_axis(self) -> str:
        """The axis along which most grasps fail."""
        return AXES[int(np.argmin(self.by_axis))]

    def __repr__(self) -> str:
        axes = ", ".join(f"{a} {100 * p:.1f}" for a, p in zip(AXES, self.by_axis, strict=True))
        return (
            f"{100 * self.probability:.1f} % of grasps succeed ({axes});\n"
            f"    {100 * self.rigs:.1f} % of rigs would be within the tolerance without noise"
        )


def success_probability(budget: ErrorBudget, n: int = DRAWS, seed: int = 0) -> Success:
    """The probability that all three axes stay within their tolerances, by n draws of the rig.

    Each bias has a magnitude from its range and a direction of its own kind, all independent; the
    noise is that after averaging. The object itself is taken as a block that fits or does not: no
    tilt, no finger that pushes it into place.
    """
    parts = budget.parts(n, seed)
    bias, noise = np.zeros((3, n)), np.zeros((3, n))
    for term, part in zip(budget.terms, parts, strict=True):
        total = bias if term.kind == "bias" else noise
        total += part
    biased, tried = budget.as_draws(bias), budget.as_draws(bias + noise)
    within = np.abs(tried.along_m) <= np.array(tried.tolerance_m)
    p = float(within.all(axis=1).mean())
    closing, approach, lateral = within.mean(axis=0).tolist()
    error = math.sqrt(max(p * (1 - p), 0.25 / n) / n)
    return Success(p, error, biased.success(), (closing, approach, lateral))


@dataclass(frozen=True)
class Gain:
    """What it gains to multiply one term's magnitude by a factor: differences, positive is better.

    worst_case_m, noise_m: along the closing axis, m. success: of the probability.
    """

    name: str
    kind: Kind
    factor: float
    worst_case_m: float
    noise_m: float
    success: float

    def __str__(self) -> str:
        action = "halve" if self.factor == 0.5 else f"{self.factor:g} times"
        return (
            f"{action} {self.name + ':':<22} {100 * self.success:+.1f} % of grasps; "
            f"{1e3 * self.worst_case_m:.1f} mm less bias, {1e3 * self.noise_m:.2f} mm less noise"
        )


def sensitivity(
    budget: ErrorBudget, factor: float = 0.5, n: int = DRAWS, seed: int = 0
) -> tuple[Gain, ...]:
    """ "Halve this, gain that": every term by itself, the one to fix first in front.

    By grasps gained; where that is within chance (all succeed, or none) by the worst case. The
    same draws serve every term, so their differences are far quieter than the probabilities.
    """
    parts = list(budget.parts(n, seed))
    total = np.sum(parts, axis=0)
    before, at = budget.as_draws(total).success(), budget.along("closing")
    gains = []
    for term, part in zip(budget.terms, parts, strict=True):
        fewer = budget.as_draws(total + (factor - 1) * part)  # a part grows with its magnitude
        better = budget.scaled(term.name, factor)
        along = better.along("closing")
        gains.append(
            Gain(
                term.name,
                term.kind,
                factor,
                at.worst_case_m[1] - along.worst_case_m[1],
                at.noise_m - along.noise_m,
                fewer.success() - before,
            )
        )
    chance = max(2 * math.sqrt(before * (1 - before) / n), FEW_DRAWS / n)
    if max(abs(gain.success) for gain in gains) <= chance:
        return tuple(sorted(gains, key=lambda g: -(g.worst_case_m + 2 * g.noise_m)))
    return tuple(sorted(gains, key=lambda g: -g.success))


@dataclass(frozen=True)
class Mounting:
    """What a camera's place must allow.

    workspace_m: (width, height) that must be in the image at the object's distance. clearance_m:
    the arm, or the hand under the camera, needs so much room. reach_m: the mount, or the arm that
    carries the camera, goes no farther. minimum_range_m: nearer than that there is no depth; None:
    what a search over 126 px of disparity gives.
    """

    workspace_m: tuple[float, float] = (0.30, 0.20)
    clearance_m: float = 0.20
    reach_m: float = 0.80
    minimum_range_m: float | None = None

    def __post_init__(self) -> None:
        for name in ("clearance_m", "reach_m"):
            if not positive(getattr(self, name)):
                raise ValueError(f"{name}: got {getattr(self, name)!r}, want a positive length, m")
        if len(self.workspace_m) != 2 or not all(map(positive, self.workspace_m)):
            raise ValueError(f"workspace_m: got {self.workspace_m!r}, want (width, height), m")
        if self.minimum_range_m is not None and not positive(self.minimum_range_m):
            raise ValueError(f"minimum_range_m: got {self.minimum_range_m!r}, want a length, m")

    def least_m(self, budget: ErrorBudget) -> dict[str, float]:
        """The least distance that each constraint allows, by its name, m."""
        camera = budget.view.intrinsics
        width, height = self.workspace_m
        seen = max(width * camera.fx / camera.width, height * camera.fy / camera.height)
        shortest = self.minimum_range_m or budget.view.minimum_range_m
        return {"field of view": seen, "minimum range": shortest, "clearance": self.clearance_m}


@dataclass(frozen=True, eq=False)
class BestDistance:
    """Where to mount the camera.

    distance_m, figure_m: the best, and what it gives. low_m, high_m: what is allowed. limit: the
    constraint that keeps it from being better, "" where the best lies inside. distances_m,
    figures_m (n,): the curve. allowed: the least distance of each constraint, m.
    """

    distance_m: float
    figure_m: float
    low_m: float
    high_m: float
    limit: str
    distances_m: Floats
    figures_m: Floats
    allowed: dict[str, float]

    def __repr__(self) -> str:
        why = f", held by the {self.limit}" if self.limit else ""
        return (
            f"{self.distance_m:.2f} m ({1e3 * self.figure_m:.1f} mm along the closing axis)"
            f"{why}; allowed are {self.low_m:.2f} to {self.high_m:.2f} m"
        )


def closing_figure_m(budget: ErrorBudget) -> float:
    """Along the closing axis: biases in quadrature at their largest, and two sigmas of noise, m."""
    along = budget.along("closing")
    return along.quadrature_m[1] + 2 * along.noise_m


def best_distance(
    budget: ErrorBudget,
    mounting: Mounting | None = None,
    figure: Callable[[ErrorBudget], float] = closing_figure_m,
) -> BestDistance:
    """The distance with the least `figure` that the constraints allow.

    The object stays at its pixel. Raises ValueError when no distance meets the constraints, with
    those that contradict each other, and when rows hold only where they were stated.
    """
    mounting = mounting or Mounting()
    allowed = mounting.least_m(budget)
    binding = max(allowed, key=lambda name: allowed[name])
    low, high = allowed[binding], mounting.reach_m
    if low > high:
        raise ValueError(
            f"mounting: the {binding} wants at least {low:.2f} m, the reach allows {high:.2f} m"
        )
    distances = np.linspace(low, high, DISTANCES)
    figures = np.array([figure(budget.at(distance_m=float(Z))) for Z in distances])
    best = int(np.argmin(figures))
    limit = binding if best == 0 else "reach" if best == len(distances) - 1 else ""
    return BestDistance(
        float(distances[best]), float(figures[best]), low, high, limit, distances, figures, allowed
    )
