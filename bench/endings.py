"""Judges endings of a task's command, over real processes: `python -m bench endings [--count 60] [--only KIND]`.

Each case starts `cocoro fetch LABEL --bring` (or `babble`) on a simulated robot, waits for a phase of the task, and
ends the command, or lets go of it, in one of the ways of `KINDS` (bench/command_endings.py). It then judges by the
simulator's truth when the robot came to rest, in simulated seconds from the last physics step before the ending (240 Hz
for the body, 30 Hz for the joints); that the task was cancelled; and that the next task is accepted.

Case N is the same for the same seed, so a bench in parts (`--from 20 --count 20`) is the same bench. Each case must
keep the bound.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import tempfile
import time
from collections.abc import AsyncIterator, Callable, Mapping
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path

from bench.command_endings import ENDS, KINDS, Command
from bench.live import NAME, Operator, operator
from bench.report import Report
from bench.trials import Runs, number_of, sized
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import NS, FollowedClock
from cocoro.errors import CocoroError
from cocoro.messages import ReportRequest, TaskReply, TaskRequest, TaskState, Truth
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.tasks import Task
from services.executive.tasks import ParkTask, PutDownTask
from sim.motion import MotionRow, read_motion

ROBOT = Robot.load()
CLAWS = ROBOT.jaws
CLAW_LINKS = {ROBOT.link_of(jaw) for jaw in CLAWS}
BOUND_S = 0.5
STANDING_MPS = 0.01
RESTING_RAD = 0.015
"""A joint rests as long as it stays within three steps of its servo's encoder of where it is in the end. When commands
are late, the servo stops and is sent on, which moves it by a step or two."""
WATCH_S = 1.5
PATIENCE_S = 90.0
PHASES = ("start", "search", "approach", "reach", "grasp", "lift", "hold", "carry", "place", "babble-arm")
"""`start`: the command has only just been started, and may or may not have asked for its task."""
CANS = ("red_can", "green_can", "blue_can")
ABSENT = "yellow_ball"
"""An object that is not in the scene, so that the search lasts."""


@dataclass
class Watched:
    """A robot that is up, and what is seen of it."""

    cocoro: Operator
    node: Node
    motion: Path
    state: TaskState = field(default_factory=TaskState)
    holding: bool = False
    truths: list[Truth] = field(default_factory=list)
    rows: list[MotionRow] = field(default_factory=list)

    def read(self) -> None:
        self.rows += read_motion(self.motion, len(self.rows))

    async def until(self, good: Callable[[], bool], timeout_s: float = PATIENCE_S) -> bool:
        """Waits until it is so; returns whether it is."""
        with suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                while not good():  # noqa: ASYNC110 # what is awaited is in files and messages
                    await asyncio.sleep(0.005)
        return good()

    async def report(self) -> TaskState:
        return await self.node.call(topics.REPORT, ReportRequest(), 10.0)

    async def ask(self, task: Task) -> TaskReply:
        return await self.node.call(topics.RUN, TaskRequest(task=task), 10.0)

    async def do(self, task: Task) -> TaskReply:
        """Asks for a task and waits for its end."""
        reply = await self.ask(task)
        if reply.accepted:
            await self.until(lambda: self.state.task_id == reply.task_id and self.state.outcome is not None)
        return reply

    def claws_touch(self) -> bool:
        """Whether a claw touches an object, by the newest truth."""
        return any(CLAW_LINKS & set(item.touching) for item in self.truths[-1].objects)

    def body_rest_s(self, since_ns: int) -> float:
        moving = [row.sim_ns for row in self.rows if row.sim_ns > since_ns and row.moves_mps >= STANDING_MPS]
        return (max(moving, default=since_ns) - since_ns) / NS

    def joints_rest_s(self, since_ns: int) -> tuple[float, float, str]:
        """When the last joint came to rest, without the claws and of the claws; and which joint was last, and how far
        it moved. Of claws at an object it is the opening between them that must rest: the pair swings by up to 0.04 rad
        in a second around what it presses, which itself moves by less than 1 mm."""
        truths = [truth for truth in self.truths if truth.stamp_ns > since_ns]
        pair = bool(truths) and self.claws_touch()
        angles = [_with_opening(truth.joints_rad) if pair else truth.joints_rad for truth in truths]
        last, which, latest_ns = {False: since_ns, True: since_ns}, "", since_ns
        for joint, end in angles[-1].items() if angles else ():
            off = [abs(each[joint] - end) for each in angles]
            away = [number for number, angle in enumerate(off) if angle > RESTING_RAD]
            rest_ns = truths[away[-1]].stamp_ns if away else since_ns
            last[joint in CLAWS] = max(last[joint in CLAWS], rest_ns)
            if rest_ns > latest_ns:
                latest_ns, which = rest_ns, f"{joint} by {off[away[0]]:.3f} rad"
        return (last[False] - since_ns) / NS, (last[True] - since_ns) / NS, which


def _with_opening(joints_rad: Mapping[str, float]) -> dict[str, float]:
    """The angles with the opening between the claws in place of each claw's own."""
    left, right = CLAWS
    return {joint: angle for joint, angle in joints_rad.items() if joint != left} | {
        right: joints_rad[right] - joints_rad[left]
    }


