"""`coursekit doctor`: what works on this computer, and what to do about the rest.

Nothing but the standard library is imported before a check needs it, rooms of the course included,
so that a broken installation gets its line too: where `coursekit` itself does not start,
`python -m coursekit.doctor` does.

A check is a function that yields what it found: a verdict, a sentence, and a remedy. The tables
COMPUTER and FIGURES, at the end of their sections, give each its name and its turn; the sentences
stand in doctor.toml.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
import time
import tomllib
import webbrowser
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Literal

Condition = Literal["ok", "note", "problem"]

OLDEST, NEWEST = (3, 11), (3, 14)
PINS = Path(__file__).resolve().parents[1] / "requirements.txt"
LOADED = ("numpy", "scipy", "cv2", "numba", "matplotlib", "ipywidgets")
UDEV_FOLDERS = tuple(map(Path, ("/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")))
LEAST_FREE_BYTES = 100_000_000  # results, recordings, bundles
LINE_WIDTH = 100

TEST_FRAMES, USUAL_FRAMES_PER_S = 30, 30
LONGEST_TEST_S = 3.0  # on the camera's clock
WINDOW_PX = 40  # the side of the window in the middle
LEAST_FRAMES_FOR_NOISE = 5
USUAL_VALID, HARDLY_VALID = 0.60, 0.05
USUAL_NOISE_PX = (0.03, 0.20)  # one pixel's disparity over time: data/published_depth_noise.json

DOCTOR_TEXTS = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
MOST_PACKAGES = 5  # that a line lists


@dataclass(frozen=True)
class CheckUp:
    """What one check found: a note is worth knowing, a problem is in the way.

    check: the name of the check, which `checks` fills in; as text it is what is printed.
    """

    verdict: Condition
    says: str
    remedy: str = ""
    check: str = ""

    def __str__(self) -> str:
        head = f"{self.verdict:8} {self.check:12} "
        blank = " " * len(head)
        parts = ((self.says, head, blank), (self.remedy, f"{blank}-> ", f"{blank}   "))
        return "\n".join(
            textwrap.fill(text, LINE_WIDTH, initial_indent=first, subsequent_indent=later)
            for text, first, later in parts
            if text
        )


Check = Callable[..., CheckUp | Iterable[CheckUp] | None]


def found(what: str, good: bool = False, check: str = "", **facts: Any) -> CheckUp:
    """What doctor.toml has under this name: verdict, sentence and remedy, with the facts in them.

    good: whether all is well, so that the sentence alone is said. check: see `CheckUp`.
    """
    verdict, *texts = DOCTOR_TEXTS["findings"][what]
    says, remedy = (text.format(**DOCTOR_TEXTS["shared"], **facts) for text in [*texts, ""][:2])
    return CheckUp("ok", says, "", check) if good else CheckUp(verdict, says, remedy, check)


def run(camera: str = "auto", as_json: bool = False) -> int:
    """Print a line for each check as it is made; 0 when nothing is a problem, 1 otherwise.

    camera: what `open_camera` takes: "auto", "simulated", a serial number or a recording. as_json:
    one object for programs instead, when all are made.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # a pipe on Windows cannot show every letter
        sys.stdout.reconfigure(errors="replace")
    lines = []
    for line in checks(camera):
        lines.append(line)
        if not as_json:
            print(line, flush=True)
    problems = sum(line.verdict == "problem" for line in lines)
    if as_json:
        print(json.dumps({"coursekit": edition(), "checks": list(map(asdict, lines))}, indent=1))
    elif problems:
        print(f"\n{problems} problem{'s' * (problems > 1)}: do what stands there, and ask again.")
    else:
        print("\nNothing is in the way. `python3 course.py lab` opens the notebooks.")
    return int(problems > 0)


def checks(camera: str = "auto") -> Iterator[CheckUp]:
    """The lines one by one; a check that fails gives a line, never an exception."""
    for name, check in COMPUTER:
        yield from _named(name, check)
    yield from _named("Camera", _cameras, camera)


def _named(name: str, check: Check, *about: Any) -> Iterator[CheckUp]:
    """What a check finds, under its name, and one more line when it fails on the way."""
    try:
        lines = check(*about)
        for line in [lines] if isinstance(lines, CheckUp) else lines or ():
            yield replace(line, check=line.check or name)
    except Exception as error:  # whatever a broken environment makes it raise
        yield found("not_checked", check=name, error=f"{type(error).__name__}: {error}")


# ---- the computer -------------------------------------------------------------------------------


