"""Examples in docstrings: all of them run, and functions that the notebooks use have one."""

import doctest
import importlib
import inspect
import pkgutil
import re

import pytest

import coursekit
from tools.build_notebooks import code_cells, find, joined, read

MODULES = [module.name for module in pkgutil.walk_packages(coursekit.__path__, "coursekit.")]
ROOMS = ("geometry", "intrinsics", "stereo")  # whose functions must have an example
WITHOUT = {"intrinsics.fit_bow": "needs a whole session of views of a bowed board"}


@pytest.mark.parametrize("name", MODULES)
def test_examples_run(name: str) -> None:
    try:
        module = importlib.import_module(name)
    except ModuleNotFoundError as error:
        pytest.skip(f"{error.name} is not installed")
    assert doctest.testmod(module).failed == 0


def test_functions_that_notebooks_use_have_an_example() -> None:
    functions = {}
    code = [joined(cell["source"]) for path in find([]) for cell in code_cells(read(path))]
    for name in set(re.findall(r"\bck\.(\w+\.\w+)\b", "\n".join(code))):
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
