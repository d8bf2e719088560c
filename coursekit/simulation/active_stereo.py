"""The active-stereo rig: two infrared eyes, a dot projector, and a matcher that knows no better.

Depth noise, holes, shadows, flying pixels and the minimum range are not put in anywhere: two
images are rendered, photons are counted, and what `match` makes of them is the depth image.

sigma_d, in this course, is the temporal standard deviation of one pixel's disparity: from frame to
frame, nothing moving. The spatial one, over the pixels of one frame about a plane, is larger: it
also holds what stays from frame to frame, the error of matching a sparse pattern through speckle.
"""

from __future__ import annotations

import math
import zlib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np

from coursekit.geometry import Intrinsics, pixel_grid
from coursekit.simulation.matching import match
from coursekit.simulation.render import box_table, check_scene, rays
from coursekit.simulation.scenes import TEXTURES, Scene

if TYPE_CHECKING:
    from numpy.typing import NDArray

# Plausible, not measured: no figure of this block was taken from a camera. They were chosen so
# that one pixel's disparity varies by about 0.08 px (the vendor's planning value) at low ambient;
# so were the defaults of Rig (electrons per grey level, read noise, room light) and match's gates.
PROJECTOR_AT = 0.4  # of the baseline, from the left eye
DOT_SPACING_PX = 9.0  # about 5,000 dots in the image
DOT_SIGMA_PX = 0.7
DOT_JITTER = 0.45  # of the spacing, to either side
DOT_FAINTEST = 0.6  # of the brightest
BETWEEN_DOTS = 0.05  # of a dot's peak
PATTERN_HALF_TAN = (1.20, 0.70)  # 100 x 70 degrees
AMBIENT_UNIT = 0.25  # of a dot's peak on white at 1 m: as bright as a dot's peak at 2 m
SPECULAR_EXPONENT = 60.0
CONTRAST = {"plain": 0.03, "grid": 0.03, "wood": 0.10}  # of a surface's fine texture
SPECKLE = 0.08  # std of the laser light, each eye its own
SPECKLE_SIGMA_PX = 0.6
LENS_SIGMA_PX = 0.5  # blur
GREY_PER_MS = 100.0  # exposed to unit light
LONGEST_MS = 33.0  # auto exposure ends where the next frame begins
METERED = (0.25, 99.8)  # auto exposure: this part of the width and height, and this percentile
BRIGHT_GREY = 235.0  # ... of the left image come to this
BLACK_GREY = 4.0
PRNU, DSNU_GREY = 0.01, 0.5  # fixed pattern: std of the pixels' gain and of their offset

NOISE_TABLE = 1 << 20


