"""Fetches on a machine that is short of processor time: `python -m bench starved [--count 20] [--busy 3]`.

Each trial starts a robot beside busy loops, fetches the red can and ends the robot. Nothing dies, so no output and no
log may say that something died or is silent; the command's exit code and outcome must be the executive's, and by the
simulator's true state the can is held exactly if it is done. Real time: results depend on the machine.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import time
from collections import Counter
from contextlib import suppress
from typing import Any, NamedTuple

from bench.alarms import busy
from bench.live import NAME, Operator, operator
from bench.report import Report
from bench.trials import Runs, number_of, sized
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import FollowedClock
from cocoro.errors import CocoroError
from cocoro.messages import PlannerStatus, ReportRequest, TaskState
from cocoro.node import Node
from cocoro.robot import Robot
from sim.judge import HELD_S, Judge, Verdict
from sim.random_scene import find_scene

FALSE = re.compile(r"\bdied\b|\bis silent\b|\bnot alive\b|no longer knows")
"""What nobody may say while all processes live."""
PAUSED = re.compile(r"nothing from|lost contact|slower, for|waiting:")
"""What is said of lateness; it is counted."""
CODES = {"done": 0, "failed": 1, "unknown": 1, "cancelled": 3}


class Trial(NamedTuple):
    code: int
    result: dict[str, Any]
    seconds: float
    truth: Verdict
    report: TaskState | None
    """What the executive says of the task afterwards."""
    pauses: Counter[str]
    """How often the planner stood or went slower for somebody who was late."""

    @property
    def wrong(self) -> list[str]:
        """The statements of the command's result that are not true."""
        outcome = str(self.result.get("outcome"))
        found = []
        if self.code != CODES.get(outcome, 2):
            found.append(f"outcome {outcome} with exit code {self.code}")
        if self.report is not None and self.report.outcome != outcome:
            found.append(f"the command says {outcome}, the executive {self.report.outcome}")
        if (outcome == "done") != self.truth.held:
            found.append(f"outcome {outcome}, but the can is {'held' if self.truth.held else 'not held'}")
        return found


async def _fetch(cocoro: Operator) -> tuple[Trial, str]:
    judge = Judge(Robot.load(), find_scene("paper", 0, "red_can"), "red_can")
    pauses: Counter[str] = Counter()
    before = ""

    def on_plan(status: PlannerStatus) -> None:
        nonlocal before
        found = PAUSED.search(status.why)
        said = re.sub(r"[\d.]+ s.*|;.*", "", status.why) if found else ""
        if said and said != before:
            pauses[said.strip()] += 1
        before = said

    async with (
        await ZenohBus.open(cocoro.run_dir.join_as("bench")) as bus,
        Node("bench", bus, FollowedClock(), Robot.load(), robot_name=NAME) as node,
    ):
        node.on(topics.TRUTH, judge.feed)
        node.on(topics.PLAN, on_plan)
        begun_s = time.monotonic()
        process = cocoro.start("fetch", "red_can", "--json")
        said, _ = await asyncio.to_thread(process.communicate)
        seconds = time.monotonic() - begun_s
        await node.sleep(HELD_S + 0.5)
        result: dict[str, Any] = {}
        for line in said.splitlines():
            with suppress(ValueError):
                result = json.loads(line) if line.startswith("{") else result
        report = None
        with suppress(CocoroError):
            report = await node.call(topics.REPORT, ReportRequest(task_id=str(result.get("task_id", ""))), 10.0)
    return Trial(process.returncode, result, seconds, judge.result(), report, pauses), said


def _logs(cocoro: Operator) -> str:
    return "".join(file.read_text(errors="replace") for file in sorted(cocoro.run_dir.logs.glob("*.log*")))


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="fetches, each with a robot that is started for it (20)")
    parser.add_argument("--busy", type=int, default=3, help="busy loops beside the robot")
    parser.add_argument("--sensors", choices=["ideal", "real"], default="real")
    parser.add_argument("--frames", default="640x480@30", metavar="WxH@HZ")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    runs = Runs(report)
    up_s: list[float] = []
    trials: list[Trial] = []
    for number in range(1, sized(chosen, chosen.count, 20, 1) + 1):
        with operator() as cocoro, busy(chosen.busy):
            code, said_up, seconds = cocoro(
                "up", "sim", "--detach", "--sensors", chosen.sensors, "--frames", chosen.frames
            )
            if code:
                runs.add(False, f"{number}: not up after {seconds:.0f} s", [said_up])
                continue
            up_s.append(seconds)
            pids = {service: by.pid for service, by in cocoro.run_dir.claims().items()}
            done, said = asyncio.run(_fetch(cocoro))
            lived = {service: by.pid for service, by in cocoro.run_dir.claims().items()} == pids
            false = sorted({line for line in (said_up + said + _logs(cocoro)).splitlines() if FALSE.search(line)})
        trials.append(done)
        wrong = [*done.wrong, *(f"said: {line}" for line in false), *([] if lived else ["a process ended"])]
        runs.add(not wrong, f"{number}: {_line(done)}", [*wrong, said])
    runs.share("nobody said what was not true")
    if trials:
        report.share("done", sum(one.result.get("outcome") == "done" for one in trials), len(trials))
        report.value("start", up_s, "s")
        report.value("fetch, by the machine's clock", [one.seconds for one in trials], "s")


def _line(done: Trial) -> str:
    outcome = f"{done.result.get('outcome')} {done.result.get('reason', '')}".strip()
    late = ", ".join(f"{count} x {text!r}" for text, count in done.pauses.most_common())
    elapsed_s = float(done.result.get("elapsed_s", 0))
    machine = f"; {done.result['machine']}" if done.result.get("machine") else ""
    return f"{outcome} after {done.seconds:.1f} s ({elapsed_s:.1f} s of the robot's); {late or 'nobody late'}{machine}"
