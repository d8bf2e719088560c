"""What every camera can do, and the frames it gives."""

from __future__ import annotations

import contextlib
import itertools
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, overload

import numpy as np

from coursekit.geometry import Intrinsics, align_depth_to_color, deproject_image

if TYPE_CHECKING:
    import os

    from numpy.typing import NDArray

    from coursekit.cameras.simulated import HiddenTruth

STILL_FRAMES = 5  # this many frames in a row must look like the one before them
STILL_BLOCK = 4  # px; averaging blocks leaves motion and a quarter of the noise
STILL_FACTOR = 1.5  # times the change that noise alone makes
STILL_FLOOR = 0.5  # grey levels (or depth counts): quantisation


class CameraError(RuntimeError):
    """A camera or recording failed; `frames` holds what had come until then (maybe nothing)."""

    def __init__(self, message: str, frames: Iterable[Frame] = ()) -> None:
        super().__init__(message)
        self.frames = Frames(frames)


@dataclass(frozen=True, eq=False)
class Frame:
    """One depth image and the images taken with it.

    depth (H, W) uint16: counts of `depth_scale_m` metres, 0 invalid. color (h, w, 3) uint8 RGB or
    None. time_s: the camera's clock. T_color_depth (4, 4): depth frame to colour frame. infrared:
    what the depth was matched from, left and right, each (H, W) uint8 and with the pixels of the
    depth image on the left; None where the camera does not give it.
    """

    depth: NDArray[np.uint16]
    color: NDArray[np.uint8] | None
    depth_scale_m: float
    time_s: float
    number: int
    depth_intrinsics: Intrinsics
    color_intrinsics: Intrinsics | None = None
    T_color_depth: NDArray[np.float64] | None = None
    infrared: tuple[NDArray[np.uint8], NDArray[np.uint8]] | None = None

    @property
    def depth_m(self) -> NDArray[np.float32]:
        """Z in metres, (H, W), 0 invalid."""
        return self.depth * np.float32(self.depth_scale_m)

    def points(self) -> NDArray[np.float32]:
        """The point cloud in the depth camera's frame, (H, W, 3) metres, NaN invalid."""
        return deproject_image(self.depth, self.depth_intrinsics, self.depth_scale_m)

    def depth_on_color(self) -> NDArray[np.float32]:
        """Z in the colour camera's frame at each colour pixel, (h, w) metres, 0 invalid.

        Raises CameraError when the camera has no colour stream.
        """
        if self.color_intrinsics is None or self.T_color_depth is None:
            raise CameraError(
                "this frame has no colour stream to put the depth on: use depth_m or points()"
            )
        return align_depth_to_color(
            self.depth_m, self.depth_intrinsics, self.color_intrinsics, self.T_color_depth
        )

    def __repr__(self) -> str:
        color = "no colour" if self.color is None else f"colour {_size(self.color)}"
        return f"Frame {self.number} at {self.time_s:.3f} s: depth {_size(self.depth)}, {color}"


class Frames(Sequence[Frame]):
    """Frames in the order they were taken, like an immutable list."""

    def __init__(self, frames: Iterable[Frame] = ()) -> None:
        self._frames = tuple(frames)

    @overload
    def __getitem__(self, index: int) -> Frame: ...
    @overload
    def __getitem__(self, index: slice) -> Frames: ...
    def __getitem__(self, index: int | slice) -> Frame | Frames:
        return Frames(self._frames[index]) if isinstance(index, slice) else self._frames[index]

    def __len__(self) -> int:
        return len(self._frames)

    @property
    def depth(self) -> NDArray[np.uint16]:
        """All depth images as one array of counts, (N, H, W); ValueError when there is none."""
        if not self._frames:
            raise ValueError("frames: there are none, so there is no depth to stack")
        return np.stack([frame.depth for frame in self._frames])

    def __repr__(self) -> str:
        if not self._frames:
            return "no frames"
        seconds = self._frames[-1].time_s - self._frames[0].time_s
        return f"{len(self)} frame{'s' * (len(self) != 1)} in {seconds:.2f} s, first: {self[0]!r}"


