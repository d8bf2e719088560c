"""The active-stereo rig: two infrared eyes, a dot projector, and a matcher that knows no better.

    scene -> light on each eye -> photons, read noise, 8 bits -> disparity by block matching -> z16

Depth noise, holes, shadows, flying pixels and the minimum range are not put in anywhere: two
images are rendered, photons are counted, and what `match` makes of them is the depth image.

sigma_d, in this course, is the temporal standard deviation of one pixel's disparity: from frame to
frame, nothing moving. The spatial one, over the pixels of one frame about a plane, is larger: it
also holds what stays from frame to frame, the error of matching a sparse pattern through speckle.

Light. Two images come out of one pass: what the dot projector lights and what the room lights, each
for a unit of light, so that a brighter room or another exposure needs no second pass. Boxes are the
rows of `raycast`, in the left eye's frame; a skin row is a box's diffuse albedo, its specular
share, the contrast of its fine texture and the code of its coarse one.

Matching. A window of the left image is compared with 127 windows of the right one; the disparity
is where the sum of absolute differences is least, refined below a pixel, and kept only where three
gates agree. Like any matcher it makes noise, holes and false matches of what it is given. Its inner
loops run along a row of unsigned 16-bit numbers, without branches, so that the compiler makes
vector instructions of them; what a band of rows works on stays in the processor's cache.
"""

from __future__ import annotations

import math
import os
import time
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numba import njit, prange

from coursekit.arrays import ArrayLike, Floats, Grey, NDArray
from coursekit.checks import number, positive, want
from coursekit.geometry import Intrinsics
from coursekit.simulation.raycast import is_lit, nearest_hit, texture_factor
from coursekit.simulation.scenes import TEXTURES, Scene, box_table, check_scene

FloatImage = NDArray[np.float32]  # (H, W)

# --- light, compiled by numba ---

TEXEL_M = 0.0005
RAYS_PER_SIDE = 2  # 2x2 rays a pixel: 1x1 distorts edges, 3x3 changes nothing that matters


@njit(cache=True, error_model="numpy", parallel=True)
def render_eye(
    boxes: Any, skins: Any, eye: Any, turn: Any, lens: Any, lamp: Any, laser: Any, ambient: Any
) -> None:
    """Write the light that reaches each pixel, the mean of 2x2 rays.

    boxes (N, 15) and skins (N, 4): see the module. eye (3,): m. turn (3, 3): the eye's frame to the
    left eye's. lens (4,): fx, fy, cx, cy in px. lamp: projector (4,), its place in m and its power,
    1 or 0; dots and pattern, see `dot_light`; grain (levels, n, n), see `fine_texture`.
    laser, ambient (H, W) float32: 1 is a dot's peak on white at 1 m, and white in a unit of room
    light.
    """
    for v in prange(laser.shape[0]):
        for u in range(laser.shape[1]):
            from_laser, from_room = 0.0, 0.0
            for sample in range(RAYS_PER_SIDE * RAYS_PER_SIDE):
                x = (u + (sample % RAYS_PER_SIDE + 0.5) / RAYS_PER_SIDE - 0.5 - lens[2]) / lens[0]
                y = (v + (sample // RAYS_PER_SIDE + 0.5) / RAYS_PER_SIDE - 0.5 - lens[3]) / lens[1]
                dx = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2]
                dy = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2]
                dz = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2]
                one, other = _shade(boxes, skins, eye, dx, dy, dz, 1.0 / lens[0], lamp)
                from_laser += one
                from_room += other
            laser[v, u] = from_laser / (RAYS_PER_SIDE * RAYS_PER_SIDE)
            ambient[v, u] = from_room / (RAYS_PER_SIDE * RAYS_PER_SIDE)


