"""Rows D1 to D16 of data/claims.csv: stereo depth and its noise.

What simulated depth images show of D7 and D9 (room light steepens the curve, nothing is right under
the minimum range) is proved in test_active_stereo.py; what averaging does (D8), the errors of a
window's std (D13) and that a fit tells scale from offset (D14) in test_stereo.py.
"""

import math

import numpy as np
import pytest
from lesson_claims import ROWS, claim, nominal_fx_px

from coursekit import plots, stereo
from coursekit.geometry import deproject
from coursekit.results import read_json
from coursekit.specifications import DATA, device

FX, BASELINE, SIGMA_D = 447.0, 0.050, 0.08
FB = FX * BASELINE
K = np.array([[FX, 0, 424], [0, FX, 240], [0, 0, 1]])
D435, D405 = device("D435"), device("D405")
STUDIO = np.array([0.30, 0.45, 0.60])
SERIES = {s["id"]: s for s in read_json(DATA / "published_depth_noise.json")["series"]}


def noise_mm(z, fx: float = FX, baseline: float = BASELINE) -> np.ndarray:
    return 1e3 * stereo.depth_noise(z, fx, baseline, SIGMA_D)


def exponent(z, values) -> float:
    return float(np.polyfit(np.log(z), np.log(values), 1)[0])


@claim("D1", "right")
def test_d1_focal_length_times_baseline() -> None:
    ROWS["D1"].says(f"{FB:.2f} px.m")
    assert float(stereo.depth_from_disparity(FB, FX, BASELINE)) == pytest.approx(1.0)


@claim("D2", "right")
def test_d2_noise_at_three_distances() -> None:
    near, one, two = noise_mm([0.4, 1.0, 2.0])
    ROWS["D2"].says(f"{near:.3f}; {one:.3f}; {two:.3f} mm", f"{near:.1f}; {one:.1f}; {two:.0f} mm")
    d = FB / 2.0 + SIGMA_D * np.random.default_rng(0).standard_normal(200_000)
    spread = 1e3 * stereo.depth_from_disparity(d, FX, BASELINE).std()
    assert spread == pytest.approx(two, rel=0.01)  # the law is a first order; it holds here


@claim("D3", "right")
def test_d3_disparities() -> None:
    one, two = FB / np.array([1.0, 2.0])
    assert float(stereo.depth_from_disparity(two, FX, BASELINE)) == pytest.approx(2.0)
    ROWS["D3"].says(f"{one:.2f}; {two:.3f} px")


@claim("D4", "right")
def test_d4_twice_as_far_is_four_times_the_noise() -> None:
    near, far = noise_mm([0.4, 0.8])
    assert far / near == pytest.approx(4)
    ROWS["D4"].says("4x", f"{4 * 0.6:.1f} mm", f"{far:.2f} mm", f"{near:.3f}")


@claim("D5", "right")
def test_d5_the_slope_of_a_reciprocal() -> None:
    z, h = np.array([0.3, 1.0, 2.0]), 1e-5
    d = FB / z
    numerical = (FB / (d + h) - FB / (d - h)) / (2 * h)
    np.testing.assert_allclose(numerical, -(z**2) / FB, rtol=1e-7)
    np.testing.assert_allclose(stereo.depth_slope(z, FX, BASELINE), numerical, rtol=1e-7)
    ROWS["D5"].says("dZ/dd = -f B / d^2 = -Z^2 / (f B)")


@claim("D6", "right")
def test_d6_a_baseline_error_is_a_depth_error() -> None:
    z = np.array([0.3, 1.0, 2.0])
    believed = stereo.depth_from_disparity(FB / z, FX, 1.10 * BASELINE)
    np.testing.assert_allclose(believed / z, 1.10)
    ROWS["D6"].says("10 %")


# --- D7: the matcher's noise is not one number ---


