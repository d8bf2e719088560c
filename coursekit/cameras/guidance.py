"""Which views of a calibration board are missing, and which to take next.

A careful session has corners all over the image, boards tilted about both axes in both directions,
near ones and far ones, all of them sharp. What each of these buys is measured in notebook 03.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.geometry import Intrinsics, deproject, invert_transform, make_transform, project
from coursekit.geometry import transform_points as through
from coursekit.simulation.board_images import T_board_sheet

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.boards import Board, Detection

    Floats = NDArray[np.float64]

CELLS = (8, 6)  # of the image, across and down
COVERED_SHARE = 0.9  # of the cells: a full session has corners in them
BORDER_WEIGHT = 2.0  # of a cell at the image's border, where distortion is largest
FLAT_DEG, TILTED_DEG = 10.0, 20.0
FEWEST_TILTED = 3  # views tilted by TILTED_DEG in each of four directions
DISTANCE_RATIO = 1.5  # of the farthest view's distance to the nearest one's
BLUR_RATIO = 1.5  # times the session's median blur: a blurred view

TILTS_DEG = (25.0, 40.0)  # of the views that are proposed; some are flat
ROLLS_DEG = (0.0, 12.0, -12.0)
FILLS = (0.80, 0.60, 0.45)  # of the image, by the board: near, middle, far
PLACES = (0.12, 0.5, 0.88)  # of the width and height: where the board's middle is aimed at
BORDER_PX = 10.0  # a corner nearer to the image's border is not counted on
LEAST_SHARE = 0.75  # of a ChArUco board's corners; a checkerboard must be seen whole

AWAY = ("right", "bottom right", "bottom", "bottom left", "left", "top left", "top", "top right")


@dataclass(frozen=True, eq=False)
class Guidance:
    """What a session still lacks, a phrase each; the next view in words and as a pose.

    target (4, 4): T_camera_board of the next view, m.
    """

    missing: tuple[str, ...]
    next: str
    target: Floats

    def __repr__(self) -> str:
        return f"Still missing: {'; '.join(self.missing) or 'nothing'}.\nNext: {self.next}."


@dataclass(frozen=True, eq=False)
class _View:
    """A view as the guidance sees it: cells (6, 8), where there are corners; normal (3,), of the
    board away from the camera; distance of its middle, m; its middle in the image, px."""

    T_camera_board: Floats
    cells: NDArray[np.bool_]
    normal: Floats
    distance_m: float
    middle_px: Floats

    @property
    def tilt_deg(self) -> float:
        return float(np.degrees(np.arctan2(np.hypot(*self.normal[:2]), self.normal[2])))

    @property
    def away(self) -> int:
        """Which edge or corner of the board, of AWAY, is farthest from the camera."""
        return round(np.arctan2(-self.normal[1], -self.normal[0]) / (np.pi / 4)) % 8

    @property
    def tilt(self) -> tuple[int, int]:
        """Views with equal ones are tilted alike: how much, and which way."""
        steep = self.tilt_deg > sum(TILTS_DEG) / 2
        return (0, 0) if self.tilt_deg < FLAT_DEG else (1 + steep, self.away)


def guidance(
    detections: Sequence[Detection],
    board: Board,
    size: tuple[int, int],
    lens: Intrinsics | None = None,
) -> Guidance:
    """What these views still lack, and the view that would add most to them.

    size: (width, height) of the images, px. lens: roughly the camera's, such as the factory's; None
    stands for a field of view of 53 degrees, which will do for the words but not for the metres.
    The same arguments give the same answer. Raises ValueError for a lens of another size, and when
    the board does not fit into the image at any distance.
    """
    width, height = size
    if lens is None:
        lens = Intrinsics(width, height, width, width, (width - 1) / 2, (height - 1) / 2)
    if lens.size != (width, height):
        raise ValueError(f"lens: got one for {lens.size} px, want {(width, height)} as the images")
    views = [_seen(detection, board, lens) for detection in detections]
    best = _most_useful(views, _proposals(board, lens))
    missing = [_coverage_lack(views), *_tilt_lacks(views), _distance_lack(views)]
    missing.append(_sharpness_lack(detections))
    return Guidance(tuple(filter(None, missing)), _in_words(best, size), best.T_camera_board)


def outline(board: Board, T_camera_board: Floats, lens: Intrinsics) -> Floats:
    """The pattern's outer corners in the image, (4, 2) px, clockwise from its top left one.

    They are NaN where they are behind the camera.
    """
    wide, high = board.size_m
    corners = np.array([[0, 0, 0], [wide, 0, 0], [wide, high, 0], [0, high, 0]], float)
    return project(through(T_camera_board @ T_board_sheet(board), corners), lens.K, lens.dist)


def middle_of(board: Board) -> Floats:
    """The middle of the pattern, (3,) m, in the board's frame."""
    return through(T_board_sheet(board), np.array([*board.size_m, 0.0]) / 2)


