"""How old a picture is when a browser has it on the screen, and how many there are in a second.

The cockpit's page in Chromium looks at a simulated robot with all its services and the recorder. Beside each picture
the page draws a letter in the same frame; the browser's own paint timing (Element Timing) tells when that frame was
presented. The age counts from the picture's stamp, which is 33 ms before the camera delivers it, by the simulator's
record of when each stamp was. There is no window: what a real screen adds (half of its period, mostly) is not in it.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from playwright.sync_api import Browser, Page

from bench.browser import browser, page_clock_ns
from bench.cockpit_clock import StampClock
from bench.cockpit_pictures import OLD_MS, SETTLED_S, started
from bench.live import operator
from bench.report import Report, percentile
from bench.trials import number_of, sized
from cocoro.errors import CocoroError

LEAST_HZ = 15.0
DESK = {"width": 1280, "height": 800}
PAINTED = """
window.painted = [];
addEventListener("DOMContentLoaded", () => {
  const canvas = document.getElementById("picture");
  const corner = document.createElement("div");
  corner.style.position = "fixed";
  corner.style.top = corner.style.left = "0";
  document.body.append(corner);
  new PerformanceObserver((found) => {
    for (const entry of found.getEntries()) window.painted.push([entry.identifier, entry.renderTime]);
  }).observe({ type: "element" });
  new MutationObserver(() => {
    const letter = document.createElement("div");
    letter.setAttribute("elementtiming", canvas.dataset.stamp);
    letter.textContent = "x";
    corner.replaceChildren(letter);
  }).observe(canvas, { attributes: true, attributeFilter: ["data-stamp"] });
});
"""
"""Lists each picture's stamp and when the frame with it was presented, ms of the page's clock."""


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="pages, one after the other (3)")
    parser.add_argument("--seconds", type=float, help="for which each is watched (15)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    count, seconds = sized(chosen, chosen.count, 3, 1), sized(chosen, chosen.seconds, 15.0, 3.0)
    ages: list[float] = []
    rates: list[float] = []
    with operator() as cocoro:
        motion = cocoro.run_dir.root / "motion"
        port = started(cocoro, "--set", f"service.sim.motion={json.dumps(str(motion))}")
        with browser() as chromium:
            for _ in range(count):
                found = _watch(chromium, port, seconds, motion)
                ages += found
                rates.append(len(found) / seconds)
                report.say(f"{len(found)} pictures in {seconds:g} s")
    report.value("from the picture's stamp to the screen", ages, "ms", at_most=OLD_MS)
    report.value("the same, 99 of 100 pictures", [percentile(ages, 99.0)], "ms")
    report.value("pictures a second on the screen", rates, "Hz", at_least=LEAST_HZ)


def _watch(chromium: Browser, port: int, seconds: float, motion: Path) -> list[float]:
    """The ages of the pictures that a new page has shown in this time, ms. Raises CocoroError when it shows none."""
    context = chromium.new_context(viewport=DESK)  # type: ignore[arg-type]
    try:
        page = context.new_page()
        page.add_init_script(PAINTED)
        page.goto(f"http://127.0.0.1:{port}/")
        page.wait_for_selector("#veil", state="hidden")
        time.sleep(SETTLED_S)
        origin_ns, error_ns = page_clock_ns(page)
        if error_ns > 5_000_000:
            raise CocoroError(f"this machine is too busy to compare clocks: to {error_ns / 1e6:.1f} ms")
        painted = _painted(page, seconds)
    finally:
        context.close()
    if not painted:
        raise CocoroError("the page has shown no picture")
    clock = StampClock.of_file(motion)
    return [(origin_ns + shown_ms * 1e6 - clock.real_ns(int(stamp))) / 1e6 for stamp, shown_ms in painted]


def _painted(page: Page, seconds: float) -> list[Any]:
    """Stamps of the pictures that the page shows in this time, and when, ms by its clock."""
    since_ms = page.evaluate("performance.now()")
    time.sleep(seconds)
    found: list[Any] = page.evaluate(
        "([since, until]) => window.painted.filter(([_, at]) => at >= since && at < until)",
        [since_ms, since_ms + seconds * 1e3],
    )
    return found
