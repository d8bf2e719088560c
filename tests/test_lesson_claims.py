"""Every row of data/claims.csv has one test, and what is corrected stands in data/corrections.md.

The tests of the rows are in test_lesson_claims_*.py, by notebook.
"""

import json
import re
from collections import Counter
from importlib import import_module
from pathlib import Path

import pytest
from lesson_claims import ROWS, TESTED, read_rows

from coursekit.specifications import DATA

NOTEBOOKS = Path(__file__).parents[1] / "notebooks"
FILES = sorted(Path(__file__).parent.glob("test_lesson_claims_*.py"))
MODULES = [import_module(path.stem) for path in FILES]
VERDICTS = ("right", "imprecise", "wrong")
# 1: id, 2: verdict; 3: the text up to the next entry
ENTRY = re.compile(r"^### ([A-Z]\d+) · [^\n]+ \((\w+)\)\n(.*?)(?=^##|\Z)", re.MULTILINE | re.DOTALL)
SHOWN = re.compile(r'^Shown in: notebook (\d\d), "(.+)"$', re.MULTILINE)
PAGE = (DATA / "corrections.md").read_text(encoding="utf-8")
ENTRIES = {name: (verdict, text) for name, verdict, text in ENTRY.findall(PAGE)}


# --- the table ---


def test_the_table_has_the_lessons_rows() -> None:
    assert len(read_rows()) == len(ROWS) == 53
    wanted = {"P": 12, "D": 16, "I": 8, "H": 7, "B": 10}
    assert set(ROWS) == {f"{letter}{k}" for letter, n in wanted.items() for k in range(1, n + 1)}
    for row in ROWS.values():
        assert row.verdict in VERDICTS
        assert row.notebook == f"0{1 + 'PDIHB'.index(row.id[0])}"
        assert row.lesson_claim
        assert row.lesson_value


def test_each_row_has_one_test_which_stands_for_its_verdict() -> None:
    assert Counter(name for name, *_ in TESTED) == Counter(list(ROWS))
    for name, verdict, test in TESTED:
        assert verdict == ROWS[name].verdict, test
        assert f".test_{name.lower()}_" in test


def test_the_tests_are_where_they_are_collected() -> None:
    names = [(module.__name__, name) for module in MODULES for name in vars(module)]
    found = {f"{module}.{name}" for module, name in names if name.startswith("test_")}
    assert found == {test for *_, test in TESTED}


# --- the page ---


def test_the_page_has_what_is_not_right_and_nothing_else() -> None:
    corrected = {name: row.verdict for name, row in ROWS.items() if row.verdict != "right"}
    assert {name: verdict for name, (verdict, _) in ENTRIES.items()} == corrected
    assert PAGE.count("\n### ") == len(ENTRIES)  # no heading that ENTRY does not understand
    right = sum(row.verdict == "right" for row in ROWS.values())
    assert f"{right} are right. These {len(corrected)} are not" in PAGE


@pytest.mark.parametrize("name", ENTRIES)
def test_an_entry_names_sections_that_exist(name: str) -> None:
    _, text = ENTRIES[name]
    shown = SHOWN.findall(text)
    assert shown
    assert len(shown) == text.count("Shown in")
    for number, heading in shown:
        assert number == ROWS[name].notebook
        assert heading in headings(number)


def headings(number: str) -> set[str]:
    """The headings of a notebook, of any level."""
    (path,) = NOTEBOOKS.glob(f"{number}_*.ipynb")
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    text = "\n".join("".join(c["source"]) for c in cells if c["cell_type"] == "markdown")
    return set(re.findall(r"^#+ (.+)$", text, re.MULTILINE))
