"""Pairs of arm pose and board pose as `diagnose` handles them, and a fit that outliers hardly bend.

The residual of a pair is the twist (omega, v) from where the camera should see the board to where
it does, rad and m, in the camera's axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from coursekit.arm import pose_difference
from coursekit.arrays import Floats, NDArray
from coursekit.geometry import invert_transform, turned
from coursekit.hand_eye.closed_form import motions, rotation_by_axes
from coursekit.hand_eye.poses import Mount, by_X_and_Y, camera_board, carrier_stand, mean_pose
from coursekit.hand_eye.session import HandEyeSession

ROBUST_STEPS, SMALLEST_STEP = 15, 1e-7  # m and rad
CAUCHY_WIDTH = 3.0  # times the usual residual: from there on a pair counts less and less
# Below this nobody's residuals are, whatever the arm: 0.005 deg and 0.02 mm.
LEAST_RAD, LEAST_M = np.radians(0.005), 2e-5
MEDIAN_3D = 1.5382  # the median length of three independent standard normal numbers


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
    mount: Mount
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
        arm, seen, image = (a[mask] for a in (self.T_base_gripper, self.T_camera_board, self.image))
        segment, view, row = (a[mask] for a in (self.segment, self.view, self.row))
        return PosePairs(arm, seen, self.mount, image, segment, view, row)

    @cached_property
    def fit(self) -> Fit:
        """`robust_fit` of these pairs."""
        return robust_fit(self)

    def scaled(self, factor: float) -> PosePairs:
        """With a board that is `factor` times as large as it was taken for."""
        T, image = self.T_camera_board.copy(), self.image.copy()
        T[:, :3, 3] *= factor
        image[:, 3:] *= factor
        image[:, :, 3:] *= factor
        return replace(self, T_camera_board=T, image=image)

    def arm_scaled(self, factor: float) -> PosePairs:
        """With the arm's translations times `factor`."""
        T = self.T_base_gripper.copy()
        T[:, :3, 3] *= factor
        return replace(self, T_base_gripper=T)

    def exchanged(self) -> PosePairs:
        """Camera and arm with their parts exchanged, as eye-to-hand: C Y^-1 = X^-1 M."""
        M = carrier_stand(self.T_base_gripper, self.mount)
        return replace(
            self, T_base_gripper=self.T_camera_board, T_camera_board=M, mount="eye_to_hand"
        )

    def shifted(self, by: int) -> PosePairs:
        """Each image with the arm pose `by` places further on; the ends fall off."""
        n = len(self)
        images = np.arange(max(0, -by), min(n, n - by))
        moved = self.keep(np.isin(np.arange(n), images))
        rows = images + by
        return replace(moved, T_base_gripper=self.T_base_gripper[rows], row=self.row[rows])


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
        columns = np.zeros((len(self.pairs), 6, 6 + 6 * len(self.Y)))
        for number, Y in enumerate(self.Y):
            mine = self.pairs.segment == number
            both = by_X_and_Y(self.pairs.T_base_gripper[mine], self.X, Y, self.pairs.mount)
            columns[mine, :, :6] = both[..., :6]
            columns[mine, :, 6 + 6 * number : 12 + 6 * number] = both[..., 6:]
        return columns

    def says(self) -> str:
        """Its typical residual in words: "0.4 mm and 0.05 deg"."""
        return f"{1e3 * self.shift_m:.1f} mm and {np.degrees(self.turn_rad):.2f} deg"

    def better_than(self, other: Fit) -> float:
        """How many times smaller the residuals are, the geometric mean of rotation and position."""
        turn = (other.turn_rad + LEAST_RAD) / (self.turn_rad + LEAST_RAD)
        shift = (other.shift_m + LEAST_M) / (self.shift_m + LEAST_M)
        return float(np.sqrt(turn * shift))


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
    predicted = camera_board(pairs.T_base_gripper, X, Y[pairs.segment], pairs.mount)
    return Fit(pairs, X, Y, pose_difference(predicted, pairs.T_camera_board))


def _closed_form(pairs: PosePairs) -> tuple[Floats, Floats]:
    """X from the pairs of the largest segment, Y of each segment."""
    largest = np.bincount(pairs.segment).argmax()
    main = pairs.keep(pairs.segment == largest)
    A, B = motions(main.T_base_gripper, main.T_camera_board, pairs.mount)
    X = np.eye(4)
    X[:3, :3] = rotation_by_axes(A, B)
    rows = (A[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (B[:, :3, 3] @ X[:3, :3].T - A[:, :3, 3]).ravel()
    X[:3, 3] = np.linalg.lstsq(rows, right, rcond=1e-10)[0]
    stand = invert_transform(carrier_stand(pairs.T_base_gripper, pairs.mount))
    places = stand @ X @ pairs.T_camera_board
    Y = [mean_pose(places[pairs.segment == k]) for k in range(pairs.segment.max() + 1)]
    return X, np.stack(Y)
