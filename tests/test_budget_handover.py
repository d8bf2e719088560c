"""Notebook 5 takes what notebooks 1 to 4 saved, and names every file that it cannot use."""

import math
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from common import EXPECTED

from coursekit import results
from coursekit.budget import HandOver, hand_over, independent_frames, looking_down
from coursekit.budget.handover import NEEDED, lesson_budget, wrist_budget
from coursekit.results import Covariance, Quantity

YOURS = SimpleNamespace(source="live", name="D435 on the bench")
REFERENCE = SimpleNamespace(source="simulated", name="Simulated D435, seed 7")
K = ("fx", "fy", "cx", "cy", "k1")
TWIST = ("rx", "ry", "rz", "tx", "ty", "tz")


def write(camera: SimpleNamespace, scale: float = 1.0) -> None:
    """What the last cells of the four notebooks save; scale multiplies every error."""
    values = zip(K, (430.0, 430.0, 424.0, 240.0), strict=False)
    pinhole = {f"depth_{name}": Quantity(value, "px", None, "bias") for name, value in values}
    results.save("01_pinhole", camera, pinhole)
    depth = {
        "sigma_d": Quantity(0.07 * scale, "px", 0.003, "noise"),
        "depth_bias_fitted_at_450_mm": Quantity(-1.8 * scale, "mm", 0.5 * scale, "bias"),
    }
    results.save("02_depth_noise", camera, depth)
    sigma = np.array([0.9, 0.9, 1.1, 1.2, 0.004]) * scale
    R = np.eye(5)
    R[0, 1] = R[1, 0] = 0.95
    lens = {n: Quantity(1.0, "px", s) for n, s in zip(K, sigma, strict=True)}
    groups = {"intrinsics": Covariance(K, R * np.outer(sigma, sigma))}
    results.save("03_intrinsics", camera, lens, groups)
    turn, shift = np.array([0.05, 0.06, 0.07]) * scale, np.array([0.6, 0.8, 1.0]) * scale
    units = zip(TWIST, ["deg"] * 3 + ["mm"] * 3, (*turn, *shift), strict=True)
    mount = {name: Quantity(0.0, unit, sigma) for name, unit, sigma in units}
    results.save("04_hand_eye", camera, mount)


@pytest.fixture
def folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """The student's folder, still empty, and a whole reference whose errors are twice as large."""
    reference, mine = tmp_path / "reference", tmp_path / "results"
    monkeypatch.setenv("COURSEKIT_RESULTS", str(reference))
    write(REFERENCE, scale=2.0)
    monkeypatch.setenv("COURSEKIT_RESULTS", str(mine))
    return mine, reference


def at_object_mm(handed: HandOver) -> dict[str, tuple[float, float]]:
    return {r.term.name: (1e3 * r.low_m, 1e3 * r.high_m) for r in handed.budget().rows}


def test_all_yours(folders: tuple[Path, Path]) -> None:
    write(YOURS)
    handed = hand_over(folders[1])
    assert all("yours (live: D435 on the bench, 20" in found.says for found in handed)
    assert "several cameras" not in repr(handed)
    budget = handed.budget()
    assert "Your budget" in repr(budget)
    at = at_object_mm(handed)
    assert at["pixel"][1] == pytest.approx(450 / 430)
    f_B = 430.0 * budget.view.baseline_m
    assert at["depth noise"][1] == pytest.approx(1e3 * 0.45**2 * 0.07 / f_B)
    assert at["depth bias"] == pytest.approx((0.8, 2.8))
    turn = math.radians(math.sqrt((0.05**2 + 0.06**2 + 0.07**2) / 3))
    assert at["hand-eye rotation"][1] == pytest.approx(2 * turn * 450)
    assert at["hand-eye translation"][1] == pytest.approx(2 * math.sqrt((0.36 + 0.64 + 1) / 3))
    assert at["forward kinematics"] == pytest.approx((2.0, 4.0))
    assert at["intrinsics"][1] == pytest.approx(2 * 450 / 430 * 1.2, rel=1e-6)  # cy, on the axis
    whose = {row.term.name: row.term.source for row in budget.rows}
    assert whose["pixel"] == whose["forward kinematics"] == "the lesson"
    assert whose["depth noise"].startswith("yours")


def test_numbers_of_two_cameras_are_said_to_be(folders: tuple[Path, Path]) -> None:
    """As of somebody who gave a name only after notebook 01."""
    write(YOURS)
    for lesson, seed in (("01_pinhole", 7), ("02_depth_noise", 22), ("04_hand_eye", "")):
        camera = SimpleNamespace(**vars(YOURS), serial=seed and f"seed-{seed}")
        results.save(lesson, camera, results.load(lesson).quantities)
    assert "several cameras (01: seed-7, 02: seed-22), and" in repr(hand_over())


