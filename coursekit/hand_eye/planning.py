"""Poses beyond those of a fit: how far it is off there, and which of them to take next.

`held_out` compares what a result predicts with what is seen at poses that it was not fitted to.
`next_pose` looks for the arm pose that shrinks the worst direction of X most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from coursekit.arm import FkErrors
from coursekit.arrays import ArrayLike, Floats, Mask
from coursekit.boards import Board, Detection
from coursekit.boards.board import seen
from coursekit.checks import want
from coursekit.geometry import Intrinsics
from coursekit.hand_eye.poses import IN_METRES, SCATTER, by_X_and_Y, camera_board, check_poses
from coursekit.hand_eye.refinement import arm_poses_with
from coursekit.hand_eye.session import HandEyeResult, HandEyeSession
from coursekit.hand_eye.views import PixelViews, board_gap, rms_length, view_residuals
from coursekit.intrinsics.derivatives import scaled_inverse
from coursekit.words import say, wrapped

CORNER_PX = 0.1  # corner noise where no images have told
VIEW_ROOM_PX = 10.0  # that a proposed view leaves between the board and the image's border
LEAST_FACING = 0.5  # cosine between the board's normal and the line of sight: 60 deg
NEARER_THAN_EVER, FARTHER_THAN_EVER = 0.6, 1.5  # times the nearest and farthest view so far
DRAW_RAD, DRAWN, PROPOSALS = 0.35, 4000, 400  # std about known joints; how many, how many stay
UNKNOWN_POSE = np.repeat([10.0, 10.0], 3)  # prior std, rad and m: keeps what is unknown finite


# --- poses that were held out ---


@dataclass(frozen=True, eq=False, repr=False)
class HeldOut:
    """What a result predicts of m poses that it has not seen.

    residuals: observed - predicted of each view, (N_i, 2) px, None without detections. gap_m (m,):
    between the board as the image alone places it and as predicted, root mean square over the
    corners. along_m, across_m (m,): the same along the line of sight, where an image knows least,
    and across it.
    """

    residuals: tuple[Floats, ...] | None
    gap_m: Floats
    along_m: Floats

    @property
    def across_m(self) -> Floats:
        """The part (m,) of `gap_m` across the line of sight."""
        return np.sqrt(np.maximum(self.gap_m**2 - self.along_m**2, 0.0))

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residual vectors, px; ValueError without detections."""
        if self.residuals is None:
            raise ValueError("seen: poses have no residuals in px; give detections")
        return rms_length(np.concatenate(self.residuals))

    @property
    def rms_mm(self) -> float:
        """Root mean square of `gap_m`, mm."""
        return 1e3 * rms_length(self.gap_m[:, None])

    def __repr__(self) -> str:
        pixels = "" if self.residuals is None else f"{self.rms_px:.2f} px, "
        across, along = (1e3 * rms_length(part[:, None]) for part in (self.across_m, self.along_m))
        facts = {"across": across, "along": along, "worst": 1e3 * self.gap_m.max()}
        held = say("hand_eye.held_out", n=len(self.gap_m), pixels=pixels, mm=self.rms_mm, **facts)
        return wrapped(held)


def held_out(
    result: HandEyeResult,
    T_base_gripper: ArrayLike,
    seen: Sequence[Detection] | ArrayLike,
    *,
    q: ArrayLike | None = None,
    fk: FkErrors | None = None,
) -> HeldOut:
    """The gap between prediction and sight at poses that were not used for the fit.

    T_base_gripper (m, 4, 4), m, and seen as in a session, of the result's board and camera.
    q (m, 6), rad, or fk for these poses apply what the fit has learnt of the arm's
    own errors; without them the arm of a session with joint angles is taken at its word. Compare
    its rms_px with the result's own: where it is much larger, X fits the noise of its poses. Raises
    ValueError as a session does.
    """
    given, fit = result.session, result.refined
    about = given.board, given.intrinsics, q
    other = HandEyeSession(result.mount, T_base_gripper, seen, *about, arm=given.arm)  # type: ignore[arg-type]
    poses = other.T_base_gripper
    if fit is not None:
        if fit.problem.guessed and fk is None and (other.q is not None or given.q is None):
            fk = other.shared_errors
        poses = arm_poses_with(fit, replace(fit.problem, T_base_gripper=poses, q=other.q, fk=fk))
    expected = camera_board(poses, result.X, result.Y, result.mount)
    residuals = None
    if other.detections is not None:
        residuals = view_residuals(other.corners(), expected, result.scale)
    return HeldOut(residuals, *board_gap(other.T_camera_board, expected, other.board, result.scale))


# --- the next pose ---


@dataclass(frozen=True, eq=False, repr=False)
class NextPose:
    """The pose to take next.

    index: among the candidates. T_base_gripper (4, 4), and q (6,) in rad where joints are known.
    now_mm: standard deviation of X in its worst direction (rotations by what they do 0.3 m in front
    of the camera). then_mm (m,): the same with each candidate added, NaN where the board would not
    be seen or the joints cannot go.
    """

    index: int
    T_base_gripper: Floats
    q: Floats | None
    now_mm: float
    then_mm: Floats

    def __repr__(self) -> str:
        place = f"({', '.join(f'{p:z.0f}' for p in 1e3 * self.T_base_gripper[:3, 3])}) mm"
        usable, joints = np.isfinite(self.then_mm).sum(), ""
        if self.q is not None:
            angles = ", ".join(f"{angle:z.1f}" for angle in np.degrees(self.q))
            joints = f",\n  joints ({angles}) deg"
        then = {"now": self.now_mm, "then": self.then_mm[self.index], "usable": usable}
        return say("hand_eye.next", place=place, joints=joints, **then)


