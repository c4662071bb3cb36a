"""The simulated robot moves as commanded, and stops when it must."""

from __future__ import annotations

from collections.abc import Iterator
from math import hypot, pi, radians

import numpy as np
import pytest
from world_operator import COMMAND_EVERY, EMPTY, ROBOT, Operator, scene_with, yaw_of

from cocoro.joints import GROUPS
from cocoro.messages import BaseCommand, ServoCommand
from cocoro.servo_units import UNITS
from sim.scene import Obstacle, load_scene
from sim.world import World

pytestmark = pytest.mark.sim


@pytest.fixture
def empty() -> Iterator[World]:
    with World(ROBOT, EMPTY) as world:
        yield world


@pytest.mark.parametrize(
    ("left_mps", "right_mps"), [(0.2, 0.2), (-0.2, -0.2), (0.5, 0.5), (0.3, 0.2), (-0.1, 0.1), (0.05, 0.06)]
)
def test_the_base_goes_where_its_wheels_roll(empty: World, left_mps: float, right_mps: float) -> None:
    operator = Operator(empty)
    operator.run(3.0, wheels_mps=(left_mps, right_mps))
    operator.run(0.6)
    truth, state = empty.truth(), empty.base_state()
    way_m = 3.0 * max(abs(left_mps), abs(right_mps))
    assert truth.body_m[0] == pytest.approx(state.odometry_m[0], abs=0.005 * way_m)
    assert truth.body_m[1] == pytest.approx(state.odometry_m[1], abs=0.005 * way_m)
    turned = state.odometry_yaw_rad - yaw_of(truth)
    assert (turned + pi) % (2 * pi) - pi == pytest.approx(0.0, abs=0.005 * max(1.0, abs(state.odometry_yaw_rad)))
    # 3 s of commands, then the deadman time; the two ramps cancel.
    held_s = 3.0 + ROBOT.base.command_timeout_s - COMMAND_EVERY / 240
    assert state.odometry_yaw_rad == pytest.approx(
        (right_mps - left_mps) / ROBOT.base.axle_m * held_s, rel=0.01, abs=0.002
    )
    assert (state.speed_mps, state.turn_rate_radps) == pytest.approx((0.0, 0.0), abs=1e-3)


def test_at_rest_it_neither_drifts_nor_creeps_while_the_arm_waves(empty: World) -> None:
    operator = Operator(empty)
    for _ in range(3):
        operator.run(1.0, arm={"arm_base": -1.0, "shoulder": 0.9, "neck_pan": 1.0}, speed_radps=2.5)
        operator.run(1.0, arm={"arm_base": 1.0, "shoulder": 1.5, "neck_pan": -1.0}, speed_radps=2.5)
    operator.run(5.0)
    truth = empty.truth()
    assert hypot(*truth.body_m[:2]) < 0.002
    assert abs(yaw_of(truth)) < radians(0.3)
    assert abs(truth.body_m[2]) < 0.001


def test_a_joint_goes_at_the_speed_and_to_the_count_that_it_is_told(empty: World) -> None:
    operator = Operator(empty)
    start = empty.truth().joints_rad["neck_pan"]
    operator.run(1.0, arm={"neck_pan": 2.0}, speed_radps=0.5)
    assert empty.truth().joints_rad["neck_pan"] - start == pytest.approx(0.5, rel=0.02)
    state = empty.servo_state("arm")
    assert state.speed_radps[state.joints.index("neck_pan")] == pytest.approx(0.5, rel=0.03)
    operator.run(4.0, arm={"neck_pan": 2.0}, speed_radps=0.5)
    goal = ROBOT.joints["neck_pan"].to_angle(ROBOT.joints["neck_pan"].to_count(2.0))
    assert empty.truth().joints_rad["neck_pan"] == pytest.approx(goal, abs=1e-3)
    assert empty.servo_state("arm").position_rad[state.joints.index("neck_pan")] == pytest.approx(goal)


def test_silence_stops_wheels_and_arm(empty: World) -> None:
    operator = Operator(empty)
    operator.run(0.6, arm={"neck_pan": 2.0}, wheels_mps=(0.3, 0.3))
    operator.run(0.5)
    before = empty.truth()
    operator.run(1.0)
    after = empty.truth()
    assert after.body_m == pytest.approx(before.body_m, abs=1e-4)
    assert after.joints_rad["neck_pan"] == pytest.approx(before.joints_rad["neck_pan"], abs=1e-4)
    assert before.joints_rad["neck_pan"] < 1.7
    assert empty.base_state().stopped_by == "no command"


def test_until_the_latch_is_known_nothing_moves(empty: World) -> None:
    assert empty.command_base(BaseCommand(ahead_mps=0.2, turn_radps=0.0)) == "latch unknown"
    order = ServoCommand(joints=("neck_pan",), goal_rad=(1.0,), speed_radps=(1.0,))
    assert empty.command_servos("arm", order) == "latch unknown"
    for _ in range(60):
        empty.step()
    assert empty.truth().body_m == pytest.approx((0.0, 0.0, 0.0), abs=2e-4)
    assert empty.base_state().stopped_by == empty.servo_state("arm").stopped_by == "latch unknown"


