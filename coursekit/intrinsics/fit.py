"""Fitting K and distortion to views of a board, with the covariance of what was fitted.

How far a fitted camera may be wrong about where a point is seen, in px over the image.

After mrcal (D. Kogan, "uncertainty of projection", the "mean-pcam" method): the covariance of
intrinsics *and* poses, propagated to a pixel. With `fixed="world"` the point is fixed to the
boards. Another set of corners would give another K and, with it, other poses; what of the change
is a mere motion of the camera's frame costs nothing and is compensated. Each board says where the
point is in the refitted camera's frame, p + omega_i x p + v_i, and the mean over the boards is
projected with the refitted intrinsics. With `fixed="camera"` the point stays where it is in the
camera's frame and only the intrinsics change: what a depth camera's user gets who trusts that
frame, and the larger of the two.

What both leave out: errors of the model (a bowed board, a distortion that the coefficients cannot
follow, rolling shutter), corner errors that are correlated or larger in some views, and everything
of second order. It is the least that the uncertainty can be.

Whether a calibration is good: what the views cover, how the boards are tilted, and a verdict.
"""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np

from coursekit.arrays import ArrayLike, Floats, NDArray
from coursekit.boards import Board, Detection
from coursekit.geometry import Intrinsics, deproject, make_transform
from coursekit.intrinsics.derivatives import (
    PARAMETERS,
    NormalEquations,
    project_with_derivatives,
    scaled_inverse,
    twist_columns,
)

Fixed = Literal["world", "camera"]

MODELS = {
    "none": (),
    "k1": ("k1",),
    "k1k2": ("k1", "k2"),
    "k1k2p1p2": ("k1", "k2", "p1", "p2"),
    "brown_conrady": ("k1", "k2", "p1", "p2", "k3"),
}
MIN_VIEWS = 3
MIN_CORNERS = 6
LEAST_FOCAL = 0.05  # of the image's width: a field of view of 170 deg, no pinhole camera
ITERATIONS = 1000  # nearly parallel boards need hundreds; OpenCV's own limit of 30 ends far away
ARRIVED_SIGMAS = 0.1  # no combination of parameters would move more in the next step,
ARRIVED_PX = 1e-4  # or no corner would (float32 corners: all that OpenCV's solver can do)
UNITS = dict.fromkeys(("f", "fx", "fy", "cx", "cy"), "px")


class CalibrationFailed(ValueError):
    """The solver found no finite camera for these views."""


