"""A command that follows a task, and a scripted executive, on the local bus in virtual time."""

from __future__ import annotations

import asyncio
import io
from collections.abc import Awaitable, Callable
from copy import copy
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from apps.cli.link import MeshLink
from apps.cli.progress import LineDisplay, TaskDisplay
from apps.cli.tasks import Follower
from cocoro.bus.local import LocalMesh
from cocoro.clock import VirtualClock
from cocoro.messages import (
    CancelRequest,
    Phase,
    ReportRequest,
    TaskReply,
    TaskRequest,
    TaskState,
)
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import CANCEL, REPORT, RUN, TASK
from cocoro.vloop import run_virtual
from deploy.rundir import RunDir
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
