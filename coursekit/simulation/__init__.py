"""Scenes of boxes, their exact images, and the active-stereo rig that looks at them."""

from __future__ import annotations

from coursekit.simulation.arm_sessions import (
    HandEyeMistakes,
    default_setup,
    hand_eye_session,
    session_folder,
    shared_target,
    touch_corners,
    truth_of,
    unknown_sessions,
)
from coursekit.simulation.corner_sessions import Effects, corner_session
from coursekit.simulation.rig import Rig, RigView, cost_curve, match
from coursekit.simulation.scenes import (
    Box,
    Scene,
    artefact_scene,
    flying_pixels,
    render,
    tabletop,
    wall_scene,
)
