"""From the misses of repeated grasps to what to repair: the calibration, the eyes, or the arm.

A verdict costs something to act on, so it needs two things: a test that rejects the other
explanation, and enough trials that the explanations which were not seen would have been. So each
cause that may be at work stands with its test, and with how surely that test would have found it
(`Cause`); `decide` goes through them in a fixed order.
"""

from __future__ import annotations

import itertools
import zlib
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Literal

import numpy as np

from coursekit import checks
from coursekit.arm import widowx
from coursekit.arrays import ArrayLike, Floats, frozen
from coursekit.attribution import significance
from coursekit.attribution.significance import MeanTest, PlaceTest, PoseTest
from coursekit.budget.view import GRIPPER_DOWN
from coursekit.checks import want
from coursekit.geometry import make_transform
from coursekit.words import ROOM_TEXTS, say, wrapped

Blame = Literal["calibration", "perception", "pose_dependent", "cannot_tell_yet"]

TEST_LEVEL = 0.01  # of each test
ENOUGH_POWER = 0.9  # with which "there is none" may be said
FEWEST_TRIALS, MOST_TRIALS = 5, 500  # fewer decide nothing; nobody grasps more often to find out
MATTERS_M = 0.003
TOO_LONG_M, OUT_OF_REACH_M = 0.5, 10.0  # misses and places so far were given in millimetres
FEW_DIGITS = 1e-4  # of a rotation: poses are often written with five
COVERAGE = 0.95
# A mean is blamed on the calibration only if a part of the same size that follows the pose would
# have shown in one set of three, and, unless it would have been sure to, if the tests of the pose
# are not already close to showing one.
HINT_POWER, SUSPECT_LEVEL = 1 / 3, 0.02
# Of that size if the places are so far apart (rms about their middle) or more; less if they are
# nearer, where an arm errs nearly alike. All over the table of `simulate` is 0.18 m. There slipped
# joints change a miss by a third of what they shift all by at 0.11 m, and by a tenth at 0.03 m.
FAR_APART_M = 0.1
# The trials in repeated places count one by one for the mean only if these do not seem to differ:
# the p-value that is usual for pooling (Bancroft 1944, Annals of Mathematical Statistics 15, 190,
# and those after him). Otherwise the mean must stand out among the means of the places too.
POOLING_LEVEL = 0.25
DOUBT_LEVEL = 0.05  # of the mean, below which "perception" is not said
REMEDY: dict[Blame, str] = ROOM_TEXTS["attribution"]["remedy"]
ELSEWHERE = "grasp in other places, all over the table"


# --- what may be at work ---


@dataclass(frozen=True, eq=False)
class Cause:
    """One thing that may make grasps miss, as its test sees it.

    p_value: of "there is none of it", 1 where that could not be tested. S (3, 3), m^2, and axes:
    the scatter that it must stand out from. columns, beside: how many numbers describe it, and how
    many others are fitted. share: of the level that its test has. counted: what the test counts in
    the n trials that there are (trials, or places); more trials bring as many more of them.
    """

    p_value: float
    S: Floats
    axes: float
    columns: int
    beside: int
    share: float
    counted: int
    n: int

    def power(self, size_m: float, n: int, level: float = TEST_LEVEL) -> float:
        """How surely it would be found in n trials, if it were of this size, m rms."""
        counted, level = round(n * self.counted / self.n), level * self.share
        return significance.power_of_test(
            size_m, self.S, self.axes, counted, self.columns, self.beside, level
        )

    def shows(self, size_m: float, n: int, level: float = TEST_LEVEL) -> bool:
        """Whether that is sure enough."""
        return self.power(size_m, n, level) >= ENOUGH_POWER


