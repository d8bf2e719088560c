"""What a depth stack says in a window: its level, its noise over time, what averaging buys.

A window lies on one smooth surface. Its noise over time is that of single pixels, pooled, and how
well it is known depends on how many of the samples are independent: neighbours share their
matching window, and frames can share a drift (`window_stats`). The same drift limits what the mean
of many frames buys (`averaging_curve`, `effective_frames`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from coursekit.arrays import AnyArray, ArrayLike, Bools, Floats, Integers, Interval, Window
from coursekit.checks import array, positive, refuse, want
from coursekit.stereo.law import unrounded_std

CORRELATION_PX = 12  # disparities farther apart than the matching window (11 px) are independent
JUMP_SIGMAS = 8.0  # a sample this far from the rest is a mismatch, not noise
# A block matcher's noise differs by a factor of up to 2.5 between parts of a bland wall and of 1.2
# between parts of a stack, and its excess kurtosis is within 0.3 of 0 (D435, simulated).
PARTS_APART, TIMES_APART, FAR_FROM_GAUSS = 3.0, 1.5, 1.0
TWO_CLUSTERS = 5.0  # gap over spread; an evenly spread depth split in halves has 3.5
CHI2_95 = 3.84  # 95 % of chi-squared with one degree of freedom lies below
DRIFT_SLACK = 0.05  # of 2 log likelihood: a drift that explains no more than this is not assumed


# --- stacks and windows of them ---


def first_frame(depth: Any) -> Any:
    """The first of a camera's frames, or None for an array."""
    return depth[0] if hasattr(depth, "__getitem__") and len(depth) else None


def depth_stack(depth: Any, depth_scale_m: float | None) -> tuple[AnyArray, float | None]:
    """The stack (N, H, W) as it came, and its unit; frames bring both."""
    refuse(hasattr(depth, "__len__") and len(depth) == 0, "depth: got 0 frames, want at least one")
    if hasattr(first_frame(depth), "depth_scale_m"):
        depth, depth_scale_m = np.stack([f.depth for f in depth]), depth[0].depth_scale_m
    stack = np.asarray(depth)
    stack = stack[None] if stack.ndim == 2 else stack
    want(stack.ndim == 3, "depth", stack.shape, "(N, H, W)")
    want(stack.dtype.kind in "uf", "depth", stack.dtype, "unsigned counts or floats in m")
    if depth_scale_m is None and stack.dtype.kind == "f":
        return stack, None
    return stack, positive("depth_scale_m", depth_scale_m, "the metres of a count")


def cut(stack: AnyArray, window: Window, step: float | None) -> Floats:
    """The window's depths (N, h, w) in m, NaN where invalid; ValueError off the image.

    Of counts the largest that the type holds is no depth either: it is where they end.
    """
    rows, columns = stack.shape[1:]
    try:
        left, top, width, height = given = tuple(int(v) for v in window)
        inside = 0 <= left < left + width <= columns and 0 <= top < top + height <= rows
        fits = inside and given == tuple(window)
    except (TypeError, ValueError):
        fits = False
    wanted = f"(left, top, width, height) in whole px inside the image of {columns}x{rows} px"
    want(fits, "window", window, wanted)
    part = stack[:, top : top + height, left : left + width]
    z = part.astype(np.float64)
    if part.dtype.kind == "u":
        z *= step or 1.0
        z[part == np.iinfo(part.dtype).max] = np.nan
    z[~((z > 0) & np.isfinite(z))] = np.nan
    return z


def clip_window(window: Window, stack: AnyArray) -> Window:
    """The part of a window that is on the image; ValueError when there is none."""
    left, top = max(window[0], 0), max(window[1], 0)
    right = min(window[0] + window[2], stack.shape[2])
    bottom = min(window[1] + window[3], stack.shape[1])
    want(right > left and bottom > top, "near", window, "a window around it that is on the image")
    return left, top, right - left, bottom - top


# --- one window ---


