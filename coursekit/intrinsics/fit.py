"""How K and distortion are fitted to views of a board, and how well they are then known.

Corner j of view i is seen at pi(T_i p_j; K, dist) + noise. The squares of the noise are made
smallest over K, dist and all poses T_i together (`calibrate`, by OpenCV). What comes back carries
the derivatives at that minimum, and from them the covariance of everything that was fitted.

How far the fitted camera may be wrong about where a point is seen, in px, is what counts
(`IntrinsicsResult.projection_covariance`). After mrcal (D. Kogan, "uncertainty of projection", the
"mean-pcam" method) it is the covariance of intrinsics *and* poses, propagated to a pixel. With
`fixed="world"` the point is fixed to the boards. Another set of corners would give another K and,
with it, other poses; what of the change is a mere motion of the camera's frame costs nothing and is
compensated. Each board says where the point is in the refitted camera's frame,
p + omega_i x p + v_i, and the mean over the boards is projected with the refitted intrinsics. With
`fixed="camera"` the point stays where it is in the camera's frame and only the intrinsics change:
what a depth camera's user gets who trusts that frame, and the larger of the two.

The unit is the view: what the residuals of one view have in common counts once, and views that
scatter more than corner noise explains widen every figure. What both leave out: errors of the model
that all views share (a bowed board, a distortion that the coefficients cannot follow), and
everything of second order.

Whether a calibration is good is said by `IntrinsicsResult.verdict`, from that uncertainty, from
what the corners cover (`coverage`) and from how the boards were tilted (`tilts`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.spatial.transform import Rotation

from coursekit.arrays import ArrayLike, Floats, NDArray
from coursekit.boards import Board, Detection, Detections
from coursekit.boards.board import FEWEST_CORNERS, check_detections
from coursekit.checks import array, choice, is_number, want
from coursekit.geometry import Intrinsics, deproject, make_transform, project
from coursekit.intrinsics import derivatives
from coursekit.words import Estimate, counted, say, up_to, wrapped

Fixed = Literal["world", "camera"]

MODELS = {
    "none": (),
    "k1": ("k1",),
    "k1k2": ("k1", "k2"),
    "k1k2p1p2": ("k1", "k2", "p1", "p2"),
    "brown_conrady": ("k1", "k2", "p1", "p2", "k3"),
}
MIN_VIEWS = 3
ALIKE = 0.005  # of the image's width, by which a board moves that nobody moved
WIDE_FOCAL = 0.5  # of the width: 90 deg across
LEAST_FOCAL = 0.05  # of the image's width: a field of view of 170 deg, no pinhole camera
MOST_FOCAL = 1e3  # of it: 0.06 deg, beyond any telescope; boards without tilt lead there
ITERATIONS = 1000  # nearly parallel boards need hundreds; OpenCV's own limit of 30 ends far away
ARRIVED_SIGMAS = 0.1  # no combination of parameters would move more in the next step,
ARRIVED_PX = 1e-4  # or no corner would (float32 corners: all that OpenCV's solver can do)
MAP_SHAPE = (30, 40)  # rows, columns of a map over the image

# What a verdict asks for.
SIDES = ("left", "top", "right", "bottom")
GOOD_COVERAGE = 0.75  # of the cells
GOOD_MARGIN = 0.1  # of the width or height
GOOD_SPREAD_DEG = 10.0
GOOD_VIEWS = 10
GOOD_PX, USABLE_PX = 0.5, 2.0  # 95 %, in all but the worst 5 % of the image, at the boards' range
GOOD_FAR_PX, USABLE_FAR_PX = 2.0, 4.0  # the same for a direction (a point infinitely far away)
UNKNOWN_PX = 1e4  # what is known no better is not known; of mm and of coefficients, too
MOST_FOLDED = 0.05  # of the image; beyond, no figure is one of "95 % of the image"
DETERMINED_SHARE = 0.01  # 95 % of the focal length and of the centre, as shares of the focal length


# --- what a fit says ---


class CalibrationFailed(ValueError):
    """The solver found no finite camera for these views."""


@dataclass(frozen=True, eq=False, repr=False)
class IntrinsicsResult(Estimate):
    """A fitted camera and what the data say about it.

    intrinsics: the estimate. names (p): the parameters that were estimated; "f" stands for
    fx = fy. T_camera_board (n, 4, 4): the pose of the board in each view. equations: the residuals
    and their Jacobian at the estimate, poses perturbed from the left in the camera's frame (see
    `intrinsics.derivatives`). points (N, 3): where the board's corners are taken to be, m. extra:
    what was estimated besides (the bow of a board); it widens every covariance and is not part of
    it.

    `value`, `sigma` and `Estimate.interval` take one of `names`; "fx" and "fy" are known where "f"
    is.
    """

    intrinsics: Intrinsics
    model: str
    names: tuple[str, ...]
    T_camera_board: Floats
    equations: derivatives.NormalEquations
    board: Board
    points: Floats
    detections: Sequence[Detection]
    extra: tuple[str, ...] = ()

    # --- how large the residuals are ---

    @cached_property
    def residuals(self) -> tuple[Floats, ...]:
        """Observed - predicted pixels, one (N_i, 2) a view, px."""
        flat = self.equations.residuals
        return tuple(flat[rows].reshape(-1, 2) for rows in self.equations.slices)

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
    def rms_uv_px(self) -> tuple[float, float]:
        """Root mean square residual along u and along v, px."""
        u, v = self._all_residuals.T
        return _rms(u), _rms(v)

    @property
    def per_view_rms_px(self) -> Floats:
        """`rms_px` of each view, (n,)."""
        return np.array([_rms(r) for r in self.residuals])

    @property
    def dof(self) -> float:
        """Degrees of freedom of the covariances, which the scatter from view to view decides."""
        return self._scatter.dof

    @property
    def sigma_px(self) -> float:
        """Standard deviation of one corner coordinate, px: squares over degrees of freedom."""
        return math.sqrt(float(np.sum(self.equations.residuals**2)) / self.equations.dof)

    @cached_property
    def converged(self) -> bool:
        """Whether another Gauss-Newton step would leave everything where it is.

        It would move no combination of parameters by more than ARRIVED_SIGMAS of its own standard
        deviation, or no corner by more than ARRIVED_PX.
        """
        decrease, variance = self.equations.decrease(), float(np.mean(self._all_residuals**2))
        of_sigma = variance * 2 * self.corners / max(1, self.equations.dof)
        return decrease < max(ARRIVED_SIGMAS**2 * of_sigma, 2 * self.corners * ARRIVED_PX**2)

    # --- what the parameters are known to ---

    @cached_property
    def _scatter(self) -> derivatives.Scatter:
        return self.equations.scatter(len(self.names), first_alike(self.detections))

    @cached_property
    def covariance(self) -> Floats:
        """The covariance (p, p) of the parameters `names`, poses unknown; px^2 for K.

        The residuals of one view hang together (its image, its light, what the model lacks of its
        pose), so the view is the unit that it counts, not the corner: `NormalEquations.scatter`.
        """
        return self._scatter.covariance[: len(self.names), : len(self.names)]

    def value(self, name: str) -> float:
        """The estimate of one of `names`."""
        return float(derivatives.parameter_vector(self.intrinsics)[self._row(name)])

    def sigma(self, name: str) -> float:
        """The standard deviation of one of `names`, px for K."""
        row = derivatives.selection(self.names)[self._row(name)]
        return math.sqrt(float(row @ self.covariance @ row))

    def _row(self, name: str) -> int:
        """Where the parameter of this name stands in `PARAMETERS`; ValueError if not estimated."""
        known = (*self.names, "fx", "fy") if "f" in self.names else self.names
        choice("name", name, known)
        return derivatives.PARAMETERS.index("fx" if name == "f" else name)

    # --- what that means for a pixel ---

    def projection_covariance(
        self, pixels: ArrayLike, range_m: float, fixed: Fixed = "world"
    ) -> Floats:
        """The covariance of where a point is seen, (..., 2, 2), px^2; see the module.

        pixels (..., 2): where the fitted camera sees it. range_m: its distance from the camera, m;
        `math.inf` for a direction. fixed: "world" or "camera", to what the point is fixed. NaN
        where the distortion has no inverse. Raises ValueError for a range that is not positive.
        """
        choice("fixed", fixed, ("world", "camera"))
        uv = array("pixels", pixels, (2,), leading=True)
        columns = projection_columns(self.intrinsics, uv.reshape(-1, 2), range_m, self.names)
        scatter, p = self._scatter, len(self.names)
        joint = self.equations.mean_motion_covariance(scatter.covariance, scatter.variance)
        asked = np.delete(np.arange(len(joint)), np.s_[p : p + len(self.extra)])
        asked = asked[:p] if fixed == "camera" else asked
        columns, covariance = columns[..., : len(asked)], joint[np.ix_(asked, asked)]
        return (columns @ covariance @ np.swapaxes(columns, -1, -2)).reshape(*uv.shape, 2)

    def uncertainty_map(
        self, range_m: float, shape: tuple[int, int] = MAP_SHAPE, fixed: Fixed = "world"
    ) -> Floats:
        """The standard deviation of where a point is seen, over the image, (rows, columns), px.

        At `image_grid(shape)`, in the direction in which it is worst, as mrcal reports it: the
        square root of the larger eigenvalue of `projection_covariance`.
        """
        grid = image_grid(self.intrinsics, shape)
        return worst_direction(self.projection_covariance(grid, range_m, fixed))

    @property
    def board_range_m(self) -> float:
        """The median distance of the boards from the camera, m."""
        seen = [
            np.linalg.norm(self.points[d.ids].mean(axis=0) @ T[:3, :3].T + T[:3, 3])
            for d, T in zip(self.detections, self.T_camera_board, strict=True)
        ]
        return float(np.median(seen))

    # --- where it says nothing ---

    @cached_property
    def folded_share(self) -> float:
        """The share of the image in which the fitted distortion has no inverse, hence no figure."""
        grid = image_grid(self.intrinsics, MAP_SHAPE).reshape(-1, 2)
        return float(np.isnan(points_at(grid, math.inf, self.intrinsics)[:, 0]).mean())

    @cached_property
    def simpler(self) -> IntrinsicsResult | None:
        """The fit with the most coefficients below these whose lens does not fold in the image.

        None where there is none. Raises ValueError as `calibrate`.
        """
        smaller = list(MODELS)[: list(MODELS).index(self.model)]
        fits = (self._refitted(self.detections, model) for model in reversed(smaller))
        return next((fit for fit in fits if not fit.folded_share), None)

    def held_out_px(self) -> float:
        """The RMS in px of each half of the views under the camera of the other half.

        With the poses that suit it best: what a model is worth, where coefficients too many show.
        Raises ValueError where a half has fewer than 3 views, and as `calibrate`.
        """
        squares = 0.0
        for part in (0, 1):
            views, others = self.detections[part::2], self.detections[1 - part :: 2]
            lens = self._refitted(views, self.model).intrinsics
            squares += rms_under(lens, others, self.points) ** 2 * sum(map(len, others))
        return math.sqrt(squares / self.corners)

    def _refitted(self, views: Sequence[Detection], model: str) -> IntrinsicsResult:
        return calibrate(views, self.board, model, "f" in self.names, None, self.points)

    # --- in words ---

    def verdict(self) -> str:
        """In words: is this calibration good, and if not, what it lacks and what to do.

        Judged by how far it may be wrong about where a point is seen, at the boards' range and
        infinitely far away (where a focal length that only suits one distance gives itself away),
        by what the corners cover, and by how the boards are tilted; not by the RMS.
        """
        range_m, wide, views = self.board_range_m, self.quantile(), len(self.residuals)
        maps = (self.uncertainty_map(r) for r in (range_m, math.inf))
        near, far = (wide * float(np.nanquantile(sigmas, 0.95)) for sigmas in maps)
        focal = wide * max(self.sigma(f) / self.value(f) for f in ("fx", "fy"))
        centre = wide * max(self.sigma(c) for c in ("cx", "cy"))
        determined = max(focal, centre / self.value("fx")) < DETERMINED_SHARE
        near_mm = 1e3 * near * range_m / self.value("fx")
        where = "the pixels that have a ray" if self.folded_share else "the image"
        unsure = {"focal": up_to(100 * focal, 100, 1), "centre": up_to(centre, UNKNOWN_PX, 0)}
        says = say("intrinsics.undetermined", views=views, **unsure)
        if determined:
            reaches = {"range_m": range_m, "near": near, "near_mm": near_mm, "far": far}
            says = say("intrinsics.determined", where=where, **reaches)
        weak = list(_weaknesses(self))
        if not weak and (near > GOOD_PX or far > GOOD_FAR_PX):
            weak = [say("intrinsics.too_little", sigma=self.sigma_px)]
        grade = "Usable with care" if weak else "Good"
        small = near < USABLE_PX and far < USABLE_FAR_PX and self.folded_share <= MOST_FOLDED
        if not (self.converged and determined and small):
            grade = "Not good enough"
        lines = [f"{grade}: {says}", *(f"- {reason}" for reason in weak)]
        lines.append(say("intrinsics.rms", rms=self.rms_px))
        return "\n".join(map(wrapped, lines))

    def __repr__(self) -> str:
        lines = [say("intrinsics.fit", fit=self, views=len(self.residuals))]
        lines[0] += ", the board's shape fitted too" if self.extra else ""
        lines[0] += "" if self.converged else "; NOT CONVERGED"
        for name in self.names:
            places, unit = (2, " px") if name[0] in "fc" else (4, "")
            half = self.quantile() * self.sigma(name)
            number = f"{self.value(name):.{places}f} ± {up_to(half, UNKNOWN_PX, places)}{unit}"
            lines.append(f"{'fx = fy' if name == 'f' else name} = {number} (95 %)")
        sigmas = self.quantile() * self.uncertainty_map(self.board_range_m)
        lines.append(say("intrinsics.residuals", fit=self, **sizes_over(sigmas)))
        lines += folded_text(self.folded_share)
        return "\n".join(lines)


def sizes_over(image: Floats) -> dict[str, str]:
    """The median and the worst of a map over the image, NaN left out, in words."""
    sizes = {"median": np.nanmedian(image), "worst": np.nanmax(image)}
    return {name: up_to(float(size), UNKNOWN_PX) for name, size in sizes.items()}


def folded_text(share: float) -> list[str]:
    """The line about the share of the image in which a lens has no answer; none where it has."""
    if not share:
        return []
    where = "in its corners" if share < MOST_FOLDED else "from some distance to its centre on"
    return [say("intrinsics.folds", percent=100 * share, where=where)]


def rms_under(lens: Intrinsics, detections: Sequence[Detection], points: Floats) -> float:
    """The RMS in px (2-D) of corners under a camera that is held: only the poses are fitted.

    points (N, 3): the board's corners, m. A K that is wrong shows where the corners can tell.

    >>> lens = Intrinsics(640, 480, 600, 600, 320, 240)
    >>> board = Board("checkerboard", (10, 7), 0.025)
    >>> turn = Rotation.from_euler("x", 30, degrees=True).as_matrix()
    >>> seen = project(board.points @ turn.T + [-0.1, -0.1, 0.5], lens.K)
    >>> views = [Detection(np.arange(54), seen, lens.size)]
    >>> wrong = Intrinsics(640, 480, 660, 600, 320, 240)
    >>> print(f"{rms_under(wrong, views, board.points):.1f} px")
    1.7 px
    """
    import cv2

    off = []
    for view in detections:
        corners = points[view.ids]
        _, r, t = cv2.solvePnP(corners, view.pixels, lens.K, lens.dist)
        at = corners @ cv2.Rodrigues(r)[0].T + t.ravel()
        off.append(view.pixels - project(at, lens.K, lens.dist))
    return _rms(np.concatenate(off))


def _rms(residuals: Floats) -> float:
    return math.sqrt(float(np.sum(residuals**2)) / len(residuals))


# --- the fit ---


def calibrate(
    detections: Sequence[Detection],
    board: Board,
    model: str = "brown_conrady",
    same_focal: bool = False,
    guess: Intrinsics | None = None,
    points: ArrayLike | None = None,
) -> IntrinsicsResult:
    """The camera that explains detections of a board best, by OpenCV's `calibrateCameraExtended`.

    model: which distortion coefficients are estimated, one of `MODELS`; the others are held at 0.
    same_focal: holds fx = fy. guess: where to start; None lets OpenCV find a start, and where that
    leads nowhere takes a focal length as long as the image is wide, then half that. points (N, 3):
    where the board's corners really are, m, in place of `board.points` (a measured or bowed board).
    One thread, so that a second run gives the same bits.
    Raises ValueError that names the view for fewer than 3 views that differ (pictures of a board
    that stayed where it was are one), fewer than 6 corners or all of them on a line, corners that
    the board does not have, NaN, and images of different sizes; and CalibrationFailed where the
    solver finds no finite camera.

    >>> from coursekit.geometry import project
    >>> lens = Intrinsics(640, 480, 600, 600, 320, 240)
    >>> board = Board("checkerboard", (10, 7), 0.025)
    >>> turns = Rotation.from_euler("xy", [[30, 0], [0, 30], [-30, -30]], degrees=True).as_matrix()
    >>> seen = [project(board.points @ R.T + [-0.1, -0.1, 0.5], lens.K) for R in turns]
    >>> views = [Detection(np.arange(54), pixels, lens.size) for pixels in seen]
    >>> print(f"fx = {calibrate(views, board, model='none').value('fx'):.1f} px")
    fx = 600.0 px
    """
    choice("model", model, tuple(MODELS))
    check_detections(detections, board, FEWEST_CORNERS, MIN_VIEWS)
    places = len(set(first_alike(detections)))
    got = f"{len(detections)} views with the board in {counted(places, 'place')}"
    want(places >= MIN_VIEWS, "detections", got, f"at least {MIN_VIEWS} places: move the board")
    points = board.points if points is None else points
    corners = array("points", points, board.points.shape, finite=True)
    width, height = size = detections[0].size
    if guess is not None:
        want(guess.size == size, "guess", guess.size, f"the images' size, {size} px")
    names = (*(("f",) if same_focal else ("fx", "fy")), "cx", "cy", *MODELS[model])
    # OpenCV's own start can lie at the far end of the valley in which focal length and distance
    # trade against each other, where its steps go nowhere; then once more from plain cameras.
    centre = (width - 1) / 2, (height - 1) / 2
    plain = [Intrinsics(width, height, f, f, *centre) for f in (width, WIDE_FOCAL * width)]
    starts = [None, *plain] if guess is None else [guess]
    fits: list[IntrinsicsResult] = []
    for start in starts:
        try:
            lens, poses = _solve(corners, detections, names, start)
        except CalibrationFailed:
            if start is starts[-1] and not fits:
                raise
            continue
        fits.append(evaluate(lens, poses, detections, board, corners, names, model))
        if fits[-1].converged:
            break
    return min(fits, key=lambda fit: fit.rms_px)


def evaluate(
    intrinsics: Intrinsics,
    T_camera_board: Floats,
    detections: Sequence[Detection],
    board: Board,
    points: Floats,
    names: tuple[str, ...],
    model: str,
    extra: dict[str, Floats] | None = None,
    held: tuple[Floats, Floats] | None = None,
) -> IntrinsicsResult:
    """Residuals and Jacobian of a camera and poses, as a result.

    T_camera_board (n, 4, 4). points (N, 3): the board's corners, m. names: what counts as
    estimated. extra: d points / d a further estimated quantity, (N, 3) by name. held: what is known
    of each of those besides, in px: weights (k,) and what they amount to (k,); 0 for nothing.
    """
    extra = extra or {}
    ids = np.concatenate([d.ids for d in detections])
    counts = [len(d.ids) for d in detections]
    R = np.repeat(T_camera_board[:, :3, :3], counts, axis=0)
    at = np.einsum("nij,nj->ni", R, points[ids])
    at += np.repeat(T_camera_board[:, :3, 3], counts, axis=0)
    predicted, by_parameter, by_point = derivatives.project_with_derivatives(at, intrinsics)
    residuals = np.concatenate([d.pixels for d in detections]) - predicted
    shared = [by_parameter @ derivatives.selection(names)]
    for by_extra in extra.values():
        moves = np.einsum("nij,nj->ni", R, by_extra[ids])
        shared.append(np.einsum("nij,nj->ni", by_point, moves)[..., None])
    poses = np.split(derivatives.twist_columns(at, by_point), np.cumsum(counts)[:-1])
    weights, off = held or (np.zeros(len(extra)), np.zeros(len(extra)))
    known = np.concatenate([np.zeros((len(extra), len(names))), np.diag(weights)], axis=1)
    seen = np.concatenate(shared, axis=-1).reshape(2 * len(ids), -1)
    rows = np.concatenate([seen, known[weights > 0]])
    blocks = tuple(block.reshape(-1, 6) for block in poses)
    left = np.concatenate([residuals.ravel(), -off[weights > 0]])
    equations = derivatives.NormalEquations(rows, blocks, left)
    fitted = intrinsics, model, names, T_camera_board, equations
    return IntrinsicsResult(*fitted, board, points, detections, tuple(extra))


def _solve(
    corners: Floats, detections: Sequence[Detection], names: Sequence[str], guess: Intrinsics | None
) -> tuple[Intrinsics, Floats]:
    """The camera and T_camera_board (n, 4, 4) of the least squares over `names`, by OpenCV.

    On one thread: on two, OpenCV adds sums in an order that changes from run to run. Raises
    CalibrationFailed where it gives up, runs away, or ends at a camera that cannot be.
    """
    import cv2

    size, same_focal = detections[0].size, "f" in names
    points = [corners[d.ids].astype(np.float32) for d in detections]
    pixels = [np.asarray(d.pixels, np.float32) for d in detections]
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, ITERATIONS, np.finfo(float).eps)
    flags = cv2.CALIB_FIX_ASPECT_RATIO if same_focal else 0
    flags |= 0 if "p1" in names else cv2.CALIB_ZERO_TANGENT_DIST
    for name in ("k1", "k2", "k3"):
        flags |= 0 if name in names else getattr(cv2, f"CALIB_FIX_{name.upper()}")
    K0, dist0 = np.eye(3), np.zeros(5)
    if guess is not None:
        K0, flags = guess.K, flags | cv2.CALIB_USE_INTRINSIC_GUESS
        dist0 = np.where([k in names for k in derivatives.PARAMETERS[4:]], guess.coeffs, 0.0)
        if same_focal:  # the ratio that OpenCV holds is that of the guess
            K0[0, 0] = K0[1, 1] = (K0[0, 0] + K0[1, 1]) / 2
    elif any(p[:, 2].any() for p in points):  # OpenCV finds a start for flat boards only
        flat = [p * np.array([1, 1, 0], np.float32) for p in points]
        K0 = np.asarray(cv2.initCameraMatrix2D(flat, pixels, size, 1.0 if same_focal else 0.0))
        flags |= cv2.CALIB_USE_INTRINSIC_GUESS
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        _, K, dist, rotations, translations, *_ = cv2.calibrateCameraExtended(
            points, pixels, size, K0, dist0, flags=flags, criteria=criteria
        )
    except cv2.error as error:
        raise CalibrationFailed(f"detections: OpenCV's solver gave up ({error.err})") from error
    finally:
        cv2.setNumThreads(threads)
    finite = all(np.isfinite(found).all() for found in (K, dist, *rotations, *translations))
    if not finite or max(K[0, 0], K[1, 1]) > MOST_FOCAL * size[0]:
        raise CalibrationFailed("detections: the solver ran away to infinity; tilt the board more")
    places = zip(map(np.ravel, rotations), map(np.ravel, translations), strict=True)
    poses = np.stack([make_transform(Rotation.from_rotvec(r), t) for r, t in places])
    depths = [p @ T[2, :3] + T[2, 3] for T, p in zip(poses, points, strict=True)]
    in_front = all((z > 0).all() for z in depths)
    if min(K[0, 0], K[1, 1]) < LEAST_FOCAL * size[0] or not in_front:
        raise CalibrationFailed(say("intrinsics.no_camera", fx=K[0, 0], fy=K[1, 1]))
    kind = "brown_conrady" if "k1" in names else "none"
    coeffs = tuple(np.ravel(dist)[:5].tolist())
    return Intrinsics(*size, K[0, 0], K[1, 1], K[0, 2], K[1, 2], kind, coeffs), poses


# --- pixels and what the fit says about them ---


def image_grid(intrinsics: Intrinsics, shape: tuple[int, int]) -> Floats:
    """Pixels (rows, columns, 2) spread evenly from the image's first pixel to its last."""
    rows, columns = shape
    want(rows > 1 and columns > 1, "shape", shape, "at least 2 rows and 2 columns")
    u = np.linspace(0.0, intrinsics.width - 1.0, columns)
    v = np.linspace(0.0, intrinsics.height - 1.0, rows)
    return np.stack(np.meshgrid(u, v), axis=-1)


