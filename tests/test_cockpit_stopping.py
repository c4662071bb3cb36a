"""STOP and its release over the cockpit: by a page, and by a script over HTTP."""

from __future__ import annotations

from pathlib import Path

from cockpit_rig import cockpit, stoppable

from cocoro.messages import EstopReply, ResetRequest
from cocoro.testing import in_virtual_time
from cocoro.topics import RESET


@in_virtual_time
async def test_every_page_is_told_of_a_stop_and_who_acknowledged_it(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page, rig.page() as other:
        stoppable(rig)
        reply = await page.asks("stop")
        assert reply["ok"]
        for each in (page, other):
            last = each.of("stopped")[-1]
            assert (last["final"], last["acknowledged"], last["missing"]) == (True, ["base", "arm", "hand"], [])
            assert last["by"] == "tester"


@in_virtual_time
async def test_who_lives_and_does_not_acknowledge_a_stop_is_named(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        stoppable(rig, silent=("arm",))
        reply = await page.asks("stop")
        assert not reply["ok"]
        assert page.of("stopped")[-1]["missing"] == ["arm"]
        assert "NOT ACKNOWLEDGED by arm" in reply["text"]


@in_virtual_time
async def test_a_script_stops_the_robot_by_http(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig:
        asked = stoppable(rig)
        answer = await rig.request("POST", "/stop")
        assert (answer.status, answer.json["ok"]) == (200, True)
        assert answer.json["acknowledged"] == ["base", "arm", "hand"]
        assert len(asked) == 3
        assert (await rig.request("GET", "/stop")).status == 405


@in_virtual_time
async def test_a_stop_of_a_robot_of_which_nothing_lives_is_no_success(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig:
        answer = await rig.request("POST", "/stop")
        assert (answer.status, answer.json["ok"]) == (502, False)


@in_virtual_time
async def test_a_reset_asks_the_executive_first_and_gives_its_refusal(tmp_path: Path) -> None:
    async with cockpit(tmp_path) as rig, rig.page() as page:
        stoppable(rig)
        answers = [EstopReply(service="executive", latch="latched", text="a servo is overloaded")]

        async def reset(_: ResetRequest) -> EstopReply:
            return answers[0]

        rig.service.serve(RESET.of("executive"), reset)
        reply = await page.asks("reset")
        assert not reply["ok"]
        assert "a servo is overloaded" in reply["text"]
        answers[0] = EstopReply(service="executive", latch="released")
        assert (await page.asks("reset"))["data"]["released"] == ["arm", "base", "hand"]
