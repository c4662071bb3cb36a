"""A simulated body on three omni wheels: it moves as commanded in every direction, stops, and is stopped."""

from __future__ import annotations

from math import cos, hypot, pi, radians, sin

import numpy as np
import pytest
from omni_robot import omni_robot
from world_operator import COMMAND_EVERY, EMPTY, Operator, scene_with, yaw_of

from cocoro.drive import Twist
from cocoro.frames import Pose2
from cocoro.messages import BaseCommand, Truth
from sim.realism import body_of
from sim.scene import Obstacle
from sim.world import World

pytestmark = pytest.mark.sim

ROBOT = omni_robot()
HZ = 240


def pose_of(truth: Truth) -> Pose2:
    return Pose2(truth.body_m[0], truth.body_m[1], yaw_of(truth))


def drive(world: World, twist: Twist, seconds: float) -> set[str]:
    """Command a motion at 48 Hz. Returns the collisions."""
    seen: set[str] = set()
    for step in range(round(seconds * HZ)):
        if step % COMMAND_EVERY == 0:
            world.command_base(BaseCommand(ahead_mps=twist.ahead, turn_radps=twist.turn, aside_mps=twist.aside))
        world.step()
        if step % 8 == 7:
            seen.update(world.truth().collisions)
    return seen


def rest(world: World, seconds: float) -> None:
    for _ in range(round(seconds * HZ)):
        world.step()


@pytest.mark.parametrize(
    "twist",
    [
        Twist(ahead=0.25),
        Twist(ahead=-0.25),
        Twist(aside=0.2),
        Twist(aside=-0.2),
        Twist(turn=1.5),
        Twist(turn=-1.5),
        Twist(0.12, 0.0, 0.12),
        Twist(0.15, 0.5, -0.1),
        Twist(0.02, 0.02, 0.01),
    ],
)
def test_it_moves_as_commanded(twist: Twist) -> None:
    with World(ROBOT, EMPTY) as world:
        world.set_latch("released")
        drive(world, twist, 1.0)
        before = pose_of(world.truth())
        assert not drive(world, twist, 1.0)
        moved = before.inverse().compose(pose_of(world.truth()))
        # A second along an arc: the chord.
        half = twist.turn / 2
        chord = sin(half) / half if half else 1.0
        ahead_m = chord * (cos(half) * twist.ahead - sin(half) * twist.aside)
        aside_m = chord * (sin(half) * twist.ahead + cos(half) * twist.aside)
        assert (moved.x_m, moved.y_m) == pytest.approx((ahead_m, aside_m), abs=0.001)
        assert (moved.yaw_rad + pi) % (2 * pi) - pi == pytest.approx(twist.turn, abs=0.003)
        state = world.base_state()
        assert (state.speed_mps, state.aside_mps, state.turn_rate_radps) == pytest.approx(
            (twist.ahead, twist.aside, twist.turn), abs=0.01
        )
        rest(world, 0.5)
        truth, state = world.truth(), world.base_state()
        assert truth.body_m[:2] == pytest.approx(state.odometry_m, abs=0.003)
        assert state.stopped_by == "no command"


@pytest.mark.parametrize("twist", [Twist(ahead=0.3), Twist(aside=0.29), Twist(turn=2.3)])
def test_it_stands_in_time_after_the_last_command(twist: Twist) -> None:
    with World(ROBOT, EMPTY) as world:
        world.set_latch("released")
        drive(world, twist, 1.0)
        rest(world, ROBOT.base.stand_within_s - COMMAND_EVERY / HZ)
        before = pose_of(world.truth())
        rest(world, 0.5)
        moved = before.inverse().compose(pose_of(world.truth()))
        assert hypot(moved.x_m, moved.y_m) < 0.001
        assert abs(moved.yaw_rad) < 0.003


def test_the_wheels_limit_slows_it_in_its_direction() -> None:
    with World(ROBOT, EMPTY) as world:
        world.set_latch("released")
        drive(world, Twist(1.0, 0.0, 1.0), 2.0)
        x, y, _ = world.truth().body_m
        assert x == pytest.approx(y, abs=0.005)
        fastest = ROBOT.drive.fastest(Twist(1.0, 0.0, 1.0))
        assert hypot(x, y) < 2.0 * hypot(1.0, 1.0) * ROBOT.base.max_wheel_speed_mps / fastest
        assert world.wheels().speed_mps == pytest.approx(ROBOT.base.max_wheel_speed_mps)


def test_it_neither_drifts_nor_creeps_while_the_arm_waves() -> None:
    with World(ROBOT, EMPTY) as world:
        operator = Operator(world)
        for _ in range(2):
            operator.run(1.0, arm={"arm_base": -1.0, "shoulder": 0.9, "neck_pan": 1.0}, speed_radps=2.5)
            operator.run(1.0, arm={"arm_base": 1.0, "shoulder": 1.5, "neck_pan": -1.0}, speed_radps=2.5)
        operator.run(4.0)
        truth = world.truth()
        assert hypot(*truth.body_m[:2]) < 0.002
        assert abs(yaw_of(truth)) < radians(0.3)
        assert abs(truth.body_m[2]) < 0.001


AHEAD = Obstacle(shape="box", size_m=(0.1, 2.0, 0.5), position_m=(0.45, 0.0))
LEFT = Obstacle(shape="box", size_m=(2.0, 0.1, 0.5), position_m=(0.0, 0.45))
BEHIND = Obstacle(shape="box", size_m=(0.1, 2.0, 0.5), position_m=(-0.45, 0.0))
GAP_M = 0.4 - ROBOT.base.chassis_diameter_m / 2


@pytest.mark.parametrize("bumper", [True, False])
@pytest.mark.parametrize(
    ("wall", "twist"), [(AHEAD, Twist(ahead=0.2)), (LEFT, Twist(aside=0.2)), (BEHIND, Twist(ahead=-0.2))]
)
def test_a_wall_stops_it(wall: Obstacle, twist: Twist, *, bumper: bool) -> None:
    robot = omni_robot(bumper=bumper)
    with World(robot, scene_with(obstacles=(wall,))) as world:
        world.set_latch("released")
        seen = drive(world, twist, 4.0)
        x, y, z = world.truth().body_m
        towards = x * np.sign(twist.ahead) + y * np.sign(twist.aside)
        assert towards == pytest.approx(GAP_M, abs=0.003)
        assert abs(z) < 0.001
        assert seen == {"chassis~obstacle_1"}
        felt = bumper and twist.ahead >= 0.0
        assert (world.base_state().stopped_by == "bump") == felt
        assert (world.base_state().bump_left or world.base_state().bump_right) == felt
        drive(world, Twist(-twist.ahead, 0.0, -twist.aside), 1.5)
        x, y, _ = world.truth().body_m
        assert x * np.sign(twist.ahead) + y * np.sign(twist.aside) < GAP_M - 0.15


def test_wheels_that_differ_and_slip_are_not_seen_by_its_odometry() -> None:
    errors = []
    for seed in range(3):
        with World(ROBOT, EMPTY, seed=seed, sensors="real", wear=body_of(ROBOT, "worn", seed)) as world:
            world.set_latch("released")
            drive(world, Twist(0.1, 0.0, 0.15), 3.0)
            rest(world, 0.5)
            state, truth = world.base_state(), world.truth()
            way_m = hypot(*state.odometry_m)
            assert state.odometry_m[1] == pytest.approx(1.5 * state.odometry_m[0], rel=0.02)
            errors.append(hypot(truth.body_m[0] - state.odometry_m[0], truth.body_m[1] - state.odometry_m[1]) / way_m)
    assert 0.001 < max(errors) < 0.08
