"""What a calibration board is: its pattern, its corners in metres, its exact picture."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any, Literal, get_args

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

Kind = Literal["checkerboard", "charuco"]
FEWEST_SQUARES = 3
FEWEST_CHECKERBOARD = 4  # OpenCV finds none with fewer than 3x3 inner corners
SMALLEST_M, LARGEST_M = 0.0005, 1.0  # of a square or marker: who gives millimetres is told so
MARKER_SHARE = 0.75  # of a square's side, unless the board says otherwise
DICTIONARIES = tuple(
    name for name in sorted(vars(cv2.aruco)) if name.startswith("DICT_") and name == name.upper()
)


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

    Raises ValueError for fields that make no board.
    """

    kind: Kind
    squares: tuple[int, int]
    square_m: float
    marker_m: float | None = None
    dictionary: str = "DICT_5X5_250"
    old_origin: bool = False

    def __post_init__(self) -> None:
        if self.kind not in get_args(Kind):
            raise ValueError(f"kind: got {self.kind!r}, want 'checkerboard' or 'charuco'")
        object.__setattr__(self, "squares", _squares(self.squares, self.kind))
        object.__setattr__(self, "square_m", _length("square_m", self.square_m))
        if self.kind == "checkerboard":
            if self.marker_m is not None or self.old_origin:
                raise ValueError("marker_m, old_origin: a checkerboard has neither, leave them out")
            return
        default = round(MARKER_SHARE * self.square_m, 9)  # 0.01875, not 0.018750000000000003
        marker_m = default if self.marker_m is None else self.marker_m
        object.__setattr__(self, "marker_m", _length("marker_m", marker_m))
        if self.marker_m >= self.square_m:  # type: ignore[operator]
            raise ValueError(
                f"marker_m: got {self.marker_m}, want less than the square's {self.square_m} m"
            )
        held = len(_dictionary(self.dictionary).bytesList)
        if self._marker_count > held:
            raise ValueError(
                f"dictionary: {self.dictionary} holds {held} markers, a board of {self.text} needs "
                f"{self._marker_count}"
            )

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
        points = self.square_m * np.stack([x, y, np.zeros_like(x)], axis=-1).reshape(-1, 3)
        points.flags.writeable = False
        return points

    @cached_property
    def falling(self) -> NDArray[np.bool_]:
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
    def turns(self) -> int:
        """How many ways of turning the board in its plane look the same: 1, 2 or 4.

        The markers of a ChArUco board tell its turns apart. So do the colours of a checkerboard
        with one even and one odd number of squares; with two odd or two even numbers it looks the
        same after half a turn, with equal odd ones after a quarter.
        """
        columns, rows = self.squares
        if self.kind == "charuco" or (columns + rows) % 2:
            return 1
        return 4 if columns == rows and columns % 2 else 2

    @property
    def text(self) -> str:
        """The squares in words that nobody can take for inner corners."""
        inner = "{}x{}".format(*self.corners)
        return "{}x{} squares ({} inner corners)".format(*self.squares, inner)

    def image(self, pixels_per_square: int) -> NDArray[np.uint8]:
        """The pattern without a border, (rows, columns) x pixels_per_square, 0 black, 255 white.

        A pixel that the edge of a marker's cell cuts gets the grey of its areas; edges of squares
        fall between pixels. `image_from_board` says where a point of the board lies in it.
        Raises ValueError for fewer than one pixel.
        """
        if (
            isinstance(pixels_per_square, bool)
            or not isinstance(pixels_per_square, (int, np.integer))
            or pixels_per_square < 1
        ):
            raise ValueError(f"pixels_per_square: got {pixels_per_square!r}, want at least 1 px")
        squares = np.kron(self.white, np.ones((pixels_per_square, pixels_per_square)))
        for left, top, cells in self.markers:
            side = self._marker_share / len(cells)
            columns = _cover(left, side, len(cells), pixels_per_square)
            rows = _cover(top, side, len(cells), pixels_per_square)
            x, y = int(left) * pixels_per_square, int(top) * pixels_per_square
            square = squares[y : y + pixels_per_square, x : x + pixels_per_square]
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
        margin = 0.5 * (1.0 - self._marker_share)
        return tuple(
            (
                column + margin,
                row + margin,
                _cells(dictionary, number),
            )
            for number, (row, column) in enumerate(np.argwhere(self.white).tolist())
        )

    @cached_property
    def marker_centres(self) -> Floats:
        """(M, 2): the markers' centres in squares, right and down from the top-left corner."""
        return np.argwhere(self.white)[:, ::-1] + np.float64(0.5)

    def opencv(self) -> Any:
        """The `cv2.aruco.CharucoBoard` of this board; ValueError for a checkerboard."""
        if self.marker_m is None:
            raise ValueError("kind: a checkerboard has no cv2.aruco.CharucoBoard")
        board = cv2.aruco.CharucoBoard(
            self.squares, self.square_m, self.marker_m, _dictionary(self.dictionary)
        )
        board.setLegacyPattern(self.old_origin)
        return board

    @cached_property
    def white(self) -> NDArray[np.bool_]:
        """(rows, columns): which squares are white, from the pattern's top-left corner."""
        columns, rows = self.squares
        first_white = self.old_origin and rows % 2 == 0
        return (np.add.outer(np.arange(rows), np.arange(columns)) + first_white) % 2 == 1

    @property
    def _marker_count(self) -> int:
        return int(self.white.sum())

    @property
    def _marker_share(self) -> float:
        """The marker's side in squares."""
        return self.marker_m / self.square_m if self.marker_m else 0.0


