"""Bundles: what goes in comes out, the same bytes every time, whatever version wrote the arrays."""

import hashlib
import io
import json
import re
import struct
from dataclasses import asdict, fields, replace
from pathlib import Path

import numpy as np
import pytest
from hostile_bundles import BUNDLES, HONEST, MEMBERS, ZOE, hashed, unhashed, with_member, zipped

from coursekit import results
from coursekit.submission import format as bundle
from coursekit.submission.format import Claims, Conclusion, Outcome, Plot, Refused, Stack, TableRow


def same(one: bundle.Submission, other: bundle.Submission) -> bool:
    """Equal in every field, and every array bit for bit."""
    plain = [field.name for field in fields(one) if field.name != "stacks"]
    return all(getattr(one, name) == getattr(other, name) for name in plain) and all(
        (a.distance_m, a.window) == (b.distance_m, b.window)
        and np.array_equal(a.counts, b.counts)
        and np.array_equal(a.times_s, b.times_s)
        for a, b in zip(one.stacks, other.stacks, strict=True)
    )


# --- there and back ---


def test_what_goes_in_comes_out(tmp_path):
    path = tmp_path / "new" / "studio_1_zoe.zip"
    results.write_bytes(path, bundle.bundle_bytes(ZOE))
    assert [p.name for p in path.parent.iterdir()] == [path.name]  # nothing left over
    for found in (bundle.read_bundle(path), bundle.read_bundle(path.read_bytes())):
        assert same(found, ZOE)
        assert found.stacks[0].counts.dtype == np.uint16
        assert found.stacks[0].times_s.dtype == np.float64
        assert not found.stacks[0].counts.flags.writeable


def square(values) -> list[Stack]:
    """One stack a distance of 100 frames of 40 x 40 px, from what broadcasts to that."""
    counts = [np.broadcast_to(one, (100, 40, 40)).astype(np.uint16) for one in values]
    times = np.arange(100) / 30
    return [Stack(0.3 + 0.15 * i, (400, 220, 40, 40), c, times) for i, c in enumerate(counts)]


ODD_NUMBERS = TableRow(0.1 + 0.2, -0.0, 5e-324, 1 / 3, 1e-9, -7.0)
NOISE = np.random.default_rng(5).normal(300, 10, (3, 100, 40, 40)).round()
UNUSUAL = {
    "nothing claimed": {"plot": None, "claims": Claims(), "conclusion": Conclusion()},
    "nothing answered": {"outcomes": {}},
    "no stacks": {"stacks": ()},
    "no prediction": {"plot": Plot((0.3, 0.45), (0.3, 0.6), None)},
    "no baseline": {"camera": replace(ZOE.camera, baseline_m=None, serial="")},
    "a formula": {"student": "=1+1"},  # what is a formula or a tag elsewhere is only text here
    "a tag": {"student": "<script>alert(1)</script>"},
    "letters": {"student": "O'Brien; DROP TABLE -- 王小明 مریم"},
    "a long text": {"conclusion": Conclusion(paragraph="\t" + "ǅ\n" * 2_000)},
    "odd numbers": {"claims": Claims((ODD_NUMBERS,))},
    "as the exercise asks": {"stacks": square(NOISE)},
    # Weak, but honest, and no zip bomb: it is stored, for deflate shrinks it 800 times.
    "all invalid": {"stacks": square([0])},
    "frozen": {"stacks": square([300])},
    "frozen at most": {"stacks": square([65535])},
}


@pytest.mark.parametrize("kind", UNUSUAL)
def test_unusual_but_honest(kind):
    given = replace(ZOE, **UNUSUAL[kind])
    data = bundle.bundle_bytes(given)
    assert len(data) < 600_000
    assert same(bundle.read_bundle(data), given)


def test_same_bytes_every_time_however_arrays_lie_in_memory():
    assert bundle.bundle_bytes(ZOE) == bundle.bundle_bytes(bundle.read_bundle(HONEST)) == HONEST
    one, two = ZOE.stacks
    spread = np.repeat(one.times_s, 2)[::2]
    turned = replace(one, counts=np.asfortranarray(one.counts), times_s=spread)
    assert bundle.bundle_bytes(replace(ZOE, stacks=(turned, two))) == HONEST


# --- writing ---


