"""Points and a sentence for each thing that is asked for, by comparing claims with raw depths.

A claim is right within a stated tolerance: so many standard errors of what the raw depths say, and
half a unit of the last printed digit (rubric.toml). A wrong claim that a typical mistake explains
is named, and keeps a part of its points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np

from coursekit.submission.flags import Fingerprint, Flag, data_flags, fingerprint
from coursekit.submission.recompute import Measured, Recomputed, recompute
from coursekit.submission.rules import rules

if TYPE_CHECKING:
    from coursekit.stereo import NoiseFit
    from coursekit.submission.contents import Claims, Plot, Row, Submission

Verdict = Literal["right", "partial", "wrong", "missing"]
Interval = tuple[float, float]

SAME_DISTANCE_M = 0.005  # a row or a point of the plot belongs to the stack this near
SHAPE = 0.03  # a wrong number is explained by a mistake that gives it to this part

# What a class page calls a mistake; rubric.toml says what each leaves of the points.
MISTAKES = {
    "close": "close, but outside the tolerance",
    "sign": "sign of the bias turned",
    "metres": "metres instead of millimetres",
    "counts": "depth counts instead of millimetres",
    "percent": "percent for a fraction or for millimetres",
    "complement": "valid instead of invalid",
    "unrounded": "corrected for rounding where the measured value is asked for",
    "unpooled": "mean of the pixels' stds instead of their pooled std",
    "variance": "variance instead of std",
    "level": "the depth itself instead of its error",
    "zeros": "invalid pixels (0) averaged in",
    "of_the_mean": "std of the window's mean instead of a pixel's",
    "standard_error": "standard error instead of std",
    "spatial": "std over the pixels instead of over time",
    "mixed": "std over pixels and time together",
    "not_divided": "std instead of standard error",
    "independent": "all samples taken as independent",
    "one_pixel": "error of one pixel's std instead of the window's",
    "tape_only": "the tape's error alone",
    "no_tape": "no error of the tape",
    "ever": "pixels that were ever invalid instead of samples",
    "millimetres": "millimetres in a formula that wants metres",
    "not_squared": "noise taken as proportional to Z",
    "no_interval": "no interval",
    "one_sigma": "one standard error instead of a 95 % interval",
    "not_widened": "interval not widened for the scatter",
    "of_variance": "exponent of the variance",
    "proportional": "prediction not proportional to Z squared",
    "copied_prediction": "prediction equal to the measurement",
    "off_scale": "prediction far from the measurement",
    "no_prediction": "prediction, or points of the plot, missing",
    "other_dominates": "the other error dominates",
    "not_measured_there": "conclusion far from where it was measured",
    "incomplete": "something left out",
    "short": "too short",
}


@dataclass(frozen=True)
class Item:
    """One thing that is asked for.

    name: "bias at 0.45 m"; topic: "bias". says: one sentence. mistake: a key of MISTAKES, or "".
    claimed, found, tolerance: what was compared, in the claim's unit, where it is one number.
    """

    name: str
    topic: str
    points: float
    of: float
    verdict: Verdict
    says: str
    mistake: str = ""
    claimed: float | None = None
    found: float | None = None
    tolerance: float | None = None


@dataclass(frozen=True, eq=False)
class Grade:
    """Points with their reasons; flags, which take none; and what the raw depths say."""

    student: str
    items: tuple[Item, ...]
    flags: tuple[Flag, ...]
    recomputed: Recomputed
    fingerprint: Fingerprint

    @property
    def points(self) -> float:
        """Of `of`."""
        return round(sum(item.points for item in self.items), 2)

    @property
    def of(self) -> float:
        """The most that this submission could get."""
        return round(sum(item.of for item in self.items), 2)


@dataclass(frozen=True)
class _Mistake:
    """A value that a typical mistake gives, and how near a claim must be to be explained by it."""

    code: str
    value: float
    why: str
    within: float = 0.0


def grade(submission: Submission) -> Grade:
    """Compare what a submission claims with what its raw depths say."""
    found, prints = recompute(submission), fingerprint(submission)
    items = [*_at_distances(submission, found), *_overall(submission, found)]
    flags = data_flags(submission, found, prints)
    return Grade(submission.student, tuple(items), flags, found, prints)


def check(submission: Submission) -> tuple[str, ...]:
    """What is missing, weak or wrong, in the grader's own sentences; empty for full points."""
    return tuple(item.says for item in grade(submission).items if item.verdict != "right")


# --- at each distance -------------------------------------------------------------------------


def _at_distances(submission: Submission, found: Recomputed) -> Iterator[Item]:
    wanted: list[float] = rules()["exercise"]["distances_m"]
    points = rules()["points"]
    slots = _slots(wanted, found.at)
    for z, m in slots:
        row = _row(submission, z if m is None else m.distance_m)
        yield from _one_distance(submission, z, m, row, points)
    taken = {m.distance_m for _, m in slots if m is not None}
    nothing = dict.fromkeys(points, 0.0)
    for m in found.at:  # beyond what is asked for: compared, but not counted
        row = _row(submission, m.distance_m)
        if m.distance_m not in taken and row is not None:
            yield from _one_distance(submission, m.distance_m, m, row, nothing)


