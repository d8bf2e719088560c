"""Points and a sentence for each thing that is asked for, by comparing claims with raw depths.

A claim is right within a stated tolerance: so many standard errors of what the raw depths say, and
half a unit of the last printed digit (rubric.toml). A wrong claim that a typical mistake explains
is named, and keeps a part of its points.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from coursekit.arrays import Interval
from coursekit.stereo import NoiseFit
from coursekit.submission.flags import Fingerprint, Flag, data_flags, fingerprint
from coursekit.submission.format import NOBODY, Plot, Submission, TableRow
from coursekit.submission.recompute import (
    LABELS,
    SAYS,
    WHY,
    AtDistance,
    Recomputed,
    grading_rules,
    recompute,
)
from coursekit.words import counted

Judgement = Literal["right", "partial", "wrong", "missing"]

SAME_DISTANCE_M = 0.005  # a row or a point of the plot belongs to the stack this near
EXPLAINED_WITHIN = 0.01  # a wrong number is explained by a mistake that gives it to this part,
EXACTLY = 0.002  # and to this one where the mistake's number is near the right one
NEAR_RIGHT = 0.15  # of the right number
COARSE = 0.015  # half a unit of the last digit of a claim that is too coarse to tell the two apart
ONE_DIGIT = ("bias_se", "std_se", "invalid")  # is enough of these

UNIT_OF = {"sigma_d": " px", "sigma_d_interval": " px", "exponent": "", "invalid": " %"}  # else mm


@dataclass(frozen=True)
class Item:
    """One thing that is asked for.

    name: "bias at 0.45 m"; topic: "bias". says: one sentence. mistake: a key of MISTAKES, or "".
    tolerance: by how much what was compared may be off, in the claim's unit.
    """

    name: str
    topic: str
    points: float
    of: float
    verdict: Judgement
    says: str
    mistake: str = ""
    tolerance: float | None = None


@dataclass(frozen=True, eq=False)
class Grade:
    """Points with their reasons; flags, which take none; and what the raw depths say.

    student: "" for what is measured and not packed, see `submit.keep`.
    """

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


class _Mistake(NamedTuple):
    """A value that a typical mistake gives, and how near a claim must be to be explained by it.

    key: the mistake's code, and after a dot the way in which it was made, where there are several;
    words.toml says why it is wrong. fact: what has to be filled in there.
    """

    key: str
    value: float
    within: float = 0.0
    fact: str = ""

    def why(self, topic: str) -> str:
        """Why a claim about the topic is wrong."""
        return (WHY.get(f"{topic}.{self.key}") or WHY[self.key]).format(self.fact)


class _Question(NamedTuple):
    """One thing that is asked for: its topic, what it is worth, and where (" at 0.45 m").

    only: the one mistake that may explain a wrong number, "" for none; None where any may.
    """

    topic: str
    of: float
    at: str = ""
    only: str | None = None

    @property
    def name(self) -> str:
        """ "Bias at 0.45 m", as a sentence begins."""
        name = LABELS[self.topic] + self.at
        return name[:1].upper() + name[1:]

    def item(
        self,
        verdict: Judgement,
        says: str,
        mistake: str = "",
        part: float | None = None,
        tolerance: float | None = None,
    ) -> Item:
        """The answer to it.

        part: of the points that are kept; default all of what is right, none of what is wrong or
        missing, and of what is partial what its mistake leaves.
        """
        if part is None:
            credit = grading_rules()["credit"]
            part = credit[mistake] if verdict == "partial" else float(verdict == "right")
        points = round(self.of * part, 2)
        name = LABELS[self.topic] + self.at
        return Item(name, self.topic, points, self.of, verdict, says, mistake, tolerance)

    def missing(self, why: str) -> Item:
        """Nothing was answered."""
        return self.item("missing", f"{self.name}: missing; {why}.")


def _say(sentence: str, **facts: Any) -> str:
    """A sentence of words.toml with the facts in its places."""
    return SAYS[sentence].format(**facts)


def grade(submission: Submission) -> Grade:
    """Compare what a submission claims with what its raw depths say.

    Nothing that came with the bundle runs, and the claims are never taken for granted: what is
    found comes from the raw depths alone. Raises ValueError for a rubric.toml that cannot be.
    """
    found, prints = recompute(submission), fingerprint(submission)
    flags = data_flags(submission, found, prints)
    named = submission.student != NOBODY or submission.conclusion.paragraph
    student = submission.student if named else ""
    return Grade(student, judged(submission, found), flags, found, prints)


def shortcomings(submission: Submission) -> tuple[str, ...]:
    """What is missing, weak or wrong, in the grader's own sentences; empty for full points."""
    return tuple(item.says for item in grade(submission).items if item.verdict != "right")


