"""`coursekit doctor`: what works on this computer, and what to do about the rest.

Nothing but the standard library is imported before a check needs it, so that a broken installation
gets its line too: where `coursekit` itself does not start, `python -m coursekit.doctor` does.
"""

from __future__ import annotations

import contextlib
import importlib
import io
import itertools
import os
import platform
import re
import shutil
import sys
import tempfile
import textwrap
import time
import webbrowser
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from coursekit import results

if TYPE_CHECKING:
    from coursekit.cameras import Camera, Frame, Frames
    from coursekit.geometry import Intrinsics
    from coursekit.specifications import Device
    from coursekit.stereo import WindowStats

Verdict = Literal["ok", "note", "problem"]

# What a broken environment can make a check raise. Anything else is a mistake of this module.
CONTAINED = (
    ArithmeticError,
    AttributeError,
    EOFError,
    ImportError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,  # CameraError, and what librealsense raises
    SyntaxError,
    TypeError,
    ValueError,
)

OLDEST, NEWEST_TESTED = (3, 11), (3, 13)
PINS = results.ROOT / "requirements.txt"
LOADED = ("numpy", "scipy", "cv2", "numba", "matplotlib", "ipywidgets")
UDEV_FOLDERS = tuple(map(Path, ("/etc/udev/rules.d", "/usr/lib/udev/rules.d", "/lib/udev/rules.d")))
LEAST_FREE_BYTES = 100_000_000  # results, recordings, bundles
WIDTH = 100

TEST_FRAMES, LONGEST_TEST_S = 30, 3.0  # a second of a camera that gives 30 frames a second
FRAMES_PER_S = 30
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
class Line:
    """What one check found: a note is worth knowing, a problem is in the way."""

    check: str
    verdict: Verdict
    says: str
    remedy: str = ""

    def __str__(self) -> str:
        head = f"{self.verdict:8} {self.check:12} "
        blank = " " * len(head)
        text = textwrap.fill(self.says, WIDTH, initial_indent=head, subsequent_indent=blank)
        if not self.remedy:
            return text
        return f"{text}\n" + textwrap.fill(
            self.remedy, WIDTH, initial_indent=f"{blank}-> ", subsequent_indent=f"{blank}   "
        )


def run(camera: str = "auto") -> int:
    """Print a line for each check as it is made; 0 when nothing is a problem, 1 otherwise.

    camera: what `open_camera` takes: "auto", "simulated", a serial number or a recording.
    """
    if isinstance(sys.stdout, io.TextIOWrapper):  # a pipe on Windows cannot show every letter
        sys.stdout.reconfigure(errors="replace")
    found = Counter[Verdict]()
    for line in checks(camera):
        print(line, flush=True)
        found[line.verdict] += 1
    problems = found["problem"]
    if problems:
        print(f"\n{problems} problem{'s' * (problems != 1)}: do what stands there, and ask again.")
        return 1
    print("\nNothing is in the way. `python3 course.py lab` opens the notebooks.")
    return 0


def examine(camera: str = "auto") -> list[Line]:
    """All the lines of `run`, without printing them."""
    return list(checks(camera))


def checks(camera: str = "auto") -> Iterator[Line]:
    """The lines one by one; a check that fails gives a line, never an exception."""
    for name, check in (
        ("Python", _python),
        ("Packages", _packages),
        ("Loading", _loading),
        ("Kernel", _kernel),
        ("Browser", _browser),
        ("results/", _results),
        ("Camera", partial(_cameras, camera)),
    ):
        yield from _contained(name, check)


def _contained(name: str, check: Callable[[], Iterable[Line]]) -> Iterator[Line]:
    """The lines of a check, and one more when it fails on the way."""
    try:
        yield from check()
    except CONTAINED as error:
        yield Line(
            name,
            "problem",
            f"could not be checked ({type(error).__name__}: {error})",
            f"mend the problems above first, if there are any; else {INSTALL}",
        )


# ---- the computer -------------------------------------------------------------------------------


