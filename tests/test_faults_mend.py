"""Services that die in the middle of a task and are restarted, links that are cut and come back: the task goes on.

Policies: docs/faults.md. In virtual time, with the whole robot, judged by the simulator's truth.
"""

from __future__ import annotations

import asyncio
from collections.abc import Sequence

import pytest
from link_rig import Link
from robot_rig import HALTED_MPS, RobotRig
from spelled import asked

from cocoro import topics
from cocoro.keys import asker_key
from cocoro.messages import TaskState
from cocoro.testing import in_virtual_time

pytestmark = pytest.mark.sim

STAND_S = 0.3
"""Bound from the fault until the body stands, by the true state."""
RESTART_S = 3.0
"""Time from a death until the service is back."""
CUT_S = 5.0
PHASES = (("search", "approach", "reach"), ("grasp", "lift", "hold"))
INTO_S = {"search": 0.1, "approach": 1.5, "reach": 0.3, "grasp": 0.1, "lift": 0.5, "hold": 1.0}
"""Time from the begin of a phase to the fault."""


async def into(rig: RobotRig, task_id: str, phase: str) -> None:
    """Wait until a moment in a phase."""
    await rig.phase(task_id, phase)
    await rig.advance(INTO_S[phase])
    assert rig.state(task_id).phase == phase, rig.state(task_id)


def stood_since(rig: RobotRig, fault_s: float) -> None:
    assert max(rig.speeds_since(fault_s + STAND_S)) < HALTED_MPS
    assert rig.turned_since(fault_s + STAND_S) < 0.01


async def ends_well(rig: RobotRig, task_id: str) -> TaskState:
    state = await rig.outcome(task_id)
    assert (state.outcome, state.reason) == ("done", ""), state
    assert rig.held("red_can")
    return state


@pytest.mark.parametrize("service", ["perception", "planning"])
@pytest.mark.parametrize("phases", PHASES, ids="-".join)
def test_a_fetch_stands_while_a_service_is_restarted_and_goes_on_to_its_end(
    service: str, phases: Sequence[str]
) -> None:
    """Three times in one fetch, which is as often as a task goes on."""

    @in_virtual_time
    async def scenario() -> None:
        async with RobotRig() as rig:
            task_id = await rig.begin("fetch", "red_can")
            for phase in phases:
                await into(rig, task_id, phase)
                held, died_s = rig.held("red_can"), rig.now_s
                await rig.kill(service)
                await rig.advance(RESTART_S)
                stood_since(rig, died_s)
                assert rig.state(task_id).text == f"lost contact with {service}"
                assert rig.held("red_can") or not held
                await rig.start(service)
            await ends_well(rig, task_id)

    scenario()


@pytest.mark.parametrize("phases", PHASES, ids="-".join)
def test_a_fetch_stands_while_a_link_is_cut_and_goes_on_to_its_end(phases: Sequence[str]) -> None:
    """The operator is beyond the link, too."""

    @in_virtual_time
    async def scenario() -> None:
        link = Link()
        async with RobotRig(bus_of=link.bus) as rig:
            await rig.advance(1.5)
            rig.operator.bus.declare_alive(asker_key(rig.operator.robot_name, "ann"))
            reply = await rig.operator.call(topics.RUN, asked("fetch", "red_can", asker="ann"))
            assert reply.accepted, reply.text
            for phase in phases:
                await into(rig, reply.task_id, phase)
                held, cut_s = rig.held("red_can"), rig.now_s
                await link.cut(CUT_S)
                stood_since(rig, cut_s)
                assert rig.held("red_can") or not held
            await ends_well(rig, reply.task_id)

    scenario()


@in_virtual_time
async def test_what_was_carried_is_still_brought_when_the_planner_was_restarted_on_the_way() -> None:
    async with RobotRig() as rig:
        await rig.advance(1.5)
        reply = await rig.operator.call(topics.RUN, asked("fetch", "red_can", bring=True))
        assert reply.accepted, reply.text
        for phase, into_s in (("carry", 1.0), ("place", 1.0)):
            await rig.phase(reply.task_id, phase)
            await rig.advance(into_s)
            died_s = rig.now_s
            await rig.kill("planning")
            await rig.advance(RESTART_S)
            stood_since(rig, died_s)
            assert rig.held("red_can")
            await rig.start("planning")
        state = await rig.outcome(reply.task_id)
        assert (state.outcome, state.reason) == ("done", "")
        await rig.advance(0.5)
        can = rig.thing("red_can")
        assert can.touching == ("floor",)
        assert can.position_m[2] == pytest.approx(0.06, abs=0.003), "it stands"


@in_virtual_time
async def test_with_an_empty_hand_nothing_is_put_down_again() -> None:
    async with RobotRig() as rig:
        await rig.holding()
        task_id = await rig.begin("put-down")
        await rig.until(lambda: "backing out" in rig.state(task_id).text if task_id in rig._tasks else False)
        await rig.kill("planning")
        await rig.advance(RESTART_S)
        await rig.start("planning")
        state = await rig.outcome(task_id)
        assert (state.outcome, state.reason) == ("failed", "not_alive: lost contact with planning")
        assert rig.thing("red_can").touching == ("floor",)


@in_virtual_time
async def test_perception_is_not_needed_to_put_something_down() -> None:
    async with RobotRig() as rig:
        await rig.holding()
        task_id = await rig.begin("put-down")
        await rig.phase(task_id, "place")
        await rig.kill("perception")
        state = await rig.outcome(task_id)
        assert (state.outcome, state.reason) == ("done", "")


@in_virtual_time
async def test_a_drive_to_an_object_goes_on_when_the_planner_was_restarted() -> None:
    async with RobotRig() as rig:
        task_id = await rig.driving(task="go-to")
        await rig.kill("planning")
        await asyncio.sleep(RESTART_S)
        await rig.start("planning")
        state = await rig.outcome(task_id)
        assert (state.outcome, state.reason) == ("done", "")
