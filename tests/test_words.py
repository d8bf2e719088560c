"""What a reader of findings sees."""

from __future__ import annotations

import pytest

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


def test_a_finding_cannot_be_changed() -> None:
    with pytest.raises(AttributeError):
        BOW.name = "other"  # type: ignore[misc]
