"""The fit: against OpenCV, numerical derivatives, dense algebra, and bad input."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from simulated_corners import CHARUCO, CHECKERBOARD, LENS, fit

from coursekit import intrinsics
from coursekit.boards import Detection, Detections
from coursekit.geometry import Intrinsics, moved, project
from coursekit.intrinsics.derivatives import (
    PARAMETERS,
    parameter_vector,
    project_with_derivatives,
    scaled_inverse,
    selection,
    with_parameters,
)
from coursekit.simulation.corner_sessions import Effects, bowed, corner_session


@pytest.fixture(scope="module")
def session() -> tuple[Detections, np.ndarray]:
    detections, truth = corner_session(CHARUCO, LENS, seed=1)
    return detections, truth.T_camera_board


@pytest.fixture(scope="module")
def result():
    return fit(CHARUCO, 1)


def corners_for_opencv(detections, board=CHARUCO):
    return (
        [board.points[d.ids].astype(np.float32) for d in detections],
        [d.pixels.astype(np.float32) for d in detections],
    )


# --- the estimate ---


def test_estimate_and_deviations_are_opencvs(session, result):
    """Its stdDeviationsIntrinsics come from its own Jacobian, in another parametrisation."""
    cv2.setNumThreads(1)
    rms, K, dist, _, _, deviations, _, per_view = cv2.calibrateCameraExtended(
        *corners_for_opencv(session[0]), LENS.size, None, None
    )
    assert result.converged
    assert result.rms_px == pytest.approx(rms, rel=1e-4)
    np.testing.assert_allclose(result.per_view_rms_px, per_view.ravel(), rtol=1e-3)
    np.testing.assert_allclose(result.intrinsics.K, K, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(result.intrinsics.coeffs, dist.ravel(), rtol=1e-2)
    ours = [result.sigma(name) for name in PARAMETERS]
    np.testing.assert_allclose(ours, deviations.ravel()[:9], rtol=1e-4)


@pytest.mark.parametrize("model", intrinsics.MODELS)
@pytest.mark.parametrize("same_focal", [False, True])
def test_corners_without_noise_give_the_lens_back(model, same_focal):
    free = intrinsics.MODELS[model]
    names = ("k1", "k2", "p1", "p2", "k3")
    coeffs = tuple(
        value if name in free else 0.0 for name, value in zip(names, LENS.coeffs, strict=True)
    )
    lens = replace(LENS, coeffs=coeffs, fy=LENS.fx if same_focal else LENS.fy)
    detections, truth = corner_session(CHARUCO, lens, seed=2, views=8, noise_px=0.0)
    fit = intrinsics.calibrate(detections, CHARUCO, model=model, same_focal=same_focal)
    assert fit.converged
    assert fit.names == (*(("f",) if same_focal else ("fx", "fy")), "cx", "cy", *free)
    np.testing.assert_allclose(fit.intrinsics.K, lens.K, atol=2e-3)  # its corners are float32
    np.testing.assert_allclose(fit.intrinsics.coeffs, coeffs, atol=2e-4)
    np.testing.assert_allclose(fit.T_camera_board, truth.T_camera_board, atol=1e-5)


def test_nearly_parallel_boards_converge_where_opencvs_own_limit_stops_short():
    """At 30 iterations OpenCV ends at more than twice the focal length with an RMS of 0.13 px."""
    detections, _ = corner_session(CHARUCO, LENS, 0, effects=Effects(max_tilt_deg=3.0))
    fit = intrinsics.calibrate(detections, CHARUCO)
    assert fit.converged
    assert abs(fit.value("fx") - LENS.fx) < 3 * fit.sigma("fx")
    rms, K, *_ = cv2.calibrateCamera(*corners_for_opencv(detections), LENS.size, None, None)
    assert fit.rms_px < rms < 0.15
    assert K[0, 0] > 2 * LENS.fx


def test_a_start_that_leads_nowhere_is_followed_by_a_plain_one():
    """From its own start OpenCV's solver ends at f = 14,874 px here, whatever the iterations."""
    detections, _ = corner_session(CHARUCO, LENS, 7, effects=Effects(max_tilt_deg=3.0))
    views = [view for index, view in enumerate(detections) if index % 5 != 1]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 1000, np.finfo(float).eps)
    cv2.setNumThreads(1)
    _, K, *_ = cv2.calibrateCamera(
        *corners_for_opencv(views), LENS.size, None, None, criteria=criteria
    )
    assert K[0, 0] > 10000
    fit = intrinsics.calibrate(views, CHARUCO)
    assert fit.converged
    assert abs(fit.value("fx") - LENS.fx) < 3 * fit.sigma("fx") < 250


