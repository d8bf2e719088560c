"""What every camera can do."""

from __future__ import annotations

import contextlib
import itertools
import os
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from coursekit import checks
from coursekit.cameras import recording
from coursekit.cameras.frames import CameraError, Description, Frame, Frames
from coursekit.geometry import Intrinsics
from coursekit.results import Quantity
from coursekit.words import counting, say


@dataclass(frozen=True)
class HiddenTruth:
    """What a simulated camera really is, and does not report.

    baseline_m: the true one. reported_baseline_m: the one its depth is computed with.
    disparity_offset_px: by which disparities come out too large. drift_px, drift_time_s: standard
    deviation and correlation time of a slow change of that offset. color_lens: of the colour image,
    coefficients in OpenCV's sense. reported_color_lens: what the device says of it.
    """

    baseline_m: float
    reported_baseline_m: float
    disparity_offset_px: float
    drift_px: float
    drift_time_s: float
    color_lens: Intrinsics
    reported_color_lens: Intrinsics

    @property
    def scale_error(self) -> float:
        """By which part all depths come out too large (negative: too small) for the baseline."""
        return self.reported_baseline_m / self.baseline_m - 1.0

    def __repr__(self) -> str:
        mm = {"true_mm": 1e3 * self.baseline_m, "reported_mm": 1e3 * self.reported_baseline_m}
        lenses = map(_lens_text, (self.color_lens, self.reported_color_lens))
        both = dict(zip(("true_lens", "reported_lens"), lenses, strict=True))
        return say("cameras.truth", t=self, percent=100 * self.scale_error, **mm, **both)


