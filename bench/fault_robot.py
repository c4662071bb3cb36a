"""A whole robot in one process and in virtual time that drives at full speed when a fault occurs."""

from __future__ import annotations

import asyncio
import random
from collections.abc import Sequence
from contextlib import AsyncExitStack, suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import msgspec

from bench.fault_bus import LATE_S, FaultyBus, Way
from bench.fault_scenes import Errand
from bench.report import Report
from cocoro import topics
from cocoro.bus.base import Payload, Qos
from cocoro.bus.local import LocalMesh
from cocoro.clock import NS, VirtualClock
from cocoro.component import load
from cocoro.errors import CocoroError
from cocoro.messages import CancelRequest, EstopRequest, TaskReply, TaskRequest, TaskState
from cocoro.node import Node
from cocoro.robot import Robot
from deploy.processes import hardware, named, needs
from services.planning.config import PlanningConfig
from sim.motion import MotionRow, read_motion

SERVICES = ("sim", "perception", "planning", "executive")
STANDING_MPS = 0.01
STAND_S = 0.3
"""Bound from a fault until the body stands for good."""
PATIENCE_S = 25.0
"""Time limit to reach full speed."""
ARRIVED = ("reach", "end")
"""Phases in which a robot does not drive any more."""
WATCH_S = 1.0
"""Time that it is watched after a fault."""
FRAMES = {"width": 320, "height": 240, "frame_rate_hz": 30.0, "sensors": "real"}


def full_speed_mps(drive: str) -> float:
    """The highest speed that the planner chooses for a task."""
    planning = PlanningConfig()
    return planning.follow.max_speed_mps if drive == "follow" else planning.navigation.max_speed_mps


class NotFastError(CocoroError):
    """The robot did not reach its full speed."""


class Happening(NamedTuple):
    """A fault: a service that fails in some way, an event (`what`), or both together."""

    service: str = ""
    way: Way | None = None
    what: str = ""
    """'estop', 'cancel', 'flood' (bad messages on every key, too many to count), or nothing."""

    @property
    def name(self) -> str:
        return " and ".join(filter(None, (self.what, f"{self.service} {self.way}" if self.way else "")))

    @property
    def watch_s(self) -> float:
        """Time to watch after the fault, s. A late service is watched until its messages arrive again. Late
        perception is the exception: by then it counts as slow, and the robot drives on."""
        late_s = LATE_S if self.service in ("perception", "kinect") else LATE_S + 0.5
        return late_s if self.way == "late" else WATCH_S


