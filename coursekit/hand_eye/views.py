"""What images say of the board: where it is in each, and how well a pose explains the corners.

`board_poses` finds the board in each image by itself, with its covariance and the second pose that
a plane allows. `PixelViews` and `PoseViews` compare poses that somebody predicts with what was
seen: both come down to a gradient and an information matrix (7, 7) of (omega, v, log scale) of each
pose, and the refinement asks for nothing else.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from coursekit.arrays import Floats, Integers
from coursekit.boards import Board, Detection
from coursekit.boards.board import check_detections
from coursekit.geometry import Intrinsics, cross_matrix, pose_difference, undistort
from coursekit.intrinsics.derivatives import project_with_derivatives, scaled_inverse, twist_columns

CORNERS_OF_A_POSE = 6  # at least: an image with fewer fixes no pose worth having
REFINE_STEPS, REFINE_CHANGE = 50, 1e-14  # of `cv2.solvePnPRefineLM`; relative, at which it stops
HOPELESS = 20.0  # times the better start's sum of squares: such a start is not refined
# The two poses of a flat board are told apart where the worse one's sum of squares, in units of
# the better one's variance, is larger by more than this: odds of 1 to 4,000.
TOLD_APART = 2 * np.log(4000.0)
ONE_POSE_RAD = np.radians(0.1)  # nearer than this two fits are one pose that was reached twice


@dataclass(frozen=True, eq=False)
class PixelViews:
    """Corners: board points (N, 3) in m, pixels (N, 2), and where each view starts (n,).

    sigma_px: the standard deviation of one coordinate.
    """

    points: Floats
    pixels: Floats
    starts: Integers
    intrinsics: Intrinsics
    sigma_px: float = 1.0

    @classmethod
    def of(
        cls, detections: Sequence[Detection], board: Board, lens: Intrinsics, sigma_px: float = 1.0
    ) -> PixelViews:
        """The corners of detections, one view after the other."""
        starts = np.cumsum([0, *(len(seen.ids) for seen in detections[:-1])])
        ids = np.concatenate([seen.ids for seen in detections])
        pixels = np.concatenate([seen.pixels for seen in detections])
        return cls(board.points[ids], pixels, starts, lens, sigma_px)

    @cached_property
    def view(self) -> Integers:
        """The view (N,) of each corner."""
        counts = np.diff([*self.starts, len(self.pixels)])
        return np.repeat(np.arange(len(self.starts)), counts)

    def predicted(self, T_camera_board: Floats, scale: float = 1.0) -> tuple[Floats, Floats]:
        """Corners in the camera's frame and the same from the board's origin, (N, 3) each, m."""
        T = T_camera_board[self.view]
        arm = np.einsum("nij,nj->ni", T[:, :3, :3], scale * self.points)
        return arm + T[:, :3, 3], arm

    def residuals(self, T_camera_board: Floats, scale: float = 1.0) -> Floats:
        """Observed - predicted, (N, 2) px; infinite for a corner behind the camera."""
        at, _ = self.predicted(T_camera_board, scale)
        front = at[:, 2] > 0
        pixels = np.full((len(at), 2), np.inf)
        pixels[front] = project_with_derivatives(at[front], self.intrinsics)[0]
        return self.pixels - pixels

    def linear(self, T_camera_board: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
        """At poses (n, 4, 4): squares (n,), gradient (n, 7), information (n, 7, 7); whitened.

        The gradient is J'r and the information J'J of the twist (omega, v) of each pose and of
        the logarithm of the board's scale. Infinite squares for a board that reaches behind the
        camera.
        """
        at, arm = self.predicted(T_camera_board, scale)
        behind = np.logical_or.reduceat(at[:, 2] <= 0, self.starts)
        at[behind[self.view], 2] = 1.0
        predicted, _, by_point = project_with_derivatives(at, self.intrinsics)
        residuals = (self.pixels - predicted) / self.sigma_px
        columns = np.empty((len(at), 2, 7))
        columns[..., :6] = twist_columns(arm, by_point)
        columns[..., 6] = np.einsum("nij,nj->ni", by_point, arm)
        columns /= self.sigma_px
        turned_columns = np.swapaxes(columns, 1, 2)
        gradient = (turned_columns @ residuals[..., None])[..., 0]
        squares = np.add.reduceat((residuals**2).sum(axis=1), self.starts)
        return (
            np.where(behind, np.inf, squares),
            np.add.reduceat(gradient, self.starts),
            np.add.reduceat(turned_columns @ columns, self.starts),
        )


@dataclass(frozen=True, eq=False)
class PoseViews:
    """Poses T_camera_board (n, 4, 4) that somebody measured, with their information (n, 6, 6)."""

    poses: Floats
    information: Floats

    def linear(self, T_camera_board: Floats, scale: float) -> tuple[Floats, Floats, Floats]:
        """As `PixelViews.linear`: at poses (n, 4, 4), and in rad and m where that is in px.

        A board `scale` times larger than said shrinks all distances by as much.
        """
        predicted = T_camera_board.copy()
        predicted[:, :3, 3] /= scale
        residuals = pose_difference(predicted, self.poses)
        columns = np.zeros((len(self.poses), 6, 7))
        # log(exp(r) exp(-w)) = r - (1 + [r]x / 2 + ..) w
        columns[:, :3, :3] = np.eye(3) + cross_matrix(residuals[:, :3]) / 2
        columns[:, 3:, 3:6] = np.eye(3) / scale
        columns[:, 3:, 6] = -predicted[:, :3, 3]
        weighted = np.swapaxes(columns, 1, 2) @ self.information
        return (
            np.einsum("ni,nij,nj->n", residuals, self.information, residuals),
            np.einsum("nij,nj->ni", weighted, residuals),
            weighted @ columns,
        )


Views = PixelViews | PoseViews


# --- the board in one image ---


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Where the camera sees the board in one image.

    T_camera_board (4, 4), m. covariance (6, 6): of its twist (omega, v) in the camera's axes, rad
    and m, from the residuals of this image. rms_px: of the residual vectors (2-D). other: the
    second pose of a flat board, its normal mirrored about the line of sight, where the image cannot
    tell the two apart; None where it can.
    """

    T_camera_board: Floats
    covariance: Floats
    rms_px: float
    other: Floats | None = None


