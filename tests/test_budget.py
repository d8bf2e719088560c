"""The table: the lesson's own sums, each conversion against the exact chain, and what adds how."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from coursekit.budget import (
    AXES,
    ErrorBudget,
    ErrorTerm,
    GraspAxes,
    View,
    autocorrelation,
    independent_frames,
    lesson_budget,
    lesson_view,
    looking_down,
    wrist_budget,
)
from coursekit.geometry import Intrinsics, deproject, project
from coursekit.stereo import depth_noise

LENS = Intrinsics(
    848, 480, 430.0, 432.0, 421.0, 243.0, "brown_conrady", (-0.05, 0.06, -8e-4, 1.4e-3, -0.02)
)
TURNED = np.eye(4)
TURNED[:3, :3] = Rotation.from_rotvec([0.4, -1.9, 0.7]).as_matrix()
SOMEWHERE = View(LENS, 0.52, 0.05, 703.0, 88.0, TURNED)


# --- the lesson's example ---


def test_the_lessons_sums() -> None:
    budget = lesson_budget()
    assert 1e3 * budget.noise_m == pytest.approx(1.22, abs=0.005)
    assert [1e3 * m for m in budget.worst_case_m] == pytest.approx([5.0, 15.9], abs=1e-9)
    assert [1e3 * m for m in budget.quadrature_m] == pytest.approx([3.0, 8.4], abs=0.05)
    assert "5.0 to 15.9 mm" in repr(budget)
    held = budget.with_term(replace(budget["hand-eye rotation"], stated_m=(3.9e-3, 3.9e-3)))
    assert 1e3 * held.worst_case_m[0] == pytest.approx(8.9)


def test_the_lessons_random_model() -> None:
    draws = lesson_budget().draw(1_000_000, seed=0, directions="isotropic")
    assert 1e3 * draws.mean_m == pytest.approx(5.4, abs=0.05)
    assert 1e3 * draws.percentile_m(95) == pytest.approx(9.1, abs=0.05)
    assert draws.share_over(0.007) == pytest.approx(0.23, abs=0.005)
    for axis in AXES:  # isotropic: every axis alike
        assert draws.share_over(0.007, axis) == pytest.approx(0.034, abs=0.0006)


def test_converted_rows() -> None:
    budget = lesson_budget(stated=False)
    at = {row.term.name: (1e3 * row.low_m, 1e3 * row.high_m) for row in budget.rows}
    assert at["pixel"][1] == pytest.approx(1.007, abs=5e-4)
    assert at["depth noise"][1] == pytest.approx(0.725, abs=5e-4)
    assert at["hand-eye rotation"] == pytest.approx((0.0, 3.93), abs=0.005)
    total_m = math.sqrt(np.trace(budget.noise_covariance))
    assert 1e3 * total_m == pytest.approx(1.60, abs=0.005)
    assert 1e3 * budget.at(distance_m=0.9).rows[0].high_m == pytest.approx(2.013, abs=5e-4)


@pytest.mark.parametrize(("u", "v", "moved_mm"), [(424, 240, 5.0), (0, 240, 6.9), (0, 0, 7.4)])
def test_depth_bias_leaks_sideways(u: float, v: float, moved_mm: float) -> None:
    budget = lesson_budget(stated=False).at(u=u, v=v)
    low, high = budget["depth bias"].at_object_m(budget.view)
    assert 1e3 * high == pytest.approx(moved_mm, abs=0.05)
    assert low == pytest.approx(0.4 * high)


def test_the_leak_is_the_tangent() -> None:
    term = ErrorTerm("depth bias", "bias", 5e-3, 5e-3, "ray", "test")
    view = lesson_view().moved(off_axis_deg=43.5)
    closing = ErrorBudget((term,), view).along("closing")
    assert 1e3 * closing.worst_case_m[1] == pytest.approx(5 * math.tan(math.radians(43.5)))
    assert view.off_axis_deg == pytest.approx(43.5)
    assert ErrorBudget((term,), view).along("lateral").worst_case_m[1] == pytest.approx(
        0, abs=1e-12
    )


def test_the_wrist_is_worse_in_depth() -> None:
    far = wrist_budget().at(distance_m=0.40)
    noise = far["depth noise"].at_object_m(far.view)[1]
    assert 1e3 * noise == pytest.approx(1.67, abs=0.01)  # claim D15, with the D405's own 425 px
    near = wrist_budget()
    assert near.view.distance_m < 0.3
    assert near.worst_case_m[1] < lesson_budget(stated=False).worst_case_m[1]


# --- each conversion against the exact chain ---


def exact(view: View, along: str, change: np.ndarray) -> np.ndarray:
    """Where the object goes, base axes, by the functions of notebook 1 and SciPy's rotations."""
    pixel, Z, turn, shift = np.array([view.u, view.v]), view.distance_m, np.zeros(3), np.zeros(3)
    camera = view.intrinsics
    match along:
        case "image":
            pixel = pixel + change
        case "ray":
            Z = Z + change[0]
        case "scale":
            Z = Z * (1 + change[0])
        case "disparity":
            f_B = camera.fx * view.baseline_m
            Z = f_B / (f_B / Z + change[0])
        case "turn":
            turn = change
        case "shift":
            shift = change
        case "intrinsics":
            K = {
                n: getattr(camera, n) + c
                for n, c in zip(("fx", "fy", "cx", "cy"), change[:4], strict=True)
            }
            lens = tuple(np.add(camera.coeffs, change[4:]))
            camera = replace(camera, model="brown_conrady", coeffs=lens, **K)
    in_base = view.R_base_camera @ deproject(pixel, Z, camera.K, camera.dist)
    return Rotation.from_rotvec(turn).apply(in_base) + shift


