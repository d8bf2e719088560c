"""What people read: a page for each student, two for the instructor, and a table for a spreadsheet.

Everything that came with a bundle is escaped; pages hold their style and figures, load nothing and
run nothing. Flags are on the instructor's page only: they are questions, not findings.
"""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from html import escape
from typing import Any
from urllib.parse import quote

from coursekit.submission.contents import Submission
from coursekit.submission.flags import Copy, Fingerprint, Flag, compare, person, same_words
from coursekit.submission.rubric import LABELS, MISTAKES, Grade, Item
from coursekit.submission.svg import histogram, noise_plot, off_scale

HEADER = (
    "file",
    "student",
    "status",
    "counts",
    "points",
    "of",
    "percent",
    *LABELS,
    "lost",
    "flags",
    "says",
)
PARAGRAPHS = "paragraphs.html"  # the link to it from the class page
SHOWN = 12  # students of a group whose links are shown at once
FORMULA = tuple("=+-@\t\r\n＝＋－＠")  # what makes a spreadsheet calculate a cell
VERDICTS = ("right", "partial", "wrong", "missing")

STYLE = """
:root { color-scheme: light; }
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, sans-serif; color: #222; background: #fff; margin: 0 auto;
  padding: 20px 16px 48px; max-width: 900px; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 4px; }
h2 { font-size: 1.2rem; margin: 32px 0 8px; }
p { margin: 6px 0; }
a { color: #00538a; }
.faint { color: #595959; }
.points { font-size: 1.25rem; margin: 12px 0; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; width: 100%; font-variant-numeric: tabular-nums; }
th, td { text-align: left; padding: 5px 10px 5px 0; border-bottom: 1px solid #ddd;
  vertical-align: top; overflow-wrap: break-word; max-width: 36rem; }
td:first-child, th:first-child { max-width: 13rem; }
.names td:first-child { max-width: 36rem; }
th { font-weight: 600; color: #444; }
th.n, td.n { text-align: right; white-space: nowrap; }
svg.figure { display: block; width: 100%; max-width: 620px; height: auto;
  font: 12.5px system-ui, sans-serif; }
.key { display: flex; flex-wrap: wrap; gap: 2px 18px; font-size: .9rem; }
.key span { display: inline-flex; align-items: center; gap: 7px; }
.key svg { flex: none; }
ul { list-style: none; padding: 0; margin: 0; }
li { display: grid; grid-template-columns: 5.2rem 4.6rem 1fr; gap: 8px; padding: 5px 0;
  border-bottom: 1px solid #eee; }
li .n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.tag { display: inline-block; border-radius: 4px; padding: 0 7px; font-size: .85rem;
  align-self: start; justify-self: start; border: 1px solid; white-space: nowrap; }
.right { color: #00593f; background: #e3f4ee; }
.partial { color: #6b4800; background: #fdf1d8; }
.wrong { color: #8f3300; background: #fdeadd; }
.missing { color: #444; background: #eee; }
details { margin: 4px 0; }
summary { cursor: pointer; color: #00538a; }
.groups > div { margin-bottom: 4px; }
blockquote { margin: 8px 0; padding: 4px 14px; border-left: 3px solid #bbb; white-space: pre-wrap; }
@media (max-width: 560px) {
  body { font-size: 15px; }
  svg.figure { font-size: 15px; }
  table { font-size: 14px; }
  th, td { padding-right: 7px; }
  .names td:first-child, .stack td { max-width: none; overflow-wrap: anywhere; }
  td:first-child, th:first-child { max-width: 8rem; }
  .stack thead { display: none; }
  .stack, .stack tbody { display: block; }
  .stack tr { display: block; border-bottom: 1px solid #ddd; padding: 6px 0; }
  .stack td { display: block; border: 0; padding: 1px 0; }
  .stack td.n { text-align: left; }
  .stack td:first-child { font-weight: 600; max-width: none; }
  li { grid-template-columns: 1fr auto; }
  li .says { grid-column: 1 / -1; }
}
"""


@dataclass(frozen=True)
class Line:
    """One bundle in the class: graded, or not and why.

    file: the bundle's name. made, paragraph: as handed in. page: the link to its page. reason,
    says: of a bundle that was not graded. counts: False where the student has a newer one.
    `to_dict`, `from_dict`: through JSON.
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

    @property
    def percent(self) -> float | None:
        """Points of what could be had."""
        if self.points is None:
            return None
        return 100 * self.points / self.of if self.of else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Plain text, numbers, lists and dictionaries."""
        prints = None if self.fingerprint is None else self.fingerprint.to_dict()
        return {**asdict(replace(self, fingerprint=None)), "fingerprint": prints}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Line:
        """The inverse of `to_dict`."""
        items = tuple(Item(**item) for item in data["items"])
        flags = tuple(Flag(**flag) for flag in data["flags"])
        prints = data["fingerprint"]
        prints = None if prints is None else Fingerprint.from_dict(prints)
        return cls(**{**data, "items": items, "flags": flags, "fingerprint": prints})


