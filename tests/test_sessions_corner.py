"""Simulated corner-level sessions against OpenCV's projection and against brute force."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation

from coursekit.boards import Board
from coursekit.geometry import Intrinsics
from coursekit.simulation.corner_sessions import (
    Effects,
    Truth,
    bowed,
    corner_session,
    rolling_shutter,
)

LENS = Intrinsics(
    640, 480, 612.0, 610.0, 322.0, 238.0, "brown_conrady", (-0.12, 0.08, 0.001, -0.0008, 0.02)
)
CHARUCO = Board("charuco", (9, 6), 0.025)
CHECKERBOARD = Board("checkerboard", (10, 7), 0.025)


def opencv(points: np.ndarray, T: np.ndarray, lens: Intrinsics = LENS) -> np.ndarray:
    rotation = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    pixels, _ = cv2.projectPoints(points, rotation, T[:3, 3], lens.K, np.array(lens.coeffs))
    return pixels[:, 0]


def tilts_deg(truth: Truth) -> np.ndarray:
    return np.degrees(np.arccos(truth.T_camera_board[:, 2, 2]))


@pytest.mark.parametrize("board", [CHARUCO, CHECKERBOARD])
def test_a_healthy_session_is_opencvs_projection_and_covers_the_image(board: Board) -> None:
    session, truth = corner_session(board, LENS, seed=1, noise_px=0.0)
    assert len(session) == 28
    for view, T, depth in zip(session, truth.T_camera_board, truth.depth_m, strict=True):
        assert np.abs(view.pixels - opencv(board.points[view.ids], T)).max() < 1e-9
        assert np.abs(depth - (board.points[view.ids] @ T[2, :3] + T[2, 3])).max() < 1e-12
    pixels = np.concatenate([view.pixels for view in session])
    assert (pixels >= 6).all()
    assert (pixels <= np.array(LENS.size) - 7).all()
    assert (pixels.min(axis=0) < 0.12 * np.array(LENS.size)).all()
    assert (pixels.max(axis=0) > 0.88 * np.array(LENS.size)).all()
    normals = truth.T_camera_board[:, :3, 2]
    assert 35 < tilts_deg(truth).max() <= 45
    assert np.degrees(np.arcsin(normals[:, :2])).std(axis=0).min() > 15  # about both axes
    distance = truth.T_camera_board[:, 2] @ [*board.points.mean(axis=0), 1.0]
    assert (distance > 0.3).all()
    assert (distance < 0.8).all()


def test_a_checkerboard_is_seen_whole_and_a_charuco_board_in_part() -> None:
    whole, _ = corner_session(CHECKERBOARD, LENS, seed=2)
    assert {len(view) for view in whole} == {len(CHECKERBOARD.points)}
    partial, _ = corner_session(CHARUCO, LENS, seed=2)
    assert min(len(view) for view in partial) < len(CHARUCO.points)
    assert min(len(view) for view in partial) >= 0.4 * len(CHARUCO.points)


def test_the_noise_has_the_size_asked_for_and_the_same_seed_the_same_bytes() -> None:
    first, truth = corner_session(CHECKERBOARD, LENS, seed=3, noise_px=0.08)
    again, _ = corner_session(CHECKERBOARD, LENS, seed=3, noise_px=0.08)
    exact, _ = corner_session(CHECKERBOARD, LENS, seed=3, noise_px=0.0)
    other, _ = corner_session(CHECKERBOARD, LENS, seed=4, noise_px=0.08)
    noise = np.concatenate([a.pixels - b.pixels for a, b in zip(first, exact, strict=True)]).ravel()
    assert all((a.pixels == b.pixels).all() for a, b in zip(first, again, strict=True))
    assert not (first[0].pixels == other[0].pixels).any()
    # 3024 coordinates: the std is known to 1.3 %, four of those
    assert abs(noise.std() / 0.08 - 1) < 0.052
    assert truth.effects == Effects()


def test_an_effect_leaves_poses_and_noise_of_the_seed_as_they_are() -> None:
    healthy, truth = corner_session(CHARUCO, LENS, seed=5)
    spoiled, same = corner_session(CHARUCO, LENS, seed=5, effects=Effects(spoiled_px=3.0))
    assert (truth.T_camera_board == same.T_camera_board).all()
    off = [
        np.linalg.norm(a.pixels - b.pixels, axis=1) for a, b in zip(healthy, spoiled, strict=True)
    ]
    assert same.spoiled_view is not None
    assert np.allclose(off.pop(same.spoiled_view), 3.0)
    assert max(o.max() for o in off) == 0.0


def test_a_bowed_board_is_a_paraboloid_that_stands_out_towards_the_camera() -> None:
    points = bowed(CHECKERBOARD, 1e-3)
    centre = CHECKERBOARD.points.mean(axis=0)
    radius = np.linalg.norm(points[:, :2] - centre[:2], axis=1)
    assert np.allclose(points[radius == radius.max(), 2], 0.0)
    slope, offset = np.polyfit(radius**2, points[:, 2], 1)
    assert np.allclose(points[:, 2], slope * radius**2 + offset, atol=1e-15)
    assert offset == pytest.approx(-1e-3)  # z points away from the viewer
    session, truth = corner_session(
        CHECKERBOARD, LENS, seed=6, noise_px=0.0, effects=Effects(bow_m=1e-3)
    )
    for view, T in zip(session, truth.T_camera_board, strict=True):
        assert np.abs(view.pixels - opencv(points[view.ids], T)).max() < 1e-9


def test_the_focal_length_of_each_view_drifts_within_the_share() -> None:
    session, truth = corner_session(
        CHECKERBOARD, LENS, seed=7, views=40, noise_px=0.0, effects=Effects(focus_drift=0.02)
    )
    assert 0.015 < np.abs(truth.focal_scale - 1).max() <= 0.02
    for view, T, scale in zip(session, truth.T_camera_board, truth.focal_scale, strict=True):
        lens = Intrinsics(
            640, 480, LENS.fx * scale, LENS.fy * scale, LENS.cx, LENS.cy, LENS.model, LENS.coeffs
        )
        pixels = opencv(CHECKERBOARD.points[view.ids], T, lens)
        assert np.abs(view.pixels - pixels).max() < 1e-9


def test_a_rolling_shutter_sees_each_corner_at_the_time_of_its_row() -> None:
    """Brute force: the root of v(t) = row(t), by bisection, with OpenCV's projection."""
    effects = Effects(readout_s=0.02, speed_m_s=0.1)
    session, truth = corner_session(CHECKERBOARD, LENS, seed=8, noise_px=0.0, effects=effects)
    assert np.allclose(np.linalg.norm(truth.velocity_m_s, axis=1), 0.1)
    moved = 0.0
    for i in (0, 9, 21):
        T, velocity = truth.T_camera_board[i], truth.velocity_m_s[i]
        still = opencv(CHECKERBOARD.points, T)
        moved = max(moved, np.abs(session[i].pixels - still).max())
        for corner in (0, 13, 53):
            point = CHECKERBOARD.points[corner] @ T[:3, :3].T + T[:3, 3]

            def at(time: float, point: np.ndarray = point, v: np.ndarray = velocity) -> np.ndarray:
                return opencv((point + time * v)[None], np.eye(4))[0]

            def late(time: float, at=at) -> float:  # type: ignore[no-untyped-def]
                return time - ((at(time)[1] + 0.5) / 480 - 0.5) * 0.02

            time = brentq(late, -0.02, 0.02, xtol=1e-16)
            assert np.abs(session[i].pixels[corner] - at(time)).max() < 1e-6
    assert moved > 0.3


