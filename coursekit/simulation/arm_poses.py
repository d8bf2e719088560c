"""Where an arm, a camera and a board are by default, and joint configurations to calibrate with.

A careful session turns the gripper by 30 degrees or more about at least two axes with the board in
view: `careful_poses` takes, from many random configurations, those that turn farthest. What people
do instead (a grid of translations at one orientation, turns about one axis only, turns of a few
degrees) was searched for once, by tools/degenerate_poses.py, and is kept in data/.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arm import Arm
from coursekit.arrays import Bools, Floats, Integers
from coursekit.boards import Board
from coursekit.boards.board import seen
from coursekit.checks import choice, number, settle, transform, whole
from coursekit.geometry import Intrinsics, make_transform
from coursekit.hand_eye.poses import MOUNTS, Mount, camera_board
from coursekit.specifications import DATA
from coursekit.words import say

SMALLEST_SQUARE_PX = 14.0  # a square's side as seen, below which markers are not read
STEEPEST_RAD = np.radians(60)  # between the line of sight and the board's normal
CLEARANCE_M = 0.02  # of arm, camera and a held board above the table
WIDE_TURN_RAD = np.radians(30)  # a careful session turns so far to either side about two axes
CANDIDATES_A_POSE = 6  # of a careful session, from which distant ones are taken
SEARCHED_AT_LEAST, SEARCHED_A_POSE = 100_000, 4_000  # random configurations before giving up
FINGERS_M = 0.01  # free paper between the fingertips' frame and the pattern
DEGENERATE = DATA / "degenerate_poses.json"


# --- where things are by default ---


def board_on_table(board: Board) -> Floats:
    """T_base_board (4, 4) of a board that lies on the table, pattern up, its top away from the arm.

    Its middle is 0.40 m in front of the base.
    """
    # x right, y towards the arm, z into the table, as one looks from the arm
    R = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return make_transform(R, np.array([0.40, 0.0, 0.0]) - R @ board.middle)


def board_in_gripper(board: Board) -> Floats:
    """T_gripper_board (4, 4) of a plate that the fingers hold by the middle of its bottom edge.

    The fingers close along the gripper's y axis, so that is the plate's normal; the plate sticks
    out forward (x), and with joint_5 at +90 degrees its pattern faces up.
    """
    R = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    half = board.size_m[1] / 2
    return make_transform(R, np.array([FINGERS_M + half, 0.0, 0.0]) - R @ board.middle)


def over_the_shoulder() -> Floats:
    """T_base_camera (4, 4) of a camera beside and above the arm's shoulder, its image upright."""
    at = np.array([-0.12, 0.18, 0.75])
    forward = np.array([0.28, 0.0, 0.25]) - at
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return make_transform(np.column_stack([right, np.cross(forward, right), forward]), at)


# --- what is fixed to what, and what the camera sees ---


@dataclass(frozen=True, eq=False)
class Setup:
    """An arm, a camera and a board, and what of them is fixed to what.

    mount "eye_in_hand": X = T_gripper_camera and Y = T_base_board; "eye_to_hand": X = T_base_camera
    and Y = T_gripper_board. board: none of the old origin. share: how many of its corners the
    camera must see, 0 to 1. turn_rad: how far the board may be turned from straight on and upright,
    about any axis; a camera on its head would twist its cable off. Raises ValueError for another
    mount or transforms that are not rigid.
    """

    arm: Arm
    mount: Mount
    X: Floats
    Y: Floats
    intrinsics: Intrinsics
    board: Board
    share: float = 1.0
    turn_rad: float = np.radians(60)

    def __post_init__(self) -> None:
        choice("mount", self.mount, MOUNTS)
        settle(self, X=transform("X", self.X), Y=transform("Y", self.Y))
        number("share", self.share, "more than 0 and at most 1", above=0.0, most=1.0)

    def T_camera_board(self, T_base_gripper: Floats) -> Floats:
        """The board in the camera (n, 4, 4) for gripper poses (n, 4, 4)."""
        return camera_board(T_base_gripper, self.X, self.Y, self.mount)

    def sees(self, T_base_gripper: Floats) -> Bools:
        """(n,): whether enough of the board is in view, from the front, and large enough."""
        T = self.T_camera_board(T_base_gripper)
        good = self._faces(T)
        corners = seen(self.board.points, T[good], self.intrinsics)
        good[good] = corners.mean(axis=-1) >= self.share - 1e-9
        return good

    def allows(self, q: Floats) -> Bools:
        """(n,): whether the arm can hold still at q (n, 6), rad, and the camera then `sees`.

        Inside the limits, the arm free, and a board in the gripper above the table.
        """
        T = self.arm.forward(q)
        # most fail the first test, so the costly ones come last and see only what is left
        left = np.flatnonzero(self._faces(self.T_camera_board(T)) & self.arm.within_limits(q))
        if self.mount == "eye_to_hand":
            outline = self.Y[:3, :3] @ self.board.outline.T + self.Y[:3, 3:]
            heights = T[left, 2, :3] @ outline + T[left, 2, 3:]
            left = left[(heights >= CLEARANCE_M).all(axis=-1)]
        left = left[self.sees(T[left])]
        left = left[self.arm.is_free(q[left], CLEARANCE_M)]
        return np.isin(np.arange(len(q)), left)

    def upright(self, T_camera_board: Floats) -> Floats:
        """1 + 2 cos of the angle (n,) by which boards (n, 4, 4) are turned from upright."""
        return np.einsum("nii->n", T_camera_board[:, :3, :3])

    def _faces(self, T: Floats) -> Bools:
        """(n,): whether the board is in front, little enough turned, and its squares large."""
        middle = T[:, :3, :3] @ self.board.middle + T[:, :3, 3]
        facing = (middle * T[:, :3, 2]).sum(axis=1) / np.linalg.norm(middle, axis=1)
        focal = min(self.intrinsics.fx, self.intrinsics.fy)
        with np.errstate(divide="ignore"):
            side_px = focal * self.board.square_m * facing / middle[:, 2]
        large = (middle[:, 2] > 0) & (side_px >= SMALLEST_SQUARE_PX)
        upright = self.upright(T) >= 1 + 2 * np.cos(self.turn_rad)
        return large & upright & (facing >= np.cos(STEEPEST_RAD))