def points_at(pixels: Floats, range_m: float, intrinsics: Intrinsics) -> Floats:
    """The points (N, 3) that are seen at pixels (N, 2), range_m from the camera, m.

    At an infinite range their directions, of length 1. NaN where the distortion has no inverse.
    Raises ValueError for a range that is not positive.
    """
    far = range_m == math.inf
    want(far or (is_number(range_m) and range_m > 0), "range_m", range_m, "a positive number, m")
    rays = deproject(pixels, np.ones(len(pixels)), intrinsics.K, intrinsics.dist)
    return rays / np.linalg.norm(rays, axis=1, keepdims=True) * (1.0 if far else range_m)


def projection_columns(
    intrinsics: Intrinsics, pixels: Floats, range_m: float, names: Sequence[str]
) -> Floats:
    """d pixel / d (parameters `names`, motion of the point): (N, 2, p + 6) at pixels (N, 2).

    At an infinite range a translation moves nothing.
    """
    points = points_at(pixels, range_m, intrinsics)
    _, by_parameter, by_point = derivatives.project_with_derivatives(points, intrinsics)
    motion = derivatives.twist_columns(points, by_point)
    if math.isinf(range_m):
        motion[..., 3:] = 0.0
    return np.concatenate([by_parameter @ derivatives.selection(names), motion], axis=-1)


