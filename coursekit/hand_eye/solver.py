"""Where the camera is: `solve` by a closed form, by OpenCV's solvers or by joint refinement."""

from __future__ import annotations

from collections.abc import Sequence

from coursekit.arm import Arm, FkErrors
from coursekit.arrays import ArrayLike
from coursekit.boards import Board, Detection
from coursekit.geometry import Intrinsics
from coursekit.hand_eye.closed_form import CLOSED_FORMS, FEWEST
from coursekit.hand_eye.poses import Mount, check_mount
from coursekit.hand_eye.refinement import refine, refine_poses
from coursekit.hand_eye.result import HandEyeData, HandEyeResult

__all__ = ["FEWEST", "METHODS", "HandEyeResult", "solve"]

METHODS = ("refine", *CLOSED_FORMS)


def solve(
    T_base_gripper: ArrayLike,
    seen: Sequence[Detection] | ArrayLike,
    mount: Mount,
    method: str = "refine",
    *,
    board: Board | None = None,
    intrinsics: Intrinsics | None = None,
    free_scale: bool = False,
    arm: Arm | None = None,
    q: ArrayLike | None = None,
    fk: FkErrors | None = None,
    guess: ArrayLike | None = None,
) -> HandEyeResult:
    """Where the camera is, from arm poses and what the camera saw at each.

    T_base_gripper (n, 4, 4): as the arm reports them, m. seen: the detections of the n images,
    with the board and the camera's intrinsics, or the poses T_camera_board (n, 4, 4). mount:
    "eye_in_hand" (camera in the gripper, board on the table) gives X = T_gripper_camera and
    Y = T_base_board; "eye_to_hand" (camera on the table, board in the gripper) gives
    X = T_base_camera and Y = T_gripper_board. For eye-to-hand every solver of A X = X B works on
    the inverted arm poses: T_base_gripper T_gripper_board = T_base_camera T_camera_board has the
    form of eye-in-hand with base and gripper exchanged.

    method: "refine" (the best: X and Y together by least squares on the pixels, or on the poses
    where no detections are given), "closed_form" (rotation first, then translation), OpenCV's
    "tsai", "park", "horaud", "andreff", "daniilidis", and its robot-world "shah", "li".

    With "refine" only: free_scale also estimates how much larger the board is than it says; arm
    and q (n, 6) in rad also estimate the joint offsets; fk weighs the arm's errors. guess (4, 4):
    an X to start from, in place of the closed form.

    Raises ValueError that names the argument, and the index in it, for fewer than three poses,
    unequal numbers, anything that is no rigid transform, and images without a pose; NotDetermined
    where the arm did not turn about two axes; SolverFailed where a solver's output is no rotation
    (OpenCV's Park can return a reflection, its Tsai the identity).
    """
    check_mount(mount)
    if method not in METHODS:
        raise ValueError(f"method: got {method!r}, want one of {', '.join(METHODS)}")
    if method != "refine" and (free_scale or arm is not None or fk is not None):
        raise ValueError(f"method: {method} has no free_scale, arm or fk; take 'refine'")
    if method != "refine" and guess is not None:
        raise ValueError(f"guess: {method} starts from nothing; take 'refine'")
    data = HandEyeData.of(T_base_gripper, seen, mount, board, intrinsics, arm, q, fk)
    if fk is not None and data.detections is None:
        raise ValueError("fk: got poses; to weigh the arm against the images, give detections")
    if method != "refine":
        X, Y, data = data.by_closed_form(method, guess)
        return HandEyeResult(X, Y, method, data)
    X, Y, data = data.by_closed_form("closed_form", guess)
    fit = refine if data.detections is not None else refine_poses
    refined = fit(data.problem(free_scale), X, Y)
    return HandEyeResult(refined.state.X, refined.state.Y, method, data, refined)
