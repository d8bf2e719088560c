"""What is made once a run for the tests of several modules."""

import os
import signal
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
from fake_realsense import plugged_in, real_library

from coursekit import specifications
from coursekit.cameras import simulated
from coursekit.cameras.simulated import SimulatedCamera


@pytest.fixture(scope="session")
def real_data():
    if not os.environ.get("COURSEKIT_REAL_DATA"):
        pytest.skip("COURSEKIT_REAL_DATA is not set: it names the folder of real data")
    return Path(os.environ["COURSEKIT_REAL_DATA"])


@pytest.fixture(scope="session")
def rs():
    """The module pyrealsense2 itself; skips without it."""
    return real_library()


@pytest.fixture(scope="session")
def tabletop(rs, tmp_path_factory):
    """12 frames of the simulated camera, as librealsense recorded them; skips without it."""
    with SimulatedCamera() as camera:
        return camera.record(tmp_path_factory.mktemp("recording") / "tabletop.db3", 12)


@pytest.fixture(scope="module")
def small_cameras():
    """Simulated cameras with a quarter of the pixels each way, where the size is not the point."""

    def quarter(k):
        return replace(
            k, width=k.width // 4, height=k.height // 4,
            fx=k.fx / 4, fy=k.fy / 4, cx=k.cx / 4 - 0.375, cy=k.cy / 4 - 0.375,
        )  # fmt: skip

    def device(name):
        full = specifications.device(name)
        unit = replace(full.unit, depth=quarter(full.unit.depth), color=quarter(full.unit.color))
        return replace(full, unit=unit)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulated, "specifications", SimpleNamespace(device=device))
        yield


@pytest.fixture
def plug_in(monkeypatch, tmp_path):
    """Plug in a fake D435 that behaves as the arguments say."""
    return partial(plugged_in, monkeypatch, tmp_path)


@pytest.fixture
def own_results(monkeypatch, tmp_path):
    """Where results go: a folder that is not there yet, in the one that is worked in."""
    monkeypatch.setenv("COURSEKIT_RESULTS", str(tmp_path / "results"))
    monkeypatch.chdir(tmp_path)
    return tmp_path / "results"


@pytest.fixture
def ctrl_c_is_heard() -> Iterator[None]:
    """A shell lets what it starts in the background, and its children, ignore SIGINT."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def no_library(monkeypatch):
    """As where pyrealsense2 is not installed."""
    monkeypatch.delenv("COURSEKIT_CAMERA", raising=False)
    for name in ("pyrealsense2", "libusb_package"):
        monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture
def broken_library(monkeypatch, tmp_path):
    """As where pyrealsense2 is installed and does not load."""
    content = "raise ImportError('libusb-1.0.so.0: no such file')"
    (tmp_path / "pyrealsense2.py").write_text(content, encoding="utf-8")
    monkeypatch.delitem(sys.modules, "pyrealsense2", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
