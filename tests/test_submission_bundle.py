"""Bundles: what goes in comes out, the same bytes every time, whatever version wrote the arrays."""

from __future__ import annotations

import hashlib
import io
import json
import pickle
import re
import struct
import zipfile
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hostile_bundles import (
    CAMERA,
    HONEST,
    MEMBERS,
    hashed,
    parts,
    submission,
    unhashed,
    with_member,
)

from coursekit.submission import format as bundle_format
from coursekit.submission.format import (
    MAX_ALL_SAMPLES,
    MAX_FRAMES,
    MAX_SAMPLES,
    SCHEMA,
    CameraFacts,
    Claims,
    Conclusion,
    Outcome,
    Plot,
    Refused,
    Stack,
    Submission,
    TableRow,
    array_bytes,
    bundle_bytes,
    check_schema,
    read_bundle,
    write_bundle,
    zip_bytes,
)

FORMAT = Path(bundle_format.__file__).with_name("FORMAT.md")


def same(one: Submission, other: Submission) -> bool:
    """Equal in every field, and every array bit for bit."""
    plain = ("student", "exercise", "made", "versions", "camera", "tape_sigma_m", "caliper_m")
    plain += ("claims", "plot", "conclusion", "outcomes")
    return all(getattr(one, name) == getattr(other, name) for name in plain) and all(
        (a.distance_m, a.window) == (b.distance_m, b.window)
        and np.array_equal(a.counts, b.counts)
        and np.array_equal(a.times_s, b.times_s)
        for a, b in zip(one.stacks, other.stacks, strict=True)
    )


# --- there and back ---


def test_what_goes_in_comes_out(tmp_path: Path) -> None:
    given = submission()
    path = write_bundle(tmp_path / "new" / "studio_1_zoe.zip", given)
    assert path == tmp_path / "new" / "studio_1_zoe.zip"
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # nothing left over
    for found in (read_bundle(path), read_bundle(path.read_bytes())):
        assert same(found, given)
        assert found.stacks[0].counts.dtype == np.uint16
        assert found.stacks[0].times_s.dtype == np.float64
        assert not found.stacks[0].counts.flags.writeable


@pytest.mark.parametrize(
    "changes",
    [
        {"plot": None, "claims": Claims(), "conclusion": Conclusion(), "outcomes": {}},
        {"stacks": ()},
        {"plot": Plot((0.3, 0.45), (0.3, 0.6), None)},
        {"camera": CameraFacts(**CAMERA | {"baseline_m": None, "serial": ""})},
        {"student": "=1+1"},  # what is a formula or a tag elsewhere is only text here
        {"student": "<script>alert(1)</script>"},
        {"student": "O'Brien; DROP TABLE -- 王小明 مریم"},
        {"conclusion": Conclusion(paragraph="\t" + "ǅ\n" * 2_000)},
        {"claims": Claims((TableRow(0.1 + 0.2, -0.0, 5e-324, 1 / 3, 1e-9, -7.0),))},
    ],
)
def test_unusual_but_honest(changes: dict[str, Any]) -> None:
    given = submission(**changes)
    assert same(read_bundle(bundle_bytes(given)), given)


def test_a_hundred_frames_at_three_distances_take_milliseconds_and_half_a_megabyte() -> None:
    rng = np.random.default_rng(5)
    stacks = [
        Stack(z, (400, 220, 40, 40), depths(rng, z, (100, 40, 40)), np.arange(100) / 30)
        for z in (0.3, 0.45, 0.6)
    ]
    given = submission(stacks=stacks)
    data = bundle_bytes(given)
    assert len(data) < 600_000
    assert same(read_bundle(data), given)


def depths(rng: np.random.Generator, z: float, shape: tuple[int, ...]) -> np.ndarray:
    return rng.normal(1000 * z, 30 * z * z, shape).round().astype(np.uint16)


@pytest.mark.parametrize("value", [0, 300, 65535])
def test_depth_that_never_changes_is_no_zip_bomb(value: int) -> None:
    """All invalid, or frozen: weak, but honest. It is stored, for deflate shrinks it 800 times."""
    counts = np.full((100, 40, 40), value, np.uint16)
    given = submission(stacks=[Stack(0.3, (0, 0, 40, 40), counts, np.arange(100) / 30)])
    assert same(read_bundle(bundle_bytes(given)), given)


