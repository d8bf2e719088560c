"""Recordings as files, one at a time and in sets: the checks before one is played, the only
writer of .db3, and the index of a folder with one recording for each scene that was placed.
"""

from __future__ import annotations

import contextlib
import os
import re
import sqlite3
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from coursekit import checks, results
from coursekit.arrays import AnyArray
from coursekit.cameras.frames import FRAMES_PER_S, CameraError, Description, Frame, need
from coursekit.cameras.librealsense import load_librealsense
from coursekit.geometry import Intrinsics
from coursekit.words import say

FILE_STARTS = {".db3": b"SQLite format 3\0", ".bag": b"#ROSBAG V2.0\n", ".mcap": b"\x89MCAP0\r\n"}
EYES = ("left", "right")
STREAMS = {  # by our name: librealsense's kind and format, bytes a pixel, index and id
    "depth": ("depth", "z16", 2, 0, 0),
    "color": ("color", "rgb8", 3, 0, 1),
    "left": ("infrared", "y8", 1, 1, 2),
    "right": ("infrared", "y8", 1, 2, 3),
}
INDEX, INTRINSICS = "index.json", "intrinsics.json"
SAME_PLACE_M = 0.0005  # distances closer than this are one place


# --- reading -----------------------------------------------------------------------------------


def check_recording(path: Path) -> None:
    """CameraError with what to do when `path` is no recording."""
    need(path.suffix in FILE_STARTS, "cameras.no_recording", path=path)
    need(path.exists(), "cameras.no_file", path=path)
    need(path.is_file(), "cameras.no_plain_file", path=path)
    try:
        with path.open("rb") as file:
            start = file.read(16)
    except OSError as error:
        raise CameraError(say("cameras.not_read", path=path, error=error.strerror)) from error
    need(start, "cameras.empty_file", path=path)
    same = start.startswith(FILE_STARTS[path.suffix])
    need(same, "cameras.other_file", path=path, suffix=path.suffix)


def without_depth(path: Path, topics: Sequence[str]) -> CameraError:
    """What is wrong with a recording of ROS topics that hold no depth images."""
    nearest = sorted(topics, key=lambda topic: ("depth" not in topic, "info" in topic, topic))
    return CameraError(say("cameras.without_depth", path=path, shown="".join(nearest[:1])))


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
        raise CameraError(say("cameras.damaged_or_full", name=path.name, error=error)) from error


# --- writing -----------------------------------------------------------------------------------


def write_recording(
    path: str | os.PathLike[str],
    camera: Description,
    frames: Iterator[Frame],
    overwrite: bool = False,
    infrared: bool = False,
) -> Path:
    """Write a camera's frames to a .db3 file as they come, and return its path.

    infrared: whether to write the infrared images too if the first frame has them. The file
    appears under its name when it is complete. When Ctrl-C or the camera ends `frames` early it
    holds those so far: Ctrl-C then prints one line, the CameraError is raised again with the
    file's name. Raises ValueError for a bad path, and CameraError when the disk is full.
    """
    target = _check_target(path, overwrite)
    rs = load_librealsense()
    stopped: KeyboardInterrupt | CameraError | None = None
    given, writer = 0, None
    with tempfile.TemporaryDirectory(prefix=".recording-", dir=target.parent) as folder:
        unfinished = Path(folder) / "recording.db3"
        try:
            for frame in frames:
                if writer is None:  # playback would wait for the images of a stream that has none
                    pair = infrared and frame.infrared is not None
                    writer = Writer(rs, unfinished, camera, pair)
                given += 1
                writer.add(frame)
        except (KeyboardInterrupt, CameraError) as error:
            stopped = error
        finally:
            if writer is not None:
                writer.close()
        if writer is not None:
            restore_order(unfinished)
            if stopped:
                given = len(depth_frame_numbers(unfinished))
        if given == 0:
            raise stopped or CameraError(f"no frame came from the {camera.name}: nothing written")
        _publish(unfinished, target, given)
    if isinstance(stopped, CameraError):
        raise CameraError(f"{stopped} (its {given} frames so far are in {target})") from stopped
    if stopped:
        print(f"Stopped: {target.name} holds the {given} frames so far.")
    return target