@asynccontextmanager
async def robot_up(folder: Path) -> AsyncIterator[Watched]:
    with operator() as cocoro:
        motion = folder / "motion"
        settings = [
            "--set",
            f"service.sim.motion={motion}",
            "--set",
            'processes=["sim","perception","planning","executive"]',
        ]
        code, said, _ = await asyncio.to_thread(cocoro, "up", "sim", "--detach", "--frames", "320x240@15", *settings)
        if code:
            raise CocoroError(said)
        async with (
            await ZenohBus.open(cocoro.run_dir.join_as("bench")) as bus,
            Node("bench", bus, FollowedClock(), Robot.load(), robot_name=NAME) as node,
        ):
            watched = Watched(cocoro, node, motion)
            node.on(topics.TASK, lambda state: setattr(watched, "state", state))
            node.on(topics.PLAN, lambda plan: setattr(watched, "holding", plan.holding))
            node.on(topics.TRUTH, watched.truths.append)
            yield watched


# --- a case --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Case:
    number: int
    kind: str
    phase: str
    label: str
    wait_s: float

    @property
    def arguments(self) -> list[str]:
        if self.phase == "babble-arm":
            return ["babble", "arm", "--samples", "1000"]
        return ["fetch", self.label, "--bring"]


def case(number: int, seed: int) -> Case:
    rng = random.Random(f"endings/{seed}/{number}")
    kinds = list(KINDS)
    turn, place = divmod(number, len(kinds))
    phase = PHASES[(place + 3 * turn) % len(PHASES)]
    if (kinds[place], phase) == ("Ctrl-Z", "start"):  # suspended before it asks, as every command is
        phase = "search"
    label = ABSENT if phase == "search" else CANS[number % len(CANS)]
    wait_s = rng.uniform(0.1, 0.9) if phase == "start" else rng.uniform(0.0, 0.6)
    return Case(number, kinds[place], phase, label, wait_s)


@dataclass
class Verdict:
    case: Case
    body_s: float = 0.0
    joints_s: float = 0.0
    claws_s: float = 0.0
    last: str = ""
    """The joint that moved last, and how far."""
    held: bool = False
    """The claws touched an object."""
    real_s: float = 0.0
    code: int | None = None
    faults: list[str] = field(default_factory=list)


async def judge(robot: Watched, one: Case, folder: Path) -> Verdict | None:
    """None when the task ended before the phase was reached."""
    out = ["--out", str(folder / f"{one.number}.jsonl")] if one.phase == "babble-arm" else []
    command = Command(robot.cocoro.environment, [*one.arguments, *out], one.kind)
    before = robot.state.task_id
    try:
        if one.phase != "start":

            def reached() -> bool:
                state = robot.state
                return state.task_id != before and (state.phase == one.phase or state.outcome is not None)

            if not await robot.until(reached) or robot.state.outcome is not None:
                return None
        await asyncio.sleep(one.wait_s)
        if one.phase != "start" and robot.state.outcome is not None:
            return None
        ended_ns = time.monotonic_ns()
        await asyncio.to_thread(KINDS[one.kind], command)
        verdict = Verdict(one)
        since_ns = robot.node.now_ns()
        await robot.until(lambda: robot.node.now_ns() > since_ns + WATCH_S * NS)
    finally:
        code = await asyncio.to_thread(command.finish)
    robot.read()
    last_ns = max(row.sim_ns for row in robot.rows if row.real_ns <= ended_ns)
    verdict.body_s = robot.body_rest_s(last_ns)
    verdict.joints_s, verdict.claws_s, verdict.last = robot.joints_rest_s(last_ns)
    verdict.held = robot.claws_touch()
    moved_ns = [row.real_ns for row in robot.rows if row.sim_ns > last_ns and row.moves_mps >= STANDING_MPS]
    verdict.real_s = (max(moved_ns, default=ended_ns) - ended_ns) / NS
    verdict.code = code
    await _judge_task(robot, verdict, before, command)
    return verdict


