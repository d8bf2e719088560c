"""Judging a fit: coverage, tilts, verdict, halves, the factory's K, bow.

COURSEKIT_NIGHTLY=1 takes more sessions.
"""

import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from common import EXPECTED, refusals
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from scipy.stats import ttest_1samp
from simulated_corners import CHARUCO, CHECKERBOARD, LENS, NIGHTLY, fit

from coursekit import intrinsics
from coursekit.boards import Board, Detection, Detections
from coursekit.geometry import Intrinsics, make_transform, project
from coursekit.intrinsics.comparison import difference_px
from coursekit.intrinsics.fit import image_grid
from coursekit.simulation.corner_sessions import Effects, corner_session


@pytest.fixture(scope="module")
def good() -> intrinsics.IntrinsicsResult:
    return fit(CHARUCO, 1)


# --- coverage and tilts ---


def test_coverage_counts_cells_and_margins() -> None:
    pixels = np.array([[63.5, 47.5], [319.5, 239.5], [575.5, 335.5]])
    seen = intrinsics.coverage([Detection(np.arange(3), pixels, (640, 480))], cells=(2, 4))
    np.testing.assert_array_equal(seen.counts, [[1, 0, 0, 0], [0, 0, 1, 1]])
    assert seen.fraction == pytest.approx(3 / 8)
    assert seen.margins == pytest.approx((0.1, 0.1, 0.1, 0.3))
    assert seen.reach == pytest.approx(math.hypot(256, 192) / 400)
    assert seen.empty_sides == ("bottom",)


def test_tilts_are_the_angles_the_boards_were_turned_by(good) -> None:
    turns = [(25.0, 0.0), (-10.0, 0.0), (0.0, 30.0), (0.0, -40.0)]
    rotations = Rotation.from_euler("xy", turns, degrees=True)
    poses = np.stack([make_transform(R, [0, 0, 0.5]) for R in rotations])
    turned = intrinsics.tilts(replace(good, T_camera_board=poses))
    np.testing.assert_allclose(turned.about_x_deg, [25, -10, 0, 0], atol=1e-9)
    np.testing.assert_allclose(turned.about_y_deg, [0, 0, 30, -40], atol=1e-9)
    np.testing.assert_allclose(turned.total_deg, [25, 10, 30, 40])
    # the other direction of z, as on boards with the old origin, is the same tilt
    flipped = poses @ np.diag([1.0, -1.0, -1.0, 1.0])
    again = intrinsics.tilts(replace(good, T_camera_board=flipped))
    np.testing.assert_allclose(again.about_x_deg, turned.about_x_deg, atol=1e-9)
    assert repr(turned) == "boards tilted 10 to 40 deg, spread 13 and 25 deg about x and y"


# --- the verdict ---

SEEDS = range(100, 130) if NIGHTLY else range(100, 103)
FLAT, INNER = Effects(max_tilt_deg=3.0), Effects(inner_only=0.15)


@pytest.mark.parametrize("seed", SEEDS)
def test_verdict_names_what_is_weak(seed) -> None:
    for session, head, words in (
        ({"effects": FLAT}, "Not good enough: these 28 views do not determine K", "tilt 30 to 45"),
        ({"effects": INNER}, "Not good enough", "no corners in the outer tenth"),
        ({"noise_px": 0.25}, "Usable with care", "corners scatter by 0.2"),
    ):
        result = fit(CHARUCO, seed, **session)
        verdict = result.verdict()
        assert verdict.startswith(head)
        assert words in verdict.replace("\n  ", " ")
        assert max(map(len, (verdict + "\n" + repr(result)).splitlines())) <= 92


def test_few_views_are_said(good) -> None:
    assert good.verdict().startswith("Good: ")
    assert "4 views are few" in fit(CHARUCO, 3, views=4).verdict()


# --- a lens that folds inside the image ---

FOLDS = EXPECTED["folds"]


