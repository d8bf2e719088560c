"""Bundles made to do harm, or damaged: for each kind its bytes, and the reason of its refusal.

`submission()` is a small honest one; most kinds are it with one thing wrong and everything else
right (hashes and checksums too), so that what refuses them is the check that they are about.
"""

from __future__ import annotations

import bz2
import hashlib
import io
import json
import os
import pickle
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from coursekit.submission.format import (
    CameraFacts,
    Claims,
    Conclusion,
    Outcome,
    Plot,
    Stack,
    Submission,
    TableRow,
    array_bytes,
    bundle_bytes,
    zip_bytes,
)

CAMERA = {
    "name": "Simulated D435",
    "serial": "seed-7",
    "source": "simulated",
    "width": 848,
    "height": 480,
    "fx": 425.0,
    "fy": 425.5,
    "cx": 424.0,
    "cy": 240.0,
    "model": "none",
    "coeffs": (0.0,) * 5,
    "baseline_m": 0.05,
    "depth_scale_m": 0.001,
}
Parts = dict[str, bytes]


def submission(**changes: Any) -> Submission:
    """Two distances, 3 frames of 5 x 4 px each: a bundle of some 3 kB; `changes` by field."""
    rng = np.random.default_rng(1)
    stacks = [
        Stack(
            distance_m=z,
            window=(420, 238, 5, 4),
            counts=rng.integers(1000 * z - 3, 1000 * z + 3, (3, 4, 5)).astype(np.uint16),
            times_s=np.arange(3) / 30,
        )
        for z in (0.3, 0.6)
    ]
    fields = {
        "student": "Zoë O'Neill-Łukasiewicz",
        "made": "2026-03-01T12:00:00+00:00",
        "versions": {"python": "3.12.1", "numpy": "2.4.0"},
        "camera": CameraFacts(**CAMERA),
        "tape_sigma_m": 0.001,
        "caliper_m": 0.06,
        "stacks": stacks,
        "claims": Claims(
            rows=(TableRow(0.3, 0.5, 0.02, 1.25, 0.01, 0.0), TableRow(0.6, depth_std_mm=4.5)),
            sigma_d_px=0.08,
            sigma_d_interval_px=(0.07, 0.09),
            exponent=2.1,
            exponent_interval=(1.5, 2.75),
        ),
        "plot": Plot((0.3, 0.6), (1.25, 4.5), (1.2, 4.8)),
        "conclusion": Conclusion(0.45, 30, "bias", "Bias.\nIt stays; noise averages down."),
        "outcomes": {"depth_noise.width": Outcome(True, 2), "depth_std": Outcome(False, 1)},
    }
    return Submission(**fields | changes)


# --- taking a bundle apart, and packing it again ---


def parts(data: bytes) -> Parts:
    """The members of a bundle, by name."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


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


def with_json(name: str, change: Callable[[Any], Any]) -> bytes:
    """The honest bundle with one JSON member changed in place (or replaced by what returns)."""
    content = json.loads(MEMBERS[name])
    replaced = change(content)
    changed = json.dumps(content if replaced is None else replaced).encode()
    if name == "manifest.json":
        return zip_bytes(MEMBERS | {name: changed})
    return with_member(name, changed)


def with_text(name: str, old: str, new: str) -> bytes:
    """The honest bundle with a piece of a member's text replaced; the piece must be there."""
    written = MEMBERS[name].decode()
    assert old in written, (name, old)
    return with_member(name, written.replace(old, new, 1).encode())


def npy(
    descr: str = "'<u2'",
    shape: str = "(3, 4, 5)",
    fortran: str = "False",
    content: bytes = bytes(120),
    version: bytes = b"\x01\x00",
) -> bytes:
    """A .npy file with any header."""
    header = f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}\n".encode()
    return b"\x93NUMPY" + version + struct.pack("<H", len(header)) + header + content


