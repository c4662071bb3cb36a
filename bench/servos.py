"""Measures the CPU time of the hardware services on emulated wires: `python -m bench servos`.

The emulated hardware is a separate process. The figures contain everything in the services' processes: messages (on a
local bus), the threads of the lines, and the guard of the base's port.
"""

from __future__ import annotations

import argparse
import asyncio
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import psutil

from bench.report import Report, percentile
from bench.trials import sized
from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import RealClock
from cocoro.errors import CocoroError
from cocoro.messages import BaseCommand, BaseState, Latch, ServoCommand, ServoState
from cocoro.node import Node
from cocoro.robot import Robot
from services.base.service import BaseConfig
from services.base.service import run as run_base
from services.servos.service import LineService, ServosConfig

REPLY_S = 0.1


class Meter:
    """Share of one core used by this process and its children, and the rates of the messages."""

    def __init__(self, children: Sequence[psutil.Process] = ()) -> None:
        self._processes = [psutil.Process(), *children]
        self._cpu_s = self._used_s()
        self._wall_s = time.perf_counter()
        self.count = 0
        self.ages_s: list[float] = []

    def take(self, message: ServoState | BaseState) -> None:
        self.count += 1
        self.ages_s.append((time.time_ns() - message.stamp_ns) / 1e9)

    def tell(self, report: Report, name: str) -> None:
        """The figures since it was made. Raises psutil.NoSuchProcess when a child has ended."""
        wall_s = time.perf_counter() - self._wall_s
        share = (self._used_s() - self._cpu_s) / wall_s
        ages_ms = [1e3 * age for age in self.ages_s]
        report.value(f"{name}: share of a core", [100.0 * share], "%")
        report.value(f"{name}: rate of states", [self.count / wall_s], "Hz")
        report.value(f"{name}: age of a state at its arrival", ages_ms, "ms")
        report.value(f"{name}: age of a state, 99%", [percentile(ages_ms, 99)], "ms")

    def _used_s(self) -> float:
        return sum(sum(process.cpu_times()[:2]) for process in self._processes)


async def measure_arm(folder: Path, seconds: float, report: Report) -> None:
    """Six servos on one line, each commanded and reported at 50 Hz."""
    robot, mesh, clock = Robot.load(), LocalMesh(), RealClock()
    joints = robot.group_joints("arm")
    async with Node("arm", mesh.join(), clock, robot) as node, Node("other", mesh.join(), clock, robot) as other:
        service = LineService("arm", {"arm": node}, ServosConfig(port=str(folder / "{line}"), reply_s=REPLY_S))
        work = asyncio.ensure_future(service.run())
        other.publish(topics.LATCH, Latch(state="released"))
        goal_rad = 0.3
        meter: Meter | None = None
        started_s = time.perf_counter()
        states = other.inbox(topics.ARM_STATE)
        async for _ in other.every(50.0):
            goal_rad = -goal_rad if int(time.perf_counter()) % 2 else goal_rad
            command = ServoCommand(joints=joints, goal_rad=(goal_rad,) * len(joints), speed_radps=(0.5,) * len(joints))
            other.publish(topics.ARM_COMMAND, command)
            if meter is None and time.perf_counter() - started_s > 1.0:
                meter = Meter()
                states.add(lambda _key, message, meter=meter: meter.take(message))  # type: ignore[misc]
            if time.perf_counter() - started_s > seconds + 1.0:
                break
        assert meter is not None
        meter.tell(report, "arm, 6 servos")
        work.cancel()
        await asyncio.gather(work, return_exceptions=True)


async def measure_base(folder: Path, seconds: float, report: Report) -> None:
    """A driving base with the guard's process, reported at the Create's rate."""
    robot, mesh, clock = Robot.load(), LocalMesh(), RealClock()
    async with Node("base", mesh.join(), clock, robot) as node, Node("other", mesh.join(), clock, robot) as other:
        node.spawn(run_base(node, BaseConfig(port=str(folder / "create"))))
        other.publish(topics.LATCH, Latch(state="released"))
        meter: Meter | None = None
        states = other.inbox(topics.BASE_STATE)
        started_s = time.perf_counter()
        async for _ in other.every(50.0):
            other.publish(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.11, turn_radps=0.08))
            if meter is None and time.perf_counter() - started_s > 1.0:
                meter = Meter([child for child in psutil.Process().children() if "guard" in " ".join(child.cmdline())])
                states.add(lambda _key, message, meter=meter: meter.take(message))  # type: ignore[misc]
            if time.perf_counter() - started_s > seconds + 1.0:
                break
        assert meter is not None
        try:
            meter.tell(report, "base, with its guard")
        except psutil.NoSuchProcess:
            raise CocoroError("base: the guard was replaced meanwhile: this machine is too busy") from None


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=float, help="of arm and base each (10)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    seconds = sized(chosen, chosen.seconds, 10.0, 2.0)
    with tempfile.TemporaryDirectory(prefix="cocoro") as name:
        folder = Path(name)
        with subprocess.Popen([sys.executable, "-m", "sim.wire", name], stdout=subprocess.PIPE) as emulated:
            assert emulated.stdout is not None
            for _ in range(3):
                emulated.stdout.readline()
            try:
                asyncio.run(measure_arm(folder, seconds, report))
                asyncio.run(measure_base(folder, seconds, report))
            finally:
                emulated.terminate()
