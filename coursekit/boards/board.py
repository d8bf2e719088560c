"""What a calibration board is (its pattern, its corners in metres, its exact picture), and what an
image or many of them show of it.

    p_camera = T_camera_board @ p_board

A `Board` is printed once. A `Detection` holds the corners that one image shows, `Detections` those
of a session; whoever calibrates with them asks `check_detections` first.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import cv2
import numpy as np

from coursekit import geometry
from coursekit.arrays import Bools, Floats, Grey, NDArray, frozen
from coursekit.checks import array, choice, instance, number, settle, want, whole
from coursekit.geometry import Intrinsics
from coursekit.words import ROOM_TEXTS, Listed, counted, say

BoardKind = Literal["checkerboard", "charuco"]
FEWEST_SQUARES = {"checkerboard": 4, "charuco": 3}  # OpenCV finds none with fewer corners than 3x3
FEWEST_CORNERS = 6  # in an image that counts
SMALLEST_SQUARE_M, LARGEST_SQUARE_M = 0.0005, 1.0  # who gives millimetres is told so
MARKER_SHARE = 0.75  # of a square's side, unless the board says otherwise
DICTIONARIES = tuple(
    name for name in sorted(vars(cv2.aruco)) if name.startswith("DICT_") and name == name.upper()
)
LISTED, LISTED_SKIPPED = 6, 20  # lines that a repr shows at most


# --- the board ---


@dataclass(frozen=True)
class Board:
    """A flat calibration board, checkerboard or ChArUco.

    squares: (columns, rows) of SQUARES. Inner corners, where four squares meet, are one fewer in
    each direction: the "9x6" checkerboard of many tutorials has squares=(10, 7). square_m and
    marker_m (ChArUco only, default 0.75 of a square): side lengths, m. dictionary: one of OpenCV's
    predefined ArUco dictionaries.

    Board frame: metres, z = 0 on the board, x right, y down and z into the board as one looks at
    it. Its origin is where OpenCV puts it: for a checkerboard at the first inner corner, for a
    ChArUco board at the outer corner of the top-left square, so that its first inner corner lies
    at (square_m, square_m, 0).

    old_origin: a ChArUco board as OpenCV drew and described it before version 4.6: the origin at
    the outer corner of the bottom-left square, y up and z out of the board, corners counted from
    the bottom; and with an even number of rows the top-left square is white, not black. With an
    odd number of rows old and new boards are the same print, and only the one who reads the pose
    can know which origin is meant.

    first_marker: the number of a ChArUco board's first marker; boards that are seen together have
    different ones.

    Raises ValueError for fields that make no board.

    >>> board = Board("charuco", (9, 6), 0.025)
    >>> board.corners, board.marker_m, board.points[0].tolist()
    ((8, 5), 0.01875, [0.025, 0.025, 0.0])
    """

    kind: BoardKind
    squares: tuple[int, int]
    square_m: float
    marker_m: float | None = None
    dictionary: str = "DICT_5X5_250"
    old_origin: bool = False
    first_marker: int = 0

    def __post_init__(self) -> None:
        fewest = FEWEST_SQUARES[choice("kind", self.kind, get_args(BoardKind))]
        squares = np.asarray(self.squares)
        fits = squares.dtype.kind in "iu" and squares.shape == (2,)
        fits = fits and fewest <= squares.min() and squares.max() <= 1000
        wanted = f"(columns, rows) of squares, {fewest} to 1000 each (inner corners are one fewer)"
        want(fits, "squares", self.squares, wanted)
        settle(self, squares=tuple(squares.tolist()), square_m=_side("square_m", self.square_m))
        if self.kind == "checkerboard":
            extras = (self.marker_m, self.old_origin)
            want(extras == (None, False), "marker_m, old_origin", extras, "none on a checkerboard")
            want(self.first_marker == 0, "first_marker", self.first_marker, "0 on a checkerboard")
            return
        default = round(MARKER_SHARE * self.square_m, 9)  # 0.01875, not 0.018750000000000003
        marker_m = _side("marker_m", default if self.marker_m is None else self.marker_m)
        settle(self, marker_m=marker_m)
        want(marker_m < self.square_m, "marker_m", marker_m, f"less than {self.square_m} m")
        first = whole("first_marker", self.first_marker, "a whole number from 0 on", least=0)
        held, needed = len(_dictionary(self.dictionary).bytesList), first + int(self.white.sum())
        wanted = f"one of {needed} markers or more for {self.text}, this one holds {held}"
        want(needed <= held, "dictionary", self.dictionary, wanted)

    @property
    def corners(self) -> tuple[int, int]:
        """(columns, rows) of inner corners: one fewer than squares."""
        return self.squares[0] - 1, self.squares[1] - 1

    @cached_property
    def points(self) -> Floats:
        """The inner corners in the board frame, (N, 3) m, row after row; read-only."""
        columns, rows = self.corners
        first = 0 if self.kind == "checkerboard" else 1
        y, x = np.mgrid[first : first + rows, first : first + columns]
        return frozen(self.square_m * np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3))

    @cached_property
    def falling(self) -> Bools:
        """(N,): whether the two white squares at a corner lie towards (-x, -y) and (+x, +y).

        Otherwise the white ones lie towards (-x, +y) and (+x, -y). Neighbours differ.
        """
        white = self.white[::-1] if self.old_origin else self.white  # along the board's y
        return white[1:, 1:].ravel()

    @property
    def size_m(self) -> tuple[float, float]:
        """(width, height) of the printed pattern, m, without the white paper around it."""
        return self.squares[0] * self.square_m, self.squares[1] * self.square_m

    @property
    def middle(self) -> Floats:
        """The middle of the pattern in the board frame, (3,) m, wherever the origin is."""
        return self.points.mean(axis=0)

    @property
    def T_board_sheet(self) -> Floats:
        """Sheet frame to board frame, (4, 4).

        The sheet's frame is the same for all boards: its origin in the pattern's top-left outer
        corner, x right, y down, z into the paper.
        """
        image_from_board = self.image_from_board(1)
        right, down = np.sign(np.diag(image_from_board)[:2])
        offset = self.square_m * (image_from_board[:2, 2] + 0.5)
        turn = np.diag([right, down, right * down])
        return geometry.invert_transform(geometry.make_transform(turn, (*offset, 0.0)))

    @property
    def outline(self) -> Floats:
        """The pattern's outer corners in the board frame, (4, 3) m, clockwise from its top left."""
        wide, high = self.size_m
        sheet = [[0.0, 0.0, 0.0], [wide, 0.0, 0.0], [wide, high, 0.0], [0.0, high, 0.0]]
        return geometry.transform_points(self.T_board_sheet, sheet)

    @property
    def text(self) -> str:
        """The squares in words that nobody can take for inner corners."""
        inner = "{}x{}".format(*self.corners)
        return "{}x{} squares ({} inner corners)".format(*self.squares, inner)

    def image(self, pixels_per_square: int) -> Grey:
        """The pattern without a border, (rows, columns) x pixels_per_square, 0 black, 255 white.

        A pixel that the edge of a marker's cell cuts gets the grey of its areas; edges of squares
        fall between pixels. `image_from_board` says where a point of the board lies in it.
        Raises ValueError for fewer than one pixel.
        """
        n = whole("pixels_per_square", pixels_per_square)
        squares = np.kron(self.white, np.ones((n, n)))
        for left, top, cells in self.markers:
            columns, rows = (_cover(at, self.marker_share, len(cells), n) for at in (left, top))
            x, y = int(left) * n, int(top) * n
            square = squares[y : y + n, x : x + n]
            square -= rows.T @ (1.0 - cells) @ columns
        return np.rint(255.0 * squares).astype(np.uint8)

    def image_from_board(self, pixels_per_square: int) -> Floats:
        """The (3, 3) matrix from (x, y, 1) on the board in m to (u, v, 1) in `image`, in px."""
        first = 1.0 if self.kind == "checkerboard" else 0.0
        scale = pixels_per_square / self.square_m
        down, top = (-1.0, self.squares[1]) if self.old_origin else (1.0, first)
        u0, v0 = first * pixels_per_square - 0.5, top * pixels_per_square - 0.5
        return np.array([[scale, 0.0, u0], [0.0, down * scale, v0], [0.0, 0.0, 1.0]])

    @cached_property
    def markers(self) -> tuple[tuple[float, float, Floats], ...]:
        """The markers in the order of their numbers: left and top, in squares, and their cells.

        Left and top count from the pattern's top-left corner whatever the origin; cells (n, n)
        hold 0 black and 1 white, the black frame of one cell included. Empty for a checkerboard.
        """
        if self.kind == "checkerboard":
            return ()
        dictionary = _dictionary(self.dictionary)
        n = dictionary.markerSize + 2
        margin = 0.5 * (1.0 - self.marker_share)
        markers = []
        for marker_id, (row, column) in enumerate(np.argwhere(self.white).tolist()):
            number = self.first_marker + marker_id
            image = cv2.aruco.generateImageMarker(dictionary, number, n, borderBits=1)
            markers.append((column + margin, row + margin, (image > 0).astype(float)))
        return tuple(markers)

    def opencv(self) -> Any:
        """The `cv2.aruco.CharucoBoard` of this board; ValueError for a checkerboard."""
        if self.marker_m is None:
            raise ValueError("kind: a checkerboard has no cv2.aruco.CharucoBoard")
        numbers = self.first_marker + np.arange(self.white.sum())
        known = _dictionary(self.dictionary)
        board = cv2.aruco.CharucoBoard(self.squares, self.square_m, self.marker_m, known, numbers)
        board.setLegacyPattern(self.old_origin)
        return board

    @cached_property
    def white(self) -> Bools:
        """(rows, columns): which squares are white, from the pattern's top-left corner."""
        columns, rows = self.squares
        first_white = self.old_origin and rows % 2 == 0
        return (np.add.outer(np.arange(rows), np.arange(columns)) + first_white) % 2 == 1

    @property
    def marker_share(self) -> float:
        """The marker's side in squares, 0 on a checkerboard."""
        return self.marker_m / self.square_m if self.marker_m else 0.0


