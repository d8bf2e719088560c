"""The command `coursekit`."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

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
    return parser


def _record(options: argparse.Namespace) -> None:
    with open_camera(options.camera) as camera:
        print(camera)
        path = camera.record(options.out, options.frames, overwrite=options.overwrite)
    print(f"Wrote {path}. Play it with ck.open_camera({str(path)!r}).")


if __name__ == "__main__":
    sys.exit(main())