@dataclass(frozen=True)
class Rig:
    """A pair of infrared eyes on one baseline, with or without a dot projector between them.

    What the device reports: left, the intrinsics of the left eye and of the depth image, without
    distortion; baseline_m. What is true and only the renderer knows: the baseline is longer by the
    part baseline_error; the right eye is turned so that disparities come out disparity_offset_px
    larger in the middle of the image; and this turn drifts with time with a standard deviation of
    drift_px and a correlation time of drift_time_s.
    ambient: room light, 1 is as bright on a surface as a dot's peak is at 2 m. exposure: ms, or
    "auto". electrons_per_grey: of the 8-bit image; fewer are noisier. read_noise_e: electrons.
    Raises ValueError for a figure out of range.
    """

    left: Intrinsics
    baseline_m: float
    projector: bool = True
    baseline_error: float = 0.0
    disparity_offset_px: float = 0.0
    drift_px: float = 0.0
    drift_time_s: float = 3.0
    electrons_per_grey: float = 2.0
    ambient: float = 0.01
    exposure: float | Literal["auto"] = "auto"
    read_noise_e: float = 4.5
    seed: int = 0

    def __post_init__(self) -> None:
        if self.left.dist is not None:
            raise ValueError(f"left: got coefficients {self.left.coeffs}, want none: rectified")
        for name in ("baseline_m", "drift_time_s", "electrons_per_grey"):
            _check(name, getattr(self, name), "a positive number", 0.0, strictly=True)
        for name in ("drift_px", "ambient", "read_noise_e"):
            _check(name, getattr(self, name), "a number of at least 0", 0.0)
        _check("disparity_offset_px", self.disparity_offset_px, "a finite number")
        _check("baseline_error", self.baseline_error, "a number above -1", -1.0, strictly=True)
        if self.exposure != "auto":
            _check("exposure", self.exposure, '"auto" or a positive number', 0.0, strictly=True)

    def look_at(self, scene: Scene) -> View:
        """Both eyes' views of a scene, rendered once; another scene costs about 0.4 s.

        Raises ValueError for a wrong scene and for a camera inside a box.
        """
        check_scene(scene)
        return View(self, tuple(scene))

    def drift(self, time_s: float) -> float:
        """The right eye's turn at this time, px of disparity: the same at the same time.

        A sum of cosines with the frequencies of exponentially correlated noise (random Fourier
        features, Rahimi and Recht, 2007): autocorrelation exp(-|dt| / drift_time_s).
        """
        frequencies, phases = _drift_spectrum(self.seed)
        angles = frequencies * (time_s / self.drift_time_s) + phases
        return float(self.drift_px * math.sqrt(2 / len(phases)) * np.cos(angles).sum())


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """What the rig delivers each time: left, right (H, W) uint8; disparity (H, W) float32 px, 0
    where there is none."""

    left: NDArray[np.uint8]
    right: NDArray[np.uint8]
    disparity: NDArray[np.float32]


class View:
    """A rig in front of a scene that stands still.

    exposure_ms: of every frame, ms. truth_m: the exact depth.
    """

    def __init__(self, rig: Rig, scene: Scene) -> None:
        self.rig, self.scene = rig, scene
        eyes = _light(
            scene,
            rig.left,
            rig.baseline_m,
            rig.baseline_error,
            rig.disparity_offset_px,
            rig.projector,
            rig.seed,
        )
        radiance = [laser + np.float32(rig.ambient * AMBIENT_UNIT) * room for laser, room in eyes]
        self.exposure_ms = _metered(radiance[0]) if rig.exposure == "auto" else rig.exposure
        grey = [np.float32(GREY_PER_MS * self.exposure_ms) * image for image in radiance]
        rng = np.random.default_rng([rig.seed, 1])  # these eyes' fixed pattern
        gain = 1 + np.float32(PRNU) * rng.standard_normal((2, *grey[0].shape), np.float32)
        offset = np.float32(DSNU_GREY) * rng.standard_normal(gain.shape, np.float32)
        self._mean = gain * np.stack(grey) + offset + np.float32(BLACK_GREY)
        self._slope = gain[1] * _yaw_slope(grey[1], rig.left)
        electrons = np.float32(rig.electrons_per_grey) * np.stack(grey)
        noise_e = np.sqrt(electrons + np.float32(rig.read_noise_e**2))
        self._sigma = noise_e / np.float32(rig.electrons_per_grey)

    def frame(self, rng: np.random.Generator, time_s: float = 0.0) -> StereoFrame:
        """The next pair of images at this time, and what the matcher makes of it.

        The drift turns the right eye by a shift of its mean image, to first order, with the yaw's
        own pattern: (1 + x^2, x y) times as far at (x, y, 1). Against an eye rendered anew at that
        yaw, the disparity moves 5 % too far (0.001 px for 0.02), for the shift takes the speckle
        along.
        """
        left, right = self.images(rng, time_s)
        return StereoFrame(left, right, match(left, right))

    def images(
        self, rng: np.random.Generator, time_s: float = 0.0
    ) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """The next pair of images (H, W) uint8 alone, with photon and read noise."""
        from coursekit.simulation import infrared

        pair = np.empty(self._mean.shape, np.uint8)
        table = _noise_table()
        rows = rng.integers(0, NOISE_TABLE - self.rig.left.width, pair.shape[:2])
        drift = self.rig.drift(time_s)
        infrared.expose(self._mean, self._slope, drift, self._sigma, table, rows, pair)
        return pair[0], pair[1]

    def depth(self, frame: StereoFrame, depth_scale_m: float = 0.001) -> NDArray[np.uint16]:
        """The frame's depth (H, W) in counts of depth_scale_m, by the baseline the device reports.

        0 where there is no disparity and beyond 65,535 counts.
        """
        return counts(frame.disparity, self.rig.left.fx, self.rig.baseline_m, depth_scale_m)

    @cached_property
    def truth_m(self) -> NDArray[np.float64]:
        """The exact Z (H, W) of what the left eye's pixel centres see, m, 0 where there is none."""
        from coursekit.simulation import raycast

        left = self.rig.left
        truth, index = np.empty(left.size[::-1]), np.empty(left.size[::-1], np.int16)
        raycast.render_depth(
            box_table(self.scene, None), rays(left, pixel_grid(*left.size)), truth, index
        )
        return truth


