"""Simulated corner-level sessions against OpenCV's projection and against brute force."""

from dataclasses import replace

import numpy as np
import pytest
from common import by_opencv, named, refusals
from scipy.optimize import brentq
from simulated_corners import CHARUCO, CHECKERBOARD, LENS, fisheye, quotient

from coursekit.boards import Board
from coursekit.geometry import Intrinsics, project
from coursekit.simulation.corner_sessions import Effects, bowed, corner_session, rolling_shutter

BOWED, LARGER = bowed(CHECKERBOARD, 1e-3), 1.03 * CHECKERBOARD.points


def tilts_deg(truth) -> np.ndarray:
    return np.degrees(np.arccos(truth.T_camera_board[:, 2, 2]))


@pytest.mark.parametrize(
    ("board", "effects", "points"),
    [
        (CHARUCO, Effects(), CHARUCO.points),
        (CHECKERBOARD, Effects(), CHECKERBOARD.points),
        (CHECKERBOARD, Effects(bow_m=1e-3), BOWED),
        (CHECKERBOARD, Effects(square_scale=1.03), LARGER),
        (CHECKERBOARD, Effects(focus_drift=0.02), CHECKERBOARD.points),
    ],
)
def test_a_session_is_opencvs_projection_of_its_points(board, effects, points) -> None:
    session, truth = corner_session(board, LENS, seed=6, noise_px=0.0, effects=effects)
    drift, most = np.abs(truth.draw.focal_scale - 1).max(), effects.focus_drift
    assert 0.75 * most <= drift <= most
    for view, T, scale in zip(session, truth.T_camera_board, truth.draw.focal_scale, strict=True):
        lens = replace(LENS, fx=LENS.fx * scale, fy=LENS.fy * scale)
        assert np.abs(view.pixels - by_opencv(points[view.ids], T, lens)).max() < 1e-9


@pytest.mark.parametrize("board", [CHARUCO, CHECKERBOARD])
def test_a_healthy_session_covers_the_image(board: Board) -> None:
    session, truth = corner_session(board, LENS, seed=1, noise_px=0.0)
    assert len(session) == 28
    for view, T, depth in zip(session, truth.T_camera_board, truth.depth_m, strict=True):
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
    assert truth.draw.effects == Effects()


def test_an_effect_leaves_poses_and_noise_of_the_seed_as_they_are() -> None:
    healthy, truth = corner_session(CHARUCO, LENS, seed=5)
    spoiled, same = corner_session(CHARUCO, LENS, seed=5, effects=Effects(spoiled_px=3.0))
    assert (truth.T_camera_board == same.T_camera_board).all()
    pairs = zip(healthy, spoiled, strict=True)
    off = [np.linalg.norm(a.pixels - b.pixels, axis=1) for a, b in pairs]
    assert same.draw.spoiled_view is not None
    assert np.allclose(off.pop(same.draw.spoiled_view), 3.0)
    assert max(o.max() for o in off) == 0.0


def test_a_bowed_board_is_a_paraboloid_that_stands_out_towards_the_camera() -> None:
    points = BOWED
    centre = CHECKERBOARD.points.mean(axis=0)
    radius = np.linalg.norm(points[:, :2] - centre[:2], axis=1)
    assert np.allclose(points[radius == radius.max(), 2], 0.0)
    slope, offset = np.polyfit(radius**2, points[:, 2], 1)
    assert np.allclose(points[:, 2], slope * radius**2 + offset, atol=1e-15)
    assert offset == pytest.approx(-1e-3)  # z points away from the viewer


def test_a_rolling_shutter_sees_each_corner_at_the_time_of_its_row() -> None:
    """Brute force: the root of v(t) = row(t), by bisection, with OpenCV's projection."""
    effects = Effects(readout_s=0.02, speed_m_s=0.1)
    session, truth = corner_session(CHECKERBOARD, LENS, seed=8, noise_px=0.0, effects=effects)
    assert np.allclose(np.linalg.norm(truth.draw.velocity_m_s, axis=1), 0.1)
    moved = 0.0
    for i in (0, 9, 21):
        T, velocity = truth.T_camera_board[i], truth.draw.velocity_m_s[i]
        still = by_opencv(CHECKERBOARD.points, T, LENS)
        moved = max(moved, np.abs(session[i].pixels - still).max())
        for corner in (0, 13, 53):
            point = CHECKERBOARD.points[corner] @ T[:3, :3].T + T[:3, 3]

            def at(time: float, point: np.ndarray = point, v: np.ndarray = velocity) -> np.ndarray:
                return by_opencv((point + time * v)[None], np.eye(4), LENS)[0]

            def late(time: float, at=at) -> float:
                return time - ((at(time)[1] + 0.5) / 480 - 0.5) * 0.02

            time = brentq(late, -0.02, 0.02, xtol=1e-16)
            assert np.abs(session[i].pixels[corner] - at(time)).max() < 1e-6
    assert moved > 0.3


def test_the_limits_of_tilt_and_of_the_image_hold() -> None:
    _, truth = corner_session(CHARUCO, LENS, seed=9, effects=Effects(max_tilt_deg=3.0))
    assert 2 < tilts_deg(truth).max() <= 3
    inner, _ = corner_session(CHARUCO, LENS, seed=9, effects=Effects(inner_only=0.15))
    pixels = np.concatenate([view.pixels for view in inner])
    margin = 0.15 * np.array(LENS.size)
    assert (pixels >= margin - 1).all()  # the noise moves them a little
    assert (pixels <= np.array(LENS.size) - margin).all()


