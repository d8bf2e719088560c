"""Submissions to test the grader with: honest ones, weak ones, wrong ones, and made-up data.

The camera is synthetic and quick: disparity noise that correlates over a 9 px matching window, a
pattern that stays, a drift that all pixels share, holes, and depths rounded to counts. What is
claimed of its depths is computed here with NumPy where that is not the course's own estimate.
"""

import io
import zipfile
from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from typing import Any

import numpy as np
from common import EXPECTED
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from coursekit import specifications
from coursekit.submission import format as bundle
from coursekit.submission.flags import Fingerprint, data_flags, fingerprint
from coursekit.submission.format import CameraFacts, Outcome, Plot, Stack, Submission, TableRow
from coursekit.submission.recompute import AtDistance, Recomputed, recompute
from coursekit.submission.rubric import JUDGES, Grade, Item, judged

DISTANCES = (0.30, 0.45, 0.60)
MADE = "2026-03-02T10:00:00+00:00"
CLOCK_START_S = 1_772_440_000.0  # half an hour before MADE
MATCHING_PX = 9
PARAGRAPH = EXPECTED["paragraphs"]["honest"]
SIMULATED = {"source": "simulated", "name": "Simulated D435", "serial": "seed-7"}
OUTCOMES = {"depth_noise.twice_as_far": Outcome(True, 1), "depth_noise.width": Outcome(False, 2)}
Counts = NDArray[Any]
Random = np.random.Generator


def camera(seed: int = 0, **changes: Any) -> CameraFacts:
    """A real camera's facts; another unit for each seed."""
    random = np.random.default_rng((seed, 99))
    serial = f"{random.integers(10**11, 10**12)}"
    fx, cx, cy = (round(px + float(random.normal(0, 3)), 4) for px in (425, 424, 240))
    baseline_m = round(0.0500 + float(random.normal(0, 1e-4)), 7)
    lens = (848, 480, fx, 425.5, cx, cy, "brown_conrady", (0.0,) * 5)
    facts = CameraFacts("Intel RealSense D435", serial, "live", *lens, baseline_m, 0.001)
    return replace(facts, **changes)


def depths(random, facts, z, frames=100, size=40, sigma_d=0.065, holes=0.01, error=(-0.006, 0.1)):
    """Raw counts (frames, size, size) of a block's face at z metres; error: in scale, and in px."""
    wide, inner = size + 2 * MATCHING_PX, slice(MATCHING_PX, -MATCHING_PX)
    shape = (frames, wide, wide)
    noise = uniform_filter(random.standard_normal(shape, np.float32), (1, MATCHING_PX, MATCHING_PX))
    pattern = uniform_filter(random.standard_normal(shape[1:]), MATCHING_PX) * MATCHING_PX
    other_dots = uniform_filter(random.spawn(1)[0].standard_normal((size, size)), MATCHING_PX)
    uneven = np.exp(0.3 * MATCHING_PX * other_dots)  # as the dots are that a window sees
    noise = noise[:, inner, inner] * MATCHING_PX * sigma_d * uneven / np.sqrt((uneven**2).mean())
    pattern = pattern[inner, inner] * 1.1 * sigma_d
    drift = np.zeros(frames)
    for i, kick in enumerate(random.standard_normal(frames)):
        drift[i] = (0.989 * drift[i - 1] if i else 0.0) + 0.008 * 0.148 * kick
    v, u = np.indices((size, size)) - (size - 1) / 2
    plane = z * (1 + 2e-5 * u + 1e-5 * v)
    product = facts.fx * facts.baseline_m
    true = product / (plane * (1 + error[0])) + error[1]
    measured = product / (true + pattern + noise + drift[:, None, None])
    counts = np.rint(measured / facts.depth_scale_m)
    hole = uniform_filter(random.standard_normal((size, size)), 5) * 5
    often = hole > np.quantile(hole, 1 - 2 * holes) if holes else np.zeros((size, size), bool)
    counts[often & (random.random(counts.shape) < 0.5)] = 0
    return counts.astype(np.uint16)