def folding(coefficients, seed: int) -> Detections:
    """12 views of exact corners and 0.1 px of noise, all inside of where the lens folds."""
    rng, board = np.random.default_rng(seed), CHECKERBOARD
    k1, k2, k3 = coefficients
    lens = Intrinsics(1280, 720, 1160, 1160, 675, 388, "brown_conrady", (k1, k2, 0, 0, k3))
    P, views = 1.2 * (board.points - board.points.mean(axis=0)), []
    while len(views) < 12:
        turn = Rotation.from_euler("xyz", rng.uniform(-35, 35, 3), degrees=True)
        X = turn.apply(P) + rng.uniform([-0.25, -0.15, 0.45], [0.2, 0.1, 0.6])
        seen = project(X, lens.K, lens.dist)
        if (seen > 8).all() and (seen < [1272, 712]).all():
            noisy = seen + rng.normal(0, 0.1, seen.shape)
            views.append(Detection(np.arange(54), noisy, lens.size, f"view {len(views)}"))
    return Detections(views)


@pytest.mark.parametrize("case", FOLDS if NIGHTLY else [*FOLDS][:2])
def test_where_a_lens_folds_it_has_no_figures_and_all_that_is_said_is_a_number(
    case, monkeypatch
) -> None:
    views = folding(*FOLDS[case])
    result = intrinsics.calibrate(views, CHECKERBOARD)
    sigma = result.uncertainty_map(result.board_range_m)
    assert result.folded_share == pytest.approx(np.isnan(sigma).mean())
    assert 0 < result.folded_share < 0.2
    both = intrinsics.halves(views, CHECKERBOARD)
    compared = intrinsics.compare(result, replace(result.intrinsics, fx=1150.0))
    texts = [repr(result), result.verdict(), repr(both), repr(compared)]
    texts.append(repr(intrinsics.diagnose(views, CHECKERBOARD, result=result)))
    for text in texts:
        assert not re.search(r"\bnan\b|\binf\b", text)
        assert text is texts[-1] or "% of the image (" in text
    verdict = result.verdict().replace("\n  ", " ")
    assert result.simpler is not None
    assert result.simpler.folded_share == 0
    assert f"model='{result.simpler.model}'): held-out views RMS" in verdict
    assert not verdict.startswith("Good")
    monkeypatch.setattr(type(result), "held_out_px", lambda fit: np.nan)  # a half that folds
    assert "nan" not in result.verdict()


# --- two halves ---


def test_halves_of_healthy_sessions_differ_as_they_say() -> None:
    """P-values are uniform, and differences are as large as their stated deviations."""
    found = []
    for seed in range(7000, 7000 + (500 if NIGHTLY else 20)):
        detections, _ = corner_session(CHARUCO, LENS, seed)
        found.append(intrinsics.halves(detections, CHARUCO, range_m=0.6, shape=(5, 5)))
    p_values = np.array([both.p_value for both in found])
    for level in (0.1, 0.5):
        share = np.mean(p_values < level)
        assert abs(share - level) < 3.5 * math.sqrt(level * (1 - level) / len(found))
    # the length has two directions, the expected sigma is of the worse one
    lengths, expected = ([getattr(b, k) for b in found] for k in ("length_px", "expected_px"))
    ratio = np.sqrt(np.mean(np.square(lengths), axis=0) / np.mean(np.square(expected), axis=0))
    # Sigmas that count views err on the wide side where a half has 14 of them.
    assert 0.65 < ratio.min() < ratio.max() < 1.7
    assert 0.95 < np.median(ratio) < 1.45


def test_halves_disagree_when_the_lens_was_refocused_between() -> None:
    other = replace(LENS, fx=LENS.fx * 1.02, fy=LENS.fy * 1.02)
    even, _ = corner_session(CHARUCO, LENS, 8, views=14)
    odd, _ = corner_session(CHARUCO, other, 9, views=14)
    mixed = Detections(view for pair in zip(even, odd, strict=True) for view in pair)
    both = intrinsics.halves(mixed, CHARUCO)
    assert both.p_value < 1e-4
    assert "corner noise alone does not explain it (p < " in repr(both)
    assert both.first.value("fx") == pytest.approx(612, abs=4)
    assert both.second.value("fx") == pytest.approx(624, abs=4)


