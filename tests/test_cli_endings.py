"""Every way in which a person ends a task's command or lets go of it, over real processes: the task is cancelled."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Coroutine
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from bench.command_endings import ENDS, KINDS, Command
from cocoro.bus.endpoints import default
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import RealClock
from cocoro.messages import CancelRequest, ReportRequest, TaskReply, TaskRequest, TaskState
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import CANCEL, REPORT, RUN, TASK
from services.executive.askers import Askers
from services.executive.executive import GONE

pytestmark = [pytest.mark.zenoh, pytest.mark.process]

PATIENCE_S = 60.0
UNANSWERED = b"the executive does not answer"
MUTE = {kind for kind in KINDS if "closed" in kind or "gone" in kind or "unread" in kind}
"""Endings after which nobody reads what the command says."""
STARTS = 5
AT_ONCE = 4
"""Commands at a time: more would be late on a busy machine, and give up."""


class Executive:
    """Takes any number of tasks at a time, and notes who ended each: `operator` by a request, or `gone`. A task's id is
    its time limit, by which a test tells its commands apart."""

    def __init__(self, node: Node) -> None:
        self._node = node
        self._asked: dict[str, str] = {}
        """Task by asker."""
        self.ended: dict[str, str] = {}
        self.changed = asyncio.Event()
        self._askers = Askers(node, lambda asker: self._end(self._asked[asker], "gone"))
        node.serve(RUN, self._run)
        node.serve(CANCEL, self._cancel)
        node.serve(REPORT, self._report)
        node.ready()

    async def _run(self, request: TaskRequest) -> TaskReply:
        if not await self._askers.present(request.asker):  # on a busy machine; the command asks again
            return TaskReply(accepted=False, refusal="asker_gone", text=GONE)
        task_id = f"{request.timeout_s:g}"
        self._asked[request.asker] = task_id
        self.changed.set()
        return TaskReply(accepted=True, task_id=task_id)

    async def _cancel(self, request: CancelRequest) -> TaskReply:
        self._end(request.task_id, "operator")
        return TaskReply(accepted=True, task_id=request.task_id)

    async def _report(self, request: ReportRequest) -> TaskState:
        return self._state(request.task_id)

    def _end(self, task_id: str, by: str) -> None:
        self.ended.setdefault(task_id, by)
        self._node.publish(TASK, self._state(task_id))
        self.changed.set()

    def _state(self, task_id: str) -> TaskState:
        state = TaskState(task_id=task_id, task="fetch", label="red_can")
        if task_id in self.ended:
            state.outcome = "cancelled"
        return state

    async def until_asked(self, task_id: str) -> None:
        while task_id not in self._asked.values():
            await self._change()

    async def until_ended(self, task_id: str) -> str:
        while task_id not in self.ended:
            await self._change()
        return self.ended[task_id]

    async def _change(self) -> None:
        self.changed.clear()
        async with asyncio.timeout(PATIENCE_S):
            await self.changed.wait()


class Ended(NamedTuple):
    by: str
    """Who ended the task."""
    code: int | None
    said: bytes


async def asking(executive: Executive, task_id: str, kind: str) -> Command:
    """A command whose task runs. On a busy machine one may give up before it has met the executive."""
    gave_up = list[bytes]()
    for _ in range(STARTS):
        command = Command(os.environ, ["fetch", "red_can", "--timeout", task_id], kind)
        asked = asyncio.create_task(executive.until_asked(task_id))
        ended = asyncio.create_task(asyncio.to_thread(command.process.wait))
        await asyncio.wait((asked, ended), return_when=asyncio.FIRST_COMPLETED)
        if asked.done():
            return command
        asked.cancel()
        command.finish()
        gave_up.append(bytes(command.said))
    raise AssertionError(f"{kind}: {gave_up}")


async def end(executive: Executive, number: int, kind: str) -> Ended:
    """End one command once its task runs."""
    task_id = str(100 + number)
    command = await asking(executive, task_id, kind)
    try:
        await asyncio.to_thread(KINDS[kind], command)
        by = await executive.until_ended(task_id)
    except TimeoutError:
        alive = "lives" if command.process.poll() is None else "has ended"
        raise AssertionError(f"{kind}: the command {alive}, and said {bytes(command.said)!r}") from None
    finally:
        code = await asyncio.to_thread(command.finish)
    return Ended(by, code, bytes(command.said))


async def in_turn(turns: asyncio.Semaphore, ending: Coroutine[Any, Any, Ended]) -> Ended:
    async with turns:
        return await ending


def test_a_task_is_cancelled_by_every_signal_hang_up_and_lost_reader(root: Path) -> None:
    async def scenario() -> None:
        async with (
            await ZenohBus.open(default("calliope", "executive")) as bus,
            Node("executive", bus, RealClock(), Robot.load()) as node,
        ):
            executive = Executive(node)
            turns = asyncio.Semaphore(AT_ONCE)
            ends = await asyncio.gather(*(in_turn(turns, end(executive, *one)) for one in enumerate(KINDS)))
        by = {kind: end.by for kind, end in zip(KINDS, ends, strict=True)}
        # On a busy machine a request to cancel may get no answer in time. The command says so, if it still can, and
        # drops its token; a second Ctrl-C may come before the request has left.
        excused = (
            {kind for kind, end in zip(KINDS, ends, strict=True) if UNANSWERED in end.said} | MUTE | {"Ctrl-C twice"}
        )
        assert {by[kind] for kind in ENDS} == {"gone"}
        assert {kind for kind in by if by[kind] == "gone"} <= ENDS.keys() | excused
        codes = {kind: end.code for kind, end in zip(KINDS, ends, strict=True)}
        assert codes == {kind: ENDS.get(kind, 3) for kind in KINDS}
        assert not [end.said for end in ends if b"Traceback" in end.said]

    asyncio.run(scenario())