@dataclass(frozen=True, eq=False)
class MissEvidence:
    """What n trials say of each cause.

    constant: all trials share it. by_pose: it follows the pose, by the regression. by_place: the
    places differ, by their repeats; of_places: the means of the places share it. mean, pose,
    places: the tests themselves. None where poses or repeats are missing. spread: how much of its
    size an error of the arm changes by over these poses, 0 (one place) to 1 (all over the table);
    None if they are not known.
    """

    n: int
    mean: MeanTest
    pose: PoseTest | None
    places: PlaceTest | None
    spread: float | None
    constant: Cause
    by_pose: Cause
    by_place: Cause | None
    of_places: Cause | None

    @classmethod
    def of(cls, misses: Floats, T_base_gripper: Floats | None) -> MissEvidence:
        """All tests of misses (n, 3), m, at poses (n, 4, 4)."""
        n, S, mean = len(misses), np.cov(misses.T), significance.mean_test(misses)
        pose, places, spread = None, None, None
        if T_base_gripper is not None:
            pose = significance.pose_test(misses, significance.pose_columns(T_base_gripper))
            places = significance.place_test(misses, T_base_gripper, TEST_LEVEL)
            apart = float(np.sqrt(T_base_gripper[:, :3, 3].var(axis=0).sum()))
            near = apart <= significance.ONE_PLACE_M
            spread = 0.0 if near else min(1.0, apart / FAR_APART_M)
        share = 1.0 if pose is None or places is None else 0.5  # two tests of the pose
        p_pose, numbers = (1.0, 7) if pose is None else (pose.p_value, pose.columns)
        # p-value, scatter and its axes, numbers of its own and beside, share of the level, how many
        constant = Cause(mean.p_value, S, mean.axes, 3, 0, significance.POOLED_SHARE, n, n)
        by_pose = Cause(p_pose, S, mean.axes, numbers, 3, share, n, n)
        by_place, of_places = None, None
        if places is not None:
            k, p, axes, trials = places.places, places.p_value, places.axes, places.trials
            by_place = Cause(p, places.S, axes, 3 * (k - 1), 3, share, trials, n)
            own, means = np.cov(places.means_m.T), significance.mean_test(places.means_m)
            of_places = replace(constant, p_value=means.p_value, S=own, axes=means.axes, counted=k)
        return cls(n, mean, pose, places, spread, constant, by_pose, by_place, of_places)

    @property
    def p_pose(self) -> float | None:
        """Of "the pose does not matter": the regression and the places, joined by Bonferroni."""
        found = [test.p_value for test in (self.pose, self.places) if test is not None]
        return min(1.0, len(found) * min(found)) if found else None

    @property
    def pose_cause(self) -> Cause:
        """What "the pose does not matter" rests on: the repeats; without them, the regression."""
        return self.by_place or self.by_pose

    def pose_may_hide(self, size_m: float, spread: float) -> bool:
        """Whether what follows the pose, at poses spread so, may hide behind a mean of size_m.

        Unrelated errors of the places must be larger than their mean, by the root of their number.
        """
        shows = self.by_pose.power(spread * size_m, self.n, SUSPECT_LEVEL)
        if self.by_place is not None and self.places is not None:
            each = size_m * self.places.places**0.5
            shows = min(shows, self.by_place.power(each, self.n, SUSPECT_LEVEL))
        suspected = self.p_pose is not None and self.p_pose < SUSPECT_LEVEL
        return shows < HINT_POWER or (suspected and shows < ENOUGH_POWER)


# --- the decision ---


Decision = tuple[Blame, str, int | None, str]  # the first four of `Attribution`


