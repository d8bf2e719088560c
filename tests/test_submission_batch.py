"""A folder of bundles is graded to its end, whatever is in it, and goes on where it was stopped."""

import contextlib
import csv
import io
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
import zipfile
from collections.abc import Iterable
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from datetime import datetime
from pathlib import Path

import pytest
from common import EXPECTED, NIGHTLY
from hostile_bundles import ZOE
from misbehaving import fail, misbehave
from sample_submissions import canvas, class_names, class_zip, moodle, with_part

from coursekit import cli
from coursekit.specifications import DATA
from coursekit.submission import batch
from coursekit.submission.batch import Bundle, Limits
from coursekit.submission.format import NOBODY, Claims, bundle_bytes, zip_bytes
from coursekit.submission.recompute import grading_rules
from coursekit.submission.report import ReportLine

pytestmark = pytest.mark.usefixtures("ctrl_c_is_heard")
USUAL = {"impossible_times", "not_distance_dependent"}  # of the small bundle
SAMPLES = DATA / "sample_bundles"
GRADED = ("ada_good", "ben_weak", "cleo_wrong", "dan_copied", "eve_formula")


def table(out: Path, name: str = "grades.csv") -> list[dict[str, str]]:
    """The rows of a table in a report."""
    return list(csv.DictReader(io.StringIO((out / name).read_text(encoding="utf-8-sig"))))


