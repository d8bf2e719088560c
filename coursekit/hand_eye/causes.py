"""What the residuals of a hand-eye fit speak for: wrong squares, a late clock, and three more.

A session under examination is a set of pairs of arm pose and board pose (`PosePairs`). X and Y are
fitted to them so that outliers hardly bend them; the residual of a pair is the twist (omega, v)
from where the camera should see the board to where it does, rad and m, in the camera's axes.

The model that is searched for causes is that fit, of pairs with the causes found so far put right
(`MendedPairs`). Its residuals are taken as normal with the covariance of what careful people have:
the board pose's, as the image says, and the arm's (`arm.fk_covariance`), most of which all poses
share. Since arms differ the latter is multiplied by a factor that is fitted anew under each
hypothesis. Hypotheses are a scale, a delay, a board that moved between two poses, one pose that is
off, and the zero of a joint; the search is that of `coursekit.causes`.

Where the joint angles are not known, the arm's error is taken as independent from pose to pose, of
the size that the residuals have.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import product

import numpy as np
from scipy.linalg import block_diag

from coursekit.arm import Arm, fk_covariance
from coursekit.arrays import Floats, NDArray
from coursekit.causes import Hypothesis, Tested, likelihood_ratios
from coursekit.geometry import make_transform, pose_difference, turned
from coursekit.hand_eye import poses
from coursekit.hand_eye.closed_form import motions, rotation_by_axes, translation_half
from coursekit.hand_eye.session import HandEyeSession
from coursekit.hand_eye.views import enlarged

ROBUST_STEPS, SMALLEST_STEP = 15, 1e-7  # m and rad
CAUCHY_WIDTH = 3.0  # times the usual residual: from there on a pair counts less and less
# Below this nobody's residuals are, whatever the arm: 0.005 deg and 0.02 mm.
LEAST_RAD, LEAST_M = np.radians(0.005), 2e-5
MEDIAN_1D = 1.4826  # of the size of a standard normal number, one over
MEDIAN_3D = 1.5382  # the median length of three independent standard normal numbers
SCALE, LATE, ARM_ERROR = "wrong_square_size", "late_time_stamps", "arm_error"
SLIP, OUTLIER, STEADY = "slipping_board", "outlier_pose", "slow_drift"
SMOOTH = (SCALE, LATE, ARM_ERROR)  # one number that acts on all pairs
# At most 2 % of healthy sessions may get a finding, and five kinds of test at this level make
# 0.05 %; the rest is for arms whose errors are not quite normal.
PAIRS_LEVEL = 1e-4
# What careful people have, and no finding: squares measured with a ruler, a driver's own delay, a
# board that settles, a pose in which the arm still swings, a zero that a jig sets.
NORMAL_SIZE = {
    SCALE: 0.01, LATE: 5e-3, SLIP: 2e-3, OUTLIER: 5e-3, STEADY: 2e-3, ARM_ERROR: np.radians(0.6)
}  # fmt: skip
NORMAL_TURN_RAD = {SLIP: np.radians(0.5), OUTLIER: np.radians(1.0), STEADY: np.radians(0.25)}
# Times as much, where no image says how well it knows its board pose, or no joint angles what the
# arm may be wrong by: some pose of a healthy one is off by four times the typical error.
ROUGH_DATA = 3.0
# Times the typical residual, where no joint angles say which errors poses share: those of the arm
# then look like a slip of their own size.
OVER_USUAL = {SLIP: 2.5, OUTLIER: 4.0, STEADY: 1.0}
SCALE_WITHOUT_JOINTS = 0.02  # the arm's own shared errors can imitate that much of a scale
CAMERA_RAD, CAMERA_M = np.radians(0.02), 1e-4  # what imperfect intrinsics do to a board's pose
# Of the arm's stated errors, which poses share; one that is worse than the last is itself a
# mistake. And of the residuals as they are, for what is drawn anew at each pose.
ARM_FACTORS = (1.0, 2.0, 4.0)
OWN_FACTORS = (0.1, 0.2, 0.35, 0.6, 1.0, 1.5)
SHARES_ALIKE, NEAR = (0.0, 0.5, 0.9), 2.0  # of the own errors' variance; of two medians
OWN_SIZES = 4  # poses' worth of numbers that X, Y and the sizes along the axes take
AXIS_POSES = 5.0  # that the mean of three axes counts for, in the size along each
SHORTEST_SEGMENT = 3  # pairs on either side of a slip
FEWEST_PAIRS = 6  # below which one odd pose cannot be told from 24 odd numbers
MOST_OUTLIERS = 4  # at most one pair in as many


# --- pairs and their fit ---


@dataclass(frozen=True, eq=False)
class PosePairs:
    """Arm poses and board poses that belong together.

    T_base_gripper, T_camera_board (n, 4, 4), m. image (n, 6, 6): the covariance of the latter's
    twist as the image says, rad and m, 0 where only poses are known. segment (n,): pairs with the
    same number share one Y. view, row (n,): the numbers of the image and of the arm pose in the
    session.
    """

    T_base_gripper: Floats
    T_camera_board: Floats
    mount: poses.Mount
    image: Floats
    segment: NDArray[np.intp]
    view: NDArray[np.intp]
    row: NDArray[np.intp]

    @classmethod
    def of(cls, session: HandEyeSession) -> PosePairs:
        """The pairs of a session as they were given."""
        n = len(session)
        image = np.zeros((n, 6, 6))
        if session.board_poses:
            image = np.stack([pose.covariance for pose in session.board_poses])
        arm, seen, order = session.T_base_gripper, session.T_camera_board.copy(), np.arange(n)
        return cls(arm, seen, session.mount, image, np.zeros(n, int), order, order)

    def __len__(self) -> int:
        return len(self.view)

    def keep(self, mask: NDArray[np.bool_]) -> PosePairs:
        """The pairs where mask (n,) is true."""
        names = ("T_base_gripper", "T_camera_board", "image", "segment", "view", "row")
        return replace(self, **{name: getattr(self, name)[mask] for name in names})

    @cached_property
    def fit(self) -> Fit:
        """`robust_fit` of these pairs."""
        return robust_fit(self)

    def scaled(self, factor: float) -> PosePairs:
        """With a board that is `factor` times as large as it was taken for."""
        by, T = np.repeat([1.0, factor], 3), enlarged(self.T_camera_board, factor)
        return replace(self, T_camera_board=T, image=self.image * np.outer(by, by))

    def arm_scaled(self, factor: float) -> PosePairs:
        """With the arm's translations times `factor`."""
        return replace(self, T_base_gripper=enlarged(self.T_base_gripper, factor))

    def exchanged(self) -> PosePairs:
        """Camera and arm with their parts exchanged, as eye-to-hand: C Y^-1 = X^-1 M."""
        M = poses.carrier_stand(self.T_base_gripper, self.mount)
        return replace(
            self, T_base_gripper=self.T_camera_board, T_camera_board=M, mount="eye_to_hand"
        )

    def paired(self, rows: NDArray[np.intp]) -> PosePairs:
        """Each image with the arm pose rows (n,), without those whose row does not exist."""
        there = (rows >= 0) & (rows < len(self))
        T, row = self.T_base_gripper[rows[there]], self.row[rows[there]]
        return replace(self.keep(there), T_base_gripper=T, row=row)


