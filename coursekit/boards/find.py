"""Where a board is in an image, to about a pixel, and which of its corners is which.

OpenCV finds candidates; what is added here keeps out what it takes for a board and is none, and
tells which corner is the first. `refine_corners` makes fractions of a pixel of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np

from coursekit.arrays import Bools, Floats, Grey, NDArray
from coursekit.boards.board import Board

Corners = tuple[NDArray[np.intp], Floats]  # ids (N,) and pixels (N, 2)

# Longest side in px at which a board is looked for; a larger image is made smaller first, and
# looked at again in the next size when nothing is found.
LOOKED_AT_PX = {"checkerboard": (1000, 2000), "charuco": (2000, 4000)}
SEARCHES = (cv2.findChessboardCorners, cv2.findChessboardCornersSB)  # the quick one first
LOOK_AT = ((0.25, 0.25), (0.3, 0.12), (0.12, 0.3))  # squares from a corner along x and y
LEAST_REAL = 0.7  # of the corners in each row and column of a checkerboard are real,
MOST_BEYOND = 0.5  # and in the lines beyond them no more


def find_corners(grey: Grey, board: Board) -> Corners | None:
    """The board's corners in a grey image: ids (N,) and pixels (N, 2), or None.

    A checkerboard is found whole or not at all. OpenCV's older search finds boards that touch
    other dark things, its newer one (after Duda and Frese 2018) blurred and noisy ones: the second
    is tried where the first finds nothing.
    """
    look = _charuco if board.kind == "charuco" else _checkerboard
    for longest_px in LOOKED_AT_PX[board.kind]:
        small = shrunk(grey, longest_px)
        found = look(small, board)
        if found is not None:
            ids, pixels = found
            scale = np.array(grey.shape[::-1]) / small.shape[::-1]
            return ids, (pixels + 0.5) * scale - 0.5
        if small is grey:
            break
    return None


def shrunk(grey: Grey, longest_px: int) -> Grey:
    """The image with its longer side at most so long; the image itself where it is."""
    shrink = longest_px / max(grey.shape)
    if shrink >= 1.0:
        return grey
    height, width = grey.shape
    size = (round(width * shrink), round(height * shrink))
    return np.asarray(cv2.resize(grey, size, interpolation=cv2.INTER_AREA), np.uint8)


def _charuco(grey: Grey, board: Board) -> Corners | None:
    settings = cv2.aruco.CharucoParameters()
    settings.minMarkers = 1  # of the two beside a corner: half as many corners again in a blur
    pixels, ids, _, _ = cv2.aruco.CharucoDetector(board.opencv(), settings).detectBoard(grey)
    if ids is None or len(ids) == 0:
        return None
    columns, rows = board.corners
    row, column = np.divmod(ids.ravel().astype(np.intp), columns)
    if board.old_origin:  # OpenCV counts from the top whatever the origin
        row = rows - 1 - row
    numbers = row * columns + column
    order = np.argsort(numbers)
    return numbers[order], pixels.reshape(-1, 2).astype(np.float64)[order]


def _checkerboard(grey: Grey, board: Board) -> Corners | None:
    grid = checkerboard_grid(grey, board.corners)
    if grid is None:
        return None
    return np.arange(len(board.points)), _oriented(grey, grid, board).reshape(-1, 2)


def checkerboard_grid(
    grey: Grey, corners: tuple[int, int], searches: Sequence[Any] = SEARCHES
) -> Floats | None:
    """(rows, columns, 2) px of a checkerboard with (columns, rows) inner corners, or None.

    Where a row of corners is outside the image, OpenCV's searches may take the pattern's outer edge
    for it, and all corners move by one; so every row and column must consist of real corners. And
    they may take a part of a larger board: beyond the last row and column there must be none.
    """
    for search in searches:
        found, pixels = search(grey, corners)
        if found:
            grid = pixels.reshape(corners[1], corners[0], 2).astype(np.float64)
            real = _is_saddle(grey, grid)
            least = min(real.mean(axis=0).min(), real.mean(axis=1).min())
            if least > LEAST_REAL and _share_real_beyond(grey, grid) < MOST_BEYOND:
                return grid
    return None


def _share_real_beyond(grey: Grey, grid: Floats) -> float:
    """The largest share of real corners in the four lines next to the grid."""
    around = ((1, 1), (1, 1), (0, 0))
    wide = np.pad(grid, around, mode="reflect", reflect_type="odd")  # one line more on each side
    real = _is_saddle(grey, wide)
    lines = (real[0, 1:-1], real[-1, 1:-1], real[1:-1, 0], real[1:-1, -1])
    return float(max(line.mean() for line in lines))


def _is_saddle(grey: Grey, grid: Floats) -> Bools:
    """(rows, columns): whether opposite squares at a corner are alike and neighbours are not.

    And whether it is a corner of the kind, falling or rising, that is its turn. The squares are
    looked at in their middle and near either edge, which tells a grid from a skewed one.
    """
    last = np.array(grey.shape[::-1]) - 1
    real: Bools = np.all((grid >= 0) & (grid <= last), axis=-1)
    for share in LOOK_AT:
        a, b, c, d = _around(grey, grid, share)
        in_turn = a + b - c - d
        in_turn[1::2] *= -1
        in_turn[:, 1::2] *= -1
        in_turn *= np.sign(in_turn.sum())
        real &= np.maximum(np.abs(a - b), np.abs(c - d)) < 0.5 * in_turn
    return real


def _oriented(grey: Grey, grid: Floats, board: Board) -> Floats:
    """The (rows, columns, 2) corners turned so that x, y and the colours are the board's.

    Of turns that the colours do not tell apart, the one whose x points most to the right.
    """
    along_x = np.gradient(grid, axis=1).mean(axis=(0, 1))
    along_y = np.gradient(grid, axis=0).mean(axis=(0, 1))
    if along_x[0] * along_y[1] - along_x[1] * along_y[0] < 0:  # left for right: count backwards
        grid = grid[:, ::-1]
    turns = [np.rot90(grid, k) for k in range(4)]
    turns = [turn for turn in turns if turn.shape == grid.shape]
    expected = np.where(board.falling, 1.0, -1.0).reshape(grid.shape[:2])
    # how well the colours at the corners agree with the board's, by the way of their contrast
    around = [_around(grey, turn, LOOK_AT[0]) for turn in turns]
    fits = [float((expected * (a + b - c - d)).sum()) for a, b, c, d in around]
    if max(fits) > 0:  # otherwise a symmetric board printed with white for black
        turns = [turn for turn, fit in zip(turns, fits, strict=True) if fit > 0.5 * max(fits)]
    return max(turns, key=lambda turn: float(np.gradient(turn, axis=1)[..., 0].mean()))


def _around(
    grey: Grey, grid: Floats, share: tuple[float, float]
) -> tuple[Floats, Floats, Floats, Floats]:
    """Grey of the squares towards (-x, -y), (+x, +y), (-x, +y), (+x, -y), (rows, columns) each.

    share: how far away, in squares along x and y.
    """
    x, y = share[0] * np.gradient(grid, axis=1), share[1] * np.gradient(grid, axis=0)
    height, width = grey.shape

    def nearest(pixels: Floats) -> Floats:  # the image's rim for pixels outside
        u, v = np.rint(pixels).astype(int).transpose(2, 0, 1)
        return grey[v.clip(0, height - 1), u.clip(0, width - 1)].astype(np.float64)

    return (
        nearest(grid - x - y),
        nearest(grid + x + y),
        nearest(grid - x + y),
        nearest(grid + x - y),
    )
