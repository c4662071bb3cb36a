"""One end of what `bench.site_frames` measures: `python -m bench.site_frames_speaker ROLE OPTIONS`.

Role `body` publishes frames, states and events, and hears wheel commands; `brain` commands and hears frames; `viewer`
subscribes to everything, as a person. `OPTIONS` is one JSON object. Prints what was heard as JSON.
"""

from __future__ import annotations

import asyncio
import json
import sys
import time
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from bench.perception_scene import scene
from cocoro.bus.base import Qos
from cocoro.bus.zenoh import ZenohBus
from cocoro.clock import RealClock
from cocoro.lending import LendingLoop
from cocoro.messages import BaseCommand, BaseState, Exchange, Frame
from cocoro.node import Node
from cocoro.robot import Robot
from cocoro.topics import BASE_COMMAND, BASE_STATE, EXCHANGES, FRAME
from deploy.rundir import RunDir
from deploy.site import access

SETTLE_S = 3.0
"""From the first frame until the first figure counts."""
LONGEST_S = 40.0
"""Longest wait for the first frame."""
SILENT_S = 2.0
"""After so long without a command the body ends."""
STATE_HZ = COMMAND_HZ = 50.0
EVENTS_EVERY = 5
"""One event for so many states."""
EVENT_BYTES = 20_000
"""More than a link of 1 Mbit/s carries, with so many of them."""


async def body(node: Node, options: dict[str, Any]) -> dict[str, Any]:
    """Publishes until no command comes any more; returns the periods of commands as they arrived, s."""
    shown = scene(node.robot, 16, 4, (options["width"], options["height"])).frames
    commands: list[float] = []
    node.on(BASE_COMMAND, lambda _: commands.append(time.monotonic()))
    states, frames = node.publisher(BASE_STATE), node.publisher(FRAME)
    events = node.publisher(EXCHANGES.of("kinect"))
    begun_s = time.monotonic()
    number, due_s = 0, 0.0
    while (now_s := time.monotonic()) < (commands[-1] if commands else begun_s + LONGEST_S) + SILENT_S:
        states.put(BaseState(odometry_m=(0.0, 0.0), odometry_yaw_rad=0.0, speed_mps=0.0, turn_rate_radps=0.0))
        if number % EVENTS_EVERY == 0:
            events.put(Exchange(request="bench", question="x" * EVENT_BYTES))
        if now_s >= due_s:
            due_s = max(due_s + 1 / options["frame_hz"], now_s)
            shot = shown[number % len(shown)]
            frames.put(Frame(width=shot.width, height=shot.height, colour=shot.colour, depth=shot.depth))
        number += 1
        await asyncio.sleep(max(0.0, begun_s + number / STATE_HZ - time.monotonic()))
    counted = [at_s for at_s in commands if at_s > commands[-1] - options["seconds"]]
    return {"periods": [after - before for before, after in pairwise(counted)]}


async def brain(node: Node, options: dict[str, Any]) -> dict[str, Any]:
    """Commands until it has heard frames for the given time; returns the ages of frames and of states at their arrival,
    s, and the frames' widths."""
    heard: dict[str, list[float]] = {"ages": [], "widths": [], "states": []}
    first: list[float] = []

    def counts() -> bool:
        return bool(first) and time.monotonic() > first[0] + SETTLE_S

    def on_frame(frame: Frame) -> None:
        first[:] = first or [time.monotonic()]
        if counts():
            heard["ages"].append((node.now_ns() - frame.stamp_ns) / 1e9)
            heard["widths"].append(frame.width)

    def on_state(state: BaseState) -> None:
        if counts():
            heard["states"].append((node.now_ns() - state.stamp_ns) / 1e9)

    node.on(FRAME, on_frame)
    node.on(BASE_STATE, on_state)
    commands = node.publisher(BASE_COMMAND)
    begun_s = time.monotonic()
    number = 0
    while time.monotonic() < (first[0] + SETTLE_S + options["seconds"] if first else begun_s + LONGEST_S):
        commands.put(BaseCommand(ahead_mps=0.1, turn_radps=0.0))
        number += 1
        await asyncio.sleep(max(0.0, begun_s + number / COMMAND_HZ - time.monotonic()))
    return heard


async def viewer(options: dict[str, Any]) -> dict[str, Any]:
    """Subscribes to everything, until it is ended."""
    config = access.way(options["way"], options["robot"], "bench").config
    async with await ZenohBus.open(replace(config, patience_s=10.0), expect_mesh=True) as bus:
        bus.subscribe(f"{options['robot']}/**", Qos.STATE, lambda _key, _payload: None, depth=256)
        await asyncio.Event().wait()
    return {}


async def speak(role: str, options: dict[str, Any]) -> dict[str, Any]:
    if role == "viewer":
        return await viewer(options)
    run_dir = RunDir(options["robot"], Path(options["run"]))
    name = "planning" if role == "brain" else "kinect"
    async with (
        await ZenohBus.open(run_dir.join_as(f"speaker-{role}", frames=True)) as bus,
        Node(name, bus, RealClock(0), Robot.load(), robot_name=options["robot"]) as node,
    ):
        return await (brain if role == "brain" else body)(node, options)


def main() -> None:
    role, options = sys.argv[1], json.loads(sys.argv[2])
    with asyncio.Runner(loop_factory=LendingLoop) as runner:
        print(json.dumps(runner.run(speak(role, options))), flush=True)


if __name__ == "__main__":
    main()
