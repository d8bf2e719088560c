"""The check engine and the checkpoints: verdicts on right, wrong, blank and broken answers."""

import dataclasses
import itertools
import json
import math
import re
import sys
from functools import partial
from pathlib import Path
from statistics import mean

import cv2
import numpy as np
import pytest
from common import EXPECTED, NIGHTLY, refusals

from coursekit import lessons
from coursekit.lessons import CHECKPOINTS, EXERCISES, questions
from coursekit.lessons.exercises import Exercise, Model
from coursekit.lessons.questions import EXAMPLES, Choice, Number, Verdict, panel

FILES = [Path(lessons.__file__).with_name(f"{lesson}.toml") for lesson in lessons.LESSONS]
pytestmark = pytest.mark.usefixtures("own_results")
each_exercise = pytest.mark.parametrize("exercise", EXERCISES.values(), ids=EXERCISES.keys())
each_checkpoint = pytest.mark.parametrize("checkpoint", CHECKPOINTS.values(), ids=CHECKPOINTS)


# --- every exercise ---


@each_exercise
def test_each_model_gets_its_verdict(exercise: Exercise) -> None:
    """The right one is right, and each wrong one is named, without a line that would solve it."""
    verdict = exercise.judge(exercise.model())
    assert (verdict.kind, verdict.named) == ("right", None)
    for mistake in exercise.mistakes:
        verdict = exercise.judge(exercise.model(mistake))
        assert (verdict.kind, verdict.named) == ("wrong", mistake.name)
        assert mistake.says in verdict.headline
        assert mistake.ask in verdict.lines
        assert "K[" not in repr(verdict)
        assert "np." not in repr(verdict).replace("`np.stack`", "")
        # A phrase that begins within a sentence, and a question or a hint that ends one.
        assert not mistake.says.endswith((".", "?"))
        assert mistake.ask.endswith((".", "?", ")"))
        assert not re.search(r"\s\s|\n", mistake.says + mistake.ask)


@pytest.mark.parametrize("lesson", lessons.LESSONS)
def test_each_text_about_a_mistake_is_said_by_an_exercise(lesson: str) -> None:
    ours = [e for e in EXERCISES.values() if e.name.startswith(f"{lesson}.")]
    said = {mistake.name for exercise in ours for mistake in exercise.mistakes}
    assert said == set(questions.lesson_texts(lesson)["mistakes"])


@each_exercise
@pytest.mark.parametrize("core", [False, True], ids=["all cases", "core cases"])
def test_the_cases_separate_every_two_models(exercise: Exercise, core: bool) -> None:
    """Any two models differ somewhere by far more than the tolerance, or share a name.

    In the core cases: any that are wrong there, so that a core attempt is called by its mistake.
    """
    if core and exercise.core is None:
        return
    cases = [args for args in exercise.cases if not core or exercise.is_core(args)]
    assert 0 < len(cases) < len(exercise.cases) + (not core)
    models = [("right", exercise.model())] + [
        (m.name, exercise.model(m)) for m in exercise.mistakes
    ]
    answers = [(name, answered(model, cases)) for name, model in models]
    if core:
        right = answers[0][1]
        answers[1:] = [a for a in answers if gap(a[1], right) > exercise.tolerance]
        assert len(answers) > 10
    for (name_a, a), (name_b, b) in itertools.combinations(answers, 2):
        # An iteration that stops one round before it is good enough is not far off.
        far = 1 if name_b == "too_few_rounds" else 20
        if name_a != name_b:
            assert gap(a, b) > far * exercise.tolerance, (name_a, name_b)


@each_exercise
def test_one_core_mistake_is_one_mistake(exercise: Exercise) -> None:
    """An attempt that leaves the rest alone is judged, and counted, on the core cases only."""
    if exercise.core is None:
        return
    count, few = sum(map(exercise.is_core, exercise.cases)), exercise.core.arguments
    for mistake in exercise.mistakes:
        model = exercise.model(mistake)
        verdict = exercise.judge(lambda *args, model=model: model(*args[:few]))
        if mistake.step in ("read", "bend", "unbend"):
            assert (verdict.kind, verdict.named) == ("core right", None)
            assert f"all {count} cases without distortion agree" in verdict.headline
        elif verdict.kind != "core right":  # bent before the division: the core does not show it
            assert (verdict.kind, verdict.named) == ("wrong", mistake.name)
            assert f"of the {count} cases without distortion agree." in verdict.headline
            assert verdict.headline.endswith("(`dist` can wait.)")
            assert "coefficients" not in verdict.lines[0]
            assert mistake.ask in verdict.lines


