"""Grading: honest work gets full points, a changed number is noticed, a mistake gets its name."""

import json
import math
import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import sample_submissions as samples
from common import NIGHTLY
from hostile_bundles import BUNDLES
from hypothesis import given, settings
from hypothesis import strategies as st
from sample_submissions import DISTANCES, honest, with_part, with_row
from scipy.optimize import curve_fit
from scipy.stats import norm

from coursekit import cli
from coursekit.stereo import window_stats
from coursekit.submission import rubric
from coursekit.submission.flags import Fingerprint, as_json, copies, fingerprint
from coursekit.submission.format import Claims, Conclusion, Plot, Stack, Submission
from coursekit.submission.recompute import MISTAKES, RULES, WHY, grading_rules, recompute
from coursekit.submission.report import page_body
from coursekit.submission.rubric import JUDGES, Item, grade, shortcomings

MANY = 8 if NIGHTLY else 1
FIELDS = {topic: field for topic, (field, _) in JUDGES.items()}
GOOD = honest(0)
EXACT = samples.exact(GOOD)  # every claim in the middle of its tolerance
MISTAKEN = samples.mistaken(0)


def item(submission: Submission, topic: str, i: int = 0) -> Item:
    """The i-th item of a topic."""
    return samples.items(submission, topic)[i]


def not_right(items) -> list[str]:
    """What is said of the items that cost points."""
    return [item.says for item in items if item.verdict != "right"]


# --- honest work ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(200 if NIGHTLY else 6))
def test_honest_work_gets_full_points_and_no_flag(seed):
    result = grade(honest(seed, of_camera={"depth_scale_m": (1e-3, 1e-4)[seed % 2]}))
    assert not_right(result.items) == []
    assert result.points == result.of == 100
    assert result.flags == ()


def rounded_std(sigma):
    """Std of Gaussian numbers that are rounded to whole ones, over all places of their mean."""
    whole, places = np.arange(-30, 31)[:, None], (np.arange(64) - 31.5) / 64
    part = norm.cdf(whole + 0.5, places, sigma) - norm.cdf(whole - 0.5, places, sigma)
    return np.sqrt(((part * whole**2).sum(axis=0) - (part * whole).sum(axis=0) ** 2).mean())


@pytest.mark.parametrize("seed", range(5))
def test_what_is_recomputed_is_what_other_code_says_of_the_raw_stacks(seed):
    """To half a printed digit: bias, std and invalid part; and the law that their slope gives."""
    whole = honest(seed)
    found, at, stds, errors = recompute(whole), [], [], []
    for measured, stack in zip(found.at, whole.stacks, strict=True):
        z = np.where(stack.counts > 0, 1.0 * stack.counts, np.nan)  # mm, as a count is one
        dof = np.isfinite(z).sum(axis=0) - 1
        squares = np.nansum((z - np.nanmean(z, axis=0)) ** 2, axis=0)
        stds.append(math.sqrt(squares[dof > 0].sum() / dof[dof > 0].sum()))
        v, u = np.indices(z.shape[1:]) - (np.array(z.shape[1:]) - 1)[:, None, None] / 2
        plane = np.column_stack([np.ones(u.size), u.ravel(), v.ravel()])  # flat in 1 / z
        seen = (dof >= 0).ravel()
        level = np.linalg.lstsq(plane[seen], 1 / np.nanmean(z, axis=0).ravel()[seen])[0][0]
        bias = 1 / level - 1e3 * stack.distance_m
        assert measured.std.value == pytest.approx(stds[-1], abs=5e-4)
        assert measured.bias.value == pytest.approx(bias, abs=5e-3)
        assert measured.invalid.value == pytest.approx(np.mean(stack.counts == 0), abs=1e-12)
        at.append(stack.distance_m)
        errors.append(measured.std.se)

    def law(z, log_c, exponent):
        return [rounded_std(math.exp(log_c) * one**exponent) for one in z]

    (_, exponent), _ = curve_fit(law, at, stds, (1.0, 2.0), errors)
    assert found.free.exponent == pytest.approx(exponent, abs=0.1)


