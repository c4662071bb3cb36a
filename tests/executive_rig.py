"""The executive with a scripted planner and scripted hardware."""

from __future__ import annotations

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

import msgspec
from spelled import asked, idle

from cocoro import topics
from cocoro.clock import NS, Clock
from cocoro.contact import Contact
from cocoro.messages import (
    BaseState,
    EstopReply,
    EstopRequest,
    Intent,
    LatchState,
    PlannerStatus,
    ResetRequest,
    ServoState,
    TargetEstimate,
    TaskReply,
    TaskState,
)
from cocoro.messages.actions import Idle
from cocoro.testing import ServiceUnderTest
from deploy.processes import hardware, needs, stoppable


class Robot:
    """An executive under test and the services that it needs."""

    def __init__(self, service: ServiceUnderTest) -> None:
        self.service = service
        self.script: dict[str, list[str]] = {}
        """By behaviour, the results of its next steps: 'done', a reason to fail, or 'never'. The default is 'done'."""
        self.takes_s = 0.1
        self.holding = False
        self.speed_mps = 0.0
        self.silent = False
        self.says: dict[str, LatchState] = dict.fromkeys(stoppable(), "released")
        self.task_id = ""
        self.asked: list[str] = []
        """The behaviours that were requested, without repetitions."""
        self._intent = idle()
        self._since_ns = 0
        self._end = "done"
        service.tester.on(topics.INTENT, self._hear)
        service.tester.spawn(self._work())

    def _hear(self, intent: Intent) -> None:
        before = self._intent
        if (intent.task_id, intent.step, intent.action) == (before.task_id, before.step, before.action):
            return
        self._intent, self._since_ns = intent, self.service.tester.now_ns()
        self.asked.append(intent.action.name)
        self._end = (self.script.get(intent.action.name) or ["done"]).pop(0)

    async def _work(self) -> None:
        async for _ in self.service.tester.every(50.0):
            self._tell_hardware()
            if not self.silent:
                self.service.feed(topics.PLAN, self.status())

    def _tell_hardware(self) -> None:
        for name in stoppable():
            if name == "base" and name in self.says:
                here = {"odometry_m": (0.0, 0.0), "odometry_yaw_rad": 0.0, "turn_rate_radps": 0.0}
                state = BaseState(**here, speed_mps=self.speed_mps, latch=self.says[name])  # type: ignore[arg-type]
                self.service.feed(topics.BASE_STATE, state)
            elif name in self.says:
                servos = ServoState(joints=(), position_rad=(), speed_radps=(), load=(), latch=self.says[name])
                self.service.feed(topics.ARM_STATE if name == "arm" else topics.HAND_STATE, servos)

    def status(self, **changes: Any) -> PlannerStatus:
        over = self.service.tester.now_ns() - self._since_ns >= self.takes_s * NS and self._end != "never"
        status = PlannerStatus(
            task_id=self._intent.task_id,
            step=self._intent.step,
            behaviour=self._intent.action.name,
            state=("done" if self._end == "done" else "failed") if over else "running",
            reason=self._end if over and self._end != "done" else "",
            why=f"{self._intent.action.name} is what I do",
            distance_m=0.5,
            holding=self.holding,
            body_m=(0.0, 0.0),
            known=(TargetEstimate(label="red_can", position_m=(1.0, 0.0, 0.06), age_s=3.0),),
        )
        return msgspec.structs.replace(status, **changes)

    # --- what an operator does ------------------------------------------------------------------------

    async def ask(self, task: str = "fetch", label: str = "red_can", **more: Any) -> TaskReply:
        return await self.service.ask(topics.RUN, asked(task, label, **more))

    async def begin(self, task: str = "fetch", label: str = "red_can", **more: Any) -> str:
        reply = await self.ask(task, label, **more)
        assert reply.accepted, reply.text
        self.task_id = reply.task_id
        return reply.task_id

    async def estop(self, latched: bool) -> EstopReply:
        """Stop or reset the executive alone."""
        if latched:
            return await self.service.ask(topics.ESTOP.of("executive"), EstopRequest(by="test"))
        return await self.service.ask(topics.RESET.of("executive"), ResetRequest(by="test"))

    def state(self) -> TaskState:
        """The last published state of a task; empty before the first."""
        return (self.service.outputs(topics.TASK) or [TaskState()])[-1]

    async def outcome(self) -> TaskState:
        """Wait for the end of the last task that was begun."""

        def over() -> bool:
            state = self.state()
            return state.outcome is not None and state.task_id == self.task_id

        await self.service.until(over, timeout_s=300.0)
        return self.state()

    async def phase(self, name: str) -> None:
        await self.service.until(lambda: self.state().phase == name)

    def latch(self) -> LatchState:
        return self.service.latest(topics.LATCH).state


@asynccontextmanager
async def robot(
    clock: Clock | None = None, ready: bool = True, contact: Contact | None = None, **config: Any
) -> AsyncIterator[Robot]:
    """A robot with all services alive and the hardware released; with `ready=False` without them."""
    under_test = ServiceUnderTest("services.executive.service", {"needed": needs("executive")} | config, clock=clock)
    if contact is not None:
        under_test.node.contact = contact
    async with under_test as service:
        robot = Robot(service)
        if ready:
            service.others_live(*hardware(), "perception", "planning")
            await service.advance(0.5)
        yield robot


def idle_again(robot: Robot) -> bool:
    return isinstance(robot.service.latest(topics.INTENT).action, Idle)
