"""The reference among the web pages: what notebooks, README and command line name, by docstrings.

Its first page is the package with its map of rooms; then there is one page for each room. A class
has its public members, and a class that a named function or such a member returns is there too.
`python3 course.py site` writes it.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import patch

import pdoc.doc
import pdoc.render

import coursekit
from tools.build_notebooks import ROOT, find, joined, read

FOLDER = "reference"
TEMPLATES = Path(__file__).resolve().parent / "site" / "reference"
NAMED = re.compile(r"\bck\.([a-z]\w*(?:\.[A-Za-z]\w*)*)")
IMPORTED = re.compile(r"from coursekit\.([\w.]+) import (\w+)")
CLI = "coursekit/cli.py"


def named() -> set[str]:
    """What notebooks (code and text), README and command line name, without `ck.`."""
    texts = [joined(cell["source"]) for path in find([]) for cell in read(path)["cells"]]
    texts += [(ROOT / name).read_text(encoding="utf-8") for name in ("README.md", CLI)]
    imported = IMPORTED.findall(texts[-1])
    return {name for text in texts for name in NAMED.findall(text)} | set(map(".".join, imported))


def pages() -> dict[str, dict[str, Any]]:
    """The modules that have a page, and in each the things that it shows by their name.

    Raises ValueError for a name that nothing has.
    """
    found: dict[str, dict[str, Any]] = {"coursekit": {}}
    seen: set[int] = set()

    def show(module: str, name: str, thing: Any) -> None:
        if id(thing) not in seen:
            seen.add(id(thing))
            found.setdefault(module, {})[name] = thing
            for kind in _classes_of(thing):
                show(".".join(kind.__module__.split(".")[:2]), kind.__name__, kind)

    for path in sorted(named(), key=lambda name: (name.count("."), name)):
        room: Any = coursekit
        for part in path.split("."):
            try:
                thing = getattr(room, part, None) or import_module(f"{room.__name__}.{part}")
            except ImportError:
                raise ValueError(f"coursekit.{path} is named, but there is no {part}") from None
            if not isinstance(thing, ModuleType):
                show(room.__name__, part, thing)
                break
            room = thing
    return {module: dict(sorted(things.items())) for module, things in sorted(found.items())}


def _classes_of(thing: Any) -> Iterator[type]:
    """The public classes of this package that a function, or a class's public members, return."""
    members = [thing]
    if isinstance(thing, type):
        yield from (base for base in thing.__bases__ if _is_ours(base))
        members = [member for name, member in vars(thing).items() if not name.startswith("_")]
    for member in members:
        inner = getattr(member, "func", getattr(member, "fget", member))  # of either property
        function: Any = inspect.unwrap(getattr(inner, "__func__", inner))
        if inspect.isfunction(function):
            returned = str(function.__annotations__.get("return", ""))
            kinds: Iterator[Any] = map(function.__globals__.get, re.findall(r"\w+", returned))
            yield from (kind for kind in kinds if _is_ours(kind))


def _is_ours(kind: Any) -> bool:
    public = isinstance(kind, type) and not kind.__name__.startswith("_")
    return public and kind.__module__.startswith("coursekit.")


class _Written(str):
    """An annotation as it is written, "Floats | None", and not what that stands for."""

    __slots__ = ()

    def __repr__(self) -> str:
        return str(self)


def _written(annotation: Any, *_: Any) -> Any:
    return _Written(annotation) if isinstance(annotation, str) else annotation


def _all_written(annotations: dict[str, Any], *_: Any) -> dict[str, Any]:
    return {name: _written(annotation) for name, annotation in annotations.items()}


def files() -> dict[str, bytes]:
    """The pages by their path in the site."""
    modules = {}
    for name, things in pages().items():
        shown = ModuleType(name, sys.modules[name].__doc__)
        vars(shown).update(things, __all__=[*things])
        modules[name] = pdoc.doc.Module(shown)
    pdoc.render.configure(docformat="markdown", template_directory=TEMPLATES, search=False)
    with patch.multiple(pdoc.doc, safe_eval_type=_written, resolve_annotations=_all_written):
        texts = {name: pdoc.render.html_module(module, modules) for name, module in modules.items()}
    return {
        f"{FOLDER}/{name.replace('.', '/')}.html": text.replace(str(ROOT), "").encode("utf-8")
        for name, text in texts.items()
    }
