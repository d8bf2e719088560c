"""The build backend: flit's, and a wheel carries data/, which stands beside the package here."""

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from flit_core import buildapi
from flit_core.buildapi import (  # noqa: F401 - what a builder asks a backend for
    build_editable,
    build_sdist,
    get_requires_for_build_editable,
    get_requires_for_build_sdist,
    get_requires_for_build_wheel,
    prepare_metadata_for_build_editable,
    prepare_metadata_for_build_wheel,
)

ROOT = Path(__file__).resolve().parents[2]
INSIDE = ROOT / "coursekit" / "data"


@contextmanager
def data_inside() -> Iterator[None]:
    """data/ in the package, as long as it is packed."""
    shutil.copytree(ROOT / "data", INSIDE)
    try:
        yield
    finally:
        shutil.rmtree(INSIDE)


def build_wheel(*where: Any, **more: Any) -> str:
    """Write the wheel and return its name."""
    with data_inside():
        return str(buildapi.build_wheel(*where, **more))
