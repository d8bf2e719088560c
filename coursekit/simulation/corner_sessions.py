"""Calibration sessions at corner level: what a detector would report, without rendering an image.

A session takes milliseconds, so statistics over hundreds of them are affordable. Each effect that
spoils a calibration is in here with its physics: the board's shape in metres, the focal length of
each view, and for a rolling shutter the row at which each corner is really seen. What no session of
the street is without, and what is no mistake, is in here too: see `ordinary`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import Bools, Floats, Integers
from coursekit.boards import Board, Detection, Detections
from coursekit.boards.board import BORDER_PX, seen, slide_into_view
from coursekit.checks import number, positive, whole
from coursekit.geometry import Intrinsics, project, transform_points
from coursekit.words import say

PARTIAL_SHARE = 0.4  # a ChArUco view shows at least this share of the corners
SHARP_BLUR_PX = 0.63  # std of the blur that `detect` measures in sharp rendered images
BLUR_SCATTER = 0.08  # relative error of a blur variance; measured, as the two others are
BLUR_NOISE_GAIN = 0.15  # growth of the corner variance per unit of relative blur variance
POSES_TRIED = 60  # for each view, before giving up
NEAREST_M, FARTHEST_M = 0.3, 0.8
ROW_STEPS, ROW_TOLERANCE_PX = 50, 1e-9
WIDEST_RAD = np.radians(80)  # from the axis, where a fisheye is still looked through
WAVES = 32  # that a random smooth field is made of
SHARED_SQUARES = 2.0  # errors of corners that are farther apart than this have little in common


@dataclass(frozen=True)
class Effects:
    """What is wrong with a session. The defaults are a healthy one.

    bow_m: how much the board's middle stands out towards the camera over its outermost corners, m,
    the shape being a paraboloid. focus_drift: each view's focal length is off by up to this share.
    readout_s and speed_m_s: a rolling shutter reads the image in that time, first row first, while
    the board moves in a direction of its own in each view. max_tilt_deg: no view is tilted more.
    inner_only: no corner within this share of the width and height of an image border. blur_px:
    the length of the motion blur in `blur_share` of the views. spoiled_px: every corner of one
    view is off by this much, each in a direction of its own. bad_corners: so many single corners,
    in different views, are off by bad_corner_px. square_scale: real size of a square over the size
    that the board claims. noise_spread: relative std of the corner noise from view to view.

    Of an ordinary session: wave_m, wave_reach: rms height of the paper's irregular waves over the
    best plane, m, and how far a wave reaches, in diagonals of the pattern. print_error: std of the
    relative error of the print's width and of its height, each on its own, and of its right angles.
    shared: std of errors that neighbouring corners of a view share, over the noise. corner_spread:
    as noise_spread, from corner to corner of a view, which makes the noise's tails heavy. shake_px:
    std of the length of the motion blur in every view. claimed: what the detector says of its
    noise, over what it is. see: how a lens that five coefficients do not describe makes pixels
    (N, 2) of points (N, 3) in its frame; the image must grow all the way to its corners, which is
    not checked.
    """

    bow_m: float = 0.0
    focus_drift: float = 0.0
    readout_s: float = 0.0
    speed_m_s: float = 0.0
    max_tilt_deg: float = 45.0
    inner_only: float = 0.0
    blur_px: float = 0.0
    blur_share: float = 1 / 3
    spoiled_px: float = 0.0
    bad_corners: int = 0
    bad_corner_px: float = 3.0
    square_scale: float = 1.0
    noise_spread: float = 0.0
    wave_m: float = 0.0
    wave_reach: float = 0.3
    print_error: float = 0.0
    shared: float = 0.0
    corner_spread: float = 0.0
    shake_px: float = 0.0
    claimed: float = 1.0
    see: Callable[[Floats, Intrinsics], Floats] | None = None

    def __post_init__(self) -> None:
        most = {"max_tilt_deg": 60.0, "inner_only": 0.3, "blur_share": 1.0}
        for name in (field.name for field in fields(self) if field.type in ("float", "int")):
            least, highest = -np.inf if name == "bow_m" else 0.0, most.get(name, np.inf)
            wanted = f"a finite number from {least:g} to {highest:g}"
            number(name, getattr(self, name), wanted, least=least, most=highest)
        positive("square_scale", self.square_scale)
        positive("wave_reach", self.wave_reach)


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulated session really was.

    T_camera_board (n, 4, 4): the poses, at mid readout, m. draw: what its effects made of each
    view. bad_corners: (view, corner id) of each. depth_m: the true Z of each corner, m, (N_i,) a
    view. points (N, 3): where the board's corners really are in its own frame, m.
    """

    T_camera_board: Floats
    draw: Drawn
    bad_corners: tuple[tuple[int, int], ...]
    depth_m: tuple[Floats, ...]
    points: Floats


