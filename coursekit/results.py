"""The hand-over between notebooks, and to a robot: one JSON file a notebook in `results/`.

Every number carries its unit, its standard deviation, whether it is a bias or noise, and where it
came from, so that the error budget can say whose numbers it uses. A lens and a camera's place go
along whole, and `export` writes them as other programs read them.
"""

from __future__ import annotations

import contextlib
import json
import os
import platform
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from coursekit import checks
from coursekit.arrays import ArrayLike, Floats
from coursekit.checks import refuse, want
from coursekit.formats import lens as lens_files
from coursekit.formats import numbers
from coursekit.formats import poses as pose_files
from coursekit.geometry import Intrinsics, cross_matrix, invert_transform
from coursekit.words import say, wrapped

ROOT = Path(__file__).resolve().parent.parent
EXPORTS = tuple(dict.fromkeys((*lens_files.LENS_FORMATS, *pose_files.PLACE_FORMATS)))
FORMAT = 2  # 1 had neither lens nor placement
OPTICAL = "camera_color_optical_frame"  # as realsense-ros calls it: x right, y down, z forward
PARENTS = {"eye_in_hand": "ee_gripper_link", "eye_to_hand": "base_link"}
BASE, GRIPPER = "base_link", "ee_gripper_link"
# The turn from a camera's link (x forward, y left, z up) to its optical frame, as ROS has it
OPTICAL_TURN = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
Source = Literal["live", "recorded", "simulated", "reference"]
ErrorKind = Literal["bias", "noise"]


@dataclass(frozen=True)
class Origin:
    """What stands in for a camera where one took the images that is none of ours: photographs.

    color: what it reports of its own lens, nothing.

    >>> Origin("photographs in my_photos").source
    'recorded'
    """

    name: str
    source: Source = "recorded"
    color: None = None


@dataclass(frozen=True)
class Quantity:
    """A number with its unit.

    sigma: one standard deviation in the same unit, None where nobody has measured it (then `note`
    says so). kind: "bias" for what repeats, "noise" for what averages down, None for neither.
    Raises ValueError for numbers that are not finite, a negative sigma and a missing unit.

    >>> Quantity(612.4, "px", 0.9, "bias", "from 28 views").sigma
    0.9
    """

    value: float
    unit: str
    sigma: float | None = None
    kind: ErrorKind | None = None
    note: str = ""

    def __post_init__(self) -> None:
        checks.number("value", self.value)
        if self.sigma is not None:
            checks.number("sigma", self.sigma, "a standard deviation >= 0", least=0.0)
        checks.choice("kind", self.kind, (None, *get_args(ErrorKind)))
        want(self.unit, "unit", self.unit, "for example 'px', 'mm' or '1'")
        for name in ("unit", "note"):
            checks.instance(name, getattr(self, name), str)


@dataclass(frozen=True)
class Covariance:
    """The covariance of several numbers that were estimated together.

    names (n): which numbers; matrix (n, n): in the product of their units, symmetric, none of its
    eigenvalues negative. A NumPy array is taken and kept as tuples. Raises ValueError for what is
    no covariance of so many numbers.

    >>> Covariance(("fx", "k1"), [[0.81, 4e-4], [4e-4, 1e-6]]).names
    ('fx', 'k1')
    """

    names: tuple[str, ...]
    matrix: tuple[tuple[float, ...], ...]

    def __post_init__(self) -> None:
        names = tuple(checks.instance("names", name, str) for name in self.names)
        matrix = checks.covariance("matrix", self.matrix, len(names))
        checks.settle(self, names=names, matrix=tuple(map(tuple, matrix.tolist())))


