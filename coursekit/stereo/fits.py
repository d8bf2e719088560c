"""The noise law fitted to measurements at several distances.

Scale error and disparity offset from depths against a tape, widths against a caliper.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from coursekit.arrays import ArrayLike, Floats, Interval
from coursekit.checks import positive
from coursekit.stereo.law import fx_baseline, increasing, numbers, rounded_variance
from coursekit.words import counted, with_notes

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


FREE_CONSTANT_FROM = 5  # distances, from which a constant depth error is estimated


@dataclass(frozen=True, eq=False, repr=False)
class BiasFit:
    """Where Z_m = Z / (1 + b + o Z / (fx B)) stands, fitted; see the module's derivation.

    scale_error: s = 1 / (1 + b) - 1, what depths and widths read too large where the offset does
    not matter. disparity_offset_px: o, what disparities come out too large; None from one
    distance. fattening_px: what each edge is pushed outwards; None without widths. constant_m:
    how far behind the tape's zero the camera's lies; None unless it was fitted. Each with its
    95 % interval. covariance (2, 2) or (1, 1): of (b, o). chi2, dof, consistent, notes: as in
    `NoiseFit`.
    """

    scale_error: float
    scale_error_interval: Interval
    disparity_offset_px: float | None
    disparity_offset_interval_px: Interval | None
    fattening_px: float | None
    fattening_interval_px: Interval | None
    constant_m: float | None
    constant_interval_m: Interval | None
    n_distances: int
    fx: float
    baseline_m: float
    covariance: Floats
    chi2: float
    dof: int
    consistent: bool
    sigmas: float
    notes: tuple[str, ...] = ()

    @property
    def true_baseline_m(self) -> float:
        """The baseline that explains the scale error: B / (1 + s), m."""
        return self.baseline_m / (1 + self.scale_error)

    @property
    def true_baseline_interval_m(self) -> Interval:
        """The 95 % interval of `true_baseline_m`."""
        low, high = self.scale_error_interval
        return self.baseline_m / (1 + high), self.baseline_m / (1 + low)

    def bias_m(self, distances_m: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Z_m - Z and its 95 % band at true distances (...): (bias, low, high), each (...), m."""
        z = numbers("distances_m", distances_m)
        bias = z / (1 / (1 + self.scale_error) + self._offset(z)) - z
        slopes = np.stack([z, z**2 / (self.fx * self.baseline_m)][: len(self.covariance)], axis=-1)
        half = self.sigmas * np.sqrt(np.einsum("...i,ij,...j", slopes, self.covariance, slopes))
        return bias, bias - half, bias + half

    def _offset(self, z: Floats) -> Floats:
        return (self.disparity_offset_px or 0.0) * z / (self.fx * self.baseline_m)

    def __repr__(self) -> str:
        low, high = (100 * v for v in self.scale_error_interval)
        text = f"scale error {100 * self.scale_error:+.2f} % (95 %: {low:+.2f} to {high:+.2f})"
        constant = self.constant_interval_m
        for name, unit, value, interval in (
            ("disparity offset", "px", self.disparity_offset_px, self.disparity_offset_interval_px),
            ("edges pushed out by", "px", self.fattening_px, self.fattening_interval_px),
            ("constant", "mm", _mm(self.constant_m), constant and tuple(map(_mm, constant))),
        ):
            if value is not None and interval:
                text += f",\n    {name} {value:+.2f} {unit} "
                text += f"({interval[0]:+.2f} to {interval[1]:+.2f})"
        return with_notes(f"{text}, from {counted(self.n_distances, 'distance')}", self.notes)


