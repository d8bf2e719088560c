"""Grading: honest work gets full points, a changed number is noticed, a mistake gets its name."""

from __future__ import annotations

import json
import os
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import sample_submissions as samples
from hypothesis import given, settings
from hypothesis import strategies as st

from coursekit import cli
from coursekit.submission import rubric
from coursekit.submission.flags import Fingerprint, copies, fingerprint
from coursekit.submission.format import Claims, Conclusion, Plot, Stack, Submission
from coursekit.submission.recompute import MISTAKES, RULES, grading_rules, recompute
from coursekit.submission.report import student_page
from coursekit.submission.rubric import Item, grade, judged, shortcomings

MANY = 8 if os.environ.get("COURSEKIT_NIGHTLY") == "1" else 1
FIELDS = {
    "bias": "depth_bias_mm",
    "bias_se": "depth_bias_se_mm",
    "std": "depth_std_mm",
    "std_se": "depth_std_se_mm",
    "invalid": "invalid_fraction",
}


@pytest.fixture(scope="module")
def good() -> Submission:
    """An honest submission."""
    return samples.honest(0)


@pytest.fixture(scope="module")
def exact(good: Submission) -> Submission:
    """Every claim in the middle of its tolerance, the exponent included."""
    return replace(good, claims=samples.exact_claims(recompute(good)))


def item(submission: Submission, topic: str, i: int = 0) -> Item:
    """The i-th item of a topic."""
    return [item for item in grade(submission).items if item.topic == topic][i]


# --- honest work ----------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(6))
def test_honest_work_gets_full_points_and_no_flag(seed: int) -> None:
    unit = {"depth_scale_m": (1e-3, 1e-4)[seed % 2]}
    result = grade(samples.honest(seed, of_camera=unit))
    assert [i.says for i in result.items if i.verdict != "right"] == []
    assert result.points == result.of == 100
    assert result.flags == ()


def test_check_says_nothing_about_honest_work(good: Submission) -> None:
    assert shortcomings(good) == ()


def test_check_is_the_graders_own_sentences() -> None:
    poor = samples.weak(1)
    says = shortcomings(poor)
    assert "0.60 m has 84 frames, 100 are needed." in says
    assert "0.30 m is missing: 100 frames of raw depth are needed there." in says
    assert says == tuple(i.says for i in grade(poor).items if i.verdict != "right")


def test_every_item_has_one_sentence(good: Submission) -> None:
    for submission in (good, samples.weak(2), *(s for _, s in MISTAKEN.values())):
        for one in samples.graded(submission).items:
            assert one.says.endswith(".")
            assert "\n" not in one.says
            assert 0 <= one.points <= one.of
            assert (one.points == one.of) or one.verdict != "right"


def test_the_recomputed_std_and_bias_are_what_numpy_says(good: Submission) -> None:
    for measured in recompute(good).at:
        z = measured.z_mm[:, np.isfinite(measured.z_mm).all(axis=0)]
        assert measured.std is not None
        assert measured.bias is not None
        pooled = float(np.sqrt(z.var(axis=0, ddof=1).mean()))
        assert measured.std.value == pytest.approx(pooled, rel=0.02)
        level = float(z.mean()) - 1e3 * measured.distance_m
        assert measured.bias.value == pytest.approx(level, abs=0.1)
        assert measured.invalid.value == (measured.stack.counts == 0).mean()


def test_repeated_measurements_lie_within_their_standard_errors() -> None:
    """The tolerances come from these errors, so they must be true ones."""
    stds, errors = [], []
    facts = samples.camera(0, depth_scale_m=1e-4)
    any_one = samples.honest(0)
    for seed in range(16):
        counts = samples.depths(np.random.default_rng(seed), facts, 0.45, holes=0.0)
        stack = Stack(0.45, (400, 220, 40, 40), counts, np.arange(100) / 30)
        measured = recompute(replace(any_one, camera=facts, stacks=(stack,))).at[0]
        assert measured.std is not None
        stds.append(measured.std.value)
        errors.append(measured.std.se)
    assert np.std(stds) == pytest.approx(np.mean(errors), rel=0.35)


