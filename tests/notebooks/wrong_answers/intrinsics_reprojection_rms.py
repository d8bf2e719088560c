"""Wrong answers to `reprojection_rms` of notebook 03."""

import math

import numpy as np

from wrong_answers import changed


def vectorised(observed, predicted):
    d = observed - predicted
    u, v = np.sqrt(np.mean(d**2, axis=0))
    both = np.hypot(u, v)
    return np.array([u, v, both])


changed(
    vectorised,
    {
        # one axis
        "np.sqrt(np.mean(d**2, axis=0)) -> np.std(d, axis=0)": "mean_removed",
        "[u, v, both] -> [np.std(d[:, 0]), np.std(d[:, 1]), both]": "mean_removed",
        "np.sqrt(np.mean(d**2, axis=0)) -> np.abs(d).mean(axis=0)": "mean_absolute",
        "[u, v, both] -> [np.abs(d[:, 0]).mean(), np.abs(d[:, 1]).mean(), both]": "mean_absolute",
        "np.sqrt(np.mean(d**2, axis=0)) -> d.mean(axis=0)": "signed_mean",
        "[u, v, both] -> [u**2, v**2, both]": "no_root",
        "np.sqrt(np.mean(d**2, axis=0)) -> np.linalg.norm(d, axis=0)": "summed",
        "np.mean(d**2, axis=0) -> (d**2).sum(axis=0) / d.size": "axis_over_2n",
        "np.sqrt(np.mean(d**2, axis=0)) -> np.abs(d).max(axis=0)": "largest",
        # both axes
        "np.hypot(u, v) -> np.sqrt(np.mean(d**2))": "both_over_2n",
        "np.hypot(u, v) -> u + v": "added",
        "np.hypot(u, v) -> (u + v) / 2": "mean_of_axes",
        "np.hypot(u, v) -> u**2 + v**2": "squared",
        "np.hypot(u, v) -> np.linalg.norm(d)": "norm_of_everything",
        # what is returned
        "[u, v, both] -> [u**2, v**2, both**2]": "squares_everywhere",
        "[u, v, both] -> [v, u, both]": "exchanged",
        "[u, v, both] -> [both, u, v]": "both_first",
        "d = observed - predicted -> observed -= predicted\n    d = observed": "in_place",
        "np.sqrt(np.mean(d**2, axis=0)) -> np.std(d, axis=0) and np.hypot(u, v) -> u + v": (
            "several, first mean_removed"
        ),
        "[u, v, both] -> [u, v]": None,
        "[u, v, both] -> np.sqrt(np.mean(d**2, axis=1))": None,
        "np.mean(d**2, axis=0) -> np.mean(d ^ 2, axis=0)": "raised",
    },
)


def loop_over_lists(observed, predicted):
    n = len(observed)
    d = [(u - pu, v - pv) for (u, v), (pu, pv) in zip(observed, predicted, strict=True)]
    u = math.sqrt(sum(a * a for a, _ in d) / n)
    v = math.sqrt(sum(b * b for _, b in d) / n)
    return u, v, math.hypot(u, v)


changed(
    loop_over_lists,
    {
        "n = len(observed) -> n = len(observed) - 1": "divided_by_n_minus_1",
        "math.hypot(u, v) -> sum(math.hypot(*one) for one in d) / n": "mean_distance",
        "math.sqrt(sum(a * a for a, _ in d) / n) -> sum(abs(a) for a, _ in d) / n "
        "and math.sqrt(sum(b * b for _, b in d) / n) -> sum(abs(b) for _, b in d) / n "
        "and math.hypot(u, v) -> sum(math.hypot(*one) for one in d) / n": ("mean_distances"),
    },
)