def _slots(wanted: Sequence[float], at: Sequence[Measured]) -> list[tuple[float, Measured | None]]:
    """For each wanted distance the nearest measured one within the slack, none of them twice."""
    slack = rules()["exercise"]["slack_m"]
    pairs = sorted((abs(m.distance_m - z), z, i) for z in wanted for i, m in enumerate(at))
    chosen: dict[float, int] = {}
    for off, z, i in pairs:
        if off <= slack + 1e-9 and z not in chosen and i not in chosen.values():
            chosen[z] = i
    return [(z, at[chosen[z]] if z in chosen else None) for z in wanted]


def _row(submission: Submission, z: float) -> Row | None:
    near = [r for r in submission.claims.rows if abs(r.distance_m - z) <= SAME_DISTANCE_M]
    return min(near, key=lambda r: abs(r.distance_m - z), default=None)


def _one_distance(
    submission: Submission,
    z: float,
    m: Measured | None,
    row: Row | None,
    points: dict[str, float],
) -> Iterator[Item]:
    yield _data(z, m, points["data"])
    topics = ("bias", "bias_se", "std", "std_se", "invalid")
    if m is None:
        for topic in topics:
            yield _missing(topic, f" at {z:.2f} m", points, "there are no raw depths at it")
        return
    at = f" at {m.distance_m:.2f} m"
    claims = (
        (None,) * 5
        if row is None
        else (
            row.depth_bias_mm,
            row.depth_bias_se_mm,
            row.depth_std_mm,
            row.depth_std_se_mm,
            row.invalid_fraction,
        )
    )
    judges = (_bias, _bias_se, _std, _std_se, _invalid)
    for topic, claim, judge in zip(topics, claims, judges, strict=True):
        if claim is None:
            yield _missing(topic, at, points, "your table leaves it out")
        else:
            yield judge(submission, m, claim, points[topic], at)


LABELS = {
    "data": "raw depths",
    "bias": "bias",
    "bias_se": "standard error of the bias",
    "std": "std of depth",
    "std_se": "standard error of the std",
    "invalid": "invalid part",
    "plot": "plot",
    "sigma_d": "sigma_d",
    "sigma_d_interval": "95 % interval of sigma_d",
    "exponent": "exponent",
    "verdict": "bias or noise",
    "paragraph": "paragraph",
}
UNITS = {"sigma_d": " px", "sigma_d_interval": " px", "exponent": "", "invalid": " %"}


def _missing(topic: str, at: str, points: dict[str, float], why: str) -> Item:
    name = LABELS[topic] + at
    return Item(name, topic, 0.0, points[topic], "missing", f"{_capital(name)}: missing; {why}.")


def _data(z: float, m: Measured | None, of: float) -> Item:
    exercise = rules()["exercise"]
    name, needed, side = f"raw depths at {z:.2f} m", exercise["frames"], exercise["window_px"]
    if m is None:
        says = f"{z:.2f} m is missing: {needed} frames of raw depth are needed there."
        return Item(name, "data", 0.0, of, "missing", says)
    n, height, width = m.stack.counts.shape
    where = f"{m.distance_m:.2f} m"
    if m.bias is None:
        says = f"{where} has no depth in its window: every pixel is invalid."
        return Item(name, "data", 0.0, of, "wrong", says)
    frames, small = min(n / needed, 1.0), min(width, height) < side
    if n < needed:
        says = f"{where} has {n} frame{'s' * (n != 1)}, {needed} are needed"
        says += f", and a window of {width}x{height} px is small." if small else "."
    elif small:
        says = f"{where} has a window of {width}x{height} px, at least {side}x{side} are needed."
    else:
        says = f"{where} has {n} frames of {width}x{height} px: enough."
        return Item(name, "data", of, of, "right", says)
    points = round(of * frames * (0.5 if small else 1.0), 2)
    return Item(name, "data", points, of, "partial", says, "incomplete")


def _bias(_: Submission, m: Measured, claim: float, of: float, at: str) -> Item:
    if m.bias is None:
        return _unknown("bias", at, of, claim)
    found, step, z = m.bias.value, 1e3 * m.scale_m, 1e3 * m.distance_m

    def mistakes() -> Iterator[_Mistake]:
        yield _Mistake("sign", -found, "its sign is turned: bias is measured minus true", tolerance)
        yield _metres(found, tolerance)
        yield _counts(found, tolerance, step)
        yield _Mistake(
            "percent", 100 * found / z, "it is in percent of the distance", 100 * tolerance / z
        )
        yield _Mistake("level", z + found, "it is the depth, not its error", 0.01 * z)
        yield _Mistake("level", (z + found) / 1e3, "it is the depth, not its error", 1e-5 * z)
        yield _Mistake(
            "zeros",
            float(m.stack.counts.mean()) * step - z,
            "invalid pixels were averaged in as depths of 0",
            tolerance,
        )

    tolerance = _tolerance("bias", m.bias.se)
    return _judge("bias", at, of, claim, found, tolerance, mistakes)