def _python() -> CheckUp:
    computer, running = f"{sys.platform} {platform.machine()}", sys.version_info
    lacks, runs = DOCTOR_TEXTS["without_packages"].get(computer, ("", ""))
    faults = {
        "python_old": running < OLDEST,
        "python_32": sys.maxsize < 2**32,
        "python_new": running[:2] > NEWEST,
        "python_lacks": lacks,
    }
    what = next((fault for fault, there in faults.items() if there), "python")
    oldest, newest, version = (".".join(map(str, v)) for v in (OLDEST, NEWEST, running[:3]))
    python = f"{version} on {platform.system()} {platform.machine()}, in {sys.prefix}"
    another = f"install Python {newest} for 64 bits and begin again"
    return found(what, python=python, oldest=oldest, another=another, lacks=lacks, runs=runs)


def edition() -> str:
    """The course's version, and in a clone the commit."""
    commit = ""
    if (PINS.parent / ".git").exists() and shutil.which("git"):
        git = ["git", "-C", str(PINS.parent), "rev-parse", "--short", "HEAD"]
        commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    return f"{_version('coursekit') or 'not installed'}{commit and ', commit '}{commit}"


def pins(path: Path) -> list[Any]:
    """The packages that a requirements file pins, each a `Requirement`, in its order."""
    from packaging.requirements import Requirement

    lines = path.read_text(encoding="utf-8").splitlines()
    return [Requirement(line.rstrip("\\ ")) for line in lines if re.match(r"[\w.-]+==", line)]


def _packages() -> Iterator[CheckUp]:
    if not PINS.exists():
        yield found("no_pins", file=PINS.name)
        return
    here = (pin for pin in pins(PINS) if pin.marker is None or pin.marker.evaluate())
    tested = {pin.name: str(pin.specifier).removeprefix("==") for pin in here}
    there = {name: _version(name) for name in tested}
    others = [
        f"{name} {version} (tested with {tested[name]})"
        for name, version in there.items()
        if version not in (tested[name], "")
    ]
    missing = [name for name, version in there.items() if not version]
    faults = {"missing": missing, "unsuited": _out_of_range(), "others": others}
    for what, names in faults.items():
        if names:
            more = f" and {len(names) - MOST_PACKAGES} more" if len(names) > MOST_PACKAGES else ""
            yield found(what, names=", ".join(names[:MOST_PACKAGES]) + more)
    if not any(faults.values()):
        yield found("pinned", count=len(tested), file=PINS.name)


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _out_of_range() -> list[str]:
    """The packages whose version the course cannot use at all, with what it wants."""
    from packaging.requirements import Requirement

    try:
        wants = map(Requirement, metadata.requires("coursekit") or ())
    except metadata.PackageNotFoundError:
        return ["coursekit itself is not installed"]
    return [
        f"{want.name} {version} (want {want.specifier})"
        for want in wants
        if (version := _version(want.name)) and not want.specifier.contains(version, True)
    ]


def _loading() -> CheckUp:
    """Whether the packages with compiled parts load: a wheel can be damaged or lack a library."""
    failed = []
    for name in LOADED:
        try:
            importlib.import_module(name)
        except Exception as error:
            why = str(error).splitlines()[0] if str(error) else type(error).__name__
            failed.append(f"{name} does not load ({why})")
    return found("loading", not failed, says="; ".join(failed) or f"{', '.join(LOADED)} load")


def _opencv() -> CheckUp:
    """Whether one package brings cv2, and it is what was loaded: of two the last one wins."""
    import cv2

    packages = sorted(set(metadata.packages_distributions().get("cv2", ())))
    good = len(packages) == 1 and _version(packages[0]).startswith(cv2.__version__)
    good &= hasattr(cv2, "calibrateHandEye")
    names = {"brings": " and ".join(packages) or "no package", "packages": " ".join(packages)}
    return found("opencv", good, version=cv2.__version__, **names)


def _kernel() -> CheckUp:
    """Whether the notebooks' kernel is this environment's; it is not started."""
    from jupyter_client.kernelspec import KernelSpecManager, NoSuchKernel

    try:
        spec = KernelSpecManager().get_kernel_spec("python3")
    except NoSuchKernel:
        return found("no_kernel")
    command = Path(spec.argv[0])
    if command.name == spec.argv[0] and command.stem.startswith("python"):
        return found("kernel_of_lab")
    with contextlib.suppress(OSError):  # in one folder: a resolved link would lead out of a .venv
        if command.parent.samefile(Path(sys.executable).parent):
            return found("kernel")
    return found("other_kernel", folder=spec.resource_dir, command=command)


