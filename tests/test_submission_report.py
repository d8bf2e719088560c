"""The pages and the table: complete, escaped, and readable without the figures."""

import csv
import io
import json
import re
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from html import escape
from html.parser import HTMLParser

import numpy as np
import pytest
import sample_submissions as samples
from common import EXPECTED, contrast
from hostile_bundles import BUNDLES
from sample_submissions import PARAGRAPH, honest, with_part, with_row

from coursekit.submission import report
from coursekit.submission.flags import Flag, as_json, same_words, words_of
from coursekit.submission.format import Stack, Submission
from coursekit.submission.recompute import LABELS, MISTAKES

VOID = {"meta", "br", "img", "hr", "input", "link"}
GOOD = honest(0)
WRONG = samples.mistaken(0)
INVENTED = samples.made_up(samples.INVENTIONS["a pixel"], 2)


class Page(HTMLParser):
    """The elements of a page and all that is not markup; fails where they are not nested."""

    def __init__(self, text: str):
        super().__init__(convert_charrefs=True)
        self.tags, self.text, self._open = [], "", []
        self.feed(text)
        self.close()
        assert self._open == []

    def handle_starttag(self, tag, attrs):
        self.handle_startendtag(tag, attrs)
        if tag not in VOID:
            self._open.append(tag)

    def handle_startendtag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        self.text += data + " "


ALLOWED = set(EXPECTED["allowed_elements"])


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


def page_of(submission: Submission) -> str:
    """A student's page, which is well nested and has no figure that is infinite or unknown."""
    body = report.page_body(samples.graded(submission), submission)
    text = report.student_page(line_of(submission), body)
    check_page(text)
    assert "nan" not in text.replace("nano", "")
    assert not re.search(r'="-?inf', text)
    return text


def line_of(submission: Submission, file: str = "a.zip", page: str = "") -> report.ReportLine:
    """The line of a graded submission."""
    return replace(report.graded(file, samples.graded(submission), submission), page=page)


def own_words(submission: Submission, seed: int) -> Submission:
    """With another paragraph for each seed."""
    words = np.random.default_rng(seed).permutation(PARAGRAPH.split()).tolist()
    return with_part(submission, "conclusion", paragraph=" ".join(words))


def said_by(student: str, paragraph: str, **more) -> report.ReportLine:
    """A graded line with nothing but a paragraph."""
    fields = {"points": 1.0, "of": 2.0, "page": f"students/{student}.html"} | more
    return report.ReportLine(f"{student}.zip", student, paragraph=paragraph, **fields)


def notes(lines, code: str) -> dict[str, str]:
    """What the flags of a kind say, by the bundle's name."""
    return {line.file: flag.says for line in lines for flag in line.flags if flag.code == code}


@pytest.fixture(scope="module")
def lines():
    """A small class."""
    handed = [
        GOOD,
        samples.weak(1),
        own_words(samples.copied(GOOD, "few_values"), 1),
        own_words(INVENTED, 2),
        samples.injecting('=HYPERLINK("http://x")<script>alert(1)</script>', 4),
        own_words(replace(WRONG["sign"][1], student="Student 3"), 3),
    ]
    some = [line_of(s, f"hand in/{i}.zip", f"students/{i} a.html") for i, s in enumerate(handed)]
    refused = report.not_graded("bad.zip", "zip_bomb", "It grows a thousand times.")
    return report.across([*some, refused])


# --- the student's page ---------------------------------------------------------------------------


def test_a_students_page_has_every_item_and_the_points():
    page = check_page(page_of(GOOD))
    assert "100 of 100 points." in page.text
    assert all(item.says in page.text for item in samples.items(GOOD))
    assert PARAGRAPH in page.text
    assert "depth_noise.twice_as_far" in page.text


def test_what_cost_points_comes_first():
    text = page_of(WRONG["sign"][1])
    assert text.index("What cost points") < text.index("What is right")
    (sign,) = [item for item in samples.items(WRONG["sign"][1]) if item.mistake == "sign"]
    assert escape(sign.says) in text


def test_flags_are_not_on_the_students_page():
    assert (flags := samples.graded(INVENTED).flags)
    text = page_of(INVENTED)
    assert not any(escape(flag.says) in text or flag.code in text for flag in flags)
    assert "flag" not in text.casefold()


