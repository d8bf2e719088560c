"""The command `coursekit`.

It calls what a notebook would, by the same names: `ck` loads a room when it is first used, so that
`coursekit --help` does not wait for all of them.
"""

from __future__ import annotations

import argparse
import io
import sys
from collections.abc import Callable, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any

import coursekit as ck
from coursekit import doctor

OPTIONS = {"path": "--out", "n": "--frames", "which": "--camera", "distance_m": "--distance"}
OPTIONS |= {f"{name}_m": f"--{name}-mm (here in m)" for name in ("square", "marker")}
OPTIONS |= {name: f"--{name}" for name in ("squares", "paper", "dictionary", "workers", "timeout")}
INSTEAD = {"overwrite=True": "--overwrite", "run this cell again": "run this again"}
CAMERAS = "auto (default), simulated, a serial number or a recording"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `coursekit ARGUMENTS` and return its exit code: 0 done, 1 failed, 130 Ctrl-C.

    The doctor's is 1 when it found a problem. A report of graded bundles is done whatever is in the
    bundles; a bundle to hand in is done when it is written. Wrong usage exits with 2, as argparse
    does.
    """
    if (sys.argv[1:] if arguments is None else list(arguments)) == ["--version"]:
        print(f"coursekit {doctor.edition()}")
        return 0
    options = _parser().parse_args(arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal or a file may not know every sign
    try:
        return options.run(options) or 0
    except (ck.cameras.CameraError, OSError, ValueError) as error:
        name, colon, said = str(error).partition(": ")
        print("coursekit:", _typed(OPTIONS.get(name, name) + colon + said), file=sys.stderr)
        return 1
    except KeyboardInterrupt as stopped:
        print(f"coursekit: {stopped or 'stopped, nothing was written'}", file=sys.stderr)
        return 130


def _typed(text: str) -> str:
    """The text as somebody reads it who types options and not Python."""
    for python, option in INSTEAD.items():
        text = text.replace(python, option)
    return text


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="coursekit", description="The course's tools.")
    parser.add_argument("--version", action="store_true", help="say which course this is, and end")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")

    def command(name: str, run: Callable[..., Any], says: str, **more: Any) -> Any:
        added = commands.add_parser(name, help=says, **more)
        added.set_defaults(run=run)
        return added

    the = command("record", _record, "record a camera to a .db3 file")
    the.add_argument("--out", required=True, metavar="FILE", help="the .db3 file to write")
    the.add_argument("--frames", required=True, type=int, metavar="N", help="how many frames")
    the.add_argument("--camera", default="auto", metavar="WHICH", help=CAMERAS)
    the.add_argument("--overwrite", action="store_true", help="replace an existing file")

    the = command("board", _board, "print a calibration board to true scale")
    kinds = "charuco (default): chessboard with markers, may be seen in part"
    the.add_argument("--kind", choices=("checkerboard", "charuco"), default="charuco", help=kinds)
    squares = "columns x rows of squares (inner corners are one fewer each way)"
    the.add_argument("--squares", required=True, type=_squares, metavar="9x6", help=squares)
    side = "the side of a square"
    the.add_argument("--square-mm", required=True, type=float, metavar="MM", help=side)
    the.add_argument("--marker-mm", type=float, metavar="MM", help="default: 0.75 of a square")
    the.add_argument("--dictionary", metavar="NAME", help="of a ChArUco board's markers")
    the.add_argument("--paper", default="A4", metavar="NAME", help="A4 (default) to A0, Letter")
    the.add_argument("--out", required=True, metavar="FILE", help="a .pdf or .png file to write")
    the.add_argument("--overwrite", action="store_true", help="replace an existing file")

    the = command("submit", _submit, "pack the studio exercise to hand it in")
    the.add_argument("--student", required=True, metavar="NAME", help="as your course knows it")
    the.add_argument("--distance", type=float, metavar="M", help="where the camera will be, m")
    the.add_argument("--frames", type=int, default=1, metavar="N", help="averaged there")
    choices = ("bias", "noise")
    the.add_argument("--dominates", type=str.lower, choices=choices, help="which error, there")
    says = "what your own table does with samples far from all others of their pixel"
    the.add_argument("--mismatches", choices=("kept", "left out"), help=says)
    words = the.add_mutually_exclusive_group()
    words.add_argument("--paragraph", default="", metavar="TEXT", help="three sentences: why")
    words.add_argument("--paragraph-file", metavar="FILE", help="a text file that holds them")
    the.add_argument("--folder", metavar="DIR", help="where to write, default: results/")
    the.add_argument("--overwrite", action="store_true", help="replace an existing bundle")

    _add_grade(command)
    _add_export(command)
    _add_doctor(command)
    return parser


def _add_grade(command: Callable[..., Any]) -> None:
    more = (
        "Grade every bundle (.zip) in a folder and below it, or in the zip that Moodle or Canvas "
        "makes. Stopped with Ctrl-C, the same command goes on from there. Nothing that a student "
        "wrote is run."
    )
    lines = """the three commonest lines:
  coursekit grade submissions.zip
  coursekit grade submissions.zip --roster class.csv --late-after 2026-03-02T23:59
  the same again with --overwrite       (after your own points, or more hand-ins)