@dataclass(frozen=True, eq=False)
class WindowStats:
    """What a stack of depth images says in one window; lengths in m, NaN where nothing says it.

    depth_m: mean, at the window's centre, of a plane through the time means. depth_error_m: its
    standard error, from the frames and from patches of the window (the pattern that stays).
    pixel_std_m: std over time of one pixel, pooled over the window, as measured; pixel_dof: the
    number of independent squares in it. pixel_std_unrounded_m: the same without the depth unit's
    rounding. mean_std_m, mean_dof: std over time of the window's mean. spatial_std_m: std over the
    pixels of one frame about its plane. invalid_fraction: of all samples. n_mismatches: of the
    valid samples, those far from their pixel's median or off the plane, left out of all else.
    frozen_fraction: pixels that never change. means_m (N,): the window's mean in each frame.
    not_gaussian: what in the window is not one Gaussian noise, in words; it has lowered pixel_dof.
    """

    n_frames: int
    n_pixels: int
    invalid_fraction: float
    n_mismatches: int
    frozen_fraction: float
    depth_m: float
    depth_error_m: float
    pixel_std_m: float
    pixel_dof: float
    pixel_std_unrounded_m: float
    mean_std_m: float
    mean_dof: float
    spatial_std_m: float
    means_m: Floats
    depth_scale_m: float | None = None
    not_gaussian: tuple[str, ...] = ()

    @property
    def pixel_std_error_m(self) -> float:
        """Standard error of `pixel_std_m`: std / sqrt(2 dof)."""
        return std_error(self.pixel_std_m, self.pixel_dof)

    @property
    def pixel_std_interval_m(self) -> Interval:
        """95 % interval of `pixel_std_m`: dof s^2 / sigma^2 is chi-squared with pixel_dof."""
        from scipy.special import chdtri

        ends = chdtri(self.pixel_dof, [0.025, 0.975]) / self.pixel_dof
        low, high = self.pixel_std_m / np.sqrt(ends)
        return float(low), float(high)


def window_stats(depth: Any, window: Window, depth_scale_m: float | None = None) -> WindowStats:
    """Noise, level and holes of a depth stack in a window that lies on one smooth surface.

    depth: stack or frames, see the room. window: (left, top, width, height) px.
    depth_scale_m: m per count; for floats, what they were rounded to, or None.

    Model of `pixel_dof`: Gaussian noise with an unknown covariance over the window's pixels, plus
    a drift that all pixels share. The covariance's participation ratio (tr C)^2 / tr C^2, unbiased
    as in Srivastava (2005), counts independent pixels; squared autocorrelations count independent
    frames; noise and drift add as by Satterthwaite. A drift slower than the stack is not seen.
    Where `_not_gaussian` finds more than one Gaussian noise it lowers pixel_dof.
    Model of `depth_error_m`: the mean over time with its effective number of frames, and the
    spread of the plane's residuals over patches of CORRELATION_PX px, in quadrature.

    One frame gives NaN for everything over time; a window without valid pixels NaN for all
    lengths. Raises ValueError for no frames, a window off the image, or counts without a unit.

    >>> frames = 0.5 + 0.001 * np.random.default_rng(2).standard_normal((50, 20, 20))
    >>> print(f"{1e3 * window_stats(frames, (0, 0, 20, 20)).pixel_std_m:.2f} mm")
    1.00 mm
    """
    stack, step = depth_stack(depth, depth_scale_m)
    measured = cut(stack, window, step)
    return stats_without_mismatches(measured, without_mismatches(measured, step)[0], step)


def stats_without_mismatches(measured: Floats, z: Floats, step: float | None) -> WindowStats:
    """See `window_stats`, of depths (N, h, w) in m, and of the same with NaN for mismatches."""
    valid = np.isfinite(measured)
    n, height, width = z.shape
    mean = valid_mean(z, axis=0)
    deviation = (z - mean)[:, np.isfinite(z).sum(axis=0) > 1]
    pixel_std, pixel_dof, drift = _temporal(deviation.reshape(n, -1))
    pixel_dof, gap, not_gaussian = _not_gaussian(z, mean, drift, pixel_std, pixel_dof, step)
    mean_std, mean_dof = series_std(drift)
    moves = n > 1 and deviation.size
    frozen = (np.nanmax(np.abs(deviation), axis=0) < 1e-12).mean() if moves else math.nan
    residual, level = about_plane(mean)
    moved = 0.0 if n == 1 else mean_std / math.sqrt(effective_frames(drift[:, None])[0])
    return WindowStats(
        n_frames=n,
        n_pixels=height * width,
        invalid_fraction=1 - float(valid.mean()),
        n_mismatches=int(valid.sum() - np.isfinite(z).sum()),
        frozen_fraction=float(frozen),
        depth_m=float(level),
        depth_error_m=math.hypot(moved, _patch_error(residual), gap / 2),
        pixel_std_m=pixel_std,
        pixel_dof=pixel_dof,
        pixel_std_unrounded_m=unrounded_std(pixel_std, step),
        mean_std_m=mean_std,
        mean_dof=mean_dof,
        spatial_std_m=off_plane(z),
        means_m=level + drift,
        depth_scale_m=step,
        not_gaussian=not_gaussian,
    )


