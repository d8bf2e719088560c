"""`coursekit doctor`: what works on this computer, and what to do about the rest.

Nothing but the standard library is imported before a check needs it, rooms of the course included,
so that a broken installation gets its line too: where `coursekit` itself does not start,
`python -m coursekit.doctor` does.

A check is a function that yields what it found: a verdict, a sentence, and a remedy. The tables
COMPUTER and FIGURES, at the end of their sections, give each its name and its turn.
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
import webbrowser
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Any, Literal, NamedTuple

Condition = Literal["ok", "note", "problem"]

OLDEST, NEWEST_TESTED, TOO_NEW = (3, 11), (3, 13), (3, 15)
PINS = Path(__file__).resolve().parents[1] / "requirements.txt"
WITHOUT_PACKAGES = {  # how it is called, and the Python that runs there all the same
    ("win32", "ARM64"): ("Windows on ARM", "the Python for x86-64"),
    ("darwin", "x86_64"): ("Intel processors under macOS", "on Apple silicon the arm64 Python"),
}
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

INSTALL = (
    "run `python3 course.py lab` again, which mends `.venv`; in an environment of your own, "
    "`pip install -r requirements.txt`"
)
FACTORY = (
    "the factory calibration looks damaged: restore it with the vendor's tools (RealSense Viewer, "
    "On-Chip Calibration, or Dynamic Calibrator), and measure it yourself in notebook 3"
)
LIGHTEN = (
    "point the camera at something with texture, 0.3 to 2 m away, neither shiny nor black; clean "
    "the front glass and take its film off; leave the projector on"
)


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
        text = textwrap.fill(self.says, LINE_WIDTH, initial_indent=head, subsequent_indent=blank)
        if not self.remedy:
            return text
        return f"{text}\n" + textwrap.fill(
            self.remedy, LINE_WIDTH, initial_indent=f"{blank}-> ", subsequent_indent=f"{blank}   "
        )


Check = Callable[..., CheckUp | Iterable[CheckUp] | None]


def run(camera: str = "auto", as_json: bool = False) -> int:
    """Print a line for each check as it is made; 0 when nothing is a problem, 1 otherwise.

    camera: what `open_camera` takes: "auto", "simulated", a serial number or a recording. as_json:
    one object for programs instead, when all are made.
    """
    if as_json:
        lines = list(checks(camera))
        print(json.dumps({"coursekit": edition(), "checks": list(map(asdict, lines))}, indent=1))
        return int(any(line.verdict == "problem" for line in lines))
    if isinstance(sys.stdout, io.TextIOWrapper):  # a pipe on Windows cannot show every letter
        sys.stdout.reconfigure(errors="replace")
    found = Counter[Condition]()
    for line in checks(camera):
        print(line, flush=True)
        found[line.verdict] += 1
    if problems := found["problem"]:
        print(f"\n{problems} problem{'s' * (problems > 1)}: do what stands there, and ask again.")
        return 1
    print("\nNothing is in the way. `python3 course.py lab` opens the notebooks.")
    return 0


def checks(camera: str = "auto") -> Iterator[CheckUp]:
    """The lines one by one; a check that fails gives a line, never an exception."""
    for name, check in COMPUTER:
        yield from _named(name, check)
    yield from _named("Camera", _cameras, camera)


def _named(name: str, check: Check, *about: Any) -> Iterator[CheckUp]:
    """What a check finds, under its name, and one more line when it fails on the way."""
    try:
        found = check(*about)
        for line in [found] if isinstance(found, CheckUp) else found or ():
            yield replace(line, check=line.check or name)
    except Exception as error:  # whatever a broken environment makes it raise
        says = f"could not be checked ({type(error).__name__}: {error})"
        remedy = f"mend the problems above first, if there are any; else {INSTALL}"
        yield CheckUp("problem", says, remedy, name)


def _ok_if(good: bool, says: str, remedy: str, otherwise: Condition = "note") -> CheckUp:
    return CheckUp("ok", says) if good else CheckUp(otherwise, says, remedy)


# ---- the computer -------------------------------------------------------------------------------


def _python() -> CheckUp:
    version = ".".join(map(str, sys.version_info[:3]))
    says = f"{version} on {platform.system()} {platform.machine()}, in {sys.prefix}"
    install = f"install Python {'.'.join(map(str, NEWEST_TESTED))} for 64 bits and begin again"
    if sys.version_info < OLDEST:
        wanted = ".".join(map(str, OLDEST))
        return CheckUp("problem", f"{says}: too old, want {wanted} or newer", install)
    elif sys.maxsize < 2**32:
        return CheckUp("problem", f"{says}: a 32-bit Python, it lacks the packages", install)
    elif sys.version_info[:2] >= TOO_NEW:
        return CheckUp("problem", f"{says}: too new, some packages do not exist for it", install)
    elif (computer := (sys.platform, platform.machine())) in WITHOUT_PACKAGES:
        lacks, runs = WITHOUT_PACKAGES[computer]
        remedy = f"install {runs}; or use another computer, or a hub"
        return CheckUp("problem", f"{says}: some packages do not exist for {lacks}", remedy)
    elif sys.version_info[:2] > NEWEST_TESTED:
        return CheckUp("note", f"{says}: newer than what the course was tested with", install)
    else:
        return CheckUp("ok", says)


def edition() -> str:
    """The course's version, and in a clone the commit."""
    commit = ""
    if (PINS.parent / ".git").exists() and shutil.which("git"):
        git = ["git", "-C", str(PINS.parent), "rev-parse", "--short", "HEAD"]
        commit = subprocess.run(git, capture_output=True, text=True, check=False).stdout.strip()
    return f"{_version('coursekit') or 'not installed'}{commit and ', commit '}{commit}"