def test_a_shutter_slower_than_the_image_is_refused() -> None:
    points = np.array([[0.0, 0.1, 0.5]])
    with pytest.raises(ValueError, match="velocity: 500 m/s"):
        rolling_shutter(points, np.array([0.0, 500.0, 0.0]), 0.02, 480, LENS.K, None)


def test_the_limits_of_tilt_and_of_the_image_hold() -> None:
    _, truth = corner_session(CHARUCO, LENS, seed=9, effects=Effects(max_tilt_deg=3.0))
    assert 2 < tilts_deg(truth).max() <= 3
    inner, _ = corner_session(CHARUCO, LENS, seed=9, effects=Effects(inner_only=0.15))
    pixels = np.concatenate([view.pixels for view in inner])
    margin = 0.15 * np.array(LENS.size)
    assert (pixels >= margin - 1).all()  # the noise moves them a little
    assert (pixels <= np.array(LENS.size) - margin).all()


def test_blurred_views_have_the_covariance_of_a_uniform_motion() -> None:
    session, truth = corner_session(CHARUCO, LENS, seed=10, views=30, effects=Effects(blur_px=3.0))
    assert len(truth.blurred) == 10
    for i, view in enumerate(session):
        assert view.blur is not None
        along = np.linalg.eigvalsh(view.blur)[1]
        base = 0.666**2
        wanted = base + 9 / 12 if i in truth.blurred else base
        assert along == pytest.approx(wanted, rel=0.25)


def test_single_bad_corners_are_off_by_what_was_asked_for() -> None:
    effects = Effects(bad_corners=4, bad_corner_px=5.0)
    healthy, _ = corner_session(CHARUCO, LENS, seed=11)
    session, truth = corner_session(CHARUCO, LENS, seed=11, effects=effects)
    assert len(truth.bad_corners) == 4
    found = {
        (i, int(corner))
        for i, (a, b) in enumerate(zip(healthy, session, strict=True))
        for corner in a.ids[np.linalg.norm(a.pixels - b.pixels, axis=1) > 1]
    }
    assert found == set(truth.bad_corners)


def test_larger_squares_are_seen_as_a_larger_board() -> None:
    session, truth = corner_session(
        CHECKERBOARD, LENS, seed=12, noise_px=0.0, effects=Effects(square_scale=1.03)
    )
    T = truth.T_camera_board[0]
    assert np.abs(session[0].pixels - opencv(1.03 * CHECKERBOARD.points, T)).max() < 1e-9


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"focus_drift": -0.1}, "focus_drift: got -0.1"),
        ({"bow_m": float("nan")}, "bow_m"),
        ({"max_tilt_deg": 80.0}, "max_tilt_deg: got 80.0"),
        ({"inner_only": 0.4}, "inner_only: got 0.4"),
        ({"blur_share": 1.5}, "blur_share"),
        ({"square_scale": 0.0}, "square_scale"),
    ],
)
def test_effects_that_cannot_be_are_refused(fields: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Effects(**fields)  # type: ignore[arg-type]


def test_sessions_that_cannot_be_are_refused() -> None:
    with pytest.raises(ValueError, match="views: got 0"):
        corner_session(CHARUCO, LENS, seed=0, views=0)
    with pytest.raises(ValueError, match="noise_px: got -1"):
        corner_session(CHARUCO, LENS, seed=0, noise_px=-1)
    with pytest.raises(ValueError, match=r"board: 3\.000 x 2\.100 m does not fit"):
        corner_session(Board("checkerboard", (10, 7), 0.3), LENS, seed=0, views=3)
