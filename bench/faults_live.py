"""Measures the time to stand of processes in real time: `python -m bench faults-live [--count 6]`.

Each trial starts a robot (profile `sim`, real sensors), lets it drive at full speed, and kills or stops one of its
processes. It is judged at every physics step. Times are simulated; real times are beside them. In every trial the robot
must stand within 0.3 s.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import signal
import tempfile
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from pathlib import Path

from bench.fault_robot import STAND_S, STANDING_MPS, full_speed_mps, report_stands
from bench.fault_scenes import DRIVES, Errand, draw_errand
from bench.live import NAME, Operator, operator
from bench.report import Report
from bench.trials import number_of, sized
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import NS, FollowedClock
from cocoro.errors import CocoroError
from cocoro.messages import PlannerStatus, TaskReply, TaskRequest, TaskState
from cocoro.node import Node
from cocoro.robot import Robot
from deploy.rundir import Target
from sim.motion import MotionRow, read_motion

VICTIMS = {"sim": ("planning", "executive", "perception"), "sim-wire": ("base", "arm")}
"""By profile, the services whose processes are killed and stopped; the process of 'arm' drives all servos. The
simulator is not among them, because time stands still without it."""
SIGNALS = (signal.SIGKILL, signal.SIGSTOP)
PATIENCE_S = 40.0
WATCH_S = 1.2


@dataclass(frozen=True)
class LiveTrial:
    """One killed or stopped process and the result."""

    what: str
    drive: str
    speed_mps: float
    stand_s: float
    """Simulated time from the last physics step before the signal until the body stood for good."""
    real_s: float
    """Real time from the sending of the signal until then."""


class LiveRobot:
    """A running robot with a task. Made by `robot_up`."""

    def __init__(self, cocoro: Operator, node: Node, motion: Path) -> None:
        self.cocoro = cocoro
        self.node = node
        self.states: list[TaskState] = []
        self.whys: list[str] = []
        """The planner's stated activity, status by status."""
        self._motion = motion
        self.rows: list[MotionRow] = []
        node.on(topics.TASK, self.states.append)
        node.on(topics.PLAN, self._plan)

    def _plan(self, status: PlannerStatus) -> None:
        self.whys.append(status.why)

    def read(self) -> MotionRow:
        """The newest physics step."""
        self.rows += read_motion(self._motion, len(self.rows))
        return self.rows[-1]

    async def begin(self, question: TaskRequest) -> str:
        """Request a task until it is accepted; returns its id. Raises TimeoutError."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                try:
                    reply = await self.node.call(topics.RUN, question)
                except CocoroError as error:
                    reply = TaskReply(accepted=False, text=str(error))
                if reply.accepted:
                    return reply.task_id
                await asyncio.sleep(0.1)

    async def ended(self, task_id: str) -> TaskState:
        """Wait for a task's outcome. Raises TimeoutError."""
        async with asyncio.timeout(3 * PATIENCE_S):
            while True:
                for state in self.states:
                    if state.task_id == task_id and state.outcome is not None:
                        return state
                await asyncio.sleep(0.05)

    async def at_speed(self, errand: Errand, rng: random.Random) -> MotionRow:
        """Give the task and drive until a random moment at full speed. Raises TimeoutError."""
        await self.begin(TaskRequest(task=errand.task))
        full_mps = 0.97 * full_speed_mps(errand.task.name)
        async with asyncio.timeout(PATIENCE_S):
            while True:
                await asyncio.sleep(0.005)
                if self.read().speed_mps < full_mps:
                    continue
                await asyncio.sleep(rng.uniform(0.0, 0.6))
                if (now := self.read()).speed_mps >= full_mps:
                    return now


@asynccontextmanager
async def robot_up(
    cocoro: Operator, profile: str, scene: str, folder: Path, *settings: str
) -> AsyncIterator[LiveRobot]:
    """Start a robot of a profile in a scene. `folder` receives the record of its motion. Raises CocoroError when it
    does not start."""
    motion = folder / "motion"
    options = ["--scene", scene, "--sensors", "real"]
    for setting in (f"service.sim.motion={motion}", *settings):
        options += ["--set", setting]
    code, said, _ = await asyncio.to_thread(cocoro, "up", profile, "--detach", *options)
    if code:
        raise CocoroError(said)
    async with (
        await ZenohBus.open(cocoro.run_dir.join_as("bench")) as bus,
        Node("bench", bus, FollowedClock(), Robot.load(), robot_name=NAME) as node,
    ):
        yield LiveRobot(cocoro, node, motion)


# --- faults ---------------------------------------------------------------------------------------


async def _trial(number: int, profile: str, rng: random.Random) -> LiveTrial:
    victims = VICTIMS[profile]
    turn, kind = divmod(number, len(victims) * len(SIGNALS))
    victim, how = victims[kind % len(victims)], SIGNALS[kind // len(victims)]
    with operator() as cocoro, tempfile.TemporaryDirectory(prefix="faults") as name:
        folder = Path(name)
        errand = draw_errand(DRIVES[(kind + turn) % len(DRIVES)], rng, folder)
        async with robot_up(cocoro, profile, str(errand.scene), folder) as robot:
            before = await robot.at_speed(errand, rng)
            target = Target(cocoro.run_dir.path / "claims" / victim)
            sent_ns = time.monotonic_ns()
            target.signal(how)
            await asyncio.sleep(WATCH_S)
            robot.read()
            target.signal(signal.SIGCONT)
            target.close()
        since_ns = max(row.sim_ns for row in robot.rows if row.real_ns <= sent_ns)
        moving = [row for row in robot.rows if row.sim_ns > since_ns and row.moves_mps >= STANDING_MPS]
        stood_ns, real_ns = (moving[-1].sim_ns, moving[-1].real_ns) if moving else (since_ns, sent_ns)
    return LiveTrial(
        f"{victim} {how.name}", errand.task.name, round(before.speed_mps + before.rim_mps, 3),
        round((stood_ns - since_ns) / NS, 4), round((real_ns - sent_ns) / NS, 4),
    )  # fmt: skip


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="faults, each with a robot that is started for it (6)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--profile", choices=VICTIMS, default="sim", help="of the robot")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    trials: list[LiveTrial] = []
    for number in range(sized(chosen, chosen.count, 6, 1)):
        try:
            trial = asyncio.run(_trial(number, chosen.profile, random.Random(f"live/{chosen.seed}/{number}")))
        except TimeoutError:
            report.notes.append(f"trial {number}: never at full speed in time, which is no trial")
            continue
        trials.append(trial)
        line = (
            f"trial {number}, {trial.what}, {trial.drive} at {trial.speed_mps:.3f} m/s: stood after"
            f" {trial.stand_s:.3f} s ({trial.real_s:.3f} s of the machine's)"
        )
        report.say(line)
        if trial.stand_s > STAND_S:
            report.notes.append(line)
    report_stands(report, [trial.stand_s for trial in trials])
    report.value("longest time by the machine's clock", [max(trial.real_s for trial in trials)], "s")
