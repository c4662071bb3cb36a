"""The live robot, with processes on zenoh in real time: `python -m bench.live fetches|periods`.

`fetches`: start the robot, fetch the red can and shut down, repeatedly. Nothing may fail or be left over, and the true
state must have the can in the hand and nothing else touched. With `--profile sim-wire` the real services of base and
servos drive it over emulated wires.
`periods`: how evenly wheels and servos are commanded during a fetch, with perception slowed to 2 Hz.

Times depend on the machine's load. Exit code 1 when something failed.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

from bench.ended import leave_when_ended
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import NS, FollowedClock
from cocoro.node import Node
from cocoro.robot import Robot
from deploy.rundir import RunDir
from sim.judge import HELD_S, Judge, Verdict
from sim.random_scene import find_scene

NAME = f"bench-{os.getpid()}"
"""Robots of benches have a name of their own: `cocoro stop --robot calliope` is for others, and theirs for them."""


class Operator:
    """`cocoro` with a separate run directory; its `up` starts the robot NAME."""

    def __init__(self, root: Path) -> None:
        self.run_dir = RunDir(NAME, root)
        self.environment = os.environ | {"COCORO_RUN_DIR": str(root), "COCORO_CAPTURE_DIR": str(root / "captures")}
        self.environment |= {"COCORO_STATE_DIR": str(root / "state")}

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        named = ("--set", f'robot="{NAME}"') if arguments[0] == "up" else ()
        command = [sys.executable, "-m", "apps.cli.main", *arguments, *named]
        return subprocess.Popen(
            command, env=self.environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
        )

    def __call__(self, *arguments: str) -> tuple[int, str, float]:
        """Exit code, what was printed, and seconds."""
        begun_s = time.monotonic()
        with self.start(*arguments) as process:
            said = process.communicate(timeout=300.0)[0]
        return process.returncode, said, time.monotonic() - begun_s


@contextmanager
def operator() -> Iterator[Operator]:
    root = Path(tempfile.mkdtemp(prefix="cocoro"))  # short: sockets live there
    work = Operator(root)
    try:
        yield work
    finally:
        work("down")
        shutil.rmtree(root, ignore_errors=True)


def _spread(values: list[float], unit: str) -> str:
    ordered = sorted(values)
    p99 = ordered[min(len(ordered) - 1, int(0.99 * len(ordered)))]
    return f"median {statistics.median(ordered):.2f} {unit}, p99 {p99:.2f}, longest {ordered[-1]:.2f}"


# --- fetches --------------------------------------------------------------------------------------


class Fetched(NamedTuple):
    code: int
    said: str
    seconds: float
    truth: Verdict


async def _fetch(cocoro: Operator) -> Fetched:
    """One fetch, judged a while after its end, so that a slipping can counts as lost."""
    judge = Judge(find_scene("paper", 0, "red_can"), "red_can")
    async with (
        await ZenohBus.open(cocoro.run_dir.join_as("bench")) as bus,
        Node("bench", bus, FollowedClock(), Robot.load(), robot_name=NAME) as node,
    ):
        node.on(topics.TRUTH, judge.feed)
        begun_s = time.monotonic()
        process = cocoro.start("fetch", "red_can")
        said, _ = await asyncio.to_thread(process.communicate)
        seconds = time.monotonic() - begun_s
        await asyncio.sleep(HELD_S + 0.5)
    return Fetched(process.returncode, said, seconds, judge.result())


def fetches(count: int, profile: str, sensors: str) -> bool:
    took: dict[str, list[float]] = {"up": [], "fetch": [], "down": []}
    good = 0
    for number in range(count):
        with operator() as cocoro:
            up, said_up, took_up = cocoro("up", profile, "--detach", "--sensors", sensors)
            fetched = asyncio.run(_fetch(cocoro)) if up == 0 else None
            down, said_down, took_down = cocoro("down")
            left = sorted(cocoro.run_dir.claims())
        code, said_fetch, took_fetch, truth = fetched or (1, "", 0.0, None)
        well = (up, code, down) == (0, 0, 0) and not left
        well = well and truth is not None and truth.held and not truth.knocked_over and not truth.collisions
        good += well
        for name, seconds in zip(took, (took_up, took_fetch, took_down), strict=True):
            took[name].append(seconds)
        last = said_fetch.partition("\nrecorded in ")[0].strip().splitlines()[-1] if said_fetch.strip() else "no fetch"
        print(f"{'ok  ' if well else 'FAIL'} {number + 1:3d}  up {took_up:.1f} s  {last}  down {took_down:.1f} s")
        if not well:
            print(said_up, said_fetch, said_down, f"left: {left}", truth, sep="\n")
        sys.stdout.flush()
    print(f"{good} of {count}; " + "; ".join(f"{name}: {_spread(values, 's')}" for name, values in took.items()))
    return good == count


# --- periods --------------------------------------------------------------------------------------


async def _commands(cocoro: Operator) -> dict[str, list[int]]:
    """The stamps of commands and detections during a fetch."""
    stamps: dict[str, list[int]] = {}
    async with (
        await ZenohBus.open(cocoro.run_dir.join_as("bench")) as bus,
        Node("bench", bus, FollowedClock(), Robot.load(), robot_name=NAME) as node,
    ):
        for topic in (topics.BASE_COMMAND, topics.ARM_COMMAND, topics.DETECTIONS):
            arrived = stamps.setdefault(topic.name, [])
            node.on(topic, lambda message, arrived=arrived: arrived.append(message.stamp_ns))  # type: ignore[misc]
        process = cocoro.start("fetch", "red_can")
        said, _ = await asyncio.to_thread(process.communicate)
        print(said.partition("\nrecorded in ")[0].strip().splitlines()[-1])
    return stamps


def periods(latency_s: float) -> bool:
    with operator() as cocoro:
        code, said, _ = cocoro("up", "sim", "--detach", "--latency", f"perception={latency_s:g}")
        if code:
            print(said)
            return False
        stamps = asyncio.run(_commands(cocoro))
        _, status, _ = cocoro("status", "--json")
    for name, arrived in stamps.items():
        apart_ms = [(b - a) / 1e6 for a, b in pairwise(arrived)]
        rate_hz = (len(arrived) - 1) / ((arrived[-1] - arrived[0]) / NS)
        print(f"{name:22s} {rate_hz:5.1f} Hz; period by stamp {_spread(apart_ms, 'ms')}")
    print("the planner's own loop:", json.dumps(_loops(json.loads(status), "planning")))
    return True


def _loops(status: Any, service: str) -> Any:
    """The loops of a service, wherever they are in the status."""
    if isinstance(status, dict):
        if status.get("service") == service and status.get("loops"):
            return status["loops"]
        status = list(status.values())
    if isinstance(status, list):
        return next(filter(None, (_loops(value, service) for value in status)), None)
    return None


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=["fetches", "periods"])
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--latency", type=float, default=0.5, metavar="S", help="of perception, for periods")
    parser.add_argument("--profile", choices=["sim", "sim-wire"], default="sim", help="of the fetches")
    parser.add_argument("--sensors", choices=["ideal", "real"], default="ideal")
    arguments = parser.parse_args()
    leave_when_ended()
    if arguments.what == "fetches":
        well = fetches(arguments.count, arguments.profile, arguments.sensors)
    else:
        well = periods(arguments.latency)
    return 0 if well else 1


if __name__ == "__main__":
    sys.exit(main())
