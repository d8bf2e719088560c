"""Examples in docstrings: all of them run, and functions that the notebooks use have one."""

import ast
import doctest
import importlib
import inspect
import json
import pkgutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import coursekit

NOTEBOOKS = sorted((Path(__file__).parents[1] / "notebooks").glob("*.ipynb"))
MODULES = [module.name for module in pkgutil.walk_packages(coursekit.__path__, "coursekit.")]
ROOMS = ("geometry", "intrinsics", "stereo")  # whose functions must have an example
WITHOUT = {
    "intrinsics.fit_bow": "needs a whole session of views of a bowed board",
}


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name: str) -> None:
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        pytest.skip(f"{error.name} is not installed")
    assert doctest.testmod(module).failed == 0


def used_by_notebooks() -> Iterator[str]:
    """What the notebooks' cells name as ck.room.name, once each time."""
    for path in NOTEBOOKS:
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] != "code":
                continue
            lines = "".join(cell["source"]).splitlines()
            code = "\n".join(line for line in lines if not line.startswith(("%", "!")))
            for node in ast.walk(ast.parse(code)):
                parts = ast.unparse(node).split(".") if isinstance(node, ast.Attribute) else []
                if len(parts) == 3 and parts[0] == "ck":
                    yield ".".join(parts[1:])


def test_functions_that_notebooks_use_have_an_example() -> None:
    functions = {}
    for name in set(used_by_notebooks()):
        room, thing = name.split(".")
        if room in ROOMS and thing not in dir(importlib.import_module(f"coursekit.{room}")):
            pytest.fail(f"a notebook uses ck.{name}, which is not there")
        found = getattr(getattr(coursekit, room), thing, None)
        if room in ROOMS and inspect.isfunction(found):
            functions[name] = inspect.getdoc(found) or ""
    assert len(functions) > 15
    without = {name for name, text in functions.items() if ">>> " not in text}
    assert sorted(without - set(WITHOUT)) == []
    assert sorted(set(WITHOUT) - set(functions)) == []  # nothing stays in the list for no reason
