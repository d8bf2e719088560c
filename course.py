"""Sets up the course once, then runs it.

python3 course.py lab     open your copies of the notebooks, in notebooks/my, in JupyterLab
                          (more options: those of jupyter lab)
python3 course.py test    check everything (more options: those of pytest)
python3 course.py run     execute every notebook into build/, without a browser
python3 course.py bench   time the parts that must be fast
python3 course.py site    make web pages of the notebooks, to read without running: build/site/

The first of these makes the folder .venv and installs everything into it, once.
To take it all away again, delete the project folder.
"""

# Down to "if sys.version_info" this must run on Python 3.6; below it, parse there: no match, no :=.
import contextlib
import errno
import functools
import hashlib
import importlib.util
import io
import json
import os
import re
import secrets
import shutil
import signal
import subprocess
import sys
import sysconfig
import tempfile
import threading
import time
import urllib.error
import urllib.request
import webbrowser
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import IO, Any, NamedTuple

MINIMUM, BELOW = (3, 11), (3, 15)
RECOMMENDED = "3.12"


def works(command: list) -> bool:
    """Whether a command runs and succeeds: a pyenv shim, say, can be on PATH and not work."""
    if shutil.which(command[0]) is None:
        return False
    nothing = subprocess.DEVNULL
    return subprocess.call(command, stdin=nothing, stdout=nothing, stderr=nothing) == 0


def unfit(version: tuple, arguments: list) -> str:
    """What to tell somebody whose Python is too old or too new, and what to type instead."""
    check = ["-c", f"import sys; sys.exit(not {MINIMUM} <= sys.version_info < {BELOW})"]
    names = [
        name.format(minor) for name in ("python3.{}", "py -3.{}") for minor in (12, 13, 11, 14)
    ]
    newer = [name for name in [*names, "python3", "python"] if works(name.split() + check)]
    if works(["uv", "--version"]):
        newer.append(f"uv run --no-project --python {RECOMMENDED}")
    advice = f"Install Python {RECOMMENDED} (python.org has it), or uv, and run this again."
    if newer:
        advice = f"Type this instead:\n\n    {newer[0]} {' '.join(arguments)}\n"
    found = ".".join(map(str, version[:2]))
    return f"This is Python {found}, and the course needs 3.11, 3.12, 3.13 or 3.14. {advice}"


if not MINIMUM <= sys.version_info < BELOW:
    sys.exit(unfit(sys.version_info, sys.argv))

if sys.platform == "win32":
    import msvcrt
else:
    import fcntl

ROOT = Path(__file__).resolve().parent
VENV = ROOT / ".venv"
SCHEME = {"base": str(VENV), "platbase": str(VENV)}
SCRIPTS = Path(sysconfig.get_path("scripts", "venv", SCHEME))
PYTHON = SCRIPTS / ("python.exe" if os.name == "nt" else "python")
BASE_PYTHON = getattr(sys, "_base_executable", sys.executable)  # also when started inside .venv
MARKER = VENV / "made-by-course"  # written first: this .venv may be deleted
STATE = VENV / "course-state.json"  # written last: this .venv is complete
LOG = ROOT / "build" / "setup.log"
LOCK = ROOT / "build" / "setup.lock"
ENDING = threading.Event()  # what is still set up beside JupyterLab ends with it
COMPILING = ROOT / "build" / "compiling"  # there while the fast parts are compiled
CONFIGURATION = ROOT / "tools" / "jupyter_server_config.py"
BEGUN = "begun"  # in place of the fingerprint of a step that has not ended
SPACE_BYTES = 1_500_000_000
HASHED = ("--require-hashes", "--only-binary", ":all:", "-r")
EDITABLE = ("--no-deps", "--no-build-isolation", "-e", ".")

OVERRIDES = "share/jupyter/lab/settings/overrides.json"
NO_NEWS = {"fetchNews": "false", "checkForUpdates": False}  # else a question pops up at first