async def _judge_task(robot: Watched, verdict: Verdict, before: str, command: Command) -> None:
    state = await robot.report()
    begun = state.task_id != before
    if begun and state.outcome != "cancelled":
        verdict.faults.append(f"the task is {state.outcome or 'running'} ({state.reason or state.phase})")
    if verdict.case.phase != "start" and verdict.code != ENDS.get(verdict.case.kind, 3):
        verdict.faults.append(f"exit code {verdict.code}")
    if b"Traceback" in command.said:
        verdict.faults.append(command.said.decode(errors="replace"))
    if verdict.body_s > BOUND_S:
        verdict.faults.append(f"the body moved for {verdict.body_s:.3f} s")
    if max(verdict.joints_s, verdict.claws_s) > BOUND_S:
        verdict.faults.append(f"the joints moved for too long: {verdict.last}")
    following = await robot.do(PutDownTask() if robot.holding else ParkTask())
    if not following.accepted:
        verdict.faults.append(f"the next task is refused: {following.text}")


# --- the bench ------------------------------------------------------------------------------------


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="cases (60)")
    parser.add_argument("--from", dest="first", type=int, default=0, help="the number of the first case")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="", metavar="KIND", help=f"one of: {', '.join(KINDS)}")
    parser.add_argument("--phase", default="", metavar="PHASE", help=f"one of: {', '.join(PHASES)}")


def measure(chosen: argparse.Namespace, report: Report) -> None:
    numbers = range(chosen.first, chosen.first + sized(chosen, chosen.count, 60, 1))
    cases = [case(number, chosen.seed) for number in numbers]
    cases = [one for one in cases if chosen.only in one.kind and chosen.phase in one.phase]
    runs, verdicts = Runs(report), list[Verdict]()
    if cases:
        asyncio.run(_judge_all(cases, verdicts, runs, report))
    runs.share("ended well")
    rest_s = [max(verdict.body_s, verdict.joints_s, verdict.claws_s) for verdict in verdicts]
    report.value("at rest after", rest_s, "s")
    report.value("at rest after, the longest", [max(rest_s)], "s", at_most=BOUND_S)
    report.value("the body at rest after, the longest", [max(verdict.body_s for verdict in verdicts)], "s")
    report.value("the same by the machine's clock", [max(verdict.real_s for verdict in verdicts)], "s")


async def _judge_all(cases: list[Case], verdicts: list[Verdict], runs: Runs, report: Report) -> None:
    with tempfile.TemporaryDirectory(prefix="endings") as name:
        async with robot_up(Path(name)) as robot:
            await robot.until(lambda: bool(robot.truths))
            for one in cases:
                for _ in range(4):
                    robot.truths.clear()
                    if (verdict := await judge(robot, one, Path(name))) is not None:
                        verdicts.append(verdict)
                        runs.add(not verdict.faults, _line(verdict))
                        break
                    await robot.until(lambda: robot.state.outcome is not None)
                    await robot.do(PutDownTask() if robot.holding else ParkTask())
                else:
                    report.notes.append(f"case {one.number}: {one.phase} was not reached, which is no case")


def _line(verdict: Verdict) -> str:
    one, holds = verdict.case, " (hold)" if verdict.held else ""
    times = f"body {verdict.body_s:.3f} s, joints {verdict.joints_s:.3f} s, claws {verdict.claws_s:.3f} s{holds}"
    return f"{one.number:3d}: {one.kind:27s} {one.phase:10s} {times}; code {verdict.code} {'; '.join(verdict.faults)}"
