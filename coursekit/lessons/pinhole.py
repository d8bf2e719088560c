"""Notebook 01: its two exercises and the mistakes that people make in them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.lessons.exercises import Core, Exercise, Model, Step

# --- project ---

GENERIC_K = np.array([[612.5, 0.0, 331.4], [0.0, 598.0, 236.8], [0.0, 0.0, 1.0]])
LESSON_K = np.array([[447.0, 0.0, 424.0], [0.0, 447.0, 240.0], [0.0, 0.0, 1.0]])
SINGLE = np.array([[0.30, -0.20, 0.90]])
# Four points, not two or three: a wrong broadcast over (N, 2) or (N, 3) must not go through.
SEVERAL = np.array([[0.25, 0.40, 0.80], [-0.31, 0.12, 0.55], [0.07, -0.26, 0.62], [0.1, 0.2, 0.4]])
MIXED = np.array([-0.27, 0.11, 0.0018, -0.0012, 0.05])


# The steps of projection. The third of x, y, w is 1 unless somebody treats Z in a way of their own.


def _normalise(points: Floats) -> Any:
    return points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], 1.0


def _read(k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    return k1, k2, p1, p2, k3


def _bend(x: Floats, y: Floats, k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


def _to_pixels(x: Floats, y: Floats, w: Any, K: Floats) -> Any:
    return K[0, 0] * x + K[0, 2] * w, K[1, 1] * y + K[1, 2] * w


def _image(points: Floats, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    x, y, w = normalise(points)
    return to_pixels(*bend(x, y), w)


def _columns(u: Floats, v: Floats) -> Floats:
    return np.stack([u, v], axis=1)


def _build_project(steps: Mapping[str, Step]) -> Model:
    def project(points: Floats, K: Floats, dist: Floats | None = None) -> Any:
        def bend(x: Floats, y: Floats) -> Any:
            return (x, y) if dist is None else steps["bend"](x, y, *steps["read"](*dist))

        def to_pixels(x: Floats, y: Floats, w: Any) -> Any:
            return steps["to_pixels"](x, y, w, K)

        return steps["columns"](*steps["image"](points, steps["normalise"], bend, to_pixels))

    return project


def _tuple(values: Any, places: int) -> str:
    return "(" + ", ".join(f"{v:.{places}f}" for v in values) + ")"


def _short(values: Any) -> str:
    return "(" + ", ".join(f"{v:g}" for v in values) + ")"


def _describe_camera(K: Floats, dist: Floats | None = None) -> str:
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


@PROJECT.mistake("normalise")
def no_division(points: Floats) -> Any:
    """nothing is divided by Z

    Two points on one ray, one twice as far as the other: do yours land on the same pixel?
    """
    return points[:, 0], points[:, 1], 1.0


@PROJECT.mistake("normalise", same_as=no_division)
def homogeneous_without_division(points: Floats) -> Any:
    return points[:, 0], points[:, 1], points[:, 2]


@PROJECT.mistake("normalise")
def divided_by_range(points: Floats) -> Any:
    """X and Y are divided by the length of the ray instead of by Z

    All points of a wall that faces the camera have the same Z. Do yours get the same divisor?
    """
    length = np.linalg.norm(points, axis=1)
    return points[:, 0] / length, points[:, 1] / length, 1.0


@PROJECT.mistake("normalise")
def centre_divided(points: Floats) -> Any:
    """the principal point is divided by Z as well

    Where does a point on the optical axis land, at 0.5 m and at 1 m? And with yours?
    """
    x, y, _ = _normalise(points)
    return x, y, 1.0 / points[:, 2]


@PROJECT.mistake("normalise")
def upside_down(points: Floats) -> Any:
    """the ratios are upside down: Z is divided by X and by Y

    Move a point twice as far to the right. Does yours move farther to the right in the image?
    """
    return points[:, 2] / points[:, 0], points[:, 2] / points[:, 1], 1.0


@PROJECT.mistake("normalise")
def y_up(points: Floats) -> Any:
    """your y axis points up

    In which row is a point below the optical axis?
    """
    x, y, w = _normalise(points)
    return x, -y, w


@PROJECT.mistake("to_pixels", same_as=y_up)
def y_up_after_distortion(x: Floats, y: Floats, w: Any, K: Floats) -> Any:
    return _to_pixels(x, -y, w, K)


@PROJECT.mistake("to_pixels")
def fx_fy_swapped(x: Floats, y: Floats, w: Any, K: Floats) -> Any:
    """your fx and fy are swapped

    Which entry of K belongs to the columns of the image?
    """
    return K[1, 1] * x + K[0, 2] * w, K[0, 0] * y + K[1, 2] * w


@PROJECT.mistake("to_pixels")
def fx_for_both(x: Floats, y: Floats, w: Any, K: Floats) -> Any:
    """fx is used for both axes

    K has four numbers in it. Does your function use them all?
    """
    return K[0, 0] * x + K[0, 2] * w, K[0, 0] * y + K[1, 2] * w


@PROJECT.mistake("to_pixels")
def centre_before_scale(x: Floats, y: Floats, w: Any, K: Floats) -> Any:
    """the principal point is added before the multiplication by fx and fy

    A point on the optical axis has x = y = 0. On which pixel must it land?
    """
    return K[0, 0] * (x + K[0, 2] * w), K[1, 1] * (y + K[1, 2] * w)


@PROJECT.mistake("to_pixels")
def K_transposed(x: Floats, y: Floats, w: Any, K: Floats) -> Any:
    """K is multiplied from the wrong side

    The equation says K times a column. Your points are rows: what has to be transposed?
    """
    third = K[0, 2] * x + K[1, 2] * y + w
    return K[0, 0] * x / third, K[1, 1] * y / third


@PROJECT.mistake("to_pixels")
def cx_cy_swapped(x: Floats, y: Floats, w: Any, K: Floats) -> Any:
    """your cx and cy are swapped

    Which of the two is near half the *width* of the image?
    """
    return K[0, 0] * x + K[1, 2] * w, K[1, 1] * y + K[0, 2] * w


@PROJECT.mistake("to_pixels")
def principal_point_forgotten(x: Floats, y: Floats, w: Any, K: Floats) -> Any:
    """the principal point is forgotten

    Where does a point on the optical axis land, and where does yours put it?
    """
    return K[0, 0] * x, K[1, 1] * y


@PROJECT.mistake("to_pixels")
def principal_point_subtracted(x: Floats, y: Floats, w: Any, K: Floats) -> Any:
    """the principal point is subtracted

    A point on the optical axis has x = y = 0. On which pixel must it land?
    """
    return K[0, 0] * x - K[0, 2] * w, K[1, 1] * y - K[1, 2] * w


@PROJECT.mistake("read")
def p1_p2_swapped(k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    """your p1 and p2 are swapped

    Which of the two multiplies r² + 2x²?
    """
    return k1, k2, p2, p1, k3


@PROJECT.mistake("read")
def k3_before_p1(k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    """the coefficients are read as (k1, k2, k3, p1, p2)

    OpenCV added k3 when the other four were already there. At which end?
    """
    return k1, k2, p2, k3, p1


@PROJECT.mistake("read")
def r6_missing(k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    """the r⁶ term is missing

    Five coefficients come in. Does each of them do something?
    """
    return k1, k2, p1, p2, 0.0


@PROJECT.mistake("read")
def tangential_missing(k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    """the tangential terms are missing

    What do p1 and p2 do in your function?
    """
    return k1, k2, 0.0, 0.0, k3


def _bent(
    powers: tuple[float, float, float] = (1, 2, 3),
    tangential: float = 1,
    cross: float = 2,
    square: float = 2,
) -> Step:
    """`bend` with these powers of r² in the radial and the tangential terms, and these factors.

    cross: of p xy, square: of x² and y².
    """

    def bend(x: Floats, y: Floats, k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
        r2 = x * x + y * y
        radial = 1 + sum(k * r2**power for k, power in zip((k1, k2, k3), powers, strict=True))
        return (
            x * radial + cross * p1 * x * y + p2 * (r2**tangential + square * x * x),
            y * radial + p1 * (r2**tangential + square * y * y) + cross * p2 * x * y,
        )

    return bend


@PROJECT.mistake("bend")
def factor_2_missing(x: Floats, y: Floats, *dist: float) -> Any:
    """a factor 2 is missing in the tangential terms

    There are four twos in them: 2 p1 xy, 2x², 2y² and 2 p2 xy. Count yours.
    """
    return _bent(cross=1)(x, y, *dist)


PROJECT.mistake("bend", same_as=factor_2_missing)(_bent(square=1))
PROJECT.mistake("bend", same_as=factor_2_missing)(_bent(cross=1, square=1))


@PROJECT.mistake("bend")
def x_overwritten(
    x: Floats, y: Floats, k1: float, k2: float, p1: float, p2: float, k3: float
) -> Any:
    """x is overwritten before y is computed from it

    Your line for y uses x. Is it still the x you started with?
    """
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    y = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return x, y


@PROJECT.mistake("bend")
def tangential_after_radial(
    x: Floats, y: Floats, k1: float, k2: float, p1: float, p2: float, k3: float
) -> Any:
    """the tangential terms use x and y after the radial factor

    Both kinds of distortion start from the same ideal x and y. Do yours?
    """
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    x, y = x * radial, y * radial
    return (
        x + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
        y + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
    )


@PROJECT.mistake("bend")
def one_missing(x: Floats, y: Floats, *dist: float) -> Any:
    """the 1 is missing in the radial factor

    If all five coefficients are 0, nothing may move. Where do your points land then?
    """
    bent_x, bent_y = _bend(x, y, *dist)
    return bent_x - x, bent_y - y


@PROJECT.mistake("bend")
def r_for_r2(x: Floats, y: Floats, *dist: float) -> Any:
    """the radial polynomial runs in r instead of r²

    With k1 alone, the displacement grows as the third power of the radius. How does yours?
    """
    return _bent((0.5, 1, 1.5))(x, y, *dist)


PROJECT.mistake("bend", same_as=r_for_r2)(_bent((0.5, 1, 1.5), tangential=0.5))


@PROJECT.mistake("bend")
def r2_for_r(x: Floats, y: Floats, *dist: float) -> Any:
    """r² is taken for r and raised to the powers 2, 4 and 6

    In your code, is the name of x² + y² the name of a radius or of its square?
    """
    return _bent((2, 4, 6))(x, y, *dist)


PROJECT.mistake("bend", same_as=r2_for_r)(_bent((2, 4, 6), tangential=2))
PROJECT.mistake("bend", same_as=r2_for_r)(_bent((1, 4, 6)))


@PROJECT.mistake("image")
def bent_before_division(points: Floats, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    """the distortion is applied before the division by Z

    r² has no unit. What unit does yours have?
    """
    x, y = bend(points[:, 0], points[:, 1])
    return to_pixels(x / points[:, 2], y / points[:, 2], 1.0)


@PROJECT.mistake("image")
def distortion_in_pixels(points: Floats, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    """the distortion is applied in pixels

    The polynomial wants x = X/Z, which is 1 at 45 degrees off the axis. How large is your r²?
    """
    return bend(*to_pixels(*normalise(points)))


@PROJECT.mistake("image", same_as=distortion_in_pixels)
def distortion_of_centred_uv(points: Floats, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    cx, cy = to_pixels(0.0, 0.0, 1.0)
    u, v = to_pixels(*normalise(points))
    u, v = bend(u - cx, v - cy)
    return u + cx, v + cy


@PROJECT.mistake("columns")
def output_swapped(u: Floats, v: Floats) -> Floats:
    """x and y are swapped in the output

    A pixel is (u, v), column first; a NumPy index is [row, column]. Which did you return?
    """
    return np.stack([v, u], axis=1)


@PROJECT.mistake("columns")
def rounded(u: Floats, v: Floats) -> Floats:
    """the pixels are rounded to whole numbers

    A calibrated corner is known to a tenth of a pixel. What is left of that?
    """
    return np.rint(np.stack([u, v], axis=1))


@PROJECT.mistake("columns", same_as=rounded)
def truncated(u: Floats, v: Floats) -> Floats:
    return np.trunc(np.stack([u, v], axis=1))


@PROJECT.mistake("columns")
def half_pixel(u: Floats, v: Floats) -> Floats:
    """every pixel is half a pixel off

    OpenCV and RealSense give the *centre* of the top-left pixel the coordinates (0, 0). Which of
    your lines moves it?
    """
    return np.stack([u, v], axis=1) + 0.5


@PROJECT.mistake("columns", same_as=half_pixel)
def half_pixel_less(u: Floats, v: Floats) -> Floats:
    return np.stack([u, v], axis=1) - 0.5


# --- deproject ---

# The steps back. The third of x, y, w is 1 unless somebody multiplies from the wrong side.


def _to_normalised(pixels: Floats, K: Floats) -> Any:
    return (pixels[:, 0] - K[0, 2]) / K[0, 0], (pixels[:, 1] - K[1, 2]) / K[1, 1], 1.0


def _iterate(rounds: int) -> Step:
    """The fixed-point iteration, so many rounds of it."""

    def unbend(x: Floats, y: Floats, bend: Step, *dist: float) -> Any:
        xd, yd = x, y
        for _ in range(rounds):
            bent_x, bent_y = bend(x, y)
            x, y = x + xd - bent_x, y + yd - bent_y
        return x, y

    return unbend


def _scale(x: Floats, y: Floats, w: Any, depth: Floats) -> Any:
    return x * depth, y * depth, w * depth


def _points(X: Floats, Y: Floats, Z: Floats) -> Floats:
    return np.stack([X, Y, Z], axis=1)


def _build_deproject(steps: Mapping[str, Step]) -> Model:
    def deproject(pixels: Floats, depth: Floats, K: Floats, dist: Floats | None = None) -> Any:
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


# From the pixel to the ray.


@DEPROJECT.mistake("to_normalised")
def inverse_missing(pixels: Floats, K: Floats) -> Any:
    """K is applied where its inverse is needed

    K takes rays to pixels. Which way does this function go?
    """
    return K[0, 0] * pixels[:, 0] + K[0, 2], K[1, 1] * pixels[:, 1] + K[1, 2], 1.0


@DEPROJECT.mistake("to_normalised", name="K_transposed")
def inverse_transposed(pixels: Floats, K: Floats) -> Any:
    """the inverse of K is multiplied from the wrong side

    The equation says K⁻¹ times a column. Your pixels are rows: what has to be transposed?
    """
    third = 1 - K[0, 2] / K[0, 0] * pixels[:, 0] - K[1, 2] / K[1, 1] * pixels[:, 1]
    return pixels[:, 0] / K[0, 0], pixels[:, 1] / K[1, 1], third


@DEPROJECT.mistake("to_normalised", same_as=inverse_transposed, name="K_transposed")
def inverse_transposed_and_divided(pixels: Floats, K: Floats) -> Any:
    x, y, third = inverse_transposed(pixels, K)
    return x / third, y / third, 1.0


@DEPROJECT.mistake("to_normalised", same_as=principal_point_forgotten)
def principal_point_not_subtracted(pixels: Floats, K: Floats) -> Any:
    return pixels[:, 0] / K[0, 0], pixels[:, 1] / K[1, 1], 1.0


@DEPROJECT.mistake("to_normalised")
def principal_point_added(pixels: Floats, K: Floats) -> Any:
    """the principal point is added

    The pixel at the principal point looks straight ahead. What are your x and y there?
    """
    return (pixels[:, 0] + K[0, 2]) / K[0, 0], (pixels[:, 1] + K[1, 2]) / K[1, 1], 1.0


@DEPROJECT.mistake("to_normalised")
def brackets_missing(pixels: Floats, K: Floats) -> Any:
    """only the principal point is divided by fx and fy

    In `a - b / c`, what does Python do first?
    """
    return pixels[:, 0] - K[0, 2] / K[0, 0], pixels[:, 1] - K[1, 2] / K[1, 1], 1.0


@DEPROJECT.mistake("to_normalised")
def times_focal_length(pixels: Floats, K: Floats) -> Any:
    """the pixels are multiplied by fx and fy

    Pixels from the principal point, and a focal length in pixels: which of × and ÷ gives X/Z?
    """
    return (pixels[:, 0] - K[0, 2]) * K[0, 0], (pixels[:, 1] - K[1, 2]) * K[1, 1], 1.0


@DEPROJECT.mistake("to_normalised", same_as=fx_fy_swapped)
def fx_fy_swapped_back(pixels: Floats, K: Floats) -> Any:
    return (pixels[:, 0] - K[0, 2]) / K[1, 1], (pixels[:, 1] - K[1, 2]) / K[0, 0], 1.0


@DEPROJECT.mistake("to_normalised", same_as=fx_for_both)
def fx_for_both_back(pixels: Floats, K: Floats) -> Any:
    return (pixels[:, 0] - K[0, 2]) / K[0, 0], (pixels[:, 1] - K[1, 2]) / K[0, 0], 1.0


@DEPROJECT.mistake("to_normalised", same_as=cx_cy_swapped)
def cx_cy_swapped_back(pixels: Floats, K: Floats) -> Any:
    return (pixels[:, 0] - K[1, 2]) / K[0, 0], (pixels[:, 1] - K[0, 2]) / K[1, 1], 1.0


@DEPROJECT.mistake("to_normalised")
def input_swapped(pixels: Floats, K: Floats) -> Any:
    """x and y are swapped in the input

    A pixel is (u, v), column first. Which of your lines uses u?
    """
    return _to_normalised(pixels[:, ::-1], K)


@DEPROJECT.mistake("to_normalised", same_as=y_up)
def y_up_back(pixels: Floats, K: Floats) -> Any:
    x, y, w = _to_normalised(pixels, K)
    return x, -y, w


@DEPROJECT.mistake("to_normalised", same_as=half_pixel)
def half_pixel_more_back(pixels: Floats, K: Floats) -> Any:
    return _to_normalised(pixels + 0.5, K)


@DEPROJECT.mistake("to_normalised", same_as=half_pixel)
def half_pixel_less_back(pixels: Floats, K: Floats) -> Any:
    return _to_normalised(pixels - 0.5, K)


# From the ray to the point.


@DEPROJECT.mistake("scale")
def depth_along_ray(x: Floats, y: Floats, w: Any, depth: Floats) -> Any:
    """the depth is taken along the ray instead of along Z

    A wall faces the camera. Does your function give all its pixels the same Z?
    """
    return _scale(x, y, w, depth / np.sqrt(x * x + y * y + w * w))


@DEPROJECT.mistake("scale")
def millimetres(x: Floats, y: Floats, w: Any, depth: Floats) -> Any:
    """your points are not in metres

    The depth comes in metres and the points leave in metres. What do you multiply it by?
    """
    return _scale(x, y, w, 1000 * depth)


@DEPROJECT.mistake("scale", same_as=millimetres)
def through_thousand(x: Floats, y: Floats, w: Any, depth: Floats) -> Any:
    return _scale(x, y, w, depth / 1000)


@DEPROJECT.mistake("scale")
def not_scaled(x: Floats, y: Floats, w: Any, depth: Floats) -> Any:
    """x and y are not multiplied by the depth

    Two pixels of one ray at 0.5 m and at 1 m: is X the same for both?
    """
    return x, y, w * depth


@DEPROJECT.mistake("scale")
def divided_by_depth(x: Floats, y: Floats, w: Any, depth: Floats) -> Any:
    """x and y are divided by the depth

    Of two points on one ray, the farther one is also farther from the axis. Is yours?
    """
    return x / depth, y / depth, w * depth


@DEPROJECT.mistake("scale")
def depth_forgotten(x: Floats, y: Floats, w: Any, depth: Floats) -> Any:
    """the depth is forgotten: Z is 1 everywhere

    Your points lie on a plane at 1 m. What says how far along its ray each of them is?
    """
    return x, y, w * np.ones_like(depth)


# The coefficients and the equation: what goes wrong in the first exercise does so in this one. But
# without its 1 the radial factor has no inverse that an iteration would find.

DEPROJECT.mistakes += [
    m for m in PROJECT.mistakes if m.step in ("read", "bend") and m.name != "one_missing"
]

# The inversion.


@DEPROJECT.mistake("unbend")
def distorted_again(x: Floats, y: Floats, bend: Step, *dist: float) -> Any:
    """the distortion is applied once more instead of being inverted

    Project your answer. Do you come back to the pixel that you started from?
    """
    return bend(x, y)


@DEPROJECT.mistake("unbend")
def one_step(x: Floats, y: Floats, bend: Step, *dist: float) -> Any:
    """the inversion stops after one step (flipping the signs of the coefficients is one, too)

    Project your answer: close, but not back. What would a second step do?
    """
    return _iterate(1)(x, y, bend, *dist)


def _divide(rounds: int) -> Step:
    """OpenCV's iteration: subtract the tangential part, divide by the radial factor."""

    def unbend(x: Floats, y: Floats, bend: Step, *dist: float) -> Any:
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


