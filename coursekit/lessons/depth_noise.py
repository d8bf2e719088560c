"""Notebook 02: its exercises and the mistakes that people make in them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import compress, product
from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.lessons import questions
from coursekit.lessons.exercises import Exercise, Step, Steps
from coursekit.specifications import device

Bounds = tuple[int, int, int, int]  # first row, the one after the last; the same for columns

# --- depth_noise ---


def _depth_noise(steps: Steps, Z: Any, fx: float, baseline: float, sigma_d: float) -> Any:
    slope = steps["divide"](steps["power"](Z), steps["constant"](fx, baseline))
    return steps["result"](steps["noise"](slope, sigma_d, Z))


def _describe_depth_noise(args: tuple[Any, ...]) -> str:
    Z, fx, baseline, sigma_d = args
    camera = f"fx = {fx:g} px, baseline = {baseline:g} m, sigma_d = {sigma_d:g} px"
    return f"{camera}, Z = {', '.join(f'{z:g}' for z in np.ravel(Z))} m"


def _noise_by_disparity(Z: Any, fx: float, baseline: float, sigma_d: float) -> Any:
    d = fx * baseline / Z
    return fx * baseline / d**2 * sigma_d


DEPTH_NOISE = Exercise.told(
    "depth_noise.depth_noise",
    build=_depth_noise,
    steps={
        "power": lambda Z: Z**2,
        "constant": lambda fx, baseline: fx * baseline,
        "divide": lambda Z2, fxB: Z2 / fxB,
        "noise": lambda slope, sigma_d, Z: slope * sigma_d,
        "result": lambda sigma: sigma,
    },
    describe=_describe_depth_noise,
    styles=[_noise_by_disparity],
)


def _difference(of_part: tuple[float, int]) -> Step:
    """fx B / (d - sigma_d) - Z; Z - fx B / (d + sigma_d); half of the two together; and the same
    with half of sigma_d to each side: the factor and the power of what part of Z the noise is.
    """
    factor, power = of_part
    return lambda slope, sigma_d, Z: slope * sigma_d / (1 + factor * (slope * sigma_d / Z) ** power)


DEPTH_NOISE.add_mistakes(
    ("power", "linear_in_Z", lambda Z: Z, lambda Z: 2 * Z),
    ("", "depth_for_slope", lambda _: lambda Z, fx, baseline, sigma_d: Z * sigma_d),
    ("power", "cubed", lambda Z: Z**3),
    ("constant", "baseline_forgotten", lambda fx, baseline: fx),
    ("constant", "fx_forgotten", lambda fx, baseline: baseline),
    ("constant", "constant_forgotten", lambda fx, baseline: 1.0),
    ("constant", "other_baseline", lambda fx, baseline: fx * device("D435").unit.baseline_m),
    ("constant", "other_baseline", lambda fx, baseline: fx * 0.05),
    ("divide", "multiplied", lambda power, constant: power * constant),
    ("constant", "baseline_behind_the_fraction", lambda fx, baseline: fx / baseline),
    ("constant", "focal_length_behind_the_fraction", lambda fx, baseline: baseline / fx),
    ("divide", "upside_down", lambda power, constant: constant / power),
    ("noise", "noise_divided", lambda slope, sigma_d, Z: slope / sigma_d),
    ("noise", "noise_forgotten", lambda slope, sigma_d, Z: slope),
    ("noise", "difference", *map(_difference, ((-1, 1), (1, 1), (-1, 2), (-1 / 4, 2)))),
    ("result", "negative", lambda sigma: -sigma),
    ("", "disparity", lambda law: lambda Z, fx, baseline, sigma_d: fx * baseline / Z),
)


# --- robust_depth ---


IMAGE = np.array(questions.lesson_texts("depth_noise")["given"]["image"])  # metres


def _window(row: int, column: int, half: int) -> Bounds:
    return row - half, row + half + 1, column - half, column + half + 1


def _cut(rows: Step, columns: Step | None = None) -> Step:
    """Cuts a window out of an image: what gives the indices of an axis from (start, stop, size)."""

    def cut(image: Floats, top: int, bottom: int, left: int, right: int) -> Any:
        height, width = image.shape
        return image[rows(top, bottom, height)][:, (columns or rows)(left, right, width)]

    return cut


def _inside(start: int, stop: int, size: int) -> slice:
    return slice(max(start, 0), max(stop, 0))


def _as_they_come(start: int, stop: int, size: int) -> slice:
    return slice(start, stop)


def _robust_depth(
    steps: Steps, depth_m: Floats, u: float, v: float, half: int = 2, min_valid: int = 5
) -> Any:
    column, row = (steps["round"](c) for c in steps["read"](u, v))
    alone = steps["shortcut"](depth_m, row, column)
    if alone is not None:
        return alone
    pixels = steps["cut"](depth_m, *steps["window"](row, column, half))
    valid = steps["finite"](steps["zeros"](pixels.ravel()))
    if len(valid) == 0 or not steps["enough"](valid, pixels, min_valid):
        return steps["none"]()
    return steps["middle"](valid)


def _describe_robust_depth(args: tuple[Any, ...]) -> str:
    """The window in words: its size, where the border cuts it off, what is in it."""
    image, u, v = args[:3]
    half = args[3] if len(args) > 3 else 2
    text = f"a {2 * half + 1}x{2 * half + 1} window about (u, v) = ({u:g}, {v:g}) px"
    if len(args) > 4:
        text += f", min_valid = {args[4]}"
    top, bottom, left, right = _window(round(v), round(u), half)
    pixels = _cut(_inside)(image, top, bottom, left, right)
    if pixels.size == 0:
        return f"{text}, all of it off the image"
    beyond = (top < 0, bottom > image.shape[0], left < 0, right > image.shape[1])
    if any(beyond):
        borders = " and ".join(compress(("top", "bottom", "left", "right"), beyond))
        text += f", cut off at the {borders} border"
    valid = np.isfinite(pixels) & (pixels != 0)
    kinds = (valid, pixels == 0, np.isnan(pixels), np.isinf(pixels))
    named = zip(kinds, ("valid", "zero", "NaN", "infinite"), strict=True)
    inside = ", ".join(f"{kind.sum()} {name}" for kind, name in named if kind.any())
    return f"{text} ({inside})"


ROBUST_DEPTH = Exercise.told(
    "depth_noise.robust_depth",
    build=_robust_depth,
    steps={
        "read": lambda u, v: (u, v),
        "round": round,
        "shortcut": lambda image, row, column: None,
        "window": _window,
        "cut": _cut(_inside),
        "zeros": lambda pixels: pixels[pixels != 0],
        "finite": lambda pixels: pixels[np.isfinite(pixels)],
        "enough": lambda valid, pixels, min_valid: len(valid) >= min_valid,
        "none": lambda: math.nan,
        "middle": lambda valid: float(np.median(valid)),
    },
    cases=[(7 * IMAGE, 10, 8)],  # far away
    describe=_describe_robust_depth,
    show=lambda depth: "NaN" if np.isnan(depth) else f"{float(depth):.5f}",
)


def _pixel_alone(image: Floats, row: int, column: int) -> Any:
    height, width = image.shape
    return image[row, column] if 0 <= row < height and 0 <= column < width else math.nan


def _pixel_alone_if_valid(image: Floats, row: int, column: int) -> Any:
    alone = _pixel_alone(image, row, column)
    return alone if 0 < alone < math.inf else None


def _pixel_alone_if_positive(image: Floats, row: int, column: int) -> Any:
    height, width = image.shape
    inside = -height <= row < height and -width <= column < width
    return image[row, column] if inside and image[row, column] > 0 else None


def _moved_inside(start: int, stop: int, size: int) -> Any:
    return np.arange(stop - start) + min(max(start, 0), size - stop + start)


def _centre_clamped(start: int, stop: int, size: int) -> Any:
    half = (stop - start) // 2
    centre = min(max(start + half, 0), size - 1)
    return slice(max(centre - half, 0), centre + half + 1)


def _repeated_if_inside(start: int, stop: int, size: int) -> Any:
    """As of an image padded with its edge: nothing where the centre lies outside."""
    return np.clip(range(start, stop), 0, size - 1)[: size * (0 <= (start + stop) // 2 < size)]


def _height_width_swapped(image: Floats, top: int, bottom: int, left: int, right: int) -> Any:
    width, height = image.shape
    return _cut(_inside)(image, top, min(bottom, height), left, min(right, width))


ROBUST_DEPTH.add_mistakes(
    ("read", "u_v_swapped", lambda u, v: (v, u)),
    ("round", "truncated", int),
    ("round", "rounded_up", math.ceil),
    ("window", "first_too_early", lambda *at: np.subtract(_window(*at), (1, 0, 1, 0))),
    ("window", "last_missing", lambda *at: np.subtract(_window(*at), (0, 1, 0, 1))),
    ("window", "half_ignored", lambda row, column, half: _window(row, column, 2)),
    ("window", "half_halved", lambda row, column, half: _window(row, column, half // 2)),
    ("shortcut", "pixel_alone", _pixel_alone, _pixel_alone_if_valid, _pixel_alone_if_positive),
    ("cut", "negative_index", _cut(_as_they_come), _cut(_as_they_come, _inside)),
    ("cut", "negative_index", _cut(_inside, _as_they_come)),
    ("cut", "negative_index", _cut(lambda a, b, size: np.arange(a, min(b, size)))),
    ("cut", "negative_end", _cut(lambda a, b, size: slice(max(a, 0), b))),
    ("cut", "moved_inside", _cut(_moved_inside)),
    ("cut", "centre_clamped", _cut(_centre_clamped)),
    ("cut", "border_repeated", _cut(lambda a, b, size: np.clip(range(a, b), 0, size - 1))),
    ("cut", "border_repeated", _cut(_repeated_if_inside)),
    ("cut", "border_lost", _cut(lambda a, b, size: _inside(a, min(b, size - 1), size))),
    ("cut", "border_lost", _cut(lambda a, b, size: slice(max(a, 0), min(b, size - 1)))),
    ("cut", "modulo", _cut(lambda a, b, size: np.arange(a, b) % size)),
    ("cut", "height_width_swapped", _height_width_swapped),
    ("cut", "border_refused", _cut(lambda a, b, size: slice(a, b if a >= 0 and b <= size else a))),
    ("zeros", "zeros_counted", lambda pixels: pixels),
    ("finite", "nan_counted", lambda pixels: pixels, lambda pixels: pixels[~np.isinf(pixels)]),
    ("finite", "infinity_counted", lambda pixels: pixels[~np.isnan(pixels)]),
    ("enough", "min_valid_ignored", lambda valid, pixels, min_valid: True),
    ("enough", "min_valid_fixed", lambda valid, pixels, min_valid: len(valid) >= 5),
    ("enough", "one_too_strict", lambda valid, pixels, min_valid: len(valid) > min_valid),
    ("enough", "all_pixels_counted", lambda valid, pixels, min_valid: pixels.size >= min_valid),
    ("none", "zero_returned", lambda: 0.0),
    ("middle", "mean", lambda valid: float(np.mean(valid))),
    ("middle", "one_of_the_middle_two", lambda valid: float(np.sort(valid)[len(valid) // 2])),
    ("middle", "one_of_the_middle_two", lambda valid: float(np.sort(valid)[(len(valid) - 1) // 2])),
)


# --- table_row ---

_FAR = 8 * 1.4826  # times the median distance from a pixel's median: a mismatch, see `stereo`


def _left_out(z: Floats, axis: int | None = 0) -> Floats:
    off = np.abs(z - np.nanmedian(z, axis=axis))
    return np.where(off > _FAR * np.nanmedian(off), np.nan, z)


def _variances(z: Floats, ddof: int = 1) -> Floats:
    return np.asarray(np.nanvar(z, axis=0, ddof=ddof))


def _pooled(z: Floats) -> Any:
    """Each pixel's variance over time, their mean, its root."""
    return np.sqrt(np.nanmean(_variances(z)))