def test_same_bytes_every_time() -> None:
    assert bundle_bytes(submission()) == HONEST
    assert bundle_bytes(read_bundle(HONEST)) == HONEST


def test_arrays_that_lie_differently_in_memory_give_the_same_bytes() -> None:
    stack = submission().stacks[0]
    turned = np.asfortranarray(stack.counts)
    spread = np.repeat(stack.times_s, 2)[::2]
    again = Stack(stack.distance_m, stack.window, turned, spread)
    stacks = (again, submission().stacks[1])
    assert bundle_bytes(submission(stacks=stacks)) == HONEST


# --- writing ---


def test_never_overwritten_without_being_told(tmp_path: Path) -> None:
    path = write_bundle(tmp_path / "a.zip", submission())
    with pytest.raises(FileExistsError, match="overwrite=True"):
        write_bundle(path, submission(student="Max"))
    assert path.read_bytes() == HONEST
    write_bundle(path, submission(student="Max"), overwrite=True)
    assert read_bundle(path).student == "Max"


def test_as_much_as_a_submission_may_hold_fits() -> None:
    """Every cap of the schema reached at once, depths pure noise: below 5 MiB, and read back."""
    rng = np.random.default_rng(6)
    stacks = [
        Stack(0.3 + i, (0, 0, 9, 9), noise, rng.uniform(0, 1, len(noise)))
        for i, noise in enumerate(rng.integers(0, 65535, (12, 2000, 9, 9), np.uint16))
    ]
    word = "\U0001f9ff\U00010400" * 50  # 100 characters of 4 bytes each
    names = [f"{i:03d}_{'a' * 96}" for i in range(100)]
    numbers = (-1 / 3e9,) * 100
    row = dict.fromkeys(TableRow.__dataclass_fields__, 1000000000.0 - 1 / 3)
    given = submission(
        student=word,
        stacks=stacks,
        camera=CameraFacts(**CAMERA | {"name": word, "serial": word, "model": word}),
        versions={
            word[:-2] + chr(0x10400 + i // 40) + chr(0x10400 + i % 40): word for i in range(100)
        },
        claims=Claims(tuple(TableRow(**row | {"distance_m": 0.3 + i}) for i in range(12))),
        plot=Plot(numbers, numbers, numbers),
        conclusion=Conclusion(0.3, 10**6, "noise", word[:1] * 4_999 + "1"),
        outcomes={name: Outcome(False, 10**6) for name in names},
    )
    data = bundle_bytes(given)
    assert 4e6 < len(data) < 5 * 2**20
    assert same(read_bundle(data), given)


def test_interrupted_writing_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = write_bundle(tmp_path / "a.zip", submission())

    def full(*_: Any) -> None:
        raise OSError("No space left on device")

    monkeypatch.setattr(Path, "replace", full)
    with pytest.raises(OSError, match="No space"):
        write_bundle(path, submission(student="Max"), overwrite=True)
    assert path.read_bytes() == HONEST
    assert [p.name for p in tmp_path.iterdir()] == ["a.zip"]


# --- any change is noticed ---


def test_every_raw_value_counts() -> None:
    """Each depth and each time stamp, one bit off: refused, unless the hash is redone."""
    for name, width in (("depth_0.npy", 2), ("depth_1.npy", 2), ("times_0.npy", 8)):
        content = MEMBERS[name]
        for at in range(content.index(b"\n") + 1, len(content), width):
            changed = content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]
            with pytest.raises(Refused, match="does not match its own manifest") as refused:
                read_bundle(unhashed(name, changed))
            assert refused.value.reason == "wrong_hash"
    assert not same(read_bundle(with_member(name, changed)), submission())


@pytest.mark.parametrize("name", ["facts.json", "claims.json", "conclusion.json", "outcomes.json"])
def test_every_number_claimed_counts(name: str) -> None:
    written = MEMBERS[name].decode()
    numbers = list(re.finditer(r"-?\d+(\.\d+)?|true|false", written))
    assert len(numbers) >= 2
    for number in numbers:
        other = {"true": "false", "false": "true"}.get(number[0], "2" if number[0] == "1" else "1")
        changed = written[: number.start()] + other + written[number.end() :]
        with pytest.raises(Refused, match="does not match its own manifest"):
            read_bundle(unhashed(name, changed.encode()))


