"""course.py without a network: its decisions, and what it says when something is in the way."""

import ast
import importlib.util
import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from pathlib import Path
from types import ModuleType

import pytest
from common import EXPECTED

ROOT = Path(__file__).resolve().parents[1]
REQUIREMENTS = ("requirements.txt", "requirements-test.txt", "requirements-camera.txt")
posix = pytest.mark.skipif(os.name == "nt", reason="the stand-ins are shell scripts and links")

# Stands in for pip inside the environment: writes down each call, and fails or waits on demand.
PIP = """
import os, pathlib, sys, time
with open("calls.txt", "a") as calls:
    print(" ".join(sys.argv[1:]), file=calls)
if os.environ.get("FAIL", "-") in sys.argv:
    print(os.environ["SAY"])
    sys.exit(1)
if os.environ.get("WAIT", "-") in sys.argv:
    pathlib.Path("pid").write_text(f"{os.getpid()}.")
    time.sleep(3600)  # until it is killed
"""


@pytest.fixture
def project(tmp_path: Path, course: ModuleType) -> Path:
    """A project folder with the true course.py and small stand-ins for all it installs and runs."""
    root = tmp_path / "my project"
    for folder in ("coursekit/simulation", "tools"):
        (root / folder).mkdir(parents=True)
    (root / "course.py").write_bytes((ROOT / "course.py").read_bytes())
    for name in {name for step in course.STEPS for name in step.inputs}:
        (root / name).write_text(f"# {name}\n", encoding="utf-8")
    (root / "tools/warm_up.py").touch()
    (root / "tools/bench.py").write_text("print('bench ran')\n", encoding="utf-8")
    (root / "stand-ins/ensurepip").mkdir(parents=True)
    (root / "stand-ins/ensurepip/__init__.py").touch()
    (root / "stand-ins/ensurepip/__main__.py").write_text(
        "import pathlib, sysconfig\n"
        "folder = pathlib.Path(sysconfig.get_path('purelib'))\n"
        "(folder / 'pip').mkdir(parents=True)\n"
        f"(folder / 'pip/__main__.py').write_text({PIP!r})\n",
        encoding="utf-8",
    )
    return root


def start(root: Path, *arguments: str, **environment: str) -> subprocess.Popen:
    """Run the project's course.py with the stand-ins and little of this computer's environment."""
    program = (
        "import sys, runpy; sys.argv = sys.argv[1:]\n"
        "module = runpy.run_path(sys.argv[0], run_name='course')\n"
        "names = module['set_up'].__globals__\n"
        "true = names['environment']\n"
        "names['environment'] = lambda: {**true(), 'PYTHONPATH': 'stand-ins'}\n"
        "sys.exit(module['main'](sys.argv[1:]))"
    )
    command = [sys.executable, "-c", program, "course.py", *(arguments or ("bench",))]
    environment |= {"PATH": str(root), "HOME": str(root), "SYSTEMROOT": "C:\\Windows"}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    return subprocess.Popen(command, cwd=root, env=environment, **streams)


def run(root: Path, *arguments: str, **environment: str) -> tuple[int, str]:
    child = start(root, *arguments, **environment)
    output, _ = child.communicate()
    assert "Traceback" not in output
    return child.returncode, output


def calls(root: Path) -> list[str]:
    """What pip was asked to install since the last look."""
    file = root / "calls.txt"
    lines = file.read_text(encoding="utf-8").splitlines() if file.exists() else []
    file.unlink(missing_ok=True)
    return [line.split()[-1] for line in lines]


def pip_waiting(root: Path, child: subprocess.Popen) -> int:
    """The process number of the stand-in for pip, once it waits."""
    written = root / "pid"
    while not (written.exists() and written.read_text(encoding="utf-8").endswith(".")):
        assert child.poll() is None, "it ended without the stand-in for pip"
        time.sleep(0.02)
    return int(written.read_text(encoding="utf-8")[:-1])


@pytest.fixture
def course() -> ModuleType:
    return importlib.import_module("course")


# ---- the state of the environment ---------------------------------------------------------------

ALL = ["requirements.txt", "requirements-camera.txt", "."]


