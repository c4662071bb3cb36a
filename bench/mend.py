"""Fetches in which a service dies or hangs, or a link is cut and comes back: `python -m bench mend --count 12`.

Each trial starts a robot of real processes and hits it once, in the phases of a fetch in turn, at a random moment of
the phase. The fetch must end `done` with the can held, nothing else touched, by the simulator's truth; the body must
stand 0.3 s after the blow and until the service or the link is back. `--how kill`: SIGKILL to perception and planning
in turn, with `--profile sim-wire` to base and servos. `stop`: SIGSTOP; the supervisor kills what hangs. `cut`: the link
between body and brain of a site of three hosts, for 5 s; needs root, for network namespaces.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import signal
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from bench.fault_robot import STAND_S, STANDING_MPS
from bench.faults_live import robot_up
from bench.live import operator
from bench.report import Report
from bench.site_lab import BRAIN, FRAMES, Lab, lab
from bench.trials import Runs, number_of, sized
from cocoro import topics
from cocoro.clock import NS
from cocoro.errors import CocoroError, ConfigError
from cocoro.messages import TaskState
from cocoro.node import Node
from deploy.rundir import Target
from sim.judge import HELD_S, Judge, Verdict
from sim.motion import read_motion
from sim.network.network import obstacle
from sim.random_scene import find_scene

LABEL = "red_can"
PHASES = {"search": 0.6, "approach": 2.5, "reach": 0.8, "grasp": 0.3, "lift": 0.8, "hold": 2.0}
"""The phases of a fetch, and the latest moment in each for a blow, s of the machine."""
VICTIMS = {"sim": ("perception", "planning"), "sim-wire": ("base", "arm")}
"""By profile; the process of 'arm' drives all servos. The simulator is not among them: the world ends with it."""
CUT_S = 5.0
PATIENCE_S = 180.0


class Trial(NamedTuple):
    what: str
    phase: str
    """In which the blow fell."""
    state: TaskState
    truth: Verdict
    stand_s: float
    """Simulated time from the blow until the body stood, at the latest before it could go on."""
    said: tuple[str, ...]
    """What the task said while it waited."""

    @property
    def well(self) -> bool:
        truth = self.truth
        return self.state.outcome == "done" and truth.held and not truth.knocked_over and not truth.collisions

    @property
    def line(self) -> str:
        state = self.state
        return (
            f"{self.what} in {self.phase}: {state.outcome} after {state.elapsed_s:.1f} s {state.reason}; stood after"
            f" {self.stand_s:.3f} s; it said: {'; '.join(self.said) or 'nothing'}"
        )


class _Watch:
    """What a robot says and truly does."""

    def __init__(self, node: Node, motion: Path) -> None:
        self._motion = motion
        self._judge = Judge(node.robot, find_scene("paper", 0, LABEL), LABEL)
        self._states: list[TaskState] = []
        self._news = asyncio.Event()
        self._blow_ns = 0
        node.on(topics.TRUTH, self._judge.feed)
        node.on(topics.TASK, self._state)

    def _state(self, state: TaskState) -> None:
        self._states.append(state)
        self._news.set()

    async def until(self, wanted: Callable[[TaskState], bool]) -> TaskState:
        """Wait for a state of the task. Raises TimeoutError."""
        async with asyncio.timeout(PATIENCE_S):
            while not (self._states and wanted(self._states[-1])):
                self._news.clear()
                await self._news.wait()
        return self._states[-1]

    async def moment(self, phase: str, rng: random.Random, fetching: asyncio.Future[tuple[int, str, float]]) -> str:
        """Wait until a random moment of a phase; returns the phase that it really is then. Raises CocoroError when the
        command ends before."""
        came = asyncio.ensure_future(self.until(lambda state: state.phase == phase))
        await asyncio.wait((came, fetching), return_when=asyncio.FIRST_COMPLETED)
        if not came.done():
            came.cancel()
            raise CocoroError(fetching.result()[1].strip())
        came.result()
        await asyncio.sleep(rng.uniform(0.0, PHASES[phase]))
        self._blow_ns = time.monotonic_ns()
        return self._states[-1].phase

    async def result(self, what: str, phase: str, still_s: float) -> Trial:
        """`still_s`: time after the blow in which nothing can be back, by the machine's clock."""
        state = await self.until(lambda state: state.outcome is not None)
        await asyncio.sleep(HELD_S + 0.5)
        rows = read_motion(self._motion, 0)
        after = [row for row in rows if self._blow_ns < row.real_ns < self._blow_ns + still_s * NS]
        moving = [row for row in after if row.moves_mps >= STANDING_MPS]
        stand_s = (moving[-1].sim_ns - after[0].sim_ns) / NS if moving else 0.0
        waits = ("waiting", "lost contact", "going on", "standing still")
        said = dict.fromkeys(state.text for state in self._states if state.text.startswith(waits))
        kept = [text for text in said if not text.startswith(("waiting: nothing", "standing still"))]
        return Trial(what, phase, state, self._judge.result(), round(stand_s, 4), tuple(kept))


