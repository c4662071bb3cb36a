"""A LeKiwi's line service in a separate process, commanded to drive ahead: `python drive_wheels_forever.py PORT`."""

from __future__ import annotations

import asyncio
import sys
from pathlib import Path

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import RealClock
from cocoro.messages import BaseCommand, Latch
from cocoro.node import Node
from cocoro.robot import Robot
from services.servos.mobile import run
from services.servos.service import ServosConfig


async def main(port: str) -> None:
    mesh, clock, robot = LocalMesh(), RealClock(), Robot.load(Path("lekiwi"))
    config = ServosConfig(ports={"bus": port}, reply_s=0.1)
    async with (
        Node("servos-base", mesh.join(), clock, robot) as node,
        Node("other", mesh.join(), clock, robot) as other,
    ):
        other.spawn(run(node, config))
        async for _ in other.every(50.0):
            other.publish(topics.LATCH, Latch(state="released"))
            other.publish(topics.BASE_COMMAND, BaseCommand(ahead_mps=0.1, turn_radps=0.0))


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1]))
