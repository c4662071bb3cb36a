"""Fetches on a machine that is short of processor time: `python -m bench.starved [--count 20] [--busy 3]`.

Each trial starts a robot beside busy loops, fetches the red can and ends the robot. Nothing dies, so no output and no
log may say that something died or is silent; the command's exit code and outcome must be the executive's, and by the
simulator's true state the can is held exactly if it is done. Real time: results depend on the machine. Exit code 1 when
one was not so.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import re
import subprocess
import sys
import time
from collections import Counter
from contextlib import suppress
from typing import Any, NamedTuple

from bench.ended import leave_when_ended
from bench.faults_live import busy
from bench.live import NAME, Operator, operator
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
    judge = Judge(find_scene("paper", 0, "red_can"), "red_can")
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


def trial(number: int, loops: int, options: list[str]) -> bool:
    with operator() as cocoro, busy(loops):
        up, said_up, took_up = cocoro("up", "sim", "--detach", *options)
        if up:
            print(f"FAIL {number:3d}  not up after {took_up:.0f} s:\n{said_up}")
            return False
        pids = {service: by.pid for service, by in cocoro.run_dir.claims().items()}
        done, said = asyncio.run(_fetch(cocoro))
        lived = {service: by.pid for service, by in cocoro.run_dir.claims().items()} == pids
        false = sorted({line for line in (said_up + said + _logs(cocoro)).splitlines() if FALSE.search(line)})
    wrong = [*done.wrong, *(f"said: {line}" for line in false), *([] if lived else ["a process ended"])]
    outcome = f"{done.result.get('outcome')} {done.result.get('reason', '')}".strip()
    late = ", ".join(f"{count} x {text!r}" for text, count in done.pauses.most_common())
    print(
        f"{'FAIL' if wrong else 'ok  '} {number:3d}  up {took_up:.1f} s, {outcome} after {done.seconds:.1f} s"
        f" ({float(done.result.get('elapsed_s', 0)):.1f} s of the robot's); {late or 'nobody late'}"
    )
    for line in (*wrong, *([said] if wrong else []), *filter(None, [str(done.result.get("machine", ""))])):
        print(f"     {line}")
    sys.stdout.flush()
    return not wrong


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--busy", type=int, default=3, help="busy loops beside the robot")
    parser.add_argument("--sensors", choices=["ideal", "real"], default="real")
    parser.add_argument("--frames", default="640x480@30")
    asked = parser.parse_args()
    leave_when_ended()
    options = ["--sensors", asked.sensors, "--frames", asked.frames]
    try:
        good = sum(trial(number + 1, asked.busy, options) for number in range(asked.count))
    except subprocess.TimeoutExpired as error:
        print(f"a command did not end: {error}")
        return 1
    print(f"{good} of {asked.count}")
    return 0 if good == asked.count else 1


if __name__ == "__main__":
    sys.exit(main())
