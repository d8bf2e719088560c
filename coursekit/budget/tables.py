"""The lesson's own table, and the same rig with the camera on the wrist."""

from __future__ import annotations

import math

import numpy as np

from coursekit.arm import widowx
from coursekit.budget.budget import ErrorBudget
from coursekit.budget.terms import Along, ErrorTerm
from coursekit.budget.view import GraspAxes, View
from coursekit.geometry import Intrinsics
from coursekit.results import Kind
from coursekit.specifications import device
from coursekit.stereo.law import depth_slope

LESSON = "the lesson"
LESSON_CAMERA = Intrinsics(848, 480, 447.0, 447.0, 424.0, 240.0)
LESSON_BASELINE_M = 0.050
LESSON_DISTANCE_M = 0.45
LESSON_SIGMA_D_PX = 0.08
WRIST_DISTANCE_M = 0.25
GRIPPER_DOWN = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # R_base_gripper, fingers down


def lesson_view(distance_m: float = LESSON_DISTANCE_M) -> View:
    """The lesson's camera: 447 px, 50 mm, the object in the middle of the image at 0.45 m."""
    return View(LESSON_CAMERA, distance_m, LESSON_BASELINE_M)


def lesson_terms(stated: bool) -> tuple[ErrorTerm, ...]:
    """The lesson's six rows; stated: with its own rounded millimetres at the object."""

    def row(
        name: str, kind: Kind, low: float, high: float, along: Along, *at_mm: float
    ) -> ErrorTerm:
        at = (1e-3 * at_mm[0], 1e-3 * at_mm[-1]) if stated else None
        return ErrorTerm(name, kind, low, high, along, LESSON, stated_m=at)

    turn = math.radians(0.5)
    matching = (
        row("depth noise", "noise", 7e-4, 7e-4, "ray", 0.7)
        if stated
        else row("depth noise", "noise", LESSON_SIGMA_D_PX, LESSON_SIGMA_D_PX, "disparity")
    )
    return (
        row("pixel", "noise", 1.0, 1.0, "image", 1.0),
        matching,
        row("depth bias", "bias", 2e-3, 5e-3, "ray", 2.0, 6.0),
        row("hand-eye rotation", "bias", turn, turn, "turn", 0.0, 3.9),
        row("hand-eye translation", "bias", 1e-3, 2e-3, "shift", 1.0, 2.0),
        row("forward kinematics", "bias", 2e-3, 4e-3, "shift", 2.0, 4.0),
    )


def lesson_budget(stated: bool = True, grasp: GraspAxes | None = None) -> ErrorBudget:
    """The lesson's table for a 25 mm cube seen from 0.45 m, eye-to-hand, tolerance ±7 mm.

    stated: with the lesson's own millimetres at the object, its ranges included ("up to 3.9" is 0
    to 3.9), each in any direction; they hold at 0.45 m only. Otherwise the same magnitudes are
    converted here, the depth noise from 0.08 px of disparity, and the budget can be moved.
    """
    title = "The lesson's table" if stated else "The lesson's magnitudes, converted"
    return ErrorBudget(lesson_terms(stated), lesson_view(), grasp or GraspAxes(), title=title)


def wrist_budget(
    distance_m: float = WRIST_DISTANCE_M, grasp: GraspAxes | None = None
) -> ErrorBudget:
    """The D405 on the wrist, looking at the object from `distance_m` along its optical axis.

    Camera and baseline are those of data/devices.toml. Nobody has published the D405's bias:
    **assumed** is the lesson's 2 to 5 mm at 0.45 m read as an offset of disparity, 0.22 to 0.55 px,
    and the same offset here. The mount's and the arm's rows are the lesson's; for a camera on the
    wrist the arm's counts for what differs between looking and grasping, so it is the upper end.
    The gripper comes along the fingers' direction of the maker's mount, the camera 20° from it.
    """
    unit = device("D405").unit
    T_base_camera = np.eye(4)  # where it stands does not matter, only how it is turned
    T_base_camera[:3, :3] = GRIPPER_DOWN @ widowx().T_gripper_camera[:3, :3]
    view = View(unit.depth, distance_m, unit.baseline_m, T_base_camera=T_base_camera)
    per_px = -float(depth_slope(LESSON_DISTANCE_M, LESSON_CAMERA.fx, LESSON_BASELINE_M))
    assumed = "assumed: the lesson's, as a disparity"
    bias = ErrorTerm("depth bias", "bias", 2e-3 / per_px, 5e-3 / per_px, "disparity", assumed)
    budget = ErrorBudget(lesson_terms(False), view, grasp or GraspAxes(), title="D405 on the wrist")
    return budget.with_term(bias)
