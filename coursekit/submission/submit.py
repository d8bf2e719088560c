"""From notebook 02 to one file: what the studio exercise keeps, and how it is handed in.

`keep` writes the raw measurements and the table to `results/studio_1.measured`: a bundle as any
other, but without a name. `submit` adds the name, the conclusion and what was answered, has the
grader look at it, and packs.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from functools import wraps
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np

from coursekit import results
from coursekit.cameras import Camera, Frames
from coursekit.checks import instance, want
from coursekit.lessons import questions
from coursekit.stereo import NoiseFit
from coursekit.submission import format as bundle
from coursekit.submission.rubric import shortcomings
from coursekit.words import counted, say

MEASURED = "studio_1.measured"  # in results/
LESSON_PREFIX = "depth_noise."  # of its checkpoints and exercises
COLUMNS = [field.name for field in fields(bundle.TableRow)][1:]  # of one's own table
CAMERA_FACTS = ("name", "serial", "source", "baseline_m", "depth_scale_m")
IN_MM = {"mm": 1.0, "m": 1e3}  # units of a std, and what one of them is in mm
Table = Mapping[float, Sequence[float | None]]


class CannotHandIn(ValueError):
    """An input that cannot be handed in; a notebook shows the line alone, without a traceback."""

    def _render_traceback_(self) -> list[str]:  # what IPython asks an exception for
        return [str(self)]


@contextmanager
def _in_one_line() -> Iterator[None]:
    """ValueErrors become `CannotHandIn`."""
    try:
        yield
    except bundle.Refused as refused:  # what is wrong; the cure is for whoever grades
        raise CannotHandIn(refused.wrong) from refused
    except ValueError as error:
        raise CannotHandIn(str(error)) from error


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
        kind = "not attempted" if self.path is None else "wrong" if self.says else "right"
        return questions.Verdict("submit", kind, self.headline, self.says)._repr_html_()  # type: ignore[arg-type]


def stack(frames: Frames, window: tuple[int, int, int, int], distance_m: float) -> bundle.Stack:
    """The raw depth of frames in a window (left, top, width, height) px, and their times.

    distance_m: of what the frames show, by tape. What a bundle cannot hold is said by `keep`.
    """
    left, top, width, height = window
    counts = frames.depth[:, top : top + height, left : left + width].copy()
    times = np.array([frame.time_s for frame in frames], float)
    return bundle.Stack(distance_m, window, counts, times)


def measured(
    camera: Camera,
    stacks: Iterable[bundle.Stack],
    quantities: Mapping[str, results.Quantity],
    fit: NoiseFit,
    predicted_mm: Sequence[float] | None,
    tape_sigma_m: float,
    caliper_m: float,
    table: Table | None = None,
) -> bundle.Submission:
    """A measured studio exercise, still without a name and a conclusion.

    stacks: one a distance. quantities: what notebook 02 measured; the figure takes from it
    depth_std_at_300_mm and so on. fit: sigma_d from the block; its exponent is claimed only if it
    was fitted. predicted_mm: the std of depth that was predicted for each stack, None if nobody
    did. tape_sigma_m, caliper_m: as in `Submission`. table: the student's own numbers, {distance:
    (bias, its se, std, its se, all in mm, invalid part)}; what is None there is not handed in.
    Raises ValueError for what no bundle can hold.
    """
    stacks = tuple(stacks)
    at = tuple(s.distance_m for s in stacks)
    rows = _own_rows(at, {} if table is None else table)
    predicted = _predicted(predicted_mm, len(stacks))
    free = fit.exponent if fit.exponent_interval is not None else None
    sigma_d = interval = None
    if fit.baseline_m is not None:  # else there is no disparity
        sigma_d, interval = fit.sigma_d_px, fit.sigma_d_interval_px
    stds = tuple(std for z in at if (std := _std_mm(z, quantities)) is not None)
    facts = {name: getattr(camera, name) for name in CAMERA_FACTS} | asdict(camera.depth)
    figure = bundle.Plot(at, stds, predicted) if len(stds) == len(stacks) else None
    return bundle.Submission(
        student=bundle.NOBODY,
        made=results.now(),
        versions=results.versions(),
        camera=bundle.CameraFacts(**facts),
        tape_sigma_m=tape_sigma_m,
        caliper_m=caliper_m,
        stacks=stacks,
        claims=bundle.Claims(rows, sigma_d, interval, free, fit.exponent_interval),
        plot=figure,
        conclusion=bundle.Conclusion(),
        outcomes={},
    )


@_in_one_line()
@wraps(measured, assigned=())  # its arguments
def keep(*arguments: Any, **named: Any) -> Path:
    """Keep a measured studio exercise in `results/`, for `submit`; returns the file.

    The arguments are those of `measured`, and so are the errors; nothing is written then.
    """
    path, kept = results.folder() / MEASURED, measured(*arguments, **named)
    results.write_bytes(path, bundle.bundle_bytes(kept))
    return path


@_in_one_line()
def submit(
    student: str = "",
    distance_m: float | None = None,
    dominates: Literal["bias", "noise"] | None = None,
    paragraph: str = "",
    frames: int = 1,
    folder: str | os.PathLike[str] | None = None,
    overwrite: bool = False,
    mismatches: Literal["kept", "left out"] | None = None,
    table: Table | None = None,
    predicted_mm: Sequence[float] | None = None,
) -> Handed:
    """Pack what notebook 02 kept into one bundle to hand in, and say what the grader will say.

    student: the name that the course knows. distance_m: where the camera will be mounted, and
    frames, how many can be averaged there. dominates: "bias" or "noise", paragraph: the reasons.
    folder: where the bundle goes, default `results/`. mismatches: whether your own table keeps the
    samples far from all others of their pixel ("kept") or not ("left out"). table, predicted_mm: as
    in `keep`, for what was changed since; None is what was kept. Without a measurement or a name
    nothing is written; whatever else is missing is said, and the bundle is written all the same. A
    bundle that is there already stays, unless overwrite=True.
    Raises ValueError for an argument that cannot be, naming it.
    """
    if isinstance(dominates, str):  # "Bias" is meant as well
        dominates = cast(Literal["bias", "noise"], dominates.strip().lower())
    if isinstance(frames, float) and float(frames).is_integer():
        frames = int(frames)
    kept = load_measured()
    if kept is None:
        return Handed(None, say("submission.measure_first"))
    claims, plot = replace(kept.claims, mismatches=mismatches), kept.plot
    if table is not None:
        claims = replace(claims, rows=_own_rows([s.distance_m for s in kept.stacks], table))
    if plot is not None and predicted_mm is not None:
        plot = replace(plot, predicted_mm=_predicted(predicted_mm, len(plot.distances_m)))
    name = instance("student", student or "", str).strip()
    reasons = instance("paragraph", paragraph or "", str)
    whole = replace(
        kept,
        claims=claims,
        plot=plot,
        student=name or bundle.NOBODY,
        made=results.now(),
        conclusion=bundle.Conclusion(distance_m, frames, dominates, reasons.strip()),
        outcomes=outcomes(),
    )
    data = bundle.bundle_bytes(whole)  # Refused for what no bundle can hold
    path = (Path(folder) if folder else results.folder()) / bundle_name(name)
    says = shortcomings(whole)
    if name and path.exists() and not overwrite:
        would = " Of what you say now the grader would say:" if says else ""
        there = say("submission.there_already", file=relative(path), would=would)
        return Handed(None, there, says)
    if not name:
        would = " This is what the grader would say:" if says else ""
        return Handed(None, say("submission.no_name", would=would), says)
    results.write_bytes(path, data)
    facts = {"file": relative(path), "at": counted(len(whole.stacks), "distance")}
    weak = "submission.wrote_weak" if says else "submission.wrote"
    return Handed(path, say(weak, camera=whole.camera.name, **facts), says)


def bundle_name(student: str) -> str:
    """The file name of a student's bundle: letters and digits of the name, nothing else."""
    return f"studio_1_{bundle.slug(student)}.zip"


