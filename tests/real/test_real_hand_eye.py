"""Hand-eye data that MoveIt publishes with its calibration plugin, and the answer in its tests."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import coursekit.hand_eye as he
from coursekit.boards import Board, detect
from coursekit.geometry import Intrinsics, pose_difference

pytestmark = pytest.mark.real

PUBLISHED_M = np.array([0.659, -0.249, 0.830])
PUBLISHED_EULER = (0.230, -2.540, 1.950)  # about x, then the new y, then the new z
BOARD_M = np.array([0.0975, 0.1028, 0.3256])


@pytest.fixture(scope="module")
def session(moveit_poses):
    """Fifty pairs of arm pose and board pose; the camera stands beside the arm."""
    return he.HandEyeSession("eye_to_hand", *moveit_poses)


@pytest.mark.parametrize("method", he.METHODS)
def test_every_solver_finds_the_published_camera(session, method):
    result = session.solve(method)
    np.testing.assert_allclose(result.X[:3, 3], PUBLISHED_M, rtol=0.01)
    published = Rotation.from_euler("XYZ", PUBLISHED_EULER)
    off = Rotation.from_matrix(result.X[:3, :3]) * published.inv()
    assert off.magnitude() < 0.01
    assert result.spread_board_mm == pytest.approx(4.6, abs=0.05)
    assert result.free == ()


def test_the_interval_of_the_refinement_holds_all_solvers(session):
    result = session.solve()
    sigma = np.sqrt(np.diag(result.covariance)[:6])
    for method in he.CLOSED_FORMS:
        off = pose_difference(result.X, session.solve(method).X)
        assert (np.abs(off) < result.quantile() * sigma).all()
    free = session.solve(free_scale=True)
    assert abs(free.scale - 1) < 2 * free.sigma("scale") < 0.005


@pytest.mark.parametrize(("old_origin", "off_m"), [(True, 0.0), (False, 0.197)])
def test_the_published_pose_of_the_board_has_the_old_origin(real_data, old_origin, off_m):
    image = cv2.imread(str(real_data / "moveit_hand_eye/test_charuco_board_detection.jpg"))
    board = Board("charuco", (5, 7), 0.1971 / 7, 0.0176, "DICT_5X5_250", old_origin=old_origin)
    lens = Intrinsics(
        640, 480, 590.6972, 592.8468, 322.3310, 247.4003,
        "brown_conrady", (0.15405, -0.24917, 0.0035079, -0.0011004, 0.0),
    )  # fmt: skip
    (pose,) = he.board_poses([detect(image, board)], board, lens)
    away = np.linalg.norm(pose.T_camera_board[:3, 3] - BOARD_M)
    assert away == pytest.approx(off_m, abs=2e-3)
    assert pose.rms_px < 0.4
    assert pose.other is None
