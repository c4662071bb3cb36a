"""A browser for benches: Debian's Chromium without a window, with a profile of its own."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager

from playwright.sync_api import Browser, Page, sync_playwright

from cocoro.errors import ConfigError

CHROMIUM = "chromium"
FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update",
)  # fmt: skip
READINGS = 15
"""Round trips of which the shortest compares the clocks."""


@contextmanager
def browser() -> Iterator[Browser]:
    """A browser that runs while the context lasts. Raises ConfigError where there is none."""
    program = shutil.which(CHROMIUM)
    if program is None:
        raise ConfigError(f"there is no {CHROMIUM}: on Debian `apt-get install chromium` brings it")
    with sync_playwright() as playwright:
        started = playwright.chromium.launch(executable_path=program, args=[*FLAGS])
        try:
            yield started
        finally:
            started.close()


def page_clock_ns(page: Page) -> tuple[int, int]:
    """CLOCK_MONOTONIC (ns) at the origin of the page's own clock (`performance.now()`), and how far that may be off,
    ns: half of the shortest round trip."""
    readings = []
    for _ in range(READINGS):
        before_ns = time.monotonic_ns()
        page_ms = page.evaluate("performance.now()")
        after_ns = time.monotonic_ns()
        readings.append(((after_ns - before_ns) // 2, (before_ns + after_ns) // 2 - round(page_ms * 1e6)))
    error_ns, origin_ns = min(readings)
    return origin_ns, error_ns
