"""The simulated camera: the same interface, without hardware."""

from __future__ import annotations

from collections.abc import Generator
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from coursekit import specifications
from coursekit.cameras.camera import Camera, CameraError, Frame
from coursekit.geometry import invert_transform
from coursekit.simulation import Scene, render, tabletop

if TYPE_CHECKING:
    from numpy.typing import NDArray

FRAMES_PER_S = 30
PLUG_IN = (
    'Plug in a RealSense and run this cell again, or name a recording: ck.open_camera("file.bag")'
)


class SimulatedCamera(Camera):
    """A stand-in for one unit of a real camera model, looking at a block on a table.

    The geometry is exact and depth is rounded to the device's unit, but there is **no noise**, no
    hole and no flying pixel: all frames of a scene are equal but for number and time, so nothing
    about depth noise can be learned from it. `seed` names the camera and changes no image.
    device: a name of data/devices.toml. scene: in the depth camera's frame. advice: the last
    sentence of the description. Raises ValueError for an unknown device or a bad seed.
    """

    def __init__(
        self,
        device: str = "D435",
        seed: int = 7,
        scene: Scene | None = None,
        advice: str = PLUG_IN,
    ) -> None:
        if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
            raise ValueError(f"seed: got {seed!r}, want a whole number of at least 0")
        unit = specifications.device(device).unit
        self.name, self.source, self.serial = f"Simulated {device}", "simulated", f"seed-{seed}"
        self.depth = unit.depth
        self.color = self._color = unit.color
        self.baseline_m, self.depth_scale_m = unit.baseline_m, unit.depth_scale_m
        self.T_color_depth = self._T_color_depth = unit.T_color_depth
        self.scene = tabletop() if scene is None else scene
        self._seed, self._advice, self._closed, self._given = seed, advice, False, 0

    def __repr__(self) -> str:
        return f"{self.name}, seed {self._seed}: no real camera in use.\n{self._advice}"

    def lock(self) -> str:
        """Nothing to do: returns one sentence that says so."""
        return "There is nothing to lock: the simulated camera has fixed exposure and focus."

    def close(self) -> None:
        """End this camera; a second call does nothing."""
        self._closed = True

    def _stream(self) -> Generator[Frame, None, None]:
        if self._closed:
            raise CameraError(f"the {self.name} is closed: open it again with open_camera()")
        while not self._closed:
            depth, color = self._images
            self._given += 1
            yield Frame(
                depth.copy(),
                color.copy(),
                self.depth_scale_m,
                self._given / FRAMES_PER_S,
                self._given,
                self.depth,
                self.color,
                self.T_color_depth,
            )

    @cached_property
    def _images(self) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
        """Depth (H, W) in counts and colour (h, w, 3) of the scene, each from its own eye."""
        exact = render(self.scene, self.depth).depth_m
        counts = np.rint(exact / self.depth_scale_m)
        in_range = counts <= np.iinfo(np.uint16).max
        depth = np.where(in_range, counts, 0).astype(np.uint16)
        color = render(self.scene, self._color, invert_transform(self._T_color_depth)).color
        return depth, color
