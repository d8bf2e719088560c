"""RealSense cameras on USB and recordings of them: one class, because librealsense plays both."""

from __future__ import annotations

import contextlib
import functools
import itertools
import re
import threading
import weakref
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from coursekit import specifications
from coursekit.arrays import AnyArray, Image
from coursekit.cameras import recording
from coursekit.cameras.camera import Camera, camera_line
from coursekit.cameras.frames import FRAMES_PER_S, CameraError, Frame
from coursekit.cameras.librealsense import device_info, load_librealsense, start_problem
from coursekit.geometry import Intrinsics, make_transform
from coursekit.words import ROOM_TEXTS, say

DEPTH_SIZE, COLOR_SIZE = (848, 480), (640, 480)
WARM_UP_FRAMES = 30  # automatic exposure settles in about a second
SETTLE_FRAMES = 6  # a new exposure shows up to five frames later (librealsense issue 11228)
POLL_MS = 50  # a recording's last wait always runs out, so it is short
# Without a frame in so many waits (5 s) the camera is gone. Waits are counted, because a busy
# computer can let any time pass between two of them.
MOST_POLLS = 100

_live_cameras: weakref.WeakValueDictionary[str, RealSense] = weakref.WeakValueDictionary()


class RealSense(Camera):
    """A RealSense on USB (by serial number) or a recording (by path) in librealsense's hands.

    infrared: whether a live camera is to give both infrared images too; a recording gives them if
    it holds them. Raises LibraryMissing without pyrealsense2, and CameraError for a camera or file
    that does not open. All attributes are what the device or recording reports about itself.
    """

    def __init__(
        self, serial: str | None = None, path: Path | None = None, infrared: bool = False
    ) -> None:
        if (serial is None) == (path is None):
            raise ValueError("serial, path: got both or neither, want exactly one")
        self._rs = load_librealsense()
        self._running = _Running()
        weakref.finalize(self, self._running.leave)
        self._path, self._infrared = path, infrared
        self._what = f"the RealSense {serial}"
        self.source, self.serial, self.can_place = "live", serial or "", path is None
        if path is not None:
            self._what = f"the recording {path.name}"
            self.source = "recorded"
            recording.check_recording(path)
        elif self.serial in _live_cameras:  # the setup cell was run again
            _live_cameras[self.serial].close()
        self._start()
        try:
            self._query()
            if self.source == "live":
                _live_cameras[self.serial] = self
                self._skip(WARM_UP_FRAMES)
        except CameraError:
            self.close()
            raise
        except (RuntimeError, ValueError) as error:
            self.close()
            raise CameraError(f"{self._what} does not describe itself fully: {error}") from error

    # --- opening and closing -------------------------------------------------------------------

    def _start(self) -> None:
        """Start streaming; of a recording from its beginning."""
        with self._running.turn:
            if self._running.left:
                raise CameraError(say("cameras.closed_meanwhile", what=self._what))
            try:
                pipeline = self._rs.pipeline()
                config = self._playback_config(pipeline) if self._path else self._live_config()
                self._profile = pipeline.start(config)
                playback = self._profile.get_device().as_playback() if self._path else None
            except CameraError:
                raise
            except RuntimeError as error:
                if self._path is None:
                    raise CameraError(start_problem(self._what, error)) from error
                reason = str(error).rsplit("Reason: ", maxsplit=1)[-1]
                raise CameraError(
                    say("cameras.not_read", what=self._what, reason=reason)
                ) from error
            self._running.run(pipeline, playback)

    def _live_config(self) -> Any:
        rs, config = self._rs, self._rs.config()
        config.enable_device(self.serial)
        config.enable_stream(rs.stream.depth, *DEPTH_SIZE, rs.format.z16, FRAMES_PER_S)
        config.enable_stream(rs.stream.color, *COLOR_SIZE, rs.format.rgb8, FRAMES_PER_S)
        for eye in (1, 2) if self._infrared else ():
            config.enable_stream(rs.stream.infrared, eye, *DEPTH_SIZE, rs.format.y8, FRAMES_PER_S)
        return config

    def _playback_config(self, pipeline: Any) -> Any:
        """Depth, colour and the infrared pair of the file, as fast as they are asked for."""
        rs, wrapper = self._rs, self._rs.pipeline_wrapper(pipeline)

        def from_file() -> Any:
            config = rs.config()
            config.enable_device_from_file(str(self._path), repeat_playback=False)
            return config

        everything = from_file().resolve(wrapper)
        profiles = everything.get_streams()
        streams = {profile.stream_type() for profile in profiles}
        if rs.stream.depth not in streams:
            raise CameraError(f"{self._what} holds no depth images: record depth and colour")
        config = from_file()
        for stream in streams & {rs.stream.depth, rs.stream.color}:
            config.enable_stream(stream)
        self._infrared = self._has_pair(profiles)
        for eye in (1, 2) if self._infrared else ():
            config.enable_stream(rs.stream.infrared, eye)
        # Both before the start, or images are lost: at the recorded pace those that are not fetched
        # in time, and the first ones while the sensors are started one after the other.
        playback = config.resolve(wrapper).get_device().as_playback()
        playback.set_real_time(False)
        playback.pause()
        return config

    def _has_pair(self, profiles: Any) -> bool:
        """Whether there are a left and a right infrared stream of grey pixels."""
        rs = self._rs
        grey = (p for p in profiles if p.format() == rs.format.y8)
        return {p.stream_index() for p in grey if p.stream_type() == rs.stream.infrared} >= {1, 2}

    def _check_open(self) -> None:
        if not self._running:
            raise CameraError(say("cameras.closed", what=self._what))

    def _depth_sensor(self) -> Any:
        return self._profile.get_device().first_depth_sensor()

    def close(self) -> None:
        """Stop the camera, or close the file; a second call does nothing."""
        self._running.stop()

    # --- what the device says about itself -----------------------------------------------------

    def _query(self) -> None:
        rs, device, sensor = self._rs, self._profile.get_device(), self._depth_sensor()
        self.name = device_info(rs, device, "name") or "RealSense"
        self.serial = device_info(rs, device, "serial_number")
        self.depth_scale_m = shortest_decimal(sensor.get_depth_scale())
        self.baseline_m = None
        if sensor.supports(rs.option.stereo_baseline):
            self.baseline_m = (
                shortest_decimal(sensor.get_option(rs.option.stereo_baseline)) / 1000.0
            )
        profiles = {p.stream_type(): p for p in self._profile.get_streams()}
        depth = profiles[rs.stream.depth].as_video_stream_profile()
        self.depth = Intrinsics.from_realsense(depth.get_intrinsics())
        self.color = self.T_color_depth = self._to_rgb = None
        if rs.stream.color in profiles:
            color = profiles[rs.stream.color].as_video_stream_profile()
            self.color = Intrinsics.from_realsense(color.get_intrinsics())
            self._to_rgb = _rgb_converter(str(color.format()).rsplit(".", 1)[-1])
            extrinsics = depth.get_extrinsics_to(color)
            rotation = np.reshape(extrinsics.rotation, (3, 3), order="F")  # column by column
            self.T_color_depth = make_transform(rotation, extrinsics.translation)

    def __repr__(self) -> str:
        where = f"recording {self._path.name}" if self._path else f"live, serial {self.serial}"
        return camera_line(self, where, "unknown")

    # --- frames --------------------------------------------------------------------------------

    def stream(self) -> Generator[Frame, None, None]:
        self._check_open()
        if self._path is not None:
            self.close()
            self._start()
        # A playback gives each depth image with the colour image before it and the one after it;
        # a live camera gives matching images, and repeats one when the other is late.
        choose = functools.partial(min, key=_time_apart) if self._path else next
        frame = None
        for _, groups in itertools.groupby(self._groups(), key=_identity):
            frame = self._frame(choose(groups))
            yield frame
        self._check_end(frame)

    def _groups(self) -> Iterator[_Group]:
        """The images as librealsense groups them, until a recording ends."""
        while (frameset := self._next_frameset()) is not None:
            depth, color = frameset.get_depth_frame(), frameset.get_color_frame()
            eyes = (1, 2) if self._infrared else ()
            if depth:
                infrared = tuple(frameset.get_infrared_frame(eye) or None for eye in eyes)
                yield _Group(depth, color or None, infrared)

    def _check_end(self, last: Frame | None) -> None:
        """CameraError unless a playback that ended has given all depth images of its file.

        librealsense ends it silently at the first message that it cannot decode.
        """
        if self._path is not None and self._path.suffix == ".db3":
            numbers = recording.depth_frame_numbers(self._path)
            lost = len(numbers)
            if last is not None and last.number in numbers:
                lost = numbers[::-1].index(last.number)
            if lost:
                raise CameraError(say("cameras.damaged_end", what=self._what, lost=lost))
        if last is None:
            raise CameraError(f"{self._what} holds no frames: record it anew")

    def _next_frameset(self) -> Any:
        """The next group of images; None once a recording has ended."""
        ended = False
        for _ in range(MOST_POLLS):
            try:
                arrived, frameset, status = self._running.poll()
            except RuntimeError as error:
                stopped = (
                    f"{self._what} stopped giving frames ({error}): {say('cameras.unplugged')}"
                )
                raise CameraError(stopped) from error
            if arrived is None:
                raise CameraError(say("cameras.closed_meanwhile", what=self._what))
            if arrived:
                return frameset
            if ended:
                return None
            ended = status is not None and status == self._rs.playback_status.stopped
        silence_s = MOST_POLLS * POLL_MS / 1000
        raise CameraError(
            f"no frame came from {self._what} for {silence_s:g} s: {say('cameras.unplugged')}"
        )

    def _frame(self, group: _Group) -> Frame:
        depth, color, infrared = group
        counts = np.array(depth.get_data(), dtype=np.uint16)
        rgb = self._to_rgb(np.asarray(color.get_data())) if color and self._to_rgb else None
        time_s, number = depth.get_timestamp() / 1000.0, depth.get_frame_number()
        figures = self.depth, self.color, self.T_color_depth
        return Frame(counts, rgb, self.depth_scale_m, time_s, number, *figures, _pixels(infrared))

    def _skip(self, n: int) -> None:
        for _ in itertools.islice(self.stream(), n):
            pass

    # --- placing and settings ------------------------------------------------------------------

    def place(self, name: str, distance_m: float) -> None:
        if self._path is not None:
            super().place(name, distance_m)
            return
        recording.check_distance(distance_m)
        device = specified(self.name)
        glass_m = device.nominal.glass_m if device else 0.0
        what, distance_mm = (
            ROOM_TEXTS["cameras"]["placing"].get(name, f"Put the {name}"),
            1000 * (distance_m - glass_m),
        )
        where = {"distance_mm": distance_mm, "distance_m": distance_m, "glass_mm": 1000 * glass_m}
        print(say("cameras.place", what=what, **where))
        input("Press Enter when it stands there")
        self._skip(WARM_UP_FRAMES)  # those from before, and until automatic exposure has settled

    def _change(self, asked: dict[str, Any]) -> str:
        if self._path is not None:
            return super()._change(asked)
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
            raise CameraError(
                keeps + (f" (librealsense says: {refused})" if refused else "")
            ) from refused
        return f"depth unit set to {1000 * self.depth_scale_m:g} mm"

    # --- exposure ------------------------------------------------------------------------------

    def lock(self) -> str:
        """Switch automatic exposure, gain and white balance off, at the values they have now.

        The colour camera does not report its automatic exposure (librealsense issue 2549), so it
        takes its manual setting. A recording is left as it is. Returns one sentence that says so.
        """
        if self._path is not None:
            return say("cameras.as_recorded")
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
        depth = next(self._groups()).depth

        def chosen(value: Any, setting: Any) -> float:
            known = depth.supports_frame_metadata(value)
            return depth.get_frame_metadata(value) if known else sensor.get_option(setting)

        values, option = self._rs.frame_metadata_value, self._rs.option
        return (
            chosen(values.actual_exposure, option.exposure),
            chosen(values.gain_level, option.gain),
        )


