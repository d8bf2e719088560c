"""The command `coursekit`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from coursekit.cameras import CameraError, open_camera


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `coursekit ARGUMENTS` and return its exit code: 0 done, 1 failed, 130 Ctrl-C.

    The doctor's is 1 when it found a problem. A report of graded bundles is done whatever is in the
    bundles; a bundle to hand in is done when it is written. Wrong usage exits with 2, as argparse
    does.
    """
    options = _parser().parse_args(arguments)
    try:
        return options.run(options) or 0
    except (CameraError, OSError, ValueError) as error:
        said = str(error).replace("overwrite=True", "--overwrite")  # which is Python's way
        print(f"coursekit: {said}", file=sys.stderr)
        return 1
    except KeyboardInterrupt as stopped:
        print(f"coursekit: {stopped or 'stopped, nothing was written'}", file=sys.stderr)
        return 130


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
    _add_submit(commands)
    _add_grade(commands)
    _add_doctor(commands)
    return parser


def _add_doctor(commands: Any) -> None:
    doctor = commands.add_parser(
        "doctor", help="say what works here, and what to do about the rest"
    )
    which = "auto (default), simulated, a serial number or a recording"
    doctor.add_argument("--camera", default="auto", metavar="WHICH", help=which)
    doctor.set_defaults(run=_doctor)


def _doctor(options: argparse.Namespace) -> int:
    from coursekit.doctor import run

    return run(options.camera)


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


def _add_submit(commands: Any) -> None:
    submit = commands.add_parser("submit", help="pack the studio exercise to hand it in")
    submit.add_argument("--student", required=True, metavar="NAME", help="as your course knows it")
    submit.add_argument("--distance", type=float, metavar="M", help="where the camera will be, m")
    submit.add_argument("--frames", type=int, default=1, metavar="N", help="averaged there")
    choices = ("bias", "noise")
    submit.add_argument("--dominates", type=str.lower, choices=choices, help="which error, there")
    words = submit.add_mutually_exclusive_group()
    words.add_argument("--paragraph", default="", metavar="TEXT", help="three sentences: why")
    words.add_argument("--paragraph-file", metavar="FILE", help="a text file that holds them")
    submit.add_argument("--folder", metavar="DIR", help="where to write, default: results/")
    submit.add_argument("--overwrite", action="store_true", help="replace an existing bundle")
    submit.set_defaults(run=_submit)


def _add_grade(commands: Any) -> None:
    grade = commands.add_parser(
        "grade",
        help="grade a folder of bundles",
        description="Grade every bundle (.zip) in a folder and below it. Stopped with Ctrl-C, the "
        "same command goes on from there. Nothing that a student wrote is run or unpacked.",
    )
    grade.add_argument("folder", metavar="FOLDER", help="what students handed in")
    grade.add_argument("--out", required=True, metavar="DIR", help="the report: a new folder")
    grade.add_argument("--workers", type=int, metavar="N", help="processes, default: one a core")
    grade.add_argument(
        "--timeout", type=float, default=10.0, metavar="S", help="seconds a bundle, default: 10"
    )
    grade.add_argument(
        "--overwrite",
        action="store_true",
        help="replace a finished report; only what has changed is graded",
    )
    grade.set_defaults(run=_grade)


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
    from coursekit.boards.sheet import caption

    fields = {"dictionary": options.dictionary} if options.dictionary else {}
    if options.marker_mm is not None:
        fields["marker_m"] = options.marker_mm / 1000
    board = Board(options.kind, options.squares, options.square_mm / 1000, **fields)
    path = save_sheet(board, options.out, options.paper, overwrite=options.overwrite)
    print(f"Wrote {path}: {caption(board)}.")
    print("Print at 100 %, check that the bar measures 100 mm, and glue it flat to glass.")
    print(f"In Python: {board!r}")


def _submit(options: argparse.Namespace) -> None:
    from coursekit.submission.submit import submit

    paragraph = options.paragraph
    if options.paragraph_file:
        try:
            paragraph = Path(options.paragraph_file).read_text(encoding="utf-8-sig")
        except UnicodeDecodeError:
            raise ValueError(
                f"{options.paragraph_file}: is no plain text in UTF-8; save it as that (in Word or "
                "Notepad: plain text, encoding UTF-8) and try again"
            ) from None
    handed = submit(
        options.student,
        options.distance,
        options.dominates,
        paragraph,
        options.frames,
        options.folder,
        options.overwrite,
    )
    if handed.path is None:
        raise ValueError(str(handed))
    print(handed)


def _grade(options: argparse.Namespace) -> None:
    from coursekit.submission.batch import grade_folder

    print(
        grade_folder(
            options.folder,
            options.out,
            options.workers,
            options.timeout,
            overwrite=options.overwrite,
        )
    )


if __name__ == "__main__":
    sys.exit(main())
