"""A student's own copies: made once, without what answers a prediction, and never in git's way."""

import json
import runpy
import shutil
import subprocess
from pathlib import Path
from types import SimpleNamespace

import pytest

from tools import copies
from tools.build_notebooks import ANSWERS, ROOT, WIDGET_VIEW, code_cells, joined, read


def git(folder, *arguments):
    own = ["-c", "user.name=x", "-c", "user.email=x@y.z", "-C", str(folder)]
    run = subprocess.run(["git", *own, *arguments], capture_output=True, text=True, check=True)
    return run.stdout.strip()


def changed(path, source):
    """A later version of a notebook: with another first cell."""
    notebook = read(path)
    notebook["cells"][0]["source"] = source
    path.write_text(json.dumps(notebook), encoding="utf-8")


@pytest.fixture
def clone(tmp_path, monkeypatch):
    """A clone of a course of two notebooks, and the folder it was cloned from."""
    upstream, mine = tmp_path / "upstream", tmp_path / "mine"
    (upstream / "notebooks").mkdir(parents=True)
    shutil.copy(ROOT / ".gitignore", upstream)
    for path in copies.originals()[:2]:
        shutil.copy(path, upstream / "notebooks")
    git(upstream, "init", "-q")
    git(upstream, "add", "-A")
    git(upstream, "commit", "-qm", "first")
    git(tmp_path, "clone", "-q", str(upstream), str(mine))
    monkeypatch.setattr(copies, "ROOT", mine)
    monkeypatch.setattr(copies, "ORIGINALS", mine / "notebooks")
    monkeypatch.delenv("COURSEKIT_RESULTS")
    return mine, upstream


def test_work_in_a_copy_and_a_newer_version_do_not_meet(clone):
    mine, upstream = clone
    own = mine / "notebooks" / "my"
    assert copies.make(own) == []
    first, second = sorted(own.iterdir())
    notebook = read(first)
    notebook["cells"][2]["source"] = "my own work"
    first.write_text(json.dumps(notebook), encoding="utf-8")
    (mine / "my_photos").mkdir()
    (mine / "my_photos" / "a.jpg").touch()
    assert git(mine, "status", "--porcelain") == ""
    changed(upstream / "notebooks" / first.name, "# A newer one")
    git(upstream, "commit", "-qam", "second")
    git(mine, "pull", "-q")
    assert "# A newer one" in (mine / "notebooks" / first.name).read_text("utf-8")
    before = first.read_bytes()
    assert copies.make(own) == [first]
    assert f"{first.name}. They stay as they are" in copies.older_ones([first])
    assert first.read_bytes() == before
    first.rename(own / "old.ipynb")
    second.write_text("not even a notebook", encoding="utf-8")
    assert copies.make(own) == [second]
    assert "# A newer one" in first.read_text("utf-8")


def test_the_first_unfinished_one_is_opened(clone):
    mine, _ = clone
    first, second = (path.name for path in copies.originals())
    assert copies.unfinished() == first
    (mine / "results").mkdir()
    (mine / "results" / "01_pinhole.json").touch()
    assert copies.unfinished() == second
    (mine / "results" / "02_depth_noise.json").touch()
    assert copies.unfinished() == second


def test_a_copy_lacks_what_answers_a_prediction_and_nothing_else(tmp_path):
    copies.make(tmp_path)
    for path in copies.originals():
        for old, new in zip(
            code_cells(read(path)), code_cells(read(tmp_path / path.name)), strict=True
        ):
            answers = ANSWERS in old["metadata"].get("tags", [])
            assert new["outputs"] == ([] if answers else old["outputs"])
            assert not new["metadata"].get("jupyter", {}).get("outputs_hidden")
            assert joined(new["source"]) == joined(old["source"])


def configured():
    settings = SimpleNamespace(ServerApp=SimpleNamespace())
    path = ROOT / "tools" / "jupyter_server_config.py"
    return runpy.run_path(str(path), {"get_config": lambda: settings})


def test_the_server_writes_no_original_and_no_widget(tmp_path):
    settings = configured()
    (tmp_path / "notebooks" / "my").mkdir(parents=True)
    names = ("notebooks/01_pinhole.ipynb", "notebooks/my/01_pinhole.ipynb")
    for name in names:
        (tmp_path / name).touch()
    contents = settings["Contents"](root_dir=str(tmp_path))
    assert [contents.is_writable(name) for name in names] == [False, True]

    def output(**data):
        return {"output_type": "display_data", "metadata": {}, "data": data}

    picture, view = {"image/png": "AAAA", "text/plain": "words"}, {WIDGET_VIEW: {"model_id": "1"}}
    shown = [output(**picture, **view), output(**view, **{"text/plain": "0%"}), output(**picture)]
    cells = [{"cell_type": "code", "outputs": shown}, {"cell_type": "markdown"}]
    notebook = {"metadata": {"widgets": {}, "kernelspec": {}}, "cells": cells}
    settings["without_widgets"]({"type": "notebook", "content": notebook})
    assert notebook["metadata"] == {"kernelspec": {}}
    assert cells[0]["outputs"] == [output(**picture), output(**picture)]


def test_an_original_that_runs_keeps_its_results_apart(tmp_path):
    settings = configured()
    contents = settings["Contents"](root_dir=str(tmp_path))
    sessions = settings["Sessions"](contents_manager=contents)
    for name, apart in (("notebooks/01_pinhole.ipynb", True), ("notebooks/my/a.ipynb", False)):
        where = sessions.get_kernel_env(name).get("COURSEKIT_RESULTS")
        assert (where == str(Path(tmp_path, "build", "results"))) == apart
