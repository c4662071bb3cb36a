"""A robot whose camera is fixed on its body: the base is its neck."""

from __future__ import annotations

from math import pi
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from bodies import without_neck, written
from spelled import asked

import cocoro
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.frames import Pose2
from cocoro.messages import BaseCommand, Frame, Motion
from cocoro.robot import Robot
from cocoro.testing import CoreUnderTest
from cocoro.topics import DETECTIONS, FRAME
from services.perception.config import PerceptionConfig
from services.perception.core import PerceptionCore
from services.planning.arm import ArmStep
from services.planning.config import HeadConfig, PlanningConfig
from services.planning.core import PlanningCore
from services.planning.gaze import BaseAsNeck, Neck, gaze_of
from services.planning.head import Aim

DOWN_DEG = 28.0
BEHIND = """
name = "behind"
[[object]]
label = "red_can"
shape = "cylinder"
radius_m = 0.033
height_m = 0.12
position_m = [-0.5, 1.2]
"""
LOW_BALL = """
name = "low ball"
[[object]]
label = "blue_ball"
shape = "sphere"
radius_m = 0.04
position_m = [1.0, 0.0, 0.15]
path_m = [[2.0, 0.0], [2.0, 2.0]]
speed_mps = 0.25
floating = true
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> str:
    return written(tmp_path_factory.mktemp("body"), without_neck(DOWN_DEG))


@pytest.fixture(scope="module")
def fixed(file: str) -> Robot:
    return Robot.load(Path(file))


@pytest.fixture(scope="module")
def gaze(fixed: Robot) -> BaseAsNeck:
    return BaseAsNeck(fixed, HeadConfig())


def rehearsed(file: str, task: str, label: str, tmp_path: Path, scene: str, **more: Any) -> dict[str, Any]:
    place = tmp_path / "scene.toml"
    place.write_text(scene, encoding="utf-8")
    return rehearse(
        RehearsalRequest(
            task=asked(task, label, **more).task, scene=str(place), description=file, width=320, height=240,
            frame_rate_hz=15.0,
        )
    )  # fmt: skip


@pytest.mark.sim
def test_it_turns_until_it_sees_a_can_behind_it_and_drives_to_it(file: str, tmp_path: Path) -> None:
    result = rehearsed(file, "go-to", "red_can", tmp_path, BEHIND)
    assert (result["outcome"], result["reason"]) == ("done", "")
    assert [phase["name"] for phase in result["phases"]] == ["search", "go-to"]
    assert result["tasks"][0]["target_edge_m"] == pytest.approx(0.2, abs=0.02)
    assert not result["truth"]["collisions"]
    assert not result["truth"]["knocked_over"]


@pytest.mark.sim
def test_it_keeps_behind_a_ball_that_turns_a_corner(file: str, tmp_path: Path) -> None:
    result = rehearsed(file, "follow", "blue_ball", tmp_path, LOW_BALL, for_s=9.0)
    assert (result["outcome"], result["reason"]) == ("done", "")
    assert result["truth"]["contacts"] == 0
    assert result["truth"]["lost_s"] <= 0.5
    assert result["truth"]["near_share"] > 0.9


@pytest.mark.sim
def test_a_task_that_needs_a_neck_is_refused_with_the_reason(file: str, tmp_path: Path) -> None:
    with pytest.raises(cocoro.NotAbleError, match="calliope has no neck: its camera is fixed on its body; babble-wh"):
        rehearsed(file, "babble-wheels", "red_can", tmp_path, BEHIND)


def test_a_robot_has_the_gaze_that_its_description_gives_it(fixed: Robot, robot: Robot) -> None:
    assert isinstance(gaze_of(fixed, HeadConfig()), BaseAsNeck)
    assert isinstance(gaze_of(robot, HeadConfig()), Neck)


def test_floor_from_the_nearest_to_the_farthest_distance_is_in_the_picture(fixed: Robot, gaze: BaseAsNeck) -> None:
    def row_px(distance_m: float) -> float:
        pose = fixed.camera_chain.pose({})
        _, y, z = pose[:3, :3].T @ (np.array([distance_m, 0.0, 0.0]) - pose[:3, 3])
        return float(fixed.camera.cy + fixed.camera.fy * y / z)

    low, high = -0.5, fixed.camera.height - 0.5
    assert 0.5 < gaze.nearest_m < gaze.farthest_m < 5.0
    for distance_m in (gaze.nearest_m, gaze.farthest_m):
        assert low < row_px(distance_m) < high
    assert not low < row_px(gaze.nearest_m - 0.25) < high
    assert not low < row_px(gaze.farthest_m + 3.0) < high


def test_it_hides_what_is_too_near_and_too_far_in_every_direction(gaze: BaseAsNeck) -> None:
    bearings = np.linspace(-pi, pi, 7)
    for distance_m, hidden in ((0.5, True), (1.0, False), (2.5, False), (5.0, True)):
        assert (gaze.hides(bearings, np.full(7, distance_m)) == hidden).all()


def test_only_what_is_before_the_camera_is_shown_while_the_body_stands(gaze: BaseAsNeck) -> None:
    assert gaze.shows((1.2, 0.0, 0.06))
    assert not gaze.shows((1.2, 1.2, 0.06))
    assert not gaze.shows((-1.2, 0.0, 0.06))
    assert not gaze.shows((0.4, 0.0, 0.06))


def test_a_camera_that_looks_up_sees_no_floor(tmp_path: Path) -> None:
    up = Robot.load(Path(written(tmp_path, without_neck(-30.0))))
    assert gaze_of(up, HeadConfig()).hides(np.zeros(3), np.array([0.5, 1.0, 2.0])).all()


def test_an_operator_who_turns_the_head_turns_the_base(gaze: BaseAsNeck) -> None:
    motion, why_not = gaze.steered(Motion(speed_mps=0.1, turn_radps=0.2, pan_radps=0.3))
    assert motion == Motion(speed_mps=0.1, turn_radps=0.5)
    assert why_not == ""
    motion, why_not = gaze.steered(Motion(tilt_radps=0.3))
    assert motion.zero
    assert why_not == "the camera is fixed on the body: it cannot be tilted"


def test_perception_waits_for_no_head_angles(fixed: Robot) -> None:
    test = CoreUnderTest(PerceptionCore(fixed, PerceptionConfig(), cocoro.Catalogue.load()))
    test.now_ns = 10**9
    pixels = 160 * 120
    depth = np.full(pixels, 2047, dtype="<u2").tobytes()
    black = Frame(stamp_ns=10**9, width=160, height=120, colour=memoryview(bytes(3 * pixels)), depth=memoryview(depth))
    test.feed(FRAME, black)
    test.step()
    assert test.latest(DETECTIONS).pan_rad is None


def test_the_planner_commands_no_joints_of_a_neck(fixed: Robot) -> None:
    assert PlanningCore(fixed, PlanningConfig()).actuators.gaze.joints == ()


class Standing:
    """A robot that stands, its body turned."""

    def __init__(self, yaw_rad: float = 0.0, turning_radps: float = 0.0, *, folded: bool = True) -> None:
        self.angles: dict[str, float] = {}
        self.body = Pose2(0.0, 0.0, yaw_rad)
        self.turning_radps, self.folded = turning_radps, folded
        self.step = ArmStep(np.zeros(4), np.zeros(4), 0.0, 0.0, True)

    def stand(self) -> BaseCommand:
        return BaseCommand(ahead_mps=0.0, turn_radps=0.0)

    def still(self) -> ArmStep:
        return self.step._replace(arrived=False)

    def fold(self) -> ArmStep:
        return self.step

    def turn(self, left_rad: float, most_radps: float) -> BaseCommand:
        return BaseCommand(ahead_mps=0.0, turn_radps=min(max(left_rad, -most_radps), most_radps))


def turned(gaze: BaseAsNeck, aim: Aim | None, **here: Any) -> float:
    return gaze.turn(aim, Standing(**here)).turn_radps


def test_the_base_turns_to_what_is_to_be_looked_at_the_shorter_way(gaze: BaseAsNeck) -> None:
    left = Aim(*gaze.at((0.0, 1.0, 0.0), (), {}, Pose2()), 4.0)
    assert turned(gaze, left) == HeadConfig().body_turn_radps
    assert turned(gaze, left, yaw_rad=-2.0) == -HeadConfig().body_turn_radps
    assert turned(gaze, left, yaw_rad=pi / 2 - 0.1) == pytest.approx(0.1)
    assert turned(gaze, left._replace(speed_radps=0.3)) == pytest.approx(0.3)


def test_the_base_does_not_turn_with_the_arm_out_or_without_an_aim(gaze: BaseAsNeck) -> None:
    aim = Aim(1.0, 0.0, 1.0)
    assert turned(gaze, aim, folded=False) == 0.0
    assert turned(gaze, None) == 0.0
    assert gaze.arm(Standing()).arrived, "it folds the arm"


def test_the_camera_rests_at_an_aim_when_the_base_is_there_and_stands(gaze: BaseAsNeck) -> None:
    assert gaze.reached((1.0, 0.0), Standing(yaw_rad=1.03))
    assert gaze.reached((1.0 + 2 * pi, 0.0), Standing(yaw_rad=1.0))
    assert not gaze.reached((1.0, 0.0), Standing(yaw_rad=1.2))
    assert not gaze.reached((1.0, 0.0), Standing(yaw_rad=1.0, turning_radps=0.4))


def test_a_sweep_shows_every_direction_once(fixed: Robot, gaze: BaseAsNeck) -> None:
    sweep, aims = gaze.sweep(Standing(yaw_rad=2.0)), []
    while not sweep.done:
        aims.append(sweep.aim[0])
        sweep.go_on()
    assert aims[0] == pytest.approx(2.0)
    for bearing in np.linspace(-pi, pi, 40):
        off = min(abs((bearing - aim + pi) % (2 * pi) - pi) for aim in aims)
        assert off < fixed.eye.horizontal_fov_rad / 2


def test_looking_at_parts_of_the_floor_turns_the_body_to_each(gaze: BaseAsNeck) -> None:
    floor = np.array([[1.0, 1.0], [1.05, 1.2], [-2.0, 1.5]])
    way = gaze.glances(floor, Standing(yaw_rad=0.5))
    assert {round(aim.pan_rad - 0.5, 2) for aim in way} == {round((1.0 + 1.05) / 2, 2), -2.0}
    assert all(aim.tilt_rad == pytest.approx(-DOWN_DEG * pi / 180) for aim in way)