def _cover(first: float, share: float, cells: int, pixels: int) -> Floats:
    """(cells, pixels): the share of each pixel of a square's row that each cell covers.

    first: where a marker's first cell starts, share: the marker's width, both in squares.
    """
    edges = pixels * (first - int(first) + share / cells * np.arange(cells + 1))[:, None]
    inside = np.clip(edges - np.arange(pixels), 0.0, 1.0)  # of the pixel, left of the edge
    return inside[:-1] - inside[1:]


@cache
def _dictionary(name: str) -> Any:
    """OpenCV's dictionary of a name; ValueError for an unknown one."""
    number = getattr(cv2.aruco, choice("dictionary", name, DICTIONARIES))
    return cv2.aruco.getPredefinedDictionary(number)


def _side(name: str, value: object) -> float:
    """The side of a square or marker, m."""
    wanted = f"{SMALLEST_SQUARE_M} to {LARGEST_SQUARE_M} m (25 mm is 0.025)"
    return number(name, value, wanted, least=SMALLEST_SQUARE_M, most=LARGEST_SQUARE_M)


# --- what images show of it ---


class BoardNotFound(ValueError):
    """The board is not in the image; the message says what is there instead, or what to mend.

    kind: as `Skipped` has it.
    """

    kind = ""


class OtherBoard(BoardNotFound):
    """Another board than was asked for is in the image."""

    kind = "other_board"


