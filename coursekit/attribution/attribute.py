"""From the misses of repeated grasps to what to repair: the calibration, the eyes, or the arm.

Three tests: is the mean miss zero, do the misses follow the pose, do they differ from place to
place by more than repeats in one place do. `decision` says what they add up to.
"""

from __future__ import annotations

import textwrap
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.attribution.decision import MOST, WIDE_M, Tests, Verdict, decide
from coursekit.attribution.mean_test import MeanTest, mean_test
from coursekit.attribution.place_test import SAME_M, PlaceTest, place_test
from coursekit.attribution.pose_test import GROUPS, STILL, PoseTest, pose_columns, pose_test
from coursekit.hand_eye.poses import check_poses

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]

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
