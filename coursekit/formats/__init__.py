"""Files of other programs, as plain numbers: `lens` for K and distortion, `poses` for transforms.

A file is recognised by what is in it, not by its suffix, and one of another kind is named for what
it is. Files come from anywhere, so nothing in them is executed, looked up or expanded: of YAML only
PyYAML's tree of nodes is used (its safe loader, and no object is built), XML may declare nothing,
and sizes are limited. OpenCV's own `FileStorage` is not used to read: some thousand opening
brackets end the process. All here speak in dictionaries and arrays, so that `geometry` can use it;
names, kinds and what is written stand in texts.toml.
"""

from __future__ import annotations

import codecs
import itertools
import math
import os
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import yaml

from coursekit.checks import refuse, want

FORMAT_TEXTS = tomllib.loads((Path(__file__).parent / "texts.toml").read_text("utf-8"))
LARGEST, LARGEST_TREE = 2 << 20, 256 << 10  # bytes of a table, of YAML, JSON or XML
MOST_NODES, DEEPEST = 50_000, 12
BRACKET = re.compile(r"[\[\]{}]")
NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_./-]*")  # of a frame or a camera, safe in all formats


def read_text(path: str | os.PathLike[str], wanted: str) -> str:
    """The text of a file, in UTF-8 or with the mark of UTF-16; ValueError for no text.

    wanted: what it should be, for the message.
    """
    place = Path(path)
    want(place.is_file(), "path", os.fspath(path), "a file that exists")
    with place.open("rb") as file:
        data = file.read(LARGEST + 1)
    want(data.strip(), place.name, "an empty file", wanted)
    wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
    try:
        text = data.decode("utf-16" if wide else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        other = "no text in UTF-8: binary, or UTF-16 without a mark, or of another code page"
        kind = kind_of(data.decode("latin-1"), other, "foreign")
        want(False, place.name, kind, wanted)
    want(len(data) <= LARGEST, place.name, f"more than {LARGEST >> 20} MB", wanted)
    return text


def kind_of(text: str, otherwise: str = "another text", only: str = "") -> str:
    """What a text is, in words, as far as its content tells; only: "foreign" or "kinds"."""
    signs = FORMAT_TEXTS[only] if only else FORMAT_TEXTS["foreign"] | FORMAT_TEXTS["kinds"]
    return next((kind for sign, kind in signs.items() if re.search(sign, text[:9000])), otherwise)


def tree(text: str, name: str, wanted: str) -> Any:
    """YAML, JSON or OpenCV's XML as dictionaries, lists and texts, numbers too; None for nothing.

    name: of the file; wanted: what it should be, for messages. Raises ValueError in one line for
    what is of another kind, damaged, too deep or too large, holds a Python object or, by aliases,
    far more than it shows.
    """
    foreign = kind_of(text, "", "foreign")
    want(not foreign, name, foreign, wanted)
    want(len(text) <= LARGEST_TREE, name, f"{len(text) >> 10} kB", wanted)
    try:
        if text.lstrip().startswith("<"):
            return _xml(text)
        # OpenCV's first line is no YAML, nor are the tabs that JSON may be indented with
        plain = re.sub(r"\A%YAML:.*", "", text).replace("\t", " ")
        opened = itertools.accumulate(1 if m[0] in "[{" else -1 for m in BRACKET.finditer(plain))
        # the loader takes time with the square of the depth
        refuse(any(depth > DEEPEST for depth in opened), f"is deeper than {DEEPEST} levels")
        loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
        nodes = list(yaml.compose_all(plain, Loader=loader))
        return _plain(nodes[0], 0, iter(range(MOST_NODES))) if nodes and nodes[0] else None
    except yaml.MarkedYAMLError as error:
        line = error.problem_mark.line + 1 if error.problem_mark else "?"
        reason = f"is damaged, or no YAML or JSON: {error.problem}, line {line}"
    except ElementTree.ParseError as error:
        reason = f"is damaged: {error}"
    except RecursionError:
        reason = "is nested too deeply"
    except (yaml.YAMLError, ValueError) as error:
        reason = str(error).splitlines()[0]
    raise ValueError(f"{name}: {reason}; want {wanted}")


def _plain(node: Any, depth: int, left: Iterator[int]) -> Any:
    """A node of YAML as dictionaries, lists and texts."""
    if depth > DEEPEST or next(left, None) is None:
        raise ValueError(f"is deeper than {DEEPEST} levels, or its aliases make too much of it")
    refuse("python" in node.tag, "holds a Python object, which could run code")
    if isinstance(node, yaml.SequenceNode):
        return [_plain(item, depth + 1, left) for item in node.value]
    if isinstance(node, yaml.MappingNode):
        pairs = [(str(key.value), _plain(value, depth + 1, left)) for key, value in node.value]
        if len(dict(pairs)) < len(pairs):
            raise ValueError("has a key that stands twice: which of the two is right?")
        return dict(pairs)
    return None if node.tag.endswith(":null") else node.value


def _xml(text: str) -> dict[str, Any]:
    """OpenCV's XML: what stands in it by name, a matrix as rows, cols and data."""
    if "<!" in text.replace("<!--", ""):
        raise ValueError("declares a document type or entities, which no calibration needs")
    root = ElementTree.fromstring(text)
    refuse(root.tag != "opencv_storage", f"is XML with <{root.tag[:40]}>, not <opencv_storage>")
    found: dict[str, Any] = {}
    for entry in root:
        parts = {part.tag: (part.text or "").strip() for part in entry}
        data = {"data": parts["data"].split()} if "data" in parts else {}
        found[entry.tag] = parts | data if parts else (entry.text or "").strip()
    return found


def numbers(value: Any, name: str, depth: int = 3) -> list[float]:
    """The finite numbers in a text, in a list of such or lists of them, or in a matrix's `data`."""
    if isinstance(value, dict):
        value = value.get("data")
    if isinstance(value, list) and depth:
        return [one for item in value for one in numbers(item, name, depth - 1)]
    try:
        found = float(value)
    except (TypeError, ValueError):
        found = math.nan
    want(math.isfinite(found), name, value, "finite numbers")
    return [found]


def one_number(value: Any, name: str) -> float:
    """The one finite number that a value is."""
    found = numbers(value, name)
    want(len(found) == 1, name, value, "one number")
    return found[0]


def fill(to: str, values: dict[str, Any]) -> str:
    """The text of a format with these values, numbers in full; ValueError for an unsafe name."""
    for key, value in values.items():
        safe = not isinstance(value, str) or NAME.fullmatch(value)
        want(safe, key, value, "a name of letters, digits and _, as ROS has them")
    shown = {key: value if isinstance(value, str) else repr(value) for key, value in values.items()}
    return str(FORMAT_TEXTS["out"][to].format(**shown))
