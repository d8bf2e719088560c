"""Why a board was not found, in words that name the likely cause.

An image is asked in turn: is it blank? Does it show markers, as they are, mirrored or with white
for black, of which dictionary, on which plan? A checkerboard, and of which size? A grid of circles?
Is it blurred? The first answer that explains the failure is given, starting with what is seen and
ending with what to change.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

from coursekit.arrays import Floats, Grey, NDArray
from coursekit.boards.board import DICTIONARIES, FEWEST_CORNERS, FEWEST_SQUARES, Board, OtherBoard
from coursekit.boards.find import checkerboard_seen, off_homography, real_beyond, shrunk
from coursekit.words import ROOM_TEXTS, say

LONGEST_PX = 1600  # an image is looked at no larger than this
ANY_SIZE_PX = 800  # ... and where checkerboards of any size are looked for than this
BLANK_GREY = 15.0  # levels between the darkest and the brightest hundredth
BLURRED_PX = 5.0  # the sharpest edges of a picture that shows a board are steeper than this
FAMILIES = tuple(  # the largest dictionary of each; the smaller ones are their beginnings
    name for name in DICTIONARIES if not name.endswith(("_50", "_100", "_250"))
)
WAYS: dict[str, Callable[[Grey], Grey]] = {  # to look for markers, and what they then are
    "": lambda grey: grey,
    "mirrored": lambda grey: np.ascontiguousarray(grey[:, ::-1]),
    "with white for black": lambda grey: 255 - grey,
    "mirrored, with white for black": lambda grey: np.ascontiguousarray(255 - grey[:, ::-1]),
}
FEWEST_MARKERS, MANY_MARKERS = 4, 12  # so many are never seen mirrored by mistake
FEWEST_ON_PLAN = 6  # markers: any four lie on some plan
MOST_SQUARES = 20  # each way that are tried
OFF_PLAN = 0.1  # squares: markers of the right board lie on its plan within this
SHARE_ON_PLAN = 0.95  # a board with the other origin has 8 of 9 in the right place
SQUARE = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]], np.float32)
FAR = 8.0  # half sides of a marker: its neighbours on a board are nearer
CUT = 0.25  # of the corners in the line beyond a checkerboard are real: something hides the others
FEWEST_CIRCLES, LEAST_ROUND = 12, 0.82
OFF_ROW = 0.25  # of the distance between two circles: the third in their row is off by less


class _Markers(NamedTuple):
    """Markers seen: in which of WAYS, their dictionary, numbers (M,) and corners (M, 4, 2) px."""

    way: str
    dictionary: str
    ids: NDArray[np.intp]
    corners: Floats

    @property
    def centres(self) -> Floats:
        """(M, 2) px."""
        return self.corners.mean(axis=1)


def explain(grey: Grey, board: Board, corners: int) -> str:
    """Why `board` was not found in a grey image (H, W), uint8, in one sentence.

    corners: how many of the board's corners were found, too few for use. Raises OtherBoard with the
    sentence where another board is seen.
    """
    small = shrunk(grey, LONGEST_PX)
    low, high = np.quantile(small, [0.01, 0.99])
    if high - low < BLANK_GREY:
        return say("boards.blank", low=low, high=high)
    asked = f"the {board.text} asked for"
    if reason := _what_else(small, board):
        raise OtherBoard(say("boards.not_asked_for", asked=asked, reason=reason))
    if corners:
        return say("boards.few_corners", corners=corners, asked=asked, least=FEWEST_CORNERS)
    if (width_px := _edges_px(small)) > BLURRED_PX:
        return say("boards.blurred", width_px=width_px)
    return say(f"boards.no_{board.kind}", board=board)


def _what_else(grey: Grey, board: Board) -> str:
    """Another board that is seen, and what to change; "" for none."""
    if markers := _markers(grey, board):
        return _marked(markers, board)
    blurred = _edges_px(grey) > BLURRED_PX
    if reason := _checkered(shrunk(grey, ANY_SIZE_PX), board, blurred):
        return reason
    circles = not blurred and _has_circles(grey)
    return say("boards.circles", not_usable=say("boards.not_usable")) if circles else ""


def _edges_px(grey: Grey) -> float:
    """How wide the sharpest edges of an image are, px."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (5, 5), 1.0)
    steepest = np.quantile(np.hypot(*np.gradient(smooth)), 0.999)
    return float(np.subtract(*np.quantile(smooth, [0.99, 0.01])) / max(steepest, 1e-3))


