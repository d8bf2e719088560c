"""Corners to a fraction of a pixel, and how far the image's noise moves them.

A corner q is where all edges around it point to: at a pixel p with the brightness gradient g, g is
at right angles to the edge, so g . (p - q) = 0. The weighted least-squares answer is

    q = A^-1 sum(w g g' p),    A = sum(w g g'),

found by repeating it with the window moved to q (Foerstner and Guelch 1987; OpenCV's cornerSubPix).
What is done differently here: the window is not a number of pixels but 0.4 of a square, in the
board's own directions, so that it holds as much of the four edges as there is and never reaches
the next corner; where a ChArUco board has a marker in the window, its pixels get no weight; and the
image is smoothed by a pixel first, which halves the error of gradients taken from a sharp image's
samples (0.03 px without) and costs no noise, since the differences smooth anyway.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.boards.board import Board

    Floats = NDArray[np.float64]
    Patch = NDArray[np.float32]

REACH = 0.4  # half the window's side, in squares
LEAST_PX = 2.0  # ... and at least this
SMOOTH_PX = 1.0  # standard deviation of the smoothing
KERNEL = (7, 7)
RIM_PX = 4  # beside the image's rim, what smoothing and differences made up from outside
MARKER_MARGIN_PX = 2.5  # the blur of a marker's edge stays out of the window
MAX_STEPS = 10
NEAR_PX = 0.02  # a step this short is near enough for Newton's method
NEWTON_STEPS = 2
PROBE_PX = 0.25  # to measure how the window pulls back
LEAST_PULL = 0.3  # per px; less than this and something else than one corner is in the window
FARTHEST = 0.3  # squares from where the search began: what moves farther found something else
BLOCK = 4  # px; noise is measured in blocks,
BLOCKS = 30_000  # at most so many
FLAT = 0.04  # of the image's contrast: a block as bright as its neighbours within this has no edge
CLIPPED = (3.0, 252.0)  # grey levels at which noise may be cut off
BINS = 12  # of brightness
LEAST_BLOCKS = 30  # in a bin
# About its plane, a block of pure noise has the noise's variance times chi2(13) / 13:
QUANTILE, QUANTILE_AT = 0.25, 0.715  # this share of blocks lies below that,
HIGHEST = 2.5  # and next to none above this


@dataclass(frozen=True)
class Window:
    """A corner's window at its whole-pixel size: weights and offsets from the centre.

    weight (h, w); dx (w,), dy (h,): px.
    """

    weight: Patch
    dx: Patch
    dy: Patch


def refine(
    grey: NDArray[np.uint8], start: Floats, steps: Floats, ids: NDArray[np.intp], board: Board
) -> tuple[Floats, Floats]:
    """Corners near `start` and the covariance of each.

    grey (H, W). start (N, 2): px. steps (N, 2, 2): px per square, columns along the board's x and
    y. Returns (N, 2) px, NaN where no corner is, and (N, 2, 2) px^2, NaN likewise.
    """
    image = np.asarray(cv2.GaussianBlur(grey.astype(np.float32), KERNEL, SMOOTH_PX), np.float32)
    levels, variances = noise_levels(grey)
    pixels = np.full((len(start), 2), np.nan)
    covariances = np.full((len(start), 2, 2), np.nan)
    for k, (centre, step) in enumerate(zip(start, steps, strict=True)):
        window = _window(step, bool(board.falling[ids[k]]), board)
        found = _corner(image, centre, window, FARTHEST * np.linalg.norm(step, axis=0).min())
        if found is None:
            continue
        pixels[k], pull = found
        covariances[k] = _covariance(image, pixels[k], pull, window, levels, variances)
    return pixels, covariances


def noise_levels(grey: NDArray[np.uint8]) -> tuple[Floats, Floats]:
    """The variance of an image's noise at several grey levels, (M,) each, for `np.interp`.

    Measured in blocks of 4x4 px without an edge, about the plane through each. Noise counts as
    independent from pixel to pixel: what compression or demosaicing has smoothed away is not seen.
    """
    rows, columns = (size // BLOCK for size in grey.shape)
    blocks = grey[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK)
    level = blocks.mean(axis=(1, 3), dtype=np.float32)
    contrast = np.subtract(*np.quantile(level, [0.99, 0.01]))
    flat = _is_flat(level, FLAT * contrast) & (level > CLIPPED[0]) & (level < CLIPPED[1])
    if flat.sum() < LEAST_BLOCKS:  # nothing but edges: all blocks, whose lowest are still noise
        flat = np.ones_like(flat)
    row, column = np.nonzero(flat)
    some = slice(None, None, -(-len(row) // BLOCKS))
    row, column = row[some], column[some]
    level, variance = level[row, column], _plane_residual(blocks[row, :, column])
    edges = np.linspace(level.min(), level.max() + 1e-3, BINS + 1)
    bins = np.digitize(level, edges)
    groups = [bins == k for k in range(1, BINS + 1) if (bins == k).sum() >= LEAST_BLOCKS]
    groups = groups or [np.ones(len(level), bool)]
    return (
        np.array([level[group].mean() for group in groups], np.float64),
        np.array([_noise_variance(variance[group]) for group in groups]),
    )


def _is_flat(level: Patch, most: float) -> NDArray[np.bool_]:
    """(rows, columns): blocks whose four neighbours are as bright within `most` grey levels."""
    down = np.abs(np.diff(level, axis=0)) <= most
    right = np.abs(np.diff(level, axis=1)) <= most
    flat = np.zeros(level.shape, bool)
    flat[1:-1, 1:-1] = down[1:, 1:-1] & down[:-1, 1:-1] & right[1:-1, 1:] & right[1:-1, :-1]
    return flat


def _plane_residual(blocks: NDArray[np.uint8]) -> Patch:
    """Variance (M,) of blocks (M, 4, 4) about their planes."""
    v, u = np.mgrid[:BLOCK, :BLOCK]
    planes, _ = np.linalg.qr(np.stack([np.ones(BLOCK**2), u.ravel(), v.ravel()], axis=1))
    flat = blocks.reshape(-1, BLOCK**2).astype(np.float32)
    flat = flat - flat.mean(axis=1, keepdims=True)
    squares = (flat**2).sum(axis=1) - ((flat @ planes.astype(np.float32)) ** 2).sum(axis=1)
    return np.maximum(squares, 0.0) / (BLOCK**2 - 3)


def _noise_variance(variance: Patch) -> float:
    """The noise's variance from blocks, some of which may have texture."""
    noise = float(np.quantile(variance, QUANTILE)) / QUANTILE_AT
    return float(variance[variance <= HIGHEST * noise].mean())