@dataclass(frozen=True, eq=False, repr=False)
class IntrinsicsResult:
    """A fitted camera and what the data say about it.

    intrinsics: the estimate. names (p): the parameters that were estimated; "f" stands for
    fx = fy. T_camera_board (n, 4, 4): the pose of the board in each view. residuals: one
    (N_i, 2) a view, observed - predicted, px. equations: the Jacobian at the estimate, its poses
    perturbed from the left in the camera's frame (see `intrinsics.derivatives`). converged: whether
    another Gauss-Newton step would leave everything where it is, measured in its own sigma.
    points (N, 3): where the board's corners are taken to be, m. extra: what was estimated besides
    (the bow of a board); it widens every covariance and is not part of it.
    """

    intrinsics: Intrinsics
    model: str
    names: tuple[str, ...]
    T_camera_board: Floats
    residuals: tuple[Floats, ...]
    equations: NormalEquations
    converged: bool
    board: Board
    points: Floats
    detections: Sequence[Detection]
    extra: tuple[str, ...] = ()

    # --- how large the residuals are ---

    @cached_property
    def _all_residuals(self) -> Floats:
        return np.concatenate(self.residuals)

    @property
    def corners(self) -> int:
        """How many corners were used."""
        return len(self._all_residuals)

    @property
    def rms_px(self) -> float:
        """Root mean square length of the residual vectors, px: what OpenCV returns."""
        return _rms(self._all_residuals)

    @property
    def rms_u_px(self) -> float:
        """Root mean square residual along u, px."""
        return math.sqrt(float(np.mean(self._all_residuals[:, 0] ** 2)))

    @property
    def rms_v_px(self) -> float:
        """Root mean square residual along v, px."""
        return math.sqrt(float(np.mean(self._all_residuals[:, 1] ** 2)))

    @property
    def per_view_rms_px(self) -> Floats:
        """`rms_px` of each view, (n,)."""
        return np.array([_rms(r) for r in self.residuals])

    @property
    def dof(self) -> int:
        """Degrees of freedom: two a corner, less all parameters, those of the poses included."""
        return 2 * self.corners - self.equations.shared.shape[1] - 6 * len(self.residuals)

    @property
    def sigma_px(self) -> float:
        """Standard deviation of one corner coordinate, px, from the residuals and `dof`."""
        return math.sqrt(float(np.sum(self._all_residuals**2)) / self.dof)

    # --- what the parameters are known to ---

    @property
    def jacobian(self) -> tuple[Floats, tuple[Floats, ...]]:
        """d predicted pixels / d parameters (2N, p), and / d pose of view i (2 N_i, 6).

        Rows are u, v of each corner, view after view. Columns of a pose: (omega, v), rad and m,
        of T <- exp(omega, v) T in the camera's frame.
        """
        return self.equations.shared[:, : len(self.names)], tuple(self.equations.poses)

    @cached_property
    def covariance(self) -> Floats:
        """The covariance (p, p) of the parameters `names`, poses unknown; px^2 for K."""
        p = len(self.names)
        return self.sigma_px**2 * self.equations.shared_covariance[:p, :p]

    @cached_property
    def joint_covariance(self) -> Floats:
        """The covariance (p + 6n, p + 6n) of the parameters, then (omega, v) of each pose."""
        p, g = len(self.names), self.equations.shared.shape[1]
        keep = np.r_[:p, g : g + 6 * len(self.residuals)]
        return self.sigma_px**2 * self.equations.covariance()[np.ix_(keep, keep)]

    @property
    def correlation(self) -> Floats:
        """The correlations (p, p) of the parameters."""
        sigma = np.sqrt(np.diag(self.covariance))
        return self.covariance / np.outer(sigma, sigma)

    @property
    def selection(self) -> Floats:
        """(9, p): d (fx, fy, cx, cy, k1, k2, p1, p2, k3) / d the parameters `names`."""
        return _selection(self.names)

    def value(self, name: str) -> float:
        """The estimate of one of `names`."""
        return float(parameter_vector(self.intrinsics)[PARAMETERS.index(self._full_name(name))])

    def sigma(self, name: str) -> float:
        """The standard deviation of one of `names`, px for K."""
        row = self.selection[PARAMETERS.index(self._full_name(name))]
        return math.sqrt(float(row @ self.covariance @ row))

    def interval(self, name: str, level: float = 0.95) -> tuple[float, float]:
        """The interval that holds one of `names` with probability `level` (Student's t)."""
        half = self.quantile(level) * self.sigma(name)
        return self.value(name) - half, self.value(name) + half

    def quantile(self, level: float = 0.95) -> float:
        """How many sigmas an interval of probability `level` reaches to either side."""
        from scipy.stats import t

        if not 0 < level < 1:
            raise ValueError(f"level: got {level!r}, want a probability between 0 and 1")
        return float(t.ppf((1 + level) / 2, self.dof))

    def _full_name(self, name: str) -> str:
        estimated = {"fx": "f", "fy": "f"}.get(name, name) if "f" in self.names else name
        if estimated not in self.names:
            raise ValueError(f"name: got {name!r}, want one of {', '.join(self.names)}")
        return "fx" if name == "f" else name

    # --- what that means for a pixel ---

    def projection_covariance(
        self, pixels: ArrayLike, range_m: float, fixed: Literal["world", "camera"] = "world"
    ) -> Floats:
        """`uncertainty.projection_covariance` of this fit: (..., 2, 2), px^2."""

        return projection_covariance(self, pixels, range_m, fixed)

    def projection_sigma_px(
        self, pixels: ArrayLike, range_m: float, fixed: Literal["world", "camera"] = "world"
    ) -> Floats:
        """`uncertainty.projection_sigma_px` of this fit: (...), px, in the worst direction."""

        return projection_sigma_px(self, pixels, range_m, fixed)

    def uncertainty_map(
        self,
        range_m: float,
        shape: tuple[int, int] = (30, 40),
        fixed: Literal["world", "camera"] = "world",
    ) -> Floats:
        """`projection_sigma_px` over the image, (rows, columns), px."""

        return uncertainty_map(self, range_m, shape, fixed)

    @property
    def board_range_m(self) -> float:
        """The median distance of the boards from the camera, m."""
        seen = [
            np.linalg.norm(self.points[d.ids].mean(axis=0) @ T[:3, :3].T + T[:3, 3])
            for d, T in zip(self.detections, self.T_camera_board, strict=True)
        ]
        return float(np.median(seen))

    def verdict(self) -> str:
        """In words: is this calibration good, and if not, what it lacks."""

        return verdict(self)

    def __repr__(self) -> str:
        width, height = self.intrinsics.size
        lines = [
            f"{width}x{height} px, model {self.model}, {len(self.residuals)} views, "
            f"{self.corners} corners"
            + (", the board's bow fitted too" if self.extra else "")
            + ("" if self.converged else "; NOT CONVERGED")
        ]
        for name in self.names:
            value, half = self.value(name), self.quantile() * self.sigma(name)
            unit = UNITS.get(name, "")
            places = 2 if unit else 4
            number = f"{value:.{places}f} ± {half:.{places}f} {unit}".rstrip()
            lines.append(f"{'fx = fy' if name == 'f' else name} = {number} (95 %)")
        lines.append(
            f"residuals: rms {self.rms_px:.3f} px (2-D), {self.rms_u_px:.3f} along u, "
            f"{self.rms_v_px:.3f} along v"
        )
        sigmas = self.quantile() * self.uncertainty_map(self.board_range_m)
        lines.append(
            f"at {self.board_range_m:.2f} m a point is seen within ± {np.median(sigmas):.2f} px "
            f"(median of the image), ± {sigmas.max():.2f} px (worst)"
        )
        return "\n".join(lines)


