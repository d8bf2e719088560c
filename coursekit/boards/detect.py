"""Find a board in an image, to a fraction of a pixel."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from coursekit.boards.blur import blur_covariance
from coursekit.boards.board import Board
from coursekit.boards.detection import BoardNotFound, Detection
from coursekit.boards.explain import explain
from coursekit.boards.find import find, steps
from coursekit.boards.refine import refine

FEWEST_CORNERS = 6
SMALLEST_PX = 40  # shorter side of an image in which a board can be told


def detect(image: NDArray[np.uint8], board: Board, name: str = "") -> Detection:
    """The corners of `board` in one image, with their noise and the image's blur.

    image: (H, W) grey or (H, W, 3) RGB, uint8. A checkerboard must be seen whole, a ChArUco board
    in part. Corners are refined in a window of 0.4 of a square (module `refine`). On a
    checkerboard the colours of the squares tell which corner is the first, as in `Board.image`;
    where they cannot (`board.turns` is not 1) it is the turn whose x axis points most to the
    right, which may change from view to view: harmless for K, not for what needs the pose.

    Raises BoardNotFound, which says what is there instead, and ValueError for what is no image.
    """
    grey = _grey(image)
    if min(grey.shape) < SMALLEST_PX:
        raise BoardNotFound(
            f"the picture is {grey.shape[1]}x{grey.shape[0]} px: too small to show a board"
        )
    found = find(grey, board)
    if found is None or not _usable(found[0], board):
        raise BoardNotFound(explain(grey, board, 0 if found is None else len(found[0])))
    ids, start = found
    pixels, covariances = refine(grey, start, steps(start, ids, board), ids, board)
    good = np.isfinite(pixels[:, 0])
    ids, pixels, covariances = ids[good], pixels[good], covariances[good]
    if not _usable(ids, board):
        raise BoardNotFound(explain(grey, board, len(ids)))
    return Detection(
        ids=ids,
        pixels=pixels,
        size=(grey.shape[1], grey.shape[0]),
        name=name,
        noise_px=float(np.sqrt(np.trace(covariances, axis1=1, axis2=2).mean() / 2)),
        blur=blur_covariance(grey, pixels, ids, steps(pixels, ids, board), board),
    )


def _usable(ids: NDArray[np.intp], board: Board) -> bool:
    """Whether there are corners enough, and not all on one line."""
    if len(ids) < FEWEST_CORNERS:
        return False
    plane = board.points[ids][:, :2]
    return bool(np.linalg.matrix_rank(plane - plane[0], tol=0.1 * board.square_m) == 2)


def _grey(image: object) -> NDArray[np.uint8]:
    """The image as a contiguous (H, W) array; ValueError for what is no image."""
    array = np.asarray(image)
    if array.dtype != np.uint8 or not (array.ndim == 2 or array.shape[2:] == (3,)):
        raise ValueError(
            f"image: got {array.dtype} of shape {array.shape}, want uint8 (H, W) grey or "
            "(H, W, 3) RGB"
        )
    if array.size == 0:
        raise ValueError(f"image: got shape {array.shape}, want at least one pixel")
    if array.ndim == 3:
        grey = cv2.cvtColor(np.ascontiguousarray(array), cv2.COLOR_RGB2GRAY)
        return np.asarray(grey, np.uint8)
    return np.ascontiguousarray(array)
