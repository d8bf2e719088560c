"""The command line: what it writes, what it says, how it exits."""

import re
import tomllib
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from common import CHARUCO, EXPECTED
from fake_realsense import real_library

from coursekit import cli
from coursekit.boards import Board, save_sheet
from coursekit.boards.board import Skipped
from coursekit.cameras import CameraError, open_camera
from coursekit.cameras.simulated import SimulatedCamera
from coursekit.results import ROOT
from coursekit.simulation.arm_sessions import truth_of
from coursekit.specifications import DATA
from coursekit.words import Estimate, Finding, Findings

FINDINGS = Path(cli.__file__).with_name("findings.toml")


@pytest.mark.usefixtures("small_cameras")
def test_record_writes_a_recording_and_says_how_to_play_it(tmp_path, capsys):
    real_library()
    path = tmp_path / "a.db3"
    arguments = ["record", "--out", str(path), "--frames", "3", "--camera", "simulated"]
    assert cli.main(arguments) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0].startswith("Simulated D435, seed 7: no real camera in use.")
    assert said[-1] == f"Wrote {path}. Play it with ck.open_camera({str(path)!r})."
    with open_camera(path) as played:
        assert len(played.frames(3)) == 3

    assert cli.main(arguments) == 1
    assert capsys.readouterr().err.endswith(
        "a.db3 exists already: choose another name or --overwrite\n"
    )
    assert cli.main([*arguments, "--overwrite"]) == 0


def test_it_says_which_course_this_is(capsys):
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out == f"coursekit {cli.doctor.edition()}\n"


@pytest.mark.parametrize(("arguments", "message"), EXPECTED["cli_failures"])
def test_a_failure_is_one_line_and_exit_code_1(arguments, message, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert cli.main(arguments.split()) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"coursekit: {message}")
    assert error.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_board_writes_a_sheet_and_says_what_it_is(tmp_path, capsys):
    path = tmp_path / "board.pdf"
    arguments = ["board", "--kind", "charuco", "--squares", "9x6", "--square-mm", "25,0"]
    assert cli.main([*arguments, "--out", str(path)]) == 0
    said = capsys.readouterr().out.splitlines()
    assert said[0] == (
        f"Wrote {path}: ChArUco board, 9x6 squares (8x5 inner corners), square 25 mm, "
        "marker 18.75 mm, DICT_5X5_250."
    )
    assert path.read_bytes() == save_sheet(CHARUCO, tmp_path / "same.pdf").read_bytes()
    assert said[-1] == f"In Python: {CHARUCO!r}"
    assert eval(said[-1].removeprefix("In Python: "), {"Board": Board}) == CHARUCO

    assert cli.main([*arguments, "--out", str(path)]) == 1
    assert capsys.readouterr().err.endswith("choose another name or --overwrite\n")
    changed = [*arguments, "--marker-mm", "15", "--dictionary", "DICT_4X4_50", "--paper", "a3"]
    assert cli.main([*changed, "--out", str(path), "--overwrite"]) == 0
    assert "marker 15 mm, DICT_4X4_50." in capsys.readouterr().out


@pytest.mark.parametrize(("arguments", "message"), EXPECTED["cli_usage"])
def test_usage_is_told_and_wrong_usage_exits_with_2(arguments, message, capsys):
    with pytest.raises(SystemExit) as caught:
        cli.main(arguments.split())
    said = "".join(capsys.readouterr())
    assert caught.value.code == (0 if "--help" in arguments else 2)
    assert said.startswith("usage: coursekit")
    assert message in " ".join(said.split())


def test_a_day_alone_is_its_end():
    said = [str(cli.TYPES["moment"](text)) for text in ("2026-03-02", "2026-03-02T10:00")]
    assert said == ["2026-03-02 23:59:59", "2026-03-02 10:00:00"]


@pytest.mark.parametrize(("error", "code"), [(CameraError("gone"), 1), (KeyboardInterrupt(), 130)])
def test_a_camera_that_fails_at_once(error, code, tmp_path, monkeypatch, capsys):
    real_library()

    def fail(self):
        raise error
        yield

    monkeypatch.setattr(SimulatedCamera, "stream", fail)
    arguments = ["record", "--out", str(tmp_path / "a.db3"), "--frames", "3"]
    assert cli.main([*arguments, "--camera", "simulated"]) == code
    assert capsys.readouterr().err.startswith("coursekit: ")
    assert list(tmp_path.iterdir()) == []