class Pin(NamedTuple):
    """One package of requirements.txt; marker: where it is wanted, empty for everywhere."""

    name: str
    version: str
    marker: str


def pins(path: Path) -> list[Pin]:
    """The packages that a requirements file pins, in its order."""
    pattern = re.compile(r"^([\w.-]+)==([^\s;\\]+)\s*(?:;\s*([^\\]+?))?\s*\\?$")
    matches = map(pattern.match, path.read_text(encoding="utf-8").splitlines())
    return [Pin(m[1], m[2], m[3] or "") for m in matches if m]


def _packages() -> Iterator[CheckUp]:
    from packaging.markers import Marker

    if not PINS.exists():
        yield CheckUp("note", f"no {PINS.name} beside the course: nothing to compare with")
        return
    wanted = [pin for pin in pins(PINS) if not pin.marker or Marker(pin.marker).evaluate()]
    found = {pin.name: _version(pin.name) for pin in wanted}
    missing = [pin.name for pin in wanted if not found[pin.name]]
    others = [
        f"{pin.name} {found[pin.name]} (tested with {pin.version})"
        for pin in wanted
        if found[pin.name] not in (pin.version, "")
    ]
    broken = _out_of_range()
    if missing:
        yield CheckUp("problem", f"not installed: {_some(missing)}", INSTALL)
    if broken:
        yield CheckUp("problem", f"do not suit the course: {_some(broken)}", INSTALL)
    if others:
        yield CheckUp("note", f"other versions than the tested ones: {_some(others)}", INSTALL)
    if not missing and not broken and not others:
        yield CheckUp("ok", f"all {len(wanted)} as pinned in {PINS.name}")


def _version(name: str) -> str:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return ""


