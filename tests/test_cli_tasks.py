"""Commands that ask for a task and follow it, against a scripted executive on the local bus in virtual time."""

from __future__ import annotations

import asyncio

import pytest
from follower_rig import ID, REQUEST, Executive, Scene, following, in_virtual_time
from msgspec import to_builtins

from apps.cli import exits
from apps.cli.output import recent_complaints
from apps.cli.progress import LineDisplay
from apps.cli.tasks import Follower
from cocoro.clock import VirtualClock
from cocoro.errors import MeshError
from cocoro.messages import (
    Latch,
    LatchState,
    Recording,
    TaskReply,
    TaskState,
)
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import LATCH, RECORDING


@in_virtual_time
async def test_a_task_that_is_done_is_followed_phase_by_phase_and_exits_with_0(scene: Scene) -> None:
    executive = Executive(scene.node)
    running = await following(scene.follower())
    states = ((0.2, "search", None), (0.4, "search", None), (3.0, "approach", 0.9), (3.2, "approach", 0.8))
    for elapsed_s, phase, distance_m in states:
        executive.tell(phase, elapsed_s, distance_m=distance_m, text="because")
    executive.tell("end", 9.5, outcome="done")
    code, result = await running
    assert code == exits.DONE
    assert [request.task for request in executive.asked] == [to_builtins(REQUEST.task)]
    assert scene.out.getvalue().splitlines() == [
        "   0.4 s  search               because",
        "   3.2 s  approach     0.80 m  because",
        "done: fetch red_can in 9.5 s",
    ]
    assert (result["outcome"], result["elapsed_s"]) == ("done", 9.5)


@in_virtual_time
async def test_where_the_task_is_recorded_is_told_with_its_outcome(scene: Scene) -> None:
    executive = Executive(scene.node)
    recorder = Node("capture", scene.bus, VirtualClock(), Robot.load())
    running = await following(scene.follower())
    for task_id, file in (("", "idle.mcap"), (ID, "fetch.mcap"), ("another", "other.mcap")):
        recorder.publish(RECORDING.of("capture"), Recording(file=file, task_id=task_id))
    executive.tell("end", 9.5, outcome="done")
    code, result = await running
    assert code == exits.DONE
    assert scene.out.getvalue().splitlines() == ["done: fetch red_can in 9.5 s", "recorded in fetch.mcap"]
    assert result["recorded_in"] == "fetch.mcap"


@in_virtual_time
async def test_a_long_phase_is_told_of_again_every_two_seconds(scene: Scene) -> None:
    executive = Executive(scene.node)
    running = await following(scene.follower())
    for tenths in range(1, 60):
        executive.tell("approach", tenths / 10)
    executive.tell("end", 6.0, outcome="done")
    await running
    assert [line.split(" s ")[0].strip() for line in scene.out.getvalue().splitlines()[:-1]] == ["0.2", "2.2", "4.2"]


@in_virtual_time
async def test_a_task_that_fails_says_why_and_exits_with_1(scene: Scene) -> None:
    executive = Executive(scene.node)
    running = await following(scene.follower())
    executive.tell("end", 30.0, outcome="failed", reason="not_found: looked everywhere")
    code, result = await running
    assert (code, result["reason"]) == (exits.FAILED, "not_found: looked everywhere")
    assert scene.out.getvalue() == "failed: fetch red_can after 30.0 s: not_found: looked everywhere\n"


@in_virtual_time
async def test_another_tasks_outcome_is_not_taken_for_this_ones(scene: Scene) -> None:
    executive = Executive(scene.node)
    running = await following(scene.follower())
    executive.tell("end", 3.0, task_id="fetch-0", outcome="failed", reason="lost")
    executive.tell("end", 4.0, outcome="done")
    assert (await running)[0] == exits.DONE


@in_virtual_time
async def test_an_outcome_that_comes_with_the_reply_is_not_missed(scene: Scene) -> None:
    executive = Executive(scene.node)
    executive.on_run = lambda: executive.tell("end", 0.0, outcome="failed", reason="unreachable")
    code, _ = await asyncio.wait_for(scene.follower().run(), 5.0)
    assert code == exits.FAILED


@in_virtual_time
async def test_a_detached_task_names_nobody_and_its_id_is_the_result(scene: Scene) -> None:
    executive = Executive(scene.node)
    code, result = await Follower(scene.link, REQUEST, LineDisplay(scene.out), None, watched=False).ask()
    assert (code, result["task_id"], result["outcome"]) == (exits.DONE, ID, None)
    assert executive.asked[0].asker == ""


@in_virtual_time
async def test_who_waits_for_a_task_gets_its_outcome_and_its_code(scene: Scene) -> None:
    executive = Executive(scene.node)
    waiting = Follower(scene.link, None, LineDisplay(scene.out), None)
    waiting.listen()
    running = asyncio.create_task(waiting.attend(TaskState(task_id=ID, task="fetch", label="red_can", phase="lift")))
    await asyncio.sleep(1.0)
    executive.tell("end", 9.5, outcome="failed", reason="slipped")
    assert (await running)[0] == exits.FAILED
    assert executive.cancelled == []
    done = TaskState(task_id=ID, task="fetch", label="red_can", phase="end", outcome="done")
    assert (await Follower(scene.link, None, LineDisplay(scene.out), None).attend(done))[0] == exits.DONE


def refused(code: str, text: str) -> TaskReply:
    return TaskReply(accepted=False, refusal=code, text=text)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("refusal", "code"),
    [
        ("unknown_label", exits.USAGE),
        ("not_graspable", exits.USAGE),
        ("not_able", exits.USAGE),
        ("busy", exits.REFUSED),
        ("not_holding", exits.REFUSED),
    ],
)
def test_a_refusal_gives_the_robots_words_and_its_code(
    refusal: str, code: int, capsys: pytest.CaptureFixture[str]
) -> None:
    recent_complaints.clear()  # as each command does; what was just said is not said again

    @in_virtual_time
    async def scenario(scene: Scene) -> None:
        Executive(scene.node, replies=[refused(refusal, "what it says")])
        assert (await scene.follower().run())[0] == code

    scenario()
    assert capsys.readouterr().err == "cocoro: refused: what it says\n"


@in_virtual_time
async def test_a_robot_that_has_only_just_come_up_is_asked_again(scene: Scene) -> None:
    unsettled = [refused("not_alive", "not yet"), refused("estop", "unknown"), TaskReply(accepted=True, task_id=ID)]
    executive = Executive(scene.node, replies=unsettled)
    running = asyncio.create_task(scene.follower().run())
    await asyncio.sleep(0.5)
    executive.tell("end", 1.0, outcome="done")
    assert (await running)[0] == exits.DONE
    assert len(executive.asked) == 3


@pytest.mark.parametrize(("latch", "asked"), [("latched", range(1, 2)), ("unknown", range(100, 103))])
def test_a_latched_emergency_stop_is_not_asked_about_again_and_again(latch: LatchState, asked: range) -> None:
    @in_virtual_time
    async def scenario(scene: Scene) -> None:
        executive = Executive(scene.node, replies=[refused("estop", "latched")])

        async def say() -> None:
            async for _ in scene.node.every(20.0):
                scene.node.publish(LATCH, Latch(state=latch))

        scene.node.spawn(say())
        assert (await scene.follower().run())[0] == exits.REFUSED
        assert len(executive.asked) in asked

    scenario()


@in_virtual_time
async def test_without_an_executive_it_says_what_to_start(scene: Scene) -> None:
    with pytest.raises(MeshError, match=r"no executive running: start one with `cocoro up sim`"):
        await scene.follower().run()
