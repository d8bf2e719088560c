"""Recorded sets: a folder with one recording for each scene that was placed, and an index."""

from __future__ import annotations

import os
import re
from collections.abc import Generator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from coursekit import results
from coursekit.cameras.camera import Camera, CameraError, Frame, check_distance
from coursekit.cameras.realsense import RealSense
from coursekit.cameras.recording import depth_frame_numbers

INDEX = "index.json"
SAME_M = 0.0005  # distances closer than this are one place


@dataclass(frozen=True)
class Scene:
    """One recording of a set: what stood how far away, m, and the file in the set's folder."""

    name: str
    distance_m: float
    file: str

    def is_at(self, name: str, distance_m: float) -> bool:
        return self.name == name and abs(self.distance_m - distance_m) < SAME_M


class RecordedSet(Camera):
    """The recordings in a folder that `record_set` wrote, as one camera; the first is open.

    Raises CameraError for a folder without a set, and for recordings that do not open.
    """

    source = "recorded"
    can_place = True

    def __init__(self, folder: Path) -> None:
        self._folder, self._scenes = folder, _read_index(folder)
        self._turn_to(self._scenes[0])

    def _turn_to(self, scene: Scene) -> None:
        """Open another recording and describe the camera as it does; it must be the same camera."""
        played = RealSense(path=self._folder / scene.file)
        before = getattr(self, "_played", None)
        if before is not None and played.serial != before.serial:
            played.close()
            raise CameraError(
                f"{scene.file} was recorded by another camera ({played.serial}, not "
                f"{before.serial}): record one set with one camera"
            )
        if before is not None:
            before.close()
        self._played, self._scene = played, scene
        self.name, self.serial = played.name, played.serial
        self.depth, self.color = played.depth, played.color
        self.baseline_m, self.depth_scale_m = played.baseline_m, played.depth_scale_m
        self.T_color_depth = played.T_color_depth

    def __repr__(self) -> str:
        return (
            f"{self.name} (recorded set {self._folder.name}, now {_label(self._scene)}), "
            f"which holds {_contents(self._scenes)}"
        )

    def place(self, name: str, distance_m: float) -> None:
        check_distance(distance_m)
        for scene in self._scenes:
            if scene.is_at(name, distance_m):
                if scene != self._scene:
                    self._turn_to(scene)
                return
        raise CameraError(
            f"the set {self._folder.name} has no {name} at {distance_m:.3f} m: it holds "
            f"{_contents(self._scenes)}"
        )

    def lock(self) -> str:
        return self._played.lock()

    def close(self) -> None:
        self._played.close()

    def _stream(self) -> Generator[Frame, None, None]:
        return self._played._stream()


def write_set(
    folder: str | os.PathLike[str],
    camera: Camera,
    name: str,
    distances_m: Sequence[float],
    n: int,
    overwrite: bool,
    infrared: bool,
) -> Path:
    """`Camera.record_set`."""
    target = Path(folder).expanduser()
    if not camera.can_place:
        raise CameraError(f"{camera.name}: a recording cannot be rearranged, so it makes no set")
    for distance_m in distances_m:
        check_distance(distance_m)
    scenes = _read_index(target) if (target / INDEX).exists() else []
    held = [scene for scene in scenes if any(scene.is_at(name, d) for d in distances_m)]
    if held and not overwrite:
        raise ValueError(
            f"distances_m: the set {target} holds {_contents(held)} already: choose another folder "
            "or overwrite=True"
        )
    try:
        target.mkdir(exist_ok=True)
    except OSError as error:
        raise ValueError(f"folder: {target} cannot be made ({error.strerror})") from error
    for distance_m in distances_m:
        scene = Scene(name, float(distance_m), _file_name(name, distance_m))
        camera.place(name, distance_m)
        camera.record(target / scene.file, n, overwrite=True, infrared=infrared)
        scenes = [old for old in scenes if not old.is_at(name, distance_m)] + [scene]
        results.write_json(target / INDEX, {"scenes": [asdict(scene) for scene in scenes]})
        if camera.source != "recorded" and len(depth_frame_numbers(target / scene.file)) < n:
            print(f"The set {target.name} holds {_contents(scenes)}.")  # stopped by Ctrl-C
            break
    return target


def _file_name(name: str, distance_m: float) -> str:
    """A file name that every system takes: "60-mm-block_0.450m.db3"."""
    return f"{re.sub('[^A-Za-z0-9]+', '-', name).strip('-')}_{distance_m:.3f}m.db3"


def _read_index(folder: Path) -> list[Scene]:
    path = folder / INDEX
    if not path.exists():
        raise CameraError(
            f"{folder} is a folder: name the .db3 or .bag file in it, "
            "or a folder that camera.record_set() wrote"
        )
    try:
        scenes = [Scene(**entry) for entry in results.read_json(path)["scenes"]]
        for scene in scenes:
            check_distance(scene.distance_m)
            if Path(scene.file).name != scene.file:
                raise ValueError(f"file: got {scene.file!r}, want a name in the set's own folder")
        if not scenes:
            raise ValueError("it lists no scenes")
    except (KeyError, TypeError, ValueError) as error:
        raise CameraError(f"{path} is damaged ({error}): record the set anew") from error
    return scenes


def _label(scene: Scene) -> str:
    return f"{scene.name} at {scene.distance_m:.3f} m"


def _contents(scenes: Sequence[Scene]) -> str:
    """ "60 mm block at 0.300, 0.450 m; wall at 1.000 m"."""
    names = dict.fromkeys(scene.name for scene in scenes)
    distances = {k: sorted(s.distance_m for s in scenes if s.name == k) for k in names}
    return "; ".join(f"{k} at {', '.join(f'{d:.3f}' for d in distances[k])} m" for k in names)
