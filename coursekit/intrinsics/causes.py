"""The calibration model extended: curved board, focal length and motion of each view, a lens.

Beside camera and poses, each cause that can spoil a session has its columns here, whether it is in
the model or not: those in the model are fitted, the others are tested (`intrinsics.causes`).

A board that is not flat: its bow fitted along with the camera.

A bow puts corners a millimetre off the plane, and the fit pays with the focal length and k1 rather
than with the residuals. Three coefficients of a quadratic form are enough to take it out:
z = a x^2 + b x y + c y^2 over the board's middle; constant and linear terms are poses.

What else could explain the residuals of a calibration: F-tests for physical causes.

A fit leaves residuals r and has the Jacobian J (camera and poses). A cause that was left out of
the model, such as the curvature of the board, would add columns E. Whatever J can imitate is taken
out of E first; what E then explains of r, per column, over what remains, per degree of freedom, is
distributed as F(k, dof - k) when the cause is absent and the noise is Gaussian. Where several
causes explain something, the one that the data prefer is added to the model, the model is fitted
again, and the others are tested once more: most causes imitate each other a little.

Source: Seber and Lee, "Linear Regression Analysis" (2003), chapter 4; the choice between causes
is by restricted likelihood, see `Explained.best_size`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from coursekit.arrays import Floats, Interval, Mask, NDArray
from coursekit.boards import Board, Detection, Detections
from coursekit.geometry import Intrinsics, moved
from coursekit.intrinsics.derivatives import (
    NormalEquations,
    parameter_vector,
    project_with_derivatives,
    selection,
    twist_columns,
    with_parameters,
)
from coursekit.intrinsics.fit import (
    ARRIVED_PX,
    MIN_CORNERS,
    IntrinsicsResult,
    evaluate,
)
from coursekit.words import p_text

BOW, FOCUS, SHUTTER, LENS = "bowed_board", "focus_drift", "rolling_shutter", "lens_model"
OWN = {FOCUS: 1, SHUTTER: 3}  # columns of the causes that each view has of its own
PRIOR_PX = 0.1  # corner noise against which a cause's size is weighed in a refit
STEPS, ARRIVED = 40, 1e-7
LEAST_DAMPING, MOST_DAMPING = 1e-12, 1.0  # of the columns' own squares


@dataclass(frozen=True, eq=False)
class Data:
    """The corners of all views in one row: board points (N, 3), pixels (N, 2), view (N,), id (N,).

    Views are those of `names`; `height` is the image's, px.
    """

    points: Floats
    pixels: Floats
    view: NDArray[np.intp]
    ids: NDArray[np.intp]
    names: tuple[str, ...]
    height: int

    def keep(self, mask: Mask) -> Data:
        """The corners under the mask (N,)."""
        return replace(
            self,
            points=self.points[mask], pixels=self.pixels[mask],
            view=self.view[mask], ids=self.ids[mask],
        )  # fmt: skip

    @property
    def views(self) -> NDArray[np.intp]:
        """The views that have corners."""
        return np.unique(self.view)


@dataclass(frozen=True, eq=False)
class Model:
    """A camera, the board's pose in each view, and the causes that were added.

    estimated (p,): the columns of the nine camera parameters that are fitted, as (9, p). bow (3,):
    coefficients of x^2, xy, y^2 in the board's half diagonals, m. focal (n,): relative to the
    common one. motion (n, 3): of the board during the readout of a whole image, m. lens (5,):
    the terms of `lens_terms`. sizes: the causes that were added, with their coefficients' rms.
    """

    camera: Intrinsics
    estimated: Floats
    poses: Floats
    centre: Floats
    half_diagonal: float
    bow: Floats
    focal: Floats
    motion: Floats
    lens: Floats
    sizes: dict[str, float] = field(default_factory=dict)

    @property
    def causes(self) -> tuple[str, ...]:
        """The causes that were added."""
        return tuple(self.sizes)


@dataclass(frozen=True, eq=False)
class Linear:
    """A model at its data: residuals (N, 2) and derivatives, (N, 2, columns) each."""

    residuals: Floats
    camera: Floats
    pose: Floats
    columns: dict[str, Floats]


def begin(result: IntrinsicsResult) -> tuple[Model, Data]:
    """A fit as a model without causes, and its corners."""
    detections, points = result.detections, result.points
    counts = [len(d.ids) for d in detections]
    ids = np.concatenate([d.ids for d in detections])
    data = Data(
        points[ids], np.concatenate([d.pixels for d in detections]),
        np.repeat(np.arange(len(detections)), counts), ids,
        tuple(d.name or f"view {i}" for i, d in enumerate(detections)), result.intrinsics.height,
    )  # fmt: skip
    n = len(detections)
    centre = points.mean(axis=0)
    half_diagonal = float(np.linalg.norm(points - centre, axis=1).max())
    estimated = selection(result.names)
    missing = int((~estimated[4:].any(axis=1)).sum())
    model = Model(
        result.intrinsics, estimated, result.T_camera_board, centre, half_diagonal,
        np.zeros(3), np.ones(n), np.zeros((n, 3)), np.zeros(5 + missing),
    )  # fmt: skip
    return model, data


def bow_shape(model: Model, points: Floats) -> Floats:
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


def linearise(model: Model, data: Data) -> Linear:
    """Residuals and derivatives of a model at data."""
    R, t = model.poses[data.view, :3, :3], model.poses[data.view, :3, 3]
    shape = bow_shape(model, data.points)
    on_board = data.points + (shape @ model.bow)[:, None] * [0.0, 0.0, 1.0]
    still = np.einsum("nij,nj->ni", R, on_board) + t
    # The row at which a corner was seen is measured: nothing has to be solved for it.
    time = (data.pixels[:, 1] + 0.5) / data.height - 0.5
    points = still + time[:, None] * model.motion[data.view]
    pixels, by_camera, by_point = project_with_derivatives(points, model.camera)
    principal = np.array([model.camera.cx, model.camera.cy])
    focal = np.array([model.camera.fx, model.camera.fy])
    left_out = by_camera[:, :, 4:][:, :, ~model.estimated[4:].any(axis=1)]
    terms = lens_terms(points[:, :2] / points[:, 2:]) * focal[:, None]
    terms = np.concatenate([terms, left_out], axis=2)
    from_axis = pixels - principal + terms @ model.lens
    scale = model.focal[data.view][:, None, None]
    by_point = by_point * scale
    by_camera = by_camera * scale
    by_camera[:, [0, 1], [2, 3]] = 1.0
    columns = {
        BOW: np.einsum("nij,nj->ni", by_point, R[:, :, 2])[..., None] * shape[:, None, :],
        FOCUS: from_axis[..., None],
        SHUTTER: by_point * time[:, None, None],
        LENS: terms * scale,
    }
    predicted = principal + from_axis * scale[:, 0]
    return Linear(
        data.pixels - predicted, by_camera @ model.estimated, twist_columns(points, by_point),
        columns,
    )  # fmt: skip


def refit(model: Model, data: Data) -> Model:
    """Levenberg-Marquardt over the camera, the poses and the causes of the model.

    Views without tilt leave a direction open in which an undamped step runs away.
    """
    squares, damping = _squares(model, data), LEAST_DAMPING
    for _ in range(STEPS):
        trial = _moved(model, data, *_step(model, data, damping))
        now = np.inf if trial is None else _squares(trial, data)
        if trial is None or not now <= squares:
            damping *= 10.0
            if damping > MOST_DAMPING:
                break
            continue
        small = squares - now <= ARRIVED * squares
        model, squares, damping = trial, now, max(damping / 10.0, LEAST_DAMPING)
        if small:
            break
    return model


def _squares(model: Model, data: Data) -> float:
    with np.errstate(all="ignore"):
        residuals = linearise(model, data).residuals
    return float((residuals**2).sum()) + float(sum((v**2).sum() for v in _prior(model, data)))


def _prior(model: Model, data: Data) -> list[Floats]:
    """The views' own quantities over their prior standard deviations, in px, (views, l) each."""
    own = {FOCUS: model.focal[:, None] - 1.0, SHUTTER: model.motion}
    return [
        PRIOR_PX * own[cause][data.views] / model.sizes[cause]
        for cause in model.causes
        if cause in OWN
    ]


