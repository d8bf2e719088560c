"""Rows I1 to I8 of data/claims.csv: intrinsic calibration.

Sessions are simulated at the corners. COURSEKIT_NIGHTLY=1 takes more of them.
"""

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from lesson_claims import ROWS, claim
from scipy.spatial.transform import Rotation
from simulated_corners import CHARUCO, CHECKERBOARD, LENS, NIGHTLY, fit

from coursekit import intrinsics
from coursekit.boards import Board, BoardNotFound, Detection, Detections, detect
from coursekit.geometry import Intrinsics, make_transform, project, transform_points
from coursekit.intrinsics.comparison import difference_px
from coursekit.intrinsics.fit import evaluate, image_grid
from coursekit.simulation.corner_sessions import Effects, bowed, corner_session

SEEDS = range(9000, 9060 if NIGHTLY else 9003)
MORE_SEEDS = range(9000, 9060 if NIGHTLY else 9015)  # for a mean that scatters more


def fits(board: Board, seeds: range = SEEDS, **session) -> list[intrinsics.IntrinsicsResult]:
    return [fit(board, seed, **session) for seed in seeds]


def facing(R: Rotation, z_m: float, across_m: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """T_camera_board with the checkerboard's middle at (across_m, z_m)."""
    centre = CHECKERBOARD.points.mean(axis=0)
    return make_transform(R, np.array([*across_m, z_m]) - R.apply(centre))


# --- I1: the bow ---


def stated(result: intrinsics.IntrinsicsResult, name: str) -> float:
    """The standard deviation that OpenCV would state: of corners that err each by itself."""
    variances = np.diag(result.equations.shared_covariance)
    return float(result.sigma_px * np.sqrt(variances[result.names.index(name)]))


@claim("I1", "wrong")
def test_i1_a_bow_moves_corners_little_and_the_focal_length_much() -> None:
    refitted = []
    texts = {600.0: "0.4 / 0.9 / 1.0 px at", 900.0: "0.5 / 1.3 / 1.6 at f 900"}
    for focal, text in texts.items():
        K, moved = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1]]), []
        for tilt in (15, 45, 60):
            T = facing(Rotation.from_euler("x", tilt, degrees=True), 0.5)
            flat = project(transform_points(T, CHECKERBOARD.points), K)
            bent = project(transform_points(T, bowed(CHECKERBOARD, 0.001)), K)
            moved.append(np.linalg.norm(bent - flat, axis=1).max())
            _, r, t = cv2.solvePnP(CHECKERBOARD.points, bent, K, None)
            again = cv2.projectPoints(CHECKERBOARD.points, r, t, K, None)[0][:, 0]
            refitted.append(np.linalg.norm(again - bent, axis=1).max())
        assert max(moved) < 2  # not several px
        ROWS["I1"].says(text)
        written = [float(word) for word in text.replace("/", " ").split()[:3]]
        np.testing.assert_allclose(moved, written, atol=0.07)
    assert max(refitted) == pytest.approx(0.9, abs=0.05)

    ROWS["I1"].says("-1.7 % (checkerboard) to -2.7 % (ChArUco)", "3-5 of its stated sigmas")
    ROWS["I1"].says("RMS is 0.19 px (0.22-0.31 px with 0.12-0.2 px of noise)")
    for board, percent, sigmas in ((CHECKERBOARD, -1.7, -3.2), (CHARUCO, -2.7, -4.9)):
        found = fits(board, MORE_SEEDS, effects=Effects(bow_m=0.001))
        bias = 100 * np.mean([r.value("fx") / LENS.fx - 1 for r in found])
        assert bias == pytest.approx(percent, abs=0.2)
        off = np.mean([(r.value("k1") - LENS.coeffs[0]) / stated(r, "k1") for r in found])
        assert off == pytest.approx(sigmas, abs=1.0)
        assert np.mean([r.rms_px for r in found]) == pytest.approx(0.19, abs=0.01)
        for noise, wanted in ((0.12, 0.225), (0.2, 0.31)):
            found = fits(board, noise_px=noise, effects=Effects(bow_m=0.001))
            assert np.mean([r.rms_px for r in found]) == pytest.approx(wanted, abs=0.015)


