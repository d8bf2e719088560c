"""Rays against boxes, compiled by numba: which box, which face, where on it, and its colour.

A box is a row of 15 numbers: its centre (3) and half edge lengths (3) in metres, then the rotation
R_camera_box row by row (9). Rays and boxes are given in one frame, here the camera's.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit, prange

# No fastmath: a ray may be NaN (a pixel that no light reaches), and then it hits nothing.

AMBIENT, DIFFUSE, IN_SHADOW = 0.42, 0.58, 0.25
BACKGROUND = 0.08
GRID_M, GRID_LINE_M = 0.100, 0.003
PLANK_M, SEAM_M, GRAIN_PER_M = 0.110, 0.0012, 150.0
PLAIN, GRID, WOOD = 0, 1, 2  # as in scenes.TEXTURES


@njit(cache=True, error_model="numpy")
def enter_box(
    box: Any, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, int]:
    """Where the ray o + t d enters one box: (t, face), or (inf, -1) for a miss.

    Faces are numbered 0..5 = -x, +x, -y, +y, -z, +z of the box. A ray that starts inside the box
    does not enter it. Source: the slab test, Kay and Kajiya, SIGGRAPH 1986.
    """
    px, py, pz = ox - box[0], oy - box[1], oz - box[2]
    t_in, t_out, face = -math.inf, math.inf, -1
    for k in range(3):
        p = box[6 + k] * px + box[9 + k] * py + box[12 + k] * pz
        d = box[6 + k] * dx + box[9 + k] * dy + box[12 + k] * dz
        half = box[3 + k]
        if d == 0.0:
            if abs(p) > half:
                return math.inf, -1
            continue
        side = math.copysign(half, d)
        near, far = (-side - p) / d, (side - p) / d
        if near > t_in:
            t_in, face = near, 2 * k + (d < 0.0)
        t_out = min(t_out, far)
    if t_in > 0.0 and t_in <= t_out:  # False for NaN
        return t_in, face
    return math.inf, -1


@njit(cache=True, error_model="numpy")
def nearest_hit(
    boxes: Any, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[float, int, int, float, float]:
    """The first surface on the ray o + t d: (t, box index, face, p, q), or (inf, -1, -1, 0, 0).

    boxes (N, 15): see the module. With dz = 1 in the camera frame, t is the depth Z in metres.
    (p, q) are surface coordinates: metres from the face's centre along the two remaining axes of
    the box in ascending order, (y, z), (x, z) or (x, y). Of two boxes at one t, the first wins.
    """
    t, index, face = math.inf, -1, -1
    for i in range(boxes.shape[0]):
        t_i, face_i = enter_box(boxes[i], ox, oy, oz, dx, dy, dz)
        if t_i < t:
            t, index, face = t_i, i, face_i
    if index < 0:
        return t, index, face, 0.0, 0.0
    box = boxes[index]
    x, y, z = ox + t * dx - box[0], oy + t * dy - box[1], oz + t * dz - box[2]
    first = 1 if face < 2 else 0
    second = 1 if face >= 4 else 2
    p = box[6 + first] * x + box[9 + first] * y + box[12 + first] * z
    q = box[6 + second] * x + box[9 + second] * y + box[12 + second] * z
    return t, index, face, p, q


@njit(cache=True, error_model="numpy")
def is_lit(
    boxes: Any, index: int, x: float, y: float, z: float, lx: float, ly: float, lz: float
) -> bool:
    """Whether no other box is between a lamp at (lx, ly, lz) and (x, y, z) on box `index`, m."""
    dx, dy, dz = x - lx, y - ly, z - lz
    for i in range(boxes.shape[0]):
        if i != index and enter_box(boxes[i], lx, ly, lz, dx, dy, dz)[0] < 1.0:
            return False
    return True


@njit(cache=True, error_model="numpy")
def texture_factor(texture: int, p: float, q: float, pixel_m: float) -> float:
    """The brightness, around 1, of a texture at (p, q) m, blurred to a pixel `pixel_m` wide."""
    if texture == GRID:
        off_p = abs(p - GRID_M * math.floor(p / GRID_M + 0.5))
        off_q = abs(q - GRID_M * math.floor(q / GRID_M + 0.5))
        off = min(off_p, off_q)
        return 1.0 - 0.16 * _line(off, GRID_LINE_M, pixel_m)
    if texture == WOOD:
        plank = math.floor(p / PLANK_M + 0.5)
        tone = (7.0 * plank) % 5.0 / 4.0  # 0..1, fixed for each plank
        phase = 2.0 * math.pi * (GRAIN_PER_M * p + 1.2 * math.sin(5.0 * q + 9.0 * tone))
        fade = 1.0 / (1.0 + (2.0 * GRAIN_PER_M * pixel_m) ** 2)
        grain = math.sin(phase) + 0.6 * math.sin(0.37 * phase + tone)
        seam = _line(PLANK_M / 2 - abs(p - plank * PLANK_M), SEAM_M, pixel_m)
        return (0.90 + 0.14 * tone + 0.035 * fade * grain) * (1.0 - 0.35 * seam)
    return 1.0


@njit(cache=True, error_model="numpy")
def _line(off: float, width: float, pixel_m: float) -> float:
    """How much of a pixel, 0..1, a line covers whose middle is `off` away."""
    overlap = min(off + pixel_m / 2, width / 2) - max(off - pixel_m / 2, -width / 2)
    return max(0.0, overlap / pixel_m)


@njit(cache=True, error_model="numpy", parallel=True)
def render_depth(boxes: Any, rays: Any, depth: Any, object_index: Any) -> None:
    """Write Z in m (0: nothing hit) and the box's index (-1) for rays (H, W, 3) at Z = 1."""
    for v in prange(rays.shape[0]):
        for u in range(rays.shape[1]):
            t, index, _, _, _ = nearest_hit(
                boxes, 0.0, 0.0, 0.0, rays[v, u, 0], rays[v, u, 1], rays[v, u, 2]
            )
            depth[v, u] = t if index >= 0 else 0.0
            object_index[v, u] = index