@claim("D7", "imprecise")
def test_d7_the_disparity_noise_is_not_constant() -> None:
    mapping, walls = SERIES["d435_mapping_model"], SERIES["d435_window_mean"]
    a, b, c = mapping["coefficients"]

    def model_mm(z: np.ndarray) -> np.ndarray:
        return 1e3 * (a + b * (z - c) ** 2)

    z = np.linspace(0.3, 3.0, 271)
    sigma_d = model_mm(z) / 1e3 * mapping["fx_baseline_px_m"] / z**2
    least = int(np.argmin(sigma_d))
    assert sigma_d[0] > 3 * sigma_d[least]  # constant it is not
    ROWS["D7"].says(f"{sigma_d[least]:.3f}-{sigma_d[0]:.2f} px", f"from 0.3 to {z[least]:.1f} m")
    ROWS["D7"].says(f"{sigma_d[-1]:.3f} px at 3 m")

    z = np.array(walls["distances_m"])
    means = np.array(walls["std_mm"])
    ROWS["D7"].says(f"exponent {exponent(z, means):.1f}")
    quieter = model_mm(z) / means
    by_law = 1e3 * z**2 * SIGMA_D / mapping["fx_baseline_px_m"] / means
    ROWS["D7"].says(f"{quieter.min():.0f}-{quieter.max():.0f} times quieter than that model's")
    ROWS["D7"].says(f"{by_law.min():.0f}-{by_law.max():.0f} times quieter than 0.08 px")

    rounded = np.sqrt(stereo.rounded_variance(noise_mm(STUDIO), 1.0))
    ROWS["D7"].says(f"rounding alone can give {exponent(STUDIO, rounded):.1f}")

    ROWS["D7"].says("ambient light steepens")


# --- averaging ---


def gain_of_hundred(rho: float) -> float:
    """std(one) / std(mean of 100) for noise whose correlation falls as rho^k, exactly."""
    lags = np.arange(1, 100)
    return math.sqrt(100 / (1 + 2 * ((1 - lags / 100) * rho**lags).sum()))


@claim("D8", "imprecise")
def test_d8_what_a_hundred_frames_buy() -> None:
    assert gain_of_hundred(0.0) == pytest.approx(10)
    ROWS["D8"].says(f"AR(1) rho 0.5 gives {gain_of_hundred(0.5):.1f}x")
    ROWS["D8"].says(f"{gain_of_hundred(0.0):.0f}x")
    ROWS["D8"].says(f"gained {SERIES['d435_window_mean']['gain_of_100_frames']}x")
    ROWS["D8"].says("does not average at all")


@claim("D9", "right")
def test_d9_minimum_range() -> None:
    theory = FB / 126
    ROWS["D9"].says(f"{theory:.3f} m", "0.2-0.3 m")
    at_1280 = nominal_fx_px("D435", 1280) * BASELINE / 126
    sheets = {"195 mm at 848x480": theory, "280 mm at 1280x720": at_1280}
    ROWS["D9"].says(*sheets)
    for text, least in sheets.items():  # a little above what the search allows
        assert least < int(text[:3]) / 1e3 < 1.2 * least


# --- D10: three ways to make Z ---


def time_of_flight(z: float, photons: float, rng: np.random.Generator) -> float:
    """Std of depth from four phase images of light that is modulated at 100 MHz."""
    light, wave = 299792458.0, 2 * math.pi * 100e6
    phase = 2 * wave * z / light
    steps = np.arange(4) * math.pi / 2
    seen = rng.poisson(photons * (1 + 0.5 * np.cos(phase - steps)), (20_000, 4))
    measured = np.arctan2(seen[:, 1] - seen[:, 3], seen[:, 0] - seen[:, 2])
    off = np.angle(np.exp(1j * (measured - phase)))
    return float(off.std() * light / (2 * wave))


