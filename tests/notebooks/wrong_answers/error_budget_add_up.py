"""Wrong answers to `add_up` of notebook 05."""

import math

import numpy as np

from wrong_answers import changed, wrong


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


changed(
    a_loop,
    {
        "abs(toward[0]) -> toward[0]": "direction_sign",
        "abs(toward[0]) -> 1.0": "not_projected",
        "abs(toward[0]) -> abs(toward[1])": "other_axis",
        "1.0 if toward is None -> 1 / math.sqrt(3) if toward is None": "third_of_the_worst",
        "noise2 += (high * c) ** 2 -> noise2 += high * c": "squares_forgotten",
        "math.sqrt(noise2), worst -> noise2, worst": "squared",
        "math.sqrt(quad2), p -> quad2, p": "squared",
        "worst += high * c -> worst += low * c": None,
        "worst += high * c -> worst += low * c and quad2 += (high * c) -> quad2 += (low * c)": (
            "least_for_most"
        ),
        "(low**2 + low * high + high**2) / 3 -> ((low + high) / 2) ** 2": "mean_squared",
        "(low**2 + low * high + high**2) / 3 -> high**2": "largest_squared",
        "(low**2 + low * high + high**2) / 3 -> (low**2 + high**2) / 2": "ends_squared",
        "(low**2 + low * high + high**2) / 3 -> (high - low) ** 2 / 12": "spread_squared",
        "share = 1 / 3 if toward is None else c**2 -> share = 1.0 if toward is None else c**2": (
            "third_forgotten"
        ),
        "share = 1 / 3 if toward is None else c**2 -> share = 1 / 3": "third_for_all",
        "sigma = math.sqrt(mean2) -> sigma = mean2": "variance_for_sigma",
        "sigma = math.sqrt(mean2) -> sigma = math.sqrt(quad2)": "quadrature_for_sigma",
        "sigma = math.sqrt(mean2) -> sigma = math.sqrt(mean2 + noise2)": "noise_in_the_share",
        "sigma = math.sqrt(mean2) -> sigma = worst": "worst_for_sigma",
        "p = math.erfc -> p = 0.5 * math.erfc": "one_sided",
        "p = math.erfc -> p = 1 - math.erfc": "within_for_beyond",
        "p = math.erfc -> p = 100 * math.erfc": "hundred",
        " / math.sqrt(2)) -> )": "root_two_lost",
        "worst, math.sqrt(quad2), p -> math.sqrt(quad2), worst, p": "sums_exchanged",
        'kind == "noise" -> kind == "bias"': "kinds_exchanged",
        "p = math.erfc -> p = 0.5 * math.erfc and math.sqrt(noise2), worst -> noise2, worst": (
            "several, first one_sided"
        ),
        ", math.sqrt(quad2), p -> , p": None,
    },
)


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


changed(
    arrays,
    {
        "np.abs(n[:, 0]) -> np.linalg.norm(n, axis=1)": "not_projected",
        "np.where(free, 1 / 3, part**2) -> np.where(free, 1 / np.sqrt(3), part**2)": "third_rooted",
        "np.where(free, 1 / 3, part**2) -> np.where(free, 1 / 2, part**2)": "half_for_third",
        "square[~noisy].sum() -> square.sum()": "noise_in_the_share",
        "bias = most[~noisy] -> bias = most": "noise_in_the_bias",
        "bias = most[~noisy] -> bias = ((low + high) / 2 * part)[~noisy]": "middle_for_most",
        "np.where(free, 1 / 3, part**2) -> np.where(free, 1 / 3, part)": "not_squared",
        "noise = np.linalg.norm(most[noisy]) -> noise = np.linalg.norm(most)": "bias_in_the_noise",
        "noise = np.linalg.norm(most[noisy]) -> noise = most[noisy].sum()": "noise_added",
        "noise = np.linalg.norm(most[noisy]) -> noise = most[noisy].mean()": "noise_mean",
        "bias.sum(), np.linalg.norm(bias) -> np.linalg.norm(bias), np.linalg.norm(bias)": (
            "worst_in_quadrature"
        ),
        "bias.sum(), np.linalg.norm(bias) -> bias.sum(), bias.sum()": "quadrature_added",
        "(1.0, 0, 0) if r[2] is None -> (0, 0, 0) if r[2] is None": "any_way_nothing",
    },
)


@wrong("raised")
def none_is_no_vector(rows, tolerance):
    return sum(high * row[0] for low, high, row, kind in rows)


@wrong(None)
def one_number(rows, tolerance):
    return sum(row[1] for row in rows if row[3] == "bias")
