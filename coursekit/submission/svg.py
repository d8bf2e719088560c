"""The two figures of a report as plain SVG; a plotting library would take longer than grading."""

from __future__ import annotations

import math
from collections.abc import Sequence
from html import escape

import numpy as np

from coursekit.stereo import rounded_variance
from coursekit.submission.contents import Plot, Submission
from coursekit.submission.recompute import Recomputed

# As in plots/style.py, where the same thing has the same colour; text in them is darker.
MODEL, MEASURED, INK, FAINT = "#0072B2", "#D55E00", "#222222", "#BBBBBB"
WIDTH, HEIGHT = 480, 320  # of the view; a phone shows it at three quarters of that
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 14, 46
BARS_HEIGHT = 200
LARGEST_MM = 1e6  # beyond this nothing is drawn


class _Axes:
    """Straight axes from 0 in y; millimetres and metres to the view's units."""

    def __init__(self, x: tuple[float, float], y_top: float) -> None:
        self.x_range, self.y_top = x, y_top

    def x(self, value: float) -> float:
        low, high = self.x_range
        return LEFT + (WIDTH - LEFT - RIGHT) * (value - low) / (high - low)

    def y(self, value: float) -> float:
        return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * value / self.y_top

    def draw(self, x_label: str, y_label: str) -> list[str]:
        """Axis lines, ticks with numbers, and labels."""
        floor, end = HEIGHT - BOTTOM, WIDTH - RIGHT
        parts = [_line(LEFT, floor, end, floor, INK), _line(LEFT, TOP, LEFT, floor, INK)]
        for value in _ticks(*self.x_range, 6):
            at = self.x(value)
            parts += [_line(at, floor, at, floor + 5, INK), _text(at, floor + 19, f"{value:.2g}")]
        for value in _ticks(0, self.y_top, 5):
            at = self.y(value)
            parts.append(_line(LEFT, at, end, at, "#EEEEEE") if value else "")
            parts.append(_text(LEFT - 7, at + 4, f"{value:.3g}", "end"))
        middle = (TOP + floor) / 2
        parts.append(_text((LEFT + end) / 2, HEIGHT - 8, x_label))
        turned = f'transform="rotate(-90 14 {middle:.1f})"'
        return [*parts, _text(14, middle, y_label, "middle", turned)]


def noise_plot(submission: Submission, found: Recomputed) -> str:
    """Std of depth against distance: recomputed with its error, the law, and what was claimed.

    Values off the scale are left out and named in the text alternative.
    """
    measured = [(m.distance_m, m.std.value, m.std.se) for m in found.at if m.std is not None]
    rows = submission.claims.rows
    claimed = [(r.distance_m, r.depth_std_mm) for r in rows if r.depth_std_mm is not None]
    plot = submission.plot or Plot((), (), ())
    predicted = list(zip(plot.distances_m, plot.predicted_mm or (), strict=False))  # or none
    tops = [std + 2 * se for _, std, se in measured if std < LARGEST_MM]
    if not tops:
        return ""
    limit = 2.5 * max(*tops, 1e-6)
    shown = [v for _, v in claimed + predicted if 0 <= v <= limit]
    ends = [z for z, _, _ in measured]
    if found.law is not None:
        shown.append(min(1e3 * float(found.law.std_m(1.1 * max(ends))[0]), limit))
    axes = _Axes((0.8 * min(ends), 1.1 * max(ends)), 1.1 * max([*tops, *shown, 1e-6]))
    parts = axes.draw("distance by tape (m)", "std of depth (mm)")
    parts += _law(axes, found)
    inside = [p for p in predicted if _fits(axes, *p)]
    parts += [_square(axes.x(z), axes.y(v)) for z, v in inside]
    parts += [_with_bar(axes, *point) for point in measured if point[1] < LARGEST_MM]
    parts += [_cross(axes.x(z), axes.y(v)) for z, v in claimed if _fits(axes, z, v)]
    alt = _alternative(measured, claimed, predicted, axes)
    keys = [(_dot(0, 0), "recomputed from your raw depths, ± 2 standard errors")]
    if found.law is not None:
        keys.append((_stroke("M-9 0H9"), f"law with their σ_d of {found.law.sigma_d_px:.3f} px"))
        if _rounding_shows(found, ends):
            step = 1e3 * submission.camera.depth_scale_m
            keys.append((_dashes("M-9 0H9"), f"the same in depth counts of {step:g} mm"))
    keys += [(_cross(0, 0), "your table")] if claimed else []
    keys += [(_square(0, 0), "your prediction")] if predicted else []
    return _svg("std of depth against distance", alt, HEIGHT, parts) + _key(keys)


