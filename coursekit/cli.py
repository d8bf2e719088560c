"""The command `coursekit`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from typing import Any

from coursekit.cameras import CameraError, open_camera


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `coursekit ARGUMENTS` and return its exit code: 0 done, 1 failed, 130 Ctrl-C.

    Wrong usage exits with 2, as argparse does.
    """
    options = _parser().parse_args(arguments)
    try:
        options.run(options)
    except (CameraError, ValueError) as error:
        print(f"coursekit: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("coursekit: stopped, nothing was written", file=sys.stderr)
        return 130
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="coursekit", description="The course's tools.")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    record = commands.add_parser("record", help="record a camera to a .db3 file")
    record.add_argument("--out", required=True, metavar="FILE", help="the .db3 file to write")
    record.add_argument("--frames", required=True, type=int, metavar="N", help="how many frames")
    record.add_argument(
        "--camera",
        default="auto",
        metavar="WHICH",
        help="auto (default), simulated, a serial number or a recording",
    )
    record.add_argument("--overwrite", action="store_true", help="replace an existing file")
    record.set_defaults(run=_record)
    _add_board(commands)
    return parser


def _add_board(commands: Any) -> None:
    board = commands.add_parser("board", help="print a calibration board to true scale")
    board.add_argument("--kind", choices=("checkerboard", "charuco"), default="charuco")
    board.add_argument(
        "--squares",
        required=True,
        type=_squares,
        metavar="9x6",
        help="columns x rows of squares (inner corners are one fewer each way)",
    )
    board.add_argument("--square-mm", required=True, type=float, metavar="MM")
    board.add_argument("--marker-mm", type=float, metavar="MM", help="default: 0.75 of a square")
    board.add_argument("--dictionary", metavar="NAME", help="of a ChArUco board's markers")
    board.add_argument("--paper", default="A4", metavar="NAME", help="A4 (default) to A0, Letter")
    board.add_argument("--out", required=True, metavar="FILE", help="a .pdf or .png file to write")
    board.add_argument("--overwrite", action="store_true", help="replace an existing file")
    board.set_defaults(run=_board)


def _squares(text: str) -> tuple[int, int]:
    columns, _, rows = text.lower().partition("x")
    try:
        return int(columns), int(rows)
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r}, want for example 9x6") from None


def _record(options: argparse.Namespace) -> None:
    with open_camera(options.camera) as camera:
        print(camera)
        path = camera.record(options.out, options.frames, overwrite=options.overwrite)
    print(f"Wrote {path}. Play it with ck.open_camera({str(path)!r}).")


def _board(options: argparse.Namespace) -> None:
    from coursekit.boards import Board, save_sheet
    from coursekit.boards.sheet import describe

    fields = {"dictionary": options.dictionary} if options.dictionary else {}
    if options.marker_mm is not None:
        fields["marker_m"] = options.marker_mm / 1000
    board = Board(options.kind, options.squares, options.square_mm / 1000, **fields)
    path = save_sheet(board, options.out, options.paper, overwrite=options.overwrite)
    print(f"Wrote {path}: {describe(board)}.")
    print("Print at 100 %, check that the bar measures 100 mm, and glue it flat to glass.")
    print(f"In Python: {board!r}")


if __name__ == "__main__":
    sys.exit(main())
