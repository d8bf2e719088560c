"""A notebook runs for somebody who leaves out every section marked deeper or studio."""

import nbformat
import pytest

from tools import build_notebooks

PATHS = build_notebooks.find([])
MARKS = ("deeper", "studio")


def core(notebook):
    """The notebook without the sections whose headings begin with a mark, and what is in them."""
    kept, left_out = [], None  # left_out: the level of the heading that began the gap
    for cell in notebook.cells:
        level, title = heading(cell)
        if level and (left_out is None or level <= left_out):
            left_out = level if title.lower().startswith(MARKS) else None
        if left_out is None:
            kept.append(cell)
    notebook.cells = kept
    return notebook


def heading(cell):
    """Level and text of the heading that a cell begins with; 0 if it begins with none."""
    first = cell.source.partition("\n")[0]
    marks, _, title = first.partition(" ")
    is_one = cell.cell_type == "markdown" and marks and set(marks) == {"#"}
    return (len(marks), title) if is_one else (0, "")


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_the_core_runs_alone(path, tmp_path):
    notebook = nbformat.read(path, as_version=4)
    whole = len(notebook.cells)
    notebook = core(notebook)
    assert len(notebook.cells) < whole, "no section is marked deeper or studio"
    environment = build_notebooks.kernel_environment(tmp_path)
    build_notebooks.execute(notebook, path.stem, path.parent, environment)
    assert (tmp_path / "results" / f"{path.stem}.json").exists()
