"""From notebook 02 to one file: what the studio exercise keeps, and how it is handed in.

`keep` writes the raw measurements and the table to `results/studio_1.measured`: a bundle as any
other, but without a name. `submit` adds the name, the conclusion and what was answered, has the
grader look at it, and packs.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import wraps
from pathlib import Path
from typing import TYPE_CHECKING, Any, ParamSpec, TypeVar, cast

import numpy as np

from coursekit import results
from coursekit.submission.contents import (
    CameraFacts,
    Cause,
    Claims,
    Conclusion,
    Outcome,
    Plot,
    Row,
    Stack,
    Submission,
    shown,
)

if TYPE_CHECKING:
    import os

    from coursekit.cameras import Camera, Frames
    from coursekit.stereo import NoiseFit

    Table = Mapping[float, Sequence[float | None]]

MEASURED = "studio_1.measured"  # in results/
CHECKPOINTS = "depth_noise."  # what the names of the lesson's checkpoints and exercises begin with
PARTS = ("depth_bias_mm", "depth_bias_se_mm", "depth_std_mm", "depth_std_se_mm", "invalid_fraction")
UNITS = {  # of a quantity that is handed in, and what one of it is in the table's own
    "depth_bias": {"mm": 1.0, "m": 1e3},
    "depth_std": {"mm": 1.0, "m": 1e3},
    "invalid": {"1": 1.0, "%": 0.01},
}
LONGEST_SLUG = 40  # characters of a name that go into the name of a file
NOBODY = "nobody"  # stands in for a name while there is none

MEASURE_FIRST = (
    "The studio exercise is not measured yet: run the studio cells of notebook 02 (with a camera, "
    "a set of recordings or the simulated one), up to the one that keeps the measurement."
)


class CannotHandIn(ValueError):
    """An input that cannot be handed in; a notebook shows the line alone, without a traceback."""

    def _render_traceback_(self) -> list[str]:  # what IPython asks an exception for
        return [str(self)]


P = ParamSpec("P")
T = TypeVar("T")


def _in_one_line(function: Callable[P, T]) -> Callable[P, T]:
    """The function, with its ValueErrors turned into `CannotHandIn`."""

    @wraps(function)
    def wrapped(*args: P.args, **kwargs: P.kwargs) -> T:
        try:
            return function(*args, **kwargs)
        except ValueError as error:
            raise CannotHandIn(str(error)) from error

    return wrapped


@dataclass(frozen=True, repr=False)
class Handed:
    """What became of a hand-in: the bundle, None if none was written, and what the grader says.

    says: what is missing or weak in the grader's own words; empty when nothing is.
    """

    path: Path | None
    headline: str
    says: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return "\n".join([self.headline, *(f"- {line}" for line in self.says)])

    def _repr_html_(self) -> str:
        from coursekit.lessons.progress import Verdict

        kind = "not attempted" if self.path is None else "wrong" if self.says else "right"
        return Verdict("submit", kind, self.headline, self.says)._repr_html_()  # type: ignore[arg-type]


def stack(frames: Frames, window: tuple[int, int, int, int], distance_m: float) -> Stack:
    """The raw depth of frames in a window (left, top, width, height) px, and their times.

    distance_m: of what the frames show, by tape. Raises ValueError as `Stack` does.
    """
    left, top, width, height = window
    counts = frames.depth[:, top : top + height, left : left + width]
    return Stack(distance_m, window, counts, np.array([frame.time_s for frame in frames], float))


@_in_one_line
def keep(
    camera: Camera,
    stacks: Iterable[Stack],
    quantities: Mapping[str, results.Quantity],
    fit: NoiseFit,
    predicted_mm: Sequence[float] | None,
    tape_sigma_m: float,
    caliper_m: float,
    table: Table | None = None,
) -> Path:
    """Keep a measured studio exercise in `results/`, for `submit`; returns the file.

    The arguments are those of `measured`, and so are the errors; nothing is written then.
    """
    from coursekit.submission.bundle import write_bundle

    kept = measured(camera, stacks, quantities, fit, predicted_mm, tape_sigma_m, caliper_m, table)
    return write_bundle(results.folder() / MEASURED, kept, overwrite=True)


def measured(
    camera: Camera,
    stacks: Iterable[Stack],
    quantities: Mapping[str, results.Quantity],
    fit: NoiseFit,
    predicted_mm: Sequence[float] | None,
    tape_sigma_m: float,
    caliper_m: float,
    table: Table | None = None,
) -> Submission:
    """A measured studio exercise, still without a name and a conclusion.

    stacks: one a distance. quantities: the student's table, by the names that notebook 02 gives
    (depth_bias_at_300_mm, depth_std_at_300_mm, invalid_at_300_mm, ...). fit: sigma_d from the
    block; its exponent is claimed only if it was fitted. predicted_mm: the std of depth that was
    predicted for each stack, None if nobody did. tape_sigma_m, caliper_m: as in `Submission`.
    table: the student's own numbers, {distance: (bias, its se, std, its se, all in mm, invalid
    part)}; each that is not None takes the place of the one in `quantities`.
    Raises ValueError for what no bundle can hold.
    """
    stacks = tuple(stacks)
    rows = _with_own(tuple(_row(s.distance_m, quantities) for s in stacks), table or {})
    if predicted_mm is not None and np.shape(predicted_mm) != (len(stacks),):
        raise ValueError(
            f"predicted_mm: got {np.size(predicted_mm)}, want {len(stacks)}: one number in mm for "
            "each distance"
        )
    free = fit.exponent if fit.exponent_interval is not None else None
    stds = [row.depth_std_mm for row in rows if row.depth_std_mm is not None]
    predicted = None if predicted_mm is None else tuple(predicted_mm)
    figure = None
    if len(stds) == len(stacks):
        figure = Plot(tuple(s.distance_m for s in stacks), tuple(stds), predicted)
    return Submission(
        student=NOBODY,
        made=results.now(),
        versions=results._versions(),
        camera=facts(camera),
        tape_sigma_m=tape_sigma_m,
        caliper_m=caliper_m,
        stacks=stacks,
        claims=Claims(rows, fit.sigma_d_px, fit.sigma_d_interval_px, free, fit.exponent_interval),
        plot=figure,
        conclusion=Conclusion(),
        outcomes={},
    )


def facts(camera: Camera) -> CameraFacts:
    """What the camera says about its depth stream."""
    K = camera.depth
    return CameraFacts(
        camera.name,
        camera.serial,
        camera.source,
        K.width,
        K.height,
        K.fx,
        K.fy,
        K.cx,
        K.cy,
        K.model,
        K.coeffs,
        camera.baseline_m,
        camera.depth_scale_m,
    )


@_in_one_line
def submit(
    student: str = "",
    distance_m: float | None = None,
    dominates: Cause | None = None,
    paragraph: str = "",
    frames: int = 1,
    folder: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
) -> Handed:
    """Pack what notebook 02 kept into one bundle to hand in, and say what the grader will say.

    student: the name that the course knows. distance_m: where the camera will be mounted, and
    frames, how many can be averaged there. dominates: "bias" or "noise", paragraph: the reasons.
    folder: where the bundle goes, default `results/`. Without a measurement or a name nothing is
    written; whatever else is missing is said, and the bundle is written all the same. A bundle that
    is there already stays, unless overwrite=True.
    Raises ValueError for an argument that cannot be, naming it.
    """
    if isinstance(dominates, str):  # "Bias" is meant as well
        dominates = cast("Cause", dominates.strip().lower())
    if isinstance(frames, float) and float(frames).is_integer():
        frames = int(frames)
    conclusion = Conclusion(distance_m, frames, dominates, (paragraph or "").strip())
    kept = load()
    if kept is None:
        return Handed(None, MEASURE_FIRST)
    name = (student or "").strip()
    whole = replace(
        kept,
        student=name or NOBODY,
        made=results.now(),
        conclusion=conclusion,
        outcomes=outcomes(),
    )
    return _checked(whole) if not name else _packed(whole, folder, overwrite)


def _checked(submission: Submission) -> Handed:
    from coursekit.submission.rubric import check

    headline = "Nothing is written yet: a bundle needs your name (`student`)."
    says = check(submission)
    return Handed(
        None, f"{headline} This is what the grader would say:" if says else headline, says
    )


def _packed(submission: Submission, folder: Any, overwrite: bool) -> Handed:
    from coursekit.submission.bundle import write_bundle
    from coursekit.submission.rubric import check

    path = (Path(folder) if folder else results.folder()) / bundle_name(submission.student)
    if path.exists() and not overwrite:
        there = f"{relative(path)} is there already and stays as it is."
        return Handed(None, f"{there} To replace it: `overwrite=True` (or --overwrite).")
    says = check(submission)
    write_bundle(path, submission, overwrite=overwrite)
    n = len(submission.stacks)
    measured_with = f"{n} distance{'s' * (n != 1)} with {submission.camera.name}"
    headline = f"Wrote {relative(path)}, {measured_with}: hand in this one file. "
    if says:
        headline += "What the grader will say is missing or weak:"
    else:
        headline += "The grader misses nothing in it."
    return Handed(path, headline, says)


def bundle_name(student: str) -> str:
    """The file name of a student's bundle: letters and digits of the name, nothing else."""
    return f"studio_1_{slug(student)}.zip"