def _check_target(path: str | os.PathLike[str], overwrite: bool) -> Path:
    target = Path(path).expanduser()
    checks.want(target.suffix == ".db3", "path", str(target), "a name that ends in .db3")
    place = target.parent
    checks.refuse(not place.is_dir(), f"path: there is no folder {place}: make it first")
    checks.refuse(target.is_dir(), f"path: {target} is a folder, want a file name")
    if target.exists() and not overwrite:
        raise ValueError(f"path: {target} exists already: choose another name or overwrite=True")
    return target


def restore_order(path: Path) -> None:
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
    # librealsense does not say when it cannot write
    need(written >= given, "cameras.not_written", written=written, given=given, target=target)
    try:
        os.replace(unfinished, target)
    except OSError as error:
        raise CameraError(say("cameras.not_named", target=target, error=error.strerror)) from error


class Writer:
    """librealsense's recorder, fed frame by frame through a software device.

    infrared: whether it writes the two infrared images of each frame. The file is complete, but for
    `restore_order`, once it is closed.
    """

    def __init__(
        self, rs: ModuleType, path: Path, camera: Description, infrared: bool = False
    ) -> None:
        self._rs = rs
        self._streams: dict[str, tuple[Any, Any]] = {}  # sensor and profile by name
        device = rs.software_device()
        device.register_info(rs.camera_info.name, camera.name)
        device.register_info(rs.camera_info.serial_number, camera.serial)
        sensor = device.add_sensor("Stereo Module")
        sensor.add_read_only_option(rs.option.depth_units, camera.depth_scale_m)
        if camera.baseline_m is not None:
            sensor.add_read_only_option(rs.option.stereo_baseline, 1000 * camera.baseline_m)
        depth = self._add_stream("depth", sensor, camera.depth)
        for name in EYES if infrared else ():
            self._add_stream(name, sensor, camera.depth)
        if camera.color is not None:
            color = self._add_stream("color", device.add_sensor("RGB Camera"), camera.color)
            if camera.T_color_depth is not None:
                extrinsics = rs.extrinsics()
                extrinsics.rotation = camera.T_color_depth[:3, :3].ravel(order="F").tolist()
                extrinsics.translation = camera.T_color_depth[:3, 3].tolist()
                depth.register_extrinsics_to(color, extrinsics)
        self._recorder = rs.recorder(str(path), device)
        self._sensors = self._recorder.query_sensors()
        self._queue = rs.frame_queue(1)  # the recorder sees only sensors that stream somewhere
        for sensor in self._sensors:
            sensor.open(sensor.get_stream_profiles())
            sensor.start(self._queue)

    def _add_stream(self, name: str, sensor: Any, intrinsics: Intrinsics) -> Any:
        """Give a sensor the stream that frames have images for under this name of STREAMS."""
        kind, form, bpp, index, uid = STREAMS[name]
        stream = self._rs.video_stream()
        stream.type, stream.fmt = getattr(self._rs.stream, kind), getattr(self._rs.format, form)
        stream.bpp, stream.index, stream.uid, stream.fps = bpp, index, uid, FRAMES_PER_S
        stream.width, stream.height = intrinsics.size
        stream.intrinsics = realsense_intrinsics(self._rs, intrinsics)
        profile = sensor.add_video_stream(stream)
        self._streams[name] = (sensor, profile.as_video_stream_profile())
        return profile

    def add(self, frame: Frame) -> None:
        """Write the images of a frame; returns once they are written."""
        # Depth last: a Ctrl-C in between leaves an image over, which playback ignores, and not a
        # depth image with the wrong colour.
        if frame.color is not None:
            self.add_image("color", frame.color, frame)
        for name, image in zip(EYES, frame.infrared or (), strict=False):
            if name in self._streams:
                self.add_image(name, image, frame)
        self.add_image("depth", frame.depth, frame)
        self._recorder.pause()  # waits until all is written: else memory grows with each frame
        self._recorder.resume()

    def add_image(self, stream: str, pixels: AnyArray, frame: Frame) -> None:
        """Write one image of a frame to the stream of this name."""
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


def realsense_intrinsics(rs: ModuleType, intrinsics: Intrinsics) -> Any:
    """The `pyrealsense2.intrinsics` of `intrinsics`; `Intrinsics.from_realsense` undoes it."""
    result = rs.intrinsics()
    result.width, result.height = intrinsics.size
    result.fx, result.fy = intrinsics.fx, intrinsics.fy
    result.ppx, result.ppy = intrinsics.cx, intrinsics.cy
    result.model = getattr(rs.distortion, intrinsics.model)
    result.coeffs = list(intrinsics.coeffs)
    return result


