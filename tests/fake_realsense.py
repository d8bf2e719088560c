"""A stand-in for the module pyrealsense2 with one live D435, for what no test machine has."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from common import EXPECTED

from coursekit.cameras import Camera, Frame, librealsense, realsense
from coursekit.cameras.librealsense import LibraryMissing, load_librealsense

SERIAL = "728612070259"


def real_library() -> Any:
    """The module pyrealsense2 itself; the test is skipped where it cannot be used."""
    try:
        return load_librealsense()
    except LibraryMissing as missing:
        pytest.skip(str(missing))


def ending_after(camera: Camera, frames: int, error: BaseException) -> None:
    """Let the camera's stream end with an error after so many frames."""
    stream = camera.stream

    def ending() -> Iterator[Frame]:
        yield from itertools.islice(stream(), frames)
        raise error

    camera.stream = ending


def plugged_in(monkeypatch: pytest.MonkeyPatch, usb: Path, **behaviour: Any) -> FakeRealSense:
    """Plug in a fake D435 that behaves as the arguments say, and nothing else into `usb`."""
    rs = FakeRealSense(**behaviour)
    monkeypatch.delenv("COURSEKIT_CAMERA", raising=False)
    monkeypatch.setattr(librealsense, "USB_DEVICES", usb)
    monkeypatch.setattr(realsense, "_live_cameras", {})
    for module in (librealsense, realsense):
        monkeypatch.setattr(module, "load_librealsense", lambda: rs)
    return rs


@cache
def _noise() -> np.ndarray:
    return np.random.default_rng(0).standard_normal((480, 848), np.float32)


class _Names:
    """Any attribute is its own name, like the members of the library's enumerations."""

    def __getattr__(self, name: str) -> str:
        return name


class FakeSensor:
    def __init__(self, depth: bool, options: dict[str, float]) -> None:
        self.options = options
        self.is_depth_sensor = lambda: depth
        self.supports, self.get_option = options.__contains__, options.__getitem__
        self.set_calls: list[tuple[str, float]] = []

    def set_option(self, option: str, value: float) -> None:
        self.set_calls.append((option, value))
        self.options[option] = value

    def is_option_read_only(self, option: str) -> bool:
        return False

    def get_depth_scale(self) -> float:
        return float(np.float32(self.options.get("depth_units", 0.001)))


class FakeProfile:
    def __init__(self, stream: str, form: str, width: int, height: int, fx: float) -> None:
        self.stream_type, self.format = (lambda: stream), (lambda: f"format.{form}")
        self.as_video_stream_profile = lambda: self
        size = {"width": width, "height": height, "ppx": width / 2 + 1.5, "ppy": height / 2 - 2.5}
        lens = {"model": "distortion.inverse_brown_conrady", "fx": fx, "fy": fx + 0.25}
        coeffs = [0.1, -0.2, 0.001, 0.002, 0.05]
        self.get_intrinsics = lambda: SimpleNamespace(**size, **lens, coeffs=coeffs)

    def get_extrinsics_to(self, other: FakeProfile) -> SimpleNamespace:
        # A quarter turn about z, listed by columns as the library does: x goes to y.
        return SimpleNamespace(rotation=[0, 1, 0, -1, 0, 0, 0, 0, 1], translation=[0.015, 0, 0])


class FakeImage:
    def __init__(self, number: int, frames_per_s: float, pixels: Callable[[], np.ndarray]) -> None:
        self.get_data, self.get_frame_number = pixels, lambda: number
        self.get_timestamp = lambda: 1000.0 * number / frames_per_s

    def supports_frame_metadata(self, value: str) -> bool:
        return value in ("actual_exposure", "gain_level")

    def get_frame_metadata(self, value: str) -> int:
        return {"actual_exposure": 8500, "gain_level": 16}[value]


