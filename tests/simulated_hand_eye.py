"""Hand-eye sessions at corner level for the tests: exact projection, Gaussian corners."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arm import ArmErrors, FkErrors, SimulatedArm, fk_covariance, widowx
from coursekit.boards import Board, Detection, Detections
from coursekit.geometry import (
    Intrinsics,
    invert_transform,
    make_transform,
    pose_difference,
    project,
    turned,
)
from coursekit.hand_eye import HandEyeResult, HandEyeSession, solve
from coursekit.hand_eye.poses import camera_board

LENS = Intrinsics(
    640, 480, 440.0, 441.0, 322.0, 238.0, "brown_conrady", (-0.05, 0.06, 4e-4, -3e-4, -0.02)
)
BOARD = Board("checkerboard", (10, 7), 0.02)  # 54 corners, 160 x 100 mm
NOISE_PX = 0.1
BORDER_PX = 8.0


def _pose(euler_deg, place) -> np.ndarray:
    return make_transform(Rotation.from_euler("xyz", euler_deg, degrees=True), place)


def typical(mount: str) -> tuple[np.ndarray, np.ndarray]:
    """X and Y of a rig: the maker's wrist camera, or a camera over the shoulder."""
    if mount == "eye_in_hand":
        return widowx().T_gripper_camera, _pose([180, 0, 90], [0.33, -0.08, 0.0])
    return _pose([-125, 0, -90], [-0.12, 0.0, 0.58]), _pose([0, -90, -90], [0.03, -0.08, 0.05])


@dataclass(frozen=True, eq=False)
class Simulated:
    """What a student would have, and the truth. fk: the honest model of the arm's errors."""

    session: HandEyeSession
    X: np.ndarray
    Y: np.ndarray
    fk: FkErrors | None

    @property
    def T(self) -> np.ndarray:
        """The reported arm poses."""
        return self.session.T_base_gripper

    @property
    def exact(self) -> np.ndarray:
        """Where the camera would see the board if the arm were where it says."""
        return camera_board(self.T, self.X, self.Y, self.session.mount)

    def with_poses(self, T_camera_board: np.ndarray | None = None) -> HandEyeSession:
        """The session with poses of the board, exact ones unless given, in place of corners."""
        return replace(self.session, seen=self.exact if T_camera_board is None else T_camera_board)

    def part(self, which: slice) -> Simulated:
        fk = self.fk
        if fk is not None:
            fk = FkErrors(fk.shared[which], fk.sigma, fk.names, fk.each[which])
        rows = np.arange(len(self.session))[which]
        return Simulated(self.session.pick(rows), self.X, self.Y, fk)

    def solve(self, method: str = "refine", **options) -> HandEyeResult:
        return solve(self.session, method, **options)


def holds(result: HandEyeResult, X: np.ndarray, level: float = 0.95) -> np.ndarray:
    """Whether the interval of each of rx, ry, rz, tx, ty, tz holds the truth, (6,)."""
    sigma = np.sqrt(np.diag(result.covariance)[:6])
    return np.abs(pose_difference(result.X, X)) < result.quantile(level) * sigma


def in_view(T_camera_board: np.ndarray) -> np.ndarray:
    """(n,): whether the whole board is in the image, its face to the camera and not too flat."""
    R, t = T_camera_board[:, :3, :3], T_camera_board[:, None, :3, 3]
    at = BOARD.points @ np.swapaxes(R, 1, 2) + t
    pixels = project(at, LENS.K, LENS.dist)
    with np.errstate(invalid="ignore"):
        low = pixels > BORDER_PX
        high = pixels < np.array(LENS.size) - 1 - BORDER_PX
    centre = at.mean(axis=1)
    sight = centre / np.linalg.norm(centre, axis=1, keepdims=True)
    facing = np.einsum("ni,ni->n", R[:, :, 2], sight)
    near = np.linalg.norm(centre, axis=1)
    return (low & high).all(axis=(1, 2)) & (facing > 0.6) & (near < 0.6)


