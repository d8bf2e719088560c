"""What the tests add up to: a verdict, or how many more trials one would take.

A verdict costs something to act on, so it needs two things: a test that rejects the other
explanation, and enough trials that the explanations which were not seen would have been.

From the misses of repeated grasps to what to repair: the calibration, the eyes, or the arm.

Three tests: is the mean miss zero, do the misses follow the pose, do they differ from place to
place by more than repeats in one place do. `decision` says what they add up to.
"""

from __future__ import annotations

import textwrap
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np

from coursekit.arrays import ArrayLike, Floats
from coursekit.attribution.significance import (
    GROUPS,
    SAME_M,
    STILL,
    MeanTest,
    PlaceTest,
    PoseTest,
    effective_axes,
    mean_power,
    mean_test,
    place_test,
    pose_columns,
    pose_power,
    pose_test,
)
from coursekit.hand_eye.poses import check_poses

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


LEVEL = 0.01
MATTERS_M = 0.003
COVERAGE = 0.95
FAR_M = 0.5
LINE = 88
AXES = ("x", "y", "z")


@dataclass(frozen=True, eq=False, repr=False)
class Attribution:
    """What repeated misses say about their cause.

    verdict: "calibration" (one direction in the base), "perception" (scatter), "pose_dependent"
    (the miss follows the pose of the arm, or the place), "cannot_tell_yet". says: why, in a
    sentence. remedy: what to do about it.

    n: trials. mean_m (3,), interval_m (3, 2), scatter_m (3,): mean miss along the base's axes, its
    95 % interval axis by axis, and the std of one trial. p_mean: of "the mean is zero", by
    Hotelling's T^2 and the pooled test joined (`mean_test` has both). p_pose: of "the pose does not
    matter", by the regression (`pose_test`, p_regression) and, where places were repeated, by the
    places (`place_test`, p_places) joined with Bonferroni; each None where it could not be had.

    power_mean, power_pose: how surely a constant, or a part that follows the pose (rms; with
    repeats, any difference between the places), of matters_m would be found in n such trials;
    level: of the tests. more_trials: how many more would settle it, 0 where it is settled, None
    where 500 would not do.
    """

    verdict: Verdict
    says: str
    n: int
    mean_m: Floats
    interval_m: Floats
    scatter_m: Floats
    mean_test: MeanTest
    pose_test: PoseTest | None
    place_test: PlaceTest | None
    p_pose: float | None
    power_mean: float
    power_pose: float | None
    more_trials: int | None
    level: float
    matters_m: float
    remedy: str

    @property
    def p_mean(self) -> float:
        """How often misses with a mean of zero look at least this constant."""
        return self.mean_test.p_value

    @property
    def p_regression(self) -> float | None:
        """How often misses that do not follow the pose look as if they did at least this much."""
        return None if self.pose_test is None else self.pose_test.p_value

    @property
    def p_places(self) -> float | None:
        """How often places that do not matter look at least this different, beside repeats."""
        return None if self.place_test is None else self.place_test.p_value

    @property
    def p_hotelling(self) -> float | None:
        """Of Hotelling's T^2 alone; None under 4 trials and for scatter in a plane."""
        return self.mean_test.p_t2

    @property
    def evidence(self) -> tuple[str, ...]:
        """The numbers behind the verdict, a line each, mm."""
        axes = ", ".join(
            f"{axis} {1e3 * mean:+.1f} ({1e3 * low:+.1f} to {1e3 * high:+.1f})"
            for axis, mean, (low, high) in zip(AXES, self.mean_m, self.interval_m, strict=True)
        )
        scatter = ", ".join(f"{1e3 * std:.1f}" for std in self.scatter_m)
        return (
            f"mean miss {axes} mm (95 %)",
            f"scatter of one trial {scatter} mm along x, y, z",
            self._mean_line(),
            self._pose_line(),
            *self._place_lines(),
        )

    def _mean_line(self) -> str:
        test = self.mean_test
        t2 = "" if test.t2 is None else f"; T² = {test.t2:.1f}, alone {_p(test.p_t2)}"
        return (
            f"mean of zero: {_p(self.p_mean)}{t2}; power to find "
            f"{1e3 * self.matters_m:.0f} mm: {self.power_mean:.0%}"
        )

    def _pose_line(self) -> str:
        test = self.pose_test
        if test is None:
            return "not tested against the pose: an arm error that follows it is not ruled out"
        shares = ", ".join(f"{name} {share:.0%}" for name, share in test.shares.items())
        alone = f"; of the scatter, alone: {shares}" if shares else ""
        return (
            f"pose does not matter: {_p(test.p_value)}; the part that follows it "
            f"{1e3 * test.part_m:.1f} mm rms{alone}{'' if self.place_test else self._power_pose()}"
        )

    def _place_lines(self) -> tuple[str, ...]:
        test = self.place_test
        if test is None:
            return ()
        both = "" if self.pose_test is None else f"; with the line above {_p(self.p_pose)}"
        return (
            f"{test.places} places repeated, {test.trials} trials: place does not matter: "
            f"{_p(test.p_value)}{both}; places differ by {1e3 * test.part_m:.1f} mm rms, repeats "
            f"in one by {1e3 * test.scatter_m:.1f} mm{self._power_pose()}",
        )

    def _power_pose(self) -> str:
        return f"; power to find {1e3 * self.matters_m:.0f} mm: {self.power_pose:.0%}"

    def __repr__(self) -> str:
        name = self.verdict.replace("_", " ").upper()
        lines = [
            _fill(f"{name} ({self.n} trials): {self.says}."),
            *(_fill(line, "  ") for line in self.evidence),
            _fill(f"What to do: {self.remedy}."),
        ]
        if self.verdict == "cannot_tell_yet":
            lines.append(_fill(f"Trials: {_more(self.more_trials)}."))
        return "\n".join(lines)


