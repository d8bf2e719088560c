"""What is made once a run for the tests of several modules."""

import pytest
from fake_realsense import real_library

from coursekit.cameras.simulated import SimulatedCamera


@pytest.fixture(scope="session")
def tabletop(tmp_path_factory):
    """12 frames of the simulated camera, as librealsense recorded them; skips without it."""
    real_library()
    with SimulatedCamera() as camera:
        return camera.record(tmp_path_factory.mktemp("recording") / "tabletop.db3", 12)
