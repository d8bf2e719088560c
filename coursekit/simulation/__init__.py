"""Scenes of boxes and their exact images: what the simulated camera looks at."""

from coursekit.simulation.render import RenderResult, render
from coursekit.simulation.scenes import Box, Scene, tabletop

__all__ = ["Box", "RenderResult", "Scene", "render", "tabletop"]
