"""Arcs that bring a target beside the robot, and the wheels' limits."""

from __future__ import annotations

from math import atan2, cos, hypot, pi, sin

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cocoro.frames import Pose2
from cocoro.messages import BaseCommand
from cocoro.robot import Robot
from services.planning.config import PlanningConfig
from services.planning.course import Course, Move
from services.planning.navigation import GENTLE, Driver, offset_to
from services.planning.surroundings import Surroundings

ROBOT = Robot.load()
CONFIG = PlanningConfig().navigation
AIM_M = (0.58, -0.10)
TICK_S = 0.02


class Base:
    """A base that follows commands exactly."""

    def __init__(self) -> None:
        self.pose = Pose2()
        self.commands: list[BaseCommand] = []

    def obey(self, command: BaseCommand) -> None:
        self.commands.append(command)
        speed, turn = command.ahead_mps, command.turn_radps
        half = turn * TICK_S / 2
        way = speed * TICK_S
        self.pose = self.pose.compose(Pose2(way * cos(half), way * sin(half), 2 * half))

    @property
    def speeds(self) -> list[tuple[float, float]]:
        """Speed and turn rate of each command."""
        return [(c.ahead_mps, c.turn_radps) for c in self.commands]


def driven(distance_m: float, bearing_rad: float, most_s: float = 40.0) -> tuple[Base, bool]:
    """Drive until the target stands at the aim; whether it ever did."""
    driver, base = Driver(CONFIG, ROBOT.base), Base()
    target = (distance_m * cos(bearing_rad), distance_m * sin(bearing_rad), 0.0)
    for _ in range(round(most_s / TICK_S)):
        x, y, _z = base.pose.inverse().apply(target)
        offset = offset_to((x, y), AIM_M)
        if driver.arrived(offset) and not driver.moving:
            return base, True
        speed, turn = (0.0, 0.0) if driver.arrived(offset) else driver.law(offset)
        base.obey(driver.command(speed, turn, TICK_S))
    return base, False


@settings(max_examples=60)
@given(distance_m=st.floats(0.7, 3.0), bearing_rad=st.floats(-pi, pi))
def test_from_every_bearing_the_target_comes_to_where_the_arm_reaches(distance_m: float, bearing_rad: float) -> None:
    base, arrived = driven(distance_m, bearing_rad)
    assert arrived
    target = (distance_m * cos(bearing_rad), distance_m * sin(bearing_rad), 0.0)
    x, y, _ = base.pose.inverse().apply(target)
    assert hypot(x - AIM_M[0], y - AIM_M[1]) < 0.05
    lead = max(CONFIG.acceleration_mps2, CONFIG.turn_acceleration_radps2 * ROBOT.base.axle_m / 2) * TICK_S
    assert max(ROBOT.drive.fastest_mps(command) for command in base.commands) <= ROBOT.base.max_wheel_speed_mps
    assert base.speeds[-1] == pytest.approx((0.0, 0.0), abs=lead)


@given(x=st.floats(-3, 3), y=st.floats(-3, 3))
def test_what_is_left_is_what_turning_and_driving_straight_would_do(x: float, y: float) -> None:
    if hypot(x, y) < abs(AIM_M[1]) + 0.01:
        return
    offset = offset_to((x, y), AIM_M)
    gone = Pose2(0.0, 0.0, offset.heading_rad).compose(Pose2(offset.ahead_m, 0.0, 0.0))
    assert gone.inverse().apply((x, y, 0.0))[:2] == pytest.approx(AIM_M, abs=1e-9)


def test_a_target_under_the_robot_gives_no_error() -> None:
    offset = offset_to((0.0, 0.0), AIM_M)
    assert offset.ahead_m < 0


def test_a_target_that_is_too_near_is_backed_away_from() -> None:
    speed, _ = Driver(CONFIG, ROBOT.base).law(offset_to((0.4, -0.10), AIM_M))
    assert speed < 0


def test_what_lies_behind_is_turned_to_first() -> None:
    driver = Driver(CONFIG, ROBOT.base)
    speed, turn = driver.law(offset_to((-1.0, 0.5), AIM_M))
    assert speed == 0.0
    assert turn > 0


