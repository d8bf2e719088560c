"""First order against numerical derivatives and against Monte Carlo through the exact chain."""

import math
from dataclasses import replace

import numpy as np
import pytest
from common import NIGHTLY, WIDE, derivative
from scipy.spatial.transform import Rotation

import coursekit.budget as eb
from coursekit.arm import fk_covariance, widowx
from coursekit.budget.handover import LESSON_CAMERA
from coursekit.budget.propagation import displacements, jacobian
from coursekit.geometry import Intrinsics, deproject, invert_transform, transform_points, undistort
from coursekit.intrinsics.derivatives import PARAMETERS, parameter_vector, scaled_root
from coursekit.stereo import depth_noise

ARM_AT = (0.2, 1.3, 1.2, -0.3, 0.1, 0.4)
SAMPLES = 150_000 if NIGHTLY else 50_000  # a variance to 0.4 or 0.6 % (one standard error)
CORNERS = [(424.0, 240.0), (0.0, 0.0), (847.0, 240.0), (847.0, 479.0), (424.0, 0.0)]


def chain(mount: str, camera: Intrinsics, Z: float, u: float, v: float) -> eb.Chain:
    if mount == "eye_to_hand":
        return eb.Chain(eb.View(camera, Z, 0.05, u, v, eb.looking_down()), "eye_to_hand")
    T_base_gripper = widowx().forward(ARM_AT)
    T = T_base_gripper @ widowx().T_gripper_camera
    return eb.Chain(eb.View(camera, Z, 0.05, u, v, T), "eye_in_hand", T_base_gripper)


def errors(Z: float, turn_deg: float, lens: bool = False) -> eb.Covariances:
    """Every link of the chain: 1 px, 0.08 px of disparity, K from a calibration, X, the arm."""
    turn = math.radians(turn_deg)
    sigma_K = [1.0, 1.0, 1.2, 1.2, 5e-3, 8e-3, 5e-4, 5e-4, 5e-3]
    names = PARAMETERS if lens else PARAMETERS[:4]
    X = np.diag(np.square([turn] * 3 + [1.5e-3] * 3))
    X[0, 4] = X[4, 0] = 0.6 * turn * 1.5e-3  # what turns the camera seems to shift it
    depth, arm = depth_noise(Z, LESSON_CAMERA.fx, 0.05, 0.08), fk_covariance(ARM_AT).covariance
    K = np.diag(np.square(sigma_K[: len(names)]))
    return eb.Covariances(np.eye(2), float(depth), K, names, hand_eye=X, arm=arm)


def exact(where: eb.Chain, names: tuple[str, ...], e: np.ndarray) -> np.ndarray:
    """The point less the gripper's miss, composed from 4x4 transforms; errors e (15 + p,)."""

    def moved(T: np.ndarray, twist: np.ndarray) -> np.ndarray:
        T = T.copy()
        T[:3, :3] = Rotation.from_rotvec(twist[:3]).as_matrix() @ T[:3, :3]
        T[:3, 3] += twist[3:]
        return T

    view, p = where.view, len(names)
    fx, fy, cx, cy, *coeffs = parameter_vector(view.intrinsics) + np.pad(e[3 : 3 + p], (0, 9 - p))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    pixel = np.array([view.u, view.v]) + e[:2]
    seen = deproject(pixel, view.distance_m + e[2], K, coeffs)
    X_twist, arm_twist = e[3 + p : 9 + p], e[9 + p :]
    if where.mount == "eye_to_hand":
        return transform_points(moved(view.T_base_camera, X_twist), seen) - arm_twist[3:]
    X = invert_transform(where.T_base_gripper) @ view.T_base_camera
    T = moved(where.T_base_gripper, arm_twist) @ moved(X, X_twist)
    return transform_points(T, seen)


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
@pytest.mark.parametrize(("camera", "p"), [(LESSON_CAMERA, 4), (WIDE, 9)])
def test_jacobian_is_the_derivative(mount: str, camera: Intrinsics, p: int) -> None:
    where, names = chain(mount, camera, 0.5, 701.0, 92.0), PARAMETERS[:p]
    numerical = derivative(lambda e: exact(where, names, e), 1e-6, 15 + p)
    assert jacobian(where, names) == pytest.approx(numerical, rel=1e-6, abs=1e-8)


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
def test_displacements_are_those_of_the_composed_transforms(mount: str) -> None:
    """Errors of every part at once, and large: 10 degrees of turn, 10 mm of depth, a wrong lens."""
    where = chain(mount, WIDE, 0.5, 701.0, 92.0)
    given = errors(0.5, 10.0, lens=True)
    all_of_it = replace(given, depth_sigma_m=0.01, arm=100 * np.asarray(given.arm))
    drawn = scaled_root(all_of_it.joint) @ np.random.default_rng(5).standard_normal((24, 30))
    start = exact(where, PARAMETERS, np.zeros(24))
    expected = [exact(where, PARAMETERS, e) - start for e in drawn.T]
    found = displacements(where, PARAMETERS, drawn)
    np.testing.assert_allclose(found.T, expected, atol=1e-9)


