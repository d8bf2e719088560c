"""What people read: a page for each student, two for the instructor, and a table for a spreadsheet.

Everything that came with a bundle is escaped by the template, report.html.jinja; pages hold their
style (report.css) and figures, load nothing and run nothing. Flags are on the instructor's page
only: they are questions. The figures are SVG that the template draws from the numbers made here; a
plotting library would take longer than grading.
"""

from __future__ import annotations

import csv
import hashlib
import io
import math
import re
import statistics
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
import scipy.optimize  # noqa: F401 - `stereo` would load it while it grades the first bundle
from markupsafe import Markup

from coursekit.arrays import Interval
from coursekit.stereo import rounded_variance
from coursekit.submission.flags import (
    Copy,
    Fingerprint,
    Flag,
    Person,
    Roster,
    another_unit,
    copies,
    flag_of,
    grouped,
    person,
    place_of,
    same_words,
    words_of,
)
from coursekit.submission.format import WORDS, Plot, Refused, Submission, TableRow, read_bundle
from coursekit.submission.recompute import (
    HEADINGS,
    LABELS,
    MISTAKES,
    REPEAT,
    SAYS,
    Recomputed,
    grading_rules,
)
from coursekit.submission.rubric import Grade, Item, grade
from coursekit.words import counted

HEADER = (*HEADINGS["first"], *LABELS, *HEADINGS["last"])  # of grades.csv
FAILED = ("timeout", "died", "memory", "error", "lost")  # reasons; tried anew by the next run
NOTHING, GONE = WORDS["failed"]["missing"], WORDS["failed"]["gone"]
CODE = re.compile("p[0-9a-f]{6}")  # see `ReportLine.code`
MOODLE_COLUMNS, CANVAS_COLUMNS, OWN_COLUMNS = (HEADINGS[k] for k in ("moodle", "canvas", "own"))
FORMULA = tuple("=+-@\t\r\n＝＋－＠")  # what makes a spreadsheet calculate a cell
HERE = Path(__file__).parent

# Of a figure, in units of its view (a phone shows it at three quarters of that), and its margins.
PLOT = {"W": 480, "H": 320, "LEFT": 52, "RIGHT": 14, "TOP": 14, "BOTTOM": 46}
LARGEST_MM = 1e6  # beyond this nothing is drawn


def _page(**values: Any) -> str:
    """One page; values: what the template shows, with `what` for the kind of page."""
    return TEMPLATE.render(**values).lstrip()


@dataclass(frozen=True)
class ReportLine:
    """One bundle in the class: graded, or not and why.

    file: the bundle's name. student: the name in it. made, paragraph: as handed in. page: the link
    to its page. reason, says: of a bundle that was not graded. handed_in: when, as the LMS says.
    Of `across`: counts, False where another one of the student does; late: when and by how much;
    who, name, row: the person and what the roster says; own: the instructor's points and comment.
    `as_json` and `from_dict` take it through JSON.
    """

    file: str
    student: str = ""
    made: str = ""
    paragraph: str = ""
    points: float | None = None
    of: float | None = None
    items: tuple[Item, ...] = ()
    flags: tuple[Flag, ...] = ()
    page: str = ""
    reason: str = ""
    says: str = ""
    counts: bool = True
    fingerprint: Fingerprint | None = None
    handed_in: str = ""
    late: str = ""
    who: str = ""
    name: str = ""
    row: Mapping[str, str] = field(default_factory=dict)
    own: Mapping[str, str] = field(default_factory=dict)

    @property
    def total(self) -> float | None:
        """The points with the instructor's own: for the paragraph, for late days, in all; >= 0."""
        if self.own.get("overrule"):
            return number_of(self.own["overrule"])
        if self.points is None:
            return None
        own = self.own.get("paragraph")
        more = number_of(own) - self.computed_paragraph if own else 0.0
        return round(max(self.points + more + number_of(self.own.get("late", "")), 0.0), 2)

    @property
    def computed_paragraph(self) -> float:
        """The points that the program gave for the paragraph."""
        return sum(item.points for item in self.items if item.topic == "paragraph")

    @property
    def judged(self) -> tuple[Item, ...]:
        """The items, with the instructor's points for the paragraph in place of the program's."""
        own = self.own.get("paragraph")
        if not own:
            return self.items
        read = partial(replace, points=number_of(own), says=SAYS["read"])
        return tuple(read(item) if item.topic == "paragraph" else item for item in self.items)

    @property
    def code(self) -> str:
        """What stands for the name on the pages of a second marker; to no spreadsheet a number."""
        return "p" + hashlib.sha256(f"{self.who}\0{self.file}".encode()).hexdigest()[:6]

    @property
    def depths(self) -> tuple[str, ...]:
        """What is the same for the same raw depths; () for none."""
        prints = self.fingerprint
        return tuple(sorted(stack.digest for stack in prints.stacks)) if prints else ()

    @property
    def measured(self) -> bool:
        """Whether it is what `submit.keep` wrote, and no bundle to hand in."""
        return self.points is not None and not self.student

    @property
    def percent(self) -> float | None:
        """Points of what could be had."""
        if self.points is None:
            return None
        return 100 * self.points / self.of if self.of else 0.0

    @property
    def flagged(self) -> bool:
        """Whether something is to be looked at."""
        return any(not flag.note for flag in self.flags)

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> ReportLine:
        """The line whose JSON `as_json` made."""
        prints = data["fingerprint"] and Fingerprint.from_dict(data["fingerprint"])
        items = tuple(Item(**item) for item in data["items"])
        flags = tuple(Flag(**flag) for flag in data["flags"])
        return cls(**{**data, "items": items, "flags": flags, "fingerprint": prints})


