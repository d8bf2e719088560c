"""The pages and the table: complete, escaped, and readable without the figures."""

from __future__ import annotations

import csv
import io
import json
import re
from collections.abc import Iterable
from dataclasses import replace
from html import escape
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest
import sample_submissions as samples

from coursekit.submission import report
from coursekit.submission.flags import Flag, same_words
from coursekit.submission.format import Stack, Submission
from coursekit.submission.recompute import LABELS, MISTAKES
from coursekit.submission.rubric import Grade

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
ALLOWED |= {"details", "summary"}
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
    return samples.graded(submission), submission


def own_words(submission: Submission, seed: int) -> Submission:
    """With another paragraph for each seed."""
    random = np.random.default_rng(seed)
    said = " ".join(random.permutation(samples.PARAGRAPH.split()).tolist())
    return replace(submission, conclusion=replace(submission.conclusion, paragraph=said))


def said_by(student: str, paragraph: str, **more: Any) -> report.ReportLine:
    """A graded line with nothing but a paragraph."""
    fields = {"points": 1.0, "of": 2.0, "page": f"students/{student}.html"} | more
    return report.ReportLine(f"{student}.zip", student, paragraph=paragraph, **fields)


def notes(lines: Iterable[report.ReportLine], code: str) -> dict[str, str]:
    """What the flags of a kind say, by the bundle's name."""
    return {line.file: flag.says for line in lines for flag in line.flags if flag.code == code}


@pytest.fixture(scope="module")
def lines() -> list[report.ReportLine]:
    """A small class."""
    handed = [
        samples.honest(0),
        samples.weak(1),
        own_words(samples.copied(samples.honest(0), "few_values"), 1),
        own_words(samples.random_numbers(2), 2),
        samples.injecting('=HYPERLINK("http://x")<script>alert(1)</script>', 4),
        own_words(samples.mistaken(3)["sign"][1], 3),
    ]
    some = [
        report.graded(f"hand in/{i}.zip", samples.graded(s), s, f"students/{i} a.html")
        for i, s in enumerate(handed)
    ]
    some.append(report.not_graded("bad.zip", "zip_bomb", "It grows a thousand times."))
    return report.across(some)


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
    result = samples.graded(submission)
    text = report.student_page(result, submission)
    assert text.index("What cost points") < text.index("What is right")
    assert escape(next(i.says for i in result.items if i.mistake == "sign")) in text


def test_flags_are_not_on_the_students_page() -> None:
    submission = samples.random_numbers(0)
    result = samples.graded(submission)
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
    text = report.student_page(samples.graded(wild), wild)
    check_page(text)
    assert "Off the scale and not drawn: 1e+09 mm at 0.45 m." in text
    assert max(float(v) for v in re.findall(r'[xy][12]?="([\d.]+)"', text)) < 700


def test_a_page_without_depths_has_no_figure(good: tuple[Grade, Submission]) -> None:
    nothing = replace(good[1], stacks=())
    page = check_page(report.student_page(samples.graded(nothing), nothing))
    assert "svg" not in {tag for tag, _ in page.tags}
    holes = Stack(0.3, (0, 0, 9, 9), np.zeros((5, 9, 9), np.uint16), np.arange(5.0))
    blind = replace(good[1], stacks=(holes,))
    check_page(report.student_page(samples.graded(blind), blind))


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
    text = report.student_page(samples.graded(odd), odd)
    check_page(text)
    assert "nan" not in text.replace("nano", "")
    assert not re.search(r'="-?inf', text)


@pytest.mark.parametrize("text", samples.HOSTILE_TEXTS)
def test_a_students_text_stays_text(text: str) -> None:
    submission = samples.injecting(text)
    result = samples.graded(submission)
    page = check_page(report.student_page(result, submission))
    assert text in page.text
    line = report.graded(text + ".zip", result, submission, "students/x.html")
    some = [line, report.not_graded(text, text, text)]
    assert text in check_page(report.class_page(some)).text
    assert text in check_page(report.paragraphs_page(some)).text


# --- the class page -------------------------------------------------------------------------------


