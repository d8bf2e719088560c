"""Wrong answers to `add_up` of notebook 05."""

import math

import numpy as np

from wrong_answers import wrong


def a_loop(rows, tolerance):
    noise2 = worst = quad2 = mean2 = 0.0
    for low, high, toward, kind in rows:
        c = 1.0 if toward is None else abs(toward[0])
        if kind == "noise":
            noise2 += (high * c) ** 2
        else:
            worst += high * c
            quad2 += (high * c) ** 2
            share = 1 / 3 if toward is None else c**2
            mean2 += share * (low**2 + low * high + high**2) / 3
    sigma = math.sqrt(mean2)
    p = math.erfc(tolerance / sigma / math.sqrt(2))
    return math.sqrt(noise2), worst, math.sqrt(quad2), p


def arrays(rows, tolerance):
    low, high = np.array([r[:2] for r in rows]).T
    n = np.array([(1.0, 0, 0) if r[2] is None else r[2] for r in rows])
    free = np.array([r[2] is None for r in rows])
    noisy = np.array([r[3] == "noise" for r in rows])
    part = np.abs(n[:, 0])
    most = high * part
    square = (low**2 + low * high + high**2) / 3 * np.where(free, 1 / 3, part**2)
    z = tolerance / np.sqrt(square[~noisy].sum())
    noise = np.linalg.norm(most[noisy])
    bias = most[~noisy]
    return np.array([noise, bias.sum(), np.linalg.norm(bias), math.erfc(z / np.sqrt(2))])


@wrong("raised")
def none_is_no_vector(rows, tolerance):
    return sum(high * row[0] for low, high, row, kind in rows)


@wrong("no name")
def one_number(rows, tolerance):
    return sum(row[1] for row in rows if row[3] == "bias")
