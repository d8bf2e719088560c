"""Attribution of misses: the shares of right and wrong verdicts, the tests behind, the ledger.

Rules and thresholds were set on the seeds below 100,000; the tests use seeds from there on. The
bounds on shares are those asked of the course. COURSEKIT_NIGHTLY=1 holds 1,000 sets to them, whose
figures were two standard errors or more on the safe side of each on other seeds, and checks the
levels of the tests with more sets. The ordinary run takes a twelfth, and a share may be off by what
chance does to so few once in a thousand times.
"""

import csv
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path

import common
import numpy as np
import pytest
from common import EXPECTED, NIGHTLY, each, named, refusals
from scipy.spatial.transform import Rotation
from scipy.stats import f, f_oneway, ncf, t

from coursekit.attribution import Entry, Ledger, attribute, four_sets, significance, simulate_misses
from coursekit.attribution.ledger import LEDGER_HEADER
from coursekit.attribution.significance import mean_test, place_test, pose_columns, pose_test
from coursekit.attribution.verdict import REMEDY

SETS = 1000 if NIGHTLY else 80
SOME = 400 if NIGHTLY else 50  # where repeats are
FIRST_SEED = 100_000
MANY = 40_000 if NIGHTLY else 300
LEVEL = 0.01


def most(share: float, sets: int = SETS) -> float:
    return share if NIGHTLY else common.most(share, sets)


def least(share: float, sets: int = SETS) -> float:
    return share if NIGHTLY else common.least(share, sets)


def resized(made, constant=1.0, by_pose=1.0, scatter=1.0):
    """The same misses, each part so many times as large; scatter: one number or (3,)."""
    own = scatter * (made.misses - made.constant_m - made.by_pose_m)
    same, moving = constant * made.constant_m, by_pose * made.by_pose_m
    return replace(made, misses=same + moving + own, constant_m=same, by_pose_m=moving)


@cache
def shares(kind: str, n: int | None = None, poses: bool = True, **sizes) -> Counter[str]:
    """Of each verdict on sets of n trials, or of 5 to 30 in turn."""
    found: Counter[str] = Counter()
    for i in range(SETS):
        made = resized(simulate_misses(kind, n or 5 + i % 26, FIRST_SEED + i), **sizes)
        found[attribute(made.misses, made.T_base_gripper if poses else None).verdict] += 1 / SETS
    return found


# --- verdicts ---


@pytest.mark.parametrize("poses", [True, False])
@pytest.mark.parametrize("kind", ["perception", "pose_dependent", "cannot_tell_yet"])
def test_what_is_no_calibration_error_is_rarely_called_one(kind, poses):
    assert shares(kind, poses=poses)["calibration"] <= most(0.02)


@pytest.mark.parametrize("poses", [True, False])
@pytest.mark.parametrize(("trials", "share"), [(10, 0.80), (20, 0.97)])
def test_a_bias_of_3_mm_under_2_mm_of_scatter_is_found(trials, share, poses):
    assert shares("calibration", trials, poses)["calibration"] >= least(share)


def test_an_arm_error_is_found_from_the_poses_and_nothing_else_is_blamed_on_the_arm():
    assert shares("pose_dependent", poses=True)["pose_dependent"] >= least(0.70)
    assert shares("perception", poses=True)["pose_dependent"] <= most(0.02)
    assert shares("calibration", 20, True)["pose_dependent"] <= most(0.02)


def test_perception_is_said_once_enough_trials_rule_out_the_rest():
    # a mean of p < 0.05, which chance makes, holds it back
    assert shares("perception", 25)["perception"] >= least(0.90)
    assert "perception" not in shares("perception", 6)


def test_uneven_scatter_as_of_depth_is_not_taken_for_a_constant():
    assert shares("perception", scatter=(0.5, 0.5, 2.0))["calibration"] <= most(0.02)


