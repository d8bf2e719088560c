"""Tests of a hand-eye calibration in the world: touch the board, look with two cameras.

The simulated arm is really at the place; what it *reports* is its own forward kinematics, so its
hidden errors show, as they would on a table.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.arm import SimulatedArm
from coursekit.geometry import invert_transform, make_transform, transform_points

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.simulation.hand_eye_sessions import HandEyeTruth

    Floats = NDArray[np.float64]

# the gripper points down (its x to the table), its fingers close along the base's y
POINTS_DOWN = np.column_stack([[0.0, 0.0, -1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]])
SEEN_TO_M = 2e-4  # std along each axis of where one camera puts a target in its own frame


def touch_corners(truth: HandEyeTruth, corners: Sequence[int] = (0, 7, 39)) -> Floats:
    """Where the arm says its fingertip is when it is on corners of the board on the table.

    truth: of an eye-in-hand session. corners (k,): ids. Returns (k, 3), m, in the base by the
    arm's own forward kinematics; the fingertip is really on the corner.
    Raises ValueError for another mount, and for a corner out of the arm's reach.
    """
    if truth.mount != "eye_in_hand":
        raise ValueError(f"truth: got {truth.mount}, the board has to lie on the table")
    places = transform_points(truth.setup.Y, truth.setup.board.points[list(corners)])
    poses = np.stack([make_transform(POINTS_DOWN, place) for place in places])
    return np.asarray(_reported(truth.arm, poses, "corners")[:, :3, 3])


@dataclass(frozen=True, eq=False)
class SharedTarget:
    """One point on the table, as two cameras see it at the same time.

    T_base_gripper (4, 4): where the arm says the gripper is while its camera looks.
    in_wrist_camera, in_shoulder_camera (3,): the point in either camera's frame, m.
    """

    T_base_gripper: Floats
    in_wrist_camera: Floats
    in_shoulder_camera: Floats


def shared_target(
    on_wrist: HandEyeTruth, over_shoulder: HandEyeTruth, view: int = 0, seed: int = 0
) -> SharedTarget:
    """The middle of the board on the table, seen from view `view` of the wrist and from above.

    Both cameras are good to 0.2 mm along each axis in their own frames.
    Raises ValueError for sessions of other mounts.
    """
    if (on_wrist.mount, over_shoulder.mount) != ("eye_in_hand", "eye_to_hand"):
        raise ValueError(
            f"on_wrist, over_shoulder: got {on_wrist.mount} and {over_shoulder.mount}, want an "
            "eye_in_hand and an eye_to_hand session"
        )
    rng = np.random.default_rng(seed)
    middle = on_wrist.setup.board.points.mean(axis=0)
    place = transform_points(on_wrist.Y[view], middle)
    true = on_wrist.T_base_gripper[view]
    near, far = (
        transform_points(invert_transform(T), place) + SEEN_TO_M * rng.normal(size=3)
        for T in (true @ on_wrist.setup.X, over_shoulder.setup.X)
    )
    return SharedTarget(_reported(on_wrist.arm, true[None], "on_wrist")[0], near, far)


def _reported(arm: SimulatedArm, poses: Floats, name: str) -> Floats:
    """Where forward kinematics puts grippers that really are at poses (n, 4, 4).

    First order: the arm's error, a few mm, is taken from the nearest place that it can command.
    """
    nominal = arm.nominal
    q, reached = nominal.inverse(poses)
    if not reached.all():
        raise ValueError(f"{name}: number {int(np.argmin(reached))} is out of the arm's reach")
    read = arm.move(q)
    computed = nominal.forward(read)
    error = arm.true_pose() @ invert_transform(computed)  # about the base's origin
    return np.asarray(invert_transform(error) @ poses)