def test_the_figure_shows_the_std_and_says_it_in_words():
    text = page_of(GOOD).partition('class="key"')[0]
    words = re.search(r"<desc>(.*?)</desc>", text)[1]
    at = samples.graded(GOOD).recomputed.at
    for m in at:
        assert f"{m.distance_m:.2f} m: recomputed {m.std.value:.3g}" in words
    y = [float(v) for v in re.findall(r'<circle cx="[\d.]+" cy="([\d.]+)"', text)]
    slope = np.diff(y) / np.diff([m.std.value for m in at])
    assert slope == pytest.approx([min(slope[0], 0)] * 2, rel=0.01)  # up is more
    assert text.count("h8M") == sum(-4 * m.std.se * slope[0] > 9 for m in at)  # not in the marker


def test_a_claim_off_the_scale_is_said_not_drawn():
    guessed = samples.predicting(GOOD, 99)
    text = page_of(with_row(guessed, 1, depth_std_mm=1e9, depth_bias_mm=-1e-9))
    assert "not drawn: of your table 1e+09 mm at 0.45 m; of your prediction 21.4 mm at 0.3" in text
    assert "your prediction</span>" not in text
    assert max(float(v) for v in re.findall(r'[xy][12]?="([\d.]+)"', text)) < 700


def test_a_page_without_depths_has_no_figure():
    assert "<svg" not in page_of(replace(GOOD, stacks=()))
    holes = Stack(0.3, (0, 0, 9, 9), np.zeros((5, 9, 9), np.uint16), np.arange(5.0))
    page_of(replace(GOOD, stacks=(holes,)))


@pytest.mark.parametrize("unit", [1e-7, 1e-3, 1.0])
@pytest.mark.parametrize("frames", [1, 2, 30])
def test_odd_depths_give_a_page(unit, frames):
    counts = np.random.default_rng(frames).integers(0, 65_535, (2, frames, 8, 8), np.uint16)
    window, times = (0, 0, 8, 8), np.arange(float(frames))
    stacks = (Stack(0.3, window, counts[0], times), Stack(0.6, window, counts[1], times))
    page_of(with_part(replace(GOOD, stacks=stacks), "camera", depth_scale_m=unit))


@pytest.mark.parametrize("text", BUNDLES["hostile_texts"])
def test_a_students_text_stays_text(text):
    submission = samples.injecting(text)
    some = [line_of(submission, text + ".zip", "x.html"), report.not_graded(text, text, text)]
    for page in (page_of(submission), report.class_page(some), report.paragraphs_page(some)):
        assert text in check_page(page).text


# --- the class page -------------------------------------------------------------------------------


def test_the_class_page_has_everything(lines):
    page = check_page(report.class_page(lines))
    assert "6 bundles graded, 1 not graded, 3 flagged." in page.text
    assert "It grows a thousand times." in page.text
    assert "sign of the bias turned (1)" in page.text
    assert "nearly identical" in page.text
    links = {attributes["href"] for tag, attributes in page.tags if tag == "a"}
    pages = {f"students/{i}%20a.html" for i in range(6)}
    assert links == pages | {"paragraphs.html", "second_marker.html"}
    for line in lines:
        for flag in line.flags:
            assert flag.says in page.text


def test_a_flag_that_several_share_is_said_once(lines):
    shared, _ = notes(lines, "nearly_identical").values()
    assert report.class_page(lines).count(escape(shared)) == 1


def test_notes_are_no_suspicion(lines):
    noted = replace(lines[0], flags=(Flag("identical", "The same by right.", note=True),))
    text = report.class_page([noted])
    assert "0 flagged" in text
    assert "To look at" not in text
    assert "The same by right." in text


def test_an_empty_class_has_a_page():
    check_page(report.class_page(report.across([])))
    check_page(report.paragraphs_page([]))
    assert report.grades_csv([]).count("\n") == 1


def test_points_are_those_that_the_instructor_gave():
    text = report.class_page([line_of(GOOD), replace(line_of(GOOD, "b"), own={"overrule": "12,5"})])
    assert "Median 56.25 % of the points, from 12.5 to 100 %." in text
    assert "Students by points: 1 from 10 to 20 %, 1 from 90 to 100 %." in text


