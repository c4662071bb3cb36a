"""Replaces planner and executive of a running robot: releases its base and drives it straight at 0.2 m/s.

`python drive_on_mesh.py ROBOT`
"""

from __future__ import annotations

import asyncio
import sys

from cocoro import topics
from cocoro.bus.zenoh import ZenohBus
from cocoro.messages import BaseCommand, Latch
from cocoro.node import Node
from cocoro.robot import Robot
from deploy import robot_time
from deploy.rundir import RunDir


async def main(name: str) -> None:
    run_dir = RunDir(name)
    clock = robot_time.clock(run_dir.path)
    async with (
        await ZenohBus.open(run_dir.join_as("planning"), expect_mesh=True) as bus,
        Node("planning", bus, clock, Robot.load(), robot_name=name) as node,
    ):
        node.ready()
        async for _ in node.every(50.0):
            node.publish(topics.LATCH, Latch(state="released"))
            node.publish(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.2, turn_radps=0.0))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
