"""What is handed in, and the one file it travels in: FORMAT.md describes it, `bundle.schema.json`
says what its JSON may hold.

`bundle_bytes` packs a `Submission`; `read_bundle` makes one out of a file from a stranger, or says
with `Refused` why it does not. Nothing in a bundle is run or written to the disk, sizes are checked
before anything is unpacked, and all checks are in the reader: whatever is written is read back.
Lengths are in m, px and s unless a name says otherwise.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import os
import re
import tomllib
import unicodedata
import warnings
import zipfile
import zlib
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import fastjsonschema
import numpy as np

from coursekit.arrays import AnyArray, Floats, Interval, NDArray
from coursekit.checks import shown

VERSION = 2
READS = (1, 2)  # in 1 nobody said what became of mismatches
MAX_FILE = 5 * 2**20  # bytes
MAX_MEMBERS = 32
MAX_TOTAL = 6 * 2**20  # bytes, of all members together, unpacked
MAX_RATIO = 100  # of a member's size to what it takes up in the file
MAX_JSON = 2**17  # bytes of a JSON member; as much as the schema allows takes 90 kB
MAX_NESTED = 8  # levels of JSON; the format needs five
MAX_HEADER = 1024  # bytes, of an array
MAX_FRAMES = 2_000  # at one distance
MAX_SAMPLES = 1_000_000  # of one stack (600 frames of 40 x 40 px): it sets the grader's memory
MAX_ALL_SAMPLES = 2_000_000  # of all stacks (12 of 100 frames): it sets how long a bundle takes
LONGEST_SLUG = 40  # characters of a name that go into the name of a file
LATEST_S = 1e12  # of a time stamp, either side of 0

MANIFEST = "manifest.json"
NOBODY = "nobody"  # stands in for a name while there is none
DOCUMENTS = ("facts.json", "claims.json", "conclusion.json", "outcomes.json")
ALLOWED_BYTES = {
    re.compile(r"(manifest|facts|claims|conclusion|outcomes)\.json"): MAX_JSON,
    re.compile(r"depth_[0-9]{1,2}\.npy"): MAX_HEADER + 2 * MAX_SAMPLES,
    re.compile(r"times_[0-9]{1,2}\.npy"): MAX_HEADER + 8 * MAX_FRAMES,
}
WORDS = tomllib.loads(Path(__file__).with_name("words.toml").read_text(encoding="utf-8"))
SCHEMA = json.loads(Path(__file__).with_name("bundle.schema.json").read_text(encoding="utf-8"))

FIRST_DATE = (1980, 1, 1, 0, 0, 0)  # that a zip can say
SECRET_FLAGS = 0x2041  # of a zip's member: it is encrypted, or its header is
JUNK = ("Thumbs.db", "desktop.ini", "Icon\r")  # that a system leaves in a folder
TURNING_SIGNS = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"  # text runs backwards
NO_TEXT = ("Cc", "Cs", "Zl", "Zp")  # control characters, halves of others, line ends of Unicode


# --- what is handed in ----------------------------------------------------------------------------


@dataclass(frozen=True)
class CameraFacts:
    """The depth camera as it describes itself.

    source: "live", "recorded" or "simulated". width, height, fx, fy, cx, cy: of the depth image,
    px. model, coeffs (5): its distortion. baseline_m: None where a recording does not say.
    depth_scale_m: metres of a count.
    """

    name: str
    serial: str
    source: str
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    model: str
    coeffs: tuple[float, ...]
    baseline_m: float | None
    depth_scale_m: float


@dataclass(frozen=True, eq=False)
class Stack:
    """The raw measurement at one distance.

    distance_m: by tape. window: (left, top, width, height) px in the depth image, on the face.
    counts (N, height, width): uint16 depth counts, 0 invalid. times_s (N,): the camera's clock.
    """

    distance_m: float
    window: tuple[int, int, int, int]
    counts: NDArray[np.uint16]
    times_s: Floats


@dataclass(frozen=True)
class TableRow:
    """The student's own table at one distance; None is what was left out."""

    distance_m: float
    depth_bias_mm: float | None = None
    depth_bias_se_mm: float | None = None
    depth_std_mm: float | None = None
    depth_std_se_mm: float | None = None
    invalid_fraction: float | None = None


