"""What librealsense does with each distortion model, measured against `geometry`.

`measure()` needs pyrealsense2; `table()` also answers without it, from data/vendor_models.json.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from importlib.metadata import version

import numpy as np

from coursekit import geometry, results
from coursekit.arrays import Floats
from coursekit.cameras.librealsense import LibraryMissing, load_librealsense
from coursekit.cameras.recording import realsense_intrinsics
from coursekit.geometry import Intrinsics
from coursekit.specifications import DATA

VENDOR_MODELS = DATA / "vendor_models.json"
POINTS = 2000
# A 640x480 camera with fx != fy, p1 != p2 and every coefficient in use, so that nothing cancels.
CAMERA = Intrinsics(640, 480, 612.5, 598.0, 331.4, 236.8)
COEFFS = {
    "none": (0.0, 0.0, 0.0, 0.0, 0.0),
    "radial": (-0.27, 0.11, 0.0, 0.0, 0.05),
    "radial and tangential": (-0.27, 0.11, 0.0018, -0.0012, 0.05),
}
CASES = (
    ("none", "none"),
    ("brown_conrady", "radial and tangential"),
    ("inverse_brown_conrady", "radial"),
    ("inverse_brown_conrady", "radial and tangential"),
    ("modified_brown_conrady", "radial"),
    ("modified_brown_conrady", "radial and tangential"),
)


@dataclass(frozen=True)
class Agreement:
    """One distortion model in librealsense, the largest of many points, px.

    project_px: its projection against `geometry.project`. round_trip_px: its own deprojection,
    projected again, against the pixel it started from.
    """

    model: str
    coefficients: str
    project_px: float
    round_trip_px: float

    def __str__(self) -> str:
        errors = f"{self.project_px:8.3f} px {self.round_trip_px:8.3f} px"
        return f"{self.model:23} {self.coefficients:22} {errors}"


def measure() -> list[Agreement]:
    """Each distortion model of librealsense, over random points all over the image.

    Raises LibraryMissing without pyrealsense2.
    """
    rng = np.random.default_rng(1)
    pixels = rng.uniform([0, 0], [CAMERA.width - 1, CAMERA.height - 1], (POINTS, 2))
    depths = rng.uniform(0.2, 4.0, POINTS)
    return [_measure(model, name, pixels, depths) for model, name in CASES]


def _measure(model: str, name: str, pixels: Floats, depths: Floats) -> Agreement:
    rs = load_librealsense()
    camera = Intrinsics(**CAMERA.to_dict() | {"model": model, "coeffs": COEFFS[name]})
    theirs = realsense_intrinsics(rs, camera)
    points = geometry.deproject(pixels, depths, camera.K, camera.dist)
    projected = np.array([rs.rs2_project_point_to_pixel(theirs, p) for p in points.tolist()])
    seen = zip(projected.tolist(), depths.tolist(), strict=True)
    back = [rs.rs2_deproject_pixel_to_point(theirs, uv, z) for uv, z in seen]
    again = np.array([rs.rs2_project_point_to_pixel(theirs, p) for p in back])
    ours = geometry.project(points, camera.K, camera.dist)
    return Agreement(model, name, _largest(projected - ours), _largest(again - projected))


def _largest(difference: Floats) -> float:
    return float(np.linalg.norm(difference, axis=1).max())


def stored() -> list[Agreement]:
    """The table in data/vendor_models.json; a test measures it again."""
    return [Agreement(**row) for row in results.read_json(VENDOR_MODELS)["rows"]]


def table() -> tuple[list[Agreement], str]:
    """The rows, measured here or else the stored ones, and a sentence that says which."""
    try:
        return measure(), "measured on this computer"
    except LibraryMissing:
        return stored(), "stored: pyrealsense2 is not installed here"


def store() -> None:
    """Measure and write data/vendor_models.json (called by tools/make_data.py)."""
    note = f"coursekit.cameras.conventions, pyrealsense2 {version('pyrealsense2')}"
    results.write_json(VENDOR_MODELS, {"source": note, "rows": [asdict(row) for row in measure()]})
