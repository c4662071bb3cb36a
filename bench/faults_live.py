"""Faults and false alarms of a live robot: processes on zenoh in real time, judged at every physics step.

`live`: each trial starts a robot (profile `sim`, real sensors), lets it drive at full speed, and kills or stops one of
its processes. `alarms`: nothing is killed. It counts how often a robot that fetches and follows is slowed or stopped by
a service's patience although all services live. Times are simulated; real times are printed beside them.
"""

from __future__ import annotations

import asyncio
import random
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Iterator, Sequence
from contextlib import ExitStack, asynccontextmanager, contextmanager
from dataclasses import dataclass
from pathlib import Path

from bench.fault_robot import STANDING_MPS, full_speed_mps
from bench.fault_scenes import DRIVES, Errand, draw_errand
from bench.live import NAME, Operator, operator
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import NS, FollowedClock
from cocoro.errors import CocoroError
from cocoro.messages import PlannerStatus, TaskReply, TaskRequest, TaskState
from cocoro.node import Node
from cocoro.robot import Robot
from deploy.rundir import Target
from services.executive.tasks import FetchTask, FollowTask
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
        """Time of the newest physics step."""
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


def live(count: int, seed: int, profile: str, bound_s: float) -> bool:
    """Print each trial and a summary; returns whether the robot stood in time in every trial."""
    trials: list[LiveTrial] = []
    for number in range(count):
        try:
            trial = asyncio.run(_trial(number, profile, random.Random(f"live/{seed}/{number}")))
        except TimeoutError:
            print(f"  {number}: never at full speed in time, which is no trial", flush=True)
            continue
        trials.append(trial)
        print(
            f"  {number}: {trial.what}, {trial.drive} at {trial.speed_mps:.3f} m/s: stands after {trial.stand_s:.3f} s"
            f" ({trial.real_s:.3f} s of the machine's)", flush=True,
        )  # fmt: skip
    times = sorted(trial.stand_s for trial in trials)
    if not times:
        return False
    print(
        f"{len(times)} faults: median {statistics.median(times):.3f} s, worst {times[-1]:.3f} s,"
        f" margin {bound_s - times[-1]:+.3f} s; by the machine's clock {max(t.real_s for t in trials):.3f} s at worst"
    )
    return times[-1] <= bound_s


# --- false alarms ---------------------------------------------------------------------------------


@dataclass
class Alarms:
    """The number of times that a service's patience ended although all services lived."""

    task: str
    seconds: float
    driven: float
    """Time in which the wheels turned."""
    base: int
    """Number of times that the base's deadman stopped turning wheels."""
    deepest: float
    """Greatest share of its speed that the robot lost by that."""
    stood: int
    """Number of times that it stood because of that."""
    slower: int
    """Number of times that the planner slowed down because of a late service."""
    halted: Counter[str]
    """Number of times that it commanded zero because of a silent service, by its stated reason."""
    outcome: str = ""

    def line(self) -> str:
        halts = ", ".join(f"{count} x {why!r}" for why, count in self.halted.items()) or "none"
        return (
            f"{self.task:12s} {self.outcome:9s} {self.seconds:5.1f} s, {self.driven:5.1f} s of it driving:"
            f" deadman {self.base} (deepest {self.deepest:.0%}, stood {self.stood}),"
            f" planner slower {self.slower}, halts {halts}"
        )


def _deadman(rows: Sequence[MotionRow]) -> tuple[int, float, int]:
    """Number of events, the greatest share of speed lost, and the number that ended in standing."""
    events, deepest, stood = 0, 0.0, 0
    began_mps: float | None = None
    for row in rows:
        if row.no_command and began_mps is None and row.asked_mps > STANDING_MPS:
            events, began_mps = events + 1, row.asked_mps
        elif not row.no_command and began_mps is not None:
            began_mps = None
        if began_mps is not None and row.no_command:
            deepest = max(deepest, 1.0 - row.asked_mps / began_mps)
            if row.asked_mps == 0.0:
                stood, began_mps = stood + 1, None
    return events, deepest, stood


def _events(whys: Sequence[str], start: str) -> Iterator[str]:
    before = ""
    for why in whys:
        if why.startswith(start) and not before.startswith(start):
            yield why
        before = why


async def _alarms(scene: str, question: TaskRequest, *settings: str) -> Alarms:
    with operator() as cocoro, tempfile.TemporaryDirectory(prefix="faults") as name:
        async with robot_up(cocoro, "sim", scene, Path(name), *settings) as robot:
            task_id = await robot.begin(question)
            robot.read()
            first, said = len(robot.rows), len(robot.whys)
            state = await robot.ended(task_id)
            robot.read()
        rows, whys = robot.rows[first:], robot.whys[said:]
    events, deepest, stood = _deadman(rows)
    steps = 1.0 / 240
    return Alarms(
        f"{question.task.name} {scene}", state.elapsed_s, steps * sum(row.asked_mps > STANDING_MPS for row in rows),
        events, deepest, stood, sum(1 for _ in _events(whys, "slower, for")),
        Counter(_events(whys, "standing still:")), state.outcome or "",
    )  # fmt: skip


@contextmanager
def busy(processes: int) -> Iterator[None]:
    """Processes that load the machine meanwhile."""
    with ExitStack() as stack:
        for _ in range(processes):
            process = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(process.kill)
        yield


def alarms(count: int, others: int, settings: Sequence[str]) -> bool:
    """Run a fetch and a pursuit `count` times and print the alarms; returns whether all tasks ended as they should."""
    well = True
    with busy(others):
        for _ in range(count):
            for scene, question in (
                ("paper", TaskRequest(task=FetchTask(label="red_can"))),
                ("follow-fast", TaskRequest(task=FollowTask(label="blue_ball", for_s=24.0))),
            ):
                met = asyncio.run(_alarms(scene, question, *settings))
                well = well and met.outcome == "done"
                print(met.line(), flush=True)
    return well
