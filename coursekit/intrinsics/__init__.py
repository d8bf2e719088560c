"""Intrinsic calibration: fit K and distortion, know how well they are known, and judge the fit.

A small reprojection error proves nothing: the poses absorb what is wrong with K. What counts is
how far the fitted camera may be wrong about where a point is seen (`projection_sigma_px`,
`uncertainty_map`), whether the corners cover the image and the boards are tilted (`coverage`,
`tilts`), and whether two independent halves of the views agree (`halves`).

Intervals are 95 %. Pixels, metres and radians; a pose is T_camera_board, (4, 4).
"""

from __future__ import annotations

from coursekit.intrinsics.causes import Bow, fit_bow
from coursekit.intrinsics.comparison import (
    Comparison,
    HalvesDifference,
    HeldOut,
    compare,
    halves,
    held_out,
)
from coursekit.intrinsics.diagnosis import diagnose, stored_power
from coursekit.intrinsics.fit import (
    MODELS,
    CalibrationFailed,
    Coverage,
    IntrinsicsResult,
    Tilts,
    calibrate,
    coverage,
    image_grid,
    tilts,
)

__all__ = [
    "MODELS",
    "Bow",
    "CalibrationFailed",
    "Comparison",
    "Coverage",
    "HalvesDifference",
    "HeldOut",
    "IntrinsicsResult",
    "Tilts",
    "calibrate",
    "compare",
    "coverage",
    "diagnose",
    "fit_bow",
    "halves",
    "held_out",
    "image_grid",
    "stored_power",
    "tilts",
]
