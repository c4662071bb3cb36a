"""The simulator behind wires: the real drivers talk to emulated firmware, which drives the PyBullet robot's motors."""

from __future__ import annotations

import asyncio
import select
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import copysign, radians
from pathlib import Path

from cocoro.base import Base
from cocoro.child import ChildProcess, wait_or_kill
from cocoro.component import Implementation
from cocoro.errors import CocoroError, ConfigError
from cocoro.joints import GROUPS, Group, Joint
from cocoro.node import Node
from cocoro.omni import OmniWheel, WheelServo
from cocoro.ports import wire_dir
from cocoro.robot import Robot
from cocoro.servo_units import UNITS, Protocol
from sim.base import MobileBase
from sim.camera import SimKinect
from sim.mechanism import WHEEL_TORQUE_NM
from sim.realism import BodyRealism
from sim.service import SimConfig, Simulator, keep_going, make_kinect, make_world
from sim.servos import Drive, SimServo, SimServoGroup
from sim.wire.firmware import Channel, MotorOrders, PlantState, ServoSetup, Setup
from sim.wire.models import WHEEL_OVERLOAD_S, model_of, servos_on_lines
from sim.wire.servo import Motor
from sim.world import Motors, World

LIMP_SHARE = 0.05
"""Friction of a limp servo's gears, as a share of its stall torque."""
LIMP_RADPS = 1.0
FULL_RADPS = 12.0
"""Speed of a servo whose speed register is 0: the joint's own limit is below."""


class WireServo(SimServo):
    """A servo whose motor is driven by registers."""

    def __init__(self, joint: Joint, angle_rad: float, backlash_rad: float) -> None:
        super().__init__(joint, angle_rad, backlash_rad)
        # It holds until the firmware sends orders, so that the robot keeps its posture.
        self.motor = Motor(on=True, goal=self.goal_count, speed=0, limit=1.0, slope=1, punch=1.0)

    def drive(self, speed_factor: float = 1.0) -> Drive:
        motor, joint = self.motor, self.joint
        if not motor.on or motor.limit <= 0.0:
            return Drive(self.angle_rad, LIMP_RADPS, LIMP_SHARE * joint.torque_nm)
        error_counts = motor.goal - self.count
        share = min(max(abs(error_counts) / motor.slope, motor.punch), 1.0)
        asked_radps = motor.speed * joint.units.speed_radps or FULL_RADPS
        speed_radps = min(asked_radps * speed_factor, joint.max_speed_radps)
        error_rad = joint.to_angle(motor.goal) - self._play.shaft_rad
        return Drive(self.angle_rad + error_rad, speed_radps, joint.torque_nm * motor.limit * share)

    @property
    def measurements(self) -> tuple[int, int, float]:
        """Position (counts), speed (the servo's unit) and load (share of stall torque), as the servo turns."""
        sign = self.joint.direction
        return self.count, round(sign * self.speed_radps / self.joint.units.speed_radps), sign * self.load


class WireGroup(SimServoGroup):
    """Servos that are driven only by registers: the driver handles commands, expiry and the emergency stop."""

    def __init__(self, joints: Mapping[str, Joint], angles_rad: Mapping[str, float], backlash_deg: float) -> None:
        super().__init__(joints, angles_rad, keeps_goal=True, timeout_s=0.0, backlash_deg=backlash_deg)
        self.wired = {
            joint.id: WireServo(joint, angles_rad[name], radians(backlash_deg)) for name, joint in joints.items()
        }
        self.servos.update({servo.joint.name: servo for servo in self.wired.values()})


class WireBase(MobileBase):
    """Wheels that turn at the speeds of the Create's firmware, with its ramp."""

    def __init__(self, base: Base) -> None:
        super().__init__(base, exact=True)
        self.asked_mps = (0.0, 0.0)
        self.counted_m = [0.0] * len(base.drive.names)
        """Distance that each wheel's encoder has measured since the start."""

    def rolled(self, rolled_m: Sequence[float], now_ns: int, dt_s: float) -> None:
        self.counted_m = [counted + rolled for counted, rolled in zip(self.counted_m, rolled_m, strict=True)]

    def _allowed_mps(self, now_ns: int) -> tuple[float, ...]:
        return self.asked_mps


