"""A printed sheet on a table as one camera sees it, compiled by numba.

Sheet frame: origin in the pattern's top-left corner, x right, y down, z into the sheet, metres. A
pose is a row of 12 numbers in that frame: where the camera is (3), then the rotation that takes a
ray of the camera there, row by row (9).
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit, prange

from coursekit.simulation.raycast import WOOD, texture_factor

SAMPLES = 64  # points of a lattice in a pixel that sees an edge: an edge moves by 1/64 px
STEP_V, STEP_T = 19, 27  # of that lattice down the pixel and in time, where across it steps by 1
BOW_STEPS = 4  # each leaves a few hundredths of the error, for a bow's slope is small
SHADOW, SHADOW_M = 0.35, 0.006  # beside the sheet, on the table
WALL_M = 4.0  # the table ends so far away


@njit(cache=True, error_model="numpy")
def meet(pose: Any, bow: Any, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Where the ray (x, y, 1) meets the plane z with a bow on it: (X, Y, Z in the camera's frame).

    bow (4,): its middle in X and Y, its height there, and 1 / the square of the distance from the
    middle where it is zero. Z is not positive, or NaN, where there is no such point.
    """
    dx = pose[3] * x + pose[4] * y + pose[5]
    dy = pose[6] * x + pose[7] * y + pose[8]
    dz = pose[9] * x + pose[10] * y + pose[11]
    t = (z - pose[2]) / dz
    if bow[2] != 0.0:
        for _ in range(BOW_STEPS):
            across, down = pose[0] + t * dx - bow[0], pose[1] + t * dy - bow[1]
            height = bow[2] * (1.0 - (across * across + down * down) * bow[3])
            t = (z + height - pose[2]) / dz
    return pose[0] + t * dx, pose[1] + t * dy, t


@njit(cache=True, error_model="numpy", parallel=True)
def unroll(poses: Any, bow: Any, rays: Any, out: Any) -> None:
    """Write where the pixels' corners are on the sheet, (n, H + 1, W + 1, 2) m, NaN for nowhere.

    poses (n, 1 or H + 1, 12): at n moments of the exposure, of each row of corners where rows are
    exposed at different times. rays (H + 1, W + 1, 2): of the pixels' corners, at Z = 1.
    """
    for v in prange(rays.shape[0]):
        for moment in range(poses.shape[0]):
            pose = poses[moment, v] if poses.shape[1] > 1 else poses[moment, 0]
            for u in range(rays.shape[1]):
                X, Y, t = meet(pose, bow, rays[v, u, 0], rays[v, u, 1], 0.0)
                out[moment, v, u, 0] = X if t > 0.0 else math.nan
                out[moment, v, u, 1] = Y if t > 0.0 else math.nan


@njit(cache=True, error_model="numpy", parallel=True)
def light_up(
    poses: Any, rays: Any, corners: Any, sheet: Any, edges: Any, place: Any, pixel: float, out: Any
) -> None:
    """Write the light (H, W) on each pixel, the mean over its area and the exposure.

    poses, rays: see `unroll`. corners: what that wrote, for one moment or for start and end.
    sheet (rows, columns) float32: reflectance of the print and its margin. edges, alike: from each
    texel to the next one of another colour, texels. place (7,): where the sheet's corner is, in x
    and in y; texels a metre; the table's z and brightness; the lamp's place (3). pixel: its width
    at Z = 1.
    """
    for v in prange(out.shape[0]):
        pose = poses[0, v] if poses.shape[1] > 1 else poses[0, 0]
        for u in range(out.shape[1]):
            x, y = _middle(rays[v, u], rays[v, u + 1], rays[v + 1, u], rays[v + 1, u + 1])
            if not math.isfinite(x + y):
                out[v, u] = 0.0  # no light reaches a pixel beyond the fold of the distortion
                continue
            out[v, u] = _pixel(pose, corners, sheet, edges, place, x, y, v, u, pixel)