# --- checkerboards of another size, circles ---


def _checkered(grey: Grey, board: Board, blurred: bool) -> str:
    """A checkerboard of another size is seen; "" for none.

    Turned by a quarter it is the same board: the longer side is where `board` has it.
    """
    grid = checkerboard_seen(grey)
    if grid is None:
        return ""
    few, many = sorted(count + 1 for count in grid.shape[:2])
    squares = (many, few) if board.squares[0] >= board.squares[1] else (few, many)
    size = "{}x{} squares".format(*squares)
    cut = _is_cut(grey, grid)
    found = board.kind == "checkerboard" and squares == board.squares  # but not as it should be
    if found or (cut and blurred):  # a blur hides the outer corners
        return ""
    if board.kind == "charuco":
        what = "without_markers"
    elif cut and np.less_equal(squares, board.squares).all():
        what = "part"
    elif sorted(squares) == sorted(count + 1 for count in board.squares):
        what = "inner_corners"
    else:
        what = "other_squares"
    return say(f"boards.{what}", size=size, squares=squares)


def _is_cut(grey: Grey, grid: Floats) -> bool:
    """Whether the outer squares around these corners leave the image, or more corners follow."""
    around = np.pad(grid, ((1, 1), (1, 1), (0, 0)), mode="reflect", reflect_type="odd")
    outside = (around < -2) | (around > np.array(grey.shape[::-1]) + 1)
    return bool(outside.any() or max(real_beyond(grey, grid)) > CUT)


def _has_circles(grey: Grey) -> bool:
    """Whether there are many round blobs, dark or bright, most of them in rows of three.

    Where both are, they are the squares of a chessboard, blurred.
    """
    opencv: Any = cv2  # whose type stubs lack the blobs
    settings = opencv.SimpleBlobDetector_Params()
    settings.minArea, settings.maxArea = 20, grey.size / 50
    settings.filterByCircularity, settings.minCircularity = True, LEAST_ROUND
    seen = 0
    for image in (grey, 255 - grey):
        blobs = opencv.SimpleBlobDetector_create(settings).detect(image)
        if len(blobs) < FEWEST_CIRCLES:
            continue
        centres = np.array([blob.pt for blob in blobs])
        tree = cKDTree(centres)
        distance, index = tree.query(centres, k=2)
        step = centres[index[:, 1]] - centres
        off = [tree.query(third)[0] for third in (centres - step, centres + 2 * step)]
        seen += (np.min(off, axis=0) < OFF_ROW * distance[:, 1]).mean() > 0.8
    return seen == 1


# --- other markers, or the same on another plan ---


def _markers(grey: Grey, board: Board) -> _Markers | None:
    """The markers of the dictionary and the way that show the most, the board's own where equal."""
    names = [board.dictionary] if board.kind == "charuco" else []
    names += [name for name in FAMILIES if name not in names]
    dictionaries = [cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name)) for name in names]
    detector = cv2.aruco.ArucoDetector(dictionaries)
    best = None
    for way, seen_so in WAYS.items():
        if best is not None and len(best.ids) >= MANY_MARKERS:
            break
        corners, ids, _, which = detector.detectMarkersMultiDict(seen_so(grey))
        if len(corners) == 0:
            continue
        counts = np.bincount(which.ravel().astype(np.intp), minlength=len(names))
        most = int(counts.argmax())
        if counts[most] >= FEWEST_MARKERS and (best is None or counts[most] > len(best.ids)):
            own = which.ravel() == most
            boxes = np.array(corners, np.float64).reshape(-1, 4, 2)[own]
            best = _Markers(way, names[most], ids.ravel()[own].astype(np.intp), boxes)
    return best


def _marked(markers: _Markers, board: Board) -> str:
    """What markers show, of this dictionary or another; "" where they fit the board asked for."""
    seen = f"{len(markers.ids)} markers of {_short_name(markers, board)}"
    if markers.way:
        cure = ROOM_TEXTS["boards"]["cures"][markers.way]
        return f"{len(markers.ids)} markers, all {markers.way}: {cure}"
    if _is_grid(markers):
        return say("boards.tags", seen=seen, not_usable=say("boards.not_usable"))
    if board.kind == "checkerboard":
        return say("boards.with_markers", seen=seen)
    return _other_charuco(markers, board, seen)


