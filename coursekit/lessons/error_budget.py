"""Notebook 05: its exercise and the mistakes that people make in it."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from coursekit.arrays import Floats
from coursekit.lessons.exercises import Exercise, Model, Step

# --- sensitivities ---


def _build(steps: Mapping[str, Step]) -> Model:
    def sensitivities(u: float, Z: float, fx: float, cx: float, depth_error: float) -> Floats:
        dX_du, dX_dZ = steps["pixel"](u, Z, fx, cx), steps["depth"](u, Z, fx, cx)
        return steps["order"](dX_du, dX_dZ, steps["leak"](dX_du, dX_dZ, depth_error, Z))

    return sensitivities


SENSITIVITIES = Exercise(
    name="error_budget.sensitivities",
    build=_build,
    steps={
        "pixel": lambda u, Z, fx, cx: Z / fx,
        "depth": lambda u, Z, fx, cx: (u - cx) / fx,
        "leak": lambda dX_du, dX_dZ, depth_error, Z: dX_dZ * depth_error,
        "order": lambda dX_du, dX_dZ, leak: np.array([dX_du, dX_dZ, leak]),
    },
    cases=[
        (524.0, 0.5, 500.0, 424.0, 0.004),
        (847.0, 0.45, 447.0, 424.0, 0.005),
        (20.0, 0.30, 612.0, 322.0, 0.003),
        (700.0, 3.70, 390.4, 331.4, -0.006),
    ],
    per_row=0,
    unit="m/px, 1 and m",
    tolerance=1e-10,
    describe=lambda args: (
        "u = {:g} px, Z = {:g} m, fx = {:g} px, cx = {:g} px, depth error {:g} m".format(*args)
    ),
    show=lambda row: "(" + ", ".join(f"{v:.6g}" for v in np.ravel(row)) + ")",
)


SENSITIVITIES.add_mistakes(
    ("pixel", "distance_forgotten", lambda u, Z, fx, cx: 1 / fx),
    ("pixel", "not_differentiated", lambda u, Z, fx, cx: (u - cx) * Z / fx),
    ("pixel", "upside_down", lambda u, Z, fx, cx: fx / Z),
    ("depth", "centre_forgotten", lambda u, Z, fx, cx: u / fx),
    ("depth", "other_way", lambda u, Z, fx, cx: (cx - u) / fx),
    ("depth", "not_differentiated", lambda u, Z, fx, cx: (u - cx) * Z / fx),
    ("depth", "angle", lambda u, Z, fx, cx: math.atan2(u - cx, fx)),
    ("depth", "sine", lambda u, Z, fx, cx: (u - cx) / math.hypot(u - cx, fx)),
    ("leak", "wrong_price", lambda dX_du, dX_dZ, depth_error, Z: dX_du * depth_error),
    ("leak", "sign_lost", lambda dX_du, dX_dZ, depth_error, Z: abs(dX_dZ * depth_error)),
    ("leak", "millimetres", lambda dX_du, dX_dZ, depth_error, Z: 1000 * dX_dZ * depth_error),
    ("leak", "landing_place", lambda dX_du, dX_dZ, depth_error, Z: dX_dZ * (Z + depth_error)),
    ("order", "all_millimetres", lambda u, Z, leak: np.array([1000 * u, Z, 1000 * leak])),
    ("order", "exchanged", lambda dX_du, dX_dZ, leak: np.array([dX_dZ, dX_du, leak])),
)
