"""Joint configurations for hand-eye calibration: careful sessions, and the ones that cannot work.

A careful session turns the gripper by 30 degrees or more about at least two axes with the board in
view. The degenerate ones are what people do instead: a grid of translations at one orientation,
turns about one axis only, turns of a few degrees.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arm import Arm
from coursekit.arrays import ArrayLike, Floats, Mask, NDArray
from coursekit.boards import Board
from coursekit.checks import transform, transforms
from coursekit.geometry import (
    Intrinsics,
    deproject,
    invert_transform,
    make_transform,
    project,
    undistort,
)

Mount = Literal["eye_in_hand", "eye_to_hand"]

BORDER_PX = 6.0  # a corner nearer to the image's border has no room for its refinement window
SMALLEST_SQUARE_PX = 14.0  # a square's side as seen, below which markers are not read
STEEPEST_RAD = np.radians(60)  # between the line of sight and the board's normal
CLEARANCE_M = 0.02  # of arm, camera and a held board above the table
WIDE_TURN_RAD = np.radians(30)  # a careful session turns so far to either side about two axes
TRIES = 6  # places in the image and ranges that are tried for each pose of a degenerate set
ASIDE, NEARER = 0.12, 0.15  # how much these differ: of the image's size, and of the range
CHOICE = 6  # candidates for each pose of a careful session, from which distant ones are taken
TRIES_AT_LEAST, TRIES_A_POSE = 100_000, 4_000  # random configurations before a search gives up
FINGERS_M = 0.01  # free paper between the fingertips' frame and the pattern


# --- where things are by default ---


def board_on_table(
    board: Board, centre_m: tuple[float, float] = (0.40, 0.0), turn_rad: float = 0.0
) -> Floats:
    """T_base_board (4, 4) of a board that lies on the table, pattern up, its top away from the arm.

    centre_m: x and y of the pattern's middle in the base. turn_rad: about the vertical.
    """
    # x right, y towards the arm, z into the table, as one looks from the arm
    axes = np.array([[0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]).T
    R = Rotation.from_euler("z", turn_rad).as_matrix() @ axes
    return make_transform(R, np.array([*centre_m, 0.0]) - R @ _middle(board))


def board_in_gripper(board: Board) -> Floats:
    """T_gripper_board (4, 4) of a plate that the fingers hold by the middle of its bottom edge.

    The fingers close along the gripper's y axis, so that is the plate's normal; the plate sticks
    out forward (x), and with joint_5 at +90 degrees its pattern faces up.
    """
    x, y, z = np.array([0.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0]), np.array([0.0, -1.0, 0.0])
    if board.old_origin:  # its y points up the pattern and its z out of it
        y, z = -y, -z
    R = np.column_stack([x, y, z])
    half = board.size_m[1] / 2
    return make_transform(R, np.array([FINGERS_M + half, 0.0, 0.0]) - R @ _middle(board))


def over_the_shoulder(
    at_m: tuple[float, float, float] = (-0.12, 0.18, 0.75),
    looks_at_m: tuple[float, float, float] = (0.28, 0.0, 0.25),
) -> Floats:
    """T_base_camera (4, 4) of a camera beside and above the arm's shoulder, its image upright."""
    at = np.array(at_m)
    forward = np.array(looks_at_m) - at
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    return make_transform(np.column_stack([right, np.cross(forward, right), forward]), at)


def _middle(board: Board) -> Floats:
    """The middle of the pattern in the board's frame, (3,) m, wherever its origin is."""
    return np.asarray(board.points.mean(axis=0))


# --- what is fixed to what, and what the camera sees ---


