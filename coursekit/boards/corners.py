"""Corners to a fraction of a pixel, how far the image's noise moves them, and how blurred it is.

A corner q is where all edges around it point to: at a pixel p with the brightness gradient g, g is
at right angles to the edge, so g . (p - q) = 0. The weighted least-squares answer is

    q = A^-1 sum(w g g' p),    A = sum(w g g'),

found by repeating it with the window moved to q (Foerstner and Guelch 1987; OpenCV's cornerSubPix).
What is done differently here: the window is not a number of pixels but 0.4 of a square, in the
board's own directions, so that it holds as much of the four edges as there is and never reaches
the next corner; where a ChArUco board has a marker in the window, its pixels get no weight; and the
image is smoothed by a pixel first, which halves the error of gradients taken from a sharp image's
samples (0.03 px without) and costs no noise, since the differences smooth anyway.

The blur is measured at the edges between the corners. Let C be its covariance, px^2. An edge with
the unit normal n turns into a step of standard deviation w with w^2 = n' C n: a board's two
directions of edges give two of C's three numbers. The third is in the corners. There two edges
cross, and the grey at the crossing would be half-way if the blur were round; a blur along a
diagonal mixes in more of the squares on that diagonal. For a Gaussian blur it is off by a share
(2 / pi) arcsin(rho) of half the contrast (Sheppard 1899), rho being the correlation of the blur
across the two edges: n1' C n2 = rho w1 w2.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from scipy.special import ndtr

from coursekit.arrays import Bools, Floats, Grey, NDArray
from coursekit.boards.board import Board

Patch = NDArray[np.float32]
FourArrays = tuple[Floats, Floats, Floats, Floats]

# --- corners ---

REACH = 0.4  # half the window's side, in squares
LEAST_REACH_PX = 2.0  # ... and at least this
LEAST_SQUARE_PX2 = 1.0  # the area of a square, px^2
SMOOTH_PX = 1.0  # standard deviation of the smoothing
KERNEL = (7, 7)
RIM_PX = 4  # beside the image's rim, what smoothing and differences made up from outside
MARKER_MARGIN_PX = 2.5  # the blur of a marker's edge stays out of the window
MAX_STEPS = 10
NEAR_PX = 0.02  # a step this short is near enough for Newton's method
LAST_STEPS = 2
PROBE_PX = 0.25  # to measure how the window pulls back
LEAST_PULL = 0.3  # per px; less than this and something else than one corner is in the window
FARTHEST_MOVE = 0.3  # squares from where the search began; farther away is something else
BLOCK_PX = 4  # px; noise is measured in blocks,
MOST_BLOCKS = 30_000  # at most so many
FLAT_CONTRAST = 0.04  # of the contrast: a block as bright as its neighbours within this has no edge
CLIPPED = (3.0, 252.0)  # grey levels at which noise may be cut off
BINS = 12  # of brightness
FEWEST_BLOCKS = 30  # in a bin
# About its plane, a block of pure noise has the noise's variance times chi2(13) / 13:
QUANTILE, QUANTILE_AT = 0.25, 0.715  # this share of blocks lies below that,
HIGHEST_RATIO = 2.5  # and next to none above this


@dataclass(frozen=True)
class _Window:
    """A corner's window at its whole-pixel size: weights and offsets from the centre.

    weight (h, w); dx (w,), dy (h,): px.
    """

    weight: Patch
    dx: Patch
    dy: Patch


def steps(pixels: Floats, ids: NDArray[np.intp], board: Board) -> Floats:
    """Pixels per square along the board's x and y at each corner, (N, 2, 2), as columns.

    Half the way from the neighbour before to the neighbour after; where one is missing, the
    derivative of the homography through all corners.
    """
    columns, rows = board.corners
    grid = np.full((rows + 2, columns + 2, 2), np.nan)
    row, column = np.divmod(ids, columns)
    grid[row + 1, column + 1] = pixels
    along_x = (grid[row + 1, column + 2] - grid[row + 1, column]) / 2
    along_y = (grid[row + 2, column + 1] - grid[row, column + 1]) / 2
    central = np.stack([along_x, along_y], axis=-1)
    return np.where(np.isnan(central), _homography_steps(pixels, ids, board), central)


def _homography_steps(pixels: Floats, ids: NDArray[np.intp], board: Board) -> Floats:
    plane = board.points[ids][:, :2] / board.square_m
    H, _ = cv2.findHomography(plane, pixels)
    if H is None:
        raise ValueError("pixels: the corners lie on one line")
    p = np.c_[plane, np.ones(len(plane))] @ H.T
    uv = p[:, :2] / p[:, 2:]
    return (H[:2, :2] - uv[:, :, None] * H[2, :2]) / p[:, 2, None, None]


def refine_corners(
    grey: Grey, start: Floats, steps: Floats, ids: NDArray[np.intp], board: Board
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
        if not np.abs(step).max() < max(grey.shape) or abs(np.linalg.det(step)) < LEAST_SQUARE_PX2:
            continue  # a window larger than the image, or none: such corners are on no board
        window = _window(step, bool(board.falling[ids[k]]), board)
        found = _corner(image, centre, window, FARTHEST_MOVE * np.linalg.norm(step, axis=0).min())
        if found is None:
            continue
        pixels[k], pull = found
        covariances[k] = _covariance(image, pixels[k], pull, window, levels, variances)
    return pixels, covariances


def noise_levels(grey: Grey) -> tuple[Floats, Floats]:
    """The variance of an image's noise at several grey levels, (M,) each, for `np.interp`.

    Measured in blocks of 4x4 px without an edge, about the plane through each. Noise counts as
    independent from pixel to pixel: what compression or demosaicing has smoothed away is not seen.
    """
    n = BLOCK_PX
    rows, columns = (size // n for size in grey.shape)
    blocks = grey[: rows * n, : columns * n].reshape(rows, n, columns, n)
    level = blocks.mean(axis=(1, 3), dtype=np.float32)
    contrast = np.subtract(*np.quantile(level, [0.99, 0.01]))
    flat = _is_flat(level, FLAT_CONTRAST * contrast) & (level > CLIPPED[0]) & (level < CLIPPED[1])
    if flat.sum() < FEWEST_BLOCKS:  # nothing but edges: all blocks, whose lowest are still noise
        flat = np.ones_like(flat)
    row, column = np.nonzero(flat)
    some = slice(None, None, -(-len(row) // MOST_BLOCKS))
    row, column = row[some], column[some]
    level, variance = level[row, column], _plane_residual(blocks[row, :, column])
    edges = np.linspace(level.min(), level.max() + 1e-3, BINS + 1)
    bins = np.digitize(level, edges)
    groups = [bins == k for k in range(1, BINS + 1) if (bins == k).sum() >= FEWEST_BLOCKS]
    groups = groups or [np.ones(len(level), bool)]
    levels = np.array([level[group].mean() for group in groups], np.float64)
    return levels, np.array([_noise_variance(variance[group]) for group in groups])


def _is_flat(level: Patch, most: float) -> Bools:
    """(rows, columns): blocks whose four neighbours are as bright within `most` grey levels."""
    down = np.abs(np.diff(level, axis=0)) <= most
    right = np.abs(np.diff(level, axis=1)) <= most
    flat = np.zeros(level.shape, bool)
    flat[1:-1, 1:-1] = down[1:, 1:-1] & down[:-1, 1:-1] & right[1:-1, 1:] & right[1:-1, :-1]
    return flat


def _plane_residual(blocks: Grey) -> Patch:
    """Variance (M,) of blocks (M, 4, 4) about their planes."""
    v, u = np.mgrid[:BLOCK_PX, :BLOCK_PX]
    planes, _ = np.linalg.qr(np.stack([np.ones(BLOCK_PX**2), u.ravel(), v.ravel()], axis=1))
    flat = blocks.reshape(-1, BLOCK_PX**2).astype(np.float32)
    flat = flat - flat.mean(axis=1, keepdims=True)
    squares = (flat**2).sum(axis=1) - ((flat @ planes.astype(np.float32)) ** 2).sum(axis=1)
    return np.maximum(squares, 0.0) / (BLOCK_PX**2 - 3)


def _noise_variance(variance: Patch) -> float:
    """The noise's variance from blocks, some of which may have texture."""
    noise = float(np.quantile(variance, QUANTILE)) / QUANTILE_AT
    return float(variance[variance <= HIGHEST_RATIO * noise].mean())