def _other_charuco(markers: _Markers, board: Board, seen: str) -> str:
    """What is different about a ChArUco board, so many markers of which are seen; "" for nothing"""
    if len(np.unique(markers.ids)) < SHARE_ON_PLAN * len(markers.ids):
        return say("boards.twice", seen=seen)
    name, enough = _short_name(markers, board), len(markers.ids) >= FEWEST_ON_PLAN
    plans = _plans(board, name, markers.ids) if enough else ()
    plan = next((plan for plan in plans if _on_plan(markers, plan)), None)
    if plan is None and name != board.dictionary:
        return say("boards.other_dictionary", seen=seen, name=name)
    if plan is None:
        return say("boards.no_plan", seen=seen, most=MOST_SQUARES) if enough else ""
    fields = ("dictionary", "squares", "first_marker", "old_origin")
    new = [(field, getattr(plan, field)) for field in fields]
    changes = [f"{field}={value!r}" for field, value in new if value != getattr(board, field)]
    if changes:
        size = "{}x{} squares".format(*plan.squares)
        return say("boards.other_plan", seen=seen, size=size, changes=", ".join(changes))
    return ""


def _is_grid(markers: _Markers) -> bool:
    """Whether a marker's nearest neighbour lies beside it; on a ChArUco board it is at a corner."""
    beside = []
    for box in markers.corners.astype(np.float32):
        to_square = cv2.getPerspectiveTransform(box, SQUARE)
        others = cv2.perspectiveTransform(markers.centres[None], to_square)[0]
        distance = np.linalg.norm(others, axis=1)
        distance[distance < 1.0] = np.inf  # itself
        nearest = distance.argmin()
        if distance[nearest] < FAR:
            few, many = np.sort(np.abs(others[nearest]))
            beside.append(few < np.tan(np.pi / 8) * many)
    return len(beside) > 0 and bool(np.mean(beside) > 0.5)


def _short_name(markers: _Markers, board: Board) -> str:
    """The board's dictionary if it holds the markers, else one of their family: _250 or _1000."""
    family, _, length = markers.dictionary.rpartition("_")
    if markers.dictionary == board.dictionary or length != "1000":
        return markers.dictionary
    own_family, _, own_length = board.dictionary.rpartition("_")
    if own_family == family and int(own_length) > markers.ids.max():
        return board.dictionary
    return f"{family}_{250 if markers.ids.max() < 250 else 1000}"


def _plans(board: Board, dictionary: str, ids: NDArray[np.intp]) -> Iterator[Board]:
    """What the board may be, the likeliest first: as asked for, of another size, counted from
    another first marker; each with its own origin and with the other one."""
    first, (columns, rows) = board.first_marker, board.squares
    counts = range(FEWEST_SQUARES["charuco"], MOST_SQUARES + 1)
    lowest, highest = int(ids.min()), int(ids.max())
    tries = [(first, columns, rows), (lowest, columns, rows)]
    for start in (first, lowest):
        fewest = {n: max(2 * (highest - start + 1) // n, counts[0]) for n in counts}
        sizes = [(n, m) for n in counts for m in range(fewest[n], fewest[n] + 3)]
        sizes = [(n, m) for n, m in sizes if highest - start < (n * m + 1) // 2 and m in counts]
        tries += [(start, *size) for size in sorted(sizes, key=lambda size: size[0] * size[1])]
    tries += [(start, columns, rows) for start in range(lowest, -1, -1)[1:columns]]
    for start, n, m in tries:
        for old in (board.old_origin, not board.old_origin)[: 1 + (m + 1) % 2]:
            plan: dict[str, Any] = {"squares": (n, m), "first_marker": start, "old_origin": old}
            try:
                yield replace(board, dictionary=dictionary, **plan)
            except ValueError:  # more squares than the dictionary has markers
                continue


def _on_plan(markers: _Markers, board: Board) -> bool:
    """Whether the markers lie where the board has them, up to a homography."""
    plan = np.argwhere(board.white)[:, ::-1] + np.float64(0.5)  # their centres, in squares
    numbers = markers.ids - board.first_marker
    known = (numbers >= 0) & (numbers < len(plan))
    if known.sum() < max(FEWEST_MARKERS, SHARE_ON_PLAN * len(known)):
        return False
    off = off_homography(markers.centres[known], plan[numbers[known]], OFF_PLAN)
    return bool((off < 3 * OFF_PLAN).mean() >= SHARE_ON_PLAN)