def judged(submission: Submission, found: Recomputed) -> tuple[Item, ...]:
    """All that is asked for, in the order of LABELS at each distance, then over all of them.

    found: what `recompute` says of the same submission.
    """
    points = grading_rules()["points"]
    overall = {topic: _Question(topic, points[topic]) for topic in list(LABELS)[6:]}
    return (
        *_at_distances(submission, found),
        _plot(overall["plot"], submission, found),
        _sigma_d(overall["sigma_d"], submission, found),
        _sigma_d_interval(overall["sigma_d_interval"], submission, found),
        _exponent(overall["exponent"], submission, found),
        _conclusion(overall["verdict"], submission, found),
        _paragraph(overall["paragraph"], submission),
    )


# --- at each distance -----------------------------------------------------------------------------


def _at_distances(submission: Submission, found: Recomputed) -> list[Item]:
    """The items at each distance that is asked for, and at others that were measured."""
    points, wanted = grading_rules()["points"], grading_rules()["exercise"]["distances_m"]
    chosen = _chosen(wanted, found.at)
    places: list[tuple[float, AtDistance | None, dict[str, float]]]
    places = [(z, chosen.get(z), points) for z in wanted]
    for m in found.at:  # beyond what is asked for: compared, but not counted
        if m not in chosen.values() and _row(submission, m.distance_m) is not None:
            places.append((m.distance_m, m, dict.fromkeys(points, 0.0)))
    items = [item for place in places for item in _one_distance(submission, *place, {})]
    only = {topic: _reason([item for item in items if item.topic == topic]) for topic in JUDGES}
    if {*only.values()} != {None}:
        items = [item for place in places for item in _one_distance(submission, *place, only)]
    return items


def _reason(items: Sequence[Item]) -> str | None:
    """The one mistake that explains most wrong numbers of a topic, "" where none explains more than
    half of them: who makes a mistake makes it at every distance, and a number by itself is near
    that of some mistake by chance. None where there is no such choice."""
    codes = Counter(item.mistake for item in items if item.verdict in ("wrong", "partial"))
    del codes["close"]
    if len(codes) < 2:
        return None
    code, n = codes.most_common(1)[0]
    return code if 2 * n > codes.total() else ""


def _chosen(wanted: Sequence[float], at: Sequence[AtDistance]) -> dict[float, AtDistance]:
    """For each wanted distance the nearest measured one within the slack, none of them twice."""
    slack = grading_rules()["exercise"]["slack_m"]
    pairs = sorted((abs(m.distance_m - z), z, i) for z in wanted for i, m in enumerate(at))
    chosen: dict[float, AtDistance] = {}
    for off, z, i in pairs:
        if off <= slack + 1e-9 and z not in chosen and at[i] not in chosen.values():
            chosen[z] = at[i]
    return chosen


def _row(submission: Submission, z: float) -> TableRow | None:
    """The row of the student's table at a distance."""
    rows = {row.distance_m: row for row in submission.claims.rows}
    return rows.get(_nearest(list(rows), z) or 0.0)


def _one_distance(
    submission: Submission,
    z: float,
    m: AtDistance | None,
    points: dict[str, float],
    only: Mapping[str, str | None],
) -> Iterator[Item]:
    """Raw depths and the five numbers of the table at z; m: what was measured there. only: by
    topic, see `_Question`."""
    yield _data(_Question("data", points["data"], f" at {z:.2f} m"), z, m)
    row = None if m is None else _row(submission, m.distance_m)
    for topic, (field, judge) in JUDGES.items():
        at = f" at {z if m is None else m.distance_m:.2f} m"
        asked = _Question(topic, points[topic], at, only.get(topic))
        claim = getattr(row, field, None)
        if m is None:
            yield asked.missing("there are no raw depths at it")
        elif claim is None:
            yield asked.missing("your table leaves it out")
        else:
            yield judge(asked, submission, m, claim)


def _data(asked: _Question, z: float, m: AtDistance | None) -> Item:
    """Whether there are raw depths enough: frames, and a window that is large enough."""
    exercise = grading_rules()["exercise"]
    needed, side = exercise["frames"], exercise["window_px"]
    if m is None:
        return asked.item("missing", _say("no_stack", z=z, needed=needed))
    n, height, width = m.stack.counts.shape
    facts = {"z": m.distance_m, "frames": counted(n, "frame"), "needed": needed, "side": side}
    facts["window"] = f"{width}x{height} px"
    few, small = n < needed, min(width, height) < side
    if m.bias is None:
        return asked.item("wrong", _say("no_depth", **facts))
    if not (few or small):
        return asked.item("right", _say("enough", **facts))
    says = _say("few_and_small" if few and small else "few" if few else "small", **facts)
    return asked.item("partial", says, "too_few", min(n / needed, 1.0) * (0.5 if small else 1.0))


