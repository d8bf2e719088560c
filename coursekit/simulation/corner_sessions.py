"""Calibration sessions at corner level: what a detector would report, without rendering an image.

A session takes milliseconds, so statistics over hundreds of them are affordable. Each effect that
spoils a calibration is in here with its physics: the board's shape in metres, the focal length of
each view, and for a rolling shutter the row at which each corner is really seen.
"""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import Floats, NDArray
from coursekit.boards import Board, Detection, Detections
from coursekit.geometry import Intrinsics, deproject, fold_radius, project, transform_points

BORDER_PX = 6.0  # a corner nearer to the image's border has no room for its refinement window
PARTIAL_SHARE = 0.4  # a ChArUco view shows at least this share of the corners
SHARP_BLUR_PX = 0.63  # std of the blur that `detect` measures in sharp rendered images
BLUR_SCATTER = 0.08  # relative error of a blur variance; measured, as the two others are
BLUR_NOISE_GAIN = 0.15  # growth of the corner variance per unit of relative blur variance
SLIDES, TRIES = 21, 60  # from the target to the middle of the image; poses before giving up
ROW_STEPS, ROW_TOLERANCE_PX = 50, 1e-9


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

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            signed = field.name == "bow_m"
            if not np.isfinite(value) or (value < 0 and not signed):
                raise ValueError(f"{field.name}: got {value!r}, want a finite number, 0 or more")
        if not self.max_tilt_deg <= 60:
            raise ValueError(f"max_tilt_deg: got {self.max_tilt_deg}, want at most 60")
        if not self.inner_only <= 0.3:
            raise ValueError(f"inner_only: got {self.inner_only}, want a share of at most 0.3")
        if not self.blur_share <= 1:
            raise ValueError(f"blur_share: got {self.blur_share}, want a share of at most 1")
        if not self.square_scale > 0:
            raise ValueError(f"square_scale: got {self.square_scale}, want a positive number")


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulated session really was.

    lens: the camera; T_camera_board (n, 4, 4): the poses, at mid readout, m; effects as asked for.
    focal_scale (n,): of each view. velocity_m_s (n, 3): of the board in the camera's frame.
    blurred: the indices of the views with motion blur. spoiled_view: an index, or None.
    bad_corners: (view, corner id) of each. depth_m: the true Z of each corner, m, (N_i,) a view.
    """

    lens: Intrinsics
    T_camera_board: Floats
    effects: Effects
    focal_scale: Floats
    velocity_m_s: Floats
    blurred: tuple[int, ...]
    spoiled_view: int | None
    bad_corners: tuple[tuple[int, int], ...]
    depth_m: tuple[Floats, ...]


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
    """
    if views < 1:
        raise ValueError(f"views: got {views!r}, want at least 1")
    if not (np.isfinite(noise_px) and noise_px >= 0):
        raise ValueError(f"noise_px: got {noise_px!r}, want a finite number, 0 or more")
    effects = effects or Effects()
    # One stream of random numbers for the poses and one for the rest: a session with an effect
    # then has the poses and the noise of the healthy session with the same seed.
    poses = view_poses(board, lens, np.random.default_rng([seed, 0]), views, effects)
    rng = np.random.default_rng([seed, 1])
    draw = _Draw(rng, views, effects)
    seen = [
        _see(board, lens, poses[i], effects, draw.focal_scale[i], draw.velocity_m_s[i])
        for i in range(views)
    ]
    wrong = _wrong_corners(rng, seen, effects)
    detections = []
    for i, (ids, pixels, _) in enumerate(seen):
        blur = SHARP_BLUR_PX**2 * np.eye(2)
        if i in draw.blurred:
            blur = blur + effects.blur_px**2 / 12 * np.outer(draw.along[i], draw.along[i])
        noise = _corner_noise(rng, len(ids), noise_px * draw.noise_scale[i], blur)
        wild = _errors(rng, i, ids, draw, wrong, effects)
        detections.append(
            Detection(
                ids=ids,
                pixels=pixels + noise + wild,
                size=lens.size,
                name=f"view {i:02d}",
                noise_px=noise_px * draw.noise_scale[i],
                blur=_measured_blur(rng, blur),
            )
        )
    truth = Truth(
        lens, poses, effects, draw.focal_scale, draw.velocity_m_s, draw.blurred,
        draw.spoiled_view, tuple(wrong), tuple(depth for _, _, depth in seen),
    )  # fmt: skip
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
    poses = []
    for azimuth, cell in zip(azimuths, cells, strict=True):
        aim = (np.array([cell % columns, cell // columns]) + rng.random(2)) / [columns, rows]
        target = aim * np.array(lens.size) - 0.5
        poses.append(_pose_in_view(board, lens, rng, azimuth, target, effects))
    return np.stack(poses)


def _pose_in_view(
    board: Board,
    lens: Intrinsics,
    rng: np.random.Generator,
    azimuth: float,
    target: Floats,
    effects: Effects,
) -> Floats:
    middle = np.array([(lens.width - 1) / 2, (lens.height - 1) / 2])
    centre = board.points.mean(axis=0)
    shares = np.linspace(1.0, 0.0, SLIDES)[:, None]
    aims = middle + shares * (target - middle)
    rays = deproject(aims, np.ones(SLIDES), lens.K, lens.dist)
    for _ in range(TRIES):
        tilt = np.radians(effects.max_tilt_deg) * np.sqrt(rng.random())
        axis = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        roll = rng.uniform(-np.pi / 4, np.pi / 4)
        rotation = Rotation.from_rotvec(tilt * axis) * Rotation.from_euler("z", roll)
        T = np.eye(4)
        T[:3, :3] = rotation.as_matrix()
        for offset in rng.uniform(0.3, 0.8) * rays - T[:3, :3] @ centre:
            T[:3, 3] = offset
            if _enough_in_view(board, lens, T, effects.inner_only):
                return T
    raise ValueError(
        f"board: {board.size_m[0]:.3f} x {board.size_m[1]:.3f} m does not fit the "
        f"{lens.width}x{lens.height} image at 0.3 to 0.8 m"
    )


def _enough_in_view(board: Board, lens: Intrinsics, T: Floats, inner_only: float) -> bool:
    if inner_only:
        return bool(_visible(board.points, lens, T, inner_only).all())
    if board.kind == "checkerboard":
        ring = board.square_m * np.array([1.0, 1.0, 0.0])
        low, high = board.points.min(axis=0) - ring, board.points.max(axis=0) + ring
        outline = np.array([[x, y, 0.0] for x in (low[0], high[0]) for y in (low[1], high[1])])
        everything = np.concatenate([board.points, outline])
        return bool(_visible(everything, lens, T).all())
    seen = _visible(board.points, lens, T)
    return bool(seen.sum() >= max(PARTIAL_SHARE * len(seen), 12))


def _visible(
    points: Floats, lens: Intrinsics, T: Floats, inner_only: float = 0.0
) -> NDArray[np.bool_]:
    """Whether each board point is in the image, BORDER_PX from its border."""
    margin = np.maximum(BORDER_PX, inner_only * np.array(lens.size))
    inside = points @ T[:3, :3].T + T[:3, 3]
    pixels = project(inside, lens.K, lens.dist)
    last = np.array(lens.size) - 1 - margin
    seen = np.asarray(((pixels >= margin) & (pixels <= last)).all(axis=-1))
    if lens.dist is not None:
        # Beyond its fold a distortion brings points back into the image, but not to their ray.
        seen &= np.hypot(*(inside[:, :2] / inside[:, 2:]).T) < fold_radius(lens.dist)
    return seen


# --- what is seen of them ---


class _Draw:
    """The random numbers of a session's effects, all drawn whether an effect is on or not."""

    def __init__(self, rng: np.random.Generator, views: int, effects: Effects) -> None:
        self.focal_scale = 1 + effects.focus_drift * rng.uniform(-1, 1, views)
        direction = rng.normal(size=(views, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        self.velocity_m_s = effects.speed_m_s * direction
        angle = rng.uniform(0, np.pi, views)
        self.along = np.column_stack([np.cos(angle), np.sin(angle)])
        order = rng.permutation(views)
        count = round(effects.blur_share * views) if effects.blur_px else 0
        self.blurred = tuple(sorted(order[:count].tolist()))
        self.noise_scale = np.exp(effects.noise_spread * rng.normal(size=views))
        chosen = int(rng.integers(views))
        self.spoiled_view = chosen if effects.spoiled_px else None


def _see(
    board: Board, lens: Intrinsics, T: Floats, effects: Effects, scale: float, velocity: Floats
) -> tuple[NDArray[np.int64], Floats, Floats]:
    """The ids of the corners in the image, their pixels (N, 2) without noise, and their Z (N,)."""
    ids = np.flatnonzero(_visible(board.points, lens, T, effects.inner_only))
    on_board = bowed(board, effects.bow_m)[ids] * effects.square_scale
    points = transform_points(T, on_board)
    K = lens.K
    K[[0, 1], [0, 1]] *= scale
    pixels = rolling_shutter(points, velocity, effects.readout_s, lens.height, K, lens.dist)
    return ids, pixels, points[:, 2]


def bowed(board: Board, bow_m: float) -> Floats:
    """The board's corners (N, 3), m, on a paraboloid.

    The middle stands out by bow_m towards the viewer (z points into the board) and the
    outermost corners stay where they were.
    """
    points = board.points.copy()
    away = points[:, :2] - points[:, :2].mean(axis=0)
    share = (away**2).sum(axis=1)
    points[:, 2] -= bow_m * (1 - share / share.max())
    return points


def rolling_shutter(
    points: Floats, velocity: Floats, readout_s: float, rows: int, K: Floats, dist: Floats | None
) -> Floats:
    """Pixels (N, 2) of moving points, each at the time at which its row is read.

    points (N, 3): at mid readout, camera frame, m. velocity (3,): m/s. readout_s: from the first
    to the last of `rows`. The row depends on where the point is and that on the row: solved by
    iteration, which contracts as long as the image moves less than a row in a row's time.
    Raises ValueError when it does not.
    """
    pixels = project(points, K, dist)
    if readout_s == 0 or not np.any(velocity):
        return pixels
    for _ in range(ROW_STEPS):
        time = ((pixels[:, 1] + 0.5) / rows - 0.5) * readout_s
        moved = project(points + time[:, None] * velocity, K, dist)
        change = np.abs(moved - pixels).max(initial=0.0)
        pixels = moved
        if change < ROW_TOLERANCE_PX:
            return pixels
    raise ValueError(
        f"velocity: {np.linalg.norm(velocity):g} m/s over {readout_s:g} s moves the image as fast "
        "as the shutter runs; the row of a corner has no answer"
    )


# --- what the detector makes of it ---


def _corner_noise(rng: np.random.Generator, count: int, noise_px: float, blur: Floats) -> Floats:
    """Corner errors (N, 2), px: blur flattens the edges across its direction and adds noise."""
    sharp = SHARP_BLUR_PX**2 * np.eye(2)
    growth = np.eye(2) + BLUR_NOISE_GAIN * (blur - sharp) / SHARP_BLUR_PX**2
    return noise_px * rng.normal(size=(count, 2)) @ np.linalg.cholesky(growth).T


def _measured_blur(rng: np.random.Generator, blur: Floats) -> Floats:
    """The covariance (2, 2), px^2, that a detector measures where `blur` is true."""
    root = np.linalg.cholesky(blur)
    noise = rng.normal(size=(2, 2)) * BLUR_SCATTER
    return root @ (np.eye(2) + (noise + noise.T) / 2) @ root.T


def _wrong_corners(
    rng: np.random.Generator,
    seen: list[tuple[NDArray[np.int64], Floats, Floats]],
    effects: Effects,
) -> list[tuple[int, int]]:
    """(view, corner id) of the single bad corners, in different views as far as they go round."""
    order = np.resize(rng.permutation(len(seen)), effects.bad_corners)
    return [(int(view), int(rng.choice(seen[view][0]))) for view in order]


def _errors(
    rng: np.random.Generator,
    view: int,
    ids: NDArray[np.int64],
    draw: _Draw,
    wrong: list[tuple[int, int]],
    effects: Effects,
) -> Floats:
    """Gross errors (N, 2), px: the spoiled view's and the bad corners'."""
    angle = rng.uniform(0, 2 * np.pi, len(ids))
    direction = np.column_stack([np.cos(angle), np.sin(angle)])
    size = np.zeros(len(ids))
    if view == draw.spoiled_view:
        size += effects.spoiled_px
    size[np.isin(ids, [corner for at, corner in wrong if at == view])] = effects.bad_corner_px
    return size[:, None] * direction
