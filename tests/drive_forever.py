"""A base service in a separate process that is commanded to drive straight: `python drive_forever.py PORT`."""

from __future__ import annotations

import asyncio
import sys

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import RealClock
from cocoro.messages import BaseCommand, Latch
from cocoro.node import Node
from cocoro.robot import Robot
from services.base.service import BaseConfig, run


async def main(port: str) -> None:
    mesh, clock, robot = LocalMesh(), RealClock(), Robot.load()
    async with Node("base", mesh.join(), clock, robot) as node, Node("other", mesh.join(), clock, robot) as other:
        other.spawn(run(node, BaseConfig(port=port)))
        async for _ in other.every(50.0):
            other.publish(topics.LATCH, Latch(state="released"))
            other.publish(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.2, turn_radps=0.0))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
