"""Stereo statistics against Monte Carlo, closed forms, SciPy and rendered scenes.

The coverage of every 95 % interval is counted over many simulated sessions: with
COURSEKIT_NIGHTLY=1 over 1,000, otherwise over 50. One sigma of such a count is 0.7 % (3.1 %), and
three of those to either side are allowed (`about_95_percent`).
"""

import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from common import EXPECTED, NIGHTLY, each, named, refusals
from scipy.ndimage import gaussian_filter
from scipy.spatial.transform import Rotation

from coursekit import stereo
from coursekit.cameras.camera import Frame, Frames
from coursekit.geometry import Intrinsics, make_transform
from coursekit.simulation import render, tabletop
from coursekit.specifications import device

UNIT = device("D435").unit
FX, BASELINE = UNIT.depth.fx, UNIT.baseline_m
FB = FX * BASELINE
NEAR = np.array([0.30, 0.45, 0.60])
FAR = np.array([0.30, 0.45, 0.60, 1.0, 1.5, 2.0])
SESSIONS = 1000 if NIGHTLY else 50
WINDOWS = 200 if NIGHTLY else 20
SERIES = 300 if NIGHTLY else 40


def covers(interval: tuple[float, float], truth: float) -> bool:
    return interval[0] <= truth <= interval[1]


def about_95_percent(hits, of: int) -> bool:
    """Whether intervals hold the truth as often as they say, to three sigmas of the count."""
    return bool((np.abs(np.asarray(hits) / of - 0.95) <= 3 * math.sqrt(0.95 * 0.05 / of)).all())


# --- the law ---


def test_depth_from_disparity():
    """Its slope: claim D5."""
    z = np.array([0.3, 0.6, 2.0])
    np.testing.assert_allclose(stereo.depth_from_disparity(FB / z, FX, BASELINE), z)
    assert np.isnan(stereo.depth_from_disparity([0.0, -1.0, np.nan, np.inf], FX, BASELINE)).all()


# --- rounding ---


@pytest.mark.parametrize("sigma", [0.02, 0.08, 0.14, 0.16, 0.25, 0.4, 0.8, 3.0])
def test_rounded_variance_is_what_rounding_leaves(sigma):
    rng = np.random.default_rng(7)
    centres = (np.arange(5_000) + 0.5) / 5_000  # evenly between two steps
    rounded = np.round(centres[:, None] + sigma * rng.standard_normal((5_000, 60)))
    want = rounded.var(axis=1, ddof=1).mean()
    assert float(stereo.rounded_variance(sigma, 1.0)) == pytest.approx(want, rel=0.03)
    assert stereo.unrounded_std(math.sqrt(want), 1.0) == pytest.approx(sigma, rel=0.03)


# --- one window ---


def pixel_noise(rng, n, size, sigma, correlation=3.6):
    """Noise (n, size, size) that correlates 0.5 at 6 px, 0.06 at 12 px, as the matcher's does."""
    white = rng.standard_normal((n, size + 24, size + 24))
    smooth = gaussian_filter(white, (0, correlation, correlation))[:, 12:-12, 12:-12]
    return smooth * sigma * 2 * math.sqrt(math.pi) * correlation


def correlated(x, rho):
    """Frames (n, ...) of an AR(1) process, from ones (n, ...) that do not correlate."""
    y = x.copy()
    for i in range(1, len(y)):
        y[i] = rho * y[i - 1] + math.sqrt(1 - rho**2) * x[i]
    return y


def tilted(size=40, z=0.5, slope=2e-3):
    v, u = (np.indices((size, size)) - (size - 1) / 2) / size
    return 1 / (1 / z + slope / z**2 * (u + 2 * v))


def without_plane(image):
    v, u = np.indices(image.shape).reshape(2, -1)
    design = np.stack([np.ones(image.size), u, v], axis=1)
    plane = design @ np.linalg.lstsq(design, image.ravel(), rcond=None)[0]
    return image - plane.reshape(image.shape)


def test_tilt_is_neither_noise_nor_bias():
    rng = np.random.default_rng(3)
    steep = tilted(slope=0.03)
    stack = steep + 5e-4 * rng.standard_normal((80, 40, 40))
    stats = stereo.window_stats(stack, (0, 0, 40, 40))
    assert stats.depth_m == pytest.approx(0.5, abs=4 * stats.depth_error_m)
    assert stats.depth_error_m < 1e-4
    assert stats.pixel_std_m == pytest.approx(5e-4, rel=0.02)
    assert stats.spatial_std_m == pytest.approx(5e-4, rel=0.02)
    assert stats.mean_std_m == pytest.approx(5e-4 / 40, rel=0.25)
    assert steep.std() > 5e-3  # what a std without the plane would have said


@cache
def patterns(correlation_in_time: float) -> list[np.ndarray]:
    """Noise of standard deviation 1 in WINDOWS windows of 50 frames, for all tests to share."""
    rng = np.random.default_rng(11)
    return [correlated(pixel_noise(rng, 50, 30, 1.0), correlation_in_time) for _ in range(WINDOWS)]


