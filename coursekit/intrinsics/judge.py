"""Whether a calibration is good: what the views cover, how the boards are tilted, and a verdict."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.boards import Detection
    from coursekit.intrinsics.fit import IntrinsicsResult

    Floats = NDArray[np.float64]

CELLS = (6, 8)  # rows, columns
SIDES = ("left", "top", "right", "bottom")
GOOD_COVERAGE = 0.75  # of the cells
GOOD_MARGIN = 0.1  # of the width or height
GOOD_SPREAD_DEG = 10.0
GOOD_VIEWS = 10
GOOD_PX, USABLE_PX = 0.5, 2.0  # 95 %, in all but the worst 5 % of the image, at the boards' range
GOOD_FAR_PX, USABLE_FAR_PX = 2.0, 4.0  # the same for a direction (a point infinitely far away)
DETERMINED = 0.01  # 95 % of the focal length and of the centre, as shares of the focal length
LINE = 88


@dataclass(frozen=True, eq=False, repr=False)
class Coverage:
    """Where in the image corners were seen.

    counts (rows, columns): corners in each cell of the image. margins: what is empty at the left,
    top, right and bottom, as a share of the width or height. distances_px (N,): of all corners
    from the image's centre. size: (width, height), px.
    """

    counts: NDArray[np.intp]
    margins: tuple[float, float, float, float]
    distances_px: Floats
    size: tuple[int, int]

    @property
    def fraction(self) -> float:
        """The share of the cells with at least one corner."""
        return float(np.mean(self.counts > 0))

    @property
    def reach(self) -> float:
        """How far out the outermost corner lies: 0 the image's centre, 1 the image's corner."""
        return float(self.distances_px.max() / (math.hypot(*self.size) / 2))

    @property
    def empty_sides(self) -> tuple[str, ...]:
        """The sides of the image where more than a tenth of it saw no corner."""
        return tuple(s for s, m in zip(SIDES, self.margins, strict=True) if m > GOOD_MARGIN)

    def __repr__(self) -> str:
        margins = ", ".join(
            f"{100 * m:.0f} % {side}" for side, m in zip(SIDES, self.margins, strict=True)
        )
        rows, columns = self.counts.shape
        return (
            f"corners in {100 * self.fraction:.0f} % of {columns}x{rows} image cells, out to "
            f"{100 * self.reach:.0f} % of the half diagonal\nempty margins: {margins}"
        )


def coverage(detections: Sequence[Detection], cells: tuple[int, int] = CELLS) -> Coverage:
    """Where in the image the corners of all views lie.

    cells: (rows, columns) in which to count them. Raises ValueError for no detections.
    """
    if not len(detections):
        raise ValueError("detections: there are none")
    width, height = detections[0].size
    pixels = np.concatenate([d.pixels for d in detections])
    # pixel 0 is the centre of the first pixel: the image reaches from -0.5 to size - 0.5
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], cells, [(-0.5, height - 0.5), (-0.5, width - 0.5)]
    )
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margins = (
        (low[0] + 0.5) / width,
        (low[1] + 0.5) / height,
        (width - 0.5 - high[0]) / width,
        (height - 0.5 - high[1]) / height,
    )
    centre = np.array([width - 1, height - 1]) / 2
    return Coverage(
        counts=counts.astype(np.intp),
        margins=tuple(float(m) for m in margins),  # type: ignore[arg-type]
        distances_px=np.linalg.norm(pixels - centre, axis=1),
        size=(width, height),
    )


@dataclass(frozen=True, eq=False, repr=False)
class Tilts:
    """How the boards are turned out of the image plane.

    about_x_deg, about_y_deg (n,): of the board's normal about the camera's x axis (positive: the
    board's top is nearer) and y axis (positive: its right side is nearer). total_deg (n,): between
    the normal and the optical axis.
    """

    about_x_deg: Floats
    about_y_deg: Floats
    total_deg: Floats

    @property
    def spread_deg(self) -> tuple[float, float]:
        """The standard deviation about x and about y; parallel boards have none, however tilted."""
        return float(np.std(self.about_x_deg)), float(np.std(self.about_y_deg))

    def __repr__(self) -> str:
        spread = "{:.0f} and {:.0f}".format(*self.spread_deg)
        return (
            f"boards tilted {self.total_deg.min():.0f} to {self.total_deg.max():.0f} deg, "
            f"spread {spread} deg about x and y"
        )


def tilts(result: IntrinsicsResult) -> Tilts:
    """How far the board was tilted in each view."""
    normals = result.T_camera_board[:, :3, 2]
    x, y, z = (normals * np.sign(normals[:, 2:])).T  # away from the camera, whatever the origin
    return Tilts(
        about_x_deg=np.degrees(np.arctan2(-y, z)),
        about_y_deg=np.degrees(np.arctan2(x, z)),
        total_deg=np.degrees(np.arccos(np.clip(z, -1.0, 1.0))),
    )


# --- the verdict ---


def verdict(result: IntrinsicsResult) -> str:
    """In words whether a calibration is good, and if not, what it lacks and what to do.

    Judged by how far it may be wrong about where a point is seen, at the boards' range and
    infinitely far away (where a focal length that only suits one distance gives itself away), by
    what the corners cover, and by how the boards are tilted; not by the RMS.
    """
    facts = _Facts.of(result)
    weak = [reason for reason in facts.weaknesses() if reason]
    if not weak and max(facts.near_px / GOOD_PX, facts.far_px / GOOD_FAR_PX) > 1:
        weak = [
            "nothing is wrong with coverage and tilt, there is too little of it: take more views, "
            f"or sharper ones (the corners scatter by {facts.sigma_px:.2f} px)."
        ]
    if facts.bad:
        lines = [f"Not good enough: {facts.head()}"]
    elif weak:
        lines = [f"Usable with care: {facts.head()}"]
    else:
        lines = [f"Good: {facts.head()}"]
    lines += [f"- {reason}" for reason in weak]
    lines.append(
        f"The RMS of {result.rms_px:.2f} px says none of this: the poses absorb much of what is "
        "wrong with K, and the RMS stays small."
    )
    return "\n".join(_wrapped(line) for line in lines)


def _wrapped(line: str) -> str:
    """Broken into lines of at most `LINE` characters, never after a ±."""
    text = textwrap.fill(
        line.replace("± ", "±\0"), LINE, subsequent_indent="  ", break_on_hyphens=False
    )
    return text.replace("\0", " ")


@dataclass(frozen=True)
class _Facts:
    """What the verdict rests on. All but the last three are half widths of 95 % or plain facts.

    near, far: of a projection at the boards' range and infinitely far away; focal, centre: as
    shares of the focal length.
    """

    views: int
    converged: bool
    range_m: float
    near_px: float
    near_mm: float
    far_px: float
    focal: float
    centre_px: float
    centre: float
    coverage: Coverage
    spread_deg: tuple[float, float]
    sigma_px: float

    @classmethod
    def of(cls, result: IntrinsicsResult) -> _Facts:
        """Measured on a result."""
        range_m, wide = result.board_range_m, result.quantile()
        near, far = (
            wide * float(np.quantile(result.uncertainty_map(r), 0.95)) for r in (range_m, math.inf)
        )
        focal = max(result.sigma(f) / result.value(f) for f in ("fx", "fy"))
        centre = max(result.sigma(c) for c in ("cx", "cy"))
        return cls(
            views=len(result.residuals),
            converged=result.converged,
            range_m=range_m,
            near_px=near,
            near_mm=1e3 * near * range_m / result.value("fx"),
            far_px=far,
            focal=wide * focal,
            centre_px=wide * centre,
            centre=wide * centre / result.value("fx"),
            coverage=coverage(result.detections),
            spread_deg=tilts(result).spread_deg,
            sigma_px=result.sigma_px,
        )

    @property
    def determined(self) -> bool:
        """Whether K itself is known."""
        return max(self.focal, self.centre) < DETERMINED

    @property
    def bad(self) -> bool:
        """Whether the calibration should not be used."""
        known = self.near_px < USABLE_PX and self.far_px < USABLE_FAR_PX
        return not (self.converged and self.determined and known)

    def head(self) -> str:
        """The finding in one sentence."""
        if not self.determined:
            return (
                f"these {self.views} views do not determine K (f ± {100 * self.focal:.1f} %, "
                f"centre ± {self.centre_px:.0f} px, 95 %)."
            )
        return (
            f"in 95 % of the image a point {self.range_m:.2f} m away is seen where this camera "
            f"says to ± {self.near_px:.2f} px ({self.near_mm:.2f} mm), and a direction to "
            f"± {self.far_px:.2f} px (95 %)."
        )

    def weaknesses(self) -> list[str]:
        """What could be better, with what to do; "" for what could not."""
        seen, (about_x, about_y) = self.coverage, self.spread_deg
        flat = min(about_x, about_y) < GOOD_SPREAD_DEG
        sides = " and ".join(seen.empty_sides) if len(seen.empty_sides) < 4 else "all four"
        return [
            "" if self.converged else "the solver did not converge: remove views that are spoiled, "
            "or give a guess.",
            f"{self.views} views are few: take 20 to 40." if self.views < GOOD_VIEWS else "",
            f"the boards' tilts spread only {about_x:.0f} and {about_y:.0f} deg about x and y, and "
            "nearly parallel boards leave focal length and distance to trade against each other: "
            "tilt 30 to 45 deg about both axes, to both sides." if flat else "",
            f"no corners in the outer tenth of the image ({sides} sides): there the figures above "
            "extrapolate and hold only if the distortion model does. Push the board into the "
            "image's corners."
            if seen.empty_sides
            else "",
            f"only {100 * seen.fraction:.0f} % of the image saw a corner: fill the rest."
            if seen.fraction < GOOD_COVERAGE else "",
        ]  # fmt: skip
