"""How far a fitted camera may be wrong about where a point is seen, in px over the image.

After mrcal (D. Kogan, "uncertainty of projection", the "mean-pcam" method): the covariance of
intrinsics *and* poses, propagated to a pixel. With `fixed="world"` the point is fixed to the
boards. Another set of corners would give another K and, with it, other poses; what of the change
is a mere motion of the camera's frame costs nothing and is compensated. Each board says where the
point is in the refitted camera's frame, p + omega_i x p + v_i, and the mean over the boards is
projected with the refitted intrinsics. With `fixed="camera"` the point stays where it is in the
camera's frame and only the intrinsics change: what a depth camera's user gets who trusts that
frame, and the larger of the two.

What both leave out: errors of the model (a bowed board, a distortion that the coefficients cannot
follow, rolling shutter), corner errors that are correlated or larger in some views, and everything
of second order. It is the least that the uncertainty can be.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from coursekit.geometry import deproject
from coursekit.intrinsics.derivatives import (
    NormalEquations,
    project_with_derivatives,
    scaled_inverse,
    twist_columns,
)

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from coursekit.geometry import Intrinsics
    from coursekit.intrinsics.fit import IntrinsicsResult

    Floats = NDArray[np.float64]
    Fixed = Literal["world", "camera"]


@dataclass(frozen=True, eq=False)
class Information:
    """What n views know of the shared parameters and of the mean motion of their boards.

    shared (g, g): the Schur complement of the shared parameters. response (6, g): the sum of the
    poses' responses, poses (6, 6): the sum of their own covariances, at corner noise 1 px. The
    mean motion is (noise - response d) / n. Sums, so that a view is added without a refit.
    """

    shared: Floats
    response: Floats
    poses: Floats
    views: int

    @classmethod
    def of(cls, equations: NormalEquations) -> Information:
        """The information in views."""
        return cls(
            equations.information,
            equations.responses.sum(axis=0),
            equations.pose_covariances.sum(axis=0),
            len(equations.poses),
        )

    def __add__(self, other: Information) -> Information:
        return Information(
            self.shared + other.shared,
            self.response + other.response,
            self.poses + other.poses,
            self.views + other.views,
        )

    def covariance(self) -> Floats:
        """Of the shared parameters and the mean motion (g + 6, g + 6), at corner noise 1 px."""
        spread = np.concatenate([np.eye(len(self.shared)), -self.response / self.views])
        joint = spread @ scaled_inverse(self.shared) @ spread.T
        joint[-6:, -6:] += self.poses / self.views**2
        return joint


def projection_covariance(
    result: IntrinsicsResult, pixels: ArrayLike, range_m: float, fixed: Fixed = "world"
) -> Floats:
    """The covariance of where a point is seen, (..., 2, 2), px^2; see the module for what it is.

    pixels (..., 2): where the fitted camera sees it. range_m: its distance from the camera, m;
    `math.inf` for a direction. NaN where the distortion has no inverse.
    Raises ValueError for a range that is not positive.
    """
    uv = np.asarray(pixels, float)
    columns = projection_columns(result.intrinsics, uv.reshape(-1, 2), range_m, result.selection)
    p, extra = len(result.names), len(result.extra)
    covariance = result.sigma_px**2 * Information.of(result.equations).covariance()
    keep = np.r_[:p, p + extra : p + extra + 6] if check_fixed(fixed) == "world" else np.r_[:p]
    columns = columns[..., : len(keep)]
    spread = columns @ covariance[np.ix_(keep, keep)] @ np.swapaxes(columns, -1, -2)
    return spread.reshape(*uv.shape, 2)


def projection_sigma_px(
    result: IntrinsicsResult, pixels: ArrayLike, range_m: float, fixed: Fixed = "world"
) -> Floats:
    """The standard deviation of where a point is seen, in its worst direction, (...), px.

    The square root of the larger eigenvalue of `projection_covariance`, as mrcal reports it.
    """
    return worst_direction(projection_covariance(result, pixels, range_m, fixed))


def uncertainty_map(
    result: IntrinsicsResult,
    range_m: float,
    shape: tuple[int, int] = (30, 40),
    fixed: Fixed = "world",
) -> Floats:
    """`projection_sigma_px` at `image_grid(shape)`, (rows, columns), px."""
    return projection_sigma_px(result, image_grid(result.intrinsics, shape), range_m, fixed)


def image_grid(intrinsics: Intrinsics, shape: tuple[int, int]) -> Floats:
    """Pixels (rows, columns, 2) spread evenly from the image's first pixel to its last."""
    rows, columns = shape
    if rows < 2 or columns < 2:
        raise ValueError(f"shape: got {shape}, want at least 2 rows and 2 columns")
    u = np.linspace(0.0, intrinsics.width - 1.0, columns)
    v = np.linspace(0.0, intrinsics.height - 1.0, rows)
    return np.stack(np.meshgrid(u, v), axis=-1)


def projection_columns(
    intrinsics: Intrinsics, pixels: Floats, range_m: float, selection: Floats
) -> Floats:
    """d pixel / d (parameters, motion of the point): (N, 2, p + 6) at pixels (N, 2).

    selection (9, p): which parameters. At an infinite range a translation moves nothing.
    """
    distance = check_range(range_m)
    rays = deproject(pixels, np.ones(len(pixels)), intrinsics.K, intrinsics.dist)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = rays * (distance if math.isfinite(distance) else 1.0)
    _, by_parameter, by_point = project_with_derivatives(points, intrinsics)
    motion = twist_columns(points, by_point)
    if math.isinf(distance):
        motion[..., 3:] = 0.0
    return np.concatenate([by_parameter @ selection, motion], axis=-1)


def worst_direction(covariance: Floats) -> Floats:
    """The standard deviation along the longer axis of covariances (..., 2, 2)."""
    a, b, d = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.sqrt((a + d) / 2 + np.hypot((a - d) / 2, b))


def check_fixed(fixed: str) -> str:
    """`fixed`, or a ValueError."""
    if fixed not in ("world", "camera"):
        raise ValueError(f'fixed: got {fixed!r}, want "world" or "camera"')
    return fixed


def check_range(range_m: float) -> float:
    """The range as a float, or a ValueError unless it is positive (infinity is allowed)."""
    if not isinstance(range_m, (int, float, np.number)) or not range_m > 0:
        raise ValueError(f"range_m: got {range_m!r}, want a positive number of metres")
    return float(range_m)
