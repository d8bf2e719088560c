"""From the covariances of pixel, depth, K, mount and arm to one of the point in the base.

p = T_base_camera deproject(u, v, Z; K): the chain that the budget's rows take apart. `propagate`
is its first order, J S J^T with the Jacobians written out here; `monte_carlo` draws the errors and
sends each through the exact chain. They part where the chain bends within the errors: turns of
several degrees move a point inwards by the square of the angle, whatever their sign, and a depth
from a disparity that errs by a tenth or more is skewed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from coursekit.arrays import ArrayLike, Floats
from coursekit.budget.view import View, positive
from coursekit.checks import transform
from coursekit.geometry import cross_matrix, distortion_jacobian
from coursekit.hand_eye.poses import Mount

PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
CHUNK = 65_536  # samples at a time: what one step needs stays in the cache
NEWTON_STEPS = 6  # from the nominal point, whose neighbours are all that is asked for
NEWTON_TOLERANCE = 1e-7  # of the last step: the next, its square, is lost in rounding


@dataclass(frozen=True, eq=False)
class Chain:
    """What the point goes through on its way to the base.

    view: the camera at the moment of the picture. mount: "eye_to_hand" (X = T_base_camera) or
    "eye_in_hand" (X = T_gripper_camera). T_base_gripper (4, 4): the arm's pose then, needed for
    "eye_in_hand", of which T_base_camera = T_base_gripper X. With "eye_to_hand" the arm is not in
    the chain, but has to go to the point: its error there counts, that of its fingertip.
    """

    view: View
    mount: Mount = "eye_to_hand"
    T_base_gripper: Floats | None = None

    def __post_init__(self) -> None:
        if self.mount not in ("eye_in_hand", "eye_to_hand"):
            raise ValueError(f"mount: got {self.mount!r}, want 'eye_in_hand' or 'eye_to_hand'")
        if self.mount == "eye_in_hand":
            if self.T_base_gripper is None:
                raise ValueError("T_base_gripper: eye_in_hand wants the arm's pose at the picture")
            T = transform("T_base_gripper", self.T_base_gripper)
            object.__setattr__(self, "T_base_gripper", T)

    @property
    def R_base_frame(self) -> Floats:
        """From the axes that X is given in (base or gripper) to the base's, (3, 3)."""
        if self.mount == "eye_to_hand" or self.T_base_gripper is None:
            return np.eye(3)
        return self.T_base_gripper[:3, :3]

    @property
    def arm_lever(self) -> Floats:
        """From the gripper's origin to the point, base axes, (3,), m; 0 for a camera off the arm,
        where the fingertip is at the point."""
        if self.mount == "eye_to_hand" or self.T_base_gripper is None:
            return np.zeros(3)
        there = self.view.T_base_camera[:3, 3] + self.view.lever_base
        return np.asarray(there - self.T_base_gripper[:3, 3])


@dataclass(frozen=True, eq=False)
class Covariances:
    """What is known of the errors that enter the chain; a part left out is exact.

    pixel (2, 2): of (u, v), px². depth_sigma_m: standard deviation of Z. intrinsics (p, p): of
    `names`, a choice of fx, fy, cx, cy, k1, k2, p1, p2, k3. hand_eye (6, 6): of X's twist as
    `HandEyeResult.covariance` has it, its first six rows; arm (6, 6): of the gripper's twist in
    the base, as `arm.fk_covariance(...).covariance`; (omega, v), rad and m.
    Raises ValueError for a wrong shape, an unknown name, and what is no covariance.
    """

    pixel: ArrayLike | None = None
    depth_sigma_m: float = 0.0
    intrinsics: ArrayLike | None = None
    names: tuple[str, ...] = ("fx", "fy", "cx", "cy")
    hand_eye: ArrayLike | None = None
    arm: ArrayLike | None = None

    def __post_init__(self) -> None:
        unknown = [name for name in self.names if name not in PARAMETERS]
        if unknown or len(set(self.names)) != len(self.names):
            raise ValueError(f"names: got {self.names}, want different ones of {PARAMETERS}")
        if self.depth_sigma_m != 0 and not positive(self.depth_sigma_m):
            raise ValueError(f"depth_sigma_m: got {self.depth_sigma_m!r}, want 0 m or more")
        for name, size in (
            ("pixel", 2),
            ("intrinsics", len(self.names)),
            ("hand_eye", 6),
            ("arm", 6),
        ):
            object.__setattr__(self, name, _covariance(name, getattr(self, name), size))

    @cached_property
    def joint(self) -> Floats:
        """Of (u, v), Z, K, the twist of X and that of the arm together, (15 + p, 15 + p)."""
        from scipy.linalg import block_diag

        parts = (
            self.pixel,
            [[self.depth_sigma_m**2]],
            self.intrinsics,
            self.hand_eye,
            self.arm,
        )
        return np.asarray(block_diag(*parts), dtype=np.float64)