def _some(names: list[str], most: int = 5) -> str:
    """The first of a list in words."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


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
    says = "; ".join(failed) or f"{', '.join(LOADED)} load"
    return _ok_if(not failed, says, INSTALL, "problem")


def _opencv() -> CheckUp:
    """Whether one package brings cv2, and it is what was loaded: of two the last one wins."""
    import cv2

    brings = sorted(set(metadata.packages_distributions().get("cv2", ())))
    says = f"cv2 {cv2.__version__} comes from {' and '.join(brings) or 'no package'}"
    good = len(brings) == 1 and _version(brings[0]).startswith(cv2.__version__)
    away = f"`pip uninstall {' '.join(brings)}`, then {INSTALL}"
    return _ok_if(good and hasattr(cv2, "calibrateHandEye"), says, away, "problem")


def _kernel() -> CheckUp:
    """Whether the notebooks' kernel is this environment's; it is not started."""
    from jupyter_client.kernelspec import KernelSpecManager, NoSuchKernel

    try:
        spec = KernelSpecManager().get_kernel_spec("python3")
    except NoSuchKernel:
        return CheckUp("problem", "there is no kernel python3 for the notebooks", INSTALL)
    command = Path(spec.argv[0])
    if command.name == spec.argv[0] and command.stem.startswith("python"):
        return CheckUp("ok", "python3 is the Python that JupyterLab runs with")
    with contextlib.suppress(OSError):  # in one folder: a resolved link would lead out of a .venv
        if command.parent.samefile(Path(sys.executable).parent):
            return CheckUp("ok", "python3 is this environment's Python")
    return CheckUp(
        "problem",
        f"the kernel python3 in {spec.resource_dir} starts another Python, {command}",
        "`jupyter kernelspec remove python3` takes it away; or open the notebooks with "
        "`python3 course.py lab`, which takes its own first",
    )


def _browser() -> CheckUp:
    elsewhere = (
        "`python3 course.py lab` prints an address: open it in a browser on this computer, or from "
        "another one through `ssh -L PORT:localhost:PORT ...`, PORT being the number in it"
    )
    if "JUPYTERHUB_SERVICE_PREFIX" in os.environ:
        return CheckUp("ok", "a hub serves the notebooks to the browser that you have open")
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        return CheckUp("note", "this computer has no screen to show one on", elsewhere)
    try:
        name = getattr(webbrowser.get(), "name", "") or "the system's own"
    except webbrowser.Error:
        return CheckUp("note", "none was found", elsewhere)
    return CheckUp("ok", f"{name} opens the notebooks")


def _results() -> CheckUp:
    """Whether results can be saved; nothing is left behind."""
    from coursekit import results

    folder = results.folder()
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            free = shutil.disk_usage(there).free
    except OSError as error:
        return CheckUp(
            "problem",
            f"nothing can be saved in {folder} ({error.strerror or error})",
            "make the folder writable, copy the course into your home folder, or let the "
            "environment variable COURSEKIT_RESULTS name a folder of your own",
        )
    if free < LEAST_FREE_BYTES:
        says = f"only {free / 1e6:.0f} MB are free on the disk of {folder}"
        return CheckUp("problem", says, "delete something")
    return CheckUp("ok", f"{folder} can be written, {free / 1e9:.1f} GB free")


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
        yield CheckUp("ok", f"{VARIABLE} names {named!r}, so nothing else is looked for")
    if named == "simulated" or Path(named).is_dir():  # a set opens its files, and says so
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
    version = getattr(rs, "__version__", "")
    yield CheckUp("ok", f"pyrealsense2 {version} loads", check="Driver")
    live = named == "auto" or named.isdecimal()
    yield from _live(rs, named) if live else _tested(named)


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
        remedy = "to use one: plug it into a USB 3 port with its own cable, and wait a few seconds"
        yield CheckUp("note", "no RealSense is plugged in", remedy, "USB")
        if sys.platform == "linux":
            yield from _named("udev rules", _udev)
        yield from _stand_in()


def _stand_in() -> Iterator[CheckUp]:
    says = "the simulated camera stands in, which is fine: all of the course works with it"
    yield CheckUp("note", says)
    yield from _tested("simulated")


def _udev() -> CheckUp:
    """Whether Linux would let this user open a camera once it is plugged in."""
    from coursekit.cameras.librealsense import UDEV_ADVICE

    for folder in UDEV_FOLDERS:
        for rules in folder.glob("*realsense*.rules"):
            return CheckUp("ok", f"{rules}")
    says = "none for a RealSense: without them only root may use a real camera"
    return CheckUp("note", says, f"before you plug one in: {UDEV_ADVICE}")


def _device(rs: Any, device: Any) -> Iterator[CheckUp]:
    """What a plugged-in camera says of itself before it is started."""
    from coursekit.cameras.librealsense import device_info

    def told(name: str) -> str:
        return device_info(rs, device, name)

    yield CheckUp("ok", f"{told('name') or 'RealSense'}, serial {told('serial_number')}")
    yield from _named("USB link", _link, told("usb_type_descriptor"))
    versions = told("firmware_version"), told("recommended_firmware_version")
    yield from _named("Firmware", _firmware, *versions)


def _link(usb: str) -> CheckUp | None:
    if not usb or usb.startswith("3"):
        return CheckUp("ok", f"USB {usb}") if usb else None
    return CheckUp(
        "problem",
        f"USB {usb}: too slow for depth and colour together at 30 frames a second",
        "use a USB 3 port (blue, or marked SS) of the computer itself, not of a hub, and a USB "
        "3 cable, best its own; push the plug in fast, or turn a USB-C plug over",
    )


def _firmware(own: str, recommended: str) -> CheckUp | None:
    if not own or not recommended:
        return None
    numbers, wanted = (tuple(map(int, re.findall(r"\d+", v))) for v in (own, recommended))
    if numbers < wanted:
        says = f"{own}, older than {recommended}, which this version of librealsense wants"
        return CheckUp("note", says, "update it in the RealSense Viewer (More, Update)")
    return CheckUp("ok", f"{own}, recommended is {recommended}")


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


def _depth_unit(camera: Any) -> CheckUp:
    from coursekit.cameras.realsense import specified

    says, device = f"{1e3 * camera.depth_scale_m:g} mm a count", specified(camera.name)
    if device is None:
        return CheckUp("ok", f"{says} (usual: 1 mm, of a D405 0.1 mm)")
    usual = device.nominal.depth_scale_m
    good = abs(camera.depth_scale_m / usual - 1) < 1e-3
    remedy = f"if nobody meant it: camera.set(depth_scale_m={usual:g})"
    return _ok_if(good, f"{says} (usual: {1e3 * usual:g} mm)", remedy)


def _baseline(camera: Any) -> CheckUp:
    from coursekit.cameras.realsense import specified

    if camera.baseline_m is None:
        says = "none: no stereo camera, or a recording without its baseline"
        remedy = (
            "sections on disparity use the D435's 50 mm; your noise is fitted as std over distance"
        )
        return CheckUp("note", says, remedy)
    says, device = f"{1e3 * camera.baseline_m:.2f} mm", specified(camera.name)
    if device is None:
        return CheckUp("ok", f"{says} (usual: 18 to 95 mm)")
    nominal = device.nominal.baseline_m
    good = abs(camera.baseline_m / nominal - 1) < 0.02
    return _ok_if(good, f"{says} (usual: {1e3 * nominal:g} mm to 2 %)", FACTORY)


def _matrix(k: Any) -> CheckUp:
    """The factory's K, of an `Intrinsics`, beside what is usual: square pixels, a centred axis."""
    if k is None:
        says = "there is no colour stream: notebooks 3 and 4 need it"
        return CheckUp("note", says, "record depth and colour together")
    says = (
        f"fx {k.fx:.2f}, fy {k.fy:.2f}, cx {k.cx:.2f}, cy {k.cy:.2f} px at {k.width}x{k.height}, "
        f"{k.model} (usual: fx = fy to 1 %, the centre within 5 % of the width)"
    )
    off = max(abs(k.cx - (k.width - 1) / 2), abs(k.cy - (k.height - 1) / 2))
    return _ok_if(abs(k.fx / k.fy - 1) < 0.01 and off < 0.05 * k.width, says, FACTORY)


