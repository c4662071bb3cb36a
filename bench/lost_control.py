"""Measures how soon a robot that is driven by hand stands when its driver is lost: `python -m bench lost-control`.

A robot of processes (profile `sim`, real sensors) is driven at full speed by a program, by a program over the cockpit's
WebSocket, or by the cockpit's page in Chromium. At a random moment that is killed or stopped, freezes, or lets go; the
browser's page is closed, crashes, or goes behind another tab; or the executive or the cockpit is killed or stopped, or
the emergency stop is pressed. The time counts from when the last request was sent whose motion was accepted, until the
body stands for good by the simulator's record of each physics step. It must be at rest within 0.45 s, and a wheel
command of zero must come within 0.3 s.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import re
import tempfile
from collections.abc import Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import NamedTuple

from bench.fault_robot import STANDING_MPS
from bench.faults_live import LiveRobot, robot_up
from bench.live import operator
from bench.lost_control_losses import LOSSES, Driver, Drivers, Kind
from bench.report import Report
from bench.trials import number_of, one_of, sized
from cocoro import topics
from cocoro.clock import NS
from cocoro.errors import CocoroError
from cocoro.messages import BaseCommand, ResetRequest
from services.planning.config import PlanningConfig

REST_S = 0.45
ZERO_S = 0.30
FAST_SHARE = 0.93
"""Share of the full speed at which a trial may begin: real wheels slip a little."""
PATIENCE_S = 40.0
WATCH_S = 1.2
LIFE = 100
"""Losses of one robot, before another one is started."""
SCENE = """\
name = "lost-control"

[[object]]
label = "red_can"
shape = "cylinder"
radius_m = 0.033
height_m = 0.12
position_m = [0.0, 2.5]
"""


class Trial(NamedTuple):
    what: str
    speed_mps: float
    rest_s: float
    """Simulated time from the last accepted request until the body stood for good."""
    real_s: float
    """The same by the machine's clock."""
    zero_s: float
    """Simulated time until the first wheel command of zero after which no other came."""


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


async def _trial(robot: LiveRobot, drivers: Drivers, what: str, following: Kind, rng: random.Random) -> Trial:
    """One loss. `following`: the kind of the next driver, which starts meanwhile. Raises TimeoutError when the robot
    never drives fast."""
    commands: list[BaseCommand] = []
    robot.node.on(topics.BASE_COMMAND, commands.append)
    loss, since_row = LOSSES[what], len(robot.rows)
    driver = drivers.take(loss.kind)
    driver.go(0 if loss.kind == "program" else await _port(robot))
    drivers.prepare(following)
    try:
        speed_mps = await _fast(robot, driver, rng)
        loss.happens(robot, driver)
        await asyncio.sleep(WATCH_S)
        robot.read()
        last_ns = driver.last_sent_ns()
    except TimeoutError as error:
        raise TimeoutError(driver.end()) from error
    finally:
        robot.node.drop(topics.BASE_COMMAND)
    drivers.give_back(driver, loss.kind)
    rows = robot.rows[since_row:]
    since = max(row.sim_ns for row in rows if row.real_ns <= last_ns)
    moving = [row for row in rows if row.sim_ns > since and row.moves_mps >= STANDING_MPS]
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
    """Bring the robot back to where it takes a task. What was killed or stopped comes back by itself, and the next
    driver waits for it."""
    if what == "emergency stop":
        with suppress(CocoroError):
            await robot.node.call_all(topics.RESET.of("*"), ResetRequest(by="bench"))


async def _robot(numbers: range, names: Sequence[str], seed: int, report: Report) -> list[Trial]:
    """Trials in one life of a robot."""
    trials = []
    with operator() as cocoro, tempfile.TemporaryDirectory(prefix="lost") as name:
        folder = Path(name)
        scene = folder / "scene.toml"
        scene.write_text(SCENE)
        drivers = Drivers(cocoro, folder)
        async with robot_up(cocoro, "sim", str(scene), folder, "service.cockpit.port=0") as robot:
            with closing(drivers):
                for number in numbers:
                    what, following = (names[each % len(names)] for each in (number, number + 1))
                    rng = random.Random(f"lost/{seed}/{number}")
                    try:
                        trial = await _trial(robot, drivers, what, LOSSES[following].kind, rng)
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
    parser.add_argument("--count", type=number_of, help=f"losses, by turns of the kinds ({2 * len(LOSSES)})")
    parser.add_argument("--first", type=int, default=0, help="number of the first one, to go on with a series (0)")
    parser.add_argument("--of-a-robot", type=number_of, default=LIFE, help=f"losses of one robot ({LIFE})")
    parser.add_argument("--kind", type=one_of(LOSSES), action="append", help="of loss; repeatable (all)")
    parser.add_argument("--seed", type=int, default=0)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    names = chosen.kind or [*LOSSES]
    end = chosen.first + sized(chosen, chosen.count, 2 * len(LOSSES), 2)
    trials: list[Trial] = []
    for first in range(chosen.first, end, chosen.of_a_robot):
        numbers = range(first, min(first + chosen.of_a_robot, end))
        trials += asyncio.run(_robot(numbers, names, chosen.seed, report))
    if not trials:
        raise CocoroError("no trial came about")
    report.value("time to rest", [trial.rest_s for trial in trials], "s")
    report.value("longest time to rest", [max(trial.rest_s for trial in trials)], "s", at_most=REST_S)
    report.value("longest time to zero", [max(trial.zero_s for trial in trials)], "s", at_most=ZERO_S)
    report.value("longest time by the machine's clock", [max(trial.real_s for trial in trials)], "s")
    good = sum(trial.rest_s <= REST_S for trial in trials)
    report.share(f"at rest within {REST_S:g} s", good, len(trials), at_least=len(trials))
