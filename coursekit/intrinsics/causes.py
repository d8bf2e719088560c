"""What the residuals of a calibration speak for: a bowed board, drifting focus, and four more.

The model is the camera and the board's pose in each view, to which causes are added. A corner at P
on the board (m, z into it) is seen at

    p = R_i (P + bow(P) n) + t_i + time motion_i,      time = -1/2 ... 1/2 from first row to last,
    pixel = c + (1 + focus_i) (K distort(p) + lens terms - c),

where bow is a quadratic form (constant and linear terms are poses), n the board's normal, motion_i
what the board moves while view i is read out, and focus_i the view's relative change of the focal
length. What is not in the model is 0 there and is tested by `coursekit.causes`: each has its
columns whether it is in the model or not. Two more hypotheses set data aside: a view, and single
corners, that do not fit the others.

`fit_bow` fits the bow alone. It puts corners a millimetre off the plane, and a fit without it pays
with the focal length and k1 rather than with the residuals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from coursekit.arrays import Floats, Interval, Mask, NDArray
from coursekit.boards import Detection, Detections
from coursekit.causes import CauseSearch, Explained, Hypothesis, Projection, Tested, search
from coursekit.geometry import Intrinsics, moved
from coursekit.intrinsics.derivatives import (
    NormalEquations,
    parameter_vector,
    project_with_derivatives,
    selection,
    twist_columns,
    with_parameters,
)
from coursekit.intrinsics.fit import MIN_CORNERS, IntrinsicsResult, evaluate
from coursekit.words import p_text

BOW, FOCUS, SHUTTER, LENS = "bowed_board", "focus_drift", "rolling_shutter", "lens_model"
PHYSICAL = (BOW, FOCUS, SHUTTER, LENS)
SPOILED_VIEW, BAD_CORNERS = "spoiled_view", "bad_corners"
OWN = {FOCUS: 1, SHUTTER: 3}  # columns of the causes that each view has of its own
# What a cause's coefficients are when it matters: bow, motion during the readout in m, relative
# focal length, px for the rest.
TYPICAL = {BOW: 5e-4, FOCUS: 0.01, SHUTTER: 1e-3, LENS: 0.5, SPOILED_VIEW: 1.0, BAD_CORNERS: 1.0}
# At most 2 % of healthy sessions may get a finding. Six kinds of test at this level make 0.2 %; the
# rest is for noise that is not quite Gaussian and for the checks that are no F-tests.
CHANCE_LEVEL = 3e-4
BOW_LEVEL = 0.01  # a bow less likely than this by chance is one
PRIOR_PX = 0.1  # corner noise against which a cause's size is weighed in a refit
REFIT_STEPS, SMALL_DECREASE = 40, 1e-7  # a step that saves less of the squares is the last
LEAST_DAMPING, MOST_DAMPING = 1e-12, 1.0  # of the columns' own squares
SPOILED_RATIO = 3.0  # a view's rms over the others' median; blurred or far views reach 2
SPOILED_PX = 0.2  # and at least this: what is a good corner's noise in a poor image
BAD_CORNER_PX = 0.5  # a wrong corner is off by pixels; good ones stay below 5 sigma of 0.1 px
RAYLEIGH_MEDIAN = 1.1774  # the median length of two independent standard normal numbers
SHRINK_DOF = 30.0  # per-view variances are drawn to the common one as by this many observations
BOW_NAMES = ("bow_xx", "bow_xy", "bow_yy")
NORMAL = np.array([0.0, 0.0, 1.0])  # into the board


@dataclass(frozen=True, eq=False)
class CornerTable:
    """The corners of all views in one row.

    points (N, 3): on the board, m. pixels (N, 2). view, ids (N,): each corner's view and number.
    """

    points: Floats
    pixels: Floats
    view: NDArray[np.intp]
    ids: NDArray[np.intp]

    def keep(self, mask: Mask) -> CornerTable:
        """The corners under the mask (N,)."""
        return CornerTable(self.points[mask], self.pixels[mask], self.view[mask], self.ids[mask])


@dataclass(frozen=True, eq=False)
class Linear:
    """A calibration at its corners.

    residuals (N, 2); shared (N, 2, g) and own (N, 2, w): derivatives of what all views have in
    common and of what each has of its own, with the causes in the model; columns: those of every
    physical cause, (N, 2, k) each.
    """

    residuals: Floats
    shared: Floats
    own: Floats
    columns: dict[str, Floats]


@dataclass(frozen=True, eq=False)
class Calibration:
    """A camera, the board's pose in each view, the causes that were added, and the corners.

    estimated (9, p): d camera parameters / d those that are fitted. poses (n, 4, 4):
    T_camera_board. names: of the n views. centre, half_diagonal: of the board, m. values: the
    coefficients of the causes, 0 where a cause is not in the model: bow (3,) of x^2, xy, y^2 in
    half diagonals, m; focus (n, 1); motion (n, 3) during the readout of a whole image, m; lens
    (5 or more,), the terms of `lens_terms`. sizes: the causes that were added, with their
    coefficients' rms.
    """

    camera: Intrinsics
    estimated: Floats
    poses: Floats
    corners: CornerTable
    names: tuple[str, ...]
    centre: Floats
    half_diagonal: float
    values: dict[str, Floats]
    sizes: dict[str, float]

    @classmethod
    def of(cls, result: IntrinsicsResult) -> Calibration:
        """A fit as a model without causes."""
        detections, points = result.detections, result.points
        n, centre = len(detections), points.mean(axis=0)
        ids = np.concatenate([d.ids for d in detections])
        pixels = np.concatenate([d.pixels for d in detections])
        view = np.repeat(np.arange(n), [len(d.ids) for d in detections])
        estimated = selection(result.names)
        left_out = int((~estimated[4:].any(axis=1)).sum())
        corners = CornerTable(points[ids], pixels, view, ids)
        names = tuple(d.name or f"view {i}" for i, d in enumerate(detections))
        half_diagonal = float(np.linalg.norm(points - centre, axis=1).max())
        values = {BOW: np.zeros(3), LENS: np.zeros(5 + left_out)}
        values |= {cause: np.zeros((n, width)) for cause, width in OWN.items()}
        camera, poses = result.intrinsics, result.T_camera_board
        return cls(camera, estimated, poses, corners, names, centre, half_diagonal, values, {})

    @cached_property
    def views(self) -> NDArray[np.intp]:
        """The views that have corners."""
        return np.unique(self.corners.view)

    @cached_property
    def index(self) -> NDArray[np.intp]:
        """The place (N,) of each corner's view among `views`."""
        return np.searchsorted(self.views, self.corners.view)

    @cached_property
    def linear(self) -> Linear:
        """Residuals and derivatives at the corners."""
        corners, camera, values = self.corners, self.camera, self.values
        R, t = self.poses[corners.view, :3, :3], self.poses[corners.view, :3, 3]
        shape = bow_shape(self, corners.points)
        on_board = corners.points + (shape @ values[BOW])[:, None] * NORMAL
        still = np.einsum("nij,nj->ni", R, on_board) + t
        # The row at which a corner was seen is measured: nothing has to be solved for it.
        time = (corners.pixels[:, 1] + 0.5) / camera.height - 0.5
        points = still + time[:, None] * values[SHUTTER][corners.view]
        pixels, by_camera, by_point = project_with_derivatives(points, camera)
        left_out = by_camera[:, :, 4:][:, :, ~self.estimated[4:].any(axis=1)]
        terms = lens_terms(points[:, :2] / points[:, 2:]) * np.array([[camera.fx], [camera.fy]])
        terms = np.concatenate([terms, left_out], axis=2)
        principal = np.array([camera.cx, camera.cy])
        from_axis = pixels - principal + terms @ values[LENS]
        scale = 1.0 + values[FOCUS][corners.view][:, :, None]
        by_point = by_point * scale
        by_camera = by_camera * scale
        by_camera[:, [0, 1], [2, 3]] = 1.0
        columns = {
            BOW: np.einsum("nij,nj->ni", by_point, R[:, :, 2])[..., None] * shape[:, None, :],
            FOCUS: from_axis[..., None],
            SHUTTER: by_point * time[:, None, None],
            LENS: terms * scale,
        }
        shared = [by_camera @ self.estimated, *(columns[c] for c in self.sizes if c not in OWN)]
        own = [twist_columns(points, by_point), *(columns[c] for c in self.sizes if c in OWN)]
        return Linear(
            corners.pixels - principal - from_axis * scale[:, 0],
            np.concatenate(shared, axis=2),
            np.concatenate(own, axis=2),
            columns,
        )

    def projection(self, weights: Floats | None = None) -> Projection:
        """The residuals without what the model imitates; weights (N,), one a corner."""
        linear, view = self.linear, np.repeat(self.corners.view, 2)
        own = linear.own.reshape(len(view), -1)
        blocks = [(rows, own[rows]) for rows in (np.flatnonzero(view == v) for v in self.views)]
        residuals, shared = linear.residuals.ravel(), linear.shared.reshape(len(view), -1)
        by_row = None if weights is None else np.repeat(weights, 2)
        return Projection(residuals, shared, blocks, by_row)

    @cached_property
    def plain(self) -> Projection:
        """`projection` with all corners alike."""
        return self.projection()

    # --- the search ---

    def hypotheses(self) -> Iterator[Hypothesis]:
        """The physical causes that were not added, the worst view, and corners far out."""
        for cause in PHYSICAL:
            if cause not in self.sizes:
                yield self.hypothesis(cause)
        rms = self._rms_by_view()
        if len(rms) >= 4 and len(self.names) - len(rms) < len(rms) // 4:
            worst = int(self.views[rms.argmax()])
            rows = np.flatnonzero(np.repeat(self.corners.view == worst, 2))
            yield _free(SPOILED_VIEW, rows, at=worst, tried=len(rms))
        wrong = self._wrong_corners()
        if len(wrong):
            yield _free(BAD_CORNERS, np.column_stack([2 * wrong, 2 * wrong + 1]).ravel())

    def hypothesis(self, cause: str) -> Hypothesis:
        """A physical cause: one set of columns for all views, or one set a view."""
        columns = self.linear.columns[cause]
        n, _, width = columns.shape
        if cause in OWN:
            by_view = np.zeros((n, 2, len(self.views), width))
            by_view[np.arange(n), :, self.index] = columns
            columns = by_view
        columns = columns.reshape(2 * n, -1)
        if cause == LENS:  # terms of different units: each as the px that it moves corners by
            columns = columns / np.sqrt(np.mean(columns**2, axis=0) + 1e-300)
        return Hypothesis(cause, columns, typical=TYPICAL[cause])

    def tested(self, hypotheses: Sequence[Hypothesis]) -> list[Tested]:
        """The test of each hypothesis."""
        return [self.test(hypothesis) for hypothesis in hypotheses]

    def test(self, hypothesis: Hypothesis) -> Tested:
        """One hypothesis; a physical cause has its p-value from weights after each view's noise.

        The variance of each view is taken from what remains after the cause, so that the cause
        itself does not pass for noise; with noisier views (blur) the plain F would be too large
        too often.
        """
        explained = self.plain.explains(hypothesis)
        test = explained.tested()
        if test.cause not in PHYSICAL:
            return test
        fair = self.projection(self._noise_weights(explained))
        return replace(test, log_p=fair.explains(hypothesis).log_p)

    def matters(self, test: Tested) -> bool:
        """Whether a view stands out from the others; the rest is for the findings to say."""
        if test.cause != SPOILED_VIEW:
            return True
        rms = self._rms_by_view()
        others = float(np.median(np.delete(rms, rms.argmax())))
        return test.size >= max(SPOILED_RATIO * others, SPOILED_PX)

    def accept(self, test: Tested) -> Calibration:
        """The calibration with a cause added, or corners set aside, fitted again."""
        if test.cause in PHYSICAL:
            return refit(replace(self, sizes={**self.sizes, test.cause: max(test.size, 1e-12)}))
        return refit(replace(self, corners=self.corners.keep(~self.corners_of(test))))

    def corners_of(self, test: Tested) -> Mask:
        """The corners (N,) that a spoiled view or bad corners concern."""
        mask = np.zeros(len(self.corners.view), bool)
        mask[np.asarray(test.hypothesis.rows) // 2] = True
        return mask

    def _rms_by_view(self) -> Floats:
        squares = (self.plain.residuals.reshape(-1, 2) ** 2).mean(axis=1)
        return np.sqrt(np.bincount(self.index, squares) / np.bincount(self.index))

    def _wrong_corners(self) -> NDArray[np.intp]:
        """Single corners too far out for the noise of the session and of their view."""
        length = np.linalg.norm(self.plain.residuals.reshape(-1, 2), axis=1)
        sigma = np.full(len(length), np.median(length))
        for view in self.views:
            mine = self.corners.view == view
            sigma[mine] = np.maximum(sigma[mine], np.median(length[mine]))
        limit = np.sqrt(2 * np.log(len(length) / CHANCE_LEVEL)) / RAYLEIGH_MEDIAN
        return np.flatnonzero((length > limit * sigma) & (length > BAD_CORNER_PX))

    def _noise_weights(self, explained: Explained) -> Floats:
        """1 / sigma of each corner (N,), from the residuals of its view, shrunk to the common."""
        squares = (explained.after.reshape(-1, 2) ** 2).sum(axis=1)
        dof = max(explained.dof - int(explained.visible.sum()), 1)
        common, own_dof = squares.sum() / dof, np.bincount(self.index) * dof / len(squares)
        own = np.bincount(self.index, squares)
        variance = (own + SHRINK_DOF * common) / (own_dof + SHRINK_DOF)
        return np.maximum(variance, 1e-300)[self.index] ** -0.5


def _free(cause: str, rows: NDArray[np.intp], at: int = 0, tried: int = 1) -> Hypothesis:
    """Single coordinates that may be anything."""
    return Hypothesis(cause, np.eye(len(rows)), at, rows, TYPICAL[cause], tried)


def search_residuals(result: IntrinsicsResult) -> CauseSearch[Calibration]:
    """The causes that the residuals of a calibration speak for, the strongest first."""
    return search(refit(Calibration.of(result)), CHANCE_LEVEL)


def kept(model: Calibration, detections: Sequence[Detection]) -> Detections:
    """The detections without the views and corners that were set aside."""
    left = []
    for view in model.views:
        d = detections[view]
        mine = np.isin(d.ids, model.corners.ids[model.corners.view == view])
        if mine.sum() >= MIN_CORNERS:
            left.append(replace(d, ids=d.ids[mine], pixels=d.pixels[mine]))
    return Detections(left)


def sag(model: Calibration) -> tuple[float, float]:
    """How far the bowed board's corners lie out of a plane, top to bottom, and its sigma, m."""
    shape = bow_shape(model, np.unique(model.corners.points, axis=0))
    z = shape @ model.values[BOW]
    between = shape[z.argmax()] - shape[z.argmin()]
    sizes = {cause: size for cause, size in model.sizes.items() if cause != BOW}
    without = replace(model, sizes=sizes)
    covariance = without.plain.explains(without.hypothesis(BOW)).covariance
    return float(between @ model.values[BOW]), math.sqrt(float(between @ covariance @ between))


# --- the model ---


def bow_shape(model: Calibration, points: Floats) -> Floats:
    """The three shapes (N, 3) of a bow: x^2, xy, y^2 from the board's centre in half diagonals."""
    x, y = ((points - model.centre)[:, :2] / model.half_diagonal).T
    return np.stack([x * x, x * y, y * y], axis=1)


def lens_terms(xy: Floats) -> Floats:
    """Distortions that Brown-Conrady lacks, (N, 2, 5): r^8, and thin prisms in r^2 and r^4.

    xy (N, 2): normalised coordinates. Source: OpenCV's s1..s4; its rational model differs from
    Brown-Conrady first of all in r^8.
    """
    r2 = (xy**2).sum(axis=1)
    terms = np.zeros((len(xy), 2, 5))
    terms[:, :, 0] = xy * r2[:, None] ** 4
    for axis, column, power in ((0, 1, r2), (1, 2, r2), (0, 3, r2**2), (1, 4, r2**2)):
        terms[:, axis, column] = power
    return terms


def refit(model: Calibration) -> Calibration:
    """Levenberg-Marquardt over the camera, the poses and the causes of the model.

    Views without tilt leave a direction open in which an undamped step runs away.
    """
    squares, damping = _squares(model), LEAST_DAMPING
    for _ in range(REFIT_STEPS):
        trial = _moved(model, *_step(model, damping))
        now = np.inf if trial is None else _squares(trial)
        if trial is None or not now <= squares:
            damping *= 10.0
            if damping > MOST_DAMPING:
                break
            continue
        small = squares - now <= SMALL_DECREASE * squares
        model, squares, damping = trial, now, max(damping / 10.0, LEAST_DAMPING)
        if small:
            break
    return model


def _squares(model: Calibration) -> float:
    with np.errstate(all="ignore"):
        return float((model.linear.residuals**2).sum()) + float((_prior(model)[1] ** 2).sum())


def _prior(model: Calibration) -> tuple[Floats, Floats]:
    """Of the views' own causes: px a coefficient (k,), and what they amount to (views, k), px.

    Coefficients are held towards 0 as by one corner coordinate of noise PRIOR_PX each.
    """
    own = [cause for cause in model.sizes if cause in OWN]
    weights = [np.full(OWN[cause], PRIOR_PX / model.sizes[cause]) for cause in own]
    values = [np.zeros((len(model.views), 0)), *(model.values[cause][model.views] for cause in own)]
    weight = np.concatenate([np.zeros(0), *weights])
    return weight, np.concatenate(values, axis=1) * weight


def _step(model: Calibration, damping: float) -> tuple[Floats, Floats]:
    """The damped step of what is shared (g,) and of each view's own (views, w)."""
    linear = model.linear
    g, width = linear.shared.shape[2], linear.own.shape[2]
    weight, prior = _prior(model)
    weak = np.eye(width)[6:] * np.concatenate([np.ones(6), weight])
    sizes = np.linalg.norm(linear.shared, axis=(0, 1))
    damp = np.sqrt(damping / len(model.views)) * np.diag(sizes)
    s, b, r = [], [], []
    for index, view in enumerate(model.views):
        rows = model.corners.view == view
        mine = linear.own[rows].reshape(-1, width)
        damp_own = np.sqrt(damping) * np.diag(np.linalg.norm(mine, axis=0))
        s += [linear.shared[rows].reshape(-1, g), np.zeros((len(weak) + width, g)), damp]
        b.append(np.concatenate([mine, weak, damp_own, np.zeros((g, width))]))
        r += [linear.residuals[rows].ravel(), -prior[index], np.zeros(width + g)]
    return NormalEquations(np.concatenate(s), b, np.concatenate(r)).step()


def _moved(model: Calibration, shared: Floats, own: Floats) -> Calibration | None:
    """The model after a step, None where that leads to no camera."""
    p = model.estimated.shape[1]
    parameters = parameter_vector(model.camera) + model.estimated @ shared[:p]
    if not (np.isfinite(parameters).all() and (parameters[:2] > 0).all()):
        return None
    poses, values = model.poses.copy(), dict(model.values)
    poses[model.views] = moved(poses[model.views], own[:, :6])
    at_shared, at_own = p, 6
    for cause in model.sizes:
        value = values[cause] = values[cause].copy()
        if cause in OWN:
            value[model.views] += own[:, at_own : at_own + OWN[cause]]
            at_own += OWN[cause]
        else:
            value += shared[at_shared : at_shared + len(value)]
            at_shared += len(value)
    camera = with_parameters(model.camera, parameters)
    return replace(model, camera=camera, poses=poses, values=values)


# --- the bow alone ---


@dataclass(frozen=True, eq=False, repr=False)
class Bow:
    """The shape of the board that explains the corners best, and the camera that goes with it.

    sag_m: how far the middle stands out towards the viewer over the board's four outermost corners
    (their mean), m; negative for a hollow board. sigma_m: its standard deviation.
    coefficients (3,), covariance (3, 3): of z = a x^2 + b x y + c y^2, 1/m, x and y in m from the
    mean of the corners and z into the board. p_value: how often a flat board with the same corner
    noise gives a bow at least as significant (F-test). result: the camera fitted with the bow.
    """

    sag_m: float
    sigma_m: float
    coefficients: Floats
    covariance: Floats
    p_value: float
    result: IntrinsicsResult

    def interval_m(self, level: float = 0.95) -> Interval:
        """The interval that holds the sag with probability `level`, m."""
        half = self.result.quantile(level) * self.sigma_m
        return self.sag_m - half, self.sag_m + half

    def __repr__(self) -> str:
        half = 1e3 * self.result.quantile() * self.sigma_m
        found = "a bow" if self.p_value < BOW_LEVEL else "no more than a flat board would show"
        return (
            f"the board's middle stands out by {1e3 * self.sag_m:+.2f} ± {half:.2f} mm (95 %):\n"
            f"{found} ({p_text(self.p_value)})"
        )


def fit_bow(result: IntrinsicsResult) -> Bow:
    """The bow of the board, fitted along with all that `result` fitted.

    Its covariances include what the unknown bow costs; `Bow.result.converged` says whether the
    solver arrived. The sag is that of the four outermost corners' mean, not of the largest: that
    one would be chosen by the noise. Of a twist it sees nothing; the coefficients and the F-test
    do.
    """
    from scipy.stats import f

    model = refit(replace(Calibration.of(result), sizes={BOW: TYPICAL[BOW]}))
    shape = bow_shape(model, result.points) * model.half_diagonal**2
    coefficients = model.values[BOW] / model.half_diagonal**2
    bowed = evaluate(
        model.camera,
        model.poses,
        result.detections,
        result.board,
        result.points + (shape @ coefficients)[:, None] * NORMAL,
        result.names,
        result.model,
        {name: z[:, None] * NORMAL for name, z in zip(BOW_NAMES, shape.T, strict=True)},
    )
    covariance = bowed.sigma_px**2 * bowed.equations.shared_covariance[-3:, -3:]
    columns, rows = result.board.corners
    outermost = shape[[0, columns - 1, (rows - 1) * columns, rows * columns - 1]].mean(axis=0)
    flat, bent = (float(np.sum(r.equations.residuals**2)) for r in (result, bowed))
    return Bow(
        # With the old origin z points out of the board.
        sag_m=float(outermost @ coefficients) * (-1 if result.board.old_origin else 1),
        sigma_m=math.sqrt(float(outermost @ covariance @ outermost)),
        coefficients=coefficients,
        covariance=covariance,
        p_value=float(f.sf(max(0.0, flat - bent) / 3 / (bent / bowed.dof), 3, bowed.dof)),
        result=bowed,
    )