CERTIFICATE = "CERTIFICATE_VERIFY_FAILED|invalid peer certificate"
NETWORK = "the network did not answer. Connect to it (or check the proxy) and run this again"
CAUSES = {  # what pip, uv or the system says: what it means. A retry that went well leaves a
    # network warning behind, so the network comes after what never gets better by itself.
    r"DO NOT MATCH THE HASHES|Hash mismatch": "a package that arrived is not the one the course "
    "was tested with. Run this again on another network; if it stays so, tell your instructor",
    r"No space left|not enough space on the disk|os error (28|112)\b|quota exceeded": "the disk is "
    "full. Free about 1.5 GB and run this again",
    r"Read-only file system|Permission denied|os error (13|30)\b"
    r"|Access is denied|(os error|WinError) 5\b": "a file cannot be written, or is in use. End "
    "JupyterLab if it is running; if the folder is read-only, copy it into your home folder and "
    "run this there",
    CERTIFICATE: "the network's certificate is not "
    "trusted. Try another network, or ask whoever runs this one how to set up pip for it",
    r"Failed to establish a new connection|NewConnectionError|ProxyError|Max retries exceeded"
    r"|timed out|Connection (broken|reset|aborted)|error sending request"
    r"|dns error|connect error|network was disabled|IncompleteRead": NETWORK,
    r"No matching distribution|No solution found": "a package does not exist for this computer or "
    f"this Python. Try Python {RECOMMENDED}",
}


class Step(NamedTuple):
    name: str  # in the state file
    says: str
    inputs: tuple[str, ...] = ()  # files; when one of them changes, the step is repeated
    pip: tuple[str, ...] = ()  # what pip or uv installs ...
    python: tuple[str, ...] = ()  # ... or what Python runs
    without: str = ""  # what follows when the step fails; empty: nothing works without it


COURSE, TEST = "requirements.txt", "requirements-test.txt"
CAMERA = "requirements-camera.txt"
NO_CAMERA = "The simulated camera works all the same; for a real one, the next start tries again."
NO_PIP = "Only `!pip` in a notebook needs it."
NO_KERNELS = "The notebooks compile them when they need them, and the next start tries again."
KERNELS = ("kernels", "simulation/raycast", "simulation/rig", "simulation/board_images")
COMPILED = (COURSE, *(f"coursekit/{name}.py" for name in KERNELS))
COMPILE = ("tools/warm_up.py",)
# A module's tests, and the cells of a notebook, stay together in one of the two processes.
TWO_PROCESSES = ("-n", "2", "--dist", "loadscope", "--no-loadscope-reorder")
PIP = ("-m", "ensurepip", "--default-pip")
PIP_INSTALL = ("-m", "pip", "install", "--no-compile")  # as uv does: Python compiles what it uses
STEPS = (
    Step("pip", "pip", python=PIP, without=NO_PIP),
    Step("course", "Packages", (COURSE,), (*HASHED, COURSE)),
    Step("test", "Test tools", (TEST,), (*HASHED, TEST)),
    Step("camera", "RealSense driver", (CAMERA,), (*HASHED, CAMERA), without=NO_CAMERA),
    Step("project", "Course package", ("pyproject.toml",), EDITABLE),
    Step("kernels", "Fast parts", COMPILED, python=COMPILE, without=NO_KERNELS),
)


def environment() -> dict[str, str]:
    """The user's environment with its proxies and indexes, less what leads out of .venv."""
    away = {"PYTHONHOME", "PYTHONPATH", "__PYVENV_LAUNCHER__", "CONDA_PREFIX", "CONDA_DEFAULT_ENV"}
    away |= {"PIP_TARGET", "PIP_PREFIX", "PIP_ROOT", "PIP_CONSTRAINT", "PIP_REQUIRE_HASHES"}
    away |= {"UV_PYTHON", "UV_SYSTEM_PYTHON", "UV_TARGET", "UV_PREFIX", "UV_CONSTRAINT"}
    kept = {name: value for name, value in os.environ.items() if name not in away}
    kept["PATH"] = os.pathsep.join([str(SCRIPTS), kept.get("PATH", os.defpath)])
    return {
        **kept,
        "VIRTUAL_ENV": str(VENV),
        "PYTHONUTF8": "1",
        "UV_SYSTEM_CERTS": kept.get("UV_SYSTEM_CERTS", "1"),  # a campus may have its own
        "PIP_USER": "0",  # wins over a "user = true" in pip's configuration
        "PIP_NO_INPUT": "1",
        "PIP_PROGRESS_BAR": "off",
        "PIP_DISABLE_PIP_VERSION_CHECK": "1",
        "JUPYTER_PREFER_ENV_PATH": "1",  # our kernel, not another "python3" of this user's
    }


