"""The WidowX AI: forward kinematics from data/, and a simulated arm with hidden errors."""

from coursekit.arm.errors import (
    HOME,
    ArmErrors,
    ArmTruth,
    FkErrors,
    SimulatedArm,
    fk_covariance,
    fk_error,
    load_side,
)
from coursekit.arm.kinematics import Arm, pose_difference, widowx

__all__ = [
    "HOME",
    "Arm",
    "ArmErrors",
    "ArmTruth",
    "FkErrors",
    "SimulatedArm",
    "fk_covariance",
    "fk_error",
    "load_side",
    "pose_difference",
    "widowx",
]
