"""How the laws of noise and of bias are fitted to measurements at several distances.

`fit_noise` fits sigma_Z = Z^2 sigma_d / (f B) to the std of depth over time. `fit_bias` fits
Z_m = Z / (1 + b + o Z / (f B)) to depths against a tape and widths against a caliper. The room's
docstring derives both. Each is a least-squares fit of residuals that have unit variance where the
stated errors are right; where they are too small to explain the residuals, the intervals are
widened and the fit says so.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from coursekit.arrays import ArrayLike, Floats, Interval
from coursekit.checks import array, choice, positive, want
from coursekit.stereo.law import fx_baseline, rounded_variance
from coursekit.words import Estimate, counted, say, with_notes

WIDENED_BELOW = 0.05  # scatter less likely than this by chance widens the intervals
FREE_CONSTANT_FROM = 5  # distances, from which a constant depth error is estimated


@dataclass(frozen=True, eq=False, repr=False)
class LawFit(Estimate):
    """A law whose parameters were fitted to residuals of unit variance.

    names (k), theta (k,): the parameters, which `value`, `sigma` and `Estimate.interval` take by
    name. covariance (k, k): theirs, if the stated errors are right. chi2: the sum of the squared
    residuals; n_residuals: how many there were. fx (px), baseline_m: what the camera reports, the
    latter None where it has none. notes: what a reader must know. scatter_dof: how many squares
    the scatter between repeats was estimated from, where it is part of the errors.
    """

    names: tuple[str, ...]
    theta: Floats
    covariance: Floats
    chi2: float
    n_residuals: int
    n_distances: int
    fx: float
    baseline_m: float | None
    notes: tuple[str, ...] = ()
    scatter_dof: float = math.inf

    def value(self, name: str) -> float:
        """The estimate of one of `names`."""
        return float(self.theta[self.names.index(choice("name", name, self.names))])

    def sigma(self, name: str) -> float:
        """The standard deviation of one of `names`, if the stated errors are right."""
        at = self.names.index(choice("name", name, self.names))
        return math.sqrt(self.covariance[at, at])

    @property
    def dof(self) -> int:
        """The number of residuals less that of parameters."""
        return self.n_residuals - len(self.theta)

    @property
    def consistent(self) -> bool:
        """Whether the stated errors explain how large the residuals are."""
        from scipy.special import chdtrc

        return self.dof < 1 or bool(chdtrc(self.dof, self.chi2) > WIDENED_BELOW)

    def quantile(self, level: float = 0.95) -> float:
        """How many sigmas an interval of probability `level` reaches to either side.

        Of a normal distribution where the fit is consistent, or Student's t where the errors rest
        on repeats; else Student's t, and more by the factor by which the residuals are larger than
        their errors.
        """
        from scipy.special import stdtrit

        if self.consistent:
            return float(stdtrit(self.scatter_dof, (1 + level) / 2))
        return super().quantile(level) * math.sqrt(self.chi2 / self.dof)

    def _half_band(self, slopes: list[Floats]) -> Floats:
        """Half the 95 % band of something with these derivatives by the first parameters."""
        by = np.stack(slopes[: len(self.theta)], axis=-1)
        known = self.covariance[: by.shape[-1], : by.shape[-1]]
        return self.quantile() * np.sqrt(np.einsum("...i,ij,...j", by, known, by))


def _fitted(
    residuals: Callable[[Floats], Floats],
    start: dict[str, float],
    z: Floats,
    fx: float,
    baseline_m: float | None,
) -> dict[str, Any]:
    """What a `LawFit` is made of: the parameters that make residuals(theta) smallest.

    z (K,): the distances, m; fx (px), baseline_m: as the camera reports them.
    """
    from scipy.optimize import least_squares

    ends = dict.fromkeys(("xtol", "ftol", "gtol"), 1e-12)
    found = least_squares(residuals, list(start.values()), x_scale="jac", **ends)
    covariance, chi2 = np.linalg.inv(found.jac.T @ found.jac), float(2 * found.cost)
    told = {"names": tuple(start), "theta": found.x, "covariance": covariance, "chi2": chi2}
    counts = {"n_residuals": len(found.fun), "n_distances": len(np.unique(z))}
    return told | counts | {"fx": fx, "baseline_m": baseline_m}


def _positive(name: str, values: ArrayLike) -> Floats:
    z = np.atleast_1d(array(name, values, leading=True)).round(6)  # 0.1 + 0.2 is 0.3
    fits = z.ndim == 1 and z.size > 0 and np.isfinite(z).all() and (z > 0).all()
    want(fits, name, z, "positive distances in m")
    return z


# --- noise ---


@dataclass(frozen=True, eq=False, repr=False, kw_only=True)
class NoiseFit(LawFit):
    """sigma_Z = (r^2 sigma_d / (fx B)) (Z / r)^exponent, fitted; r = reference_m.

    Parameters: "ln_std" (of std in m at r) and, where it is not held, "exponent". held: what the
    exponent was held at, None where it was fitted or where one distance cannot give one. scatter:
    by which part the stds of repeats at one distance differ beyond their errors; 0 without repeats.
    """

    reference_m: float
    held: float | None
    scatter: float = 0.0

    @property
    def sigma_d_px(self) -> float:
        """Disparity noise at the reference distance (at any distance if the exponent is 2), px.

        Like its interval it raises ValueError for a camera without a baseline: it has no disparity.
        """
        return self._to_px(self.value("ln_std"))

    @property
    def sigma_d_interval_px(self) -> Interval:
        """The 95 % interval of `sigma_d_px`."""
        low, high = self.interval("ln_std")
        return self._to_px(low), self._to_px(high)

    def _to_px(self, ln_std: float) -> float:
        return math.exp(ln_std) * fx_baseline(self.fx, self.baseline_m) / self.reference_m**2

    @property
    def exponent(self) -> float | None:
        """The exponent of Z, as fitted or as held; None where one distance cannot give one."""
        return self.value("exponent") if "exponent" in self.names else self.held

    @property
    def exponent_interval(self) -> Interval | None:
        """The 95 % interval of the exponent, None unless it was fitted."""
        return self.interval("exponent") if "exponent" in self.names else None

    def std_m(self, distances_m: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """The fitted law and its 95 % band at distances (...): (std, low, high), each (...), m."""
        ratio = np.log(array("distances_m", distances_m, leading=True) / self.reference_m)
        power = 2.0 if self.exponent is None else self.exponent
        middle = np.exp(self.value("ln_std") + power * ratio)
        half = self._half_band([np.ones_like(ratio), ratio])
        return middle, middle * np.exp(-half), middle * np.exp(half)

    def __repr__(self) -> str:
        if self.baseline_m is None:
            std, low, high = (1e3 * float(v) for v in self.std_m(self.reference_m))
            text = f"std of depth at {self.reference_m:.2f} m = {std:.3f} mm "
            text += f"(95 %: {low:.3f} to {high:.3f})"
        else:
            low, high = self.sigma_d_interval_px
            text = f"sigma_d = {self.sigma_d_px:.3f} px (95 %: {low:.3f} to {high:.3f})"
        if self.exponent is None:
            text += ", no exponent"
        elif self.exponent_interval is None:
            text += f", exponent held at {self.exponent:g}"
        else:
            low, high = self.exponent_interval
            text += f", exponent {self.exponent:z.2f} ({low:z.2f} to {high:z.2f})"
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

    distances_m (K,): m, in any order; a distance may come again. stds_m (K,): std over time of one
    pixel's depth as measured, rounding included, m; NaN is left out. baseline_m: None for a camera
    that has none: its std is fitted over distance, and there is no sigma_d. dof (K,) or one number:
    independent squares in each, as `WindowStats.pixel_dof` says. depth_scale_m: the depth unit, to
    correct for; None leaves the rounding in. exponent: 2 to hold it, None to fit it.

    Model: dof_i s_i^2 / V_i is chi-squared with dof_i, V_i = `rounded_variance` of the law; so
    ln s_i has known mean and variance (digamma, trigamma) and the fit is weighted least squares
    on it. Intervals are 1.96 standard errors, of ln sigma_d and of the exponent. How much a std
    changes from run to run, when camera and wall are set up anew, only repeats of a distance show:
    what they scatter beyond that model (Paule and Mandel, J. Res. NBS 87 (1982), 377-385) is added
    to the error of each, and Student's t has the degrees of freedom that it rests on. Where the
    residuals are larger than that model lets them be (chi-squared beyond 5 %), the standard errors
    are scaled to the residuals and Student's t takes the place of 1.96.
    One distance holds the exponent at 2 to get sigma_d, reports no exponent, and says so.
    Raises ValueError for distances, stds or a dof that are not positive, or stds that are all zero
    or NaN.

    >>> stds_m = [0.00057, 0.00129, 0.00358]
    >>> fit_noise([0.4, 0.6, 1.0], stds_m, dof=800, fx=447.0, baseline_m=0.05, exponent=2)
    sigma_d = 0.080 px (95 %: 0.078 to 0.082), exponent held at 2, from 3 distances
    """
    from scipy.special import digamma, polygamma

    if baseline_m is not None:
        fx_baseline(fx, baseline_m)
    camera = positive("fx", fx), None if baseline_m is None else float(baseline_m)
    z, s, nu, left_out = _noise_points(distances_m, stds_m, dof)
    reference = float(np.exp(np.log(z).mean()))
    expected = np.log(s) - (digamma(nu / 2) - np.log(nu / 2)) / 2
    error = np.sqrt(polygamma(1, nu / 2)) / 2
    scatter, scatter_dof = _scatter(z, expected, error)
    error = np.hypot(error, scatter)
    start = {"ln_std": float(np.mean(np.log(s) - 2 * np.log(z / reference)))}
    if exponent is None and np.ptp(z) > 0:
        start["exponent"] = 2.0
    power = 2.0 if exponent is None else float(exponent)

    def residuals(theta: Floats) -> Floats:
        powers = theta[1] if len(theta) > 1 else power
        sigma = np.exp(theta[0] + powers * np.log(z / reference))
        variance = rounded_variance(sigma, depth_scale_m) if depth_scale_m else sigma**2
        return (expected - np.log(variance) / 2) / error

    fit = NoiseFit(
        **_fitted(residuals, start, z, *camera),
        reference_m=reference,
        held=None if exponent is None else power,
        scatter=scatter,
        scatter_dof=scatter_dof,
    )
    return replace(fit, notes=(*left_out, *_noise_notes(fit, np.unique(z), depth_scale_m)))


