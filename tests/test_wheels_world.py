"""The wheels of a LeKiwi on its servo line, in virtual time, with the simulated body behind the servos: what the wheels
do to the body, and that it stands in time, by the simulator's truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from math import atan2, hypot

import numpy as np
import pytest
from wheels_rig import START_NS, WheelsRig
from world_operator import EMPTY

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from sim.wire.firmware import MotorOrders, order_of
from sim.wire.service import WireMotors, setup_of
from sim.wire.servo import EmulatedServo
from sim.world import World

pytestmark = pytest.mark.sim

STAND_S = 0.3
STANDING_MPS = 0.01
LEVER_M = 0.125


def yaw_of(pose: FloatArray) -> float:
    return atan2(pose[1, 0], pose[0, 0])


class Body:
    """The simulated body in place of a plant without physics."""

    def __init__(self, world: World, motors: WireMotors, wheels: dict[int, EmulatedServo]) -> None:
        self.world = world
        self.motors = motors
        self.moves: list[tuple[int, float]] = []
        """(ns, speed of the body's fastest part at the height of the wheels, m/s)."""
        self._wheels = wheels
        self._pose = world.body_pose()

    def advance(self, now_ns: int) -> None:
        while self.world.time_ns + START_NS < now_ns:
            orders = {number: order_of(servo.motor) for number, servo in self._wheels.items()}
            self.motors.obey(MotorOrders(0, 0, orders))
            self.world.step()
            before, self._pose = self._pose, self.world.body_pose()
            turned = abs(yaw_of(np.linalg.inv(before) @ self._pose))
            moved_m = hypot(*(self._pose[:2, 3] - before[:2, 3])) + LEVER_M * turned
            self.moves.append((now_ns, moved_m * 240.0))
            for number, shaft in self.motors.state(0).shafts.items():
                if number in self._wheels:
                    self._wheels[number].sense(*shaft, now_ns)

    def speeds(self) -> dict[int, float]:
        return {number: float(self._wheels[number].get(58) & 0x7FFF) for number in self._wheels}

    def stood_after(self, since_ns: int) -> float:
        moving = [at_ns for at_ns, mps in self.moves if mps > STANDING_MPS and at_ns > since_ns]
        return (max(moving, default=since_ns) - since_ns) / NS


class WorldRig(WheelsRig):
    def __init__(self, world: World, motors: WireMotors) -> None:
        super().__init__()
        wheels = {servo.number: servo for servo in self.wheels.values()}
        self.body = Body(world, motors, wheels)
        self.plant = self.body  # type: ignore[assignment]


@pytest.fixture
def rig() -> Iterator[WorldRig]:
    motors = WireMotors()
    with World(WheelsRig().robot, EMPTY, motors=motors.make) as world:
        rig = WorldRig(world, motors)
        rig.release()
        yield rig


def test_the_line_has_all_nine_servos_and_no_create(rig: WorldRig) -> None:
    setup = setup_of(rig.robot, rig.body.motors, seed=0)
    assert setup.wheel_base_mm is None
    assert [(one.number, one.is_wheel) for one in setup.lines["bus"]] == [(n, n > 6) for n in range(1, 10)]


def test_the_body_goes_where_it_is_sent_and_the_odometry_knows(rig: WorldRig) -> None:
    for ahead, turn, aside in ((0.12, 0.0, 0.0), (0.0, 0.0, 0.12), (0.0, 0.9, 0.0)):
        rig.drive(ahead, turn, aside)
        rig.run(1.0)
    rig.drive()
    rig.run(0.5)
    pose, state = rig.body.world.body_pose(), rig.states[-1]
    assert state.odometry_m == pytest.approx(tuple(pose[:2, 3]), abs=0.008)
    assert state.odometry_yaw_rad == pytest.approx(yaw_of(pose), abs=0.02)
    assert pose[:2, 3] == pytest.approx([0.11, 0.11], abs=0.02)
    assert yaw_of(pose) == pytest.approx(0.8, abs=0.1)
    assert state.standing


def fall_silent(rig: WorldRig) -> None:
    rig.wanted = None


def hang(rig: WorldRig) -> None:
    rig.alive = False


def die(rig: WorldRig) -> None:
    rig.alive = False
    rig.guard.end(rig.now_ns)


def stop(rig: WorldRig) -> None:
    rig.orders.halt()


def pull_the_plug_of_a_wheel(rig: WorldRig) -> None:
    rig.wheels["left"].put(62, 0)


def pull_the_plug_of_the_line(rig: WorldRig) -> None:
    """That at the adapter's board, which carries the servos' power, too."""
    rig.plugged = False
    for servo in rig.wheels.values():
        servo.put(62, 0)


def block_a_wheel(rig: WorldRig) -> None:
    rig.body.motors.wheels[7].blocked = True


def disturb(rig: WorldRig) -> None:
    """Half of the packets are damaged, and commands cease."""
    rig.disturb("corrupted", 0.03)
    rig.wanted = None


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (fall_silent, ""),
        (hang, ""),
        (die, ""),
        (stop, ""),
        (pull_the_plug_of_a_wheel, "wheel left (ID 7) does not answer"),
        (pull_the_plug_of_the_line, "wheel left (ID 7) does not answer"),
        (block_a_wheel, "wheel left is held up"),
        (disturb, "the line is disturbed"),
    ],
)
def test_the_body_stands_in_time(rig: WorldRig, spoil: Callable[[WorldRig], None], says: str) -> None:
    rig.drive(0.2)
    rig.run(0.5)
    assert rig.body.moves[-1][1] > 0.18
    since_ns = rig.now_ns
    spoil(rig)
    rig.run(0.7)
    assert 0.0 < rig.body.stood_after(since_ns) <= STAND_S
    assert says in "; ".join(rig.core.faults(rig.now_ns))