def without_mismatches(z: Floats, step: float | None) -> tuple[Floats, int]:
    """The stack (N, h, w) with NaN for mismatches, and their number.

    A mismatch is far from its pixel's median, by the noise of the window and by that of the pixel,
    for some places are noisier than others; or this median is far off the window's plane.

    >>> z = np.full((5, 3, 3), 0.45)
    >>> z[2, 1, 1] = 0.52
    >>> without_mismatches(z, 0.0001)[1]
    1
    """
    middle = valid_median(z)
    off = np.abs(z - middle)
    jumps = _far(off, step)
    at = jumps.any(axis=0) & (np.isfinite(z).sum(axis=0) >= 8)  # fewer say nothing of a pixel
    jumps[:, at] &= off[:, at] > JUMP_SIGMAS * 1.4826 * valid_median(off[:, at])
    for _ in range(2):  # the second plane is free of what the first one throws out
        middle = np.where(_far(about_plane(middle)[0], step), np.nan, middle)
    jumps |= np.isfinite(z) & np.isnan(middle)
    return np.where(jumps, np.nan, z), int(jumps.sum())


def _not_gaussian(
    z: Floats, mean: Floats, drift: Floats, std: float, dof: float, step: float | None
) -> tuple[float, float, tuple[str, ...]]:
    """What in a stack (N, h, w) is not one Gaussian noise: the dof it leaves, a gap in m, words.

    mean (h, w), drift (N,): of the stack. std, dof: of a pixel, as for one Gaussian noise. A
    variance from samples of excess kurtosis k has 1 + k / 2 times the variance of a Gaussian one's;
    that of parts which differ is known no better than by how much they differ, and pixels that jump
    between two depths, or lie on two surfaces, count as one pixel. Fewer than 8 frames, and noise
    that the depth unit hides, say nothing.
    """
    n, words = len(z), []
    gap = _two_surfaces(mean, max(JUMP_SIGMAS * np.nan_to_num(std), step or 0.0))
    if gap > 0:
        words.append(f"two surfaces, {1e3 * gap:.1f} mm apart: move the window off the edge")
        dof = min(dof, n - 1.0)
    if n < 8 or not std > (step or 0.0) or not dof > 0:
        return dof, gap, tuple(words)
    if drift @ drift / (n - 1) > std**2 / 2:  # which pixel_dof holds already
        words.append("most of it is a drift that all pixels share")
    square = np.square(z - mean - drift[:, None, None])
    if not np.nanmean(square) > 1e-12 * std**2:  # rounding: of one pixel, or where all move as one
        return dof, gap, tuple(words)
    own, fourth = valid_mean(square, axis=0), valid_mean(square**2, axis=0)
    ratio = float(np.nanmean(fourth) / np.nanmean(own**2))
    excess = (ratio * (1 + 2 / n) - 3) / max(1 - ratio / n, 0.1)  # own holds the tails, too
    unsure, left = 3 * math.sqrt(24 / dof), [dof]
    if excess > unsure:
        left.append(dof / (1 + excess / 2))
    if excess > FAR_FROM_GAUSS + unsure:
        words.append(f"heavy tails, excess kurtosis {excess:.1f}")
    elif excess < -FAR_FROM_GAUSS - unsure:
        words.append("pixels jump between two depths")
        left.append(min(dof, n - 1.0))
    parts = [p for row in np.array_split(own, 3) for p in np.array_split(row, 3, axis=1)]
    for pieces, most, where in (
        (parts, PARTS_APART, "parts of the window"),
        (np.array_split(square, 5), TIMES_APART, "times in the stack"),
    ):
        v = np.array([np.nanmean(piece) for piece in pieces if np.isfinite(piece).any()])
        v = np.maximum(v / v.mean(), 1e-4)
        apart = math.sqrt(v.max() / v.min())
        if apart > most * math.exp(3 / math.sqrt(2 * dof / len(v))):
            words.append(f"it differs by a factor of {apart:.1f} between {where}")
            left.append(2 * len(v) / float(v.var(ddof=1)))
    return min(left), gap, tuple(words)


