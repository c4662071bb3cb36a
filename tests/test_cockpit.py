"""The cockpit's pages: what they are told, what they may ask for, and what it costs while nobody looks."""

from __future__ import annotations

import asyncio
import base64
import zlib
from pathlib import Path

import pytest
from cockpit_rig import cockpit, stoppable

from cocoro.errors import CocoroError
from cocoro.messages import (
    BaseState,
    FloorPlan,
    Latch,
    PlannerStatus,
    TargetEstimate,
    TaskReply,
    TaskRequest,
    TaskState,
)
from cocoro.testing import in_virtual_time, misdeclared
from cocoro.topics import (
    BASE_STATE,
    FLOOR_PLAN,
    LATCH,
    PLAN,
    RUN,
    TASK,
    TOPICS,
)
from services.cockpit.component import COCKPIT

BASE = BaseState(odometry_m=(0.0, 0.0), odometry_yaw_rad=0.0, speed_mps=0.2, turn_rate_radps=0.0, bump_left=True)


# --- looking --------------------------------------------------------------------------------------


@in_virtual_time
async def test_a_page_is_greeted_with_the_tasks_and_objects_of_the_robot(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        (hello,) = page.of("hello")
        assert [task["name"] for task in hello["tasks"]] == ["fetch", "park"]
        assert hello["tasks"][0]["options"][0]["name"] == "bring"
        assert [one["label"] for one in hello["objects"]] == ["red_can"]
        assert (hello["live"], hello["role"], hello["robot"]) == (True, "operator", "calliope")
        assert hello["limits"]["speed_mps"] == pytest.approx(0.5)


@in_virtual_time
async def test_pages_are_greeted_again_when_the_executive_comes_back(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        rig.service.other_dies("executive")
        await rig.service.advance(0.1)
        rig.service.others_live("executive")
        await rig.service.advance(0.1)
        assert len(page.of("hello")) == 2


@in_virtual_time
async def test_a_page_sees_the_newest_of_everything_ten_times_a_second(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        rig.service.feed(BASE_STATE, BASE)
        rig.service.feed(TASK, TaskState(task_id="fetch-1", task="fetch", label="red_can", phase="approach"))
        rig.service.feed(PLAN, PlannerStatus(behaviour="approach", why="drives there", body_m=(1.0, 2.0)))
        rig.service.feed(LATCH, Latch(state="released"))
        await rig.service.advance(0.2)
        assert page.state["base"]["speed_mps"] == 0.2
        assert page.state["base"]["bumped"] == ["left"]
        assert (page.state["task"]["label"], page.state["task"]["phase"]) == ("red_can", "approach")
        assert (page.state["plan"]["why"], page.state["plan"]["body"]) == ("drives there", [1.0, 2.0, 0.0])
        assert page.state["latch"] == "released"
        before = len(page.of("state"))
        await rig.service.advance(1.0)
        assert len(page.of("state")) - before == pytest.approx(10, abs=1)


@in_virtual_time
async def test_what_was_published_before_somebody_looked_is_asked_for(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig:
        rig.service.feed(LATCH, Latch(state="latched", by="operator"))
        await rig.service.advance(0.1)
        async with rig.page() as page:
            await rig.service.advance(0.2)
            assert page.state["latch"] == "latched"


@in_virtual_time
async def test_a_state_that_is_not_told_any_more_does_not_look_fresh(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        rig.service.feed(LATCH, Latch(state="released"))
        rig.service.feed(BASE_STATE, BASE)
        await rig.service.advance(5.0)
        assert page.state["latch"] == "unknown"
        assert page.state["base"]["age_s"] == pytest.approx(5.0, abs=0.2)


@in_virtual_time
async def test_a_service_that_died_is_shown_as_not_alive(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.2)
        assert {one["service"]: one["alive"] for one in page.state["services"]}["executive"]
        rig.service.other_dies("executive")
        await rig.service.advance(0.2)
        assert not any(one["alive"] for one in page.state["services"] if one["service"] == "executive")


@in_virtual_time
async def test_nothing_is_subscribed_to_while_nobody_looks(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig:
        assert not [name for name in rig.service.bus.reads if "clock" not in name]
        async with rig.page() as page:
            await rig.service.advance(0.1)
            assert "kinect/frame" in rig.service.bus.reads
            assert page.accepted
        await rig.service.advance(5.0)
        before = rig.service.received(BASE_STATE).count  # subscribes anew, in place of the cockpit
        assert before == 0


@in_virtual_time
async def test_the_map_is_told_when_it_changes_and_to_who_comes_later(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        await rig.service.advance(0.1)
        floor = FloorPlan(cell_m=0.05, width=2, height=1, cells=b"\1\2", way_m=((0.0, 0.0), (1.0, 0.0)))
        for _ in range(3):
            rig.service.feed(FLOOR_PLAN, floor)
            await rig.service.advance(0.5)
        (told,) = page.of("map")
        assert zlib.decompress(base64.b64decode(told["cells"])) == b"\1\2"
        assert (told["width"], told["height"], told["way"]) == (2, 1, [[0.0, 0.0], [1.0, 0.0]])
        async with rig.page() as later:
            await rig.service.advance(0.1)
            assert later.of("map")


# --- asking ---------------------------------------------------------------------------------------


@in_virtual_time
async def test_a_page_runs_a_task_and_gets_the_executives_answer(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        asked: list[TaskRequest] = []

        async def run(request: TaskRequest) -> TaskReply:
            asked.append(request)
            if len(asked) > 1:
                return TaskReply(accepted=False, refusal="busy", text="fetch red_can is running")
            return TaskReply(accepted=True, task_id="fetch-1")

        rig.service.serve(RUN, run)
        reply = await page.asks("run", task={"task": "fetch", "label": "red_can", "bring": True})
        assert (reply["ok"], reply["data"]["task_id"]) == (True, "fetch-1")
        assert asked[0].task == {"task": "fetch", "label": "red_can", "bring": True}
        reply = await page.asks("run", task={"task": "park"}, instead=True)
        assert (reply["ok"], reply["text"], reply["data"]["refusal"]) == (False, "fetch red_can is running", "busy")
        assert asked[1].instead


@in_virtual_time
async def test_a_page_is_told_that_nobody_answers(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        reply = await page.asks("cancel")
        assert not reply["ok"]
        assert "executive" in reply["text"]


@in_virtual_time
async def test_a_viewer_may_look_and_stop_but_not_operate(tmp_path: Path) -> None:
    async with cockpit(tmp_path, "viewer") as rig, rig.page() as page:
        asked = stoppable(rig)
        for do in ("run", "cancel", "reset", "begin-drive", "end-drive"):
            reply = await page.asks(do, **({"task": {"task": "park"}} if do == "run" else {}))
            assert not reply["ok"]
            assert "operator" in reply["text"]
        assert (await page.asks("stop"))["ok"]
        assert asked == ["cockpit: tester"] * 3


@in_virtual_time
async def test_who_is_not_let_in_sees_nothing(tmp_path: Path) -> None:
    async with cockpit(tmp_path, None) as rig, rig.page() as page:
        assert not page.accepted
        assert page.closed is not None
        assert page.closed[0] == 1008
        assert (await rig.request("POST", "/stop")).status == 403
        assert (await rig.request("GET", "/captures")).status == 403


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "[]",
        '{"do":"fly"}',
        '{"do":"run"}',
        '{"do":"stop","x":1}',
        '{"do":"seek","at_s":1}',
        '"\ud800"',
        "1" * 9,
    ],
)
def test_what_is_no_message_ends_the_connection_and_says_why(text: str, tmp_path: Path) -> None:
    @in_virtual_time
    async def tried() -> None:
        async with cockpit(tmp_path) as rig, rig.page() as page:
            page.say_raw(text)
            await rig.service.advance(0.1)
            assert page.closed is not None
            assert page.closed[0] == 1008
            assert "protocol" in page.closed[1]
            assert len(page.closed[1].encode()) < 124

    tried()


@in_virtual_time
async def test_a_page_that_asks_too_much_at_once_is_refused_and_still_stops(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        stoppable(rig)
        never = asyncio.Event()

        async def run(_: TaskRequest) -> TaskReply:
            await never.wait()
            raise CocoroError("not reached")

        rig.service.serve(RUN, run)
        for number in range(12):
            page.say("run", id=number, task={"task": "park"})
        assert (await page.asks("stop"))["ok"]
        assert [reply["id"] for reply in page.of("reply") if "under way" in reply["text"]] == [8, 9, 10, 11]


# --- pointing -------------------------------------------------------------------------------------


@in_virtual_time
async def test_a_click_on_the_map_names_the_object_there_or_the_place(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        can = TargetEstimate(label="red_can", position_m=(1.0, 0.0, 0.06), odometry_position_m=(1.5, 0.5, 0.06))
        await rig.service.advance(0.1)
        rig.service.feed(PLAN, PlannerStatus(known=(can,)))
        await rig.service.advance(0.1)
        assert (await page.asks("what", map=[1.45, 0.55]))["data"]["label"] == "red_can"
        reply = await page.asks("what", map=[0.2, -0.4])
        assert (reply["data"]["label"], reply["data"]["place"]) == (None, [0.2, -0.4])
        assert not (await page.asks("what"))["ok"]


# --- what it declares -----------------------------------------------------------------------------


@in_virtual_time
async def test_it_speaks_as_it_declares(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        stoppable(rig)
        await rig.service.advance(0.5)
        rig.service.feed(TASK, TaskState(task_id="drive-1", task="drive", phase="drive"))
        await rig.service.advance(0.1)
        await page.asks("run", task={"task": "park"})
        await page.asks("cancel")
        await page.asks("reset")
        await page.asks("stop")
        page.say("drive", tick=0)
        await rig.request("GET", "/captures")
        await rig.service.advance(1.0)
        rig.service.bus.calls -= {topic.of("*").name if topic.per_service else topic.name for topic in TOPICS}  # newest
        assert misdeclared(COCKPIT, rig.service.bus) == []
