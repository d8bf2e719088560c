"""Scenes of boxes, their exact images, and the active-stereo rig that looks at them."""

from coursekit.simulation.active_stereo import Rig, StereoFrame, View
from coursekit.simulation.matching import cost_curve, match
from coursekit.simulation.render import RenderResult, render
from coursekit.simulation.scenes import Box, Scene, artefact_scene, tabletop, wall_scene

__all__ = [
    "Box",
    "RenderResult",
    "Rig",
    "Scene",
    "StereoFrame",
    "View",
    "artefact_scene",
    "cost_curve",
    "match",
    "render",
    "tabletop",
    "wall_scene",
]
