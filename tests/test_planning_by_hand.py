"""Driving by hand in the planner: what base, arm, head and claws do with an operator's motion, and what they do not."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from planner_rig import ROBOT, TICK_S, Planner, standing, started

from cocoro import topics
from cocoro.messages import Motion
from services.planning.behaviours.base import Actuators
from services.planning.config import PlanningConfig
from services.planning.core import PlanningCore
from services.planning.reach import HandPose

CONFIG = PlanningConfig()
Points = tuple[tuple[float, float, float], ...]
AHEAD = Motion(speed_mps=9.0)
WALL: Points = tuple((0.75, y * 0.04, z) for y in range(-10, 11) for z in (0.1, 0.3))
RING = tuple((k * 0.1, 0.2, 3.0) for k in range(-31, 32))
BEFORE = tuple((bearing, 0.2, 3.0) for bearing, _, _ in RING if abs(bearing) < 0.8)
"""Floor that only a camera that looks ahead has shown."""


@pytest.fixture
def planner() -> Planner:
    return driven()


def driven(prepare: Callable[[Planner], None] = lambda _: None) -> Planner:
    """A planner that is driven by hand, at rest so far, over floor that was seen."""
    planner = Planner()
    planner.sees = None
    prepare(planner)
    planner.run(0.4)
    planner.want("drive")
    planner.run(0.1)
    return planner


def speed(planner: Planner) -> float:
    return planner.wheels.ahead_mps


def turn(planner: Planner) -> float:
    return planner.wheels.turn_radps


def give(planner: Planner, motion: Motion, seconds: float) -> str:
    """Hold a motion for a time; returns why the robot does what it does then."""
    planner.motion = motion
    return planner.run(seconds).why


def actuators(planner: Planner) -> Actuators:
    core = planner.under_test.core
    assert isinstance(core, PlanningCore)
    return core.actuators


def hand(planner: Planner) -> HandPose:
    """The hand's pose by the joint angles."""
    return actuators(planner).reacher.pose(planner.angles)


def hand_m(planner: Planner) -> tuple[float, float, float]:
    """Its place, body frame."""
    x, y, z = actuators(planner).reacher.position(planner.angles).tolist()
    return x, y, z


def drive_towards(planner: Planner, points: Points, motion: Motion, seconds: float) -> tuple[str, float]:
    """Hold a motion before a thing that stands, on wheels that turn; returns the reason at the end, and the way."""
    way_m, why, sees = 0.0, "", planner.sees
    planner.motion = motion
    for _ in range(round(seconds / TICK_S)):
        planner.points = tuple((x - way_m, y, z) for x, y, z in points)
        planner.sees = (sees[0] - way_m, *sees[1:]) if sees is not None else None
        planner.base = {"odometry_m": (way_m, 0.0), "speed_mps": speed(planner)}
        why = planner.tick().why
        way_m += speed(planner) * TICK_S
    return why, way_m


def unfolded(planner: Planner) -> None:
    give(planner, Motion(up_mps=1e-6), 6.0)
    give(planner, Motion(), 0.1)


# --- the base -------------------------------------------------------------------------------------


def test_without_a_motion_everything_is_at_rest(planner: Planner) -> None:
    before = dict(planner.angles)
    status = planner.run(1.0)
    assert standing(planner)
    assert planner.angles == pytest.approx(before)
    assert (status.state, status.why) == ("running", "at rest: nothing is held")


def test_the_base_comes_to_the_wanted_speed_within_the_limits_of_every_drive(planner: Planner) -> None:
    before_mps = 0.0
    planner.motion = AHEAD
    for _ in range(60):
        planner.tick()
        assert speed(planner) - before_mps <= CONFIG.navigation.acceleration_mps2 * TICK_S + 1e-9
        before_mps = speed(planner)
    assert speed(planner) == pytest.approx(CONFIG.navigation.max_speed_mps)
    give(planner, Motion(turn_radps=-9.0), 1.0)
    assert turn(planner) == pytest.approx(-CONFIG.navigation.max_turn_radps)


