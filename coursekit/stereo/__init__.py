"""Depth from disparity, how noisy and how wrong it is, and how well that can be known.

A rectified pair with focal length f (px) and baseline B (m) sees a point at depth Z with disparity
d = f B / Z (px). Two kinds of error follow from Z = f B / d:

Noise. dZ/dd = -f B / d^2 = -Z^2 / (f B), so a standard deviation sigma_d of disparity becomes
sigma_Z = Z^2 sigma_d / (f B). In this course sigma_d is the *temporal* standard deviation of *one*
pixel's disparity. The spatial one, over the pixels of a single frame about a plane, is larger by
the pattern that repeats in every frame; the one of a window's mean is smaller by far, because many
pixels average.

Bias. The device computes with the baseline B it reports. Let the true one be (1 + b) B, and let
disparities come out o px too large. Then d = (1 + b) f B / Z + o, and

    Z_m = f B / d = Z / (1 + b + o Z / (f B)),
    Z_m - Z = s Z - o Z^2 / (f B) + ...,    s = 1 / (1 + b) - 1:

a scale error grows with Z, a disparity offset with Z^2. A width is read as n Z_m / f from n px, so
its relative error is that of the depth, W_m / W - 1 = s - o Z / (f B): regressed on Z, the
intercept is the scale and the slope the disparity offset, and no tape measure is needed, only a
caliper. But block matching pushes the edges of a near object outwards by some p px each, up to
half the matching window, which adds 2 p Z / (f W): a slope too. `fit_bias` keeps it as its own
term; only the depths tell it from an offset.

Depth stacks: (N, H, W), unsigned integer counts of `depth_scale_m` metres or floats in metres; 0,
negative, NaN and infinite are invalid. One (H, W) image counts as a stack of one. Where the
intrinsics and the depth unit come with the frames, a camera's frames can be given instead.
A window is (left, top, width, height) in px. Intervals are 95 %.
"""

from __future__ import annotations

from coursekit.stereo.face import BlockFace, block_face
from coursekit.stereo.fits import BiasFit, BiasPriors, NoiseFit, fit_bias, fit_noise
from coursekit.stereo.law import (
    depth_from_disparity,
    depth_noise,
    depth_slope,
    robust_depth,
    rounded_variance,
    unrounded_std,
)
from coursekit.stereo.windows import (
    AveragingCurve,
    WindowStats,
    averaging_curve,
    off_plane,
    valid_mean,
    window_stats,
    without_mismatches,
)