def calibrate(
    detections: Sequence[Detection],
    board: Board,
    size: tuple[int, int] | None = None,
    model: str = "brown_conrady",
    same_focal: bool = False,
    guess: Intrinsics | None = None,
    points: ArrayLike | None = None,
) -> IntrinsicsResult:
    """The camera that explains detections of a board best, by OpenCV's `calibrateCameraExtended`.

    size: (width, height) of the images, px; None takes the detections'. model: which distortion
    coefficients are estimated, one of `MODELS`; the others are held at 0. same_focal: holds
    fx = fy. guess: where to start; None lets OpenCV find a start, and where that leads nowhere
    takes a focal length as long as the image is wide. points (N, 3): where the board's corners
    really are, m, in place of `board.points` (a measured or bowed board).
    One thread, so that a second run gives the same bits.
    Raises ValueError that names the view for fewer than 3 views, fewer than 6 corners or all of
    them on a line, corners that the board does not have, NaN, and images of another size; and
    CalibrationFailed where the solver finds no finite camera.
    """
    if model not in MODELS:
        raise ValueError(f"model: got {model!r}, want one of {', '.join(MODELS)}")
    corners = _board_points(board, points)
    size = _check_detections(detections, corners, size)
    names = (*(("f",) if same_focal else ("fx", "fy")), "cx", "cy", *MODELS[model])
    if guess is not None and guess.size != size:
        raise ValueError(f"guess: made for {guess.size} px, the images have {size}")
    # OpenCV's own start can lie at the far end of the valley in which focal length and distance
    # trade against each other, where its steps go nowhere; then once more from a plain camera.
    starts = [guess] if guess is not None else [None, _plain_camera(size)]
    fits: list[IntrinsicsResult] = []
    for start in starts:
        try:
            lens, poses = _solve(corners, detections, size, model, same_focal, start)
        except CalibrationFailed:
            if start is starts[-1] and not fits:
                raise
            continue
        fits.append(evaluate(lens, poses, detections, board, corners, names, model))
        if fits[-1].converged:
            break
    return min(fits, key=lambda fit: fit.rms_px)


def _plain_camera(size: tuple[int, int]) -> Intrinsics:
    """A focal length as long as the image is wide, the centre in the middle, no distortion."""
    width, height = size
    return Intrinsics(width, height, width, width, (width - 1) / 2, (height - 1) / 2)


def evaluate(
    intrinsics: Intrinsics,
    T_camera_board: Floats,
    detections: Sequence[Detection],
    board: Board,
    points: Floats,
    names: tuple[str, ...],
    model: str,
    extra: dict[str, Floats] | None = None,
) -> IntrinsicsResult:
    """Residuals and Jacobian of a camera and poses, as a result.

    T_camera_board (n, 4, 4). points (N, 3): the board's corners, m. names: what counts as
    estimated. extra: d points / d a further estimated quantity, (N, 3) by name.
    """
    extra = extra or {}
    ids = np.concatenate([d.ids for d in detections])
    counts = [len(d.ids) for d in detections]
    ends = np.cumsum(counts)[:-1]
    R = np.repeat(T_camera_board[:, :3, :3], counts, axis=0)
    at = np.einsum("nij,nj->ni", R, points[ids])
    at += np.repeat(T_camera_board[:, :3, 3], counts, axis=0)
    predicted, by_parameter, by_point = project_with_derivatives(at, intrinsics)
    residuals = np.concatenate([d.pixels for d in detections]) - predicted
    shared = [by_parameter @ _selection(names)]
    for by_extra in extra.values():
        moves = np.einsum("nij,nj->ni", R, by_extra[ids])
        shared.append(np.einsum("nij,nj->ni", by_point, moves)[..., None])
    poses = np.split(twist_columns(at, by_point), ends)
    equations = NormalEquations(
        shared=np.concatenate(shared, axis=-1).reshape(2 * len(ids), -1),
        poses=tuple(block.reshape(-1, 6) for block in poses),
        residuals=residuals.ravel(),
    )
    return IntrinsicsResult(
        intrinsics=intrinsics,
        model=model,
        names=names,
        T_camera_board=T_camera_board,
        residuals=tuple(np.split(residuals, ends)),
        equations=equations,
        converged=_arrived(equations),
        board=board,
        points=points,
        detections=detections,
        extra=tuple(extra),
    )


