"""Bundles from strangers: whatever the bytes are, a Submission or Refused comes out, nothing else.

COURSEKIT_NIGHTLY=1 takes 5,000 structured inputs and 200,000 mutated ones (a few minutes).
"""

import contextlib
import json
import os
import re
import tracemalloc
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import hostile_bundles as bundles
import numpy as np
import pytest
from common import NIGHTLY
from hostile_bundles import GONE, HONEST, MEMBERS, hashed, parts
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from coursekit.submission import format as bundle_format
from coursekit.submission.format import Refused, Submission, bundle_bytes, read_bundle, zip_bytes

STRUCTURED = 5_000 if NIGHTLY else 120
MUTATED = 200_000 if NIGHTLY else 1_000
KINDS = bundles.hostile()
AS_IF_PLAIN = ("not_plain", "unknown_member")  # what the hashes vouch for may be read all the same


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


@contextlib.contextmanager
def at_most(memory_bytes: float) -> Iterator[None]:
    """Fails where more memory is taken at any moment."""
    tracemalloc.start()
    try:
        yield
        assert tracemalloc.get_traced_memory()[1] < memory_bytes
    finally:
        tracemalloc.stop()


# --- one thing wrong ---


@pytest.mark.parametrize("name", KINDS)
def test_each_kind_is_refused_for_its_own_reason_and_takes_little_memory(name):
    reason, data = KINDS[name]
    with at_most(20e6):
        found = outcome(data)
    if reason in AS_IF_PLAIN and isinstance(found, Submission):  # zipped again, or near enough
        assert parts(bundle_bytes(found)) == parts(HONEST)
    elif reason:
        assert found == reason or (reason in AS_IF_PLAIN and isinstance(found, str))
    else:  # what is read is what the hashes vouch for
        packed, given = parts(bundle_bytes(found)), parts(data)
        changed = {name for name in packed if packed[name] != given[name]}
        assert changed <= {"manifest.json", "claims.json"}
        assert abs(found.claims.rows[1].depth_std_mm - 4.5) in (0.0, 3.5)  # or 0.999...


def test_there_are_as_many_kinds_as_ever_and_every_reason_has_one():
    """All codes in the source are met by a bundle here, or by a path below."""
    assert len(KINDS) == 197
    accepted = [name for name, (reason, _) in KINDS.items() if not reason]
    assert accepted == ["junk behind the stream", "a number of 5,000 digits"]
    source = Path(bundle_format.__file__).read_text(encoding="utf-8")
    assert set(re.findall(r'_refused\(\s*"([\w.]+)"', source)) == set(
        bundle_format.WORDS["refused"]
    )
    codes = {key.partition(".")[0] for key in bundle_format.WORDS["refused"]}
    assert codes - {reason for reason, _ in KINDS.values()} == {"not_a_file", "unreadable"}
    assert len(codes) > 10


@pytest.mark.parametrize("kind", ["a Mac's zip of a bundle", "a folder", "streamed"])
def test_a_bundle_zipped_again_is_read(kind):
    assert bundle_bytes(read_bundle(KINDS[kind][1])) == HONEST


def test_an_unpacked_bundle_and_a_bundle_in_a_zip_are_read_but_no_zip_in_a_zip_in_a_zip(tmp_path):
    for name, content in MEMBERS.items():
        (tmp_path / name).write_bytes(content)
    (tmp_path / ".DS_Store").write_bytes(b"")
    assert bundle_bytes(read_bundle(tmp_path)) == HONEST
    folder = {f"studio_1_Zoe/{name}": content for name, content in MEMBERS.items()}
    assert bundle_bytes(read_bundle(bundles.zipped(folder))) == HONEST
    assert outcome(bundles.zipped({"facts.json": b"{}"} | folder)) == "unknown_member"
    once = bundles.zipped({"studio_1.zip": HONEST, "__MACOSX/._studio_1.zip": b"junk"})
    assert bundle_bytes(read_bundle(once)) == HONEST
    assert outcome(bundles.zipped({"b.zip": once})) == "unknown_member"


def test_a_lie_about_the_size_takes_no_memory():
    """32 MB of zeros behind a header that says 9,000 bytes: they are never unpacked."""
    data = bundles.with_deflated(bundles.deflated(bytes(2**25)), 9_000, 0)
    with at_most(500_000), pytest.raises(Refused, match=r"^manifest\.json is damaged, or not as"):
        read_bundle(data)


