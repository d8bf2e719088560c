"""The error budget: pixels, depth, hand-eye and arm errors as one table in millimetres."""

from coursekit.budget.beside import beside
from coursekit.budget.budget import AxisBudget, Draws, ErrorBudget, Row
from coursekit.budget.grasp import (
    CUBE,
    LESSON_GRIPPER,
    WIDOWX_GRIPPER,
    BestDistance,
    Gain,
    Gripper,
    Mounting,
    Success,
    Target,
    best_distance,
    centring_tolerance_m,
    sensitivity,
    success_probability,
    with_gripper,
)
from coursekit.budget.handover import Found, HandOver, hand_over
from coursekit.budget.propagate import (
    Chain,
    Covariances,
    FirstOrderCheck,
    check_first_order,
    ellipsoid,
    jacobian,
    monte_carlo,
    propagate,
)
from coursekit.budget.tables import lesson_budget, lesson_view, wrist_budget
from coursekit.budget.terms import ErrorTerm, autocorrelation, effective_frames
from coursekit.budget.view import AXES, GraspAxes, View, looking_down

__all__ = [
    "AXES",
    "CUBE",
    "LESSON_GRIPPER",
    "WIDOWX_GRIPPER",
    "AxisBudget",
    "BestDistance",
    "Chain",
    "Covariances",
    "Draws",
    "ErrorBudget",
    "ErrorTerm",
    "FirstOrderCheck",
    "Found",
    "Gain",
    "GraspAxes",
    "Gripper",
    "HandOver",
    "Mounting",
    "Row",
    "Success",
    "Target",
    "View",
    "autocorrelation",
    "beside",
    "best_distance",
    "centring_tolerance_m",
    "check_first_order",
    "effective_frames",
    "ellipsoid",
    "hand_over",
    "jacobian",
    "lesson_budget",
    "lesson_view",
    "looking_down",
    "monte_carlo",
    "propagate",
    "sensitivity",
    "success_probability",
    "with_gripper",
    "wrist_budget",
]