@dataclass(frozen=True, eq=False)
class Setup:
    """An arm, a camera and a board, and what of them is fixed to what.

    mount "eye_in_hand": X = T_gripper_camera and Y = T_base_board; "eye_to_hand": X = T_base_camera
    and Y = T_gripper_board. share: how many of the board's corners the camera must see, 0 to 1.
    turn_rad: how far the board may be turned from straight on and upright, about any axis; a
    camera on its head would twist its cable off. Raises ValueError for another mount or
    transforms that are not rigid.
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
        if self.mount not in get_args(Mount):
            raise ValueError(f"mount: got {self.mount!r}, want 'eye_in_hand' or 'eye_to_hand'")
        for name in ("X", "Y"):
            object.__setattr__(self, name, transform(name, getattr(self, name)))
        if not 0 < self.share <= 1:
            raise ValueError(f"share: got {self.share!r}, want more than 0 and at most 1")

    def T_camera_board(self, T_base_gripper: ArrayLike) -> Floats:
        """The board in the camera (..., 4, 4) for gripper poses (..., 4, 4)."""
        return self._seen(transforms("T_base_gripper", T_base_gripper))

    def T_base_gripper(self, T_camera_board: ArrayLike) -> Floats:
        """The gripper poses (..., 4, 4) at which the camera has the board at (..., 4, 4)."""
        arm = self.X @ transforms("T_camera_board", T_camera_board) @ invert_transform(self.Y)
        return invert_transform(arm) if self.mount == "eye_in_hand" else arm

    def sees(self, T_base_gripper: ArrayLike) -> Mask:
        """(...): whether enough of the board is in view, from the front, and large enough."""
        T = self.T_camera_board(T_base_gripper)
        flat = T.reshape(-1, 4, 4)
        seen = self._faces(flat)
        seen[seen] = self._corners(flat[seen]) >= self.share - 1e-9
        return seen.reshape(T.shape[:-2])

    def allows(self, q: ArrayLike) -> Mask:
        """(...): whether the arm can hold still at q (..., 6), rad, and the camera then `sees`.

        Inside the limits, the arm free, and a board in the gripper above the table.
        """
        q = np.asarray(q, dtype=np.float64)
        flat = q.reshape(-1, 6)
        T = self.arm.forward(flat)
        # most fail the first test, so the costly ones come last and see only what is left
        left = np.flatnonzero(self._faces(self._seen(T)) & self.arm.within_limits(flat))
        if self.mount == "eye_to_hand":
            left = left[self._held_above_table(T[left])]
        left = left[self.sees(T[left])]
        left = left[self.arm.is_free(flat[left], CLEARANCE_M)]
        allowed = np.zeros(len(flat), bool)
        allowed[left] = True
        return allowed.reshape(q.shape[:-1])

    def _seen(self, T: Floats) -> Floats:
        arm = _inverse(T) if self.mount == "eye_in_hand" else T
        return np.asarray(_inverse(self.X) @ arm @ self.Y)

    def _held_above_table(self, T: Floats) -> Mask:
        outline = self.Y[:3, :3] @ _outline(self.board).T + self.Y[:3, 3:]
        heights = T[:, 2, :3] @ outline + T[:, 2, 3:]
        return np.asarray((heights >= CLEARANCE_M).all(axis=-1))

    def _faces(self, T: Floats) -> Mask:
        """(n,): whether the board is in front, little enough turned, and its squares large."""
        middle = T[:, :3, :3] @ _middle(self.board) + T[:, :3, 3]
        into = T[:, :3, 2] * (-1.0 if self.board.old_origin else 1.0)
        facing = (middle * into).sum(axis=1) / np.linalg.norm(middle, axis=1)
        focal = min(self.intrinsics.fx, self.intrinsics.fy)
        with np.errstate(divide="ignore"):
            side_px = focal * self.board.square_m * facing / middle[:, 2]
        return (
            (middle[:, 2] > 0)
            & (facing >= np.cos(STEEPEST_RAD))
            & (side_px >= SMALLEST_SQUARE_PX)
            & (_upright_trace(self.board, T) >= 1 + 2 * np.cos(self.turn_rad))
        )

    def _corners(self, T: Floats) -> Floats:
        """(n,): the share of the corners that lie in the image, BORDER_PX from its border."""
        lens = self.intrinsics
        points = self.board.points @ np.swapaxes(T[:, :3, :3], -1, -2) + T[:, None, :3, 3]
        pixels = project(points, lens.K, lens.dist)
        high = np.array(lens.size) - 1 - BORDER_PX
        seen = ((pixels >= BORDER_PX) & (pixels <= high)).all(axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = np.linalg.norm(points[..., :2] / points[..., 2:], axis=-1)
        return np.asarray((seen & (slope <= _widest_slope(lens))).mean(axis=-1))


def _upright_trace(board: Board, T: Floats) -> Floats:
    """1 + 2 cos of the angle (n,) by which boards in the camera are turned from upright."""
    upright = np.array([1.0, -1.0, -1.0]) if board.old_origin else np.ones(3)
    return np.asarray(np.einsum("nii,i->n", T[:, :3, :3], upright))


def _inverse(T: Floats) -> Floats:
    """As `invert_transform`, without its checks: a search inverts a hundred thousand."""
    inverse = np.empty_like(T)
    inverse[..., :3, :3] = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, 3:] = -inverse[..., :3, :3] @ T[..., :3, 3:]
    inverse[..., 3, :] = [0.0, 0.0, 0.0, 1.0]
    return inverse


def _outline(board: Board) -> Floats:
    """The four outer corners of the pattern in the board's frame, (4, 3) m."""
    width, height = board.size_m
    corners = np.array([[x, y, 0.0] for x in (-0.5, 0.5) for y in (-0.5, 0.5)])
    return _middle(board) + corners * [width, height, 0.0]


