"""A fetch over a site that is disturbed at a random moment of one of its phases, and what came of it."""

from __future__ import annotations

import asyncio
import random
import time
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path

from bench.fault_robot import STANDING_MPS
from bench.site_lab import ROBOT, Lab
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import NS, FollowedClock
from cocoro.messages import TaskState
from cocoro.node import Node
from cocoro.robot import Robot
from sim.judge import HELD_S, Judge, Verdict
from sim.motion import read_motion
from sim.random_scene import find_scene

PHASES = ("search", "approach", "reach", "grasp", "lift", "hold")
LONGEST_IN_S = {"search": 0.3, "approach": 2.0, "reach": 0.5, "grasp": 0.5, "lift": 0.7, "hold": 1.5}
"""The disturbance comes at a random moment of this long from the beginning of its phase."""
PHASE_S = 40.0
"""Longest wait for a phase."""
END_S = 150.0


@dataclass(frozen=True)
class Disturbed:
    """What came of a fetch."""

    code: int
    said: str
    stand_s: float
    """From the disturbance until the body stood, as long as that lasted."""
    truth: Verdict

    @property
    def last_line(self) -> str:
        return (self.said.partition("\nrecorded in ")[0].strip().splitlines() or ["it said nothing"])[-1]

    @property
    def harmless(self) -> bool:
        """Nothing was knocked over or run into."""
        return not self.truth.knocked_over and not self.truth.collisions

    @property
    def done(self) -> bool:
        return self.harmless and self.code == 0 and self.truth.held


async def disturbed_fetch(
    site: Lab, motion: Path, phase: str, rng: random.Random, disturb: Callable[[], Awaitable[None]]
) -> Disturbed | None:
    """One fetch by the operator. `disturb` begins a disturbance, and returns when it is over. None when the phase did
    not come."""
    judge = Judge(Robot.load(), find_scene("paper", 0, "red_can"), "red_can")
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
        begun_ns = time.monotonic_ns()
        await disturb()
        over_ns = time.monotonic_ns()
        said, _ = await asyncio.to_thread(process.communicate, timeout=END_S)
        await asyncio.sleep(HELD_S + 0.5)
    rows = [row for row in read_motion(motion, 0) if begun_ns < row.real_ns < over_ns]
    moving = [row.real_ns for row in rows if row.moves_mps >= STANDING_MPS]
    stand_s = (moving[-1] - begun_ns) / NS if moving else 0.0
    return Disturbed(process.returncode, said, stand_s, judge.result())
