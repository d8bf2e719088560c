"""Notebook 01: its two exercises and the mistakes that people make in them."""

from __future__ import annotations

from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.lessons.exercises import Exercise, Step, Steps, in_digits

# --- project ---

# The steps of projection. The third of x, y, w is 1 unless somebody treats Z in a way of their own.


def _lens(K: Floats) -> Any:
    """fx, fy, cx and cy."""
    return K[0, 0], K[1, 1], K[0, 2], K[1, 2]


def _bend(x: Floats, y: Floats, k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
    r2 = x**2 + y**2
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    return (
        x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
        y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
    )


def _bent(
    powers: tuple[float, float, float] = (1, 2, 3),
    tangential: float = 1,
    cross: float = 2,
    square: float = 2,
) -> Step:
    """The distortion; a mistake has other powers of r² in the radial and the tangential terms, or
    other factors.

    cross: of p xy, square: of x² and y².
    """

    def bend(x: Floats, y: Floats, k1: float, k2: float, p1: float, p2: float, k3: float) -> Any:
        r2 = x * x + y * y
        radial = sum((k * r2**n for k, n in zip((k1, k2, k3), powers, strict=True)), 1)
        return (
            x * radial + cross * p1 * x * y + p2 * (r2**tangential + square * x * x),
            y * radial + p1 * (r2**tangential + square * y * y) + cross * p2 * x * y,
        )

    return bend


def _to_pixels(x: Floats, y: Floats, w: Any, fx: float, fy: float, cx: float, cy: float) -> Any:
    return fx * x + cx * w, fy * y + cy * w


def _image(points: Floats, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    x, y, w = normalise(*points)
    return to_pixels(*bend(x, y), w)


def _project(steps: Steps, points: Floats, K: Floats, dist: Floats | None = None) -> Any:
    def bend(x: Floats, y: Floats) -> Any:
        return (x, y) if dist is None else steps["bend"](x, y, *steps["read"](*dist))

    def to_pixels(x: Floats, y: Floats, w: Any) -> Any:
        return steps["to_pixels"](x, y, w, *steps["lens"](*_lens(K)))

    return steps["columns"](*steps["image"](points.T, steps["normalise"], bend, to_pixels))


def _describe_camera(K: Floats, dist: Floats | None = None) -> str:
    text = f"K = {in_digits('(g)', _lens(K))} px"
    return text if dist is None else f"{text}, coefficients {in_digits('(g)', dist)}"


def _describe_project(args: tuple[Any, ...]) -> str:
    points, *camera = args
    named = "point" if len(points) == 1 else "points"
    what = ", ".join(in_digits("(.2f)", point) for point in points)
    return f"{_describe_camera(*camera)}, {named} {what} m"


PROJECT = Exercise.told(
    "pinhole.project",
    build=_project,
    steps={
        "lens": lambda fx, fy, cx, cy: (fx, fy, cx, cy),
        "normalise": lambda X, Y, Z: (X / Z, Y / Z, 1.0),
        "read": lambda k1, k2, p1, p2, k3: (k1, k2, p1, p2, k3),
        "bend": _bend,
        "to_pixels": _to_pixels,
        "image": _image,
        "columns": lambda u, v: np.stack([u, v], axis=1),
    },
    describe=_describe_project,
)


def _tangential_after_radial(x: Floats, y: Floats, *dist: float) -> Any:
    """The tangential terms of the point that is bent already, as librealsense has them."""
    k1, k2, p1, p2, k3 = dist
    r2 = x**2 + y**2
    a, b = _bend(x, y, k1, k2, 0.0, 0.0, k3)
    return a + 2 * p1 * a * b + p2 * (r2 + 2 * a**2), b + p1 * (r2 + 2 * b**2) + 2 * p2 * a * b


def _x_overwritten(x: Floats, y: Floats, *dist: float) -> Any:
    new_x, new_y = _bend(x, y, *dist)
    return new_x, new_y + 2 * dist[3] * (new_x - x) * y


def _transposed(x: Floats, y: Floats, w: Any, fx: float, fy: float, cx: float, cy: float) -> Any:
    return np.divide((fx * x, fy * y), cx * x + cy * y + w)


def _bent_first(points: Floats, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    return to_pixels(*(np.stack(bend(*points[:2])) / points[2]), 1.0)


def _bent_last(points: Floats, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    return bend(*to_pixels(*normalise(*points)))


def _bent_about_the_centre(points: Floats, normalise: Step, bend: Step, to_pixels: Step) -> Any:
    centre = np.reshape(to_pixels(0.0, 0.0, 1.0), (2, 1))
    return centre + bend(*np.subtract(to_pixels(*normalise(*points)), centre))


# What goes wrong in this exercise and in the next.
_CAMERA: list[tuple[str, str, *tuple[Step, ...]]] = [
    ("lens", "y_up", lambda fx, fy, cx, cy: (fx, -fy, cx, cy)),
    ("lens", "fx_fy_swapped", lambda fx, fy, cx, cy: (fy, fx, cx, cy)),
    ("lens", "fx_for_both", lambda fx, fy, cx, cy: (fx, fx, cx, cy)),
    ("lens", "cx_cy_swapped", lambda fx, fy, cx, cy: (fx, fy, cy, cx)),
    ("lens", "principal_point_forgotten", lambda fx, fy, cx, cy: (fx, fy, 0.0, 0.0)),
    ("lens", "principal_point_forgotten", lambda fx, fy, cx, cy: (fx, fx, 0.0, 0.0)),
    ("lens", "half_pixel", lambda fx, fy, cx, cy: (fx, fy, cx + 0.5, cy + 0.5)),
    ("lens", "half_pixel", lambda fx, fy, cx, cy: (fx, fy, cx - 0.5, cy - 0.5)),
    ("read", "p1_p2_swapped", lambda k1, k2, p1, p2, k3: (k1, k2, p2, p1, k3)),
    ("read", "k3_before_p1", lambda k1, k2, p1, p2, k3: (k1, k2, p2, k3, p1)),
    ("read", "r6_missing", lambda k1, k2, p1, p2, k3: (k1, k2, p1, p2, 0.0)),
    ("read", "tangential_missing", lambda k1, k2, p1, p2, k3: (k1, k2, 0.0, 0.0, k3)),
    ("bend", "factor_2_missing", _bent(cross=1), _bent(square=1), _bent(cross=1, square=1)),
    ("bend", "x_overwritten", _x_overwritten),
    ("bend", "tangential_after_radial", _tangential_after_radial),
    ("bend", "r_for_r2", _bent((0.5, 1, 1.5)), _bent((0.5, 1, 1.5), tangential=0.5)),
    ("bend", "r2_for_r", _bent((2, 4, 6)), _bent((2, 4, 6), tangential=2), _bent((1, 4, 6))),
]
PROJECT.add_mistakes(
    ("normalise", "no_division", lambda X, Y, Z: (X, Y, 1.0), lambda X, Y, Z: (X, Y, Z)),
    ("normalise", "divided_by_range", lambda *P: (*(P[:2] / np.linalg.norm(P, axis=0)), 1.0)),
    ("normalise", "centre_divided", lambda X, Y, Z: (X / Z, Y / Z, 1.0 / Z)),
    ("normalise", "upside_down", lambda X, Y, Z: (Z / X, Z / Y, 1.0)),
    ("normalise", "y_up", lambda X, Y, Z: (X / Z, -Y / Z, 1.0)),
    ("lens", "centre_before_scale", lambda fx, fy, cx, cy: (fx, fy, fx * cx, fy * cy)),
    ("lens", "principal_point_subtracted", lambda fx, fy, cx, cy: (fx, fy, -cx, -cy)),
    ("to_pixels", "K_transposed", _transposed),
    *_CAMERA,
    ("bend", "one_missing", lambda x, y, *dist: np.subtract(_bend(x, y, *dist), (x, y))),
    ("image", "bent_before_division", _bent_first),
    ("image", "distortion_in_pixels", _bent_last, _bent_about_the_centre),
)


# --- deproject ---

# The steps back. The third of x, y, w is 1 unless somebody multiplies from the wrong side.


def _to_normalised(u: Floats, v: Floats, fx: float, fy: float, cx: float, cy: float) -> Any:
    return (u - cx) / fx, (v - cy) / fy, 1.0


def _iterate(rounds: int) -> Step:
    """The fixed-point iteration, so many rounds of it."""

    def unbend(x: Floats, y: Floats, bend: Step, *dist: float) -> Any:
        xd, yd = x, y
        for _ in range(rounds):
            bent_x, bent_y = bend(x, y)
            x, y = x + (xd - bent_x), y + (yd - bent_y)
            if np.all(np.abs(bent_x - xd) + np.abs(bent_y - yd) < 1e-14):
                break
        return x, y

    return unbend


def _scale(x: Floats, y: Floats, w: Any, depth: Floats) -> Any:
    return x * depth, y * depth, w * depth


def _deproject(
    steps: Steps, pixels: Floats, depth: Floats, K: Floats, dist: Floats | None = None
) -> Any:
    x, y, w = steps["rays"](*pixels.T, *steps["lens"](*_lens(K)))
    if dist is not None:
        read = steps["read"](*dist)
        x, y = steps["unbend"](x, y, lambda x, y: steps["bend"](x, y, *read), *read)
    return steps["points"](*steps["scale"](x, y, w, depth))


def _describe_deproject(args: tuple[Any, ...]) -> str:
    pixels, depth, *camera = args
    what = [f"{in_digits('(.1f)', p)} px at {z:.2f} m" for p, z in zip(pixels, depth, strict=True)]
    named = "pixel" if len(pixels) == 1 else "pixels"
    return f"{_describe_camera(*camera)}, {named} {', '.join(what)}"


DEPROJECT = Exercise.told(
    "pinhole.deproject",
    build=_deproject,
    steps={
        "lens": PROJECT.steps["lens"],
        "rays": _to_normalised,
        "read": PROJECT.steps["read"],
        "bend": _bend,
        "unbend": _iterate(40),
        "scale": _scale,
        "points": lambda X, Y, Z: np.stack([X, Y, Z], axis=1),
    },
    describe=_describe_deproject,
)


def _divide(rounds: int) -> Step:
    """OpenCV's iteration: subtract the tangential part, divide by the radial factor."""

    def unbend(x: Floats, y: Floats, bend: Step, *dist: float) -> Any:
        k1, k2, p1, p2, k3 = dist
        xd, yd = x, y
        for _ in range(rounds):
            r2 = x * x + y * y
            radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
            tangential = np.subtract(_bend(x, y, 0.0, 0.0, p1, p2, 0.0), (x, y))
            x, y = np.subtract((xd, yd), tangential) / radial
        return x, y

    return unbend


def _overwritten(rounds: int) -> Step:
    """The iteration that compares with its own last guess: xd and x are one array, say."""

    def unbend(x: Floats, y: Floats, bend: Step, *dist: float) -> Any:
        for _ in range(rounds):
            bent_x, bent_y = bend(x, y)
            x, y = 2 * x - bent_x, 2 * y - bent_y
        return x, y

    return unbend


def _from_the_wrong_side(u: Floats, v: Floats, fx: float, fy: float, cx: float, cy: float) -> Any:
    return u / fx, v / fy, 1 - cx / fx * u - cy / fy * v


def _from_the_wrong_side_scaled(u: Floats, v: Floats, *lens: float) -> Any:
    x, y, w = _from_the_wrong_side(u, v, *lens)
    return x / w, y / w, 1.0


def _only_the_centre_scaled(pixels: Floats, depth: Floats, K: Floats, *_: Any) -> Floats:
    fx, fy, cx, cy = _lens(K)
    u, v = pixels.T
    return np.stack([u - cx * depth / fx, v - cy * depth / fy, depth], axis=1)


def _along_the_ray(x: Floats, y: Floats, w: Any, depth: Floats) -> Any:
    return _scale(x, y, w, depth / np.sqrt(x**2 + y**2 + w**2))


DEPROJECT.add_mistakes(
    ("rays", "inverse_missing", lambda u, v, *lens: (*_to_pixels(u, v, 1.0, *lens), 1.0)),
    ("rays", "input_swapped", lambda u, v, *lens: _to_normalised(v, u, *lens)),
    ("rays", "inverse_transposed", _from_the_wrong_side, _from_the_wrong_side_scaled),
    ("lens", "principal_point_added", lambda fx, fy, cx, cy: (fx, fy, -cx, -cy)),
    ("lens", "brackets_missing", lambda fx, fy, cx, cy: (1.0, 1.0, cx / fx, cy / fy)),
    ("lens", "times_focal_length", lambda fx, fy, cx, cy: (1 / fx, 1 / fy, cx, cy)),
    *_CAMERA,
    ("", "brackets_missing", lambda _: _only_the_centre_scaled),
    ("", "depth_for_scale", lambda _: lambda uv, Z, K, *_: np.c_[uv, Z] @ np.linalg.inv(K).T),
    ("scale", "depth_along_ray", _along_the_ray),
    ("scale", "not_scaled", lambda x, y, w, depth: (x, y, w * depth)),
    ("scale", "divided_by_depth", lambda x, y, w, depth: (x / depth, y / depth, w * depth)),
    ("unbend", "distorted_again", lambda x, y, bend, *dist: bend(x, y)),
    ("unbend", "one_step", _iterate(1), _divide(1)),
)

# With more rounds than these, all cases agree. Of each long family a few are tried in pairs, too.
for _name, _family, _every, _in_pairs in (
    ("too_few_rounds", _iterate, range(2, 14), (2, 3, 5, 10)),
    ("too_few_rounds", _divide, range(2, 8), (5,)),
    ("target_overwritten", _overwritten, (*range(2, 51), 100), (5, 10, 20, 50)),
):
    for _rounds in _every:
        _alone = _rounds not in _in_pairs
        DEPROJECT.add_mistakes(("unbend", _name, _family(_rounds)), alone=_alone)
