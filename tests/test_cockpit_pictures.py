"""The cockpit's pictures: one encoding for all, coarser and never older where a network is slow, none for nobody."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from cockpit_rig import CockpitRig, Page, cockpit

from cocoro.clock import NS
from cocoro.messages import Detection, Detections, Frame, PlannerStatus, ServoState
from cocoro.testing import in_virtual_time
from cocoro.topics import ARM_STATE, DETECTIONS, FRAME, PLAN
from services.cockpit import pictures
from services.cockpit.pictures import LOST_S, Level, Looking, levels

CAMERA_HZ = 30.0
LEVELS = levels(75)


async def film(rig: CockpitRig, seconds: float, each: Callable[[], object] = lambda: None) -> None:
    """Has the camera deliver frames, each of another shade."""
    for number in range(round(seconds * CAMERA_HZ)):
        rig.service.feed(FRAME, rig.frame(shade=number % 250))
        each()
        await rig.service.advance(1 / CAMERA_HZ)


@contextmanager
def encodings_counted(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[Level]]:
    done: list[Level] = []
    real = pictures.encode

    def counted(frame: Frame, level: Level) -> bytes:
        done.append(level)
        return real(frame, level)

    monkeypatch.setattr(pictures, "encode", counted)
    yield done


def of_joints(pan_rad: float = 0.0, tilt_rad: float = -0.4) -> ServoState:
    """The head's angles; the camera looks down."""
    names = ("neck_pan", "neck_tilt")
    return ServoState(joints=names, position_rad=(pan_rad, tilt_rad), speed_radps=(0.0, 0.0), load=(0.0, 0.0))


# --- what is sent ---------------------------------------------------------------------------------