def _bias(asked: _Question, submission: Submission, m: AtDistance, claim: float) -> Item:
    """Mean depth minus the distance by tape, mm; the sign is the commonest mistake."""
    if m.bias is None:
        return _unknown(asked, claim)
    step, z, (kept, _), said = 1e3 * m.scale_m, 1e3 * m.distance_m, m.kept, _said_kept(submission)
    tolerance = _tolerance("bias", m.bias.se)
    found = _nearest_of(claim, (m.bias.value, *kept) if said else (m.bias.value,))

    def mistakes() -> Iterator[_Mistake]:
        for value in () if said else kept:
            yield _Mistake("mismatches", value, EXACTLY * abs(value), _mismatches(m))
        yield _Mistake("middle_pixel", float(m.z_mm[:, *_middle(m)].mean()) - z)
        yield _Mistake("sign", -found, 0.3 * tolerance)  # of the same data, so nearer than that
        yield from _other_units(found, tolerance, step)
        yield _Mistake("percent", 100 * found / z)
        yield _Mistake("level", z + found, 0.01 * z)
        yield _Mistake("level", (z + found) / 1e3, 1e-5 * z)
        yield _Mistake("zeros", float(m.stack.counts.mean()) * step - z)

    return _judge(asked, claim, found, tolerance, mistakes)


def _bias_se(asked: _Question, submission: Submission, m: AtDistance, claim: float) -> Item:
    """The standard error of the bias, mm: of the mean depth, as the frames correlate.

    With the tape's error or without it is right; it is itself known to a part only.
    """
    if m.bias is None or m.bias_se_mm is None:
        return _unknown(asked, claim)
    both, apart, tape = m.bias_se_mm, m.bias.se, 1e3 * submission.tape_sigma_m
    n, pixels = m.stats.n_frames, m.stats.n_pixels
    stds = (m.std.value if m.std else math.nan, *m.kept[1])

    def mistakes() -> Iterator[_Mistake]:
        if tape:
            yield _Mistake("tape_only", tape)
        for std in stds:
            yield _Mistake("not_divided", std)
            for samples in (n, n * pixels):
                yield _Mistake("independent", std / math.sqrt(samples))
        yield _Mistake("not_divided.window", 1e3 * m.stats.mean_std_m)
        for std in (1e3 * m.stats.mean_std_m, _std_of_means(m)):
            yield _Mistake("independent", std / math.sqrt(n))
        yield _Mistake("independent", float(np.nanstd(m.z_mm)) / math.sqrt(n * pixels))
        for se in (both, apart):
            yield from _other_units(se, 0.1 * se, 1e3 * m.scale_m)

    near = _nearest_of(claim, (both, apart))  # with the tape's, or apart from it
    item = _judge(asked, claim, near, None, mistakes)
    if item.verdict == "right" and submission.camera.source == "live" and tape == 0:
        says = _say("no_tape", what=asked.name, claim=_shown("bias_se", claim))
        return asked.item("partial", says, "no_tape", tolerance=item.tolerance)
    return item


def _std(asked: _Question, submission: Submission, m: AtDistance, claim: float) -> Item:
    """The std of one pixel over time, mm, the pixels' variances averaged.

    With mismatches or without them is right, if it is said which.
    """
    if m.std is None:
        return _unknown(asked, claim)
    n, stats, (_, kept), out = m.stats.n_frames, m.stats, m.kept, m.std.value
    said, treatment = _said_kept(submission) and bool(kept), submission.claims.mismatches
    found = _nearest_of(claim, kept if said else (out,))
    tolerance = _tolerance("std", m.std.se * (found / out if out else 1.0))

    def mistakes() -> Iterator[_Mistake]:
        yield from _other_units(found, tolerance, 1e3 * m.scale_m)
        way = "mismatches.kept" if said else "mismatches.out" if treatment else "mismatches"
        for value in (out,) if said else kept:
            yield _Mistake(way, value, 0.02 * value, _mismatches(m))
        yield _Mistake("middle_pixel", float(m.z_mm[:, *_middle(m)].std(ddof=min(n - 1, 1))))
        yield _Mistake("unrounded", 1e3 * stats.pixel_std_unrounded_m)
        steady = m.z_mm[:, np.isfinite(m.z_mm).all(axis=0)]
        each = steady.std(axis=0, ddof=1) if n > 1 and steady.size else np.array([math.nan])
        for kind, value in (("mean", each.mean()), ("median", np.median(each))):
            yield _Mistake("unpooled", float(value), fact=kind)
        yield _Mistake("of_the_mean", 1e3 * stats.mean_std_m)
        yield _Mistake("standard_error", found / math.sqrt(n))
        yield _Mistake("variance", found**2, found * tolerance)
        yield _Mistake("spatial", 1e3 * stats.spatial_std_m)
        yield _Mistake("mixed", float(m.z_mm[np.isfinite(m.z_mm)].std()))
        filled = np.nan_to_num(m.z_mm)
        if n > 1:
            yield _Mistake("zeros", math.sqrt(filled.var(axis=0, ddof=1).mean()))
        yield _Mistake("zeros", float(filled.std()))

    item = _judge(asked, claim, found, tolerance, mistakes)
    if stats.n_mismatches and item.mistake != "mismatches":
        became = "kept, as you say" if said else "left out"
        item = replace(item, says=f"{item.says[:-1]} ({_mismatches(m)} {became}).")
    return item


