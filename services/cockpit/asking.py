"""What the page asks of the robot's services: tasks, objects, the emergency stop's release."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from typing import Any, NamedTuple

import msgspec

from cocoro.errors import CocoroError
from cocoro.keys import asker_key
from cocoro.messages import (
    CancelRequest,
    ObjectsRequest,
    ResetRequest,
    TaskReply,
    TaskRequest,
    TasksRequest,
)
from cocoro.node import Node
from cocoro.stop.asking import STOPPABLE
from cocoro.topics import CANCEL, OBJECTS, RESET, RUN, TASKS

LEARN_S = 1.0
"""Longest wait for the executive's tasks and objects."""
INSTEAD_S = 6.0
"""Longest wait for a task that begins when another has come to rest."""
EXECUTIVE = "executive"


class Reply(NamedTuple):
    """What became of a request."""

    ok: bool
    text: str
    data: Mapping[str, Any] | None = None


class Asker:
    """Calls the requests of the mesh, and remembers which tasks and objects there are."""

    def __init__(self, node: Node) -> None:
        self.tasks: list[dict[str, Any]] = []
        self.objects: list[dict[str, Any]] = []
        self._node = node
        self._alive: set[str] = set()
        self._learnt = False
        node.keep(node.bus.declare_alive(asker_key(node.robot_name, node.name)))

    def lives(self, service: str, alive: bool) -> None:
        """A service became alive, or ceased to be. A new executive may know other tasks."""
        (self._alive.add if alive else self._alive.discard)(service)
        if service == EXECUTIVE:
            self._learnt = False

    async def learn(self) -> None:
        """Ask the executive for its tasks and objects, where they are not known; they stay so without an answer."""
        if self._learnt or EXECUTIVE not in self._alive:
            return
        try:
            tasks, objects = await asyncio.gather(
                self._node.call(TASKS, TasksRequest(), LEARN_S), self._node.call(OBJECTS, ObjectsRequest(), LEARN_S)
            )
        except CocoroError as error:
            self._node.log.info("the executive does not tell its tasks: %s", error)
            return
        # A task that reports samples needs somebody who keeps them: `cocoro babble` does.
        self.tasks = [msgspec.to_builtins(task) for task in tasks.tasks if not task.samples]
        self.objects = [
            {"label": one.label, "shape": one.shape, "graspable": one.graspable, "size_m": one.size_m}
            for one in objects.objects
        ]
        self._learnt = True

    async def run(self, task: Mapping[str, Any], *, instead: bool = False, with_us: bool = False) -> Reply:
        """Start a task; `instead` of the one that runs, once the robot is at rest. `with_us`: it ends when this process
        does, however it ends."""
        asker = self._node.name if with_us else ""
        request = TaskRequest(task=dict(task), instead=instead, asker=asker)
        return await self._told(self._node.call(RUN, request, INSTEAD_S if instead else None))

    async def cancel(self, task_id: str = "") -> Reply:
        """End the running task, or this one."""
        return await self._told(self._node.call(CANCEL, CancelRequest(task_id=task_id)))

    async def _told(self, asking: Any) -> Reply:
        try:
            reply: TaskReply = await asking
        except CocoroError as error:
            return Reply(False, str(error))
        return Reply(reply.accepted, reply.text, {"task_id": reply.task_id, "refusal": reply.refusal})

    async def reset(self, by: str) -> Reply:
        """Release the emergency stop. The executive is asked first: when it refuses, everything stays latched."""
        moving = {service for service in STOPPABLE if service in self._alive}
        if not moving:
            return Reply(False, "no service that moves something is alive")
        question = ResetRequest(by=f"cockpit: {by}")
        try:
            if EXECUTIVE in self._alive and (why := await self._refusal({EXECUTIVE}, EXECUTIVE, question)):
                return Reply(False, why)
            why = await self._refusal(moving, "*", question)
        except CocoroError as error:
            return Reply(False, str(error))
        return Reply(not why, why, {"released": sorted(moving)})

    async def _refusal(self, wanted: set[str], asked: str, question: ResetRequest) -> str:
        """Who of the wanted did not release, and why; '' when all did."""
        answers = {answer.service: answer for answer in await self._node.call_all(RESET.of(asked), question)}
        for service in sorted(wanted):
            answer = answers.get(service)
            if answer is None:
                return f"{service} does not release the emergency stop: no answer"
            if answer.reply is None or answer.reply.latch != "released":
                why = answer.error or (answer.reply.text if answer.reply else "") or "it is still latched"
                return f"{service} does not release the emergency stop: {why}"
        return ""