def _window(step: Floats, falling: bool, board: Board) -> _Window:
    """Weights exp(-(x^2 + y^2) / reach^2) in the board's directions, none on a marker."""
    square_px = np.linalg.norm(step, axis=0)  # along x and y
    reach = np.maximum(REACH, LEAST_REACH_PX / square_px)  # squares
    half = np.ceil(np.abs(step) @ reach).astype(int)
    dx = np.arange(-half[0], half[0] + 1, dtype=np.float32)
    dy = np.arange(-half[1], half[1] + 1, dtype=np.float32)
    back = np.linalg.inv(step)
    x = back[0, 0] * dx + back[0, 1] * dy[:, None]
    y = back[1, 0] * dx + back[1, 1] * dy[:, None]
    weight = np.exp(-((x / reach[0]) ** 2) - (y / reach[1]) ** 2)
    weight[(np.abs(x) > reach[0]) | (np.abs(y) > reach[1])] = 0.0
    if board.marker_m is not None:
        weight[_marker(x, y, step, falling, board.marker_share)] = 0.0
    return _Window(weight.astype(np.float32), dx, dy)


def _marker(x: Floats, y: Floats, step: Floats, falling: bool, share: float) -> Bools:
    """Which pixels at (x, y) squares from a corner lie on a marker or in the blur of its edge."""
    px = np.linalg.norm(step, axis=0)
    gap = 0.5 * (1.0 - share)
    free = np.maximum(np.minimum(gap - MARKER_MARGIN_PX / px, 0.5 * gap), 1.0 / px)
    white = (x * y > 0) == falling
    return white & (np.abs(x) > free[0]) & (np.abs(y) > free[1])