# --- what a session lacks ---


def _coverage_lack(views: Sequence[_View]) -> str:
    across, down = CELLS
    empty = ~np.any([view.cells for view in views], axis=0) if views else np.ones((down, across))
    if empty.mean() <= 1 - COVERED_SHARE:
        return ""
    rows, columns = np.nonzero(empty)
    thirds = Counter(zip(3 * rows // down, 3 * columns // across, strict=True))
    row, column = max(thirds, key=lambda third: (thirds[third], third))
    place = _place(int(row), int(column))
    return f"coverage: {int(empty.sum())} of {across * down} parts of the image, most {place}"


def _tilt_lacks(views: Sequence[_View]) -> list[str]:
    sine = np.sin(np.radians(TILTED_DEG))
    slopes = np.array([view.normal[:2] for view in views]).reshape(-1, 2)
    lacks = []
    for axis, edges in ((0, ("left", "right")), (1, ("top", "bottom"))):
        for edge, side in zip(edges, (1, -1), strict=True):
            have = int((side * slopes[:, axis] > sine).sum())
            if have < FEWEST_TILTED:
                lacks.append(f"tilt: {edge} edge away, {have} of {FEWEST_TILTED} views")
    return lacks


def _distance_lack(views: Sequence[_View]) -> str:
    distances = [view.distance_m for view in views]
    if len(distances) < 2 or max(distances) >= DISTANCE_RATIO * min(distances):
        return "" if len(distances) >= 2 else "distance: near and far views"
    return f"distance: all views between {min(distances):.2f} and {max(distances):.2f} m"


def _sharpness_lack(detections: Sequence[Detection]) -> str:
    blurs = [view.blur_px for view in detections if view.blur_px is not None]
    blurred = sum(blur > BLUR_RATIO * np.median(blurs) for blur in blurs)
    return f"sharpness: {blurred} of {len(detections)} views are blurred" if blurred else ""


# --- what would add most ---


def _most_useful(views: Sequence[_View], proposals: Sequence[_View]) -> _View:
    """The proposal whose cells, tilt and distance the views have least of."""
    down, across = np.ogrid[: CELLS[1], : CELLS[0]]
    border = (down % (CELLS[1] - 1) == 0) | (across % (CELLS[0] - 1) == 0)
    worth = np.where(border, BORDER_WEIGHT, 1.0)
    worth = worth / (1 + np.sum([view.cells for view in views], axis=0)) ** 2
    tilts = Counter(view.tilt for view in views)
    fills = Counter(_fill(view, proposals) for view in views)

    def gain(view: _View) -> float:
        tilt, fill = 1 + tilts[view.tilt], 1 + fills[_fill(view, proposals)]
        return float(worth[view.cells].sum()) / 8 + 1 / tilt + 0.5 / fill

    return max(proposals, key=gain)


def _fill(view: _View, proposals: Sequence[_View]) -> int:
    """Which of FILLS the view's distance is nearest to."""
    distances = sorted({proposal.distance_m for proposal in proposals})
    return int(np.argmin(np.abs(np.log(np.array(distances) / view.distance_m))))


@lru_cache(maxsize=8)
def _proposals(board: Board, lens: Intrinsics) -> tuple[_View, ...]:
    """Views to choose from: all places, distances and tilts that show enough of the board."""
    wide, high = board.size_m
    views = []
    for number, tilt in enumerate((0.0, *(t for t in TILTS_DEG for _ in AWAY))):
        turn = np.radians(45.0 * number)
        facing = Rotation.from_rotvec(np.radians(tilt) * np.array([np.cos(turn), np.sin(turn), 0]))
        facing *= Rotation.from_euler("z", ROLLS_DEG[number % len(ROLLS_DEG)], degrees=True)
        for fill in FILLS:
            near = max(lens.fx * wide / lens.width, lens.fy * high / lens.height) / fill
            for aim in np.stack(np.meshgrid(PLACES, PLACES), axis=-1).reshape(-1, 2):
                view = _aimed(board, lens, facing, near, aim * lens.size)
                if view is not None:
                    views.append(view)
    if not views:
        raise ValueError(f"board: no view of {wide:g} x {high:g} m fits into {lens.size} px")
    return tuple(views)


def _aimed(
    board: Board, lens: Intrinsics, facing: Rotation, distance_m: float, aim_px: Floats
) -> _View | None:
    """The view nearest to this aim of the board's middle that shows enough of the board."""
    T_sheet_board = invert_transform(T_board_sheet(board))
    middle = np.array([*board.size_m, 0.0]) / 2
    needed = LEAST_SHARE if board.kind == "charuco" else 1.0
    centre = np.array(lens.size) / 2
    for share in np.linspace(1.0, 0.0, 11):
        ray = deproject(centre + share * (aim_px - centre), distance_m, lens.K, lens.dist)
        if not np.isfinite(ray).all():
            continue
        T = make_transform(facing, ray - facing.apply(middle)) @ T_sheet_board
        pixels = project(through(T, board.points), lens.K, lens.dist)
        room = np.minimum(pixels, np.array(lens.size) - 1 - pixels).min(axis=-1)
        if np.mean(room > BORDER_PX) >= needed:
            return _view(T, pixels[room > BORDER_PX], board, lens)
    return None


def _seen(detection: Detection, board: Board, lens: Intrinsics) -> _View:
    _, turn, shift = cv2.solvePnP(
        board.points[detection.ids], detection.pixels, lens.K, lens.dist, flags=cv2.SOLVEPNP_IPPE
    )
    T = make_transform(Rotation.from_rotvec(turn.ravel()), shift.ravel())
    return _view(T, detection.pixels, board, lens)


def _view(T: Floats, pixels: Floats, board: Board, lens: Intrinsics) -> _View:
    across, down = CELLS
    column, row = (pixels * [across, down] // lens.size).astype(int).T
    cells = np.zeros((down, across), bool)
    cells[np.clip(row, 0, down - 1), np.clip(column, 0, across - 1)] = True
    T_camera_sheet = T @ T_board_sheet(board)
    middle = through(T_camera_sheet, np.array([*board.size_m, 0.0]) / 2)
    seen_at = project(middle, lens.K, lens.dist)
    return _View(T, cells, T_camera_sheet[:3, 2], float(middle[2]), seen_at)


# --- in words ---


def _in_words(view: _View, size: tuple[int, int]) -> str:
    column, row = np.clip(3 * view.middle_px // size, 0, 2).astype(int)
    tilt = "square to the camera"
    if view.tilt_deg >= FLAT_DEG:
        part = "corner" if view.away % 2 else "edge"
        tilt = f"its {AWAY[view.away]} {part} turned away by {view.tilt_deg:.0f} degrees"
    return f"the board {_place(row, column)}, {view.distance_m:.2f} m from the camera, {tilt}"


def _place(row: int, column: int) -> str:
    """Where a ninth of the image is."""
    if (row, column) == (1, 1):
        return "in the middle"
    side = " ".join(filter(None, (("top", "", "bottom")[row], ("left", "", "right")[column])))
    return f"at the {side}"
