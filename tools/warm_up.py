"""Compile every numba kernel once and leave it in the cache: `python tools/warm_up.py`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import coursekit
from coursekit import geometry, simulation
from coursekit.boards import Board
from coursekit.geometry import Intrinsics, make_transform
from coursekit.simulation.board_images import render_board


def forget() -> None:
    """Empty the cache: a cached kernel does not notice that one which it calls has changed."""
    for folder in Path(coursekit.__file__).parent.rglob("__pycache__"):
        for file in (*folder.glob("*.nbi"), *folder.glob("*.nbc")):
            file.unlink(missing_ok=True)


def compile_all() -> None:
    """Call every kernel with the types that the course uses."""
    camera = Intrinsics(4, 3, 4.0, 4.0, 1.5, 1.0)
    bent = Intrinsics(4, 3, 4.0, 4.0, 1.5, 1.0, "brown_conrady", (0.1, 0.0, 0.0, 0.0, 0.0))
    for dtype in (np.uint16, np.float32, np.float64):
        depth = np.ones((3, 4), dtype)
        geometry.deproject_image(depth, camera)
        geometry.deproject_image(depth, bent)
    geometry.align_depth_to_color(np.ones((3, 4)), camera, camera, np.eye(4))
    simulation.render(simulation.tabletop(), camera)
    eye = Intrinsics(64, 48, 40.0, 40.0, 31.5, 23.5)
    view = simulation.Rig(eye, 0.05).look_at(simulation.tabletop())
    view.depth(view.frame(np.random.default_rng(0)))
    pose = make_transform(np.eye(3), (-0.05, -0.05, 0.4))
    render_board(Board("checkerboard", (5, 4), 0.025), pose, eye, np.random.default_rng(0))


if __name__ == "__main__":
    forget()
    compile_all()