def test_a_small_bias_across_large_depth_noise_is_found_by_hotelling():
    rng = np.random.default_rng(FIRST_SEED)
    misses = np.array([0.0015, 0, 0]) + rng.standard_normal((20, 3)) * (0.0006, 0.0006, 0.008)
    found = attribute(misses)
    assert found.evidence.mean.p_pooled > 0.05
    assert found.evidence.mean.p_t2 < 1e-4
    assert found.verdict == "calibration"


def test_an_unfinished_verdict_says_how_many_trials_would_settle_it():
    undecided = [simulate_misses("perception", 8, FIRST_SEED + i) for i in range(30)]
    more = [attribute(made.misses, made.T_base_gripper).more_trials for made in undecided]
    n = 8 + int(np.median([m for m in more if m]))
    assert 14 <= n <= 22
    assert shares("perception", n)["perception"] >= least(0.60)  # half is the aim
    settled = attribute(simulate_misses("calibration", 30, FIRST_SEED).misses)
    assert settled.more_trials == 0
    hopeless = np.random.default_rng(1).standard_normal((10, 3)) * 0.1
    assert attribute(hopeless).more_trials is None


def test_a_constant_is_not_blamed_on_the_calibration_while_the_pose_may_explain_it():
    blamed, unsure = Counter(), []
    for i in range(100):
        made = resized(simulate_misses("pose_dependent", 6, FIRST_SEED + i), scatter=0.5)
        misses = made.misses + np.array([0.005, 0, 0])  # the arm's error is nowhere zero
        found = attribute(misses, made.T_base_gripper)
        blamed["without poses"] += attribute(misses).verdict == "calibration"
        blamed["with poses"] += found.verdict == "calibration"
        if "follow the pose" in found.says:
            unsure.append(found)
    assert blamed["with poses"] <= 0.7 * blamed["without poses"]
    assert unsure
    assert all(found.verdict == "cannot_tell_yet" and found.more_trials > 0 for found in unsure)


def test_a_small_constant_is_seldom_called_perception():
    """The interval of a mean of 2 mm still leaves zero out at 95 % in most sets that miss 99 %."""
    assert shares("calibration", 12, constant=2 / 3, scatter=0.75)["perception"] <= most(0.06)
    doubtful = np.random.default_rng(3).standard_normal((40, 3)) * 0.002
    doubtful += np.array([0.0011, 0, 0]) - doubtful.mean(axis=0)
    found = attribute(doubtful)
    assert LEVEL < found.evidence.mean.p_value < 0.05
    assert found.evidence.constant.power(0.003, 40) > 0.99
    assert found.verdict == "cannot_tell_yet"
    assert found.more_trials > 0


def test_in_one_place_a_constant_is_not_told_from_an_error_of_the_arm():
    made = simulate_misses("calibration", 12, FIRST_SEED)
    poses = np.repeat(made.T_base_gripper[:1], 12, axis=0)
    found = attribute(made.misses, poses)
    assert found.evidence.p_pose is None
    assert found.verdict == "cannot_tell_yet"
    assert "too near" in found.says
    assert "in other places" in found.remedy
    assert found.more_trials >= 5
    assert "not ruled out" in repr(found)
    known = attribute(made.misses)
    assert known.verdict == "calibration"
    assert "not ruled out" in repr(known)
    few = [0.003, 0, 0] + 0.5e-3 * np.random.default_rng(1).standard_normal((5, 3))
    assert "too near" in attribute(few, poses[:5]).says
    exact = np.tile([0.003, 0, 0], (12, 1))
    assert attribute(exact, poses).verdict == "cannot_tell_yet"


@pytest.mark.parametrize(("apart_m", "low", "high"), EXPECTED["blamed_by_distance"])
def test_the_nearer_the_places_the_less_a_constant_is_blamed_on_the_calibration(apart_m, low, high):
    blamed = 0
    for i in range(100):
        made = simulate_misses("calibration", 15, FIRST_SEED + i)
        poses = made.T_base_gripper.copy()
        middle = poses[:, :3, 3].mean(axis=0)
        off = poses[:, :3, 3] - middle
        poses[:, :3, 3] = middle + off * apart_m / np.sqrt((off**2).sum(axis=1).mean())
        blamed += attribute(made.misses, poses).verdict == "calibration"
    assert low <= blamed / 100 <= high


