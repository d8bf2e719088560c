"""Whether a hand-eye result is good: poses that were held out, a verdict in words, the printout."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from coursekit.hand_eye.data import HandEyeData
from coursekit.hand_eye.observability import observability
from coursekit.hand_eye.poses import FRAMES, camera_board, cross_matrix
from coursekit.hand_eye.refine import arm_poses_with
from coursekit.hand_eye.result import HandEyeResult, board_gap, pixel_residuals

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from coursekit.arm import FkErrors
    from coursekit.boards import Board, Detection
    from coursekit.geometry import Intrinsics

    Floats = NDArray[np.float64]

LINE = 88
GOOD_MM, USABLE_MM = 2.0, 5.0  # 95 %, worst direction, lever arm included
LEVER_M = 0.3  # from the camera to what it looks at: where a rotation becomes millimetres
CONSISTENT = 0.001
TWICE = 4.0  # a unit of an arm may have twice the gear play of most: that is still as stated
UNKNOWN_DEG, UNKNOWN_MM = 90.0, 1e3  # what is known no better is not known
GOOD_POSES = 15
GOOD_TURN_DEG = 15.0  # rms about the second axis: +-25 deg or so


@dataclass(frozen=True, eq=False, repr=False)
class HeldOut:
    """What a result predicts of poses that it has not seen.

    residuals: observed - predicted of each view, (N_i, 2) px, None without detections. gap_m (m,):
    between the board as the image alone places it and as predicted, root mean square over the
    corners. along_m, across_m (m,): the same along the line of sight, where an image knows least,
    and across it.
    """

    residuals: tuple[Floats, ...] | None
    gap_m: Floats
    along_m: Floats
    across_m: Floats

    @cached_property
    def rms_px(self) -> float:
        """Root mean square length of the residual vectors, px."""
        if self.residuals is None:
            raise ValueError("seen: poses have no residuals in px; give detections")
        rows = np.concatenate(self.residuals)
        return float(np.sqrt(np.mean((rows**2).sum(axis=1))))

    @property
    def rms_mm(self) -> float:
        """Root mean square of `gap_m`, mm."""
        return 1e3 * _rms(self.gap_m)

    def __repr__(self) -> str:
        pixels = "" if self.residuals is None else f"{self.rms_px:.2f} px, "
        return (
            f"{len(self.gap_m)} poses held out: {pixels}{self.rms_mm:.2f} mm at the board "
            f"({1e3 * _rms(self.across_m):.2f} across the line of sight, "
            f"{1e3 * _rms(self.along_m):.2f} along it), worst {1e3 * self.gap_m.max():.2f} mm"
        )


def held_out(
    result: HandEyeResult,
    T_base_gripper: ArrayLike,
    seen: Sequence[Detection] | ArrayLike,
    *,
    board: Board | None = None,
    intrinsics: Intrinsics | None = None,
    q: ArrayLike | None = None,
    fk: FkErrors | None = None,
) -> HeldOut:
    """The gap between prediction and sight at poses that were not used for the fit.

    T_base_gripper (m, 4, 4) and seen as in `solve`; board and intrinsics are the result's unless
    given. q (m, 6) or fk for these poses apply what the fit has learnt of the arm's own errors;
    without them the arm is taken at its word. Raises ValueError as `solve` does.
    """
    data = result.data
    arm = data.arm if q is not None else None
    other = HandEyeData.of(
        T_base_gripper, seen, result.mount, board or data.board, intrinsics or data.intrinsics,
        arm, q if arm is not None else None, fk, at_least=1,
    )  # fmt: skip
    poses = other.T_base_gripper
    if result.refined is not None and (fk is not None or arm is not None):
        poses = arm_poses_with(result.refined, poses, other.q, fk)
    expected = camera_board(poses, result.X, result.Y, result.mount)
    residuals = None
    if other.detections is not None:
        residuals = pixel_residuals(
            other.detections, other.board, other.intrinsics, result, expected  # type: ignore[arg-type]
        )  # fmt: skip
    gap = board_gap(other.T_camera_board, expected, other.board, result.scale)
    along = _along_sight(other.T_camera_board, expected, other.board, result.scale)
    return HeldOut(residuals, gap, along, np.sqrt(np.maximum(gap**2 - along**2, 0.0)))


def _along_sight(seen: Floats, expected: Floats, board: Board | None, scale: float) -> Floats:
    """Root mean square over the corners of the gap along each corner's line of sight, (n,), m."""
    points = np.zeros((1, 3)) if board is None else scale * board.points
    at, there = (
        points @ np.swapaxes(T[:, :3, :3], 1, 2) + factor * T[:, None, :3, 3]
        for T, factor in ((seen, scale), (expected, 1.0))
    )
    sight = there / np.linalg.norm(there, axis=2, keepdims=True)
    return np.sqrt(np.mean(np.sum((at - there) * sight, axis=2) ** 2, axis=1))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


# --- in words ---


