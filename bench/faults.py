"""How fast the robot stands after a fault at full speed: `python -m bench.faults [--count 200] [--seed N] [--json]`.

Each trial is a whole robot in virtual time, on an errand in a scene drawn at random: a fetch or a go-to at full speed,
or a pursuit that makes up for a gap. At a random moment at full speed something happens to it, the kinds of
docs/faults.md in turn. Then the simulator's truth at every step of the physics (240 Hz) says when the body stood for
good: slower than 1 cm/s, at its centre as well as, by turning, where its wheels are. Exit code 1 when one took longer
than 0.3 s.

`python -m bench.faults live --count N`: the same with the processes of a robot that is up in real time, killed and
stopped. `python -m bench.faults alarms --count N [--others 2]`: how often patience ends while everyone lives. See
`bench.faults_live`.

The same seed gives the same trials. Nothing here depends on how busy the machine is but the wall time; that of `live`
does, and says what it is worth.
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
"""Scenes that are drawn for a trial until there is one in which the robot comes to its full speed."""


@dataclass(frozen=True)
class Trial:
    """One fault, and what came of it."""

    number: int
    what: str
    drive: Drive
    speed_mps: float
    """At the moment of the fault, of the faster of centre and wheels' rims, by the truth."""
    stand_s: float
    """From the fault until it stood for good."""


def happening_of(number: int) -> tuple[Happening, Drive]:
    """The kind and the errand of a trial; all kinds come once before any comes again."""
    turn, kind = divmod(number, len(HAPPENINGS))
    return HAPPENINGS[kind], DRIVES[(turn + kind) % len(DRIVES)]


def run_trial(seed: int, number: int) -> Trial:
    """Raises NotFastError when no scene that was drawn lets the robot drive at full speed."""
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
    """How long it took until the robot stood, in several trials; seconds."""

    count: int
    median_s: float
    p95_s: float
    worst_s: float
    margin_s: float
    """Left of the bound in the worst."""


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
    """An emergency stop that is pressed on purpose is no news."""
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