class _Running:
    """A pipeline while it runs, and for a recording the thread that wakes its playback and, at the
    end, brings it to rest.

    A thread that is inside librealsense when the interpreter ends, in resume() or waiting for
    frames, ends the process with an abort. So a camera calls it in turns, and `leave`, at the
    interpreter's end, has the last one. True while there is a pipeline.
    """

    def __init__(self) -> None:
        self.turn, self.left = threading.RLock(), False
        self._pipeline: Any = None
        self._playback: Any = None
        self._attendant: threading.Thread | None = None
        self._ending = threading.Event()

    def __bool__(self) -> bool:
        return self._pipeline is not None

    def run(self, pipeline: Any, playback: Any) -> None:
        """Take a started pipeline; playback: of one that was started paused, else None."""
        self._pipeline, self._playback = pipeline, playback
        self._attendant, self._ending = None, threading.Event()
        if playback is not None:
            attend = functools.partial(_attend, playback, self._ending)
            self._attendant = threading.Thread(target=attend, daemon=True)
            self._attendant.start()

    def poll(self) -> tuple[bool | None, Any, Any]:
        """Whether images came within POLL_MS, these, and a playback's status when none came.

        All None once it is stopped.
        """
        with self.turn:
            if self._pipeline is None or self.left:
                return None, None, None
            arrived, images = self._pipeline.try_wait_for_frames(POLL_MS)
            ask = self._playback is not None and not arrived
            return arrived, images, self._playback.current_status() if ask else None

    def leave(self) -> None:
        """Stop for good: when Python ends, or nobody holds the camera any more."""
        self.left = True
        self.stop()

    def stop(self) -> None:
        """Bring everything to rest: a thread that polls, the playback, the pipeline.

        At the end of its file a playback's reading thread stops the sensors itself; when the
        pipeline stops them at the same moment, librealsense frees its callbacks twice and may end
        the process (its issue 9446). So that thread has to rest first, which pause() waits for; and
        it comes to rest only while somebody takes its images.
        """
        with self.turn:
            pipeline, self._pipeline, self._playback = self._pipeline, None, None
            if pipeline is None:
                return
            self._ending.set()
            attendant = self._attendant
            if attendant is threading.current_thread():  # where Python collects a forgotten camera
                attendant = None
            with contextlib.suppress(RuntimeError):  # an unplugged camera cannot be stopped
                try:
                    while attendant and attendant.is_alive():  # at most librealsense's own 10 s
                        pipeline.try_wait_for_frames(1)
                finally:
                    pipeline.stop()


