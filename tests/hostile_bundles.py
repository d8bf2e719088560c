"""Bundles made to do harm, or damaged: for each kind its bytes, and the reason of its refusal.

`ZOE` is a small honest one, a bundle of some 3 kB; most kinds are it with one thing wrong and
everything else right (hashes and checksums too), so that what refuses them is the check that they
are about.
"""

import bz2
import hashlib
import io
import json
import os
import pickle
import struct
import tomllib
import zipfile
import zlib
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from coursekit.submission import format as bundle
from coursekit.submission.format import Outcome, Stack, TableRow, array_bytes, zip_bytes

BUNDLES = tomllib.loads(Path(__file__).with_name("bundles.toml").read_text(encoding="utf-8"))
LENS = (848, 480, 425.0, 425.5, 424.0, 240.0, "none", (0.0,) * 5)
CAMERA = bundle.CameraFacts("Simulated D435", "seed-7", "simulated", *LENS, 0.05, 0.001)
Parts = dict[str, bytes]
Kinds = dict[str, tuple[str, bytes]]


def small_stacks() -> list[Stack]:
    """Two distances, 3 frames of 5 x 4 px each."""
    rng = np.random.default_rng(1)
    counts = [rng.integers(mm - 3, mm + 3, (3, 4, 5)).astype(np.uint16) for mm in (300, 600)]
    window, times = (420, 238, 5, 4), np.arange(3) / 30
    return [Stack(z, window, raw, times) for z, raw in zip((0.3, 0.6), counts, strict=True)]


ZOE = bundle.Submission(
    student="Zoë O'Neill-Łukasiewicz",
    made="2026-03-01T12:00:00+00:00",
    versions={"python": "3.12.1", "numpy": "2.4.0"},
    camera=CAMERA,
    tape_sigma_m=0.001,
    caliper_m=0.06,
    stacks=small_stacks(),
    claims=bundle.Claims(
        (TableRow(0.3, 0.5, 0.02, 1.25, 0.01, 0.0), TableRow(0.6, depth_std_mm=4.5)),
        *(0.08, (0.07, 0.09), 2.1, (1.5, 2.75)),
    ),
    plot=bundle.Plot((0.3, 0.6), (1.25, 4.5), (1.2, 4.8)),
    conclusion=bundle.Conclusion(0.45, 30, "bias", "Bias.\nIt stays; noise averages down."),
    outcomes={"depth_noise.width": Outcome(True, 2), "depth_std": Outcome(False, 1)},
)


# --- taking a bundle apart, and packing it again ---


def parts(data: bytes) -> Parts:
    """The members of a bundle, by name."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


HONEST = bundle.bundle_bytes(ZOE)
MEMBERS = parts(HONEST)
DIRECTORY, END_RECORD = HONEST.index(b"PK\x01\x02"), HONEST.rindex(b"PK\x05\x06")


def hashed(members: Parts) -> Parts:
    """These members with a manifest that lists them as they are."""
    manifest = json.loads(members["manifest.json"])
    manifest["members"] = {
        name: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
        for name, content in members.items()
        if name != "manifest.json"
    }
    return members | {"manifest.json": json.dumps(manifest).encode()}


def with_member(name: str, content: bytes) -> bytes:
    """The honest bundle, but this member has another content, or is there besides; rehashed."""
    return zip_bytes(hashed(MEMBERS | {name: content}))


def unhashed(name: str, content: bytes) -> bytes:
    """The honest bundle with another content of this member, and its manifest left as it was."""
    return zip_bytes(MEMBERS | {name: content})


GONE = "(gone)"


def placed(content: Any, path: tuple[Any, ...], value: Any) -> Any:
    """JSON with another value at a path, or with none there where the value is GONE."""
    if not path:
        return value
    copy = content.copy()
    copy[path[0]] = placed(content[path[0]], path[1:], value) if path[1:] else value
    if copy[path[0]] == GONE:
        del copy[path[0]]
    return copy


def with_json(name: str, content: Any) -> bytes:
    """The honest bundle with another JSON in this member; all but the manifest are rehashed."""
    pack = unhashed if name == "manifest.json" else with_member
    return pack(name, json.dumps(content).encode())


def with_text(name: str, old: str, new: str) -> bytes:
    """The honest bundle with a piece of a member's text replaced; the piece must be there."""
    written = MEMBERS[name].decode()
    assert old in written, (name, old)
    return with_member(name, written.replace(old, new, 1).encode())


