"""Why a board was not found, in words that name the likely cause."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np

from coursekit.arrays import Floats, Grey, NDArray
from coursekit.boards.board import FEWEST_CHECKERBOARD, FEWEST_SQUARES, Board
from coursekit.boards.find import SEARCHES, checkerboard_grid

COMMON = (
    (9, 6),
    (8, 6),
    (7, 6),
    (8, 5),
    (7, 5),
    (11, 8),
    (10, 7),
    (7, 7),
    (6, 5),
    (5, 4),
)  # corners
LONGEST_PX = 1600  # an image is looked at no larger than this,
CHECKERBOARD_PX = 800  # and for checkerboards of unknown size than this
BLANK = 15.0  # grey levels between the darkest and the brightest hundredth
BLURRED_PX = 5.0  # the sharpest edges of a picture that shows a board are steeper than this
FAMILIES = (  # the largest dictionary of each; the smaller ones are their beginnings
    "DICT_4X4_1000",
    "DICT_5X5_1000",
    "DICT_6X6_1000",
    "DICT_7X7_1000",
    "DICT_ARUCO_ORIGINAL",
    "DICT_APRILTAG_16H5",
    "DICT_APRILTAG_25H9",
    "DICT_APRILTAG_36H10",
    "DICT_APRILTAG_36H11",
    "DICT_ARUCO_MIP_36H12",
)
LENGTHS = (50, 100, 250, 1000)
FEWEST_MARKERS = 4
LARGEST = 20  # squares each way that are tried
ON_BOARD = 0.1  # squares: markers of the right board lie on its plan within this
SHARE_ON_BOARD = 0.95  # a board with the other origin has 8 of 9 in the right place


class _Markers(NamedTuple):
    """Markers seen: their dictionary, numbers (M,) and centres (M, 2) px."""

    dictionary: str
    ids: NDArray[np.intp]
    centres: Floats


def explain(grey: Grey, board: Board, corners: int) -> str:
    """Why `board` was not found in a grey image; corners: how many of them were, too few for use.

    Most reasons start with what is seen and end with what to change.
    """
    small = _shrunk(grey, LONGEST_PX)
    low, high = np.quantile(small, [0.01, 0.99])
    if high - low < BLANK:
        return (
            f"the picture is blank: nearly all of it has grey levels from {low:.0f} to {high:.0f}"
        )
    asked = f"the {board.text} asked for"
    markers = _best_markers(small, board)
    grid = None if markers else _checkerboard_seen(small, board)
    if board.kind == "charuco" and markers:
        reason = _other_markers(markers, board)
    elif board.kind == "charuco" and grid:
        reason = (
            f"a checkerboard of {_squares(grid)}, without markers: use Board('checkerboard', "
            f"{grid}, ...)"
        )
    elif markers:
        reason = (
            f"{len(markers.ids)} markers of {markers.dictionary}: this is a ChArUco board, use "
            "Board('charuco', ...)"
        )
    elif grid:
        reason = _other_size(grid, board)
    else:
        reason = ""
    if reason:
        return f"not {asked}, but {reason}"
    if corners:
        return (
            f"only {corners} usable corners of {asked}: at least 6 are needed that do not lie on "
            "one line; bring more of the board into the picture"
        )
    return _nothing(small, board)


def _other_size(grid: tuple[int, int], board: Board) -> str:
    """A checkerboard of `grid` squares is seen where another was asked for."""
    seen = f"a checkerboard of {_squares(grid)}"
    if sorted(grid) == sorted(count + 1 for count in board.squares):
        return f"{seen}: you gave inner corners, squares are one more in each direction"
    return f"{seen}: use squares={grid}"


def _nothing(grey: Grey, board: Board) -> str:
    """No board of any kind: the advice that fits the picture."""
    width = _sharpest_edge_px(grey)
    if width > BLURRED_PX:
        return (
            f"no board seen, and the picture is blurred (its sharpest edges are {width:.0f} px "
            "wide): hold still, focus, or use a shorter exposure"
        )
    if board.kind == "checkerboard":
        return (
            f"no checkerboard of {board.text} seen: all of it must be in the picture, with white "
            "around it, well lit and not too oblique"
        )
    return (
        f"no marker of {board.dictionary} or any other dictionary seen: bring the board nearer "
        "or into focus, and keep lamps from reflecting in it"
    )


def _sharpest_edge_px(grey: Grey) -> float:
    """Contrast over the steepest slopes, px."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (5, 5), 1.0)
    across, down = np.gradient(smooth)
    slope = np.hypot(across, down)
    contrast = np.subtract(*np.quantile(smooth, [0.99, 0.01]))
    return float(contrast / max(np.quantile(slope, 0.999), 1e-3))


def _shrunk(grey: Grey, longest: int) -> Grey:
    shrink = longest / max(grey.shape)
    if shrink >= 1.0:
        return grey
    small = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.uint8)


def _squares(squares: tuple[int, int]) -> str:
    return "{}x{} squares".format(*squares)


# --- checkerboards of another size ---


