"""Pictures of a printed board, so that corner noise emerges from detection instead of being put in.

Light is linear: the print is sampled through the whole camera model, blurred by the lens, counted
in photons, read with noise and rounded to 8 bits. The board lies on a wooden table, under a lamp.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from coursekit.geometry import (
    Intrinsics,
    check_transform,
    deproject,
    invert_transform,
    make_transform,
    pixel_grid,
    transform_points,
)
from coursekit.simulation.scenes import MAPLE, TABLE_THICK_M, WALL_PAINT, Box

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from coursekit.boards import Board
    from coursekit.simulation.scenes import Scene

# Plausible, not measured. Light and noise were chosen so that detection finds the corners of an
# ordinary view with a standard deviation of about 0.05 px: tests/test_board_images.py measures it.
TEXELS_PER_SQUARE = 112  # whole texels for each module of a ChArUco marker of 3/4 square
MARGIN = 0.625  # of a square, whole texels: white paper round the pattern
PAPER, INK, TABLE = 1.0, 0.06, 0.34  # light that they send back, of white paper's
THICK_M = 0.005  # of the plate that the sheet is glued to
LAMP_M = (-0.50, -0.70, -1.80)  # from the board's middle, in the sheet's frame
LENS_SIGMA_PX = 0.6  # blur of lens and sensor in focus
ELECTRONS_PER_MS = 50.0  # from white paper in a room of light 1: an evening at home
READ_NOISE_E = 3.5
WHITE_GREY, BLACK_GREY = 150.0, 8.0  # the camera's gain brings white paper and no light to these
MOST_BOW_M = 0.02  # a steeper one hides parts of the board behind others


def render_board(
    board: Board,
    T_camera_board: ArrayLike,
    lens: Intrinsics,
    rng: np.random.Generator | None,
    *,
    bow_m: float = 0.0,
    defocus_px: float = 0.0,
    exposure_ms: float = 8.0,
    velocity: ArrayLike = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    readout_ms: float = 0.0,
    light: float = 1.0,
) -> NDArray[np.uint8]:
    """A grey picture (h, w) of a board on a table, as a camera with this lens takes it.

    T_camera_board (4, 4): board frame to camera frame, at the middle of the exposure of the middle
    row. lens: its size, K and Brown-Conrady coefficients in OpenCV's sense. rng: makes the noise;
    None makes a picture without. bow_m: by how much the board's middle stands out towards the
    viewer over its outermost corners, the shape being a paraboloid. defocus_px: standard deviation
    of the blur that is added to the lens's own. velocity (6,): of the board's middle in m/s and
    about it in rad/s, along the camera's axes; the table goes along, as if the camera moved.
    readout_ms: from the exposure of the first row to that of the last. light: of the room, in units
    of an ordinary one; less light or exposure is not darker but noisier, for the camera's gain
    makes up for it.
    Raises ValueError for a wrong argument, and for a board that does not face the camera.
    """
    T = check_pose(board, T_camera_board)
    if not isinstance(lens, Intrinsics):
        raise ValueError(f"lens: got {type(lens).__name__}, want Intrinsics")
    _check("bow_m", bow_m, -MOST_BOW_M, MOST_BOW_M, "m")
    _check("defocus_px", defocus_px, 0, 50, "px")
    _check("exposure_ms", exposure_ms, 0.01, 1000, "ms")
    _check("readout_ms", readout_ms, 0, 1000, "ms")
    _check("light", light, 0.001, 1000, "times an ordinary room's")
    twist = _check_velocity(velocity)
    T_camera_sheet = T @ T_board_sheet(board)
    middle = np.array([*board.size_m, 0.0]) / 2
    poses = _poses(T_camera_sheet, middle, twist, exposure_ms / 1e3, readout_ms / 1e3, lens.height)
    radiance = _radiance(board, poses, lens, bow_m)
    blurred = gaussian_filter(radiance, np.hypot(LENS_SIGMA_PX, defocus_px), mode="nearest")
    return _expose(blurred, ELECTRONS_PER_MS * exposure_ms * light, rng)


def board_scene(board: Board, T_scene_board: ArrayLike) -> Scene:
    """A plate of the printed sheet's size, without the print, on a table: "board", "table"."""
    T = check_transform("T_scene_board", T_scene_board) @ T_board_sheet(board)
    wide, high = board.size_m
    margin = 2 * MARGIN * board.square_m
    into_plate, into_table = np.eye(4), np.eye(4)
    into_plate[:3, 3] = wide / 2, high / 2, THICK_M / 2
    into_table[:3, 3] = wide / 2, high / 2, THICK_M + TABLE_THICK_M / 2
    return (
        Box("board", np.array([wide + margin, high + margin, THICK_M]), T @ into_plate, WALL_PAINT),
        Box("table", np.array([4.0, 4.0, TABLE_THICK_M]), T @ into_table, MAPLE, "wood"),
    )


def check_pose(board: Board, T_camera_board: ArrayLike) -> NDArray[np.float64]:
    """T_camera_board as (4, 4) float64; ValueError unless the board's print faces the camera."""
    T = check_transform("T_camera_board", T_camera_board)
    if T.shape != (4, 4):
        raise ValueError(f"T_camera_board: got shape {T.shape}, want one (4, 4) transform")
    T_camera_sheet = T @ T_board_sheet(board)
    middle = transform_points(T_camera_sheet, np.array([*board.size_m, 0.0]) / 2)
    if not (middle[2] > 0 and invert_transform(T_camera_sheet)[2, 3] < 0):
        raise ValueError("T_camera_board: the board's printed side does not face the camera")
    return T