def worst_direction(covariance: Floats) -> Floats:
    """The standard deviation along the longer axis of covariances (..., 2, 2).

    Where one is rounding, of either sign, it is as large as what it hides.
    """
    a, b, d = covariance[..., 0, 0], covariance[..., 0, 1], covariance[..., 1, 1]
    return np.sqrt(np.abs(a + d) / 2 + np.hypot((a - d) / 2, b))


# --- what the views cover, and what a calibration lacks ---


@dataclass(frozen=True, eq=False, repr=False)
class Coverage:
    """Where in the image corners were seen.

    counts (rows, columns): corners in each cell of the image. margins: what is empty at the left,
    top, right and bottom, as a share of the width or height. reach: how far out the outermost
    corner lies, 0 in the image's centre and 1 in the image's corner.
    """

    counts: NDArray[np.intp]
    margins: tuple[float, float, float, float]
    reach: float

    @property
    def fraction(self) -> float:
        """The share of the cells with at least one corner."""
        return float(np.mean(self.counts > 0))

    @property
    def empty_sides(self) -> tuple[str, ...]:
        """The sides of the image where more than a tenth of it saw no corner."""
        return tuple(s for s, m in zip(SIDES, self.margins, strict=True) if m > GOOD_MARGIN)

    @property
    def percent(self) -> dict[str, float]:
        """How far out corners reach, and what is empty at each side, in per cent."""
        shares = zip(("reach", *SIDES), (self.reach, *self.margins), strict=True)
        return {name: 100 * share for name, share in shares}

    def __repr__(self) -> str:
        (rows, columns), covered = self.counts.shape, 100 * self.fraction
        facts = {"rows": rows, "columns": columns, "covered": covered}
        return say("intrinsics.coverage", **facts, **self.percent)


