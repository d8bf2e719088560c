"""Derivatives of the projection, and least squares over a camera and the poses of its boards.

A board's pose is perturbed from the left, in the camera's frame: T <- exp(xi) T with
xi = (omega, v), a rotation (rad) about the camera's axes and a translation (m). A point moves by
omega x p + v, whichever board it is on; so an uncertain pose and a moving camera have the same
columns, and the pose that several boards have in common is the mean of their xi.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from coursekit.arrays import ArrayLike, Floats
from coursekit.geometry import Intrinsics, distort, distortion_jacobian

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
Projector = Callable[[Floats, Intrinsics], tuple[Floats, Floats, Floats]]
RADIAL = [4, 5, 8]  # of them; a fisheye has these and no others
FISHEYE_POWERS = np.array([1, 3, 5, 7])  # of the angle from the axis, of 1 and those


# --- a camera as a vector ---


def parameter_vector(intrinsics: Intrinsics) -> Floats:
    """(fx, fy, cx, cy, k1, k2, p1, p2, k3) of a camera, (9,), in the order of `PARAMETERS`."""
    i = intrinsics
    return np.array([i.fx, i.fy, i.cx, i.cy, *i.coeffs])


def with_parameters(intrinsics: Intrinsics, parameters: Floats) -> Intrinsics:
    """The camera with other `PARAMETERS` (9,)."""
    fx, fy, cx, cy, *coeffs = parameters.tolist()
    model = "brown_conrady" if any(coeffs) else intrinsics.model
    return replace(intrinsics, fx=fx, fy=fy, cx=cx, cy=cy, model=model, coeffs=tuple(coeffs))


def selection(names: Sequence[str]) -> Floats:
    """d `PARAMETERS` / d the parameters of these names, (9, p); "f" stands for fx = fy.

    >>> print(selection(["f", "cx"])[:4].T)
    [[1. 1. 0. 0.]
     [0. 0. 1. 0.]]
    """
    both = [("fx", "fy") if name == "f" else (name,) for name in names]
    return np.array([[float(full in ones) for ones in both] for full in PARAMETERS])


# --- derivatives ---


def project_with_derivatives(
    points: Floats, intrinsics: Intrinsics
) -> tuple[Floats, Floats, Floats]:
    """Pixels of points in the camera's frame and their derivatives.

    points (N, 3): m, Z > 0. Returns pixels (N, 2), d pixels / d `PARAMETERS` (N, 2, 9) and
    d pixels / d point (N, 2, 3), px/m. Source: the derivatives of OpenCV's `projectPoints`.
    """
    z = points[:, 2]
    xy = points[:, :2] / z[:, None]
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    coeffs = np.zeros(5) if intrinsics.dist is None else intrinsics.dist
    distorted = distort(xy, coeffs)
    focal = np.array([intrinsics.fx, intrinsics.fy])
    pixels = distorted * focal + [intrinsics.cx, intrinsics.cy]

    by_parameter = np.zeros((len(points), 2, 9))
    by_parameter[:, [0, 1], [0, 1]] = distorted
    by_parameter[:, [0, 1], [2, 3]] = 1.0
    for column, power in ((4, r2), (5, r2 * r2), (8, r2**3)):
        by_parameter[:, :, column] = xy * power[:, None]
    by_parameter[:, 0, 6] = by_parameter[:, 1, 7] = 2.0 * x * y
    by_parameter[:, 0, 7] = r2 + 2.0 * x * x
    by_parameter[:, 1, 6] = r2 + 2.0 * y * y
    by_parameter[:, :, 4:] *= focal[:, None]

    xx, cross, yy = distortion_jacobian(xy, coeffs)
    by_xy = np.stack([xx, cross, cross, yy], axis=-1).reshape(-1, 2, 2) * focal[:, None]
    by_point = np.empty((len(points), 2, 3))
    by_point[..., :2] = by_xy / z[:, None, None]
    by_point[..., 2] = -np.einsum("nij,nj->ni", by_point[..., :2], xy)
    return pixels, by_parameter, by_point


def fisheye_with_derivatives(
    points: Floats, intrinsics: Intrinsics
) -> tuple[Floats, Floats, Floats]:
    """As `project_with_derivatives`, through a fisheye: the image grows with the angle.

    k1, k2 and k3 are those of the 3rd, 5th and 7th power of the angle from the axis; p1 and p2 do
    nothing. Source: the model of OpenCV's `cv2.fisheye`, with one power less.
    """
    focal = np.array([intrinsics.fx, intrinsics.fy])
    out = np.maximum(np.linalg.norm(points[:, :2], axis=1), 1e-12)
    angle, along = np.arctan2(out, points[:, 2]), points[:, :2] / out[:, None]
    powers = angle[:, None] ** FISHEYE_POWERS
    series = np.concatenate([[1.0], parameter_vector(intrinsics)[RADIAL]])
    radius, slope = powers @ series, powers / angle[:, None] * FISHEYE_POWERS @ series
    distorted = along * radius[:, None]
    by_parameter = np.zeros((len(points), 2, 9))
    by_parameter[:, [0, 1], [0, 1]] = distorted
    by_parameter[:, [0, 1], [2, 3]] = 1.0
    by_parameter[:, :, RADIAL] = along[..., None] * powers[:, None, 1:] * focal[:, None]
    squares = (points**2).sum(axis=1)
    by_angle = np.column_stack([along * points[:, 2:], -out]) / squares[:, None]
    by_point = along[..., None] * (slope[:, None] * by_angle)[:, None]
    across = np.eye(2) - along[:, :, None] * along[:, None, :]
    by_point[..., :2] += (radius / out)[:, None, None] * across
    pixels = distorted * focal + [intrinsics.cx, intrinsics.cy]
    return pixels, by_parameter, by_point * focal[:, None]


def twist_columns(points: Floats, by_point: Floats) -> Floats:
    """d pixels / d (omega, v), (N, 2, 6), of points (N, 3) that move by omega x p + v."""
    # d (omega x p) / d omega = -[p]x, and -(row . [p]x) = (p x row)
    rotation = np.cross(points[:, None, :], by_point)
    return np.concatenate([rotation, by_point], axis=-1)


# --- least squares ---


@dataclass(frozen=True, eq=False)
class Scatter:
    """How much the shared parameters scatter, as the views bear it out.

    covariance (g, g), of the parameters. variance: of one coordinate of a corner, as it would have
    to be for independent corners to give as much. dof: degrees of freedom of either.
    """

    covariance: Floats
    variance: float
    dof: float


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """J'J of parameters that all views share and six of a pose a view, poses eliminated.

    shared (2N, g): rows u, v of each corner, view after view. poses: one (2 N_i, 6) a view.
    residuals (2N,): observed - predicted, px. Rows beyond those of the views say what is known of
    the shared parameters besides. Covariances are for residuals of variance 1 unless it is given.
    """

    shared: Floats
    poses: Sequence[Floats]
    residuals: Floats

    @cached_property
    def slices(self) -> list[slice]:
        """The rows of each view."""
        ends = np.cumsum([len(block) for block in self.poses])
        return [slice(e - len(b), e) for e, b in zip(ends, self.poses, strict=True)]

    @property
    def dof(self) -> int:
        """Degrees of freedom of the residuals, all poses counted as fitted."""
        return len(self.residuals) - self.shared.shape[1] - 6 * len(self.poses)

    @cached_property
    def pose_covariances(self) -> Floats:
        """(B_i' B_i)^-1 of each view, (n, 6, 6): of its pose where the shared are known."""
        return np.stack([scaled_inverse(block.T @ block) for block in self.poses])

    @cached_property
    def responses(self) -> Floats:
        """Y (n, 6, g): pose i moves by -Y_i d when the shared parameters move by d."""
        return self.pose_covariances @ self._by_pose(self.shared)

    @cached_property
    def information(self) -> Floats:
        """The Schur complement (g, g): what is known of the shared parameters, poses unknown."""
        known = np.einsum("nig,nih->gh", self._by_pose(self.shared), self.responses)
        total = self.shared.T @ self.shared - known
        return (total + total.T) / 2

    @cached_property
    def shared_covariance(self) -> Floats:
        """The inverse of `information`, (g, g)."""
        return scaled_inverse(self.information)

    def step(self) -> tuple[Floats, Floats]:
        """The Gauss-Newton step: (g,) of the shared parameters and (n, 6) of the poses."""
        by_pose = self._by_pose(self.residuals)
        reduced = self.shared.T @ self.residuals - np.einsum("nig,ni->g", self.responses, by_pose)
        shared = self.shared_covariance @ reduced
        own = np.einsum("nij,nj->ni", self.pose_covariances, by_pose)
        return shared, own - self.responses @ shared

    def decrease(self) -> float:
        """What the Gauss-Newton step takes off the sum of squares where the model is linear."""
        shared, twists = self.step()
        change = self.shared @ shared
        for block, rows, twist in zip(self.poses, self.slices, twists, strict=True):
            change[rows] += block @ twist
        return float(change @ change)

    @cached_property
    def parts(self) -> tuple[Floats, Floats]:
        """What each view says of the shared parameters, its pose unknown.

        Its part (n, g, g) of `information`, and the gradient (n, g) that its residuals leave.
        """
        information, gradients = [], []
        for block, rows, responses in zip(self.poses, self.slices, self.responses, strict=True):
            left = self.shared[rows] - block @ responses
            information.append(left.T @ left)
            gradients.append(left.T @ self.residuals[rows])
        return np.stack(information), np.stack(gradients)

    def scatter(self, p: int, first: ArrayLike | None = None) -> Scatter:
        """How the first p shared parameters scatter from view to view; all g get a covariance.

        first (n,): for each view the first one that is the same again; together these count as one.
        The views' gradients say it, whatever the residuals of one view have in common: half of
        each variance is the parameter's own, by a jackknife in which each view in turn keeps an
        n-th of its weight; half is the `shared_covariance` times what all p agree on. That is right
        for independent corners and for views that differ, however few they are. Source: Bell and
        McCaffrey, "Bias reduction in standard errors for linear regression with multi-stage
        samples" (2002).
        """
        V, (information, gradients) = self.shared_covariance, self.parts
        if first is not None:
            together = np.unique(first)[:, None] == np.asarray(first)
            information, gradients = np.tensordot(together, information, 1), together @ gradients
        moves = gradients @ V  # what each view adds to the parameters, (n, g)
        least = np.eye(len(V)) - (1.0 - 1.0 / len(moves)) * information @ V
        without = np.linalg.solve(least, gradients[..., None])[..., 0] @ V
        free = information - information @ V @ information
        expected = np.einsum("ag,ngh,hb->nab", V[:p], free, V[:, :p])  # of moves, at noise 1
        by_view = np.einsum("ag,ngh,ha->na", V, free, V)
        inverse = scaled_inverse(V[:p, :p])
        squares = np.einsum("na,ab,nb->", moves[:, :p], inverse, moves[:, :p])
        agreed = float(np.einsum("nab,ab->", expected, inverse))
        if not 0 < agreed < p:  # rounding, where the views do not determine the parameters
            squares, agreed = self.residuals @ self.residuals, float(max(self.dof, 1))
        variance = float(squares) / agreed
        covariance = (without.T @ without + variance * V) / 2.0
        own = by_view[:, :p].sum(axis=0) ** 2 / (by_view[:, :p] ** 2).sum(axis=0)
        return Scatter(covariance, variance, float(4.0 * np.mean(own) / (1.0 + 3.0 / p)))

    def _by_pose(self, values: Floats) -> Floats:
        """B_i' values_i of each view, (n, 6, ...)."""
        views = zip(self.poses, self.slices, strict=True)
        return np.stack([block.T @ values[rows] for block, rows in views])

    def mean_motion_covariance(self, shared: Floats, variance: float) -> Floats:
        """The covariance (g + 6, g + 6) of the shared parameters and of the poses' mean twist.

        shared (g, g): that of the shared. variance: of one coordinate of a corner.
        """
        spread = np.concatenate([np.eye(self.shared.shape[1]), -self.responses.mean(axis=0)])
        joint = spread @ shared @ spread.T
        joint[-6:, -6:] += variance * self.pose_covariances.sum(axis=0) / len(self.poses) ** 2
        return joint


def scaled_inverse(matrix: Floats) -> Floats:
    """The inverse (..., p, p) of symmetric positive matrices whose rows have very different units.

    A direction that the data do not determine at all (to double precision) gets a variance that
    is huge, not an exception: that it is undetermined is what the reader must learn.
    """
    scale, values, vectors = _scaled_parts(matrix)
    least = values.shape[-1] * np.finfo(float).eps * np.maximum(values[..., -1:], 1.0)
    inverse = (vectors / np.maximum(values, least)[..., None, :]) @ np.swapaxes(vectors, -1, -2)
    return inverse / (scale[..., :, None] * scale[..., None, :])


def scaled_root(covariance: Floats) -> Floats:
    """A root (p, m) of a covariance (p, p) with very different units: root root^T is it again.

    m < p where some numbers, or combinations of them, are exact.
    """
    scale, values, vectors = _scaled_parts(covariance)
    kept = values > 1e-12
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def _scaled_parts(matrix: Floats) -> tuple[Floats, Floats, Floats]:
    """Scale (..., p) that makes diagonals 1, and eigenvalues and vectors of what is left."""
    scale = np.sqrt(np.maximum(np.einsum("...ii->...i", matrix), 0.0))
    scale = np.where(scale > 0, scale, 1.0)
    values, vectors = np.linalg.eigh(matrix / (scale[..., :, None] * scale[..., None, :]))
    return scale, values, vectors
