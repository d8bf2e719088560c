"""Notebook 03: its two exercises and the mistakes that people make in them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.lessons.exercises import Exercise, Model, Step

# --- reprojection_rms ---


def _difference(observed: Floats, predicted: Floats) -> Floats:
    return observed - predicted


def _root_mean_square(residuals: Floats) -> Floats:
    return np.sqrt(np.mean(residuals**2, axis=0))


def _both_axes(residuals: Floats, axes: Floats) -> float:
    return float(np.hypot(*axes))


def _as_they_are(residuals: Floats, axes: Floats) -> Floats:
    return axes


def _u_v_both(axes: Floats, both: float) -> Floats:
    return np.array([*axes, both])


def _build_rms(steps: Mapping[str, Step]) -> Model:
    def reprojection_rms(observed: Floats, predicted: Floats) -> Floats:
        residuals = steps["difference"](observed, predicted)
        axes = steps["axis"](residuals)
        both = steps["both"](residuals, axes)
        result = steps["order"](steps["shown"](residuals, axes), both)
        return steps["whole"](residuals, result)

    return reprojection_rms


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


REPROJECTION_RMS = Exercise(
    name="intrinsics.reprojection_rms",
    build=_build_rms,
    steps={
        "difference": _difference,
        "axis": _root_mean_square,
        "both": _both_axes,
        "shown": _as_they_are,
        "order": _u_v_both,
        "whole": _as_they_are,
    },
    cases=[
        (np.array([[103.0, 54.0], [201.0, 50.0]]), np.array([[100.0, 50.0], [200.0, 50.0]])),
        (
            np.array([[312.2, 80.1], [40.6, 431.3], [500.0, 222.7]]),
            np.array([[312.0, 80.4], [41.0, 431.0], [499.9, 222.5]]),
        ),
        _corners(1, 7, (0.20, 0.10), 0.3),
        _corners(2, 54, (0.10, 0.15), -0.1),
        _corners(3, 120, (0.25, 0.08), 0.05),
    ],
    per_row=0,
    unit="px",
    tolerance=1e-7,
    describe=_describe_rms,
    show=lambda row: "(" + ", ".join(f"{v:.4f}" for v in np.ravel(row)) + ")",
)


def _wrong_axis(wrong: Step) -> Step:
    """A mistake in the numbers of the two axes, whether or not the 2-D number is made of them."""

    def only_shown(residuals: Floats, axes: Floats) -> Floats:
        return np.asarray(wrong(residuals))

    REPROJECTION_RMS.mistake("axis")(wrong)
    REPROJECTION_RMS.mistake("shown", same_as=wrong)(only_shown)
    return wrong


@_wrong_axis
def mean_removed(residuals: Floats) -> Floats:
    """that is the standard deviation, which takes the mean away first

    All corners 1 px too far right: what does a standard deviation say, and what should an error
    measure say?
    """
    return np.std(residuals, axis=0)


@_wrong_axis
def divided_by_n_minus_1(residuals: Floats) -> Floats:
    """the sum of squares is divided by N - 1

    N - 1 belongs to a spread about a mean that was itself estimated. Is there such a mean here?
    """
    return np.sqrt(np.sum(residuals**2, axis=0) / (len(residuals) - 1))


@_wrong_axis
def mean_absolute(residuals: Floats) -> Floats:
    """that is the mean absolute error

    The letters of RMS, from the right: square, mean, root. Which of them does yours lack?
    """
    return np.mean(np.abs(residuals), axis=0)


@_wrong_axis
def signed_mean(residuals: Floats) -> Floats:
    """that is the mean error with its sign: left and right cancel

    Two corners, one 1 px too far left, one 1 px too far right: what does yours say?
    """
    return np.mean(residuals, axis=0)


@_wrong_axis
def no_root(residuals: Floats) -> Floats:
    """the root is missing: these are px²

    What is the unit of your result, and which one is wanted?
    """
    return np.mean(residuals**2, axis=0)


@_wrong_axis
def summed(residuals: Floats) -> Floats:
    """you add the squares up but do not take their mean

    Twice as many corners, each as good as before: should the number grow?
    """
    return np.sqrt(np.sum(residuals**2, axis=0))


@_wrong_axis
def axis_over_2n(residuals: Floats) -> Floats:
    """the sum of squares of one axis is divided by 2N

    N corners have N errors in u. By how many do you divide their squares?
    """
    return np.sqrt(np.sum(residuals**2, axis=0) / (2 * len(residuals)))


@_wrong_axis
def largest(residuals: Floats) -> Floats:
    """that is the largest error, not the root mean square

    What does one bad corner among a thousand do to your number?
    """
    return np.max(np.abs(residuals), axis=0)


@REPROJECTION_RMS.mistake("both")
def both_over_2n(residuals: Floats, axes: Floats) -> float:
    """for the 2-D value you take the mean over 2N coordinates instead of over N corners

    One corner, 3 px off in u and 4 px in v: how far off is it? What does yours say?
    """
    return float(np.sqrt(np.mean(axes**2)))


@REPROJECTION_RMS.mistake("both")
def mean_distance(residuals: Floats, axes: Floats) -> float:
    """the 2-D value is a mean of the distances, not their root mean square

    You have the distance of each corner. Square, mean, root: in which order did you do them?
    """
    return float(np.mean(np.linalg.norm(residuals, axis=1)))


@REPROJECTION_RMS.mistake("both")
def added(residuals: Floats, axes: Floats) -> float:
    """the RMS of the two axes are added

    3 px to the right and 4 px down: how far is that as the crow flies?
    """
    return float(np.sum(axes))


@REPROJECTION_RMS.mistake("both")
def mean_of_axes(residuals: Floats, axes: Floats) -> float:
    """the 2-D value is the mean of the two axes

    3 px to the right and 4 px down: can the distance be less than either of the two?
    """
    return float(np.mean(axes))


@REPROJECTION_RMS.mistake("both")
def both_without_root(residuals: Floats, axes: Floats) -> float:
    """the root is missing in the 2-D value

    What is its unit, and what is the unit of the other two?
    """
    return float(np.sum(axes**2))


@REPROJECTION_RMS.mistake("both")
def norm_of_everything(residuals: Floats, axes: Floats) -> float:
    """the 2-D value is that of all corners together: a sum, not a mean

    The norm of all residuals grows with every corner that you add. Should it?
    """
    return float(np.linalg.norm(residuals))


@REPROJECTION_RMS.mistake("whole")
def squares_everywhere(residuals: Floats, result: Floats) -> Floats:
    """no root is taken: all three are in px²

    What is the unit of your result, and which one is wanted?
    """
    return result**2


@REPROJECTION_RMS.mistake("whole")
def mean_distances_everywhere(residuals: Floats, result: Floats) -> Floats:
    """these are mean distances, in u, in v and in two dimensions, not root mean squares

    The letters of RMS, from the right: square, mean, root. Which of them does yours lack?
    """
    distance = np.linalg.norm(residuals, axis=1)
    return np.array([*np.abs(residuals).mean(axis=0), distance.mean()])


@REPROJECTION_RMS.mistake("order")
def v_before_u(axes: Floats, both: float) -> Floats:
    """u and v are swapped

    Columns of the array: which of them is u?
    """
    return np.array([axes[1], axes[0], both])


@REPROJECTION_RMS.mistake("order")
def both_first(axes: Floats, both: float) -> Floats:
    """the 2-D value stands first

    The exercise asks for (RMS in u, RMS in v, 2-D RMS).
    """
    return np.array([both, *axes])


# --- focal_sigma ---


def _freedom(J: Floats, residuals: Floats) -> float:
    return float(J.shape[0] - J.shape[1])


def _noise_variance(residuals: Floats, freedom: float) -> float:
    return float(residuals @ residuals) / freedom


def _information(J: Floats) -> Floats:
    return J.T @ J


def _first_of_inverse(information: Floats) -> float:
    return float(np.linalg.inv(information)[0, 0])


def _times(noise: float, first: float) -> float:
    return noise * first


def _build_sigma(steps: Mapping[str, Step]) -> Model:
    def focal_sigma(J: Floats, residuals: Floats) -> Any:
        noise = steps["noise"](residuals, steps["freedom"](J, residuals))
        first = steps["first"](steps["information"](J))
        return steps["root"](steps["scale"](noise, first))

    return focal_sigma


def _least_squares(seed: int, rows: int, columns: int, sigma: float) -> tuple[Floats, Floats]:
    """A Jacobian with correlated columns, and residuals that a fit leaves: none along J."""
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(rows, columns)) @ (np.eye(columns) + 0.4 * rng.random((columns, columns)))
    noise = rng.normal(0.0, sigma, rows)
    return J, noise - J @ np.linalg.lstsq(J, noise, rcond=None)[0]


FOCAL_SIGMA = Exercise(
    name="intrinsics.focal_sigma",
    build=_build_sigma,
    steps={
        "freedom": _freedom,
        "noise": _noise_variance,
        "information": _information,
        "first": _first_of_inverse,
        "scale": _times,
        "root": math.sqrt,
    },
    cases=[
        (
            np.array([[1.0, 0.0], [1.0, 1.0], [1.0, 2.0], [1.0, 3.0], [1.0, 4.0], [1.0, 5.0]]),
            np.array([1.0, -2.0, 1.0, 1.0, -2.0, 1.0]),
        ),
        _least_squares(1, 8, 2, 0.5),
        _least_squares(2, 24, 5, 0.1),
        _least_squares(3, 108, 15, 0.08),
        _least_squares(4, 60, 9, 2.0),
    ],
    per_row=0,
    unit="px",
    tolerance=1e-9,
    describe=lambda args: (
        f"J is {args[0].shape[0]}x{args[0].shape[1]}"
        + (f" with rows {args[0].tolist()}, residuals {args[1].tolist()}" * (len(args[0]) < 7))
    ),
    show=lambda row: f"{float(row):.5f}",
)


@FOCAL_SIGMA.mistake("freedom")
def nothing_fitted(J: Floats, residuals: Floats) -> float:
    """the sum of squares is divided by the number of residuals, as if nothing had been fitted

    Ten residuals and ten fitted parameters: how large are the residuals then, whatever the noise?
    What has to stand below the sum?
    """
    return float(J.shape[0])


@FOCAL_SIGMA.mistake("freedom")
def one_parameter(J: Floats, residuals: Floats) -> float:
    """one degree of freedom is taken off, not one for each parameter

    N - 1 is for a single fitted number, the mean. How many numbers has this fit?
    """
    return float(J.shape[0] - 1)


@FOCAL_SIGMA.mistake("freedom")
def corners_counted(J: Floats, residuals: Floats) -> float:
    """you count corners where you should count coordinates

    Each corner gives two residuals, and J has a row for each. How many rows has J?
    """
    return J.shape[0] / 2 - J.shape[1]


@FOCAL_SIGMA.mistake("noise")
def no_noise(residuals: Floats, freedom: float) -> float:
    """the noise does not enter: this is sigma for residuals of 1 px

    Twice as noisy corners: is your fx then known equally well?
    """
    return 1.0


@FOCAL_SIGMA.mistake("noise")
def noise_not_squared(residuals: Floats, freedom: float) -> float:
    """the covariance is scaled by the noise's standard deviation instead of its variance

    A covariance is in squared units. Which power of the noise has the same?
    """
    return math.sqrt(float(residuals @ residuals) / freedom)


@FOCAL_SIGMA.mistake("noise")
def noise_summed(residuals: Floats, freedom: float) -> float:
    """the squares are added up but not divided by the degrees of freedom

    Twice as many corners: does your sigma fall?
    """
    return float(residuals @ residuals)


@FOCAL_SIGMA.mistake("noise")
def spread_of_residuals(residuals: Floats, freedom: float) -> float:
    """the noise is taken as the standard deviation of the residuals: no parameter is counted

    Ten residuals and ten fitted parameters: how large is the standard deviation of what is left?
    """
    return float(np.var(residuals))


@FOCAL_SIGMA.mistake("noise")
def two_dimensional_rms(residuals: Floats, freedom: float) -> float:
    """the noise is the 2-D RMS, and J has a row for each coordinate

    A corner that is 0.1 px off in u and in v is 0.14 px off. Which of the two belongs to a row?
    """
    return float(2 * np.mean(residuals**2))


@FOCAL_SIGMA.mistake("first")
def others_known(information: Floats) -> float:
    """that is sigma of fx if all other parameters were known exactly

    The first element of the inverse is not the inverse of the first element, unless the matrix is
    diagonal. Which of the two lets the board's distance move along with fx?
    """
    return float(1.0 / information[0, 0])


@FOCAL_SIGMA.mistake("first")
def not_inverted(information: Floats) -> float:
    """the matrix is not inverted

    J^T J is large where the data say a lot. Should sigma be large there?
    """
    return float(information[0, 0])


@FOCAL_SIGMA.mistake("first")
def last_parameter(information: Floats) -> float:
    """that is sigma of the last parameter

    Which column of J belongs to fx?
    """
    return float(np.linalg.inv(information)[-1, -1])


@FOCAL_SIGMA.mistake("scale")
def divided_by_noise(noise: float, first: float) -> float:
    """you divide by the noise where you should multiply

    Noisier corners, better fx?
    """
    return first / noise


@FOCAL_SIGMA.mistake("root")
def variance(value: float) -> float:
    """that is the variance, and a standard deviation is wanted

    What is the unit of your result?
    """
    return value


@FOCAL_SIGMA.mistake("root")
def ninety_five(value: float) -> float:
    """that is half of a 95 % interval, and one standard deviation is wanted

    Which factor turns the one into the other?
    """
    return 1.96 * math.sqrt(value)