def _python() -> Iterator[Line]:
    version = ".".join(map(str, sys.version_info[:3]))
    system = f"{platform.system()} {platform.machine()}"
    says = f"{version} on {system}, in {sys.prefix}"
    install = f"install Python {'.'.join(map(str, NEWEST_TESTED))} for 64 bits and begin again"
    if sys.version_info < OLDEST:
        wanted = ".".join(map(str, OLDEST))
        yield Line("Python", "problem", f"{says}: too old, want {wanted} or newer", install)
    elif sys.maxsize < 2**32:
        yield Line("Python", "problem", f"{says}: a 32-bit Python, it lacks the packages", install)
    elif (sys.platform, platform.machine()) == ("darwin", "x86_64"):
        yield Line(
            "Python",
            "problem",
            f"{says}: some packages no longer exist for Intel processors under macOS",
            "on an Apple-silicon Mac take the arm64 Python; else use another computer or a hub",
        )
    elif sys.version_info[:2] > NEWEST_TESTED:
        yield Line("Python", "note", f"{says}: newer than what the course was tested with", install)
    else:
        yield Line("Python", "ok", says)


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


def _packages() -> Iterator[Line]:
    from packaging.markers import Marker

    if not PINS.exists():
        yield Line("Packages", "note", f"no {PINS.name} beside the course: nothing to compare with")
        return
    wanted = [pin for pin in pins(PINS) if not pin.marker or Marker(pin.marker).evaluate()]
    found = {pin.name: _version(pin.name) for pin in wanted}
    missing = [pin.name for pin in wanted if not found[pin.name]]
    other = [pin for pin in wanted if found[pin.name] not in (pin.version, "")]
    if missing:
        yield Line("Packages", "problem", f"not installed: {_some(missing)}", INSTALL)
    if broken := _out_of_range():
        yield Line("Packages", "problem", f"do not suit the course: {_some(broken)}", INSTALL)
    if other:
        named = [f"{p.name} {found[p.name]} (tested with {p.version})" for p in other]
        says = f"other versions than the tested ones: {_some(named)}"
        yield Line("Packages", "note", says, INSTALL)
    if not missing and not broken and not other:
        yield Line("Packages", "ok", f"all {len(wanted)} as pinned in {PINS.name}")


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


def _loading() -> Iterator[Line]:
    """Whether the packages with compiled parts load: a wheel can be damaged or lack a library."""
    failed = {}
    for name in LOADED:
        try:
            importlib.import_module(name)
        except CONTAINED as error:
            failed[name] = str(error).splitlines()[0] if str(error) else type(error).__name__
    if failed:
        says = "; ".join(f"{name} does not load ({why})" for name, why in failed.items())
        yield Line("Loading", "problem", says, INSTALL)
    else:
        yield Line("Loading", "ok", f"{', '.join(LOADED)} load")


def _kernel() -> Iterator[Line]:
    """Whether the notebooks' kernel is this environment's; it is not started."""
    from jupyter_client.kernelspec import KernelSpecManager, NoSuchKernel

    try:
        spec = KernelSpecManager().get_kernel_spec("python3")
    except NoSuchKernel:
        yield Line("Kernel", "problem", "there is no kernel python3 for the notebooks", INSTALL)
        return
    command = Path(spec.argv[0])
    if command.name == spec.argv[0] and command.stem.startswith("python"):
        yield Line("Kernel", "ok", "python3 is the Python that JupyterLab runs with")
    elif _same_folder(command, Path(sys.executable)):
        yield Line("Kernel", "ok", "python3 is this environment's Python")
    else:
        yield Line(
            "Kernel",
            "problem",
            f"the kernel python3 in {spec.resource_dir} starts another Python, {command}",
            "`jupyter kernelspec remove python3` takes it away; or open the notebooks with "
            "`python3 course.py lab`, which takes its own first",
        )


def _same_folder(one: Path, other: Path) -> bool:
    """Whether two programs lie in one folder (a resolved link would lead out of a .venv)."""
    with contextlib.suppress(OSError):
        return one.parent.samefile(other.parent)
    return False


def _browser() -> Iterator[Line]:
    if "JUPYTERHUB_SERVICE_PREFIX" in os.environ:
        yield Line("Browser", "ok", "a hub serves the notebooks to the browser that you have open")
        return
    elsewhere = (
        "`python3 course.py lab` prints an address: open it in a browser on this computer, or from "
        "another one through `ssh -L 8888:localhost:8888 ...`"
    )
    if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
        yield Line("Browser", "note", "this computer has no screen to show one on", elsewhere)
        return
    try:
        name = getattr(webbrowser.get(), "name", "") or "the system's own"
    except webbrowser.Error:
        yield Line("Browser", "note", "none was found", elsewhere)
        return
    yield Line("Browser", "ok", f"{name} opens the notebooks")