# ---- what is installed, and whether that still holds --------------------------------------------


def place() -> list[str]:
    """What an environment is bound to: its folder, its Python, the kind of computer."""
    version = ".".join(map(str, sys.version_info[:2]))
    return [str(VENV), version, sysconfig.get_platform(), os.path.realpath(PYTHON)]


def read_state() -> dict[str, str] | None:
    """The finished steps and their fingerprints, or None when .venv is not sound."""
    try:
        state = json.loads(STATE.read_text(encoding="utf-8"))
        sound = state["place"] == place() and PYTHON.exists() and Path(state["base"]).exists()
        return dict(state["steps"]) if sound else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def write_state(done: dict[str, str]) -> None:
    temporary = STATE.with_suffix(".new")
    state = {"place": place(), "base": BASE_PYTHON, "steps": done}
    temporary.write_text(json.dumps(state, indent=1), encoding="utf-8")
    os.replace(temporary, STATE)


def fingerprint(step: Step) -> str:
    content = [(ROOT / name).read_bytes() for name in step.inputs]
    return hashlib.sha256(b"\0".join(content)).hexdigest()


def pending(done: dict[str, str], but: Collection[str]) -> list[Step]:
    return [s for s in STEPS if s.name not in but and done.get(s.name) != fingerprint(s)]


# ---- setting up ---------------------------------------------------------------------------------


@functools.cache
def has_uv() -> bool:
    return works(["uv", "--version"])


def explain(output: str) -> str:
    """The cause of a failure, from what pip, uv or the operating system said."""
    for pattern, cause in CAUSES.items():
        if re.search(pattern, output, re.IGNORECASE):
            return cause
    last = output.strip().splitlines()[-1:] or ["(nothing)"]
    return f"it failed, saying last: {last[0].strip()}"


def show(text: str, end: str = "") -> None:
    """Write over the terminal's current line."""
    width = shutil.get_terminal_size().columns - 1
    print("\r" + text[:width].ljust(width), end=end, flush=True)


