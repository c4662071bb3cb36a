"""Servo lines at the end of pseudo-terminals, and a service for them: the common part of the servos' tests."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from math import nan
from pathlib import Path
from typing import TypeVar

from cocoro import topics
from cocoro.clock import RealClock
from cocoro.joints import GROUPS
from cocoro.messages import Latch, ServoCommand, ServoState
from cocoro.robot import Robot
from cocoro.servo_units import UNITS, Protocol
from cocoro.testing import ServiceUnderTest
from cocoro.topics import Topic
from services.servos.bus import ServoBus
from services.servos.families import FAMILIES
from sim.wire.emulator import Emulator, SimplePlant
from sim.wire.models import model_of, servo_of, servos_on_lines
from sim.wire.servo import EmulatedServo, EmulatedServoBus

T = TypeVar("T")

MS = 1_000_000
LONG_S = 30.0
REPLY_S = 0.2
"""Time limit for answers on a busy machine."""
WHEEL = {"dynamixel": {"low_limit": 0, "high_limit": 0}, "feetech": {"mode": 1}}
"""By protocol, the registers with which a servo turns endlessly."""
STATE: dict[str, Topic[ServoState]] = {"arm": topics.ARM_STATE, "hand": topics.HAND_STATE}
COMMAND: dict[str, Topic[ServoCommand]] = {"arm": topics.ARM_COMMAND, "hand": topics.HAND_COMMAND}


class ServoBench:
    """The emulated lines of a robot, the Calliope by default, with servos of one family, and a plant without physics; a
    context manager."""

    def __init__(
        self,
        folder: Path,
        seed: int = 0,
        overload_s: float = 5.0,
        protocol: Protocol = "dynamixel",
        robot: Robot | None = None,
    ) -> None:
        self.family, self.units = FAMILIES[protocol], UNITS[protocol]
        self.robot = (robot or Robot.load()).with_networks(protocol=protocol)
        self.buses = {
            line: EmulatedServoBus(servo_of(model_of(joint.group, protocol), joint.id, overload_s) for joint in joints)
            for line, (protocol, joints) in servos_on_lines(self.robot).items()
        }
        self.body = SimplePlant(None, *self.buses.values())
        self.emulator = Emulator(folder, self.buses, self.body, seed)
        self.folder = folder

    def __enter__(self) -> ServoBench:
        self.emulator.__enter__()
        return self

    def __exit__(self, *_: object) -> None:
        self.emulator.__exit__(None, None, None)

    def port(self, name: str) -> str:
        return str(self.folder / name)

    def servo(self, number: int) -> EmulatedServo:
        return next(servo for bus in self.buses.values() for servo in bus.servos if servo.number == number)

    def bus(self, name: str = "arm", reply_s: float = REPLY_S, baud: int = 1_000_000, tries: int = 1) -> ServoBus:
        """A driver of a line."""
        return ServoBus(self.port(name), baud, reply_s, self.family, tries)

    def put(self, number: int, **registers: int) -> None:
        """Set registers of a servo between two packets."""

        def put() -> None:
            for name, value in registers.items():
                self.servo(number).put(self.at(name), value)

        self.emulator.call(put)

    def at(self, register: str) -> int:
        """The address of a register."""
        return self.family.registers[register].address

    def get(self, number: int, register: str) -> int:
        return self.servo(number).get(self.at(register))

    def count(self, joint: str, angle_rad: float) -> int:
        return self.robot.joints[joint].to_count(angle_rad)

    def tireless(self, number: int) -> None:
        """Let a servo push for ever."""
        self.servo(number).overload_s = 1000.0
        if "overload_torque" in self.family.registers:
            self.put(number, overload_torque=254)

    def call(self, job: Callable[[], T]) -> T:
        return self.emulator.call(job)

    async def until(self, condition: Callable[[], object]) -> int:
        """Wait until the condition holds; returns when, CLOCK_MONOTONIC."""
        return await asyncio.to_thread(self.emulator.until, condition)


class Moved:
    """The service under test, and the operations on an arm."""

    def __init__(self, bench: ServoBench, service: ServiceUnderTest) -> None:
        self.bench = bench
        self.service = service
        self.commanded_ns = 0
        self._moving: dict[str, asyncio.Task[None]] = {}

    def release(self) -> None:
        self.service.feed(topics.LATCH, Latch(state="released"))

    def move(self, network: str, **goals: float) -> None:
        """Move towards these goals at 1 rad/s, commanded at 50 Hz from now on."""
        self.silence(network)
        self._moving[network] = asyncio.ensure_future(self._move(network, goals))

    def silence(self, network: str = "") -> None:
        for name in [network] if network else list(self._moving):
            if name in self._moving:
                self._moving.pop(name).cancel()

    async def _move(self, network: str, goals: dict[str, float]) -> None:
        async for _ in self.service.tester.every(50.0):
            self.commanded_ns = time.monotonic_ns()
            command = ServoCommand(joints=tuple(goals), goal_rad=tuple(goals.values()), speed_radps=(1.0,) * len(goals))
            self.service.feed(COMMAND[network], command)

    async def state(self, network: str, good: Callable[[ServoState], object]) -> ServoState:
        """The next state for which the condition holds."""
        async with asyncio.timeout(LONG_S):
            async for state in self.service.tester.stream(STATE[network]):
                if good(state):
                    return state
        raise AssertionError("the stream ended")

    async def fault(self, network: str, text: str) -> None:
        async with asyncio.timeout(LONG_S):
            async for health in self.service.tester.stream(topics.HEALTH.of(network)):
                if any(text in fault for fault in health.faults):
                    return

    async def without(self, network: str, text: str) -> None:
        """Wait until no fault has this text. On a busy machine other faults may come and go."""
        async with asyncio.timeout(LONG_S):
            async for health in self.service.tester.stream(topics.HEALTH.of(network)):
                if not any(text in fault for fault in health.faults):
                    return

    async def healthy(self, network: str) -> None:
        async with asyncio.timeout(LONG_S):
            async for health in self.service.tester.stream(topics.HEALTH.of(network)):
                if not health.faults and health.state == "ready":
                    return


def angle(state: ServoState, joint: str) -> float:
    """Not a number while its servo is silent, as on a busy machine it is at times."""
    return state.position_rad[state.joints.index(joint)] if joint in state.joints else nan


@asynccontextmanager
async def inspected(bench: ServoBench, **config: object) -> AsyncIterator[Moved]:
    """The servo service on all lines, all servos read, the emergency stop released."""
    settings = {"ports": {line: bench.port(line) for line in bench.robot.networks}, "reply_s": REPLY_S} | config
    async with ServiceUnderTest("services.servos.service", settings, robot=bench.robot, clock=RealClock()) as service:
        servos = Moved(bench, service)
        for group in GROUPS:
            joints = bench.robot.group_joints(group)
            await servos.state(group, lambda state, joints=joints: state.joints == joints)  # type: ignore[misc]
        servos.release()
        yield servos
        servos.silence()


@asynccontextmanager
async def moved(bench: ServoBench, **config: object) -> AsyncIterator[Moved]:
    """The same, and all servos hold."""
    async with inspected(bench, **config) as servos:
        for group in GROUPS:
            await servos.state(group, lambda state: state.torque_enabled and all(state.torque_enabled))
        yield servos