def packed_by(pack: Callable[[zipfile.ZipFile], object]) -> bytes:
    """A zip that `pack` fills."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        pack(archive)
    return buffer.getvalue()


def with_info(name: str, **attributes: Any) -> bytes:
    """The honest bundle, where the zip says something else about one member."""

    def pack(archive: zipfile.ZipFile) -> None:
        for member, content in MEMBERS.items():
            info = zipfile.ZipInfo(member)
            for attribute, value in attributes.items() if member == name else ():
                setattr(info, attribute, value)
            archive.writestr(info, content)

    return packed_by(pack)


# --- lies in the zip's headers ---

LOCAL = {"flags": (6, 2), "method": (8, 2), "crc": (14, 4), "packed": (18, 4), "size": (22, 4)}
CENTRAL = {k: (at + 2, n) for k, (at, n) in LOCAL.items()} | {
    "disk": (34, 2),
    "attributes": (38, 4),
    "offset": (42, 4),
}
END = {"disk": (4, 2), "here": (8, 2), "count": (10, 2), "size": (12, 4), "start": (16, 4)}


def headers(data: bytes, name: str) -> tuple[int, int]:
    """Where a member's local header is, and its entry in the directory."""
    entry = data.rindex(b"PK\x01\x02", 0, data.rindex(name.encode()))
    return int.from_bytes(data[entry + 42 : entry + 46], "little"), entry


def lying(name: str, where: str = "both", **values: int) -> bytes:
    """The honest bundle, where headers of a member ("local", "central", "both") say otherwise."""
    data = bytearray(HONEST)
    local, central = headers(HONEST, name)
    for field, value in values.items():
        for header, table, chosen in ((local, LOCAL, "local"), (central, CENTRAL, "central")):
            if field in table and where in (chosen, "both"):
                at, size = table[field]
                data[header + at : header + at + size] = value.to_bytes(size, "little")
    return bytes(data)


def lying_end(**values: int) -> bytes:
    """The honest bundle, where the zip's end record says otherwise."""
    data, end = bytearray(HONEST), HONEST.rindex(b"PK\x05\x06")
    for field, value in values.items():
        at, size = END[field]
        data[end + at : end + at + size] = value.to_bytes(size, "little")
    return bytes(data)


def inserted(at: int, junk: bytes, moved: bool) -> bytes:
    """The honest bundle with junk at a place; all offsets behind it moved along, or not."""
    data = bytearray(HONEST)
    end = HONEST.rindex(b"PK\x05\x06")
    if moved:
        places = [headers(HONEST, name)[1] + 42 for name in MEMBERS] + [end + 16]
        for place in places:
            offset = int.from_bytes(data[place : place + 4], "little")
            if offset >= at:
                data[place : place + 4] = (offset + len(junk)).to_bytes(4, "little")
    return bytes(data[:at] + junk + data[at:])


def with_deflated(stream: bytes, size: int, crc: int) -> bytes:
    """A zip whose one member, the manifest, has this deflate stream, size and checksum."""
    fields = (20, 0, 8, 0, 33, crc, len(stream), size, 13)
    local = b"PK\x03\x04" + struct.pack("<5H3L2H", *fields, 0) + b"manifest.json" + stream
    entry = b"PK\x01\x02" + struct.pack("<6H3L5H2L", 20, *fields, 0, 0, 0, 0, 0, 0)
    counts = (0, 0, 1, 1, len(entry) + 13, len(local), 0)
    return local + entry + b"manifest.json" + b"PK\x05\x06" + struct.pack("<4H2LH", *counts)


def deflated(content: bytes) -> bytes:
    stream = zlib.compressobj(9, zlib.DEFLATED, -15)
    return stream.compress(content) + stream.flush()


def with_stream(content: bytes, size: int) -> bytes:
    """As `with_deflated`: `content` compressed, declared to be `size` bytes."""
    return with_deflated(deflated(content), size, zlib.crc32(content))


def junk_behind_stream() -> bytes:
    """The honest bundle with four bytes behind a member's compressed content, counted to it."""
    local, central = headers(HONEST, "facts.json")
    packed = int.from_bytes(HONEST[local + 18 : local + 22], "little")
    data = bytearray(inserted(local + 30 + len("facts.json") + packed, b"junk", moved=True))
    for at in (local + 18, central + 4 + 20):
        data[at : at + 4] = (packed + 4).to_bytes(4, "little")
    return bytes(data)


class _Shell:
    """A pickle that ends the process that opens it: the tests would not survive it."""

    def __reduce__(self) -> tuple[Any, ...]:
        return os._exit, (3,)