def graded(file: str, grade: Grade, submission: Submission, page: str = "") -> Line:
    """The line of a graded bundle; of its items what the class page and the table say."""
    return Line(
        file=file,
        student=grade.student,
        made=submission.made,
        paragraph=submission.conclusion.paragraph,
        points=grade.points,
        of=grade.of,
        items=tuple(
            replace(item, says="", claimed=None, found=None, tolerance=None) for item in grade.items
        ),
        flags=grade.flags,
        page=page,
        fingerprint=grade.fingerprint,
    )


def not_graded(file: str, reason: str, says: str) -> Line:
    """The line of a bundle that was refused, or whose grading failed."""
    return Line(file, reason=reason, says=says)


def across(lines: Sequence[Line]) -> list[Line]:
    """The lines with what only the class shows: shared data and words, and whose newest counts.

    Without fingerprints, which are of no more use.
    """
    done = [line for line in lines if line.points is not None]
    prints = {line.file: line.fingerprint for line in done if line.fingerprint is not None}
    said = {line.file: (line.student, line.paragraph) for line in done}
    about: dict[str, list[Flag]] = {}
    for copy in [*compare(prints), *same_words(said)]:
        flag = _copy_flag(copy)
        for key in copy.keys:
            about.setdefault(key, []).append(flag)
    newest = _newest(done)
    found = []
    for line in lines:
        flags = [*line.flags, *about.get(line.file, ())]
        last = newest.get(person(line.student)) if line.points is not None else None
        counts = last is None or last is line
        if last is not None and not counts:
            says = (
                f"An earlier bundle of {last.student}, {_points(line.points or 0.0)} points; "
                f"{last.file} counts, {_points(last.points or 0.0)} points."
            )
            flags.append(Flag("earlier_bundle", says, note=True))
        found.append(replace(line, flags=tuple(flags), counts=counts, fingerprint=None))
    return found


def _newest(lines: Sequence[Line]) -> dict[str, Line]:
    """The bundle of each student that was made last; the first one of several."""
    newest: dict[str, Line] = {}
    for line in lines:
        before = newest.setdefault(person(line.student), line)
        if _moment(line) > _moment(before):
            newest[person(line.student)] = line
    return newest


def _moment(line: Line) -> float:
    return datetime.fromisoformat(line.made).timestamp() if line.made else 0.0


def _copy_flag(copy: Copy) -> Flag:
    names = ", ".join(copy.keys[:6]) + (f", {len(copy.keys) - 6} more" * (len(copy.keys) > 6))
    return Flag(copy.code, f"{copy.says.rstrip('.')} ({names}).", copy.note)


# --- the student's page -------------------------------------------------------------------------


def student_page(grade: Grade, submission: Submission) -> str:
    """A student's page: points, plot, table and a sentence on everything; no flags."""
    camera = submission.camera
    lost = [item for item in grade.items if item.points < item.of]
    figure = noise_plot(submission, grade.recomputed)
    note = off_scale(figure)
    facts = (
        f"{camera.name} ({camera.source}), {camera.width}x{camera.height} px, "
        f"fx = {camera.fx:.1f} px, baseline "
        + ("unknown" if camera.baseline_m is None else f"{1e3 * camera.baseline_m:.2f} mm")
        + f", depth unit {1e3 * camera.depth_scale_m:g} mm"
    )
    top = f"{_points(grade.points)} of {_points(grade.of)} points."
    if lost:
        top += f" {_counted(len(lost), 'answer')} cost some; see below."
    body = [
        f"<h1>Studio exercise 1: {escape(submission.student)}</h1>",
        f'<p class="faint">{escape(facts)}. Packed {escape(submission.made)}.</p>',
        f'<p class="points"><strong>{escape(top)}</strong></p>',
    ]
    if figure:
        body += ["<h2>Noise against distance</h2>", figure]
        body += [f'<p class="faint">{note}</p>'] if note else []  # already escaped
    body += ["<h2>Your table and your raw depths</h2>", _comparison(grade, submission)]
    if lost:
        body += ["<h2>What cost points</h2>", _item_list(lost)]
    right = [item for item in grade.items if item.points >= item.of]
    body += ["<h2>What is right</h2>", _item_list(right)] if right else []
    body += _conclusion(submission)
    body += _outcomes(submission)
    return _page(f"Studio exercise 1: {submission.student}", body)


