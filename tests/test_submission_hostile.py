"""Bundles from strangers: whatever the bytes are, a Submission or Refused comes out, nothing else.

COURSEKIT_NIGHTLY=1 takes 5,000 structured inputs and 200,000 mutated ones (a few minutes).
"""

from __future__ import annotations

import json
import os
import re
import tracemalloc
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_bundles import (
    CENTRAL,
    HONEST,
    LOCAL,
    MEMBERS,
    Hostile,
    hashed,
    headers,
    hostile,
    lying_end,
    npy,
    parts,
    submission,
    with_deflated,
    with_member,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from coursekit.submission import format as bundle_format
from coursekit.submission.format import Refused, Submission, bundle_bytes, read_bundle, zip_bytes

NIGHTLY = os.environ.get("COURSEKIT_NIGHTLY") == "1"
STRUCTURED = 5_000 if NIGHTLY else 200
MUTATED = 200_000 if NIGHTLY else 1_000
KINDS = list(hostile())


def outcome(data: bytes | Path) -> Submission | str:
    """The submission, or the reason; a refusal is a sentence that a page can show."""
    try:
        return read_bundle(data)
    except Refused as refused:
        sentence = str(refused)
        assert sentence.isprintable()
        assert sentence.endswith(".")
        assert 20 < len(sentence) < 400
        return refused.reason


# --- one thing wrong ---


@pytest.mark.parametrize("kind", KINDS, ids=[kind.name for kind in KINDS])
def test_each_kind_is_refused_for_its_own_reason_and_takes_little_memory(kind: Hostile) -> None:
    tracemalloc.start()
    try:
        found = outcome(kind.data)
        assert tracemalloc.get_traced_memory()[1] < 20e6
    finally:
        tracemalloc.stop()
    if kind.reason:
        assert found == kind.reason
    else:  # what is read is what the hashes vouch for
        assert isinstance(found, Submission)
        packed, given = parts(bundle_bytes(found)), parts(kind.data)
        changed = {name for name in packed if packed[name] != given[name]}
        assert changed <= {"manifest.json", "claims.json"}
        assert abs(found.claims.rows[1].depth_std_mm - 4.5) in (0.0, 3.5)  # or 0.999...


def test_there_are_as_many_kinds_as_ever() -> None:
    assert len({kind.name for kind in KINDS}) == len(KINDS) == 195
    assert [kind.name for kind in KINDS if not kind.reason] == [
        "junk behind the stream",
        "a number of 5,000 digits",
    ]


@pytest.mark.parametrize(
    "kind", ["a bundle in a folder", "a Mac's zip of a bundle", "a folder", "streamed"]
)
def test_who_zips_a_bundle_again_hears_what_to_do(kind: str) -> None:
    (data,) = [one.data for one in KINDS if one.name == kind]
    with pytest.raises(Refused, match=r"zipped again.*; hand in the \.zip that .* never unpacked"):
        read_bundle(data)


def test_every_reason_has_its_kind() -> None:
    """All codes in the source are met by a bundle here, or by a path below."""
    source = Path(bundle_format.__file__).read_text(encoding="utf-8")
    codes = set(re.findall(r'Refused\(\s*"(\w+)"', source))
    assert codes - {kind.reason for kind in KINDS} == {"not_a_file", "unreadable"}
    assert len(codes) > 10


def test_a_lie_about_the_size_takes_no_memory() -> None:
    """32 MB of zeros behind a header that says 9,000 bytes: they are never unpacked."""
    stream = zlib.compressobj(9, zlib.DEFLATED, -15)
    bomb = stream.compress(bytes(2**25)) + stream.flush()
    data = with_deflated(bomb, 9_000, 0)
    tracemalloc.start()
    try:
        with pytest.raises(
            Refused, match=r"^manifest\.json is damaged, or not as long as its header"
        ):
            read_bundle(data)
        assert tracemalloc.get_traced_memory()[1] < 500_000
    finally:
        tracemalloc.stop()


# --- files that are none ---


def test_a_path_that_is_no_file(tmp_path: Path) -> None:
    assert outcome(tmp_path) == "not_a_file"
    assert outcome(tmp_path / "gone.zip") == "not_a_file"
    assert outcome(tmp_path / ("a" * 300)) in ("not_a_file", "unreadable")


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no pipes in folders here")
def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.zip")
    assert outcome(tmp_path / "pipe.zip") == "not_a_file"


def test_a_link_to_itself(tmp_path: Path) -> None:
    link = tmp_path / "loop.zip"
    try:
        link.symlink_to(link)
    except OSError:
        pytest.skip("no links here")
    assert outcome(link) in ("not_a_file", "unreadable")


def test_a_file_that_cannot_be_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "secret.zip"
    path.write_bytes(HONEST)

    def forbidden(*_: Any, **__: Any) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", forbidden)
    with pytest.raises(Refused, match="Permission denied") as refused:
        read_bundle(path)
    assert refused.value.reason == "unreadable"


def test_a_file_without_end_is_not_read_to_its_end(tmp_path: Path) -> None:
    path = tmp_path / "large.zip"
    with path.open("wb") as file:
        file.truncate(2**32)  # takes no room on the disk
    tracemalloc.start()
    try:
        assert outcome(path) == "too_large"
        assert tracemalloc.get_traced_memory()[1] < 12e6
    finally:
        tracemalloc.stop()


# --- structured inputs ---

words = st.sampled_from(
    [*MEMBERS, "depth_0.npy", "live", "bias", "../x", "=1+1", "<b>", "", "\u202e", "\ud800", "\0"]
)
leaves = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.integers(-(10**39), 10**39)
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.text(max_size=8)
    | words
)
values = st.recursive(
    leaves,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=6,
)


