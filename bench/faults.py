"""Measures the time to stand after a fault at full speed: `python -m bench faults [--count 200] [--seed N]`.

Each trial is a whole robot in virtual time with a task in a random scene: a fetch or a go-to at full speed, or a
pursuit that closes a gap. At a random moment at full speed a fault occurs, the kinds of docs/faults.md in turn. Then
the simulator's true state at every physics step (240 Hz) shows when the body stood for good: slower than 1 cm/s both at
its centre and at its wheels. In every trial that must be within 0.3 s.

`python -m bench faults-live` does the same with real processes in real time, which are killed and stopped.
`python -m bench alarms` counts how often patience ends although all services live.

Equal seeds give equal trials. The results do not depend on the load of the machine.
"""

from __future__ import annotations

import argparse
import logging
import random
import tempfile
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import get_args

from bench.fault_bus import Way
from bench.fault_robot import STAND_S, FaultRobot, Happening, NotFastError, report_stands
from bench.fault_scenes import DRIVES, Drive, draw_errand
from bench.report import Report, Table, number, percentile
from bench.trials import add_jobs, number_of, sized
from cocoro.robot import Robot
from cocoro.vloop import run_virtual
from deploy.processes import hardware

SERVICES = ("planning", "executive", "perception", *hardware())
HAPPENINGS: tuple[Happening, ...] = (
    *(Happening(service, way) for way in get_args(Way) for service in SERVICES),
    Happening(what="estop"),
    Happening(what="cancel"),
    *(Happening(service, "silent", "flood") for service in ("planning", "executive", "perception", "base")),
)
TRIES = 4
"""Number of scenes to draw for a trial before one must let the robot reach full speed."""


@dataclass(frozen=True)
class Trial:
    """One fault and its result."""

    number: int
    what: str
    drive: Drive
    speed_mps: float
    """True speed at the fault: the greater of centre and wheel rims."""
    stand_s: float
    """Time from the fault until the body stood for good."""


def happening_of(number: int) -> tuple[Happening, Drive]:
    """Kind and task of a trial. Every kind occurs once before any occurs again."""
    turn, kind = divmod(number, len(HAPPENINGS))
    return HAPPENINGS[kind], DRIVES[(turn + kind) % len(DRIVES)]


def run_trial(seed: int, number: int) -> Trial:
    """Raises NotFastError when the robot reaches full speed in no scene that was drawn."""
    happening, drive = happening_of(number)
    rng = random.Random(f"{seed}/{number}")
    for left in reversed(range(TRIES)):
        try:
            return run_virtual(_try(number, happening, drive, rng))
        except NotFastError:
            if not left:
                raise
    raise AssertionError("unreachable")


async def _try(number: int, happening: Happening, drive: Drive, rng: random.Random) -> Trial:
    with tempfile.TemporaryDirectory(prefix="faults") as name:
        folder = Path(name)
        errand = draw_errand(drive, rng, folder)
        async with FaultRobot(errand, folder, rng.randrange(1000)) as robot:
            before = await robot.drive(rng)
            stand_s = await robot.stand_s(happening, rng)
    fastest_mps = before.speed_mps + before.rim_mps
    return Trial(number, happening.name, drive, round(fastest_mps, 4), round(stand_s, 4))


# --- the bench ------------------------------------------------------------------------------------


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="trials (200)")
    parser.add_argument("--first", type=int, default=0, help="the number of the first trial")
    parser.add_argument("--seed", type=int, default=0)
    add_jobs(parser)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    numbers = range(chosen.first, chosen.first + sized(chosen, chosen.count, 200, 4))
    trials = []
    with ProcessPoolExecutor(chosen.jobs, initializer=_quiet) as pool:
        for trial in pool.map(run_trial, [chosen.seed] * len(numbers), numbers):
            trials.append(trial)
            report.say(_line(trial))
    report_stands(report, [trial.stand_s for trial in trials])
    report.notes += [_line(trial) for trial in trials if trial.stand_s > STAND_S]
    report.tables.append(Table("Time to stand, s", ["fault", *HEAD], [_row(*kind) for kind in by_kind(trials).items()]))
    slowest = sorted(trials, key=lambda trial: -trial.stand_s)[:5]
    rows = [
        [str(trial.number), trial.what, trial.drive, number(trial.speed_mps), number(trial.stand_s)]
        for trial in slowest
    ]
    report.tables.append(Table("The slowest", ["trial", "fault", "task", "speed, m/s", "stood after, s"], rows))
    fastest = max(trials, key=lambda trial: trial.speed_mps)
    ramp_s = fastest.speed_mps / Robot.load().base.wheel_acceleration_mps2
    report.notes.append(
        f"the fastest wheel: {fastest.speed_mps:.3f} m/s, from where the ramp alone takes {ramp_s:.3f} s"
    )


HEAD = ["trials", "median", "95%", "worst", "margin"]


def _row(kind: str, times_s: Sequence[float]) -> list[str]:
    middle, most, worst = (f"{percentile(times_s, percent):.3f}" for percent in (50, 95, 100))
    return [kind, str(len(times_s)), middle, most, worst, f"{STAND_S - max(times_s):+.3f}"]


def by_kind(trials: Iterable[Trial]) -> dict[str, list[float]]:
    """Times to stand, s: of each kind of fault, and of all in each task."""
    times: dict[str, list[float]] = {}
    for trial in trials:
        times.setdefault(trial.what, []).append(trial.stand_s)
    for trial in trials:
        times.setdefault(f"all in a {trial.drive}", []).append(trial.stand_s)
    return times


def _line(trial: Trial) -> str:
    where = f"trial {trial.number}, {trial.what}, {trial.drive}"
    return f"{where}: stood {trial.stand_s:.3f} s after a fault at {trial.speed_mps:.3f} m/s"


def _quiet() -> None:
    """Hides the log line of the emergency stop, which is pressed on purpose here."""
    logging.getLogger("cocoro").setLevel(logging.ERROR)
