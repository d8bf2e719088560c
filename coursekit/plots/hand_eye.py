"""Figures of notebook 04."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import ArrayLike, Floats
from coursekit.hand_eye import StudyPoint
from coursekit.plots.style import (
    COLORS,
    MARKERS,
    STYLES,
    LessonFigure,
    cross,
    panels,
    plain_ticks,
    single,
)
from coursekit.simulation.arm_poses import Setup

AXIS_M = 0.09  # how long a frame's axes are drawn


def mounts(setups: Mapping[str, Setup], joints: Mapping[str, ArrayLike]) -> LessonFigure:
    """Rigs from the side, at true scale: the arm's links, the camera's view, the board.

    joints: the joint angles (6,), rad, at which each rig is drawn. Seen from the arm's right, so
    x of the base points to the right and z up.
    """
    fig, axes = panels(len(setups), len(setups), 9.6, 4.4, sharey=True)
    for ax, (name, setup) in zip(axes, setups.items(), strict=True):
        _side_view(ax, setup, np.asarray(joints[name], float))
        ax.set_title(name)
        ax.label_outer()
    return fig.saying(
        "Side views at true scale: with the camera on the wrist it looks along the gripper at a "
        "board on the table; with the camera over the shoulder it looks down at a board in the "
        "gripper."
    )


def _side_view(ax: Any, setup: Setup, q: Floats) -> None:
    T_base_gripper = setup.arm.forward(q)
    links = setup.arm.link_frames(q)[:, :3, 3]
    chain = np.concatenate([[[0.0, 0.0, 0.0]], links, T_base_gripper[None, :3, 3]])
    ax.plot(chain[:, 0], chain[:, 2], "o-", color=COLORS["block"], lw=5, ms=7)
    on_wrist = setup.mount == "eye_in_hand"
    T_base_camera = T_base_gripper @ setup.X if on_wrist else setup.X
    T_base_board = setup.Y if on_wrist else T_base_gripper @ setup.Y
    rim = setup.board.points[[0, setup.board.corners[0] - 1, -1, -setup.board.corners[0]]]
    board = rim @ T_base_board[:3, :3].T + T_base_board[:3, 3]
    ax.plot(*board[[0, 1, 2, 3, 0]][:, [0, 2]].T, color=COLORS["ink"], lw=3)
    ax.annotate("board", board[2, [0, 2]], (8, 8), textcoords="offset points")
    eye = T_base_camera[:3, 3]
    for corner in board:
        ax.plot(*np.array([eye, corner])[:, [0, 2]].T, color=COLORS["color"], lw=0.8)
    for T, label, offset in (
        (np.eye(4), "base", (-10, -16)),
        (T_base_gripper, "gripper", (10, -18)),
        (T_base_camera, "camera", (-34, 16)),
    ):
        _axes(ax, T)
        ax.annotate(label, T[[0, 2], 3], offset, textcoords="offset points", fontsize=10,
                    bbox={"fc": "white", "ec": "none", "alpha": 0.7, "pad": 1})  # fmt: skip
    ax.axhline(0, color=COLORS["faint"], lw=1)
    ax.set(aspect="equal", xlabel="x of the base (m)", ylabel="z of the base (m)",
           xlim=(-0.3, 0.75), ylim=(-0.08, 0.9))  # fmt: skip


def _axes(ax: Any, T: Floats) -> None:
    """A frame's x and z axis as they look from the side."""
    at = T[[0, 2], 3]
    for column, color in ((0, "measured"), (2, "model")):
        tip = at + AXIS_M * T[[0, 2], column]
        ax.annotate("", tip, at, arrowprops={"arrowstyle": "-|>", "color": COLORS[color], "lw": 2})
        ax.annotate("xyz"[column], tip, color=COLORS[color], fontweight="bold", fontsize=10)


def diversity(sessions: Mapping[str, Floats]) -> LessonFigure:
    """Where grippers were and how they were turned: poses (n, 4, 4) of some sessions.

    Rotations are those from the session's mean, as rotation vectors along the gripper's axes.
    """
    fig, (places, turns) = panels(2, 2, 9.6, 4.0)
    texts = []
    for marker, color, (name, T) in zip(
        MARKERS, ("measured", "model", "truth"), sessions.items(), strict=False
    ):
        style = {"marker": marker, "ls": "", "color": COLORS[color], "label": name}
        places.plot(T[:, 0, 3], T[:, 1, 3], **style)
        R = Rotation.from_matrix(T[:, :3, :3])
        vectors = np.degrees((R.mean().inv() * R).as_rotvec())
        turns.plot(vectors[:, 1], vectors[:, 2], **style)
        texts.append(f"{name}: turned by up to {np.linalg.norm(vectors, axis=1).max():.0f} deg")
    places.set(aspect="equal", xlabel="x of the base (m)", ylabel="y of the base (m)")
    places.set_title("the gripper from above")
    cross(turns)
    reach = max(10.0, 1.1 * np.abs([*turns.get_xlim(), *turns.get_ylim()]).max())
    turns.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal",
              xlabel="turned about the gripper's y (deg)",
              ylabel="turned about the gripper's z (deg)")  # fmt: skip
    turns.set_title("how it was turned, from the mean")
    turns.legend(loc="best")
    return fig.saying(
        "Gripper places from above, and rotations from their mean. " + "; ".join(texts)
    )


