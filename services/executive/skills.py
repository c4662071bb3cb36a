"""What a task is written with: one awaitable step at a time, each ending in the planner's word on it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Protocol

from cocoro import topics
from cocoro.clock import NS
from cocoro.messages import Behaviour, Intent, PlannerStatus
from cocoro.node import Node


class TaskFailedError(Exception):
    """A step, and with it perhaps the task, did not succeed: a reason to decide on, a text for people."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(f"{reason}: {text}" if text else reason)
        self.reason = reason
        self.text = text


class Skills(Protocol):
    """The steps that tasks are made of."""

    async def do(self, behaviour: Behaviour, label: str = "", *, timeout_s: float) -> PlannerStatus:
        """Have the planner do something until it is done. Raises TaskFailedError with the planner's reason, or
        `timed_out`, or `not_alive` when the planner falls silent."""

    async def watch_hold(self, seconds: float) -> None:
        """Hold still for a while; raises TaskFailedError('slipped') when the hand loses what it holds."""

    @property
    def status(self) -> PlannerStatus | None: ...


class PlannerSkills:
    """Skills by way of the planner on the mesh. `phase(name)` is told of each step."""

    def __init__(self, node: Node, phase: Callable[[str], None], intent_hz: float, silence_s: float) -> None:
        self._node = node
        self._phase = phase
        self._silence_s = silence_s
        self._plan = node.latest(topics.PLAN)
        self._publisher = node.publisher(topics.INTENT)
        self._step = 0
        self.intent = Intent()
        node.spawn(self._repeat(intent_hz))

    @property
    def status(self) -> PlannerStatus | None:
        """The planner's newest word, if it is not too old."""
        return self._plan.fresh()

    def want(self, behaviour: Behaviour, label: str, task_id: str) -> None:
        """Publish a new intent now; it is repeated until the next."""
        self._step += 1
        self.intent = Intent(task_id=task_id, step=self._step, behaviour=behaviour, label=label)
        self._publish()

    def _publish(self) -> None:
        intent = self.intent
        self._publisher.put(
            Intent(task_id=intent.task_id, step=intent.step, behaviour=intent.behaviour, label=intent.label)
        )

    async def _repeat(self, rate_hz: float) -> None:
        async for _ in self._node.every(rate_hz, "intent"):
            self._publish()

    async def do(self, behaviour: Behaviour, label: str = "", *, timeout_s: float) -> PlannerStatus:
        self._phase(behaviour)
        self.want(behaviour, label, self.intent.task_id)
        deadline_ns = self._node.now_ns() + round(timeout_s * NS)
        heard_ns = self._node.now_ns()
        while True:
            status = await self._next_status()
            now_ns = self._node.now_ns()
            if status is None:
                if now_ns - heard_ns > self._silence_s * NS:
                    raise TaskFailedError("not_alive", "the planner is silent")
            else:
                heard_ns = now_ns
                if self._answers(status):
                    if status.state == "done":
                        return status
                    if status.state == "failed":
                        raise TaskFailedError(status.reason, status.why)
            if now_ns > deadline_ns:
                why = status.why if status is not None else ""
                raise TaskFailedError("timed_out", f"{behaviour} took over {timeout_s:g} s: {why}")

    def _answers(self, status: PlannerStatus) -> bool:
        """Whether a status is of what is wanted now; a planner that did not hear for a while is idle meanwhile."""
        wanted = self.intent
        return (status.task_id, status.step, status.behaviour) == (wanted.task_id, wanted.step, wanted.behaviour)

    async def watch_hold(self, seconds: float) -> None:
        self._phase("hold")
        end_ns = self._node.now_ns() + round(seconds * NS)
        while self._node.now_ns() < end_ns:
            status = await self._next_status()
            if status is None:
                raise TaskFailedError("not_alive", "the planner is silent")
            if not status.holding:
                raise TaskFailedError("slipped", "the hand has lost what it held")

    async def _next_status(self) -> PlannerStatus | None:
        """The next status, or None when none comes for a while."""
        waiting = asyncio.ensure_future(self._plan.next())
        timer = asyncio.ensure_future(self._node.sleep(self._silence_s))
        try:
            await asyncio.wait((waiting, timer), return_when=asyncio.FIRST_COMPLETED)
            return waiting.result() if waiting.done() else None
        finally:
            waiting.cancel()
            timer.cancel()