def parameter_vector(intrinsics: Intrinsics) -> Floats:
    """(fx, fy, cx, cy, k1, k2, p1, p2, k3), (9,)."""
    i = intrinsics
    return np.array([i.fx, i.fy, i.cx, i.cy, *i.coeffs])


def with_parameters(intrinsics: Intrinsics, parameters: Floats) -> Intrinsics:
    """The intrinsics with other (fx, fy, cx, cy, k1, k2, p1, p2, k3), (9,)."""
    fx, fy, cx, cy, *coeffs = parameters.tolist()
    model = "brown_conrady" if any(coeffs) else intrinsics.model
    return replace(intrinsics, fx=fx, fy=fy, cx=cx, cy=cy, model=model, coeffs=tuple(coeffs))


def p_text(p_value: float) -> str:
    """ "p = 0.03", and no more zeros than mean anything."""
    return f"p = {p_value:.2g}" if p_value >= 1e-6 else "p < 0.000001"


def _selection(names: tuple[str, ...]) -> Floats:
    matrix = np.zeros((9, len(names)))
    for column, name in enumerate(names):
        for full in ("fx", "fy") if name == "f" else (name,):
            matrix[PARAMETERS.index(full), column] = 1.0
    return matrix


def _arrived(equations: NormalEquations) -> bool:
    squares, decrease = float(equations.residuals @ equations.residuals), equations.decrease()
    dof = max(1, len(equations.residuals) - equations.shared.shape[1] - 6 * len(equations.poses))
    return bool(
        decrease < ARRIVED_SIGMAS**2 * squares / dof
        or decrease < ARRIVED_PX**2 * len(equations.residuals)
    )


def _rms(residuals: Floats) -> float:
    return math.sqrt(float(np.sum(residuals**2)) / len(residuals))


# --- OpenCV's solver ---


def _solve(
    corners: Floats,
    detections: Sequence[Detection],
    size: tuple[int, int],
    model: str,
    same_focal: bool,
    guess: Intrinsics | None,
) -> tuple[Intrinsics, Floats]:
    """The camera and T_camera_board (n, 4, 4) of the least squares; CalibrationFailed."""
    import cv2
    from scipy.spatial.transform import Rotation

    points = [corners[d.ids].astype(np.float32) for d in detections]
    pixels = [np.asarray(d.pixels, np.float32) for d in detections]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, ITERATIONS, np.finfo(float).eps)
    K0, dist0, flags = _start(points, pixels, size, same_focal, guess)
    flags |= _held(MODELS[model])
    try:
        with one_thread():
            _, K, dist, rotations, translations, *_ = cv2.calibrateCameraExtended(
                points, pixels, size, K0, dist0, flags=flags, criteria=criteria
            )
    except cv2.error as error:
        raise CalibrationFailed(f"detections: OpenCV's solver gave up ({error.err})") from error
    poses = np.stack([
        make_transform(Rotation.from_rotvec(r.ravel()), t.ravel())
        for r, t in zip(rotations, translations, strict=True)
    ])  # fmt: skip
    if not (np.isfinite(K).all() and np.isfinite(dist).all() and np.isfinite(poses).all()):
        raise CalibrationFailed("detections: the solver ran away to infinity; tilt the board more")
    if min(K[0, 0], K[1, 1]) < LEAST_FOCAL * size[0] or not _in_front(poses, points):
        raise CalibrationFailed(
            f"detections: the solver ended at a camera that cannot be (fx = {K[0, 0]:.3g}, fy = "
            f"{K[1, 1]:.3g} px, or a board behind it). Is this the board in the images? If it is, "
            "tilt it more, or give a guess"
        )
    kind = "brown_conrady" if MODELS[model] else "none"
    coeffs = tuple(np.ravel(dist)[:5].tolist())
    return Intrinsics(*size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], kind, coeffs), poses