def test_photographs_become_a_lens_and_a_place(tmp_path, capsys):
    board = "--squares 9x6 --square-mm 25 --kind charuco"
    lens, urdf = tmp_path / "camera_info.yaml", tmp_path / "camera.urdf"
    session = ROOT / "data" / "hand_eye_in_hand"
    assert cli.main(f"calibrate {session} {board} --out {lens}".split()) == 0
    said = capsys.readouterr().out
    assert said.startswith("Good: ")
    assert said.splitlines()[-1] == "Wrote camera_info.yaml."
    assert len(said.split()) < 80
    place = f"--lens {lens} --mount eye_in_hand --parent tool0 --out {urdf}"
    assert cli.main(f"hand-eye {session} {board} {place}".split()) == 0
    said = capsys.readouterr().out
    assert said.startswith("Good: ")
    assert len(said.split()) < 120
    text = urdf.read_text("utf-8")
    written = ElementTree.fromstring(f"<robot>{text}</robot>").find("joint")
    xyz = [float(number) for number in written.find("origin").get("xyz").split()]
    assert written.find("parent").get("link") == "tool0"
    assert np.linalg.norm(xyz - truth_of(session).X[:3, 3]) < 0.01


@pytest.mark.parametrize(
    "command", ["calibrate", "hand-eye --lens a --mount eye_in_hand --parent b"]
)
def test_a_file_that_is_there_is_refused_before_the_work(command, tmp_path, capsys):
    (tmp_path / "a.yaml").write_text("mine", encoding="utf-8")
    options = f"no_folder --squares 9x6 --square-mm 25 --out {tmp_path / 'a.yaml'}"
    assert cli.main(f"{command} {options}".split()) == 1
    assert capsys.readouterr().err.endswith("choose another name or --overwrite\n")


REMEDIES = {
    f"{room}.{name}": finding["remedy"]
    for room in ("intrinsics", "hand_eye")
    for name, finding in tomllib.loads(FINDINGS.read_text("utf-8"))[room]["findings"].items()
    if "remedy" in finding and name != "camera_axes"  # of poses, which no command takes
}


def test_the_mount_is_the_first_thing_to_check():
    shared = tomllib.loads(FINDINGS.read_text("utf-8"))["shared"]["inconsistent_convention"]
    assert cli._typed(shared["remedy"]).startswith("First check --mount: does the camera ride on")


@pytest.mark.parametrize("name", REMEDIES)
def test_a_remedy_speaks_of_options(name):
    said = cli._typed(REMEDIES[name])
    assert len(said) > 30
    assert not re.search(r"(?<!/)\b\w+\([^)]*\)|=['\"(\[]|`\w+[.(]|square_m|np\.|\[:", said), said


@pytest.mark.parametrize(("python", "typed"), EXPECTED["advice"])
def test_advice_speaks_of_options(python, typed):
    assert cli._typed(python) == typed


class Judged(Estimate):
    """A result of which only the verdict is asked."""

    def __init__(self, grade):
        self.grade = grade

    def verdict(self):
        return f"{self.grade}: the intervals\n  hold.\n- turn the wrist."

    def __repr__(self):
        return "X"


def test_the_verdict_comes_first(capsys):
    skipped = [Skipped(f"{k}.png", "blank" if k else "odd") for k in range(3)]
    cli._say_how_good(Judged("Good"), skipped, Findings(), False)
    said = capsys.readouterr().out.splitlines()
    assert said[:2] == ["Good: the intervals hold.", "- turn the wrist."]
    assert said[2:4] == ["not used: 1.png, 2.png: blank", "not used, either: 0.png"]


def test_the_exit_code_says_what_is_not_to_be_trusted(tmp_path, capsys):
    session = DATA / "hand_eye_in_hand"
    options = "--kind charuco --squares 9x6 --square-mm 32 --mount eye_in_hand --parent x"
    files = f"--lens {session / 'session.json'} --out {tmp_path / 'camera.urdf'}"
    assert cli.main(f"hand-eye {session} {options} {files}".split()) == 3
    assert capsys.readouterr().out.startswith("Not to be")
    assert (tmp_path / "camera.urdf").is_file()


def test_a_finding_leaves_room_for_what_is_weak_besides(capsys):
    found = Findings(
        [Finding("bowed_board", "S", "E", "Take glass. "), Finding("blur", "S", "E", "")]
    )
    cli._say_how_good(Judged("Not good enough"), [], found, False, ["30 deg or more."])
    said = capsys.readouterr().out.splitlines()[1:4]
    assert said == ["Do first: Take glass.", "Found: Bowed board; Blur.", "- 30 deg or more."]
