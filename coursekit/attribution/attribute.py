"""From the misses of repeated grasps to what to repair: the calibration, the eyes, or the arm.

A verdict costs something to act on, so it needs two things: a test that rejects the other
explanation, and enough trials that the explanations which were not seen would have been. Where
the second is missing the answer is "cannot tell yet", with the trials that would settle it.
"""

from __future__ import annotations

import textwrap
from bisect import bisect_left
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from coursekit.attribution.mean_test import MeanTest, mean_power, mean_test, pose_power
from coursekit.attribution.pose_test import GROUPS, STILL, PoseTest, pose_columns, pose_test
from coursekit.hand_eye.poses import check_poses

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]

Verdict = Literal["calibration", "perception", "pose_dependent", "cannot_tell_yet"]

LEVEL = 0.01
MATTERS_M = 0.003
FEWEST = 5  # trials below which nothing is decided
SURE = 0.9  # power with which "there is none" may be said
# A mean is blamed on the calibration only if a part of the same size that follows the pose would
# have shown in one set of three, and, unless it would have been sure to, if the regression is not
# already close to showing one.
SEEN, SUSPECT = 1 / 3, 0.02
MOST = 500  # trials: nobody grasps more often to find out
COVERAGE = 0.95
FAR_M = 0.5
LINE = 88
AXES = ("x", "y", "z")
REMEDY: dict[Verdict, str] = {
    "calibration": "repeat the hand-eye calibration, which also takes up what the arm is wrong by "
    "everywhere, or measure the constant and subtract it; more frames will not help",
    "perception": "look at the detector, the depth and its averaging; a new calibration will not "
    "help",
    "pose_dependent": "let the calibration estimate the arm's joint zeros, or calibrate where you "
    "grasp; a camera that is turned (fixed camera) or a shifted finger or wrist camera looks like "
    "this too, and the shares below say which is likelier",
    "cannot_tell_yet": "repeat the grasp, at places and turns all over the table",
}