COMPONENTS = {"image": 2, "ray": 1, "scale": 1, "disparity": 1, "turn": 3, "shift": 3}


@pytest.mark.parametrize(("along", "k"), [*COMPONENTS.items(), ("intrinsics", 9)])
@pytest.mark.parametrize("view", [SOMEWHERE, lesson_view()], ids=["lens", "lesson"])
def test_matrix_is_the_derivative(view: View, along: str, k: int) -> None:
    factor = tuple(map(tuple, np.eye(9))) if along == "intrinsics" else None
    term = ErrorTerm("x", "bias", 0.0, 1.0, along, "test", factor=factor)  # type: ignore[arg-type]
    h = 1e-5
    numerical = [
        (exact(view, along, h * e) - exact(view, along, -h * e)) / (2 * h) for e in np.eye(k)
    ]
    assert term.matrix(view) == pytest.approx(np.array(numerical).T, rel=1e-5, abs=1e-8)


def test_a_view_sees_its_point() -> None:
    point = SOMEWHERE.point_camera
    seen = project(point, LENS.K, LENS.dist)
    assert seen == pytest.approx([SOMEWHERE.u, SOMEWHERE.v], abs=1e-9)
    assert point[2] == SOMEWHERE.distance_m
    assert lesson_view().minimum_range_m == pytest.approx(0.177, abs=5e-4)  # claim D9


# --- how things add ---


def test_noise_in_the_mean_is_the_covariance() -> None:
    budget = lesson_budget(stated=False).at(u=700.0, v=100.0)
    noisy = ErrorBudget(tuple(t for t in budget.terms if t.kind == "noise"), budget.view)
    draws = noisy.draw(400_000, seed=1, noise=True).displacements_m
    assert np.cov(draws.T) == pytest.approx(noisy.noise_covariance, rel=0.02, abs=2e-9)
    sigma_Z = float(depth_noise(0.45, 447.0, 0.05, 0.08))
    assert noisy.along("approach").noise_m == pytest.approx(sigma_Z)


def test_no_draw_exceeds_the_worst_case() -> None:
    budget = lesson_budget(stated=False).at(u=700.0, v=100.0)
    draws = budget.draw(50_000, seed=2)
    assert draws.norm_m.max() <= budget.worst_case_m[1]
    for axis, reached in zip(AXES, np.abs(draws.along_m).max(axis=0), strict=True):
        limit = budget.along(axis).worst_case_m[1]
        assert 0.8 * limit < reached <= limit


def test_autocorrelation_and_floor() -> None:
    assert independent_frames(100) == pytest.approx(100)
    assert math.sqrt(independent_frames(100, 0.5)) == pytest.approx(5.8, abs=0.05)  # claim D8
    k = np.arange(1, 30)
    direct = 30 / (1 + 2 * np.sum((1 - k / 30) * 0.7**k))
    assert independent_frames(30, 0.7) == pytest.approx(direct)

    term = ErrorTerm("depth noise", "noise", 1e-3, 1e-3, "ray", "test", floor=2e-4)
    one = ErrorBudget((term,), lesson_view())
    assert one.noise_m == pytest.approx(math.hypot(1e-3, 2e-4))
    assert one.at(frames=100).noise_m == pytest.approx(math.hypot(1e-4, 2e-4))
    assert one.at(frames=10**6).noise_m == pytest.approx(2e-4, rel=1e-4)


@pytest.mark.parametrize("rho", [0.0, 0.13, 0.5, 0.98])
def test_the_autocorrelation_of_frames_comes_back(rho: float) -> None:
    assert autocorrelation(200, independent_frames(200, rho)) == pytest.approx(rho, abs=1e-9)


@pytest.mark.parametrize(("frames", "effective"), [(1, 1.0), (10, 0.9), (10, 10.1), (10, 1.0)])
def test_an_impossible_number_of_frames_is_named(frames: int, effective: float) -> None:
    with pytest.raises(ValueError, match=r"frames: got|effective: got"):
        autocorrelation(frames, effective)


def test_averaging_leaves_bias_alone() -> None:
    budget = lesson_budget()
    averaged = budget.at(frames=100)
    assert averaged.noise_m == pytest.approx(budget.noise_m / 10)
    assert averaged.worst_case_m == budget.worst_case_m