class Camera(Description, ABC):
    """A depth camera: live, recorded or simulated, with the same attributes and methods.

    As the head of a `with` block it is closed at the block's end.
    """

    @abstractmethod
    def stream(self) -> Generator[Frame, None, None]:
        """Frames from now on; of a recording from its start to its end."""

    @abstractmethod
    def lock(self) -> str:
        """Fix exposure and focus where the device allows it; one sentence of what was done."""

    @abstractmethod
    def close(self) -> None:
        """Let go of the device or file; a second call does nothing."""

    def place(self, name: str, distance_m: float) -> None:
        """Bring the thing called `name` before the camera: "60 mm block", "wall" or "artefacts".

        distance_m: Z of its front, m. The simulated camera moves its scene, a live one says what to
        put where and waits for Enter, a recorded set turns to the file. A single recording shows
        what it shows: it prints one line that says so, and `can_place` is False.
        Raises ValueError for a bad distance, or for a name that the simulated camera does not know,
        and CameraError for what a recorded set does not hold (the message lists what it does).
        """
        recording.check_distance(distance_m)
        print(f"{say('cameras.not_rearranged', name=self.name)}, it shows what it shows.")

    def set(
        self,
        ambient: float | None = None,
        exposure: float | Literal["auto"] | None = None,
        depth_scale_m: float | None = None,
    ) -> str:
        """Change what is not None, and return a sentence of what was done.

        ambient: the simulated room's infrared light, where 1 is as bright as a projected dot's peak
        on a surface at 2 m. exposure: ms, or "auto". depth_scale_m: metres per depth count; a
        RealSense changes nothing else, and this only where the device offers it. A recording cannot
        be changed. Raises ValueError for a figure out of range, and CameraError.
        """
        asked = {"ambient": ambient, "exposure": exposure, "depth_scale_m": depth_scale_m}
        return self._change({name: value for name, value in asked.items() if value is not None})

    def _change(self, asked: dict[str, Any]) -> str:
        """Do what `set` was asked for, and say what was done."""
        return "A recording cannot be changed: light, exposure and units are as recorded."

    def reveal(self) -> HiddenTruth:
        """What the simulated camera really is, to be looked at last; CameraError for any other."""
        raise CameraError(say("cameras.not_revealed", name=self.name))

    def factory_values(self) -> dict[str, Quantity]:
        """What the device says of itself, for `results.save`: nobody has told how uncertain it is.

        depth_fx to color_cy, depth_width and depth_height in px; the baseline in mm.
        """
        says, note = {}, "factory, sigma not given"
        for name, lens in (("depth", self.depth), ("color", self.color)):
            for entry in ("fx", "fy", "cx", "cy") if lens else ():
                says[f"{name}_{entry}"] = Quantity(getattr(lens, entry), "px", None, "bias", note)
        for name in ("width", "height"):
            says[f"depth_{name}"] = Quantity(getattr(self.depth, name), "px")
        if self.baseline_m is not None:
            says["baseline"] = Quantity(1000 * self.baseline_m, "mm", None, "bias", "factory")
        return says

    def frames(self, n: int = 1, progress: bool = True) -> Frames:
        """The next n frames; of a recording always its first n.

        A recording with fewer gives what there is and prints one line. Ctrl-C (the notebook's
        stop button) returns the frames so far, with one line, when there is at least one.
        Raises ValueError for a bad n, and CameraError with the frames so far in `.frames`.
        """
        checks.whole("n", n)
        taken: list[Frame] = []
        try:
            for frame in self._take(n, progress):
                taken.append(frame)
        except KeyboardInterrupt:
            if not taken:
                raise
            print(f"Stopped after {len(taken)} of {n} frames; they are kept.")
        except CameraError as error:
            error.frames = Frames(taken)
            raise
        return Frames(taken)

    def frame(self) -> Frame:
        """The next frame; of a recording its first."""
        return self.frames(1)[0]

    def record(
        self, path: str | os.PathLike[str], n: int, overwrite: bool = False, infrared: bool = False
    ) -> Path:
        """Record n frames to a .db3 file that `open_camera` plays back, and return its path.

        infrared: the infrared images too, where the camera gives them; a file of noisy ones is two
        to three times as large. Nothing is kept in memory. When the camera fails or Ctrl-C stops
        it, the file holds the frames so far. Raises ValueError for a bad n or path (an existing
        file is kept unless `overwrite`), and CameraError.
        """
        checks.whole("n", n)
        frames = self._take(n, progress=True)
        return recording.write_recording(path, self, frames, overwrite, infrared)

    def record_set(
        self,
        folder: str | os.PathLike[str],
        name: str,
        distances_m: Sequence[float],
        n: int,
        overwrite: bool = False,
        infrared: bool = False,
    ) -> Path:
        """Place `name` at each distance, record n frames of each, and return the folder.

        infrared as for `record`. `open_camera(folder)` opens the set. The folder is made if need
        be; a set in it is added to. What is recorded when Ctrl-C or the camera stops it stays.
        Raises ValueError for bad arguments (a scene that the set holds is kept unless `overwrite`),
        and CameraError.
        """
        checks.whole("n", n)
        if not self.can_place:
            stays = say("cameras.not_rearranged", name=self.name)
            raise CameraError(f"{stays}, so it makes no set")
        index = recording.Index.to_extend(Path(folder).expanduser(), name, distances_m, overwrite)
        for distance_m in distances_m:
            scene = recording.scene_to_record(name, distance_m)
            self.place(name, distance_m)
            path = self.record(index.folder / scene.file, n, overwrite=True, infrared=infrared)
            index.add(scene)
            if self.source != "recorded" and len(recording.depth_frame_numbers(path)) < n:
                print(f"The set {index.folder.name} holds {index}.")  # stopped by Ctrl-C
                break
        return index.folder

    def _take(self, n: int, progress: bool) -> Iterator[Frame]:
        """Up to n frames, counted on a line; one printed line when a recording ends early."""
        count = 0
        with contextlib.closing(self.stream()) as stream:
            wanted = itertools.islice(stream, n)
            for frame in counting(wanted, n, "frame", progress and n >= 10):
                yield frame
                count += 1
        if count < n:
            print(f"The recording ends after {count} of the {n} frames asked for.")

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


@contextlib.contextmanager
def place(camera: Camera, name: str, distance_m: float) -> Iterator[Camera]:
    """`camera.place(name, distance_m)` as the head of a `with` block, which is given the camera.

    Raises what `Camera.place` raises.

    >>> from coursekit.cameras import open_camera
    >>> with place(open_camera("simulated"), "wall", 0.8) as camera:
    ...     print(camera.name)
    Simulated D435
    """
    camera.place(name, distance_m)
    yield camera


def camera_line(camera: Camera, where: str, without: str) -> str:
    """A camera's figures in a line; without: what is said of a baseline that it does not have."""
    color, baseline_m, unit_mm = camera.color, camera.baseline_m, 1000 * camera.depth_scale_m
    colour = f"colour {color.width}x{color.height}" if color else "no colour"
    baseline = without if baseline_m is None else f"{1000 * baseline_m:.1f} mm"
    return say(
        "cameras.camera", c=camera, where=where, colour=colour, baseline=baseline, unit_mm=unit_mm
    )


def _lens_text(lens: Intrinsics) -> str:
    names = ("k1", "k2", "p1", "p2", "k3")
    coeffs = ", ".join(f"{n} {c:+.4f}" for n, c in zip(names, lens.coeffs, strict=True) if c)
    return say("cameras.lens", lens=lens, coeffs=coeffs or "no distortion")
