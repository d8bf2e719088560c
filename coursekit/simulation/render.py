"""The exact image of a scene: depth and box at every pixel centre, and a readable picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.geometry import (
    Intrinsics,
    check_transform,
    deproject,
    invert_transform,
    pixel_grid,
)
from coursekit.simulation.scenes import TEXTURES, Box, Scene

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

LAMP_M = np.array([-0.25, -0.40, -0.10])  # beside the camera, in its frame


@dataclass(frozen=True, eq=False)
class RenderResult:
    """What `render` returns.

    depth_m (H, W) float64: Z in the camera frame at the pixel's centre, m, 0 where nothing is hit.
    object_index (H, W) int16: which box of the scene, -1 for none. color (H, W, 3) uint8: RGB.
    """

    depth_m: NDArray[np.float64]
    object_index: NDArray[np.int16]
    color: NDArray[np.uint8]


def render(
    scene: Scene, intrinsics: Intrinsics, T_scene_camera: ArrayLike | None = None
) -> RenderResult:
    """The image of a scene by exact ray casting, without noise.

    T_scene_camera (4, 4): the camera's pose, camera frame to scene frame; None puts the camera at
    the scene's origin. Coefficients of `intrinsics` are Brown-Conrady in OpenCV's sense; a pixel
    that they give no ray hits nothing. Depth and index are exact at pixel centres, colour is the
    mean of 2x2 rays with Lambert's law, a lamp beside the camera and its shadows.
    Raises ValueError for a wrong argument and for a camera inside a box.
    """
    from coursekit.simulation import raycast  # numba takes half a second to import

    check_scene(scene)
    if not isinstance(intrinsics, Intrinsics):
        raise ValueError(f"intrinsics: got {type(intrinsics).__name__}, want Intrinsics")
    boxes = box_table(scene, T_scene_camera)
    width, height = intrinsics.size
    depth, index = np.empty((height, width)), np.empty((height, width), np.int16)
    raycast.render_depth(boxes, rays(intrinsics, pixel_grid(width, height)), depth, index)
    color = np.empty((height, width, 3), np.uint8)
    raycast.render_color(
        boxes,
        np.array([box.color for box in scene]).reshape(-1, 3),
        np.array([TEXTURES.index(box.texture) for box in scene], np.int64),
        rays(intrinsics, pixel_grid(width + 1, height + 1) - 0.5),
        LAMP_M,
        1.0 / intrinsics.fx,
        color,
    )
    return RenderResult(depth, index, color)


def rays(intrinsics: Intrinsics, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """The points at Z = 1 m behind pixels (H, W, 2): (H, W, 3), NaN where there is none."""
    return deproject(pixels, np.ones(pixels.shape[:2]), intrinsics.K, intrinsics.dist)


def box_table(scene: Scene, T_scene_camera: ArrayLike | None) -> NDArray[np.float64]:
    """The boxes as `raycast` wants them, (N, 15), in the camera frame.

    Raises ValueError for a camera inside a box.
    """
    T = check_transform("T_scene_camera", np.eye(4) if T_scene_camera is None else T_scene_camera)
    if T.shape != (4, 4):
        raise ValueError(f"T_scene_camera: got shape {T.shape}, want one (4, 4) transform")
    T_camera_scene = invert_transform(T)
    boxes = np.empty((len(scene), 15))
    for row, box in zip(boxes, scene, strict=True):
        T_camera_box = T_camera_scene @ box.T_scene_box
        row[:3], row[3:6], row[6:] = T_camera_box[:3, 3], box.size_m / 2, T_camera_box[:3, :3].flat
        if (np.abs(invert_transform(T_camera_box)[:3, 3]) < box.size_m / 2).all():
            raise ValueError(f"T_scene_camera: the camera is inside the box {box.name!r}")
    return boxes


def check_scene(scene: Scene) -> None:
    """Raises ValueError for anything but a tuple or list of Box."""
    if not isinstance(scene, (tuple, list)) or not all(isinstance(box, Box) for box in scene):
        raise ValueError(f"scene: got {scene!r}, want a tuple of Box, e.g. tabletop()")
