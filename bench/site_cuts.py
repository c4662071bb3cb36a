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
import time
from dataclasses import dataclass
from pathlib import Path

from bench.fault_robot import STAND_S, STANDING_MPS, report_stands
from bench.report import Report
from bench.site_lab import BODY, BRAIN, ROBOT, Lab, lab
from bench.trials import Runs, number_of, sized
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import NS, FollowedClock
from cocoro.errors import ConfigError
from cocoro.messages import TaskState
from cocoro.node import Node
from cocoro.robot import Robot
from sim.judge import HELD_S, Judge, Verdict
from sim.motion import read_motion
from sim.network.network import obstacle
from sim.random_scene import find_scene

PHASES = ("search", "approach", "reach", "grasp", "lift", "hold")
LONGEST_IN_S = {"search": 0.3, "approach": 2.0, "reach": 0.5, "grasp": 0.5, "lift": 0.7, "hold": 1.5}
"""A cut comes at a random moment of this long from the beginning of its phase."""
PHASE_S = 40.0
"""Longest wait for a phase."""
END_S = 150.0


@dataclass(frozen=True)
class Trial:
    """One cut and what came of it."""

    what: str
    code: int
    said: str
    stand_s: float
    """From the cut until the body stood, until the network was back."""
    truth: Verdict

    @property
    def harmless(self) -> bool:
        return self.stand_s <= STAND_S and not self.truth.knocked_over and not self.truth.collisions

    @property
    def done(self) -> bool:
        return self.harmless and self.code == 0 and self.truth.held


async def trial(site: Lab, motion: Path, phase: str, whose: str, cut_s: float, rng: random.Random) -> Trial | None:
    """One fetch with a cut; None when the phase did not come."""
    judge = Judge(find_scene("paper", 0, "red_can"), "red_can")
    came = asyncio.Event()

    def on_task(state: TaskState) -> None:
        if state.phase == phase and state.outcome is None:
            came.set()

    async with (
        await ZenohBus.open(site.run_dir.join_as("bench")) as bus,
        Node("bench", bus, FollowedClock(), Robot.load(), robot_name=ROBOT) as node,
    ):
        node.on(topics.TRUTH, judge.feed)
        node.on(topics.TASK, on_task)
        process = await asyncio.to_thread(site.begin, site.desk, "fetch", "red_can", *site.as_person("ada"))
        try:
            async with asyncio.timeout(PHASE_S):
                await came.wait()
        except TimeoutError:
            process.kill()
            return None
        await asyncio.sleep(rng.uniform(0.0, LONGEST_IN_S[phase]))
        cut_ns = time.monotonic_ns()
        site.network.cut(whose)
        await asyncio.sleep(cut_s)
        back_ns = time.monotonic_ns()
        site.network.heal()
        said, _ = await asyncio.to_thread(process.communicate, timeout=END_S)
        await asyncio.sleep(HELD_S + 0.5)
    rows = [row for row in read_motion(motion, 0) if cut_ns < row.real_ns < back_ns]
    moving = [row.real_ns for row in rows if row.moves_mps >= STANDING_MPS]
    stand_s = (moving[-1] - cut_ns) / NS if moving else 0.0
    return Trial(f"{whose} cut off in {phase}", process.returncode, said, stand_s, judge.result())


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="cuts, each with a robot that is started for it (20)")
    parser.add_argument("--seconds", type=float, default=5.0, help="length of each cut (5)")
    parser.add_argument("--seed", type=int, default=0)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if why := obstacle():
        raise ConfigError(f"there can be no network of hosts here: {why}")
    runs = Runs(report)
    trials: list[Trial] = []
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
        last = (found.said.partition("\nrecorded in ")[0].strip().splitlines() or ["it said nothing"])[-1]
        line = f"cut {number}, {found.what}: at rest after {found.stand_s:.3f} s; {last}"
        runs.add(found.harmless, line, [found.said, str(found.truth)])
    report_stands(report, [found.stand_s for found in trials])
    runs.share("at rest in time, and nothing touched")
    report.share("done after the network was back", sum(found.done for found in trials), len(trials))
