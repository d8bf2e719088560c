"""Find a board in an image, to a fraction of a pixel, and in many: a folder, files, arrays, frames.

    find_corners (to a pixel)  ->  refine_corners (to 0.05 px)  ->  Detection

What cannot be used is never dropped silently: `detect` says why it finds no board, `detect_all`
lists the images that it skipped, with the reason.
"""

from __future__ import annotations

import os
import re
import struct
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from coursekit.arrays import AnyArray, Grey, NDArray
from coursekit.boards.board import (
    FEWEST_CORNERS,
    Board,
    BoardNotFound,
    Detection,
    Detections,
    Skipped,
)
from coursekit.boards.corners import blur_covariance, refine_corners, steps
from coursekit.boards.explain import BLANK_GREY, explain
from coursekit.boards.find import OFF_PLANE, find_corners, on_plane
from coursekit.checks import want
from coursekit.words import ROOM_TEXTS, counting, say

SMALLEST_IMAGE_PX = 40  # shorter side of an image in which a board can be told
NARROWEST = 40  # long sides to the short one
MOST_PIXELS, MOST_BYTES = 250_000_000, 2_000_000_000  # more is no photograph
RANGE = 12, 243  # grey levels of a hundredth and of 99 hundredths of a scaled image
SESSION = "session.json"  # written beside the images by the course itself
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
NO_PICTURE = r"^\.|\.(md|txt|csv|json|ya?ml|xml|html?|toml|ini|log|py|zip|db)$"  # of a file's name
JPEG, PNG = b"\xff\xd8", b"\x89PNG"
SIZE_SEGMENTS = b"\xc0\xc1\xc2\xc3\xc5\xc6\xc7\xc9\xca\xcb\xcd\xce\xcf"  # of a JPEG hold its size
ALPHA = (b"\4", b"\6")  # PNG: kinds of colour with transparency
AS_STORED = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION


# --- one image ---


def detect(image: NDArray[np.uint8], board: Board, name: str = "") -> Detection:
    """The corners of `board` in one image, with their noise and the image's blur.

    image: (H, W) grey or (H, W, 3) RGB, uint8, or uint16 of any depth, which its own range scales.
    A checkerboard must be seen whole, a ChArUco board in part. Corners are refined in a window of
    0.4 of a square (module `corners`). On a checkerboard the colours of the squares tell which
    corner is the first, as in `Board.image`; where they cannot (two odd or two even numbers of
    squares) it is the turn whose x axis points most to the right, which may change from view to
    view: harmless for K, not for what needs the pose. A mirrored ChArUco board is told from a true
    one; a mirrored checkerboard cannot be, its picture is that of a turned one.

    Raises BoardNotFound, which says what is there instead, and ValueError for what is no image.

    >>> board = Board("charuco", (5, 4), 0.03)
    >>> seen = detect(np.pad(board.image(42), 40, constant_values=255), board)
    >>> len(seen), seen.pixels[0].round(1).tolist()
    (12, [81.5, 81.5])
    """
    grey = _grey(image)
    try:
        return _detect(grey, board, name)
    except BoardNotFound:
        raise
    except Exception as error:  # no picture, however strange, may end a session of many
        raise BoardNotFound(say("boards.failed", error=_words(error))) from error


def _words(error: Exception) -> str:
    """An error in one short line."""
    return f"{type(error).__name__}: {' '.join(str(error).split())}"[:120]