@dataclass(frozen=True)
class Claims:
    """The student's table and fit; None is what was left out.

    sigma_d_px: std of disparity with the exponent held at 2, and its 95 % interval (low, high).
    exponent: of a fit with the exponent free, and its 95 % interval. mismatches: what became in the
    student's table of samples that are far from all others of their pixel; None if it is not said.
    """

    rows: tuple[TableRow, ...] = ()
    sigma_d_px: float | None = None
    sigma_d_interval_px: Interval | None = None
    exponent: float | None = None
    exponent_interval: Interval | None = None
    mismatches: Literal["kept", "left out"] | None = None


@dataclass(frozen=True)
class Plot:
    """What the student's figure showed: std of depth in mm, one of each for every distance.

    predicted_mm: None where nothing was predicted.
    """

    distances_m: tuple[float, ...]
    measured_mm: tuple[float, ...]
    predicted_mm: tuple[float, ...] | None


@dataclass(frozen=True)
class Conclusion:
    """The closing paragraph, and what it says: which error dominates at the mounting distance.

    distance_m: where the camera will be mounted. frames: how many are averaged there.
    """

    distance_m: float | None = None
    frames: int = 1
    dominates: Literal["bias", "noise"] | None = None
    paragraph: str = ""


@dataclass(frozen=True)
class Outcome:
    """How a checkpoint or an exercise ended: right at last or not, after how many attempts."""

    right: bool
    attempts: int


@dataclass(frozen=True, eq=False)
class Submission:
    """All that one student hands in for one exercise; width is not part of it (FORMAT.md says why).

    made: UTC, as `results.now()` writes it. versions: of Python and packages, by name.
    tape_sigma_m: std of a tape reading, 0 where distances are exact. caliper_m: the block's width.
    stacks: at different distances. outcomes: by the name of the checkpoint or exercise, such as
    "depth_noise.width". What the fields may hold is checked when a bundle is packed or read.
    """

    student: str
    made: str
    versions: dict[str, str]
    camera: CameraFacts
    tape_sigma_m: float
    caliper_m: float
    stacks: tuple[Stack, ...]
    claims: Claims
    plot: Plot | None
    conclusion: Conclusion
    outcomes: dict[str, Outcome]
    exercise: str = "studio_1"


class Refused(ValueError):
    """A bundle that is not read. `reason`: a short code. The message: what is wrong, what to do."""

    def __init__(self, reason: str, wrong: str, cure: str) -> None:
        super().__init__(reason, wrong, cure)  # all of it, so that it survives pickling
        self.reason, self.wrong, self.cure = reason, wrong, cure

    def __str__(self) -> str:
        return f"{self.wrong}; {self.cure}."


def _refused(key: str, **facts: Any) -> Refused:
    """What words.toml says of a reason (before the dot), with the facts in its places."""
    wrong, cure = [*WORDS["refused"][key], "hand_in"][:2]
    return Refused(key.partition(".")[0], wrong.format(**facts), WORDS["cures"][cure])


# --- packing --------------------------------------------------------------------------------------


def bundle_bytes(submission: Submission) -> bytes:
    """The bundle as bytes: the same ones for the same submission, with the same version of zlib.

    It is read back, so that nobody hands in what cannot be read: Refused says what is wrong.
    """
    s = submission
    documents = {
        "facts.json": {
            "camera": asdict(s.camera),
            "tape_sigma_m": s.tape_sigma_m,
            "caliper_m": s.caliper_m,
            "stacks": [{"distance_m": k.distance_m, "window": k.window} for k in s.stacks],
            "versions": s.versions,
        },
        "claims.json": asdict(s.claims) | {"plot": None if s.plot is None else asdict(s.plot)},
        "conclusion.json": asdict(s.conclusion),
        "outcomes.json": {name: asdict(outcome) for name, outcome in s.outcomes.items()},
    }
    members = {name: _json_bytes(document) for name, document in documents.items()}
    for i, stack in enumerate(s.stacks):
        members[f"depth_{i}.npy"] = array_bytes(stack.counts)
        members[f"times_{i}.npy"] = array_bytes(stack.times_s)
    manifest = {
        "format": VERSION,
        "exercise": s.exercise,
        "student": s.student,
        "made": s.made,
        "members": {
            name: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            for name, content in members.items()
        },
    }
    data = zip_bytes({MANIFEST: _json_bytes(manifest)} | members)
    read_bundle(data)
    return data


