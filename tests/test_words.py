"""What a reader of findings sees."""

import ast
import string
from pathlib import Path

import pytest
from common import EXPECTED

from coursekit import doctor, words
from coursekit.words import Finding, Findings

BOW = Finding("bowed_board", "The board is <not> flat.", "0.51 ± 0.04 mm", "Use glass.", 1e-9)
FEW = Finding("few_views", "Too few views.", "4 views", "Take more.")


def test_findings_are_a_sequence_with_names() -> None:
    findings = Findings([BOW, FEW], ["a bowed board"], ["a wrong square size; use a ruler."])
    assert findings.names == ("bowed_board", "few_views")
    assert len(findings) == 2
    assert findings[1] is FEW
    assert BOW in findings
    tail = findings[1:]
    assert isinstance(tail, Findings)
    assert tail.names == ("few_views",)
    assert tail.looked_for == findings.looked_for
    assert tail.not_tested == findings.not_tested


def test_each_finding_shows_what_it_is_its_evidence_and_its_remedy() -> None:
    text = repr(Findings([BOW, FEW], ["a bowed board"]))
    assert text.startswith("2 findings.")
    for part in ("1. Bowed board", "0.51 ± 0.04 mm", "What to do: Use glass.", "2. Few views"):
        assert part in text
    assert max(map(len, text.splitlines())) <= 92


def test_nothing_found_says_what_was_looked_for_and_what_was_not_tested() -> None:
    text = repr(Findings([], ["a bowed board", "blur"], ["a wrong square size; use a ruler."]))
    assert text.splitlines() == EXPECTED["nothing_found"]
    assert not Findings()


def test_the_html_is_escaped_and_has_the_same_words() -> None:
    html = Findings([BOW], ["a bowed board"])._repr_html_()
    assert "The board is &lt;not&gt; flat." in html
    assert "<not>" not in html
    for part in ("1 finding.", "Bowed board", "0.51 ± 0.04 mm", "Use glass.", "Looked for"):
        assert part in html
    assert "<li>" not in Findings()._repr_html_()


PACKAGE = Path(words.__file__).parent
SENTENCES = {
    "say": {f"{room}.{name}": text for room, texts in words.ROOM_TEXTS.items()
            for name, text in texts.items() if isinstance(text, str)},
    "found": {name: " ".join(texts) for name, texts in doctor.DOCTOR_TEXTS["findings"].items()},
}  # fmt: skip


@pytest.mark.parametrize("function", SENTENCES)
def test_every_sentence_is_there_used_and_gets_its_facts(function: str) -> None:
    files = PACKAGE.rglob("*.py") if function == "say" else [PACKAGE / "doctor.py"]
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text("utf-8")))]
    shared = doctor.DOCTOR_TEXTS["shared"].keys() if function == "found" else set()
    for call in nodes:
        if isinstance(call, ast.Call) and getattr(call.func, "id", "") == function:
            facts = {fact.arg for fact in call.keywords} | shared
            if isinstance(call.args[0], ast.Constant) and None not in facts:
                text = SENTENCES[function][call.args[0].value]
                fields = [field for _, field, _, _ in string.Formatter().parse(text) if field]
                assert {field.split(".")[0].split("[")[0] for field in fields} <= facts, text
    strings = {node.value for node in nodes if isinstance(node, ast.Constant)}
    chosen = {"boards.no_charuco", "boards.no_checkerboard"}  # by the board's kind
    said = [word for word in strings if isinstance(word, str)]
    chosen |= {f"{room}.{word}" for word in said for room in ("boards", "plots")}
    chosen |= {"no_baseline", "unknown_baseline", "unknown_depth_scale"}  # by the camera's length
    assert SENTENCES[function].keys() <= strings | chosen
