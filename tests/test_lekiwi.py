"""The shipped description of the LeKiwi: it agrees with the published numbers, stands, moves, fetches a small can."""

from __future__ import annotations

import re
from importlib import resources
from math import degrees, radians
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from spelled import asked
from test_lekiwi_numbers import table
from world_operator import EMPTY, yaw_of

from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.errors import ConfigError
from cocoro.messages import BaseCommand, ServoCommand
from cocoro.robot import Robot
from deploy.profiles import read
from services.planning.clearance import Clearance
from services.planning.config import ArmConfig, HandConfig, HeadConfig, PlanningConfig
from services.planning.core import PlanningCore
from services.planning.gaze import BaseAsNeck, gaze_of
from services.planning.hand import widest_m
from services.planning.of_body import of_body
from services.planning.reach import HandPose, Reacher
from sim.world import World

HZ = 240
URDF_DEG = {"shoulder_pan": 0.0, "elbow_flex": -73.8, "gripper": 25.0}
"""The URDF's angle at a joint's angle 0, where that is another."""
BY_THE_CAN = """
name = "by the can"
[[object]]
label = "red_can"
shape = "cylinder"
SIZE
position_m = [0.7, 0.1]
"""


@pytest.fixture(scope="module")
def lekiwi() -> Robot:
    return Robot.load(Path("lekiwi"))


@pytest.fixture
def at_zero(lekiwi: Robot) -> dict[str, float]:
    """All joints at the URDF's angle 0."""
    return {name: radians(-URDF_DEG.get(name, 0.0)) for name in lekiwi.joints}


def test_its_frames_are_where_the_published_urdf_has_them(lekiwi: Robot, at_zero: dict[str, float]) -> None:
    base = lekiwi.chain("base_link").position({})
    for name, (text,) in table("frame").items():
        place = lekiwi.chain(name).position(at_zero) - base
        assert place == pytest.approx([float(word) for word in text.split(",")], abs=1e-5), name


def test_the_servos_turn_as_lerobots_do(lekiwi: Robot) -> None:
    for name, (number, limits, *_) in table("joint").items():
        joint, zero_deg = lekiwi.joints[name], URDF_DEG.get(name, 0.0)
        assert joint.id == int(number)
        low, high = (float(word) for word in re.findall(r"-?\d+\.\d+", limits)[:2])
        assert joint.limits_deg == pytest.approx((low - zero_deg, high - zero_deg), abs=0.1)
        at_zero_rad = joint.to_angle(2047.5)
        assert degrees(at_zero_rad) == pytest.approx(-zero_deg, abs=0.05)
        grows = 1 if name != "shoulder_pan" else -1  # the URDF's pan axis points down
        assert joint.to_angle(2147.5) * grows > at_zero_rad * grows


def test_a_turned_pan_joint_moves_the_hand_counter_clockwise(lekiwi: Robot) -> None:
    angles = dict.fromkeys(lekiwi.joints, 0.0) | lekiwi.poses["upright"] | {lekiwi.arm.azimuth: 0.5}
    assert lekiwi.chain(lekiwi.arm.tip).position(angles)[1] > 0.05


def test_its_postures_are_what_they_are_for(lekiwi: Robot) -> None:
    clearance = Clearance(lekiwi)
    for name in ("park", "upright"):
        assert clearance.of(dict.fromkeys(lekiwi.joints, 0.0) | lekiwi.poses[name]) > 0.03
    centres, radii = clearance.hull(dict.fromkeys(lekiwi.joints, 0.0) | lekiwi.poses["park"])
    assert (np.hypot(centres[:, 0], centres[:, 1]) + radii).max() < lekiwi.base.chassis_diameter_m / 2
    reacher = Reacher(lekiwi, ArmConfig().damping)
    for pose in ("upright", "unfolded"):
        hand = reacher.pose(reacher.upright | lekiwi.poses[pose])
        assert hand.pitch_rad == pytest.approx(ArmConfig().pitch_rad, abs=0.02)
        assert hand.height_m == pytest.approx(0.20, abs=0.005)


def test_it_reaches_where_its_description_says(lekiwi: Robot) -> None:
    reacher, clearance, config = Reacher(lekiwi, 0.02), Clearance(lekiwi), of_body(PlanningConfig(), lekiwi).arm
    for radius_m in (config.retreat_radius_m, *config.grasp_radius_range_m):
        found = reacher.solve(reacher.upright, HandPose(radius_m, 0.0, 0.05, config.pitch_rad))
        assert found is not None
        assert clearance.of(reacher.upright | found) > config.clearance_m


def test_what_a_profile_sets_counts_before_the_descriptions_reach(lekiwi: Robot, robot: Robot) -> None:
    assert lekiwi.reach is not None
    config = PlanningCore(lekiwi, PlanningConfig(arm=ArmConfig(carry_radius_m=0.3))).actuators.config.arm
    assert config.carry_radius_m == 0.3
    assert config.grasp_radius_m == lekiwi.reach.grasp_radius_m
    assert PlanningCore(robot, PlanningConfig()).actuators.config == PlanningConfig()
    data = lekiwi.to_data()
    data["reach"]["grasp_radius_range_m"] = [0.4, 0.3]
    with pytest.raises(ConfigError, match="grasp_radius_range_m must rise"):
        Robot.from_data(data)


def test_the_open_hand_takes_what_fits_between_its_pads(lekiwi: Robot, robot: Robot) -> None:
    assert widest_m(lekiwi, of_body(PlanningConfig(), lekiwi).hand) == pytest.approx(0.064, abs=0.001)
    assert widest_m(robot, HandConfig()) == pytest.approx(0.072 + 2 * 0.0686 * np.sin(0.42), abs=0.001)


