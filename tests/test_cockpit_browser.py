"""The cockpit in a browser, with a whole simulated robot: seen, sent, stopped, driven by hand, and watched again.

One robot and one browser for all tests of this file, which run in their order: each begins where the robot stands.
"""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Coroutine, Iterator
from contextlib import suppress
from typing import Any, TypeVar

import pytest
from browser_rig import DRIVING, opened
from faults_live import PROCESSES, LiveRobot, live
from operator_shell import PATIENCE_S
from playwright.sync_api import Browser, Error, Page, expect

from cocoro import topics

pytestmark = [pytest.mark.process, pytest.mark.sim, pytest.mark.zenoh]

T = TypeVar("T")
AT_REST_S = 0.6
"""Simulated time after which a robot that nobody drives any more stands; half of it is how late the test may notice."""
ANY_PORT = "[service.cockpit]\nport = 0\n"
SCENE = """
name = "far"
[[object]]
label = "red_can"
shape = "cylinder"
radius_m = 0.033
height_m = 0.12
position_m = [2.7, 0.15]
[[object]]
label = "green_can"
shape = "cylinder"
radius_m = 0.033
height_m = 0.12
position_m = [2.6, -0.5]
"""
"""The camera at rest sees the floor from 2.3 m on."""
expect.set_options(timeout=PATIENCE_S * 1e3)


class Beside:
    """A robot with its observer, whose loop runs in a thread: the browser has this one."""

    def __init__(self, loop: asyncio.AbstractEventLoop, robot: LiveRobot) -> None:
        self._loop = loop
        self.robot = robot
        said = next(line for line in robot.up.lines if "cockpit: http" in line)
        self.url = said.partition("cockpit: ")[2].split()[0]

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()

    def stands(self) -> None:
        """The robot is at rest soon, and stays so, by the true state."""
        robot = self.robot
        since_s = self.run(robot.surely_now_s()) + AT_REST_S
        self.run(robot.until(lambda: robot.now_s >= since_s + 0.5))
        assert robot.stood_since(since_s)


@pytest.fixture(scope="module")
def beside(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Beside]:
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    folder = tmp_path_factory.mktemp("cockpit")
    (folder / "far.toml").write_text(SCENE)
    # STOP reaches all robots of a name on this machine: this one has its own.
    life = live(
        folder, name="seen", scene=folder / "far.toml", mesh=ANY_PORT, processes=(*PROCESSES, "capture", "cockpit")
    )
    (folder / "state").mkdir(mode=0o700)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COCORO_STATE_DIR", str(folder / "state"))
        robot = asyncio.run_coroutine_threadsafe(life.__aenter__(), loop).result()
    try:
        yield Beside(loop, robot)
    finally:
        asyncio.run_coroutine_threadsafe(life.__aexit__(None, None, None), loop).result()
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@pytest.fixture
def page(chromium: Browser, beside: Beside) -> Iterator[Page]:
    with opened(chromium, beside.url) as shown:
        shown.set_default_timeout(PATIENCE_S * 1e3)
        yield shown


def next_picture(page: Page) -> None:
    """Wait for another picture than the one that is shown."""
    page.wait_for_function(
        "shown => ![undefined, shown].includes(document.getElementById('picture').dataset.stamp)",
        arg=page.evaluate("document.getElementById('picture').dataset.stamp ?? null"),
    )


def click_on(page: Page, beside: Beside, label: str) -> None:
    """Click on an object where perception sees it."""
    robot = beside.robot
    beside.run(
        robot.until(lambda: any(found.label == label for found in robot.heard(topics.DETECTIONS)[-1].detections))
    )
    seen = robot.heard(topics.DETECTIONS)[-1]
    mark = next(found for found in seen.detections if found.label == label)
    box = page.locator("#picture").bounding_box()
    assert box is not None
    scale = min(box["width"] / seen.width, box["height"] / seen.height)
    left, top = (box["width"] - seen.width * scale) / 2, (box["height"] - seen.height * scale) / 2
    page.click("#picture", position={"x": left + mark.u_px * scale, "y": top + mark.v_px * scale})


def release(page: Page) -> None:
    page.wait_for_selector("#release:visible")
    while page.locator("#release").is_visible():  # it takes no press that comes too soon
        with suppress(Error):
            page.click("#release", timeout=1000)


def test_a_can_is_fetched_by_a_click_on_it_in_the_moving_picture_and_stop_holds_the_robot(
    page: Page, beside: Beside
) -> None:
    page.wait_for_selector("#veil", state="hidden")
    for _ in range(3):
        next_picture(page)
    click_on(page, beside, "red_can")
    page.click("#menu button:has-text('Fetch')")
    expect(page.locator("#now-task")).to_have_text("Fetch red can")
    beside.run(beside.robot.drives())
    page.click("#stop")
    expect(page.locator("#stop-state")).to_contain_text("base")
    beside.stands()
    expect(page.locator("#now-task")).to_have_text("Fetch red can — stopped")
    release(page)


def test_a_robot_that_follows_is_stopped_by_the_space_bar(page: Page, beside: Beside) -> None:
    page.click("#objects button:has-text('green can')")
    page.click("#tasks button:has-text('Follow')")
    beside.run(beside.robot.drives(0.05))
    page.keyboard.press("Space")
    expect(page.locator("#stop-state")).to_contain_text("base")
    beside.stands()
    release(page)


def test_a_robot_that_is_driven_by_a_held_key_stands_when_the_page_crashes(page: Page, beside: Beside) -> None:
    page.click("#take-over")
    page.wait_for_selector(DRIVING)
    page.keyboard.down("KeyA")  # on the spot first: nothing is in the way
    beside.run(beside.robot.until(lambda: abs(beside.robot.heard(topics.BASE_STATE)[-1].turn_rate_radps) > 0.2))
    with suppress(Error):
        page.goto("chrome://crash")
    robot = beside.robot
    since_s = beside.run(robot.surely_now_s()) + AT_REST_S
    beside.run(robot.until(lambda: robot.now_s >= since_s + 0.5))
    turned = [state.turn_rate_radps for state in robot.heard(topics.BASE_STATE) if state.stamp_ns >= since_s * 1e9]
    assert turned
    assert max(map(abs, turned)) < 0.02


def test_what_was_recorded_is_watched_on_the_same_screen(page: Page, beside: Beside) -> None:
    page.click("#open-captures")
    page.click("#captures li:has-text('Fetch red can') button:first-of-type")
    expect(page.locator("#link-state")).to_have_text("capture: Fetch red can")
    for _ in range(3):
        next_picture(page)
    expect(page.locator("#now-task")).to_contain_text("Fetch red can")
    page.wait_for_selector("#map[data-cells]")
    page.click("#play-pause")
    expect(page.locator("#play-pause")).to_have_attribute("aria-label", "Play")
    page.click("#play-end")
    next_picture(page)
