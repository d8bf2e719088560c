"""The table: the lesson's own sums, each conversion against the exact chain, what adds how; and
grasp success against closed forms, what to fix first, and where to mount the camera."""

import math
from dataclasses import replace

import numpy as np
import pytest
from common import WIDE, derivative, each, named, refusals
from scipy.spatial.transform import Rotation
from scipy.stats import norm

import coursekit.budget as eb
from coursekit.geometry import Intrinsics, deproject
from coursekit.stereo import depth_noise

TURNED = np.eye(4)
TURNED[:3, :3] = Rotation.from_rotvec([0.4, -1.9, 0.7]).as_matrix()
SOMEWHERE = eb.View(WIDE, 0.52, 0.05, 703.0, 88.0, TURNED)


# --- the lesson's example ---


def test_the_lessons_sums() -> None:
    budget = eb.lesson_budget()
    assert 1e3 * budget.noise_m == pytest.approx(1.22, abs=0.005)
    assert [1e3 * m for m in budget.worst_case_m] == pytest.approx([5.0, 15.9], abs=1e-9)
    assert [1e3 * m for m in budget.quadrature_m] == pytest.approx([3.0, 8.4], abs=0.05)
    assert "5.0 to 15.9 mm" in repr(budget)
    averaged = budget.at(frames=100)
    assert averaged.noise_m == pytest.approx(budget.noise_m / 10)
    assert averaged.worst_case_m == budget.worst_case_m
    held = budget.with_term(replace(budget["hand-eye rotation"], stated_m=(3.9e-3, 3.9e-3)))
    assert 1e3 * held.worst_case_m[0] == pytest.approx(8.9)


def test_converted_rows() -> None:
    budget = eb.lesson_budget(stated=False)
    at = {row.term.name: (1e3 * row.low_m, 1e3 * row.high_m) for row in budget.rows}
    assert at["pixel"][1] == pytest.approx(1.007, abs=5e-4)
    assert at["depth noise"][1] == pytest.approx(0.725, abs=5e-4)
    assert at["hand-eye rotation"] == pytest.approx((0.0, 3.93), abs=0.005)
    total_m = math.sqrt(np.trace(budget.noise_covariance))
    assert 1e3 * total_m == pytest.approx(1.60, abs=0.005)
    assert 1e3 * budget.at(distance_m=0.9).rows[0].high_m == pytest.approx(2.013, abs=5e-4)


def test_the_wrist_is_worse_in_depth() -> None:
    far = eb.wrist_budget().at(distance_m=0.40)
    noise = far["depth noise"].at_object_m(far.view)[1]
    assert 1e3 * noise == pytest.approx(1.67, abs=0.01)  # claim D15, with the D405's own 425 px
    near = eb.wrist_budget()
    assert near.view.distance_m < 0.3
    assert near.worst_case_m[1] < eb.lesson_budget(stated=False).worst_case_m[1]


# --- each conversion against the exact chain ---


def exact(view: eb.View, along: str, change: np.ndarray) -> np.ndarray:
    """Where the object goes, base axes, by the functions of notebook 1 and SciPy's rotations."""
    by = {part: np.zeros(k) for part, k in COMPONENTS.items()} | {along: change}
    camera, (fx, fy, cx, cy) = view.intrinsics, by["intrinsics"][:4]
    f_B, Z = camera.fx * view.baseline_m, view.distance_m * (1 + by["depth"][0]) + by["ray"][0]
    Z = f_B / (f_B / Z + by["disparity"][0] + by["depth"][1])
    K = camera.K + np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 0]])
    pixel, coeffs = by["image"] + (view.u, view.v), by["intrinsics"][4:] + camera.coeffs
    seen = deproject(pixel, Z, K, coeffs)
    return Rotation.from_rotvec(by["turn"]).apply(view.R_base_camera @ seen) + by["shift"]


COMPONENTS = {"image": 2, "ray": 1, "depth": 2, "disparity": 1, "turn": 3, "shift": 3}
COMPONENTS["intrinsics"] = 9


@pytest.mark.parametrize(("along", "k"), COMPONENTS.items())
@pytest.mark.parametrize("view", [SOMEWHERE, eb.lesson_view()], ids=["lens", "lesson"])
def test_matrix_is_the_derivative(view: eb.View, along: str, k: int) -> None:
    factor = tuple(map(tuple, np.eye(k))) if along in ("depth", "intrinsics") else None
    term = eb.ErrorTerm("x", "bias", 0.0, 1.0, along, "test", factor=factor)  # type: ignore[arg-type]
    numerical = derivative(lambda change: exact(view, along, change), 1e-5, k)
    assert term.matrix(view) == pytest.approx(numerical, rel=1e-5, abs=1e-8)


# --- how things add ---