def test_as_much_as_a_submission_may_hold_fits():
    """Every cap of the schema reached at once, depths pure noise: below 5 MiB, and read back."""
    rng = np.random.default_rng(6)
    stacks = [
        Stack(0.3 + i, (0, 0, 9, 9), noise, rng.uniform(0, 1, len(noise)))
        for i, noise in enumerate(rng.integers(0, 65535, (12, 2000, 9, 9), np.uint16))
    ]
    word = "\U0001f9ff\U00010400" * 50  # 100 characters of 4 bytes each
    numbers = (-1 / 3e9,) * 100
    row = dict.fromkeys(asdict(ODD_NUMBERS), 1000000000.0 - 1 / 3)
    packages = [word[:-2] + chr(0x10400 + i // 40) + chr(0x10400 + i % 40) for i in range(100)]
    given = replace(
        ZOE,
        student=word,
        stacks=stacks,
        camera=replace(ZOE.camera, name=word, serial=word, model=word),
        versions=dict.fromkeys(packages, word),
        claims=Claims(tuple(TableRow(**row | {"distance_m": 0.3 + i}) for i in range(12))),
        plot=Plot(numbers, numbers, numbers),
        conclusion=Conclusion(0.3, 10**6, "noise", word[:1] * 4_999 + "1"),
        outcomes={f"{i:03d}_{'a' * 96}": Outcome(False, 10**6) for i in range(100)},
    )
    data = bundle.bundle_bytes(given)
    assert 4e6 < len(data) < 5 * 2**20
    assert same(bundle.read_bundle(data), given)


# --- any change is noticed ---


def changed_once(name: str):
    """A member with one raw value a bit off, or one number of its JSON another, each in turn."""
    content = MEMBERS[name]
    if name.endswith(".npy"):
        for at in range(content.index(b"\n") + 1, len(content), 2 if "depth" in name else 8):
            yield content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :]
    others = {b"true": b"false", b"false": b"true", b"1": b"2"}
    for number in re.finditer(rb"-?\d+(\.\d+)?|true|false", content) if ".json" in name else ():
        yield content[: number.start()] + others.get(number[0], b"1") + content[number.end() :]


@pytest.mark.parametrize("name", [name for name in MEMBERS if name != "manifest.json"])
def test_every_raw_value_and_every_number_claimed_counts(name):
    """Refused, unless the hash is redone."""
    several = list(changed_once(name))
    assert len(several) >= 2
    for changed in several:
        with pytest.raises(Refused, match="does not match its own manifest") as refused:
            bundle.read_bundle(unhashed(name, changed))
        assert refused.value.reason == "wrong_hash"
    if name.endswith(".npy"):
        assert not same(bundle.read_bundle(with_member(name, changed)), ZOE)


# --- NumPy's files, of any version ---


def test_what_numpy_saves_is_read():
    saved = {}
    for i, stack in enumerate(ZOE.stacks):
        for kind, values in (("depth", stack.counts), ("times", stack.times_s)):
            np.save(buffer := io.BytesIO(), values)
            saved[f"{kind}_{i}.npy"] = buffer.getvalue()
    assert same(bundle.read_bundle(bundle.zip_bytes(hashed(MEMBERS | saved))), ZOE)


# --- the format, as it is described ---

COUNTS = b"{'descr': '<u2', 'fortran_order': False, 'shape': (2, 1, 2), }\n"
TIMES = b"{'descr': '<f8', 'fortran_order': False, 'shape': (2,), }\n"


def test_a_bundle_written_by_hand():
    """Format 1 from FORMAT.md alone, without coursekit and NumPy: it must be read for ever."""
    members = {name: text.encode() for name, text in BUNDLES["by_hand"].items()}
    for name, header, values in (
        ("depth_0.npy", COUNTS, struct.pack("<4H", 300, 301, 0, 65535)),
        ("times_0.npy", TIMES, struct.pack("<2d", 0.5, 0.75)),
    ):
        members[name] = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + values
    manifest = {"format": 1, "exercise": "studio_1", "student": "Zoë", "members": {}}
    manifest["made"] = "2026-03-01T12:00:00+00:00"
    for name, content in members.items():
        digest = hashlib.sha256(content).hexdigest()
        manifest["members"][name] = {"bytes": len(content), "sha256": digest}
    found = bundle.read_bundle(zipped(members | {"manifest.json": json.dumps(manifest).encode()}))
    assert found.student == "Zoë"
    assert found.camera.fx == 425
    assert found.claims == Claims((TableRow(0.3, depth_std_mm=0.5, invalid_fraction=0),))
    assert found.conclusion == Conclusion(0.45, 30, "noise", "Z²\n")
    assert found.outcomes == {"depth_noise.width": Outcome(True, 1)}
    assert found.stacks[0].counts.tolist() == [[[300, 301]], [[0, 65535]]]
    assert found.stacks[0].times_s.tolist() == [0.5, 0.75]


def test_the_page_on_the_format_and_the_schema_agree():
    """The page's examples are what the schema wants, with all of its keys, and so are its caps."""
    page = Path(bundle.__file__).with_name("FORMAT.md").read_text(encoding="utf-8")
    examples = list(map(json.loads, re.findall(r"```json\n(.*?)```", page, re.DOTALL)))
    definitions, properties = bundle.SCHEMA["definitions"], bundle.SCHEMA["properties"]
    assert len(examples) == len(properties) == 5
    for name, example in zip(properties, examples, strict=True):
        for entry in example.get("members", {}).values():
            entry["sha256"] = 64 * "0"  # the page cuts it short
        bundle.check_schema({name: example})
        keys = set(re.findall(r'"(\w+)":', json.dumps(example)))
        assert keys >= keys_of_schema(properties[name])
    for name in MEMBERS:
        assert re.sub("[01]", "0", name) in page
    for cap in ("5 MiB", "32 members", "6 MiB", "100 times", "128 KiB", "8 deep"):
        assert cap in page, cap
    for cap in (bundle.MAX_FRAMES, bundle.MAX_SAMPLES, bundle.MAX_ALL_SAMPLES):
        assert f"{cap:,}" in page, cap
    side = definitions["side"]["maximum"]
    assert f"| a window | {side} x {side} px |" in page
    facts, paragraph = (properties[n]["properties"] for n in ("facts.json", "conclusion.json"))
    assert f"| distances | {facts['stacks']['maxItems']} |" in page
    lengths = definitions["name"]["maxLength"], paragraph["paragraph"]["maxLength"]
    assert "| names, the paragraph | {} and {:,} characters |".format(*lengths) in page
    assert "bundle.schema.json" in page
    assert len(page.splitlines()) <= 130


def keys_of_schema(schema) -> set[str]:
    """All keys of objects that a schema names."""
    if isinstance(schema, list):
        return set().union(*map(keys_of_schema, schema))
    if not isinstance(schema, dict):
        return set()
    return set(schema.get("properties", ())).union(*map(keys_of_schema, schema.values()))


# --- contents ---


DARK = Stack(0.3, (0, 0, 1, 1), np.ones((1, 1, 1), np.uint16), np.zeros(1))
CANNOT_BE = [
    ("claims", Claims((TableRow(None),)), r"rows\[0\].distance_m: got None"),
    ("claims", Claims((TableRow(0.3, np.nan),)), r"rows\[0\].depth_bias_mm: got .*NaN"),
    ("claims", Claims((TableRow(0.3, 1 + 2j),)), r"rows\[0\].depth_bias_mm: got"),
    ("claims", Claims((TableRow(0.3, [1.0, 2.0]),)), r"rows\[0\].depth_bias_mm: got"),
    ("claims", Claims((TableRow(0.3), TableRow(0.3))), "rows: a distance is there twice"),
    ("claims", Claims(exponent_interval=(2, np.inf)), r"exponent_interval\[1\]: got"),
    ("plot", Plot((0.3,), (1.0,), ()), "plot: "),
    ("plot", Plot(0.3, 1.0, 1.0), "plot.distances_m: "),
    ("plot", Plot([[0.3]], [[1.0]], [[1.0]]), r"plot.distances_m\[0\]: "),
    ("conclusion", Conclusion(dominates="Bias"), "dominates: got 'Bias', want one of bias"),
    ("conclusion", Conclusion(paragraph="a\r\nb"), "paragraph: "),
    ("conclusion", Conclusion(frames=2.5), "frames: got 2.5"),
    ("conclusion", Conclusion(450), "distance_m: got 450; .* did you mean 0.45?"),
    ("outcomes", {"a": Outcome("yes", 1)}, "a.right: got 'yes'"),
    ("outcomes", {"A!": Outcome(True, 1)}, "has a name that cannot be, want names like"),
    ("stacks", [replace(DARK, counts=np.ones((1, 1, 1), np.float32))], "depth_0.npy holds '<f4'"),
    ("stacks", [replace(DARK, counts=DARK.counts[0])], "depth_0.npy holds .* shape"),
    ("stacks", [replace(DARK, times_s=np.zeros(2))], "depth_0.npy has"),
    ("stacks", [replace(DARK, window=(0, 0, 1))], r"stacks\[0\].window: "),
    ("stacks", [DARK, DARK], "stacks: a distance is there twice"),
    ("student", "", "student: got '', want some letters"),
    ("student", None, "student: got None"),
    ("versions", {"numpy": 2}, "versions.numpy: got 2"),
    ("made", "yesterday", "made: got 'yesterday', want UTC like"),
    ("made", "1970-01-01T00:00:00+00:00", "made: got"),
]


@pytest.mark.parametrize(("field", "value", "message"), CANNOT_BE)
def test_what_no_bundle_can_hold_is_named_when_it_is_packed(field, value, message):
    with pytest.raises(Refused, match=rf"^{message}") as error:
        bundle.bundle_bytes(replace(ZOE, **{field: value}))
    assert len(str(error.value)) < 300
