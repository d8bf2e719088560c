"""The vendor's library: loading it, what it sees on USB, and its errors in words of advice."""

from __future__ import annotations

import contextlib
import ctypes
import re
import sys
from pathlib import Path
from types import ModuleType
from typing import Any

from coursekit.cameras.frames import CameraError, need
from coursekit.words import ROOM_TEXTS, say

USB_DEVICES = Path("/sys/bus/usb/devices")  # Linux only

UDEV_ADVICE = say("cameras.udev")


class LibraryMissing(CameraError):
    """pyrealsense2 cannot be used on this computer."""


def load_librealsense() -> ModuleType:
    """The module pyrealsense2; LibraryMissing, with what to do, where it cannot be loaded."""
    if sys.platform == "linux":
        # The wheel links libusb-1.0.so.0 and does not ship it; this needs neither root nor apt.
        # Where it fails the system's own libusb may do, and the import below says if it does not.
        with contextlib.suppress(ImportError, OSError):
            import libusb_package

            path = libusb_package.get_library_path()
            ctypes.CDLL(str(path), mode=ctypes.RTLD_GLOBAL)
    try:
        import pyrealsense2
    except ModuleNotFoundError:
        raise LibraryMissing(say("cameras.not_installed")) from None
    except ImportError as error:
        raise LibraryMissing(say("cameras.not_loading", error=error)) from error
    return pyrealsense2


def connected_realsenses() -> dict[str, str]:
    """Serial number and name of every RealSense that librealsense sees on USB.

    Raises LibraryMissing, and CameraError when one is plugged in that it may not touch.
    """
    rs = load_librealsense()
    try:
        found = {
            device_info(rs, device, "serial_number"): device_info(rs, device, "name")
            for device in rs.context().query_devices()
        }
    except RuntimeError as error:
        raise CameraError(start_problem("the RealSense", error)) from error
    found.pop("", None)  # a device in recovery mode has no serial number
    need(found or not _realsense_on_usb(), "cameras.not_permitted", udev=UDEV_ADVICE)
    return found


def device_info(rs: ModuleType, device: Any, name: str) -> str:
    """What the device says under `name` (a member of rs.camera_info), "" if it does not say."""
    field = getattr(rs.camera_info, name)
    return str(device.get_info(field)) if device.supports(field) else ""


def start_problem(what: str, error: RuntimeError) -> str:
    """The message for a live camera that does not start: what happened and what to do next."""
    for words, advice in ROOM_TEXTS["cameras"]["start"].items():
        if re.search(words, str(error).lower()):
            because = advice.format(udev=UDEV_ADVICE)
            return say("cameras.not_starting_because", what=what, advice=because, error=error)
    return say("cameras.not_starting", what=what, error=error)


def _realsense_on_usb() -> bool:
    """Whether the operating system (Linux only) sees a RealSense on USB."""
    products = USB_DEVICES.glob("*/product")
    return any("RealSense" in path.read_text("utf-8", "replace") for path in products)
