"""Tables of arm poses, pose samples of other calibrators, and transforms for a robot's software.

A table says what its numbers are by the names of its columns, or whoever reads it says so: metres
or millimetres, radians or degrees, and how three numbers turn. What nobody states is not guessed.
Rotations are named as SciPy does: "rotation_vector", or Euler angles by the order of their axes,
small letters for fixed axes ("xyz": roll, pitch, yaw as in URDF), capitals for the body's own
("ZYX": KUKA).
"""

from __future__ import annotations

import csv
import itertools
import math
import os
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import Floats
from coursekit.checks import choice, transform, want
from coursekit.formats import FORMAT_TEXTS, fill, kind_of, numbers, one_number, read_text, tree

PLACE, TURN, THREE = ("x", "y", "z"), ("qx", "qy", "qz", "qw"), ("rx", "ry", "rz")
JOINTS = tuple(f"q{joint}" for joint in range(6))
VELOCITIES = tuple(f"d{name}" for name in JOINTS)
ANGULAR = (*THREE, *JOINTS, *VELOCITIES)
UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001, "rad": 1.0}
UNITS |= dict.fromkeys(("deg", "degrees", "°"), math.pi / 180)
AXIS_ORDERS = [f"{a}{b}{c}" for a, b, c in itertools.product("xyz", repeat=3) if a != b != c]
ROTATIONS = ("rotation_vector", *AXIS_ORDERS, *(order.upper() for order in AXIS_ORDERS))
POSE_COLUMNS = FORMAT_TEXTS["columns"]
COLUMN_NAMES = {name: ours for ours, names in POSE_COLUMNS.items() for name in names.split()}
HEADING = re.compile(r"(.+?)(?:[ _]*[\[(]|[ _])(mm|cm|m|deg|degrees|rad|°)[\])]?")
UNIT_TOLERANCE = 1e-3  # of a quaternion's length: four digits
# No arm's gripper is farther from its base's origin than the one, nor as near as the other, always
LONGEST_ARM_M, SHORTEST_ARM_M = 10.0, 0.005
TABLE = "a table of arm poses"
SAMPLES = "pose samples of easy_handeye2 or MoveIt"
PLACE_FORMATS = ("tf2", "urdf", "moveit", "easy_handeye2")


# --- tables ---


@dataclass(frozen=True)
class PoseRow:
    """A line of a table: the image's file, and its numbers by our names in m, rad, s.

    T (4, 4): T_base_gripper, None where the table has no pose. problem: why the row cannot be used,
    "" where it can.
    """

    line: int
    file: str
    values: dict[str, float]
    T: Floats | None = None
    problem: str = ""


@dataclass(frozen=True)
class PoseTable:
    """A table of poses: where each of its columns, by our names, stands, and how large its unit is.

    rotation: how its three numbers turn, None where it has a quaternion, or none of them. header:
    the names of its columns as they stand in it.
    """

    name: str
    places: dict[str, int]
    units: dict[str, float]
    rotation: str | None
    header: tuple[str, ...]

    def row(self, line: int, cells: Sequence[str]) -> PoseRow:
        """A line of the table, with what is wrong in it."""
        texts = {ours: "".join(cells[at : at + 1]).strip() for ours, at in self.places.items()}
        file, values = texts.pop("file", "").replace("\\", "/"), {}
        for ours, text in texts.items():
            plain = text.strip('p[]()" ')  # as Universal Robots write a pose: p[0.1, ..., 3.1]
            try:
                values[ours] = float(plain.replace(",", ".")) * self.units.get(ours, 1.0)
            except ValueError:
                return PoseRow(line, file, {}, None, f"{ours} is {text[:40]!r}, no number")
            if not math.isfinite(values[ours]):
                return PoseRow(line, file, {}, None, f"{ours} is {text[:40]}, want a finite number")
        if not values.keys() >= {*PLACE} or not (self.rotation or values.keys() >= {*TURN}):
            return PoseRow(line, file, values)
        T = np.eye(4)
        T[:3, 3] = [values[name] for name in PLACE]
        turn = [values[name] for name in (THREE if self.rotation else TURN)]
        length = float(np.linalg.norm(turn))
        if not self.rotation and abs(length - 1) > UNIT_TOLERANCE:
            problem = f"the quaternion has length {length:.4g}, want 1"
            return PoseRow(line, file, values, None, problem)
        T[:3, :3] = turned_by(turn, self.rotation).as_matrix()
        return PoseRow(line, file, values, T)


def turned_by(turn: Sequence[float] | Floats, rotation: str | None) -> Rotation:
    """The rotation of a quaternion (4) or, as `rotation` names it, of three angles in rad.

    Or of many, (n, 4) or (n, 3).
    """
    if rotation is None:
        return Rotation.from_quat(turn)
    if rotation == "rotation_vector":
        return Rotation.from_rotvec(turn)
    return Rotation.from_euler(rotation, turn)


