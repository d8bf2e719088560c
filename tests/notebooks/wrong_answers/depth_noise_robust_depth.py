"""Wrong answers to `robust_depth` of notebook 02."""

import math
import statistics

import numpy as np

from wrong_answers import changed, wrong


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


changed(
    slices,
    {
        # which pixel
        "round(v), round(u) -> round(u), round(v)": "u_v_swapped",
        "round(v), round(u) -> int(v), int(u)": "truncated",
        "round(v), round(u) -> np.array([v, u]).astype(int)": "truncated",
        "round(v), round(u) -> v, u": "raised",
        "round(v), round(u) -> math.ceil(v), math.ceil(u)": "rounded_up",
        # the window
        "row, column = -> half = 2\n    row, column =": "half_ignored",
        "row, column = -> half = half // 2\n    row, column =": "half_halved",
        "[top:bottom -> [row - half : row + half + 1 "
        "and left:right] -> column - half : column + half + 1]": "negative_index",
        "max(row - half, 0), max(min(row + half + 1, H), 0) -> row - half, min(row + half + 1, H) "
        "and max(column - half, 0), max(min(column + half + 1, W), 0) "
        "-> column - half, min(column + half + 1, W)": "negative_index",
        "[top:bottom -> [row - half : row + half + 1": "negative_index",
        "left:right] -> column - half : column + half + 1]": "negative_index",
        "max(min(row + half + 1, H), 0) -> row + half + 1 "
        "and max(min(column + half + 1, W), 0) -> column + half + 1": "negative_end",
        "round(v), round(u) -> np.clip(round(v), half, H - 1 - half), "
        "np.clip(round(u), half, W - 1 - half)": "moved_inside",
        "1, H) -> 1, H - 1) and 1, W) -> 1, W - 1)": "border_lost",
        "max(row - half, 0) -> min(max(row - half, 0), H - 1) and 1, H) -> 1, H - 1) "
        "and max(column - half, 0) -> min(max(column - half, 0), W - 1) and 1, W) -> 1, W - 1)": (
            "border_lost"
        ),
        "half + 1, H) -> half, H - 1) and half + 1, W) -> half, W - 1)": (
            "several, first last_missing"
        ),
        "H, W = -> W, H =": "height_width_swapped",
        "[top:bottom, left:right] -> [top:bottom, left:right] "
        "if min(row, column, H - 1 - row, W - 1 - column) >= half else np.array([])": (
            "border_refused"
        ),
        # which depths count
        " & (patch > 0) -> ": "zeros_counted",
        "np.isfinite(patch) & (patch > 0) -> patch != 0": "nan_counted",
        "np.isfinite(patch) & (patch > 0) -> patch > 0": "infinity_counted",
        "np.isfinite(patch) & (patch > 0) -> ~np.isnan(patch) & (patch != 0)": "infinity_counted",
        "np.isfinite(patch) & (patch > 0) -> ~np.isnan(patch)": "several, first zeros_counted",
        "valid, min_valid) -> valid, 1)": "min_valid_ignored",
        "valid, min_valid) -> valid, 5)": "min_valid_fixed",
        "valid, min_valid) -> valid, min_valid + 1)": "one_too_strict",
        "valid, min_valid) -> valid, 1) if patch.size >= min_valid else math.nan": (
            "all_pixels_counted"
        ),
        # what is returned
        "_median(valid, min_valid) -> np.median(valid) if valid.size >= min_valid else 0.0": (
            "zero_returned"
        ),
        "_median(valid, min_valid) -> valid.mean() if valid.size >= min_valid else np.nan": "mean",
        "half + 1, H) -> half, H) and half + 1, W) -> half, W) "
        "and _median(valid, min_valid) -> valid.mean() if valid.size >= min_valid else np.nan": (
            "several, first last_missing"
        ),
        "return -> if valid.size >= min_valid:\n        return": None,
        "_median(valid, min_valid) -> np.nanmedian(patch, axis=0)": None,
        "depth_m[top:bottom, left:right] -> depth_m.ravel()[top:bottom, left:right]": "raised",
        "H, W = -> depth_m[(depth_m == 0) | np.isinf(depth_m)] = np.nan\n    H, W =": "in_place",
        "return -> if depth_m[row, column] > 0:\n        return depth_m[row, column]\n    return": (
            "pixel_alone"
        ),
    },
)


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


changed(
    loop_over_lists,
    {
        "round(v) + half + 1 -> round(v) + half and round(u) + half + 1 -> round(u) + half": (
            "last_missing"
        ),
        "0 <= row < H -> row < H and 0 <= column < W -> column < W": "negative_index",
        "0 <= row < H -> True and 0 <= column < W -> True": "raised",
        "0 <= row < H -> True and 0 <= column < W -> True "
        "and depth_m[row, column] -> depth_m[row % H, column % W]": "modulo",
        "statistics.median(found) -> sum(found) / len(found)": "mean",
        "statistics.median(found) -> sorted(found)[len(found) // 2]": "one_of_the_middle_two",
        "statistics.median(found) -> statistics.median_low(found)": "one_of_the_middle_two",
    },
)


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
