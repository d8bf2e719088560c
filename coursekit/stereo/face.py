"""Where a block's front face is in a depth stack, and how wide it looks.

The face is found around a pixel as what hangs together at about one depth and is as wide as a block
(`_find_face`). A plane through it gives its depth and tilt, and straight lines through the last
pixels on that plane, row by row, give its two upright edges to sub-pixel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from coursekit.arrays import AnyArray, Bools, Floats, Interval, Window
from coursekit.checks import instance, positive, refuse, want
from coursekit.geometry import Intrinsics, deproject
from coursekit.stereo import windows
from coursekit.stereo.law import rounded_variance, unrounded_std
from coursekit.stereo.windows import WindowStats

HALF_WINDOW_PX = 5.5  # of the matching window; edges are pushed out by up to that
EDGE_BAND_PX = 8  # beside an edge, where pixels may fly
GAP_PX = 4  # holes up to this wide do not end a face
FACE_WINDOW_PX = 40
USUAL_WIDTH_M = 0.060
NEAR_FACE = 0.35  # of the width: tilt, noise and pattern move no pixel of a face farther


@dataclass(frozen=True, eq=False)
class BlockFace:
    """The front face of a block, from a depth stack; lengths in m.

    depth_m: Z of the face's plane at its centre, and standard error. tilt_deg: the angle between
    the face's normal and the optical axis. edges_px: u of the left and right edge on the middle
    row. width_m: between the edges, as measured, in the face's plane; width_error_m: its standard
    error from the edges' jitter from row to row, the pixel grid and the depth.
    widths_m (N,): the width in each frame, with its edges found anew, NaN for a frame without the
    face; width_std_m: std of that.
    width_held_std_m: std of the width when the edges are held and only the plane's depth changes.
    fattening_px: what each edge is pushed outwards if the depth is right, against the known width,
    and standard error. window: on the face. stats: of `window_stats` there.
    """

    depth_m: float
    depth_error_m: float
    tilt_deg: float
    edges_px: Interval
    width_m: float
    width_error_m: float
    width_std_m: float
    width_held_std_m: float
    fattening_px: float
    fattening_error_px: float
    window: Window
    stats: WindowStats
    widths_m: Floats

    @property
    def depth_std_mm(self) -> float:
        """Std over time of one pixel's depth on the face, mm."""
        return 1e3 * self.stats.pixel_std_m

    @property
    def depth_std_error_mm(self) -> float:
        """Standard error of `depth_std_mm`."""
        return 1e3 * self.stats.pixel_std_error_m

    @property
    def width_std_error_m(self) -> float:
        """Standard error of `width_std_m`, frames taken as `averaging_curve` finds them."""
        known = self.widths_m[np.isfinite(self.widths_m)]
        return windows.std_error(*windows.series_std(known - known.mean()))


