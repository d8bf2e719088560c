"""Submissions to test the grader with: honest ones, weak ones, wrong ones, and made-up data.

The camera is synthetic and quick: disparity noise that correlates over a 9 px matching window, a
pattern that stays, a drift that all pixels share, holes, and depths rounded to counts. What is
claimed of its depths is computed here with NumPy where that is not the course's own estimate.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from coursekit.submission.flags import data_flags, fingerprint
from coursekit.submission.format import (
    CameraFacts,
    Claims,
    Conclusion,
    Outcome,
    Plot,
    Stack,
    Submission,
    TableRow,
)
from coursekit.submission.recompute import Recomputed, recompute
from coursekit.submission.rubric import Grade, judged

DISTANCES = (0.30, 0.45, 0.60)
MADE = "2026-03-02T10:00:00+00:00"
CLOCK_START_S = 1_772_440_000.0  # half an hour before MADE
MATCHING_PX = 9
PARAGRAPH = (
    "I will mount the camera at 0.45 m. There the bias is larger than the noise of one pixel, and "
    "the mean of thirty frames makes the noise smaller still. So the bias dominates: calibrate it."
)
Counts = NDArray[np.uint16]


def camera(seed: int = 0, **changes: Any) -> CameraFacts:
    """A real camera's facts; another unit for each seed."""
    random = np.random.default_rng((seed, 99))
    facts = CameraFacts(
        name="Intel RealSense D435",
        serial=f"{random.integers(10**11, 10**12)}",
        source="live",
        width=848,
        height=480,
        fx=round(425 + float(random.normal(0, 3)), 4),
        fy=425.5,
        cx=round(424 + float(random.normal(0, 3)), 4),
        cy=round(240 + float(random.normal(0, 3)), 4),
        model="brown_conrady",
        coeffs=(0.0,) * 5,
        baseline_m=round(0.0500 + float(random.normal(0, 1e-4)), 7),
        depth_scale_m=0.001,
    )
    return replace(facts, **changes)


def depths(
    random: np.random.Generator,
    facts: CameraFacts,
    distance_m: float,
    frames: int = 100,
    size: int = 40,
    sigma_d: float = 0.065,
    holes: float = 0.01,
    scale_error: float = -0.006,
    offset_px: float = 0.1,
) -> Counts:
    """Raw counts (frames, size, size) of a block's face at a distance."""
    margin = MATCHING_PX
    wide = size + 2 * margin
    shape = (frames, wide, wide)
    noise = uniform_filter(random.standard_normal(shape, np.float32), (1, MATCHING_PX, MATCHING_PX))
    pattern = uniform_filter(random.standard_normal(shape[1:]), MATCHING_PX) * MATCHING_PX
    noise = noise[:, margin:-margin, margin:-margin] * MATCHING_PX * sigma_d
    pattern = pattern[margin:-margin, margin:-margin] * 1.1 * sigma_d
    drift = np.zeros(frames)
    for i, kick in enumerate(random.standard_normal(frames)):
        drift[i] = (0.989 * drift[i - 1] if i else 0.0) + 0.008 * 0.148 * kick
    assert facts.baseline_m is not None
    product = facts.fx * facts.baseline_m
    v, u = np.indices((size, size)) - (size - 1) / 2
    plane = distance_m * (1 + 2e-5 * u + 1e-5 * v)
    true = product / (plane * (1 + scale_error)) + offset_px
    z = product / (true + pattern + noise + drift[:, None, None])
    counts = np.rint(z / facts.depth_scale_m)
    hole = uniform_filter(random.standard_normal((size, size)), 5) * 5
    often = hole > np.quantile(hole, 1 - 2 * holes) if holes else np.zeros((size, size), bool)
    counts[often & (random.random(counts.shape) < 0.5)] = 0
    return counts.astype(np.uint16)


