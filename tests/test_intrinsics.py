"""The fit: against OpenCV, numerical derivatives, dense algebra, and bad input."""

import re
from contextlib import suppress
from dataclasses import replace

import cv2
import numpy as np
import pytest
from common import by_opencv as seen_by_opencv
from common import derivative, each, refusals
from scipy.linalg import block_diag
from scipy.stats import t as student
from simulated_corners import CHARUCO, CHECKERBOARD, LENS, dense_jacobian, fit

from coursekit import intrinsics
from coursekit.boards import Detection
from coursekit.geometry import Intrinsics, moved, project, transform_points
from coursekit.intrinsics import derivatives
from coursekit.intrinsics.derivatives import PARAMETERS, parameter_vector, with_parameters
from coursekit.simulation.corner_sessions import Effects, bowed, corner_session

FLAT = Effects(max_tilt_deg=3.0)
VIEWS = corner_session(CHARUCO, LENS, seed=1)[0]


@pytest.fixture(scope="module")
def result():
    return fit(CHARUCO, 1)


def by_opencv(detections, **options):
    """OpenCV's RMS and K, by one thread."""
    cv2.setNumThreads(1)
    points = [CHARUCO.points[d.ids].astype(np.float32) for d in detections]
    pixels = [d.pixels.astype(np.float32) for d in detections]
    return cv2.calibrateCameraExtended(points, pixels, LENS.size, None, None, **options)


# --- the estimate ---


