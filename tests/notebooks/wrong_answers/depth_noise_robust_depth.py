"""Wrong answers to `robust_depth` of notebook 02."""

import math
import statistics

import numpy as np

from wrong_answers import wrong


def _median(valid, min_valid):
    return float(np.median(valid)) if valid.size >= min_valid else float("nan")


def slices(depth_m, u, v, half=2, min_valid=5):
    H, W = depth_m.shape
    row, column = round(v), round(u)
    top, bottom = max(row - half, 0), max(min(row + half + 1, H), 0)
    left, right = max(column - half, 0), max(min(column + half + 1, W), 0)
    patch = depth_m[top:bottom, left:right]
    valid = patch[np.isfinite(patch) & (patch > 0)]
    return _median(valid, min_valid)


def loop_over_lists(depth_m, u, v, half=2, min_valid=5):
    H, W = depth_m.shape
    found = []
    for row in range(round(v) - half, round(v) + half + 1):
        for column in range(round(u) - half, round(u) + half + 1):
            if 0 <= row < H and 0 <= column < W:
                z = depth_m[row, column]
                if 0 < z < math.inf:
                    found.append(z)
    return statistics.median(found) if len(found) >= min_valid else math.nan


@wrong("border_repeated")
def padded_with_the_edge(depth_m, u, v, half=2, min_valid=5):
    image = np.pad(depth_m, 20, mode="edge")
    row, column = round(v) + 20, round(u) + 20
    patch = image[row - half : row + half + 1, column - half : column + half + 1]
    return _median(patch[np.isfinite(patch) & (patch > 0)], min_valid)


@wrong("pixel_alone")
def the_pixel_itself_if_it_is_valid(depth_m, u, v, half=2, min_valid=5):
    row, column = round(v), round(u)
    inside = 0 <= row < depth_m.shape[0] and 0 <= column < depth_m.shape[1]
    if inside and np.isfinite(depth_m[row, column]) and depth_m[row, column] > 0:
        return depth_m[row, column]
    return slices(depth_m, u, v, half, min_valid)