@pytest.mark.parametrize("case", EXPECTED["windows"], ids=str)
def test_interval_of_a_pooled_std_covers(case):
    """Windows of 30x30 px whose pixels correlate: as often as they say, to three sigmas.

    As if all samples were independent, the same intervals would hold far less than half the time.
    """
    n, step, drift = case.get("n", 50), case.get("step"), case.get("drift", 0.0)
    rng, sigma, size, hits, naive = np.random.default_rng(12), 8e-4, 30, 0, 0
    truth = sigma * math.hypot(1, drift)
    if step:
        truth = math.sqrt(float(stereo.rounded_variance(sigma, step)))
    for noise in patterns(case.get("rho", 0.0)):
        stack = tilted(size) + sigma * noise[:n]
        stack += drift * sigma * correlated(rng.standard_normal((n, 1, 1)), 0.8)
        if step:
            stack = np.round(stack / step) * step
        stats = stereo.window_stats(stack, (0, 0, size, size), step)
        hits += covers(stats.pixel_std_interval_m, truth)
        half = 1.96 * stats.pixel_std_m / math.sqrt(2 * n * size**2)
        naive += abs(stats.pixel_std_m - truth) < half
    assert about_95_percent(hits, WINDOWS), hits / WINDOWS
    assert naive / WINDOWS < 0.5


def test_degrees_of_freedom_of_independent_pixels_are_all_of_them():
    rng = np.random.default_rng(5)
    stack = 0.5 + 1e-3 * rng.standard_normal((100, 20, 20))
    stats = stereo.window_stats(stack, (0, 0, 20, 20))
    assert stats.pixel_dof == pytest.approx(99 * 400, rel=0.1)
    assert stats.mean_dof == pytest.approx(99, rel=0.25)


def test_standard_error_of_the_depth_covers():
    """The error counts noise and pattern, so it may be wider, never narrower."""
    hits = 0
    for noise in patterns(0.0):
        stack = tilted(30) + 6e-4 * (noise[:1] + noise[1:13])  # a pattern that stays, and 12 frames
        stats = stereo.window_stats(stack, (0, 0, 30, 30))
        hits += abs(stats.depth_m - 0.5) < 1.96 * stats.depth_error_m
    assert hits / WINDOWS >= 0.95 - 3 * math.sqrt(0.95 * 0.05 / WINDOWS)


def test_holes_jumps_and_frozen_pixels_are_counted_and_left_out():
    rng = np.random.default_rng(8)
    stack = tilted() + 5e-4 * rng.standard_normal((50, 40, 40))
    stack[:, :4, :] = 0.0
    stack[rng.random(stack.shape) < 0.1] = np.nan
    stack[::7, 20, 20] = 0.9
    stack[:, 30, 30] = 0.7  # a mismatch in every frame
    stats = stereo.window_stats(stack, (0, 0, 40, 40))
    invalid = 1 - (np.isfinite(stack) & (stack > 0)).mean()
    assert stats.invalid_fraction == pytest.approx(invalid)
    assert stats.n_mismatches == pytest.approx(58, rel=0.15)
    assert not stats.not_gaussian
    assert stats.pixel_std_m == pytest.approx(5e-4, rel=0.03)
    assert stats.depth_m == pytest.approx(0.5, abs=2e-4)


def test_depth_unit_that_hides_the_noise_is_said():
    rng = np.random.default_rng(9)
    exact = tilted(slope=4e-3) + 2e-4 * rng.standard_normal((100, 40, 40))
    counts = np.round(exact / 1e-3).astype(np.uint16)
    stats = stereo.window_stats(counts, (0, 0, 40, 40), 1e-3)
    changes = (np.ptp(counts.astype(int), axis=0) > 0).mean()
    assert stats.frozen_fraction == pytest.approx(1 - changes)
    assert stats.pixel_std_unrounded_m == pytest.approx(2e-4, rel=0.06)
    assert stats.pixel_std_m > 1.3 * stats.pixel_std_unrounded_m


def around(rng, n=30, more=0.0, times=1.0):
    """A window on a tilted wall with one Gaussian noise of 0.6 mm, and what is done to it."""
    return tilted() + 6e-4 * pixel_noise(rng, n, 40, 1.0) * times + more


ACROSS, OVER_TIME = np.arange(40), np.arange(30)[:, None, None]
NOT_ONE_NOISE = {
    "two surfaces": (r"surfaces, 4\d\.\d mm", lambda r: around(r, more=0.05 * (ACROSS > 19))),
    "a sliver of another": ("two surfaces, ", lambda r: around(r, more=0.05 * (ACROSS > 34))),
    "jumps": ("two depths", lambda r: around(r, more=4e-3 * (r.random((30, 40, 40)) < 0.5))),
    "an edge": ("between parts of the window", lambda r: around(r, times=1 + 6.0 * (ACROSS > 31))),
    "a light goes off": ("times in the", lambda r: around(r, times=1 + 1.5 * (OVER_TIME > 14))),
    "warming up": ("a drift that all pixels share", lambda r: around(r, more=2e-4 * OVER_TIME)),
    "tails": ("heavy tails", lambda r: tilted() + 6e-4 * r.standard_t(3, (30, 40, 40))),
}


@pytest.mark.parametrize("kind", NOT_ONE_NOISE)
def test_a_window_that_is_not_one_gaussian_noise_widens_its_interval_and_says_why(kind):
    says, make = NOT_ONE_NOISE[kind]
    stats = stereo.window_stats(make(np.random.default_rng(5)), (0, 0, 40, 40))
    assert re.search(says, "; ".join(stats.not_gaussian)), stats.not_gaussian
    assert stats.pixel_dof < (25_000 if "tails" in says else 40)  # of 46,425, and of 650
    if "surfaces" in says:  # the depth's interval reaches both
        assert stats.depth_error_m > 0.4 * 0.05