def zip_bytes(members: dict[str, bytes]) -> bytes:
    """A zip of these members in this order, with fixed dates and nothing else in it.

    They are deflated, but stored where that would shrink them so much that they look like a bomb.
    """
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            info = zipfile.ZipInfo(name, FIRST_DATE)
            info.create_system = 3  # Unix, on every system
            info.external_attr = 0o100644 << 16
            plain = len(content) > MAX_RATIO / 2 * len(zlib.compress(content))
            archive.writestr(info, content, zipfile.ZIP_STORED if plain else zipfile.ZIP_DEFLATED)
    return buffer.getvalue()


def array_bytes(values: AnyArray) -> bytes:
    """An array as a .npy file of version 1.0; the same bytes whatever version NumPy has."""
    values = values.astype(values.dtype.newbyteorder("<"), copy=False)
    header = f"{{'descr': '{values.dtype.str}', 'fortran_order': False, 'shape': {values.shape}, }}"
    header = header.ljust(-(len(header) + 11) % 64 + len(header)) + "\n"  # values begin at 64 n
    start = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode("ascii")
    return start + values.tobytes()


def _json_bytes(content: Any) -> bytes:
    """JSON in UTF-8, NumPy's numbers as plain ones; what JSON cannot say is left to the reader."""

    def plain(value: Any) -> Any:
        return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else shown(value)

    text = json.dumps(content, indent=1, ensure_ascii=False, default=plain)
    return f"{text}\n".encode("utf-8", "surrogatepass")


def slug(text: str) -> str:
    """The letters and digits of a text with _ for what is between, for the name of a file.

    >>> slug("../../etc/passwd")
    'etc_passwd'
    """
    kept = "".join(sign if sign.isalnum() else " " for sign in text)
    return "_".join(kept.split())[:LONGEST_SLUG].strip("_") or "unnamed"


# --- reading --------------------------------------------------------------------------------------


def read_bundle(source: bytes | Path) -> Submission:
    """The submission in a bundle: the file's bytes, its path, or the folder it was unpacked into.
    Raises Refused, nothing else.

    First the zip is looked at, then the manifest with the sizes and hashes of all members, then
    each JSON member by the schema, then the arrays, and last how all of it fits together.

    >>> read_bundle(b"my homework")
    Traceback (most recent call last):
    coursekit.submission.format.Refused: The file is no zip, or cut off; copy or download it again.
    """
    if isinstance(source, Path) and os.path.isfile(source / MANIFEST):
        members = _unpacked(source)
    else:
        members = _unzipped(_bytes_of(source) if isinstance(source, Path) else source)
    manifest = _manifest(members)
    facts, claims, conclusion, outcomes = (_document(members, name) for name in DOCUMENTS)
    stacks = facts.pop("stacks")
    arrays = [f"{kind}_{i}.npy" for i in range(len(stacks)) for kind in ("depth", "times")]
    _want_names(members, (MANIFEST, *DOCUMENTS, *arrays), "the bundle's facts")
    plot = claims.pop("plot")
    facts["camera"] = CameraFacts(**facts["camera"])
    claims["rows"] = tuple(TableRow(**row) for row in claims["rows"])
    given = {name: manifest[name] for name in ("student", "exercise", "made")}
    submission = Submission(
        **given,
        **facts,
        claims=Claims(**claims),
        plot=None if plot is None else Plot(**plot),
        conclusion=Conclusion(**conclusion),
        outcomes={name: Outcome(**outcome) for name, outcome in outcomes.items()},
        stacks=tuple(_stack(members, i, **stack) for i, stack in enumerate(stacks)),
    )
    for fault in _faults(submission):
        raise _refused("bad_value", fault=fault)
    return submission


