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
        by_u, by_Z = steps["pixel"](u, Z, fx, cx), steps["depth"](u, Z, fx, cx)
        return steps["order"](by_u, by_Z, steps["leak"](by_u, by_Z, depth_error, Z))

    return sensitivities


SENSITIVITIES = Exercise(
    name="error_budget.sensitivities",
    build=_build,
    steps={
        "pixel": lambda u, Z, fx, cx: Z / fx,
        "depth": lambda u, Z, fx, cx: (u - cx) / fx,
        "leak": lambda by_u, by_Z, depth_error, Z: by_Z * depth_error,
        "order": lambda by_u, by_Z, leak: np.array([by_u, by_Z, leak]),
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


SENSITIVITIES.add_mistakes(
    ("pixel", "distance_forgotten", lambda u, Z, fx, cx: 1 / fx),
    ("pixel", "upside_down", lambda u, Z, fx, cx: fx / Z),
    ("depth", "centre_forgotten", lambda u, Z, fx, cx: u / fx),
    ("depth", "other_way", lambda u, Z, fx, cx: (cx - u) / fx),
    ("depth", "not_differentiated", lambda u, Z, fx, cx: (u - cx) * Z / fx),
    ("depth", "angle", lambda u, Z, fx, cx: math.atan2(u - cx, fx)),
    ("depth", "sine", lambda u, Z, fx, cx: (u - cx) / math.hypot(u - cx, fx)),
    ("leak", "wrong_price", lambda by_u, by_Z, depth_error, Z: by_u * depth_error),
    ("leak", "sign_lost", lambda by_u, by_Z, depth_error, Z: abs(by_Z * depth_error)),
    ("leak", "millimetres", lambda by_u, by_Z, depth_error, Z: 1000 * by_Z * depth_error),
    ("leak", "landing_place", lambda by_u, by_Z, depth_error, Z: by_Z * (Z + depth_error)),
    ("order", "all_millimetres", lambda u, Z, leak: np.array([1000 * u, Z, 1000 * leak])),
    ("order", "exchanged", lambda by_u, by_Z, leak: np.array([by_Z, by_u, leak])),
)
