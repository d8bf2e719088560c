"""One look for all figures, figures that say in words what they show, and sliders under them."""

from __future__ import annotations

import base64
import html
import io
import math
import struct
from collections.abc import Callable, Iterable
from typing import Any

import matplotlib as mpl
from cycler import cycler
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from PIL import Image

from coursekit.checks import want
from coursekit.words import say, stacked

# Okabe-Ito, its two lightest darker for 3:1 on white: distinguishable with any colour vision; the
# same thing has the same colour everywhere.
COLORS = {
    "model": "#0072B2",  # what theory, a specification or a fit says
    "measured": "#D55E00",  # what was measured, or what a slider did
    "truth": "#009E73",
    "depth": "#3A98D2",  # the depth camera
    "color": "#CC79A7",  # the colour camera
    "block": "#7F7F7F",
    "cube": "#C48600",
    "ink": "#222222",
    "faint": "#BBBBBB",
}
DEPTH_COLORMAP = "viridis"
STYLES = ("-", "--", "-.", ":")
MARKERS = ("o", "s", "^", "D", "v")
SLIDER_UNITS = ("mm", "m", "px", "deg")

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
        "axes.prop_cycle": cycler(color=["#0072B2", "#D55E00", "#009E73", "#CC79A7", "#3A98D2"]),
    }
)


class LessonFigure(Figure):
    """A Matplotlib figure with a text alternative `alt`; a notebook shows it without pyplot."""

    alt: str = ""

    def saying(self, what: str, /, **facts: Any) -> LessonFigure:
        """The figure itself, with the facts in its text alternative, which texts.toml has."""
        self.alt = say(f"plots.{what}", **facts)
        return self

    def png(self) -> bytes:
        """The figure as a PNG file, of 256 colours: a third of the bytes of one of all colours."""
        drawn, small = io.BytesIO(), io.BytesIO()
        self.savefig(drawn, format="png", dpi=100)
        Image.open(drawn).convert("RGB").quantize(dither=Image.Dither.NONE).save(small, "png")
        return small.getvalue()

    def _repr_mimebundle_(self, **_: Any) -> tuple[dict[str, str], dict[str, Any]]:
        image = base64.b64encode(self.png()).decode("ascii")
        return {"image/png": image, "text/plain": self.alt}, {"image/png": {"alt": self.alt}}

    def _ipython_display_(self) -> None:
        show(self._repr_mimebundle_(), "The figure in words", self.alt)


def show(bundle: tuple[dict[str, Any], dict[str, Any]], says: str, alt: str) -> None:
    """A figure in a notebook and, as JupyterLab gives it no text alternative, its words below."""
    from IPython.display import display

    display(bundle[0], metadata=bundle[1], raw=True)
    words = f"<summary>{says}</summary>{html.escape(alt)}"
    display({"text/html": f'<details class="alt">{words}</details>'}, raw=True)


Draw = Callable[..., LessonFigure]


def figure(width: float = 8.0, height: float = 4.0) -> LessonFigure:
    """An empty figure, size in inches; who draws into it returns it `saying` what it shows."""
    return LessonFigure(figsize=(width, height), layout="constrained")


def single(width: float, height: float) -> tuple[LessonFigure, Axes]:
    """A figure of one pair of axes, size in inches, and these axes."""
    fig = figure(width, height)
    return fig, fig.subplots()


def panels(
    n: int, columns: int, width: float, row: float, more: float = 0.0, **others: Any
) -> tuple[LessonFigure, list[Any]]:
    """A figure of n axes in so many columns, and the n axes.

    width of the figure and height of a row in inches; more: how much higher the figure is. others:
    for Matplotlib's `Figure.subplots`, such as sharey=True.
    """
    rows = -(-n // columns)
    fig = figure(width, row * rows + more)
    axes = fig.subplots(rows, columns, squeeze=False, **others).ravel()
    for empty in axes[n:]:
        empty.set_visible(False)
    return fig, list(axes[:n])


def image_axes(ax: Axes, width: int, height: int) -> None:
    """Axes that end at an image's rim, in px, with v downwards."""
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), aspect="equal")
    ax.set(xlabel="u (px)", ylabel="v (px)")