@pytest.mark.parametrize("end", [None, Motion()])
def test_the_end_of_a_motion_brakes_at_once(planner: Planner, end: Motion | None) -> None:
    give(planner, AHEAD, 1.0)
    assert speed(planner) > 0.4
    planner.motion = end
    planner.tick()
    assert standing(planner)


def test_a_motion_ends_at_its_time_though_the_executive_goes_on_with_it(planner: Planner) -> None:
    give(planner, AHEAD, 1.0)
    planner.silent.add(topics.INTENT.name)
    planner.run(0.1)
    assert not standing(planner)
    planner.run(0.1)
    assert standing(planner)


@pytest.mark.parametrize("ahead_mps", [0.1, 9.0])
def test_it_stops_before_an_obstacle_however_fast_it_came(ahead_mps: float) -> None:
    def wall(planner: Planner) -> None:
        planner.points = WALL

    planner = driven(wall)
    why, way_m = drive_towards(planner, WALL, Motion(speed_mps=ahead_mps), 12.0)
    assert standing(planner)
    assert why == "something is in the way"
    left_m = 0.75 - way_m - ROBOT.base.chassis_diameter_m / 2
    assert 0.0 < left_m < 0.15
    give(planner, Motion(turn_radps=1.0), 0.5)
    assert turn(planner) > 0.5  # the body is round
    give(planner, Motion(speed_mps=-1.0), 0.5)
    assert speed(planner) < 0.0


def test_a_known_object_is_in_the_way_too() -> None:
    def can(planner: Planner) -> None:
        planner.sees = (0.8, 0.0, 0.06)

    planner = driven(can)
    why, way_m = drive_towards(planner, (), AHEAD, 8.0)
    assert why == "something is in the way"
    assert standing(planner)
    assert 0.4 < way_m < 0.8 - 0.03 - ROBOT.base.chassis_diameter_m / 2


def test_over_floor_that_was_never_seen_it_goes_slowly_and_looks_there() -> None:
    def blind(planner: Planner) -> None:
        planner.free = ()

    planner = driven(blind)
    why = give(planner, AHEAD, 1.0)
    assert why == "slower, for the floor ahead was not seen yet"
    assert speed(planner) == pytest.approx(CONFIG.by_hand.unseen_mps, abs=0.01)
    assert planner.angles["neck_tilt"] < -0.5


def test_backwards_it_crawls_over_seen_floor_and_stands_before_other() -> None:
    planner = driven()
    why = give(planner, Motion(speed_mps=-1.0), 1.0)
    assert speed(planner) == pytest.approx(-CONFIG.by_hand.crawl_mps)
    assert why == "slowly backwards"

    def ahead_alone(planner: Planner) -> None:
        planner.free = BEFORE

    planner = driven(ahead_alone)
    why = give(planner, Motion(speed_mps=-1.0), 1.0)
    assert standing(planner)
    assert why.startswith("the floor behind was never seen")


def test_it_backs_over_floor_on_which_it_has_just_been() -> None:
    def ahead_alone(planner: Planner) -> None:
        planner.free = tuple((bearing, 0.2, 0.45) for bearing, _, _ in BEFORE)

    planner = driven(ahead_alone)
    planner.free = ()
    planner.motion = Motion(speed_mps=0.1)
    way_m = 0.0
    for _ in range(int(0.4 / 0.1 / TICK_S)):
        planner.tick()
        way_m += speed(planner) * TICK_S
        planner.base = {"odometry_m": (way_m, 0.0)}
    give(planner, Motion(speed_mps=-1.0), 0.5)
    assert speed(planner) == pytest.approx(-CONFIG.by_hand.crawl_mps)


def test_a_pressed_bumper_leaves_only_the_way_back(planner: Planner) -> None:
    planner.base = {"bump_left": True}
    assert "bumper" in give(planner, AHEAD, 0.5)
    assert speed(planner) == pytest.approx(0.0)
    give(planner, Motion(speed_mps=-1.0), 0.5)
    assert speed(planner) < 0.0


