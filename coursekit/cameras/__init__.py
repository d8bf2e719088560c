"""Cameras: live, recorded or simulated, behind one interface."""

from __future__ import annotations

import os
from pathlib import Path

from coursekit.cameras import conventions
from coursekit.cameras.camera import Camera, place
from coursekit.cameras.files import ImageFolder, RecordedSet, RosBag, play
from coursekit.cameras.frames import CameraError, Frame, Frames
from coursekit.cameras.librealsense import LibraryMissing, connected_realsenses
from coursekit.cameras.realsense import RealSense
from coursekit.cameras.recording import INDEX, INTRINSICS
from coursekit.cameras.simulated import SimulatedCamera, my_unit
from coursekit.words import say

__all__ = [
    "Camera", "CameraError", "Frame", "Frames", "conventions", "my_unit", "open_camera", "place",
]  # fmt: skip

VARIABLE = "COURSEKIT_CAMERA"


def open_camera(
    which: str | os.PathLike[str] = "auto", infrared: bool = False, seed: int | None = None
) -> Camera:
    """The camera that `which` names, open and ready.

    which: "simulated"; the path of a .db3 or .bag recording, of a folder that `Camera.record_set`
    wrote, or of one with 16-bit PNGs of depth and an intrinsics.json (`ImageFolder`); the serial
    number (digits) of a RealSense; or "auto", which is what the environment variable
    COURSEKIT_CAMERA names, else the first RealSense on USB, else the
    simulated camera. infrared: whether a live camera is to give its two infrared images with each
    frame; the others give them when they have them. seed: which simulated camera, a whole number;
    None for your own, `my_unit()`. Another seed is another unit of the same model, with errors of
    its own; real cameras and recordings have none. Raises ValueError when `which` is none of
    these, and CameraError with what to do when the camera or file does not open: a RealSense that
    is plugged in but does not work is never replaced silently.

    >>> camera = open_camera("simulated")
    >>> camera.depth.size, camera.baseline_m
    ((848, 480), 0.0501707)
    """
    argument = "which"
    if isinstance(which, str) and which == "auto":
        which, argument = os.environ.get(VARIABLE, "auto"), VARIABLE
        if which == "auto":
            return _connected_or_simulated(infrared, seed)
    if isinstance(which, os.PathLike):
        return _recording(Path(which))
    if isinstance(which, str):
        if which == "simulated":
            wanted = argument == "which"  # and then not to be told how to get another
            return SimulatedCamera(seed=seed, advice="" if wanted else say("cameras.plug_in"))
        if which.isdecimal():
            return _live(which, infrared)
        path = Path(which)
        if path.suffix or "/" in which or os.sep in which or (which and path.is_dir()):
            return _recording(path)
    raise ValueError(f"{argument}: got {which!r}, {say('cameras.which')}")


def _connected_or_simulated(infrared: bool, seed: int | None) -> Camera:
    try:
        serials = connected_realsenses()
    except LibraryMissing as missing:
        return SimulatedCamera(seed=seed, advice=f"The reason: {missing}.")
    return RealSense(min(serials), infrared=infrared) if serials else SimulatedCamera(seed=seed)


def _live(serial: str, infrared: bool) -> Camera:
    present = connected_realsenses()  # librealsense waits 15 s for a camera that is not there
    if serial not in present:
        found = ", ".join(f"{number} ({name})" for number, name in present.items())
        instead = f"there is {found}: open that one" if found else "there is none: plug it in"
        raise CameraError(say("cameras.no_such_serial", serial=serial, instead=instead))
    return RealSense(serial, infrared=infrared)


def _recording(path: Path) -> Camera:
    path = path.expanduser()
    if not path.is_dir():
        return play(path)
    if (path / "metadata.yaml").exists():  # what `ros2 bag record` makes
        return RosBag(path)
    images = (path / INTRINSICS).exists() or any(path.glob("*.png"))
    return ImageFolder(path) if images and not (path / INDEX).exists() else RecordedSet(path)
