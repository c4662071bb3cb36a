"""Measures the live robot, with processes on zenoh in real time: its start, a fetch, and its end.

Starts the robot, fetches the red can and shuts down, repeatedly. Nothing may fail or be left over, and the true state
must have the can in the hand and nothing else touched. With `--profile sim-wire` the real services of base and servos
drive it over emulated wires. Times depend on the machine's load.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from bench.report import Report
from bench.trials import Runs, number_of, sized
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import FollowedClock
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
        self.captures = root / "captures"
        self.environment = os.environ | {"COCORO_RUN_DIR": str(root), "COCORO_CAPTURE_DIR": str(self.captures)}
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


class Fetched(NamedTuple):
    code: int
    said: str
    seconds: float
    """By the machine's clock, from the command's start to its end."""
    truth: Verdict

    @property
    def last_line(self) -> str:
        """The result as the command said it."""
        return (self.said.partition("\nrecorded in ")[0].strip().splitlines() or ["it said nothing"])[-1]

    @property
    def well(self) -> bool:
        """It said done, the can is held, and nothing else was touched."""
        return self.code == 0 and self.truth.held and not self.truth.knocked_over and not self.truth.collisions

    @property
    def task_s(self) -> float | None:
        """Time of the task by the robot's clock, as the command said it; None where it did not."""
        took = re.search(r" in ([0-9.]+) s", self.last_line)
        return float(took[1]) if took else None


async def _fetch(cocoro: Operator) -> Fetched:
    """One fetch, judged a while after its end, so that a slipping can counts as lost."""
    judge = Judge(Robot.load(), find_scene("paper", 0, "red_can"), "red_can")
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


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="fetches, each with a robot that is started for it (3)")
    parser.add_argument("--profile", choices=["sim", "sim-wire"], default="sim")
    parser.add_argument("--sensors", choices=["ideal", "real"], default="ideal")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    runs = Runs(report)
    took: dict[str, list[float]] = {"start": [], "command": [], "task": [], "end": []}
    for number in range(1, sized(chosen, chosen.count, 3, 1) + 1):
        with operator() as cocoro:
            up, said_up, up_s = cocoro("up", chosen.profile, "--detach", "--sensors", chosen.sensors)
            fetched = asyncio.run(_fetch(cocoro)) if up == 0 else None
            down, said_down, down_s = cocoro("down")
            left = sorted(cocoro.run_dir.claims())
        if fetched is None:
            runs.add(False, f"{number}: it did not start", [said_up])
            continue
        truth = fetched.truth
        well = fetched.well and down == 0 and not left
        line = f"{number}: up {up_s:.1f} s  {fetched.last_line}  down {down_s:.1f} s"
        runs.add(well, line, [said_up, fetched.said, said_down, f"left: {left}", str(truth)])
        took["start"].append(up_s)
        took["end"].append(down_s)
        if fetched.task_s is not None:
            took["command"].append(fetched.seconds)
            took["task"].append(fetched.task_s)
    runs.share("fetched, nothing else touched, nothing left over")
    for name, words in (
        ("start", "start, until everything is ready"),
        ("command", "`cocoro fetch red_can`, from its start to its end"),
        ("task", "the task, by the robot's clock"),
        ("end", "end, until nothing runs"),
    ):
        if took[name]:
            report.value(words, took[name], "s")
    if took["task"]:
        report.ratio("a fetch: the command / the task", took["command"], took["task"], better="less")
