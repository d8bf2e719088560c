"""Checkpoints: what the notebook asks is what the lesson's TOML file says and judges."""

import re

import pytest

import coursekit as ck
from coursekit.lessons.questions import Choice
from tools import build_notebooks

CHECKPOINTS = ck.lessons.CHECKPOINTS
CALL = re.compile(r'^ck\.checkpoint\("([\w.]+)"\)$')
each = pytest.mark.parametrize("checkpoint", CHECKPOINTS.values(), ids=list(CHECKPOINTS))


def asked():
    """Each checkpoint call of the notebooks with the Markdown before it and what is stored."""
    for path in build_notebooks.find([]):
        before = ""
        for cell in build_notebooks.read(path)["cells"]:
            source = build_notebooks.joined(cell["source"])
            if cell["cell_type"] == "code" and (call := CALL.match(source.strip())):
                yield call[1], before, cell["outputs"][0]["data"]
            before = source if cell["cell_type"] == "markdown" else ""


def plain(text):
    """Text without Markdown's emphasis, code and math signs, all white space single."""
    return " ".join(re.sub(r"[*`$\\]", "", text).split())


ASKED = list(asked())
TEXTS = {name: plain(before) for name, before, _ in ASKED}
STORED = {name: data for name, _, data in ASKED}


def test_every_checkpoint_is_asked_once():
    assert sorted(name for name, *_ in ASKED) == sorted(CHECKPOINTS)


@each
def test_the_notebook_says_what_the_checkpoint_asks(checkpoint):
    text = TEXTS[checkpoint.name]
    assert plain(checkpoint.question) in text
    if isinstance(checkpoint, Choice):
        lines = [f"{letter}. {plain(o.text)}" for letter, o in checkpoint.lettered().items()]
        assert [line for line in lines if line not in text] == []
        assert len(re.findall(r"(?:^|\s)- [A-Z]\. ", text)) == len(lines)


@each
def test_what_a_page_without_a_kernel_shows_is_what_the_checkpoint_says(checkpoint):
    """The site's pages are made of what the notebooks store, which is the same at every run."""
    html = checkpoint.without_kernel()
    for mime, text in (("text/plain", repr(checkpoint)), ("text/html", html)):
        assert build_notebooks.joined(STORED[checkpoint.name][mime]) == text
    assert "<summary>Why not another answer?</summary>" in html