def ordinary(seed: int) -> Effects:
    """What a session of the street has without any mistake, its sizes drawn by the seed.

    **Assumed**, around what a fit with a free place for each corner finds in six real sets of
    tests/real: paper 0.05 to 0.5 mm rms from its plane (real: 0.11 and 0.35 mm, and rough: a wave
    reaches a square or two), printed some tenths of a per cent too wide, high or oblique (0.02 to
    0.64 %), corners whose noise differs from view to view (by 18 to 34 %) and of which neighbours
    share a part (correlation 0.08 to 0.42), of which the detector may state a thirtieth (real
    photographs; of JPEGs as tests/test_board_images.py makes them a quarter to the whole). A lens
    that breathes 0.03 % and a board held so still that it moves less than 0.1 mm while an image is
    read: nobody could call that a fault.

    >>> ordinary(1).bow_m, 5e-5 <= ordinary(1).wave_m <= 5e-4
    (0.0, True)
    """
    rng = np.random.default_rng([seed, 3])

    def between(least: float, most: float) -> float:
        return float(np.exp(rng.uniform(np.log(least), np.log(most))))

    return Effects(
        focus_drift=3e-4,
        readout_s=0.02,
        speed_m_s=0.003,
        noise_spread=between(0.1, 0.4),
        wave_m=between(5e-5, 5e-4),
        wave_reach=between(0.08, 0.6),
        print_error=between(2e-4, 4e-3),
        shared=between(0.3, 1.5),
        corner_spread=between(0.05, 0.3),
        shake_px=between(0.1, 0.8),
        claimed=between(0.03, 1.0),
    )


def corner_session(
    board: Board,
    lens: Intrinsics,
    seed: int,
    views: int = 28,
    noise_px: float = 0.08,
    effects: Effects | None = None,
) -> tuple[Detections, Truth]:
    """A session's detections and the truth behind them.

    The views lie 0.3 to 0.8 m away, tilted up to `max_tilt_deg` about axes all around, and spread
    over the image; a checkerboard is always seen whole, a ChArUco board may be cut by the border.
    noise_px: std of one coordinate of a corner. The same arguments give the same bytes.
    Raises ValueError for bad arguments and when the board does not fit the image at any distance.

    >>> lens = Intrinsics(640, 480, 600.0, 600.0, 319.5, 239.5)
    >>> board = Board("charuco", (9, 6), 0.025)
    >>> detections, truth = corner_session(board, lens, 1, views=3, effects=Effects(bow_m=1e-3))
    >>> len(detections), truth.T_camera_board.shape
    (3, (3, 4, 4))
    """
    whole("views", views)
    number("noise_px", noise_px, "a finite number, 0 or more", least=0.0)
    effects = effects or Effects()
    # One stream of random numbers for the poses and one for the rest: a session with an effect
    # then has the poses and the noise of the healthy session with the same seed.
    poses = view_poses(board, lens, np.random.default_rng([seed, 0]), views, effects)
    rng = np.random.default_rng([seed, 1])
    draw = Drawn(rng, views, effects)
    street = np.random.default_rng([seed, 2])  # drawn after and apart: the rest stays as it is
    points = printed(board, effects, street)
    looks = [_look(board, points, lens, poses[i], draw, i) for i in range(views)]
    # single bad corners, in different views as far as they go round
    order = np.resize(rng.permutation(views), effects.bad_corners).tolist()
    wrong = tuple((view, int(rng.choice(looks[view][0]))) for view in order)
    detections = []
    for i, (ids, pixels, _) in enumerate(looks):
        blur = SHARP_BLUR_PX**2 * np.eye(2)
        if i in draw.blurred:
            blur = blur + effects.blur_px**2 / 12 * np.outer(draw.along[i], draw.along[i])
        shaken = effects.shake_px * street.normal() * draw.along[i]
        blur = blur + np.outer(shaken, shaken) / 12
        sigma_px = noise_px * draw.noise_scale[i]
        noise = corner_errors(board, ids, sigma_px, effects, (rng, street), blur)
        spoiled = effects.spoiled_px * (i == draw.spoiled_view)
        bad = np.isin(ids, [corner for view, corner in wrong if view == i])
        far_px = np.where(bad, effects.bad_corner_px, spoiled)
        wild = _directions(rng, ids.size, 2 * np.pi) * far_px[:, None]
        measured = _measured_blur(rng, blur)
        found = pixels + noise + wild
        said_px = effects.claimed * sigma_px
        detections.append(Detection(ids, found, lens.size, f"view {i:02d}", said_px, measured))
    truth = Truth(poses, draw, wrong, tuple(Z for _, _, Z in looks), points)
    return Detections(detections), truth


