"""`diagnose` on sessions with a known cause, and its statistics against brute force.

Thresholds were set on sessions with the seeds 0 to 999; the tests use seeds from 100,000 on, and
nothing was tuned on those. COURSEKIT_NIGHTLY=1 runs 100 sessions a cause and 200 healthy ones.
"""

import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from common import EXPECTED, NIGHTLY, check_named, derivative
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.stats import binom, kstest
from simulated_corners import BOARDS, LENSES, names_found

from coursekit.boards import Board, Detection, Detections, Skipped
from coursekit.causes import CauseSearch, search
from coursekit.geometry import Intrinsics
from coursekit.intrinsics import causes
from coursekit.intrinsics.causes import Calibration, CornerTable, Linear
from coursekit.intrinsics.derivatives import (
    fisheye_with_derivatives,
    parameter_vector,
    with_parameters,
)
from coursekit.intrinsics.diagnosis import blur_lengths_px, depth_scale, diagnose, stored_power
from coursekit.intrinsics.fit import calibrate
from coursekit.simulation.corner_sessions import Effects, Truth, corner_session
from tools import make_data

FIRST_SEED = 100_000
LENS, CHARUCO, CHECKERBOARD = LENSES[0], *BOARDS
CLASSES = {
    label: (name, Effects(**fields))
    for label, (name, fields) in EXPECTED["intrinsic_classes"].items()
}
# What careful people have: a plate flat to 0.03 mm, a lens that breathes 0.03 %, a board that is
# put down, and corners that are noisier in some views than in others.
MILD = Effects(
    bow_m=3e-5, focus_drift=3e-4, readout_s=0.01, speed_m_s=0.003, noise_spread=0.2
)  # fmt: skip