# --- sets --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class RecordedScene:
    """One recording of a set: what stood how far away, m, and the file in the set's folder."""

    name: str
    distance_m: float
    file: str

    def is_at(self, name: str, distance_m: float) -> bool:
        """Whether this is the thing called `name` at this distance, to half a millimetre."""
        return self.name == name and abs(self.distance_m - distance_m) < SAME_PLACE_M

    def __str__(self) -> str:
        return f"{self.name} at {self.distance_m:.3f} m"


class Index:
    """Which scenes a set of recordings holds: what stands in the index.json of its folder."""

    def __init__(self, folder: Path, scenes: Sequence[RecordedScene]) -> None:
        self.folder, self.scenes = folder, list(scenes)

    @classmethod
    def read(cls, folder: Path) -> Index:
        """The index of a set; CameraError for a folder without one, and for a damaged one."""
        path = folder / INDEX
        need(path.exists(), "cameras.no_index", folder=folder, intrinsics=INTRINSICS)
        try:
            scenes = [RecordedScene(**entry) for entry in results.read_json(path)["scenes"]]
            for scene in scenes:
                check_distance(scene.distance_m)
                in_folder = Path(scene.file).name == scene.file
                checks.want(in_folder, "file", scene.file, "a name in the set's own folder")
            checks.refuse(not scenes, "it lists no scenes")
        except (KeyError, TypeError, ValueError) as error:
            raise CameraError(f"{path} is damaged ({error}): record the set anew") from error
        return cls(folder, scenes)

    @classmethod
    def to_extend(
        cls, folder: Path, name: str, distances_m: Sequence[float], overwrite: bool
    ) -> Index:
        """The index of a folder, made if need be, that is to hold `name` at these distances, m.

        Raises ValueError for a bad distance, for a folder that cannot be made, and for a set that
        holds one of these scenes already unless `overwrite`.
        """
        for distance_m in distances_m:
            check_distance(distance_m)
        index = cls.read(folder) if (folder / INDEX).exists() else cls(folder, [])
        held = [scene for scene in index.scenes if any(scene.is_at(name, d) for d in distances_m)]
        if held and not overwrite:
            raise ValueError(say("cameras.held_already", folder=folder, held=cls(folder, held)))
        try:
            folder.mkdir(exist_ok=True)
        except OSError as error:
            raise ValueError(f"folder: {folder} cannot be made ({error.strerror})") from error
        return index

    def add(self, scene: RecordedScene) -> None:
        """Write the index with one more scene, in place of an older one at the same place."""
        others = [old for old in self.scenes if not old.is_at(scene.name, scene.distance_m)]
        self.scenes = [*others, scene]
        content = {"scenes": [asdict(scene) for scene in self.scenes]}
        results.write_json(self.folder / INDEX, content)

    def __str__(self) -> str:
        """What the set holds: "60 mm block at 0.300, 0.450 m; wall at 1.000 m"."""
        places: dict[str, list[float]] = {}
        for scene in self.scenes:
            places.setdefault(scene.name, []).append(scene.distance_m)
        texts = (f"{k} at {', '.join(f'{d:.3f}' for d in sorted(v))} m" for k, v in places.items())
        return "; ".join(texts)


def scene_to_record(name: str, distance_m: float) -> RecordedScene:
    """A scene, and a file name for it that every system takes: "60-mm-block_0.450m.db3"."""
    slug = re.sub("[^A-Za-z0-9]+", "-", name).strip("-")
    return RecordedScene(name, float(distance_m), f"{slug}_{distance_m:.3f}m.db3")


def check_distance(distance_m: object) -> None:
    """ValueError unless `distance_m` is a positive, finite number."""
    checks.positive("distance_m", distance_m, "a positive number of metres")


def check_depth_scale(depth_scale_m: object) -> float:
    """Metres per depth count; ValueError for a number that no D4xx takes."""
    wanted = "metres per count from 0.000001 to 0.01"
    return checks.number("depth_scale_m", depth_scale_m, wanted, least=1e-6, most=0.01)
