"""How blurred an image is, and in which direction, from the edges between a board's corners.

Let C be the blur's covariance, px^2. An edge with the unit normal n turns into a step of standard
deviation w with w^2 = n' C n: a board's two directions of edges give two of C's three numbers. The
third is in the corners. There two edges cross, and the grey at the crossing would be half-way if
the blur were round; a blur along a diagonal mixes in more of the squares on that diagonal. For a
Gaussian blur it is off by a share (2 / pi) arcsin(rho) of half the contrast (Sheppard 1899), rho
being the correlation of the blur across the two edges: n1' C n2 = rho w1 w2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.special import ndtr

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.boards.board import Board

    Floats = NDArray[np.float64]
    Grey = NDArray[np.uint8]

ALONG = np.linspace(0.3, 0.7, 9)  # where an edge is sampled, as shares of its length
ACROSS = np.linspace(-1.0, 1.0, 27)  # ... and in units of the reach
REACH = 0.35  # squares from the edge,
REACH_PX = 13.0  # no more than this,
REACH_CELLS = 0.5  # and so far into a marker's black frame
FIRST_PX = 1.0  # where the fit of a width begins
FIT_STEPS = 12
DAMPING = 1e-3
LONGEST_STEP = 0.5  # px, or in the logarithm of the width
WIDTHS_PX = (0.1, 10.0)  # what a fit may find
LEAST_CONTRAST = 10.0  # grey levels
FEWEST = 4  # edges in each direction
BILINEAR = 1.0 / 6.0  # px^2: the mean variance that bilinear interpolation adds


@dataclass(frozen=True)
class _Edges:
    """Edges in one direction of the board, sampled.

    normal (E, 2): towards the white side. distance, grey (E, M): samples, px along the normal and
    grey levels. marker (E,): px from the edge to the marker, infinite on a checkerboard.
    """

    normal: Floats
    distance: Floats
    grey: Floats
    marker: Floats


@dataclass(frozen=True)
class _Profiles:
    """What was fitted to each edge: normal (E, 2), width (E,) px, black and white (E,)."""

    normal: Floats
    width: Floats
    black: Floats
    white: Floats


def blur_covariance(
    grey: Grey, pixels: Floats, ids: NDArray[np.intp], steps: Floats, board: Board
) -> Floats | None:
    """The blur's covariance (2, 2), px^2, the pixel's own width included.

    pixels (N, 2): corners, px. steps (N, 2, 2): px per square, as `find.steps` gives them. None
    where fewer than four edges in either direction can be measured.
    """
    sets = [_fit(_edges(grey, pixels, ids, steps, board, axis)) for axis in (0, 1)]
    if min(len(profiles.width) for profiles in sets) < FEWEST:
        return None
    rows = [_products(p.normal, p.normal) / p.width[:, None] ** 2 for p in sets]
    values = [np.ones(len(p.width)) for p in sets]
    w1, w2 = (float(np.median(p.width)) for p in sets)
    black = np.median(np.concatenate([p.black for p in sets]))
    white = np.median(np.concatenate([p.white for p in sets]))
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


def _correlation(shifts: Floats, falling: NDArray[np.bool_]) -> float:
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
    maps = pixels.astype(np.float32)
    values = cv2.remap(
        grey.astype(np.float32),
        maps[:, :1],
        maps[:, 1:],
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(values, np.float64).ravel()


def _edges(
    grey: Grey,
    pixels: Floats,
    ids: NDArray[np.intp],
    steps: Floats,
    board: Board,
    axis: int,
) -> _Edges:
    """Samples of the edges between neighbours along the board's x (axis 0) or y (axis 1).

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
    return _Edges(normal, distance, levels, marker[inside])


def _marker_and_reach(square: Floats, board: Board) -> tuple[Floats, Floats]:
    """Distance of the markers from edges, and how far to sample, px, for squares this wide, px."""
    reach = np.minimum(REACH * square, REACH_PX)
    if board.marker_m is None:
        return np.full(len(square), np.inf), reach
    share = board.marker_m / board.square_m
    gap = 0.5 * (1.0 - share)
    cell = share / len(board.markers[0][2])
    return gap * square, np.minimum(reach, (gap + REACH_CELLS * cell) * square)


def _fit(edges: _Edges) -> _Profiles:
    """Width of each edge: black + contrast (Phi(z) - Phi(z - marker / width)), z = (d - m) / width.

    Levenberg-Marquardt with fixed damping on all edges at once.
    """
    if len(edges.grey) == 0:
        return _Profiles(edges.normal, *np.empty((3, 0)))
    bright = edges.distance > 0
    black = np.average(edges.grey, axis=1, weights=~bright)
    white = np.average(edges.grey, axis=1, weights=bright)
    zero = np.zeros_like(black)
    p = np.stack([black, white - black, zero, zero + np.log(FIRST_PX)])
    for _ in range(FIT_STEPS):
        model, J = _profile(edges, *p)
        normal = np.einsum("iem,jem->eij", J, J)
        normal += DAMPING * normal * np.eye(4) + 1e-9 * np.eye(4)
        step = np.linalg.solve(normal, np.einsum("iem,em->ei", J, edges.grey - model)[..., None])
        step = step[..., 0].T
        step[2:] = np.clip(step[2:], -LONGEST_STEP, LONGEST_STEP)
        p = p + step
        p[3] = np.clip(p[3], *np.log(WIDTHS_PX))
    black, contrast, offset, width = *p[:3], np.exp(p[3])
    good = (width > 1.01 * WIDTHS_PX[0]) & (width < 0.99 * WIDTHS_PX[1])
    good &= (np.abs(contrast) > LEAST_CONTRAST) & (np.abs(offset) < 1.0 + width)
    return _Profiles(edges.normal[good], width[good], black[good], (black + contrast)[good])


def _profile(
    edges: _Edges, black: Floats, contrast: Floats, offset: Floats, log_width: Floats
) -> tuple[Floats, Floats]:
    """The model (E, M) and its derivatives by the four parameters (4, E, M)."""
    width = np.exp(log_width)[:, None]
    z = (edges.distance - offset[:, None]) / width
    up, bump = ndtr(z), np.exp(-0.5 * z * z) / np.sqrt(2 * np.pi)
    zbump = z * bump
    if np.isfinite(edges.marker).all():
        y = z - edges.marker[:, None] / width
        fall = np.exp(-0.5 * y * y) / np.sqrt(2 * np.pi)
        up, bump, zbump = up - ndtr(y), bump - fall, zbump - y * fall
    c = contrast[:, None]
    return black[:, None] + c * up, np.stack([np.ones_like(up), up, -c * bump / width, -c * zbump])