def _scatter(z: Floats, values: Floats, errors: Floats) -> tuple[float, float]:
    """The std by which values (K,) at equal z (K,) differ beyond their errors (K,), and its dof.

    Paule and Mandel's: with it the weighted squares about each distance's mean are as many as there
    are repeats. The dof are those of the sum with the errors, by Satterthwaite; infinite for none.
    """
    from scipy.optimize import brentq

    _, group = np.unique(z, return_inverse=True)
    repeats = len(z) - int(group.max()) - 1

    def excess(variance: float) -> float:
        weights = 1 / (errors**2 + variance)
        mean = np.bincount(group, weights * values) / np.bincount(group, weights)
        return float(weights @ np.square(values - mean[group])) - repeats

    if repeats == 0 or excess(0.0) <= 0:
        return 0.0, math.inf
    most = float(np.ptp(values)) ** 2 * len(z)
    variance = float(brentq(excess, 0.0, most))
    return math.sqrt(variance), repeats * (1 + float(np.mean(errors**2)) / variance) ** 2


def _noise_points(
    distances_m: ArrayLike, stds_m: ArrayLike, dof: ArrayLike
) -> tuple[Floats, Floats, Floats, list[str]]:
    """The distances, stds and dof that a fit can use, and notes on those it cannot."""
    z = _positive("distances_m", distances_m)
    s = array("stds_m", stds_m, z.shape)
    nu = np.broadcast_to(array("dof", dof, z.shape if np.ndim(dof) else ()), z.shape)
    use = s > 0
    want(not ((s < 0) | np.isinf(s)).any(), "stds_m", s, "standard deviations in m")
    wanted = "one above 0, which takes two frames and a depth unit that does not hide the noise"
    want(use.any(), "stds_m", s, wanted)
    want(((nu > 0) & (nu < np.inf))[use].all(), "dof", nu, "a positive number for each distance")
    notes = [
        f"{d:g} m is left out: " + ("no pixel ever changed there" if v == 0 else "it has no std")
        for d, v in zip(z[~use], s[~use], strict=True)
    ]
    return z[use], s[use], nu[use], notes


