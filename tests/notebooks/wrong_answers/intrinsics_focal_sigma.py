"""Wrong answers to `focal_sigma` of notebook 03."""

import math

import numpy as np

from wrong_answers import wrong


@wrong("nothing_fitted", "vectorised")
def mean_square(J, residuals):
    return np.sqrt(np.linalg.inv(J.T @ J)[0, 0] * np.mean(residuals**2))


@wrong("one_parameter", "numpy's own")
def variance_with_ddof(J, residuals):
    noise = (residuals**2).sum() / (residuals.size - 1)
    return math.sqrt(noise * np.linalg.inv(J.T.dot(J))[0][0])


@wrong("corners_counted", "loop over lists")
def corners_less_parameters(J, residuals):
    corners = len(residuals) / 2
    freedom = corners - len(J[0])
    return (sum(r * r for r in residuals) / freedom * np.linalg.inv(J.T @ J)[0, 0]) ** 0.5


@wrong("no_noise", "linalg")
def geometry_only(J, residuals):
    return np.linalg.norm(np.linalg.pinv(J)[0])


@wrong("noise_not_squared", "vectorised")
def times_the_standard_deviation(J, residuals):
    sigma = np.sqrt(residuals @ residuals / (J.shape[0] - J.shape[1]))
    return np.sqrt(np.diag(sigma * np.linalg.inv(J.T @ J))[0])


@wrong("noise_summed", "linalg")
def norm_of_the_residuals(J, residuals):
    return np.linalg.norm(residuals) * np.sqrt(np.linalg.inv(J.T @ J)[0, 0])


@wrong("spread_of_residuals", "numpy's own")
def standard_deviation_of_the_residuals(J, residuals):
    return np.std(residuals) * np.sqrt(np.linalg.inv(J.T @ J)[0, 0])


@wrong("two_dimensional_rms", "vectorised")
def opencvs_rms_for_sigma(J, residuals):
    du, dv = residuals[0::2], residuals[1::2]
    rms = np.sqrt(np.mean(du**2 + dv**2))
    return rms * np.linalg.norm(np.linalg.pinv(J)[0])


@wrong("others_known", "vectorised")
def only_its_own_column(J, residuals):
    s2 = residuals @ residuals / (len(J) - J.shape[1])
    return np.sqrt(s2 / (J[:, 0] @ J[:, 0]))


@wrong("not_inverted", "vectorised")
def information_for_covariance(J, residuals):
    s2 = residuals @ residuals / (len(J) - J.shape[1])
    return np.sqrt(s2 * (J.T @ J)[0, 0])


@wrong("last_parameter", "vectorised")
def the_last_of_the_diagonal(J, residuals):
    M, P = J.shape
    C = residuals @ residuals / (M - P) * np.linalg.inv(J.T @ J)
    return np.sqrt(C[-1, -1])


@wrong("divided_by_noise", "weights")
def weighted_the_wrong_way(J, residuals):
    s2 = residuals @ residuals / (len(J) - J.shape[1])
    weighted = J * np.sqrt(s2)
    return np.sqrt(np.linalg.inv(weighted.T @ weighted)[0, 0])


@wrong("variance", "vectorised")
def element_of_the_covariance(J, residuals):
    M, P = J.shape
    return (np.linalg.inv(J.T @ J) * (residuals @ residuals) / (M - P))[0, 0]


@wrong("ninety_five", "vectorised")
def half_an_interval(J, residuals):
    M, P = J.shape
    C = np.linalg.inv(J.T @ J) * (residuals @ residuals) / (M - P)
    return 1.96 * np.sqrt(C[0, 0])


@wrong("several, first nothing_fitted", "vectorised")
def variance_and_no_freedom(J, residuals):
    return np.linalg.inv(J.T @ J)[0, 0] * np.mean(residuals**2)


@wrong(None, "vectorised")
def all_sigmas(J, residuals):
    M, P = J.shape
    C = np.linalg.inv(J.T @ J) * (residuals @ residuals) / (M - P)
    return np.sqrt(np.diag(C))


@wrong(None, "vectorised")
def mean_taken_away(J, residuals):
    M, P = J.shape
    return np.sqrt(np.linalg.inv(J.T @ J)[0, 0] * np.var(residuals) * M / (M - P))


@wrong(None, "vectorised", kind="raised")
def transposed_the_wrong_one(J, residuals):
    M, P = J.shape
    return np.sqrt((J @ J.T)[0, 0] * residuals / (M - P) @ J.T)
