"""Wrong answers to `reprojection_rms` of notebook 03."""

import numpy as np


def vectorised(observed, predicted):
    d = observed - predicted
    u, v = np.sqrt(np.mean(d**2, axis=0))
    both = np.hypot(u, v)
    return np.array([u, v, both])
