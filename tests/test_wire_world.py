"""The PyBullet robot behind its firmware: registers and wheel speeds move it, and its motion is measured."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from math import hypot

import pytest

from cocoro.robot import Robot
from cocoro.servo_units import UNITS
from sim.scene import Scene, load_scene
from sim.service import SimConfig
from sim.wire.firmware import Channel, LinkedPlant, MotorOrder, MotorOrders, PlantState, ServoSetup, Setup, firmware
from sim.wire.service import WireMotors, setup_of
from sim.world import World

pytestmark = pytest.mark.sim

ROBOT = Robot.load()
COUNT_RAD = UNITS["dynamixel"].count_rad
ELBOW = ROBOT.joints["elbow"].id
DRIVING = 2


def scene() -> Scene:
    return load_scene("paper")


@pytest.fixture
def motors() -> WireMotors:
    return WireMotors()


@pytest.fixture
def world(motors: WireMotors) -> Iterator[World]:
    with World(ROBOT, scene(), motors=motors.make) as world:
        yield world


def run(world: World, seconds: float) -> None:
    for _ in range(round(seconds * 240)):
        world.step()


def test_servos_hold_where_they_were_left(world: World, motors: WireMotors) -> None:
    before = {number: servo.count for number, servo in motors.servos.items()}
    run(world, 1.0)
    assert all(abs(servo.count - before[number]) <= 1 for number, servo in motors.servos.items())
    for servo in motors.servos.values():  # as from the factory: it pushes the harder the further it is pushed away
        servo.motor.slope, servo.motor.punch = 32, 0.03
    run(world, 1.0)
    assert all(abs(servo.count - before[number]) < 32 for number, servo in motors.servos.items())


def test_a_servo_goes_to_the_goal_in_its_register_at_the_speed_in_its_register(
    world: World, motors: WireMotors
) -> None:
    elbow = motors.servos[ELBOW]
    start = elbow.count
    elbow.motor.goal, elbow.motor.speed, elbow.motor.slope = start + 200, 43, 2
    run(world, 0.5)
    assert (elbow.count - start) * COUNT_RAD == pytest.approx(0.5 * 0.5, abs=0.05)
    assert elbow.measurements[1] == pytest.approx(43, abs=5)
    run(world, 2.0)
    assert elbow.count == pytest.approx(start + 200, abs=3)


def test_feetech_servos_move_the_same_arm_in_their_own_units(motors: WireMotors) -> None:
    robot = ROBOT.with_networks(protocol="feetech")
    with World(robot, scene(), motors=motors.make) as world:
        elbow = motors.servos[ELBOW]
        start = elbow.count
        _, lines = firmware(setup_of(robot, motors, seed=3))
        servo = lines["arm"].by_number(ELBOW)
        assert (servo.get(3), servo.get(56), servo.get(42)) == (777, start, start)
        servo.put(42, start + 800)
        servo.put(46, 326)  # 0.5 rad/s
        elbow.motor = servo.motor
        run(world, 0.5)
        unit_rad = UNITS["feetech"].count_rad
        assert (elbow.count - start) * unit_rad == pytest.approx(0.5 * 0.5, abs=0.05)
        assert elbow.measurements[1] == pytest.approx(326, abs=40)
        run(world, 3.0)
        assert (start + 800 - elbow.count) * unit_rad == pytest.approx(0.0, abs=0.03)  # it sags under its load


def test_a_limp_arm_sinks_and_one_without_torque_limit_does_too(world: World, motors: WireMotors) -> None:
    shoulder = motors.servos[ROBOT.joints["shoulder"].id]
    for joint, angle_rad in {"shoulder": 0.8, "elbow": 0.0, "wrist_pitch": 0.0}.items():
        servo = motors.servos[ROBOT.joints[joint].id]
        servo.motor.goal, servo.motor.speed = servo.joint.to_count(angle_rad), 100
    run(world, 4.0)
    held = shoulder.count
    shoulder.motor.limit = 0.0
    run(world, 2.0)
    assert shoulder.count < held - 20


def test_wheels_turn_as_the_firmware_asks_and_are_counted(world: World, motors: WireMotors) -> None:
    before = world.truth().body_m
    motors.base.asked_mps = (0.1, 0.1)
    run(world, 2.0)
    after = world.truth().body_m
    way_m = hypot(after[0] - before[0], after[1] - before[1])
    assert way_m == pytest.approx(0.2, abs=0.02)
    assert motors.base.counted_m == pytest.approx([way_m, way_m], rel=0.02)


def test_the_setup_tells_the_firmware_how_the_robot_stands(world: World, motors: WireMotors) -> None:
    setup = setup_of(ROBOT, motors, seed=3)
    create, lines = firmware(setup)
    assert create is not None
    assert [servo.number for servo in lines["arm"].servos] == [1, 2, 3, 4, 5, 6]
    assert [servo.number for servo in lines["hand"].servos] == [7, 8, 9]
    elbow = lines["arm"].by_number(ELBOW)
    assert elbow.get(36) == elbow.get(30) == motors.servos[ELBOW].count
    assert elbow.motor.on
    assert create.mode == 0
    assert SimConfig() is not None


def test_firmware_and_physics_tell_each_other_the_newest_and_notice_the_end() -> None:
    ours, theirs = (Channel(end) for end in socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET))
    create, lines = firmware(Setup(261.0, {"arm": [ServoSetup(5, 28, 5.0, 512)]}, 0))
    assert create is not None
    body = LinkedPlant(theirs, create, lines)
    create.receive(bytes([128, 131, 145, 0, 100, 0, 50]), 57600, 0)
    for left_m in (0.0, 0.5, 1.0):
        ours.send(PlantState(0, left_m, left_m, True, False, {5: (600, -20, 0.25)}))
        body.advance(0)
    orders = ours.newest(MotorOrders)
    assert isinstance(orders, MotorOrders)
    assert (orders.left_mmps, orders.right_mmps) == (50, 100)
    motor = orders.motors.pop(5)
    assert not orders.motors
    assert motor == MotorOrder(True, 512, 0, 1.0, 32, motor.punch)
    assert motor.punch == pytest.approx(32 / 1023)
    assert create.mode == DRIVING
    servo = lines["arm"].servos[0]
    assert (servo.get(36), servo.get(38), servo.get(40)) == (600, 1024 + 20, 256)
    create.receive(bytes([142, 19, 142, 7]), 57600, 0)
    assert create.advance(57600, 0)[:3] == bytes([3, 0xE8, 2])  # 1000 mm, left bumper
    ours.close()
    body.advance(0)
    assert not body.connected
    theirs.close()