def number_of(text: str) -> float:
    """Points as somebody writes them, "2.5" or "2,5"; nothing is 0. Raises ValueError."""
    return float(text.replace(",", ".").strip() or 0.0)


def graded(file: str, grade: Grade, submission: Submission) -> ReportLine:
    """The line of a graded bundle; of its items what the class page and the table say."""
    told = ("verdict", "paragraph")
    items = tuple(replace(i, says=i.says * (i.topic in told), tolerance=None) for i in grade.items)
    return ReportLine(
        file=file,
        student=grade.student,
        made=submission.made,
        paragraph=submission.conclusion.paragraph,
        points=grade.points,
        of=grade.of,
        items=items,
        flags=grade.flags,
        fingerprint=grade.fingerprint,
    )


def not_graded(file: str, reason: str, says: str = "", **facts: Any) -> ReportLine:
    """The line of a bundle that was refused, or whose grading failed; says: else what words.toml
    says of the reason, with the facts in it."""
    says = says or WORDS["failed"][reason].format(**facts)
    return ReportLine(file, reason=reason, says=says)


def grade_file(path: str, name: str) -> tuple[ReportLine, str]:
    """What a process of the grader does: the line of a bundle, and what `page_body` says of it.

    name: what to call the file at `path`. Importing this module loads all that grading needs, so
    that nothing is loaded on first use, when memory is limited.
    """
    try:
        submission = read_bundle(Path(path))
        found = grade(submission)
        return graded(name, found, submission), page_body(found, submission)
    except Refused as refused:
        return not_graded(name, refused.reason, str(refused)), ""
    except MemoryError:
        return not_graded(name, "memory"), ""


def across(
    lines: Sequence[ReportLine],
    roster: Roster | None = None,
    late_after: datetime | None = None,
    own: Sequence[dict[str, str]] = (),
) -> list[ReportLine]:
    """The lines with what only the class shows: who each is of and which of theirs counts, shared
    data and words, and a line for each of the roster who handed in nothing.

    own: rows of the instructor's points. Without fingerprints, which are of no more use.
    """
    roster = roster or Roster()
    for line in lines:  # first, so that a typed name can be known as somebody else's
        if (at := place_of(line.file)).lms:
            roster.of_place(at)
    who = {line.file: roster.of_file(line.file, line.student) for line in lines}
    owner = {n.depths: who[n.file] for n in reversed(lines) if n.student and n.depths}
    who |= {n.file: owner[n.depths] for n in lines if n.depths in owner and not who[n.file].name}
    there = {one.key: one for one in who.values()}
    enrolled = Counter(person(one.name) for one in roster.people.values() if one.row)
    handed = Counter(person(one.name) for one in there.values())
    for one in there.values():
        roster.add(one)
    owners = roster.owners()
    codes = {replace(line, who=who[line.file].key).code: who[line.file] for line in lines}
    rows = _own_rows(own, roster, codes)
    theirs = grouped((who[line.file].key, line) for line in lines)
    chosen = {key: _that_counts(some) for key, some in theirs.items()}
    done = [line for line in lines if line.points is not None]
    prints = {
        line.file: replace(line.fingerprint, student=who[line.file].key)
        for line in done
        if line.fingerprint and not (line.measured and chosen[who[line.file].key][0] is not line)
    }
    said = {line.file: (who[line.file].key, line.paragraph) for line in done}
    shared = [*copies(prints, owners), *same_words(said), *_one_file(done, who)]
    about = grouped(
        (key, Flag(copy.code, copy.says, copy.note, "; ".join(copy.keys)))
        for copy in shared
        for key in copy.keys
    )
    found = []
    for line in lines:
        one = who[line.file]
        last, more = chosen[one.key]
        flags = [*line.flags, *about.get(line.file, ()), *more, *_clock(line)]
        flags += roster.other_name(one, line.student)
        if line.fingerprint is not None:
            flags += another_unit(line.fingerprint.camera, (one.name, line.student), owners)
        if line.measured:
            code = "only_a_measurement" if last is line else "unpacked_measurement"
            flags.append(flag_of(code, last is not line, file=last.file))
        elif last is not line and line.points is not None:
            facts = {"student": last.student, "file": last.file}
            facts |= {"points": _points(line.points), "better": _points(last.points)}
            flags.append(flag_of("earlier_bundle", note=True, **facts))
        own_line = replace(_of(line, one, rows), flags=tuple(flags), fingerprint=None)
        found.append(replace(own_line, counts=last is line, late=_late(line, late_after)))
    nothing = not_graded("", "missing")
    absent = (one for one in roster.people.values() if one.key not in there)
    missing = [n for n in absent if handed[person(n.name)] < enrolled[person(n.name)]]
    return [*found, *(_of(nothing, one, rows) for one in missing)]