@given(speed=st.floats(-2, 2), turn=st.floats(-5, 5), seconds=st.floats(0.0, 3.0))
def test_a_wheel_that_cannot_go_faster_slows_the_other_and_the_arc_is_kept(
    speed: float, turn: float, seconds: float
) -> None:
    driver = Driver(CONFIG, ROBOT.base)
    command = driver.command(0.0, 0.0, TICK_S)
    for _ in range(round(seconds / TICK_S)):
        command = driver.command(speed, turn, TICK_S)
    fastest = ROBOT.drive.fastest_mps(command)
    assert fastest <= ROBOT.base.max_wheel_speed_mps + 1e-9
    asked_speed, asked_turn = driver._speed_mps, driver._turn_radps
    is_speed, is_turn = command.ahead_mps, command.turn_radps
    assert is_speed * asked_turn == pytest.approx(is_turn * asked_speed, abs=1e-9)


def test_speeds_change_no_faster_than_they_may() -> None:
    driver, before = Driver(CONFIG, ROBOT.base), (0.0, 0.0)
    for goal in [(0.35, 0.9)] * 60 + [(-0.3, -0.9)] * 90 + [(0.0, 0.0)] * 60:
        command = driver.command(*goal, TICK_S)
        now = (command.ahead_mps, command.turn_radps)
        assert abs(now[0] - before[0]) <= CONFIG.acceleration_mps2 * TICK_S + 1e-9
        assert abs(now[1] - before[1]) <= CONFIG.turn_acceleration_radps2 * TICK_S + 1e-9
        before = now
    assert before == pytest.approx((0.0, 0.0), abs=1e-9)


def test_a_halt_is_zero_at_once_and_nothing_is_left_of_the_motion() -> None:
    driver = Driver(CONFIG, ROBOT.base)
    for _ in range(50):
        driver.command(0.35, 0.5, TICK_S)
    assert driver.halt() == BaseCommand(ahead_mps=0.0, turn_radps=0.0)
    assert not driver.moving
    assert driver.brake(TICK_S) == BaseCommand(ahead_mps=0.0, turn_radps=0.0)


def test_the_preview_is_the_way_that_is_driven() -> None:
    target = (1.2, 0.8)
    preview = Driver(CONFIG, ROBOT.base).preview(target, AIM_M)
    base, arrived = driven(hypot(*target), atan2(target[1], target[0]))
    assert arrived
    end = preview[-1]
    assert (end.x_m, end.y_m, end.yaw_rad) == pytest.approx((base.pose.x_m, base.pose.y_m, base.pose.yaw_rad), abs=0.06)


def test_before_an_aim_near_an_obstacle_the_robot_goes_so_slowly_that_it_can_stop_at_the_aim() -> None:
    around, config = Surroundings("hand_marker"), PlanningConfig()
    around.floor.bump([(ROBOT.base.chassis_diameter_m / 2 + 0.09, y) for y in (-0.05, 0.0, 0.05)])
    fields, driver = around.fields("", (), 0), Driver(CONFIG, ROBOT.base)
    course = Course(ROBOT, config, AIM_M, arm="folded")

    def speed_mps(left_m: float, direct: bool) -> float:
        return course.careful(Move(0.20, 0.1, left_m, "", direct), Pose2(), fields, driver).speed_mps

    assert course.guarded(Move(0.20, 0.1, 0.04, "", True), Pose2(), fields, driver)
    assert 0.05 < speed_mps(0.04, direct=True) < 0.15
    assert speed_mps(0.30, direct=True) == 0.0
    assert speed_mps(0.04, direct=False) == 0.0


@pytest.mark.parametrize("way_m", [0.02, 0.05, 0.12, 0.4])
def test_at_the_stopping_speed_of_a_way_the_stopping_poses_end_with_it(way_m: float) -> None:
    driver = Driver(CONFIG, ROBOT.base)
    assert driver.stopping_poses(driver.stopping_mps(way_m), 0.0)[-1].x_m == pytest.approx(way_m)


def test_a_gentle_way_speeds_up_and_turns_by_half_of_the_limits_and_brakes_by_all_of_them() -> None:
    driver = Driver(CONFIG, ROBOT.base)
    seconds = 0.0
    while driver._speed_mps < 0.2:
        driver.command(0.3, 9.0, TICK_S, pace=GENTLE)
        seconds += TICK_S
    assert seconds == pytest.approx(0.2 / (GENTLE * CONFIG.acceleration_mps2), abs=2 * TICK_S)
    for _ in range(200):
        driver.command(0.3, 9.0, TICK_S, pace=GENTLE)
    assert driver._turn_radps == pytest.approx(GENTLE * CONFIG.max_turn_radps)
    before_mps = driver._speed_mps
    driver.command(0.0, 0.0, TICK_S, pace=GENTLE)
    assert before_mps - driver._speed_mps == pytest.approx(CONFIG.acceleration_mps2 * TICK_S)
