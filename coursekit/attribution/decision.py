"""What the tests add up to: a verdict, or how many more trials one would take.

A verdict costs something to act on, so it needs two things: a test that rejects the other
explanation, and enough trials that the explanations which were not seen would have been.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from coursekit.attribution.mean_test import (
    MeanTest,
    effective_axes,
    mean_power,
    mean_test,
    pose_power,
)
from coursekit.attribution.place_test import PlaceTest
from coursekit.attribution.pose_test import PoseTest

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

Verdict = Literal["calibration", "perception", "pose_dependent", "cannot_tell_yet"]

FEWEST = 5  # trials below which nothing is decided
SURE = 0.9  # power with which "there is none" may be said
# A mean is blamed on the calibration only if a part of the same size that follows the pose would
# have shown in one set of three, and, unless it would have been sure to, if the tests of the pose
# are not already close to showing one.
SEEN, SUSPECT = 1 / 3, 0.02
# Of that size if the places are WIDE_M apart (rms about their middle) or more; less if they are
# nearer, where an arm errs nearly alike. All over the table of `simulate` is 0.18 m. There slipped
# joints change a miss by a third of what they shift all by at 0.11 m, and by a tenth at 0.03 m.
WIDE_M = 0.1
# The trials in repeated places count one by one for the mean only if these do not seem to differ:
# the p-value that is usual for pooling (Bancroft 1944, Annals of Mathematical Statistics 15, 190,
# and those after him). Otherwise the mean must stand out among the means of the places too.
POOL = 0.25
ANY_POSE = 7  # numbers of the general regression
DOUBT = 0.05  # p-value of the mean below which "perception" is not said
MOST = 500  # trials: nobody grasps more often to find out
REMEDY: dict[Verdict, str] = {
    "calibration": "repeat the hand-eye calibration, which also takes up what the arm is wrong by "
    "everywhere, or measure the constant and subtract it; more frames will not help",
    "perception": "look at the detector, the depth and its averaging; a new calibration will not "
    "help",
    "pose_dependent": "let the calibration estimate the arm's joint zeros, or calibrate where you "
    "grasp; a camera that is turned (fixed camera) or a shifted finger or wrist camera looks like "
    "this too, and the shares of the scatter say which is likelier",
    "cannot_tell_yet": "repeat the grasp, at places and turns all over the table",
}
ELSEWHERE = "grasp in other places, all over the table"
BY_PLACE = (
    "calibrate where you grasp, or subtract what each place misses by. No turn, scale or shift is "
    "seen to explain it: look at the arm's gears and load, the table, and the depth and the lens "
    "in that part of the image"
)


@dataclass(frozen=True, eq=False)
class Tests:
    """All tests of a set of n trials with scatter S (3, 3), m^2, and their powers.

    pose, places: None where they could not be had. spread: how much of its size an error of the arm
    changes by over these poses, 0 (one place) to 1 (all over the table); None if they are not
    known.
    """

    n: int
    S: Floats
    mean: MeanTest
    pose: PoseTest | None
    places: PlaceTest | None
    spread: float | None
    level: float

    @property
    def p_pose(self) -> float | None:
        """Of "the pose does not matter": the regression and the places, joined by Bonferroni."""
        found = [test.p_value for test in (self.pose, self.places) if test is not None]
        return min(1.0, len(found) * min(found)) if found else None

    def mean_power(self, size_m: float, n: int) -> float:
        """How surely a constant of length size_m is found in n trials."""
        return mean_power(size_m, self.S, self.mean.axes, n, self.level)

    def pose_power(self, size_m: float, n: int, level: float | None = None) -> float:
        """The same of a part that follows the pose, rms, by the regression."""
        columns = ANY_POSE if self.pose is None else self.pose.columns
        level = (level or self.level) / self._shares
        return pose_power(size_m, self.S, self.mean.axes, n, columns, level)

    def place_power(self, size_m: float, n: int, level: float | None = None) -> float:
        """The same of any differences between the places that were repeated, rms; 1 without."""
        if self.places is None:
            return 1.0
        some = round(n * self.places.trials / self.n)  # in the same places, as often
        S, axes, level = self.places.S, self.places.axes, (level or self.level) / self._shares
        return pose_power(size_m, S, axes, some, self.places.columns, level)

    def none_power(self, size_m: float, n: int) -> float:
        """What "the pose does not matter" rests on: the repeats; without them, the regression."""
        if self.p_pose is None:
            return 1.0  # not asked for
        test = self.pose_power if self.places is None else self.place_power
        return test(size_m, n)

    def pose_may_be(self, size_m: float, spread: float | None) -> bool:
        """Whether what follows the pose, at poses spread so, may hide behind a mean of size_m.

        Unrelated errors of the places must be larger than their mean, by the root of their number.
        """
        if spread is None:
            return False
        seen = self.pose_power(spread * size_m, self.n, SUSPECT)
        if self.places is not None:
            each = size_m * self.places.places**0.5
            seen = min(seen, self.place_power(each, self.n, SUSPECT))
        suspect = self.p_pose is not None and self.p_pose < SUSPECT
        return seen < SEEN or (suspect and seen < SURE)

    def places_may_be(self) -> bool:
        """Whether the mean may be that of a few places with errors of their own."""
        if self.places is None or self.places.p_value >= POOL:
            return False
        return mean_test(self.places.means_m).p_value >= self.level

    def places_power(self, size_m: float, n: int) -> float:
        """How surely a constant of size_m stands out among places like these, as often repeated."""
        assert self.places is not None
        S, places = np.cov(self.places.means_m.T), self.places.places
        axes = effective_axes(S, places)
        return mean_power(size_m, S, axes, round(places * n / self.n), self.level)

    def finds_both(self, size_m: float, n: int) -> bool:
        """Whether n trials are enough to say that there is neither, of size_m."""
        return n >= FEWEST and min(self.mean_power(size_m, n), self.none_power(size_m, n)) >= SURE

    @property
    def _shares(self) -> int:
        """How many tests of the pose share the level."""
        return 1 if self.pose is None or self.places is None else 2


@dataclass(frozen=True)
class Decision:
    """verdict, says: why. more_trials: that would settle it, 0 if it is, None beyond 500."""

    verdict: Verdict
    says: str
    more_trials: int | None
    remedy: str


def decide(tests: Tests, length_m: float, matters_m: float) -> Decision:
    """The verdict on trials whose mean has length_m, where matters_m is worth finding."""
    if tests.n < FEWEST:
        why = f"{tests.n} trials decide nothing, {FEWEST} are the fewest"
        return _undecided(why, tests.n, lambda n: tests.finds_both(matters_m, n))
    if tests.p_pose is not None and tests.p_pose < tests.level:
        return _pose_dependent(tests)
    if tests.mean.p_value < tests.level:
        return _constant(tests, length_m)
    return _scatter(tests, length_m, matters_m)


def _pose_dependent(tests: Tests) -> Decision:
    places = tests.places
    if places is None or places.p_value >= tests.level:
        return _decided("pose_dependent", "the miss changes with the pose of the gripper")
    says = (
        f"the miss changes by {1e3 * places.part_m:.1f} mm from place to place, repeats in one "
        f"place scatter by {1e3 * places.scatter_m:.1f} mm"
    )
    follows = places.p_follows is not None and places.p_follows < tests.level
    return Decision("pose_dependent", says, 0, REMEDY["pose_dependent"] if follows else BY_PLACE)


def _constant(tests: Tests, length_m: float) -> Decision:
    share = f"the misses share {1e3 * length_m:.1f} mm"
    seen = lambda n: tests.pose_power(length_m, n, SUSPECT) >= SURE  # noqa: E731
    if tests.places_may_be():
        says = f"{share}, but as likely because few places with errors of their own were tried"
        more = lambda n: tests.places_power(length_m, n) >= SURE  # noqa: E731
        return _undecided(says, tests.n, more, ELSEWHERE)
    if not tests.pose_may_be(length_m, tests.spread):
        return _decided("calibration", f"{share} in one direction")
    if tests.spread and tests.pose_may_be(length_m, 1.0):
        says = f"{share}, but too few trials rule out that they follow the pose"
        return _undecided(says, tests.n, seen)
    says = f"{share}, but the places are too near each other to tell it from an error of the arm"
    elsewhere = lambda n: n >= tests.n + FEWEST and seen(n)  # noqa: E731
    return _undecided(says, tests.n, elsewhere, ELSEWHERE)


def _scatter(tests: Tests, length_m: float, matters_m: float) -> Decision:
    of_size, n = f"{1e3 * matters_m:.0f} mm", tests.n
    if not tests.finds_both(matters_m, n):
        says = f"no cause shows, but one of {of_size} could hide in {n} trials with this scatter"
        return _undecided(says, n, lambda n: tests.finds_both(matters_m, n))
    if tests.mean.p_value < DOUBT:
        says = f"the misses share {1e3 * length_m:.1f} mm, which is hardly chance, but may be"
        return _undecided(says, n, lambda n: tests.mean_power(length_m, n) >= SURE)
    rest = "" if tests.p_pose is None else f", nor a part of {of_size} that follows the pose"
    if tests.places is not None:
        rest = f", nor a difference of {of_size} between the places"
    return _decided("perception", f"scatter: no constant of {of_size}{rest} would have hidden")


def _decided(verdict: Verdict, says: str) -> Decision:
    return Decision(verdict, says, 0, REMEDY[verdict])


def _undecided(
    says: str, n: int, settled: Callable[[int], bool], remedy: str = REMEDY["cannot_tell_yet"]
) -> Decision:
    """more_trials from what total settles it; power only grows with trials."""
    total = bisect_left(range(MOST + 1), True, lo=n + 1, key=settled)
    return Decision("cannot_tell_yet", says, total - n if total <= MOST else None, remedy)
