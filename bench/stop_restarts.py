"""Checks that a stopped robot stays stopped over restarts: `python -m bench stop-restarts [--count 50]`.

Stops the robot, kills supervisor, executive and hardware in random order, starts it again, and asks for a fetch: each
time all that moves must be latched, and the fetch refused. One in five is a robot of the profile `sim-wire`.

Runs as root in separate mount and network namespaces, as `python -m bench stop` does.
"""

from __future__ import annotations

import argparse
import asyncio
import random
import signal
import time
from typing import Any

from bench.report import Report
from bench.stop_rig import PATIENCE_S, Place, in_namespaces, place
from bench.trials import Runs, number_of, sized
from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import FollowedClock
from cocoro.messages import TaskRequest
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import Topic
from deploy.rundir import Target
from services.executive.tasks import FetchTask


async def _still_latched(here: Place) -> str:
    """The fault of the latch of a restarted robot; '' when it is latched."""
    async with (
        await ZenohBus.open(here.run_dir.join_as("bench")) as bus,
        Node("tester", bus, FollowedClock(), Robot.load()) as node,
    ):
        states: dict[str, str] = {}
        node.on(topics.BASE_STATE, lambda state: states.update(base=state.latch))
        node.on(topics.ARM_STATE, lambda state: states.update(arm=state.latch))
        node.on(topics.HAND_STATE, lambda state: states.update(hand=state.latch))
        reporting: tuple[Topic[Any], ...] = (topics.BASE_STATE, topics.ARM_STATE, topics.HAND_STATE)
        for topic in reporting:
            await asyncio.wait_for(node.latest(topic).next(), PATIENCE_S)
        await asyncio.sleep(1.5)  # longer than the executive takes to believe a cold start
        reply = await node.call(topics.RUN, TaskRequest(task=FetchTask(label="red_can")), 10.0)
        if reply.accepted or set(states.values()) != {"latched"}:
            return f"{states}, a fetch was {reply.refusal or 'accepted'}"
    return ""


def _kill(here: Place, who: str) -> None:
    file = here.run_dir.path / "supervisor" if who == "supervisor" else here.run_dir.path / "claims" / who
    target = Target(file)
    target.signal(signal.SIGKILL)
    target.wait(10.0)
    target.close()


def options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--count", type=number_of, help="stops and restarts (50)")
    parser.add_argument("--seed", type=int, default=0)


def measure(chosen: argparse.Namespace, report: Report) -> None:
    in_namespaces()
    draws, runs = random.Random(chosen.seed), Runs(report)
    for number in range(sized(chosen, chosen.count, 50, 1)):
        profile = "sim-wire" if number % 5 == 4 else "sim"
        with place() as here:
            here.up(profile, "--frames", "160x120@10")
            code, said = here.run("stop", "--json")
            order = ["supervisor", "executive", "base", *(["arm"] if profile == "sim-wire" else [])]
            draws.shuffle(order)
            order = order[: draws.randint(1, len(order))]
            for who in order:
                time.sleep(draws.choice((0.0, 0.0, 0.05, 0.3, 1.0)))  # a random moment of the restart
                _kill(here, who)
            if "supervisor" in order:
                here.up(profile, "--frames", "160x120@10")
            wrong = asyncio.run(_still_latched(here)) or ("" if code == 0 else said)
        runs.add(not wrong, f"{number + 1:3d} {profile}: killed {', '.join(order)}: {wrong or 'latched'}")
    runs.share("latched after the restart")