def _key(keys: Sequence[tuple[str, str]]) -> str:
    """What the signs of a figure mean, as HTML below it."""
    parts = [
        '<span><svg viewBox="-10 -9 20 18" width="22" height="20" aria-hidden="true">'
        f"{sign}</svg>{escape(words)}</span>"
        for sign, words in keys
    ]
    return f'<p class="key">{"".join(parts)}</p>'


def _alternative(
    measured: Sequence[tuple[float, float, float]],
    claimed: Sequence[tuple[float, float]],
    predicted: Sequence[tuple[float, float]],
    axes: _Axes,
) -> str:
    said, guessed = dict(claimed), dict(predicted)
    parts = []
    for z, std, se in measured:
        part = f"{z:.2f} m: recomputed {std:.3g} ± {se:.2g} mm"
        part += f", claimed {said[z]:.3g} mm" if z in said else ""
        part += f", predicted {guessed[z]:.3g} mm" if z in guessed else ""
        parts.append(part)
    off = [f"{v:.3g} mm at {z:.2f} m" for z, v in [*claimed, *predicted] if not _fits(axes, z, v)]
    text = "Std of one pixel's depth over time at " + "; ".join(parts) + "."
    return f"{text} Off the scale and not drawn: {', '.join(off)}." if off else text


def off_scale(svg: str) -> str:
    """The sentence of a figure's text alternative about what is not drawn, or nothing."""
    _, found, rest = svg.partition("Off the scale")
    return f"{found}{rest.partition('</desc>')[0]}" if found else ""


def _law(axes: _Axes, found: Recomputed) -> list[str]:
    if found.law is None:
        return []
    z = np.linspace(*axes.x_range, 40)
    curves = [1e3 * curve for curve in found.law.std_m(z)]
    middle, low, high = (list(zip(z.tolist(), curve.tolist(), strict=True)) for curve in curves)
    band = [(a, min(b, axes.y_top)) for a, b in low + high[::-1]]
    parts = [f'<path d="{_path(axes, band)}Z" fill="{MODEL}" opacity="0.15"/>']
    parts.append(_stroke(_path(axes, [(a, b) for a, b in middle if b <= axes.y_top])))
    if _rounding_shows(found, list(axes.x_range)):
        rounded = [(a, _rounded_mm(found, b)) for a, b in middle]
        parts.append(_dashes(_path(axes, [(a, b) for a, b in rounded if b <= axes.y_top])))
    return parts


def _path(axes: _Axes, points: Sequence[tuple[float, float]]) -> str:
    return "M" + "L".join(f"{axes.x(a):.1f} {axes.y(b):.1f}" for a, b in points) if points else ""


def _rounded_mm(found: Recomputed, std_mm: float) -> float:
    """What a std becomes when depths are rounded to counts."""
    return math.sqrt(float(rounded_variance(std_mm, 1e3 * found.at[0].scale_m)))


def _rounding_shows(found: Recomputed, distances_m: Sequence[float]) -> bool:
    if found.law is None:
        return False
    least = 1e3 * float(found.law.std_m(min(distances_m))[0])
    return _rounded_mm(found, least) > 1.05 * least