def _pooled_by_samples(z: Floats) -> Any:
    """The same with each pixel counted by its degrees of freedom."""
    dof = np.maximum(np.isfinite(z).sum(axis=0) - 1, 0)
    return np.sqrt(np.nansum(dof * _variances(z)) / dof.sum())


_BY_PIXELS = (", every pixel alike in the bias", lambda z: np.nanmean(np.nanmean(z, axis=0)))
_BY_SAMPLES = (", pixels weighted by their samples in the std", _pooled_by_samples)


def _steady(z: Floats) -> Floats:
    """Only the pixels that are valid in every frame."""
    return z[:, np.isfinite(z).all(axis=0)][..., None]


def _table_row(steps: Steps, counts: Any, scale: float, distance: float) -> Any:
    step_mm = 1e3 * scale
    z = steps["depth"](counts, step_mm)
    for_bias, for_std = steps["keep"](z)
    bias = steps["bias"](steps["level"](for_bias), 1e3 * distance)
    std = steps["report"](steps["std"](for_std), len(z))
    return np.array([*steps["unit"]((bias, std), step_mm), steps["invalid"](counts)])


def _table_case(shape: tuple[int, int, int], scale: float, distance: float, seed: int) -> Any:
    """Counts of a face with a pattern that stays; from 100 samples on with holes and mismatches."""
    rng = np.random.default_rng(seed)
    face = distance / scale + rng.normal(-8 if seed % 2 else 8, 6, shape[1:])
    z = face + rng.uniform(1, 6, shape[1:]) * rng.uniform(-1.7, 1.7, shape)
    if seed == 7:
        z[:, 1, 2] += 300  # a pixel that stands off and does not scatter: it stays
    if z.size > 100:
        at = rng.choice(z.size, 9, replace=False)
        z.flat[at[:7]] = 0
        z.flat[at[7:] if seed % 2 else []] += 700
    return np.rint(z).astype(np.uint16), scale, distance