def cross(ax: Axes) -> None:
    """Faint lines through (0, 0)."""
    ax.axhline(0, color=COLORS["faint"], lw=1)
    ax.axvline(0, color=COLORS["faint"], lw=1)


def plain_ticks(axis: Axis, ticks: Iterable[float], widen: bool = False) -> None:
    """Ticks of a logarithmic axis at these numbers, written as numbers.

    Those outside its range are left out, or else `widen` it.
    """
    low, high = axis.get_view_interval()
    shown = [t for t in ticks if widen or low <= t <= high]
    axis.set_ticks(shown, [f"{t:g}" for t in shown])
    axis.set_ticks([], minor=True)


def drag(draw: Draw, **sliders: tuple[float, float, float]) -> Draggable:
    """A figure drawn by `draw(**values)` with one slider a parameter, each (low, high, start).

    Raises ValueError under a slider's name where its start is not in its range.

    >>> from coursekit.plots import pinhole
    >>> drag(pinhole.similar_triangles, depth_m=(0.3, 1.2, 0.6)).start().alt[:26]
    'Side by side: the ray from'
    """
    for name, slider in sliders.items():
        fits = len(slider) == 3 and slider[0] <= slider[2] <= slider[1] and slider[0] < slider[1]
        want(fits, name, slider, "(low, high, start) in that range")
    return Draggable(draw, sliders)


class Draggable:
    """What `drag` returns: a widget where a kernel runs, else the figure at the start values."""

    def __init__(self, draw: Draw, sliders: dict[str, tuple[float, float, float]]) -> None:
        self.draw, self.sliders = draw, sliders

    def start(self) -> LessonFigure:
        """The figure at the start values."""
        return self.draw(**{name: start for name, (_, _, start) in self.sliders.items()})

    def widget(self) -> Any:
        """Sliders above an image that is drawn again at every step of a drag."""
        import ipywidgets

        fields = {}
        for name, (low, high, start) in self.sliders.items():
            step = 10.0 ** math.floor(math.log10((high - low) / 40))  # 40 to 400 of them
            fields[name] = ipywidgets.FloatSlider(
                value=start,
                min=start - step * math.floor((start - low) / step),  # a slider counts from here
                max=start + step * math.floor((high - start) / step),
                step=step,
                description=label(name),
                readout_format=f".{max(0, -round(math.log10(step)))}f",
                style={"description_width": "11em"},
                layout=ipywidgets.Layout(width="32em"),
            )
        image = ipywidgets.HTML(_picture(self.start()))  # ipywidgets.Image has no alternative text

        def redraw(_: Any) -> None:
            drawn = self.draw(**{name: field.value for name, field in fields.items()})
            image.value = _picture(drawn)

        for field in fields.values():
            field.observe(redraw, names="value")
        return stacked(*fields.values(), image)

    def __repr__(self) -> str:
        return self.start().alt

    def _ipython_display_(self) -> None:
        first = self.start()
        data, metadata = first._repr_mimebundle_()
        # ipywidgets 7 has no such method: then there is the picture
        widget: dict[str, Any] = getattr(self.widget(), "_repr_mimebundle_", dict)()
        says = "No sliders? Run this cell. The figure in words, as it is drawn first"
        show((widget | data, metadata), says, first.alt)


def _picture(drawn: LessonFigure) -> str:
    """A figure as HTML, with its text alternative; it keeps its place while it is drawn again."""
    png = drawn.png()
    width, height = struct.unpack(">II", png[16:24])
    source = base64.b64encode(png).decode("ascii")
    size = f"width: {width}px; max-width: 100%; aspect-ratio: {width}/{height}"
    address, words = f"data:image/png;base64,{source}", html.escape(drawn.alt)
    return f'<img src="{address}" alt="{words}" decoding="sync" style="{size}">'


def label(name: str) -> str:
    """`focal_length_mm` as `focal length (mm)`."""
    words, _, unit = name.rpartition("_")
    return f"{words.replace('_', ' ')} ({unit})" if unit in SLIDER_UNITS and words else name