@njit(cache=True, error_model="numpy")
def _shade(
    boxes: Any, skins: Any, eye: Any, dx: float, dy: float, dz: float, pixel: float, lamp: Any
) -> tuple[float, float]:
    """(laser light, room light) from what the ray eye + t (dx, dy, dz) hits; (0, 0) for nothing.

    Diffuse light follows Lambert's law; the specular share is a normalised Phong lobe about the
    mirror direction (Phong, CACM 1975; (n + 2) / 2 keeps its energy), and mirrors an even room.
    """
    projector, dots, pattern, grain = lamp
    t, index, face, p, q = nearest_hit(boxes, eye[0], eye[1], eye[2], dx, dy, dz)
    if index < 0:
        return 0.0, 0.0
    x, y, z = eye[0] + t * dx, eye[1] + t * dy, eye[2] + t * dz
    albedo = skins[index, 0] * texture_factor(int(skins[index, 3]), p, q, t * pixel)
    albedo *= 1.0 + skins[index, 2] * fine_texture(grain, p, q, t * pixel, index)
    specular = skins[index, 1]
    room = (1.0 - specular) * albedo + specular
    lx, ly, lz = projector[0] - x, projector[1] - y, projector[2] - z
    distance = math.sqrt(lx * lx + ly * ly + lz * lz)
    axis, sign = face // 2, 2.0 * (face % 2) - 1.0
    nx, ny = sign * boxes[index, 6 + axis], sign * boxes[index, 9 + axis]
    nz = sign * boxes[index, 12 + axis]
    cosine = (nx * lx + ny * ly + nz * lz) / distance
    if projector[3] == 0.0 or cosine <= 0.0:
        return 0.0, room
    if not is_lit(boxes, index, x, y, z, projector[0], projector[1], projector[2]):
        return 0.0, room
    light = projector[3] * dot_light(dots, pattern, lx / lz, ly / lz) / distance**2
    reflected = (1.0 - specular) * albedo * cosine
    if specular > 0.0:
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        mirrored = 2.0 * cosine * (nx * dx + ny * dy + nz * dz)
        mirrored = -(mirrored - (lx * dx + ly * dy + lz * dz) / distance) / length
        shine = pattern[3]
        reflected += specular * (shine + 2.0) / 2.0 * max(0.0, mirrored) ** shine
    return light * reflected, room


@njit(cache=True, error_model="numpy")
def dot_light(dots: Any, pattern: Any, x: float, y: float) -> float:
    """The projector's light in the direction (x, y, 1) of its own frame: 1 at a dot's peak.

    dots (rows, columns, 3): one Gaussian dot a cell, its x and y at Z = 1 and its brightness.
    pattern (4,): edge of a cell, radius (sigma) of a dot, both at Z = 1; light between the dots;
    exponent of the specular lobe. Nothing is projected beyond the cells.
    """
    cell, sigma = pattern[0], pattern[1]
    rows, columns = dots.shape[0], dots.shape[1]
    column = math.floor(x / cell + columns / 2)
    row = math.floor(y / cell + rows / 2)
    if not (0 <= column < columns and 0 <= row < rows):
        return 0.0
    light = pattern[2]
    for j in range(max(0, row - 1), min(rows, row + 2)):
        for i in range(max(0, column - 1), min(columns, column + 2)):
            off = (x - dots[j, i, 0]) ** 2 + (y - dots[j, i, 1]) ** 2
            if off < (4.0 * sigma) ** 2:
                light += dots[j, i, 2] * math.exp(-off / (2.0 * sigma**2))
    return light


@njit(cache=True, error_model="numpy")
def fine_texture(grain: Any, p: float, q: float, pixel_m: float, index: int) -> float:
    """Texture of unit contrast at (p, q) m of box `index`, blurred to a pixel `pixel_m` wide.

    grain (levels, n, n): one tile of texels of 0.5 mm, each level blurred to twice the one before.
    """
    texels = pixel_m / TEXEL_M
    level = 0
    while level < grain.shape[0] - 1 and texels > 1.5:
        level, texels = level + 1, texels / 2.0
    x, y = p / TEXEL_M + 37.0 * index, q / TEXEL_M + 91.0 * index
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    last = grain.shape[1] - 1  # n is a power of two: & wraps round the tile
    i0, i1, j0, j1 = i & last, (i + 1) & last, j & last, (j + 1) & last
    image = grain[level]
    upper = image[j0, i0] * (1.0 - a) + image[j0, i1] * a
    lower = image[j1, i0] * (1.0 - a) + image[j1, i1] * a
    return upper * (1.0 - b) + lower * b


