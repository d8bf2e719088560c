"""Find a board in an image, to a fraction of a pixel, and in many: a folder, files, arrays, frames.

    find_corners (to a pixel)  ->  refine_corners (to 0.05 px)  ->  Detection

What cannot be used is never dropped silently: `detect` says why it finds no board, `detect_all`
lists the images that it skipped, with the reason.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from coursekit.arrays import Grey, NDArray
from coursekit.boards.board import Board, BoardNotFound, Detection, Detections, OtherBoard, Skipped
from coursekit.boards.corners import blur_covariance, refine_corners, steps
from coursekit.boards.explain import explain
from coursekit.boards.find import find_corners
from coursekit.checks import want

FEWEST_CORNERS = 6
SMALLEST_IMAGE_PX = 40  # shorter side of an image in which a board can be told
SESSION = "session.json"  # written beside the images by the course itself


# --- one image ---


def detect(image: NDArray[np.uint8], board: Board, name: str = "") -> Detection:
    """The corners of `board` in one image, with their noise and the image's blur.

    image: (H, W) grey or (H, W, 3) RGB, uint8. A checkerboard must be seen whole, a ChArUco board
    in part. Corners are refined in a window of 0.4 of a square (module `corners`). On a
    checkerboard the colours of the squares tell which corner is the first, as in `Board.image`;
    where they cannot (two odd or two even numbers of squares) it is the turn whose x axis points
    most to the right, which may change from view to view: harmless for K, not for what needs the
    pose.

    Raises BoardNotFound, which says what is there instead, and ValueError for what is no image.

    >>> board = Board("charuco", (5, 4), 0.03)
    >>> seen = detect(np.pad(board.image(42), 40, constant_values=255), board)
    >>> len(seen), seen.pixels[0].round(1).tolist()
    (12, [81.5, 81.5])
    """
    grey = _grey(image)
    if min(grey.shape) < SMALLEST_IMAGE_PX:
        raise BoardNotFound(
            f"the picture is {grey.shape[1]}x{grey.shape[0]} px: too small to show a board"
        )
    found = find_corners(grey, board)
    if found is None or not _usable(found[0], board):
        raise BoardNotFound(explain(grey, board, 0 if found is None else len(found[0])))
    ids, start = found
    pixels, covariances = refine_corners(grey, start, steps(start, ids, board), ids, board)
    good = np.isfinite(pixels[:, 0])
    ids, pixels, covariances = ids[good], pixels[good], covariances[good]
    if not _usable(ids, board):
        raise BoardNotFound(explain(grey, board, len(ids)))
    noise_px = float(np.sqrt(np.trace(covariances, axis1=1, axis2=2).mean() / 2))
    blur = blur_covariance(grey, pixels, ids, steps(pixels, ids, board), board)
    return Detection(ids, pixels, (grey.shape[1], grey.shape[0]), name, noise_px, blur)


def _usable(ids: NDArray[np.intp], board: Board) -> bool:
    """Whether there are corners enough, and not all on one line."""
    if len(ids) < FEWEST_CORNERS:
        return False
    plane = board.points[ids][:, :2]
    return bool(np.linalg.matrix_rank(plane - plane[0], tol=0.1 * board.square_m) == 2)


def _grey(image: object) -> Grey:
    """The image as a contiguous (H, W) array; ValueError for what is no image."""
    pixels = np.asarray(image)
    shape = pixels.ndim == 2 or (pixels.ndim == 3 and pixels.shape[2] == 3)
    if pixels.dtype != np.uint8 or not shape or pixels.size == 0:
        got = f"{pixels.dtype} of shape {pixels.shape}"
        raise ValueError(f"image: got {got}, want uint8 (H, W) grey or (H, W, 3) RGB")
    if pixels.ndim == 3:
        pixels = np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY))
    return np.ascontiguousarray(pixels)


# --- many images ---


def detect_all(
    images: str | os.PathLike[str] | Iterable[Any], board: Board, progress: bool = True
) -> Detections:
    """The board in each of many images; what cannot be used is listed in `.skipped`, with why.

    images: a folder (all its files, in natural order, not those of folders in it), or a sequence
    of paths, of arrays (uint8, grey or RGB) or of a camera's frames, whose colour image is taken.
    Where sizes differ the commonest is used (of equally common ones the largest). Ctrl-C keeps
    what was detected until then, with one line.

    An orientation that a photograph carries is ignored: rotated pixels would belong to another
    camera, with cx and cy exchanged, and a phone sets it at whim when it looks down on a table.

    Raises ValueError when there is no such folder, when it is empty, or for anything else than
    images in a sequence.

    >>> board = Board("charuco", (5, 4), 0.03)
    >>> picture = np.pad(board.image(42), 40, constant_values=255)
    >>> detect_all([picture, np.zeros((99, 99), np.uint8)], board)
    1 view with 12 corners, 1 not used
      image 0: 12 corners in 290x248, noise 0.115 px
      not used: image 1: the picture is blank: nearly all of it has grey levels from 0 to 0
    """
    from tqdm.auto import tqdm

    sources = _sources(images)
    quiet = not progress or len(sources) < 10
    views: list[Detection] = []
    skipped: list[Skipped] = []
    try:
        for name, source in tqdm(sources, unit="image", leave=False, disable=quiet):
            try:
                views.append(detect(_read(source), board, name))
            except (BoardNotFound, _Unreadable) as reason:
                kind = "other_board" if isinstance(reason, OtherBoard) else ""
                skipped.append(Skipped(name, str(reason), kind))
    except KeyboardInterrupt:
        done = len(views) + len(skipped)
        print(f"Stopped after {done} of {len(sources)} images; they are kept.")
    return _of_one_size(views, skipped, [name for name, _ in sources])


class _Unreadable(Exception):
    """A file is no image; the message says what it is."""


def _sources(images: Any) -> list[tuple[str, Any]]:
    """Name and source (a path or an array) of each image."""
    if isinstance(images, (str, os.PathLike)):
        folder = Path(images)
        want(folder.is_dir(), "images", os.fspath(images), "a folder that exists")
        files = [p for p in folder.iterdir() if p.is_file()]
        files = [p for p in files if p.name != SESSION and not p.name.startswith(".")]
        if not files:
            raise ValueError(f"images: {os.fspath(images)!r} holds no files")
        return [(path.name, path) for path in sorted(files, key=_natural)]
    if not isinstance(images, Iterable):
        kind = type(images).__name__
        raise ValueError(f"images: got a {kind}, want a folder, or paths, arrays or frames")
    items = list(images)
    if not items:
        raise ValueError("images: got none")
    return [_named(number, item) for number, item in enumerate(items)]


def _named(number: int, item: Any) -> tuple[str, Any]:
    """Name and source of one of a sequence."""
    if isinstance(item, (str, os.PathLike)):
        return Path(item).name, Path(item)
    if isinstance(item, np.ndarray):
        return f"image {number}", item
    if hasattr(item, "color"):
        if item.color is None:
            raise ValueError(f"images: frame {number} has no colour image")
        return f"frame {item.number}", item.color
    raise ValueError(
        f"images: number {number} is a {type(item).__name__}, want a path, an array or a frame"
    )


def _natural(path: Path) -> list[Any]:
    """A key that sorts view2 before view10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [int(part) if part.isdecimal() else part for part in parts]


