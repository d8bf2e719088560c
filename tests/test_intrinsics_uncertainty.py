"""Intervals and projection uncertainty against simulated sessions whose truth is known.

COURSEKIT_NIGHTLY=1 takes 1,000 sessions, and then asks for 93 to 97 %; 20 are allowed three sigmas
of a count. The fits of many sessions start at the true lens: where a fit starts does not change
where it ends (test_intrinsics.py).
"""

import math
from dataclasses import replace

import numpy as np
import pytest
from simulated_corners import CHARUCO, CHECKERBOARD, LENS, NIGHTLY, fit

from coursekit import intrinsics
from coursekit.boards import Board
from coursekit.geometry import deproject, invert_transform, project, transform_points
from coursekit.intrinsics.fit import evaluate, image_grid
from coursekit.simulation.corner_sessions import corner_session

SESSIONS = 1000 if NIGHTLY else 20
WITHIN = (0.93, 0.97) if NIGHTLY else (0.80, 1.0)
TRUTH = {"fx": 612.0, "fy": 610.0, "cx": 322.0, "cy": 238.0, "k1": 0.08}
PIXELS = np.array([[320.0, 240.0], [20, 20], [620, 460], [600, 100], [150, 400]])
RANGES_M = (0.45, 2.0)


def seen_again(result: intrinsics.IntrinsicsResult, poses: np.ndarray, range_m: float):
    """Where the fitted camera sees what the true one sees at PIXELS.

    With the point fixed to the boards: its place in the fitted camera's frame is the mean of
    what each board says. And with the point fixed in the camera's frame.
    """
    rays = deproject(PIXELS, np.ones(len(PIXELS)), LENS.K, LENS.dist)
    points = range_m * rays / np.linalg.norm(rays, axis=1, keepdims=True)
    moves = result.T_camera_board @ invert_transform(poses)
    in_fitted = np.mean([transform_points(move, points) for move in moves], axis=0)
    K, dist = result.intrinsics.K, result.intrinsics.dist
    return project(in_fitted, K, dist), project(points, K, dist)


BOARDS = (CHARUCO, CHECKERBOARD) if NIGHTLY else (CHARUCO,)  # a checkerboard's poses take long


@pytest.mark.parametrize("board", BOARDS, ids=lambda board: board.kind)
def test_intervals_hold_the_truth_as_often_as_they_say(board: Board) -> None:
    """95 % intervals of parameters and of projected pixels, over fresh sessions."""
    held: dict[str, list[np.ndarray]] = {name: [] for name in (*TRUTH, "world", "camera")}
    for seed in range(5000, 5000 + SESSIONS):
        detections, truth = corner_session(board, LENS, seed)
        result = intrinsics.calibrate(detections, board, guess=LENS)
        for name, value in TRUTH.items():
            low, high = result.interval(name)
            held[name].append(low <= value <= high)
        for range_m in RANGES_M:
            both = seen_again(result, truth.T_camera_board, range_m)
            for fixed, seen in zip(("world", "camera"), both, strict=True):
                covariance = result.projection_covariance(seen, range_m, fixed)
                sigma = np.sqrt(np.einsum("nii->ni", covariance))
                held[fixed].append(np.abs(seen - PIXELS) <= result.quantile() * sigma)
    shares = {name: float(np.mean(values)) for name, values in held.items()}
    print(shares)
    for name, share in shares.items():
        assert WITHIN[0] <= share <= WITHIN[1], name


def test_uncertainty_is_the_spread_over_repeated_sessions() -> None:
    """The same views again and again with fresh noise: parameters and projection scatter so."""
    rng = np.random.default_rng(17)
    clean, truth = corner_session(CHARUCO, LENS, 4, noise_px=0.0)
    values, world, camera, stated = [], [], [], []
    for _ in range(2 * SESSIONS):
        views = [replace(d, pixels=d.pixels + rng.normal(0, 0.08, d.pixels.shape)) for d in clean]
        result = intrinsics.calibrate(views, CHARUCO, guess=LENS)
        values.append([result.value(name) for name in result.names])
        seen = seen_again(result, truth.T_camera_board, 0.45)
        world.append(seen[0])
        camera.append(seen[1])
        projected = [result.projection_covariance(PIXELS, 0.45, to) for to in ("world", "camera")]
        stated.append((result.covariance, *projected))
    given = (CHARUCO, CHARUCO.points, result.names, "brown_conrady")
    model = evaluate(LENS, truth.T_camera_board, clean, *given)
    expected = 0.08 * np.sqrt(np.diag(model.equations.shared_covariance))
    tolerance = 4 / math.sqrt(4 * SESSIONS)  # four sigmas of an empirical deviation
    np.testing.assert_allclose(np.std(values, axis=0) / expected, 1.0, atol=tolerance)
    correlation = np.corrcoef(np.transpose(values))
    covariance, *projections = (np.mean(each, axis=0) for each in zip(*stated, strict=True))
    scale = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(np.std(values, axis=0) / scale, 1.0, atol=tolerance)
    expected = covariance / np.outer(scale, scale)
    np.testing.assert_allclose(correlation, expected, atol=0.15 if NIGHTLY else 0.5)
    for spread, covariance in zip((world, camera), projections, strict=True):
        sigma = np.sqrt(np.einsum("nii->ni", covariance))
        np.testing.assert_allclose(np.std(spread, axis=0) / sigma, 1.0, atol=1.3 * tolerance)


def test_copies_of_views_say_no_more_than_the_views() -> None:
    eight = [*corner_session(CHARUCO, LENS, 4)[0]][:8]
    once, copied = (intrinsics.calibrate(v, CHARUCO, guess=LENS) for v in (eight, 6 * eight))
    np.testing.assert_allclose(copied.covariance, once.covariance, rtol=1e-3)
    assert copied.dof == pytest.approx(once.dof)
    assert "8 views that differ" in copied.verdict()
    assert intrinsics.diagnose(6 * eight, CHARUCO).names[0] == "few_views"


# --- the functions ---


def test_map_is_projection_sigma_on_a_grid_and_that_the_worst_direction() -> None:
    result, grid = fit(CHARUCO, 1), image_grid(LENS, (3, 5))
    assert grid.shape == (3, 5, 2)
    np.testing.assert_array_equal(grid[-1, -1], [639, 479])
    sigma = result.uncertainty_map(0.45, (3, 5))
    covariance = result.projection_covariance(grid, 0.45)
    np.testing.assert_allclose(sigma**2, np.linalg.eigvalsh(covariance)[..., -1])
    one = result.projection_covariance(grid[1, 2], 0.45)
    np.testing.assert_allclose(one, covariance[1, 2])
    assert sigma[0, 0] > 2 * sigma[1, 2]  # least where the boards were


def test_a_very_distant_point_is_a_direction() -> None:
    result = fit(CHARUCO, 1)
    far, nowhere = (result.uncertainty_map(r, (4, 4)) for r in (1e7, math.inf))
    np.testing.assert_allclose(far, nowhere, rtol=1e-4)
    camera = [result.uncertainty_map(r, (4, 4), "camera") for r in (0.45, math.inf)]
    np.testing.assert_allclose(camera[0], camera[1])  # no range matters where nothing moves
