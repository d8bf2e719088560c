"""Handing in: what is kept, what is said before packing, what is written and what never is."""

from dataclasses import asdict, replace
from pathlib import Path

import nbformat
import numpy as np
import pytest
from common import EXPECTED, NIGHTLY
from sample_submissions import PARAGRAPH, honest

import coursekit as ck
from coursekit import cli, results
from coursekit.cameras.simulated import SimulatedCamera
from coursekit.lessons import questions
from coursekit.results import Quantity
from coursekit.submission import submit as handing_in
from coursekit.submission.format import Conclusion, Plot, TableRow, bundle_bytes, read_bundle, slug
from coursekit.submission.rubric import grade, shortcomings
from coursekit.submission.submit import MEASURED, keep, load_measured, relative, submit
from tools import build_notebooks

RIGHT = asdict(honest(seed=3).conclusion)


@pytest.fixture
def kept(own_results):
    """An honest measurement, as the notebook keeps it."""
    nameless = {"student": handing_in.bundle.NOBODY, "conclusion": Conclusion(), "outcomes": {}}
    whole = honest(seed=3, **nameless)
    results.write_bytes(own_results / MEASURED, bundle_bytes(whole))
    return whole


# --- what notebook 02 keeps ---


@pytest.fixture(scope="module")
def block():
    """A camera, the raw depth of the block's face at 0.45 m, its frames, and the face in them."""
    camera = SimulatedCamera(seed=7)
    camera.set(depth_scale_m=0.0001)
    camera.place("60 mm block", 0.45)
    frames = camera.frames(6, progress=False)
    face = ck.stereo.block_face(frames)
    return camera, handing_in.stack(frames, face.window, 0.45), frames, face


STD = {"depth_std_at_450_mm": Quantity(0.6, "mm", 0.01, "noise")}
ONE_STD = ([0.45], [6e-4], 900, 431.0, 0.05)  # what a law is fitted to


def test_a_stack_is_the_window_of_each_frame(block):
    _, found, frames, face = block
    left, top, width, height = face.window
    for i, frame in enumerate(frames):
        assert np.array_equal(found.counts[i], frame.depth[top : top + height, left : left + width])
        assert found.times_s[i] == frame.time_s
    assert found.counts.dtype == np.uint16


def test_what_is_kept_says_exactly_what_the_notebook_says(block, own_results):
    camera, one, _, face = block
    stats = face.stats

    def fitted(stats, fx, baseline_m, scale_m):
        stds, dof = [stats.pixel_std_m], [stats.pixel_dof]
        return ck.stereo.fit_noise([0.45], stds, dof, fx, baseline_m, scale_m, exponent=2)

    law = fitted(stats, camera.depth.fx, camera.baseline_m, camera.depth_scale_m)
    table = {
        "depth_std_at_450_mm": Quantity(face.depth_std_mm, "mm", face.depth_std_error_mm, "noise")
    }
    assert keep(camera, [one], table, law, [0.7], 0.001, 0.06) == own_results / MEASURED
    found = load_measured()
    facts, claims, (row,), (raw,) = found.camera, found.claims, found.claims.rows, found.stacks
    assert (facts.serial, facts.source) == (camera.serial, "simulated")
    assert (facts.fx, facts.baseline_m) == (camera.depth.fx, camera.baseline_m)
    assert (found.tape_sigma_m, found.caliper_m) == (0.001, 0.06)
    assert claims.sigma_d_interval_px == law.sigma_d_interval_px
    assert claims.exponent is None  # it was held at 2, so none is quoted
    assert found.plot == Plot((0.45,), (face.depth_std_mm,), (0.7,))
    again = ck.stereo.window_stats(raw.counts, (0, 0, *raw.window[2:]), camera.depth_scale_m)
    assert found.plot.measured_mm == (1000 * again.pixel_std_m,)
    assert row == TableRow(0.45)  # the table holds the student's own numbers alone
    law = fitted(again, facts.fx, facts.baseline_m, facts.depth_scale_m)
    assert law.sigma_d_px == claims.sigma_d_px


