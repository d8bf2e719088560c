"""The per-pixel loops of geometry, compiled by numba; `python -m coursekit.kernels` fills its cache."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

# No fastmath: these kernels write and compare NaN.


@njit(parallel=True, cache=True)
def deproject_pinhole(
    depth: Any, scale: float, fx: float, fy: float, cx: float, cy: float, out: Any
) -> None:
    """Write the camera-frame points of `depth` (H, W) to `out` (H, W, 3), NaN where invalid."""
    height, width = depth.shape
    nan = np.float32(np.nan)
    factor = np.float32(scale)
    x = ((np.arange(width) - cx) / fx).astype(np.float32)
    y = ((np.arange(height) - cy) / fy).astype(np.float32)
    for v in prange(height):
        for u in range(width):
            z = np.float32(depth[v, u]) * factor
            if not (z > 0 and z < np.inf):
                z = nan
            out[v, u, 0] = x[u] * z
            out[v, u, 1] = y[v] * z
            out[v, u, 2] = z


@njit(parallel=True, cache=True)
def scale_rays(depth: Any, scale: float, rays: Any, out: Any) -> None:
    """As `deproject_pinhole`, with the rays (H, W, 3) of a distorted camera at Z = 1."""
    height, width = depth.shape
    for v in prange(height):
        for u in range(width):
            z = depth[v, u] * scale
            if not (z > 0 and z < np.inf):
                z = np.nan
            for k in range(3):
                out[v, u, k] = rays[v, u, k] * z


@njit(cache=True)
def nearest_footprint(depth: Any, first: Any, last: Any, width: int, height: int) -> Any:
    """Fill each depth pixel's rectangle first..last (H, W, 2), in target px, nearest depth first.

    Returns (height, width) int64: the flat index of the depth pixel that won, -1 for none. As in
    librealsense, a rectangle that is not wholly inside the target is left out.
    """
    source = np.full((height, width), -1, np.int64)
    flat = depth.ravel()
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            u0, v0, u1, v1 = first[v, u, 0], first[v, u, 1], last[v, u, 0], last[v, u, 1]
            inside = u0 >= 0 and v0 >= 0 and u1 < width and v1 < height
            if not inside:  # also where the depth is invalid: NaN compares false
                continue
            index = v * depth.shape[1] + u
            for y in range(int(v0), int(v1) + 1):
                for x in range(int(u0), int(u1) + 1):
                    if source[y, x] < 0 or flat[index] < flat[source[y, x]]:
                        source[y, x] = index
    return source


def compile_all() -> None:
    """Call every kernel once with the types that the course uses, so that the cache holds them."""
    out = np.empty((2, 2, 3), np.float32)
    for dtype in (np.uint16, np.float32, np.float64):
        depth = np.ones((2, 2), dtype)
        deproject_pinhole(depth, 1.0, 1.0, 1.0, 0.0, 0.0, out)
        scale_rays(depth, 1.0, np.ones((2, 2, 3)), out)
    nearest_footprint(np.ones((2, 2)), np.zeros((2, 2, 2)), np.zeros((2, 2, 2)), 2, 2)


if __name__ == "__main__":
    compile_all()