def session(board=CHARUCO, **changes):
    return corner_session(board, LENS, seed=0, **changes)


# --- ordinary sessions ---


def test_paper_is_as_wavy_and_as_oblique_as_was_asked_for() -> None:
    """Heights over the best plane have their rms; fields of one reach differ between seeds."""
    effects = Effects(wave_m=3e-4, wave_reach=0.2, print_error=3e-3)
    shapes = [
        corner_session(CHECKERBOARD, LENS, seed, 1, 0, effects)[1].points for seed in range(40)
    ]
    plane = np.column_stack([CHECKERBOARD.points[:, :2], np.ones(len(CHECKERBOARD.points))])
    for points in shapes[:5]:
        off = points[:, 2] - plane @ np.linalg.lstsq(plane, points[:, 2], rcond=None)[0]
        assert np.sqrt(np.mean(off**2)) == pytest.approx(3e-4, rel=1e-6)
    errors = np.stack([np.linalg.lstsq(plane[:, :2], p[:, :2], rcond=None)[0] for p in shapes])
    wide, high = errors[:, 0, 0] - 1, errors[:, 1, 1] - 1
    for part in (wide, high, errors[:, 1, 0]):
        assert 2e-3 < part.std() < 4e-3
    assert np.allclose(errors[:, 0, 1], 0)
    assert abs(np.corrcoef(wide, high)[0, 1]) < 0.5


def test_neighbours_share_a_part_of_their_errors_and_the_detector_says_less() -> None:
    still, _ = corner_session(CHECKERBOARD, LENS, 3, 30, 0.0)
    effects = Effects(shared=1.0, claimed=0.1)
    found, _ = corner_session(CHECKERBOARD, LENS, 3, 30, 0.1, effects)
    errors = np.stack([b.pixels - a.pixels for a, b in zip(still, found, strict=True)])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(0.1 * np.sqrt(2), rel=0.1)
    lattice = errors.reshape(30, 6, 9, 2) / errors.std()
    near, far = (lattice[:, :, k:] * lattice[:, :, : 9 - k] for k in (1, 7))
    assert 0.3 < near.mean() < 0.6  # half of exp(-1/8)
    assert abs(far.mean()) < 0.15
    assert {round(view.noise_px, 12) for view in found} == {0.01}


def test_a_session_looks_through_another_lens() -> None:
    """A fisheye, which grows with the angle, and a quotient of polynomials."""
    lens = Intrinsics(640, 480, 250.0, 251.0, 322.0, 238.0)
    found, truth = corner_session(CHECKERBOARD, lens, 2, 12, 0.0, Effects(see=fisheye))
    for view, T in zip(found, truth.T_camera_board, strict=True):
        x, y, z = (truth.points[view.ids] @ T[:3, :3].T + T[:3, 3]).T
        across = np.hypot(x, y)
        ray = np.arctan2(across, z) / across
        expected = np.column_stack([250 * x * ray + 322, 251 * y * ray + 238])
        assert np.abs(view.pixels - expected).max() < 1e-6
    assert np.degrees(max(np.arctan2(np.hypot(*p[:2]), p[2]) for p in rays_of(truth))) > 55
    bent = replace(LENS, fx=300.0, fy=300.0)
    found, truth = corner_session(CHARUCO, bent, 2, 6, 0.0, Effects(see=quotient))
    for view, T in zip(found, truth.T_camera_board, strict=True):
        x, y, z = (truth.points[view.ids] @ T[:3, :3].T + T[:3, 3]).T
        x, y, (k1, k2, p1, p2, k3) = x / z, y / z, bent.coeffs
        r2 = x * x + y * y
        radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + 0.4 * r2)
        u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        expected = np.column_stack([300 * u + bent.cx, 300 * v + bent.cy])
        assert np.abs(view.pixels - expected).max() < 1e-6


def rays_of(truth) -> np.ndarray:
    """Where the corners of all poses are in the camera's frame, (n, 3)."""
    R, t = truth.T_camera_board[:, :3, :3], truth.T_camera_board[:, None, :3, 3]
    return (truth.points @ np.swapaxes(R, 1, 2) + t).reshape(-1, 3)


FAR, FAST = np.array([[0.0, 0.1, 0.5]]), np.array([0.0, 500.0, 0.0])

test_what_cannot_be_is_refused = refusals(
    *named(Effects, focus_drift=[-0.1], bow_m=[float("nan")], max_tilt_deg=[80.0]),
    *named(Effects, inner_only=[0.4], blur_share=[1.5], square_scale=[0.0], wave_reach=[0.0]),
    *named(Effects, wave_m=[-1e-3], shared=[-1.0]),
    *named(session, views=[0], noise_px=[-1]),
    ("board: 3.000 x 2.100 m does not fit", lambda: session(replace(CHECKERBOARD, square_m=0.3))),
    (
        "velocity: 500 m/s",
        lambda: rolling_shutter(FAR, FAST, 0.02, 480, lambda p: project(p, LENS.K)),
    ),
)
