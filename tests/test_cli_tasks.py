"""Commands that ask for a task and follow it, against a scripted executive on the local bus in virtual time."""

from __future__ import annotations

import asyncio
import errno
import io
import signal
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from msgspec import to_builtins

from apps.cli import exits
from apps.cli.babble import SampleWriter
from apps.cli.link import MeshLink
from apps.cli.output import recent_complaints
from apps.cli.progress import LineDisplay, TaskDisplay
from apps.cli.tasks import Follower
from cocoro.bus.local import LocalMesh
from cocoro.clock import VirtualClock
from cocoro.errors import MeshError
from cocoro.messages import (
    CancelRequest,
    Latch,
    LatchState,
    Message,
    Phase,
    Recording,
    ReportRequest,
    TaskReply,
    TaskRequest,
    TaskState,
)
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import CANCEL, LATCH, RECORDING, REPORT, RUN, TASK
from cocoro.vloop import run_virtual
from deploy.rundir import RunDir
from services.executive.askers import asker_key
from services.executive.tasks import FetchTask

REQUEST = TaskRequest(task=FetchTask(label="red_can"))
ID = "fetch-1"


@dataclass
class Executive:
    """Accepts one task and publishes the states that the test gives."""

    node: Node
    replies: list[TaskReply] = field(default_factory=lambda: [TaskReply(accepted=True, task_id=ID)])
    asked: list[TaskRequest] = field(default_factory=list)
    cancelled: list[str] = field(default_factory=list)
    known: dict[str, TaskState] = field(default_factory=lambda: {ID: TaskState(task_id=ID, task="fetch")})
    on_run: Callable[[], None] = lambda: None
    on_cancel: Callable[[], None] = lambda: None

    def __post_init__(self) -> None:
        self.node.serve(RUN, self._run)
        self.node.serve(CANCEL, self._cancel)
        self.node.serve(REPORT, self._report)
        self.node.ready()

    async def _run(self, request: TaskRequest) -> TaskReply:
        self.asked.append(request)
        self.on_run()
        return self.replies.pop(0) if len(self.replies) > 1 else self.replies[0]

    async def _cancel(self, request: CancelRequest) -> TaskReply:
        self.cancelled.append(request.task_id)
        self.on_cancel()
        return TaskReply(accepted=True, task_id=request.task_id)

    async def _report(self, request: ReportRequest) -> TaskState:
        return self.known.get(request.task_id, TaskState())

    def tell(self, phase: str, elapsed_s: float, task_id: str = ID, **fields: Any) -> None:
        state = self.knows(phase, elapsed_s, task_id, **fields)
        self.node.publish(TASK, copy(state))

    def knows(self, phase: str, elapsed_s: float, task_id: str = ID, **fields: Any) -> TaskState:
        """The state that it tells who asks."""
        self.known[task_id] = TaskState(
            task_id=task_id, task="fetch", label="red_can", phase=phase, elapsed_s=elapsed_s,
            phases=(Phase(name=phase, start_ns=0),), **fields,
        )  # fmt: skip
        return self.known[task_id]


class Scene:
    """An operator's link and an executive on one mesh."""

    def __init__(self) -> None:
        self.mesh = LocalMesh()
        self.bus = self.mesh.join()
        self.node = Node("executive", self.bus, VirtualClock(), Robot.load())
        self.link = MeshLink(RunDir("calliope", Path("unused")), self.mesh.join())
        self.out = io.StringIO()

    def follower(self, view: TaskDisplay | None = None) -> Follower:
        return Follower(self.link, REQUEST, view or LineDisplay(self.out), None)


def in_virtual_time(scenario: Callable[[Scene], Awaitable[None]]) -> Callable[[], None]:
    async def run() -> None:
        scene = Scene()
        async with scene.node:
            await scenario(scene)

    def test() -> None:
        run_virtual(run())

    test.__name__, test.__doc__ = scenario.__name__, scenario.__doc__
    return test