def test_while_perception_is_late_the_wheels_stand_and_the_head_moves_on(planner: Planner) -> None:
    give(planner, AHEAD, 1.0)
    planner.silent |= {topics.DETECTIONS.name, topics.OBSTACLES.name}
    pan_rad = planner.angles["neck_pan"]
    why = give(planner, Motion(speed_mps=9.0, pan_radps=1.0), 1.0)
    assert standing(planner)
    assert why.startswith("standing still: nothing from perception for ")
    assert planner.angles["neck_pan"] > pan_rad + 0.3
    status = planner.run(20.0)
    assert status.state == "running"
    planner.silent.clear()
    give(planner, AHEAD, 1.0)
    assert speed(planner) > 0.3


# --- arm, head and claws --------------------------------------------------------------------------


def test_the_hand_unfolds_first_while_it_is_wanted_to_move_and_the_base_waits(planner: Planner) -> None:
    folded = dict(planner.angles)
    assert give(planner, Motion(speed_mps=9.0, out_mps=0.1), 0.6) == "unfolding the arm"
    assert standing(planner)
    half = dict(planner.angles)
    assert half != pytest.approx(folded)
    give(planner, Motion(), 1.0)
    assert planner.angles == pytest.approx(half)
    give(planner, Motion(out_mps=1e-6), 6.0)
    arm = CONFIG.arm
    assert hand(planner) == pytest.approx((arm.travel_radius_m, 0.0, arm.travel_height_m, arm.pitch_rad), abs=0.06)


@pytest.mark.parametrize(
    ("motion", "axis", "least"),
    [
        (Motion(out_mps=0.1), 0, 0.05),
        (Motion(round_radps=0.3), 1, 0.2),
        (Motion(round_radps=-0.3), 1, -0.2),
        (Motion(up_mps=0.1), 2, 0.05),
        (Motion(up_mps=-0.1), 2, -0.05),
    ],
)
def test_the_hand_moves_along_one_of_its_own_coordinates_and_keeps_the_others(
    planner: Planner, motion: Motion, axis: int, least: float
) -> None:
    unfolded(planner)
    before = hand(planner)
    assert give(planner, motion, 1.0) == "moving the hand"
    moved = [now - then for now, then in zip(hand(planner), before, strict=True)]
    assert moved[axis] * (1 if least > 0 else -1) > abs(least)
    others = [value for number, value in enumerate(moved) if number != axis]
    assert others == pytest.approx([0.0, 0.0, 0.0], abs=0.02)
    still = dict(planner.angles)
    give(planner, Motion(), 0.5)
    assert planner.angles == pytest.approx(still)


def test_the_wrist_rolls_and_stays_where_it_was_turned_to(planner: Planner) -> None:
    unfolded(planner)
    roll_rad = planner.angles["wrist_roll"]
    give(planner, Motion(roll_radps=-1.0), 1.0)
    turned_rad = planner.angles["wrist_roll"]
    assert turned_rad == pytest.approx(roll_rad - 1.0, abs=0.1)
    give(planner, Motion(), 0.2)
    give(planner, Motion(up_mps=0.05), 0.5)
    assert planner.angles["wrist_roll"] == pytest.approx(turned_rad, abs=0.05)


@pytest.mark.parametrize("motion", [Motion(up_mps=-1.0), Motion(out_mps=-1.0), Motion(round_radps=1.0)])
def test_no_motion_brings_the_arm_nearer_to_robot_or_floor_than_its_clearance(planner: Planner, motion: Motion) -> None:
    unfolded(planner)
    clearance = actuators(planner).arm.clearance
    planner.motion = motion
    for _ in range(300):
        planner.tick()
        assert clearance.of(planner.angles) >= CONFIG.arm.clearance_m - 1e-6
    before = hand(planner)
    give(planner, Motion(up_mps=0.1), 1.0)  # it comes away from there at once: nothing has wound up
    assert hand(planner).height_m > before.height_m + 0.05


def test_beside_an_obstacle_the_arm_stays_folded() -> None:
    def wall(planner: Planner) -> None:
        planner.points = tuple((x / 2, y, z) for x, y, z in WALL)

    planner = driven(wall)
    folded = dict(planner.angles)
    assert give(planner, Motion(out_mps=0.1), 1.0) == "no room here to unfold the arm"
    assert planner.angles == pytest.approx(folded)