def _results() -> Iterator[Line]:
    """Whether results can be saved; nothing is left behind."""
    folder = results.folder()
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    try:
        with tempfile.TemporaryFile(dir=there):
            pass
        free = shutil.disk_usage(there).free
    except OSError as error:
        yield Line(
            "results/",
            "problem",
            f"nothing can be saved in {folder} ({error.strerror or error})",
            "make the folder writable, copy the course into your home folder, or let the "
            "environment variable COURSEKIT_RESULTS name a folder of your own",
        )
        return
    if free < LEAST_FREE_BYTES:
        says = f"only {free / 1e6:.0f} MB are free on the disk of {folder}"
        yield Line("results/", "problem", says, "delete something")
    else:
        yield Line("results/", "ok", f"{folder} can be written, {free / 1e9:.1f} GB free")


# ---- the camera ---------------------------------------------------------------------------------


def _cameras(which: str) -> Iterator[Line]:
    from coursekit.cameras import VARIABLE
    from coursekit.cameras.librealsense import LibraryMissing, load_librealsense

    named = os.environ.get(VARIABLE, "auto") if which == "auto" else which
    if named != which:
        yield Line("Camera", "ok", f"{VARIABLE} names {named!r}, so nothing else is looked for")
    if named == "simulated" or Path(named).is_dir():  # a set opens its files, and says so
        yield from _tested(named)
        return
    try:
        rs = load_librealsense()
    except LibraryMissing as missing:
        broken = missing.__cause__ is not None  # installed, and does not load
        verdict: Verdict = "problem" if broken or named != "auto" else "note"
        yield Line("Driver", verdict, str(missing))
        if named == "auto":
            yield from _stand_in()
        return
    yield Line("Driver", "ok", f"pyrealsense2 {getattr(rs, '__version__', '')} loads")
    if named == "auto" or named.isdecimal():
        yield from _live(rs, named)
    else:
        yield from _tested(named)


def _live(rs: Any, named: str) -> Iterator[Line]:
    """The cameras on USB, and a test of the first or the named one; without any, the stand-in."""
    from coursekit.cameras import CameraError
    from coursekit.cameras.librealsense import connected_realsenses

    try:
        serials = connected_realsenses()
    except CameraError as error:
        yield Line("USB", "problem", str(error))
        return
    if named not in ("auto", *serials):
        yield from _tested(named)  # says which there are
        return
    if not serials:
        yield Line(
            "USB",
            "note",
            "no RealSense is plugged in",
            "to use one: plug it into a USB 3 port with its own cable, and wait a few seconds",
        )
        yield from _udev()
        yield from _stand_in()
        return
    for device in rs.context().query_devices():
        yield from _contained("USB", partial(_device, rs, device))
    yield from _tested(min(serials) if named == "auto" else named)


def _stand_in() -> Iterator[Line]:
    says = "the simulated camera stands in, which is fine: all of the course works with it"
    yield Line("Camera", "note", says)
    yield from _tested("simulated")


def _udev() -> Iterator[Line]:
    """Whether Linux would let this user open a camera once it is plugged in."""
    from coursekit.cameras.librealsense import UDEV_ADVICE

    if sys.platform != "linux":
        return
    rules = [rule for folder in UDEV_FOLDERS for rule in folder.glob("*realsense*.rules")]
    if rules:
        yield Line("udev rules", "ok", f"{rules[0]}")
    else:
        says = "none for a RealSense: without them only root may use a real camera"
        yield Line("udev rules", "note", says, f"before you plug one in: {UDEV_ADVICE}")


def _device(rs: Any, device: Any) -> Iterator[Line]:
    """What a plugged-in camera says of itself before it is started."""
    from coursekit.cameras.librealsense import device_info

    info = partial(device_info, rs, device)
    yield Line("USB", "ok", f"{info('name') or 'RealSense'}, serial {info('serial_number')}")
    yield from _contained("USB link", partial(_link, info("usb_type_descriptor")))
    versions = info("firmware_version"), info("recommended_firmware_version")
    yield from _contained("Firmware", partial(_firmware, *versions))


