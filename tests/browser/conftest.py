"""A headless Chromium, and pages that fail a test when they print an error to the console."""

import os
import shutil

import pytest

CHROMIUM = ("chromium", "chromium-browser", "google-chrome")
SLOW_MS = 120_000  # a shared machine may take long


@pytest.fixture(scope="session")
def browser():
    """The Chromium of the system, or the one that playwright downloaded."""
    playwright = pytest.importorskip("playwright.sync_api", reason="run `make test-browser`")
    found = next((path for path in map(shutil.which, CHROMIUM) if path), None)
    sandbox = ["--no-sandbox"] if os.getuid() == 0 else []  # Chromium refuses its sandbox to root
    with playwright.sync_playwright() as running:
        chromium = running.chromium.launch(executable_path=found, args=sandbox)
        yield chromium
        chromium.close()


@pytest.fixture
def open_page(browser):
    """A function that opens an address in a page of its own; errors of the page fail the test when it ends."""
    errors, contexts = [], []

    def open_address(address, width=1400, theme="light"):
        context = browser.new_context(viewport={"width": width, "height": 900}, color_scheme=theme)
        context.set_default_timeout(SLOW_MS)
        contexts.append(context)
        page = context.new_page()
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.goto(address)
        return page

    yield open_address
    for context in contexts:
        context.close()
    assert errors == []
