"""Settings of all tests: the student's results are never touched, and notebooks run as when built.

This file is beside the notebooks' folder, not in tests/, so that it holds for `pytest notebooks`.
"""

import os
import tempfile
from pathlib import Path

import pytest

from tools.build_notebooks import kernel_environment

SCRATCH = pytest.StashKey[Path]()


def pytest_configure(config):
    scratch = tempfile.TemporaryDirectory(prefix="coursekit-", ignore_cleanup_errors=True)
    config.add_cleanup(scratch.cleanup)
    config.stash[SCRATCH] = Path(scratch.name)
    os.environ["COURSEKIT_RESULTS"] = str(Path(scratch.name) / "results")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_setup(item):
    """nbval starts a notebook's kernel while it sets up the first cell, with this environment."""
    if item.path.suffix != ".ipynb":
        return (yield)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in kernel_environment(item.config.stash[SCRATCH] / item.path.stem).items():
            patch.setenv(name, value)
        return (yield)
