"""Counts how often patience ends although all services live: `python -m bench alarms [--count 3] [--others 2]`.

A robot (profile `sim`, real sensors, processes in real time) fetches and follows. Nothing is killed. Counted is how
often it is slowed or stopped by a service's patience. Each task must be done.
"""

from __future__ import annotations

import argparse
import asyncio
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from bench.fault_robot import STANDING_MPS
from bench.faults_live import robot_up
from bench.live import operator
from bench.report import Report, Table
from bench.trials import Runs, number_of, sized
from cocoro.messages import TaskRequest
from services.executive.tasks import FetchTask, FollowTask
from sim.motion import MotionRow


@dataclass
class Alarms:
    """The number of times that a service's patience ended although all services lived."""

    task: str
    seconds: float
    driven: float
    """Time in which the wheels turned."""
    base: int
    """Number of times that the base's deadman stopped turning wheels."""
    deepest: float
    """Greatest share of its speed that the robot lost by that."""
    stood: int
    """Number of times that it stood because of that."""
    slower: int
    """Number of times that the planner slowed down because of a late service."""
    halted: Counter[str]
    """Number of times that it commanded zero because of a silent service, by its stated reason."""
    outcome: str = ""

    def line(self) -> str:
        halts = ", ".join(f"{count} x {why!r}" for why, count in self.halted.items()) or "none"
        return (
            f"{self.task:12s} {self.outcome:9s} {self.seconds:5.1f} s, {self.driven:5.1f} s of it driving:"
            f" deadman {self.base} (deepest {self.deepest:.0%}, stood {self.stood}),"
            f" planner slower {self.slower}, halts {halts}"
        )


def _deadman(rows: Sequence[MotionRow]) -> tuple[int, float, int]:
    """Number of events, the greatest share of speed lost, and the number that ended in standing."""
    events, deepest, stood = 0, 0.0, 0
    began_mps: float | None = None
    for row in rows:
        if row.no_command and began_mps is None and row.asked_mps > STANDING_MPS:
            events, began_mps = events + 1, row.asked_mps
        elif not row.no_command and began_mps is not None:
            began_mps = None
        if began_mps is not None and row.no_command:
            deepest = max(deepest, 1.0 - row.asked_mps / began_mps)
            if row.asked_mps == 0.0:
                stood, began_mps = stood + 1, None
    return events, deepest, stood


def _events(whys: Sequence[str], start: str) -> Iterator[str]:
    before = ""
    for why in whys:
        if why.startswith(start) and not before.startswith(start):
            yield why
        before = why


async def _alarms(scene: str, question: TaskRequest, *settings: str) -> Alarms:
    with operator() as cocoro, tempfile.TemporaryDirectory(prefix="faults") as name:
        async with robot_up(cocoro, "sim", scene, Path(name), *settings) as robot:
            task_id = await robot.begin(question)
            robot.read()
            first, said = len(robot.rows), len(robot.whys)
            state = await robot.ended(task_id)
            robot.read()
        rows, whys = robot.rows[first:], robot.whys[said:]
    events, deepest, stood = _deadman(rows)
    steps = 1.0 / 240
    return Alarms(
        f"{question.task.name} {scene}", state.elapsed_s, steps * sum(row.asked_mps > STANDING_MPS for row in rows),
        events, deepest, stood, sum(1 for _ in _events(whys, "slower, for")),
        Counter(_events(whys, "standing still:")), state.outcome or "",
    )  # fmt: skip


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Processes that load the machine meanwhile."""
    with ExitStack() as stack:
        for _ in range(processes):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(process.kill)
        yield


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="fetches and pursuits (3)")
    parser.add_argument("--others", type=int, default=0, help="so many processes keep the cores busy")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="of the profile")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    runs, met = Runs(report), list[Alarms]()
    tasks = (
        ("paper", TaskRequest(task=FetchTask(label="red_can"))),
        ("follow-fast", TaskRequest(task=FollowTask(label="blue_ball", for_s=24.0))),
    )
    with busy(chosen.others):
        for _ in range(sized(chosen, chosen.count, 3, 1)):
            for scene, question in tasks[:1] if chosen.short else tasks:
                met.append(asyncio.run(_alarms(scene, question, *chosen.set)))
                runs.add(met[-1].outcome == "done", met[-1].line())
    runs.share("tasks done")
    report.value("driving in a task", [one.driven for one in met], "s")
    report.value("the base's deadman stopped turning wheels, in a task", [one.base for one in met], "times")
    report.value("it stood because of that", [one.stood for one in met], "times")
    report.value("greatest share of its speed lost by that", [100.0 * max(one.deepest for one in met)], "%")
    report.value("the planner slowed down for a late service", [one.slower for one in met], "times")
    report.value("the planner stood for a silent service", [one.halted.total() for one in met], "times")
    report.tables.append(Table("Each task", ["what"], [[one.line()] for one in met]))
