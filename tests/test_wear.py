"""The worn body: its distance from the nominal one; it depends on the seed alone, and the world is built from it."""

from __future__ import annotations

from math import acos, degrees, hypot

import numpy as np
import pytest
from world_operator import EMPTY, Operator

from cocoro.robot import Robot
from sim.realism import BEND_RAD, LOOSENING_DEG_PER_MIN, body_of
from sim.world import World

SEEDS = range(20)


def test_a_nominal_body_is_its_drawing(robot: Robot) -> None:
    wear = body_of(robot, "nominal", seed=3)
    assert wear.robot is robot
    assert wear.slip_rad("elbow", 1000.0) == 0.0


def test_the_same_seed_is_the_same_body_and_another_is_another(robot: Robot) -> None:
    one, same, other = (body_of(robot, "worn", seed) for seed in (1, 1, 2))
    assert one.robot.to_data() == same.robot.to_data()
    assert one.slip_radps == same.slip_radps
    assert one.robot.to_data() != other.robot.to_data()
    assert one.robot.base.axle_m != other.robot.base.axle_m


def test_lengths_zeros_marker_and_wheels_stay_within_their_bounds(robot: Robot) -> None:
    for seed in SEEDS:
        worn = body_of(robot, "worn", seed).robot
        for name, drawn in robot.links.items():
            real = worn.links[name]
            x, y, z = (real.fixed() - drawn.fixed())[:3, 3]
            assert hypot(x, y) <= 0.005
            assert abs(z) <= 0.005
            assert abs(degrees(real.offset_rad - drawn.offset_rad)) <= 2.0
        off = np.subtract(worn.the_marker.position_m, robot.the_marker.position_m)
        assert np.linalg.norm(off) == pytest.approx(0.005)
        assert abs(worn.base.axle_m - robot.base.axle_m) <= 0.008


def test_the_camera_is_mounted_off_by_a_degree_and_five_millimetres_at_most(robot: Robot) -> None:
    turns, shifts = [], []
    for seed in SEEDS:
        worn = body_of(robot, "worn", seed).robot
        neck = dict.fromkeys(("neck_pan", "neck_tilt"), 0.0)
        for name in neck:  # leave the neck's own zeros out of it
            neck[name] = robot.links[name].offset_rad - worn.links[name].offset_rad
        drawn = robot.chain("camera").pose(dict.fromkeys(neck, 0.0))
        real = worn.chain("camera").pose(neck)
        between = np.linalg.inv(drawn) @ real
        turns.append(degrees(acos(min((np.trace(between[:3, :3]) - 1) / 2, 1.0))))
        mount = robot.chain("camera_mount").pose(dict.fromkeys(neck, 0.0))
        # The rotation is about the mount, which is 28 mm away from the camera.
        arm = (np.linalg.inv(mount) @ drawn)[:3, 3]
        shifts.append(np.linalg.norm(real[:3, 3] - drawn[:3, 3]) - np.linalg.norm(arm) * np.radians(turns[-1]))
    assert max(turns) <= 1.01
    assert max(turns) > 0.5
    assert max(shifts) <= 0.0051


def test_loosening_is_slow_and_a_bend_is_sudden(robot: Robot) -> None:
    wear = body_of(robot, "worn", seed=4, bend_s=60.0)
    before, after = wear.slip_rad("elbow", 59.9), wear.slip_rad("elbow", 60.0)
    assert after - before == pytest.approx(BEND_RAD, abs=1e-4)
    for joint in ("arm_base", "shoulder", "wrist_pitch"):
        assert 0 < abs(degrees(wear.slip_rad(joint, 60.0))) <= LOOSENING_DEG_PER_MIN


@pytest.mark.sim
def test_the_world_is_built_from_the_worn_body_while_its_odometry_keeps_the_drawing(robot: Robot) -> None:
    wear = body_of(robot, "worn", seed=5)
    with World(robot, EMPTY, seed=5, wear=wear) as world:
        operator = Operator(world)
        operator.run(1.0, wheels_mps=(-0.13, 0.13))
        operator.run(0.5, wheels_mps=(0.0, 0.0))
        truth = world.truth()
        body = world.link_pose("body")
        marker = np.linalg.inv(body) @ world.link_pose("wrist_roll") @ [*wear.robot.the_marker.position_m, 1.0]
        angles = truth.joints_rad
        real = wear.robot.chain("wrist_roll").pose(angles) @ [*wear.robot.the_marker.position_m, 1.0]
        drawn = robot.chain("wrist_roll").pose(angles) @ [*robot.the_marker.position_m, 1.0]
        assert np.linalg.norm(marker - real) < 1e-4
        assert 0.003 < np.linalg.norm(marker - drawn) < 0.06
        yaw = 2 * np.arctan2(truth.body_orientation[2], truth.body_orientation[3])
        ratio = world.base_state().odometry_yaw_rad / yaw
        assert ratio == pytest.approx(wear.robot.base.axle_m / robot.base.axle_m, abs=2e-3)


@pytest.mark.sim
def test_a_bent_forearm_carries_the_hand_three_centimetres_off_while_the_servo_notices_nothing(robot: Robot) -> None:
    pose = {"arm_base": 0.0, "shoulder": 1.2, "elbow": -1.8, "wrist_pitch": 0.5}
    with World(robot, EMPTY, wear=body_of(robot, "nominal", 0, bend_s=3.0)) as world:
        operator = Operator(world)
        operator.run(2.9, arm=pose)
        before, said = world.link_pose("wrist_roll"), world.servo_state("arm").position_rad
        operator.run(1.5, arm=pose)
        after = world.link_pose("wrist_roll")
        marker = [*robot.the_marker.position_m, 1.0]
        assert np.linalg.norm((after - before) @ marker) == pytest.approx(0.03, abs=0.008)
        assert np.allclose(world.servo_state("arm").position_rad, said, atol=0.012)