def _start(
    points: list[NDArray[np.float32]],
    pixels: list[NDArray[np.float32]],
    size: tuple[int, int],
    same_focal: bool,
    guess: Intrinsics | None,
) -> tuple[Floats, Floats, int]:
    """K, dist and flags with which OpenCV's solver starts."""
    import cv2

    flags = cv2.CALIB_FIX_ASPECT_RATIO if same_focal else 0
    if guess is not None:
        K = guess.K
        if same_focal:  # the ratio that OpenCV holds is that of the guess
            K[0, 0] = K[1, 1] = (K[0, 0] + K[1, 1]) / 2
        return K, np.array(guess.coeffs), flags | cv2.CALIB_USE_INTRINSIC_GUESS
    if any(p[:, 2].any() for p in points):  # OpenCV finds a start for flat boards only
        flat = [p * np.array([1, 1, 0], np.float32) for p in points]
        K = np.asarray(cv2.initCameraMatrix2D(flat, pixels, size, 1.0 if same_focal else 0.0))
        return K, np.zeros(5), flags | cv2.CALIB_USE_INTRINSIC_GUESS
    return np.eye(3), np.zeros(5), flags


def _held(estimated: tuple[str, ...]) -> int:
    """OpenCV's flags that hold at 0 the coefficients that are not estimated."""
    import cv2

    flags = 0
    for name in ("k1", "k2", "k3"):
        if name not in estimated:
            flags |= getattr(cv2, f"CALIB_FIX_{name.upper()}")
    return flags if "p1" in estimated else flags | cv2.CALIB_ZERO_TANGENT_DIST


@contextmanager
def one_thread() -> Iterator[None]:
    """OpenCV on one thread: on two, sums are added in an order that changes from run to run."""
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _in_front(poses: Floats, points: list[NDArray[np.float32]]) -> bool:
    return all((p @ T[2, :3] + T[2, 3] > 0).all() for T, p in zip(poses, points, strict=True))


# --- what is wrong with the input ---


def _board_points(board: Board, points: ArrayLike | None) -> Floats:
    corners = np.asarray(board.points if points is None else points, float)
    if corners.shape != board.points.shape or not np.isfinite(corners).all():
        raise ValueError(
            f"points: got shape {corners.shape}, want finite {board.points.shape}, one a corner"
        )
    return corners


def _check_detections(
    detections: Sequence[Detection], points: Floats, size: tuple[int, int] | None
) -> tuple[int, int]:
    """The images' size, or the ValueError that names the view which cannot be used."""
    if len(detections) < MIN_VIEWS:
        skipped = getattr(detections, "skipped", ())
        raise ValueError(
            f"detections: got {len(detections)} views, want at least {MIN_VIEWS}"
            + (f"; {len(skipped)} not used, the first: {skipped[0]!r}" if skipped else "")
        )
    width, height = detections[0].size if size is None else size
    for index, detection in enumerate(detections):
        trouble = next(_troubles(detection, points, (width, height)), "")
        if trouble:
            name = f" ({detection.name})" if detection.name else ""
            raise ValueError(f"detections: view {index}{name} {trouble}")
    spare = 2 * sum(len(d.ids) for d in detections) - 9 - 6 * len(detections)
    if spare < 1:
        raise ValueError("detections: fewer corner coordinates than parameters; take more views")
    return width, height


