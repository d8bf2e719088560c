"""What `capture` shows while it waits: a live image in a notebook, a progress bar elsewhere."""

from __future__ import annotations

import contextlib
import html
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import cv2
import numpy as np

from coursekit.cameras.guidance import outline

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.boards import Board, Detection
    from coursekit.cameras.guidance import Guidance
    from coursekit.geometry import Intrinsics

WANTED, SEEN, TAKEN = (0, 159, 230), (115, 158, 0), (233, 180, 86)  # Okabe-Ito, in BGR
LINE_PX = 2


class Screen(Protocol):
    """Where `capture` says what it sees and wants."""

    def say(self, text: str) -> None:
        """One sentence, once."""

    def show(
        self,
        image: NDArray[np.uint8],
        detection: Detection | None,
        wanted: Guidance,
        taken: Sequence[Detection],
        why: str = "",
    ) -> None:
        """An image (H, W), what is seen in it (None: nothing, and why), and what is wanted."""


@contextlib.contextmanager
def screen_for(board: Board, lens: Intrinsics, views: int) -> Iterator[Screen]:
    """A live image where a notebook's kernel runs, else a progress bar on standard error."""
    if _in_notebook():
        from IPython.display import display

        live = LiveImage(board, lens, views)
        display(live)
        yield live
    else:
        from tqdm.auto import tqdm

        with tqdm(total=views, unit="view", leave=False) as bar:
            yield Bar(bar)


class Bar:
    """A progress bar with the next view's description."""

    def __init__(self, bar: Any) -> None:
        self._bar = bar

    def say(self, text: str) -> None:
        self._bar.set_postfix_str(text)

    def show(
        self,
        image: NDArray[np.uint8],
        detection: Detection | None,
        wanted: Guidance,
        taken: Sequence[Detection],
        why: str = "",
    ) -> None:
        self._bar.n = len(taken)
        self._bar.set_postfix_str(why or f"next: {wanted.next}")


class LiveImage:
    """A widget: the image with what is seen, taken and wanted drawn into it, and words below."""

    def __init__(self, board: Board, lens: Intrinsics, views: int) -> None:
        import ipywidgets

        self._board, self._lens, self._views = board, lens, views
        self._said = ""
        self._image = ipywidgets.Image(format="jpeg", value=_jpeg(np.zeros((48, 64, 3), np.uint8)))
        self._image.layout.max_width = "100%"
        self._words = ipywidgets.HTML("Waiting for the first image ...")
        self._box = ipywidgets.VBox([self._image, self._words])

    def say(self, text: str) -> None:
        self._said = text

    def show(
        self,
        image: NDArray[np.uint8],
        detection: Detection | None,
        wanted: Guidance,
        taken: Sequence[Detection],
        why: str = "",
    ) -> None:
        ring = outline(self._board, wanted.target, self._lens)
        self._image.value = _jpeg(draw(image, detection, ring, taken))
        lines = [f"<b>{len(taken)} of {self._views} views.</b> {html.escape(self._said)}"]
        lines.append(f"<b>Next:</b> {html.escape(wanted.next)}.")
        lines += [html.escape(f"Missing: {text}") for text in wanted.missing]
        if detection is None:
            lines.append(f"<i>{html.escape(why)}</i>")
        self._words.value = "<br>".join(lines)

    def __repr__(self) -> str:
        return "The live image appears here while the cell runs."

    def _repr_mimebundle_(self, **kwargs: Any) -> dict[str, Any]:
        """The widget, and a text that is the same at each run where widgets are not shown."""
        return self._box._repr_mimebundle_(**kwargs) | {"text/plain": repr(self)}


def draw(
    image: NDArray[np.uint8],
    detection: Detection | None,
    ring: NDArray[np.float64],
    taken: Sequence[Detection],
) -> NDArray[np.uint8]:
    """The image (H, W) in colour (H, W, 3), BGR, with the corners that were taken, those that are
    seen, and the outline (4, 2) px that is wanted."""
    canvas = np.repeat(image[..., None], 3, axis=2)
    for view in taken:
        for u, v in np.rint(view.pixels).astype(int):
            cv2.circle(canvas, (int(u), int(v)), 1, TAKEN, -1)
    if detection is not None:
        for u, v in np.rint(detection.pixels).astype(int):
            cv2.circle(canvas, (int(u), int(v)), 4, SEEN, LINE_PX)
    if np.isfinite(ring).all():
        cv2.polylines(canvas, [np.rint(ring).astype(np.int32)], True, WANTED, LINE_PX)
    return canvas


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", image)[1].tobytes()


def _in_notebook() -> bool:
    from IPython import get_ipython

    return getattr(get_ipython(), "kernel", None) is not None