@dataclass(frozen=True, eq=False)
class Detection:
    """The corners of a board that one image shows.

    ids (N,): rows of `board.points`, ascending. pixels (N, 2): where they are, px. size: (width,
    height) of the image, px. name: what the image is called. noise_px: the standard deviation of
    one coordinate of one corner that the image's noise causes, root mean square over the corners.
    blur (2, 2): covariance of the blur, px^2: an edge with the unit normal n is blurred as by a
    Gaussian with variance n @ blur @ n, the pixel's own width (1/12 px^2) included. Equal
    eigenvalues are defocus; one much larger than the other is motion, along its eigenvector.
    noise_px and blur are None where nothing was measured.
    """

    ids: NDArray[np.intp]
    pixels: Floats
    size: tuple[int, int]
    name: str = ""
    noise_px: float | None = None
    blur: Floats | None = None

    def __post_init__(self) -> None:
        ids = np.array(self.ids)
        counts = ids.ndim == 1 and (np.issubdtype(ids.dtype, np.integer) or ids.size == 0)
        want(counts, "ids", self.ids, "(N,) whole numbers")
        pixels = array("pixels", self.pixels, (len(ids), 2)).copy()
        width, height = self.size
        size = int(width), int(height)
        settle(self, ids=frozen(ids.astype(np.intp)), pixels=frozen(pixels), size=size)
        if self.blur is not None:
            settle(self, blur=frozen(array("blur", self.blur, (2, 2)).copy()))

    def __len__(self) -> int:
        """How many corners."""
        return len(self.ids)

    @property
    def blur_px(self) -> float | None:
        """Standard deviation of the blur in the direction where it is worst, px."""
        return None if self.blur is None else float(np.sqrt(np.linalg.eigvalsh(self.blur)[-1]))

    def __repr__(self) -> str:
        size = "{}x{}".format(*self.size)
        text = f"{self.name or 'detection'}: {len(self)} corners in {size}"
        if self.noise_px is not None:
            text += f", noise {self.noise_px:.3f} px"
        if self.blur_px is not None:
            text += f", blur {self.blur_px:.2f} px"
        return text