def _pickled_array() -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.array([_Shell()], dtype=object), allow_pickle=True)
    return buffer.getvalue()


def _streamed() -> bytes:
    """A zip written to something that cannot seek: sizes stand behind each member."""

    class Pipe(io.RawIOBase):
        data = b""

        def writable(self) -> bool:
            return True

        def write(self, block: Any) -> int:
            self.data += bytes(block)
            return len(block)

    pipe = Pipe()
    with zipfile.ZipFile(pipe, "w") as archive:
        for name, content in MEMBERS.items():
            archive.writestr(name, content)
    return pipe.data


def _bomb() -> bytes:
    """2 MB of zeros in 2 kB, within all sizes."""
    zeros = np.zeros((250, 64, 64), np.uint16)
    return packed_by(
        lambda archive: [
            archive.writestr(name, content, zipfile.ZIP_DEFLATED)
            for name, content in hashed(MEMBERS | {"depth_0.npy": array_bytes(zeros[:240])}).items()
        ]
    )


def _same_name() -> bytes:
    """A zip with the same name twice (zipfile would warn)."""
    return zip_bytes({"facts.json": b"{}", "factz.json": b"{}"}).replace(b"factz", b"facts")


def _set(*path: Any, to: Any) -> Callable[[Any], None]:
    """A change of JSON: what is at this path becomes `to`."""

    def change(content: Any) -> None:
        for key in path[:-1]:
            content = content[key]
        content[path[-1]] = to

    return change


def _without(*path: Any) -> Callable[[Any], None]:
    def change(content: Any) -> None:
        for key in path[:-1]:
            content = content[key]
        del content[path[-1]]

    return change


def _a_million(seed: int) -> np.ndarray:
    """Depths of 244 frames of 64 x 64 px, nearly all the same: quickly packed."""
    return np.uint16(300) + (np.random.default_rng(seed).random((244, 64, 64)) < 0.04)


def full_size(last: int) -> bytes:
    """As much as a bundle may hold, a million depths at two distances, the very last one wrong."""
    counts = _a_million(2)
    window = {"window": (400, 200, 64, 64), "times_s": np.arange(244) / 30}
    stacks = [Stack(distance_m=z, counts=counts, **window) for z in (0.3, 0.6)]
    members = parts(bundle_bytes(submission(stacks=stacks)))
    content = members["depth_1.npy"]
    members["depth_1.npy"] = content[:-1] + bytes([content[-1] ^ last])
    return zip_bytes(members)


HONEST = bundle_bytes(submission())
MEMBERS = parts(HONEST)
DIRECTORY = HONEST.index(b"PK\x01\x02")


@dataclass(frozen=True)
class Hostile:
    """One kind: what it is, its bytes, and the reason that its refusal has to give.

    Without a reason it is read: what was added to it is nowhere in what comes out.
    """

    name: str
    reason: str
    data: bytes


def hostile() -> Iterator[Hostile]:
    """Every kind, each once."""
    groups = (_files, _zips, _headers, _names, _hashes, _jsons, _values, _arrays)
    for group in groups:
        for name, (reason, data) in group().items():
            yield Hostile(name, reason, data)


def _files() -> dict[str, tuple[str, bytes]]:
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
        "junk before, offsets moved": ("not_plain", inserted(0, b"GIF89a", moved=True)),
    }


