"""The command `coursekit`.

It calls what a notebook would, by the same names: `ck` loads a room when it is first used, so that
`coursekit --help` does not wait for all of them. The options stand in cli.toml.
"""

from __future__ import annotations

import argparse
import copy
import io
import re
import sys
import tomllib
from collections.abc import Sequence
from dataclasses import replace
from datetime import datetime
from functools import partial
from pathlib import Path
from typing import Any

import coursekit as ck
from coursekit import doctor
from coursekit.boards import Board
from coursekit.boards.board import Skipped, by_reason
from coursekit.checks import want
from coursekit.formats import numbers, poses
from coursekit.results import Exported
from coursekit.words import Estimate, Findings, say, wrapped

SHOWN = 1  # reason, the commonest, for which images were not used
NOT_TRUSTED = 3  # the exit code; what was found is written nevertheless

COMMANDS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
INSTEAD, OPTIONS, TYPED_AS = (COMMANDS.pop(name) for name in ("instead", "arguments", "wanted"))


def main(arguments: Sequence[str] | None = None) -> int:
    """Run `coursekit ARGUMENTS` and return its exit code: 0 done, 1 failed, 130 Ctrl-C.

    3 is a result that is written and not to be trusted. The doctor's is 1 when it found a problem.
    A report of graded bundles is done whatever is in the bundles; a bundle to hand in is done when
    it is written. Wrong usage exits with 2, as argparse does.
    """
    if (sys.argv[1:] if arguments is None else list(arguments)) == ["--version"]:
        print(f"coursekit {doctor.edition()}")
        return 0
    options = _parser().parse_args(arguments)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="replace")  # a terminal or a file may not know every sign
    try:
        _refuse_existing(options)
        return options.run(options) or 0
    except (ck.cameras.CameraError, OSError, ValueError) as error:
        name, colon, said = str(error).partition(": ")
        print("coursekit:", _typed(OPTIONS.get(name, name) + colon + said), file=sys.stderr)
        return 1
    except KeyboardInterrupt as stopped:
        print(f"coursekit: {stopped or 'stopped, nothing was written'}", file=sys.stderr)
        return 130


def _refuse_existing(options: argparse.Namespace) -> None:
    """Say that a file is there before the work and not after it; a report of grades goes on."""
    out = getattr(options, "out", None)
    if out and Path(out).is_file() and not options.overwrite:
        raise FileExistsError(f"{out} exists already: choose another name or --overwrite")


def _typed(text: str) -> str:
    """The text as somebody reads it who types options and not Python."""
    for python, option in INSTEAD.items():
        text = re.sub(python, option, text)
    return text


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="coursekit", description="The course's tools.")
    parser.add_argument("--version", action="store_true", help="say which course this is, and end")
    commands = parser.add_subparsers(required=True, metavar="COMMAND")
    table = copy.deepcopy(COMMANDS)
    table["export"]["options"]["--to"]["help"] = ", ".join(ck.results.EXPORTS)
    shared = table.pop("shared")
    for name, about in table.items():
        options, either = about.pop("options"), about.pop("either", [])
        for group in about.pop("with", []):
            options |= shared[group]
        if "epilog" in about:  # whose lines stay as they are
            about["formatter_class"] = argparse.RawDescriptionHelpFormatter
        command = commands.add_parser(name, **about)
        command.set_defaults(run=RUN[name])
        group = command.add_mutually_exclusive_group() if either else command
        for option, how in options.items():
            types = {"type": partial(_read, how["type"])} if "type" in how else {}
            (group if option in either else command).add_argument(option, **how | types)
    return parser


def _read(kind: str, text: str) -> Any:
    """What was typed, as one of TYPES; argparse ends with the message where it is none."""
    try:
        return TYPES[kind](text)
    except ValueError:
        raise argparse.ArgumentTypeError(f"got {text!r}, want {TYPED_AS[kind]}") from None


def _squares(text: str) -> tuple[int, int]:
    columns, _, rows = text.lower().partition("x")
    return int(columns), int(rows)


def _number(text: str) -> float:
    return float(text.replace(",", "."))


def _moment(text: str) -> datetime:
    """A moment as ISO 8601 has it; a day alone is its last second."""
    when = datetime.fromisoformat(text)
    return when.replace(hour=23, minute=59, second=59) if len(text) <= len("2026-03-02") else when


def _pose(text: str) -> Any:
    """What `export` takes as T_link_optical, looked at before any work."""
    return text if text == "turn" else poses.posed(numbers(text.split(), "pose"), "pose")


def _record(options: argparse.Namespace) -> None:
    with ck.open_camera(options.camera) as camera:
        print(_typed(str(camera)))
        path = camera.record(options.out, options.frames, overwrite=options.overwrite)
    print(f"Wrote {path}. Play it with ck.open_camera({str(path)!r}).")