def test_the_numbers_are_those_of_the_textbook():
    made = simulate_misses("calibration", 12, FIRST_SEED)
    found, x = attribute(made.misses, made.T_base_gripper), made.misses
    S = (x - x.mean(0)).T @ (x - x.mean(0)) / 11
    t2 = 12 * x.mean(0) @ np.linalg.inv(S) @ x.mean(0)
    assert found.evidence.mean.t2 == pytest.approx(t2, rel=1e-9)
    assert found.evidence.mean.p_t2 == pytest.approx(f.sf(t2 * 9 / 33, 3, 9), rel=1e-9)
    half = t.ppf(0.975, 11) * x.std(0, ddof=1) / np.sqrt(12)
    np.testing.assert_allclose(found.interval_m[:, 1] - found.mean_m, half, rtol=1e-9)
    np.testing.assert_allclose(found.scatter_m, x.std(0, ddof=1), rtol=1e-12)


# --- repeats ---


def repeated(places, repeats, seed, kind="own", scatter_m=None, own_m=0.002):
    """Misses and poses of trials in a few places, one after the other.

    "own": each place has an error of its own, own_m an axis, and repeats scatter by 0.5 mm; else
    what a kind of `simulate_misses` has, scattered by 2 mm.
    """
    made = simulate_misses("perception" if kind == "own" else kind, places, FIRST_SEED + seed)
    rng = np.random.default_rng([FIRST_SEED, seed, places, repeats])
    place = np.repeat(np.arange(places), repeats)
    own = own_m * rng.standard_normal((places, 3)) if kind == "own" else made.by_pose_m
    usual_m = 0.0005 if kind == "own" else 0.002
    scatter = (usual_m if scatter_m is None else scatter_m) * rng.standard_normal((len(place), 3))
    return made.constant_m + own[place] + scatter, made.T_base_gripper[place]


@cache
def repeated_shares(places: int, repeats: int, sets: int = SOME, **options) -> Counter[str]:
    found: Counter[str] = Counter()
    for i in range(sets):
        found[attribute(*repeated(places, repeats, i, **options)).verdict] += 1 / sets
    return found


@pytest.mark.parametrize(("places", "repeats", "share"), EXPECTED["found_by_repeats"])
def test_errors_of_places_that_follow_no_regression_are_found_by_repeats(places, repeats, share):
    found = repeated_shares(places, repeats)
    assert found["pose_dependent"] >= least(share, SOME)
    assert found["calibration"] <= most(0.02, SOME)


@pytest.mark.parametrize(("places", "repeats"), [(3, 2), (4, 3), (8, 3)])
def test_repeated_scatter_is_blamed_on_nothing_else(places, repeats):
    found = repeated_shares(places, repeats, kind="perception")
    assert max(found["pose_dependent"], found["calibration"]) <= most(0.02, SOME)


def test_repeated_constants_are_those_of_the_calibration():
    for places, repeats, scatter_m in ((8, 3, 0.002), (10, 2, 0.002), (5, 3, 0.001)):
        found = repeated_shares(places, repeats, kind="calibration", scatter_m=scatter_m)
        assert found["calibration"] >= least(0.95, SOME)


def test_weak_errors_of_few_places_do_not_pass_for_a_constant():
    """A mean of 15 trials in 3 places is one of 3 if the places differ."""
    sets = 400 if NIGHTLY else 100
    assert repeated_shares(3, 5, sets, own_m=0.0005)["calibration"] <= most(0.05, sets)