@claim("D10", "right")
def test_d10_how_three_technologies_grow() -> None:
    rng, z = np.random.default_rng(10), np.array([0.5, 1.0, 2.0])
    # triangulation, with a second eye or with a projector that knows its pattern: one equation
    for fb in (FB, 580 * 0.075):
        stds = [(fb / (fb / x + SIGMA_D * rng.standard_normal(40_000))).std() for x in z]
        assert exponent(z, stds) == pytest.approx(2, abs=0.05)
    flat = [time_of_flight(x, 1e5, rng) for x in z]  # as bright at all distances
    fading = [time_of_flight(x, 1e5 / x**2, rng) for x in z]  # returns fall with the square
    assert exponent(z, flat) == pytest.approx(0, abs=0.05)
    assert exponent(z, fading) == pytest.approx(1, abs=0.05)
    axes = plots.depth_noise.technologies(FX, BASELINE, SIGMA_D).axes[0]
    slopes = [exponent(*line.get_data()) for line in axes.lines]
    np.testing.assert_allclose(slopes, [2, 2, 0], atol=1e-9)
    ROWS["D10"].says("side by side")


# --- D11: the std of a width is not that of depth ---


def width_std_mm(z: float, middle_m: float, own_depths: bool, frames: int = 40_000, n: int = 1):
    """Std of the width of a 60 mm block between fixed pixels; n pixels' median at each end."""
    rng = np.random.default_rng(11)
    ends = K[0, 2] + FX * (middle_m + np.array([-0.03, 0.03])) / z
    noise = float(stereo.depth_noise(z, FX, BASELINE, SIGMA_D))
    depths = z + noise * np.median(rng.standard_normal((2, frames, n)), axis=2)
    if not own_depths:
        depths[1] = depths[0]
    a, b = (deproject(np.array([u, 240.0]), d, K) for u, d in zip(ends, depths, strict=True))
    return 1e3 * np.linalg.norm(b - a, axis=1).std()


@claim("D11", "wrong")
def test_d11_the_width_does_not_follow_the_depths_curve() -> None:
    one, own = (width_std_mm(0.4, 0.0, own_depths) for own_depths in (False, True))
    median = width_std_mm(0.4, 0.0, True, frames=20_000, n=25)
    depth = float(noise_mm(0.4))
    tangent = 0.03 / 0.4  # of each end's angle off the axis
    together, apart = 2 * tangent * depth, math.sqrt(2) * tangent * depth
    assert one == pytest.approx(together, rel=0.03)
    assert own == pytest.approx(apart, rel=0.03)
    ROWS["D11"].says(f"{depth:.3f} mm", f"{together:.3f} mm of width (7 times less)")
    ROWS["D11"].says(f"{apart:.3f} mm (9 times less)", f"{median:.3f} mm (38 times less)")
    assert [round(depth / s) for s in (one, own)] == [7, 9]
    assert depth / median == pytest.approx(38, abs=1)

    z = np.array([0.3, 0.4, 0.6])
    centred = [exponent(z, [width_std_mm(x, 0.0, own) for x in z]) for own in (False, True)]
    assert centred[0] == pytest.approx(1, abs=0.02)  # the curve's is 2
    assert 1 < centred[1] < 1.2  # the ends' difference in Z adds to the length, in second order
    aside = [width_std_mm(x, 0.7 * x, True) for x in z]  # at a constant angle off the axis
    assert exponent(z, aside) == pytest.approx(2, abs=0.1)
    ROWS["D11"].says("about proportional to Z", "brings Z^2 back")

    pixel_mm = 1e3 * 0.4 / FX
    jitter_mm = 0.1 * math.sqrt(2) * pixel_mm
    ROWS["D11"].says(f"add {jitter_mm:.2f} mm", f"is {pixel_mm:.1f} mm at 0.4 m")


# --- D12 to D16 ---


def plain_median(depth: np.ndarray, u, v) -> float:
    """Taken at its word: slices of 5 x 5 pixels, zeros dropped, the median; 0 if none is left."""
    values = depth[v - 2 : v + 3, u - 2 : u + 3].ravel()
    return float(np.median(values[values > 0])) if (values > 0).any() else 0.0