def run_logged(says: str, command: list[str], live: bool | None = None) -> tuple[int, str]:
    """Run one step with a live line on a terminal; what it says goes to the log, too."""
    live = sys.stdout.isatty() if live is None else live
    if not live:
        print(f"{says} ...")
    started = time.monotonic()
    child = subprocess.Popen(
        command,
        cwd=ROOT,
        env={**environment(), "PYTHONSAFEPATH": "1", "PYTHONUNBUFFERED": "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        encoding="utf-8",
        errors="replace",
        close_fds=False,  # the child holds the lock, too, in case this process is killed
    )
    lines = [f"$ {' '.join(command)}\n"]

    def read() -> None:
        for line in child.stdout or ():
            lines.append(line)

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        while reader.is_alive():
            reader.join(0.2)
            if ENDING.is_set():
                child.terminate()
                stop(child)
                sys.exit()  # of a thread: it says nothing
            if live:
                show(f"{says}: {time.monotonic() - started:.0f} s  {lines[-1].strip()}")
    except KeyboardInterrupt:
        stop(child)
        raise
    result = "failed" if child.wait() else "done"
    (show if live else print)(f"{says}: {result} in {time.monotonic() - started:.0f} s", end="\n")
    with contextlib.suppress(OSError), LOG.open("a", encoding="utf-8") as log:  # disk full
        log.writelines(lines)
    return child.returncode, "".join(lines[1:])


def must(says: str, command: list[str]) -> None:
    code, output = run_logged(says, command)
    if code:
        sys.exit(f"{says}: {explain(output)}.\nThe full output is in {LOG}")


def perform(step: Step, done: dict[str, str], live: bool | None = None) -> None:
    """Run a step; if it is interrupted, what was finished before stays, and it begins again."""
    interrupted = done.pop(step.name, "") == BEGUN
    if step.pip and "course" not in done:
        STATE.unlink(missing_ok=True)  # nothing can stay: .venv is made anew
    elif step.pip:
        write_state({**done, step.name: BEGUN})
    command = [*command_of(step)]
    if interrupted:
        command.append("--force-reinstall")  # a package may be there by half
    code, output = run_logged(step.says, command, live)
    if code and step.pip and has_uv() and re.search(CERTIFICATE, output):
        print("uv does not trust this network; pip may have been told of it: once more with pip.")
        run_logged("pip", [str(PYTHON), *PIP])
        code, output = run_logged(step.says, [str(PYTHON), *PIP_INSTALL, *step.pip])
    cause = explain(output)
    if code == 0:
        done[step.name] = fingerprint(step)
    if code == 0 or step.without or cause == NETWORK:  # both download first, then install
        write_state(done)
    if code and not step.without:
        sys.exit(f"{step.says}: {cause}.\nThe full output is in {LOG}")
    if code:
        print(f"{step.says}: {cause}.\n{step.without}\nThe full output is in {LOG}")


def command_of(step: Step) -> Iterator[str]:
    if not step.pip:
        yield from (str(PYTHON), *step.python)
    elif has_uv():
        yield from ("uv", "pip", "install", "--python", str(PYTHON), *step.pip)
    else:
        yield from (str(PYTHON), *PIP_INSTALL, *step.pip)


def require_ensurepip() -> None:
    if not all(map(importlib.util.find_spec, ("venv", "ensurepip"))):
        version = ".".join(map(str, sys.version_info[:2]))
        sys.exit(
            "This Python cannot make virtual environments: its module ensurepip is missing.\n"
            f"On Debian or Ubuntu: sudo apt install python{version}-venv\n"
            "Or install uv (docs.astral.sh/uv), which does not need it. Then run this again."
        )


def clear() -> None:
    """Empty .venv if it is ours; the marker stays, so that half a removal can be resumed."""
    foreign = VENV.is_symlink() or (VENV.exists() and not VENV.is_dir())
    if foreign or (VENV.exists() and any(VENV.iterdir()) and not MARKER.exists()):
        sys.exit(
            f"{VENV} was not made by course.py, so it stays as it is.\n"
            "Rename it or take it away, and run this again."
        )
    VENV.mkdir(exist_ok=True)
    MARKER.write_text("course.py made this folder and may delete it.\n", encoding="utf-8")
    for child in VENV.iterdir():
        if child.is_dir() and not child.is_symlink():
            shutil.rmtree(child)
        elif child != MARKER:
            child.unlink()


def create() -> None:
    """Make .venv afresh, with nothing in it but JupyterLab's settings."""
    if MARKER.exists():
        print("Replacing .venv: it is incomplete, or made in another folder or by another Python.")
    clear()
    free = shutil.disk_usage(ROOT).free
    if free < SPACE_BYTES:
        sys.exit(
            f"The disk has {free / 1e9:.1f} GB free, and the course needs about "
            f"{SPACE_BYTES / 1e9:.1f} GB. Free some and run this again."
        )
    print("Setting up the course in .venv, once: one to three minutes; with uv half a minute.")
    with_uv = ["uv", "venv", "--no-project", "--allow-existing", "--python", BASE_PYTHON, str(VENV)]
    with_venv = [BASE_PYTHON, "-m", "venv", "--without-pip", str(VENV)]
    must("Environment", with_uv if has_uv() else with_venv)
    overrides = VENV / OVERRIDES
    overrides.parent.mkdir(parents=True)
    news = {"@jupyterlab/apputils-extension:notification": NO_NEWS}
    overrides.write_text(json.dumps(news), encoding="utf-8")


def set_up(but: Collection[str] = ("test",)) -> None:
    """Bring .venv up to date, but for some steps; if it is, that takes milliseconds, no network."""
    state = read_state()
    if state is not None and not pending(state, but):
        return
    with locked():
        state = read_state()  # whoever held the lock may have done the work
        LOG.write_bytes(b"")
        if not has_uv():
            require_ensurepip()
        if state is None:
            create()
        done = state or {}
        for step in pending(done, but):
            perform(step, done)


def finish_set_up() -> None:
    """What JupyterLab can start without, while it runs; a notebook that needs it waits."""
    state = read_state() or {}
    COMPILING.touch()
    try:
        with locked():
            for step in reversed(pending(state, ("test",))):  # what is slow and wanted soon, first
                perform(step, state, live=False)
    finally:
        COMPILING.unlink(missing_ok=True)


@contextlib.contextmanager
def locked() -> Iterator[None]:
    """Let one course.py at a time change .venv; the system frees the lock when its holder ends."""
    LOCK.parent.mkdir(exist_ok=True)
    with LOCK.open("ab") as file:
        os.set_inheritable(file.fileno(), True)
        if not try_lock(file):
            print("Another set-up of this folder is under way: waiting for it to end.")
            while not try_lock(file):
                if ENDING.wait(0.3):
                    sys.exit()
        yield


def try_lock(file: IO[bytes]) -> bool:
    try:
        if sys.platform == "win32":
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:  # a network drive may know no locks: then go on without one
        return error.errno not in (errno.EACCES, errno.EAGAIN, errno.EDEADLK)
    return True


# ---- running ------------------------------------------------------------------------------------


def stop(child: subprocess.Popen) -> None:
    """End a child; Ctrl-C in a terminal has reached it already, so it gets time to end itself."""
    for seconds, end in ((5, child.terminate), (10, child.kill)):
        try:
            child.wait(seconds)
        except subprocess.TimeoutExpired:
            end()
    child.wait()


def finish(child: subprocess.Popen) -> int:
    try:
        while child.poll() is None:
            time.sleep(0.1)
    except KeyboardInterrupt:
        stop(child)
        raise
    return child.returncode


def run_python(*arguments: str) -> int:
    return finish(subprocess.Popen([str(PYTHON), *arguments], cwd=ROOT, env=environment()))


def ask(server: dict[str, Any], path: str, data: bytes | None = None) -> None:
    """Send a request to JupyterLab; no proxy is between."""
    headers = {"Authorization": f"token {server['token']}"}
    request = urllib.request.Request(f"{server['url']}api/{path}", data, headers)
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    opener.open(request, timeout=5).close()


def server_when_ready(child: subprocess.Popen, runtime: Path) -> dict[str, Any]:
    """Wait until JupyterLab answers; empty when it ends before that."""
    while child.poll() is None:
        time.sleep(0.1)
        for file in runtime.glob("jpserver-*.json"):
            try:
                server = json.loads(file.read_text(encoding="utf-8"))
                if not server["secure"]:  # a certificate of one's own would not be trusted here
                    ask(server, "")
            except (OSError, ValueError):
                continue  # half-written, or not answering yet
            return dict(server)
    return {}


def start_kernel(server: dict[str, Any], notebook: str) -> None:
    """Ask for what the page will ask for: it starts while the page is loaded."""
    wanted = {"path": notebook, "type": "notebook", "name": "", "kernel": {"name": "python3"}}
    with contextlib.suppress(OSError):  # then the page does
        ask(server, "sessions", json.dumps(wanted).encode())


def jupyter_command(page: str, arguments: list[str]) -> list[str]:
    options = ["--no-browser", "--log-level=ERROR", "--LabApp.log_level=ERROR"]
    options += [f"--config={CONFIGURATION}"]
    options += [f"--ServerApp.root_dir={ROOT}", f"--LabApp.default_url=/{page}"]
    options += ["--KernelManager.transport_encryption=auto"]  # "disabled" warns on the terminal
    options += ["--ServerApp.answer_yes=True"]  # to "Shut down this server?" after Ctrl-C
    if hasattr(os, "geteuid") and os.geteuid() == 0:
        options.append("--allow-root")
    return [str(PYTHON), "-m", "tools.lab", *options, *arguments]


def open_browser(address: str) -> None:
    """Not left to Jupyter: it opens a file, which a browser installed as a snap may not read."""
    threading.Thread(target=webbrowser.open, args=(address,), daemon=True).start()


def lab(arguments: list[str]) -> int:
    if {"-h", "--help", "--help-all", "--version"} & set(arguments):
        print(__doc__)
        return 0
    COMPILING.unlink(missing_ok=True)  # of a start that was killed
    later = ("pip", "kernels") if "pip" in (read_state() or {}) or has_uv() else ("kernels",)
    set_up(("test", *later))
    from tools import copies

    print(copies.older_ones(copies.make()), end="")
    notebook = f"notebooks/my/{copies.unfinished()}"
    page = f"lab/tree/{notebook}"
    print("Starting JupyterLab ...")
    screen = sys.platform != "linux" or {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ)
    with tempfile.TemporaryDirectory(prefix="coursekit-", ignore_cleanup_errors=True) as runtime:
        own = {"JUPYTER_TOKEN": secrets.token_hex(24), "JUPYTER_RUNTIME_DIR": runtime}
        own["COURSEKIT_COMPILING"] = str(COMPILING)
        command = jupyter_command(page, arguments)
        child = subprocess.Popen(command, cwd=ROOT, env={**environment(), **own})
        try:
            if pending(read_state() or {}, ("test",)):
                threading.Thread(target=finish_set_up).start()
            server = server_when_ready(child, Path(runtime))
            if server:
                address = f"{server['url']}{page}?token={server['token']}"
                print(f"\nThe course is at\n\n    {address}\n\nCtrl-C here ends it.")
                if screen and "CI" not in os.environ and "--no-browser" not in arguments:
                    open_browser(address)
                start_kernel(server, notebook)
            return finish(child)
        except KeyboardInterrupt:
            stop(child)
            print("\nJupyterLab has ended.")
            return 0
        finally:
            ENDING.set()


def test(arguments: list[str]) -> int:
    set_up(())
    checks = (
        ("ruff check", ("-m", "ruff", "check")),
        ("ruff format", ("-m", "ruff", "format", "--check")),
        ("mypy", ("-m", "mypy")),
        ("stored outputs of the notebooks", ("tools/build_notebooks.py", "--check")),
        ("pytest", ("-m", "pytest", *TWO_PROCESSES, *arguments)),
    )
    failed = []
    for name, command in checks:
        print(f"-- {name}")
        if run_python(*command):
            failed.append(name)
    if failed:
        print(f"Failed: {', '.join(failed)}")
    return 1 if failed else 0


def run(arguments: list[str]) -> int:
    set_up()
    return run_python("tools/build_notebooks.py", "--into", "build", *arguments)


def bench(arguments: list[str]) -> int:
    set_up()
    return run_python("tools/bench.py", *arguments)


def site(arguments: list[str]) -> int:
    set_up()
    return run_python("-m", "tools.build_site", *arguments)


def interrupt(*_: object) -> None:
    raise KeyboardInterrupt


def main(arguments: list[str]) -> int:
    commands = {"lab": lab, "test": test, "run": run, "bench": bench, "site": site}
    command = arguments[0] if arguments else ""
    if command not in commands:
        print(__doc__)
        return 0 if command in ("-h", "--help", "help") else 2
    signal.signal(signal.SIGTERM, interrupt)
    if isinstance(sys.stdout, io.TextIOWrapper):  # in step with what the children print
        sys.stdout.reconfigure(line_buffering=True, errors="replace")
    try:
        return commands[command](arguments[1:])
    except KeyboardInterrupt:
        print("\nInterrupted. The same command starts again.", file=sys.stderr)
        return 130
    except OSError as error:
        print(f"{error}: {explain(str(error))}.", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