@dataclass(frozen=True, eq=False)
class Placement:
    """Where a camera is: T (4, 4) takes coordinates in `child` to coordinates in `parent`, m.

    mount: "eye_in_hand" or "eye_to_hand". covariance (6, 6): of a small turn about the axes of
    `parent` (rad) and a shift along them (m), (rx, ry, rz, tx, ty, tz); None where nobody knows.
    verdict: how good it is, in a sentence that goes along wherever the place goes.
    """

    parent: str
    child: str
    mount: str
    T: Floats
    covariance: Floats | None = None
    verdict: str = ""

    def __post_init__(self) -> None:
        checks.choice("mount", self.mount, PARENTS)
        checks.instance("verdict", self.verdict, str)
        checks.settle(self, T=checks.transform("T", self.T))
        if self.covariance is not None:
            checks.settle(self, covariance=checks.covariance("covariance", self.covariance, 6))

    def to_dict(self) -> dict[str, Any]:
        """As JSON has it, with the quaternion (x, y, z, w) beside the matrix."""
        q = pose_files.described(self.T)
        known = None if self.covariance is None else self.covariance.tolist()
        frames = {"parent": self.parent, "child": self.child, "mount": self.mount}
        named = {"translation_m": pose_files.PLACE, "quaternion_xyzw": pose_files.TURN}
        named |= {"rpy_rad": ("roll", "pitch", "yaw")}
        place = {key: [q[name] for name in names] for key, names in named.items()}
        matrices = {"T": self.T.tolist(), **place, "covariance_rad_m": known}
        return frames | matrices | {"verdict": self.verdict}

    @classmethod
    def from_dict(cls, content: dict[str, Any]) -> Placement:
        """Of `to_dict`; the matrix counts, what else says the same is for other readers."""
        c = content
        verdict = c.get("verdict", "")  # files of before have none
        return cls(c["parent"], c["child"], c["mount"], c["T"], c["covariance_rad_m"], verdict)

    def of_link(self, link: str, T_link_optical: ArrayLike) -> Placement:
        """Where the link is that a driver hangs the optical frame on: T inv(T_link_optical)."""
        T = self.T @ invert_transform(T_link_optical)
        known, moved = self.covariance, np.eye(6)
        moved[3:, :3] = -cross_matrix(T[:3, 3] - self.T[:3, 3])  # a turn of the camera moves it
        known = None if known is None else moved @ known @ moved.T
        return replace(self, child=link, T=T, covariance=known)


@dataclass(frozen=True)
class Result:
    """What one notebook found: quantities by name, and the camera and day they come from.

    covariances: of those quantities that were estimated together, by a name for the group. lens,
    placement: the camera's K, size and distortion, and where it is, if the notebook found these.
    eye_to_hand: where a second camera is, that of notebook 04's rig which does not move.
    """

    lesson: str
    source: Source
    camera: str
    date: str
    versions: dict[str, str]
    quantities: dict[str, Quantity]
    covariances: dict[str, Covariance] = field(default_factory=dict)
    serial: str = ""
    lens: Intrinsics | None = None
    placement: Placement | None = None
    eye_to_hand: Placement | None = None


def folder() -> Path:
    """Where the hand-over files are: COURSEKIT_RESULTS, else `results/` of the course.

    Where the package was installed without the course: of the folder that one works in.
    """
    course = ROOT if (ROOT / "course.py").is_file() else Path.cwd()
    return Path(os.environ.get("COURSEKIT_RESULTS") or course / "results")


def save(
    lesson: str,
    camera: Any,
    quantities: Mapping[str, Quantity],
    covariances: Mapping[str, Covariance] | None = None,
    lens: Intrinsics | None = None,
    placement: Placement | None = None,
    eye_to_hand: Placement | None = None,
) -> Path:
    """Write `results/<lesson>.json` in one step (a reader sees the old file or the new one).

    camera: what measured, or an `Origin` or hand-over in its place: its name and source are kept.
    covariances: of those quantities that were estimated together, by a name for the group. lens,
    placement, eye_to_hand: as in `Result`; the camera's serial number goes along where it has one.
    Returns the path. Raises ValueError for what is no quantity and no covariance, and for a
    covariance of something that is not among the quantities.
    """
    covariances = covariances or {}
    for name, quantity in quantities.items():
        checks.instance(f"quantities[{name!r}]", quantity, Quantity)
    for group, covariance in covariances.items():
        argument = f"covariances[{group!r}]"
        for name in checks.instance(argument, covariance, Covariance).names:
            want(name in quantities, argument, name, "the name of a quantity")
    made = (lesson, camera.source, camera.name, now(), versions())
    result = Result(*made, dict(quantities), dict(covariances), getattr(camera, "serial", ""))
    parts = {"lens": lens, "placement": placement, "eye_to_hand": eye_to_hand}
    whole = {name: part and part.to_dict() for name, part in parts.items()}
    path = _path(lesson)
    write_json(path, {"format": FORMAT} | asdict(result) | whole)
    return path