@dataclass(frozen=True, eq=False)
class _Patch:
    """The part of a depth stack around the face, and where in it the face is.

    z (N, h, w): depths in m, NaN invalid. left, top: of its first pixel in the image. rows,
    columns: of the face in it. plane (3,): 1/Z = plane . (1, u - u0, v - v0) about the middle of
    the patch. tolerance: within which a pixel is on the face's plane, m.
    """

    intrinsics: Intrinsics
    z: Floats
    left: int
    top: int
    rows: slice
    columns: slice
    plane: Floats
    tolerance: float

    def measure(self, lines: Floats, plane: Floats) -> tuple[float, float, float]:
        """Width, depth at the face's centre (m) and tilt (degrees) of a face with these edges.

        lines (2, 2): u at the middle row and du/dv of both edges. From 1/Z = n . (x, y, 1) /
        distance: the normal's slopes are those of 1/Z.
        """
        camera, corner = self.intrinsics, np.array([self.left, self.top])
        v = (self.rows.start + self.rows.stop - 1) / 2
        pixels = np.array([[u, v] for u in (*lines[:, 0], lines[:, 0].mean())])
        middle = (np.array(self.z.shape[:0:-1]) - 1) / 2
        inverse = np.column_stack([np.ones(3), pixels - middle]) @ plane
        left, right, centre = deproject(pixels + corner, 1 / inverse, camera.K, camera.dist)
        lean = math.cos(math.atan(float(lines[:, 1].mean())))
        slopes = plane[1:] * [camera.fx, camera.fy]
        ray = (pixels[2] + corner - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
        facing = float(inverse[2] - slopes @ ray)
        tilt = math.degrees(math.atan2(math.hypot(*slopes), facing))
        return float(np.linalg.norm(right - left)) * lean, float(centre[2]), tilt


def block_face(
    depth: Any,
    intrinsics: Intrinsics | None = None,
    depth_scale_m: float | None = None,
    width_m: float | None = USUAL_WIDTH_M,
    near: tuple[float, float] | None = None,
) -> BlockFace:
    """The front face of a block: its plane, its two upright edges to sub-pixel, its width.

    depth: stack or frames, see the room. width_m: the block's true width, by caliper, or None.
    near: a pixel (u, v) on the face; None takes the image's centre.

    In each frame and row the face reaches to the last pixel within tolerance of its plane; the
    edge is half a pixel further. A straight line through the rows' edges, taken over rows and
    frames, is sub-pixel as far as the edge jitters or leans; where it does not, the pixel grid's
    own error (`rounded_variance`) is in width_error_m. Rows correlate over CORRELATION_PX.
    Raises ValueError for no frames, a unit or intrinsics that are missing, and when no face is
    found: the message says what was seen.

    >>> camera = Intrinsics(120, 90, 400.0, 400.0, 59.5, 44.5)
    >>> image = np.full((90, 120), 0.9)
    >>> image[20:70, 33:87] = 0.4  # 54 px of 0.4 m / 400 px each: 54 mm
    >>> print(f"{1e3 * block_face(image, camera, width_m=0.054).width_m:.1f} mm")
    54.0 mm
    """
    stack, step = windows.depth_stack(depth, depth_scale_m)
    intrinsics = intrinsics or getattr(windows.first_frame(depth), "depth_intrinsics", None)
    camera = instance("intrinsics", intrinsics, Intrinsics)
    size = (camera.height, camera.width)
    want(stack.shape[1:] == size, "depth", stack.shape[1:], f"images of {size} as the intrinsics")
    if width_m is not None:
        width_m = positive("width_m", width_m)
    patch = _find_face(stack, step, camera, width_m, near)
    planes, edges = _frame_planes(patch), _edges(patch)
    line, edge_error = _edge_lines(edges)
    window = _face_window(patch)
    stats = windows.window_stats(stack, window, step)
    width, level, tilt = patch.measure(line, patch.plane)
    held = [patch.measure(line, plane)[0] for plane in planes]
    anew = (_edge_lines(edges[:, i : i + 1])[0] for i in range(len(planes)))
    widths = [patch.measure(lines, plane)[0] for lines, plane in zip(anew, planes, strict=True)]
    per_pixel = width / float(line[1, 0] - line[0, 0])
    left, right = (line[:, 0] + patch.left).tolist()
    return BlockFace(
        depth_m=level,
        depth_error_m=stats.depth_error_m,
        tilt_deg=tilt,
        edges_px=(left, right),
        width_m=width,
        width_error_m=math.hypot(per_pixel * edge_error, width / level * stats.depth_error_m),
        width_std_m=_std(widths),
        width_held_std_m=_std(held),
        fattening_px=math.nan if width_m is None else (width - width_m) / per_pixel / 2,
        fattening_error_px=math.nan if width_m is None else edge_error / 2,
        window=window,
        stats=stats,
        widths_m=np.array(widths),
    )


def _std(values: list[float]) -> float:
    known = np.array(values)[np.isfinite(values)]
    return float(known.std(ddof=1)) if known.size > 1 else math.nan


# --- finding the face ---


def _find_face(
    stack: AnyArray,
    step: float | None,
    intrinsics: Intrinsics,
    width_m: float | None,
    near: tuple[float, float] | None,
) -> _Patch:
    """The face around the pixel `near`: pixels about as far away, hanging together."""
    u, v = near or ((intrinsics.width - 1) / 2, (intrinsics.height - 1) / 2)
    few = stack[:: max(1, len(stack) // 8)]
    around = windows.clip_window((round(u) - 10, round(v) - 10, 21, 21), few)
    seen = windows.cut(few, around, step)
    seen = seen[np.isfinite(seen)]
    refuse(seen.size == 0, f"depth: no valid pixel near ({u:.0f}, {v:.0f}), so no face there")
    size = width_m or USUAL_WIDTH_M
    z0 = float(np.percentile(seen, 25))  # the block, even where it fills only part of the window
    z0 = float(np.median(seen[np.abs(seen - z0) < NEAR_FACE * size]))
    half = round(1.2 * intrinsics.fx * size / z0) + 30
    wide = (round(u) - half, round(v) - half, 2 * half + 1, 2 * half + 1)
    window = windows.clip_window(wide, few)
    image = windows.valid_median(windows.cut(few, window, step))
    left, top = window[:2]
    near_mask = np.abs(image - z0) < NEAR_FACE * size
    rows, columns = _rows_and_columns(
        near_mask, round(v) - top, round(u) - left, intrinsics.fx * size / z0, width_m is not None
    )
    plane, tolerance = _face_plane(image, rows, columns, step)
    z = windows.cut(stack, window, step)
    return _Patch(intrinsics, z, left, top, rows, columns, plane, tolerance)


def _rows_and_columns(
    mask: Bools, row: int, column: int, expected_px: float, known: bool
) -> tuple[slice, slice]:
    """Rows in which the mask's run through the column is as wide as a block, and its columns.

    Below the block stands a table, which is wider; fattening adds some pixels to each side.
    """
    from scipy import ndimage

    closed = ndimage.binary_closing(np.pad(mask, GAP_PX), np.ones((GAP_PX + 1, GAP_PX + 1)))
    closed = closed[GAP_PX:-GAP_PX, GAP_PX:-GAP_PX]
    column = int(np.clip(column, 0, mask.shape[1] - 1))
    row = int(np.clip(row, 0, mask.shape[0] - 1))
    ends = np.array([_run(line, column) for line in closed])
    lengths = ends[:, 1] - ends[:, 0]
    typical = float(np.median(lengths[max(row - 8, 0) : row + 9]))
    middle = expected_px if known else typical
    fits = (lengths > 0.7 * middle) & (lengths < middle + 2 * HALF_WINDOW_PX + 4)
    bridged = ndimage.binary_closing(np.pad(fits, EDGE_BAND_PX), np.ones(EDGE_BAND_PX))
    start, stop = _run(bridged[EDGE_BAND_PX:-EDGE_BAND_PX], row)
    if stop - start < 8:
        wanted = f"want rows about {expected_px:.0f} px wide, found {typical:.0f} px"
        raise ValueError(f"depth: no block's face there: {wanted}")
    inset = max(2, round(0.12 * (stop - start)))
    rows = slice(start + inset, stop - inset)
    sure = ends[rows][fits[rows]]
    columns = slice(int(np.median(sure[:, 0])), int(np.median(sure[:, 1])))
    return rows, columns


def _run(line: Bools, at: int) -> tuple[int, int]:
    """Start and stop of the run of True in a line (n,) around index `at`, (at, at) if none."""
    if not line[at]:
        return at, at
    off = np.flatnonzero(~line)
    return int(off[off < at].max(initial=-1)) + 1, int(off[off > at].min(initial=len(line)))


def _inner(shape: tuple[int, ...], rows: slice, columns: slice) -> Bools:
    """The pixels (h, w) of a face away from its edges."""
    inset = min(EDGE_BAND_PX, (columns.stop - columns.start) // 5)
    inner = np.zeros(shape, bool)
    inner[rows, columns.start + inset : columns.stop - inset] = True
    return inner


def _face_plane(
    image: Floats, rows: slice, columns: slice, step: float | None
) -> tuple[Floats, float]:
    """The plane of the face and how far off it a pixel of the face may be, m."""
    box = _inner(image.shape, rows, columns)
    use = box & np.isfinite(image)
    for _ in range(4):
        if use.sum() < 12:
            raise ValueError(f"depth: only {use.sum()} valid pixels on the face, want at least 12")
        plane = windows.fit_plane(np.where(use, image, np.nan))
        off = image - 1 / windows.plane_image(plane, image.shape)
        spread = 1.4826 * float(np.median(np.abs(off[use])))
        tolerance = max(6 * spread, 3 * (step or 0.0), 0.001)
        use = box & (np.abs(off) < tolerance)
    return plane, tolerance


# --- its planes and edges, frame by frame ---


def _frame_planes(patch: _Patch) -> Floats:
    """The face's plane in each frame, (N, 3); the stack's where a frame has too few pixels."""
    inner = _inner(patch.z.shape[1:], patch.rows, patch.columns)
    off = patch.z - 1 / windows.plane_image(patch.plane, inner.shape)
    use = inner & (np.abs(off) < 2 * patch.tolerance)
    enough = use.sum(axis=(1, 2))[:, None] >= 12
    return np.where(enough, windows.fit_plane(np.where(use, patch.z, np.nan)), patch.plane)


def _edges(patch: _Patch) -> Floats:
    """The u of the left and right edge in the patch, (2, N, rows); NaN where there is no face.

    Half a pixel beyond the last pixel on the face's plane, reached from the middle without a gap
    of more than GAP_PX.
    """
    plane = 1 / windows.plane_image(patch.plane, patch.z.shape[1:])
    on_face = np.abs(patch.z[:, patch.rows] - plane[patch.rows]) < patch.tolerance
    middle = (patch.columns.start + patch.columns.stop) // 2
    right = _reach(on_face[..., middle:])
    left = _reach(on_face[..., middle::-1])
    return np.stack([middle - left - 0.5, middle + right + 0.5])


def _reach(on_face: Bools) -> Floats:
    """The last True of each row (..., n) before a gap of more than GAP_PX; NaN for none."""
    column = np.arange(on_face.shape[-1])
    seen = np.maximum.accumulate(np.where(on_face, column, -1), axis=-1)
    ends = np.argmax(column - seen > GAP_PX, axis=-1)[..., None]  # 0 where there is no such gap
    last = np.take_along_axis(seen, ends - 1, axis=-1)[..., 0]
    return np.where(last < 0, np.nan, last)


def _edge_lines(edges: Floats) -> tuple[Floats, float]:
    """Lines through edges (2, N, rows): (u at the middle row, du/dv) each (2, 2); and the standard
    error of the distance between the two, px."""
    (*left, left_error), (*right, right_error) = map(_edge_line, edges)
    return np.array([left, right]), math.hypot(left_error, right_error)


def _edge_line(edges: Floats) -> tuple[float, float, float]:
    """u at the middle row, du/dv and standard error (px) of one edge (N, rows)."""
    if not np.isfinite(edges).any():  # a frame without depth
        return (math.nan,) * 3
    off_median = np.abs(edges - np.nanmedian(edges))
    good = np.where(off_median <= 2 * HALF_WINDOW_PX, edges, np.nan)  # no matching pushes farther
    mean = windows.valid_mean(good, axis=0)
    known = np.isfinite(mean)
    if known.sum() < 3:
        return (math.nan,) * 3
    v = np.flatnonzero(known) - (len(mean) - 1) / 2
    slope, at = np.polyfit(v, mean[known], 1)
    off = mean[known] - at - slope * v
    jitter = float(np.nanstd(good[:, known] - at - slope * v))
    # The pixel grid: what jitter and lean leave of the rounding to whole pixels.
    dither = math.hypot(unrounded_std(jitter, 1.0), slope * len(mean) / math.sqrt(12))
    grid = dither**2 + 1 / 12 - float(rounded_variance(dither, 1.0))
    patches = min(windows.effective_frames(off[:, None])[0], len(off) / windows.CORRELATION_PX)
    error = math.sqrt(max(grid, 0.0) + float(np.var(off)) / max(patches, 1.0))
    return float(at), float(slope), error


# --- a window on it, and flying pixels beside it ---


def _face_window(patch: _Patch) -> Window:
    """A square window in the middle of the face, FACE_WINDOW_PX wide where there is room."""
    rows, columns = patch.rows, patch.columns
    room = min(columns.stop - columns.start - EDGE_BAND_PX, rows.stop - rows.start)
    size = max(min(FACE_WINDOW_PX, room), 1)
    u, v = ((side.start + side.stop - size) // 2 for side in (columns, rows))
    return patch.left + u, patch.top + v, size, size
