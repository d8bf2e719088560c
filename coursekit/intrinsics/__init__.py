"""Intrinsic calibration: fit K and distortion, know how well they are known, and judge the fit.

A small reprojection error proves nothing: the poses absorb what is wrong with K. What counts is
how far the fitted camera may be wrong about where a point is seen (`projection_sigma_px`,
`uncertainty_map`), whether the corners cover the image and the boards are tilted (`coverage`,
`tilts`), and whether two independent halves of the views agree (`halves`).

Intervals are 95 %. Pixels, metres and radians; a pose is T_camera_board, (4, 4).
"""

from coursekit.intrinsics.bow import Bow, fit_bow
from coursekit.intrinsics.diagnose import diagnose
from coursekit.intrinsics.differences import (
    Comparison,
    HalvesDifference,
    HeldOut,
    compare,
    halves,
    held_out,
)
from coursekit.intrinsics.fit import MODELS, CalibrationFailed, IntrinsicsResult, calibrate
from coursekit.intrinsics.judge import Coverage, Tilts, coverage, tilts
from coursekit.intrinsics.next_view import NextView, candidate_views, next_view
from coursekit.intrinsics.power import stored_power
from coursekit.intrinsics.uncertainty import image_grid

__all__ = [
    "MODELS",
    "Bow",
    "CalibrationFailed",
    "Comparison",
    "Coverage",
    "HalvesDifference",
    "HeldOut",
    "IntrinsicsResult",
    "NextView",
    "Tilts",
    "calibrate",
    "candidate_views",
    "compare",
    "coverage",
    "diagnose",
    "fit_bow",
    "halves",
    "held_out",
    "image_grid",
    "next_view",
    "stored_power",
    "tilts",
]