def test_noise_in_the_mean_is_the_covariance() -> None:
    budget = eb.lesson_budget(stated=False).at(u=700.0, v=100.0)
    noisy = eb.ErrorBudget(tuple(t for t in budget.terms if t.kind == "noise"), budget.view)
    draws = noisy.draw(400_000, seed=1, noise=True).displacements_m
    assert np.cov(draws.T) == pytest.approx(noisy.noise_covariance, rel=0.02, abs=2e-9)
    sigma_Z = float(depth_noise(0.45, 447.0, 0.05, 0.08))
    assert noisy.along("approach").noise_m == pytest.approx(sigma_Z)


def test_no_draw_exceeds_the_worst_case() -> None:
    budget = eb.lesson_budget(stated=False).at(u=700.0, v=100.0)
    draws = budget.draw(50_000, seed=2)
    assert draws.norm_m.max() <= budget.worst_case_m[1]
    for axis, reached in zip(eb.AXES, np.abs(draws.along_m).max(axis=0), strict=True):
        limit = budget.along(axis).worst_case_m[1]
        assert 0.8 * limit < reached <= limit


def test_autocorrelation_and_floor() -> None:
    assert eb.independent_frames(100) == pytest.approx(100)
    assert math.sqrt(eb.independent_frames(100, 0.5)) == pytest.approx(5.8, abs=0.05)  # claim D8
    k = np.arange(1, 30)
    direct = 30 / (1 + 2 * np.sum((1 - k / 30) * 0.7**k))
    assert eb.independent_frames(30, 0.7) == pytest.approx(direct)

    term = eb.ErrorTerm("depth noise", "noise", 1e-3, 1e-3, "ray", "test", floor=2e-4)
    one = eb.ErrorBudget((term,), eb.lesson_view())
    assert one.noise_m == pytest.approx(math.hypot(1e-3, 2e-4))
    assert one.at(frames=100).noise_m == pytest.approx(math.hypot(1e-4, 2e-4))
    assert one.at(frames=10**6).noise_m == pytest.approx(2e-4, rel=1e-4)


@pytest.mark.parametrize("rho", [0.0, 0.13, 0.5, 0.98])
def test_the_autocorrelation_of_frames_comes_back(rho: float) -> None:
    assert eb.autocorrelation(200, eb.independent_frames(200, rho)) == pytest.approx(rho, abs=1e-9)


def test_a_bias_about_its_mean() -> None:
    """s Z - o Z²/(f B) with the covariance of both: over distance, along an axis, drawn."""
    root = np.linalg.cholesky([[4e-6, 3e-5], [3e-5, 9e-4]])
    term = eb.ErrorTerm("depth bias", "bias", 0.0, 2.0, "depth", "test", normal=True,
                        factor=tuple(map(tuple, root)), mean=(-0.008, -0.2))  # fmt: skip
    budget = CONVERTED.with_term(term).at(T_base_camera=eb.looking_down(30.0))
    for Z in (0.3, 0.45, 0.9, 1.5):
        there = budget.at(distance_m=Z)
        by = np.array([Z, -(Z**2) / (447 * 0.05)])
        middle, sigma = abs(by @ [-0.008, -0.2]), math.sqrt(by @ root @ root.T @ by)
        row = next(row for row in there.rows if row.term == term)
        assert row.low_m == pytest.approx(max(0.0, middle - 2 * sigma))
        assert row.high_m == pytest.approx(middle + 2 * sigma)
        assert row.along_m[0] == pytest.approx(row.high_m * math.sin(math.radians(30)))
        drawn = replace(there, terms=(term,)).draw(20_000)
        assert drawn.displacements_m.mean(axis=0) @ there.view.R_base_camera[:, 2] == pytest.approx(
            by @ [-0.008, -0.2], abs=sigma / 30
        )
        assert np.linalg.norm(drawn.displacements_m.std(axis=0)) == pytest.approx(sigma, rel=0.03)
    assert term.magnitude == "-0.8 %, -0.2 px"
    halved = budget.with_term(term.scaled(0.5)).along("closing").worst_case_m[1]
    assert halved < budget.along("closing").worst_case_m[1]


def test_one_term_changed_leaves_the_others_draws() -> None:
    budget = eb.lesson_budget(stated=False)
    gone = budget.scaled("forward kinematics", 0.0)
    alone = eb.ErrorBudget((budget["depth bias"].scaled(0.0), *budget.terms[3:]), budget.view)
    assert len(alone.terms) == 4
    difference = budget.draw(1000, 4).displacements_m - gone.draw(1000, 4).displacements_m
    length = np.linalg.norm(difference, axis=1)
    assert ((length >= 2e-3 - 1e-12) & (length <= 4e-3 + 1e-12)).all()