def _of(line: ReportLine, one: Person, rows: Mapping[str, Mapping[str, str]]) -> ReportLine:
    """The line with whose it is."""
    return replace(line, who=one.key, name=one.name, row=one.row, own=rows.get(one.key, {}))


def _own_rows(
    own: Sequence[dict[str, str]], roster: Roster, codes: Mapping[str, Person]
) -> dict[str, dict[str, str]]:
    """The instructor's rows by person: by `who`; a second marker's by `code`; of an older roster's
    by name and number, where these are one person's. Of two rows the first one counts, and takes
    from the other what it leaves empty."""
    found: dict[str, dict[str, str]] = {}
    for row in sorted(own, key=lambda row: row["who"] not in roster.people):
        one = roster.people.get(row["who"]) or codes.get(row.get("code", ""))
        one = one or roster.named(row["student"], row["who"])
        if one is None or found.setdefault(one.key, row) is row:
            continue
        kept, row["student"], row["who"] = found[one.key], one.name, "another row of theirs counts"
        for column in OWN_COLUMNS[3:]:
            if not kept.get(column) or kept[column] == row.get(column):
                kept[column] = row.pop(column, "")
    return found


def _that_counts(some: Sequence[ReportLine]) -> tuple[ReportLine, tuple[Flag, ...]]:
    """Which of a student's bundles counts, and what to say about it.

    The newest, or the first of those; but if no LMS says that they are of one student, never one
    that takes points away from another. What is graded before what is not, and bundles before a
    measurement.
    """
    some = [line for line in some if line.points is not None] or some
    some = [line for line in some if not line.measured] or some
    newest = max(some, key=_moment)
    if len(some) == 1 or place_of(newest.file).lms:
        return newest, ()
    best = max(some, key=lambda line: (line.points or 0.0, _moment(line)))
    folders = {line.file.rpartition("/")[0] for line in some}
    if best is newest and len(folders) == 1:
        return best, ()
    each = ", ".join(
        f"{line.file} ({_points(line.points)} points, packed {_date(line.made)})"
        for line in some[:6]
    )
    return best, (flag_of("same_name", typed=best.student, bundles=each),)


def _clock(line: ReportLine) -> Iterator[Flag]:
    """Whether a bundle was packed later than it can have been."""
    now = datetime.now(UTC).isoformat(timespec="seconds")
    for what, moment in (("was handed in", line.handed_in), ("was graded", now)):
        if line.made and moment and _seconds(line.made) > _seconds(moment) + 86_400:
            after = f"it {what} ({_date(moment)})"
            yield flag_of("wrong_clock", made=_date(line.made), after=after)
            return


def _seconds(moment: str) -> float:
    """s since 1970; a moment without a zone is of here."""
    return datetime.fromisoformat(moment).timestamp()


def _moment(line: ReportLine) -> float:
    """When a bundle was handed in, or else made, s since 1970; 0 for one that does not say."""
    return _seconds(line.handed_in or line.made) if line.handed_in or line.made else 0.0