# --- files that are none ---


def test_paths_that_are_no_file(tmp_path):
    assert outcome(tmp_path) == "not_a_file"
    assert outcome(tmp_path / "gone.zip") == "not_a_file"
    assert outcome(tmp_path / ("a" * 300)) in ("not_a_file", "unreadable")
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.zip")  # which is not waited for
        assert outcome(tmp_path / "pipe.zip") == "not_a_file"
        (tmp_path / "loop.zip").symlink_to(tmp_path / "loop.zip")  # a link to itself
        assert outcome(tmp_path / "loop.zip") in ("not_a_file", "unreadable")


def test_a_file_that_cannot_be_read(tmp_path, monkeypatch):
    def forbidden(*_, **__):
        raise PermissionError(13, "Permission denied")

    (tmp_path / "secret.zip").write_bytes(HONEST)
    monkeypatch.setattr(Path, "open", forbidden)
    with pytest.raises(Refused, match="Permission denied") as refused:
        read_bundle(tmp_path / "secret.zip")
    assert refused.value.reason == "unreadable"


def test_a_file_without_end_is_not_read_to_its_end(tmp_path):
    with (tmp_path / "large.zip").open("wb") as file:
        file.truncate(2**32)  # takes no room on the disk
    with at_most(12e6):
        assert outcome(tmp_path / "large.zip") == "too_large"


# --- structured inputs ---

words = st.sampled_from(
    [*MEMBERS, "depth_0.npy", "live", "bias", "../x", "=1+1", "<b>", "", "\u202e", "\ud800", "\0"]
)
numbers = st.integers() | st.integers(-(10**39), 10**39)
numbers |= st.floats(allow_nan=False, allow_infinity=False)
values = st.recursive(
    st.none() | st.booleans() | numbers | st.text(max_size=8) | words,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=6,
)


def places(content, path=()):
    """The paths of all values in JSON."""
    yield path
    if isinstance(content, (dict, list)):
        for key in content if isinstance(content, dict) else range(len(content)):
            yield from places(content[key], (*path, key))


@st.composite
def changed_json(draw):
    """The honest bundle, where one or two values of a JSON member are others, or gone."""
    name = draw(st.sampled_from([name for name in MEMBERS if name.endswith(".json")]))
    content = json.loads(MEMBERS[name])
    for _ in range(draw(st.integers(1, 2))):
        path = draw(st.sampled_from(list(places(content))))
        content = bundles.placed(content, path, draw(values | st.just(GONE)))
    return bundles.with_json(name, content)


dimensions = st.lists(st.sampled_from([0, 1, 2, 3, 4, 5, 60, 2001, 10**6, 2**32, -1]), max_size=5)
kinds = ["'<u2'", "'<f8'", "'>f8'", "'|u1'", "'|O'", "'<M8'", "'<u2', 'x': 1", "[]"]
changed_array = st.builds(  # the honest bundle with an array of any header
    lambda name, header: bundles.with_member(name, bundles.npy(**header)),
    st.sampled_from([f"{kind}_{i}.npy" for kind in ("depth", "times") for i in range(3)]),
    st.fixed_dictionaries(
        {
            "descr": st.sampled_from(kinds) | st.text(max_size=6),
            "shape": dimensions.map(lambda some: str(tuple(some)))
            | st.sampled_from(["(3, 4, 5)", "(3,)", "3", "()"]),
            "fortran": st.sampled_from(["False", "True", "0", "None"]),
            "content": st.sampled_from([bytes(120), bytes(24), bytes(480)]) | st.binary(max_size=9),
            "version": st.sampled_from([b"\1\0"] * 3 + [b"\2\0", b"\0\0", b"\xff\xff"]),
        }
    ),
)


@st.composite
def changed_zip(draw):
    """The honest bundle, where some numbers in the zip's headers are others."""
    data = HONEST
    number = st.sampled_from([0, 1, 2, 8, 12, 22, 99, 2**15, 2**16 - 1, 2**31, 2**32 - 1])
    for _ in range(draw(st.integers(1, 3))):
        local, central = bundles.headers(HONEST, draw(st.sampled_from(list(MEMBERS))))
        lie = {draw(st.sampled_from(list(bundles.CENTRAL))): draw(number | st.integers(0, 4_000))}
        for start, table in ((local, bundles.LOCAL), (central, bundles.CENTRAL)):
            if draw(st.booleans()):
                data = bundles.patched(data, start, table, **lie)
    return data