def coverage(detections: Sequence[Detection], cells: tuple[int, int] = (6, 8)) -> Coverage:
    """Where in the image the corners of all views lie.

    cells: (rows, columns) in which to count them. Raises ValueError for no corners, and for images
    of different sizes.

    >>> corners = np.array([[15.5, 11.5], [623.5, 11.5], [15.5, 467.5], [623.5, 467.5]])
    >>> coverage([Detection(np.arange(4), corners, (640, 480))], (2, 2))
    corners in 100 % of 2x2 image cells, out to 95 % of the half diagonal
    empty margins: 2 % left, 2 % top, 2 % right, 2 % bottom
    """
    want(any(map(len, detections)), "detections", 0, "at least one view with corners")
    width, height = size = np.array(Detections(detections).size)
    pixels = np.concatenate([d.pixels for d in detections])
    # pixel 0 is the centre of the first pixel: the image reaches from -0.5 to size - 0.5
    spans = (-0.5, height - 0.5), (-0.5, width - 0.5)
    counts, _, _ = np.histogram2d(pixels[:, 1], pixels[:, 0], cells, spans)
    left, top = (pixels.min(axis=0) + 0.5) / size
    right, bottom = (size - 0.5 - pixels.max(axis=0)) / size
    outermost = np.linalg.norm(pixels - (size - 1) / 2, axis=1).max()
    margins = float(left), float(top), float(right), float(bottom)
    return Coverage(counts.astype(np.intp), margins, float(outermost / np.linalg.norm(size / 2)))