def _comparison(grade: Grade, submission: Submission) -> str:
    """Claims beside what is recomputed, a row for each number."""
    rows = []
    for m in grade.recomputed.at:
        claims = [r for r in submission.claims.rows if abs(r.distance_m - m.distance_m) < 0.005]
        row = claims[0] if claims else None
        said = (
            (row.depth_bias_mm, row.depth_bias_se_mm, row.depth_std_mm, row.depth_std_se_mm)
            if row
            else (None,) * 4
        )
        invalid = None if row is None else row.invalid_fraction
        bias, std = m.bias, m.std
        rows.append(
            (
                f"{m.distance_m:.2f}\u00a0m",
                "bias (mm)",
                _pair(said[0], said[1], "+.2f", ".2f"),
                _pair(bias.value if bias else None, m.bias_se_mm, "+.2f", ".2f"),
            )
        )
        rows.append(
            (
                "",
                "std (mm)",
                _pair(said[2], said[3], ".3f", ".3f"),
                _pair(std.value if std else None, std.se if std else None, ".3f", ".3f"),
            )
        )
        found = _pair(100 * m.invalid.value, None, ".1f", "")
        percent = None if invalid is None else 100 * invalid
        rows.append(("", "invalid (%)", _pair(percent, None, ".1f", ""), found))
    law, claims_ = grade.recomputed.law, submission.claims
    said_d, found_d = claims_.sigma_d_px, None if law is None else law.sigma_d_px
    rows.append(
        ("all", "σ_d (px)", _pair(said_d, None, ".3f", ""), _pair(found_d, None, ".3f", ""))
    )
    ends = None if law is None else law.sigma_d_interval_px
    rows.append(("", "95 % (px)", _ends(claims_.sigma_d_interval_px), _ends(ends)))
    return _table(("at", "what", "you say", "recomputed"), rows, (2, 3))


def _pair(value: float | None, error: float | None, digits: str, error_digits: str) -> str:
    if value is None:
        return "-"
    text = _fixed(value, digits)
    return text if error is None else f"{text} ± {_fixed(error, error_digits)}"


def _ends(ends: tuple[float, float] | None) -> str:
    return "-" if ends is None else " to ".join(_fixed(end, ".3f") for end in ends)


def _fixed(value: float, digits: str) -> str:
    """A number in a fixed format, or in few digits where that would be long or hide it."""
    sign = "+" if digits.startswith("+") else ""
    places = int(digits.strip("+.f"))
    hidden = value != 0 and abs(value) < 2 * 10.0**-places
    return f"{value:{sign}.2g}" if hidden or abs(value) >= 1e6 else f"{value:{digits}}"


def _item_list(items: Iterable[Item]) -> str:
    rows = [
        f'<li><span class="tag {item.verdict}">{item.verdict}</span>'
        f'<span class="n">{_points(item.points)} of {_points(item.of)}</span>'
        f'<span class="says">{escape(item.says)}</span></li>'
        for item in items
    ]
    return f"<ul>{''.join(rows)}</ul>"


def _conclusion(submission: Submission) -> list[str]:
    text = submission.conclusion.paragraph.strip()
    return ["<h2>Your paragraph</h2>", f"<blockquote>{escape(text)}</blockquote>"] if text else []


def _outcomes(submission: Submission) -> list[str]:
    if not submission.outcomes:
        return []
    rows = [
        (name, "right" if outcome.right else "not yet", str(outcome.attempts))
        for name, outcome in sorted(submission.outcomes.items())
    ]
    table = _table(("checkpoint or exercise", "in the end", "attempts"), rows, (2,))
    return ["<h2>Checkpoints and exercises (no points)</h2>", table]


# --- the instructor's page ----------------------------------------------------------------------


