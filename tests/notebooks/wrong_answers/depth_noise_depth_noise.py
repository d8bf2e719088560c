"""Wrong answers to `depth_noise` of notebook 02."""

import numpy as np

from wrong_answers import changed, wrong

B = 0.0501707  # of the simulated camera, as the notebook sets it


def vectorised(Z, fx, baseline, sigma_d):
    return Z**2 / (fx * baseline) * sigma_d


changed(
    vectorised,
    {
        "Z**2 -> 2 * Z": "linear_in_Z",
        "(fx * baseline) -> (fx * 1000 * baseline)": "thousandth",
        "* sigma_d -> * sigma_d * 1e3": "thousand",
        "(fx * baseline) -> baseline": "fx_forgotten",
        "/ (fx * baseline) -> * 1": "constant_forgotten",
        "(fx * baseline) -> (fx * B)": "other_baseline",
        "(fx * baseline) -> (1 / (fx * baseline))": "multiplied",
        "(fx * baseline) -> fx * baseline": "baseline_behind_the_fraction",
        "Z**2 / (fx * baseline) -> np.asarray(Z) ** 2 / fx * baseline": (
            "baseline_behind_the_fraction"
        ),
        "Z**2 / (fx * baseline) -> np.asarray(Z) ** 2 / baseline * fx": (
            "focal_length_behind_the_fraction"
        ),
        "* sigma_d -> / sigma_d": "noise_divided",
        "Z**2 / (fx * baseline) * sigma_d -> (Z**2 / (fx * baseline) * sigma_d) ** 2": "squared",
        "Z**2 / (fx * baseline) * sigma_d -> np.sqrt(Z**2 / (fx * baseline) * sigma_d)": "rooted",
        "* sigma_d -> * sigma_d * math.sqrt(2)": "root_of_two",
        "return Z**2 -> Z *= Z\n    return Z": "in_place",
        "Z**2 -> 1000 * Z": "several, first linear_in_Z",
        "Z**2 -> math.pow(Z, 2)": "raised",
        "Z**2 -> Z ^ 2": "raised",
    },
)


def by_the_disparity(Z, fx, baseline, sigma_d):
    d = fx * baseline / Z
    slope = fx * baseline / d**2
    return slope * sigma_d


changed(
    by_the_disparity,
    {
        "slope * sigma_d -> sigma_d / d": "linear_in_Z",
        "slope * sigma_d -> slope * Z * sigma_d": "cubed",
        "fx * baseline / d**2 -> fx / (fx / Z) ** 2": "baseline_forgotten",
        "slope * sigma_d -> Z / (fx * 0.05 / Z) * sigma_d": "other_baseline",
        "fx * baseline / d**2 -> abs(-fx * baseline / Z**2)": "upside_down",
        "slope * sigma_d -> slope": "noise_forgotten",
        "slope * sigma_d -> -slope * sigma_d": "negative",
        "slope * sigma_d -> fx * baseline / (d - sigma_d) - Z": "difference",
        "slope * sigma_d -> abs(fx * baseline / (d + sigma_d) - fx * baseline / d)": "difference",
        "slope * sigma_d -> fx * baseline * (1 / (d - sigma_d) - 1 / (d + sigma_d)) / 2": (
            "difference"
        ),
        "slope * sigma_d -> fx * baseline * (1 / (d - sigma_d / 2) - 1 / (d + sigma_d / 2))": (
            "difference"
        ),
    },
)


@wrong(None)
def only_the_first_depth(Z, fx, baseline, sigma_d):
    for z in np.ravel(Z):
        return z**2 * sigma_d / (fx * baseline)


@wrong("raised")
def loop_over_a_number(Z, fx, baseline, sigma_d):
    return np.array([z**2 * sigma_d / (fx * baseline) for z in Z])