def _window(step: Floats, falling: bool, board: Board) -> Window:
    """Weights exp(-(x^2 + y^2) / reach^2) in the board's directions, none on a marker."""
    reach = np.maximum(REACH, LEAST_PX / np.linalg.norm(step, axis=0))  # squares along x and y
    half = np.ceil(np.abs(step) @ reach).astype(int)
    dx = np.arange(-half[0], half[0] + 1, dtype=np.float32)
    dy = np.arange(-half[1], half[1] + 1, dtype=np.float32)
    back = np.linalg.inv(step)
    x = back[0, 0] * dx + back[0, 1] * dy[:, None]
    y = back[1, 0] * dx + back[1, 1] * dy[:, None]
    weight = np.exp(-((x / reach[0]) ** 2) - (y / reach[1]) ** 2)
    weight[(np.abs(x) > reach[0]) | (np.abs(y) > reach[1])] = 0.0
    if board.marker_m is not None:
        weight[_marker(x, y, step, falling, board.marker_m / board.square_m)] = 0.0
    return Window(weight.astype(np.float32), dx, dy)


def _marker(x: Floats, y: Floats, step: Floats, falling: bool, share: float) -> NDArray[np.bool_]:
    """Which pixels at (x, y) squares from a corner lie on a marker or in the blur of its edge."""
    px = np.linalg.norm(step, axis=0)
    gap = 0.5 * (1.0 - share)
    free = np.maximum(np.minimum(gap - MARKER_MARGIN_PX / px, 0.5 * gap), 1.0 / px)
    white = (x * y > 0) == falling
    return white & (np.abs(x) > free[0]) & (np.abs(y) > free[1])


def _corner(
    image: Patch, start: Floats, window: Window, farthest: float
) -> tuple[Floats, Floats] | None:
    """The corner (2,) in the window that begins at `start`, and how the window pulls towards it.

    The pull (2, 2) is the derivative of `_step` by its q: minus one where the window holds the
    four edges alone. None where no corner is.
    """
    q = start
    for _ in range(MAX_STEPS):
        step = _step(image, q, window)
        q = q + step
        if not np.hypot(*(q - start)) <= farthest:  # also NaN
            return None
        if np.hypot(*step) < NEAR_PX:
            break
    else:
        return None
    probes = PROBE_PX * np.eye(2)
    change = [_step(image, q + d, window) - _step(image, q - d, window) for d in probes]
    pull = np.stack(change, axis=1) / (2 * PROBE_PX)
    if not np.isfinite(pull).all() or np.linalg.svd(pull)[1][-1] < LEAST_PULL:
        return None
    for _ in range(NEWTON_STEPS):
        q = q - np.linalg.solve(pull, _step(image, q, window))
    return (q, pull) if np.hypot(*(q - start)) <= farthest else None