def class_page(lines: Sequence[Line]) -> str:
    """Distribution, misconceptions, flags, refused bundles, and a link to every student's page.

    lines: after `across`. A student counts once, with the newest bundle.
    """
    done = [line for line in lines if line.points is not None]
    counted = [line for line in done if line.counts]
    refused = [line for line in lines if line.points is None]
    percents = [line.percent for line in counted if line.percent is not None]
    flagged = sum(any(not flag.note for flag in line.flags) for line in done)
    summary = (
        f"{_counted(len(done), 'bundle')} graded, {len(refused)} not graded, {flagged} flagged."
    )
    if len(counted) < len(done):
        summary += f" They are of {_counted(len(counted), 'student')}, whose newest counts."
    if percents:
        summary += (
            f" Median {statistics.median(percents):.0f} % of the points, "
            f"from {min(percents):.0f} to {max(percents):.0f} %."
        )
    body = [
        "<h1>Studio exercise 1: the class</h1>",
        f'<p class="points">{escape(summary)}</p>',
        f'<p><a href="{PARAGRAPHS}">All paragraphs on one page</a>, to read and score.</p>',
        histogram(percents),
    ]
    if counted:
        body += ["<h2>What was asked, and what went wrong</h2>", _misconceptions(counted)]
    body += _flag_section(done)
    if refused:
        rows = [(line.file, line.reason, line.says) for line in refused]
        table = _table(("file", "reason", "what to do"), rows, kind="stack")
        body += ["<h2>Not graded</h2>", table]
    body += _students(counted)
    return _page("Studio exercise 1: the class", body)


def _misconceptions(lines: Sequence[Line]) -> str:
    rows = []
    for topic, label in LABELS.items():
        items = [item for line in lines for item in line.items if item.topic == topic]
        if not items:
            continue
        right = sum(item.verdict == "right" for item in items) / len(items)
        # A mistake made at three distances is made by one student.
        who: dict[str, list[Line]] = {}
        for line in lines:
            for mistake in {_said(item): None for item in line.items if item.topic == topic}:
                if mistake:
                    who.setdefault(mistake, []).append(line)
        groups = [
            f"<div>{escape(mistake)} ({len(some)}): {_links(some)}</div>"
            for mistake, some in sorted(who.items(), key=lambda pair: -len(pair[1]))
        ]
        cell = _Raw(f'<div class="groups">{"".join(groups)}</div>' if groups else "-")
        rows.append((label, f"{right:.0%} right", cell))
    return _table(("item", "answers", "otherwise (students)"), rows, (1,), kind="stack")


def _said(item: Item) -> str:
    if item.mistake:
        return MISTAKES.get(item.mistake, item.mistake)
    return {"wrong": "wrong, no known reason", "missing": "left out"}.get(item.verdict, "")


def _flag_section(lines: Sequence[Line]) -> list[str]:
    sections = []
    for note, title, words in (
        (
            False,
            "To look at",
            "No points were taken for these. Ask first: there may be an innocent reason.",
        ),
        (True, "Notes", "Expected, and no reason to ask."),
    ):
        who: dict[tuple[str, str], list[Line]] = {}  # those who share a flag share a row
        for line in lines:
            for flag in line.flags:
                if flag.note == note:
                    who.setdefault((flag.code.replace("_", " "), flag.says), []).append(line)
        if who:
            cells = [(_links(some), code, says) for (code, says), some in who.items()]
            table = _table(("student", "what", "what was seen"), cells, kind="stack")
            sections += [f"<h2>{title}</h2>", f"<p>{words}</p>", table]
    return sections


def _students(lines: Sequence[Line]) -> list[str]:
    if not lines:
        return []
    named = sorted(lines, key=lambda line: (person(line.student), line.file))
    ranked = sorted(named, key=lambda line: line.percent or 0.0)
    return [
        "<h2>Everybody, lowest points first</h2>",
        _everybody(ranked),
        f"<details><summary>Everybody by name</summary>{_everybody(named)}</details>",
    ]


def _everybody(lines: Sequence[Line]) -> str:
    rows = [
        (
            _Raw(f'{_link(line)}<div class="faint">{escape(line.file)}</div>'),
            f"{_points(line.points or 0.0)} of {_points(line.of or 0.0)}",
            str(sum(not flag.note for flag in line.flags) or ""),
        )
        for line in lines
    ]
    return _table(("student and file", "points", "flags"), rows, (1, 2), kind="names")


def paragraphs_page(lines: Sequence[Line]) -> str:
    """The closing paragraphs of the class, by name, to read in one go; lines: after `across`."""
    some = [line for line in lines if line.points is not None and line.counts]
    some.sort(key=lambda line: (person(line.student), line.file))
    silent = [line for line in some if not line.paragraph.strip()]
    words = f"{_counted(len(some) - len(silent), 'paragraph')}, by name. <a href="
    body = [
        "<h1>Studio exercise 1: the paragraphs</h1>",
        f'<p class="points">{words}"index.html">Back to the class</a></p>',
    ]
    if silent:
        body.append(f"<div>No paragraph: {_links(silent)}</div>")
    for line in some:
        text = line.paragraph.strip()
        if text:
            facts = [_counted(len(text.split()), "word")]
            facts += [
                f"which error dominates: {item.verdict}"
                for item in line.items
                if item.topic == "verdict"
            ]
            if any(flag.code == "same_words" for flag in line.flags):
                facts.append("shares its words with others, see the class page")
            body += [
                f"<h2>{_link(line)}</h2>",
                f'<p class="faint">{escape("; ".join(facts))}</p>',
                f"<blockquote>{escape(text)}</blockquote>",
            ]
    return _page("Studio exercise 1: the paragraphs", body)


