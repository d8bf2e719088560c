"""The pages and the table: complete, escaped, and readable without the figures."""

from __future__ import annotations

import csv
import io
import json
import re
from dataclasses import replace
from html import escape
from html.parser import HTMLParser

import numpy as np
import pytest
import sample_submissions as samples

from coursekit.submission import report
from coursekit.submission.contents import Stack, Submission
from coursekit.submission.flags import Flag
from coursekit.submission.rubric import LABELS, Grade, grade

VOID = {"meta", "br", "img", "hr", "input", "link"}


class Page(HTMLParser):
    """The elements of a page; fails where they are not nested."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self._open: list[str] = []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self._open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.words.append(data)

    @property
    def text(self) -> str:
        """All that is not markup."""
        return " ".join(self.words)


ALLOWED = {"html", "head", "meta", "title", "style", "body", "h1", "h2", "p", "a", "ul", "li"}
ALLOWED |= {"span", "strong", "div", "table", "thead", "tbody", "tr", "th", "td", "blockquote"}
ALLOWED |= {"svg", "desc", "line", "text", "path", "circle", "rect"}


def check_page(text: str) -> Page:
    """A page that loads nothing, runs nothing and is well nested."""
    page = Page(text)
    for tag, attributes in page.tags:
        assert tag in ALLOWED
        assert not any(name.startswith("on") for name in attributes)
        assert not {"src", "style", "xlink:href"} & set(attributes)
        assert tag == "a" or "href" not in attributes
    assert "javascript:" not in " ".join(str(a.get("href")) for _, a in page.tags)
    return page


@pytest.fixture(scope="module")
def good() -> tuple[Grade, Submission]:
    """An honest submission and its grade."""
    submission = samples.honest(0)
    return grade(submission), submission


@pytest.fixture(scope="module")
def lines() -> list[report.Line]:
    """A small class."""
    handed = [
        samples.honest(0),
        samples.weak(1),
        samples.copied(samples.honest(0), "few_values"),
        samples.random_numbers(2),
        samples.injecting('=HYPERLINK("http://x")<script>alert(1)</script>', 4),
        samples.mistaken(3)["sign"][1],
    ]
    some = [
        report.graded(f"hand in/{i}.zip", grade(s), f"students/{i} a.html")
        for i, s in enumerate(handed)
    ]
    some.append(report.not_graded("bad.zip", "zip_bomb", "It grows a thousand times."))
    return report.with_copies(some)


# --- the student's page ---------------------------------------------------------------------------


def test_a_students_page_has_every_item_and_the_points(good: tuple[Grade, Submission]) -> None:
    page = check_page(report.student_page(*good))
    assert "100 of 100 points." in page.text
    for item in good[0].items:
        assert item.says in page.text
    assert good[1].conclusion.paragraph in page.text
    assert "depth_noise.twice_as_far" in page.text


def test_what_cost_points_comes_first() -> None:
    submission = samples.mistaken(1)["sign"][1]
    result = grade(submission)
    text = report.student_page(result, submission)
    assert text.index("What cost points") < text.index("What is right")
    assert escape(next(i.says for i in result.items if i.mistake == "sign")) in text


def test_flags_are_not_on_the_students_page() -> None:
    submission = samples.random_numbers(0)
    result = grade(submission)
    assert result.flags
    text = report.student_page(result, submission)
    assert not any(escape(flag.says) in text or flag.code in text for flag in result.flags)
    assert "flag" not in text.casefold()


def test_the_figure_says_in_words_what_it_shows(good: tuple[Grade, Submission]) -> None:
    text = report.student_page(*good)
    found = re.search(r"<desc>(.*?)</desc>", text)
    assert found
    for measured in good[0].recomputed.at:
        assert measured.std is not None
        assert f"{measured.distance_m:.2f} m: recomputed {measured.std.value:.3g}" in found[1]


def test_the_figures_points_lie_where_the_std_is(good: tuple[Grade, Submission]) -> None:
    text = report.student_page(*good).partition('class="key"')[0]
    y = [float(v) for v in re.findall(r'<circle cx="[\d.]+" cy="([\d.]+)"', text)]
    stds = [m.std.value for m in good[0].recomputed.at if m.std is not None]
    assert len(y) == 3
    slope = np.diff(y) / np.diff(stds)
    assert slope[0] == pytest.approx(slope[1], rel=0.01)
    assert slope[0] < 0  # up is more


def test_a_claim_off_the_scale_is_said_not_drawn(good: tuple[Grade, Submission]) -> None:
    wild = samples.with_row(good[1], 1, depth_std_mm=1e9, depth_bias_mm=-1e-9)
    text = report.student_page(grade(wild), wild)
    check_page(text)
    assert "Off the scale and not drawn: 1e+09 mm at 0.45 m." in text
    assert max(float(v) for v in re.findall(r'[xy][12]?="([\d.]+)"', text)) < 700


def test_a_page_without_depths_has_no_figure(good: tuple[Grade, Submission]) -> None:
    nothing = replace(good[1], stacks=())
    page = check_page(report.student_page(grade(nothing), nothing))
    assert "svg" not in {tag for tag, _ in page.tags}
    holes = Stack(0.3, (0, 0, 9, 9), np.zeros((5, 9, 9), np.uint16), np.arange(5.0))
    blind = replace(good[1], stacks=(holes,))
    check_page(report.student_page(grade(blind), blind))


@pytest.mark.parametrize("unit", [1e-7, 1e-3, 1.0])
@pytest.mark.parametrize("frames", [1, 2, 30])
def test_odd_depths_give_a_page(good: tuple[Grade, Submission], unit: float, frames: int) -> None:
    random = np.random.default_rng(frames)
    stacks = tuple(
        Stack(
            0.3 * (i + 1),
            (0, 0, 8, 8),
            random.integers(0, 65_535, (frames, 8, 8), np.uint16),
            np.arange(float(frames)),
        )
        for i in range(2)
    )
    camera = replace(good[1].camera, depth_scale_m=unit)
    odd = replace(good[1], stacks=stacks, camera=camera)
    text = report.student_page(grade(odd), odd)
    check_page(text)
    assert "nan" not in text.replace("nano", "")
    assert not re.search(r'="-?inf', text)


@pytest.mark.parametrize("text", samples.HOSTILE_TEXTS)
def test_a_students_text_stays_text(text: str) -> None:
    submission = samples.injecting(text)
    result = grade(submission)
    page = check_page(report.student_page(result, submission))
    assert text in page.text
    line = report.graded(text + ".zip", result, "students/x.html")
    assert text in check_page(report.class_page([line, report.not_graded(text, text, text)])).text


# --- the class page -------------------------------------------------------------------------------


def test_the_class_page_has_everything(lines: list[report.Line]) -> None:
    page = check_page(report.class_page(lines))
    assert "6 bundles graded, 1 not graded, 3 flagged." in page.text
    assert "zip_bomb" in page.text
    assert "sign of the bias turned (1)" in page.text
    assert "nearly identical" in page.text
    links = {attributes["href"] for tag, attributes in page.tags if tag == "a"}
    assert links == {f"students/{i}%20a.html" for i in range(6)}
    for line in lines:
        for flag in line.flags:
            assert flag.says in page.text


def test_a_flag_that_several_share_is_said_once(lines: list[report.Line]) -> None:
    copies = [flag for line in lines for flag in line.flags if flag.code == "nearly_identical"]
    assert len(copies) == 2
    assert report.class_page(lines).count(escape(copies[0].says)) == 1


def test_notes_are_no_suspicion(lines: list[report.Line]) -> None:
    noted = replace(lines[0], flags=(Flag("identical", "The same by right.", note=True),))
    text = report.class_page([noted])
    assert "0 flagged" in text
    assert "To look at" not in text
    assert "The same by right." in text


def test_an_empty_class_has_a_page() -> None:
    check_page(report.class_page([]))
    assert report.grades_csv([]).count("\n") == 1


def test_a_mistake_at_three_distances_is_one_students() -> None:
    submission = samples.mistaken(0)["sign"][1]
    for i in (0, 2):
        bias = submission.claims.rows[i].depth_bias_mm
        assert bias is not None
        submission = samples.with_row(submission, i, depth_bias_mm=-bias)
    line = report.graded("a.zip", grade(submission))
    assert "sign of the bias turned (1)" in report.class_page([line])


# --- the table ------------------------------------------------------------------------------------


def read(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_the_table_has_a_row_a_bundle_and_points_that_add_up(lines: list[report.Line]) -> None:
    rows = read(report.grades_csv(lines))
    assert len(rows) == len(lines)
    assert tuple(rows[0]) == report.HEADER
    for row, line in zip(rows, lines, strict=True):
        assert row["file"] == line.file
        if line.points is not None:
            assert sum(float(row[topic]) for topic in LABELS) == pytest.approx(line.points)
            assert float(row["points"]) == pytest.approx(line.points)
    assert rows[-1]["status"] == "not graded: zip_bomb"
    assert rows[-1]["points"] == ""
    assert rows[3]["flags"] == "no_pattern white_in_space"


@pytest.mark.parametrize(
    "text",
    ["=1+1", "+1", "-1", "@A1", "\t=1", "\r=1", "\n=1", " =1", "＝1", "=cmd|' /C calc'!A0"],
)
def test_a_cell_is_never_a_formula(text: str) -> None:
    line = report.Line(text, student=text, points=1.0, of=2.0)
    for row in read(report.grades_csv([line, report.not_graded(text, text, text)])):
        for cell in row.values():
            assert not cell.lstrip().startswith(report.FORMULA)
            assert "\n" not in cell


def test_an_ordinary_name_stays_as_it_is() -> None:
    name = 'Zoë "Z" O\'Neil-Żak, Jr.'
    row = read(report.grades_csv([report.Line("a.zip", student=name, points=1.0, of=2.0)]))[0]
    assert row["student"] == name
    assert row["percent"] == "50.0"


def test_a_line_goes_through_json(lines: list[report.Line]) -> None:
    back = [report.Line.from_dict(json.loads(json.dumps(line.to_dict()))) for line in lines]
    assert report.class_page(back) == report.class_page(lines)
    assert report.grades_csv(back) == report.grades_csv(lines)


def test_ink_on_paper_has_contrast() -> None:
    """WCAG AA: 4.5 to 1 for text."""

    def luminance(colour: str) -> float:
        digits = colour.lstrip("#")
        digits = "".join(2 * d for d in digits) if len(digits) == 3 else digits
        parts = [int(digits[i : i + 2], 16) / 255 for i in (0, 2, 4)]
        linear = [p / 12.92 if p <= 0.04045 else ((p + 0.055) / 1.055) ** 2.4 for p in parts]
        return float(np.dot(linear, (0.2126, 0.7152, 0.0722)))

    pairs = re.findall(r"\{ color: (#\w+); background: (#\w+);? \}", report.STYLE)
    pairs += [("#222", "#fff"), ("#595959", "#fff"), ("#00538a", "#fff"), ("#444", "#fff")]
    assert len(pairs) >= 8
    for ink, paper in pairs:
        dark, light = sorted((luminance(ink), luminance(paper)))
        assert (light + 0.05) / (dark + 0.05) >= 4.5, (ink, paper)