def _zips() -> dict[str, tuple[str, bytes]]:
    second = headers(HONEST, "facts.json")[0]
    many = zip_bytes({f"depth_{i}.npy": b"" for i in range(33)})
    return {
        "no members": ("missing_member", zip_bytes({})),
        "33 members": ("too_large", many),
        "junk between members": ("not_plain", inserted(second, b"junk", moved=True)),
        "junk before the directory": ("not_plain", inserted(DIRECTORY, b"junk", moved=True)),
        "overlapping members": ("not_plain", lying("facts.json", offset=0)),
        "a member longer than the file": ("not_plain", lying("times_1.npy", packed=10**6)),
        "the directory elsewhere": ("not_plain", lying_end(start=DIRECTORY + 1)),
        "the directory damaged": ("not_a_zip", HONEST.replace(b"PK\x01\x02", b"PK\x01\x03")),
        "a member not counted": ("not_plain", lying_end(here=8, count=8)),
        "a member too many counted": ("not_plain", lying_end(here=10, count=10)),
        "a split zip": ("not_plain", lying_end(disk=1)),
        "a member elsewhere": ("not_plain", lying("facts.json", disk=1)),
        "a large zip": ("not_plain", lying_end(here=0xFFFF, count=0xFFFF)),
        "a large zip's locator": ("not_a_zip", inserted_locator()),
        "a large member": ("too_large", lying("times_1.npy", packed=0xFFFFFFFF)),
        "streamed": ("not_plain", _streamed()),
        "extra fields": ("not_plain", with_info("facts.json", extra=b"\x55\x54\x01\x00\x00")),
        "a member's comment": ("not_plain", with_info("facts.json", comment=b"hello")),
        "a name twice": ("not_plain", _same_name()),
    }


def inserted_locator() -> bytes:
    """An honest bundle with a zip64 locator before its end, counted to the directory."""
    data = inserted(HONEST.rindex(b"PK\x05\x06"), b"PK\x06\x07" + bytes(16), moved=False)
    end, size = len(data) - 22, len(data) - 22 - DIRECTORY
    return data[: end + 12] + size.to_bytes(4, "little") + data[end + 16 :]


def _headers() -> dict[str, tuple[str, bytes]]:
    facts = MEMBERS["facts.json"]
    zeros, noise = bytes(300_000), np.random.default_rng(3).bytes(300_000)
    link, pipe = 0o120777 << 16, 0o010644 << 16
    return {
        "encrypted": ("not_plain", lying("facts.json", flags=1)),
        "strongly encrypted": ("not_plain", lying("facts.json", flags=0x41)),
        "unknown flags": ("not_plain", lying("facts.json", flags=0x20)),
        "a symlink": ("not_plain", with_info("facts.json", external_attr=link)),
        "a pipe": ("not_plain", with_info("facts.json", external_attr=pipe)),
        "a folder by attribute": ("not_plain", with_info("facts.json", external_attr=0x10)),
        "LZMA": ("not_plain", with_info("facts.json", compress_type=zipfile.ZIP_LZMA)),
        "bzip2 member": ("not_plain", lying("facts.json", method=12)),
        "a zip bomb by ratio": ("too_large", _bomb()),
        "a gigabyte declared": ("too_large", lying("depth_0.npy", size=2**30)),
        "300 kB of JSON": ("too_large", with_member("facts.json", noise)),
        "two sizes": ("not_plain", lying("facts.json", where="local", size=9)),
        "two names": ("damaged", HONEST.replace(b"facts.json", b"FACTS.json", 1)),
        "two checksums": ("not_plain", lying("facts.json", where="central", crc=9)),
        "stored, two sizes": ("damaged", lying("facts.json", method=0)),
        "no local header": (
            "damaged",
            b"PK\x03\x04" + HONEST[4:].replace(b"PK\x03\x04", b"PK\x03\x05"),
        ),
        "more than declared": ("damaged", with_stream(facts * 9, size=len(facts))),
        "a bomb behind a lie": ("damaged", with_stream(zeros, size=9_000)),
        "less than declared": ("damaged", with_stream(facts, size=len(facts) + 1)),
        "junk behind the stream": ("", junk_behind_stream()),
        "no deflate stream": ("damaged", with_deflated(b"\xff" * 90, 100, 0)),
        "half a stream": ("damaged", with_deflated(deflated(facts)[:-9], len(facts), 0)),
        "a bit of the content": ("damaged", with_deflated(deflated(facts), len(facts), 1)),
    }