def _said_kept(submission: Submission) -> bool:
    return submission.claims.mismatches == "kept"


def _mismatches(m: AtDistance) -> str:
    """ "3 of its samples are mismatches", in short."""
    return counted(m.stats.n_mismatches, "mismatch", "mismatches")


def _std_of_means(m: AtDistance) -> float:
    """Std of the frames' means with all that is in them, mm."""
    means = [float(frame[ok].mean()) for frame in m.z_mm if (ok := np.isfinite(frame)).any()]
    return float(np.std(means, ddof=1)) if len(means) > 1 else math.nan


def _middle(m: AtDistance) -> tuple[int, int]:
    """Row and column of the window's middle pixel."""
    return m.z_mm.shape[1] // 2, m.z_mm.shape[2] // 2


def _nearest_of(claim: float, values: Iterable[float]) -> float:
    return min(values, key=lambda value: abs(claim - value))


def _std_se(asked: _Question, _: Submission, m: AtDistance, claim: float) -> Item:
    """The standard error of that std, mm: std / sqrt(2 dof), dof the effective ones."""
    if m.std is None:
        return _unknown(asked, claim)
    stds = (m.std.value, *m.kept[1])
    n, pixels, part = m.stats.n_frames, m.stats.n_pixels, m.std.se / (m.std.value or 1.0)
    found = _nearest_of(claim, (m.std.se, *(std * part for std in m.kept[1])))

    def mistakes() -> Iterator[_Mistake]:
        for std in stds:
            yield _Mistake("not_divided", std)
            for dof in (n, max(n - 1, 1)):
                yield _Mistake("one_pixel", std / math.sqrt(2 * dof))
            yield _Mistake("one_pixel.mean", std / math.sqrt(n))
            yield _Mistake("independent", std / math.sqrt(2 * n * pixels))
            yield _Mistake("independent", std / math.sqrt(n * pixels))
        yield from _other_units(found, 0.1 * found, 1e3 * m.scale_m)

    return _judge(asked, claim, found, None, mistakes)


def _invalid(asked: _Question, _: Submission, m: AtDistance, claim: float) -> Item:
    """The part of all samples (pixels times frames) that have no depth."""
    found, tolerance = m.invalid.value, _tolerance("invalid", m.invalid.se)

    def mistakes() -> Iterator[_Mistake]:
        yield _Mistake("percent", 100 * found, 100 * tolerance)
        yield _Mistake("complement", 1 - found, tolerance)
        yield _Mistake("complement.percent", 100 * (1 - found), 0.5)
        holes = m.stack.counts == 0
        yield _Mistake("ever", float(holes.any(axis=0).mean()), tolerance)
        yield _Mistake("ever.frames", float(holes.any(axis=(1, 2)).mean()), tolerance)

    return _judge(asked, claim, found, tolerance, mistakes)


JUDGES: dict[str, tuple[str, Callable[[_Question, Submission, AtDistance, float], Item]]] = {
    "bias": ("depth_bias_mm", _bias),
    "bias_se": ("depth_bias_se_mm", _bias_se),
    "std": ("depth_std_mm", _std),
    "std_se": ("depth_std_se_mm", _std_se),
    "invalid": ("invalid_fraction", _invalid),
}


def _other_units(found: float, tolerance: float, step_mm: float) -> Iterator[_Mistake]:
    """Metres, and depth counts where these are no millimetres."""
    yield _Mistake("metres", found / 1e3, tolerance / 1e3)
    if abs(step_mm - 1) > 0.01:
        yield _Mistake("counts", found / step_mm, tolerance / step_mm, f"{step_mm:g}")


# --- over all distances ---------------------------------------------------------------------------


