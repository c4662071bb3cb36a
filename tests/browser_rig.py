"""A browser for tests: Debian's Chromium, with a profile of its own."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import Browser, Page, sync_playwright

CHROMIUM = "chromium"
FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
]  # fmt: skip
DRIVING = "#app[data-driving]"
"""What is there while this page drives by hand."""
SIZES = {"phone": (360, 640), "desk": (1280, 800), "wall": (3840, 2160)}


@contextmanager
def browser(*flags: str) -> Iterator[Browser]:
    """A browser; the test is skipped where there is none."""
    program = shutil.which(CHROMIUM)
    if program is None:
        pytest.skip(f"SKIPPED, NOT PROVEN HERE: there is no {CHROMIUM}; on Debian `apt-get install chromium` brings it")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=[*FLAGS, *flags])
        try:
            yield started
        finally:
            started.close()


@contextmanager
def opened(browser: Browser, url: str, size: str = "desk", **options: Any) -> Iterator[Page]:
    """The page, when it is connected. Whatever it complains of fails the test."""
    width, height = SIZES[size]
    context = browser.new_context(viewport={"width": width, "height": height}, **options)
    complaints: list[str] = []
    try:
        page = context.new_page()
        page.on("pageerror", lambda error: complaints.append(str(error)))
        page.on("console", lambda told: complaints.extend([told.text] if told.type == "error" else []))
        page.goto(url)
        page.wait_for_selector("#link-state[data-state=live]")
        page.wait_for_selector("#open-health[data-state]")
        yield page
    finally:
        context.close()
    refused = [text for text in complaints if "WebSocket" not in text and "ERR_CONNECTION_REFUSED" not in text]
    assert not refused, refused


def unfit(page: Page) -> list[str]:
    """What is wrong with the page for people who see, hear or move less, by the rules of axe-core."""
    found = Axe().run(page).response
    assert len(found["passes"]) > 10  # it has looked
    return [f"{fault['id']}: {fault['help']}: {fault['nodes'][0]['html'][:150]}" for fault in found["violations"]]


def middle_of(page: Page, selector: str) -> tuple[float, float]:
    box = page.locator(selector).bounding_box()
    assert box is not None
    return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2


def at_the_middle_of(page: Page, selector: str) -> str:
    """The id of what a press at the middle of it would meet, or of what holds that."""
    x, y = middle_of(page, selector)
    return str(page.evaluate("([x, y]) => document.elementFromPoint(x, y).closest('[id]').id", [x, y]))