def test_intrinsics_use_the_correlations(folders: tuple[Path, Path]) -> None:
    write(YOURS)
    handed = hand_over(folders[1])
    view = handed.view().moved(u=824.0, v=640.0)  # 400 px off both ways: fx and fy move together
    M = handed.budget()["intrinsics"].matrix(view)
    covariance = M @ M.T
    x2 = (400 / 430) ** 2
    expected = x2 * ((0.45 / 430) ** 2 * 0.9**2 * 0.95 + (0.45 * 0.004 * 2 * x2) ** 2)
    assert covariance[0, 1] == pytest.approx(expected, rel=1e-6)  # base -y, -x: the signs cancel


def test_nothing_yet(folders: tuple[Path, Path]) -> None:
    handed = hand_over(folders[1])
    for lesson, found in zip(NEEDED, handed, strict=True):
        missing = f"{lesson}: results/{lesson}.json is not there yet, notebook {lesson} has not"
        assert found.says == f"{missing} saved it; the reference is used."
    assert "The reference budget" in repr(handed.budget())
    assert handed.budget()["depth noise"].source == "reference (Simulated D435, seed 7)"
    assert at_object_mm(handed)["depth bias"] == pytest.approx((1.6, 5.6))


@pytest.mark.parametrize(("old", "new", "named"), EXPECTED["bad_hand_over"])
def test_a_bad_file_is_named_and_replaced(folders, old: str, new: str, named: str) -> None:
    write(YOURS)
    path = folders[0] / "04_hand_eye.json"
    text = path.read_text("utf-8")
    assert old in text
    path.write_text(text.replace(old, new), encoding="utf-8")
    handed = hand_over(folders[1])
    says = handed["04_hand_eye"].says
    assert "04_hand_eye.json" in says
    assert named in says
    assert says.endswith("the reference is used.")
    assert says in repr(handed)
    rows = handed.budget()
    assert rows["hand-eye rotation"].source.startswith("reference")
    assert rows["depth noise"].source.startswith("yours")
    at = at_object_mm(handed)
    assert at["hand-eye translation"][1] == pytest.approx(4 * math.sqrt((0.36 + 0.64 + 1) / 3))


def test_a_file_without_the_studio_exercise(folders: tuple[Path, Path]) -> None:
    """Noise without bias: one row is the student's, the other the lesson's, no other unit's."""
    write(YOURS)
    results.save("02_depth_noise", YOURS, {"sigma_d": Quantity(0.05, "px", 0.01, "noise")})
    handed = hand_over(folders[1])
    assert "but it holds no depth_bias_fitted_at_450_mm or depth_bias_at_450_mm" in repr(handed)
    budget = handed.budget()
    assert budget["depth noise"].source.startswith("yours")
    assert budget["depth noise"].high == 0.05
    assert budget["depth bias"].source.startswith("the lesson")
    only = {"sigma_d": Quantity(0.05, "px"), "depth_bias_at_450_mm": Quantity(2.0, "mm", 0.25)}
    results.save("02_depth_noise", YOURS, only)
    assert at_object_mm(hand_over(folders[1]))["depth bias"] == pytest.approx((1.5, 2.5))


def test_neither_yours_nor_a_reference(folders: tuple[Path, Path]) -> None:
    (folders[1] / "03_intrinsics.json").unlink()
    (folders[1] / "01_pinhole.json").write_text("{", encoding="utf-8")
    handed = hand_over(folders[1])
    assert "there is no reference 03_intrinsics.json" in handed["03_intrinsics"].says
    assert "the reference is damaged" in handed["01_pinhole"].says
    with pytest.raises(ValueError, match=r"^03_intrinsics: no number to use"):
        handed.terms()
    with pytest.raises(ValueError, match=r"^lesson: "):
        handed["05_error_budget"]


def test_a_table_says_every_row_and_whose_it_is(folders: tuple[Path, Path]) -> None:
    write(YOURS)
    handed = hand_over(folders[1])
    table = handed.budget()
    _, lines = table.table()
    assert lines[2][:5] == ("depth bias", "bias", "-0.4 %, +0 px", "sZ - oZ²/(fB)", "0.8 to 2.8 mm")
    assert "from the lesson: pixel, forward kinematics" in repr(table).splitlines()
    assert "the bench, 20" in repr(table)
    assert "the bench, 20" in table._repr_html_()
    assert "from" not in repr(lesson_budget())  # all of one source
    assert (handed.source, handed.name) == ("live", "D435 on the bench")
    (folders[0] / "03_intrinsics.json").unlink()
    mixed = hand_over(folders[1])
    assert (mixed.source, mixed.name) == ("reference", "D435 on the bench, Simulated D435, seed 7")


