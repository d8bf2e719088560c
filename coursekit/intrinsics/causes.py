"""What the residuals of a calibration speak for: the board's shape, drifting focus, and more.

The model is the camera and the board's pose in each view, to which causes are added. Corner j, at
P_j on the board (m, z into it), is seen at

    p = R_i (P_j + (bow(P_j) + height_j + flex_i(P_j)) n + print_j) + t_i + time motion_i,
    pixel = c + drift_c number_i + (1 + focus_i + drift_f number_i) (K distort(p) + lens terms - c),

where bow is a quadratic form (constant and linear terms are poses), as flex_i is, that of a board
which bends from view to view, n the board's normal, height_j
and print_j what the corner is off out of the plane and in it, motion_i what the board moves while
view i is read out (time = -1/2 ... 1/2 from first row to last), focus_i the view's relative change
of the focal length, and number_i = -1/2 ... 1/2 over the session. Heights, prints, motions and
focus are drawn from normal distributions, one width each. Lens terms are smooth functions of the
place in the image. What is not in the model is 0 there and is tested by `coursekit.causes`: each
has its columns whether it is in the model or not. Two more hypotheses set data aside: a view, and
single corners, that do not fit the others.

What explains most is taken in first, and that is not yet a reason to name it: residuals of real
images hang together within a view, and something always explains a little of that. `named` asks
whether a cause explains what there is: with it the residuals are as small as the corners' noise, or
it takes most of what they hold beyond it. The noise is what is left when the board's shape and a
smooth field in each view are free (`Calibration.noise_px`), whatever the detector believes.

`fit_bow` fits the bow alone. It puts corners a millimetre off the plane, and a fit without it pays
with the focal length and k1 rather than with the residuals. `fit_shape` lets every corner be where
the views say.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from coursekit import causes as engine
from coursekit.arrays import Floats, Mask, NDArray
from coursekit.boards import Detection, Detections
from coursekit.boards.board import FEWEST_CORNERS
from coursekit.checks import want
from coursekit.geometry import Intrinsics, distort, moved
from coursekit.intrinsics import derivatives
from coursekit.intrinsics.fit import IntrinsicsResult, evaluate
from coursekit.words import p_text, say

BOW, HEIGHTS, FLEX = "bowed_board", "heights", "flexing_board"
STRETCH, PRINT = "stretch", "print"
DRIFT, FOCUS = "steady_drift", "focus_drift"
SHUTTER, LENS = "rolling_shutter", "lens_model"
SHAPE = (BOW, HEIGHTS, STRETCH, PRINT)  # of the board: four causes, one fault
PHYSICAL = (*SHAPE, FLEX, DRIFT, FOCUS, SHUTTER, LENS)
SPOILED_VIEW, BAD_CORNERS = "spoiled_view", "bad_corners"
OWN = {FLEX: 3, FOCUS: 1, SHUTTER: 3}  # columns of the causes that each view has of its own
# What a cause's coefficients are when it matters: bow, heights, print and motion during the readout
# in m on the course's board (in proportion on others: it is their effect on K that counts, and a
# square size that is wrong changes nothing), relative focal length, px for the rest.
TYPICAL = {
    BOW: 5e-4, HEIGHTS: 3e-4, STRETCH: 5e-4, PRINT: 1e-4, FLEX: 5e-4, DRIFT: 0.5, FOCUS: 0.01,
    SHUTTER: 1e-3, LENS: 0.5, SPOILED_VIEW: 1.0, BAD_CORNERS: 1.0,
}  # fmt: skip
GROWS_WITH_BOARD = (*SHAPE, FLEX, SHUTTER)
COURSE_BOARD_M = math.hypot(0.0875, 0.05)  # from its middle to its outermost corners
SHAPE_VIEWS, SHAPE_SIGHTS = 6, 5  # so many, and of each corner on average, tell a shape from noise
SMOOTH_DEGREE = 3  # of the field over the board that is no corner's noise
# One cause, beside the board's shape, after which nothing smooth is left explains the residuals;
# else it must take most of what they hold. Two of them together take a part of whatever there is.
FAIR = 3  # of the strongest causes are tested with each view's own noise
NOTHING_LEFT = 1e-3  # of the p-value: so seldom is a cause missed that is all there is
MOST, MOST_OF_SHAPE = 0.75, 0.5  # paper is never without a shape, whatever comes on top
LEAST_GAIN = 0.02  # of the variance of the noise: a lens that gains less is as good
MOST_MOTION_M = 0.03  # an axis, in the 20 ms of an image: beyond it there are smears, no corners
STIFF = 0.1  # nor is it stiff: that much of what its shape does changes from view to view
# At most 2 % of healthy sessions may get a finding. Six kinds of test at this level make 0.2 %; the
# rest is for noise that is not quite Gaussian and for the checks that are no F-tests.
CHANCE_LEVEL = 3e-4
BOW_LEVEL = 0.01  # a bow less likely than this by chance is one
PRIOR_PX = 0.1  # corner noise until residuals were looked at
LEAST_SHAPE_M = 1e-6
DENT_SIGMAS, DENT_M = 3.5, 2e-4  # of a corner that stands out from its board
LEAST_PX = 1e-6  # of noise, where exact corners have none
REFIT_STEPS, FISHEYE_STEPS = 40, 300
MIRROR_STEPS, MIRROR_DAMPING = 20, 1e-3
SMALL_DECREASE = 1e-7  # of the squares: a step that saves less is the last
LEAST_DAMPING, MOST_DAMPING = 1e-12, 1.0  # of the columns' own squares
SPOILED_RATIO = 3.0  # a view's rms over the others' median; blurred or far views reach 2
SPOILED_PX = 0.2  # and at least this: what is a good corner's noise in a poor image
BAD_CORNER_PX = 0.5  # a wrong corner is off by pixels; good ones stay below 5 sigma of 0.1 px
RAYLEIGH_MEDIAN = 1.1774  # the median length of two independent standard normal numbers
RAYLEIGH_99 = 3.0349 / RAYLEIGH_MEDIAN  # and the 99th percentile, in medians
HEAVIEST_TAIL = 1.35  # of corners that differ in noise by 30 %; beyond, one in a hundred is wrong
SIGMA_OF_MAD = 1.4826  # the standard deviation of a normal distribution, in median deviations
SHRINK_DOF = 30.0  # per-view variances are drawn to the common one as by this many observations


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
    T_camera_board. names: of the n views. board (m, 3): its corners, m; free: what they are free to
    do, see `free_shapes`. values: the coefficients of the causes, 0 where a cause is not in the
    model: bow (3,) of x^2, xy, y^2 in half diagonals, m; stretch (2,)
    as bow; heights (m - 3,) and print (2 m - 4,),
    m; flex (n, 3) as bow; drift (3,) over the session, of the focal length in per cent and of the
    centre in px; focus (n, 1); motion (n, 3) during the readout of a whole image, m; lens (8 or
    more,), the terms of `lens_terms`. sizes: the causes that were added, with their coefficients'
    rms. prior_px: the
    corners' noise against which those are weighed. project: how points become pixels, whose
    coefficients the camera's are.
    """

    camera: Intrinsics
    estimated: Floats
    poses: Floats
    corners: CornerTable
    names: tuple[str, ...]
    board: Floats
    free: tuple[Floats, Floats]
    values: dict[str, Floats]
    sizes: dict[str, float]
    prior_px: float = PRIOR_PX
    project: derivatives.Projector = derivatives.project_with_derivatives

    @classmethod
    def of(cls, result: IntrinsicsResult) -> Calibration:
        """A fit as a model without causes."""
        detections, points = result.detections, result.points
        n, free = len(detections), free_shapes(points)
        ids = np.concatenate([d.ids for d in detections])
        pixels = np.concatenate([d.pixels for d in detections])
        view = np.repeat(np.arange(n), [len(d.ids) for d in detections])
        estimated = derivatives.selection(result.names)
        left_out = int((~estimated[4:].any(axis=1)).sum())
        corners = CornerTable(points[ids], pixels, view, ids)
        names = tuple(d.name or f"view {i}" for i, d in enumerate(detections))
        widths = {BOW: 3, STRETCH: 2, DRIFT: 3, LENS: 8 + left_out}
        widths |= {HEIGHTS: free[0].shape[-1], PRINT: free[1].shape[-1]}
        values = {cause: np.zeros(width) for cause, width in widths.items()}
        values |= {cause: np.zeros((n, width)) for cause, width in OWN.items()}
        camera, poses = result.intrinsics, result.T_camera_board
        return cls(camera, estimated, poses, corners, names, points, free, values, {})

    @cached_property
    def views(self) -> NDArray[np.intp]:
        """The views that have corners."""
        return np.unique(self.corners.view)

    @cached_property
    def index(self) -> NDArray[np.intp]:
        """The place (N,) of each corner's view among `views`."""
        return np.searchsorted(self.views, self.corners.view)

    @property
    def seen(self) -> Floats:
        """The corners (N, 3) of a flat board in the camera's frame, m."""
        R, t = self.poses[self.corners.view, :3, :3], self.poses[self.corners.view, :3, 3]
        return np.einsum("nij,nj->ni", R, self.corners.points) + t

    @property
    def widest(self) -> float:
        """The tangent of the largest angle from the optical axis at which a corner is."""
        x, y, z = self.seen.T
        return float((np.hypot(x, y) / z).max())

    @property
    def shared(self) -> list[str]:
        """The causes that were added with one set of coefficients for all views."""
        return [cause for cause in self.sizes if cause not in OWN]

    @property
    def own(self) -> list[str]:
        """Those of which each view has its own."""
        return [cause for cause in self.sizes if cause in OWN]

    @cached_property
    def linear(self) -> Linear:
        """Residuals and derivatives at the corners."""
        corners, camera, values = self.corners, self.camera, self.values
        R, t = self.poses[corners.view, :3, :3], self.poses[corners.view, :3, 3]
        bow = bow_shape(self, corners.points)
        off = self.shape[corners.ids]
        off[:, 2] += np.einsum("nk,nk->n", bow, values[FLEX][corners.view])
        still = np.einsum("nij,nj->ni", R, corners.points + off) + t
        # The row at which a corner was seen is measured: nothing has to be solved for it.
        time = (corners.pixels[:, 1] + 0.5) / camera.height - 0.5
        points = still + time[:, None] * values[SHUTTER][corners.view]
        pixels, by_camera, by_point = self.project(points, camera)
        left_out = by_camera[:, :, 4:][:, :, ~self.estimated[4:].any(axis=1)]
        terms = np.concatenate([lens_terms(pixels, camera.size), left_out], axis=2)
        principal = np.array([camera.cx, camera.cy])
        from_axis = pixels - principal + terms @ values[LENS]
        number = corners.view / max(len(self.names) - 1, 1) - 0.5
        longer = values[FOCUS][corners.view, 0] + 0.01 * number * values[DRIFT][0]
        scale = 1.0 + longer[:, None, None]
        by_point = by_point * scale
        by_camera = by_camera * scale
        by_camera[:, [0, 1], [2, 3]] = 1.0
        on_board = np.einsum("nij,njk->nik", by_point, R)
        centre = np.broadcast_to(np.eye(2), (len(number), 2, 2))
        drift = np.concatenate([0.01 * from_axis[..., None], centre], axis=2)
        heights, spread = self.free
        columns = {
            BOW: on_board[:, :, 2:] * bow[:, None, :],
            FLEX: on_board[:, :, 2:] * bow[:, None, :],
            HEIGHTS: on_board[:, :, 2:] * heights[corners.ids][:, None, :],
            STRETCH: on_board[:, :, :2] @ stretch_shape(self, corners.points),
            PRINT: on_board[:, :, :2] @ spread[corners.ids],
            DRIFT: drift * number[:, None, None],
            FOCUS: from_axis[..., None],
            SHUTTER: by_point * time[:, None, None],
            LENS: terms * scale,
        }
        shared = [by_camera @ self.estimated, *(columns[c] for c in self.shared)]
        own = [derivatives.twist_columns(points, by_point), *(columns[c] for c in self.own)]
        moved_centre = principal + number[:, None] * values[DRIFT][1:]
        residuals = corners.pixels - moved_centre - from_axis * scale[:, 0]
        of_all, of_each = (np.concatenate(blocks, axis=2) for blocks in (shared, own))
        return Linear(residuals, of_all, of_each, columns)

    @property
    def shape(self) -> Floats:
        """What the board's corners (m, 3) are off, m."""
        heights, spread = self.free
        z = bow_shape(self, self.board) @ self.values[BOW] + heights @ self.values[HEIGHTS]
        flat = stretch_shape(self, self.board) @ self.values[STRETCH] + spread @ self.values[PRINT]
        return np.column_stack([flat, z])

    def projection(self, weights: Floats | None = None, smooth: bool = False) -> engine.Projection:
        """The residuals without what the model imitates; weights (N,), one a corner.

        smooth: nor what a shape of the board and a smooth field over each view imitate.
        """
        linear, view = self.linear, np.repeat(self.corners.view, 2)
        rows_of = [np.flatnonzero(view == v) for v in self.views]
        own, shared = linear.own, [linear.shared]
        if smooth:  # in place of the views' own causes: a row that was measured has noise in it
            own = np.concatenate([own[..., :6], self._fields], axis=2)
            shared += [linear.columns[c] for c in (HEIGHTS, PRINT) if self.shows_shape]
        own = own.reshape(len(view), -1)
        blocks = [(rows, own[rows]) for rows in rows_of]
        columns = np.concatenate(shared, axis=2).reshape(len(view), -1)
        by_row = None if weights is None else np.repeat(weights, 2)
        return engine.Projection(linear.residuals.ravel(), columns, blocks, by_row)

    @cached_property
    def plain(self) -> engine.Projection:
        """`projection` with all corners alike."""
        return self.projection()

    @property
    def left_px(self) -> float:
        """The residuals' standard deviation in one coordinate, px."""
        dof = len(self.plain.residuals) - self.plain.rank
        return math.sqrt(float(self.plain.residuals @ self.plain.residuals) / max(dof, 1))

    @cached_property
    def noise_px(self) -> float:
        """The corners' own noise in one coordinate, px: what no shape and no smooth field explains.

        Of the corners as they are, so that it is true of JPEGs too.
        """
        squares, dof = self._rough
        return math.sqrt(squares / max(dof, 1))

    @cached_property
    def _rough(self) -> tuple[float, int]:
        rest = self.projection(smooth=True)
        return float(rest.residuals @ rest.residuals), len(rest.residuals) - rest.rank

    @cached_property
    def smooth(self) -> tuple[float, float]:
        """The squares that a shape and smooth fields take beyond what noise gives them, px^2.

        And how often noise alone would give them as much.
        """
        from scipy.stats import f

        squares, dof = self._rough
        fields = len(self.plain.residuals) - self.plain.rank - dof
        more, each = float(self.plain.residuals @ self.plain.residuals) - squares, squares / dof
        return more - fields * each, float(f.sf(more / fields / each, fields, dof))

    @property
    def shows_shape(self) -> bool:
        """Whether the views are enough to tell where each corner of the board is."""
        enough = len(self.corners.view) >= SHAPE_SIGHTS * len(self.board)
        return enough and len(self.views) >= SHAPE_VIEWS

    @cached_property
    def _fields(self) -> Floats:
        """Columns (N, 2, k) of a polynomial over the board in u and in v, in each view its own."""
        x, y = ((self.corners.points - self.board.mean(axis=0))[:, :2] / self.half_diagonal).T
        powers = [(i, j) for i in range(SMOOTH_DEGREE + 1) for j in range(SMOOTH_DEGREE + 1 - i)]
        terms = np.stack([x**i * y**j for i, j in powers], axis=1)
        few = np.bincount(self.index)[self.index] < 2 * len(powers)  # a cubic takes those whole
        terms[np.ix_(few, np.array([i + j > 2 for i, j in powers]))] = 0.0
        return np.einsum("nk,ij->nijk", terms, np.eye(2)).reshape(len(x), 2, -1)

    @cached_property
    def half_diagonal(self) -> float:
        """From the board's centre to its outermost corner, m."""
        return float(np.linalg.norm(self.board - self.board.mean(axis=0), axis=1).max())

    @property
    def larger(self) -> float:
        """Times as large as the course's board; limits in m are for that one."""
        return self.half_diagonal / COURSE_BOARD_M

    # --- the search ---

    def hypotheses(self) -> Iterator[engine.Hypothesis]:
        """The physical causes that were not added, the worst view, and corners far out."""
        for cause in PHYSICAL:
            if cause not in self.sizes and (self.shows_shape or cause not in (HEIGHTS, PRINT)):
                yield self.hypothesis(cause)
        rms = self._rms_by_view()
        if len(rms) >= 4 and len(self.names) - len(rms) < len(rms) // 4:
            worst = int(self.views[rms.argmax()])
            rows = np.flatnonzero(np.repeat(self.corners.view == worst, 2))
            yield _free(SPOILED_VIEW, rows, at=worst, tried=len(rms))
        wrong = self._wrong_corners()
        if len(wrong):
            yield _free(BAD_CORNERS, np.column_stack([2 * wrong, 2 * wrong + 1]).ravel())

    def hypothesis(self, cause: str) -> engine.Hypothesis:
        """A physical cause: one set of columns for all views, or one set a view."""
        columns = self.linear.columns[cause]
        n = len(columns)
        columns = self._by_view(columns) if cause in OWN else columns.reshape(2 * n, -1)
        if cause == LENS:  # terms of different units: each as the px that it moves corners by
            columns = columns / np.sqrt(np.mean(columns**2, axis=0) + 1e-300)
        typical = TYPICAL[cause] * (self.larger if cause in GROWS_WITH_BOARD else 1.0)
        return engine.Hypothesis(cause, columns, typical=typical)

    def _by_view(self, columns: Floats) -> Floats:
        """Columns (N, 2, k) that each view has of its own, (2 N, views k)."""
        n, _, width = columns.shape
        by_view = np.zeros((n, 2, len(self.views), width))
        by_view[np.arange(n), :, self.index] = columns
        return by_view.reshape(2 * n, -1)

    @cached_property
    def smooth_strength(self) -> float:
        """The strength of smooth fields, each view its own, as a rival of what views have so.

        One width for all of them, as for a cause: where a cause is real, a few columns a view say
        it all and are the likelier, clearly; where corners only share errors with their neighbours,
        all do.
        """
        fields = engine.Hypothesis("smooth", self._by_view(self._fields), typical=PRIOR_PX)
        return self.plain.explains(fields).strength

    def tested(self, hypotheses: Sequence[engine.Hypothesis]) -> list[engine.Tested]:
        """The test of each hypothesis; the fair p-value only of those that can be accepted."""
        tests = [self.plain.explains(hypothesis) for hypothesis in hypotheses]
        physical = sorted(t.strength for t in tests if t.cause in PHYSICAL)
        least = max(physical[-FAIR:][0] if physical else math.inf, 0.0)
        fair = [t.cause in PHYSICAL and t.strength >= least for t in tests]
        return [self.test(t.hypothesis) if f else t for t, f in zip(tests, fair, strict=True)]

    def test(self, hypothesis: engine.Hypothesis) -> engine.Tested:
        """One hypothesis; a physical cause has its p-value from weights after each view's noise.

        The variance of each view is taken from what remains after the cause, so that the cause
        itself does not pass for noise; with noisier views (blur) the plain F would be too large
        too often.
        """
        test = self.plain.explains(hypothesis)
        if test.cause not in PHYSICAL:
            return test
        fair = self.projection(self._noise_weights(test))
        return replace(test, log_p=fair.explains(hypothesis).log_p)

    def matters(self, test: engine.Tested) -> bool:
        """Whether a view stands out, or a motion can be; the rest is for the findings to say."""
        if test.cause == SHUTTER:
            return test.size < MOST_MOTION_M * self.larger
        if test.cause != SPOILED_VIEW:
            return True
        rms = self._rms_by_view()
        others = np.delete(rms, rms.argmax())
        unlike = np.log(others / np.median(others))  # views differ in noise, some sessions' by much
        ratio = max(SPOILED_RATIO, math.exp(4 * SIGMA_OF_MAD * float(np.median(np.abs(unlike)))))
        return test.size >= max(ratio * float(np.median(others)), SPOILED_PX)

    def accept(self, test: engine.Tested) -> Calibration:
        """The calibration with a cause added, or corners set aside, fitted again."""
        if test.cause in PHYSICAL:
            return self.with_cause(test)
        return refit(replace(self, corners=self.corners.keep(~self.corners_of(test))))

    def with_cause(self, test: engine.Tested) -> Calibration:
        """The calibration with a physical cause added, fitted again."""
        least = LEAST_SHAPE_M if test.cause in (HEIGHTS, PRINT) else 1e-12
        sizes = {**self.sizes, test.cause: max(test.size, least)}
        noise = math.sqrt(self.plain.explains(test.hypothesis).rest)
        return refit(replace(self, sizes=sizes, prior_px=max(noise, LEAST_PX)))

    def corners_of(self, test: engine.Tested) -> Mask:
        """The corners (N,) that a spoiled view or bad corners concern."""
        mask = np.zeros(len(self.corners.view), bool)
        mask[np.asarray(test.hypothesis.rows) // 2] = True
        return mask

    def _rms_by_view(self) -> Floats:
        squares = (self.plain.residuals.reshape(-1, 2) ** 2).mean(axis=1)
        return np.sqrt(np.bincount(self.index, squares) / np.bincount(self.index))

    def _wrong_corners(self) -> NDArray[np.intp]:
        """Single corners too far out for the noise of the session and of their view.

        Corners that differ in noise have heavier tails than a normal distribution: what the 99th
        percentile is too far out goes into the limit, to the third power, as a mixture of normal
        distributions has it where one corner in a million is.
        """
        length = np.linalg.norm(self.plain.residuals.reshape(-1, 2), axis=1)
        sigma = np.full(len(length), np.median(length))
        for view in self.views:
            mine = self.corners.view == view
            sigma[mine] = np.maximum(sigma[mine], np.median(length[mine]))
        limit = np.sqrt(2 * np.log(len(length) / CHANCE_LEVEL)) / RAYLEIGH_MEDIAN
        tail = float(np.percentile(length / sigma, 99)) / RAYLEIGH_99
        limit *= np.clip(tail, 1.0, HEAVIEST_TAIL) ** 3
        return np.flatnonzero((length > limit * sigma) & (length > BAD_CORNER_PX))

    def _noise_weights(self, explained: engine.Explained) -> Floats:
        """1 / sigma of each corner (N,), from the residuals of its view, shrunk to the common."""
        squares = (explained.after.reshape(-1, 2) ** 2).sum(axis=1)
        dof = max(explained.dof, 1)
        common, own_dof = squares.sum() / dof, np.bincount(self.index) * dof / len(squares)
        own = np.bincount(self.index, squares)
        variance = (own + SHRINK_DOF * common) / (own_dof + SHRINK_DOF)
        return np.maximum(variance, 1e-300)[self.index] ** -0.5


def _free(cause: str, rows: NDArray[np.intp], at: int = 0, tried: int = 1) -> engine.Hypothesis:
    """Single coordinates that may be anything."""
    return engine.Hypothesis(cause, np.eye(len(rows)), at, rows, TYPICAL[cause], tried)


def as_fisheye(model: Calibration) -> tuple[Calibration, float]:
    """The same views through a fisheye with three coefficients, fitted from the same poses.

    It starts as the lens that it is to beat, whose tangential coefficients it does without. And
    how often by chance it would leave so much less, view by view: a t-test over the views, which
    are independent where the corners of one are not, of the logarithm of what each model leaves.
    """
    from scipy.special import stdtr

    camera, tangent = model.camera, np.linspace(0.0, model.widest, 100)
    parameters = derivatives.parameter_vector(camera)
    straight = parameters[4:] * [1, 1, 0, 0, 1]  # without the tangential ones
    radius = distort(np.column_stack([tangent, 0.0 * tangent]), straight)[:, 0]
    powers = np.arctan(tangent)[:, None] ** derivatives.FISHEYE_POWERS
    series = np.linalg.lstsq(powers, radius, rcond=None)[0]
    parameters[:2] *= series[0]
    parameters[4:] = 0.0
    parameters[derivatives.RADIAL] = series[1:] / series[0]
    estimated = model.estimated[:, model.estimated[[6, 7]].sum(axis=0) == 0]
    camera, values = derivatives.with_parameters(camera, parameters), model.values.copy()
    values[LENS] = np.zeros(10)
    project = derivatives.fisheye_with_derivatives
    rival = replace(model, camera=camera, estimated=estimated, values=values, project=project)
    rival = refit(turned_over(refit(rival, FISHEYE_STEPS)))
    left = (np.minimum(_squares_by_view(m) + LEAST_PX**2, 1e300) for m in (model, rival))
    less, n = -np.diff(np.log([*left]), axis=0)[0], len(model.views)
    t = math.sqrt(n) * less.mean() / max(less.std(ddof=1), 1e-300)
    return rival, float(stdtr(n - 1, -t))


def search_lens(start: Calibration) -> engine.Accepted[Calibration] | None:
    """The step to a lens that the model cannot follow, where that explains most of the residuals.

    Then nothing else is asked: a wrong lens passes for every other cause. None where another
    physical cause explains more, or where no more is gained than a calibration is exact to.
    """
    tests = [start.test(h) for h in start.hypotheses() if h.cause in PHYSICAL]
    best = max(tests, key=lambda test: test.strength)
    if best.cause != LENS or best.log_p > math.log(CHANCE_LEVEL):
        return None
    step = engine.Accepted(best, start, start.with_cause(best), ())
    excess = start.left_px**2 - start.noise_px**2
    return step if start.left_px**2 - step.after.left_px**2 > MOST * max(excess, 0.0) else None


def named(found: engine.CauseSearch[Calibration]) -> list[engine.Accepted[Calibration]]:
    """The accepted steps that explain what there is; the three of a board's shape are one cause."""
    noise = found.model.noise_px**2
    shape = [step for step in found.accepted if step.test.cause in SHAPE]
    others = [s for s in found.accepted if s.test.cause in PHYSICAL and s not in shape]

    def taken(steps: Sequence[engine.Accepted[Calibration]]) -> float:
        return sum(step.before.left_px**2 - step.after.left_px**2 for step in steps)

    closed = found.model.smooth[1] > NOTHING_LEFT and len(others) <= 1
    held = max(shape[0].before.left_px ** 2 - noise, 0.0) if shape else 0.0
    good = list(shape) if closed or taken(shape) >= MOST_OF_SHAPE * held else []
    # Paper that bends from view to view is taken in, lest others pass for it, and is not named:
    # what neighbouring corners of any image have in common looks like it.
    crumbs = STIFF**2 * taken(good)
    large = [s for s in others if taken([s]) > crumbs and s.test.cause != FLEX]
    for step in large:
        if step.test.cause in OWN:
            clear = step.test.strength > step.before.smooth_strength + engine.RIVAL_GAIN
            good += [step] * clear
        elif closed or step.after.smooth[0] < (1 - MOST) * step.before.smooth[0]:
            good += [step]
    kept = _sound(found, good)
    return [step for step in kept if step.test.cause not in PHYSICAL] + good


def _sound(
    found: engine.CauseSearch[Calibration], good: Sequence[engine.Accepted[Calibration]]
) -> list[engine.Accepted[Calibration]]:
    """The steps up to the first physical one that is not good: what comes later rests on it."""
    physical = [step.test.cause in PHYSICAL and step not in good for step in found.accepted]
    return found.accepted[: physical.index(True)] if any(physical) else found.accepted


def explained(found: engine.CauseSearch[Calibration]) -> Calibration:
    """The end of a search with nothing in it but what is `named`."""
    good = named(found)
    causes = {step.test.cause for step in good}
    if len(good) == len(found.accepted):
        return found.model
    sound = _sound(found, good)
    corners = sound[-1].after.corners if sound else found.start.corners
    sizes = {cause: size for cause, size in found.model.sizes.items() if cause in causes}
    return refit(replace(found.start, corners=corners, sizes=sizes, prior_px=found.model.prior_px))


def without(model: Calibration, causes: Sequence[str]) -> Calibration:
    """The calibration with these causes taken out, fitted again."""
    sizes = {cause: size for cause, size in model.sizes.items() if cause not in causes}
    values = {c: v * (c in sizes) for c, v in model.values.items()}
    return refit(replace(model, sizes=sizes, values=values))


def kept(model: Calibration, detections: Sequence[Detection]) -> Detections:
    """The detections without the views and corners that were set aside."""
    left = []
    for view in model.views:
        d = detections[view]
        mine = np.isin(d.ids, model.corners.ids[model.corners.view == view])
        if mine.sum() >= FEWEST_CORNERS:
            left.append(replace(d, ids=d.ids[mine], pixels=d.pixels[mine]))
    return Detections(left)


def sag(model: Calibration) -> tuple[float, float]:
    """How far the board's corners lie out of a plane, top to bottom, and its sigma, m."""
    seen = np.unique(model.corners.ids)
    z = model.shape[seen, 2]
    plane = np.column_stack([model.board[seen, :2], np.ones(len(seen))])
    z = z - plane @ np.linalg.lstsq(plane, z, rcond=None)[0]
    covariance = np.zeros((len(seen), len(seen)))
    bases = {BOW: bow_shape(model, model.board), HEIGHTS: model.free[0]}
    for cause, basis in bases.items():
        if cause in model.sizes:
            sizes = {c: size for c, size in model.sizes.items() if c != cause}
            less = replace(model, sizes=sizes)
            own = less.plain.explains(less.hypothesis(cause)).covariance
            covariance += basis[seen] @ own @ basis[seen].T
    between = np.zeros(len(seen))
    between[[z.argmax(), z.argmin()]] = 1.0, -1.0
    return float(np.ptp(z)), math.sqrt(float(between @ covariance @ between))


def dents(model: Calibration) -> list[tuple[int, float]]:
    """Single corners that stand out of the others' surface, and how far out of the plane, m.

    z points into the board.
    """
    seen = np.unique(model.corners.ids)
    plane = np.column_stack([model.board[seen, :2], np.ones(len(seen))])
    smooth = np.column_stack([bow_shape(model, model.board)[seen], plane])
    z = model.shape[seen, 2]
    from_plane, off = (z - A @ np.linalg.lstsq(A, z, rcond=None)[0] for A in (plane, smooth))
    usual = SIGMA_OF_MAD * float(np.median(np.abs(off)))
    limit = max(DENT_SIGMAS * usual, DENT_M * model.larger)
    return [(int(seen[k]), float(from_plane[k])) for k in np.flatnonzero(np.abs(off) > limit)]


# --- the model ---


def bow_shape(model: Calibration, points: Floats) -> Floats:
    """The three shapes (N, 3) of a bow: x^2, xy, y^2 from the board's centre in half diagonals."""
    x, y = ((points - model.board.mean(axis=0))[:, :2] / model.half_diagonal).T
    return np.stack([x * x, x * y, y * y], axis=1)


def stretch_shape(model: Calibration, points: Floats) -> Floats:
    """A print too wide and as much too low, and one askew: (N, 2, 2) in half diagonals."""
    x, y = ((points - model.board.mean(axis=0))[:, :2] / model.half_diagonal).T
    return np.stack([np.stack([x, y], axis=1), np.stack([-y, x], axis=1)], axis=1)


def free_shapes(points: Floats) -> tuple[Floats, Floats]:
    """What the corners (m, 3) of a board may do: heights (m, m - 3) and print (m, 2, 2 m - 4).

    Orthonormal columns, without what is no shape: a motion of the board, and its size.
    """
    (x, y), one, zero = points[:, :2].T, np.ones(len(points)), np.zeros(len(points))
    moved_plane = np.linalg.qr(np.stack([one, x, y], axis=1), mode="complete")[0]
    motions = [[one, zero], [zero, one], [-y, x], [x, y]]
    flat = np.stack([np.stack(m, axis=1).ravel() for m in motions], axis=1)
    spread = np.linalg.qr(flat, mode="complete")[0][:, 4:]
    return moved_plane[:, 3:], spread.reshape(len(points), 2, -1)


def lens_terms(pixels: Floats, size: tuple[int, int]) -> Floats:
    """What a lens may do that the model lacks, (N, 2, 8), px: smooth fields over the image.

    Radial ones with the 5th, 7th, 9th and 11th power of the distance from the image's centre, and
    thin prisms with the 2nd and 4th. In the image, where they stay bounded: the normalised
    coordinates of a wide lens do not. pixels (N, 2): where the model sees the corners (where they
    were seen has their noise in it, and would explain itself); size: (width, height), px.
    """
    at = (pixels - (np.array(size) - 1) / 2) / (np.hypot(*size) / 2)
    r2 = (at**2).sum(axis=1)
    terms = np.zeros((len(at), 2, 8))
    for column in range(4):
        terms[:, :, column] = at * r2[:, None] ** (column + 2)
    for axis, column, power in ((0, 4, r2), (1, 5, r2), (0, 6, r2**2), (1, 7, r2**2)):
        terms[:, axis, column] = power
    return terms


def refit(model: Calibration, steps: int = REFIT_STEPS) -> Calibration:
    """Levenberg-Marquardt over the camera, the poses and the causes of the model.

    Views without tilt leave a direction open in which an undamped step runs away.
    """
    squares, damping = _squares(model), LEAST_DAMPING
    for _ in range(steps):
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


def turned_over(model: Calibration) -> Calibration:
    """The model with each board mirrored in its tilt where that fits its view better.

    A plane and its mirror image look nearly alike, and a solver that went through a wrong lens
    keeps the wrong one of them: that view then passes for whatever bends a view of its own. Each
    mirror image is fitted to its view with the camera as it is (Levenberg-Marquardt).
    """
    centre = model.board.mean(axis=0)
    middle = model.poses[:, :3, :3] @ centre + model.poses[:, :3, 3]
    sight = middle / np.linalg.norm(middle, axis=1, keepdims=True)
    mirror = np.eye(3) - 2 * sight[:, :, None] * sight[:, None, :]
    poses = model.poses.copy()
    poses[:, :3, :3] = mirror @ poses[:, :3, :3] * [1.0, 1.0, -1.0]
    poses[:, :3, 3] = middle - poses[:, :3, :3] @ centre
    trial, damping = replace(model, poses=poses), np.full(len(model.views), MIRROR_DAMPING)
    squares = _squares_by_view(trial)
    for _ in range(MIRROR_STEPS):
        own, poses = trial.linear.own[..., :6], trial.poses.copy()
        normal, gradient = np.zeros((len(damping), 6, 6)), np.zeros((len(damping), 6))
        np.add.at(normal, trial.index, np.swapaxes(own, 1, 2) @ own)
        np.add.at(gradient, trial.index, np.einsum("nij,ni->nj", own, trial.linear.residuals))
        diagonal = np.einsum("njj->nj", normal)
        damped = normal + (damping[:, None] * diagonal)[..., None] * np.eye(6)
        step = np.linalg.solve(damped, gradient[..., None])[..., 0]
        poses[trial.views] = moved(poses[trial.views], step)
        now = _squares_by_view(replace(trial, poses=poses))
        less = now < squares
        poses[trial.views[~less]] = trial.poses[trial.views[~less]]
        trial, squares = replace(trial, poses=poses), np.where(less, now, squares)
        damping = np.where(less, damping / 10.0, damping * 10.0)
    better = model.views[squares < (1.0 - SMALL_DECREASE) * _squares_by_view(model)]
    poses = model.poses.copy()
    poses[better] = trial.poses[better]
    return replace(model, poses=poses)


def _squares_by_view(model: Calibration) -> Floats:
    """Squared residuals (views,), infinite where a corner would be behind the camera."""
    with np.errstate(all="ignore"):
        squares = np.bincount(model.index, (model.linear.residuals**2).sum(axis=1))
    squares[model.index[model.seen[:, 2] <= 0]] = np.inf
    return np.nan_to_num(squares, nan=np.inf, posinf=np.inf)


def _squares(model: Calibration) -> float:
    with np.errstate(all="ignore"):
        held = sum(float((_prior(model, own)[1] ** 2).sum()) for own in (True, False))
        return float((model.linear.residuals**2).sum()) + held


def _prior(model: Calibration, own: bool) -> tuple[Floats, Floats]:
    """How what is shared, or a view's own, is held: px a number (g,), (k,), and what it amounts to.

    That is (g,) or (views, k), px. A view's own coefficients, and corners that are off the board's
    smooth shape, are held towards 0 as by one corner coordinate of noise `prior_px` each.
    """
    causes = model.own if own else model.shared
    free = np.zeros((len(model.views), 0) if own else model.estimated.shape[1])
    values = [free, *(model.values[c][model.views] if own else model.values[c] for c in causes)]
    held = [model.prior_px / model.sizes[c] * (own or c in (HEIGHTS, PRINT)) for c in causes]
    weight = np.repeat([0.0, *held], [value.shape[-1] for value in values])
    return weight, np.concatenate(values, axis=-1) * weight


def _step(model: Calibration, damping: float) -> tuple[Floats, Floats]:
    """The damped step of what is shared (g,) and of each view's own (views, w)."""
    linear = model.linear
    g, width = linear.shared.shape[2], linear.own.shape[2]
    weight, prior = _prior(model, own=True)
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
    held, values = _prior(model, own=False)
    s.append(np.diag(held)[held > 0])
    r.append(-values[held > 0])
    return derivatives.NormalEquations(np.concatenate(s), b, np.concatenate(r)).step()


def _moved(model: Calibration, shared: Floats, own: Floats) -> Calibration | None:
    """The model after a step, None where that leads to no camera."""
    p = model.estimated.shape[1]
    parameters = derivatives.parameter_vector(model.camera) + model.estimated @ shared[:p]
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
    camera = derivatives.with_parameters(model.camera, parameters)
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

    def __repr__(self) -> str:
        half = 1e3 * self.result.quantile() * self.sigma_m
        found = "a bow" if self.p_value < BOW_LEVEL else "no more than a flat board would show"
        facts = {"sag": 1e3 * self.sag_m, "half": half, "found": found}
        return say("intrinsics.bow", p=p_text(self.p_value), **facts)


def fit_bow(result: IntrinsicsResult) -> Bow:
    """The bow of the board, fitted along with all that `result` fitted.

    Its covariances include what the unknown bow costs; `Bow.result.converged` says whether the
    solver arrived. The sag is that of the four outermost corners' mean, not of the largest: that
    one would be chosen by the noise. Of a twist it sees nothing; the coefficients and the F-test
    do.
    """
    from scipy.stats import f

    model = refit(replace(Calibration.of(result), sizes={BOW: TYPICAL[BOW]}))
    bowed, unit = shaped(model, result), model.half_diagonal**2
    shape, coefficients = bow_shape(model, result.points) * unit, model.values[BOW] / unit
    covariance = bowed.equations.scatter(len(result.names)).covariance[-3:, -3:] / unit**2
    columns, rows = result.board.corners
    outermost = shape[[0, columns - 1, (rows - 1) * columns, rows * columns - 1]].mean(axis=0)
    flat, bent = (float(np.sum(r.equations.residuals**2)) for r in (result, bowed))
    ratio, dof = max(0.0, flat - bent) / 3 / (bent / bowed.equations.dof), bowed.equations.dof
    # With the old origin z points out of the board.
    sag_m = float(outermost @ coefficients) * (-1 if result.board.old_origin else 1)
    sigma_m = math.sqrt(float(outermost @ covariance @ outermost))
    return Bow(sag_m, sigma_m, coefficients, covariance, float(f.sf(ratio, 3, dof)), bowed)


# --- the shape, corner by corner ---


def fit_shape(result: IntrinsicsResult) -> IntrinsicsResult:
    """The camera where every corner of the board may be off, in its plane and out of it.

    How far corners are off is drawn from two normal distributions whose widths the residuals tell
    (restricted maximum likelihood). The board's `points` are then where the views put them, and
    every covariance includes what their being unknown costs. Raises ValueError for fewer than 6
    views or fewer than 5 sights of each corner on average: they cannot tell a shape from noise.
    """
    model = refit(Calibration.of(result))
    sights = len(model.corners.view) / len(model.board)
    wanted = f"at least {SHAPE_VIEWS} views and {SHAPE_SIGHTS} sights of each corner"
    want(model.shows_shape, "result", f"{len(model.views)} views and {sights:.1f} sights", wanted)
    for cause in (STRETCH, HEIGHTS, PRINT, HEIGHTS):  # the heights again, with the print known
        less = without(model, (cause,))
        model = less.with_cause(less.plain.explains(less.hypothesis(cause)))
    return shaped(model, result)


def _flat(moves: Floats) -> Floats:
    """Moves (m, 2, k) in the board's plane as moves (m, 3, k)."""
    return np.concatenate([moves, np.zeros((len(moves), 1, moves.shape[2]))], axis=1)


def shaped(model: Calibration, result: IntrinsicsResult) -> IntrinsicsResult:
    """The fit `result` with the camera of a model and the shape that it gives the board."""
    (heights, spread), up = model.free, np.array([[0.0], [0.0], [1.0]])
    moves = {
        BOW: bow_shape(model, model.board)[:, None] * up,
        HEIGHTS: heights[:, None] * up,
        STRETCH: _flat(stretch_shape(model, model.board)),
        PRINT: _flat(spread),
    }
    sizes = {cause: size for cause, size in model.sizes.items() if cause in SHAPE}
    extra = {f"{c} {k}": moves[c][:, :, k] for c in sizes for k in range(moves[c].shape[2])}
    held = _prior(replace(model, sizes=sizes), own=False)
    weights, off = (part[model.estimated.shape[1] :] for part in held)
    given = result.detections, result.board, model.board + model.shape, result.names, result.model
    return evaluate(model.camera, model.poses, *given, extra, (weights, off))
