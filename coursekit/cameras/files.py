"""Cameras that are files: recordings, sets of them, ROS messages, and folders of depth images."""

from __future__ import annotations

import contextlib
import os
import re
import tempfile
from collections.abc import Collection, Generator, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit import checks, results
from coursekit.arrays import AnyArray, Floats, NDArray
from coursekit.boards.detector import natural
from coursekit.cameras import recording
from coursekit.cameras.camera import Camera, camera_line
from coursekit.cameras.frames import FRAMES_PER_S, NO_DEPTH, CameraError, Description, Frame, need
from coursekit.cameras.realsense import shortest_decimal
from coursekit.geometry import Intrinsics, invert_transform, make_transform
from coursekit.words import counted, say

DEPTH_KINDS = ("16UC1", "mono16", "32FC1")  # ROS's names of what a depth image holds
FINE_M = 0.0001  # a count of depth that was recorded as metres
STREAM = {  # by our name what is in the name of its topic
    "color": r"colou?r|rgb",
    "left": r"infra(red)?_?1|infra_?left|left_ir",
    "right": r"infra(red)?_?2|infra_?right|right_ir",
}
FACT = re.compile(r"/device_0/info$|(Units|Baseline)/value$|/tf/\d+$|/tf_static$|camera_info$")
MOST_WAITING = 60  # depth images that wait for the colour image after them, where none comes


def play(path: Path) -> Camera:
    """A recording, read by `RosBag`; CameraError for a file that is none."""
    recording.check_recording(path)
    return RosBag(path)


@contextlib.contextmanager
def _plainly_named(path: Path) -> Iterator[Path]:
    """The path, or a link to it where rosbags would misread its name as more of an address."""
    if not set("?#%") & set(os.fspath(path)):
        yield path
        return
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / f"recording{path.suffix}"
        link.symlink_to(path.resolve())
        yield link


@cache
def _ros_types() -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores.ROS2_HUMBLE)


# --- messages -------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Shot:
    """One image of a recording, not decoded yet."""

    message: Any
    time_s: float
    number: int