# --- every claimed number, inside and outside its tolerance ---------------------------------------


def changed(submission: Submission, topic: str, i: int, by: float) -> Submission:
    """The submission with one claimed number moved by so many of its tolerances."""
    base = item(submission, topic, i if topic in FIELDS else 0)
    assert base.tolerance is not None
    if topic in FIELDS:
        now = getattr(submission.claims.rows[i], FIELDS[topic])
        return samples.with_row(submission, i, **{FIELDS[topic]: now + by * base.tolerance})
    if topic == "sigma_d_interval":
        ends = submission.claims.sigma_d_interval_px
        assert ends is not None
        moved = [end + by * base.tolerance * (k == i) for k, end in enumerate(ends)]
        return samples.with_claims(submission, sigma_d_interval_px=tuple(moved))
    name = {"sigma_d": "sigma_d_px", "exponent": "exponent"}[topic]
    now = getattr(submission.claims, name)
    return samples.with_claims(submission, **{name: now + by * base.tolerance})


NUMBERS = [(topic, i) for topic in FIELDS for i in range(3)]
NUMBERS += [("sigma_d", 0), ("exponent", 0), ("sigma_d_interval", 0), ("sigma_d_interval", 1)]


@pytest.fixture
def known(exact: Submission, monkeypatch: pytest.MonkeyPatch) -> Submission:
    """`exact`, whose raw depths are computed once: only its claims change."""
    found, prints = recompute(exact), fingerprint(exact)
    monkeypatch.setattr(rubric, "recompute", lambda _: found)
    monkeypatch.setattr(rubric, "fingerprint", lambda _: prints)
    monkeypatch.setattr(rubric, "data_flags", lambda *_: ())
    return exact


@pytest.mark.parametrize(("topic", "i"), NUMBERS)
def test_a_number_is_right_up_to_its_tolerance_and_noticed_beyond(
    known: Submission, topic: str, i: int
) -> None:
    at = 0 if topic == "sigma_d_interval" else i
    base = item(known, topic, at)
    assert base.verdict == "right"
    for by in (-0.999, 0.999):
        ends = topic == "sigma_d_interval" and (by > 0) == (i == 0)  # the ends must not cross
        inside = changed(known, topic, i, by if not ends else by / 10)
        assert item(inside, topic, at).verdict == "right"
    for by in (-1.001, 1.001, -1.5, 1.5, -10, 10, 1e4):
        try:
            outside = changed(known, topic, i, by)
        except ValueError:  # ends that cross cannot be written
            continue
        result = grade(outside)
        verdicts = [one.verdict for one in result.items if one.topic == topic]
        assert verdicts[at] != "right", by
        assert result.points < result.of


@settings(max_examples=60, deadline=None)
@given(where=st.sampled_from(NUMBERS[:-2]), by=st.floats(-6, 6))
def test_a_claim_is_right_exactly_within_its_tolerance(where: tuple[str, int], by: float) -> None:
    submission, found = _exact_once()
    base = _items(submission, found)[where]
    assert base.tolerance is not None
    moved = changed_by(submission, where, by * base.tolerance)
    if abs(abs(by) - 1) < 1e-6:
        return
    assert (_items(moved, found)[where].verdict == "right") == (abs(by) < 1)


_ONCE: list[Any] = []


def _exact_once() -> tuple[Submission, Any]:
    if not _ONCE:
        submission = samples.honest(0, tape_sigma_m=0.0)
        found = recompute(submission)
        submission = replace(
            submission,
            claims=samples.exact_claims(found),
            camera=replace(submission.camera, source="simulated"),
        )
        _ONCE.extend((submission, found))
    return _ONCE[0], _ONCE[1]


def _items(submission: Submission, found: Any) -> dict[tuple[str, int], Item]:
    items = judged(submission, found)
    numbered: dict[tuple[str, int], Item] = {}
    for one in items:
        numbered[one.topic, sum(topic == one.topic for topic, _ in numbered)] = one
    return numbered


