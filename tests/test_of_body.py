"""Settings that follow from a robot's body: by one rule for all, and the Calliope's as they were chosen on it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from cocoro.drive import Twist
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from services.planning.arm import ArmController
from services.planning.config import ArmConfig, ByHandConfig, HandConfig, NavigationConfig, PlanningConfig
from services.planning.gaze import gaze_of
from services.planning.hand import aside_m, gap_m, side_room_m
from services.planning.of_body import of_body
from services.planning.own_arm import OwnArm
from services.planning.reach import HandPose, Reacher
from sim.body import body_of_parts, pose_of
from sim.random_scene import find_scene

CAN_RADII_M = {"calliope": 0.033, "lekiwi": 0.020}
DT_S = 0.02


@pytest.fixture(scope="module")
def lekiwi() -> Robot:
    return Robot.load(Path("lekiwi"))


@pytest.fixture(scope="module")
def settings(lekiwi: Robot) -> PlanningConfig:
    return of_body(PlanningConfig(), lekiwi)


def test_a_calliopes_settings_are_the_planners_own(robot: Robot) -> None:
    assert of_body(PlanningConfig(), robot) == PlanningConfig()


def test_a_smaller_hand_is_opened_as_its_description_says_and_must_know_better(
    lekiwi: Robot, settings: PlanningConfig
) -> None:
    assert settings.hand.open_rad == pytest.approx(0.698, abs=0.001)
    assert settings.hand.clamp_rad == 2 * HandConfig().clamp_rad
    assert settings.arm.grasp_sigma_m == 0.009 < ArmConfig().grasp_sigma_m
    assert settings.navigation.hand_half_width_m == 0.07
    assert settings.by_hand.radius_m == (0.205, 0.41)
    top_mps = lekiwi.base.max_wheel_speed_mps / lekiwi.drive.fastest(Twist(1.0, 0.0))
    assert max(settings.navigation.max_speed_mps, settings.follow.max_speed_mps) < top_mps


def test_what_a_profile_sets_counts_first(lekiwi: Robot) -> None:
    profile = PlanningConfig(
        arm=ArmConfig(grasp_sigma_m=0.02, insert_speed_mps=0.1),
        hand=HandConfig(open_rad=0.5),
        navigation=NavigationConfig(hand_half_width_m=0.12, max_speed_mps=0.1),
        by_hand=ByHandConfig(radius_m=(0.25, 0.35)),
    )
    got = of_body(profile, lekiwi)
    assert (got.arm.grasp_sigma_m, got.arm.insert_speed_mps) == (0.02, 0.1)
    assert got.hand.open_rad == 0.5
    assert got.navigation == profile.navigation
    assert got.by_hand == profile.by_hand


@pytest.mark.parametrize("name", ["calliope", "lekiwi"])
def test_the_fingers_come_down_before_the_nearest_target(name: str) -> None:
    robot = Robot.load(Path(name))
    arm = of_body(PlanningConfig(), robot).arm
    ends_m = arm.retreat_radius_m + robot.claw.pad_length_m / 2
    assert arm.grasp_radius_range_m[0] == pytest.approx(ends_m + CAN_RADII_M[name] + 0.010, abs=0.0005)
    assert arm.grasp_radius_range_m[0] < arm.grasp_radius_m < arm.grasp_radius_range_m[1]


def test_a_fixed_finger_leaves_as_much_room_as_the_jaw_within_what_the_jaw_may_push(
    lekiwi: Robot, settings: PlanningConfig, robot: Robot
) -> None:
    hand = settings.hand
    assert side_room_m(lekiwi, hand, 0.040) == pytest.approx(0.015)
    assert side_room_m(lekiwi, hand, 0.050) == pytest.approx((gap_m(lekiwi, hand.open_rad) - 0.05) / 2)
    assert side_room_m(lekiwi, hand, 0.060) == hand.fixed_finger_room_m
    assert side_room_m(robot, HandConfig(), 0.066) == 0.0
    assert abs(aside_m(lekiwi, 0.04, 0.015)) == pytest.approx(0.035, abs=1e-4)


def moved(robot: Robot, config: ArmConfig, goal: HandPose, start: HandPose) -> tuple[bool, float]:
    """Whether the hand arrives from a pose at another, and its least height on the way, m."""
    reacher = Reacher(robot, config.damping)
    solved = reacher.solve(reacher.upright, start)
    assert solved is not None
    angles = dict.fromkeys(robot.joints, 0.0) | reacher.upright | solved
    arm, low_m = ArmController(robot, config, reacher), 1.0
    for _ in range(200):
        step = arm.reach(goal, config.insert_speed_mps, angles, DT_S)
        angles.update(zip(robot.arm.joints, step.goal_rad.tolist(), strict=True))
        low_m = min(low_m, reacher.pose(angles).height_m)
        if step.blocked or step.arrived:
            break
    return step.arrived, low_m


def test_the_hand_closes_in_level_at_its_lowest_where_it_would_dip_as_fast_as_a_longer_arm(
    lekiwi: Robot, settings: PlanningConfig
) -> None:
    low_m = settings.arm.grasp_height_range_m[0]
    assert low_m == 0.036
    start = HandPose(settings.arm.retreat_radius_m, 0.0, low_m, settings.arm.pitch_rad)
    goal = start._replace(radius_m=settings.arm.grasp_radius_m)
    arrived, least_m = moved(lekiwi, settings.arm, goal, start)
    assert arrived
    assert least_m > low_m - 0.004
    fast = of_body(PlanningConfig(arm=ArmConfig(insert_speed_mps=0.351)), lekiwi).arm
    assert not moved(lekiwi, fast, goal, start)[0]


def test_the_arm_folds_from_where_it_waits_behind_a_target(lekiwi: Robot, settings: PlanningConfig) -> None:
    config = settings.arm
    reacher = Reacher(lekiwi, config.damping)
    solved = reacher.solve(reacher.upright, HandPose(config.retreat_radius_m, 0.0, 0.05, config.pitch_rad))
    assert solved is not None
    angles = dict.fromkeys(lekiwi.joints, 0.0) | reacher.upright | solved
    arm = ArmController(lekiwi, config, reacher)
    for _ in range(400):
        step = arm.park(angles, DT_S)
        assert not step.blocked
        angles.update(zip(lekiwi.arm.joints, step.goal_rad.tolist(), strict=True))
        angles[lekiwi.arm.roll] = step.roll_rad
        if arm.parked(angles):
            return
    pytest.fail("not folded")


def test_a_hand_before_a_fixed_camera_hides_the_target_and_a_folded_one_does_not(
    lekiwi: Robot, settings: PlanningConfig, robot: Robot
) -> None:
    known = {item.label: item for item in Catalogue.load().targets}
    own = OwnArm(lekiwi, gaze_of(lekiwi, settings.head), known)
    reacher, can_m = Reacher(lekiwi, settings.arm.damping), (0.42, 0.0, 0.05)
    solved = reacher.solve(reacher.upright, HandPose(0.275, 0.0, 0.05, settings.arm.pitch_rad))
    assert solved is not None
    zero = dict.fromkeys(lekiwi.joints, 0.0)
    assert own.hides("red_can", can_m, zero | reacher.upright | solved)
    assert not own.hides("red_can", (0.9, 0.0, 0.05), zero | lekiwi.poses["park"])
    necked = OwnArm(robot, gaze_of(robot, settings.head), known)
    assert not necked.hides("red_can", can_m, dict.fromkeys(robot.joints, 0.0) | robot.poses["upright"])


@pytest.mark.parametrize("name", ["calliope", "lekiwi"])
def test_the_simulated_fingers_lie_at_one_height(name: str) -> None:
    robot = Robot.load(Path(name))
    level = dict.fromkeys(robot.joints, 0.0) | robot.poses["upright"] | {robot.arm.roll: robot.claw.level_roll_rad}
    pads = [(link, part) for link, parts in body_of_parts(robot).parts.items() for part in parts if "_pad" in part.name]
    heights = [float((robot.chain(link).pose(level) @ pose_of(part))[2, 3]) for link, part in pads]
    assert len(heights) == 2
    assert np.ptp(heights) < 0.001


def test_a_scaled_scene_is_at_the_distances_of_the_robots_arm(lekiwi: Robot, robot: Robot) -> None:
    for name in ("paper", "random"):
        plain, same, near = (
            find_scene(scene, 3, robot=body)
            for scene, body in ((name, lekiwi), (f"{name}-scaled", robot), (f"{name}-scaled", lekiwi))
        )
        assert same.objects == plain.objects
        # Those of a random scene that would stand too near to each other are drawn anew.
        share = np.array(near.objects[0].position_m) / plain.objects[0].position_m
        assert share == pytest.approx(0.35 / 0.49)
