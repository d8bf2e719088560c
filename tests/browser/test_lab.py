"""A learner's way through notebook 01 in JupyterLab, in a real browser.

Screenshots of the page go to build/screenshots/.
"""

import json
import os
import re
import secrets
import shutil
import socket
import subprocess
import sys
import time
import urllib.request

import pytest

import coursekit as ck
from tools import build_notebooks

pytestmark = pytest.mark.browser

NAME = "01_pinhole"
SCREENSHOTS = build_notebooks.ROOT / "build" / "screenshots"
CHROMIUM = next(
    filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None
)
QUIET = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync"
NO_NEWS = "--disable-background-networking --disable-component-update"
SETTINGS = {
    "@jupyterlab/apputils-extension:notification": {"fetchNews": "false", "checkForUpdates": False},
    "@jupyterlab/notebook-extension:tracker": {"windowingMode": "none"},  # all cells are in the DOM
}
STARTUP_S = 60
NOTEBOOK_MS = 90_000


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """The address of notebook 01 in a JupyterLab of its own, which works on copies."""
    if CHROMIUM is None and os.environ.get("CI") == "true":
        pytest.fail("no Chromium, and CI must run this test")
    if CHROMIUM is None:
        pytest.skip("not run: no Chromium")
    home = tmp_path_factory.mktemp("home")
    served = tmp_path_factory.mktemp("served")
    (home / "overrides.json").write_text(json.dumps(SETTINGS))
    shutil.copy(build_notebooks.NOTEBOOKS / f"{NAME}.ipynb", served)
    token, port = secrets.token_hex(16), free_port()
    command = [sys.executable, "-m", "jupyterlab", "--no-browser", "--allow-root"]
    command += [f"--port={port}", "--ServerApp.port_retries=0", "--log-level=ERROR"]
    command += [f"--ServerApp.root_dir={served}", f"--LabApp.app_settings_dir={home}"]
    environment = build_notebooks.kernel_environment(home)
    environment |= {"HOME": str(home), "JUPYTER_TOKEN": token, "JUPYTER_CONFIG_DIR": f"{home}/c"}
    environment |= {"JUPYTER_DATA_DIR": f"{home}/d", "JUPYTER_RUNTIME_DIR": f"{home}/r"}
    with (home / "log").open("w") as log:
        server = subprocess.Popen(command, env=environment, stdout=log, stderr=subprocess.STDOUT)
    try:
        wait_for(f"http://127.0.0.1:{port}/api", server, home / "log")
        yield f"http://127.0.0.1:{port}/lab/tree/{NAME}.ipynb?token={token}"
    finally:
        server.terminate()
        server.wait(20)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def wait_for(url, server, log):
    deadline = time.monotonic() + STARTUP_S
    while time.monotonic() < deadline and server.poll() is None:
        try:
            urllib.request.urlopen(url, timeout=5).close()
            return
        except OSError:  # not listening yet
            time.sleep(0.2)
    raise RuntimeError(f"JupyterLab did not start: {log.read_text()[-2000:]}")