def test_repeated_measurements_lie_within_their_standard_errors():
    """The tolerances come from these errors, so they must be true ones."""
    facts, stds = samples.camera(0, depth_scale_m=1e-4), []
    for seed in range(16):
        counts = samples.depths(np.random.default_rng(seed), facts, 0.45, holes=0.0)
        stack = Stack(0.45, (400, 220, 40, 40), counts, np.arange(100) / 30)
        stds.append(recompute(replace(GOOD, camera=facts, stacks=(stack,))).at[0].std)
    errors = [std.se for std in stds]
    assert np.std([std.value for std in stds]) == pytest.approx(np.mean(errors), rel=0.35)


# --- every claimed number, inside and outside its tolerance ---------------------------------------


def moved(topic: str, i: int, by: float) -> Submission:
    """EXACT with one claimed number moved by so many of its tolerances."""
    if topic in FIELDS:
        now = getattr(EXACT.claims.rows[i], FIELDS[topic])
        return with_row(EXACT, i, **{FIELDS[topic]: now + by * item(EXACT, topic, i).tolerance})
    off, name = by * item(EXACT, topic).tolerance, f"{topic}_px".replace("exponent_px", "exponent")
    if topic != "sigma_d_interval":
        return with_part(EXACT, "claims", **{name: getattr(EXACT.claims, name) + off})
    ends = [end + off * (k == i) for k, end in enumerate(EXACT.claims.sigma_d_interval_px)]
    return with_part(EXACT, "claims", sigma_d_interval_px=tuple(ends))


NUMBERS = [(topic, i) for topic in FIELDS for i in range(3)]
NUMBERS += [("sigma_d", 0), ("exponent", 0), ("sigma_d_interval", 0), ("sigma_d_interval", 1)]


@pytest.mark.parametrize(("topic", "i"), NUMBERS)
def test_a_number_is_right_exactly_within_its_tolerance(topic, i):
    at = 0 if topic == "sigma_d_interval" else i
    assert item(EXACT, topic, at).verdict == "right"
    ends_meet = topic == "sigma_d_interval" and (1 if i == 0 else -1)
    for by in (-0.999, -0.5, 0.1, 0.999):
        off = by / 10 if by * ends_meet > 0 else by / 1.42 if topic.endswith("_se") else by
        assert item(moved(topic, i, off), topic, at).verdict == "right", by
    below = (-6,) if topic == "bias_se" else (-1.001, -1.5)  # apart from the tape's is right, too
    for by in (*below, 1.001, 1.5, 3, -10, 10, 1e4):
        one = item(moved(topic, i, by), topic, at)
        assert one.verdict != "right", by
        assert one.points < one.of


def test_the_tolerance_is_stated():
    for one in samples.items(EXACT):
        if one.tolerance is not None and one.topic != "exponent":
            assert re.search(r"\((± \S+|up to 1.4 times as .*) is accepted", one.says), one.says


def test_the_exponents_interval_is_compared_too():
    low, high = EXACT.claims.exponent_interval
    wide = item(with_part(EXACT, "claims", exponent_interval=(low - 3, high + 3)), "exponent")
    assert wide.verdict == "partial"
    assert "too wide" in wide.says
    assert item(with_part(EXACT, "claims", exponent=None), "exponent").verdict == "partial"
    two = with_part(replace(EXACT, stacks=EXACT.stacks[:2]), "claims", exponent=None)
    says = item(with_part(two, "claims", exponent_interval=None), "exponent").says
    assert "2 distances over a factor of 1.5" in says


@pytest.mark.parametrize("field", ["distances_m", "measured_mm", "predicted_mm"])
@pytest.mark.parametrize("i", range(3))
def test_every_number_of_the_plot_counts(field, i):
    values = list(getattr(EXACT.plot, field))
    values[i] *= 1.3
    assert item(with_part(EXACT, "plot", **{field: tuple(values)}), "plot").points < 11


def test_a_standard_error_counts_with_the_tapes_or_apart_from_it():
    measured = recompute(GOOD).at[1]
    both, apart = measured.bias_se_mm, measured.bias.se
    assert item(with_row(GOOD, 1, depth_bias_se_mm=apart), "bias_se", 1).verdict == "right"
    assert item(with_row(GOOD, 1, depth_bias_se_mm=2 * both), "bias_se", 1).points < 1


# --- mistakes with a name -------------------------------------------------------------------------


@pytest.mark.parametrize("mistake", MISTAKEN)
def test_a_mistake_is_named_and_keeps_a_part_of_its_points(mistake):
    topic, submission = MISTAKEN[mistake]
    items = samples.items(submission)
    found = [one for one in items if (one.topic, one.mistake) == (topic, mistake)]
    assert found, not_right(items)
    assert found[0].verdict == "partial"
    assert 0 < found[0].points < found[0].of