def _late(line: ReportLine, late_after: datetime | None) -> str:
    """When a bundle that is late was handed in, and how late that is; "" for one that is not."""
    when = line.handed_in or line.made
    over = _moment(line) - late_after.timestamp() if late_after is not None else 0.0
    if over > 0:
        hours, minutes = divmod(math.ceil(over / 60), 60)
        much = f"{hours} h {minutes} min"
        if hours >= 24:
            much = f"{counted(hours // 24, 'day')} {hours % 24} h"
        return f"{_date(when)}: {much} late"
    return f"{_date(when)}: late, as Canvas says" if place_of(line.file).late else ""


def _date(moment: str) -> str:
    """ "2 March 2026, 10:00 UTC"; of here where no zone is said."""
    if not moment:
        return "at an unknown time"
    then = datetime.fromisoformat(moment)
    return f"{then.day} {then:%B %Y, %H:%M} {then.tzname() or ''}".strip()


def _one_file(done: Sequence[ReportLine], who: Mapping[str, Person]) -> Iterator[Copy]:
    """Files that several people handed in: one name, one second of packing, the same depths."""
    packed = grouped(
        ((line.student, line.made, line.depths), line.file) for line in done if line.fingerprint
    )
    for (typed, made, _), files in packed.items():
        n = len({who[file].key for file in files})
        if n > 1:
            says = flag_of("same_file", n=n, typed=typed, made=_date(made)).says
            yield Copy(tuple(files), "same_file", says)


# --- the student's page ---------------------------------------------------------------------------


def student_page(line: ReportLine, body: str) -> str:
    """A student's page: whose it is, the points with the instructor's own, and what was measured.

    line: after `across`. body: of `page_body`, or "" where the bundle was not graded.
    """
    lost = sum(item.points < item.of for item in line.judged)
    paragraph = next((item for item in line.judged if item.topic == "paragraph"), None)
    return _page(what="student", bundle=line, lost=lost, body=Markup(body), paragraph=paragraph)


def _decided(line: ReportLine) -> str:
    """Which points the instructor gave, for the student; "" for none."""
    facts = {"points": _points(line.points), "of": _points(line.of)}
    facts["reasons"] = ", for the reasons that follow" if line.points != line.of else ""
    computed = "" if line.points is None else SAYS["computed"].format(**facts)
    if line.own.get("overrule"):
        return SAYS["total_set"] + computed
    instead = f"for the paragraph, in place of {_points(line.computed_paragraph)}"
    words = {"paragraph": instead, "late": "for late days"}
    said = [f"{_points(number_of(line.own[k]))} {words[k]}" for k in words if line.own.get(k)]
    return f"Points that your instructor set: {'; '.join(said)}.{computed}" if said else ""


def _told(line: ReportLine) -> str:
    """What somebody without points is told; nothing where it is the grader that failed. With points
    it is what is to be handed in, where that was no bundle."""
    if line.total is not None or line.reason in FAILED:
        return next((flag.says for flag in line.flags if flag.code == "only_a_measurement"), "")
    again = SAYS["again"].format(file=line.file.rpartition("/")[2], says=line.says)
    return line.says if line.reason == "missing" else again


def page_body(grade: Grade, submission: Submission) -> str:
    """The part of a student's page that the bundle decides: plot, table, a sentence on everything.

    No flags, which are the instructor's.
    """
    return _page(
        what="body",
        submission=submission,
        made=_date(submission.made),
        figure=_noise_figure(submission, grade.recomputed),
        comparison=list(_comparison(grade, submission)),
        lost=[i for i in grade.items if i.points < i.of and i.topic != "paragraph"],
        right=[i for i in grade.items if i.points >= i.of and i.topic != "paragraph"],
    )


def _comparison(grade: Grade, submission: Submission) -> Iterator[tuple[str, ...]]:
    """Claims beside what is recomputed, a row for each number: at, what, claimed, found."""
    claims, law = submission.claims, grade.recomputed.law
    for m in grade.recomputed.at:
        same = (row for row in claims.rows if abs(row.distance_m - m.distance_m) < 0.005)
        row = next(same, TableRow(m.distance_m))
        claim = _pair(row.depth_bias_mm, "+.2f", row.depth_bias_se_mm)
        found = _pair(getattr(m.bias, "value", None), "+.2f", m.bias_se_mm)
        yield f"{m.distance_m:.2f}\u00a0m", "bias (mm)", claim, found
        claim = _pair(row.depth_std_mm, ".3f", row.depth_std_se_mm)
        found = _pair(getattr(m.std, "value", None), ".3f", getattr(m.std, "se", None))
        yield "", "std (mm)", claim, found
        percent = None if row.invalid_fraction is None else 100 * row.invalid_fraction
        yield "", "invalid (%)", _pair(percent, ".1f"), _pair(100 * m.invalid.value, ".1f")
    sigma_d, ends = (law.sigma_d_px, law.sigma_d_interval_px) if law else (None, None)
    yield "all", "σ_d (px)", _pair(claims.sigma_d_px, ".3f"), _pair(sigma_d, ".3f")
    yield "", "95 % (px)", _ends(claims.sigma_d_interval_px), _ends(ends)