@dataclass(frozen=True, eq=False, repr=False)
class Attribution:
    """What repeated misses say about their cause.

    verdict: "calibration" (one direction in the base), "perception" (scatter), "pose_dependent"
    (the miss follows the pose of the arm), "cannot_tell_yet". says: why, in a sentence.

    n: trials. mean_m (3,), interval_m (3, 2), scatter_m (3,): mean miss along the base's axes, its
    95 % interval axis by axis, and the std of one trial. p_mean: of "the mean is zero", by
    Hotelling's T^2 and the pooled test joined (`mean_test` has both); p_pose: of "the misses do
    not follow the pose", None where the poses are not known or do not differ (`pose_test`).

    power_mean, power_pose: how surely a constant, or a part that follows the pose (rms), of
    matters_m would be found in n such trials; level: of the tests. more_trials: how many more
    would settle it, 0 where it is settled, None where 500 would not do.
    """

    verdict: Verdict
    says: str
    n: int
    mean_m: Floats
    interval_m: Floats
    scatter_m: Floats
    mean_test: MeanTest
    pose_test: PoseTest | None
    power_mean: float
    power_pose: float | None
    more_trials: int | None
    level: float
    matters_m: float

    @property
    def p_mean(self) -> float:
        """How often misses with a mean of zero look at least this constant."""
        return self.mean_test.p_value

    @property
    def p_pose(self) -> float | None:
        """How often misses that do not follow the pose look as if they did at least this much."""
        return None if self.pose_test is None else self.pose_test.p_value

    @property
    def p_hotelling(self) -> float | None:
        """Of Hotelling's T^2 alone; None under 4 trials and for scatter in a plane."""
        return self.mean_test.p_t2

    @property
    def remedy(self) -> str:
        """What to do about it."""
        return REMEDY[self.verdict]

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
            f"{1e3 * test.part_m:.1f} mm rms{alone}; power to find {1e3 * self.matters_m:.0f} mm: "
            f"{self.power_pose:.0%}"
        )

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
    independent trials. poses (n, 4, 4): T_base_gripper of each trial; without them, or with all
    the same, nothing is said about the pose. columns (n, 3, k): instead of what is read from poses,
    what k suspected numbers do to each trial, such as `arm.jacobian(q)[:, 3:]` for the zeros of the
    joints. level: of each test. matters_m: the smallest constant, or part that follows the pose,
    that is worth finding; it decides when "perception" may be said.

    The order: misses that follow the pose are "pose_dependent"; else a mean that is not zero is
    "calibration", if the pose cannot be suspected of it; else it is "perception", if a constant and
    a part of matters_m that follows the pose would both have been found in nine sets of ten.

    What no test of misses can see: an arm error that is nearly the same at all the trials' poses is
    "calibration" here, and repeating the hand-eye calibration there does take it up; without poses,
    an arm error that averages out over the table is scatter, hence "perception".

    Raises ValueError for shapes, NaN, lengths of 0.5 m and more (millimetres?), and a level or
    matters_m out of range.
    """
    rows = _check_misses(misses)
    if not 1e-4 <= level < 0.5:
        raise ValueError(f"level: got {level!r}, want 0.0001 to 0.5")
    if not 0 < matters_m < FAR_M:
        raise ValueError(f"matters_m: got {matters_m!r}, want a length in m, such as 0.003")
    mean, pose = mean_test(rows), _test_pose(rows, poses, columns, level)
    found = _Sizes(len(rows), np.cov(rows.T), mean, pose, level)
    verdict, says, settled = _decide(rows, found, matters_m)
    center, scatter = rows.mean(axis=0), rows.std(axis=0, ddof=1)
    half = _t_limit(len(rows)) * scatter / np.sqrt(len(rows))
    return Attribution(
        verdict=verdict,
        says=says,
        n=len(rows),
        mean_m=center,
        interval_m=np.column_stack([center - half, center + half]),
        scatter_m=scatter,
        mean_test=mean,
        pose_test=pose,
        power_mean=found.mean_power(matters_m, len(rows)),
        power_pose=found.pose_power(matters_m, len(rows)) if pose else None,
        more_trials=0 if settled is None else _trials(len(rows), settled),
        level=level,
        matters_m=matters_m,
    )


# --- the decision ---


@dataclass(frozen=True, eq=False)
class _Sizes:
    """Both tests, and how surely they would find a size in n trials with scatter S (3, 3)."""

    n: int
    S: Floats
    mean: MeanTest
    pose: PoseTest | None
    level: float

    def mean_power(self, size_m: float, n: int) -> float:
        return mean_power(size_m, self.S, self.mean.axes, n, self.level)

    def pose_power(self, size_m: float, n: int, level: float | None = None) -> float:
        if self.pose is None:
            return 1.0  # not asked for
        columns = self.pose.columns
        return pose_power(size_m, self.S, self.mean.axes, n, columns, level or self.level)

    def pose_may_be(self, size_m: float) -> bool:
        """Whether a part of the misses that follows the pose may hide behind a mean of size_m."""
        seen = self.pose_power(size_m, self.n, SUSPECT)
        suspect = self.pose is not None and self.pose.p_value < SUSPECT
        return seen < SEEN or (suspect and seen < SURE)

    def finds_both(self, size_m: float, n: int) -> bool:
        return n >= FEWEST and min(self.mean_power(size_m, n), self.pose_power(size_m, n)) >= SURE


def _decide(
    rows: Floats, found: _Sizes, matters_m: float
) -> tuple[Verdict, str, Callable[[int], bool] | None]:
    """The verdict, why, and what number of trials would settle it (None: it is settled)."""
    n, length = len(rows), float(np.linalg.norm(rows.mean(axis=0)))
    enough = lambda trials: found.finds_both(matters_m, trials)  # noqa: E731
    of_size = f"{1e3 * matters_m:.0f} mm"
    if n < FEWEST:
        return "cannot_tell_yet", f"{n} trials decide nothing, {FEWEST} are the fewest", enough
    if found.pose is not None and found.pose.p_value < found.level:
        return "pose_dependent", "the miss changes with the pose of the gripper", None
    if found.mean.p_value < found.level:
        if found.pose_may_be(length):
            return (
                "cannot_tell_yet",
                f"the misses share {1e3 * length:.1f} mm, but too few trials rule out that they "
                "follow the pose",
                lambda trials: found.pose_power(length, trials, SUSPECT) >= SURE,
            )
        return "calibration", f"the misses share {1e3 * length:.1f} mm in one direction", None
    if enough(n):
        rest = "" if found.pose is None else f", nor a part of {of_size} that follows the pose"
        return "perception", f"scatter: no constant of {of_size}{rest} would have hidden", None
    return (
        "cannot_tell_yet",
        f"no cause shows, but one of {of_size} could hide in {n} trials with this scatter",
        enough,
    )


def _trials(n: int, settled: Callable[[int], bool]) -> int | None:
    """The fewest more trials that settle it, None beyond MOST; power only grows with trials."""
    total = bisect_left(range(MOST + 1), True, lo=n + 1, key=settled)
    return total - n if total <= MOST else None


def _test_pose(
    rows: Floats, poses: ArrayLike | None, columns: ArrayLike | None, level: float
) -> PoseTest | None:
    if columns is not None:
        if poses is not None:
            raise ValueError("columns: got poses too, want one of them")
        given = np.asarray(columns, dtype=np.float64)
        if given.ndim != 3 or given.shape[:2] != rows.shape or not np.isfinite(given).all():
            raise ValueError(f"columns: got shape {given.shape}, want finite ({len(rows)}, 3, k)")
        largest = np.sqrt((given**2).sum(axis=(1, 2)).mean())
        return pose_test(rows, given, {}, STILL * float(largest), level)
    if poses is None:
        return None
    T_base_gripper = check_poses("poses", poses)
    if len(T_base_gripper) != len(rows):
        raise ValueError(f"poses: got {len(T_base_gripper)}, want one for each of {len(rows)}")
    return pose_test(rows, pose_columns(T_base_gripper), GROUPS, STILL, level)


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
