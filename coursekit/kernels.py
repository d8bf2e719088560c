"""The per-pixel loops of geometry, compiled by numba; its cache is filled by `tools/warm_up.py`."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit

# No fastmath: these kernels write and compare NaN. No threads either: vectorised, one thread is
# faster than librealsense, and two wait for each other whenever the computer is busy.


@njit(cache=True)
def deproject_pinhole(
    depth: Any, scale: float, fx: float, fy: float, cx: float, cy: float, out: Any
) -> None:
    """Write the camera-frame points of `depth` (H, W) to `out` (H, W, 3), NaN where invalid."""
    height, width = depth.shape
    factor, nan = np.float32(scale), np.float32(np.nan)
    x = ((np.arange(width) - cx) / fx).astype(np.float32)
    y = ((np.arange(height) - cy) / fy).astype(np.float32)
    for v in range(height):
        # Two simple loops over a row are vectorised; one that does both is not.
        row = np.empty(width, np.float32)
        for u in range(width):
            z = np.float32(depth[v, u]) * factor
            row[u] = z if (z > 0) & (z < np.inf) else nan
        flat = out[v].reshape(3 * width)
        for u in range(width):
            flat[3 * u] = x[u] * row[u]
            flat[3 * u + 1] = y[v] * row[u]
            flat[3 * u + 2] = row[u]


@njit(cache=True)
def nearest_footprint(depth: Any, first: Any, last: Any, width: int, height: int) -> Any:
    """Fill each depth pixel's rectangle first..last (H, W, 2), in target px, nearest depth first.

    Returns (height, width) int64: the flat index of the depth pixel that won, -1 for none.
    """
    source = np.full((height, width), -1, np.int64)
    flat = depth.ravel()
    for v in range(depth.shape[0]):
        for u in range(depth.shape[1]):
            u0, v0, u1, v1 = first[v, u, 0], first[v, u, 1], last[v, u, 0], last[v, u, 1]
            in_view = u1 >= 0 and v1 >= 0 and u0 < width and v0 < height
            if not in_view:  # also where the depth is invalid: NaN compares false
                continue
            index = v * depth.shape[1] + u
            for y in range(max(0, int(v0)), min(height - 1, int(v1)) + 1):
                for x in range(max(0, int(u0)), min(width - 1, int(u1)) + 1):
                    if source[y, x] < 0 or flat[index] < flat[source[y, x]]:
                        source[y, x] = index
    return source
