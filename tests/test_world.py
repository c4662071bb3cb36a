"""The PyBullet world: its robot is the described one, moves as commanded, and holds a can by friction alone."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator, Mapping
from math import asin, atan2, cos, hypot, pi, radians

import msgspec
import numpy as np
import pytest

from cocoro.kinematics import Array
from cocoro.messages import BaseCommand, ServoCommand, TrueObject, Truth
from cocoro.robot import SERVO_COUNT_RAD, Robot
from sim.bullet import Bullet
from sim.judge import Judge
from sim.mechanism import Mechanism
from sim.model import build_model
from sim.scene import Obstacle, Scene, SceneObject, Start, load_scene
from sim.world import World

pytestmark = pytest.mark.sim

ROBOT = Robot.load()
EMPTY = Scene(name="empty")
ARM = ("arm_base", "shoulder", "elbow", "wrist_pitch")
LEVEL = {"wrist_roll": pi / 2}
OPEN = {"claw_left": -radians(20), "claw_right": radians(20)}
SHUT = {"claw_left": radians(15), "claw_right": -radians(15)}
READY = {"arm_base": 0.0, "shoulder": 1.2, "elbow": -1.8, "wrist_pitch": 0.5}
"""Above the floor before the robot: where the search for arm angles starts."""
COMMAND_EVERY = 5


class Operator:
    """Commands a world at 48 Hz and feeds a judge."""

    def __init__(self, world: World, judge: Judge | None = None) -> None:
        self.world = world
        self.judge = judge
        self.seen: set[str] = set()
        """Collisions so far."""
        world.set_latch("released")

    def run(
        self,
        seconds: float,
        *,
        arm: Mapping[str, float] | None = None,
        hand: Mapping[str, float] | None = None,
        wheels_mps: tuple[float, float] | None = None,
        speed_radps: float = 1.5,
    ) -> None:
        for step in range(round(seconds * 240)):
            if step % COMMAND_EVERY == 0:
                for name, goals in (("arm", arm), ("hand", hand)):
                    if goals:
                        self.world.command_servos(
                            name,
                            ServoCommand(
                                joints=tuple(goals),
                                goal_rad=tuple(goals.values()),
                                speed_radps=(speed_radps,) * len(goals),
                            ),
                        )
                if wheels_mps:
                    self.world.command_base(BaseCommand(left_mps=wheels_mps[0], right_mps=wheels_mps[1]))
            self.world.step()
            if step % 8 == 7:
                truth = self.world.truth()
                self.seen.update(truth.collisions)
                if self.judge:
                    self.judge.feed(truth)

    def reach(
        self, start_m: Array, end_m: Array, pitch_rad: float, seconds: float, arm: Mapping[str, float]
    ) -> dict[str, float]:
        """Carry the pad centre along a line; returns the arm's angles at its end."""
        angles = dict(arm)
        points = 8
        for point in range(1, points + 1):
            angles = arm_angles(start_m + (end_m - start_m) * point / points, pitch_rad, angles)
            self.run(seconds / points, arm=angles)
        return angles


def arm_angles(target_m: Array, pitch_rad: float, start: Mapping[str, float]) -> dict[str, float]:
    """Damped least squares: arm angles that bring the pad centre to a point of the body frame, the roll axis
    pitched so (up positive), the claws level."""
    chain = ROBOT.chain("pad_centre")
    angles = {**start, **LEVEL}
    for _ in range(100):
        pose = chain.pose(angles)
        axis, pitch = pose[:3, 2], asin(pose[2, 2])
        error = np.append(target_m - pose[:3, 3], 0.3 * (pitch_rad - pitch))
        if np.linalg.norm(error) < 1e-5:
            return {joint: angles[joint] for joint in ARM}
        jacobian = chain.jacobian(angles, ARM)
        turn = np.cross(jacobian[3:].T, axis)[:, 2] / cos(pitch)
        rows = np.vstack([jacobian[:3], 0.3 * turn])
        move = rows.T @ np.linalg.solve(rows @ rows.T + 1e-5 * np.eye(4), error)
        move *= min(1.0, 0.2 / float(np.abs(move).max()))
        for joint, by in zip(ARM, move, strict=True):
            low, high = ROBOT.joints[joint].limits_rad
            angles[joint] = min(max(angles[joint] + float(by), low), high)
    raise AssertionError(f"no arm angles for {target_m}")


