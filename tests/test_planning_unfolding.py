"""A robot whose folded arm has no room to unfold where it stands: it goes to where there is room, or says why not."""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, hypot, pi, sin

import numpy as np
from planner_rig import ROBOT, TICK_S, Planner

from cocoro import topics
from cocoro.frames import Pose2
from cocoro.messages import PlannerStatus
from services.planning.behaviours.base import Actuators
from services.planning.behaviours.driving import grasp_aim
from services.planning.clearance import Clearance
from services.planning.config import PlanningConfig
from services.planning.surroundings import placed

TALL_M = 0.4
HULL = Clearance(ROBOT)


class Mover(Planner):
    """A robot that follows all commands, also those to the wheels, near a can and tall things of 5 cm."""

    def __init__(self, can_m: tuple[float, float], things_m: Sequence[tuple[float, float]]) -> None:
        super().__init__()
        self.pose = Pose2()
        self.can_m, self.things_m = can_m, things_m
        self.hit = ""
        """What the arm or the body touched."""
        self.farthest_m = 0.0
        for _ in range(20):
            self.tick()

    def tick(self) -> PlannerStatus:
        away = self.pose.inverse()
        self.sees = away.apply((*self.can_m, 0.06))
        self.points = tuple(away.apply((x, y, TALL_M)) for x, y in self.things_m)
        self.base = {"odometry_m": (self.pose.x_m, self.pose.y_m), "odometry_yaw_rad": self.pose.yaw_rad}
        status = super().tick()
        if topics.BASE_COMMAND.name in self.commanded:
            way, turn = self.wheels.ahead_mps * TICK_S, self.wheels.turn_radps * TICK_S
            self.pose = self.pose.compose(Pose2(way * cos(turn / 2), way * sin(turn / 2), turn))
        self.farthest_m = max(self.farthest_m, hypot(self.pose.x_m, self.pose.y_m))
        self._touch()
        return status

    def _touch(self) -> None:
        centres, radii = HULL.hull(self.angles)
        low = centres[:, 2] - radii < TALL_M
        radii = np.append(radii[low], ROBOT.base.chassis_diameter_m / 2)
        places = placed(np.vstack([centres[low][:, :2], np.zeros(2)]), self.pose)
        gaps = np.hypot(*np.moveaxis(places[:, None] - np.array(self.things_m)[None], 2, 0)) - radii[:, None]
        if gaps.min() < 0.0:
            self.hit = f"at {self.pose}"

    def approach(self, most_s: float = 60.0) -> PlannerStatus:
        self.want("approach", "red_can")
        status = self.tick()
        for _ in range(round(most_s / TICK_S)):
            if status.state != "running":
                break
            status = self.tick()
        return status


def here() -> tuple[float, float]:
    """Where a target stands that the robot need not drive to."""
    return grasp_aim(Actuators(ROBOT, PlanningConfig()))


def test_a_robot_that_has_no_room_to_unfold_goes_to_where_it_has() -> None:
    robot = Mover(here(), [(0.30, 0.30)])
    status = robot.approach()
    assert (status.state, robot.hit) == ("done", "")
    x, y, _ = robot.pose.inverse().apply((*robot.can_m, 0.0))
    assert hypot(x - here()[0], y - here()[1]) < 0.05
    assert robot.farthest_m < 1.5


def test_with_a_wall_behind_it_the_robot_comes_to_the_target_from_another_side() -> None:
    robot = Mover(here(), [(0.30, 0.30), *((-0.32, 0.05 * number) for number in range(-30, 31))])
    status = robot.approach()
    assert (status.state, robot.hit) == ("done", "")


def test_a_robot_beside_a_wall_turns_to_where_the_arm_has_room() -> None:
    robot = Mover(here(), [(0.05 * number, 0.30) for number in range(-16, 36)])
    status = robot.approach()
    assert (status.state, robot.hit) == ("done", "")


def test_an_enclosed_robot_looks_at_what_is_in_the_way_and_says_why_it_gives_up() -> None:
    ring = [(0.42 * cos(pi * k / 24), 0.42 * sin(pi * k / 24)) for k in range(48) if abs(k - 45.5) > 3]
    robot = Mover(here(), ring)
    status = robot.approach()
    assert (status.state, status.reason, robot.hit) == ("failed", "blocked", "")
    assert status.why.startswith("no room to unfold the arm: something stands 0."), status.why
    assert status.why.endswith("nor a way to where there is")
    assert robot.farthest_m < 0.1


def test_what_is_near_is_no_obstacle_while_it_is_not_known_where_the_arm_was() -> None:
    """It may be the robot's own hand, which would then stand in its own way."""
    robot = Planner()
    robot.sees, robot.free = None, ()
    robot.run(0.2)
    places = np.array([[0.40, 0.30, 0.1], [1.50, 0.30, 0.1]])
    floor = robot.under_test.core._estimator.around.floor  # type: ignore[attr-defined]
    robot.silent = {topics.ARM_STATE.name}
    robot.run(0.06)
    robot.points = ((0.40, 0.30, 0.25), (1.50, 0.30, 0.25))
    robot.run(0.08)
    assert floor.taller(places).tolist() == [False, True]
    robot.silent = set()
    robot.run(0.2)
    assert floor.taller(places).tolist() == [True, True]