def npy(descr="'<u2'", shape="(3, 4, 5)", fortran="False", content=bytes(120), version=b"\1\0"):
    """A .npy file with any header."""
    header = f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + content


def zipped(members: Parts, of: str = "", streamed: bool = False, **attributes: Any) -> bytes:
    """A zip as `zipfile` writes it, where attributes `of` one member are others.

    streamed: to something that cannot seek, so that sizes stand behind each member.
    """
    buffer = io.BytesIO()
    pipe = SimpleNamespace(write=buffer.write, flush=buffer.flush)
    with zipfile.ZipFile(pipe if streamed else buffer, "w") as archive:
        for name, content in members.items():
            info = zipfile.ZipInfo(name)
            for attribute, value in attributes.items() if name == of else ():
                setattr(info, attribute, value)
            archive.writestr(info, content)
    return buffer.getvalue()


# --- lies in the zip's headers ---

LOCAL = {"flags": (6, 2), "method": (8, 2), "crc": (14, 4), "packed": (18, 4), "size": (22, 4)}
CENTRAL = {k: (at + 2, n) for k, (at, n) in LOCAL.items()}
CENTRAL |= {"disk": (34, 2), "attributes": (38, 4), "offset": (42, 4)}
END = {"disk": (4, 2), "here": (8, 2), "count": (10, 2), "size": (12, 4), "start": (16, 4)}


def headers(data: bytes, name: str) -> tuple[int, int]:
    """Where a member's local header is, and its entry in the directory."""
    entry = data.rindex(b"PK\x01\x02", 0, data.rindex(name.encode()))
    return int.from_bytes(data[entry + 42 : entry + 46], "little"), entry


def patched(data: bytes, header: int, table: dict[str, tuple[int, int]], **values: int) -> bytes:
    """The data, where the header that lies there says otherwise, in what its table knows."""
    for field in table.keys() & values.keys():
        at, size = header + table[field][0], table[field][1]
        number = (values[field] % 256**size).to_bytes(size, "little")
        data = data[:at] + number + data[at + size :]
    return data


def lying(name: str, where: str = "both", **values: int) -> bytes:
    """The honest bundle, where headers of a member ("local", "central", "both") say otherwise."""
    local, central = headers(HONEST, name)
    data = HONEST if where == "central" else patched(HONEST, local, LOCAL, **values)
    return data if where == "local" else patched(data, central, CENTRAL, **values)


def lying_end(**values: int) -> bytes:
    """The honest bundle, where the zip's end record says otherwise."""
    return patched(HONEST, END_RECORD, END, **values)


def inserted(at: int, junk: bytes) -> bytes:
    """The honest bundle with junk at a place, and all offsets behind it moved along."""
    data = HONEST
    for local, entry in (headers(HONEST, name) for name in MEMBERS):
        data = patched(data, entry, CENTRAL, offset=local + len(junk) * (local >= at))
    data = patched(data, END_RECORD, END, start=DIRECTORY + len(junk) * (at <= DIRECTORY))
    return data[:at] + junk + data[at:]


def with_deflated(stream: bytes, size: int, crc: int) -> bytes:
    """A zip whose one member, the manifest, has this deflate stream, size and checksum."""
    fields = (20, 0, 8, 0, 33, crc, len(stream), size, 13)
    local = b"PK\x03\x04" + struct.pack("<5H3L2H", *fields, 0) + b"manifest.json" + stream
    entry = b"PK\x01\x02" + struct.pack("<6H3L5H2L", 20, *fields, 0, 0, 0, 0, 0, 0)
    counts = (0, 0, 1, 1, len(entry) + 13, len(local), 0)
    return local + entry + b"manifest.json" + b"PK\x05\x06" + struct.pack("<4H2LH", *counts)


def deflated(content: bytes) -> bytes:
    """A raw deflate stream."""
    stream = zlib.compressobj(9, zlib.DEFLATED, -15)
    return stream.compress(content) + stream.flush()


def with_stream(content: bytes, size: int) -> bytes:
    """As `with_deflated`: `content` compressed, declared to be `size` bytes."""
    return with_deflated(deflated(content), size, zlib.crc32(content))