def test_everybody_with_a_mistake_is_named_and_linked_once():
    """Though it was made at three distances."""
    wrong = WRONG["sign"][1]
    for i in (0, 2):
        wrong = with_row(wrong, i, depth_bias_mm=-wrong.claims.rows[i].depth_bias_mm)
    one = line_of(wrong)
    many = [replace(one, student=f"Student {i}", page=f"students/{i}.html") for i in range(20)]
    text = report.class_page(many)
    check_page(text)
    cell = text.partition("sign of the bias turned (20): ")[2].partition("</div>")[0]
    shown, _, more = cell.partition("<details><summary>and 8 more</summary>")
    assert (shown.count("<a href="), more.count("<a href=")) == (12, 8)
    assert all(f'<a href="students/{i}.html">Student {i}</a>' in cell for i in range(20))


def test_every_mistake_is_on_the_page_not_the_most_frequent_alone():
    some = [line_of(wrong) for topic, wrong in WRONG.values() if topic in ("bias", "std")]
    mistakes = {item.mistake for line in some for item in line.items if item.mistake}
    assert len(mistakes) > 10
    text = check_page(report.class_page(some)).text
    assert all(MISTAKES[mistake] in text for mistake in mistakes)


def test_what_most_got_wrong_comes_first_and_what_is_left_out_is_no_mistake():
    wrong = {topic: line_of(one) for topic, one in WRONG.values() if topic in ("bias", "std")}
    left_out = line_of(replace(GOOD, student="Silent", stacks=(), plot=None), "silent.zip")
    text = check_page(report.class_page([wrong["std"], *[wrong["bias"]] * 2, left_out])).text
    assert "What went wrong, and with how many of 4 students" in text
    assert re.findall(r"\d+ \(\d+ %\)", text) == ["2 (50 %)", "1 (25 %)"]  # bias, then std
    table, _, rest = text.partition("Answers that are missing, in no row above:")
    assert "Silent" not in table.partition("What went wrong")[2]
    assert "Silent" in rest.partition("Everybody")[0]


def test_everybody_is_by_points_and_by_name(lines):
    text = report.class_page(lines)
    ranked, named = text.partition("Everybody, lowest points first")[2].split("Everybody by name")
    for part, key in ((ranked, lambda a: a.percent), (named, lambda a: words_of(a.student))):
        order = [part.index(f'href="students/{i}%20a.html"') for i in range(6)]
        keys = [key(lines[i]) for i in np.argsort(order)]
        assert keys == sorted(keys)


def test_a_student_counts_once_with_the_newest_bundle():
    some = [
        replace(said_by(name, "", made=made, points=points, of=100.0), file=f"{i}.zip")
        for i, (name, made, points) in enumerate(EXPECTED["handed_in_twice"])
    ]
    found = report.across([*some, report.not_graded("x.zip", "truncated", "Half of it.")])
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


# --- words that are shared, and all paragraphs ----------------------------------------------------


def test_the_same_words_are_a_flag_though_the_data_may_be_the_same():
    """25 simulations: the same data by right, the same words not."""
    one = honest(0, 20, samples.SIMULATED)
    texts = {3: own_words(one, 3).conclusion.paragraph, 4: PARAGRAPH.upper().replace(".", " !")}
    some = []
    for i in range(25):
        own = with_part(one, "conclusion", paragraph=texts.get(i, PARAGRAPH))
        some.append(replace(line_of(replace(own, student=str(i)), f"{i}.zip"), flags=()))
    found = report.across(some)
    assert all(flag.note for a in found for flag in a.flags if flag.code == "identical")
    flags = notes(found, "same_words")
    assert set(flags) == {f"{i}.zip" for i in range(25)} - {"3.zip"}
    assert "The paragraphs of 24 students have the same words: “I will mount" in flags["0.zip"]
    assert "To look at" in report.class_page(found)


CHANGED = PARAGRAPH.replace("one pixel", "each pixel").replace("thirty", "30")
LONGER = PARAGRAPH + " " + "I measured all of it on Tuesday with the lamp on. " * 2
SHORT = "The bias dominates, I think."
OWN = EXPECTED["paragraphs"]["own"]
PAIRS = [
    pytest.param(PARAGRAPH, CHANGED, "nearly the same words", id="a few words changed"),
    pytest.param(PARAGRAPH, LONGER, "nearly the same words", id="sentences added"),
    pytest.param("", "", "", id="nothing"),
    pytest.param(SHORT, SHORT, "", id="short"),
    pytest.param(PARAGRAPH, OWN, "", id="own words"),
]