def first_alike(detections: Sequence[Detection]) -> NDArray[np.intp]:
    """For each view the first one with the board in the same place, (n,): itself if it is new.

    A burst, or a copy of a file, brings one error of the pose and the board many times.
    """
    first, last = np.arange(len(detections)), max((int(d.ids.max()) for d in detections), default=0)
    at = np.full((len(detections), last + 1, 2), np.nan)
    for i, view in enumerate(detections):
        at[i, view.ids] = view.pixels
        moved = np.linalg.norm(at[:i] - at[i], axis=2)
        both = np.isfinite(moved).sum(axis=1)
        far = np.nansum(moved, axis=1) / np.maximum(both, 1) > ALIKE * view.size[0]
        if (alike := (both >= FEWEST_CORNERS) & ~far).any():
            first[i] = first[alike.argmax()]
    return first


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
        least, most = self.total_deg.min(), self.total_deg.max()
        return say("intrinsics.tilts", least=least, most=most, spread=self.spread_deg)


def tilts(result: IntrinsicsResult) -> Tilts:
    """How far the board was tilted in each view.

    >>> from types import SimpleNamespace
    >>> tilts(SimpleNamespace(T_camera_board=np.eye(4)[None]))
    boards tilted 0 to 0 deg, spread 0 and 0 deg about x and y
    """
    normals = result.T_camera_board[:, :3, 2]
    x, y, z = (normals * np.sign(normals[:, 2:])).T  # away from the camera, whatever the origin
    about_x_deg, about_y_deg = np.degrees(np.arctan2(-y, z)), np.degrees(np.arctan2(x, z))
    return Tilts(about_x_deg, about_y_deg, np.degrees(np.arccos(np.clip(z, -1.0, 1.0))))