def histogram(percents: Sequence[float]) -> str:
    """How many students got which part of the points, in tens of percent."""
    bins = [0] * 10
    for percent in percents:
        bins[min(max(int(percent // 10), 0), 9)] += 1
    most, floor = max([*bins, 1]), BARS_HEIGHT - BOTTOM
    wide = (WIDTH - LEFT - RIGHT) / 10
    parts = [_line(LEFT, floor, WIDTH - RIGHT, floor, INK)]
    for i, n in enumerate(bins):
        x, tall = LEFT + i * wide, (floor - TOP - 14) * n / most
        parts.append(
            f'<rect x="{x + 2:.1f}" y="{floor - tall:.1f}" width="{wide - 4:.1f}" '
            f'height="{tall:.1f}" fill="{MODEL}"/>'
        )
        parts.append(_text(x + wide / 2, floor - tall - 5, str(n)) if n else "")
    parts += [_text(LEFT + i * wide, floor + 19, str(10 * i)) for i in range(0, 11, 2)]
    parts.append(
        _text((LEFT + WIDTH - RIGHT) / 2, BARS_HEIGHT - 8, "points (% of what can be had)")
    )
    words = [f"{n} from {10 * i} to {10 * i + 10} %" for i, n in enumerate(bins) if n]
    alt = f"Students by points: {', '.join(words)}." if words else "No graded bundle."
    return _svg("distribution of points", alt, BARS_HEIGHT, parts)


def _svg(title: str, alt: str, height: int, parts: Sequence[str]) -> str:
    return (
        f'<svg class="figure" viewBox="0 0 {WIDTH} {height}" role="img" xmlns="http://www.w3.org/2000/svg">'
        f"<title>{escape(title)}</title><desc>{escape(alt)}</desc>{''.join(parts)}</svg>"
    )


def _fits(axes: _Axes, z: float, value: float) -> bool:
    low, high = axes.x_range
    return low <= z <= high and 0 <= value <= axes.y_top


def _ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers from low to high, some `about` of them."""
    raw = (high - low) / about
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(f * power for f in (1, 2, 5, 10) if f * power >= raw * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


def _line(x1: float, y1: float, x2: float, y2: float, colour: str) -> str:
    ends = f'x1="{x1:.1f}" y1="{y1:.1f}" x2="{x2:.1f}" y2="{y2:.1f}"'
    return f'<line {ends} stroke="{colour}"/>'


def _text(x: float, y: float, words: str, anchor: str = "middle", more: str = "") -> str:
    start = f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{INK}"'
    return f"{start} {more}>{escape(words)}</text>"


def _stroke(path: str, colour: str = MODEL) -> str:
    return f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="2"/>'


def _dashes(path: str) -> str:
    return (
        f'<path d="{path}" fill="none" stroke="{MODEL}" stroke-width="1.5" stroke-dasharray="5 3"/>'
    )


def _dot(x: float, y: float) -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4.5" fill="{MEASURED}"/>'


def _with_bar(axes: _Axes, z: float, std: float, se: float) -> str:
    x, low, high = axes.x(z), axes.y(max(std - 2 * se, 0)), axes.y(min(std + 2 * se, axes.y_top))
    bar = f"M{x:.1f} {low:.1f}V{high:.1f}M{x - 4:.1f} {low:.1f}h8M{x - 4:.1f} {high:.1f}h8"
    return _stroke(bar, MEASURED) + _dot(x, axes.y(std))


def _cross(x: float, y: float) -> str:
    return _stroke(f"M{x - 7:.1f} {y - 7:.1f}l14 14m0 -14l-14 14", INK)


def _square(x: float, y: float) -> str:
    return (
        f'<rect x="{x - 6:.1f}" y="{y - 6:.1f}" width="12" height="12" fill="none" '
        f'stroke="{MODEL}" stroke-width="2"/>'
    )
