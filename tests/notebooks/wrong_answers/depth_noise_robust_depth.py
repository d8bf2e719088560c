"""Wrong answers to `robust_depth` of notebook 02."""

import math
import statistics

import numpy as np

from wrong_answers import wrong


def _rows_and_columns(depth_m, u, v, half):
    """The window's indices, cut off at the image: right."""
    height, width = depth_m.shape
    rows = [r for r in range(round(v) - half, round(v) + half + 1) if 0 <= r < height]
    columns = [c for c in range(round(u) - half, round(u) + half + 1) if 0 <= c < width]
    return rows, columns


def _patch(depth_m, u, v, half):
    return depth_m[np.ix_(*_rows_and_columns(depth_m, u, v, half))]


def _valid(patch):
    return patch[np.isfinite(patch) & (patch > 0)]


def _median(valid, min_valid):
    return float(np.median(valid)) if valid.size >= min_valid else float("nan")


# --- which pixel ---------------------------------------------------------------------------------


@wrong("u_v_swapped", "vectorised")
def u_for_the_row(depth_m, u, v, half=2, min_valid=5):
    return _median(_valid(_patch(depth_m, v, u, half)), min_valid)


@wrong("truncated", "vectorised")
def whole_pixels_by_int(depth_m, u, v, half=2, min_valid=5):
    return _median(_valid(_patch(depth_m, int(u), int(v), half)), min_valid)


@wrong("truncated", "slices with limits")
def cast_to_integers(depth_m, u, v, half=2, min_valid=5):
    column, row = np.array([u, v]).astype(int)
    top, left = max(row - half, 0), max(column - half, 0)
    patch = depth_m[top : max(row + half + 1, 0), left : max(column + half + 1, 0)]
    return _median(_valid(patch), min_valid)


@wrong(None, "slices", kind="raised")
def floats_in_a_slice(depth_m, u, v, half=2, min_valid=5):
    patch = depth_m[max(v - half, 0) : v + half + 1, max(u - half, 0) : u + half + 1]
    return _median(_valid(patch), min_valid)


@wrong(None, "vectorised")
def always_up(depth_m, u, v, half=2, min_valid=5):
    return _median(_valid(_patch(depth_m, math.ceil(u), math.ceil(v), half)), min_valid)


# --- the window ----------------------------------------------------------------------------------


@wrong("last_missing", "loop over lists")
def range_without_its_end(depth_m, u, v, half=2, min_valid=5):
    found = []
    for row in range(round(v) - half, round(v) + half):
        for column in range(round(u) - half, round(u) + half):
            if 0 <= row < depth_m.shape[0] and 0 <= column < depth_m.shape[1]:
                z = depth_m[row, column]
                if z > 0 and math.isfinite(z):
                    found.append(z)
    return statistics.median(found) if len(found) >= min_valid else math.nan


@wrong("half_ignored", "slices with limits")
def five_by_five_always(depth_m, u, v, half=2, min_valid=5):
    rows, columns = np.indices(depth_m.shape)
    near = (abs(rows - round(v)) < 3) & (abs(columns - round(u)) < 3)
    return _median(_valid(depth_m[near]), min_valid)