@pytest.mark.parametrize("how", samples.SLOPPY)
def test_a_sloppy_bundle_is_told_its_one_cause_and_no_other(how):
    """Of honest work with one thing wrong everywhere; seeds by day: one."""
    topics, code, make = samples.SLOPPY[how]
    given = set()
    for seed in range(3, 3 + (8 if NIGHTLY else 1)):
        good = honest(seed)
        changed = make(good, samples.graded(good).recomputed)
        wrong = [i for i in samples.items(changed) if i.verdict != "right"]
        assert {i.topic for i in wrong} <= topics, seed
        assert {i.mistake for i in wrong} <= {"", "close", code}, seed
        given |= {i.mistake for i in wrong}
    assert not code or code in given
    assert not topics or given


def test_every_item_has_one_sentence():
    for submission in (GOOD, samples.weak(2), *(wrong for _, wrong in MISTAKEN.values())):
        for one in samples.items(submission):
            assert one.says.endswith(".")
            assert "\n" not in one.says
            assert 0 <= one.points <= one.of
            assert (one.points == one.of) or one.verdict != "right"


def test_the_sentence_of_a_turned_sign():
    says = item(with_row(honest(11), 2, depth_bias_mm=2.06), "bias", 2).says
    assert says.startswith("Bias at 0.60 m: you say +2.06 mm, your raw depths say -2.06 mm (±")
    assert says.endswith("wrong because its sign is turned: bias is measured minus true.")


HOLED = MISTAKEN["sign"][1]  # has raw depths with holes


def test_the_grader_leaves_out_the_mismatches_that_the_notebook_leaves_out_and_says_how_many():
    _, spiked = MISTAKEN["mismatches"]
    stack = spiked.stacks[1]
    stats = window_stats(stack.counts, (0, 0, 40, 40), spiked.camera.depth_scale_m)
    left_out = stats.n_mismatches
    assert 12 <= left_out < 24  # 12 are made; of 160,000 honest samples a few are in the tails
    assert f"it holds {left_out} mismatches" in item(spiked, "std", 1).says
    right = with_row(spiked, 1, depth_std_mm=1e3 * stats.pixel_std_m)
    assert item(right, "std", 1).verdict == "right"
    assert item(right, "std", 1).says.endswith(f"right ({left_out} mismatches left out).")
    noise, without = (recompute(s).at[1].noise_of_mean_mm(100) for s in (spiked, HOLED))
    assert noise == pytest.approx(without, rel=0.02)


def test_the_largest_count_is_an_invalid_sample_for_the_grader_too():
    stacks = tuple(
        replace(stack, counts=np.where(stack.counts == 0, 65535, stack.counts))
        for stack in HOLED.stacks
    )
    ended, holed = (recompute(s).at[0] for s in (replace(HOLED, stacks=stacks), HOLED))
    assert ended.invalid.value == holed.invalid.value > 0
    assert ended.bias.value == holed.bias.value


def test_every_mistake_that_is_looked_for_has_its_words_and_every_word_a_mistake():
    source = Path(rubric.__file__).read_text(encoding="utf-8")
    keys = set(re.findall(r'_Mistake\(\s*"([\w.]+)"', source))
    assert len(keys) > 20
    assert keys <= set(WHY)
    for key in WHY:  # "sign", "exponent.sign" of a topic, "ever.frames" in one way
        assert {key, key.partition(".")[2]} & set(re.findall(r'"([\w.]+)"', source)), key
        assert set(key.split(".")) & set(MISTAKES), key


def test_every_mistake_has_a_credit_and_a_sample_and_points_are_a_hundred():
    credit, points = grading_rules()["credit"], grading_rules()["points"]
    assert set(credit) == set(MISTAKES) == set(MISTAKEN)
    assert all(0 < part < 1 for part in credit.values())
    each = sum(points[topic] for topic in ("data", *FIELDS))
    assert 3 * each + sum(points.values()) - each == 100


# --- the plot ---

FACTORS = {1: "", 0.7: "", 1.6: "", 0.4: "off_scale", 2.5: "off_scale", 1e-3: "metres"}