@cache
def reachable(mount: str, count: int = 3000) -> np.ndarray:
    """Joint angles (count, 6) at which a typical rig sees the board; the same every time."""
    arm, rng = widowx(), np.random.default_rng(0)
    X, Y = typical(mount)
    low, high = arm.limits.T
    found = np.empty((0, 6))
    while len(found) < count:
        q = rng.uniform(low, high, (20000, 6))
        if len(found) > 20:  # explore around what is known
            q = found[rng.integers(len(found), size=20000)] + 0.3 * rng.normal(size=(20000, 6))
            q = q[((q > low) & (q < high)).all(axis=1)]
        q = q[in_view(camera_board(arm.forward(q), X, Y, mount))]
        found = np.concatenate([found, q[arm.is_free(q)]])
    return found[:count]


@cache
def arm_session(
    seed: int, mount: str = "eye_in_hand", n: int = 25, errors: ArmErrors | None = None
) -> Simulated:
    """A session on the WidowX; errors: of the arm, None for one whose kinematics are exact."""
    rng = np.random.default_rng([seed, 5])
    arm = widowx()
    X, Y = (turned(T, rng.normal(size=6) * ([0.02] * 3 + [0.004] * 3)) for T in typical(mount))
    pool = reachable(mount)
    pool = pool[rng.permutation(len(pool))]
    pool = pool[in_view(camera_board(arm.forward(pool), X, Y, mount))]
    q = pool[:n]
    true = arm.forward(q)
    if errors is not None:
        unit = SimulatedArm(seed, errors)
        read = unit.move(pool[: 3 * n])
        true = unit.true_pose()
        keep = np.flatnonzero(in_view(camera_board(true, X, Y, mount)))[:n]
        q, true = read[keep], true[keep]
    assert len(q) == n
    seen = camera_board(true, X, Y, mount)
    fk = None if errors is None else fk_covariance(q, errors)
    session = HandEyeSession(mount, arm.forward(q), corners_at(seen, rng), BOARD, LENS, q)
    return Simulated(session, X, Y, fk)


def corners_at(
    T_camera_board: np.ndarray, rng: np.random.Generator, board: Board = BOARD, px: float = NOISE_PX
) -> Detections:
    """What a camera detects of a board at poses (n, 4, 4)."""
    at = board.points @ np.swapaxes(T_camera_board[:, :3, :3], 1, 2)
    pixels = project(at + T_camera_board[:, None, :3, 3], LENS.K, LENS.dist)
    pixels += px * rng.normal(size=pixels.shape)
    ids = np.arange(len(board.points))
    return Detections([Detection(ids, uv, LENS.size, f"{i:02d}") for i, uv in enumerate(pixels)])


@cache
def free_session(
    seed: int, mount: str = "eye_in_hand", n: int = 25, tilt_deg: float = 40.0
) -> Simulated:
    """A session of an arm that reaches every pose: tilts all around up to tilt_deg."""
    rng = np.random.default_rng([seed, 6])
    X, Y = (turned(T, rng.normal(size=6) * ([0.05] * 3 + [0.01] * 3)) for T in typical(mount))
    centre = BOARD.points.mean(axis=0)
    seen = []
    while len(seen) < n:
        tilt, azimuth = np.radians(tilt_deg) * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi)
        lean = Rotation.from_rotvec(tilt * np.array([np.cos(azimuth), np.sin(azimuth), 0.0]))
        R = (lean * Rotation.from_euler("z", rng.uniform(-1.0, 1.0))).as_matrix()
        T = make_transform(R, rng.uniform([-0.1, -0.08, 0.25], [0.1, 0.08, 0.5]) - R @ centre)
        if in_view(T[None])[0]:
            seen.append(T)
    seen = np.stack(seen)
    M = X @ seen @ invert_transform(Y)
    T_base_gripper = M if mount == "eye_to_hand" else invert_transform(M)
    session = HandEyeSession(mount, T_base_gripper, corners_at(seen, rng), BOARD, LENS)
    return Simulated(session, X, Y, None)