def test_the_class_page_has_everything(lines: list[report.ReportLine]) -> None:
    page = check_page(report.class_page(lines))
    assert "6 bundles graded, 1 not graded, 3 flagged." in page.text
    assert "zip_bomb" in page.text
    assert "sign of the bias turned (1)" in page.text
    assert "nearly identical" in page.text
    links = {attributes["href"] for tag, attributes in page.tags if tag == "a"}
    assert links == {f"students/{i}%20a.html" for i in range(6)} | {"paragraphs.html"}
    for line in lines:
        for flag in line.flags:
            assert flag.says in page.text


def test_a_flag_that_several_share_is_said_once(lines: list[report.ReportLine]) -> None:
    copies = [flag for line in lines for flag in line.flags if flag.code == "nearly_identical"]
    assert len(copies) == 2
    assert report.class_page(lines).count(escape(copies[0].says)) == 1


def test_notes_are_no_suspicion(lines: list[report.ReportLine]) -> None:
    noted = replace(lines[0], flags=(Flag("identical", "The same by right.", note=True),))
    text = report.class_page([noted])
    assert "0 flagged" in text
    assert "To look at" not in text
    assert "The same by right." in text


def test_an_empty_class_has_a_page() -> None:
    check_page(report.class_page(report.across([])))
    check_page(report.paragraphs_page([]))
    assert report.grades_csv([]).count("\n") == 1


def test_a_mistake_at_three_distances_is_one_students() -> None:
    submission = samples.mistaken(0)["sign"][1]
    for i in (0, 2):
        bias = submission.claims.rows[i].depth_bias_mm
        assert bias is not None
        submission = samples.with_row(submission, i, depth_bias_mm=-bias)
    line = report.graded("a.zip", samples.graded(submission), submission)
    assert "sign of the bias turned (1)" in report.class_page([line])


def test_everybody_with_a_mistake_is_named_and_linked() -> None:
    wrong = samples.mistaken(0)["sign"][1]
    result = samples.graded(wrong)
    one = report.graded("0.zip", result, wrong, "students/0.html")
    many = [
        replace(one, file=f"{i}.zip", student=f"Student {i}", page=f"students/{i}.html")
        for i in range(20)
    ]
    text = report.class_page(many)
    check_page(text)
    cell = text.partition("sign of the bias turned (20): ")[2].partition("</div>")[0]
    shown, _, more = cell.partition("<details><summary>and 8 more</summary>")
    assert shown.count("<a href=") == 12
    assert more.count("<a href=") == 8
    assert all(f'<a href="students/{i}.html">Student {i}</a>' in cell for i in range(20))


def test_every_mistake_is_on_the_page_not_the_most_frequent_alone() -> None:
    kinds = [key for key, (topic, _) in samples.mistaken(0).items() if topic in ("bias", "std")]
    some = []
    for kind in kinds:
        wrong = samples.mistaken(0)[kind][1]
        some.append(report.graded(f"{kind}.zip", samples.graded(wrong), wrong))
    text = check_page(report.class_page(some)).text
    for line in some:
        for item in line.items:
            if item.mistake:
                assert MISTAKES[item.mistake] in text


def test_everybody_is_by_points_and_by_name(lines: list[report.ReportLine]) -> None:
    text = report.class_page(lines)
    ranked, named = text.partition("Everybody, lowest points first")[2].split("Everybody by name")
    done = [line for line in lines if line.points is not None]
    for part, key in ((ranked, lambda a: a.percent), (named, lambda a: a.student.casefold())):
        order = [part.index(f'href="students/{i}%20a.html"') for i in range(6)]
        keys = [key(done[i]) for i in np.argsort(order)]
        assert keys == sorted(keys)