# --- I2 and I3: what images do not say ---

FAR_LENS = Intrinsics(1280, 720, 900.0, 900.0, 640.0, 360.0)


@claim("I2", "right")
def test_i2_tilt_makes_the_focal_length_known() -> None:
    """Exact sigmas of fx, and that residuals do not show them.

    Nine by six inner corners, every view tilted by the angle, to all sides. That fits scatter as
    their sigmas say is shown in test_intrinsics_uncertainty.py.
    """
    percent = {1: 41.0, 2: 10.0, 5: 1.8, 10: 0.52, 20: 0.20, 45: 0.10}
    ROWS["I2"].says(" / ".join(f"{p:.2f}" if p < 1 else f"{p:g}" for p in percent.values()))
    names = ("fx", "fy", "cx", "cy")
    for tilt, wanted in percent.items():
        azimuths = 2 * np.pi * np.arange(12) / 12
        axes = np.stack([np.cos(azimuths), np.sin(azimuths), np.zeros(12)], axis=1)
        poses = np.stack([facing(Rotation.from_rotvec(math.radians(tilt) * a), 0.5) for a in axes])
        seen = [project(transform_points(T, CHECKERBOARD.points), FAR_LENS.K) for T in poses]
        clean = [Detection(np.arange(54), pixels, FAR_LENS.size) for pixels in seen]
        exact = evaluate(FAR_LENS, poses, clean, CHECKERBOARD, CHECKERBOARD.points, names, "none")
        sigma = 0.2 * math.sqrt(exact.equations.shared_covariance[0, 0])
        assert 100 * sigma / FAR_LENS.fx == pytest.approx(wanted, rel=0.15)
    flat = fits(CHECKERBOARD, effects=Effects(max_tilt_deg=3.0))
    tilted = fits(CHECKERBOARD)
    for useless, useful in zip(flat, tilted, strict=True):
        assert useless.rms_px == pytest.approx(useful.rms_px, rel=0.05)
        assert useless.sigma("fx") > 25 * useful.sigma("fx")
    # at the boards' own distance the wrong f of a session hardly shows either; far away it does
    assert np.median(useless.uncertainty_map(useless.board_range_m)) < 0.5
    assert np.median(useless.uncertainty_map(math.inf)) > 4


def stretched_session(roll_deg: float, stretch: float, seed: int) -> Detections:
    """Twenty tilted views, rolled by up to roll_deg, of a board whose x is stretched."""
    rng, views = np.random.default_rng(seed), []
    points = CHECKERBOARD.points * [stretch, 1, 1]
    for i in range(20):
        azimuth, tilt = 2 * np.pi * i / 20, math.radians(rng.uniform(20, 45))
        lean = Rotation.from_rotvec(tilt * np.array([math.cos(azimuth), math.sin(azimuth), 0]))
        roll = Rotation.from_euler("z", rng.uniform(-roll_deg, roll_deg), degrees=True)
        T = facing(lean * roll, rng.uniform(0.4, 0.6), (rng.uniform(-0.08, 0.08), 0.0))
        pixels = project(transform_points(T, points), LENS.K, LENS.dist)
        noise = rng.normal(0, 0.1, pixels.shape)
        views.append(Detection(np.arange(54), pixels + noise, LENS.size, f"{i:02d}"))
    return Detections(views)


