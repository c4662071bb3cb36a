"""Measures how soon a robot that is driven by hand stands when its driver is lost: `python -m bench lost-control`.

A robot of processes (profile `sim`, real sensors) is driven at full speed by a program, or by a page over the cockpit's
WebSocket. At a random moment that is killed or stopped, freezes, or lets go; or the executive or the cockpit is killed
or stopped, or the emergency stop is pressed. The time counts from when the last request was sent whose motion was
accepted, until the body stands for good by the simulator's record of each physics step. It must be at rest within
0.45 s, and a wheel command of zero must come within 0.3 s.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import re
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from bench.fault_robot import STANDING_MPS
from bench.faults_live import LiveRobot, robot_up
from bench.live import NAME, Operator, operator
from bench.lost_control_driver import SENT
from bench.report import Report
from bench.trials import number_of, sized
from cocoro import topics
from cocoro.clock import NS
from cocoro.errors import CocoroError
from cocoro.messages import BaseCommand, EstopRequest, ResetRequest
from deploy.rundir import Target
from services.planning.config import PlanningConfig

REST_S = 0.45
ZERO_S = 0.30
FAST_SHARE = 0.93
"""Share of the full speed at which a trial may begin: real wheels slip a little."""
PATIENCE_S = 40.0
WATCH_S = 1.2
TRIALS = 13
"""Trials with one robot."""
SCENE = """\
name = "lost-control"

[[object]]
label = "red_can"
shape = "cylinder"
radius_m = 0.033
height_m = 0.12
position_m = [0.0, 2.5]
"""


class Driver:
    """The program that drives. `sent` is the file of the times at which it sent what was accepted."""

    def __init__(self, cocoro: Operator, sent: Path, port: int | None) -> None:
        """`port`: of the cockpit, for a page that drives."""
        self._sent = sent
        sent.write_bytes(b"")
        which = ("bench.lost_control_driver", NAME) if port is None else ("bench.lost_control_page", str(port))
        command = [sys.executable, "-m", *which, str(sent)]
        self._process = subprocess.Popen(
            command, env=cocoro.environment, stdin=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )

    def signal(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def say(self, line: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()

    def last_sent_ns(self) -> int:
        """When it sent the last request whose motion was accepted, CLOCK_MONOTONIC; 0 before the first."""
        data = self._sent.read_bytes()
        whole = len(data) // SENT.size * SENT.size
        return int(SENT.unpack_from(data, whole - SENT.size)[0]) if whole else 0

    def end(self) -> str:
        """Kill it; returns the end of what it said."""
        if not self._process.stderr or self._process.stderr.closed:
            return ""
        self._process.kill()
        return self._process.communicate()[1][-300:].replace("\n", " ")


class Trial(NamedTuple):
    what: str
    speed_mps: float
    rest_s: float
    """Simulated time from the last accepted request until the body stood for good."""
    real_s: float
    """The same by the machine's clock."""
    zero_s: float
    """Simulated time until the first wheel command of zero after which no other came."""


def _service(number: signal.Signals, service: str = "executive") -> Callable[[LiveRobot, Driver], None]:
    def send(robot: LiveRobot, driver: Driver) -> None:
        target = Target(robot.cocoro.run_dir.path / "claims" / service)
        target.signal(number)
        target.close()

    return send


def _stop(robot: LiveRobot, driver: Driver) -> None:
    robot.node.spawn(robot.node.call_all(topics.ESTOP.of("*"), EstopRequest(by="bench")))


LOSSES: dict[str, Callable[[LiveRobot, Driver], None]] = {
    "driver killed": lambda robot, driver: driver.signal(signal.SIGKILL),
    "driver stopped": lambda robot, driver: driver.signal(signal.SIGSTOP),
    "driver frozen": lambda robot, driver: driver.say("freeze"),
    "let go": lambda robot, driver: driver.say("let-go"),
    "executive killed": _service(signal.SIGKILL),
    "executive stopped": _service(signal.SIGSTOP),
    "emergency stop": _stop,
    "page killed": lambda robot, driver: driver.signal(signal.SIGKILL),
    "page stopped": lambda robot, driver: driver.signal(signal.SIGSTOP),
    "page frozen": lambda robot, driver: driver.say("freeze"),
    "page lets go": lambda robot, driver: driver.say("let-go"),
    "page, cockpit killed": _service(signal.SIGKILL, "cockpit"),
    "page, cockpit stopped": _service(signal.SIGSTOP, "cockpit"),
}