def _pair(value: float | None, digits: str, error: float | None = None) -> str:
    """A value and its error in a fixed format, such as "+1.25 ± 0.10"; "-" for none."""
    if value is None:
        return "-"
    text = _fixed(value, digits)
    return text if error is None else f"{text} ± {_fixed(error, digits.lstrip('+'))}"


def _ends(ends: Interval | None) -> str:
    """An interval in px, such as "0.070 to 0.090"; "-" for none."""
    return "-" if ends is None else " to ".join(_fixed(end, ".3f") for end in ends)


def _fixed(value: float, digits: str) -> str:
    """A number in a fixed format, or in few digits where that would be long or hide it."""
    sign = "+" if digits.startswith("+") else ""
    hidden = value != 0 and abs(value) < 2 * 10.0 ** -int(digits.strip("+.f"))
    return f"{value:{sign}.2g}" if hidden or abs(value) >= 1e6 else f"{value:{digits}}"


class _Axes(NamedTuple):
    """Straight axes from 0 in y; metres and millimetres to the view's units."""

    low: float
    high: float
    top: float

    def x(self, value: float) -> float:
        inside = PLOT["W"] - PLOT["LEFT"] - PLOT["RIGHT"]
        return PLOT["LEFT"] + inside * (value - self.low) / (self.high - self.low)

    def y(self, value: float) -> float:
        inside = PLOT["H"] - PLOT["TOP"] - PLOT["BOTTOM"]
        return PLOT["H"] - PLOT["BOTTOM"] - inside * value / self.top

    def split(self, points: Iterable[tuple[float, float]]) -> tuple[list[Any], list[Any]]:
        """The points that fit, in the view's units; and the others, in words."""
        inside, off = [], []
        for z, value in points:
            if self.low <= z <= self.high and 0 <= value <= self.top:
                inside.append((self.x(z), self.y(value)))
            else:
                off.append(f"{value:.3g} mm at {z:.2f} m")
        return inside, off

    def path(self, z: Iterable[float], values: Iterable[float]) -> str:
        """A line through these points, without those that are too high."""
        pairs = [p for p in zip(z, values, strict=True) if p[1] <= self.top]
        return "M" + "L".join(f"{self.x(a):.1f} {self.y(b):.1f}" for a, b in pairs) if pairs else ""


def _noise_figure(submission: Submission, found: Recomputed) -> dict[str, Any] | None:
    """Std of depth against distance: recomputed with its error, the law, and what was claimed.

    Values off the scale are left out and named in the text alternative. None without any depth.
    """
    measured = [(m.distance_m, m.std.value, m.std.se) for m in found.at if m.std is not None]
    rows, plot = submission.claims.rows, submission.plot or Plot((), (), ())
    claimed = {r.distance_m: r.depth_std_mm for r in rows if r.depth_std_mm is not None}
    predicted = dict(zip(plot.distances_m, plot.predicted_mm or (), strict=False))  # or none
    tops = [std + 2 * se for _, std, se in measured if std < LARGEST_MM]
    if not tops:
        return None
    law, ends, limit = found.law, [z for z, _, _ in measured], 2.5 * max(*tops, 1e-6)
    tops += [v for v in (*claimed.values(), *predicted.values()) if 0 <= v <= limit]
    if law is not None:
        tops.append(min(1e3 * float(law.std_m(1.1 * max(ends))[0]), limit))
    axes = _Axes(0.8 * min(ends), 1.1 * max(ends), 1.1 * max([*tops, 1e-6]))
    claims, off_claims = axes.split(claimed.items())
    guesses, off_guesses = axes.split(predicted.items())
    return _law_curves(axes, submission, found, min(ends)) | {
        "x_ticks": [(axes.x(v), f"{v:.2g}") for v in _ticks(axes.low, axes.high, 6)],
        "y_ticks": [(axes.y(v), f"{v:.3g}") for v in _ticks(0, axes.top, 5)],
        "measured": [
            (axes.x(z), *map(axes.y, (std, max(std - 2 * se, 0), min(std + 2 * se, axes.top))))
            for z, std, se in measured
            if std < LARGEST_MM
        ],
        "claimed": claims,
        "predicted": guesses,
        "said": [(*row, claimed.get(row[0]), predicted.get(row[0])) for row in measured],
        "off": (("your table", off_claims), ("your prediction", off_guesses)),
    }