def _browser() -> CheckUp:
    if "JUPYTERHUB_SERVICE_PREFIX" in os.environ:
        return found("hub")
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        return found("no_browser", why="this computer has no screen to show one on")
    try:
        return found("browser", name=getattr(webbrowser.get(), "name", "") or "the system's own")
    except webbrowser.Error:
        return found("no_browser", why="none was found")


def _results() -> CheckUp:
    """Whether results can be saved; nothing is left behind."""
    from coursekit import results

    folder = results.folder()
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            free = shutil.disk_usage(there).free
    except OSError as error:
        return found("not_writable", folder=folder, why=error.strerror or error)
    what = "disk_full" if free < LEAST_FREE_BYTES else "results"
    return found(what, folder=folder, free_mb=free / 1e6, free_gb=free / 1e9)


COMPUTER: tuple[tuple[str, Check], ...] = (
    ("Course", lambda: CheckUp("ok", edition())),
    ("Python", _python),
    ("Packages", _packages),
    ("Loading", _loading),
    ("OpenCV", _opencv),
    ("Kernel", _kernel),
    ("Browser", _browser),
    ("results/", _results),
)


# ---- the camera ---------------------------------------------------------------------------------


def _cameras(which: str) -> Iterator[CheckUp]:
    from coursekit.cameras import VARIABLE
    from coursekit.cameras.librealsense import LibraryMissing, load_librealsense

    named = os.environ.get(VARIABLE, "auto") if which == "auto" else which
    if named != which:
        yield found("variable", variable=VARIABLE, named=named)
    if not (named == "auto" or named.isdecimal()):  # the simulated one or a recording
        yield from _tested(named)
        return
    try:
        rs = load_librealsense()
    except LibraryMissing as missing:
        broken = missing.__cause__ is not None  # installed, and does not load
        verdict: Condition = "problem" if broken or named != "auto" else "note"
        yield CheckUp(verdict, str(missing), check="Driver")
        if named == "auto":
            yield from _stand_in()
        return
    yield found("driver", check="Driver", version=getattr(rs, "__version__", ""))
    yield from _live(rs, named)


def _live(rs: Any, named: str) -> Iterator[CheckUp]:
    """The cameras on USB, and a test of the first or the named one; without any, the stand-in."""
    from coursekit.cameras import CameraError
    from coursekit.cameras.librealsense import connected_realsenses

    try:
        serials = connected_realsenses()
    except CameraError as error:
        yield CheckUp("problem", str(error), check="USB")
        return
    if named not in ("auto", *serials):
        yield from _tested(named)  # says which there are
    elif serials:
        for device in rs.context().query_devices():
            yield from _named("USB", _device, rs, device)
        yield from _tested(min(serials) if named == "auto" else named)
    else:
        yield found("not_plugged_in", check="USB")
        if sys.platform == "linux":
            yield from _named("udev rules", _udev)
        yield from _stand_in()


def _stand_in() -> Iterator[CheckUp]:
    yield found("stand_in")
    yield from _tested("simulated")


def _udev() -> CheckUp:
    """Whether Linux would let this user open a camera once it is plugged in."""
    from coursekit.cameras.librealsense import UDEV_ADVICE

    for folder in UDEV_FOLDERS:
        for rules in folder.glob("*realsense*.rules"):
            return CheckUp("ok", f"{rules}")
    return found("no_rules", advice=UDEV_ADVICE)


def _device(rs: Any, device: Any) -> Iterator[CheckUp]:
    """What a plugged-in camera says of itself before it is started."""
    from coursekit.cameras.librealsense import device_info

    def told(name: str) -> str:
        return device_info(rs, device, name)

    yield CheckUp("ok", f"{told('name') or 'RealSense'}, serial {told('serial_number')}")
    if usb := told("usb_type_descriptor"):
        yield found("link" if usb.startswith("3") else "slow_link", check="USB link", usb=usb)
    own, recommended = told("firmware_version"), told("recommended_firmware_version")
    if own and recommended:
        numbers, wanted = (tuple(map(int, re.findall(r"\d+", v))) for v in (own, recommended))
        what = "old_firmware" if numbers < wanted else "firmware"
        yield found(what, check="Firmware", own=own, recommended=recommended)


# ---- what a camera reports ----------------------------------------------------------------------


def _tested(which: str) -> Iterator[CheckUp]:
    """A camera or recording, opened: its figures beside what is usual, and its depth."""
    from coursekit.cameras import CameraError, open_camera

    try:
        camera = open_camera(which)
    except (CameraError, ValueError) as error:
        yield CheckUp("problem", str(error))
        return
    with camera:
        yield CheckUp("ok", repr(camera).splitlines()[0])
        for name, check in FIGURES:
            yield from _named(name, check, camera)
        yield from _named("Depth test", _depth_test, camera)


