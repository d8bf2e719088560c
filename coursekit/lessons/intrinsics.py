"""Notebook 03: its two exercises and the mistakes that people make in them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.lessons.exercises import Exercise, Steps

# --- reprojection_rms ---


def _reprojection_rms(steps: Steps, observed: Floats, predicted: Floats) -> Floats:
    residuals = steps["difference"](observed, predicted)
    axes = steps["axis"](residuals)
    both = steps["both"](residuals, axes)
    result = steps["order"](steps["shown"](residuals, axes), both)
    return steps["whole"](residuals, result)


def _corners(seed: int, n: int, spread: tuple[float, float], offset: float) -> tuple[Any, ...]:
    """Predicted corners and where they were found, in px, with another error in u than in v."""
    rng = np.random.default_rng(seed)
    predicted = rng.uniform((20, 20), (620, 460), (n, 2)).round(2)
    error = rng.normal((offset, 0.0), spread, (n, 2))
    return (predicted + error).round(3), predicted


def _describe_rms(args: tuple[Any, ...]) -> str:
    residuals = np.round(args[0] - args[1], 3)
    if len(residuals) > 3:
        return f"{len(residuals)} corners"
    return "residuals " + ", ".join(f"({u:g}, {v:g})" for u, v in residuals) + " px"


def _rms_by_axes(observed: Floats, predicted: Floats) -> Any:
    error = observed - predicted
    n = len(error)
    u = np.sqrt(np.sum(error[:, 0] ** 2) / n)
    v = np.sqrt(np.sum(error[:, 1] ** 2) / n)
    return u, v, np.sqrt(u**2 + v**2)


def _rms_by_rows(observed: Floats, predicted: Floats) -> Any:
    u = v = both = 0.0
    for seen, there in zip(observed, predicted, strict=True):
        du, dv = seen[0] - there[0], seen[1] - there[1]
        u += du**2
        v += dv**2
        both += du**2 + dv**2
    n = len(observed)
    return np.sqrt(u / n), np.sqrt(v / n), np.sqrt(both / n)


REPROJECTION_RMS = Exercise.told(
    "intrinsics.reprojection_rms",
    build=_reprojection_rms,
    steps={
        "difference": lambda observed, predicted: observed - predicted,
        "axis": lambda residuals: np.sqrt(np.mean(residuals**2, axis=0)),
        "both": lambda residuals, axes: float(np.hypot(*axes)),
        "shown": lambda residuals, axes: axes,
        "order": lambda axes, both: np.array([*axes, both]),
        "whole": lambda residuals, result: result,
    },
    cases=[
        _corners(1, 7, (0.20, 0.10), 0.3),
        _corners(2, 54, (0.10, 0.15), -0.1),
        _corners(4, 60, (4.0, 7.0), -2.0),
        _corners(3, 120, (0.25, 0.08), 0.05),
    ],
    describe=_describe_rms,
    styles=[_rms_by_axes, _rms_by_rows],
)


def _with_lengths(residuals: Floats) -> Floats:
    return np.c_[residuals, np.linalg.norm(residuals, axis=1)]


def _squares_subtracted(observed: Floats, predicted: Floats) -> Floats:
    axes = np.sqrt(np.abs(np.mean(observed**2 - predicted**2, axis=0)))
    return np.array([*axes, np.hypot(*axes)])


for _step in ("axis", "shown"):  # whether or not the 2-D number is made of them
    REPROJECTION_RMS.add_mistakes(
        (_step, "mean_removed", lambda e, *_: np.std(e, axis=0)),
        (_step, "divided_by_n_minus_1", lambda e, *_: np.sqrt(np.sum(e**2, axis=0) / (len(e) - 1))),
        (_step, "mean_absolute", lambda e, *_: np.mean(np.abs(e), axis=0)),
        (_step, "signed_mean", lambda e, *_: np.mean(e, axis=0)),
        (_step, "mean_before_square", lambda e, *_: np.abs(np.mean(e, axis=0))),
        (_step, "first_only", lambda e, *_: abs(e[0]) / len(e) ** 0.5, lambda e, *_: abs(e[0])),
        (_step, "first_column_twice", lambda e, *_: np.sqrt(np.mean(e**2, axis=0))[[0, 0]]),
        (_step, "no_root", lambda e, *_: np.mean(e**2, axis=0)),
        (_step, "summed", lambda e, *_: np.sqrt(np.sum(e**2, axis=0))),
        (_step, "axis_over_2n", lambda e, *_: np.sqrt(np.sum(e**2, axis=0) / (2 * len(e)))),
        (_step, "root_before_the_mean", lambda e, *_: np.sqrt(np.sum(e**2, axis=0)) / len(e)),
        (_step, "median_absolute", lambda e, *_: np.sqrt(np.median(e**2, axis=0))),
        (_step, "largest", lambda e, *_: np.max(np.abs(e), axis=0)),
        (_step, "median_absolute", lambda e, *_: np.median(np.abs(e), axis=0)),
        (_step, "wrong_axis", lambda e, *_: np.sqrt(np.mean(e**2, axis=1))[:2]),
    )
REPROJECTION_RMS.add_mistakes(
    ("whole", "mean_removed", lambda e, result: np.std(_with_lengths(e), axis=0)),
    ("whole", "largest", lambda e, result: np.max(np.abs(_with_lengths(e)), axis=0)),
    ("whole", "median_absolute", lambda e, result: np.median(np.abs(_with_lengths(e)), axis=0)),
    ("both", "both_over_2n", lambda residuals, axes: float(np.sqrt(np.mean(axes**2)))),
    ("both", "mean_distance", lambda e, axes: float(np.mean(np.linalg.norm(e, axis=1)))),
    ("both", "added", lambda residuals, axes: float(np.sum(axes))),
    ("both", "mean_of_axes", lambda residuals, axes: float(np.mean(axes))),
    ("both", "norm_of_everything", lambda residuals, axes: float(np.linalg.norm(residuals))),
    ("whole", "squares_everywhere", lambda residuals, result: result**2),
    ("whole", "mean_distances", lambda e, result: np.mean(np.abs(_with_lengths(e)), axis=0)),
    ("", "squares_subtracted", lambda _: _squares_subtracted),
    ("order", "both_first", lambda axes, both: np.array([both, *axes])),
)


# --- focal_sigma ---


def _focal_sigma(steps: Steps, J: Floats, residuals: Floats) -> Any:
    noise = steps["noise"](residuals, steps["freedom"](J, residuals))
    first = steps["first"](steps["information"](J))
    return steps["root"](steps["scale"](noise, first))


def _least_squares(seed: int, rows: int, columns: int, sigma: float) -> tuple[Floats, Floats]:
    """A Jacobian with correlated columns, and residuals that a fit leaves: none along J."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(rows, columns)) @ (np.eye(columns) + 0.4 * rng.random((columns, columns)))
    noise = rng.normal(0.0, sigma, rows)
    return J, noise - J @ np.linalg.lstsq(J, noise, rcond=None)[0]