def _step(model: Model, data: Data, damping: float) -> tuple[Floats, Floats]:
    linear = linearise(model, data)
    shared = [linear.camera] + [linear.columns[c] for c in model.causes if c not in OWN]
    own = [linear.pose] + [linear.columns[c] for c in model.causes if c in OWN]
    shared_rows, own_rows = np.concatenate(shared, axis=2), np.concatenate(own, axis=2)
    g, width = shared_rows.shape[2], own_rows.shape[2]
    widths = [np.full(OWN[c], PRIOR_PX / model.sizes[c]) for c in model.causes if c in OWN]
    weak = np.eye(width)[6:] * np.concatenate([np.ones(6), *widths])
    prior = np.concatenate([np.zeros((len(data.views), 0)), *_prior(model, data)], axis=1)
    damp = np.sqrt(damping / len(data.views)) * np.diag(np.linalg.norm(shared_rows, axis=(0, 1)))
    s, b, r = [], [], []
    for index, view in enumerate(data.views):
        rows = data.view == view
        mine = own_rows[rows].reshape(-1, width)
        damp_own = np.sqrt(damping) * np.diag(np.linalg.norm(mine, axis=0))
        s += [shared_rows[rows].reshape(-1, g), np.zeros((len(weak) + width, g)), damp]
        b.append(np.concatenate([mine, weak, damp_own, np.zeros((g, width))]))
        r += [linear.residuals[rows].ravel(), -prior[index], np.zeros(width + g)]
    return NormalEquations(np.concatenate(s), b, np.concatenate(r)).step()