def changed_by(submission: Submission, where: tuple[str, int], delta: float) -> Submission:
    topic, i = where
    if topic in FIELDS:
        now = getattr(submission.claims.rows[i], FIELDS[topic])
        return samples.with_row(submission, i, **{FIELDS[topic]: now + delta})
    name = {"sigma_d": "sigma_d_px", "exponent": "exponent"}[topic]
    return samples.with_claims(submission, **{name: getattr(submission.claims, name) + delta})


def test_the_tolerance_is_stated(known: Submission) -> None:
    for one in grade(known).items:
        if one.tolerance is not None and one.topic != "exponent":
            assert re.search(r"\(± \S+ is accepted", one.says), one.says


def test_the_exponents_interval_is_compared_too(known: Submission) -> None:
    ends = known.claims.exponent_interval
    assert ends is not None
    wide = samples.with_claims(known, exponent_interval=(ends[0] - 3, ends[1] + 3))
    assert item(wide, "exponent").verdict == "partial"
    assert "too wide" in item(wide, "exponent").says
    only = samples.with_claims(known, exponent=None)
    assert item(only, "exponent").verdict == "partial"


@pytest.mark.parametrize("field", ["distances_m", "measured_mm", "predicted_mm"])
@pytest.mark.parametrize("i", range(3))
def test_every_number_of_the_plot_counts(known: Submission, field: str, i: int) -> None:
    assert known.plot is not None
    values = list(getattr(known.plot, field))
    values[i] *= 1.3
    assert (
        item(replace(known, plot=replace(known.plot, **{field: tuple(values)})), "plot").points < 6
    )


def test_a_standard_error_counts_with_the_tapes_or_apart_from_it(good: Submission) -> None:
    measured = recompute(good).at[1]
    apart = samples.with_row(good, 1, depth_bias_se_mm=measured.bias_se_apart_mm)
    assert item(apart, "bias_se", 1).verdict == "right"
    assert measured.bias_se_mm is not None
    assert measured.bias_se_apart_mm is not None
    between = (measured.bias_se_mm + measured.bias_se_apart_mm) / 2
    assert item(samples.with_row(good, 1, depth_bias_se_mm=between), "bias_se", 1).points < 2


# --- mistakes with a name -------------------------------------------------------------------------

MISTAKEN = samples.mistaken(0)


@pytest.mark.parametrize("mistake", MISTAKEN)
def test_a_mistake_is_named_and_keeps_a_part_of_its_points(mistake: str) -> None:
    topic, submission = MISTAKEN[mistake]
    items = samples.graded(submission).items
    found = [i for i in items if i.topic == topic and i.mistake == mistake]
    assert found, [i.says for i in items if i.verdict != "right"]
    assert found[0].verdict == "partial"
    assert 0 < found[0].points < found[0].of


def test_the_sentence_of_a_turned_sign(good: Submission) -> None:
    row = good.claims.rows[2]
    assert row.depth_bias_mm is not None
    far = samples.with_row(samples.honest(11), 2, depth_bias_mm=2.05)
    says = item(far, "bias", 2).says
    assert says.startswith("Bias at 0.60 m: you say +2.05 mm, your raw depths say -2.05 mm (±")
    assert says.endswith("wrong because its sign is turned: bias is measured minus true.")


def test_every_mistake_has_a_credit_and_a_sample() -> None:
    assert set(grading_rules()["credit"]) == set(MISTAKES)
    assert set(MISTAKEN) == set(MISTAKES)
    assert all(0 < part < 1 for part in grading_rules()["credit"].values())


def test_points_are_a_hundred() -> None:
    points = grading_rules()["points"]
    each = sum(points[topic] for topic in ("data", *FIELDS))
    assert 3 * each + sum(points.values()) - each == 100


# --- the plot ---


