"""Omni wheels: the body's motion and that of its wheels, their ramp, and the base that drives them."""

from __future__ import annotations

from math import cos, hypot, pi, radians, sin, sqrt

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from omni_robot import omni_robot

from cocoro.clock import NS
from cocoro.drive import Twist
from cocoro.messages import BaseCommand
from cocoro.odometry import Odometry, WheelRamp
from cocoro.omni import Omni, OmniWheel
from sim.base import Bumper, MobileBase

ROBOT = omni_robot()
BASE, DRIVE = ROBOT.base, ROBOT.drive
SQUARE = Omni(
    [OmniWheel(name=f"at {angle}", distance_m=0.2, angle_deg=angle, radius_m=0.04) for angle in (45, 135, 225, 315)]
)
SPEEDS = st.floats(-0.5, 0.5)
TWISTS = st.builds(Twist, SPEEDS, st.floats(-3.0, 3.0), SPEEDS)
STEP_S = 1 / 240


# --- kinematics -----------------------------------------------------------------------------------


def test_the_wheels_turn_as_lekiwis_do() -> None:
    # Its program has a row (cos a, sin a, 0.125 m) for a = 150, -90 and 30 degrees, left, back and right.
    assert DRIVE.names == ("left", "back", "right")
    half = sqrt(3) / 2
    assert DRIVE.wheels(Twist(ahead=1.0)) == pytest.approx((-half, 0.0, half))
    assert DRIVE.wheels(Twist(aside=1.0)) == pytest.approx((0.5, -1.0, 0.5))
    assert DRIVE.wheels(Twist(turn=1.0)) == pytest.approx((0.125, 0.125, 0.125))
    assert DRIVE.lever_m == pytest.approx(0.125)
    assert DRIVE.goes_aside


@given(twist=TWISTS, drive=st.sampled_from([DRIVE, SQUARE]))
def test_the_wheels_of_a_twist_are_those_of_that_twist(twist: Twist, drive: Omni) -> None:
    wheels = drive.wheels(twist)
    assert drive.twist(wheels) == pytest.approx(twist, abs=1e-12)
    assert drive.slips(wheels) == pytest.approx([0.0] * len(wheels), abs=1e-12)


@given(
    places=st.lists(
        st.tuples(st.floats(0.05, 1.0), st.floats(-180.0, 180.0), st.floats(-180.0, 180.0)), min_size=3, max_size=6
    ),
    twist=TWISTS,
)
def test_a_rim_moves_as_its_place_on_the_body_does(places: list[tuple[float, float, float]], twist: Twist) -> None:
    wheels = [
        OmniWheel(name=str(number), distance_m=away_m, angle_deg=angle, radius_m=0.05, drive_deg=drive)
        for number, (away_m, angle, drive) in enumerate(places)
    ]
    try:
        drive = Omni(wheels)
    except ValueError:
        assume(False)
    dt_s = 1e-6  # move the body a little, and look where each place has gone
    for wheel, speed in zip(wheels, drive.wheels(twist), strict=True):
        x, y = wheel.place_m
        turned = twist.turn * dt_s
        moved_x = twist.ahead * dt_s + cos(turned) * x - sin(turned) * y - x
        moved_y = twist.aside * dt_s + sin(turned) * x + cos(turned) * y - y
        along = moved_x * cos(wheel.drive_rad) + moved_y * sin(wheel.drive_rad)
        assert speed == pytest.approx(along / dt_s, abs=1e-4)


def test_what_four_wheels_do_against_each_other_is_slip() -> None:
    wheels = SQUARE.wheels(Twist(0.2, 0.5, -0.1))
    against = (0.01, -0.01, 0.01, -0.01)
    told = tuple(one + other for one, other in zip(wheels, against, strict=True))
    assert SQUARE.twist(told) == pytest.approx((0.2, 0.5, -0.1))
    assert SQUARE.slips(told) == pytest.approx(against)


