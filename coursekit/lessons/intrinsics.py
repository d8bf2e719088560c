"""Notebook 03: its checkpoints, its two exercises and the mistakes that people make in them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from coursekit.lessons.checkpoints import Choice, Classic, Number, Option
from coursekit.lessons.exercises import Exercise, Model, Step
from coursekit.lessons.objectives import Objective

Array = np.ndarray

# --- reprojection_rms ---


def _difference(observed: Array, predicted: Array) -> Array:
    return observed - predicted


def _root_mean_square(residuals: Array) -> Array:
    return np.sqrt(np.mean(residuals**2, axis=0))


def _both_axes(residuals: Array, axes: Array) -> float:
    return float(np.hypot(*axes))


def _as_they_are(residuals: Array, axes: Array) -> Array:
    return axes


def _u_v_both(axes: Array, both: float) -> Array:
    return np.array([*axes, both])


def _build_rms(steps: Mapping[str, Step]) -> Model:
    def reprojection_rms(observed: Array, predicted: Array) -> Array:
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


def _wrong_axis(says: str, ask: str) -> Callable[[Step], Step]:
    """A mistake in the numbers of the two axes, whether or not the 2-D number is made of them."""

    def add(wrong: Step) -> Step:
        REPROJECTION_RMS.mistake("axis", says, ask, name=wrong.__name__)(wrong)

        def only_shown(residuals: Array, axes: Array) -> Array:
            return np.asarray(wrong(residuals))

        REPROJECTION_RMS.mistake("shown", says, ask, name=wrong.__name__)(only_shown)
        return wrong

    return add


@_wrong_axis(
    "that is the standard deviation, which takes the mean away first",
    "All corners 1 px too far right: what does a standard deviation say, and what should an "
    "error measure say?",
)
def mean_removed(residuals: Array) -> Array:
    return np.std(residuals, axis=0)


@_wrong_axis(
    "the sum of squares is divided by N - 1",
    "N - 1 belongs to a spread about a mean that was itself estimated. Is there such a mean here?",
)
def divided_by_n_minus_1(residuals: Array) -> Array:
    return np.sqrt(np.sum(residuals**2, axis=0) / (len(residuals) - 1))


@_wrong_axis(
    "that is the mean absolute error",
    "The letters of RMS, from the right: square, mean, root. Which of them does yours lack?",
)
def mean_absolute(residuals: Array) -> Array:
    return np.mean(np.abs(residuals), axis=0)


@_wrong_axis(
    "that is the mean error with its sign: left and right cancel",
    "Two corners, one 1 px too far left, one 1 px too far right: what does yours say?",
)
def signed_mean(residuals: Array) -> Array:
    return np.mean(residuals, axis=0)


@_wrong_axis(
    "the root is missing: these are px²",
    "What is the unit of your result, and which one is wanted?",
)
def no_root(residuals: Array) -> Array:
    return np.mean(residuals**2, axis=0)


@_wrong_axis(
    "you add the squares up but do not take their mean",
    "Twice as many corners, each as good as before: should the number grow?",
)
def summed(residuals: Array) -> Array:
    return np.sqrt(np.sum(residuals**2, axis=0))


@_wrong_axis(
    "the sum of squares of one axis is divided by 2N",
    "N corners have N errors in u. By how many do you divide their squares?",
)
def axis_over_2n(residuals: Array) -> Array:
    return np.sqrt(np.sum(residuals**2, axis=0) / (2 * len(residuals)))


@_wrong_axis(
    "that is the largest error, not the root mean square",
    "What does one bad corner among a thousand do to your number?",
)
def largest(residuals: Array) -> Array:
    return np.max(np.abs(residuals), axis=0)


@REPROJECTION_RMS.mistake(
    "both",
    "for the 2-D value you take the mean over 2N coordinates instead of over N corners",
    "One corner, 3 px off in u and 4 px in v: how far off is it? What does yours say?",
)
def both_over_2n(residuals: Array, axes: Array) -> float:
    return float(np.sqrt(np.mean(axes**2)))


@REPROJECTION_RMS.mistake(
    "both",
    "the 2-D value is a mean of the distances, not their root mean square",
    "You have the distance of each corner. Square, mean, root: in which order did you do them?",
)
def mean_distance(residuals: Array, axes: Array) -> float:
    return float(np.mean(np.linalg.norm(residuals, axis=1)))


@REPROJECTION_RMS.mistake(
    "both",
    "the RMS of the two axes are added",
    "3 px to the right and 4 px down: how far is that as the crow flies?",
)
def added(residuals: Array, axes: Array) -> float:
    return float(np.sum(axes))


@REPROJECTION_RMS.mistake(
    "both",
    "the 2-D value is the mean of the two axes",
    "3 px to the right and 4 px down: can the distance be less than either of the two?",
)
def mean_of_axes(residuals: Array, axes: Array) -> float:
    return float(np.mean(axes))


@REPROJECTION_RMS.mistake(
    "both",
    "the root is missing in the 2-D value",
    "What is its unit, and what is the unit of the other two?",
)
def both_without_root(residuals: Array, axes: Array) -> float:
    return float(np.sum(axes**2))


@REPROJECTION_RMS.mistake(
    "both",
    "the 2-D value is that of all corners together: a sum, not a mean",
    "The norm of all residuals grows with every corner that you add. Should it?",
)
def norm_of_everything(residuals: Array, axes: Array) -> float:
    return float(np.linalg.norm(residuals))


@REPROJECTION_RMS.mistake(
    "whole",
    "no root is taken: all three are in px²",
    "What is the unit of your result, and which one is wanted?",
)
def squares_everywhere(residuals: Array, result: Array) -> Array:
    return result**2


@REPROJECTION_RMS.mistake(
    "whole",
    "these are mean distances, in u, in v and in two dimensions, not root mean squares",
    "The letters of RMS, from the right: square, mean, root. Which of them does yours lack?",
)
def mean_distances_everywhere(residuals: Array, result: Array) -> Array:
    distance = np.linalg.norm(residuals, axis=1)
    return np.array([*np.abs(residuals).mean(axis=0), distance.mean()])


@REPROJECTION_RMS.mistake(
    "order",
    "u and v are swapped",
    "Columns of the array: which of them is u?",
)
def v_before_u(axes: Array, both: float) -> Array:
    return np.array([axes[1], axes[0], both])


@REPROJECTION_RMS.mistake(
    "order",
    "the 2-D value stands first",
    "The exercise asks for (RMS in u, RMS in v, 2-D RMS).",
)
def both_first(axes: Array, both: float) -> Array:
    return np.array([both, *axes])


# --- focal_sigma ---


def _freedom(J: Array, residuals: Array) -> float:
    return float(J.shape[0] - J.shape[1])


def _noise_variance(residuals: Array, freedom: float) -> float:
    return float(residuals @ residuals) / freedom


def _information(J: Array) -> Array:
    return J.T @ J


def _first_of_inverse(information: Array) -> float:
    return float(np.linalg.inv(information)[0, 0])


def _times(noise: float, first: float) -> float:
    return noise * first


def _build_sigma(steps: Mapping[str, Step]) -> Model:
    def focal_sigma(J: Array, residuals: Array) -> Any:
        noise = steps["noise"](residuals, steps["freedom"](J, residuals))
        first = steps["first"](steps["information"](J))
        return steps["root"](steps["scale"](noise, first))

    return focal_sigma


def _least_squares(seed: int, rows: int, columns: int, sigma: float) -> tuple[Array, Array]:
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


@FOCAL_SIGMA.mistake(
    "freedom",
    "the sum of squares is divided by the number of residuals, as if nothing had been fitted",
    "Ten residuals and ten fitted parameters: how large are the residuals then, whatever the "
    "noise? What has to stand below the sum?",
)
def nothing_fitted(J: Array, residuals: Array) -> float:
    return float(J.shape[0])


@FOCAL_SIGMA.mistake(
    "freedom",
    "one degree of freedom is taken off, not one for each parameter",
    "N - 1 is for a single fitted number, the mean. How many numbers has this fit?",
)
def one_parameter(J: Array, residuals: Array) -> float:
    return float(J.shape[0] - 1)


@FOCAL_SIGMA.mistake(
    "freedom",
    "you count corners where you should count coordinates",
    "Each corner gives two residuals, and J has a row for each. How many rows has J?",
)
def corners_counted(J: Array, residuals: Array) -> float:
    return J.shape[0] / 2 - J.shape[1]


@FOCAL_SIGMA.mistake(
    "noise",
    "the noise does not enter: this is sigma for residuals of 1 px",
    "Twice as noisy corners: is your fx then known equally well?",
)
def no_noise(residuals: Array, freedom: float) -> float:
    return 1.0


@FOCAL_SIGMA.mistake(
    "noise",
    "the covariance is scaled by the noise's standard deviation instead of its variance",
    "A covariance is in squared units. Which power of the noise has the same?",
)
def noise_not_squared(residuals: Array, freedom: float) -> float:
    return math.sqrt(float(residuals @ residuals) / freedom)


@FOCAL_SIGMA.mistake(
    "noise",
    "the squares are added up but not divided by the degrees of freedom",
    "Twice as many corners: does your sigma fall?",
)
def noise_summed(residuals: Array, freedom: float) -> float:
    return float(residuals @ residuals)


@FOCAL_SIGMA.mistake(
    "noise",
    "the noise is taken as the standard deviation of the residuals: no parameter is counted",
    "Ten residuals and ten fitted parameters: how large is the standard deviation of what is left?",
)
def spread_of_residuals(residuals: Array, freedom: float) -> float:
    return float(np.var(residuals))


@FOCAL_SIGMA.mistake(
    "noise",
    "the noise is the 2-D RMS, and J has a row for each coordinate",
    "A corner that is 0.1 px off in u and in v is 0.14 px off. Which of the two belongs to a row?",
)
def two_dimensional_rms(residuals: Array, freedom: float) -> float:
    return float(2 * np.mean(residuals**2))


@FOCAL_SIGMA.mistake(
    "first",
    "that is sigma of fx if all other parameters were known exactly",
    "The first element of the inverse is not the inverse of the first element, unless the "
    "matrix is diagonal. Which of the two lets the board's distance move along with fx?",
)
def others_known(information: Array) -> float:
    return float(1.0 / information[0, 0])


@FOCAL_SIGMA.mistake(
    "first",
    "the matrix is not inverted",
    "J^T J is large where the data say a lot. Should sigma be large there?",
)
def not_inverted(information: Array) -> float:
    return float(information[0, 0])


@FOCAL_SIGMA.mistake(
    "first",
    "that is sigma of the last parameter",
    "Which column of J belongs to fx?",
)
def last_parameter(information: Array) -> float:
    return float(np.linalg.inv(information)[-1, -1])


@FOCAL_SIGMA.mistake(
    "scale",
    "you divide by the noise where you should multiply",
    "Noisier corners, better fx?",
)
def divided_by_noise(noise: float, first: float) -> float:
    return first / noise


@FOCAL_SIGMA.mistake(
    "root",
    "that is the variance, and a standard deviation is wanted",
    "What is the unit of your result?",
)
def variance(value: float) -> float:
    return value


@FOCAL_SIGMA.mistake(
    "root",
    "that is half of a 95 % interval, and one standard deviation is wanted",
    "Which factor turns the one into the other?",
)
def ninety_five(value: float) -> float:
    return 1.96 * math.sqrt(value)


EXERCISES = (REPROJECTION_RMS, FOCAL_SIGMA)


# --- checkpoints ---

CHECKPOINTS = (
    Number(
        name="intrinsics.two_views",
        question="One view of a flat board with 54 corners gives 108 measured numbers, and brings "
        "6 unknowns of its own: where the board was. Without noise and without distortion, how "
        "many different views does it take, at least, to determine fx, fy, cx and cy?",
        value=2,
        unit="views",
        why="However many corners it has, the image of a plane under a pinhole camera is a "
        "homography: 8 numbers. Six of them go into the board's pose, so a view says two things "
        "about K, and four unknowns take two views. More corners only make these two things more "
        "certain.",
        classics=(
            Classic(
                1,
                "108 numbers for 10 unknowns look like plenty. But once four corners of a *flat* "
                "board are known, all the others are: a view has 8 numbers to give, and needs 10.",
            ),
            Classic(
                3,
                "Three is the answer when the skew of the pixel grid is a fifth unknown, as in "
                "the paper that everybody cites. This K has four.",
            ),
            Classic(
                4,
                "One view for each unknown would mean that a view says one thing about K. Count "
                "what is left of the 8 numbers of a homography after the 6 of the pose.",
            ),
        ),
        hint="The image of a plane is a homography, and a homography has 8 numbers. How many of "
        "them are left for K when the pose has had its share?",
    ),
    Choice(
        name="intrinsics.square_on",
        question="You hold the board square to the camera, twelve times, at twelve distances from "
        "0.3 to 0.8 m. What do these images say about the focal length?",
        options=(
            Option(
                "Plenty: the board looks smaller the farther it is, and how fast depends on f",
                "It looks smaller in proportion to f/Z, and you do not know Z: nobody measured "
                "the distances, they are fitted too. A camera of twice the f with every board "
                "twice as far takes exactly the same images.",
            ),
            Option(
                "Next to nothing: each view only tells f/Z, and each has its own unknown Z",
                "A board without tilt is the same Z everywhere, so f and Z only appear as their "
                "quotient. New distances bring new unknowns. Only when one side of the board is "
                "nearer than the other does the picture depend on f and on Z separately.",
                right=True,
            ),
            Option(
                "A little, and 120 such views instead of 12 would say it precisely",
                "More data of a kind that says nothing says nothing. The noise gets smaller, and "
                "f/Z is known better and better; f and Z are not.",
            ),
            Option(
                "Plenty about f, but nothing about the distortion",
                "It is the other way round: a board that fills a square-on view shows distortion "
                "well, for straight lines must stay straight. It is f that it does not show.",
            ),
        ),
    ),
    Number(
        name="intrinsics.rms_axes",
        question="The residuals of a calibration have an RMS of 0.12 px in u and of 0.16 px in v. "
        "Which RMS reprojection error does OpenCV report?",
        value=0.20,
        unit="px",
        why="OpenCV's number is 2-D: the root of the mean squared *distance* of a corner from "
        "where it should be, so the two axes add in quadrature. Before you compare two numbers, "
        "ask whether both are 2-D.",
        classics=(
            Classic(
                0.1414,
                "That is the RMS over all coordinates, a number *per axis*. It is what the corner "
                "noise is usually quoted as, and a factor 1.4 below what OpenCV prints.",
            ),
            Classic(0.28, "They do not simply add: 3 to the right and 4 down are 5, not 7."),
        ),
        hint="How far is a corner from where it should be when it is 3 px too far right and 4 px "
        "too far down?",
    ),
    Choice(
        name="intrinsics.which_one",
        question="Which of the two K do you take to the robot?",
        options=(
            Option(
                "Either: same RMS, same number of corners, so they are equally good",
                "RMS says how well the model fits the corners that it was fitted to. It does not "
                "say whether another f would have fitted them just as well.",
            ),
            Option(
                "P's: its smallest and largest residuals are no worse, and its boards look more "
                "regular",
                "Square-on views look neat, are easy to detect, and say the least. What did you "
                "learn from the valley?",
            ),
            Option(
                "Q's: its boards are tilted, so f and distance are not interchangeable",
                "Tilt is what tells f from distance. P fits its corners just as well with a focal "
                "length that is wrong by far more than a percent.",
                right=True,
            ),
            Option(
                "Neither: an RMS of 0.11 px is too good to be true",
                "It is what 0.08 px of corner noise per axis gives in two dimensions. Nothing is "
                "wrong with it, and nothing is said by it.",
            ),
        ),
    ),
    Choice(
        name="intrinsics.bowed_board",
        question="The board is a sheet of paper whose middle is 1 mm higher than its rim. Thirty "
        "views with all the tilt that one could wish. What happens?",
        options=(
            Option(
                "The corners are off by several px in tilted views: RMS far above 1 px",
                "A millimetre, seen from the side at half a metre, is a pixel, and most of that "
                "goes into the board's pose. RMS stays in the range that people call careful.",
            ),
            Option(
                "Nothing: one millimetre at half a metre is 0.2 %, and it averages out",
                "It does not average: the board has the same shape in every view, so the error "
                "always points the same way. That is a bias, not noise.",
            ),
            Option(
                "RMS stays below 0.4 px, but fx is wrong by two to three percent, and k1 with it",
                "The fit has no parameter for the bow, so it uses the ones it has: a smaller fx (a "
                "larger one if the board is hollow), another k1. fx comes with a small stated "
                "sigma, and is wrong by many of these sigmas.",
                right=True,
            ),
            Option(
                "Only the poses of the board suffer: K belongs to the camera, not to the board",
                "All parameters are fitted to the same residuals. What the poses cannot take up, "
                "K takes.",
            ),
        ),
    ),
    Choice(
        name="intrinsics.square_size",
        question="You typed 24 mm where the squares are 25 mm. What happens to the calibration?",
        options=(
            Option(
                "fx comes out 4 % too small, because the board looks larger than it is said to be",
                "A board that is 4 % smaller looks the same 4 % nearer. The fit moves the board; "
                "it has no reason to touch fx.",
            ),
            Option(
                "RMS goes up: the corners do not fit the model any more",
                "Every corner fits as before, to the last digit: the same picture, a smaller "
                "board nearer by. That is why this one is the invisible mistake.",
            ),
            Option(
                "K, the distortion and RMS stay the same; every distance comes out 4 % too short",
                "The size of a square only scales the poses. No image shows it; something that "
                "knows metres does: a depth camera, an arm that moves by a known amount, a ruler.",
                right=True,
            ),
            Option(
                "Nothing at all: a calibration is about angles",
                "K is about angles and does stay. But whoever measures with the boards of this "
                "session, as hand-eye calibration does, measures 4 % too short.",
            ),
        ),
    ),
)

OBJECTIVES = (
    Objective("say what a calibration fits, and why tilt makes f known", ("intrinsics.square_on",)),
    Objective(
        "say which kind of reprojection error a number is (deeper: and compute it)",
        ("intrinsics.rms_axes", "intrinsics.reprojection_rms"),
    ),
    Objective("tell a good calibration from a bad one of the same RMS", ("intrinsics.which_one",)),
    Objective(
        "(deeper) say where the uncertainty of fx comes from, and how many views it takes",
        ("intrinsics.two_views", "intrinsics.focal_sigma"),
    ),
    Objective(
        "(deeper) recognise what spoils a calibration, and say what no image can show",
        ("intrinsics.bowed_board", "intrinsics.square_size"),
    ),
)