def _cover(first: float, side: float, cells: int, pixels: int) -> Floats:
    """(cells, pixels): the share of each pixel of a square's row that each cell covers.

    first: where the first cell starts, side: its width, both in squares.
    """
    edges = pixels * (first - int(first) + side * np.arange(cells + 1))[:, None]
    inside = np.clip(edges - np.arange(pixels), 0.0, 1.0)  # of the pixel, left of the edge
    return inside[:-1] - inside[1:]


def _cells(dictionary: Any, number: int) -> Floats:
    """The cells of a marker with its black frame, 0 black and 1 white."""
    n = dictionary.markerSize + 2
    return (cv2.aruco.generateImageMarker(dictionary, number, n, borderBits=1) > 0).astype(float)


@cache
def _dictionary(name: str) -> Any:
    if name not in DICTIONARIES:
        raise ValueError(f"dictionary: got {name!r}, want one of {', '.join(DICTIONARIES)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


def _squares(value: object, kind: Kind) -> tuple[int, int]:
    """`value` as (columns, rows); ValueError with the commonest mistake in mind."""
    fewest = FEWEST_CHECKERBOARD if kind == "checkerboard" else FEWEST_SQUARES
    counts = list(value) if isinstance(value, (tuple, list, np.ndarray)) else []
    whole = all(isinstance(n, (int, np.integer)) and not isinstance(n, bool) for n in counts)
    if len(counts) != 2 or not whole or min(counts) < fewest:
        raise ValueError(
            f"squares: got {value!r}, want (columns, rows) of squares, at least {fewest} each "
            "(inner corners are one fewer)"
        )
    return int(counts[0]), int(counts[1])


def _length(name: str, value: object) -> float:
    number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value <= 0:  # type: ignore[arg-type,operator]
        raise ValueError(f"{name}: got {value!r}, want a positive number of metres")
    if not SMALLEST_M <= value <= LARGEST_M:  # type: ignore[operator]
        raise ValueError(
            f"{name}: got {value!r} m; want {SMALLEST_M} to {LARGEST_M} m (25 mm is 0.025)"
        )
    return float(value)  # type: ignore[arg-type]