def test_first_run_installs_and_second_run_does_nothing(project: Path) -> None:
    code, output = run(project)
    assert (code, calls(project)) == (0, ALL), output
    assert "Setting up the course" in output
    log = (project / "build/setup.log").read_text(encoding="utf-8")
    assert log.count("--require-hashes --only-binary :all: -r requirements") == 2
    overrides = project / ".venv/share/jupyter/lab/settings/overrides.json"
    settings = json.loads(overrides.read_text(encoding="utf-8"))
    quiet = {"fetchNews": "false", "checkForUpdates": False}
    assert settings["@jupyterlab/apputils-extension:notification"] == quiet

    before = (project / "build/setup.log").stat().st_mtime_ns
    assert run(project) == (0, "bench ran\n")
    assert calls(project) == []
    assert (project / "build/setup.log").stat().st_mtime_ns == before


def test_only_what_changed_is_installed_again_in_place(project: Path) -> None:
    run(project)
    calls(project)
    (project / ".venv/kept").touch()
    for changed, wanted in EXPECTED["installed_again"]:
        (project / changed).write_text("# changed\n", encoding="utf-8")
        code, output = run(project)
        assert (code, calls(project)) == (0, wanted), output
    assert (project / ".venv/kept").exists()
    (project / "coursekit/kernels.py").write_text("# changed\n", encoding="utf-8")
    code, output = run(project)
    assert (code, calls(project), "Fast parts: done" in output) == (0, [], True)


def test_what_is_compiled_ahead_is_every_module_with_numba(course: ModuleType) -> None:
    package = ROOT / "coursekit"
    compiled = {
        path.relative_to(package).with_suffix("").as_posix()
        for path in package.rglob("*.py")
        if "from numba import" in path.read_text(encoding="utf-8")
    }
    assert compiled == set(course.KERNELS)


def test_test_adds_its_tools_runs_every_check_and_names_those_that_failed(project: Path) -> None:
    checks = project / "tools/build_notebooks.py"
    checks.write_text("print('checked the notebooks')\n", encoding="utf-8")
    for name, status in (("ruff", 0), ("mypy", 3), ("pytest", 0)):
        lines = f"import sys; print('{name}', *sys.argv[1:]); sys.exit({status})"
        (project / f"{name}.py").write_text(lines, encoding="utf-8")
    code, output = run(project, "test", "-k", "some")
    assert "requirements-test.txt" in calls(project)
    assert code == 1
    said = output[output.index("--") :].splitlines()
    assert said == EXPECTED["said_by_course_test"].splitlines()
    (project / "mypy.py").write_text("", encoding="utf-8")
    code, output = run(project, "test")
    said = "pytest -n 2 --dist loadscope --no-loadscope-reorder"
    assert (code, output.splitlines()[-1]) == (0, said)


@posix
@pytest.mark.parametrize("end", [getattr(signal, "SIGKILL", signal.SIGTERM), signal.SIGTERM])
def test_interrupted_set_up_is_made_anew(project: Path, end: signal.Signals) -> None:
    child = start(project, WAIT="requirements.txt")
    pip = pip_waiting(project, child)
    (project / ".venv/half-done").touch()
    os.kill(child.pid, end)
    os.kill(pip, end)
    output, _ = child.communicate()
    assert "Traceback" not in output
    assert child.returncode != 0
    assert calls(project) == ["requirements.txt"]

    code, output = run(project)
    assert (code, calls(project)) == (0, ALL), output
    assert "Replacing .venv" in output
    assert not (project / ".venv/half-done").exists()


@posix
def test_an_interrupted_step_throws_no_finished_one_away(project: Path, ctrl_c_is_heard) -> None:
    child = start(project, WAIT="requirements-camera.txt")
    os.kill(pip_waiting(project, child), signal.SIGINT)  # a terminal's Ctrl-C reaches both
    os.kill(child.pid, signal.SIGINT)
    assert "Interrupted" in child.communicate()[0]
    assert calls(project) == ["requirements.txt", "requirements-camera.txt"]

    code, output = run(project)
    assert (code, calls(project)) == (0, ["--force-reinstall", "."]), output
    assert "Replacing .venv" not in output


COPIES = """
def make():
    return []

def older_ones(copies):
    return ""

def unfinished():
    return "01_pinhole.ipynb"
"""
LAB = """
import os, pathlib, time
server = pathlib.Path(os.environ["JUPYTER_RUNTIME_DIR"], "jpserver-1.json")
server.write_text('{"secure": true, "url": "https://here/", "token": "1"}')
while not pathlib.Path("end").exists():
    time.sleep(0.02)
"""
WARM_UP = """
import os, pathlib, time
pathlib.Path("pid").write_text(f"{os.getpid()}.")
time.sleep(3600)
"""