def _detect(grey: Grey, board: Board, name: str) -> Detection:
    height, width = grey.shape
    if grey.size > MOST_PIXELS:
        raise BoardNotFound(say("boards.too_large", width=width, height=height))
    if min(grey.shape) < SMALLEST_IMAGE_PX or max(grey.shape) > NARROWEST * min(grey.shape):
        raise BoardNotFound(say("boards.too_small", width=width, height=height))
    found = find_corners(grey, board)
    if found is None or not _usable(found[0], board):
        raise BoardNotFound(explain(grey, board, 0 if found is None else len(found[0])))
    ids, start = found
    pixels, covariances = refine_corners(grey, start, steps(start, ids, board), ids, board)
    good = np.isfinite(pixels[:, 0])
    good[good] = on_plane(ids[good], pixels[good], (width, height), board, OFF_PLANE[1])
    ids, pixels, covariances = ids[good], pixels[good], covariances[good]
    if not _usable(ids, board):
        raise BoardNotFound(explain(grey, board, len(ids)))
    noise_px = float(np.sqrt(np.trace(covariances, axis1=1, axis2=2).mean() / 2))
    blur = blur_covariance(grey, pixels, ids, steps(pixels, ids, board), board)
    return Detection(ids, pixels, (width, height), name, noise_px, blur)


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
    if pixels.dtype not in (np.uint8, np.uint16) or not shape or pixels.size == 0:
        got = f"{pixels.dtype} of shape {pixels.shape}"
        raise ValueError(f"image: got {got}, want uint8 or uint16 (H, W) grey or (H, W, 3) RGB")
    if pixels.ndim == 3:
        pixels = np.asarray(cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2GRAY))
    return np.ascontiguousarray(_eight_bits(pixels))


