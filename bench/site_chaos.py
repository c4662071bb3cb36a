"""Kills and stops processes of a site in the middle of fetches: `python -m bench site-chaos --count 20`.

In each trial one process of one host gets SIGKILL or SIGSTOP at a random moment of a phase of a fetch over three
hosts; processes and signals take turns. Where what commands the wheels is gone (planning, a gateway), they must be at
rest within 0.3 s, by the simulator's truth at every physics step. The service must be back, the task done, or failed
with a reason that is true: nothing is said to have died that did not.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import re
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from bench.fault_robot import STAND_S, report_stands
from bench.report import Report
from bench.site_disturbed import PHASES, Disturbed, disturbed_fetch
from bench.site_lab import BODY, BRAIN, ROBOT, Lab, lab
from bench.trials import Runs, number_of, sized
from cocoro.errors import ConfigError
from deploy.rundir import RunDir, Target
from sim.network.network import obstacle

VICTIMS = (
    (BRAIN, "planning"), (BRAIN, "perception"), (BRAIN, "executive"), (BRAIN, "gateway-brain"),
    (BODY, "gateway-body"), (BODY, "capture"), (BODY, "base"),
)  # fmt: skip
"""Host and service; the process that is the base is the simulator's, with all that it stands in for."""
COMMANDING = ("planning", "gateway-brain", "gateway-body")
SIMULATED = ("kinect", "base", "arm", "hand")
SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
BACK_S = 5.0
PATIENCE_S = 30.0
_DIED = re.compile(r"(\w[\w-]*) died")


class Hit:
    """One process that is killed or stopped, and how long its service was away."""

    def __init__(self, site: Lab, host: str, service: str, number: signal.Signals) -> None:
        self._run_dir = RunDir(ROBOT, site.network.host(host).folder / "run")
        self._service = service
        self._number = number
        self.away_s = float("nan")

    async def __call__(self) -> None:
        before = self._run_dir.claims()[self._service].pid
        target = Target(self._run_dir.path / "claims" / self._service)
        begun_s = time.monotonic()
        target.signal(self._number)
        target.close()
        await self._until(lambda pid: pid not in (0, before))
        self.away_s = time.monotonic() - begun_s

    async def _until(self, good: Callable[[int], bool]) -> None:
        end_s = time.monotonic() + PATIENCE_S
        while time.monotonic() < end_s:
            by = self._run_dir.claims().get(self._service)
            if good(0 if by is None else by.pid):
                return
            await asyncio.sleep(0.02)


def untrue(found: Disturbed, service: str, number: signal.Signals) -> str:
    """What the reason of a failure says to have died, though it did not; '' when it says the truth."""
    gone = set(SIMULATED if service == "base" else (service,)) if number is signal.SIGKILL else set()
    return ", ".join(sorted(set(_DIED.findall(found.last_line)) - gone))


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="hits, each with a robot that is started for it (20)")
    parser.add_argument("--seed", type=int, default=0)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if why := obstacle():
        raise ConfigError(f"there can be no network of hosts here: {why}")
    runs = Runs(report)
    stood: list[float] = []
    away: list[float] = []
    done: list[bool] = []
    for number in range(sized(chosen, chosen.count, 20, 1)):
        rng = random.Random(f"chaos/{chosen.seed}/{number}")
        host, service = VICTIMS[number % len(VICTIMS)]
        how, phase = SIGNALS[number // len(VICTIMS) % 2], rng.choice(PHASES)
        with tempfile.TemporaryDirectory(prefix="site") as name:
            motion = Path(name) / "motion"
            with lab(Path(name), seed=number, sensors="real", motion=str(motion)) as site:
                site.network.links().set(delay_ms=1.0)
                site.up()
                hit = Hit(site, host, service, how)
                found = asyncio.run(disturbed_fetch(site, motion, phase, rng, hit))
        if found is None:
            report.notes.append(f"hit {number}: {phase} did not come, which is no trial")
            continue
        lie = untrue(found, service, how)
        well = found.harmless and not lie
        if service in COMMANDING:
            stood.append(found.stand_s)
            well = well and found.stand_s <= STAND_S
        if service != "base":
            done.append(found.done)
        away.append(hit.away_s)
        line = f"hit {number}, {service} {how.name} in {phase}: away {hit.away_s:.1f} s; {found.last_line}"
        runs.add(well, line, [found.said, str(found.truth), f"untrue: {lie}"])
    if stood:
        report_stands(report, stood)
    report.value("until the service had a process again", away, "s", at_most=BACK_S)
    runs.share("at rest in time, nothing touched, the reason true")
    if done:
        report.share("done, of those that lost something other than the simulator", sum(done), len(done))
