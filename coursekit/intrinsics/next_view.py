"""Which view to take next: the one that would shrink the worst projection uncertainty most.

A view that has not been taken has no residuals, but its Jacobian is known: where the board would
be and what the fitted camera would see of it. Its information is added to that of the views so
far, and the uncertainty that would follow is propagated; nothing is fitted again.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.geometry import Intrinsics, check_transform, deproject, fold_radius, project
from coursekit.intrinsics.derivatives import (
    NormalEquations,
    project_with_derivatives,
    twist_columns,
)
from coursekit.intrinsics.uncertainty import (
    Information,
    image_grid,
    projection_columns,
    worst_direction,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from coursekit.boards import Board
    from coursekit.intrinsics.fit import IntrinsicsResult

    Floats = NDArray[np.float64]

RANGES_M = (0.45, math.inf)
GRID = (7, 9)
SEEN_SHARE = 0.4  # of a ChArUco board's corners; a checkerboard is found whole or not at all
BORDER_PX = 8.0  # a corner nearer to the border has no room for its refinement window
FILLS = (0.9, 0.6, 0.4)  # of the image's width by the board, facing the camera
AIMS = (0.05, 0.5, 0.95)  # of the image's width and height, for the board's middle
TILTS_DEG = (20.0, 40.0)
AZIMUTHS = 8
SLIDES = 11


@dataclass(frozen=True, eq=False, repr=False)
class NextView:
    """The best of some candidate views.

    index: of the best. T_camera_board (4, 4): its pose. worst_px (m,): the largest standard
    deviation of projection over the image that would be left with each candidate; infinite where
    the board would not be detected. now_px: the same without any.
    """

    index: int
    T_camera_board: Floats
    worst_px: Floats
    now_px: float

    def __repr__(self) -> str:
        return (
            f"candidate {self.index} of {len(self.worst_px)}: the worst sigma of projection would "
            f"go\nfrom {self.now_px:.3f} to {self.worst_px[self.index]:.3f} px"
        )


def next_view(
    result: IntrinsicsResult,
    candidates: ArrayLike | None = None,
    range_m: float | Sequence[float] = RANGES_M,
) -> NextView:
    """Which candidate view would shrink the worst projection uncertainty most.

    candidates (m, 4, 4): T_camera_board; None takes `candidate_views`. range_m: at which the
    uncertainty counts, m; of several the worst. Infinity among them keeps a focal length that
    suits only the boards' distance from passing for a good one.
    Raises ValueError for candidates that are no poses, and when none shows enough of the board.
    """
    board, lens = result.board, result.intrinsics
    poses = candidate_views(board, lens) if candidates is None else candidates
    poses = check_transform("candidates", poses)
    if poses.ndim != 3:
        raise ValueError(f"candidates: got shape {poses.shape}, want (m, 4, 4)")
    ranges = [range_m] if isinstance(range_m, (int, float)) else list(range_m)
    columns = _columns(result, ranges)
    now = Information.of(result.equations)
    worst = np.full(len(poses), np.inf)
    for index, T in enumerate(poses):
        ids = visible(board, lens, T)
        if _enough(board, ids):
            worst[index] = _worst(now + _information(result, T, ids), columns, result.sigma_px)
    if not np.isfinite(worst).any():
        raise ValueError("candidates: none of them shows enough of the board")
    best = int(np.argmin(worst))
    return NextView(best, poses[best], worst, _worst(now, columns, result.sigma_px))


def candidate_views(board: Board, intrinsics: Intrinsics) -> Floats:
    """Poses (m, 4, 4) of the board worth considering, all with enough of it in the image.

    Three distances, nine places in the image, upright or tilted by 20 and 40 deg to eight sides. A
    place where too little of the board would be seen is slid towards the image's middle.
    """
    lens = intrinsics
    turns = [np.eye(3)]
    turns += [
        _tilt(math.radians(tilt), 2 * math.pi * k / AZIMUTHS)
        for tilt in TILTS_DEG
        for k in range(AZIMUTHS)
    ]
    poses = []
    for u in AIMS:
        for v in AIMS:
            rays = _rays_to_the_middle(
                lens, np.array([u * (lens.width - 1), v * (lens.height - 1)])
            )
            for fill in FILLS:
                distance = lens.fx * board.size_m[0] / (fill * lens.width)
                poses += [_slid(board, lens, R, distance * rays) for R in turns]
    return np.stack([T for T in poses if T is not None])


def visible(board: Board, intrinsics: Intrinsics, T_camera_board: Floats) -> NDArray[np.intp]:
    """The ids of the corners (N,) that a view at this pose would show, clear of the border."""
    at = board.points @ T_camera_board[:3, :3].T + T_camera_board[:3, 3]
    pixels = project(at, intrinsics.K, intrinsics.dist)
    inside = (pixels >= BORDER_PX) & (pixels <= np.array(intrinsics.size) - 1 - BORDER_PX)
    # beyond its fold a distortion brings points back into the image
    before_fold = np.hypot(at[:, 0], at[:, 1]) < fold_radius(np.array(intrinsics.coeffs)) * at[:, 2]
    return np.flatnonzero(inside.all(axis=1) & before_fold)


def _enough(board: Board, ids: NDArray[np.intp]) -> bool:
    share = 1.0 if board.kind == "checkerboard" else SEEN_SHARE
    return len(ids) >= share * len(board.points)


def _rays_to_the_middle(lens: Intrinsics, aim: Floats) -> Floats:
    """Points at Z = 1 on the way from a pixel (2,) to the image's middle, (SLIDES, 3)."""
    middle = np.array([lens.width - 1, lens.height - 1]) / 2
    pixels = middle + np.linspace(1.0, 0.0, SLIDES)[:, None] * (aim - middle)
    rays = deproject(pixels, np.ones(SLIDES), lens.K, lens.dist)
    return rays[np.isfinite(rays).all(axis=1)]