class WireWheel:
    """A wheel that is turned by a servo in its endless mode."""

    def __init__(self, wheel: OmniWheel, servo: WheelServo, protocol: Protocol) -> None:
        units = UNITS[protocol]
        self.number = servo.id
        self.protocol = protocol
        self.motor = Motor(on=False, goal=0, speed=0, limit=1.0, slope=1, punch=1.0, endless=0)
        self._metres_a_count = servo.direction * units.count_rad * wheel.radius_m
        self._metres_a_speed = servo.direction * units.speed_radps * wheel.radius_m
        self._start = round(units.centre_count)
        self.sign = servo.direction
        self.blocked = False
        """Whether something holds it."""
        self.mps = 0.0
        """At which it is driven now."""
        self._rolled_m = self._rolls_mps = self.load = 0.0

    @property
    def place(self) -> int:
        """Of its shaft, counts, with all its turns."""
        return self._start + round(self._rolled_m / self._metres_a_count)

    @property
    def measurements(self) -> tuple[int, int, float]:
        """Place (counts), speed (the servo's unit) and load (share of stall torque)."""
        return self.place, round(self._rolls_mps / self._metres_a_speed), self.load

    def drive(self, top_mps: float, dt_s: float) -> float:
        """Advance its speed by one step: its servo has a ramp of its own, and one that is limp is braked by its gears.
        Returns the speed, m/s."""
        motor = self.motor
        pushes = motor.on and motor.limit > 0.0
        asked_mps = (motor.endless or 0) * self._metres_a_speed if pushes else 0.0
        change_mps = min(max(asked_mps, -top_mps), top_mps) - self.mps
        reach_mps = motor.acceleration * abs(self._metres_a_speed) * dt_s if motor.acceleration else abs(change_mps)
        self.mps += copysign(min(abs(change_mps), reach_mps), change_mps)
        if self.blocked:
            self.mps = 0.0
        return self.mps

    def sense(self, rolled_m: float, torque_nm: float, dt_s: float) -> None:
        """Take what the wheel did in the step that ended now."""
        self._rolled_m += rolled_m
        self._rolls_mps = rolled_m / dt_s
        self.load = self.sign * min(max(torque_nm / WHEEL_TORQUE_NM, -1.0), 1.0)


class WireServoBase(WireBase):
    """Wheels that turn as the registers of their servos say."""

    def __init__(self, robot: Robot) -> None:
        super().__init__(robot.base)
        servos = ((wheel, wheel.servo) for wheel in robot.base.wheel)
        self.turned = [
            WireWheel(wheel, servo, robot.networks[servo.network].protocol)
            for wheel, servo in servos
            if servo is not None
        ]
        self._torques_nm: Sequence[float] = [0.0] * len(self.turned)

    def wheels(self, now_ns: int, dt_s: float) -> tuple[float, ...]:
        top_mps = self._base.max_wheel_speed_mps
        self.ramp.wheels_mps = tuple(wheel.drive(top_mps, dt_s) for wheel in self.turned)
        return self.ramp.wheels_mps

    def strained(self, torques_nm: Sequence[float]) -> None:
        self._torques_nm = torques_nm

    def rolled(self, rolled_m: Sequence[float], now_ns: int, dt_s: float) -> None:
        super().rolled(rolled_m, now_ns, dt_s)
        for wheel, way_m, torque_nm in zip(self.turned, rolled_m, self._torques_nm, strict=True):
            wheel.sense(way_m, torque_nm, dt_s)


