"""Blank, right and wrong answers to every exercise of the notebooks get the verdict they should."""

import copy

import nbformat
import numpy as np
import pytest
from wrong_answers import attempts

import coursekit as ck
from tools import build_notebooks

PATHS = build_notebooks.find([])
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
WRONG = [
    pytest.param(name, answer, id=f"{name}, {answer.style}: {answer.attempt.__name__}")
    for name in EXERCISES
    for answer in attempts(name)
]


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
    assert (verdict.kind, verdict.named) == (answer.kind, answer.named), verdict


@pytest.mark.parametrize("name", EXERCISES)
def test_every_mistake_that_a_check_names_has_a_wrong_answer(name):
    named = {answer.named for answer in attempts(name)}
    assert {mistake.name for mistake in EXERCISES[name].mistakes} <= named


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_a_notebook_with_all_answers_runs_and_finds_them_right(path, tmp_path):
    notebook = solved(nbformat.read(path, as_version=4))
    environment = build_notebooks.kernel_environment(tmp_path)
    build_notebooks.execute(notebook, path.stem, path.parent, environment)
    said = {
        exercise: cell.outputs[-1].data["text/plain"]
        for cell in build_notebooks.code_cells(notebook)
        for exercise, part in [build_notebooks.role(cell)]
        if part == "check"
    }
    assert {name: text.partition(".")[0] for name, text in said.items()} == {
        name: f"{name}: right" for name in said
    }


def solved(notebook):
    notebook = copy.deepcopy(notebook)
    cells = {build_notebooks.role(cell): cell for cell in notebook.cells}
    for (exercise, part), cell in cells.items():
        if part == "stub":
            cell.source = injected({"answer": cells[exercise, "answer"].source}, exercise)
    return notebook