def _link(usb: str) -> Iterator[Line]:
    if usb.startswith("3"):
        yield Line("USB link", "ok", f"USB {usb}")
    elif usb:
        yield Line(
            "USB link",
            "problem",
            f"USB {usb}: too slow for depth and colour together at 30 frames a second",
            "use a USB 3 port (blue, or marked SS) of the computer itself, not of a hub, and a USB "
            "3 cable, best its own; push the plug in fast, or turn a USB-C plug over",
        )


def _firmware(own: str, recommended: str) -> Iterator[Line]:
    if not own or not recommended:
        return
    if _numbers(own) < _numbers(recommended):
        says = f"{own}, older than {recommended}, which this version of librealsense wants"
        yield Line("Firmware", "note", says, "update it in the RealSense Viewer (More, Update)")
    else:
        yield Line("Firmware", "ok", f"{own}, recommended is {recommended}")


def _numbers(version: str) -> tuple[int, ...]:
    return tuple(map(int, re.findall(r"\d+", version)))


# ---- what a camera reports, and what it measures ------------------------------------------------


def _tested(which: str) -> Iterator[Line]:
    """A camera or recording, opened: its figures beside what is usual, and its depth."""
    from coursekit.cameras import CameraError, open_camera

    try:
        camera = open_camera(which)
    except (CameraError, ValueError) as error:
        yield Line("Camera", "problem", str(error))
        return
    with camera:
        yield Line("Camera", "ok", repr(camera).splitlines()[0])
        for name, check in (
            ("Depth unit", _depth_unit),
            ("Baseline", _baseline),
            ("K of depth", _depth_matrix),
            ("K of colour", _color_matrix),
            ("Depth test", _depth_test),
        ):
            yield from _contained(name, partial(check, camera))


def _specified(camera: Camera) -> Device | None:
    """The device of data/devices.toml that a camera is, by its name."""
    from coursekit import specifications

    for name in specifications.device_names():
        if re.search(rf"\b{name}", camera.name):  # also D435i
            return specifications.device(name)
    return None


def _depth_unit(camera: Camera) -> Iterator[Line]:
    says = f"{1e3 * camera.depth_scale_m:g} mm a count"
    device = _specified(camera)
    if device is None:
        yield Line("Depth unit", "ok", f"{says} (usual: 1 mm, of a D405 0.1 mm)")
        return
    usual = device.nominal.depth_scale_m
    says += f" (usual: {1e3 * usual:g} mm)"
    if abs(camera.depth_scale_m / usual - 1) < 1e-3:
        yield Line("Depth unit", "ok", says)
    else:
        remedy = f"if nobody meant it: camera.set(depth_scale_m={usual:g})"
        yield Line("Depth unit", "note", says, remedy)


def _baseline(camera: Camera) -> Iterator[Line]:
    if camera.baseline_m is None:
        says = "not recorded: disparity and the noise law need it"
        yield Line("Baseline", "note", says, "record anew with `coursekit record`, which keeps it")
        return
    says, device = f"{1e3 * camera.baseline_m:.2f} mm", _specified(camera)
    if device is None:
        yield Line("Baseline", "ok", f"{says} (usual: 18 to 95 mm)")
        return
    nominal = device.nominal.baseline_m
    says += f" (usual: {1e3 * nominal:g} mm to 2 %)"
    good = abs(camera.baseline_m / nominal - 1) < 0.02
    yield Line("Baseline", "ok" if good else "note", says, "" if good else FACTORY)


def _depth_matrix(camera: Camera) -> Iterator[Line]:
    yield _matrix("K of depth", camera.depth)


def _color_matrix(camera: Camera) -> Iterator[Line]:
    if camera.color is None:
        says = "there is no colour stream: notebooks 3 and 4 need it"
        yield Line("K of colour", "note", says, "record depth and colour together")
    else:
        yield _matrix("K of colour", camera.color)


