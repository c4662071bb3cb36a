"""The base and servo services in one process, with commands that keep the robot moving.

`python -m bench.hardware_driver CREATE ARM HAND`, started by the bench `hardware-faults`. It prints the contents of
`cocoro status` ten times a second, each as a JSON line, and accepts {"do": "recover"} and {"do": "clear"}.
"""

from __future__ import annotations

import asyncio
import json
import os
import sys
import threading
import time

from cocoro import topics
from cocoro.bus.local import LocalMesh
from cocoro.clock import RealClock
from cocoro.errors import CocoroError
from cocoro.messages import BaseState, Health, Latch, RecoverRequest, ServoCommand, ServoRequest
from cocoro.node import Node
from cocoro.robot import Robot
from services.base.service import BaseConfig
from services.base.service import run as run_base
from services.servos.service import ServosConfig
from services.servos.service import run as run_servos

WHEELS = ((0.2, 0.2), (0.12, 0.06), (-0.06, 0.06))
"""Wheel speeds, m/s, commanded in turn."""
REACH_RAD = {"elbow": 0.4, "shoulder": 0.3, "claw_left": 0.2}
"""Joints that move to and fro, with their amplitudes, rad."""
SPEED_RADPS = 0.6
STEP_S = 0.7
REPLY_S = 0.05


class Driver:
    def __init__(self, node: Node) -> None:
        self._node = node
        self._faults: dict[str, tuple[str, ...]] = {}
        self._base: BaseState | None = None
        for service in ("base", "arm", "hand"):
            node.on(topics.HEALTH, self._heard, service=service)
        node.on(topics.BASE_STATE, self._moved)

    def _heard(self, health: Health) -> None:
        self._faults[health.service] = health.faults

    def _moved(self, state: BaseState) -> None:
        self._base = state

    async def drive(self) -> None:
        node = self._node
        async for _ in node.every(50.0):
            step = int(time.monotonic() / STEP_S)
            left_mps, right_mps = WHEELS[step % len(WHEELS)]
            node.publish(topics.LATCH, Latch(state="released"))
            node.publish(topics.BASE_COMMAND, node.robot.drive.command_of((left_mps, right_mps)))
            sign = 1.0 if step % 2 else -1.0
            for topic, joints in ((topics.ARM_COMMAND, ("elbow", "shoulder")), (topics.HAND_COMMAND, ("claw_left",))):
                goals = tuple(sign * REACH_RAD[joint] for joint in joints)
                command = ServoCommand(joints=joints, goal_rad=goals, speed_radps=(SPEED_RADPS,) * len(joints))
                node.publish(topic, command)

    async def tell(self) -> None:
        async for _ in self._node.every(10.0):
            faults = [f"{service}: {fault}" for service, found in self._faults.items() for fault in found]
            print(
                json.dumps({"faults": faults, "stopped_by": self._base.stopped_by if self._base else "?"}), flush=True
            )

    async def obey(self, question: str) -> None:
        try:
            if question == "recover":
                await self._node.call(topics.RECOVER, RecoverRequest())
            else:
                for network in ("arm", "hand"):
                    await self._node.call(topics.SERVOS.of(network), ServoRequest(action="clear"))
        except CocoroError:
            pass  # it is requested again while it is needed


async def main(create: str, arm: str, hand: str) -> None:
    mesh, clock, robot = LocalMesh(), RealClock(), Robot.load()
    loop = asyncio.get_running_loop()
    async with (
        Node("base", mesh.join(), clock, robot, health_hz=10.0) as base,
        Node("servos", mesh.join(), clock, robot, health_hz=10.0) as servos,
        Node("driver", mesh.join(), clock, robot) as node,
    ):
        driver = Driver(node)

        def listen() -> None:
            for line in sys.stdin:
                question = json.loads(line)["do"]
                asyncio.run_coroutine_threadsafe(driver.obey(question), loop)
            os._exit(0)  # the parent process has ended

        threading.Thread(target=listen, daemon=True).start()
        async with asyncio.TaskGroup() as group:
            group.create_task(run_base(base, BaseConfig(port=create)))
            group.create_task(run_servos(servos, ServosConfig(ports={"arm": arm, "hand": hand}, reply_s=REPLY_S)))
            group.create_task(driver.drive())
            group.create_task(driver.tell())


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