def _bias_se(submission: Submission, m: Measured, claim: float, of: float, at: str) -> Item:
    if m.bias is None or m.bias_se_mm is None or m.bias_se_apart_mm is None:
        return _unknown("bias_se", at, of, claim)
    both, apart = m.bias_se_mm, m.bias_se_apart_mm
    tape = 1e3 * submission.tape_sigma_m
    n, pixels = m.stats.n_frames, m.stats.n_pixels
    std = m.std.value if m.std else math.nan

    def mistakes() -> Iterator[_Mistake]:
        if tape:
            yield _Mistake("tape_only", tape, "it is the tape's error alone, without the camera's")
        yield _Mistake("not_divided", std, "it is the std of a pixel, not the error of a mean")
        why = "it takes all samples as independent, but neighbours share their noise and a pattern"
        yield _Mistake("independent", std / math.sqrt(n), f"{why} stays in every frame")
        yield _Mistake("independent", std / math.sqrt(n * pixels), f"{why} stays in every frame")
        mean = 1e3 * m.stats.mean_std_m
        yield _Mistake("not_divided", mean, "it is the std of the window's mean, not its error")
        for se in (both, apart):
            yield _metres(se, 0.1 * se)
            yield _counts(se, 0.1 * se, 1e3 * m.scale_m)

    near = min((both, apart), key=lambda se: abs(claim - se))  # with the tape's, or apart from it
    tolerance = _error_tolerance("bias_se", apart * apart / near if near else 0.0)
    item = _judge("bias_se", at, of, claim, near, tolerance, mistakes)
    if item.verdict == "right" and submission.camera.source == "live" and tape == 0:
        says = (
            f"{_capital(item.name)}: {_shown('bias_se', claim)} is the camera's part; but you say "
            "that the tape has no error, and a tape is read to a millimetre or two."
        )
        return _partial(item, "no_tape", says)
    return item


def _std(_: Submission, m: Measured, claim: float, of: float, at: str) -> Item:
    if m.std is None:
        return _unknown("std", at, of, claim)
    found, n, stats = m.std.value, m.stats.n_frames, m.stats

    def mistakes() -> Iterator[_Mistake]:
        yield _metres(found, tolerance)
        yield _counts(found, tolerance, 1e3 * m.scale_m)
        unrounded = 1e3 * stats.pixel_std_unrounded_m
        yield _Mistake(
            "unrounded", unrounded, "it is corrected for rounding; the table wants it as measured"
        )
        steady = m.z_mm[:, np.isfinite(m.z_mm).all(axis=0)]
        each = steady.std(axis=0, ddof=1) if n > 1 and steady.size else np.array([math.nan])
        why = "it is the mean of the pixels' stds; over pixels, variances are averaged"
        yield _Mistake("unpooled", float(each.mean()), why, 0.005 * found)
        why = "it is the median of the pixels' stds; over pixels, variances are averaged"
        yield _Mistake("unpooled", float(np.median(each)), why, 0.005 * found)
        why = "it is the std of the window's mean; the noise of one pixel is asked for"
        yield _Mistake("of_the_mean", 1e3 * stats.mean_std_m, why)
        why = "it was divided by the root of the number of frames: a standard error, not a std"
        yield _Mistake("standard_error", found / math.sqrt(n), why)
        yield _Mistake("variance", found**2, "it is a variance, the square of the std")
        why = "it is the spread over the pixels of a frame; noise is the spread over time"
        yield _Mistake("spatial", 1e3 * stats.spatial_std_m, why)
        depths = m.z_mm
        known = depths[np.isfinite(depths)]
        why = "it is the std of all samples at once, so it holds the pattern that stays"
        yield _Mistake("mixed", float(known.std()), why)
        filled = np.nan_to_num(depths)
        yield _Mistake(
            "zeros",
            math.sqrt(float(filled.var(axis=0, ddof=1).mean())) if n > 1 else math.nan,
            "invalid pixels were taken as depths of 0",
        )
        yield _Mistake("zeros", float(filled.std()), "invalid pixels were taken as depths of 0")

    tolerance = _tolerance("std", m.std.se)
    return _judge("std", at, of, claim, found, tolerance, mistakes)