def _matrix(name: str, k: Intrinsics) -> Line:
    """The factory's K beside what is usual: square pixels, a centred axis."""
    says = (
        f"fx {k.fx:.2f}, fy {k.fy:.2f}, cx {k.cx:.2f}, cy {k.cy:.2f} px at {k.width}x{k.height}, "
        f"{k.model} (usual: fx = fy to 1 %, the centre within 5 % of the width)"
    )
    off = max(abs(k.cx - (k.width - 1) / 2), abs(k.cy - (k.height - 1) / 2))
    good = abs(k.fx / k.fy - 1) < 0.01 and off < 0.05 * k.width
    return Line(name, "ok" if good else "note", says, "" if good else FACTORY)


def _depth_test(camera: Camera) -> Iterator[Line]:
    """A second of depth: how many frames come, how much of them is depth, how noisy it is."""
    from coursekit.cameras import CameraError
    from coursekit.stereo import window_stats

    try:
        frames, seconds = _second_of(camera)
    except CameraError as error:
        yield Line("Frames", "problem", str(error))
        return
    yield _arrival([frame.number for frame in frames], seconds, camera.source == "live")
    counts = frames.depth
    height, width = counts.shape[1:]
    yield _filled(float((counts > 0).mean()))
    side = min(WINDOW_PX, height, width)
    window = ((width - side) // 2, (height - side) // 2, side, side)
    yield _noise(window_stats(frames, window), camera)


def _second_of(camera: Camera) -> tuple[Frames, float]:
    """TEST_FRAMES frames, or those of LONGEST_TEST_S seconds, or what a recording has.

    And the seconds between the first and the last; the first may wait for a compiler.
    """
    from coursekit.cameras import Frames

    taken: list[Frame] = []
    seconds = 0.0
    with contextlib.closing(camera._stream()) as stream:
        for frame in itertools.islice(stream, TEST_FRAMES):
            if not taken:
                started = time.monotonic()
            taken.append(frame)
            seconds = time.monotonic() - started
            if seconds > LONGEST_TEST_S:
                break
    return Frames(taken), seconds


def _arrival(numbers: list[int], seconds: float, live: bool) -> Line:
    """numbers: of the frames that came; seconds: from the first to the last."""
    count = len(numbers)
    lost = numbers[-1] - numbers[0] + 1 - count
    if not live:
        return Line("Frames", "ok", f"{count} read in {seconds:.1f} s")
    says = (
        f"{count} in {seconds:.2f} s, {lost} lost between them "
        f"(usual: {FRAMES_PER_S} a second, none lost)"
    )
    rate = (count - 1) / max(seconds, 1e-3)
    if rate >= 0.8 * FRAMES_PER_S and lost <= 0.1 * count:
        return Line("Frames", "ok", says)
    return Line(
        "Frames",
        "note",
        says,
        "close what keeps the computer or its USB busy, plug the camera in directly, and do not "
        "run it beside another camera on one hub",
    )


def _filled(valid: float) -> Line:
    says = f"{valid:.0%} of the pixels have depth (usual: more than {USUAL_VALID:.0%} indoors)"
    if valid >= USUAL_VALID:
        return Line("Filled", "ok", says)
    return Line("Filled", "note" if valid > HARDLY_VALID else "problem", says, LIGHTEN)


def _noise(stats: WindowStats, camera: Camera) -> Line:
    """The noise of the middle window over time, as disparity where the baseline is known."""
    if stats.invalid_fraction > 0.5:
        says = f"no depth in the middle of the image ({stats.invalid_fraction:.0%} invalid)"
        return Line("Noise", "note", says, LIGHTEN)
    if stats.n_frames < LEAST_FRAMES_FOR_NOISE:
        says = f"{stats.n_frames} frames are too few to tell"
        return Line("Noise", "note", says, f"record {TEST_FRAMES} or more")
    says = f"{1e3 * stats.pixel_std_m:.2f} mm over time for a pixel at {stats.depth_m:.2f} m"
    if camera.baseline_m is None:
        return Line("Noise", "ok", says)
    disparity = camera.depth.fx * camera.baseline_m / stats.depth_m
    noise_px = disparity * stats.pixel_std_unrounded_m / stats.depth_m
    low, high = USUAL_NOISE_PX
    says += f", {noise_px:.3f} px of disparity (usual: {low} to {high} px)"
    if noise_px <= high:
        return Line("Noise", "ok", says)
    return Line("Noise", "note", says, f"hold everything still, and {LIGHTEN}")


if __name__ == "__main__":
    sys.exit(run(sys.argv[1] if len(sys.argv) > 1 else "auto"))
