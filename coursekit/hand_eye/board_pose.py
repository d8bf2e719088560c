"""The pose of a board in one image, with its covariance and the second pose that a plane allows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.arm import pose_difference
from coursekit.geometry import undistort
from coursekit.hand_eye.poses import turned
from coursekit.hand_eye.views import PixelViews
from coursekit.intrinsics.derivatives import scaled_inverse

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.boards import Board, Detection
    from coursekit.geometry import Intrinsics

    Floats = NDArray[np.float64]

MIN_CORNERS = 6
STEPS, DAMPING, ARRIVED = 50, 1e-4, 1e-8  # of Levenberg and Marquardt; the last in px^2
HOPELESS = 20.0  # times the best start's sum of squares
# The two poses of a flat board are told apart where the worse one's sum of squares, in units of
# the better one's variance, is larger by more than this: odds of 1 to 4,000.
AMBIGUOUS = 2 * np.log(4000.0)
SAME_RAD = np.radians(0.1)  # nearer than this two fits are one pose that was reached twice


@dataclass(frozen=True, eq=False)
class BoardPose:
    """Where the camera sees the board in one image.

    T_camera_board (4, 4). covariance (6, 6): of its twist (omega, v) in the camera's axes, rad and
    m, from the residuals of this image. rms_px: of the residual vectors (2-D). other: the second
    pose of a flat board, its normal mirrored about the line of sight, where the image cannot tell
    the two apart (`ambiguous`); None where it can.
    """

    T_camera_board: Floats
    covariance: Floats
    rms_px: float
    other: Floats | None = None

    @property
    def ambiguous(self) -> bool:
        """Whether a second pose explains the image about as well."""
        return self.other is not None

    @property
    def sigma_mm(self) -> Floats:
        """Standard deviations (3,) of the position along the camera's axes, mm."""
        return 1e3 * np.sqrt(np.diag(self.covariance)[3:])

    @property
    def sigma_deg(self) -> Floats:
        """Standard deviations (3,) of the rotation about the camera's axes, deg."""
        return np.degrees(np.sqrt(np.diag(self.covariance)[:3]))


def board_pose(detection: Detection, board: Board, intrinsics: Intrinsics) -> BoardPose:
    """The pose of a board by least squares on its corners, from both starts that a plane allows.

    Raises ValueError for fewer than 6 corners, corners on a line or that the board does not have,
    an image of another size than the intrinsics', and pixels that belong to no ray.
    Source of the two starts: Collins and Bartoli, "Infinitesimal plane-based pose estimation"
    (2014), OpenCV's SOLVEPNP_IPPE.
    """
    return board_poses([detection], board, intrinsics, name="detection")[0]


def board_poses(
    detections: Sequence[Detection],
    board: Board,
    intrinsics: Intrinsics,
    name: str = "detections",
) -> list[BoardPose]:
    """`board_pose` of each image, all at once; errors name the image."""
    check_detections(detections, board, intrinsics, name)
    starts = [
        _starts(seen, board, intrinsics, f"{name}[{index}]")
        for index, seen in enumerate(detections)
    ]
    owners = np.repeat(np.arange(len(starts)), [len(both) for both in starts])
    views = PixelViews.of([detections[int(owner)] for owner in owners], board, intrinsics)
    poses, squares, information = _refined(views, np.concatenate(starts), owners)
    found = []
    for index, seen in enumerate(detections):
        mine = np.flatnonzero(owners == index)
        mine = mine[np.argsort(squares[mine], kind="stable")]
        best, variance = mine[0], squares[mine[0]] / max(1, 2 * len(seen.ids) - 6)
        other = None
        if len(mine) > 1 and squares[mine[1]] - squares[best] < AMBIGUOUS * variance:
            other = poses[mine[1]] if _apart(poses[best], poses[mine[1]]) else None
        rms = float(np.sqrt(squares[best] / len(seen.ids)))
        covariance = variance * scaled_inverse(information[best])
        found.append(BoardPose(poses[best], covariance, rms, other))
    return found


def check_detections(
    detections: Sequence[Detection], board: Board, intrinsics: Intrinsics, name: str = "detections"
) -> None:
    """A ValueError that names the first image whose corners fix no pose."""
    count = len(board.points)
    for index, seen in enumerate(detections):
        where = f"{name}[{index}]" + (f" ({seen.name})" if seen.name else "")
        if tuple(seen.size) != intrinsics.size:
            raise ValueError(f"{where}: is {seen.size} px, the intrinsics {intrinsics.size}")
        if len(seen.ids) < MIN_CORNERS:
            raise ValueError(f"{where}: has {len(seen.ids)} corners, want at least {MIN_CORNERS}")
        if not np.isfinite(seen.pixels).all():
            raise ValueError(f"{where}: has NaN or infinite pixels")
        if seen.ids.min() < 0 or seen.ids.max() >= count:
            raise ValueError(
                f"{where}: has corner {seen.ids.max()}, the board has 0 to {count - 1}; another "
                "board?"
            )
        flat = board.points[seen.ids, :2]
        spread = np.linalg.svd(flat - flat.mean(axis=0), compute_uv=False)
        if spread[1] < 1e-6 * spread[0]:
            raise ValueError(f"{where}: has all its corners on one line, which fixes no pose")


def _starts(seen: Detection, board: Board, intrinsics: Intrinsics, name: str) -> Floats:
    """The one or two poses (k, 4, 4) of IPPE."""
    import cv2

    rays = (seen.pixels - [intrinsics.cx, intrinsics.cy]) / [intrinsics.fx, intrinsics.fy]
    if intrinsics.dist is not None:
        rays, found = undistort(rays, intrinsics.dist)
        if not found.all():
            raise ValueError(f"{name}: has pixels where the distortion has no inverse")
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


def _refined(
    views: PixelViews, T: Floats, owners: NDArray[np.intp]
) -> tuple[Floats, Floats, Floats]:
    """Levenberg-Marquardt on each view by itself: poses, sums of squares (px^2), J'J (n, 6, 6).

    Of the starts of one owner, those that are hopelessly worse than the best stay where they are.
    """
    damping = np.full(len(T), DAMPING)
    squares, gradient, information = views.linear(T, 1.0)
    best = np.full(owners[-1] + 1, np.inf)
    np.minimum.at(best, owners, squares)
    active = squares <= HOPELESS * best[owners]
    for _ in range(STEPS):
        at = np.flatnonzero(active)
        N, g = information[at, :6, :6], gradient[at, :6]
        damped = N * (1.0 + damping[at, None, None] * np.eye(6))
        step = np.linalg.solve(damped, g[..., None])[..., 0]
        moving = np.sum(step * g, axis=1) > ARRIVED
        active[at[~moving]] = False
        at = at[moving]
        if not at.size:
            break
        trial = turned(T[at], step[moving])
        now, new_gradient, new_information = views.pick(at).linear(trial, 1.0)
        better = now <= squares[at]
        damping[at] *= np.where(better, 0.1, 10.0)
        at, new = at[better], np.flatnonzero(better)
        T[at], squares[at] = trial[new], now[new]
        gradient[at], information[at] = new_gradient[new], new_information[new]
    return T, squares, information[:, :6, :6]


def _apart(T: Floats, other: Floats) -> bool:
    return bool(np.linalg.norm(pose_difference(T, other)[:3]) > SAME_RAD)