def _std_se(_: Submission, m: Measured, claim: float, of: float, at: str) -> Item:
    if m.std is None:
        return _unknown("std_se", at, of, claim)
    found, std = m.std.se, m.std.value
    n, pixels = m.stats.n_frames, m.stats.n_pixels

    def mistakes() -> Iterator[_Mistake]:
        yield _Mistake("not_divided", std, "it is the std itself")
        why = "it is the error of one pixel's std; the window has many pixels, though not all of "
        why += "them independent"
        yield _Mistake("one_pixel", std / math.sqrt(2 * max(n - 1, 1)), why)
        why = "it is the error of a mean, std / sqrt(N); that of a std is std / sqrt(2 dof)"
        yield _Mistake("one_pixel", std / math.sqrt(n), why)
        why = "it takes all samples as independent, but neighbours share their noise"
        yield _Mistake("independent", std / math.sqrt(2 * n * pixels), why)
        yield _Mistake("independent", std / math.sqrt(n * pixels), why)
        yield _metres(found, 0.1 * found)
        yield _counts(found, 0.1 * found, 1e3 * m.scale_m)

    tolerance = _error_tolerance("std_se", found)
    return _judge("std_se", at, of, claim, found, tolerance, mistakes)


def _invalid(_: Submission, m: Measured, claim: float, of: float, at: str) -> Item:
    found = m.invalid.value
    tolerance = rules()["tolerance"]["standard_errors"] * m.invalid.se + _half_digit("invalid")

    def mistakes() -> Iterator[_Mistake]:
        why = "it is in percent; a fraction lies between 0 and 1"
        yield _Mistake("percent", 100 * found, why, 100 * tolerance)
        yield _Mistake("complement", 1 - found, "it is the valid part, not the invalid", tolerance)
        yield _Mistake("complement", 100 * (1 - found), "it is the valid part, in percent", 0.5)
        holes = m.stack.counts == 0
        why = "it counts pixels that were ever invalid; asked for is the part of all samples"
        yield _Mistake("ever", float(holes.any(axis=0).mean()), why, tolerance)
        why = "it counts frames that have a hole; asked for is the part of all samples"
        yield _Mistake("ever", float(holes.any(axis=(1, 2)).mean()), why, tolerance)

    return _judge("invalid", at, of, claim, found, tolerance, mistakes)


def _metres(found: float, tolerance: float) -> _Mistake:
    return _Mistake("metres", found / 1e3, "it is in metres: 1 m is 1000 mm", tolerance / 1e3)


def _counts(found: float, tolerance: float, step_mm: float) -> _Mistake:
    value = found / step_mm if abs(step_mm - 1) > 0.01 else math.nan
    why = f"it is in depth counts, and a count is {step_mm:g} mm here"
    return _Mistake("counts", value, why, tolerance / step_mm)


# --- over all distances -----------------------------------------------------------------------


def _overall(submission: Submission, found: Recomputed) -> Iterator[Item]:
    points = rules()["points"]
    yield _plot(submission, found, points["plot"])
    yield _sigma_d(submission, found, points)
    yield _sigma_d_interval(submission, found, points)
    yield _exponent(submission, found, points["exponent"])
    yield _verdict(submission, found, points["verdict"])
    yield _paragraph(submission, points["paragraph"])


def _plot(submission: Submission, found: Recomputed, of: float) -> Item:
    plot = submission.plot
    measured = [m for m in found.at if m.std is not None]
    if plot is None or not plot.distances_m:
        says = "Plot: missing; measured std of depth against the predicted one, at each distance."
        return Item("plot", "plot", 0.0, of, "missing", says)
    wanted = len(rules()["exercise"]["distances_m"])
    absent, wrong, of_table, right = [], [], [], 0
    for m in measured:
        i = _nearest(plot, m.distance_m)
        if i is None:
            absent.append(f"{m.distance_m:.2f} m")
            continue
        assert m.std is not None
        got, want = plot.measured_mm[i], m.std.value
        tolerance = _tolerance("std", m.std.se)
        if abs(got - want) <= tolerance:
            right += 1
        elif _is_of_table(submission, m.distance_m, got):  # wrong, but that is counted there
            right += 1
            of_table.append(f"{m.distance_m:.2f} m")
        else:
            wrong.append(
                f"at {m.distance_m:.2f} m it shows a measured {_shown('std', got)}, your raw "
                f"depths say {_shown('std', want)} ({_accepted('std', tolerance)})"
            )
    strange = [z for z in plot.distances_m if _stack_at(measured, z) is None]
    wrong += [f"it shows a point at {z:.2f} m, where there are no raw depths" for z in strange]
    part = right / max(wanted, len(measured), len(plot.distances_m))
    if wrong:
        says = f"Plot: wrong because {'; '.join(wrong)}."
        points = round(of * 0.5 * part, 2)
        return Item("plot", "plot", points, of, "partial" if points else "wrong", says)
    if absent or right < wanted:
        short = f"{', '.join(absent)} missing" if absent else f"{right} of {wanted} distances"
        says = f"Plot: it shows what you measured, but with {short}"
        if plot.predicted_mm is None:
            part *= rules()["credit"]["no_prediction"]
            says += " and without your prediction"
        return Item("plot", "plot", round(of * part, 2), of, "partial", f"{says}.", "no_prediction")
    shows = "measured std as in your raw depths"
    if of_table:
        shows = f"measured std as in your table, which is judged there ({', '.join(of_table)})"
    there = [_stack_at(measured, z) for z in plot.distances_m]
    return _prediction(plot, shows, [m.std.value for m in there if m and m.std], of)


