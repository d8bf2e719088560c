"""What an instructor should look at: data that cannot be, and data or words that students share.

A flag takes no points. It says what was seen, and what else could explain it.
"""

from __future__ import annotations

import base64
import contextlib
import csv
import hashlib
import io
import json
import math
import re
import unicodedata
import zlib
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime
from functools import cache, partial
from itertools import combinations, permutations
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from coursekit import specifications
from coursekit.arrays import Floats, NDArray
from coursekit.checks import want
from coursekit.submission.format import CameraFacts, Stack, Submission
from coursekit.submission.recompute import HEADINGS, SEEN, Recomputed, grading_rules

_Key = TypeVar("_Key")
_Thing = TypeVar("_Thing")
LARGEST_WAVE = 6  # so many of them across a window; finer ones hold what was added
# Numbers in a spectrum: pairs of 0 to 6 waves down and across, in any order, but (0, 0).
N_WAVES = 27
FRAME_LIKENESS = 0.8  # of two frames' spectra; strangers' 8th best of 12: 0.74 in a small window
COMPARED, MOST_FRAMES = 150_000, 40_000  # pairs of stacks in all, and frames for each, at most
FRAMES_ASKED = 12  # frames of a stack that are looked for in others
FRAMES_FOUND = 9  # of these, for the stacks to be the same measurement
DIFFERENT = 5  # steps between values of a frame that is told by its values alone
STRANGERS, STANDS_OUT = 0.55, 0.3  # second look: a likeness worth it, and the lead (atanh) it asks
LEAST_FRAMES, LEAST_PIXELS, LEAST_COUNTS = 30, 100, 0.5  # to tell even noise from uneven
PERFECT_CLOCK_S = 1e-8  # no real clock keeps step so well
WORDS_IN_A_ROW = 3  # words in a row, by which paragraphs are compared
MOODLE = re.compile(
    r"(?:^|/)(?P<at>(?P<name>[^/]+?)_(?P<id>\d+)_assignsubmission_(?:file|onlinetext)_?)"
)
CANVAS = re.compile(  # but no date
    r"(?:^|/)(?P<name>[^/_]+)(?P<late>_LATE)?_(?!20\d\d_[01]\d_)(?P<id>\d{2,})_\d{2,}_[^/]+$"
)
NAME_COLUMNS, FIRST_AND_LAST, IDS = (HEADINGS[k] for k in ("names", "parts_of_names", "ids"))
UNDECOMPOSED = str.maketrans({"ł": "l", "ø": "o", "đ": "d", "ð": "d", "ħ": "h", "ŧ": "t", "ı": "i"})
UNDECOMPOSED |= str.maketrans({"æ": "ae", "œ": "oe", "þ": "th", "ŋ": "n"})  # ß: by casefold
SHARED_RUNS = 0.7  # part of the runs of the shorter of two paragraphs that the other one has too


@dataclass(frozen=True)
class Flag:
    """code: one word; says: a sentence, with the numbers. note: true where it is no suspicion.

    among: the files that share it.
    """

    code: str
    says: str
    note: bool = False
    among: str = ""


def flag_of(code: str, note: bool = False, **facts: Any) -> Flag:
    """The flag of this code; facts: what its sentence in words.toml has to be filled with."""
    return Flag(code, SEEN[code].format(**facts), note)


def data_flags(submission: Submission, found: Recomputed, prints: Fingerprint) -> tuple[Flag, ...]:
    """Flags of one submission, from its raw data alone; prints: its own `fingerprint`."""
    limits = grading_rules()["flags"]
    return (
        *_too_clean(submission.camera, found, limits),
        *_flat(found, limits),
        *_invented(found, limits),
        *_simulated(submission),
        *_times(submission, limits),
        *_one_stack_twice(prints.stacks),
    )


def _too_clean(camera: CameraFacts, found: Recomputed, limits: dict[str, float]) -> Iterator[Flag]:
    """Frames that repeat themselves, and noise that no stereo camera has.

    The noise is compared as a disparity, sigma_d = std fx B / Z^2 in px, without rounding.
    Where the baseline is not known, that of a D435 stands in.
    """
    several = [m for m in found.at if m.stats.n_frames > 1]
    for m in several:
        different, n = len({frame.tobytes() for frame in m.stack.counts}), m.stats.n_frames
        if different < n and not m.stats.frozen_fraction > 0.5:
            yield flag_of("repeated_frames", z=m.distance_m, different=different, n=n)
    product = camera.fx * (camera.baseline_m or 0.05)
    known = [m for m in several if m.std is not None]
    sigma_d = [m.stats.pixel_std_unrounded_m * product / m.distance_m**2 for m in known]
    if sigma_d and max(sigma_d) < limits["least_sigma_d_px"]:
        yield flag_of("too_clean", most=max(sigma_d), least=limits["least_sigma_d_px"])


