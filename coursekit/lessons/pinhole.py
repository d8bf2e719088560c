"""Notebook 01: its checkpoints, its two exercises and the mistakes that people make in them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from coursekit.lessons.checkpoints import Choice, Classic, Number, Option
from coursekit.lessons.exercises import Core, Exercise, Model, Step
from coursekit.lessons.objectives import Objective

Array = np.ndarray

# --- project ---

GENERIC_K = np.array([[612.5, 0.0, 331.4], [0.0, 598.0, 236.8], [0.0, 0.0, 1.0]])
LESSON_K = np.array([[447.0, 0.0, 424.0], [0.0, 447.0, 240.0], [0.0, 0.0, 1.0]])
SINGLE = np.array([[0.30, -0.20, 0.90]])
# Four points, not two or three: a wrong broadcast over (N, 2) or (N, 3) must not go through.
SEVERAL = np.array([[0.25, 0.40, 0.80], [-0.31, 0.12, 0.55], [0.07, -0.26, 0.62], [0.1, 0.2, 0.4]])
MIXED = np.array([-0.27, 0.11, 0.0018, -0.0012, 0.05])


# The steps of projection. The third of x, y, w is 1 unless somebody treats Z in a way of their own.


def _normalise(points: Array) -> Any:
    return points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], 1.0


def _read(k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    return k1, k2, p1, p2, k3


def _bend(x: Array, y: Array, k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def _to_pixels(x: Array, y: Array, w: Any, K: Array) -> Any:
    return K[0, 0] * x + K[0, 2] * w, K[1, 1] * y + K[1, 2] * w


def _image(points: Array, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    x, y, w = normalise(points)
    return to_pixels(*bend(x, y), w)


def _columns(u: Array, v: Array) -> Array:
    return np.stack([u, v], axis=1)


def _build_project(steps: Mapping[str, Step]) -> Model:
    def project(points: Array, K: Array, dist: Array | None = None) -> Any:
        def bend(x: Array, y: Array) -> Any:
            return (x, y) if dist is None else steps["bend"](x, y, *steps["read"](*dist))

        def to_pixels(x: Array, y: Array, w: Any) -> Any:
            return steps["to_pixels"](x, y, w, K)

        return steps["columns"](*steps["image"](points, steps["normalise"], bend, to_pixels))

    return project


def _tuple(values: Any, places: int) -> str:
    return "(" + ", ".join(f"{v:.{places}f}" for v in values) + ")"


def _short(values: Any) -> str:
    return "(" + ", ".join(f"{v:g}" for v in values) + ")"


def _describe_camera(K: Array, dist: Array | None = None) -> str:
    text = f"K = {_short((K[0, 0], K[1, 1], K[0, 2], K[1, 2]))} px"
    return text if dist is None else f"{text}, coefficients {_short(dist)}"


def _describe_project(args: tuple[Any, ...]) -> str:
    points, *camera = args
    named = "point" if len(points) == 1 else "points"
    return f"{_describe_camera(*camera)}, {named} {', '.join(_tuple(p, 2) for p in points)} m"


PROJECT = Exercise(
    name="pinhole.project",
    build=_build_project,
    steps={
        "normalise": _normalise,
        "read": _read,
        "bend": _bend,
        "to_pixels": _to_pixels,
        "image": _image,
        "columns": _columns,
    },
    cases=[
        (np.array([[0.10, -0.05, 0.45]]), LESSON_K),
        (SINGLE, LESSON_K),
        (SINGLE, GENERIC_K),
        (SEVERAL, GENERIC_K),
        (SINGLE, LESSON_K, np.array([0.1, 0.0, 0.0, 0.0, 0.0])),
        (SINGLE, LESSON_K, np.array([0.0, 0.2, 0.0, 0.0, 0.0])),
        (SINGLE, LESSON_K, np.array([0.0, 0.0, 0.0010, 0.0005, 0.0])),
        (SINGLE, LESSON_K, np.array([0.0, 0.0, 0.0, 0.0, 0.4])),
        (SEVERAL, GENERIC_K, MIXED),
        (SEVERAL[::-1] * [-1, 1, 1], GENERIC_K, MIXED * [1, -2, 3, 2, -1]),
    ],
    per_row=1,
    unit="px",
    tolerance=1e-3,
    describe=_describe_project,
    show=lambda row: _tuple(row, 3),
    core=Core(of=lambda args: args[:2], which="without distortion", rest="`dist`"),
)


_DIVIDE = (
    "nothing is divided by Z",
    "Two points on one ray, one twice as far as the other: do yours land on the same pixel?",
)


@PROJECT.mistake("normalise", *_DIVIDE)
def no_division(points: Array) -> Any:
    return points[:, 0], points[:, 1], 1.0


@PROJECT.mistake("normalise", *_DIVIDE, name="no_division")
def homogeneous_without_division(points: Array) -> Any:
    return points[:, 0], points[:, 1], points[:, 2]


@PROJECT.mistake(
    "normalise",
    "X and Y are divided by the length of the ray instead of by Z",
    "All points of a wall that faces the camera have the same Z. Do yours get the same divisor?",
)
def divided_by_range(points: Array) -> Any:
    length = np.linalg.norm(points, axis=1)
    return points[:, 0] / length, points[:, 1] / length, 1.0


@PROJECT.mistake(
    "normalise",
    "the principal point is divided by Z as well",
    "Where does a point on the optical axis land, at 0.5 m and at 1 m? And with yours?",
)
def centre_divided(points: Array) -> Any:
    x, y, _ = _normalise(points)
    return x, y, 1.0 / points[:, 2]


@PROJECT.mistake(
    "normalise",
    "the ratios are upside down: Z is divided by X and by Y",
    "Move a point twice as far to the right. Does yours move farther to the right in the image?",
)
def upside_down(points: Array) -> Any:
    return points[:, 2] / points[:, 0], points[:, 2] / points[:, 1], 1.0


_UP = ("your y axis points up", "In which row is a point below the optical axis?")


@PROJECT.mistake("normalise", *_UP, name="y_up")
def y_up_before_distortion(points: Array) -> Any:
    x, y, w = _normalise(points)
    return x, -y, w


@PROJECT.mistake("to_pixels", *_UP, name="y_up")
def y_up_after_distortion(x: Array, y: Array, w: Any, K: Array) -> Any:
    return _to_pixels(x, -y, w, K)


@PROJECT.mistake(
    "to_pixels",
    "your fx and fy are swapped",
    "Which entry of K belongs to the columns of the image?",
)
def fx_fy_swapped(x: Array, y: Array, w: Any, K: Array) -> Any:
    return K[1, 1] * x + K[0, 2] * w, K[0, 0] * y + K[1, 2] * w


@PROJECT.mistake(
    "to_pixels",
    "fx is used for both axes",
    "K has four numbers in it. Does your function use them all?",
)
def fx_for_both(x: Array, y: Array, w: Any, K: Array) -> Any:
    return K[0, 0] * x + K[0, 2] * w, K[0, 0] * y + K[1, 2] * w


@PROJECT.mistake(
    "to_pixels",
    "the principal point is added before the multiplication by fx and fy",
    "A point on the optical axis has x = y = 0. On which pixel must it land?",
)
def centre_before_scale(x: Array, y: Array, w: Any, K: Array) -> Any:
    return K[0, 0] * (x + K[0, 2] * w), K[1, 1] * (y + K[1, 2] * w)


@PROJECT.mistake(
    "to_pixels",
    "K is multiplied from the wrong side",
    "The equation says K times a column. Your points are rows: what has to be transposed?",
)
def K_transposed(x: Array, y: Array, w: Any, K: Array) -> Any:
    third = K[0, 2] * x + K[1, 2] * y + w
    return K[0, 0] * x / third, K[1, 1] * y / third


@PROJECT.mistake(
    "to_pixels",
    "your cx and cy are swapped",
    "Which of the two is near half the *width* of the image?",
)
def cx_cy_swapped(x: Array, y: Array, w: Any, K: Array) -> Any:
    return K[0, 0] * x + K[1, 2] * w, K[1, 1] * y + K[0, 2] * w


_PRINCIPAL = (
    "the principal point is forgotten",
    "Where does a point on the optical axis land, and where does yours put it?",
)


@PROJECT.mistake("to_pixels", *_PRINCIPAL)
def principal_point_forgotten(x: Array, y: Array, w: Any, K: Array) -> Any:
    return K[0, 0] * x, K[1, 1] * y


@PROJECT.mistake(
    "to_pixels",
    "the principal point is subtracted",
    "A point on the optical axis has x = y = 0. On which pixel must it land?",
)
def principal_point_subtracted(x: Array, y: Array, w: Any, K: Array) -> Any:
    return K[0, 0] * x - K[0, 2] * w, K[1, 1] * y - K[1, 2] * w


@PROJECT.mistake("read", "your p1 and p2 are swapped", "Which of the two multiplies r² + 2x²?")
def p1_p2_swapped(k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    return k1, k2, p2, p1, k3


@PROJECT.mistake(
    "read",
    "the coefficients are read as (k1, k2, k3, p1, p2)",
    "OpenCV added k3 when the other four were already there. At which end?",
)
def k3_before_p1(k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    return k1, k2, p2, k3, p1


@PROJECT.mistake(
    "read",
    "the r⁶ term is missing",
    "Five coefficients come in. Does each of them do something?",
)
def r6_missing(k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    return k1, k2, p1, p2, 0.0


@PROJECT.mistake(
    "read",
    "the tangential terms are missing",
    "What do p1 and p2 do in your function?",
)
def tangential_missing(k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    return k1, k2, 0.0, 0.0, k3


_FACTOR = (
    "a factor 2 is missing in the tangential terms",
    "There are four twos in them: 2 p1 xy, 2x², 2y² and 2 p2 xy. Count yours.",
)


def _tangential(a: float, b: float) -> Step:
    """`bend` with the factors a (of p xy) and b (of x², y²) in place of the two twos."""

    def bend(x: Array, y: Array, k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
        r2 = x * x + y * y
        radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
        return (
            x * radial + a * p1 * x * y + p2 * (r2 + b * x * x),
            y * radial + p1 * (r2 + b * y * y) + a * p2 * x * y,
        )

    return bend


PROJECT.mistake("bend", *_FACTOR, name="factor_2_missing")(_tangential(1, 2))
PROJECT.mistake("bend", *_FACTOR, name="factor_2_missing")(_tangential(2, 1))
PROJECT.mistake("bend", *_FACTOR, name="factor_2_missing")(_tangential(1, 1))


@PROJECT.mistake(
    "bend",
    "x is overwritten before y is computed from it",
    "Your line for y uses x. Is it still the x you started with?",
)
def x_overwritten(x: Array, y: Array, k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return x, y


@PROJECT.mistake(
    "bend",
    "the tangential terms use x and y after the radial factor",
    "Both kinds of distortion start from the same ideal x and y. Do yours?",
)
def tangential_after_radial(
    x: Array, y: Array, k1: float, k2: float, p1: float, p2: float, k3: float
) -> Any:
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x, y = x * radial, y * radial
    return (
        x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@PROJECT.mistake(
    "bend",
    "the 1 is missing in the radial factor",
    "If all five coefficients are 0, nothing may move. Where do your points land then?",
)
def one_missing(x: Array, y: Array, *dist: float) -> Any:
    bent_x, bent_y = _bend(x, y, *dist)
    return bent_x - x, bent_y - y


def _powers(a: float, b: float, c: float, tangential: float) -> Step:
    """`bend` with these powers of r² in the three radial terms and in the tangential ones."""

    def bend(x: Array, y: Array, k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
        r2 = x * x + y * y
        radial = 1 + k1 * r2**a + k2 * r2**b + k3 * r2**c
        return (
            x * radial + 2 * p1 * x * y + p2 * (r2**tangential + 2 * x * x),
            y * radial + p1 * (r2**tangential + 2 * y * y) + 2 * p2 * x * y,
        )

    return bend


_RADIUS = (
    "the radial polynomial runs in r instead of r²",
    "With k1 alone, the displacement grows as the third power of the radius. How does yours?",
)
PROJECT.mistake("bend", *_RADIUS, name="r_for_r2")(_powers(0.5, 1, 1.5, 1))
PROJECT.mistake("bend", *_RADIUS, name="r_for_r2")(_powers(0.5, 1, 1.5, 0.5))

_SQUARED = (
    "r² is taken for r and raised to the powers 2, 4 and 6",
    "In your code, is the name of x² + y² the name of a radius or of its square?",
)
PROJECT.mistake("bend", *_SQUARED, name="r2_for_r")(_powers(2, 4, 6, 1))
PROJECT.mistake("bend", *_SQUARED, name="r2_for_r")(_powers(2, 4, 6, 2))
PROJECT.mistake("bend", *_SQUARED, name="r2_for_r")(_powers(1, 4, 6, 1))


@PROJECT.mistake(
    "image",
    "the distortion is applied before the division by Z",
    "r² has no unit. What unit does yours have?",
)
def bent_before_division(points: Array, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    x, y = bend(points[:, 0], points[:, 1])
    return to_pixels(x / points[:, 2], y / points[:, 2], 1.0)


_IN_PIXELS = (
    "the distortion is applied in pixels",
    "The polynomial wants x = X/Z, which is 1 at 45 degrees off the axis. How large is your r²?",
)


@PROJECT.mistake("image", *_IN_PIXELS, name="distortion_in_pixels")
def distortion_of_uv(points: Array, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    return bend(*to_pixels(*normalise(points)))


@PROJECT.mistake("image", *_IN_PIXELS, name="distortion_in_pixels")
def distortion_of_centred_uv(points: Array, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    cx, cy = to_pixels(0.0, 0.0, 1.0)
    u, v = to_pixels(*normalise(points))
    u, v = bend(u - cx, v - cy)
    return u + cx, v + cy


@PROJECT.mistake(
    "columns",
    "x and y are swapped in the output",
    "A pixel is (u, v), column first; a NumPy index is [row, column]. Which did you return?",
)
def output_swapped(u: Array, v: Array) -> Array:
    return np.stack([v, u], axis=1)


_ROUNDED = (
    "the pixels are rounded to whole numbers",
    "A calibrated corner is known to a tenth of a pixel. What is left of that?",
)


@PROJECT.mistake("columns", *_ROUNDED)
def rounded(u: Array, v: Array) -> Array:
    return np.rint(np.stack([u, v], axis=1))


@PROJECT.mistake("columns", *_ROUNDED, name="rounded")
def truncated(u: Array, v: Array) -> Array:
    return np.trunc(np.stack([u, v], axis=1))


_HALF = (
    "every pixel is half a pixel off",
    "OpenCV and RealSense give the *centre* of the top-left pixel the coordinates (0, 0). "
    "Which of your lines moves it?",
)


@PROJECT.mistake("columns", *_HALF, name="half_pixel")
def half_pixel_more(u: Array, v: Array) -> Array:
    return np.stack([u, v], axis=1) + 0.5


@PROJECT.mistake("columns", *_HALF, name="half_pixel")
def half_pixel_less(u: Array, v: Array) -> Array:
    return np.stack([u, v], axis=1) - 0.5


# --- deproject ---

# The steps back. The third of x, y, w is 1 unless somebody multiplies from the wrong side.


def _to_normalised(pixels: Array, K: Array) -> Any:
    return (pixels[:, 0] - K[0, 2]) / K[0, 0], (pixels[:, 1] - K[1, 2]) / K[1, 1], 1.0


def _iterate(rounds: int) -> Step:
    """The fixed-point iteration, so many rounds of it."""

    def unbend(x: Array, y: Array, bend: Step, *dist: float) -> Any:
        xd, yd = x, y
        for _ in range(rounds):
            bent_x, bent_y = bend(x, y)
            x, y = x + xd - bent_x, y + yd - bent_y
        return x, y

    return unbend


def _scale(x: Array, y: Array, w: Any, depth: Array) -> Any:
    return x * depth, y * depth, w * depth


def _points(X: Array, Y: Array, Z: Array) -> Array:
    return np.stack([X, Y, Z], axis=1)


def _build_deproject(steps: Mapping[str, Step]) -> Model:
    def deproject(pixels: Array, depth: Array, K: Array, dist: Array | None = None) -> Any:
        x, y, w = steps["to_normalised"](pixels, K)
        if dist is not None:
            read = steps["read"](*dist)
            x, y = steps["unbend"](x, y, lambda x, y: steps["bend"](x, y, *read), *read)
        return steps["points"](*steps["scale"](x, y, w, depth))

    return deproject


def _describe_deproject(args: tuple[Any, ...]) -> str:
    pixels, depth, *camera = args
    what = ", ".join(f"{_tuple(p, 1)} px at {z:.2f} m" for p, z in zip(pixels, depth, strict=True))
    named = "pixel" if len(pixels) == 1 else "pixels"
    return f"{_describe_camera(*camera)}, {named} {what}"


_PIXEL = np.array([[600.0, 140.0]])
_PIXELS = np.array([[600.0, 140.0], [52.5, 310.2], [400.1, 20.8], [210.3, 199.9]])
_DEPTHS = np.array([0.90, 0.55, 0.62, 0.48])

# A wide lens (data/lenses.toml): here an iteration must be taken to its end.
WIDE_K = np.array([[336.602, 0.0, 305.563], [0.0, 336.319, 237.203], [0.0, 0.0, 1.0]])
WIDE = np.array([-0.29998, 0.07393, 0.00170, -0.00079, 0.0])
_CORNER = np.array([[60.0, 50.0]])

DEPROJECT = Exercise(
    name="pinhole.deproject",
    build=_build_deproject,
    steps={
        "to_normalised": _to_normalised,
        "read": _read,
        "bend": _bend,
        "unbend": _iterate(40),
        "scale": _scale,
        "points": _points,
    },
    cases=[
        (_PIXEL, _DEPTHS[:1], LESSON_K),
        (_PIXEL, _DEPTHS[:1], GENERIC_K),
        (_PIXELS, _DEPTHS, GENERIC_K),
        (_PIXEL, _DEPTHS[:1], LESSON_K, np.array([0.1, 0.0, 0.0, 0.0, 0.0])),
        (_PIXEL, _DEPTHS[:1], LESSON_K, np.array([0.0, 0.0, 0.0010, 0.0005, 0.0])),
        (_PIXEL, _DEPTHS[:1], LESSON_K, np.array([0.0, 0.0, 0.0, 0.0, 0.4])),
        (_PIXELS, _DEPTHS, GENERIC_K, MIXED),
        (_CORNER, _DEPTHS[:1], WIDE_K, WIDE),
    ],
    per_row=2,
    unit="m",
    tolerance=1e-5,
    describe=_describe_deproject,
    show=lambda row: _tuple(row, 4),
    core=Core(of=lambda args: args[:3], which="without distortion", rest="`dist`"),
)


def _as_in_project(name: str) -> tuple[str, str]:
    """What a mistake of the first exercise says and asks."""
    return next((m.says, m.ask) for m in PROJECT.mistakes if m.name == name)


# From the pixel to the ray.


@DEPROJECT.mistake(
    "to_normalised",
    "K is applied where its inverse is needed",
    "K takes rays to pixels. Which way does this function go?",
)
def inverse_missing(pixels: Array, K: Array) -> Any:
    return K[0, 0] * pixels[:, 0] + K[0, 2], K[1, 1] * pixels[:, 1] + K[1, 2], 1.0


_SIDE = (
    "the inverse of K is multiplied from the wrong side",
    "The equation says K⁻¹ times a column. Your pixels are rows: what has to be transposed?",
)


@DEPROJECT.mistake("to_normalised", *_SIDE, name="K_transposed")
def inverse_transposed(pixels: Array, K: Array) -> Any:
    third = 1 - K[0, 2] / K[0, 0] * pixels[:, 0] - K[1, 2] / K[1, 1] * pixels[:, 1]
    return pixels[:, 0] / K[0, 0], pixels[:, 1] / K[1, 1], third


@DEPROJECT.mistake("to_normalised", *_SIDE, name="K_transposed")
def inverse_transposed_and_divided(pixels: Array, K: Array) -> Any:
    x, y, third = inverse_transposed(pixels, K)
    return x / third, y / third, 1.0


@DEPROJECT.mistake("to_normalised", *_PRINCIPAL, name="principal_point_forgotten")
def principal_point_not_subtracted(pixels: Array, K: Array) -> Any:
    return pixels[:, 0] / K[0, 0], pixels[:, 1] / K[1, 1], 1.0


@DEPROJECT.mistake(
    "to_normalised",
    "the principal point is added",
    "The pixel at the principal point looks straight ahead. What are your x and y there?",
)
def principal_point_added(pixels: Array, K: Array) -> Any:
    return (pixels[:, 0] + K[0, 2]) / K[0, 0], (pixels[:, 1] + K[1, 2]) / K[1, 1], 1.0


@DEPROJECT.mistake(
    "to_normalised",
    "only the principal point is divided by fx and fy",
    "In `a - b / c`, what does Python do first?",
)
def brackets_missing(pixels: Array, K: Array) -> Any:
    return pixels[:, 0] - K[0, 2] / K[0, 0], pixels[:, 1] - K[1, 2] / K[1, 1], 1.0


@DEPROJECT.mistake(
    "to_normalised",
    "the pixels are multiplied by fx and fy",
    "Pixels from the principal point, and a focal length in pixels: which of × and ÷ gives X/Z?",
)
def times_focal_length(pixels: Array, K: Array) -> Any:
    return (pixels[:, 0] - K[0, 2]) * K[0, 0], (pixels[:, 1] - K[1, 2]) * K[1, 1], 1.0


@DEPROJECT.mistake("to_normalised", *_as_in_project("fx_fy_swapped"), name="fx_fy_swapped")
def fx_fy_swapped_back(pixels: Array, K: Array) -> Any:
    return (pixels[:, 0] - K[0, 2]) / K[1, 1], (pixels[:, 1] - K[1, 2]) / K[0, 0], 1.0


@DEPROJECT.mistake("to_normalised", *_as_in_project("fx_for_both"), name="fx_for_both")
def fx_for_both_back(pixels: Array, K: Array) -> Any:
    return (pixels[:, 0] - K[0, 2]) / K[0, 0], (pixels[:, 1] - K[1, 2]) / K[0, 0], 1.0


@DEPROJECT.mistake("to_normalised", *_as_in_project("cx_cy_swapped"), name="cx_cy_swapped")
def cx_cy_swapped_back(pixels: Array, K: Array) -> Any:
    return (pixels[:, 0] - K[1, 2]) / K[0, 0], (pixels[:, 1] - K[0, 2]) / K[1, 1], 1.0


@DEPROJECT.mistake(
    "to_normalised",
    "x and y are swapped in the input",
    "A pixel is (u, v), column first. Which of your lines uses u?",
)
def input_swapped(pixels: Array, K: Array) -> Any:
    return _to_normalised(pixels[:, ::-1], K)


@DEPROJECT.mistake("to_normalised", *_UP, name="y_up")
def y_up_back(pixels: Array, K: Array) -> Any:
    x, y, w = _to_normalised(pixels, K)
    return x, -y, w


@DEPROJECT.mistake("to_normalised", *_HALF, name="half_pixel")
def half_pixel_more_back(pixels: Array, K: Array) -> Any:
    return _to_normalised(pixels + 0.5, K)


@DEPROJECT.mistake("to_normalised", *_HALF, name="half_pixel")
def half_pixel_less_back(pixels: Array, K: Array) -> Any:
    return _to_normalised(pixels - 0.5, K)


# From the ray to the point.


@DEPROJECT.mistake(
    "scale",
    "the depth is taken along the ray instead of along Z",
    "A wall faces the camera. Does your function give all its pixels the same Z?",
)
def depth_along_ray(x: Array, y: Array, w: Any, depth: Array) -> Any:
    return _scale(x, y, w, depth / np.sqrt(x * x + y * y + w * w))


_MILLIMETRES = (
    "your points are not in metres",
    "The depth comes in metres and the points leave in metres. What do you multiply it by?",
)


@DEPROJECT.mistake("scale", *_MILLIMETRES, name="millimetres")
def times_thousand(x: Array, y: Array, w: Any, depth: Array) -> Any:
    return _scale(x, y, w, 1000 * depth)


@DEPROJECT.mistake("scale", *_MILLIMETRES, name="millimetres")
def through_thousand(x: Array, y: Array, w: Any, depth: Array) -> Any:
    return _scale(x, y, w, depth / 1000)


@DEPROJECT.mistake(
    "scale",
    "x and y are not multiplied by the depth",
    "Two pixels of one ray at 0.5 m and at 1 m: is X the same for both?",
)
def not_scaled(x: Array, y: Array, w: Any, depth: Array) -> Any:
    return x, y, w * depth


@DEPROJECT.mistake(
    "scale",
    "x and y are divided by the depth",
    "Of two points on one ray, the farther one is also farther from the axis. Is yours?",
)
def divided_by_depth(x: Array, y: Array, w: Any, depth: Array) -> Any:
    return x / depth, y / depth, w * depth


@DEPROJECT.mistake(
    "scale",
    "the depth is forgotten: Z is 1 everywhere",
    "Your points lie on a plane at 1 m. What says how far along its ray each of them is?",
)
def depth_forgotten(x: Array, y: Array, w: Any, depth: Array) -> Any:
    return x, y, w * np.ones_like(depth)


# The coefficients and the equation: what goes wrong in the first exercise does so in this one. But
# without its 1 the radial factor has no inverse that an iteration would find.

DEPROJECT.mistakes += [
    m for m in PROJECT.mistakes if m.step in ("read", "bend") and m.name != "one_missing"
]

# The inversion.


@DEPROJECT.mistake(
    "unbend",
    "the distortion is applied once more instead of being inverted",
    "Project your answer. Do you come back to the pixel that you started from?",
)
def distorted_again(x: Array, y: Array, bend: Step, *dist: float) -> Any:
    return bend(x, y)


def _divide(rounds: int) -> Step:
    """OpenCV's iteration: subtract the tangential part, divide by the radial factor."""

    def unbend(x: Array, y: Array, bend: Step, *dist: float) -> Any:
        k1, k2, p1, p2, k3 = dist
        xd, yd = x, y
        for _ in range(rounds):
            r2 = x * x + y * y
            radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
            dx = 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
            dy = p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
            x, y = (xd - dx) / radial, (yd - dy) / radial
        return x, y

    return unbend