def answered(model: Model, cases: list) -> np.ndarray:
    """What a model makes of some cases, all in one row."""
    with np.errstate(all="ignore"):
        return np.concatenate([np.ravel(model(*args)).astype(float) for args in cases])


def gap(x: np.ndarray, y: np.ndarray) -> float:
    """The largest difference; NaN equals NaN and is infinitely far from every number."""
    with np.errstate(all="ignore"):
        same = (x == y) | (np.isnan(x) & np.isnan(y))
        return float(np.where(same, 0.0, np.nan_to_num(np.abs(x - y), nan=np.inf)).max())


TRUE_OF_THE_NUMBERS = (None, "constant", "runs_away")  # whatever made them


@each_exercise
def test_two_mistakes_are_called_more_than_one(exercise: Exercise) -> None:
    """Unless a single one gives the very same numbers (one hides the other, say): then that one."""
    steps = list(exercise.steps)
    alone = {}  # numbers of each mistake by itself
    pairs = itertools.permutations([m for m in exercise.mistakes if not m.alone], 2)
    for a, b in itertools.islice(pairs, None, None, 1 if NIGHTLY else 19):
        if steps.index(a.step) >= steps.index(b.step) or a.name == b.name:
            continue
        pair = exercise.model(a, b)
        verdict = exercise.judge(pair)
        assert verdict.kind in ("wrong", "raised")  # what is no pose has no inverse
        if "more than one mistake" in repr(verdict) or verdict.named in TRUE_OF_THE_NUMBERS:
            assert verdict.named or verdict.kind == "raised"
            continue
        both = answered(pair, exercise.cases)
        named = [m for m in exercise.single_mistakes() if m.name == verdict.named]
        for mistake in named:
            if id(mistake) not in alone:
                alone[id(mistake)] = answered(exercise.model(mistake), exercise.cases)
        singles = [alone[id(m)] for m in named]
        assert any(same_numbers(exercise, one, both) for one in singles), (a.name, b.name)


