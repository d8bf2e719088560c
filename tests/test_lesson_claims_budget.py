"""Rows B1 to B10 of data/claims.csv: the error budget.

By NumPy and SciPy alone: `coursekit.budget` has tests of its own, and these figures are for both.
"""

import csv
import io
import math

import numpy as np
import pytest
from lesson_claims import ROWS, claim
from scipy import stats

from coursekit import stereo
from coursekit.arm import ArmErrors, SimulatedArm, widowx
from coursekit.geometry import deproject

K = np.array([[447.0, 0, 424], [0, 447, 240], [0, 0, 1]])
AT = 0.45  # m
# Bias rows, mm at the object, least and most: depth, hand-eye rotation and translation, FK
BIAS_MM = np.array([[2.0, 6.0], [0.0, 3.9], [1.0, 2.0], [2.0, 4.0]])
TOLERANCE_MM = 7.0


@claim("B1", "right")
def test_b1_the_price_of_a_pixel() -> None:
    pixels = [[500.0, 240.0], [501.0, 240.0]]
    prices = [1e3 * np.linalg.norm(np.diff(deproject(pixels, z, K), axis=0)) for z in (AT, 2 * AT)]
    ROWS["B1"].says(f"{prices[0]:.3f}; {prices[1]:.3f} mm", f"{prices[0]:.1f}; {prices[1]:.1f} mm")


def leak(u: float, v: float) -> float:
    """Metres sideways for a metre of depth error, at a pixel."""
    nearer, farther = deproject([u, v], [1.0, 2.0], K)
    return float(np.linalg.norm((farther - nearer)[:2]))


@claim("B2", "right")
def test_b2_the_lateral_leak() -> None:
    edge, corner = leak(0, 240), leak(0, 0)
    assert edge == pytest.approx(leak(848, 240))
    ROWS["B2"].says(f"{edge:.3f} at the left/right edge", f"{edge:.2f}", f"{corner:.2f} in the")
    ROWS["B2"].says(f"{5 * edge:.1f} and {5 * corner:.1f} mm sideways")


@claim("B3", "right")
def test_b3_a_rotation_and_its_lever() -> None:
    arc = 1e3 * AT * math.radians(0.5)
    chord = 1e3 * AT * 2 * math.sin(math.radians(0.25))
    ROWS["B3"].says(f"{arc:.2f} mm", f"{chord:.2f} mm", f"{arc:.1f} mm")


@claim("B4", "imprecise")
def test_b4_the_noise_rows() -> None:
    together = math.hypot(1.0, 0.7)
    ROWS["B4"].says("1.3 mm", f"= {together:.2f} mm")
    assert round(together, 1) == 1.2  # not 1.3
    rng = np.random.default_rng(4)
    as_bounds = np.std(rng.uniform(-1, 1, (400_000, 2)) @ [1.0, 0.7])
    assert as_bounds == pytest.approx(together / math.sqrt(3), rel=0.01)
    ROWS["B4"].says(f"{together / math.sqrt(3):.2f} mm. +-1 px")
    depth = 1e3 * float(stereo.depth_noise(AT, 447.0, 0.05, 0.08))
    pixel = 1e3 * AT / 447.0
    in_all = math.sqrt(2 * pixel**2 + depth**2)
    ROWS["B4"].says(f"{in_all:.2f} mm in all", f"{depth:.3f} mm")