class Camera(ABC):
    """A depth camera: live, recorded or simulated, with the same attributes and methods.

    depth_scale_m: metres per depth count. baseline_m: between the two infrared cameras, metres,
    None where a recording does not say. T_color_depth (4, 4): depth frame to colour frame.
    can_place: whether `place` brings the scene that it is asked for.
    """

    name: str
    source: Literal["live", "recorded", "simulated"]
    serial: str
    depth: Intrinsics
    color: Intrinsics | None
    baseline_m: float | None
    depth_scale_m: float
    T_color_depth: NDArray[np.float64] | None
    can_place: bool = False

    @abstractmethod
    def _stream(self) -> Generator[Frame, None, None]:
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
        check_distance(distance_m)
        print(f"{self.name}: a recording cannot be rearranged, it shows what it shows.")

    def set(
        self,
        ambient: float | None = None,
        exposure: float | Literal["auto"] | None = None,
        depth_scale_m: float | None = None,
    ) -> str:
        """Change what is not None, and return a sentence of what was done.

        ambient: the simulated room's infrared light, where 1 is as bright as a projected dot's peak
        on a surface at 1 m. exposure: ms, or "auto". depth_scale_m: metres per depth count; a
        RealSense changes nothing else, and this only where the device offers it. A recording cannot
        be changed. Raises ValueError for a figure out of range, and CameraError.
        """
        return "A recording cannot be changed: light, exposure and units are as recorded."

    def reveal(self) -> HiddenTruth:
        """What the simulated camera really is, to be looked at last; CameraError for any other."""
        raise CameraError(
            f"nobody knows the true geometry of the {self.name}: only a camera that "
            'open_camera("simulated") opened can reveal it'
        )

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
        from coursekit.cameras.recorded_set import write_set

        check_count("n", n)
        return write_set(folder, self, name, distances_m, n, overwrite, infrared)

    def frames(self, n: int = 1, progress: bool = True) -> Frames:
        """The next n frames; of a recording always its first n.

        A recording with fewer gives what there is and prints one line. Ctrl-C (the notebook's
        stop button) returns the frames so far, with one line, when there is at least one.
        Raises ValueError for a bad n, and CameraError with the frames so far in `.frames`.
        """
        check_count("n", n)
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
        self,
        path: str | os.PathLike[str],
        n: int,
        overwrite: bool = False,
        infrared: bool = False,
    ) -> Path:
        """Record n frames to a .db3 file that `open_camera` plays back, and return its path.

        infrared: the infrared images too, where the camera gives them; a file of noisy ones is two
        to three times as large. Nothing is kept in memory. When the camera fails or Ctrl-C stops
        it, the file holds the frames so far. Raises ValueError for a bad n or path (an existing
        file is kept unless `overwrite`), and CameraError.
        """
        from coursekit.cameras.recording import write_recording

        check_count("n", n)
        return write_recording(path, self, self._take(n, progress=True), overwrite, infrared)

    def frame_when_still(self, timeout_s: float = 30.0) -> Frame:
        """The first frame that the five frames before it agree with: the scene stands still.

        The mean absolute change must stay below what the image's own noise explains.
        timeout_s: on the camera's clock. Raises ValueError for a bad timeout, and CameraError
        when nothing stands still in time or the recording ends first.
        """
        if not timeout_s > 0:
            raise ValueError(f"timeout_s: got {timeout_s!r}, want a positive number of seconds")
        run: list[NDArray[np.float32]] = []
        start_s: float | None = None
        advice = "put the camera and the object down, keep hands and flickering light away, and "
        with contextlib.closing(self._stream()) as stream:
            for frame in stream:
                start_s = frame.time_s if start_s is None else start_s
                image = _block_means(frame)
                if run and not _looks_still(run[0], image):
                    run.clear()
                run.append(image)
                if len(run) > STILL_FRAMES:
                    return frame
                if frame.time_s - start_s > timeout_s:
                    raise CameraError(
                        f"nothing stood still within {timeout_s:g} s: {advice}try again"
                    )
        raise CameraError(
            f"the recording ended before {STILL_FRAMES + 1} frames in a row stood still: "
            "take camera.frame() instead"
        )

    def _take(self, n: int, progress: bool) -> Iterator[Frame]:
        """Up to n frames with a progress bar; one printed line when a recording ends early."""
        from tqdm.auto import tqdm

        count = 0
        with (
            contextlib.closing(self._stream()) as stream,
            tqdm(total=n, unit="frame", leave=False, disable=not progress or n < 10) as bar,
        ):
            for frame in itertools.islice(stream, n):
                yield frame
                count += 1
                bar.update()
        if count < n:
            print(f"The recording ends after {count} of the {n} frames asked for.")

    def __enter__(self) -> Camera:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


