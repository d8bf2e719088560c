"""Lesson 02: its exercises name every mistake, and its checkpoints' numbers and texts are right."""

import math
import re
from statistics import median

import numpy as np
import pytest

from coursekit import stereo
from coursekit.lessons import CHECKPOINTS
from coursekit.lessons.depth_noise import DEPTH_NOISE, IMAGE, ROBUST_DEPTH
from tools import build_notebooks

# --- depth_noise ---


def test_the_row_of_an_array_that_is_furthest_off_is_shown() -> None:
    def farthest_wrong(Z, fx, baseline, sigma_d):
        return np.where(np.asarray(Z) == 0.45, 9.0, DEPTH_NOISE.model()(Z, fx, baseline, sigma_d))

    verdict = DEPTH_NOISE.judge(farthest_wrong)
    assert verdict.headline == "depth_noise: not right yet. 3 of 5 cases agree."
    case = "fx = 431.1 px, baseline = 0.0502 m, sigma_d = 0.08 px, Z = 0.45 m"
    assert case in verdict.lines[0]
    assert "xpected 0.0007485" in verdict.lines[0]
    assert verdict.lines[0].endswith("yours 9 m.")


@pytest.mark.parametrize("half", [0.5, 1.0])
def test_a_central_difference_is_shown_with_the_digits_in_which_it_differs(half: float) -> None:
    def central(Z, fx, baseline, sigma_d):
        d, step = fx * baseline / np.asarray(Z), half * sigma_d
        return fx * baseline * (1 / (d - step) - 1 / (d + step)) / (2 * half)

    verdict = DEPTH_NOISE.judge(central)
    assert verdict.named == "difference"
    want, got = re.search(r"xpected ([\d., ]+), yours ([\d., ]+) m", verdict.lines[0]).groups()
    assert want != got


# --- robust_depth ---


def pixel_by_pixel(depth_m, u, v, half=2, min_valid=5):
    height, width = depth_m.shape
    found = [
        depth_m[row, column]
        for row in range(height)
        for column in range(width)
        if max(abs(row - round(v)), abs(column - round(u))) <= half
        and 0 < depth_m[row, column] < math.inf
    ]
    return median(found) if len(found) >= min_valid else math.nan


@pytest.mark.parametrize("model", [ROBUST_DEPTH.model(), stereo.robust_depth])
def test_robust_depth_is_an_independent_ones_everywhere_in_and_around_the_image(model) -> None:
    for u in range(-4, 20):
        for v in range(-4, 16):
            for half, min_valid in ((0, 1), (1, 5), (2, 5), (3, 12)):
                args = (IMAGE, u, v, half, min_valid)
                np.testing.assert_equal(model(*args), pixel_by_pixel(*args))


def test_windows_are_described_in_words() -> None:
    descriptions = [ROBUST_DEPTH.describe(args) for args in ROBUST_DEPTH.cases]
    assert descriptions[0] == "a 3x3 window about (u, v) = (4, 1) px, min_valid = 1 (9 valid)"
    assert (
        "a 5x5 window about (u, v) = (0, 6) px, cut off at the left border (11 valid, 4 zero)"
        in descriptions
    )
    assert any("cut off at the bottom and right border" in d for d in descriptions)
    assert any(d.endswith("all of it off the image") for d in descriptions)
    assert any("3 infinite" in d for d in descriptions)
    assert len(set(descriptions)) == len(descriptions)


def test_an_example_of_the_verdict() -> None:
    wraps = next(m for m in ROBUST_DEPTH.mistakes if m.name == "negative_index")
    verdict = ROBUST_DEPTH.judge(ROBUST_DEPTH.model(wraps))
    depths = [z for z in IMAGE[4:9, :3].ravel() if z]
    assert "cut off at the left border" in verdict.lines[0]
    assert f"xpected {median(depths):.5f}, yours NaN m." in verdict.lines[0]


right = ROBUST_DEPTH.model()


@pytest.mark.parametrize(
    ("function", "kind", "says"),
    [
        (lambda *args: None if np.isnan(right(*args)) else right(*args), "wrong", "`return`"),
        (lambda *args: [right(*args)], "wrong", "shape (1,), and one number is wanted"),
        (lambda *args: np.array(right(*args)), "right", "All 22 cases agree"),
    ],
)
def test_odd_functions_of_one_number(function, kind: str, says: str) -> None:
    verdict = ROBUST_DEPTH.judge(function)
    assert verdict.kind == kind
    assert says in repr(verdict)


# --- the notebook ---


def test_no_printed_line_is_longer_than_a_page() -> None:
    """JupyterLab breaks lines of more than 107 characters in mid-word."""
    notebook = build_notebooks.read(build_notebooks.NOTEBOOKS / "02_depth_noise.ipynb")
    lines = [
        line
        for cell in build_notebooks.code_cells(notebook)
        for output in cell["outputs"]
        for line in build_notebooks.joined(output.get("text", "")).splitlines()
    ]
    assert len(lines) > 50
    assert [line for line in lines if len(line) > 100] == []


# --- checkpoints ---


def test_the_numbers_of_the_checkpoints() -> None:
    """Computed here another way: by disparities. Others show their working: test_lessons.py."""
    step = 0.0006 * 447 * 0.05 / 0.4**2  # px that make 0.6 mm at 0.4 m
    d = 447 * 0.05 / 0.8
    noise = 447 * 0.05 * (1 / (d - step / 2) - 1 / (d + step / 2))
    assert CHECKPOINTS["depth_noise.twice_as_far"].value == pytest.approx(1000 * noise, rel=1e-4)

    slips = [126 * 0.05017 / 431.1, 126 / 431.1 / 0.05017, 431.1 * 0.05017, 0.05017, 431.1 / 126]
    slips.append(447 * 0.05 / 126)
    classics = [c.value for c in CHECKPOINTS["depth_noise.minimum_range"].classics]
    assert classics == pytest.approx(slips, rel=0.01)
