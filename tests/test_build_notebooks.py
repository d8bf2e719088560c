"""The builder of stored outputs, its checks, and nbval's comparison of what is stored."""

import json
import os
import re
import subprocess
import sys

import nbformat
import pytest
from common import EXPECTED

from tools import build_notebooks
from tools.build_notebooks import WIDGET_VIEW, code_cells, joined, problems, read

SOURCES = dict(EXPECTED["toy_notebook"])


def toy(sources, path):
    """Write a notebook as JupyterLab would save it, with one cell a source, named by its id."""
    notebook = nbformat.v4.new_notebook(
        metadata={"language_info": {"name": "python", "version": "3.11.7"}}
    )
    notebook.cells = [nbformat.v4.new_markdown_cell("# Toy", id="title")]
    for name, source in sources.items():
        cell = nbformat.v4.new_code_cell(source, id=name)
        cell.metadata["execution"] = {"iopub.status.busy": "2026-01-01T00:00:00Z"}
        if name in build_notebooks.PARTS:
            cell.metadata["coursekit"] = {"exercise": "half", "part": name}
        if name == "answer":
            cell.metadata["jupyter"] = {"outputs_hidden": True}  # not as it should be
        if name == "sum":
            cell.metadata["tags"] = ["answers", "answers-source"]
        notebook.cells.append(cell)
    path.parent.mkdir(exist_ok=True)
    nbformat.write(notebook, path)
    return path


@pytest.fixture(scope="module")
def built_text(tmp_path_factory):
    path = toy(SOURCES, tmp_path_factory.mktemp("toy") / "01_toy.ipynb")
    assert build_notebooks.build(path) == len(SOURCES)
    return path.read_text(encoding="utf-8")


@pytest.fixture
def built(built_text, tmp_path, monkeypatch):
    """A built notebook, the only one of a folder that the tool takes for the course's."""
    path = tmp_path / "01_toy.ipynb"
    path.write_text(built_text, encoding="utf-8")
    monkeypatch.setattr(build_notebooks, "NOTEBOOKS", tmp_path)
    return path


@pytest.fixture
def light(built):
    """The same without coursekit, which takes a kernel long to import."""
    edit(built, lighten)
    return built


def lighten(notebook):
    cell_of(notebook, "setup").update(source=["import os"])
    notebook["cells"].remove(cell_of(notebook, "question"))
    for number, cell in enumerate(code_cells(notebook), 1):
        cell["execution_count"] = number


def cell_of(notebook, name):
    return next(cell for cell in notebook["cells"] if cell["id"] == name)


def edit(path, change):
    """Change a stored notebook as data, and write it in the tool's own format."""
    notebook = read(path)
    change(notebook)
    text = json.dumps(notebook, ensure_ascii=False, indent=1, sort_keys=True) + "\n"
    path.write_text(text, encoding="utf-8")


# ---- building -----------------------------------------------------------------------------------


def test_a_built_notebook_has_nothing_to_complain_about(built):
    assert problems(built) == []


def test_what_changes_from_run_to_run_is_not_stored(built):
    notebook = read(built)
    assert notebook["metadata"] == build_notebooks.METADATA
    assert [cell["id"] for cell in notebook["cells"]] == ["title", *SOURCES]
    cells = code_cells(notebook)
    assert [cell["execution_count"] for cell in cells] == [1, 2, 3, 4, 5, 6]
    assert not any("execution" in cell["metadata"] for cell in cells)
    hidden = {"source_hidden": True, "outputs_hidden": True}
    assert cell_of(notebook, "sum")["metadata"]["jupyter"] == hidden
    assert cell_of(notebook, "answer")["metadata"]["tags"] == ["hide-input"]
    question, said = cell_of(notebook, "question")["outputs"]
    assert sorted(question["data"]) == ["text/html", "text/plain"]
    assert joined(said["data"]["text/html"]) == ""
    (stream,) = cell_of(notebook, "check")["outputs"]
    assert stream["text"] == ["one\n", "two\n"]
    assert cell_of(notebook, "sum")["outputs"][0]["text"] == ["0.476 m, camera simulated\n"]


def test_a_failing_cell_leaves_the_file_and_is_named(tmp_path, monkeypatch, capsys):
    path = toy({"fine": "x = 0", "bad": "1 / x", "never": "print(1)"}, tmp_path / "02_bad.ipynb")
    before = path.read_bytes()
    monkeypatch.setattr(build_notebooks, "NOTEBOOKS", tmp_path)
    assert build_notebooks.main([]) == 1
    said = capsys.readouterr()
    assert said.err == "02_bad, cell bad: ZeroDivisionError: division by zero\n"
    assert said.out == "02_bad ... failed\n"
    assert path.read_bytes() == before
    assert list(tmp_path.iterdir()) == [path]


def test_a_copy_keeps_its_widgets_and_the_users_environment(built, tmp_path, monkeypatch, capsys):
    monkeypatch.setenv("COURSEKIT_CAMERA", "728612070259")
    before = built.read_bytes()
    assert build_notebooks.main(["--into", str(tmp_path / "build"), "01_toy"]) == 0
    assert capsys.readouterr().out.startswith("01_toy ... 6 cells, ")
    assert built.read_bytes() == before
    copy = read(tmp_path / "build" / "01_toy.ipynb")
    assert WIDGET_VIEW in cell_of(copy, "question")["outputs"][0]["data"]
    assert copy["metadata"]["widgets"]
    assert cell_of(copy, "sum")["outputs"][0]["text"] == ["0.476 m, camera 728612070259\n"]