@njit(cache=True, error_model="numpy")
def _pixel(
    pose: Any,
    corners: Any,
    sheet: Any,
    edges: Any,
    place: Any,
    x: float,
    y: float,
    v: int,
    u: int,
    pixel: float,
) -> float:
    """The light on one pixel, whose middle's ray is (x, y, 1).

    Over so little, a point of the sheet moves linearly with the place in the pixel and with time:
    X = X + a XA + b XB + t XT, each of a, b and t from -1/2 to 1/2.
    """
    X, Y, XA, YA, XB, YB, XT, YT = _map(corners, v, u, place)
    if not math.isfinite(X + Y):
        return _table(pose, sheet, place, x, y, pixel)
    reach = 0.5 * math.sqrt((abs(XA) + abs(XB) + abs(XT)) ** 2 + (abs(YA) + abs(YB) + abs(YT)) ** 2)
    rows, columns = sheet.shape
    i, j = math.floor(Y), math.floor(X)
    if not (0 <= i < rows and 0 <= j < columns):
        if reach < max(-X, X - columns, -Y, Y - rows):
            return _table(pose, sheet, place, x, y, pixel)
    elif reach + 1.0 < edges[i, j]:
        return sheet[i, j] * _lamp(place, X / place[1] + place[0], Y / place[1] + place[0], 0.0)
    printed, count = 0.0, 0
    for k in range(SAMPLES):
        a = (k + 0.5) / SAMPLES - 0.5
        b = ((k * STEP_V) % SAMPLES + 0.5) / SAMPLES - 0.5
        t = ((k * STEP_T) % SAMPLES + 0.5) / SAMPLES - 0.5
        j = math.floor(X + a * XA + b * XB + t * XT)
        i = math.floor(Y + a * YA + b * YB + t * YT)
        if 0 <= i < rows and 0 <= j < columns:
            printed += sheet[i, j]
            count += 1
    light = printed * _lamp(place, X / place[1] + place[0], Y / place[1] + place[0], 0.0)
    if count < SAMPLES:
        light += (SAMPLES - count) * _table(pose, sheet, place, x, y, pixel)
    return light / SAMPLES


@njit(cache=True, error_model="numpy")
def _map(
    corners: Any, v: int, u: int, place: Any
) -> tuple[float, float, float, float, float, float, float, float]:
    """A pixel's middle on the sheet and its change across, down and in time, all in texels."""
    first, last = corners[0], corners[-1]
    X, Y = _middle(first[v, u], first[v, u + 1], first[v + 1, u], first[v + 1, u + 1])
    X_end, Y_end = _middle(last[v, u], last[v, u + 1], last[v + 1, u], last[v + 1, u + 1])
    p, q, r, s = first[v, u], first[v, u + 1], first[v + 1, u], first[v + 1, u + 1]
    scale = place[1]
    return (
        (0.5 * (X + X_end) - place[0]) * scale,
        (0.5 * (Y + Y_end) - place[0]) * scale,
        0.5 * (q[0] - p[0] + s[0] - r[0]) * scale,
        0.5 * (q[1] - p[1] + s[1] - r[1]) * scale,
        0.5 * (r[0] - p[0] + s[0] - q[0]) * scale,
        0.5 * (r[1] - p[1] + s[1] - q[1]) * scale,
        (X_end - X) * scale,
        (Y_end - Y) * scale,
    )


@njit(cache=True, error_model="numpy")
def _middle(p: Any, q: Any, r: Any, s: Any) -> tuple[float, float]:
    return 0.25 * (p[0] + q[0] + r[0] + s[0]), 0.25 * (p[1] + q[1] + r[1] + s[1])


@njit(cache=True, error_model="numpy")
def _table(pose: Any, sheet: Any, place: Any, x: float, y: float, pixel: float) -> float:
    """The light from the table behind the sheet, with the sheet's soft shadow on it.

    Its grain is faint and coarse: it is not blurred by motion.
    """
    dx = pose[3] * x + pose[4] * y + pose[5]
    dy = pose[6] * x + pose[7] * y + pose[8]
    dz = pose[9] * x + pose[10] * y + pose[11]
    t = (place[2] - pose[2]) / dz
    if not 0.0 < t < WALL_M:
        t = WALL_M
    X, Y = pose[0] + t * dx, pose[1] + t * dy
    beside = max(0.0, place[0] - X, X - place[0] - sheet.shape[1] / place[1])
    beyond = max(0.0, place[0] - Y, Y - place[0] - sheet.shape[0] / place[1])
    shadow = 1.0 - SHADOW * math.exp(-math.sqrt(beside**2 + beyond**2) / SHADOW_M)
    wood = texture_factor(WOOD, Y, X, t * pixel)
    return place[3] * wood * shadow * _lamp(place, X, Y, place[2])


@njit(cache=True, error_model="numpy")
def _lamp(place: Any, X: float, Y: float, z: float) -> float:
    """Lambert's law for a lamp above the sheet, 1 on the sheet straight below it."""
    dx, dy, dz = X - place[4], Y - place[5], z - place[6]
    squared = (dx * dx + dy * dy) / (dz * dz)
    return (place[6] / dz) ** 2 / ((1.0 + squared) * math.sqrt(1.0 + squared))
