"""A figure with sliders that is also a figure where there is no kernel."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from coursekit.plots.style import LessonFigure

Draw = Callable[..., LessonFigure]
UNITS = ("mm", "m", "px", "deg")


def drag(draw: Draw, **sliders: tuple[float, float, float]) -> Draggable:
    """A figure drawn by `draw(**values)` with one slider a parameter, each (low, high, start)."""
    for name, slider in sliders.items():
        if len(slider) != 3 or not slider[0] <= slider[2] <= slider[1] or slider[0] == slider[1]:
            raise ValueError(f"{name}: got {slider}, want (low, high, start) in that range")
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
            step = 10.0 ** math.floor(math.log10((high - low) / 50))
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
        first = self.start()
        image = ipywidgets.Image(value=first.png(), format="png")
        image.layout.max_width = "100%"

        def redraw(_: Any) -> None:
            drawn = self.draw(**{name: field.value for name, field in fields.items()})
            image.value = drawn.png()

        for field in fields.values():
            field.observe(redraw, names="value")
        return ipywidgets.VBox([*fields.values(), image])

    def __repr__(self) -> str:
        return self.start().alt

    def _repr_mimebundle_(self, **kwargs: Any) -> tuple[dict[str, Any], dict[str, Any]]:
        data, metadata = self.start()._repr_mimebundle_()
        return self.widget()._repr_mimebundle_(**kwargs) | data, metadata


def label(name: str) -> str:
    """`focal_length_mm` as `focal length (mm)`."""
    words, _, unit = name.rpartition("_")
    return f"{words.replace('_', ' ')} ({unit})" if unit in UNITS and words else name