def _names() -> dict[str, tuple[str, bytes]]:
    names = {
        "an absolute path": "/etc/passwd",
        "a Windows path": "C:\\Windows\\system.ini",
        "a network path": "\\\\server\\share",
        "path traversal": "../../.bashrc",
        "path traversal inside": "raw/../../facts.json",
        "path traversal, Windows": "..\\facts.json",
        "a backslash": "raw\\facts.json",
        "a folder": "raw/",
        "a bundle in a folder": "studio_1_Ada/manifest.json",
        "a Mac's zip of a bundle": "__MACOSX/._manifest.json",
        "a Mac's view of a folder": ".DS_Store",
        "a nested archive": "more.zip",
        "a nested archive, NumPy's": "depth.NPZ",
        "a program": "setup.py",
        "a Mac's leftovers": "__MACOSX",
        "another case": "Facts.json",
        "a line end in a name": "facts.json\n",
        "other digits in a name": "depth_٣.npy",
        "a long name": "a" * 60_000,
        "a formula for a name": '=HYPERLINK("http://x")',
    }
    kinds = {kind: zip_bytes(MEMBERS | {name: b""}) for kind, name in names.items()}
    nul = zip_bytes(MEMBERS | {"facts.json?": b""}).replace(b"json?", b"json\0")
    return {k: ("unknown_member", v) for k, v in (kinds | {"a NUL in a name": nul}).items()}


def _hashes() -> dict[str, tuple[str, bytes]]:
    depth = bytearray(MEMBERS["depth_0.npy"])
    depth[-2] ^= 1
    claims = MEMBERS["claims.json"].replace(b"4.5", b"4.6", 1)
    gone = {k: v for k, v in MEMBERS.items() if k != "claims.json"}
    listed = _set("members", "depth_0.npy", "bytes", to=9)
    return {
        "one raw value changed": ("wrong_hash", unhashed("depth_0.npy", bytes(depth))),
        "one claim changed": ("wrong_hash", unhashed("claims.json", claims)),
        "members swapped": ("wrong_hash", unhashed("depth_0.npy", MEMBERS["depth_1.npy"])),
        "a wrong size in the manifest": ("wrong_hash", with_json("manifest.json", listed)),
        "as large as can be, last value changed": ("wrong_hash", full_size(last=1)),
        "a member missing": ("missing_member", zip_bytes(gone)),
        "a member missing everywhere": ("missing_member", zip_bytes(hashed(gone))),
        "no manifest": ("missing_member", zip_bytes({"facts.json": b"{}"})),
        "a member not listed": ("unlisted_member", unhashed("depth_2.npy", b"")),
        "an array of no distance": ("unlisted_member", with_member("depth_2.npy", npy())),
    }


def _jsons() -> dict[str, tuple[str, bytes]]:
    name = "claims.json"
    whole = {
        "no JSON": ("not_json", b"{'a': 1}"),
        "brackets that do not match": ("not_json", b"]]][[["),
        "brackets of two kinds": ("not_json", b"[}"),
        "40,000 strings": ("bad_value", b"[" + b'"",' * 40_000 + b'""]'),
        "half a JSON": ("not_json", MEMBERS[name][:40]),
        "a byte order mark": ("not_json", b"\xef\xbb\xbf" + MEMBERS[name]),
        "a string without end": ("not_json", b'"' + b'\\"' * 65_000),
        "UTF-16": ("not_json", MEMBERS[name].decode().encode("utf-16")),
        "invalid UTF-8": ("not_json", b'{"rows": "\xff\xfe\x80"}'),
        "an overlong UTF-8": ("not_json", b'{"rows": "\xc0\xaf"}'),
        "deep lists": ("not_json", b"[" * 60_000 + b"]" * 60_000),
        "deep objects": ("not_json", b'{"a":' * 20_000 + b"1" + b"}" * 20_000),
        "wide lists": ("bad_value", b"[" + b"[]," * 40_000 + b"[]]"),
        "a list for an object": ("bad_value", b"[1, 2]"),
        "a number for an object": ("bad_value", b"3"),
        "a name of 5,000 letters": ("bad_value", b'{"' + b"a" * 5_000 + b'": 1}'),
        "8,000 keys": ("bad_value", json.dumps(dict.fromkeys(map(str, range(8_000)))).encode()),
    }
    kinds = {kind: (reason, with_member(name, data)) for kind, (reason, data) in whole.items()}
    return kinds | {
        "NaN": ("bad_value", with_text(name, "4.5", "NaN")),
        "infinity": ("bad_value", with_text(name, "4.5", "-Infinity")),
        "1e999": ("bad_value", with_text(name, "4.5", "1e999")),
        "an integer of 5,000 digits": ("not_json", with_text(name, "4.5", "9" * 5_000)),
        "a number of 5,000 digits": ("", with_text(name, "4.5", "0." + "9" * 5_000)),
        "a key twice": (
            "not_json",
            with_text(name, '"exponent"', '"sigma_d_px": 1, "exponent"'),
        ),
        "an unknown key": ("bad_value", with_json(name, _set("bonus", to=5))),
        "a method's name for a key": ("bad_value", with_json(name, _set("__class__", to="x"))),
        "a key missing": ("bad_value", with_json(name, _without("sigma_d_px"))),
        "a key of a row missing": (
            "bad_value",
            with_json(name, _without("rows", 0, "depth_std_mm")),
        ),
        "a later format": ("other_format", with_json("manifest.json", _set("format", to=2))),
        "no format": ("other_format", with_json("manifest.json", _without("format"))),
        "True for a format": ("bad_value", with_json("manifest.json", _set("format", to=True))),
        "members is a list": ("bad_value", with_json("manifest.json", _set("members", to=[1]))),
        "101 outcomes": (
            "bad_value",
            with_member("outcomes.json", json.dumps({f"a{i}": 1 for i in range(101)}).encode()),
        ),
        "13 rows": ("bad_value", with_json(name, _set("rows", to=[{}] * 13))),
        "13 stacks": ("bad_value", with_json("facts.json", _set("stacks", to=[{}] * 13))),
    }