@pytest.mark.parametrize(("one", "two", "said"), PAIRS)
def test_changed_words_and_added_sentences_are_noticed_short_and_own_ones_not(one, two, said):
    flags = notes(report.across([said_by("Ann", one), said_by("Bob", two)]), "same_words")
    assert set(flags) == ({"Ann.zip", "Bob.zip"} if said else set())
    assert said in flags.get("Ann.zip", "")


def test_many_paragraphs_are_compared():
    random = np.random.default_rng(0)
    vocabulary = [f"word{i}" for i in range(300)]
    said = {str(i): (str(i), " ".join(random.choice(vocabulary, 100).tolist())) for i in range(900)}
    said |= {str(i): (str(i), f"{said['0'][1]} and {i}") for i in range(900, 1000)}
    found = same_words(said)
    assert [set(one.keys) for one in found] == [{"0", *(str(i) for i in range(900, 1000))}]


def test_twins_of_a_bundle_with_a_near_copy_are_all_flagged():
    near = samples.copied(GOOD, "few_values")
    handed = {"a.zip": GOOD, "b.zip": replace(GOOD, student="Twin"), "c.zip": near}
    found = report.across([line_of(submission, file) for file, submission in handed.items()])
    assert set(notes(found, "nearly_identical")) == set(handed)
    (row,) = re.findall("<tr><td>(.*?)</td><td>nearly identical</td>", report.class_page(found))
    assert row.split("; ") == ["Student 0", "Twin", "Copying Student"]


@pytest.mark.parametrize(("serial", "foreign", "said"), EXPECTED["units"])
def test_one_file_under_two_names_is_to_look_at_and_so_is_another_unit(serial, foreign, said):
    one = line_of(honest(0, 20, samples.SIMULATED | {"serial": serial}))
    places = [f"{name}_{i}_assignsubmission_file_/s.zip" for i, name in enumerate(("Ann", "Bo"))]
    found = report.across([replace(one, file=place, flags=()) for place in places])
    assert set(notes(found, "same_file")) == set(places)
    assert [*notes(found, "another_unit")] == [places[i] for i in foreign]
    assert all(said in text for text in notes(found, "identical").values())
    assert "One file from 2 students: all are packed as Student 0, " in report.class_page(found)
    assert ">Ann; Bo</td><td>same file</td>" in report.class_page(found)


@pytest.mark.parametrize(("handed", "typed", "known"), EXPECTED["names_in_other_ways"])
def test_a_name_written_in_another_way_is_not_held_against_anybody(handed, typed, known):
    first = " ".join(reversed(known.split(", ")))
    line = replace(line_of(GOOD), student=typed, file=handed)
    (same,) = report.across([line], report.Roster([{"name": known}]))
    text = report.student_page(same, "")
    assert f"Studio exercise 1: {first}" in check_page(text).text
    assert "The name in the file is" not in text
    (other,) = report.across([replace(line, student="Eve")], report.Roster([{"name": known}]))
    assert "The name in the file is Eve." in report.student_page(other, "")


def test_the_students_page_says_what_the_instructor_set():
    line = line_of(WRONG["sign"][1])
    own = {"paragraph": "1", "late": "-10"}
    text = report.student_page(replace(line, own=own), "")
    said = "Points that your instructor set: 1 for the paragraph, in place of 2; -10 for late days."
    assert f"{said} Computed were {line.points:g} of 100 points" in text
    assert "cost some" in text
    assert replace(line, own={"late": "-100"}).total == 0
    text = report.student_page(replace(line, own={"overrule": "75"}), "")
    assert "<strong>75 of 100 points." in text
    assert "Your instructor set the total. Computed were" in text
    assert "cost some" not in text


@pytest.mark.parametrize(("after", "said"), EXPECTED["late_min"])
def test_late_is_said_to_the_minute_not_rounded_up(after, said):
    due = datetime(2026, 3, 2, 12, tzinfo=UTC)
    line = replace(line_of(GOOD), made=(due + timedelta(minutes=after)).isoformat())
    (late,) = report.across([line], late_after=due)
    assert late.late.endswith(f": {said} late")


def test_whoever_hands_in_an_essay_reads_which_file_and_what_is_wanted():
    line = report.not_graded("Bo_17_assignsubmission_file_/e.docx", "no_bundle", files="e.docx")
    text = report.student_page(line, "")
    assert "Your file e.docx could not be graded, so hand in another." in text
    assert "Wanted is the .zip" in text