def same_numbers(exercise: Exercise, one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two models agree wherever the first has an answer."""
    known = np.full(one.shape, True) if exercise.nan_answers else np.isfinite(one)
    close = {"rtol": 1e-9, "atol": exercise.tolerance, "equal_nan": True}
    return np.allclose(one[known], other[known], **close)


@each_exercise
def test_a_near_match_is_not_named(exercise: Exercise) -> None:
    for mistake in exercise.mistakes[:: 1 if NIGHTLY else 24]:
        model = exercise.model(mistake)
        verdict = exercise.judge(lambda *args, f=model: f(*args) + 0.02 * (1 + abs(f(*args))))
        assert verdict.kind == "wrong"
        assert verdict.named in (None, "runs_away")


# --- broken, blank and odd functions ---

PROJECT = EXERCISES["pinhole.project"]
right = PROJECT.model()


def in_place(points, K, dist=None, columns=slice(None)):
    answer = right(points, K, dist)[:, columns]
    points /= points[:, 2:]
    return answer


def beyond(rest):
    """A function that is right in the core; with a lens, it is what is given."""

    def function(points, K, dist=None):
        return right(points, K) if dist is None else rest(points, K)

    return function


def unready(points, K, dist=None):
    raise NotImplementedError


def recursion(points, K, dist=None):
    return recursion(points, K, dist)


def core_only(points, K, dist=None):
    return right(points, K)


def only_one_point(points, K, dist=None):
    return core_only(points, K) if len(points) == 1 else None


def core_in_place(points, K, dist=None):
    points /= points[:, 2:]
    return right(points, K)


CORE_RIGHT, TRANSPOSED_CORE, IN_PLACE_CORE = EXPECTED["of_the_core"]


@pytest.mark.parametrize(
    ("function", "kind", "says"),
    [
        (lambda points, K, dist=None: None, "not attempted", "returns None"),
        (unready, "not attempted", "not attempted yet"),
        (42, "not attempted", "not a function"),
        (lambda points, K: points, "raised", "positional arguments"),
        (beyond(lambda points, K: points @ np.eye(7)), "raised", "points @ np.eye(7)"),
        (lambda points, K, dist=None: sys.exit(3), "raised", "SystemExit"),
        (recursion, "raised", "RecursionError"),
        (beyond(lambda points, K: None), "core right", CORE_RIGHT),
        (beyond(unready), "core right", CORE_RIGHT),
        (core_only, "core right", CORE_RIGHT),
        (lambda *args: core_only(*args).T, "wrong", TRANSPOSED_CORE),
        (core_in_place, "wrong", IN_PLACE_CORE),
        (lambda *args: core_only(*args)[:, ::-1].T, "wrong", "more than one mistake"),
        (lambda *args: np.c_[core_only(*args), [0] * len(args[0])], "wrong", "wrong shape"),
        (only_one_point, "wrong", "`return` missing"),
        (lambda *args: "pixels", "wrong", "a str"),
        (lambda *args: {1: 2}, "wrong", "a dict"),
        (lambda *args: [[1, 2], [3]], "wrong", "a list"),
        (lambda *args: right(*args) + 0j, "wrong", "not an array of numbers"),
        (lambda *args: np.c_[right(*args), right(*args)], "wrong", "wrong shape"),
        (lambda *args: right(*args)[0], "wrong", "wrong shape"),
        (lambda *args: 3.0, "wrong", "wrong shape"),
        (lambda *args: np.full((len(args[0]), 2), np.nan), "wrong", "runs away"),
        (lambda *args: right(*args).T, "wrong", "transposed"),
        (in_place, "wrong", "changes the array it is given. The numbers are right"),
        (partial(in_place, columns=[1, 0]), "wrong", "more than one mistake"),
        (lambda *args: right(*args)[:, ::-1].T, "wrong", "more than one mistake"),
    ],
)
def test_odd_functions(function, kind: str, says: str) -> None:
    verdict = lessons.check("pinhole.project", function)
    assert verdict.kind == kind
    assert says in repr(verdict)
    assert verdict._repr_html_().count("<div") >= 1


def test_the_counterexample_of_the_design() -> None:
    """The smallest case that shows p1 and p2 swapped, with OpenCV's numbers."""
    (mistake,) = [m for m in PROJECT.mistakes if m.name == "p1_p2_swapped"]
    verdict = PROJECT.judge(PROJECT.model(mistake))
    assert verdict.headline == "project: your p1 and p2 are swapped. 7 of 10 cases agree."
    K, dist = np.array([[447.0, 0, 424], [0, 447, 240], [0, 0, 1]]), np.array([0, 0, 1e-3, 5e-4, 0])
    pixel = cv2.projectPoints(np.array([[0.3, -0.2, 0.9]]), np.zeros(3), np.zeros(3), K, dist)[0]
    assert "({:.3f}, {:.3f})".format(*pixel.ravel()) == "(573.019, 140.749)"
    assert "expected (573.019, 140.749), yours (573.138, 140.658) px" in verdict.lines[0]


def test_a_mistake_in_the_core_is_told_with_its_own_count() -> None:
    verdict = PROJECT.judge(lambda points, K, dist=None: right(points * [1, -1, 1], K))
    agree = "0 of the 4 cases without distortion agree."
    assert verdict.headline == f"project: your y axis points up. {agree} (`dist` can wait.)"
    assert verdict.named == "y_up"
    verdict = PROJECT.judge(lambda points, K, dist=None: right(points, K) + 0.1)
    assert f"not right yet. {agree}" in verdict.headline
    assert verdict.named is None


def test_without_a_core_nothing_can_wait() -> None:
    whole = dataclasses.replace(PROJECT, core=None)
    verdict = whole.judge(core_only)
    assert verdict.kind == "wrong"
    assert "4 of 10 cases agree." in verdict.headline


test_unknown_names = refusals(
    (r"pinhole\.project", lambda: lessons.check("pinhole.projection", right)),
    (r"pinhole\.pitch", lambda: lessons.checkpoint("pitch")),
    ("pinhole", lambda: lessons.evidence("optics")),
)


# --- checkpoints ---


@each_checkpoint
def test_one_answer_is_right_and_every_answer_says_why(checkpoint) -> None:
    if isinstance(checkpoint, Choice):
        answers = {k: (o.right, o.why) for k, o in checkpoint.lettered().items()}
    else:
        answers = {slip.value: (False, slip.why) for slip in checkpoint.classics}
        answers[checkpoint.value] = True, checkpoint.why
        assert checkpoint.answer(checkpoint.value * 1.7).lines[0] == checkpoint.hint
    assert sum(right for right, _ in answers.values()) == 1
    for answer, (right, why) in answers.items():
        verdict = checkpoint.answer(answer)
        assert verdict.kind == ("right" if right else "wrong")
        assert (verdict.named is None) == right
        assert verdict.lines[0] == why
        assert len(why) > 20
    assert all(why in repr(checkpoint.explanation()) for _, why in answers.values())


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_values_that_show_their_working(path: Path) -> None:
    """Behind a computed value stands how: `value = 0.62  # = 0.45 * hypot(1, 424 / 447)`."""
    for line in path.read_text(encoding="utf-8").splitlines():
        if found := re.match(r"[^#\d]*([\d.]+),?\s+# = (.+)$", line):
            assert float(found[1]) == pytest.approx(eval(found[2], vars(math).copy()), rel=1e-12)
        else:
            assert "# =" not in line


@pytest.mark.parametrize("lesson", lessons.LESSONS)
def test_objectives_cover_every_checkpoint_and_exercise(lesson: str) -> None:
    named = [n for o in lessons.evidence(lesson).objectives for n in o.names]
    known = [n for n in (*CHECKPOINTS, *EXERCISES) if n.startswith(f"{lesson}.")]
    assert sorted(named) == sorted(known)
    assert len(known) >= 6


@pytest.mark.parametrize("lesson", lessons.LESSONS)
def test_no_option_is_given_away_by_its_length(lesson: str) -> None:
    """The right one is not the longest in more than half of the choices (05: in two of three)."""
    choices = [c for n, c in CHECKPOINTS.items() if n.startswith(lesson) and isinstance(c, Choice)]
    longest = [max(c.options, key=lambda o: len(o.text)).right for c in choices]
    assert mean(longest) <= (2 / 3 if lesson == "error_budget" else 1 / 2)


PITCH = CHECKPOINTS["pinhole.pitch"]


@pytest.mark.parametrize(("checkpoint", "given", "verdict"), EXPECTED["typed_answers"])
def test_ways_to_type_an_answer(checkpoint: str, given, verdict: list[str]) -> None:
    """Units are converted, and a number with two readings is the one that is known."""
    found = CHECKPOINTS[f"pinhole.{checkpoint}"].judge(given)
    assert [found.kind, found.named or ""] == verdict


def test_right_digits_in_another_unit_are_no_attempt() -> None:
    verdict = CHECKPOINTS["pinhole.same_size"].answer(187.5)
    assert verdict.kind == "not attempted"
    assert "wanted in m" in verdict.headline
    assert PITCH.judge("2000 m").kind == "not attempted"  # of pixels


def test_the_first_mistake_to_look_at_shows_in_the_case() -> None:
    """Principal point and tangential terms: the first case has no coefficients to blame."""
    chosen = {m.name: m for m in PROJECT.mistakes}
    model = PROJECT.model(chosen["tangential_missing"], chosen["principal_point_forgotten"])
    assert PROJECT.judge(model).named == "several, first principal_point_forgotten"


def test_no_message_tells_a_number() -> None:
    """Neither asking again nor the example of a number gives an answer away."""
    for checkpoint in CHECKPOINTS.values():
        if isinstance(checkpoint, Number):
            assert "such as 0.37 or 150" in checkpoint.judge("10/0.005").headline
            for example in EXAMPLES.split(" or "):
                assert not checkpoint._close(float(example), checkpoint.value)


@pytest.mark.parametrize("given", ["", "two", "nan", "inf", None, "20 00", [2000], "3,000"])
def test_what_is_no_number_is_not_an_attempt(given) -> None:
    assert PITCH.answer(given).kind == "not attempted"
    assert questions.read_attempts() == {}


def test_the_numbers_of_the_checkpoints() -> None:
    """Computed here another way: similar triangles."""
    assert PITCH.value == pytest.approx(0.010 / 5e-6)
    assert CHECKPOINTS["pinhole.same_size"].value == pytest.approx(0.45 * 25 / 60)


def test_the_widget_commits() -> None:
    said: list[str] = []
    field, button, _ = panel(CHECKPOINTS["pinhole.half_size"], said.append).children
    button.click()
    assert "Choose or type" in said[-1]
    field.value = "A"
    button.click()
    assert "not this one" in said[-1]
    field.value = "C"
    button.click()
    assert "right" in said[-1]
    assert CHECKPOINTS["pinhole.half_size"]._before().startswith("<details><summary>You have")
    field, button, _ = panel(PITCH, said.append).children
    for number, verdict in (("500", "not this"), ("2000", "right")):
        field._handle_custom_msg({"event": "submit"}, [])  # the key Enter, told before the number
        field.value = number
        assert verdict in said[-1]
    field.value = "500"
    button.click()
    button.click()  # of a busy kernel's learner, who has typed 2000: the press is told first
    assert "not this" in said[-1]
    field.value = "2000"
    assert "right" in said[-1]
    assert len(questions.read_attempts()["pinhole.pitch"]) == 4  # nothing was judged twice
    kinds = [a["kind"] for a in questions.read_attempts()["pinhole.half_size"]]
    assert kinds == ["wrong", "right"]


# --- progress and evidence ---


def test_attempts_are_kept_in_order(own_results: Path) -> None:
    PITCH.answer(500)
    PITCH.answer(2000)
    lessons.check("pinhole.project", right)
    kept = json.loads((own_results / "progress.json").read_text(encoding="utf-8"))
    assert [a["kind"] for a in kept["pinhole.pitch"]] == ["wrong", "right"]
    rows = dict(lessons.evidence("pinhole").rows())
    assert "pitch: right at try 2" in " ".join(rows.values())
    assert {"project: right", "deproject: not attempted yet"} <= set(rows.values())
    assert "range: not answered yet" in " ".join(rows.values())


def test_evidence_of_the_core() -> None:
    lessons.check("pinhole.project", lambda *args: right(*args)[:, ::-1])
    lessons.check("pinhole.project", core_only)
    assert "project: core right" in repr(lessons.evidence("pinhole"))
    lessons.check("pinhole.project", in_place)  # what was shown stays shown
    assert "project: core right" in repr(lessons.evidence("pinhole"))
    lessons.check("pinhole.project", right)
    assert "project: right at try 4" in repr(lessons.evidence("pinhole"))


def test_a_damaged_record_is_set_aside(own_results: Path) -> None:
    own_results.mkdir()
    (own_results / "progress.json").write_text("{half", encoding="utf-8")
    PITCH.answer(2000)
    assert len(questions.read_attempts()["pinhole.pitch"]) == 1
    assert (own_results / "progress.damaged.json").read_text(encoding="utf-8") == "{half"


def test_a_record_that_cannot_be_written_is_said(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("", encoding="utf-8")
    monkeypatch.setenv("COURSEKIT_RESULTS", str(tmp_path / "file" / "inside"))
    verdict = PITCH.answer(2000)
    assert verdict.kind == "right"
    assert "progress is not saved" in verdict.lines[-1]


def test_html_is_escaped() -> None:
    verdict = Verdict("x", "wrong", "<b>", ("`a<b**2*c*d` and *so*",))
    html = verdict._repr_html_()
    assert "&lt;b&gt;" in html
    assert "<code>a&lt;b**2*c*d</code> and <em>so</em>" in html
