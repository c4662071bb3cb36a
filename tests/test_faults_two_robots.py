"""Two robots on one mesh: whatever happens to the one, the other does as if it were alone."""

from __future__ import annotations

import asyncio
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest
from faults_live import LiveRobot, live
from robot_rig import HALTED_MPS, RobotRig
from spelled import asked

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.messages import TaskState
from cocoro.testing import in_virtual_time
from cocoro.topics import Topic
from cocoro.vloop import run_virtual

pytestmark = pytest.mark.sim

ONE, OTHER = "calliope", "calliope2"
"""The one's name begins the other's, which must not matter."""


async def fetched_alone() -> TaskState:
    async with RobotRig(name=ONE) as rig:
        return await rig.run("fetch", "red_can")


async def fetched_beside_another() -> TaskState:
    mesh = LocalMesh()
    async with RobotRig(name=ONE, mesh=mesh) as rig, RobotRig(name=OTHER, mesh=mesh) as idle:
        began_s = rig.now_s
        state = await rig.run("fetch", "red_can")
        assert rig.held("red_can")
        assert not idle.held("red_can")
        assert max(idle.speeds_since(began_s)) < HALTED_MPS
        assert not any(map(any, idle.commanded_since(began_s)))
        assert {state.task_id for state in idle.tap.messages(topics.TASK)} == {""}
        return state


def test_a_robot_does_the_same_beside_another_as_alone() -> None:
    alone, beside = run_virtual(fetched_alone()), run_virtual(fetched_beside_another())
    assert alone.outcome == "done"
    assert (alone.outcome, alone.elapsed_s) == (beside.outcome, beside.elapsed_s)


@in_virtual_time
async def test_whatever_happens_to_the_one_the_other_goes_on() -> None:
    mesh = LocalMesh()
    async with RobotRig(name=ONE, mesh=mesh) as rig, RobotRig(name=OTHER, mesh=mesh) as other:
        task_id = await rig.begin("fetch", "red_can")
        other_id = await other.begin("fetch", "green_can")
        await other.until(lambda: other.speed_mps > 0.1)
        assert await other.estop(latched=True) == {"base", "arm", "hand", "executive"}
        assert (await other.outcome(other_id)).reason == "estop: emergency stop by test"
        for service in ("executive", "planning", "perception", "sim"):
            await other.kill(service)
        state = await rig.outcome(task_id)
        assert (state.outcome, state.reason) == ("done", "")
        assert rig.held("red_can")


@in_virtual_time
async def test_an_emergency_stop_of_one_robot_is_acknowledged_by_its_own_services_alone() -> None:
    mesh = LocalMesh()
    async with RobotRig(name=ONE, mesh=mesh) as rig, RobotRig(name=OTHER, mesh=mesh) as other:
        await rig.advance(1.5)
        await rig.estop(latched=True)
        await rig.advance(1.0)
        assert rig.tap.messages(topics.BASE_STATE)[-1].latch == "latched"
        reporting: tuple[Topic[Any], ...] = (topics.BASE_STATE, topics.ARM_STATE, topics.HAND_STATE)
        for topic in reporting:
            assert other.tap.messages(topic)[-1].latch == "released"
        assert (await other.ask("park")).accepted


@pytest.mark.process
@pytest.mark.zenoh
def test_two_robots_on_one_machine_each_do_their_own(tmp_path: Path) -> None:
    async def scenario() -> None:
        small: dict[str, Any] = {"width": 160, "height": 120, "frame_rate_hz": 15.0}
        async with AsyncExitStack() as stack:
            robots: list[LiveRobot] = [
                await stack.enter_async_context(live(tmp_path, name=name, **small)) for name in (ONE, OTHER)
            ]
            one, other = robots
            began_s = other.now_s
            task_id = await one.driving()
            await other.passes(0.5)
            assert other.stood_since(began_s)
            assert not other.obeyed_since(began_s)
            code, told = await other.command("estop")
            assert code == 0, told
            await one.passes(0.3)
            state = one.state(task_id)
            assert state is not None
            assert state.outcome is None, state.reason
            assert one.heard(topics.BASE_STATE)[-1].latch == "released"
            assert other.heard(topics.BASE_STATE)[-1].latch == "latched"
            assert (await other.ask(asked("park"))).refusal == "estop"
            code, told = await other.command("reset")
            assert code == 0, told
            code, told = await one.command("cancel")
            assert code == 0, told
            assert (await one.outcome(task_id)).outcome == "cancelled"

    asyncio.run(scenario())
