"""Wrong answers to `focal_sigma` of notebook 03."""

import numpy as np

from wrong_answers import wrong


def vectorised(J, residuals):
    M, P = J.shape
    s2 = residuals @ residuals / (M - P)
    C = s2 * np.linalg.inv(J.T @ J)
    return np.sqrt(C[0, 0])


@wrong("two_dimensional_rms")
def opencvs_rms_for_sigma(J, residuals):
    du, dv = residuals[0::2], residuals[1::2]
    rms = np.sqrt(np.mean(du**2 + dv**2))
    return rms * np.linalg.norm(np.linalg.pinv(J)[0])
