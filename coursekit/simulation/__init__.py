"""Scenes of boxes, their exact images, and the active-stereo rig that looks at them."""

from coursekit.simulation.active_stereo import Rig, StereoFrame, View
from coursekit.simulation.board_images import render_board
from coursekit.simulation.matching import cost_curve, match
from coursekit.simulation.render import RenderResult, render
from coursekit.simulation.scenes import Box, Scene, artefact_scene, tabletop, wall_scene
from coursekit.simulation.sessions import Effects, Truth, corner_session

__all__ = [
    "Box",
    "Effects",
    "RenderResult",
    "Rig",
    "Scene",
    "StereoFrame",
    "Truth",
    "View",
    "artefact_scene",
    "corner_session",
    "cost_curve",
    "match",
    "render",
    "render_board",
    "tabletop",
    "wall_scene",
]