@wrong("half_halved", "vectorised")
def half_of_the_half(depth_m, u, v, half=2, min_valid=5):
    return _median(_valid(_patch(depth_m, u, v, half // 2)), min_valid)


@wrong("negative_index", "slices")
def slices_with_no_limits(depth_m, u, v, half=2, min_valid=5):
    v, u = np.rint([v, u]).astype(int)
    patch = depth_m[v - half : v + half + 1, u - half : u + half + 1]
    return _median(_valid(patch), min_valid)


@wrong("negative_index", "slices")
def slices_limited_at_the_far_end(depth_m, u, v, half=2, min_valid=5):
    height, width = depth_m.shape
    row, column = round(v), round(u)
    rows = slice(row - half, min(row + half + 1, height))
    columns = slice(column - half, min(column + half + 1, width))
    return _median(_valid(depth_m[rows, columns]), min_valid)


@wrong("negative_index", "loop over lists")
def pixels_beyond_the_far_end_skipped(depth_m, u, v, half=2, min_valid=5):
    found = []
    for dv in range(-half, half + 1):
        for du in range(-half, half + 1):
            try:
                z = depth_m[round(v) + dv, round(u) + du]
            except IndexError:
                continue
            if z > 0 and np.isfinite(z):
                found.append(z)
    return np.median(found) if len(found) >= min_valid else np.nan


@wrong(None, "loop over lists", kind="raised")
def pixels_beyond_the_far_end_taken(depth_m, u, v, half=2, min_valid=5):
    offsets = range(-half, half + 1)
    found = [depth_m[round(v) + dv, round(u) + du] for dv in offsets for du in offsets]
    return _median(_valid(np.array(found)), min_valid)


@wrong("negative_index", "slices with limits")
def only_columns_limited(depth_m, u, v, half=2, min_valid=5):
    row, column = round(v), round(u)
    left, right = np.clip([column - half, column + half + 1], 0, depth_m.shape[1])
    return _median(_valid(depth_m[row - half : row + half + 1, left:right]), min_valid)


@wrong("negative_index", "slices with limits")
def only_rows_limited(depth_m, u, v, half=2, min_valid=5):
    row, column = round(v), round(u)
    top, bottom = np.clip([row - half, row + half + 1], 0, depth_m.shape[0])
    return _median(_valid(depth_m[top:bottom, column - half : column + half + 1]), min_valid)


@wrong("negative_end", "slices with limits")
def begins_at_zero_at_least(depth_m, u, v, half=2, min_valid=5):
    row, column = round(v), round(u)
    patch = depth_m[max(0, row - half) : row + half + 1, max(0, column - half) : column + half + 1]
    return _median(_valid(patch), min_valid)


@wrong("moved_inside", "slices")
def a_whole_window_always(depth_m, u, v, half=2, min_valid=5):
    row = np.clip(round(v), half, depth_m.shape[0] - 1 - half)
    column = np.clip(round(u), half, depth_m.shape[1] - 1 - half)
    patch = depth_m[row - half : row + half + 1, column - half : column + half + 1]
    return _median(_valid(patch), min_valid)


@wrong("border_repeated", "padding")
def padded_with_the_edge(depth_m, u, v, half=2, min_valid=5):
    image = np.pad(depth_m, 20, mode="edge")
    row, column = round(v) + 20, round(u) + 20
    patch = image[row - half : row + half + 1, column - half : column + half + 1]
    return _median(_valid(patch), min_valid)


@wrong("border_lost", "slices with limits")
def limited_to_the_last_index(depth_m, u, v, half=2, min_valid=5):
    last_row, last_column = np.array(depth_m.shape) - 1
    top, bottom = np.clip([round(v) - half, round(v) + half + 1], 0, last_row)
    left, right = np.clip([round(u) - half, round(u) + half + 1], 0, last_column)
    return _median(_valid(depth_m[top:bottom, left:right]), min_valid)


@wrong("border_lost", "slices with limits")
def slice_ends_at_the_last_index(depth_m, u, v, half=2, min_valid=5):
    H, W = depth_m.shape
    v, u = round(v), round(u)
    rows = slice(max(v - half, 0), min(v + half + 1, H - 1))
    columns = slice(max(u - half, 0), min(u + half + 1, W - 1))
    return _median(_valid(depth_m[rows, columns]), min_valid)


@wrong("several, first last_missing", "slices with limits")
def last_index_taken_for_the_end(depth_m, u, v, half=2, min_valid=5):
    H, W = depth_m.shape
    v, u = round(v), round(u)
    patch = depth_m[
        max(v - half, 0) : min(v + half, H - 1), max(u - half, 0) : min(u + half, W - 1)
    ]
    return _median(_valid(patch), min_valid)


@wrong("modulo", "loop over lists")
def indices_modulo_the_size(depth_m, u, v, half=2, min_valid=5):
    H, W = depth_m.shape
    found = []
    for dv in range(-half, half + 1):
        for du in range(-half, half + 1):
            z = depth_m[(round(v) + dv) % H, (round(u) + du) % W]
            if 0 < z < np.inf:
                found.append(z)
    return statistics.median(found) if len(found) >= min_valid else math.nan


@wrong("height_width_swapped", "slices with limits")
def width_and_height_as_shape(depth_m, u, v, half=2, min_valid=5):
    width, height = depth_m.shape
    left, right = max(round(u) - half, 0), max(min(round(u) + half + 1, width), 0)
    top, bottom = max(round(v) - half, 0), max(min(round(v) + half + 1, height), 0)
    return _median(_valid(depth_m[top:bottom, left:right]), min_valid)


@wrong("border_refused", "slices")
def nothing_near_the_border(depth_m, u, v, half=2, min_valid=5):
    row, column = round(v), round(u)
    height, width = depth_m.shape
    if not (half <= row < height - half and half <= column < width - half):
        return np.nan
    patch = depth_m[row - half : row + half + 1, column - half : column + half + 1]
    return _median(_valid(patch), min_valid)


# --- which depths count --------------------------------------------------------------------------


@wrong("zeros_counted", "vectorised")
def every_finite_number(depth_m, u, v, half=2, min_valid=5):
    patch = _patch(depth_m, u, v, half)
    return _median(patch[np.isfinite(patch)], min_valid)


@wrong("nan_counted", "vectorised")
def everything_but_zero(depth_m, u, v, half=2, min_valid=5):
    patch = _patch(depth_m, u, v, half)
    return _median(patch[patch != 0], min_valid)


@wrong("infinity_counted", "vectorised")
def everything_above_zero(depth_m, u, v, half=2, min_valid=5):
    patch = _patch(depth_m, u, v, half)
    return _median(patch[patch > 0], min_valid)


@wrong("infinity_counted", "nanmedian")
def zeros_to_nan_in_a_copy(depth_m, u, v, half=2, min_valid=5):
    patch = np.where(_patch(depth_m, u, v, half) == 0, np.nan, _patch(depth_m, u, v, half))
    return np.nanmedian(patch) if np.count_nonzero(~np.isnan(patch)) >= min_valid else np.nan


@wrong("several, first zeros_counted", "nanmedian")
def only_nan_is_ignored(depth_m, u, v, half=2, min_valid=5):
    patch = _patch(depth_m, u, v, half)
    return np.nanmedian(patch) if np.sum(~np.isnan(patch)) >= min_valid else np.nan


@wrong("min_valid_ignored", "vectorised")
def any_valid_pixel_will_do(depth_m, u, v, half=2, min_valid=5):
    valid = _valid(_patch(depth_m, u, v, half))
    return np.median(valid) if valid.size else np.nan


@wrong("min_valid_fixed", "vectorised")
def five_at_least(depth_m, u, v, half=2, min_valid=5):
    return _median(_valid(_patch(depth_m, u, v, half)), 5)


@wrong("one_too_strict", "vectorised")
def more_than_min_valid(depth_m, u, v, half=2, min_valid=5):
    valid = _valid(_patch(depth_m, u, v, half))
    if len(valid) <= min_valid:
        return math.nan
    return np.median(valid)


@wrong("all_pixels_counted", "vectorised")
def size_of_the_patch(depth_m, u, v, half=2, min_valid=5):
    patch = _patch(depth_m, u, v, half)
    if patch.size < min_valid:
        return math.nan
    return np.median(_valid(patch))


# --- what is returned ----------------------------------------------------------------------------


@wrong("zero_returned", "vectorised")
def zero_for_invalid(depth_m, u, v, half=2, min_valid=5):
    valid = _valid(_patch(depth_m, u, v, half))
    return float(np.median(valid)) if valid.size >= min_valid else 0.0


@wrong("mean", "loop over lists")
def sum_by_number(depth_m, u, v, half=2, min_valid=5):
    valid = _valid(_patch(depth_m, u, v, half)).tolist()
    return sum(valid) / len(valid) if len(valid) >= min_valid else math.nan


@wrong("one_of_the_middle_two", "loop over lists")
def middle_of_the_sorted_list(depth_m, u, v, half=2, min_valid=5):
    valid = sorted(_valid(_patch(depth_m, u, v, half)))
    return valid[len(valid) // 2] if len(valid) >= min_valid else math.nan


@wrong("one_of_the_middle_two", "partition")
def lower_median(depth_m, u, v, half=2, min_valid=5):
    valid = _valid(_patch(depth_m, u, v, half)).tolist()
    return statistics.median_low(valid) if len(valid) >= min_valid else math.nan


@wrong("in_place", "nanmedian")
def zeros_to_nan_in_the_callers_image(depth_m, u, v, half=2, min_valid=5):
    depth_m[(depth_m == 0) | np.isinf(depth_m)] = np.nan
    patch = _patch(depth_m, u, v, half)
    return np.nanmedian(patch) if np.sum(~np.isnan(patch)) >= min_valid else np.nan


@wrong("several, first last_missing", "vectorised")
def short_window_and_mean(depth_m, u, v, half=2, min_valid=5):
    row, column = round(v), round(u)
    rows = slice(max(row - half, 0), max(row + half, 0))
    columns = slice(max(column - half, 0), max(column + half, 0))
    valid = _valid(depth_m[rows, columns])
    return valid.mean() if len(valid) >= min_valid else math.nan


@wrong("pixel_alone", "vectorised")
def the_pixel_itself_if_it_is_valid(depth_m, u, v, half=2, min_valid=5):
    row, column = round(v), round(u)
    inside = 0 <= row < depth_m.shape[0] and 0 <= column < depth_m.shape[1]
    if inside and np.isfinite(depth_m[row, column]) and depth_m[row, column] > 0:
        return depth_m[row, column]
    return _median(_valid(_patch(depth_m, u, v, half)), min_valid)


@wrong("pixel_alone", "vectorised")
def the_pixel_itself_if_above_zero(depth_m, u, v, half=2, min_valid=5):
    row, column = round(v), round(u)
    if depth_m[row, column] > 0:
        return depth_m[row, column]
    return _median(_valid(_patch(depth_m, u, v, half)), min_valid)


@wrong(None, "loop over lists")
def none_for_invalid(depth_m, u, v, half=2, min_valid=5):
    valid = _valid(_patch(depth_m, u, v, half))
    if len(valid) >= min_valid:
        return np.median(valid)


@wrong(None, "vectorised")
def a_median_for_each_column(depth_m, u, v, half=2, min_valid=5):
    return np.nanmedian(_patch(depth_m, u, v, half), axis=0)


@wrong(None, "slices", kind="raised")
def rows_and_columns_of_a_flat_image(depth_m, u, v, half=2, min_valid=5):
    row, column = round(v), round(u)
    patch = depth_m.ravel()[row - half : row + half + 1, column - half : column + half + 1]
    return _median(_valid(patch), min_valid)