@given(twist=TWISTS, limit=st.floats(0.01, 0.5))
def test_a_twist_within_the_wheels_limit_keeps_its_direction(twist: Twist, limit: float) -> None:
    within = DRIVE.within(twist, limit)
    assert DRIVE.fastest(within) <= limit * (1 + 1e-12)
    share = limit / max(DRIVE.fastest(twist), limit)
    assert within == pytest.approx([share * value for value in twist], abs=1e-12)


@pytest.mark.parametrize(
    "angles", [[(0.0, 90.0), (90.0, 90.0), (180.0, 90.0)], [(0.0, 0.0), (120.0, 120.0), (240.0, 240.0)]]
)
def test_wheels_that_cannot_move_the_body_everywhere_are_refused(angles: list[tuple[float, float]]) -> None:
    wheels = [
        OmniWheel(name=str(angle), distance_m=0.1, angle_deg=angle, radius_m=0.05, drive_deg=drive)
        for angle, drive in angles
    ]
    with pytest.raises(ValueError, match="do not move the body ahead, aside and round"):
        Omni(wheels)


# --- odometry and ramp ----------------------------------------------------------------------------


@given(twist=TWISTS)
def test_odometry_integrates_arcs_exactly(twist: Twist) -> None:
    whole, pieces = Odometry(DRIVE), Odometry(DRIVE)
    wheels = DRIVE.wheels(twist)
    whole.advance(wheels, 1.0)
    for _ in range(100):
        pieces.advance([way_m / 100 for way_m in wheels], 0.01)
    assert hypot(whole.x_m - pieces.x_m, whole.y_m - pieces.y_m) < 1e-9
    assert whole.yaw_rad == pytest.approx(pieces.yaw_rad, abs=1e-12)
    assert (whole.speed_mps, whole.turn_rate_radps, whole.aside_mps) == pytest.approx(twist, abs=1e-12)


def test_aside_of_a_turned_body_is_where_its_left_is() -> None:
    odometry = Odometry(DRIVE)
    odometry.advance(DRIVE.wheels(Twist(turn=pi / 2)), 1.0)
    odometry.advance(DRIVE.wheels(Twist(aside=0.3)), 1.0)
    assert (odometry.x_m, odometry.y_m) == pytest.approx((-0.3, 0.0), abs=1e-12)


@given(first=TWISTS, then=TWISTS)
def test_the_ramp_takes_the_body_straight_from_one_motion_to_the_next(first: Twist, then: Twist) -> None:
    limit = BASE.max_wheel_speed_mps
    ramp = WheelRamp(BASE)
    ramp.advance(DRIVE.wheels(first), 10.0)
    assert DRIVE.twist(ramp.wheels_mps) == pytest.approx(DRIVE.within(first, limit), abs=1e-9)
    start, goal = DRIVE.within(first, limit), DRIVE.within(then, limit)
    for _ in range(400):
        before = ramp.wheels_mps
        ramp.advance(DRIVE.wheels(then), STEP_S)
        steps = [now - was for now, was in zip(ramp.wheels_mps, before, strict=True)]
        assert max(map(abs, steps)) <= BASE.wheel_acceleration_mps2 * STEP_S + 1e-12
        now = DRIVE.twist(ramp.wheels_mps)
        gone = [part - was for part, was in zip(now, start, strict=True)]
        way = [to - was for to, was in zip(goal, start, strict=True)]
        shares = [part / whole for part, whole in zip(gone, way, strict=True) if abs(whole) > 0.05]
        assert max(shares, default=0.0) - min(shares, default=0.0) < 1e-6
    assert now == pytest.approx(goal, abs=1e-9)


# --- the base that drives them --------------------------------------------------------------------


def drive(base: MobileBase, seconds: float, command: BaseCommand | None, start_ns: int = 0) -> int:
    """Wheels with perfect encoders, and commands at 48 Hz. Returns the time."""
    for step in range(round(seconds / STEP_S)):
        now_ns = start_ns + round(step * STEP_S * NS)
        if command is not None and step % 5 == 0:
            assert base.command(command, now_ns) == ""
        rolled_m = [speed_mps * STEP_S for speed_mps in base.wheels(now_ns, STEP_S)]
        base.rolled(rolled_m, now_ns, STEP_S)
    return start_ns + round(seconds * NS)


