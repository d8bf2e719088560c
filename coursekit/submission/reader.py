"""A bundle from a stranger, read: a `Submission`, or `Refused` with a reason, nothing else.

FORMAT.md describes the format. No code in a bundle is run and no file of it is written; sizes are
checked before memory is taken, and everything that can be said about a bundle is said here, so that
what comes after can trust it.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
from dataclasses import fields
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from coursekit.submission.archive import MAX_FILE, Archive, Refused
from coursekit.submission.contents import (
    MAX_ALL_SAMPLES,
    MAX_ENTRIES,
    MAX_FRAMES,
    MAX_SAMPLES,
    MAX_STACKS,
    CameraFacts,
    Claims,
    Conclusion,
    Outcome,
    Plot,
    Row,
    Stack,
    Submission,
    shown,
)

__all__ = ["FORMAT", "Refused", "read_bundle"]

FORMAT = 1
MAX_JSON = 2**17  # bytes; as much as contents.py allows takes 90 kB
MAX_DEPTH = 8  # of nested JSON; the format needs four
MAX_DIGITS = 40  # of a number; no double needs more than 25 characters
MAX_HEADER = 1024  # bytes, of an array

_T = TypeVar("_T")
_ALLOWED = {
    re.compile(r"(manifest|facts|claims|conclusion|outcomes)\.json"): MAX_JSON,
    re.compile(r"depth_[0-9]{1,2}\.npy"): MAX_HEADER + 2 * MAX_SAMPLES,
    re.compile(r"times_[0-9]{1,2}\.npy"): MAX_HEADER + 8 * MAX_FRAMES,
}
_STRING = re.compile(rb'"(?:[^"\\]++|\\.)*+(?:"|\\?\Z)', re.DOTALL)  # possessive: linear in time
_SQUARE = bytes.maketrans(b"{}", b"[]")
_NO_BRACKETS = bytes(set(range(256)) - set(b"[]{}"))
_HEADER = re.compile(
    r"\{ ?'descr': ?(?P<descr>'[^']*'|\[.*\]), ?'fortran_order': ?(?P<fortran>True|False), ?"
    r"'shape': ?\((?P<shape>[0-9L, ]*)\),? ?\} *\n?"
)
_DIMENSION = re.compile(r"([0-9]{1,12})L?")


def read_bundle(source: bytes | Path) -> Submission:
    """The submission in a bundle: the file's bytes, or its path. Raises Refused, nothing else."""
    archive = Archive(_bytes_of(source) if isinstance(source, Path) else source, _ALLOWED)
    manifest = _manifest(archive)
    members = _Members(archive, manifest["members"])
    facts = _object(members, "facts.json", "camera tape_sigma_m caliper_m stacks versions")
    claims, plot = _claims(members)
    conclusion = _object(members, "conclusion.json", _names(Conclusion))
    outcomes = _json(members.read("outcomes.json"), "outcomes.json")
    _want_dictionary(outcomes, "outcomes.json")
    return _make(
        Submission,
        "The bundle",
        student=manifest["student"],
        exercise=manifest["exercise"],
        made=manifest["made"],
        versions=facts["versions"],
        camera=_build(CameraFacts, facts["camera"], "facts.json, camera"),
        tape_sigma_m=facts["tape_sigma_m"],
        caliper_m=facts["caliper_m"],
        claims=claims,
        plot=plot,
        conclusion=_make(Conclusion, "conclusion.json", **conclusion),
        outcomes=_outcomes(outcomes),
        stacks=_stacks(members, facts["stacks"]),  # last: it is most of the work
    )


def _bytes_of(path: Path) -> bytes:
    """The bytes of a file, one more than allowed at most: then it is too large."""
    try:
        if not path.is_file():  # opening a pipe would wait for ever
            raise Refused("not_a_file", f"{shown(path.name)} is not there, or no plain file")
        with path.open("rb") as file:
            return file.read(MAX_FILE + 1)
    except OSError as error:
        raise Refused(
            "unreadable", f"{shown(path.name)} cannot be read ({error.strerror})"
        ) from error


class _Members:
    """The members that the manifest lists, each read only if its size and its hash are right."""

    def __init__(self, archive: Archive, listed: Any) -> None:
        _want_dictionary(listed, "manifest.json, members")
        for name in listed:
            if name not in archive.members:
                raise Refused("missing_member", f"{shown(name)} is missing from the bundle")
        for name in archive.members:
            if name != "manifest.json" and name not in listed:
                raise Refused("unlisted_member", f"{name} is not in the bundle's manifest")
        self._archive, self._listed = archive, listed
        self.names = set(listed)

    def size(self, names: set[str]) -> int:
        """Bytes of these members together, as declared."""
        return sum(self._archive.members[name].size for name in names)

    def read(self, name: str) -> bytes:
        """The content of a member that is what its manifest says."""
        content = self._archive.read(name)
        entry = self._listed[name]
        _want_keys(entry, "bytes sha256", f"manifest.json, {name}")
        if entry["bytes"] != len(content) or entry["sha256"] != hashlib.sha256(content).hexdigest():
            raise Refused(
                "wrong_hash",
                f"{name} does not match its own manifest: it was changed after it was packed",
            )
        return content