def _describe_table_row(args: tuple[Any, ...]) -> str:
    counts, scale, distance = args
    what = f"counts {counts.shape} up to {counts.max()}, {np.sum(counts == 0)} of them 0"
    return f"{what}; scale = {scale:g} m, distance = {distance:g} m"


def _row_by_sums(counts: Any, scale: float, distance: float) -> Any:
    z = np.where(counts == 0, np.nan, counts * scale * 1000.0)
    error = z - distance * 1000.0
    n = np.sum(np.isfinite(z), axis=0)
    off = z - np.nanmean(z, axis=0)
    variance = np.nansum(off**2, axis=0) / (n - 1)
    return np.nanmean(error), np.sqrt(np.mean(variance)), np.sum(counts == 0) / counts.size


TABLE_ROW = Exercise.told(
    "depth_noise.table_row",
    build=_table_row,
    steps={
        "depth": lambda counts, step: np.where(counts > 0, step * counts, np.nan),
        "keep": lambda z: (z, z),
        "level": np.nanmean,
        "bias": lambda level, distance: level - distance,
        "std": _pooled,
        "report": lambda std, frames: std,
        "unit": lambda both, step: both,
        "invalid": lambda counts: np.mean(counts == 0),
    },
    cases=[
        _table_case((4, 2, 2), 0.001, 0.5, 0),
        _table_case((6, 3, 4), 0.0001, 0.3, 2),
        _table_case((10, 4, 5), 0.0001, 0.45, 4),
        _table_case((10, 5, 4), 0.00025, 0.3, 5),
        _table_case((16, 4, 5), 0.0001, 0.6, 7),
    ],
    describe=_describe_table_row,
    styles=[_row_by_sums],
    ways=[  # how the means and variances of pixels with holes are weighted is free
        (f"mismatches {way}{mean}{mix}", {"keep": keep, "level": level, "std": std})
        for way, keep in (("kept", lambda z: (z, z)), ("left out", lambda z: (_left_out(z),) * 2))
        for mean, level in (("", np.nanmean), _BY_PIXELS)
        for mix, std in (("", _pooled), _BY_SAMPLES)
    ][1:],
)