def _moved(model: Model, data: Data, shared: Floats, own: Floats) -> Model | None:
    """The model after a step, None where that leads to no camera."""
    p = model.estimated.shape[1]
    parameters = parameter_vector(model.camera) + model.estimated @ shared[:p]
    if not (np.isfinite(parameters).all() and (parameters[:2] > 0).all()):
        return None
    camera = with_parameters(model.camera, parameters)
    poses = model.poses.copy()
    poses[data.views] = moved(poses[data.views], own[:, :6])
    values = {BOW: model.bow, LENS: model.lens, FOCUS: model.focal, SHUTTER: model.motion}
    at_shared, at_own = p, 6
    for cause in model.causes:
        value = values[cause].copy()
        if cause in OWN:
            width = OWN[cause]
            value[data.views] += own[:, at_own : at_own + width].reshape(value[data.views].shape)
            at_own += width
        else:
            value += shared[at_shared : at_shared + len(value)]
            at_shared += len(value)
        values[cause] = value
    return replace(
        model, camera=camera, poses=poses, bow=values[BOW], lens=values[LENS],
        focal=values[FOCUS], motion=values[SHUTTER],
    )  # fmt: skip


NAMES = ("bow_xx", "bow_xy", "bow_yy")
STEPS = 30
HALVINGS = 10
SURE = 0.01  # a bow less likely than this by chance is one


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
        found = "a bow" if self.p_value < SURE else "no more than a flat board would show"
        return (
            f"the board's middle stands out by {1e3 * self.sag_m:+.2f} ± {half:.2f} mm (95 %):\n"
            f"{found} ({p_text(self.p_value)})"
        )


def fit_bow(result: IntrinsicsResult) -> Bow:
    """The bow of the board, fitted along with all that `result` fitted.

    Gauss-Newton from the flat board until it moves no more; `Bow.result.converged` says whether it
    arrived. Its covariances include what the unknown bow costs.
    """
    shapes = _shapes(result.points)
    coefficients, bowed = np.zeros(len(NAMES)), _evaluate(result, shapes, np.zeros(len(NAMES)))
    for _ in range(STEPS):
        if bowed.equations.decrease() < ARRIVED_PX**2 * len(bowed.equations.residuals):
            break
        better = _bow_step(bowed, result, shapes, coefficients)
        if better is None:
            break
        coefficients, bowed = better
    covariance = bowed.sigma_px**2 * bowed.equations.shared_covariance[-3:, -3:]
    sag, sigma = _sag(result.board, shapes, coefficients, covariance)
    return Bow(
        sag_m=-sag if result.board.old_origin else sag,  # there z points out of the board
        sigma_m=sigma,
        coefficients=coefficients,
        covariance=covariance,
        p_value=_p_value(result, bowed),
        result=bowed,
    )


