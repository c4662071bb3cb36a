"""The cockpit's page in a browser, against a made-up robot that speaks the same protocol."""

from __future__ import annotations

import json
import re
from typing import Any

import pytest
from browser_rig import DRIVING, SIZES, at_the_middle_of, opened, unfit
from cockpit_fake import PAGE, FakeCockpit
from playwright.sync_api import Browser, Page, expect

pytestmark = [pytest.mark.process, pytest.mark.zenoh]

BROKEN = """() => {
    const send = WebSocket.prototype.send;
    WebSocket.prototype.send = function (text) {
        if (text.includes('"stop"')) throw new Error("no network");
        send.call(this, text);
    };
}"""
"""Sockets take everything but a stop."""
TOO_SOON = """() => {
    const release = document.getElementById("release");
    const watch = new MutationObserver(() => {
        if (release.hidden) return;
        watch.disconnect();
        release.click();
        window.pressed = true;
    });
    watch.observe(release, { attributes: true });
}"""
"""Releases the robot in the moment in which that can be done."""


def place_of(page: Page, fake: FakeCockpit, label: str) -> dict[str, float]:
    """Where an object is in the canvas of the picture, CSS pixels."""
    box = page.locator("#picture").bounding_box()
    assert box is not None
    scale = min(box["width"] / 640, box["height"] / 480)
    mark = next(mark for mark in fake.world.seen() if mark["label"] == label)
    left, top = (box["width"] - 640 * scale) / 2, (box["height"] - 480 * scale) / 2
    return {"x": left + mark["u"] * scale, "y": top + mark["v"] * scale}


# --- looking ----------------------------------------------------------------------------------------


def test_pictures_come_and_each_is_acknowledged_by_its_own_stamp(page: Page, fake: FakeCockpit) -> None:
    page.wait_for_selector("#veil", state="hidden")
    fake.until(lambda: len(fake.done("seen")) > 3)
    stamps = [message["stamp_ns"] for message in fake.done("seen")]
    assert stamps == sorted(set(stamps))
    assert set(stamps) <= set(fake.stamps)  # to the last digit, though JavaScript has not so many


def test_a_picture_that_is_old_is_veiled_with_its_age(page: Page, fake: FakeCockpit) -> None:
    page.wait_for_selector("#veil", state="hidden")
    fake.sees = False
    expect(page.locator("#veil")).to_contain_text("s old", timeout=30_000)


def test_a_lost_connection_is_said_and_comes_back_by_itself(chromium: Browser) -> None:
    with FakeCockpit() as fake, opened(chromium, fake.url) as page:
        port = int(fake.url.rstrip("/").rpartition(":")[2])
        fake.close()
        expect(page.locator("#link-state")).to_have_attribute("data-state", "lost", timeout=30_000)
        with FakeCockpit(port=port):
            expect(page.locator("#link-state")).to_have_attribute("data-state", "live", timeout=30_000)


def test_services_log_and_captures_open_one_at_a_time_and_never_over_stop(page: Page) -> None:
    for name in ("health", "captures", "log"):
        page.click(f"#open-{name}")
        for each in ("health", "captures", "log"):
            expect(page.locator(f"#{each}")).to_be_visible(visible=each == name)
        assert at_the_middle_of(page, "#stop") == "stop"
    expect(page.locator("#log .lines li").first).to_contain_text("drives around the box")
    page.keyboard.press("Escape")
    expect(page.locator("#log")).to_be_hidden()


# --- tasks ------------------------------------------------------------------------------------------


def test_a_click_on_a_can_offers_what_can_be_done_with_it(page: Page, fake: FakeCockpit) -> None:
    page.wait_for_selector("#veil", state="hidden")
    page.click("#picture", position=place_of(page, fake, "red_can"))  # type: ignore[arg-type]
    page.click("#menu button:has-text('Fetch')")
    fake.until(lambda: fake.done("run"))
    assert fake.done("run")[0]["task"] == {"task": "fetch", "label": "red_can"}
    expect(page.locator("#now-task")).to_have_text("Fetch red can")


def test_a_newcomer_is_told_what_to_do_first(page: Page, fake: FakeCockpit) -> None:
    expect(page.locator("#now-task")).to_have_text("Ready")
    expect(page.locator("#now-why")).to_contain_text("Choose an object")
    expect(page.locator("#tasks .first").first).to_have_text("Fetch red can")


def test_what_was_fetched_is_said_to_be_in_the_hand(page: Page, fake: FakeCockpit) -> None:
    page.click("#objects button:has-text('green can')")
    page.click("#tasks button:has-text('Fetch green can')")
    fake.until(lambda: fake.world.running)
    fake.world.end("done")
    expect(page.locator("#now-why")).to_have_text("In the hand: green can.")
    expect(page.locator("#objects button:has-text('green can') small")).to_have_text("in the hand")