def board_poses(
    detections: Sequence[Detection], board: Board, intrinsics: Intrinsics
) -> list[BoardPose]:
    """The pose of a board in each image, by least squares on its corners.

    The iteration is OpenCV's (`solvePnPRefineLM`), from both poses that a plane allows. Raises
    ValueError that names the image for fewer than 6 corners, corners on a line or that the board
    does not have, an image of another size than the intrinsics', and pixels that belong to no ray.
    Source of the two starts: Collins and Bartoli, "Infinitesimal plane-based pose estimation"
    (2014), OpenCV's SOLVEPNP_IPPE.

    >>> board, lens = Board("checkerboard", (5, 4), 0.02), Intrinsics(640, 480, 500, 500, 320, 240)
    >>> pixels = [320, 240] + 500 * board.points[:, :2] / 0.4  # seen head on, from 0.4 m
    >>> seen = Detection(range(12), pixels, (640, 480))
    >>> board_poses([seen], board, lens)[0].T_camera_board[:3, 3].round(6) + 0.0
    array([0. , 0. , 0.4])
    """
    check_detections(detections, board, CORNERS_OF_A_POSE, size=intrinsics.size)
    starts = [
        _starts(seen, board, intrinsics, f"detections[{index}]")
        for index, seen in enumerate(detections)
    ]
    owners = np.repeat(np.arange(len(starts)), [len(both) for both in starts])
    owned = [detections[owner] for owner in owners.tolist()]
    views = PixelViews.of(owned, board, intrinsics)
    poses = np.concatenate(starts)
    at_start = views.linear(poses, 1.0)[0]
    for index, owner in enumerate(owners):
        if at_start[index] <= HOPELESS * at_start[owners == owner].min():
            poses[index] = _refined(poses[index], owned[index], board, intrinsics)
    squares, _, information = views.linear(poses, 1.0)
    found = []
    for index, seen in enumerate(detections):
        best, *worse = sorted(np.flatnonzero(owners == index), key=squares.__getitem__)
        variance = squares[best] / max(1, 2 * len(seen.ids) - 6)
        rivals = [poses[i] for i in worse if squares[i] < squares[best] + TOLD_APART * variance]
        turns = [np.linalg.norm(pose_difference(poses[best], T)[:3]) for T in rivals]
        other = rivals[0] if rivals and turns[0] > ONE_POSE_RAD else None
        covariance = variance * scaled_inverse(information[best, :6, :6])
        rms = float(np.sqrt(squares[best] / len(seen.ids)))
        found.append(BoardPose(poses[best], covariance, rms, other))
    return found