def test_difference_takes_out_a_motion_of_the_frame_and_no_more() -> None:
    """A principal point 5 px off is nearly a rotation; a distortion is not."""
    grid = image_grid(LENS, (9, 11)).reshape(-1, 2)
    shifted = replace(LENS, cx=LENS.cx + 5.0)
    assert np.abs(difference_px(LENS, LENS, grid, 0.5)).max() < 1e-9
    left = difference_px(LENS, shifted, grid, 0.5)
    assert 0.01 < np.linalg.norm(left, axis=1).max() < 1.0  # of 5
    scaled = replace(LENS, fx=LENS.fx * 1.01, fy=LENS.fy * 1.01)
    off = [difference_px(LENS, scaled, grid, range_m) for range_m in (0.5, math.inf)]
    near, far = np.linalg.norm(off, axis=2).max(axis=1)
    assert near < 0.5 * far  # at one distance, moving away takes the place of a longer f
    assert far > 3
    bent = replace(LENS, coeffs=(0.06, *LENS.coeffs[1:]))
    assert np.linalg.norm(difference_px(LENS, bent, grid, 0.5), axis=1).max() > 0.3


# --- the factory's K ---


def test_comparison_with_the_truth_and_with_another_camera(good) -> None:
    same = intrinsics.compare(good, LENS)
    assert same.p_value > 0.01
    assert np.abs(same.differences / same.sigmas).max() < 4
    factory = replace(LENS, fx=620.0, fy=618.0)
    other = intrinsics.compare(good, factory, range_m=0.5, shape=(5, 5))
    assert other.p_value < 1e-6
    assert other.differences[0] == pytest.approx(good.value("fx") - 620)
    # pixel (0, 0) at Z = 0.5 m: x = (u - cx) Z / f, 322 / 612 of 0.5 m, a ratio of 620 / 612
    own = 0.5 * (np.array([-322.0, -238.0]) / 612.0)
    expected = np.linalg.norm(own) * (8 / 620)
    assert other.shift_m[0, 0] == pytest.approx(expected, abs=0.0015)
    assert max(map(len, repr(other).splitlines())) <= 92


OTHER = Intrinsics(848, 480, 600, 600, 424, 240)
EMPTY = Detection([], np.zeros((0, 2)), (320, 240))
test_bad_input_is_named = refusals(
    ("detections: got 0, want at least one view", lambda: intrinsics.coverage([])),
    ("detections: got 0, want .* with corners", lambda: intrinsics.coverage([EMPTY])),
    ("320", lambda: intrinsics.coverage([*fit(CHARUCO, 1).detections, EMPTY])),
    ("5 views, halves need", lambda: intrinsics.halves(fit(CHARUCO, 1).detections[:5], CHARUCO)),
    (r"factory: got \(848, 480\), want", lambda: intrinsics.compare(fit(CHARUCO, 1), OTHER)),
    ("factory: got IntrinsicsR.*, want Int", lambda: intrinsics.compare(*[fit(CHARUCO, 1)] * 2)),
)


def test_comparison_of_a_shared_focal_length() -> None:
    lens = replace(LENS, fy=LENS.fx)
    detections, _ = corner_session(CHARUCO, lens, 5)
    result = intrinsics.calibrate(detections, CHARUCO, same_focal=True)
    factory = replace(lens, fx=610.0, fy=616.0)
    difference = intrinsics.compare(result, factory).differences[0]
    assert difference == pytest.approx(result.value("f") - 613)


# --- the bow ---