def attribute(
    misses: ArrayLike,
    poses: ArrayLike | None = None,
    *,
    columns: ArrayLike | None = None,
    level: float = LEVEL,
    matters_m: float = MATTERS_M,
) -> Attribution:
    """Decide what repeated grasps miss by: the calibration, perception, or the pose of the arm.

    misses (n, 3), n >= 2: where the gripper closed less where the object was, in the base, m, of
    independent trials. poses (n, 4, 4): T_base_gripper of each trial; without them nothing is said
    about the pose. columns (n, 3, k): instead of what is read from poses, what k suspected numbers
    do to each trial, such as `arm.jacobian(q)[:, 3:]` for the zeros of the joints. level: of each
    test. matters_m: the smallest constant, or part that follows the pose, that is worth finding; it
    decides when "perception" may be said.

    The order: misses that follow the pose, or differ from place to place by more than repeats in
    one place do, are "pose_dependent"; else a mean that is not zero is "calibration", if the pose
    cannot be suspected of it; else it is "perception", if a constant and a part of matters_m that
    follows the pose would both have been found in nine sets of ten, and the mean is not nearly
    significant (p < 0.05). Repeats: 2 trials or more within 1 cm and 3 degrees, in 3 places or
    more that hold half of the trials; then "perception" rests on them and not on the regression.

    In one place an arm is wrong by a constant: poses that are too near each other give "cannot tell
    yet" where the misses share one. What no test of misses can see: an arm error that is nearly the
    same all over the table is "calibration" here, and repeating the hand-eye calibration does take
    it up; without poses any arm error that is a constant there is "calibration", and one that
    averages out over the table is scatter, hence "perception". And a depth or lens error that
    changes with the place looks like the arm's.

    Raises ValueError for shapes, NaN, lengths of 0.5 m and more (millimetres?), and a level or
    matters_m out of range.
    """
    rows = _check_misses(misses)
    if not 1e-4 <= level < 0.5:
        raise ValueError(f"level: got {level!r}, want 0.0001 to 0.5")
    if not 0 < matters_m < FAR_M:
        raise ValueError(f"matters_m: got {matters_m!r}, want a length in m, such as 0.003")
    tests = _run(rows, poses, columns, level)
    center, scatter = rows.mean(axis=0), rows.std(axis=0, ddof=1)
    half = _t_limit(len(rows)) * scatter / np.sqrt(len(rows))
    decision = decide(tests, float(np.linalg.norm(center)), matters_m)
    return Attribution(
        verdict=decision.verdict,
        says=decision.says,
        n=len(rows),
        mean_m=center,
        interval_m=np.column_stack([center - half, center + half]),
        scatter_m=scatter,
        mean_test=tests.mean,
        pose_test=tests.pose,
        place_test=tests.places,
        p_pose=tests.p_pose,
        power_mean=tests.mean_power(matters_m, len(rows)),
        power_pose=None if tests.p_pose is None else tests.none_power(matters_m, len(rows)),
        more_trials=decision.more_trials,
        level=level,
        matters_m=matters_m,
        remedy=decision.remedy,
    )