@posix
def test_what_is_set_up_beside_jupyterlab_ends_with_it(project: Path) -> None:
    for name, program in (("copies", COPIES), ("lab", LAB), ("warm_up", WARM_UP)):
        (project / f"tools/{name}.py").write_text(program, encoding="utf-8")
    child = start(project, "lab", CI="true")
    compiling = pip_waiting(project, child)
    child.terminate()
    (project / "end").touch()
    output, _ = child.communicate()
    assert (child.returncode, "Traceback" in output) == (0, False), output
    assert not (project / "build/compiling").exists()
    with pytest.raises(ProcessLookupError):
        os.kill(compiling, 0)


@posix
def test_second_set_up_waits_even_for_the_orphan_of_a_killed_one(project: Path) -> None:
    first = start(project, WAIT="requirements.txt")
    pip = pip_waiting(project, first)
    first.kill()
    second = start(project)
    assert second.stdout is not None
    waits = "Another set-up of this folder is under way: waiting for it to end.\n"
    assert second.stdout.readline() == waits
    assert calls(project) == ["requirements.txt"]
    os.kill(pip, signal.SIGKILL)
    second.communicate()
    assert (second.returncode, calls(project)) == (0, ALL)
    first.communicate()


@posix
def test_moved_folder_and_vanished_python_are_repaired(project: Path) -> None:
    run(project)
    calls(project)
    moved = project.with_name("moved")
    project.rename(moved)
    code, output = run(moved)
    assert (code, calls(moved)) == (0, ALL), output
    python = moved / ".venv/bin/python"
    python.unlink()
    python.symlink_to(moved / "no-longer-there")
    code, output = run(moved)
    assert (code, calls(moved)) == (0, ALL), output


@pytest.mark.parametrize("linked", [False, pytest.param(True, marks=posix)])
def test_environment_of_somebody_else_is_left_alone(project, tmp_path, linked: bool) -> None:
    theirs = project / ".venv/pyvenv.cfg"
    (tmp_path / "precious").mkdir()
    if linked:
        theirs.parent.symlink_to(tmp_path / "precious")
    else:
        theirs.parent.mkdir()
    theirs.write_text("home = elsewhere", encoding="utf-8")
    code, output = run(project)
    assert code == 1
    assert "was not made by course.py, so it stays as it is" in output
    assert "Rename it" in output
    assert list(theirs.parent.iterdir()) == [theirs]
    assert theirs.read_text(encoding="utf-8") == "home = elsewhere"


# ---- what is said when something is in the way --------------------------------------------------


def test_camera_failure_is_no_obstacle_and_is_retried(project: Path) -> None:
    code, output = run(project, FAIL="requirements-camera.txt", SAY="os error 28")
    assert (code, calls(project)) == (0, ALL)
    assert "the disk is full" in output
    assert "The simulated camera works all the same" in output
    assert output.endswith("bench ran\n")
    run(project)
    assert calls(project) == ["requirements-camera.txt"]
    run(project)
    assert calls(project) == []


def test_failed_set_up_says_why_and_names_the_log(project: Path) -> None:
    failure = "client error: dns error, no such host"
    code, output = run(project, FAIL="requirements.txt", SAY=failure)
    assert (code, calls(project)) == (1, ["requirements.txt"])
    assert "the network did not answer" in output
    assert "bench ran" not in output
    log = Path(output.splitlines()[-1].removeprefix("The full output is in "))
    assert failure in log.read_text(encoding="utf-8")
    code, output = run(project)
    assert (code, calls(project), "Replacing" in output) == (0, ALL, False)