async def following(follower: Follower) -> asyncio.Task[tuple[int, dict[str, object]]]:
    """A follower whose task has been accepted."""
    running = asyncio.create_task(follower.run())
    await asyncio.sleep(0.01)
    return running


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
async def test_an_outcome_that_was_not_heard_is_asked_for_when_the_next_task_runs(scene: Scene) -> None:
    executive = Executive(scene.node)
    running = await following(scene.follower())
    executive.tell("search", 1.0)
    executive.knows("end", 4.0, outcome="done")
    for elapsed_s in (0.0, 0.2):
        executive.tell("search", elapsed_s, task_id="fetch-2")
    assert (await asyncio.wait_for(running, 1.0))[0] == exits.DONE


@in_virtual_time
async def test_an_outcome_that_comes_with_the_reply_is_not_missed(scene: Scene) -> None:
    executive = Executive(scene.node)
    executive.on_run = lambda: executive.tell("end", 0.0, outcome="failed", reason="unreachable")
    code, _ = await asyncio.wait_for(scene.follower().run(), 5.0)
    assert code == exits.FAILED


class Claimed(Scene):
    """The executive is a process of this machine, which holds its claim."""

    def __init__(self, folder: Path) -> None:
        super().__init__()
        run_dir = RunDir("calliope", folder)
        (self.claim,) = run_dir.claim("executive", ["executive"])
        self.link = MeshLink(run_dir, self.mesh.join())

    def returns(self) -> Executive:
        """The executive, on the mesh again as it was before."""
        self.bus = self.mesh.join()
        self.node = Node("executive", self.bus, VirtualClock(), Robot.load())
        return Executive(self.node)


def with_claim(scenario: Callable[[Claimed], Awaitable[None]]) -> Callable[[Path], None]:
    def test(tmp_path: Path) -> None:
        async def run() -> None:
            scene = Claimed(tmp_path)
            async with scene.node:
                await scenario(scene)
            scene.claim.release()

        run_virtual(run())

    test.__name__ = scenario.__name__
    return test


@with_claim
async def test_when_the_executive_dies_so_does_the_task(scene: Claimed) -> None:
    Executive(scene.node)
    running = await following(scene.follower())
    scene.bus.kill()
    scene.claim.release()
    code, result = await asyncio.wait_for(running, 1.0)
    assert (code, result["outcome"], result["reason"]) == (exits.FAILED, "failed", "executive died")
    assert scene.out.getvalue() == "failed: fetch red_can: executive died\n"


@with_claim
async def test_an_executive_that_is_lost_and_heard_again_says_the_outcome_itself(scene: Claimed) -> None:
    Executive(scene.node)
    running = await following(scene.follower())
    scene.bus.kill()
    await asyncio.sleep(5.0)
    executive = scene.returns()
    executive.tell("approach", 6.0)
    await asyncio.sleep(30.0)
    executive.tell("end", 40.0, outcome="done")
    code, _ = await running
    assert code == exits.DONE
    assert scene.out.getvalue().splitlines()[0] == "lost contact with executive: looking again"


@with_claim
async def test_an_executive_that_dies_while_it_is_not_heard_has_died(scene: Claimed) -> None:
    Executive(scene.node)
    running = await following(scene.follower())
    scene.bus.kill()
    await asyncio.sleep(5.0)
    scene.claim.release()
    code, result = await asyncio.wait_for(running, 1.0)
    assert (code, result["reason"]) == (exits.FAILED, "executive died")


@in_virtual_time
async def test_of_an_executive_that_is_not_heard_any_more_it_is_not_said_that_it_died(scene: Scene) -> None:
    Executive(scene.node)
    running = await following(scene.follower())
    scene.bus.kill()
    code, result = await asyncio.wait_for(running, 15.0)
    reason = "lost contact with executive; the task may still be running; see cocoro status"
    assert (code, result["outcome"], result["reason"]) == (exits.FAILED, "unknown", reason)


