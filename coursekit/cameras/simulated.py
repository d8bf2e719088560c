"""The simulated camera: the same interface, without hardware."""

from __future__ import annotations

import zlib
from collections.abc import Generator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np

from coursekit import checks, results, specifications
from coursekit.arrays import ArrayLike, Floats, Image
from coursekit.boards import Board
from coursekit.cameras.camera import Camera, HiddenTruth
from coursekit.cameras.frames import FRAMES_PER_S, Frame, need
from coursekit.cameras.recording import check_depth_scale, check_distance
from coursekit.geometry import Intrinsics, invert_transform
from coursekit.simulation import Rig, RigView, Scene, artefact_scene, render, tabletop, wall_scene
from coursekit.simulation.board_images import board_scene, check_pose, render_board
from coursekit.specifications import Unit
from coursekit.words import say

SCENES = {"60 mm block": tabletop, "wall": wall_scene, "artefacts": artefact_scene}

# How far a unit is from what it reports. The vendor allows 2 % of depth error at 2 m; with these a
# D435 is 2-5 mm off at 0.45 m, as people find (data/published_depth_noise.json).
BASELINE_ERROR = (0.004, 0.010)  # least and largest, of the baseline, either sign
OFFSET_PX = 0.10  # std
# How far the colour lens is from the factory's figures, std: plausible, not measured. Its pixels
# are square to a far smaller part than its focal length is known.
FOCAL_ERROR, ASPECT_ERROR, CENTRE_ERROR_PX = 0.003, 0.0002, 1.5
LENS_SPREAD = ((0.020, 0.003), (-0.030, 0.005))  # k1 and k2 that the factory's lack: mean and std
TANGENTIAL = 3e-4
UNIT, REFERENCE_UNIT = "unit.json", 7  # in results/; whose numbers the stored notebooks show
DRIFT_PX, DRIFT_TIME_S = 0.008, 3.0  # a wall at 0.5 m then varies as published ones do


def my_unit(name: str = "") -> int:
    """The seed of your own simulated camera, arm and sessions, so that your numbers are yours.

    name: yours, as on the class list. The seed is made from its letters and digits; case, spaces
    and accents make no difference. Both are kept in `results/unit.json`. Without a name it is the
    seed kept there, else 7, the unit of the numbers printed in the course. Raises ValueError for a
    name without letters and for a damaged file, and OSError where nothing can be saved.

    >>> my_unit()
    7
    """
    path = results.folder() / UNIT
    if checks.instance("name", name, str):
        results.write_json(path, {"name": name, "seed": specifications.seed_of(name)})
    if not path.exists():
        return REFERENCE_UNIT
    try:
        return checks.whole("seed", results.read_json(path).get("seed"), least=0)
    except ValueError as error:
        again = 'give your name again: ck.my_unit("your name")'
        raise ValueError(f"{path.name} in results/ is damaged, {again} ({error})") from error