def _manifest(archive: Archive) -> dict[str, Any]:
    """What manifest.json says; its format is looked at first, as the rest depends on it."""
    manifest = _json(archive.read("manifest.json"), "manifest.json")
    _want_dictionary(manifest, "manifest.json")
    if manifest.get("format") != FORMAT or isinstance(manifest["format"], bool):
        got = shown(manifest.get("format"))
        raise Refused(
            "other_format",
            f"The bundle has format {got}, this grader reads {FORMAT}",
            "update the course where you pack or where you grade, whichever is older",
        )
    _want_keys(manifest, "format exercise student made members", "manifest.json")
    return manifest


def _claims(members: _Members) -> tuple[Claims, Plot | None]:
    where = "claims.json"
    claims = _object(members, where, f"{_names(Claims)} plot")
    plot, rows = claims.pop("plot"), claims.pop("rows")
    rows = [_build(Row, row, f"{where}, rows") for row in _list(rows, f"{where}, rows", MAX_STACKS)]
    if plot is not None:
        plot = _build(Plot, plot, f"{where}, plot")
    return _make(Claims, where, rows=rows, **claims), plot


def _outcomes(outcomes: dict[str, Any]) -> dict[str, Outcome]:
    if len(outcomes) > MAX_ENTRIES:
        wrong = f"outcomes.json has {len(outcomes)} outcomes, {MAX_ENTRIES} are allowed"
        raise Refused("too_many", wrong)
    where = "outcomes.json, {}"
    return {k: _build(Outcome, v, where.format(shown(k))) for k, v in outcomes.items()}


def _stacks(members: _Members, listed: Any) -> list[Stack]:
    """The stacks that facts.json lists; there must be two arrays for each, and no more."""
    where = "facts.json, stacks"
    listed = _list(listed, where, MAX_STACKS)
    wanted = {f"{kind}_{i}.npy" for kind in ("depth", "times") for i in range(len(listed))}
    for name in sorted(wanted - members.names):
        raise Refused("missing_member", f"{name} is missing from the bundle")
    for name in sorted(members.names - wanted):
        if name.endswith(".npy"):
            raise Refused("unlisted_member", f"{name} belongs to no distance in facts.json")
    if members.size(wanted) > 2 * MAX_ALL_SAMPLES + 2 * MAX_STACKS * (MAX_HEADER + 8 * MAX_FRAMES):
        raise Refused("too_many_values", f"The arrays hold more than {MAX_ALL_SAMPLES} depths")
    return [_stack(members, i, facts, where) for i, facts in enumerate(listed)]


def _stack(members: _Members, i: int, facts: Any, where: str) -> Stack:
    _want_keys(facts, "distance_m window", where)
    counts = _array(members.read(f"depth_{i}.npy"), f"depth_{i}.npy", "<u2", 3)
    times = _array(members.read(f"times_{i}.npy"), f"times_{i}.npy", "<f8", 1)
    if not np.isfinite(times).all():
        raise Refused("not_finite", f"times_{i}.npy holds NaN or infinity, want seconds")
    return _make(Stack, f"{where}, depth_{i}.npy", counts=counts, times_s=times, **facts)


# JSON


def _object(members: _Members, name: str, keys: str) -> dict[str, Any]:
    """The JSON object in a member, which must have these keys and no others."""
    found = _json(members.read(name), name)
    _want_keys(found, keys, name)
    return found


def _json(content: bytes, name: str) -> Any:
    """What JSON text says; numbers are finite and of bearable length, no key is there twice."""
    try:
        written = content.decode("utf-8")
    except UnicodeDecodeError:
        raise Refused("not_utf8", f"{name} is not text in UTF-8") from None
    if not _nests_well(content):  # else the parser's recursion could run out of stack
        wrong = f"{name} is nested deeper than {MAX_DEPTH}, or its brackets do not match"
        raise Refused("bad_nesting", wrong)

    def whole(digits: str) -> int:
        return int(_short(digits, name))

    def real(digits: str) -> float:
        value = float(_short(digits, name))
        return value if math.isfinite(value) else constant(digits)

    def constant(word: str) -> Any:
        raise Refused("not_finite", f"{name} holds {word}, want finite numbers")

    def pairs(items: list[tuple[str, Any]]) -> dict[str, Any]:
        found = dict(items)
        if len(found) < len(items):
            raise Refused("duplicate_key", f"{name} has the same key twice")
        return found

    try:
        return json.loads(
            written,
            parse_int=whole,
            parse_float=real,
            parse_constant=constant,
            object_pairs_hook=pairs,
        )
    except json.JSONDecodeError as error:
        raise Refused("not_json", f"{name} is no JSON (line {error.lineno})") from None


