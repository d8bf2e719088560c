"""The course on Linux, Windows and macOS, as far as one machine can tell: by reading the code.

Also what a hub needs (`.binder`), because nothing here can build its image.
"""

import ast
import json
import os
import re
import stat
import subprocess
import sys
import tomllib
from collections import Counter
from collections.abc import Callable
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import pytest
from common import EXPECTED

from coursekit.doctor import NEWEST, OLDEST, pins

ROOT = Path(__file__).resolve().parents[1]
BINDER = ROOT / ".binder"
SHIPPED = ("coursekit", "tools")
ALL = (*SHIPPED, "tests")
ONE_SYSTEM_ONLY = re.compile(
    "curses|fcntl|grp|msvcrt|nt|posix|pty|pwd|readline|resource|syslog|termios|tty|_?winapi|winreg"
)
NOT_ON_WINDOWS = re.compile(
    r"os\.(chown|fork|forkpty|get(e?[ug]id|pgid|sid)|killpg|mkfifo|nice|sched_getaffinity|setsid|"
    r"statvfs|sysconf|uname)|signal\.(pthread_sigmask|alarm|SIG(ALRM|HUP|KILL|USR1))"
)
MODE = re.compile(r"[rwaxbt+]+")


def sources(*folders: str) -> list[Path]:
    """The Python files of these folders, and those of the project's own folder."""
    inside = [path for folder in folders for path in sorted((ROOT / folder).rglob("*.py"))]
    return [*inside, *sorted(ROOT.glob("*.py"))]


LOOKED_AT = (ast.Attribute, ast.Call, ast.Constant, ast.Import, ast.ImportFrom)


@cache
def nodes(path: Path) -> list[ast.AST]:
    """The parts of a file's syntax that a rule looks at."""
    module = ast.parse(path.read_text(encoding="utf-8"))
    return [node for node in ast.walk(module) if isinstance(node, LOOKED_AT)]


def found(is_fault: Callable[[Any], bool], *folders: str) -> list[str]:
    """Where the code of these folders has a node that is a fault: file, line, what it says."""
    return [
        f"{path.relative_to(ROOT).as_posix()}:{node.lineno}: {ast.unparse(node)[:80]}"
        for path in sources(*folders)
        for node in nodes(path)
        if is_fault(node)
    ]


def dotted(node: ast.AST) -> str:
    """A name such as os.path.join as text, empty for anything else."""
    if isinstance(node, ast.Attribute):
        owner = dotted(node.value)
        return owner and f"{owner}.{node.attr}"
    return node.id if isinstance(node, ast.Name) else ""


def name_of(call: ast.Call) -> str:
    """The last part of the name of the function that is called."""
    func = call.func
    return func.attr if isinstance(func, ast.Attribute) else getattr(func, "id", "")


def keywords(call: ast.Call) -> dict[str | None, ast.expr]:
    return {keyword.arg: keyword.value for keyword in call.keywords}


# --- encodings ---


def without_encoding(call: ast.AST) -> bool:
    """Whether a call reads or writes text in whatever encoding the system prefers."""
    if not isinstance(call, ast.Call) or {"encoding", None} & set(keywords(call)):
        return False
    name = name_of(call)
    if name == "read_text":
        return not call.args
    if name == "write_text":
        return len(call.args) < 2
    if name not in ("open", "fdopen", "TemporaryFile", "NamedTemporaryFile"):
        return False
    given = [*call.args, *call.keywords]
    values = [getattr(one, "value", None) for one in given]
    values = [getattr(value, "value", value) for value in values]
    modes = [value for value in values if isinstance(value, str) and MODE.fullmatch(value)]
    if any("b" in mode for mode in modes):
        return False
    method = isinstance(call.func, ast.Attribute)  # Path.open(); not sensor.open(profiles)
    return bool(modes) or (name == "open" and not (method and given))


# --- no path of one system (ruff looks for shells, and for paths put together as text) ---


def of_one_system(node: ast.AST) -> bool:
    """Whether it is an absolute path, of Linux or of Windows."""
    folders = "etc|home|proc|sys|tmp|usr|var|opt|dev|lib"
    return isinstance(node, ast.Constant) and bool(
        re.fullmatch(rf"/({folders})(/\S*)?|[A-Z]:\\\S*", str(node.value))
    )


