"""What was seen of a board in one image, and in many."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, overload

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

LISTED, LISTED_SKIPPED = 6, 20  # lines that a repr shows at most


class BoardNotFound(ValueError):
    """The board is not in the image; the message says what is there instead, or what to mend."""


@dataclass(frozen=True, eq=False)
class Detection:
    """The corners of a board that one image shows.

    ids (N,): rows of `board.points`, ascending. pixels (N, 2): where they are, px. size: (width,
    height) of the image, px. name: what the image is called. noise_px: the standard deviation of
    one coordinate of one corner that the image's noise causes, root mean square over the corners.
    blur (2, 2): covariance of the blur, px^2: an edge with the unit normal n is blurred as by a
    Gaussian with variance n @ blur @ n, the pixel's own width (1/12 px^2) included. Equal
    eigenvalues are defocus; one much larger than the other is motion, along its eigenvector.
    noise_px and blur are None where nothing was measured.
    """

    ids: NDArray[np.intp]
    pixels: Floats
    size: tuple[int, int]
    name: str = ""
    noise_px: float | None = None
    blur: Floats | None = None

    def __post_init__(self) -> None:
        ids = np.array(self.ids)
        if ids.ndim != 1 or not (np.issubdtype(ids.dtype, np.integer) or ids.size == 0):
            raise ValueError(f"ids: got {ids.dtype} of shape {ids.shape}, want (N,) whole numbers")
        pixels = np.array(self.pixels, np.float64)
        if pixels.shape != (len(ids), 2):
            raise ValueError(f"pixels: got shape {pixels.shape}, want ({len(ids)}, 2)")
        width, height = self.size
        object.__setattr__(self, "ids", _frozen(ids.astype(np.intp)))
        object.__setattr__(self, "pixels", _frozen(pixels))
        object.__setattr__(self, "size", (int(width), int(height)))
        if self.blur is not None:
            blur = np.array(self.blur, np.float64)
            if blur.shape != (2, 2):
                raise ValueError(f"blur: got shape {blur.shape}, want (2, 2)")
            object.__setattr__(self, "blur", _frozen(blur))

    def __len__(self) -> int:
        """How many corners."""
        return len(self.ids)

    @property
    def blur_px(self) -> float | None:
        """Standard deviation of the blur in the direction where it is worst, px."""
        return None if self.blur is None else float(np.sqrt(np.linalg.eigvalsh(self.blur)[-1]))

    def __repr__(self) -> str:
        text = f"{self.name or 'detection'}: {len(self)} corners in {_times(self.size)}"
        if self.noise_px is not None:
            text += f", noise {self.noise_px:.3f} px"
        if self.blur_px is not None:
            text += f", blur {self.blur_px:.2f} px"
        return text


@dataclass(frozen=True)
class Skipped:
    """An image that was not used, and why."""

    name: str
    reason: str

    def __repr__(self) -> str:
        return f"{self.name}: {self.reason}"


class Detections(Sequence[Detection]):
    """What was seen in many images, in their order, like an immutable list.

    skipped: the images that were not used. A slice keeps it; `pick` takes any choice of views.
    """

    def __init__(self, views: Iterable[Detection] = (), skipped: Iterable[Skipped] = ()) -> None:
        self._views = tuple(views)
        self.skipped = tuple(skipped)
        for view in self._views:
            if not isinstance(view, Detection):
                raise ValueError(f"views: got a {type(view).__name__}, want Detection")

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of all images, px; ValueError when there is none or they differ."""
        if not self._views:
            raise ValueError("detections: there are none, so there is no image size")
        first = self._views[0]
        for number, view in enumerate(self._views):
            if view.size != first.size:
                raise ValueError(
                    f"detections: view {number} ({view.name}) is {_times(view.size)} px, the first "
                    f"{_times(first.size)}: one calibration is for one size"
                )
        return first.size

    @overload
    def __getitem__(self, index: int) -> Detection: ...
    @overload
    def __getitem__(self, index: slice) -> Detections: ...
    def __getitem__(self, index: int | slice) -> Detection | Detections:
        if isinstance(index, slice):
            return Detections(self._views[index], self.skipped)
        return self._views[index]

    def pick(self, which: Iterable[int]) -> Detections:
        """The views with these numbers, in this order."""
        return Detections((self._views[number] for number in which), self.skipped)

    def __len__(self) -> int:
        return len(self._views)

    def __repr__(self) -> str:
        corners = sum(len(view) for view in self._views)
        heads = [f"{len(self)} view{'s' * (len(self) != 1)} with {corners} corners"]
        if self.skipped:
            heads.append(f"{len(self.skipped)} not used")
        lines = [", ".join(heads)]
        lines += [f"  {view!r}" for view in self._views[:LISTED]]
        if len(self) > LISTED:
            lines.append(f"  and {len(self) - LISTED} more")
        lines += [f"  not used: {skip!r}" for skip in self.skipped[:LISTED_SKIPPED]]
        if len(self.skipped) > LISTED_SKIPPED:
            lines.append(f"  and {len(self.skipped) - LISTED_SKIPPED} more not used")
        return "\n".join(lines)


def _times(size: tuple[int, int]) -> str:
    return f"{size[0]}x{size[1]}"


def _frozen(array: NDArray[np.generic]) -> NDArray[np.generic]:
    array.flags.writeable = False
    return array