@pytest.mark.parametrize("mount", ["eye_to_hand", "eye_in_hand"])
@pytest.mark.parametrize("Z", [0.25, 0.45, 0.8])
def test_first_order_over_the_working_volume(mount: str, Z: float) -> None:
    """Every variance within 3 % for turns of 1 degree about each axis, over the whole image."""
    for u, v in CORNERS if NIGHTLY else CORNERS[::2]:
        check = eb.check_first_order(chain(mount, LESSON_CAMERA, Z, u, v), errors(Z, 1.0), SAMPLES)
        assert check.worst < 0.03, (u, v, check)


def test_first_order_with_a_lens() -> None:
    """Within 1 % of a million; of fewer, within four standard errors of a variance more."""
    n = 1_000_000 if NIGHTLY else 200_000
    where = chain("eye_in_hand", WIDE, 0.45, 40.0, 30.0)
    check = eb.check_first_order(where, errors(0.45, 1.0, lens=True), n)
    assert check.n == n
    assert check.worst < 0.01
    assert np.abs(check.first_order - check.monte_carlo).max() < 0.01 * check.first_order.max()


def test_a_lens_that_folds_has_no_ray() -> None:
    """k3 so uncertain that some drawn lenses turn back before the corner: NaN, not a number."""
    where = chain("eye_to_hand", WIDE, 0.45, 10.0, 10.0)
    wild = eb.Covariances(names=("k3",), intrinsics=[[0.05**2]])
    samples = eb.monte_carlo(where, wild, 2000)
    lost = np.isnan(samples).any(axis=1)
    assert 0 < lost.mean() < 0.3
    assert eb.check_first_order(where, wild, 2000).n == 2000 - lost.sum()
    drawn = WIDE.coeffs[4] + 0.05 * np.random.default_rng(0).standard_normal(2000)
    seen = (np.array([10.0, 10.0]) - WIDE.K[:2, 2]) / WIDE.K[[0, 1], [0, 1]]
    has_ray = [undistort(seen, (*WIDE.coeffs[:4], k3))[1] for k3 in drawn[:300]]
    assert (~lost[:300] == np.array(has_ray)).mean() > 0.99


def bare(Z: float, turn_deg: float) -> eb.Covariances:
    """Without the millimetres of mount and arm, which hide what a turn does to the depth."""
    turn = np.diag([math.radians(turn_deg) ** 2] * 3 + [0.0] * 3)
    return replace(errors(Z, 0.0), hand_eye=turn, arm=None, intrinsics=None)


def test_where_first_order_fails() -> None:
    """Along the axis a turn shortens by theta²/2, whatever its sign: not in the first order."""
    near = chain("eye_to_hand", LESSON_CAMERA, 0.25, 424.0, 240.0)
    good = eb.check_first_order(near, bare(0.25, 1 / math.sqrt(3)), 100_000)  # 1 degree in all
    assert good.worst < 0.03
    poor = eb.check_first_order(near, bare(0.25, 1.0), 100_000)
    assert 0.05 < poor.worst < 0.2
    bad = eb.check_first_order(near, bare(0.25, 5.0), 100_000)
    assert bad.ratio[2] < 0.2
    # E(omega_x² + omega_y²) / 2 = sigma²: the mean rises towards the camera by Z sigma²
    assert bad.mean_m[2] == pytest.approx(0.25 * math.radians(5) ** 2, rel=0.02)
