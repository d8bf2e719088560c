"""One look for all figures, and a figure that also says in words what it shows."""

from __future__ import annotations

import base64
import io
from typing import Any

import matplotlib as mpl
from cycler import cycler
from matplotlib.figure import Figure

# Okabe-Ito, distinguishable with any colour vision; the same thing has the same colour everywhere.
COLORS = {
    "model": "#0072B2",  # what theory, a specification or a fit says
    "measured": "#D55E00",  # what was measured, or what a slider did
    "truth": "#009E73",
    "depth": "#56B4E9",  # the depth camera
    "color": "#CC79A7",  # the colour camera
    "block": "#7F7F7F",
    "cube": "#E69F00",
    "ink": "#222222",
    "faint": "#BBBBBB",
}
DEPTH_COLORMAP = "viridis"

mpl.rcParams.update(
    {
        "font.size": 11,
        "axes.titlesize": 11,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": False,
        "lines.linewidth": 2,
        "legend.frameon": False,
        "image.cmap": DEPTH_COLORMAP,
        "axes.prop_cycle": cycler(color=["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9"]),
    }
)


class LessonFigure(Figure):
    """A Matplotlib figure with a text alternative `alt`; a notebook shows it without pyplot."""

    alt: str = ""

    def png(self) -> bytes:
        """The figure as a PNG file."""
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=100)
        return buffer.getvalue()

    def _repr_mimebundle_(self, **_: Any) -> tuple[dict[str, str], dict[str, Any]]:
        image = base64.b64encode(self.png()).decode("ascii")
        return {"image/png": image, "text/plain": self.alt}, {"image/png": {"alt": self.alt}}


def figure(width: float = 8.0, height: float = 4.0) -> LessonFigure:
    """An empty figure, size in inches; the caller draws into it and sets `alt`."""
    return LessonFigure(figsize=(width, height), layout="constrained")