def pixel_jacobian(view: View) -> Floats:
    """d(X, Y, Z)/d(u, v) at fixed Z, camera frame, (3, 2), m/px: Z/fx and Z/fy without a lens."""
    f = np.diag([1 / view.intrinsics.fx, 1 / view.intrinsics.fy])
    return np.concatenate([view.distance_m * _undistortion(view) @ f, np.zeros((1, 2))])


def intrinsics_jacobian(view: View, names: tuple[str, ...] = PARAMETERS) -> Floats:
    """d(X, Y, Z)/d(K and distortion) at fixed (u, v) and Z, camera frame, (3, p), m a unit."""
    camera, (x, y) = view.intrinsics, view.ray[:2]
    u, v = view.pixel
    seen = [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy]
    r2 = x * x + y * y
    columns = {  # of the distorted coordinates less the distortion's own change
        "fx": (-seen[0] / camera.fx, 0.0),
        "fy": (0.0, -seen[1] / camera.fy),
        "cx": (-1 / camera.fx, 0.0),
        "cy": (0.0, -1 / camera.fy),
        "k1": (-x * r2, -y * r2),
        "k2": (-x * r2**2, -y * r2**2),
        "p1": (-2 * x * y, -(r2 + 2 * y * y)),
        "p2": (-(r2 + 2 * x * x), -2 * x * y),
        "k3": (-x * r2**3, -y * r2**3),
    }
    chosen = np.array([columns[name] for name in names]).reshape(-1, 2).T
    lateral = view.distance_m * _undistortion(view) @ chosen
    return np.concatenate([lateral, np.zeros((1, len(names)))])


def jacobian(chain: Chain, names: tuple[str, ...] = ("fx", "fy", "cx", "cy")) -> Floats:
    """d p_base / d(u, v, Z, K, twist of X, twist of the arm), (3, 15 + p)."""
    view, R = chain.view, chain.view.R_base_camera
    frame = chain.R_base_frame
    turned = -cross_matrix(view.lever_base) @ frame
    arm = np.concatenate([-cross_matrix(chain.arm_lever), np.eye(3)], axis=1)
    parts = (
        R @ pixel_jacobian(view),
        (R @ view.ray)[:, None],
        R @ intrinsics_jacobian(view, names),
        turned,
        frame,
        arm if chain.mount == "eye_in_hand" else -arm,
    )
    return np.concatenate(parts, axis=1)


def propagate(chain: Chain, covariances: Covariances) -> Floats:
    """The covariance of the point in the base less where the gripper goes, (3, 3), m²."""
    J = jacobian(chain, covariances.names)
    return np.asarray(J @ covariances.joint @ J.T)


def monte_carlo(
    chain: Chain,
    covariances: Covariances,
    n: int = 1_000_000,
    seed: int = 0,
    through_disparity: bool = False,
) -> Floats:
    """n draws of the point's error in the base through the exact chain, (n, 3), m.

    through_disparity: the disparity is drawn from a normal distribution, not the depth; for small
    errors they are the same. NaN where it then comes out zero or negative, no depth at all, and
    where a drawn lens folds before it reaches the pixel.
    Raises ValueError for n under 1.
    """
    if not isinstance(n, (int, np.integer)) or n < 1:
        raise ValueError(f"n: got {n!r}, want a whole number of samples")
    rng = np.random.default_rng(seed)
    root = _root(covariances.joint)
    draw = _Draw(chain, covariances, through_disparity)
    errors = np.empty((n, 3))
    for start in range(0, n, CHUNK):
        stop = min(start + CHUNK, n)
        used = rng.standard_normal((root.shape[1], stop - start))
        errors[start:stop] = draw(root @ used).T
    return errors