def test_estimate_and_deviations_are_opencvs(result):
    """Its stdDeviationsIntrinsics come from its own Jacobian, in another parametrisation."""
    rms, K, dist, _, _, deviations, _, per_view = by_opencv(VIEWS)
    assert result.converged
    assert result.rms_px == pytest.approx(rms, rel=1e-4)
    np.testing.assert_allclose(result.per_view_rms_px, per_view.ravel(), rtol=1e-3)
    np.testing.assert_allclose(result.intrinsics.K, K, rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(result.intrinsics.coeffs, dist.ravel(), rtol=1e-2)
    ours = result.sigma_px * np.sqrt(np.diag(result.equations.shared_covariance))
    np.testing.assert_allclose(ours, deviations.ravel()[:9], rtol=1e-4)


@pytest.mark.parametrize("model", intrinsics.MODELS)
@pytest.mark.parametrize("same_focal", [False, True])
def test_corners_without_noise_give_the_lens_back(model, same_focal):
    free = intrinsics.MODELS[model]
    coeffs = [k if n in free else 0.0 for n, k in zip(PARAMETERS[4:], LENS.coeffs, strict=True)]
    lens = replace(LENS, coeffs=tuple(coeffs), fy=LENS.fx if same_focal else LENS.fy)
    detections, truth = corner_session(CHARUCO, lens, seed=2, views=8, noise_px=0.0)
    fit = intrinsics.calibrate(detections, CHARUCO, model=model, same_focal=same_focal)
    assert fit.converged
    assert fit.names == (*(("f",) if same_focal else ("fx", "fy")), "cx", "cy", *free)
    np.testing.assert_allclose(fit.intrinsics.K, lens.K, atol=2e-3)  # its corners are float32
    np.testing.assert_allclose(fit.intrinsics.coeffs, coeffs, atol=2e-4)
    np.testing.assert_allclose(fit.T_camera_board, truth.T_camera_board, atol=1e-5)


def test_nearly_parallel_boards_converge_where_opencvs_own_limit_stops_short():
    """At 30 iterations OpenCV ends at more than twice the focal length with an RMS of 0.13 px."""
    flat = fit(CHARUCO, 0, effects=FLAT)
    assert flat.converged
    assert abs(flat.value("fx") - LENS.fx) < 3 * flat.sigma("fx")
    rms, K, *_ = by_opencv(flat.detections)
    assert flat.rms_px < rms < 0.15
    assert K[0, 0] > 2 * LENS.fx


def test_a_start_that_leads_nowhere_is_followed_by_a_plain_one():
    """From its own start OpenCV's solver ends at f = 14,874 px here, whatever the iterations."""
    detections, _ = corner_session(CHARUCO, LENS, 7, effects=FLAT)
    views = [view for index, view in enumerate(detections) if index % 5 != 1]
    _, K, *_ = by_opencv(views, criteria=(3, 1000, np.finfo(float).eps))
    assert K[0, 0] > 10000
    fit = intrinsics.calibrate(views, CHARUCO)
    assert fit.converged
    assert abs(fit.value("fx") - LENS.fx) < 3 * fit.sigma("fx") < 300


def test_views_that_determine_nothing_get_no_absurd_figures():
    """What they leave open is rounding of either sign, whose root was none."""
    for noise in np.random.default_rng(3).normal(200, 0.1, (9, 3, 54, 2)):
        seen = CHECKERBOARD.points[:, :2] * 1200 + noise + 9 * np.arange(3)[:, None, None]
        with suppress(intrinsics.CalibrationFailed):
            views = [Detection(range(54), pixels, LENS.size) for pixels in seen]
            fit = intrinsics.calibrate(views, CHECKERBOARD, "none", same_focal=True)
            said = repr(fit) + fit.verdict() + repr(intrinsics.compare(fit, LENS))
            assert not re.search(r"nan|inf\b|\d{7}", said)


def test_a_fit_that_was_stopped_early_says_so(monkeypatch):
    detections, _ = corner_session(CHARUCO, LENS, 0, effects=FLAT)
    monkeypatch.setattr(intrinsics.fit, "ITERATIONS", 3)
    fit = intrinsics.calibrate(detections, CHARUCO)
    assert not fit.converged
    assert "NOT CONVERGED" in repr(fit)
    assert "did not converge" in fit.verdict()


def test_repeats_to_the_bit_and_leaves_opencvs_threads_alone(result):
    before = cv2.getNumThreads()
    cv2.setNumThreads(2)
    try:
        again = intrinsics.calibrate(VIEWS, CHARUCO)
        assert cv2.getNumThreads() == 2
    finally:
        cv2.setNumThreads(before)
    assert again.intrinsics == result.intrinsics
    assert (again.T_camera_board == result.T_camera_board).all()
    assert (again.covariance == result.covariance).all()


def test_a_guess_changes_the_start_and_not_the_end(result):
    guess = replace(LENS, fx=700.0, fy=690.0, coeffs=(0.0,) * 5)
    fit = intrinsics.calibrate(VIEWS, CHARUCO, guess=guess)
    for name in fit.names:
        assert abs(fit.value(name) - result.value(name)) < 0.01 * result.sigma(name)
    assert calibrated(model="none", guess=LENS).intrinsics.coeffs == (0.0,) * 5  # held at 0
    same = intrinsics.calibrate(VIEWS, CHARUCO, guess=guess, same_focal=True)
    assert same.value("fx") == same.value("fy") == same.value("f")
    assert same.sigma("fx") == same.sigma("f") > 0


def test_measured_points_take_the_boards_place():
    """A board known to be bowed is fitted as well as a flat one; OpenCV needs a start for it."""
    wrong = fit(CHECKERBOARD, 3, effects=Effects(bow_m=0.002))
    points = bowed(CHECKERBOARD, 0.002)
    right = intrinsics.calibrate(wrong.detections, CHECKERBOARD, points=points)
    assert abs(right.value("fx") - LENS.fx) < 3 * right.sigma("fx")
    assert right.sigma_px == pytest.approx(0.08, rel=0.06)
    assert wrong.sigma_px > 2 * right.sigma_px


# --- residuals ---


def test_rms_is_over_corners_and_sigma_over_degrees_of_freedom(result):
    both = np.concatenate(result.residuals)
    assert result.corners == sum(len(d) for d in VIEWS) == len(both)
    assert result.rms_px**2 == pytest.approx(np.sum(np.square(result.rms_uv_px)))
    assert result.rms_px == pytest.approx(np.sqrt((np.linalg.norm(both, axis=1) ** 2).mean()))
    assert result.equations.dof == 2 * len(both) - 9 - 6 * 28
    assert result.sigma_px**2 * result.equations.dof == pytest.approx((both**2).sum())
    assert result.sigma_px == pytest.approx(0.08, rel=0.06)
    points = transform_points(result.T_camera_board[4], CHARUCO.points[VIEWS[4].ids])
    predicted = project(points, result.intrinsics.K, result.intrinsics.dist)
    np.testing.assert_allclose(result.residuals[4], VIEWS[4].pixels - predicted, atol=1e-9)


# --- derivatives and algebra ---


def test_jacobian_is_the_numerical_derivative_of_opencvs_projection(result):
    shared, poses = result.equations.shared, result.equations.poses
    lens = result.intrinsics

    def seen(e, view):
        changed = with_parameters(lens, parameter_vector(lens) + e[:9])
        T = moved(result.T_camera_board[[view]], e[None, 9:])[0]
        return seen_by_opencv(CHARUCO.points[VIEWS[view].ids], T, changed).ravel()

    for view in (0, 7, 27):
        rows = result.equations.slices[view]
        numeric = derivative(lambda e, view=view: seen(e, view), 1e-6, 15)
        np.testing.assert_allclose(shared[rows], numeric[:, :9], rtol=1e-6, atol=1e-6)
        np.testing.assert_allclose(poses[view], numeric[:, 9:], rtol=1e-5, atol=1e-3)
    assert rows.stop == len(shared) == 2 * result.corners
    bare, at = replace(lens, model="none"), CHARUCO.points + np.array([0, 0, 0.5])
    assert (derivatives.project_with_derivatives(at, bare)[0] == project(at, bare.K)).all()


def test_covariances_are_from_the_inverse_of_the_whole_normal_matrix(result):
    """The Schur complements and the poses' mean against one dense inverse, 177 x 177."""
    whole = dense_jacobian(result)
    scale = np.linalg.norm(whole, axis=0)
    _, triangle = np.linalg.qr(whole / scale)
    inverse, views = np.linalg.inv(triangle), len(result.T_camera_board)
    mean = block_diag(np.eye(9), np.tile(np.eye(6) / views, views))
    wanted = mean @ (inverse @ inverse.T / np.outer(scale, scale)) @ mean.T
    sigma = np.sqrt(np.diag(wanted))
    joint = result.equations.mean_motion_covariance(result.equations.shared_covariance, 1.0)
    np.testing.assert_allclose(
        joint / np.outer(sigma, sigma), wanted / np.outer(sigma, sigma), atol=1e-7
    )
    k1, k2 = np.sqrt(np.diag(result.covariance))[4:6]
    assert result.covariance[4, 5] / (k1 * k2) < -0.9  # they pull against each other


def test_a_direction_without_data_gets_a_huge_variance():
    matrix = np.diag([4.0, 1.0, 0.0])
    inverse = derivatives.scaled_inverse(matrix)
    np.testing.assert_allclose(inverse[:2, :2], np.diag([0.25, 1.0]))
    assert inverse[2, 2] > 1e12


# --- what is said ---


def test_repr_and_intervals(result):
    lines = repr(result).splitlines()
    assert max(map(len, lines)) <= 92
    low, high = result.interval("fx")
    assert (low + high) / 2 == pytest.approx(result.value("fx"))
    assert (high - low) / 2 == pytest.approx(student.ppf(0.975, result.dof) * result.sigma("fx"))
    assert 27 < result.dof < 4 * 27  # 28 views: neither the corners' two thousand nor one each
    assert lines[1] == f"fx = {result.value('fx'):.2f} ± {(high - low) / 2:.2f} px (95 %)"
    narrow = result.interval("fx", level=0.5)
    assert (narrow[1] - narrow[0]) / (high - low) == pytest.approx(0.338, rel=1e-2)


# --- bad input ---


def calibrated(detections=VIEWS, **options):
    return intrinsics.calibrate(detections, CHARUCO, **options)


def fourth(message, **changes):
    """The case of a fourth view with other fields."""
    views = [*VIEWS[:3], replace(VIEWS[3], **changes), *VIEWS[4:]]
    return rf"^detections\[3\] \(view 03\): .*{message}", lambda: calibrated(views)


IDS, PIXELS = VIEWS[3].ids, VIEWS[3].pixels
LINE = np.flatnonzero(CHARUCO.points[:, 1] == CHARUCO.points[0, 1])
OTHER = Intrinsics(1280, 720, 900, 900, 640, 360)

test_bad_input_is_named = refusals(
    fourth(r"is \(1280, 720\) px, not \(640, 480\)", size=(1280, 720)),
    fourth("has 5 corners, want", ids=IDS[:5], pixels=PIXELS[:5]),
    fourth("not finite", pixels=PIXELS * np.nan),
    fourth("has corner .* the board has 0 to 39: another board", ids=IDS + 40),
    fourth("has corner -1, the board has 0", ids=np.append(-1, IDS[1:])),
    fourth("all its corners on one line", pixels=np.ones_like(PIXELS)),
    fourth("the same corner twice", ids=np.zeros(len(IDS), int)),
    fourth("all its corners on one line", ids=LINE, pixels=np.ones((len(LINE), 2))),
    *each("detections: got 2 views, want at least 3", calibrated, "detections", VIEWS[:2]),
    *each("got '8 views with the board in 1 place'", calibrated, "detections", 8 * [VIEWS[0]]),
    *each("model: got 'fisheye', want one of none, k1", calibrated, "model", "fisheye"),
    *each(r"guess: got \(1280, 720\), want the images' size", calibrated, "guess", OTHER),
    *each(r"points: got shape \(3, 3\), want \(40, 3\)", calibrated, "points", np.eye(3)),
    ("level: got 95", lambda: fit(CHARUCO, 1).interval("fx", level=95)),
    ("name: got 'k4', want one of fx, fy", lambda: fit(CHARUCO, 1).sigma("k4")),
    ("range_m: got 0, want a pos", lambda: fit(CHARUCO, 1).projection_covariance([9.0, 9.0], 0)),
    (
        "fixed: got 'board', want one of world, camera",
        lambda: fit(CHARUCO, 1).projection_covariance([9.0, 9.0], 0.5, fixed="board"),
    ),
    (r"shape: got \(1, 40\), want", lambda: fit(CHARUCO, 1).uncertainty_map(0.5, (1, 40))),
)


def test_views_that_fit_no_camera_are_refused():
    rng = np.random.default_rng(0)
    anything = [
        Detection(np.arange(54), rng.uniform(0, LENS.size, (54, 2)), LENS.size) for _ in range(4)
    ]
    with pytest.raises(intrinsics.CalibrationFailed, match="a camera that cannot be"):
        intrinsics.calibrate(anything, CHECKERBOARD, model="none")
