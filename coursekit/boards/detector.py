"""Find a board in an image, to a fraction of a pixel.

Find a board in many images: a folder, a list of files, arrays or a camera's frames.
"""

from __future__ import annotations

import os
import re
from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from coursekit.arrays import NDArray
from coursekit.boards.board import Board, BoardNotFound, Detection, Detections, Skipped
from coursekit.boards.corners import blur_covariance, refine
from coursekit.boards.explain import explain
from coursekit.boards.find import find, steps

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


SESSION = "session.json"  # written beside the images by the course itself


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
    """
    sources = _sources(images)
    views: list[Detection] = []
    skipped: list[Skipped] = []
    try:
        for name, source in _with_bar(sources, progress):
            try:
                views.append(detect(_read(source), board, name))
            except (BoardNotFound, _Unreadable) as reason:
                skipped.append(Skipped(name, str(reason)))
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
        if not folder.is_dir():
            raise ValueError(f"images: got {os.fspath(images)!r}, want a folder that exists")
        files = [path for path in folder.iterdir() if path.is_file()]
        files = [p for p in files if p.name != SESSION and not p.name.startswith(".")]
        if not files:
            raise ValueError(f"images: {os.fspath(images)!r} holds no files")
        return [(path.name, path) for path in sorted(files, key=_natural)]
    try:
        items = list(images)
    except TypeError:
        raise ValueError(
            f"images: got a {type(images).__name__}, want a folder, or a sequence of paths, arrays "
            "or frames"
        ) from None
    if not items:
        raise ValueError("images: got none")
    return [_named(number, item) for number, item in enumerate(items)]


def _named(number: int, item: Any) -> tuple[str, Any]:
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


def _with_bar(sources: list[tuple[str, Any]], progress: bool) -> Iterator[tuple[str, Any]]:
    from tqdm.auto import tqdm

    with tqdm(sources, unit="image", leave=False, disable=not progress or len(sources) < 10) as bar:
        yield from bar


def _read(source: Any) -> NDArray[np.uint8]:
    """The grey image of a path, or the array itself."""
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
    if views:
        counts = Counter(view.size for view in views)
        size = max(counts, key=lambda s: (counts[s], s))
        width, height = size
        skipped = skipped + [
            Skipped(
                view.name,
                f"{view.size[0]}x{view.size[1]} px, where most are {width}x{height}: one "
                "calibration is for one size",
            )
            for view in views
            if view.size != size
        ]
        views = [view for view in views if view.size == size]
        skipped.sort(key=lambda skip: names.index(skip.name))
    return Detections(views, skipped)
