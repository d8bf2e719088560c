"""Notebook 05: its exercises and the mistakes that people make in them."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.lessons import questions
from coursekit.lessons.exercises import Exercise, Step, Steps

# --- sensitivities ---


def _sensitivities(
    steps: Steps, u: float, Z: float, fx: float, cx: float, depth_error: float
) -> Floats:
    dX_du, dX_dZ = steps["pixel"](u, Z, fx, cx), steps["depth"](u, Z, fx, cx)
    return steps["order"](dX_du, dX_dZ, steps["leak"](dX_du, dX_dZ, depth_error, Z))


def _prices(u: float, Z: float, fx: float, cx: float, depth_error: float) -> Any:
    off = u - cx
    dX_du = Z / fx
    dX_dZ = off / fx
    return dX_du, dX_dZ, off / fx * depth_error


SENSITIVITIES = Exercise.told(
    "error_budget.sensitivities",
    build=_sensitivities,
    steps={
        "pixel": lambda u, Z, fx, cx: Z / fx,
        "depth": lambda u, Z, fx, cx: (u - cx) / fx,
        "leak": lambda dX_du, dX_dZ, depth_error, Z: dX_dZ * depth_error,
        "order": lambda dX_du, dX_dZ, leak: np.array([dX_du, dX_dZ, leak]),
    },
    describe=lambda args: (
        "u = {:g} px, Z = {:g} m, fx = {:g} px, cx = {:g} px, depth error {:g} m".format(*args)
    ),
    styles=[_prices],
)


SENSITIVITIES.add_mistakes(
    ("leak", "whole_shift", lambda dX_du, dX_dZ, off, Z: off * math.hypot(1, dX_dZ)),
    ("pixel", "distance_forgotten", lambda u, Z, fx, cx: 1 / fx),
    ("pixel", "not_differentiated", lambda u, Z, fx, cx: (u - cx) * Z / fx),
    ("depth", "not_differentiated", lambda u, Z, fx, cx: (u - cx) * Z / fx),
    ("depth", "other_way", lambda u, Z, fx, cx: (cx - u) / fx),
    ("depth", "centre_forgotten", lambda u, Z, fx, cx: u / fx),
    ("leak", "leak_is_the_error", lambda dX_du, dX_dZ, depth_error, Z: depth_error),
    ("", "at_the_wrong_depth", lambda f: lambda u, Z, fx, cx, off: f(u, Z + off, fx, cx, off)),
    ("pixel", "floored", lambda u, Z, fx, cx: Z // fx),
    ("depth", "floored", lambda u, Z, fx, cx: (u - cx) // fx),
    ("depth", "u_with_Z", lambda u, Z, fx, cx: (cx - u) / Z),
    ("leak", "wrong_price", lambda dX_du, dX_dZ, depth_error, Z: dX_du * depth_error),
    ("leak", "landing_place", lambda dX_du, dX_dZ, depth_error, Z: dX_dZ * (Z + depth_error)),
)


# --- add_up ---

Rows = list[tuple[float, float, Any, str]]


def _add_up(steps: Steps, rows: Rows, tolerance: float) -> Floats:
    noise, bias = steps["kinds"](rows)
    along = steps["along"]
    noises = [high * steps["noise part"](toward, along) for _, high, toward, _ in noise]
    most = [steps["most"](low, high, toward) * along(toward) for low, high, toward, _ in bias]
    squares, others = (
        [steps["square"](low, high) * steps["part"](toward, along) for low, high, toward, _ in of]
        for of in (bias, noise)
    )
    variance = steps["rigs"](squares, noises, others)
    summed = steps["summed"](most, noises)
    sums = steps["noise"](noises), steps["worst"](summed), steps["quadrature"](summed)
    sigma = steps["sigma"](variance, most)
    return steps["order"](*sums, steps["share"](tolerance / sigma if sigma else math.inf))


def _sorted(rows: Rows) -> tuple[Rows, Rows]:
    noise, bias = ([row for row in rows if row[3] == kind] for kind in ("noise", "bias"))
    return noise, bias


def _along(toward: Any) -> float:
    return 1.0 if toward is None else abs(toward[0])


def _third_along(toward: Any) -> float:
    return 3**-0.5 if toward is None else _along(toward)


def _part(toward: Any, along: Step, third: float = 1 / 3) -> float:
    return third if toward is None else float(along(toward)) ** 2


def _root(values: list[float]) -> float:
    return math.sqrt(sum(value * value for value in values))


def _beyond(z: float) -> float:
    """The share of a normal distribution beyond z standard deviations, to both sides."""
    return math.erfc(z / math.sqrt(2))


def _row(low: float, high: float, kind: str, *toward: float) -> tuple[float, float, Any, str]:
    return low, high, toward or None, kind


def _sums_by_rows(rows: Rows, tolerance: float) -> Any:
    noise, worst, quadrature, square = 0.0, 0.0, 0.0, 0.0
    for low, high, toward, kind in rows:
        along = 1.0 if toward is None else abs(toward[0])
        part = 1 / 3 if toward is None else toward[0] ** 2
        if kind == "noise":
            noise += (high * along) ** 2
        else:
            worst += high * along
            quadrature += (high * along) ** 2
            square += part * (low**2 + low * high + high**2) / 3
    sigma = np.sqrt(square)
    share = math.erfc(tolerance / (math.sqrt(2) * sigma))
    return np.sqrt(noise), worst, np.sqrt(quadrature), share


ADD_UP = Exercise.told(
    "error_budget.add_up",
    build=_add_up,
    steps={
        "kinds": _sorted,
        "along": _along,
        "most": lambda low, high, toward: high,
        "noise part": lambda toward, along: along(toward),
        "noise": _root,
        "worst": sum,
        "quadrature": _root,
        "square": lambda low, high: (low * low + low * high + high * high) / 3,
        "part": _part,
        "rigs": lambda squares, noises, others: sum(squares),
        "summed": lambda most, noises: most,
        "sigma": lambda variance, most: math.sqrt(variance),
        "share": _beyond,
        "order": lambda *sums: np.array(sums),
    },
    cases=[
        ([_row(*row) for row in rows], tolerance)
        for rows, tolerance in questions.lesson_texts("error_budget")["given"]["rigs"]
    ],
    describe=lambda args: (
        "; ".join(_row_in_words(row) for row in args[0]) + f"; tolerance {args[1]:g} mm"
    ),
    styles=[_sums_by_rows],
)


def _row_in_words(row: tuple[float, float, Any, str]) -> str:
    low, high, toward, kind = row
    way = "any way" if toward is None else "along ({:.2f}, {:.2f}, {:.2f})".format(*toward)
    return f"{kind} {low:g} to {high:g} mm {way}"


ADD_UP.add_mistakes(
    ("kinds", "kinds_exchanged", lambda rows: _sorted(rows)[::-1]),
    ("kinds", "noise_in_the_bias", lambda rows: (_sorted(rows)[0], rows), lambda rows: ([], rows)),
    ("kinds", "kind_ignored", lambda rows: (rows, rows)),
    ("", "first_row_only", lambda sums: lambda rows, tolerance: sums(rows[:1], tolerance)),
    ("noise part", "noise_shared_out", lambda way, along: along(way) if way else 3**-0.5),
    ("summed", "noise_in_the_bias", lambda most, noises: most + noises),
    ("kinds", "bias_in_the_noise", lambda rows: (rows, _sorted(rows)[1])),
    ("along", "not_projected", lambda toward: 1.0),
    ("along", "direction_sign", lambda toward: 1.0 if toward is None else toward[0]),
    ("along", "other_axis", lambda toward: 1.0 if toward is None else abs(toward[1])),
    ("along", "any_way_nothing", lambda toward: 0.0 if toward is None else abs(toward[0])),
    ("most", "third_of_the_worst", lambda low, high, toward: high * _third_along(toward)),
    ("along", "third_of_the_worst", _third_along),
    ("most", "least_for_most", lambda low, high, toward: low),
    ("most", "middle_for_most", lambda low, high, toward: (low + high) / 2),
    ("noise", "noise_added", sum),
    ("noise", "squares_forgotten", lambda values: math.sqrt(sum(values))),
    ("noise", "noise_mean", lambda values: _root(values) / max(len(values), 1) ** 0.5),
    ("noise", "noise_mean", lambda values: sum(values) / max(len(values), 1)),
    ("worst", "worst_in_quadrature", _root),
    ("quadrature", "quadrature_added", sum),
    ("square", "product_doubled", lambda low, high: (low + high) ** 2 / 3),
    ("quadrature", "quadrature_mean", lambda values: _root(values) / max(len(values), 1) ** 0.5),
    ("worst", "worst_row_only", lambda values: max(values, default=0.0)),
    ("square", "mean_squared", lambda low, high: ((low + high) / 2) ** 2),
    ("square", "largest_squared", lambda low, high: high * high),
    ("square", "ends_squared", lambda low, high: (low * low + high * high) / 2),
    ("square", "spread_squared", lambda low, high: (high - low) ** 2 / 12),
    ("part", "third_forgotten", lambda toward, along: _part(toward, along, 1.0)),
    ("part", "third_rooted", lambda toward, along: _part(toward, along, 3 ** (-0.5))),
    ("part", "half_for_third", lambda toward, along: _part(toward, along, 0.5)),
    ("part", "third_for_all", lambda toward, along: 1 / 3),
    ("part", "not_squared", lambda toward, along: 1 / 3 if toward is None else along(toward)),
    ("rigs", "noise_in_the_share", lambda squares, noise, _: sum(squares) + _root(noise) ** 2),
    ("rigs", "noise_in_the_share", lambda squares, noise, others: sum(squares) + sum(others)),
    ("sigma", "variance_for_sigma", lambda variance, most: variance),
    ("sigma", "quadrature_for_sigma", lambda variance, most: _root(most)),
    ("sigma", "quadrature_over_root_3", lambda variance, most: _root(most) / 3**0.5),
    ("sigma", "worst_for_sigma", lambda variance, most: sum(most)),
    ("share", "one_sided", lambda z: _beyond(z) / 2),
    ("share", "within_for_beyond", lambda z: 1 - _beyond(z)),
    ("share", "root_two_lost", math.erfc),
    ("order", "sums_exchanged", lambda n, w, q, share: np.array([n, q, w, share])),
)