def test_a_path_of_one_system_is_an_extra() -> None:
    """What is there on Linux only serves what the course can do without."""
    allowed = re.compile(
        r"coursekit/(doctor\.py:\d+: '.*/udev/rules\.d'|cameras/librealsense\.py:\d+: "
        r"'/sys/bus/usb/devices'|submission/\w+\.py:\d+: '/proc/self/statm')"
    )
    assert [one for one in found(of_one_system, *SHIPPED) if not allowed.match(one)] == []


# --- processes and modules of one system ---


def starts_a_process_its_own_way(node: ast.AST) -> bool:
    """Not by "spawn"; where a system has it "forkserver" will do, which copies no memory either."""
    if not isinstance(node, ast.Call):
        return False
    if name_of(node) in ("get_context", "set_start_method"):
        how = [getattr(argument, "value", None) for argument in node.args]
        return how not in (["spawn"], ["forkserver"])
    if name_of(node) in ("ProcessPoolExecutor", "ProcessPool"):
        return not {"mp_context", "context"} & set(keywords(node))
    text = dotted(node.func)
    return bool(re.fullmatch(r"(multiprocessing|mp)\.(Pool|Process|Queue|Manager)", text))


RULES = {
    "text is read and written as UTF-8": without_encoding,
    "processes are started as every system can": starts_a_process_its_own_way,
}


@pytest.mark.parametrize("is_fault", RULES.values(), ids=RULES.keys())
def test_the_code_keeps_the_rule(is_fault: Callable[[Any], bool]) -> None:
    assert found(is_fault, *ALL) == []


@pytest.mark.parametrize("rule", RULES)
def test_the_search_for_a_fault_finds_what_it_should(rule: str) -> None:
    is_fault = RULES[rule]
    for codes, fault in zip(EXPECTED["faults"][rule], (True, False), strict=True):
        for code in codes:
            assert is_fault(ast.parse(code, mode="eval").body) is fault, code


def names_of_one_system(path: Path) -> set[str]:
    """The modules and functions in a file that not every system has."""
    names = set()
    for node in nodes(path):
        if isinstance(node, ast.Import):
            names |= {one.name for one in node.names if ONE_SYSTEM_ONLY.fullmatch(one.name)}
        elif isinstance(node, ast.ImportFrom) and ONE_SYSTEM_ONLY.fullmatch(node.module or ""):
            names.add(node.module)
        elif isinstance(node, ast.Attribute) and NOT_ON_WINDOWS.fullmatch(dotted(node)):
            names.add(dotted(node))
    return names


def test_what_one_system_has_is_used_where_somebody_saw_to_the_others() -> None:
    """In these places a question about the system is asked before; a new one wants one, too."""
    used = {path.relative_to(ROOT).as_posix(): names_of_one_system(path) for path in sources(*ALL)}
    assert {name: sorted(names) for name, names in used.items() if names} == EXPECTED["guarded"]


# --- the files of the repository ---


def git(*arguments: str, given: str | None = None) -> str:
    """What git says; the test is skipped where there is no git, or no repository."""
    try:
        command = ["git", "-C", str(ROOT), *arguments]
        streams: dict[str, Any] = {"input": given, "capture_output": True, "encoding": "utf-8"}
        result = subprocess.run(command, check=True, **streams)
    except (OSError, subprocess.CalledProcessError) as error:
        pytest.skip(f"no git here: {error}")
    return result.stdout


def committed() -> list[str]:
    """The names of all files that are in the repository, or would be with the next commit."""
    said = git("ls-files", "--cached", "--others", "--exclude-standard", "-z")
    return sorted(name for name in set(said.split("\0")) if name and (ROOT / name).exists())


def faults_of(name: str) -> str:
    """Why a file cannot have this name on Windows, or in a zip for it; empty if it can."""
    device = re.compile(r"(con|prn|aux|nul|com[0-9]|lpt[0-9])(\..*)?", re.IGNORECASE)
    for part in PurePosixPath(name).parts:
        if device.fullmatch(part):
            return "a device"
        if re.search(r'[<>:"\\|?*\x00-\x1f]', part):
            return "a character"
        if part.endswith((".", " ")) or part.startswith(" "):
            return "a dot or space at the end"
        if not part.isascii():
            return "a letter that systems store in different ways"
    return "its length" if len(name) > 120 else ""  # of 259, the rest is the user's folder


