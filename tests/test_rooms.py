"""The package is built as its map says: rooms, who may import whom, and one name for one thing.

The map is the table in the docstring of `coursekit/__init__.py`; the README shows the same text.
"""

import ast
import importlib
import io
import tokenize
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest
from common import EXPECTED

import coursekit

PACKAGE = Path(coursekit.__file__).parent
README = PACKAGE.parent / "README.md"
FILES = sorted(PACKAGE.rglob("*.py"))
TREES = {path: ast.parse(path.read_text(encoding="utf-8")) for path in FILES}
MOST_FILES, MOST_LINES = 95, 20_000  # of the whole edition


def map_rows(text: str) -> dict[str, list[str]]:
    """The rooms of the map in order, with the other cells of their rows."""
    rows = {}
    for line in text.splitlines():
        cells = [cell.strip() for cell in line.strip().strip("|").split("|")]
        if line.strip().startswith("| `") and len(cells) == 4:
            rows[cells[0].strip("`")] = cells[1:]
    return rows


MAP = map_rows(coursekit.__doc__ or "")
EVERYWHERE = ("arrays", "checks", "words")  # what the map's heading says that any room may use


def module(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def room(name: str) -> str:
    return [*name.split("."), ""][1]


MODULES = {module(path): path for path in FILES if path.stem != "__main__"}  # that is `cli`


def imported(path: Path) -> Iterator[str]:
    """Modules of the package that a file imports: at its top, in a function, or for types only."""
    for node in ast.walk(TREES[path]):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "coursekit":
            for alias in node.names:
                full = f"{node.module}.{alias.name}"
                yield full if full in MODULES else str(node.module)
        elif isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "ck":
            face = getattr(coursekit, node.attr)  # the package's own: what `ck.open_camera` loads
            yield face.__name__ if isinstance(face, ModuleType) else face.__module__


ARROWS = {name: set(imported(path)) for name, path in MODULES.items() if name != "coursekit"}


def test_every_room_is_on_the_map_and_the_readme_shows_the_same() -> None:
    assert {room(name) for name in MODULES} - {""} == set(MAP)
    assert map_rows(README.read_text(encoding="utf-8")) == MAP


def test_rooms_import_what_the_map_allows() -> None:
    """And the map has no allowance that nobody uses."""
    used = defaultdict(set)
    for name, others in ARROWS.items():
        used[room(name)] |= {room(other) for other in others} - {room(name), "", *EVERYWHERE}
    order = list(MAP)
    for name, cells in MAP.items():
        allowed = set() if cells[2] == "-" else {cell.strip(" `") for cell in cells[2].split(",")}
        assert used[name] == allowed, name
        assert all(order.index(other) < order.index(name) for other in allowed), name
    for name in EVERYWHERE:
        assert {room(other) for other in ARROWS[f"coursekit.{name}"]} <= set(EVERYWHERE)


def test_no_module_imports_itself_by_a_detour() -> None:
    """Lazy and type-only imports count, and so do those of a room's face, its `__init__`."""
    left = {name: set(others) - {name} for name, others in ARROWS.items()}
    left["coursekit"] = set()
    while ends := [name for name, others in left.items() if not others & left.keys()]:
        for name in ends:
            del left[name]
    assert left == {}


def test_no_imports_for_types_only() -> None:
    for path, tree in TREES.items():
        if path != PACKAGE / "__init__.py":  # it names for the type checker what it loads lazily
            tests = [ast.unparse(node.test) for node in ast.walk(tree) if isinstance(node, ast.If)]
            assert "TYPE_CHECKING" not in tests, path


@pytest.mark.parametrize("path", [path for path in FILES if path.name == "__init__.py"], ids=module)
def test_no_module_is_hidden_by_a_name(path: Path) -> None:
    """`import coursekit.boards.detector` gives the module, whatever the room's face exports."""
    package = importlib.import_module(module(path))
    for other in path.parent.glob("[!_]*.py"):
        found = getattr(package, other.stem, None)
        assert found is None or isinstance(found, ModuleType), f"{module(path)}.{other.stem}"


def public_names(tree: ast.Module) -> Iterator[str]:
    for node in tree.body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, (ast.Assign, ast.AnnAssign)):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            found = (part for target in targets for part in ast.walk(target))
            yield from (part.id for part in found if isinstance(part, ast.Name))


def test_a_public_name_means_one_thing() -> None:
    """Of functions, classes and constants."""
    places = defaultdict(set)
    for path, tree in TREES.items():
        for name in public_names(tree):
            if not name.startswith("_"):
                places[name].add(module(path))
    twice = {name: sorted(where) for name, where in places.items() if len(where) > 1}
    assert set(twice) == set(EXPECTED["one_name_two_places"]), twice
    assert len(twice) <= 10


def test_no_private_name_is_used_from_another_module() -> None:
    for path, tree in TREES.items():
        imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
        ours = [node for node in imports if (node.module or "").startswith("coursekit")]
        names = {alias.name for node in ours for alias in node.names}
        assert not [name for name in names if name.startswith("_")], path
        modules = {name for name in names if any(m.endswith(f".{name}") for m in MODULES)}
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                private = node.attr.startswith("_") and not node.attr.startswith("__")
                assert not (private and node.value.id in modules), f"{path}: {ast.unparse(node)}"


def lines_of_code(path: Path) -> int:
    """Lines that a token touches which is no comment and no docstring."""
    source = path.read_text(encoding="utf-8")
    docstrings = set()
    for node in ast.walk(TREES[path]):
        body = getattr(node, "body", None)
        if isinstance(body, list) and body and isinstance(body[0], ast.Expr):
            value = body[0].value
            if isinstance(value, ast.Constant) and isinstance(value.value, str):
                docstrings.update(range(value.lineno, (value.end_lineno or 0) + 1))
    layout = (tokenize.COMMENT, tokenize.NL, tokenize.NEWLINE, tokenize.INDENT, tokenize.DEDENT)
    lines = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in (*layout, tokenize.ENDMARKER):
            lines.update(range(token.start[0], token.end[0] + 1))
    return len(lines - docstrings)


def test_the_package_has_few_enough_files_and_lines_to_carry() -> None:
    assert len(FILES) <= MOST_FILES
    assert sum(map(lines_of_code, FILES)) <= MOST_LINES
