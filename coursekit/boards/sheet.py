"""A board on paper, to true scale, with a bar to check the print by."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.boards.board import Board
from coursekit.checks import want, whole

PAPERS_MM = {  # short and long side
    "A4": (210.0, 297.0),
    "A3": (297.0, 420.0),
    "A2": (420.0, 594.0),
    "A1": (594.0, 841.0),
    "A0": (841.0, 1189.0),
    "Letter": (215.9, 279.4),
    "Legal": (215.9, 355.6),
    "Tabloid": (279.4, 431.8),
}
MARGIN_MM = 6.0  # printers leave about 5 mm blank
FOOT_MM = 18.0  # bar and text below the board
BAR_MM = 100.0
MM_PER_INCH = 25.4
ADVICE = """\
Print at 100 % (no "fit to page"). The bar must measure 100 mm; if not, use the measured square.
Glue it dead flat to glass or aluminium: 1 mm of bow spoils fx by 3 %."""


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


def _page(board: Board, paper: str) -> tuple[float, float]:
    """(width, height) of the sheet in mm, upright or lying; ValueError for too big a board."""
    names = {name.lower(): name for name in PAPERS_MM}
    want(str(paper).lower() in names, "paper", paper, f"one of {', '.join(PAPERS_MM)}")
    name = names[paper.lower()]
    if pages := _fitting(board, name):
        return pages[0]
    sides = PAPERS_MM[name]
    square = max(_largest_square_mm(board, page) for page in (sides, sides[::-1]))
    larger = next((other for other in PAPERS_MM if _fitting(board, other)), "a print shop")
    width, height = (1000 * side for side in board.size_m)
    raise ValueError(
        f"paper: a board of {width:g} x {height:g} mm does not fit on {name}: take {larger}, or "
        f"squares of at most {np.floor(10 * square) / 10:g} mm"
    )


def _fitting(board: Board, paper: str) -> list[tuple[float, float]]:
    """The ways to turn a paper, (width, height) in mm, upright first, that hold the board."""
    sides = PAPERS_MM[paper]
    least = 1000 * board.square_m * (1 - 1e-9)
    return [page for page in (sides, sides[::-1]) if _largest_square_mm(board, page) >= least]


def _largest_square_mm(board: Board, page: tuple[float, float]) -> float:
    """The largest square for this many of them on a page, mm; 0 where the bar has no room."""
    if page[0] < BAR_MM + 2 * MARGIN_MM:
        return 0.0
    columns, rows = board.squares
    return min((page[0] - 2 * MARGIN_MM) / columns, (page[1] - 2 * MARGIN_MM - FOOT_MM) / rows)


def _draw(board: Board, page_mm: tuple[float, float]) -> Any:
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
    words = f"{caption(board)}.\n{ADVICE}"
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
