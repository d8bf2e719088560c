"""Notebook 05: its exercise and the mistakes that people make in it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from coursekit.arrays import Floats
from coursekit.lessons.exercises import Exercise, Model, Step

# --- sensitivities ---


def _pixel_price(u: float, Z: float, fx: float, cx: float) -> float:
    return Z / fx


def _depth_price(u: float, Z: float, fx: float, cx: float) -> float:
    return (u - cx) / fx


def _leak(by_u: float, by_Z: float, depth_error: float, Z: float) -> float:
    return by_Z * depth_error


def _in_order(by_u: float, by_Z: float, leak: float) -> Floats:
    return np.array([by_u, by_Z, leak])


def _build(steps: Mapping[str, Step]) -> Model:
    def sensitivities(u: float, Z: float, fx: float, cx: float, depth_error: float) -> Floats:
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


@SENSITIVITIES.mistake("pixel")
def distance_forgotten(u: float, Z: float, fx: float, cx: float) -> float:
    """a pixel does not cost the same at every distance: Z is missing

    Twice as far: how many millimetres of the world lie behind one pixel?
    """
    return 1 / fx


@SENSITIVITIES.mistake("pixel")
def upside_down(u: float, Z: float, fx: float, cx: float) -> float:
    """that is how u changes with X, and X with u is wanted

    Which of the two do you hold in your hand, the pixel or the point?
    """
    return fx / Z


@SENSITIVITIES.mistake("depth")
def centre_forgotten(u: float, Z: float, fx: float, cx: float) -> float:
    """the principal point is missing: in the middle of the image nothing leaks

    What is dX/dZ for the pixel u = cx?
    """
    return u / fx


@SENSITIVITIES.mistake("depth")
def other_way(u: float, Z: float, fx: float, cx: float) -> float:
    """the sign is wrong: right of the centre a depth that is too long moves the point to the right

    X = (u - cx) Z / fx: does X grow with Z when u > cx?
    """
    return (cx - u) / fx


@SENSITIVITIES.mistake("depth")
def not_differentiated(u: float, Z: float, fx: float, cx: float) -> float:
    """that is X itself, not its derivative by Z

    X is proportional to Z. What is left when you differentiate?
    """
    return (u - cx) * Z / fx


@SENSITIVITIES.mistake("depth")
def angle(u: float, Z: float, fx: float, cx: float) -> float:
    """the depth leaks with the tangent of the angle, and yours is the angle itself

    (u - cx) / fx is a slope. What is the function that makes an angle of it, and do you want it?
    """
    return math.atan2(u - cx, fx)


@SENSITIVITIES.mistake("depth")
def sine(u: float, Z: float, fx: float, cx: float) -> float:
    """the depth leaks with the tangent of the angle, and yours is the sine

    The error is along Z, the optical axis, not along the ray. Draw the triangle.
    """
    return (u - cx) / math.hypot(u - cx, fx)


@SENSITIVITIES.mistake("leak")
def wrong_price(by_u: float, by_Z: float, depth_error: float, Z: float) -> float:
    """the depth error is multiplied by the price of a pixel

    Which of the two prices has the unit metre per metre?
    """
    return by_u * depth_error


@SENSITIVITIES.mistake("leak")
def sign_lost(by_u: float, by_Z: float, depth_error: float, Z: float) -> float:
    """the leak has a sign: a depth that is too short pulls the point towards the middle

    What is lost when you take the absolute value of a bias?
    """
    return abs(by_Z * depth_error)


@SENSITIVITIES.mistake("leak")
def millimetres(by_u: float, by_Z: float, depth_error: float, Z: float) -> float:
    """millimetres and metres are mixed: the leak is off by a factor 1000

    The depth error comes in metres, and the leak leaves in metres.
    """
    return 1000 * by_Z * depth_error


@SENSITIVITIES.mistake("leak")
def landing_place(by_u: float, by_Z: float, depth_error: float, Z: float) -> float:
    """that is where the point lands, not how far it was moved

    What would your third number be with a depth error of zero, and what should it be?
    """
    return by_Z * (Z + depth_error)


@SENSITIVITIES.mistake("order")
def all_millimetres(by_u: float, by_Z: float, leak: float) -> Floats:
    """all of it is in millimetres, and metres are wanted

    Everything goes in in metres and pixels; what is the unit of Z / fx then?
    """
    return np.array([1000 * by_u, by_Z, 1000 * leak])


@SENSITIVITIES.mistake("order")
def exchanged(by_u: float, by_Z: float, leak: float) -> Floats:
    """the two prices are exchanged

    The exercise asks for (dX/du, dX/dZ, leak).
    """
    return np.array([by_Z, by_u, leak])