@dataclass(frozen=True, eq=False)
class Fit:
    """X and Y of pairs, and what they leave over.

    X (4, 4), Y (k, 4, 4) of the segments, m. twists (n, 6): the residuals, rad and m.
    """

    pairs: PosePairs
    X: Floats
    Y: Floats
    twists: Floats

    @property
    def turn_rad(self) -> float:
        """The rotation of a typical residual: the median over the pairs."""
        return float(np.median(np.linalg.norm(self.twists[:, :3], axis=1)))

    @property
    def shift_m(self) -> float:
        """The displacement of a typical residual: the median over the pairs."""
        return float(np.median(np.linalg.norm(self.twists[:, 3:], axis=1)))

    @property
    def columns(self) -> Floats:
        """d predicted twists / d twists of X and of each segment's Y: (n, 6, 6 + 6 k)."""
        by_X, by_Y = np.split(self.by_X_and_Y, 2, axis=2)
        mine = np.eye(len(self.Y))[self.pairs.segment]
        each = mine[:, None, :, None] * by_Y[:, :, None]
        return np.concatenate([by_X, each.reshape(len(mine), 6, -1)], axis=2)

    @property
    def by_X_and_Y(self) -> Floats:
        """d predicted twists / d twists of X and of the Y that is each pair's, (n, 6, 12)."""
        pairs = self.pairs
        return poses.by_X_and_Y(pairs.T_base_gripper, self.X, self.Y[pairs.segment], pairs.mount)

    def says(self) -> str:
        """Its typical residual in words: "0.4 mm and 0.05 deg"."""
        return f"{1e3 * self.shift_m:.1f} mm and {np.degrees(self.turn_rad):.2f} deg"

    @property
    def size(self) -> float:
        """Of the residuals, the geometric mean of rotation and position, rad and m."""
        return float(np.sqrt((self.turn_rad + LEAST_RAD) * (self.shift_m + LEAST_M)))

    def better_than(self, other: Fit) -> float:
        """How many times smaller the residuals are, the geometric mean of rotation and position."""
        return other.size / self.size


