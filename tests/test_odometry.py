"""Odometry from the commands to a Create and its coarse reports."""

from __future__ import annotations

from math import degrees, hypot, pi

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cocoro.odometry import Odometry, WheelRamp
from cocoro.robot import Robot
from sim.base import CreateCounters

ROBOT = Robot.load()
HZ = 240


def drive_by_reports(
    left_mps: float, right_mps: float, seconds: float, *, share: float = 1.0, report_hz: int = 5
) -> tuple[Odometry, Odometry]:
    """Fused and exact odometry of wheels that turn at `share` of the commanded speed."""
    fused, exact = Odometry(ROBOT.drive), Odometry(ROBOT.drive)
    counters = CreateCounters(ROBOT.drive)
    ramp = WheelRamp(ROBOT.base)
    for step in range(1, round(seconds * HZ) + 1):
        ramp.advance((left_mps, right_mps), 1 / HZ)
        fused.advance([speed_mps / HZ for speed_mps in ramp.wheels_mps], 1 / HZ)
        rolled_m = [share * speed_mps / HZ for speed_mps in ramp.wheels_mps]
        exact.advance(rolled_m, 1 / HZ)
        counters.roll(rolled_m)
        if step % (HZ // report_hz) == 0:
            fused.report(*counters.take())
    return fused, exact


def apart_m(one: Odometry, other: Odometry) -> float:
    return hypot(one.x_m - other.x_m, one.y_m - other.y_m)


def test_the_counters_forget_what_is_less_than_a_unit() -> None:
    counters = CreateCounters(ROBOT.drive)
    counters.roll((0.0109, 0.0109))
    assert counters.take() == (10, 0)
    counters.roll((0.0109, 0.0109))
    assert counters.take() == (10, 0)
    counters.roll((-0.0015, 0.0035))
    assert counters.take() == (1, 1)


def test_a_slow_arc_that_the_reports_alone_call_straight_is_followed() -> None:
    # 4.4 degrees a second: less than one degree in each of the 0.2 s between reports.
    fused, exact = drive_by_reports(0.10, 0.12, 20.0)
    assert degrees(exact.yaw_rad) == pytest.approx(87.6, abs=0.5)
    assert apart_m(fused, exact) < 0.001
    assert degrees(abs(fused.yaw_rad - exact.yaw_rad)) < 0.1


@pytest.mark.parametrize("share", [0.8, 0.95, 1.05])
def test_wheels_that_do_not_what_they_are_told_are_corrected_to_within_the_reports_units(share: float) -> None:
    fused, exact = drive_by_reports(0.2, 0.2, 10.0, share=share)
    assert apart_m(fused, exact) <= 0.001 * 50 + 1e-9  # a millimetre a report at worst
    assert apart_m(fused, exact) < 0.5 * abs(1.0 - share) * 2.0


def test_blocked_wheels_are_not_believed_to_turn() -> None:
    fused, _ = drive_by_reports(0.2, 0.2, 5.0, share=0.0)
    assert hypot(fused.x_m, fused.y_m) < 0.002
    fused, _ = drive_by_reports(-0.2, 0.2, 5.0, share=0.0)
    assert abs(degrees(fused.yaw_rad)) < 0.5


@given(st.floats(-0.5, 0.5), st.floats(-0.5, 0.5))
def test_arcs_are_integrated_exactly(left_m: float, right_m: float) -> None:
    whole, pieces = Odometry(ROBOT.drive), Odometry(ROBOT.drive)
    whole.advance((left_m, right_m), 1.0)
    for _ in range(100):
        pieces.advance((left_m / 100, right_m / 100), 0.01)
    assert apart_m(whole, pieces) < 1e-9
    assert whole.yaw_rad == pytest.approx(pieces.yaw_rad, abs=1e-12)


def test_turning_on_the_spot_is_measured_at_the_wheels_distance() -> None:
    odometry = Odometry(ROBOT.drive)
    around_m = pi * ROBOT.base.axle_m / 2
    odometry.advance((-around_m, around_m), 1.0)
    assert odometry.yaw_rad == pytest.approx(pi)
    assert hypot(odometry.x_m, odometry.y_m) < 1e-12
