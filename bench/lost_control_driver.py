"""The driver that `bench.lost_control` loses: `python -m bench.lost_control_driver ROBOT FILE`.

Waits for a line on standard input; then asks the robot for the task `drive`, turns round, and drives ahead at full
speed. Appends to FILE the time (CLOCK_MONOTONIC, ns, 8 bytes) at which each request was sent whose motion was
accepted. The next line ends that: `freeze` stops asking as a frozen program does, `let-go` asks for rest. Standard
error tells why the robot does what it does.
"""

from __future__ import annotations

import asyncio
import os
import struct
import sys
import time
from pathlib import Path

from apps.cli.link import MeshLink, joined
from apps.client.choice import RobotChoice
from cocoro.driving import Driving, begin
from cocoro.errors import CocoroError
from cocoro.keys import asker_key
from cocoro.messages import Motion
from cocoro.topics import PLAN

SENT = struct.Struct("<q")
TURN_S = 2.2
TURN = Motion(turn_radps=1.5)
FAST = Motion(speed_mps=1.0)
PATIENCE_S = 40.0


class NotedDriving(Driving):
    """Notes when what was accepted was sent."""

    def __init__(self, link: MeshLink, task_id: str, file: Path) -> None:
        super().__init__(link, task_id)
        self._file = file.open("ab", buffering=0)

    async def _ask(self, motion: Motion) -> None:
        sent_ns = time.monotonic_ns()
        await super()._ask(motion)
        if self.reply.accepted and motion.base:
            self._file.write(SENT.pack(sent_ns))

    def freeze(self) -> None:
        """Ask for nothing any more."""
        assert self._work is not None
        self._work.cancel()


async def _task(link: MeshLink, asker: str) -> str:
    """The id of the task, once it is accepted. Raises TimeoutError."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                reply = await begin(link, asker=asker, instead=True)
                if reply.accepted:
                    return reply.task_id
                print(reply.text, file=sys.stderr)
            except CocoroError as error:
                print(error, file=sys.stderr)
            await asyncio.sleep(0.2)


async def main(robot: str, file: Path) -> None:
    """Drive from the first line on until the next one says what else to do, and for ever then."""
    loop = asyncio.get_running_loop()
    await loop.run_in_executor(None, sys.stdin.readline)
    said = loop.run_in_executor(None, sys.stdin.readline)
    async with joined(RobotChoice(robot, None)) as link:
        asker = f"driver-{os.getpid()}"
        link.bus.declare_alive(asker_key(link.robot, asker))
        plan = link.latest(PLAN)
        driving = NotedDriving(link, await _task(link, asker), file)
        async with driving:
            begun_s = time.monotonic()
            told = ""
            while not said.done():
                why = driving.trouble or driving.reply.text or (plan.value.why if plan.value is not None else "")
                if (word := why.partition(",")[0]) != told:
                    told = word
                    print(why, file=sys.stderr, flush=True)
                driving.motion = TURN if time.monotonic() - begun_s < TURN_S else FAST
                await asyncio.sleep(0.04)
            if (await said).strip() == "freeze":
                driving.freeze()
            else:
                driving.motion = Motion()
            await asyncio.sleep(3600.0)


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], Path(sys.argv[2])))