async def _local(number: int, how: str, profile: str, rng: random.Random) -> Trial:
    phase = [*PHASES][number % len(PHASES)]
    victim = VICTIMS[profile][(number // len(PHASES)) % len(VICTIMS[profile])]
    sized_frames = [f"service.sim.{name}={value}" for name, value in FRAMES.items()]
    with operator() as cocoro, tempfile.TemporaryDirectory(prefix="mend") as name:
        async with robot_up(cocoro, profile, "paper", Path(name), *sized_frames) as robot:
            watch = _Watch(robot.node, Path(name) / "motion")
            fetching = asyncio.create_task(asyncio.to_thread(cocoro, "fetch", LABEL))
            phase = await watch.moment(phase, rng, fetching)
            target = Target(cocoro.run_dir.path / "claims" / victim)
            target.signal(signal.SIGKILL if how == "kill" else signal.SIGSTOP)
            target.close()
            trial = await watch.result(f"{how} {victim}", phase, 1.0)
            await fetching
    return trial


async def _cut(site: Lab, motion: Path, phase: str, rng: random.Random) -> Trial:
    async with site.observer() as node:
        watch = _Watch(node, motion)
        fetching = asyncio.create_task(
            asyncio.to_thread(site.command, site.desk, "fetch", LABEL, *site.as_person("ada"))
        )
        phase = await watch.moment(phase, rng, fetching)
        site.network.cut(BRAIN, for_s=CUT_S)
        trial = await watch.result("cut", phase, CUT_S)
        code, said, _ = await fetching
    if code and trial.state.outcome == "done":
        return trial._replace(said=(*trial.said, f"the command ended with {code}: {said.splitlines()[-1:]}"))
    return trial


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="trials, each with a robot that is started for it (12)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--first", type=int, default=0, help="the number of the first trial")
    parser.add_argument("--profile", choices=VICTIMS, default="sim", help="of the robot (sim)")
    parser.add_argument("--how", choices=["kill", "stop", "cut"], default="kill", help="the blow (kill)")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    if chosen.how == "cut" and (why := obstacle()):
        raise ConfigError(f"there can be no network of hosts here: {why}")
    runs, stood, took = Runs(report), [], []
    for number in range(chosen.first, chosen.first + sized(chosen, chosen.count, 12, 1)):
        rng = random.Random(f"mend/{chosen.seed}/{number}")
        try:
            if chosen.how == "cut":
                with tempfile.TemporaryDirectory(prefix="mend") as name:
                    motion = Path(name) / "motion"
                    with lab(Path(name), seed=number, sensors="real", motion=str(motion)) as site:
                        site.network.links().set(delay_ms=1.0)
                        site.up()
                        trial = asyncio.run(_cut(site, motion, [*PHASES][number % len(PHASES)], rng))
            else:
                trial = asyncio.run(_local(number, chosen.how, chosen.profile, rng))
        except (TimeoutError, CocoroError) as error:
            report.notes.append(
                f"trial {number} is none: {error or 'the task did not come to the phase, or to its end'}"
            )
            report.say(report.notes[-1])
            continue
        runs.add(trial.well, f"{number}: {trial.line}", [str(trial.truth)])
        stood.append(trial.stand_s)
        took.append(trial.state.elapsed_s)
    runs.share("ended well")
    if stood:
        report.value("time to stand", stood, "s")
        report.share(f"stood within {STAND_S:g} s", sum(s <= STAND_S for s in stood), len(stood), at_least=len(stood))
        report.value("the task, by the robot's clock", took, "s")
