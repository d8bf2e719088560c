"""A learner's way through each notebook in JupyterLab, in a real browser.

By day through notebook 01, which has each kind of widget: what of the others is shown, answered and
drawn is tested without a browser (nbval, tests/notebooks, test_lessons.py). COURSEKIT_NIGHTLY=1
goes through all.
"""

import json
import re
import secrets
import shutil
import socket
import subprocess
import sys
import time
import urllib.request

import pytest
from common import EXPECTED, NIGHTLY
from playwright.sync_api import expect

import coursekit as ck
from coursekit.lessons.questions import LETTERS, Choice
from tools import build_notebooks, copies

pytestmark = pytest.mark.browser

NAMES = [f"{number:02d}_{lesson}" for number, lesson in enumerate(ck.lessons.LESSONS, start=1)]
NAMES = NAMES if NIGHTLY else NAMES[:1]
PATIENCE_MS = 1_800_000  # so that a hang ends; no page takes minutes
expect.set_options(timeout=PATIENCE_MS)


@pytest.fixture(scope="module", params=NAMES)
def name(request):
    """A notebook; its tests share one page."""
    return request.param


@pytest.fixture(scope="module")
def server_at(browser, tmp_path_factory):
    """Where a JupyterLab, started as by course.py, serves copies: of {0}, in the workspace {1}."""
    home = tmp_path_factory.mktemp("home")
    served = tmp_path_factory.mktemp("served")
    (home / "overrides.json").write_text(json.dumps(EXPECTED["lab_settings"]), encoding="utf-8")
    (served / "notebooks").mkdir()
    for name in NAMES:
        shutil.copy(build_notebooks.NOTEBOOKS / f"{name}.ipynb", served / "notebooks")
    copies.make(served)
    token, port = secrets.token_hex(16), free_port()
    command = [sys.executable, "-m", "tools.lab", "--no-browser", "--allow-root"]
    command += [f"--port={port}", "--ServerApp.port_retries=0", "--log-level=ERROR"]
    command += [f"--ServerApp.root_dir={served}", f"--LabApp.app_settings_dir={home}"]
    command += [f"--config={build_notebooks.ROOT / 'tools' / 'jupyter_server_config.py'}"]
    environment = build_notebooks.kernel_environment(home)
    environment |= {"HOME": str(home), "JUPYTER_TOKEN": token, "JUPYTER_CONFIG_DIR": f"{home}/c"}
    environment |= {"JUPYTER_DATA_DIR": f"{home}/d", "JUPYTER_RUNTIME_DIR": f"{home}/r"}
    with (home / "log").open("w", encoding="utf-8") as log:
        streams = {"stdout": log, "stderr": subprocess.STDOUT}
        server = subprocess.Popen(command, cwd=build_notebooks.ROOT, env=environment, **streams)
    try:
        wait_for(f"http://127.0.0.1:{port}/api", server, home / "log")
        yield f"http://127.0.0.1:{port}/lab/workspaces/{{1}}/tree/{{0}}.ipynb?token={token}"
    finally:
        server.terminate()
        server.wait()


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(url, server, log):
    while server.poll() is None:
        try:
            urllib.request.urlopen(url).close()
            return
        except OSError:  # not listening yet
            time.sleep(0.2)
    raise RuntimeError(f"JupyterLab did not start: {log.read_text('utf-8')[-2000:]}")


@pytest.fixture(scope="module")
def opened(server_at, browser, name):
    """The page with the notebook as it opens, before anything has run."""
    page = open_page(browser, server_at.format(name, name))
    yield page
    if not page.is_closed():
        stop_kernel(page)
        page.close()


def open_page(browser, address):
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    page.set_default_timeout(PATIENCE_MS)
    page.goto(address)
    page.locator(".jp-CodeCell").last.wait_for(state="attached")
    page.locator(".jp-KernelName", has_text="Python 3").wait_for()  # idle until then, too
    page.locator(".jp-Notebook-ExecutionIndicator[data-status=idle]").wait_for()
    return page


def stop_kernel(page):
    """Two cores are soon taken by the kernels of pages that nobody looks at any more."""
    page.get_by_role("menuitem", name="Kernel", exact=True).click()
    page.locator("[data-command='kernelmenu:shutdown']").click()
    page.locator(".jp-KernelName", has_text="No Kernel").wait_for()


@pytest.fixture(scope="module")
def page(opened, name):
    """The page after Run All Cells."""
    opened.get_by_role("menuitem", name="Run", exact=True).click()
    opened.locator("[data-command='runmenu:run-all']").click()
    prompt = opened.locator(".jp-CodeCell .jp-InputArea-prompt").last
    expect(prompt).to_have_text("[*]:")
    expect(prompt).to_have_text(re.compile(r"\[\d+\]:"))
    return opened


def cell_with(page, source):
    return page.locator(".jp-CodeCell").filter(has=page.locator(".cm-content", has_text=source))


def answers(page, name):
    """The bars of cells whose source is hidden, answers and sources that give one away; and how
    many there should be."""
    stored = build_notebooks.read(build_notebooks.NOTEBOOKS / f"{name}.ipynb")
    cells = build_notebooks.code_cells(stored)
    hidden = [cell["metadata"].get("jupyter", {}).get("source_hidden", False) for cell in cells]
    return page.locator(".jp-InputPlaceholder"), sum(hidden)


