"""What a task is written with: one awaitable step at a time, each ending in the planner's word on it."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from copy import copy
from typing import Protocol

from cocoro import topics
from cocoro.clock import NS
from cocoro.messages import Behaviour, Intent, PlannerStatus
from cocoro.node import Node
from cocoro.units import Vec2

LOOSE_S = 0.5
"""A hand that feels nothing for so long has lost what it held. When the arm comes to rest the claws may feel nothing
for a moment, and then want a quarter of a second until they trust their grip again."""

LISTEN_S = 0.25
"""At least so long nothing may come while this process runs, before the planner is said to be silent."""


class TaskFailedError(Exception):
    """A step, and with it perhaps the task, did not succeed: a reason to decide on, a text for people."""

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(f"{reason}: {text}" if text else reason)
        self.reason = reason
        self.text = text


class Skills(Protocol):
    """The steps that tasks are made of."""

    async def do(
        self,
        behaviour: Behaviour,
        label: str = "",
        *,
        timeout_s: float,
        place_m: Vec2 | None = None,
        distance_m: float = 0.0,
        first: int = 0,
        count: int = 0,
    ) -> PlannerStatus:
        """Have the planner do something until it is done. Raises TaskFailedError with the planner's reason, or
        `timed_out`, or `not_alive` when the planner falls silent."""

    async def keep_doing(self, behaviour: Behaviour, label: str, *, until_s: float) -> None:
        """Have the planner do something that has no end, until a time; raises as `do` does."""

    async def watch_hold(self, seconds: float) -> None:
        """Hold still for a while; raises TaskFailedError('slipped') when the hand loses what it holds."""

    def place(self) -> Vec2:
        """Where the body stands in the odometry frame."""

    def now_s(self) -> float: ...

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

    def place(self) -> Vec2:
        status = self.status
        if status is None or status.body_m is None:
            raise TaskFailedError("not_alive", "the planner does not say where the robot stands")
        return status.body_m

    def now_s(self) -> float:
        return self._node.now_ns() / NS

    def want(
        self,
        behaviour: Behaviour,
        label: str,
        task_id: str,
        place_m: Vec2 | None = None,
        distance_m: float = 0.0,
        first: int = 0,
        count: int = 0,
    ) -> None:
        """Publish a new intent now; it is repeated until the next."""
        self._step += 1
        self.intent = Intent(
            task_id=task_id,
            step=self._step,
            behaviour=behaviour,
            label=label,
            place_m=place_m,
            distance_m=distance_m,
            first=first,
            count=count,
        )
        self._publish()

    def _publish(self) -> None:
        self._publisher.put(copy(self.intent))

    async def _repeat(self, rate_hz: float) -> None:
        async for _ in self._node.every(rate_hz, "intent"):
            self._publish()

    async def do(
        self,
        behaviour: Behaviour,
        label: str = "",
        *,
        timeout_s: float,
        place_m: Vec2 | None = None,
        distance_m: float = 0.0,
        first: int = 0,
        count: int = 0,
    ) -> PlannerStatus:
        self._phase(behaviour)
        self.want(behaviour, label, self.intent.task_id, place_m, distance_m, first, count)
        ended = await self._watch(self.now_s() + timeout_s)
        if ended is None:
            status = self.status
            why = status.why if status is not None else ""
            raise TaskFailedError("timed_out", f"{behaviour} took over {timeout_s:g} s: {why}")
        return ended

    async def keep_doing(self, behaviour: Behaviour, label: str, *, until_s: float) -> None:
        self._phase(behaviour)
        self.want(behaviour, label, self.intent.task_id)
        await self._watch(until_s)

    async def _watch(self, until_s: float) -> PlannerStatus | None:
        """Wait for the planner's word that what is wanted is done; None when it is not by then."""
        while True:
            status = await self._next_status()
            if self._answers(status):
                if status.state == "done":
                    return status
                if status.state == "failed":
                    raise TaskFailedError(status.reason, status.why)
            if self.now_s() > until_s:
                return None

    def _answers(self, status: PlannerStatus) -> bool:
        """Whether a status is of what is wanted now; a planner that did not hear for a while is idle meanwhile."""
        wanted = self.intent
        return (status.task_id, status.step, status.behaviour) == (wanted.task_id, wanted.step, wanted.behaviour)

    async def watch_hold(self, seconds: float) -> None:
        self._phase("hold")
        end_ns = self._node.now_ns() + round(seconds * NS)
        loose_since_ns: int | None = None
        while True:
            status = await self._next_status()
            now_ns = self._node.now_ns()
            if status.holding:
                loose_since_ns = None
                if now_ns >= end_ns:
                    return
            elif loose_since_ns is None:
                loose_since_ns = now_ns
            elif now_ns - loose_since_ns > LOOSE_S * NS:
                raise TaskFailedError("slipped", "the hand has lost what it held")

    async def _next_status(self) -> PlannerStatus:
        """The next status. Raises TaskFailedError when none comes for too long."""
        while True:
            waiting = asyncio.ensure_future(self._plan.next())
            try:
                # The last part is listened to anew: who was stopped meanwhile takes what came only after it wakes.
                for part_s in (max(self._silence_s - LISTEN_S, 0.0), LISTEN_S):
                    began_s = self.now_s()
                    timer = asyncio.ensure_future(self._node.sleep(part_s))
                    try:
                        await asyncio.wait((waiting, timer), return_when=asyncio.FIRST_COMPLETED)
                    finally:
                        timer.cancel()
                    if waiting.done():
                        return waiting.result()
            finally:
                waiting.cancel()
            if self.now_s() - began_s < 2 * LISTEN_S:
                raise TaskFailedError("not_alive", "the planner is silent")
            # This process was itself stopped in that last part.