def _plot(asked: _Question, submission: Submission, found: Recomputed) -> Item:
    """The student's figure: measured stds as in the raw depths, and a prediction; all in mm."""
    plot = submission.plot
    measured = {m.distance_m: m.std for m in found.at if m.std is not None}
    if plot is None or not plot.distances_m:
        return asked.missing("measured std of depth against the predicted one, at each distance")
    wanted = len(grading_rules()["exercise"]["distances_m"])
    absent, wrong, right = [], [], 0
    for z, std in measured.items():
        near, tolerance = _nearest(plot.distances_m, z), _tolerance("std", std.se)
        if near is None:
            absent.append(f"{z:.2f} m")
            continue
        got = plot.measured_mm[plot.distances_m.index(near)]
        own = getattr(_row(submission, z), "depth_std_mm", None)  # which is judged in the table
        if min(abs(got - std.value), abs(got - (own or math.inf))) <= tolerance:
            right += 1
        else:
            values = {"got": _shown("std", got), "found": _shown("std", std.value)}
            wrong.append(_say("plotted", z=z, accepted=_accepted("std", tolerance), **values))
    there = [_nearest(list(measured), z) for z in plot.distances_m]
    pairs = zip(plot.distances_m, there, strict=True)
    wrong += [_say("plotted_more", z=z) for z, near in pairs if near is None]
    part = right / max(wanted, len(measured), len(plot.distances_m))
    if wrong:
        verdict: Judgement = "partial" if round(asked.of * part / 2, 2) else "wrong"
        return asked.item(verdict, f"Plot: wrong because {'; '.join(wrong)}.", "", part / 2)
    if absent or right < wanted:
        short = f"{', '.join(absent)} missing" if absent else f"{right} of {wanted} distances"
        if plot.predicted_mm is None:
            part *= grading_rules()["credit"]["no_prediction"]
            short += " and without your prediction"
        return asked.item("partial", _say("plotted_less", short=short), "no_prediction", part)
    return _prediction(asked, plot, [measured[z].value for z in there if z is not None])


def _nearest(distances_m: Sequence[float], z: float) -> float | None:
    """That of these distances which is the same as z; None where none is."""
    near = min(distances_m, key=lambda d: abs(d - z), default=math.inf)
    return near if abs(near - z) <= SAME_DISTANCE_M else None


def _prediction(asked: _Question, plot: Plot, found_mm: Sequence[float]) -> Item:
    """The predicted curve, where the measured points are right: it was made before measuring, so
    its shape must be right, and its scale to a factor.

    found_mm: what the raw depths say for each point.
    """
    if plot.predicted_mm is None:
        return asked.item("partial", _say("no_prediction"), "no_prediction")
    z, predicted, found = map(np.array, (plot.distances_m, plot.predicted_mm, found_mm))
    if not (predicted > 0).all():
        return asked.item("partial", _say("not_positive"), "proportional")
    if len(z) > 1 and np.array_equal(predicted, plot.measured_mm):
        return asked.item("partial", _say("copied_prediction"), "copied_prediction")
    rule, shape = grading_rules()["tolerance"], predicted / z**2
    off, slack, most = shape.max() / shape.min() - 1, rule["prediction"], rule["prediction_factor"]
    if off > slack:
        law = "Z" if np.ptp(np.log(predicted / z)) < math.log(1 + slack) else "something else"
        return asked.item("partial", _say("proportional", law=law, off=off), "proportional")
    ratio = float(np.exp(np.log(predicted / found).mean())) if (found > 0).all() else 1.0
    if 1 / most <= ratio <= most:
        return asked.item("right", _say("predicted", ratio=ratio))
    mistake = "metres" if 1 / most <= 1e3 * ratio <= most else "off_scale"
    return asked.item("partial", _say(f"predicted_{mistake}", ratio=ratio, most=most), mistake)


def _sigma_d(asked: _Question, submission: Submission, found: Recomputed) -> Item:
    """The std of disparity, px, from sigma_Z = Z^2 sigma_d / (fx B) through all distances."""
    claim, law, camera = submission.claims.sigma_d_px, found.law, submission.camera
    if law is None:
        return _no_law(asked, found)
    if claim is None:
        return asked.missing("the fit with the exponent held at 2 is asked for")
    value = law.sigma_d_px
    tolerance = _tolerance("sigma_d", value * _log_se(law, 0))

    def mistakes() -> Iterator[_Mistake]:
        for factor in (1e3, 1e-3):
            yield _Mistake("millimetres", factor * value, factor * tolerance)
        product = camera.fx * (camera.baseline_m or 0.0)
        known = [m for m in found.at if m.std is not None]

        def mean(std: str, power: int) -> float:
            each = [getattr(m.stats, std) * product / m.distance_m**power for m in known]
            return float(np.mean(each))

        yield _Mistake("not_squared", mean("pixel_std_m", 1))
        for key, std in (("spatial", "spatial_std_m"), ("of_the_mean", "mean_std_m")):
            yield _Mistake(key, mean(std, 2), 0.02 * mean(std, 2))

    return _judge(asked, claim, value, tolerance, mistakes)


