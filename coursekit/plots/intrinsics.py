"""Figures of notebook 03."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.colors import LogNorm
from matplotlib.patches import Polygon
from matplotlib.patheffects import withStroke

from coursekit.arrays import Floats
from coursekit.boards import Detection
from coursekit.boards.detector import AS_STORED
from coursekit.checks import refuse
from coursekit.geometry import project, transform_points
from coursekit.intrinsics import Comparison, IntrinsicsResult
from coursekit.intrinsics.fit import tilts
from coursekit.plots.style import (
    COLORS,
    LessonFigure,
    cross,
    image_axes,
    panels,
    plain_ticks,
    single,
)

F_PX = np.linspace(300, 1200, 181)
ARROWS = 150  # residuals are drawn so many times too long
LABEL_PART = 0.09  # of the image's width: closer to its rim a contour's label is cut
LEVELS_PX = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50, 100)


# --- what is fitted ---


def best_fits(X: Floats, Y: Floats, seen: Mapping[str, Floats], f_px: float) -> LessonFigure:
    """The smallest RMS that each focal length allows, distance and tilt fitted to it.

    X, Y (N,): corners on the board, m. seen: by name, their pixels (2N,) from the principal point,
    first all u, then all v. f_px: the true focal length. The model is a board that is turned by
    `tilt` about its Y axis: u = f X cos(tilt) / (Z + X sin(tilt)), v = f Y / (Z + X sin(tilt)).
    """
    fig, ax = single(9.0, 4.0)
    texts = []
    styles = zip(("-", "--", "-.", ":"), ("model", "cube", "color", "measured"), strict=True)
    for (style, color), (name, pixels) in zip(styles, seen.items(), strict=False):
        rms = _best_rms(X, Y, pixels)
        good = F_PX[rms < 1.1 * rms.min()]
        label = f"{name}: {good[0]:.0f} to {good[-1]:.0f}"
        ax.plot(F_PX, rms, style, color=COLORS[color], label=label)
        texts.append(f"{name}: within a tenth of the best from {good[0]:.0f} to {good[-1]:.0f} px")
    ax.axvline(f_px, color=COLORS["truth"], lw=1.5, label="true f")
    ax.set(xlim=(F_PX[0], F_PX[-1]), ylim=(0, 3), xlabel="assumed focal length f (px)",
           ylabel="smallest RMS (px)")  # fmt: skip
    fig.legend(loc="outside right upper", title="f (px) within a tenth\nof the smallest RMS")
    return fig.saying("best_fits", each="; ".join(texts))


def _best_rms(X: Floats, Y: Floats, seen: Floats) -> Floats:
    """The RMS (len(F_PX),) with the best distance and tilt at each f, by damped Gauss-Newton."""
    f = F_PX[:, None]
    theta = np.stack([F_PX * 0.5 / 600, np.full(F_PX.size, 0.4)], axis=1)
    for _ in range(40):
        sine, cosine = np.sin(theta[:, 1:]), np.cos(theta[:, 1:])
        depth = theta[:, :1] + X * sine
        u, v = f * X * cosine / depth, f * Y / depth
        residual = seen - np.concatenate([u, v], axis=1)
        by_z = -np.concatenate([u / depth, v / depth], axis=1)
        by_tilt = np.concatenate([-f * X * sine / depth - u * X * cosine / depth,
                                  -v * X * cosine / depth], axis=1)  # fmt: skip
        J = np.stack([by_z, by_tilt], axis=2)
        A = np.swapaxes(J, 1, 2) @ J
        A[:, [0, 1], [0, 1]] *= 1 + 1e-3  # a board without tilt does not show its sign
        step = np.linalg.solve(A, np.swapaxes(J, 1, 2) @ residual[..., None])[..., 0]
        theta = theta + np.clip(step, -0.2, 0.2)
        theta[:, 1] = np.clip(theta[:, 1], 0.0, 1.3)
    return np.sqrt(2 * np.mean(residual**2, axis=1))


# --- board and views ---


def views(folder: str | Path, detections: Sequence[Detection]) -> LessonFigure:
    """The images of a folder with the corners that were found in them."""
    refuse(not len(detections), "detections: there are none to show; print them to see why")
    fig, axes = panels(len(detections), 3, 9.0, 2.35, 0.3, sharex=True, sharey=True)
    for ax, found in zip(axes, detections, strict=True):
        # as its corners were found; and imread takes no accents on Windows
        data = np.fromfile(Path(folder) / found.name, np.uint8)
        image = cv2.imdecode(data, AS_STORED)
        ax.imshow(image, cmap="gray", vmin=0, vmax=255)
        ax.plot(found.pixels[:, 0], found.pixels[:, 1], ".", ms=3, color=COLORS["measured"])
        ax.set_title(f"{found.name}: {len(found.ids)} corners", fontsize=10)
        ax.set(xlabel="u (px)", ylabel="v (px)")
        ax.label_outer()
    each = (f"{d.name} with {len(d.ids)} corners" for d in detections)
    return fig.saying("views", each=", ".join(each))


def coverage(result: IntrinsicsResult) -> LessonFigure:
    """Where the corners are in the image, and how the board was tilted."""
    fig, (image, tilt) = panels(2, 2, 9.0, 3.9, width_ratios=(1.45, 1))
    width, height = result.intrinsics.size
    for found in result.detections:
        image.plot(found.pixels[:, 0], found.pixels[:, 1], ".", ms=3, color=COLORS["measured"])
    image_axes(image, width, height)
    image.set_title("corners of all views")
    turned = tilts(result)
    x, y = turned.about_x_deg, turned.about_y_deg
    cross(tilt)
    tilt.plot(y, x, "o", color=COLORS["measured"])
    reach = max(50.0, 5 + np.abs([x, y]).max())
    tilt.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal",
             xlabel="tilt about the vertical (deg)",
             ylabel="tilt about the horizontal (deg)")  # fmt: skip
    tilt.set_title("tilt of the board, one dot a view")
    ends = {"x": (x.min(), x.max()), "y": (y.min(), y.max())}
    return fig.saying("coverage", views=len(result.detections), **ends)


# --- a result ---


def residuals(result: IntrinsicsResult) -> LessonFigure:
    """Residuals as arrows where they are in the image, and as a cloud."""
    fig, (image, cloud) = panels(2, 2, 9.0, 3.9, width_ratios=(1.45, 1))
    pixels = np.concatenate([d.pixels for d in result.detections])
    errors = np.concatenate(result.residuals)
    _arrows(image, pixels, errors, ARROWS)
    image_axes(image, *result.intrinsics.size)
    image.set_title(f"residuals, drawn {ARROWS} times too long")
    cloud.plot(errors[:, 0], errors[:, 1], ".", ms=3, alpha=0.5, color=COLORS["measured"])
    angle = np.linspace(0, 2 * np.pi, 100)
    for k in (1, 2):
        cloud.plot(k * result.sigma_px * np.cos(angle), k * result.sigma_px * np.sin(angle),
                   color=COLORS["model"], lw=1.5)  # fmt: skip
    reach = 1.1 * np.abs(errors).max()
    cloud.set(xlim=(-reach, reach), ylim=(reach, -reach), aspect="equal",
              xlabel="residual in u (px)", ylabel="residual in v (px)")  # fmt: skip
    cloud.set_title("circles: 1 and 2 σ per axis")
    return fig.saying("residuals", corners=len(errors), fit=result)


def _arrows(ax: Any, at: Floats, vectors: Floats, times: float, width: float = 0.003) -> None:
    ax.quiver(*at.T, *(times * vectors.T), angles="xy", scale_units="xy", scale=1, width=width,
              color=COLORS["measured"])  # fmt: skip


def uncertainty(results: Mapping[str, IntrinsicsResult], range_m: float) -> LessonFigure:
    """Maps of the standard deviation of a projected pixel, with one scale for all of them."""
    maps = {name: r.uncertainty_map(range_m, (30, 40)) for name, r in results.items()}
    ends = [f([f(m) for m in maps.values()]) for f in (np.nanmin, np.nanmax)]  # a lens may fold
    fig, axes = panels(len(maps), len(maps), 3.1 * len(maps) + 0.7, 2.7)
    edge, texts = [withStroke(linewidth=2.5, foreground=COLORS["ink"])], []
    for ax, (name, sigma) in zip(axes, maps.items(), strict=True):
        width, height = results[name].intrinsics.size
        u, v = np.linspace(0, width - 1, sigma.shape[1]), np.linspace(0, height - 1, len(sigma))
        shown = ax.pcolormesh(u, v, sigma, norm=LogNorm(*ends), shading="gouraud", cmap="cividis")
        levels = [x for x in LEVELS_PX if 0.02 < np.mean(sigma < x) < 0.99]
        lines = ax.contour(u, v, sigma, levels, colors="white", linewidths=1.2)
        lines.set_path_effects(edge)
        ends_at = np.array([width, height]) - 1
        drawn = [path.vertices for path in lines.get_paths() if len(path)]
        inside = [at[np.minimum(at, ends_at - at).min(axis=1).argmax()] for at in drawn]
        whole: list[Floats] = []  # places of labels that neither the rim nor another one cuts
        for at in (at for at in inside if np.minimum(at, ends_at - at).min() > LABEL_PART * width):
            if all(np.abs((at - other) / (0.25, 0.12)).max() > width for other in whole):
                whole.append(at)
        ax.clabel(lines, fmt="%g px", fontsize=9, inline_spacing=1, manual=whole)
        for text in lines.labelTexts:
            text.set_path_effects(edge)
        image_axes(ax, width, height)
        span = f"{np.nanmin(sigma):.2g} to {np.nanmax(sigma):.2g} px"
        ax.set_title(f"{name}: {span}", fontsize=10)
        texts.append(f"{name} from {span}")
    bar = fig.colorbar(shown, ax=axes, label="σ of a projected pixel (px)", shrink=0.9)
    plain_ticks(bar.ax.yaxis, LEVELS_PX)
    return fig.saying("uncertainty", range_m=range_m, each="; ".join(texts))


def two_sessions(results: Mapping[str, IntrinsicsResult]) -> LessonFigure:
    """RMS of each view, and the outlines of the boards, of some sessions side by side."""
    n = len(results)
    fig, axes = panels(2 * n, n, 9.0, 2.8, height_ratios=(1, 1.5))
    texts = []
    top = 1.3 * max(float(r.per_view_rms_px.max()) for r in results.values())
    for bars, image, (name, result) in zip(axes[:n], axes[n:], results.items(), strict=True):
        numbers = np.arange(1, len(result.detections) + 1)
        bars.bar(numbers, result.per_view_rms_px, color=COLORS["measured"])
        bars.axhline(result.rms_px, color=COLORS["model"])
        bars.set(ylim=(0, top), xlabel="view (number)", ylabel="RMS (px)")
        bars.set_title(f"{name}: RMS {result.rms_px:.3f} px, fx = {result.intrinsics.fx:.1f} px")
        for outline in outlines(result):
            image.add_patch(Polygon(outline, fill=False, ec=COLORS["measured"], lw=1))
        image_axes(image, *result.intrinsics.size)
        fx = f"fx {result.intrinsics.fx:.1f} px"
        texts.append(f"session {name} has RMS {result.rms_px:.3f} px and {fx}")
    return fig.saying("two_sessions", each="; ".join(texts))


def outlines(result: IntrinsicsResult) -> list[Floats]:
    """The rims of the boards as the fitted camera sees them, each (4, 2) px."""
    columns, rows = result.board.corners
    rim = result.board.points[[0, columns - 1, columns * rows - 1, columns * (rows - 1)]]
    lens = result.intrinsics
    return [project(transform_points(T, rim), lens.K, lens.dist) for T in result.T_camera_board]


def rules(rows: Mapping[str, IntrinsicsResult], range_m: float) -> LessonFigure:
    """What each capture rule buys: sigma of fx, and the worst pixel's sigma, of some sessions.

    Behind each name stands the session's RMS.
    """
    names = [f"{name} ({r.rms_px:.2f} px)" for name, r in rows.items()]
    fx = [100 * r.sigma("fx") / r.intrinsics.fx for r in rows.values()]
    worst = [float(np.nanmax(r.uncertainty_map(range_m, (12, 16)))) for r in rows.values()]
    fig, axes = panels(2, 2, 9.0, 0.45 * len(names) + 1.2, sharey=True)
    for ax, values, label in (
        (axes[0], fx, "σ of fx (%)"),
        (axes[1], worst, f"σ of the worst pixel at {range_m:g} m (px)"),
    ):
        ax.plot(values, names, "o", color=COLORS["model"], ms=8)
        ax.grid(axis="y", color=COLORS["faint"], lw=0.8)
        ax.set(xscale="log", xlabel=label, xlim=(0.6 * min(values), 3 * max(values)))
        plain_ticks(ax.xaxis, (0.1, 0.3, 1, 3, 10, 30))
        for y, value in enumerate(values):
            ax.annotate(f"{value:.2g}", (value, y), (9, 0), textcoords="offset points", va="center",
                        fontsize=10, bbox={"fc": "white", "ec": "none", "pad": 1})  # fmt: skip
    axes[0].invert_yaxis()
    axes[0].set_ylabel(" ")
    each = map("{}: fx to {:.2g} %, worst pixel {:.2g} px".format, names, fx, worst)
    return fig.saying("rules", each="; ".join(each))


# --- the museum ---


def rooms(results: Mapping[str, IntrinsicsResult]) -> LessonFigure:
    """What failures leave: the RMS of each view, and a pattern in the view that suffers most."""
    columns = min(len(results), 3)
    rows = -(-len(results) // columns)
    heights = (1, 2.4) * rows
    fig, axes = panels(2 * rows * columns, columns, 9.6, 2.0, height_ratios=heights)
    bars, views = np.moveaxis(np.reshape(axes, (rows, 2, columns)), 1, 0).reshape(2, -1)
    usual = float(np.median([np.median(r.per_view_rms_px) for r in results.values()]))
    for bar, view, (name, result) in zip(bars, views, results.items(), strict=False):
        rms = result.per_view_rms_px
        bar.bar(np.arange(1, len(rms) + 1), rms, color=COLORS["measured"])
        bar.set(ylim=(0, 3 * usual), xlabel="view (number)", ylabel="RMS (px)")
        bar.set_title(f"{name}: RMS {result.rms_px:.2f} px", fontsize=10)
        for at in np.flatnonzero(rms > 3 * usual):
            bar.annotate(f"{rms[at]:.1f} px", (at + 1, 3 * usual), (6, -4), va="top",
                         textcoords="offset points", fontsize=9)  # fmt: skip
        _pattern(view, result)
    said = "{}, RMS of all views {:.2f} px, of the worst one {:.2f} px".format
    each = (said(name, r.rms_px, max(r.per_view_rms_px)) for name, r in results.items())
    return fig.saying("rooms", each="; ".join(each))


def _pattern(ax: Any, result: IntrinsicsResult) -> None:
    """The worst view: each corner's arrow is the mean of its residual and its neighbours'."""
    worst = int(np.argmax(result.per_view_rms_px))
    seen, pixels = result.detections[worst], result.detections[worst].pixels
    square = np.stack(np.divmod(seen.ids, result.board.corners[0]), axis=1)
    near = np.abs(square[:, None] - square).max(axis=2) <= 1
    errors = near @ result.residuals[worst] / near.sum(axis=1, keepdims=True)
    apart = np.sqrt(np.prod(np.ptp(pixels, axis=0)) / len(pixels))
    times = min(100.0, float(f"{1.5 * apart / np.linalg.norm(errors, axis=1).max():.1g}"))
    ax.plot(*pixels.T, ".", ms=4, color=COLORS["model"])
    _arrows(ax, pixels, errors, times, width=0.007)
    middle, half = (pixels.min(axis=0) + pixels.max(axis=0)) / 2, np.ptp(pixels, axis=0) / 2
    rim = 1.2 * max(half[0], half[1] / 0.75) * np.array([1, 0.75])  # of one shape in all of them
    (left, top), (right, bottom) = middle - rim, middle + rim
    ax.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xlabel="u (px)", ylabel="v (px)")
    ax.set_title(f"view {worst + 1}, arrows x{times:g}", fontsize=10)


def power(table: Mapping[str, Mapping[str, Any]]) -> LessonFigure:
    """The share of sessions in which `diagnose` names an effect, against the effect's size.

    table: by effect: `unit`, `sizes`, `named` (counts) and `sessions` (their number).
    """
    fig, axes = panels(len(table), len(table), 9.6, 3.2, sharey=True)
    texts = []
    for ax, (effect, row) in zip(axes, table.items(), strict=True):
        share = 100 * np.asarray(row["named"]) / row["sessions"]
        ax.plot(row["sizes"], share, "o-", color=COLORS["model"])
        ax.set(xscale="log", ylim=(-3, 103),
               xlabel=f"{effect.replace('_', ' ')} ({row['unit']})")  # fmt: skip
        plain_ticks(ax.xaxis, (0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.5, 1, 2))
        shares = map(f"{{:.0f}} % at {{:g}} {row['unit']}".format, share, row["sizes"])
        texts.append(f"{effect}: {', '.join(shares)}")
    axes[0].set_ylabel("sessions that it is named in (%)")
    return fig.saying("power", each="; ".join(texts))


# --- against the factory ---


def difference(comparison: Comparison) -> LessonFigure:
    """By how many pixels, and by how many millimetres, a fit and the factory disagree.

    Pixels after the best motion of the camera, millimetres without it; see `intrinsics.compare`.
    """
    fig, axes = panels(2, 2, 9.6, 3.9, sharey=True)
    pixels, shift_mm = comparison.difference_px, 1000 * comparison.shift_m
    width, height = comparison.size
    for ax, values, label in (
        (axes[0], pixels, "px, the camera turned to fit"),
        (axes[1], shift_mm, f"mm at {comparison.range_m:g} m, the camera not turned"),
    ):
        u, v = np.linspace(0, width - 1, values.shape[1]), np.linspace(0, height - 1, len(values))
        shown = ax.pcolormesh(u, v, values, shading="gouraud", cmap="cividis", vmin=0)
        fig.colorbar(shown, ax=ax, location="bottom", label=label, shrink=0.9)
        image_axes(ax, width, height)
        ax.label_outer()
    px, mm = ((np.nanmin(values), np.nanmax(values)) for values in (pixels, shift_mm))
    return fig.saying("difference", px=px, mm=mm, range_m=comparison.range_m)