def places(content: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """The paths of all values in JSON."""
    yield path
    if isinstance(content, (dict, list)):
        for key in content if isinstance(content, dict) else range(len(content)):
            yield from places(content[key], (*path, key))


def placed(content: Any, path: tuple[Any, ...], value: Any) -> Any:
    """JSON with another value at a path; without it, where the value is "(gone)"."""
    if not path:
        return value
    copy = content.copy()
    copy[path[0]] = placed(content[path[0]], path[1:], value)
    if copy[path[0]] == "(gone)":
        del copy[path[0]]
    return copy


@st.composite
def changed_json(draw: st.DrawFn) -> bytes:
    """The honest bundle, where one or two values of a JSON member are others, or gone."""
    name = draw(st.sampled_from([name for name in MEMBERS if name.endswith(".json")]))
    content = json.loads(MEMBERS[name])
    for _ in range(draw(st.integers(1, 2))):
        path = draw(st.sampled_from(list(places(content))))
        content = placed(content, path, draw(values | st.just("(gone)")))
    written = json.dumps(content).encode()
    if name == "manifest.json":
        return zip_bytes(MEMBERS | {name: written})
    return with_member(name, written)


@st.composite
def changed_array(draw: st.DrawFn) -> bytes:
    """The honest bundle with an array of any header: type, shape, order, version, length."""
    kind = draw(st.sampled_from(["depth", "times"]))
    dimensions = draw(
        st.lists(st.sampled_from([0, 1, 2, 3, 4, 5, 60, 2001, 10**6, 2**32, -1]), max_size=5)
    )
    shape = draw(st.sampled_from([str(tuple(dimensions)), "(3, 4, 5)", "(3,)", "3", "()"]))
    descr = draw(
        st.sampled_from(
            ["'<u2'", "'<f8'", "'>f8'", "'|u1'", "'|O'", "'<M8'", "'<u2', 'x': 1", "[]"]
        )
        | st.text(max_size=6)
    )
    fortran = draw(st.sampled_from(["False", "True", "0", "None"]))
    version = draw(st.sampled_from([b"\x01\x00"] * 3 + [b"\x02\x00", b"\x00\x00", b"\xff\xff"]))
    content = draw(
        st.sampled_from([bytes(120), bytes(24), b"", bytes(480)]) | st.binary(max_size=9)
    )
    data = npy(descr, shape, fortran, content, version)
    return with_member(f"{kind}_{draw(st.integers(0, 2))}.npy", data)


@st.composite
def changed_zip(draw: st.DrawFn) -> bytes:
    """The honest bundle, where some numbers in the zip's headers are others."""
    data = bytearray(HONEST)
    number = st.sampled_from([0, 1, 2, 8, 12, 22, 99, 2**15, 2**16 - 1, 2**31, 2**32 - 1])
    for _ in range(draw(st.integers(1, 3))):
        local, central = headers(HONEST, draw(st.sampled_from(list(MEMBERS))))
        field = draw(st.sampled_from(list(CENTRAL)))
        value = draw(number | st.integers(0, len(HONEST)))
        for start, table in ((local, LOCAL), (central, CENTRAL)):
            if field in table and draw(st.booleans()):
                at, size = table[field]
                value %= 256**size
                data[start + at : start + at + size] = value.to_bytes(size, "little")
    return bytes(data)


@st.composite
def any_members(draw: st.DrawFn) -> bytes:
    """A zip of some members with any names and any contents, hashed or not."""
    names = st.sampled_from([*MEMBERS, "a/../b", "/x", "\\", "depth_00.npy", "times_99.npy"])
    content = st.binary(max_size=40) | st.sampled_from(list(MEMBERS.values()))
    others = draw(st.dictionaries(names | st.text(min_size=1, max_size=9), content, max_size=3))
    gone = draw(st.sets(st.sampled_from(list(MEMBERS)), max_size=2))
    members = {k: v for k, v in MEMBERS.items() if k not in gone} | others
    try:
        return zip_bytes(
            hashed(members | {"manifest.json": MEMBERS["manifest.json"]})
            if draw(st.booleans())
            else members
        )
    except (UnicodeEncodeError, ValueError):  # a name that zipfile does not write
        return b""


ends = st.fixed_dictionaries(
    {},
    optional={
        "disk": st.integers(0, 2),
        "here": st.integers(0, 40),
        "count": st.integers(0, 40),
        "size": st.integers(0, 9_999),
        "start": st.integers(0, 9_999),
    },
)


@settings(
    max_examples=STRUCTURED,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(
    changed_json()
    | changed_array()
    | changed_zip()
    | any_members()
    | ends.map(lambda values: lying_end(**values))
    | st.binary(max_size=60).map(lambda junk: HONEST[:40] + junk + HONEST[40:])
)
def test_structured_inputs(data: bytes) -> None:
    outcome(data)


# --- mutated inputs ---

Mutation = Callable[[np.random.Generator, bytes], bytes]


def flipped(rng: np.random.Generator, data: bytes) -> bytes:
    """One to eight bytes changed."""
    changed = bytearray(data)
    for at in rng.integers(0, len(data), rng.integers(1, 9)) if data else ():
        changed[at] ^= int(rng.integers(1, 256))
    return bytes(changed)


def cut(rng: np.random.Generator, data: bytes) -> bytes:
    """The end, or a piece in the middle, taken out."""
    low, high = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    return data[:low] + (data[high:] if rng.random() < 0.5 else b"")


def spliced(rng: np.random.Generator, data: bytes) -> bytes:
    """A piece copied to another place, over what is there or between."""
    low, high = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    piece, at = data[low:high][:200], int(rng.integers(0, len(data) + 1))
    return data[:at] + piece + data[at + (len(piece) if rng.random() < 0.5 else 0) :]


def extreme(rng: np.random.Generator, data: bytes) -> bytes:
    """A run of bytes set to 0, to 255, or to a number at the edge of a type."""
    at, run = int(rng.integers(0, len(data) + 1)), int(rng.choice([1, 2, 4, 8]))
    piece = [bytes(run), b"\xff" * run, b"\x80".rjust(run, b"\0"), b"9" * run][rng.integers(4)]
    return data[:at] + piece + data[at + run :]


MUTATIONS: tuple[Mutation, ...] = (flipped, cut, spliced, extreme)


def mutated(rng: np.random.Generator) -> tuple[bytes, bool]:
    """A mutant of the honest bundle, and whether its manifest was redone to fit."""
    mutation = MUTATIONS[rng.integers(len(MUTATIONS))]
    way = rng.integers(4)
    if way == 0:  # the file
        return mutation(rng, HONEST), False
    names = list(MEMBERS)
    name = names[rng.integers(len(names))]
    members = MEMBERS | {name: mutation(rng, MEMBERS[name])}
    if way == 1:  # two members swapped, or one renamed
        other = names[rng.integers(len(names))]
        members = MEMBERS | {name: MEMBERS[other], other: MEMBERS[name]}
        return zip_bytes(members), False
    if way == 2 or name == "manifest.json":  # a member, and the zip's checksum
        return zip_bytes(members), False
    return zip_bytes(hashed(members)), True  # a member, and its hash


def test_mutated_inputs() -> None:
    """None raises anything else; without a rehash, none is read as other raw values or claims."""
    rng = np.random.default_rng(8)
    reasons: dict[str, int] = {}
    honest = submission()
    for _ in range(MUTATED):
        data, rehashed = mutated(rng)
        found = outcome(data)
        if isinstance(found, str):
            reasons[found] = reasons.get(found, 0) + 1
        elif not rehashed:  # what has no meaning was hit, such as a date in the zip
            assert_unchanged(found, honest)
    assert len(reasons) >= 9, reasons


def assert_unchanged(found: Submission, honest: Submission) -> None:
    """What the manifest hashes is bit for bit what was packed."""
    words = {name: getattr(honest, name) for name in ("student", "made")}  # the manifest's own
    assert bundle_bytes(replace(found, **words)) == HONEST
