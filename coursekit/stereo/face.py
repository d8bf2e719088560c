"""A block's front face in a depth stack: its plane, its edges, its width."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from coursekit.arrays import Bools, Floats, Interval, NDArray, Window
from coursekit.checks import positive
from coursekit.geometry import Intrinsics, deproject
from coursekit.stereo.law import rounded_variance, unrounded_std
from coursekit.stereo.windows import (
    CORRELATION_PX,
    WindowStats,
    clip_window,
    cut,
    depth_stack,
    effective_frames,
    first_frame,
    plane_design,
    plane_image,
    series_std,
    std_error,
    valid_mean,
    valid_median,
    valid_std,
    window_stats,
)
from coursekit.words import wrapped

HALF_WINDOW_PX = 5.5  # of the matching window; edges are pushed out by up to that
EDGE_BAND_PX = 8  # on either side of an edge, where flying pixels are counted
GAP_PX = 4  # holes up to this wide do not end a face
FACE_WINDOW_PX = 40
NEAR_FACE = 0.35  # of the width: tilt, noise and pattern move no pixel of a face farther


@dataclass(frozen=True, eq=False, repr=False)
class BlockFace:
    """The front face of a block, from a depth stack; lengths in m.

    depth_m: Z of the face's plane at its centre, and standard error. tilt_deg: the angle between
    the face's normal and the optical axis. edges_px: u of the left and right edge on the middle
    row. width_m: between the edges, as measured, in the face's plane; width_error_m: its standard
    error from the edges' jitter from row to row, the pixel grid and the depth.
    widths_m, depths_m (N,): width, with its edges found anew, and depth of each frame; width_std_m:
    std of the first. width_held_std_m: std of the width when the edges are held and only the
    plane's depth changes. edge_jitter_px: std of an edge from row to row. fattening_px: what
    each edge is pushed outwards if the depth is right, against the known width, and standard error;
    1 % of scale error would change it by `fattening_per_percent_px`. flying_fraction: of the valid
    pixels within 8 px of the edges, those on neither the face nor what is behind it.
    window: on the face. stats: what `window_stats` says there.
    """

    depth_m: float
    depth_error_m: float
    tilt_deg: float
    edges_px: Interval
    width_m: float
    width_error_m: float
    width_std_m: float
    width_held_std_m: float
    edge_jitter_px: float
    fattening_px: float
    fattening_error_px: float
    fattening_per_percent_px: float
    flying_fraction: float
    window: Window
    stats: WindowStats
    widths_m: Floats = field(default_factory=lambda: np.empty(0))
    depths_m: Floats = field(default_factory=lambda: np.empty(0))

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
        return std_error(*series_std(self.widths_m - self.widths_m.mean()))

    def __repr__(self) -> str:
        text = (
            f"face at Z = {1e3 * self.depth_m:.2f} ± {1e3 * self.depth_error_m:.2f} mm, tilted "
            f"{self.tilt_deg:.1f} deg, "
            f"{1e3 * self.width_m:.2f} ± {1e3 * self.width_error_m:.2f} mm wide"
        )
        if not math.isnan(self.fattening_px):
            text += (
                f", edges {self.fattening_px:+.2f} ± {self.fattening_error_px:.2f} px outwards "
                "if its depth is right"
            )
        said = f"{text}, {self.flying_fraction:.1%} flying pixels at its edges"
        return wrapped(said, 84, indent="    ")


@dataclass(frozen=True)
class _Patch:
    """A part of a depth stack around the face: z (N, h, w), its corner, rows and columns of the
    face in it, and the tolerance (m) within which a pixel is on the face's plane."""

    z: Any
    left: int
    top: int
    rows: slice
    columns: slice
    plane: Any  # (3,): 1/Z = plane . (1, u - u0, v - v0) about the centre of the patch
    tolerance: float


