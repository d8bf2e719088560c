"""Intrinsic calibration: fit K and distortion, know how well they are known, and judge the fit.

A small reprojection error proves nothing: the poses absorb what is wrong with K. What counts is
how far the fitted camera may be wrong about where a point is seen (`projection_covariance` and
`uncertainty_map` of what `calibrate` returns), whether the corners cover the image and the boards
are tilted (`coverage`, `tilts`), and whether two independent halves of the views agree (`halves`).

Intervals are 95 %. Pixels, metres and radians; a pose is T_camera_board, (4, 4).
"""

from __future__ import annotations

from coursekit.intrinsics.causes import Bow, fit_bow, fit_shape
from coursekit.intrinsics.comparison import Comparison, HalvesDifference, compare, halves
from coursekit.intrinsics.diagnosis import diagnose, stored_power
from coursekit.intrinsics.fit import (
    MODELS,
    CalibrationFailed,
    IntrinsicsResult,
    calibrate,
    coverage,
    rms_under,
    tilts,
)