def _law_curves(
    axes: _Axes, submission: Submission, found: Recomputed, nearest: float
) -> dict[str, Any]:
    """The curve of the fitted law with its band, and, where it shows, what rounding to counts makes
    of it; `in_counts` is the count in mm where that shows at the nearest distance, too."""
    if found.law is None:
        return {}
    step_mm, z = 1e3 * submission.camera.depth_scale_m, np.linspace(axes.low, axes.high, 40)

    def rounded(std_mm: float) -> float:
        return math.sqrt(float(rounded_variance(std_mm, step_mm)))

    middle, low, high = ((1e3 * curve).tolist() for curve in found.law.std_m(z))
    shows, near = (
        rounded(std) > 1.05 * std
        for std in (1e3 * float(found.law.std_m(at)[0]) for at in (axes.low, nearest))
    )
    return {
        "band": axes.path([*z, *z[::-1]], np.minimum(low + high[::-1], axes.top)),
        "law": axes.path(z, middle),
        "rounded": axes.path(z, map(rounded, middle)) if shows else "",
        "sigma_d": found.law.sigma_d_px,
        "in_counts": step_mm if near else None,
    }


def _ticks(low: float, high: float, about: int) -> list[float]:
    """Round numbers from low to high, some `about` of them."""
    raw = (high - low) / about
    power = 10.0 ** math.floor(math.log10(raw))
    step = next(f * power for f in (1, 2, 5, 10) if f * power >= raw * 0.999)
    first, last = math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9)
    return [i * step for i in range(first, last + 1)]


# --- the instructor's pages -----------------------------------------------------------------------


def class_page(
    lines: Sequence[ReportLine], changes: Sequence[tuple[str, ...]] = (), warning: str = ""
) -> str:
    """Distribution, misconceptions, flags, refused bundles, and a link to every student's page.

    lines: after `across`. A student counts once. changes: since the last report, of a regrade.
    warning: stands first.
    """
    done = [line for line in lines if line.points is not None]
    counts = [line for line in done if line.counts]
    everybody = [line for line in lines if line.counts]
    given = [(line.total, line.of or 100) for line in everybody]
    percents = [100 * total / of for total, of in given if total is not None]
    named = sorted(everybody, key=_by_name)
    return _page(
        what="class",
        lines=lines,
        warning=warning,
        done=done,
        counts=counts,
        percents=percents,
        median=statistics.median(percents) if percents else 0.0,
        bins=np.histogram(np.clip(percents, 0, 100), 10, (0, 100))[0].tolist(),
        topics=_topics(counts),
        left_out=_left_out(counts),
        flags=_by_flag(done, False),
        notes=_by_flag(done, True),
        changes=changes,
        named=named,
        namesakes=_namesakes(named),
        unread=unread(counts),
        ranked=sorted(named, key=lambda line: (line.total is not None, line.total or 0.0)),
    )


def unread(lines: Sequence[ReportLine]) -> int:
    """How many paragraphs have no points of the instructor's."""
    some = (line for line in lines if line.counts and line.points is not None)
    return sum(bool(n.paragraph.strip()) and not n.own.get("paragraph") for n in some)


def _namesakes(lines: Sequence[ReportLine]) -> set[str]:
    """The names that several have."""
    return {name for name, n in Counter(line.name for line in lines).items() if n > 1}


def _by_name(line: ReportLine) -> tuple[list[str], str]:
    """In which order people stand on a page."""
    return words_of(line.name or line.student), line.file


def _result(line: ReportLine) -> str:
    """The points of somebody, and whose they are; or why there are none."""
    if line.total is None:
        return "missing" if line.reason == "missing" else "not graded"
    text = f"{_points(line.total)} of {_points(line.of or 100)}"
    computed = "none" if line.points is None else _points(line.points)
    return text if line.total == line.points else f"{text} (yours; {computed} computed)"


def _topics(lines: Sequence[ReportLine]) -> list[tuple[str, str, int, Any]]:
    """Label, where the lesson says it, how many students got it wrong and (mistake, students) of
    each topic, the worst first. What somebody left out is no mistake.
    """
    found = []
    for topic, label in LABELS.items():
        said = [(line, _ways(line, topic)) for line in lines]
        groups = grouped((way, line) for line, ways in said for way in ways)
        ranked = sorted(groups.items(), key=lambda pair: -len(pair[1]))
        if ranked:
            wrong = sum(bool(ways) for _, ways in said)
            found.append((label, REPEAT.get(topic, ""), wrong, ranked))
    return sorted(found, key=lambda row: -row[2])