def test_the_sum_along_an_axis_turns_with_the_gripper() -> None:
    budget = eb.lesson_budget(stated=False).at(off_axis_deg=30.0)
    turned = budget.at(grasp=eb.GraspAxes(closing=(0, 0, 2.0), approach=(0, -1.0, 0)))
    straight = budget.along("approach").worst_case_m
    assert turned.along("closing").worst_case_m == pytest.approx(straight)
    assert turned.along("approach").tolerance_m == 0.010


def test_rows_for_people() -> None:
    budget = eb.lesson_budget(stated=False)
    assert "up to" not in budget["hand-eye rotation"].magnitude
    assert budget["hand-eye rotation"].magnitude == "0.5 deg"
    assert budget["depth bias"].magnitude == "0.22 to 0.55 px"  # 2 to 5 mm at 0.45 m
    assert eb.lesson_budget()["depth bias"].magnitude == "2 to 5 mm"
    prices = [row.term.conversion(budget.view) for row in eb.lesson_budget().rows]
    assert prices[0] == "Z/f: 1.01 mm/px"
    assert prices[3] == "lever 0.45 m: 7.9 mm/deg"
    assert prices[-1] == "direct"
    assert all(len(line) <= 110 for line in repr(budget).splitlines())
    shady = replace(budget["pixel"], name="<b>pixel")
    assert "<b>pixel" not in replace(budget, terms=(shady,))._repr_html_()


# --- grasps ---

CONVERTED = eb.lesson_budget(stated=False)


def test_tolerances() -> None:
    """Claim B7."""
    widest, can = eb.Gripper(0.088, "the same"), eb.Target(0.066)
    pairs = [(g, eb.CUBE) for g in (eb.LESSON_GRIPPER, eb.WIDOWX_GRIPPER, widest)]
    left_m = [eb.centring_tolerance_m(*pair) for pair in (*pairs, (eb.WIDOWX_GRIPPER, can))]
    assert left_m == pytest.approx([0.0075, 0.0275, 0.0315, 0.0070])
    wide = eb.with_gripper(CONVERTED, eb.WIDOWX_GRIPPER, eb.CUBE)
    assert wide.grasp.tolerance_m == pytest.approx((0.0275, 0.010, 0.010))


def test_success_by_noise_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Three independent normal errors: a product of three probabilities."""
    term = eb.ErrorTerm("shake", "noise", 4e-3, 4e-3, "shift", "test")
    tight = eb.GraspAxes(tolerance_m=(0.004, 0.006, 0.012))
    monkeypatch.setattr("coursekit.budget.grasp.DRAWS", 200_000)
    success = eb.success_probability(eb.ErrorBudget((term,), eb.lesson_view(), tight))
    each = [2 * norm.cdf(t) - 1 for t in (1.0, 1.5, 3.0)]
    assert success.by_axis == pytest.approx(each, abs=0.003)
    assert success.probability == pytest.approx(math.prod(each), abs=4 * success.error)
    assert success.rigs == 1.0


def test_success_by_bias_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """An isotropic direction's component along an axis is uniform (Archimedes)."""
    term = eb.ErrorTerm("off", "bias", 8e-3, 8e-3, "shift", "test")
    wide = eb.GraspAxes(tolerance_m=(0.006, 1.0, 1.0))
    monkeypatch.setattr("coursekit.budget.grasp.DRAWS", 200_000)
    success = eb.success_probability(eb.ErrorBudget((term,), eb.lesson_view(), wide))
    assert success.probability == pytest.approx(0.75, abs=0.004)
    assert success.rigs == success.probability


def test_probability_changes_smoothly() -> None:
    """While a slider is dragged: the same draws, so no jumps."""
    budgets = [CONVERTED.at(distance_m=Z) for Z in np.linspace(0.3, 0.8, 26)]
    p = [eb.success_probability(budget).probability for budget in budgets]
    assert np.diff(p).max() < 0.003
    assert p[0] - p[-1] > 0.15


def test_what_to_fix_first() -> None:
    far = CONVERTED.at(distance_m=0.8, off_axis_deg=35.0)
    gains = eb.sensitivity(far)
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


def test_closing_rows_scatter_as_drawn_rigs_do() -> None:
    mine = eb.hand_over().budget(subtract_depth_bias=True).at(distance_m=0.7)
    rows = [r for r in mine.closing_rows().values() if r[3] == "bias"]
    squares = [(a * a + a * b + b * b) / (9 if toward is None else 3) for a, b, toward, _ in rows]
    drawn = 1000 * mine.draw(100_000).along_m[:, 0]
    assert math.sqrt(sum(squares)) == pytest.approx(drawn.std(), rel=0.03)