def test_a_fit_that_was_stopped_early_says_so(monkeypatch):
    detections, _ = corner_session(CHARUCO, LENS, 0, effects=Effects(max_tilt_deg=3.0))
    monkeypatch.setattr(intrinsics.fit, "ITERATIONS", 3)
    fit = intrinsics.calibrate(detections, CHARUCO)
    assert not fit.converged
    assert "NOT CONVERGED" in repr(fit)
    assert "did not converge" in fit.verdict()


def test_repeats_to_the_bit_and_leaves_opencvs_threads_alone(session, result):
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        again = intrinsics.calibrate(session[0], CHARUCO)
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
    assert again.intrinsics == result.intrinsics
    assert (again.T_camera_board == result.T_camera_board).all()
    assert (again.covariance == result.covariance).all()


def test_a_guess_changes_the_start_and_not_the_end(session, result):
    guess = replace(LENS, fx=700.0, fy=690.0, coeffs=(0.0,) * 5)
    fit = intrinsics.calibrate(session[0], CHARUCO, guess=guess)
    for name in fit.names:
        assert abs(fit.value(name) - result.value(name)) < 0.01 * result.sigma(name)
    same = intrinsics.calibrate(session[0], CHARUCO, guess=guess, same_focal=True)
    assert same.value("fx") == same.value("fy") == same.value("f")
    assert same.sigma("fx") == same.sigma("f") > 0


def test_measured_points_take_the_boards_place():
    """A board known to be bowed is fitted as well as a flat one; OpenCV needs a start for it."""
    points = bowed(CHECKERBOARD, 0.002)
    detections, _ = corner_session(CHECKERBOARD, LENS, 3, effects=Effects(bow_m=0.002))
    right = intrinsics.calibrate(detections, CHECKERBOARD, points=points)
    wrong = intrinsics.calibrate(detections, CHECKERBOARD)
    assert abs(right.value("fx") - LENS.fx) < 3 * right.sigma("fx")
    assert right.sigma_px == pytest.approx(0.08, rel=0.06)
    assert wrong.sigma_px > 2 * right.sigma_px


# --- residuals ---


def test_rms_is_over_corners_and_sigma_over_degrees_of_freedom(session, result):
    both = np.concatenate(result.residuals)
    assert result.corners == sum(len(d) for d in session[0]) == len(both)
    assert result.rms_px**2 == pytest.approx(result.rms_u_px**2 + result.rms_v_px**2)
    assert result.rms_px == pytest.approx(np.sqrt((np.linalg.norm(both, axis=1) ** 2).mean()))
    assert result.dof == 2 * len(both) - 9 - 6 * 28
    assert result.sigma_px**2 * result.dof == pytest.approx((both**2).sum())
    assert result.sigma_px == pytest.approx(0.08, rel=0.06)
    predicted = project(
        CHARUCO.points[session[0][4].ids] @ result.T_camera_board[4, :3, :3].T
        + result.T_camera_board[4, :3, 3],
        result.intrinsics.K,
        result.intrinsics.dist,
    )
    np.testing.assert_allclose(result.residuals[4], session[0][4].pixels - predicted, atol=1e-9)