def read_table(
    path: str | os.PathLike[str],
    rotation: str | None = None,
    length: str | None = None,
    angle: str | None = None,
) -> tuple[PoseTable, list[PoseRow]]:
    """A table of poses, with a line that names its columns; the names are in texts.toml.

    Separated by commas, semicolons, tabs or spaces; decimal commas where commas do not separate;
    lines with # are comments. rotation: how rx, ry, rz turn; length ("m", "cm", "mm") and angle
    ("rad", "deg"): the units of columns whose names, such as x_mm, do not say it. m and rad are
    taken for granted but where three angles turn.

    Raises ValueError in a sentence for no table, for rotations that nobody describes, and where
    the arm would reach 400 m or turn by 180 rad.
    """
    choice("rotation", rotation, (None, *ROTATIONS))
    choice("length", length, (None, "m", "cm", "mm"))
    choice("angle", angle, (None, "rad", "deg"))
    name, text = Path(path).name, read_text(path, TABLE)
    lines = [line.strip() for line in text.splitlines()]
    first, header = _header(lines, name)
    mark = next((mark for mark in ";\t," if mark in header), " ")
    lines = ["" if line.startswith("#") else line for line in lines]
    try:
        (cells,) = csv.reader([header], delimiter=mark, skipinitialspace=True)
        table = _columns(cells, name, rotation, length, angle)
        reader = csv.reader(lines[first:], delimiter=mark, skipinitialspace=True)
        rows = [table.row(first + reader.line_num, row) for row in reader if any(row)]
    except csv.Error as error:
        raise ValueError(f"{name}: is damaged ({error}), want {TABLE}") from None
    _plausible(table, [row.values for row in rows if not row.problem])
    return table, rows


def _header(lines: list[str], name: str) -> tuple[int, str]:
    """The number of the first line of the body, and the header, which may be a comment."""
    comment = ""
    for number, line in enumerate(lines):
        if line.startswith(("#", "sep=")):  # the latter is Excel's
            comment = line.lstrip("# ")
        elif line:
            for at, header in ((number + 1, line), (number, comment)):
                cells = re.split(r"[;,\t ]+", re.sub(r" +[\[(]", "(", header))
                if sum(_known(cell)[0] in POSE_COLUMNS for cell in cells) >= 3:
                    return at, header
            break
    kind = kind_of("\n".join(lines[:50]), "no line that names such columns")
    wanted = "image, x, y, z and qx, qy, qz, qw or rx, ry, rz; or image, q0, ..., q5"
    raise ValueError(f"{name}: got {kind}, want {TABLE}, whose first line has {wanted}")


def _known(cell: str) -> tuple[str, str, str]:
    """Our name of a column, its plain name, and the unit in it."""
    plain = re.sub(r"[.\-/ ]", "_", cell[:60].strip('" ').lower())
    found = HEADING.fullmatch(plain)
    if found and found[1] in COLUMN_NAMES:
        return COLUMN_NAMES[found[1]], found[1], found[2]
    return COLUMN_NAMES.get(plain, plain), plain, ""


def _columns(
    cells: Sequence[str], name: str, rotation: str | None, length: str | None, angle: str | None
) -> PoseTable:
    """What the header and the caller say of the columns; ValueError where that is not enough."""
    places: dict[str, int] = {}
    units = dict.fromkeys(PLACE, UNITS[length or "m"])
    units |= dict.fromkeys(ANGULAR, UNITS[angle or "rad"])
    says, angular = None, angle is not None
    for at, (ours, plain, unit) in enumerate(map(_known, cells)):
        if ours not in POSE_COLUMNS:
            continue
        want(ours not in places, f"{name}, column {cells[at]!r}", "a second one", f"one {ours}")
        places[ours] = at
        says = FORMAT_TEXTS["stated"].get(plain, says)
        angular |= (unit != "" or plain.startswith("actual_tcp")) and ours == "rx"
        units |= {ours: UNITS[unit]} if unit else {}
    if places.keys() >= {*TURN} or not places.keys() >= {*THREE}:
        return PoseTable(name, places, units, None, tuple(cells))
    agree = None in (says, rotation) or says == rotation
    want(agree, "rotation", rotation, f"{says!r}, which the columns of {name} say")
    if not (says or rotation) or not angular:
        missing = "how they turn" if not (says or rotation) else "whether in rad or in deg"
        raise ValueError(FORMAT_TEXTS["messages"]["rotation"].format(name=name, missing=missing))
    return PoseTable(name, places, units, rotation or says, tuple(cells))


def _plausible(table: PoseTable, rows: list[dict[str, float]]) -> None:
    """ValueError where the units would make an arm that is none."""

    def refuse(what: str, if_: str, argument: str) -> None:
        say = f"if they are {if_}, say {argument}={if_!r}"
        raise ValueError(f"{table.name}: {what}; {say}, or name the columns so ('x_mm', 'rz_deg')")

    for names in (PLACE, THREE, JOINTS):
        there = table.places.keys() >= {*names} and (names != THREE or table.rotation)
        if not rows or not there:
            continue
        most = max(abs(row[name]) for row in rows for name in names)
        few, degrees = len(rows) < 3, table.units[names[0]] < 1
        if names == PLACE and most > LONGEST_ARM_M:
            refuse(f"its positions reach {most:.0f} m", "mm", "length")
        if names == PLACE and most < SHORTEST_ARM_M and not few:
            refuse(f"its positions stay within {1e3 * most:.2g} mm", "m", "length")
        if names != PLACE and not degrees and most > 2 * math.pi + 0.01:
            refuse(f"its angles reach {most:.0f} rad", "deg", "angle")
        if names != PLACE and degrees and math.degrees(most) < math.pi + 0.01 and not few:
            refuse(f"no angle is larger than {math.degrees(most):.2f} deg", "rad", "angle")


