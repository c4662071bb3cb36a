"""Cuts the network of a site in the middle of fetches: `python -m bench site-cuts --count 20`.

The robot is simulated on one host, perception, planning and executive run on another, the operator sits at a third.
In each trial all packets of the robot's host or of the brain's are lost for some seconds, at a random moment of a
phase; phases take turns. The wheels must be at rest within 0.3 s of the cut, by the simulator's truth at every physics
step, and nothing may be touched. What became of the task is counted.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import tempfile
from pathlib import Path

from bench.fault_robot import STAND_S, report_stands
from bench.report import Report
from bench.site_disturbed import PHASES, Disturbed, disturbed_fetch
from bench.site_lab import BODY, BRAIN, Lab, lab
from bench.trials import Runs, number_of, sized
from cocoro.errors import ConfigError
from sim.network.network import obstacle


async def trial(site: Lab, motion: Path, phase: str, whose: str, cut_s: float, rng: random.Random) -> Disturbed | None:
    """One fetch with a cut; None when the phase did not come."""

    async def cut() -> None:
        site.network.cut(whose)
        await asyncio.sleep(cut_s)
        site.network.heal()

    return await disturbed_fetch(site, motion, phase, rng, cut)


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="cuts, each with a robot that is started for it (20)")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of each cut (5)")
    parser.add_argument("--seed", type=int, default=0)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if why := obstacle():
        raise ConfigError(f"there can be no network of hosts here: {why}")
    runs = Runs(report)
    trials: list[Disturbed] = []
    for number in range(sized(chosen, chosen.count, 20, 1)):
        rng = random.Random(f"cuts/{chosen.seed}/{number}")
        phase, whose = PHASES[number % len(PHASES)], (BRAIN, BODY)[number // len(PHASES) % 2]
        with tempfile.TemporaryDirectory(prefix="site") as name:
            motion = Path(name) / "motion"
            with lab(Path(name), seed=number, sensors="real", motion=str(motion)) as site:
                site.network.links().set(delay_ms=1.0)
                site.up()
                found = asyncio.run(trial(site, motion, phase, whose, chosen.seconds, rng))
        if found is None:
            report.notes.append(f"cut {number}: {phase} did not come, which is no trial")
            continue
        trials.append(found)
        line = f"cut {number}, {whose} in {phase}: at rest after {found.stand_s:.3f} s; {found.last_line}"
        runs.add(found.harmless and found.stand_s <= STAND_S, line, [found.said, str(found.truth)])
    report_stands(report, [found.stand_s for found in trials])
    runs.share("at rest in time, and nothing touched")
    report.share("done after the network was back", sum(found.done for found in trials), len(trials))
