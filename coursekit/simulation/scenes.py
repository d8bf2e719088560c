"""What stands in front of the simulated camera, boxes with a size, a pose, a colour and a texture;
and the exact image of it: depth and box at every pixel's centre, and a readable picture.

    scene = tabletop(0.45)
    render(scene, intrinsics).depth_m
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import ArrayLike, Bools, Floats, NDArray, frozen
from coursekit.checks import array, choice, instance, number, positive, settle, transform, want
from coursekit.geometry import Intrinsics, deproject, invert_transform, make_transform, pixel_grid
from coursekit.simulation import raycast

Three = tuple[float, float, float]
TEXTURES = ("plain", "grid", "wood")

WALL_PAINT = (0.86, 0.87, 0.84)
MAPLE = (0.80, 0.66, 0.48)
ALUMINIUM = (0.67, 0.69, 0.72)
DARK = (0.05, 0.05, 0.05)
SKIN = (0.80, 0.60, 0.50)
ORANGE = (230 / 255, 159 / 255, 0.0)  # of the Okabe-Ito palette, safe for the colour-blind

BLOCK_M, CUBE_M = 0.060, 0.025
TABLE_THICK_M, WALL_BEHIND_M = 0.025, 0.50  # the latter: from the block's face
METRES = "a positive number of metres"


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
    size_m: Floats
    T_scene_box: Floats
    color: Three
    texture: str = "plain"
    specular: float = 0.0

    def __post_init__(self) -> None:
        size = array("size_m", self.size_m, (3,), finite=True)
        want((size > 0).all(), "size_m", size, "three positive lengths in m")
        color = array("color", self.color, (3,), finite=True)
        want(((color >= 0) & (color <= 1)).all(), "color", color, "red, green, blue from 0 to 1")
        choice("texture", self.texture, TEXTURES)
        number("specular", self.specular, "a share from 0 to 1", least=0.0, most=1.0)
        T = transform("T_scene_box", self.T_scene_box)
        settle(self, size_m=frozen(size.copy()), T_scene_box=frozen(T.copy()))
        settle(self, color=tuple(color.tolist()))


Scene = tuple[Box, ...]


def tabletop(distance_m: float = 0.45) -> Scene:
    """A wall, a table, a 60 mm block standing on it and a 25 mm cube beside the block.

    distance_m: Z of the block's front face, m; the face is parallel to the image plane of a camera
    at the scene's origin, its centre on the optical axis; the wall is 0.5 m behind it. Returns the
    four boxes, in this order: "wall", "table", "60 mm block", "25 mm cube". Raises ValueError for a
    distance that is not positive.

    >>> [box.name for box in tabletop(0.45)]
    ['wall', 'table', '60 mm block', '25 mm cube']
    """
    distance = positive("distance_m", distance_m, METRES)
    top = BLOCK_M / 2
    front, back = min(0.20, 0.6 * distance), distance + WALL_BEHIND_M - 0.02
    table_size, table_middle = (2.00, TABLE_THICK_M, back - front), (back + front) / 2
    table = _box("table", table_size, (0.0, top + TABLE_THICK_M / 2, table_middle), MAPLE, "wood")
    block_at = (0.0, top - BLOCK_M / 2, distance + BLOCK_M / 2)
    block = _box("60 mm block", 3 * (BLOCK_M,), block_at, ALUMINIUM)
    cube_at = (0.075, top - CUBE_M / 2, distance + 0.015)
    cube = _box("25 mm cube", 3 * (CUBE_M,), cube_at, ORANGE, deg=28)
    return _wall(distance + WALL_BEHIND_M, 0.0), table, block, cube


def wall_scene(distance_m: float = 1.0, tilt_deg: float = 7.0) -> Scene:
    """A wall alone, which fills the view.

    distance_m: Z of the wall on the optical axis of a camera at the scene's origin, m. tilt_deg:
    turns the wall about the vertical there, its right side away from the camera, less than 60.
    A wall square to the camera has one disparity, so one sub-pixel phase; a tilted one has all.
    Raises ValueError for a distance that is not positive and for too large a tilt.
    """
    return (_wall(positive("distance_m", distance_m, METRES), tilt_deg),)


def artefact_scene(distance_m: float = 0.60) -> Scene:
    """A table seen from above, with everything on it that a stereo camera gets wrong.

    distance_m: Z of the table on the optical axis of a camera at the scene's origin, which looks
    down at 35 degrees, m; at least 0.30. Returns "wall", "table", "60 mm block", "25 mm cube";
    "tall box", 0.2 m high, whose shadow is easy to see; lying on the table "dark card" (albedo
    0.05) and "shiny plate" (95 % mirror); and "finger", 0.13 m in front of the camera on the left.
    Raises ValueError for a shorter distance.
    """
    wanted = "at least 0.30 m, behind the finger"
    distance = number("distance_m", distance_m, wanted, least=0.30)
    looks_down = Rotation.from_euler("x", 35, degrees=True)
    stage = make_transform(looks_down, (0.0, 0.0, distance))  # x right, y down, z along the table
    block, cube, card = 3 * (BLOCK_M,), 3 * (CUBE_M,), (0.12, 0.002, 0.12)
    plate = _box("shiny plate", card, (0.20, -0.001, 0.02), ALUMINIUM)
    on_table = (
        _box("wall", (6.0, 4.0, 0.10), (0.0, 0.0, 0.45), WALL_PAINT, "grid"),
        _box("table", (1.4, TABLE_THICK_M, 0.88), (0.0, TABLE_THICK_M / 2, -0.05), MAPLE, "wood"),
        _box("60 mm block", block, (0.0, -BLOCK_M / 2, 0.0), ALUMINIUM),
        _box("25 mm cube", cube, (0.09, -CUBE_M / 2, -0.05), ORANGE, deg=28),
        _box("tall box", (0.06, 0.20, 0.06), (0.33, -0.10, 0.02), WALL_PAINT),
        _box("dark card", card, (-0.17, -0.001, 0.0), DARK),
        replace(plate, specular=0.95),
    )
    finger = _box("finger", (0.018, 0.070, 0.018), (-0.070, -0.055, 0.139), SKIN)
    return (*(replace(box, T_scene_box=stage @ box.T_scene_box) for box in on_table), finger)


def _wall(distance: float, tilt_deg: float) -> Box:
    """A wall of 100 mm whose front crosses the optical axis at this Z."""
    number("tilt_deg", tilt_deg)
    want(abs(tilt_deg) < 60, "tilt_deg", tilt_deg, "less than 60 degrees to either side")
    turned, thick = Rotation.from_euler("y", -tilt_deg, degrees=True), 0.10
    center = np.array([0.0, 0.0, distance]) + turned.apply([0.0, 0.0, thick / 2])
    size = (8.0 * distance, 5.0 * distance, thick)
    return _box("wall", size, tuple(center), WALL_PAINT, "grid", -tilt_deg)


def _box(
    name: str, size_m: Three, at_m: Three, color: Three, texture: str = "plain", deg: float = 0.0
) -> Box:
    """A box turned by so many degrees about its y axis."""
    pose = make_transform(Rotation.from_euler("y", deg, degrees=True), at_m)
    return Box(name, np.array(size_m), pose, color, texture)


# --- the image of a scene ---

LAMP_M = np.array([-0.25, -0.40, -0.10])  # beside the camera, in its frame


@dataclass(frozen=True, eq=False)
class RenderResult:
    """What `render` returns.

    depth_m (H, W) float64: Z in the camera frame at the pixel's centre, m, 0 where nothing is hit.
    object_index (H, W) int16: which box of the scene, -1 for none. color (H, W, 3) uint8: RGB.
    """

    depth_m: Floats
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

    >>> camera = Intrinsics(64, 48, 60.0, 60.0, 31.5, 23.5)
    >>> round(float(render(tabletop(0.45), camera).depth_m[24, 32]), 3)  # of the block
    0.45
    """
    check_scene(scene)
    instance("intrinsics", intrinsics, Intrinsics)
    boxes = box_table(scene, T_scene_camera)
    width, height = intrinsics.size
    depth, index = np.empty((height, width)), np.empty((height, width), np.int16)
    raycast.render_depth(boxes, rays(intrinsics, pixel_grid(width, height)), depth, index)
    color = np.empty((height, width, 3), np.uint8)
    paint = np.array([box.color for box in scene]).reshape(-1, 3)
    textures = np.array([TEXTURES.index(box.texture) for box in scene], np.int64)
    corners, pixel = corner_rays(intrinsics), 1.0 / intrinsics.fx
    raycast.render_color(boxes, paint, textures, corners, LAMP_M, pixel, color)
    return RenderResult(depth, index, color)


