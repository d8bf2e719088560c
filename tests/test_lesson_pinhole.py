"""Numbers in the text of notebook 01."""

import math

import numpy as np
import pytest

from coursekit.geometry import deproject, project
from coursekit.specifications import device, lens


def test_numbers_of_notebook_01() -> None:
    """Those of its text that no cell prints."""
    camera = device("D435").unit
    focal, edge = camera.depth.fx, math.tan(math.radians(87 / 2))
    short = 1 - focal * edge / 424  # of the data sheet's 87 degrees
    assert (100 * short, 60 * short) == pytest.approx((3.5, 2.1), abs=0.05)
    assert (edge, 5 * edge, math.hypot(1, edge)) == pytest.approx((0.95, 4.7, 1.38), abs=0.05)
    T = np.linalg.inv(camera.T_color_depth)
    turn = math.degrees(math.atan2(T[2, 0], T[2, 2]))
    x = 1000 * deproject([600, 240], 1.0, camera.color.K)[0]
    parts = turn, x, x * T[2, 0], 1000 * T[2, 3], camera.depth.cx - 423.5
    assert parts == pytest.approx((0.74, 457, 5.9, -0.8, 13), abs=0.3)
    sheet = 1.93 / 0.003  # mm, mm a pixel
    assert (sheet, sheet * 848 / 1280) == pytest.approx((643, 426), abs=0.5)
    left = lens("opencv_left").intrinsics
    points = np.random.default_rng(0).uniform([-0.5, -0.4, 1.0], [0.5, 0.4, 1.5], (1000, 3))
    moved = project(points, left.K, left.dist) - project(points, left.K)
    assert np.linalg.norm(moved, axis=1).max() == pytest.approx(29, abs=0.5)
