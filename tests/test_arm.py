"""The arm against its maker's own parameters, SciPy, numerical derivatives and Monte Carlo."""

import numpy as np
import pytest
from common import NIGHTLY, derivative, refusals
from scipy.linalg import block_diag

from coursekit import arm as arms
from coursekit.arm import ArmErrors, SimulatedArm, fk_covariance, widowx
from coursekit.geometry import pose_difference

UNITS = 400 if NIGHTLY else 60
NONE = ArmErrors(0.0, 0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def anywhere() -> np.ndarray:
    arm = widowx()
    return np.random.default_rng(3).uniform(arm.limits[:, 0], arm.limits[:, 1], (500, 6))


# --- forward kinematics against two other descriptions ---


def makers_table(q: np.ndarray) -> np.ndarray:
    """T_base_flange by the classic Denavit-Hartenberg table in the maker's documentation.

    github.com/TrossenRobotics/trossen_arm, docs/specifications/wxai.rst at commit
    37f63d339e5481d8ffb920f84003661c0697a537; its flange has z where the robot's description has x.
    """
    far = np.hypot(0.245, 0.06)
    table = [
        (0.1035, q[0], 0.02, -np.pi / 2),
        (0.0, q[1] + np.pi, 0.264, np.pi),
        (0.0, q[2] - np.pi / 2 - np.arctan(0.245 / 0.06), far, 0.0),
        (0.0, q[3] - np.arctan(0.06 / 0.245), 0.06775, np.pi / 2),
        (0.0, q[4] + np.pi / 2, 0.0, np.pi / 2),
        (0.02895, q[5], 0.0, np.pi / 2),
        (0.0, np.pi / 2, 0.0, 0.0),
    ]
    T = np.eye(4)
    for d, theta, a, alpha in table:
        c, s, ca, sa = np.cos(theta), np.sin(theta), np.cos(alpha), np.sin(alpha)
        T = T @ np.array(
            [[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]]
        )
    return T


def test_forward_is_the_makers_table(anywhere: np.ndarray) -> None:
    ours = widowx().forward(anywhere, "flange")
    theirs = np.stack([makers_table(q) for q in anywhere])
    assert np.abs(ours[:, :3, 3] - theirs[:, :3, 3]).max() < 1e-12
    # one fixed turn of the frame between the two, the same in every pose
    between = np.swapaxes(theirs[:, :3, :3], 1, 2) @ ours[:, :3, :3]
    assert np.abs(between - between[0]).max() < 1e-12
    assert np.abs(np.abs(between[0]) - np.eye(3)[np.abs(between[0]).argmax(1)]).max() < 1e-12


def test_the_wrist_camera_is_where_the_description_puts_it() -> None:
    """The same transform as that of the maker's chain, multiplied out elsewhere."""
    arm = widowx()
    T = arm.T_flange_gripper @ arm.T_gripper_camera
    assert T[:3, 3] == pytest.approx([0.05865016595536615, 0.009, 0.054272138451420565], abs=1e-14)
    tilt = np.radians(20)
    assert T[:3, 2] == pytest.approx([np.cos(tilt), 0.0, -np.sin(tilt)], abs=1e-12)
    assert T[:3, 0] == pytest.approx([0.0, -1.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("tool", ["gripper", "flange"])
def test_jacobian_is_the_numerical_one(tool: arms.Tool, anywhere: np.ndarray) -> None:
    arm = widowx()
    here = arm.forward(anywhere, tool)
    J = derivative(lambda e: pose_difference(here, arm.forward(anywhere + e, tool)), 1e-6, 6)
    assert np.abs(arm.jacobian(anywhere, tool) - J).max() < 1e-8


def test_inverse_meets_the_pose_or_says_so() -> None:
    arm = widowx()
    q = arm.random(np.random.default_rng(1), 150)
    q[:, 0] = np.clip(q[:, 0], -1.5, 1.5)
    found, reached = arm.inverse(arm.forward(q))
    assert reached.mean() > 0.85
    miss = pose_difference(arm.forward(found[reached]), arm.forward(q[reached]))
    assert np.abs(miss).max() < 1e-8
    assert arm.within_limits(found).all()
    far = arm.forward(q[0])
    far[:3, 3] = [1.0, 0.0, 0.3]
    assert not arm.inverse(far)[1]
    near, again = arm.inverse(arm.forward(q), start=q + 0.01)
    assert again.mean() > 0.99
    assert np.median(np.abs(near - q)) < 1e-6


def test_random_configurations_are_free() -> None:
    arm = widowx()
    q = arm.random(np.random.default_rng(0), 500, clearance_m=0.05)
    assert q.shape == (500, 6)
    assert (arm.check(q) == q).all()
    camera = (arm.forward(q) @ arm.T_gripper_camera)[:, 2, 3]
    assert min(arm.forward(q)[:, 2, 3].min(), camera.min()) >= 0.05
    assert np.array_equal(q, arm.random(np.random.default_rng(0), 500, clearance_m=0.05))


ARM, RANDOM, UNIT = widowx(), np.random.default_rng(0), SimulatedArm(0)

test_bad_input_is_named = refusals(
    (r"q: got shape \(5,\), want \(\.\.\., 6\)", lambda: ARM.forward(np.zeros(5))),
    ("q: got .*nan.*, want finite", lambda: ARM.forward([0, 0, np.nan, 0, 0, 0])),
    ("tool: got 'wrist'", lambda: ARM.forward(np.zeros(6), "wrist")),
    (r"q\[1\]: joint_3 is at 1.6000 rad", lambda: ARM.check([[0.0] * 6, [0, 0, 0, 1.6, 0, 0]])),
    ("joint_1 .*are these degrees", lambda: ARM.check([0, 40.0, 0, 0, 0, 0])),
    ("n: got 0", lambda: ARM.random(RANDOM, 0)),
    ("clearance_m: got 2.0", lambda: ARM.random(RANDOM, 5, clearance_m=2.0)),
    ("T_base_gripper: .* a reflection", lambda: ARM.inverse(np.diag([1.0, 1, -1, 1]))),
    ("play_rad: got -1.0", lambda: ArmErrors(play_rad=-1.0)),
    ("joint_2 is at 3.0000 rad", lambda: UNIT.move(np.full(6, 3.0))),
    (r"want \(6,\) or \(n, 6\)", lambda: UNIT.move(np.zeros((2, 2, 6)))),
)


# --- the simulated arm ---


def test_an_arm_without_errors_is_the_drawing() -> None:
    arm = widowx()
    q = arm.random(np.random.default_rng(2), 30)
    robot = SimulatedArm(7, NONE)
    read = robot.move(q)
    assert np.abs(robot.true_pose() - arm.forward(read)).max() < 1e-12
    assert 0 < np.abs(read - q).max() < 5e-3  # it stops near the command, and reads where


def test_the_error_of_forward_kinematics_is_2_to_4_mm_and_depends_on_the_pose() -> None:
    """Over units and the workspace: the mean, and how much one unit's own error varies."""
    arm, rng = widowx(), np.random.default_rng(5)
    off: dict[str, list[np.ndarray]] = {"flange": [], "gripper": []}
    for unit in range(UNITS):
        robot = SimulatedArm(unit)
        read = robot.move(arm.random(rng, 100))
        for tool, found in off.items():
            miss = pose_difference(arm.forward(read, tool), robot.true_pose(tool))
            found.append(np.linalg.norm(miss[:, 3:], axis=1))
    for errors_m in map(np.array, off.values()):
        assert 2e-3 < errors_m.mean() < 4e-3
        assert 2e-3 < np.median(errors_m) < 4e-3
        low, high = np.percentile(errors_m, [5, 95], axis=1)
        assert np.mean(high / low) > 2.5  # within one unit


def test_gravity_turns_a_joint_the_way_its_weight_sinks(anywhere: np.ndarray) -> None:
    arm = widowx()

    def height(q: np.ndarray) -> np.ndarray:
        return (arm.forward(q, "flange")[:, 2, 3] + arm.forward(q)[:, 2, 3]) / 2

    side = arms.load_side(arm, anywhere)
    assert not side[:, [0, 5]].any()  # vertical, and through the weight
    for j in range(1, 5):
        step = 1e-6 * np.eye(6)[j]
        sinks = -(height(anywhere + step) - height(anywhere - step)) / 2e-6
        loaded = side[:, j] != 0
        assert loaded.mean() > 0.5
        assert np.array_equal(np.sign(sinks[loaded]), side[loaded, j])
        assert np.abs(sinks[~loaded]).max() <= arms.GRAVITY_ARM_M + 1e-6


def test_play_trails_the_last_move_of_an_unloaded_joint() -> None:
    robot = SimulatedArm(3, ArmErrors(0.0, 2e-3, 0.0, 0.0))
    arm, play = robot.nominal, robot.reveal().play_rad[0]
    turns = []
    for direction in (1, -1):
        robot.move(np.array(arms.HOME) - direction * np.eye(6)[0])
        read = robot.move(arms.HOME)
        miss = pose_difference(arm.forward(read, "flange"), robot.true_pose("flange"))
        read = robot.move(arms.HOME)  # no move: the joint stays on its side
        stayed = pose_difference(arm.forward(read, "flange"), robot.true_pose("flange"))
        assert stayed[2] == pytest.approx(miss[2], abs=1e-5)
        turns.append(miss[2])
    assert turns[1] - turns[0] == pytest.approx(2 * play, abs=1e-5)  # it trails to either side


def test_a_seed_names_a_unit_and_its_moves() -> None:
    q = widowx().random(np.random.default_rng(0), 4)
    one, same, other = SimulatedArm(1), SimulatedArm(1), SimulatedArm(2)
    assert np.array_equal(one.move(q), same.move(q))
    assert np.array_equal(one.true_pose(), same.true_pose())
    assert not np.array_equal(one.reveal().offset_rad, other.reveal().offset_rad)
    singly = SimulatedArm(1)
    for pose, wanted in zip(q, one.true_pose(), strict=True):
        singly.move(pose)
        assert np.abs(singly.true_pose() - wanted).max() < 1e-12


# --- what a fit may know ---


def test_shared_columns_are_numerical_derivatives() -> None:
    arm = widowx()
    q = arm.random(np.random.default_rng(4), 20)
    model = fk_covariance(q)
    assert model.shared.shape == (20, 6, len(model.names))
    assert model.sigma.shape == (len(model.names),)
    side = arms.load_side(arm, q)
    by_joint = arm.jacobian(q)
    assert np.array_equal(model.shared[..., :6], by_joint)
    assert np.array_equal(model.shared[..., 6:12], by_joint * side[:, None, :])

    def off(links):
        bent = arms.with_link_errors(arm, links.reshape(7, 6))
        return pose_difference(arm.forward(q), bent.forward(q))

    assert np.abs(model.shared[..., 13:] - derivative(off, 1e-6, 42)).max() < 1e-8


def test_covariance_is_that_of_many_units() -> None:
    """Spread and correlation over poses of units drawn at random, arriving from anywhere."""
    arm, n = widowx(), 1500 if NIGHTLY else 500
    q = arm.random(np.random.default_rng(1), 3)
    model = fk_covariance(q)
    misses = np.empty((n, 3, 6))
    for unit in range(n):
        rng = np.random.default_rng([unit, 9])
        robot = SimulatedArm(unit)
        for i in rng.permutation(3):
            robot.move(rng.uniform(arm.limits[:, 0], arm.limits[:, 1]))
            read = robot.move(q[i])
            misses[unit, i] = pose_difference(arm.forward(read), robot.true_pose())
    drawn = np.sqrt((misses**2).mean(axis=0))
    stated = np.sqrt(np.einsum("nii->ni", model.covariance))
    assert drawn == pytest.approx(stated, rel=0.09)
    shared = (model.shared * model.sigma).reshape(18, -1)
    joint = shared @ shared.T + block_diag(*model.each)  # the shared part does not average
    chi2 = np.mean([m.ravel() @ np.linalg.solve(joint, m.ravel()) for m in misses])
    assert chi2 / 18 == pytest.approx(1.0, abs=0.07)
    separate = np.linalg.slogdet(joint)[1]
    alone = sum(np.linalg.slogdet(c)[1] for c in model.covariance)
    assert separate < alone - 3  # the poses' errors are correlated: they do not average
