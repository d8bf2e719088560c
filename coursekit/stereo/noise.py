"""The noise law fitted to measurements at several distances."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from coursekit.stereo.law import rounded_variance
from coursekit.stereo.stacks import counted, fx_baseline, increasing, numbers, with_notes

if TYPE_CHECKING:
    from collections.abc import Callable

    from numpy.typing import ArrayLike, NDArray

    Floats = NDArray[np.float64]
    Interval = tuple[float, float]

SURE = 0.05  # scatter less likely than this by chance widens the intervals


@dataclass(frozen=True, eq=False, repr=False)
class NoiseFit:
    """sigma_Z = (r^2 sigma_d / (fx B)) (Z / r)^exponent, fitted; r = reference_m.

    sigma_d_px: disparity noise at the reference distance (at any distance if the exponent is 2),
    and its 95 % interval. exponent: as fitted, or as held, or None where one distance cannot give
    one; its interval is None unless it was fitted. covariance (k, k): of (ln sigma_d, exponent).
    chi2, dof: of the residuals. consistent: whether their size is explained by the errors; where
    it is not, the intervals are widened. notes: what a reader must know.
    """

    sigma_d_px: float
    sigma_d_interval_px: Interval
    exponent: float | None
    exponent_interval: Interval | None
    reference_m: float
    n_distances: int
    fx: float
    baseline_m: float
    covariance: Floats
    chi2: float
    dof: int
    consistent: bool
    sigmas: float
    notes: tuple[str, ...] = ()

    def std_m(self, distances_m: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """The fitted law and its 95 % band at distances (...): (std, low, high), each (...), m."""
        ratio = np.log(numbers("distances_m", distances_m) / self.reference_m)
        power = 2.0 if self.exponent is None else self.exponent
        scale = self.reference_m**2 * self.sigma_d_px / (self.fx * self.baseline_m)
        slopes = np.stack([np.ones_like(ratio), ratio][: len(self.covariance)], axis=-1)
        spread = np.sqrt(np.einsum("...i,ij,...j", slopes, self.covariance, slopes))
        middle = scale * np.exp(power * ratio)
        return middle, middle * np.exp(-self.sigmas * spread), middle * np.exp(self.sigmas * spread)

    def __repr__(self) -> str:
        low, high = self.sigma_d_interval_px
        text = f"sigma_d = {self.sigma_d_px:.3f} px (95 %: {low:.3f} to {high:.3f})"
        if self.exponent is None:
            text += ", no exponent"
        elif self.exponent_interval is None:
            text += f", exponent held at {self.exponent:g}"
        else:
            low, high = self.exponent_interval
            text += f", exponent {self.exponent:.2f} ({low:.2f} to {high:.2f})"
        return with_notes(f"{text}, from {counted(self.n_distances, 'distance')}", self.notes)


def fit_noise(
    distances_m: ArrayLike,
    stds_m: ArrayLike,
    dof: ArrayLike,
    fx: float,
    baseline_m: float | None,
    depth_scale_m: float | None = None,
    exponent: float | None = None,
) -> NoiseFit:
    """sigma_d, and the exponent of Z unless it is held, from std of depth at several distances.

    distances_m (K,): increasing, m. stds_m (K,): std over time of one pixel's depth as measured,
    rounding included, m; NaN is left out. dof (K,) or one number: independent squares in each, as
    `WindowStats.pixel_dof` says. depth_scale_m: the depth unit, to correct for; None leaves the
    rounding in. exponent: 2 to hold it, None to fit it.

    Model: dof_i s_i^2 / V_i is chi-squared with dof_i, V_i = `rounded_variance` of the law; so
    ln s_i has known mean and variance (digamma, trigamma) and the fit is weighted least squares
    on it. Intervals are 1.96 standard errors, of ln sigma_d and of the exponent. Where the
    residuals are larger than that model lets them be (chi-squared beyond 5 %), the standard errors
    are scaled to the residuals and Student's t takes the place of 1.96.
    One distance holds the exponent at 2 to get sigma_d, reports no exponent, and says so.
    Raises ValueError for distances that do not increase, stds that are negative or all zero or
    NaN, a dof that is not positive, and a missing baseline.
    """
    from scipy.special import digamma, polygamma

    product = fx_baseline(fx, baseline_m)
    z, s, nu, notes = _noise_points(distances_m, stds_m, dof)
    free = exponent is None and len(z) > 1
    reference = float(np.exp(np.log(z).mean()))
    expected = np.log(s) - (digamma(nu / 2) - np.log(nu / 2)) / 2
    error = np.sqrt(polygamma(1, nu / 2)) / 2

    def law(theta: Floats) -> Floats:
        power = theta[1] if free else 2.0 if exponent is None else exponent
        return reference**2 / product * np.exp(theta[0] + power * np.log(z / reference))

    def residuals(theta: Floats) -> Floats:
        sigma = law(theta)
        variance = rounded_variance(sigma, depth_scale_m) if depth_scale_m else sigma**2
        return (expected - np.log(variance) / 2) / error

    start = [float(np.mean(np.log(s * product / z**2))), 2.0][: 1 + free]
    theta, covariance, chi2 = solve(residuals, start)
    left = len(z) - len(theta)
    sigmas, consistent = half_interval(chi2, left)
    half = sigmas * np.sqrt(np.diag(covariance))
    sigma_d = float(np.exp(theta[0]))
    notes += _noise_notes(z, law(theta), depth_scale_m, free, exponent, left, consistent)
    return NoiseFit(
        sigma_d_px=sigma_d,
        sigma_d_interval_px=(sigma_d * math.exp(-half[0]), sigma_d * math.exp(half[0])),
        exponent=float(theta[1]) if free else None if exponent is None else float(exponent),
        exponent_interval=(theta[1] - half[1], theta[1] + half[1]) if free else None,
        reference_m=reference,
        n_distances=len(z),
        fx=float(fx),
        baseline_m=product / float(fx),
        covariance=covariance,
        chi2=chi2,
        dof=left,
        consistent=consistent,
        sigmas=sigmas,
        notes=tuple(notes),
    )


def _noise_points(
    distances_m: ArrayLike, stds_m: ArrayLike, dof: ArrayLike
) -> tuple[Floats, Floats, Floats, list[str]]:
    """The distances, stds and dof that a fit can use, and notes on those it cannot."""
    z = increasing("distances_m", distances_m)
    s = numbers("stds_m", stds_m, z.shape)
    nu = (
        np.broadcast_to(numbers("dof", dof), z.shape)
        if np.ndim(dof) == 0
        else numbers("dof", dof, z.shape)
    )
    if (s < 0).any() or np.isinf(s).any():
        raise ValueError(f"stds_m: got {s.tolist()}, want standard deviations in m")
    use = s > 0
    if not use.any():
        raise ValueError(
            f"stds_m: got {s.tolist()}, want at least one above 0; a pixel that never changes is "
            "rounded away (choose a smaller depth unit), and one frame has no std"
        )
    if not (nu[use] > 0).all():
        raise ValueError(f"dof: got {nu.tolist()}, want a positive number for each distance")
    notes = [
        f"{d:g} m is left out: " + ("no pixel ever changed there" if v == 0 else "it has no std")
        for d, v in zip(z[~use], s[~use], strict=True)
    ]
    return z[use], s[use], nu[use], notes


def _noise_notes(
    z: Floats,
    sigma: Floats,
    step: float | None,
    free: bool,
    exponent: float | None,
    left: int,
    consistent: bool,
) -> list[str]:
    notes = []
    if len(z) == 1 and exponent is None:
        notes.append("one distance has no exponent; sigma_d takes it to be 2")
    if free and z[-1] / z[0] < 3:
        notes.append(
            f"the distances span a factor of {z[-1] / z[0]:.1f} only: 10 % more noise at one end "
            f"moves the exponent by {math.log(1.1) / math.log(z[-1] / z[0]):.2f}"
        )
    if free and left == 0:
        notes.append("two distances and two unknowns leave nothing to check the law with")
    if not consistent:
        notes.append(
            "the distances scatter about the law by more than their errors; intervals are widened"
        )
    notes += [
        f"at {d:g} m the noise is {v / step:.2f} of the depth unit, and its correction supposes "
        "that the true depths lie anywhere between two steps"
        for d, v in zip(z, sigma, strict=True)
        if step and v < step / 2
    ]
    return notes


def solve(
    residuals: Callable[[Floats], Floats], start: list[float]
) -> tuple[Floats, Floats, float]:
    """The parameters, their covariance for residuals of unit variance, and chi-squared."""
    from scipy.optimize import least_squares

    found = least_squares(residuals, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12)
    covariance = np.linalg.inv(found.jac.T @ found.jac)
    return found.x, covariance, float(2 * found.cost)


def half_interval(chi2: float, dof: int) -> tuple[float, bool]:
    """Standard errors in half a 95 % interval, and whether chi-squared fits the stated errors."""
    from scipy import stats

    if dof < 1 or stats.chi2.sf(chi2, dof) > SURE:
        return float(stats.norm.ppf(0.975)), True
    return float(stats.t.ppf(0.975, dof) * math.sqrt(chi2 / dof)), False