@njit(cache=True, error_model="numpy", parallel=True)
def expose(
    mean: Any, slope: Any, shift: float, sigma: Any, table: Any, starts: Any, out: Any
) -> None:
    """Write a pair of 8-bit images (2, H, W): the mean with normal noise, rounded and clipped.

    mean, sigma (2, H, W) float32: grey levels. slope (H, W): what one px of `shift` adds to the
    right eye's mean. table: normal numbers, starts (2, H): where in it each row's begin.
    """
    height, width = out.shape[1], out.shape[2]
    for row in prange(2 * height):
        eye, y = row // height, row % height
        start = starts[eye, y]
        turn = np.float32(shift) if eye == 1 else np.float32(0.0)
        for x in range(width):
            value = mean[eye, y, x] + turn * slope[y, x] + sigma[eye, y, x] * table[start + x]
            value = min(max(value + np.float32(0.5), np.float32(0.0)), np.float32(255.0))
            out[eye, y, x] = np.uint8(value)


# --- matching, compiled by numba ---

HALF = 5  # windows of 11x11 px
BAND = 40  # rows that one thread takes at a time


@njit(cache=True, parallel=True, error_model="numpy")
def match_bands(
    left: Any,
    right: Any,
    gradient: Any,
    uniqueness: int,
    texture: float,
    left_right: int,
    disparity: Any,
) -> None:
    """Write the disparity (H, W) px where all gates are open; bands of rows go to the threads.

    left, right: high-pass images with HALF rows and columns of padding, the right one with one more
    column on the left for every disparity above 0. For the rest see `match`.
    """
    height, width = disparity.shape
    candidates = right.shape[1] - left.shape[1] + 1
    for band in prange(-(-height // BAND)):
        first = band * BAND
        columns = np.zeros((candidates, width + 2 * HALF), np.uint16)  # sums over 11 rows
        costs = np.empty((candidates, width), np.uint16)
        two, four = np.empty_like(columns[0]), np.empty_like(columns[0])
        least, second = np.empty(width, np.uint16), np.empty(width, np.uint16)
        at = np.empty(width, np.uint16)
        for y in range(first, min(height, first + BAND)):
            least[:] = 65535
            at[:] = 0
            for d in range(candidates):
                start = candidates - 1 - d
                if y == first:
                    for row in range(y, y + 2 * HALF + 1):
                        _add_row(columns[d], left[row], right[row, start:])
                else:
                    new, old = y + 2 * HALF, y - 1
                    _move_row(
                        columns[d], left[new], right[new, start:], left[old], right[old, start:]
                    )
                _sum_windows(columns[d], two, four, costs[d])
                _keep_least(costs[d], d, least, at)
            second[:] = 65535
            for d in range(candidates):
                _keep_second(costs[d], d, at, second)
            _refine(costs, least, second, at, uniqueness, disparity[y])
            _close(disparity[y], least, at, gradient[y], texture, left_right)


@njit(cache=True)
def _add_row(column: Any, a: Any, b: Any) -> None:
    """Add |a - b| of a new row to the sums down the columns."""
    for x in range(column.size):
        column[x] = np.uint16(column[x] + (max(a[x], b[x]) - min(a[x], b[x])))


@njit(cache=True)
def _move_row(column: Any, a: Any, b: Any, old_a: Any, old_b: Any) -> None:
    """Add |a - b| of the row that comes in and take away that of the row that goes out."""
    for x in range(column.size):
        column[x] = np.uint16(
            column[x]
            + (max(a[x], b[x]) - min(a[x], b[x]))
            - (max(old_a[x], old_b[x]) - min(old_a[x], old_b[x]))
        )


@njit(cache=True)
def _sum_windows(column: Any, two: Any, four: Any, cost: Any) -> None:
    """Sums of 2 HALF + 1 = 11 = 4 + 4 + 2 + 1 neighbours."""
    for x in range(column.size - 1):
        two[x] = np.uint16(column[x] + column[x + 1])
    for x in range(column.size - 3):
        four[x] = np.uint16(two[x] + two[x + 2])
    for x in range(cost.size):
        cost[x] = np.uint16(four[x] + four[x + 4] + two[x + 8] + column[x + 10])


@njit(cache=True)
def _keep_least(cost: Any, d: int, least: Any, at: Any) -> None:
    """Keep the least cost of each pixel so far, and at which disparity it is."""
    code = np.uint16(d)
    for x in range(cost.size):
        better = np.uint16(0) - np.uint16(cost[x] < least[x])  # all bits or none
        at[x] = np.uint16(at[x] ^ ((at[x] ^ code) & better))
        least[x] = min(least[x], cost[x])


@njit(cache=True)
def _keep_second(cost: Any, d: int, at: Any, second: Any) -> None:
    """The least cost further than one step from the best candidate."""
    code = np.uint16(d)
    for x in range(cost.size):
        beside = np.uint16(at[x] + np.uint16(1) - code) <= np.uint16(2)
        second[x] = min(second[x], np.uint16(cost[x] | (np.uint16(0) - np.uint16(beside))))


@njit(cache=True, error_model="numpy")
def _refine(costs: Any, least: Any, second: Any, at: Any, uniqueness: int, out: Any) -> None:
    """Write sub-pixel disparities where the uniqueness gate is open and both neighbours exist."""
    for x in range(out.size):
        d, best = np.int64(at[x]), np.int64(least[x])
        inside = 0 < d < costs.shape[0] - 1 and x - d - HALF >= 1
        if not inside or np.int64(second[x]) * 100 < best * (100 + uniqueness):
            continue
        before, after = np.int64(costs[d - 1, x]), np.int64(costs[d + 1, x])
        rise = max(before, after) - best
        if rise > 0:
            out[x] = d + 0.5 * (before - after) / rise


@njit(cache=True)
def _close(out: Any, least: Any, at: Any, gradient: Any, texture: float, left_right: int) -> None:
    """Set to 0 what has no texture and what claims a right pixel that a better match has."""
    price = np.full(out.size, np.uint16(65535))
    claim = np.zeros(out.size, np.int64)
    for x in range(out.size):
        target = x - np.int64(at[x])
        if target >= 0 and least[x] < price[target]:
            price[target], claim[target] = least[x], at[x]
    for x in range(out.size):
        d = np.int64(at[x])
        if x < d or abs(claim[x - d] - d) > left_right or not gradient[x] > texture:
            out[x] = 0.0


# --- matching a pair of images ---

CANDIDATES = 127  # disparities 0..126 px; a match needs a neighbour on both sides: 1..125
CAP = 63  # of the high-pass image, grey levels to either side
_CROSS = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]], np.float32)