def load(lesson: str) -> Result:
    """Read `results/<lesson>.json`; FileNotFoundError if there is none, ValueError if damaged."""
    try:
        return read(_path(lesson))
    except FileNotFoundError as error:
        raise FileNotFoundError(f"notebook {lesson} has kept nothing: run it to its end") from error
    except ValueError as error:
        raise ValueError(f"{error}. Run notebook {lesson} again.") from error


def read(path: Path) -> Result:
    """A result in another folder; ValueError that names the file where it is damaged."""
    content = read_json(path)
    try:
        refuse(content.pop("format") not in (1, FORMAT), "written by another version of the course")
        quantities = {k: Quantity(**v) for k, v in content.pop("quantities").items()}
        covariances = {k: Covariance(**v) for k, v in content.pop("covariances", {}).items()}
        checks.choice("source", content["source"], get_args(Source))
        for name in ("lesson", "camera", "date"):
            checks.instance(name, content[name], str)
        lens = content.pop("lens", None)
        content["lens"] = lens and Intrinsics.from_dict(lens)
        for name in ("placement", "eye_to_hand"):
            placed = content.pop(name, None)
            content[name] = placed and Placement.from_dict(placed)
        return Result(**content, quantities=quantities, covariances=covariances)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{path.name}: {error}") from error


# --- to other programs ---

# How a verdict stands in a file; JSON of our own has a field for it, Open3D's has no place
HASHED = ("ros", "opencv", "kalibr", "colmap", "tf2", "moveit", "easy_handeye2")
COMMENTS = dict.fromkeys(HASHED, "# {0}\n") | {"opencv_json": ' "verdict": {1},\n'}
COMMENTS |= dict.fromkeys(("urdf", "opencv_xml"), "<!-- {0} -->\n")
GRADES = "Good|Usable with care|Not good enough"  # with which the verdict on a lens begins
VERDICT = re.compile(rf'(?m)^(?:# |<!-- | *"verdict": ")((?:{GRADES}): .+?)(?: -->|",?)?\r?$')


@dataclass(frozen=True)
class Exported:
    """What `export` wrote: the text of the file, where it is, and what the format made of it."""

    text: str
    path: Path | None
    notes: tuple[str, ...]

    def __repr__(self) -> str:
        where = [f"Wrote {self.path.name}." if self.path else self.text.rstrip()]
        return "\n".join([*where, *(wrapped(note, first="- ") for note in self.notes)])


