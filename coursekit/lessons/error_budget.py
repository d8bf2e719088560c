"""Notebook 05: its checkpoints, its exercise and the mistakes that people make in it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from coursekit.lessons.checkpoints import Choice, Classic, Number, Option
from coursekit.lessons.exercises import Exercise, Model, Step
from coursekit.lessons.objectives import Objective

Array = np.ndarray

# --- sensitivities ---


def _pixel_price(u: float, Z: float, fx: float, cx: float) -> float:
    return Z / fx


def _depth_price(u: float, Z: float, fx: float, cx: float) -> float:
    return (u - cx) / fx


def _leak(by_u: float, by_Z: float, depth_error: float, Z: float) -> float:
    return by_Z * depth_error


def _in_order(by_u: float, by_Z: float, leak: float) -> Array:
    return np.array([by_u, by_Z, leak])


def _build(steps: Mapping[str, Step]) -> Model:
    def sensitivities(u: float, Z: float, fx: float, cx: float, depth_error: float) -> Array:
        by_u, by_Z = steps["pixel"](u, Z, fx, cx), steps["depth"](u, Z, fx, cx)
        return steps["order"](by_u, by_Z, steps["leak"](by_u, by_Z, depth_error, Z))

    return sensitivities


SENSITIVITIES = Exercise(
    name="error_budget.sensitivities",
    build=_build,
    steps={
        "pixel": _pixel_price,
        "depth": _depth_price,
        "leak": _leak,
        "order": _in_order,
    },
    cases=[
        (524.0, 0.5, 500.0, 424.0, 0.004),
        (847.0, 0.45, 447.0, 424.0, 0.005),
        (20.0, 0.30, 612.0, 322.0, 0.003),
        (700.0, 0.80, 390.4, 331.4, -0.006),
    ],
    per_row=0,
    unit="m/px, 1 and m",
    tolerance=1e-10,
    describe=lambda args: (
        "u = {:g} px, Z = {:g} m, fx = {:g} px, cx = {:g} px, depth error {:g} m".format(*args)
    ),
    show=lambda row: "(" + ", ".join(f"{v:.6g}" for v in np.ravel(row)) + ")",
)


@SENSITIVITIES.mistake(
    "pixel",
    "a pixel does not cost the same at every distance: Z is missing",
    "Twice as far: how many millimetres of the world lie behind one pixel?",
)
def distance_forgotten(u: float, Z: float, fx: float, cx: float) -> float:
    return 1 / fx


@SENSITIVITIES.mistake(
    "pixel",
    "that is how u changes with X, and X with u is wanted",
    "Which of the two do you hold in your hand, the pixel or the point?",
)
def upside_down(u: float, Z: float, fx: float, cx: float) -> float:
    return fx / Z


@SENSITIVITIES.mistake(
    "depth",
    "the principal point is missing: in the middle of the image nothing leaks",
    "What is dX/dZ for the pixel u = cx?",
)
def centre_forgotten(u: float, Z: float, fx: float, cx: float) -> float:
    return u / fx


@SENSITIVITIES.mistake(
    "depth",
    "the sign is wrong: right of the centre a depth that is too long moves the point to the right",
    "X = (u - cx) Z / fx: does X grow with Z when u > cx?",
)
def other_way(u: float, Z: float, fx: float, cx: float) -> float:
    return (cx - u) / fx


@SENSITIVITIES.mistake(
    "depth",
    "that is X itself, not its derivative by Z",
    "X is proportional to Z. What is left when you differentiate?",
)
def not_differentiated(u: float, Z: float, fx: float, cx: float) -> float:
    return (u - cx) * Z / fx


@SENSITIVITIES.mistake(
    "depth",
    "the depth leaks with the tangent of the angle, and yours is the angle itself",
    "(u - cx) / fx is a slope. What is the function that makes an angle of it, and do you want it?",
)
def angle(u: float, Z: float, fx: float, cx: float) -> float:
    return math.atan2(u - cx, fx)


@SENSITIVITIES.mistake(
    "depth",
    "the depth leaks with the tangent of the angle, and yours is the sine",
    "The error is along Z, the optical axis, not along the ray. Draw the triangle.",
)
def sine(u: float, Z: float, fx: float, cx: float) -> float:
    return (u - cx) / math.hypot(u - cx, fx)


@SENSITIVITIES.mistake(
    "leak",
    "the depth error is multiplied by the price of a pixel",
    "Which of the two prices has the unit metre per metre?",
)
def wrong_price(by_u: float, by_Z: float, depth_error: float, Z: float) -> float:
    return by_u * depth_error


@SENSITIVITIES.mistake(
    "leak",
    "the leak has a sign: a depth that is too short pulls the point towards the middle",
    "What is lost when you take the absolute value of a bias?",
)
def sign_lost(by_u: float, by_Z: float, depth_error: float, Z: float) -> float:
    return abs(by_Z * depth_error)


@SENSITIVITIES.mistake(
    "leak",
    "millimetres and metres are mixed: the leak is off by a factor 1000",
    "The depth error comes in metres, and the leak leaves in metres.",
)
def millimetres(by_u: float, by_Z: float, depth_error: float, Z: float) -> float:
    return 1000 * by_Z * depth_error


@SENSITIVITIES.mistake(
    "leak",
    "that is where the point lands, not how far it was moved",
    "What would your third number be with a depth error of zero, and what should it be?",
)
def landing_place(by_u: float, by_Z: float, depth_error: float, Z: float) -> float:
    return by_Z * (Z + depth_error)


@SENSITIVITIES.mistake(
    "order",
    "all of it is in millimetres, and metres are wanted",
    "Everything goes in in metres and pixels; what is the unit of Z / fx then?",
)
def all_millimetres(by_u: float, by_Z: float, leak: float) -> Array:
    return np.array([1000 * by_u, by_Z, 1000 * leak])


@SENSITIVITIES.mistake(
    "order",
    "the two prices are exchanged",
    "The exercise asks for (dX/du, dX/dZ, leak).",
)
def exchanged(by_u: float, by_Z: float, leak: float) -> Array:
    return np.array([by_Z, by_u, leak])


EXERCISES = (SENSITIVITIES,)


# --- checkpoints ---

CHECKPOINTS = (
    Number(
        name="error_budget.leak",
        question="A camera with a horizontal field of view of 87 degrees reports depths that are "
        "5 mm too long. By how many millimetres does that move a point *sideways* that it sees "
        "at the edge of its image?",
        value=5 * math.tan(math.radians(43.5)),
        unit="mm",
        why="The edge is 43.5 degrees off the axis, and depth leaks sideways with the tangent of "
        "that angle, 0.95. A depth error is a sideways error, except in the middle of the image.",
        classics=(
            Classic(
                0.0,
                "In the middle, yes. At the edge the ray leans, and a longer ray ends elsewhere.",
            ),
            Classic(
                5 * math.sin(math.radians(43.5)),
                "The error is along Z, not along the ray: the tangent, not the sine.",
            ),
            Classic(
                5 * math.tan(math.radians(87)),
                "87 degrees is the whole field of view; the edge is half of that off the axis.",
            ),
        ),
        hint="How far off the axis does the edge of the image look, and what is X / Z there?",
    ),
    Choice(
        name="error_budget.averaging",
        question="You average 100 frames before each grasp. Which rows of the budget shrink?",
        options=(
            Option(
                "All of them, by ten",
                "Averaging removes what is new in each frame. A mount that is turned by half a "
                "degree is turned in all hundred.",
            ),
            Option(
                "The depth noise, and of the pixel error what is new in each frame",
                "And even the noise by less than ten: neighbouring frames share a drift, and each "
                "pixel has a pattern of its own that stays. The bias rows do not move at all.",
                right=True,
            ),
            Option(
                "None: the object does not move",
                "That is why averaging helps: what changes from frame to frame is noise then.",
            ),
            Option(
                "The bias rows, because a mean has no bias",
                "A mean of a thousand readings of a wrong scale is a very precise wrong reading.",
            ),
        ),
    ),
    Choice(
        name="error_budget.worst_case",
        question="The bias rows of a budget add up to 15.9 mm at worst, and the gripper forgives "
        "7 mm along the direction in which it closes. Magnitudes are anywhere in their ranges, "
        "directions anyhow. In how many of 100 such rigs does the bias alone exceed 7 mm along "
        "that direction?",
        options=(
            Option(
                "About 100: the worst case is more than twice what is allowed",
                "The worst case needs all four errors at their largest and all in one direction.",
            ),
            Option(
                "About 25",
                "That is the share with a bias *longer* than 7 mm in some direction. The fingers "
                "only care about one.",
            ),
            Option(
                "About 3",
                "Four arrows of random direction rarely line up, and only the part along the "
                "closing direction counts. Worst case, length and part along an axis answer three "
                "different questions.",
                right=True,
            ),
            Option(
                "None: errors of random direction cancel",
                "They cancel in part. In three of a hundred rigs they do not, and these miss "
                "in *every* trial.",
            ),
        ),
    ),
    Number(
        name="error_budget.room",
        question="Each finger of a gripper travels 40 mm, so that it opens 80 mm. A cube of 25 mm "
        "stands between the fingers. How much room is there on each side, in mm, when it is "
        "centred?",
        value=27.5,
        unit="mm",
        why="(80 - 25) / 2. The same cube in a gripper that opens 40 mm in all would have 7.5. One "
        "figure of a data sheet, read as the opening or as the travel of one finger, decides "
        "whether the budget is tight or comfortable: measure it.",
        classics=(
            Classic(
                7.5, "That is for an opening of 40 mm. Here 40 mm is the travel of *one* finger."
            ),
            Classic(55.0, "That is the room on both sides together."),
        ),
        hint="Opening less object, and then half of it.",
    ),
    Choice(
        name="error_budget.same_side",
        question="Ten grasps of ten cubes in ten places. Every one lands 3 mm too far left, give "
        "or take 2. What do you repair?",
        options=(
            Option(
                "The detector: 2 mm of scatter is the larger problem",
                "Scatter averages out; what is the same in ten places does not.",
            ),
            Option(
                "The calibration: one direction in all places is a bias of the mount or the depth",
                "A mean of 3 mm with a standard error of 2/√10 = 0.6 mm is no accident, and a "
                "perception error would point another way each time. (A turned mount moves a point "
                "by its distance from the camera, so it differs a little from place to place.)",
                right=True,
            ),
            Option(
                "The arm: its forward kinematics are off",
                "In one place an arm's error repeats, and the budget books it as a bias. But it "
                "changes with the pose: in ten places it would not point the same way ten times.",
            ),
            Option(
                "Nothing yet: ten trials say nothing",
                "It depends on what they say. Ten trials find a bias of one and a half standard "
                "deviations most of the time; for half of one they would be too few.",
            ),
        ),
    ),
)

OBJECTIVES = (
    Objective(
        "read the partial derivatives of the deprojection as prices",
        ("error_budget.leak", "error_budget.sensitivities"),
    ),
    Objective(
        "build an error budget in millimetres, and add bias and noise each in its own way",
        ("error_budget.averaging", "error_budget.worst_case"),
    ),
    Objective("say whether a grasp can succeed, and what to fix first", ("error_budget.room",)),
    Objective(
        "attribute misses to calibration, perception or the arm", ("error_budget.same_side",)
    ),
)