def describe(result: HandEyeResult) -> str:
    """The printout of a result."""
    name_X, name_Y = FRAMES[result.mount]
    data = result.data
    n = len(data.T_base_gripper)
    corners = (
        "" if data.detections is None else f", {sum(len(d.ids) for d in data.detections)} corners"
    )
    unsure = result.refined is not None and not result.refined.converged
    lines = [
        f"{result.mount}, {result.method}, {n} poses{corners}" + ("; NOT CONVERGED" * unsure),
        _pose_line(name_X, result.X, result, 0),
        _pose_line(name_Y, result.Y, result, 6),
    ]
    if result.refined is not None:
        lines += [
            f"{name} = {_value(result, name)}" for name in result.names[12:] if _own_name(name)
        ]
    if result.free:
        lines.append(textwrap.fill(f"NOT DETERMINED: {'; '.join(result.free)}", LINE))
    pixels = "" if data.detections is None else f"{result.rms_px:.2f} px, "
    lines.append(f"residuals: {pixels}{result.rms_mm:.2f} mm at the board (rms)")
    lines.append(
        f"spread: {result.spread_board_mm:.2f} mm of the board on its stand, "
        f"{result.spread_gripper_mm:.2f} mm and {result.spread_gripper_deg:.3f} deg of the gripper"
    )
    return "\n".join(lines)


def _own_name(name: str) -> bool:
    return name == "scale" or name.startswith("offset_")


def _value(result: HandEyeResult, name: str) -> str:
    half = result.quantile() * result.sigma(name)
    if name == "scale":
        return f"{result.scale:.5f} ± {half:.5f} (95 %)"
    offset = result.joint_offsets_rad[int(name[-1])]
    return f"{math.degrees(offset):.3f} ± {math.degrees(half):.3f} deg (95 %)"


def _pose_line(name: str, T: Floats, result: HandEyeResult, first: int) -> str:
    from scipy.spatial.transform import Rotation

    turned = "({:.2f}, {:.2f}, {:.2f})".format(
        *(np.degrees(Rotation.from_matrix(T[:3, :3]).as_rotvec()) + 0.0)
    )
    place = 1e3 * T[:3, 3] + 0.0
    if result.refined is None:
        return f"{name}: " + "({:.2f}, {:.2f}, {:.2f}) mm".format(*place) + f", turned {turned} deg"
    sigma = result.quantile() * np.sqrt(np.diag(result.covariance)[first : first + 6])
    wide, far = np.degrees(sigma[:3].max()), 1e3 * sigma[3:]
    if wide > UNKNOWN_DEG or far.max() > UNKNOWN_MM:
        one = "({:.0f}, {:.0f}, {:.0f}) mm".format(*place)
        return f"{name}: unknown in part; one that fits: {one}"
    where = ", ".join(f"{p:.2f} ± {s:.2f}" for p, s in zip(place, far, strict=True))
    return f"{name}: ({where}) mm,\n  turned {turned} ± {wide:.3f} deg (95 %)"


def verdict(result: HandEyeResult) -> str:
    """In words: how far to trust X, and what to do about what is weak."""
    weak = [reason for reason in _weaknesses(result) if reason]
    lines = [_head(result, bool(weak)), *(f"- {reason}" for reason in weak)]
    return "\n".join(
        textwrap.fill(line, LINE, subsequent_indent="  ", break_on_hyphens=False) for line in lines
    )


def _weaknesses(result: HandEyeResult) -> list[str]:
    """What could be better, with what to do; "" for what could not."""
    seen = observability(result.data.T_base_gripper, result.mount)
    n, turn = seen.poses, seen.turns_deg[1]
    converged = result.refined is None or result.refined.converged
    return [
        *(f"{direction}: the poses do not determine it." for direction in seen.free),
        f"{n} poses are few: take 15 to 30." if n < GOOD_POSES else "",
        f"about its second axis the wrist turned by {turn:.0f} deg (rms) only: turn it by 30 deg "
        "or more about two axes." if turn < GOOD_TURN_DEG else "",
        _inconsistent(result),
        "" if converged else "the refinement did not converge: are some pairs of pose and image "
        "wrong?",
    ]  # fmt: skip


def _head(result: HandEyeResult, weak: bool) -> str:
    """The finding in a sentence or two."""
    if result.refined is None:
        return (
            f"Uncertain: {result.method} says nothing about its own error. Solve with 'refine' for "
            "an interval."
        )
    worst = result.quantile() * reach_sigma_mm(result)
    if result.free or worst > USABLE_MM:
        grade = "Not good enough"
    elif _inconsistent(result):
        grade = "Not to be trusted"
    else:
        grade = "Usable with care" if weak or worst > GOOD_MM else "Good"
    at_its_word = result.data.fk is None
    return (
        f"{grade}: a point {1e3 * LEVER_M:.0f} mm in front of the camera is placed within "
        f"± {worst:.1f} mm (95 %, worst direction), as far as the mount goes."
        + " That takes the arm at its word: an arm's own error comes on top."
        * at_its_word
    )


def reach_sigma_mm(result: HandEyeResult, lever_m: float = LEVER_M) -> float:
    """Standard deviation, mm, worst direction, of where X puts a point `lever_m` ahead."""
    arm = result.X[:3, 2] * lever_m
    by_twist = np.concatenate([-cross_matrix(arm), np.eye(3)], axis=1)
    spread = by_twist @ result.covariance[:6, :6] @ by_twist.T
    return 1e3 * float(np.sqrt(np.linalg.eigvalsh(spread)[-1]))


def _inconsistent(result: HandEyeResult) -> str:
    if result.refined is None or result.data.detections is None:
        return ""
    stated = result.data.fk is not None
    if result.consistency_p_value > CONSISTENT or (stated and result.excess < TWICE):
        return ""
    said = "more than was stated (fk)" if stated else "which was taken as exact"
    return (
        f"arm and images disagree by {result.spread_gripper_mm:.1f} mm and "
        f"{result.spread_gripper_deg:.2f} deg at the gripper, more than the corners' noise "
        f"explains: the arm errs, {said}, or a pair is wrong. The intervals are too narrow then."
    )