# --- careful sessions ---


def careful_poses(
    setup: Setup, rng: np.random.Generator, n: int, pool: Floats | None = None
) -> Floats:
    """n joint configurations (n, 6), rad, that the setup allows and that turn far about two axes.

    From CANDIDATES_A_POSE times as many random ones, each next one is that which turns farthest
    from all taken so far. pool (m, 6): configurations from `random_poses` to draw these from, which
    saves the search when many sessions are made with one setup. Raises ValueError when the arm has
    too few, or none that turn so far.
    """
    n = whole("n", n, "at least 3 poses", least=3)
    if pool is None:
        pool = random_poses(setup, rng, CANDIDATES_A_POSE * n)
    whole("pool", len(pool), f"at least {n} configurations", least=n)
    q = pool[rng.permutation(len(pool))[: CANDIDATES_A_POSE * n]]
    q = q[_farthest(setup.arm.forward(q)[:, :3, :3], n)]
    turns = half_turns(setup.arm.forward(q))
    if turns[1] < WIDE_TURN_RAD:
        facts = {"turn": np.degrees(turns[1]), "least": np.degrees(WIDE_TURN_RAD)}
        raise ValueError(say("simulation.narrow_turns", n=n, **facts))
    return q


def random_poses(setup: Setup, rng: np.random.Generator, n: int) -> Floats:
    """n joint configurations (n, 6), rad, uniform over the joints' ranges among those allowed."""
    low, high = setup.arm.limits.T
    found, tried, batch = np.empty((0, 6)), 0, 4000
    while len(found) < n and tried < SEARCHED_AT_LEAST + n * SEARCHED_A_POSE:
        q = rng.uniform(low, high, (batch, 6))
        found = np.concatenate([found, q[setup.allows(q)]])
        tried += batch
        batch = 20_000
    if len(found) < n:
        raise ValueError(say("simulation.few_in_view", n=n, found=len(found), tried=tried))
    return found[:n]


def _farthest(R: Floats, n: int) -> Integers:
    """The indices of n rotations of (m, 3, 3), each as far as can be from those before it."""
    taken = [0]
    closest = np.full(len(R), np.inf)
    for _ in range(n - 1):
        # trace(R_a^T R_b) = 1 + 2 cos(angle): the smallest trace is the largest turn
        closest = np.minimum(closest, -np.einsum("nij,ij->n", R, R[taken[-1]]))
        taken.append(int(closest.argmax()))
    return np.array(taken)


def half_turns(T_base_gripper: Floats) -> Floats:
    """How far poses (n, 4, 4) turn to either side about their main axes, (3,) rad, largest first.

    Rotation vectors from the mean orientation, along their principal directions: half the range.
    """
    R = Rotation.from_matrix(T_base_gripper[:, :3, :3])
    vectors = (R.mean().inv() * R).as_rotvec()
    _, axes = np.linalg.eigh(vectors.T @ vectors)
    return np.sort(np.ptp(vectors @ axes, axis=0) / 2)[::-1]


# --- sessions that cannot determine the mount ---


@cache
def degenerate_poses(mount: Mount, design: str) -> Floats:
    """Joint configurations (4, 25, 6), rad, of sessions that cannot work: four of each design.

    design: "grid", 5 x 5 places in a plane, 25 mm apart, at one orientation; "single_axis", turns
    of up to 30 degrees about the vertical, in order; "small_rotations", of up to 3 degrees about
    any axis. The arm is allowed to go there in the course's own rig of this mount, and sees the
    board.

    >>> degenerate_poses("eye_in_hand", "grid").shape
    (4, 25, 6)
    """
    return np.array(json.loads(DEGENERATE.read_text("utf-8"))[mount][design])