@dataclass(frozen=True, eq=False)
class FirstOrderCheck:
    """First order beside Monte Carlo.

    first_order, monte_carlo (3, 3): covariances in the base, m². mean_m (3,): where Monte Carlo's
    mean lies from the point without errors, which first order puts at 0. n: valid samples.
    """

    first_order: Floats
    monte_carlo: Floats
    mean_m: Floats
    n: int

    @property
    def ratio(self) -> Floats:
        """First order's variances over Monte Carlo's along the base's axes, (3,).

        1 along an axis where neither has any.
        """
        ours, drawn = np.diag(self.first_order), np.diag(self.monte_carlo)
        none = (ours == 0) & (drawn == 0)
        return np.where(none, 1.0, ours) / np.where(none, 1.0, drawn)

    @property
    def worst(self) -> float:
        """The largest relative difference of a variance, such as 0.02."""
        return float(np.abs(self.ratio - 1).max())

    def __repr__(self) -> str:
        ratio = ", ".join(f"{r:.3f}" for r in self.ratio)
        shift = ", ".join(f"{1e3 * m:+.2f}" for m in self.mean_m)
        return (
            f"variances of first order over Monte Carlo's ({self.n:,} samples): {ratio}; "
            f"mean off by {shift} mm"
        )


def check_first_order(
    chain: Chain,
    covariances: Covariances,
    n: int = 1_000_000,
    seed: int = 0,
    through_disparity: bool = False,
) -> FirstOrderCheck:
    """Compare `propagate` with `monte_carlo`; n samples tell variances to sqrt(2 / n)."""
    samples = monte_carlo(chain, covariances, n, seed, through_disparity)
    valid = samples[np.isfinite(samples).all(axis=1)]
    if len(valid) < 2:
        raise ValueError(f"n: got {n}, of which {len(valid)} gave a depth; want at least 2")
    covariance = np.cov(valid.T)
    return FirstOrderCheck(
        propagate(chain, covariances), covariance, valid.mean(axis=0), len(valid)
    )


def ellipsoid(covariance: ArrayLike, level: float = 0.95) -> tuple[Floats, Floats]:
    """The ellipsoid that holds a normal error with probability `level`.

    covariance (3, 3): m². Returns its half axes (3,), m, the longest first, and their directions
    (3, 3), columns. Raises ValueError for a level outside (0, 1).
    """
    from scipy.stats import chi2

    if not 0 < level < 1:
        raise ValueError(f"level: got {level!r}, want a probability between 0 and 1")
    values, vectors = np.linalg.eigh(_covariance("covariance", covariance, 3))
    half = np.sqrt(np.clip(values, 0, None) * chi2(3).ppf(level))
    return half[::-1], vectors[:, ::-1]


# --- the exact chain ---


@dataclass(frozen=True, eq=False)
class _Draw:
    """The exact chain for errors (15 + p, m) in the order of `jacobian`; returns (3, m)."""

    chain: Chain
    covariances: Covariances
    through_disparity: bool

    def __call__(self, error: Floats) -> Floats:
        p, chain = len(self.covariances.names), self.chain
        view, frame = chain.view, chain.R_base_frame
        seen = self._points(error[:2], error[2], error[3 : 3 + p])
        omega, v = error[3 + p : 6 + p], error[6 + p : 9 + p]
        R_frame_camera = frame.T @ view.R_base_camera
        in_frame = _turn(omega, R_frame_camera @ seen)
        in_frame += v
        moved = frame @ in_frame - view.lever_base[:, None]
        omega, v = error[9 + p : 12 + p], error[12 + p :]
        if chain.mount == "eye_to_hand":
            return moved - v  # the fingertip is at the point: turning it moves it not at all
        lever = chain.arm_lever[:, None]
        return _turn(omega, moved + lever) - lever + v

    def _points(self, pixel: Floats, depth: Floats, intrinsics: Floats) -> Floats:
        view = self.chain.view
        values = {name: getattr(view.intrinsics, name) for name in PARAMETERS[:4]}
        dist = view.intrinsics.dist
        lens = np.zeros(5) if dist is None else dist
        values |= dict(zip(PARAMETERS[4:], lens, strict=True))
        for name, off in zip(self.covariances.names, intrinsics, strict=True):
            values[name] = values[name] + off
        x = (view.pixel[0] + pixel[0] - values["cx"]) / values["fx"]
        y = (view.pixel[1] + pixel[1] - values["cy"]) / values["fy"]
        if dist is not None or set(self.covariances.names) & set(PARAMETERS[4:]):
            x, y = _ideal(x, y, view.ray, [values[name] for name in PARAMETERS[4:]])
        z = self._depth(depth)
        return np.stack([x * z, y * z, z])

    def _depth(self, error: Floats) -> Floats:
        Z = self.chain.view.distance_m
        if not self.through_disparity:
            return np.asarray(Z + error)
        disparity = 1 - error / Z  # over the true one: Z = f B / d
        return np.asarray(Z / np.where(disparity > 0, disparity, np.nan))