def test_the_student_can_be_renamed_by_hand() -> None:
    """What FORMAT.md says the manifest does not protect against: it is no signature."""
    manifest = json.loads(MEMBERS["manifest.json"]) | {"student": "Max"}
    renamed = unhashed("manifest.json", json.dumps(manifest).encode())
    assert read_bundle(renamed).student == "Max"


# --- NumPy's files, of any version ---


def header_of(shape: str, multiple: int, spaces: int = 0, end: str = "\n") -> bytes:
    """The start of a .npy file: the header padded with blanks to a multiple of so many bytes."""
    text = f"{{'descr': '<u2', 'fortran_order': False, 'shape': {shape}, }}" + " " * spaces
    text += " " * (-(10 + len(text) + len(end)) % multiple) + end
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text.encode()


@pytest.mark.parametrize(
    "header",
    [
        pytest.param(header_of("(3, 4, 5)", 16), id="NumPy 1.0 to 1.13: 16 bytes"),
        pytest.param(header_of("(3, 4, 5)", 64), id="NumPy 1.14 to 1.22: 64 bytes"),
        pytest.param(header_of("(3, 4, 5)", 64, spaces=20), id="NumPy 1.23 on: room to grow"),
        pytest.param(header_of("(3, 4, 5)", 1), id="no padding"),
        pytest.param(header_of("(3, 4, 5,)", 64), id="a comma behind the last"),
    ],
)
def test_headers_of_all_versions_of_numpy(header: bytes) -> None:
    given = submission().stacks[0].counts
    data = header + given.tobytes()
    np.testing.assert_array_equal(np.load(io.BytesIO(data)), given)
    found = read_bundle(with_member("depth_0.npy", data))
    assert same(found, submission())


@pytest.mark.parametrize("shape", [(1,), (7,), (3, 4, 5), (1, 1, 1), (100, 40, 40), (2000, 1, 64)])
@pytest.mark.parametrize("dtype", ["<u2", "<f8"])
def test_arrays_are_numpys_own_format(shape: tuple[int, ...], dtype: str) -> None:
    rng = np.random.default_rng(7)
    given = rng.integers(0, 65535, shape).astype(dtype)
    data = array_bytes(given)
    found = np.load(io.BytesIO(data), allow_pickle=False)
    np.testing.assert_array_equal(found, given)
    assert found.dtype == given.dtype
    assert (data.index(b"\n") + 1) % 64 == 0


def test_what_numpy_saves_is_read() -> None:
    saved = {}
    for i, stack in enumerate(submission().stacks):
        for kind, values in (("depth", stack.counts), ("times", stack.times_s)):
            buffer = io.BytesIO()
            np.save(buffer, values)
            saved[f"{kind}_{i}.npy"] = buffer.getvalue()
    assert same(read_bundle(zip_bytes(hashed(MEMBERS | saved))), submission())


# --- the format, as it is described ---

BY_HAND = {
    "facts.json": """{"camera": {"name": "D435", "serial": "8172", "source": "live", "width": 848,
        "height": 480, "fx": 425, "fy": 425, "cx": 424.5, "cy": 240, "model": "brown_conrady",
        "coeffs": [0, 0, 0, 0, 0], "baseline_m": 0.05, "depth_scale_m": 1e-3},
        "tape_sigma_m": 1e-3, "caliper_m": 6e-2, "versions": {},
        "stacks": [{"distance_m": 0.3, "window": [420, 238, 2, 1]}]}""",
    "claims.json": """{"rows": [{"distance_m": 0.3, "depth_bias_mm": null, "depth_bias_se_mm": null,
        "depth_std_mm": 0.5, "depth_std_se_mm": null, "invalid_fraction": 0}], "sigma_d_px": null,
        "sigma_d_interval_px": null, "exponent": null, "exponent_interval": null, "plot": null}""",
    "conclusion.json": """{"distance_m": 0.45, "frames": 30, "dominates": "noise",
        "paragraph": "Z\\u00b2\\n"}""",
    "outcomes.json": """{"depth_noise.width": {"right": true, "attempts": 1}}""",
}
COUNTS = b"{'descr': '<u2', 'fortran_order': False, 'shape': (2, 1, 2), }\n"
TIMES = b"{'descr': '<f8', 'fortran_order': False, 'shape': (2,), }\n"