def quick(folder: Path, names: Iterable[str]) -> Path:
    """A folder of small valid bundles."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in names:
        (folder / f"{name}.zip").write_bytes(bundle_bytes(replace(ZOE, student=name)))
    return folder


def graded(folder: Path, out: Path, workers: int = 1, **options) -> batch.Summary:
    """`grade_folder` with one process and without a progress bar."""
    return batch.grade_folder(folder, out, workers, progress=False, **options)


@pytest.fixture(scope="module")
def report(tmp_path_factory) -> Path:
    """The report on the sample bundles."""
    out = tmp_path_factory.mktemp("samples") / "report"
    said = str(graded(SAMPLES, out, workers=2))
    assert said.startswith("9 bundles in ")
    assert "5 graded, 4 refused, 5 flagged." in said
    return out


@pytest.fixture(autouse=True)
def patient(monkeypatch) -> None:
    """Beside other work processes may take minutes to start."""
    monkeypatch.setattr(batch, "PATIENCE_S", 600.0)


@pytest.fixture
def in_process(monkeypatch) -> None:
    """Bundles are graded here: for what is not about processes, of which each takes its time."""

    def run(bundles, work, limits):
        for bundle in bundles:
            yield bundle, work(str(bundle.path), bundle.name)

    monkeypatch.setattr(batch, "work_through", run)


# --- what comes out ---


def test_every_sample_bundle_has_its_row_in_the_order_of_names(report):
    rows = {row["file"].removesuffix(".zip"): row for row in table(report)}
    assert [row["file"] for row in rows.values()] == sorted(path.name for path in SAMPLES.iterdir())
    assert {rows[name]["status"] for name in GRADED} == {"graded"}
    for name, reason in EXPECTED["refused_samples"].items():
        assert rows[name]["status"] == f"not graded: {reason}"
        assert len(rows[name]["says"]) > 30
        assert rows[name]["points"] == ""
    percent = {name: float(rows[name]["percent"]) for name in GRADED}
    assert percent["ada_good"] == percent["dan_copied"] == 100  # a flag costs nothing
    assert percent["cleo_wrong"] < percent["ben_weak"] < 100
    flags = {name: rows[name]["flags"].removeprefix("another_unit ") for name in GRADED}
    assert flags["ada_good"] == flags["dan_copied"] == "nearly_identical same_words"
    assert flags["eve_formula"] == flags["ada_good"]  # of the same simulated camera, by right
    assert (flags["cleo_wrong"], flags["ben_weak"]) == ("same_words", "another_unit")


def test_the_report_holds_a_page_a_student_and_nothing_else(report):
    made = ["feedback.zip", "grades.csv", "index.html", "own_points.csv", "paragraphs.html"]
    made += ["second_marker.html", "students"]
    assert sorted(path.name for path in report.iterdir()) == [".rows", *made]
    pages = sorted(path.name for path in (report / "students").iterdir())
    assert [page.rpartition("_")[0] for page in pages] == list(GRADED)
    index = (report / "index.html").read_text(encoding="utf-8")
    assert all(f'href="students/{page}"' in index for page in pages)
    assert len(list((report / ".rows").glob("*.json"))) == 10  # and what the class had


def test_the_same_bytes_come_out_however_many_processes_there_are(in_process, report, tmp_path):
    graded(SAMPLES, tmp_path / "one")
    for path in report.rglob("*.*"):
        if path.is_file():
            assert (tmp_path / "one" / path.relative_to(report)).read_bytes() == path.read_bytes()


# --- what a bundle can do to a process ---


def outcomes(names: Iterable[str], limits: Limits) -> dict[str, ReportLine]:
    """What `work_through` makes of bundles of these names."""
    bundles = [Bundle(Path(name), name, name) for name in names]
    found = batch.work_through(bundles, misbehave, limits)
    return {bundle.name: line for bundle, (line, _) in found}


def test_the_batch_outlives_whatever_a_bundle_does_to_its_process():
    late = outcomes(["hang", "spin", "wait"], Limits(2, timeout_s=1.0))
    reasons = {name: line.reason for name, line in late.items()}
    assert reasons == {"hang": "timeout", "spin": "timeout", "wait": "well"}
    assert late["hang"].says == late["spin"].says
    assert "longer than 1 s" in late["spin"].says
    wanted = dict.fromkeys(("kill", "crash", "exit"), "died")
    wanted |= dict.fromkeys(("quit", "interrupt", "raise"), "error")
    names, before = [*wanted], dict(os.environ)
    for i in range(8):
        wanted[f"good {i}"] = "well"
        names.insert(2 * i, f"good {i}")
    found = outcomes(names, Limits(2, timeout_s=60.0))  # however busy the machine is
    assert dict(os.environ) == before
    assert {name: line.reason for name, line in found.items()} == wanted
    assert found["good 0"].says.split()[1] == "1"  # thread for linear algebra
    assert "SIGKILL" in found["kill"].says
    assert all(line.points is None for line in found.values())


@pytest.mark.skipif(sys.platform != "linux", reason="nothing else holds to a limit of memory")
def test_a_bundle_that_wants_too_much_memory_is_a_row_and_its_process_lives():
    found = outcomes(["good 0", "memory", "good 1"], Limits(1, memory_bytes=2**28))
    assert found["memory"].reason == "memory"
    assert found["good 0"].says == found["good 1"].says  # the same process


def test_processes_that_start_from_nothing_do_the_same(monkeypatch):
    """As on Windows and macOS."""
    monkeypatch.setattr(batch, "_context", lambda: multiprocessing.get_context("spawn"))
    found = outcomes(["kill", "good"], Limits(1))
    assert (found["kill"].reason, found["good"].reason) == ("died", "well")
    assert found["good"].says.split()[1] == "1"


def test_processes_are_replaced_after_some_bundles(monkeypatch):
    monkeypatch.setattr(batch, "MAX_TASKS", 2)
    found = outcomes("abc", Limits(1))
    assert len({line.says for line in found.values()}) == 2  # 3, and one that shows it is there


def test_processes_that_cannot_start_are_said(monkeypatch):
    monkeypatch.setattr(batch, "_warm_up", fail)
    with pytest.raises(ChildProcessError, match="cannot be started"):
        outcomes(["good"], Limits(1))


def test_a_pool_that_breaks_is_replaced_and_its_bundles_are_tried_again(monkeypatch):
    real, broken = batch._outcome, []

    def breaks(future, bundle, limits):
        if not broken or bundle.name == "always":
            broken.append(bundle.name)
            raise BrokenProcessPool
        return real(future, bundle, limits)

    monkeypatch.setattr(batch, "_outcome", breaks)
    names = ["a", "b", "c", "d", "always", "e", "f"]
    found = outcomes(names, Limits(1))
    wanted = dict.fromkeys(names, "well") | {"always": "lost"}
    assert {name: line.reason for name, line in found.items()} == wanted


# --- stopping and going on ---


def test_what_is_graded_is_not_graded_again(in_process, tmp_path, monkeypatch):
    folder, out = quick(tmp_path / "in", "abcd"), tmp_path / "out"
    assert graded(folder, out).kept == 0
    before = (out / "grades.csv").read_bytes()
    with pytest.raises(ValueError, match="holds a finished report already"):
        graded(folder, out)
    assert graded(folder, out, overwrite=True).kept == 4
    assert (out / "grades.csv").read_bytes() == before

    (folder / "b.zip").write_bytes(bundle_bytes(replace(ZOE, student="New")))
    (folder / "d.zip").rename(folder / "e.zip")
    (next((out / ".rows").glob("*.json"))).write_bytes(b"{")
    assert graded(folder, out, overwrite=True).kept in (1, 2)
    assert [row["student"] for row in table(out)] == ["a", "New", "c", "d"]
    assert len(list((out / "students").iterdir())) == 4  # the old pages of b and d are gone
    monkeypatch.setattr(batch, "grader_version", lambda: "another")
    assert graded(folder, out, overwrite=True).kept == 0


def test_what_failed_is_tried_again(tmp_path, monkeypatch):
    folder, out = quick(tmp_path / "in", ["a", "kill"]), tmp_path / "out"
    with monkeypatch.context() as patch:
        patch.setattr(batch.report, "grade_file", misbehave)
        first = graded(folder, out)
    assert (first.counts["failed"], first.counts["graded"]) == (1, 0)
    assert "1 not graded (time, memory or a crash)" in str(first)
    again = graded(folder, out, overwrite=True)
    assert (again.counts["failed"], again.counts["graded"], again.kept) == (0, 1, 1)


@pytest.mark.skipif(sys.platform == "win32", reason="Ctrl-C goes another way there")
def test_ctrl_c_keeps_what_is_done_and_the_same_command_goes_on(tmp_path, capsys):
    folder, out = quick(tmp_path / "in", ()), tmp_path / "out"
    for i in range(400):  # more than is graded before it is looked at
        (folder / f"{i:03d}.zip").write_bytes((SAMPLES / "ada_good.zip").read_bytes())
    command = ["grade", str(folder), "--out", str(out)]
    here = [sys.executable, "-m", "coursekit", *command, "--workers", "2"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    running = subprocess.Popen(here, start_new_session=True, **pipes)
    deadline = time.monotonic() + 600  # however busy the machine is
    while len(list(out.glob(".rows/*.json"))) < 5 and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(running.pid, signal.SIGINT)  # as a terminal does: to all of them
    said, error = running.communicate(timeout=600)
    assert (running.returncode, said) == (130, "")
    assert "bundles, which are kept. The same command goes on from there." in error
    assert "Traceback" not in error
    assert not (out / "grades.csv").exists()
    assert not list(out.rglob("*.part"))
    kept = {json.loads(path.read_bytes())["file"] for path in out.glob(".rows/*.json")}
    assert 5 <= (done := len(kept)) < 400

    for path in sorted(folder.iterdir())[5:]:  # enough to see that it goes on
        if path.name not in kept:
            path.unlink()
    assert cli.main([*command, "--workers", "1"]) == 0
    assert f"{done} of them had been graded before" in capsys.readouterr().out


def test_a_ctrl_c_that_nobody_heard_still_stops(tmp_path, monkeypatch):
    """Raised in a destructor or a callback, a KeyboardInterrupt goes no further."""

    def run(bundles, work, limits):
        for bundle in bundles:
            with contextlib.suppress(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            yield bundle, batch._failed(bundle, "error", error="Not tried.")

    monkeypatch.setattr(batch, "work_through", run)
    with pytest.raises(batch.Stopped, match="stopped after 1 of 3 bundles"):
        graded(quick(tmp_path / "in", "abc"), tmp_path / "out")


# --- folders ---


def test_only_bundles_are_looked_at(in_process, tmp_path):
    folder = quick(tmp_path / "in", ["b", "A"])
    quick(folder / "late" / "Ada_17", ["studio"])
    quick(folder / "__MACOSX", ["no"])
    for name in ("._b.zip", "essay.pdf"):
        (folder / name).write_bytes(b"")
    (folder / "UPPER.ZIP").write_bytes((folder / "b.zip").read_bytes())
    (folder / "linked").symlink_to(quick(tmp_path / "elsewhere", ["secret"]))
    summary = graded(folder, folder / "report")
    assert summary.left_out == ("essay.pdf", "linked")
    assert "left out: 2 files: essay.pdf; linked" in str(summary)
    names = [row["file"] for row in table(folder / "report")]
    assert names == ["A.zip", "UPPER.ZIP", "b.zip", "late/Ada_17/studio.zip"]
    again = graded(folder, folder / "report", overwrite=True)
    assert again.kept == 4  # the report in the folder is no bundle of it
    assert len(graded(folder, folder / "second").left_out) == 2  # nor an earlier run's


def test_what_is_kept_of_a_bundle_may_go_and_the_report_says_so(in_process, tmp_path, monkeypatch):
    real, out = batch._load, tmp_path / "out"
    monkeypatch.setattr(batch, "_load", lambda out, b: None if b.name == "a.zip" else real(out, b))
    summary = graded(quick(tmp_path / "in", "ab"), out)
    assert (summary.counts["graded"], summary.counts["failed"]) == (1, 1)
    assert [row["status"] for row in table(out)] == ["not graded: lost", "graded"]


@pytest.mark.skipif(sys.platform == "win32", reason="such paths cannot be made there")
def test_a_folder_in_a_folder_a_thousand_times(in_process, tmp_path, capsys):
    folder = quick(tmp_path / "in", ["a"])
    below = [*["d"] * 1100, "deep.zip"]
    (tmp_path / "lms.zip").write_bytes(zip_bytes({"/".join(below): bundle_bytes(ZOE)}))
    with contextlib.chdir(folder):
        for part in below[:-1]:
            os.mkdir(part)
            os.chdir(part)
        Path("deep.zip").write_bytes(bundle_bytes(ZOE))
    try:
        assert graded(folder, tmp_path / "out").counts["graded"] == 2
    finally:  # which pytest could not
        subprocess.run(["rm", "-rf", str(folder)], check=True)
    assert cli.main(["grade", str(tmp_path / "lms.zip"), "--out", str(tmp_path / "two")]) == 1
    assert "got 1101, want at most 100 folders in each other" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform != "linux", reason="such names cannot be made elsewhere")
def test_names_of_files_are_never_paths_or_code(in_process, tmp_path):
    folder, out = quick(tmp_path / "in", ()), tmp_path / "out"
    data = bundle_bytes(replace(ZOE, student="../../up"))
    names = [b"=1+1", b"<b>", b"a\nb", b"\xff\xfe", b"?", b"\xff", b"\xfe"]
    for name in names:
        (folder / os.fsdecode(name + b".zip")).write_bytes(data)
    assert graded(folder, out).counts["graded"] == len(names)
    assert len({row["file"] for row in table(out)}) == len(names)
    assert [path.parent for path in out.rglob("*.html")].count(out / "students") == len(names)
    for path in (out / "students").iterdir():
        assert path.name.isascii()
        assert path.name.removesuffix(".html").replace("_", "").isalnum()
    assert "<b>" not in (out / "index.html").read_text(encoding="utf-8")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["in", "out"]


@pytest.mark.parametrize("mine", ["out", "in", "out/thesis.tex", "out/mine/"])
def test_a_folder_that_is_no_report_is_not_touched(mine, tmp_path):
    folder, path = quick(tmp_path / "in", ["a"]), tmp_path / mine
    if mine.startswith("out/"):
        (tmp_path / "out").mkdir()
    if mine.endswith("/"):
        path.mkdir()
    elif mine != "in":
        path.write_text("mine", encoding="utf-8")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(ValueError, match="out: "):
        graded(folder, folder if mine == "in" else tmp_path / "out", overwrite=True)
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize(("change", "message"), EXPECTED["cannot_grade"])
def test_what_cannot_be_is_said_before_anything_is_made(change, message, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    quick(tmp_path / "in", ["a"])
    quick(tmp_path / "empty", ())
    (quick(tmp_path / "papers", ()) / "a.pdf").write_bytes(b"")
    zipfile.ZipFile("a.zip", "w").close()
    Path("roster.csv").write_text("Vorname;Nachname\nAda;Honest\n", encoding="utf-8")
    choices = batch.Choices(change.pop("roster", None))
    with pytest.raises(ValueError, match=message):
        graded(**{"folder": "in", "out": "out", "choices": choices} | change)
    assert not (tmp_path / "out").exists()


# --- a class ---

LMS = {"Moodle": (moodle, "Identifier", "Participant {}", "Vollständiger Name")}
LMS |= {"Canvas": (canvas, "ID", "{}", "Student")}


@pytest.mark.parametrize("lms", LMS)
def test_everybody_of_a_class_has_a_row_and_nobodys_grade_is_anothers(
    lms, in_process, tmp_path, monkeypatch
):
    """And the table for the LMS, read as it is documented, says the same."""
    monkeypatch.chdir(tmp_path)
    n, (of, column, number, title) = 120 if NIGHTLY else 16, LMS[lms]
    names = class_names(n)
    Path("all.zip").write_bytes(class_zip(ZOE, n, of))
    lines = [f"{number.format(1000 + i)};{name};{'AB'[i % 2]}" for i, name in enumerate(names)]
    Path("class.csv").write_text("\n".join([f"{column};{title};Section", *lines]), "utf-8-sig")
    choices = batch.Choices("class.csv", datetime(2026, 3, 4))
    summary = batch.grade_folder("all.zip", progress=False, choices=choices)
    assert summary.missing == tuple(names[:2])
    assert sum("“Studio exercise 1”" in note for note in summary.notes) == (lms == "Canvas")
    rows = table(out := Path("all_report"))
    status: dict[str, list[str]] = {}
    for row in rows:
        status.setdefault(row["student"], []).append(row["status"].removeprefix("not graded: "))
    odd = {0: ["missing"], 1: ["missing"], 3: ["graded"] * 3, 14: ["not_a_zip"], 8: ["no_bundle"]}
    odd |= {4: ["not_a_zip"]} | ({} if lms == "Moodle" else {6: ["no_bundle"]})
    assert status == {name: odd.get(i, ["graded"]) for i, name in enumerate(names)}
    assert {row["student"] for row in rows if row["late"] == "yes"} == {names[2]}
    assert [row["counts"] for row in rows if row["student"] == names[3]] == ["no", "yes", "no"]
    assert all(row["Section"] == "AB"[names.index(row["student"]) % 2] for row in rows)
    flags = {row["student"]: {*row["flags"].split()} - USUAL for row in rows}
    seen = {names[9]: {"another_student", "wrong_clock"}, names[13]: {"other_name"}}
    assert {name: codes for name, codes in flags.items() if codes} == seen
    graded = {row["student"]: row["total"] for row in rows if row["counts"] == "yes"}
    imported = {row[column]: row for row in table(out, f"{lms.lower()}.csv")}
    points = "Grade" if lms == "Moodle" else "Studio exercise 1"
    for i, name in enumerate(names):
        if name in graded or i < 2:
            assert imported[number.format(1000 + i)][points] == graded.get(name, "")
    with zipfile.ZipFile(out / "feedback.zip") as packed:
        assert of(names[15], 15, "feedback.html" if lms == "Moodle" else "studio_1.html") in (
            packed.namelist()
        )


@pytest.mark.parametrize("lms", LMS)
def test_what_the_instructor_decides_reaches_everybody(lms, in_process, tmp_path, monkeypatch):
    """From zip to import, with a gradebook of Canvas: a copied bundle, one that is late, a broken
    one, and nothing."""
    monkeypatch.chdir(tmp_path)
    Path("class.csv").write_text(EXPECTED["gradebook"], encoding="utf-8")
    typed = {"Eve Martin": "Hana Sato", "Łukasz Żółć": "lukasz zolc", "Bo Lee": ""}
    of, where = LMS[lms][0], {}
    with zipfile.ZipFile("all.zip", "w") as packed:
        for i, (name, said) in enumerate(typed.items()):
            file = of(name, i if name != "Bo Lee" else 2, "s.zip").replace("_LATE", "")
            where[name] = of(name, i, "feedback.html" if lms == "Moodle" else "s.html")
            data = bundle_bytes(replace(ZOE, student=said)) if said else b"no"
            packed.writestr(zipfile.ZipInfo(file, (2026, 3, 2 + i, 13, 0, 0)), data)
    where["Bo Lee"] = where["Bo Lee"].replace("_LATE", "")
    how = batch.Choices("class.csv", datetime(2026, 3, 2, 14), assignment="depth noise")
    out = Path("all_report")

    def run() -> tuple[str, dict[str, dict[str, str]], dict[str, str]]:
        said = str(batch.grade_folder("all.zip", progress=False, overwrite=True, choices=how))
        rows = {row["Student"]: row for row in table(out, "canvas.csv")}
        with zipfile.ZipFile(out / "feedback.zip") as packed:
            pages = {name: packed.read(file).decode() for name, file in where.items()}
        return said, rows, pages

    said, rows, pages = run()
    assert "Missing: 1 student: Absent, Ann\n" in said
    assert ("gradebook's of 20: set" in said, "--assignment" in said) == (True, False)
    assert "could not be graded, so hand in another. The file is no zip" in pages["Bo Lee"]
    assert "<h1>Studio exercise 1: Eve Martin</h1>" in pages["Eve Martin"]
    assert "The name in the file is Hana Sato." in pages["Eve Martin"]
    assert "Handed in 3 March 2026, 13:00: 23 h 0 min late." in pages["Łukasz Żółć"]
    index = (out / "index.html").read_text(encoding="utf-8")
    assert "Lee, Bo is asked to hand it in again." in index
    assert index.count("Absent, Ann") == 3  # missing, and twice among everybody
    assert "other_name" not in {row["student"]: row["flags"] for row in table(out)}["Żółć, Łukasz"]
    assert len(list((out / "students").glob("martin_eve_*.html"))) == 1
    assert (out / "moodle.csv").exists() == (lms == "Moodle")

    own = "who,overrule,comment\n1000,50,well tried\n1002,0,too late\n1003,,excused\n"
    (out / "own_points.csv").write_text(own, encoding="utf-8")
    said, rows, pages = run()
    assert said.startswith("3 bundles: 2 graded, 1 refused")
    column = "Homework depth noise (4711)"
    who = ("Martin, Eve", "Lee, Bo", "Absent, Ann", "    Points Possible")
    assert [rows[name][column] for name in who] == ["50", "0", "", "20"]
    assert [*rows["Lee, Bo"].values()][:5] == ["Lee, Bo", "1002", "s2", "bo", "B"]
    assert "<strong>50 of 100 points." in pages["Eve Martin"]
    assert "Your instructor set the total. Computed were " in pages["Eve Martin"]
    assert "well tried" in pages["Eve Martin"]
    assert "<strong>0 of 100 points." in pages["Bo Lee"]
    assert "50 of 100 (yours; " in (out / "index.html").read_text(encoding="utf-8")
    if lms == "Moodle":
        (bo,) = [row for row in table(out, "moodle.csv") if row["Full name"] == "Lee, Bo"]
        said = "too late | Your instructor set the total."
        assert (bo["Grade"], bo["Feedback comments"]) == ("0", said)


def test_own_points_survive_a_regrade_which_says_what_changed(in_process, tmp_path, monkeypatch):
    folder, out = quick(tmp_path / "in", ["a", "b", "c"]), tmp_path / "out"
    before = graded(folder, out)
    own = out / "own_points.csv"
    codes = {row["student"]: row["code"] for row in table(out, "own_points.csv")}
    second = f";;{codes['a']};0;;;\n;;{codes['b']};;;;terse\n{codes['b']};0,5\npabcdef;1\n"
    text = f"who;student;code;paragraph;late;overrule;comment\na;a;;1,5;-1;;\n{second}"
    own.write_text(text, encoding="utf-8-sig")
    kept = own.read_bytes()
    (out / "grades.csv").write_text("edited", encoding="utf-8")
    junk = (".DS_Store", "Thumbs.db", "desktop.ini", "~$grades.xlsx", ".~lock.grades.csv#")
    for name in (*junk, "grades.xlsx", "a.txt", "students/.DS_Store", "students/a.png", ".rows/x"):
        (out / name).write_bytes(b"mine")
    foreign = {path for path in out.rglob("*") if path.is_file()}
    summary = graded(folder, out, overwrite=True)
    first = next(row for row in table(out) if row["student"] == "a")
    machine = float(first["points"]) - float(first["paragraph"])
    assert float(first["total"]) == pytest.approx(machine + 1.5 - 1)
    why = "your own points changed"
    assert summary.changes[0] == ("a", f"{float(first['points']):g}", first["total"], why)
    other = next(row for row in table(out) if row["student"] == "b")
    assert float(other["total"]) == float(other["points"]) - float(other["paragraph"]) + 0.5
    assert other["comment"] == "terse"
    assert "another row: a (another row of theirs counts); pabcdef." in str(summary)
    assert "grades.csv had been edited: your copy of it is grades_edited_" in str(summary)
    assert summary.kept == before.counts["graded"] == 3
    assert own.read_bytes() == kept
    assert all(path.exists() for path in foreign)
    (edited,) = out.glob("grades_edited_*.csv")
    assert edited.read_text(encoding="utf-8") == "edited"
    with pytest.raises(ValueError, match="is the report of other bundles"):
        graded(quick(tmp_path / "another", ["d"]), out, overwrite=True)
    monkeypatch.setitem(grading_rules()["points"], "paragraph", 4)
    monkeypatch.setattr(batch, "grader_version", lambda: "another")
    (change,) = [c for c in graded(folder, out, overwrite=True).changes if c[0] == "c"]
    assert "the rubric or the grader changed; paragraph " in change[3]


@pytest.mark.parametrize(("row", "said"), EXPECTED["bad_own_points"])
def test_own_points_that_cannot_be_are_refused_before_any_work(row, said, tmp_path):
    out = quick(tmp_path / "out", ())
    (out / "own_points.csv").write_text(row, "utf-8")
    with pytest.raises(ValueError, match=rf"^own_points\.csv: {said}"):
        graded(quick(tmp_path / "in", ["a"]), out)


def test_own_points_and_namesakes_outlive_another_roster(in_process, tmp_path, monkeypatch):
    """Two Kim Lees and Jon, by a list with the LMS's numbers, then by its own table."""
    monkeypatch.chdir(tmp_path)
    people = {17: "Kim Lee", 18: "Kim Lee", 19: "Late, Jon"}
    with zipfile.ZipFile("all.zip", "w") as packed:
        for number, name in people.items():
            file = f"{name}_{number}_assignsubmission_file_/s.zip"
            packed.writestr(file, bundle_bytes(replace(ZOE, student=name)))
    lists = {"Participant {}": "Identifier", "{}": "id", "s{}": "login"}
    for of, column in lists.items():
        rows = [f'{of.format(number)},"{name}"\n' for number, name in people.items()]
        Path(f"{column}.csv").write_text(f"{column},name\n{''.join(rows)}", encoding="utf-8")

    def run(column: str) -> tuple[batch.Summary, dict[str, str]]:
        choices = batch.Choices(f"{column}.csv")
        summary = batch.grade_folder("all.zip", overwrite=True, progress=False, choices=choices)
        rows = table(Path("all_report"), "moodle.csv")
        return summary, {row["Identifier"].split()[1]: row["Grade"] for row in rows}

    summary, computed = run("id")
    assert (summary.missing, len(table(Path("all_report")))) == ((), 3)
    own = "who,student,overrule\n18,Kim Lee,77\n19,x,66\n20,Nobody,55\n21,Empty,\n"
    Path("all_report/own_points.csv").write_text(own, encoding="utf-8")
    for column, jon in (("id", "66"), ("Identifier", computed["19"])):
        summary, grades = run(column)
        assert grades == {"17": computed["17"], "18": "77", "19": jon}
    assert "another row: x (19); Nobody (20)." in str(summary)
    again = batch.grade_folder("all.zip", overwrite=True, progress=False)
    assert "Without --roster, which the last report had" in str(again)
    own = own.replace("19,x", '19,"Jon Late"')
    Path("all_report/own_points.csv").write_text(own, encoding="utf-8")
    summary, grades = run("Identifier")
    assert (grades["18"], grades["19"]) == ("77", "66")
    assert "NOT USED, for these rows fit nobody of this class" in str(summary)
    assert "another row: Nobody (20)." in Path("all_report/index.html").read_text(encoding="utf-8")
    summary, grades = run("login")  # nothing tells the two apart
    assert (summary.missing, len(table(Path("all_report")))) == ((), 3)
    assert grades == {"17": computed["17"], "18": "77", "19": "66"}
    flags = {row["who"]: row["flags"] for row in table(Path("all_report"))}
    assert ["namesakes" in flags[who] for who in ("Moodle 17", "Moodle 18", "s19")] == [1, 1, 0]