def match(
    left: ArrayLike,
    right: ArrayLike,
    uniqueness: int = 12,
    texture: float = 12.0,
    left_right: int = 1,
) -> FloatImage:
    """The disparity in px of every pixel of the left image, 0 where there is none.

    left, right (H, W) uint8: rectified, row v of one is row v of the other. A pixel at u in the
    left image is sought at u - d in the right one, d = 0..126.
    Gates: a second minimum must cost `uniqueness` per cent more; the mean Sobel gradient along the
    row in the window must exceed `texture` grey levels; and of two left pixels that claim one
    right pixel with disparities more than `left_right` px apart the worse match is dropped.
    Sub-pixel: equiangular lines through the three least costs (Shimizu and Okutomi, 2005).
    Raises ValueError for images that are not uint8, not 2-D, not equal in size, or too small.

    >>> scene = np.random.default_rng(0).integers(0, 256, (40, 80)).astype(np.uint8)
    >>> round(float(np.median(match(scene[:, :60], scene[:, 7:67])[10:30, 20:50])), 1)
    7.0
    """
    left, right = _pair(left, right)
    a = np.pad(high_pass(left), HALF)
    b = np.pad(high_pass(right), ((HALF, HALF), (HALF + CANDIDATES - 1, HALF)))
    gradient = cv2.convertScaleAbs(cv2.Sobel(left, cv2.CV_16S, 1, 0, ksize=3))
    gradient = cv2.boxFilter(gradient, -1, (2 * HALF + 1, 2 * HALF + 1))
    disparity = np.zeros(left.shape, np.float32)
    match_bands(a, b, gradient, uniqueness, texture, left_right, disparity)
    return disparity