def test_a_bundle_written_by_hand() -> None:
    """Format 1 from FORMAT.md alone, without coursekit and NumPy: it must be read for ever."""
    members = {name: text.encode() for name, text in BY_HAND.items()}
    start = b"\x93NUMPY\x01\x00"
    members["depth_0.npy"] = start + struct.pack("<H", len(COUNTS)) + COUNTS
    members["depth_0.npy"] += struct.pack("<4H", 300, 301, 0, 65535)
    members["times_0.npy"] = start + struct.pack("<H", len(TIMES)) + TIMES
    members["times_0.npy"] += struct.pack("<2d", 0.5, 0.75)
    manifest: dict[str, Any] = {"format": 1, "exercise": "studio_1", "student": "Zoë"}
    manifest |= {"made": "2026-03-01T12:00:00+00:00", "members": {}}
    for name, content in members.items():
        digest = hashlib.sha256(content).hexdigest()
        manifest["members"][name] = {"bytes": len(content), "sha256": digest}
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
        archive.writestr("manifest.json", json.dumps(manifest))
    found = read_bundle(buffer.getvalue())
    assert found.student == "Zoë"
    assert found.camera.fx == 425
    assert found.claims == Claims((TableRow(0.3, depth_std_mm=0.5, invalid_fraction=0),))
    assert found.conclusion == Conclusion(0.45, 30, "noise", "Z²\n")
    assert found.outcomes == {"depth_noise.width": Outcome(True, 1)}
    assert found.stacks[0].counts.tolist() == [[[300, 301]], [[0, 65535]]]
    assert found.stacks[0].times_s.tolist() == [0.5, 0.75]


def test_the_page_on_the_format_and_the_schema_agree() -> None:
    """The page's examples are what the schema wants, with all of its keys, and so are its caps."""
    page = FORMAT.read_text(encoding="utf-8")
    examples = list(map(json.loads, re.findall(r"```json\n(.*?)```", page, re.DOTALL)))
    names = list(SCHEMA["properties"])
    assert len(examples) == len(names) == 5
    for name, example in zip(names, examples, strict=True):
        for entry in example.get("members", {}).values():
            entry["sha256"] = 64 * "0"  # the page cuts it short
        check_schema({name: example})
        assert keys(example) >= keys_of_schema(SCHEMA["properties"][name])
    for name in MEMBERS:
        assert re.sub("[01]", "0", name) in page
    for cap in ("5 MiB", "32 members", "6 MiB", "100 times", "128 KiB", "8 deep"):
        assert cap in page, cap
    for cap in (MAX_FRAMES, MAX_SAMPLES, MAX_ALL_SAMPLES):
        assert f"{cap:,}" in page, cap
    definitions, properties = SCHEMA["definitions"], SCHEMA["properties"]
    side = definitions["side"]["maximum"]
    assert f"| a window | {side} x {side} px |" in page
    facts, paragraph = (properties[n]["properties"] for n in ("facts.json", "conclusion.json"))
    assert f"| distances | {facts['stacks']['maxItems']} |" in page
    lengths = definitions["name"]["maxLength"], paragraph["paragraph"]["maxLength"]
    assert "| names, the paragraph | {} and {:,} characters |".format(*lengths) in page
    assert "bundle.schema.json" in page
    assert len(page.splitlines()) <= 130


def keys(example: Any) -> set[str]:
    """All keys in JSON."""
    inner = example.values() if isinstance(example, dict) else example
    if not isinstance(example, (dict, list)):
        return set()
    return set(example if isinstance(example, dict) else ()).union(*map(keys, inner))


def keys_of_schema(schema: Any) -> set[str]:
    """All keys of objects that a schema names."""
    if isinstance(schema, list):
        return set().union(*map(keys_of_schema, schema))
    if not isinstance(schema, dict):
        return set()
    return set(schema.get("properties", ())).union(*map(keys_of_schema, schema.values()))


# --- contents ---


def test_numbers_of_numpy_are_written_as_plain_ones() -> None:
    row = TableRow(np.float32(0.5), depth_std_mm=np.float64(1.5), invalid_fraction=np.int64(0))
    claims = Claims((row,), sigma_d_interval_px=np.array([0.1, 0.2]))
    found = read_bundle(bundle_bytes(submission(claims=claims))).claims
    assert found == Claims((TableRow(0.5, None, None, 1.5, None, 0),), None, (0.1, 0.2))
    assert {type(value) for value in asdict(found.rows[0]).values()} == {float, int, type(None)}


