"""A hand-eye session: arm poses and what the camera saw at each, in memory and in a folder.

A folder holds the images, `poses.csv` with one row for each, and `session.json` with the mount, the
board and the intrinsics. The columns of poses.csv, in any order, others are ignored:

    file                        the image's name in the folder
    x, y, z                     T_base_gripper's translation, m           } these seven,
    qx, qy, qz, qw              and its rotation as a unit quaternion     } or
    q0 .. q5                    joint angles, rad                         } these six, or both
    dq0 .. dq5                  joint velocities at that moment, rad/s (optional)
    time                        of the image, s (optional)
"""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from coursekit.arm import widowx
from coursekit.arrays import ArrayLike, Floats, NDArray
from coursekit.boards import Board, Detections, detect_all
from coursekit.boards.board import Skipped
from coursekit.boards.detector import SESSION
from coursekit.geometry import Intrinsics, make_transform
from coursekit.hand_eye.closed_form import FEWEST
from coursekit.hand_eye.poses import Mount, check_mount, check_poses
from coursekit.hand_eye.refinement import BoardPose, board_poses
from coursekit.hand_eye.result import HandEyeResult
from coursekit.hand_eye.solver import solve
from coursekit.results import write_bytes

POSES = "poses.csv"
PLACE = ("x", "y", "z")
TURN = ("qx", "qy", "qz", "qw")
JOINTS = tuple(f"q{joint}" for joint in range(6))
SPEEDS = tuple(f"d{name}" for name in JOINTS)
UNIT_TOLERANCE = 1e-3  # of a quaternion's length: four digits