def _shapes(points: Floats) -> Floats:
    """x^2, x y, y^2 of the corners (N, 3), from their mean, m^2."""
    x, y = (points[:, :2] - points[:, :2].mean(axis=0)).T
    return np.stack([x * x, x * y, y * y], axis=1)


def _evaluate(
    result: IntrinsicsResult,
    shapes: Floats,
    coefficients: Floats,
    intrinsics: Intrinsics | None = None,
    poses: Floats | None = None,
) -> IntrinsicsResult:
    """`result` on a bowed board, at other intrinsics and poses where they are given."""
    into_board = np.array([0.0, 0.0, 1.0])
    return evaluate(
        result.intrinsics if intrinsics is None else intrinsics,
        result.T_camera_board if poses is None else poses,
        result.detections,
        result.board,
        result.points + (shapes @ coefficients)[:, None] * into_board,
        result.names,
        result.model,
        {name: shapes[:, i, None] * into_board for i, name in enumerate(NAMES)},
    )


def _bow_step(
    bowed: IntrinsicsResult, result: IntrinsicsResult, shapes: Floats, coefficients: Floats
) -> tuple[Floats, IntrinsicsResult] | None:
    """The Gauss-Newton step, halved until the residuals shrink; None where they do not."""
    shared, twists = bowed.equations.step()
    before = float(bowed.equations.residuals @ bowed.equations.residuals)
    for scale in 0.5 ** np.arange(HALVINGS):
        change = selection(result.names) @ (scale * shared[: len(result.names)])
        parameters = parameter_vector(bowed.intrinsics) + change
        if (parameters[:2] <= 0).any():
            continue
        lens = with_parameters(bowed.intrinsics, parameters)
        bow = coefficients + scale * shared[-len(NAMES) :]
        after = _evaluate(result, shapes, bow, lens, moved(bowed.T_camera_board, scale * twists))
        if float(after.equations.residuals @ after.equations.residuals) < before:
            return bow, after
    return None


def _sag(board: Board, shapes: Floats, coefficients: Floats, covariance: Floats) -> Interval:
    """z of the four outermost corners over the middle, and its standard deviation, m.

    Their mean, not the largest: that one would be chosen by the noise. Of a twist it sees nothing;
    the coefficients and the F-test do.
    """
    columns, rows = board.corners
    outermost = shapes[[0, columns - 1, (rows - 1) * columns, rows * columns - 1]].mean(axis=0)
    return float(outermost @ coefficients), math.sqrt(float(outermost @ covariance @ outermost))


def _p_value(flat: IntrinsicsResult, bowed: IntrinsicsResult) -> float:
    """The F-test of the three coefficients."""
    from scipy.stats import f

    squares = [float(r.equations.residuals @ r.equations.residuals) for r in (flat, bowed)]
    gain = max(0.0, squares[0] - squares[1]) / len(NAMES)
    return float(f.sf(gain / (squares[1] / bowed.dof), len(NAMES), bowed.dof))


PHYSICAL = (BOW, FOCUS, SHUTTER, LENS)
VIEW, CORNERS = "spoiled_view", "bad_corners"
# At most 2 % of healthy sessions may get a finding. Six kinds of test at this level make 0.2 %; the
# rest is for noise that is not quite Gaussian and for the checks that are no F-tests.
LEVEL = 3e-4
SPOILED_RATIO = 3.0  # a view's rms over the others' median; blurred or far views reach 2
SPOILED_PX = 0.2  # and at least this: what is a good corner's noise in a poor image
BAD_CORNER_PX = 0.5  # a wrong corner is off by pixels; good ones stay below 5 sigma of 0.1 px
# What a cause's coefficients are when it matters: bow, relative focal length, motion during the
# readout in m, px for the rest.
TYPICAL = {BOW: 5e-4, FOCUS: 0.01, SHUTTER: 1e-3, LENS: 0.5, VIEW: 1.0, CORNERS: 1.0}
SHRINK_DOF = 30.0  # per-view variances are drawn to the common one as by this many observations
MOST_ROUNDS = 8


@dataclass(frozen=True, eq=False)
class Tested:
    """One cause: the log-likelihood (times 2) that it gains, the F-test's p-value, its size."""

    cause: str
    gain: float
    p_value: float
    size: float
    which: tuple[int, ...] = ()  # the view, or the rows of the corners