def next_pose(
    result: HandEyeResult, candidates: ArrayLike | None = None, seed: int = 0
) -> NextPose:
    """The arm pose that shrinks the worst direction of X most, from the result so far.

    candidates: arm poses (m, 4, 4), m, or joint angles (m, 6), rad, of the session's arm; None
    draws joint angles within the arm's limits, by `seed`. A candidate counts only if the arm may go
    there and the whole board would be in view, its face towards the camera and about as far away as
    so far; so the session needs the board and the intrinsics. The arm itself is taken to scatter by
    0.1 deg and 0.5 mm; corners alone would make every pose look perfect. Where the poses do not
    determine X, solve with a `guess` first: the proposal then turns about the missing axis.
    Raises ValueError where no candidate is usable.
    """
    arm = result.session.arm
    given = _drawn(result, seed) if candidates is None else np.asarray(candidates, float)
    q = given if given.ndim == 2 and given.shape[1] == 6 else None
    poses = check_poses("candidates", given if q is None else arm.forward(q))
    usable = _in_view(result, poses)
    if q is not None:
        usable &= arm.within_limits(q) & arm.is_free(q)
    want(usable.any(), "candidates", len(poses), "one where the arm is free and the board seen")
    known = _information(result, result.session.T_base_gripper)
    total = known.sum(axis=0) + np.diag(np.tile(UNKNOWN_POSE, 2) ** -2)
    then = np.full(len(poses), np.nan)
    then[usable] = _worst_mm(total + _information(result, poses[usable]))
    best = int(np.nanargmin(then))
    now = float(_worst_mm(total[None])[0])
    return NextPose(best, poses[best], None if q is None else q[best], now, then)


def _drawn(result: HandEyeResult, seed: int) -> Floats:
    """Joint angles (m, 6), rad, near the poses so far and elsewhere, at which the board is seen."""
    rng = np.random.default_rng([seed, 17])
    arm, known = result.session.arm, result.session.q
    if known is None:
        known, reached = arm.inverse(result.session.T_base_gripper)
        known = known[reached]
    if not len(known):
        raise ValueError("arm: reaches none of the poses in the result; is it this arm?")
    near = known[rng.integers(len(known), size=DRAWN)] + DRAW_RAD * rng.normal(size=(DRAWN, 6))
    drawn = np.concatenate([near, arm.random(rng, DRAWN)])
    drawn = drawn[arm.within_limits(drawn)]
    drawn = drawn[_in_view(result, arm.forward(drawn))]
    return rng.permutation(drawn[arm.is_free(drawn)])[:PROPOSALS]


def _seen_with(result: HandEyeResult) -> tuple[Board, Intrinsics]:
    """The session's board and intrinsics, or a ValueError."""
    board, intrinsics = result.session.board, result.session.intrinsics
    if board is None or intrinsics is None:
        raise ValueError("board, intrinsics: want both in the session, to know what is in view")
    return board, intrinsics


def _in_view(result: HandEyeResult, T_base_gripper: Floats) -> Mask:
    """(m,): whether the camera would see the whole board well from arm poses (m, 4, 4)."""
    board, intrinsics = _seen_with(result)
    C = camera_board(T_base_gripper, result.X, result.Y, result.mount)
    facing, away = _facing(C, board)
    facing_so_far, away_so_far = _facing(result.T_camera_board, board)
    side = np.sign(np.median(facing_so_far))  # z may point into the board or out of it
    return (
        seen(board.points, C, intrinsics, VIEW_ROOM_PX).all(axis=1)
        & (side * facing > LEAST_FACING)
        & (away > NEARER_THAN_EVER * away_so_far.min())
        & (away < FARTHER_THAN_EVER * away_so_far.max())
    )


def _facing(C: Floats, board: Board) -> tuple[Floats, Floats]:
    """Cosine between the board's z axis and the line of sight (n,), and the distance (n,), m."""
    centre = C[:, :3, :3] @ board.middle + C[:, :3, 3]
    away = np.linalg.norm(centre, axis=1)
    return np.einsum("ni,ni->n", C[:, :3, 2], centre) / away, away


def _information(result: HandEyeResult, poses: Floats) -> Floats:
    """What a pair of pose and image at each of (m, 4, 4) says about X and Y, (m, 12, 12)."""
    board, intrinsics = _seen_with(result)
    C = camera_board(poses, result.X, result.Y, result.mount)
    noise_px = CORNER_PX
    if result.session.detections is not None:
        noise_px = result.session.corner_sigma_px
    count, starts = len(board.points), len(board.points) * np.arange(len(C))
    points, pixels = np.tile(board.points, (len(C), 1)), np.zeros((len(C) * count, 2))
    views = PixelViews(points, pixels, starts, intrinsics, noise_px)
    of_image = np.linalg.inv(views.linear(C, 1.0)[2][:, :6, :6])
    weight = np.linalg.inv(of_image + np.diag(SCATTER**2))
    columns = by_X_and_Y(poses, result.X, result.Y, result.mount)
    return np.swapaxes(columns, 1, 2) @ weight @ columns


def _worst_mm(information: Floats) -> Floats:
    """The standard deviation of X in its worst direction, mm, from informations (m, 12, 12)."""
    of_X = scaled_inverse(information)[:, :6, :6] * IN_METRES[:, None] * IN_METRES
    return 1e3 * np.sqrt(np.linalg.eigvalsh(of_X)[:, -1])