@with_claim
async def test_an_executive_that_comes_back_without_the_task_is_not_waited_for(scene: Claimed) -> None:
    Executive(scene.node)
    running = await following(scene.follower())
    scene.bus.kill()
    await asyncio.sleep(5.0)
    executive = scene.returns()
    executive.known.clear()
    executive.tell("", 0.0, task_id="")
    code, result = await asyncio.wait_for(running, 1.0)
    reason = "the executive was restarted meanwhile and does not know the task"
    assert (code, result["outcome"], result["reason"]) == (exits.FAILED, "unknown", reason)


@with_claim
async def test_an_outcome_that_was_told_while_contact_was_lost_is_asked_for(scene: Claimed) -> None:
    Executive(scene.node)
    running = await following(scene.follower())
    scene.bus.kill()
    await asyncio.sleep(5.0)
    executive = scene.returns()
    executive.knows("end", 9.0, outcome="done")
    executive.tell("search", 1.0, task_id="fetch-2")  # another's task runs by now
    assert (await asyncio.wait_for(running, 1.0))[0] == exits.DONE
    assert scene.out.getvalue().splitlines()[-1] == "done: fetch red_can in 9.0 s"


@with_claim
async def test_a_broken_session_is_replaced_by_another(scene: Claimed) -> None:
    """The executive goes on, and is heard by everybody but this command."""
    Executive(scene.node)

    @asynccontextmanager
    async def rejoin() -> AsyncIterator[MeshLink]:
        yield MeshLink(scene.link.run_dir, other.join())

    follower = Follower(scene.link, REQUEST, LineDisplay(scene.out), None, rejoin=rejoin)
    running = await following(follower)
    other = LocalMesh()
    scene.bus.kill()
    node = Node("executive", other.join(), VirtualClock(), Robot.load())
    executive = Executive(node)
    executive.tell("approach", 2.0)
    await asyncio.sleep(3.0)
    executive.tell("end", 5.0, outcome="failed", reason="blocked")
    code, result = await asyncio.wait_for(running, 1.0)
    assert (code, result["outcome"], result["reason"]) == (exits.FAILED, "failed", "blocked")


@in_virtual_time
async def test_when_no_news_arrives_the_executive_is_asked(scene: Scene) -> None:
    executive = Executive(scene.node)
    running = await following(scene.follower())
    executive.knows("end", 3.0, outcome="done")
    assert (await asyncio.wait_for(running, 6.0))[0] == exits.DONE


@in_virtual_time
async def test_the_first_interrupt_cancels_on_the_robot_and_waits_for_the_outcome(scene: Scene) -> None:
    executive = Executive(scene.node)
    executive.on_cancel = lambda: executive.tell("end", 2.0, outcome="cancelled", reason="by the operator")
    follower = scene.follower()
    running = await following(follower)
    follower.signalled(signal.SIGINT)
    code, _ = await running
    assert (code, executive.cancelled) == (exits.REFUSED, [ID])
    assert scene.out.getvalue().splitlines()[-1] == "cancelled: fetch red_can after 2.0 s: by the operator"


@in_virtual_time
async def test_babbling_that_cannot_be_kept_is_cancelled_on_the_robot(scene: Scene) -> None:
    """The robot would move for nothing."""

    class Full:
        taken = 0

        def take(self, _message: Message) -> None:
            self.taken += 1
            raise OSError(errno.ENOSPC, "No space left on device")

    executive = Executive(scene.node)
    executive.on_cancel = lambda: executive.tell("end", 2.0, outcome="cancelled")
    follower, full = scene.follower(), Full()
    writer = SampleWriter(full, follower.cancel)  # type: ignore[arg-type]
    running = await following(follower)
    writer.take(Message())
    writer.take(Message())
    assert (await running)[0] == exits.REFUSED
    assert executive.cancelled == [ID]
    assert full.taken == 1
    assert writer.failure is not None


