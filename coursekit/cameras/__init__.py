"""Cameras: live, recorded or simulated, behind one interface."""

from __future__ import annotations

import os
from pathlib import Path

from coursekit.cameras import conventions
from coursekit.cameras.camera import Camera, CameraError, Frame, Frames, place

__all__ = ["Camera", "CameraError", "Frame", "Frames", "conventions", "open_camera", "place"]

VARIABLE = "COURSEKIT_CAMERA"
WANTED = (
    'want "auto", "simulated", a serial number, the path of a .db3 or .bag recording, '
    "or a folder of them"
)


def open_camera(which: str | os.PathLike[str] = "auto", infrared: bool = False) -> Camera:
    """The camera that `which` names, open and ready.

    which: "simulated"; the path of a .db3 or .bag recording, or of a folder that
    `Camera.record_set` wrote; the serial number (digits) of a RealSense; or "auto", which is what
    the environment variable COURSEKIT_CAMERA names, else the first RealSense on USB, else the
    simulated camera. infrared: whether a live camera is to give its two infrared images with each
    frame; the others give them when they have them. Raises ValueError when `which` is none of
    these, and CameraError with what to do when the camera or file does not open: a RealSense that
    is plugged in but does not work is never replaced silently.
    """
    if isinstance(which, str) and which == "auto":
        named = os.environ.get(VARIABLE, "auto")
        if named == "auto":
            return _connected_or_simulated(infrared)
        return _open(named, VARIABLE, infrared)
    return _open(which, "which", infrared)


def _open(which: str | os.PathLike[str], argument: str, infrared: bool) -> Camera:
    if isinstance(which, os.PathLike):
        return _recording(os.fspath(which))
    if not isinstance(which, str):
        raise ValueError(f"{argument}: got {which!r}, {WANTED}")
    if which == "simulated":
        return _simulated()
    if which.isdecimal():
        return _live(which, infrared)
    if Path(which).suffix or "/" in which or os.sep in which or (which and Path(which).is_dir()):
        return _recording(which)
    raise ValueError(f"{argument}: got {which!r}, {WANTED}")


def _connected_or_simulated(infrared: bool) -> Camera:
    from coursekit.cameras.librealsense import LibraryMissing, connected_realsenses

    try:
        serials = connected_realsenses()
    except LibraryMissing as missing:
        return _simulated(f"The reason: {missing}.")
    return _live(min(serials), infrared) if serials else _simulated()


def _live(serial: str, infrared: bool) -> Camera:
    from coursekit.cameras.librealsense import connected_realsenses
    from coursekit.cameras.realsense import RealSense

    present = connected_realsenses()  # librealsense waits 15 s for a camera that is not there
    if serial not in present:
        found = ", ".join(f"{number} ({name})" for number, name in present.items())
        raise CameraError(
            f"there is no RealSense with serial number {serial} on USB; "
            + (f"there is {found}: open that one" if found else "there is none: plug it in")
        )
    return RealSense(serial=serial, infrared=infrared)


def _recording(name: str) -> Camera:
    from coursekit.cameras.realsense import RealSense
    from coursekit.cameras.recorded_set import RecordedSet

    path = Path(name).expanduser()
    return RecordedSet(path) if path.is_dir() else RealSense(path=path)


def _simulated(advice: str | None = None) -> Camera:
    from coursekit.cameras.simulated import PLUG_IN, SimulatedCamera

    return SimulatedCamera(advice=PLUG_IN if advice is None else advice)
