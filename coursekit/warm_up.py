"""Compile every numba kernel once and leave it in the cache: `python -m coursekit.warm_up`."""

from __future__ import annotations

import numpy as np

from coursekit import geometry, simulation
from coursekit.geometry import Intrinsics

if __name__ == "__main__":
    camera = Intrinsics(4, 3, 4.0, 4.0, 1.5, 1.0)
    bent = Intrinsics(4, 3, 4.0, 4.0, 1.5, 1.0, "brown_conrady", (0.1, 0.0, 0.0, 0.0, 0.0))
    for dtype in (np.uint16, np.float32, np.float64):
        depth = np.ones((3, 4), dtype)
        geometry.deproject_image(depth, camera)
        geometry.deproject_image(depth, bent)
    geometry.align_depth_to_color(np.ones((3, 4)), camera, camera, np.eye(4))
    simulation.render(simulation.tabletop(), camera)
