"""Is the mean of miss vectors zero? Two tests that know different amounts about the scatter.

Hotelling's T^2 takes the scatter as any covariance and estimates its six numbers; ten trials make
that dear: a bias of 3 mm under 2 mm of scatter an axis is found in 53 % of sets at level 0.01. The
pooled test weighs the axes alike, n |mean|^2 / trace S, with degrees of freedom that shrink as the
scatter gets uneven (Box 1954, Annals of Mathematical Statistics 25, 290; the "ANOVA-type
statistic"): 85 % of the same sets, but blind to a small bias across a large scatter, where T^2
sees it. Both are done, and their p-values joined with Bonferroni's weights. Box's degrees of
freedom are an approximation: at level 0.01 both together reject 0.3 to 1.9 % of sets without bias,
the most where one axis scatters three times as much as the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    Floats = NDArray[np.float64]

POOLED, T2 = 0.95, 0.05  # the shares of the level: T^2 is for the rarer case
FEW = 10  # trials below which the shape of the scatter is hardly known: then err to fewer axes
SINGULAR = 1e-9  # smallest eigenvalue of the covariance over its largest


@dataclass(frozen=True)
class MeanTest:
    """p-values of "the mean is zero", T^2 itself (both None where T^2 cannot be had), and both
    joined. axes: how many the scatter really fills, 1 to 3."""

    t2: float | None
    p_t2: float | None
    p_pooled: float
    axes: float

    @property
    def p_value(self) -> float:
        """Of both tests together."""
        p_t2 = 1.0 if self.p_t2 is None else self.p_t2
        return min(1.0, self.p_pooled / POOLED, p_t2 / T2)


def mean_test(misses: Floats) -> MeanTest:
    """Test misses (n, 3), n >= 2, m, for a mean of zero."""
    from scipy.stats import f

    n, mean, S = len(misses), misses.mean(axis=0), np.cov(misses.T)
    total = float(np.trace(S))
    axes = effective_axes(S, n)
    squares = float(n * mean @ mean)
    if total > 0:
        p_pooled = float(f.sf(squares / total, axes, box_freedom(S, n) * (n - 1)))
    else:
        p_pooled = 0.0 if squares > 0 else 1.0
    values = np.linalg.eigvalsh(S)
    if n < 4 or values[0] <= SINGULAR * values[-1]:
        return MeanTest(None, None, p_pooled, axes)
    t2 = float(n * mean @ np.linalg.solve(S, mean))
    p_t2 = float(f.sf(t2 * (n - 3) / (3 * (n - 1)), 3, n - 3))
    return MeanTest(t2, p_t2, p_pooled, axes)


def effective_axes(S: Floats, n: int) -> float:
    """tr(C)^2 / tr(C^2) of the true covariance C behind S (3, 3) of n trials: 1 to 3.

    From the expectations of tr(S)^2 and tr(S^2) for normal scatter; S alone would say too few. Two
    trials lie on a line, and 1 is all that they show.
    """
    v = n - 1
    if v == 1:
        return 1.0
    square_of_trace, trace_of_square = float(np.trace(S)) ** 2, float((S * S).sum())
    a, b = np.linalg.solve(
        [[1.0, 2.0 / v], [1.0 / v, 1.0 + 1.0 / v]], [square_of_trace, trace_of_square]
    )
    return float(np.clip(a / b, 1.0, 3.0)) if b > 0 else 3.0


def box_freedom(S: Floats, n: int) -> float:
    """Degrees of freedom of tr S (3, 3) for each of the n - 1 trials behind it: 1 to 3."""
    squares = float((S * S).sum())
    if n >= FEW or squares == 0:
        return effective_axes(S, n)
    return float(np.trace(S)) ** 2 / squares


def mean_power(size_m: float, S: Floats, axes: float, n: int, level: float) -> float:
    """The share of sets of n trials in which the pooled test finds a mean of length size_m, m.

    S (3, 3): the scatter, taken as known; axes: as of `effective_axes`.
    """
    return _power(n * size_m**2, S, axes, axes, axes * (n - 1), level * POOLED)


def pose_power(size_m: float, S: Floats, axes: float, n: int, columns: int, level: float) -> float:
    """The same for a part of the misses that follows the pose, size_m rms over the trials.

    columns: how many numbers describe that part.
    """
    share = axes / 3.0  # of the degrees of freedom that uneven scatter leaves
    rest = share * (3 * (n - 1) - columns)
    return _power(n * size_m**2, S, axes, share * columns, rest, level) if rest > 0 else 0.0


def _power(
    squares: float, S: Floats, axes: float, above: float, below: float, level: float
) -> float:
    from scipy.stats import f, ncf

    total = float(np.trace(S))
    if total <= 0:
        return float(squares > 0)
    limit = f.isf(level, above, below)
    return float(
        np.nan_to_num(ncf.sf(limit, above, below, min(axes * squares / total, 1e4)), nan=1.0)
    )