def test_a_fitted_exponent_is_claimed_and_what_is_not_in_the_table_is_left_out(block, own_results):
    camera, one, *_ = block
    law = ck.stereo.fit_noise([0.45, 0.60], [6e-4, 1.1e-3], *ONE_STD[2:])
    keep(camera, [one, replace(one, distance_m=0.60)], STD, law, [0.7, 1.2], 0.0, 0.06)
    claims = load_measured().claims
    assert claims.exponent == law.exponent
    assert claims.exponent_interval == pytest.approx(law.exponent_interval)
    assert load_measured().plot is None


def only(quantity):
    return {"quantities": {"depth_std_at_450_mm": quantity}}


CANNOT_KEEP = [
    *EXPECTED["cannot_keep"],
    (only(0.6), r"depth_std_at_450_mm: got 0.6, want Quantity\(value, 'mm', standard error\)"),
    (only(Quantity(0.6, "inch")), "depth_std_at_450_mm: got 'inch', want the unit 'mm' or 'm'"),
    ({"table": {0.5: (1, 1, 1, 1, 0)}}, "table: got 0.5, want one of the distances 0.45"),
    ({"table": {0.45: (1, 1)}}, r"table at 0.45 m: got \(1, 1\), want five: bias, its standard"),
    ({"table": {0.45: (1, 1, "x", 1, 0)}}, "depth_std_mm: got 'x', want a number"),
]


@pytest.mark.parametrize(("change", "message"), CANNOT_KEEP)
def test_nothing_is_kept_of_what_cannot_be_handed_in(change, message, block, own_results):
    camera, one, *_ = block
    fit = ck.stereo.fit_noise(*ONE_STD, exponent=2)
    honestly = {"quantities": STD, "predicted_mm": None, "tape_sigma_m": 0.0, "caliper_m": 0.06}
    with pytest.raises(ValueError, match=message):
        keep(camera, [one], fit=fit, **honestly | change)
    assert not own_results.exists()


def test_own_numbers_are_handed_in_and_what_was_changed_since_counts(block, own_results):
    camera, one, *_ = block
    law = ck.stereo.fit_noise(*ONE_STD, exponent=2)
    table = {0.45: (None, None, 0.7, np.float64(0.02), None)}
    keep(camera, [one], STD, law, [0.65], 0.0, 0.06, table)
    assert load_measured().claims.rows == (TableRow(0.45, None, None, 0.7, 0.02, None),)
    assert load_measured().plot == Plot((0.45,), (0.6,), (0.65,))
    handed = submit("Ada", mismatches="kept", table={0.45: (1, 1, 1, 1, 0)}, predicted_mm=[0.61])
    packed = read_bundle(handed.path)
    assert packed.claims.rows == (TableRow(0.45, 1, 1, 1, 1, 0),)
    assert (packed.claims.mismatches, packed.plot.predicted_mm) == ("kept", (0.61,))
    with pytest.raises(ValueError, match="mismatches: got 'both', want one of kept, left out"):
        submit("Ada", mismatches="both")


# --- what is said, and what is written ---


def test_without_a_measurement_it_says_what_to_run(own_results, capsys):
    handed = submit("Ada")
    assert handed.path is None
    assert "studio cells of notebook 02" in repr(handed)
    assert cli.main(["submit", "--student", "Ada"]) == 1
    assert "studio cells of notebook 02" in capsys.readouterr().err
    assert not own_results.exists()


def test_without_a_name_it_says_all_that_is_missing_and_writes_nothing(kept, own_results):
    handed = submit("  ")
    assert handed.path is None
    assert [says.partition(":")[0] for says in handed.says] == ["Bias or noise", "Paragraph"]
    assert "needs your name" in repr(handed)
    assert all(f"- {says}" in repr(handed) for says in handed.says)
    assert [path.name for path in own_results.iterdir()] == [MEASURED]


def test_an_honest_student_gets_full_points_for_what_passes_here(kept, own_results):
    handed = submit("Ada Lovelace", **RIGHT)
    assert handed.says == ()
    assert handed.path == own_results / "studio_1_Ada_Lovelace.zip"
    assert "Wrote results/studio_1_Ada_Lovelace.zip" in repr(handed)
    assert str(own_results.parent) not in repr(handed) + handed._repr_html_()
    packed = read_bundle(handed.path)
    assert (packed.student, packed.conclusion.paragraph) == ("Ada Lovelace", PARAGRAPH)
    found = grade(packed)
    assert found.points == found.of == 100
    for one, two in zip(packed.stacks, kept.stacks, strict=True):
        assert np.array_equal(one.counts, two.counts)