def _widest_slope(lens: Intrinsics) -> float:
    """The largest sqrt(X^2 + Y^2) / Z in the image; past its fold a lens brings points back in."""
    across, down = np.arange(lens.width), np.arange(lens.height)
    rim = [(u, v) for u in across[:: max(lens.width // 32, 1)] for v in (0, lens.height - 1)]
    rim += [(u, v) for v in down[:: max(lens.height // 32, 1)] for u in (0, lens.width - 1)]
    rim.append((lens.width - 1, lens.height - 1))
    xy = (np.array(rim) - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
    if lens.dist is not None:
        xy, found = undistort(xy, lens.dist)
        xy = xy[found]
    return float(np.linalg.norm(xy, axis=1).max(initial=0.0)) if len(xy) else np.inf


# --- careful sessions ---


def eye_in_hand_poses(
    arm: Arm,
    T_base_board: ArrayLike,
    T_gripper_camera: ArrayLike,
    intrinsics: Intrinsics,
    board: Board,
    rng: np.random.Generator,
    n: int,
    share: float = 1.0,
) -> Floats:
    """n joint configurations (n, 6), rad, of a careful session with the camera on the gripper.

    Inside the limits, fingertip and camera above the table, the board in view; turned by at least
    30 degrees to either side about two axes or more. Raises ValueError when there are none.
    """
    X, Y = np.asarray(T_gripper_camera, float), np.asarray(T_base_board, float)
    return careful_poses(Setup(arm, "eye_in_hand", X, Y, intrinsics, board, share), rng, n)


def eye_to_hand_poses(
    arm: Arm,
    T_base_camera: ArrayLike,
    T_gripper_board: ArrayLike,
    intrinsics: Intrinsics,
    board: Board,
    rng: np.random.Generator,
    n: int,
    share: float = 1.0,
) -> Floats:
    """n joint configurations (n, 6), rad, of a careful session with the board in the gripper.

    As `eye_in_hand_poses`; the board stays above the table as well.
    """
    X, Y = np.asarray(T_base_camera, float), np.asarray(T_gripper_board, float)
    return careful_poses(Setup(arm, "eye_to_hand", X, Y, intrinsics, board, share), rng, n)


def careful_poses(
    setup: Setup, rng: np.random.Generator, n: int, pool: Floats | None = None
) -> Floats:
    """n joint configurations (n, 6), rad, that the setup allows and that turn far about two axes.

    From CHOICE times as many random ones, each next one is that which turns farthest from all
    taken so far. pool (m, 6): configurations from `random_poses` to draw these from, which saves
    the search when many sessions are made with one setup. Raises ValueError when the arm has too
    few, or none that turn so far.
    """
    if isinstance(n, bool) or not isinstance(n, (int, np.integer)) or n < 3:
        raise ValueError(f"n: got {n!r}, want at least 3 poses")
    if pool is None:
        pool = random_poses(setup, rng, CHOICE * int(n))
    elif len(pool) < n:
        raise ValueError(f"pool: got {len(pool)} configurations, want at least {n}")
    q = pool[rng.permutation(len(pool))[: CHOICE * int(n)]]
    q = q[_farthest(setup.arm.forward(q)[:, :3, :3], int(n))]
    turns = half_turns(setup.arm.forward(q))
    if turns[1] < WIDE_TURN_RAD:
        raise ValueError(
            f"n: {n} poses turn only {np.degrees(turns[1]):.0f} degrees to either side about their "
            f"second axis, want {np.degrees(WIDE_TURN_RAD):.0f}: take more poses or move the board"
        )
    return q


def random_poses(setup: Setup, rng: np.random.Generator, n: int) -> Floats:
    """n joint configurations (n, 6), rad, uniform over the joints' ranges among those allowed."""
    low, high = setup.arm.limits.T
    found, tried, batch = np.empty((0, 6)), 0, 4000
    while len(found) < n and tried < TRIES_AT_LEAST + n * TRIES_A_POSE:
        q = rng.uniform(low, high, (batch, 6))
        found = np.concatenate([found, q[setup.allows(q)]])
        tried += batch
        batch = 20_000
    if len(found) < n:
        raise ValueError(
            f"n: got {n}, but only {len(found)} of {tried} random configurations have the board in "
            "view: move the board or the camera"
        )
    return found[:n]


def _farthest(R: Floats, n: int) -> NDArray[np.int64]:
    """The indices of n rotations of (m, 3, 3), each as far as can be from those before it."""
    taken = [0]
    closest = np.full(len(R), np.inf)
    for _ in range(n - 1):
        # trace(R_a^T R_b) = 1 + 2 cos(angle): the smallest trace is the largest turn
        closest = np.minimum(closest, -np.einsum("nij,ij->n", R, R[taken[-1]]))
        taken.append(int(closest.argmax()))
    return np.array(taken)


def half_turns(T_base_gripper: ArrayLike) -> Floats:
    """How far poses (n, 4, 4) turn to either side about their main axes, (3,) rad, largest first.

    Rotation vectors from the mean orientation, along their principal directions: half the range.
    """
    R = Rotation.from_matrix(transforms("T_base_gripper", T_base_gripper)[:, :3, :3])
    vectors = (R.mean().inv() * R).as_rotvec()
    _, axes = np.linalg.eigh(vectors.T @ vectors)
    return np.sort(np.ptp(vectors @ axes, axis=0) / 2)[::-1]


# --- sessions that cannot determine the mount ---


def translation_grid(
    setup: Setup, rng: np.random.Generator, side: int = 5, step_m: float = 0.025
) -> Floats:
    """Joint configurations (side^2, 6), rad: a horizontal grid of positions at one orientation.

    Raises ValueError when no orientation has the whole grid in reach and the board in view.
    """
    offsets = step_m * (np.arange(side) - (side - 1) / 2)
    steps = np.stack([*np.meshgrid(offsets, offsets, indexing="ij"), np.zeros((side, side))], -1)
    for start in np.concatenate([_starts(setup, rng) for _ in range(2)]):
        targets = np.repeat(_aimed(setup, setup.arm.forward(start)[None]), side * side, axis=0)
        targets[:, :3, 3] += steps.reshape(-1, 3)
        q, good = _reach(setup, targets, start)
        if good.all():
            return q
    raise ValueError(
        f"side, step_m: no {side}x{side} grid of {1e3 * step_m:.0f} mm steps is in reach with the "
        "board in view"
    )


def single_axis_poses(
    setup: Setup,
    rng: np.random.Generator,
    n: int,
    axis: ArrayLike = (0.0, 0.0, 1.0),
    turn_rad: float = np.radians(30),
) -> Floats:
    """Joint configurations (n, 6), rad, all turned about one axis from one orientation.

    axis (3,): in the base. turn_rad: the largest angle to either side; the poses' angles are
    spread over it evenly. The positions differ too. Raises ValueError when no start has them all
    in reach and in view.
    """
    along: Floats = np.asarray(axis, dtype=np.float64)
    if along.shape != (3,) or not 0 < np.linalg.norm(along) < np.inf:
        raise ValueError(f"axis: got {along.tolist()}, want a direction (3,)")
    along = along / np.linalg.norm(along)
    angles = np.linspace(-turn_rad, turn_rad, n)
    # The start need not be in the middle of the turns, nor the board upright in all of them.
    shifts = turn_rad * np.array([0.0, 0.5, -0.5, 1.0, -1.0])
    free = replace(setup, turn_rad=np.pi)
    starts = _starts(setup, rng)
    return _turned(free, rng, starts, angles[:, None] * along, shifts[:, None] * along)


def small_rotations(
    setup: Setup, rng: np.random.Generator, n: int, turn_rad: float = np.radians(3)
) -> Floats:
    """Joint configurations (n, 6), rad, about all axes but by no more than turn_rad from one.

    The positions differ too. Raises ValueError as `single_axis_poses` does.
    """
    vectors = rng.normal(size=(n, 3))
    length = turn_rad * np.cbrt(rng.random((n, 1)))  # even over the ball
    vectors = length * vectors / np.linalg.norm(vectors, axis=1, keepdims=True)
    return _turned(setup, rng, _starts(setup, rng), vectors, np.zeros((1, 3)))


def _turned(
    setup: Setup, rng: np.random.Generator, starts: Floats, vectors: Floats, shifts: Floats
) -> Floats:
    """Joint configurations (n, 6) with orientations exp(vectors) exp(shift) of a start's."""
    turns = Rotation.from_rotvec(vectors).as_matrix()
    for start in starts:
        for shift in Rotation.from_rotvec(shifts).as_matrix():
            begin = setup.arm.forward(start)
            begin[:3, :3] = shift @ begin[:3, :3]
            q = _scattered(setup, rng, start, begin, turns)
            if q is not None:
                return q
    raise ValueError("turn_rad: no such poses are in reach with the board in view")


def _scattered(
    setup: Setup, rng: np.random.Generator, start: Floats, begin: Floats, turns: Floats
) -> Floats | None:
    """Configurations (n, 6) for orientations `turns @ begin`, places differing, if all exist."""
    targets = np.repeat(begin[None], len(turns), axis=0)
    targets[:, :3, :3] = turns @ begin[:3, :3]
    q, good = _reach(setup, _aimed(setup, targets[[0, -1]]), start)
    if not good.all():  # the outermost two decide mostly, and cheaply
        return None
    q, missing = np.empty((len(turns), 6)), np.arange(len(turns))
    for attempt in range(TRIES):
        width = 1 - attempt / TRIES  # ask for less as it goes on
        aside = width * rng.uniform(-ASIDE, ASIDE, (len(missing), 2))
        nearness = 1 + width * rng.uniform(-NEARER, NEARER, len(missing))
        aimed = _aimed(setup, targets[missing], aside, nearness)
        found, good = _reach(setup, aimed, start, elsewhere=True)
        q[missing[good]] = found[good]
        missing = missing[~good]
        if not missing.size:
            return q
    return None


def _aimed(
    setup: Setup, T_base_gripper: Floats, aside: ArrayLike = (0.0, 0.0), nearness: ArrayLike = 1.0
) -> Floats:
    """Gripper poses (n, 4, 4) of the same orientations with the board's middle at a chosen pixel.

    aside (n, 2): from the image's middle, or with a fixed camera from where the first pose has
    it, as parts of width and height. nearness (n,): times the range that the first pose has.
    """
    lens = setup.intrinsics
    T = setup.T_camera_board(T_base_gripper)
    first = T[0, :3, :3] @ _middle(setup.board) + T[0, :3, 3]
    # a camera on the arm can look anywhere; in front of a fixed one the arm's reach comes first
    on_arm = setup.mount == "eye_in_hand"
    around = 0.5 * np.array(lens.size) - 0.5 if on_arm else project(first, lens.K, lens.dist)
    pixels = around + np.asarray(aside) * lens.size
    wanted = deproject(pixels, first[2] * np.asarray(nearness), lens.K, lens.dist)
    T[:, :3, 3] = wanted - T[:, :3, :3] @ _middle(setup.board)
    return setup.T_base_gripper(T)


def _starts(setup: Setup, rng: np.random.Generator) -> Floats:
    """Configurations (60, 6) to begin from: straight on and far from the joints' limits first."""
    q = random_poses(setup, rng, 60)
    low, high = setup.arm.limits.T
    room = np.minimum(q - low, high - q).min(axis=1)
    T = setup.T_camera_board(setup.arm.forward(q))
    return q[np.argsort(-room - _upright_trace(setup.board, T) / 2)]


def _reach(
    setup: Setup, targets: Floats, start: Floats, elsewhere: bool = False
) -> tuple[Floats, Mask]:
    """Joint configurations (n, 6) for gripper poses, and whether each is found and allowed.

    elsewhere: also try to get there by configurations that are far from `start`.
    """
    q, good = np.tile(start, (len(targets), 1)), setup.sees(targets)
    q[good], reached = setup.arm.inverse(targets[good], start, elsewhere)
    good[good] = reached & setup.allows(q[good])
    return q, good