def can(x_m: float, y_m: float, mass_kg: float = 0.2) -> SceneObject:
    return SceneObject(
        label="red_can", shape="cylinder", radius_m=0.033, height_m=0.12, position_m=(x_m, y_m), mass_kg=mass_kg
    )


def scene_with(*objects: SceneObject, obstacles: tuple[Obstacle, ...] = ()) -> Scene:
    return Scene(name="test", objects=objects, obstacles=obstacles)


def the_can(world: World) -> TrueObject:
    return world.truth().objects[0]


def yaw_of(truth: Truth) -> float:
    return 2.0 * atan2(truth.body_orientation[2], truth.body_orientation[3])


@pytest.fixture
def empty() -> Iterator[World]:
    with World(ROBOT, EMPTY) as world:
        yield world


# --- the body ---------------------------------------------------------------------------------------


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
        assert angle_rad == pytest.approx(wanted, abs=SERVO_COUNT_RAD), joint
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


# --- motion ---------------------------------------------------------------------------------------


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
    # 3 s of commands, 0.2 s of the deadman's patience, and what the two ramps take off and give back.
    held_s = 3.0 + 0.2 - COMMAND_EVERY / 240
    assert state.odometry_yaw_rad == pytest.approx(
        (right_mps - left_mps) / ROBOT.base.wheel_separation_m * held_s, rel=0.01, abs=0.002
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
    assert empty.command_base(BaseCommand(left_mps=0.2, right_mps=0.2)) == "latch unknown"
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
    assert truth.joints_rad["neck_pan"] == pytest.approx(0.0, abs=SERVO_COUNT_RAD)
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
                {joint: draws.uniform(*ROBOT.joints[joint].limits_rad) for joint in ROBOT.network_joints(name)}
                for name in ("arm", "hand")
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
            assert abs(yaw_of(truth)) < 0.05 * 0.84 / ROBOT.base.wheel_separation_m
            # What the wheels were told is all that a Create's driver can know; here they did it.
            assert state.odometry_m[0] == pytest.approx(0.2 * (4.2 - COMMAND_EVERY / 240), rel=0.005)
    assert np.std(errors) > 0.001


# --- grasping -------------------------------------------------------------------------------------


def grasp_and_lift(
    world: World, at_m: tuple[float, float], pitch_rad: float, judge: Judge, height_m: float = 0.06
) -> Operator:
    """Open, reach along the ground to `at_m`, close, lift to 0.25 m and wait 3 s."""
    x, y = at_m
    operator = Operator(world, judge)
    before, there, high = (
        np.array(point) for point in ([x - 0.09, y, height_m + 0.005], [x, y, height_m], [x - 0.1, y, 0.25])
    )
    above = before + np.array([0.02, 0.0, 0.14])
    angles = arm_angles(above, pitch_rad, READY)
    operator.run(2.5, arm=angles, hand={**LEVEL, **OPEN})
    angles = operator.reach(above, before, pitch_rad, 1.0, angles)
    angles = operator.reach(before, there, pitch_rad, 1.5, angles)
    operator.run(0.3, arm=angles)
    operator.run(1.0, hand=SHUT)
    angles = operator.reach(there, high, pitch_rad, 2.0, angles)
    operator.run(3.0, arm=angles)
    return operator


@pytest.mark.parametrize("sensors", ["ideal", "real"])
@pytest.mark.parametrize(
    ("offset_m", "pitch_deg", "mass_kg"),
    [
        ((0.0, 0.0), 0.0, 0.2),
        ((0.015, 0.015), -10.0, 0.2),
        ((-0.015, -0.015), -15.0, 0.2),
        ((0.0, 0.01), -5.0, 0.35),
    ],
)
def test_a_can_is_held_by_friction_alone(
    sensors: str, offset_m: tuple[float, float], pitch_deg: float, mass_kg: float
) -> None:
    scene = scene_with(can(0.58 + offset_m[0], -0.10 + offset_m[1], mass_kg))
    judge = Judge(scene, "red_can")
    with World(ROBOT, scene, seed=3, sensors=sensors) as world:  # type: ignore[arg-type]
        operator = grasp_and_lift(world, (0.58, -0.10), radians(pitch_deg), judge)
        verdict = judge.result()
        assert verdict.held, the_can(world)
        assert verdict.lifted_m > 0.15
        assert verdict.knocked_over == ()
        assert operator.seen == set()
        hand = world.servo_state("hand")
        assert hand.faults == ()
        load = dict(zip(hand.joints, hand.load, strict=True))
        assert load["claw_left"] > 0.3 < -load["claw_right"]  # each pushes inwards


def test_a_held_can_survives_a_shake_and_the_end_of_commands() -> None:
    scene = scene_with(can(0.58, -0.10))
    judge = Judge(scene, "red_can")
    with World(ROBOT, scene) as world:
        operator = grasp_and_lift(world, (0.58, -0.10), radians(-5.0), judge)
        hand = np.linalg.inv(world.link_pose("pad_centre"))
        before = hand @ [*the_can(world).position_m, 1.0]
        for sway in (0.25, -0.25, 0.25, 0.0):
            operator.run(0.4, arm={"arm_base": sway}, speed_radps=2.0)
        operator.run(0.5, wheels_mps=(-0.3, -0.3))
        operator.run(0.5, wheels_mps=(-0.2, 0.2))
        operator.run(3.0)
        after = np.linalg.inv(world.link_pose("pad_centre")) @ [*the_can(world).position_m, 1.0]
        assert judge.result().held
        assert np.linalg.norm(after - before) < 0.01
        operator.run(1.0, hand=OPEN)
        operator.run(0.5)
        assert the_can(world).position_m[2] < 0.12
        assert not judge.result().held


def test_a_ball_is_held_too() -> None:
    ball = SceneObject(label="yellow_ball", shape="sphere", radius_m=0.03, position_m=(0.58, -0.10), mass_kg=0.1)
    scene = scene_with(ball)
    judge = Judge(scene, "yellow_ball")
    with World(ROBOT, scene, seed=1, sensors="real") as world:
        operator = grasp_and_lift(world, (0.58, -0.10), 0.0, judge, height_m=0.035)
        assert judge.result().held
        assert operator.seen == set()


def test_claws_that_close_on_nothing_meet_and_that_is_no_collision(empty: World) -> None:
    operator = Operator(empty)
    operator.run(1.5, arm=READY, hand={**LEVEL, "claw_left": radians(40), "claw_right": -radians(40)})
    angles = empty.truth().joints_rad
    assert 0.0 < angles["claw_left"] < radians(25)
    assert 0.0 < -angles["claw_right"] < radians(25)
    assert operator.seen == set()


# --- the stage -------------------------------------------------------------------------------------


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
        judge = Judge(scene, "red_can")
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
    marker = empty.link_pose("wrist_roll") @ [*ROBOT.marker.position_m, 1.0]
    assert place["marker"][:3, 3] == pytest.approx(marker[:3], abs=1e-6)
    low, high = np.array(ROBOT.kinect.mount_min_m), np.array(ROBOT.kinect.mount_max_m)
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


def test_importing_the_simulator_writes_nothing() -> None:
    done = subprocess.run([sys.executable, "-c", "import sim.world"], capture_output=True, check=True, timeout=60)
    assert done.stdout == b""
    assert done.stderr == b""
