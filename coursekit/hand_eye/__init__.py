"""Hand-eye calibration: where the camera is on the arm, or where the arm is before the camera.

A `HandEyeSession` is arm poses and what the camera saw at each; `solve` finds the camera from it,
by a closed form or by refinement, and the `HandEyeResult` says how well it is known. Before that,
`observability` says which directions of X the poses determine; after it, `held_out` how far the
result is off at poses that it has not seen, and `next_pose` which pose to take next. `diagnose`
names what is wrong with a session. The frames and the equation are in `hand_eye.poses`.

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
from coursekit.hand_eye.planning import held_out, next_pose
from coursekit.hand_eye.poses import MOUNTS, observability
from coursekit.hand_eye.session import METHODS, HandEyeResult, HandEyeSession, solve
from coursekit.hand_eye.views import board_poses