def nearer(boards: Sequence[BoardPose], expected: Floats) -> Floats:
    """Of the two poses that an image may allow the one that turns least from those expected.

    expected (n, 4, 4): T_camera_board, as is what is returned.
    """
    best = [pose.T_camera_board for pose in boards]
    other = [pose.T_camera_board if pose.other is None else pose.other for pose in boards]
    both = np.stack([best, other], axis=1)
    turns = np.linalg.norm(pose_difference(expected[:, None], both)[..., :3], axis=-1)
    return both[np.arange(len(both)), turns.argmin(axis=1)]


def _starts(seen: Detection, board: Board, intrinsics: Intrinsics, name: str) -> Floats:
    """The one or two poses (k, 4, 4) of IPPE."""
    rays = (seen.pixels - [intrinsics.cx, intrinsics.cy]) / [intrinsics.fx, intrinsics.fy]
    if intrinsics.dist is not None:
        rays, found = undistort(rays, intrinsics.dist)
        if not found.all():
            why = "are the intrinsics those of this camera, at this image size?"
            raise ValueError(f"{name}: has pixels where the distortion has no inverse; {why}")
    points = board.points[seen.ids]
    centre = points.mean(axis=0)  # without it IPPE loses digits on boards far from their origin
    count, rotations, translations, _ = cv2.solvePnPGeneric(
        points - centre, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    starts = np.tile(np.eye(4), (count, 1, 1))
    for T, rotation, translation in zip(starts, rotations, translations, strict=False):
        T[:3, :3] = cv2.Rodrigues(rotation)[0]
        T[:3, 3] = translation.ravel() - T[:3, :3] @ centre
    usable = np.isfinite(starts).all(axis=(1, 2))
    if not usable.any():
        raise ValueError(f"{name}: no pose of the board explains these corners")
    return starts[usable]


def _refined(T: Floats, seen: Detection, board: Board, intrinsics: Intrinsics) -> Floats:
    """The pose (4, 4) of least squares on the corners of one image that a start T leads to."""
    start = cv2.Rodrigues(T[:3, :3])[0], T[:3, 3:].copy()
    rotation, translation = cv2.solvePnPRefineLM(
        board.points[seen.ids], seen.pixels, intrinsics.K, intrinsics.dist, *start,
        (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, REFINE_STEPS, REFINE_CHANGE),
    )  # fmt: skip
    refined = np.eye(4)
    refined[:3, :3], refined[:3, 3] = cv2.Rodrigues(rotation)[0], translation.ravel()
    return refined


# --- distances between what is seen and what is expected ---


def rms_length(vectors: Floats) -> float:
    """Root mean square length of vectors (n, k)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def enlarged(T: Floats, scale: float) -> Floats:
    """Poses (n, 4, 4) of a board whose real size is `scale` times what they were measured with."""
    T = T.copy()
    T[:, :3, 3] *= scale
    return T


def view_residuals(corners: PixelViews, T: Floats, scale: float) -> tuple[Floats, ...]:
    """Observed - predicted of each view, (N_i, 2) px, with the board at poses T (n, 4, 4)."""
    return tuple(np.split(corners.residuals(T, scale), corners.starts[1:]))


def board_gap(
    seen: Floats, expected: Floats, board: Board | None, scale: float
) -> tuple[Floats, Floats]:
    """Distance between two poses (n, 4, 4) of a board, and its part along the line of sight, m.

    Root mean square over the corners, (n,) each; at the board's origin where no board is known.
    """
    points = np.zeros((1, 3)) if board is None else scale * board.points
    at, there = (
        points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        for T in (enlarged(seen, scale), expected)
    )
    sight = there / np.linalg.norm(there, axis=2, keepdims=True)
    along = np.sum((at - there) * sight, axis=2)
    gap = np.sum((at - there) ** 2, axis=2)
    return np.sqrt(np.mean(gap, axis=1)), np.sqrt(np.mean(along**2, axis=1))
