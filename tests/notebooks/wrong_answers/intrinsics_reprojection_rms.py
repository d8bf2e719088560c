"""Wrong answers to `reprojection_rms` of notebook 03."""

import math
import statistics

import numpy as np

from wrong_answers import wrong

# --- one axis ------------------------------------------------------------------------------------


@wrong("mean_removed", "vectorised")
def spread_of_each_axis(observed, predicted):
    du, dv = (observed - predicted).T
    return np.std(du), np.std(dv), np.hypot(np.std(du), np.std(dv))


@wrong("mean_removed", "statistics")
def spread_but_true_distance(observed, predicted):
    du = [float(o[0] - p[0]) for o, p in zip(observed, predicted, strict=True)]
    dv = [float(o[1] - p[1]) for o, p in zip(observed, predicted, strict=True)]
    both = math.sqrt(statistics.fmean(u * u + v * v for u, v in zip(du, dv, strict=True)))
    return statistics.pstdev(du), statistics.pstdev(dv), both


@wrong("divided_by_n_minus_1", "loop over lists")
def one_less_to_be_safe(observed, predicted):
    total_u = total_v = 0.0
    for (u, v), (pu, pv) in zip(observed, predicted, strict=True):
        total_u += (u - pu) ** 2
        total_v += (v - pv) ** 2
    n = len(observed) - 1
    return math.sqrt(total_u / n), math.sqrt(total_v / n), math.sqrt((total_u + total_v) / n)


@wrong("mean_absolute", "vectorised")
def absolute_values(observed, predicted):
    error = np.abs(observed - predicted).mean(axis=0)
    return error[0], error[1], np.linalg.norm(error)


@wrong("mean_absolute", "vectorised")
def absolute_values_only_per_axis(observed, predicted):
    error = predicted - observed
    both = np.sqrt((error**2).sum(axis=1).mean())
    return [np.abs(error[:, 0]).mean(), np.abs(error[:, 1]).mean(), both]


@wrong("signed_mean", "vectorised")
def mean_error(observed, predicted):
    u, v = (observed - predicted).mean(0)
    return u, v, math.sqrt(u**2 + v**2)


@wrong("no_root", "vectorised")
def mean_squares(observed, predicted):
    squares = (observed - predicted) ** 2
    u, v = squares.mean(axis=0)
    return u, v, np.sqrt(squares.sum(axis=1).mean())


@wrong("summed", "linalg")
def norms_of_columns(observed, predicted):
    u = np.linalg.norm(observed[:, 0] - predicted[:, 0])
    v = np.linalg.norm(observed[:, 1] - predicted[:, 1])
    return u, v, np.hypot(u, v)


@wrong("axis_over_2n", "vectorised")
def size_for_the_number_of_corners(observed, predicted):
    squares = (observed - predicted) ** 2
    u, v = np.sqrt(squares.sum(axis=0) / squares.size)
    return u, v, np.sqrt(u**2 + v**2)


@wrong("largest", "vectorised")
def worst_corner(observed, predicted):
    du, dv = np.abs(observed - predicted).max(axis=0)
    return du, dv, np.hypot(du, dv)


# --- both axes -----------------------------------------------------------------------------------


@wrong("both_over_2n", "vectorised")
def mean_of_all_squares(observed, predicted):
    d = predicted - observed
    rms = [math.sqrt(np.mean(d[:, k] ** 2)) for k in range(2)]
    return *rms, math.sqrt(np.mean(d**2))


@wrong("mean_distance", "loop over lists")
def average_distance(observed, predicted):
    d = observed - predicted
    distance = [math.dist(o, p) for o, p in zip(observed, predicted, strict=True)]
    return np.sqrt(np.mean(d[:, 0] ** 2)), np.sqrt(np.mean(d[:, 1] ** 2)), np.mean(distance)


@wrong("added", "vectorised")
def the_sum(observed, predicted):
    u, v = np.sqrt(np.mean((observed - predicted) ** 2, 0))
    return u, v, u + v


@wrong("mean_of_axes", "vectorised")
def the_average(observed, predicted):
    rms = np.sqrt(np.mean((observed - predicted) ** 2, 0))
    return np.append(rms, rms.mean())


@wrong("both_without_root", "vectorised")
def squared_distance(observed, predicted):
    d2 = (observed - predicted) ** 2
    return np.sqrt(d2[:, 0].mean()), np.sqrt(d2[:, 1].mean()), d2.sum(1).mean()


@wrong("norm_of_everything", "linalg")
def frobenius(observed, predicted):
    d = observed - predicted
    return *np.sqrt(np.mean(d**2, axis=0)), np.linalg.norm(d)


# --- what is returned ----------------------------------------------------------------------------


@wrong("squares_everywhere", "vectorised")
def mean_squares_only(observed, predicted):
    squares = np.mean((observed - predicted) ** 2, axis=0)
    return squares[0], squares[1], squares.sum()


@wrong("mean_distances_everywhere", "loop over lists")
def how_far_off_on_average(observed, predicted):
    n = len(observed)
    off = [(o[0] - p[0], o[1] - p[1]) for o, p in zip(observed, predicted, strict=True)]
    u = sum(abs(a) for a, _ in off) / n
    v = sum(abs(b) for _, b in off) / n
    return u, v, sum(math.hypot(a, b) for a, b in off) / n


@wrong("v_before_u", "vectorised")
def rows_before_columns(observed, predicted):
    u, v = np.sqrt(np.mean((observed - predicted) ** 2, axis=0))
    return v, u, np.hypot(u, v)


@wrong("both_first", "vectorised")
def the_usual_number_first(observed, predicted):
    u, v = np.sqrt(np.mean((observed - predicted) ** 2, axis=0))
    return np.hypot(u, v), u, v


@wrong("in_place", "vectorised")
def difference_in_place(observed, predicted):
    observed -= predicted
    u, v = np.sqrt(np.mean(observed**2, axis=0))
    return u, v, np.hypot(u, v)


@wrong("several, first mean_removed", "vectorised")
def spread_and_sum(observed, predicted):
    u, v = np.std(observed - predicted, axis=0)
    return u, v, u + v


@wrong(None, "vectorised")
def only_two_numbers(observed, predicted):
    return np.sqrt(np.mean((observed - predicted) ** 2, axis=0))


@wrong(None, "vectorised")
def over_the_other_axis(observed, predicted):
    return np.sqrt(np.mean((observed - predicted) ** 2, axis=1))


@wrong(None, "vectorised", kind="raised")
def caret_for_a_power(observed, predicted):
    return np.sqrt(np.mean((observed - predicted) ^ 2))