def test_all_paragraphs_are_on_a_page_with_name_and_link(lines):
    earlier = replace(said_by("Old", "words of old"), counts=False)
    text = report.paragraphs_page([*lines, earlier, said_by("Silent", "  ")])
    page = check_page(text)
    for line in lines[:-1]:
        assert line.paragraph.strip() in page.text
        assert line.student in page.text
        assert f'href="{line.page.replace(" ", "%20")}"' in text
    assert "6 paragraphs, by name, worth 2 points each." in page.text
    assert 'No paragraph: <a href="students/Silent.html">Silent</a>' in text
    assert "words of old" not in page.text
    assert text.count("shares its words") == 0
    twins = [replace(line, name="Ann", who=f"number {i}") for i, line in enumerate(lines[:2])]
    assert "</a> (number 0)</h2>" in report.paragraphs_page(twins)
    shared = report.across([said_by("Ann", PARAGRAPH), said_by("Bob", PARAGRAPH)])
    assert report.paragraphs_page(shared).count("shares its words") == 2
    assert report.paragraphs_page(shared, named=False).count("shares its words") == 0  # no bias
    verdict = next(item for item in lines[0].items if item.topic == "verdict")
    assert verdict.says.startswith("Bias or noise: you say ")
    assert verdict.says in page.text  # what was chosen, beside the paragraph that argues for it


def test_a_second_marker_finds_the_row_to_write_into(lines):
    rows = read(report.own_table(lines))
    codes = re.findall("<h2>(p[0-9a-f]{6})</h2>", report.paragraphs_page(lines, named=False))
    assert len(codes) == len(set(codes)) == 6
    those = {row["student"].removeprefix("'") for row in rows if row["code"] in codes}
    assert those == {line.name for line in lines[:-1]}


# --- the table ------------------------------------------------------------------------------------


def read(text: str) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(text)))


@pytest.mark.parametrize(("most", "other"), [("", 0), ("100,00", 0), ("50", 1), ("1.000,00", 1)])
def test_a_worksheet_of_other_points_is_told(lines, most, other):
    row = {"Identifier": "Participant 17", "Maximum grade": most}
    assert len(report.exports([replace(lines[0], row=row)])[1]) == other


def test_the_table_has_a_row_a_bundle_and_points_that_add_up(lines):
    rows = read(report.grades_csv(lines))
    assert tuple(rows[0]) == report.HEADER
    assert [row["file"] for row in rows] == [line.file for line in lines]
    for row, line in zip(rows[:-1], lines[:-1], strict=True):
        assert sum(float(row[topic]) for topic in LABELS) == pytest.approx(line.points)
        assert float(row["points"]) == pytest.approx(line.points)
        lost = [item for item in line.items if item.points < item.of]
        assert row["lost"].count("; ") == max(len(lost) - 1, 0)
        assert all(item.name in row["lost"] for item in lost)
    assert rows[0]["lost"] == ""
    assert ": sign of the bias turned (-" in rows[5]["lost"]
    assert (rows[-1]["status"], rows[-1]["points"]) == ("not graded: zip_bomb", "")
    assert rows[3]["flags"] == "even_noise no_pattern white_in_space"


FORMULAS = ["=1+1", "+1", "-1", "@A1", "\t=1", "\r=1", "\n=1", " =1", "＝1", "=cmd|' /C calc'!A0"]


@pytest.mark.parametrize("text", FORMULAS)
def test_a_cell_is_never_a_formula(text):
    line = report.ReportLine(text, student=text, points=1.0, of=2.0)
    for row in read(report.grades_csv([line, report.not_graded(text, text, text)])):
        for cell in row.values():
            assert not cell.lstrip().startswith(report.FORMULA)
            assert "\n" not in cell


def test_a_line_goes_through_json(lines):
    back = [report.ReportLine.from_dict(json.loads(as_json(line))) for line in lines]
    assert report.class_page(back) == report.class_page(lines)
    assert report.grades_csv(back) == report.grades_csv(lines)


def test_ink_on_paper_has_contrast():
    """WCAG AA: 4.5 to 1 for text."""
    style = (report.HERE / "report.css").read_text(encoding="utf-8")
    pairs = re.findall(r"\{ color: (#\w+); background: (#\w+);? \}", style)
    pairs += [(ink, "#fff") for ink in ("#222", "#595959", "#00538a", "#444")]
    assert len(pairs) >= 8
    for ink, paper in pairs:
        assert contrast(ink, paper) >= 4.5, (ink, paper)