class RosBag(Camera):
    """The messages of a recording, read by rosbags, which is pure Python: what librealsense
    recorded, or a ROS driver of any depth camera.

    Depth comes from images of 16UC1 (mm, or as librealsense says) or 32FC1 (m; counts are 0.1 mm
    then) with `depth` in their topic and a camera_info beside it; colour and the infrared pair
    likewise; T_color_depth and the baseline where the recording holds them. Raises CameraError for
    a recording without depth, and for one that is damaged.
    """

    def __init__(self, path: Path) -> None:
        self._path, self._what, self._closed = path, f"the recording {path.name}", False
        self.source, self.serial, self.name = "recorded", "", "Depth camera"
        self.depth_scale_m, self.baseline_m, self.T_color_depth = 0.001, None, None
        with self._reader() as reader:
            self._describe(reader)

    def __repr__(self) -> str:
        return camera_line(self, f"recording {self._path.name}", "unknown")

    @contextlib.contextmanager
    def _reader(self) -> Iterator[Any]:
        from rosbags.highlevel import AnyReader

        try:
            with (
                _plainly_named(self._path) as path,
                AnyReader([path], default_typestore=_ros_types()) as reader,
            ):
                yield reader
        except CameraError:
            raise
        except Exception as error:  # of damaged bytes rosbags, SQLite and zstd raise what they like
            raise CameraError(say("cameras.damaged", what=self._what, error=error)) from error

    def _messages(self, reader: Any, topics: Collection[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time (ns) and message, in the order of their times."""
        wanted = [c for c in reader.connections if c.topic in topics]
        for connection, time_ns, raw in reader.messages(connections=wanted) if wanted else ():
            yield connection.topic, time_ns, reader.deserialize(raw, connection.msgtype)

    def _describe(self, reader: Any) -> None:
        """What the recording says of its camera in the messages that come once."""
        facts = _Facts(self._messages(reader, {t for t in reader.topics if FACT.search(t)}))
        found = _image_streams(reader.connections)
        topics = {name: topic for name, topic in found.items() if facts.info(topic)}
        if "depth" not in topics:
            raise recording.without_depth(self._path, sorted(reader.topics))
        self._names = {topic: name for name, topic in topics.items()}
        self._numbers = {t for t in reader.topics if t.endswith("/image/metadata")}
        said = facts.said
        self.name, self.serial = said.get("Name", self.name), said.get("Serial Number", "")
        self.depth = facts.lens(topics["depth"])
        self.color = facts.lens(topics["color"]) if "color" in topics else None
        if self.color:
            self.T_color_depth = facts.between(topics["color"], topics["depth"])
        self.baseline_m = facts.baseline_m(topics.get("right"))
        first = next(self._messages(reader, {topics["depth"]}), None)
        if first is None:
            raise recording.without_depth(self._path, sorted(reader.topics))
        kind = getattr(first[2], "encoding", "16UC1")
        if kind not in DEPTH_KINDS:  # a picture of depth, for people to look at
            raise recording.without_depth(self._path, [f"{topics['depth']}, {kind},"])
        metres = kind == "32FC1"
        self.depth_scale_m = FINE_M if metres else facts.depth_scale_m()

    # --- frames --------------------------------------------------------------------------------

    def stream(self) -> Generator[Frame, None, None]:
        others: dict[str, list[_Shot]] = {name: [] for name in self._names.values()}
        waiting = others.pop("depth")
        with self._reader() as reader:
            for name, shot in self._shots(reader):
                need(not self._closed, "cameras.closed", what=self._what)
                (waiting if name == "depth" else others[name]).append(shot)
                while waiting and (len(waiting) > MOST_WAITING or _passed(waiting[0], others)):
                    yield self._frame(waiting.pop(0), others)
            for shot in waiting:
                yield self._frame(shot, others)

    def _shots(self, reader: Any) -> Iterator[tuple[str, _Shot]]:
        """The images of all streams in the order of their times, each with its stream's name."""
        numbered: dict[str, list[dict[str, str]]] = {}  # librealsense's own numbers and times
        for topic, _, message in self._messages(reader, self._numbers):
            if {"Frame number", "timestamp"} <= (pairs := _pairs(message)).keys():
                numbered.setdefault(topic.partition("/image")[0], []).append(pairs)
        counts = dict.fromkeys(self._names.values(), 0)
        for topic, _, message in self._messages(reader, self._names.keys()):
            name, stamp = self._names[topic], message.header.stamp
            ours = numbered.get(topic.partition("/image")[0], [])
            counts[name] += 1
            number, time_s = counts[name], stamp.sec + 1e-9 * stamp.nanosec
            if number <= len(ours):
                said = ours[number - 1]
                number, time_s = int(said["Frame number"]), float(said["timestamp"]) / 1000.0
            elif topic.startswith("/device_"):
                number = message.header.seq
            yield name, _Shot(message, time_s, number)

    def _frame(self, shot: _Shot, others: dict[str, list[_Shot]]) -> Frame:
        """The depth image with those of the other streams that are nearest in time."""
        images = {}
        for name, shots in others.items():
            if shots:
                nearest = min(shots, key=lambda other: abs(other.time_s - shot.time_s))
                del shots[: shots.index(nearest)]
                images[name] = _pixels(nearest.message, "rgb8" if name == "color" else "mono8")
        depth = _counts(_pixels(shot.message))
        if depth.shape != self.depth.size[::-1]:
            raise ValueError(f"a depth image of {depth.shape}, camera_info says {self.depth.size}")
        eyes = (images["left"], images["right"]) if {"left", "right"} <= images.keys() else None
        facts = shot.time_s, shot.number, self.depth, self.color, self.T_color_depth
        return Frame(depth, images.get("color"), self.depth_scale_m, *facts, eyes)

    def lock(self) -> str:
        return say("cameras.as_recorded")

    def close(self) -> None:
        self._closed = True  # the file is open only while frames are read


class _Facts:
    """What the messages of a recording say that come once: said by librealsense of its device, by
    topic (the first), and by frame (of /tf_static).
    """

    def __init__(self, messages: Iterator[tuple[str, int, Any]]) -> None:
        self.said: dict[str, str] = {}
        self._first: dict[str, Any] = {}
        self._frames: dict[str, Any] = {}
        for topic, _, message in messages:
            if topic.endswith("/tf_static"):
                self._frames |= {t.child_frame_id: t for t in message.transforms}
            elif topic.endswith("/device_0/info"):
                self.said |= _pairs(message)
            else:
                self._first.setdefault(topic, message)

    def _beside(self, topic: str, field: str) -> Any:
        """The first message beside an image's topic that has this field, or None."""
        base = topic.partition("/image")[0] if "/image" in topic else topic.rpartition("/")[0]
        near = (m for other, m in self._first.items() if other.startswith(f"{base}/"))
        return next((m for m in near if hasattr(m, field)), None)

    def info(self, topic: str) -> Any:
        """The CameraInfo beside an image's topic, or None."""
        return self._beside(topic, "distortion_model")

    def lens(self, topic: str) -> Intrinsics:
        """Of the stream with this topic; ValueError for a model that the course does not have."""
        info, said = self.info(topic), self._beside(topic, "data")
        named = _pairs(said).get("model", info.distortion_model) if said else info.distortion_model
        K, d = _matrix(info, "k"), _matrix(info, "d")
        model = named.lower().replace(" ", "_") or "none"
        size = info.width, info.height
        return Intrinsics(*size, K[0], K[4], K[2], K[5], model, tuple(d) or (0.0,) * 5)

    def baseline_m(self, right: str | None) -> float | None:
        """As librealsense says, else from the right eye's projection matrix, P[0, 3] = -fx B."""
        told = self._value("Baseline/value")
        if told is not None:
            return shortest_decimal(told) / 1000.0
        P = _matrix(self.info(right), "p") if right else None
        return -P[3] / P[0] if P and P[0] and P[3] else None

    def depth_scale_m(self) -> float:
        """As librealsense says, else ROS's millimetre."""
        told = self._value("Units/value")
        return 0.001 if told is None else shortest_decimal(told)

    def _value(self, ending: str) -> float | None:
        return next((float(m.data) for t, m in self._first.items() if t.endswith(ending)), None)

    def between(self, to: str, of: str) -> Floats | None:
        """The (4, 4) transform from one stream's frame to the other's; None if nothing tells."""
        (root, T_root_to), (other, T_root_of) = self._place(to), self._place(of)
        return invert_transform(T_root_to) @ T_root_of if root == other else None

    def _place(self, topic: str) -> tuple[str, Floats]:
        """The frame in which a stream's place is known, and its pose there."""
        inverse = self._beside(topic, "rotation")
        if inverse is not None:  # librealsense's .bag: from the reference to the stream
            return "reference", invert_transform(_transform(inverse))
        frame, T = self.info(topic).header.frame_id, np.eye(4)
        for _ in self._frames:  # no more steps than frames, also where they go round in a circle
            if frame in self._frames:
                T = _transform(self._frames[frame].transform) @ T
                frame = self._frames[frame].header.frame_id
        return frame, T


def _image_streams(connections: Any) -> dict[str, str]:
    """By our name each stream's topic: raw images before compressed ones, short names first."""
    kinds = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
    images = [c for c in connections if c.msgtype in kinds and "aligned" not in c.topic]
    images.sort(key=lambda c: (c.msgtype == kinds[1], len(c.topic)))
    depth = [c.topic for c in images if re.search("depth", c.topic, re.IGNORECASE)]
    found = {"depth": depth[0]} if depth else {}
    for name, pattern in STREAM.items():
        rest = (c.topic for c in images if c.topic not in depth)
        found |= dict([(name, t) for t in rest if re.search(pattern, t, re.IGNORECASE)][:1])
    return found


def _pairs(message: Any) -> dict[str, str]:
    """What librealsense wrote as "name=value;..." or as a key and its value."""
    if hasattr(message, "key"):
        return {message.key: message.value}
    parts = (part.partition("=") for part in str(getattr(message, "data", "")).split(";"))
    return {name: value for name, equals, value in parts if equals}


def _matrix(info: Any, name: str) -> list[float]:
    """A field of CameraInfo, which ROS 1 writes with a capital."""
    values = getattr(info, name) if hasattr(info, name) else getattr(info, name.upper())
    return [float(value) for value in values]


def _transform(message: Any) -> Floats:
    q, t = message.rotation, message.translation
    return make_transform(Rotation.from_quat([q.x, q.y, q.z, q.w]), (t.x, t.y, t.z))


def _passed(shot: _Shot, others: dict[str, list[_Shot]]) -> bool:
    """Whether each other stream has come as far as this depth image."""
    return all(shots and shots[-1].time_s >= shot.time_s for shots in others.values())


def _pixels(message: Any, encoding: str | None = None) -> AnyArray:
    """The pixels of an image; encoding: RGB or grey, None for as they are."""
    import cv2
    from rosbags.image import image_to_cvimage

    if not hasattr(message, "format"):
        image: AnyArray = image_to_cvimage(message, encoding)
        return np.array(image)
    data = np.asarray(message.data)
    if "compressedDepth" in message.format:  # twelve bytes come before the PNG
        data = data[12:]
    decoded = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if decoded is None:
        raise ValueError(f"an image of format {message.format!r} cannot be decoded")
    return decoded[..., ::-1].copy() if encoding == "rgb8" and decoded.ndim == 3 else decoded


def _counts(depth: AnyArray) -> NDArray[np.uint16]:
    """Counts of FINE_M of an image in metres, 0 for what is no number or too far for them."""
    if depth.dtype != np.float32:
        return depth.astype(np.uint16)
    counts = np.nan_to_num(np.rint(depth / FINE_M), nan=0.0, posinf=0.0, neginf=0.0)
    return np.where((counts > 0) & (counts < NO_DEPTH), counts, 0).astype(np.uint16)


# --- folders --------------------------------------------------------------------------------------


class RecordedSet(Camera):
    """The recordings in a folder that `record_set` wrote, as one camera; the first is open.

    Raises CameraError for a folder without a set, and for recordings that do not open.
    """

    can_place = True

    def __init__(self, folder: Path) -> None:
        self._index = recording.Index.read(folder)
        self._turn_to(self._index.scenes[0])

    def _turn_to(self, scene: recording.RecordedScene, before: Camera | None = None) -> None:
        """Open a recording, and say what it says; CameraError if another camera took it."""
        played = play(self._index.folder / scene.file)
        if before is not None and played.serial != before.serial:
            played.close()
            serials = {"serial": played.serial, "before": before.serial}
            raise CameraError(say("cameras.other_camera", file=scene.file, **serials))
        if before is not None:
            before.close()
        self._played, self._scene = played, scene
        for name in set(Description.__annotations__) - {"can_place"}:
            setattr(self, name, getattr(played, name))

    def __repr__(self) -> str:
        where = {"folder": self._index.folder.name, "index": self._index}
        return say("cameras.set", name=self.name, scene=self._scene, **where)

    def place(self, name: str, distance_m: float) -> None:
        recording.check_distance(distance_m)
        scene = next((s for s in self._index.scenes if s.is_at(name, distance_m)), None)
        if scene is None:
            where = {"folder": self._index.folder.name, "index": self._index}
            raise CameraError(say("cameras.not_held", name=name, distance_m=distance_m, **where))
        if scene != self._scene:
            self._turn_to(scene, before=self._played)

    def lock(self) -> str:
        return self._played.lock()

    def close(self) -> None:
        self._played.close()

    def stream(self) -> Generator[Frame, None, None]:
        return self._played.stream()


class ImageFolder(Camera):
    """Depth images of any camera in a folder: 16-bit PNGs, in the order of the numbers in their
    names, beside an intrinsics.json.

    That file holds the fields of `Intrinsics` and depth_scale_m (metres a count), and may hold
    baseline_m (of a stereo camera), name and frames_per_s. There is no colour. Raises CameraError
    for a folder without both, or with a file that is damaged.
    """

    def __init__(self, folder: Path) -> None:
        path, self._what = folder / recording.INTRINSICS, f"the folder {folder.name}"
        self._images = sorted(folder.glob("*.png"), key=natural)  # img_2 comes before img_10
        if not self._images or not path.exists():
            missing = recording.INTRINSICS if self._images else "16-bit PNGs"
            lacks = {"missing": missing, "intrinsics": recording.INTRINSICS}
            raise CameraError(say("cameras.incomplete_folder", what=self._what, **lacks))
        try:
            given = results.read_json(path)
            self.depth_scale_m = recording.check_depth_scale(given.pop("depth_scale_m", None))
            self.baseline_m = given.pop("baseline_m", None)
            if self.baseline_m is not None:
                self.baseline_m = checks.positive("baseline_m", self.baseline_m)
            self.name = str(given.pop("name", "Depth camera"))
            rate = given.pop("frames_per_s", FRAMES_PER_S)
            self._frames_per_s = checks.positive("frames_per_s", rate)
            self.depth = Intrinsics(**given)
        except (TypeError, ValueError) as error:
            raise CameraError(f"{path} cannot be used ({error}): correct it") from error
        self.source, self.serial, self.color, self.T_color_depth = "recorded", "", None, None

    def __repr__(self) -> str:
        return camera_line(self, f"{self._what}, {counted(len(self._images), 'image')}", "none")

    def stream(self) -> Generator[Frame, None, None]:
        import cv2

        size = (self.depth.height, self.depth.width)
        for number, path in enumerate(self._images, start=1):
            data = np.fromfile(path, np.uint8)  # imread takes no accents on Windows
            image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
            if image is None or image.dtype != np.uint16 or image.shape != size:
                got = "no image" if image is None else f"{image.dtype} {image.shape}"
                wanted = f"16-bit grey of {size}, as {recording.INTRINSICS} says"
                raise CameraError(f"{path} is {got}: want {wanted}")
            depth, time_s = image.astype(np.uint16), number / self._frames_per_s
            yield Frame(depth, None, self.depth_scale_m, time_s, number, self.depth)

    def lock(self) -> str:
        return "Images in a folder cannot be changed: exposure and focus are as they were."

    def close(self) -> None:
        pass  # no file stays open