def _two_surfaces(mean: Floats, least: float) -> float:
    """How far apart two surfaces are, m, in the means (h, w) of a window; 0 for one surface.

    The means are split where the two halves' variances are smallest (Otsu). Two surfaces are
    farther apart than `least` and 1 % of their distance, and TWO_CLUSTERS times the spread in each.
    """
    values = np.sort(mean[np.isfinite(mean)])
    few = max(len(values) // 20, 1)
    if len(values) < 20:
        return 0.0
    counts = np.arange(1, len(values))
    total = np.cumsum(values - values[0])
    apart = (total[-1] - total[:-1]) / counts[::-1] - total[:-1] / counts
    between = counts * counts[::-1] * np.square(apart / len(values))
    at = few - 1 + int(np.argmax(between[few - 1 : len(between) - few + 1]))
    gap, spread = float(apart[at]), math.sqrt(max(float(values.var() - between[at]), 0.0))
    return gap if gap > max(least, 0.01 * values[0], TWO_CLUSTERS * spread) else 0.0


def _far(off: Floats, step: float | None) -> Bools:
    """Which deviations are beyond JUMP_SIGMAS of what is typical; never NaN."""
    size = np.abs(off)
    typical = size[np.isfinite(size)]
    if typical.size == 0 or typical.max() <= JUMP_SIGMAS * (step or 0.0):
        return np.zeros(off.shape, bool)
    middle, most = np.percentile(typical, [50, 90], overwrite_input=True)
    scale = max(1.4826 * middle, most / 1.645, step or 0.0)
    return size > max(JUMP_SIGMAS * scale, 1e-9)


def _temporal(deviation: Floats) -> tuple[float, float, Floats]:
    """Pooled std of deviations (N, P) from each pixel's mean, its dof, the mean's deviation (N,).

    NaN is invalid. See `window_stats` for the model.
    """
    n, pixels = deviation.shape
    if n < 2 or pixels == 0:
        return math.nan, 0.0, np.zeros(n) if pixels or n == 1 else np.full(n, np.nan)
    known = np.isfinite(deviation)
    squares = float(np.square(deviation[known]).sum())
    complete = deviation[:, known.all(axis=0)]
    drift = np.nan_to_num(valid_mean(deviation, axis=1))
    drift -= drift.mean()
    if complete.shape[1] < 2 or not complete.any():
        return math.sqrt(squares / (known.sum() - pixels)), n - 1.0, drift
    own = complete - complete.mean(axis=1, keepdims=True)
    gram = own @ own.T
    # The mean of frames that correlate follows them: it costs tau squares a pixel, not one.
    tau = _correlation_time(gram) if n > 4 else 1.0
    variance = squares / (known.sum() - pixels * min(tau, n / 2))
    common = min(float(drift @ drift) / (n - 1), variance)
    of_noise = (variance - common) ** 2 / _pixel_dof(gram, own.shape[1])
    shares = of_noise + common**2 / series_std(drift)[1]
    return math.sqrt(variance), variance**2 / shares, drift


def _patch_error(residual: Floats) -> float:
    """Standard error of the mean of residuals (h, w) that correlate over CORRELATION_PX px."""
    known = residual[np.isfinite(residual)]
    if known.size < 4:
        return math.nan
    return float(known.std()) / math.sqrt(max(known.size / CORRELATION_PX**2, 1.0))


# --- how many samples are independent ---


def _pixel_dof(gram: Floats, pixels: int) -> float:
    """The number of independent squares in noise that correlates in space and time.

    gram (N, N): of the frames of P pixels, as for `_autocorrelation`.
    """
    frames = max((len(gram) - 1) / _squared_correlation(gram, pixels), 1.0)
    trace, square = np.trace(gram), np.square(gram).sum()  # tr S, tr S^2 of the pixels' covariance
    if trace == 0 or frames < 2:
        return frames
    # E tr S^2 = tr C^2 (1 + 1/m) + (tr C)^2 / m for m independent frames (Srivastava, 2005)
    ratio = (frames - 1) * (frames + 2) / frames**2 / max(square / trace**2 - 1 / frames, 1e-12)
    return frames * float(np.clip(ratio, 1.0, pixels))


def series_std(series: Floats) -> tuple[float, float]:
    """Std of a series (N,) and the number of independent squares in it."""
    n = len(series)
    if n < 2 or not np.isfinite(series).all():
        return math.nan, 0.0
    squares = max((n - 1) / _squared_correlation(np.outer(series, series)), 1.0)
    return float(series.std(ddof=1)), squares


def _squared_correlation(gram: Floats, pixels: int = 1) -> float:
    """1 + 2 sum of rho^2 of P pixels, up to the first lag with nothing significant left.

    For the variance of a variance it is the squares of autocorrelations that count. P pixels in
    patches of CORRELATION_PX tell more than one series.
    """
    n = len(gram)
    rho = _autocorrelation(gram, max(1, n // 3))
    noise = 1 / math.sqrt(n * max(1.0, pixels / CORRELATION_PX**2))
    over = np.flatnonzero(rho < 2 * noise)
    return 1 + 2 * float(np.square(rho[: over[0] if over.size else None]).sum())


def _autocorrelation(gram: Floats, lags: int) -> Floats:
    """Autocorrelation (lags,) at lag 1, 2, ... of frames of known mean, pooled over pixels.

    gram (N, N): the frames (N, P) times their transpose.
    """
    n = len(gram)
    power = np.trace(gram) / n
    if power == 0 or n < 3:
        return np.zeros(lags)
    return np.array([np.trace(gram, k) / (n - k) for k in range(1, lags + 1)]) / power


def _correlation_time(gram: Floats) -> float:
    """1 + 2 sum of rho, at least 1, of frames free of the drift that all pixels share.

    Summed up to the lag 2.5 tau (Sokal, 1997): many pixels pin it down, a slow drift would not be
    seen. The mean was taken from the same frames, which lowers every autocovariance by
    var / N_eff; that is put back.
    """
    n = len(gram)
    raw = _autocorrelation(gram, max(1, n // 2))
    tau = 1.0
    for _ in range(20):
        share = min(tau / n, 0.5)
        sums = np.concatenate([[1.0], 1 + 2 * np.cumsum(raw * (1 - share) + share)])
        window = int(np.argmax(np.arange(len(sums)) >= 2.5 * np.maximum(sums, 1.0)))
        tau = max(float(sums[window or -1]), 1e-3)
    return float(np.clip(tau, 1.0, n))


def effective_frames(series: Floats) -> tuple[float, Interval]:
    """The number of independent frames in series (N, P) of zero mean, and its 95 % interval.

    Model: white noise plus a drift whose correlation falls as r^k, r = exp(-1 / tau), spectrum
    S(f) = w + a (1 - r^2) / (1 - 2 r cos(2 pi f) + r^2). It is fitted to the periodogram by
    maximum likelihood: Whittle, Estimation and information in stationary time series, Arkiv för
    Matematik 2 (1953), 423-434. The frequencies k / N, k > 0, do not see the mean. The number is
    var(one) / var(mean of N) of the fitted model; the interval holds what the profile likelihood
    does not reject at 5 % (2 log ratio below CHI2_95). Of the models within DRIFT_SLACK of the best
    the largest number is taken, or most white series would be given a drift.
    Assumes a stationary, Gaussian series and tau from 1 to N frames: a slower drift is not seen,
    frames that correlate negatively count as independent. The periodograms of P pixels are
    averaged and count as one series, since pixels share the drift. Weak drifts leave the interval
    wide and the number, within it, too large more often than too small.
    A constant series or fewer than 5 frames say nothing: N, from 1 to N.
    """
    n = len(series)
    power = np.square(np.abs(np.fft.rfft(series, axis=0)[1:])).mean(axis=1)
    if n < 5 or not power.sum() > 0:
        return float(n), (1.0, float(n))
    effective, inverse, log_spectra, weights, starts = _drift_models(n)
    binned = np.add.reduceat(weights * power / power.mean(), starts)
    deviance = log_spectra + 2 * weights.sum() * np.log(inverse @ binned)
    profile = deviance.min(axis=0)
    best = int(np.argmax(profile <= profile.min() + DRIFT_SLACK))
    inside = np.flatnonzero(profile < profile.min() + CHI2_95)
    last = len(profile) - 1  # the interval's ends lie between two numbers: take the outer ones
    low, high = effective[[min(inside[-1] + 1, last), max(inside[0] - 1, 0)]]
    return float(effective[best]), (float(low), float(high))


@lru_cache(maxsize=8)
def _drift_models(n: int) -> tuple[Floats, Floats, Floats, Floats, Integers]:
    """Models of `effective_frames` for N frames: T correlation times, E numbers of frames.

    Returns effective (E,): from N down. inverse (T, E, B): 1 / spectrum, of unit variance, in B
    bins of frequencies; the variance has a closed form. log_spectra (T, E): twice the sum of its
    log, inf where no share of the drift gives this number. weights (K,): of the ordinates; starts
    (B,): their bins.
    """
    k = np.arange(1, n // 2 + 1)
    weights = np.where(2 * k == n, 0.5, 1.0)  # the highest ordinate has one square, not two
    starts = np.unique(np.geomspace(1, len(k) + 1, 1024).astype(np.int64))[:-1] - 1
    sizes = np.add.reduceat(weights, starts)
    lags = np.arange(1, n)
    effective = np.geomspace(n, 1, 100)
    inverse, log_spectra = [], []
    for r in np.exp(-1 / np.geomspace(1, n, 40)):
        drift = (1 - r**2) / (1 - 2 * r * np.cos(2 * np.pi * k / n) + r**2)
        drift = np.add.reduceat(weights * drift, starts) / sizes
        tau = 1 + 2 * float(((1 - lags / n) * r**lags).sum())
        share = (n / effective - 1) / (tau - 1)  # of the drift in the variance: a / (w + a)
        spectrum = 1 + np.minimum(share, 1.0)[:, None] * (drift - 1)
        inverse.append(1 / spectrum)
        log_spectra.append(np.where(share <= 1, 2 * np.log(spectrum) @ sizes, np.inf))
    return effective, np.array(inverse), np.array(log_spectra), weights, starts


# --- averaging ---


@dataclass(frozen=True)
class AveragingCurve:
    """What averaging N frames buys.

    n_frames: all there are. effective_frames: how many independent ones they are worth, and its
    interval. gain: how much quieter the mean of all frames is than one; sqrt(n_frames) at best.
    floor_m: the pattern that every frame repeats, RMS over the pixels about a plane; None for a
    series without pixels, and for fewer than three of them.
    """

    n_frames: int
    effective_frames: float
    effective_frames_interval: Interval
    gain: float
    floor_m: float | None


def averaging_curve(series_m: ArrayLike) -> AveragingCurve:
    """What the mean of N frames gains over one, and what stays in each pixel.

    series_m: (N,) values of one pixel or of a window's mean, or (N, h, w) depths of a window on a
    smooth surface, m, NaN invalid (pixels not valid in every frame are left out).

    Model: white noise plus a drift that is correlated over 1 to N frames; `effective_frames` says
    how the number of independent ones follows. Its interval is as wide as one series makes it:
    pixels share the drift, so more of them do not narrow it.
    Raises ValueError for fewer than 8 frames, where no autocorrelation can be had.

    >>> round(averaging_curve(np.random.default_rng(1).standard_normal(64)).effective_frames)
    64
    """
    values = array("series_m", series_m, leading=True)
    long = values.ndim in (1, 3) and len(values) >= 8
    want(long, "series_m", values.shape, "(N,) or (N, h, w) with N >= 8")
    n = len(values)
    if values.ndim == 3:
        values = np.where((values > 0) & (values < np.inf), values, np.nan)
    pixels = values.reshape(n, -1)
    pixels = pixels[:, np.isfinite(pixels).all(axis=0)]
    refuse(pixels.shape[1] == 0, "series_m: no pixel is valid in every frame")
    deviation = pixels - pixels.mean(axis=0)
    effective, interval = effective_frames(deviation)
    floor = None
    if values.ndim == 3 and pixels.shape[1] > 2:
        own = deviation - deviation.mean(axis=1, keepdims=True)  # without the drift all share
        each = np.square(own).sum() / own.shape[1] / (n - 1)
        noise = each / (n / _correlation_time(own @ own.T))
        floor = math.sqrt(max(off_plane(values.mean(axis=0)[None]) ** 2 - noise, 0.0))
    return AveragingCurve(n, effective, interval, math.sqrt(effective), floor)


# --- means, planes and errors, where NaN is invalid ---


def valid_mean(values: Floats, axis: int) -> Floats:
    """The mean without NaN, NaN where there is nothing else.

    >>> valid_mean(np.array([[0.45, np.nan], [0.47, np.nan]]), axis=0)
    array([0.46,  nan])
    """
    known = np.isfinite(values)
    count = known.sum(axis=axis)
    total = np.where(known, values, 0.0).sum(axis=axis)
    return np.asarray(total / np.where(count > 0, count, np.nan))


def valid_median(stack: Floats) -> Floats:
    """The median over frames (N, ...) without NaN, NaN where there is nothing else."""
    count = np.isfinite(stack).sum(axis=0)
    middle = np.stack([(count - 1) // 2, count // 2])  # of the sorted ones: NaN comes last
    return np.asarray(np.take_along_axis(np.sort(stack, axis=0), middle, axis=0).mean(axis=0))


def off_plane(images: Floats) -> float:
    """RMS over the pixels of images (N, h, w), each about its own plane, see `about_plane`.

    >>> image = np.array([[0.5, 0.5, 0.5], [0.5, 0.509, 0.5], [0.5, 0.5, 0.5]])
    >>> print(f"{off_plane(image[None]):.4f} m")
    0.0028 m
    """
    off = about_plane(images)[0]
    known = off[np.isfinite(off)]
    return math.sqrt(known @ known / known.size) if known.size else math.nan


def about_plane(images: Floats) -> tuple[Floats, Floats]:
    """What images (..., h, w) of depths are off their planes; the planes' depths at the centre."""
    planes = fit_plane(images)
    return images - 1 / plane_image(planes, images.shape[-2:]), 1 / planes[..., 0]


def fit_plane(images: Floats) -> Floats:
    """A plane in space through each image (..., h, w) of depths: (..., 3).

    1/Z = plane . (1, u - u0, v - v0), linear in 1/Z, and u0, v0 the middle. NaN is invalid; fewer
    than three valid pixels leave NaN. The normal equations of all images are solved at once: about
    the middle they are well conditioned, and of pixels in one line the shortest solution is taken.
    """
    design = _plane_design(images.shape[-2:]).reshape(-1, 3)
    inverse = 1 / images.reshape(*images.shape[:-2], -1)
    known = np.isfinite(inverse).astype(float)
    products = (design[:, :, None] * design[:, None, :]).reshape(-1, 9)
    squares = (known @ products).reshape(*known.shape[:-1], 3, 3)
    right = np.where(known, inverse, 0.0) @ design
    planes = np.linalg.pinv(squares, rcond=1e-12, hermitian=True) @ right[..., None]
    return np.where(known.sum(axis=-1, keepdims=True) < 3, np.nan, planes[..., 0])


def plane_image(planes: Floats, shape: tuple[int, ...]) -> Floats:
    """1/Z of planes (..., 3) at the pixels of a patch: (..., h, w)."""
    flat = planes @ _plane_design(shape).reshape(-1, 3).T
    return np.asarray(flat.reshape(*planes.shape[:-1], *shape))


def _plane_design(shape: tuple[int, ...]) -> Floats:
    v, u = np.indices(shape)
    return np.stack([np.ones(shape), u - (shape[1] - 1) / 2, v - (shape[0] - 1) / 2], axis=-1)


def std_error(std: float, dof: float) -> float:
    return std / math.sqrt(2 * dof) if dof > 0 else math.nan
