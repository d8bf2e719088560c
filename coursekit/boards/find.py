"""Where a board is in an image, to about a pixel, and which of its corners is which.

OpenCV finds candidates; what is added here keeps out what it takes for a board and is none, and
tells which corner is the first. `refine_corners` makes fractions of a pixel of them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import numpy as np

from coursekit.arrays import Bools, Floats, Grey, NDArray
from coursekit.boards.board import Board

Corners = tuple[NDArray[np.intp], Floats]  # ids (N,) and pixels (N, 2)

LOOK_AT = ((0.25, 0.25), (0.3, 0.12), (0.12, 0.3))  # squares from a corner along x and y
LEAST_REAL = 0.7  # of the corners in each row and column of a checkerboard are real,
MOST_BEYOND = 0.5  # and in the lines beyond them no more
MOST_LINES = 40  # of corners each way
OFF_PLANE = 0.4, 0.2  # squares: a corner is no farther from its place, as found and as refined
LEAST_ON_PLANE = 0.7  # of the corners
# Lenses that are tried: what is seen at r half diagonals from the middle would be seen without the
# lens at r / (1 + k r^2) (Fitzgibbon 2001); the most negative is a fisheye's.
LENSES = (0.0, -0.1, -0.2, -0.35, -0.5, -0.7, -0.9, 0.1, 0.2, 0.4)


def find_corners(grey: Grey, board: Board) -> Corners | None:
    """The board's corners in a grey image: ids (N,) and pixels (N, 2), or None.

    A checkerboard is found whole or not at all. OpenCV's older search finds boards that touch
    other dark things, its newer one (after Duda and Frese 2018) blurred and noisy ones. In vain,
    the older one may take 20 s of a large cluttered image: so it looks at small ones alone, and
    where a first glance or the newer one says that it will find something.

    Corners that lie far from where a plane and a lens would have them are left out; where they are
    many, what was found is no board.
    """
    for longest_px, looks in LOOKS[board.kind]:
        small = shrunk(grey, longest_px)
        scale = np.array(grey.shape[::-1]) / small.shape[::-1]
        for look in looks:
            found = look(small, board)
            if found is not None:
                ids, pixels = found
                near = on_plane(ids, pixels, small.shape[::-1], board, OFF_PLANE[0])
                if near.any():
                    return ids[near], (pixels[near] + 0.5) * scale - 0.5
        if small is grey:
            break
    return None


def on_plane(
    ids: NDArray[np.intp], pixels: Floats, size: tuple[int, ...], board: Board, most: float
) -> Bools:
    """(N,): which corners lie where the board's plane has them, seen through one of LENSES.

    size: (width, height), px. most: how far from there they may be, squares. None do where fewer
    than LEAST_ON_PLANE would: then what was found is no board.
    """
    if len(ids) <= 4:  # any four corners lie on a plane
        return np.ones(len(ids), bool)
    plane = board.points[ids, :2] / board.square_m
    rays = (pixels - (np.array(size) - 1) / 2) / (0.5 * np.hypot(size[0], size[1]))
    best = np.zeros(len(ids), bool)
    for k in LENSES:
        straight = rays / (1 + k * (rays**2).sum(axis=1, keepdims=True))
        near = off_homography(straight, plane, most) < most
        if near.sum() > best.sum():
            best = near
        if best.all():
            break
    return best if best.mean() >= LEAST_ON_PLANE else np.zeros_like(best)


def off_homography(points: Floats, plane: Floats, most: float) -> Floats:
    """How far (N,) points (N, 2) are from their places (N, 2) on a plane, after the homography
    that brings most of them nearer than `most`; infinite where there is none."""
    H, _ = cv2.findHomography(points, plane, cv2.RANSAC, most)
    if H is None:
        return np.full(len(points), np.inf)
    return np.linalg.norm(cv2.perspectiveTransform(points[None], H)[0] - plane, axis=1)


def shrunk(grey: Grey, longest_px: int) -> Grey:
    """The image with its longer side at most so long; the image itself where it is."""
    shrink = longest_px / max(grey.shape)
    if shrink >= 1.0:
        return grey
    height, width = grey.shape
    size = (max(round(width * shrink), 1), max(round(height * shrink), 1))
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


def _older(grey: Grey, board: Board, glance: int = cv2.CALIB_CB_FAST_CHECK) -> Corners | None:
    flags = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | glance
    return _checkerboard(grey, board, *cv2.findChessboardCorners(grey, board.corners, None, flags))


def _newer(grey: Grey, board: Board) -> Corners | None:
    return _checkerboard(grey, board, *cv2.findChessboardCornersSB(grey, board.corners))


def _either(grey: Grey, board: Board) -> Corners | None:
    """As the older search has it without its glance, where the newer one finds the board too."""
    found = _newer(grey, board)
    return found and (_older(grey, board, 0) or found)


LOOKS: dict[str, Any] = {  # the longest side in px to which an image is made smaller, the searches
    "checkerboard": ((1000, (_older, _either)), (2000, (_newer,))),
    "charuco": ((2000, (_charuco,)), (4000, (_charuco,))),
}


def _checkerboard(grey: Grey, board: Board, found: bool, pixels: Any) -> Corners | None:
    """What a search found, if it is the whole board.

    Where a row of corners is outside the image, OpenCV's searches may take the pattern's outer edge
    for it, and all corners move by one; so every row and column must consist of real corners. And
    they may take a part of a larger board: beyond the last row and column there must be none.
    """
    if not found:
        return None
    columns, rows = board.corners
    grid = pixels.reshape(rows, columns, 2).astype(np.float64)
    if not _is_whole(grey, grid):
        return None
    return np.arange(len(board.points)), _oriented(grey, grid, board).reshape(-1, 2)


def checkerboard_seen(grey: Grey) -> Floats | None:
    """The inner corners (rows, columns, 2), px, of a checkerboard of whatever size, or None.

    OpenCV's search for boards of any size often reports one line too few or too many, so lines of
    corners that are none are dropped, and real ones beyond the last are added.
    """
    for flags in (cv2.CALIB_CB_LARGER, cv2.CALIB_CB_LARGER | cv2.CALIB_CB_EXHAUSTIVE):
        found, pixels, meta = cv2.findChessboardCornersSBWithMeta(grey, (3, 3), flags)
        if found:
            grid = _fitted(grey, pixels.reshape(*meta.shape[:2], 2).astype(np.float64))
            if min(grid.shape[:2]) > 2 and _is_whole(grey, grid):
                return grid
    return None


def _fitted(grey: Grey, grid: Floats) -> Floats:
    """The corners (rows, columns, 2) without outer lines that are none, and with those beyond."""
    for _ in range(4):  # sides
        while len(grid) > 2 and _is_saddle(grey, grid)[0].mean() <= LEAST_REAL:
            grid = grid[1:]
        while len(grid) < MOST_LINES and real_beyond(grey, grid)[0] >= MOST_BEYOND:
            grid = np.concatenate([2 * grid[:1] - grid[1:2], grid])
        grid = np.rot90(grid)
    return grid


def _is_whole(grey: Grey, grid: Floats) -> bool:
    real = _is_saddle(grey, grid)
    least = min(real.mean(axis=0).min(), real.mean(axis=1).min())
    return bool(least > LEAST_REAL and max(real_beyond(grey, grid)) < MOST_BEYOND)


def real_beyond(grey: Grey, grid: Floats) -> list[float]:
    """The share of real corners in the four lines next to the grid: above, below, left, right."""
    around = ((1, 1), (1, 1), (0, 0))
    wide = np.pad(grid, around, mode="reflect", reflect_type="odd")  # one line more on each side
    real = _is_saddle(grey, wide)
    lines = (real[0, 1:-1], real[-1, 1:-1], real[1:-1, 0], real[1:-1, -1])
    return [float(line.mean()) for line in lines]


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


def _around(grey: Grey, grid: Floats, share: tuple[float, float]) -> Iterator[Floats]:
    """Grey of the squares towards (-x, -y), (+x, +y), (-x, +y), (+x, -y), (rows, columns) each.

    share: how far away, in squares along x and y.
    """
    x, y = share[0] * np.gradient(grid, axis=1), share[1] * np.gradient(grid, axis=0)
    height, width = grey.shape

    def nearest(pixels: Floats) -> Floats:  # the image's rim for pixels outside
        u, v = np.rint(pixels).astype(int).transpose(2, 0, 1)
        return grey[v.clip(0, height - 1), u.clip(0, width - 1)].astype(np.float64)

    return (nearest(grid + a * x + b * y) for a, b in ((-1, -1), (1, 1), (-1, 1), (1, -1)))