@in_virtual_time
async def test_of_an_interrupt_before_the_request_the_robot_hears_nothing(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = scene.follower()
    follower.signalled(signal.SIGINT)
    code, result = await follower.run()
    assert (code, result["outcome"], executive.asked) == (exits.REFUSED, "cancelled", [])
    assert scene.out.getvalue() == "cancelled: fetch red_can before it began\n"


@in_virtual_time
async def test_an_interrupt_before_the_robot_has_answered_cancels_as_soon_as_it_has(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = scene.follower()
    executive.on_run = lambda: follower.signalled(signal.SIGTERM)
    executive.on_cancel = lambda: executive.tell("end", 0.1, outcome="cancelled")
    assert (await follower.run())[0] == exits.REFUSED
    assert executive.cancelled == [ID]


@in_virtual_time
async def test_the_second_interrupt_leaves_without_the_outcome_and_says_so(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = scene.follower()
    running = await following(follower)
    follower.signalled(signal.SIGINT)
    await asyncio.sleep(1.0)
    assert not running.done()
    follower.signalled(signal.SIGINT)
    code, result = await asyncio.wait_for(running, 0.1)
    assert (code, result["outcome"], result["task_id"]) == (exits.REFUSED, None, ID)
    assert executive.cancelled == [ID]


@in_virtual_time
async def test_the_signals_of_a_terminal_that_is_closed_are_one_end(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = scene.follower()
    running = await following(follower)
    for _ in range(2):
        follower.cancel()  # its output has no reader any more
        follower.signalled(signal.SIGHUP)
    await asyncio.sleep(1.0)
    executive.tell("end", 2.0, outcome="cancelled", reason="by the operator")
    assert (await running)[0] == exits.REFUSED
    assert executive.cancelled == [ID]


class Vanished(LineDisplay):
    """A terminal that is no more: it raises whatever is written."""

    def say(self, text: str) -> None:
        raise OSError(errno.EIO, "Input/output error")


@in_virtual_time
async def test_the_task_is_cancelled_before_anything_is_written(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = scene.follower(Vanished(scene.out))
    running = await following(follower)
    follower.signalled(signal.SIGHUP)
    await asyncio.sleep(0.1)
    assert executive.cancelled == [ID]
    running.cancel()


@in_virtual_time
async def test_a_request_names_an_asker_whose_token_lives_as_long_as_the_task_is_followed(scene: Scene) -> None:
    executive = Executive(scene.node)
    running = await following(scene.follower())
    key = asker_key("calliope", executive.asked[0].asker)
    assert scene.mesh.tokens[key] == 1
    executive.tell("end", 9.5, outcome="done")
    await running
    assert scene.mesh.tokens[key] == 0


@in_virtual_time
async def test_a_detached_task_names_nobody_and_its_id_is_the_result(scene: Scene) -> None:
    executive = Executive(scene.node)
    code, result = await Follower(scene.link, REQUEST, LineDisplay(scene.out), None, watched=False).ask()
    assert (code, result["task_id"], result["outcome"]) == (exits.DONE, ID, None)
    assert executive.asked[0].asker == ""


@in_virtual_time
async def test_a_detached_task_that_is_let_go_of_before_the_answer_is_cancelled_however_often(scene: Scene) -> None:
    executive = Executive(scene.node)
    follower = Follower(scene.link, REQUEST, LineDisplay(scene.out), None, watched=False)

    def three_times() -> None:
        for _ in range(3):
            follower.signalled(signal.SIGINT)

    executive.on_run = three_times
    code, result = await follower.ask()
    assert (code, result["outcome"], executive.cancelled) == (exits.REFUSED, "cancelled", [ID])


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


@in_virtual_time
async def test_a_task_that_does_not_end_when_cancelled_points_to_the_emergency_stop(scene: Scene) -> None:
    Executive(scene.node)
    follower = scene.follower()
    running = await following(follower)
    follower.signalled(signal.SIGINT)
    await asyncio.sleep(11.0)
    assert "cocoro estop" in scene.out.getvalue().splitlines()[-1]
    running.cancel()


def refused(code: str, text: str) -> TaskReply:
    return TaskReply(accepted=False, refusal=code, text=text)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("refusal", "code"),
    [
        ("unknown_label", exits.USAGE),
        ("not_graspable", exits.USAGE),
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