def test_a_student_counts_once_with_the_newest_bundle() -> None:
    moments = (
        "2026-03-02T10:00:00+00:00",
        "2026-03-04T10:00:00+00:00",
        "2026-03-03T23:00:00-05:00",
    )
    names = ("Ann  Lee", "ann lee ", "ANN\u00a0LEE")
    points = (75.25, 90.0, 80.0)
    some = [
        replace(said_by(name, "", made=made, points=p, of=100.0), file=f"{i}.zip")
        for i, (name, made, p) in enumerate(zip(names, moments, points, strict=True))
    ]
    other = said_by("Bob", "", made=moments[0], points=10.0, of=100.0)
    found = report.across([*some, other, report.not_graded("x.zip", "truncated", "Half of it.")])
    assert [line.counts for line in found] == [False, True, False, True, True]
    page = check_page(report.class_page(found))
    assert "4 bundles graded, 1 not graded, 0 flagged." in page.text
    assert "They are of 2 students, whose newest counts." in page.text
    assert "Median 50 % of the points, from 10 to 90 %." in page.text
    assert "An earlier bundle of ann lee" in page.text
    assert "75.25 points; 1.zip counts, 90 points." in page.text
    everybody = report.class_page(found).partition("Everybody, lowest")[2]
    assert [f">{i}.zip<" in everybody for i in range(3)] == [False, True, False]
    rows = read(report.grades_csv(found))
    assert [row["counts"] for row in rows] == ["no", "yes", "no", "yes", "no"]
    assert [row["points"] for row in rows] == ["75.25", "90", "80", "10", ""]


def test_of_bundles_made_at_the_same_moment_the_first_counts() -> None:
    some = [replace(said_by("Ann", "", made=samples.MADE), file=f"{i}.zip") for i in range(3)]
    assert [line.counts for line in report.across(some)] == [True, False, False]


# --- words that are shared, and all paragraphs ----------------------------------------------------


def test_the_same_words_are_a_flag_though_the_data_may_be_the_same() -> None:
    """25 simulations: the same data by right, the same words not."""
    of_camera = {"source": "simulated", "name": "Simulated D435", "serial": "seed-0"}
    one = samples.honest(0, 20, of_camera)
    line = report.graded("0.zip", samples.graded(one), one)
    line = replace(line, flags=())
    some = [replace(line, file=f"{i}.zip", student=f"Student {i}") for i in range(25)]
    prints = line.fingerprint
    assert prints is not None
    some = [replace(a, fingerprint=replace(prints, student=a.student)) for a in some]
    some[3] = replace(some[3], paragraph=own_words(one, 3).conclusion.paragraph)
    some[4] = replace(some[4], paragraph=some[4].paragraph.upper().replace(".", " !"))
    found = report.across(some)
    assert all(flag.note for a in found for flag in a.flags if flag.code == "identical")
    flags = notes(found, "same_words")
    assert set(flags) == {f"{i}.zip" for i in range(25)} - {"3.zip"}
    assert "The paragraphs of 24 students have the same words: “I will mount" in flags["0.zip"]
    assert "To look at" in report.class_page(found)


def test_a_few_changed_words_and_added_sentences_are_noticed() -> None:
    changed = samples.PARAGRAPH.replace("one pixel", "each pixel").replace("thirty", "30")
    longer = samples.PARAGRAPH + " " + "I measured all of it on Tuesday with the lamp on. " * 2
    for other in (changed, longer):
        found = report.across([said_by("Ann", samples.PARAGRAPH), said_by("Bob", other)])
        flags = notes(found, "same_words")
        assert set(flags) == {"Ann.zip", "Bob.zip"}
        assert "nearly the same words" in flags["Ann.zip"]


@pytest.mark.parametrize(
    ("one", "two"),
    [
        ("", ""),
        ("The bias dominates, I think.", "The bias dominates, I think."),
        (
            samples.PARAGRAPH,
            "At 0.45 m the bias dominates: averaging thirty frames leaves a tenth of a millimetre "
            "of noise, but the bias is larger than that and stays, so I will calibrate the camera.",
        ),
    ],
)
def test_short_paragraphs_and_own_words_are_no_flag(one: str, two: str) -> None:
    found = report.across([said_by("Ann", one), said_by("Bob", two)])
    assert notes(found, "same_words") == {}


def test_one_student_may_say_it_again() -> None:
    found = report.across([said_by("Ann", samples.PARAGRAPH), said_by(" ANN", samples.PARAGRAPH)])
    assert notes(found, "same_words") == {}


def test_many_paragraphs_are_compared() -> None:
    random = np.random.default_rng(0)
    vocabulary = [f"word{i}" for i in range(300)]
    said = {str(i): (str(i), " ".join(random.choice(vocabulary, 100).tolist())) for i in range(900)}
    said |= {str(i): (str(i), f"{said['0'][1]} and {i}") for i in range(900, 1000)}
    found = same_words(said)
    assert [set(one.keys) for one in found] == [{"0", *(str(i) for i in range(900, 1000))}]


