"""What stands in front of the simulated camera: boxes with a size, a pose, a colour, a texture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.geometry import check_transform, make_transform

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

TEXTURES = ("plain", "grid", "wood")

WALL_PAINT = (0.86, 0.87, 0.84)
MAPLE = (0.80, 0.66, 0.48)
ALUMINIUM = (0.67, 0.69, 0.72)
ORANGE = (230 / 255, 159 / 255, 0.0)  # of the Okabe-Ito palette, safe for the colour-blind

BLOCK_M = 0.060
CUBE_M = 0.025
TABLE_THICK_M = 0.025


@dataclass(frozen=True, eq=False)
class Box:
    """A solid box centred on its own frame, its edges along the frame's axes.

    size_m (3,): edge lengths, m. T_scene_box (4, 4): box frame to scene frame.
    color: red, green, blue, each 0..1. texture: "plain"; "grid", faint lines every 100 mm; or
    "wood", planks along the box's z axis. Raises ValueError for anything else.
    """

    name: str
    size_m: NDArray[np.float64]
    T_scene_box: NDArray[np.float64]
    color: tuple[float, float, float]
    texture: str = "plain"

    def __post_init__(self) -> None:
        size = _three_numbers("size_m", self.size_m)
        if (size <= 0).any():
            raise ValueError(f"size_m: got {size.tolist()}, want three positive lengths in m")
        color = _three_numbers("color", self.color)
        if (color < 0).any() or (color > 1).any():
            raise ValueError(f"color: got {color.tolist()}, want red, green, blue from 0 to 1")
        if self.texture not in TEXTURES:
            raise ValueError(f"texture: got {self.texture!r}, want one of {', '.join(TEXTURES)}")
        T = check_transform("T_scene_box", self.T_scene_box).copy()
        if T.shape != (4, 4):
            raise ValueError(f"T_scene_box: got shape {T.shape}, want one (4, 4) transform")
        size.flags.writeable = T.flags.writeable = False
        object.__setattr__(self, "size_m", size)
        object.__setattr__(self, "T_scene_box", T)
        object.__setattr__(self, "color", tuple(color.tolist()))


Scene = tuple[Box, ...]


def tabletop(distance_m: float = 0.45, wall_behind_m: float = 0.50) -> Scene:
    """A wall, a table, a 60 mm block standing on it and a 25 mm cube beside the block.

    distance_m: Z of the block's front face, m; the face is parallel to the image plane of a camera
    at the scene's origin, its centre on the optical axis. wall_behind_m: from that face to the
    wall, m, at least 0.10. Returns the four boxes, in this order: "wall", "table",
    "60 mm block", "25 mm cube". Raises ValueError for a distance that is not positive.
    """
    distance, behind = _number("distance_m", distance_m), _number("wall_behind_m", wall_behind_m)
    if distance <= 0:
        raise ValueError(f"distance_m: got {distance}, want a positive number of metres")
    if behind < 0.10:
        raise ValueError(f"wall_behind_m: got {behind}, want at least 0.10 m, behind the cube")
    table_y, table_front, table_back = (
        BLOCK_M / 2,
        min(0.20, 0.6 * distance),
        distance + behind - 0.02,
    )
    wall_width, wall_height = 8.0 * (distance + behind), 5.0 * (distance + behind)
    turned = Rotation.from_euler("y", 28, degrees=True)
    return (
        _box(
            "wall",
            (wall_width, wall_height, 0.10),
            (0.0, 0.0, distance + behind + 0.05),
            WALL_PAINT,
            texture="grid",
        ),
        _box(
            "table",
            (2.00, TABLE_THICK_M, table_back - table_front),
            (0.0, table_y + TABLE_THICK_M / 2, (table_back + table_front) / 2),
            MAPLE,
            texture="wood",
        ),
        _box(
            "60 mm block",
            (BLOCK_M, BLOCK_M, BLOCK_M),
            (0.0, table_y - BLOCK_M / 2, distance + BLOCK_M / 2),
            ALUMINIUM,
        ),
        _box(
            "25 mm cube",
            (CUBE_M, CUBE_M, CUBE_M),
            (0.075, table_y - CUBE_M / 2, distance + 0.015),
            ORANGE,
            rotation=turned,
        ),
    )


def _box(
    name: str,
    size_m: tuple[float, float, float],
    center_m: tuple[float, float, float],
    color: tuple[float, float, float],
    texture: str = "plain",
    rotation: Rotation | None = None,
) -> Box:
    pose = make_transform(np.eye(3) if rotation is None else rotation, center_m)
    return Box(name, np.array(size_m), pose, color, texture)


def _number(name: str, value: float) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        raise ValueError(f"{name}: got {value!r}, want a number of metres")
    if not np.isfinite(value):
        raise ValueError(f"{name}: got {value!r}, want a finite number of metres")
    return float(value)


def _three_numbers(name: str, values: ArrayLike) -> NDArray[np.float64]:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: got {values!r}, want three numbers") from None
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name}: got {values!r}, want three finite numbers")
    return array
