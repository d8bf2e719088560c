"""Cameras: live, recorded or simulated, behind one interface."""

from __future__ import annotations

import os
from pathlib import Path

from coursekit.cameras import conventions
from coursekit.cameras.camera import Camera, CameraError, Frame, Frames

__all__ = ["Camera", "CameraError", "Frame", "Frames", "conventions", "open_camera"]

VARIABLE = "COURSEKIT_CAMERA"
WANTED = 'want "auto", "simulated", a serial number, or the path of a .db3 or .bag recording'


def open_camera(which: str | os.PathLike[str] = "auto") -> Camera:
    """The camera that `which` names, open and ready.

    which: "simulated"; the path of a .db3 or .bag recording; the serial number (digits) of a
    RealSense; or "auto", which is what the environment variable COURSEKIT_CAMERA names, else the
    first RealSense on USB, else the simulated camera. Raises ValueError when it is none of these,
    and CameraError with what to do when the camera or file does not open: a RealSense that is
    plugged in but does not work is never replaced silently.
    """
    if isinstance(which, str) and which == "auto":
        named = os.environ.get(VARIABLE, "auto")
        return _connected_or_simulated() if named == "auto" else _open(named, VARIABLE)
    return _open(which, "which")


def _open(which: str | os.PathLike[str], argument: str) -> Camera:
    if isinstance(which, os.PathLike):
        return _recording(os.fspath(which))
    if not isinstance(which, str):
        raise ValueError(f"{argument}: got {which!r}, {WANTED}")
    if which == "simulated":
        return _simulated()
    if which.isdecimal():
        return _live(which)
    if Path(which).suffix or "/" in which or os.sep in which:
        return _recording(which)
    raise ValueError(f"{argument}: got {which!r}, {WANTED}")


def _connected_or_simulated() -> Camera:
    from coursekit.cameras.librealsense import LibraryMissing, connected_realsenses

    try:
        serials = connected_realsenses()
    except LibraryMissing as missing:
        return _simulated(f"The reason: {missing}.")
    return _live(min(serials)) if serials else _simulated()


def _live(serial: str) -> Camera:
    from coursekit.cameras.librealsense import connected_realsenses
    from coursekit.cameras.realsense import RealSense

    present = connected_realsenses()  # librealsense waits 15 s for a camera that is not there
    if serial not in present:
        found = ", ".join(f"{number} ({name})" for number, name in present.items())
        raise CameraError(
            f"there is no RealSense with serial number {serial} on USB; "
            + (f"there is {found}: open that one" if found else "there is none: plug it in")
        )
    return RealSense(serial=serial)


def _recording(path: str) -> Camera:
    from coursekit.cameras.realsense import RealSense

    return RealSense(path=Path(path).expanduser())


def _simulated(advice: str | None = None) -> Camera:
    from coursekit.cameras.simulated import PLUG_IN, SimulatedCamera

    return SimulatedCamera(advice=PLUG_IN if advice is None else advice)