def study(points: Sequence[StudyPoint]) -> LessonFigure:
    """Median error of X against the range of rotation, one line for each number of axes."""
    fig, (turn, shift) = panels(2, 2, 9.0, 3.8)
    for style, marker, axes in zip(STYLES, MARKERS, sorted({p.axes for p in points}), strict=False):
        chosen = sorted((p for p in points if p.axes == axes), key=lambda p: p.range_deg)
        ranges = [p.range_deg for p in chosen]
        for ax, values in (
            (turn, [p.rotation_deg for p in chosen]),
            (shift, [p.translation_mm for p in chosen]),
        ):
            ax.plot(ranges, values, ls=style, marker=marker, color=COLORS["model"],
                    label=f"about {axes} axes")  # fmt: skip
    for ax, label in ((turn, "rotation of X (deg)"), (shift, "translation of X (mm)")):
        ax.set(xlabel="the wrist turns by up to ± (deg)", ylabel=f"median error, {label}",
               ylim=(0, None))  # fmt: skip
        ax.legend()
    return fig.saying(
        "Median error of X against the range of rotation: " + "; ".join(map(repr, points))
    )


def more_poses(
    counts: Sequence[int], error_mm: Mapping[str, ArrayLike], half_mm: Mapping[str, ArrayLike]
) -> LessonFigure:
    """Error of X's translation and the half width of its stated 95 % interval, against poses.

    error_mm, half_mm: one value for each of the counts, by the panel's name.
    """
    fig, axes = panels(len(error_mm), len(error_mm), 9.6, 3.8, sharey=True)
    texts = []
    for ax, name in zip(axes, error_mm, strict=True):
        error, half = np.asarray(error_mm[name]), np.asarray(half_mm[name])
        ax.plot(counts, error, "o-", color=COLORS["measured"], label="error")
        ax.plot(counts, half, "--", color=COLORS["model"], label="stated 95 %")
        ax.set(xscale="log", yscale="log", xlabel="poses (number)")
        plain_ticks(ax.xaxis, counts, widen=True)
        ax.set_title(name)
        texts.append(
            f"{name}: error {error[0]:.2f} to {error[-1]:.2f} mm, stated {half[0]:.2f} to "
            f"{half[-1]:.2f} mm"
        )
    plain_ticks(axes[0].yaxis, (0.1, 0.3, 1, 3, 10), widen=True)
    axes[0].set_ylabel("translation of X (mm)")
    axes[0].legend()
    return fig.saying(
        f"Error of X against the number of poses, {counts[0]} to {counts[-1]}. " + "; ".join(texts)
    )


def gaps(fitted_mm: ArrayLike, held_mm: ArrayLike) -> LessonFigure:
    """How far the board is from where X says, pose by pose: fitted ones and ones held out, mm.

    >>> gaps([1.0, 2.0], [2.0]).alt[:65]
    'Gap between the board as seen and as predicted: rms 1.58 mm over '
    """
    fitted, held = np.asarray(fitted_mm), np.asarray(held_mm)
    fig, ax = single(8.0, 3.4)
    ax.bar(np.arange(len(fitted)) + 1, fitted, color=COLORS["model"], label="fitted")
    ax.bar(len(fitted) + 1 + np.arange(len(held)), held, color=COLORS["measured"],
           label="held out")  # fmt: skip
    ax.set(xlabel="pose (number)", ylabel="gap at the board (mm)")
    ax.legend()
    return fig.saying(
        f"Gap between the board as seen and as predicted: rms {_rms(fitted):.2f} mm over "
        f"{len(fitted)} fitted poses, {_rms(held):.2f} mm over {len(held)} held out."
    )


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))


def touched(gap_mm: ArrayLike) -> LessonFigure:
    """Where corners are by camera, from several looks, and by fingertip: the gaps (n, 3), mm.

    >>> touched([[1.0, -1.0, 0.5]]).alt[-22:]
    'x +1.0, y -1.0, z +0.5'
    """
    gap = np.asarray(gap_mm)
    fig, ax = single(7.0, 3.2)
    places = np.arange(len(gap))
    for k, (axis, color) in enumerate(zip("xyz", ("measured", "truth", "model"), strict=True)):
        ax.bar(places + 0.25 * (k - 1), gap[:, k], 0.22, color=COLORS[color], label=axis)
    ax.axhline(0, color=COLORS["ink"], lw=1)
    ax.set_xticks(places, [f"{n + 1}" for n in places])
    ax.set(xlabel="corner, look after look (number)", ylabel="camera - fingertip (mm)")
    ax.legend(ncols=3)
    return fig.saying(
        "Camera minus fingertip, corner by corner and look by look, mm: "
        + "; ".join(
            ", ".join(f"{a} {v:+.1f}" for a, v in zip("xyz", row, strict=True)) for row in gap
        )
    )