@pytest.mark.parametrize(("factor", "mistake"), [*FACTORS.items(), (1e3, "off_scale")])
def test_a_prediction_is_right_within_a_factor(factor, mistake):
    found = item(samples.predicting(EXACT, factor), "plot")
    assert (found.verdict, found.mistake) == ("partial" if mistake else "right", mistake)
    if mistake == "metres":
        assert found.says.endswith("but the prediction is in metres: 1 m is 1000 mm.")


def test_no_prediction_is_none_and_keeps_little():
    silent = with_part(EXACT, "plot", predicted_mm=None)
    found = item(silent, "plot")
    assert (found.points, found.verdict, found.mistake) == (2.2, "partial", "no_prediction")
    assert "without your prediction" in found.says
    assert shortcomings(silent) == (found.says,)
    two = Plot(EXACT.plot.distances_m[:2], EXACT.plot.measured_mm[:2], None)
    found = item(replace(EXACT, plot=two), "plot")
    assert (found.points, found.mistake) == (1.47, "no_prediction")
    assert found.says.endswith("0.60 m missing and without your prediction.")
    assert page_body(samples.graded(silent), silent)
    assert item(replace(EXACT, plot=Plot((), (), ())), "plot").verdict == "missing"


def test_a_wrong_std_is_named_once():
    near, middle, far = EXACT.plot.measured_mm
    only_there = with_part(EXACT, "plot", measured_mm=(near, 10 * middle, far))
    wrong = with_row(only_there, 1, depth_std_mm=10 * middle)
    assert [says.partition(":")[0] for says in shortcomings(wrong)] == ["Std of depth at 0.45 m"]
    assert item(wrong, "plot").verdict == "right"
    assert item(only_there, "plot").verdict == "partial"  # not in the table: the plot's own fault


# --- typing errors in rubric.toml ---


@pytest.mark.parametrize(("old", "new", "message"), BUNDLES["typing_errors"])
def test_a_typing_error_in_the_rubric_is_one_line(old, new, message, tmp_path, monkeypatch, capsys):
    content = RULES.read_text(encoding="utf-8")
    assert content.count(old) == 1
    broken, out = tmp_path / "rubric.toml", tmp_path / "out"
    broken.write_text(content.replace(old, new + "#" * (old[-1] == " ")), encoding="utf-8")
    out.mkdir()
    (out / "grades.csv").write_text("good", encoding="utf-8")
    monkeypatch.setattr("coursekit.submission.recompute.RULES", broken)
    grading_rules.cache_clear()
    try:
        with pytest.raises(ValueError, match=message) as raised:
            grading_rules()
        assert "\n" not in str(raised.value)
        assert cli.main(["grade", str(tmp_path), "--out", str(out), "--overwrite"]) == 1
        assert capsys.readouterr().err == f"coursekit: {raised.value}\n"
        assert [path.read_text(encoding="utf-8") for path in out.iterdir()] == ["good"]
    finally:
        grading_rules.cache_clear()


# --- what is missing, or cannot be compared -------------------------------------------------------


def test_an_empty_bundle_gets_nothing_and_claims_without_raw_depths_are_not_believed():
    silent = replace(GOOD, claims=Claims(), plot=None, conclusion=Conclusion(), outcomes={})
    empty = grade(replace(silent, stacks=()))
    assert (empty.points, empty.of) == (0, 100)
    assert {one.verdict for one in empty.items} == {"missing"}
    assert copies({"one": empty.fingerprint, "two": empty.fingerprint}) == []
    assert grade(replace(GOOD, stacks=())).points <= 3  # the paragraph
    assert grade(silent).points == 11  # data, and no exponent


def test_a_camera_without_a_baseline_loses_what_needs_one():
    blind = with_part(GOOD, "claims", sigma_d_px=None, sigma_d_interval_px=None)
    result = grade(with_part(blind, "camera", baseline_m=None))
    assert (result.points, result.of) == (93, 100)
    assert "without the camera's baseline" in not_right(result.items)[0]


def test_other_distances_nearby_count_and_further_ones_are_compared_only():
    facts, random = GOOD.camera, np.random.default_rng(3)
    at = (0.33, 0.45, 0.62, 0.90)
    stacks = samples.stacks_of(random, lambda z: samples.depths(random, facts, z), at)
    four = samples.finished(facts, stacks, "Four Distances")
    result = grade(four)
    assert not_right(result.items) == []
    assert result.points == result.of == 100
    assert [one.of for one in result.items if "0.90" in one.name] == 6 * [0]
    wrong = grade(with_row(four, 3, depth_std_mm=9.0))
    assert "wrong" in {one.verdict for one in wrong.items if "0.90" in one.name}