def _is_of_table(submission: Submission, z: float, std_mm: float) -> bool:
    row = _row(submission, z)
    claim = None if row is None else row.depth_std_mm
    return claim is not None and abs(std_mm - claim) <= _half_digit("std")


def _prediction(plot: Plot, shows: str, found_mm: Sequence[float], of: float) -> Item:
    """The predicted curve: it was made before measuring, so its shape must be right, and its scale
    to a factor.

    shows: what is right about the measured points. found_mm: what the raw depths say for each.
    """
    full = Item("plot", "plot", of, of, "right", "")
    if plot.predicted_mm is None:
        says = (
            f"Plot: {shows}, but without your prediction; predicted is what sigma_d, fx and "
            "baseline say before you measure."
        )
        return _partial(full, "no_prediction", says)
    z, predicted = np.array(plot.distances_m), np.array(plot.predicted_mm)
    measured, found = np.array(plot.measured_mm), np.array(found_mm)
    slack = rules()["tolerance"]["prediction"]
    if not (predicted > 0).all():
        says = f"Plot: {shows}, but a predicted std must be greater than 0."
        return _partial(full, "proportional", says)
    if len(z) > 1 and np.array_equal(predicted, measured):
        says = (
            "Plot: the prediction is the measurement to the last digit; predicted is what your "
            "sigma_d, fx and baseline say without it."
        )
        return _partial(full, "copied_prediction", says)
    shape = predicted / z**2
    off = float(shape.max() / shape.min()) - 1
    ratio = float(np.exp(np.log(predicted / found).mean())) if (found > 0).all() else 1.0
    if off > slack:
        law = "Z" if np.ptp(np.log(predicted / z)) < math.log(1 + slack) else "something else"
        says = (
            f"Plot: {shows}, but the prediction goes as {law}: divided by Z² it differs by "
            f"{off:.0%} between distances, and sigma_Z = Z² sigma_d / (fx B) would not."
        )
        return _partial(full, "proportional", says)
    return _scale(full, shows, ratio)


def _scale(full: Item, shows: str, ratio: float) -> Item:
    """A prediction of the right shape that is so many times what the raw depths say."""
    most = rules()["tolerance"]["prediction_factor"]
    if 1 / most <= ratio <= most:
        says = (
            f"Plot: {shows}, prediction proportional to Z² and {ratio:.2f} times what your raw "
            "depths say: right."
        )
        return replace(full, says=says)
    if 1 / most <= 1e3 * ratio <= most:
        says = f"Plot: {shows}, but the prediction is in metres: 1 m is 1000 mm."
        return _partial(full, "metres", says)
    says = (
        f"Plot: {shows}, but the prediction is {ratio:.2g} times what your raw depths say; within "
        f"a factor of {most:g} is accepted."
    )
    return _partial(full, "off_scale", says)


def _nearest(plot: Plot, z: float) -> int | None:
    off = [abs(d - z) for d in plot.distances_m]
    i = int(np.argmin(off))
    return i if off[i] <= SAME_DISTANCE_M else None


def _stack_at(at: Sequence[Measured], z: float) -> Measured | None:
    near = [m for m in at if abs(m.distance_m - z) <= SAME_DISTANCE_M]
    return min(near, key=lambda m: abs(m.distance_m - z), default=None)


def _sigma_d(submission: Submission, found: Recomputed, points: dict[str, float]) -> Item:
    claim, law, of = submission.claims.sigma_d_px, found.law, points["sigma_d"]
    if law is None:
        return _no_law("sigma_d", claim, found, of)
    if claim is None:
        return _missing("sigma_d", "", points, "the fit with the exponent held at 2 is asked for")
    value = law.sigma_d_px
    tolerance = _tolerance("sigma_d", value * _log_se(law, 0))

    def mistakes() -> Iterator[_Mistake]:
        for factor in (1e3, 1e-3):
            why = "millimetres and metres were mixed in sigma_Z fx B / Z²"
            yield _Mistake("millimetres", factor * value, why, factor * tolerance)
        camera = submission.camera
        product = camera.fx * (camera.baseline_m or math.nan)
        known = [(m, m.std.value / 1e3) for m in found.at if m.std is not None]
        why = "it takes noise as proportional to Z, not to Z²"
        yield _Mistake(
            "not_squared", float(np.mean([s * product / m.distance_m for m, s in known])), why
        )
        for code, stds, why in (
            ("spatial", [m.stats.spatial_std_m for m, _ in known], "the std over the pixels"),
            ("of_the_mean", [m.stats.mean_std_m for m, _ in known], "the std of the window's mean"),
        ):
            each = [s * product / m.distance_m**2 for s, (m, _) in zip(stds, known, strict=True)]
            says = f"it is made from {why}; sigma_d is that of one pixel over time"
            yield _Mistake(code, float(np.mean(each)), says, 0.06 * float(np.mean(each)))

    return _judge("sigma_d", "", of, claim, value, tolerance, mistakes)