def _weaknesses(result: IntrinsicsResult) -> Iterator[str]:
    """What could be better about the views of a calibration, with what to do."""
    views, seen = len(set(first_alike(result.detections))), coverage(result.detections)
    about_x, about_y = tilts(result).spread_deg
    if result.folded_share:
        yield f"{folded_text(result.folded_share)[0]}; {_fewer_coefficients(result)}"
    if not result.converged:
        yield "the solver did not converge: remove views that are spoiled, or give a guess."
    if views < GOOD_VIEWS:
        differ = " that differ" if views < len(result.detections) else ""
        yield f"{views} views{differ} are few: take 20 to 40."
    if min(about_x, about_y) < GOOD_SPREAD_DEG:
        yield say("intrinsics.parallel", about_x=about_x, about_y=about_y)
    if seen.empty_sides:
        sides = " and ".join(seen.empty_sides) if len(seen.empty_sides) < 4 else "all four sides"
        yield say("intrinsics.bare", sides=sides)
    if seen.fraction < GOOD_COVERAGE:
        yield f"only {100 * seen.fraction:.0f} % of the image saw a corner: fill the rest."


def _fewer_coefficients(result: IntrinsicsResult) -> str:
    """What to fit in place of a lens that folds inside the image, and what it costs."""
    fit = result.simpler
    if fit is None:
        return "no smaller model here does better: push the board into the image's corners."
    held_out, fx = "", "f" if "f" in result.names else "fx"
    if len(result.detections) >= 2 * MIN_VIEWS:
        rms = {"theirs": fit.held_out_px(), "ours": result.held_out_px()}
        if math.isfinite(sum(rms.values())):  # not where a half's lens folds within its corners
            held_out = say("intrinsics.held_out", **rms)
    sigmas = {"theirs": fit.sigma(fx), "ours": result.sigma(fx)}
    return say("intrinsics.fewer", model=fit.model, held_out=held_out, **sigmas)