SAID = [("bias", 30, "right"), ("noise", 30, "partial"), ("bias", 1, "right"), (None, 1, "missing")]


@pytest.mark.parametrize(("said", "frames", "verdict"), SAID)
def test_the_conclusion_is_judged_by_the_students_own_depths(said, frames, verdict):
    strong = MISTAKEN["sign"][1]  # a bias of 7 mm
    strong = with_part(strong, "conclusion", dominates=said, frames=frames)
    assert item(strong, "verdict").verdict == verdict


@pytest.mark.parametrize("said", ["bias", "noise"])
def test_a_close_call_accepts_both(said):
    close = item(with_part(GOOD, "conclusion", dominates=said), "verdict")
    assert close.verdict == "right"  # a bias of 0.4 mm, a tape good for 1 mm
    assert "too close to call" in close.says


def test_frames_that_drift_together_average_less():
    measured = recompute(GOOD).at[1]
    one, many = measured.noise_of_mean_mm(1), measured.noise_of_mean_mm(100)
    assert one == measured.std.value
    assert one / 10 <= many < one / 2


def any_of(*values):
    return st.sampled_from(values)


@settings(max_examples=200 if NIGHTLY else 20, deadline=None)
@given(
    data=st.data(), seed=st.integers(0, 2**32), scale=any_of(1e-7, 1e-3, 1.0), much=st.booleans()
)
def test_no_raw_depths_make_the_grader_fail(data, seed, scale, much):
    random, stacks = np.random.default_rng(seed), []
    for i in range(data.draw(st.integers(1, 4))):
        shape = data.draw(st.tuples(any_of(1, 2, 5, 12), any_of(1, 2, 9), any_of(1, 3, 9)))
        low = data.draw(any_of(0, 1, 500, 65_535))
        high = data.draw(any_of(low, min(low + 2, 65_535), 65_535))
        counts = random.integers(low, high, shape, np.uint16, endpoint=True)
        counts[random.random(shape) < data.draw(any_of(0.0, 0.3, 1.0))] = 0
        times = random.choice([0.0, 1.0, -1e12, 1e12], shape[0])
        stacks.append(Stack(0.1 + 0.2 * i, (0, 0, shape[2], shape[1]), counts, times))
    odd = replace(EXACT, stacks=tuple(stacks), claims=EXACT.claims if much else Claims())
    result = grade(with_part(odd, "camera", depth_scale_m=scale))
    assert 0 <= result.points <= result.of
    assert all(np.isfinite([one.points, one.of]).all() for one in result.items)
    json.dumps(json.loads(as_json(result.fingerprint)), allow_nan=False)


# --- flags ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", samples.DISHONEST)
def test_made_up_data_are_flagged_without_taking_points(kind):
    code, make = samples.DISHONEST[kind]
    result = grade(make(1))
    assert code in {flag.code for flag in result.flags}
    assert all(flag.says.endswith(".") for flag in result.flags)
    if kind not in ("too clean", "flat noise"):  # claims nobody could make honestly
        assert result.points > 90


@pytest.mark.parametrize("how", samples.INVENTIONS)
def test_invented_noise_is_flagged_however_much_care_it_took(how):
    """50 of 50 at night, and none of 50 honest ones; FORMAT.md says what cannot be known."""
    made = samples.INVENTIONS[how]
    for seed in range(50 if NIGHTLY else 1):
        flags = {flag.code for flag in grade(samples.made_up(made, seed)).flags}
        assert "even_noise" in flags
        assert ("same_pattern" in flags) == (how == "disparity")
        assert ("no_pattern" in flags) == (how != "disparity")
        assert samples.graded(honest(seed)).flags == ()


def test_a_recorded_clock_without_jitter_is_no_flag():
    played = with_part(samples.simulated_as_live("clock", 2), "camera", source="recorded")
    assert grade(played).flags == ()


def test_a_published_model_of_a_real_camera_is_not_called_flat():
    """Near the camera a D435's noise grows slowly: data/published_depth_noise.json."""
    facts, random = samples.camera(1), np.random.default_rng(1)

    def make(z):
        std = 0.000611 + 0.003587 * (z - 0.3515) ** 2
        sigma_d = std * facts.fx * facts.baseline_m / z**2
        return samples.depths(random, facts, z, sigma_d=sigma_d)

    assert grade(samples.finished(facts, samples.stacks_of(random, make), "Real")).flags == ()


