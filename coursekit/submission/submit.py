"""From notebook 02 to one file: what the studio exercise keeps, and how it is handed in.

`keep` writes the raw measurements and the table to `results/studio_1.measured`: a bundle as any
other, but without a name. `submit` adds the name, the conclusion and what was answered, has the
grader look at it, and packs.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
)

if TYPE_CHECKING:
    import os

    from coursekit.cameras import Camera, Frames
    from coursekit.stereo import NoiseFit

MEASURED = "studio_1.measured"  # in results/
CHECKPOINTS = "depth_noise."  # what the names of the lesson's checkpoints and exercises begin with
LONGEST_SLUG = 40  # characters of a name that go into the name of a file
NOBODY = "nobody"  # stands in for a name while there is none

MEASURE_FIRST = (
    "The studio exercise is not measured yet: run the studio cells of notebook 02 (with a camera, "
    "a set of recordings or the simulated one), up to the one that keeps the measurement."
)


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
        from coursekit.lessons.verdict import Verdict

        kind = "not attempted" if self.path is None else "wrong" if self.says else "right"
        return Verdict("submit", kind, self.headline, self.says)._repr_html_()  # type: ignore[arg-type]


def stack(frames: Frames, window: tuple[int, int, int, int], distance_m: float) -> Stack:
    """The raw depth of frames in a window (left, top, width, height) px, and their times.

    distance_m: of what the frames show, by tape. Raises ValueError as `Stack` does.
    """
    left, top, width, height = window
    counts = frames.depth[:, top : top + height, left : left + width]
    return Stack(distance_m, window, counts, np.array([frame.time_s for frame in frames], float))


def keep(
    camera: Camera,
    stacks: Iterable[Stack],
    quantities: Mapping[str, results.Quantity],
    fit: NoiseFit,
    predicted_mm: Sequence[float],
    tape_sigma_m: float,
    caliper_m: float,
) -> Path:
    """Keep a measured studio exercise in `results/`, for `submit`; returns the file.

    The arguments are those of `measured`, and so are the errors; nothing is written then.
    """
    from coursekit.submission.bundle import write_bundle

    kept = measured(camera, stacks, quantities, fit, predicted_mm, tape_sigma_m, caliper_m)
    return write_bundle(results.folder() / MEASURED, kept, overwrite=True)


def measured(
    camera: Camera,
    stacks: Iterable[Stack],
    quantities: Mapping[str, results.Quantity],
    fit: NoiseFit,
    predicted_mm: Sequence[float],
    tape_sigma_m: float,
    caliper_m: float,
) -> Submission:
    """A measured studio exercise, still without a name and a conclusion.

    stacks: one a distance. quantities: the student's table, by the names that notebook 02 gives
    (depth_bias_at_300_mm, depth_std_at_300_mm, invalid_at_300_mm, ...). fit: sigma_d from the
    block; its exponent is claimed only if it was fitted. predicted_mm: the std of depth that was
    predicted for each stack. tape_sigma_m, caliper_m: as in `Submission`.
    Raises ValueError for what no bundle can hold.
    """
    stacks = tuple(stacks)
    rows = tuple(_row(s.distance_m, quantities) for s in stacks)
    free = fit.exponent if fit.exponent_interval is not None else None
    stds = [row.depth_std_mm for row in rows if row.depth_std_mm is not None]
    figure = None
    if len(stds) == len(stacks):
        figure = Plot(tuple(s.distance_m for s in stacks), tuple(stds), tuple(predicted_mm))
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
        quantity = quantities.get(f"{name}_at_{1000 * distance_m:.0f}_mm")
        return (quantity.value, quantity.sigma) if quantity else (None, None)

    return Row(distance_m, *found("depth_bias"), *found("depth_std"), found("invalid")[0])