@pytest.mark.parametrize(
    ("factor", "mistake"),
    [(1, ""), (0.7, ""), (1.6, ""), (0.4, "off_scale"), (2.5, "off_scale"), (1e-3, "metres"),
     (1e3, "off_scale")],
)  # fmt: skip
def test_a_prediction_is_right_within_a_factor(
    known: Submission, factor: float, mistake: str
) -> None:
    assert known.plot is not None
    found = item(replace(known, plot=samples.predicting(known.plot, factor)), "plot")
    assert (found.verdict, found.mistake) == ("partial" if mistake else "right", mistake)
    if mistake == "metres":
        assert found.says.endswith("but the prediction is in metres: 1 m is 1000 mm.")


def test_no_prediction_is_none_and_keeps_half(known: Submission) -> None:
    assert known.plot is not None
    silent = replace(known, plot=replace(known.plot, predicted_mm=None))
    found = item(silent, "plot")
    assert (found.points, found.verdict, found.mistake) == (3, "partial", "no_prediction")
    assert "without your prediction" in found.says
    assert shortcomings(silent) == (found.says,)
    two = Plot(known.plot.distances_m[:2], known.plot.measured_mm[:2], None)
    found = item(replace(known, plot=two), "plot")
    assert (found.points, found.mistake) == (2, "no_prediction")
    assert found.says.endswith("0.60 m missing and without your prediction.")
    assert student_page(grade(silent), silent)


def test_a_wrong_std_is_named_once(known: Submission) -> None:
    assert known.plot is not None
    stds = list(known.plot.measured_mm)
    stds[1] *= 10
    wrong = samples.with_row(known, 1, depth_std_mm=stds[1])
    wrong = replace(wrong, plot=replace(known.plot, measured_mm=tuple(stds)))
    assert [says.partition(":")[0] for says in shortcomings(wrong)] == ["Std of depth at 0.45 m"]
    assert "in your table, which is judged there (0.45 m)" in item(wrong, "plot").says
    only_there = replace(known, plot=wrong.plot)  # not in the table: the plot's own fault
    assert item(only_there, "plot").verdict == "partial"


# --- typing errors in rubric.toml ---


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("plot = 6 ", "plot = six ", r"rubric.toml: cannot be read: .*line 1\d"),
        ("plot = 6 ", "plto = 6 ", "rubric.toml: points.plto: is no key .*points.plot is missing"),
        ("plot = 6 ", "", "rubric.toml: points.plot: is missing|cannot be read"),
        ("plot = 6 ", "plot = 6\nmore = 1 ", "rubric.toml: points.more: is no key of this file$"),
        ("plot = 6 ", "plot = '6' ", "rubric.toml: points.plot: got '6', want a number from 0"),
        ("plot = 6 ", "plot = -6 ", "rubric.toml: points.plot: got -6, want a number from 0"),
        ("plot = 6 ", "plot = nan ", "rubric.toml: points.plot: got nan, want a number"),
        ("plot = 6 ", "plot = true ", "rubric.toml: points.plot: got True, want a number"),
        ("frames = 100 ", "frames = 99.5 ", "exercise.frames: got 99.5, want a whole number"),
        ("close = 0.5", "close = 1.5", "credit.close: got 1.5, want a number from 0 to 1"),
        ("close = 0.5", "", "rubric.toml: credit.close: is missing"),
        ("[flags]", "[flgas]", "rubric.toml: flgas: is no key .*flags is missing"),
        ("[0.30, 0.45, 0.60]", "0.30", "exercise.distances_m: got 0.3, want a list of numbers"),
        ("[0.30, 0.45, 0.60]", "[0.3, 'far']", "exercise.distances_m: got 'far', want a number"),
        ("[0.30, 0.45, 0.60]", "[0.3, 0.3]", "exercise.distances_m: .* want different numbers"),
        ("# Points", "points = 3 # ", "rubric.toml: "),
    ],
)
def test_a_typing_error_in_the_rubric_is_one_line(
    old: str, new: str, message: str, good: Submission, tmp_path: Any, monkeypatch: Any, capsys: Any
) -> None:
    content = RULES.read_text(encoding="utf-8")
    assert content.count(old) == 1
    broken = tmp_path / "rubric.toml"
    broken.write_text(content.replace(old, new + "#" * (old[-1] == " ")), encoding="utf-8")
    monkeypatch.setattr("coursekit.submission.recompute.RULES", broken)
    grading_rules.cache_clear()
    try:
        with pytest.raises(ValueError, match=message) as raised:
            shortcomings(good)
        assert "\n" not in str(raised.value)
        out = tmp_path / "out"
        out.mkdir()
        (out / "grades.csv").write_text("good", encoding="utf-8")
        command = ["grade", str(tmp_path), "--out", str(out), "--overwrite"]
        assert cli.main(command) == 1
        assert capsys.readouterr().err == f"coursekit: {raised.value}\n"
        assert [path.read_text(encoding="utf-8") for path in out.iterdir()] == ["good"]
    finally:
        grading_rules.cache_clear()