class WireMotors:
    """Makes a world's motors by `make`, and keeps references to them."""

    base: WireBase
    servos: dict[int, WireServo]
    wheels: dict[int, WireWheel]
    """Of a base whose wheels are turned by servos, by their IDs."""

    def make(self, robot: Robot, angles_rad: Mapping[str, float], realism: BodyRealism) -> Motors:
        groups: dict[Group, SimServoGroup] = {}
        self.servos, self.wheels = {}, {}
        if robot.wheel_line is None:
            self.base = WireBase(robot.base)
        else:
            self.base = base = WireServoBase(robot)
            self.wheels = {wheel.number: wheel for wheel in base.turned}
        for name in GROUPS:
            joints = {joint: robot.joints[joint] for joint in robot.group_joints(name)}
            groups[name] = group = WireGroup(joints, angles_rad, realism.backlash_deg)
            self.servos |= group.wired
        return Motors(self.base, groups)

    def obey(self, orders: MotorOrders) -> None:
        """Do as the firmware says."""
        self.base.asked_mps = orders.left_mmps / 1000.0, orders.right_mmps / 1000.0
        for number, order in orders.motors.items():
            driven = self.servos.get(number) or self.wheels[number]
            driven.motor = Motor(
                order.on, order.goal, order.speed, order.limit, order.slope, order.punch, order.endless,
                order.acceleration,
            )  # fmt: skip

    def state(self, time_ns: int) -> PlantState:
        """What the firmware's sensors measure."""
        base = self.base
        left_m, right_m = (0.0, 0.0) if self.wheels else base.counted_m
        driven: dict[int, WireServo | WireWheel] = {**self.servos, **self.wheels}
        shafts = {number: one.measurements for number, one in driven.items()}
        return PlantState(time_ns, left_m, right_m, base.bumper.left, base.bumper.right, shafts)


START_S, END_S = 30.0, 3.0


class WireSimulator(Simulator):
    """A simulator whose motors are driven by firmware in another process."""

    def __init__(
        self, node: Node, config: SimConfig, world: World, kinect: SimKinect, motors: WireMotors, channel: Channel
    ) -> None:
        super().__init__(node, config, world, kinect)
        self._motors = motors
        self._channel = channel

    def tick(self) -> None:
        orders = self._channel.newest(MotorOrders)
        if orders is not None:
            self._motors.obey(orders)
        if not self._channel.open:
            raise CocoroError("the emulated firmware has ended")
        super().tick()
        self._channel.send(self._motors.state(self._world.time_ns))


def setup_of(robot: Robot, motors: WireMotors, seed: int) -> Setup:
    """The firmware's devices: the Create, if it is one, and by line the servos of all groups and of wheels. Raises
    ConfigError as `servos_on_lines` does, and for wheels that nothing emulated turns."""
    if robot.base.kind != "differential" and not motors.wheels:
        raise ConfigError(f"nothing behind wires turns the wheels of {robot.name}: no [[base.wheel]] has a servo")
    lines = {
        line: [
            ServoSetup(joint.id, model_of(joint.group, protocol), joint.overload_s, motors.servos[joint.id].count)
            for joint in joints
            if joint.group is not None
        ]
        for line, (protocol, joints) in servos_on_lines(robot).items()
    }
    for wheel in motors.wheels.values():
        assert robot.wheel_line is not None
        model = model_of(None, wheel.protocol)
        lines[robot.wheel_line].append(ServoSetup(wheel.number, model, WHEEL_OVERLOAD_S, wheel.place, is_wheel=True))
    return Setup(None if motors.wheels else robot.base.axle_m * 1000.0, lines, seed)


@contextmanager
def firmware_process(folder: Path, setup: Setup) -> Iterator[Channel]:
    """Start the firmware's process, which makes its ports in `folder`; it has ended when this context is left."""
    child = ChildProcess("sim.wire.firmware", str(folder), packages=sys.path[1:])
    channel = Channel(child.channel)
    try:
        channel.send(setup)
        yield channel
    finally:
        channel.close()
        wait_or_kill(child.process, END_S)


async def run(node: Node, config: SimConfig) -> None:
    """Simulate for ever."""
    motors = WireMotors()
    folder = wire_dir(node.robot_name)
    with (
        make_world(node.robot, config, motors.make) as world,
        make_kinect(node.robot, config, world) as kinect,
        firmware_process(folder, setup_of(node.robot, motors, config.seed)) as channel,
    ):
        simulator = WireSimulator(node, config, world, kinect, motors, channel)
        async with node.sibling("kinect") as camera:
            simulator.connect_camera(camera)
            await asyncio.to_thread(select.select, [channel], [], [], START_S)  # its first orders show that it runs
            simulator.publish_time()
            for part in (node, camera):
                part.ready(f"simulated behind wires, scene {world.scene.name}, {config.sensors} sensors")
            await keep_going(node, config, simulator)


implementation = Implementation(SimConfig, run)
