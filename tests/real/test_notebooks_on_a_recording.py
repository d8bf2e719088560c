"""The notebooks, cell by cell, on a recording of a real D435 instead of the simulated camera."""

import nbformat
import pytest
from common import EXPECTED, nightly

from tools import build_notebooks

pytest.importorskip("pyrealsense2", reason="no pyrealsense2 for this platform")
pytestmark = pytest.mark.real
PATHS = build_notebooks.find([])


@pytest.mark.parametrize(  # the later ones take little more than a name from the camera
    "path",
    [PATHS[0], *(pytest.param(path, marks=nightly) for path in PATHS[1:])],
    ids=lambda path: path.stem,
)
def test_every_cell_runs_on_the_recording_and_says_what_it_is(path, real_data, tmp_path) -> None:
    bag = real_data / "realsense_d435" / "single_depth_color_640x480.bag"
    environment = build_notebooks.kernel_environment(tmp_path) | {"COURSEKIT_CAMERA": str(bag)}
    notebook = nbformat.read(path, as_version=4)
    build_notebooks.execute(notebook, path.stem, path.parent, environment)
    cells = build_notebooks.code_cells(notebook)
    said = {cell.id: str(cell.outputs) for cell in cells}
    assert "Intel RealSense D435 (recording single_depth_color_640x480.bag)" in said["setup"]
    assert [o for cell in cells for o in cell.outputs if o.get("name") == "stderr"] == []
    for cell, words in EXPECTED["of_two_frames"].get(path.stem, {}).items():
        assert words in said[cell]