def test_a_click_on_the_map_sends_the_robot_there(page: Page, fake: FakeCockpit) -> None:
    box = page.locator("#map").bounding_box()
    assert box is not None
    page.click("#map", position={"x": box["width"] * 0.5, "y": box["height"] * 0.3})
    page.click("#menu button:has-text('Drive there')")
    fake.until(lambda: fake.done("run"))
    task = fake.done("run")[0]["task"]
    assert task["task"] == "go-there"
    assert task["x_m"] > 0.3
    assert abs(task["y_m"]) < 0.05


def test_the_picture_can_be_pointed_at_with_the_keyboard_alone(page: Page, fake: FakeCockpit) -> None:
    page.wait_for_selector("#veil", state="hidden")
    page.focus("#picture")
    page.keyboard.press("ArrowDown")
    page.keyboard.press("Enter")
    expect(page.locator("#menu button").first).to_be_focused()
    page.keyboard.press("Escape")
    expect(page.locator("#picture")).to_be_focused()
    page.focus("#tasks .first")
    page.keyboard.press("Enter")
    fake.until(lambda: fake.done("run"))


def test_options_of_a_task_are_asked_for_with_their_own_units_and_defaults(page: Page, fake: FakeCockpit) -> None:
    page.click("#tasks .pair:has-text('Fetch') button:nth-child(2)")
    page.keyboard.press("Enter")  # sets the box: the space bar would stop the robot
    page.click("#options button[type=submit]")
    fake.until(lambda: fake.done("run"))
    assert fake.done("run")[0]["task"] == {"task": "fetch", "label": "red_can", "bring": True}


def test_a_robot_that_is_busy_is_taken_from_its_task_only_when_the_person_says_so(
    page: Page, fake: FakeCockpit
) -> None:
    fake.world.begin({"task": "follow", "label": "green_can"}, False)
    expect(page.locator("#cancel")).to_be_visible()
    page.click("#tasks button:has-text('Park')")
    page.click(".notice button:has-text('instead')")
    fake.until(lambda: len(fake.done("run")) == 2)
    assert [message["instead"] for message in fake.done("run")] == [False, True]
    expect(page.locator("#now-task")).to_have_text("Park the arm")


def test_a_refusal_is_shown_in_the_robots_own_words(page: Page, fake: FakeCockpit) -> None:
    fake.world.latch = "latched"
    page.click("#tasks .first")
    expect(page.locator(".notice")).to_contain_text("refused: the robot is stopped")


def test_a_viewer_can_stop_and_nothing_else(chromium: Browser) -> None:
    with FakeCockpit(role="viewer") as fake, opened(chromium, fake.url) as page:
        expect(page.locator("#viewer")).to_be_visible()
        assert page.locator("#tasks button:visible, #objects button:visible, #take-over:visible").count() == 0
        page.click("#stop")
        fake.until(lambda: fake.done("stop"))
        expect(page.locator("#stop-state")).to_contain_text("Stopped")
        expect(page.locator("#release")).to_be_hidden()


# --- stop -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("focus", ["body", "#tasks .first", "#theme", "#options input"])
def test_space_stops_wherever_the_focus_is_and_presses_no_button(page: Page, fake: FakeCockpit, focus: str) -> None:
    if "options" in focus:
        page.click("#tasks .pair:has-text('Go to') button:nth-child(2)")
    page.focus(focus)
    page.keyboard.press("Space")
    fake.until(lambda: fake.done("stop") and fake.done("posted"))
    expect(page.locator("#stop-state")).to_contain_text("base, servos")
    assert not fake.done("run")


def test_stop_reaches_the_robot_without_a_socket(page: Page, fake: FakeCockpit) -> None:
    page.evaluate(BROKEN)
    page.click("#stop")
    fake.until(lambda: fake.done("posted"))
    expect(page.locator("#stop-state")).to_contain_text("base, servos")


def test_a_stop_that_nobody_acknowledges_is_repeated_and_said(page: Page, fake: FakeCockpit) -> None:
    fake.stops = False
    page.click("#stop")
    fake.until(lambda: len(fake.done("stop")) > 3)
    expect(page.locator("#stop-state")).to_contain_text("Nobody answers", timeout=30_000)
    fake.stops = True
    expect(page.locator("#stop-state")).to_contain_text("base, servos", timeout=30_000)


def test_stop_stays_where_it_is_and_is_not_followed_by_a_release_under_the_finger(
    page: Page, fake: FakeCockpit
) -> None:
    before = page.locator("#stop").bounding_box()
    page.evaluate(TOO_SOON)
    page.click("#stop")
    page.wait_for_function("() => window.pressed")  # as a function: the page lets no string be evaluated
    assert page.locator("#stop").bounding_box() == before
    page.keyboard.press("Space")
    fake.until(lambda: len(fake.done("stop")) >= 2)
    assert not fake.done("reset")


def test_the_robot_is_released_by_its_own_button(page: Page, fake: FakeCockpit) -> None:
    fake.world.latch = "latched"
    expect(page.locator("#stop-state")).to_contain_text("is stopped")
    page.wait_for_function("() => { document.getElementById('release').click(); return true; }")
    while not fake.done("reset"):
        page.click("#release")
    expect(page.locator("#release")).to_be_hidden()


