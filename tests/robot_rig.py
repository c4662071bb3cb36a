"""The whole robot in one process and in virtual time, for tests that kill and restart services or press the emergency
stop, and judge the result by the true state."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Iterable, Mapping
from itertools import pairwise
from math import atan2, hypot
from typing import Any, NamedTuple

import msgspec
from spelled import asked

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import NS, Clock, VirtualClock
from cocoro.component import load
from cocoro.frames import wrap_rad
from cocoro.messages import (
    BaseState,
    CancelRequest,
    EstopRequest,
    ResetRequest,
    TaskReply,
    TaskState,
    TrueObject,
    Truth,
)
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.testing import NotedBus, Tap, settle
from deploy.delayed import DelayedNode
from deploy.processes import named, needs

SERVICES = ("sim", "perception", "planning", "executive")
HALTED_MPS = 0.01
SMALL_FRAMES = {"width": 320, "height": 240, "frame_rate_hz": 15.0}
CLAWS = {"claw_left", "claw_right"}


class _Running(NamedTuple):
    bus: NotedBus
    node: Node
    work: asyncio.Future[None]


class RobotRig:
    """An asynchronous context manager, in virtual time."""

    def __init__(
        self,
        *,
        services: Iterable[str] = SERVICES,
        settings: Mapping[str, Mapping[str, Any]] | None = None,
        latency_s: Mapping[str, float] | None = None,
        record_steps: bool = False,
        robot: Robot | None = None,
        name: str = "",
        mesh: LocalMesh | None = None,
        clock_of: Callable[[str], Clock] | None = None,
        bus_of: Callable[[LocalMesh, str, str], NotedBus] | None = None,
    ) -> None:
        """`settings`: by service; frames are small unless the settings of 'sim' are given. `robot`: None is the
        Calliope. `name` and `mesh`: for several robots on one mesh. `clock_of`: returns the clock of each service, in
        place of virtual time. `bus_of`: makes the bus of a component on a mesh, for a robot's name."""
        self._settings = {"sim": SMALL_FRAMES} | dict(settings or {})
        self._latency_s = latency_s or {}
        self._record_steps = record_steps
        self._clock = VirtualClock()
        self._clock_of = clock_of or (lambda _: self._clock)
        self._bus_of = bus_of or (lambda mesh, robot, _: NotedBus(mesh, robot))
        self.robot = robot or Robot.load()
        self.robot.name = name or self.robot.name
        self.mesh = mesh or LocalMesh()
        self._services: dict[str, _Running] = {}
        self.operator = Node("operator", self.mesh.join(), self._clock, self.robot)
        self.tap = Tap(self.mesh.join(), self.robot.name)
        if not record_steps:  # then nobody asks for them; those of a fetch are 70 MB
            self.tap.leave_out(topics.FRAME)
        self.truths: list[Truth] = []
        self._base: list[BaseState] = []
        self._first = tuple(services)
        self._tasks: dict[str, TaskState] = {}

    async def __aenter__(self) -> RobotRig:
        await self.operator.__aenter__()
        self.operator.on(topics.TRUTH, self.truths.append)
        self.operator.on(topics.BASE_STATE, self._base.append)
        self.operator.on(topics.TASK, lambda state: self._tasks.update({state.task_id: state}))
        for name in self._first:
            await self.start(name)
        return self

    async def __aexit__(self, *_: object) -> None:
        for name in list(self._services):
            await self.kill(name)
        await self.operator.__aexit__()
        self.tap.forget()  # what it keeps would wait for the garbage collector

    # --- services -----------------------------------------------------------------------------------

    async def start(self, name: str) -> None:
        component = load(named(name))
        needed = {"needed": needs(name)} if name == "executive" else {}
        config = msgspec.convert(needed | dict(self._settings.get(name, {})), component.config)
        bus = self._bus_of(self.mesh, self.robot.name, name)
        node = DelayedNode(
            name, bus, self._clock_of(name), self.robot,
            latency_s=self._latency_s.get(name, 0.0), record_steps=self._record_steps,
        )  # fmt: skip
        await node.__aenter__()
        self._services[name] = _Running(bus, node, asyncio.ensure_future(component.run(node, config)))
        await settle()

    def bus(self, name: str) -> NotedBus:
        """The bus of a running component."""
        return self._services[name].bus

    async def kill(self, name: str) -> None:
        """End a service as SIGKILL does."""
        bus, node, work = self._services.pop(name)
        bus.kill()
        work.cancel()
        await asyncio.gather(work, return_exceptions=True)
        await node.__aexit__()

    # --- time ---------------------------------------------------------------------------------------

    @property
    def now_s(self) -> float:
        return self.operator.now_ns() / NS

    async def advance(self, seconds: float) -> None:
        """Let time pass. Raises the exception of a service that failed meanwhile."""
        await asyncio.sleep(seconds)
        self._check()

    async def until(self, content: Callable[[], object], timeout_s: float = 60.0) -> None:
        """Let time pass until a condition holds."""
        end_s = self.now_s + timeout_s
        while not content():
            assert self.now_s < end_s, f"still not so after {timeout_s:g} s"
            await self.advance(0.01)

    def _check(self) -> None:
        for name, service in self._services.items():
            if service.work.done():
                service.work.result()
                raise AssertionError(f"{name} ended by itself")

    # --- the operator ---------------------------------------------------------------------------------

    async def ask(self, task: str, label: str = "", timeout_s: float | None = None) -> TaskReply:
        return await self.operator.call(topics.RUN, asked(task, label, timeout_s))

    async def begin(self, task: str, label: str = "", timeout_s: float | None = None) -> str:
        """Request a task until it is accepted; returns its id."""
        reply = await self.ask(task, label, timeout_s)
        while reply.refusal in ("not_alive", "estop") and self.now_s < 3.0:
            await self.advance(0.05)
            reply = await self.ask(task, label, timeout_s)
        assert reply.accepted, reply.text
        return reply.task_id

    def state(self, task_id: str) -> TaskState:
        """The last published state of a task."""
        return self._tasks[task_id]

    async def outcome(self, task_id: str, timeout_s: float = 120.0) -> TaskState:
        """Wait for a task's end."""
        await self.until(lambda: task_id in self._tasks and self._tasks[task_id].outcome is not None, timeout_s)
        return self._tasks[task_id]

    async def run(self, task: str, label: str = "", timeout_s: float | None = None) -> TaskState:
        return await self.outcome(await self.begin(task, label, timeout_s))

    async def phase(self, task_id: str, phase: str) -> None:
        """Wait until a task reaches a phase."""
        await self.until(lambda: task_id in self._tasks and self._tasks[task_id].phase == phase)

    async def cancel(self) -> TaskReply:
        return await self.operator.call(topics.CANCEL, CancelRequest())

    async def estop(self, latched: bool) -> set[str]:
        """Press or reset the emergency stop; returns the services that acknowledged it."""
        if latched:
            answers = await self.operator.call_all(topics.ESTOP.of("*"), EstopRequest(by="test"))
        else:
            answers = await self.operator.call_all(topics.RESET.of("*"), ResetRequest(by="test"))
        wanted = "latched" if latched else "released"
        return {answer.service for answer in answers if answer.reply is not None and answer.reply.latch == wanted}

    async def driving(self, speed_mps: float = 0.25, task: str = "fetch") -> str:
        """Start a task with the red can and wait until the robot drives at a speed, m/s; returns the task's id."""
        task_id = await self.begin(task, "red_can")
        await self.until(lambda: self.speed_mps > speed_mps)
        return task_id

    async def holding(self) -> None:
        """Fetch the red can and wait until it is lifted."""
        assert (await self.run("fetch", "red_can")).outcome == "done"

    # --- the truth ------------------------------------------------------------------------------------

    @property
    def speed_mps(self) -> float:
        """True speed of the body over the last step of the true state."""
        return self.speeds_since(-1.0)[-1] if len(self.truths) > 1 else 0.0

    def speeds_since(self, when_s: float) -> list[float]:
        """True speeds of the body, one for each later step of the true state."""
        after = [truth for truth in self.truths[-300:] if truth.stamp_ns >= when_s * NS]
        return [
            hypot(b.body_m[0] - a.body_m[0], b.body_m[1] - a.body_m[1]) / ((b.stamp_ns - a.stamp_ns) / NS)
            for a, b in pairwise(after)
        ]

    def turned_since(self, when_s: float) -> float:
        """True change of the body's heading since then, rad."""
        after = [truth for truth in self.truths if truth.stamp_ns >= when_s * NS]
        first, last = (yaw_of(truth) for truth in (after[0], after[-1]))
        return abs(wrap_rad(last - first))

    def commanded_since(self, when_s: float) -> list[tuple[float, float]]:
        """The wheel commands that were published later."""
        return [
            (command.ahead_mps, command.turn_radps)
            for command in self.tap.messages(topics.BASE_COMMAND)
            if command.stamp_ns > when_s * NS
        ]

    def base_obeys_since(self, when_s: float) -> bool:
        """Whether the base reports that it followed a wheel command later."""
        return any(state.stopped_by == "" for state in self._base if state.stamp_ns > when_s * NS)

    def thing(self, label: str) -> TrueObject:
        """The true state of an object."""
        return next(item for item in self.truths[-1].objects if item.label == label)

    def held(self, label: str) -> bool:
        """Whether an object touches both claws and nothing else and is off the floor, by the true state."""
        return set(self.thing(label).touching) == CLAWS


def yaw_of(truth: Truth) -> float:
    """The body's true heading, rad."""
    x, y, z, w = truth.body_orientation
    return atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
