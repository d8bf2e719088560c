"""RealSense cameras on USB, in librealsense's hands."""

from __future__ import annotations

import contextlib
import itertools
import re
import threading
import weakref
from collections.abc import Generator
from typing import Any

import numpy as np

from coursekit import specifications
from coursekit.arrays import Image
from coursekit.cameras import recording
from coursekit.cameras.camera import Camera, camera_line
from coursekit.cameras.frames import FRAMES_PER_S, CameraError, Frame, need
from coursekit.cameras.librealsense import device_info, load_librealsense, start_problem
from coursekit.geometry import Intrinsics, make_transform
from coursekit.words import ROOM_TEXTS, say

DEPTH_SIZE, COLOR_SIZE = (848, 480), (640, 480)
WARM_UP_FRAMES = 30  # automatic exposure settles in about a second
SETTLE_FRAMES = 6  # a new exposure shows up to five frames later (librealsense issue 11228)
POLL_MS = 50
# Without a frame in so many waits (5 s) the camera is gone. Waits are counted, because a busy
# computer can let any time pass between two of them.
MOST_POLLS = 100

_live_cameras: weakref.WeakValueDictionary[str, RealSense] = weakref.WeakValueDictionary()


class RealSense(Camera):
    """A RealSense on USB, by its serial number.

    infrared: whether it is to give both infrared images too. Raises LibraryMissing without
    pyrealsense2, and CameraError for a camera that does not open. All attributes are what the
    device reports about itself.
    """

    source, can_place = "live", True

    def __init__(self, serial: str, infrared: bool = False) -> None:
        self._rs = load_librealsense()
        self._running = _Running()
        weakref.finalize(self, self._running.leave)
        self._infrared, self.serial = infrared, serial
        self._what = f"the RealSense {serial}"
        if serial in _live_cameras:  # the setup cell was run again
            _live_cameras[serial].close()
        try:
            self._start()
            self._query()
            _live_cameras[self.serial] = self
            self._skip(WARM_UP_FRAMES)
        except BaseException as error:  # Ctrl-C, too: nobody holds this camera
            self.close()
            if isinstance(error, CameraError) or not isinstance(error, (RuntimeError, ValueError)):
                raise
            raise CameraError(f"{self._what} does not describe itself fully: {error}") from error

    # --- opening and closing -------------------------------------------------------------------

    def _start(self) -> None:
        """Start streaming."""
        with self._running.turn:
            need(not self._running.left, "cameras.closed_meanwhile", what=self._what)
            try:
                # held before it starts: a Ctrl-C meanwhile comes as soon as it has
                self._running.pipeline = self._rs.pipeline()
                self._profile = self._running.pipeline.start(self._config())
            except RuntimeError as error:
                self._running.pipeline = None
                raise CameraError(start_problem(self._what, error)) from error

    def _config(self) -> Any:
        rs, config = self._rs, self._rs.config()
        config.enable_device(self.serial)
        config.enable_stream(rs.stream.depth, *DEPTH_SIZE, rs.format.z16, FRAMES_PER_S)
        config.enable_stream(rs.stream.color, *COLOR_SIZE, rs.format.rgb8, FRAMES_PER_S)
        for eye in (1, 2) if self._infrared else ():
            config.enable_stream(rs.stream.infrared, eye, *DEPTH_SIZE, rs.format.y8, FRAMES_PER_S)
        return config

    def _check_open(self) -> None:
        need(self._running.pipeline, "cameras.closed", what=self._what)

    def _depth_sensor(self) -> Any:
        return self._profile.get_device().first_depth_sensor()

    def close(self) -> None:
        """Stop the camera; a second call does nothing."""
        self._running.stop()

    # --- what the device says about itself -----------------------------------------------------

    def _query(self) -> None:
        rs, device, sensor = self._rs, self._profile.get_device(), self._depth_sensor()
        self.name = device_info(rs, device, "name") or "RealSense"
        self.serial = device_info(rs, device, "serial_number")
        self.depth_scale_m = shortest_decimal(sensor.get_depth_scale())
        option = rs.option.stereo_baseline
        known = sensor.supports(option)
        self.baseline_m = shortest_decimal(sensor.get_option(option)) / 1000.0 if known else None
        profiles = {p.stream_type(): p for p in self._profile.get_streams()}
        depth = profiles[rs.stream.depth].as_video_stream_profile()
        self.depth = Intrinsics.from_realsense(depth.get_intrinsics())
        self.color = self.T_color_depth = None
        if rs.stream.color in profiles:
            color = profiles[rs.stream.color].as_video_stream_profile()
            self.color = Intrinsics.from_realsense(color.get_intrinsics())
            extrinsics = depth.get_extrinsics_to(color)
            rotation = np.reshape(extrinsics.rotation, (3, 3), order="F")  # column by column
            self.T_color_depth = make_transform(rotation, extrinsics.translation)

    def __repr__(self) -> str:
        return camera_line(self, f"live, serial {self.serial}", "unknown")

    # --- frames --------------------------------------------------------------------------------

    def stream(self) -> Generator[Frame, None, None]:
        self._check_open()
        last = None
        while True:
            images = self._next_frameset()
            depth, color = images.get_depth_frame(), images.get_color_frame()
            # An image is repeated when the other is late.
            if depth and (moment := (depth.get_frame_number(), depth.get_timestamp())) != last:
                last = moment
                yield self._frame(depth, color, images)

    def _next_frameset(self) -> Any:
        """The next group of images."""
        for _ in range(MOST_POLLS):
            try:
                arrived, images = self._running.poll()
            except RuntimeError as error:
                stopped = f"{self._what} stopped giving frames ({error})"
                raise CameraError(f"{stopped}: {say('cameras.unplugged')}") from error
            need(arrived is not None, "cameras.closed_meanwhile", what=self._what)
            if arrived:
                return images
        silent = f"no frame came from {self._what} for {MOST_POLLS * POLL_MS / 1000:g} s"
        raise CameraError(f"{silent}: {say('cameras.unplugged')}")

    def _frame(self, depth: Any, color: Any, images: Any) -> Frame:
        counts = np.array(depth.get_data(), dtype=np.uint16)
        rgb = np.array(color.get_data()) if color else None
        time_s, number = depth.get_timestamp() / 1000.0, depth.get_frame_number()
        figures = self.depth, self.color, self.T_color_depth
        eyes = [images.get_infrared_frame(eye) for eye in ((1, 2) if self._infrared else ())]
        return Frame(counts, rgb, self.depth_scale_m, time_s, number, *figures, _pixels(eyes))

    def _skip(self, n: int) -> None:
        for _ in itertools.islice(self.stream(), n):
            pass

    # --- placing and settings ------------------------------------------------------------------

    def place(self, name: str, distance_m: float) -> None:
        recording.check_distance(distance_m)
        device = specified(self.name)
        glass_m = device.nominal.glass_m if device else 0.0
        what = ROOM_TEXTS["cameras"]["placing"].get(name, f"Put the {name}")
        distance_mm = 1000 * (distance_m - glass_m)
        where = {"distance_mm": distance_mm, "distance_m": distance_m, "glass_mm": 1000 * glass_m}
        print(say("cameras.place", what=what, **where))
        input("Press Enter when it stands there")
        self._skip(WARM_UP_FRAMES)  # those from before, and until automatic exposure has settled

    def _change(self, asked: dict[str, Any]) -> str:
        said = []
        if "ambient" in asked:
            said.append("the room's light is yours to change: draw the curtains, turn on a lamp")
        if "exposure" in asked:
            said.append("exposure stays: lock() fixes it where automatic exposure has put it")
        if "depth_scale_m" in asked:
            scale_m = recording.check_depth_scale(asked["depth_scale_m"])
            said.append(self._set_depth_scale(scale_m))
        sentence = "; ".join(said or ["nothing to change"])
        return sentence[0].upper() + sentence[1:] + "."

    def _set_depth_scale(self, depth_scale_m: float) -> str:
        """Set the depth unit with the camera stopped, as some firmware wants, and start again."""
        self._check_open()
        option, sensor = self._rs.option.depth_units, self._depth_sensor()
        if not sensor.supports(option) or sensor.is_option_read_only(option):
            return f"depth unit stays {1000 * self.depth_scale_m:g} mm: this camera has no other"
        self.close()
        try:
            sensor.set_option(option, depth_scale_m)
            refused = None
        except RuntimeError as error:
            refused = error
        self._start()
        self._query()
        self._skip(WARM_UP_FRAMES)
        if refused or not np.isclose(self.depth_scale_m, depth_scale_m, rtol=1e-3):
            keeps = say("cameras.keeps_unit", what=self._what, unit_mm=1000 * self.depth_scale_m)
            said = f" (librealsense says: {refused})" if refused else ""
            raise CameraError(keeps + said) from refused
        return f"depth unit set to {1000 * self.depth_scale_m:g} mm"

    # --- exposure ------------------------------------------------------------------------------

    def lock(self) -> str:
        """Switch automatic exposure, gain and white balance off, at the values they have now.

        The colour camera does not report its automatic exposure (librealsense issue 2549), so it
        takes its manual setting. Returns one sentence that says so.
        """
        self._check_open()
        rs, locked = self._rs, []
        try:
            for sensor in self._profile.get_device().query_sensors():
                if sensor.supports(rs.option.enable_auto_exposure):
                    locked.append(self._lock_exposure(sensor))
                if sensor.supports(rs.option.enable_auto_white_balance):
                    sensor.set_option(rs.option.enable_auto_white_balance, 0)
                    locked.append("white balance")
            self._skip(SETTLE_FRAMES)
        except CameraError:
            raise
        except RuntimeError as error:
            raise CameraError(f"{self._what} does not let itself be locked: {error}") from error
        fixed = ", ".join(locked) or "nothing: this camera has no automatic exposure"
        return f"Locked {fixed}; the focus is fixed by the lenses."

    def _lock_exposure(self, sensor: Any) -> str:
        rs, option = self._rs, self._rs.option
        if sensor.is_depth_sensor():
            exposure, gain = self._depth_exposure(sensor)
            name, us_per_count = "depth", 1.0
        else:
            exposure, gain = sensor.get_option(option.exposure), sensor.get_option(option.gain)
            name, us_per_count = "colour (manual setting)", 100.0
        sensor.set_option(rs.option.enable_auto_exposure, 0)
        sensor.set_option(option.exposure, exposure)
        sensor.set_option(option.gain, gain)
        return f"{name} exposure at {exposure * us_per_count / 1000.0:.1f} ms"

    def _depth_exposure(self, sensor: Any) -> tuple[float, float]:
        """Exposure (us) and gain of the newest depth image, which automatic exposure chose."""
        depth = self._next_frameset().get_depth_frame()
        values, option = self._rs.frame_metadata_value, self._rs.option

        def chosen(value: Any, setting: Any) -> float:
            known = depth.supports_frame_metadata(value)
            return depth.get_frame_metadata(value) if known else sensor.get_option(setting)

        exposure_us = chosen(values.actual_exposure, option.exposure)
        return exposure_us, chosen(values.gain_level, option.gain)