def _links(lines: Sequence[Line]) -> _Raw:
    links = [_link(line) for line in lines]
    shown, rest = ", ".join(links[:SHOWN]), links[SHOWN:]
    if rest:
        shown += f"<details><summary>and {len(rest)} more</summary>{', '.join(rest)}</details>"
    return _Raw(shown)


def _link(line: Line) -> str:
    name = escape(line.student or line.file)
    link = f'<a href="{escape(quote(line.page), quote=True)}">{name}</a>' if line.page else name
    return link if line.counts else f"{link} (earlier)"


# --- the table for a spreadsheet ------------------------------------------------------------------


def grades_csv(lines: Sequence[Line]) -> str:
    """One row a bundle: points in all and by topic, what cost some, flags, why it was not graded.

    Of several bundles of one student one counts, as its column says; lines: after `across`.
    Text that a spreadsheet would calculate gets an apostrophe before it.
    """
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(HEADER)
    for line in lines:
        by_topic = {
            topic: _sum(item.points for item in line.items if item.topic == topic)
            for topic in LABELS
        }
        done = line.points is not None
        codes = sorted({flag.code for flag in line.flags if not flag.note})
        writer.writerow(
            [
                _cell(line.file),
                _cell(line.student),
                "graded" if done else _cell(f"not graded: {line.reason}"),
                "yes" if done and line.counts else "no",
                _points(line.points) if line.points is not None else "",
                _points(line.of) if line.of is not None else "",
                f"{line.percent:.1f}" if line.percent is not None else "",
                *(_points(by_topic[topic]) if done else "" for topic in LABELS),
                _cell("; ".join(_lost(item) for item in line.items if item.points < item.of)),
                _cell(" ".join(codes)),
                _cell(line.says),
            ]
        )
    return out.getvalue()


def _lost(item: Item) -> str:
    """Why an item lost points, and how many: "bias at 0.45 m: sign of the bias turned (-2)"."""
    return f"{item.name}: {_said(item) or item.verdict} ({_points(item.points - item.of)})"


def _cell(text: str) -> str:
    """Text that no spreadsheet takes for a formula; one line."""
    text = " ".join(text.split()) if any(c in text for c in "\r\n\t") else text
    return f"'{text}" if text.lstrip().startswith(FORMULA) else text


# --- parts of a page ------------------------------------------------------------------------------


class _Raw(str):
    """HTML made here, not to be escaped."""

    __slots__ = ()


def _table(
    head: Sequence[str],
    rows: Sequence[Sequence[str]],
    numbers: Sequence[int] = (),
    kind: str = "",
) -> str:
    """numbers: columns of them. kind: "stack": on a phone the cells of a row come below each other;
    "names": names and files come first."""

    def cell(tag: str, i: int, text: str) -> str:
        side = ' class="n"' if i in numbers else ""
        return f"<{tag}{side}>{text if isinstance(text, _Raw) else escape(text)}</{tag}>"

    top = "".join(cell("th", i, text) for i, text in enumerate(head))
    body = "".join(
        f"<tr>{''.join(cell('td', i, text) for i, text in enumerate(row))}</tr>" for row in rows
    )
    return (
        f'<div class="wide"><table class="{kind}">'
        f"<thead><tr>{top}</tr></thead><tbody>{body}</tbody></table></div>"
    )


def _page(title: str, body: Sequence[str]) -> str:
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        '<meta http-equiv="Content-Security-Policy" '
        "content=\"default-src 'none'; style-src 'unsafe-inline'\">"
        f"<title>{escape(title)}</title><style>{STYLE}</style></head>\n"
        f"<body>\n{chr(10).join(body)}\n</body></html>\n"
    )


def _points(value: float) -> str:
    """Points without zeros that say nothing."""
    return f"{value:.2f}".rstrip("0").rstrip(".")


def _sum(values: Iterable[float]) -> float:
    return round(math.fsum(values), 2)


def _counted(n: int, what: str) -> str:
    return f"{n} {what}{'s' * (n != 1)}"
