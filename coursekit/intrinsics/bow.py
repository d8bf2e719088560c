"""A board that is not flat: its bow fitted along with the camera.

A bow puts corners a millimetre off the plane, and the fit pays with the focal length and k1 rather
than with the residuals. Three coefficients of a quadratic form are enough to take it out:
z = a x^2 + b x y + c y^2 over the board's middle; constant and linear terms are poses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.intrinsics.derivatives import moved
from coursekit.intrinsics.fit import (
    ARRIVED_PX,
    IntrinsicsResult,
    evaluate,
    p_text,
    parameter_vector,
    with_parameters,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from coursekit.boards import Board
    from coursekit.geometry import Intrinsics

    Floats = NDArray[np.float64]
    Interval = tuple[float, float]

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
        better = _step(bowed, result, shapes, coefficients)
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


def _step(
    bowed: IntrinsicsResult, result: IntrinsicsResult, shapes: Floats, coefficients: Floats
) -> tuple[Floats, IntrinsicsResult] | None:
    """The Gauss-Newton step, halved until the residuals shrink; None where they do not."""
    shared, twists = bowed.equations.step()
    before = float(bowed.equations.residuals @ bowed.equations.residuals)
    for scale in 0.5 ** np.arange(HALVINGS):
        change = result.selection @ (scale * shared[: len(result.names)])
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