def _ways(line: ReportLine, topic: str) -> list[str]:
    """In which ways a topic is wrong; a mistake made at three distances is one."""
    items = [i for i in line.items if i.topic == topic and i.verdict != "missing"]
    return [*dict.fromkeys(filter(None, map(_said, items)))]


def _left_out(lines: Sequence[ReportLine]) -> list[tuple[str, list[ReportLine]]]:
    """What students left out, with those who left out the same."""
    topics = (
        (dict.fromkeys(item.topic for item in line.items if item.verdict == "missing"), line)
        for line in lines
    )
    who = grouped((", ".join(LABELS[t] for t in some), line) for some, line in topics if some)
    return sorted(who.items(), key=lambda pair: -len(pair[1]))


def _by_flag(lines: Sequence[ReportLine], note: bool) -> list[Any]:
    """Those who share a flag share a row."""
    flags = ((flag, line) for line in lines for flag in line.flags if flag.note == note)
    who = grouped(((f.code.replace("_", " "), f.says, f.among), line) for f, line in flags)
    return list(who.items())


def paragraphs_page(lines: Sequence[ReportLine], named: bool = True) -> str:
    """The closing paragraphs of the class, by name, to read in one go; lines: after `across`.

    named: else by code and without links, for a second marker.
    """
    some = sorted((n for n in lines if n.points is not None and n.counts), key=_by_name)
    if not named:
        some = sorted((replace(n, name=n.code, page="") for n in some), key=lambda n: n.name)
    said = [line for line in some if line.paragraph.strip()]
    silent = [line for line in some if not line.paragraph.strip()]
    worth = grading_rules()["points"]["paragraph"]
    shown = {"said": said, "silent": silent, "named": named, "namesakes": _namesakes(some)}
    return _page(what="paragraphs", worth=worth, **shown)


def _said(item: Item) -> str:
    """What a class page calls the way in which an item is not right; nothing where it is."""
    if item.mistake:
        return MISTAKES.get(item.mistake, item.mistake)
    return {"wrong": "wrong, no known reason", "missing": "left out"}.get(item.verdict, "")


def grades_csv(lines: Sequence[ReportLine], separator: str = ",") -> str:
    """One row a bundle, and one for each of the roster without any: points in all and by topic,
    what cost some, flags, why it was not graded, the page, and the roster's own columns.

    Of several bundles of one student one counts, as its column says; lines: after `across`. `total`
    holds the instructor's own points. Text that a spreadsheet would calculate gets an apostrophe.
    """
    more = [c for c in dict.fromkeys(c for line in lines for c in line.row) if c not in HEADER]
    rows = []
    for line in lines:
        done = line.points is not None
        topics = (
            round(sum(item.points for item in line.items if item.topic == topic), 2)
            for topic in LABELS
        )
        lost = "; ".join(_lost(item) for item in line.items if item.points < item.of)
        codes = " ".join(sorted({flag.code for flag in line.flags if not flag.note}))
        rows.append(
            (
                *(line.file, line.name or line.student, line.who, line.student),
                "graded" if done else f"not graded: {line.reason}",
                *("yes" if done and line.counts else "no", "yes" if line.late else "no"),
                *(line.made, line.handed_in, _points(line.points), _points(line.of)),
                f"{line.percent:.1f}" if done else "",
                *(_points(value) if done else "" for value in topics),
                *(_points(line.total), line.own.get("comment", ""), lost, codes, line.says),
                *(line.page, line.code, *(line.row.get(column, "") for column in more)),
            )
        )
    return _csv([(*HEADER, *more), *rows], separator)


def canvas_column(lines: Sequence[ReportLine], assignment: str = "") -> tuple[str, bool]:
    """The gradebook's column for the points, and whether the roster has it: the one that is named,
    or the only one whose name holds `assignment`."""
    name = assignment or CANVAS_COLUMNS[-1]
    columns = dict.fromkeys(column.strip() for line in lines for column in line.row)
    found = [c for c in columns if c == name]
    found = found or [c for c in columns if name.casefold() in c.casefold()]
    return (found[0], True) if len(found) == 1 else (name, False)