def _overwritten(rounds: int) -> Step:
    """The iteration that compares with its own last guess: xd and x are one array, say."""

    def unbend(x: Array, y: Array, bend: Step, *dist: float) -> Any:
        for _ in range(rounds):
            bent_x, bent_y = bend(x, y)
            x, y = 2 * x - bent_x, 2 * y - bent_y
        return x, y

    return unbend


_ONE_STEP = (
    "the inversion stops after one step (flipping the signs of the coefficients is one, too)",
    "Project your answer: close, but not back. What would a second step do?",
)
DEPROJECT.mistake("unbend", *_ONE_STEP, name="one_step")(_iterate(1))
DEPROJECT.mistake("unbend", *_ONE_STEP, name="one_step")(_divide(1))

# With more rounds than these, all cases agree. Of each long family a few are tried in pairs, too.
_EARLY = (
    "the iteration stops too early (`cv2.undistortPoints` does after five rounds)",
    "Print how much x changes in the last round. When may you stop?",
)
for _rounds in range(2, 14):
    _alone = _rounds not in (2, 3, 5, 10)
    DEPROJECT.mistake("unbend", *_EARLY, "too_few_rounds", _alone)(_iterate(_rounds))
for _rounds in range(2, 8):
    _alone = _rounds != 5
    DEPROJECT.mistake("unbend", *_EARLY, "too_few_rounds", _alone)(_divide(_rounds))

