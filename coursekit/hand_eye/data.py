"""What `solve` is given, checked."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from coursekit.arm import pose_difference
from coursekit.hand_eye.board_pose import BoardPose, board_poses
from coursekit.hand_eye.closed_form import FEWEST, closed_form, stand_board
from coursekit.hand_eye.poses import (
    Mount,
    camera_board,
    check_one,
    check_poses,
    mean_pose,
    same_number,
)
from coursekit.hand_eye.refine import Problem
from coursekit.hand_eye.views import PixelViews, PoseViews

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from coursekit.arm import Arm, FkErrors
    from coursekit.boards import Board, Detection
    from coursekit.geometry import Intrinsics

    Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class HandEyeData:
    """Checked input. T_camera_board (n, 4, 4): measured, from the images where there are any."""

    T_base_gripper: Floats
    T_camera_board: Floats
    mount: Mount
    poses: tuple[BoardPose, ...] = ()
    detections: Sequence[Detection] | None = None
    board: Board | None = None
    intrinsics: Intrinsics | None = None
    arm: Arm | None = None
    q: Floats | None = None
    fk: FkErrors | None = None

    @classmethod
    def of(
        cls,
        T_base_gripper: ArrayLike,
        seen: Sequence[Detection] | ArrayLike,
        mount: Mount,
        board: Board | None,
        intrinsics: Intrinsics | None,
        arm: Arm | None = None,
        q: ArrayLike | None = None,
        fk: FkErrors | None = None,
        at_least: int = FEWEST,
    ) -> HandEyeData:
        """The input, or the ValueError that says what is wrong with it."""
        arm_poses = check_poses("T_base_gripper", T_base_gripper, at_least)
        n = len(arm_poses)
        joints = _joints(arm, q, n)
        if fk is not None and fk.each.shape != (n, 6, 6):
            raise ValueError(f"fk: has {fk.each.shape}, want ({n}, 6, 6), one for each arm pose")
        if not _are_detections(seen):
            measured = check_poses("seen", seen, at_least)  # type: ignore[arg-type]
            same_number(n, len(measured))
            return cls(arm_poses, measured, mount, arm=arm, q=joints, fk=fk)
        if board is None or intrinsics is None:
            missing = "board" if board is None else "intrinsics"
            raise ValueError(f"{missing}: got None; detections need the board and the intrinsics")
        same_number(n, len(seen))  # type: ignore[arg-type]
        poses = board_poses(seen, board, intrinsics)  # type: ignore[arg-type]
        measured = np.stack([pose.T_camera_board for pose in poses])
        return cls(
            arm_poses, measured, mount, tuple(poses), seen, board, intrinsics, arm, joints, fk,  # type: ignore[arg-type]
        )  # fmt: skip

    def by_closed_form(
        self, method: str, guess: ArrayLike | None
    ) -> tuple[Floats, Floats, HandEyeData]:
        """X and Y; where an image allows two poses of the board the data keep the one that fits."""
        measured = self.T_camera_board
        for _ in range(2):
            if guess is not None:
                X = check_one("guess", guess)
                Y = mean_pose(stand_board(self.T_base_gripper, measured, X, self.mount))
            else:
                X, Y = closed_form(self.T_base_gripper, measured, self.mount, method)
            chosen = self._that_fit(X, Y)
            if chosen is measured or np.array_equal(chosen, measured):
                break
            measured = chosen
        return X, Y, replace(self, T_camera_board=measured)

    def _that_fit(self, X: Floats, Y: Floats) -> Floats:
        expected = camera_board(self.T_base_gripper, X, Y, self.mount)
        chosen = self.T_camera_board.copy()
        for index, pose in enumerate(self.poses):
            if pose.other is None:
                continue
            both = np.stack([pose.T_camera_board, pose.other])
            turns = np.linalg.norm(pose_difference(expected[index], both)[:, :3], axis=1)
            chosen[index] = both[np.argmin(turns)]
        return chosen

    def problem(self, free_scale: bool) -> Problem:
        """What the refinement works on."""
        if self.detections is None:
            views: PixelViews | PoseViews = PoseViews(self.T_camera_board, np.zeros((0, 6, 6)))
        else:
            assert self.board is not None
            assert self.intrinsics is not None
            views = PixelViews.of(
                self.detections, self.board, self.intrinsics, self.corner_sigma_px
            )
        return Problem(
            self.T_base_gripper, self.mount, views, free_scale, self.arm, self.q, self.fk
        )

    @property
    def corner_sigma_px(self) -> float:
        """Std of one corner coordinate, px, each image with a pose of its own: no arm is in it."""
        counts = np.array([len(seen.ids) for seen in self.detections or ()])
        squares = sum(c * p.rms_px**2 for c, p in zip(counts, self.poses, strict=True))
        return max(math.sqrt(squares / max(1, 2 * counts.sum() - 6 * len(counts))), 1e-6)


def _are_detections(seen: object) -> bool:
    from coursekit.boards import Detection, Detections

    if isinstance(seen, Detections):
        return True
    return isinstance(seen, (list, tuple)) and any(isinstance(one, Detection) for one in seen)


def _joints(arm: Arm | None, q: ArrayLike | None, n: int) -> Floats | None:
    if (arm is None) != (q is None):
        raise ValueError("arm, q: joint offsets need both, or give neither")
    if q is None:
        return None
    joints = np.asarray(q, float)
    if joints.shape != (n, 6) or not np.isfinite(joints).all():
        raise ValueError(f"q: got shape {joints.shape}, want finite ({n}, 6) in rad")
    return joints
