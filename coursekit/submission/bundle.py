"""A submission, packed: one zip with a manifest, JSON and arrays, as FORMAT.md describes.

The same submission gives the same bytes (with the same version of zlib), and whatever is written
can be read: every bundle is read back before it is handed out.
"""

from __future__ import annotations

import hashlib
import io
import json
import zipfile
import zlib
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from coursekit import results
from coursekit.submission.archive import MAX_RATIO
from coursekit.submission.contents import Submission
from coursekit.submission.reader import FORMAT, read_bundle

_DATE = (1980, 1, 1, 0, 0, 0)  # the first that a zip can say


def write_bundle(path: Path, submission: Submission, overwrite: bool = False) -> Path:
    """Write the bundle in one step, and return its path.

    Raises FileExistsError when there is one already and `overwrite` is False.
    """
    if path.exists() and not overwrite:
        raise FileExistsError(f"{path}: is there already; overwrite=True replaces it")
    results.write_bytes(path, bundle_bytes(submission))
    return path


def bundle_bytes(submission: Submission) -> bytes:
    """The bundle as bytes; what a Submission may hold always fits into the grader's caps."""
    members = {
        "facts.json": _json(_facts(submission)),
        "claims.json": _json(_claims(submission)),
        "conclusion.json": _json(asdict(submission.conclusion)),
        "outcomes.json": _json({k: asdict(v) for k, v in submission.outcomes.items()}),
    }
    for i, stack in enumerate(submission.stacks):
        members[f"depth_{i}.npy"] = array_bytes(stack.counts, "<u2")
        members[f"times_{i}.npy"] = array_bytes(stack.times_s, "<f8")
    data = zip_bytes({"manifest.json": _json(_manifest(submission, members))} | members)
    read_bundle(data)  # nobody hands in what cannot be read
    return data


def zip_bytes(members: dict[str, bytes]) -> bytes:
    """A zip of these members in this order, with fixed dates and nothing else in it."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for name, content in members.items():
            info = zipfile.ZipInfo(name, _DATE)
            info.create_system = 3  # Unix, on every system
            info.external_attr = 0o100644 << 16
            archive.writestr(info, content, _method(content))
    return buffer.getvalue()


def array_bytes(values: NDArray[Any], dtype: str) -> bytes:
    """An array as a .npy file of version 1.0; the same bytes whatever version NumPy has."""
    header = f"{{'descr': '{dtype}', 'fortran_order': False, 'shape': {values.shape}, }}"
    header = header.ljust(-(len(header) + 11) % 64 + len(header)) + "\n"  # values begin at 64 n
    start = b"\x93NUMPY\x01\x00" + len(header).to_bytes(2, "little") + header.encode("ascii")
    return start + values.astype(np.dtype(dtype), copy=False).tobytes()


def _method(content: bytes) -> int:
    """Deflated, but stored where that would shrink it so much that it looks like a zip bomb."""
    small = len(zlib.compress(content))
    return zipfile.ZIP_STORED if len(content) > MAX_RATIO / 2 * small else zipfile.ZIP_DEFLATED


def _manifest(submission: Submission, members: dict[str, bytes]) -> dict[str, Any]:
    return {
        "format": FORMAT,
        "exercise": submission.exercise,
        "student": submission.student,
        "made": submission.made,
        "members": {
            name: {"bytes": len(content), "sha256": hashlib.sha256(content).hexdigest()}
            for name, content in members.items()
        },
    }


def _facts(submission: Submission) -> dict[str, Any]:
    return {
        "camera": asdict(submission.camera),
        "tape_sigma_m": submission.tape_sigma_m,
        "caliper_m": submission.caliper_m,
        "stacks": [{"distance_m": s.distance_m, "window": s.window} for s in submission.stacks],
        "versions": submission.versions,
    }


def _claims(submission: Submission) -> dict[str, Any]:
    plot = None if submission.plot is None else asdict(submission.plot)
    return asdict(submission.claims) | {"plot": plot}


def _json(content: Any) -> bytes:
    return (json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n").encode()