# --- what is missing, or cannot be compared -------------------------------------------------------


def empty(good: Submission, **changes: Any) -> Submission:
    nothing = replace(
        good, stacks=(), claims=Claims(), plot=None, conclusion=Conclusion(), outcomes={}
    )
    return replace(nothing, **changes)


def test_an_empty_bundle_gets_nothing_and_hears_what_is_missing(good: Submission) -> None:
    result = grade(empty(good))
    assert result.points == 0
    assert result.of == 100
    assert {one.verdict for one in result.items} == {"missing"}


def test_claims_without_raw_depths_are_not_believed(good: Submission) -> None:
    result = grade(empty(good, claims=good.claims, plot=good.plot, conclusion=good.conclusion))
    assert result.points <= 3  # the paragraph


def test_raw_depths_without_claims_count_as_data(good: Submission) -> None:
    result = grade(empty(good, stacks=good.stacks))
    assert result.points == 19  # data, and no exponent


def test_a_camera_without_a_baseline_is_not_asked_for_sigma_d(good: Submission) -> None:
    blind = replace(good, camera=replace(good.camera, baseline_m=None))
    blind = samples.with_claims(blind, sigma_d_px=None, sigma_d_interval_px=None)
    result = grade(blind)
    assert result.of < 100
    assert result.points == result.of


def test_other_distances_nearby_count_and_further_ones_are_compared_only(good: Submission) -> None:
    facts = good.camera
    random = np.random.default_rng(3)
    stacks = tuple(
        Stack(z, (400, 220, 40, 40), samples.depths(random, facts, z), np.arange(100) / 29.97 + i)
        for i, z in enumerate((0.33, 0.45, 0.62, 0.90))
    )
    result = grade(samples.finished(facts, stacks, "Four Distances"))
    assert [i.says for i in result.items if i.verdict != "right"] == []
    assert result.points == result.of == 100
    extra = [one for one in result.items if "0.90" in one.name]
    assert extra
    assert sum(one.of for one in extra) == 0
    wrong = samples.with_row(samples.finished(facts, stacks, "x"), 3, depth_std_mm=9.0)
    assert "wrong" in {one.verdict for one in grade(wrong).items if "0.90" in one.name}


@pytest.mark.parametrize(
    ("said", "frames", "verdict"),
    [("bias", 30, "right"), ("noise", 30, "partial"), ("bias", 1, "right"), (None, 1, "missing")],
)
def test_the_conclusion_is_judged_by_the_students_own_depths(
    said: Any, frames: int, verdict: str
) -> None:
    strong = MISTAKEN["sign"][1]  # a bias of 7 mm
    conclusion = replace(strong.conclusion, dominates=said, frames=frames)
    assert item(replace(strong, conclusion=conclusion), "verdict").verdict == verdict


def test_a_close_call_accepts_both() -> None:
    close = samples.honest(0)  # a bias of 0.4 mm, a tape good for 1 mm
    for said in ("bias", "noise"):
        conclusion = replace(close.conclusion, dominates=said)
        judged = item(replace(close, conclusion=conclusion), "verdict")
        assert judged.verdict == "right"
        assert "too close to call" in judged.says