def _noise_notes(fit: NoiseFit, z: Floats, step: float | None) -> Iterator[str]:
    free, span = "exponent" in fit.names, z[-1] / z[0]
    if fit.baseline_m is None:
        yield say("stereo.std_alone")
    if fit.exponent is None:
        what = "std elsewhere" if fit.baseline_m is None else "sigma_d"
        yield say("stereo.no_exponent", what=what)
    if fit.scatter > 0:
        yield say("stereo.repeats", scatter=fit.scatter)
    if free and span < 3:
        yield say("stereo.short_span", span=span, moves=math.log(1.1) / math.log(span))
    if free and fit.dof == 0:
        yield say("stereo.no_freedom")
    if not fit.consistent:
        yield say("stereo.off_the_law")
    for d, std in zip(z, fit.std_m(z)[0], strict=True):
        if step and std < step / 2:
            yield say("stereo.below_the_unit", d=d, share=std / step)


# --- bias ---


@dataclass(frozen=True)
class BiasPriors:
    """Standard uncertainties of what `fit_bias` is not told by its measurements.

    tape_zero_m: of where the camera's zero is on the tape, the same for all distances. caliper_m:
    of the block's width. edge_px: what each edge is pushed outwards, mean and standard deviation;
    0 to 5 px are half a matching window of 11. edge_scatter_px: std of that from one distance to
    the next, where other dots fall on the edges. drift_px: std of the disparity offset from one
    distance to the next, which no averaging at one distance shows.
    """

    tape_zero_m: float = 0.002
    caliper_m: float = 0.00002
    edge_px: tuple[float, float] = (2.5, 2.5)
    edge_scatter_px: float = 0.5
    drift_px: float = 0.0


