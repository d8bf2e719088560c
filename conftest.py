"""Settings of all tests: the student's results are never touched, and notebooks run as when built.

This file is beside the notebooks' folder, not in tests/, so that it holds for `pytest notebooks`.
"""

import os
import random
import tempfile
from itertools import chain
from pathlib import Path

import pytest

from tools.build_notebooks import kernel_environment

# Before NumPy is loaded: two processes of tests with two threads each wait for one another, and the
# digits of a test should not depend on how many cores a computer has. Numba's threads change none.
for threads in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(threads, "1")
os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # Numba's spin while they wait
SCRATCH = pytest.StashKey[Path]()


def pytest_configure(config):
    scratch = tempfile.TemporaryDirectory(prefix="coursekit-", ignore_cleanup_errors=True)
    config.add_cleanup(scratch.cleanup)
    config.stash[SCRATCH] = Path(scratch.name)
    os.environ["COURSEKIT_RESULTS"] = str(Path(scratch.name) / "results")


def pytest_collection_modifyitems(items):
    """COURSEKIT_SHUFFLE=7 shuffles the modules and the tests in each, but not the cells."""
    if seed := os.environ.get("COURSEKIT_SHUFFLE"):
        order, modules = random.Random(seed), {}
        for item in items:
            modules.setdefault(item.path, []).append(item)
        for module in modules.values():
            if module[0].path.suffix != ".ipynb":
                order.shuffle(module)
            if module[0].get_closest_marker("browser"):  # the tests of a page share its Run All
                module.sort(key=lambda item: (_page(item), "next_day" in item.name))  # closes it
        items[:] = chain.from_iterable(order.sample(list(modules.values()), len(modules)))


def _page(item):
    """The notebook that a browser test opens, "" for one that opens none."""
    return item.callspec.params.get("name", "") if hasattr(item, "callspec") else ""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item):
    """nbval starts a notebook's kernel while it sets up the first cell, with this environment."""
    if item.path.suffix != ".ipynb":
        return (yield)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in kernel_environment(item.config.stash[SCRATCH] / item.path.stem).items():
            patch.setenv(name, value)
        return (yield)
