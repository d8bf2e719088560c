"""Files of other programs, as plain numbers: `lens` for K and distortion, `poses` for transforms.

A file is recognised by what is in it, not by its suffix, and one of another kind is named for what
it is. Files come from anywhere, so nothing in them is executed, looked up or expanded: of YAML only
PyYAML's tree of nodes is used (safe loader, no object is built from it), XML may declare nothing,
and sizes are limited. OpenCV's own `FileStorage` writes, but does not read: a few thousand opening
brackets end the process. All here speak in dictionaries and arrays, so that `geometry` can use it.
"""

from __future__ import annotations

import codecs
import json
import math
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from coursekit.checks import shown, want

LARGEST = 2 << 20  # bytes; the longest table of poses that was seen has 100 kB
LARGEST_TREE = 256 << 10  # of YAML, JSON and XML
MOST_NODES, DEEPEST = 50_000, 12
BYTE_MARKS = {codecs.BOM_UTF8: "utf-8-sig", codecs.BOM_UTF16_LE: "utf-16"}
BYTE_MARKS |= {codecs.BOM_UTF16_BE: "utf-16"}
STARTS = {  # the first bytes of files that are no text
    b"\x89PNG": "a PNG image",
    b"\xff\xd8\xff": "a JPEG image",
    b"%PDF": "a PDF document",
    b"PK\x03\x04": "a ZIP archive (.zip, .npz, .xlsx and others)",
    b"SQLite format 3": "an SQLite database, such as a .db3 recording",
    b"#ROSBAG": "a ROS 1 bag",
    b"\x93NUMPY": "a NumPy array",
    b"\x89HDF": "an HDF5 file",
    b"\x1f\x8b": "a gzip archive",
    b"\x80": "a Python pickle, which could run code and is not read",
    b"\x7fELF": "a program",
}
SIGNS = {  # what texts of other kinds have in them
    r"\A\s*<!doctype html|\A\s*<html": "a web page",
    r"\A\s*version https://git-lfs": "a pointer of Git LFS and not the file itself (git lfs pull)",
    r"<robot\b": "a robot description (URDF)",
    r"<launch>|LaunchDescription": "a launch file of ROS",
    r'"nbformat"': "a notebook",
    r"easy_handeye|calibration_type": "a file of easy_handeye2",
    r"effector_wrt_world": "pose samples of MoveIt",
    r"(?m)^ *cam\d+:": "a camera chain of Kalibr",
    r"opencv-matrix|opencv_storage": "a file of OpenCV's FileStorage",
    r"distortion_model": "a camera_info of ROS",
    r'"quantities"': "a result of the course's notebooks",
    r"(?m)^ *\d+ +[A-Z][A-Z_]+ +\d+ +\d+ ": "COLMAP's cameras.txt",
    r"(?mi)^#? *(file|image|time|x)\w* *[,;\t ].*\b(qw|rz|z)": "a table of poses",
}


def read_text(path: str | os.PathLike[str], wanted: str) -> str:
    """The text of a file, in UTF-8 or with the mark of another Unicode; ValueError for no text.

    wanted: what it should be, for the message.
    """
    place = Path(path)
    want(place.is_file(), "path", os.fspath(path), "a file that exists")
    with place.open("rb") as file:
        data = file.read(LARGEST + 1)
    for start, kind in STARTS.items():
        want(not data.startswith(start), place.name, kind, wanted)
    want(data.strip(), place.name, "an empty file", wanted)
    want(len(data) <= LARGEST, place.name, f"more than {LARGEST >> 20} MB", wanted)
    encoding = next((name for mark, name in BYTE_MARKS.items() if data.startswith(mark)), "utf-8")
    try:
        text = data.decode(encoding)
    except UnicodeDecodeError as error:
        reason = f"no text in UTF-8 (byte {error.start}); save it as that"
        raise ValueError(f"{place.name}: {reason}") from None
    want("\0" not in text, place.name, "a binary file, or UTF-16 without its mark", wanted)
    return text


