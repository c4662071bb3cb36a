"""A fetch over zenoh processes in real time, with perception and planning as services or in lock-step."""

from __future__ import annotations

import asyncio
import json
import time
from contextlib import AsyncExitStack
from functools import partial
from itertools import pairwise
from typing import Any, NamedTuple

import msgspec

from apps.rehearsal.lockstep import LOCKSTEP_PLANNER, LOCKSTEP_SETTINGS, LockstepCycle, LockstepNode
from bench.live import NAME, Fetched, Operator, operator
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import FollowedClock
from cocoro.component import load
from cocoro.messages import BaseCommand
from cocoro.node import Node
from cocoro.robot import Robot
from deploy.processes import named
from sim.judge import HELD_S, Judge
from sim.random_scene import find_scene

LABEL = "green_can"


class LiveRun(NamedTuple):
    """A fetch in real time."""

    outcome: str
    """What the command printed last."""
    held: bool
    """By the simulator's truth, with nothing knocked over."""
    seconds: float
    """Time of the task, simulated seconds."""
    periods_ms: list[float]
    """Between successive wheel commands, by their stamps."""


async def live_fetch(time_s: float, *, lockstep: bool) -> LiveRun:
    """Start a simulated robot with real sensors, fetch the green can, and judge it. `time_s` is perception's, s. In
    lock-step, this process runs perception and planning, one after the other."""
    with operator() as cocoro:
        profile = cocoro.run_dir.path.parent / "bench.toml"
        profile.parent.mkdir(parents=True, exist_ok=True)
        profile.write_text(_profile(time_s, lockstep=lockstep))
        code, said, _ = await asyncio.to_thread(cocoro, "up", str(profile), "--detach")
        if code:
            return LiveRun(f"it did not start: {said.strip()}", False, 0.0, [])
        async with AsyncExitStack() as stack:
            cycle = asyncio.ensure_future(_in_lockstep(cocoro, time_s)) if lockstep else None
            try:
                return await _fetch(cocoro, stack)
            finally:
                if cycle is not None:
                    cycle.cancel()
                    await asyncio.gather(cycle, return_exceptions=True)


def _profile(time_s: float, *, lockstep: bool) -> str:
    """The text of a profile. Without lock-step perception and planning are processes of their own."""
    processes = ["sim", "executive"] if lockstep else ["sim", "perception", "planning", "executive"]
    settings: dict[str, dict[str, Any]] = {"sim": {"sensors": "real"}}
    if lockstep:
        settings["sim"] |= LOCKSTEP_SETTINGS["sim"]
        settings["executive"] = LOCKSTEP_SETTINGS["executive"]
    else:
        settings["perception"] = {"latency_s": time_s}
    lines = [f'robot = "{NAME}"', 'clock = "sim"', f"processes = {json.dumps(processes)}"]
    for name, table in settings.items():
        lines += [f"[service.{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
    return "\n".join(lines) + "\n"


async def _in_lockstep(cocoro: Operator, time_s: float) -> None:
    """Perception and planning in this process, stepped in turn."""
    robot, cycle = Robot.load(), LockstepCycle()
    async with AsyncExitStack() as stack:
        services = []
        for name in LockstepCycle.ORDER:
            row = LOCKSTEP_PLANNER if name == "planning" else named(name)
            component = load(row)
            bus = await stack.enter_async_context(await ZenohBus.open(cocoro.run_dir.join_as(name)))
            make = partial(LockstepNode, cycle=cycle, latency_s=time_s if name == "perception" else 0.0)
            config = msgspec.convert({}, component.config)
            node = make(name, bus, FollowedClock(), robot, robot_name=NAME, module=row.module, config=config)
            await stack.enter_async_context(node)
            services.append(asyncio.ensure_future(component.run(node, config)))
        try:
            await asyncio.gather(*services)
        finally:
            for service in services:
                service.cancel()
            await asyncio.gather(*services, return_exceptions=True)


async def _fetch(cocoro: Operator, stack: AsyncExitStack) -> LiveRun:
    judge, stamps = Judge(Robot.load(), find_scene("paper", 0, LABEL), LABEL), list[int]()
    bus = await stack.enter_async_context(await ZenohBus.open(cocoro.run_dir.join_as("bench")))
    node = await stack.enter_async_context(Node("bench", bus, FollowedClock(), Robot.load(), robot_name=NAME))
    node.on(topics.TRUTH, judge.feed)
    process = await asyncio.to_thread(cocoro.start, "fetch", LABEL)

    def commanded(command: BaseCommand) -> None:
        stamps.append(command.stamp_ns)

    node.on(topics.BASE_COMMAND, commanded)
    begun_s = time.monotonic()
    said, _ = await asyncio.to_thread(process.communicate)
    ended, seconds = len(stamps), time.monotonic() - begun_s
    await asyncio.sleep(HELD_S + 0.5)
    truth = judge.result()
    fetched = Fetched(process.returncode, said, seconds, truth)
    periods = [(later - earlier) / 1e6 for earlier, later in pairwise(stamps[:ended])]
    held = fetched.code == 0 and truth.held and not truth.knocked_over
    return LiveRun(fetched.last_line, held, fetched.task_s or 0.0, periods)
