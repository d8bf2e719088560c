"""How different two cameras are: two halves of one session, or the fit and the factory's K.

Two calibrations of one camera place its frame differently, by a small rotation and translation
that every pose, and every hand-eye transform after it, absorbs. So the difference over the image
is taken after the motion that brings the two nearest to each other (after mrcal's
`show-projection-diff`), each pixel weighted by how well it is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from coursekit.arrays import ArrayLike, Floats
from coursekit.boards import Board, Detection
from coursekit.checks import instance, want
from coursekit.geometry import Intrinsics, deproject, moved, project
from coursekit.intrinsics import derivatives, fit
from coursekit.intrinsics.fit import MAP_SHAPE, IntrinsicsResult
from coursekit.words import p_text, say

_GAUSS_NEWTON_STEPS = 20


# --- two halves ---


@dataclass(frozen=True, eq=False, repr=False)
class HalvesDifference:
    """What two independent halves of the views say differently about the same camera.

    first, second: the fits to every other view. range_m: at which they are compared.
    difference_px (rows, columns, 2): second - first where each sees the same point, after the best
    motion of the camera's frame. expected_px (rows, columns): the standard deviation of that, in
    its worst direction, from the covariances of both. Both are NaN where a half has no ray.
    p_value: how often halves whose views scatter as these do have intrinsics at least this far
    apart (Wald test); noise_p_value: how often corners would that err each by itself, which is
    nearly never where the model lacks something, whatever it is.
    """

    first: IntrinsicsResult
    second: IntrinsicsResult
    range_m: float
    difference_px: Floats
    expected_px: Floats
    p_value: float
    noise_p_value: float

    @property
    def length_px(self) -> Floats:
        """The length of the difference, (rows, columns), px."""
        return np.linalg.norm(self.difference_px, axis=-1)

    def __repr__(self) -> str:
        length, wide = self.length_px, self.expected_px
        alone = "explains" if self.noise_p_value > 0.01 else "does not explain"
        px, sigma = map(fit.sizes_over, (length, wide))
        views = [len(half.residuals) for half in (self.first, self.second)]
        p = {"views": p_text(self.p_value), "noise": p_text(self.noise_p_value)}
        facts = {"views": views, "range_m": self.range_m, "px": px, "sigma": sigma, "p": p}
        lines = [say("intrinsics.halves", alone=alone, **facts)]
        return "\n".join([*lines, *fit.folded_text(float(np.isnan(length).mean()))])


def halves(
    detections: Sequence[Detection],
    board: Board,
    model: str = "brown_conrady",
    range_m: float | None = None,
    shape: tuple[int, int] = MAP_SHAPE,
    points: ArrayLike | None = None,
) -> HalvesDifference:
    """Calibrate the even and the odd views apart and compare.

    range_m: where to compare, m; None takes the boards' median distance. shape: (rows, columns)
    of the map. points (N, 3): where the board's corners really are, m, as in `calibrate`.
    Raises ValueError where a half is too small to fit, and as `calibrate`.

    >>> halves([], Board("checkerboard", (10, 7), 0.025))
    Traceback (most recent call last):
    ValueError: detections: got 0 views, halves need at least 6
    """
    if len(detections) < 6:
        raise ValueError(f"detections: got {len(detections)} views, halves need at least 6")
    parts = detections[::2], detections[1::2]
    first, second = both = [fit.calibrate(part, board, model, points=points) for part in parts]
    range_m = first.board_range_m if range_m is None else float(range_m)
    grid = fit.image_grid(first.intrinsics, shape).reshape(-1, 2)
    weights = 1.0 / np.hypot(*(r.uncertainty_map(range_m, shape).ravel() for r in both))
    weights[~np.isfinite(weights)] = 0.0  # where a half's distortion has no inverse
    difference = difference_px(first.intrinsics, second.intrinsics, grid, range_m, weights)
    difference[weights == 0] = np.nan
    columns = fit.projection_columns(first.intrinsics, grid, range_m, first.names)
    spread = _without_motion(columns, weights)
    total = first.covariance + second.covariance
    apart = np.array([second.value(name) - first.value(name) for name in first.names])
    known = len(apart)
    noise = [r.sigma_px**2 * r.equations.shared_covariance[:known, :known] for r in both]
    expected = fit.worst_direction(spread @ total @ np.swapaxes(spread, -1, -2)).reshape(shape)
    p_value = _wald(apart, total, min(first.dof, second.dof))
    noise_p_value = _wald(apart, noise[0] + noise[1], min(r.equations.dof for r in both))
    maps = difference.reshape(*shape, 2), expected
    return HalvesDifference(first, second, range_m, *maps, p_value, noise_p_value)


def difference_px(
    first: Intrinsics,
    second: Intrinsics,
    pixels: Floats,
    range_m: float,
    weights: Floats | None = None,
) -> Floats:
    """Where the second camera sees what the first sees at pixels (N, 2), less those: (N, 2), px.

    The second camera's frame is moved to where the weighted squares of the difference are least:
    a rotation, and, for points at a finite range_m (m), a translation. weights (N,): of each
    pixel's residual; None weighs all alike. Gauss-Newton. NaN where the first camera's distortion
    has no inverse.
    """
    points = fit.points_at(pixels, range_m, first)
    weights = np.ones(len(pixels)) if weights is None else weights
    known = np.isfinite(points).all(axis=1) & (weights > 0)
    weight, homogeneous = weights[known, None], np.insert(points[known], 3, 1.0, axis=1).T
    free = 6 if math.isfinite(range_m) else 3
    T = np.eye(4)
    for _ in range(_GAUSS_NEWTON_STEPS):
        at = points[known] @ T[:3, :3].T + T[:3, 3]
        seen, _, by_point = derivatives.project_with_derivatives(at, second)
        columns = weight[..., None] * derivatives.twist_columns(at, by_point)[..., :free]
        columns = columns.reshape(-1, free)
        residuals = (weight * (pixels[known] - seen)).ravel()
        twist = np.zeros(6)
        twist[:free] = derivatives.scaled_inverse(columns.T @ columns) @ (columns.T @ residuals)
        while ((ahead := moved(T[None], twist[None])[0])[2] @ homogeneous <= 0).any():
            twist /= 2  # no point goes behind the camera
        T = ahead
        if np.abs(columns @ twist[:free]).max() < 1e-9 * weight.max():
            break
    moved_points = points @ T[:3, :3].T + T[:3, 3]
    return project(moved_points, second.K, second.dist) - pixels


def _without_motion(columns: Floats, weights: Floats) -> Floats:
    """d difference / d parameters (N, 2, p) once the best motion has been taken out.

    columns (N, 2, p + 6): by the parameters and by the motion of the points. Pixels with a weight
    (N,) of 0 do not decide about the motion.
    """
    used = weights > 0
    moving = columns[used, :, -6:].any(axis=(0, 1))  # at infinity a translation moves nothing
    parameters, motion = columns[..., :-6], columns[..., -6:][..., moving]
    flat = (columns[used] * weights[used, None, None]).reshape(-1, columns.shape[-1])
    A, b = flat[:, -6:][:, moving], flat[:, :-6]
    return parameters - motion @ (derivatives.scaled_inverse(A.T @ A) @ (A.T @ b))


def _wald(difference: Floats, covariance: Floats, dof: float) -> float:
    """The p-value of a difference (p,) whose covariance (p, p) was estimated with `dof`.

    Hotelling's: of so few degrees of freedom, p - 1 go into the covariance's directions.
    """
    from scipy.stats import f

    p = len(difference)
    left = max(dof - p + 1, 1.0)
    squares = float(difference @ derivatives.scaled_inverse(covariance) @ difference)
    return float(f.sf(squares * left / (p * dof), p, left))


# --- the factory's K ---


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """A fitted camera beside what the device reports of itself.

    names (p): as in the result. differences, sigmas (p,): result - factory and the standard
    deviation of the result. p_value: how often corner noise alone makes them differ as much, were
    the factory's right (Wald test over `names`). difference_px (rows, columns): between the pixels
    at which the two see the same point, after the best motion of the camera's frame. shift_m
    (rows, columns): how far apart the two put the point at a pixel and the depth Z = range_m, with
    no such motion; expected_shift_m: the standard deviation of that from the result's covariance.
    size: (width, height) of the image that the maps cover, px.
    """

    names: tuple[str, ...]
    differences: Floats
    sigmas: Floats
    p_value: float
    range_m: float
    difference_px: Floats
    shift_m: Floats
    expected_shift_m: Floats
    size: tuple[int, int]

    def __repr__(self) -> str:
        lines = ["fitted - factory:"]
        for name, difference, sigma in zip(self.names, self.differences, self.sigmas, strict=True):
            off = f"{difference:+z9.2f}" if name[0] in "fc" else f"{difference:+z9.4f}"
            lines.append(f"{name:>4} {off}, {difference / sigma:+z6.1f} of its sigma")
        maps = (self.difference_px, 1e3 * self.shift_m, 1e3 * self.expected_shift_m)
        px, mm, sigma = map(fit.sizes_over, maps)
        facts = {"p": p_text(self.p_value), "range_m": self.range_m, "px": px, "mm": mm}
        lines.append(say("intrinsics.apart", sigma=sigma, **facts))
        lines += fit.folded_text(float(np.isnan(self.shift_m).mean()))
        return "\n".join(lines)


def compare(
    result: IntrinsicsResult,
    factory: Intrinsics,
    range_m: float = 0.45,
    shape: tuple[int, int] = MAP_SHAPE,
) -> Comparison:
    """A fitted camera against the factory's intrinsics, in sigmas, pixels and metres.

    factory: its coefficients in OpenCV's sense (`Intrinsics.dist`). range_m: Z, m.
    Raises ValueError where the two are for images of different sizes.

    >>> from coursekit.intrinsics.fit import evaluate
    >>> lens = Intrinsics(640, 480, 600, 600, 320, 240)
    >>> board = Board("checkerboard", (10, 7), 0.025)
    >>> pose = np.array([[1, 0, 0, -0.1], [0, 0.8, -0.6, 0], [0, 0.6, 0.8, 0.5], [0, 0, 0, 1]])
    >>> seen = project(board.points @ pose[:3, :3].T + pose[:3, 3], lens.K)
    >>> views = [Detection(np.arange(54), seen + [[0.1], [-0.1]] * 27, lens.size)]
    >>> fit = evaluate(lens, pose[None], views, board, board.points, ("fx", "fy"), "none")
    >>> print(compare(fit, Intrinsics(640, 480, 590, 600, 320, 240)).differences)
    [10.  0.]
    """
    ours, names = result.intrinsics, result.names
    size = instance("factory", factory, Intrinsics).size
    want(size == ours.size, "factory", size, f"the fit's size, {ours.size} px")
    grid = fit.image_grid(ours, shape).reshape(-1, 2)
    weights = 1.0 / result.uncertainty_map(range_m, shape).ravel()
    pixels = difference_px(ours, factory, grid, range_m, weights).reshape(*shape, 2)
    depth = np.full(len(grid), float(range_m))
    theirs = deproject(grid, depth, factory.K, factory.dist)
    shift = np.linalg.norm(deproject(grid, depth, ours.K, ours.dist) - theirs, axis=1)
    full = derivatives.parameter_vector(ours) - derivatives.parameter_vector(factory)
    # "f" against the mean of fx and fy
    difference = np.linalg.pinv(derivatives.selection(names)) @ full
    sigmas = np.sqrt(np.diag(result.covariance))
    p_value = _wald(difference, result.covariance, result.dof)
    expected = result.uncertainty_map(range_m, shape, "camera") * range_m / result.value("fx")
    maps = np.linalg.norm(pixels, axis=-1), shift.reshape(shape), expected
    return Comparison(names, difference, sigmas, p_value, float(range_m), *maps, ours.size)