def kind_of(text: str) -> str:
    """What a text is, in words, as far as its content tells."""
    head = text[:20_000]
    return next((kind for sign, kind in SIGNS.items() if re.search(sign, head)), "another text")


def tree(text: str, name: str) -> Any:
    """YAML, JSON or OpenCV's XML as dictionaries, lists and texts, numbers too; None for nothing.

    name: of the file, for messages. Raises ValueError in one line for what is damaged, too deep or
    too large, holds a Python object or, by aliases, far more than it shows.
    """
    want(len(text) <= LARGEST_TREE, name, f"{len(text) >> 10} kB", f"{LARGEST_TREE >> 10} kB")
    try:
        if text.lstrip().startswith("<"):
            return _xml(text)
        if text.lstrip().startswith(("{", "[")):
            found = json.loads(text, parse_float=str, parse_int=str, parse_constant=str)
            return _shallow(found)
        plain = re.sub(r"\A%YAML:.*", "", text)  # OpenCV's first line is no YAML
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        nodes = list(yaml.compose_all(plain, Loader=loader))
        return _plain(nodes[0], 0, iter(range(MOST_NODES))) if nodes and nodes[0] else None
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else "?"
        reason = f"is damaged or no YAML: {error.problem}, line {line}"
    except ElementTree.ParseError as error:
        reason = f"is damaged or no XML: {error}"
    except RecursionError:
        reason = "is nested too deeply"
    except (yaml.YAMLError, ValueError) as error:
        reason = str(error).splitlines()[0]
    raise ValueError(f"{name}: {reason}")


def _plain(node: Any, depth: int, left: Iterator[int]) -> Any:
    """A node of YAML as dictionaries, lists and texts."""
    if depth > DEEPEST or next(left, None) is None:
        raise ValueError(f"is deeper than {DEEPEST} levels, or its aliases make too much of it")
    if "python" in node.tag:
        raise ValueError(f"holds a Python object ({shown(node.tag)}), which could run code")
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item, depth + 1, left) for item in node.value]
    if isinstance(node, yaml.MappingNode):
        pairs = [(str(key.value), _plain(value, depth + 1, left)) for key, value in node.value]
        if len(dict(pairs)) < len(pairs):
            raise ValueError("has a key that stands twice; which of the two is right?")
        return dict(pairs)
    return None if node.tag.endswith(":null") else node.value


def _shallow(value: Any, depth: int = 0) -> Any:
    """The value itself; ValueError where lists and dictionaries stand in one another too deeply."""
    if depth > DEEPEST:
        raise ValueError(f"is deeper than {DEEPEST} levels")
    inside = value.values() if isinstance(value, dict) else value
    for item in inside if isinstance(value, (dict, list)) else ():
        _shallow(item, depth + 1)
    return value


def _xml(text: str) -> dict[str, Any]:
    """OpenCV's XML: what stands in it by name, a matrix as rows, cols and data."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("declares a document type or entities, which no calibration needs")
    root = ElementTree.fromstring(text)
    if root.tag != "opencv_storage":
        raise ValueError(f"is {kind_of(text)}: XML with <{root.tag[:40]}>, not <opencv_storage>")
    found: dict[str, Any] = {}
    for entry in root:
        parts = {part.tag: (part.text or "").strip() for part in entry}
        data = {"data": parts["data"].split()} if "data" in parts else {}
        found[entry.tag] = parts | data if parts else (entry.text or "").strip()
    return found


def numbers(value: Any, name: str) -> list[float]:
    """The finite numbers in a text, or in lists of them, or in a matrix's `data`."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, list):
        return [one for item in value for one in numbers(item, name)]
    try:
        found = float(value)
    except (TypeError, ValueError):
        found = math.nan
    want(math.isfinite(found) and not isinstance(value, bool), name, value, "finite numbers")
    return [found]
