"""Wrong answers to `depth_noise` of notebook 02."""

import math

import numpy as np

from wrong_answers import wrong

# --- how it grows with Z -------------------------------------------------------------------------


@wrong("linear_in_Z", "by the disparity")
def one_power_of_the_disparity(Z, fx, baseline, sigma_d):
    disparity = fx * baseline / Z
    return sigma_d / disparity


@wrong("linear_in_Z", "vectorised")
def square_differentiated_by_mistake(Z, fx, baseline, sigma_d):
    return 2 * Z * sigma_d / (fx * baseline)


@wrong("cubed", "by the disparity")
def slope_times_depth(Z, fx, baseline, sigma_d):
    d = fx * baseline / Z
    dZ_dd = fx * baseline / d**2
    return dZ_dd * Z * sigma_d


# --- the constant --------------------------------------------------------------------------------


@wrong("millimetres", "vectorised")
def baseline_in_millimetres(Z, fx, baseline, sigma_d):
    B = 1000 * baseline
    return Z**2 / (fx * B) * sigma_d


@wrong("millimetres", "vectorised")
def answer_in_millimetres(Z, fx, baseline, sigma_d):
    noise_m = sigma_d * Z**2 / (fx * baseline)
    return noise_m * 1e3


@wrong("baseline_forgotten", "by the disparity")
def focal_length_for_the_constant(Z, fx, baseline, sigma_d):
    return fx / (fx / Z) ** 2 * sigma_d


@wrong("fx_forgotten", "vectorised")
def baseline_for_the_constant(Z, fx, baseline, sigma_d):
    return np.power(Z, 2) / baseline * sigma_d


@wrong("constant_forgotten", "vectorised")
def proportional_to(Z, fx, baseline, sigma_d):
    return Z**2 * sigma_d


B = 0.0501707  # of the simulated camera, as the notebook sets it


@wrong("other_baseline", "vectorised")
def global_of_the_notebook(Z, fx, baseline, sigma_d):
    return Z**2 / (fx * B) * sigma_d


@wrong("other_baseline", "by the disparity")
def fifty_millimetres(Z, fx, baseline, sigma_d):
    disparity = fx * 0.05 / Z
    return Z / disparity * sigma_d


@wrong("multiplied", "vectorised")
def precedence(Z, fx, baseline, sigma_d):
    constant = 1 / (fx * baseline)
    return Z**2 / constant * sigma_d


@wrong("baseline_behind_the_fraction", "vectorised")
def brackets_missing(Z, fx, baseline, sigma_d):
    return Z**2 / fx * baseline * sigma_d


@wrong("upside_down", "by the disparity")
def disparity_by_depth(Z, fx, baseline, sigma_d):
    dd_dZ = -fx * baseline / Z**2
    return abs(dd_dZ) * sigma_d


# --- the noise -----------------------------------------------------------------------------------


@wrong("noise_divided", "vectorised")
def noise_below_the_line(Z, fx, baseline, sigma_d):
    return Z * Z / (fx * baseline * sigma_d)


@wrong("noise_forgotten", "by the disparity")
def only_the_slope(Z, fx, baseline, sigma_d):
    d = fx * baseline / np.asarray(Z)
    return fx * baseline / d**2


@wrong("variance", "propagation")
def propagated_without_the_root(Z, fx, baseline, sigma_d):
    jacobian = Z**2 / (fx * baseline)
    return jacobian * sigma_d**2 * jacobian


@wrong("root", "propagation")
def root_without_the_squares(Z, fx, baseline, sigma_d):
    jacobian = Z**2 / (fx * baseline)
    return np.sqrt(jacobian * sigma_d)


@wrong("negative", "by the disparity")
def sign_of_the_slope_kept(Z, fx, baseline, sigma_d):
    d = fx * baseline / Z
    return -fx * baseline / d**2 * sigma_d


# --- what is returned ----------------------------------------------------------------------------


@wrong("in_place", "vectorised")
def squared_where_it_is(Z, fx, baseline, sigma_d):
    Z *= Z
    return Z * sigma_d / (fx * baseline)


@wrong("several, first linear_in_Z", "vectorised")
def linear_and_in_millimetres(Z, fx, baseline, sigma_d):
    return 1000 * Z * sigma_d / (fx * baseline)


@wrong("difference", "two depths")
def difference_of_two_depths(Z, fx, baseline, sigma_d):
    d = fx * baseline / Z
    return fx * baseline / (d - sigma_d) - Z


@wrong("difference", "two depths")
def difference_to_the_nearer_depth(Z, fx, baseline, sigma_d):
    d = fx * baseline / Z
    return abs(fx * baseline / (d + sigma_d) - fx * baseline / d)


@wrong("difference", "two depths")
def half_the_depths_on_both_sides(Z, fx, baseline, sigma_d):
    d = fx * baseline / Z
    near, far = (fx * baseline / (d + side * sigma_d) for side in (1, -1))
    return (far - near) / 2


@wrong("difference", "two depths")
def half_a_sigma_to_both_sides(Z, fx, baseline, sigma_d):
    d = fx * baseline / Z
    return fx * baseline * (1 / (d - sigma_d / 2) - 1 / (d + sigma_d / 2))


@wrong("root_of_two", "vectorised")
def two_eyes(Z, fx, baseline, sigma_d):
    return math.sqrt(2) * sigma_d * Z**2 / (fx * baseline)


@wrong(None, "loop over lists")
def only_the_first_depth(Z, fx, baseline, sigma_d):
    for z in np.ravel(Z):
        return z**2 * sigma_d / (fx * baseline)


@wrong(None, "loop over lists", kind="raised")
def loop_over_a_number(Z, fx, baseline, sigma_d):
    return np.array([z**2 * sigma_d / (fx * baseline) for z in Z])


@wrong(None, "math", kind="raised")
def math_takes_one_number(Z, fx, baseline, sigma_d):
    return math.pow(Z, 2) / (fx * baseline) * sigma_d


@wrong(None, "vectorised", kind="raised")
def caret_for_a_power(Z, fx, baseline, sigma_d):
    return Z ^ 2 / (fx * baseline) * sigma_d


@wrong("baseline_behind_the_fraction", "one line")
def left_to_right(Z, fx, baseline, sigma_d):
    return np.asarray(Z) ** 2 / fx * baseline * sigma_d


@wrong("focal_length_behind_the_fraction", "one line")
def left_to_right_the_other_way(Z, fx, baseline, sigma_d):
    return np.asarray(Z) ** 2 / baseline * fx * sigma_d
