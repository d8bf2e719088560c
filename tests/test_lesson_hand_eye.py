"""What notebook 04 teaches, against OpenCV and simulated sessions."""

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import coursekit as ck
from coursekit.lessons import CHECKPOINTS
from coursekit.lessons import hand_eye as lesson
from coursekit.simulation.arm_sessions import HandEyeMistakes, hand_eye_session


def pairs_of(session):
    T, C = session.T_base_gripper, session.T_camera_board
    return [(T[i], T[j], C[i], C[j]) for i, j in ((0, 1), (3, 7), (5, 2))]


def test_the_right_option_is_the_eye_to_hand_equation() -> None:
    session, truth = hand_eye_session("eye_to_hand", 3, n=8, corner_noise_px=0.0)
    for T_i, T_j, C_i, C_j in pairs_of(session):
        B = C_j @ np.linalg.inv(C_i)
        right = T_j @ np.linalg.inv(T_i)
        as_before = np.linalg.inv(T_j) @ T_i
        assert pytest.approx(right @ truth.X, abs=1e-6) == truth.X @ B
        assert np.abs(truth.X @ B - as_before @ truth.X).max() > 0.01
    options = CHECKPOINTS["hand_eye.eye_to_hand"].lettered()
    assert options["B"].right
    assert "T_base_gripper(j) inverse(T_base_gripper(i))" in options["B"].text


def test_the_rotation_half_is_opencvs_for_motions_without_noise() -> None:
    session, truth = hand_eye_session("eye_in_hand", 3, n=8, corner_noise_px=0.0)
    T, C = session.T_base_gripper, session.T_camera_board
    pairs = [lesson.MOTION_PAIR.model()(T[i], T[i + 1], C[i], C[i + 1]) for i in range(7)]
    R_A, R_B = (np.array([p[k][:3, :3] for p in pairs]) for k in (0, 1))
    R_X = lesson.ROTATION_HALF.model()(R_A, R_B)
    R, _ = cv2.calibrateHandEye(
        T[:, :3, :3], T[:, :3, 3], C[:, :3, :3], C[:, :3, 3], method=cv2.CALIB_HAND_EYE_PARK
    )
    assert pytest.approx(R, abs=1e-4) == R_X
    assert pytest.approx(truth.X[:3, :3], abs=1e-4) == R_X


def test_inverted_poses_leave_centimetres_and_are_not_the_inverse() -> None:
    session, truth = hand_eye_session(
        "eye_in_hand", 3, n=20, mistakes=HandEyeMistakes(inverted_poses=True)
    )
    result = session.solve()
    assert result.spread_gripper_mm > 20
    assert result.spread_gripper_deg > 2
    inverse = np.linalg.inv(truth.X)
    for X in (truth.X, inverse):
        assert np.linalg.norm(result.X[:3, 3] - X[:3, 3]) > 0.02
    assert CHECKPOINTS["hand_eye.inverted_poses"].lettered()["B"].right


def test_three_sessions_are_told_by_what_they_show() -> None:
    """The evidence of notebook 04, with other arms than the one on its page."""
    for name, session in ck.simulation.unknown_sessions(23).items():
        A, B = ck.hand_eye.motions(session.T_base_gripper, session.T_camera_board, "eye_in_hand")
        a, b = (Rotation.from_matrix(T[:, :3, :3]).as_rotvec() for T in (A, B))
        along = [
            np.sum(r * T[:, :3, 3], axis=1) / np.linalg.norm(r, axis=1) for r, T in ((a, A), (b, B))
        ]
        assert np.linalg.norm(a, axis=1) == pytest.approx(np.linalg.norm(b, axis=1), abs=0.02)
        slope = along[0] @ along[1] / (along[0] @ along[0])
        assert slope == pytest.approx(1 / 1.05 if name == "P" else 1.0, abs=0.01)
        spread = session.solve().spread_board_mm
        assert spread > 50 if name == "Q" else spread < 6


def test_more_poses_shrink_the_interval_and_not_the_error() -> None:
    """Over six arms: four times the poses, half the sigma, and no less error to speak of."""
    few, many = [], []
    for seed in range(6):
        for n, kept in ((25, few), (100, many)):
            session, truth = hand_eye_session(
                "eye_in_hand", seed, n=n, arm_errors=ck.arm.ArmErrors()
            )
            result = session.solve(fk=None)
            kept.append([np.linalg.norm(result.X[:3, 3] - truth.X[:3, 3]),
                         np.linalg.norm(result.sigma_mm)])  # fmt: skip
    (error_few, sigma_few), (error_many, sigma_many) = np.median(few, 0), np.median(many, 0)
    assert 0.4 < sigma_many / sigma_few < 0.62
    assert error_many / error_few > 0.6