def _bytes_of(path: Path) -> bytes:
    """The bytes of a file, one more than allowed at most: then it is too large."""
    try:
        if path.is_symlink() or not path.is_file():  # opening a pipe would wait for ever
            raise _refused("not_a_file", file=shown(path.name))
        with path.open("rb") as file:
            return file.read(MAX_FILE + 1)
    except OSError as error:
        raise _refused("unreadable", file=shown(path.name), error=error.strerror) from error


def _unzipped(data: bytes, inner: bool = False) -> dict[str, bytes]:
    """The members of a zip by their names in it, of one folder, whoever zipped it.

    What macOS and Windows add is passed over; the manifest's hashes say whether the rest is whole.
    inner: it came out of one. A zip that holds nothing but a bundle is opened once more.
    """
    if len(data) > MAX_FILE:
        raise _refused("too_large.file", size=len(data), most=MAX_FILE)
    try:
        archive = zipfile.ZipFile(io.BytesIO(data))
    except Exception:  # a stranger's bytes: the parser may trip over anything
        raise _refused("not_a_zip") from None
    every = [m for m in archive.infolist() if not is_junk(m.orig_filename)]
    members = {m.orig_filename: m for m in every if not m.orig_filename.endswith("/")}
    if len(members) == 1 and next(iter(members)).lower().endswith(".zip") and not inner:
        (bundle,) = members.values()
        if bundle.file_size <= min(MAX_FILE, MAX_RATIO * bundle.compress_size):
            return _unzipped(_content(archive, bundle), inner=True)
    if len(members) > MAX_MEMBERS or sum(m.file_size for m in every) > MAX_TOTAL:
        raise _refused("too_large.unpacked", most=MAX_TOTAL, members=MAX_MEMBERS)
    if len({m.orig_filename for m in every}) < len(every):
        raise _refused("not_plain.twice")
    parts = {name: name.rpartition("/") for name in members}
    folder = next((at for at, _, name in parts.values() if name == MANIFEST), "")
    found = {}
    for name, (at, _, last) in parts.items():
        _check_member(members[name], last if at == folder else f"{at}/{last}")
        found[last] = _content(archive, members[name])
    return found


def is_junk(name: str) -> bool:
    """Whether a system or a spreadsheet leaves such a file or folder anywhere; name: its path."""
    parts = name.split("/")
    return "__MACOSX" in parts or parts[-1].startswith((".", "~$")) or parts[-1] in JUNK


def _unpacked(folder: Path) -> dict[str, bytes]:
    """The members of a bundle that somebody unpacked into a folder."""
    names = [path.name for path in folder.iterdir() if path.name in (MANIFEST, *DOCUMENTS)]
    names += [f"{kind}_{i}.npy" for i in range(MAX_MEMBERS) for kind in ("depth", "times")]
    return {name: _bytes_of(folder / name) for name in names if (folder / name).exists()}


def _check_member(member: zipfile.ZipInfo, name: str) -> None:
    """A member has a name of the format and is a plain file within the caps, as it is declared."""
    most = next((most for pattern, most in ALLOWED_BYTES.items() if pattern.fullmatch(name)), None)
    if most is None:
        raise _refused("unknown_member", name=shown(name))
    link = member.external_attr >> 28 not in (0, 8)  # as Unix writes it: 8 is a plain file
    known = member.compress_type in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
    if member.flag_bits & SECRET_FLAGS or not known or link:
        raise _refused("not_plain.member", name=name)
    packed = member.compress_size
    if member.file_size > min(most, MAX_RATIO * packed) or packed > MAX_FILE:
        facts = {"name": name, "size": member.file_size, "most": most, "ratio": MAX_RATIO}
        raise _refused("too_large.member", **facts)


def _content(archive: zipfile.ZipFile, member: zipfile.ZipInfo) -> bytes:
    """What a member holds; no more is unpacked than it declares, however much is there."""
    try:
        with archive.open(member) as file:
            content = file.read(member.file_size + 1)
    except Exception:  # a stranger's bytes: the parser may trip over anything
        content = None
    if content is None or len(content) != member.file_size:
        raise _refused("damaged", name=member.filename)
    return content