@contextlib.contextmanager
def place(camera: Camera, name: str, distance_m: float) -> Iterator[Camera]:
    """`camera.place(name, distance_m)` as the head of a `with` block, which is given the camera."""
    camera.place(name, distance_m)
    yield camera


def check_distance(distance_m: object) -> None:
    """ValueError unless `distance_m` is a positive, finite number."""
    number = isinstance(distance_m, (int, float, np.number)) and not isinstance(distance_m, bool)
    if not number or not 0 < distance_m < np.inf:  # type: ignore[operator]
        raise ValueError(f"distance_m: got {distance_m!r}, want a positive number of metres")


def check_depth_scale(depth_scale_m: object) -> None:
    """ValueError unless `depth_scale_m` is a number that a D4xx takes, 0.000001 to 0.01 m."""
    number = isinstance(depth_scale_m, (float, np.floating))
    if not number or not 1e-6 <= depth_scale_m <= 0.01:  # type: ignore[operator]
        raise ValueError(
            f"depth_scale_m: got {depth_scale_m!r}, want metres per count from 0.000001 to 0.01"
        )


def check_count(name: str, value: object) -> None:
    """ValueError under `name` unless `value` is a whole number of at least 1."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < 1:
        raise ValueError(f"{name}: got {value!r}, want a whole number of at least 1")


def _size(image: NDArray[np.generic]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"


def _block_means(frame: Frame) -> NDArray[np.float32]:
    """Means of 4x4 px blocks of the green channel, or of the depth, NaN with an invalid pixel."""
    if frame.color is not None:
        image = frame.color[..., 1].astype(np.float32)
    else:
        image = np.where(frame.depth > 0, frame.depth, np.float32(np.nan))
    rows, columns = (size // STILL_BLOCK for size in image.shape)
    image = image[: rows * STILL_BLOCK, : columns * STILL_BLOCK]
    return image.reshape(rows, STILL_BLOCK, columns, STILL_BLOCK).mean(axis=(1, 3))


def _looks_still(before: NDArray[np.float32], after: NDArray[np.float32]) -> bool:
    """Whether the mean absolute change is no more than the image's own noise explains."""
    change = np.abs(after - before)
    change = change[np.isfinite(change)]
    if change.size == 0:
        return False
    expected = 2.0 / np.sqrt(np.pi) * _noise_std(before)  # mean |difference| of two noisy values
    return bool(change.mean() <= STILL_FLOOR + STILL_FACTOR * expected)


def _noise_std(image: NDArray[np.float32]) -> float:
    """Standard deviation of an image's noise, insensitive to planes and to a few edges.

    Source: Immerkaer, "Fast noise variance estimation" (1996), with the median absolute value in
    place of the mean, so that edges and texture count less.
    """
    rows = image[:-2] - 2.0 * image[1:-1] + image[2:]
    second = rows[:, :-2] - 2.0 * rows[:, 1:-1] + rows[:, 2:]
    second = second[np.isfinite(second)]
    return 1.4826 * float(np.median(np.abs(second))) / 6.0 if second.size else 0.0
