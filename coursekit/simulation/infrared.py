"""Infrared light on boxes as one eye of the rig sees it, compiled by numba.

Two images come out of one pass: what the dot projector lights and what the room lights, each for a
unit of light, so that a brighter room or another exposure needs no second pass. Boxes are the rows
of `raycast`, in the left eye's frame; a skin row is a box's diffuse albedo, its specular share, the
contrast of its fine texture and the code of its coarse one.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit, prange

from coursekit.simulation.raycast import is_lit, nearest_hit, texture_factor

TEXEL_M = 0.0005
SAMPLES = 2  # 2x2 rays a pixel: 1x1 distorts edges, 3x3 changes nothing that matters


@njit(cache=True, error_model="numpy", parallel=True)
def render_eye(
    boxes: Any,
    skins: Any,
    eye: Any,
    turn: Any,
    lens: Any,
    projector: Any,
    dots: Any,
    pattern: Any,
    grain: Any,
    laser: Any,
    ambient: Any,
) -> None:
    """Write the light that reaches each pixel, the mean of 2x2 rays.

    boxes (N, 15) and skins (N, 4): see the module. eye (3,): m. turn (3, 3): the eye's frame to the
    left eye's. lens (4,): fx, fy, cx, cy in px. projector (4,): its place in m and its power, 1 or
    0. dots and pattern: see `dot_light`. grain (levels, n, n): see `fine_texture`.
    laser, ambient (H, W) float32: 1 is a dot's peak on white at 1 m, and white in a unit of room
    light.
    """
    for v in prange(laser.shape[0]):
        for u in range(laser.shape[1]):
            from_laser, from_room = 0.0, 0.0
            for sample in range(SAMPLES * SAMPLES):
                x = (u + (sample % SAMPLES + 0.5) / SAMPLES - 0.5 - lens[2]) / lens[0]
                y = (v + (sample // SAMPLES + 0.5) / SAMPLES - 0.5 - lens[3]) / lens[1]
                dx = turn[0, 0] * x + turn[0, 1] * y + turn[0, 2]
                dy = turn[1, 0] * x + turn[1, 1] * y + turn[1, 2]
                dz = turn[2, 0] * x + turn[2, 1] * y + turn[2, 2]
                one, other = _shade(
                    boxes, skins, eye, dx, dy, dz, 1.0 / lens[0], projector, dots, pattern, grain
                )
                from_laser += one
                from_room += other
            laser[v, u] = from_laser / (SAMPLES * SAMPLES)
            ambient[v, u] = from_room / (SAMPLES * SAMPLES)


@njit(cache=True, error_model="numpy")
def _shade(
    boxes: Any,
    skins: Any,
    eye: Any,
    dx: float,
    dy: float,
    dz: float,
    pixel: float,
    projector: Any,
    dots: Any,
    pattern: Any,
    grain: Any,
) -> tuple[float, float]:
    """(laser light, room light) from what the ray eye + t (dx, dy, dz) hits; (0, 0) for nothing.

    Diffuse light follows Lambert's law; the specular share is a normalised Phong lobe about the
    mirror direction (Phong, CACM 1975; (n + 2) / 2 keeps its energy), and mirrors an even room.
    """
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