@in_virtual_time
async def test_a_page_gets_fifteen_pictures_a_second_of_a_camera_that_makes_thirty(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        await film(rig, 2.0)
        assert len(page.pictures) == pytest.approx(30, abs=2)
        last = page.pictures[-1]
        assert (last["width"], last["height"], last["level"]) == (320, 240, "1/75")
        image = cv2.imdecode(np.frombuffer(last["jpeg"], np.uint8), cv2.IMREAD_COLOR)
        assert image is not None
        assert image.shape == (240, 320, 3)


@in_virtual_time
async def test_the_rate_is_the_asked_one_though_the_camera_has_no_frames_at_these_times(tmp_path: Path) -> None:
    async with cockpit(tmp_path, fps=20) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        await film(rig, 3.0)
        assert len(page.pictures) == pytest.approx(60, abs=2)


@in_virtual_time
async def test_a_page_that_is_late_at_times_gets_as_many_pictures_as_others(tmp_path: Path) -> None:
    async with cockpit(tmp_path, fps=15) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        for _ in range(20):
            await film(rig, 6 / CAMERA_HZ)
            page.acknowledges = False
            await film(rig, 3 / CAMERA_HZ)
            page.say("seen", stamp_ns=page.pictures[-1]["stamp_ns"])
            page.acknowledges = True
        assert len(page.pictures) == pytest.approx(90, abs=3)


def test_five_pages_share_each_encoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @in_virtual_time
    async def tried() -> None:
        async with cockpit(tmp_path) as rig, rig.page() as a, rig.page() as b, rig.page() as c:
            pages = (a, b, c)
            await rig.service.advance(0.1)
            await film(rig, 2.0)
            with encodings_counted(monkeypatch) as done:
                before = [len(page.pictures) for page in pages]
                await film(rig, 1.0)
                assert [len(page.pictures) - had for page, had in zip(pages, before, strict=True)] == [len(done)] * 3

    tried()


def test_a_page_that_wants_no_pictures_costs_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @in_virtual_time
    async def tried() -> None:
        async with cockpit(tmp_path) as rig, rig.page() as page:
            await rig.service.advance(0.1)
            page.say("pictures", on=False)
            await rig.service.advance(0.1)
            with encodings_counted(monkeypatch) as done:
                await film(rig, 1.0)
            assert (page.pictures, done) == ([], [])
            page.say("pictures", on=True)
            await rig.service.advance(0.1)
            await film(rig, 0.5)
            assert page.pictures

    tried()


@in_virtual_time
async def test_a_page_that_takes_nothing_gets_the_newest_afterwards_and_nothing_old(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        await film(rig, 0.5)
        page.stuck.clear()
        await film(rig, 2.0)
        states, had = len(page.of("state")), len(page.pictures)
        page.stuck.set()
        await rig.service.settle()
        assert len(page.of("state")) - states <= 2  # one was on its way, the newest waited
        assert len(page.pictures) - had <= 2
        await film(rig, 0.5)
        age_s = (rig.service.tester.now_ns() - page.pictures[-1]["stamp_ns"]) / NS
        assert age_s < 0.15


# --- flow control ---------------------------------------------------------------------------------


def acknowledged_after(looking: Looking, took_s: float, pictures: int, start_s: float = 0.0) -> float:
    """Sends so many pictures, each of which is acknowledged so late; returns the time."""
    now_s = start_s
    for number in range(pictures):
        assert looking.wants(now_s)
        looking.sent(number, now_s)
        assert not looking.wants(now_s + took_s / 2)
        now_s += took_s
        looking.seen(number, now_s)
    return now_s


def test_the_first_picture_is_the_coarsest_and_a_quick_network_gets_the_best_soon() -> None:
    looking = Looking(LEVELS)
    assert looking.level == LEVELS[-1]
    acknowledged_after(looking, 0.02, 12)
    assert looking.level == LEVELS[0]


def test_a_network_that_becomes_slow_gets_coarser_pictures_and_better_ones_when_it_is_quick_again() -> None:
    looking = Looking(LEVELS)
    now_s = acknowledged_after(looking, 0.02, 12)
    now_s = acknowledged_after(looking, 0.5, 12, now_s)
    assert looking.level == LEVELS[-1]
    acknowledged_after(looking, 0.02, 400, now_s)
    assert looking.level == LEVELS[0]


def test_a_network_that_is_far_away_but_quick_gets_the_best() -> None:
    looking = Looking(LEVELS)
    acknowledged_after(looking, 0.6, 20)
    assert looking.level == LEVELS[0]


def test_a_picture_that_is_never_acknowledged_keeps_the_next_back_for_some_seconds() -> None:
    looking = Looking(LEVELS)
    acknowledged_after(looking, 0.02, 12)
    looking.sent(77, 10.0)
    assert not looking.wants(10.0 + LOST_S - 0.1)
    looking.seen(55, 10.1)  # of another picture nothing follows
    assert not looking.wants(10.2)
    assert looking.wants(10.0 + LOST_S + 0.1)
    assert looking.level != LEVELS[0]


@in_virtual_time
async def test_a_slow_page_gets_coarser_pictures_and_the_others_keep_theirs(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as quick, rig.page(acknowledges=False) as slow:
        await rig.service.advance(0.1)
        waiting: list[tuple[float, int]] = []
        late_s = 0.02

        def acknowledge(page: Page = slow) -> None:
            now_s = rig.service.tester.now_ns() / NS
            waiting.extend((now_s + late_s, picture["stamp_ns"]) for picture in page.pictures[len(waiting) :])
            for at_s, stamp_ns in waiting:
                if at_s <= now_s < at_s + 1.5 / CAMERA_HZ:
                    page.say("seen", stamp_ns=stamp_ns)

        await film(rig, 3.0, acknowledge)
        assert slow.pictures[-1]["level"] == "1/75"
        late_s = 0.5
        await film(rig, 8.0, acknowledge)
        assert slow.pictures[-1]["level"] == "4/50"
        assert quick.pictures[-1]["level"] == "1/75"
        age_s = (slow.pictures[-1]["now_ns"] - slow.pictures[-1]["stamp_ns"]) / NS
        assert age_s < 0.05


def seen(*found: Detection) -> Detections:
    return Detections(frame_seq=0, frame_incarnation=0, width=640, height=480, detections=found)


# --- what is drawn in, and what is there ----------------------------------------------------------


@in_virtual_time
async def test_detections_are_marked_in_the_pixels_of_the_picture(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        found = Detection(label="red_can", u_px=320.0, v_px=240.0, area_px=900, box_px=(300, 200, 340, 280))
        await film(rig, 1.5, lambda: rig.service.feed(DETECTIONS, seen(found)))
        (mark,) = page.pictures[-1]["marks"]["detections"]
        assert (mark["label"], mark["box"], mark["u"]) == ("red_can", [150.0, 100.0, 170.0, 140.0], 160.0)
        stamp_ns = page.pictures[-1]["stamp_ns"]
        click = {"stamp_ns": stamp_ns, "u": 160.0, "v": 120.0, "width": 320, "height": 240}
        assert (await page.asks("what", picture=click))["data"]["label"] == "red_can"
        await rig.service.advance(2.0)
        await film(rig, 0.3)
        assert page.pictures[-1]["marks"]["detections"] == []  # too old for this picture


@in_virtual_time
async def test_a_click_on_the_floor_gives_its_place_and_the_place_is_drawn_where_it_was_clicked(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.1)

        def tell() -> None:
            rig.service.feed(ARM_STATE, of_joints())
            rig.service.feed(PLAN, PlannerStatus(body_m=(1.0, 2.0), body_yaw_rad=0.5))

        await film(rig, 1.5, tell)
        stamp_ns = page.pictures[-1]["stamp_ns"]
        scene = rig.cockpit.scene
        place = scene.sight.at(stamp_ns)
        assert place is not None
        down = {"stamp_ns": stamp_ns, "u": 170.0, "v": 200.0, "width": 320, "height": 240}
        floor = place.floor_at(170.0, 200.0, 320, 240)
        reply = await page.asks("what", picture=down)
        assert floor is not None
        assert reply["data"]["place"] == pytest.approx(floor, abs=1e-3)
        assert place.pixel_of_floor((*floor, 0.0), 320, 240) == pytest.approx((170.0, 200.0), abs=0.2)


@in_virtual_time
async def test_a_click_on_a_picture_of_long_ago_is_refused(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        reply = await page.asks("what", picture={"stamp_ns": 1, "u": 1.0, "v": 1.0, "width": 320, "height": 240})
        assert not reply["ok"]
        assert "too old" in reply["text"]