def fit_bias(
    distances_m: ArrayLike,
    fx: float,
    baseline_m: float | None,
    depths_m: ArrayLike | None = None,
    depth_errors_m: ArrayLike | None = None,
    widths_m: ArrayLike | None = None,
    width_errors_m: ArrayLike | None = None,
    width_m: float | None = None,
    tape_m: float = 0.001,
    tape_zero_m: float = 0.002,
    caliper_m: float = 0.00002,
    edge_px: tuple[float, float] = (2.5, 2.5),
    edge_scatter_px: float = 0.5,
    drift_px: float = 0.0,
) -> BiasFit:
    """Scale error and disparity offset from depths against the tape, widths against the caliper.

    distances_m (K,): by tape, increasing, m. depths_m, widths_m (K,): as measured by the camera,
    with standard errors; either or both. width_m: by caliper. Standard uncertainties: tape_m of
    each tape reading; tape_zero_m of where the camera's zero is on the tape, the same for all;
    caliper_m, the same for all widths.
    edge_px: what each edge is pushed outwards, mean and standard deviation of what is known before;
    0 to 5 px are half a matching window of 11. edge_scatter_px: std of that from one distance to
    the next, where other dots fall on the edges. drift_px: std of the disparity offset from one
    distance to the next, which no averaging at one distance shows.

    Model: measured depth and width follow the module's formulas, with Gaussian errors of the
    stated sizes; what is common to several distances is a parameter with a Gaussian prior, or, for
    the caliper, a covariance. From five distances on the camera's zero is fitted without a prior.
    Generalised least squares (SciPy); intervals as in `fit_noise`. The noise that a depth and a
    width share is neglected: it is small beside the tape.
    One distance reports everything as scale, no offset, and says so.
    Raises ValueError for distances that do not increase, neither depths nor widths, widths without
    width_m, errors that are not positive, and a missing baseline.
    """
    z = increasing("distances_m", distances_m)
    depths = _measured("depths_m", depths_m, depth_errors_m, z)
    widths = _measured("widths_m", widths_m, width_errors_m, z)
    if depths is None and widths is None:
        raise ValueError("depths_m, widths_m: got neither, want at least one of them")
    if widths is not None:
        width_m = positive("width_m", width_m)
    zero_free = len(z) >= FREE_CONSTANT_FROM
    model = _Model(
        z=z,
        fx=float(fx),
        product=fx_baseline(fx, baseline_m),
        depths=depths,
        widths=widths,
        width_m=width_m or math.nan,
        tape_m=tape_m,
        tape_zero_m=math.inf if zero_free else tape_zero_m,
        caliper_m=caliper_m,
        edge_px=edge_px,
        edge_scatter_px=edge_scatter_px,
        drift_px=drift_px,
    )
    theta, covariance, chi2 = solve(model.residuals, model.start())
    left = len(model.residuals(theta)) - len(theta)
    sigmas, consistent = half_interval(chi2, left)
    half = sigmas * np.sqrt(np.diag(covariance))
    known = dict(zip(model.names(), zip(theta, half, strict=True), strict=True))
    size = 1 + ("o" in known)
    b, b_half = known["b"]
    return BiasFit(
        scale_error=float(1 / (1 + b) - 1),
        scale_error_interval=(float(1 / (1 + b + b_half) - 1), float(1 / (1 + b - b_half) - 1)),
        disparity_offset_px=_value(known.get("o")),
        disparity_offset_interval_px=_interval(known.get("o")),
        fattening_px=_value(known.get("p")),
        fattening_interval_px=_interval(known.get("p")),
        constant_m=_value(known.get("a")) if zero_free else None,
        constant_interval_m=_interval(known.get("a")) if zero_free else None,
        n_distances=len(z),
        fx=model.fx,
        baseline_m=model.product / model.fx,
        covariance=covariance[:size, :size],
        chi2=chi2,
        dof=left,
        consistent=consistent,
        sigmas=sigmas,
        notes=_bias_notes(covariance[:size, :size], consistent),
    )


