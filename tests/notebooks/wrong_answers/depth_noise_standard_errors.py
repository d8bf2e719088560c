"""Wrong answers to `standard_errors` of notebook 02."""

import numpy as np

from wrong_answers import changed


def whole_arrays(z):
    n, h, w = z.shape
    pixels = np.nanmean(z, axis=0)
    frames = np.nanmean(z, axis=(1, 2))
    stays = np.nanvar(pixels, ddof=1) / (h * w / 144)
    moves = np.nanvar(frames, ddof=1) / n
    variance = np.nanmean(np.nanvar(z, axis=0, ddof=1))
    return np.sqrt(stays + moves), np.sqrt(variance / (2 * (n - 1) * h * w / 64))


changed(
    whole_arrays,
    {
        "stays + moves -> moves": "pattern_forgotten",
        "(h * w / 144) -> (h * w)": "pixels_independent",
        "(h * w / 144) -> (h * w / 12)": "patch_not_squared",
        "stays + moves -> stays": "frames_forgotten",
        "np.sqrt(stays + moves) -> stays**0.5 + moves**0.5": "errors_added",
        "h * w / 64 -> h * w": "pixels_independent",
        "h * w / 64 -> h * w / 144": "patch_of_the_mean",
        "(2 * (n -> ((n": "root_of_two",
        "* h * w / 64)) -> ))": "one_pixel_only",
        "np.nanmean(z, axis=0) -> z.mean(axis=0)": None,
    },
)