def _values() -> dict[str, tuple[str, bytes]]:
    facts = {
        "a negative focal length": (("camera", "fx"), -425),
        "text for a number": (("camera", "fx"), "425"),
        "True for a number": (("camera", "fx"), True),
        "a huge focal length": (("camera", "fx"), 1e300),
        "an integer of 39 digits": (("camera", "width"), 10**38),
        "half a pixel": (("camera", "width"), 848.5),
        "an unknown source": (("camera", "source"), "stolen"),
        "a list for a source": (("camera", "source"), ["live"]),
        "three coefficients": (("camera", "coeffs"), [0, 0, 0]),
        "a block of no width": (("caliper_m",), 0),
        "a version that is a list": (("versions", "numpy"), [2]),
        "a window outside": (("stacks", 0, "window"), [846, 238, 5, 4]),
        "a window of another size": (("stacks", 0, "window"), [420, 238, 4, 5]),
        "a negative window": (("stacks", 0, "window"), [-1, 238, 5, 4]),
        "a huge window": (("stacks", 0, "window"), [0, 0, 10**9, 10**9]),
        "a negative distance": (("stacks", 0, "distance_m"), -0.3),
        "a distance twice": (("stacks", 0, "distance_m"), 0.6),
    }
    manifest = {
        "no name": "   ",
        "an invisible name": "\u200b\u2060",
        "a name of two lines": "Zoë\nsecond line",
        "a name with a NUL": "Zo\0",
        "a name that runs backwards": "\u202ezoe",
        "half a character": "Zo\ud83d",
        "a long name of a student": "Z" * 101,
        "a list for a name": ["Zoë"],
    }
    claims, conclusion, outcomes = "claims.json", "conclusion.json", "outcomes.json"
    others = {
        "another exercise": ("manifest.json", _set("exercise", to="../studio_9")),
        "no such day": ("manifest.json", _set("made", to="2026-02-30T12:00:00+00:00")),
        "no time zone": ("manifest.json", _set("made", to="2026-02-03T12:00:00")),
        "Arabic digits in a date": ("manifest.json", _set("made", to="٢٠٢٦-02-03T12:00:00+00:00")),
        "a claim of 1e200": (claims, _set("rows", 0, "depth_std_mm", to=1e200)),
        "an interval of three": (claims, _set("exponent_interval", to=[1, 2, 3])),
        "an interval upside down": (claims, _set("exponent_interval", to=[2, 1])),
        "a plot of unequal lists": (claims, _set("plot", "measured_mm", to=[1])),
        "a row twice": (claims, _set("rows", 1, "distance_m", to=0.3)),
        "minus 3 frames": (conclusion, _set("frames", to=-3)),
        "a verdict of its own": (conclusion, _set("dominates", to="both")),
        "a long paragraph": (conclusion, _set("paragraph", to="a b " * 1_300)),
        "a path for an outcome": (outcomes, _set("../../x", to={"right": True, "attempts": 1})),
        "minus 3 attempts": (outcomes, _set("depth_std", "attempts", to=-3)),
        "1 for True": (outcomes, _set("depth_std", "right", to=1)),
    }
    changes = {k: ("facts.json", _set(*path, to=v)) for k, (path, v) in facts.items()}
    changes |= {k: ("manifest.json", _set("student", to=v)) for k, v in manifest.items()}
    kinds = {k: ("bad_value", with_json(*change)) for k, change in (changes | others).items()}
    kinds["a window of another size"] = ("bad_array", kinds["a window of another size"][1])
    return kinds