@pytest.mark.parametrize(("name", "fault"), EXPECTED["names_of_files"])
def test_names_that_windows_cannot_have(name: str, fault: str) -> None:
    assert faults_of(name) == fault


def test_every_file_can_be_checked_out_anywhere() -> None:
    names = committed()
    assert {name: faults_of(name) for name in names if faults_of(name)} == {}
    folders = {str(p) for name in names for p in PurePosixPath(name).parents}
    alike = Counter(name.casefold() for name in [*names, *folders])
    assert [name for name, count in alike.items() if count > 1] == []


def test_there_are_no_links() -> None:
    assert [row for row in git("ls-files", "--stage").splitlines() if row.startswith("120")] == []
    assert [name for name in committed() if (ROOT / name).is_symlink()] == []


def test_every_checkout_has_the_same_bytes() -> None:
    """Text has one line feed a line on every system, and nothing else is touched."""
    names = committed()
    said = git("check-attr", "-z", "--stdin", "text", "eol", given="\0".join(names))
    fields = said.split("\0")
    rules: dict[str, dict[str, str]] = {}
    for name, attribute, value in zip(fields[::3], fields[1::3], fields[2::3], strict=False):
        rules.setdefault(name, {})[attribute] = value
    for name in names:
        text = (ROOT / name).read_bytes().decode(errors="replace")
        if rules[name]["text"] == "unset":
            continue  # of a binary kind: git leaves it as it is
        assert not set("\0\ufffd") & set(text), f".gitattributes: {name} is binary, name its kind"
        assert rules[name] == {"text": "auto", "eol": "lf"}, name
        assert "\r" not in text, f"{name} has carriage returns"


# --- the same pins for every Python and system ---


REQUIREMENTS = ("requirements.txt", "requirements-camera.txt", "requirements-test.txt")
PYTHONS = [f"3.{minor}" for minor in range(OLDEST[1], NEWEST[1] + 1)]


def chosen(file: str, python: str, system: str, machine: str) -> dict[str, list[str]]:
    """The versions that a requirements file gives each package there."""
    about = {
        **EXPECTED["systems"][system],
        "python_version": python,
        "python_full_version": f"{python}.4",
        "platform_machine": machine,
        "platform_python_implementation": "CPython",
        "implementation_name": "cpython",
    }
    versions: dict[str, list[str]] = {}
    for pin in pins(ROOT / file):
        if not pin.marker or pin.marker.evaluate(about):
            versions.setdefault(pin.name, []).append(str(pin.specifier))
    return versions


PLACES = (("linux", "x86_64"), ("linux", "aarch64"), ("win32", "AMD64"), ("darwin", "arm64"))


@pytest.mark.parametrize("python", PYTHONS)
@pytest.mark.parametrize("file", REQUIREMENTS)
def test_one_version_of_each_package_for_every_system(file: str, python: str) -> None:
    everywhere: dict[str, str] = {}
    for place in PLACES:
        for name, versions in chosen(file, python, *place).items():
            assert len(versions) == 1, (name, place)
            assert everywhere.setdefault(name, versions[0]) == versions[0], (name, place)


@pytest.mark.parametrize("python", PYTHONS)
def test_what_the_course_asks_for_is_pinned_for_every_system(python: str) -> None:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    dependencies = tomllib.loads(text)["project"]["dependencies"]
    wanted = {re.split(r"[<>=~! ]", one)[0].replace("_", "-").lower() for one in dependencies}
    for place in PLACES:
        names = {name.replace("_", "-").lower() for name in chosen(REQUIREMENTS[0], python, *place)}
        assert wanted <= names, place
    drivers = ["pyrealsense2" in chosen(REQUIREMENTS[1], python, *place) for place in PLACES]
    assert drivers == [True, False, True, False]


def test_the_oldest_python_is_the_same_everywhere() -> None:
    import course

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    oldest, too_new = (".".join(map(str, one)) for one in (course.MINIMUM, course.BELOW))
    assert project["requires-python"] == f">={oldest},<{too_new}"
    assert course.MINIMUM == OLDEST
    assert course.RECOMMENDED in PYTHONS


