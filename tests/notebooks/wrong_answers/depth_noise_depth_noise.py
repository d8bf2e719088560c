"""Wrong answers to `depth_noise` of notebook 02."""

import numpy as np

from wrong_answers import wrong

B = 0.0501707  # of the simulated camera, as the notebook sets it


def vectorised(Z, fx, baseline, sigma_d):
    return Z**2 / (fx * baseline) * sigma_d


def by_the_disparity(Z, fx, baseline, sigma_d):
    d = fx * baseline / Z
    slope = fx * baseline / d**2
    return slope * sigma_d


@wrong("no name")
def only_the_first_depth(Z, fx, baseline, sigma_d):
    for z in np.ravel(Z):
        return z**2 * sigma_d / (fx * baseline)


@wrong("raised")
def loop_over_a_number(Z, fx, baseline, sigma_d):
    return np.array([z**2 * sigma_d / (fx * baseline) for z in Z])