def T_board_sheet(board: Board) -> NDArray[np.float64]:
    """Sheet frame to board frame (4, 4): see `board_kernels`."""
    image_from_board = board.image_from_board(1)
    right, down = np.sign(np.diag(image_from_board)[:2])
    offset = board.square_m * (image_from_board[:2, 2] + 0.5)
    return invert_transform(make_transform(np.diag([right, down, right * down]), (*offset, 0.0)))


def _bow(board: Board, bow_m: float) -> NDArray[np.float64]:
    """As `board_kernels.meet` wants it, (4,): z points away from the viewer."""
    width, height = board.size_m
    across, down = board.square_m * (np.array(board.corners) - 1)
    return np.array([width / 2, height / 2, -bow_m, 4.0 / (across**2 + down**2)])


def _poses(
    T_camera_sheet: NDArray[np.float64],
    middle: NDArray[np.float64],
    twist: NDArray[np.float64],
    exposure_s: float,
    readout_s: float,
    rows: int,
) -> NDArray[np.float64]:
    """Where the camera is in the sheet's frame, (moments, lines, 12): see `board_kernels`."""
    moments, lines = (2, rows + 1 if readout_s else 1) if twist.any() else (1, 1)
    within = exposure_s * np.array([-0.5, 0.5])[-moments:, None] * (moments - 1)
    time_s = within + readout_s * np.linspace(-0.5, 0.5, lines) * (lines > 1)
    turn = Rotation.from_rotvec(time_s.reshape(-1, 1) * twist[3:]).as_matrix()
    R = (turn @ T_camera_sheet[:3, :3]).reshape(moments, lines, 3, 3)
    where = transform_points(T_camera_sheet, middle) + time_s[..., None] * twist[:3]
    place = middle - np.einsum("...ji,...j->...i", R, where)
    return np.concatenate([place, np.swapaxes(R, -1, -2).reshape(moments, lines, 9)], axis=-1)


def _radiance(
    board: Board, poses: NDArray[np.float64], lens: Intrinsics, bow_m: float
) -> NDArray[np.float64]:
    """The light (h, w) on the sensor without the lens's blur, 1 for white paper below the lamp."""
    from coursekit.simulation import board_kernels  # numba takes half a second to import

    sheet, edges = _sheet(board)
    rays, pixel = _corner_rays(lens), 1.0 / lens.fx
    lamp = np.array([*board.size_m, 0.0]) / 2 + LAMP_M
    texels_per_m = TEXELS_PER_SQUARE / board.square_m
    place = np.array([-MARGIN * board.square_m, texels_per_m, THICK_M, TABLE, *lamp])
    corners = np.empty((len(poses), *rays.shape))
    board_kernels.unroll(poses, _bow(board, bow_m), rays, corners)
    light = np.empty((lens.height, lens.width))
    board_kernels.light_up(poses, rays, corners, sheet, edges, place, pixel, light)
    return light


def _expose(
    radiance: NDArray[np.float64], white_e: float, rng: np.random.Generator | None
) -> NDArray[np.uint8]:
    """The 8-bit picture: photon noise by its normal limit, read noise, gain, rounding."""
    grey_per_e = (WHITE_GREY - BLACK_GREY) / white_e
    grey = (WHITE_GREY - BLACK_GREY) * radiance + BLACK_GREY
    if rng is not None:
        sigma_e = np.sqrt(white_e * radiance + READ_NOISE_E**2)
        grey += grey_per_e * sigma_e * rng.standard_normal(grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


@lru_cache(maxsize=8)
def _sheet(board: Board) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The print with its margin as reflectances, and each texel's distance to the next edge."""
    pattern = board.image(TEXELS_PER_SQUARE)
    margin = round(MARGIN * TEXELS_PER_SQUARE)
    paper = np.pad(pattern, margin, constant_values=255)
    sheet = (INK + (PAPER - INK) / 255.0 * paper).astype(np.float32)
    framed = np.pad(paper, 1, constant_values=128)  # the sheet's own edge is one, too
    flat = np.ones(framed.shape, np.uint8)
    flat[:-1] &= framed[:-1] == framed[1:]
    flat[:, :-1] &= framed[:, :-1] == framed[:, 1:]
    edges = cv2.distanceTransform(flat, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)[1:-1, 1:-1]
    return sheet, np.ascontiguousarray(edges, np.float32)


@lru_cache(maxsize=4)
def _corner_rays(lens: Intrinsics) -> NDArray[np.float64]:
    """Where the rays of the pixels' corners are at Z = 1 m, (h + 1, w + 1, 2), NaN for no ray."""
    corners = pixel_grid(lens.width + 1, lens.height + 1) - 0.5
    rays = deproject(corners, np.ones(corners.shape[:2]), lens.K, lens.dist)
    return np.ascontiguousarray(rays[..., :2])


def _check(name: str, value: object, least: float, most: float, unit: str) -> None:
    number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    if not number or not least <= value <= most:  # type: ignore[operator]
        raise ValueError(f"{name}: got {value!r}, want {least} to {most} {unit}")


def _check_velocity(velocity: ArrayLike) -> NDArray[np.float64]:
    try:
        twist = np.asarray(velocity, np.float64)
    except (TypeError, ValueError):
        twist = np.full(6, np.nan)
    if twist.shape != (6,) or not np.isfinite(twist).all():
        raise ValueError(f"velocity: got {velocity!r}, want six finite numbers, m/s and rad/s")
    return twist
