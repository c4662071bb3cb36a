"""Measures the CPU time of the hardware services on emulated wires: `python -m bench.servos`.

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

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import RealClock
from cocoro.messages import BaseCommand, BaseState, Latch, ServoCommand, ServoState
from cocoro.node import Node
from cocoro.robot import Robot
from services.base.service import BaseConfig
from services.base.service import run as run_base
from services.servos.service import NetworkService, ServosConfig

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

    def result(self) -> str:
        wall_s = time.perf_counter() - self._wall_s
        share = (self._used_s() - self._cpu_s) / wall_s
        ages_ms = sorted(1e3 * age for age in self.ages_s)
        median, p99 = ages_ms[len(ages_ms) // 2], ages_ms[int(0.99 * len(ages_ms))]
        return f"{self.count / wall_s:5.1f} Hz, {100 * share:4.1f}% of a core, age {median:.1f} ms (p99 {p99:.1f} ms)"

    def _used_s(self) -> float:
        return sum(sum(process.cpu_times()[:2]) for process in self._processes)


async def measure_arm(folder: Path, seconds: float) -> str:
    """Six servos on one line, each commanded and reported at 50 Hz."""
    robot, mesh, clock = Robot.load(), LocalMesh(), RealClock()
    joints = robot.network_joints("arm")
    async with Node("arm", mesh.join(), clock, robot) as node, Node("other", mesh.join(), clock, robot) as other:
        service = NetworkService(node, ServosConfig(arm_port=str(folder / "arm"), reply_s=REPLY_S))
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
        result = meter.result()
        work.cancel()
        await asyncio.gather(work, return_exceptions=True)
    return result


async def measure_base(folder: Path, seconds: float) -> str:
    """A driving base with the guard's process, reported at the Create's rate."""
    robot, mesh, clock = Robot.load(), LocalMesh(), RealClock()
    async with Node("base", mesh.join(), clock, robot) as node, Node("other", mesh.join(), clock, robot) as other:
        node.spawn(run_base(node, BaseConfig(port=str(folder / "create"))))
        other.publish(topics.LATCH, Latch(state="released"))
        meter: Meter | None = None
        states = other.inbox(topics.BASE_STATE)
        started_s = time.perf_counter()
        async for _ in other.every(50.0):
            other.publish(topics.BASE_COMMAND, BaseCommand(left_mps=0.1, right_mps=0.12))
            if meter is None and time.perf_counter() - started_s > 1.0:
                meter = Meter([child for child in psutil.Process().children() if "guard" in " ".join(child.cmdline())])
                states.add(lambda _key, message, meter=meter: meter.take(message))  # type: ignore[misc]
            if time.perf_counter() - started_s > seconds + 1.0:
                break
        assert meter is not None
        try:
            return meter.result()
        except psutil.NoSuchProcess:
            return "not measured: the guard was replaced meanwhile, this machine is too busy"


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m bench.servos", description=__doc__)
    parser.add_argument("--seconds", type=float, default=10.0)
    seconds = parser.parse_args().seconds
    with tempfile.TemporaryDirectory(prefix="cocoro") as name:
        folder = Path(name)
        with subprocess.Popen([sys.executable, "-m", "sim.wire", name], stdout=subprocess.PIPE) as emulated:
            assert emulated.stdout is not None
            for _ in range(3):
                emulated.stdout.readline()
            try:
                print(f"arm, 6 servos  {asyncio.run(measure_arm(folder, seconds))}")
                print(f"base, guard    {asyncio.run(measure_base(folder, seconds))}")
            finally:
                emulated.terminate()


if __name__ == "__main__":
    main()