def _checkerboard_seen(grey: Grey, board: Board) -> tuple[int, int] | None:
    """(columns, rows) of SQUARES of a checkerboard that is whole in the image, or None.

    Turned by a quarter it is the same board: the longer side is where `board` has it.

    OpenCV's search for boards of any size says whether there is one at all; the size that it
    reports is often one off, so each likely one is put to the search for a given size.
    """
    small = _shrunk(grey, CHECKERBOARD_PX)
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    found, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
    if not found:
        return None
    for corners in _likely(board.corners, (meta.shape[1], meta.shape[0])):
        if checkerboard_grid(small, corners, SEARCHES[:1]) is not None:
            few, many = sorted(count + 1 for count in corners)
            return (many, few) if board.corners[0] >= board.corners[1] else (few, many)
    return None


def _likely(asked: tuple[int, int], seen: tuple[int, int]) -> Iterator[tuple[int, int]]:
    """Sizes in inner corners to try: one more each way (a miscount), near what is seen, common."""
    tried = {tuple(sorted(asked))}
    about = [(asked[0] + 1, asked[1] + 1), seen]
    about += [(seen[0] + a, seen[1] + b) for a, b in product((0, -1, 1), repeat=2)]
    about += [(asked[0] + a, asked[1] + b) for a, b in product((0, -1, 1), repeat=2)]
    for size in (*about, *COMMON):
        if min(size) >= FEWEST_CHECKERBOARD - 1 and tuple(sorted(size)) not in tried:
            tried.add(tuple(sorted(size)))
            yield size


# --- other markers, or the same on another plan ---


def _best_markers(grey: Grey, board: Board) -> _Markers | None:
    """The dictionary with the most markers in the image, the board's own where it has enough."""
    families = [board.dictionary] if board.kind == "charuco" else []
    best = None
    for name in [*families, *FAMILIES]:
        seen = _markers(grey, name)
        if len(seen.ids) >= FEWEST_MARKERS and (best is None or len(seen.ids) > len(best.ids)):
            best = seen
    return best


def _markers(grey: Grey, name: str) -> _Markers:
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)
    if ids is None:
        return _Markers(name, np.empty(0, np.intp), np.empty((0, 2)))
    centres = np.array([corner.reshape(4, 2).mean(axis=0) for corner in corners])
    return _Markers(name, ids.ravel().astype(np.intp), centres.astype(np.float64))


def _other_markers(markers: _Markers, board: Board) -> str:
    """Markers are seen, of this dictionary or another; "" where they fit the board asked for."""
    name = _short_name(markers, board)
    if name != board.dictionary:
        return f"{len(markers.ids)} markers of {name}: use dictionary={name!r}"
    if _on_plan(markers, board):
        return ""
    count = f"{len(markers.ids)} markers of {name}"
    for squares in _plans(markers):
        for old in (board.old_origin, not board.old_origin):
            other = _try_plan(board, squares, old)
            if other is not None and _on_plan(markers, other):
                change = f"squares={squares}" if squares != board.squares else ""
                if old != board.old_origin and squares[1] % 2 == 0:
                    change += f"{', ' if change else ''}old_origin={old}"
                return f"{count} as on a board of {_squares(squares)} or more: use {change}"
    return f"{count} that lie as on no board of up to {LARGEST}x{LARGEST} squares"


def _short_name(markers: _Markers, board: Board) -> str:
    """The board's dictionary if it holds the markers, else the shortest of their family."""
    family, _, length = markers.dictionary.rpartition("_")
    if markers.dictionary == board.dictionary or length != "1000":
        return markers.dictionary
    own_family, _, own_length = board.dictionary.rpartition("_")
    if own_family == family and int(own_length) > markers.ids.max():
        return board.dictionary
    shortest = min(n for n in LENGTHS if n > markers.ids.max())
    return f"{family}_{max(shortest, 250)}"


def _plans(markers: _Markers) -> Iterator[tuple[int, int]]:
    """(columns, rows) that hold these markers, fewest squares first."""
    sizes = product(range(FEWEST_SQUARES, LARGEST + 1), repeat=2)
    for columns, rows in sorted(sizes, key=lambda size: (size[0] * size[1], size)):
        if (columns * rows + 1) // 2 > markers.ids.max():
            yield columns, rows


def _try_plan(board: Board, squares: tuple[int, int], old: bool) -> Board | None:
    try:
        return replace(board, squares=squares, old_origin=old)
    except ValueError:  # more squares than the dictionary has markers
        return None


def _on_plan(markers: _Markers, board: Board) -> bool:
    """Whether the markers lie where the board has them, up to a homography."""
    plan: Any = board.marker_centres
    known = markers.ids < len(plan)
    if known.sum() < max(FEWEST_MARKERS, SHARE_ON_BOARD * len(known)):
        return False
    on_board, centres = plan[markers.ids[known]], markers.centres[known]
    H, _ = cv2.findHomography(centres, on_board, cv2.RANSAC, ON_BOARD)
    if H is None:
        return False
    mapped = np.c_[centres, np.ones(len(centres))] @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - on_board, axis=1)
    return bool((off < 3 * ON_BOARD).mean() >= SHARE_ON_BOARD)