def test_twins_of_a_bundle_with_a_near_copy_are_all_flagged() -> None:
    one = samples.honest(0)
    near = samples.copied(one, "few_values")
    handed = {"a.zip": one, "b.zip": replace(one, student="Twin"), "c.zip": near}
    some = [report.graded(file, samples.graded(s), s) for file, s in handed.items()]
    found = report.across(some)
    assert set(notes(found, "identical")) == {"a.zip", "b.zip"}
    assert set(notes(found, "nearly_identical")) == set(handed)
    assert "(a.zip, b.zip, c.zip)" in notes(found, "nearly_identical")["b.zip"]


def test_all_paragraphs_are_on_a_page_with_name_and_link(lines: list[report.ReportLine]) -> None:
    earlier = replace(said_by("Old", "words of old"), counts=False)
    silent = said_by("Silent", "  ")
    text = report.paragraphs_page([*lines, earlier, silent])
    page = check_page(text)
    for line in lines:
        if line.points is not None:
            assert line.paragraph.strip() in page.text
            assert line.student in page.text
            assert f'href="{line.page.replace(" ", "%20")}"' in text
    assert "6 paragraphs, by name." in page.text
    assert 'No paragraph: <a href="students/Silent.html">Silent</a>' in text
    assert "words of old" not in page.text
    assert text.count("shares its words") == 0
    shared = report.across([said_by("Ann", samples.PARAGRAPH), said_by("Bob", samples.PARAGRAPH)])
    assert report.paragraphs_page(shared).count("shares its words") == 2


# --- the table ------------------------------------------------------------------------------------


def read(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


def test_the_table_has_a_row_a_bundle_and_points_that_add_up(
    lines: list[report.ReportLine],
) -> None:
    rows = read(report.grades_csv(lines))
    assert len(rows) == len(lines)
    assert tuple(rows[0]) == report.HEADER
    for row, line in zip(rows, lines, strict=True):
        assert row["file"] == line.file
        if line.points is not None:
            assert sum(float(row[topic]) for topic in LABELS) == pytest.approx(line.points)
            assert float(row["points"]) == pytest.approx(line.points)
            lost = [item for item in line.items if item.points < item.of]
            assert row["lost"].count("; ") == max(len(lost) - 1, 0)
            assert all(item.name in row["lost"] for item in lost)
    assert rows[0]["lost"] == ""
    assert ": sign of the bias turned (-" in rows[5]["lost"]
    assert rows[-1]["status"] == "not graded: zip_bomb"
    assert rows[-1]["points"] == ""
    assert rows[3]["flags"] == "no_pattern white_in_space"


@pytest.mark.parametrize(
    "text",
    ["=1+1", "+1", "-1", "@A1", "\t=1", "\r=1", "\n=1", " =1", "＝1", "=cmd|' /C calc'!A0"],
)
def test_a_cell_is_never_a_formula(text: str) -> None:
    line = report.ReportLine(text, student=text, points=1.0, of=2.0)
    for row in read(report.grades_csv([line, report.not_graded(text, text, text)])):
        for cell in row.values():
            assert not cell.lstrip().startswith(report.FORMULA)
            assert "\n" not in cell


def test_an_ordinary_name_stays_as_it_is() -> None:
    name = 'Zoë "Z" O\'Neil-Żak, Jr.'
    row = read(report.grades_csv([report.ReportLine("a.zip", student=name, points=1.0, of=2.0)]))[0]
    assert row["student"] == name
    assert row["percent"] == "50.0"


def test_a_line_goes_through_json(lines: list[report.ReportLine]) -> None:
    back = [report.ReportLine.from_dict(json.loads(json.dumps(line.to_dict()))) for line in lines]
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

    style = (report.HERE / "report.css").read_text(encoding="utf-8")
    pairs = re.findall(r"\{ color: (#\w+); background: (#\w+);? \}", style)
    pairs += [("#222", "#fff"), ("#595959", "#fff"), ("#00538a", "#fff"), ("#444", "#fff")]
    assert len(pairs) >= 8
    for ink, paper in pairs:
        dark, light = sorted((luminance(ink), luminance(paper)))
        assert (light + 0.05) / (dark + 0.05) >= 4.5, (ink, paper)
