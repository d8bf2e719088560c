"""Recordings as files: the one writer of .db3, and the checks before and after librealsense."""

from __future__ import annotations

import contextlib
import os
import re
import sqlite3
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coursekit.cameras.camera import Camera, CameraError, Frame
from coursekit.cameras.librealsense import load_librealsense
from coursekit.geometry import Intrinsics

if TYPE_CHECKING:
    from types import ModuleType

    import numpy as np
    from numpy.typing import NDArray

FILE_STARTS = {".db3": b"SQLite format 3\0", ".bag": b"#ROSBAG V2.0\n"}
FRAMES_PER_S = 30
EYES = ("left", "right")


# --- reading -----------------------------------------------------------------------------------


def check_recording(path: Path) -> None:
    """CameraError with what to do when `path` is no recording, before librealsense opens it."""
    if path.suffix not in FILE_STARTS:
        raise CameraError(
            f"{path} is no recording: its name must end in .db3 or .bag, in lower case"
        )
    if not path.exists():
        raise CameraError(f"there is no file {path}: check the name and the folder")
    if not path.is_file():
        raise CameraError(f"{path} is a folder: name the .db3 or .bag file in it")
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise CameraError(
            f"{path} cannot be read ({error.strerror}): check its permissions"
        ) from error
    if not start:
        raise CameraError(f"{path} is empty: copy it again or record it anew")
    if not start.startswith(FILE_STARTS[path.suffix]):
        raise CameraError(
            f"{path} is not a {path.suffix} recording, though its name says so: "
            "open a file that a RealSense program or camera.record() wrote"
        )


def depth_frame_numbers(path: Path) -> list[int]:
    """The frame numbers of the depth images in a .db3 recording, in the order of playback.

    Raises CameraError when the file is damaged.
    """
    query = (
        "SELECT data FROM messages JOIN topics ON topic_id = topics.id "
        "WHERE name LIKE '%/Depth_0/image/metadata' ORDER BY timestamp"
    )
    with _database(path) as file:
        texts = [re.search(rb"Frame number=(\d+)", data) for (data,) in file.execute(query)]
    return [int(text.group(1)) for text in texts if text]


@contextlib.contextmanager
def _database(path: Path, mode: str = "ro") -> Iterator[sqlite3.Connection]:
    """A .db3 recording as the SQLite database that it is; its errors become CameraErrors."""
    address = f"{path.resolve().as_uri()}?mode={mode}"
    try:
        with contextlib.closing(sqlite3.connect(address, uri=True)) as file, file:
            yield file
    except sqlite3.DatabaseError as error:
        raise CameraError(
            f"the recording {path.name} is damaged or the disk is full ({error}): "
            "free some space, copy the file again or record it anew"
        ) from error


# --- writing -----------------------------------------------------------------------------------


def write_recording(
    path: str | os.PathLike[str],
    camera: Camera,
    frames: Iterator[Frame],
    overwrite: bool = False,
    infrared: bool = False,
) -> Path:
    """Write a camera's frames to a .db3 file as they come, and return its path.

    infrared: whether to write the infrared images too if the first frame has them. The file
    appears under its name when it is complete. When Ctrl-C or the camera ends `frames` early it
    holds those so far: Ctrl-C then prints one line, the CameraError is raised again with the
    file's name. Raises ValueError for a bad path.
    """
    target = _check_target(path, overwrite)
    rs = load_librealsense()
    problem: CameraError | None = None
    interrupted, given = False, 0
    with tempfile.TemporaryDirectory(prefix=".recording-", dir=target.parent) as folder:
        unfinished = Path(folder) / "recording.db3"
        writer: _Writer | None = None
        try:
            for frame in frames:
                if writer is None:  # playback would wait for the images of a stream that has none
                    pair = infrared and frame.infrared is not None
                    writer = _Writer(rs, unfinished, camera, pair)
                given += 1
                writer.add(frame)
        except KeyboardInterrupt:
            interrupted = True
        except CameraError as error:
            problem = error
        finally:
            if writer is not None:
                writer.close()
        if writer is not None:
            _restore_order(unfinished)
        if interrupted or problem:
            given = len(depth_frame_numbers(unfinished)) if given else 0
        if given == 0:
            raise (
                KeyboardInterrupt()
                if interrupted
                else problem
                or CameraError(f"no frame came from the {camera.name}: nothing written")
            )
        _publish(unfinished, target, given)
    if problem:
        raise CameraError(f"{problem} (its {given} frames so far are in {target})") from problem
    if interrupted:
        print(f"Stopped: {target.name} holds the {given} frames so far.")
    return target


def _check_target(path: str | os.PathLike[str], overwrite: bool) -> Path:
    target = Path(path).expanduser()
    if target.suffix != ".db3":
        raise ValueError(f"path: got {str(target)!r}, want a name that ends in .db3")
    if not target.parent.is_dir():
        raise ValueError(f"path: there is no folder {target.parent}: make it first")
    if target.is_dir():
        raise ValueError(f"path: {target} is a folder, want a file name")
    if target.exists() and not overwrite:
        raise ValueError(f"path: {target} exists already: choose another name or overwrite=True")
    return target


def _restore_order(path: Path) -> None:
    """Make the messages' times in the file ascend in the order in which they were written.

    The recorder takes the time spent in a pause off its clock a little late, so a message after a
    pause can carry a later time than the next one: in 2 of 100 recordings frames changed places.
    """
    with _database(path, "rw") as file:
        latest = 0
        query = "SELECT id, timestamp FROM messages WHERE timestamp > 0 ORDER BY id"  # 0: settings
        for key, time_ns in file.execute(query).fetchall():
            if time_ns < latest:
                file.execute("UPDATE messages SET timestamp = ? WHERE id = ?", (latest, key))
            latest = max(latest, time_ns)