def _sigma_d_interval(asked: _Question, submission: Submission, found: Recomputed) -> Item:
    """The 95 % interval of sigma_d, px, widened for the scatter about the law."""
    claim, law = submission.claims.sigma_d_interval_px, found.law
    if law is None:
        return _no_law(asked, found)
    if claim is None:
        return asked.missing("a number without one says nothing of how well it fits")
    stated = submission.claims.sigma_d_px or 0.0
    unit = next((f for f in (1e3, 1e-3) if 0.8 < stated / (f * law.sigma_d_px) < 1.25), 1.0)
    low, high = claim
    item = _judge_interval(asked, (low / unit, high / unit), law.sigma_d_interval_px, law, 0)
    if unit != 1.0:
        item = replace(item, says=f"{item.says[:-1]} (in px; the unit is counted with sigma_d).")
    return item


def _exponent(asked: _Question, submission: Submission, found: Recomputed) -> Item:
    """The exponent of a free fit: none quoted is right, and one with its interval is, too."""
    claims, free = submission.claims, found.free
    claim, interval = claims.exponent, claims.exponent_interval
    if found.law is None:
        return _no_law(asked, found)
    if claim is None and interval is None:
        at, n = [m.distance_m for m in found.at], counted(len(found.at), "distance")
        return asked.item("right", _say("no_exponent", n=n, factor=max(at) / min(at)))
    if free is None or free.exponent is None or free.exponent_interval is None:
        return asked.item("missing", _say("none_to_compare"))
    if claim is None:
        return asked.item("partial", _say("no_middle"), "incomplete")
    value, tolerance = free.exponent, _tolerance("exponent", _log_se(free, 1))

    def mistakes() -> Iterator[_Mistake]:
        yield _Mistake("sign", -value, tolerance)
        yield _Mistake("of_variance", 2 * value, tolerance)

    item = _judge(asked, claim, value, tolerance, mistakes)
    right = item.verdict == "right"
    return _with_interval(asked, item, claim, free, interval) if right else item


def _with_interval(
    asked: _Question, item: Item, claim: float, free: NoiseFit, interval: Interval | None
) -> Item:
    """The item of a right exponent, after a look at its interval."""
    assert free.exponent_interval is not None
    low, high = free.exponent_interval
    if interval is None:
        says = _say("no_interval", claim=claim, low=low, high=high)
        return asked.item("partial", says, "no_interval", tolerance=item.tolerance)
    ends = _judge_interval(asked, interval, (low, high), free, 1)
    if ends.verdict == "right":
        facts = {"interval": interval, "found": free.exponent, "low": low, "high": high}
        return replace(item, says=_say("exponent", claim=claim, **facts))
    if ends.points < 0.5 * asked.of:  # the exponent itself is right
        points = round(0.5 * asked.of, 2)
        mistake = ends.mistake or "no_interval"
        return replace(ends, points=points, verdict="partial", mistake=mistake)
    return ends


def _judge_interval(
    asked: _Question, claim: Interval, found: Interval, law: NoiseFit, i: int
) -> Item:
    """A 95 % interval of sigma_d (i = 0) or the exponent (1): each end may be off by so many errors
    of half the interval's width."""
    topic, rule = asked.topic, grading_rules()["tolerance"]
    half = (found[1] - found[0]) / 2
    digits = max(_rounding(topic, end) for end in claim)
    tolerance = rule["standard_errors"] * rule["error_of_an_error"] * half + digits
    unit = UNIT_OF[topic]
    one, two = (" to ".join(_digits(topic, end) for end in ends) for ends in (claim, found))
    accepted = f"{_accepted(topic, tolerance)} for each end"
    facts = {"claim": one + unit, "found": two + unit, "accepted": accepted}
    says = _say("compared", what=asked.name, **facts)
    off = _apart(claim, found)
    if off <= tolerance:
        return asked.item("right", f"{says}: right.", tolerance=tolerance)

    def about(error: float) -> Interval:
        if i == 1 and law.exponent is not None:
            return law.exponent - error, law.exponent + error
        factor = math.exp(min(error, 50.0))
        return law.sigma_d_px / factor, law.sigma_d_px * factor

    wide, narrow = _log_se(law, i), _log_se(law, i, widened=False)
    others = [("one_sigma", about(se)) for se in (wide, narrow)]
    others.append(("not_widened", about(1.96 * narrow)))
    for mistake, ends in sorted(others, key=lambda other: _apart(claim, other[1])):
        explained = 0.1 * (ends[1] - ends[0]) + _half_digit(topic)
        if _apart(claim, ends) <= min(explained, off / 4):
            says = f"{says}: wrong because {WHY[mistake]}."
            return asked.item("partial", says, mistake, tolerance=tolerance)
    if off <= rule["near"] * tolerance:
        says = f"{says}: close, but not within that."
        return asked.item("partial", says, "close", tolerance=tolerance)
    why = "narrow" if claim[1] - claim[0] < found[1] - found[0] else "wide"
    says = f"{says}: wrong because too {why}, or about another middle."
    return asked.item("wrong", says, tolerance=tolerance)


