"""The static pages in a real browser, opened from disk."""

import pytest
from common import NIGHTLY

from tools import build_site

pytestmark = pytest.mark.browser

REFERENCE = ["reference/coursekit.html", "reference/coursekit/cameras.html"]
PAGES = [*build_site.page_names().values(), *REFERENCE]
VIEWS = [(name, 390) for name in PAGES]  # where a page is too wide, it is so here
VIEWS += [(name, 1280) for name in (PAGES if NIGHTLY else PAGES[:2])]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("site")
    build_site.write(build_site.site(), path)
    return path


@pytest.fixture
def page(browser):
    opened = browser.new_page()
    yield opened
    opened.close()


@pytest.mark.parametrize(("name", "width"), VIEWS)
def test_a_page_opens_from_disk(folder, page, name, width):
    page.set_viewport_size({"width": width, "height": 844})
    asked, failed, errors = [], [], []
    page.on("request", lambda request: asked.append(request.url))
    page.on("requestfailed", lambda request: failed.append(request.url))
    page.on("pageerror", lambda error: errors.append(str(error)))
    page.on("console", lambda message: errors.append(message.text))
    page.goto((folder / name).as_uri(), wait_until="load")
    page.evaluate("document.fonts.ready.then(() => true)")

    assert len(asked) >= 2  # the page and its style sheet
    assert [url for url in asked if not url.startswith(folder.as_uri())] == []
    assert (failed, errors) == ([], [])
    assert page.evaluate("[...document.images].every(i => i.complete && i.naturalWidth > 0)")
    assert page.evaluate("document.documentElement.scrollWidth") == width
    assert page.locator("h1").is_visible()
    for details in page.locator("details:not(.toc details)").all():
        assert details.get_attribute("open") is None


def test_fences_are_as_high_as_their_matrix(folder, page):
    """The font that comes along has the table MATH: without one, nothing stretches."""
    page.goto((folder / PAGES[1]).as_uri())
    page.evaluate("document.fonts.ready.then(() => true)")
    heights = page.locator("mo:has(+ mtable), mo + mtable").evaluate_all(
        "all => all.map(e => e.getBoundingClientRect().height)"
    )
    assert len(heights) >= 6
    for fence, matrix in zip(heights[::2], heights[1::2], strict=True):
        assert fence == pytest.approx(matrix, rel=0.15)