@dataclass(eq=False)
class Search:
    """The end of the search: the model with its causes, the data kept, and what was set aside."""

    plain: Model  # without any cause
    model: Model
    data: Data
    tests: dict[str, Tested] = field(default_factory=dict)
    spoiled: list[tuple[int, float, float]] = field(default_factory=list)  # view, rms, others' rms
    corners: list[tuple[int, int, float]] = field(default_factory=list)  # view, id, px off

    def kept(self, detections: Sequence[Detection]) -> Detections:
        """The detections without the views and corners that were set aside."""
        kept = []
        for view in self.data.views:
            mine = np.isin(detections[view].ids, self.data.ids[self.data.view == view])
            if mine.sum() >= MIN_CORNERS:
                d = detections[view]
                kept.append(replace(d, ids=d.ids[mine], pixels=d.pixels[mine]))
        return Detections(kept)


def search(result: IntrinsicsResult) -> Search:
    """The causes that the residuals of a calibration speak for, the strongest first."""
    model, data = begin(result)
    model = refit(model, data)
    state = Search(model, model, data)
    for _ in range(MOST_ROUNDS):
        best = _strongest(state)
        if best is None:
            break
        _accept(state, best)
    return state


def sag(state: Search) -> tuple[float, float]:
    """How far the bowed board's corners lie out of a plane, top to bottom, and its sigma, m."""
    model, data = state.model, state.data
    shape = bow_shape(model, np.unique(data.points, axis=0))
    z = shape @ model.bow
    between = shape[z.argmax()] - shape[z.argmin()]
    linear = linearise(model, data)
    plain = Projector(replace(model, sizes=_without(model.sizes, BOW)), data, linear)
    columns = plain.remove(linear.columns[BOW].reshape(-1, 3))
    rest = Projector(model, data, linear)
    variance = float(rest.residuals @ rest.residuals) / (len(rest.residuals) - rest.rank)
    covariance = variance * np.linalg.inv(columns.T @ columns)
    return float(between @ model.bow), float(np.sqrt(between @ covariance @ between))


def _without(sizes: dict[str, float], cause: str) -> dict[str, float]:
    return {name: size for name, size in sizes.items() if name != cause}


class Projector:
    """Takes out of columns what the model's own parameters can imitate.

    weights (N,): one a corner, None for all alike. Rows are u, v of each corner.
    """

    def __init__(
        self, model: Model, data: Data, linear: Linear, weights: Floats | None = None
    ) -> None:
        shared = [linear.camera] + [linear.columns[c] for c in model.causes if c not in OWN]
        own = [linear.pose] + [linear.columns[c] for c in model.causes if c in OWN]
        self.weights = np.ones(2 * len(data.view)) if weights is None else np.repeat(weights, 2)
        self.rows = [np.flatnonzero(np.repeat(data.view == v, 2)) for v in data.views]
        per_view = self._weighted(np.concatenate(own, axis=2))
        self._own = [_basis(per_view[rows]) for rows in self.rows]
        self._shared = np.zeros((len(self.weights), 0))
        self._shared = _basis(self.remove(self._weighted(np.concatenate(shared, axis=2))))
        self.rank = sum(q.shape[1] for q in self._own) + self._shared.shape[1]
        self.residuals = self.remove(self._weighted(linear.residuals[..., None]))[:, 0]

    def _weighted(self, blocks: Floats) -> Floats:
        return blocks.reshape(len(self.weights), -1) * self.weights[:, None]

    def remove(self, columns: Floats) -> Floats:
        """`columns` (2N, k) without what the camera, the poses and the model's causes imitate."""
        left = columns.copy()
        for rows, q in zip(self.rows, self._own, strict=True):
            left[rows] -= q @ (q.T @ left[rows])
        return left - self._shared @ (self._shared.T @ left)

    def explains(self, columns: Floats, size: float) -> Explained:
        """What columns (2N, k) explain of the residuals.

        size: what their coefficients would typically be. Directions in which an effect of that
        size would stay below the noise are not tested: they would only dilute the test.
        """
        columns = columns * self.weights[:, None]
        left = self.remove(columns)
        values, vectors = np.linalg.eigh(left.T @ left)
        # What projects to less than 1e-5 of its size is imitated, but for rounding errors.
        well = values > 1e-10 * np.einsum("ij,ij->j", columns, columns).max(initial=1e-300)
        values, vectors = values[well], vectors[:, well]
        seen = vectors.T @ (left.T @ self.residuals) / np.sqrt(values)
        total = float(self.residuals @ self.residuals)
        dof = len(self.residuals) - self.rank
        visible = values * size**2 > total / dof
        coefficients = vectors[:, visible] @ (seen / np.sqrt(values))[visible]
        after = self.residuals - left @ coefficients
        return Explained(values, seen, total, dof, visible, after)


