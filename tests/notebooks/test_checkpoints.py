"""Checkpoints: what the notebook asks is what the checkpoint judges."""

import re

import pytest

import coursekit as ck
from coursekit.lessons.questions import Choice, Number
from tools import build_notebooks

CHECKPOINTS = ck.lessons.CHECKPOINTS
CALL = re.compile(r'^ck\.checkpoint\("([\w.]+)"\)$')
each = pytest.mark.parametrize("checkpoint", CHECKPOINTS.values(), ids=list(CHECKPOINTS))


def asked():
    """Each checkpoint call of the notebooks with the Markdown before it."""
    for path in build_notebooks.find([]):
        before = ""
        for cell in build_notebooks.read(path)["cells"]:
            source = build_notebooks.joined(cell["source"])
            if cell["cell_type"] == "code" and (call := CALL.match(source.strip())):
                yield call[1], before
            before = source if cell["cell_type"] == "markdown" else ""


def plain(text):
    """Text without Markdown's emphasis, code and math signs, all white space single."""
    return " ".join(re.sub(r"[*`$\\]", "", text).split())


def test_every_checkpoint_is_asked_once():
    assert sorted(name for name, _ in asked()) == sorted(CHECKPOINTS)


@each
def test_the_notebook_says_what_the_checkpoint_asks(checkpoint):
    text = plain(dict(asked())[checkpoint.name])
    assert plain(checkpoint.question) in text
    if isinstance(checkpoint, Choice):
        lines = [f"{letter}. {plain(o.text)}" for letter, o in checkpoint.lettered().items()]
        assert [line for line in lines if line not in text] == []
        assert len(re.findall(r"(?:^|\s)- [A-Z]\. ", text)) == len(lines)


@each
def test_one_answer_is_right_and_every_answer_is_explained(checkpoint):
    if isinstance(checkpoint, Choice):
        answers = {letter: o.right for letter, o in checkpoint.lettered().items()}
    else:
        assert isinstance(checkpoint, Number)
        answers = {c.value: False for c in checkpoint.classics} | {checkpoint.value: True}
    assert sum(answers.values()) == 1
    for answer, right in answers.items():
        verdict = checkpoint.judge(answer)
        assert verdict.kind == ("right" if right else "wrong")
        assert (verdict.named is None) == right
        assert len(verdict.lines[0]) > 20
