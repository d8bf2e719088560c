"""Figures of notebook 05."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.patches import Ellipse, Rectangle

from coursekit.arrays import ArrayLike
from coursekit.attribution.verdict import SimulatedMisses
from coursekit.budget import ErrorBudget, Gripper, Target
from coursekit.plots.style import COLORS, LessonFigure, panels, single

KINDS = {"bias": "measured", "noise": "depth"}
CHI2_95_IN_A_PLANE = 5.991  # of two degrees of freedom


def bars(budget: ErrorBudget) -> LessonFigure:
    """Each row of a budget in millimetres at the object.

    Bias: dark to its least, light to its most. Noise (one sigma): light in a single frame, dark in
    the mean of the budget's frames. A tick: the most that the row does along the closing axis,
    where the rows know their directions.
    """
    rows, averaged = budget.rows, budget.averaged_m
    fig, ax = single(8.6, 0.5 * len(rows) + 1.3)
    said = []
    for y, row in enumerate(rows):
        name, kind = row.term.name, row.term.kind
        high, low = 1000 * row.high_m, 1000 * averaged.get(name, row.low_m)
        color = COLORS[KINDS[kind]]
        ax.barh(y, high, color=color, height=0.6, alpha=0.45)
        ax.barh(y, low, color=color, height=0.6)
        said.append(f"{name} {low:.1f} to {high:.1f} mm ({kind})")
        if row.term.stated_m is None:
            closing = 1000 * row.along_m[0]
            ax.plot([closing] * 2, [y - 0.42, y + 0.42], color=COLORS["ink"], lw=2.5)
            said[-1] += f", {closing:.1f} along closing"
    tolerance = 1000 * budget.grasp.tolerance_m[0]
    ax.axvline(tolerance, color=COLORS["ink"], ls="--")
    ax.annotate(f"closing tolerance ±{tolerance:g} mm", (tolerance, -0.7), (4, 0),
                textcoords="offset points", fontsize=10, va="center")  # fmt: skip
    ax.set_yticks(range(len(rows)), [f"{row.term.name} ({row.term.kind})" for row in rows])
    right = max(1.5 * tolerance, 1050 * max(row.high_m for row in rows))
    ax.set(xlabel="at the object (mm)", xlim=(0, right), ylim=(len(rows) - 0.5, -1.0))
    ax.set_ylabel(" ")
    return fig.saying("bars", each="; ".join(said))


def between_fingers(
    gripper: Gripper,
    target: Target,
    covariance: ArrayLike,
    bias_mm: ArrayLike,
    others_mm: ArrayLike = (),
) -> LessonFigure:
    """The object between the fingers from above, at true scale, and where its centre may be.

    covariance (3, 3): of the centre along closing, approach and lateral, m^2, drawn as the ellipse
    that holds 95 %. bias_mm (3,): its middle. others_mm (n, 3): biases of other rigs, as dots.
    """
    flat, bias = 1e6 * np.asarray(covariance)[::2, ::2], np.asarray(bias_mm, float)
    others = np.reshape(np.asarray(others_mm, float), (-1, 3))
    width, opening = 1000 * target.width_m, 1000 * gripper.opening_m
    room, reach = (opening - width) / 2, opening / 2 + 10
    fig, ax = single(6.0, 4.8)
    ax.add_patch(Rectangle((-width / 2, -width / 2), width, width, fc=COLORS["cube"], alpha=0.25))
    for side in (-1, 1):
        ax.bar(side * (opening / 2 + 4), 16, 8, -8, color=COLORS["block"])  # a finger
        ax.axvline(side * room, color=COLORS["ink"], ls="--", lw=1)
    ax.plot(others[:, 0], others[:, 2], ".", ms=2, color=COLORS[KINDS["bias"]], alpha=0.7)
    values, vectors = np.linalg.eigh(flat)
    long, short = half = np.sqrt(CHI2_95_IN_A_PLANE * np.clip(values, 0, None))[::-1]
    turn = np.degrees(np.arctan2(vectors[1, 1], vectors[0, 1]))
    ax.add_patch(Ellipse((bias[0], bias[2]), 2 * long, 2 * short, angle=turn, alpha=0.5,
                         fc=COLORS[KINDS["noise"]], ec=COLORS[KINDS["noise"]], lw=2))  # fmt: skip
    ax.plot(bias[0], bias[2], "o", ms=5, color=COLORS[KINDS["bias"]], mec=COLORS["ink"])
    ax.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal",
           xlabel="closing (mm)", ylabel="lateral (mm)")  # fmt: skip
    ax.set_title(f"from above: the centre must stay within ±{room:.1f} mm")
    lengths = {"width": width, "opening": opening, "room": room, "off": np.linalg.norm(bias)}
    return fig.saying("between_fingers", half=half, bias=bias, dots=len(others), **lengths)


def misses(sets: Mapping[str, SimulatedMisses], times: float = 15.0) -> LessonFigure:
    """Sets of misses from above, each arrow where its grasp was and so many times as long."""
    fig, axes = panels(len(sets), 2, 9.6, 3.0, sharex=True, sharey=True)
    ends = [one.T_base_gripper[:, :2, 3] + times * one.misses[:, :2] for one in sets.values()]
    forward, left = np.concatenate(ends).T
    wide, texts = 1.05 * np.abs(left).max(), []
    for ax, (name, one) in zip(axes, sets.items(), strict=True):
        (x, y), (right, up) = one.T_base_gripper[:, :2, 3].T, times * one.misses[:, 1::-1].T
        ax.quiver(y, x, right, up, angles="xy", scale_units="xy", scale=1, width=0.006,
                  color=COLORS["measured"])  # fmt: skip
        ax.plot(y, x, ".", ms=4, color=COLORS["ink"])
        ax.set(xlim=(wide, -wide), ylim=(min(0.0, forward.min()), 1.05 * forward.max()),
               aspect="equal", title=f"{name}, {len(one.misses)} trials",
               xlabel="y of the base, to the left (m)", ylabel="x, forward (m)")  # fmt: skip
        ax.label_outer()
        mean_mm = 1000 * np.linalg.norm(one.misses.mean(axis=0))
        texts.append(f"{name}, {len(one.misses)} trials, mean {mean_mm:.1f} mm")
    return fig.saying("misses", times=times, each="; ".join(texts))