def _apart(one: Interval, two: Interval) -> float:
    """How far the ends of two intervals are apart, at most."""
    return max(abs(a - b) for a, b in zip(one, two, strict=True))


def _no_law(asked: _Question, found: Recomputed) -> Item:
    """No fit: the camera's facts lack the baseline, or the raw depths are at fault."""
    key = "no_baseline" if found.why_no_law.startswith("baseline_m") else "no_law"
    return asked.item("missing", _say(key, what=asked.name, why=found.why_no_law))


# --- the conclusion -------------------------------------------------------------------------------


def _conclusion(asked: _Question, submission: Submission, found: Recomputed) -> Item:
    """Which error dominates, judged by the student's own depths."""
    said = submission.conclusion
    known = [m for m in found.at if m.bias is not None and m.std is not None]
    if said.dominates is None or not known:
        why = "your raw depths give neither" if said.dominates else "say which dominates"
        return asked.missing(f"{why} where you will mount the camera")
    if said.distance_m is None:
        return asked.item("partial", _say("nowhere", dominates=said.dominates), "incomplete")
    z, frames, near, far = said.distance_m, said.frames, known[0].distance_m, known[-1].distance_m
    bias, bias_se, noise, noise_se = _at_mounting(submission, known, z, frames)
    facts = {"bias": bias, "se": bias_se, "noise": noise, "dominates": said.dominates, "z": z}
    says = _say("dominates", over=f"{frames} frames" if frames > 1 else "one frame", **facts)
    if not near / 1.5 <= z <= 1.5 * far:
        says += _say("too_far", near=near, far=far)
        if near / 1.5 <= z / 100 <= 1.5 * far:
            says = _say("centimetres", z=z, metres=z / 100)
        return asked.item("partial", says, "not_measured_there")
    lead = abs(bias) - noise
    sure = grading_rules()["tolerance"]["standard_errors"] * math.hypot(bias_se, noise_se)
    if abs(lead) <= sure:
        return asked.item("right", f"{says}: too close to call, so right.")
    larger = "bias" if lead > 0 else "noise"
    if said.dominates == larger:
        return asked.item("right", f"{says}: right.")
    averaged = SAYS["averaging"] * (larger == "bias" and frames > 1)
    says += _say("other", larger=larger, lead=abs(lead), averaged=averaged)
    return asked.item("partial", says, "other_dominates")


def _at_mounting(
    submission: Submission, known: Sequence[AtDistance], z: float, frames: int
) -> tuple[float, float, float, float]:
    """Bias, its error, noise of the mean of `frames` frames and its error at z, mm.

    Bias: linear between the distances, beyond them in proportion to Z, with that much more error.
    Noise: of the nearest distance, in proportion to Z^2.
    """
    at = np.array([m.distance_m for m in known])
    each = [m.bias.value for m in known if m.bias is not None]
    errors = [m.bias.se for m in known if m.bias is not None]
    inside = float(np.clip(z, at[0], at[-1]))
    beyond = z / inside
    bias, se = float(np.interp(inside, at, each)) * beyond, float(np.interp(inside, at, errors))
    tape = 1e3 * min(submission.tape_sigma_m, grading_rules()["exercise"]["tape_at_most_m"])
    nearest = min(known, key=lambda m: abs(m.distance_m - z))
    noise = (nearest.noise_of_mean_mm(frames) or 0.0) * (z / nearest.distance_m) ** 2
    part = 0.0 if nearest.std is None else nearest.std.se / max(nearest.std.value, 1e-12)
    return bias, math.hypot(se, tape) * max(beyond, 1 / beyond) ** 2, noise, noise * part


def _paragraph(asked: _Question, submission: Submission) -> Item:
    """Whether there is a closing paragraph, by its number of words; a person reads it."""
    words = len(submission.conclusion.paragraph.split())
    if words == 0:
        return asked.missing("three sentences on which error dominates, and why")
    if words < grading_rules()["exercise"]["words"]:
        return asked.item("partial", _say("short", words=counted(words, "word")), "short")
    return asked.item("right", _say("paragraph", words=words))


# --- judging one number ---------------------------------------------------------------------------