@claim("I3", "right")
def test_i3_a_wrong_square_size_leaves_no_trace_in_the_image() -> None:
    views, _ = corner_session(CHARUCO, LENS, 5)
    right = intrinsics.calibrate(views, CHARUCO)
    wrong_board = replace(CHARUCO, square_m=0.024, marker_m=0.018)
    wrong = intrinsics.calibrate(views, wrong_board)
    assert wrong.rms_px == pytest.approx(right.rms_px, abs=1e-7)
    assert wrong.value("fx") == pytest.approx(right.value("fx"), abs=1e-3)
    shorter = wrong.T_camera_board[:, 2, 3] / right.T_camera_board[:, 2, 3]
    np.testing.assert_allclose(shorter, 24 / 25, rtol=1e-5)

    rms, aspect = {}, {}
    for roll in (0, 45, 90):
        for stretch in (1.0, 1.01):
            fit = intrinsics.calibrate(stretched_session(roll, stretch, 1), CHECKERBOARD)
            rms[roll, stretch] = fit.rms_px
            aspect[roll, stretch] = fit.value("fx") / fit.value("fy") * LENS.fy / LENS.fx
    ROWS["I3"].says("RMS .14 to .19-.22", "rolls up to 45-90 deg", ".140 both times", "1.2 % apart")
    assert [rms[roll, 1.0] for roll in (0, 45, 90)] == pytest.approx([0.140] * 3, abs=0.002)
    assert rms[0, 1.01] == pytest.approx(0.140, abs=0.002)
    assert rms[45, 1.01] == pytest.approx(0.19, abs=0.01)
    assert rms[90, 1.01] == pytest.approx(0.22, abs=0.01)
    assert aspect[0, 1.01] - aspect[0, 1.0] == pytest.approx(0.012, abs=0.002)


# --- I4 to I6: judging, rules, time ---


@claim("I4", "imprecise")
def test_i4_rms_is_no_quality() -> None:
    per_axis = [value / math.sqrt(2) for value in (0.15, 0.3)]
    ROWS["I4"].says(f"{per_axis[0]:.2f}-{per_axis[1]:.2f} px per axis", "0.15-0.3; 0.5; 1 px")
    useless = fits(CHECKERBOARD, noise_px=0.1, effects=Effects(max_tilt_deg=2.0))
    useful = fits(CHECKERBOARD, noise_px=0.1)
    for one, other in zip(useless, useful, strict=True):
        assert one.rms_px < 0.15  # better than "careful"
        assert one.rms_px == pytest.approx(math.hypot(*one.rms_uv_px))
        assert one.rms_px == pytest.approx(other.rms_px, rel=0.02)
        assert one.verdict().startswith("Not good enough")
        assert not other.verdict().startswith("Not")
    off = np.sqrt(np.mean([(r.value("fx") - LENS.fx) ** 2 for r in useless]))
    assert 20 < off < 200  # tens of px
    assert np.mean([r.rms_px for r in useless]) == pytest.approx(0.14, abs=0.005)
    assert max(abs(r.value("fx") - LENS.fx) for r in useful) < 3


@claim("I5", "right")
def test_i5_what_each_rule_buys() -> None:
    """Broken one at a time, each rule costs sigma_f or the projection at the worst pixel."""

    def sigma(**session) -> float:
        return float(np.mean([r.sigma("fx") for r in fits(CHARUCO, **session)]))

    def worst(**session) -> float:
        maps = [r.uncertainty_map(0.45, (7, 9)) for r in fits(CHARUCO, **session)]
        return float(np.mean([sigmas.max() for sigmas in maps]))

    assert sigma(views=6) > 2 * sigma()
    assert sigma(views=20) > sigma(views=40)
    by_tilt = [sigma(effects=Effects(max_tilt_deg=tilt)) for tilt in (10, 30, 45)]
    assert by_tilt[0] > 5 * by_tilt[1] > 5 * by_tilt[2]
    inner = {"effects": Effects(inner_only=0.15)}
    assert sigma(**inner) < 1.5 * sigma()  # corners in the image corners do little for fx
    assert worst(**inner) > 10 * worst()  # and everything for the border
    ROWS["I5"].says("sigma_f and in projection uncertainty")


