"""Where things are by default, and joint configurations to calibrate with: careful, degenerate."""

from dataclasses import replace

import numpy as np
import pytest
from common import refusals
from scipy.spatial.transform import Rotation

from coursekit.boards import Board
from coursekit.boards.board import BORDER_PX
from coursekit.geometry import make_transform, project, transform_points
from coursekit.hand_eye import MOUNTS
from coursekit.simulation import arm_poses as poses
from coursekit.simulation import default_setup
from tools import degenerate_poses

BOARD = Board("charuco", (9, 6), 0.02)


def check_allowed(setup: poses.Setup, q: np.ndarray) -> None:
    """By other means than the sampler's: corner by corner and chain by chain."""
    arm, lens, board = setup.arm, setup.intrinsics, setup.board
    arm.check(q)
    for T in arm.forward(q):
        assert T[2, 3] >= poses.CLEARANCE_M
        if setup.mount == "eye_in_hand":
            T_base_camera, T_base_board = T @ setup.X, setup.Y
            assert T_base_camera[2, 3] >= poses.CLEARANCE_M
        else:
            T_base_camera, T_base_board = setup.X, T @ setup.Y
            assert transform_points(T_base_board, board.points)[:, 2].min() >= poses.CLEARANCE_M
        T_camera_board = np.linalg.inv(T_base_camera) @ T_base_board
        pixels = project(transform_points(T_camera_board, board.points), lens.K, lens.dist)
        assert ((pixels >= BORDER_PX) & (pixels <= np.array(lens.size) - 1 - BORDER_PX)).all()
        eye = np.linalg.inv(T_camera_board)[:3, 3]
        assert eye[2] < 0  # in front of the pattern


@pytest.mark.parametrize("mount", MOUNTS)
def test_careful_poses_see_the_board_and_turn_far(mount: str) -> None:
    setup = default_setup(mount)
    q = poses.careful_poses(setup, np.random.default_rng(0), 20)
    assert q.shape == (20, 6)
    check_allowed(setup, q)
    R = Rotation.from_matrix(setup.arm.forward(q)[:, :3, :3])
    pairs = (R[0].inv() * R).as_rotvec()
    assert np.linalg.svd(pairs, compute_uv=False)[1] / np.sqrt(20) > np.radians(10)
    assert poses.half_turns(setup.arm.forward(q))[1] >= np.radians(30)
    again = poses.careful_poses(setup, np.random.default_rng(1), 10, pool=q)
    assert {tuple(row) for row in again} <= {tuple(row) for row in q}


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("design", ["grid", "single_axis", "small_rotations"])
def test_stored_sets_are_allowed_and_as_degenerate_as_they_say(mount: str, design: str) -> None:
    setup, sets = default_setup(mount), poses.degenerate_poses(mount, design)
    assert sets.shape == (degenerate_poses.VARIANTS, degenerate_poses.POSES, 6)
    for q in sets:
        check_allowed(setup, q)
        T = setup.arm.forward(q)
        R = Rotation.from_matrix(T[:, :3, :3])
        turns = (R * R[12].inv()).as_rotvec()
        if design == "grid":
            assert np.abs(turns).max() < 1e-6
            assert np.ptp(T[:, :3, 3], axis=0) == pytest.approx([0.1, 0.1, 0.0], abs=1e-6)
            continue
        assert T[:, :3, 3].std(axis=0).min() > 3e-3
        if design == "single_axis":
            assert np.abs(turns[:, :2]).max() < 1e-6
            assert np.abs(turns[[0, -1], 2]) == pytest.approx(np.radians(30), abs=1e-6)
        else:
            assert np.radians(1) < np.linalg.norm(turns, axis=1).max() <= np.radians(6) + 1e-7


def test_the_search_finds_a_stored_set_again() -> None:
    setup, rng = default_setup("eye_in_hand"), np.random.default_rng([0, 1])
    stored = poses.degenerate_poses("eye_in_hand", "grid")[0]
    np.testing.assert_allclose(degenerate_poses.translation_grid(setup, rng), stored, atol=1e-7)


def test_the_default_places_are_what_they_say() -> None:
    T = poses.board_on_table(BOARD)
    assert transform_points(T, BOARD.points.mean(axis=0)) == pytest.approx([0.4, 0.0, 0.0])
    assert T[:3, 2] == pytest.approx([0, 0, -1])  # into the table
    T = poses.over_the_shoulder()
    assert T[:3, 0][2] == pytest.approx(0.0)  # level
    assert T[:3, 1][2] < 0  # image down is down
    held = poses.board_in_gripper(BOARD)
    nearest = transform_points(held, BOARD.points)[:, 0].min()
    assert nearest == pytest.approx(poses.FINGERS_M + BOARD.square_m)
    assert held[:3, 2] == pytest.approx([0, -1, 0])


SETUP, RNG = default_setup("eye_in_hand"), np.random.default_rng(0)
AWAY = replace(SETUP, Y=make_transform(SETUP.Y[:3, :3], (2.0, 0.0, 0.0)))

test_what_cannot_be_is_refused = refusals(
    ("mount: got 'wrist'", lambda: replace(SETUP, mount="wrist")),
    ("share: got 0", lambda: replace(SETUP, share=0)),
    ("n: got 2, want at least 3", lambda: poses.careful_poses(SETUP, RNG, 2)),
    ("only 0 of .* have the board in", lambda: poses.random_poses(AWAY, RNG, 3)),
)