def _instead(at: int, part: Step) -> Step:
    """Another way to one part of the whole result."""
    return lambda right: lambda *args: np.r_[right(*args)[:at], part(*args), right(*args)[at + 1 :]]


def _bias_wrapped(c: Any, scale: float, distance: float) -> Any:
    return 1e3 * scale * np.mean(c[c > 0] - np.uint16(distance / scale))


def _about_the_distance(c: Any, scale: float, distance: float) -> Any:
    return 1e3 * np.sqrt(np.nanmean((np.where(c > 0, scale * c, np.nan) - distance) ** 2))


# Tried two at a time are only these steps': with eight ways to be right, all would take too long.
TABLE_ROW.add_mistakes(
    ("bias", "bias_is_depth", lambda level, distance: level),
    ("invalid", "ever_invalid", lambda counts: (counts == 0).any(axis=0).mean()),
    ("invalid", "ever_invalid", lambda counts: (counts == 0).any(axis=(1, 2)).mean()),
    ("bias", "bias_percent", lambda level, distance: 100 * (level / distance - 1)),
    ("depth", "scale_forgotten", lambda counts, step: np.where(counts > 0, 1.0 * counts, np.nan)),
    ("report", "error_of_the_mean", lambda std, frames: std / math.sqrt(frames)),
    ("unit", "row_in_counts", lambda both, step: (both[0] / step, both[1] / step)),
    ("unit", "row_in_counts", lambda both, step: (both[0], both[1] / step)),
    ("invalid", "valid_part", lambda counts: np.mean(counts > 0)),
    ("invalid", "invalid_number", lambda counts: np.sum(counts == 0)),
)
TABLE_ROW.add_mistakes(
    ("depth", "zeros_counted", lambda counts, step: step * counts),
    ("level", "zeros_counted", lambda z: np.nan_to_num(z).mean()),
    ("std", "zeros_counted", lambda z: _pooled(np.nan_to_num(z))),
    ("std", "stds_averaged", lambda z: np.nanmean(np.sqrt(_variances(z)))),
    ("std", "stds_averaged", lambda z: np.nanmean(np.sqrt(_variances(z, 0)))),
    ("std", "stds_averaged", lambda z: np.nanmedian(np.sqrt(_variances(z)))),
    ("std", "divided_by_n", lambda z: np.sqrt(np.nanmean(_variances(z, 0)))),
    ("std", "over_space", lambda z: np.sqrt(np.nanmean(np.nanvar(z, axis=(1, 2), ddof=1)))),
    ("std", "over_space", lambda z: np.nanmean(np.nanstd(z, axis=(1, 2)))),
    ("std", "over_space", lambda z: np.nanstd(np.nanmean(z, axis=0))),
    ("std", "over_space", lambda z: np.nanstd(np.nanmean(z, axis=0), ddof=1)),
    ("std", "over_everything", np.nanstd, lambda z: np.nanstd(z, ddof=1)),
    ("bias", "distance_in_metres", lambda level, distance: level - distance / 1e3),
    ("", "about_the_distance", _instead(1, _about_the_distance)),
    ("keep", "mixed_treatment", lambda z: (_left_out(z), z), lambda z: (z, _left_out(z))),
    ("keep", "median_of_all", lambda z: (_left_out(z, None),) * 2),
    ("keep", "steady_only", lambda z: (_steady(z),) * 2),
    ("std", "steady_only", lambda z: _pooled(_steady(z))),
    ("invalid", "mismatches_invalid", lambda c: np.isnan(_left_out(np.where(c, c, np.nan))).mean()),
    ("", "wraps_round", _instead(0, _bias_wrapped)),
    ("depth", "wraps_round", lambda c, mm: np.where(c, c * np.uint16(1000) * (mm / 1e3), np.nan)),
    ("std", "over_space", lambda z: np.sqrt(np.nanmean(np.nanvar(z, axis=1, ddof=1)))),
    ("std", "over_space", lambda z: np.sqrt(np.nanmean(np.nanvar(z, axis=2, ddof=1)))),
    ("std", "median_deviation", lambda z: 1.4826 * np.nanmedian(abs(z - np.nanmedian(z, axis=0)))),
    ("std", "median_deviation", lambda z: 1.48 * np.nanmedian(abs(z - np.nanmedian(z, axis=0)))),
    ("level", "nan_spreads", np.mean),
    ("std", "nan_spreads", lambda z: np.sqrt(np.mean(np.var(z, axis=0, ddof=1)))),
    ("level", "bias_of_the_median", np.nanmedian),
    ("std", "of_the_windows_mean", lambda z: np.nanstd(np.nanmean(z, axis=(1, 2)), ddof=1)),
    ("std", "of_the_windows_mean", lambda z: np.nanstd(np.nanmean(z, axis=(1, 2)))),
    alone=True,
)