def slug(text: str) -> str:
    """The letters and digits of a text with _ for what is between, for the name of a file."""
    kept = "".join(sign if sign.isalnum() else " " for sign in text)
    return "_".join(kept.split())[:LONGEST_SLUG].strip("_") or "unnamed"


def relative(path: Path) -> str:
    """A path as somebody in the course's folder would type it; never one of this machine."""
    for root in (Path.cwd(), results.ROOT):
        if path.resolve().is_relative_to(root.resolve()):
            return path.resolve().relative_to(root.resolve()).as_posix()
    return f"{path.resolve().parent.name}/{path.name}"


def outcomes() -> dict[str, Outcome]:
    """How the checkpoints and exercises of notebook 02 stand that were attempted, by name."""
    from coursekit.lessons import progress

    return {
        name: Outcome(any(a.get("kind") == "right" for a in attempts), len(attempts))
        for name, attempts in progress.read().items()
        if name.startswith(CHECKPOINTS)
    }


def load() -> Submission | None:
    """What `keep` wrote, without a name and a conclusion; None if there is nothing.

    Raises ValueError for a damaged file.
    """
    from coursekit.submission.reader import Refused, read_bundle

    path = results.folder() / MEASURED
    if not path.exists():
        return None
    try:
        return read_bundle(path)
    except Refused as error:
        raise ValueError(
            f"{path.name}: {error} Run the studio cells of notebook 02 again."
        ) from error


