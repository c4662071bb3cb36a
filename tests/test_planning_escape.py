"""The way out of an obstacle's margin, and the course that takes it."""

from __future__ import annotations

from math import cos, hypot, pi, sin

import numpy as np
import pytest

from cocoro.arrays import BoolArray, FloatArray
from cocoro.frames import Pose2, wrap_rad
from cocoro.robot import Robot
from services.planning.config import PlanningConfig
from services.planning.course import Course, Move
from services.planning.escape import SPEED_MPS, WayOut, way_out
from services.planning.floor_map import CELL_M
from services.planning.navigation import Driver
from services.planning.surroundings import Surroundings

ROBOT, CONFIG = Robot.load(), PlanningConfig()
BODY_M = ROBOT.base.chassis_diameter_m / 2
MARGIN_M = CONFIG.navigation.clearance_m
TICK_S = 0.02


def room(*places_m: tuple[float, float]) -> Surroundings:
    """Floor with obstacles at places, odometry frame; all of it was seen."""
    around = Surroundings("hand_marker")
    around.floor._looked[:] = True
    if places_m:
        around.floor.bump(places_m)
    return around


def wall(x_m: float) -> list[tuple[float, float]]:
    """A wall across the whole map: there is no way round it."""
    return [(x_m, y) for y in np.arange(-4.0, 4.0, CELL_M).tolist()]


def clearance_m(around: Surroundings, body: Pose2) -> float:
    return float(around.fields("", (), 0).body.at(np.array([[body.x_m, body.y_m]]))[0]) - BODY_M


def out_of(around: Surroundings, body: Pose2, *, may_turn: bool = True, seen: bool = True) -> WayOut | None:
    def unseen(places_m: FloatArray) -> BoolArray:
        return around.unseen(places_m) if seen else np.ones(len(places_m), dtype=bool)

    field = around.fields("", (), 0).body
    return way_out(body, field, BODY_M + MARGIN_M + CELL_M, unseen, lambda turn: may_turn or turn == 0.0, BODY_M)


@pytest.mark.parametrize("yaw_rad", [0.0, 0.4, -0.4])
def test_before_a_wall_the_way_out_is_back(yaw_rad: float) -> None:
    way = out_of(room(*wall(BODY_M + 0.06)), Pose2(0.0, 0.0, yaw_rad))
    assert way is not None
    assert way.backwards
    assert abs(wrap_rad(way.bearing_rad - pi)) < 0.5
    assert 0.0 < way.length_m < 0.2


def test_with_a_wall_behind_the_way_out_is_ahead() -> None:
    way = out_of(room(*wall(-BODY_M - 0.06)), Pose2())
    assert way is not None
    assert not way.backwards
    assert abs(way.turn_rad(Pose2())) < 0.3


def test_the_robot_does_not_back_onto_floor_that_it_has_not_seen_but_turns() -> None:
    way = out_of(room(*wall(BODY_M + 0.06)), Pose2(), seen=False)
    assert way is not None
    assert not way.backwards
    speed, turn = way.drive(Pose2())
    assert speed == 0.0
    assert turn != 0.0
    speed, turn = way.drive(Pose2(0.0, 0.0, way.bearing_rad))
    assert speed == SPEED_MPS
    assert turn == pytest.approx(0.0)


def test_an_arm_that_may_not_turn_leaves_straight_back() -> None:
    way = out_of(room(*wall(BODY_M + 0.06)), Pose2(), may_turn=False)
    assert way is not None
    assert way.backwards
    assert way.turn_rad(Pose2()) == pytest.approx(0.0)
    assert way.drive(Pose2())[0] == -SPEED_MPS


def test_there_is_no_way_out_where_the_clearance_grows_nowhere() -> None:
    ring = [(0.23 * cos(at), 0.23 * sin(at)) for at in np.arange(0.0, 2 * pi, 0.1).tolist()]
    assert out_of(room(*ring), Pose2(0.01, 0.01)) is None


def test_no_way_out_leads_nearer_to_an_obstacle_on_its_way() -> None:
    # A post between the wall and the open floor: the shortest way to open floor passes it too near.
    around = room(*wall(BODY_M + 0.04), (-BODY_M - 0.10, 0.0))
    body = Pose2(0.0, 0.0, 0.0)
    way = out_of(around, body)
    if way is not None:
        along = np.arange(0.0, way.length_m, 0.01)[:, None] * [cos(way.bearing_rad), sin(way.bearing_rad)]
        clearance = around.fields("", (), 0).body.at(along)
        assert clearance.min() >= clearance[0] - 1e-9


class Drive:
    """A body that follows each move of a course exactly."""

    def __init__(self, around: Surroundings, body: Pose2) -> None:
        self.around, self.body = around, body
        self.course = Course(ROBOT, CONFIG, (0.0, 0.0), arm="folded", arrive_m=0.12)
        self.driver = Driver(CONFIG.navigation, ROBOT.base)
        self.now_ns = 0

    def step(self, target_m: tuple[float, float]) -> Move:
        self.now_ns += round(TICK_S * 1e9)
        fields = self.around.fields("", (), self.now_ns)
        move = self.course.step(target_m, self.body, self.around, fields, self.driver, self.now_ns)
        self.body = self.body.compose(Pose2(move.speed_mps * TICK_S, 0.0, move.turn_radps * TICK_S))
        return move


def test_a_robot_that_is_held_within_a_margin_leaves_it_slowly_and_never_comes_nearer() -> None:
    around = room(*wall(BODY_M + 0.06))
    drive = Drive(around, Pose2())
    nearest_m = clearance_m(around, drive.body)
    assert nearest_m < MARGIN_M
    moves = [drive.step((1.5, 0.0)) for _ in range(250)]
    leaving = [move for move in moves if "leaving its margin" in move.why]
    assert leaving
    assert max(abs(move.speed_mps) for move in leaving) <= SPEED_MPS
    assert clearance_m(around, drive.body) >= nearest_m
    assert drive.body.x_m < 0.0


def test_after_some_ways_out_that_led_nowhere_the_course_says_that_there_is_no_free_way() -> None:
    around = room(*wall(BODY_M + 0.06))
    drive = Drive(around, Pose2())
    for _ in range(3000):
        move = drive.step((1.5, 0.0))
        if move.blocked:
            break
    assert move.blocked
    assert move.why == "there is no free way"
    assert clearance_m(around, drive.body) >= 0.0


def test_where_no_motion_gains_clearance_the_robot_stands_and_says_why() -> None:
    ring = [(0.23 * cos(at), 0.23 * sin(at)) for at in np.arange(0.0, 2 * pi, 0.1).tolist()]
    drive = Drive(room(*ring), Pose2(0.01, 0.01))
    moves = [drive.step((1.5, 0.0)) for _ in range(500)]
    assert all(move.speed_mps == 0.0 for move in moves)
    assert any(move.why.startswith("something is in the way") for move in moves)
    assert moves[-1].blocked


def test_from_within_a_margin_the_path_goes_where_the_clearance_grows_and_cuts_no_corner() -> None:
    # A wall's end ahead to the left: the way to what lies behind the wall goes round that end.
    around = room(*[(x, 0.26) for x in np.arange(-1.0, 0.31, CELL_M).tolist()])
    drive = Drive(around, Pose2())
    least_m, target_m = clearance_m(around, drive.body), (-0.2, 1.0)
    for _ in range(1500):
        if drive.step(target_m).arrived:
            break
        assert clearance_m(around, drive.body) >= min(least_m, MARGIN_M / 2) - 1e-9
    assert hypot(drive.body.x_m - target_m[0], drive.body.y_m - target_m[1]) < 0.2