@st.composite
def any_members(draw):
    """A zip of some members with any names and any contents, hashed or not."""
    names = st.sampled_from([*MEMBERS, "a/../b", "/x", "\\", "depth_00.npy", "times_99.npy"])
    content = st.binary(max_size=40) | st.sampled_from(list(MEMBERS.values()))
    others = draw(st.dictionaries(names | st.text(min_size=1, max_size=9), content, max_size=3))
    gone = draw(st.sets(st.sampled_from(list(MEMBERS)), max_size=2))
    members = {k: v for k, v in MEMBERS.items() if k not in gone} | others
    if draw(st.booleans()):
        members = hashed(members | {"manifest.json": MEMBERS["manifest.json"]})
    try:
        return zip_bytes(members)
    except (UnicodeEncodeError, ValueError):  # a name that zipfile does not write
        return b""


limits = {"disk": 2, "here": 40, "count": 40, "size": 9_999, "start": 9_999}
ends = st.fixed_dictionaries({}, optional={k: st.integers(0, most) for k, most in limits.items()})


@settings(
    max_examples=STRUCTURED,
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=list(HealthCheck),
)
@given(
    changed_json()
    | changed_array
    | changed_zip()
    | any_members()
    | ends.map(lambda values: bundles.lying_end(**values))
    | st.binary(max_size=60).map(lambda junk: HONEST[:40] + junk + HONEST[40:])
)
def test_structured_inputs(data):
    outcome(data)


# --- mutated inputs ---


def mutation(rng: np.random.Generator, data: bytes) -> bytes:
    """Bytes flipped, a piece cut out or copied elsewhere, or a run of bytes as at a type's edge."""
    way, at = rng.integers(4), int(rng.integers(0, len(data) + 1))
    low, high = sorted(rng.integers(0, len(data) + 1, 2).tolist())
    if way == 0 and data:  # one to eight bytes flipped
        changed = np.frombuffer(data, np.uint8).copy()
        some = rng.integers(0, len(data), rng.integers(1, 9))
        changed[some] ^= rng.integers(1, 256, len(some), np.uint8)
        return changed.tobytes()
    if way == 1:  # the end, or a piece in the middle, taken out
        return data[:low] + (data[high:] if rng.random() < 0.5 else b"")
    if way == 2:  # a piece copied over what is there, or between
        piece = data[low:high][:200]
        return data[:at] + piece + data[at + len(piece) * int(rng.integers(2)) :]
    run = int(rng.choice([1, 2, 4, 8]))
    piece = [bytes(run), b"\xff" * run, b"\x80".rjust(run, b"\0"), b"9" * run][rng.integers(4)]
    return data[:at] + piece + data[at + run :]


def mutated(rng: np.random.Generator) -> tuple[bytes, bool]:
    """A mutant of the honest bundle, and whether its manifest was redone to fit."""
    way, (name, other) = rng.integers(4), rng.choice(list(MEMBERS), 2).tolist()
    if way == 0:  # the file
        return mutation(rng, HONEST), False
    if way == 1:  # two members swapped
        return zip_bytes(MEMBERS | {name: MEMBERS[other], other: MEMBERS[name]}), False
    members = MEMBERS | {name: mutation(rng, MEMBERS[name])}
    if way == 2 or name == "manifest.json":  # a member, and the zip's checksum
        return zip_bytes(members), False
    return zip_bytes(hashed(members)), True  # a member, and its hash


def test_mutated_inputs():
    """None raises anything else; without a rehash, none is read as other raw values or claims."""
    rng, reasons = np.random.default_rng(8), Counter()
    own = {name: getattr(bundles.ZOE, name) for name in ("student", "made")}  # the manifest's
    for _ in range(MUTATED):
        data, rehashed = mutated(rng)
        found = outcome(data)
        if isinstance(found, str):
            reasons[found] += 1
        elif not rehashed:  # what has no meaning was hit, such as a date in the zip
            assert bundle_bytes(replace(found, **own)) == HONEST
    assert len(reasons) >= 9, reasons