def _judge(
    asked: _Question,
    claim: float,
    found: float,
    tolerance: float | None,
    mistakes: Callable[[], Iterator[_Mistake]],
) -> Item:
    """A claimed number beside what the raw depths say: right, explained, close or wrong; the
    mistake that explains it best counts.

    tolerance: None for a standard error, which is itself known to a part only: there the ratio to
    what is found counts.
    """
    topic, rule = asked.topic, grading_rules()["tolerance"]
    if tolerance is None:
        factor = 1 + rule["standard_errors"] * rule["error_of_an_error"]
        off = abs(math.log(claim / found)) / math.log(factor) if claim > 0 < found else math.inf
        off = 0.0 if abs(claim - found) <= _rounding(topic, claim) else off
        tolerance, accepted = (factor - 1) * found, _say("factor", factor=factor)
    else:
        tolerance += _rounding(topic, claim) - _half_digit(topic)
        off, accepted = abs(claim - found) / tolerance, _accepted(topic, tolerance)
    facts = {"claim": _shown(topic, claim), "found": _shown(topic, found), "accepted": accepted}
    says = _say("compared", what=asked.name, **facts)
    answer = partial(asked.item, tolerance=tolerance)
    if off <= 1:
        return answer("right", f"{says}: right.")
    mistake = _explanation(asked, claim, found, tolerance, mistakes())
    if mistake is not None:
        says, code = f"{says}: wrong because {mistake.why(topic)}.", mistake.key
        return answer("partial", says, code.partition(".")[0])
    if off <= rule["near"]:
        return answer("partial", f"{says}: close, but not within that.", "close")
    size = "large" if claim > found else "small"
    return answer("wrong", f"{says}: wrong because it is too {size}.")


def _explanation(
    asked: _Question, claim: float, found: float, tolerance: float, mistakes: Iterable[_Mistake]
) -> _Mistake | None:
    """The mistake whose number is nearest to a claim, if it is near enough to be the reason.

    A mistake whose number is near the right one explains only a claim that has its digits.
    """
    topic, best, least = asked.topic, None, math.inf
    rounded = topic not in ONE_DIGIT and claim == float(f"{found:.0e}")
    for mistake in [_Mistake("rounded", claim)] if rounded else mistakes:
        if asked.only not in (None, mistake.key.partition(".")[0]):
            continue
        value, off = mistake.value, abs(claim - mistake.value)
        within = max(mistake.within, EXPLAINED_WITHIN * abs(value))
        if abs(value - found) < max(2 * tolerance, NEAR_RIGHT * abs(found)):
            coarse = _last_digit(claim) > COARSE * abs(value)
            within = 0.0 if coarse else max(_half_digit(topic), EXACTLY * abs(value))
        if off <= within and off < least:
            best, least = mistake, off
    return best


def _unknown(asked: _Question, claim: float) -> Item:
    """A claim about what the raw depths do not give."""
    says = _say("unknown", what=asked.name, claim=_shown(asked.topic, claim))
    return asked.item("wrong", says)


def _half_digit(topic: str) -> float:
    """Half a unit of the last digit that the notebook prints, in the claim's unit."""
    half = 0.5 * 10.0 ** -grading_rules()["digits"][topic]
    return half / 100 if topic == "invalid" else half


def _tolerance(topic: str, se: float) -> float:
    """How far a claim may be off: standard errors of what is found, and half a printed digit."""
    return float(grading_rules()["tolerance"]["standard_errors"] * se + _half_digit(topic))


def _last_digit(number: float) -> float:
    """Half a unit of the last digit with which a number is written."""
    return 0.5 * 10.0 ** int(Decimal(repr(float(number))).as_tuple().exponent)


def _rounding(topic: str, claim: float) -> float:
    """By how much a claim is rounded, in the claim's unit: half a printed digit, or half of its own
    last one where that is the second at least."""
    if claim == 0:
        return _half_digit(topic)
    first = math.floor(math.log10(abs(claim)))
    most = 0.5 * 10.0 ** (first - (topic not in ONE_DIGIT))
    return max(_half_digit(topic), min(_last_digit(claim), most))


def _log_se(law: NoiseFit, i: int, widened: bool = True) -> float:
    """Standard error of ln sigma_d (i = 0) or of the exponent (1), widened for scatter."""
    scatter = max(1.0, law.chi2 / law.dof) if widened and law.dof > 0 else 1.0
    return math.sqrt(law.covariance[i, i] * scatter)


def _shown(topic: str, value: float) -> str:
    """A value with its unit."""
    return _digits(topic, value) + UNIT_OF.get(topic, " mm")


def _digits(topic: str, value: float) -> str:
    """A value with the digits of its topic, others where these would hide it."""
    value = 100 * value if topic == "invalid" else value
    digits, sign = grading_rules()["digits"][topic], "+" if topic == "bias" else ""
    if value != 0 and (abs(value) >= 1e6 or abs(value) < 3.0 * 10.0**-digits):
        return f"{value:{sign}.2g}"
    return f"{value:{sign}.{digits}f}"


def _accepted(topic: str, tolerance: float) -> str:
    """The tolerance in words; a fraction is shown in percent."""
    return f"± {100 * tolerance if topic == 'invalid' else tolerance:.2g} is accepted"
