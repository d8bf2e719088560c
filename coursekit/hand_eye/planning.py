"""Which arm pose to take next: the one that shrinks the worst direction of X most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from coursekit.arm import Arm
from coursekit.arrays import ArrayLike, Floats, NDArray
from coursekit.boards import Board
from coursekit.boards.view import seen
from coursekit.geometry import Intrinsics
from coursekit.hand_eye.poses import camera_board, check_poses
from coursekit.hand_eye.refinement import PixelViews, by_X_and_Y
from coursekit.hand_eye.result import POSITION_M, ROTATION_RAD, HandEyeResult, units

CORNER_PX = 0.1  # corner noise where no images have told
ROOM_PX = 10.0
LEAST_FACING = 0.5  # cosine between the board's normal and the line of sight: 60 deg
NEARER, FARTHER = 0.6, 1.5  # times the nearest and farthest view so far
STEP_RAD, DRAWN, MOST = 0.35, 4000, 400  # of the candidates
NOTHING = np.repeat([10.0, 10.0], 3)  # prior std, rad and m: keeps what is unknown finite


@dataclass(frozen=True, eq=False, repr=False)
class NextPose:
    """The pose to take next.

    index: among the candidates. T_base_gripper (4, 4), and q (6,) in rad where joints are known.
    now_mm: standard deviation of X in its worst direction (rotations by what they do
    `observability.LEVER_M` in front of the camera). then_mm (m,): the same with each candidate
    added, NaN where the board would not be seen or the joints cannot go.
    """

    index: int
    T_base_gripper: Floats
    q: Floats | None
    now_mm: float
    then_mm: Floats

    @property
    def usable(self) -> NDArray[np.bool_]:
        """Which candidates are within the limits and see the board, (m,)."""
        return np.isfinite(self.then_mm)

    def __repr__(self) -> str:
        place = "({:.0f}, {:.0f}, {:.0f}) mm".format(*(1e3 * self.T_base_gripper[:3, 3] + 0.0))
        joints = ""
        if self.q is not None:
            angles = ", ".join(f"{angle:.1f}" for angle in np.degrees(self.q) + 0.0)
            joints = f",\n  joints ({angles}) deg"
        return (
            f"next: gripper at {place}{joints}\n"
            f"X in its worst direction: {self.now_mm:.2f} mm now, "
            f"{self.then_mm[self.index]:.2f} mm with it ({int(self.usable.sum())} candidates)"
        )


def next_pose(
    result: HandEyeResult,
    candidates: ArrayLike | None = None,
    *,
    arm: Arm | None = None,
    board: Board | None = None,
    intrinsics: Intrinsics | None = None,
    rotation_rad: float = ROTATION_RAD,
    position_m: float = POSITION_M,
    seed: int = 0,
) -> NextPose:
    """The arm pose that shrinks the worst direction of X most, from the result so far.

    candidates: arm poses (m, 4, 4), or joint angles (m, 6) in rad with the arm; None draws joint
    angles within the arm's limits, by `seed`. A candidate counts only if the arm may go there and
    the whole board would be in view, its face towards the camera and about as far away as so far.
    board, intrinsics: the result's unless given. rotation_rad, position_m: by how much the arm
    itself scatters; corners alone would make every pose look perfect. Where the poses do not
    determine X, solve with a `guess` first: the proposal then turns about the missing axis.
    Raises ValueError where no candidate is usable.
    """
    board, intrinsics = board or result.data.board, intrinsics or result.data.intrinsics
    if board is None or intrinsics is None:
        raise ValueError("board, intrinsics: want both, to know what is in view")
    if candidates is None:
        if arm is None:
            raise ValueError("candidates: got None; give poses, or the arm to draw them")
        candidates = candidate_joints(result, arm, board, intrinsics, seed)
    q, poses = _poses_of(candidates, arm)
    allowed = np.ones(len(poses), bool) if q is None or arm is None else _may_go(arm, q)
    allowed &= in_view(result, poses, board, intrinsics)
    if not allowed.any():
        raise ValueError(f"candidates: in none of {len(poses)} is the arm free and the board seen")
    scatter = np.repeat([rotation_rad, position_m], 3)
    known = _information(result, result.data.T_base_gripper, board, intrinsics, scatter)
    total = known.sum(axis=0) + np.diag(np.tile(NOTHING, 2) ** -2)
    then = np.full(len(poses), np.nan)
    added = _information(result, poses[allowed], board, intrinsics, scatter)
    then[allowed] = _worst_mm(total + added)
    best = int(np.nanargmin(then))
    now = float(_worst_mm(total[None])[0])
    return NextPose(best, poses[best], None if q is None else q[best], now, then)


def candidate_joints(
    result: HandEyeResult, arm: Arm, board: Board, intrinsics: Intrinsics, seed: int = 0
) -> Floats:
    """Joint angles (m, 6), rad, near the poses so far and elsewhere, at which the board is seen."""
    rng = np.random.default_rng([seed, 17])
    known = result.data.q
    if known is None:
        known, reached = arm.inverse(result.data.T_base_gripper)
        known = known[reached]
    if not len(known):
        raise ValueError("arm: reaches none of the poses in the result; is it this arm?")
    near = known[rng.integers(len(known), size=DRAWN)] + STEP_RAD * rng.normal(size=(DRAWN, 6))
    drawn = np.concatenate([near, arm.random(rng, DRAWN)])
    low, high = arm.limits.T
    drawn = drawn[((drawn > low) & (drawn < high)).all(axis=1)]
    drawn = drawn[in_view(result, arm.forward(drawn), board, intrinsics)]
    return rng.permutation(drawn[arm.is_free(drawn)])[:MOST]


def in_view(
    result: HandEyeResult, T_base_gripper: Floats, board: Board, intrinsics: Intrinsics
) -> NDArray[np.bool_]:
    """(m,): whether the camera would see the whole board well from arm poses (m, 4, 4)."""
    C = camera_board(T_base_gripper, result.X, result.Y, result.mount)
    facing, away = _facing(C, board)
    facing_so_far, away_so_far = _facing(result.T_camera_board, board)
    side = np.sign(np.median(facing_so_far))  # z may point into the board or out of it
    return (
        seen(board.points, C, intrinsics, ROOM_PX).all(axis=1)
        & (side * facing > LEAST_FACING)
        & (away > NEARER * away_so_far.min())
        & (away < FARTHER * away_so_far.max())
    )


def _facing(C: Floats, board: Board) -> tuple[Floats, Floats]:
    """Cosine between the board's z axis and the line of sight (n,), and the distance (n,), m."""
    centre = C[:, :3, :3] @ board.middle + C[:, :3, 3]
    away = np.linalg.norm(centre, axis=1)
    return np.einsum("ni,ni->n", C[:, :3, 2], centre) / away, away