def _corner(
    image: Patch, start: Floats, window: _Window, farthest: float
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
    for _ in range(LAST_STEPS):
        q = q - np.linalg.solve(pull, _step(image, q, window))
    return (q, pull) if np.hypot(*(q - start)) <= farthest else None


def _step(image: Patch, q: Floats, window: _Window) -> Floats:
    """From q to where the edges in the window around it point; NaN when they are all parallel."""
    gx, gy, weight = _gradients(image, q, window)
    A = _structure(gx, gy, weight)
    if not np.linalg.det(A) > 1e-6 * np.trace(A) ** 2:
        return np.full(2, np.nan)
    along = gx * window.dx + gy * window.dy[:, None]
    return np.linalg.solve(A, [np.vdot(weight * gx, along), np.vdot(weight * gy, along)])


def _gradients(image: Patch, q: Floats, window: _Window) -> tuple[Patch, Patch, Patch]:
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


def _patch(image: Patch, q: Floats, window: _Window) -> Patch:
    """The image around q, a pixel wider than the window on each side, bilinear."""
    size = (len(window.dx) + 2, len(window.dy) + 2)
    return np.asarray(cv2.getRectSubPix(image, size, (float(q[0]), float(q[1]))), np.float32)


def _structure(gx: Patch, gy: Patch, weight: Patch) -> Floats:
    wx, wy = weight * gx, weight * gy
    mixed = np.vdot(wx, gy)
    return np.array([[np.vdot(wx, gx), mixed], [mixed, np.vdot(wy, gy)]], np.float64)


def _covariance(
    image: Patch, q: Floats, pull: Floats, window: _Window, levels: Floats, variances: Floats
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
    to_x = _transposed(weight * (r + gx * dx), weight * gx * dy, q)
    to_y = _transposed(weight * gy * dx, weight * (r + gy * dy), q)
    C = np.stack([to_x, to_y])
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


# --- blur ---

ALONG = np.linspace(0.3, 0.7, 9)  # where an edge is sampled, as shares of its length
ACROSS = np.linspace(-1.0, 1.0, 27)  # ... and in units of the reach
BLUR_REACH = 0.35  # squares from the edge,
REACH_PX = 13.0  # no more than this,
REACH_CELLS = 0.5  # and so far into a marker's black frame
FIRST_PX = 1.0  # where the fit of a width begins
FIT_STEPS = 12
FIT_DAMPING = 1e-3
LONGEST_STEP = 0.5  # px, or in the logarithm of the width
WIDTHS_PX = (0.1, 10.0)  # what a fit may find
LEAST_CONTRAST = 10.0  # grey levels
FEWEST_EDGES = 4  # edges in each direction
BILINEAR = 1.0 / 6.0  # px^2: the mean variance that bilinear interpolation adds


def blur_covariance(
    grey: Grey, pixels: Floats, ids: NDArray[np.intp], steps: Floats, board: Board
) -> Floats | None:
    """The blur's covariance (2, 2), px^2, the pixel's own width included.

    pixels (N, 2): corners, px. steps (N, 2, 2): px per square, as `steps` gives them. None
    where fewer than four edges in either direction can be measured.
    """
    sets = [_fit(*_edges(grey, pixels, ids, steps, board, axis)) for axis in (0, 1)]
    normals, widths, blacks, whites = zip(*sets, strict=True)
    if min(map(len, widths)) < FEWEST_EDGES:
        return None
    rows = [_products(n, n) / w[:, None] ** 2 for n, w in zip(normals, widths, strict=True)]
    values = [np.ones(len(w)) for w in widths]
    w1, w2 = (float(np.median(w)) for w in widths)
    black, white = (np.median(np.concatenate(levels)) for levels in (blacks, whites))
    shifts = 2.0 * (_at(grey, pixels) - black) / (white - black) - 1.0
    rho = _correlation(shifts, board.falling[ids])
    rho *= np.sqrt((1.0 + BILINEAR / w1**2) * (1.0 + BILINEAR / w2**2))
    first, second = _across(steps, 0), _across(steps, 1)
    rows.append(_products(first, second) / (w1 * w2))
    values.append(np.full(len(pixels), rho))
    xx, xy, yy = np.linalg.lstsq(np.concatenate(rows), np.concatenate(values))[0]
    variances, directions = np.linalg.eigh([[xx, xy], [xy, yy]])
    return (directions * np.maximum(variances, 0.0)) @ directions.T


def _products(a: Floats, b: Floats) -> Floats:
    """(N, 3): what multiplies Cxx, Cxy and Cyy in a' C b."""
    mixed = a[:, 0] * b[:, 1] + a[:, 1] * b[:, 0]
    return np.stack([a[:, 0] * b[:, 0], mixed, a[:, 1] * b[:, 1]], axis=1)


def _across(steps: Floats, axis: int) -> Floats:
    """Unit normals (N, 2) of edges along the board's `axis`, towards growing other axis."""
    along, other = steps[:, :, axis], steps[:, :, 1 - axis]
    normal = np.stack([-along[:, 1], along[:, 0]], axis=1)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return normal * np.sign((normal * other).sum(axis=1, keepdims=True))


def _correlation(shifts: Floats, falling: Bools) -> float:
    """Correlation of the blur across the two edges, from the grey at the corners.

    shifts (N,): -1 black, 1 white. The two kinds of corners move apart; what they have in common
    is light, gamma, or bleeding of ink, and cancels.
    """
    if falling.all() or not falling.any():
        return 0.0
    shift = 0.5 * (np.median(shifts[falling]) - np.median(shifts[~falling]))
    return float(np.sin(0.5 * np.pi * np.clip(shift, -1.0, 1.0)))


def _at(grey: Grey, pixels: Floats) -> Floats:
    """Grey levels (N,) at pixels (N, 2), bilinear."""
    u, v = np.hsplit(pixels.astype(np.float32), 2)
    rim = cv2.BORDER_REPLICATE
    values = cv2.remap(grey.astype(np.float32), u, v, cv2.INTER_LINEAR, borderMode=rim)
    return np.asarray(values, np.float64).ravel()


def _edges(
    grey: Grey, pixels: Floats, ids: NDArray[np.intp], steps: Floats, board: Board, axis: int
) -> FourArrays:
    """Samples of the edges between neighbours along the board's x (axis 0) or y (axis 1).

    Returns normal (E, 2): towards the white side; distance, grey (E, M): samples, px along the
    normal and grey levels; marker (E,): px from the edge to the marker, infinite on a checkerboard.
    Whole pixels are taken, each with its own distance from the straight line between the two
    corners: interpolating would blur.
    """
    columns = board.corners[0]
    where = np.full(len(board.points) + columns + 1, -1)
    where[ids] = np.arange(len(ids))
    second = where[ids + (1, columns)[axis]]
    pair = (second >= 0) & ((axis == 1) | (ids % columns < columns - 1))
    second = second[pair]
    start, line = pixels[pair], pixels[second] - pixels[pair]
    other = 0.5 * (steps[pair] + steps[second])[:, :, 1 - axis]
    normal = _across(np.stack([line, other][:: 1 - 2 * axis], axis=-1), axis)
    square = np.abs((normal * other).sum(axis=1))
    normal = np.where(board.falling[ids[pair], None], normal, -normal)
    marker, reach = _marker_and_reach(square, board)
    on_line = start[:, None, None] + ALONG[:, None, None] * line[:, None, None]
    spots = on_line + (reach[:, None] * ACROSS)[:, None, :, None] * normal[:, None, None]
    spots = np.rint(spots).astype(int).reshape(len(start), ALONG.size * ACROSS.size, 2)
    inside = ((spots >= 0) & (spots < grey.shape[::-1])).all(axis=(1, 2))
    spots, normal = spots[inside], normal[inside]
    distance = np.einsum("emi,ei->em", spots - start[inside, None], normal)
    levels = grey[spots[..., 1], spots[..., 0]].astype(np.float64)
    return normal, distance, levels, marker[inside]


def _marker_and_reach(square: Floats, board: Board) -> tuple[Floats, Floats]:
    """Distance of the markers from edges, and how far to sample, px, for squares this wide, px."""
    reach = np.minimum(BLUR_REACH * square, REACH_PX)
    if board.marker_m is None:
        return np.full(len(square), np.inf), reach
    gap = 0.5 * (1.0 - board.marker_share)
    cell = board.marker_share / len(board.markers[0][2])
    return gap * square, np.minimum(reach, (gap + REACH_CELLS * cell) * square)


def _fit(normal: Floats, distance: Floats, grey: Floats, marker: Floats) -> FourArrays:
    """Width of each edge: black + contrast (Phi(z) - Phi(z - marker / width)), z = (d - m) / width.

    Levenberg-Marquardt with fixed damping on all edges, of `_edges`, at once. Returns of those that
    could be fitted: normal (E, 2), width (E,) px, black and white (E,).
    """
    if len(grey) == 0:
        return normal, *np.empty((3, 0))
    bright = distance > 0
    black = np.average(grey, axis=1, weights=~bright)
    white = np.average(grey, axis=1, weights=bright)
    zero = np.zeros_like(black)
    p = np.stack([black, white - black, zero, zero + np.log(FIRST_PX)])
    for _ in range(FIT_STEPS):
        model, J = _profile(distance, marker, p)
        A = np.einsum("iem,jem->eij", J, J)
        A += FIT_DAMPING * A * np.eye(4) + 1e-9 * np.eye(4)
        step = np.linalg.solve(A, np.einsum("iem,em->ei", J, grey - model)[..., None])
        step = step[..., 0].T
        step[2:] = np.clip(step[2:], -LONGEST_STEP, LONGEST_STEP)
        p = p + step
        p[3] = np.clip(p[3], *np.log(WIDTHS_PX))
    black, contrast, offset, width = *p[:3], np.exp(p[3])
    good = (width > 1.01 * WIDTHS_PX[0]) & (width < 0.99 * WIDTHS_PX[1])
    good &= (np.abs(contrast) > LEAST_CONTRAST) & (np.abs(offset) < 1.0 + width)
    return normal[good], width[good], black[good], (black + contrast)[good]


def _profile(distance: Floats, marker: Floats, p: Floats) -> tuple[Floats, Floats]:
    """The model (E, M) and its derivatives (4, E, M) by the parameters p (4, E) of `_fit`."""
    black, c, offset, log_width = p[..., None]
    width = np.exp(log_width)
    z = (distance - offset) / width
    up, bump = ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    zbump = z * bump
    if np.isfinite(marker).all():
        y = z - marker[:, None] / width
        fall = np.exp(-0.5 * y * y) / np.sqrt(2 * np.pi)
        up, bump, zbump = up - ndtr(y), bump - fall, zbump - y * fall
    return black + c * up, np.stack([np.ones_like(up), up, -c * bump / width, -c * zbump])
