"""What the raw depths of a submission say: bias, noise and holes at each distance, and the law.

Also what rubric.toml holds, `grading_rules`: points, tolerances and thresholds. Whoever edits that
file makes typing errors; each is one line that names the file and the key.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Collection
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from coursekit.arrays import Floats
from coursekit.checks import number, want, whole
from coursekit.stereo import NoiseFit, WindowStats, fit_noise, windows
from coursekit.submission.format import WORDS, Stack, Submission

RULES = Path(__file__).with_name("rubric.toml")
LABELS: dict[str, str] = WORDS["labels"]  # of what is asked for, by topic
MISTAKES: dict[str, str] = WORDS["mistakes"]
WHY: dict[str, str] = WORDS["why"]  # a number that a mistake explains is wrong, by its code
SAYS: dict[str, str] = WORDS["says"]  # longer sentences of the rubric
SEEN: dict[str, str] = WORDS["seen"]  # what a flag says, by its code
HEADINGS: dict[str, list[str]] = WORDS["columns"]  # of tables that are read or written
REPEAT: dict[str, str] = WORDS["repeat"]  # by topic: the section of notebook 02 to repeat
KEYS: dict[str, tuple[float, Collection[str]]] = {  # of rubric.toml: the largest value, the keys
    "exercise": (2000, WORDS["rules"]["exercise"]),
    "points": (1000, LABELS),
    "tolerance": (1000, WORDS["rules"]["tolerance"]),
    "digits": (9, [*LABELS][1:6] + [*LABELS][7:10]),
    "credit": (1, MISTAKES),
    "flags": (1e9, WORDS["rules"]["flags"]),
}
AT_LEAST_ONE = ("frames", "window_px", "prediction_factor", "near")
WHOLE_NUMBERS = ("frames", "window_px", "words", "common_seed")


@lru_cache(maxsize=1)
def grading_rules() -> dict[str, Any]:
    """What rubric.toml holds. Raises ValueError, one line that names the file and the key."""
    try:
        found = tomllib.loads(RULES.read_text(encoding="utf-8"))
    except ValueError as error:  # TOML's own, which says the line, or text that is not UTF-8
        raise ValueError(f"{RULES.name}: cannot be read: {' '.join(str(error).split())}") from None
    try:
        _check_keys("", found, KEYS)
        for section, (most, keys) in KEYS.items():
            want(isinstance(found[section], dict), section, found[section], "a section of keys")
            _check_keys(f"{section}.", found[section], keys)
            for key, value in found[section].items():
                _check_rule(section, key, value, most)
    except ValueError as error:
        raise ValueError(f"{RULES.name}: {error}") from None
    return found


def _check_keys(where: str, found: dict[str, Any], wanted: Collection[str]) -> None:
    """ValueError for a key too many or too few; where both are, one may be the other mistyped."""
    missing = [f"{where}{key}" for key in wanted if key not in found]
    for key in found:
        if key not in wanted:
            also = f" ({missing[0]} is missing)" if missing else ""
            raise ValueError(f"{where}{key!s:.40}: is no key of this file{also}")
    if missing:
        raise ValueError(f"{missing[0]}: is missing")


def _check_rule(section: str, key: str, value: Any, most: float) -> None:
    """ValueError unless the value of a key in rubric.toml is a number that can be meant."""
    name, least = f"{section}.{key}", float(key in AT_LEAST_ONE)
    if key == "distances_m":
        want(isinstance(value, list) and value, name, value, "a list of numbers")
        for one in value:
            number(name, one, "a number from 0.01 to 100", least=0.01, most=100)
        want(len(set(value)) == len(value), name, value, "different numbers")
    elif section == "digits" or key in WHOLE_NUMBERS:
        whole(name, value, f"a whole number from {least:g} to {most:g}", least=least, most=most)
    else:
        number(name, value, f"a number from {least:g} to {most:g}", least=least, most=most)


@dataclass(frozen=True, eq=False)
class WithError:
    """A number and its standard error, both in the unit in which it is claimed."""

    value: float
    se: float


@dataclass(frozen=True, eq=False)
class AtDistance:
    """One distance; None is what its raw depths do not say.

    z_mm: raw depths (N, h, w), NaN where invalid; clean_mm: the same with NaN for mismatches, too.
    bias, std in mm. bias_se_mm holds the tape's error, the error in bias does not. invalid: as a
    fraction; its standard error is that of a mean over frames.
    """

    stack: Stack
    scale_m: float
    z_mm: Floats
    clean_mm: Floats
    stats: WindowStats
    bias: WithError | None
    bias_se_mm: float | None
    std: WithError | None
    invalid: WithError

    @property
    def distance_m(self) -> float:
        """By tape."""
        return self.stack.distance_m

    @cached_property
    def kept(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Bias and std, mm, with mismatches kept, each as textbooks pool it: all samples alike, all
        pixels alike, or only pixels that are always valid. Empty where there is no mismatch."""
        if not self.stats.n_mismatches:
            return (), ()
        z = self.z_mm.reshape(len(self.z_mm), -1)
        z = z[:, np.isfinite(z).sum(axis=0) > 1]
        level, square = np.nanmean(z, axis=0), np.nanvar(z, axis=0, ddof=1)
        seen, always = np.isfinite(z).sum(axis=0), np.isfinite(z).all(axis=0)
        ways = [(seen, seen - 1), (seen > 0, seen > 0), (always, always)]
        ways = [way for way in ways if way[0].any()]
        bias = (float(np.average(level, weights=w)) - 1e3 * self.distance_m for w, _ in ways)
        stds = (math.sqrt(float(np.average(square, weights=w))) for _, w in ways)
        return tuple(bias), tuple(stds)

    def noise_of_mean_mm(self, frames: int) -> float | None:
        """Std of one pixel's mean over `frames` frames, as they correlate in this stack.

        The number of independent frames in a stack of N, `effective_frames`, is scaled to `frames`.
        """
        if self.std is None:
            return None
        n = len(self.stack.counts)
        if frames == 1 or n < 5:
            return self.std.value / math.sqrt(frames)
        pixels = self.clean_mm.reshape(n, -1)
        pixels = pixels[:, np.isfinite(pixels).all(axis=0)]
        independent = float(n)
        if pixels.shape[1]:
            independent, _ = windows.effective_frames(pixels - pixels.mean(axis=0))
        share = (independent - 1) / (n - 1)
        return self.std.value / math.sqrt(1 + (frames - 1) * share)