@claim("D12", "wrong")
def test_d12_a_plain_window_fails_at_borders_floats_and_single_pixels() -> None:
    image = np.full((480, 848), 0.5)
    for u, v in ((1, 240), (424, 1)):  # left, top
        assert plain_median(image, u, v) == 0.0
        assert stereo.robust_depth(image, u, v) == 0.5
    with pytest.raises(TypeError, match="slice indices must be integers"):
        plain_median(image, 423.6, 239.8)
    assert stereo.robust_depth(image, 423.6, 239.8) == 0.5
    lonely = np.zeros((480, 848))
    lonely[240, 424] = 3.0  # the only valid pixel, and a wrong one
    assert plain_median(lonely, 424, 240) == 3.0
    assert math.isnan(stereo.robust_depth(lonely, 424, 240))
    ROWS["D12"].says("returned as depth 0", "float pixel coordinates raise", "one valid pixel")


@claim("D13", "imprecise")
def test_d13_degrees_of_freedom_and_standard_errors() -> None:
    rng, n = np.random.default_rng(13), 10
    samples = rng.standard_normal((200_000, n))
    assert samples.var(axis=1).mean() == pytest.approx(1 - 1 / n, rel=0.01)  # ddof = 0: too small
    assert samples.var(axis=1, ddof=1).mean() == pytest.approx(1, rel=0.01)
    bias_error, std_error = 1 / math.sqrt(n), 1 / math.sqrt(2 * (n - 1))
    assert samples.mean(axis=1).std() == pytest.approx(bias_error, rel=0.01)
    assert samples.std(axis=1, ddof=1).std() == pytest.approx(std_error, rel=0.03)
    ROWS["D13"].says("ddof = 1", "standard error of bias and of std")


@claim("D14", "right")
def test_d14_exponents_tell_causes_apart() -> None:
    z = np.array([0.3, 0.45, 0.6, 1.0, 1.5, 2.0])
    scale, offset = 0.01, 0.15
    by_scale = stereo.depth_from_disparity(FB / z, FX, BASELINE * (1 + scale)) - z
    by_offset = stereo.depth_from_disparity(FB / z - offset, FX, BASELINE) - z
    assert exponent(z, noise_mm(z)) == pytest.approx(2)
    assert exponent(z, by_scale) == pytest.approx(1)
    assert exponent(z, by_offset) == pytest.approx(2, abs=0.02)  # as the noise: the exponent alone
    ROWS["D14"].says("bias ~ Z^2", "regression")


@claim("D15", "imprecise")
def test_d15_the_d405_is_of_another_class() -> None:
    baseline = D405.nominal.baseline_m
    assert (baseline, D405.projector, D435.projector) == (0.018, False, True)
    ratio = float(noise_mm(0.4, FX, baseline) / noise_mm(0.4))
    own = float(noise_mm(0.4, D405.unit.depth.fx, baseline))
    assert ratio > 2  # not the noise of the class described
    ROWS["D15"].says(f"own {D405.unit.depth.fx:.0f} px")
    ROWS["D15"].says("18 mm baseline and no projector", f"{ratio:.1f}x")
    ROWS["D15"].says(f"{float(noise_mm(0.4, FX, baseline)):.2f} mm at 0.4 m", f"{own:.2f} with")


@claim("D16", "imprecise")
def test_d16_two_millimetres_over_a_tabletop() -> None:
    z = np.array([0.4, 0.6])
    wide, narrow = noise_mm(z), noise_mm(z, FX, D405.nominal.baseline_m)
    ROWS["D16"].says("< 2 mm")
    assert wide.max() < 2  # as the lesson says, with the baseline that it assumes
    assert narrow.max() > 2  # and not with the camera that the arm ships with
    ROWS["D16"].says(f"{wide[0]:.2f}-{wide[1]:.2f} mm", f"{narrow[0]:.1f}-{narrow[1]:.1f} mm")