def robust_fit(pairs: PosePairs, start: tuple[Floats, Floats] | None = None) -> Fit:
    """X and Y by least squares with Cauchy weights, from the closed form or a start (X, Y).

    start: X (4, 4) and Y (k, 4, 4) of the segments. The residuals' usual size, one for rotations
    and one for positions, comes from their medians. Poses that leave X free get some X.
    Source: Holland and Welsch, "Robust regression using iteratively reweighted least squares"
    (1977).
    """
    X, Y = start or _closed_form(pairs)
    fit = _at(pairs, X, Y)
    for _ in range(ROBUST_STEPS):
        usual = [fit.turn_rad / MEDIAN_3D + LEAST_RAD, fit.shift_m / MEDIAN_3D + LEAST_M]
        scale = 1.0 / np.repeat(usual, 3)
        far = ((fit.twists * scale) ** 2).sum(axis=1) / 6.0
        weight = scale / np.sqrt(1.0 + far / CAUCHY_WIDTH**2)[:, None]
        rows, right = fit.columns * weight[..., None], fit.twists * weight
        step = np.linalg.lstsq(rows.reshape(right.size, -1), right.ravel(), rcond=1e-10)[0]
        X, Y = turned(fit.X, step[:6]), turned(fit.Y, step[6:].reshape(-1, 6))
        fit = _at(pairs, X, Y)
        if np.abs(step).max() < SMALLEST_STEP:
            break
    return fit


def _at(pairs: PosePairs, X: Floats, Y: Floats) -> Fit:
    predicted = poses.camera_board(pairs.T_base_gripper, X, Y[pairs.segment], pairs.mount)
    return Fit(pairs, X, Y, pose_difference(predicted, pairs.T_camera_board))


def _closed_form(pairs: PosePairs) -> tuple[Floats, Floats]:
    """X from the pairs of the largest segment, Y of each segment."""
    largest = np.bincount(pairs.segment).argmax()
    main = pairs.keep(pairs.segment == largest)
    A, B = motions(main.T_base_gripper, main.T_camera_board, pairs.mount)
    R = rotation_by_axes(A, B)
    X = make_transform(R, translation_half(A, B, R))
    places = poses.stand_board(pairs.T_base_gripper, pairs.T_camera_board, X, pairs.mount)
    Y = [poses.mean_pose(places[pairs.segment == k]) for k in range(pairs.segment.max() + 1)]
    return X, np.stack(Y)


# --- causes ---