def _manifest(members: dict[str, bytes]) -> dict[str, Any]:
    """What manifest.json says, if all that it lists is there and has its size and its hash."""
    manifest = _document(members, MANIFEST)
    listed = manifest["members"]
    _want_names(members, (MANIFEST, *listed), "the bundle's manifest")
    for name, entry in listed.items():
        content = members[name]
        if entry["bytes"] != len(content) or entry["sha256"] != hashlib.sha256(content).hexdigest():
            raise _refused("wrong_hash", name=name)
    return manifest


def _want_names(members: Iterable[str], wanted: Iterable[str], by: str) -> None:
    """Refused unless these names, and no others, are in the bundle; by: where they are listed."""
    for name in sorted({*wanted} ^ {*members}):
        if name in members:
            raise _refused("unlisted_member", name=name, by=by)
        raise _refused("missing_member", name=shown(name))


def _document(members: dict[str, bytes], name: str) -> dict[str, Any]:
    """A JSON member that is as the schema wants it, with tuples for lists."""
    if name not in members:
        raise _refused("missing_member", name=name)
    try:
        text = members[name].decode("utf-8")
        # NaN becomes what is no value of JSON, so that the schema says where it stands
        read = json.loads(text, object_pairs_hook=_without_doubles, parse_constant=str.encode)
        document = _with_tuples(read, MAX_NESTED)
    except (ValueError, RecursionError) as error:  # also an integer of thousands of digits
        raise _refused("not_json", name=name, error=error) from None
    if name == MANIFEST and isinstance(document, dict) and document.get("format") not in READS:
        raise _refused("other_format", got=shown(document.get("format")), reads=READS)
    try:
        check_schema({name: document})
    except fastjsonschema.JsonSchemaValueException as fault:
        raise _refused("bad_value", fault=f"{_fault_text(name, fault)} ({name})") from None
    return document