# --- derivatives and algebra ---


def seen_by_opencv(parameters: np.ndarray, T: np.ndarray, points: np.ndarray) -> np.ndarray:
    fx, fy, cx, cy = parameters[:4]
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    rotation = Rotation.from_matrix(T[:3, :3]).as_rotvec()
    return cv2.projectPoints(points, rotation, T[:3, 3], K, parameters[4:])[0][:, 0].ravel()


def test_jacobian_is_the_numerical_derivative_of_opencvs_projection(session, result):
    shared, poses = result.jacobian
    parameters = parameter_vector(result.intrinsics)
    row = 0
    for view in (0, 7, 27):
        rows = result.equations.slices[view]
        points, T = CHARUCO.points[session[0][view].ids], result.T_camera_board[view]
        for column in range(9):
            step = np.zeros(9)
            step[column] = 1e-3 if column < 4 else 1e-5
            numeric = (
                seen_by_opencv(parameters + step, T, points)
                - seen_by_opencv(parameters - step, T, points)
            ) / (2 * step[column])
            np.testing.assert_allclose(shared[rows, column], numeric, rtol=1e-6, atol=1e-6)
        for column in range(6):
            twist = np.zeros((1, 6))
            twist[0, column] = 1e-6
            numeric = (
                seen_by_opencv(parameters, moved(T[None], twist)[0], points)
                - seen_by_opencv(parameters, moved(T[None], -twist)[0], points)
            ) / 2e-6
            np.testing.assert_allclose(poses[view][:, column], numeric, rtol=1e-5, atol=1e-3)
        row = rows.stop
    assert row == len(shared) == 2 * result.corners


def test_a_shared_focal_length_has_one_column(session):
    fit = intrinsics.calibrate(session[0], CHARUCO, same_focal=True, model="k1")
    points = np.array([[0.1, -0.05, 0.5], [-0.2, 0.1, 0.6]])
    _, by_parameter, _ = project_with_derivatives(points, fit.intrinsics)
    by_names = by_parameter @ selection(fit.names)
    assert fit.names == ("f", "cx", "cy", "k1")
    np.testing.assert_allclose(by_names[..., 0], by_parameter[..., 0] + by_parameter[..., 1])


def test_joint_covariance_is_the_inverse_of_the_whole_normal_matrix(result):
    """The Schur complements against one dense inverse of the whole, 177 x 177."""
    shared, poses = result.jacobian
    whole = np.zeros((len(shared), 9 + 6 * len(poses)))
    whole[:, :9] = shared
    for i, (block, rows) in enumerate(zip(poses, result.equations.slices, strict=True)):
        whole[rows, 9 + 6 * i : 15 + 6 * i] = block
    scale = np.linalg.norm(whole, axis=0)
    _, triangle = np.linalg.qr(whole / scale)
    inverse = np.linalg.inv(triangle)
    wanted = result.sigma_px**2 * (inverse @ inverse.T) / np.outer(scale, scale)
    sigma = np.sqrt(np.diag(wanted))
    np.testing.assert_allclose(
        result.joint_covariance / np.outer(sigma, sigma), wanted / np.outer(sigma, sigma), atol=1e-7
    )
    np.testing.assert_allclose(result.joint_covariance[:9, :9], result.covariance, rtol=1e-9)
    k1, k2 = np.sqrt(np.diag(result.covariance))[4:6]
    assert result.covariance[4, 5] / (k1 * k2) < -0.9  # they pull against each other


def test_the_step_leads_back_to_the_minimum_from_beside_it(result):
    at_minimum, _ = result.equations.step()
    assert np.abs(at_minimum / np.sqrt(np.diag(result.covariance))).max() < 0.01
    detections, truth = corner_session(CHARUCO, LENS, seed=1, noise_px=0.0)
    change = np.array([0.1, -0.1, 0.1, 0.1, 1e-3, -2e-3, 1e-4, 1e-4, 1e-3])
    beside = intrinsics.fit.evaluate(
        with_parameters(LENS, parameter_vector(LENS) + change), truth.T_camera_board, detections,
        CHARUCO, CHARUCO.points, result.names, "brown_conrady",
    )  # fmt: skip
    assert not beside.converged
    back, _ = beside.equations.step()
    np.testing.assert_allclose(back, -change, rtol=0.02)