# --- captures ---------------------------------------------------------------------------------------


def test_a_capture_is_watched_on_the_same_screen_and_the_robot_can_be_stopped_meanwhile(
    page: Page, fake: FakeCockpit
) -> None:
    page.click("#open-captures")
    page.click("#captures li:has-text('Fetch red can') button:first-of-type")
    expect(page.locator("#link-state")).to_have_text("capture: Fetch red can")
    expect(page.locator("#play-time")).to_contain_text("/ 0:31")
    expect(page.locator("#tasks")).to_be_hidden()
    page.click("#play-pause")
    fake.until(lambda: fake.done("pause"))
    page.focus("#play-at")
    page.keyboard.press("PageUp")
    fake.until(lambda: fake.done("seek"))
    page.keyboard.press("Space")
    fake.until(lambda: fake.world.latch == "latched")
    page.click("#play-end")
    expect(page.locator("#link-state")).to_have_text("live")
    fake.until(lambda: [message["on"] for message in fake.done("pictures")][-2:] == [False, True])


def test_a_capture_is_deleted_only_on_a_second_press_and_pinned_or_written_ones_never(
    page: Page, fake: FakeCockpit
) -> None:
    page.click("#open-captures")
    rows = page.locator("#captures li")
    expect(rows).to_have_count(5)
    assert rows.nth(0).get_by_role("button", name="Delete").count() == 0  # is being written
    assert rows.nth(1).get_by_role("button", name="Delete").count() == 0  # is pinned
    rows.nth(2).get_by_role("button", name="Delete").click()
    assert not fake.done("delete")
    rows.nth(2).get_by_role("button", name="Really delete").click()
    fake.until(lambda: fake.done("delete"))
    assert fake.done("delete")[0]["path"] == "/captures/calliope-20261128-02"


# --- the look ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("theme", ["light", "dark"])
@pytest.mark.parametrize("size", SIZES)
def test_the_page_is_accessible_and_whole_at_every_size(
    chromium: Browser, fake: FakeCockpit, size: str, theme: Any
) -> None:
    with opened(chromium, fake.url, size, color_scheme=theme, bypass_csp=True) as page:
        page.wait_for_selector("#veil", state="hidden")
        fake.world.begin({"task": "fetch", "label": "red_can"}, False)
        page.wait_for_selector("#cancel:visible")
        assert unfit(page) == []
        width, height = SIZES[size]
        for name in ("#picture", "#stop", "#now-task", "#open-health", "#theme"):
            box = page.locator(name).bounding_box()
            assert box is not None
            assert 0 <= box["x"] <= box["x"] + box["width"] <= width, name
            assert 0 <= box["y"] <= box["y"] + box["height"] <= height, name
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert at_the_middle_of(page, "#stop") == "stop"
        page.click("#open-captures")
        page.wait_for_selector("#captures li")
        assert unfit(page) == []
        page.keyboard.press("Escape")
        if size == "phone":
            page.click(".tabs [data-tab=drive]")
        page.click("#begin-drive" if size == "phone" else "#take-over")
        page.click(".notice button:has-text('Take it')")
        page.wait_for_selector(DRIVING)
        page.wait_for_selector(".notice", state="hidden")
        assert unfit(page) == []
        for name in ("#stick-base", "#stick-part", "#hand-back"):
            assert at_the_middle_of(page, name) == name[1:]


def test_the_theme_and_the_language_are_chosen_and_remembered(page: Page, fake: FakeCockpit) -> None:
    page.click("#theme")
    page.click("#language")
    expect(page.locator("#stop b")).to_have_text("STOPP")
    page.reload()
    expect(page.locator("#stop b")).to_have_text("STOPP")
    assert page.evaluate("document.documentElement.dataset.theme") == "light"


def test_every_text_is_in_both_languages_and_none_is_missing() -> None:
    english, german = (json.loads((PAGE / "words" / f"{name}.json").read_text()) for name in ("en", "de"))
    assert english.keys() == german.keys()
    assert all(holes(english[name]) == holes(german[name]) for name in english)
    sources = [path.read_text() for path in (PAGE / "js").glob("*.js")] + [(PAGE / "index.html").read_text()]
    used = set(re.findall(r'(?:say|words)\(\s*"([\w.]+)"|data-(?:word|label)="([\w.]+)"', "\n".join(sources)))
    missing = {name for pair in used for name in pair if name} - english.keys()
    assert not missing


def test_the_page_asks_nobody_else_for_anything() -> None:
    for path in PAGE.rglob("*.*"):
        text = path.read_text().replace("http://www.w3.org/2000/svg", "")
        assert "://" not in text.replace("${scheme}://${location.host}", ""), path
        assert not re.search(r"\son\w+=|style=|<script>", text) or path.suffix != ".html", path


# --- helpers ----------------------------------------------------------------------------------------


def holes(text: str) -> set[str]:
    return set(re.findall(r"\{(\w+)\}", text))
