"""A newcomer's first minute: from the opening of the cockpit's page until the can is in the hand, by two clicks.

For each trial a simulated robot is started. A browser opens the page, sees a picture, chooses the can and presses the
page's main button; the page must then say by itself that the can is in the hand, and the robot must put it down when
it is asked to, which it refuses with an empty hand. The trials take turns between a laptop and a phone. What a person
needs to read the page comes in addition.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page, expect

from bench.browser import browser
from bench.cockpit_pictures import started
from bench.live import Operator, operator
from bench.report import Report
from bench.trials import Runs, number_of, sized
from cocoro.errors import CocoroError

MINUTE_S = 60.0
PATIENCE_MS = 120_000.0
SIZES: dict[str, dict[str, Any]] = {
    "desk": {"viewport": {"width": 1280, "height": 800}},
    "phone": {"viewport": {"width": 360, "height": 640}, "has_touch": True, "is_mobile": True},
}


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="newcomers, each with a robot of his own (4)")
    parser.add_argument("--pictures", type=Path, metavar="DIR", help="write the screen there at each step, as PNG")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    runs = Runs(report)
    ups: list[float] = []
    took: list[float] = []
    with browser() as chromium:
        for number in range(sized(chosen, chosen.count, 4, 1)):
            size = [*SIZES][number % len(SIZES)]
            with operator() as cocoro:
                begun_s = time.monotonic()
                port = started(cocoro)
                ups.append(time.monotonic() - begun_s)
                screens = Screens(chosen.pictures, size)
                seconds = _fetches(chromium, port, size, screens)
                held = _holds(cocoro)
            took.append(seconds)
            runs.add(held, f"{number}: {size}: the page says that the can is in the hand after {seconds:.1f} s")
    runs.share("the can is in the hand, and is put down when that is asked for")
    report.value("`cocoro up sim`, until the page's address is told", ups, "s")
    report.value("from the page's opening to the can in the hand", took, "s", at_most=MINUTE_S)


class Screens:
    """Writes what a page shows at each step, where a folder was given."""

    def __init__(self, folder: Path | None, size: str) -> None:
        self._folder, self._size = folder, size

    def write(self, page: Page, step: str) -> None:
        if self._folder is not None:
            page.screenshot(path=self._folder / f"{self._size}-{step}.png")


def _fetches(chromium: Browser, port: int, size: str, screens: Screens) -> float:
    """A newcomer opens the page and fetches the red can; returns how long that took, s."""
    context = chromium.new_context(**SIZES[size])
    try:
        page = context.new_page()
        page.set_default_timeout(PATIENCE_MS)
        begun_s = time.monotonic()
        page.goto(f"http://127.0.0.1:{port}/")
        page.wait_for_selector("#veil", state="hidden")
        screens.write(page, "1-opened")
        page.click("#objects button:has-text('red can')")
        page.click("#tasks button:has-text('Fetch red can')")
        page.wait_for_selector("#now-task:has-text('Fetch red can')")
        screens.write(page, "2-begun")
        expect(page.locator("#now-why")).to_have_text("In the hand: red can.", timeout=PATIENCE_MS)
        seconds = time.monotonic() - begun_s
        screens.write(page, "3-held")
        return seconds
    finally:
        context.close()


def _holds(cocoro: Operator) -> bool:
    """Whether the robot puts something down when it is told to. Raises CocoroError when it does not for another reason
    than an empty hand."""
    code, said, _ = cocoro("put-down", "--robot", cocoro.run_dir.robot)
    if code and "hold" not in said:
        raise CocoroError(said)
    return code == 0