def _sigma_d_interval(submission: Submission, found: Recomputed, points: dict[str, float]) -> Item:
    topic = "sigma_d_interval"
    claim, law, of = submission.claims.sigma_d_interval_px, found.law, points[topic]
    if law is None:
        return _no_law(topic, None if claim is None else claim[0], found, of)
    if claim is None:
        return _missing(topic, "", points, "a number without one says nothing of how well it fits")
    judged = _judge_interval(topic, claim, law.sigma_d_interval_px)
    return _interval_item(topic, of, judged, claim, *_other_intervals(law, 0))


def _exponent(submission: Submission, found: Recomputed, of: float) -> Item:
    claims, free, topic = submission.claims, found.free, "exponent"
    claim = claims.exponent
    if found.law is None:
        return _no_law(topic, claim, found, of)
    if claim is None and claims.exponent_interval is None:
        says = "Exponent: none quoted, and three distances over a factor of two give none: right."
        return Item(topic, topic, of, of, "right", says)
    if free is None or free.exponent is None:
        says = "Exponent: your raw depths give none to compare yours with."
        return Item(topic, topic, 0.0, of, "missing", says, claimed=claim)
    if claim is None:
        says = "Exponent: there is an interval, but no exponent in it."
        kept = round(of * rules()["credit"]["incomplete"], 2)
        return Item(topic, topic, kept, of, "partial", says, "incomplete")
    value, tolerance = free.exponent, _tolerance(topic, _log_se(free, 1))

    def mistakes() -> Iterator[_Mistake]:
        yield _Mistake("sign", -value, "its sign is turned: noise grows with distance", tolerance)
        why = "it is that of the variance; the exponent of the std is half as large"
        yield _Mistake("of_variance", 2 * value, why, tolerance)

    item = _judge(topic, "", of, claim, value, tolerance, mistakes)
    return item if item.verdict != "right" else _with_interval(item, free, claims)


def _with_interval(item: Item, free: NoiseFit, claims: Claims) -> Item:
    """The item of a right exponent, after a look at its interval."""
    assert free.exponent_interval is not None
    interval, (low, high) = claims.exponent_interval, free.exponent_interval
    if interval is None:
        says = (
            f"Exponent: {item.claimed:.2f} fits your raw depths, but without an interval it says "
            f"more than three distances can: they give {low:.2f} to {high:.2f}; quote that, or "
            "none."
        )
        return _partial(item, "no_interval", says)
    judged = _judge_interval(item.topic, interval, free.exponent_interval)
    if judged[0] == "right":
        says = (
            f"Exponent: you say {item.claimed:.2f} ({interval[0]:.2f} to {interval[1]:.2f}), your "
            f"raw depths say {free.exponent:.2f} ({low:.2f} to {high:.2f}): right."
        )
        return replace(item, says=says)
    worse = _interval_item(item.topic, item.of, judged, interval, *_other_intervals(free, 1))
    if worse.points < 0.5 * item.of:  # the exponent itself is right
        return _partial(worse, worse.mistake or "no_interval", worse.says, 0.5)
    return worse


def _other_intervals(law: NoiseFit, i: int) -> tuple[list[Interval], Interval]:
    """Of sigma_d (i = 0) or the exponent (1): those of one standard error, with the scatter and
    without; and the 95 % one without."""
    wide, narrow = _log_se(law, i), _log_se(law, i, widened=False)

    def about(half: float) -> Interval:
        if i == 1:
            assert law.exponent is not None
            return law.exponent - half, law.exponent + half
        factor = math.exp(min(half, 50.0))
        return law.sigma_d_px / factor, law.sigma_d_px * factor

    return [about(wide), about(narrow)], about(1.96 * narrow)


def _judge_interval(
    topic: str, claim: Interval, found: Interval
) -> tuple[Verdict, Interval, float]:
    """Each end may be off by so many errors of half the interval's width."""
    rule = rules()["tolerance"]
    half = (found[1] - found[0]) / 2
    tolerance = rule["standard_errors"] * rule["error_of_an_error"] * half + _half_digit(topic)
    return ("right" if _apart(claim, found) <= tolerance else "wrong"), found, tolerance


def _apart(one: Interval, two: Interval) -> float:
    """How far the ends of two intervals are apart, at most."""
    return max(abs(a - b) for a, b in zip(one, two, strict=True))