# --- standard_errors ---


def _standard_errors(steps: Steps, z: Floats) -> Any:
    spread, root, sides = steps["spread"], steps["root"], steps["sides"]()
    areas = [steps["area"](*z[0].shape, side) for side in sides]
    patches, frames = steps["patches"](areas[0], sides[0]), steps["frames"](len(z))
    for_stays, for_moves = steps["numbers"](patches, frames)
    stays = spread(np.nanmean(z, axis=0)) / root(for_stays)
    moves = spread(steps["levels"](z)) / root(for_moves)
    nu = steps["squares"](steps["count"](z), areas[1], sides[1])
    return np.array([steps["sum"](stays, moves), steps["pooled"](z) / math.sqrt(nu)])


def _freedom(z: Floats) -> Any:
    return (np.isfinite(z).sum(axis=0) - 1).mean()


def _lines(z: Floats, axis: int) -> Any:
    """Each frame's mean, by the means of its rows or columns."""
    return np.nanmean(np.nanmean(z, axis=3 - axis), axis=1)


def _errors_case(shape: tuple[int, int, int], seed: int) -> tuple[Floats]:
    rng = np.random.default_rng(seed)
    z = 450 + rng.normal(0, 0.4, shape[1:]) + rng.normal(0, 0.7, shape)
    z += rng.normal(0, 0.3, shape[0])[:, None, None]
    if seed:
        z.flat[rng.choice(z.size, 20, replace=False)] = np.nan
    return (z.round(3),)