def decide(seen: MissEvidence, length_m: float, matters_m: float) -> Decision:
    """The verdict on trials whose mean has length_m, where matters_m is worth finding.

    The first line that holds; "would show" is a power of 0.9:

    ==================================================================  ===============
    fewer than 5 trials                                                 cannot tell yet
    the pose matters (p < 0.01)                                         pose dependent
    the mean is not zero (p < 0.01) ...                                 by `_constant`
    a constant, or what follows the pose, of matters_m would not show   cannot tell yet
    the mean is hardly zero (p < 0.05)                                  cannot tell yet
    otherwise                                                           perception
    ==================================================================  ===============
    """
    n, of_size = seen.n, f"{1e3 * matters_m:.0f} mm"
    neither = [partial(seen.constant.shows, matters_m)]
    if seen.p_pose is not None:
        neither.append(partial(seen.pose_cause.shows, matters_m))
    if n < FEWEST_TRIALS:
        says = f"{n} trials decide nothing, {FEWEST_TRIALS} are the fewest"
        return _undecided(n, says, neither)
    if seen.p_pose is not None and seen.p_pose < TEST_LEVEL:
        return _pose_dependent(seen)
    if seen.mean.p_value < TEST_LEVEL:
        return _constant(seen, length_m)
    if not all(shows(n) for shows in neither):
        says = f"no cause shows, but one of {of_size} could hide in {n} trials with this scatter"
        return _undecided(n, says, neither)
    if seen.mean.p_value < DOUBT_LEVEL:
        says = f"the misses share {1e3 * length_m:.1f} mm, which is hardly chance, but may be"
        return _undecided(n, says, [partial(seen.constant.shows, length_m)])
    rest = "" if seen.p_pose is None else f", nor a part of {of_size} that follows the pose"
    if seen.places is not None:
        rest = f", nor a difference of {of_size} between the places"
    says = f"scatter: no constant of {of_size}{rest} would have hidden"
    return "perception", says, 0, REMEDY["perception"]


def _pose_dependent(seen: MissEvidence) -> Decision:
    """By the places where their repeats show it, else by the regression."""
    says, remedy = "the miss changes with the pose of the gripper", REMEDY["pose_dependent"]
    places = seen.places
    if places is not None and places.p_value < TEST_LEVEL:
        part, scatter = 1e3 * places.part_m, 1e3 * places.scatter_m
        says = say("attribution.places_differ", part=part, scatter=scatter)
        if places.p_follows is None or places.p_follows >= TEST_LEVEL:
            remedy = say("attribution.by_place")
    return "pose_dependent", says, 0, remedy


def _constant(seen: MissEvidence, length_m: float) -> Decision:
    """Of a mean that is not zero. The first line that holds:

    ==================================================================  ===============
    the places may differ, and their few means may be zero              cannot tell yet
    a part as large that follows the pose would have shown a hint       calibration
    it would not, even with the places far apart: too few trials        cannot tell yet
    it would, were the places farther apart                             cannot tell yet
    ==================================================================  ===============
    """
    n, share, of_places = seen.n, f"the misses share {1e3 * length_m:.1f} mm", seen.of_places
    may_differ = seen.by_place is not None and seen.by_place.p_value < POOLING_LEVEL
    if may_differ and of_places is not None and of_places.p_value >= TEST_LEVEL:
        says = f"{share}, but as likely because few places with errors of their own were tried"
        return _undecided(n, says, [partial(of_places.shows, length_m)], ELSEWHERE)
    if seen.spread is None or not seen.pose_may_hide(length_m, seen.spread):
        return "calibration", f"{share} in one direction", 0, REMEDY["calibration"]
    pose = [partial(seen.by_pose.shows, length_m, level=SUSPECT_LEVEL)]
    if seen.spread and seen.pose_may_hide(length_m, 1.0):
        says = f"{share}, but too few trials rule out that they follow the pose"
        return _undecided(n, says, pose)
    says = f"{share}, but the places are too near each other to tell it from an error of the arm"
    return _undecided(n, says, pose, ELSEWHERE, n + FEWEST_TRIALS)


def _undecided(
    n: int,
    says: str,
    needed: Sequence[Callable[[int], bool]],
    remedy: str = REMEDY["cannot_tell_yet"],
    least: int = FEWEST_TRIALS,
) -> Decision:
    """more_trials from the least total in which all that is needed shows; power only grows.

    needed: for each cause that has to show, whether it does in n trials. least: trials in any case.
    """
    totals, first = range(MOST_TRIALS + 1), max(n + 1, least)
    total = bisect_left(totals, True, first, key=lambda n: all(shows(n) for shows in needed))
    more = total - n if total <= MOST_TRIALS else None
    return "cannot_tell_yet", says, more, remedy


# --- the answer ---