# --- the hub ---


def test_the_hub_installs_the_courses_pins() -> None:
    rows = (BINDER / "requirements.txt").read_text(encoding="utf-8").splitlines()
    rows = [row for row in rows if row and not row.startswith("#")]
    assert rows[:3] == ["--require-hashes", "--only-binary :all:", "-r ../requirements.txt"]
    for row in rows[2:]:
        option, name = row.split()
        assert (option, (BINDER / name).is_file()) == ("-r", True)
    python = (BINDER / "runtime.txt").read_text(encoding="utf-8").strip()
    assert python.removeprefix("python-") in PYTHONS
    allowed = {"README.md", "overrides.json", "postBuild", "requirements.txt", "runtime.txt"}
    assert {path.name for path in BINDER.iterdir()} == allowed | {"start"}


def test_what_the_hub_runs_exists() -> None:
    """Scripts with line feeds and a first line, and every file and module that they name."""
    for name in ("postBuild", "start"):
        content = (BINDER / name).read_bytes()
        assert content.startswith(b"#!/bin/bash\n")
        assert b"\r" not in content
        if os.name != "nt":
            assert (BINDER / name).stat().st_mode & stat.S_IXUSR
    build = (BINDER / "postBuild").read_text(encoding="utf-8")
    modules = re.findall(r"python -m (\S+)", build)
    assert modules == ["pip"]
    for name in re.findall(r"(?:\.binder|tools)/\S+", build):
        assert (ROOT / name).is_file()
    import course

    for word in course.EDITABLE:
        assert f" {word}" in build
    assert course.OVERRIDES.startswith("share/jupyter/lab/settings")
    assert "share/jupyter/lab/settings" in build
    settings = json.loads((BINDER / "overrides.json").read_text(encoding="utf-8"))
    assert list(settings.values()) == [course.NO_NEWS]


@pytest.mark.skipif(sys.platform != "linux", reason="a hub's images are Linux")
class TestStart:
    """The script that starts a student's server."""

    @staticmethod
    def start(home: Path, *command: str, **environment: str) -> str:
        command, told = [BINDER / "start", *command], {"capture_output": True, "encoding": "utf-8"}
        env = {"HOME": str(home), "PATH": os.environ["PATH"], **environment}
        result = subprocess.run(["bash", *command], check=True, env=env, **told)
        assert result.stderr == ""
        return result.stdout

    def variables(self, home: Path, **environment: str) -> dict[str, str]:
        rows = self.start(home, "env", **environment).splitlines()
        return dict(row.split("=", 1) for row in rows if "=" in row)

    def test_the_simulated_camera_and_results_at_home(self, tmp_path: Path) -> None:
        said = self.variables(tmp_path)
        assert said["COURSEKIT_CAMERA"] == "simulated"
        assert said["COURSEKIT_RESULTS"] == str(tmp_path / "results")
        said = self.variables(tmp_path, COURSEKIT_CAMERA="auto", COURSEKIT_RESULTS="elsewhere")
        assert (said["COURSEKIT_CAMERA"], said["COURSEKIT_RESULTS"]) == ("auto", "elsewhere")

    @pytest.mark.parametrize(("limit", "threads"), EXPECTED["threads_of_a_hub"])
    def test_threads(self, tmp_path: Path, limit: str, threads: str) -> None:
        said = self.variables(tmp_path, CPU_LIMIT=limit)
        assert {said[f"{name}_NUM_THREADS"] for name in ("NUMBA", "OMP", "OPENBLAS")} == {threads}

    def test_copies_come_home_once(self, tmp_path: Path) -> None:
        self.start(tmp_path, "true")
        there = tmp_path / "notebooks" / "my"
        names = sorted(path.name for path in (ROOT / "notebooks").glob("[0-9]*.ipynb"))
        assert sorted(path.name for path in there.iterdir()) == names
        (there / names[0]).write_text("my answers", encoding="utf-8")
        assert f"{names[0]}. They stay as they are" in self.start(tmp_path, "true")
        assert (there / names[0]).read_text(encoding="utf-8") == "my answers"