class SimulatedCamera(Camera):
    """A stand-in for one unit of a real camera model, looking at a block on a table.

    Two infrared images are rendered and exposed, and depth is what a block matcher makes of them:
    see `simulation.rig`. The colour image has no noise unless it shows a board (see
    `show_board`), and its true lens is not quite the one that the camera reports.

    device: a name of data/devices.toml. seed: names the unit, so its hidden truth, its pattern of
    speckle and its noise; None for `my_unit()`. depth_scale_m: see `set`; None for the device's own
    depth unit. advice: the last sentence of the description. Raises ValueError for an unknown
    device and a bad figure.

    The same calls give the same bytes. `place` and `set` start a stream of random numbers that is
    named by seed, scene, distance, ambient light and exposure, and the drift somewhere of its own,
    so a cell that places and captures gives the same numbers when it is run again, other distances
    are independent, and another depth unit rounds the same images. Captures without a new `place`
    go on in the stream. Clock and frame numbers never go back.
    """

    can_place = True

    def __init__(
        self,
        device: str = "D435",
        seed: int | None = REFERENCE_UNIT,
        depth_scale_m: float | None = None,
        advice: str = say("cameras.plug_in"),
    ) -> None:
        self.seed = my_unit() if seed is None else checks.whole("seed", seed, least=0)
        self._advice, self._closed = advice, False
        profile = specifications.device(device)
        unit = profile.unit
        self.name, self.source = f"Simulated {device}", "simulated"
        self.serial = f"seed-{self.seed}"
        self.depth, self.color, self.T_color_depth = unit.depth, unit.color, unit.T_color_depth
        self.baseline_m, self.depth_scale_m = unit.baseline_m, unit.depth_scale_m
        self._device, self._given = device, 0
        self._truth = truth = _hidden_truth(self.seed, unit)
        self._rig = Rig(
            self.depth,
            truth.reported_baseline_m,
            projector=profile.projector,
            baseline_error=truth.baseline_m / truth.reported_baseline_m - 1.0,
            disparity_offset_px=truth.disparity_offset_px,
            drift_px=truth.drift_px,
            drift_time_s=truth.drift_time_s,
            seed=self.seed,
        )
        self._shown: tuple[Board, Floats] | None = None
        self.place("60 mm block", 0.45)
        self.set(depth_scale_m=depth_scale_m)

    def __repr__(self) -> str:
        return f"{self.name}, seed {self.seed}: no real camera in use.\n{self._advice}".strip()

    # --- the scene, the light, the truth -------------------------------------------------------

    def place(self, name: str, distance_m: float) -> None:
        check_distance(distance_m)
        self.scene = _scene(checks.choice("name", name, SCENES), float(distance_m))
        self._shown = None
        self._place_name, self._distance_m = name, float(distance_m)
        self._start_afresh()

    def show_board(self, board: Board, T_camera_board: ArrayLike) -> None:
        """Lay a calibration board on a table before the camera, until the next `place`.

        T_camera_board (4, 4): board frame to the colour camera's frame. The colour image is then
        what `render_board` makes with the true lens, grey and with noise; the depth image that of a
        plain plate of the board's size. Raises ValueError for a pose that does not face the camera.
        """
        T = check_pose(board, T_camera_board)
        T_color_depth = specifications.device(self._device).unit.T_color_depth
        self.scene = board_scene(board, invert_transform(T_color_depth) @ T)
        self._shown = board, T
        # Rounded: the last bits of a pose differ between machines, the pictures must not.
        name = f"{board.kind} {board.squares} {board.square_m:.6f} {np.rint(1e6 * T).astype(int)}"
        self._place_name, self._distance_m = name, float(T[2, 3])
        self._start_afresh()

    def _change(self, asked: dict[str, Any]) -> str:
        scale_m = check_depth_scale(asked.pop("depth_scale_m", self.depth_scale_m))
        self._rig, self.depth_scale_m = replace(self._rig, **asked), scale_m
        self._start_afresh()
        fixed = self._rig.exposure
        exposure_ms = fixed if fixed == "auto" else f"{fixed:.3g} ms"
        light = {"ambient": self._rig.ambient, "exposure": exposure_ms}
        return say("cameras.light", **light, unit_mm=1000 * scale_m)

    def lock(self) -> str:
        """Fix the exposure at what it is now, as on a real camera; one sentence that says so."""
        self._check_open()
        exposure_ms = _view(self._rig, self.scene).exposure_ms
        self.set(exposure=exposure_ms)
        return f"Locked infrared exposure at {exposure_ms:.3g} ms; focus and colour are fixed."

    def reveal(self) -> HiddenTruth:
        return self._truth

    def close(self) -> None:
        """End this camera; a second call does nothing."""
        self._closed = True

    # --- frames --------------------------------------------------------------------------------

    def stream(self) -> Generator[Frame, None, None]:
        self._check_open()
        while True:
            view, color = _view(self._rig, self.scene), self.color_image()
            shot = view.frame(self._rng, self._drift_from_s + self._since_placed_s)
            depth, scale_m = view.depth(shot, self.depth_scale_m), self.depth_scale_m
            when, figures = self._given / FRAMES_PER_S, (self.depth, self.color, self.T_color_depth)
            eyes = shot.left, shot.right
            yield Frame(depth, color, scale_m, when, self._given, *figures, eyes)

    def color_image(self) -> Image:
        """The colour image (h, w, 3) of the next frame alone, which needs no stereo matching."""
        self._check_open()
        self._given += 1
        self._since_placed_s += 1 / FRAMES_PER_S
        lens = self._truth.color_lens
        if self._shown is None:
            return _color_image(self.scene, self._device, lens).copy()
        grey = render_board(*self._shown, lens, self._color_rng)
        return np.repeat(grey[..., None], 3, axis=2)

    def _check_open(self) -> None:
        need(not self._closed, "cameras.closed", what=f"the {self.name}")

    def _start_afresh(self) -> None:
        """Start the named stream of random numbers, and the drift at a moment that it names."""
        light = f"{self._rig.ambient:.6g} {self._rig.exposure}"
        name = f"{self._place_name} {self._distance_m:.6f} {light}"
        self._rng = np.random.default_rng([self.seed, zlib.crc32(name.encode())])
        self._color_rng = np.random.default_rng([self.seed, zlib.crc32(name.encode()), 1])
        self._drift_from_s = self._rng.uniform(0.0, 1000.0 * DRIFT_TIME_S)
        self._since_placed_s = 0.0


