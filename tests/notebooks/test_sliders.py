"""The figures that a reader drags: two steps of each slider, as two arrow keys make, redraw it."""

import re

import pytest
from common import names

import coursekit as ck
from coursekit import plots
from tools import build_notebooks

PATHS = build_notebooks.find([])


def cells_of_figures(path):
    """The sources of a notebook's figures with sliders, and of the cells that these need."""
    needed, found = set(), []
    for cell in reversed(build_notebooks.code_cells(build_notebooks.read(path))):
        source = build_notebooks.joined(cell["source"])
        used, bound = names(source)
        if "ck.drag(" in source or needed & bound:
            needed |= used
            found.append(source)
    return found[::-1]


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_two_steps_of_each_slider_change_the_picture(path, tmp_path, monkeypatch):
    for name, value in build_notebooks.kernel_environment(tmp_path).items():
        monkeypatch.setenv(name, value)
    figures, space = [], {}
    monkeypatch.setattr(ck, "drag", lambda *a, **k: figures.append(plots.drag(*a, **k)))
    for source in cells_of_figures(path):
        exec(source, space)
    assert figures
    for figure in figures:
        *sliders, image, _ = figure.widget().children
        for slider in sliders:
            before = picture(image)
            slider.value += 2 * slider.step
            assert picture(image) != before, slider.description


def picture(image):
    return re.search(r'src="([^"]+)"', image.value)[1]
