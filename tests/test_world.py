"""The PyBullet world: its robot is the described one, its scene the given one, and it is repeatable to the bit."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from math import pi

import msgspec
import numpy as np
import pytest
from world_operator import (
    EMPTY,
    LEVEL,
    OPEN,
    READY,
    ROBOT,
    SHUT,
    Operator,
    arm_angles,
    can,
    scene_with,
    the_can,
    yaw_of,
)

from cocoro.servo_units import UNITS
from sim.bullet import Bullet
from sim.judge import Judge
from sim.mechanism import Mechanism
from sim.model import build_model
from sim.scene import Scene, SceneObject, Start, load_scene
from sim.world import World

pytestmark = pytest.mark.sim


@pytest.fixture
def empty() -> Iterator[World]:
    with World(ROBOT, EMPTY) as world:
        yield world


def test_the_models_forward_kinematics_are_the_descriptions() -> None:
    draws = np.random.default_rng(7)
    model = build_model(ROBOT)
    for _ in range(10):
        angles = {name: draws.uniform(*joint.limits_rad) for name, joint in ROBOT.joints.items()}
        bullet = Bullet()
        try:
            mechanism = Mechanism(bullet, ROBOT, model, Start(position_m=(1.0, -2.0), yaw_rad=0.7), angles)
            poses, to_body = mechanism.link_poses(), np.linalg.inv(mechanism.root_pose())
        finally:
            bullet.close()
        for link in ROBOT.links:
            carrier, offset = model.carried[link]
            modelled = to_body @ poses[mechanism.index[carrier]] @ offset
            assert modelled == pytest.approx(ROBOT.chain(link).pose(angles), abs=1e-6), link


def test_the_model_weighs_what_the_robot_weighs_and_is_written_in_lines() -> None:
    model = build_model(ROBOT)
    assert model.body.mass_kg == pytest.approx(ROBOT.base.mass_kg)
    assert max(len(line) for line in model.urdf.splitlines()) < 200


def test_link_poses_are_those_of_now_also_in_motion(empty: World) -> None:
    operator = Operator(empty)
    operator.run(0.5, arm={"neck_pan": 2.0, "shoulder": 1.0}, wheels_mps=(0.3, 0.1), speed_radps=3.0)
    joints = empty.truth().joints_rad
    to_body = np.linalg.inv(empty.link_pose("body"))
    for link in ("camera", "pad_centre"):
        assert to_body @ empty.link_pose(link) == pytest.approx(ROBOT.chain(link).pose(joints), abs=1e-5)
    assert empty.camera_pose() == pytest.approx(empty.link_pose("camera"))


def test_it_starts_parked_still_and_touching_nothing_but_the_floor(empty: World) -> None:
    truth = empty.truth()
    assert truth.stamp_ns == 0
    assert truth.collisions == ()
    assert truth.body_m == pytest.approx((0.0, 0.0, 0.0), abs=2e-4)
    for joint, angle_rad in truth.joints_rad.items():
        wanted = ROBOT.poses["park"].get(joint, 0.0)
        assert angle_rad == pytest.approx(wanted, abs=UNITS["dynamixel"].count_rad), joint
    assert empty.base_state().odometry_m == (0.0, 0.0)


def test_it_starts_where_the_scene_says() -> None:
    scene = Scene(name="test", objects=(can(1.0, 0.5),), robot=Start(position_m=(2.0, -1.0), yaw_rad=pi / 2))
    with World(ROBOT, scene) as world:
        truth = world.truth()
        assert truth.body_m[:2] == pytest.approx((2.0, -1.0), abs=2e-4)
        assert yaw_of(truth) == pytest.approx(pi / 2, abs=1e-3)
        assert truth.objects[0].position_m == pytest.approx((1.5, 0.0, 0.06), abs=1e-4)
        assert world.base_state().odometry_yaw_rad == 0.0


@pytest.mark.parametrize("hand", [LEVEL | {"wrist_roll": 0.0}, OPEN, {"claw_left": 0.3, "claw_right": -0.3}])
def test_the_parked_hand_keeps_clear_of_the_mount_at_roll_zero(empty: World, hand: dict[str, float]) -> None:
    operator = Operator(empty)
    operator.run(1.0, arm=ROBOT.poses["park"], hand=hand)
    assert operator.seen == set()


def test_rolled_level_in_the_park_pose_a_claw_enters_the_mount(empty: World) -> None:
    operator = Operator(empty)
    operator.run(2.0, arm=ROBOT.poses["park"], hand=LEVEL)
    assert operator.seen == {"claw_right~mount"}


def test_full_reach_costs_the_shoulder_what_the_design_says(empty: World) -> None:
    operator = Operator(empty)
    arm_base_x = ROBOT.chain("arm_base").position({"arm_base": 0.0})[0]
    above = arm_angles(np.array([0.45, -0.1, 0.2]), 0.0, READY)
    operator.run(2.0, arm=above, hand=LEVEL)
    operator.run(2.0, arm=arm_angles(np.array([arm_base_x + 0.54, -0.1, 0.06]), 0.0, above))
    state = empty.servo_state("arm")
    shoulder = state.load[state.joints.index("shoulder")] * ROBOT.joints["shoulder"].torque_nm
    assert shoulder == pytest.approx(1.6, abs=0.05)
    assert state.faults == ()


def test_an_arm_driven_into_the_mount_collides_with_it(empty: World) -> None:
    operator = Operator(empty)
    operator.run(3.0, arm={**ROBOT.poses["park"], "wrist_pitch": 0.6}, hand=OPEN)
    operator.run(2.0, arm={**ROBOT.poses["park"], "wrist_pitch": 0.6, "arm_base": 1.3, "shoulder": 2.6})
    operator.run(2.0, arm={"arm_base": -2.6, "shoulder": 2.0, "elbow": 0.0, "wrist_pitch": 0.0})
    assert any(pair.endswith("~mount") for pair in operator.seen)


def test_an_object_with_a_path_goes_along_it_and_is_not_pushed_off() -> None:
    ball = SceneObject(
        label="blue_ball",
        shape="sphere",
        radius_m=0.04,
        position_m=(1.0, 0.0, 0.6),
        path_m=((1.0, 0.5), (1.5, 0.5)),
        speed_mps=0.25,
    )
    with World(ROBOT, scene_with(ball)) as world:
        places = []
        for _ in range(5):
            for _ in range(240):
                world.step()
            places.append(the_can(world).position_m)
    expected = [(1.0, 0.25, 0.6), (1.0, 0.5, 0.6), (1.25, 0.5, 0.6), (1.5, 0.5, 0.6), (1.5, 0.5, 0.6)]
    assert np.array(places) == pytest.approx(np.array(expected), abs=1e-6)


def test_a_path_that_loops_comes_round_again() -> None:
    ball = SceneObject(
        label="blue_ball",
        shape="sphere",
        radius_m=0.04,
        position_m=(1.0, 0.0),
        path_m=((1.5, 0.0),),
        speed_mps=0.5,
        path_loop=True,
        floating=True,
    )
    with World(ROBOT, scene_with(ball)) as world:
        for _ in range(720):
            world.step()
        assert the_can(world).position_m == pytest.approx((1.5, 0.0, 0.04), abs=1e-6)


def test_what_is_near_is_touched_only_when_it_presses() -> None:
    with World(ROBOT, scene_with(can(0.5, 0.3))) as world:
        assert the_can(world).touching == ("floor",)
        Operator(world).run(2.0)
        resting = the_can(world)
        assert resting.touching == ("floor",)
        assert resting.position_m == pytest.approx((0.5, 0.3, 0.06), abs=2e-4)


def test_the_bump_reflex_stops_before_a_can_is_knocked_over_and_behind_there_is_none() -> None:
    for x_m, speed_mps, knocked in ((0.6, 0.3, ()), (-0.6, -0.3, ("red_can",))):
        scene = scene_with(can(x_m, 0.0))
        judge = Judge(ROBOT, scene, "red_can")
        with World(ROBOT, scene) as world:
            Operator(world, judge).run(3.0, wheels_mps=(speed_mps, speed_mps))
            assert judge.result().knocked_over == knocked
            assert "chassis~red_can" in judge.result().collisions


def test_visuals_have_poses_and_the_marker_stands_where_the_description_puts_it(empty: World) -> None:
    poses = empty.visual_poses()
    assert poses.shape == (len(empty.visuals), 4, 4)
    assert poses[:, 3] == pytest.approx(np.tile([0.0, 0.0, 0.0, 1.0], (len(poses), 1)))
    place = {visual.name: pose for visual, pose in zip(empty.visuals, poses, strict=True)}
    assert len(place) == len(poses)
    marker = empty.link_pose("wrist_roll") @ [*ROBOT.the_marker.position_m, 1.0]
    assert place["marker"][:3, 3] == pytest.approx(marker[:3], abs=1e-6)
    low, high = np.array(ROBOT.eye.mount_min_m), np.array(ROBOT.eye.mount_max_m)
    assert place["mount"][:3, 3] == pytest.approx((low + high) / 2, abs=5e-4)


def test_pads_are_flat_parallel_level_and_as_far_apart_as_the_design_says(empty: World) -> None:
    operator = Operator(empty)
    operator.run(2.0, arm=READY, hand=LEVEL)
    place = {visual.name: (visual, pose) for visual, pose in zip(empty.visuals, empty.visual_poses(), strict=True)}
    (left, left_pose), (right, right_pose) = place["claw_left_pad"], place["claw_right_pad"]
    apart = left_pose[:3, 3] - right_pose[:3, 3]
    gap = abs(left_pose[:3, 0] @ apart) - left.size_m[0]
    assert 0.067 <= gap <= 0.087
    assert abs(left_pose[:3, 0] @ right_pose[:3, 0]) == pytest.approx(1.0, abs=1e-3)
    assert abs(apart[2]) < 1e-3
    assert max(left.size_m) == ROBOT.claw.pad_length_m == max(right.size_m)
    middle = (left_pose[:3, 3] + right_pose[:3, 3]) / 2
    assert middle == pytest.approx(empty.link_pose("pad_centre")[:3, 3], abs=1e-3)


# --- repeatability ------------------------------------------------------------------------------------


COURSE = ((0.3, 0.2), (-0.1, 0.3), (0.4, 0.4))


def history(sensors: str, seed: int) -> list[bytes]:
    with World(ROBOT, load_scene("paper", seed), seed=seed, sensors=sensors) as world:  # type: ignore[arg-type]
        operator = Operator(world)
        told: list[bytes] = []
        for wheels_mps in COURSE:
            operator.run(0.8, arm=READY, hand={**LEVEL, **SHUT}, wheels_mps=wheels_mps)
            told += heard_from(world)
        return told


def heard_from(world: World) -> list[bytes]:
    messages = (world.truth(), world.base_state(), world.servo_state("arm"), world.servo_state("hand"))
    return [msgspec.msgpack.encode(message) for message in messages]


@pytest.mark.parametrize("sensors", ["ideal", "real"])
def test_the_same_seed_and_commands_give_the_same_bits(sensors: str) -> None:
    assert history(sensors, 4) == history(sensors, 4)


def test_another_seed_gives_another_run() -> None:
    assert history("real", 4) != history("real", 5)


def test_two_worlds_in_one_process_do_not_meet() -> None:
    with (
        World(ROBOT, scene_with(can(0.3, 0.0))) as other,
        World(ROBOT, load_scene("paper", 4), seed=4, sensors="real") as world,
    ):
        mine, operator = Operator(world), Operator(other)
        told: list[bytes] = []
        for wheels_mps in COURSE:
            for _ in range(8):
                mine.run(0.1, arm=READY, hand={**LEVEL, **SHUT}, wheels_mps=wheels_mps)
                operator.run(0.1, wheels_mps=(0.2, 0.2))
            told += heard_from(world)
    with World(ROBOT, load_scene("paper", 4), seed=4, sensors="real") as world:
        mine = Operator(world)
        alone: list[bytes] = []
        for wheels_mps in COURSE:
            for _ in range(8):
                mine.run(0.1, arm=READY, hand={**LEVEL, **SHUT}, wheels_mps=wheels_mps)
            alone += heard_from(world)
    assert told == alone


@pytest.mark.process
def test_importing_the_simulator_writes_nothing() -> None:
    done = subprocess.run([sys.executable, "-c", "import sim.world"], capture_output=True, check=True, timeout=60)
    assert done.stdout == b""
    assert done.stderr == b""
