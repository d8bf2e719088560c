"""Wrong answers to `focal_sigma` of notebook 03."""

import numpy as np

from wrong_answers import changed, wrong


def vectorised(J, residuals):
    M, P = J.shape
    s2 = residuals @ residuals / (M - P)
    C = s2 * np.linalg.inv(J.T @ J)
    return np.sqrt(C[0, 0])


changed(
    vectorised,
    {
        "(M - P) -> M": "nothing_fitted",
        "(M - P) -> (M - 1)": "one_parameter",
        "(M - P) -> (M / 2 - P)": "corners_counted",
        "s2 * np -> np": "no_noise",
        "s2 * np -> np.sqrt(s2) * np": "noise_not_squared",
        " / (M - P) -> ": "noise_summed",
        "residuals @ residuals / (M - P) -> np.var(residuals)": "spread_of_residuals",
        "C[0, 0] -> s2 / (J[:, 0] @ J[:, 0])": "others_known",
        "np.linalg.inv(J.T @ J) -> J.T @ J": "not_inverted",
        "C[0, 0] -> C[-1, -1]": "last_parameter",
        "s2 * np -> 1 / s2 * np": "divided_by_noise",
        "np.sqrt(C[0, 0]) -> C[0, 0]": "squared",
        "np.sqrt(C[0, 0]) -> 1.96 * np.sqrt(C[0, 0])": "ninety_five",
        "(M - P) -> M and np.sqrt(C[0, 0]) -> C[0, 0]": "several, first nothing_fitted",
        "C[0, 0] -> np.diag(C)": None,
        "residuals @ residuals -> np.var(residuals) * M": "mean_taken_off",
        "np.linalg.inv(J.T @ J) -> (J @ J.T) * residuals @ J.T": "raised",
    },
)


@wrong("two_dimensional_rms")
def opencvs_rms_for_sigma(J, residuals):
    du, dv = residuals[0::2], residuals[1::2]
    rms = np.sqrt(np.mean(du**2 + dv**2))
    return rms * np.linalg.norm(np.linalg.pinv(J)[0])