@pytest.mark.parametrize("board", [CHARUCO, CHECKERBOARD], ids=lambda board: board.kind)
def test_a_bow_is_found_and_its_damage_undone(board: Board) -> None:
    """What it does while nobody looks for it is claim I1, by the same fits."""
    count = 100 if NIGHTLY else 6
    fitted, sag_held, fx_held = [], 0, 0
    for seed in range(9000, 9000 + count):
        bow = intrinsics.fit_bow(fit(board, seed, effects=Effects(bow_m=0.001)))
        assert bow.result.converged
        assert bow.p_value < 1e-6
        sag_held += abs(bow.sag_m - 0.001) <= bow.result.quantile() * bow.sigma_m
        low, high = bow.result.interval("fx")
        fx_held += low <= LENS.fx <= high
        fitted.append(bow.result)
    for name, truth in (("fx", LENS.fx), ("k1", LENS.coeffs[0])):  # without a bias
        assert abs(ttest_1samp([r.value(name) for r in fitted], truth).statistic) < 3.5
    assert min(sag_held, fx_held) >= 0.88 * count - 1
    assert np.mean([r.sigma_px for r in fitted]) == pytest.approx(0.08, rel=0.03)


def test_a_flat_board_has_no_bow_and_a_hollow_one_a_negative_sag() -> None:
    p_values = []
    for seed in range(9000, 9000 + (200 if NIGHTLY else 15)):
        bow = intrinsics.fit_bow(fit(CHARUCO, seed))
        p_values.append(bow.p_value)
        assert abs(bow.sag_m) < 4.5 * bow.sigma_m
    assert 0.3 < np.mean(p_values) < 0.7
    assert np.mean(np.array(p_values) < 0.05) < (0.1 if NIGHTLY else 0.2)
    hollow = intrinsics.fit_bow(fit(CHARUCO, 1, effects=Effects(bow_m=-0.0005)))
    assert hollow.sag_m == pytest.approx(-0.0005, abs=3 * hollow.sigma_m)
    assert repr(hollow).startswith("the board's middle stands out by -0.")
    assert max(map(len, repr(hollow.result).splitlines())) <= 92


def test_bow_is_what_scipy_finds_over_everything() -> None:
    """All intrinsics, poses and the bow by scipy's least_squares and OpenCV's projection."""
    detections, truth = corner_session(CHARUCO, LENS, 11, views=9, effects=Effects(bow_m=0.0015))
    bow = intrinsics.fit_bow(intrinsics.calibrate(detections, CHARUCO, model="k1k2"))
    x, y = (CHARUCO.points[:, :2] - CHARUCO.points[:, :2].mean(axis=0)).T
    names = bow.result.names

    def residuals(theta: np.ndarray) -> np.ndarray:
        fx, fy, cx, cy, k1, k2, a, b, c = theta[:9]
        points = CHARUCO.points + np.outer(a * x * x + b * x * y + c * y * y, [0, 0, 1])
        K, dist = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), np.array([k1, k2, 0, 0, 0])
        parts = []
        for pose, view in zip(theta[9:].reshape(-1, 6), detections, strict=True):
            seen = cv2.projectPoints(points[view.ids], pose[:3], pose[3:], K, dist)[0][:, 0]
            parts.append((view.pixels - seen).ravel())
        return np.concatenate(parts)

    T = truth.T_camera_board
    poses = np.hstack([Rotation.from_matrix(T[:, :3, :3]).as_rotvec(), T[:, :3, 3]])
    start = np.array([600.0, 600, 320, 240, 0, 0, 0, 0, 0, *np.ravel(poses)])
    found = least_squares(residuals, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    for i, name in enumerate(names):
        tolerance = 0.02 * bow.result.sigma(name)
        assert bow.result.value(name) == pytest.approx(found.x[i], abs=tolerance)
    equations = bow.result.equations
    sigma = bow.result.sigma_px * np.sqrt(np.diag(equations.shared_covariance))
    sigma[6:9] /= np.sum(np.ptp(CHARUCO.points, axis=0) ** 2) / 4  # as z over the half diagonal
    assert np.abs((bow.coefficients - found.x[6:9]) / sigma[6:9]).max() < 0.02
    free = len(found.fun) - len(found.x)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * (found.fun @ found.fun) / free
    expected = np.sqrt(np.diag(covariance))
    np.testing.assert_allclose(sigma, expected[:9], rtol=0.01)  # were all corners independent
    stated = [*(bow.result.sigma(name) for name in names), *np.sqrt(np.diag(bow.covariance))]
    np.testing.assert_allclose(stated, expected[:9], rtol=0.6)  # and as nine views scatter