def _flat(found: Recomputed, limits: dict[str, float]) -> Iterator[Flag]:
    """Noise that does not grow with distance; intervals without the widening for scatter."""
    free = found.free
    if free is None or free.exponent is None or free.n_distances < 2:
        return
    most = free.exponent + 2 * math.sqrt(free.covariance[1, 1])
    if most < limits["flat_exponent"]:
        yield flag_of("not_distance_dependent", exponent=free.exponent, most=most)


def _invented(found: Recomputed, limits: dict[str, float]) -> Iterator[Flag]:
    """Noise that lacks what matching windows of a real pattern of dots leaves in it.

    Neighbours share their window, so they share noise; the error of a place stays in every frame;
    each place sees other dots, so some are noisier than others; and at another distance the dots
    are others, and so is what stays. Stacks whose noise is rounded away, or of a few frames, are
    not looked at. FORMAT.md says how often invented and honest data are flagged.
    """
    looks = [
        (m.distance_m, look)
        for m in found.at
        if m.std is not None
        and m.std.value >= 0.35e3 * m.scale_m  # else rounded away
        and m.stats.n_frames >= 8
        and (look := _look(m.stack.counts)) is not None
    ]
    likeness = max((look.likeness for _, look in looks), default=math.inf)
    pattern = max((look.pattern for _, look in looks), default=math.inf)
    uneven = max((look.uneven for _, look in looks if look.uneven is not None), default=math.inf)
    if likeness < limits["white"]:
        yield flag_of("white_in_space", likeness=likeness)
    if pattern < limits["pattern"]:
        yield flag_of("no_pattern", times=pattern)
    if uneven < limits["uneven"]:
        yield flag_of("even_noise", part=uneven)
    for (one, first), (two, second) in combinations(looks, 2):
        likeness = _correlation(first.stays, second.stays)
        if likeness > limits["same_pattern"]:
            yield flag_of("same_pattern", one=one, two=two, likeness=likeness)


class _Look(NamedTuple):
    """What the noise of a stack is like.

    likeness: correlation of neighbours over time. pattern: what stays in the mean, in units of what
    averaging leaves of noise. uneven: by which part the stds of pixels differ beyond chance; None
    where frames or pixels are too few, or counts too coarse, to tell. stays
    (h, w): what stays in the mean, less a twisted plane, NaN where pixels are not always valid.
    """

    likeness: float
    pattern: float
    uneven: float | None
    stays: Floats