def test_with_the_arm_out_the_base_is_slower_and_keeps_the_hand_off_obstacles(planner: Planner) -> None:
    unfolded(planner)
    give(planner, AHEAD, 2.0)
    assert speed(planner) == pytest.approx(CONFIG.by_hand.arm_out_mps)
    give(planner, Motion(), 0.1)
    x, y, _ = hand_m(planner)
    shelf = tuple((x + 0.3, y + k * 0.04, z) for k in range(-4, 5) for z in (0.1, 0.3))
    planner.points = shelf
    planner.motion = None
    planner.run(0.5)
    why, way_m = drive_towards(planner, shelf, AHEAD, 8.0)
    assert why == "something is in the way"
    assert 0.05 < way_m < 0.3 - ROBOT.claw.pad_length_m / 2


def test_an_object_that_the_hand_reaches_for_is_not_in_the_way(planner: Planner) -> None:
    unfolded(planner)
    give(planner, Motion(up_mps=-0.2), 1.0)
    x, y, _ = hand_m(planner)
    planner.sees = (x + 0.12, y, 0.06)
    planner.motion = None
    planner.run(0.5)
    give(planner, Motion(speed_mps=0.05), 0.5)
    assert speed(planner) == pytest.approx(0.05, abs=0.01)


def test_the_head_turns_within_its_limits_and_stops_with_the_operator(planner: Planner) -> None:
    give(planner, Motion(pan_radps=1.0, tilt_radps=-0.5), 0.5)
    assert planner.angles["neck_pan"] == pytest.approx(0.5, abs=0.1)
    assert planner.angles["neck_tilt"] == pytest.approx(-0.25, abs=0.1)
    pan_rad = planner.angles["neck_pan"]
    give(planner, Motion(), 0.5)
    assert planner.angles["neck_pan"] == pytest.approx(pan_rad, abs=0.05)
    give(planner, Motion(pan_radps=9.0, tilt_radps=9.0), 6.0)
    assert planner.angles["neck_pan"] == pytest.approx(ROBOT.joints["neck_pan"].limits_rad[1], abs=0.01)
    assert planner.angles["neck_tilt"] == pytest.approx(CONFIG.head.tilt_range_rad[1], abs=0.01)


def test_a_tap_opens_the_claws_and_another_closes_them_until_they_hold_something(planner: Planner) -> None:
    def opening() -> float:
        return min(ROBOT.claw.open_sign[name] * planner.angles[name] for name in ROBOT.claw.open_sign)

    give(planner, Motion(grip="open"), 0.04)
    give(planner, Motion(), 1.0)
    assert opening() == pytest.approx(CONFIG.hand.open_rad)
    planner.motion = Motion(grip="close")
    for _ in range(50):
        planner.tick()
        planner.motion = None
        if opening() < 0.1:  # there is something between them
            planner.hand_load = 0.6
            planner.angles.update({name: 0.1 * sign for name, sign in ROBOT.claw.open_sign.items()})
    assert planner.status.holding
    give(planner, Motion(grip="close"), 0.1)
    assert opening() == pytest.approx(0.1 - CONFIG.hand.clamp_rad)  # what is held is not pressed harder
    planner.hand_load = 0.0
    give(planner, Motion(grip="open"), 1.0)
    assert opening() == pytest.approx(CONFIG.hand.open_rad)


def test_an_emergency_stop_leaves_no_command_whatever_is_held(planner: Planner) -> None:
    give(planner, AHEAD, 0.5)
    planner.latch = "latched"
    give(planner, Motion(speed_mps=9.0, out_mps=0.1, pan_radps=1.0, grip="close"), 0.1)
    assert planner.commanded == set()


def test_other_actions_take_no_notice_of_a_motion() -> None:
    planner = started()
    planner.motion = AHEAD
    planner.run(0.5)
    assert standing(planner)
    assert (planner.wheels.ahead_mps, planner.wheels.turn_radps) == (0.0, 0.0)