@dataclass(frozen=True, eq=False)
class Explained:
    """Residuals along the directions of a cause.

    strength (k,): squares that a coefficient of 1 along a direction would add. seen (k,): the
    residuals along it. total: all squares; dof: their degrees of freedom. visible (k,): the
    directions that are tested. after (2N,): residuals without what those explain.
    """

    strength: Floats
    seen: Floats
    total: float
    dof: int
    visible: Mask
    after: Floats

    @property
    def p_value(self) -> float:
        """Of the F-test: explained squares a column over the rest a degree of freedom."""
        from scipy.stats import f

        rank = int(self.visible.sum())
        if rank < 1 or self.dof - rank < 1:
            return 1.0
        squares = float((self.seen[self.visible] ** 2).sum())
        rest = max(self.total - squares, 1e-300) / (self.dof - rank)
        return float(f.sf(squares / rank / rest, rank, self.dof - rank))

    def best_size(self) -> tuple[float, float]:
        """The most likely rms of the coefficients, and twice the log-likelihood that it gains.

        Coefficients are taken as drawn from a normal distribution of that width (restricted
        maximum likelihood, Patterson and Thompson 1971): then three columns and ninety are
        compared on equal terms, one width each.
        """
        if not len(self.strength):
            return 0.0, 0.0
        ratios = np.concatenate([[0.0], np.geomspace(1e-3, 1e8, 200) / self.strength.max()])
        spread = 1.0 + ratios[:, None] * self.strength
        squares = self.total - (self.seen**2 * (1.0 - 1.0 / spread)).sum(axis=1)
        squares = np.maximum(squares, 1e-300)
        deviance = self.dof * np.log(squares / self.total) + np.log(spread).sum(axis=1)
        best = int(deviance.argmin())
        return float(np.sqrt(ratios[best] * squares[best] / self.dof)), float(-deviance[best])


def _basis(columns: Floats) -> Floats:
    """An orthonormal basis of the columns, without those that the others imitate."""
    size = np.linalg.norm(columns, axis=0)
    u, s, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
    return u[:, s > 1e-10 * s[0]]


def _dense(data: Data, cause: str, block: Floats) -> Floats:
    """A cause's columns (2N, k): one set for all views, or one set a view."""
    if cause not in OWN:
        columns = block.reshape(-1, block.shape[2])
        if cause == LENS:  # terms of different units: each as the px that it moves corners by
            columns = columns / np.sqrt(np.mean(columns**2, axis=0) + 1e-300)
        return columns
    width = block.shape[2]
    columns = np.zeros((len(block), 2, len(data.views), width))
    columns[np.arange(len(block)), :, np.searchsorted(data.views, data.view)] = block
    return columns.reshape(2 * len(block), -1)


def _strongest(state: Search) -> Tested | None:
    """The cause that explains most of those that are significant, or None."""
    model, data = state.model, state.data
    linear = linearise(model, data)
    plain = Projector(model, data, linear)
    candidates = [
        _test(plain, model, data, linear, cause, _dense(data, cause, linear.columns[cause]))
        for cause in PHYSICAL
        if cause not in model.causes
    ]
    candidates += [c for c in (_worst_view(plain, data, state), _wrong_corners(plain, data)) if c]
    significant = [c for c in candidates if c.p_value < LEVEL and c.gain > 0]
    return max(significant, key=lambda c: c.gain, default=None)