def _run(rows: Floats, poses: ArrayLike | None, columns: ArrayLike | None, level: float) -> Tests:
    pose, places, spread = None, None, None
    if columns is not None:
        if poses is not None:
            raise ValueError("columns: got poses too, want one of them")
        pose, spread = _test_columns(rows, columns, level)
    elif poses is not None:
        T_base_gripper = check_poses("poses", poses)
        if len(T_base_gripper) != len(rows):
            raise ValueError(f"poses: got {len(T_base_gripper)}, want one for each of {len(rows)}")
        pose = pose_test(rows, pose_columns(T_base_gripper), GROUPS, STILL, level)
        places = place_test(rows, T_base_gripper, level)
        spread = _spread(T_base_gripper)
    S = np.cov(rows.T)
    return Tests(len(rows), S, mean_test(rows), pose, places, spread, level)


# --- input ---


def _test_columns(rows: Floats, columns: ArrayLike, level: float) -> tuple[PoseTest | None, float]:
    """The regression on given columns, and 0 where they do not differ from trial to trial."""
    given = np.asarray(columns, dtype=np.float64)
    if given.ndim != 3 or given.shape[:2] != rows.shape or not np.isfinite(given).all():
        raise ValueError(f"columns: got shape {given.shape}, want finite ({len(rows)}, 3, k)")
    still = STILL * float(np.sqrt((given**2).sum(axis=(1, 2)).mean()))
    return pose_test(rows, given, {}, still, level), float(_rms(given) > still)


def _spread(T_base_gripper: Floats) -> float:
    apart = _rms(T_base_gripper[:, :3, 3])
    return min(1.0, apart / WIDE_M) if apart > SAME_M else 0.0


def _rms(values: Floats) -> float:
    """Root mean square distance of values (n, ...) from their mean."""
    centred = (values - values.mean(axis=0)).reshape(len(values), -1)
    return float(np.sqrt((centred**2).sum(axis=1).mean()))


def _check_misses(misses: ArrayLike) -> Floats:
    rows = np.asarray(misses, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[1] != 3 or len(rows) < 2:
        raise ValueError(f"misses: got shape {rows.shape}, want (n, 3) with 2 trials or more")
    if not np.isfinite(rows).all():
        raise ValueError(f"misses[{np.argwhere(~np.isfinite(rows))[0][0]}]: is not finite")
    if np.linalg.norm(rows, axis=1).max() >= FAR_M:
        raise ValueError(
            f"misses: the largest is {np.linalg.norm(rows, axis=1).max():.1f} m "
            "(are these millimetres?)"
        )
    return rows


def _t_limit(n: int) -> float:
    from scipy.stats import t

    return float(t.ppf((1 + COVERAGE) / 2, n - 1))


# --- in words ---


def _more(trials: int | None) -> str:
    if trials is None:
        return f"not even {MOST} would settle it with this scatter"
    return f"about {trials} more would settle it, if they scatter like these"


def _p(value: float | None) -> str:
    if value is None:
        return "p unknown"
    return "p < 0.001" if value < 0.001 else f"p = {value:.3f}"


def _fill(text: str, indent: str = "") -> str:
    return textwrap.fill(text, LINE, initial_indent=indent, subsequent_indent=indent + "  ")