@pytest.fixture(scope="module")
def opened(address):
    """The page with notebook 01 as it opens, before anything has run."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        arguments = f"{QUIET} {NO_NEWS}".split()
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=arguments)
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.set_default_timeout(20_000)
        page.goto(address)
        page.locator(".jp-CodeCell").last.wait_for(state="attached", timeout=NOTEBOOK_MS)
        page.locator(".jp-KernelName", has_text="Python 3").wait_for()  # idle until then, too
        page.locator(".jp-Notebook-ExecutionIndicator[data-status=idle]").wait_for()
        yield page
        browser.close()


@pytest.fixture(scope="module")
def page(opened):
    """The page after Run All Cells."""
    from playwright.sync_api import expect

    opened.get_by_role("menuitem", name="Run", exact=True).click()
    opened.locator("[data-command='runmenu:run-all']").click()
    prompt = opened.locator(".jp-CodeCell .jp-InputArea-prompt").last
    expect(prompt).to_have_text("[*]:")
    expect(prompt).to_have_text(re.compile(r"\[\d+\]:"), timeout=NOTEBOOK_MS)
    yield opened
    photograph(opened)


def photograph(page):
    """The whole notebook as a student sees it, a screenful a file."""
    shutil.rmtree(SCREENSHOTS, ignore_errors=True)
    SCREENSHOTS.mkdir(parents=True)
    scroller = page.locator(".jp-WindowedPanel-outer").first
    screenful = scroller.evaluate("e => e.clientHeight")
    height = page.locator(".jp-Cell").last.evaluate(
        """e => e.getBoundingClientRect().bottom
              + e.closest(".jp-WindowedPanel-outer").scrollTop"""
    )
    for number, top in enumerate(range(0, int(height), screenful - 40), 1):
        scroller.evaluate("(e, top) => { e.scrollTop = top }", top)
        page.wait_for_timeout(150)
        page.screenshot(path=SCREENSHOTS / f"{NAME}-{number:02}.png")


def cell_with(page, source):
    return page.locator(".jp-CodeCell").filter(has=page.locator(".cm-content", has_text=source))


def answers(page):
    """The notebook's answer cells, and how many there should be."""
    stored = build_notebooks.read(build_notebooks.NOTEBOOKS / f"{NAME}.ipynb")
    roles = [build_notebooks.role(cell) for cell in build_notebooks.code_cells(stored)]
    return page.locator(".jp-InputPlaceholder"), sum(part == "answer" for _, part in roles)


def plain(text):
    return re.sub("[*`]", "", text)


def test_answers_are_collapsed_on_load(opened):
    from playwright.sync_api import expect

    bars, count = answers(opened)
    assert count > 0
    expect(bars).to_have_count(count)
    for bar in bars.all():
        expect(bar).to_contain_text("# An answer")


def test_run_all_shows_no_error_and_no_answer(page):
    outputs = page.locator(".jp-OutputArea-output")
    kinds = outputs.evaluate_all('all => all.map(e => e.dataset.mimeType ?? "")')
    assert len(kinds) > 20
    assert [kind for kind in kinds if kind.endswith((".error", ".stderr"))] == []
    bars, count = answers(page)
    assert bars.count() == count


def test_each_checkpoint_and_figure_becomes_a_widget(page):
    asked = cell_with(page, "ck.checkpoint(").count()
    assert asked == len([n for n in ck.lessons.checkpoints() if n.startswith("pinhole.")])
    assert cell_with(page, "ck.checkpoint(").get_by_role("button", name="Commit").count() == asked
    figures = cell_with(page, "ck.drag(")
    assert figures.locator("img.widget-image").count() == figures.count() > 0


def test_a_choice_explains_each_answer(page):
    from playwright.sync_api import expect

    checkpoint = ck.lessons.checkpoints()["pinhole.twice_as_far"]
    cell = cell_with(page, checkpoint.name)
    for letter, right in (("C", False), ("B", True)):
        option = checkpoint.lettered()[letter]
        assert option.right is right
        cell.get_by_role("radio", name=f"{letter}. {option.text}").check()
        cell.get_by_role("button", name="Commit").click()
        said = cell.locator(".widget-html-content").last
        expect(said).to_contain_text(f"{letter}, {option.text}: {'right' if right else 'not this'}")
        expect(said).to_contain_text(plain(option.why))


def test_a_number_explains_each_answer(page):
    from playwright.sync_api import expect

    checkpoint = ck.lessons.checkpoints()["pinhole.pitch"]
    cell = cell_with(page, checkpoint.name)
    for typed, why in (("500", checkpoint.classics[1].why), ("2000", checkpoint.why)):
        cell.get_by_role("textbox").last.fill(typed)
        cell.get_by_role("button", name="Commit").click()
        expect(cell.locator(".widget-html-content").last).to_contain_text(plain(why))


def test_a_slider_redraws_its_figure(page):
    cell = cell_with(page, "similar_triangles")
    image = cell.locator("img.widget-image")
    before = shown(image)
    handle = cell.locator(".noUi-handle").last
    handle.focus()
    handle.press("ArrowRight")
    deadline = time.monotonic() + 20
    while shown(image) == before and time.monotonic() < deadline:
        page.wait_for_timeout(50)
    assert shown(image) != before


def shown(image):
    """The bytes of the PNG file that the page shows."""
    read = "async e => Array.from(new Uint8Array(await (await fetch(e.src)).arrayBuffer()))"
    return bytes(image.evaluate(read))
