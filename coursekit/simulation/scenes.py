"""What stands in front of the simulated camera: boxes with a size, a pose, a colour, a texture."""

from __future__ import annotations

from dataclasses import dataclass, replace
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
DARK = (0.05, 0.05, 0.05)
SKIN = (0.80, 0.60, 0.50)
ORANGE = (230 / 255, 159 / 255, 0.0)  # of the Okabe-Ito palette, safe for the colour-blind

BLOCK_M = 0.060
CUBE_M = 0.025
TABLE_THICK_M = 0.025


@dataclass(frozen=True, eq=False)
class Box:
    """A solid box centred on its own frame, its edges along the frame's axes.

    size_m (3,): edge lengths, m. T_scene_box (4, 4): box frame to scene frame.
    color: red, green, blue, each 0..1; their mean is the albedo in infrared. texture: "plain";
    "grid", faint lines every 100 mm; or "wood", planks along the box's z axis. specular: the share
    of light, 0..1, that is mirrored and not scattered; only the infrared eyes see it.
    Raises ValueError for anything else.
    """

    name: str
    size_m: NDArray[np.float64]
    T_scene_box: NDArray[np.float64]
    color: tuple[float, float, float]
    texture: str = "plain"
    specular: float = 0.0

    def __post_init__(self) -> None:
        size = _three_numbers("size_m", self.size_m)
        if (size <= 0).any():
            raise ValueError(f"size_m: got {size.tolist()}, want three positive lengths in m")
        color = _three_numbers("color", self.color)
        if (color < 0).any() or (color > 1).any():
            raise ValueError(f"color: got {color.tolist()}, want red, green, blue from 0 to 1")
        if self.texture not in TEXTURES:
            raise ValueError(f"texture: got {self.texture!r}, want one of {', '.join(TEXTURES)}")
        if not 0 <= _number("specular", self.specular, "share") <= 1:
            raise ValueError(f"specular: got {self.specular}, want a share from 0 to 1")
        T = check_transform("T_scene_box", self.T_scene_box).copy()
        if T.shape != (4, 4):
            raise ValueError(f"T_scene_box: got shape {T.shape}, want one (4, 4) transform")
        size.flags.writeable = T.flags.writeable = False
        object.__setattr__(self, "size_m", size)
        object.__setattr__(self, "T_scene_box", T)
        object.__setattr__(self, "color", tuple(color.tolist()))


Scene = tuple[Box, ...]