def _slid(board: Board, lens: Intrinsics, R: Floats, places: Floats) -> Floats | None:
    """The pose with the board's middle at the first of `places` that shows enough of it."""
    T = np.eye(4)
    T[:3, :3] = R @ np.diag([1.0, -1.0, -1.0]) if board.old_origin else R
    for place in places:
        T[:3, 3] = place - T[:3, :3] @ board.points.mean(axis=0)
        if _enough(board, visible(board, lens, T)):
            return T
    return None


def _tilt(angle: float, azimuth: float) -> Floats:
    from scipy.spatial.transform import Rotation

    axis = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    return Rotation.from_rotvec(angle * axis).as_matrix()


def _information(result: IntrinsicsResult, T: Floats, ids: NDArray[np.intp]) -> Information:
    """What a view at this pose would add; columns of `extra` are left at zero."""
    at = result.points[ids] @ T[:3, :3].T + T[:3, 3]
    _, by_parameter, by_point = project_with_derivatives(at, result.intrinsics)
    shared = np.zeros((2 * len(ids), result.equations.shared.shape[1]))
    shared[:, : len(result.names)] = (by_parameter @ result.selection).reshape(2 * len(ids), -1)
    pose = twist_columns(at, by_point).reshape(-1, 6)
    return Information.of(NormalEquations(shared, (pose,), np.zeros(2 * len(ids))))


def _columns(result: IntrinsicsResult, ranges: Sequence[float]) -> Floats:
    """d pixel / d (shared parameters, motion) over the image at all ranges, (M, 2, g + 6)."""
    grid = image_grid(result.intrinsics, GRID).reshape(-1, 2)
    p, extra = len(result.names), len(result.extra)
    columns = np.concatenate([
        projection_columns(result.intrinsics, grid, r, result.selection) for r in ranges
    ])  # fmt: skip
    return np.insert(columns, [p] * extra, 0.0, axis=-1)


def _worst(information: Information, columns: Floats, sigma_px: float) -> float:
    covariance = sigma_px**2 * information.covariance()
    return float(worst_direction(columns @ covariance @ np.swapaxes(columns, -1, -2)).max())