@dataclass(frozen=True, eq=False, repr=False)
class Attribution:
    """What repeated misses say about their cause.

    verdict: "calibration" (one direction in the base), "perception" (scatter), "pose_dependent"
    (the miss follows the pose of the arm, or the place), "cannot_tell_yet". says: why, in a
    sentence. more_trials: how many more would settle it, 0 where it is settled, None where 500
    would not do. remedy: what to do about it.

    mean_m (3,), interval_m (3, 2), scatter_m (3,): mean miss along the base's axes, its 95 %
    interval axis by axis, and the std of one trial. evidence: each test, and how surely it would
    have found what it looks for. matters_m: the size that is worth finding.
    """

    verdict: Blame
    says: str
    more_trials: int | None
    remedy: str
    mean_m: Floats
    interval_m: Floats
    scatter_m: Floats
    evidence: MissEvidence
    matters_m: float

    def lines(self) -> list[str]:
        """The numbers behind the verdict, a line each, mm."""
        seen, pose, place = self.evidence, self.evidence.pose, self.evidence.places
        axes = ", ".join(
            f"{axis} {1e3 * mean:+z.1f} ({1e3 * low:+z.1f} to {1e3 * high:+z.1f})"
            for axis, mean, (low, high) in zip("xyz", self.mean_m, self.interval_m, strict=True)
        )
        scatter = ", ".join(f"{1e3 * std:.1f}" for std in self.scatter_m)
        mean = seen.mean
        t2 = "" if mean.t2 is None else f"; T² = {mean.t2:.1f}, alone {_p(mean.p_t2)}"
        find = f"; power to find {1e3 * self.matters_m:.0f} mm: "
        power = seen.constant.power(self.matters_m, seen.n)
        means = {"axes": axes, "scatter": scatter, "p": _p(mean.p_value), "t2": t2}
        lines = say("attribution.mean", find=find, power=power, **means).splitlines()
        if pose is not None:
            shares = [f"{name} {share:.0%}" for name, share in pose.shares.items()]
            alone = f"; of the scatter, alone: {', '.join(shares)}" if shares else ""
            facts = {"p": _p(pose.p_value), "part": 1e3 * pose.part_m, "alone": alone}
            lines.append(say("attribution.pose", **facts))
        else:
            lines.append(say("attribution.no_poses"))
        if place is not None:
            both = f"; with the line above {_p(seen.p_pose)}" if pose is not None else ""
            facts = {"part": 1e3 * place.part_m, "scatter": 1e3 * place.scatter_m, "both": both}
            lines.append(say("attribution.place", place=place, p=_p(place.p_value), **facts))
        if seen.p_pose is not None:
            lines[-1] += f"{find}{seen.pose_cause.power(self.matters_m, seen.n):.0%}"
        return lines

    def __repr__(self) -> str:
        name = self.verdict.replace("_", " ").upper()
        lines = [
            wrapped(f"{name} ({self.evidence.n} trials): {self.says}."),
            *(wrapped(line, first="  ", indent="    ") for line in self.lines()),
            wrapped(f"What to do: {self.remedy}."),
        ]
        if self.verdict == "cannot_tell_yet":
            more = f"about {self.more_trials} more would settle it, if they scatter like these"
            if self.more_trials is None:
                more = f"not even {MOST_TRIALS} would settle it with this scatter"
            lines.append(wrapped(f"Trials: {more}."))
        return "\n".join(lines)


