"""Driving by hand over the cockpit: what it passes on for a page, and what ends with the page."""

from __future__ import annotations

import asyncio
from pathlib import Path

from cockpit_rig import cockpit

from cocoro.keys import asker_key
from cocoro.messages import CancelRequest, DriveReply, DriveRequest, Motion, TaskReply, TaskRequest, TaskState
from cocoro.testing import in_virtual_time
from cocoro.topics import CANCEL, DRIVE, RUN, TASK


@in_virtual_time
async def test_a_page_that_drives_quotes_the_ticks_itself(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        asked: list[DriveRequest] = []

        async def run(_: TaskRequest) -> TaskReply:
            return TaskReply(accepted=True, task_id="drive-1")

        async def drive(request: DriveRequest) -> DriveReply:
            asked.append(request)
            return DriveReply(accepted=request.tick > 0, tick=len(asked), refusal=None if request.tick else "no_tick")

        async def cancel(request: CancelRequest) -> TaskReply:
            return TaskReply(accepted=True, task_id=request.task_id)

        rig.service.serve(RUN, run)
        rig.service.serve(DRIVE, drive)
        rig.service.serve(CANCEL, cancel)
        assert (await page.asks("begin-drive", instead=True))["ok"]
        await rig.service.advance(0.05)
        assert page.of("tick")[-1]["tick"] == 1
        page.say("drive", tick=1, motion={"speed_mps": 0.3})
        await rig.service.advance(0.05)
        assert (asked[1].task_id, asked[1].tick, asked[1].motion) == ("drive-1", 1, Motion(speed_mps=0.3))
        assert (page.of("tick")[-1]["tick"], page.of("tick")[-1]["accepted"]) == (2, True)
        await rig.service.advance(5.0)
        assert len(asked) == 2  # nothing is repeated for the page
        assert (await page.asks("end-drive"))["data"]["task_id"] == "drive-1"


@in_virtual_time
async def test_the_drive_ends_with_the_cockpit_however_that_ends_and_other_tasks_do_not(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig:
        asked: list[TaskRequest] = []
        alive: dict[str, bool] = {}

        async def run(request: TaskRequest) -> TaskReply:
            asked.append(request)
            return TaskReply(accepted=True, task_id="t1")

        rig.service.serve(RUN, run)
        rig.service.tester.bus.watch_alive(asker_key("calliope"), alive.__setitem__)
        async with rig.page() as page:
            assert (await page.asks("begin-drive"))["ok"]
            assert (await page.asks("run", task={"task": "park"}))["ok"]
        assert [request.asker for request in asked] == ["cockpit", ""]
        assert alive == {asker_key("calliope", "cockpit"): True}
    assert alive == {asker_key("calliope", "cockpit"): False}


@in_virtual_time
async def test_a_page_that_goes_ends_the_drive_that_it_began(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig:
        ended: list[str] = []

        async def run(_: TaskRequest) -> TaskReply:
            return TaskReply(accepted=True, task_id="drive-1")

        async def cancel(request: CancelRequest) -> TaskReply:
            ended.append(request.task_id)
            return TaskReply(accepted=True, task_id=request.task_id)

        rig.service.serve(RUN, run)
        rig.service.serve(CANCEL, cancel)
        async with rig.page() as page, rig.page():
            assert (await page.asks("begin-drive"))["ok"]
            assert ended == []
        await rig.service.advance(0.1)
        assert ended == ["drive-1"]


@in_virtual_time
async def test_motions_that_wait_are_replaced_by_the_newest(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        asked: list[float] = []

        async def drive(request: DriveRequest) -> DriveReply:
            asked.append(request.motion.speed_mps)
            await asyncio.sleep(0.3)
            return DriveReply(accepted=True, tick=5)

        rig.service.serve(DRIVE, drive)
        rig.service.feed(TASK, TaskState(task_id="drive-1", task="drive", phase="drive"))
        await rig.service.advance(0.2)
        for number in range(1, 7):
            page.say("drive", tick=1, motion={"speed_mps": number / 10})
            await rig.service.advance(0.01)
        await rig.service.advance(1.0)
        assert asked == [0.1, 0.6]


@in_virtual_time
async def test_a_motion_without_a_drive_is_refused(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        page.say("drive", tick=1, motion={"speed_mps": 0.3})
        await rig.service.advance(0.1)
        assert page.of("tick")[-1]["refusal"] == "no_task"
