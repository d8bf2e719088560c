"""`coursekit doctor`: each fault has its line and its remedy, and none stops the rest."""

import importlib
import json
import re
import subprocess
import sys
import tempfile
import webbrowser
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from common import EXPECTED
from fake_realsense import SERIAL

from coursekit import doctor, results
from coursekit.doctor import CheckUp, checks
from coursekit.geometry import Intrinsics

UDEV = "99-realsense-libusb.rules"


@pytest.fixture(autouse=True)
def alone(monkeypatch, tmp_path):
    """No camera, no variable; a screen with a browser; results of its own."""
    for name in ("COURSEKIT_CAMERA", "JUPYTERHUB_SERVICE_PREFIX"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv("COURSEKIT_RESULTS", str(tmp_path / "results"))
    monkeypatch.setattr(webbrowser, "get", lambda: SimpleNamespace(name="firefox"))


@pytest.fixture
def quick(monkeypatch):
    """Without the checks of the computer, and with few frames of the camera."""
    monkeypatch.setattr(doctor, "COMPUTER", ())
    monkeypatch.setattr(doctor, "TEST_FRAMES", 8)


def examine(camera="auto"):
    return list(checks(camera))


def line(lines, check):
    """The only line of this check; the last, where the camera has two."""
    found = [one for one in lines if one.check == check]
    assert found, [one.check for one in lines]
    return found[-1]


def expect(found, verdict, says="", remedy=""):
    assert found.verdict == verdict, str(found)
    assert says in found.says
    assert remedy in found.remedy


def stop(error):
    raise error


# --- the computer ---


def test_this_computer_with_the_simulated_camera(capsys):
    assert doctor.run("simulated") in (0, 1)  # packages of its own are the developer's affair
    said = capsys.readouterr().out
    for check in ("Python", "Packages", "Loading", "Kernel", "Browser", "results/", "Camera"):
        assert f" {check} " in said
    assert "Simulated D435" in said
    assert "could not be checked" not in said


@pytest.mark.parametrize(("attribute", "value", "verdict", "says"), EXPECTED["pythons"])
def test_python(monkeypatch, attribute, value, verdict, says):
    if attribute == "machine":
        monkeypatch.setattr(sys, "platform", "win32" if value == "ARM64" else "darwin")
        monkeypatch.setattr(doctor.platform, "machine", lambda: value)
    else:
        monkeypatch.setattr(sys, attribute, tuple(value) if attribute == "version_info" else value)
    found = doctor._python()
    assert found.verdict == verdict
    assert re.search(says, found.says)
    assert ("Python 3.14" in found.remedy or "a hub" in found.remedy) == (verdict != "ok")


@pytest.mark.parametrize(("brings", "version", "verdict"), EXPECTED["brings_opencv"])
def test_one_package_brings_opencv(monkeypatch, brings, version, verdict):
    if version:
        monkeypatch.setattr("cv2.__version__", version)
    monkeypatch.setattr(doctor.metadata, "packages_distributions", lambda: {"cv2": brings})
    found = doctor._opencv()
    assert found.verdict == verdict
    assert ("pip uninstall" in found.remedy) == (verdict == "problem")


def test_the_same_for_programs(monkeypatch, capsys):
    monkeypatch.setattr(doctor, "COMPUTER", (("Python", doctor._python),))
    monkeypatch.setattr(doctor, "_cameras", lambda which: CheckUp("problem", f"no {which}", "buy"))
    assert doctor.run("auto", as_json=True) == 1
    said = json.loads(capsys.readouterr().out)
    assert said["coursekit"] == doctor.edition()
    camera = {"verdict": "problem", "says": "no auto", "remedy": "buy", "check": "Camera"}
    assert said["checks"][-1] == camera


@pytest.mark.parametrize(("name", "version", "verdict", "says", "remedy"), EXPECTED["packages"])
def test_packages(monkeypatch, tmp_path, name, version, verdict, says, remedy):
    """A requirements file with two packages, and one for another system."""
    (tmp_path / "requirements.txt").write_text(EXPECTED["pins"], encoding="utf-8")
    installed = {"numpy": "2.4.0", "tomlish": "9"} | {name: version}
    monkeypatch.setattr(doctor, "PINS", tmp_path / "requirements.txt")
    monkeypatch.setattr(doctor, "_version", installed.get)
    monkeypatch.setattr(doctor.metadata, "requires", lambda name: ["numpy>=2.3"])
    expect(next(doctor._packages()), verdict, says, remedy)


def test_every_line_of_the_real_requirements_is_understood():
    text = (results.ROOT / "requirements.txt").read_text(encoding="utf-8")
    packages = [row for row in text.splitlines() if row and not row.startswith((" ", "#"))]
    assert len(doctor.pins(results.ROOT / "requirements.txt")) == len(packages)


def test_a_package_that_does_not_load(monkeypatch):
    real = importlib.import_module

    def broken(name):
        if name == "cv2":
            raise ImportError("libGL.so.1: cannot open shared object file\nmore")
        return real(name)

    monkeypatch.setattr(importlib, "import_module", broken)
    says = "cv2 does not load (libGL.so.1: cannot open shared object file)"
    expect(doctor._loading(), "problem", says, "course.py lab")


@pytest.mark.parametrize(
    ("command", "verdict"),
    [
        ("python", "ok"),
        ("python3.11", "ok"),
        (sys.executable, "ok"),
        (str(Path("elsewhere") / "bin" / "python"), "problem"),
    ],
)
def test_the_kernel(monkeypatch, command, verdict):
    from jupyter_client import kernelspec

    spec = SimpleNamespace(argv=[command, "-m", "ipykernel_launcher"], resource_dir="kernels")
    monkeypatch.setattr(kernelspec.KernelSpecManager, "get_kernel_spec", lambda self, name: spec)
    remedy = "jupyter kernelspec remove python3" if verdict == "problem" else ""
    expect(doctor._kernel(), verdict, remedy=remedy)
    missing = partial(stop, kernelspec.NoSuchKernel("python3"))
    monkeypatch.setattr(kernelspec.KernelSpecManager, "get_kernel_spec", lambda *_: missing())
    expect(doctor._kernel(), "problem", "there is no kernel python3")


def test_browsers(monkeypatch):
    assert doctor._browser() == CheckUp("ok", "firefox opens the notebooks")
    missing = partial(stop, webbrowser.Error("could not locate runnable browser"))
    monkeypatch.setattr(webbrowser, "get", missing)
    expect(doctor._browser(), "note", remedy="prints an address")
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("DISPLAY")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    expect(doctor._browser(), "note", "no screen", "ssh -L")
    monkeypatch.setenv("JUPYTERHUB_SERVICE_PREFIX", "/user/ada/")
    assert doctor._browser().verdict == "ok"


def test_results_are_tried_without_leaving_anything(tmp_path):
    assert doctor._results().verdict == "ok"
    assert not (tmp_path / "results").exists()


def test_results_that_cannot_be_written(monkeypatch, tmp_path):
    refuse = partial(stop, PermissionError(13, "Permission denied"))
    with monkeypatch.context() as patch:
        patch.setattr(tempfile, "TemporaryFile", lambda dir: refuse())
        expect(doctor._results(), "problem", "(Permission denied)", "COURSEKIT_RESULTS")
    with monkeypatch.context() as patch:
        patch.setattr(doctor.shutil, "disk_usage", lambda path: SimpleNamespace(free=2_000_000))
        expect(doctor._results(), "problem", "only 2 MB")
    (tmp_path / "results").write_text("a file", encoding="utf-8")
    assert doctor._results().verdict == "problem"


# --- nothing stops it ---


@pytest.mark.parametrize("error", [ImportError, OSError, RuntimeError, SyntaxError, ValueError])
def test_what_a_check_raises_becomes_a_line(error):
    def fail():
        yield CheckUp("ok", "so far")
        raise error("broken")

    first, found = doctor._named("Packages", fail)
    assert (first.check, first.says) == ("Packages", "so far")
    expect(found, "problem", f"could not be checked ({error.__name__}", "course.py lab")


def test_without_numpy_or_any_package_at_all():
    """As a student may see it: a Python without site-packages; a line for everything, no trace."""
    command = [sys.executable, "-S", "-m", "coursekit.doctor"]
    streams = {"capture_output": True, "encoding": "utf-8"}
    result = subprocess.run(command, cwd=results.ROOT, check=False, **streams)
    assert (result.returncode, result.stderr) == (1, "")
    assert "numpy does not load" in " ".join(result.stdout.split())
    assert "Camera       could not be checked (ModuleNotFoundError" in result.stdout
    assert "course.py lab" in result.stdout


def test_ctrl_c_is_not_contained():
    with pytest.raises(KeyboardInterrupt):
        next(doctor._named("Packages", lambda: stop(KeyboardInterrupt())))


def test_a_line_as_it_is_printed():
    assert str(CheckUp("ok", "fine", check="USB")) == "ok       USB          fine"
    long = str(CheckUp("problem", "slow " * 40, "push it " * 30, check="USB")).splitlines()
    assert all(len(row) <= doctor.LINE_WIDTH for row in long)
    assert any(row.strip().startswith("-> push it") for row in long)


def test_the_exit_code(quick, monkeypatch, capsys):
    for verdict, code in (("ok", 0), ("note", 0), ("problem", 1)):
        monkeypatch.setattr(doctor, "checks", lambda camera, v=verdict: [CheckUp(v, "x")])
        assert doctor.run() == code
    assert "1 problem: do what stands there" in capsys.readouterr().out


# --- no camera, or one that cannot be used ---


def test_no_camera_is_fine(quick, plug_in, monkeypatch, tmp_path):
    plug_in().serials = []
    monkeypatch.setattr(doctor, "UDEV_FOLDERS", (tmp_path,))
    monkeypatch.setattr(sys, "platform", "linux")
    lines = examine()
    assert {one.verdict for one in lines} == {"ok", "note"}
    assert "USB 3 port" in line(lines, "USB").remedy
    assert UDEV in line(lines, "udev rules").remedy
    assert any("simulated camera stands in, which is fine" in one.says for one in lines)
    assert line(lines, "Camera").says.startswith("Simulated D435")
    (tmp_path / "99-realsense-libusb.rules").touch()
    assert doctor._udev().verdict == "ok"


def test_the_variable_is_named(quick, monkeypatch):
    monkeypatch.setenv("COURSEKIT_CAMERA", "simulated")
    assert "COURSEKIT_CAMERA names 'simulated'" in examine()[0].says


def test_no_driver_is_a_note_unless_a_camera_is_asked_for(quick, no_library):
    lines = examine()
    expect(line(lines, "Driver"), "note", "pip install -r requirements-camera.txt")
    assert line(lines, "Camera").says.startswith("Simulated D435")
    for which in ("film.db3", SERIAL):
        assert [one.verdict for one in examine(which)] == ["problem"]


def test_a_driver_that_does_not_load_is_a_problem(quick, broken_library):
    found = line(examine(), "Driver")
    expect(found, "problem", "libusb-1.0.so.0")
    expect(found, "problem", "--force-reinstall -r requirements-camera.txt")


def test_no_permission(quick, plug_in, tmp_path):
    rs = plug_in()
    rs.query_error = "failed to open usb interface: 0, error: RS2_USB_STATUS_ACCESS"
    expect(line(examine(), "USB"), "problem", UDEV)
    rs.query_error, rs.serials = None, []
    (tmp_path / "1-2").mkdir()
    (tmp_path / "1-2" / "product").write_text("Intel(R) RealSense(TM) 435\n", encoding="utf-8")
    expect(line(examine(), "USB"), "problem", UDEV)


@pytest.mark.parametrize(("behaviour", "which", "says"), EXPECTED["does_not_open"])
def test_a_camera_that_does_not_open(quick, plug_in, behaviour, which, says):
    plug_in(**behaviour)
    expect(line(examine(which), "Camera"), "problem", says)


# --- a camera ---


def test_a_camera_in_order(quick, plug_in, monkeypatch):
    monkeypatch.setattr(doctor, "TEST_FRAMES", 30)
    rs = plug_in()
    rs.noise = 0.6
    lines = examine()
    assert [one.check for one in lines] == EXPECTED["lines_of_a_camera"]
    assert {one.verdict for one in lines} == {"ok"}, [str(one) for one in lines]
    assert line(lines, "USB").says == f"Intel RealSense D435, serial {SERIAL}"
    assert line(lines, "Depth unit").says == "1 mm a count (usual: 1 mm)"
    assert line(lines, "Baseline").says == "50.17 mm (usual: 50 mm to 2 %)"
    assert line(lines, "K of depth").says.startswith("fx 426.00, fy 426.25, cx 425.50, cy 237.50 ")
    assert line(lines, "K of colour").says.startswith("fx 613.00, fy 613.25, cx 321.50, cy 237.50")
    assert line(lines, "Frames").says.startswith("30 in 0.97 s, 0 lost")  # on its own clock
    assert "100%" in line(lines, "Filled").says
    assert "for a pixel at 0.70 m, 0.02" in line(lines, "Noise").says
    assert rs.stops == 1  # and it is let go


@pytest.mark.parametrize(("told", "check", "verdict", "remedy"), EXPECTED["link_and_firmware"])
def test_link_and_firmware(quick, plug_in, told, check, verdict, remedy):
    plug_in().told.update(told)
    expect(line(examine(), check), verdict, remedy=remedy)


def test_a_library_that_reports_no_firmware(quick, plug_in):
    rs = plug_in()
    for name in ("firmware_version", "recommended_firmware_version", "usb_type_descriptor"):
        del rs.told[name]
    assert {"Firmware", "USB link"}.isdisjoint(one.check for one in examine())


def test_unusual_figures(quick, plug_in):
    rs = plug_in()
    rs.depth_sensor.options.update(depth_units=1e-4, stereo_baseline=46.0)
    lines = examine()
    assert line(lines, "Depth unit").remedy == "if nobody meant it: camera.set(depth_scale_m=0.001)"
    expect(line(lines, "Baseline"), "note", remedy="factory calibration")
    del rs.depth_sensor.options["stereo_baseline"]
    expect(line(examine(), "Baseline"), "note", "none: no stereo camera")


@pytest.mark.parametrize(("fy", "cx"), [(640.0, 319.5), (613.0, 380.0)])
def test_an_unusual_matrix(fy, cx):
    expect(doctor._matrix(Intrinsics(640, 480, 613.0, fy, cx, 239.5)), "note", remedy="restore it")


@pytest.mark.parametrize(("first_end_step", "seconds", "verdict"), EXPECTED["late_or_lost"])
def test_frames_late_or_lost(first_end_step, seconds, verdict):
    numbers = range(*first_end_step)
    times_s = np.linspace(5.0, 5.0 + seconds, len(numbers))
    frames = [SimpleNamespace(number=n, time_s=t) for n, t in zip(numbers, times_s, strict=True)]
    remedy = "plug the camera in directly" if verdict == "note" else ""
    expect(doctor._arrival(frames), verdict, remedy=remedy)


def test_a_slow_camera_is_given_three_seconds_of_its_own_clock(quick, plug_in, monkeypatch):
    """Not of the computer's, which may be busy."""
    monkeypatch.setattr(doctor, "TEST_FRAMES", 30)
    rs = plug_in()
    rs.frames_per_s = 2
    expect(line(examine(), "Frames"), "note", "8 in 3.50 ")


@pytest.mark.parametrize("given", [0, 1, 7])
def test_a_camera_that_falls_silent(quick, plug_in, given):
    plug_in(frames=30 + given)
    expect(line(examine(), "Frames"), "problem", "is it still plugged in")


@pytest.mark.parametrize(("filled", "verdict"), [(0.3, "note"), (0.01, "problem")])
def test_little_depth(quick, plug_in, filled, verdict):
    rs = plug_in()
    rs.filled, rs.noise = filled, 0.6
    lines = examine()
    expect(line(lines, "Filled"), verdict, remedy="clean the front glass")
    assert line(lines, "Noise").says.startswith("no depth in the middle of the image")


def test_noisy_depth(quick, plug_in, monkeypatch):
    plug_in().noise = 12.0
    expect(line(examine(), "Noise"), "note", remedy="hold everything still")


# --- a recording ---


def test_a_recording(quick, tabletop, monkeypatch):
    lines = examine(str(tabletop))
    assert {one.verdict for one in lines} == {"ok"}, [str(one) for one in lines]
    assert "recording tabletop.db3" in line(lines, "Camera").says
    assert line(lines, "Frames").says.startswith("8 read in ")
    monkeypatch.setattr(doctor, "TEST_FRAMES", 2)
    assert line(examine(str(tabletop)), "Noise").verdict == "note"


def test_a_damaged_recording(quick, plug_in, tmp_path):
    plug_in()
    (tmp_path / "a.db3").write_text("hello", encoding="utf-8")
    expect(examine(str(tmp_path / "a.db3"))[-1], "problem", "is not a .db3 recording")