class _Running:
    """A pipeline while it runs.

    A thread that is inside librealsense when the interpreter ends, waiting for frames, ends the
    process with an abort. So a camera calls it in turns, and `leave`, at the interpreter's end, has
    the last one.
    """

    def __init__(self) -> None:
        self.turn, self.left = threading.RLock(), False
        self.pipeline: Any = None

    def poll(self) -> tuple[bool | None, Any]:
        """Whether images came within POLL_MS, and these; None twice once it is stopped."""
        with self.turn:
            if self.pipeline is None or self.left:
                return None, None
            arrived, images = self.pipeline.try_wait_for_frames(POLL_MS)
            return arrived, images

    def leave(self) -> None:
        """Stop for good: when Python ends, or nobody holds the camera any more."""
        self.left = True
        self.stop()

    def stop(self) -> None:
        """Stop the pipeline; a second call does nothing."""
        with self.turn:
            pipeline, self.pipeline = self.pipeline, None
            if pipeline is not None:
                with contextlib.suppress(RuntimeError):  # an unplugged camera cannot be stopped
                    pipeline.stop()


# --- images ------------------------------------------------------------------------------------


def _pixels(eyes: list[Any]) -> tuple[Image, Image] | None:
    """Left and right (H, W), None unless both are there."""
    if not eyes or not all(eyes):
        return None
    left, right = (np.array(image.get_data(), dtype=np.uint8) for image in eyes)
    return left, right


def shortest_decimal(value: float) -> float:
    """The shortest decimal number that is the same in float32: 0.001, not 0.0010000000475."""
    return float(str(np.float32(value)))


def specified(name: str) -> specifications.Device | None:
    """The device of data/devices.toml that a camera of this name is, or a variant of, or None.

    >>> specified("Intel RealSense D435i").nominal.baseline_m
    0.05
    """
    devices = (d for d in specifications.device_names() if re.search(rf"\b{d}", name))
    found = next(devices, None)
    return specifications.device(found) if found else None