@lru_cache(maxsize=32)
def _scene(name: str, distance_m: float) -> Scene:
    """The scene of this name; the same object each time, so that it is rendered once."""
    return SCENES[name](distance_m)


@lru_cache(maxsize=6)
def _view(rig: Rig, scene: Scene) -> RigView:
    """The rig before a scene, 8 MB: who goes back to a distance does not wait for it again."""
    return rig.look_at(scene)


@lru_cache(maxsize=4)
def _color_image(scene: Scene, device: str, lens: Intrinsics) -> Image:
    """The colour image (h, w, 3) of a scene through this lens, without noise."""
    T_color_depth = specifications.device(device).unit.T_color_depth
    return render(scene, lens, invert_transform(T_color_depth)).color


def _hidden_truth(seed: int, unit: Unit) -> HiddenTruth:
    rng = np.random.default_rng([seed, zlib.crc32(b"hidden truth")])
    error = rng.choice([-1.0, 1.0]) * rng.uniform(*BASELINE_ERROR)
    offset_px = OFFSET_PX * rng.standard_normal()
    baselines_m = unit.baseline_m * (1.0 + error), unit.baseline_m
    lenses = _true_lens(seed, unit.color), unit.color
    return HiddenTruth(*baselines_m, float(offset_px), DRIFT_PX, DRIFT_TIME_S, *lenses)


def _true_lens(seed: int, reported: Intrinsics) -> Intrinsics:
    """The colour lens of the unit that this seed names."""
    rng = np.random.default_rng([seed, zlib.crc32(b"colour lens")])
    scale, aspect = 1 + FOCAL_ERROR * rng.standard_normal(), ASPECT_ERROR * rng.standard_normal()
    dx, dy = CENTRE_ERROR_PX * rng.standard_normal(2)
    radial = [mean + std * rng.standard_normal() for mean, std in LENS_SPREAD]
    missed = [*radial, *(TANGENTIAL * rng.standard_normal(2)), 0.0]
    fx, fy = reported.fx * scale * (1 + aspect), reported.fy * scale * (1 - aspect)
    cx, cy = reported.cx + dx, reported.cy + dy
    coeffs = tuple(np.add(reported.coeffs, missed).tolist())
    return replace(reported, fx=fx, fy=fy, cx=cx, cy=cy, model="brown_conrady", coeffs=coeffs)