def _row(distance_m: float, quantities: Mapping[str, results.Quantity]) -> Row:
    """The line of the table at one distance; what was not measured is left out."""

    def found(name: str) -> tuple[float | None, float | None]:
        full = f"{name}_at_{1000 * distance_m:.0f}_mm"
        quantity = quantities.get(full)
        if quantity is None:
            return None, None
        if not isinstance(quantity, results.Quantity):
            got, unit = type(quantity).__name__, next(iter(UNITS[name]))
            raise ValueError(f"{full}: got a {got}, want Quantity(value, {unit!r}, standard error)")
        factor = UNITS[name].get(quantity.unit)
        if factor is None:
            raise ValueError(f"{full}: got the unit {quantity.unit!r}, want {_or(UNITS[name])}")
        sigma = None if quantity.sigma is None else factor * quantity.sigma
        return factor * quantity.value, sigma

    return Row(distance_m, *found("depth_bias"), *found("depth_std"), found("invalid")[0])


def _or(words: Iterable[str]) -> str:
    return " or ".join(repr(word) for word in words)


def _with_own(rows: tuple[Row, ...], table: Table) -> tuple[Row, ...]:
    """The rows with the student's own numbers in them, wherever these are not None."""
    if not isinstance(table, Mapping):
        raise ValueError(f"table: got {shown(table)}, want {{0.30: (five numbers), ...}}")
    at = [row.distance_m for row in rows]
    for z, numbers in table.items():
        if z not in at:
            measured_at = ", ".join(f"{distance:g}" for distance in at)
            raise ValueError(f"table: got the distance {shown(z)}, want one of {measured_at}")
        if not isinstance(numbers, (tuple, list, np.ndarray)) or len(numbers) != len(PARTS):
            raise ValueError(
                f"table at {z:g} m: got {shown(numbers)}, want five: bias, its standard error, "
                "std, its standard error (mm), invalid part"
            )
        own = {part: n for part, n in zip(PARTS, numbers, strict=True) if n is not None}
        i = at.index(z)
        rows = (*rows[:i], replace(rows[i], **own), *rows[i + 1 :])
    return rows
