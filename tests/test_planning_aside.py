"""Driving an omni base aside by hand: as carefully as in every other direction."""

from __future__ import annotations

from collections.abc import Callable
from math import hypot

import pytest
from omni_robot import omni_robot
from planner_rig import ROBOT, TICK_S, Planner, standing

from cocoro.messages import Motion
from services.planning.config import PlanningConfig

CONFIG = PlanningConfig()
OMNI = omni_robot()
CRAWL_MPS = CONFIG.by_hand.crawl_mps
LEFT = Motion(aside_mps=9.0)
BODY_M = ROBOT.base.chassis_diameter_m / 2


def driven(prepare: Callable[[Planner], None] = lambda _: None) -> Planner:
    """A planner of an omni base that is driven by hand, at rest so far, over floor that was seen."""
    planner = Planner(robot=OMNI)
    planner.sees = None
    prepare(planner)
    planner.run(0.4)
    planner.want("drive")
    planner.run(0.1)
    return planner


def give(planner: Planner, motion: Motion, seconds: float) -> str:
    planner.motion = motion
    return planner.run(seconds).why


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_aside_it_crawls_over_seen_floor(sign: float) -> None:
    planner = driven()
    why = give(planner, Motion(aside_mps=sign * 9.0), 1.0)
    wheels = planner.wheels
    assert (wheels.ahead_mps, wheels.aside_mps) == pytest.approx((0.0, sign * CRAWL_MPS), abs=1e-9)
    assert why == "slowly, where the camera does not look"
    why = give(planner, Motion(aside_mps=sign * 0.05), 1.0)
    assert planner.wheels.aside_mps == pytest.approx(sign * 0.05)
    assert why == f"driving by hand, +0.00 m/s ahead, {sign * 0.05:+.2f} m/s to the left"
    give(planner, Motion(), 0.1)
    assert standing(planner)


def test_aside_it_stands_before_floor_that_was_never_seen() -> None:
    def ahead_alone(planner: Planner) -> None:
        planner.free = tuple((bearing, 0.2, 3.0) for bearing, _, _ in planner.free if abs(bearing) < 0.8)

    why = give(planner := driven(ahead_alone), LEFT, 1.0)
    assert standing(planner)
    assert why.startswith("the floor on that side was never seen")


def test_obliquely_ahead_it_goes_in_that_direction_within_the_limits_of_its_wheels() -> None:
    planner = driven()
    planner.motion = Motion(speed_mps=9.0, aside_mps=4.5)
    for _ in range(60):
        planner.tick()
        wheels = planner.wheels
        assert OMNI.drive.fastest_mps(wheels) <= OMNI.base.max_wheel_speed_mps + 1e-9
    assert wheels.aside_mps == pytest.approx(0.5 * wheels.ahead_mps)
    assert hypot(wheels.ahead_mps, wheels.aside_mps) > 0.25


def test_it_stops_before_an_obstacle_at_its_side() -> None:
    wall = tuple((x * 0.04, 0.45, z) for x in range(-10, 11) for z in (0.1, 0.3))

    def beside(planner: Planner) -> None:
        planner.points = wall

    planner = driven(beside)
    way_m, why = 0.0, ""
    planner.motion = LEFT
    for _ in range(round(6.0 / TICK_S)):
        planner.points = tuple((x, y - way_m, z) for x, y, z in wall)
        planner.base = {"odometry_m": (0.0, way_m), "aside_mps": planner.wheels.aside_mps}
        why = planner.tick().why
        way_m += planner.wheels.aside_mps * TICK_S
    assert standing(planner)
    assert why == "something is in the way"
    assert 0.0 < 0.45 - way_m - BODY_M < 0.15
    give(planner, Motion(aside_mps=-1.0), 0.5)
    assert planner.wheels.aside_mps < -0.05


def test_with_the_bumper_pressed_it_does_not_move_aside() -> None:
    planner = driven()
    planner.base = {"bump_left": True}
    assert "bumper" in give(planner, LEFT, 0.5)
    assert standing(planner)


def test_a_base_of_two_wheels_says_that_it_cannot_and_does_the_rest() -> None:
    planner = Planner()
    planner.sees = None
    planner.run(0.4)
    planner.want("drive")
    why = give(planner, Motion(speed_mps=0.2, aside_mps=0.2), 1.0)
    assert why == "this base cannot move aside"
    assert planner.wheels.ahead_mps == pytest.approx(0.2)
    assert planner.wheels.aside_mps == 0.0


def test_driving_to_a_place_works_on_an_omni_base_without_going_aside() -> None:
    planner = Planner(robot=OMNI)
    planner.sees = None
    planner.run(0.4)
    planner.want("go-there", place_m=(1.0, 0.0))
    planner.run(1.5)
    assert planner.wheels.ahead_mps > 0.2
    assert planner.wheels.aside_mps == pytest.approx(0.0, abs=1e-9)
    assert OMNI.drive.fastest_mps(planner.wheels) <= OMNI.base.max_wheel_speed_mps + 1e-9


def test_a_distance_of_two_wheels_is_not_learned_where_there_are_three() -> None:
    planner = Planner(robot=OMNI)
    planner.run(0.4)
    planner.want("babble-wheels", "red_can", first=0, count=2)
    status = planner.run(0.1)
    assert (status.state, status.reason) == ("failed", "unreachable")
    assert "no two wheels" in status.why
    assert standing(planner)