def exports(
    lines: Sequence[ReportLine], sign: str = ",", assignment: str = "", most: Mapping[str, str] = {}
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Tables that Moodle and Canvas import, by the file's name, and notes: if the roster does not
    have the column of the points, or it is not worth 100; lines: after `across`.

    Moodle's is its offline grading worksheet, found by `Identifier`; Canvas' its gradebook, found
    by `ID`, with the row of the points possible. Both have whoever has points or a word for them;
    a table without either is not made. sign: between cells. assignment: see `canvas_column`. most:
    see `Roster.possible`.
    """
    tables: dict[str, str] = {}
    moodle, canvas, notes = [], [], set[str]()
    for line in lines:
        at, row = place_of(line.file), {k.strip().casefold(): v for k, v in line.row.items()}
        name, grade_of, feedback = line.name or line.student, _points(line.total), _feedback(line)
        if not (line.counts and (grade_of or feedback)):
            continue
        identifier = f"Participant {at.id}" if at.lms == "Moodle" else row.get("identifier", "")
        if identifier:
            notes |= _other_maximum("moodle.csv", "worksheet", row.get("maximum grade"))
            email = row.get("email address", row.get("email", ""))
            # else Moodle skips whom it has graded before; "-" is its word for never
            when = row.get("last modified (grade)", "").strip("- ")
            moodle.append((identifier, name, email, grade_of, "100", when, feedback))
        gradebook = {"student", "id", "section"} <= set(row)
        number = row["id"] if gradebook else at.id if at.lms == "Canvas" else ""
        if number:
            ids = (row.get(column.casefold(), "") for column in CANVAS_COLUMNS[2:5])
            canvas.append((name, number, *ids, grade_of))
    if any(row[3] or row[6] != NOTHING for row in moodle):
        tables["moodle.csv"] = _csv([MOODLE_COLUMNS, *moodle], sign)
    if not any(row[-1] for row in canvas):
        return tables, tuple(notes)
    column, known = canvas_column(lines, assignment)
    possible = ("    Points Possible", "", "", "", "", most.get(column) or "100")
    notes |= _other_maximum("canvas.csv", "gradebook", possible[-1])
    tables["canvas.csv"] = _csv([(*CANVAS_COLUMNS[:-1], column), possible, *canvas], sign)
    if not known:
        notes.add(SAYS["no_column"].format(column))
    return tables, tuple(sorted(notes))


def _other_maximum(file: str, of: str, most: str | None) -> set[str]:
    """What to say where what an LMS gives at most is not 100."""
    other = most and not re.fullmatch(r"100([.,]0*)?", most)
    return {SAYS["other_maximum"].format(file, of, most)} if other else set()


def own_table(lines: Sequence[ReportLine], separator: str = ",") -> str:
    """A table for the instructor's own points, with a row for everybody."""
    some = sorted((line for line in lines if line.who and line.counts), key=_by_name)
    rows = ((n.who, n.name or n.student, n.code, "", "", "", "") for n in some)
    return _csv([OWN_COLUMNS, *rows], separator)


def _feedback(line: ReportLine) -> str:
    """What a student reads beside the points: the instructor's words, and what cost some."""
    lost = "; ".join(_lost(item) for item in line.items if item.points < item.of)
    said = (line.own.get("comment", ""), _decided(line), lost, _told(line))
    return " | ".join(filter(None, said))


def _csv(rows: Iterable[Iterable[str]], separator: str) -> str:
    """A table with every cell quoted."""
    out = io.StringIO()
    writer = csv.writer(out, delimiter=separator, quoting=csv.QUOTE_ALL, lineterminator="\n")
    writer.writerows(map(_cell, row) for row in rows)
    return out.getvalue()


def _lost(item: Item) -> str:
    """Why an item lost points, and how many: "bias at 0.45 m: sign of the bias turned (-2)"."""
    return f"{item.name}: {_said(item) or item.verdict} ({_points(item.points - item.of)})"


def _cell(text: str) -> str:
    """Text that no spreadsheet takes for a formula, whatever separates its cells; one line."""
    text = " ".join(text.split()) if any(c in text for c in "\r\n\t") else text
    text = re.sub(rf"([;,|]\s*)([{re.escape(''.join(FORMULA))}])", r"\1'\2", text)
    return f"'{text}" if text.lstrip().startswith(FORMULA) else text


def _points(value: float | None) -> str:
    """Points without zeros that say nothing."""
    return "" if value is None else f"{value:.2f}".rstrip("0").rstrip(".")


PAGES = jinja2.Environment(loader=jinja2.FileSystemLoader(HERE), autoescape=True, trim_blocks=True)
PAGES.filters |= {"points": _points, "result": _result, "told": _told, "decided": _decided}
PAGES.filters |= {"counted": counted, "px": "{:.1f}".format}
PAGES.globals |= PLOT | {"style": Markup((HERE / "report.css").read_text(encoding="utf-8"))}
TEMPLATE = PAGES.get_template("report.html.jinja")  # of all pages; it escapes all that it shows