def _read(source: Any) -> NDArray[np.uint8]:
    """The grey image of a path, or the array itself; `_Unreadable` where there is none."""
    if isinstance(source, np.ndarray):
        return source
    try:
        data = source.read_bytes()
    except OSError as error:
        raise _Unreadable(f"cannot be read ({error.strerror or error})") from error
    if not data:
        raise _Unreadable("the file is empty")
    if _is_cut_off(data):  # OpenCV would fill the rest with grey
        raise _Unreadable("the file is cut off, its end is missing")
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error as error:
        raise _Unreadable(f"not an image that OpenCV can read ({error.err})") from error
    if image is None:
        raise _Unreadable("not an image that OpenCV can read")
    return np.asarray(image, np.uint8)


def _is_cut_off(data: bytes) -> bool:
    """Whether a JPEG or PNG file lacks its end.

    A JPEG's end marker is looked for after the start of its own data: one before that ends the
    thumbnail that cameras put into the header.
    """
    if data.startswith(b"\x89PNG"):
        return b"IEND" not in data[-64:]
    if not data.startswith(b"\xff\xd8"):
        return False
    at = 2
    while data[at : at + 1] == b"\xff" and data[at + 1 : at + 2] != b"\xda":
        at += 2 + int.from_bytes(data[at + 2 : at + 4], "big")
    return b"\xff\xd9" not in data[at:]


def _of_one_size(views: list[Detection], skipped: list[Skipped], names: list[str]) -> Detections:
    """The views of the commonest size; the others join the skipped, in the order of the images."""
    counts = Counter(view.size for view in views)
    common = max(counts, key=lambda size: (counts[size], size), default=(0, 0))
    for view in views:
        if view.size != common:
            reason = "{}x{} px, where most are {}x{}: one calibration is for one size"
            skipped.append(Skipped(view.name, reason.format(*view.size, *common), "other_size"))
    skipped.sort(key=lambda skip: names.index(skip.name))
    return Detections([view for view in views if view.size == common], skipped)