def test_a_direction_without_data_gets_a_huge_variance():
    matrix = np.diag([4.0, 1.0, 0.0])
    inverse = scaled_inverse(matrix)
    np.testing.assert_allclose(inverse[:2, :2], np.diag([0.25, 1.0]))
    assert inverse[2, 2] > 1e12


# --- what is said ---


def test_repr_and_intervals(result):
    lines = repr(result).splitlines()
    assert max(map(len, lines)) <= 92
    low, high = result.interval("fx")
    assert (low + high) / 2 == pytest.approx(result.value("fx"))
    assert (high - low) / 2 == pytest.approx(1.961 * result.sigma("fx"), rel=1e-3)
    assert lines[1] == f"fx = {result.value('fx'):.2f} ± {(high - low) / 2:.2f} px (95 %)"
    narrow = result.interval("fx", level=0.5)
    assert (narrow[1] - narrow[0]) / (high - low) == pytest.approx(0.6745 / 1.96, rel=1e-2)
    with pytest.raises(ValueError, match="level: got 95"):
        result.interval("fx", level=95)
    with pytest.raises(ValueError, match="name: got 'k4', want one of fx, fy"):
        result.sigma("k4")


# --- bad input ---


def test_bad_views_are_named(session):
    views = list(session[0])

    def with_view(view: Detection) -> list[Detection]:
        return [*views[:3], view, *views[4:]]

    good = views[3]
    line = np.flatnonzero(CHARUCO.points[:, 1] == CHARUCO.points[0, 1])
    for bad, message in (
        (replace(good, size=(1280, 720)), r"is \(1280, 720\) px, not \(640, 480\)"),
        (replace(good, ids=good.ids[:5], pixels=good.pixels[:5]), "has 5 corners, want"),
        (replace(good, pixels=good.pixels * np.nan), "not finite"),
        (replace(good, ids=good.ids + 40), "has corner .* the board has 0 to 39: another board"),
        (replace(good, ids=np.zeros(len(good), int)), "the same corner twice"),
        (replace(good, ids=line, pixels=np.ones((len(line), 2))), "all its corners on one line"),
    ):
        with pytest.raises(ValueError, match=rf"^detections\[3\] \(view 03\): .*{message}"):
            intrinsics.calibrate(with_view(bad), CHARUCO)


def test_bad_arguments(session):
    detections = session[0]
    with pytest.raises(ValueError, match="detections: got 2 views, want at least 3"):
        intrinsics.calibrate(detections[:2], CHARUCO)
    with pytest.raises(ValueError, match="model: got 'fisheye', want one of none, k1"):
        intrinsics.calibrate(detections, CHARUCO, model="fisheye")
    with pytest.raises(ValueError, match=r"guess: got \(1280, 720\), want the images' size"):
        intrinsics.calibrate(detections, CHARUCO, guess=Intrinsics(1280, 720, 900, 900, 640, 360))
    with pytest.raises(ValueError, match=r"points: got shape \(3, 3\), want \(40, 3\)"):
        intrinsics.calibrate(detections, CHARUCO, points=np.eye(3))


def test_views_that_fit_no_camera_are_refused():
    rng = np.random.default_rng(0)
    anything = [
        Detection(np.arange(54), rng.uniform(0, LENS.size, (54, 2)), LENS.size) for _ in range(4)
    ]
    with pytest.raises(intrinsics.CalibrationFailed, match="a camera that cannot be"):
        intrinsics.calibrate(anything, CHECKERBOARD, model="none")