def counts(
    disparity: NDArray[np.float32], fx: float, baseline_m: float, depth_scale_m: float
) -> NDArray[np.uint16]:
    """Depth fx baseline / disparity (H, W), rounded to counts of depth_scale_m; 0 is invalid."""
    _check("depth_scale_m", depth_scale_m, "a positive number of metres", 0.0, strictly=True)
    with np.errstate(divide="ignore"):
        depth = np.float32(fx * baseline_m / depth_scale_m) / disparity
    depth += np.float32(0.5)
    depth[~(depth < 65536)] = 0
    return depth.astype(np.uint16)


@lru_cache(maxsize=2)
def _light(
    scene: Scene,
    left: Intrinsics,
    baseline_m: float,
    baseline_error: float,
    offset_px: float,
    projector: bool,
    seed: int,
) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """(laser, room) light (H, W) on each eye, of unit brightness, blurred by the lens."""
    from coursekit.simulation import infrared

    boxes = box_table(scene, None)
    skins = np.array(
        [
            (np.mean(b.color), b.specular, CONTRAST[b.texture], TEXTURES.index(b.texture))
            for b in scene
        ]
    ).reshape(-1, 4)
    place = np.array([PROJECTOR_AT * baseline_m, 0.0, 0.0, float(projector)])
    lens = np.array([left.fx, left.fy, left.cx, left.cy])
    dots, pattern = _pattern(left.fx)
    yaw = math.atan(offset_px / left.fx)
    turn = np.array(
        [[math.cos(yaw), 0, math.sin(yaw)], [0, 1, 0], [-math.sin(yaw), 0, math.cos(yaw)]]
    )
    # Another scene, another speckle; the same scene, the same.
    rng = np.random.default_rng([seed, zlib.crc32(boxes.tobytes())])
    eyes = []
    for eye, facing in ((0.0, np.eye(3)), (baseline_m * (1 + baseline_error), turn)):
        laser, room = (np.empty(left.size[::-1], np.float32) for _ in range(2))
        infrared.render_eye(
            boxes, skins, np.array([eye, 0.0, 0.0]), facing, lens, place, dots, pattern, _grain(),
            laser, room,
        )  # fmt: skip
        laser *= 1 + np.float32(SPECKLE) * _speckle(rng, laser.shape)
        eyes.append((_blurred(laser, LENS_SIGMA_PX), _blurred(room, LENS_SIGMA_PX)))
    return eyes


def _metered(radiance: NDArray[np.float32]) -> float:
    """The exposure in ms that makes the dots in the middle bright and hardly saturated."""
    part, percentile = METERED
    rows, columns = (
        slice(round((1 - part) / 2 * n), round((1 + part) / 2 * n)) for n in radiance.shape
    )
    bright = float(np.percentile(radiance[rows, columns], percentile))
    return min(LONGEST_MS, BRIGHT_GREY / (GREY_PER_MS * bright)) if bright > 0 else LONGEST_MS