def test_what_is_weak_is_said_in_the_graders_words_and_packed_all_the_same(kept, own_results):
    *others, last = kept.stacks
    short = replace(last, counts=last.counts[:84], times_s=last.times_s[:84])
    short_one = replace(kept, stacks=(*others, short))
    results.write_bytes(own_results / MEASURED, bundle_bytes(short_one))
    handed = submit("Ben")
    assert handed.path is not None
    assert any(says.startswith("0.60 m has 84 frames, 100 are needed") for says in handed.says)
    assert handed.says == shortcomings(read_bundle(handed.path))


def test_small_differences_of_spelling_are_understood(kept):
    conclusion = read_bundle(submit("Ada", 0.45, " Bias", PARAGRAPH, frames=10.0).path).conclusion
    assert (conclusion.dominates, conclusion.frames) == ("bias", 10)
    assert isinstance(conclusion.frames, int)


TOO_LONG = ({"paragraph": "x" * 6000}, "paragraph: got 6000 characters")


@pytest.mark.parametrize(("arguments", "message"), [*EXPECTED["submit_refuses"], TOO_LONG])
def test_an_argument_that_cannot_be_is_named_and_nothing_is_written(
    arguments, message, kept, own_results
):
    with pytest.raises(ValueError, match=message) as raised:
        submit(**{"student": "Ada"} | arguments)
    assert raised.value._render_traceback_() == [str(raised.value)]  # a notebook shows one line
    assert "\n" not in str(raised.value)
    assert [path.name for path in own_results.iterdir()] == [MEASURED]


def test_a_damaged_measurement_says_so(kept, own_results):
    (own_results / MEASURED).write_bytes(b"PK nonsense")
    with pytest.raises(ValueError, match=r"studio_1\.measured: .* notebook 02 again"):
        submit("Ada")


@pytest.mark.parametrize(("name", "file"), EXPECTED["student_files"])
def test_a_name_is_never_a_path(name, file):
    assert handing_in.bundle_name(name) == file
    assert Path(file).name == file
    assert len(file.encode()) < 200
    assert slug(slug(name)) == slug(name)


def test_paths_are_said_as_somebody_in_the_course_would_type_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert relative(tmp_path / "out" / "a.zip") == "out/a.zip"
    assert relative(results.ROOT / "results" / "a.zip") == "results/a.zip"
    monkeypatch.chdir(results.ROOT / "notebooks")
    assert relative(results.ROOT / "results" / "a.zip") == "results/a.zip"
    assert relative(tmp_path / "out" / "a.zip") == "out/a.zip"


def test_what_was_answered_goes_along(kept, own_results):
    tried = {
        name: [{"kind": kind, "answer": "", "date": results.now()} for kind in tries]
        for name, tries in EXPECTED["answered"]["kinds"].items()
    }
    results.write_json(own_results / questions.RECORD, tried)
    found = handing_in.outcomes()
    counted = {name: [o.right, o.attempts] for name, o in found.items()}
    assert counted == EXPECTED["answered"]["outcomes"]
    assert read_bundle(submit("Ada").path).outcomes == found


def test_the_page_shows_it_escaped():
    shown = ck.submission.Handed(None, "<b>", ("<script>",))._repr_html_()
    assert "<script>" not in shown
    assert "&lt;script&gt;" in shown


# --- the command line ---


