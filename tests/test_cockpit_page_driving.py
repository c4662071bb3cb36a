"""Driving by hand on the cockpit's page in a browser: what moves the robot, and all that lets go of it."""

from __future__ import annotations

import json

import pytest
from browser_rig import DRIVING, middle_of, opened
from cockpit_fake import FakeCockpit
from playwright.sync_api import Browser, Page, expect

pytestmark = [pytest.mark.process, pytest.mark.zenoh]


def motions(fake: FakeCockpit) -> list[dict[str, float]]:
    """The motions that the page has asked for."""
    return [message["motion"] for message in fake.done("drive")]


def take(page: Page) -> None:
    """Begin to drive by hand."""
    page.click("#take-over")
    page.wait_for_selector(DRIVING)


def lets_go(fake: FakeCockpit) -> None:
    """Wait until the page has told that nothing is held."""
    fake.until(lambda: motions(fake)[-1:] == [{}])


def moved(fake: FakeCockpit) -> dict[str, float]:
    return motions(fake)[-1] if motions(fake) else {}


def test_a_held_key_moves_the_robot_and_nothing_is_sent_when_it_is_released(page: Page, fake: FakeCockpit) -> None:
    take(page)
    page.keyboard.down("KeyW")
    fake.until(lambda: len(fake.world.driven) > 8 and fake.world.speed_mps > 0.1)
    ticks = [message["tick"] for message in fake.done("drive")]
    assert ticks == sorted(ticks)
    page.keyboard.up("KeyW")
    lets_go(fake)
    sent = len(fake.done("drive"))
    fake.until(lambda: sum(message["do"] == "seen" for message in fake.asked[-8:]) == 8)  # for half a second
    assert len(fake.done("drive")) == sent
    page.keyboard.press("Escape")
    fake.until(lambda: fake.done("end-drive"))


@pytest.mark.parametrize(
    "happens",
    [
        "window.dispatchEvent(new Event('blur'))",
        "window.dispatchEvent(new Event('pagehide'))",
        "Object.defineProperty(document, 'hidden', { value: true });"
        " document.dispatchEvent(new Event('visibilitychange'))",
        "window.dispatchEvent(new KeyboardEvent('keydown', { key: 'Alt', altKey: true }))",
        "{ const end = performance.now() + 500; while (performance.now() < end); }",
    ],
    ids=["blur", "pagehide", "hidden", "system key", "frozen"],
)
def test_what_takes_the_person_from_the_controls_lets_go_for_good(page: Page, fake: FakeCockpit, happens: str) -> None:
    take(page)
    page.keyboard.down("KeyW")
    fake.until(lambda: len(fake.world.driven) > 3)
    page.evaluate(happens)
    lets_go(fake)
    page.keyboard.down("KeyW")  # a repetition of the key that is still down
    page.keyboard.up("KeyW")
    assert motions(fake)[-1] == {}


def test_a_page_that_is_closed_leaves_a_robot_that_stands(chromium: Browser, fake: FakeCockpit) -> None:
    with opened(chromium, fake.url) as page:
        take(page)
        page.keyboard.down("KeyW")
        fake.until(lambda: fake.world.speed_mps > 0.1)
        page.close()
    with opened(chromium, fake.url) as other:
        other.wait_for_selector("#now-task:has-text('Drive by hand')")
        fake.until(lambda: fake.world.speed_mps == 0.0)


def test_a_robot_that_does_not_answer_is_said_to_stand(page: Page, fake: FakeCockpit) -> None:
    take(page)
    page.keyboard.down("KeyW")
    fake.until(lambda: fake.world.speed_mps > 0.1)
    fake.answers = False
    expect(page.locator("#drive-state")).to_contain_text("too slow")
    page.keyboard.up("KeyW")


def test_stop_ends_driving_by_hand(page: Page, fake: FakeCockpit) -> None:
    take(page)
    page.keyboard.down("KeyW")
    fake.until(lambda: fake.world.speed_mps > 0.1)
    page.keyboard.press("Space")
    expect(page.locator(DRIVING)).to_have_count(0)
    page.keyboard.up("KeyW")
    fake.until(lambda: fake.world.latch == "latched")
    assert motions(fake)[-1] == {}


def test_two_thumbs_drive_and_look_at_once_on_a_phone(chromium: Browser, fake: FakeCockpit) -> None:
    with opened(chromium, fake.url, "phone", has_touch=True, is_mobile=True) as page:
        page.click(".tabs [data-tab=drive]")
        page.click("#begin-drive")
        page.wait_for_selector(DRIVING)
        points = [middle_of(page, "#stick-base"), middle_of(page, "#stick-part")]
        devices = page.context.new_cdp_session(page)

        def touch(kind: str, at: list[dict[str, float]]) -> None:
            devices.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": at})

        touch("touchStart", [{"x": x, "y": y, "id": index} for index, (x, y) in enumerate(points)])
        (x, y), (u, v) = points
        touch("touchMove", [{"x": x, "y": y - 60, "id": 0}, {"x": u + 60, "y": v, "id": 1}])
        fake.until(lambda: {"speed_mps", "pan_radps"} <= moved(fake).keys())
        assert moved(fake)["speed_mps"] > 0.1
        assert moved(fake)["pan_radps"] < -0.1
        touch("touchEnd", [])
        lets_go(fake)


def test_a_gamepad_moves_the_robot_only_while_a_shoulder_is_held_and_its_b_stops(
    chromium: Browser, fake: FakeCockpit
) -> None:
    pad = {"connected": True, "axes": [0, -1, 0, 0], "buttons": [{"pressed": False, "value": 0}] * 16}
    with opened(chromium, fake.url) as page:
        page.evaluate(f"window.pad = {json.dumps(pad)}; navigator.getGamepads = () => [window.pad]")
        page.evaluate("window.dispatchEvent(new Event('gamepadconnected'))")
        take(page)
        press = "window.pad.buttons[{}] = {{ pressed: {}, value: 1 }}"
        page.evaluate(press.format(4, "true"))
        fake.until(lambda: fake.world.speed_mps > 0.1)
        page.evaluate(press.format(4, "false"))
        lets_go(fake)
        page.evaluate(press.format(1, "true"))
        fake.until(lambda: fake.done("stop"))
