"""The steps that tasks are made of (`cocoro.tasks.Skills`), carried out by the planner on the mesh."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from cocoro import topics
from cocoro.clock import NS
from cocoro.messages import Intent, PlannerStatus
from cocoro.messages.actions import Action, Idle
from cocoro.node import Node
from cocoro.objects import Catalogue
from cocoro.tasks import Limits, TaskFailedError
from cocoro.units import Vec2, Vec3
from services.executive.config import ExecutiveConfig

LOOSE_S = 0.5
"""A hand that feels nothing for longer has lost what it held. When the arm comes to rest the claws may feel nothing for
a moment, and then need a quarter of a second until they trust their grip again."""

LISTEN_S = 0.25
"""Time after which this process notes that it heard nothing of the planner. However long it really was, it counts as
this much: a process that did not run heard nothing, whoever spoke."""


class PlannerSkills:
    """Publishes intents and waits for the planner's answers. Calls `phase(name)` at the begin of each step."""

    def __init__(self, node: Node, config: ExecutiveConfig, catalogue: Catalogue, phase: Callable[[str], None]) -> None:
        self._node = node
        self._config = config
        self._catalogue = catalogue
        self._phase = phase
        self._plan = node.latest(topics.PLAN)
        self._publisher = node.publisher(topics.INTENT)
        self._step = 0
        self.paused = False
        """Whether the planner is to stand still now, whatever the task wants; it begins the wanted action anew
        afterwards."""
        self.waits = ""
        """Why a task waits for the planner; empty when it does not."""
        self.intent = Intent(action=Idle())
        self.measures: dict[str, float] = {}
        """The running task's."""
        node.spawn(self._repeat(config.intent_hz))

    @property
    def limits(self) -> Limits:
        return self._config

    @property
    def status(self) -> PlannerStatus | None:
        return self._plan.fresh()

    def place(self) -> Vec2:
        status = self.status
        if status is None or status.body_m is None:
            raise TaskFailedError("not_alive", "the planner does not say where the robot stands")
        return status.body_m

    def size_m(self, label: str) -> Vec3:
        known = self._catalogue.get(label)
        if known is None:
            raise KeyError(label)
        return known.size_m

    def now_s(self) -> float:
        return self._node.now_ns() / NS

    def want(self, action: Action, task_id: str) -> None:
        """Publish a new intent now; it is repeated until the next."""
        self._step += 1
        self.intent = Intent(task_id=task_id, step=self._step, action=action)
        self._publish()

    def pause(self, paused: bool) -> None:
        self.paused = paused
        self._publish()

    def _publish(self) -> None:
        wanted = self.intent
        self._publisher.put(
            Intent(task_id=wanted.task_id, step=wanted.step, action=Idle() if self.paused else wanted.action)
        )

    async def _repeat(self, rate_hz: float) -> None:
        async for _ in self._node.every(rate_hz, "intent"):
            self._publish()

    async def do(self, action: Action, *, timeout_s: float) -> PlannerStatus:
        self._begin(action)
        ended = await self._watch(self.now_s() + timeout_s)
        if ended is None:
            status = self.status
            why = status.why if status is not None else ""
            raise TaskFailedError("timed_out", f"{action.name} took over {timeout_s:g} s: {why}")
        return ended

    async def keep_doing(
        self, action: Action, *, until_s: float, watch: Callable[[PlannerStatus], None] = lambda status: None
    ) -> None:
        self._begin(action)
        await self._watch(until_s, watch)

    def measure(self, name: str, value: float) -> None:
        self.measures[name] = round(value, 3)

    def _begin(self, action: Action) -> None:
        self._phase(action.name)
        self.want(action, self.intent.task_id)

    async def _watch(
        self, until_s: float, watch: Callable[[PlannerStatus], None] = lambda status: None
    ) -> PlannerStatus | None:
        """Wait until the planner reports the wanted action as done; None when it is not by `until_s`. `watch` gets each
        status of the action. Raises TaskFailedError when it reports a failure."""
        while True:
            status = await self._next_status()
            if self._answers(status):
                watch(status)
                if status.state == "done":
                    return status
                if status.state == "failed":
                    raise TaskFailedError(status.reason, status.why)
            if self.now_s() > until_s:
                return None

    def _answers(self, status: PlannerStatus) -> bool:
        """Whether a status is about the wanted action. A planner that has missed the intents for a while is idle."""
        wanted = self.intent
        return (status.task_id, status.step, status.behaviour) == (wanted.task_id, wanted.step, wanted.action.name)

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
        """The next status. Waits for a planner that is late; raises TaskFailedError when it is late for too long."""
        heard_nothing_s = 0.0
        waiting = asyncio.ensure_future(self._plan.next())
        try:
            while True:
                timer = asyncio.ensure_future(self._node.sleep(LISTEN_S))
                try:
                    await asyncio.wait((waiting, timer), return_when=asyncio.FIRST_COMPLETED)
                finally:
                    timer.cancel()
                if waiting.done():
                    return waiting.result()
                heard_nothing_s += LISTEN_S
                if heard_nothing_s >= self._config.planner_silence_s:
                    raise TaskFailedError("not_alive", f"nothing from the planner for {heard_nothing_s:g} s")
                if heard_nothing_s >= self._config.planner_late_s:
                    self.waits = f"waiting: nothing from the planner for {heard_nothing_s:.1f} s"
        finally:
            self.waits = ""
            waiting.cancel()