def _interval_item(
    topic: str,
    of: float,
    judged: tuple[Verdict, Interval, float],
    claim: Interval,
    one_sigma: Sequence[Interval],
    not_widened: Interval,
) -> Item:
    verdict, found, tolerance = judged
    name, unit = LABELS[topic], UNITS[topic]
    one, two = (" to ".join(_number(topic, end) for end in ends) for ends in (claim, found))
    says = (
        f"{_capital(name)}: you say {one}{unit}, your raw depths say {two}{unit} "
        f"({_accepted(topic, tolerance)} for each end)"
    )
    full = Item(name, topic, of, of, verdict, f"{says}: right.", tolerance=tolerance)
    if verdict == "right":
        return full

    why = "it reaches one standard error to each side; 95 % takes about two"
    others = [("one_sigma", ends, why) for ends in one_sigma]
    why = "the distances scatter about the law by more than their errors, and that widens it"
    others.append(("not_widened", not_widened, why))
    for mistake, ends, why in sorted(others, key=lambda other: _apart(claim, other[1])):
        if _apart(claim, ends) <= 0.1 * (ends[1] - ends[0]) + _half_digit(topic):
            return _partial(full, mistake, f"{says}: wrong because {why}.")
    near = rules()["tolerance"]["near"] * tolerance
    if _apart(claim, found) <= near:
        return _partial(full, "close", f"{says}: close, but not within that.")
    narrow = claim[1] - claim[0] < found[1] - found[0]
    why = "too narrow, or about another middle" if narrow else "too wide, or about another middle"
    return Item(name, topic, 0.0, of, "wrong", f"{says}: wrong because {why}.", tolerance=tolerance)


def _no_law(topic: str, claim: float | None, found: Recomputed, of: float) -> Item:
    """No fit: without a baseline it is not asked for, else the raw depths are at fault."""
    name = LABELS[topic]
    if found.why_no_law.startswith("baseline_m"):
        says = f"{_capital(name)}: not counted; your camera does not say its baseline."
        return Item(name, topic, 0.0, 0.0, "right" if claim is None else "missing", says)
    says = f"{_capital(name)}: your raw depths give none ({found.why_no_law})."
    return Item(name, topic, 0.0, of, "missing", says, claimed=claim)


# --- the conclusion ---------------------------------------------------------------------------


def _verdict(submission: Submission, found: Recomputed, of: float) -> Item:
    """Which error dominates, judged by the student's own depths."""
    topic, name, said = "verdict", LABELS["verdict"], submission.conclusion
    known = [m for m in found.at if m.bias is not None and m.std is not None]
    if said.dominates is None or not known:
        why = "your raw depths give neither" if said.dominates else "say which dominates"
        says = f"Bias or noise: missing; {why} where you will mount the camera."
        return Item(name, topic, 0.0, of, "missing", says)
    full = Item(name, topic, of, of, "right", "")
    if said.distance_m is None:
        says = f"Bias or noise: you say {said.dominates}, but not at which mounting distance."
        return _partial(full, "incomplete", says)
    z, frames = said.distance_m, said.frames
    bias, bias_se, noise, noise_se = _at_mounting(submission, known, z, frames)
    over = f"{frames} frames" if frames > 1 else "one frame"
    says = (
        f"Bias or noise: you say {said.dominates} dominates at {z:.2f} m; your raw depths say a "
        f"bias of {bias:+.2f} ± {bias_se:.2f} mm and {noise:.2f} mm of noise in a pixel over {over}"
    )
    low, high = known[0].distance_m, known[-1].distance_m
    if not low / 1.5 <= z <= 1.5 * high:
        says += f", but you measured from {low:.2f} to {high:.2f} m only: that is too far to tell."
        return _partial(full, "not_measured_there", says)
    lead = abs(bias) - noise
    if abs(lead) <= rules()["tolerance"]["standard_errors"] * math.hypot(bias_se, noise_se):
        return replace(full, says=f"{says}: too close to call, so right.")
    larger = "bias" if lead > 0 else "noise"
    if said.dominates == larger:
        return replace(full, says=f"{says}: right.")
    says += f": wrong because {larger} is the larger by {abs(lead):.2f} mm"
    if larger == "bias" and frames > 1:
        says += "; averaging takes noise down and leaves the bias"
    return _partial(full, "other_dominates", f"{says}.")


def _at_mounting(
    submission: Submission, known: Sequence[Measured], z: float, frames: int
) -> tuple[float, float, float, float]:
    """Bias, its error, noise of the mean of `frames` frames and its error at z, mm.

    Bias: linear between the distances, beyond them in proportion to Z, with that much more error.
    Noise: of the nearest distance, in proportion to Z^2.
    """
    at = np.array([m.distance_m for m in known])
    each = [m.bias.value for m in known if m.bias is not None]
    errors = [m.bias_se_apart_mm or 0.0 for m in known]
    inside = float(np.clip(z, at[0], at[-1]))
    beyond = z / inside
    bias, se = float(np.interp(inside, at, each)) * beyond, float(np.interp(inside, at, errors))
    tape = 1e3 * min(submission.tape_sigma_m, rules()["exercise"]["tape_at_most_m"])
    nearest = min(known, key=lambda m: abs(m.distance_m - z))
    noise = (nearest.noise_of_mean_mm(frames) or 0.0) * (z / nearest.distance_m) ** 2
    part = 0.0 if nearest.std is None else nearest.std.se / max(nearest.std.value, 1e-12)
    return bias, math.hypot(se, tape) * max(beyond, 1 / beyond) ** 2, noise, noise * part