def test_a_normal_bias() -> None:
    term = ErrorTerm("t", "bias", 0.0, 4e-3, "shift", "test", normal=True)
    draws = ErrorBudget((term,), lesson_view()).draw(100_000, seed=3)
    assert draws.displacements_m.std(axis=0) == pytest.approx([2e-3] * 3, rel=0.01)


def test_one_term_changed_leaves_the_others_draws() -> None:
    budget = lesson_budget(stated=False)
    gone = budget.scaled("forward kinematics", 0.0)
    alone = ErrorBudget((budget["depth bias"].scaled(0.0), *budget.terms[3:]), budget.view)
    assert len(alone.terms) == 4
    difference = budget.draw(1000, 4).displacements_m - gone.draw(1000, 4).displacements_m
    length = np.linalg.norm(difference, axis=1)
    assert ((length >= 2e-3 - 1e-12) & (length <= 4e-3 + 1e-12)).all()


def test_the_sum_along_an_axis_turns_with_the_gripper() -> None:
    budget = lesson_budget(stated=False).at(off_axis_deg=30.0)
    turned = budget.at(grasp=GraspAxes(closing=(0, 0, 2.0), approach=(0, -1.0, 0)))
    assert turned.along("closing").worst_case_m == pytest.approx(
        budget.along("approach").worst_case_m
    )
    assert turned.along("approach").tolerance_m == 0.010


def test_rows_for_people() -> None:
    budget = lesson_budget(stated=False)
    assert "up to" not in budget["hand-eye rotation"].magnitude
    assert budget["hand-eye rotation"].magnitude == "0.5 deg"
    assert budget["depth bias"].magnitude == "2 to 5 mm"
    assert all(len(line) <= 110 for line in repr(budget).splitlines())
    shady = replace(budget["pixel"], name="<b>pixel")
    assert "<b>pixel" not in replace(budget, terms=(shady,))._repr_html_()


# --- what is refused ---


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"kind": "random"}, "kind"),
        ({"along": "sideways"}, "along"),
        ({"low": -1.0}, "low, high"),
        ({"low": 2.0}, "low, high"),
        ({"high": math.nan}, "low, high"),
        ({"stated_m": (2.0, 1.0)}, "stated_m"),
        ({"kind": "noise"}, "low"),
        ({"floor": 1.0}, "floor"),
        ({"along": "intrinsics"}, "factor"),
    ],
)
def test_bad_terms(changes: dict, name: str) -> None:
    good = {"name": "x", "kind": "bias", "low": 0.0, "high": 1.0, "along": "ray", "source": "s"}
    with pytest.raises(ValueError, match=f"^{name}: "):
        ErrorTerm(**good | changes)


@pytest.mark.parametrize(
    ("changes", "name"),
    [
        ({"distance_m": 0.0}, "distance_m"),
        ({"distance_m": math.nan}, "distance_m"),
        ({"baseline_m": -0.05}, "baseline_m"),
        ({"u": math.inf}, "u"),
        ({"off_axis_deg": 90.0}, "off_axis_deg"),
        ({"T_base_camera": np.ones((4, 4))}, "T_base_camera"),
        ({"frames": 0}, "frames"),
        ({"autocorrelation": 1.0}, "autocorrelation"),
    ],
)
def test_bad_places(changes: dict, name: str) -> None:
    with pytest.raises(ValueError, match=f"^{name}: "):
        lesson_budget(stated=False).at(**changes)


def test_stated_rows_do_not_move() -> None:
    with pytest.raises(ValueError, match=r"^distance_m: 'pixel' is stated"):
        lesson_budget().at(distance_m=0.6)


def test_bad_budgets() -> None:
    budget = lesson_budget()
    folding = Intrinsics(640, 480, 400, 400, 320, 240, "brown_conrady", (-0.5, 0, 0, 0, 0))
    short = ((1.0, 0.0), (0.0, 1.0))
    wrong = {
        r"^terms: got \('pixel', 'pixel'\)": lambda: replace(budget, terms=budget.terms[:1] * 2),
        "^terms: got \\(\\)": lambda: replace(budget, terms=()),
        "^name: got 'bias'": lambda: budget["bias"],
        "^axis: ": lambda: budget.along("up"),
        "^n: got 0": lambda: budget.draw(0),
        "^directions: ": lambda: budget.draw(10, directions="any"),
        "^approach: ": lambda: GraspAxes(approach=(0.0, 1.0, 1.0)),
        "^closing: ": lambda: GraspAxes(closing=(0.0, 0.0, 0.0)),
        "^tolerance_m: ": lambda: GraspAxes(tolerance_m=(0.007, 0.0, 0.01)),
        "^tilt_deg: ": lambda: looking_down(math.inf),
        "^u, v: ": lambda: View(folding, 0.45, 0.05, 5.0, 5.0),
        "^factor: ": lambda: lesson_budget(stated=False).with_term(
            ErrorTerm("x", "bias", 0.0, 1.0, "ray", "s", factor=short)
        ),
    }
    for words, act in wrong.items():
        with pytest.raises(ValueError, match=words):
            act()
