"""Figures of notebook 04."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.ticker import MultipleLocator
from scipy.spatial.transform import Rotation

from coursekit.arrays import ArrayLike, Floats
from coursekit.geometry import deproject, transform_points
from coursekit.hand_eye import HandEyeSession, StudyPoint, motions
from coursekit.hand_eye.poses import stand_board
from coursekit.plots.style import (
    COLORS,
    MARKERS,
    STYLES,
    LessonFigure,
    figure,
    panels,
    plain_ticks,
    single,
)
from coursekit.simulation.arm_poses import Setup
from coursekit.words import say

VIEW_M = 0.16  # how far the camera's pyramid is drawn
AXES_M = 0.12  # the gripper's, as drawn
SPACE_M = ((-0.30, 0.66), (-0.36, 0.36), (0.0, 0.84))  # x, y, z of the base that is shown
CLEAR_PX = 13.0  # around a letter


def mounts(
    setups: Mapping[str, Setup], joints: Mapping[str, ArrayLike], view_from_deg: float = -65.0
) -> LessonFigure:
    """Rigs in space, at true scale: the arm, the camera's view, the board, and T, X and C.

    joints: the joint angles (6,), rad, at which each rig is drawn. view_from_deg: from where, about
    the vertical: -90 has x of the base to the right, 0 looks along it.
    """
    fig = figure(10.0, 4.9)
    fig.set_layout_engine("none")  # the 3-D axes reserve far more room than they use
    texts = []
    for k, (name, setup) in enumerate(setups.items()):
        ax: Any = fig.add_axes((k / len(setups), 0.0, 0.96 / len(setups), 1.0), projection="3d")
        limits = dict(zip(("xlim", "ylim", "zlim"), SPACE_M, strict=True))
        ax.set(xlabel="x (m)", ylabel="y (m)", zlabel="z (m)", **limits)
        ax.set_box_aspect(np.ptp(SPACE_M, axis=1), zoom=0.96)
        for axis in (ax.xaxis, ax.yaxis, ax.zaxis):
            axis.set_major_locator(MultipleLocator(0.3))
        ax.view_init(elev=18, azim=view_from_deg)
        ax.set_title(name, y=0.94)
        lengths = _rig(ax, setup, np.asarray(joints[name], float))
        texts.append(f"{name}: " + ", ".join(f"{k} {v:.2f} m" for k, v in lengths.items()))
    return fig.saying("mounts", each="; ".join(texts))


def _rig(ax: Any, setup: Setup, q: Floats) -> dict[str, float]:
    """The arm, the board, what the camera sees, and the three arrows; their lengths, m."""
    gripper, on_wrist = setup.arm.forward(q), setup.mount == "eye_in_hand"
    camera = gripper @ setup.X if on_wrist else setup.X
    board, base = setup.Y if on_wrist else gripper @ setup.Y, np.eye(4)
    links = setup.arm.link_frames(q)[:, :3, 3]
    chain = np.concatenate([np.zeros((1, 3)), links, gripper[None, :3, 3]])
    ax.plot(*chain.T, "o-", color=COLORS["block"], lw=5, ms=7)
    axes = transform_points(gripper, AXES_M * np.kron(np.eye(3), [[0], [1]])).reshape(3, 2, 3)
    for axis, line in zip("xyz", axes, strict=True):
        ax.plot(*line.T, color=COLORS["ink"], lw=1.2)
        ax.text(*line[1], axis, fontsize=9)
    rim = transform_points(board, setup.board.outline)
    sheet = rim[[[0, 1], [3, 2]]]
    ax.plot_surface(*np.moveaxis(sheet, 2, 0), color=COLORS["cube"], alpha=0.5, shade=False)
    ax.plot(*rim[[0, 1, 2, 3, 0]].T, color=COLORS["ink"], lw=1.2)
    wide, high = setup.intrinsics.size
    pixels = np.array([(0, 0), (wide, 0), (wide, high), (0, high)], float)
    far = deproject(pixels, np.full(4, VIEW_M), setup.intrinsics.K)
    pyramid = transform_points(camera, np.vstack([far, np.zeros(3)]))
    view = pyramid[[0, 1, 2, 3, 0, 4, 1, 4, 2, 4, 3]]
    ax.plot(*view.T, color=COLORS["color"], lw=1.2)
    arrows = {
        "T": (base, gripper, "model"),
        "X": (gripper if on_wrist else base, camera, "measured"),
        "C": (camera, board, "truth"),
    }
    ends = [np.stack([start[:3, 3], end[:3, 3]]) for start, end, _ in arrows.values()]
    taken = [_on_page(ax, line) for line in (chain, rim[[0, 1, 2, 3, 0]], view, *axes, *ends)]
    for (name, (*_, color)), line in zip(arrows.items(), taken[-3:], strict=True):
        place = _arrow(ax, name, line[0], line[-1], COLORS[color], np.concatenate(taken))
        taken.append(place)
    lengths = [float(np.linalg.norm(end - start)) for start, end in ends]
    return dict(zip(arrows, lengths, strict=True))


def _on_page(ax: Any, line: Floats) -> Floats:
    """Points along a line through (n, 3), m, as (m, 2) px on the page."""
    steps = np.linspace(0, len(line) - 1, 30 * (len(line) - 1) + 1)
    points = [np.interp(steps, np.arange(len(line)), column) for column in line.T]
    x, y, _, w = ax.get_proj() @ [*points, np.ones(len(steps))]
    return np.asarray(ax.transData.transform(np.stack([x / w, y / w], axis=1)))


def _arrow(ax: Any, name: str, start: Floats, end: Floats, color: str, taken: Floats) -> Floats:
    """An arrow on the page, px, its letter where nothing else is; where that is, (1, 2)."""
    head = {"arrowstyle": "-|>", "color": color, "lw": 2.2, "shrinkA": 0, "shrinkB": 0}
    ax.annotate("", end, start, xycoords="figure pixels", textcoords="figure pixels",
                arrowprops=head, zorder=10)  # fmt: skip
    along = (end - start) / np.linalg.norm(end - start)
    across = np.array([-along[1], along[0]])
    sides = [side * away for away in np.arange(CLEAR_PX + 1, 80, 3) for side in (1, -1)]
    places = np.array([(start + end) / 2 + side * across for side in sides])
    room = np.linalg.norm(places[:, None] - taken, axis=2).min(axis=1)
    place = places[np.argmax(room > CLEAR_PX) if (room > CLEAR_PX).any() else room.argmax()]
    ax.annotate(name, place, xycoords="figure pixels", color=color, ha="center", va="center",
                fontweight="bold", fontsize=13, zorder=11)  # fmt: skip
    return place[None]


def agreement(sessions: Mapping[str, HandEyeSession]) -> LessonFigure:
    """Three things that a session shows before anybody believes its X, a row for each session.

    From all pairs of poses how far gripper and camera turned (deg) and how far each moved along the
    axis of that turn (mm), which no X changes; and where `solve` puts the board, pose by pose, mm.
    """
    fig, axes = panels(3 * len(sessions), 3, 10.0, 2.4)
    texts = []
    for row, (name, session) in zip(np.reshape(axes, (-1, 3)), sessions.items(), strict=True):
        A, B = motions(session.T_base_gripper, session.T_camera_board, session.mount)
        arm, seen = _screw(A), _screw(B)
        for ax, x, y, unit in zip(row[:2], arm, seen, ("deg", "mm"), strict=True):
            top = 1.05 * float(np.max(x))
            ax.plot([0, top], [0, top], color=COLORS["faint"], lw=1)
            ax.plot(x, y, ".", ms=3, color=COLORS["measured"])
            ax.set(xlabel=f"gripper ({unit})", ylabel=f"camera ({unit})", xlim=(0, top))
        fit = session.solve()
        places = 1e3 * stand_board(fit.T_base_gripper, fit.measured, fit.X, session.mount)[:, :3, 3]
        off = places - np.median(places, axis=0)
        for column, color in enumerate(("measured", "truth", "model")):
            row[2].plot(np.arange(len(off)) + 1, off[:, column], ".-", lw=1, color=COLORS[color],
                        label="xyz"[column])  # fmt: skip
        row[2].set(xlabel="pose (number)", ylabel="off the median (mm)")
        titles = (f"{name}: turned by", "moved along the axis by", "the board in the base")
        for ax, title in zip(row, titles, strict=True):
            ax.set_title(title)
        apart, part = np.abs(arm[0] - seen[0]).max(), arm[1] @ seen[1] / (arm[1] @ arm[1])
        texts.append(say("plots.agrees", name=name, apart=apart, part=part, fit=fit))
    fig.legend(*axes[2].get_legend_handles_labels(), loc="outside lower right", ncols=3)
    return fig.saying("agreement", each="; ".join(texts))


def _screw(T: Floats) -> tuple[Floats, Floats]:
    """How far motions (n, 4, 4) turn (n,), deg, and how far along the axis of that, mm."""
    turns = Rotation.from_matrix(T[:, :3, :3]).as_rotvec()
    angles = np.linalg.norm(turns, axis=1)
    return np.degrees(angles), 1e3 * np.abs(np.sum(turns * T[:, :3, 3], axis=1)) / angles


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
    return fig.saying("study", each="; ".join(map(repr, points)))


def more_poses(
    counts: Sequence[int], error_mm: Mapping[str, ArrayLike], stated_mm: Mapping[str, ArrayLike]
) -> LessonFigure:
    """Error of X's translation, and the root mean square that is stated of it, against poses.

    error_mm, stated_mm: one value for each of the counts, by the panel's name.
    """
    fig, axes = panels(len(error_mm), len(error_mm), 9.6, 3.8, sharey=True)
    texts = []
    for ax, name in zip(axes, error_mm, strict=True):
        error, stated = np.asarray(error_mm[name]), np.asarray(stated_mm[name])
        ax.plot(counts, error, "o-", color=COLORS["measured"], label="error")
        ax.plot(counts, stated, "--", color=COLORS["model"], label="stated (rms)")
        ax.set(xscale="log", yscale="log", xlabel="poses (number)")
        plain_ticks(ax.xaxis, counts, widen=True)
        ax.set_title(name)
        (first, *_, last) = zip(error, stated, strict=True)
        texts.append(say("plots.error_and_half", name=name, first=first, last=last))
    plain_ticks(axes[0].yaxis, (0.1, 0.3, 1, 3, 10), widen=True)
    axes[0].set_ylabel("translation of X (mm)")
    axes[0].legend()
    return fig.saying("more_poses", counts=(counts[0], counts[-1]), each="; ".join(texts))


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
    rows = (", ".join(map("{} {:+.1f}".format, "xyz", row)) for row in gap)
    return fig.saying("touched", each="; ".join(rows))