def _paragraph(submission: Submission, of: float) -> Item:
    words, least = len(submission.conclusion.paragraph.split()), rules()["exercise"]["words"]
    topic = "paragraph"
    if words == 0:
        says = "Paragraph: missing; three sentences on which error dominates, and why."
        return Item(topic, topic, 0.0, of, "missing", says)
    if words < least:
        says = f"Paragraph: {words} word{'s' * (words != 1)}; say in three sentences why."
        kept = round(of * rules()["credit"]["short"], 2)
        return Item(topic, topic, kept, of, "partial", says, "short")
    says = f"Paragraph: {words} words, for your instructor to read."
    return Item(topic, topic, of, of, "right", says)


# --- judging one number -------------------------------------------------------------------------


def _judge(
    topic: str,
    at: str,
    of: float,
    claim: float,
    found: float,
    tolerance: float,
    mistakes: Callable[[], Iterator[_Mistake]],
) -> Item:
    name = LABELS[topic] + at
    says = (
        f"{_capital(name)}: you say {_shown(topic, claim)}, your raw depths say "
        f"{_shown(topic, found)} ({_accepted(topic, tolerance)})"
    )

    def item(part: float, verdict: Verdict, end: str, mistake: str = "") -> Item:
        kept = round(of * part, 2)
        return Item(
            name, topic, kept, of, verdict, f"{says}: {end}.", mistake, claim, found, tolerance
        )

    if abs(claim - found) <= tolerance:
        return item(1.0, "right", "right")
    for mistake in mistakes():
        within = max(mistake.within, SHAPE * abs(mistake.value))
        if math.isfinite(mistake.value) and abs(claim - mistake.value) <= within:
            part = rules()["credit"][mistake.code]
            return item(part, "partial", f"wrong because {mistake.why}", mistake.code)
    near = rules()["tolerance"]["near"] * tolerance
    if abs(claim - found) <= near:
        return item(rules()["credit"]["close"], "partial", "close, but not within that", "close")
    return item(0.0, "wrong", f"wrong because it is too {'large' if claim > found else 'small'}")


def _partial(full: Item, mistake: str, says: str, part: float | None = None) -> Item:
    """The item with what a mistake leaves of its points."""
    part = rules()["credit"][mistake] if part is None else part
    points = round(full.of * part, 2)
    return replace(full, points=points, verdict="partial", says=says, mistake=mistake)


def _unknown(topic: str, at: str, of: float, claim: float) -> Item:
    name = LABELS[topic] + at
    says = f"{_capital(name)}: you say {_shown(topic, claim)}, but your raw depths do not give it."
    return Item(name, topic, 0.0, of, "wrong", says, claimed=claim)


def _half_digit(topic: str) -> float:
    """Half a unit of the last digit that the notebook prints, in the claim's unit."""
    half = 0.5 * 10.0 ** -rules()["digits"][topic]
    return half / 100 if topic == "invalid" else half


def _tolerance(topic: str, se: float) -> float:
    return float(rules()["tolerance"]["standard_errors"] * se + _half_digit(topic))


def _error_tolerance(topic: str, se: float) -> float:
    """Of a standard error, which is itself known to a part only."""
    return _tolerance(topic, rules()["tolerance"]["error_of_an_error"] * se)


def _log_se(law: NoiseFit, i: int, widened: bool = True) -> float:
    """Standard error of ln sigma_d (i = 0) or of the exponent (1), widened for scatter."""
    scatter = max(1.0, law.chi2 / law.dof) if widened and law.dof > 0 else 1.0
    return math.sqrt(law.covariance[i, i] * scatter)


def _shown(topic: str, value: float) -> str:
    return _number(topic, value) + UNITS.get(topic, " mm")


def _number(topic: str, value: float) -> str:
    """A value with the digits of its topic, others where these would hide it."""
    value = 100 * value if topic == "invalid" else value
    digits, sign = rules()["digits"][topic], "+" if topic == "bias" else ""
    if value != 0 and (abs(value) >= 1e6 or abs(value) < 3.0 * 10.0**-digits):
        return f"{value:{sign}.2g}"
    return f"{value:{sign}.{digits}f}"


def _accepted(topic: str, tolerance: float) -> str:
    return f"± {100 * tolerance if topic == 'invalid' else tolerance:.2g} is accepted"


def _capital(text: str) -> str:
    return text[:1].upper() + text[1:]