# --- where the views are ---


def view_poses(
    board: Board, lens: Intrinsics, rng: np.random.Generator, views: int, effects: Effects
) -> Floats:
    """Poses (n, 4, 4), m, of a careful session: tilts all around, corners into the image corners.

    Each view aims at a cell of the image of its own and is slid towards the centre until enough of
    the board is seen. ValueError when the board fits at no distance.
    """
    azimuths = rng.permutation(views) / views * 2 * np.pi
    columns, rows = 4, 3
    cells = np.resize(rng.permutation(columns * rows), views)
    aimed = _as_pinhole(lens, effects) if effects.see else lens
    enough = partial(_enough, board, lens, effects=effects)
    poses: list[Floats] = []
    for azimuth, cell in zip(azimuths, cells, strict=True):
        axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        aim = (np.array([cell % columns, cell // columns]) + rng.random(2)) / [columns, rows]
        target, T = aim * np.array(lens.size) - 0.5, None
        for _ in range(POSES_TRIED):
            tilt = np.radians(effects.max_tilt_deg) * np.sqrt(rng.random())
            roll = Rotation.from_euler("z", rng.uniform(-np.pi / 4, np.pi / 4))
            R = (Rotation.from_rotvec(tilt * axis) * roll).as_matrix()
            distance_m = rng.uniform(NEAREST_M, FARTHEST_M)
            T = slide_into_view(target, distance_m, R, board.middle, aimed, enough)
            if T is not None:
                break
        if T is None:
            facts = {"board": board, "lens": lens, "near": NEAREST_M, "far": FARTHEST_M}
            raise ValueError(say("simulation.board_too_large", **facts))
        poses.append(T)
    return np.stack(poses)


def _as_pinhole(lens: Intrinsics, effects: Effects) -> Intrinsics:
    """A pinhole camera that sees as far to the side as a lens beyond the five coefficients."""
    slopes = np.tan(np.linspace(0.01, WIDEST_RAD, 400))
    seen_at = _through(lens, effects)(slopes[:, None] * [1.0, 0.0, 0.0] + [0.0, 0.0, 1.0])
    reach_px = np.hypot(*lens.size) / 2
    across = np.maximum.accumulate(seen_at[:, 0] - lens.cx)
    slope = slopes[min(np.searchsorted(across, reach_px), len(slopes) - 1)]
    return replace(lens, fx=reach_px / slope, fy=reach_px / slope, model="none")


def _enough(board: Board, lens: Intrinsics, T: Floats, effects: Effects) -> bool:
    """Whether so much of the board is seen that it makes a view."""
    if effects.inner_only or board.kind == "charuco":
        visible = _visible(board.points, lens, T, effects)
        share = 1.0 if effects.inner_only else PARTIAL_SHARE
        return bool(visible.sum() >= max(share * len(visible), min(12, len(visible))))
    return bool(_visible(np.concatenate([board.points, board.outline]), lens, T, effects).all())


def _visible(points: Floats, lens: Intrinsics, T: Floats, effects: Effects) -> Bools:
    """Which points (N, 3) of the board are in the image, as far from its border as they must be.

    As `seen`, through the session's own lens.
    """
    border_px = np.maximum(BORDER_PX, effects.inner_only * np.array(lens.size))
    if effects.see is None:
        return seen(points, T, lens, border_px)
    inside = transform_points(T, points)
    pixels, last = _through(lens, effects)(inside), np.array(lens.size) - 1 - border_px
    return ((pixels >= border_px) & (pixels <= last)).all(axis=1) & (inside[:, 2] > 0)


# --- what is seen of them ---


class Drawn:
    """The random numbers of a session's effects, all drawn whether an effect is on or not.

    focal_scale (n,): of each view. velocity_m_s (n, 3): of the board in the camera's frame.
    along (n, 2): the direction of a motion blur. blurred: the indices of the views with one.
    noise_scale (n,): of the corners. spoiled_view: an index, or None.
    """

    def __init__(self, rng: np.random.Generator, views: int, effects: Effects) -> None:
        self.effects = effects
        self.focal_scale = 1 + effects.focus_drift * rng.uniform(-1, 1, views)
        direction = rng.normal(size=(views, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        self.velocity_m_s = effects.speed_m_s * direction
        self.along = _directions(rng, views, np.pi)
        order = rng.permutation(views)
        count = round(effects.blur_share * views) if effects.blur_px else 0
        self.blurred = tuple(sorted(order[:count].tolist()))
        self.noise_scale = np.exp(effects.noise_spread * rng.normal(size=views))
        chosen = int(rng.integers(views))
        self.spoiled_view = chosen if effects.spoiled_px else None


def _look(
    board: Board, shape: Floats, lens: Intrinsics, T: Floats, draw: Drawn, view: int
) -> tuple[Integers, Floats, Floats]:
    """The ids of the corners in the image, their pixels (N, 2) without noise, and their Z (N,)."""
    effects, scale, velocity = draw.effects, draw.focal_scale[view], draw.velocity_m_s[view]
    ids = np.flatnonzero(_visible(board.points, lens, T, effects))
    points = transform_points(T, shape[ids])
    see = _through(replace(lens, fx=lens.fx * scale, fy=lens.fy * scale), effects)
    return ids, rolling_shutter(points, velocity, effects.readout_s, lens.height, see), points[:, 2]


def _through(lens: Intrinsics, effects: Effects) -> Callable[[Floats], Floats]:
    """How points (N, 3) in front of the session's lens become pixels (N, 2)."""
    see = effects.see or (lambda points, lens: project(points, lens.K, lens.dist))
    return lambda points: see(points, lens)


def printed(board: Board, effects: Effects, rng: np.random.Generator) -> Floats:
    """Where the board's corners (N, 3), m, really are in its frame."""
    points = bowed(board, effects.bow_m) * effects.square_scale
    wide, high, oblique = effects.print_error * rng.normal(size=3)
    points[:, :2] @= np.array([[1 + wide, 0.0], [oblique, 1 + high]])
    across, down = board.points[:, :2].max(axis=0) - board.points[:, :2].min(axis=0)
    waves = smooth_waves(rng, effects.wave_reach * np.hypot(across, down))
    heights = wavy(board.points[:, :2], waves)
    plane = np.column_stack([board.points[:, :2], np.ones(len(points))])
    heights -= plane @ np.linalg.lstsq(plane, heights, rcond=None)[0]
    points[:, 2] += effects.wave_m * heights / np.sqrt(np.mean(heights**2))
    return points


def smooth_waves(rng: np.random.Generator, reach: float) -> Floats:
    """A random smooth field over the plane as waves (WAVES, 3): radians a unit in x and y, phase.

    Places farther apart than `reach` (of the plane's unit) have little in common: the correlation
    over a distance d is exp(-d^2 / 2 reach^2), as Rahimi and Recht's random features make it.
    """
    turns = rng.normal(size=(WAVES, 2)) / reach
    return np.column_stack([turns, rng.uniform(0, 2 * np.pi, WAVES)])


def wavy(places: Floats, waves: Floats) -> Floats:
    """The field (N,) of `smooth_waves` at places (N, 2); its variance is 1 on average."""
    return np.sqrt(2 / len(waves)) * np.cos(places @ waves[:, :2].T + waves[:, 2]).sum(axis=1)


def bowed(board: Board, bow_m: float) -> Floats:
    """The board's corners (N, 3), m, on a paraboloid.

    The middle stands out by bow_m towards the viewer (z points into the board) and the
    outermost corners stay where they were.

    >>> corners = bowed(Board("checkerboard", (4, 4), 0.02), 0.001)
    >>> corners[[0, 4], 2].tolist()  # an outermost one and the middle one
    [0.0, -0.001]
    """
    points = board.points.copy()
    away = points[:, :2] - board.middle[:2]
    share = (away**2).sum(axis=1)
    points[:, 2] -= bow_m * (1 - share / share.max())
    return points


def rolling_shutter(
    points: Floats, velocity: Floats, readout_s: float, rows: int, see: Callable[[Floats], Floats]
) -> Floats:
    """Pixels (N, 2) of moving points, each at the time at which its row is read.

    points (N, 3): at mid readout, camera frame, m. velocity (3,): m/s. readout_s: from the first
    to the last of `rows`. see: makes pixels of points that stand still. The row depends on where
    the point is and that on the row: solved by iteration, which contracts as long as the image
    moves less than a row in a row's time.
    Raises ValueError when it does not.
    """
    pixels = see(points)
    if readout_s == 0 or not np.any(velocity):
        return pixels
    for _ in range(ROW_STEPS):
        time = ((pixels[:, 1] + 0.5) / rows - 0.5) * readout_s
        moved = see(points + time[:, None] * velocity)
        change = np.abs(moved - pixels).max(initial=0.0)
        pixels = moved
        if change < ROW_TOLERANCE_PX:
            return pixels
    speed = np.linalg.norm(velocity)
    raise ValueError(say("simulation.as_fast_as_the_shutter", speed=speed, readout=readout_s))


# --- what the detector makes of it ---


def corner_errors(
    board: Board,
    ids: Integers,
    sigma_px: float,
    effects: Effects,
    rngs: tuple[np.random.Generator, np.random.Generator],
    blur: Floats | None = None,
) -> Floats:
    """Errors (N, 2) of a view's corners ids (N,), px: each one's own, and what neighbours share.

    sigma_px: std of one coordinate in a sharp image. effects: corner_spread and shared. rngs: for
    the noise and for these two. blur (2, 2): covariance, px^2, None for a sharp image: it flattens
    the edges across its direction and adds noise there.
    """
    rng, street = rngs
    noise = sigma_px * rng.normal(size=(len(ids), 2))
    if blur is not None:
        sharp = SHARP_BLUR_PX**2 * np.eye(2)
        growth = np.eye(2) + BLUR_NOISE_GAIN * (blur - sharp) / SHARP_BLUR_PX**2
        noise = noise @ np.linalg.cholesky(growth).T
    squares = np.column_stack(np.divmod(ids, board.corners[0]))
    shared = [wavy(squares, smooth_waves(street, SHARED_SQUARES)) for _ in range(2)]
    spread = np.exp(effects.corner_spread * street.normal(size=(len(ids), 1)))
    return noise * spread + effects.shared * sigma_px * np.column_stack(shared)


def _directions(rng: np.random.Generator, count: int, most: float) -> Floats:
    """Unit vectors (count, 2), each in a direction of its own, 0 to `most` rad from the x axis."""
    angle = rng.uniform(0, most, count)
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _measured_blur(rng: np.random.Generator, blur: Floats) -> Floats:
    """The covariance (2, 2), px^2, that a detector measures where `blur` is true."""
    root = np.linalg.cholesky(blur)
    noise = rng.normal(size=(2, 2)) * BLUR_SCATTER
    return root @ (np.eye(2) + (noise + noise.T) / 2) @ root.T