def flying_pixels(depth_m: Floats, scene: Scene, intrinsics: Intrinsics) -> Bools:
    """Which pixels (H, W) of a depth image (H, W) m, 0 for none, hang in the air: 3 cm and more off
    what they see, and in the middle half between the nearest and farthest surface within 7 px."""
    from scipy import ndimage

    true = render(scene, intrinsics).depth_m
    near, far = ndimage.minimum_filter(true, 15), ndimage.maximum_filter(true, 15)
    between = np.abs(depth_m - (near + far) / 2) < (far - near) / 4
    return np.asarray((depth_m > 0) & (np.abs(depth_m - true) > 0.03) & between)


def rays(intrinsics: Intrinsics, pixels: Floats) -> Floats:
    """The points at Z = 1 m behind pixels (H, W, 2): (H, W, 3), NaN where there is none."""
    return deproject(pixels, np.ones(pixels.shape[:2]), intrinsics.K, intrinsics.dist)


@lru_cache(maxsize=4)
def corner_rays(intrinsics: Intrinsics) -> Floats:
    """The points at Z = 1 m behind the pixels' corners, (H + 1, W + 1, 3), NaN for no ray."""
    width, height = intrinsics.size
    return rays(intrinsics, pixel_grid(width + 1, height + 1) - 0.5)


def box_table(scene: Scene, T_scene_camera: ArrayLike | None) -> Floats:
    """The boxes as `raycast` wants them, (N, 15), in the camera frame.

    Raises ValueError for a camera inside a box.
    """
    T = np.eye(4) if T_scene_camera is None else T_scene_camera
    T_camera_scene = invert_transform(transform("T_scene_camera", T))
    boxes = np.empty((len(scene), 15))
    for row, box in zip(boxes, scene, strict=True):
        T_camera_box = T_camera_scene @ box.T_scene_box
        row[:3], row[3:6], row[6:] = T_camera_box[:3, 3], box.size_m / 2, T_camera_box[:3, :3].flat
        if (np.abs(invert_transform(T_camera_box)[:3, 3]) < box.size_m / 2).all():
            raise ValueError(f"T_scene_camera: the camera is inside the box {box.name!r}")
    return boxes


def check_scene(scene: Scene) -> None:
    """Raises ValueError for anything but a tuple or list of Box."""
    boxes = isinstance(scene, (tuple, list)) and all(isinstance(box, Box) for box in scene)
    want(boxes, "scene", scene, "a tuple of Box, e.g. tabletop()")