def test_a_command_aside_is_obeyed_and_told_by_the_state() -> None:
    base = MobileBase(BASE, exact=False)
    now_ns = drive(base, 1.0, BaseCommand(ahead_mps=0.1, turn_radps=0.0, aside_mps=-0.15))
    state = base.state(now_ns)
    assert (state.speed_mps, state.aside_mps, state.turn_rate_radps) == pytest.approx((0.1, -0.15, 0.0), abs=1e-9)
    assert state.odometry_m[1] == pytest.approx(-1.5 * state.odometry_m[0])
    assert not state.standing


@pytest.mark.parametrize(
    "twist", [Twist(0.3), Twist(aside=0.25), Twist(turn=-2.0), Twist(0.1, 0.5, -0.1), Twist(0.02), Twist(2.0, 1.0, 1.0)]
)
@pytest.mark.parametrize("late_s", [0.0, 0.02])
def test_three_wheels_stand_in_time_after_the_last_word(twist: Twist, late_s: float) -> None:
    base = MobileBase(BASE, exact=True)
    base.ramp.advance(DRIVE.wheels(twist), 10.0)
    said_ns = 7 * NS
    command = BaseCommand(ahead_mps=twist.ahead, turn_radps=twist.turn, aside_mps=twist.aside, stamp_ns=said_ns)
    assert base.command(command, said_ns + round(late_s * NS)) == ""
    fastest_mps = base.ramp.fastest_mps
    steps = 0
    while steps == 0 or any(base.ramp.wheels_mps):
        steps += 1
        base.wheels(said_ns + round(steps * STEP_S * NS), STEP_S)
        if steps * STEP_S <= BASE.patience_s(fastest_mps) - STEP_S:
            assert base.ramp.fastest_mps == pytest.approx(fastest_mps)
    assert base.stopped_by == "no command"
    assert steps * STEP_S <= BASE.stand_within_s - BASE.stand_reserve_s + 2 * STEP_S


@pytest.mark.parametrize(
    ("pressed", "wanted", "allowed"),
    [
        (Bumper(left=True), Twist(0.2, 0.3, 0.1), Twist(turn=0.3)),
        (Bumper(left=True), Twist(0.2, 0.0, -0.1), Twist(aside=-0.1)),
        (Bumper(right=True), Twist(-0.1, 0.0, -0.1), Twist(ahead=-0.1)),
        (Bumper(right=True), Twist(aside=0.13), Twist(aside=0.13)),
        (Bumper(left=True), Twist(aside=-0.07), Twist(aside=-0.07)),
        (Bumper(left=True, right=True), Twist(turn=0.7), Twist(turn=0.7)),
        (Bumper(right=True), Twist(-0.1, 0.2, 0.1), Twist(-0.1, 0.2, 0.1)),
    ],
)
def test_a_pressed_bumper_lets_it_turn_and_leave(pressed: Bumper, wanted: Twist, allowed: Twist) -> None:
    base = MobileBase(BASE, exact=True)
    base.bumper = pressed
    drive(base, 1.0, BaseCommand(ahead_mps=wanted.ahead, turn_radps=wanted.turn, aside_mps=wanted.aside))
    assert DRIVE.twist(base.ramp.wheels_mps) == pytest.approx(allowed, abs=1e-9)
    assert base.stopped_by == ("" if wanted == allowed else "bump")


def test_angles_are_counter_clockwise_from_ahead() -> None:
    wheel = OmniWheel(name="left", distance_m=0.1, angle_deg=90.0, radius_m=0.05)
    assert wheel.place_m == pytest.approx((0.0, 0.1), abs=1e-12)
    assert wheel.drive_rad == pytest.approx(radians(180.0))