def test_perception_rests_on_the_repeats_where_there_are_any():
    found = repeated_shares(8, 3, kind="perception", scatter_m=0.0015)
    assert found["perception"] >= least(0.90, SOME)
    found = [attribute(*repeated(10, 2, i, kind="perception")) for i in range(50)]
    by_repeats = [one.evidence.by_place.power(0.003, 20) for one in found]
    by_regression = [one.evidence.by_pose.power(0.003, 20) for one in found]
    assert np.median(by_repeats) < 0.8
    assert np.median(by_regression) > 0.95  # which would do alone
    assert sum(one.verdict == "cannot_tell_yet" for one in found) >= 40
    for one, power_of_repeats in zip(found, by_repeats, strict=True):
        assert one.evidence.pose.p_value >= one.evidence.p_pose / 2
        assert power_of_repeats >= 0.9 or one.verdict != "perception"


def test_the_words_name_the_places_and_their_own_p_value():
    found = attribute(*repeated(8, 3, 1))
    seen = found.evidence
    assert seen.p_pose == pytest.approx(min(1, 2 * min(seen.pose.p_value, seen.places.p_value)))
    assert "from place to place" in found.says
    text = repr(found)
    assert max(map(len, text.splitlines())) <= 88
    for words in ("8 places repeated, 24 trials", "p < 0.001", "place to place", "repeats in one"):
        assert words in text.replace("\n    ", " ").replace("\n  ", " ")
    assert "No turn, scale or shift" in found.remedy
    slipped = repeated(12, 2, 1, "pose_dependent", 0.0005)
    assert "joint zeros" in attribute(*slipped).remedy
    assert Entry.of(found, "cube").p_pose == seen.p_pose


def test_the_place_test_is_the_one_way_analysis_of_variance_on_one_axis():
    misses, poses = repeated(4, 3, 2)
    misses = misses * [1.0, 0, 0]
    found = place_test(misses, poses, LEVEL)
    groups = misses[:, 0].reshape(4, 3)
    assert found.axes == pytest.approx(1)
    assert found.p_value == pytest.approx(f_oneway(*groups).pvalue, rel=1e-6)
    assert found.S[0, 0] == pytest.approx(np.mean(groups.var(axis=1, ddof=1)))
    np.testing.assert_allclose(np.sort(found.means_m[:, 0]), np.sort(groups.mean(axis=1)))


