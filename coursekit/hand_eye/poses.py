"""The frames of the two mounts, and small motions of poses.

Both mounts are one problem. The camera is bolted to its carrier and the board to its stand:

    mount           carrier   stand     X                  Y
    eye_in_hand     gripper   base      T_gripper_camera   T_base_board
    eye_to_hand     base      gripper   T_base_camera      T_gripper_board

    T_camera_board = X^-1 T_carrier_stand Y,

where T_carrier_stand is T_base_gripper for eye-to-hand and its inverse for eye-in-hand. Two poses
i and j without Y give A X = X B with A = T_carrier_stand(j) T_carrier_stand(i)^-1 and
B = T_camera_board(j) T_camera_board(i)^-1; for eye-in-hand A is T_base_gripper(j)^-1
T_base_gripper(i), the form in most books, and for eye-to-hand the same with every arm pose
inverted.

A small motion of a pose T is a twist (omega, v), rad and m: R <- exp(omega) R, t <- t + v. It turns
the body about its own origin and shifts it, both along the axes of the frame in which T is given;
so a covariance of (omega, v) can be read directly: v is the position's.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from coursekit.arrays import ArrayLike, Floats
from coursekit.checks import transform
from coursekit.geometry import invert_transform

Mount = Literal["eye_in_hand", "eye_to_hand"]
MOUNTS = ("eye_in_hand", "eye_to_hand")
FRAMES = {
    "eye_in_hand": ("T_gripper_camera", "T_base_board"),
    "eye_to_hand": ("T_base_camera", "T_gripper_board"),
}
ROTATION_TOLERANCE = 1e-4  # poses are often written with five digits


# --- checks ---


def check_mount(mount: str) -> Mount:
    """`mount`, or a ValueError."""
    if mount not in MOUNTS:
        raise ValueError(f"mount: got {mount!r}, want one of {', '.join(MOUNTS)}")
    return mount  # type: ignore[return-value]


def check_poses(name: str, value: ArrayLike, at_least: int = 1) -> Floats:
    """`value` as (n, 4, 4) rigid transforms; a ValueError names the argument and the index.

    Rotations that were written with few digits are replaced by the nearest exact ones.
    """
    poses = np.asarray(value)
    if poses.dtype.kind not in "fiu" or poses.ndim != 3 or poses.shape[1:] != (4, 4):
        raise ValueError(f"{name}: got {poses.dtype} of shape {poses.shape}, want (n, 4, 4)")
    if len(poses) < at_least:
        raise ValueError(f"{name}: got {len(poses)} poses, want at least {at_least}")
    poses = poses.astype(np.float64)
    for index, pose in enumerate(poses):
        trouble = _trouble(pose)
        if trouble:
            raise ValueError(f"{name}[{index}]: {trouble}")
    poses[:, :3, :3] = nearest_rotation(poses[:, :3, :3])
    return poses


def _trouble(T: Floats) -> str:
    """What keeps one (4, 4) from being a rigid transform, "" if nothing does."""
    if not np.isfinite(T).all():
        return "has NaN or infinite entries"
    if not np.allclose(T[3], [0, 0, 0, 1], atol=1e-9):
        return f"the last row is {T[3].tolist()}, want (0, 0, 0, 1); is the matrix transposed?"
    off = float(np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max())
    if off > ROTATION_TOLERANCE:
        return f"the upper left (3, 3) is no rotation: R R^T is off by {off:.1e}"
    if np.linalg.det(T[:3, :3]) < 0:
        return "the upper left (3, 3) is a reflection (determinant -1), no rotation"
    return ""


# --- frames and small motions ---


def carrier_stand(T_base_gripper: Floats, mount: Mount) -> Floats:
    """T_carrier_stand (n, 4, 4) of arm poses (n, 4, 4); see the module."""
    return T_base_gripper if mount == "eye_to_hand" else invert_transform(T_base_gripper)


def camera_board(T_base_gripper: Floats, X: Floats, Y: Floats, mount: Mount) -> Floats:
    """Where the camera should see the board, T_camera_board (n, 4, 4)."""
    return invert_transform(X) @ carrier_stand(T_base_gripper, mount) @ Y


def turned(T: Floats, twists: Floats) -> Floats:
    """T (..., 4, 4) after twists (..., 6): the inverse of `arm.pose_difference`."""
    from scipy.spatial.transform import Rotation

    flat = np.broadcast_to(T, (*twists.shape[:-1], 4, 4)).reshape(-1, 4, 4).copy()
    steps = twists.reshape(-1, 6)
    flat[:, :3, :3] = Rotation.from_rotvec(steps[:, :3]).as_matrix() @ flat[:, :3, :3]
    flat[:, :3, 3] += steps[:, 3:]
    return flat.reshape(*twists.shape[:-1], 4, 4)


def mean_pose(T: Floats) -> Floats:
    """The mean of poses (n, 4, 4): the chordal mean of the rotations, the mean position."""
    mean = np.eye(4)
    mean[:3, :3] = nearest_rotation(T[:, :3, :3].sum(axis=0))
    mean[:3, 3] = T[:, :3, 3].mean(axis=0)
    return mean


def nearest_rotation(matrix: Floats) -> Floats:
    """The rotations (..., 3, 3) nearest to matrices. Source: Kabsch (1976)."""
    u, _, vt = np.linalg.svd(matrix)
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


def check_one(name: str, value: ArrayLike) -> Floats:
    """`value` as one (4, 4) rigid transform."""
    return transform(name, value)


def same_number(arm_poses: int, seen: int) -> None:
    if arm_poses != seen:
        raise ValueError(
            f"seen: got {seen}, T_base_gripper has {arm_poses}: one arm pose belongs to each image "
            "(an image without a board takes its arm pose with it)"
        )