def _eight_bits(pixels: AnyArray) -> Grey:
    """Grey levels of whatever kind (H, W) as uint8: others than uint8 by their own range.

    So 10, 12 or 14 bits in a 16-bit image count as what they are. A hundredth of the pixels may be
    beyond either end of the range, which leaves room for noise at the end of uint8's.
    """
    if pixels.dtype == np.uint8:
        return pixels
    some = pixels[:: pixels.shape[0] // 1000 + 1, :: pixels.shape[1] // 1000 + 1]
    some = some[np.isfinite(some)]
    low, high = np.quantile(some, [0.01, 0.99]) if some.size else (0.0, 0.0)
    if not high - low > (BLANK_GREY if pixels.dtype.kind in "iu" else 0.0):
        raise BoardNotFound(say("boards.blank", low=low, high=high))
    dark, bright = RANGE
    scale = (bright - dark) / (high - low)
    levels = np.nan_to_num((pixels.astype(np.float32) - low) * scale + dark, nan=dark)
    return np.rint(levels.clip(0, 255)).astype(np.uint8)


# --- many images ---


def detect_all(
    images: str | os.PathLike[str] | Iterable[Any], board: Board, progress: bool = True
) -> Detections:
    """The board in each of many images; what cannot be used is listed in `.skipped`, with why.

    images: a folder (its files, in natural order, without tables and texts), or a sequence
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
    sources = _sources(images)
    shown = progress and len(sources) >= 10
    views: list[Detection] = []
    skipped: list[Skipped] = []
    try:
        for name, source in counting(sources, len(sources), "image", shown):
            try:
                views.append(detect(_read(source), board, name))
            except BoardNotFound as reason:
                skipped.append(Skipped(name, str(reason), reason.kind))
    except KeyboardInterrupt:
        print(f"Stopped after {len(views) + len(skipped)} of {len(sources)} images; they are kept.")
    return _of_one_size(views, skipped, [name for name, _ in sources])


def _sources(images: Any) -> list[tuple[str, Any]]:
    """Name and source (a path or an array) of each image."""
    if isinstance(images, (str, os.PathLike)):
        folder = Path(images)
        wanted = f"a folder that exists; there is no {folder.resolve()}"
        want(folder.is_dir(), "images", os.fspath(images), wanted)
        files = [p for p in folder.iterdir() if p.is_file() or not p.exists()]  # a broken link
        files = [p for p in files if not re.search(NO_PICTURE, p.name.lower())]
        if not files:
            below = sorted(p.parent for p in folder.glob("*/*") if p.suffix.lower() in IMAGES)
            there = f" itself, {below[0]} does: name the folder of the photographs" if below else ""
            raise ValueError(f"images: {os.fspath(images)!r} holds no pictures{there}")
        return [(path.name, path) for path in sorted(files, key=natural)]
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
    kind = type(item).__name__
    raise ValueError(f"images: number {number} is a {kind}, want a path, an array or a frame")


def natural(path: Path) -> list[Any]:
    """A key that sorts view2 before view10."""
    parts = re.split(r"(\d+)", path.name.lower())
    return [int(part) if part.isdecimal() else part for part in parts]


def _read(source: Any) -> AnyArray:
    """The grey image of a path, or the array itself; BoardNotFound where there is none."""
    if isinstance(source, np.ndarray):
        return source
    try:
        if source.stat().st_size > MOST_BYTES:
            raise BoardNotFound(say("boards.too_many_bytes", size_gb=source.stat().st_size / 1e9))
        data = source.read_bytes()
    except (OSError, MemoryError) as error:
        why = getattr(error, "strerror", error)
        raise BoardNotFound(say("boards.not_read", error=why)) from error
    if not data:
        raise BoardNotFound(say("boards.empty"))
    others = {} if data.startswith((JPEG, PNG)) else ROOM_TEXTS["boards"]["other_files"]
    texts = (source.suffix.lower(), data[:16].decode("latin1"))
    for pattern, what in others.items():
        if any(re.match(pattern, text, re.DOTALL) for text in texts):
            raise BoardNotFound(what)
    (width, height), cut_off = _header(data)
    if width * height > MOST_PIXELS:  # before it takes its memory
        raise BoardNotFound(say("boards.too_large", width=width, height=height))
    if cut_off:  # OpenCV would fill the rest with grey
        raise BoardNotFound(say("boards.cut_off"))
    try:
        return _eight_bits(_decoded(data))
    except BoardNotFound:
        raise
    except Exception as error:  # whatever a broken file makes the decoders raise
        raise BoardNotFound(f"{say('boards.no_image')} ({_words(error)})") from error


def _decoded(data: bytes) -> AnyArray:
    """The grey image in a file's bytes, of whatever depth; what is transparent is white paper."""
    coded = np.frombuffer(data, np.uint8)
    image = cv2.imdecode(coded, AS_STORED | cv2.IMREAD_ANYDEPTH)
    if image is None:
        raise BoardNotFound(say("boards.no_image"))
    if data.startswith(PNG) and (data[25:26] in ALPHA or b"tRNS" in data[:4096]):
        with_alpha = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
        layers: AnyArray = np.asarray(cv2.imdecode(coded, with_alpha))
        white = 255 if image.dtype == np.uint8 else 65535
        alpha = layers[..., -1] / white
        if layers.shape[2:] == (4,) and alpha.any() and alpha.min() < 1:
            image = np.rint(white + alpha * (image - float(white))).astype(image.dtype)
    return np.asarray(image)


def _header(data: bytes) -> tuple[tuple[int, int], bool]:
    """What a JPEG or PNG file says: width and height, px, and whether its end is missing.

    (0, 0) where nothing is known. A JPEG's end marker is looked for after the start of its own
    data: one before that ends the thumbnail that cameras put into the header.
    """
    if data.startswith(PNG):
        width, height = struct.unpack(">II", data[16:24].rjust(8, b"\0"))
        return (width, height), b"IEND" not in data[-64:]
    if not data.startswith(JPEG):
        return (0, 0), False
    at, size = 2, (0, 0)
    while data[at : at + 1] == b"\xff" and data[at + 1 : at + 2] != b"\xda":
        length, _, height, width = struct.unpack(">HBHH", data[at + 2 : at + 9].rjust(7, b"\0"))
        if data[at + 1 : at + 2] in SIZE_SEGMENTS:
            size = (width, height)
        at += 2 + length
    return size, b"\xff\xd9" not in data[at:]


def _of_one_size(views: list[Detection], skipped: list[Skipped], names: list[str]) -> Detections:
    """The views of the commonest size; the others join the skipped, in the order of the images."""
    counts = Counter(view.size for view in views)
    common = max(counts, key=lambda size: (counts[size], size), default=(0, 0))
    for view in views:
        if view.size != common:
            reason = say("boards.other_size", view=view.size, common=common)
            reason += say("boards.turned") * (view.size == common[::-1])
            skipped.append(Skipped(view.name, reason, "other_size"))
    skipped.sort(key=lambda skip: names.index(skip.name))
    return Detections([view for view in views if view.size == common], skipped)