# --- samples of other calibrators ---


def read_samples(path: str | os.PathLike[str], mount: str | None) -> tuple[Floats, Floats, str]:
    """Pose pairs of easy_handeye2 (.samples) or MoveIt's calibrator (.yaml), by content.

    Returns T_base_gripper (n, 4, 4), T_camera_board (n, 4, 4) and the mount, which is the file's
    where `mount` is None. easy_handeye2 keeps T_gripper_base for a camera that is not on the arm.
    Raises ValueError in a sentence for another file, a damaged one, transforms that are none, and a
    mount that nobody states. Sources: handeye_sampler.py and handeye_control_widget.cpp of the two.
    """
    name, text = Path(path).name, read_text(path, SAMPLES)
    found, says, easy = tree(text, name, SAMPLES), None, False
    if isinstance(found, dict) and isinstance(found.get("samples"), list):
        about = found.get("parameters")
        kind = (about if isinstance(about, dict) else {}).get("calibration_type") or None
        kinds = {None: None, "eye_in_hand": "eye_in_hand", "eye_on_base": "eye_to_hand"}
        says, found, easy = kinds[choice("calibration_type", kind, kinds)], found["samples"], True
    want(isinstance(found, list) and found, name, kind_of(text), SAMPLES)
    want(None in (says, mount) or says == mount, "mount", mount, f"{says!r}, as {name} says")
    mount = mount or says
    want(mount, "mount", mount, f"'eye_in_hand' or 'eye_to_hand': {name} does not say")
    sides = (("robot", "effector_wrt_world"), ("tracking", "optical", "object_wrt_sensor"))
    each = [
        [_side(pair, keys, f"{name}, sample {i}") for keys in sides] for i, pair in enumerate(found)
    ]
    robot, seen = np.swapaxes(np.array(each, float), 0, 1)
    inverted = easy and mount == "eye_to_hand"
    return (np.asarray(np.linalg.inv(robot)) if inverted else robot), seen, str(mount)


def _side(pair: Any, keys: Sequence[str], name: str) -> Floats:
    """One of a pair's transforms: 16 numbers, row by row, or a translation and a quaternion."""
    want(isinstance(pair, dict), name, pair, "two poses")
    value, name = next((pair[key] for key in keys if key in pair), None), f"{name}, {keys[0]}"
    if isinstance(value, list):
        matrix = numbers(value, name)
        want(len(matrix) == 16, name, f"{len(matrix)} numbers", "16, row by row")
        return transform(name, np.reshape(matrix, (4, 4)))
    want(isinstance(value, dict), name, sorted(pair), " or ".join(keys))
    flat = dict(value or {})
    for part, mark in (("translation", ""), ("rotation", "q")):
        inside = flat.get(part)
        inside = inside if isinstance(inside, dict) else {}
        flat |= {mark + key: one for key, one in inside.items()}
    return posed([one_number(flat.get(key), f"{name}, {key}") for key in (*PLACE, *TURN)], name)


def posed(values: Sequence[float], name: str) -> Floats:
    """The transform (4, 4) of x, y, z, m, and a unit quaternion qx, qy, qz, qw."""
    want(len(values) == 7, name, values, "x y z qx qy qz qw")
    length = float(np.linalg.norm(values[3:]))
    want(abs(length - 1) < UNIT_TOLERANCE, name, f"a quaternion of length {length:.4g}", "1")
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_quat(values[3:]).as_matrix(), values[:3]
    return T


# --- out ---


def described(T: Floats) -> dict[str, float]:
    """A transform (4, 4) by x, y, z (m), qx, qy, qz, qw and roll, pitch, yaw as URDF has them.

    R = Rz(yaw) Ry(pitch) Rx(roll), rad.
    """
    turn = Rotation.from_matrix(T[:3, :3])
    with warnings.catch_warnings():  # of roll and yaw about one axis: either does
        warnings.simplefilter("ignore", UserWarning)
        angles = turn.as_euler("xyz")
    values = (*T[:3, 3], *turn.as_quat(canonical=True), *angles)
    names = (*PLACE, *TURN, "roll", "pitch", "yaw")
    return {name: float(value) + 0.0 for name, value in zip(names, values, strict=True)}


def write_place(T: Floats, to: str, names: dict[str, str]) -> str:
    """The text by which a robot's software learns of T_parent_child (4, 4), m.

    to: one of `PLACE_FORMATS`. names: of parent and child; for easy_handeye2 of base and gripper
    and its calibration_type too.
    """
    return fill(to, described(T) | names)