@pytest.mark.parametrize(("places", "repeats"), [(3, 2), (5, 2), (3, 5), (8, 3)])
@pytest.mark.parametrize("scatter", [(1, 1, 1), (1, 1, 3), (1, 4, 4)])
def test_the_level_of_the_place_test(scatter, places, repeats):
    rng = np.random.default_rng([FIRST_SEED, places, repeats, *scatter])
    _, poses = repeated(places, repeats, 0)
    rows = rng.standard_normal((MANY // 2, places * repeats, 3)) * scatter * 1e-3
    rejected = sum(place_test(row, poses, LEVEL).p_value < LEVEL for row in rows)
    assert rejected / len(rows) <= common.most(0.019, len(rows))


def test_places_are_told_apart_by_where_and_how_the_hand_is():
    rng = np.random.default_rng(FIRST_SEED)
    _, poses = repeated(6, 3, 0)
    poses[:, :3, 3] += rng.uniform(-0.002, 0.002, (18, 3))
    turns = Rotation.from_rotvec(rng.uniform(-0.01, 0.01, (18, 3))).as_matrix()
    poses[:, :3, :3] = poses[:, :3, :3] @ turns
    order, find_places = rng.permutation(18), significance.find_places
    place = find_places(poses[order])[np.argsort(order)].reshape(6, 3)
    assert (place == place[:, :1]).all()
    assert len(set(place[:, 0])) == 6
    far, turned = poses[[0, 0]].copy(), poses[[0, 0]].copy()
    far[1, 0, 3] += 0.012
    turned[1, :3, :3] = turned[1, :3, :3] @ Rotation.from_rotvec([0, 0, 0.06]).as_matrix()
    assert len(set(find_places(far))) == len(set(find_places(turned))) == 2
    chain = np.repeat(poses[:1], 40, axis=0)
    chain[:, 0, 3] += 0.004 * np.arange(40)  # each is near the next
    assert len(set(find_places(chain))) >= 14


def test_too_few_repeats_are_not_tested():
    made = simulate_misses("perception", 12, FIRST_SEED + 1)
    assert place_test(made.misses, made.T_base_gripper, LEVEL) is None
    assert place_test(*repeated(2, 5, 0), LEVEL) is None
    mostly_once = np.concatenate([repeated(3, 2, 0)[1], made.T_base_gripper])
    misses = np.random.default_rng(1).standard_normal((18, 3)) * 1e-3
    assert place_test(misses, mostly_once, LEVEL) is None
    found = place_test(misses[:10], mostly_once[:10], LEVEL)
    assert (found.places, found.trials) == (3, 6)


# --- words and input ---


def test_two_trials_are_too_few_and_it_says_so():
    made = simulate_misses("calibration", 2, FIRST_SEED)
    for poses in (None, made.T_base_gripper):
        found = attribute(made.misses, poses)
        assert found.verdict == "cannot_tell_yet"
        assert "2 trials decide nothing" in found.says
        assert found.more_trials >= 3
        assert 0 < found.evidence.mean.p_value <= 1
        assert "CANNOT TELL YET (2 trials)" in repr(found)
        assert "more would settle it" in repr(found)


def test_misses_without_scatter_are_no_trouble():
    same = np.tile([0.003, 0, 0], (8, 1))
    assert attribute(same).verdict == "calibration"
    assert attribute(same).evidence.mean.p_t2 is None
    made = simulate_misses("perception", 8, FIRST_SEED)
    assert attribute(same, made.T_base_gripper).verdict == "calibration"
    assert attribute(np.zeros((8, 3))).evidence.mean.p_value == 1.0
    misses, poses = repeated(4, 3, 0, scatter_m=0.0)
    assert attribute(misses, poses).verdict == "pose_dependent"
    same = np.tile([0.003, 0, 0], (12, 1))
    assert attribute(same, poses).verdict == "calibration"
    assert attribute(0 * same, poses).verdict == "perception"


# --- the tests behind it ---


@pytest.mark.parametrize("n", [5, 8, 10, 25])
@pytest.mark.parametrize("scatter", [(1, 1, 1), (1, 1, 3), (1, 4, 4)])
def test_the_level_of_the_mean_test(scatter, n):
    rng = np.random.default_rng([FIRST_SEED, n, *scatter])
    rows = rng.standard_normal((MANY, n, 3)) * scatter * 1e-3
    rejected = sum(mean_test(row).p_value < LEVEL for row in rows)
    assert common.least(0.003, MANY) <= rejected / MANY <= common.most(0.019, MANY)


def test_the_level_of_the_pose_test_under_scatter_far_from_normal():
    rng = np.random.default_rng(FIRST_SEED)
    columns = pose_columns(simulate_misses("perception", 8, FIRST_SEED).T_base_gripper)
    rows = rng.standard_t(2, (MANY // 2, 8, 3)) * 1e-3
    rejected = np.mean([pose_test(row, columns, shuffles=400).p_value <= 0.05 for row in rows])
    assert common.least(0.05, len(rows)) <= rejected <= common.most(0.05, len(rows))


@pytest.mark.parametrize("scatter", [(1, 1, 1), (1, 1, 2)])
def test_the_stated_power_is_the_share_found(scatter):
    """Of the pooled test alone, with the scatter known; for a bias in any direction."""
    n, size, S = 10, 1.5e-3 * np.sqrt(np.mean(np.square(scatter))), np.diag(np.square(scatter))
    axes = np.trace(S) ** 2 / np.trace(S @ S)
    rng = np.random.default_rng(FIRST_SEED)
    bias = rng.standard_normal((MANY, 1, 3))
    bias *= size / np.linalg.norm(bias, axis=2, keepdims=True)
    rows = bias + 1e-3 * rng.standard_normal((MANY, n, 3)) * scatter
    level = LEVEL * significance.POOLED_SHARE
    found = np.mean([mean_test(row).p_pooled < level for row in rows])
    stated = significance.power_of_test(size, 1e-6 * S, axes, n, 3, 0, level)
    assert stated == pytest.approx(found, abs=0.06)


def test_the_power_for_even_scatter_is_the_noncentral_f():
    S, power = 4e-6 * np.eye(3), significance.power_of_test
    for used, columns, left in ((3, 0, 27), (7, 3, 20)):
        wanted = ncf.sf(f.isf(LEVEL, used, left), used, left, 22.5)
        assert power(0.003, S, 3.0, 10, used, columns, LEVEL) == pytest.approx(wanted)
    assert power(0.003, S, 3.0, 3, 7, 3, LEVEL) == 0.0


def test_the_regression_names_the_group_that_made_the_misses():
    made = resized(simulate_misses("perception", 20, FIRST_SEED), scatter=0.1)
    poses = made.T_base_gripper
    columns = pose_columns(poses)
    turn, scale = np.cross([0, 0, 0.01], poses[:, :3, 3]), 0.01 * poses[:, :3, 3]
    gripper = poses[:, :3, :3] @ [0, 0.003, 0]
    causes = {"a turn of the base": turn, "a scale": scale, "the gripper": gripper}
    for name, part in causes.items():
        found = pose_test(made.misses + part, columns)
        assert max(found.shares, key=found.shares.get) == name
        varying = np.sqrt(((part - part.mean(0)) ** 2).sum(1).mean())
        assert found.part_m == pytest.approx(varying, rel=0.1)
        assert found.p_value < LEVEL


# --- simulated misses ---


def test_each_unit_has_four_sets_of_its_own_one_of_each_kind():
    kinds = {}
    for unit in (7, 3):
        sets = four_sets(unit)
        said = {name: attribute(s.misses, s.T_base_gripper).verdict for name, s in sets.items()}
        assert sorted(said.values()) == sorted(REMEDY)
        kinds[unit] = [*said.values()]
    assert kinds[7] != kinds[3]


def test_an_arm_error_is_as_large_as_said_and_has_no_constant_over_the_table():
    made = simulate_misses("pose_dependent", 397, FIRST_SEED)
    assert np.sqrt((made.by_pose_m**2).sum(axis=1).mean()) == pytest.approx(0.004, rel=0.05)
    assert np.linalg.norm(made.by_pose_m.mean(axis=0)) < 5e-4
    regression = pose_test(made.by_pose_m, pose_columns(made.T_base_gripper))
    assert regression.part_m > 0.0035  # seven numbers explain slipped joints, near enough
    own = np.random.default_rng(1).standard_normal((397, 3)) * 0.003 / np.sqrt(3)
    assert pose_test(own, pose_columns(made.T_base_gripper)).part_m < 6e-4


# --- the ledger ---

BUDGET = Entry("2026-01-01T10:00:00+00:00", "25 mm cube", "Simulated D435", 1.22, 5.0, 9.1, 7.5)


def test_the_budget_is_the_first_row_and_trials_follow(tmp_path):
    ledger = Ledger(tmp_path / "new" / "ledger.csv")
    assert ledger.read() == ()
    ledger.append(BUDGET)
    made = simulate_misses("calibration", 20, FIRST_SEED)
    row = Entry.of(attribute(made.misses, made.T_base_gripper), "25 mm cube", tolerance_mm=7.5)
    ledger.append(row)
    first, second = ledger.read()
    assert first == BUDGET
    assert second.verdict == "calibration"
    assert second.trials == 20
    assert second.mean_x_mm == pytest.approx(1e3 * made.misses[:, 0].mean(), rel=1e-5)
    assert "25 mm cube" in repr(ledger)
    assert ledger.path.read_text("utf-8").startswith(EXPECTED["ledger_header"])


@pytest.mark.parametrize("text", EXPECTED["texts_of_a_ledger"])
def test_text_comes_back_and_no_cell_is_a_formula(tmp_path, text):
    ledger = Ledger(tmp_path / "ledger.csv")
    row = replace(BUDGET, task=text, note=text, mean_x_mm=-1.25, trials=1234567)  # numbers stay
    ledger.append(row)
    assert ledger.read() == (row,)
    assert ",-1.25," in ledger.path.read_text("utf-8")
    with ledger.path.open(encoding="utf-8", newline="") as file:
        cell = list(csv.reader(file))[1][1]
    assert not cell.lstrip().startswith(("=", "+", "-", "@", "＝"))


@pytest.mark.parametrize(("content", "words"), EXPECTED["damaged_ledgers"])
def test_a_damaged_ledger_is_named_and_left_alone(tmp_path, content, words):
    ledger = Ledger(tmp_path / "ledger.csv")
    content = content.replace("HEADER", ",".join(LEDGER_HEADER)).encode("latin-1")
    ledger.path.write_bytes(content)
    for act in (ledger.read, lambda: ledger.append(BUDGET)):
        with pytest.raises(ValueError, match=rf"ledger\.csv.*{words}"):
            act()
    assert ledger.path.read_bytes() == content


def test_a_spreadsheet_may_have_saved_it_with_a_mark_and_other_line_ends(tmp_path):
    ledger = Ledger(tmp_path / "ledger.csv")
    ledger.append(BUDGET)
    text = ledger.path.read_bytes()
    ledger.path.write_bytes(b"\xef\xbb\xbf" + text.replace(b"\n", b"\r\n").removesuffix(b"\r\n"))
    ledger.append(BUDGET)
    assert ledger.read() == (BUDGET, BUDGET)


def test_writers_at_the_same_time_lose_no_row(tmp_path):
    def write(number: int) -> None:
        for _ in range(10):
            Ledger(tmp_path / "ledger.csv").append(replace(BUDGET, note=f"writer {number}"))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(write, range(4)))
    notes = Counter(row.note for row in Ledger(tmp_path / "ledger.csv").read())
    assert notes == {f"writer {number}": 10 for number in range(4)}


def test_a_write_that_fails_leaves_the_ledger_as_it_was(tmp_path, monkeypatch):
    ledger = Ledger(tmp_path / "ledger.csv")
    ledger.append(BUDGET)
    before = ledger.path.read_bytes()

    def full(*_: object) -> None:
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        patch.setattr("pathlib.Path.replace", full)
        with pytest.raises(OSError, match="no space"):
            ledger.append(BUDGET)
    assert ledger.path.read_bytes() == before
    assert not list(tmp_path.glob("*.part")) + list(tmp_path.glob(".*.part"))
    ledger.append(BUDGET)  # the lock was given back
    assert len(ledger.read()) == 2


# --- what is refused ---


ZEROS = np.zeros((5, 3))


def attributed(misses=ZEROS, **options):
    return attribute(misses, **options)


def simulated(kind="calibration", n=5):
    return simulate_misses(kind, n, FIRST_SEED)


def entry(**changes):
    return replace(BUDGET, **changes)


FAR = np.tile(np.eye(4) + 300 * np.eye(4, k=3), (5, 1, 1))
test_what_cannot_be_is_refused = refusals(
    *each("misses: got shape", attributed, "misses", np.zeros((5, 2))),
    *each("misses: .* 2 trials or more", attributed, "misses", np.zeros((1, 3))),
    *each("misses: .* finite", attributed, "misses", np.full((5, 3), np.nan)),
    *each("millimetres", attributed, "misses", np.ones((5, 3))),
    *each("one .* for each of 5", attributed, "poses", np.tile(np.eye(4), (4, 1, 1))),
    *named(attributed, matters_m=[3.0], poses=[np.zeros((5, 4, 4))]),
    *each("are these millimetres", attributed, "poses", FAR),
    *named(simulated, kind=["weather"], n=[0, 2.5]),
    *named(entry, task=[""], note=["two\nlines", "nul\0", "x" * 501]),
    *named(entry, noise_mm=[np.nan], trials=[2.5], success=["high"]),
    ("entry: got dict", lambda: Ledger(Path("ledger.csv")).append({})),
)
