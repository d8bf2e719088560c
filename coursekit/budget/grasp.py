"""Does the grasp succeed, what to fix first, and how far away to mount the camera."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from coursekit import checks
from coursekit.arrays import Floats
from coursekit.budget.budget import ErrorBudget
from coursekit.budget.view import AXES
from coursekit.checks import want
from coursekit.results import ErrorKind

DRAWS = 20_000  # of a probability that is redrawn while dragging: a standard error of 0.4 % at most
DISTANCES = 200
FEW_DRAWS = 10  # a gain of so many draws says nothing about which row is first
WIDTH_WANTED = "a positive length of at most 1 m: 60 mm is 0.060"  # more was meant in millimetres


@dataclass(frozen=True)
class Gripper:
    """Two fingers that open opening_m wide; source: who says so.

    Raises ValueError for a length that is not positive, or so large that it was meant in mm.
    """

    opening_m: float
    source: str = ""

    def __post_init__(self) -> None:
        checks.number("opening_m", self.opening_m, WIDTH_WANTED, above=0.0, most=1.0)


@dataclass(frozen=True)
class Target:
    """What is to be grasped: its width between the fingers, m.

    Raises ValueError as `Gripper` does.
    """

    width_m: float

    def __post_init__(self) -> None:
        checks.number("width_m", self.width_m, WIDTH_WANTED, above=0.0, most=1.0)


LESSON_GRIPPER = Gripper(0.040, "the lesson; it is the travel of one finger")
WIDOWX_GRIPPER = Gripper(0.080, "the arm's published model, which opens 80 to 88 mm: the lower end")
CUBE = Target(0.025)


def centring_tolerance_m(gripper: Gripper, target: Target) -> float:
    """How far the object may be from the middle between the fingers, to either side, m.

    (opening - width) / 2. Raises ValueError for an object that does not fit.

    >>> round(1000 * centring_tolerance_m(WIDOWX_GRIPPER, CUBE), 1)
    27.5
    """
    room = (gripper.opening_m - target.width_m) / 2
    opening = f"less than the {gripper.opening_m:g} m between the fingers"
    want(room > 0, "target", target.width_m, opening)
    return room


def with_gripper(budget: ErrorBudget, gripper: Gripper, target: Target) -> ErrorBudget:
    """The budget with the tolerance along the closing axis that this gripper leaves.

    Raises ValueError for an object that does not fit.
    """
    tolerance_m = (centring_tolerance_m(gripper, target), *budget.grasp.tolerance_m[1:])
    return budget.at(grasp=replace(budget.grasp, tolerance_m=tolerance_m))


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

    def __repr__(self) -> str:
        axes = ", ".join(f"{a} {100 * p:.1f}" for a, p in zip(AXES, self.by_axis, strict=True))
        return (
            f"{100 * self.probability:.1f} % of grasps succeed ({axes});\n"
            f"    {100 * self.rigs:.1f} % of rigs would be within the tolerance without noise"
        )


def success_probability(budget: ErrorBudget) -> Success:
    """The probability that all three axes stay within their tolerances, by draws of the rig.

    Each bias has a magnitude from its range and a direction of its own kind, all independent; the
    noise is that after averaging. The object itself is taken as a block that fits or does not: no
    tilt, no finger that pushes it into place. The same budget gets the same draws, so that dragging
    a slider changes the probability smoothly.

    >>> from coursekit.budget import lesson_budget
    >>> round(success_probability(lesson_budget(stated=False)).probability, 2)
    0.98
    """
    bias, noise = np.zeros((3, DRAWS)), np.zeros((3, DRAWS))
    for term, part in zip(budget.terms, budget.parts(DRAWS), strict=True):
        total = bias if term.kind == "bias" else noise
        total += part
    within = budget.as_draws(bias + noise).within()
    p = float(within.all(axis=1).mean())
    closing, approach, lateral = within.mean(axis=0).tolist()
    error = math.sqrt(max(p * (1 - p), 0.25 / DRAWS) / DRAWS)
    return Success(p, error, budget.as_draws(bias).success(), (closing, approach, lateral))


@dataclass(frozen=True)
class Gain:
    """What it gains to multiply one term's magnitude by a factor: differences, positive is better.

    worst_case_m, noise_m: along the closing axis, m. success: of the probability.
    """

    name: str
    kind: ErrorKind
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


def sensitivity(budget: ErrorBudget, factor: float = 0.5) -> tuple[Gain, ...]:
    """ "Halve this, gain that": every term by itself, the one to fix first in front.

    factor: by which each magnitude is multiplied. The order is by grasps gained; where that is
    within chance (all succeed, or none) by the worst case. The same draws serve every term, so
    their differences are far quieter than the probabilities.

    >>> from coursekit.budget import lesson_budget
    >>> sensitivity(lesson_budget(stated=False))[0].name
    'hand-eye rotation'
    """
    parts = list(budget.parts(DRAWS))
    total = np.sum(parts, axis=0)
    before, at = budget.as_draws(total).success(), budget.along("closing")
    gains = []
    for term, part in zip(budget.terms, parts, strict=True):
        fewer = budget.as_draws(total + (factor - 1) * part)  # a part grows with its magnitude
        along = budget.scaled(term.name, factor).along("closing")
        bias, noise = at.worst_case_m[1] - along.worst_case_m[1], at.noise_m - along.noise_m
        gains.append(Gain(term.name, term.kind, factor, bias, noise, fewer.success() - before))
    chance = max(2 * math.sqrt(before * (1 - before) / DRAWS), FEW_DRAWS / DRAWS)
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
        checks.positive("clearance_m", self.clearance_m, "a positive length, m")
        checks.positive("reach_m", self.reach_m, "a positive length, m")
        workspace = checks.array("workspace_m", self.workspace_m, (2,), finite=True)
        want((workspace > 0).all(), "workspace_m", self.workspace_m, "(width, height), m")
        if self.minimum_range_m is not None:
            checks.positive("minimum_range_m", self.minimum_range_m, "a positive length, m")

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

    >>> from coursekit.budget import lesson_budget
    >>> best_distance(lesson_budget(stated=False)).limit
    'clearance'
    """
    mounting = mounting or Mounting()
    allowed = mounting.least_m(budget)
    binding = max(allowed, key=lambda name: allowed[name])
    low, high = allowed[binding], mounting.reach_m
    room = f"at least {low:.2f} m, for the {binding}"
    want(low <= high, "mounting", f"a reach of {high:.2f} m", room)
    distances = np.linspace(low, high, DISTANCES)
    figures = np.array([figure(budget.at(distance_m=float(Z))) for Z in distances])
    best = int(np.argmin(figures))
    limit = binding if best == 0 else "reach" if best == len(distances) - 1 else ""
    at, figure_m = float(distances[best]), float(figures[best])
    return BestDistance(at, figure_m, low, high, limit, distances, figures, allowed)