def _errors_by_variances(z: Floats) -> Any:
    frames, rows, columns = z.shape
    pixel_means = np.nanmean(z, axis=0)
    frame_means = np.nanmean(z, axis=(1, 2))
    stays = np.nanvar(pixel_means, ddof=1) / (rows * columns / 12**2)
    moves = np.nanvar(frame_means, ddof=1) / frames
    variance = np.nanmean(np.nanvar(z, axis=0, ddof=1))
    nu = (frames - 1) * (rows * columns / 8**2)
    return np.sqrt(stays + moves), np.sqrt(variance / (2 * nu))


def _errors_by_stds(z: Floats) -> Any:
    frames, rows, columns = z.shape
    patches = rows * columns / 12**2
    stays = np.nanstd(np.nanmean(z, axis=0), ddof=1) / np.sqrt(patches)
    moves = np.nanstd(np.nanmean(z, axis=(1, 2)), ddof=1) / np.sqrt(frames)
    std = np.sqrt(np.nanmean(np.nanstd(z, axis=0, ddof=1) ** 2))
    nu = (frames - 1) * (rows / 8 * columns / 8)
    return np.sqrt(stays**2 + moves**2), std / np.sqrt(2 * nu)


STANDARD_ERRORS = Exercise.told(
    "depth_noise.standard_errors",
    build=_standard_errors,
    steps={
        "levels": lambda z: np.nanmean(z, axis=(1, 2)),
        "spread": lambda means: np.nanstd(means, ddof=1),
        "root": math.sqrt,
        "sides": lambda: (12, 8),
        "area": lambda height, width, side: height * width,
        "patches": lambda area, side: area / side**2,
        "frames": lambda n: n,
        "numbers": lambda patches, frames: (patches, frames),
        "count": lambda z: len(z) - 1,
        "pooled": _pooled,
        "squares": lambda dof, area, side: 2 * dof * area / side**2,
        "sum": math.hypot,
    },
    cases=[_errors_case((5 + 3 * i, 12 + 8 * i, 12 + 9 * i), i) for i in range(3)],
    describe=lambda args: f"z of shape {args[0].shape}, {np.sum(np.isnan(args[0]))} of it NaN",
    styles=[_errors_by_variances, _errors_by_stds],
    ways=[
        ("n = each pixel's valid samples" + mix, {"count": _freedom, "pooled": std})
        for mix, std in (("", _pooled), _BY_SAMPLES)
    ]
    + [
        ("n = frames, the rows of a frame alike", {"levels": lambda z: _lines(z, 1)}),
        ("n = frames, the columns of a frame alike", {"levels": lambda z: _lines(z, 2)}),
    ],
)


