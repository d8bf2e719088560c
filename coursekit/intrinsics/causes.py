"""What else could explain the residuals of a calibration: F-tests for physical causes.

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

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from coursekit.boards import Detections
from coursekit.intrinsics.extended import (
    BOW,
    FOCUS,
    LENS,
    OWN,
    SHUTTER,
    Data,
    Linear,
    Model,
    begin,
    bow_shape,
    linearise,
    refit,
)
from coursekit.intrinsics.fit import MIN_CORNERS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import NDArray

    from coursekit.boards import Detection
    from coursekit.intrinsics.fit import IntrinsicsResult

    Floats = NDArray[np.float64]
    Mask = NDArray[np.bool_]

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
