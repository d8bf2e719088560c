"""What librealsense does with each distortion model, measured against `geometry`.

`measure()` needs pyrealsense2; `table()` also answers without it, from data/vendor_models.json.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np

from coursekit import geometry, results
from coursekit.arrays import Floats
from coursekit.cameras.librealsense import LibraryMissing, load_librealsense
from coursekit.cameras.recording import realsense_intrinsics
from coursekit.geometry import Intrinsics
from coursekit.specifications import DATA

Function = Callable[..., Any]
VENDOR_MODELS = DATA / "vendor_models.json"
POINTS = 2000
# A 640x480 camera with fx != fy, p1 != p2 and every coefficient in use, so that nothing cancels.
CAMERA = Intrinsics(640, 480, 612.5, 598.0, 331.4, 236.8)
COEFFS = {
    "none": (0.0, 0.0, 0.0, 0.0, 0.0),
    "radial": (-0.27, 0.11, 0.0, 0.0, 0.05),
    "radial and tangential": (-0.27, 0.11, 0.0018, -0.0012, 0.05),
}
CASES = [("none", "none"), ("brown_conrady", "radial and tangential")]
CASES += product(("inverse_brown_conrady", "modified_brown_conrady"), [*COEFFS][1:])


@dataclass(frozen=True)
class Agreement:
    """One distortion model in librealsense, the largest of many points, px.

    project_px: its projection against `geometry.project`. round_trip_px: its own deprojection,
    projected again, against the pixel it started from. yours_px, yours_m: its projection and
    deprojection against a learner's; None where these give no such array.
    """

    model: str
    coefficients: str
    project_px: float
    round_trip_px: float
    yours_px: float | None = None
    yours_m: float | None = None

    def __str__(self) -> str:
        sizes = self.project_px, self.round_trip_px, self.yours_px, self.yours_m
        texts = ["-" if size is None else f"{size:.3f}" for size in sizes]
        return f"{self.model:22} {self.coefficients:21}" + "".join(f"{t:>7}" for t in texts)


def measure(*yours: Function) -> list[Agreement]:
    """Each distortion model of librealsense, over random points all over the image.

    yours: a learner's project and deproject. Raises LibraryMissing without pyrealsense2.
    """
    rng = np.random.default_rng(1)
    pixels = rng.uniform([0, 0], [CAMERA.width - 1, CAMERA.height - 1], (POINTS, 2))
    depths = rng.uniform(0.2, 4.0, POINTS)
    return [_measure(*case, pixels, depths, *yours) for case in CASES]


def _measure(model: str, name: str, pixels: Floats, depths: Floats, *yours: Function) -> Agreement:
    rs = load_librealsense()
    camera = Intrinsics(**CAMERA.to_dict() | {"model": model, "coeffs": COEFFS[name]})
    theirs, lens = realsense_intrinsics(rs, camera), (camera.K, camera.dist)
    points = geometry.deproject(pixels, depths, *lens)
    projected = np.array([rs.rs2_project_point_to_pixel(theirs, p) for p in points.tolist()])
    seen = zip(projected.tolist(), depths.tolist(), strict=True)
    back = np.array([rs.rs2_deproject_pixel_to_point(theirs, uv, z) for uv, z in seen])
    again = np.array([rs.rs2_project_point_to_pixel(theirs, p) for p in back])
    project, deproject = yours or (None, None)
    ours_px = _longest(projected - geometry.project(points, *lens))
    yours_px = largest(projected, project, points, *lens)
    yours_m = largest(back, deproject, projected, depths, *lens)
    return Agreement(model, name, ours_px, _longest(again - projected), yours_px, yours_m)


def largest(right: Floats, function: Any, first: Floats, *others: Any) -> float | None:
    """The largest distance between the rows of a learner's function and the right ones (n, k).

    None where it is not written yet, or gives no such array. `first` is passed as a copy.
    """
    try:
        return _longest(function(first.copy(), *others) - right)
    except Exception:  # whatever a function that is half written raises
        return None


def _longest(differences: Floats) -> float:
    return float(np.linalg.norm(differences, axis=1).max())


def stored() -> list[Agreement]:
    """The table in data/vendor_models.json; a test measures it again."""
    return [Agreement(**row) for row in results.read_json(VENDOR_MODELS)["rows"]]


def table(*yours: Function) -> tuple[list[Agreement], str]:
    """The rows of `measure`, or else the stored ones, and a sentence that says which."""
    try:
        return measure(*yours), "measured on this computer"
    except LibraryMissing:
        return stored(), "stored: pyrealsense2 is not installed here"