def clock(random: Random, start_s: float, frames: int) -> NDArray[np.float64]:
    """Time stamps of a real camera at 30 frames a second: some jitter, and a dropped frame."""
    steps = 1 / 30 + random.normal(0, 2e-5, frames)
    if frames > 50:
        steps[frames // 3] *= 2
    return start_s + np.cumsum(steps)


def stacks_of(random: Random, make: Callable[[float], Counts], distances=DISTANCES):
    """The counts that `make` gives for each distance, measured one a minute."""
    stacks = []
    for i, z in enumerate(distances):
        counts = make(z).astype(np.uint16)
        n, height, width = counts.shape
        times = clock(random, CLOCK_START_S + 60 * i, n)
        stacks.append(Stack(z, (400, 220, width, height), counts, times))
    return tuple(stacks)


def claims_of(found: Recomputed) -> bundle.Claims:
    """What an honest student claims. Levels, stds and holes by NumPy; errors and fits by the kit.

    A level is the mean over the pixels' means, a std that of each pixel with the squares pooled.
    """
    rows = []
    for m in found.at:
        z = m.z_mm[:, np.isfinite(m.z_mm).all(axis=0)]
        bias = round(float(z.mean()) - 1e3 * m.distance_m, 2)
        std = round(float(np.sqrt(z.var(axis=0, ddof=1).mean())), 3)
        holes = round(float((m.stack.counts == 0).mean()), 3)
        rows.append(TableRow(m.distance_m, bias, m.bias_se_mm, std, m.std.se, holes))
    return bundle.Claims(tuple(rows), round(found.law.sigma_d_px, 3), found.law.sigma_d_interval_px)


def exact(submission: Submission) -> Submission:
    """With the recomputed values as claims, an exponent too: the middle of every tolerance."""
    found = recompute(submission)
    rows = tuple(
        TableRow(m.distance_m, m.bias.value, m.bias_se_mm, m.std.value, m.std.se, m.invalid.value)
        for m in found.at
    )
    sigma_d = found.law.sigma_d_px, found.law.sigma_d_interval_px
    exponent = found.free.exponent, found.free.exponent_interval
    return replace(submission, claims=bundle.Claims(rows, *sigma_d, *exponent))


def honest(seed: int = 0, frames: int = 100, of_camera=(), **changes: Any) -> Submission:
    """A submission that deserves full points; `changes` are fields to replace afterwards."""
    whole = _honest(seed, frames, tuple(sorted(dict(of_camera).items())))
    return replace(whole, **changes) if changes else whole


@cache
def _honest(seed: int, frames: int, of_camera: tuple[tuple[str, Any], ...]) -> Submission:
    random, facts = np.random.default_rng(seed), camera(seed, **dict(of_camera))
    error = float(random.normal(0, 0.006)), float(random.normal(0, 0.1))
    sigma_d = 0.065 * float(random.uniform(0.7, 1.4))

    def make(z: float) -> Counts:
        local = sigma_d * float(random.uniform(0.92, 1.08))
        holes, size = float(random.choice([0.0, 0.005, 0.02])), 33 if z == DISTANCES[2] else 40
        return depths(random, facts, z, frames, size, local, holes, error)

    return finished(facts, stacks_of(random, make), f"Student {seed}")


@cache
def graded(submission: Submission) -> Grade:
    """As `rubric.grade`, but what several submissions share is computed once."""
    found, prints = _measured(submission.stacks, submission.camera, submission.tape_sigma_m)
    prints = replace(prints, student=submission.student)
    flags = data_flags(submission, found, prints)
    return Grade(submission.student, judged(submission, found), flags, found, prints)


def items(submission: Submission, topic: str = "") -> list[Item]:
    """The graded items, of one topic or of all, without a look at the flags."""
    found, _ = _measured(submission.stacks, submission.camera, submission.tape_sigma_m)
    return [item for item in judged(submission, found) if topic in ("", item.topic)]


@cache
def _measured(stacks, camera, tape_sigma_m) -> tuple[Recomputed, Fingerprint]:
    whole = honest(stacks=stacks, camera=camera, tape_sigma_m=tape_sigma_m)
    return recompute(whole), fingerprint(whole)


def finished(facts: CameraFacts, stacks: tuple[Stack, ...], student: str) -> Submission:
    """Raw data with honest claims, an honest plot and the right conclusion."""
    empty = Submission(
        student=student,
        made=MADE,
        versions={"python": "3.12.3", "numpy": "2.3.5", "coursekit": "0.1.0"},
        camera=facts,
        tape_sigma_m=0.0 if facts.source == "simulated" else 0.001,
        caliper_m=0.06,
        stacks=stacks,
        claims=bundle.Claims(),
        plot=None,
        conclusion=bundle.Conclusion(),
        outcomes=OUTCOMES,
    )
    found = recompute(empty)
    claims = claims_of(found)
    at = tuple(row.distance_m for row in claims.rows)
    predicted = tuple(1e3 * float(std) for std in 1.07 * found.law.std_m(at)[0])
    plot = Plot(at, tuple(row.depth_std_mm for row in claims.rows), predicted)
    middle = found.at[len(found.at) // 2]
    dominates = "bias" if abs(middle.bias.value) > middle.noise_of_mean_mm(30) else "noise"
    conclusion = bundle.Conclusion(middle.distance_m, 30, dominates, PARAGRAPH)
    return replace(empty, claims=claims, plot=plot, conclusion=conclusion)


# --- weak and wrong -----------------------------------------------------------------------------


@cache
def weak(seed: int = 0) -> Submission:
    """84 frames at 0.60 m, nothing at 0.30 m, no plot, three words of a paragraph."""
    full = honest(seed)
    far = full.stacks[2]
    short = replace(far, counts=far.counts[:84], times_s=far.times_s[:84])
    two = replace(full, stacks=(full.stacks[1], short), plot=None)
    two = replace(two, claims=claims_of(recompute(two)))
    return replace(two, conclusion=replace(full.conclusion, paragraph="bias, I think"))


def with_row(submission: Submission, i: int, **changes: float | None) -> Submission:
    """The submission with fields of row i changed."""
    rows = list(submission.claims.rows)
    rows[i] = replace(rows[i], **changes)
    return with_part(submission, "claims", rows=tuple(rows))


def with_part(submission: Submission, part: str, **changes: Any) -> Submission:
    """The submission with fields of its camera, claims, plot or conclusion changed."""
    return replace(submission, **{part: replace(getattr(submission, part), **changes)})


def predicting(submission: Submission, factor: float) -> Submission:
    """The submission with a prediction that is so many times its own."""
    predicted = tuple(factor * mm for mm in submission.plot.predicted_mm)
    return with_part(submission, "plot", predicted_mm=predicted)


@cache
def mistaken(seed: int = 0) -> dict[str, tuple[str, Submission]]:
    """One wrong submission for each named mistake: {mistake: (item's topic, submission)}."""
    # Depths in tenths of a millimetre, a bias and holes: mistakes that would hide otherwise show.
    facts, random = camera(seed, depth_scale_m=1e-4), np.random.default_rng(seed)
    sigmas = dict(zip(DISTANCES, (0.060, 0.068, 0.064), strict=True))

    def make(z: float) -> Counts:
        return depths(random, facts, z, sigma_d=sigmas[z], holes=0.03, error=(-0.012, 0.2))

    good = finished(facts, stacks_of(random, make), f"Student {seed}")
    found = recompute(good)
    m, row, law, free = found.at[1], good.claims.rows[1], found.law, found.free
    product, sloppy = facts.fx * facts.baseline_m, reversed(SLOPPY_ROWS.values())
    # of a mistake in two columns the first
    numbers = {code: (topic, float(wrong(m, row))) for topic, code, wrong in sloppy if code}
    numbers |= {
        "metres": ("bias", row.depth_bias_mm / 1000),
        "counts": ("bias", row.depth_bias_mm / (1e3 * facts.depth_scale_m)),
        "tape_only": ("bias_se", 0.1),
        "no_tape": ("bias_se", m.bias.se),
        "close": ("std_se", 1.7 * row.depth_std_se_mm),
    }
    tapes = {"tape_only": 0.0001, "no_tape": 0}
    wrong = {}
    for code, (topic, value) in numbers.items():
        changed = good
        rows = range(3) if code == "tape_only" else [1]  # the others' errors hold the tape's, too
        for i in rows:
            changed = with_row(changed, i, **{JUDGES[topic][0]: value})
        wrong[code] = topic, replace(changed, tape_sigma_m=tapes.get(code, good.tape_sigma_m))
    coarse = honest(seed)
    near = recompute(coarse).at[0]
    each = near.z_mm[:, np.isfinite(near.z_mm).all(axis=0)].std(axis=0, ddof=1)
    unrounded, one_sigma = 1e3 * near.stats.pixel_std_unrounded_m, free.covariance[1, 1] ** 0.5
    by_z = float(np.mean([a.stats.pixel_std_m * product / a.distance_m for a in found.at]))

    counts = good.stacks[1].counts.copy()
    counts[::9, 20, 20] = 9000  # where all others are at 4500
    spiked = (good.stacks[0], replace(good.stacks[1], counts=counts), good.stacks[2])
    spiked = replace(good, stacks=spiked)
    pooled = float(np.sqrt(np.nanvar(recompute(spiked).at[1].z_mm, axis=0, ddof=1).mean()))

    claiming, not_widened = partial(with_part, good, "claims"), 1.96 * law.covariance[0, 0] ** 0.5
    ends = tuple(float(law.sigma_d_px * np.exp(k * not_widened)) for k in (-1, 1))
    wrong |= {
        code: (topic, _of_all(part, change)(good, found))
        for part, topic, code, change in SLOPPY_PARTS.values()
        if code
    }
    twice = {"exponent": 2 * free.exponent, "exponent_interval": (4 - one_sigma, 4 + one_sigma)}
    return wrong | {
        "unrounded": ("std", with_row(coarse, 0, depth_std_mm=unrounded)),
        "mismatches": ("std", with_row(spiked, 1, depth_std_mm=pooled)),
        "unpooled": ("std", with_row(coarse, 0, depth_std_mm=float(each.mean()))),
        "millimetres": ("sigma_d", claiming(sigma_d_px=1000 * law.sigma_d_px)),
        "not_squared": ("sigma_d", claiming(sigma_d_px=by_z)),
        "not_widened": ("sigma_d_interval", claiming(sigma_d_interval_px=ends)),
        "of_variance": ("exponent", claiming(**twice)),
        "off_scale": ("plot", predicting(good, 2.5)),
        "incomplete": ("verdict", with_part(good, "conclusion", distance_m=None)),
        "too_few": ("data", weak(seed)),
    }


# --- sloppy: one cause each -----------------------------------------------------------------------


def _raw(m: AtDistance) -> NDArray[np.float64]:
    """The raw depths (N, h, w) in mm, NaN where there is none."""
    return np.where(m.stack.counts > 0, 1e3 * m.scale_m * m.stack.counts, np.nan)


def _zeros(m: AtDistance) -> NDArray[np.float64]:
    """The same, 0 where there is none."""
    return np.nan_to_num(_raw(m))


def _middle(m: AtDistance) -> NDArray[np.float64]:
    """The depths of the pixel in the middle."""
    _, height, width = m.stack.counts.shape
    return _raw(m)[:, height // 2, width // 2]


def _pooled(variances: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.nanmean(variances)))


def _in_rows(topic: str, wrong: Callable[[AtDistance, TableRow], float]):
    """What makes the same mistake in one column of the table at every distance."""
    field = JUDGES[topic][0]

    def make(good: Submission, found: Recomputed) -> Submission:
        pairs = zip(found.at, good.claims.rows, strict=True)
        rows = tuple(replace(row, **{field: float(wrong(m, row))}) for m, row in pairs)
        return with_part(good, "claims", rows=rows)

    return make


def _of_all(part: str, wrong: Callable[[Submission, Recomputed], dict[str, Any]]):
    """What makes a mistake in the claims, the plot or the conclusion as a whole."""
    return lambda good, found: with_part(good, part, **wrong(good, found))


def _swapped(good: Submission, _: Recomputed) -> Submission:
    """The rows of 0.30 and 0.60 m mixed up."""
    near, middle, far = good.claims.rows
    near, far = replace(far, distance_m=0.30), replace(near, distance_m=0.60)
    return with_part(good, "claims", rows=(near, middle, far))


def _columns(good: Submission, _: Recomputed) -> Submission:
    """The columns of bias and std mixed up."""
    rows = tuple(
        replace(row, depth_bias_mm=row.depth_std_mm, depth_std_mm=abs(row.depth_bias_mm))
        for row in good.claims.rows
    )
    return with_part(good, "claims", rows=rows)


def _all_in_metres(good: Submission, _: Recomputed) -> Submission:
    lengths = ("depth_bias_mm", "depth_bias_se_mm", "depth_std_mm", "depth_std_se_mm")
    rows = tuple(
        replace(row, **{name: getattr(row, name) / 1e3 for name in lengths})
        for row in good.claims.rows
    )
    return with_part(good, "claims", rows=rows)


def _another_table(good: Submission, _: Recomputed) -> Submission:
    return replace(good, claims=honest(int(good.student.split()[1]) + 500).claims)


def _scaled_sigma_d(factor: float):
    def wrong(good: Submission, _: Recomputed) -> dict[str, Any]:
        low, high = good.claims.sigma_d_interval_px
        ends = factor * low, factor * high
        return {"sigma_d_px": factor * good.claims.sigma_d_px, "sigma_d_interval_px": ends}

    return _of_all("claims", wrong)


def _one_sigma(good: Submission, found: Recomputed) -> dict[str, Any]:
    law = found.law
    near, far = np.exp(np.array([-1, 1]) * law.covariance[0, 0] ** 0.5) * law.sigma_d_px
    return {"sigma_d_interval_px": (float(near), float(far))}


def _the_other(good: Submission, _: Recomputed) -> dict[str, Any]:
    return {"dominates": "bias" if good.conclusion.dominates == "noise" else "noise"}


def _plot_in_metres(good: Submission, _: Recomputed) -> dict[str, Any]:
    return {"measured_mm": tuple(v / 1e3 for v in good.plot.measured_mm)}


def _law_of_Z(good: Submission, _: Recomputed) -> dict[str, Any]:
    return {"predicted_mm": tuple(2 * z for z in good.plot.distances_m)}


SLOPPY_ROWS = {
    # how: the column, the reason that is the real one ("": none has a name), what stands there
    "sign": ("bias", "sign", lambda m, row: -row.depth_bias_mm),
    "depth for bias": ("bias", "level", lambda m, row: 1e3 * m.distance_m + row.depth_bias_mm),
    "zeros in bias": ("bias", "zeros", lambda m, row: _zeros(m).mean() - 1e3 * m.distance_m),
    "from the glass": ("bias", "", lambda m, row: row.depth_bias_mm + 4.2),
    "variance": ("std", "variance", lambda m, row: row.depth_std_mm**2),
    "zeros in std": ("std", "zeros", lambda m, row: _pooled(_zeros(m).var(axis=0, ddof=1))),
    "all samples": ("std", "mixed", lambda m, row: np.nanstd(_raw(m))),
    "over the pixels": ("std", "spatial", lambda m, row: 1e3 * m.stats.spatial_std_m),
    "of the mean": ("std", "of_the_mean", lambda m, row: np.nanmean(_raw(m), (1, 2)).std(ddof=1)),
    "over root N": ("std", "standard_error", lambda m, row: row.depth_std_mm / 10),
    "one pixel": ("std", "middle_pixel", lambda m, row: _middle(m).std(ddof=1)),
    "1.2 times": ("std", "", lambda m, row: 1.2 * row.depth_std_mm),
    "half": ("std", "", lambda m, row: 0.5 * row.depth_std_mm),
    "one digit": ("std", "rounded", lambda m, row: f"{row.depth_std_mm:.0e}"),
    "std for error": ("bias_se", "not_divided", lambda m, row: row.depth_std_mm),
    "N": ("bias_se", "independent", lambda m, row: row.depth_std_mm * _raw(m).size ** -0.5),
    "its own std": ("std_se", "not_divided", lambda m, row: row.depth_std_mm),
    "error of one pixel": ("std_se", "one_pixel", lambda m, row: row.depth_std_mm / 198**0.5),
    "percent": ("invalid", "percent", lambda m, row: 100 * row.invalid_fraction),
    "valid": ("invalid", "complement", lambda m, row: 1 - row.invalid_fraction),
    "ever": ("invalid", "ever", lambda m, row: (m.stack.counts == 0).any(axis=0).mean()),
}
SLOPPY_PARTS = {
    # how: the part, the topic, the reason, what of the part is another
    "no interval": ("claims", "sigma_d_interval", "", lambda *_: {"sigma_d_interval_px": None}),
    "one sigma": ("claims", "sigma_d_interval", "one_sigma", _one_sigma),
    "exponent alone": (
        "claims", "exponent", "no_interval", lambda _, found: {"exponent": found.free.exponent}
    ),
    "plot in metres": ("plot", "plot", "", _plot_in_metres),
    "law of Z": ("plot", "plot", "proportional", _law_of_Z),
    "no prediction": ("plot", "plot", "no_prediction", lambda *_: {"predicted_mm": None}),
    "copied": (
        "plot", "plot", "copied_prediction", lambda good, _: {"predicted_mm": good.plot.measured_mm}
    ),
    "the other": ("conclusion", "verdict", "other_dominates", _the_other),
    "centimetres": (
        "conclusion", "verdict", "not_measured_there", lambda *_: {"distance_m": 45.0}
    ),
    "three words": (
        "conclusion", "paragraph", "short", lambda *_: {"paragraph": "bias, I think"}
    ),
}  # fmt: skip
TABLE = {"bias", "bias_se", "std", "std_se", "invalid"}
LAW = {"sigma_d", "sigma_d_interval"}
NAIVE = _in_rows("std", lambda m, row: _pooled(np.nanvar(_raw(m), axis=0)))
SLOPPY: dict[str, tuple[set[str], str, Callable[[Submission, Recomputed], Submission]]] = {
    # how: the topics it may cost, the reason, the change
    "metres": (TABLE, "metres", _all_in_metres),
    "ddof 0": (set(), "", NAIVE),
    "rows": (TABLE, "", _swapped),
    "columns": ({"bias", "std"}, "", _columns),
    "another's table": (TABLE | LAW, "", _another_table),
    "baseline of a D455": (LAW, "", _scaled_sigma_d(1.9)),
    "mm and m": ({"sigma_d"}, "millimetres", _scaled_sigma_d(1e3)),
}
SLOPPY |= {
    how: ({topic}, code, _in_rows(topic, wrong))
    for how, (topic, code, wrong) in SLOPPY_ROWS.items()
}
SLOPPY |= {
    how: ({topic}, code, _of_all(part, wrong))
    for how, (part, topic, code, wrong) in SLOPPY_PARTS.items()
}


# --- copied and made up -------------------------------------------------------------------------


def _few_values(counts: Counts, random: Random) -> Counts:
    out = counts.copy()
    at = tuple(random.integers(0, size, 400) for size in counts.shape)
    out[at] += random.integers(1, 40, 400).astype(np.uint16)
    return out


COPIES: dict[str, Callable[[Counts, Random], Counts]] = {
    "identical": lambda counts, _: counts,
    "few_values": _few_values,
    "one_count": lambda counts, r: np.where(counts, counts + r.integers(-1, 2, counts.shape), 0),
    "reordered": lambda counts, r: r.permutation(counts),
    "subset": lambda counts, r: counts[
        np.sort(r.permutation(len(counts))[: len(counts) * 6 // 10])
    ],
    "mirrored": lambda counts, _: counts[:, :, ::-1],
    "half mirrored": lambda counts, _: np.where(
        np.arange(len(counts))[:, None, None] % 2, counts, counts[:, :, ::-1]
    ),
    "every other one, mirrored": lambda counts, _: counts[::2, :, ::-1],
    "turned": lambda counts, _: np.rot90(counts, 1, (1, 2)),
    "transposed": lambda counts, _: counts.transpose(0, 2, 1),
    "rolled": lambda counts, _: np.roll(counts, (7, 3), (1, 2)),
    "rescaled": lambda counts, _: np.rint(counts * 1.004),
    "constant_added": lambda counts, _: np.where(counts, counts + 3, 0),
}


@cache
def copied(original: Submission, how: str) -> Submission:
    """The raw depths of another submission, changed `how` (see COPIES), with honest claims."""
    random = np.random.default_rng(5)
    stacks = []
    for stack in original.stacks:
        counts = COPIES[how](stack.counts, random).astype(np.uint16)
        times = clock(random, float(stack.times_s[0]) + 7.0, len(counts))
        stacks.append(replace(stack, counts=counts, times_s=times))
    facts = camera(1005, depth_scale_m=original.camera.depth_scale_m)
    return finished(facts, tuple(stacks), "Copying Student")


@cache
def made_up(make: Callable[..., Counts], seed: int, **of_camera: Any) -> Submission:
    """Depths that nobody measured."""
    random, facts = np.random.default_rng(seed), camera(seed, **of_camera)
    return finished(facts, stacks_of(random, lambda z: make(random, facts, z)), "Inventive Student")


def _smooth(random: Random, frames: int = 100) -> NDArray[np.float32]:
    """Gaussian noise of std 1 that neighbours share as in a matching window."""
    shape = (frames, 40 + MATCHING_PX, 40 + MATCHING_PX)
    wide = uniform_filter(random.standard_normal(shape, np.float32), (0, MATCHING_PX, MATCHING_PX))
    return wide[:, :40, :40] * MATCHING_PX


def _disparities(random: Random, facts: CameraFacts, z: float) -> Counts:
    """Smoothed noise in disparity with a pattern that stays, rounded to 1/32 px."""
    pattern = _smooth(np.random.default_rng(round(1e6 * facts.fx)), 1)
    noise = 0.07 * pattern + 0.065 * _smooth(random)
    disparity = np.rint(32 * (facts.fx * facts.baseline_m / z + noise)) / 32
    return np.rint(1e3 * facts.fx * facts.baseline_m / disparity)


INVENTIONS: dict[str, Callable[[Random, CameraFacts, float], Counts]] = {  # with growing care
    "a pixel": lambda r, _, z: np.rint(1e3 * z + 3 * z**2 * r.normal(0, 1, (100, 40, 40))),
    "smoothed": lambda r, _, z: np.rint(1e3 * z + 0.7 * _smooth(r)),
    "grows": lambda r, _, z: np.rint(1e3 * z + 3 * z**2 * _smooth(r)),
    "disparity": _disparities,
}


def _flat(random: Random, facts: CameraFacts, z: float) -> Counts:
    """Camera-like noise of the same size at every distance."""
    return depths(random, facts, 0.45, holes=0.0).astype(int) + round(1e3 * (z - 0.45))


def _clean(random: Random, facts: CameraFacts, z: float) -> Counts:
    """A hundredth of a camera's noise, in fine counts."""
    return depths(random, facts, z, sigma_d=0.003)


def _repeated_frames(seed: int) -> Submission:
    """25 frames, four times each."""
    few = honest(seed, 25)
    stacks = tuple(
        Stack(s.distance_m, s.window, np.tile(s.counts, (4, 1, 1)), s.times_s[0] + even)
        for s in few.stacks
        for even in [np.arange(100) / 29.97]
    )
    return finished(few.camera, stacks, few.student)


def _one_stack_twice(seed: int) -> Submission:
    """0.60 m made out of 0.45 m, its noise scaled to the law."""
    good = honest(seed)
    near, middle, far = good.stacks
    mean = middle.counts.mean(axis=0)
    counts = np.rint(600 + (16 / 9) * (middle.counts - mean)) * (middle.counts > 0)
    far = Stack(0.60, middle.window, counts.astype(np.uint16), far.times_s)
    return finished(good.camera, (near, middle, far), good.student)


def simulated_as_live(changed: str, seed: int) -> Submission:
    """The simulated camera's "name", "lens" or "clock", with another word for its source."""
    good, lens = honest(seed), specifications.device("D435").unit.depth
    facts: dict[str, Any] = {
        "name": {"name": "Simulated D435", "serial": f"seed-{seed}"},
        "lens": {name: getattr(lens, name) for name in ("fx", "fy", "cx", "cy")},
        "clock": {},
    }
    stacks = good.stacks
    if changed == "clock":
        stacks = tuple(
            replace(s, times_s=(np.arange(len(s.times_s)) + 100 * i + 1) / 30)
            for i, s in enumerate(stacks)
        )
    return finished(replace(good.camera, **facts[changed]), stacks, good.student)


TIMES: dict[str, Callable[[Counts, Counts], Counts]] = {  # from those at 0.45 m and at 0.30 m
    "times go back": lambda times, _: times - (np.arange(len(times)) >= 50),
    "times too fast": lambda times, _: times[0] + (times - times[0]) / 30,
    "times the same": lambda times, others: others[: len(times)],
    "times together": lambda times, others: times + others[0] - times[0] + 0.01,
    "times in future": lambda times, _: times + 10 * 86_400,
}


def _impossible_times(how: str, seed: int) -> Submission:
    """With other times at 0.45 m; how: see TIMES."""
    good = honest(seed)
    near, middle, far = good.stacks
    middle = replace(middle, times_s=TIMES[how](middle.times_s, near.times_s))
    return replace(good, stacks=(near, middle, far))


# --- a class ------------------------------------------------------------------------------------


def class_names(n: int) -> list[str]:
    """So many names, with accents, apostrophes and other scripts among them."""
    first = ("Ada", "Zoë", "李", "Björn", "Mary Ann", "O'Neil")
    return [f"{first[i % 6]} Student{chr(97 + i // 26)}{chr(97 + i % 26)}" for i in range(n)]


def moodle(name: str, i: int, file: str) -> str:
    return f"{name}_{1000 + i}_assignsubmission_file_/{file}"


def canvas(name: str, i: int, file: str) -> str:
    *first, last = name.replace("'", "").split()
    late = "_LATE" * (i == 2)
    who, file = (last + "".join(first)).lower(), file.replace("/", "_")
    return f"{who}{late}_{1000 + i}_{70000 + i}_{file}"


def class_zip(whole: Submission, n: int, of: Callable[[str, int, str], str]) -> bytes:
    """What an LMS makes of what n students handed in; `of` names the files as it does.

    0 and 1 hand in nothing, 2 is late, 3 hands in twice, and then the measurement without a name, 4
    half of a download, 5 a bundle without an ending, 6 an unpacked one, 7 one zipped again, 8 an
    essay, 9 a bundle with the name of 10, packed in 2099; 11, 12 and 13 type their names in other
    ways; 14's is no bundle.
    """
    names, measured = class_names(n), with_part(whole, "conclusion", paragraph="")

    def data(name: str, made: str = MADE, one: Submission = whole) -> bytes:
        return bundle.bundle_bytes(replace(one, student=name, made=made))

    def parts(name: str) -> dict[str, bytes]:
        with zipfile.ZipFile(io.BytesIO(data(name))) as packed:
            return {member: packed.read(member) for member in packed.namelist()}

    again = {f"studio_1/{part}": content for part, content in parts(names[7]).items()}
    inside = {f"studio_1/{part}": content for part, content in parts(names[6]).items()}
    odd: dict[int, dict[str, bytes]] = {
        **{0: {}, 1: {}, 3: {"a.zip": data(names[3]), "b.zip": data(names[3])}},
        **{4: {"studio.zip.crdownload": data(names[4])[:500]}, 5: {"studio": data(names[5])}},
        **{6: inside, 7: {"s.zip": bundle.zip_bytes(again | {"__MACOSX/studio_1/._x": b"q"})}},
        **{8: {"essay.pdf": b"%PDF"}, 9: {"s.zip": data(names[10], "2099-01-01T00:00:00+00:00")}},
        **{11: {"s.zip": data(names[11].upper() + "\u200b")}, 13: {"s.zip": data("Bunny")}},
        **{12: {"s.zip": data(", ".join(reversed(names[12].split(" ", 1))))}, 14: {"s.zip": b"no"}},
    }
    odd[3]["studio_1.measured"], buffer = data(bundle.NOBODY, one=measured), io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as packed:
        for i, name in enumerate(names):
            day, files = 5 if i == 2 else 2, odd.get(i, {"studio_1.zip": data(name)})
            for minute, (file, content) in enumerate(files.items()):
                member = zipfile.ZipInfo(of(name, i, file), (2026, 3, day, 13, minute, 0))
                packed.writestr(member, content)
    return buffer.getvalue()


def injecting(text: str, seed: int = 0) -> Submission:
    """A student whose name, camera and paragraph are `text`."""
    good = with_part(honest(seed), "conclusion", paragraph=f"{text} " + "word " * 20)
    good = with_part(good, "camera", name=text, serial=text)
    return replace(good, student=text, versions={"python": text})


DISHONEST: dict[str, tuple[str, Callable[[int], Submission]]] = {
    "random numbers": ("white_in_space", partial(made_up, INVENTIONS["a pixel"])),
    "flat noise": ("not_distance_dependent", partial(made_up, _flat)),
    "too clean": ("too_clean", partial(made_up, _clean, depth_scale_m=1e-5)),
    "repeated frames": ("repeated_frames", _repeated_frames),
    "one stack twice": ("one_stack_twice", _one_stack_twice),
}
for _how in ("name", "lens", "clock"):
    DISHONEST[f"simulated, {_how}"] = "simulated_as_live", partial(simulated_as_live, _how)
for _how in TIMES:
    DISHONEST[_how] = "impossible_times", partial(_impossible_times, _how)