@dataclass(frozen=True, eq=False)
class Recomputed:
    """All distances, in order, and the noise law with the exponent held at 2 and free.

    law, free: None where the stds do not give it; why_no_law then says so in a sentence.
    """

    at: tuple[AtDistance, ...]
    law: NoiseFit | None
    free: NoiseFit | None
    why_no_law: str = ""


def recompute(submission: Submission) -> Recomputed:
    """What the raw depths say, by the same functions as notebook 02 uses."""
    stacks = sorted(submission.stacks, key=lambda stack: stack.distance_m)
    scale, tape = submission.camera.depth_scale_m, submission.tape_sigma_m
    at = tuple(_measured(stack, scale, tape) for stack in stacks)
    law, why = _law(submission, at, 2.0)
    several = sum(m.std is not None and m.std.value > 0 for m in at) > 1
    free = _law(submission, at, None)[0] if law is not None and several else None
    return Recomputed(at, law, free, why)


def _measured(stack: Stack, scale: float, tape: float) -> AtDistance:
    """What one stack says; scale: metres of a count, tape: std of a reading in m."""
    _, height, width = stack.counts.shape
    ends = np.iinfo(stack.counts.dtype).max  # no depth, as for `window_stats`
    stack = replace(stack, counts=np.where(stack.counts == ends, 0, stack.counts))
    with np.errstate(all="ignore"):  # depths that no camera gives; what is not finite is dropped
        z = windows.cut(stack.counts, (0, 0, width, height), scale)
        clean = windows.without_mismatches(z, scale)[0]
        stats = windows.stats_without_mismatches(z, clean, scale)
    bias = _in_mm(stats.depth_m - stack.distance_m, stats.depth_error_m)
    return AtDistance(
        stack=stack,
        scale_m=scale,
        z_mm=1e3 * z,
        clean_mm=1e3 * clean,
        stats=stats,
        bias=bias,
        bias_se_mm=None if bias is None else math.hypot(bias.se, 1e3 * tape),
        std=_in_mm(stats.pixel_std_m, stats.pixel_std_error_m),
        invalid=_invalid(stack),
    )


def _invalid(stack: Stack) -> WithError:
    """The invalid fraction and its standard error, from how it changes from frame to frame."""
    each = (stack.counts == 0).mean(axis=(1, 2))
    least = 0.5 / stack.counts.size  # half a sample
    std, squares = windows.series_std(each)
    se = std / math.sqrt(max(squares, 1.0)) if math.isfinite(std) else 0.0
    return WithError(float(each.mean()), max(se, least))


def _law(
    submission: Submission, at: tuple[AtDistance, ...], exponent: float | None
) -> tuple[NoiseFit | None, str]:
    """The noise law through the stds with this exponent (None: free), or why there is none."""
    known = [m for m in at if m.std is not None]
    if not known:
        return None, "there are no depths to get it from"
    z, stds = [m.distance_m for m in known], [m.stats.pixel_std_m for m in known]
    dof, camera = [m.stats.pixel_dof for m in known], submission.camera
    lens = camera.fx, camera.baseline_m, camera.depth_scale_m
    try:
        with np.errstate(all="ignore"):
            fit = fit_noise(z, stds, dof, *lens, exponent)
            fits = math.isfinite(fit.sigma_d_px) and np.isfinite(fit.covariance).all()
    except (ValueError, np.linalg.LinAlgError) as error:
        return None, " ".join(str(error).split())
    return (fit, "") if fits else (None, "the stds do not follow any law")


def _in_mm(value_m: float, error_m: float) -> WithError | None:
    """A length and its standard error in mm; None where one of them is NaN or infinite."""
    found = WithError(1e3 * float(value_m), 1e3 * float(error_m))
    return found if math.isfinite(found.value) and math.isfinite(found.se) else None