@dataclass(frozen=True, eq=False, repr=False)
class HandEyeSession:
    """Arm poses and what the camera saw at each.

    mount: "eye_in_hand" or "eye_to_hand". T_base_gripper (n, 4, 4): as the arm reports them, m.
    seen: detections, with board and intrinsics, or poses T_camera_board (n, 4, 4), m. q (n, 6): the
    joint angles, rad; dq (n, 6): their velocities when the image was taken, rad/s; times (n,): of
    the images, s; all three optional. names: of the views. skipped: what was not used, and why.

    Raises ValueError that names the argument, and the index, for what does not belong together.
    """

    mount: Mount
    T_base_gripper: Floats
    seen: Detections | Floats
    board: Board | None = None
    intrinsics: Intrinsics | None = None
    q: Floats | None = None
    dq: Floats | None = None
    times: Floats | None = None
    names: tuple[str, ...] = ()
    skipped: tuple[Skipped, ...] = ()

    def __post_init__(self) -> None:
        check_mount(self.mount)
        poses = check_poses("T_base_gripper", self.T_base_gripper)
        object.__setattr__(self, "T_base_gripper", poses)
        n = len(poses)
        if isinstance(self.seen, Detections):
            for name in ("board", "intrinsics"):
                if getattr(self, name) is None:
                    raise ValueError(f"{name}: got None; detections need the board and intrinsics")
        else:
            object.__setattr__(self, "seen", check_poses("seen", self.seen))
        if len(self.seen) != n:
            raise ValueError(f"seen: got {len(self.seen)}, T_base_gripper has {n}: one for each")
        for name, width in (("q", (6,)), ("dq", (6,)), ("times", ())):
            if getattr(self, name) is not None:
                object.__setattr__(self, name, _rows(name, getattr(self, name), (n, *width)))
        if self.dq is not None and self.q is None:
            raise ValueError("dq: velocities need the joint angles q as well")
        names = self.names or tuple(f"view {i:02d}" for i in range(n))
        if len(names) != n:
            raise ValueError(f"names: got {len(names)}, T_base_gripper has {n}")
        object.__setattr__(self, "names", names)

    @property
    def detections(self) -> Detections | None:
        """The corners in the images, None where only poses are known."""
        return self.seen if isinstance(self.seen, Detections) else None

    @cached_property
    def board_poses(self) -> tuple[BoardPose, ...]:
        """What each image alone says of the board; () where only poses are known."""
        if self.detections is None:
            return ()
        assert self.board is not None
        assert self.intrinsics is not None
        return tuple(board_poses(self.detections, self.board, self.intrinsics))

    @cached_property
    def T_camera_board(self) -> Floats:
        """Where the camera saw the board, (n, 4, 4), m."""
        if isinstance(self.seen, Detections):
            return np.stack([pose.T_camera_board for pose in self.board_poses])
        return self.seen

    def __len__(self) -> int:
        """How many pairs of arm pose and image."""
        return len(self.T_base_gripper)

    def pick(self, which: Sequence[int] | NDArray[np.intp]) -> HandEyeSession:
        """The pairs with these numbers, in this order."""
        which = np.asarray(which, int)
        rows: dict[str, Any] = {
            name: None if getattr(self, name) is None else getattr(self, name)[which]
            for name in ("T_base_gripper", "q", "dq", "times")
        }
        seen = self.seen.pick(which) if isinstance(self.seen, Detections) else self.seen[which]
        names = tuple(self.names[i] for i in which)
        return replace(self, seen=seen, names=names, **rows)

    def solve(self, method: str = "refine", **options: Any) -> HandEyeResult:
        """`hand_eye.solve` of this session; options as there."""
        known = {"board": self.board, "intrinsics": self.intrinsics} | options
        return solve(self.T_base_gripper, self.seen, self.mount, method, **known)

    def __repr__(self) -> str:
        what = "poses of the board" if self.detections is None else "images"
        extras = [text for value, text in (
            (self.q, "joint angles"), (self.dq, "joint velocities"), (self.times, "times"),
        ) if value is not None]  # fmt: skip
        lines = [f"{self.mount}: {len(self)} arm poses and {what}" + "".join(
            f", {text}" for text in extras)]  # fmt: skip
        if self.board is not None:
            lines.append(f"  {self.board.text}, squares of {1e3 * self.board.square_m:g} mm")
        return "\n".join([*lines, *(f"  not used: {skip!r}" for skip in self.skipped)])

    # --- a folder ---

    @classmethod
    def from_folder(
        cls,
        folder: str | os.PathLike[str],
        mount: Mount | None = None,
        board: Board | None = None,
        intrinsics: Intrinsics | None = None,
        progress: bool = True,
    ) -> HandEyeSession:
        """A session from images and `poses.csv`; see the module for its columns.

        mount, board, intrinsics: what session.json says unless given. Rows without joint angles
        need none, rows without a pose get it from the WidowX's kinematics. A row that cannot be
        used and an image without a board are listed in `skipped`, with the line and the reason.
        Raises ValueError where the folder, the table or one of its columns is missing, and where
        fewer than three pairs are left.
        """
        place = Path(folder)
        if not place.is_dir():
            raise ValueError(f"folder: got {os.fspath(folder)!r}, want a folder that exists")
        card = _card(place)
        mount = check_mount(mount or _from_card(card, "mount", place))
        board = board or _board(_from_card(card, "board", place))
        intrinsics = intrinsics or Intrinsics.from_dict(_from_card(card, "intrinsics", place))
        rows, skipped = _table(place)
        files = [place / row.file for row in rows]
        seen = detect_all(files, board, progress) if files else Detections()
        found = {view.name: view for view in seen}
        used = [row for row in rows if row.file in found]
        skipped += seen.skipped
        if len(used) < FEWEST:
            raise ValueError(
                f"folder: {len(used)} usable pairs of arm pose and image in "
                f"{os.fspath(folder)!r}, want at least {FEWEST}"
                + "".join(f"; {skip!r}" for skip in skipped[:3])
            )
        return cls(
            mount,
            np.stack([row.T_base_gripper for row in used]),
            Detections([found[row.file] for row in used]),
            board,
            intrinsics,
            _all_or_none([row.q for row in used]),
            _all_or_none([row.dq for row in used]),
            _all_or_none([row.time for row in used]),
            tuple(row.file for row in used),
            tuple(skipped),
        )

    def save(
        self,
        folder: str | os.PathLike[str],
        images: Mapping[str, bytes],
        about: Mapping[str, object] | None = None,
    ) -> None:
        """Write the session as `from_folder` reads it; each file whole or not at all.

        images: the encoded file (PNG, JPEG) of each view, by its name. about: what else
        session.json should say, such as where the session comes from.
        Raises ValueError where an image is missing, or there is no board or intrinsics to write.
        """
        missing = [name for name in self.names if name not in images]
        if missing:
            raise ValueError(f"images: no {missing[0]!r}; want one for each of {len(self)} views")
        if self.board is None or self.intrinsics is None:
            raise ValueError("board, intrinsics: a folder of images needs both")
        place = Path(folder)
        place.mkdir(parents=True, exist_ok=True)
        for name in self.names:
            write_bytes(place / name, images[name])
        write_bytes(place / POSES, self._csv().encode())
        card = {
            "mount": self.mount,
            "board": asdict(self.board) | {"squares": list(self.board.squares)},
            "intrinsics": self.intrinsics.to_dict(),
            **(about or {}),
        }
        write_bytes(place / SESSION, (json.dumps(card, indent=1) + "\n").encode())

    def _csv(self) -> str:
        from scipy.spatial.transform import Rotation

        turns = Rotation.from_matrix(self.T_base_gripper[:, :3, :3]).as_quat(canonical=True)
        columns = [*PLACE, *TURN]
        blocks = [self.T_base_gripper[:, :3, 3], turns]
        for names, values in ((("time",), self.times), (JOINTS, self.q), (SPEEDS, self.dq)):
            if values is not None:
                columns += names
                blocks.append(values.reshape(len(self), -1))
        lines = [",".join(["file", *columns])]
        for name, row in zip(self.names, np.hstack(blocks), strict=True):
            lines.append(",".join([name, *(f"{value + 0.0:.8g}" for value in row)]))
        return "\n".join(lines) + "\n"


