"""From the covariances of pixel, depth, K, mount and arm to one of the point in the base.

p = T_base_camera deproject(u, v, Z; K): the chain that the budget's rows take apart. `propagate`
is its first order, J S J^T; `monte_carlo` draws the errors and sends each through the exact chain.
They part where the chain bends within the errors: turns of several degrees move a point inwards by
the square of the angle, whatever their sign, and a depth from a disparity that errs by a tenth or
more is skewed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, get_args

import numpy as np

from coursekit import checks
from coursekit.arrays import ArrayLike, Floats
from coursekit.budget.view import View
from coursekit.checks import want
from coursekit.geometry import bent, cross_matrix, distortion_jacobian
from coursekit.hand_eye.poses import Mount
from coursekit.intrinsics.derivatives import PARAMETERS, scaled_root
from coursekit.words import say

PINHOLE_PARAMETERS, LENS_PARAMETERS = PARAMETERS[:4], PARAMETERS[4:]
CHUNK = 65_536  # samples at a time: what one step needs stays in the cache
UNDISTORTION_STEPS = 6  # from the nominal point, whose neighbours are all that is asked for
UNDISTORTION_TOLERANCE = 1e-7  # of the last step: the next, its square, is lost in rounding


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
        checks.choice("mount", self.mount, get_args(Mount))
        if self.mount == "eye_in_hand":
            given = self.T_base_gripper
            want(given is not None, "T_base_gripper", given, "the arm's pose at the picture")
            checks.transform("T_base_gripper", self.gripper)

    @property
    def gripper(self) -> Floats:
        """The frame that X is given in, in the base: T_base_gripper, or the base itself, (4, 4)."""
        carried = self.mount == "eye_in_hand" and self.T_base_gripper is not None
        return np.asarray(self.T_base_gripper) if carried else np.eye(4)

    @property
    def arm_lever(self) -> Floats:
        """From the gripper's origin to the point, base axes, (3,), m; 0 for a camera off the arm,
        where the fingertip is at the point."""
        if self.mount == "eye_to_hand":
            return np.zeros(3)
        there = self.view.T_base_camera[:3, 3] + self.view.lever_base
        return np.asarray(there - self.gripper[:3, 3])


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
    names: tuple[str, ...] = PINHOLE_PARAMETERS
    hand_eye: ArrayLike | None = None
    arm: ArrayLike | None = None

    def __post_init__(self) -> None:
        different = len(set(self.names)) == len(self.names) and set(self.names) <= set(PARAMETERS)
        want(different, "names", self.names, f"different ones of {', '.join(PARAMETERS)}")
        checks.number("depth_sigma_m", self.depth_sigma_m, "0 m or more", least=0.0)
        sizes = {"pixel": 2, "intrinsics": len(self.names), "hand_eye": 6, "arm": 6}
        for name, size in sizes.items():
            given = getattr(self, name)
            known = np.zeros((size, size)) if given is None else given
            checks.settle(self, **{name: checks.covariance(name, known, size)})

    @cached_property
    def joint(self) -> Floats:
        """Of (u, v), Z, K, the twist of X and that of the arm together, (15 + p, 15 + p)."""
        from scipy.linalg import block_diag

        depth = [[self.depth_sigma_m**2]]
        joint = block_diag(self.pixel, depth, self.intrinsics, self.hand_eye, self.arm)
        return np.asarray(joint, dtype=np.float64)


def jacobian(chain: Chain, names: tuple[str, ...] = PINHOLE_PARAMETERS) -> Floats:
    """d p_base / d(u, v, Z, K, twist of X, twist of the arm), (3, 15 + p), m a unit.

    names (p): the parameters of K and the lens that count, in their order.
    """
    view, R, frame = chain.view, chain.view.R_base_camera, chain.gripper[:3, :3]
    chosen = [PARAMETERS.index(name) for name in names]
    turned = -cross_matrix(view.lever_base) @ frame
    arm = np.concatenate([-cross_matrix(chain.arm_lever), np.eye(3)], axis=1)
    seen = R @ view.by_pixel, (R @ view.ray)[:, None], R @ view.by_parameter[:, chosen]
    carried = arm if chain.mount == "eye_in_hand" else -arm
    return np.concatenate([*seen, turned, frame, carried], axis=1)


def propagate(chain: Chain, covariances: Covariances) -> Floats:
    """The covariance of the point in the base less where the gripper goes, (3, 3), m²."""
    J = jacobian(chain, covariances.names)
    return np.asarray(J @ covariances.joint @ J.T)


def monte_carlo(
    chain: Chain, covariances: Covariances, n: int = 1_000_000, seed: int = 0
) -> Floats:
    """n draws of the point's error in the base through the exact chain, (n, 3), m.

    NaN where a drawn lens folds before it reaches the pixel. Raises ValueError for n under 1.
    """
    n = checks.whole("n", n)
    rng, root = np.random.default_rng(seed), scaled_root(covariances.joint)
    errors = np.empty((n, 3))
    for start in range(0, n, CHUNK):
        drawn = root @ rng.standard_normal((root.shape[1], min(CHUNK, n - start)))
        moved = displacements(chain, covariances.names, drawn)
        errors[start : start + CHUNK] = moved.T
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
        return say("budget.first_order", n=self.n, ratio=ratio, shift=shift)


def check_first_order(
    chain: Chain, covariances: Covariances, n: int = 1_000_000, seed: int = 0
) -> FirstOrderCheck:
    """Compare `propagate` with `monte_carlo`; n samples tell variances to sqrt(2 / n).

    seed: as for `monte_carlo`. Raises ValueError where fewer than two samples had a ray.

    >>> from coursekit.budget import lesson_view
    >>> known = Covariances(pixel=np.eye(2), depth_sigma_m=0.0007)
    >>> check_first_order(Chain(lesson_view()), known, n=1000).worst < 0.2
    True
    """
    samples = monte_carlo(chain, covariances, n, seed)
    valid = samples[np.isfinite(samples).all(axis=1)]
    want(len(valid) >= 2, "n", n, f"two samples with a ray at least; {len(valid)} had one")
    first_order = propagate(chain, covariances)
    return FirstOrderCheck(first_order, np.cov(valid.T), valid.mean(axis=0), len(valid))


# --- the exact chain ---


def displacements(chain: Chain, names: tuple[str, ...], errors: Floats) -> Floats:
    """Where errors move the point less where the gripper goes, base axes, (3, m), m.

    errors (15 + p, m): in the order of `jacobian`, of any size. names (p): of K and the lens. NaN
    where there is no ray.
    """
    pixel, depth, K, X, arm = np.split(errors, np.cumsum([2, 1, len(names), 6]))
    view, frame, lever = chain.view, chain.gripper[:3, :3], chain.arm_lever[:, None]
    seen = _seen(view, names, pixel, K) * (view.distance_m + depth[0])
    in_frame = _turn(X[:3], frame.T @ view.R_base_camera @ seen) + X[3:]
    moved = frame @ in_frame - view.lever_base[:, None]
    if chain.mount == "eye_to_hand":
        return moved - arm[3:]  # the fingertip is at the point: turning it moves it not at all
    return _turn(arm[:3], moved + lever) - lever + arm[3:]


def _seen(view: View, names: tuple[str, ...], pixel: Floats, changes: Floats) -> Floats:
    """(x, y, 1) of pixels that are off by `pixel` (2, m), by parameters off by `changes` (p, m)."""
    camera = view.intrinsics
    lens = (0.0,) * 5 if camera.dist is None else camera.coeffs
    nominal = (camera.fx, camera.fy, camera.cx, camera.cy, *lens)
    values: dict[str, Any] = dict(zip(PARAMETERS, nominal, strict=True))
    for name, change in zip(names, changes, strict=True):
        values[name] = values[name] + change
    x = (view.pixel[0] + pixel[0] - values["cx"]) / values["fx"]
    y = (view.pixel[1] + pixel[1] - values["cy"]) / values["fy"]
    if camera.dist is not None or set(names) & set(LENS_PARAMETERS):
        x, y = _ideal(x, y, view.ray, [values[name] for name in LENS_PARAMETERS])
    return np.stack([x, y, np.ones_like(x)])


def _ideal(x: Floats, y: Floats, start: Floats, lens: Any) -> tuple[Floats, Floats]:
    """The ideal coordinates of distorted ones, each with its own lens, from a point close by.

    lens: k1, k2, p1, p2, k3, of one number or (m,) each.
    NaN where Newton's method has not arrived: close to a fold, or beyond it.
    """
    a, b = np.full_like(x, start[0]), np.full_like(y, start[1])
    for _ in range(UNDISTORTION_STEPS):
        off_x, off_y = np.subtract(bent(a, b, lens), (x, y))
        xx, xy, yy = distortion_jacobian(np.stack([a, b], axis=-1), lens)
        determinant = xx * yy - xy * xy
        step_a = (yy * off_x - xy * off_y) / determinant
        step_b = (xx * off_y - xy * off_x) / determinant
        a, b = a - step_a, b - step_b
    found = (np.abs(step_a) + np.abs(step_b) < UNDISTORTION_TOLERANCE) & (determinant > 0)
    return np.where(found, a, np.nan), np.where(found, b, np.nan)


def _turn(omega: Floats, points: Floats) -> Floats:
    """exp(omega) points; omega (3, m) in rad, points (3, m)."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_rotvec(omega.T).apply(points.T).T)
