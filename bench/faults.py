"""Measures the time to stand after a fault at full speed: `python -m bench.faults [--count 200] [--seed N] [--json]`.

Each trial is a whole robot in virtual time with a task in a random scene: a fetch or a go-to at full speed, or a
pursuit that closes a gap. At a random moment at full speed a fault occurs, the kinds of docs/faults.md in turn. Then
the simulator's true state at every physics step (240 Hz) shows when the body stood for good: slower than 1 cm/s both at
its centre and at its wheels. Exit code 1 when a trial took longer than 0.3 s.

`python -m bench.faults live --count N` does the same with real processes in real time, which are killed and stopped.
`python -m bench.faults alarms --count N [--others 2]` counts how often patience ends although all services live. See
`bench.faults_live`.

Equal seeds give equal trials. The results do not depend on the load of the machine, except those of `live`, which
reports the load.
"""

from __future__ import annotations

import argparse
import json
import logging
import random
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import get_args

from bench.ended import leave_when_ended
from bench.fault_bus import Way
from bench.fault_robot import FaultRobot, Happening, NotFastError
from bench.fault_scenes import DRIVES, Drive, draw_errand
from bench.faults_live import alarms, live
from cocoro.robot import Robot
from cocoro.vloop import run_virtual
from deploy.processes import hardware

STAND_S = 0.3
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


# --- what came of all ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Spread:
    """Times to stand of several trials, s."""

    count: int
    median_s: float
    p95_s: float
    worst_s: float
    margin_s: float
    """Margin to the bound in the worst trial."""


def spread(trials: Iterable[Trial]) -> Spread:
    times = sorted(trial.stand_s for trial in trials)

    def share(part: float) -> float:
        return times[min(int(part * len(times)), len(times) - 1)]

    return Spread(len(times), share(0.5), share(0.95), times[-1], round(STAND_S - times[-1], 4))


def by_kind(trials: Sequence[Trial]) -> dict[str, Spread]:
    kinds = dict.fromkeys(trial.what for trial in trials)
    spreads = {kind: spread(trial for trial in trials if trial.what == kind) for kind in kinds}
    spreads |= {
        f"all in a {drive}": spread(own) for drive in DRIVES if (own := [t for t in trials if t.drive == drive])
    }
    return spreads | {"all": spread(trials)}


def _print(trials: Sequence[Trial]) -> None:
    print(f"{'what':32s} count  median     95%   worst  margin")
    for kind, of in by_kind(trials).items():
        print(f"{kind:32s} {of.count:5d} {of.median_s:7.3f} {of.p95_s:7.3f} {of.worst_s:7.3f} {of.margin_s:+7.3f}")
    ramp = Robot.load().base.wheel_acceleration_mps2
    fastest = max(trials, key=lambda trial: trial.speed_mps)
    ramp_s = fastest.speed_mps / ramp
    print(f"the fastest wheel: {fastest.speed_mps:.3f} m/s, from where the ramp alone takes {ramp_s:.3f} s")
    for trial in sorted(trials, key=lambda trial: -trial.stand_s)[:5]:
        print(
            f"  {trial.stand_s:.3f} s from {trial.speed_mps:.3f} m/s: trial {trial.number}, {trial.what}, {trial.drive}"
        )


def _quiet() -> None:
    """Hides the log line of the emergency stop, which is pressed on purpose here."""
    logging.getLogger("cocoro").setLevel(logging.ERROR)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=("virtual", "live", "alarms"), default="virtual")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--first", type=int, default=0, help="the number of the first trial")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--json", action="store_true")
    parser.add_argument("--profile", choices=("sim", "sim-wire"), default="sim", help="live: of the robot")
    parser.add_argument("--others", type=int, default=0, help="alarms: so many processes that keep the cores busy")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="alarms: of the profile")
    asked = parser.parse_args()
    leave_when_ended()
    if asked.what == "live":
        return 0 if live(asked.count, asked.seed, asked.profile, STAND_S) else 1
    if asked.what == "alarms":
        return 0 if alarms(asked.count, asked.others, asked.set) else 1
    began_s = time.monotonic()
    numbers = range(asked.first, asked.first + asked.count)
    with ProcessPoolExecutor(asked.jobs, initializer=_quiet) as pool:
        trials = list(pool.map(run_trial, [asked.seed] * len(numbers), numbers))
    if asked.json:
        spreads = {kind: asdict(of) for kind, of in by_kind(trials).items()}
        print(json.dumps({"bound_s": STAND_S, "spread": spreads, "trials": [asdict(trial) for trial in trials]}))
    else:
        _print(trials)
        print(f"{len(trials)} faults in {time.monotonic() - began_s:.0f} s")
    return 0 if max(trial.stand_s for trial in trials) <= STAND_S else 1


if __name__ == "__main__":
    sys.exit(main())
