"""Frames, the calibration that comes with them, and the error of a camera that gives no more."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from coursekit import checks
from coursekit.arrays import AnyArray, Floats, Image, NDArray
from coursekit.geometry import Intrinsics, align_depth_to_color, deproject_image
from coursekit.words import Listed, counted, say

NO_DEPTH = np.iinfo(np.uint16).max  # what some devices say of what is too far or not seen
FRAMES_PER_S = 30  # of all streams that the course opens, simulates and records


class CameraError(RuntimeError):
    """A camera or recording failed; `frames` holds what had come until then (maybe nothing)."""

    def __init__(self, message: str, frames: Iterable[Frame] = ()) -> None:
        super().__init__(message)
        self.frames = Frames(frames)


def need(holds: object, sentence: str, /, **facts: Any) -> None:
    """CameraError with a sentence of texts.toml and the facts in it, unless the condition holds."""
    if not holds:
        raise CameraError(say(sentence, **facts))


class Description:
    """What a camera, live, recorded or simulated, says about itself.

    depth, color: the factory's calibration of the two streams; color is None without one.
    baseline_m: between the two infrared cameras, metres, None where a recording does not say.
    depth_scale_m: metres per depth count. T_color_depth (4, 4): depth frame to colour frame, None
    without colour. can_place: whether `place` brings the scene that it is asked for.
    """

    name: str
    source: Literal["live", "recorded", "simulated"]
    serial: str
    depth: Intrinsics
    color: Intrinsics | None
    baseline_m: float | None
    depth_scale_m: float
    T_color_depth: Floats | None
    can_place: bool = False


@dataclass(frozen=True, eq=False)
class Frame:
    """One depth image and the images taken with it.

    depth (H, W) uint16: counts of `depth_scale_m` metres, 0 invalid; the largest count, where they
    end, is made 0. color (h, w, 3) uint8 RGB or None. time_s: the camera's clock. T_color_depth
    (4, 4): depth frame to colour frame. infrared: what the depth was matched from, left and right,
    each (H, W) uint8 and with the pixels of the depth image on the left; None where the camera does
    not give it.
    """

    depth: NDArray[np.uint16]
    color: Image | None
    depth_scale_m: float
    time_s: float
    number: int
    depth_intrinsics: Intrinsics
    color_intrinsics: Intrinsics | None = None
    T_color_depth: Floats | None = None
    infrared: tuple[Image, Image] | None = None

    def __post_init__(self) -> None:
        ends = self.depth == NO_DEPTH
        if ends.any():
            object.__setattr__(self, "depth", np.where(ends, np.uint16(0), self.depth))

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
            raise CameraError(say("cameras.no_colour"))
        return align_depth_to_color(
            self.depth_m, self.depth_intrinsics, self.color_intrinsics, self.T_color_depth
        )

    def __repr__(self) -> str:
        color = "no colour" if self.color is None else f"colour {_size(self.color)}"
        return f"Frame {self.number} at {self.time_s:.3f} s: depth {_size(self.depth)}, {color}"


class Frames(Listed[Frame]):
    """Frames in the order they were taken, like an immutable list; a slice of them is Frames too.

    >>> Frames()
    no frames
    >>> len(Frames()[:5])
    0
    """

    @property
    def depth(self) -> NDArray[np.uint16]:
        """All depth images as one array of counts, (N, H, W); ValueError when there is none."""
        checks.refuse(not self, "frames: there are none, so there is no depth to stack")
        return np.stack([frame.depth for frame in self])

    def __repr__(self) -> str:
        if not self:
            return "no frames"
        seconds = self[-1].time_s - self[0].time_s
        return f"{counted(len(self), 'frame')} in {seconds:.2f} s, first: {self[0]!r}"


def _size(image: AnyArray) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
