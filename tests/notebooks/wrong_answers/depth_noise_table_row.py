"""Wrong answers to `table_row` of notebook 02."""

import numpy as np

from wrong_answers import wrong


def whole_arrays(counts, scale, distance):
    z = counts * scale * 1000.0
    z[counts == 0] = np.nan
    bias = np.nanmean(z) - distance * 1000
    std = np.sqrt(np.nanmean(np.nanvar(z, axis=0, ddof=1)))
    return bias, std, np.mean(counts == 0)


STD = "np.sqrt(np.nanmean(np.nanvar(z, axis=0, ddof=1)))"


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