FOCAL_SIGMA = Exercise.told(
    "intrinsics.focal_sigma",
    build=_focal_sigma,
    steps={
        "freedom": lambda J, residuals: J.shape[0] - J.shape[1],
        "noise": lambda residuals, freedom: residuals @ residuals / freedom,  # a variance
        "information": lambda J: J.T @ J,
        "first": lambda information: np.linalg.inv(information)[0, 0],
        "scale": lambda noise, first: noise * first,
        "root": math.sqrt,
    },
    cases=[
        _least_squares(1, 8, 2, 0.5),
        _least_squares(2, 24, 5, 0.1),
        _least_squares(3, 108, 15, 0.08),
        _least_squares(4, 60, 9, 2.0),
    ],
    describe=lambda args: (
        f"J is {args[0].shape[0]}x{args[0].shape[1]}"
        + (f" with rows {args[0].tolist()}, residuals {args[1].tolist()}" * (len(args[0]) < 7))
    ),
)


FOCAL_SIGMA.add_mistakes(
    ("first", "all_variances", lambda information: np.trace(np.linalg.inv(information))),
    ("freedom", "nothing_fitted", lambda J, residuals: J.shape[0]),
    ("freedom", "one_parameter", lambda J, residuals: J.shape[0] - 1),
    ("freedom", "corners_counted", lambda J, residuals: J.shape[0] / 2 - J.shape[1]),
    ("freedom", "corners_counted", lambda J, residuals: J.shape[0] * 2 - J.shape[1]),
    ("freedom", "mean_fitted_too", lambda J, residuals: J.shape[0] - J.shape[1] - 1),
    ("freedom", "parameters_for_freedom", lambda J, residuals: J.shape[1]),
    ("noise", "no_noise", lambda residuals, freedom: 1.0),
    ("noise", "noise_not_squared", lambda e, freedom: math.sqrt(e @ e / freedom)),
    ("noise", "noise_not_squared", lambda e, freedom: np.sum(np.abs(e)) / freedom),
    ("noise", "noise_not_squared", lambda e, freedom: np.linalg.norm(e) / freedom),
    ("scale", "noise_outside_the_root", lambda noise, first: noise**2 * first),
    ("noise", "noise_summed", lambda e, freedom: e @ e),
    ("noise", "spread_of_residuals", lambda e, _: np.var(e), lambda e, _: np.var(e, ddof=1)),
    ("noise", "mean_taken_off", lambda e, freedom: len(e) * np.var(e) / freedom),
    ("noise", "divided_twice", lambda e, freedom: np.mean(e**2) / freedom),
    ("noise", "square_of_the_sum", lambda e, freedom: np.sum(e) ** 2 / freedom),
    ("scale", "root_of_the_noise_alone", lambda noise, first: noise * first**2),
    ("noise", "two_dimensional_rms", lambda residuals, freedom: 2 * np.mean(residuals**2)),
    ("first", "others_known", lambda information: 1.0 / information[0, 0]),
    ("first", "not_inverted", lambda information: information[0, 0]),
    ("first", "last_parameter", lambda information: np.linalg.inv(information)[-1, -1]),
    ("first", "second_parameter", lambda information: np.linalg.inv(information)[1, 1]),
    ("first", "whole_row", lambda information: abs(np.sum(np.linalg.inv(information)[0]))),
    ("information", "rows_for_columns", lambda J: np.linalg.pinv(np.linalg.pinv(J @ J.T)[:1, :1])),
    ("scale", "divided_by_noise", lambda noise, first: first / noise),
    ("root", "ninety_five", lambda value: 1.96 * math.sqrt(value)),
)
