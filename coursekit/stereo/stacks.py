"""Depth stacks, windows of them and planes through them; checks at the boundary."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]
    Interval = tuple[float, float]
    Window = tuple[int, int, int, int]

LINE = 84  # characters


def first_frame(depth: Any) -> Any:
    """The first of a camera's frames, or None for an array."""
    if isinstance(depth, np.ndarray) or not hasattr(depth, "__getitem__"):
        return None
    return depth[0] if len(depth) else None


def depth_stack(depth: Any, depth_scale_m: float | None) -> tuple[NDArray[Any], float | None]:
    """The stack (N, H, W) as it came, and its unit; frames bring both."""
    if hasattr(depth, "__len__") and len(depth) == 0:
        raise ValueError("depth: got 0 frames, want at least one")
    frame = first_frame(depth)
    if frame is not None and hasattr(frame, "depth_scale_m"):
        depth, depth_scale_m = np.stack([f.depth for f in depth]), frame.depth_scale_m
    stack = np.asarray(depth)
    if stack.ndim == 2:
        stack = stack[None]
    if stack.ndim != 3 or stack.dtype.kind not in "uf":
        raise ValueError(
            f"depth: got shape {stack.shape} of {stack.dtype}, want (N, H, W) of unsigned counts "
            "or floats in m"
        )
    if depth_scale_m is not None:
        depth_scale_m = positive("depth_scale_m", depth_scale_m)
    elif stack.dtype.kind == "u":
        raise ValueError("depth_scale_m: got None, want the metres of a count")
    return stack, depth_scale_m


def cut(stack: NDArray[Any], window: Window, step: float | None) -> Floats:
    """The window's depths (N, h, w) in m, NaN where invalid; ValueError off the image."""
    rows, columns = stack.shape[1:]
    try:
        left, top, width, height = (int(v) for v in window)
        whole = (left, top, width, height) == tuple(window)
    except (TypeError, ValueError):
        whole = False
    if not whole:
        raise ValueError(f"window: got {window!r}, want (left, top, width, height) in whole px")
    if (
        width < 1
        or height < 1
        or left < 0
        or top < 0
        or left + width > columns
        or (top + height > rows)
    ):
        raise ValueError(
            f"window: got {window!r}, want a window inside the image of {columns}x{rows} px"
        )
    part = stack[:, top : top + height, left : left + width]
    z = part.astype(np.float64)
    if part.dtype.kind == "u":
        z *= step or 1.0
    z[~((z > 0) & np.isfinite(z))] = np.nan
    return z


def clip_window(window: Window, stack: NDArray[Any]) -> Window:
    """The part of a window that is on the image; ValueError when there is none."""
    left, top = max(window[0], 0), max(window[1], 0)
    right = min(window[0] + window[2], stack.shape[2])
    bottom = min(window[1] + window[3], stack.shape[1])
    if right <= left or bottom <= top:
        raise ValueError(f"near: a window {window} around it is off the image")
    return left, top, right - left, bottom - top


def valid_mean(values: Floats, axis: int) -> Floats:
    """The mean without NaN, NaN where there is nothing else."""
    known = np.isfinite(values)
    counts = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.where(counts > 0, total / np.maximum(counts, 1), np.nan)


def valid_median(stack: Floats) -> Floats:
    """The median over frames (N, ...) without NaN, NaN where there is nothing else."""
    ordered = np.sort(stack, axis=0)  # NaN last
    counts = np.isfinite(stack).sum(axis=0)
    low, high = np.maximum((counts - 1) // 2, 0), np.minimum(counts // 2, len(stack) - 1)
    pick = [np.take_along_axis(ordered, i[None], axis=0)[0] for i in (low, high)]
    return np.where(counts > 0, (pick[0] + pick[1]) / 2, np.nan)


def rms(parts: list[Floats]) -> float:
    values = np.concatenate([p[np.isfinite(p)] for p in parts])
    return float(np.sqrt(np.square(values).mean())) if values.size else math.nan


def valid_std(values: Floats) -> float:
    known = values[np.isfinite(values)]
    return float(known.std(ddof=1)) if known.size > 1 else math.nan


def about_plane(image: Floats) -> tuple[Floats, float]:
    """What an image (h, w) of depths is off its plane, and the plane's depth at the centre.

    A plane in space is linear in 1/Z, so that is fitted. NaN is invalid; fewer than three valid
    pixels leave NaN.
    """
    known = np.isfinite(image)
    rows, columns = np.nonzero(known)
    if len(rows) < 3:
        return np.full(image.shape, np.nan), math.nan
    design = plane_design(columns, rows, image.shape)
    coefficients, *_ = np.linalg.lstsq(design, 1 / image[known], rcond=None)
    residual = np.full(image.shape, np.nan)
    residual[known] = image[known] - 1 / (design @ coefficients)
    return residual, float(1 / coefficients[0])


def plane_design(columns: Any, rows: Any, shape: tuple[int, ...]) -> Floats:
    u, v = columns - (shape[1] - 1) / 2, rows - (shape[0] - 1) / 2
    return np.stack([np.ones(len(u)), u, v], axis=-1)


def plane_image(plane: Any, shape: tuple[int, ...]) -> Floats:
    """1/Z of a plane at the pixels of a patch (h, w)."""
    v, u = np.indices(shape)
    return (plane_design(u.ravel(), v.ravel(), shape) @ plane).reshape(shape)


def std_error(std: float, dof: float) -> float:
    return std / math.sqrt(2 * dof) if dof > 0 else math.nan


def std_interval(std: float, dof: float) -> Interval:
    from scipy import stats

    if not dof > 0:
        return math.nan, math.nan
    high, low = stats.chi2.ppf([0.025, 0.975], dof)
    return std * math.sqrt(dof / low), std * math.sqrt(dof / high)


def wrapped(text: str) -> str:
    """Text in lines that a notebook's page holds; JupyterLab breaks longer ones in mid-word."""
    return textwrap.fill(text, LINE, subsequent_indent="    ", break_on_hyphens=False)


def with_notes(text: str, notes: tuple[str, ...]) -> str:
    """Text, and below it, indented, what has to be said about it."""
    if not notes:
        return text
    return f"{text}.\n    {wrapped('Note: ' + '; '.join(notes) + '.')}"


def counted(n: int, thing: str) -> str:
    return f"{n} {thing}" + "s" * (n != 1)


def numbers(name: str, values: ArrayLike, shape: tuple[int, ...] | None = None) -> Floats:
    try:
        array = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name}: got {values!r}, want numbers") from None
    if shape is not None and array.shape != shape:
        raise ValueError(f"{name}: got shape {array.shape}, want {shape}, one for each distance")
    return array


def increasing(name: str, values: ArrayLike) -> Floats:
    array = np.atleast_1d(numbers(name, values))
    if array.ndim != 1 or array.size == 0 or not (np.isfinite(array) & (array > 0)).all():
        raise ValueError(f"{name}: got {array.tolist()}, want positive distances in m")
    if (np.diff(array) <= 0).any():
        raise ValueError(f"{name}: got {array.tolist()}, want them to increase")
    return array


def positive(name: str, value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)):
        raise ValueError(f"{name}: got {value!r}, want a positive number")
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name}: got {value!r}, want a positive number")
    return float(value)


def fx_baseline(fx: Any, baseline_m: Any) -> float:
    if baseline_m is None:
        raise ValueError(
            "baseline_m: got None: this recording does not say how far apart its eyes are; give "
            "the data sheet's baseline if that will do"
        )
    return positive("fx", fx) * positive("baseline_m", baseline_m)