@dataclass(frozen=True)
class Skipped:
    """An image that was not used, and why.

    kind: "other_size" for a size that is not the others', "other_board" for another board
    than was asked for, else empty.
    """

    name: str
    reason: str
    kind: str = ""

    def __repr__(self) -> str:
        return f"{self.name}: {self.reason}"


class Detections(Listed[Detection]):
    """What was seen in many images, in their order, like an immutable list.

    skipped: the images that were not used. A slice keeps it; `pick` takes any choice of views.
    """

    def __init__(self, views: Iterable[Detection] = (), skipped: Iterable[Skipped] = ()) -> None:
        super().__init__(views)
        self.skipped = tuple(skipped)
        for view in self:
            instance("views", view, Detection)

    @classmethod
    def from_file(cls, path: str | os.PathLike[str]) -> Detections:
        """Corners that are kept in an .npz, as data/ordinary/SOURCE.md describes it."""
        with np.load(path) as kept:
            width, height = kept["size"].tolist()
            of_view = [kept["view"] == number for number in range(len(kept["names"]))]
            return cls(
                Detection(kept["ids"][here], kept["pixels"][here], (width, height), str(name))
                for here, name in zip(of_view, kept["names"], strict=True)
            )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of all images, px; ValueError when there is none or they differ."""
        if not self:
            raise ValueError("detections: there are none, so there is no image size")
        first = self[0].size
        for index, view in enumerate(self):
            if view.size != first:
                raise ValueError(say("boards.sizes_differ", index=index, view=view, first=first))
        return first

    def pick(self, which: Iterable[int]) -> Detections:
        """The views with these numbers, in this order."""
        return Detections((self[number] for number in which), self.skipped)

    def __repr__(self) -> str:
        corners = sum(len(view) for view in self)
        unused = f", {len(self.skipped)} not used" if self.skipped else ""
        lines = [f"{counted(len(self), 'view')} with {corners} corners{unused}"]
        lines += [f"  {view!r}" for view in self[:LISTED]]
        if len(self) > LISTED:
            lines.append(f"  and {len(self) - LISTED} more")
        reasons = by_reason(self.skipped)
        lines += [f"  not used: {_one_of(group)}" for group in reasons[:LISTED_SKIPPED]]
        if len(reasons) > LISTED_SKIPPED:
            lines.append(f"  and others, for {len(reasons) - LISTED_SKIPPED} more reasons")
        return "\n".join(lines)


def by_reason(skipped: Iterable[Skipped]) -> list[list[Skipped]]:
    """Images that were not used, by the reason, which is often that of all; the commonest first."""
    groups: dict[str, list[Skipped]] = {}
    for skip in skipped:
        groups.setdefault(skip.reason, []).append(skip)
    return sorted(groups.values(), key=len, reverse=True)


def _one_of(group: Sequence[Skipped]) -> str:
    """The first of images that were not used for one reason, and how many more there are."""
    return f"{group[0]!r}" + f" (and {len(group) - 1} more)" * (len(group) > 1)


def why_unused(skipped: Sequence[Skipped]) -> str:
    """ "; 20 not used: ", with what is said of most of them; "" for none."""
    return f"; {len(skipped)} not used: {_one_of(by_reason(skipped)[0])}" if skipped else ""


def check_detections(
    detections: Sequence[Detection],
    board: Board,
    least_corners: int,
    least_views: int = 1,
    *,
    size: tuple[int, int] | None = None,
) -> None:
    """ValueError unless each of these views can fix a pose of `board`.

    least_corners: of each view. least_views: of all of them. size: (width, height) that each image
    must have, px, the first one's by default. The message says which view cannot be used, and
    which of six faults that view has: another size, too few corners, a pixel that is not finite, a
    corner that the board does not have, the same corner twice, or all corners on one line.

    >>> board = Board("checkerboard", (10, 7), 0.025)
    >>> check_detections([Detection([0, 1, 2], np.zeros((3, 2)), (640, 480), "a.png")], board, 4)
    Traceback (most recent call last):
    ValueError: detections[0] (a.png): has 3 corners, want at least 4
    """
    if len(detections) < least_views:
        seen = counted(len(detections), "view")
        others = why_unused(getattr(detections, "skipped", ()))
        raise ValueError(f"detections: got {seen}, want at least {least_views}{others}")
    for index, view in enumerate(detections):
        fault = next(_faults(view, board, least_corners, size or detections[0].size), "")
        if fault:
            called = f" ({view.name})" if view.name else ""
            raise ValueError(f"detections[{index}]{called}: {fault}")


def _faults(
    view: Detection, board: Board, least_corners: int, size: tuple[int, int]
) -> Iterator[str]:
    """What is wrong with one view, the first thing first; later checks rely on earlier ones."""
    ids, last = view.ids, len(board.points) - 1
    if view.size != size:
        yield f"is {view.size} px, not {size}: one calibration is for one size"
    if len(ids) < least_corners:
        yield f"has {len(ids)} corners, want at least {least_corners}"
    if not np.isfinite(view.pixels).all():
        yield "has corners that are not finite"
    if ids.min() < 0 or ids.max() > last:
        odd = ids[(ids < 0) | (ids > last)][-1]
        yield f"has corner {odd}, the board has 0 to {last}: another board?"
    if len(np.unique(ids)) < len(ids):
        yield "has the same corner twice"
    for flat in (board.points[ids, :2], view.pixels):
        spread = np.linalg.svd(flat - flat.mean(axis=0), compute_uv=False)
        if spread[1] <= 1e-6 * spread[0]:
            yield "has all its corners on one line, which fixes no pose"


# --- what a camera sees of a board ---

BORDER_PX = 6.0  # a corner nearer to the image's border has no room for its refinement window


def seen(
    points: Floats, T_camera_board: Floats, lens: Intrinsics, border_px: float | Floats = BORDER_PX
) -> Bools:
    """Which points of a board the camera sees from each pose, (..., N).

    points (N, 3): in the board's frame, m. T_camera_board (..., 4, 4): m. border_px: how far from
    the image's border a pixel must lie, one number or (2,) for columns and rows.

    >>> lens = Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
    >>> T = np.eye(4)
    >>> T[2, 3] = 0.5  # straight ahead
    >>> seen(np.array([[0.0, 0.0, 0.0], [0.3, 0.0, 0.0]]), T, lens).tolist()
    [True, False]
    """
    R, t = T_camera_board[..., :3, :3], T_camera_board[..., None, :3, 3]
    inside = points @ np.swapaxes(R, -1, -2) + t
    pixels = geometry.project(inside, lens.K, lens.dist)
    last = np.array(lens.size) - 1 - border_px
    found = np.asarray(((pixels >= border_px) & (pixels <= last)).all(axis=-1))
    if lens.dist is not None:
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.hypot(inside[..., 0], inside[..., 1]) / inside[..., 2]
        found &= slope < geometry.fold_radius(lens.dist)
    return found


def slide_into_view(
    aim_px: Floats,
    distance_m: float,
    R: Floats,
    middle: Floats,
    lens: Intrinsics,
    enough: Callable[[Floats], bool],
    steps: int = 21,
) -> Floats | None:
    """The pose T_camera_board (4, 4) nearest to an aim that shows enough of a board, or None.

    aim_px (2,): where the board's middle should be in the image. It goes on to the middle of the
    image in so many steps, at the same distance_m (Z of the board's middle) and orientation R
    (3, 3), until `enough` says yes to a pose. middle (3,): of the board, in its own frame, m.

    >>> lens = Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
    >>> corner = np.zeros((1, 3))
    >>> whole = lambda T: bool(seen(corner, T, lens, border_px=100).all())
    >>> T = slide_into_view(np.array([0.0, 240.0]), 0.5, np.eye(3), np.zeros(3), lens, whole)
    >>> geometry.project(T[:3, 3], lens.K).round().tolist()
    [112.0, 240.0]
    """
    centre = (np.array(lens.size) - 1) / 2
    shares = np.linspace(1.0, 0.0, steps)[:, None]
    pixels = centre + shares * (aim_px - centre)
    rays = geometry.deproject(pixels, np.ones(steps), lens.K, lens.dist)
    T = np.eye(4)
    T[:3, :3] = R
    for ray in rays[np.isfinite(rays).all(axis=1)]:
        T[:3, 3] = distance_m * ray - R @ middle
        if enough(T):
            return T
    return None


# --- a board on paper, to true scale, with a bar to check the print by ---

PAPERS_MM: dict[str, list[float]] = ROOM_TEXTS["boards"]["papers_mm"]  # short and long side
MARGIN_MM = 6.0  # printers leave about 5 mm blank
FOOT_MM = 18.0  # bar and text below the board
BAR_MM = 100.0
MM_PER_INCH = 25.4


def save_sheet(
    board: Board,
    path: str | os.PathLike[str],
    paper: str = "A4",
    dpi: int = 300,
    overwrite: bool = False,
) -> Path:
    """Write the board to a PDF (vector) or PNG file to true scale, and return the path.

    paper: A4 to A0, Letter, Legal or Tabloid, turned to suit the board. dpi: of a PNG, which
    says so in its header; a PDF has no pixels. Below the board are a bar of 100 mm, what the board
    is, and how to print and mount it. The same board gives the same bytes.

    Raises ValueError for a path that ends in neither .pdf nor .png or that exists (unless
    `overwrite`), an unknown paper, or a board that does not fit (which says what would).
    """
    import matplotlib as mpl

    target = Path(path)
    kind = target.suffix[1:].lower()
    want(kind in ("pdf", "png"), "path", os.fspath(path), "a name that ends in .pdf or .png")
    whole("dpi", dpi, "a whole number from 72 to 2400", least=72, most=2400)
    page_mm = _page(board, paper)
    if target.exists() and not overwrite:
        raise ValueError(f"path: {target} exists already: choose another name or overwrite=True")
    want(target.parent.is_dir(), "path", os.fspath(path), "a name in a folder that exists")
    part = target.with_name(f".{target.name}.{os.getpid()}.part")  # renamed: never half a file
    with mpl.rc_context():
        mpl.rcdefaults()  # a reader's own style may crop or colour figures
        mpl.rcParams["pdf.fonttype"] = 42
        figure = _draw(board, page_mm)
        date = {"CreationDate": None} if kind == "pdf" else {}
        try:
            figure.savefig(part, format=kind, dpi=dpi, metadata=date)
            part.replace(target)
        finally:
            part.unlink(missing_ok=True)
    return target


def caption(board: Board) -> str:
    """The board in one line: kind, squares, millimetres, dictionary."""
    text = f"{'ChArUco board' if board.kind == 'charuco' else 'Checkerboard'}, {board.text}, "
    text += f"square {1000 * board.square_m:g} mm"
    if board.marker_m is not None:
        text += f", marker {1000 * board.marker_m:g} mm, {board.dictionary}"
        text += ", origin before OpenCV 4.6" if board.old_origin else ""
        text += f", first marker {board.first_marker}" if board.first_marker else ""
    return text


def _page(board: Board, paper: str) -> list[float]:
    """(width, height) of the sheet in mm, upright or lying; ValueError for too big a board."""
    names = {name.lower(): name for name in PAPERS_MM}
    want(str(paper).lower() in names, "paper", paper, f"one of {', '.join(PAPERS_MM)}")
    name = names[paper.lower()]
    if pages := _fitting(board, name):
        return pages[0]
    sides = PAPERS_MM[name]
    square = max(_largest_square_mm(board, page) for page in (sides, sides[::-1]))
    larger = next((other for other in PAPERS_MM if _fitting(board, other)), "a print shop")
    instead = {"paper": name, "larger": larger, "square": np.floor(10 * square) / 10}
    width, height = (1000 * side for side in board.size_m)
    raise ValueError(say("boards.too_big", width=width, height=height, **instead))


def _fitting(board: Board, paper: str) -> list[list[float]]:
    """The ways to turn a paper, (width, height) in mm, upright first, that hold the board."""
    sides = PAPERS_MM[paper]
    least = 1000 * board.square_m * (1 - 1e-9)
    return [page for page in (sides, sides[::-1]) if _largest_square_mm(board, page) >= least]


def _largest_square_mm(board: Board, page: list[float]) -> float:
    """The largest square for this many of them on a page, mm; 0 where the bar has no room."""
    if page[0] < BAR_MM + 2 * MARGIN_MM:
        return 0.0
    columns, rows = board.squares
    return min((page[0] - 2 * MARGIN_MM) / columns, (page[1] - 2 * MARGIN_MM - FOOT_MM) / rows)


def _draw(board: Board, page_mm: list[float]) -> Any:
    """The sheet as a Matplotlib figure whose axes are millimetres, y down from the top."""
    from matplotlib.figure import Figure
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    width, height = page_mm
    figure = Figure(figsize=(width / MM_PER_INCH, height / MM_PER_INCH), facecolor="white")
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0), xlim=(0.0, width), ylim=(height, 0.0))
    axes.set_axis_off()
    board_mm = np.array(board.size_m) * 1000
    left = (width - board_mm[0]) / 2
    top = (height - FOOT_MM - board_mm[1]) / 2
    black = _black_boxes(board) * 1000 * board.square_m + [left, top, left, top]
    foot = height - MARGIN_MM - FOOT_MM + 4.0
    bar = np.array([[MARGIN_MM, foot, MARGIN_MM + BAR_MM, foot + 1.5]])
    for boxes in (black, bar):  # each as one path: boxes that touch leave no hairline between
        x0, y0, x1, y1 = boxes.T
        around = np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1), (x0, y0)]).transpose(2, 0, 1)
        codes = [Outline.MOVETO, *3 * [Outline.LINETO], Outline.CLOSEPOLY] * len(boxes)
        outline = Outline(around.reshape(-1, 2), codes)
        patch = PathPatch(outline, facecolor="black", linewidth=0)
        patch.set_snap(False)  # edges of a PNG keep their place between pixels
        axes.add_patch(patch)
    right = MARGIN_MM + BAR_MM + 2.0
    axes.text(right, foot + 0.75, "100 mm", fontsize=8, va="center")
    words = f"{caption(board)}.\n{say('boards.advice')}"
    axes.text(MARGIN_MM, foot + 3.0, words, fontsize=6.5, va="top", linespacing=1.25)
    return figure


def _black_boxes(board: Board) -> Floats:
    """What is black, (N, 4): left, top, right, bottom in squares from the top-left corner."""
    rows, columns = np.nonzero(~board.white)
    boxes = np.stack([columns, rows, columns + 1, rows + 1], axis=1).tolist()
    for left, top, cells in board.markers:
        side = board.marker_share / len(cells)
        for row, line in enumerate(cells):
            edges = np.flatnonzero(np.diff(np.r_[1.0, line, 1.0]))  # white to black, and back
            y = top + side * row
            runs = edges.reshape(-1, 2)
            boxes += [[left + side * a, y, left + side * b, y + side] for a, b in runs]
    return np.array(boxes, np.float64)