def test_what_to_fix_first_when_all_succeed() -> None:
    sure = CONVERTED.at(grasp=eb.GraspAxes(tolerance_m=(1.0, 1.0, 1.0)))
    gains = eb.sensitivity(sure)
    assert [g.success for g in gains] == [0.0] * len(gains)
    assert [g.room_m for g in gains] == sorted((g.room_m for g in gains), reverse=True)
    assert "%" not in repr(gains)  # what no row changes is not printed down the list
    assert "grasps" in repr(eb.sensitivity(CONVERTED)).splitlines()[1]


# --- what is refused ---


def term(**changes) -> eb.ErrorTerm:
    good = {"name": "x", "kind": "bias", "low": 0.0, "high": 1.0, "along": "ray", "source": "s"}
    return eb.ErrorTerm(**good | changes)


FOLDING = Intrinsics(640, 480, 400, 400, 320, 240, "brown_conrady", (-0.5, 0, 0, 0, 0))
SHORT = ((1.0, 0.0), (0.0, 1.0))
LESSON, PLACE, EYE = eb.lesson_budget(), eb.Chain(eb.lesson_view()), np.eye(2)

test_what_cannot_be_is_refused = refusals(
    *named(term, kind=["random"], along=["sideways"], stated_m=[(2.0, 1.0)], floor=[1.0]),
    *each("^low, high: ", term, "low", -1.0, 2.0),
    *each("^low, high: ", term, "high", math.nan),
    *each("^low: ", term, "kind", "noise"),
    *each("^factor: ", term, "along", "intrinsics"),
    ("^factor: ", lambda: CONVERTED.with_term(term(factor=SHORT))),
    *named(CONVERTED.at, distance_m=[0.0, math.nan], baseline_m=[-0.05], u=[math.inf], frames=[0]),
    *named(
        CONVERTED.at, off_axis_deg=[90.0], autocorrelation=[1.0], T_base_camera=[np.ones((4, 4))]
    ),
    ("^distance_m: 'pixel' is stated", lambda: LESSON.at(distance_m=0.6)),
    ("^u, v: ", lambda: eb.View(FOLDING, 0.45, 0.05, 5.0, 5.0)),
    ("^frames: ", lambda: replace(CONVERTED, frames=2.5)),
    ("^frames: got", lambda: eb.autocorrelation(1, 1.0)),
    *(("^effective: got", lambda n=n: eb.autocorrelation(10, n)) for n in (0.9, 10.1, 1.0)),
    (r"^terms: got \('pixel', 'pixel'\)", lambda: replace(LESSON, terms=LESSON.terms[:1] * 2)),
    (r"^terms: got \(\)", lambda: replace(LESSON, terms=())),
    ("^name: got 'bias'", lambda: LESSON["bias"]),
    ("^axis: ", lambda: LESSON.along("up")),
    ("^n: got 0", lambda: LESSON.draw(0)),
    ("^directions: ", lambda: LESSON.draw(10, directions="any")),
    *named(eb.GraspAxes, approach=[(0.0, 1.0, 1.0)], closing=[(0.0, 0.0, 0.0)]),
    *named(eb.GraspAxes, tolerance_m=[(0.007, 0.0, 0.01)]),
    ("^tilt_deg: ", lambda: eb.looking_down(math.inf)),
    (
        "^target: got 0.066, want less than the 0.04 m",
        lambda: eb.centring_tolerance_m(eb.LESSON_GRIPPER, eb.Target(0.066)),
    ),
    *named(eb.Gripper, opening_m=[0.0, 60.0]),
    *named(eb.Target, width_m=[math.nan]),
    ("^factor: ", lambda: CONVERTED.scaled("pixel", -1.0)),
    *named(eb.Covariances, pixel=[np.eye(3), -EYE, [[1.0, 0.5], [0.2, 1.0]]], arm=[np.eye(3)]),
    *named(eb.Covariances, hand_eye=[np.full((6, 6), np.nan)], depth_sigma_m=[-1.0]),
    *named(eb.Covariances, names=[("fx", "f"), ("fx", "fx")], intrinsics=[np.eye(5)]),
    ("^T_base_gripper: ", lambda: eb.Chain(eb.lesson_view(), "eye_in_hand")),
    ("^mount: ", lambda: eb.Chain(eb.lesson_view(), "eye_on_stalk")),
    ("^n: ", lambda: eb.monte_carlo(PLACE, eb.Covariances(), 0)),
)


def test_the_closing_column_of_noise_adds_up_to_the_sum_printed_below() -> None:
    """What stays of a noise is in the single frame that the column speaks of."""
    noisy = replace(eb.lesson_budget(stated=False)["depth noise"], floor=0.0006)
    budget = eb.lesson_budget(stated=False).with_term(noisy).at(
        T_base_camera=eb.looking_down(tilt_deg=25)
    )  # fmt: skip
    columns = [row.along_m[0] for row in budget.rows if row.term.kind == "noise"]
    assert math.hypot(*columns) == pytest.approx(budget.along("closing").noise_m, rel=1e-6)