ONE_NOISE = {
    "correlated": around,
    "white": lambda r: tilted() + 6e-4 * r.standard_normal((30, 40, 40)),
    "8 frames": lambda r: around(r, 8),
    "strongly tilted": lambda r: around(r) + tilted(slope=0.05) - tilted(),
    "slow noise": lambda r: tilted() + 6e-4 * correlated(pixel_noise(r, 60, 40, 1.0), 0.6),
    "a pattern": lambda r: around(r, more=8e-4 * pixel_noise(r, 1, 40, 1.0)),
    "another texture": lambda r: around(r, times=1 + (ACROSS > 19)),
    "a weak drift": lambda r: around(r, more=2e-4 * correlated(r.standard_normal((30, 1, 1)), 0.9)),
    "holes": lambda r: np.where(r.random((30, 40, 40)) < 0.2, np.nan, around(r)),
}


@pytest.mark.parametrize("kind", ONE_NOISE)
def test_an_ordinary_window_is_one_gaussian_noise(kind):
    found = [
        stereo.window_stats(ONE_NOISE[kind](np.random.default_rng(seed)), (0, 0, 40, 40))
        for seed in range(5)
    ]
    assert [stats.not_gaussian for stats in found] == [()] * 5


def test_the_interval_of_a_noise_with_heavy_tails_covers():
    hits, rng = 0, np.random.default_rng(6)
    for _ in range(SESSIONS):
        stats = stereo.window_stats(0.5 + 1e-3 * rng.laplace(size=(30, 12, 12)), (0, 0, 12, 12))
        hits += covers(stats.pixel_std_interval_m, 1e-3 * math.sqrt(2))
    assert hits / SESSIONS >= 0.92 - 3 * math.sqrt(0.92 * 0.08 / SESSIONS)


@pytest.mark.parametrize(
    ("kind", "step"), [(np.uint16, 1e-3), (np.uint16, 2.5e-4), (np.uint8, 0.01)]
)
def test_the_largest_count_of_a_type_is_no_depth(kind, step):
    rng = np.random.default_rng(7)
    counts = np.round((0.5 + 3 * step * rng.standard_normal((20, 30, 30))) / step).astype(kind)
    counts[:, :6] = np.iinfo(kind).max
    stats = stereo.window_stats(counts, (0, 0, 30, 30), step)
    assert stats.invalid_fraction == pytest.approx(0.2)
    assert stats.depth_m == pytest.approx(0.5, abs=step / 5)
    assert stats.n_mismatches == 0


def test_one_frame_gives_no_noise_over_time():
    rng = np.random.default_rng(10)
    image = tilted() + 5e-4 * rng.standard_normal((40, 40))
    stats = stereo.window_stats(image, (0, 0, 40, 40))
    assert stats.spatial_std_m == pytest.approx(5e-4, rel=0.05)
    assert stats.depth_m == pytest.approx(0.5, abs=2e-4)
    nothing = (stats.pixel_std_m, stats.pixel_std_error_m, stats.mean_std_m)
    assert np.isnan([*nothing, *stats.pixel_std_interval_m]).all()


def test_window_without_a_valid_pixel_is_nan():
    stats = stereo.window_stats(np.zeros((5, 30, 30), np.uint16), (0, 0, 20, 20), 1e-3)
    assert stats.invalid_fraction == 1.0
    nothing = (stats.depth_m, stats.pixel_std_m, stats.spatial_std_m, stats.mean_std_m)
    assert np.isnan(nothing).all()


# --- averaging ---


@pytest.mark.parametrize(("rho", "want"), [(0.0, 10.0), (0.5, 5.8)])
def test_gain_of_a_hundred_frames(rho, want):
    """Claim D8: 10x for independent frames, 5.8x for AR(1) with 0.5; exact gain by a closed form.

    var(mean) / var = (1 + 2 sum (1 - k/N) rho^k) / N. Median of the series, within 8 %.
    """
    rng = np.random.default_rng(12)
    lags = np.arange(1, 100)
    exact = math.sqrt(100 / (1 + 2 * ((1 - lags / 100) * rho**lags).sum()))
    assert exact == pytest.approx(want, abs=0.05)
    noise = 1e-3 * rng.standard_normal((SERIES, 100))
    curves = [stereo.averaging_curve(0.5 + correlated(series, rho)) for series in noise]
    assert np.median([c.gain for c in curves]) == pytest.approx(exact, rel=0.08)
    held = np.mean([covers(c.effective_frames_interval, exact**2) for c in curves])
    assert held >= 0.9  # the error of an autocorrelation time is itself an estimate