def _yaw_slope(image: NDArray[np.float32], left: Intrinsics) -> NDArray[np.float32]:
    """The change of an eye's image (H, W) per pixel of disparity offset that a yaw makes."""
    kernel = np.array([[1, -8, 0, 8, -1]], np.float32) / 12
    along = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    down = cv2.filter2D(image, -1, kernel.T, borderType=cv2.BORDER_REPLICATE)
    x = ((np.arange(left.width) - left.cx) / left.fx).astype(np.float32)
    y = ((np.arange(left.height) - left.cy) / left.fy).astype(np.float32)[:, None]
    return (1 + x * x) * along + x * y * down


@lru_cache(maxsize=4)
def _pattern(fx: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The projector's dots and pattern as `infrared.dot_light` wants them; one for every unit."""
    rng = np.random.default_rng(20)
    cell = DOT_SPACING_PX / fx
    columns, rows = (2 * math.ceil(half / cell) for half in PATTERN_HALF_TAN)
    j, i = np.indices((rows, columns))
    dots = np.stack(
        [
            (i + 0.5 - columns / 2 + rng.uniform(-DOT_JITTER, DOT_JITTER, i.shape)) * cell,
            (j + 0.5 - rows / 2 + rng.uniform(-DOT_JITTER, DOT_JITTER, i.shape)) * cell,
            rng.uniform(DOT_FAINTEST, 1.0, i.shape),
        ],
        axis=-1,
    )
    return dots, np.array([cell, DOT_SIGMA_PX / fx, BETWEEN_DOTS, SPECULAR_EXPONENT])


@lru_cache(maxsize=1)
def _grain(size: int = 512, levels: int = 6) -> NDArray[np.float32]:
    """A tile of 1/f texture of unit std (levels, size, size), each level blurred twice as far."""
    rng = np.random.default_rng(3)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.rfftfreq(size), indexing="ij"))
    spectrum = np.fft.rfft2(rng.standard_normal((size, size)))
    spectrum /= np.where(frequency > 0, frequency, np.inf)
    blurs = [0.4 * 2**level if level else 0.0 for level in range(levels)]
    tiles = [
        np.fft.irfft2(spectrum * np.exp(-2 * (np.pi * frequency * blur) ** 2)) for blur in blurs
    ]
    return (np.stack(tiles) / tiles[0].std()).astype(np.float32)


def _speckle(rng: np.random.Generator, shape: tuple[int, ...]) -> NDArray[np.float32]:
    noise = _blurred(rng.standard_normal(shape, np.float32), SPECKLE_SIGMA_PX)
    return noise / noise.std()


def _blurred(image: NDArray[np.float32], sigma_px: float) -> NDArray[np.float32]:
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.float32)


@lru_cache(maxsize=1)
def _noise_table() -> NDArray[np.float32]:
    """Normal numbers to be read from a random place for each row: twenty times faster than new
    ones, and two frames share a row's numbers once in a million."""
    return np.random.default_rng(4).standard_normal(NOISE_TABLE, np.float32)


@lru_cache(maxsize=16)
def _drift_spectrum(seed: int, terms: int = 64) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Frequencies (rad per correlation time) of a Lorentzian spectrum, and phases."""
    rng = np.random.default_rng([seed, 2])
    quantile = (np.arange(terms) + rng.random(terms)) / terms
    return np.tan(np.pi / 2 * quantile), rng.uniform(0, 2 * np.pi, terms)


def _check(
    name: str, value: float, wanted: str, least: float = -math.inf, strictly: bool = False
) -> None:
    number = isinstance(value, (int, float, np.number)) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or value < least or (strictly and value == least):
        raise ValueError(f"{name}: got {value!r}, want {wanted}")