FIGURES: tuple[tuple[str, Check], ...] = (
    ("Depth unit", _depth_unit),
    ("Baseline", _baseline),
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
        says = f"{len(taken)} read in {time.monotonic() - started:.1f} s"
        yield CheckUp("ok", says, check="Frames")
    frames = Frames(taken)
    yield from _named("Filled", _filled, float((frames.depth > 0).mean()))
    yield from _named("Noise", _noise, frames, camera)


def _arrival(frames: Sequence[Any]) -> CheckUp:
    """Whether a live camera's frames come in time, on its own clock, so that none is missing."""
    count = len(frames)
    seconds = frames[-1].time_s - frames[0].time_s
    lost = frames[-1].number - frames[0].number + 1 - count
    says = (
        f"{count} in {seconds:.2f} s, {lost} lost between them "
        f"(usual: {USUAL_FRAMES_PER_S} a second, none lost)"
    )
    rate = (count - 1) / max(seconds, 1e-3)
    return _ok_if(
        rate >= 0.8 * USUAL_FRAMES_PER_S and lost <= 0.1 * count,
        says,
        "close what keeps the computer or its USB busy, plug the camera in directly, and do not "
        "run it beside another camera on one hub",
    )


def _filled(valid: float) -> CheckUp:
    says = f"{valid:.0%} of the pixels have depth (usual: more than {USUAL_VALID:.0%} indoors)"
    otherwise: Condition = "note" if valid > HARDLY_VALID else "problem"
    return _ok_if(valid >= USUAL_VALID, says, LIGHTEN, otherwise)


def _noise(frames: Any, camera: Any) -> CheckUp:
    """The noise of the middle window over time, as disparity where the baseline is known."""
    from coursekit.stereo import window_stats

    height, width = frames[0].depth.shape
    side = min(WINDOW_PX, height, width)
    stats = window_stats(frames, ((width - side) // 2, (height - side) // 2, side, side))
    if stats.invalid_fraction > 0.5:
        says = f"no depth in the middle of the image ({stats.invalid_fraction:.0%} invalid)"
        return CheckUp("note", says, LIGHTEN)
    if stats.n_frames < LEAST_FRAMES_FOR_NOISE:
        says = f"{stats.n_frames} frames are too few to tell"
        return CheckUp("note", says, f"record {TEST_FRAMES} or more")
    says = f"{1e3 * stats.pixel_std_m:.2f} mm over time for a pixel at {stats.depth_m:.2f} m"
    if camera.baseline_m is None:
        return CheckUp("ok", says)
    disparity = camera.depth.fx * camera.baseline_m / stats.depth_m
    noise_px = disparity * stats.pixel_std_unrounded_m / stats.depth_m
    low, high = USUAL_NOISE_PX
    says += f", {noise_px:.3f} px of disparity (usual: {low} to {high} px)"
    return _ok_if(noise_px <= high, says, f"hold everything still, and {LIGHTEN}")


if __name__ == "__main__":
    sys.exit(run(sys.argv[1] if len(sys.argv) > 1 else "auto"))