def _look(counts: NDArray[np.uint16]) -> _Look | None:
    """See `_Look`; None where too few pixels are valid."""
    n, height, width = counts.shape
    good = (counts > 0).all(axis=0)
    if good.sum() < 25 or height < 4 or width < 4:
        return None
    mean = counts.mean(axis=0)
    deviation = (counts - mean).astype(np.float32)
    typical = float(np.sqrt(np.square(deviation[:, good]).mean()))
    good &= np.abs(deviation).max(axis=0) <= 8 * max(typical, 1.0)
    if good.sum() < 25 or typical == 0:
        return None
    deviation *= good
    power = np.einsum("nij,nij->", deviation, deviation) / good.sum()
    rho = []
    for one, two, ok in (
        (deviation[:, :, :-1], deviation[:, :, 1:], good[:, :-1] & good[:, 1:]),
        (deviation[:, :-1], deviation[:, 1:], good[:-1] & good[1:]),
    ):
        if ok.any():
            rho.append(float(np.einsum("nij,nij->", one, two)) / int(ok.sum()) / float(power))
    inner = good.copy()  # a filter is uneven where a window ends
    for edge in (inner, inner.T):
        edge[: len(edge) // 5], edge[-(len(edge) // 5) - 1 :] = False, False
    uneven = None
    if n >= LEAST_FRAMES and typical >= LEAST_COUNTS and inner.sum() >= LEAST_PIXELS:
        apart = deviation[:, inner] - deviation[:, inner].mean(axis=1, keepdims=True)
        variances = np.maximum(apart.var(axis=0), 1e-6 * typical**2)
        beyond = float(np.log(variances).var()) - 2 / (n - 1)  # of a variance: twice that of a std
        uneven = math.sqrt(max(beyond, 0.0)) / 2
    rows, columns = np.nonzero(good)
    design = np.stack([np.ones(len(rows)), columns, rows, columns * rows], axis=-1)
    stays = np.full((height, width), np.nan)
    stays[good] = mean[good] - design @ np.linalg.lstsq(design, mean[good], rcond=None)[0]
    left = math.sqrt(float(power) / n / max(n - 1, 1))
    return _Look(max(rho, default=1.0), float(stays[good].std()) / left, uneven, stays)


def _correlation(one: Floats, two: Floats) -> float:
    """Correlation of two maps laid corner on corner or middle on middle; of these the larger."""
    shape = np.minimum(one.shape, two.shape)
    found = [0.0]
    for part in (0, 0.5):
        maps = []
        for values in (one, two):
            top, left = (part * (values.shape - shape)).astype(int)
            maps.append(values[top : top + shape[0], left : left + shape[1]])
        ok = np.isfinite(maps[0]) & np.isfinite(maps[1])
        a, b = (values[ok] - values[ok].mean() for values in maps) if ok.sum() > 25 else (0, 0)
        size = float(np.sqrt(np.vdot(a, a) * np.vdot(b, b)))
        found.append(float(np.vdot(a, b)) / size if size else 0.0)
    return max(found)


def _simulated(submission: Submission) -> Iterator[Flag]:
    """Data of the course's simulated camera that are declared as another one's."""
    camera, reasons = submission.camera, []
    words = f"{camera.name} {camera.serial}".lower()
    if "simul" in words or "seed-" in words:
        reasons.append(f"its name is {camera.name}, {camera.serial}")
    facts = (camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy)
    if any(np.allclose(facts, known, rtol=0, atol=5e-4) for known in _simulated_devices()):
        reasons.append("its intrinsics are those of the simulated camera to the last digit")
    if camera.source == "live" and any(_perfect_clock(s.times_s) for s in submission.stacks):
        reasons.append("its clock has no jitter")
    if reasons and camera.source != "simulated":
        yield flag_of("simulated_as_live", source=camera.source, reasons="; ".join(reasons))


@cache
def _simulated_devices() -> tuple[tuple[float, ...], ...]:
    """Width, height, fx, fy, cx and cy (px) of each camera that the course simulates."""
    lenses = [specifications.device(name).unit.depth for name in specifications.device_names()]
    return tuple((k.width, k.height, k.fx, k.fy, k.cx, k.cy) for k in lenses)


def _perfect_clock(times: Floats) -> bool:
    """Whether times (N,), s, are more even than a clock; not where doubles are too coarse."""
    if len(times) < 8 or np.spacing(np.abs(times).max()) > PERFECT_CLOCK_S / 4:
        return False
    even = times[0] + (times[-1] - times[0]) / (len(times) - 1) * np.arange(len(times))
    return bool(np.abs(times - even).max() < PERFECT_CLOCK_S)


def _times(submission: Submission, limits: dict[str, float]) -> Iterator[Flag]:
    """Time stamps that go back, that are too fast, or that cannot be together."""
    reasons = []
    for stack in submission.stacks:
        steps, where = np.diff(stack.times_s), f"at {stack.distance_m:.2f} m they"
        back = int((steps <= 0).sum())
        if back:
            reasons.append(f"{where} stand still or go back {back} times")
        elif steps.size and np.median(steps) < 1 / limits["fastest_hz"]:
            reasons.append(f"{where} say {1 / float(np.median(steps)):.3g} frames a second")
    reasons += _times_together(submission)
    if reasons:
        yield flag_of("impossible_times", reasons="; ".join(reasons))


def _times_together(submission: Submission) -> Iterator[str]:
    """What is wrong with the clocks of two distances side by side, or with the date."""
    stacks = [stack for stack in submission.stacks if len(stack.times_s) > 1]
    for i, one in enumerate(stacks):
        for two in stacks[:i]:
            both = f"{two.distance_m:.2f} and {one.distance_m:.2f} m"
            first, second = one.times_s, two.times_s
            epoch = min(first.min(), second.min()) > 1e9  # a clock that nothing sets back
            if np.array_equal(first, second):
                yield f"those of {both} are the same"
            elif epoch and first.min() <= second.max() and second.min() <= first.max():
                yield f"{both} were measured at the same time"
    made = datetime.fromisoformat(submission.made).timestamp()
    last = max((float(stack.times_s.max()) for stack in stacks), default=0.0)
    if 1e9 < last < 1e10 and last > made + 86_400:
        yield f"the last is {(last - made) / 86_400:.0f} days after the bundle was made"


def _one_stack_twice(prints: Sequence[StackPrint]) -> Iterator[Flag]:
    """Whether one distance was made out of another."""
    for i, one in enumerate(prints):
        for two in prints[:i]:
            alike = _shared(one, [two])[0][0] or _shared(two, [one])[0][0]
            if one.digest == two.digest or alike:
                yield flag_of("one_stack_twice", one=two.distance_m, two=one.distance_m)


# --- fingerprints, and who shares what ------------------------------------------------------


@dataclass(frozen=True, eq=False)
class StackPrint:
    """What is remembered of a stack: spectra of its noise, which do not change when all frames are
    mirrored, turned or rolled, or a constant is added.

    digest: of its bytes. level (27,): the mean spectrum. frames (N, 27): of each frame what
    is not in that, scaled to a largest value of 127. The order of frames does not matter.
    values: a hash of each frame's values, whatever place they are moved to, if they differ enough.
    """

    distance_m: float
    digest: str
    level: tuple[float, ...]
    frames: NDArray[np.int8]
    values: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class Fingerprint:
    """What is remembered of a bundle's raw data to tell whether another one shares it: some 15 kB.

    `as_json` and `from_dict` take it through JSON.
    """

    student: str
    source: str
    camera: str
    stacks: tuple[StackPrint, ...]

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Fingerprint:
        """The fingerprint whose JSON `as_json` made."""

        stacks = []
        for stack in data["stacks"]:
            frames = np.frombuffer(base64.b64decode(stack["frames"]), np.int8).reshape(-1, N_WAVES)
            stacks.append(StackPrint(**{**stack, "level": tuple(stack["level"]), "frames": frames}))
        return cls(**{**data, "stacks": tuple(stacks)})


def as_json(record: Any) -> str:
    """A fingerprint, or a record that has one, as JSON; an array becomes its bytes in base64."""

    def plain(value: Any) -> Any:
        array = isinstance(value, np.ndarray)
        return base64.b64encode(value.tobytes()).decode("ascii") if array else vars(value)

    return json.dumps(record, default=plain)


@dataclass(frozen=True)
class Copy:
    """Bundles that share raw data or words: their keys, in order, and a sentence about them.

    note: true where that is no suspicion, as with two simulations of one camera.
    """

    keys: tuple[str, ...]
    code: str  # "identical", "nearly_identical" or "same_words"
    says: str
    note: bool = False


def fingerprint(submission: Submission) -> Fingerprint:
    """See `Fingerprint`."""
    camera, stacks = submission.camera, tuple(map(_stack_print, submission.stacks))
    name = f"{camera.name}, {camera.serial}"
    return Fingerprint(submission.student, camera.source, name, stacks)


def _stack_print(stack: Stack) -> StackPrint:
    """What is remembered of a stack; see `StackPrint`. A window that is too small has no frames.

    Values far from a frame's median are clipped, so that a few changed ones do not stand out.
    """
    counts = np.ascontiguousarray(stack.counts)
    _, height, width = counts.shape
    digest = hashlib.blake2b(repr(counts.shape).encode() + counts.tobytes(), digest_size=16)
    ordered = np.sort(counts.reshape(len(counts), -1), axis=1)
    steps = np.count_nonzero(np.diff(ordered, axis=1), axis=1)  # few: strangers may have the same
    values = tuple(zlib.crc32(frame.tobytes()) for frame in ordered[steps >= DIFFERENT])
    named = partial(StackPrint, stack.distance_m, digest.hexdigest(), values=values)
    if min(height, width) <= 2 * LARGEST_WAVE:
        return named((), np.zeros((0, N_WAVES), np.int8))
    valid = counts > 0
    mean = counts.sum(axis=0) / np.maximum(valid.sum(axis=0), 1)
    off = (counts.astype(np.float32) - mean.astype(np.float32)) * valid
    most = np.maximum(6 * np.median(np.abs(off), axis=(1, 2), keepdims=True), 3)
    off = np.clip(off, -most, most)
    off = off - off.mean(axis=(1, 2), keepdims=True)
    waves = np.arange(LARGEST_WAVE + 1)  # only these of a Fourier transform are needed
    across, down = (
        np.exp(-2j * np.pi / n * np.outer(np.arange(n), waves)).astype(np.complex64)
        for n in (width, height)
    )
    rows = (off @ across).transpose(0, 2, 1)
    power = np.square(np.abs(rows @ down)) + np.square(np.abs(rows @ down.conj()))
    power = power + power.transpose(0, 2, 1)
    spectra = power[:, *(part[1:] for part in np.triu_indices(LARGEST_WAVE + 1))] ** 0.25
    level = spectra.mean(axis=0)
    rounded = tuple(round(float(value), 3) for value in level)
    return named(rounded, _bytes(spectra - level))


def _bytes(values: NDArray[Any]) -> NDArray[np.int8]:
    """Rows scaled so that the largest value of each is 127; rows of zeros stay."""
    largest = np.abs(values).max(axis=-1, keepdims=True)
    return np.rint(127 * values / np.where(largest > 1e-6, largest, np.inf)).astype(np.int8)


def _unit(values: NDArray[np.int8]) -> NDArray[np.float32]:
    """Rows of length 1; rows of zeros stay."""
    rows = values.astype(np.float32)
    length = np.sqrt(np.square(rows).sum(axis=-1, keepdims=True))
    return np.asarray(rows / np.where(length > 0, length, 1.0), np.float32)


def _shared(one: StackPrint, others: Sequence[StackPrint]) -> list[tuple[bool, bool]]:
    """Whether some frames of `one` are in each of the others, and whether exactly.

    Either most are found at once, or on average the nearest frame stands out from the next one, as
    it does under noise as large as the camera's, and never with a stranger.
    """
    sizes = [len(other.frames) for other in others]
    n = min([len(one.frames), *sizes])
    if n < FRAMES_FOUND or not others:
        return [(False, False)] * len(others)
    rows = np.linspace(0, len(one.frames) - 1, min(len(one.frames), FRAMES_ASKED)).round()
    ask = one.frames[rows.astype(int)]
    likeness = _unit(ask) @ _unit(np.concatenate([other.frames for other in others])).T
    ends = np.cumsum(sizes, dtype=np.intp)
    most = np.partition(np.maximum.reduceat(likeness, ends - sizes, axis=1), -FRAMES_FOUND, axis=0)
    found = []
    for end, other, ninth in zip(ends, others, most[-FRAMES_FOUND], strict=True):
        part = likeness[:, end - len(other.frames) : end]
        best = part.max(axis=1)
        hits = np.flatnonzero(best >= FRAME_LIKENESS)
        alike = bool(ninth >= FRAME_LIKENESS)
        if STRANGERS < ninth < FRAME_LIKENESS:
            two = np.arctanh(np.clip(np.partition(part, -2, axis=1)[:, -2:], 0, 0.99))
            alike = bool((two[:, 1] - two[:, 0]).mean() >= STANDS_OUT)
        same = len(hits) and (other.frames[part[hits].argmax(axis=1)] == ask[hits]).all()
        found.append((alike, alike and bool(same)))
    return found


def copies(prints: Mapping[str, Fingerprint], owners: Mapping[str, str] = {}) -> list[Copy]:
    """Bundles whose raw data are identical or nearly so, by their keys: one `Copy` a group.
    owners: see `Roster.owners`.

    Found whatever the order and number of the frames, mirrored, turned, transposed, rolled, with
    noise of a count or a constant added, rescaled, some values changed. In a large class a stack is
    compared with those of the nearest level, so that the work is bounded.
    """
    stacks = [(k, s) for k, p in prints.items() for s in p.stacks if len(s.frames) >= FRAMES_FOUND]
    levels = np.array([stack.level for _, stack in stacks]).reshape(len(stacks), N_WAVES)
    pairs: dict[tuple[str, str], dict[float, bool]] = {}
    first: dict[tuple[str, ...], str] = {}
    for key, fingerprint_of in prints.items():
        digests = tuple(sorted(stack.digest for stack in fingerprint_of.stacks))
        if digests and first.setdefault(digests, key) != key:
            pairs[first[digests], key] = {s.distance_m: True for s in fingerprint_of.stacks}
    alone = dict.fromkeys(first.values())
    for (one, other, z), n in _same_values({key: prints[key] for key in alone}).items():
        if n >= FRAMES_FOUND:
            pairs.setdefault((min(one, other), max(one, other)), {})[z] = False
    for i, (key, stack) in enumerate(stacks):
        if key not in alone:
            continue
        order = np.argsort(np.abs(levels - levels[i]).sum(axis=1))
        near = [stacks[j] for j in order if stacks[j][0] != key and stacks[j][0] in alone]
        near = near[: max(24, COMPARED // len(stacks))]
        frames = np.cumsum([len(its.frames) for _, its in near])
        near = near[: 1 + int(np.searchsorted(frames, MOST_FRAMES))]
        likes = _shared(stack, [s for _, s in near])
        for (other, _), (alike, exact) in zip(near, likes, strict=True):
            if alike:
                part = pairs.setdefault((min(key, other), max(key, other)), {})
                part[stack.distance_m] = exact or part.get(stack.distance_m, False)
    return [_copy(keys, pairs, prints, owners) for keys in _groups(list(prints), list(pairs))]


def _same_values(prints: Mapping[str, Fingerprint]) -> Counter[tuple[str, str, float]]:
    """How many frames with values of the first bundle that has them are in another one, and at
    which distance."""
    first: dict[int, str] = {}
    shared: Counter[tuple[str, str, float]] = Counter()
    for key, its in prints.items():
        for stack in its.stacks:
            for value in {*stack.values}:
                if first.setdefault(value, key) != key:
                    shared[first[value], key, stack.distance_m] += 1
    return shared


def grouped(pairs: Iterable[tuple[_Key, _Thing]]) -> dict[_Key, list[_Thing]]:
    """The things that have the same key, in order."""
    found: dict[_Key, list[_Thing]] = {}
    for key, thing in pairs:
        found.setdefault(key, []).append(thing)
    return found


def _groups(keys: Sequence[Any], pairs: Sequence[tuple[Any, Any]]) -> list[list[Any]]:
    """The keys that pairs connect, in groups of two or more."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    number = {key: i for i, key in enumerate(keys)}
    one, two = np.array([(number[a], number[b]) for a, b in pairs], int).reshape(-1, 2).T
    graph = coo_array((np.ones(len(one)), (one, two)), shape=(len(keys), len(keys)))
    labels = connected_components(graph, directed=False)[1].tolist()
    groups = grouped(zip(labels, keys, strict=True))
    return [group for group in groups.values() if len(group) > 1]


def _copy(
    keys: Sequence[str],
    pairs: Mapping[tuple[str, str], Mapping[float, bool]],
    prints: Mapping[str, Fingerprint],
    owners: Mapping[str, str],
) -> Copy:
    """What is said of a group: how much the same they are, and why that may be by right."""
    some = [prints[key] for key in keys]
    parts = [found for pair, part in pairs.items() if pair[0] in keys for found in part.items()]
    digests = {tuple(sorted(stack.digest for stack in one.stacks)) for one in some}
    exact = all(same for _, same in parts)
    many = f"{len(keys)} bundles have" if len(keys) > 2 else "Two bundles have"
    if len(digests) == 1:
        code, says = "identical", f"{many} the same raw depths, byte for byte"
    else:
        where = " and ".join(f"{z:.2f} m" for z in sorted({z for z, _ in parts}))
        says = f"{many} {'the same' if exact else 'nearly the same'} frames at {where}"
        code = "nearly_identical"
    innocent, note = "", False
    if len({person(one.student) for one in some}) == 1:
        innocent, note = ": they are of one student", True
    elif len({(one.source, one.camera) for one in some}) == 1:
        camera = some[0].camera
        innocent = f": all are {camera}"
        if exact and some[0].source == "simulated":
            note = camera.endswith(f"seed-{grading_rules()['flags']['common_seed']}")
            of = owners.get(camera.rpartition(", ")[2], SEEN["nobody"])
            innocent = SEEN["common_seed" if note else "one_seed"].format(camera=camera, of=of)
    return Copy(tuple(keys), code, f"{says}{innocent}.", note)


# --- who is who -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Place:
    """What the name of a file says that Moodle or Canvas made; all but `feedback` empty elsewhere.

    feedback: the name of a student's page in a zip that the same LMS takes back.
    """

    feedback: str
    lms: str = ""
    name: str = ""
    id: str = ""
    late: bool = False


def place_of(file: str) -> Place:
    """Whose a file is by its name.

    >>> place_of("Ada Lovelace_17_assignsubmission_file_/studio_1.zip")
    Place(feedback='Ada Lovelace_17_assignsubmission_file_/feedback.html', lms='Moodle', \
name='Ada Lovelace', id='17', late=False)
    >>> place_of("lovelaceada_LATE_1234_56789_studio_1.zip").feedback
    'lovelaceada_LATE_1234_56789_studio_1.html'
    >>> place_of("lovelace_2026_03_02.zip").lms
    ''
    """
    if found := MOODLE.search(file):
        within = "/" * file[found.end() :].startswith("/")
        return Place(f"{found['at']}{within}feedback.html", "Moodle", found["name"], found["id"])
    stem = file.rpartition("/")[2].rpartition(".")[0] or file.rpartition("/")[2]
    if found := CANVAS.search(file):
        return Place(f"{stem}.html", "Canvas", found["name"], found["id"], bool(found["late"]))
    return Place(f"{stem}.html")


def words_of(name: str) -> list[str]:
    """The words of a name; case, accents and signs without a width do not matter."""
    plain = unicodedata.normalize("NFKD", unicodedata.normalize("NFKD", name).casefold())
    plain = plain.translate(UNDECOMPOSED)
    kept = "".join(sign for sign in plain if unicodedata.category(sign) not in ("Mn", "Cf"))
    return re.findall(r"[^\W_]+", kept)


def spellings(name: str) -> set[str]:
    """A name as one word, beginning with any of its words: "Lovelace, Ada" is "Ada Lovelace"."""
    words = words_of(name)
    return {"".join(words[i:] + words[:i]) for i in range(len(words))}


def bare(number: str) -> str:
    """An id without the word that an LMS, or a report, puts before it: "Participant 17" is "17"."""
    return re.sub(r"^(participant|moodle|canvas) (?=\d+$)", "", number.casefold())


def person(name: str) -> str:
    """A name for telling whether two are one."""
    return min(spellings(name), default="")


@dataclass(frozen=True)
class Person:
    """Somebody of the class. key: one a person; row: what the roster says, by column."""

    key: str
    name: str
    row: Mapping[str, str] = field(default_factory=dict)


class Roster:
    """A class: the rows of a table, and whoever an LMS names besides.

    possible: what Canvas' gradebook says that each of its columns is worth.
    """

    def __init__(self, rows: Sequence[Mapping[str, str]] = ()) -> None:
        self.people: dict[str, Person] = {}
        self.possible: dict[str, str] = {}
        self._known: dict[str, set[str]] = {}
        for row in rows:
            cells = {column.strip().casefold(): value for column, value in row.items()}
            name = next((cells[c] for c in NAME_COLUMNS if cells.get(c)), "")
            name = name or " ".join(filter(None, (cells.get(c) for c in FIRST_AND_LAST)))
            ids = {column: cells[column] for column in IDS if cells.get(column)}
            if person(name) == "pointspossible":
                self.possible = {column.strip(): value for column, value in row.items()}
            if (person(name) in ("", "pointspossible") and not ids) or name == "Student, Test":
                continue  # an empty line, or the second one of Canvas, or its test student
            key = next(iter(ids.values()), person(name))
            want(key not in self.people, "roster", key, "every student once")
            clues = [*(f"#{column} {value}" for column, value in ids.items()), *ids.values()]
            self.add(Person(key, name or key, row), clues)

    def add(self, one: Person, clues: Sequence[str] = ()) -> None:
        """One more of the class, who is found by the name and these."""
        self.people[one.key] = one
        for clue in {*spellings(one.name), *map(str.casefold, clues), *map(bare, clues)}:
            self._known.setdefault(clue, set()).add(one.key)

    def find(self, *clues: str) -> Person | None:
        """Who it is by the first of these names or ids that is one person's."""
        for hits in map(self._hits, clues):
            if len(hits) == 1:
                return self.people[hits.pop()]
        return None

    def named(self, name: str, number: str) -> Person | None:
        """Who has a name; of several of that name the one with this number."""
        hits = self._hits(name)
        hits = hits & self._hits(bare(number)) if len(hits) > 1 else hits
        return self.people[hits.pop()] if len(hits) == 1 else None

    def _hits(self, clue: str) -> set[str]:
        """The keys of all whom a name or an id fits."""
        hits = (self._known.get(known, set()) for known in {clue.casefold(), *spellings(clue)})
        return set().union(*hits)

    def of_place(self, at: Place) -> Person:
        """Who hands in from a place of an LMS: of the roster, or new."""
        key = f"{at.lms} {at.id}"
        clue = f"#identifier participant {at.id}" if at.lms == "Moodle" else f"#id {at.id}"
        known = self.people.get(key) or self.find(clue) or self.named(at.name, at.id)
        if known is None or (known.key != key and not known.row):  # another of the same name
            known = Person(key, at.name)
            self.add(known, [key])
        return known

    def of_file(self, file: str, typed: str) -> Person:
        """Who handed in a file: by the LMS's name of it, by a folder's, then by what was typed."""
        at, folders = place_of(file), file.split("/")[:-1]
        if at.lms:
            return self.of_place(at)
        stem = at.feedback.removesuffix(".html").removeprefix("studio_1_").replace("_", " ")
        found = self.find(*folders, *([typed] if typed else [stem]))
        return found or Person(person(typed) or f"file {file}", typed)

    def other_name(self, one: Person, typed: str) -> Iterator[Flag]:
        """What to say where the name in a bundle is not that of who handed it in, or could be that
        of several."""
        keys = sorted(key for key in self._hits(one.name) if self.people[key].row)
        if len(keys) > 1 and not one.row:
            yield flag_of("namesakes", name=one.name, n=len(keys), ids="; ".join(keys))
        if not typed or spellings(typed) & spellings(one.name) or typed.strip() in one.row.values():
            return
        other = self.find(typed)
        if other is not None and other.key != one.key:
            yield flag_of("another_student", typed=typed, name=one.name)
        else:
            alike = bool({*words_of(typed)} & {*words_of(one.name)})
            yield flag_of("other_name", alike, typed=typed, name=one.name)

    def owners(self) -> dict[str, str]:
        """Whose a simulated camera is, by its serial."""
        has = grouped((unit, n.name) for n in self.people.values() for unit in units(n.name))
        return {unit: " or ".join(names[:3]) for unit, names in has.items()}


def units(name: str) -> set[str]:
    """The serials of the simulated cameras that a name gives, or some of its words in any order."""
    words = re.findall(r"[^\W_]+", name)[:5]
    some = ("".join(order) for n in range(len(words)) for order in permutations(words, n + 1))
    return {f"seed-{specifications.seed_of(one)}" for one in some}


def another_unit(camera: str, names: Sequence[str], owners: Mapping[str, str]) -> Iterator[Flag]:
    """What to say of a simulated camera that none of these names gives, nor no name.

    camera: as in a `Fingerprint`. owners: see `Roster.owners`.
    """
    unit = camera.rpartition(", ")[2]
    known = {f"seed-{grading_rules()['flags']['common_seed']}"}.union(*map(units, names))
    if names[0] and unit.startswith("seed-") and unit not in known:
        whose = owners.get(unit, SEEN["nobody"])
        yield flag_of("another_unit", unit=unit, name=names[0], whose=whose)


def class_table(path: Path) -> list[dict[str, str]]:
    """The rows of a table as a spreadsheet writes it: `,`, `;` or tabs; UTF-8, UTF-16 or Windows'.

    Raises ValueError for a file that is none.
    """
    data = path.read_bytes()
    codes = ["utf-16"] if data[:2] in (b"\xff\xfe", b"\xfe\xff") else ["utf-8-sig", "cp1252"]
    for code in codes:
        with contextlib.suppress(UnicodeDecodeError):
            text = data.decode(code)
            sign = max(",;\t", key=text.partition("\n")[0].count)
            try:
                rows = list(csv.DictReader(io.StringIO(text, newline=""), delimiter=sign))
            except csv.Error as error:
                raise ValueError(f"{path.name}: is no table ({error})") from None
            return [{k: (v or "").strip() for k, v in row.items() if k} for row in rows]
    raise ValueError(f"{path.name}: is no table of text; save it as CSV, UTF-8")


# --- who shares words -----------------------------------------------------------------------


def same_words(said: Mapping[str, tuple[str, str]]) -> list[Copy]:
    """Students whose paragraphs have the same or nearly the same words, a `Copy` for each group.

    said: student and paragraph of each bundle, by its key. Case and punctuation do not matter;
    paragraphs that are too short for the rubric are not compared.
    """
    least = grading_rules()["exercise"]["words"]
    texts_of = (
        (tuple(re.findall(r"\w+", unicodedata.normalize("NFKC", text).casefold())), key)
        for key, (_, text) in said.items()
    )
    who = grouped((words, key) for words, key in texts_of if len(words) >= least)
    copies = []
    for texts in _alike(list(who), least - WORDS_IN_A_ROW + 1):
        keys = tuple(key for text in texts for key in who[text])
        students = {person(said[key][0]) for key in keys}
        if len(students) > 1:
            kind = "the same" if len(texts) == 1 else "nearly the same"
            start = " ".join(said[keys[0]][1].split()[:10])
            says = f"The paragraphs of {len(students)} students have {kind} words: “{start} …”."
            copies.append(Copy(keys, "same_words", says))
    return copies


def _alike(texts: Sequence[tuple[str, ...]], least: int) -> list[list[tuple[str, ...]]]:
    """The texts in groups of those that share their runs of words; least: runs, for a part."""
    from scipy.sparse import coo_array, csr_array

    if not texts:
        return []
    number: dict[tuple[str, ...], int] = {}
    rows: list[int] = []
    columns: list[int] = []
    for i, words in enumerate(texts):
        runs = {words[j : j + WORDS_IN_A_ROW] for j in range(len(words) - WORDS_IN_A_ROW + 1)}
        rows += [i] * len(runs)
        columns += [number.setdefault(run, len(number)) for run in runs]
    ones = np.ones(len(rows), np.float32)
    has = csr_array((ones, (rows, columns)), shape=(len(texts), len(number)))
    several = np.flatnonzero(has.sum(axis=0) > 1)
    size = np.maximum(np.bincount(rows, minlength=len(texts)), least)
    shared = coo_array(has[:, several] @ has[:, several].T)
    near = shared.data >= SHARED_RUNS * np.minimum(size[shared.row], size[shared.col])
    one, two = shared.row[near], shared.col[near]
    groups = _groups(range(len(texts)), list(zip(one.tolist(), two.tolist(), strict=True)))
    single = {*range(len(texts))} - {i for group in groups for i in group}
    return [[texts[i] for i in group] for group in [*groups, *([i] for i in single)]]
