"""The frames of the two mounts, and which directions of X a set of arm poses determines.

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

A small motion of a pose is a twist (omega, v), rad and m, as in `geometry.turned`: the body turns
about its own origin and is shifted, both along the axes of the frame in which its pose is given; so
a covariance of (omega, v) can be read directly: v is the position's.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import ArrayLike, Floats
from coursekit.checks import array, choice, transform, transforms, want
from coursekit.geometry import cross_matrix, invert_transform, make_transform
from coursekit.words import say, up_to, wrapped

Mount = Literal["eye_in_hand", "eye_to_hand"]
MOUNTS: tuple[Mount, ...] = ("eye_in_hand", "eye_to_hand")
FRAMES = {
    "eye_in_hand": ("T_gripper_camera", "T_base_board"),
    "eye_to_hand": ("T_base_camera", "T_gripper_board"),
}
WRITTEN_TOLERANCE = 1e-4  # of R R^T: poses are often written with five digits
# What a pair of pose and image scatters by about and along each axis, (omega, v), rad and m.
SCATTER = np.repeat([np.radians(0.1), 0.5e-3], 3)
LEVER_M = 0.3  # a rotation of X counts by what it does this far in front of the camera
NOTHING_MM = 1e9  # the standard deviation of what is not known at all
IN_METRES = np.array([LEVER_M, LEVER_M, LEVER_M, 1.0, 1.0, 1.0])  # times (omega, v)
FREE_M = 0.03  # a direction known no better than this is free: nobody would mount a camera so


def check_poses(name: str, value: ArrayLike, least: int = 1) -> Floats:
    """`value` as (n, 4, 4) rigid transforms; a ValueError names the argument and the index.

    Rotations that were written with few digits are replaced by the nearest exact ones. least: how
    many poses there must be.
    """
    poses = array(name, value, (None, 4, 4)).copy()
    want(len(poses) >= least, name, len(poses), f"at least {least} poses")
    for index, pose in enumerate(poses):
        transforms(f"{name}[{index}]", pose, WRITTEN_TOLERANCE)
    poses[:, :3, :3] = nearest_rotation(poses[:, :3, :3])
    return poses


# --- frames ---


def carrier_stand(T_base_gripper: Floats, mount: Mount) -> Floats:
    """T_carrier_stand (n, 4, 4) of arm poses (n, 4, 4); see the module."""
    return T_base_gripper if mount == "eye_to_hand" else invert_transform(T_base_gripper)


def camera_board(T_base_gripper: Floats, X: Floats, Y: Floats, mount: Mount) -> Floats:
    """Where the camera should see the board, T_camera_board (n, 4, 4)."""
    return invert_transform(X) @ carrier_stand(T_base_gripper, mount) @ Y


def stand_board(T_base_gripper: Floats, T_camera_board: Floats, X: Floats, mount: Mount) -> Floats:
    """Where each view puts the board on its stand, (n, 4, 4); all the same if all were right."""
    return invert_transform(carrier_stand(T_base_gripper, mount)) @ X @ T_camera_board


def base_gripper(T_camera_board: Floats, X: Floats, Y: Floats, mount: Mount) -> Floats:
    """The arm poses (n, 4, 4) at which the camera should see the board as it does."""
    return carrier_stand(X @ T_camera_board @ invert_transform(Y), mount)


def by_X_and_Y(T_base_gripper: Floats, X: Floats, Y: Floats, mount: Mount) -> Floats:
    """d twist of T_camera_board / d twists of X, then Y: (n, 6, 12), at arm poses (n, 4, 4).

    Y (4, 4), or (n, 4, 4) where it is another one at each.
    """
    M = carrier_stand(T_base_gripper, mount)
    to_camera = X[:3, :3].T
    board = (M @ Y)[:, :3, 3]  # in the carrier's frame
    columns = np.zeros((len(M), 6, 12))
    columns[:, :3, 0:3] = columns[:, 3:, 3:6] = -to_camera
    columns[:, 3:, 0:3] = to_camera @ cross_matrix(board - X[:3, 3])
    columns[:, :3, 6:9] = columns[:, 3:, 9:12] = to_camera @ M[:, :3, :3]
    return columns


def by_arm_twist(T_base_gripper: Floats, X: Floats, Y: Floats, mount: Mount) -> Floats:
    """d twist of T_camera_board / d twist of the gripper in the base's axes: (n, 6, 6).

    Y as in `by_X_and_Y`.
    """
    in_hand = mount == "eye_in_hand"  # the gripper then moves the camera, and not the board
    board = Y if in_hand else T_base_gripper @ Y
    back = -np.swapaxes(T_base_gripper[:, :3, :3], 1, 2) if in_hand else np.eye(3)
    columns = np.zeros((len(T_base_gripper), 6, 6))
    columns[:, :3, :3] = columns[:, 3:, 3:] = turn = X[:3, :3].T @ back
    columns[:, 3:, :3] = -turn @ cross_matrix(board[..., :3, 3] - T_base_gripper[:, :3, 3])
    return columns


def mean_pose(T: Floats) -> Floats:
    """The mean (4, 4) of poses (n, 4, 4): the chordal mean of the rotations, the mean position."""
    return make_transform(nearest_rotation(T[:, :3, :3].sum(axis=0)), T[:, :3, 3].mean(axis=0))


def nearest_rotation(matrix: Floats) -> Floats:
    """The rotations (..., 3, 3) nearest to matrices (..., 3, 3). Source: Kabsch (1976)."""
    u, _, vt = np.linalg.svd(matrix)
    u[..., 2] *= np.sign(np.linalg.det(u @ vt))[..., None]
    return u @ vt


# --- what poses determine ---


@dataclass(frozen=True, eq=False, repr=False)
class Observability:
    """What the poses determine of X.

    singular_values (6,): of the linearised problem, descending, 1/m: one over the standard
    deviation with which X comes out along each direction. directions (6, 6): rows (omega, v), the
    directions in the frame that X is given in, rotations measured by what they do at `LEVER_M`.
    free: the undetermined ones, in words. turns_deg (3,): rms rotation between poses about their
    three principal axes, the first of which is axis (3,). largest_turn_deg: between any two poses.
    poses: how many there are.
    """

    singular_values: Floats
    directions: Floats
    free: tuple[str, ...]
    turns_deg: Floats
    axis: Floats
    largest_turn_deg: float
    poses: int

    @property
    def sigma_mm(self) -> Floats:
        """Standard deviation along each direction, mm, ascending; infinite if nothing is known."""
        with np.errstate(divide="ignore"):
            return 1e3 / self.singular_values

    def __repr__(self) -> str:
        turns = ", ".join(f"{turn:.1f}" for turn in self.turns_deg)
        known = np.minimum(self.sigma_mm, NOTHING_MM)[:, None] * self.directions
        turn, shift = known[:, :3] / 1e3, known[:, 3:]  # rad, mm: by direction, along each axis
        worst = np.degrees(np.linalg.norm(turn, axis=0).max()), np.linalg.norm(shift, axis=0).max()
        deg, mm = (up_to(float(s), 1e4, 2 if s < 10 else 0) for s in worst)
        free = "; ".join(self.free)  # of what is free nothing is known, whatever the poses' noise
        sizes = {"rotation": f"{deg} deg", "translation": f"{mm} mm"}
        determined = [size for what, size in sizes.items() if what not in free]
        facts = {"turns": turns, "sizes": " and ".join(determined) or "nothing"}
        left = f"NOT determined: {free}." if free else "All of X is determined."
        lines = say("hand_eye.observable", known=self, left=left, **facts).splitlines()
        return "\n".join(map(wrapped, lines))


def observability(
    T_base_gripper: ArrayLike, mount: Mount, X: ArrayLike | None = None, Y: ArrayLike | None = None
) -> Observability:
    """What arm poses (n, 4, 4), m, determine of X, before any solver runs.

    One pair of arm pose and image is taken to scatter by 0.1 deg and 0.5 mm (1 sigma). X, Y (4, 4),
    m: where camera and board roughly are; without them the camera is taken to sit at its carrier's
    origin, and the board where it is nearest to it. They change how well X is determined and where
    an axis lies, not which directions are free. Raises ValueError for poses that are none.

    >>> grid = np.tile(np.eye(4), (3, 1, 1))
    >>> grid[1:, :3, 3] = [[0.1, 0.0, 0.0], [0.0, 0.1, 0.0]]
    >>> observability(grid, "eye_in_hand").free
    ('translation along all axes is free',)
    """
    poses = check_poses("T_base_gripper", T_base_gripper, 2)
    choice("mount", mount, MOUNTS)
    M = carrier_stand(poses, mount)
    X = np.eye(4) if X is None else transform("X", X)
    Y = _nearest_stand(M, X) if Y is None else transform("Y", Y)
    by_both = by_X_and_Y(poses, X, Y, mount) / SCATTER[:, None]
    by_X, by_Y = np.hsplit(by_both.reshape(-1, 12), 2)
    q, _ = np.linalg.qr(by_Y)
    seen_of_X = by_X - q @ (q.T @ by_X)  # what Y can imitate taken out
    _, values, directions = np.linalg.svd(seen_of_X / IN_METRES)
    values = np.where(values < 1e-9 * values[0], 0.0, values)
    free = tuple(_in_words(directions[values * FREE_M < 1.0]))
    # Each pose against the mean one, about the carrier's axes, because X is given there.
    from_mean = Rotation.from_matrix(M[:, :3, :3] @ mean_pose(M)[:3, :3].T).as_rotvec()
    _, turns, axes = np.linalg.svd(np.degrees(from_mean) / math.sqrt(len(M)), full_matrices=False)
    cosine = (np.einsum("nij,mij->nm", M[:, :3, :3], M[:, :3, :3]).min() - 1) / 2
    largest = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
    return Observability(values, directions / IN_METRES, free, turns, axes[0], largest, len(poses))


def _nearest_stand(M: Floats, X: Floats) -> Floats:
    """Y with the board where, over all T_carrier_stand (n, 4, 4), it is nearest to the camera."""
    rows, right = M[:, :3, :3].reshape(-1, 3), (X[:3, 3] - M[:, :3, 3]).ravel()
    return make_transform(np.eye(3), np.linalg.lstsq(rows, right, rcond=None)[0])


def _in_words(weak: Floats) -> list[str]:
    """Free directions as phrases; rows (k, 6) are (omega, v), the former by what they do, in m."""
    # Turns: the span of the omegas. Pure shifts: combinations of the rows whose omega vanishes.
    u, turns, axes = np.linalg.svd(weak[:, :3])
    turning = int(np.sum(turns > 0.05))
    _, sizes, along = np.linalg.svd((u.T @ weak)[turning:, 3:])
    rank = int(np.sum(sizes > 0.05))
    words = []
    if turning:
        words.append(f"rotation about {_named(axes[:turning])} is free")
    if rank:
        words.append(f"translation along {_named(along[:rank])} is free")
    return words


def _named(axes: Floats) -> str:
    if len(axes) == 3:
        return "all axes"
    if len(axes) == 2:
        return f"all axes across {axis_text(np.cross(axes[0], axes[1]))}"
    return f"the common axis {axis_text(axes[0])}"


def axis_text(axis: Floats) -> str:
    """The direction (3,) of an axis, whichever way it points: "(0, 0.6, 0.8)".

    >>> axis_text(np.array([0.0, -3.0, -4.0]))
    '(0, 0.6, 0.8)'
    """
    axis = axis / np.linalg.norm(axis) * np.sign(axis[np.argmax(np.abs(axis))])
    parts = [0.0 if abs(part) < 0.005 else part for part in axis]
    return "(" + ", ".join(f"{part:.2f}".rstrip("0").rstrip(".") for part in parts) + ")"