def _test(
    plain: Projector, model: Model, data: Data, linear: Linear, cause: str, columns: Floats
) -> Tested:
    """One cause: its size and gain with equal weights, the p-value with the views' own noise.

    The variance of each view is taken from what remains after the cause, so that the cause itself
    does not pass for noise; with noisier views (blur) the plain F would be too large too often.
    """
    explained = plain.explains(columns, TYPICAL[cause])
    size, gain = explained.best_size()
    weights = _noise_weights(plain, data, explained)
    fair = Projector(model, data, linear, weights).explains(columns, TYPICAL[cause])
    return Tested(cause, gain, fair.p_value, size)


def _noise_weights(plain: Projector, data: Data, explained: Explained) -> Floats:
    """1 / sigma of each corner (N,), from the residuals of its view, shrunk to the common one."""
    after: Floats = explained.after
    dof = max(explained.dof - int(explained.visible.sum()), 1)
    common = float(after @ after) / dof
    weights = np.empty(len(data.view))
    for view, rows in zip(data.views, plain.rows, strict=True):
        own_dof = len(rows) * dof / len(after)
        squares = float(after[rows] @ after[rows])
        variance = (squares + SHRINK_DOF * common) / (own_dof + SHRINK_DOF)
        weights[data.view == view] = max(variance, 1e-300) ** -0.5
    return weights


def _worst_view(plain: Projector, data: Data, state: Search) -> Tested | None:
    """The view whose removal explains most, if it stands out from the others."""
    rms = np.array([np.sqrt(np.mean(plain.residuals[rows] ** 2)) for rows in plain.rows])
    if len(rms) < 4 or len(state.spoiled) >= len(rms) // 4:
        return None
    worst = int(rms.argmax())
    explained = plain.explains(_rows(plain, plain.rows[worst]), TYPICAL[VIEW])
    size, gain = explained.best_size()
    if size < max(SPOILED_RATIO * np.median(np.delete(rms, worst)), SPOILED_PX):
        return None
    view = int(data.views[worst])
    return Tested(VIEW, gain, explained.p_value * len(rms), size, (view,))


def _wrong_corners(plain: Projector, data: Data) -> Tested | None:
    """Single corners too far out for the noise of the session and of their view."""
    length = np.linalg.norm(plain.residuals.reshape(-1, 2), axis=1)
    # The median of a Rayleigh distribution is 1.1774 sigma.
    sigma = np.full(len(length), np.median(length) / 1.1774)
    for view in data.views:
        mine = data.view == view
        sigma[mine] = np.maximum(sigma[mine], np.median(length[mine]) / 1.1774)
    limit = np.sqrt(2 * np.log(len(length) / LEVEL))
    wrong = np.flatnonzero((length > limit * sigma) & (length > BAD_CORNER_PX))
    if not len(wrong):
        return None
    rows = np.column_stack([2 * wrong, 2 * wrong + 1]).ravel()
    explained = plain.explains(_rows(plain, rows), TYPICAL[CORNERS])
    size, gain = explained.best_size()
    return Tested(CORNERS, gain, explained.p_value, size, tuple(wrong.tolist()))


def _rows(plain: Projector, rows: NDArray[np.intp]) -> Floats:
    """Columns (2N, k) that let single coordinates be anything."""
    columns = np.zeros((len(plain.weights), len(rows)))
    columns[rows, np.arange(len(rows))] = 1.0
    return columns


def _accept(state: Search, test: Tested) -> None:
    """Add a cause to the model, or set its corners aside, and fit again."""
    data = state.data
    state.tests.setdefault(test.cause, test)
    if test.cause == VIEW:
        state.data = data.keep(data.view != test.which[0])
    elif test.cause == CORNERS:
        state.data = data.keep(~np.isin(np.arange(len(data.view)), test.which))
    else:
        sizes = {**state.model.sizes, test.cause: max(test.size, 1e-12)}
        state.model = replace(state.model, sizes=sizes)
    state.model = refit(state.model, state.data)
    linear = linearise(state.model, state.data)
    if test.cause == VIEW:
        others = float(np.sqrt(np.mean(linear.residuals**2)))
        state.spoiled.append((test.which[0], test.size, others))
    elif test.cause == CORNERS:
        gone = data.keep(np.isin(np.arange(len(data.view)), test.which))
        off = np.linalg.norm(linearise(state.model, gone).residuals, axis=1)
        state.corners += zip(gone.view.tolist(), gone.ids.tolist(), off.tolist(), strict=True)