@pytest.mark.parametrize(("drift", "want", "below"), EXPECTED["weak_drifts"])
def test_a_weak_slow_drift_is_not_taken_for_white_noise(drift, want, below):
    """Series of 200 frames: white noise plus a drift of tau 90 frames and this amplitude.

    The exact number by a closed form. Intervals hold it in 88 to 100 % (a weak drift cannot be
    told from none, so they may be wide); the median is at least half of it and under a bound.
    """
    rng = np.random.default_rng(17)
    n, rho, lags = 200, math.exp(-1 / 90), np.arange(1, 200)
    tau = 1 + 2 * ((1 - lags / n) * rho**lags).sum()
    exact = n * (1 + drift**2) / (1 + drift**2 * tau)
    assert exact == pytest.approx(want, abs=0.1)
    noise = rng.standard_normal((SERIES // 2, n))
    drifts = drift * rng.standard_normal(noise.shape)
    series = [correlated(slow, rho) + white for slow, white in zip(drifts, noise, strict=True)]
    curves = [stereo.averaging_curve(one) for one in series]
    assert np.mean([covers(c.effective_frames_interval, exact) for c in curves]) >= 0.88
    assert exact / 2 <= np.median([c.effective_frames for c in curves]) <= below


def test_the_fixed_pattern_does_not_average_away():
    rng = np.random.default_rng(14)
    pattern = pixel_noise(rng, 1, 40, 8e-4)[0]
    left = without_plane(pattern)
    stack = tilted() + pattern + 1.5e-3 * rng.standard_normal((64, 40, 40))
    curve = stereo.averaging_curve(stack)
    assert curve.floor_m == pytest.approx(left.std(), rel=0.05)
    spatial = [
        np.mean([without_plane(mean).std() for mean in stack.reshape(-1, n, 40, 40).mean(axis=1)])
        for n in (1, 2, 4, 8, 16)
    ]
    assert spatial[0] == pytest.approx(math.hypot(left.std(), 1.5e-3), rel=0.05)
    assert curve.floor_m < spatial[-1] < math.hypot(left.std(), 1.5e-3 / 3)


# --- the noise fit ---


def stds_of(rng, distances, dof, sigma_d=0.08, step=None):
    """Stds as `dof` independent squares give them, of the law, rounded or not."""
    variance = (distances**2 * sigma_d / FB) ** 2
    if step:
        variance = stereo.rounded_variance(np.sqrt(variance), step)
    return np.sqrt(variance * rng.chisquare(dof, len(distances)) / dof)


@pytest.mark.parametrize("exponent", [None, 2])
@pytest.mark.parametrize(
    ("distances", "dof", "step"),
    [(NEAR, 1500, None), (NEAR, 60, 1e-3), (FAR, 300, 1e-4), (FAR, 15, None)],
)
def test_noise_intervals_cover(distances, dof, step, exponent):
    """Of sigma_d, of the exponent where it is free, and of the law far from the data."""
    rng = np.random.default_rng(20)
    hits = np.zeros(3)
    for _ in range(SESSIONS):
        stds = stds_of(rng, distances, dof, step=step)
        fit = stereo.fit_noise(distances, stds, dof, FX, BASELINE, step, exponent)
        hits[0] += covers(fit.sigma_d_interval_px, 0.08)
        hits[1] += covers(fit.std_m(1.5)[1:], 1.5**2 * 0.08 / FB)
        hits[2] += exponent is None and covers(fit.exponent_interval, 2.0)
    assert about_95_percent(hits[: 2 if exponent else 3], SESSIONS), hits / SESSIONS


def test_rounding_flattens_the_near_end_and_is_corrected():
    """The same noise in 1 mm units: below 1.9 as it stands, 2 with the unit taken into account."""
    stds = np.sqrt(stereo.rounded_variance(FAR**2 * 0.08 / FB, 1e-3))
    raw = stereo.fit_noise(FAR, stds, 1000, FX, BASELINE)
    assert raw.exponent < 1.96
    near = stereo.fit_noise(NEAR, stds[:3], 1000, FX, BASELINE)
    assert near.exponent < 1.9
    fit = stereo.fit_noise(FAR, stds, 1000, FX, BASELINE, 1e-3)
    assert fit.exponent == pytest.approx(2.0, abs=3e-4)
    assert fit.sigma_d_px == pytest.approx(0.08, rel=1e-3)
    assert "at 0.3 m the noise is 0.33 of the depth unit" in str(fit)


def test_one_distance_has_no_exponent_and_says_so():
    fit = stereo.fit_noise([0.45], [0.45**2 * 0.08 / FB], 500, FX, BASELINE)
    assert fit.exponent is None
    assert fit.exponent_interval is None
    assert fit.sigma_d_px == pytest.approx(0.08, rel=2e-3)
    assert str(fit).endswith(
        "from 1 distance.\n    Note: one distance has no exponent; sigma_d takes it to be 2."
    )


def test_three_near_distances_say_how_little_they_carry():
    stds = NEAR**2 * 0.08 / FB * [1.1, 1.0, 1.1]  # sub-pixel phase and pattern do that
    fit = stereo.fit_noise(NEAR, stds, 1500, FX, BASELINE)
    assert not fit.consistent
    low, high = fit.exponent_interval
    assert low < 1
    assert high > 3
    said = " ".join(str(fit).split())
    assert "span a factor of 2.0 only: 10 % more noise at one end moves the exponent by" in said
    assert "scatter about the law" in said
    assert max(map(len, str(fit).splitlines())) <= 100


@pytest.mark.parametrize("scatter", [0.0, 0.1])
@pytest.mark.parametrize("repeats", [2, 3, (5, 1, 2, 1, 1, 1)])
def test_repeats_in_any_order_show_the_scatter_from_run_to_run(repeats, scatter):
    rng, hits = np.random.default_rng(3), np.zeros(2)
    z = np.repeat(FAR, repeats)
    for _ in range(SESSIONS):
        at = rng.permutation(z)
        stds = stds_of(rng, at, 300) * np.exp(scatter * rng.standard_normal(len(z)))
        fit = stereo.fit_noise(at, stds, 300, FX, BASELINE)
        (low, high), (least, most) = fit.sigma_d_interval_px, fit.exponent_interval
        hits += [low <= 0.08 <= high, least <= 2 <= most]
        assert fit.n_distances == len(FAR)
    off = np.abs(hits / SESSIONS - 0.95)  # a scatter from a few repeats is not quite Student's
    assert (off <= 0.025 + 3 * math.sqrt(0.95 * 0.05 / SESSIONS)).all()


def test_a_fit_says_what_its_repeats_say():
    z = [0.6, 0.4, 0.6, 1.0, 0.4]
    stds = np.square(z) * np.array([0.090, 0.065, 0.105, 0.085, 0.080]) / FB
    fit = stereo.fit_noise(z, stds, 5_000, FX, BASELINE)
    expected = np.hypot(math.log(0.105 / 0.090), math.log(0.080 / 0.065)) / 2
    assert fit.scatter == pytest.approx(expected, rel=0.02)
    assert f"repeats at one distance differ by {fit.scatter:.0%} more" in " ".join(str(fit).split())
    alone = stereo.fit_noise(
        [0.6, 0.6, 0.6], stds[0] * np.array([0.9, 1.0, 1.1]), 5_000, FX, BASELINE
    )
    low, high = alone.sigma_d_interval_px
    assert math.log(high / low) / 2 == pytest.approx(4.303 * 0.1 / math.sqrt(3), rel=0.05)
    assert alone.exponent is None


@pytest.mark.parametrize("exponent", [0.0, 1.0])
def test_without_a_baseline_the_std_is_fitted_over_distance(exponent):
    rng, dof, hits = np.random.default_rng(8), 400, 0
    true = 0.002 * FAR**exponent
    for _ in range(SESSIONS):
        stds = true * np.sqrt(rng.chisquare(dof, len(FAR)) / dof)
        fit = stereo.fit_noise(FAR, stds, dof, 126.0, None)
        hits += covers(fit.exponent_interval, exponent)
    assert about_95_percent(hits, SESSIONS)
    assert fit.std_m(FAR)[0] == pytest.approx(true, rel=0.1)
    assert str(fit).startswith("std of depth at ")
    assert "no disparity: this is std over distance" in " ".join(str(fit).split())
    with pytest.raises(ValueError, match=r"^baseline_m: got None: no stereo camera, or a record"):
        _ = fit.sigma_d_px


def test_distances_without_noise_are_left_out_and_named():
    stds = FAR**2 * 0.08 / FB
    stds[0], stds[3] = 0.0, np.nan
    fit = stereo.fit_noise(FAR, stds, 500, FX, BASELINE)
    assert fit.n_distances == 4
    said = " ".join(str(fit).split())
    assert "0.3 m is left out: no pixel ever changed there" in said
    assert "1 m is left out: it has no std" in said


# --- the bias fit ---


def measure(z, b, o, p=0.0, width=0.06):
    """Depth and width that a rig with these errors reads, from the geometry of rays."""
    left, right = np.array([-width / 2, width / 2])[:, None] / z * FX + [[-p], [p]]
    d = FX * BASELINE * (1 + b) / z + o
    read = FX * BASELINE / d
    return read, (right - left) * read / FX


def test_bias_is_recovered_from_exact_measurements():
    depths, widths = measure(FAR, 0.004, 0.12, p=2.3)
    fit = stereo.fit_bias(FAR, FX, BASELINE, depths, 1e-5, widths, 1e-6, 0.06, tape_m=1e-5)
    assert fit.scale_error == pytest.approx(1 / 1.004 - 1, abs=1e-6)
    assert fit.value("disparity_offset_px") == pytest.approx(0.12, abs=1e-4)
    assert fit.value("fattening_px") == pytest.approx(2.3, abs=5e-3)  # its prior is 2.5 +- 2.5
    assert fit.value("constant_m") == pytest.approx(0.0, abs=1e-6)
    assert fit.value("baseline_error") == pytest.approx(0.004, rel=1e-3)
    bias, low, high = fit.bias_m(FAR)
    np.testing.assert_allclose(bias, depths - FAR, atol=1e-6)
    assert (low < bias).all()
    assert (bias < high).all()


def test_bias_fit_agrees_with_a_straight_line():
    """Z_tape / Z_m - 1 = b + o Z / (f B) is a straight line: NumPy's weighted fit of it."""
    rng = np.random.default_rng(30)
    tape = 1e-3
    depths = measure(FAR, 0.003, -0.08)[0] + tape * rng.standard_normal(6)
    given = {"tape_m": tape, "priors": stereo.BiasPriors(1e-9)}
    fit = stereo.fit_bias(FAR[:4], FX, BASELINE, depths[:4], 1e-5, **given)
    z, y = FAR[:4], FAR[:4] / depths[:4] - 1
    (slope, b), covariance = np.polyfit(z, y, 1, w=z / tape, cov="unscaled")
    assert fit.scale_error == pytest.approx(1 / (1 + b) - 1, abs=2e-5)
    assert fit.value("disparity_offset_px") == pytest.approx(slope * FB, abs=2e-3)
    half = 1.96 * math.sqrt(covariance[0, 0]) * FB
    low, high = fit.interval("disparity_offset_px")
    assert (high - low) / 2 == pytest.approx(half, rel=0.02)


@pytest.mark.parametrize("what", ["depths", "widths", "both"])
@pytest.mark.parametrize("distances", [NEAR, FAR], ids=["near", "far"])
def test_bias_intervals_cover(distances, what):
    """Hidden values as the simulated camera draws them; tape, caliper, edges, drift as stated."""
    rng = np.random.default_rng(31)
    hits, k = np.zeros(3), len(distances)
    priors = stereo.BiasPriors(edge_px=(2.5, 1.0), drift_px=0.02)
    for _ in range(SESSIONS):
        b, o, p = rng.normal(0, 0.004), rng.normal(0, 0.10), rng.normal(2.5, 1.0)
        true = distances + rng.normal(0, 0.002) + 1e-3 * rng.standard_normal(k)
        depths, widths = measure(true, b, o + 0.02 * rng.standard_normal(k), p)
        depths += 2e-4 * rng.standard_normal(k)
        widths += rng.normal(0, 2e-5) + 3e-4 * rng.standard_normal(k)
        widths += 2 * 0.5 * rng.standard_normal(k) * distances / FX
        given = {}
        if what != "widths":
            given |= {"depths_m": depths, "depth_errors_m": 2e-4}
        if what != "depths":
            given |= {"widths_m": widths, "width_errors_m": 3e-4, "width_m": 0.06}
        fit = stereo.fit_bias(distances, FX, BASELINE, **given, priors=priors)
        hits[0] += covers(fit.scale_error_interval, 1 / (1 + b) - 1)
        hits[1] += covers(fit.interval("disparity_offset_px"), o)
        _, low, high = fit.bias_m(0.45)
        hits[2] += low <= float(measure(np.array([0.45]), b, o)[0][0]) - 0.45 <= high
    assert about_95_percent(hits, SESSIONS), hits / SESSIONS


def test_fattening_alone_is_not_taken_for_an_offset():
    depths, widths = measure(NEAR, 0.0, 0.0, p=4.0)
    both = stereo.fit_bias(NEAR, FX, BASELINE, depths, 1e-4, widths, 1e-4, 0.06)
    assert covers(both.interval("disparity_offset_px"), 0.0)
    assert covers(both.interval("fattening_px"), 4.0)
    assert both.interval("fattening_px")[0] > 2.0
    alone = stereo.fit_bias(NEAR, FX, BASELINE, widths_m=widths, width_errors_m=1e-4, width_m=0.06)
    low, high = alone.interval("disparity_offset_px")
    assert high - low > 10  # widths alone cannot tell: the interval says so
    assert covers((low, high), 0.0)


def test_a_constant_is_fitted_from_five_distances_on():
    depths = measure(FAR + 0.004, 0.003, 0.1)[0]  # the camera's zero is 4 mm behind the tape's
    fit = stereo.fit_bias(FAR, FX, BASELINE, depths, 1e-6, tape_m=1e-6)
    assert fit.value("constant_m") == pytest.approx(0.004, abs=1e-4)
    assert "constant +4.00 mm" in str(fit)
    few = stereo.fit_bias(FAR[:4], FX, BASELINE, depths[:4], 1e-6)
    assert "constant_m" not in few.names
    assert "constant" not in str(few)
    with pytest.raises(ValueError, match=r"^name: got 'constant_m', want one of baseline_error"):
        few.interval("constant_m")


def test_one_distance_cannot_tell_scale_from_offset_and_says_so():
    fit = stereo.fit_bias([0.45], FX, BASELINE, [0.4522], 1e-4)
    assert "disparity_offset_px" not in fit.names
    assert fit.scale_error == pytest.approx(0.0022 / 0.45, rel=0.01)
    assert "one distance cannot tell a disparity offset from scale" in str(fit)
    assert float(fit.bias_m(0.45)[0]) == pytest.approx(0.0022, rel=0.01)


def test_depths_that_contradict_the_errors_widen_the_intervals():
    depths = measure(FAR, 0.0, 0.0)[0]
    depths[3] += 0.02
    fit = stereo.fit_bias(FAR, FX, BASELINE, depths, 1e-4)
    assert not fit.consistent
    assert "intervals are widened" in str(fit)
    assert covers(fit.scale_error_interval, 0.0)


# --- the block's face ---


@cache
def seen(distance_m, yaw_pitch_roll_deg=(0, 0, 0)):
    """The exact depth of the tabletop from a camera turned about the middle of the block's face."""
    turn = Rotation.from_euler("YXZ", yaw_pitch_roll_deg, degrees=True).as_matrix()
    middle = np.array([0, 0, distance_m])
    pose = make_transform(turn, middle - turn @ middle)
    return render(tabletop(distance_m), UNIT.depth, pose).depth_m


@pytest.mark.parametrize("distance_m", [0.30, 0.45, 0.60, 1.0])
def test_face_of_the_exact_block(distance_m):
    face = stereo.block_face(seen(distance_m), UNIT.depth)
    pixel_mm = 1e3 * distance_m / FX
    assert face.depth_m == pytest.approx(distance_m, abs=1e-6)
    assert face.tilt_deg == pytest.approx(0.0, abs=0.05)
    assert 1e3 * face.width_m == pytest.approx(60.0, abs=pixel_mm)
    middle = UNIT.depth.cx + FX * 0.03 / distance_m * np.array([-1, 1])
    np.testing.assert_allclose(face.edges_px, middle, atol=0.51)
    assert abs(face.fattening_px) < 0.5
    # Upright edges all round the same way: two of them, uniform over a pixel, and no better.
    assert face.width_error_m == pytest.approx(1e-3 * pixel_mm / math.sqrt(6), rel=0.05)
    assert math.isnan(face.width_std_m)


@pytest.mark.parametrize("turned", [(4, 0, 0), (-5, 2, 1.5), (0, -6, -2)])
@pytest.mark.parametrize("distance_m", [0.30, 0.45, 0.60])
def test_face_that_is_not_quite_parallel(distance_m, turned):
    face = stereo.block_face(seen(distance_m, turned), UNIT.depth)
    normal = Rotation.from_euler("YXZ", turned, degrees=True).as_matrix()[2]
    assert face.tilt_deg == pytest.approx(math.degrees(math.acos(normal[2])), abs=0.15)
    assert face.depth_m == pytest.approx(distance_m, abs=5e-4)  # its centre, not its tilt
    assert abs(face.width_m - 0.06) < 2.5 * face.width_error_m


def test_edges_that_lean_are_sub_pixel():
    """A roll of 3 degrees lets the pixel grid average: 0.1 mm instead of up to 1.4."""
    for z in (0.31, 0.37, 0.44, 0.52):
        face = stereo.block_face(seen(z, (0, 0, 3)), UNIT.depth)
        assert 1e3 * face.width_m == pytest.approx(60, abs=0.15)


def camera_like(rng, exact, sigma_d=0.08, push=0, n=40, holes=0.01):
    """A stack as a real camera's: noise by the law, edges pushed out, flying pixels, holes.

    Every near surface grows by `push` px to both sides, jittering by a pixel along the rows; then
    comes one flying pixel, and behind it, on the left, 6 px of shadow.
    """
    near = np.where(exact > 0, exact, np.inf)
    stack = np.empty((n, *exact.shape), np.uint16)
    jitter = 2 * gaussian_filter(rng.standard_normal((2, exact.shape[0])), (0, 4))
    for frame in stack:
        z = near.copy()
        reach = np.round(push + jitter + 0.4 * rng.standard_normal(jitter.shape)).astype(int)
        for shift in range(1, reach.max() + 1):
            right, left = (reach >= shift)[:, :, None]
            z[:, shift:] = np.minimum(z[:, shift:], np.where(right, near[:, :-shift], np.inf))
            z[:, :-shift] = np.minimum(z[:, :-shift], np.where(left, near[:, shift:], np.inf))
        step = np.diff(z, axis=1, prepend=z[:, :1])
        rows, columns = np.nonzero(step > 0.05)  # far to the right of near
        z[rows, columns] -= rng.uniform(0.2, 0.8, len(rows)) * step[rows, columns]
        rows, columns = np.nonzero(step < -0.05)  # far to the left of near
        for k in range(1, 7):
            z[rows, np.maximum(columns - k, 0)] = np.inf
        z[~np.isfinite(z)] = 0
        z += z**2 * sigma_d / FB * rng.standard_normal(z.shape)
        z[rng.random(z.shape) < holes] = 0
        frame[:] = np.clip(np.round(z / 1e-4), 0, 65535)
    return stack


MIDDLE = replace(UNIT.depth, width=424, height=240, cx=UNIT.depth.cx - 212, cy=UNIT.depth.cy - 120)


@pytest.fixture(scope="module")
def noisy_faces():
    rng, faces = np.random.default_rng(40), {}
    for z in NEAR:
        stack = camera_like(rng, seen(z)[120:360, 212:636], push=3, n=30)
        faces[z] = stereo.block_face(stack, MIDDLE, 1e-4)
    return faces


def test_face_in_camera_like_frames(noisy_faces):
    for z, face in noisy_faces.items():
        assert face.depth_m == pytest.approx(z, abs=4 * face.depth_error_m + 1e-5)
        assert face.tilt_deg < 0.6
        want = 1e3 * z**2 * 0.08 / FB
        assert face.depth_std_mm == pytest.approx(want, abs=4 * face.depth_std_error_mm)
        assert face.fattening_px == pytest.approx(3.0, abs=0.6)
        assert abs(face.fattening_px - 3.0) < 3 * face.fattening_error_px
        assert face.width_m - 0.06 == pytest.approx(2 * face.fattening_px * z / FX, rel=0.05)
        assert face.stats.invalid_fraction == pytest.approx(0.01, abs=0.005)
        u, _, width, height = face.window
        assert (width, height) == (40, 40) or z > 0.5
        assert abs(u + width / 2 - MIDDLE.cx) < 4


def test_causes_that_both_stand_out_are_not_called_hard_to_tell_apart():
    """On walls from 0.3 to 2 m, although their estimates lean on each other; near by they are."""
    z = np.array([0.3, 0.45, 0.6, 1.0, 1.5, 2.0])
    read = z / (1 + 0.008 - 0.2 * z / FB)
    far, close = (
        stereo.fit_bias(z[:n], FX, BASELINE, read[:n], 2e-4 + 8e-4 * z[:n] ** 2, tape_m=1e-6)
        for n in (6, 3)
    )
    assert abs(far.covariance[0, 1]) > 0.9 * far.sigma("baseline_error") * far.sigma(
        "disparity_offset_px"
    )
    assert not covers(far.scale_error_interval, 0.0)
    assert "hardly" not in str(far)
    assert "hardly" in str(close)


def test_block_elsewhere_is_found_near_a_pixel_and_its_width_need_not_be_known():
    moved = Intrinsics(848, 480, FX, FX, UNIT.depth.cx - 150, UNIT.depth.cy + 40)
    image = render(tabletop(0.45), moved).depth_m
    face = stereo.block_face(image, moved, near=(moved.cx + 5, moved.cy - 8), width_m=None)
    assert face.depth_m == pytest.approx(0.45, abs=1e-6)
    assert 1e3 * face.width_m == pytest.approx(60, abs=1.1)
    assert math.isnan(face.fattening_px)


def test_a_camera_s_frames_bring_their_unit_and_intrinsics():
    counts = np.round(seen(0.45) / 1e-4).astype(np.uint16)
    frames = Frames(Frame(counts, None, 1e-4, i / 30, i, UNIT.depth) for i in range(3))
    face = stereo.block_face(frames)
    again = stereo.block_face(np.stack([counts] * 3), UNIT.depth, 1e-4)
    assert (face.width_m, face.stats.pixel_std_m) == (again.width_m, again.stats.pixel_std_m)
    assert stereo.window_stats(frames, face.window).depth_m == face.stats.depth_m
    lost = stereo.block_face([*frames, replace(frames[0], depth=0 * counts)])  # a frame without
    assert (lost.width_std_m, lost.width_std_error_m) == (face.width_std_m, face.width_std_error_m)
    with pytest.raises(ValueError, match=r"^depth: got 0 frames"):
        stereo.window_stats(Frames(), (0, 0, 5, 5))


# --- what is refused ---


def window(**changes):
    return stereo.window_stats(**{"depth": np.zeros((2, 30, 30)), "window": (0, 0, 5, 5)} | changes)


def noise_fit(**changes):
    given = {"distances_m": [0.3, 0.45], "stds_m": [1e-3, 1e-3], "dof": 10}
    return stereo.fit_noise(**given | changes, fx=FX, baseline_m=BASELINE)


def bias_fit(**changes):
    given = {"distances_m": NEAR, "depths_m": NEAR, "depth_errors_m": 1e-3}
    return stereo.fit_bias(**given | changes, fx=FX, baseline_m=BASELINE)


def width_fit(**changes):
    given = {"widths_m": NEAR, "width_errors_m": 1e-3, "width_m": 0.06}
    return stereo.fit_bias(NEAR, FX, BASELINE, **given | changes)


def face(**changes):
    wall = np.full((3, 480, 848), 4500, np.uint16)
    given = {"depth": wall, "intrinsics": UNIT.depth, "depth_scale_m": 1e-4}
    return stereo.block_face(**given | changes)


NO_BASELINE = (None, 0.0, -0.05, math.nan, "50 mm")
NEEDS_BASELINE = (
    lambda baseline_m: stereo.depth_from_disparity([10.0], FX, baseline_m),
    lambda baseline_m: stereo.depth_noise([1.0], FX, baseline_m, 0.08),
    lambda baseline_m: stereo.fit_noise(NEAR, NEAR**2 * 1e-3, 100, FX, baseline_m).sigma_d_px,
    lambda baseline_m: stereo.fit_bias(NEAR, FX, baseline_m, NEAR, 1e-4),
)
OUTSIDE = ((-1, 0, 5, 5), (26, 0, 5, 5), (0, 26, 5, 5), (0, 0, 0, 5), (0, 0, 5), (0.5, 0, 5, 5))
NO_DISTANCES = ([0.0, 0.45], [-0.1, 0.45], [], [0.3, np.nan])

test_what_cannot_be_is_refused = refusals(
    *((r"^baseline_m: got", lambda f=f, b=b: f(b)) for f in NEEDS_BASELINE for b in NO_BASELINE),
    ("^depth_m", lambda: stereo.robust_depth(np.zeros((2, 3, 3)), 1, 1)),
    ("^u", lambda: stereo.robust_depth(np.zeros((3, 3)), math.nan, 1)),
    ("^v", lambda: stereo.robust_depth(np.zeros((3, 3)), 1, math.inf)),
    ("^half", lambda: stereo.robust_depth(np.zeros((3, 3)), 1, 1, -1)),
    ("^min_valid", lambda: stereo.robust_depth(np.zeros((3, 3)), 1, 1, 2, 0)),
    *named(window, depth=[np.zeros((0, 30, 30)), np.zeros(30)]),
    ("^depth: got", lambda: window(depth=np.zeros((2, 30, 30), np.int32), depth_scale_m=1e-3)),
    *each("^depth_scale_m: got", window, "depth", np.zeros((2, 30, 30), np.uint16)),
    *named(window, depth_scale_m=[-1.0], window=[*OUTSIDE, None]),
    ("^series_m: got", lambda: stereo.averaging_curve(np.zeros(5))),
    ("^series_m: got", lambda: stereo.averaging_curve(np.zeros((9, 4)))),
    ("^series_m: got", lambda: stereo.averaging_curve(1.0)),
    ("^series_m: no pixel", lambda: stereo.averaging_curve(np.full((10, 4, 4), np.nan))),
    *named(noise_fit, distances_m=[*NO_DISTANCES, "near"]),
    *named(noise_fit, stds_m=[[1e-3], [1e-3, -1e-3], [0.0, np.nan]], dof=[0, [10, 10, 10]]),
    *named(bias_fit, distances_m=[-NEAR], depths_m=[[0.3, 0.45], [0.3, 0.45, np.nan]]),
    *named(bias_fit, depth_errors_m=[None, 0.0]),
    *named(width_fit, width_errors_m=[[1e-3]], width_m=[None]),
    *each("^depths_m, widths_m: got", bias_fit, "depths_m", None),
    *each("^depth: no valid pixel near", face, "depth", np.zeros((3, 480, 848), np.uint16)),
    *each("^depth: no block's face", face, "depth", np.full((3, 480, 848), 5000, np.uint16)),
    *each("^depth: got 0 frames", face, "depth", np.zeros((0, 480, 848), np.uint16)),
    *each("^depth: got", face, "depth", np.zeros((3, 48, 84), np.uint16)),
    *named(face, depth_scale_m=[None], intrinsics=[None], width_m=[-1.0], near=[(5000, 5000)]),
)