def _poses_of(candidates: ArrayLike, arm: Arm | None) -> tuple[Floats | None, Floats]:
    given = np.asarray(candidates, float)
    if given.ndim == 2 and given.shape[1] == 6:
        if arm is None:
            raise ValueError("arm: got None; joint angles need the arm")
        return given, arm.forward(given)
    return None, check_poses("candidates", given)


def _may_go(arm: Arm, q: Floats) -> NDArray[np.bool_]:
    low, high = arm.limits.T
    return ((q >= low) & (q <= high)).all(axis=1) & arm.is_free(q)


def _information(
    result: HandEyeResult, poses: Floats, board: Board, intrinsics: Intrinsics, scatter: Floats
) -> Floats:
    """What a pair of pose and image at each of (m, 4, 4) says about X and Y, (m, 12, 12)."""
    C = camera_board(poses, result.X, result.Y, result.mount)
    noise_px = result.data.corner_sigma_px if result.data.detections is not None else CORNER_PX
    count = len(board.points)
    views = PixelViews(
        np.tile(board.points, (len(C), 1)), np.zeros((len(C) * count, 2)),
        np.arange(len(C)) * count, intrinsics, noise_px,
    )  # fmt: skip
    of_image = np.linalg.inv(views.linear(C, 1.0)[2][:, :6, :6])
    weight = np.linalg.inv(of_image + np.diag(scatter**2))
    columns = by_X_and_Y(poses, result.X, result.Y, result.mount)
    return np.swapaxes(columns, 1, 2) @ weight @ columns


def _worst_mm(information: Floats) -> Floats:
    """The standard deviation of X in its worst direction, mm, from informations (m, 12, 12)."""
    scale = np.sqrt(np.einsum("mii->mi", information))
    covariance = np.linalg.inv(information / (scale[:, :, None] * scale[:, None, :]))
    covariance /= scale[:, :, None] * scale[:, None, :]
    of_X = covariance[:, :6, :6] * units()[:, None] * units()
    return 1e3 * np.sqrt(np.linalg.eigvalsh(of_X)[:, -1])