def cost_curve(left: ArrayLike, right: ArrayLike, u: int, v: int) -> Floats:
    """The cost (127,) of matching the window about pixel (u, v) of the left image, by disparity.

    left, right (H, W) uint8 as for `match`; the cost is the sum of absolute differences of the
    high-pass images over 11x11 px, NaN for a disparity whose window leaves the right image.
    Raises ValueError as `match` does and for a window that leaves the left image.

    >>> scene = np.random.default_rng(0).integers(0, 256, (40, 80)).astype(np.uint8)
    >>> int(np.nanargmin(cost_curve(scene[:, :60], scene[:, 7:67], 40, 20)))
    7
    """
    left, right = _pair(left, right)
    height, width = left.shape
    inside = HALF <= u < width - HALF and HALF <= v < height - HALF
    want(inside, "u, v", (u, v), f"a window of {2 * HALF + 1} px inside {width}x{height} px")
    a, b = high_pass(left).astype(np.int64), high_pass(right).astype(np.int64)
    rows = slice(v - HALF, v + HALF + 1)
    window = a[rows, u - HALF : u + HALF + 1]
    costs = np.full(CANDIDATES, np.nan)
    for d in range(min(CANDIDATES, u - HALF + 1)):
        costs[d] = np.abs(window - b[rows, u - d - HALF : u - d + HALF + 1]).sum()
    return costs


def high_pass(image: Grey) -> Grey:
    """The image (H, W) less its local mean, times four, 63 for none and clipped at 0 and 126.

    The difference of a 3x3 cross-shaped smoothing and a 9x9 mean, as OpenCV's StereoBM does with
    PREFILTER_NORMALIZED_RESPONSE: what is left does not know about different brightness in the two
    eyes, and a saturated dot counts no more than an ordinary one.
    """
    smooth = cv2.filter2D(image, cv2.CV_16S, _CROSS)  # 8 times the mean of the cross
    mean = cv2.boxFilter(image, cv2.CV_16S, (9, 9))
    difference = np.asarray(cv2.scaleAdd(mean, -8.0, smooth), np.int16)
    return np.clip((difference >> 1) + CAP, 0, 2 * CAP).astype(np.uint8)


def _pair(left: ArrayLike, right: ArrayLike) -> tuple[Grey, Grey]:
    """Both images, contiguous; ValueError for what cannot be matched."""
    pair = []
    for name, image in (("left", left), ("right", right)):
        pixels = np.asarray(image)
        fits = pixels.dtype == np.uint8 and pixels.ndim == 2 and min(pixels.shape) > 2 * HALF
        got = pixels.dtype.name, pixels.shape
        want(fits, name, got, f"(H, W) uint8 of more than {2 * HALF} px either way")
        pair.append(np.ascontiguousarray(pixels))
    want(pair[0].shape == pair[1].shape, "right", pair[1].shape, f"{pair[0].shape} as the left one")
    return pair[0], pair[1]


# --- the rig ---

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
METERED = (0.375, 0.625), 99.8  # auto exposure: from, to of width and height; this percentile
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
        want(self.left.dist is None, "left", self.left.coeffs, "no coefficients: rectified")
        for name in ("baseline_m", "drift_time_s", "electrons_per_grey"):
            positive(name, getattr(self, name))
        for name in ("drift_px", "ambient", "read_noise_e"):
            number(name, getattr(self, name), "a number of at least 0", least=0.0)
        number("disparity_offset_px", self.disparity_offset_px)
        number("baseline_error", self.baseline_error, "a number above -1", above=-1.0)
        if self.exposure != "auto":
            positive("exposure", self.exposure, '"auto" or a positive number')

    def look_at(self, scene: Scene) -> RigView:
        """Both eyes' views of a scene, rendered once; another scene costs about 0.4 s.

        Raises ValueError for a wrong scene and for a camera inside a box.
        """
        check_scene(scene)
        _wait_while_compiled()
        return RigView(self, tuple(scene))

    def drift(self, time_s: float) -> float:
        """The right eye's turn at this time, px of disparity: the same at the same time.

        A sum of cosines with the frequencies of exponentially correlated noise (random Fourier
        features, Rahimi and Recht, 2007): autocorrelation exp(-|dt| / drift_time_s).
        """
        frequencies, phases = _drift_spectrum(self.seed)
        angles = frequencies * (time_s / self.drift_time_s) + phases
        return float(self.drift_px * math.sqrt(2 / len(phases)) * np.cos(angles).sum())