def junk_behind_stream() -> bytes:
    """The honest bundle with four bytes behind a member's compressed content, counted to it."""
    local, central = headers(HONEST, "facts.json")
    packed = int.from_bytes(HONEST[local + 18 : local + 22], "little")
    data = inserted(local + 30 + len("facts.json") + packed, b"junk")
    data = patched(data, local, LOCAL, packed=packed + 4)
    return patched(data, central + 4, CENTRAL, packed=packed + 4)


class _Shell:
    """A pickle that ends the process that opens it: the tests would not survive it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (3,)


def _a_million(seed: int) -> np.ndarray:
    """Depths of 244 frames of 64 x 64 px, nearly all the same: quickly packed."""
    return np.uint16(300) + (np.random.default_rng(seed).random((244, 64, 64)) < 0.04)


# --- the kinds ---


@cache
def hostile() -> Kinds:
    """Every kind, each once: what it is, the reason that its refusal has to give, and its bytes.

    Without a reason it is read: what was added to it is nowhere in what comes out.
    """
    groups = (_files, _zips, _lies, _headers, _names, _hashes, _jsons, _values, _arrays)
    return {name: kind for group in groups for name, kind in group().items()}


def _files() -> Kinds:
    return {
        "nothing": ("not_a_zip", b""),
        "a text": ("not_a_zip", b"Here is my homework.\n"),
        "a pickle": ("not_a_zip", pickle.dumps(_Shell())),
        "bzip2": ("not_a_zip", bz2.compress(HONEST)),
        "6 MiB": ("too_large", HONEST + bytes(6 * 2**20)),
        "half": ("not_a_zip", HONEST[: len(HONEST) // 2]),
        "without its last byte": ("not_a_zip", HONEST[:-1]),
        "a byte behind": ("not_plain", HONEST + b"\0"),
        "a zip and most of another": ("not_a_zip", HONEST + HONEST[:-1]),
        "a zip and another": ("not_plain", HONEST + HONEST),
        "a zip's comment": ("not_plain", HONEST[:-2] + b"\x03\x00abc"),
        "a program before": ("not_plain", b"#!/bin/sh\nexit\n" + HONEST),
        "junk before, offsets moved": ("not_plain", inserted(0, b"GIF89a")),
    }


def _zips() -> Kinds:
    second = headers(HONEST, "facts.json")[0]
    large = HONEST[:END_RECORD] + b"PK\x06\x07" + bytes(16) + HONEST[END_RECORD:]  # zip64's locator
    large = patched(large, END_RECORD + 20, END, size=END_RECORD + 20 - DIRECTORY)
    twice = zip_bytes({"facts.json": b"{}", "factz.json": b"{}"})  # zipfile would warn
    return {
        "no members": ("missing_member", zip_bytes({})),
        "33 members": ("too_large", zip_bytes({f"depth_{i}.npy": b"" for i in range(33)})),
        "junk between members": ("not_plain", inserted(second, b"junk")),
        "junk before the directory": ("not_plain", inserted(DIRECTORY, b"junk")),
        "the directory elsewhere": ("not_plain", lying_end(start=DIRECTORY + 1)),
        "the directory damaged": ("not_a_zip", HONEST.replace(b"PK\x01\x02", b"PK\x01\x03")),
        "a large zip's locator": ("not_a_zip", large),
        "streamed": ("not_plain", zipped(MEMBERS, streamed=True)),
        "extra fields": ("not_plain", zipped(MEMBERS, "facts.json", extra=b"\x55\x54\x01\0\0")),
        "a member's comment": ("not_plain", zipped(MEMBERS, "facts.json", comment=b"hello")),
        "a name twice": ("not_plain", twice.replace(b"factz", b"facts")),
    }


def _lies() -> Kinds:
    members = {
        kind: (reason, lying(of, **values))
        for kind, (reason, of, values) in BUNDLES["lying_members"].items()
    }
    ends = BUNDLES["lying_ends"].items()
    return members | {kind: ("not_plain", lying_end(**values)) for kind, values in ends}


def _headers() -> Kinds:
    name, facts = "facts.json", MEMBERS["facts.json"]
    zeros, noise = bytes(300_000), np.random.default_rng(3).bytes(300_000)
    link, pipe = 0o120777 << 16, 0o010644 << 16
    no_local = b"PK\x03\x04" + HONEST[4:].replace(b"PK\x03\x04", b"PK\x03\x05")
    dark = hashed(MEMBERS | {"depth_0.npy": array_bytes(np.zeros((240, 64, 64), np.uint16))})
    bomb = zipped(dark, "depth_0.npy", compress_type=zipfile.ZIP_DEFLATED)  # 2 MB in 2 kB
    return {
        "a symlink": ("not_plain", zipped(MEMBERS, name, external_attr=link)),
        "a pipe": ("not_plain", zipped(MEMBERS, name, external_attr=pipe)),
        "a folder by attribute": ("not_plain", zipped(MEMBERS, name, external_attr=0x10)),
        "LZMA": ("not_plain", zipped(MEMBERS, name, compress_type=zipfile.ZIP_LZMA)),
        "a zip bomb by ratio": ("too_large", bomb),
        "300 kB of JSON": ("too_large", with_member(name, noise)),
        "two names": ("damaged", HONEST.replace(b"facts.json", b"FACTS.json", 1)),
        "no local header": ("damaged", no_local),
        "more than declared": ("damaged", with_stream(facts * 9, size=len(facts))),
        "a bomb behind a lie": ("damaged", with_stream(zeros, size=9_000)),
        "less than declared": ("damaged", with_stream(facts, size=len(facts) + 1)),
        "junk behind the stream": ("", junk_behind_stream()),
        "no deflate stream": ("damaged", with_deflated(b"\xff" * 90, 100, 0)),
        "half a stream": ("damaged", with_deflated(deflated(facts)[:-9], len(facts), 0)),
        "a bit of the content": ("damaged", with_deflated(deflated(facts), len(facts), 1)),
    }


def _names() -> Kinds:
    names = BUNDLES["names"] | {"a long name": "a" * 60_000}
    kinds = {kind: zip_bytes(MEMBERS | {name: b""}) for kind, name in names.items()}
    return {k: ("unknown_member", data.replace(b"json?", b"json\0")) for k, data in kinds.items()}


def _hashes() -> Kinds:
    depth, claims = MEMBERS["depth_0.npy"], MEMBERS["claims.json"].replace(b"4.5", b"4.6", 1)
    depth = depth[:-2] + bytes([depth[-2] ^ 1]) + depth[-1:]
    gone = {k: v for k, v in MEMBERS.items() if k != "claims.json"}
    resized = placed(json.loads(MEMBERS["manifest.json"]), ("members", "depth_0.npy", "bytes"), 9)
    counts, times = _a_million(2), np.arange(244) / 30
    stacks = [Stack(z, (400, 200, 64, 64), counts, times) for z in (0.3, 0.6)]
    full = parts(bundle.bundle_bytes(replace(ZOE, stacks=stacks)))  # as much as a bundle may hold
    full["depth_1.npy"] = full["depth_1.npy"][:-1] + bytes([full["depth_1.npy"][-1] ^ 1])
    return {
        "one raw value changed": ("wrong_hash", unhashed("depth_0.npy", depth)),
        "one claim changed": ("wrong_hash", unhashed("claims.json", claims)),
        "members swapped": ("wrong_hash", unhashed("depth_0.npy", MEMBERS["depth_1.npy"])),
        "a wrong size in the manifest": ("wrong_hash", with_json("manifest.json", resized)),
        "as large as can be, last value changed": ("wrong_hash", zip_bytes(full)),
        "a member missing": ("missing_member", zip_bytes(gone)),
        "a member missing everywhere": ("missing_member", zip_bytes(hashed(gone))),
        "no manifest": ("missing_member", zip_bytes({"facts.json": b"{}"})),
        "a member not listed": ("unlisted_member", unhashed("depth_2.npy", b"")),
        "an array of no distance": ("unlisted_member", with_member("depth_2.npy", npy())),
    }


def _jsons() -> Kinds:
    name = "claims.json"
    claims = MEMBERS[name]
    not_json = {kind: text.encode("latin-1") for kind, text in BUNDLES["not_json"].items()} | {
        "half a JSON": claims[:40],
        "a byte order mark": b"\xef\xbb\xbf" + claims,
        "a string without end": b'"' + b'\\"' * 65_000,
        "UTF-16": claims.decode().encode("utf-16"),
        "deep lists": b"[" * 60_000 + b"]" * 60_000,
        "deep objects": b'{"a":' * 20_000 + b"1" + b"}" * 20_000,
    }
    bad_value = {
        "40,000 strings": b"[" + b'"",' * 40_000 + b'""]',
        "wide lists": b"[" + b"[]," * 40_000 + b"[]]",
        "a list for an object": b"[1, 2]",
        "a number for an object": b"3",
        "a name of 5,000 letters": b'{"' + b"a" * 5_000 + b'": 1}',
        "8,000 keys": json.dumps(dict.fromkeys(map(str, range(8_000)))).encode(),
    }
    many = {f"a{i}": 1 for i in range(101)}
    return {
        **{kind: ("not_json", with_member(name, data)) for kind, data in not_json.items()},
        **{kind: ("bad_value", with_member(name, data)) for kind, data in bad_value.items()},
        "101 outcomes": ("bad_value", with_json("outcomes.json", many)),
        "NaN": ("bad_value", with_text(name, "4.5", "NaN")),
        "infinity": ("bad_value", with_text(name, "4.5", "-Infinity")),
        "1e999": ("bad_value", with_text(name, "4.5", "1e999")),
        "an integer of 5,000 digits": ("not_json", with_text(name, "4.5", "9" * 5_000)),
        "a number of 5,000 digits": ("", with_text(name, "4.5", "0." + "9" * 5_000)),
        "a key twice": ("not_json", with_text(name, '"exponent"', '"sigma_d_px": 1, "exponent"')),
    }


WRONG_VALUES = BUNDLES["wrong_values"]
WRONG_VALUES["manifest.json"]["half a character"] = ["student", "Zo\ud83d"]  # no TOML holds it
WRONG_VALUES["conclusion.json"]["a long paragraph"] = ["paragraph", "a b " * 1_300]


def _values() -> Kinds:
    reasons = dict.fromkeys(("a later format", "no format"), "other_format")
    reasons |= {"a window of another size": "bad_array"}
    return {
        kind: (reasons.get(kind, "bad_value"), with_json(name, placed(content, tuple(path), value)))
        for name, wrong in WRONG_VALUES.items()
        for content in [json.loads(MEMBERS[name])]
        for kind, (*path, value) in wrong.items()
    }


def _arrays() -> Kinds:
    np.save(pickled := io.BytesIO(), np.array([_Shell()], dtype=object), allow_pickle=True)
    depth = {
        "a pickled object array": pickled.getvalue(),
        "a zip for an array": HONEST,
        "a header of a list of 300 lists": npy(shape="[" * 300 + "]" * 300),
        "sixty dimensions": npy(shape=f"({'1, ' * 60})"),
        "a dimension of 300 digits": npy(shape=f"({'9' * 300}, 4, 5)"),
    }
    given = {
        kind: {k: bytes(v) if k in ("content", "version") else v for k, v in header.items()}
        for kind, header in BUNDLES["array_headers"].items()
    }
    depth |= {kind: npy(**header) for kind, header in given.items()}
    depth |= {kind: text.encode("latin-1") for kind, text in BUNDLES["no_arrays"].items()}
    wild = {"NaN for a time": np.nan, "infinity for a time": np.inf, "a time of 1e300": 1e300}
    times = {k: npy("'<f8'", "(3,)", content=struct.pack("<3d", 0, 1, t)) for k, t in wild.items()}
    kinds = {k: ("bad_array", with_member("depth_0.npy", data)) for k, data in depth.items()}
    kinds |= {k: ("bad_value", with_member("times_0.npy", data)) for k, data in times.items()}
    huge, clock = array_bytes(_a_million(4)), array_bytes(np.arange(244) / 30)
    three = {f"depth_{i}.npy": huge for i in range(3)} | {f"times_{i}.npy": clock for i in range(3)}
    stacks = [{"distance_m": 0.3 + i, "window": [0, 0, 64, 64]} for i in range(3)]
    facts = json.dumps(json.loads(MEMBERS["facts.json"]) | {"stacks": stacks}).encode()
    all_of = zip_bytes(hashed(MEMBERS | three | {"facts.json": facts}))
    return kinds | {"three million values": ("bad_value", all_of)}