def block_face(
    depth: Any,
    intrinsics: Intrinsics | None = None,
    depth_scale_m: float | None = None,
    width_m: float | None = 0.060,
    near: tuple[float, float] | None = None,
) -> BlockFace:
    """The front face of a block: its plane, its two upright edges to sub-pixel, its width.

    depth: stack or frames, see the module. width_m: the block's true width, by caliper, or None.
    near: a pixel (u, v) on the face; None takes the image's centre.

    In each frame and row the face reaches to the last pixel within tolerance of its plane; the
    edge is half a pixel further. A straight line through the rows' edges, taken over rows and
    frames, is sub-pixel as far as the edge jitters or leans; where it does not, the pixel grid's
    own error (`rounded_variance`) is in width_error_m. Rows correlate over CORRELATION_PX.
    Raises ValueError for no frames, a unit or intrinsics that are missing, and when no face is
    found: the message says what was seen.
    """
    stack, step = depth_stack(depth, depth_scale_m)
    intrinsics = _intrinsics_of(depth, intrinsics, stack)
    if width_m is not None:
        width_m = positive("width_m", width_m)
    patch = _find_face(stack, step, intrinsics, width_m, near)
    inner = _inner(patch)
    planes = _frame_planes(patch, inner)
    edges = _edges(patch)
    line, jitter, edge_error = _edge_lines(edges)
    window = _face_window(patch)
    stats = window_stats(stack, window, step)
    place = _Place(intrinsics, patch)
    width, level, tilt = place.measure(line, patch.plane)
    held = np.array([place.measure(line, plane)[0] for plane in planes])
    found = [
        place.measure(_edge_lines(edges[:, i : i + 1])[0], plane) for i, plane in enumerate(planes)
    ]
    widths, depths = (np.array([value[k] for value in found]) for k in (0, 1))
    per_pixel = width / float(line[1, 0] - line[0, 0])
    fattening = math.nan if width_m is None else (width - width_m) / per_pixel / 2
    middle = (line[:, 0] + patch.left).tolist()
    return BlockFace(
        depth_m=level,
        depth_error_m=stats.depth_error_m,
        tilt_deg=tilt,
        edges_px=(middle[0], middle[1]),
        width_m=width,
        width_error_m=math.hypot(per_pixel * edge_error, width / level * stats.depth_error_m),
        width_std_m=valid_std(widths),
        width_held_std_m=valid_std(held),
        edge_jitter_px=jitter,
        fattening_px=fattening,
        fattening_error_px=edge_error / 2 if width_m is not None else math.nan,
        fattening_per_percent_px=0.005 * width / per_pixel,
        flying_fraction=_flying(patch, edges),
        window=window,
        stats=stats,
        widths_m=widths,
        depths_m=depths,
    )


def _intrinsics_of(depth: Any, intrinsics: Intrinsics | None, stack: NDArray[Any]) -> Intrinsics:
    """The intrinsics given, else those of the first frame; ValueError if they do not fit."""
    if intrinsics is None:
        intrinsics = getattr(first_frame(depth), "depth_intrinsics", None)
    if not isinstance(intrinsics, Intrinsics):
        raise ValueError(f"intrinsics: got {type(intrinsics).__name__}, want Intrinsics")
    if stack.shape[1:] != (intrinsics.height, intrinsics.width):
        raise ValueError(f"depth: got images {stack.shape[1:]}, want the intrinsics' size")
    return intrinsics