def _step(image: Patch, q: Floats, window: Window) -> Floats:
    """From q to where the edges in the window around it point; NaN when they are all parallel."""
    gx, gy, weight = _gradients(image, q, window)
    A = _structure(gx, gy, weight)
    if not np.linalg.det(A) > 1e-6 * np.trace(A) ** 2:
        return np.full(2, np.nan)
    along = gx * window.dx + gy * window.dy[:, None]
    return np.linalg.solve(A, [np.vdot(weight * gx, along), np.vdot(weight * gy, along)])


def _gradients(image: Patch, q: Floats, window: Window) -> tuple[Patch, Patch, Patch]:
    """Twice the gradient (h, w) around q, and the weights: 0 at the image's rim and outside."""
    patch = _patch(image, q, window)
    gx = patch[1:-1, 2:] - patch[1:-1, :-2]
    gy = patch[2:, 1:-1] - patch[:-2, 1:-1]
    height, width = image.shape
    x, y = q[0] + window.dx, q[1] + window.dy
    right, below = width - 1 - RIM_PX, height - 1 - RIM_PX
    if x[0] >= RIM_PX and y[0] >= RIM_PX and x[-1] <= right and y[-1] <= below:
        return gx, gy, window.weight
    inside = ((y >= RIM_PX) & (y <= below))[:, None] & ((x >= RIM_PX) & (x <= right))
    inside &= inside[::-1, ::-1]  # half a blurred corner would pull to its side
    return gx, gy, window.weight * inside


def _patch(image: Patch, q: Floats, window: Window) -> Patch:
    """The image around q, a pixel wider than the window on each side, bilinear."""
    size = (len(window.dx) + 2, len(window.dy) + 2)
    return np.asarray(cv2.getRectSubPix(image, size, (float(q[0]), float(q[1]))), np.float32)


def _structure(gx: Patch, gy: Patch, weight: Patch) -> Floats:
    wx, wy = weight * gx, weight * gy
    mixed = np.vdot(wx, gy)
    return np.array([[np.vdot(wx, gx), mixed], [mixed, np.vdot(wy, gy)]], np.float64)


def _covariance(
    image: Patch, q: Floats, pull: Floats, window: Window, levels: Floats, variances: Floats
) -> Floats:
    """Covariance (2, 2) of a corner from the noise of the pixels, px^2.

    At the corner s = sum(w g r) = 0 with r = g . (p - q). A change n of the image changes g, and
    with it s by sum(w (dg r + g (dg . (p - q)))): linear in n, so s = C n with C from differences,
    interpolation and smoothing, each transposed. The corner moves by G s with G = -(A pull)^-1, so
    cov(q) = G C cov(n) C' G'.
    """
    gx, gy, weight = _gradients(image, q, window)
    dx, dy = window.dx, window.dy[:, None]
    r = gx * dx + gy * dy
    C = np.stack(
        [
            _transposed(weight * (r + gx * dx), weight * gx * dy, q),
            _transposed(weight * gy * dx, weight * (r + gy * dy), q),
        ]
    )
    sigma2 = np.interp(_patch(image, q, window), levels, variances)
    margin = KERNEL[0] // 2
    sigma2 = np.pad(sigma2, (margin, margin + 1), mode="edge")
    gain = -np.linalg.inv(_structure(gx, gy, weight) @ pull)
    return gain @ np.einsum("aij,bij,ij->ab", C, C, sigma2, optimize=True) @ gain.T


def _transposed(on_gx: Patch, on_gy: Patch, q: Floats) -> Floats:
    """What multiplies each image pixel, given what multiplies the two differences.

    (h, w) become (h + 9, w + 9): a pixel more on each side for the differences, one below and
    right for the interpolation, three on each side for the smoothing.
    """
    rows, columns = on_gx.shape
    on_patch = np.zeros((rows + 2, columns + 2))
    on_patch[1:-1, 2:] += on_gx
    on_patch[1:-1, :-2] -= on_gx
    on_patch[2:, 1:-1] += on_gy
    on_patch[:-2, 1:-1] -= on_gy
    fx, fy = np.mod(q, 1.0)
    m = KERNEL[0] // 2
    image = np.zeros((rows + 3 + 2 * m, columns + 3 + 2 * m))
    below, right = slice(m + 1, rows + 3 + m), slice(m + 1, columns + 3 + m)
    above, left = slice(m, rows + 2 + m), slice(m, columns + 2 + m)
    image[above, left] = (1 - fx) * (1 - fy) * on_patch
    image[above, right] += fx * (1 - fy) * on_patch
    image[below, left] += (1 - fx) * fy * on_patch
    image[below, right] += fx * fy * on_patch
    smoothed = cv2.GaussianBlur(image, KERNEL, SMOOTH_PX, borderType=cv2.BORDER_CONSTANT)
    return np.asarray(smoothed, np.float64)