def _described(options: argparse.Namespace) -> Board:
    """The board that --kind, --squares and the sizes say."""
    fields = {"dictionary": options.dictionary} if options.dictionary else {}
    if options.marker_mm is not None:
        fields["marker_m"] = options.marker_mm / 1000
    return ck.boards.Board(options.kind, options.squares, options.square_mm / 1000, **fields)


def _board(options: argparse.Namespace) -> None:
    board = _described(options)
    path = ck.boards.save_sheet(board, options.out, options.paper, overwrite=options.overwrite)
    print(f"Wrote {path}: {ck.boards.caption(board)}.")
    print("Print at 100 %, check that the bar measures 100 mm, and glue it flat to glass.")
    print(f"In Python: {board!r}")


def _calibrate(options: argparse.Namespace) -> None:
    board = _described(options)
    views = ck.boards.detect_all(options.folder, board)
    lens = ck.intrinsics.calibrate(views, board)
    findings = ck.intrinsics.diagnose(views, board)
    _say_how_good(lens, views.skipped, findings, options.details)
    done = ck.export(lens, options.to, options.out, overwrite=options.overwrite)
    print(replace(done, notes=done.notes[1:]))  # the first is the verdict


def _hand_eye(options: argparse.Namespace) -> int:
    want(Path(options.lens).is_file(), "--lens", options.lens, "the file of a lens")
    lens = ck.geometry.Intrinsics.from_file(options.lens)
    said = {name: getattr(options, name) for name in ("rotation", "length", "angle", "in_order")}
    what = options.folder, options.mount, _described(options), lens
    session = ck.hand_eye.HandEyeSession.from_folder(*what, **said)
    place = session.solve()
    findings = ck.hand_eye.diagnose(session)
    _say_how_good(place, session.skipped, findings, options.details, place.judgement.weak)
    done = _exported_place(place, options)
    print(replace(done, notes=done.notes[1:]))
    return 0 if place.judgement.trusted else NOT_TRUSTED


def _say_how_good(
    result: Estimate,
    skipped: Sequence[Skipped],
    findings: Findings,
    details: bool,
    weak: Sequence[str] = (),
) -> None:
    """How far to trust the result, what to do first, what was not used.

    weak: what could be better and is no finding.
    """
    first, *more = (" ".join(part.split()) for part in re.split(r"\n(?=\S)", result.verdict()))
    if details:
        print(_typed(f"{result.verdict()}\n{result}\n{findings!r}"))
    else:
        titles = "; ".join(finding.title for finding in findings)
        told = [reason for reason in more if reason.startswith("- ")]
        if findings:
            told = [f"Do first: {findings[0].remedy}", f"Found: {titles}."]
            told += [f"- {reason}" for reason in weak]
        print("\n".join(wrapped(_typed(line)) for line in [first, *told]))
    reasons = by_reason(skipped)
    shown = len(reasons) if details else SHOWN
    for group in reasons[:shown]:
        names = ", ".join(skip.name for skip in group)
        print(wrapped(_typed(f"not used: {names}: {group[0].reason}")))
    if rest := [skip.name for group in reasons[shown:] for skip in group]:
        print(wrapped(f"not used, either: {', '.join(rest)}"))
    if not details:
        print("Numbers, evidence and the other remedies: the same with --details.")


def _submit(options: argparse.Namespace) -> None:
    paragraph = options.paragraph
    if options.paragraph_file:
        try:
            paragraph = Path(options.paragraph_file).read_text(encoding="utf-8-sig")
        except UnicodeDecodeError:
            raise ValueError(say("others.not_text", file=options.paragraph_file)) from None
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
    choices = Choices(options.roster, options.late_after, options.separator, options.assignment)
    print(grade_folder(*how, overwrite=options.overwrite, choices=choices))


def _export(options: argparse.Namespace) -> None:
    print(_exported_place(options.what, options))


def _exported_place(what: Any, options: argparse.Namespace) -> Exported:
    """A place, with the frames that were named; or a lens, which has none."""
    names = ("parent", "optical", "link", "T_link_optical", "overwrite")
    given = {name: value for name in names if (value := getattr(options, name)) is not None}
    return ck.export(what, options.to, options.out, **given)


def _doctor(options: argparse.Namespace) -> int:
    return doctor.run(options.camera, options.json)


TYPES: dict[str, Any] = {"int": int, "float": _number, "lower": str.lower, "squares": _squares}
TYPES |= {"moment": _moment, "pose": _pose}
RUNS = (_calibrate, _hand_eye, _record, _board, _submit, _grade, _export, _doctor)
RUN = {run.__name__[1:].replace("_", "-"): run for run in RUNS}  # by the command's name