@pytest.mark.usefixtures("built")
@pytest.mark.parametrize(("arguments", "says"), EXPECTED["bad_builds"])
def test_what_cannot_be_done_is_refused(arguments, says, capsys):
    with pytest.raises(SystemExit):
        build_notebooks.main(arguments)
    assert says in capsys.readouterr().err


# ---- checking -----------------------------------------------------------------------------------


def change(name, **fields):
    return lambda notebook: cell_of(notebook, name).update(fields)


def strip(notebook):
    for cell in code_cells(notebook):
        cell.update(outputs=[], execution_count=None)


FLAWS = [
    (strip, "cell setup: execution count is null, want 1"),
    (lambda n: n["metadata"].update(widgets={}), "widget state is stored"),
    (
        lambda n: n["metadata"]["language_info"].update(version="3.11.7"),
        "metadata of the notebook or its kernel is not normalised",
    ),
    (lambda n: cell_of(n, "title").pop("id"), "1 cells have no id"),
    *((change(cell, **fields), says) for cell, fields, says in EXPECTED["flaws_of_cells"]),
]


@pytest.mark.parametrize(("flaw", "message"), FLAWS, ids=[message for _, message in FLAWS])
def test_check_names_each_flaw(built, flaw, message):
    edit(built, flaw)
    assert f"01_toy: {message}" in problems(built)


def test_check_notices_a_file_that_another_program_wrote(built):
    built.write_text(json.dumps(read(built), indent=2), encoding="utf-8")
    assert [text for text in problems(built) if "was not written by" in text]


def test_check_fails_on_a_file_that_is_no_notebook(built, capsys):
    built.write_text("[]", encoding="utf-8")
    assert build_notebooks.main(["--check"]) == 1
    assert "01_toy.ipynb: not a notebook" in capsys.readouterr().out


@pytest.mark.parametrize("text", ["see https://a.org/b/c/d.html", "</td></tr>", "3 m/s", "1/2/3"])
def test_these_are_no_machine_paths(text):
    assert not build_notebooks.MACHINE_PATH.search(text)


def test_the_stored_notebooks_are_in_order():
    assert [text for path in build_notebooks.find([]) for text in problems(path)] == []


# ---- repeating ----------------------------------------------------------------------------------


def test_what_repeats_passes_and_nothing_is_written(light, monkeypatch, capsys):
    """An execution that gives what is stored; a kernel's own is in the test below."""
    before = light.read_bytes()
    monkeypatch.setattr(build_notebooks, "execute", lambda *_: None)
    assert build_notebooks.main(["--check", "--run"]) == 0
    first, second = capsys.readouterr().out.splitlines()
    assert first == "01_toy twice ... the same"
    assert re.fullmatch(r"2 executions, \d+ s", second)
    assert light.read_bytes() == before
    assert list(light.parent.iterdir()) == [light]


def test_cells_that_do_not_repeat_or_are_out_of_date_are_named(tmp_path, monkeypatch, capsys):
    path = toy(dict(EXPECTED["changing_notebook"]), tmp_path / "01_toy.ipynb")
    build_notebooks.build(path)
    stored = {"text/plain": ["A"], "text/html": ["<b>3</b>"]}
    edit(path, lambda n: cell_of(n, "table")["outputs"][0].update(data=stored))
    edit(path, lambda n: picture(n).update({"image/png": "AAAA"}))  # a pixel drawn elsewhere
    monkeypatch.setattr(build_notebooks, "NOTEBOOKS", tmp_path)
    assert build_notebooks.main(["--check", "--run"]) == 1
    stored = "what is stored is not what an execution gives"
    second = "the second execution gives something else than the first"
    assert capsys.readouterr().out.splitlines()[:-1] == [
        "01_toy twice ... differs or fails",
        f"01_toy: cell drawn (stdout): {stored}",
        f"01_toy: cell table (text/html, text/plain): {stored}",
        f"01_toy: cell drawn (stdout): {second}",
        f"01_toy: cell other (image/png): {second}",
    ]


def picture(notebook):
    return cell_of(notebook, "figure")["outputs"][0]["data"]


# ---- what nbval makes of it ---------------------------------------------------------------------


def test_nbval_fails_on_one_changed_digit(light, tmp_path):
    """And passes what is stripped, which is why --check exists."""
    said = ["0.477 m, camera simulated\n"]
    edit(light, lambda n: cell_of(n, "sum")["outputs"][0].update(text=said))
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-c", os.devnull]
    command += ["--rootdir", str(tmp_path), "--nbval", "--nbval-current-env", str(tmp_path)]
    environment = build_notebooks.kernel_environment(tmp_path)
    run = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert "1 failed, 4 passed" in run.stdout, run.stdout
    assert re.search(r"^FAILED .*01_toy.ipynb::Cell 4", run.stdout, re.MULTILINE)
    assert "0.477 m" in run.stdout
    edit(light, strip)
    assert len(problems(light)) == len(SOURCES)  # and no answer
