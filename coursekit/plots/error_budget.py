"""Figures of notebook 05."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.patches import Ellipse, Rectangle
from numpy.typing import ArrayLike, NDArray

from coursekit.plots.style import COLORS, LessonFigure, figure

if TYPE_CHECKING:
    from coursekit.budget import BestDistance, Draws, ErrorBudget, Gripper, Target

KINDS = {"bias": "measured", "noise": "depth"}
CHI2_95 = 5.991  # of two degrees of freedom


def bars(budget: ErrorBudget) -> LessonFigure:
    """Each row of a budget in millimetres at the object: from its least to its largest."""
    rows = budget.rows
    fig = figure(8.6, 0.5 * len(rows) + 1.3)
    ax = fig.subplots()
    for y, row in enumerate(rows):
        low, high = 1000 * row.low_m, 1000 * row.high_m
        color = COLORS[KINDS[row.term.kind]]
        ax.barh(y, high, color=color, height=0.6, alpha=0.45)
        ax.barh(y, low, color=color, height=0.6)
    ax.axvline(1000 * budget.grasp.tolerance_m[0], color=COLORS["ink"], ls="--")
    ax.annotate("closing tolerance", (1000 * budget.grasp.tolerance_m[0], -0.7), (4, 0),
                textcoords="offset points", fontsize=10, va="center")  # fmt: skip
    ax.set_yticks(range(len(rows)), [f"{row.term.name} ({row.term.kind})" for row in rows])
    ax.set(xlabel="at the object (mm)", ylim=(len(rows) - 0.5, -1.0))
    ax.set_ylabel(" ")
    fig.alt = "The budget's rows at the object: " + "; ".join(
        f"{r.term.name} {1000 * r.low_m:.1f} to {1000 * r.high_m:.1f} mm ({r.term.kind})"
        for r in rows
    )
    return fig


def biases(draws: Draws, tolerance_m: float) -> LessonFigure:
    """Many rigs of one budget: how long their bias is, and how much of it lies along closing."""
    fig = figure(9.0, 3.6)
    length, along = fig.subplots(1, 2)
    norm, closing = 1000 * draws.norm_m, 1000 * draws.along_m[:, 0]
    length.hist(norm, 60, color=COLORS["measured"], density=True)
    along.hist(closing, 60, color=COLORS["measured"], density=True)
    for ax, places in ((length, (1,)), (along, (-1, 1))):
        for sign in places:
            ax.axvline(1000 * sign * tolerance_m, color=COLORS["ink"], ls="--")
        ax.set_yticks([])
    over = 100 * np.mean(norm > 1000 * tolerance_m)
    out = 100 * np.mean(np.abs(closing) > 1000 * tolerance_m)
    length.set(xlabel="length of the bias (mm)", ylabel="share of rigs")
    along.set(xlabel="bias along the closing axis (mm)")
    length.set_title(f"{over:.1f} % beyond ±{1000 * tolerance_m:g} mm")
    along.set_title(f"{out:.1f} % beyond ±{1000 * tolerance_m:g} mm")
    fig.alt = (
        f"Bias of many rigs: mean length {norm.mean():.1f} mm, {over:.1f} % longer than "
        f"{1000 * tolerance_m:g} mm; along the closing axis {out:.1f} % beyond it."
    )
    return fig


def between_fingers(
    gripper: Gripper, target: Target, covariance: ArrayLike, bias_mm: ArrayLike
) -> LessonFigure:
    """The cube between the fingers from above, at true scale, and where its centre may be.

    covariance (2, 2): of closing and approach, m^2, drawn as the ellipse that holds 95 %.
    bias_mm (2,): where the ellipse's middle is.
    """
    fig = figure(7.2, 4.2)
    ax = fig.subplots()
    width, opening = 1000 * target.width_m, 1000 * gripper.opening_m
    for side in (-1, 1):
        ax.add_patch(Rectangle((side * opening / 2 - (side < 0) * 10, -20), 10, 40,
                               color=COLORS["block"]))  # fmt: skip
    ax.add_patch(Rectangle((-width / 2, -width / 2), width, width, fc=COLORS["cube"], alpha=0.6))
    values, vectors = np.linalg.eigh(1e6 * np.asarray(covariance))
    size = 2 * np.sqrt(CHI2_95 * values)
    turn = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    middle = np.asarray(bias_mm, float)
    place = Ellipse((middle[0], middle[1]), size[1], size[0], angle=turn, fill=False, lw=2)
    place.set(edgecolor=COLORS["measured"], label="centre of the cube, 95 %")
    ax.add_patch(place)
    ax.plot(*middle, "o", color=COLORS["measured"])
    room = (opening - width) / 2
    for side in (-1, 1):
        ax.axvline(side * room, color=COLORS["ink"], ls="--", lw=1)
    reach = max(opening / 2 + 15, 45)
    ax.set(xlim=(-reach, reach), ylim=(-32, 32), aspect="equal",
           xlabel="along the closing axis (mm)", ylabel="along the approach (mm)")  # fmt: skip
    ax.set_title(f"room ±{room:.1f} mm (dashed)")
    ax.legend(loc="upper right")
    fig.alt = (
        f"A {width:g} mm cube between fingers that open {opening:g} mm, with the ellipse that "
        f"holds its centre in 95 of 100 grasps: {size[1] / 2:.1f} by {size[0] / 2:.1f} mm, its "
        f"middle {np.hypot(*middle):.1f} mm off; the room is ±{room:.1f} mm."
    )
    return fig


def distances(best: BestDistance) -> LessonFigure:
    """A figure of the budget against the mounting distance, with what limits the distance."""
    fig = figure(8.0, 3.6)
    ax = fig.subplots()
    ax.plot(best.distances_m, 1000 * np.asarray(best.figures_m), color=COLORS["model"])
    ax.plot(best.distance_m, 1000 * best.figure_m, "o", color=COLORS["measured"])
    ax.set(xlabel="distance Z (m)", ylabel="error along closing (mm)", ylim=(0, None))
    fig.alt = (
        f"Error along the closing axis against the mounting distance: least, "
        f"{1000 * best.figure_m:.1f} mm, at {best.distance_m:.2f} m; allowed are "
        f"{best.low_m:.2f} to {best.high_m:.2f} m."
    )
    return fig


def misses(sets: Mapping[str, NDArray[Any]]) -> LessonFigure:
    """Sets of misses (n, 3), m, from above, each from the origin as an arrow."""
    fig = figure(9.6, 3.0)
    axes = fig.subplots(1, len(sets), sharex=True, sharey=True, squeeze=False)[0]
    reach = 1.1 * max(1000 * np.abs(m[:, :2]).max() for m in sets.values())
    for ax, (name, m) in zip(axes, sets.items(), strict=True):
        zero = np.zeros(len(m))
        ax.quiver(zero, zero, 1000 * m[:, 0], 1000 * m[:, 1], angles="xy", scale_units="xy",
                  scale=1, width=0.012, color=COLORS["measured"])  # fmt: skip
        ax.plot(0, 0, "+", ms=12, color=COLORS["ink"])
        ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal", title=name,
               xlabel="x of the base (mm)", ylabel="y of the base (mm)")  # fmt: skip
        ax.label_outer()
    fig.alt = "Misses from above: " + "; ".join(
        f"{name}, {len(m)} trials, mean {1000 * np.linalg.norm(m.mean(axis=0)):.1f} mm"
        for name, m in sets.items()
    )
    return fig