def too_few_rounds() -> None:
    """the iteration stops too early (`cv2.undistortPoints` does after five rounds)

    Print how much x changes in the last round. When may you stop?
    """


def _overwritten(rounds: int) -> Step:
    """The iteration that compares with its own last guess: xd and x are one array, say."""

    def target_overwritten(x: Floats, y: Floats, bend: Step, *dist: float) -> Any:
        """the iteration compares with its own last guess

        Compare with `xd`, which must not change, in every round. Does yours? (After `x = xd`,
        `x += ...` changes both.)
        """
        for _ in range(rounds):
            bent_x, bent_y = bend(x, y)
            x, y = 2 * x - bent_x, 2 * y - bent_y
        return x, y

    return target_overwritten


DEPROJECT.mistake("unbend", same_as=one_step)(_divide(1))

# With more rounds than these, all cases agree. Of each long family a few are tried in pairs, too.
for _family, _every, _in_pairs in (
    (_iterate, range(2, 14), (2, 3, 5, 10)),
    (_divide, range(2, 8), (5,)),
    (_overwritten, (*range(2, 51), 100), (5, 10, 20, 50)),
):
    for _rounds in _every:
        _same = None if _family is _overwritten else too_few_rounds
        _add = DEPROJECT.mistake("unbend", same_as=_same, alone=_rounds not in _in_pairs)
        _add(_family(_rounds))