def test_frames_that_drift_together_average_less(good: Submission) -> None:
    measured = recompute(good).at[1]
    one, many = measured.noise_of_mean_mm(1), measured.noise_of_mean_mm(100)
    assert measured.std is not None
    assert many is not None
    assert one == measured.std.value
    assert one / 10 <= many < one / 2


@settings(max_examples=40, deadline=None)
@given(data=st.data())
def test_no_raw_depths_make_the_grader_fail(data: st.DataObject) -> None:
    random = np.random.default_rng(data.draw(st.integers(0, 2**32)))
    stacks = []
    for i in range(data.draw(st.integers(1, 4))):
        shape = tuple(
            data.draw(st.sampled_from(sizes)) for sizes in ((1, 2, 5, 12), (1, 2, 9), (1, 3, 9))
        )
        low = data.draw(st.sampled_from([0, 1, 500, 65_535]))
        high = data.draw(st.sampled_from([low, min(low + 2, 65_535), 65_535]))
        counts = random.integers(low, high, shape, np.uint16, endpoint=True)
        counts[random.random(shape) < data.draw(st.sampled_from([0.0, 0.3, 1.0]))] = 0
        times = random.choice([0.0, 1.0, -1e12, 1e12], shape[0])
        stacks.append(Stack(0.1 + 0.2 * i, (0, 0, shape[2], shape[1]), counts, times))
    base, _ = _exact_once()
    claims = base.claims if data.draw(st.booleans()) else Claims()
    odd = replace(base, stacks=tuple(stacks), claims=claims)
    odd = replace(
        odd, camera=replace(odd.camera, depth_scale_m=data.draw(st.sampled_from([1e-7, 1e-3, 1.0])))
    )
    result = grade(odd)
    assert 0 <= result.points <= result.of
    assert all(np.isfinite([one.points, one.of]).all() for one in result.items)
    json.dumps(result.fingerprint.to_dict(), allow_nan=False)


# --- flags ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", samples.DISHONEST)
def test_made_up_data_are_flagged_without_taking_points(kind: str) -> None:
    code, make = samples.DISHONEST[kind]
    result = grade(make(1))
    assert code in {flag.code for flag in result.flags}
    assert all(flag.says.endswith(".") for flag in result.flags)
    if kind not in ("too clean", "flat noise"):  # claims nobody could make honestly
        assert result.points > 90


def test_a_recorded_clock_without_jitter_is_no_flag(good: Submission) -> None:
    played = samples.simulated_as_live(2, "clock")
    played = replace(played, camera=replace(played.camera, source="recorded"))
    assert grade(played).flags == ()


def test_a_published_model_of_a_real_camera_is_not_called_flat() -> None:
    """Near the camera a D435's noise grows slowly: data/published_depth_noise.json."""
    facts = samples.camera(1)
    random = np.random.default_rng(1)
    stacks = []
    for z in samples.DISTANCES:
        std = 0.000611 + 0.003587 * (z - 0.3515) ** 2
        sigma_d = std * facts.fx * (facts.baseline_m or 0.0) / z**2
        counts = samples.depths(random, facts, z, sigma_d=sigma_d)
        stacks.append(Stack(z, (400, 220, 40, 40), counts, samples.clock(random, 1e4 * z, 100)))
    assert grade(samples.finished(facts, tuple(stacks), "Real")).flags == ()


# --- copies ---------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def others() -> dict[str, Fingerprint]:
    """Fingerprints of strangers."""
    return {f"other {i}": fingerprint(samples.honest(20 + i)) for i in range(5)}


@pytest.mark.parametrize("how", samples.COPIES)
@pytest.mark.parametrize("unit", [1e-3, 1e-4])
def test_a_copy_is_found(how: str, unit: float, others: dict[str, Fingerprint]) -> None:
    original = samples.honest(1, of_camera={"depth_scale_m": unit})
    copy = samples.copied(original, how)
    prints = others | {"original": fingerprint(original), "copy": fingerprint(copy)}
    found = copies(prints)
    assert [set(one.keys) for one in found] == [{"original", "copy"}]
    assert found[0].code == ("identical" if how == "identical" else "nearly_identical")
    assert not found[0].note