def test_the_command_packs_and_refuses_like_the_function(kept, own_results, capsys):
    words = own_results / "words.txt"
    words.write_text(PARAGRAPH, encoding="utf-8")
    arguments = ["submit", "--student", "Ada", "--distance", "0.45", "--frames", "30"]
    arguments += ["--dominates", RIGHT["dominates"], "--paragraph-file", str(words)]
    assert cli.main(arguments) == 0
    assert "Wrote results/studio_1_Ada.zip, 3 distances" in capsys.readouterr().out
    assert asdict(read_bundle(own_results / "studio_1_Ada.zip").conclusion) == RIGHT

    before = (own_results / "studio_1_Ada.zip").read_bytes()
    assert cli.main(["submit", "--student", "Ada"]) == 1
    assert "is there already and stays as it is" in capsys.readouterr().err
    assert (own_results / "studio_1_Ada.zip").read_bytes() == before
    assert cli.main(["submit", "--student", "Ada", "--overwrite"]) == 0
    assert read_bundle(own_results / "studio_1_Ada.zip").conclusion == Conclusion()
    assert cli.main([*arguments, "--folder", str(own_results / "x")]) == 0
    assert (own_results / "x" / "studio_1_Ada.zip").exists()
    assert cli.main(["submit", "--student", "A", "--paragraph-file", "nowhere"]) == 1
    assert "nowhere" in capsys.readouterr().err


ENCODINGS = [("utf-8", 0), ("utf-8-sig", 0), ("utf-16", 1), ("latin-1", 1)]


@pytest.mark.parametrize(("encoding", "code"), ENCODINGS)
def test_a_paragraph_that_is_not_utf_8_is_said_plainly(encoding, code, kept, own_results, capsys):
    Path("words.txt").write_text(f"Zoë: {PARAGRAPH}", encoding=encoding)
    arguments = ["submit", "--student", "Zoë", "--dominates", "Bias"]
    assert cli.main([*arguments, "--paragraph-file", "words.txt"]) == code
    if code:
        said = capsys.readouterr().err
        assert "words.txt: is no plain text in UTF-8; save it as that" in said
        assert said.count("\n") == 1
    else:
        conclusion = read_bundle(own_results / "studio_1_Zoë.zip").conclusion
        assert (conclusion.paragraph, conclusion.dominates) == (f"Zoë: {PARAGRAPH}", "bias")


# --- the notebook ---

CELLS = ("setup", "two-eyes", "keep", "sweep", "predict", "studio-capture", "table")
CELLS += ("quantities", "hand-in-table", "hand-in-keep", "hand-in-submit")
FILLED_IN = EXPECTED["filled_in"] | {
    "hand-in-submit": f"ck.submit('Ada', 0.45, 'bias', {PARAGRAPH!r}, 30, mismatches='kept')"
}


def textbook(z, at):
    """Bias, std and invalid part of depths (N, h, w), mm, as a careful student computes them; the
    standard errors with all samples taken as independent, which costs a half of their points."""
    std, n = float(np.sqrt(np.nanmean(np.nanvar(z, axis=0, ddof=1)))), len(z)
    errors = float(np.nanmean(z, axis=(1, 2)).std(ddof=1)) / n**0.5, std / (2 * n) ** 0.5
    return float(np.nanmean(z)) - at, errors[0], std, errors[1], float(np.isnan(z).mean())


def test_the_studio_cells_of_the_notebook_hand_in_what_they_say(own_results, capsys):
    """A textbook's analysis gets 95 points, untouched defaults at most 30; a dozen frames stand for
    a hundred, but at night."""
    notebook = nbformat.read(build_notebooks.NOTEBOOKS / "02_depth_noise.ipynb", as_version=4)
    sources = {cell.id: cell.source for cell in notebook.cells} | FILLED_IN
    names = {"textbook": textbook}
    for cell in CELLS:
        frames = "camera.frames(100" if NIGHTLY else "camera.frames(12"
        exec(sources[cell].replace("camera.frames(100", frames), names)
    packed = read_bundle(own_results / "studio_1_Ada.zip")
    found = grade(packed)
    wrong = {(item.topic, item.mistake) for item in found.items if item.verdict != "right"}
    few = 0 if NIGHTLY else 9 - 9 * 12 / 100  # of the points for raw depths
    assert found.points >= 95 - few
    assert wrong <= {("data", "too_few"), ("bias_se", "independent"), ("std_se", "one_pixel")}
    empty = replace(packed.claims, rows=()), replace(packed.plot, predicted_mm=None)
    untouched = replace(packed, claims=empty[0], plot=empty[1], conclusion=Conclusion())
    assert grade(untouched).points <= 30
    assert [flag for flag in found.flags if not flag.note] == []
