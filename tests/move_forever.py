"""A servo service in a separate process that turns the elbow: `python move_forever.py ARM HAND PROTOCOL`."""

from __future__ import annotations

import asyncio
import sys

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import RealClock
from cocoro.messages import Latch, ServoCommand
from cocoro.node import Node
from cocoro.robot import Robot
from services.servos.service import ServosConfig, run


async def main(arm: str, hand: str, protocol: str) -> None:
    mesh, clock = LocalMesh(), RealClock()
    robot = Robot.load().with_networks(protocol=protocol)
    async with Node("servos", mesh.join(), clock, robot) as node, Node("other", mesh.join(), clock, robot) as other:
        other.spawn(run(node, ServosConfig(ports={"arm": arm, "hand": hand}, reply_s=0.1)))
        async for _ in other.every(50.0):
            other.publish(topics.LATCH, Latch(state="released"))
            other.publish(topics.ARM_COMMAND, ServoCommand(joints=("elbow",), goal_rad=(2.5,), speed_radps=(0.5,)))


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
