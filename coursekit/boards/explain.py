"""Why a board was not found, in words that name the likely cause.

An image is asked in turn: is it blank? Does it show markers, and of which dictionary, on which
plan? A checkerboard, and of which size? Is it blurred? The first answer that explains the failure
is given, starting with what is seen and ending with what to change.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any, NamedTuple

import cv2
import numpy as np

from coursekit.arrays import Floats, Grey, NDArray
from coursekit.boards.board import DICTIONARIES, FEWEST_SQUARES, Board, OtherBoard
from coursekit.boards.find import SEARCHES, checkerboard_grid, shrunk

COMMON_CORNERS = ((9, 6), (8, 6), (7, 6), (8, 5), (7, 5), (11, 8), (10, 7), (7, 7), (6, 5), (5, 4))
LONGEST_PX = 1600  # an image is looked at no larger than this,
CHECKERBOARD_PX = 800  # and for checkerboards of unknown size than this
BLANK_GREY = 15.0  # levels between the darkest and the brightest hundredth
BLURRED_PX = 5.0  # the sharpest edges of a picture that shows a board are steeper than this
FAMILIES = tuple(  # the largest dictionary of each; the smaller ones are their beginnings
    name for name in DICTIONARIES if not name.endswith(("_50", "_100", "_250"))
)
FAMILY_LENGTHS = (50, 100, 250, 1000)
FEWEST_MARKERS = 4
MOST_SQUARES = 20  # each way that are tried
OFF_PLAN = 0.1  # squares: markers of the right board lie on its plan within this
SHARE_ON_PLAN = 0.95  # a board with the other origin has 8 of 9 in the right place


class _Markers(NamedTuple):
    """Markers seen: their dictionary, numbers (M,) and centres (M, 2) px."""

    dictionary: str
    ids: NDArray[np.intp]
    centres: Floats


def explain(grey: Grey, board: Board, corners: int) -> str:
    """Why `board` was not found in a grey image (H, W), uint8, in one sentence.

    corners: how many of the board's corners were found, too few for use. Raises OtherBoard with the
    sentence where another board is seen.
    """
    small = shrunk(grey, LONGEST_PX)
    low, high = np.quantile(small, [0.01, 0.99])
    if high - low < BLANK_GREY:
        return (
            f"the picture is blank: nearly all of it has grey levels from {low:.0f} to {high:.0f}"
        )
    asked = f"the {board.text} asked for"
    if reason := _what_else(small, board):
        raise OtherBoard(f"not {asked}, but {reason}")
    if corners:
        return (
            f"only {corners} usable corners of {asked}: at least 6 are needed that do not lie on "
            "one line; bring more of the board into the picture"
        )
    return _nothing(small, board)


def _what_else(grey: Grey, board: Board) -> str:
    """Another board that is seen, and what to change; "" for none."""
    markers = _best_markers(grey, board)
    if markers and board.kind == "charuco":
        return _other_markers(markers, board)
    if markers:
        count = f"{len(markers.ids)} markers of {markers.dictionary}"
        return f"{count}: this is a ChArUco board, use Board('charuco', ...)"
    squares = _checkerboard_seen(grey, board)
    if squares is None:
        return ""
    seen = "a checkerboard of {}x{} squares".format(*squares)
    if board.kind == "charuco":
        return f"{seen}, without markers: use Board('checkerboard', {squares}, ...)"
    if sorted(squares) == sorted(count + 1 for count in board.squares):
        return f"{seen}: you gave inner corners, squares are one more in each direction"
    return f"{seen}: use squares={squares}"


def _nothing(grey: Grey, board: Board) -> str:
    """No board of any kind: the advice that fits the picture."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (5, 5), 1.0)
    steepest = np.quantile(np.hypot(*np.gradient(smooth)), 0.999)
    width_px = np.subtract(*np.quantile(smooth, [0.99, 0.01])) / max(steepest, 1e-3)
    if width_px > BLURRED_PX:
        return (
            f"no board seen, and the picture is blurred (its sharpest edges are {width_px:.0f} px "
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


# --- checkerboards of another size ---


def _checkerboard_seen(grey: Grey, board: Board) -> tuple[int, int] | None:
    """(columns, rows) of SQUARES of a checkerboard that is whole in the image, or None.

    Turned by a quarter it is the same board: the longer side is where `board` has it.

    OpenCV's search for boards of any size says whether there is one at all; the size that it
    reports is often one off, so likely ones are put to the search for a given size: one more each
    way than asked for (a miscount), near what is seen, near what is asked for, common ones.
    """
    small = shrunk(grey, CHECKERBOARD_PX)
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE
    found, _, meta = cv2.findChessboardCornersSBWithMeta(small, (3, 3), flags)
    if not found:
        return None
    (columns, rows), (seen_rows, seen_columns) = board.corners, meta.shape[:2]
    near = tuple(product((0, -1, 1), repeat=2))
    likely = [(columns + 1, rows + 1), (seen_columns, seen_rows)]
    likely += [(seen_columns + a, seen_rows + b) for a, b in near]
    likely += [(columns + a, rows + b) for a, b in near]
    tried = {tuple(sorted(board.corners))}
    for corners in (*likely, *COMMON_CORNERS):
        few, many = sorted(corners)
        if few < FEWEST_SQUARES["checkerboard"] - 1 or (few, many) in tried:
            continue
        tried.add((few, many))
        if checkerboard_grid(small, corners, SEARCHES[:1]) is not None:
            return (many + 1, few + 1) if columns >= rows else (few + 1, many + 1)
    return None


# --- other markers, or the same on another plan ---


def _best_markers(grey: Grey, board: Board) -> _Markers | None:
    """The dictionary with the most markers in the image, the board's own where it has enough."""
    names = [board.dictionary] if board.kind == "charuco" else []
    seen = [_markers(grey, name) for name in (*names, *FAMILIES)]
    best = max(seen, key=lambda markers: len(markers.ids))
    return best if len(best.ids) >= FEWEST_MARKERS else None


def _markers(grey: Grey, name: str) -> _Markers:
    """The markers of one dictionary in the image."""
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    corners, ids, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(grey)
    centres = np.array([corner.reshape(4, 2).mean(axis=0) for corner in corners], np.float64)
    numbers = np.empty(0, np.intp) if ids is None else ids.ravel().astype(np.intp)
    return _Markers(name, numbers, centres.reshape(-1, 2))


def _other_markers(markers: _Markers, board: Board) -> str:
    """Markers are seen, of this dictionary or another; "" where they fit the board asked for."""
    name = _short_name(markers, board)
    count = f"{len(markers.ids)} markers of {name}"
    if name != board.dictionary:
        return f"{count}: use dictionary={name!r}"
    if _on_plan(markers, board):
        return ""
    counts = range(FEWEST_SQUARES["charuco"], MOST_SQUARES + 1)
    sizes = ((columns, rows) for columns in counts for rows in counts)
    for squares in sorted(sizes, key=lambda size: (size[0] * size[1], size)):  # fewest first
        if (squares[0] * squares[1] + 1) // 2 <= markers.ids.max():
            continue
        for other in _plans(board, squares):
            if _on_plan(markers, other):
                changes = [f"squares={squares}"] * (squares != board.squares)
                if other.old_origin != board.old_origin and squares[1] % 2 == 0:
                    changes.append(f"old_origin={other.old_origin}")
                as_on = "{}x{} squares".format(*squares)
                return f"{count} as on a board of {as_on} or more: use {', '.join(changes)}"
    return f"{count} that lie as on no board of up to {MOST_SQUARES}x{MOST_SQUARES} squares"


def _short_name(markers: _Markers, board: Board) -> str:
    """The board's dictionary if it holds the markers, else the shortest of their family."""
    family, _, length = markers.dictionary.rpartition("_")
    if markers.dictionary == board.dictionary or length != "1000":
        return markers.dictionary
    own_family, _, own_length = board.dictionary.rpartition("_")
    if own_family == family and int(own_length) > markers.ids.max():
        return board.dictionary
    shortest = min(n for n in FAMILY_LENGTHS if n > markers.ids.max())
    return f"{family}_{max(shortest, 250)}"


def _plans(board: Board, squares: tuple[int, int]) -> Iterator[Board]:
    """The board with so many squares, with its own origin and with the other one."""
    for old_origin in (board.old_origin, not board.old_origin):
        try:
            yield replace(board, squares=squares, old_origin=old_origin)
        except ValueError:  # more squares than the dictionary has markers
            return


def _on_plan(markers: _Markers, board: Board) -> bool:
    """Whether the markers lie where the board has them, up to a homography."""
    plan: Any = board.marker_centres
    known = markers.ids < len(plan)
    if known.sum() < max(FEWEST_MARKERS, SHARE_ON_PLAN * len(known)):
        return False
    on_board, centres = plan[markers.ids[known]], markers.centres[known]
    H, _ = cv2.findHomography(centres, on_board, cv2.RANSAC, OFF_PLAN)
    if H is None:
        return False
    mapped = np.c_[centres, np.ones(len(centres))] @ H.T
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.linalg.norm(mapped[:, :2] / mapped[:, 2:] - on_board, axis=1)
    return bool((off < 3 * OFF_PLAN).mean() >= SHARE_ON_PLAN)