@dataclass(frozen=True, eq=False, repr=False)
class BiasFit(LawFit):
    """Where Z_m = Z / (1 + b + o Z / (fx B)) stands, fitted; the room's docstring derives it.

    Parameters: "baseline_error", b, the part by which the baseline is longer than reported.
    "disparity_offset_px", o, what disparities come out too large; from two distances on.
    "fattening_px": what each edge is pushed outwards; with widths. "constant_m": how far behind
    the tape's zero the camera's lies; with depths at five distances or more. With fewer it is
    "tape_zero_m", which `BiasPriors` says more about than the measurements.
    """

    @property
    def scale_error(self) -> float:
        """1 / (1 + b) - 1: what depths and widths read too large where the offset is nothing."""
        return 1 / (1 + self.value("baseline_error")) - 1

    @property
    def scale_error_interval(self) -> Interval:
        """The 95 % interval of `scale_error`; without an end where the baseline may be nothing."""
        low, high = self.interval("baseline_error")
        return 1 / (1 + high) - 1, 1 / (1 + low) - 1 if low > -1 else math.inf

    def bias_m(self, distances_m: ArrayLike) -> tuple[Floats, Floats, Floats]:
        """Z_m - Z and its 95 % band at true distances (...): (bias, low, high), each (...), m."""
        z = array("distances_m", distances_m, leading=True)
        product, free = fx_baseline(self.fx, self.baseline_m), "disparity_offset_px" in self.names
        offset = self.value("disparity_offset_px") if free else 0.0
        bias = z / (1 + self.value("baseline_error") + offset * z / product) - z
        half = self._half_band([z, z**2 / product] if free else [z])
        return bias, bias - half, bias + half

    @property
    def law(self) -> tuple[Floats, Floats]:
        """(s, o) of the bias s Z - o Z^2 / (fx B), to first order, and their covariance (2, 2).

        s: `scale_error`; o in px, 0 where one distance could not tell. The covariance is wide
        enough that 1.96 standard deviations are the 95 % of `Estimate.interval`.
        """
        n = min(len(self.theta), 1 + ("disparity_offset_px" in self.names))
        known, theta = np.zeros((2, 2)), np.array([self.scale_error, *self.theta[1:n], 0.0])[:2]
        known[:n, :n] = self.covariance[:n, :n] * (self.quantile() / 1.96) ** 2
        return theta, known * [[1, -1], [-1, 1]]

    def __repr__(self) -> str:
        low, high = (100 * v for v in self.scale_error_interval)
        most = f"{high:+z.2f}" if high < 1e3 else "over 1000"
        text = f"scale error {100 * self.scale_error:+z.2f} % (95 %: {low:+z.2f} to {most})"
        for name, says, unit, factor in (
            ("disparity_offset_px", "disparity offset", "px", 1),
            ("fattening_px", "edges pushed out by", "px", 1),
            ("constant_m", "constant", "mm", 1e3),
        ):
            if name in self.names:
                low, high = (factor * v for v in self.interval(name))
                text += f",\n    {says} {factor * self.value(name):+z.2f} {unit} "
                text += f"({low:+z.2f} to {high:+z.2f})"
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
    priors: BiasPriors = BiasPriors(),
) -> BiasFit:
    """Scale error and disparity offset from depths against the tape, widths against the caliper.

    distances_m (K,): by tape, m, in any order, repeats welcome. depths_m, widths_m (K,): as
    measured by the camera, with standard errors; either or both. width_m: by caliper. tape_m:
    standard uncertainty of each tape reading. priors: what else is not exact.

    Model: measured depth and width follow the room's formulas, with Gaussian errors of the stated
    sizes; what is common to several distances is a parameter with a Gaussian prior, or, for the
    caliper, a covariance. From five distances on the camera's zero is fitted without a prior.
    Generalised least squares (SciPy); intervals as in `fit_noise`. The noise that a depth and a
    width share is neglected: it is small beside the tape.
    One distance reports everything as scale, no offset, and says so.
    Raises ValueError for distances that are not positive, neither depths nor widths, widths without
    width_m, errors that are not positive, and a missing baseline.

    >>> fit_bias([0.3, 0.45, 0.6], 447.0, 0.05, [0.301, 0.4515, 0.602], depth_errors_m=0.0002)
    scale error +0.33 % (95 %: -1.79 to +2.55),
        disparity offset +0.00 px (-0.67 to +0.67), from 3 distances.
        Note: these distances hardly tell the two apart (correlation -0.95): use their sum,
        the bias at a distance.
    """
    z = _positive("distances_m", distances_m)
    product = fx_baseline(fx, baseline_m)
    depths = _measured("depths_m", depths_m, depth_errors_m, z)
    widths = _measured("widths_m", widths_m, width_errors_m, z)
    if depths is None and widths is None:
        raise ValueError("depths_m, widths_m: got neither, want at least one of them")
    width = math.nan if widths is None else positive("width_m", width_m)
    n_distances = len(np.unique(z))
    zero = "constant_m" if n_distances >= FREE_CONSTANT_FROM else "tape_zero_m"
    start = {"baseline_error": 0.0}
    if n_distances > 1:
        start["disparity_offset_px"] = 0.0
    if widths:
        start["fattening_px"] = priors.edge_px[0]
    if depths:
        start[zero] = 0.0
    drift = priors.drift_px * z**2 / product

    def residuals(theta: Floats) -> Floats:
        """Measurements and priors less the model, over their standard deviations."""
        value = dict(zip(start, theta, strict=True))
        true = z + value.get(zero, 0.0)
        offset = value.get("disparity_offset_px", 0.0) * true / product
        read = true / (1 + value["baseline_error"] + offset)
        parts = []
        if depths:
            depth, error = depths
            parts.append((depth - read) / np.sqrt(error**2 + tape_m**2 + drift**2))
            if zero == "tape_zero_m":
                parts.append([value[zero] / priors.tape_zero_m])
        if widths:
            measured, error = widths
            pushed = value["fattening_px"]
            off = measured - (width / true + 2 * pushed / fx) * read
            scatter = 2 * priors.edge_scatter_px * z / fx
            variance = error**2 + scatter**2 + (width * drift / z) ** 2
            shared = np.diag(variance) + priors.caliper_m**2
            parts.append(np.linalg.solve(np.linalg.cholesky(shared), off))
            parts.append([(pushed - priors.edge_px[0]) / priors.edge_px[1]])
        return np.concatenate(parts)

    fit = BiasFit(**_fitted(residuals, start, z, float(fx), product / float(fx)))
    return replace(fit, notes=tuple(_bias_notes(fit)))


