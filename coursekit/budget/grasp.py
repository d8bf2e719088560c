"""Does the grasp succeed, and what to fix first."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from coursekit import checks
from coursekit.budget.budget import ErrorBudget
from coursekit.budget.view import AXES
from coursekit.checks import want
from coursekit.words import say

DRAWS = 20_000  # of a probability that is redrawn while dragging: a standard error of 0.4 % at most
FEW_DRAWS = 10  # a gain of so many draws says nothing about which row is first
BY_GRASPS = "what it gains, in the order of grasps:"
BY_ROOM = "what it gains, in the order of room along closing, because no row gains grasps:"
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
        percent, rigs = 100 * self.probability, 100 * self.rigs
        return say("budget.success", percent=percent, axes=axes, rigs=rigs)


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
    """What it gains to halve one term: differences, positive is better.

    worst_case_m, noise_m: along the closing axis, m. success: of the probability.
    """

    name: str
    worst_case_m: float
    noise_m: float
    success: float

    @property
    def room_m(self) -> float:
        """Of the tolerance along closing, that is given back: the bias, and two sigmas of noise."""
        return self.worst_case_m + 2 * self.noise_m

    def line(self, grasps: bool = True) -> str:
        """The gain in words; grasps: with what it gains in these."""
        few = abs(self.success) < FEW_DRAWS / DRAWS
        share = "<0.1" if few else f"{100 * self.success:+.1f}"
        gained = f"{share:>5} % of grasps, " if grasps else ""
        return f"halve {self.name + ':':<21} {gained}{1e3 * self.room_m:.1f} mm of room"

    __str__ = line


class Ranking(tuple[Gain, ...]):
    """Gains, the largest first. by_room: all change the grasps alike, and room counts."""

    by_room: bool

    def __repr__(self) -> str:
        order = BY_ROOM if self.by_room else BY_GRASPS
        return "\n".join([order, *("  " + gain.line(not self.by_room) for gain in self)])


def sensitivity(budget: ErrorBudget) -> Ranking:
    """ "Halve this, gain that": every term by itself, the one to fix first in front.

    The order is by grasps gained; where that is within chance (all succeed, or none) by the room
    along closing. The same draws serve every term, so their differences are far quieter than the
    probabilities.

    >>> from coursekit.budget import lesson_budget
    >>> sensitivity(lesson_budget(stated=False))[0].name
    'hand-eye rotation'
    """
    parts = list(budget.parts(DRAWS))
    total = np.sum(parts, axis=0)
    before, at = budget.as_draws(total).success(), budget.along("closing")
    gains = []
    for term, part in zip(budget.terms, parts, strict=True):
        fewer = budget.as_draws(total - part / 2).success()  # a part grows with its magnitude
        along = budget.scaled(term.name, 0.5).along("closing")
        bias, noise = at.worst_case_m[1] - along.worst_case_m[1], at.noise_m - along.noise_m
        gains.append(Gain(term.name, bias, noise, fewer - before))
    chance = max(2 * math.sqrt(before * (1 - before) / DRAWS), FEW_DRAWS / DRAWS)
    alike = max(abs(gain.success) for gain in gains) <= chance
    ranked = Ranking(sorted(gains, key=lambda g: -(g.room_m if alike else g.success)))
    ranked.by_room = alike
    return ranked