def _nests_well(content: bytes) -> bool:
    """Whether brackets outside of strings match, and are nested at most MAX_DEPTH deep.

    Every round takes the innermost pairs away, so the rounds are the depth.
    """
    brackets = _STRING.sub(b"", content).translate(_SQUARE, _NO_BRACKETS)
    for _ in range(MAX_DEPTH):
        brackets = brackets.replace(b"[]", b"")
    return not brackets


def _short(digits: str, name: str) -> str:
    if len(digits) > MAX_DIGITS:
        raise Refused("huge_number", f"{name} holds a number of {len(digits)} digits")
    return digits


def _names(kind: type) -> str:
    return " ".join(field.name for field in fields(kind))


def _want_dictionary(found: Any, where: str) -> None:
    if not isinstance(found, dict):
        raise Refused("wrong_type", f"{where}: got {shown(found)}, want an object")


def _want_keys(found: Any, keys: str, where: str) -> None:
    """`found` is a dictionary with these keys (a text, blanks between) and no others."""
    _want_dictionary(found, where)
    wanted = keys.split()
    for key in found:
        if key not in wanted:
            raise Refused("unknown_key", f"{where} has the unknown key {shown(key)}")
    for key in wanted:
        if key not in found:
            raise Refused("missing_key", f"{where} lacks {key}")


def _list(found: Any, where: str, most: int) -> list[Any]:
    if not isinstance(found, list):
        raise Refused("wrong_type", f"{where}: got {shown(found)}, want a list")
    if len(found) > most:
        raise Refused("too_many", f"{where}: got {len(found)} of them, {most} are allowed")
    return found


def _build(kind: type[_T], found: Any, where: str) -> _T:
    """A dataclass from a JSON object that has exactly its fields."""
    _want_keys(found, _names(kind), where)
    return _make(kind, where, **found)


def _make(kind: type[_T], where: str, **values: Any) -> _T:
    """A dataclass of contents.py, which checks its values."""
    try:
        return kind(**values)
    except ValueError as error:
        raise Refused("bad_value", f"{where}: {error}") from error


# arrays


def _array(content: bytes, name: str, dtype: str, rank: int) -> NDArray[Any]:
    """A NumPy array file (.npy, version 1.0) of this little-endian type, C order, and rank.

    The header is a Python expression by origin; here it is matched, never evaluated. The array is
    a read-only view of `content`: nothing is copied, and its size was that of the member.
    """
    start, header = _header(content, name)
    _want_dtype(header["descr"], name, dtype)
    if header["fortran"] == "True":
        raise Refused("fortran_order", f"{name} is in Fortran order, want C order")
    shape = _shape(header["shape"], name)
    if len(shape) != rank or min(shape) < 1:
        raise Refused("wrong_shape", f"{name} has the shape {shape}, want {rank} dimensions")
    size = math.prod(shape)
    if size > MAX_SAMPLES:
        raise Refused(
            "too_many_values", f"{name} declares {size} values, {MAX_SAMPLES} are allowed"
        )
    if size * np.dtype(dtype).itemsize != len(content) - start:
        raise Refused("wrong_length", f"{name} is not as long as its shape {shape} says")
    values = np.frombuffer(content, dtype, size, start).reshape(shape)
    return values.astype(values.dtype.newbyteorder("="), copy=False)


def _header(content: bytes, name: str) -> tuple[int, re.Match[str]]:
    """Where an array's values begin, and what its header says."""
    if content.startswith(b"PK"):
        raise Refused("nested_archive", f"{name} is an archive in the archive")
    if not content.startswith(b"\x93NUMPY") or len(content) < 10:
        raise Refused("not_npy", f"{name} is no NumPy array")
    if content[6:8] != b"\x01\x00":
        version = f"{content[6]}.{content[7]}"
        raise Refused("npy_version", f"{name} has version {version} of NumPy's format, want 1.0")
    size = int.from_bytes(content[8:10], "little")
    if size > MAX_HEADER or 10 + size > len(content):
        raise Refused("bad_npy_header", f"{name} has a header of {size} bytes")
    header = _HEADER.fullmatch(content[10 : 10 + size].decode("latin-1"))
    if header is None:
        raise Refused("bad_npy_header", f"{name} has a header that NumPy does not write")
    return 10 + size, header


def _want_dtype(descr: str, name: str, dtype: str) -> None:
    if descr == f"'{dtype}'":
        return
    if "O" in descr:
        raise Refused("object_array", f"{name} holds Python objects, which could run code")
    if descr == f"'>{dtype[1:]}'":
        raise Refused("byte_order", f"{name} is big-endian, want {dtype}")
    raise Refused("wrong_dtype", f"{name} holds {shown(descr.strip(chr(39)))}, want {dtype}")


def _shape(written: str, name: str) -> tuple[int, ...]:
    """The dimensions in "100, 40, 40" (Python 2 wrote 100L), none of them beyond 12 digits."""
    parts = [part.strip() for part in written.rstrip(", ").split(",")]
    found = [_DIMENSION.fullmatch(part) for part in parts if part]
    if not found or len(found) > 8 or None in found:
        raise Refused("wrong_shape", f"{name} has the shape ({shown(written)})")
    return tuple(int(match[1]) for match in found if match)
