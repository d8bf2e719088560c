"""Scenes of boxes, their exact images, and the active-stereo rig that looks at them."""

from coursekit.simulation.active_stereo import Rig, StereoFrame, View
from coursekit.simulation.board_images import render_board
from coursekit.simulation.hand_eye_sessions import (
    HandEyeMistakes,
    default_setup,
    hand_eye_session,
    truth_of,
)
from coursekit.simulation.matching import cost_curve, match
from coursekit.simulation.physical_tests import shared_target, touch_corners
from coursekit.simulation.render import RenderResult, render
from coursekit.simulation.scenes import Box, Scene, artefact_scene, tabletop, wall_scene
from coursekit.simulation.sessions import Effects, Truth, corner_session

__all__ = [
    "Box",
    "Effects",
    "HandEyeMistakes",
    "RenderResult",
    "Rig",
    "Scene",
    "StereoFrame",
    "Truth",
    "View",
    "artefact_scene",
    "corner_session",
    "cost_curve",
    "default_setup",
    "hand_eye_session",
    "match",
    "render",
    "render_board",
    "shared_target",
    "tabletop",
    "touch_corners",
    "truth_of",
    "wall_scene",
]