def attribute(
    misses: ArrayLike, poses: ArrayLike | None = None, *, matters_m: float = MATTERS_M
) -> Attribution:
    """Decide what repeated grasps miss by: the calibration, perception, or the pose of the arm.

    misses (n, 3), n >= 2: where the gripper closed less where the object was, in the base, m, of
    independent trials. poses (n, 4, 4): T_base_gripper of each trial; without them nothing is said
    about the pose. matters_m: the smallest constant, or part that follows the pose, that is worth
    finding; it decides when "perception" may be said.

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

    Raises ValueError for shapes, NaN, lengths of 0.5 m and more (millimetres?), and a matters_m out
    of range.

    >>> from coursekit.attribution import simulate_misses
    >>> grasps = simulate_misses("calibration", 20, seed=1)
    >>> attribute(grasps.misses, grasps.T_base_gripper).verdict
    'calibration'
    """
    from scipy.stats import t

    rows = checks.array("misses", misses, (None, 3), finite=True)
    n = len(rows)
    want(n >= 2, "misses", rows, "2 trials or more")
    longest = float(np.linalg.norm(rows, axis=1).max())
    shorter = f"less than {TOO_LONG_M} m (are these millimetres?)"
    want(longest < TOO_LONG_M, "misses", f"{longest:.1f} m", shorter)
    length = "a length in m, such as 0.003"
    checks.number("matters_m", matters_m, length, above=0.0, most=TOO_LONG_M)
    if poses is not None:
        poses = checks.transforms("poses", poses, FEW_DIGITS)
        want(poses.shape == (n, 4, 4), "poses", poses, f"one (4, 4) for each of {n} trials")
        far = float(np.abs(poses[:, :3, 3]).max())
        want(far < OUT_OF_REACH_M, "poses", f"{far:.0f} m", "metres (are these millimetres?)")
    seen = MissEvidence.of(rows, poses)
    center, scatter = rows.mean(axis=0), rows.std(axis=0, ddof=1)
    half = float(t.ppf((1 + COVERAGE) / 2, n - 1)) * scatter / np.sqrt(n)
    interval = np.column_stack([center - half, center + half])
    decision = decide(seen, float(np.linalg.norm(center)), matters_m)
    return Attribution(*decision, center, interval, scatter, seen, matters_m)


def _p(value: float | None) -> str:
    """A p-value to three digits; None only where the test was not done and nothing is printed."""
    return "p < 0.001" if value is not None and value < 0.001 else f"p = {value:.3f}"


# --- misses whose cause is known ---

# The length of the constant that all trials share, the std of the scatter on one axis, and the rms
# over the table of what follows the pose
SIZES_M: dict[Blame, tuple[float, float, float]] = {
    "calibration": (0.003, 0.002, 0.0),
    "perception": (0.0, 0.002, 0.0),
    "pose_dependent": (0.0, 0.002, 0.004),  # the lesson's arm is wrong by 2 to 4 mm
    "cannot_tell_yet": (0.0005, 0.006, 0.0),  # 30 trials do not show so small a constant
}
TABLE_GRASPS = 400  # with known joint angles, drawn from
RADIUS_M, AZIMUTH_RAD, HEIGHT_M = (0.2, 0.42), 1.0, (0.01, 0.1)
YAW_RAD, TILT_RAD = 1.2, 0.15
SEEN_FROM_ABOVE_M = 0.002  # of a common miss: its level part, in the figure of notebook 5


@dataclass(frozen=True, eq=False)
class SimulatedMisses:
    """Misses of n grasps, and what made them.

    misses (n, 3): where the gripper closed less where the object was, in the base, m.
    T_base_gripper (n, 4, 4): where the arm said it was. q (n, 6): its joints, rad. kind: the cause.
    constant_m (3,): the part that every trial shares. by_pose_m (n, 3): the arm's part. The rest of
    the misses is scatter.
    """

    misses: Floats
    T_base_gripper: Floats
    q: Floats
    kind: Blame
    constant_m: Floats
    by_pose_m: Floats