def _attend(playback: Any, ending: threading.Event) -> None:
    """Wake a paused playback, and pause it again when it is to end.

    One thread does both, so that they come in this order: resume() returns only when the reading
    thread has come so far.
    """
    playback.resume()
    ending.wait()
    playback.pause()


# --- images ------------------------------------------------------------------------------------


class _Group(NamedTuple):
    """librealsense's images of one moment; infrared: none, or left and right, None if missing."""

    depth: Any
    color: Any
    infrared: tuple[Any, ...]


def _identity(group: _Group) -> tuple[int, float]:
    return group.depth.get_frame_number(), group.depth.get_timestamp()


def _time_apart(group: _Group) -> float:
    """How far the images are apart in all, ms; infinitely far without one of them."""
    others = group.color, *group.infrared
    moment = group.depth.get_timestamp()
    return sum(abs(moment - image.get_timestamp()) if image else np.inf for image in others)


def _pixels(infrared: tuple[Any, ...]) -> tuple[Image, Image] | None:
    """Left and right (H, W), None unless both are there."""
    if not infrared or not all(infrared):
        return None
    left, right = (np.array(image.get_data(), dtype=np.uint8) for image in infrared)
    return left, right


def _rgb_converter(form: str) -> Callable[[AnyArray], Image]:
    """The function that makes (h, w, 3) RGB of a colour image in librealsense's format `form`."""
    slices: dict[str, Any] = {"rgb8": np.s_[..., :3], "rgba8": np.s_[..., :3]}
    slices |= {"bgr8": np.s_[..., ::-1], "bgra8": np.s_[..., 2::-1]}
    if form in slices:
        return lambda image: image[slices[form]].copy()
    if form in ("yuyv", "uyvy"):
        import cv2

        code = cv2.COLOR_YUV2RGB_YUYV if form == "yuyv" else cv2.COLOR_YUV2RGB_UYVY
        return lambda image: cv2.cvtColor(_two_bytes_a_pixel(image), code)  # type: ignore[return-value]
    raise ValueError(f"colour is stored as {form}, want {', '.join(slices)}, yuyv or uyvy")


def _two_bytes_a_pixel(image: AnyArray) -> Image:
    return np.ascontiguousarray(image).view(np.uint8).reshape(*image.shape[:2], 2)


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
