"""The error budget: pixels, depth, hand-eye and arm errors as one table in millimetres."""

from __future__ import annotations

from coursekit.budget.budget import (
    Draws,
    ErrorBudget,
    ErrorTerm,
    autocorrelation,
    independent_frames,
)
from coursekit.budget.grasp import (
    CUBE,
    LESSON_GRIPPER,
    WIDOWX_GRIPPER,
    Gripper,
    Ranking,
    Target,
    centring_tolerance_m,
    sensitivity,
    success_probability,
    with_gripper,
)
from coursekit.budget.handover import HandOver, hand_over, lesson_budget, lesson_view, wrist_budget
from coursekit.budget.propagation import (
    Chain,
    Covariances,
    check_first_order,
    monte_carlo,
    propagate,
)
from coursekit.budget.view import AXES, GraspAxes, View, looking_down
