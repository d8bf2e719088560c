"""Wrong answers to `table_row` of notebook 02."""

import numpy as np

from wrong_answers import changed, wrong


def whole_arrays(counts, scale, distance):
    z = counts * scale * 1000.0
    z[counts == 0] = np.nan
    bias = np.nanmean(z) - distance * 1000
    std = np.sqrt(np.nanmean(np.nanvar(z, axis=0, ddof=1)))
    return bias, std, np.mean(counts == 0)


STD = "np.sqrt(np.nanmean(np.nanvar(z, axis=0, ddof=1)))"
changed(
    whole_arrays,
    {
        "return bias -> z = np.where(abs(z - np.nanmedian(z, axis=0)) > 40, np.nan, z)\n"
        f"    bias, std = np.nanmean(z) - distance * 1000, {STD}\n    return bias": "right",
        "return bias -> z = np.where(abs(z - np.nanmedian(z, axis=0)) > 40, np.nan, z)\n"
        f"    std = {STD}\n    return bias": "mixed_treatment",
        "z[counts == 0] = np.nan -> pass": "zeros_counted",
        "np.nanmean(z) -> np.mean(counts * scale) * 1000": "zeros_counted",
        "bias = -> z = z[:, (counts > 0).all(axis=0)]\n    bias =": "steady_only",
        "np.nanmean(z) -> z.mean()": "nan_spreads",
        "np.nanmean(z) -> np.nanmedian(z)": "bias_of_the_median",
        "np.nanmean(z) - distance * 1000 -> distance * 1000 - np.nanmean(z)": "negative",
        "np.nanmean(z) - distance * 1000 -> abs(np.nanmean(z) - distance * 1000)": "absolute",
        " - distance * 1000 -> ": "bias_is_depth",
        "- distance * 1000 -> / distance / 10 - 100": "bias_percent",
        "- distance * 1000 -> - distance": "thousandth",
        f"{STD} -> np.nanmean(np.nanstd(z, axis=0, ddof=1))": "stds_averaged",
        f"{STD} -> np.nanmedian(np.nanstd(z, axis=0, ddof=1))": "stds_averaged",
        ", ddof=1 -> ": "divided_by_n",
        "axis=0, ddof=1 -> axis=(1, 2), ddof=1": "over_space",
        f"{STD} -> np.nanstd(np.nanmean(z, axis=0))": "over_space",
        f"{STD} -> np.nanstd(z)": "over_everything",
        f"{STD} -> np.nanstd(np.nanmean(z, axis=(1, 2)), ddof=1)": "of_the_windows_mean",
        "np.sqrt(np.nanmean( -> (np.nanmean(": "squared",
        "bias, std, -> bias, std / len(counts) ** 0.5,": "error_of_the_mean",
        "scale * 1000.0 -> scale and - distance * 1000 -> - distance": "thousandth",
        "bias, std, -> bias, std / 1000 / scale,": "row_in_counts",
        "bias, std, -> std, bias,": "exchanged",
        "np.mean(counts == 0) -> 100 * np.mean(counts == 0)": "hundred",
        "np.mean(counts == 0) -> np.mean(counts != 0)": "valid_part",
        "np.mean(counts == 0) -> np.sum(counts == 0)": "invalid_number",
        "np.mean(counts == 0) -> np.mean((counts == 0).any(axis=0))": "ever_invalid",
        "distance * 1000 -> distance * 100": None,
        "z = counts * scale * 1000.0 -> z = counts": "raised",
    },
)


@wrong("right")
def pixel_by_pixel(counts, scale, distance):
    squares, dof, levels = 0.0, 0, []
    for pixel in counts.reshape(len(counts), -1).T:
        z = [1000 * scale * int(c) for c in pixel if c]
        if z:
            levels += z
            squares += sum((one - sum(z) / len(z)) ** 2 for one in z)
            dof += len(z) - 1
    holes = 1 - len(levels) / counts.size
    return sum(levels) / len(levels) - 1000 * distance, (squares / dof) ** 0.5, holes


@wrong("several, first negative")
def two_mistakes(counts, scale, distance):
    bias, std, invalid = whole_arrays(counts, scale, distance)
    return -bias, std, 100 * invalid