def plain(text):
    return re.sub("[*`]", "", text)


def checkpoints(name):
    lesson = name.partition("_")[2]
    return [c for n, c in ck.lessons.CHECKPOINTS.items() if n.startswith(f"{lesson}.")]


def test_answers_are_collapsed_on_load(opened, name):
    bars, count = answers(opened, name)
    stored = build_notebooks.read(build_notebooks.NOTEBOOKS / f"{name}.ipynb")
    roles = [build_notebooks.role(cell)[1] for cell in build_notebooks.code_cells(stored)]
    assert 0 < roles.count("answer") <= count
    expect(bars).to_have_count(count)
    expect(bars.filter(has_text="# An answer")).to_have_count(roles.count("answer"))


def test_run_all_shows_no_error_and_no_answer(page, name):
    outputs = page.locator(".jp-OutputArea-output")
    kinds = outputs.evaluate_all('all => all.map(e => e.dataset.mimeType ?? "")')
    assert len(kinds) > 15
    assert [kind for kind in kinds if kind.endswith((".error", ".stderr"))] == []
    bars, count = answers(page, name)
    assert bars.count() == count


def test_each_checkpoint_and_figure_becomes_a_widget(page, name):
    cells = cell_with(page, "ck.checkpoint(")
    assert cells.count() == len(checkpoints(name))
    assert cells.get_by_role("button", name="Commit").count() == cells.count()
    figures = cell_with(page, "ck.drag(")
    assert figures.locator(".jupyter-widgets img[alt]").count() == figures.count()
    assert figures.locator(".noUi-handle:not([aria-label])").count() == 0


def test_every_checkpoint_explains_wrong_and_right_answers(page, name):
    for checkpoint in checkpoints(name):
        cell = cell_with(page, f'"{checkpoint.name}"')
        for give, said in attempts(checkpoint):
            give(cell)
            expect(cell.get_by_role("alert")).to_contain_text(plain(said))


def attempts(checkpoint):
    """A wrong and the right answer: how to give each, and what must be said then."""
    if isinstance(checkpoint, Choice):
        options = sorted(checkpoint.lettered().items(), key=lambda item: item[1].right)
        for letter, option in (options[0], options[-1]):
            yield lambda cell, letter=letter: choose(cell, letter), option.why
    else:
        wrong = checkpoint.classics[0]
        for value, why in ((wrong.value, wrong.why), (checkpoint.value, checkpoint.why)):
            yield lambda cell, v=value: type_in(cell, v), why


def choose(cell, letter):
    """By keyboard: arrow keys go through the options, and not to another cell."""
    cell.get_by_role("radio", name="A", exact=True).press("Space")
    for before in LETTERS[: LETTERS.index(letter)]:
        cell.get_by_role("radio", name=before, exact=True).press("ArrowDown")
    expect(cell.get_by_role("radio", name=letter, exact=True)).to_be_focused()
    cell.get_by_role("button", name="Commit").press("Enter")


def type_in(cell, value):
    field = cell.get_by_label("Your answer")
    field.fill("")
    field.press_sequentially(f"{value:.6g}")
    field.press("Enter")


def test_each_slider_redraws_its_figure(page):
    cells = cell_with(page, "ck.drag(")
    for number in range(cells.count()):
        image = cells.nth(number).locator(".jupyter-widgets img")
        for handle in cells.nth(number).locator(".noUi-handle").all():
            before = shown(image)
            handle.focus()
            handle.press("ArrowRight")
            handle.press("ArrowRight")
            deadline = time.monotonic() + PATIENCE_MS / 1000
            while shown(image) == before:
                assert time.monotonic() < deadline, handle
                page.wait_for_timeout(50)


def shown(image):
    """The bytes of the PNG file that the page shows."""
    read = "async e => Array.from(new Uint8Array(await (await fetch(e.src)).arrayBuffer()))"
    return bytes(image.evaluate(read))


def test_on_the_next_day_every_answer_and_every_figure_is_there(browser, server_at, page, name):
    """The copy is saved, its kernel ended, and opened again: nothing runs in it."""
    drawn = cell_with(page, "ck.drag(").count()
    page.locator(".jp-MarkdownCell").first.click(position={"x": 2, "y": 2})  # off the slider
    with page.expect_response(lambda r: r.request.method == "PUT" and "/contents/" in r.url):
        page.keyboard.press("Control+s")
    stop_kernel(page)
    page.close()
    later = open_page(browser, server_at.format(name, f"{name}-later"))
    try:
        assert later.get_by_text("model not found").count() == 0
        assert later.locator(".jupyter-widgets").count() == 0
        for checkpoint in checkpoints(name):
            cell = cell_with(later, f'"{checkpoint.name}"')
            why = checkpoint.explanation().lines[0]
            expect(cell.locator(".jp-OutputArea-child").last).to_contain_text(plain(why))
        figures = cell_with(later, "ck.drag(").locator("img")
        assert figures.count() == drawn
        assert all(figures.nth(n).evaluate("e => e.naturalWidth > 300") for n in range(drawn))
    finally:
        stop_kernel(later)
        later.close()
