"""What a reader of findings sees."""

from __future__ import annotations

import ast
import string
from pathlib import Path

import pytest

from coursekit import boards, cameras, doctor
from coursekit.words import Finding, Findings, Sentences

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
    assert text.splitlines() == [
        "Nothing found.",
        "Looked for: a bowed board; blur.",
        "Not tested: a wrong square size; use a ruler.",
    ]
    assert not Findings()


def test_the_html_is_escaped_and_has_the_same_words() -> None:
    html = Findings([BOW], ["a bowed board"])._repr_html_()
    assert "The board is &lt;not&gt; flat." in html
    assert "<not>" not in html
    for part in ("1 finding.", "Bowed board", "0.51 ± 0.04 mm", "Use glass.", "Looked for"):
        assert part in html
    assert "<li>" not in Findings()._repr_html_()


ROOMS = {  # the name of the function there, the sentences that it says, the files
    "boards": ("say", Sentences(boards.__file__).texts, Path(boards.__file__).parent),
    "cameras": ("say", Sentences(cameras.__file__).texts, Path(cameras.__file__).parent),
    "doctor": ("found", doctor.TEXTS["findings"], Path(doctor.__file__)),
}


@pytest.mark.parametrize("room", ROOMS)
def test_every_sentence_is_there_used_and_gets_its_facts(room: str) -> None:
    function, sentences, place = ROOMS[room]
    files = place.glob("*.py") if place.is_dir() else [place]
    nodes = [node for file in files for node in ast.walk(ast.parse(file.read_text("utf-8")))]
    shared = doctor.TEXTS["shared"].keys() if room == "doctor" else set()
    for call in nodes:
        if isinstance(call, ast.Call) and ast.unparse(call.func) == function:
            facts = {fact.arg for fact in call.keywords} | shared
            if isinstance(call.args[0], ast.Constant) and None not in facts:
                text = (
                    " ".join(sentences[call.args[0].value])
                    if room == "doctor"
                    else (sentences[call.args[0].value])
                )
                wanted = {field for _, field, _, _ in string.Formatter().parse(text) if field}
                assert {field.split(".")[0].split("[")[0] for field in wanted} <= facts, text
    strings = {node.value for node in nodes if isinstance(node, ast.Constant)}
    assert sentences.keys() <= strings