def _length(camera: Any, what: str, tolerance: float) -> CheckUp:
    """A length that the camera reports, beside that of its data sheet where the course has one."""
    from coursekit.cameras.realsense import specified

    length_m, device = getattr(camera, f"{what}_m"), specified(camera.name)
    if length_m is None:
        return found(f"no_{what}")
    if device is None:
        return found(f"unknown_{what}", mm=1e3 * length_m)
    usual = getattr(device.nominal, f"{what}_m")
    good = abs(length_m / usual - 1) < tolerance
    return found(what, good, mm=1e3 * length_m, usual_mm=1e3 * usual, usual=usual)


def _matrix(k: Any) -> CheckUp:
    """The factory's K, of an `Intrinsics`, beside what is usual: square pixels, a centred axis."""
    if k is None:
        return found("no_colour")
    off = max(abs(k.cx - (k.width - 1) / 2), abs(k.cy - (k.height - 1) / 2))
    return found("matrix", abs(k.fx / k.fy - 1) < 0.01 and off < 0.05 * k.width, k=k)


FIGURES: tuple[tuple[str, Check], ...] = (
    ("Depth unit", lambda camera: _length(camera, "depth_scale", 1e-3)),
    ("Baseline", lambda camera: _length(camera, "baseline", 0.02)),
    ("K of depth", lambda camera: _matrix(camera.depth)),
    ("K of colour", lambda camera: _matrix(camera.color)),
)


# ---- what a camera measures ---------------------------------------------------------------------


def _depth_test(camera: Any) -> Iterator[CheckUp]:
    """A second of depth: how many frames come, how much of them is depth, how noisy it is."""
    from coursekit.cameras import CameraError, Frames

    taken: list[Any] = []
    try:
        with contextlib.closing(camera.stream()) as stream:
            for frame in itertools.islice(stream, TEST_FRAMES):
                if not taken:  # which may have waited for a compiler
                    started = time.monotonic()
                taken.append(frame)
                if frame.time_s - taken[0].time_s > LONGEST_TEST_S:
                    break
    except CameraError as error:
        yield CheckUp("problem", str(error), check="Frames")
        return
    if camera.source == "live":
        yield from _named("Frames", _arrival, taken)
    else:
        seconds = time.monotonic() - started
        yield found("frames_read", check="Frames", count=len(taken), seconds=seconds)
    frames = Frames(taken)
    valid = float((frames.depth > 0).mean())
    what = "filled" if valid > HARDLY_VALID else "hardly_filled"
    yield found(what, valid >= USUAL_VALID, "Filled", valid=valid, usual=USUAL_VALID)
    yield from _named("Noise", _noise, frames, camera)


def _arrival(frames: Sequence[Any]) -> CheckUp:
    """Whether a live camera's frames come in time, on its own clock, so that none is missing."""
    count, usual = len(frames), USUAL_FRAMES_PER_S
    seconds = frames[-1].time_s - frames[0].time_s
    lost = frames[-1].number - frames[0].number + 1 - count
    good = (count - 1) / max(seconds, 1e-3) >= 0.8 * usual and lost <= 0.1 * count
    return found("arrival", good, count=count, seconds=seconds, lost=lost, usual=usual)


def _noise(frames: Any, camera: Any) -> CheckUp:
    """The noise of the middle window over time, as disparity where the baseline is known."""
    from coursekit.stereo import window_stats

    height, width = frames[0].depth.shape
    side = min(WINDOW_PX, height, width)
    stats = window_stats(frames, ((width - side) // 2, (height - side) // 2, side, side))
    if stats.invalid_fraction > 0.5:
        return found("no_middle", invalid=stats.invalid_fraction)
    if stats.n_frames < LEAST_FRAMES_FOR_NOISE:
        return found("few_frames", count=stats.n_frames, wanted=TEST_FRAMES)
    mm, depth = 1e3 * stats.pixel_std_m, stats.depth_m
    if camera.baseline_m is None:
        return found("noise_alone", mm=mm, depth=depth)
    disparity = camera.depth.fx * camera.baseline_m / depth
    noise_px, usual = disparity * stats.pixel_std_unrounded_m / depth, USUAL_NOISE_PX
    return found("noise", noise_px <= usual[1], mm=mm, depth=depth, noise_px=noise_px, usual=usual)


if __name__ == "__main__":
    sys.exit(run(sys.argv[1] if len(sys.argv) > 1 else "auto"))
