"""Figures of notebook 02."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from coursekit.arrays import ArrayLike, Bools, Floats
from coursekit.plots.style import COLORS, MARKERS, STYLES, LessonFigure, panels, plain_ticks, single

RANGE_M = np.linspace(0.25, 3.0, 200)


def technologies(fx: float, baseline_m: float, sigma_d_px: float) -> LessonFigure:
    """Random depth error against distance of the three ways to make Z, mm.

    Active stereo: the law, for this camera. Structured light: Khoshelham and Elberink (2012),
    1.425e-5 Z^2 in cm, for the first Kinect. Time of flight: the maker's limit for the Azure
    Kinect, a standard deviation of at most 17 mm at any range; typical values are far below.

    >>> technologies(447.0, 0.050, 0.08).alt[:65]
    'Random depth error against distance: active stereo 3.6 mm at 1 m '
    """
    fig, ax = single(8.0, 4.2)
    stereo = 1000 * RANGE_M**2 * sigma_d_px / (fx * baseline_m)
    light = 10 * 1.425e-5 * (100 * RANGE_M) ** 2
    ax.plot(RANGE_M, stereo, color=COLORS["model"], label="active stereo (this camera, the law)")
    ax.plot(RANGE_M, light, color=COLORS["cube"], ls="--", label="structured light (Kinect v1)")
    ax.plot(RANGE_M, np.full_like(RANGE_M, 17.0), color=COLORS["color"], ls=":",
            label="time of flight (Azure Kinect, upper limit)")  # fmt: skip
    ax.set(xlabel="distance Z (m)", ylabel="std of depth (mm)", ylim=(0, None))
    ax.legend()
    at = [np.interp((1, 2), RANGE_M, values) for values in (stereo, light)]
    return fig.saying("technologies", stereo=at[0], light=at[1])


def two_eyes(fx: float, baseline_m: float, distance_m: float) -> LessonFigure:
    """Two eyes that look at one point 30 mm to the right, from above, and both their images.

    >>> two_eyes(431.0, 0.050, 0.5).axes[1].get_title()
    'd = 25.9 - (-17.2) = 43.1 px'
    """
    x, eyes = 0.030, {"left": 0.0, "right": baseline_m}
    fig, (above, image) = panels(2, 2, 9.0, 3.8)
    u = {name: fx * (x - at) / distance_m for name, at in eyes.items()}
    for row, (name, at) in enumerate(eyes.items()):
        style = {"color": COLORS["measured" if row else "model"], "lw": 1.5}
        above.plot([1000 * at, 1000 * x], [0, distance_m], **style)
        above.plot([1000 * at] * 3, [0, 2, 2.1], "^:", markevery=[0], ms=9, **style)
        image.plot([u[name]] * 2, [row, 2], "o:", markevery=[0], **style)
        image.text(u[name] + 5, row, f"$u_{name[0].upper()}$", va="center", color=style["color"])
    above.plot(1000 * x, distance_m, "o", color=COLORS["ink"])
    ends = (0.0, 1000 * baseline_m), (u["right"], u["left"])
    for ax, (low, high), y, what in zip((above, image), ends, (-0.2, 2.2), ("B", "d"), strict=True):
        ax.annotate("", (low, y), (high, y), arrowprops={"arrowstyle": "<->"})
        ax.text(high, y, f"  {what}", va="center")
    above.set(xlim=(-40, 130), ylim=(-0.4, 2.15), xlabel="X (mm)", ylabel="Z (m)")
    above.set_title(f"Z = {distance_m:.2f} m, B = {1000 * baseline_m:.0f} mm")
    image.set(xlim=(-150, 100), ylim=(-0.5, 2.5), xlabel="$u - c_x$ (px)", ylabel="in the eye")
    image.set_yticks([0, 1], ["left", "right"])
    d = u["left"] - u["right"]
    image.set_title(f"d = {u['left']:.1f} - ({u['right']:.1f}) = {d:.1f} px")
    return fig.saying("two_eyes", baseline_mm=1000 * baseline_m, distance_m=distance_m, u=u, d=d)


def reciprocal(fx_baseline: float, distance_m: float, sigma_d_px: float) -> LessonFigure:
    """Z = f B / d with one band of disparity noise, and what it becomes in depth.

    fx_baseline: f B in px m. distance_m: where the band is. sigma_d_px: drawn ten times too large,
    or nobody would see it.

    >>> reciprocal(21.6, 0.8, 0.08).axes[0].get_title()
    'd = 27.0 px, Z = 0.80 m: 0.08 px become 2.37 mm'
    """
    d = np.linspace(5, 130, 400)
    at = fx_baseline / distance_m
    wide = 10 * sigma_d_px
    low, high = fx_baseline / (at + wide), fx_baseline / max(at - wide, 1.0)
    sigma_mm = 1000 * distance_m**2 * sigma_d_px / fx_baseline
    fig, ax = single(8.0, 4.2)
    ax.plot(d, fx_baseline / d, color=COLORS["model"])
    ax.axvspan(at - wide, at + wide, color=COLORS["depth"], alpha=0.5, label="±10 $\\sigma_d$")
    ax.axhspan(low, high, color=COLORS["measured"], alpha=0.35, label="±10 $\\sigma_Z$")
    ax.legend()
    ax.plot(at, distance_m, "o", color=COLORS["ink"])
    ax.set(xlim=(0, 130), ylim=(0, 2.6), xlabel="disparity d (px)", ylabel="depth Z (m)")
    becomes = f"{sigma_d_px:.2f} px become {sigma_mm:.2f} mm"
    ax.set_title(f"d = {at:.1f} px, Z = {distance_m:.2f} m: {becomes}")
    facts = {"fb": fx_baseline, "distance_m": distance_m, "d_px": sigma_d_px, "z_mm": sigma_mm}
    return fig.saying("reciprocal", **facts)


def prices(devices: Mapping[str, tuple[float, float]], sigma_d_px: float) -> LessonFigure:
    """The law for several cameras, each (fx in px, baseline in m), on logarithmic axes.

    >>> prices({"D405": (425.0, 0.018)}, 0.08).alt
    'Depth noise by the law for 0.08 px, at 0.45 m: D405 2.12 mm.'
    """
    fig, ax = single(8.0, 4.4)
    texts = []
    for style, (name, (fx, baseline_m)) in zip(STYLES, devices.items(), strict=False):
        sigma = 1000 * RANGE_M**2 * sigma_d_px / (fx * baseline_m)
        ax.plot(RANGE_M, sigma, style, label=name)
        texts.append(f"{name} {np.interp(0.45, RANGE_M, sigma):.2f} mm")
    ax.axvspan(0.4, 0.6, color=COLORS["faint"], alpha=0.4, label="over a tabletop")
    ax.set(xscale="log", yscale="log", xlabel="distance Z (m)", ylabel="std of depth (mm)")
    plain_ticks(ax.xaxis, (0.3, 0.5, 1, 2, 3))
    plain_ticks(ax.yaxis, (0.1, 0.3, 1, 3, 10, 30))
    ax.legend()
    return fig.saying("prices", sigma_d_px=sigma_d_px, each=", ".join(texts))


def infrared_pair(
    left: Floats, right: Floats, pixel: tuple[int, int], disparity_px: float, half: int
) -> LessonFigure:
    """A crop of both infrared images with the window around `pixel` and where it is found.

    left, right: the images (H, W), grey levels. pixel: (u, v) of the left one. half: the window has
    2 half + 1 pixels a side.
    """
    u, v = pixel
    fig, axes = panels(2, 2, 9.0, 3.8, sharey=True)
    for ax, image, centre, name in (
        (axes[0], left, float(u), "left"),
        (axes[1], right, u - disparity_px, "right"),
    ):
        ax.imshow(image, cmap="gray", vmin=0, vmax=255)
        for x, color in ((u, COLORS["depth"]), (centre, COLORS["measured"])):
            box = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * (half + 0.5)
            ax.plot(x + box[:, 0], v + box[:, 1], color=color, lw=1.5)
        ax.set(xlim=(u - 110, u + 60), ylim=(v + 60, v - 60), xlabel="u (px)", title=name)
    axes[0].set_ylabel("v (px)")
    return fig.saying("infrared_pair", u=u, v=v, disparity_px=disparity_px)


def cost_curve(costs: Floats, disparity_px: float) -> LessonFigure:
    """Matching cost against disparity: the whole search, and the neighbourhood of the minimum.

    costs: of the candidates 0, 1, 2, ... px, in grey levels. disparity_px: what the matcher says.
    """
    fig, (whole, close) = panels(2, 2, 9.0, 3.6)
    d = np.arange(len(costs))
    whole.plot(d, costs, color=COLORS["model"], lw=1.2)
    best = int(np.argmin(costs))
    near = slice(max(0, best - 4), best + 5)
    close.plot(d[near], costs[near], "o", color=COLORS["model"])
    _flanks(close, costs, best, disparity_px)
    for ax in (whole, close):
        ax.axvline(disparity_px, color=COLORS["measured"], lw=1.5)
        ax.set(xlabel="disparity d (px)", ylabel="cost (grey levels)")
    whole.set_title("all candidates")
    close.set_title(f"around the minimum: d = {disparity_px:.2f} px")
    return fig.saying("cost_curve", best=best, disparity_px=disparity_px)


def _flanks(ax: Any, costs: Floats, best: int, disparity_px: float) -> None:
    """The two lines of equal steepness through the three lowest points, which meet at the peak."""
    before, here, after = costs[best - 1 : best + 2]
    slope = max(before, after) - here
    left = before - slope * (disparity_px - (best - 1))
    for sign in (-1, 1):
        reach = np.array([disparity_px, disparity_px + 3.0 * sign])
        ax.plot(reach, left + slope * np.abs(reach - disparity_px), color=COLORS["faint"], lw=1.5)


def depth_image(
    depth_m: Floats,
    labels: Mapping[str, tuple[float, float]] | None = None,
    flying: Bools | None = None,
) -> LessonFigure:
    """A depth image (H, W) in m, no depth in white, with labels at pixels (u, v) if there are any.

    flying (H, W): pixels to be ringed.

    >>> depth_image(np.eye(4)).alt
    'Depth image, 75% of it without depth.'
    """
    fig, ax = single(8.5, 4.6)
    shown = ax.imshow(np.where(depth_m > 0, depth_m, np.nan), vmin=0.2, vmax=1.2)
    fig.colorbar(shown, ax=ax, label="depth Z (m)", shrink=0.8)
    if flying is not None:
        ax.plot(*np.nonzero(flying)[::-1], "o", mfc="none", mec=COLORS["measured"], ms=5, mew=0.8)
    for name, (u, v) in (labels or {}).items():
        ax.annotate(name, (u, v), (u, v + 95), ha="center", fontsize=10, fontweight="bold",
                    bbox={"fc": "white", "ec": COLORS["ink"], "pad": 2},
                    arrowprops={"arrowstyle": "->", "color": COLORS["ink"]})  # fmt: skip
    ax.set(xlabel="u (px)", ylabel="v (px)")
    said = f" Marked: {', '.join(labels)}." if labels else ""
    said += f" {np.sum(flying)} flying pixels are ringed." if flying is not None else ""
    return fig.saying("depth_image", without=np.mean(depth_m == 0), more=said)


def noise_law(
    distances_m: ArrayLike,
    std_mm: ArrayLike,
    error_mm: ArrayLike,
    curve: tuple[Floats, Floats, Floats, Floats],
    extra: Mapping[str, tuple[ArrayLike, ArrayLike]] | None = None,
    law: str = "fitted law",
) -> LessonFigure:
    """Measured std of depth with its standard error over a curve (Z, mid, low, high), the `law`.

    All standard deviations are in mm, all distances in m. extra: other series (Z, std), by name.
    The legend stands beside the axes, clear of all points.
    """
    z, mid, low, high = curve
    fig, ax = single(9.5, 4.6)
    ax.plot(z, mid, color=COLORS["model"], label=law)
    ax.fill_between(z, low, high, color=COLORS["model"], alpha=0.25, label="its 95 % band")
    ax.errorbar(distances_m, std_mm, 1.96 * np.asarray(error_mm), fmt="o", ms=4, capsize=4,
                color=COLORS["measured"], label="measured, with 95 % interval")  # fmt: skip
    styles = zip(MARKERS[1:], ("truth", "color", "ink"), strict=False)
    for (marker, color), (name, (x, y)) in zip(styles, (extra or {}).items(), strict=False):
        ax.plot(x, y, marker=marker, ls=":", color=COLORS[color], mfc="white", label=name)
    ax.set(xscale="log", yscale="log", xlabel="distance Z (m)", ylabel="standard deviation (mm)")
    plain_ticks(ax.xaxis, (0.3, 0.45, 0.6, 1, 1.5, 2, 3))
    plain_ticks(ax.yaxis, (0.01, 0.03, 0.1, 0.3, 1, 3, 10, 30))
    ax.legend(loc="upper left", bbox_to_anchor=(1.02, 1.0))
    plain = law.translate({36: None, 92: None})  # without the signs of mathematics
    others = "".join(f"; {name}: {_listed(x, y)}" for name, (x, y) in (extra or {}).items())
    each = _listed(distances_m, std_mm) + others
    return fig.saying("noise_law", law=plain, each=each)


def _listed(distances_m: ArrayLike, std_mm: ArrayLike) -> str:
    pairs = zip(np.asarray(distances_m), np.asarray(std_mm), strict=True)
    return ", ".join(f"{s:.2f} mm at {d:.2f} m" for d, s in pairs)


def averaging(counts: ArrayLike, error_mm: ArrayLike, floor_mm: float) -> LessonFigure:
    """A pixel's error (RMS) in the mean of N frames, over what stays and over 1 / sqrt(N), mm.

    >>> averaging([1, 4], [1.0, 0.8], 0.7).alt[:47]
    "A pixel's error in the mean of N frames: 1.00 m"
    """
    n, e = np.asarray(counts), np.asarray(error_mm)
    fig, ax = single(8.0, 4.2)
    ideal = e[0] / np.sqrt(n)
    ax.plot(n, ideal, color=COLORS["model"], ls="--", label="if each frame had its own: 1/√N")
    ax.axhline(floor_mm, color=COLORS["ink"], ls=":", label="the same in every frame")
    ax.plot(n, e, "o-", color=COLORS["measured"], label="a pixel, measured")
    ax.set(xscale="log", yscale="log", xlabel="N (frames averaged)", ylabel="error of a pixel (mm)")
    plain_ticks(ax.xaxis, tuple(n))
    plain_ticks(ax.yaxis, (0.05, 0.1, 0.2, 0.5, 1, 2, 5))
    ax.legend()
    ends = {"n": (n[0], n[-1]), "mm": (e[0], e[-1]), "ideal_mm": ideal[-1]}
    return fig.saying("averaging", floor_mm=floor_mm, **ends)