@claim("B5", "imprecise")
def test_b5_the_bias_rows() -> None:
    low, high = BIAS_MM.sum(axis=0)
    ROWS["B5"].says("row ranges " + ", ".join(f"{a:g}-{b:g}" for a, b in BIAS_MM))
    ROWS["B5"].says("8-12 mm", f"add to {low:.1f}-{high:.1f} mm")
    ROWS["B5"].says(f"midpoint {(low + high) / 2:.2f}")
    assert low < 8  # the lesson's range is neither the least
    assert high > 12  # nor the most
    square = np.sqrt((BIAS_MM**2).sum(axis=0))
    ROWS["B5"].says(f"in quadrature {square[0]:.1f}-{square[1]:.1f}")
    ROWS["B5"].says(f"held at 3.9 the sum is {low + 3.9:.1f}-{high:.1f}")
    rng, n = np.random.default_rng(5), 400_000
    direction = rng.standard_normal((n, 4, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    size = rng.uniform(*BIAS_MM.T, (n, 4))
    miss = (size[..., None] * direction).sum(axis=1)
    norm = np.linalg.norm(miss, axis=1)
    ROWS["B5"].says(f"mean {norm.mean():.1f} and 95th percentile {np.quantile(norm, 0.95):.1f}")
    over, closing = (100 * np.mean(x > TOLERANCE_MM) for x in (norm, np.abs(miss[:, 0])))
    ROWS["B5"].says(f"{over:.0f} % exceed 7 mm in norm and {closing:.1f} % along the closing axis")
    # the mean square by hand: independent directions, so squares add
    squares = (BIAS_MM[:, 0] ** 2 + BIAS_MM.prod(axis=1) + BIAS_MM[:, 1] ** 2) / 3
    assert (norm**2).mean() == pytest.approx(squares.sum(), rel=0.01)


@claim("B6", "imprecise")
def test_b6_what_averaging_does_not_remove() -> None:
    """A detector that is off by 0.6 px in this view each time, and by 0.8 px anew in each frame."""
    repeats, anew = 0.6, 0.8
    assert math.hypot(repeats, anew) == pytest.approx(1.0)  # the row's 1 px
    assert 1 / math.hypot(repeats, anew / 10) < 2  # the gain of 100 frames: not 10
    ROWS["B6"].says("10x", "see D8", "a part that repeats")


# How far one finger goes, mm. From github.com/TrossenRobotics: docs/specifications/wxai.rst of
# trossen_arm, and urdf/generated/wxai/wxai_follower.urdf of trossen_arm_description.
FINGER_MM = {"specification": 40, "description": 44}


@claim("B7", "wrong")
def test_b7_the_grippers_opening() -> None:
    cube, in_the_lesson = 25, 40
    ROWS["B7"].says(f"(40 - 25) / 2 = {(in_the_lesson - cube) / 2} mm", "+-7 mm")
    assert FINGER_MM["specification"] == in_the_lesson  # which is the travel of one of the two
    openings = [2 * travel for travel in FINGER_MM.values()]
    left = [(opening - cube) / 2 for opening in openings]
    assert min(left) > 3 * TOLERANCE_MM
    ROWS["B7"].says(f"opens {openings[0]}-{openings[1]} mm", f"+-{left[0]} to +-{left[1]} mm")
    assert (openings[0] - 66) / 2 == TOLERANCE_MM
    ROWS["B7"].says("a 66 mm object")


def power(n: int, alike: bool = False) -> float:
    """Of Hotelling's test at level 0.01 for 3 mm of bias in 2 mm of noise an axis, n trials.

    alike: of the one that knows that the axes scatter alike, n |mean|^2 / 3 over their variance.
    """
    free = 3 * (n - 1) if alike else n - 3
    return float(stats.ncf.sf(stats.f.isf(0.01, 3, free), 3, free, n * (3.0 / 2.0) ** 2))


@claim("B8", "right")
def test_b8_calibration_perception_and_the_arm() -> None:
    """Scatter is not taken for a constant, nor a constant for scatter: test_attribution.py."""
    enough = next(n for n in range(4, 40) if power(n) >= 0.8)
    ROWS["B8"].says(f"in {100 * power(10):.0f} % of sets of 10 trials")
    ROWS["B8"].says(f"{100 * power(20):.0f} % of 20", f"{enough} for 80 %")
    ROWS["B8"].says(f"alike in {100 * power(10, alike=True):.0f} % of 10")

    # An arm whose joints are off: the same miss at the same pose, another one at another pose.
    arm, misses = SimulatedArm(2, ArmErrors()), []
    for target in np.tile(widowx().random(np.random.default_rng(0), 12), (5, 1)):
        computed = widowx().forward(arm.move(target))
        misses.append(1e3 * (arm.true_pose() - computed)[:3, 3])
    misses = np.reshape(misses, (5, 12, 3))
    within = np.sqrt(misses.var(axis=0, ddof=1).mean())
    between = np.sqrt(misses.mean(axis=0).var(axis=0, ddof=1).mean())
    assert within < 0.3 * between  # perception would scatter at one pose, too
    size = np.sqrt((misses**2).sum(axis=-1).mean())
    assert np.linalg.norm(misses.mean(axis=(0, 1))) < 0.8 * size  # calibration: one direction
    ROWS["B8"].says("looks like neither")


@claim("B9", "right")
def test_b9_the_table_is_a_ledgers_row() -> None:
    """Six terms in one line of CSV, and the sums of B4 and B5 from what is read back."""
    terms = {"pixel_noise": 1.0, "depth_noise": 0.7}
    for name, (low, high) in zip(("depth", "rotation", "translation", "fk"), BIAS_MM, strict=True):
        terms |= {f"{name}_bias_low": low, f"{name}_bias_high": high}
    file = io.StringIO(newline="")
    csv.writer(file).writerows([terms.keys(), terms.values()])
    file.seek(0)
    (row,) = csv.DictReader(file)
    noise, low, high = (
        [float(value) for key, value in row.items() if key.endswith(end)]
        for end in ("_noise", "_low", "_high")
    )
    assert math.hypot(*noise) == pytest.approx(1.22, abs=0.005)
    assert (sum(low), sum(high)) == pytest.approx((5.0, 15.9))
    ROWS["B9"].says("CSV")


@claim("B10", "imprecise")
def test_b10_what_a_depth_bias_does_to_the_point() -> None:
    ends = [deproject([u, v], [AT, AT + 0.005], K) for u, v in ((424, 240), (0, 240), (0, 0))]
    axis, edge, corner = (1e3 * np.linalg.norm(far - near) for near, far in ends)
    assert edge > 6 > axis  # 2-6 mm does not hold all over the image
    ROWS["B10"].says(f"{axis:.1f} mm on the axis", f"{edge:.1f} mm at the left", "2-6 mm")
    ROWS["B10"].says(f"{corner:.1f} mm in the corner")
    assert edge == pytest.approx(5 * math.hypot(1, leak(0, 240)))
