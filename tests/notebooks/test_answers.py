"""Blank, right and wrong answers to every exercise of the notebooks get the verdict they should.

And a notebook runs for somebody who leaves out every section marked deeper or studio.
All right answers, in each style, are judged by day; of the wrong ones one for every other verdict
of an exercise. COURSEKIT_NIGHTLY=1 judges all, and runs the notebooks with all answers in them, the
core alone and whole.
"""

import nbformat
import numpy as np
import pytest
from common import NIGHTLY, names, nightly
from wrong_answers import attempts

import coursekit as ck
from tools import build_notebooks

PATHS = build_notebooks.find([])
MARKS = ("deeper", "studio")
EXERCISES = ck.lessons.EXERCISES


def parts_of(path):
    """The sources of a notebook's exercises: {"pinhole.project": {"stub": ..., ...}, ...}."""
    lesson = path.stem.partition("_")[2]
    found = {}
    for cell in build_notebooks.code_cells(build_notebooks.read(path)):
        exercise, part = build_notebooks.role(cell)
        if exercise:
            source = build_notebooks.joined(cell["source"])
            found.setdefault(f"{lesson}.{exercise}", {})[part] = source
    return found


SOURCES = {name: parts for path in PATHS for name, parts in parts_of(path).items()}
ANSWERS = [(name, answer) for name in EXERCISES for answer in attempts(name)]
if not NIGHTLY:  # of wrong ones the last: those that are text were written without ours in view
    right = [(name, a) for name, a in ANSWERS if a.verdict[0] == "right"]
    wrong = {(name, a.verdict): (name, a) for name, a in ANSWERS if a.verdict[0] != "right"}
    ANSWERS = right + [*wrong.values()][::2]
WRONG = [pytest.param(name, answer, id=f"{name}, {answer.name}") for name, answer in ANSWERS]


def injected(parts, function):
    """The stub cell's source with the answer in it."""
    return parts["answer"].replace(f"def {function}_answer(", f"def {function}(")


def defined(source, function):
    namespace = {"ck": ck, "np": np}
    exec(source, namespace)
    return namespace[function]


def test_every_exercise_is_in_a_notebook():
    assert sorted(SOURCES) == sorted(EXERCISES)


@pytest.mark.parametrize("name", SOURCES)
def test_a_blank_stub_is_not_attempted(name):
    exercise = EXERCISES[name]
    verdict = exercise.judge(defined(SOURCES[name]["stub"], exercise.function))
    assert (verdict.kind, verdict.named) == ("not attempted", None), verdict


@pytest.mark.parametrize("name", SOURCES)
def test_the_answer_is_right(name):
    exercise = EXERCISES[name]
    source = injected(SOURCES[name], exercise.function)
    verdict = exercise.judge(defined(source, exercise.function))
    assert verdict.kind == "right", verdict


@pytest.mark.parametrize(("name", "answer"), WRONG)
def test_a_wrong_answer_gets_its_verdict(name, answer):
    verdict = EXERCISES[name].judge(answer.attempt)
    assert (verdict.kind, verdict.named) == answer.verdict, verdict


@pytest.mark.parametrize("name", EXERCISES)
def test_every_mistake_that_a_check_names_has_a_wrong_answer(name):
    named = {answer.verdict[1] for answer in attempts(name)}
    assert {mistake.name for mistake in EXERCISES[name].mistakes} <= named


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_the_core_uses_nothing_that_only_the_rest_defines(path):
    """So that it runs for somebody who skips the rest; at night it is run."""
    core, rest = split(nbformat.read(path, as_version=4).cells)
    (used, in_core), (_, in_rest) = (
        map(set().union, *(names(cell.source) for cell in cells if cell.cell_type == "code"))
        for cells in (core, rest)
    )
    assert not (used & in_rest) - in_core


@nightly
@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_a_notebook_with_all_answers_runs_and_finds_them_right(path, whole, tmp_path):
    """The core alone, as for somebody who skips the rest; then the exercises of the rest."""
    notebook = nbformat.read(path, as_version=4)
    cells = {build_notebooks.role(cell): cell for cell in notebook.cells}
    for (exercise, part), cell in cells.items():
        if part == "stub":
            cell.source = injected({"answer": cells[exercise, "answer"].source}, exercise)
    if not whole:
        own = {exercise for exercise, _ in cells if exercise}
        core, rest = split(notebook.cells)
        assert rest, "no section is marked deeper or studio"
        done = nbformat.v4.new_code_cell(f"assert ck.results.load({path.stem!r}).quantities")
        left = [c for c in build_notebooks.code_cells({"cells": rest}) if kept(c, own)]
        notebook.cells = [*core, done, *left]
    environment = build_notebooks.kernel_environment(tmp_path)
    build_notebooks.execute(notebook, path.stem, path.parent, environment)
    said = {
        exercise: cell.outputs[-1].data["text/plain"]
        for cell in build_notebooks.code_cells(notebook)
        for exercise, part in [build_notebooks.role(cell)]
        if part == "check"
    }
    lesson = path.stem.partition("_")[2]
    assert {f"{lesson}.{name}" for name in said} == {n for n in SOURCES if n.startswith(lesson)}
    assert {text.partition(".")[0] for text in said.values()} == {f"{n}: right" for n in said}


def kept(cell, exercises):
    """Whether it is part of an exercise, or uses what one of them defines."""
    return build_notebooks.role(cell)[0] or exercises & names(cell.source)[0]


def split(cells):
    """The cells of the core, and those of the sections whose headings begin with a mark."""
    core, rest = [], []
    left_out = None  # the level of the heading that began the gap
    for cell in cells:
        level, title = heading(cell)
        if level and (left_out is None or level <= left_out):
            left_out = level if title.lower().startswith(MARKS) else None
        (core if left_out is None else rest).append(cell)
    return core, rest


def heading(cell):
    """Level and text of the heading that a cell begins with; 0 if it begins with none."""
    marks, _, title = cell.source.partition("\n")[0].partition(" ")
    is_one = cell.cell_type == "markdown" and marks and set(marks) == {"#"}
    return (len(marks), title) if is_one else (0, "")