def simulate_misses(kind: Blame, n: int, seed: int) -> SimulatedMisses:
    """n grasps from above, all over the table in front of a WidowX AI, that miss for one reason.

    kind: "calibration" (a constant of 3 mm in a random direction of the base), "perception"
    (scatter and nothing else), "pose_dependent" (the zeros of the six joints slipped, then the
    hand-eye calibration was repeated, which took up what the slip does everywhere; 4 mm rms is left
    over the table), "cannot_tell_yet" (a constant of 0.5 mm under scatter of 6 mm). The scatter
    that the others have is 2 mm an axis. More than 400 grasps repeat places.

    Raises ValueError for an unknown kind, and for n < 1.

    >>> grasps = simulate_misses("calibration", 5, seed=1)
    >>> grasps.misses.shape, round(1000 * float(np.linalg.norm(grasps.constant_m)), 1)
    ((5, 3), 3.0)
    """
    constant_m, scatter_m, by_pose_m = SIZES_M[checks.choice("kind", kind, SIZES_M)]
    checks.whole("n", n)
    rng = np.random.default_rng([seed, zlib.crc32(b"misses")])
    q, poses = _table_grasps()
    chosen = rng.choice(len(q), n, replace=n > len(q))
    direction = rng.standard_normal(3)
    constant = constant_m * direction / np.linalg.norm(direction)
    ratio, by_pose = rng.standard_normal(6), np.zeros((n, 3))
    if by_pose_m:
        by_pose = by_pose_m * slipped_joints(ratio)[chosen]
    misses = constant + by_pose + scatter_m * rng.standard_normal((n, 3))
    return SimulatedMisses(misses, poses[chosen], q[chosen], kind, constant, by_pose)


def four_sets(unit: int = 7) -> dict[str, SimulatedMisses]:
    """Sets P, Q, R and S for notebook 5, one for each of `Blame`, in an order of their own.

    unit: as `my_unit` says, whose order and misses they are; misses that chance would have
    `attribute` misjudge, or that do not show from above, are drawn again.

    >>> sorted(four_sets()), len(four_sets()["S"].misses)
    (['P', 'Q', 'R', 'S'], 5)
    """
    rng, sets = np.random.default_rng(unit), {}
    made: list[tuple[Blame, Blame, int, int]] = [
        ("perception", "perception", 25, 8),
        ("calibration", "calibration", 25, 18),
        ("pose_dependent", "pose_dependent", 25, 28),
        ("cannot_tell_yet", "calibration", 5, 9),
    ]
    order = range(4) if unit == 7 else rng.permutation(4).tolist()
    for name, (verdict, kind, n, seed) in zip("PQRS", (made[i] for i in order), strict=True):
        for again in itertools.count(seed if unit == 7 else int(rng.integers(1 << 30))):
            sets[name] = drawn = simulate_misses(kind, n, again)
            level_m = np.linalg.norm(drawn.misses.mean(axis=0)[:2])
            shows = verdict != "calibration" or level_m > SEEN_FROM_ABOVE_M
            if shows and attribute(drawn.misses, drawn.T_base_gripper).verdict == verdict:
                break
    return sets


def slipped_joints(ratio: Floats) -> Floats:
    """Misses at all places of the table after slips of the joints in this ratio (6,).

    What they share is taken up by the calibration; 1 m rms is left, (places, 3).
    """
    q, poses = _table_grasps()
    slip = 1e-3 * ratio / np.linalg.norm(ratio)
    moved = widowx().forward(q + slip)[:, :3, 3] - poses[:, :3, 3]
    moved -= moved.mean(axis=0)
    return np.asarray(moved / np.sqrt((moved**2).sum(axis=1).mean()))


@cache
def _table_grasps() -> tuple[Floats, Floats]:
    """Joint angles (places, 6) and poses (places, 4, 4) of grasps from above; read-only."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(zlib.crc32(b"table"))
    azimuth = rng.uniform(-AZIMUTH_RAD, AZIMUTH_RAD, TABLE_GRASPS)
    radius = rng.uniform(*RADIUS_M, TABLE_GRASPS)
    height = rng.uniform(*HEIGHT_M, TABLE_GRASPS)
    at = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
    yaw = azimuth + rng.uniform(-YAW_RAD, YAW_RAD, TABLE_GRASPS)
    tilt = rng.uniform(-TILT_RAD, TILT_RAD, (TABLE_GRASPS, 2))
    turn = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix() @ GRIPPER_DOWN
    poses = np.stack([make_transform(R, t) for R, t in zip(turn, at, strict=True)])
    q, reached = widowx().inverse(poses)
    return frozen(q[reached]), frozen(poses[reached])
