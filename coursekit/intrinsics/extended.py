"""The calibration model extended: curved board, focal length and motion of each view, a lens.

Beside camera and poses, each cause that can spoil a session has its columns here, whether it is in
the model or not: those in the model are fitted, the others are tested (`intrinsics.causes`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from coursekit.intrinsics.derivatives import (
    NormalEquations,
    moved,
    project_with_derivatives,
    twist_columns,
)
from coursekit.intrinsics.fit import _selection, parameter_vector, with_parameters

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.geometry import Intrinsics
    from coursekit.intrinsics.fit import IntrinsicsResult

    Floats = NDArray[np.float64]
    Mask = NDArray[np.bool_]

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
    estimated = _selection(result.names)
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