def _publish(unfinished: Path, target: Path, given: int) -> None:
    """Give a finished recording its name, once all its frames are found in it."""
    written = len(depth_frame_numbers(unfinished))
    if written < given:  # librealsense does not say when it cannot write
        raise CameraError(
            f"only {written} of {given} frames could be written beside {target}, so nothing was "
            "kept: the disk is probably full; free some space and record again"
        )
    try:
        os.replace(unfinished, target)
    except OSError as error:
        raise CameraError(
            f"the recording could not be named {target} ({error.strerror}): "
            "close the programs and cameras that have it open and record again"
        ) from error


class _Writer:
    """librealsense's recorder, fed frame by frame through a software device."""

    def __init__(self, rs: ModuleType, path: Path, camera: Camera, infrared: bool = False) -> None:
        self._rs = rs
        device = rs.software_device()
        device.register_info(rs.camera_info.name, camera.name)
        device.register_info(rs.camera_info.serial_number, camera.serial)
        depth_sensor = device.add_sensor("Stereo Module")
        depth_sensor.add_read_only_option(rs.option.depth_units, camera.depth_scale_m)
        if camera.baseline_m is not None:
            depth_sensor.add_read_only_option(rs.option.stereo_baseline, 1000 * camera.baseline_m)
        depth = depth_sensor.add_video_stream(
            _video_stream(rs, rs.stream.depth, rs.format.z16, 2, camera.depth)
        )
        self._streams = {"depth": (depth_sensor, depth.as_video_stream_profile())}
        for eye, name in enumerate(EYES if infrared else (), start=1):
            stream = _video_stream(rs, rs.stream.infrared, rs.format.y8, 1, camera.depth)
            stream.index, stream.uid = eye, 1 + eye
            profile = depth_sensor.add_video_stream(stream)
            self._streams[name] = (depth_sensor, profile.as_video_stream_profile())
        if camera.color is not None:
            color_sensor = device.add_sensor("RGB Camera")
            color = color_sensor.add_video_stream(
                _video_stream(rs, rs.stream.color, rs.format.rgb8, 3, camera.color)
            )
            depth.register_extrinsics_to(color, _extrinsics(rs, camera))
            self._streams["color"] = (color_sensor, color.as_video_stream_profile())
        self._recorder = rs.recorder(str(path), device)
        self._sensors = self._recorder.query_sensors()
        self._queue = rs.frame_queue(1)  # the recorder sees only sensors that stream somewhere
        for sensor in self._sensors:
            sensor.open(sensor.get_stream_profiles())
            sensor.start(self._queue)

    def add(self, frame: Frame) -> None:
        # Depth last: a Ctrl-C in between leaves an image over, which playback ignores, and not a
        # depth image with the wrong colour.
        if frame.color is not None:
            self._add("color", frame.color, frame)
        for name, image in zip(EYES, frame.infrared or (), strict=False):
            if name in self._streams:
                self._add(name, image, frame)
        self._add("depth", frame.depth, frame)
        self._recorder.pause()  # waits until all is written: else memory grows with each frame
        self._recorder.resume()

    def _add(self, stream: str, pixels: NDArray[np.generic], frame: Frame) -> None:
        sensor, profile = self._streams[stream]
        image = self._rs.software_video_frame()
        image.pixels = pixels
        image.bpp = pixels.itemsize * (pixels.shape[2] if pixels.ndim == 3 else 1)
        image.stride = image.bpp * pixels.shape[1]
        image.timestamp = 1000.0 * frame.time_s
        image.domain = self._rs.timestamp_domain.hardware_clock
        image.frame_number = frame.number
        image.depth_units = frame.depth_scale_m
        image.profile = profile
        sensor.on_video_frame(image)

    def close(self) -> None:
        """Finish the file, which librealsense does when the recorder and its sensors are gone."""
        for sensor in self._sensors:
            sensor.stop()
            sensor.close()
        del sensor
        del self._sensors, self._recorder, self._streams, self._queue


def _video_stream(rs: ModuleType, kind: Any, form: Any, bpp: int, intrinsics: Intrinsics) -> Any:
    stream = rs.video_stream()
    stream.type, stream.fmt, stream.bpp, stream.fps = kind, form, bpp, FRAMES_PER_S
    stream.index, stream.uid = 0, 0 if kind == rs.stream.depth else 1
    stream.width, stream.height = intrinsics.size
    stream.intrinsics = realsense_intrinsics(rs, intrinsics)
    return stream


def realsense_intrinsics(rs: ModuleType, intrinsics: Intrinsics) -> Any:
    """The `pyrealsense2.intrinsics` of `intrinsics`; `Intrinsics.from_realsense` undoes it."""
    result = rs.intrinsics()
    result.width, result.height = intrinsics.size
    result.fx, result.fy = intrinsics.fx, intrinsics.fy
    result.ppx, result.ppy = intrinsics.cx, intrinsics.cy
    result.model = getattr(rs.distortion, intrinsics.model)
    result.coeffs = list(intrinsics.coeffs)
    return result


def _extrinsics(rs: ModuleType, camera: Camera) -> Any:
    result = rs.extrinsics()
    if camera.T_color_depth is not None:
        result.rotation = camera.T_color_depth[:3, :3].ravel(order="F").tolist()
        result.translation = camera.T_color_depth[:3, 3].tolist()
    return result