def _bias_notes(fit: BiasFit) -> Iterator[str]:
    if "disparity_offset_px" not in fit.names:
        yield say("stereo.offset_or_scale")
    else:
        of_both = fit.sigma("baseline_error") * fit.sigma("disparity_offset_px")
        correlation = fit.covariance[0, 1] / of_both
        ends = fit.interval("baseline_error"), fit.interval("disparity_offset_px")
        if abs(correlation) > 0.9 and any(low <= 0 <= high for low, high in ends):
            yield say("stereo.hardly_apart", correlation=correlation)
    if not fit.consistent:
        yield say("stereo.larger_residuals")


def _measured(
    name: str, values: ArrayLike | None, errors: ArrayLike | None, z: Floats
) -> tuple[Floats, Floats] | None:
    """Lengths (K,) that were measured at the distances z (K,) and their standard errors (K,)."""
    if values is None:
        return None
    measured = array(name, values, z.shape)
    want((np.isfinite(measured) & (measured > 0)).all(), name, measured, "positive lengths in m")
    other = name.replace("s_m", "_errors_m")
    errors = math.nan if errors is None else errors
    error = array(other, errors, z.shape if np.ndim(errors) else ())
    want((np.isfinite(error) & (error > 0)).all(), other, error, "positive errors in m")
    return measured, np.broadcast_to(error, z.shape)
