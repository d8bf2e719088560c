"""Figures of notebook 01."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations, product
from typing import Any

import numpy as np
from matplotlib.colors import LogNorm

from coursekit import geometry
from coursekit.arrays import AnyArray, Floats, NDArray
from coursekit.cameras import Frame
from coursekit.checks import refuse
from coursekit.geometry import Intrinsics
from coursekit.plots.style import COLORS, LessonFigure, cross, figure, image_axes, panels, single
from coursekit.simulation import Box

DISPLACEMENT_PX = 0.1, 120.0  # the colour scale of `displacement`
SLICE_M = 0.015  # half the height of the slice in `point_cloud`
NEAR_M = 0.60  # where its view from the side ends, m
ALL_EMPTY = "no pixel has a depth: uncover the lenses or step back, and take another frame"
POINT_X_M = 0.10  # how far right of the axis the point of `similar_triangles` is


def similar_triangles(focal_length_mm: float = 1.93, depth_m: float = 0.45) -> LessonFigure:
    """The two similar triangles seen from above, and the spot on the sensor.

    focal_length_mm: lens to image plane, mm. depth_m: Z of a point 100 mm right of the axis, m.
    The image plane is drawn 80 times too far from the pinhole, or nobody would see it.

    >>> similar_triangles(focal_length_mm=4.0, depth_m=0.8).alt[-55:]
    "image 0.500 mm off the sensor's centre for f = 4.00 mm."
    """
    x_mm = focal_length_mm * POINT_X_M / depth_m
    fig, (above, sensor) = panels(2, 2, 9.0, 3.8, width_ratios=[2.4, 1])
    _triangles(above, 0.080 * focal_length_mm, depth_m)
    cross(sensor)
    sensor.plot([x_mm], [0], "o", color=COLORS["measured"], ms=10)
    sensor.set(xlim=(-1.3, 1.3), ylim=(-1.3, 1.3), xlabel="$x_s$ on the sensor (mm)")
    sensor.set(aspect="equal", yticks=[], title=f"$x_s = f\\,X/Z$ = {x_mm:.3f} mm")
    facts = {"off_mm": 1000 * POINT_X_M, "depth_m": depth_m, "f_mm": focal_length_mm}
    return fig.saying("similar_triangles", x_mm=x_mm, **facts)


def _triangles(ax: Any, plane_m: float, depth_m: float) -> None:
    """The large triangle up to the point and the small one up to the image plane, both in m."""
    inner = POINT_X_M * plane_m / depth_m
    ax.axhline(0, color=COLORS["faint"], lw=1)
    ax.fill([0, depth_m, depth_m], [0, 0, POINT_X_M], color=COLORS["depth"], alpha=0.25)
    ax.fill([0, plane_m, plane_m], [0, 0, inner], color=COLORS["measured"], alpha=0.5)
    ax.plot([0, depth_m], [0, POINT_X_M], color=COLORS["model"])
    ax.plot([plane_m, plane_m], [-0.13, 0.13], color=COLORS["ink"], lw=1.5)
    ax.plot([depth_m], [POINT_X_M], "o", color=COLORS["truth"], ms=9)
    ax.plot([plane_m], [inner], "o", color=COLORS["measured"], ms=7)
    ax.plot([0], [0], "o", color=COLORS["ink"])
    ax.text(-0.02, -0.012, "pinhole", ha="right")
    ax.text(plane_m + 0.01, -0.115, "image plane\n(80 times too far out)")
    point = f"P: X = {1000 * POINT_X_M:.0f} mm"
    ax.text(depth_m, POINT_X_M + 0.025, point, ha="center", color=COLORS["truth"])
    # Seen from above with Z to the right, the camera's right hand is towards the bottom.
    ax.set(xlim=(-0.2, 1.3), ylim=(0.15, -0.15), xlabel="Z (m)", ylabel="X (m), to the right")
    ax.set_title("from above: two triangles with the same angle")


def pixel_grid(principal: tuple[float, float] = (3.3, 2.2)) -> LessonFigure:
    """A sensor of 8 x 5 pixels: (0, 0) is the centre of the top-left one, edges are at +-0.5.

    principal: (cx, cy) px of the point that is marked.

    >>> pixel_grid((3.3, 2.2)).alt[:25]
    'A grid of 8 by 5 pixels. '
    """
    columns, rows = 8, 5
    fig, ax = single(6.5, 4.4)
    u, v = np.arange(columns + 1) - 0.5, np.arange(rows + 1) - 0.5
    ax.plot([u] * 2, v[[0, -1]], color=COLORS["faint"], lw=1)
    ax.plot(u[[0, -1]], [v] * 2, color=COLORS["faint"], lw=1)
    centres = geometry.pixel_grid(columns, rows).reshape(-1, 2)
    ax.plot(*centres.T, ".", color=COLORS["ink"], ms=4, label="pixel centres")
    ax.plot(0, 0, "s", color=COLORS["model"], ms=9, label="(0, 0)")
    middle = (columns - 1) / 2, (rows - 1) / 2
    ax.plot(*middle, "x", color=COLORS["truth"], ms=11, mew=3, label=f"middle {middle}")
    ax.plot(*principal, "+", color=COLORS["measured"], ms=16, mew=3,
            label=f"principal point {principal}")  # fmt: skip
    ax.set(xlim=(-0.8, columns - 0.2), ylim=(rows - 0.2, -0.8), aspect="equal")
    ax.set(xlabel="u (px), to the right", ylabel="v (px), down")
    fig.legend(loc="outside lower center", ncols=2)
    size = {"columns": columns, "rows": rows}
    return fig.saying("pixel_grid", middle=middle, principal=principal, **size)


def entries_of_K(scene: tuple[Box, ...], camera: Intrinsics, **moved: float) -> LessonFigure:
    """The edges of a scene's boxes, drawn with the camera's K and with some entries changed.

    moved: new values, px, of fx, fy, cx or cy. Raises ValueError for another name.
    """
    changed = Intrinsics.from_dict(camera.to_dict() | moved)
    fig, ax = single(7.0, 4.1)
    for intrinsics, color, style, name in (
        (camera, COLORS["model"], "-", "K of the camera"),
        (changed, COLORS["measured"], "--", "your K"),
    ):
        for line in _edges(scene):
            ax.plot(*geometry.project(line, intrinsics.K).T, style, color=color, lw=1.5)
        ax.plot([], [], style, color=color, label=name)
        ax.plot(intrinsics.cx, intrinsics.cy, "+", color=color, ms=14, mew=2)
    ax.plot([], [], "+", color=COLORS["ink"], ms=12, label="principal point")
    image_axes(ax, *camera.size)
    ax.legend(loc="upper right")
    values = ", ".join(f"{k} = {getattr(changed, k):.0f}" for k in ("fx", "fy", "cx", "cy"))
    ax.set_title(values + " px")
    return fig.saying("entries_of_K", values=values)


def _edges(scene: tuple[Box, ...]) -> list[Floats]:
    """The twelve edges of each free-standing box, (2, 3) each, m."""
    signs = np.array(list(product((-0.5, 0.5), repeat=3)))
    pairs = [(a, b) for a, b in combinations(range(8), 2) if (signs[a] != signs[b]).sum() == 1]
    return [
        geometry.transform_points(box.T_scene_box, signs[[a, b]] * box.size_m)
        for box in scene
        if max(box.size_m) < 0.2  # the wall and the table are larger than the image
        for a, b in pairs
    ]


def displacement(lenses: Mapping[str, Intrinsics]) -> LessonFigure:
    """How far distortion moves each pixel, in px, one map a lens, all to one scale."""
    fig, axes = panels(len(lenses), 2, 8.5, 3.1)
    texts = []
    for ax, (name, lens) in zip(axes, lenses.items(), strict=True):
        shift, size = displacement_px(lens)
        edge, corner = edge_and_corner(size)
        longer = 10 if corner < 20 else 1
        shown = ax.imshow(
            np.maximum(size, DISPLACEMENT_PX[0]),
            extent=(-0.5, lens.width - 0.5, lens.height - 0.5, -0.5),
            norm=LogNorm(*DISPLACEMENT_PX),
        )
        step = lens.width // 9
        some = slice(step // 2, None, step)
        grid, arrows = geometry.pixel_grid(*lens.size)[some, some], shift[some, some]
        ax.quiver(*np.moveaxis(grid, -1, 0), *np.moveaxis(arrows, -1, 0), angles="xy",
                  scale_units="xy", scale=1 / longer, color="white", width=0.005)  # fmt: skip
        title = f"{name}\nedge {edge:.1f} px, corner {corner:.1f} px, arrows ×{longer}"
        ax.set_title(title, fontsize=10)
        image_axes(ax, *lens.size)
        texts.append(f"{name}, {edge:.1f} px at an edge, {corner:.1f} px in a corner")
    bar = fig.colorbar(shown, ax=axes, label="displacement (px)", shrink=0.6)
    bar.set_ticks([0.1, 1, 10, 100], labels=["0.1", "1", "10", "100"])
    return fig.saying("displacement", each="; ".join(texts))


def displacement_px(lens: Intrinsics) -> tuple[Floats, Floats]:
    """How far, and from the pinhole's place, the lens moves each pixel: (H, W, 2), (H, W) px."""
    grid = geometry.pixel_grid(*lens.size)
    ideal = geometry.deproject(grid, np.ones(grid.shape[:2]), lens.K)
    shift = geometry.project(ideal, lens.K, lens.dist) - grid
    return shift, np.linalg.norm(shift, axis=-1)


