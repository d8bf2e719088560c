"""What the residuals of a hand-eye fit speak for: wrong squares, a late clock, and three more.

The model is X and Y, fitted to the pairs with the causes found so far put right. Its residuals are
taken as normal with the covariance of what careful people have: the board pose's, as the image
says, and the arm's (`arm.fk_covariance`), most of which all poses share. Since arms differ the
latter is multiplied by a factor that is fitted anew under each hypothesis. Hypotheses are a scale,
a delay, a board that moved between two poses, one pose that is off, and the zero of a joint; the
search is that of `coursekit.causes`.

Where the joint angles are not known, the arm's error is taken as independent from pose to pose, of
the size that the residuals have.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from coursekit.arm import Arm, ArmErrors, fk_covariance
from coursekit.arrays import Floats
from coursekit.causes import CauseSearch, Hypothesis, Tested, likelihood_ratios, search
from coursekit.geometry import turned
from coursekit.hand_eye.pairs import LEAST_M, LEAST_RAD, MEDIAN_3D, Fit, PosePairs, robust_fit
from coursekit.hand_eye.poses import by_arm_twist

SCALE, LATE, ARM_ERROR = "wrong_square_size", "late_time_stamps", "arm_error"
SLIP, OUTLIER = "slipping_board", "outlier_pose"
SMOOTH = (SCALE, LATE, ARM_ERROR)  # one number that acts on all pairs
# At most 2 % of healthy sessions may get a finding, and five kinds of test at this level make
# 0.05 %; the rest is for arms whose errors are not quite normal.
_CHANCE_LEVEL = 1e-4
# What careful people have, and no finding: squares measured with a ruler, a driver's own delay, a
# board that settles, a pose in which the arm still swings, a zero that a jig sets.
NORMAL_SIZE = {SCALE: 0.01, LATE: 5e-3, SLIP: 2e-3, OUTLIER: 5e-3, ARM_ERROR: np.radians(0.6)}
NORMAL_TURN_RAD = {SLIP: np.radians(0.5), OUTLIER: np.radians(1.0)}
# Times as much, where no image says how well it knows its board pose, or no joint angles what the
# arm may be wrong by: some pose of a healthy one is off by four times the typical error.
ROUGH_DATA = 3.0
# Times the typical residual, where no joint angles say which errors poses share: those of the arm
# then look like a slip of their own size.
OVER_USUAL = {SLIP: 2.5, OUTLIER: 4.0}
SCALE_WITHOUT_JOINTS = 0.02  # the arm's own shared errors can imitate that much of a scale
CAMERA_RAD, CAMERA_M = np.radians(0.02), 1e-4  # what imperfect intrinsics do to a board's pose
# Of the arm's stated errors; one that is worse than the last is itself a mistake. A larger factor
# also drowns two bad poses, and lets a nonsensical scale explain what is left.
ARM_FACTORS = (1.0, 1.5, 2.0, 3.0, 5.0)
FACTORS_WITHOUT_JOINTS = (0.1, 0.2, 0.35, 0.6, 1.0, 1.5)  # of the residuals as they are
SHORTEST_SEGMENT = 3  # pairs on either side of a slip
FEWEST_PAIRS = 6  # below which one odd pose cannot be told from 24 odd numbers
MOST_OUTLIERS = 4  # at most one pair in as many


@dataclass(frozen=True, eq=False)
class Arms:
    """What is known of the arm besides its poses: for all pairs of the session.

    arm: whose joint angles they are; errors: what is normal for it, `ArmErrors` unless given.
    q (n, 6): joint angles, rad, None where unknown. velocity (n, 6): the gripper's twist rate when
    the image was taken, rad/s and m/s, None where unknown.
    """

    arm: Arm
    errors: ArmErrors | None = None
    q: Floats | None = None
    velocity: Floats | None = None


@dataclass(frozen=True, eq=False)
class MendedPairs:
    """Pairs with the causes found so far put right, and their fit.

    scale: of the board; delay_s: of the arm poses; offsets (6,): of the joints, rad. smooth: cause
    and place of those that are fitted along from now on. odd: how many pairs were left out.
    """

    arms: Arms
    fit: Fit
    scale: float = 1.0
    delay_s: float = 0.0
    offsets: Floats = field(default_factory=lambda: np.zeros(6))
    smooth: tuple[tuple[str, int], ...] = ()
    odd: int = 0

    def hypotheses(self) -> list[Hypothesis]:
        """What is suspected and was not put right."""
        if len(self.fit.pairs) < FEWEST_PAIRS:
            return []
        return [h for h in self._suspects if (h.cause, h.at) not in self.smooth]

    def tested(self, hypotheses: Sequence[Hypothesis]) -> list[Tested]:
        """Each hypothesis with its most likely size of the arm's errors."""
        residuals = self.fit.twists.ravel()
        along = [h.columns for h in self._suspects if (h.cause, h.at) in self.smooth]
        columns = np.hstack([self.fit.columns.reshape(len(residuals), -1), *along])
        return likelihood_ratios(residuals, columns, hypotheses, self.covariances())

    def matters(self, test: Tested) -> bool:
        """Whether the effect is larger than what careful people have."""
        normal, n = NORMAL_SIZE[test.cause], len(self.fit.pairs)
        if test.cause in SMOOTH:
            if test.cause == SCALE and self.arms.q is None:
                normal = SCALE_WITHOUT_JOINTS
            return bool(abs(test.coefficients[0]) > normal)
        if test.cause == OUTLIER and self.odd >= (n + self.odd) // MOST_OUTLIERS:
            return False
        rough = 1.0 if self.fit.pairs.image.any() and self.arms.q is not None else ROUGH_DATA
        usual = OVER_USUAL[test.cause] if self.arms.q is None else 0.0
        least_turn = max(rough * NORMAL_TURN_RAD[test.cause], usual * self.fit.turn_rad)
        least_shift = max(rough * normal, usual * self.fit.shift_m)
        turn, shift = turn_and_shift(test)
        return shift > least_shift or turn > least_turn

    def accept(self, test: Tested) -> MendedPairs | None:
        """The data put right for a cause and fitted again; None where that does not fit better."""
        pairs, arms, at, size = self.fit.pairs, self.arms, test.at, float(test.coefficients[0])
        if test.cause == OUTLIER:
            left = pairs.keep(np.arange(len(pairs)) != at)
            return replace(self, fit=left.fit, odd=self.odd + 1)
        if test.cause == SLIP:
            segment, Y = pairs.segment.copy(), self.fit.Y
            moved = turned(Y[segment[at]], test.coefficients)
            segment[(segment == segment[at]) & (np.arange(len(pairs)) >= at)] = len(Y)
            start = (self.fit.X, np.concatenate([Y, moved[None]]))
            return replace(self, fit=robust_fit(replace(pairs, segment=segment), start))
        after = replace(self, smooth=(*self.smooth, (test.cause, at)))
        if test.cause == SCALE:
            pairs = pairs.scaled(1.0 + size)
            after = replace(after, scale=self.scale * (1.0 + size))
        elif test.cause == LATE:
            assert arms.velocity is not None
            pairs = _moved(pairs, -size * arms.velocity[pairs.row])
            after = replace(after, delay_s=self.delay_s + size)
        else:
            change = size * np.eye(6)[at]
            pairs = _moved(pairs, self._jacobian() @ change)
            after = replace(after, offsets=self.offsets + change)
        fit = pairs.fit
        return replace(after, fit=fit) if fit.better_than(self.fit) > 1.0 else None

    @cached_property
    def _suspects(self) -> list[Hypothesis]:
        """Every hypothesis, the smooth ones that were accepted too."""
        fit, pairs, n = self.fit, self.fit.pairs, len(self.fit.pairs)
        scale = np.zeros((n, 6))
        scale[:, 3:] = -pairs.T_camera_board[:, :3, 3]
        found = [Hypothesis(SCALE, scale.reshape(-1, 1))]
        if self.arms.velocity is not None:
            moved = np.einsum("nij,nj->ni", self._by_arm, self.arms.velocity[pairs.row])
            found.append(Hypothesis(LATE, -moved.reshape(-1, 1)))
        if self.arms.q is not None:
            turned_joint = (self._by_arm @ self._jacobian()).reshape(6 * n, 6)
            # The first joint turns the base and the last the gripper: so do X and Y.
            for joint in range(1, 5):
                column = turned_joint[:, joint : joint + 1]
                found.append(Hypothesis(ARM_ERROR, column, joint, tried=4))
        rows = np.arange(6 * n).reshape(n, 6)
        found += [Hypothesis(OUTLIER, np.eye(6), i, rows[i], tried=n) for i in range(n)]
        by_Y = fit.columns[:, :, 6:].reshape(n, 6, -1, 6).sum(axis=2)
        later = {}
        for at in range(1, n):
            mine = np.flatnonzero(pairs.segment == pairs.segment[at])
            after = mine[mine >= at]
            if SHORTEST_SEGMENT <= len(after) <= len(mine) - SHORTEST_SEGMENT:
                later[at] = after
        for at, after in later.items():
            columns = by_Y[after].reshape(-1, 6)
            found.append(Hypothesis(SLIP, columns, at, rows[after].ravel(), tried=len(later)))
        return found

    def covariances(self) -> Iterator[Floats]:
        """Of all residuals, (6 n, 6 n), for each factor of the arm's errors."""
        pairs, n = self.fit.pairs, len(self.fit.pairs)
        image = _diagonal(pairs.image + np.diag(np.repeat([CAMERA_RAD**2, CAMERA_M**2], 3)))
        if self.arms.q is not None:
            errors = fk_covariance(self._joints(), self.arms.errors, self.arms.arm)
            shared = (self._by_arm @ errors.shared * errors.sigma).reshape(6 * n, -1)
            each = self._by_arm @ errors.each @ np.swapaxes(self._by_arm, 1, 2)
            arm = shared @ shared.T + _diagonal(each)
        else:
            turn = max(self.fit.turn_rad / MEDIAN_3D, LEAST_RAD)
            shift = max(self.fit.shift_m / MEDIAN_3D, LEAST_M)
            arm = np.diag(np.tile(np.repeat([turn**2, shift**2], 3), n))
        for factor in FACTORS_WITHOUT_JOINTS if self.arms.q is None else ARM_FACTORS:
            yield image + factor**2 * arm

    @cached_property
    def _by_arm(self) -> Floats:
        """d predicted twist / d the gripper's twist in the base's axes, (n, 6, 6)."""
        pairs = self.fit.pairs
        by_arm = np.empty((len(pairs), 6, 6))
        for number, Y in enumerate(self.fit.Y):
            mine = pairs.segment == number
            by_arm[mine] = by_arm_twist(pairs.T_base_gripper[mine], self.fit.X, Y, pairs.mount)
        return by_arm

    def _joints(self) -> Floats:
        """The joint angles (n, 6) with their zeros put right, rad."""
        assert self.arms.q is not None
        return self.arms.q[self.fit.pairs.row] + self.offsets

    def _jacobian(self) -> Floats:
        return self.arms.arm.jacobian(self._joints())


def search_pairs(pairs: PosePairs, arms: Arms) -> CauseSearch[MendedPairs]:
    """The causes that the residuals of pairs speak for, the strongest first."""
    return search(MendedPairs(arms, pairs.fit), _CHANCE_LEVEL)


def turn_and_shift(test: Tested) -> tuple[float, float]:
    """How far a slip or an odd pose turns, rad, and moves, m."""
    turn, shift = np.linalg.norm(test.coefficients.reshape(2, 3), axis=1)
    return float(turn), float(shift)


def _diagonal(blocks: Floats) -> Floats:
    """(n, 6, 6) along the diagonal of (6 n, 6 n)."""
    n = len(blocks)
    full = np.zeros((n, 6, n, 6))
    full[np.arange(n), :, np.arange(n)] = blocks
    return full.reshape(6 * n, 6 * n)


def _moved(pairs: PosePairs, twists: Floats) -> PosePairs:
    """The pairs with their arm poses moved by twists (n, 6)."""
    return replace(pairs, T_base_gripper=turned(pairs.T_base_gripper, twists))
