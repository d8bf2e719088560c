"""Misses of simulated grasps whose cause is known."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cache

import numpy as np

from coursekit import checks
from coursekit.arm import widowx
from coursekit.arrays import Floats
from coursekit.attribution.verdict import Blame
from coursekit.budget.view import GRIPPER_DOWN
from coursekit.geometry import make_transform

# The length of the constant that all trials share, the std of the scatter on one axis, and the rms
# over the table of what follows the pose
SIZES_M: dict[Blame, tuple[float, float, float]] = {
    "calibration": (0.003, 0.002, 0.0),
    "perception": (0.0, 0.002, 0.0),
    "pose_dependent": (0.0, 0.002, 0.004),  # the lesson's arm is wrong by 2 to 4 mm
    "cannot_tell_yet": (0.0005, 0.006, 0.0),  # 30 trials do not show so small a constant
}
TABLE_GRASPS = 400  # with known joint angles, drawn from
RADIUS_M, AZIMUTH_RAD, HEIGHT_M = (0.2, 0.42), 1.0, (0.01, 0.1)
YAW_RAD, TILT_RAD = 1.2, 0.15


@dataclass(frozen=True, eq=False)
class SimulatedMisses:
    """Misses of n grasps, and what made them.

    misses (n, 3): where the gripper closed less where the object was, in the base, m.
    T_base_gripper (n, 4, 4): where the arm said it was. q (n, 6): its joints, rad. kind: the cause.
    constant_m (3,): the part that every trial shares. by_pose_m (n, 3): the arm's part. The rest of
    the misses is scatter.
    """

    misses: Floats
    T_base_gripper: Floats
    q: Floats
    kind: Blame
    constant_m: Floats
    by_pose_m: Floats


def simulate_misses(kind: Blame, n: int, seed: int) -> SimulatedMisses:
    """n grasps from above, all over the table in front of a WidowX AI, that miss for one reason.

    kind: "calibration" (a constant of 3 mm in a random direction of the base), "perception"
    (scatter and nothing else), "pose_dependent" (the zeros of the six joints slipped, then the
    hand-eye calibration was repeated, which took up what the slip does everywhere; 4 mm rms is left
    over the table), "cannot_tell_yet" (a constant of 0.5 mm under scatter of 6 mm). The scatter
    that the others have is 2 mm an axis. More than 400 grasps repeat places.

    Raises ValueError for an unknown kind, and for n < 1.

    >>> grasps = simulate_misses("calibration", 5, seed=1)
    >>> grasps.misses.shape, round(1000 * float(np.linalg.norm(grasps.constant_m)), 1)
    ((5, 3), 3.0)
    """
    constant_m, scatter_m, by_pose_m = SIZES_M[checks.choice("kind", kind, SIZES_M)]
    checks.whole("n", n)
    rng = np.random.default_rng([seed, zlib.crc32(b"misses")])
    q, poses = _table_grasps()
    chosen = rng.choice(len(q), n, replace=n > len(q))
    direction = rng.standard_normal(3)
    constant = constant_m * direction / np.linalg.norm(direction)
    ratio, by_pose = rng.standard_normal(6), np.zeros((n, 3))
    if by_pose_m:
        by_pose = by_pose_m * slipped_joints(ratio)[chosen]
    misses = constant + by_pose + scatter_m * rng.standard_normal((n, 3))
    return SimulatedMisses(misses, poses[chosen], q[chosen], kind, constant, by_pose)


def four_sets() -> dict[str, SimulatedMisses]:
    """Sets P, Q, R and S for notebook 5, in an order of their own.

    >>> sorted(four_sets()), len(four_sets()["S"].misses)
    (['P', 'Q', 'R', 'S'], 5)
    """
    return {
        "P": simulate_misses("perception", 25, seed=8),
        "Q": simulate_misses("calibration", 25, seed=18),
        "R": simulate_misses("pose_dependent", 25, seed=28),
        "S": simulate_misses("calibration", 5, seed=9),
    }


def slipped_joints(ratio: Floats) -> Floats:
    """Misses at all places of the table after slips of the joints in this ratio (6,).

    What they share is taken up by the calibration; 1 m rms is left, (places, 3).
    """
    q, poses = _table_grasps()
    slip = 1e-3 * ratio / np.linalg.norm(ratio)
    moved = widowx().forward(q + slip)[:, :3, 3] - poses[:, :3, 3]
    moved -= moved.mean(axis=0)
    return np.asarray(moved / np.sqrt((moved**2).sum(axis=1).mean()))


@cache
def _table_grasps() -> tuple[Floats, Floats]:
    """Joint angles (places, 6) and poses (places, 4, 4) of grasps from above; read-only."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(zlib.crc32(b"table"))
    azimuth = rng.uniform(-AZIMUTH_RAD, AZIMUTH_RAD, TABLE_GRASPS)
    radius = rng.uniform(*RADIUS_M, TABLE_GRASPS)
    height = rng.uniform(*HEIGHT_M, TABLE_GRASPS)
    at = np.column_stack([radius * np.cos(azimuth), radius * np.sin(azimuth), height])
    yaw = azimuth + rng.uniform(-YAW_RAD, YAW_RAD, TABLE_GRASPS)
    tilt = rng.uniform(-TILT_RAD, TILT_RAD, (TABLE_GRASPS, 2))
    turn = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix() @ GRIPPER_DOWN
    poses = np.stack([make_transform(R, t) for R, t in zip(turn, at, strict=True)])
    q, reached = widowx().inverse(poses)
    q, poses = q[reached], poses[reached]
    q.flags.writeable = poses.flags.writeable = False
    return q, poses