def _troubles(detection: Detection, points: Floats, size: tuple[int, int]) -> Iterator[str]:
    """What is wrong with one view, the first thing first; later checks rely on earlier ones."""
    ids, pixels = detection.ids, detection.pixels
    if detection.size != size:
        yield f"is {detection.size} px, not {size}: calibrate each size on its own"
    if len(ids) < MIN_CORNERS:
        yield f"has {len(ids)} corners, want at least {MIN_CORNERS}"
    if not np.isfinite(pixels).all():
        yield "has corners that are not finite"
    if ids.min() < 0 or ids.max() >= len(points):
        yield f"has corner {ids.max()}, the board has 0 to {len(points) - 1}: another board?"
    if len(np.unique(ids)) < len(ids):
        yield "has the same corner twice"
    spread = np.linalg.svd(points[ids, :2] - points[ids, :2].mean(axis=0), compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        yield "has all its corners on one line, which fixes no pose"


@dataclass(frozen=True, eq=False)
class Information:
    """What n views know of the shared parameters and of the mean motion of their boards.

    shared (g, g): the Schur complement of the shared parameters. response (6, g): the sum of the
    poses' responses, poses (6, 6): the sum of their own covariances, at corner noise 1 px. The
    mean motion is (noise - response d) / n. Sums, so that a view is added without a refit.
    """

    shared: Floats
    response: Floats
    poses: Floats
    views: int

    @classmethod
    def of(cls, equations: NormalEquations) -> Information:
        """The information in views."""
        return cls(
            equations.information,
            equations.responses.sum(axis=0),
            equations.pose_covariances.sum(axis=0),
            len(equations.poses),
        )

    def __add__(self, other: Information) -> Information:
        return Information(
            self.shared + other.shared,
            self.response + other.response,
            self.poses + other.poses,
            self.views + other.views,
        )

    def covariance(self) -> Floats:
        """Of the shared parameters and the mean motion (g + 6, g + 6), at corner noise 1 px."""
        spread = np.concatenate([np.eye(len(self.shared)), -self.response / self.views])
        joint = spread @ scaled_inverse(self.shared) @ spread.T
        joint[-6:, -6:] += self.poses / self.views**2
        return joint


def projection_covariance(
    result: IntrinsicsResult, pixels: ArrayLike, range_m: float, fixed: Fixed = "world"
) -> Floats:
    """The covariance of where a point is seen, (..., 2, 2), px^2; see the module for what it is.

    pixels (..., 2): where the fitted camera sees it. range_m: its distance from the camera, m;
    `math.inf` for a direction. NaN where the distortion has no inverse.
    Raises ValueError for a range that is not positive.
    """
    uv = np.asarray(pixels, float)
    columns = projection_columns(result.intrinsics, uv.reshape(-1, 2), range_m, result.selection)
    p, extra = len(result.names), len(result.extra)
    covariance = result.sigma_px**2 * Information.of(result.equations).covariance()
    keep = np.r_[:p, p + extra : p + extra + 6] if check_fixed(fixed) == "world" else np.r_[:p]
    columns = columns[..., : len(keep)]
    spread = columns @ covariance[np.ix_(keep, keep)] @ np.swapaxes(columns, -1, -2)
    return spread.reshape(*uv.shape, 2)


def projection_sigma_px(
    result: IntrinsicsResult, pixels: ArrayLike, range_m: float, fixed: Fixed = "world"
) -> Floats:
    """The standard deviation of where a point is seen, in its worst direction, (...), px.

    The square root of the larger eigenvalue of `projection_covariance`, as mrcal reports it.
    """
    return worst_direction(projection_covariance(result, pixels, range_m, fixed))


def uncertainty_map(
    result: IntrinsicsResult,
    range_m: float,
    shape: tuple[int, int] = (30, 40),
    fixed: Fixed = "world",
) -> Floats:
    """`projection_sigma_px` at `image_grid(shape)`, (rows, columns), px."""
    return projection_sigma_px(result, image_grid(result.intrinsics, shape), range_m, fixed)


def image_grid(intrinsics: Intrinsics, shape: tuple[int, int]) -> Floats:
    """Pixels (rows, columns, 2) spread evenly from the image's first pixel to its last."""
    rows, columns = shape
    if rows < 2 or columns < 2:
        raise ValueError(f"shape: got {shape}, want at least 2 rows and 2 columns")
    u = np.linspace(0.0, intrinsics.width - 1.0, columns)
    v = np.linspace(0.0, intrinsics.height - 1.0, rows)
    return np.stack(np.meshgrid(u, v), axis=-1)


def projection_columns(
    intrinsics: Intrinsics, pixels: Floats, range_m: float, selection: Floats
) -> Floats:
    """d pixel / d (parameters, motion of the point): (N, 2, p + 6) at pixels (N, 2).

    selection (9, p): which parameters. At an infinite range a translation moves nothing.
    """
    distance = check_range(range_m)
    rays = deproject(pixels, np.ones(len(pixels)), intrinsics.K, intrinsics.dist)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    points = rays * (distance if math.isfinite(distance) else 1.0)
    _, by_parameter, by_point = project_with_derivatives(points, intrinsics)
    motion = twist_columns(points, by_point)
    if math.isinf(distance):
        motion[..., 3:] = 0.0
    return np.concatenate([by_parameter @ selection, motion], axis=-1)


def worst_direction(covariance: Floats) -> Floats:
    """The standard deviation along the longer axis of covariances (..., 2, 2)."""
    a, b, d = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.sqrt((a + d) / 2 + np.hypot((a - d) / 2, b))


def check_fixed(fixed: str) -> str:
    """`fixed`, or a ValueError."""
    if fixed not in ("world", "camera"):
        raise ValueError(f'fixed: got {fixed!r}, want "world" or "camera"')
    return fixed


def check_range(range_m: float) -> float:
    """The range as a float, or a ValueError unless it is positive (infinity is allowed)."""
    if not isinstance(range_m, (int, float, np.number)) or not range_m > 0:
        raise ValueError(f"range_m: got {range_m!r}, want a positive number of metres")
    return float(range_m)


CELLS = (6, 8)  # rows, columns
SIDES = ("left", "top", "right", "bottom")
GOOD_COVERAGE = 0.75  # of the cells
GOOD_MARGIN = 0.1  # of the width or height
GOOD_SPREAD_DEG = 10.0
GOOD_VIEWS = 10
GOOD_PX, USABLE_PX = 0.5, 2.0  # 95 %, in all but the worst 5 % of the image, at the boards' range
GOOD_FAR_PX, USABLE_FAR_PX = 2.0, 4.0  # the same for a direction (a point infinitely far away)
DETERMINED = 0.01  # 95 % of the focal length and of the centre, as shares of the focal length
LINE = 88


@dataclass(frozen=True, eq=False, repr=False)
class Coverage:
    """Where in the image corners were seen.

    counts (rows, columns): corners in each cell of the image. margins: what is empty at the left,
    top, right and bottom, as a share of the width or height. distances_px (N,): of all corners
    from the image's centre. size: (width, height), px.
    """

    counts: NDArray[np.intp]
    margins: tuple[float, float, float, float]
    distances_px: Floats
    size: tuple[int, int]

    @property
    def fraction(self) -> float:
        """The share of the cells with at least one corner."""
        return float(np.mean(self.counts > 0))

    @property
    def reach(self) -> float:
        """How far out the outermost corner lies: 0 the image's centre, 1 the image's corner."""
        return float(self.distances_px.max() / (math.hypot(*self.size) / 2))

    @property
    def empty_sides(self) -> tuple[str, ...]:
        """The sides of the image where more than a tenth of it saw no corner."""
        return tuple(s for s, m in zip(SIDES, self.margins, strict=True) if m > GOOD_MARGIN)

    def __repr__(self) -> str:
        margins = ", ".join(
            f"{100 * m:.0f} % {side}" for side, m in zip(SIDES, self.margins, strict=True)
        )
        rows, columns = self.counts.shape
        return (
            f"corners in {100 * self.fraction:.0f} % of {columns}x{rows} image cells, out to "
            f"{100 * self.reach:.0f} % of the half diagonal\nempty margins: {margins}"
        )


def coverage(detections: Sequence[Detection], cells: tuple[int, int] = CELLS) -> Coverage:
    """Where in the image the corners of all views lie.

    cells: (rows, columns) in which to count them. Raises ValueError for no detections.
    """
    if not len(detections):
        raise ValueError("detections: there are none")
    width, height = detections[0].size
    pixels = np.concatenate([d.pixels for d in detections])
    # pixel 0 is the centre of the first pixel: the image reaches from -0.5 to size - 0.5
    counts, _, _ = np.histogram2d(
        pixels[:, 1], pixels[:, 0], cells, [(-0.5, height - 0.5), (-0.5, width - 0.5)]
    )
    low, high = pixels.min(axis=0), pixels.max(axis=0)
    margins = (
        (low[0] + 0.5) / width,
        (low[1] + 0.5) / height,
        (width - 0.5 - high[0]) / width,
        (height - 0.5 - high[1]) / height,
    )
    centre = np.array([width - 1, height - 1]) / 2
    return Coverage(
        counts=counts.astype(np.intp),
        margins=tuple(float(m) for m in margins),  # type: ignore[arg-type]
        distances_px=np.linalg.norm(pixels - centre, axis=1),
        size=(width, height),
    )


@dataclass(frozen=True, eq=False, repr=False)
class Tilts:
    """How the boards are turned out of the image plane.

    about_x_deg, about_y_deg (n,): of the board's normal about the camera's x axis (positive: the
    board's top is nearer) and y axis (positive: its right side is nearer). total_deg (n,): between
    the normal and the optical axis.
    """

    about_x_deg: Floats
    about_y_deg: Floats
    total_deg: Floats

    @property
    def spread_deg(self) -> tuple[float, float]:
        """The standard deviation about x and about y; parallel boards have none, however tilted."""
        return float(np.std(self.about_x_deg)), float(np.std(self.about_y_deg))

    def __repr__(self) -> str:
        spread = "{:.0f} and {:.0f}".format(*self.spread_deg)
        return (
            f"boards tilted {self.total_deg.min():.0f} to {self.total_deg.max():.0f} deg, "
            f"spread {spread} deg about x and y"
        )


def tilts(result: IntrinsicsResult) -> Tilts:
    """How far the board was tilted in each view."""
    normals = result.T_camera_board[:, :3, 2]
    x, y, z = (normals * np.sign(normals[:, 2:])).T  # away from the camera, whatever the origin
    return Tilts(
        about_x_deg=np.degrees(np.arctan2(-y, z)),
        about_y_deg=np.degrees(np.arctan2(x, z)),
        total_deg=np.degrees(np.arccos(np.clip(z, -1.0, 1.0))),
    )


# --- the verdict ---


def verdict(result: IntrinsicsResult) -> str:
    """In words whether a calibration is good, and if not, what it lacks and what to do.

    Judged by how far it may be wrong about where a point is seen, at the boards' range and
    infinitely far away (where a focal length that only suits one distance gives itself away), by
    what the corners cover, and by how the boards are tilted; not by the RMS.
    """
    facts = _Facts.of(result)
    weak = [reason for reason in facts.weaknesses() if reason]
    if not weak and max(facts.near_px / GOOD_PX, facts.far_px / GOOD_FAR_PX) > 1:
        weak = [
            "nothing is wrong with coverage and tilt, there is too little of it: take more views, "
            f"or sharper ones (the corners scatter by {facts.sigma_px:.2f} px)."
        ]
    if facts.bad:
        lines = [f"Not good enough: {facts.head()}"]
    elif weak:
        lines = [f"Usable with care: {facts.head()}"]
    else:
        lines = [f"Good: {facts.head()}"]
    lines += [f"- {reason}" for reason in weak]
    lines.append(
        f"The RMS of {result.rms_px:.2f} px says none of this: the poses absorb much of what is "
        "wrong with K, and the RMS stays small."
    )
    return "\n".join(_wrapped(line) for line in lines)


def _wrapped(line: str) -> str:
    """Broken into lines of at most `LINE` characters, never after a ±."""
    text = textwrap.fill(
        line.replace("± ", "±\0"), LINE, subsequent_indent="  ", break_on_hyphens=False
    )
    return text.replace("\0", " ")


@dataclass(frozen=True)
class _Facts:
    """What the verdict rests on. All but the last three are half widths of 95 % or plain facts.

    near, far: of a projection at the boards' range and infinitely far away; focal, centre: as
    shares of the focal length.
    """

    views: int
    converged: bool
    range_m: float
    near_px: float
    near_mm: float
    far_px: float
    focal: float
    centre_px: float
    centre: float
    coverage: Coverage
    spread_deg: tuple[float, float]
    sigma_px: float

    @classmethod
    def of(cls, result: IntrinsicsResult) -> _Facts:
        """Measured on a result."""
        range_m, wide = result.board_range_m, result.quantile()
        near, far = (
            wide * float(np.quantile(result.uncertainty_map(r), 0.95)) for r in (range_m, math.inf)
        )
        focal = max(result.sigma(f) / result.value(f) for f in ("fx", "fy"))
        centre = max(result.sigma(c) for c in ("cx", "cy"))
        return cls(
            views=len(result.residuals),
            converged=result.converged,
            range_m=range_m,
            near_px=near,
            near_mm=1e3 * near * range_m / result.value("fx"),
            far_px=far,
            focal=wide * focal,
            centre_px=wide * centre,
            centre=wide * centre / result.value("fx"),
            coverage=coverage(result.detections),
            spread_deg=tilts(result).spread_deg,
            sigma_px=result.sigma_px,
        )

    @property
    def determined(self) -> bool:
        """Whether K itself is known."""
        return max(self.focal, self.centre) < DETERMINED

    @property
    def bad(self) -> bool:
        """Whether the calibration should not be used."""
        known = self.near_px < USABLE_PX and self.far_px < USABLE_FAR_PX
        return not (self.converged and self.determined and known)

    def head(self) -> str:
        """The finding in one sentence."""
        if not self.determined:
            return (
                f"these {self.views} views do not determine K (f ± {100 * self.focal:.1f} %, "
                f"centre ± {self.centre_px:.0f} px, 95 %)."
            )
        return (
            f"in 95 % of the image a point {self.range_m:.2f} m away is seen where this camera "
            f"says to ± {self.near_px:.2f} px ({self.near_mm:.2f} mm), and a direction to "
            f"± {self.far_px:.2f} px (95 %)."
        )

    def weaknesses(self) -> list[str]:
        """What could be better, with what to do; "" for what could not."""
        seen, (about_x, about_y) = self.coverage, self.spread_deg
        flat = min(about_x, about_y) < GOOD_SPREAD_DEG
        sides = " and ".join(seen.empty_sides) if len(seen.empty_sides) < 4 else "all four"
        return [
            "" if self.converged else "the solver did not converge: remove views that are spoiled, "
            "or give a guess.",
            f"{self.views} views are few: take 20 to 40." if self.views < GOOD_VIEWS else "",
            f"the boards' tilts spread only {about_x:.0f} and {about_y:.0f} deg about x and y, and "
            "nearly parallel boards leave focal length and distance to trade against each other: "
            "tilt 30 to 45 deg about both axes, to both sides." if flat else "",
            f"no corners in the outer tenth of the image ({sides} sides): there the figures above "
            "extrapolate and hold only if the distortion model does. Push the board into the "
            "image's corners."
            if seen.empty_sides
            else "",
            f"only {100 * seen.fraction:.0f} % of the image saw a corner: fill the rest."
            if seen.fraction < GOOD_COVERAGE else "",
        ]  # fmt: skip