def _arrays() -> dict[str, tuple[str, bytes]]:
    struct_type = "[('a', '<u2'), ('b', '<u2')]"
    code = "__import__('os').system('id')"
    depth = {
        "a pickled object array": _pickled_array(),
        "an object array in a record": npy("[('a', '|O')]"),
        "a zip for an array": HONEST,
        "a text for an array": b"1 2 3\n4 5 6\n",
        "nothing for an array": b"",
        "an array's magic only": b"\x93NUMPY\x01\x00",
        "version 2 of NumPy's format": npy(version=b"\x02\x00"),
        "version 3 of NumPy's format": npy(version=b"\x03\x00"),
        "code in a header": npy(shape=code),
        "code for a dtype": npy(descr=code),
        "a header of a list of 300 lists": npy(shape="[" * 300 + "]" * 300),
        "a header beyond the end": b"\x93NUMPY\x01\x00\xff\xff{}",
        "a negative dimension": npy(shape="(-3, 4, 5)"),
        "floats for counts": npy("'<f4'", content=bytes(240)),
        "complex counts": npy("'<c8'", content=bytes(480)),
        "text in an array": npy("'<U1'", content=bytes(240)),
        "dates in an array": npy("'<M8[s]'", content=bytes(480)),
        "a record in an array": npy(struct_type, content=bytes(240)),
        "big-endian": npy("'>u2'"),
        "Fortran order": npy(fortran="True"),
        "two dimensions": npy(shape="(12, 5)"),
        "no dimensions": npy(shape="()"),
        "sixty dimensions": npy(shape=f"({'1, ' * 60})"),
        "no frames": npy(shape="(0, 4, 5)", content=b""),
        "a dimension of 300 digits": npy(shape=f"({'9' * 300}, 4, 5)"),
        "a billion values": npy(shape="(1000, 1000, 1000)"),
        "2^64 values": npy(shape="(4294967296, 4294967296, 1)"),
        "fewer values than declared": npy(content=bytes(119)),
        "more values than declared": npy(content=bytes(121)),
        "another window": npy(shape="(3, 5, 4)"),
        "more frames than times": npy(shape="(4, 4, 5)", content=bytes(160)),
    }
    nan, infinity = (struct.pack("<3d", 0, 1, value) for value in (float("nan"), float("inf")))
    times = {
        "NaN for a time": npy("'<f8'", "(3,)", content=nan),
        "infinity for a time": npy("'<f8'", "(3,)", content=infinity),
        "a time of 1e300": npy("'<f8'", "(3,)", content=struct.pack("<3d", 0, 1, 1e300)),
    }
    kinds = {k: ("bad_array", with_member("depth_0.npy", data)) for k, data in depth.items()}
    kinds |= {k: ("bad_value", with_member("times_0.npy", data)) for k, data in times.items()}
    huge, clock = array_bytes(_a_million(4)), array_bytes(np.arange(244) / 30)
    three = {f"depth_{i}.npy": huge for i in range(3)} | {f"times_{i}.npy": clock for i in range(3)}
    facts = json.loads(MEMBERS["facts.json"])
    facts["stacks"] = [{"distance_m": 0.3 + i, "window": [0, 0, 64, 64]} for i in range(3)]
    all_of = hashed(MEMBERS | three | {"facts.json": json.dumps(facts).encode()})
    return kinds | {"three million values": ("bad_value", zip_bytes(all_of))}