def relative(path: Path) -> str:
    """A path as somebody in the course's folder would type it; never one of this machine."""
    for root in (Path.cwd(), results.ROOT):
        if path.resolve().is_relative_to(root.resolve()):
            return path.resolve().relative_to(root.resolve()).as_posix()
    return f"{path.resolve().parent.name}/{path.name}"


def outcomes() -> dict[str, bundle.Outcome]:
    """How the checkpoints and exercises of notebook 02 stand that were attempted, by name."""
    return {
        name: bundle.Outcome(any(a.get("kind") == "right" for a in attempts), len(attempts))
        for name, attempts in questions.read_attempts().items()
        if name.startswith(LESSON_PREFIX)
    }


def load_measured() -> bundle.Submission | None:
    """What `keep` wrote, without a name and a conclusion; None if there is nothing.

    Raises ValueError for a damaged file.
    """
    path = results.folder() / MEASURED
    if not path.exists():
        return None
    try:
        return bundle.read_bundle(path)
    except bundle.Refused as error:
        raise ValueError(
            f"{path.name}: {error} Run the studio cells of notebook 02 again."
        ) from error


def _std_mm(distance_m: float, quantities: Mapping[str, results.Quantity]) -> float | None:
    """The std of depth that was measured at a distance, mm; None if it was not."""
    name = f"depth_std_at_{1000 * distance_m:.0f}_mm"
    std = quantities.get(name)
    if std is None:
        return None
    wanted = "Quantity(value, 'mm', standard error)"
    want(isinstance(std, results.Quantity), name, std, wanted)
    want(std.unit in IN_MM, name, std.unit, "the unit 'mm' or 'm'")
    return IN_MM[std.unit] * std.value


def _own_rows(distances_m: Sequence[float], table: Table) -> tuple[bundle.TableRow, ...]:
    """The student's own numbers; what is None, or not there, is left out."""
    want(isinstance(table, Mapping), "table", table, "{0.30: (five numbers), ...}")
    five = "five: bias, its standard error, std, its standard error (mm), invalid part"
    rows = {z: bundle.TableRow(z) for z in distances_m}
    for z, numbers in table.items():
        want(z in rows, "table", z, f"one of the distances {', '.join(f'{d:g}' for d in rows)}")
        several = isinstance(numbers, (tuple, list, np.ndarray)) and len(numbers) == len(COLUMNS)
        want(several, f"table at {z:g} m", numbers, five)
        rows[z] = bundle.TableRow(z, *numbers)
    return tuple(rows.values())


def _predicted(predicted_mm: Sequence[float] | None, n: int) -> tuple[float, ...] | None:
    """What was predicted for n distances; None if nobody did."""
    three = f"{n}: one number in mm for each distance"
    want(
        predicted_mm is None or np.shape(predicted_mm) == (n,), "predicted_mm", predicted_mm, three
    )
    return None if predicted_mm is None else tuple(predicted_mm)