def _rows(name: str, value: ArrayLike, shape: tuple[int, ...]) -> Floats:
    rows = np.asarray(value, float)
    if rows.shape != shape:
        raise ValueError(f"{name}: got shape {rows.shape}, want {shape}")
    bad = np.flatnonzero(~np.isfinite(rows.reshape(len(rows), -1)).all(axis=1))
    if bad.size:
        raise ValueError(f"{name}[{bad[0]}]: has NaN or infinite entries")
    return rows


# --- reading a folder ---


@dataclass(frozen=True, eq=False)
class _Row:
    """One usable row of poses.csv."""

    file: str
    T_base_gripper: Floats
    q: Floats | None
    dq: Floats | None
    time: float | None


def _card(folder: Path) -> dict[str, Any]:
    path = folder / SESSION
    if not path.exists():
        return {}
    try:
        card = json.loads(path.read_text("utf-8"))
    except ValueError as error:
        raise ValueError(f"folder: {path.name} is no JSON ({error})") from error
    if not isinstance(card, dict):
        raise ValueError(f"folder: {path.name} holds a {type(card).__name__}, want an object")
    return card


def _from_card(card: dict[str, Any], key: str, folder: Path) -> Any:
    if key not in card:
        raise ValueError(f"{key}: neither given nor in {folder.name}/{SESSION}")
    return card[key]


def _board(card: dict[str, Any]) -> Board:
    try:
        return Board(**card | {"squares": tuple(card["squares"])})
    except (KeyError, TypeError) as error:
        raise ValueError(f"board: {SESSION} does not describe one ({error})") from error


def _table(folder: Path) -> tuple[list[_Row], list[Skipped]]:
    """The usable rows of poses.csv, and what is wrong with the others."""
    path = folder / POSES
    if not path.exists():
        raise ValueError(f"folder: has no {POSES}, the table of arm poses")
    with path.open(newline="", encoding="utf-8-sig") as lines:
        table = csv.DictReader(lines, skipinitialspace=True)
        columns = {name.strip() for name in table.fieldnames or ()}
        _check_columns(columns)
        rows, skipped = [], []
        taken: set[str] = set()
        for values in table:
            cells = {key.strip(): value for key, value in values.items() if key is not None}
            file = (cells.get("file") or "").strip()
            where = f"{POSES}, line {table.line_num}" + (f" ({file})" if file else "")
            try:
                row = _read_row(file, cells, columns, folder, taken)
            except _BadRow as reason:
                skipped.append(Skipped(where, str(reason)))
            else:
                taken.add(file)
                rows.append(row)
    return rows, skipped


class _BadRow(Exception):
    """A row cannot be used; the message says why."""


def _check_columns(columns: set[str]) -> None:
    if "file" not in columns:
        raise ValueError(f"folder: {POSES} has no column 'file'; its columns are {sorted(columns)}")
    missing = [name for name in (*PLACE, *TURN) if name not in columns]
    if missing and not columns.issuperset(JOINTS):
        raise ValueError(
            f"folder: {POSES} has no column {missing[0]!r}, and not all of {', '.join(JOINTS)} "
            "either: want a pose (m and a quaternion) or joint angles (rad)"
        )


def _read_row(
    file: str, cells: Mapping[str, str | None], columns: set[str], folder: Path, taken: set[str]
) -> _Row:
    if not file:
        raise _BadRow("no file is named")
    if file in taken:
        raise _BadRow("the file has a row already; which of the two is right?")
    if not (folder / file).is_file():
        raise _BadRow("there is no such file in the folder")
    q = _numbers(cells, JOINTS) if columns.issuperset(JOINTS) else None
    dq = _numbers(cells, SPEEDS) if columns.issuperset(SPEEDS) else None
    time = float(_numbers(cells, ("time",))[0]) if "time" in columns else None
    if columns.issuperset((*PLACE, *TURN)):
        T = _pose(_numbers(cells, PLACE), _numbers(cells, TURN))
    else:
        assert q is not None
        T = widowx().forward(q)
    return _Row(file, T, q, dq, time)


def _numbers(cells: Mapping[str, str | None], names: Sequence[str]) -> Floats:
    values = []
    for name in names:
        text = (cells.get(name) or "").strip()
        try:
            value = float(text)
        except ValueError:
            raise _BadRow(f"{name} is {text!r}, no number") from None
        if not np.isfinite(value):
            raise _BadRow(f"{name} is {text}, want a finite number")
        values.append(value)
    return np.array(values)


def _pose(place: Floats, turn: Floats) -> Floats:
    from scipy.spatial.transform import Rotation

    length = float(np.linalg.norm(turn))
    if abs(length - 1) > UNIT_TOLERANCE:
        raise _BadRow(f"the quaternion has length {length:.4g}, want 1")
    return make_transform(Rotation.from_quat(turn).as_matrix(), place)


def _all_or_none(values: Sequence[Any]) -> Floats | None:
    return None if any(value is None for value in values) else np.array(values)