def _wait_while_compiled() -> None:
    """Say so, and wait, while `course.py lab` compiles this: to do it here as well takes longer."""
    mark, ends = Path(os.environ.get("COURSEKIT_COMPILING", "")), time.monotonic() + 300
    if mark.is_file():
        print("The fast parts are still being compiled, once, for a minute or so ...", flush=True)
    while mark.is_file() and time.monotonic() < ends:
        time.sleep(0.2)


@dataclass(frozen=True, eq=False)
class StereoFrame:
    """What the rig delivers each time: left, right (H, W) uint8; disparity (H, W) float32 px, 0
    where there is none."""

    left: Grey
    right: Grey
    disparity: FloatImage


class RigView:
    """A rig in front of a scene that stands still.

    exposure_ms: of every frame, ms.
    """

    def __init__(self, rig: Rig, scene: Scene) -> None:
        self.rig, self.scene = rig, scene
        eyes = _light(scene, replace(rig, ambient=0.0, exposure="auto"))  # for all of these at once
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

    def images(self, rng: np.random.Generator, time_s: float = 0.0) -> tuple[Grey, Grey]:
        """The next pair of images (H, W) uint8 alone, with photon and read noise."""
        pair = np.empty(self._mean.shape, np.uint8)
        table = _noise_table()
        rows = rng.integers(0, NOISE_TABLE - self.rig.left.width, pair.shape[:2])
        drift = self.rig.drift(time_s)
        expose(self._mean, self._slope, drift, self._sigma, table, rows, pair)
        return pair[0], pair[1]

    def depth(self, frame: StereoFrame, depth_scale_m: float = 0.001) -> NDArray[np.uint16]:
        """The frame's depth (H, W) in counts of depth_scale_m, by the baseline the device reports.

        0 where there is no disparity and beyond 65,535 counts.
        """
        return counts(frame.disparity, self.rig.left.fx, self.rig.baseline_m, depth_scale_m)


def counts(
    disparity: FloatImage, fx: float, baseline_m: float, depth_scale_m: float
) -> NDArray[np.uint16]:
    """Depth fx baseline / disparity (H, W), rounded to counts of depth_scale_m; 0 is invalid."""
    positive("depth_scale_m", depth_scale_m, "a positive number of metres")
    with np.errstate(divide="ignore"):
        depth = np.float32(fx * baseline_m / depth_scale_m) / disparity
    depth += np.float32(0.5)
    depth[~(depth < 65536)] = 0
    return depth.astype(np.uint16)


@lru_cache(maxsize=2)
def _light(scene: Scene, rig: Rig) -> list[tuple[FloatImage, FloatImage]]:
    """(laser, room) light (H, W) on each eye, of unit brightness, blurred by the lens."""
    boxes, left = box_table(scene, None), rig.left
    skins = np.empty((len(scene), 4))
    for skin, box in zip(skins, scene, strict=True):
        skin[:3] = np.mean(box.color), box.specular, CONTRAST[box.texture]
        skin[3] = TEXTURES.index(box.texture)
    place = np.array([PROJECTOR_AT * rig.baseline_m, 0.0, 0.0, float(rig.projector)])
    lens = np.array([left.fx, left.fy, left.cx, left.cy])
    lamp = (place, *_pattern(left.fx), _grain())
    yaw = math.atan(rig.disparity_offset_px / left.fx)
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    # Another scene, another speckle; the same scene, the same.
    rng = np.random.default_rng([rig.seed, zlib.crc32(boxes.tobytes())])
    eyes = []
    for eye, facing in ((0.0, np.eye(3)), (rig.baseline_m * (1 + rig.baseline_error), turn)):
        laser, room = (np.empty(left.size[::-1], np.float32) for _ in range(2))
        render_eye(boxes, skins, np.array([eye, 0.0, 0.0]), facing, lens, lamp, laser, room)
        grains = _blurred(rng.standard_normal(left.size[::-1], np.float32), SPECKLE_SIGMA_PX)
        laser *= 1 + np.float32(SPECKLE) * (grains / grains.std())
        eyes.append((_blurred(laser, LENS_SIGMA_PX), _blurred(room, LENS_SIGMA_PX)))
    return eyes