SAID = tomllib.loads((ROOT / "tests/failed_set_ups.toml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("name", SAID)
def test_cause_is_recognised(course: ModuleType, name: str) -> None:
    assert SAID[name]["wanted"] in course.explain(SAID[name]["said"])


def stand_in(folder: Path, name: str, status: int) -> None:
    file = folder / name
    file.write_text(f"#!/bin/sh\nexit {status}\n", encoding="utf-8")
    file.chmod(0o755)


@posix
def test_old_python_is_told_a_command_that_works(course, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    typed = ["course.py", "lab", "--port=9000"]
    alone = course.unfit((3, 9, 18), typed)
    assert alone.startswith("This is Python 3.9, and the course needs 3.11, 3.12, 3.13 or 3.14. In")
    stand_in(tmp_path, "uv", 0)
    with_uv = course.unfit((3, 9, 18), typed)
    assert "\n    uv run --no-project --python 3.12 course.py lab --port=9000\n" in with_uv
    stand_in(tmp_path, "python3.12", 127)  # like a shim of pyenv with nothing behind it
    stand_in(tmp_path, "python3.13", 0)
    newer = course.unfit((3, 15, 1), typed)
    assert newer.startswith("This is Python 3.15,")
    assert "\n    python3.13 course.py lab --port=9000\n" in newer


def test_old_python_gets_that_far_and_no_further() -> None:
    source = (ROOT / "course.py").read_text(encoding="utf-8")
    ast.parse(source, feature_version=(3, 6))
    program = "import sys; sys.version_info = (3, 9, 18); exec(sys.stdin.read())"
    old = subprocess.run(
        [sys.executable, "-c", program], input=source, capture_output=True, text=True, check=False
    )
    assert old.returncode == 1
    assert old.stderr.startswith("This is Python 3.9, and the course needs 3.11,")


def test_missing_ensurepip_names_the_package(course, monkeypatch) -> None:
    course.require_ensurepip()
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name != "ensurepip" or None)
    with pytest.raises(SystemExit, match=r"sudo apt install python3\.\d+-venv") as stopped:
        course.require_ensurepip()
    assert "install uv" in str(stopped.value)


def test_too_little_space_is_said_before_anything_is_installed(
    course, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(course, "VENV", tmp_path / ".venv")
    monkeypatch.setattr(course, "MARKER", tmp_path / ".venv/marker")
    monkeypatch.setattr(course, "SPACE_BYTES", 10**18)
    monkeypatch.setattr(course, "must", lambda *_: pytest.fail("installed something"))
    with pytest.raises(SystemExit, match=r"has \d+\.\d GB free, and the course needs about"):
        course.create()


def test_system_errors_are_sentences(course, monkeypatch, capsys) -> None:
    def fail(error: BaseException) -> None:
        raise error

    denied = PermissionError(13, "Permission denied", "build")
    monkeypatch.setattr(signal, "signal", lambda *_: None)
    monkeypatch.setattr(course, "bench", lambda _: fail(denied))
    assert course.main(["bench"]) == 1
    assert "Permission denied: 'build': a file cannot be written" in capsys.readouterr().err
    monkeypatch.setattr(course, "bench", lambda _: fail(KeyboardInterrupt()))
    assert course.main(["bench"]) == 130
    assert "Interrupted" in capsys.readouterr().err


@pytest.mark.parametrize(("arguments", "status"), [([], 2), (["--help"], 0), (["labb"], 2)])
def test_usage(course, arguments: list[str], status: int, capsys) -> None:
    assert course.main(arguments) == status
    assert "python3 course.py lab" in capsys.readouterr().out


def test_environment_leads_nowhere_else(course, monkeypatch) -> None:
    for name in ("PYTHONPATH", "PYTHONHOME", "CONDA_PREFIX", "PIP_TARGET", "VIRTUAL_ENV"):
        monkeypatch.setenv(name, "elsewhere")
    monkeypatch.setenv("PIP_USER", "1")
    monkeypatch.setenv("HTTPS_PROXY", "proxy:3128")
    monkeypatch.setenv("PIP_INDEX_URL", "mirror")
    environment = course.environment()
    assert "elsewhere" not in environment.values()
    assert environment["VIRTUAL_ENV"] == str(ROOT / ".venv")
    assert environment["PATH"].split(os.pathsep)[0] == str(course.SCRIPTS)
    kept = [environment[name] for name in ("PIP_USER", "HTTPS_PROXY", "PIP_INDEX_URL")]
    assert kept == ["0", "proxy:3128", "mirror"]


# ---- the files beside it ------------------------------------------------------------------------


def test_conda_installs_the_same(course) -> None:
    text = (ROOT / "environment.yml").read_text(encoding="utf-8")
    installed = re.findall(r"^ +- -r (\S+)$", text, re.MULTILINE)
    assert installed == ["requirements.txt", "requirements-camera.txt"]
    (python,) = re.findall(r"- python=3\.(\d+)$", text, re.MULTILINE)
    assert course.MINIMUM[1] <= int(python) <= 13


@pytest.mark.parametrize("name", REQUIREMENTS)
def test_requirements_are_pinned_hashed_and_without_addresses(name: str) -> None:
    text = (ROOT / name).read_text(encoding="utf-8")
    assert not re.search(r"://|^\s*-(i|f)\b|index|find-links|trusted-host", text, re.MULTILINE)
    entries = re.split(r"\n(?=\S)", text.strip())
    pinned = re.compile(r"[\w.-]+==\S+( ; [^\\]+)? \\\n +--hash=sha256:[0-9a-f]{64}")
    assert [entry for entry in entries if not pinned.match(entry)] == []
    assert len(entries) >= 3