def export(
    what: Any,
    to: str,
    out: str | os.PathLike[str] | None = None,
    *,
    parent: str | None = None,
    optical: str = OPTICAL,
    link: str | None = None,
    T_link_optical: ArrayLike | str | None = None,
    overwrite: bool = False,
) -> Exported:
    """Write a lens or a camera's place as another program reads it.

    what: "03_intrinsics", "04_hand_eye" or the path of such a result; a lens file of any format;
    or what calibrated it: `Intrinsics`, a result of `intrinsics.calibrate` or `hand_eye.solve`.
    to: for a lens "ros", "opencv" (XML or JSON where `out` ends so), "kalibr", "colmap", "open3d",
    "json"; for a place "tf2", "urdf", "moveit", "easy_handeye2", "json". out: the file, or None.

    A place is that of the optical frame in `parent` (the gripper, or the base where the camera does
    not move). A driver that publishes link -> optical already needs parent -> link instead, as a
    frame has one parent only: name the `link` and give T_link_optical, (4, 4) in m, "turn" where
    both have one origin, or "x y z qx qy qz qw" as tf2_echo says it.

    What the result's `verdict` begins with is said, as is a parent that nobody named, and both
    stand in the file where it may hold a comment; in JSON, but Open3D's, the verdict does. That of
    a lens file goes on into the next; `Intrinsics` and notebook 3's result have none. Raises
    ValueError for what a format cannot hold, FileExistsError for a file that is there.
    """
    found, verdict = _exportable(what)
    form, unsaid = to, ""
    if isinstance(found, Intrinsics):
        checks.choice("to (of a lens)", to, lens_files.LENS_FORMATS)
        suffix = Path(out or "").suffix.lower().replace(".", "_")
        form = f"opencv{suffix}" if to == "opencv" and suffix in ("_xml", "_json") else to
        text, notes = _lens_text(found, form, verdict)
    else:
        checks.choice("to (of a camera's place)", to, (*pose_files.PLACE_FORMATS, "json"))
        placed = replace(found, parent=parent or found.parent, child=optical)
        text, notes = _place_text(placed, to, link, T_link_optical)
        unsaid = "" if parent else say("others.unsaid_parent", parent=found.parent)
    at = text.index("\n") + 1 if form.startswith("opencv") else 0  # its first line stays the first
    for one in filter(None, (unsaid, verdict)):
        line = one.replace("--", "-"), json.dumps(one, ensure_ascii=False)
        text = text[:at] + COMMENTS.get(form, "").format(*line) + text[at:]
    notes = tuple(note for note in (verdict, *notes, unsaid) if note)
    path = None if out is None else Path(out)
    if path is not None:
        if path.exists() and not overwrite:
            raise FileExistsError(f"{path} is there already; overwrite=True replaces it")
        write_bytes(path, text.encode())
    return Exported(text, path, notes)


def placement(result: Any) -> Placement:
    """The camera's place as `hand_eye.solve` found it, with the usual names of the two frames."""
    told = result.refined is not None and bool(np.isfinite(result.covariance).all())
    known = result.covariance[:6, :6] if told else None
    parent, verdict = PARENTS[result.mount], _verdict(result)
    return Placement(parent, OPTICAL, result.mount, result.X, known, verdict)


def _verdict(result: Any) -> str:
    """The first sentence of the verdict on a result, in one line; "" for what has none."""
    verdict = getattr(result, "verdict", None)
    return re.split(r"(?<=\.) ", " ".join(verdict().split()))[0] if callable(verdict) else ""


def _exportable(what: Any) -> tuple[Intrinsics | Placement, str]:
    """The lens or the place in a result, in a file or in what a notebook calls it; its verdict."""
    if isinstance(what, Intrinsics):
        return what, ""
    if isinstance(what, Placement):
        return what, what.verdict
    if hasattr(what, "X") and hasattr(what, "mount"):
        return _exportable(placement(what))
    if hasattr(what, "intrinsics"):
        return checks.instance("what", what.intrinsics, Intrinsics), _verdict(what)
    want(isinstance(what, (str, os.PathLike)), "what", what, "a result, or the path of a file")
    path = Path(what) if Path(what).exists() else folder() / f"{what}.json"
    want(path.is_file(), "what", os.fspath(what), say("others.no_result", folder=folder().name))
    try:
        result = read(path)
    except ValueError:  # no result of a notebook: a lens, whose reader says what else it is
        said = VERDICT.search(lens_files.read_text(path, lens_files.WANTED))
        return Intrinsics.from_file(path), said[1] if said else ""
    if not (whole := result.lens or result.placement):
        raise ValueError(say("others.nothing_kept", file=path.name))
    return _exportable(whole)