def _without_doubles(items: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON. Raises ValueError where a key is there twice."""
    found = dict(items)
    if len(found) < len(items):
        raise ValueError("the same key is there twice")
    return found


def _with_tuples(value: Any, levels: int) -> Any:
    """JSON with tuples for lists. Raises ValueError where it is nested deeper than so."""
    if isinstance(value, (dict, list)) and not levels:
        raise ValueError(f"it is nested deeper than {MAX_NESTED}")
    if isinstance(value, dict):
        return {key: _with_tuples(inner, levels - 1) for key, inner in value.items()}
    if isinstance(value, list):
        return tuple(_with_tuples(inner, levels - 1) for inner in value)
    return value


def _fault_text(name: str, fault: fastjsonschema.JsonSchemaValueException) -> str:
    """ "distance_m: got 0.001, want a number from 0.01 to 100", from what the schema found."""
    where = str(fault.name).removeprefix(f"data.{name}").lstrip(".")
    got, wanted = fault.value, fault.rule
    if not re.fullmatch(r"[\w.\[\]]{0,80}", where):
        where = shown(where)
    start = f"{where}: " if where else ""
    if wanted == "required":
        return f"{start}lacks {next(key for key in fault.rule_definition if key not in got)}"
    if wanted == "additionalProperties":
        unknown = next(key for key in got if key not in fault.definition["properties"])
        return f"{start}has the unknown key {shown(unknown)}"
    if wanted == "propertyNames":
        wanted = fault.definition[wanted]["description"]
        return f"{start}has a name that cannot be, want {wanted}"
    if wanted == "maximum" and where.endswith("distance_m") and got <= 100_000:
        return f"{start}got {shown(got)}; metres are wanted: did you mean {got / 1000:g}?"
    if isinstance(got, bytes):  # NaN, see `_document`
        return f"{start}got {got.decode()}, want {fault.definition['description']}"
    got = f"{len(got)} characters" if wanted == "maxLength" else shown(got)
    return f"{start}got {got}, want {fault.definition['description']}"


def _stack(members: dict[str, bytes], i: int, distance_m: float, window: Any) -> Stack:
    """Distance i, its arrays as read-only views of the members."""
    counts = _array(f"depth_{i}.npy", members[f"depth_{i}.npy"], "<u2", 3)
    times = _array(f"times_{i}.npy", members[f"times_{i}.npy"], "<f8", 1)
    wanted = (len(times), window[3], window[2])
    if counts.shape != wanted or counts.size > MAX_SAMPLES or len(times) > MAX_FRAMES:
        facts = {"i": i, "shape": counts.shape, "frames": MAX_FRAMES, "most": MAX_SAMPLES}
        raise _refused("bad_array.size", wanted=wanted, **facts)
    return Stack(distance_m, window, counts, times)


def _array(name: str, content: bytes, dtype: str, rank: int) -> AnyArray:
    """A NumPy array file (.npy, version 1.0) of this little-endian type, C order, and rank."""
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        with warnings.catch_warnings(action="error"):  # of a header as Python 2 wrote it
            found = np.lib.format.read_array_header_1_0(file, max_header_size=MAX_HEADER)
    except Exception:  # a stranger's bytes: the parser may trip over anything
        raise _refused("bad_array", name=name) from None
    shape, fortran, kind = found
    if version != (1, 0) or fortran or kind != np.dtype(dtype) or len(shape) != rank:
        order = ", in Fortran order" if fortran else ""
        facts = {"kind": shown(kind.str), "shape": shown(shape), "order": order}
        raise _refused("bad_array.kind", name=name, rank=rank, dtype=dtype, **facts)
    if min(shape) < 1 or math.prod(shape) * kind.itemsize != len(content) - file.tell():
        raise _refused("bad_array.length", name=name, shape=shown(shape))
    values = np.frombuffer(content, kind, offset=file.tell()).reshape(shape)
    return values.astype(kind.newbyteorder("="), copy=False)


def _faults(submission: Submission) -> Iterable[str]:
    """What the schema cannot say: how the values of a submission belong together."""
    camera, claims, plot = submission.camera, submission.claims, submission.plot
    for name, several in (("stacks", submission.stacks), ("rows", claims.rows)):
        distances = [one.distance_m for one in several]
        if len(set(distances)) < len(distances):
            yield f"{name}: a distance is there twice, want different distances"
    if sum(stack.counts.size for stack in submission.stacks) > MAX_ALL_SAMPLES:
        yield f"stacks: want {MAX_ALL_SAMPLES} values at most"
    for stack in submission.stacks:
        left, top, width, height = stack.window
        if left + width > camera.width or top + height > camera.height:
            image = f"{camera.width}x{camera.height} px"
            yield f"window: got {stack.window}, want a window inside the image of {image}"
        if not (np.abs(stack.times_s) <= LATEST_S).all():  # also NaN
            yield "times_s: want finite numbers of seconds"
    for name in ("sigma_d_interval_px", "exponent_interval"):
        ends = getattr(claims, name)
        if ends is not None and ends[0] > ends[1]:
            yield f"{name}: got {ends}, want (low, high)"
    if plot is not None:
        n, predicted = len(plot.distances_m), plot.predicted_mm
        if len(plot.measured_mm) != n or (predicted is not None and len(predicted) != n):
            yield f"plot: want as many measured and predicted values as distances, {n}"


# --- the schema, and what text and moments are in it ----------------------------------------------


def _is_line(text: str, besides: str = "") -> bool:
    """Text that any file and page can hold, and that looks like what it is."""
    return all(
        sign in besides or (unicodedata.category(sign) not in NO_TEXT and sign not in TURNING_SIGNS)
        for sign in text
    )


def _is_moment(text: str) -> bool:
    """UTC to the second in exactly the one form, and not before the year 2000."""
    try:
        moment = datetime.fromisoformat(text)
    except ValueError:
        return False
    return f"{moment:%Y-%m-%dT%H:%M:%S}+00:00" == text and moment.year >= 2000


check_schema = fastjsonschema.compile(
    SCHEMA,
    formats={
        "line": _is_line,
        "text": lambda text: _is_line(text, "\n\t"),
        "name": lambda text: _is_line(text) and any(map(str.isalnum, text)),
        "moment": _is_moment,
    },
)