@dataclass(frozen=True, eq=False)
class MendedPairs:
    """Pairs with the causes found so far put right, and their fit.

    arm: whose joint angles they are; `ArmErrors` is normal for it. Of all pairs of the session,
    None where unknown: q (n, 6), the joint angles, rad, and velocity (n, 6), the gripper's twist
    rate when the image was taken, rad/s and m/s. scale: of the board; delay_s: of the arm poses;
    offsets (6,): of the joints, rad. smooth: cause and place of those that are fitted along from
    now on. odd: how many pairs were left out.
    """

    arm: Arm
    q: Floats | None
    velocity: Floats | None
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
        tests = likelihood_ratios(residuals, columns, hypotheses, self.covariances())
        # Sizes that come from the residuals themselves are too small by chance, most of few poses.
        n = len(self.fit.pairs)
        sure = max(n - OWN_SIZES, 1) / n
        return [replace(t, log_p=sure * t.log_p, strength=sure * t.strength) for t in tests]

    def matters(self, test: Tested) -> bool:
        """Whether the effect is larger than what careful people have."""
        normal, n = NORMAL_SIZE[test.cause], len(self.fit.pairs)
        if test.cause in SMOOTH:
            if test.cause == SCALE and self.q is None:
                normal = SCALE_WITHOUT_JOINTS
            return bool(abs(test.coefficients[0]) > normal)
        if test.cause == OUTLIER and self.odd >= (n + self.odd) // MOST_OUTLIERS:
            return False
        rough = 1.0 if self.fit.pairs.image.any() and self.q is not None else ROUGH_DATA
        usual = OVER_USUAL[test.cause] if self.q is None else 0.0
        least_turn = max(rough * NORMAL_TURN_RAD[test.cause], usual * self.fit.turn_rad)
        least_shift = max(rough * normal, usual * self.fit.shift_m)
        turn, shift = turn_and_shift(test)
        return shift > least_shift or turn > least_turn

    def accept(self, test: Tested) -> MendedPairs | None:
        """The data put right for a cause and fitted again; None where that does not fit better."""
        pairs, at, size = self.fit.pairs, test.at, float(test.coefficients[0])
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
        if test.cause == STEADY:
            effect = (test.hypothesis.columns @ test.coefficients).reshape(-1, 6)
            pairs = replace(pairs, T_camera_board=turned(pairs.T_camera_board, -effect))
        elif test.cause == SCALE:
            pairs = pairs.scaled(1.0 + size)
            after = replace(after, scale=self.scale * (1.0 + size))
        elif test.cause == LATE:
            assert self.velocity is not None
            pairs = _moved(pairs, -size * self.velocity[pairs.row])
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
        if self.velocity is not None:
            moved = np.einsum("nij,nj->ni", self._by_arm, self.velocity[pairs.row])
            found.append(Hypothesis(LATE, -moved.reshape(-1, 1)))
        if self.q is not None:
            turned_joint = (self._by_arm @ self._jacobian()).reshape(6 * n, 6)
            # The first joint turns the base and the last the gripper: so do X and Y.
            for joint in range(1, 5):
                column = turned_joint[:, joint : joint + 1]
                found.append(Hypothesis(ARM_ERROR, column, joint, tried=4))
        rows = np.arange(6 * n).reshape(n, 6)
        found += [Hypothesis(OUTLIER, np.eye(6), i, rows[i], tried=n) for i in range(n)]
        both = np.split(fit.by_X_and_Y, 2, axis=2)
        time = (pairs.view - pairs.view.mean()) / np.ptp(pairs.view)  # 1 over the whole session
        for place, columns in enumerate(both):
            steady = (time[:, None, None] * columns).reshape(-1, 6)
            found.append(Hypothesis(STEADY, steady, place, tried=2))
        later = {}
        for at in range(1, n):
            mine = np.flatnonzero(pairs.segment == pairs.segment[at])
            after = mine[mine >= at]
            if SHORTEST_SEGMENT <= len(after) <= len(mine) - SHORTEST_SEGMENT:
                later[at] = after
        for at, after in later.items():
            columns = both[1][after].reshape(-1, 6)
            found.append(Hypothesis(SLIP, columns, at, rows[after].ravel(), tried=len(later)))
        return found

    def covariances(self) -> Iterator[Floats]:
        """Of all residuals, (6 n, 6 n): for each factor of the arm's errors, and of each pose's."""
        pairs, n = self.fit.pairs, len(self.fit.pairs)
        image = block_diag(*pairs.image + np.diag(np.repeat([CAMERA_RAD**2, CAMERA_M**2], 3)))
        size, same_axis = self._usual.ravel(), np.eye(6)
        owns = [np.outer(size, size) * np.kron(alike, same_axis) for alike in self._alike()]
        arms = [np.zeros((6 * n, 6 * n))]
        if self.q is not None:
            errors = fk_covariance(self._joints(), arm=self.arm)
            shared = (self._by_arm @ errors.shared * errors.sigma).reshape(6 * n, -1)
            each = self._by_arm @ errors.each @ np.swapaxes(self._by_arm, 1, 2)
            arm = shared @ shared.T + block_diag(*each)
            arms = [factor**2 * arm for factor in ARM_FACTORS]
        for arm, own, factor in product(arms, owns, OWN_FACTORS):
            yield image + arm + factor**2 * own

    def _alike(self) -> Iterator[Floats]:
        """How alike the own errors of poses may be, correlations (n, n): those near each other are.

        A lens, a board's shape and an arm err by the pose, and neighbours in a table are often
        neighbours in space: then errors look like something that goes on in time.
        """
        seen = self.fit.pairs.T_camera_board
        apart = pose_difference(seen[:, None], seen[None]).reshape(len(seen), len(seen), 2, 3)
        apart = np.linalg.norm(apart, axis=-1)
        near = np.exp(-(apart / np.median(apart, axis=(0, 1))).sum(axis=-1) / NEAR)
        for share in SHARES_ALIKE:
            yield (1 - share) * np.eye(len(seen)) + share * near

    @property
    def _usual(self) -> Floats:
        """The typical residual of each pose along each axis (n, 6), rad and m, camera's axes.

        What images know less of is off by more than usual: bow and lens act as the noise does.
        """
        n, twists = len(self.fit.pairs), self.fit.twists
        squares = (MEDIAN_1D * np.median(np.abs(twists), axis=0)) ** 2
        common = np.repeat(squares.reshape(2, 3).mean(axis=1), 3)
        free = n / max(n - 2.0, 1.0)  # X and Y took two poses' worth
        usual = np.sqrt(free * (n * squares + AXIS_POSES * common) / (n + AXIS_POSES))
        usual = np.maximum(usual, np.repeat([LEAST_RAD, LEAST_M], 3))
        image = np.einsum("nii->ni", self.fit.pairs.image) + LEAST_M**2
        return usual * np.sqrt((1.0 + image / np.median(image, axis=0)) / 2.0)

    @cached_property
    def _by_arm(self) -> Floats:
        """d predicted twist / d the gripper's twist in the base's axes, (n, 6, 6)."""
        pairs, fit = self.fit.pairs, self.fit
        return poses.by_arm_twist(pairs.T_base_gripper, fit.X, fit.Y[pairs.segment], pairs.mount)

    def _joints(self) -> Floats:
        """The joint angles (n, 6) with their zeros put right, rad."""
        assert self.q is not None
        return self.q[self.fit.pairs.row] + self.offsets

    def _jacobian(self) -> Floats:
        return self.arm.jacobian(self._joints())


def turn_and_shift(test: Tested) -> tuple[float, float]:
    """How far a slip or an odd pose turns, rad, and moves, m; or a drift from first to last."""
    if test.cause == STEADY:
        effect = (test.hypothesis.columns @ test.coefficients).reshape(-1, 2, 3)
        turn, shift = np.sqrt(12.0 * (effect**2).sum(axis=2).mean(axis=0))
    else:
        turn, shift = np.linalg.norm(test.coefficients.reshape(2, 3), axis=1)
    return float(turn), float(shift)


def _moved(pairs: PosePairs, twists: Floats) -> PosePairs:
    """The pairs with their arm poses moved by twists (n, 6)."""
    return replace(pairs, T_base_gripper=turned(pairs.T_base_gripper, twists))