def test_without_an_lms_a_name_typed_twice_takes_nobodys_points(in_process, tmp_path):
    folder, out = tmp_path / "in", tmp_path / "out"
    good, weak = ZOE, replace(ZOE, made="2026-03-05T12:00:00+00:00", claims=Claims())
    for place, one in (("zoe", good), ("mallory", weak)):
        (quick(folder / place, ()) / "s.zip").write_bytes(bundle_bytes(one))
    graded(folder, out)
    rows = {row["file"]: row for row in table(out)}
    assert [rows[f"{at}/s.zip"]["counts"] for at in ("zoe", "mallory")] == ["yes", "no"]
    assert all("same_name" in row["flags"] for row in rows.values())


@pytest.mark.parametrize(("n", "who"), [(2, "a"), (1, "file studio_1.measured")])
def test_a_measurement_without_a_name_never_counts_beside_its_bundle(n, who, in_process, tmp_path):
    """n: of its two distances."""
    later, out = {"made": "2026-03-05T12:00:00+00:00", "stacks": ZOE.stacks[:n]}, tmp_path / "out"
    kept = replace(with_part(ZOE, "conclusion", paragraph=""), student=NOBODY, **later)
    (quick(tmp_path / "in", "a") / "studio_1.measured").write_bytes(bundle_bytes(kept))
    graded(tmp_path / "in", out)
    rows, counts = table(out), ["yes", "yes" if n == 1 else "no"]
    assert [(row["who"], row["counts"]) for row in rows] == [*zip(["a", who], counts, strict=True)]
    assert [bool({*row["flags"].split()} - USUAL) for row in rows] == [False, n == 1]
    told = [b"hand in the zip" in page.read_bytes() for page in (out / "students").iterdir()]
    assert sorted(told) == [False, n == 1]