async def _fast(robot: LiveRobot, driver: Driver, rng: random.Random) -> float:
    """Wait until a random moment at full speed; returns the speed. Raises TimeoutError."""
    full_mps = FAST_SHARE * PlanningConfig().navigation.max_speed_mps
    async with asyncio.timeout(PATIENCE_S):
        while True:
            await asyncio.sleep(0.01)
            if robot.read().speed_mps < full_mps or not driver.last_sent_ns():
                continue
            await asyncio.sleep(rng.uniform(0.0, 0.6))
            if (now := robot.read()).speed_mps >= full_mps:
                return now.speed_mps


async def _trial(robot: LiveRobot, what: str, sent: Path, rng: random.Random) -> Trial:
    """One loss. Raises TimeoutError when the robot never drives fast."""
    commands: list[BaseCommand] = []
    robot.node.on(topics.BASE_COMMAND, commands.append)
    driver = Driver(robot.cocoro, sent, await _port(robot) if what.startswith("page") else None)
    try:
        speed_mps = await _fast(robot, driver, rng)
        LOSSES[what](robot, driver)
        await asyncio.sleep(WATCH_S)
        robot.read()
        last_ns = driver.last_sent_ns()
    except TimeoutError as error:
        raise TimeoutError(driver.end()) from error
    finally:
        driver.end()
        robot.node.drop(topics.BASE_COMMAND)
    since = max(row.sim_ns for row in robot.rows if row.real_ns <= last_ns)
    moving = [row for row in robot.rows if row.sim_ns > since and row.moves_mps >= STANDING_MPS]
    turning = [each.stamp_ns for each in commands if each.ahead_mps or each.turn_radps]
    return Trial(
        what, round(speed_mps, 3), (moving[-1].sim_ns - since) / NS if moving else 0.0,
        (moving[-1].real_ns - last_ns) / NS if moving else 0.0, (max(turning, default=since) - since) / NS,
    )  # fmt: skip


async def _port(robot: LiveRobot) -> int:
    """Where the cockpit's page is."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            for health in await robot.node.newest(topics.HEALTH.of("cockpit"), 1.0):
                if found := re.search(r":(\d+)/", health.text):
                    return int(found[1])
            await asyncio.sleep(0.2)


async def _ready_again(robot: LiveRobot, what: str) -> None:
    """Bring the robot back to where it takes a task."""
    if what == "emergency stop":
        with suppress(CocoroError):
            await robot.node.call_all(topics.RESET.of("*"), ResetRequest(by="bench"))
    if what.startswith("executive") or "cockpit" in what:
        await asyncio.sleep(4.0)  # the supervisor kills what stands still, and starts it anew


async def _robot(numbers: range, chosen: argparse.Namespace, report: Report) -> list[Trial]:
    """Trials with one robot."""
    names = [*LOSSES]
    trials = []
    with operator() as cocoro, tempfile.TemporaryDirectory(prefix="lost") as folder:
        scene = Path(folder) / "scene.toml"
        scene.write_text(SCENE)
        async with robot_up(cocoro, "sim", str(scene), Path(folder), "service.cockpit.port=0") as robot:
            for number in numbers:
                what = names[number % len(names)]
                rng = random.Random(f"lost/{chosen.seed}/{number}")
                try:
                    trial = await _trial(robot, what, Path(folder) / "sent", rng)
                except TimeoutError as error:
                    report.notes.append(f"trial {number}: never at full speed in time, which is no trial: {error}")
                    report.say(report.notes[-1])
                else:
                    trials.append(trial)
                    report.say(
                        f"trial {number}, {what} at {trial.speed_mps:.3f} m/s: at rest after {trial.rest_s:.3f} s"
                        f" ({trial.real_s:.3f} s of the machine's), zero after {trial.zero_s:.3f} s"
                    )
                await _ready_again(robot, what)
    return trials


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help=f"losses, by turns of {len(LOSSES)} kinds (26)")
    parser.add_argument("--seed", type=int, default=0)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    count = sized(chosen, chosen.count, 26, 2)
    trials: list[Trial] = []
    for first in range(0, count, TRIALS):
        trials += asyncio.run(_robot(range(first, min(first + TRIALS, count)), chosen, report))
    if not trials:
        raise CocoroError("no trial came about")
    report.value("time to rest", [trial.rest_s for trial in trials], "s")
    report.value("longest time to rest", [max(trial.rest_s for trial in trials)], "s", at_most=REST_S)
    report.value("longest time to zero", [max(trial.zero_s for trial in trials)], "s", at_most=ZERO_S)
    report.value("longest time by the machine's clock", [max(trial.real_s for trial in trials)], "s")
    good = sum(trial.rest_s <= REST_S for trial in trials)
    report.share(f"at rest within {REST_S:g} s", good, len(trials), at_least=len(trials))
