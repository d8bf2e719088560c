"""Depth from disparity, the noise law, and what rounding to a depth unit does to noise."""

from __future__ import annotations

import math

import numpy as np

from coursekit.arrays import ArrayLike, Floats
from coursekit.checks import array, number, positive, want, whole
from coursekit.words import say


def depth_from_disparity(disparity_px: ArrayLike, fx: float, baseline_m: float | None) -> Floats:
    """Z = fx baseline / d in m, for disparities (...) in px; NaN where d is not positive.

    Raises ValueError for a focal length (px) or baseline (m) that is not positive.

    >>> print(depth_from_disparity([44.7, 0.0], fx=447.0, baseline_m=0.05))
    [0.5 nan]
    """
    d = array("disparity_px", disparity_px, leading=True)
    return fx_baseline(fx, baseline_m) / np.where((d > 0) & np.isfinite(d), d, np.nan)


def depth_slope(depth_m: ArrayLike, fx: float, baseline_m: float | None) -> Floats:
    """dZ/dd = -Z^2 / (fx baseline), the metres of depth that a pixel of disparity makes.

    depth_m (...): m. Returns (...) in m/px, negative: more disparity is nearer.
    """
    return -np.square(array("depth_m", depth_m, leading=True)) / fx_baseline(fx, baseline_m)


def depth_noise(
    depth_m: ArrayLike, fx: float, baseline_m: float | None, sigma_d_px: ArrayLike
) -> Floats:
    """The law: sigma_Z = Z^2 sigma_d / (fx baseline), m, for depths (...) in m.

    Raises ValueError for a focal length or baseline that is not positive.

    >>> print(depth_noise([0.4, 0.8], fx=447.0, baseline_m=0.05, sigma_d_px=0.08).round(5))
    [0.00057 0.00229]
    """
    sigma = array("sigma_d_px", sigma_d_px, leading=True)
    return np.abs(depth_slope(depth_m, fx, baseline_m)) * sigma


def robust_depth(
    depth_m: ArrayLike, u: float, v: float, half: int = 2, min_valid: int = 5
) -> float:
    """The median depth of the (2 half + 1)^2 pixels around the pixel nearest to (u, v), m.

    depth_m (H, W): m; zero, negative, NaN and infinite are left out. At the border the window is
    cut, never wrapped. NaN where fewer than `min_valid` pixels are valid, off the image included.
    Raises ValueError for an image that is not 2-D and for u, v, half or min_valid that are no
    numbers.

    >>> robust_depth(np.full((5, 5), 0.45), u=2.2, v=1.8)
    0.45
    """
    image = np.asarray(depth_m)
    want(image.ndim == 2, "depth_m", image.shape, "one image (H, W)")
    column, row = (round(number(name, at)) for name, at in (("u", u), ("v", v)))
    whole("half", half, least=0)
    whole("min_valid", min_valid)
    rows = slice(max(row - half, 0), max(row + half + 1, 0))
    columns = slice(max(column - half, 0), max(column + half + 1, 0))
    values = image[rows, columns].astype(np.float64)
    valid = values[(values > 0) & np.isfinite(values)]
    return float(np.median(valid)) if valid.size >= min_valid else math.nan


def rounded_variance(sigma: ArrayLike, step: float) -> Floats:
    """The variance over time of values that are rounded to multiples of `step`.

    sigma (...): std before rounding, in the unit of `step`. The mean over pixels whose true values
    lie anywhere between two steps. With y = round(x) and x = mu + noise, y - x is uniform and
    independent of the noise, so E(y - mu)^2 = sigma^2 + step^2 / 12 at any sigma; what of it is
    constant in time, the bias at mu, is a Fourier series in mu and does not show:

        sigma^2 + step^2 / 12 - step^2 / (2 pi^2) sum_k exp(-4 pi^2 k^2 sigma^2 / step^2) / k^2.

    From sigma = step / 2 on this is Sheppard's correction, sigma^2 + step^2 / 12, whatever mu;
    below it needs pixels at many mu; for small sigma it tends to sigma step / sqrt(pi).
    """
    s = array("sigma", sigma, leading=True) / step
    k = np.arange(1, 6)
    series = (np.exp(-np.square(2 * np.pi * s[..., None] * k)) / k**2).sum(axis=-1)
    exact = s**2 + 1 / 12 - series / (2 * np.pi**2)
    return step**2 * np.where(s < 0.15, s / math.sqrt(math.pi), exact)


def unrounded_std(std: float, step: float | None) -> float:
    """The std before rounding of values whose pooled std over time is `std`, same units.

    The inverse of `rounded_variance`; with no step, or a std that is zero or NaN, `std` itself.
    """
    from scipy.optimize import brentq

    if step is None or not std > 0:
        return std
    return float(brentq(lambda s: float(rounded_variance(s, step)) - std**2, 0.0, std))


def fx_baseline(fx: float, baseline_m: float | None) -> float:
    """fx baseline, px m, of a focal length and a baseline that are known and positive."""
    if baseline_m is None:
        raise ValueError(say("stereo.no_baseline"))
    return positive("fx", fx) * positive("baseline_m", baseline_m)
