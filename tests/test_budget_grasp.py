"""Grasp success against closed forms, what to fix first, and where to mount the camera."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm

from coursekit.budget import (
    CUBE,
    LESSON_GRIPPER,
    WIDOWX_GRIPPER,
    ErrorBudget,
    ErrorTerm,
    GraspAxes,
    Gripper,
    Mounting,
    Target,
    best_distance,
    centring_tolerance_m,
    lesson_budget,
    lesson_view,
    sensitivity,
    success_probability,
    with_gripper,
    wrist_budget,
)

CONVERTED = lesson_budget(stated=False)


def test_tolerances() -> None:
    """Claim B7."""
    assert 1e3 * centring_tolerance_m(LESSON_GRIPPER, CUBE) == pytest.approx(7.5)
    assert 1e3 * centring_tolerance_m(WIDOWX_GRIPPER, CUBE) == pytest.approx(27.5)
    assert 1e3 * centring_tolerance_m(Gripper(0.088, "the same"), CUBE) == pytest.approx(31.5)
    assert 1e3 * centring_tolerance_m(WIDOWX_GRIPPER, Target(0.066)) == pytest.approx(7.0)
    wide = with_gripper(CONVERTED, WIDOWX_GRIPPER, CUBE)
    assert wide.grasp.tolerance_m == pytest.approx((0.0275, 0.010, 0.010))
    with pytest.raises(ValueError, match=r"^target: got 0.066, want less than the 0.04 m"):
        centring_tolerance_m(LESSON_GRIPPER, Target(0.066))


def test_success_by_noise_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three independent normal errors: a product of three probabilities."""
    term = ErrorTerm("shake", "noise", 4e-3, 4e-3, "shift", "test")
    tight = GraspAxes(tolerance_m=(0.004, 0.006, 0.012))
    monkeypatch.setattr("coursekit.budget.grasp.DRAWS", 200_000)
    success = success_probability(ErrorBudget((term,), lesson_view(), tight))
    each = [2 * norm.cdf(t) - 1 for t in (1.0, 1.5, 3.0)]
    assert success.by_axis == pytest.approx(each, abs=0.003)
    assert success.probability == pytest.approx(math.prod(each), abs=4 * success.error)
    assert success.rigs == 1.0


def test_success_by_bias_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """An isotropic direction's component along an axis is uniform (Archimedes)."""
    term = ErrorTerm("off", "bias", 8e-3, 8e-3, "shift", "test")
    wide = GraspAxes(tolerance_m=(0.006, 1.0, 1.0))
    monkeypatch.setattr("coursekit.budget.grasp.DRAWS", 200_000)
    success = success_probability(ErrorBudget((term,), lesson_view(), wide))
    assert success.probability == pytest.approx(0.75, abs=0.004)
    assert success.rigs == success.probability


def test_the_cube_with_both_grippers() -> None:
    roomy = GraspAxes(tolerance_m=(0.007, 0.015, 0.015))
    tight, wide = (
        success_probability(with_gripper(CONVERTED.at(grasp=roomy), gripper, CUBE))
        for gripper in (LESSON_GRIPPER, WIDOWX_GRIPPER)
    )
    assert 0.95 < tight.probability < wide.probability
    assert wide.by_axis[0] == 1.0
    averaged = success_probability(CONVERTED.at(frames=100))
    assert averaged.probability <= averaged.rigs + 0.01  # averaging cannot help a biased rig
    assert "% of grasps succeed" in repr(tight)


def test_probability_changes_smoothly() -> None:
    """While a slider is dragged: the same draws, so no jumps."""
    p = [
        success_probability(CONVERTED.at(distance_m=Z)).probability
        for Z in np.linspace(0.3, 0.8, 26)
    ]
    assert np.diff(p).max() < 0.003
    assert p[0] - p[-1] > 0.15


def test_what_to_fix_first() -> None:
    far = CONVERTED.at(distance_m=0.8, off_axis_deg=35.0)
    gains = sensitivity(far)
    assert sorted(g.name for g in gains) == sorted(far.names)
    assert gains[0].success == max(g.success for g in gains) > 0.02
    by_name = {g.name: g for g in gains}
    turn = by_name["hand-eye rotation"]
    halved = far.with_term(far["hand-eye rotation"].scaled(0.5)).along("closing").worst_case_m[1]
    assert turn.worst_case_m == pytest.approx(far.along("closing").worst_case_m[1] - halved)
    assert turn.noise_m == 0.0
    before = far.draw(20_000, noise=True).success()
    for gain in gains:  # the same as with that term halved and drawn anew
        again = far.scaled(gain.name, 0.5).draw(20_000, noise=True).success()
        assert gain.success == pytest.approx(again - before, abs=1e-4)
    assert by_name["pixel"].worst_case_m == 0.0
    assert by_name["pixel"].noise_m > 0.0
    assert str(turn).startswith("halve hand-eye rotation:     +")


def test_what_to_fix_first_when_all_succeed() -> None:
    sure = CONVERTED.at(grasp=GraspAxes(tolerance_m=(1.0, 1.0, 1.0)))
    gains = sensitivity(sure)
    assert [g.success for g in gains] == [0.0] * len(gains)
    assert gains[0].worst_case_m == max(g.worst_case_m for g in gains)


def test_best_distance_is_as_near_as_allowed() -> None:
    best = best_distance(CONVERTED)
    seen = max(0.30 * 447 / 848, 0.20 * 447 / 480)
    assert best.allowed["field of view"] == pytest.approx(seen)
    assert best.allowed["minimum range"] == pytest.approx(0.177, abs=5e-4)
    assert best.limit == "clearance"
    assert best.distance_m == pytest.approx(0.20)
    large = best_distance(CONVERTED, Mounting(workspace_m=(0.6, 0.5)))
    assert large.limit == "field of view"
    assert large.distance_m == pytest.approx(0.5 * 447 / 480)
    assert large.figure_m > best.figure_m
    assert "held by the field of view" in repr(large)
    blind = best_distance(CONVERTED.at(baseline_m=0.095), Mounting(clearance_m=0.1))
    assert blind.limit == "minimum range"
    assert best_distance(wrist_budget(), Mounting((0.1, 0.1), 0.12)).limit == "clearance"


def test_best_distance_inside() -> None:
    """A figure with a minimum of its own is found within a step of the grid."""
    best = best_distance(CONVERTED, figure=lambda b: abs(b.view.distance_m - 0.5))
    assert best.limit == ""
    assert best.distance_m == pytest.approx(0.5, abs=0.003)
    assert best.figures_m.shape == best.distances_m.shape


def test_no_distance_will_do() -> None:
    with pytest.raises(ValueError, match=r"^mounting: got 'a reach of 0.80 m', want at least 0.93"):
        best_distance(CONVERTED, Mounting(workspace_m=(1.0, 1.0)))
    with pytest.raises(ValueError, match="stated at the object"):
        best_distance(lesson_budget())


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: Gripper(0.0, "x"), "opening_m"),
        (lambda: Target(math.nan), "width_m"),
        (lambda: Mounting(reach_m=-1.0), "reach_m"),
        (lambda: Mounting(workspace_m=(0.3, 0.0)), "workspace_m"),
        (lambda: Mounting(minimum_range_m=0.0), "minimum_range_m"),
        (lambda: Gripper(60.0), "opening_m"),
        (lambda: CONVERTED.scaled("pixel", -1.0), "factor"),
        (lambda: replace(CONVERTED, frames=2.5), "frames"),
    ],
)
def test_bad_input(make: object, name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name}: "):
        make()  # type: ignore[operator]
