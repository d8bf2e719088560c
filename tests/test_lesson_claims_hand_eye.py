"""Rows H1 to H7 of data/claims.csv: hand-eye calibration.

COURSEKIT_NIGHTLY=1 takes more trials.
"""

import math

import cv2
import numpy as np
import pytest
from common import NIGHTLY, derivative
from lesson_claims import ROWS, claim
from scipy.optimize import differential_evolution
from scipy.spatial.transform import Rotation
from simulated_hand_eye import BOARD, arm_session, free_session

import coursekit.hand_eye as he
from coursekit.arm import widowx
from coursekit.geometry import make_transform
from coursekit.hand_eye.poses import camera_board

TRIALS = 2000 if NIGHTLY else 200


def rig(turns_rad: np.ndarray, shifts_m: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """X, and T_base_gripper and T_camera_board (n, 4, 4) that it explains exactly."""
    X = make_transform(Rotation.from_rotvec([0.3, -1.1, 0.4]), [0.03, -0.06, 0.05])
    Y = make_transform(Rotation.from_rotvec([2.9, 0.2, 0.1]), [0.35, 0.05, 0.0])
    pairs = zip(turns_rad, shifts_m, strict=True)
    T = np.stack([make_transform(Rotation.from_rotvec(turn), shift) for turn, shift in pairs])
    return X, T, np.linalg.inv(T @ X) @ Y


def motions(T: np.ndarray, C: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and B of the lesson, for all pairs i < j, by NumPy's inverse."""
    i, j = np.triu_indices(len(T), 1)
    return np.linalg.inv(T[j]) @ T[i], C[j] @ np.linalg.inv(C[i])


@claim("H1", "right")
def test_h1_the_equation() -> None:
    rng = np.random.default_rng(1)
    X, T, C = rig(rng.normal(0, 0.5, (6, 3)), rng.uniform(-0.2, 0.2, (6, 3)))
    A, B = motions(T, C)
    np.testing.assert_allclose(A @ X, X @ B, atol=1e-12)
    for ours, theirs in zip(he.motions(T, C, "eye_in_hand"), (A, B), strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-12)
    # in the other order it does not hold
    i, j = np.triu_indices(len(T), 1)
    swapped = T[i] @ np.linalg.inv(T[j])
    assert np.abs(swapped @ X - X @ B).max() > 0.1


@claim("H2", "right")
def test_h2_its_two_halves() -> None:
    rng = np.random.default_rng(2)
    X, T, C = rig(rng.normal(0, 0.5, (6, 3)), rng.uniform(-0.2, 0.2, (6, 3)))
    A, B = motions(T, C)
    R_X, t_X = X[:3, :3], X[:3, 3]
    np.testing.assert_allclose(A[:, :3, :3] @ R_X, R_X @ B[:, :3, :3], atol=1e-12)
    left = (A[:, :3, :3] - np.eye(3)) @ t_X
    np.testing.assert_allclose(left, B[:, :3, 3] @ R_X.T - A[:, :3, 3], atol=1e-12)
    R = he.rotation_half(A, B)
    np.testing.assert_allclose(R, R_X, atol=1e-9)
    np.testing.assert_allclose(he.translation_half(A, B, R), t_X, atol=1e-9)


def null_space(T: np.ndarray, C: np.ndarray, X: np.ndarray) -> np.ndarray:
    """Directions (k, 6) of X, rotation and translation, that A X = X B does not see.

    From the numerical derivative of A X - X B by exp(rotation) R_X and t_X + translation.
    """
    A, B = motions(T, C)

    def residual(step: np.ndarray) -> np.ndarray:
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        moved = make_transform(turn @ X[:3, :3], X[:3, 3] + step[3:])
        return (A @ moved - moved @ B).ravel()

    _, sizes, directions = np.linalg.svd(derivative(residual, 1e-6, 6), full_matrices=False)
    return directions[sizes < 1e-6 * sizes[0]]


@claim("H3", "right")
def test_h3_two_axes_are_needed() -> None:
    rng = np.random.default_rng(3)
    angles, axis = np.linspace(-0.6, 0.6, 8), np.array([0.6, 0.0, 0.8])
    along = np.concatenate([np.zeros(3), axis])
    X, T, C = rig(angles[:, None] * axis, np.zeros((8, 3)))
    free = null_space(T, C, X)
    assert len(free) == 2
    assert np.linalg.norm(free @ along) == pytest.approx(1, abs=1e-6)  # the shift along the axis
    turn = (free - np.outer(free @ along, along))[:, :3]  # and a turn, which takes a shift along
    turn = turn[np.argmax(np.linalg.norm(turn, axis=1))]
    assert abs(turn @ axis) == pytest.approx(np.linalg.norm(turn), rel=1e-5)
    # Shifts across the axis fix the turn through the second half; the shift along it stays free.
    shifts = rng.uniform(-0.2, 0.2, (8, 3))
    X, T, C = rig(angles[:, None] * axis, shifts)
    free = null_space(T, C, X)
    assert len(free) == 1
    assert abs(free[0] @ along) == pytest.approx(1, abs=1e-6)
    both = np.concatenate([angles[:4, None] * axis, angles[4:, None] * [0.0, 1.0, 0.0]])
    X, T, C = rig(both, shifts)
    assert len(null_space(T, C, X)) == 0
    np.testing.assert_allclose(he.HandEyeSession("eye_in_hand", T, C).solve().X, X, atol=1e-8)

    X, T, C = rig(math.radians(0.5) * rng.uniform(-1, 1, (12, 3)), rng.uniform(-0.2, 0.2, (12, 3)))
    parts = (M[:, :3, columns] for M in (T, C) for columns in (np.s_[:3], 3))
    R, _ = cv2.calibrateHandEye(*parts, method=cv2.CALIB_HAND_EYE_TSAI)
    np.testing.assert_array_equal(R, np.eye(3))
    ROWS["H3"].says("t_X is free along it", "fixed only where")
    ROWS["H3"].says("Tsai solver silently returns the identity")


@claim("H4", "right")
def test_h4_poses_and_range() -> None:
    claimed = {(3, 40): (0.13, 0.8), (2, 40): (0.17, 0.95), (2, 30): (0.22, 1.3)}
    claimed |= {(3, 10): (0.50, 3.0), (2, 10): (0.65, 4.4)}
    ROWS["H4"].says("0.13 deg / 0.8 mm", "0.17 / 0.95", "0.22 / 1.3", "0.5-0.65 deg / 3.0-4.4 mm")
    ROWS["H4"].says("A and B from each pose and the next")
    how = {"ranges_deg": (10, 30, 40), "trials": TRIALS}
    studies = [he.error_study(**how, pairs=pairs) for pairs in ("all", "consecutive")]
    every, following = ({(p.axes, p.range_deg): p for p in study} for study in studies)
    for key, (deg, mm) in claimed.items():
        assert following[key].rotation_deg == pytest.approx(deg, rel=0.1)
        assert 0.85 * every[key].translation_mm < mm < 1.05 * following[key].translation_mm
    gain = [every[key].rotation_deg / following[key].rotation_deg for key in claimed]
    assert np.mean(gain) == pytest.approx(0.8, abs=0.05)  # a fifth
    few, enough, many = he.error_study((6, 15, 30), (30,), (2,), trials=TRIALS)
    assert few.translation_mm > 1.5 * enough.translation_mm > 1.5 * many.translation_mm


@claim("H5", "right")
def test_h5_a_grid_without_rotation() -> None:
    places = np.zeros((25, 3))
    places[:, :2] = 0.03 * np.mgrid[-2:3, -2:3].reshape(2, -1).T
    X, T, C = rig(np.tile([2.0, 0.5, -0.3], (25, 1)), places)
    A, B = motions(T, C)
    np.testing.assert_allclose(A[:, :3, :3], np.tile(np.eye(3), (300, 1, 1)), atol=1e-12)
    np.testing.assert_allclose(A[:, :3, 3], B[:, :3, 3] @ X[:3, :3].T, atol=1e-12)
    elsewhere = make_transform(X[:3, :3], X[:3, 3] + [0.5, -0.2, 1.0])
    np.testing.assert_allclose(A @ elsewhere, elsewhere @ B, atol=1e-12)  # t_X has dropped out
    free = null_space(T, C, X)
    assert np.linalg.matrix_rank(free[:, 3:]) == len(free) == 3
    np.testing.assert_allclose(he.rotation_from_shifts(T, C, "eye_in_hand"), X[:3, :3], atol=1e-9)
    with pytest.raises(he.NotDetermined, match="translation is free in all directions"):
        he.HandEyeSession("eye_in_hand", T, C).solve()
    ROWS["H5"].says("t_A = R_X t_B", "t_X drops out altogether")


@claim("H6", "right")
def test_h6_held_out_poses_in_pixels_and_millimetres() -> None:
    rest = arm_session(6, n=30)
    test = rest.part(slice(15, None))

    fit = rest.part(slice(0, 15)).solve("closed_form")
    other = free_session(6, n=15, tilt_deg=4.0).solve("closed_form")  # another rig's X
    good, narrow = (he.held_out(one, test.T, test.session.seen) for one in (fit, other))
    assert narrow.rms_px > 3 * good.rms_px
    assert narrow.rms_mm > 3 * good.rms_mm
    # Millimetres by hand: the board as predicted against the board as the truth has it
    predicted = camera_board(test.T, fit.X, fit.Y, "eye_in_hand")
    off = predicted - test.exact
    gaps = [T[:3, :3] @ point + T[:3, 3] for T in off for point in BOARD.points]
    own_mm = 1e3 * np.sqrt(np.mean(np.sum(np.square(gaps), axis=-1)))
    assert 0.3 < own_mm / good.rms_mm < 1.1  # the rest is the noise of the held-out images
    ROWS["H6"].says("in mm at the board")


@claim("H7", "right")
def test_h7_reach() -> None:
    arm = widowx()
    axis_at = arm.origins[0][:3, 3]

    def farthest(length) -> float:
        """joint_0 turns the whole and joint_5 the fingers about themselves: neither matters."""

        def nearness(q):
            return -length(arm.forward(np.pad(q.T, [(0, 0), (1, 1)]))[:, :3, 3] - axis_at)

        how = {"rng": 0, "tol": 1e-10, "maxiter": 200, "vectorized": True, "updating": "deferred"}
        return -float(differential_evolution(nearness, arm.limits[1:5], **how).fun)

    radius = farthest(lambda p: np.hypot(p[:, 0], p[:, 1]))
    reach = farthest(lambda p: np.linalg.norm(p, axis=1))
    ROWS["H7"].says(f"{radius:.4f} m", f"{reach:.3f} m", "0.7699 m is the largest horizontal")
    assert radius == pytest.approx(0.769, abs=0.0015)
    turned = arm.forward([1.0, 0.9, 0.8, 0.3, 0.2, 0.0])[:3, 3]
    plain = arm.forward([0.0, 0.9, 0.8, 0.3, 0.2, 2.0])[:3, 3]
    assert np.linalg.norm(turned - axis_at) == pytest.approx(np.linalg.norm(plain - axis_at))
    assert 0.100 / 1.5 < 0.07
    ROWS["H7"].says(f"{100 * 0.100 / 1.5:.1f} % of the payload")