def _metered(radiance: FloatImage) -> float:
    """The exposure in ms that makes the dots in the middle bright and hardly saturated."""
    (low, high), percentile = METERED
    middle = tuple(slice(round(low * n), round(high * n)) for n in radiance.shape)
    bright = float(np.percentile(radiance[middle], percentile))
    return min(LONGEST_MS, BRIGHT_GREY / (GREY_PER_MS * bright)) if bright > 0 else LONGEST_MS


def _yaw_slope(image: FloatImage, left: Intrinsics) -> FloatImage:
    """The change of an eye's image (H, W) per pixel of disparity offset that a yaw makes."""
    kernel = np.array([[1, -8, 0, 8, -1]], np.float32) / 12
    along = cv2.filter2D(image, -1, kernel, borderType=cv2.BORDER_REPLICATE)
    down = cv2.filter2D(image, -1, kernel.T, borderType=cv2.BORDER_REPLICATE)
    x = ((np.arange(left.width) - left.cx) / left.fx).astype(np.float32)
    y = ((np.arange(left.height) - left.cy) / left.fy).astype(np.float32)[:, None]
    return (1 + x * x) * along + x * y * down


@lru_cache(maxsize=4)
def _pattern(fx: float) -> tuple[Floats, Floats]:
    """The projector's dots and pattern as `dot_light` wants them; one for every unit."""
    rng = np.random.default_rng(20)
    cell = DOT_SPACING_PX / fx
    columns, rows = (2 * math.ceil(half / cell) for half in PATTERN_HALF_TAN)
    j, i = np.indices((rows, columns))
    x = (i + 0.5 - columns / 2 + rng.uniform(-DOT_JITTER, DOT_JITTER, i.shape)) * cell
    y = (j + 0.5 - rows / 2 + rng.uniform(-DOT_JITTER, DOT_JITTER, i.shape)) * cell
    dots = np.stack([x, y, rng.uniform(DOT_FAINTEST, 1.0, i.shape)], axis=-1)
    return dots, np.array([cell, DOT_SIGMA_PX / fx, BETWEEN_DOTS, SPECULAR_EXPONENT])


@lru_cache(maxsize=1)
def _grain(size: int = 512, levels: int = 6) -> FloatImage:
    """A tile of 1/f texture of unit std (levels, size, size), each level blurred twice as far."""
    rng = np.random.default_rng(3)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.rfftfreq(size), indexing="ij"))
    spectrum = np.fft.rfft2(rng.standard_normal((size, size)))
    spectrum /= np.where(frequency > 0, frequency, np.inf)
    blurs = [0.4 * 2**level if level else 0.0 for level in range(levels)]
    decays = (np.exp(-2 * (np.pi * frequency * blur) ** 2) for blur in blurs)
    tiles = [np.fft.irfft2(spectrum * decay) for decay in decays]
    return (np.stack(tiles) / tiles[0].std()).astype(np.float32)


def _blurred(image: FloatImage, sigma_px: float) -> FloatImage:
    """An image (H, W) blurred by a Gaussian of this standard deviation."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), np.float32)


@lru_cache(maxsize=1)
def _noise_table() -> FloatImage:
    """Normal numbers to be read from a random place for each row: twenty times faster than new
    ones, and two frames share a row's numbers once in a million."""
    return np.random.default_rng(4).standard_normal(NOISE_TABLE, np.float32)


@lru_cache(maxsize=16)
def _drift_spectrum(seed: int, terms: int = 64) -> tuple[Floats, Floats]:
    """Frequencies (rad per correlation time) of a Lorentzian spectrum, and phases."""
    rng = np.random.default_rng([seed, 2])
    quantile = (np.arange(terms) + rng.random(terms)) / terms
    return np.tan(np.pi / 2 * quantile), rng.uniform(0, 2 * np.pi, terms)
