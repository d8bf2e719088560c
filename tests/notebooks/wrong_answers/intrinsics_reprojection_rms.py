"""Wrong answers to `reprojection_rms` of notebook 03."""

import math

import numpy as np


def vectorised(observed, predicted):
    d = observed - predicted
    u, v = np.sqrt(np.mean(d**2, axis=0))
    both = np.hypot(u, v)
    return np.array([u, v, both])


def loop_over_lists(observed, predicted):
    n = len(observed)
    d = [(u - pu, v - pv) for (u, v), (pu, pv) in zip(observed, predicted, strict=True)]
    u = math.sqrt(sum(a * a for a, _ in d) / n)
    v = math.sqrt(sum(b * b for _, b in d) / n)
    return u, v, math.hypot(u, v)