def tabletop(distance_m: float = 0.45, wall_behind_m: float = 0.50, tilt_deg: float = 0.0) -> Scene:
    """A wall, a table, a 60 mm block standing on it and a 25 mm cube beside the block.

    distance_m: Z of the block's front face, m; the face is parallel to the image plane of a camera
    at the scene's origin, its centre on the optical axis. wall_behind_m: from that face to the
    wall, m, at least 0.10. tilt_deg: turns the wall as in `wall_scene`. Returns the four boxes, in
    this order: "wall", "table", "60 mm block", "25 mm cube". Raises ValueError for a distance that
    is not positive.
    """
    distance, behind = _distance(distance_m), _number("wall_behind_m", wall_behind_m)
    if behind < 0.10:
        raise ValueError(f"wall_behind_m: got {behind}, want at least 0.10 m, behind the cube")
    table_y, table_front, table_back = (
        BLOCK_M / 2,
        min(0.20, 0.6 * distance),
        distance + behind - 0.02,
    )
    turned = Rotation.from_euler("y", 28, degrees=True)
    return (
        _wall(distance + behind, tilt_deg),
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


def wall_scene(distance_m: float = 1.0, tilt_deg: float = 7.0) -> Scene:
    """A wall alone, which fills the view.

    distance_m: Z of the wall on the optical axis of a camera at the scene's origin, m. tilt_deg:
    turns the wall about the vertical there, its right side away from the camera, less than 60.
    A wall square to the camera has one disparity, so one sub-pixel phase; a tilted one has all.
    Raises ValueError for a distance that is not positive and for too large a tilt.
    """
    return (_wall(_distance(distance_m), tilt_deg),)


def artefact_scene(distance_m: float = 0.60) -> Scene:
    """A table seen from above, with everything on it that a stereo camera gets wrong.

    distance_m: Z of the table on the optical axis of a camera at the scene's origin, which looks
    down at 35 degrees, m; at least 0.30. Returns "wall", "table", "60 mm block", "25 mm cube";
    "tall box", 0.2 m high, whose shadow is easy to see; lying on the table "dark card" (albedo
    0.05) and "shiny plate" (95 % mirror); and "finger", 0.13 m in front of the camera on the left.
    Raises ValueError for a shorter distance.
    """
    distance = _distance(distance_m)
    if distance < 0.30:
        raise ValueError(f"distance_m: got {distance}, want at least 0.30 m, behind the finger")
    looks_down = Rotation.from_euler("x", 35, degrees=True)
    stage = make_transform(looks_down, (0.0, 0.0, distance))  # x right, y down, z along the table
    turned = Rotation.from_euler("y", 28, degrees=True)
    foot = -BLOCK_M / 2
    on_table = (
        _box("wall", (6.0, 4.0, 0.10), (0.0, 0.0, 0.45), WALL_PAINT, texture="grid"),
        _box("table", (1.4, TABLE_THICK_M, 0.88), (0.0, TABLE_THICK_M / 2, -0.05), MAPLE, "wood"),
        _box("60 mm block", (BLOCK_M, BLOCK_M, BLOCK_M), (0.0, foot, 0.0), ALUMINIUM),
        _box("25 mm cube", (CUBE_M, CUBE_M, CUBE_M), (0.09, -CUBE_M / 2, -0.05), ORANGE,
             rotation=turned),
        _box("tall box", (0.06, 0.20, 0.06), (0.33, -0.10, 0.02), WALL_PAINT),
        _box("dark card", (0.12, 0.002, 0.12), (-0.17, -0.001, 0.0), DARK),
        replace(_box("shiny plate", (0.12, 0.002, 0.12), (0.20, -0.001, 0.02), ALUMINIUM),
                specular=0.95),
    )  # fmt: skip
    finger = _box("finger", (0.018, 0.070, 0.018), (-0.070, -0.055, 0.139), SKIN)
    return (*(replace(box, T_scene_box=stage @ box.T_scene_box) for box in on_table), finger)


def _wall(distance: float, tilt_deg: float) -> Box:
    """A wall of 100 mm whose front crosses the optical axis at this Z."""
    tilt = _number("tilt_deg", tilt_deg, "degrees")
    if not abs(tilt) < 60:
        raise ValueError(f"tilt_deg: got {tilt}, want less than 60 degrees to either side")
    turned = Rotation.from_euler("y", -tilt, degrees=True)
    thick = 0.10
    center = np.array([0.0, 0.0, distance]) + turned.apply([0.0, 0.0, thick / 2])
    size = (8.0 * distance, 5.0 * distance, thick)
    return _box("wall", size, tuple(center), WALL_PAINT, texture="grid", rotation=turned)


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


def _distance(value: float) -> float:
    distance = _number("distance_m", value)
    if distance <= 0:
        raise ValueError(f"distance_m: got {distance}, want a positive number of metres")
    return distance


def _number(name: str, value: float, unit: str = "metres") -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        raise ValueError(f"{name}: got {value!r}, want a number of {unit}")
    if not np.isfinite(value):
        raise ValueError(f"{name}: got {value!r}, want a finite number of {unit}")
    return float(value)


def _three_numbers(name: str, values: ArrayLike) -> NDArray[np.float64]:
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: got {values!r}, want three numbers") from None
    if array.shape != (3,) or not np.isfinite(array).all():
        raise ValueError(f"{name}: got {values!r}, want three finite numbers")
    return array