def session(seed: int, effects: Effects) -> tuple[Detections, Truth, Board]:
    """Both kinds of board, four lenses and 20 to 40 views in turn."""
    board, lens = BOARDS[seed % 2], LENSES[(seed // 2) % 4]
    detections, truth = corner_session(
        board, lens, seed, views=20 + (7 * seed) % 21, effects=effects
    )
    return detections, truth, board


# --- the causes are named ---


@pytest.mark.parametrize("label", CLASSES)
def test_a_cause_is_named(label: str) -> None:
    """At least 95 of 100 named, at most 5 with a wrong name besides (nightly).

    By day one, of either board in turn: what names 75 % of all passes the nine with 8 %.
    """
    name, effects = CLASSES[label]
    first = FIRST_SEED if NIGHTLY else FIRST_SEED + [*CLASSES].index(label)
    seeds = range(first, first + (100 if NIGHTLY else 1))
    check_named(names_found(session(seed, effects) for seed in seeds), name, label)


def test_healthy_sessions_get_no_finding() -> None:
    """At most 4 of 200 (nightly); of 4 none: a rate of 25 % passes with 32 %."""
    count, most = (200, 4) if NIGHTLY else (4, 0)
    seeds = range(FIRST_SEED + 1000, FIRST_SEED + 1000 + count)
    # every other pair of seeds, so that each kind of board has both
    found = names_found(session(seed, MILD if (seed // 2) % 2 else Effects()) for seed in seeds)
    assert sum(n for names, n in found.items() if names) <= most


@pytest.mark.parametrize("cause", stored_power())
def test_the_stored_power_is_what_is_measured(cause: str) -> None:
    """Nightly, 20 sessions of other seeds against the stored hundred, within 99.9 %; a handful
    would be within that whatever they were."""
    row = stored_power()[cause]
    named, sizes, count = np.array(row["named"]), row["sizes"], 20
    assert row["sessions"] == 100
    assert (np.diff(named) >= -10).all()
    assert named[-1] >= 95
    if NIGHTLY:
        middle = int(np.argmin(np.abs(named - 50)))
        found = make_data.times_named(cause, sizes[middle], range(200, 200 + count))
        low, high = binom.interval(0.999, count, named[middle] / 100)
        assert low - 3 <= found <= high + 3


def searched(detections: Detections) -> CauseSearch[Calibration]:
    start = causes.refit(Calibration.of(calibrate(detections, CHECKERBOARD)))
    return search(start, causes.CHANCE_LEVEL)


def test_two_causes_are_both_named_and_measured() -> None:
    effects = Effects(bow_m=1e-3, spoiled_px=3.0)
    detections, truth = corner_session(CHECKERBOARD, LENS, FIRST_SEED, effects=effects)
    findings = diagnose(detections, CHECKERBOARD)
    assert set(findings.names) == {"bowed_board", "spoiled_view"}
    spoiled, bowed = findings
    assert f"view {truth.draw.spoiled_view:02d}:" in spoiled.evidence
    found = searched(detections)
    assert {step.test.cause for step in found.accepted} == {"bowed_board", "spoiled_view"}
    sag, sigma = causes.sag(found.model)
    assert abs(sag - 1e-3) < 4 * sigma < 2e-4
    assert f"{1e3 * sag:.2f} ±" in bowed.evidence
    assert abs(found.model.camera.fx - LENS.fx) < 4.0 < abs(found.start.camera.fx - LENS.fx)


def test_the_sizes_of_focus_drift_and_shutter_motion_come_out() -> None:
    drifting, truth = corner_session(
        CHECKERBOARD, LENS, FIRST_SEED + 1, effects=Effects(focus_drift=0.02)
    )
    model = searched(drifting).model
    assert tuple(model.sizes) == (causes.FOCUS,)
    assert model.sizes[causes.FOCUS] == pytest.approx(truth.draw.focal_scale.std(), rel=0.25)
    moving, truth = corner_session(
        CHECKERBOARD, LENS, FIRST_SEED + 1, effects=Effects(readout_s=0.02, speed_m_s=0.1)
    )
    model = searched(moving).model
    assert tuple(model.sizes) == (causes.SHUTTER,)
    assert np.sqrt(3) * model.sizes[causes.SHUTTER] == pytest.approx(0.002, rel=0.25)
    estimated, true = model.values[causes.SHUTTER][:, :2], 0.02 * truth.draw.velocity_m_s[:, :2]
    assert np.corrcoef(estimated.ravel(), true.ravel())[0, 1] > 0.7


# --- the statistics ---


def small(seed: int, effects: Effects | None = None) -> Calibration:
    detections, _ = corner_session(CHARUCO, LENS, seed, views=6, effects=effects or Effects())
    return causes.refit(Calibration.of(calibrate(detections, CHARUCO)))


def dense_jacobian(linear: Linear, corners: CornerTable) -> np.ndarray:
    n = len(corners.view)
    poses = np.zeros((n, 2, 6, 6))
    poses[np.arange(n), :, corners.view] = linear.own
    return np.concatenate([linear.shared.reshape(2 * n, -1), poses.reshape(2 * n, -1)], axis=1)


def test_the_derivatives_are_those_of_the_model() -> None:
    """Against central differences, for a model in which every cause is present."""
    model = small(FIRST_SEED + 5)
    rng = np.random.default_rng(0)
    sizes = {**dict.fromkeys(causes.PHYSICAL, 3e-4), causes.FOCUS: 0.01, causes.DRIFT: 1.0}
    sizes |= {causes.SHUTTER: 1e-3, causes.LENS: 0.0}
    values = {c: sizes[c] * rng.normal(size=v.shape) for c, v in model.values.items()}
    columns = replace(model, values=values).linear.columns

    for cause in causes.PHYSICAL:
        tolerance = 1e-5 if cause in (causes.FOCUS, causes.LENS, causes.DRIFT) else 1e-4
        for direction in np.eye(values[cause].shape[-1])[:8]:
            k = int(direction.argmax())
            ahead, back = (
                replace(model, values=values | {cause: values[cause] + step * direction})
                for step in (1e-6, -1e-6)
            )
            by_cause = (back.linear.residuals - ahead.linear.residuals) / 2e-6
            assert np.abs(by_cause - columns[cause][..., k]).max() < tolerance  # of 1e3 px/m


def test_the_fisheye_is_opencvs_with_its_derivatives() -> None:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20, 3)) * [1.0, 1.0, 0.3] + [0.0, 0.0, 1.5]
    lens = Intrinsics(640, 480, 300, 310, 320, 240, "brown_conrady", (0.03, -0.02, 0, 0, 0.004))
    coeffs = np.array([0.03, -0.02, 0.004, 0.0])
    pixels, by_parameter, by_point = fisheye_with_derivatives(points, lens)
    theirs, _ = cv2.fisheye.projectPoints(points[None], np.zeros(3), np.zeros(3), lens.K, coeffs)
    np.testing.assert_allclose(pixels, theirs[0], atol=1e-9)

    def seen(e, d=0.0):
        moved = with_parameters(lens, parameter_vector(lens) + e)
        return fisheye_with_derivatives(points + d, moved)[0]

    np.testing.assert_allclose(derivative(seen, 1e-6, 9), by_parameter, atol=1e-3)
    numerical = derivative(lambda d: seen(0.0, d), 1e-6, 3)
    np.testing.assert_allclose(numerical, by_point, atol=1e-4)


def test_the_size_of_a_cause_is_the_restricted_maximum_likelihood() -> None:
    """Against the likelihood written out with a dense covariance."""
    model = small(FIRST_SEED + 6, Effects(focus_drift=0.02))
    hypothesis = model.hypothesis(causes.FOCUS)
    J, r = dense_jacobian(model.linear, model.corners), model.linear.residuals.ravel()
    # Error contrasts: an orthonormal basis of all that the model cannot imitate
    u, s, _ = np.linalg.svd(J / np.linalg.norm(J, axis=0))
    contrasts = u[:, (s > 1e-10 * s[0]).sum() :]
    z, K = contrasts.T @ r, contrasts.T @ hypothesis.columns

    def deviance(log_ratio: float) -> float:
        V = np.eye(len(z)) + np.exp(log_ratio) * K @ K.T
        squares = z @ np.linalg.solve(V, z)
        return float(len(z) * np.log(squares / len(z)) + np.linalg.slogdet(V)[1])

    best = minimize_scalar(deviance, bounds=(-20, 5), method="bounded")
    V = np.eye(len(z)) + np.exp(best.x) * K @ K.T
    sigma = np.sqrt(z @ np.linalg.solve(V, z) / len(z))
    test = model.plain.explains(hypothesis)
    size, gain = test.size, test.gain
    assert size == pytest.approx(np.exp(best.x / 2) * sigma, rel=0.1)  # the grid's step is 13 %
    assert gain == pytest.approx(deviance(-60.0) - best.fun, abs=0.2)


def test_p_values_of_healthy_sessions_are_uniform() -> None:
    """Kolmogorov-Smirnov at 1 %, over all causes; views that differ in noise make no difference."""
    count = 200 if NIGHTLY else 8
    p_values: dict[str, list[float]] = {cause: [] for cause in causes.PHYSICAL}
    for seed in range(FIRST_SEED + 3000, FIRST_SEED + 3000 + count):
        detections, _, board = session(seed, Effects(noise_spread=0.2))
        model = Calibration.of(calibrate(detections, board))
        for cause in causes.PHYSICAL:
            p_values[cause].append(model.test(model.hypothesis(cause)).p_value)
    for cause, values in p_values.items():
        assert kstest(values, "uniform").pvalue > 0.01 / len(p_values), cause


def test_the_refit_without_causes_is_opencvs_minimum() -> None:
    detections, _ = corner_session(CHARUCO, LENS, FIRST_SEED + 7)
    result = calibrate(detections, CHARUCO)
    away = replace(result.intrinsics, fx=result.intrinsics.fx * 1.03, cx=330.0)
    refitted = causes.refit(replace(Calibration.of(result), camera=away)).camera
    for name in ("fx", "fy", "cx", "cy"):
        assert abs(getattr(refitted, name) - result.value(name)) < 0.05 * result.sigma(name)


def test_a_board_that_is_mirrored_in_its_tilt_is_turned_over() -> None:
    detections, _ = corner_session(CHARUCO, LENS, FIRST_SEED + 8)
    model = Calibration.of(calibrate(detections, CHARUCO))
    assert np.array_equal(causes.turned_over(model).poses, model.poses)
    away, centre = model.poses.copy(), model.board.mean(axis=0)
    middle = away[3, :3, :3] @ centre + away[3, :3, 3]
    mirror = np.eye(3) - 2 * np.outer(middle, middle) / (middle @ middle)
    away[3, :3, :3] = mirror @ away[3, :3, :3] @ np.diag([1.0, 1.0, -1.0])
    away[3, :3, 3] = middle - away[3, :3, :3] @ centre
    assert np.abs(causes.turned_over(replace(model, poses=away)).poses - model.poses).max() < 1e-3


# --- sessions that nobody here made, and lenses beyond the model ---


def fisheye_views(focal: float, seed: int) -> Detections:
    """25 views of a board out to 80 deg from the axis of a lens that grows with the angle."""
    rng, views = np.random.default_rng(seed), []
    P = CHECKERBOARD.points - CHECKERBOARD.points.mean(axis=0)
    while len(views) < 25:
        turn, out = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0, 65))
        ahead = np.array([np.sin(out) * np.cos(turn), np.sin(out) * np.sin(turn), np.cos(out)])
        facing, _ = Rotation.align_vectors(ahead[None], [[0.0, 0.0, 1.0]])
        tilt = Rotation.from_euler("xyz", rng.uniform(-35, 35, 3), degrees=True)
        X = (facing * tilt).apply(P) + rng.uniform(0.2, 0.4) * ahead
        radius = np.hypot(X[:, 0], X[:, 1])
        angle = np.arctan2(radius, X[:, 2])
        seen = X[:, :2] / radius[:, None] * focal * angle[:, None] + [639.5, 479.5]
        inside = (seen > 5).all() and (seen < [1274, 954]).all()
        if inside and (X[:, 2] > 0.03).all():
            noisy = seen + rng.normal(0, 0.08, seen.shape)
            views.append(Detection(np.arange(54), noisy, (1280, 960), f"view {len(views)}"))
    return Detections(views)


FISHEYES = [(310.0, 3), (340.0, 4), (280.0, 5)]


@pytest.mark.parametrize(("focal", "seed"), FISHEYES if NIGHTLY else FISHEYES[2:])
def test_a_fisheye_is_a_wrong_lens_and_nothing_else(focal: float, seed: int) -> None:
    findings = diagnose(fisheye_views(focal, seed), CHECKERBOARD)
    assert findings.names == ("lens_model",)
    assert "cv2.fisheye" in findings[0].remedy
    assert any("passes for bow" in line for line in findings.not_tested)


def test_a_steady_drift_is_told_from_an_autofocus() -> None:
    """The lens grows by 1 % from the first view to the last."""
    still, _ = corner_session(CHECKERBOARD, LENS, FIRST_SEED, views=28)
    middle, longer = LENS.K[:2, 2], np.linspace(1, 1.01, 28)
    grown = zip(still, longer, strict=True)
    views = [replace(view, pixels=middle + k * (view.pixels - middle)) for view, k in grown]
    findings = diagnose(Detections(views), CHECKERBOARD)
    assert findings.names == ("steady_drift",)
    [longer] = re.findall(r"grows by ([+-][0-9.]+) %", findings[0].evidence)
    assert float(longer) == pytest.approx(1.0, abs=0.3)


# --- what needs no fit ---


def test_too_few_views() -> None:
    detections, _ = corner_session(CHARUCO, LENS, FIRST_SEED, views=4)
    findings = diagnose(detections, CHARUCO)
    assert "few_views" in findings.names
    assert "4 usable views" in findings[findings.names.index("few_views")].evidence
    assert diagnose(detections[:2], CHARUCO).names == ("few_views",)
    assert diagnose(Detections([]), CHARUCO).names == ("few_views",)


# What `detect_all` says of such an image.
SIZE_REASON = "1280x720 px, where most are 640x480: one calibration is for one size"


def test_mixed_sizes_are_named_and_the_majority_is_used() -> None:
    detections, _ = corner_session(CHARUCO, LENS, FIRST_SEED + 8)
    other = replace(detections[3], size=(1280, 720), name="large.png")
    mixed = Detections([*detections[:3], other, *detections[4:]])
    findings = diagnose(mixed, CHARUCO)
    assert findings.names == ("mixed_sizes",)
    assert "large.png" in findings[0].evidence
    assert "640x480" in findings[0].evidence
    skipped = Detections(detections, [Skipped("big.png", SIZE_REASON, "other_size")])
    assert diagnose(skipped, CHARUCO).names == ()  # left out already, and said so


def test_a_board_with_another_number_of_squares_is_recognised_by_its_lattice() -> None:
    detections, _ = corner_session(CHECKERBOARD, LENS, FIRST_SEED + 9)
    narrower = Board("checkerboard", (7, 10), 0.025)
    findings = diagnose(detections, narrower)
    assert findings.names == ("wrong_board_size",)
    assert "with 9 inner corners in a row they fit" in findings[0].evidence
    assert "7x10 squares (6x9 inner corners)" in findings[0].remedy
    fewer = Board("checkerboard", (10, 5), 0.025)
    findings = diagnose(detections, fewer)
    assert findings.names == ("wrong_board_size",)
    assert "corner 53 was seen, the board has 0 to 35" in findings[0].evidence


def test_a_board_that_the_detector_saw_with_other_squares_is_named() -> None:
    reason = "a checkerboard of 10x7 squares: you gave inner corners, squares are one more"
    skipped = [Skipped(f"view {i}", reason, "other_board") for i in range(12)]
    findings = diagnose(Detections([], skipped), Board("checkerboard", (9, 6), 0.025))
    assert findings.names == ("wrong_board_size",)
    assert reason in findings[0].evidence


def test_a_model_without_distortion_is_named_for_a_lens_with_it() -> None:
    detections, _ = corner_session(CHECKERBOARD, LENS, FIRST_SEED + 12)
    assert "lens_model" in diagnose(detections, CHECKERBOARD, model="none").names
    assert diagnose(detections, CHECKERBOARD).names == ()


@pytest.mark.parametrize("board", BOARDS)
def test_corners_without_noise_have_nothing_to_find(board: Board) -> None:
    detections, _ = corner_session(board, LENS, FIRST_SEED + 13, noise_px=0.0)
    assert diagnose(detections, board).names == ()


def test_blur_along_one_direction_is_motion_and_round_blur_is_not() -> None:
    def view(blur: np.ndarray) -> Detection:
        return Detection(np.arange(4), np.zeros((4, 2)), (640, 480), blur=blur)

    sharp, along = 0.4 * np.eye(2), np.array([0.6, 0.8])
    moved = sharp + 16 / 12 * np.outer(along, along)
    round_blur = 2.0 * np.eye(2)
    lengths = blur_lengths_px(
        [view(sharp), view(sharp), view(sharp), view(moved), view(round_blur)]
    )
    assert np.allclose(lengths, [0, 0, 0, 4, 0], atol=1e-6)


# --- a wrong square size ---


@pytest.mark.parametrize("times", [0.03, 30.0])
def test_a_bow_is_named_whatever_the_square_size(times: float) -> None:
    detections, _ = corner_session(CHARUCO, LENS, FIRST_SEED + 10, effects=Effects(bow_m=1e-3))
    sizes = {name: times * getattr(CHARUCO, name) for name in ("square_m", "marker_m")}
    assert diagnose(detections, replace(CHARUCO, **sizes)).names == ("bowed_board",)


def test_images_alone_do_not_show_a_wrong_square_size_and_the_report_says_what_would() -> None:
    effects = Effects(square_scale=0.96)
    detections, truth = corner_session(CHARUCO, LENS, FIRST_SEED + 10, effects=effects)
    findings = diagnose(detections, CHARUCO)
    assert findings.names == ()
    assert any("wrong square size" in line and "ruler" in line for line in findings.not_tested)
    revealed = diagnose(detections, CHARUCO, depth_m=truth.depth_m)
    assert revealed.names == ("wrong_square_size",)
    found = re.search(r"squares of (\S+) mm, not 25\.00 mm", revealed[0].evidence)
    assert found
    assert float(found[1]) == pytest.approx(24.0, abs=0.1)
    assert not any("wrong square size" in line for line in revealed.not_tested)


def test_the_depth_scale_has_an_honest_sigma() -> None:
    off = []
    for seed in range(FIRST_SEED, FIRST_SEED + 20):
        detections, truth = corner_session(
            CHARUCO, LENS, seed, views=20, effects=Effects(square_scale=1.02)
        )
        scale = depth_scale(calibrate(detections, CHARUCO), list(truth.depth_m))
        assert scale is not None
        off.append((scale[0] - 1.02) / scale[1])
    assert np.mean(np.square(off)) < 1.9  # chi2(20)/20 exceeds 1.9 in 1 % of all cases
    assert np.mean(np.square(off)) > 0.1


# --- the arguments ---


def test_depths_that_do_not_fit_the_views_are_refused() -> None:
    detections, truth = corner_session(CHARUCO, LENS, FIRST_SEED, views=12)
    with pytest.raises(ValueError, match="depth_m: got 3, want 12 views, each"):
        diagnose(detections, CHARUCO, depth_m=truth.depth_m[:3])
    with pytest.raises(ValueError, match=r"depth_m\[0\]: got shape \(2,\), want"):
        diagnose(detections, CHARUCO, depth_m=[z[:2] for z in truth.depth_m])
    with pytest.raises(ValueError, match=r"depth_m: .* millimetres"):
        diagnose(detections, CHARUCO, depth_m=[1e3 * z for z in truth.depth_m])
    hole = replace(detections[0], pixels=detections[0].pixels * np.nan)
    with pytest.raises(ValueError, match=r"detections\[0\].pixels: .* finite"):
        diagnose([hole, *detections[1:]], CHARUCO)