def _ideal(x: Floats, y: Floats, start: Floats, lens: list[Floats]) -> tuple[Floats, Floats]:
    """The ideal coordinates of distorted ones, each with its own lens, from a point close by.

    NaN where Newton's method has not arrived: close to a fold, or beyond it.
    """
    k1, k2, p1, p2, k3 = lens
    a, b = np.full_like(x, start[0]), np.full_like(y, start[1])
    for _ in range(NEWTON_STEPS):
        r2 = a * a + b * b
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        off_x = a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a) - x
        off_y = b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b - y
        slope = 2 * (k1 + r2 * (2 * k2 + r2 * 3 * k3))
        xx = radial + a * a * slope + 2 * p1 * b + 6 * p2 * a
        xy = a * b * slope + 2 * p1 * a + 2 * p2 * b
        yy = radial + b * b * slope + 6 * p1 * b + 2 * p2 * a
        determinant = xx * yy - xy * xy
        step_a = (yy * off_x - xy * off_y) / determinant
        step_b = (xx * off_y - xy * off_x) / determinant
        a, b = a - step_a, b - step_b
    found = (np.abs(step_a) + np.abs(step_b) < NEWTON_TOLERANCE) & (determinant > 0)
    return np.where(found, a, np.nan), np.where(found, b, np.nan)


def _turn(omega: Floats, points: Floats) -> Floats:
    """exp(omega) points by Rodrigues' formula; omega (3, m) in rad, points (3, m)."""
    wx, wy, wz = omega
    px, py, pz = points
    angle = np.sqrt(wx * wx + wy * wy + wz * wz)
    half = np.sinc(angle / (2 * math.pi))
    sine, versine = np.sinc(angle / math.pi), half * half / 2
    cosine, along = np.cos(angle), versine * (wx * px + wy * py + wz * pz)
    turned = np.empty_like(points)
    turned[0] = cosine * px + sine * (wy * pz - wz * py) + along * wx
    turned[1] = cosine * py + sine * (wz * px - wx * pz) + along * wy
    turned[2] = cosine * pz + sine * (wx * py - wy * px) + along * wz
    return turned


def _undistortion(view: View) -> Floats:
    """d(ideal)/d(distorted) normalised coordinates at the view's pixel, (2, 2)."""
    dist = view.intrinsics.dist
    if dist is None:
        return np.eye(2)
    xx, xy, yy = distortion_jacobian(view.ray[:2], dist)
    return np.array([[yy, -xy], [-xy, xx]]) / (xx * yy - xy * xy)


def _root(covariance: Floats) -> Floats:
    """A square root without the parts that are exact, (n, m): root root^T = covariance."""
    scale = np.sqrt(np.where(np.diag(covariance) > 0, np.diag(covariance), 1.0))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    kept = values > 1e-12
    return np.asarray(scale[:, None] * vectors[:, kept] * np.sqrt(values[kept]))


def _covariance(name: str, value: ArrayLike | None, size: int) -> Floats:
    """`value` as (size, size) float64, zeros for None, or a ValueError under `name`."""
    if value is None:
        return np.zeros((size, size))
    matrix = np.asarray(value, dtype=np.float64)
    if matrix.shape != (size, size) or not np.isfinite(matrix).all():
        raise ValueError(f"{name}: got shape {matrix.shape}, want finite ({size}, {size})")
    scale = np.sqrt(np.clip(np.diag(matrix), 1e-300, None))
    correlation = matrix / np.outer(scale, scale)  # units differ by powers of ten
    if not np.allclose(correlation, correlation.T, atol=1e-9):
        raise ValueError(f"{name}: is not symmetric")
    if np.linalg.eigvalsh(correlation).min() < -1e-9:
        raise ValueError(f"{name}: is no covariance, one of its eigenvalues is negative")
    return matrix
