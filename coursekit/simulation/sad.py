"""Sums of absolute differences, compiled by numba: the loops of `matching`.

The inner loops run along a row of unsigned 16-bit numbers, without branches, so that the compiler
makes vector instructions of them; what a band of rows works on stays in the processor's cache.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

HALF = 5  # windows of 11x11 px; as in matching
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
    column on the left for every disparity above 0. For the rest see `matching.match`.
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
    for x in range(column.size):
        column[x] = np.uint16(column[x] + (max(a[x], b[x]) - min(a[x], b[x])))


@njit(cache=True)
def _move_row(column: Any, a: Any, b: Any, old_a: Any, old_b: Any) -> None:
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
