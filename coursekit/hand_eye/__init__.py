"""Hand-eye calibration: where the camera is on the arm, or where the arm is before the camera.

`solve` takes arm poses and what the camera saw at each. `observability` says beforehand which
directions of X the poses determine, `next_pose` which pose to take next, `held_out` how far the
result is off at poses that it has not seen. The frames and the equation are in `hand_eye.poses`.

Metres and radians; T_base_gripper takes gripper coordinates to base coordinates.
"""

from __future__ import annotations

from coursekit.hand_eye.closed_form import (
    CLOSED_FORMS,
    NotDetermined,
    SolverFailed,
    StudyPoint,
    error_study,
    motions,
    rotation_from_shifts,
    rotation_half,
    translation_half,
)
from coursekit.hand_eye.diagnosis import diagnose
from coursekit.hand_eye.planning import NextPose, candidate_joints, next_pose
from coursekit.hand_eye.poses import MOUNTS
from coursekit.hand_eye.refinement import BoardPose, board_pose, board_poses
from coursekit.hand_eye.result import HandEyeResult, HeldOut, Observability, held_out, observability
from coursekit.hand_eye.session import HandEyeSession
from coursekit.hand_eye.solver import METHODS, solve

__all__ = [
    "CLOSED_FORMS",
    "METHODS",
    "MOUNTS",
    "BoardPose",
    "HandEyeResult",
    "HandEyeSession",
    "HeldOut",
    "NextPose",
    "NotDetermined",
    "Observability",
    "SolverFailed",
    "StudyPoint",
    "board_pose",
    "board_poses",
    "candidate_joints",
    "diagnose",
    "error_study",
    "held_out",
    "motions",
    "next_pose",
    "observability",
    "rotation_from_shifts",
    "rotation_half",
    "solve",
    "translation_half",
]