def edge_and_corner(size: Floats) -> tuple[float, float]:
    """The largest displacement at the middle of the four edges, and in the four corners, px.

    size: of each pixel's displacement (H, W), px, from `displacement_px`.
    """
    height, width = size.shape
    edge = max(size[height // 2, [0, -1]].max(), size[[0, -1], width // 2].max())
    return float(edge), float(size[np.ix_([0, -1], [0, -1])].max())


def frame(shot: Frame) -> LessonFigure:
    """The depth image, and the colour image where there is one, as the camera delivers them.

    Raises ValueError where no pixel has a depth.
    """
    refuse(not np.any(shot.depth_m), f"shot: {ALL_EMPTY}")
    depth = np.where(shot.depth_m > 0, shot.depth_m, np.nan)
    height, width = depth.shape
    wide = [1.2 * width / height]  # with room for the colour bar
    if shot.color is not None:
        wide.append(shot.color.shape[1] / shot.color.shape[0])
    fig, axes = panels(len(wide), len(wide), 2.5 * sum(wide) + 0.9, 3.0, width_ratios=wide)
    shown = axes[0].imshow(depth, vmin=np.nanquantile(depth, 0.01), vmax=_far(depth))
    fig.colorbar(shown, ax=axes[0], label="depth Z (m)", shrink=0.8)
    axes[0].set(title="depth (white: no depth)", xlabel="u (px)", ylabel="v (px)")
    if shot.color is not None:
        axes[1].imshow(shot.color)
        axes[1].set(title="colour", xlabel="u (px)", ylabel="v (px)")
    beside = "" if shot.color is None else ", and the colour image beside it"
    facts = {"half_m": np.nanmedian(depth), "without": np.isnan(depth).mean()}
    return fig.saying("frame", width=width, height=height, beside=beside, **facts)


def _far(depth_m: AnyArray) -> float:
    """Where the scene ends, m: false matches may lie far behind it."""
    return 1.1 * float(np.nanquantile(depth_m, 0.97))


def point_cloud(points: NDArray[np.float32]) -> LessonFigure:
    """A point cloud (H, W, 3) in m: from beside the camera, and a slice of it from above.

    Points are coloured by depth; NaN points and the few far beyond all others (false matches) are
    left out. The view from the side ends at NEAR_M if there is anything nearer, and leaves out
    what lies far beside all others; the slice holds the points at most SLICE_M above or below the
    optical axis. Raises ValueError where no point is left.
    """
    refuse(not np.isfinite(points[..., 2]).any(), f"points: {ALL_EMPTY}")
    cloud = points[points[..., 2] <= _far(points[..., 2])]
    near = cloud[cloud[:, 2] < NEAR_M]
    near = near if len(near) > 0.02 * len(cloud) else cloud
    low, high = np.quantile(near, (0.01, 0.99), axis=0)
    near = near[((near >= low - 0.03) & (near <= high + 0.03)).all(axis=1)]  # some stray dots stay
    some = np.random.default_rng(0).permutation(len(near))[:30_000]  # a stride makes moiré
    fig = figure(9.0, 3.9)
    fig.set_layout_engine("none")  # the 3-D axes reserve far more room than they use
    colors: dict[str, Any] = {"vmin": cloud[:, 2].min(), "vmax": cloud[:, 2].max()}
    _solid(fig.add_axes((0.05, 0.0, 0.45, 0.94), projection="3d"), near[some], colors)
    above = fig.add_axes((0.55, 0.15, 0.34, 0.75))
    flat = cloud[np.abs(cloud[:, 1]) < SLICE_M]
    dots = above.scatter(flat[:, 0], flat[:, 2], s=1.5, c=flat[:, 2], linewidths=0, **colors)
    bar = fig.add_axes((0.91, 0.2, 0.015, 0.6), label="<colorbar>")
    fig.colorbar(dots, cax=bar, label="depth Z (m)")
    above.plot(0, 0, "v", color=COLORS["ink"], ms=9)
    above.annotate("camera", (0, 0), (8, 4), textcoords="offset points")
    side = 0.6 * float(cloud[:, 2].max())
    above.set(xlabel="X (m)", ylabel="Z (m)", aspect="equal", ylim=(-0.05, None))
    above.set_xlim(-side, side)
    above.set_title(f"from above, |Y| < {1000 * SLICE_M:.0f} mm")
    ends = {"low": cloud.min(axis=0), "high": cloud.max(axis=0)}
    return fig.saying("point_cloud", n=len(cloud), in_slice=len(flat), **ends)


def _solid(ax: Any, cloud: NDArray[np.float32], colors: Mapping[str, float]) -> None:
    ax.scatter(cloud[:, 0], cloud[:, 2], -cloud[:, 1], s=2, c=cloud[:, 2], linewidths=0,
               depthshade=False, **colors)  # fmt: skip
    end = f", Z < {NEAR_M:.1f} m" if cloud[:, 2].max() < NEAR_M else ""
    ax.set(xlabel="X (m)", ylabel="Z (m)", zlabel="-Y (m)")
    ax.set_title(f"from beside the camera{end}", y=0.9)
    ax.xaxis.labelpad = ax.yaxis.labelpad = ax.zaxis.labelpad = 12
    ax.locator_params(nbins=4)
    ax.locator_params(axis="y", nbins=2)
    ax.view_init(elev=18, azim=-110)
    ax.set_box_aspect(np.maximum(np.ptp(cloud[:, [0, 2, 1]], axis=0), 0.05), zoom=0.8)