def _lens_text(given: Intrinsics, to: str, verdict: str) -> tuple[str, tuple[str, ...]]:
    """The text, and what became of the lens on the way."""
    notes = []
    fitted = given if to == "json" else given.as_brown_conrady(k3=to != "kalibr")
    if fitted != given:
        off = given.largest_difference_px(fitted)
        lost = "the inverse model" if to != "kalibr" else "k3, for which Kalibr has no place"
        notes.append(f"fitted again without {lost}: in the image off by {off:.4f} px at most")
    if to == "colmap":
        notes.append("COLMAP counts from the first pixel's corner: cx and cy are 0.5 px larger")
    fields = fitted.to_dict() | ({"verdict": verdict} if verdict else {})
    return lens_files.write_lens(fields, to), tuple(notes)


def _place_text(
    placed: Placement, to: str, link: str | None, T_link_optical: ArrayLike | str | None
) -> tuple[str, tuple[str, ...]]:
    """The text, and which frame it is of."""
    optical = placed.child
    notes = [f"of {optical}: if a driver publishes its place in a link, name the link instead"]
    want(link or T_link_optical is None, "link", link, "the frame that T_link_optical is in")
    if link is not None:
        if T_link_optical is None:
            raise ValueError(say("others.no_link", optical=optical, link=link))
        T = T_link_optical
        if isinstance(T, str) and T == "turn":
            T = OPTICAL_TURN
        elif isinstance(T, str):
            T = pose_files.posed(numbers(T.split(), "T_link_optical"), "T_link_optical")
        placed = placed.of_link(link, checks.transform("T_link_optical", T))
        notes = [f"of {link}, which carries {optical}: X inv(T_link_optical)"]
    if to == "json":
        return json.dumps(placed.to_dict(), indent=1, allow_nan=False) + "\n", tuple(notes)
    in_hand = placed.mount == "eye_in_hand"
    base, gripper = (BASE, placed.parent) if in_hand else (placed.parent, GRIPPER)
    names = {"parent": placed.parent, "child": placed.child, "base": base, "gripper": gripper}
    kind = {"calibration_type": "eye_in_hand" if in_hand else "eye_on_base"}
    return pose_files.write_place(placed.T, to, names | kind), tuple(notes)


# --- files ---


def write_json(path: Path, content: Any) -> None:
    """Write JSON to a file beside `path`, then rename it: never half a file."""
    write_bytes(path, (json.dumps(content, indent=1, allow_nan=False) + "\n").encode())


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file beside `path`, then rename it: never half a file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        part.write_bytes(content)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextlib.contextmanager
def locked(path: Path, wait: bool = True) -> Iterator[None]:
    """Held by one writer at a time; the system frees the lock when its holder ends, however.

    wait: for another holder, on Windows up to ten seconds; OSError where it holds on.
    """
    with path.open("a+b") as file:
        if sys.platform == "win32":
            import msvcrt

            file.seek(0)
            msvcrt.locking(file.fileno(), msvcrt.LK_LOCK if wait else msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield  # closing the file unlocks it


def read_json(path: Path) -> Any:
    """The object in a JSON file; ValueError naming the file when it is damaged."""
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # also not UTF-8
        raise ValueError(f"{path.name}: not a JSON file ({error})") from error
    if not isinstance(content, dict):
        raise ValueError(f"{path.name}: got a {type(content).__name__}, want an object")
    return content


def now() -> str:
    """The time, UTC, as ISO 8601 to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


def _path(lesson: str) -> Path:
    want(lesson.replace("_", "").isalnum(), "lesson", lesson, "a name like '01_pinhole'")
    return folder() / f"{lesson}.json"


def versions() -> dict[str, str]:
    """Of Python, of this package and of those whose version a result may depend on."""
    found = {"python": platform.python_version()}
    for name in ("coursekit", "numpy", "opencv-python-headless", "pyrealsense2"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            found[name] = "not installed"
    return found
