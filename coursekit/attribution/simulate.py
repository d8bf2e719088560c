"""Misses of simulated grasps whose cause is known."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cache
from typing import get_args

import numpy as np

from coursekit.arm import widowx
from coursekit.arrays import ArrayLike, Floats
from coursekit.attribution.verdict import Verdict
from coursekit.geometry import make_transform

BIAS_M = 0.003
NOISE_M = 0.002  # std of one axis
WEAK_BIAS_M, WIDE_NOISE_M = 5e-4, 0.006  # of "cannot_tell_yet": 30 trials do not show the bias
ARM_M = 0.004  # rms; the lesson's arm is wrong by 2 to 4 mm
PLACES = 400  # table grasps with known joint angles, drawn from
RADIUS_M, AZIMUTH_RAD, HEIGHT_M = (0.2, 0.42), 1.0, (0.01, 0.1)
YAW_RAD, TILT_RAD = 1.2, 0.15
POINTS_DOWN = np.column_stack([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])


@dataclass(frozen=True, eq=False)
class SimulatedMisses:
    """Misses of n grasps, and what made them.

    misses (n, 3): where the gripper closed less where the object was, in the base, m.
    T_base_gripper (n, 4, 4): where the arm said it was. q (n, 6): its joints, rad. kind: the cause.
    constant_m (3,): the part that every trial shares. by_pose_m (n, 3): the arm's part.
    """

    misses: Floats
    T_base_gripper: Floats
    q: Floats
    kind: Verdict
    constant_m: Floats
    by_pose_m: Floats


def simulate_misses(
    kind: Verdict,
    n: int,
    seed: int,
    *,
    noise_m: ArrayLike | None = None,
    bias_m: float | None = None,
    arm_m: float = ARM_M,
    repeats: int = 1,
    unrelated: bool = False,
) -> SimulatedMisses:
    """n grasps from above, all over the table in front of a WidowX AI, that miss for one reason.

    kind: "calibration" (a constant of length bias_m, 3 mm, in a random direction of the base),
    "perception" (scatter and nothing else), "pose_dependent" (the zeros of the six joints slipped,
    then the hand-eye calibration was repeated, which took up what the slip does everywhere; arm_m
    rms is left over the table; unrelated: each place has an error of its own, normal and alike in
    all directions), "cannot_tell_yet" (a constant of 0.5 mm under scatter of 6 mm).
    repeats: trials in each place, one after the other; the last place gets what is left of n.
    noise_m: std of the scatter that every kind has, one number or (3,) along the base's axes, m;
    2 mm unless given.

    Raises ValueError for an unknown kind, n or repeats < 1, and sizes that are negative or not
    finite.
    """
    if kind not in get_args(Verdict):
        raise ValueError(f"kind: got {kind!r}, want one of {', '.join(get_args(Verdict))}")
    for name, number in (("n", n), ("repeats", repeats)):
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)) or number < 1:
            raise ValueError(f"{name}: got {number!r}, want a number of trials, 1 or more")
    usual = {"calibration": BIAS_M, "cannot_tell_yet": WEAK_BIAS_M}.get(kind, 0.0)
    size = _size("bias_m", usual if bias_m is None else bias_m, ())
    if noise_m is None:
        noise_m = WIDE_NOISE_M if kind == "cannot_tell_yet" else NOISE_M
    noise = np.broadcast_to(_size("noise_m", noise_m, (), (3,)), 3)
    slipped_m = _size("arm_m", arm_m, ()) if kind == "pose_dependent" else np.zeros(())
    rng = np.random.default_rng([seed, zlib.crc32(b"misses")])
    q, poses = _places()
    places = -(-n // repeats)
    chosen = rng.choice(len(q), places, replace=places > len(q))
    place = np.arange(n) // repeats
    direction = rng.standard_normal(3)
    constant = size * direction / np.linalg.norm(direction)
    if unrelated:
        by_place = rng.standard_normal((places, 3)) / np.sqrt(3)
    else:
        by_place = _slip(rng.standard_normal(6))[chosen]
    chosen, by_pose = chosen[place], float(slipped_m) * by_place[place]
    misses = constant + by_pose + noise * rng.standard_normal((n, 3))
    return SimulatedMisses(misses, poses[chosen], q[chosen], kind, constant, by_pose)


def four_sets() -> dict[str, SimulatedMisses]:
    """Sets P, Q, R and S for notebook 5: one of each kind, in an order of their own."""
    return {
        "P": simulate_misses("perception", 25, seed=8),
        "Q": simulate_misses("calibration", 25, seed=18),
        "R": simulate_misses("pose_dependent", 25, seed=28),
        "S": simulate_misses("calibration", 5, seed=9),
    }


def _slip(ratio: Floats) -> Floats:
    """Misses at all places after slips in this ratio (6,), constant taken up, 1 m rms."""
    q, poses = _places()
    slip = 1e-3 * ratio / np.linalg.norm(ratio)
    moved = widowx().forward(q + slip)[:, :3, 3] - poses[:, :3, 3]
    moved -= moved.mean(axis=0)
    return np.asarray(moved / np.sqrt((moved**2).sum(axis=1).mean()))


@cache
def _places() -> tuple[Floats, Floats]:
    """Joint angles (PLACES, 6) and poses (PLACES, 4, 4) of grasps from above; read-only."""
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(zlib.crc32(b"table"))
    azimuth = rng.uniform(-AZIMUTH_RAD, AZIMUTH_RAD, PLACES)
    radius = rng.uniform(*RADIUS_M, PLACES)
    at = np.column_stack(
        [radius * np.cos(azimuth), radius * np.sin(azimuth), rng.uniform(*HEIGHT_M, PLACES)]
    )
    yaw = azimuth + rng.uniform(-YAW_RAD, YAW_RAD, PLACES)
    tilt = rng.uniform(-TILT_RAD, TILT_RAD, (PLACES, 2))
    turn = Rotation.from_euler("ZYX", np.column_stack([yaw, tilt])).as_matrix() @ POINTS_DOWN
    poses = np.stack([make_transform(R, t) for R, t in zip(turn, at, strict=True)])
    q, reached = widowx().inverse(poses)
    q, poses = q[reached], poses[reached]
    q.flags.writeable = poses.flags.writeable = False
    return q, poses


def _size(name: str, value: ArrayLike, *shapes: tuple[int, ...]) -> Floats:
    sizes = np.asarray(value, dtype=np.float64)
    if sizes.shape not in shapes or not (np.isfinite(sizes).all() and (sizes >= 0).all()):
        raise ValueError(f"{name}: got {value!r}, want a length >= 0 in m")
    return sizes