def test_the_emergency_stop_halts_a_moving_robot(empty: World) -> None:
    operator = Operator(empty)
    operator.run(1.0, arm={"neck_pan": 2.0}, wheels_mps=(0.4, 0.4))
    empty.set_latch("latched")
    operator.run(0.3, arm={"neck_pan": 2.0}, wheels_mps=(0.4, 0.4))
    before = empty.truth()
    operator.run(0.5, arm={"neck_pan": 2.0}, wheels_mps=(0.4, 0.4))
    after = empty.truth()
    assert after.body_m == pytest.approx(before.body_m, abs=1e-4)
    assert after.joints_rad["neck_pan"] == pytest.approx(before.joints_rad["neck_pan"], abs=1e-3)
    assert empty.base_state().stopped_by == "estop"


def test_each_hardware_service_has_a_latch_of_its_own(empty: World) -> None:
    operator = Operator(empty)
    empty.set_latch("latched", "arm")
    operator.run(1.0, arm={"neck_pan": 1.0}, hand={"wrist_roll": -0.5}, wheels_mps=(-0.2, -0.2))
    truth = empty.truth()
    assert truth.joints_rad["neck_pan"] == pytest.approx(0.0, abs=UNITS["dynamixel"].count_rad)
    assert truth.joints_rad["wrist_roll"] < -0.4
    assert truth.body_m[0] < -0.15
    assert [empty.servo_state(name).stopped_by for name in ("arm", "hand")] == ["estop", ""]


def test_nothing_flies_apart_when_everything_is_asked_of_it_at_once() -> None:
    draws = np.random.default_rng(3)
    scene = load_scene("paper", 3)
    with World(ROBOT, scene, seed=3, sensors="real") as world:
        operator = Operator(world)
        for _ in range(20):
            arm, hand = (
                {joint: draws.uniform(*ROBOT.joints[joint].limits_rad) for joint in ROBOT.group_joints(name)}
                for name in GROUPS
            )
            left, right = draws.uniform(-0.5, 0.5, 2)
            operator.run(0.4, arm=arm, hand=hand, wheels_mps=(left, right), speed_radps=6.0)
            truth = world.truth()
            assert np.isfinite(world.visual_poses()).all()
            assert truth.body_m[2] < 0.1
            for joint, angle_rad in truth.joints_rad.items():
                low, high = ROBOT.joints[joint].limits_rad
                assert low - 0.05 < angle_rad < high + 0.05, joint


@pytest.mark.parametrize(("y_m", "left", "right"), [(0.0, True, True), (0.16, True, False), (-0.16, False, True)])
def test_a_bump_stops_it_until_it_backs_off(y_m: float, left: bool, right: bool) -> None:
    pillar = Obstacle(shape="cylinder", radius_m=0.04, height_m=0.08, position_m=(0.5, y_m))
    with World(ROBOT, scene_with(obstacles=(pillar,))) as world:
        operator = Operator(world)
        operator.run(2.5, wheels_mps=(0.2, 0.2))
        state = world.base_state()
        assert (state.bump_left, state.bump_right) == (left, right)
        assert state.stopped_by == "bump"
        assert "chassis~obstacle_1" in world.truth().collisions
        stopped_m = world.truth().body_m[0]
        operator.run(1.0, wheels_mps=(0.2, 0.2))
        assert world.truth().body_m[0] == pytest.approx(stopped_m, abs=0.005)
        operator.run(1.0, wheels_mps=(-0.2, -0.2))
        assert not world.base_state().bump_left
        assert not world.base_state().bump_right
        assert world.truth().body_m[0] < stopped_m - 0.15


def test_real_wheels_differ_from_what_odometry_believes_and_ideal_ones_do_not() -> None:
    errors = []
    for seed in range(3):
        with World(ROBOT, EMPTY, seed=seed, sensors="real") as world:
            operator = Operator(world)
            operator.run(4.0, wheels_mps=(0.2, 0.2))
            operator.run(0.6)
            truth, state = world.truth(), world.base_state()
            errors.append(truth.body_m[0] - state.odometry_m[0])
            assert abs(truth.body_m[0] / state.odometry_m[0] - 1.0) < 0.03
            assert abs(yaw_of(truth)) < 0.05 * 0.84 / ROBOT.base.axle_m
            # A Create's driver knows only the commanded wheel speeds; here the wheels followed them.
            held_s = 4.0 + ROBOT.base.command_timeout_s - COMMAND_EVERY / 240
            assert state.odometry_m[0] == pytest.approx(0.2 * held_s, rel=0.005)
    assert np.std(errors) > 0.001