class FakeRealSense:
    """The module: `pyrealsense2` as far as the course's live camera uses it.

    start_error: what pipeline.start raises. frames: how many framesets come before `then` happens:
    an exception to raise, or None for silence. color_late: each depth image comes twice. told: what
    the device says of itself. noise, filled: std of the depth in counts about 700 (None: the same
    400 to 406 in each pixel), and the part of the pixels that have any.
    """

    __version__ = "fake"

    def __init__(
        self,
        start_error: str | None = None,
        frames: int = 10**9,
        then: BaseException | None = None,
        color_late: bool = False,
    ) -> None:
        self.start_error, self.limit, self.then = start_error, frames, then
        self.color_late = color_late
        self.serials = [SERIAL]
        self.noise: float | None = None
        self.filled, self.frames_per_s = 1.0, 30
        self.told = EXPECTED["told_by_a_d435"] | {"serial_number": SERIAL}
        self.starts = self.stops = self.given = 0
        self.enabled: list[tuple[Any, ...]] = []
        self.query_error: str | None = None
        automatic = {"enable_auto_exposure": 1, "exposure": 33000, "gain": 16}
        own = {"stereo_baseline": 50.17, "depth_units": 0.001}
        self.depth_sensor = FakeSensor(True, automatic | own)
        automatic = {"enable_auto_exposure": 1, "exposure": 156, "gain": 64}
        self.color_sensor = FakeSensor(False, automatic | {"enable_auto_white_balance": 1})
        self.motion_sensor = FakeSensor(False, {})
        for group in ("stream", "format", "option", "camera_info", "frame_metadata_value"):
            setattr(self, group, _Names())

    # module level
    def context(self) -> Any:
        if self.query_error:
            raise RuntimeError(self.query_error)
        return SimpleNamespace(query_devices=lambda: [_Device(self)] * len(self.serials))

    def pipeline(self) -> Any:
        return _Pipeline(self)

    def config(self) -> Any:
        return SimpleNamespace(
            enable_device=lambda serial: self.enabled.append(("device", serial)),
            enable_stream=lambda *stream: self.enabled.append(stream),
        )


class _Device:
    def __init__(self, rs: FakeRealSense) -> None:
        self._rs = rs
        self.supports, self.get_info = rs.told.__contains__, rs.told.__getitem__

    def first_depth_sensor(self) -> FakeSensor:
        return self._rs.depth_sensor

    def query_sensors(self) -> list[FakeSensor]:
        return [self._rs.depth_sensor, self._rs.color_sensor, self._rs.motion_sensor]


class _Pipeline:
    def __init__(self, rs: FakeRealSense) -> None:
        self._rs, self._waits = rs, 0

    def start(self, config: Any) -> Any:
        self._rs.starts += 1
        if self._rs.start_error:
            raise RuntimeError(self._rs.start_error)
        streams = [
            FakeProfile("depth", "z16", 848, 480, 426.0),
            FakeProfile("color", "rgb8", 640, 480, 613.0),
        ]
        device = _Device(self._rs)
        return SimpleNamespace(get_device=lambda: device, get_streams=lambda: streams)

    def try_wait_for_frames(self, timeout_ms: int) -> tuple[bool, Any]:
        rs = self._rs
        if rs.given >= rs.limit:
            if rs.then is not None:
                raise rs.then
            return False, None
        rs.given += 1
        number = (rs.given + 1) // 2 if rs.color_late else rs.given

        def depths() -> np.ndarray:
            if rs.noise is None:
                return np.full((480, 848), 400 + number % 7, np.uint16)
            depth = np.rint(700 + rs.noise * np.roll(_noise(), 7919 * number))
            empty = np.random.default_rng(number).random(depth.shape) >= rs.filled
            return np.where(empty, 0, depth).astype(np.uint16)

        depth = FakeImage(number, rs.frames_per_s, depths)
        images = [np.full((480, 848), 50 * eye, np.uint8) for eye in (1, 2)]
        images.append(np.full((480, 640, 3), 128, np.uint8))
        *eyes, color = (FakeImage(number, rs.frames_per_s, lambda i=i: i) for i in images)
        return True, SimpleNamespace(
            get_depth_frame=lambda: depth,
            get_color_frame=lambda: color,
            get_infrared_frame=lambda eye: eyes[eye - 1],
        )

    def stop(self) -> None:
        self._rs.stops += 1
        if self._rs.then is not None:
            raise RuntimeError("the device is gone")
