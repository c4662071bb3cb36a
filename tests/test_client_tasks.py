"""A program that runs tasks, against a scripted executive on the local bus in virtual time."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from typing import Any, get_args

import pytest
from follower_rig import ID, Executive, Scene, in_virtual_time

import cocoro
from apps.client.handle import TaskHandle
from apps.client.robot import RobotClient
from cocoro.clock import VirtualClock
from cocoro.errors import ConfigError, MeshError
from cocoro.keys import asker_key
from cocoro.messages import Recording, RefusalCode, TaskReply, TaskState
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.task_errors import REFUSALS
from cocoro.topics import RECORDING


@asynccontextmanager
async def client_of(scene: Scene) -> AsyncIterator[RobotClient]:
    async with cocoro.connect("calliope", bus=scene.mesh.join(), clock=VirtualClock()) as robot:
        yield robot


async def begun(handle: TaskHandle) -> TaskHandle:
    await handle.accepted()
    return handle


def that_cancels(node: Node) -> Executive:
    executive = Executive(node)
    executive.on_cancel = lambda: executive.tell("end", 2.0, outcome="cancelled", reason="by the operator")
    return executive


# --- done -----------------------------------------------------------------------------------------


@in_virtual_time
async def test_an_awaited_task_gives_its_result(scene: Scene) -> None:
    executive = Executive(scene.node)
    recorder = Node("capture", scene.bus, VirtualClock(), Robot.load())
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can"))
        recorder.publish(RECORDING.of("capture"), Recording(file="fetch.mcap", task_id=ID))
        executive.tell("end", 9.5, outcome="done", measures={"near_share": 0.9})
        result = await fetch
    assert (result.task_id, result.task, result.label) == (ID, "fetch", "red_can")
    assert (result.elapsed_s, result.measures, result.recorded_in) == (9.5, {"near_share": 0.9}, "fetch.mcap")
    assert executive.cancelled == []


@in_virtual_time
async def test_who_iterates_gets_each_state_and_the_outcome_last(scene: Scene) -> None:
    executive = Executive(scene.node)
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can"))

        async def tell() -> None:
            executive.tell("search", 0.2)
            executive.tell("approach", 3.0, distance_m=0.9)
            executive.tell("end", 9.5, outcome="done")

        telling = asyncio.create_task(tell())
        seen = [(state.phase, state.distance_m, state.outcome) async for state in fetch]
        await telling
    assert seen == [("search", None, None), ("approach", 0.9, None), ("end", None, "done")]


@in_virtual_time
async def test_who_iterates_over_a_task_that_is_over_gets_its_last_state(scene: Scene) -> None:
    executive = Executive(scene.node)
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can"))
        executive.tell("end", 9.5, outcome="done")
        await fetch
        assert fetch.done
        assert [state.outcome async for state in fetch] == ["done"]


ASKED: list[tuple[Callable[[RobotClient], TaskHandle], dict[str, Any]]] = [
    (lambda robot: robot.fetch("red_can"), {"task": "fetch", "label": "red_can", "bring": False}),
    (lambda robot: robot.fetch("red_can", bring=True), {"task": "fetch", "label": "red_can", "bring": True}),
    (lambda robot: robot.follow("blue_ball", for_s=10.0), {"task": "follow", "label": "blue_ball", "for_s": 10.0}),
    (lambda robot: robot.touch("red_can"), {"task": "touch", "label": "red_can"}),
    (lambda robot: robot.go_to("mug", distance_m=0.3), {"task": "go-to", "label": "mug", "distance_m": 0.3}),
    (lambda robot: robot.go_there(1.0, -0.5), {"task": "go-there", "x_m": 1.0, "y_m": -0.5}),
    (lambda robot: robot.policy("reach", for_s=5.0), {"task": "policy", "label": "reach", "for_s": 5.0}),
    (lambda robot: robot.put_down(), {"task": "put-down", "x_m": None, "y_m": None}),
    (lambda robot: robot.put_down(x_m=1.0, y_m=0.5), {"task": "put-down", "x_m": 1.0, "y_m": 0.5}),
    (lambda robot: robot.park(), {"task": "park"}),
    (lambda robot: robot.run({"task": "nod", "times": 3}), {"task": "nod", "times": 3}),
]


@pytest.mark.parametrize(("ask", "wire"), ASKED, ids=[wire["task"] for _, wire in ASKED])
def test_each_method_asks_for_its_task(ask: Callable[[RobotClient], TaskHandle], wire: dict[str, Any]) -> None:
    @in_virtual_time
    async def scenario(scene: Scene) -> None:
        executive = that_cancels(scene.node)
        async with client_of(scene) as robot:
            await begun(ask(robot))
        assert [request.task for request in executive.asked] == [wire]

    scenario()


@in_virtual_time
async def test_a_time_limit_and_the_wish_to_replace_a_task_travel_with_the_request(scene: Scene) -> None:
    executive = that_cancels(scene.node)
    async with client_of(scene) as robot:
        await begun(robot.park(timeout_s=30.0, instead=True))
    assert (executive.asked[0].timeout_s, executive.asked[0].instead) == (30.0, True)


# --- refused --------------------------------------------------------------------------------------


def test_every_refusal_of_a_robot_has_an_error_of_its_own_which_is_public() -> None:
    assert set(REFUSALS) == set(get_args(RefusalCode))
    assert len(set(REFUSALS.values())) == len(REFUSALS)
    assert {kind.__name__ for kind in REFUSALS.values()} <= set(cocoro.__all__)


@pytest.mark.parametrize("code", get_args(RefusalCode))
def test_a_refused_task_raises_the_error_of_its_code_with_the_robots_words(code: RefusalCode) -> None:
    @in_virtual_time
    async def scenario(scene: Scene) -> None:
        Executive(scene.node, replies=[TaskReply(accepted=False, refusal=code, text="what it says")])
        async with client_of(scene) as robot:
            for waiting in (
                robot.fetch("red_can"),
                robot.fetch("red_can").accepted(),
                iterated(robot.fetch("red_can")),
            ):
                with pytest.raises(REFUSALS[code], match="what it says") as caught:
                    await waiting
                assert caught.value.code == code
                assert isinstance(caught.value, cocoro.RefusedError)

    scenario()


async def iterated(handle: TaskHandle) -> list[TaskState]:
    return [state async for state in handle]


@in_virtual_time
async def test_a_refusal_without_a_code_is_a_plain_one(scene: Scene) -> None:
    Executive(scene.node, replies=[TaskReply(accepted=False, text="because")])
    async with client_of(scene) as robot:
        with pytest.raises(cocoro.TaskRefusedError, match="because"):
            await robot.park()


@in_virtual_time
async def test_without_an_executive_there_is_no_mesh_to_ask(scene: Scene) -> None:
    async with client_of(scene) as robot:
        with pytest.raises(MeshError, match="executive"):
            await robot.park()


@in_virtual_time
async def test_a_bus_needs_its_clock_and_the_robots_name(scene: Scene) -> None:
    for given in ({"bus": scene.bus}, {"clock": VirtualClock()}, {"bus": scene.bus, "clock": VirtualClock()}):
        with pytest.raises(ConfigError, match="together"):
            await cocoro.connect(None, **given).__aenter__()


# --- not done -------------------------------------------------------------------------------------


@in_virtual_time
async def test_a_task_that_fails_raises_its_reason_as_a_word_and_a_sentence(scene: Scene) -> None:
    executive = Executive(scene.node)
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can"))
        executive.tell("end", 30.0, outcome="failed", reason="not_found: looked everywhere")
        with pytest.raises(cocoro.TaskEndedError, match="fetch red_can: not_found: looked everywhere") as caught:
            await fetch
        assert (caught.value.reason, caught.value.text) == ("not_found", "looked everywhere")
        assert caught.value.state.elapsed_s == 30.0
        assert isinstance(caught.value, cocoro.TaskFailedError)
        assert isinstance(caught.value, cocoro.CocoroError)
        with pytest.raises(cocoro.TaskEndedError):
            await iterated(fetch)


@in_virtual_time
async def test_a_task_that_another_cancels_raises_that(scene: Scene) -> None:
    executive = Executive(scene.node)
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can"))
        executive.tell("end", 3.0, outcome="cancelled", reason="by the operator")
        with pytest.raises(cocoro.TaskCancelledError, match="by the operator"):
            await fetch


@in_virtual_time
async def test_a_task_whose_executive_is_not_heard_any_more_is_lost(scene: Scene) -> None:
    Executive(scene.node)
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can"))
        scene.bus.kill()
        with pytest.raises(cocoro.TaskLostError, match="lost contact with executive") as caught:
            await fetch
        assert caught.value.reason == "lost_contact"


def test_a_failure_that_nobody_waited_for_is_told_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    @in_virtual_time
    async def scenario(scene: Scene) -> None:
        executive = Executive(scene.node)
        async with client_of(scene) as robot:
            robot.fetch("red_can")
            await asyncio.sleep(0.1)
            executive.tell("end", 30.0, outcome="failed", reason="not_found: looked everywhere")
            await asyncio.sleep(0.1)

    scenario()
    assert "nobody waited for fetch red_can" in caplog.text


# --- ended from here ------------------------------------------------------------------------------


@in_virtual_time
async def test_leaving_the_client_cancels_its_task_and_waits_until_the_robot_stands(scene: Scene) -> None:
    executive = that_cancels(scene.node)
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can"))
    assert executive.cancelled == [ID]
    assert fetch.state is not None
    assert fetch.state.outcome == "cancelled"


@in_virtual_time
async def test_an_error_in_the_program_cancels_its_task(scene: Scene) -> None:
    executive = that_cancels(scene.node)

    async def faulty() -> None:
        async with client_of(scene) as robot:
            await begun(robot.fetch("red_can"))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await faulty()
    assert executive.cancelled == [ID]


@in_virtual_time
async def test_who_stops_waiting_cancels_the_task_on_the_robot(scene: Scene) -> None:
    executive = that_cancels(scene.node)
    async with client_of(scene) as robot:
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(robot.fetch("red_can"), 5.0)
        await asyncio.sleep(0.1)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(iterated(robot.fetch("red_can")), 5.0)
        await asyncio.sleep(0.1)
    assert executive.cancelled == [ID, ID]


@in_virtual_time
async def test_the_end_of_its_block_cancels_a_task(scene: Scene) -> None:
    executive = that_cancels(scene.node)
    async with client_of(scene) as robot:
        async with robot.fetch("red_can") as fetch:
            await fetch.accepted()
        assert (executive.cancelled, fetch.done) == ([ID], True)


@in_virtual_time
async def test_a_cancelled_task_tells_its_last_state(scene: Scene) -> None:
    executive = that_cancels(scene.node)
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can"))
        state = await fetch.cancel()
        assert state is not None
        assert (state.outcome, executive.cancelled) == ("cancelled", [ID])


@in_virtual_time
async def test_of_a_task_that_is_cancelled_at_once_the_robot_hears_nothing(scene: Scene) -> None:
    executive = Executive(scene.node)
    async with client_of(scene) as robot:
        fetch = robot.fetch("red_can")
        assert await fetch.cancel() is None
        with pytest.raises(cocoro.TaskCancelledError, match="before it began"):
            await fetch
    assert executive.asked == []


@in_virtual_time
async def test_a_task_that_does_not_end_when_cancelled_points_to_the_emergency_stop(scene: Scene) -> None:
    Executive(scene.node)
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can"))
        with pytest.raises(cocoro.TaskLostError, match="cocoro stop"):
            await fetch.cancel()


@in_virtual_time
async def test_the_robot_watches_the_program_for_as_long_as_its_task_runs(scene: Scene) -> None:
    executive = Executive(scene.node)
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can"))
        key = asker_key("calliope", executive.asked[0].asker)
        assert scene.mesh.tokens[key] == 1
        executive.tell("end", 9.5, outcome="done")
        await fetch
        assert scene.mesh.tokens[key] == 0


@in_virtual_time
async def test_a_detached_task_goes_on_without_its_program(scene: Scene) -> None:
    executive = Executive(scene.node)
    async with client_of(scene) as robot:
        await robot.fetch("red_can", detach=True).accepted()
    assert (executive.asked[0].asker, executive.cancelled) == ("", [])


@in_virtual_time
async def test_a_detached_task_is_not_cancelled_by_who_stops_waiting_but_by_who_cancels_it(scene: Scene) -> None:
    executive = that_cancels(scene.node)
    async with client_of(scene) as robot:
        fetch = robot.fetch("red_can", detach=True)
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(fetch, 5.0)
        await asyncio.sleep(1.0)
        assert executive.cancelled == []
        await fetch.cancel()
    assert executive.cancelled == [ID]


@in_virtual_time
async def test_who_waits_for_a_task_of_a_client_that_closes_is_told(scene: Scene) -> None:
    Executive(scene.node)
    async with client_of(scene) as robot:
        fetch = await begun(robot.fetch("red_can", detach=True))
        waiting = asyncio.ensure_future(iterated(fetch))
        await asyncio.sleep(1.0)
    with pytest.raises(cocoro.TaskLostError, match="the client was closed"):
        await waiting


# --- tasks of others ------------------------------------------------------------------------------


@in_virtual_time
async def test_a_task_of_another_is_attended_and_not_cancelled(scene: Scene) -> None:
    executive = Executive(scene.node)
    executive.knows("approach", 3.0)
    async with client_of(scene) as robot:
        task = await robot.attend(ID)
        assert (task.task_id, task.name) == (ID, "fetch red_can")
        executive.tell("end", 9.5, outcome="done")
        assert (await task).elapsed_s == 9.5
        over = await robot.attend(ID)
        assert (await over).elapsed_s == 9.5
        await robot.attend(ID)
    assert executive.cancelled == []


@in_virtual_time
async def test_a_task_that_the_robot_does_not_know_cannot_be_attended(scene: Scene) -> None:
    Executive(scene.node)
    async with client_of(scene) as robot:
        with pytest.raises(cocoro.NoTaskError, match="knows no task fetch-7"):
            await robot.attend("fetch-7")
        with pytest.raises(cocoro.NoTaskError, match="no task has run"):
            await robot.attend()


@in_virtual_time
async def test_whoever_asked_for_it_a_task_can_be_cancelled(scene: Scene) -> None:
    executive = Executive(scene.node)
    async with client_of(scene) as robot:
        assert await robot.cancel(ID) == ID
    assert executive.cancelled == [ID]