ONE = {"distance_m": 0.3, "window": (0, 0, 1, 1), "times_s": np.zeros(1)}
DARK = np.ones((1, 1, 1), np.uint16)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"claims": Claims((TableRow(None),))}, r"rows\[0\].distance_m: got None"),
        ({"claims": Claims((TableRow(0.3, float("nan")),))}, r"rows\[0\].depth_bias_mm: got .*NaN"),
        ({"claims": Claims((TableRow(0.3, 1 + 2j),))}, r"rows\[0\].depth_bias_mm: got"),
        ({"claims": Claims((TableRow(0.3, [1.0, 2.0]),))}, r"rows\[0\].depth_bias_mm: got"),
        ({"claims": Claims((TableRow(0.3), TableRow(0.3)))}, "rows: a distance is there twice"),
        ({"claims": Claims(exponent_interval=(2, float("inf")))}, r"exponent_interval\[1\]: got"),
        ({"plot": Plot((0.3,), (1.0,), ())}, "plot: "),
        ({"plot": Plot(0.3, 1.0, 1.0)}, "plot.distances_m: "),
        ({"plot": Plot([[0.3]], [[1.0]], [[1.0]])}, r"plot.distances_m\[0\]: "),
        ({"conclusion": Conclusion(dominates="Bias")}, "dominates: got 'Bias', want one of bias"),
        ({"conclusion": Conclusion(paragraph="a\r\nb")}, "paragraph: "),
        ({"conclusion": Conclusion(frames=2.5)}, "frames: got 2.5"),
        ({"conclusion": Conclusion(450)}, "distance_m: got 450; .* did you mean 0.45?"),
        ({"outcomes": {"a": Outcome("yes", 1)}}, "a.right: got 'yes'"),
        ({"stacks": (Stack(**ONE, counts=DARK.astype(np.float32)),)}, "depth_0.npy holds '<f4'"),
        ({"stacks": (Stack(**ONE, counts=DARK[0]),)}, "depth_0.npy holds .* shape"),
        ({"stacks": (Stack(**ONE | {"times_s": np.zeros(2)}, counts=DARK),)}, "depth_0.npy has"),
        ({"stacks": (Stack(**ONE | {"window": (0, 0, 1)}, counts=DARK),)}, r"stacks\[0\].window: "),
        ({"stacks": submission().stacks * 2}, "stacks: a distance is there twice"),
        ({"student": ""}, "student: got '', want some letters"),
        ({"student": None}, "student: got None"),
        ({"outcomes": {"A!": Outcome(True, 1)}}, "has a name that cannot be, want names like"),
        ({"versions": {"numpy": 2}}, "versions.numpy: got 2"),
        ({"made": "yesterday"}, "made: got 'yesterday', want UTC like"),
        ({"made": "1970-01-01T00:00:00+00:00"}, "made: got"),
    ],
)
def test_what_no_bundle_can_hold_is_named_when_it_is_packed(changes: Any, name: str) -> None:
    with pytest.raises(Refused, match=rf"^{name}") as error:
        bundle_bytes(submission(**changes))
    assert len(str(error.value)) < 300


def test_refusals_survive_the_way_from_a_worker() -> None:
    with pytest.raises(Refused) as caught:
        read_bundle(b"")
    again = pickle.loads(pickle.dumps(caught.value))
    assert (again.reason, str(again)) == (
        "not_a_zip",
        "The file is no zip, or cut off; copy or download it again.",
    )


def test_other_tools_may_repack_it() -> None:
    """Stored instead of deflated, in another order, with the flag that names are UTF-8."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name in reversed(MEMBERS):
            archive.writestr(zipfile.ZipInfo(name, (2026, 3, 1, 12, 0, 0)), MEMBERS[name])
    data = bytearray(buffer.getvalue())
    for signature, at in ((b"PK\x03\x04", 7), (b"PK\x01\x02", 9)):
        for found in re.finditer(re.escape(signature), bytes(data)):
            data[found.start() + at] = 0x08
    assert parts(bytes(data)) == MEMBERS
    assert same(read_bundle(bytes(data)), submission())