class FaultRobot:
    """An asynchronous context manager in virtual time. `folder` receives the record of its motion."""

    def __init__(self, errand: Errand, folder: Path, seed: int) -> None:
        self._errand = errand
        self._motion = folder / "motion"
        self._settings: dict[str, dict[str, Any]] = {
            "sim": FRAMES | {"scene": str(errand.scene), "seed": seed, "motion": str(self._motion)}
        }
        self._mesh = LocalMesh()
        self._robot = Robot.load()
        self._clock = VirtualClock()
        self._buses: dict[str, FaultyBus] = {}
        self._nodes: dict[str, Node] = {}
        self._runs: list[asyncio.Future[None]] = []
        self._stack = AsyncExitStack()
        self._rows: list[MotionRow] = []
        self._said: dict[str, bytes] = {}
        self._phase = ""
        """The phase of the task."""
        self.operator = Node("operator", self._mesh.join(), self._clock, self._robot)

    async def __aenter__(self) -> FaultRobot:
        for name in SERVICES:
            component = load(named(name))
            needed = {"needed": needs(name)} if name == "executive" else {}
            config = msgspec.convert(needed | self._settings.get(name, {}), component.config)
            bus = self._buses[name] = FaultyBus(self._mesh.join(), name)
            node = self._nodes[name] = Node(name, bus, self._clock, self._robot)
            await self._stack.enter_async_context(node)
            self._runs.append(asyncio.ensure_future(component.run(node, config)))
        await self._stack.enter_async_context(self.operator)
        self.operator.on(topics.TASK, self._note_phase)
        self._mesh.join().subscribe(f"{self._robot.name}/**", Qos.EVENT, self._hear, depth=1)
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for run in self._runs:
            run.cancel()
        await asyncio.gather(*self._runs, return_exceptions=True)
        await self._stack.aclose()

    def _hear(self, key: str, payload: Payload) -> None:
        self._said.setdefault(key, bytes(payload))

    def _note_phase(self, state: TaskState) -> None:
        self._phase = state.phase

    # --- before -----------------------------------------------------------------------------------

    async def drive(self, rng: random.Random) -> MotionRow:
        """Give the task and drive until a random moment at full speed; returns the body's motion then. Raises
        NotFastError."""
        await self._begin()
        full_mps = 0.97 * full_speed_mps(self._errand.task.name)
        end_s = PATIENCE_S + self._now_s()
        while self._now_s() < end_s and self._phase not in ARRIVED:
            await asyncio.sleep(0.02)
            if self._newest().speed_mps < full_mps:
                continue
            await asyncio.sleep(rng.uniform(0.0, 0.8))
            if (now := self._newest()).speed_mps >= full_mps:
                return now
        raise NotFastError(f"{self._errand.task.name} {self._errand.task.target}: never at {full_mps:.2f} m/s")

    async def _begin(self) -> None:
        question = TaskRequest(task=self._errand.task, timeout_s=60.0)
        for _ in range(100):
            await asyncio.sleep(0.05)
            reply = TaskReply(accepted=False)
            with suppress(CocoroError):  # no service answers it yet
                reply = await self.operator.call(topics.RUN, question)
            if reply.accepted:
                return
        raise NotFastError(f"the task is refused: {reply.text}")

    def _now_s(self) -> float:
        return self.operator.now_ns() / NS

    def _newest(self) -> MotionRow:
        self._rows += read_motion(self._motion, len(self._rows))
        return self._rows[-1]

    # --- what happens -----------------------------------------------------------------------------

    async def stand_s(self, happening: Happening, rng: random.Random) -> float:
        """Cause the fault and watch; returns the time from the fault until the body stood for good, s."""
        began_ns = self.operator.now_ns()
        work = [self.operator.spawn(self._do(happening.what, rng))] if happening.what else []
        if happening.way is not None:
            self._fail(happening.service, happening.way)
        await asyncio.sleep(happening.watch_s)
        self._newest()
        for task in work:
            if task.done():
                task.result()
            task.cancel()
        for run in self._runs:
            if run.done() and not run.cancelled():
                run.result()
        moving = [row for row in self._rows if row.sim_ns > began_ns and row.moves_mps >= STANDING_MPS]
        return (moving[-1].sim_ns - began_ns) / NS if moving else 0.0

    def _fail(self, service: str, way: Way) -> None:
        bus = self._buses["sim" if service in hardware() else service]
        bus.fail(service, way)
        if way == "dies" and service not in hardware():
            bus.whole.kill()
            self._runs[SERVICES.index(service)].cancel()

    async def _do(self, what: str, rng: random.Random) -> None:
        if what == "estop":
            await self.operator.call_all(topics.ESTOP.of("*"), EstopRequest(by="bench"))
        elif what == "cancel":
            await self.operator.call(topics.CANCEL, CancelRequest())
        elif what == "flood":
            await self._flood(rng)

    async def _flood(self, rng: random.Random) -> None:
        """Publish invalid, repeated and truncated messages on random keys, a thousand times a second."""
        keys = sorted(key for key, said in self._said.items() if said)
        while True:
            key = rng.choice(keys)
            good = self._said[key]
            bad = rng.choice((b"", good, good[: rng.randrange(len(good))], rng.randbytes(rng.randrange(1, 60))))
            self._mesh.publish(key, bad)
            await asyncio.sleep(0.001)


def report_stands(report: Report, times_s: Sequence[float]) -> None:
    """The figures of times from a fault until the body stood for good, s. In each trial that must be within `STAND_S`.
    Raises CocoroError without times."""
    if not times_s:
        raise CocoroError("no trial came about")
    report.value("time to stand", times_s, "s")
    report.value("longest time to stand", [max(times_s)], "s", at_most=STAND_S)
    good = sum(time_s <= STAND_S for time_s in times_s)
    report.share(f"stood within {STAND_S:g} s", good, len(times_s), at_least=len(times_s))