def test_what_notebooks_2_and_4_keep_since(folders: tuple[Path, Path]) -> None:
    """The law of the depth bias, the mount of the fixed camera and the touch test are used."""
    write(YOURS)
    depth, mounts = results.load("02_depth_noise").quantities, results.load("04_hand_eye")
    law = {"depth_scale_error": Quantity(-0.008, "1"), "disparity_offset": Quantity(-0.2, "px")}
    C = np.array([[4e-6, 3e-5], [3e-5, 9e-4]])
    results.save("02_depth_noise", YOURS, depth | law, {"depth_bias": Covariance(tuple(law), C)})
    sigmas = np.repeat([math.radians(0.1), 1.5e-3], 3)
    above = results.Placement("base_link", "x", "eye_to_hand", np.eye(4), np.diag(sigmas**2))
    touched = mounts.quantities | {"touch_mm": Quantity(3.0, "mm")}
    results.save("04_hand_eye", YOURS, touched, eye_to_hand=above)
    handed = hand_over(folders[1])
    assert handed.budget()["depth bias"].mean == (-0.008, -0.2)
    for Z in (0.45, 1.2):
        budget = handed.budget().at(distance_m=Z)
        at = {row.term.name: row.high_m for row in budget.rows}
        by = np.array([Z, -(Z**2) / (430 * budget.view.baseline_m)])
        middle, sigma = abs(by @ [-0.008, -0.2]), math.sqrt(by @ C @ by)
        assert at["depth bias"] == pytest.approx(middle + 2 * sigma)
        assert at["hand-eye rotation"] == pytest.approx(2 * math.radians(0.1) * Z)
        assert at["hand-eye translation"] == pytest.approx(2 * 1.5e-3)
        assert at["forward kinematics"] == pytest.approx(2 * 3e-3 / math.sqrt(3))
    assert "eye to hand" in handed.budget()["hand-eye rotation"].source
    assert "touch test" in handed.budget()["forward kinematics"].source
    wrist = handed.wrist_budget()["hand-eye rotation"].high
    assert wrist == pytest.approx(2 * math.radians(math.sqrt((0.05**2 + 0.06**2 + 0.07**2) / 3)))


def test_what_notebook_1_and_2_may_have_kept_is_used(folders: tuple[Path, Path]) -> None:
    """Size and baseline of the camera; the pattern that stays, and how alike two frames are."""
    write(YOURS)
    plain = hand_over(folders[1]).budget()
    size = {"depth_width": Quantity(640.0, "px"), "depth_height": Quantity(480.0, "px")}
    also = results.load("01_pinhole").quantities | size | {"baseline": Quantity(55.0, "mm")}
    results.save("01_pinhole", YOURS, also)
    stays = {"fixed_pattern": Quantity(0.05, "px"), "frame_autocorrelation": Quantity(0.3, "1")}
    results.save("02_depth_noise", YOURS, results.load("02_depth_noise").quantities | stays)
    budget = hand_over(folders[1]).budget()
    assert budget.view.intrinsics.size == (640, 480)
    assert budget.view.baseline_m == pytest.approx(0.055)
    per_px = 0.45**2 / (430.0 * 0.055)
    noise = {row.term.name: row.high_m for row in budget.rows}["depth noise"]
    assert noise == pytest.approx(per_px * math.hypot(0.07, 0.05))
    many = 0.07**2 / independent_frames(400, 0.3) + 0.05**2
    averaged = budget.at(frames=400).averaged_m["depth noise"]
    assert averaged == pytest.approx(per_px * math.sqrt(many))
    assert plain.at(frames=400).averaged_m["depth noise"] < 0.1 * budget.averaged_m["depth noise"]


def test_a_bias_that_is_subtracted_leaves_its_uncertainty(folders: tuple[Path, Path]) -> None:
    write(YOURS)  # -1.8 +- 0.5 mm
    left = {r.term.name: r for r in hand_over(folders[1]).budget(subtract_depth_bias=True).rows}
    assert 1e3 * left["depth bias"].low_m == 0.0
    assert 1e3 * left["depth bias"].high_m == pytest.approx(1.0)


def test_half_a_tick_is_the_sigma_of_a_bias_once_what_is_known_is_subtracted(folders) -> None:
    """So notebook 5 counts rigs by `add_up`; left in, a bias of one sign puts more of them out."""
    write(YOURS)
    for tilt_deg in (25.0, 45.0):
        place = {"distance_m": 0.70, "T_base_camera": looking_down(tilt_deg=tilt_deg)}
        left, whole = (hand_over(folders[1]).budget(known).at(**place) for known in (True, False))
        sigma = math.hypot(*(r.along_m[0] / 2 for r in left.rows if r.term.normal))
        low, high = left["forward kinematics"].range  # of the lesson: any way, and of any size
        sigma = math.hypot(sigma, math.sqrt(low**2 + low * high + high**2) / 3)
        share = math.erfc(0.005 / (math.sqrt(2.0) * sigma))
        assert left.draw(200_000).share_over(0.005, "closing") == pytest.approx(share, abs=0.006)
        assert whole.draw(200_000).share_over(0.005, "closing") > share + 0.008


def test_on_the_wrist_with_your_numbers(folders: tuple[Path, Path]) -> None:
    write(YOURS)
    handed = hand_over(folders[1])
    wrist, lesson = handed.wrist_budget(), wrist_budget()
    assert wrist.view.point_camera == pytest.approx(lesson.view.point_camera)
    assert wrist["depth bias"] == lesson["depth bias"]  # of another camera than notebook 2's
    assert wrist["hand-eye rotation"] == handed.budget()["hand-eye rotation"]
    turn = wrist["hand-eye rotation"].high
    at = {row.term.name: row.high_m for row in wrist.rows}
    assert at["hand-eye rotation"] == pytest.approx(turn * np.linalg.norm(wrist.view.point_camera))
