"""What a camera sees of a board, and the pose that aims at a place and still shows it.

    seen = projected into the image, so far inside its border, on this side of the lens's fold

Past its fold a distortion bends rays back into the image: a corner there has a pixel, but none that
belongs to its ray. `seen` answers corner by corner; `slide_into_view` slides a board from where it
was aimed at towards the middle of the image until enough of it is seen.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from coursekit.arrays import Bools, Floats
from coursekit.geometry import Intrinsics, deproject, fold_radius, project

BORDER_PX = 6.0  # a corner nearer to the image's border has no room for its refinement window


def seen(
    points: Floats, T_camera_board: Floats, lens: Intrinsics, border_px: float | Floats = BORDER_PX
) -> Bools:
    """Which points of a board the camera sees from each pose, (..., N).

    points (N, 3): in the board's frame, m. T_camera_board (..., 4, 4): m. border_px: how far from
    the image's border a pixel must lie, one number or (2,) for columns and rows.

    >>> lens = Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
    >>> T = np.eye(4)
    >>> T[2, 3] = 0.5  # straight ahead
    >>> seen(np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]), T, lens).tolist()
    [True, False]
    """
    R, t = T_camera_board[..., :3, :3], T_camera_board[..., None, :3, 3]
    inside = points @ np.swapaxes(R, -1, -2) + t
    pixels = project(inside, lens.K, lens.dist)
    last = np.array(lens.size) - 1 - border_px
    found = np.asarray(((pixels >= border_px) & (pixels <= last)).all(axis=-1))
    if lens.dist is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.hypot(inside[..., 0], inside[..., 1]) / inside[..., 2]
        found &= slope < fold_radius(lens.dist)
    return found


def slide_into_view(
    aim_px: Floats,
    distance_m: float,
    R: Floats,
    middle: Floats,
    lens: Intrinsics,
    enough: Callable[[Floats], bool],
    steps: int = 21,
) -> Floats | None:
    """The pose T_camera_board (4, 4) nearest to an aim that shows enough of a board, or None.

    aim_px (2,): where the board's middle should be in the image. It goes on to the middle of the
    image in so many steps, at the same distance_m (Z of the board's middle) and orientation R
    (3, 3), until `enough` says yes to a pose. middle (3,): of the board, in its own frame, m.

    >>> lens = Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
    >>> corner = np.zeros((1, 3))
    >>> whole = lambda T: bool(seen(corner, T, lens, border_px=100).all())
    >>> T = slide_into_view(np.array([0.0, 240.0]), 0.5, np.eye(3), np.zeros(3), lens, whole)
    >>> project(T[:3, 3], lens.K).round().tolist()
    [112.0, 240.0]
    """
    centre = (np.array(lens.size) - 1) / 2
    shares = np.linspace(1.0, 0.0, steps)[:, None]
    rays = deproject(centre + shares * (aim_px - centre), np.ones(steps), lens.K, lens.dist)
    T = np.eye(4)
    T[:3, :3] = R
    for ray in rays[np.isfinite(rays).all(axis=1)]:
        T[:3, 3] = distance_m * ray - R @ middle
        if enough(T):
            return T
    return None