def _find_face(
    stack: Any,
    step: float | None,
    intrinsics: Intrinsics,
    width_m: float | None,
    near: tuple[float, float] | None,
) -> _Patch:
    """The face around the pixel `near`: pixels about as far away, hanging together."""
    u, v = near or ((intrinsics.width - 1) / 2, (intrinsics.height - 1) / 2)
    few = stack[:: max(1, len(stack) // 8)]
    around = clip_window((round(u) - 10, round(v) - 10, 21, 21), few)
    seen = cut(few, around, step)
    seen = seen[np.isfinite(seen)]
    if seen.size == 0:
        raise ValueError(
            f"depth: no valid pixel near ({u:.0f}, {v:.0f}), so no face is found there"
        )
    size = width_m or 0.060
    z0 = float(np.percentile(seen, 25))  # the block, even where it fills only part of the window
    z0 = float(np.median(seen[np.abs(seen - z0) < NEAR_FACE * size]))
    half = round(1.2 * intrinsics.fx * size / z0) + 30
    window = clip_window((round(u) - half, round(v) - half, 2 * half + 1, 2 * half + 1), few)
    image = valid_median(cut(few, window, step))
    left, top = window[:2]
    near_mask = np.abs(image - z0) < NEAR_FACE * size
    rows, columns = _rows_and_columns(
        near_mask, round(v) - top, round(u) - left, intrinsics.fx * size / z0, width_m is not None
    )
    plane, tolerance = _face_plane(image, rows, columns, step)
    z = cut(stack, window, step)
    return _Patch(z, left, top, rows, columns, plane, tolerance)


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
        raise ValueError(
            f"depth: no block's face there: wanted rows about {expected_px:.0f} px wide, found "
            f"{typical:.0f} px"
        )
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


def _face_plane(
    image: Floats, rows: slice, columns: slice, step: float | None
) -> tuple[Any, float]:
    """The plane of the face and how far off it a pixel of the face may be, m."""
    inset = min(EDGE_BAND_PX, (columns.stop - columns.start) // 5)
    box = np.zeros(image.shape, bool)
    box[rows, columns.start + inset : columns.stop - inset] = True
    use = box & np.isfinite(image)
    for _ in range(4):
        v, u = np.nonzero(use)
        if len(u) < 12:
            raise ValueError(f"depth: only {len(u)} valid pixels on the face, want at least 12")
        design = plane_design(u, v, image.shape)
        plane, *_ = np.linalg.lstsq(design, 1 / image[use], rcond=None)
        off = image - 1 / plane_image(plane, image.shape)
        spread = 1.4826 * float(np.median(np.abs(off[use])))
        tolerance = max(6 * spread, 3 * (step or 0.0), 0.001)
        use = box & (np.abs(off) < tolerance)
    return plane, tolerance


def _inner(patch: _Patch) -> Bools:
    """The pixels of the face away from its edges, (h, w)."""
    inset = min(EDGE_BAND_PX, (patch.columns.stop - patch.columns.start) // 5)
    inner = np.zeros(patch.z.shape[1:], bool)
    inner[patch.rows, patch.columns.start + inset : patch.columns.stop - inset] = True
    return inner


def _frame_planes(patch: _Patch, inner: Bools) -> Floats:
    """The face's plane in each frame, (N, 3); the stack's where a frame has too few pixels."""
    v, u = np.nonzero(inner)
    design = plane_design(u, v, inner.shape)
    base = 1 / (design @ patch.plane)
    planes = []
    for frame in patch.z:
        values = frame[inner]
        use = np.abs(values - base) < 2 * patch.tolerance
        planes.append(
            np.linalg.lstsq(design[use], 1 / values[use], rcond=None)[0]
            if use.sum() >= 12
            else patch.plane
        )
    return np.array(planes)


def _edges(patch: _Patch) -> Floats:
    """The u of the left and right edge in the patch, (2, N, rows); NaN where there is no face.

    Half a pixel beyond the last pixel on the face's plane, reached from the middle without a gap
    of more than GAP_PX.
    """
    plane = 1 / plane_image(patch.plane, patch.z.shape[1:])
    on_face = np.abs(patch.z[:, patch.rows] - plane[patch.rows]) < patch.tolerance
    middle = (patch.columns.start + patch.columns.stop) // 2
    right = _reach(on_face[..., middle:])
    left = _reach(on_face[..., middle::-1])
    return np.stack([middle - left - 0.5, middle + right + 0.5])


def _reach(on_face: Bools) -> Floats:
    """The last True of each row (..., n) before a gap of more than GAP_PX; NaN for none."""
    last = np.full(on_face.shape[:-1], np.nan)
    gap = np.zeros(on_face.shape[:-1], np.int64)
    for column in range(on_face.shape[-1]):
        hit = on_face[..., column] & (gap <= GAP_PX)
        gap = np.where(hit, 0, gap + 1)
        last[hit] = column
    return last


def _edge_lines(edges: Floats) -> tuple[Floats, float, float]:
    """Lines through edges (2, N, rows): (u at the middle row, du/dv) each (2, 2); the rows' jitter
    about them, px; and the standard error of the distance between the two, px."""
    left, right = (_edge_line(side) for side in edges)
    return (
        np.array([left[:2], right[:2]]),
        (left[2] + right[2]) / 2,
        math.hypot(left[3], right[3]),
    )


def _edge_line(edges: Floats) -> tuple[float, float, float, float]:
    """u at the middle row, du/dv, jitter (px) and standard error (px) of one edge (N, rows)."""
    good = _without_mismatches(edges)
    mean = valid_mean(good, axis=0)
    known = np.isfinite(mean)
    if known.sum() < 3:
        return (math.nan,) * 4
    v = np.flatnonzero(known) - (len(mean) - 1) / 2
    slope, at = np.polyfit(v, mean[known], 1)
    off = mean[known] - at - slope * v
    jitter = float(np.nanstd(good[:, known] - at - slope * v))
    # The pixel grid: what jitter and lean leave of the rounding to whole pixels.
    dither = math.hypot(unrounded_std(jitter, 1.0), slope * len(mean) / math.sqrt(12))
    grid = dither**2 + 1 / 12 - float(rounded_variance(dither, 1.0))
    patches = min(effective_frames(off[:, None])[0], len(off) / CORRELATION_PX)
    error = math.sqrt(max(grid, 0.0) + float(np.var(off)) / max(patches, 1.0))
    return float(at), float(slope), jitter, error


def _without_mismatches(edges: Floats) -> Floats:
    """Edges (N, rows) with NaN for those farther from the median than matching can push them."""
    return np.where(np.abs(edges - np.nanmedian(edges)) <= 2 * HALF_WINDOW_PX, edges, np.nan)


class _Place:
    """Where a patch's planes and edges are in space."""

    def __init__(self, intrinsics: Intrinsics, patch: _Patch) -> None:
        self.intrinsics, self.patch = intrinsics, patch
        height, width = patch.z.shape[1:]
        self.centre = (width - 1) / 2, (height - 1) / 2
        self.row = (patch.rows.start + patch.rows.stop - 1) / 2

    def measure(self, lines: Floats, plane: Floats) -> tuple[float, float, float]:
        """Width, depth at the face's centre (m) and tilt (degrees) of a face with these edges."""
        u = np.array([lines[0, 0], lines[1, 0], lines[:, 0].mean()])
        pixels = np.stack([u, np.full(3, self.row)], axis=-1)
        inverse = np.column_stack([np.ones(3), pixels - self.centre]) @ plane
        corner = (self.patch.left, self.patch.top)
        points = deproject(pixels + corner, 1 / inverse, self.intrinsics.K, self.intrinsics.dist)
        lean = math.cos(math.atan(float(lines[:, 1].mean())))
        width = float(np.linalg.norm(points[1] - points[0])) * lean
        return width, float(points[2, 2]), self._tilt(plane, float(inverse[2]), pixels[2] + corner)

    def _tilt(self, plane: Floats, inverse: float, pixel: Floats) -> float:
        """From 1/Z = n . (x, y, 1) / distance: the normal's slopes are those of 1/Z."""
        fx, fy, cx, cy = (getattr(self.intrinsics, k) for k in ("fx", "fy", "cx", "cy"))
        along, down = plane[1] * fx, plane[2] * fy
        facing = inverse - along * (pixel[0] - cx) / fx - down * (pixel[1] - cy) / fy
        return math.degrees(math.atan2(math.hypot(along, down), facing))


def _face_window(patch: _Patch) -> Window:
    """A square window in the middle of the face, FACE_WINDOW_PX wide where there is room."""
    margin = EDGE_BAND_PX // 2
    room = min(
        patch.columns.stop - patch.columns.start - 2 * margin, patch.rows.stop - patch.rows.start
    )
    size = max(min(FACE_WINDOW_PX, room), 1)
    u = (patch.columns.start + patch.columns.stop - size) // 2
    v = (patch.rows.start + patch.rows.stop - size) // 2
    return patch.left + u, patch.top + v, size, size


def _flying(patch: _Patch, edges: Floats) -> float:
    """The fraction of flying pixels in the bands along both edges.

    What is behind is taken row by row from the pixels next to the band.
    """
    plane = 1 / plane_image(patch.plane, patch.z.shape[1:])[patch.rows]
    z = patch.z[:, patch.rows]
    flying = valid = 0
    for side, outwards in ((0, -1), (1, 1)):
        at = round(float(np.nanmedian(edges[side])))
        band = _columns(at - EDGE_BAND_PX, at + EDGE_BAND_PX, z.shape[2])
        beyond = sorted((at + outwards * EDGE_BAND_PX, at + outwards * 2 * EDGE_BAND_PX))
        behind = z[..., _columns(beyond[0], beyond[1], z.shape[2])]
        rows = np.moveaxis(behind, 1, 2).reshape(-1, behind.shape[1])
        far = np.nan_to_num(valid_median(rows), nan=np.inf)[:, None]
        part, face = z[..., band], plane[:, band]
        slack = patch.tolerance * np.maximum((far / face) ** 2, 1.0)
        with np.errstate(invalid="ignore"):
            flying += int(((part > face + patch.tolerance) & (part < far - slack)).sum())
        valid += int(np.isfinite(part).sum())
    return flying / valid if valid else math.nan


def _columns(start: int, stop: int, width: int) -> slice:
    return slice(min(max(start, 0), width), min(max(stop, 0), width))
