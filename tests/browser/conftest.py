"""One headless Chromium for all tests of pages."""

import os
import shutil

import pytest

QUIET = "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-sync"
NO_NEWS = "--disable-background-networking --disable-component-update"


@pytest.fixture(scope="session")
def browser():
    names = ("chromium", "chromium-browser", "google-chrome")
    path = next(filter(None, map(shutil.which, names)), None)
    if path is None and os.environ.get("CI") == "true":
        pytest.fail("no Chromium, and CI must run this test")
    if path is None:
        pytest.skip("not run: no Chromium")
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        arguments = f"{QUIET} {NO_NEWS}".split()
        launched = playwright.chromium.launch(executable_path=path, args=arguments)
        yield launched
        launched.close()