def _samples_independent(part: int) -> Iterator[Step]:
    """The bias's ± (0) or the std's (1) as if no two samples were alike, from spread and number."""
    numbers: tuple[Step, ...] = (np.size, _valid, lambda z: _valid(z) - 1)
    for n, spread in product(numbers, (np.nanstd, lambda z: np.nanstd(z, ddof=1), _pooled)):
        yield _instead(part, lambda z, n=n, s=spread: s(z) / np.sqrt((1 + part) * n(z)))


def _valid(z: Floats) -> int:
    return int(np.isfinite(z).sum())


def _of_every_frame(spread: Step) -> Step:
    """The bias's ± as if each frame had patches of its own, which scatter by so much."""
    return _instead(0, lambda z: 12 * spread(z) / math.sqrt(z.size))


STANDARD_ERRORS.add_mistakes(
    *(("", "pixels_independent", slip) for part in (0, 1) for slip in _samples_independent(part)),
    ("", "patches_of_every_frame", _of_every_frame(lambda z: np.nanstd(z, ddof=1))),
    ("", "noise_over_time_only", _of_every_frame(_pooled)),
    ("numbers", "pattern_over_frames", lambda patches, frames: (patches * frames, frames)),
    ("numbers", "numbers_exchanged", lambda patches, frames: (frames, patches)),
    ("patches", "pattern_forgotten", lambda area, side: math.inf),
    ("patches", "pixels_independent", lambda area, side: area),
    ("squares", "pixels_independent", lambda dof, area, side: 2 * dof * area),
    ("patches", "patch_not_squared", lambda area, side: area / side),
    ("squares", "patch_not_squared", lambda dof, area, side: 2 * dof * area / side),
    ("area", "whole_patches", lambda h, w, side: (h // side) * (w // side) * side**2),
    ("sides", "sides_exchanged", lambda: (8, 12)),
    ("frames", "frames_forgotten", lambda n: math.inf),
    ("frames", "frames_not_divided", lambda n: 1),
    ("root", "root_forgotten", lambda n: n),
    ("sum", "errors_added", lambda stays, moves: stays + moves),
    ("sum", "squares_forgotten", lambda stays, moves: math.sqrt(stays + moves)),
    ("sides", "patch_of_the_mean", lambda: (12, 12)),
    ("sides", "patch_of_the_std", lambda: (8, 8)),
    ("sides", "pixels_independent", lambda: (1, 1)),
    ("count", "frames_not_counted", lambda z: 1),
    ("squares", "root_forgotten", lambda dof, area, side: (2 * dof * area / side**2) ** 2),
    ("patches", "root_before_the_patch", lambda area, side: area / side**4),
    ("squares", "part_of_a_variance", lambda dof, area, side: dof * area / side**2 / 2),
    ("squares", "one_pixel_only", lambda dof, area, side: 2 * dof),
    ("squares", "std_itself", lambda dof, area, side: 1),
    ("count", "divided_by_n", len),
    ("spread", "divided_by_n", np.nanstd),
    ("pooled", "divided_by_n", lambda z: np.sqrt(np.nanmean(_variances(z, 0)))),
    ("pooled", "variance_pooled", lambda z: np.nanmean(_variances(z))),
    ("pooled", "stds_averaged", lambda z: np.nanmean(np.sqrt(_variances(z)))),
    ("pooled", "over_everything", np.nanstd, lambda z: np.nanstd(z, ddof=1)),
    ("pooled", "nan_spreads", lambda z: np.sqrt(np.mean(np.var(z, axis=0, ddof=1)))),
    ("", "nan_spreads", lambda f: lambda z: f(z) * np.where(np.isnan(z).any(), np.nan, 1)),
)
