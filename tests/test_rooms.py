"""Rooms import only from rooms above them, so that none needs to know who uses it."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path

import coursekit

PACKAGE = Path(coursekit.__file__).parent
ROOMS = (
    "arrays",
    "checks",
    "words",
    "kernels",
    "geometry",
    "specifications",
    "results",
    "stereo",
    "boards",
    "causes",
    "intrinsics",
    "arm",
    "hand_eye",
    "budget",
    "attribution",
    "simulation",
    "cameras",
    "lessons",
    "plots",
    "submission",
    "doctor",
    "warm_up",
    "cli",
)


def room(path: Path) -> str:
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imported(tree: ast.Module) -> Iterator[str]:
    """The rooms whose code runs; what only the type checker reads leads nowhere."""
    nodes: list[ast.AST] = [tree]
    while nodes:
        node = nodes.pop()
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            continue
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("coursekit"):
            below = (node.module or "").split(".")[1:]
            yield from below[:1] or [alias.name for alias in node.names]
        nodes.extend(ast.iter_child_nodes(node))


def test_no_room_imports_from_below() -> None:
    upwards = set()
    for path in PACKAGE.rglob("*.py"):
        own = room(path)
        if own == "__init__":  # it names all rooms, and loads each when it is asked for
            continue
        for other in imported(ast.parse(path.read_text(encoding="utf-8"))):
            if other != own and ROOMS.index(other) > ROOMS.index(own):
                upwards.add(f"{path.relative_to(PACKAGE)} imports {other}")
    assert upwards == set()


def test_every_room_has_its_place() -> None:
    there = {room(path) for path in PACKAGE.rglob("*.py")} - {"__init__"}
    assert there == set(ROOMS)
