"""Pairs of arm pose and board pose as `diagnose` handles them, and a fit that outliers hardly bend.

The residual of a pair is the twist (omega, v) from where the camera should see the board to where
it does, rad and m, in the camera's axes.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from coursekit.arm import pose_difference
from coursekit.arrays import Floats, NDArray
from coursekit.geometry import invert_transform, turned
from coursekit.hand_eye.closed_form import motions, rotation_by_axes
from coursekit.hand_eye.poses import Mount, by_X_and_Y, camera_board, carrier_stand, mean_pose
from coursekit.hand_eye.session import HandEyeSession

STEPS = 15
ARRIVED = 1e-7  # m and rad
BEYOND = 3.0  # times the usual residual: from there on a pair counts less and less
# Below this nobody's residuals are, whatever the arm: 0.005 deg and 0.02 mm.
LEAST_RAD, LEAST_M = np.radians(0.005), 2e-5
MEDIAN_3D = 1.5382  # the median length of three independent standard normal numbers


@dataclass(frozen=True, eq=False)
class Pairs:
    """T_base_gripper and T_camera_board (n, 4, 4); image (n, 6, 6): the covariance of the latter's
    twist as the image says, 0 where only poses are known; segment (n,): pairs with the same number
    share one Y; view, row (n,): the numbers of the image and of the arm pose in the session."""

    T_base_gripper: Floats
    T_camera_board: Floats
    mount: Mount
    image: Floats
    segment: NDArray[np.intp]
    view: NDArray[np.intp]
    row: NDArray[np.intp]

    @classmethod
    def of(cls, session: HandEyeSession) -> Pairs:
        """The pairs of a session as they were given."""
        n = len(session)
        image = np.zeros((n, 6, 6))
        if session.board_poses:
            image = np.stack([pose.covariance for pose in session.board_poses])
        return cls(
            session.T_base_gripper, session.T_camera_board.copy(), session.mount, image,
            np.zeros(n, int), np.arange(n), np.arange(n),
        )  # fmt: skip

    def __len__(self) -> int:
        return len(self.view)

    def keep(self, mask: NDArray[np.bool_]) -> Pairs:
        """The pairs where mask (n,) is true."""
        return Pairs(
            self.T_base_gripper[mask], self.T_camera_board[mask], self.mount, self.image[mask],
            self.segment[mask], self.view[mask], self.row[mask],
        )  # fmt: skip

    def scaled(self, factor: float) -> Pairs:
        """With a board that is `factor` times as large as it was taken for."""
        T, image = self.T_camera_board.copy(), self.image.copy()
        T[:, :3, 3] *= factor
        image[:, 3:] *= factor
        image[:, :, 3:] *= factor
        return replace(self, T_camera_board=T, image=image)

    def arm_scaled(self, factor: float) -> Pairs:
        """With the arm's translations times `factor`."""
        T = self.T_base_gripper.copy()
        T[:, :3, 3] *= factor
        return replace(self, T_base_gripper=T)

    def exchanged(self) -> Pairs:
        """Camera and arm with their parts exchanged, as eye-to-hand: C Y^-1 = X^-1 M."""
        M = carrier_stand(self.T_base_gripper, self.mount)
        return replace(
            self, T_base_gripper=self.T_camera_board, T_camera_board=M, mount="eye_to_hand"
        )

    def shifted(self, by: int) -> Pairs:
        """Each image with the arm pose `by` places further on; the ends fall off."""
        n = len(self)
        images = np.arange(max(0, -by), min(n, n - by))
        moved = self.keep(np.isin(np.arange(n), images))
        rows = images + by
        return replace(moved, T_base_gripper=self.T_base_gripper[rows], row=self.row[rows])


@dataclass(frozen=True, eq=False)
class Fit:
    """X (4, 4), Y (k, 4, 4) of the segments, and the residual twists (n, 6)."""

    pairs: Pairs
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
        """Its typical residual in words."""
        return f"{1e3 * self.shift_m:.1f} mm and {np.degrees(self.turn_rad):.2f} deg"

    def better_than(self, other: Fit) -> float:
        """How many times smaller the residuals are, the geometric mean of rotation and position."""
        turn = (other.turn_rad + LEAST_RAD) / (self.turn_rad + LEAST_RAD)
        shift = (other.shift_m + LEAST_M) / (self.shift_m + LEAST_M)
        return float(np.sqrt(turn * shift))


def robust_fit(pairs: Pairs, start: tuple[Floats, Floats] | None = None) -> Fit:
    """X and Y by least squares with Cauchy weights, from the closed form or a start (X, Y).

    The residuals' usual size, one for rotations and one for positions, comes from their medians.
    Source: Holland and Welsch, "Robust regression using iteratively reweighted least squares"
    (1977). Poses that leave X free get some X.
    """
    X, Y = start or _closed_form(pairs)
    fit = _at(pairs, X, Y)
    for _ in range(STEPS):
        rows, right = _weighted(fit)
        step: Floats = np.asarray(np.linalg.lstsq(rows, right, rcond=1e-10)[0], np.float64)
        X, Y = turned(fit.X, step[:6]), turned(fit.Y, step[6:].reshape(-1, 6))
        fit = _at(pairs, X, Y)
        if np.abs(step).max() < ARRIVED:
            break
    return fit


def _weighted(fit: Fit) -> tuple[Floats, Floats]:
    """The whitened, weighted columns (6 n, 6 + 6 k) and residuals (6 n,)."""
    usual = np.repeat([fit.turn_rad / MEDIAN_3D + LEAST_RAD, fit.shift_m / MEDIAN_3D + LEAST_M], 3)
    whitened = fit.twists / usual
    far = (whitened**2).sum(axis=1) / 6.0
    weight = np.sqrt(1.0 / (1.0 + far / BEYOND**2))
    rows = fit.columns / usual[:, None] * weight[:, None, None]
    return rows.reshape(len(whitened) * 6, -1), (whitened * weight[:, None]).ravel()


def _at(pairs: Pairs, X: Floats, Y: Floats) -> Fit:
    predicted = camera_board(pairs.T_base_gripper, X, Y[pairs.segment], pairs.mount)
    return Fit(pairs, X, Y, pose_difference(predicted, pairs.T_camera_board))


def _closed_form(pairs: Pairs) -> tuple[Floats, Floats]:
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
