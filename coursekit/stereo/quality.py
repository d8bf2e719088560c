"""The vendor's depth-quality metrics."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from coursekit.geometry import Intrinsics, deproject, pixel_grid
from coursekit.stereo.stacks import (
    counted,
    cut,
    depth_stack,
    fx_baseline,
    positive,
    rms,
    valid_mean,
    wrapped,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]
    Window = tuple[int, int, int, int]


@dataclass(frozen=True, repr=False)
class DepthQuality:
    """The metrics of RealSense's Depth Quality Tool in one window, each the mean over the frames.

    fill_rate: valid pixels of all in the window. z_accuracy: median signed distance from the true
    plane, as part of the true distance; None without one. plane_rms_m, plane_rms: RMS distance
    from the fitted plane, m and as part of the camera's distance to it. subpixel_rms_px: RMS of
    the disparity differences to it. temporal_noise_m, temporal_noise: median over the pixels of
    their std over time, m and as part of the distance; NaN from one frame.
    """

    fill_rate: float
    z_accuracy: float | None
    plane_rms_m: float
    plane_rms: float
    subpixel_rms_px: float
    temporal_noise_m: float
    temporal_noise: float
    n_frames: int

    def __repr__(self) -> str:
        accuracy = "" if self.z_accuracy is None else f"Z accuracy {self.z_accuracy:+.2%}, "
        return wrapped(
            f"fill rate {self.fill_rate:.1%}, {accuracy}plane RMS {1e3 * self.plane_rms_m:.2f} mm "
            f"({self.plane_rms:.2%}), sub-pixel RMS {self.subpixel_rms_px:.3f} px, temporal noise "
            f"{1e3 * self.temporal_noise_m:.2f} mm ({self.temporal_noise:.2%}), "
            f"{counted(self.n_frames, 'frame')}"
        )


def depth_quality(
    depth: Any,
    window: Window,
    intrinsics: Intrinsics,
    baseline_m: float | None,
    depth_scale_m: float | None = None,
    true_distance_m: float | None = None,
) -> DepthQuality:
    """The vendor's depth-quality metrics of a flat wall in a window.

    depth: stack or frames, see the module. true_distance_m: of the wall along the optical axis.
    Definitions: librealsense, tools/depth-quality (rs-depth-quality.cpp and depth-metrics.h,
    github.com/realsenseai/librealsense). Points of the window are deprojected and a plane z on
    (x, y) is fitted; the nearest and farthest 0.5 % are then dropped. Distances are perpendicular
    to the plane; disparities are fx baseline over a point's *range*, as the tool's code has it,
    against the foot of its perpendicular. Z accuracy is the median of the signed distances plus
    the plane's depth on the optical axis, less the true distance, over the true distance.
    Temporal noise (pull request 13786, 2025): median over the window of each pixel's std over the
    frames, of which the tool takes 40.
    NaN where fewer than three pixels are valid. Raises ValueError as `window_stats` does, and for
    a missing baseline.
    """
    if not isinstance(intrinsics, Intrinsics):
        raise ValueError(f"intrinsics: got {type(intrinsics).__name__}, want Intrinsics")
    product = fx_baseline(intrinsics.fx, baseline_m)
    stack, step = depth_stack(depth, depth_scale_m)
    z = cut(stack, window, step)
    left, top, width, height = window
    pixels = pixel_grid(width, height) + np.array([left, top])
    metrics = np.array(
        [_plane_metrics(frame, pixels, intrinsics, product, true_distance_m) for frame in z]
    )
    rms, relative, subpixel, accuracy, distance = valid_mean(metrics, axis=0)
    known = np.isfinite(z)
    enough = known.sum(axis=0) > 1
    deviation = (z - valid_mean(z, axis=0))[:, enough]
    std = np.sqrt(np.nansum(deviation**2, axis=0) / (known[:, enough].sum(axis=0) - 1))
    noise = float(np.median(std)) if std.size else math.nan
    return DepthQuality(
        fill_rate=float(known.mean()),
        z_accuracy=None if true_distance_m is None else float(accuracy),
        plane_rms_m=float(rms),
        plane_rms=float(relative),
        subpixel_rms_px=float(subpixel),
        temporal_noise_m=noise,
        temporal_noise=noise / float(distance),
        n_frames=len(z),
    )


def _plane_metrics(
    image: Floats,
    pixels: Floats,
    intrinsics: Intrinsics,
    product: float,
    true_distance_m: float | None,
) -> tuple[float, float, float, float, float]:
    """Plane RMS (m, relative), sub-pixel RMS (px), Z accuracy, distance of one window (h, w)."""
    points = deproject(pixels, image, intrinsics.K, intrinsics.dist)
    points = points[np.isfinite(points[..., 2])]
    if len(points) < 3:
        return (math.nan,) * 5
    centroid = points.mean(axis=0)
    slopes, *_ = np.linalg.lstsq(
        points[:, :2] - centroid[:2], points[:, 2] - centroid[2], rcond=None
    )
    normal = np.array([-slopes[0], -slopes[1], 1.0])
    on_axis = float(centroid @ normal)  # Z at x = y = 0
    normal /= np.linalg.norm(normal)
    cut = len(points) // 200
    points = points[np.argsort(points[:, 2], kind="stable")][cut : len(points) - cut]
    off = (points - centroid) @ normal
    foot = points - off[:, None] * normal
    disparity = product / np.linalg.norm(points, axis=1) - product / np.linalg.norm(foot, axis=1)
    distance = float(centroid @ normal)
    accuracy = math.nan
    if true_distance_m is not None:
        error = on_axis - true_distance_m + np.sort(off)[len(off) // 2]
        accuracy = float(error) / positive("true_distance_m", true_distance_m)
    size = rms([off])
    return size, size / distance, rms([disparity]), accuracy, distance