@claim("I6", "right")
def test_i6_a_calibration_is_a_small_problem() -> None:
    """No clock: the number of steps that suffice, times the multiplications of one."""
    board, views = CHARUCO, corner_session(CHARUCO, LENS, 6)[0]
    objects = [board.points[v.ids].astype(np.float32) for v in views]
    corners = [v.pixels.astype(np.float32) for v in views]

    def focal(steps: int) -> float:
        criteria = (cv2.TERM_CRITERIA_COUNT, steps, 0)
        _, K, *_ = cv2.calibrateCamera(objects, corners, LENS.size, None, None, criteria=criteria)
        return float(K[0, 0])

    result = intrinsics.calibrate(views, board)
    assert focal(30) == pytest.approx(focal(200), abs=0.01 * result.sigma("fx"))
    data, unknowns = 2 * result.corners, 9 + 6 * len(views)
    multiplications = data * unknowns**2  # J'J, as if J were dense
    assert multiplications == pytest.approx(6e7, rel=0.3)
    assert 30 * multiplications < 5e9  # a core does some 1e9 a second without effort
    ROWS["I6"].says("30 iterations", "6e7 multiplications", "seconds")


# --- I7 and I8: boards and causes ---


@claim("I7", "right")
def test_i7_charuco_knows_which_corner_it_sees() -> None:
    def picture(board: Board) -> np.ndarray:
        return np.pad(board.image(60), 60, constant_values=255)

    whole = picture(CHARUCO)
    part = detect(whole[:, :360], CHARUCO)  # a good half of the board
    assert 12 <= len(part.ids) < len(CHARUCO.points)
    exact = 59.5 + 60 * CHARUCO.points[part.ids, :2] / 0.025
    assert np.abs(part.pixels - exact).max() < 0.1
    with pytest.raises(BoardNotFound):
        detect(picture(CHECKERBOARD)[:, :360], CHECKERBOARD)


CAUSES = {
    "focus_drift": Effects(focus_drift=0.02),
    "motion_blur": Effects(blur_px=3.0),
    "rolling_shutter": Effects(readout_s=0.02, speed_m_s=0.1),
    "no_edge_corners": Effects(inner_only=0.15),
}


def harm_px(**session) -> float:
    """How far the fitted camera is off at its worst pixel, 0.45 m away; mean over sessions."""
    grid = image_grid(LENS, (9, 11)).reshape(-1, 2)
    found = [r.intrinsics for r in fits(CHARUCO, **session)]
    off = [np.linalg.norm(difference_px(LENS, lens, grid, 0.45), axis=1) for lens in found]
    return float(np.mean(np.max(off, axis=1)))


@claim("I8", "right")
def test_i8_each_cause_has_a_signature_and_does_harm() -> None:
    """That each cause, and none, is named in session after session: test_intrinsics_diagnose.py."""
    for name, effects in CAUSES.items():
        views, _ = corner_session(CHARUCO, LENS, 3, effects=effects)
        assert intrinsics.diagnose(views, CHARUCO).names == (name,)
        if name != "motion_blur":
            assert harm_px(effects=effects) > 1.8 * harm_px(), name
    # a blur of 3 px in a third of the views: noisier corners there, and a fit that averages them
    blurred, sharp = [], []
    for seed in range(SEEDS.start, SEEDS.stop + 2):
        views, truth = corner_session(CHARUCO, LENS, seed, effects=CAUSES["motion_blur"])
        rms = intrinsics.calibrate(views, CHARUCO).per_view_rms_px
        blurred.append(rms[list(truth.draw.blurred)].mean())
        sharp.append(np.delete(rms, truth.draw.blurred).mean())
    assert np.mean(blurred) > 1.03 * np.mean(sharp)
    ROWS["I8"].says("reproducible session with its own signature")