# --- copies ---------------------------------------------------------------------------------------

SIMULATED = honest(3, of_camera=samples.SIMULATED)


print_of = cache(fingerprint)  # several tests look at one submission


@cache
def others() -> dict[str, Fingerprint]:
    """Fingerprints of strangers."""
    return {f"other {i}": fingerprint(honest(20 + i)) for i in range(5)}


def shared(one: Submission, two: Submission):
    """What is said of two submissions among strangers: a copy, and it is of these two."""
    found = copies({"one": print_of(one)} | others() | {"two": print_of(two)})
    assert [set(copy.keys) for copy in found] == [{"one", "two"}]
    return found[0]


COPIED = [(how, unit) for how in samples.COPIES for unit in (1e-3, 1e-4)]
BY_DAY = [case for k, case in enumerate(COPIED) if k % 4 in (0, 3)]  # each once, the units in turn


@pytest.mark.parametrize(("how", "unit"), COPIED if NIGHTLY else BY_DAY)
def test_a_copy_is_found_whichever_came_first(how, unit):
    original = honest(1, of_camera={"depth_scale_m": unit})
    copy = samples.copied(original, how)
    for found in (shared(original, copy), shared(copy, original)):
        assert found.code == ("identical" if how == "identical" else "nearly_identical")
        assert not found.note


SEED_22 = replace(SIMULATED, camera=replace(SIMULATED.camera, serial="seed-22"))
SAME_DEPTHS = {
    "two simulations": (SIMULATED, replace(SIMULATED, student="Two"), "gives everybody the same"),
    "another's seed": (SEED_22, replace(SEED_22, student="Two"), ""),
    "one as live": (SIMULATED, replace(SIMULATED, camera=samples.camera(3), student="Two"), ""),
    "handed in twice": (GOOD, replace(GOOD, student=GOOD.student.upper()), "of one student"),
    "one real camera": (GOOD, replace(GOOD, student="Two"), ""),
}


@pytest.mark.parametrize(("one", "two", "note"), SAME_DEPTHS.values(), ids=SAME_DEPTHS)
def test_the_same_by_right_is_a_note(one, two, note):
    found = shared(one, two)
    assert found.note == bool(note)
    assert note in found.says
    assert ("only if you gave them all this seed" in found.says) == (one is SEED_22)


def test_strangers_and_two_measurements_with_one_camera_at_one_place_are_not_copies():
    """The same pattern, but other noise: two students share a camera."""
    facts, prints = samples.camera(5), dict(others())
    pattern = 10 + np.rint(9 * np.random.default_rng(0).normal(0, 2, (40, 40)))
    for seed in (40, 41):
        random = np.random.default_rng(seed)
        stacks = [
            Stack(z, (400, 220, 40, 40), (counts + pattern).astype(np.uint16), np.arange(100) / 30)
            for z in DISTANCES
            for counts in [samples.depths(random, facts, z, holes=0.0)]
        ]
        prints[str(seed)] = fingerprint(replace(GOOD, stacks=stacks, student=str(seed)))
    assert copies(prints) == []


def test_a_fingerprint_goes_through_json():
    there = as_json(fingerprint(GOOD))
    assert len(there) < 25_000
    back = Fingerprint.from_dict(json.loads(there))
    found = copies(others() | {"a": fingerprint(GOOD), "b": back})
    assert [set(copy.keys) for copy in found] == [{"a", "b"}]


def test_many_bundles_of_one_camera_are_compared():
    """40 of one camera in one place, each different in its noise, and 80 copies of 5 of them."""
    random, base = np.random.default_rng(0), others()["other 0"]
    prints = {}
    for i in range(40 * MANY):
        stacks = tuple(
            replace(
                s,
                digest=f"{i} {k}",
                frames=random.integers(-127, 127, s.frames.shape, np.int8),
                values=tuple(range(100 * i, 100 * i + len(s.values))),
            )
            for k, s in enumerate(base.stacks)
        )
        prints[f"own {i}"] = replace(base, stacks=stacks, student=f"own {i}")
    for i in range(80 * MANY):
        prints[f"repeated {i}"] = replace(prints[f"own {i % (5 * MANY)}"], student=f"repeated {i}")
    found = copies(prints)
    assert [one.code for one in found] == 5 * MANY * ["identical"]
