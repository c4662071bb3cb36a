"""The floor and the planned way as the planner publishes them, for who looks on."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from planner_rig import Planner, started

from cocoro import topics
from cocoro.frames import Pose2
from cocoro.messages import FloorPlan, Obstacles
from services.planning.floor_map import CELL_M, SIZE, FloorMap
from services.planning.floor_plan import FloorPlanner, Way

HERE = Pose2()


def plans(planner: Planner) -> list[FloorPlan]:
    outputs = [output.message for step in planner.under_test.steps for output in step]
    return [message for message in outputs if isinstance(message, FloorPlan)]


def at(plan: FloorPlan, x_m: float, y_m: float) -> int:
    """What a message says of a place, as a reader finds it."""
    column = int((x_m - plan.origin_m[0]) // plan.cell_m)
    row = int((y_m - plan.origin_m[1]) // plan.cell_m)
    return plan.cells[row * plan.width + column]


def test_it_comes_twice_a_second_whatever_the_planner_does() -> None:
    planner = Planner()
    planner.silent = {"arm/state"}  # so that it stands still for want of it
    planner.run(1.0)
    planner.silent = set()
    planner.run(1.0)
    assert len(plans(planner)) in (4, 5)


def test_a_robot_that_stands_says_what_it_saw_and_no_way() -> None:
    plan = plans(started())[-1]
    assert plan.way_m == ()
    assert plan.goal_m is None
    planner = started()
    planner.run(1.0)
    plan = plans(planner)[-1]
    assert at(plan, 1.0, 0.0) == 1
    assert (plan.width, plan.height) == (plan.width, len(plan.cells) // plan.width)


def test_a_drive_shows_its_goal_and_its_way_there() -> None:
    planner = started()
    planner.want("approach", "red_can")
    planner.run(1.0)
    plan = plans(planner)[-1]
    assert plan.goal_m == pytest.approx((1.5, 0.0), abs=0.01)
    assert len(plan.way_m) > 2
    assert plan.way_m[0] == pytest.approx((0.0, 0.0), abs=0.1)
    assert 0.7 < plan.way_m[-1][0] < 1.2, "the robot stops where its arm reaches the can"
    planner.want("idle")
    planner.run(1.0)
    assert plans(planner)[-1].goal_m is None


def test_what_stands_is_occupied_and_the_rest_of_the_rectangle_not_seen() -> None:
    floor = FloorMap()
    for _ in range(3):
        floor.enter(Obstacles(points_m=((1.02, -0.52, 0.2),), free=((0.0, 0.2, 0.8),)), HERE, None)
    plan = FloorPlanner.made(floor, None)
    assert at(plan, 1.02, -0.52) == 2
    assert at(plan, 0.5, 0.0) == 1
    assert at(plan, 0.22, -0.52) == 0
    assert plan.width < SIZE / 4
    assert plan.cell_m == CELL_M
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(plan), type=FloorPlan) == plan


def test_where_nothing_was_seen_it_has_no_cells() -> None:
    plan = FloorPlanner.made(FloorMap(), None)
    assert (plan.width, plan.height, plan.cells) == (0, 0, b"")


def test_a_long_way_is_thinned_but_keeps_its_end() -> None:
    places = np.stack([np.arange(0.0, 50.0, 0.05), np.zeros(1000)], axis=1)
    plan = FloorPlanner.made(FloorMap(), Way((50.0, 0.0), places))
    assert 200 < len(plan.way_m) <= 256
    assert plan.way_m[-1] == (49.95, 0.0)


def test_cells_that_do_not_fill_the_rectangle_are_refused() -> None:
    with pytest.raises(ValueError, match="3 x 2"):
        FloorPlan(cell_m=0.05, width=3, height=2, cells=bytes(5))


def test_a_whole_map_fits_its_topic() -> None:
    plan = FloorPlan(
        cell_m=0.05, width=SIZE, height=SIZE, cells=bytes(SIZE * SIZE), way_m=((1.234, 5.678),) * 256, goal_m=(1.0, 2.0)
    )  # fmt: skip
    assert len(msgspec.msgpack.encode(plan)) < topics.FLOOR_PLAN.max_bytes