def test_a_copy_is_found_in_the_other_order(others: dict[str, Fingerprint]) -> None:
    original = samples.honest(1)
    copy = fingerprint(samples.copied(original, "subset"))
    prints = {"copy": copy} | others | {"original": fingerprint(original)}
    assert [set(one.keys) for one in copies(prints)] == [{"original", "copy"}]


def test_strangers_are_not_copies(others: dict[str, Fingerprint]) -> None:
    assert copies(others) == []


def test_two_measurements_with_one_camera_at_one_place_are_not_copies() -> None:
    """The same pattern, but other noise: two students share a camera."""
    facts = samples.camera(5)
    prints = {}
    pattern = np.random.default_rng(0).normal(0, 2, (40, 40))
    for who in ("one", "two"):
        random = np.random.default_rng(len(prints) + 40)
        stacks = tuple(
            Stack(
                z,
                (400, 220, 40, 40),
                (samples.depths(random, facts, z, holes=0.0) + 10 + np.rint(9 * pattern)).astype(
                    np.uint16
                ),
                np.arange(100) / 29.97,
            )
            for z in samples.DISTANCES
        )
        prints[who] = fingerprint(replace(samples.honest(0), stacks=stacks, student=who))
    assert copies(prints) == []


def test_two_simulations_of_one_camera_are_a_note() -> None:
    facts = {"source": "simulated", "name": "Simulated D435", "serial": "seed-7"}
    prints = {
        who: fingerprint(samples.honest(3, of_camera=facts, student=who)) for who in ("one", "two")
    }
    found = copies(prints)
    assert [one.note for one in found] == [True]
    assert "gives everybody the same" in found[0].says


def test_a_simulation_declared_as_live_shares_its_depths_with_the_others() -> None:
    facts = {"source": "simulated", "name": "Simulated D435", "serial": "seed-7"}
    one = samples.honest(3, of_camera=facts)
    two = replace(one, student="Two", camera=samples.camera(3))
    found = copies({"one": fingerprint(one), "two": fingerprint(two)})
    assert [copy.note for copy in found] == [False]


def test_a_student_who_hands_in_twice_is_a_note(good: Submission) -> None:
    again = fingerprint(replace(good, student=good.student.upper()))
    assert [c.note for c in copies({"one": fingerprint(good), "two": again})] == [True]


def test_a_fingerprint_goes_through_json(good: Submission, others: dict[str, Fingerprint]) -> None:
    there = json.dumps(fingerprint(good).to_dict())
    assert len(there) < 25_000
    back = Fingerprint.from_dict(json.loads(there))
    assert [set(c.keys) for c in copies(others | {"a": fingerprint(good), "b": back})] == [
        {"a", "b"}
    ]


def test_many_bundles_of_one_camera_are_compared(others: dict[str, Fingerprint]) -> None:
    """40 of one camera in one place, each different in its noise, and 80 copies of 5 of them."""
    random = np.random.default_rng(0)
    base = next(iter(others.values()))
    prints = {}
    for i in range(40 * MANY):
        stacks = tuple(
            replace(
                s,
                digest=f"{i} {k}",
                frames=random.integers(-127, 127, s.frames.shape, np.int8),
            )
            for k, s in enumerate(base.stacks)
        )
        prints[f"own {i}"] = replace(base, stacks=stacks, student=f"own {i}")
    for i in range(80 * MANY):
        prints[f"repeated {i}"] = replace(prints[f"own {i % (5 * MANY)}"], student=f"repeated {i}")
    found = copies(prints)
    assert len(found) == 5 * MANY
    assert all(one.code == "identical" for one in found)


def test_an_empty_bundle_is_like_no_other(good: Submission) -> None:
    nothing = fingerprint(empty(good))
    assert copies({"one": nothing, "two": nothing}) == []


def test_a_plot_without_points_is_missing(good: Submission) -> None:
    assert item(replace(good, plot=Plot((), (), ())), "plot").verdict == "missing"