def test_a_bundle_by_itself_is_graded_and_graded_again(in_process, tmp_path):
    bundle, out = quick(tmp_path / "in", ["a"]) / "a.zip", tmp_path / "out"
    assert [graded(bundle, out, overwrite=True).kept for _ in "12"] == [0, 1]
    assert [(row["file"], row["handed in"]) for row in table(out)] == [("a.zip", "")]


def test_two_graders_do_not_write_one_report(in_process, tmp_path):
    folder, out = quick(tmp_path / "in", ["a"]), tmp_path / "out"
    graded(folder, out)
    with batch._alone(out), pytest.raises(ValueError, match="another `coursekit grade`"):
        graded(folder, out, overwrite=True)


# --- the command ---


def test_the_command_says_what_to_do_next(tmp_path, capsys):
    folder, out = quick(tmp_path / "in", ["a"]), tmp_path / "out"
    (folder / "b.zip").write_bytes(b"nothing")
    command = ["grade", str(folder), "--out", str(out), "--workers", "1", "--timeout", "20"]
    assert cli.main(command) == 0
    said = capsys.readouterr()
    assert "1 graded, 1 refused" in said.out
    assert f"Open {out / 'index.html'}" in said.out
    assert "2/2" in said.err  # the progress bar

    assert cli.main(command) == 1
    assert "--overwrite" in capsys.readouterr().err
    assert cli.main([*command, "--overwrite"]) == 0
    assert "2 of them had been graded before" in capsys.readouterr().out
    assert cli.main(["grade", str(tmp_path / "x"), "--out", str(out)]) == 1
    assert capsys.readouterr().err.startswith("coursekit: ")