for _rounds in (*range(2, 51), 100):
    DEPROJECT.mistake(
        "unbend",
        "the iteration compares with its own last guess",
        "Compare with `xd`, which must not change, in every round. Does yours? "
        "(After `x = xd`, `x += ...` changes both.)",
        name="target_overwritten",
        alone=_rounds not in (5, 10, 20, 50),
    )(_overwritten(_rounds))


EXERCISES = [PROJECT, DEPROJECT]

# --- checkpoints ---

CHECKPOINTS = [
    Choice(
        name="pinhole.twice_as_far",
        question="The image of a point is 30 px right of the optical axis. The point moves "
        "straight away from the camera, along Z, to twice its depth. Where is its image now?",
        options=(
            Option(
                "30 px right of it",
                "That would mean that size does not depend on distance. A point that stays 30 px "
                "out moves along its *ray*, not along Z.",
            ),
            Option(
                "15 px right of it",
                "x_s = f X / Z: X stays, Z doubles, the offset halves. That is why distant "
                "things look small and why one pixel covers more of them.",
                right=True,
            ),
            Option(
                "7.5 px right of it",
                "A quarter is how *area* shrinks, or brightness. A length is divided by Z once.",
            ),
            Option(
                "60 px right of it",
                "Farther away is smaller in the image: in x_s = f X / Z, Z is the denominator.",
            ),
        ),
    ),
    Number(
        name="pinhole.pitch",
        question="A lens with f = 10 mm in front of a sensor with 10 µm pixels has fx = 1000 px. "
        "The sensor is replaced by one with 5 µm pixels. What is fx now, in px?",
        value=2000.0,
        unit="px",
        why="fx = f / pitch = 10 mm / 0.005 mm per px. The lens has not changed; the ruler that "
        "measures its focal length has become twice as fine.",
        hint="fx is the focal length measured in pixels: f divided by the pixel pitch.",
        classics=(
            Classic(1000.0, "The lens is the same, but fx counts *pixels*, and those are smaller."),
            Classic(500.0, "Smaller pixels mean more of them along the same focal length."),
            Classic(50.0, "That is 10 × 5. f is divided by the pitch, not multiplied by it."),
            Classic(2.0, "Check the units: 10 mm are 10 000 µm."),
        ),
    ),
    Choice(
        name="pinhole.half_size",
        question="You scale the 1280x720 image down to 640x360. What happens to K?",
        options=(
            Option(
                "nothing, the lens is the same",
                "The lens is, the pixels are not: each is twice as large, so f measured in pixels "
                "is half. K belongs to an *image size*, not to a camera alone.",
            ),
            Option(
                "fx and fy halve, cx and cy stay",
                "Then the optical axis would meet the small image near its right lower corner.",
            ),
            Option(
                "all four halve",
                "Everything measured in pixels shrinks with the pixels. (cx and cy to a quarter "
                "pixel: (0, 0) is the *centre* of a pixel, so cx becomes (cx + 0.5) / 2 - 0.5.)",
                right=True,
            ),
            Option(
                "cx and cy halve, fx and fy stay",
                "Then the field of view would halve too. Cropping does something like that (it "
                "keeps fx and moves cx); scaling does not.",
            ),
        ),
    ),
    Number(
        name="pinhole.same_size",
        question="The face of the 60 mm block, 0.45 m away, is as wide in the image as the face "
        "of the 25 mm cube. How far away is the cube, in m?",
        value=0.1875,
        unit="m",
        why="Equal width in the image means equal X / Z: 25 / Z = 60 / 0.45. From one colour image "
        "alone you could not have told the two apart.",
        hint="Equal size in the image means equal ratio of size to distance.",
        classics=(
            Classic(1.08, "Upside down: the smaller thing has to be *nearer* to look as large."),
            Classic(0.45, "At the same distance the smaller cube looks smaller."),
            Classic(0.415, "Sizes are divided by distance, not subtracted from it."),
            Classic(0.0781, "A length goes with 1/Z, not with 1/Z²."),
        ),
    ),
    Choice(
        name="pinhole.exact_centre",
        question="A calibration program returns the principal point (319.5, 239.5) px for a "
        "640x480 camera, exact to the last digit. What do you conclude?",
        options=(
            Option(
                "an excellent lens",
                "Lenses are glued to within tens of micrometres, and pixels measure a few. The "
                "cameras in this course are 0.4 to 23 px off centre.",
            ),
            Option(
                "it was not estimated: that is the image centre, put in by hand",
                "(640 - 1) / 2 = 319.5 is the centre when (0, 0) is the centre of the first pixel. "
                "A number that was *measured* has digits that nobody would choose.",
                right=True,
            ),
            Option(
                "the camera had already straightened the image",
                "Straightened (*rectified*) images have a principal point of their own, and it is "
                "as crooked as any: the depth stream of your camera is one.",
            ),
            Option(
                "the calibration is half a pixel off: the centre is (320, 240)",
                "That is the other convention, in which (0, 0) is the *corner* of the first "
                "pixel. OpenCV and RealSense put it at the centre.",
            ),
        ),
    ),
    Number(
        name="pinhole.range",
        question="K = (447, 447, 424, 240). The pixel (0, 240), at the left edge, has depth "
        "0.45 m. How far is that point from the camera's centre, in m?",
        value=0.45 * math.hypot(1.0, 424 / 447),
        unit="m",
        why="Depth is Z, along the optical axis. The point is also X = (0 - 424) / 447 × 0.45 = "
        "-0.427 m to the left, so its distance along the ray is √(0.45² + 0.427²).",
        hint="Deproject the pixel first: X = (u - cx) Z / fx. Then take the length of (X, Y, Z).",
        classics=(
            Classic(0.45, "That is the depth, Z. The point lies far to the left as well."),
            Classic(0.427, "That is the size of X alone; the point is also 0.45 m in front."),
            Classic(0.3265, "That takes 0.45 m as the length of the ray and returns its Z."),
            Classic(0.877, "Lengths at a right angle add as squares, not as numbers."),
        ),
    ),
]

OBJECTIVES = (
    Objective(
        "derive the projection equation and say what projection throws away",
        ("pinhole.twice_as_far", "pinhole.same_size"),
    ),
    Objective(
        "explain each entry of K for the camera in hand, with its unit",
        ("pinhole.pitch", "pinhole.half_size", "pinhole.exact_centre"),
    ),
    Objective(
        "write project, and take a pixel with its depth back to a point (deeper: write deproject, "
        "with distortion, and test both against OpenCV)",
        ("pinhole.project", "pinhole.deproject"),
    ),
    Objective(
        "turn a depth image into points and say what its numbers mean",
        ("pinhole.range",),
    ),
)