def test_a_finger_is_named_by_its_link_and_closed_where_its_joint_is_not_told(lekiwi: Robot) -> None:
    assert list(lekiwi.hull.finger_turn_deg) == [lekiwi.link_of("gripper")] != ["gripper"]
    clearance, arm = Clearance(lekiwi), dict.fromkeys(lekiwi.joints, 0.0)
    without = {name: angle for name, angle in arm.items() if name != "gripper"}
    assert (clearance.hull(without)[0] == clearance.hull(arm)[0]).all()
    assert (clearance.hull(arm | {"gripper": 0.5})[0] != clearance.hull(arm)[0]).any()


def test_a_camera_behind_the_middle_sees_the_floor_that_the_picture_shows(lekiwi: Robot) -> None:
    gaze = gaze_of(lekiwi, HeadConfig())
    assert isinstance(gaze, BaseAsNeck)
    into = np.linalg.inv(lekiwi.camera_chain.pose({}))

    def row_px(distance_m: float) -> float:
        _, y, z, _ = into @ [distance_m, 0.0, 0.0, 1.0]
        return float(lekiwi.camera.cy + lekiwi.camera.fy * y / z)

    margin_px = 60  # HeadConfig.view_margin_rad and no more
    assert lekiwi.camera.height - margin_px < row_px(gaze.nearest_m) < lekiwi.camera.height
    assert 0 < row_px(gaze.farthest_m) < margin_px
    assert not gaze.hides(np.zeros(3), np.array([0.5, 0.8, 1.2])).any()


def test_a_shipped_robot_is_asked_for_by_its_name(lekiwi: Robot, robot: Robot, tmp_path: Path) -> None:
    assert Robot.load(Path("calliope")).to_data() == robot.to_data()
    assert resources.files("cocoro").joinpath("lekiwi.toml").is_file()
    profile = tmp_path / "kiwi.toml"
    profile.write_text('robot = "kiwi"\ndescription = "lekiwi"\nprocesses = ["planning"]\n', encoding="utf-8")
    assert Robot.load(*read(str(profile)).robot_files).to_data() == lekiwi.to_data()
    with pytest.raises(ConfigError, match="lekiwi2"):
        Robot.load(Path("lekiwi2"))


@pytest.mark.sim
def test_it_stands_moves_every_joint_and_drives_in_every_direction(lekiwi: Robot) -> None:
    moves = (BaseCommand(ahead_mps=0.12, turn_radps=0.0, aside_mps=0.1), BaseCommand(ahead_mps=0.0, turn_radps=0.8))
    hand = ServoCommand(
        joints=("wrist_roll", "gripper"), goal_rad=(lekiwi.claw.level_roll_rad, 0.42), speed_radps=(2.5, 2.5)
    )
    with World(lekiwi, EMPTY) as world:
        world.set_latch("released")
        for pose in ("unfolded", "upright"):
            goals = lekiwi.poses[pose]
            arm = ServoCommand(joints=tuple(goals), goal_rad=tuple(goals.values()), speed_radps=(2.5,) * len(goals))
            for step in range(HZ * 3 // 2):
                if step % 5 == 0:
                    world.command_servos("arm", arm)
                    world.command_servos("hand", hand)
                    world.command_base(moves[step > HZ // 2])
                world.step()
                if step % 40 == 0:
                    truth = world.truth()
                    assert not truth.collisions
            place = dict(zip(world.servo_state("arm").joints, world.servo_state("arm").position_rad, strict=True))
            assert {name: place[name] for name in goals} == pytest.approx(goals, abs=0.05)
        assert world.servo_state("hand").position_rad == pytest.approx(hand.goal_rad, abs=0.05)
        truth = world.truth()
        assert min(truth.body_m[:2]) > 0.03
        assert yaw_of(truth) > 0.8


def fetched(tmp_path: Path, radius_m: float, height_m: float, description: str = "lekiwi") -> dict[str, Any]:
    """The result of fetching a can of this size."""
    text = resources.files("cocoro").joinpath("objects.toml").read_text(encoding="utf-8")
    size = f"radius_m = {radius_m}\nheight_m = {height_m}"
    scene, objects = tmp_path / "scene.toml", tmp_path / "objects.toml"
    scene.write_text(BY_THE_CAN.replace("SIZE", size), encoding="utf-8")
    objects.write_text(text.replace("radius_m = 0.033\nheight_m = 0.120", size), encoding="utf-8")
    return rehearse(
        RehearsalRequest(
            task=asked("fetch", "red_can").task, scene=str(scene), description=description, objects=str(objects),
            width=320, height=240, frame_rate_hz=15.0,
        )
    )  # fmt: skip


@pytest.mark.sim
def test_it_finds_approaches_grasps_and_lifts_a_small_can(tmp_path: Path) -> None:
    result = fetched(tmp_path, 0.02, 0.1)
    assert (result["outcome"], result["reason"]) == ("done", "")
    assert result["truth"]["held"]
    assert result["truth"]["lifted_m"] > 0.08
    assert not result["truth"]["collisions"]
    assert not result["truth"]["knocked_over"]


@pytest.mark.sim
def test_what_is_wider_than_the_open_hand_is_left_alone(tmp_path: Path) -> None:
    result = fetched(tmp_path, 0.033, 0.12)
    assert result["outcome"] == "failed"
    assert "66 mm wide" in result["reason"]
    assert result["truth"]["target_moved_m"] < 0.002