@njit(cache=True, error_model="numpy", parallel=True)
def render_color(
    boxes: Any, paint: Any, textures: Any, corners: Any, lamp: Any, pixel: float, out: Any
) -> None:
    """Write shaded colours (H, W, 3) uint8, the mean of 2x2 rays a pixel.

    corners (H + 1, W + 1, 3): the rays at the pixels' corners, at Z = 1. paint (N, 3): 0..1.
    textures (N,): codes. lamp (3,): m. pixel: the width of a pixel at Z = 1.
    """
    for v in prange(out.shape[0]):
        for u in range(out.shape[1]):
            red, green, blue = 0.0, 0.0, 0.0
            for sample in range(4):
                a, b = 0.25 + 0.5 * (sample % 2), 0.25 + 0.5 * (sample // 2)
                dx = _between(corners, v, u, 0, a, b)
                dy = _between(corners, v, u, 1, a, b)
                light, index = _shade(boxes, textures, dx, dy, lamp, pixel)
                if index < 0:
                    red, green, blue = red + light, green + light, blue + light
                else:
                    red += light * paint[index, 0]
                    green += light * paint[index, 1]
                    blue += light * paint[index, 2]
            out[v, u, 0] = int(min(255.0, 63.75 * red + 0.5))
            out[v, u, 1] = int(min(255.0, 63.75 * green + 0.5))
            out[v, u, 2] = int(min(255.0, 63.75 * blue + 0.5))


@njit(cache=True, error_model="numpy")
def _between(corners: Any, v: int, u: int, k: int, a: float, b: float) -> float:
    """Component k of the ray at (a, b) of the way across and down pixel (u, v), bilinear."""
    top = corners[v, u, k] * (1.0 - a) + corners[v, u + 1, k] * a
    bottom = corners[v + 1, u, k] * (1.0 - a) + corners[v + 1, u + 1, k] * a
    return top * (1.0 - b) + bottom * b


@njit(cache=True, error_model="numpy")
def _shade(
    boxes: Any, textures: Any, dx: float, dy: float, lamp: Any, pixel: float
) -> tuple[float, int]:
    """Lambert's cosine law at what the ray (dx, dy, 1) hits: (brightness, box index)."""
    t, index, face, p, q = nearest_hit(boxes, 0.0, 0.0, 0.0, dx, dy, 1.0)
    if index < 0:
        return BACKGROUND, -1
    axis, sign = face // 2, 2.0 * (face % 2) - 1.0
    x, y, z = t * dx, t * dy, t
    lx, ly, lz = lamp[0] - x, lamp[1] - y, lamp[2] - z
    nx, ny, nz = boxes[index, 6 + axis], boxes[index, 9 + axis], boxes[index, 12 + axis]
    cosine = sign * (nx * lx + ny * ly + nz * lz)
    cosine = max(0.0, cosine) / math.sqrt(lx * lx + ly * ly + lz * lz)
    if cosine > 0.0 and not is_lit(boxes, index, x, y, z, lamp[0], lamp[1], lamp[2]):
        cosine *= IN_SHADOW
    return (AMBIENT + DIFFUSE * cosine) * texture_factor(textures[index], p, q, t * pixel), index