@dataclass(frozen=True, eq=False)
class _Model:
    """What `fit_bias` was given, and its residuals of unit variance.

    Parameters: b, the part by which the baseline is longer; o, the disparity offset (px), from two
    distances on; p, what edges are pushed outwards (px), with widths; a, how far the camera's zero
    lies behind the tape's (m), with depths, without a prior where tape_zero_m is infinite.
    """

    z: Floats
    fx: float
    product: float
    depths: tuple[Floats, Floats] | None
    widths: tuple[Floats, Floats] | None
    width_m: float
    tape_m: float
    tape_zero_m: float
    caliper_m: float
    edge_px: tuple[float, float]
    edge_scatter_px: float
    drift_px: float

    def names(self) -> list[str]:
        """The parameters' names, in order."""
        use = {"b": True, "o": len(self.z) > 1, "p": self.widths, "a": self.depths}
        return [name for name, used in use.items() if used]

    def start(self) -> list[float]:
        """Where the search begins."""
        return [self.edge_px[0] if name == "p" else 0.0 for name in self.names()]

    def residuals(self, theta: Floats) -> Floats:
        """Measurements and priors less the model, over their standard deviations."""
        value = dict(zip(self.names(), theta, strict=True))
        o, p, a = value.get("o", 0.0), value.get("p", 0.0), value.get("a", 0.0)
        true = self.z + a
        read = true / (1 + value["b"] + o * true / self.product)
        wander = self.drift_px * self.z**2 / self.product
        parts = []
        if self.depths:
            depth, error = self.depths
            parts.append((depth - read) / np.sqrt(error**2 + self.tape_m**2 + wander**2))
            if math.isfinite(self.tape_zero_m):
                parts.append(np.array([a / self.tape_zero_m]))
        if self.widths:
            width, error = self.widths
            expected = (self.width_m / true + 2 * p / self.fx) * read
            scatter = 2 * self.edge_scatter_px * self.z / self.fx
            error = np.sqrt(error**2 + scatter**2 + (self.width_m * wander / self.z) ** 2)
            parts.append(_whiten(width - expected, error, self.caliper_m))
            parts.append(np.array([(p - self.edge_px[0]) / self.edge_px[1]]))
        return np.concatenate(parts)


def _mm(length_m: float | None) -> float | None:
    return None if length_m is None else 1e3 * length_m


def _value(known: tuple[float, float] | None) -> float | None:
    return None if known is None else float(known[0])


def _interval(known: tuple[float, float] | None) -> Interval | None:
    return None if known is None else (float(known[0] - known[1]), float(known[0] + known[1]))


def _bias_notes(covariance: Floats, consistent: bool) -> tuple[str, ...]:
    notes = []
    if len(covariance) == 1:
        notes.append("one distance cannot tell a disparity offset from scale")
    else:
        correlation = covariance[0, 1] / math.sqrt(covariance[0, 0] * covariance[1, 1])
        if abs(correlation) > 0.9:
            notes.append(
                f"these distances hardly tell the two apart (correlation {correlation:.2f}): "
                "use their sum, the bias at a distance"
            )
    if not consistent:
        notes.append("the residuals are larger than the stated errors; intervals are widened")
    return tuple(notes)


def _measured(
    name: str, values: ArrayLike | None, errors: ArrayLike | None, z: Floats
) -> tuple[Floats, Floats] | None:
    if values is None:
        return None
    measured = numbers(name, values, z.shape)
    other = name.replace("s_m", "_errors_m")
    sigma = numbers(other, np.nan if errors is None else errors)
    if not np.isfinite(measured).all() or (measured <= 0).any():
        raise ValueError(
            f"{name}: got {measured.tolist()}, want a positive length for each distance"
        )
    if sigma.shape not in ((), z.shape) or not (np.isfinite(sigma) & (sigma > 0)).all():
        raise ValueError(f"{other}: got {sigma.tolist()}, want a positive error for each distance")
    return measured, np.broadcast_to(sigma, z.shape)


def _whiten(residual: Floats, error: Floats, common: float) -> Floats:
    """Residuals of unit covariance from ones with `error` each and `common` to all."""
    covariance = np.diag(error**2) + common**2
    return np.linalg.solve(np.linalg.cholesky(covariance), residual)