def clock(random: np.random.Generator, start_s: float, frames: int) -> NDArray[np.float64]:
    """Time stamps of a real camera at 30 frames a second: some jitter, and a dropped frame."""
    steps = 1 / 30 + random.normal(0, 2e-5, frames)
    if frames > 50:
        steps[frames // 3] *= 2
    return start_s + np.cumsum(steps)


def raw(
    seed: int = 0, frames: int = 100, **of_camera: Any
) -> tuple[CameraFacts, tuple[Stack, ...]]:
    """A camera and its stacks at the three distances."""
    random = np.random.default_rng(seed)
    facts = camera(seed, **of_camera)
    stacks = []
    truth = {
        "scale_error": float(random.normal(0, 0.006)),
        "offset_px": float(random.normal(0, 0.1)),
        "sigma_d": 0.065 * float(random.uniform(0.7, 1.4)),
    }
    for i, z in enumerate(DISTANCES):
        size = (40, 40, 33)[i]
        local = truth | {"sigma_d": truth["sigma_d"] * float(random.uniform(0.92, 1.08))}
        hole = float(random.choice([0.0, 0.005, 0.02]))
        counts = depths(random, facts, z, frames, size, holes=hole, **local)
        times = clock(random, CLOCK_START_S + 60 * i, frames)
        stacks.append(Stack(z, (400 + i, 220, size, size), counts, times))
    return facts, tuple(stacks)


def claims_of(submission: Submission, found: Recomputed | None = None) -> Claims:
    """What an honest student claims. Levels, stds and holes by NumPy; errors and fits by the kit.

    A level is the mean over the pixels' means, a std that of each pixel with the squares pooled.
    """
    found = found or recompute(submission)
    rows = []
    for m in found.at:
        z = m.z_mm
        steady = np.isfinite(z).all(axis=0)
        assert m.std is not None
        rows.append(
            TableRow(
                m.distance_m,
                round(float(z[:, steady].mean()) - 1e3 * m.distance_m, 2),
                m.bias_se_mm,
                round(float(np.sqrt(z[:, steady].var(axis=0, ddof=1).mean())), 3),
                m.std.se,
                round(float((m.stack.counts == 0).mean()), 3),
            )
        )
    assert found.law is not None
    return Claims(tuple(rows), round(found.law.sigma_d_px, 3), found.law.sigma_d_interval_px)


def exact_claims(found: Recomputed) -> Claims:
    """The recomputed values themselves, with an exponent: the middle of every tolerance."""
    rows = tuple(
        TableRow(
            m.distance_m,
            m.bias and m.bias.value,
            m.bias_se_mm,
            m.std and m.std.value,
            m.std and m.std.se,
            m.invalid.value,
        )
        for m in found.at
    )
    assert found.law is not None
    assert found.free is not None
    return Claims(
        rows,
        found.law.sigma_d_px,
        found.law.sigma_d_interval_px,
        found.free.exponent,
        found.free.exponent_interval,
    )


def honest(
    seed: int = 0, frames: int = 100, of_camera: dict[str, Any] | None = None, **changes: Any
) -> Submission:
    """A submission that deserves full points; `changes` are fields to replace afterwards."""
    whole = _honest(seed, frames, tuple(sorted((of_camera or {}).items())))
    return replace(whole, **changes) if changes else whole


@cache
def _honest(seed: int, frames: int, of_camera: tuple[tuple[str, Any], ...]) -> Submission:
    return finished(*raw(seed, frames, **dict(of_camera)), f"Student {seed}")


@cache
def graded(submission: Submission) -> Grade:
    """As `rubric.grade`, but what several submissions share is computed once."""
    found = _recomputed(submission.stacks, submission.camera, submission.tape_sigma_m)
    prints = fingerprint(submission)
    flags = data_flags(submission, found, prints)
    return Grade(submission.student, judged(submission, found), flags, found, prints)


@cache
def _recomputed(stacks: tuple[Stack, ...], facts: CameraFacts, tape_sigma_m: float) -> Recomputed:
    whole = replace(_honest(0, 100, ()), stacks=stacks, camera=facts, tape_sigma_m=tape_sigma_m)
    return recompute(whole)


def finished(
    facts: CameraFacts, stacks: tuple[Stack, ...], student: str, **changes: Any
) -> Submission:
    """Raw data with honest claims, an honest plot and the right conclusion."""
    empty = Submission(
        student=student,
        made=MADE,
        versions={"python": "3.12.3", "numpy": "2.3.5", "coursekit": "0.1.0"},
        camera=facts,
        tape_sigma_m=0.0 if facts.source == "simulated" else 0.001,
        caliper_m=0.06,
        stacks=stacks,
        claims=Claims(),
        plot=None,
        conclusion=Conclusion(),
        outcomes={
            "depth_noise.twice_as_far": Outcome(True, 1),
            "depth_noise.width": Outcome(False, 2),
            "depth_noise.depth_noise": Outcome(True, 3),
        },
    )
    found = recompute(empty)
    claims = claims_of(empty, found)
    assert found.law is not None
    plot = Plot(
        tuple(row.distance_m for row in claims.rows),
        tuple(row.depth_std_mm or 0.0 for row in claims.rows),
        tuple(1e3 * float(s) for s in 1.07 * found.law.std_m([m.distance_m for m in found.at])[0]),
    )
    middle = found.at[len(found.at) // 2]
    assert middle.bias is not None
    noise = middle.noise_of_mean_mm(30) or 0.0
    dominates = "bias" if abs(middle.bias.value) > noise else "noise"
    conclusion = Conclusion(middle.distance_m, 30, dominates, PARAGRAPH)
    whole = replace(empty, claims=claims, plot=plot, conclusion=conclusion)
    return replace(whole, **changes)


# --- weak and wrong -----------------------------------------------------------------------------


@cache
def weak(seed: int = 0) -> Submission:
    """84 frames at 0.60 m, nothing at 0.30 m, no plot, three words of a paragraph."""
    full = honest(seed)
    far = full.stacks[2]
    short = replace(far, counts=far.counts[:84], times_s=far.times_s[:84])
    two = replace(full, stacks=(full.stacks[1], short))
    two = replace(two, claims=claims_of(two), plot=None)
    return replace(two, conclusion=replace(full.conclusion, paragraph="bias, I think"))


def with_row(submission: Submission, i: int, **changes: float | None) -> Submission:
    """The submission with fields of row i changed."""
    rows = list(submission.claims.rows)
    rows[i] = replace(rows[i], **changes)
    return replace(submission, claims=replace(submission.claims, rows=tuple(rows)))


def with_claims(submission: Submission, **changes: Any) -> Submission:
    """The submission with other claims beside its rows."""
    return replace(submission, claims=replace(submission.claims, **changes))


def predicting(plot: Plot, factor: float) -> Plot:
    """The plot with a prediction that is so many times its own."""
    return replace(plot, predicted_mm=tuple(factor * mm for mm in plot.predicted_mm or ()))


@cache
def mistaken(seed: int = 0) -> dict[str, tuple[str, Submission]]:
    """One wrong submission for each named mistake: {mistake: (item's topic, submission)}."""
    # Depths in tenths of a millimetre, a bias and holes: mistakes that would hide otherwise show.
    facts = camera(seed, depth_scale_m=1e-4)
    random = np.random.default_rng(seed)
    stacks = tuple(
        Stack(
            z,
            (400, 220, 40, 40),
            depths(random, facts, z, 100, 40, sigma_d, 0.03, -0.012, 0.2),
            clock(random, CLOCK_START_S + 60 * i, 100),
        )
        for i, (z, sigma_d) in enumerate(zip(DISTANCES, (0.060, 0.068, 0.064), strict=True))
    )
    good = finished(facts, stacks, f"Student {seed}")
    found = recompute(good)
    m, row = found.at[1], good.claims.rows[1]
    z = m.z_mm
    bias, std = row.depth_bias_mm or 0.0, row.depth_std_mm or 0.0
    se, invalid = row.depth_std_se_mm or 0.0, row.invalid_fraction or 0.0
    law, free = found.law, found.free
    assert law is not None
    assert free is not None
    assert good.plot is not None
    product = facts.fx * (facts.baseline_m or 0.0)
    one_sigma = (free.covariance[1, 1]) ** 0.5
    coarse = honest(seed)
    near = recompute(coarse).at[0]
    near_stds = near.z_mm[:, np.isfinite(near.z_mm).all(axis=0)].std(axis=0, ddof=1)
    unrounded = 1e3 * near.stats.pixel_std_unrounded_m

    def cell(**change: float | None) -> Submission:
        return with_row(good, 1, **change)

    def about(k: float) -> tuple[float, float]:
        factor = float(np.exp(k * law.covariance[0, 0] ** 0.5))
        return law.sigma_d_px / factor, law.sigma_d_px * factor

    return {
        "sign": ("bias", cell(depth_bias_mm=-bias)),
        "metres": ("bias", cell(depth_bias_mm=bias / 1000)),
        "counts": ("bias", cell(depth_bias_mm=bias / (1e3 * facts.depth_scale_m))),
        "level": ("bias", cell(depth_bias_mm=1e3 * m.distance_m + bias)),
        "percent": ("invalid", cell(invalid_fraction=100 * invalid)),
        "complement": ("invalid", cell(invalid_fraction=1 - invalid)),
        "ever": ("invalid", cell(invalid_fraction=float(np.isnan(z).any(axis=0).mean()))),
        "zeros": ("bias", cell(depth_bias_mm=float(np.nan_to_num(z).mean()) - 450)),
        "unrounded": ("std", with_row(coarse, 0, depth_std_mm=unrounded)),
        "of_the_mean": ("std", cell(depth_std_mm=float(np.nanmean(z, axis=(1, 2)).std(ddof=1)))),
        "standard_error": ("std", cell(depth_std_mm=std / 10)),
        "variance": ("std", cell(depth_std_mm=std**2)),
        "spatial": ("std", cell(depth_std_mm=1e3 * m.stats.spatial_std_m)),
        "mixed": ("std", cell(depth_std_mm=float(np.nanstd(z)))),
        "not_divided": ("bias_se", cell(depth_bias_se_mm=std)),
        "independent": ("bias_se", cell(depth_bias_se_mm=std / z.size**0.5)),
        "unpooled": ("std", with_row(coarse, 0, depth_std_mm=float(near_stds.mean()))),
        "tape_only": ("bias_se", replace(cell(depth_bias_se_mm=0.1), tape_sigma_m=0.0001)),
        "no_tape": ("bias_se", replace(cell(depth_bias_se_mm=m.bias_se_apart_mm), tape_sigma_m=0)),
        "one_pixel": ("std_se", cell(depth_std_se_mm=std / 198**0.5)),
        "close": ("std_se", cell(depth_std_se_mm=1.7 * se)),
        "millimetres": ("sigma_d", with_claims(good, sigma_d_px=1000 * law.sigma_d_px)),
        "not_squared": (
            "sigma_d",
            with_claims(
                good,
                sigma_d_px=float(
                    np.mean([a.stats.pixel_std_m * product / a.distance_m for a in found.at])
                ),
            ),
        ),
        "one_sigma": ("sigma_d_interval", with_claims(good, sigma_d_interval_px=about(1.0))),
        "not_widened": ("sigma_d_interval", with_claims(good, sigma_d_interval_px=about(1.96))),
        "no_interval": ("exponent", with_claims(good, exponent=free.exponent)),
        "of_variance": (
            "exponent",
            with_claims(
                good,
                exponent=2 * (free.exponent or 0.0),
                exponent_interval=(4 - one_sigma, 4 + one_sigma),
            ),
        ),
        "proportional": (
            "plot",
            replace(good, plot=replace(good.plot, predicted_mm=(0.4, 0.6, 0.8))),
        ),
        "copied_prediction": (
            "plot",
            replace(good, plot=replace(good.plot, predicted_mm=good.plot.measured_mm)),
        ),
        "off_scale": ("plot", replace(good, plot=predicting(good.plot, 2.5))),
        "no_prediction": ("plot", replace(good, plot=replace(good.plot, predicted_mm=None))),
        "other_dominates": (
            "verdict",
            replace(good, conclusion=replace(good.conclusion, dominates="noise")),
        ),
        "not_measured_there": (
            "verdict",
            replace(good, conclusion=replace(good.conclusion, distance_m=5.0)),
        ),
        "short": ("paragraph", replace(good, conclusion=replace(good.conclusion, paragraph="so"))),
        "incomplete": ("data", weak(seed)),
    }


# --- copied and made up -------------------------------------------------------------------------

Change = Callable[[Counts, np.random.Generator], Counts]


def _few_values(counts: Counts, random: np.random.Generator) -> Counts:
    out = counts.copy()
    at = tuple(random.integers(0, size, 400) for size in counts.shape)
    out[at] += random.integers(1, 40, 400).astype(np.uint16)
    return out


def _one_count(counts: Counts, random: np.random.Generator) -> Counts:
    moved = counts.astype(int) + random.integers(-1, 2, counts.shape)
    return np.where(counts > 0, moved, 0).astype(np.uint16)


def _shuffled(counts: Counts, random: np.random.Generator) -> Counts:
    return random.permutation(counts)


def _subset(counts: Counts, random: np.random.Generator) -> Counts:
    return counts[np.sort(random.permutation(len(counts))[: len(counts) * 6 // 10])]


def _shifted(counts: Counts, _: np.random.Generator) -> Counts:
    return np.where(counts > 0, counts + 3, 0).astype(np.uint16)


COPIES: dict[str, Change] = {
    "identical": lambda counts, _: counts.copy(),
    "few_values": _few_values,
    "one_count": _one_count,
    "reordered": _shuffled,
    "subset": _subset,
    "constant_added": _shifted,
}


@cache
def copied(
    original: Submission, how: str, student: str = "Copying Student", seed: int = 5
) -> Submission:
    """The raw depths of another submission, changed `how` (see COPIES), with honest claims."""
    random = np.random.default_rng(seed)
    stacks = []
    for stack in original.stacks:
        counts = COPIES[how](stack.counts, random)
        times = clock(random, float(stack.times_s[0]) + 7.0, len(counts))
        stacks.append(replace(stack, counts=counts, times_s=times))
    facts = camera(seed + 1000, depth_scale_m=original.camera.depth_scale_m)
    return finished(facts, tuple(stacks), student)


def _made_up(seed: int, make: Callable[[np.random.Generator, float], Counts]) -> Submission:
    random = np.random.default_rng(seed)
    facts = camera(seed)
    stacks = tuple(
        Stack(z, (400, 220, 40, 40), make(random, z), clock(random, CLOCK_START_S + 60 * i, 100))
        for i, z in enumerate(DISTANCES)
    )
    return finished(facts, stacks, f"Inventive Student {seed}")


@cache
def random_numbers(seed: int = 0) -> Submission:
    """Independent Gaussian numbers of the right size instead of a camera's."""
    return _made_up(
        seed,
        lambda random, z: np.rint(1e3 * z + 3 * z**2 * random.normal(0, 1, (100, 40, 40))).astype(
            np.uint16
        ),
    )


def flat_noise(seed: int = 0) -> Submission:
    """Camera-like noise of the same size at every distance."""

    def make(random: np.random.Generator, z: float) -> Counts:
        near = depths(random, camera(seed), 0.45, holes=0.0)
        return (near.astype(int) + round(1e3 * (z - 0.45))).astype(np.uint16)

    return _made_up(seed, make)


def too_clean(seed: int = 0) -> Submission:
    """A hundredth of a camera's noise, in fine counts."""
    random = np.random.default_rng(seed)
    facts = camera(seed, depth_scale_m=1e-5)
    stacks = tuple(
        Stack(
            z,
            (400, 220, 40, 40),
            depths(random, facts, z, sigma_d=0.003),
            clock(random, CLOCK_START_S + 60 * i, 100),
        )
        for i, z in enumerate(DISTANCES)
    )
    return finished(facts, stacks, f"Clean Student {seed}")


def repeated_frames(seed: int = 0) -> Submission:
    """25 frames, four times each."""
    few = honest(seed, 25)
    stacks = tuple(
        replace(
            s, counts=np.tile(s.counts, (4, 1, 1)), times_s=s.times_s[0] + np.arange(100) / 29.97
        )
        for s in few.stacks
    )
    return finished(few.camera, stacks, few.student)


def one_stack_twice(seed: int = 0) -> Submission:
    """0.60 m made out of 0.45 m, its noise scaled to the law."""
    good = honest(seed)
    middle = good.stacks[1]
    mean = middle.counts.mean(axis=0)
    counts = np.rint(600 + (16 / 9) * (middle.counts - mean)) * (middle.counts > 0)
    far = Stack(0.60, middle.window, counts.astype(np.uint16), good.stacks[2].times_s)
    return finished(good.camera, (*good.stacks[:2], far), good.student)


def simulated_as_live(seed: int = 0, changed: str = "all") -> Submission:
    """The simulated camera's facts and clock, with another word for its source.

    changed: "all" for name and clock as simulated, "clock" or "name" or "lens" for that alone.
    """
    from coursekit import specifications

    good = honest(seed)
    facts, stacks = good.camera, good.stacks
    if changed in ("all", "name"):
        facts = replace(facts, name="Simulated D435", serial=f"seed-{seed}")
    if changed in ("all", "lens"):
        lens = specifications.device("D435").unit.depth
        facts = replace(facts, fx=lens.fx, fy=lens.fy, cx=lens.cx, cy=lens.cy)
    if changed in ("all", "clock"):
        stacks = tuple(
            replace(s, times_s=(np.arange(len(s.times_s)) + 100 * i + 1) / 30)
            for i, s in enumerate(stacks)
        )
    return finished(facts, stacks, good.student)


def impossible_times(seed: int = 0, how: str = "back") -> Submission:
    """how: "back", "fast", "same" (one clock for two distances), "together" or "future"."""
    good = honest(seed)
    stacks = list(good.stacks)
    times = stacks[1].times_s.copy()
    if how == "back":
        times[50:] -= 1.0
    elif how == "fast":
        times = times[0] + (times - times[0]) / 30
    elif how == "same":
        times = stacks[0].times_s[: len(times)]
    elif how == "together":
        times += stacks[0].times_s[0] - times[0] + 0.01
    else:
        times += 10 * 86_400
    stacks[1] = replace(stacks[1], times_s=times)
    return replace(good, stacks=tuple(stacks))


HOSTILE_TEXTS = (
    "<script>alert(1)</script>",
    "<img src=x onerror=alert(1)>",
    "\"><svg onload='alert(1)'>",
    '=HYPERLINK("http://example.org";"x")',
    "+1+1",
    "-2+3",
    "@SUM(A1)",
    "../../etc/passwd",
    "C:\\Windows\\system32",
    "{{7*7}} ${7*7} <%= 7*7 %>",
    "&lt;b&gt; &amp; ]]> <!-- -->",
)


def injecting(text: str, seed: int = 0) -> Submission:
    """A student whose name, camera and paragraph are `text`."""
    good = honest(seed)
    return replace(
        good,
        student=text,
        camera=replace(good.camera, name=text, serial=text),
        conclusion=replace(good.conclusion, paragraph=f"{text} " + "word " * 20),
        versions={"python": text},
    )


DISHONEST: dict[str, tuple[str, Callable[[int], Submission]]] = {
    "random numbers": ("white_in_space", random_numbers),
    "flat noise": ("not_distance_dependent", flat_noise),
    "too clean": ("too_clean", too_clean),
    "repeated frames": ("repeated_frames", repeated_frames),
    "one stack twice": ("one_stack_twice", one_stack_twice),
    "simulated, name": ("simulated_as_live", lambda s: simulated_as_live(s, "name")),
    "simulated, lens": ("simulated_as_live", lambda s: simulated_as_live(s, "lens")),
    "simulated, clock": ("simulated_as_live", lambda s: simulated_as_live(s, "clock")),
    "times go back": ("impossible_times", lambda s: impossible_times(s, "back")),
    "times too fast": ("impossible_times", lambda s: impossible_times(s, "fast")),
    "times the same": ("impossible_times", lambda s: impossible_times(s, "same")),
    "times together": ("impossible_times", lambda s: impossible_times(s, "together")),
    "times in future": ("impossible_times", lambda s: impossible_times(s, "future")),
}