then: index.html is to read, own_points.csv is yours, moodle.csv or canvas.csv to import
"""
    raw = argparse.RawDescriptionHelpFormatter
    shape = {"description": more, "epilog": lines, "formatter_class": raw}
    the = command("grade", _grade, "grade a folder of bundles", **shape)
    the.add_argument("folder", metavar="FOLDER", help="what students handed in, or a .zip of it")
    the.add_argument("--out", metavar="DIR", help="the report: a new folder, default NAME_report")
    roster = "a table (CSV) of the class: names, any ids, any more columns"
    the.add_argument("--roster", metavar="FILE", help=roster)
    late = "the last moment that is not late, of this computer's zone"
    the.add_argument("--late-after", type=datetime.fromisoformat, metavar="MOMENT", help=late)
    the.add_argument("--separator", choices=(",", ";"), default=",", help="of the tables' cells")
    the.add_argument("--workers", type=int, metavar="N", help="processes, default: one a core")
    timeout = "seconds of computing a bundle, default: 10"
    the.add_argument("--timeout", type=float, default=10.0, metavar="S", help=timeout)
    finished = "replace a finished report; only what has changed is graded"
    the.add_argument("--overwrite", action="store_true", help=finished)


def _add_doctor(command: Callable[..., Any]) -> None:
    says = "say what works here, and what to do about the rest"
    more = "A line for each thing that must work: Python, packages, browser, camera and its link."
    the = command("doctor", lambda o: doctor.run(o.camera, o.json), says, description=more)
    the.add_argument("--camera", default="auto", metavar="WHICH", help=CAMERAS)
    the.add_argument("--json", action="store_true", help="the same for programs, and for a report")


def _export(options: argparse.Namespace) -> None:
    names = ("parent", "optical", "link", "T_link_optical", "overwrite")
    frames = {name: getattr(options, name) for name in names}
    print(ck.export(options.what, options.to, options.out, **frames))


def _add_export(command: Callable[..., Any]) -> None:
    more = "A lens, or where the camera is, as other programs read it (the README has a table)."
    the = command("export", _export, "write a result for ROS, OpenCV and others", description=more)
    what = "03_intrinsics, 04_hand_eye, or a file of a lens"
    the.add_argument("what", metavar="WHAT", help=what)
    the.add_argument("--to", required=True, metavar="FORMAT", help="/".join(ck.results.EXPORTS))
    the.add_argument("--out", metavar="FILE", help="default: print it")
    the.add_argument("--parent", metavar="FRAME", help="what X is given in, default: the gripper")
    the.add_argument("--optical", metavar="FRAME", default=ck.results.OPTICAL)
    the.add_argument("--link", metavar="FRAME", help="of the driver, above the optical frame")
    pose = "where optical is in link, m: 'turn', or 'x y z qx qy qz qw' as tf2_echo says"
    the.add_argument("--link-to-optical", dest="T_link_optical", metavar="POSE", help=pose)
    the.add_argument("--overwrite", action="store_true", help="replace an existing file")


def _squares(text: str) -> tuple[int, int]:
    columns, _, rows = text.lower().partition("x")
    try:
        return int(columns), int(rows)
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r}, want for example 9x6") from None


def _record(options: argparse.Namespace) -> None:
    with ck.open_camera(options.camera) as camera:
        print(_typed(str(camera)))
        path = camera.record(options.out, options.frames, overwrite=options.overwrite)
    print(f"Wrote {path}. Play it with ck.open_camera({str(path)!r}).")


def _board(options: argparse.Namespace) -> None:
    fields = {"dictionary": options.dictionary} if options.dictionary else {}
    if options.marker_mm is not None:
        fields["marker_m"] = options.marker_mm / 1000
    board = ck.boards.Board(options.kind, options.squares, options.square_mm / 1000, **fields)
    path = ck.boards.save_sheet(board, options.out, options.paper, overwrite=options.overwrite)
    print(f"Wrote {path}: {ck.boards.caption(board)}.")
    print("Print at 100 %, check that the bar measures 100 mm, and glue it flat to glass.")
    print(f"In Python: {board!r}")


def _submit(options: argparse.Namespace) -> None:
    paragraph = options.paragraph
    if options.paragraph_file:
        try:
            paragraph = Path(options.paragraph_file).read_text(encoding="utf-8-sig")
        except UnicodeDecodeError:
            raise ValueError(
                f"{options.paragraph_file}: is no plain text in UTF-8; save it as that (in Word or "
                "Notepad: plain text, encoding UTF-8) and try again"
            ) from None
    claims = options.distance, options.dominates, paragraph, options.frames
    where = options.folder, options.overwrite, options.mismatches
    handed = ck.submit(options.student, *claims, *where)
    if handed.path is None:
        raise ValueError(str(handed))
    print(handed)


def _grade(options: argparse.Namespace) -> None:
    # No notebook needs it, so it has no short name.
    from coursekit.submission.batch import Choices, grade_folder

    how = options.folder, options.out, options.workers, options.timeout
    choices = Choices(options.roster, options.late_after, options.separator)
    print(grade_folder(*how, overwrite=options.overwrite, choices=choices))


if __name__ == "__main__":
    sys.exit(main())
