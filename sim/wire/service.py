"""The simulator as the hardware itself: camera and clock on the mesh, base and servos at the ends of emulated wires.

The services of base and servos are the real ones; they open the ports that this puts into the robot's run directory.
"""

from __future__ import annotations

import asyncio
import os
import select
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from cocoro.component import Implementation
from cocoro.errors import CocoroError
from cocoro.node import Node
from cocoro.ports import wire_dir
from cocoro.robot import Robot
from sim.camera import Kinect
from sim.service import SimConfig, Simulator, keep_going, make_kinect, make_world
from sim.wire.dynamixel import Motor
from sim.wire.link import Channel, Orders, Senses, ServoSetup, Setup
from sim.wire.motors import WireMotors
from sim.world import World

MODELS = {"arm": 28, "hand": 12}
START_S, END_S = 30.0, 3.0


class WireSimulator(Simulator):
    """A simulator whose motors are driven by firmware in another process."""

    def __init__(
        self, node: Node, config: SimConfig, world: World, kinect: Kinect, motors: WireMotors, channel: Channel
    ) -> None:
        super().__init__(node, config, world, kinect)
        self._motors = motors
        self._channel = channel

    def tick(self) -> None:
        orders = self._channel.newest(Orders)
        if orders is not None:
            self._obey(orders)
        if not self._channel.open:
            raise CocoroError("the emulated firmware has ended")
        super().tick()
        self._tell()

    def _obey(self, orders: Orders) -> None:
        self._motors.base.asked_mps = orders.left_mmps / 1000.0, orders.right_mmps / 1000.0
        for number, order in orders.motors.items():
            self._motors.servos[number].motor = Motor(
                order.on, order.goal, order.speed, order.limit, order.slope, order.punch
            )

    def _tell(self) -> None:
        base = self._motors.base
        left_m, right_m = base.counted_m
        self._channel.send(
            Senses(
                self._world.time_ns,
                left_m,
                right_m,
                base.bumper.left,
                base.bumper.right,
                {number: servo.senses for number, servo in self._motors.servos.items()},
            )
        )


def setup_of(robot: Robot, motors: WireMotors, seed: int) -> Setup:
    lines = {
        name: [
            ServoSetup(joint.id, MODELS[name], joint.overload_s, motors.servos[joint.id].count)
            for joint in (robot.joints[row] for row in robot.network_joints(name))
        ]
        for name in MODELS
    }
    return Setup(robot.base.wheel_separation_m * 1000.0, lines, seed)


@contextmanager
def firmware_process(folder: Path, setup: Setup) -> Iterator[Channel]:
    """Start the firmware's process; it has ended when this context has."""
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    command = [sys.executable, "-P", "-m", "sim.wire.process", str(folder), "--fd", str(theirs.fileno())]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(Path(__file__).parents[2]), *sys.path[1:]])}
    with theirs:
        process = subprocess.Popen(command, env=environment, pass_fds=(theirs.fileno(),), stdin=subprocess.DEVNULL)
    channel = Channel(ours)
    try:
        channel.send(setup)
        yield channel
    finally:
        channel.close()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()


async def run(node: Node, config: SimConfig) -> None:
    """Simulate for ever."""
    motors = WireMotors()
    folder = wire_dir(node.robot_name)
    with make_world(node.robot, config, motors.make) as world:
        kinect = make_kinect(node.robot, config, world)
        with firmware_process(folder, setup_of(node.robot, motors, config.seed)) as channel:
            simulator = WireSimulator(node, config, world, kinect, motors, channel)
            async with node.sibling("kinect") as camera:
                simulator.connect_camera(camera)
                await asyncio.to_thread(select.select, [channel], [], [], START_S)  # its first orders: it is there
                simulator.tell_time()
                for part in (node, camera):
                    part.ready(f"simulated behind wires, scene {world.scene.name}, {config.sensors} sensors")
                await keep_going(node, config, simulator)


implementation = Implementation(SimConfig, run)
