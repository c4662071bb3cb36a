"""Odometry: the body's pose by what its wheels have rolled.

A Create reports its path in whole millimetres and its turn in whole degrees since the last request, and drops the rest
(iRobot Create Open Interface, packets 19 and 20). Requested often, a slow arc reads as straight ahead; requested
rarely, the pose lags. Between reports the commanded wheel speeds are therefore integrated, with the Create's own ramp,
and the integral since the last report is clamped into the interval that the report allows (derived; the problem is
known from other drivers of this base).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin

from cocoro.base import Base
from cocoro.drive import WheelDrive

REPORT_PERIOD_S = 0.2
"""Period of requests for path and turn: at 5 Hz the unit of a report is small against its value."""
MILLIMETRE_M = 1e-3
DEGREE_RAD = 0.017453292519943295


class WheelRamp:
    """Wheel speeds that follow the commanded ones: clipped, with limited acceleration.

    The wheels of a drive `in_step` are clipped and accelerated by a common share: the body's motion goes straight from
    what it is to what is commanded, and more than three wheels do not work against each other. Others go each by
    itself, as a Create's.
    """

    def __init__(self, base: Base) -> None:
        drive = base.drive
        self._limit_mps = base.max_wheel_speed_mps
        self._acceleration_mps2 = base.wheel_acceleration_mps2
        self._in_step = drive.in_step
        self.wheels_mps: tuple[float, ...] = (0.0,) * len(drive.names)

    @property
    def fastest_mps(self) -> float:
        """Speed of the fastest wheel, without its sign."""
        return max(abs(speed_mps) for speed_mps in self.wheels_mps)

    def advance(self, wheels_mps: Sequence[float], dt_s: float) -> None:
        """One time step towards the commanded speeds."""
        reach, limit = self._acceleration_mps2 * dt_s, self._limit_mps
        if not self._in_step:
            self.wheels_mps = tuple(
                now + _clip(_clip(wanted, limit) - now, reach)
                for now, wanted in zip(self.wheels_mps, wheels_mps, strict=True)
            )
            return
        wanted_mps = _scaled(wheels_mps, limit)
        missing = [to - now for now, to in zip(self.wheels_mps, wanted_mps, strict=True)]
        steps = _scaled(missing, reach)
        arrives = max(abs(step) for step in missing) <= reach
        self.wheels_mps = (
            wanted_mps if arrives else tuple(now + step for now, step in zip(self.wheels_mps, steps, strict=True))
        )


class Odometry:
    """The body's pose in the frame in which it started, and its speeds."""

    def __init__(self, drive: WheelDrive) -> None:
        self._drive = drive
        self.x_m = 0.0
        self.y_m = 0.0
        self.yaw_rad = 0.0
        self.speed_mps = 0.0
        self.aside_mps = 0.0
        self.turn_rate_radps = 0.0
        self._way_m = 0.0
        self._turn_rad = 0.0
        self._report_x_m = 0.0
        self._report_y_m = 0.0
        self._report_yaw_rad = 0.0

    def advance(self, rolled_m: Sequence[float], dt_s: float) -> None:
        """Advance the pose by the wheels' travel in `dt_s`, during which the body's motion is taken as constant: each
        point of it goes along an arc."""
        way_m, turn_rad, aside_m = self._drive.twist(rolled_m)
        heading = self.yaw_rad + turn_rad / 2
        per_arc = _chord_per_arc(turn_rad)
        chord_m, across_m = way_m * per_arc, aside_m * per_arc
        c, s = cos(heading), sin(heading)
        self.x_m += chord_m * c - across_m * s
        self.y_m += chord_m * s + across_m * c
        self.yaw_rad += turn_rad
        self._way_m += way_m
        self._turn_rad += turn_rad
        self.speed_mps = way_m / dt_s
        self.aside_mps = aside_m / dt_s
        self.turn_rate_radps = turn_rad / dt_s

    def measured(self, wheels_mps: Sequence[float]) -> None:
        """Take the speeds from the wheels' own measurement: those of `advance` are only as good as the times of two
        readings."""
        self.speed_mps, self.turn_rate_radps, self.aside_mps = self._drive.twist(wheels_mps)

    # --- a Create's reports -------------------------------------------------------------------------

    def unreported(self) -> None:
        """Accept the integral since the last report, because the Create's report was lost."""
        self._way_m = self._turn_rad = 0.0
        self._report_x_m, self._report_y_m, self._report_yaw_rad = self.x_m, self.y_m, self.yaw_rad

    def report(self, distance_mm: int, angle_deg: int) -> None:
        """Correct the integral since the last report by the Create's report of that time."""
        way_m = _within(self._way_m, distance_mm, MILLIMETRE_M)
        turn_rad = _within(self._turn_rad, angle_deg, DEGREE_RAD)
        extra_m, extra_rad = way_m - self._way_m, turn_rad - self._turn_rad
        if extra_m or extra_rad:
            self._correct(extra_m, extra_rad)
        self.unreported()

    def _correct(self, extra_m: float, extra_rad: float) -> None:
        """Bend and stretch the path since the last report, with the missing turn spread evenly along it."""
        dx, dy = self.x_m - self._report_x_m, self.y_m - self._report_y_m
        c, s = cos(extra_rad / 2), sin(extra_rad / 2)
        dx, dy = c * dx - s * dy, s * dx + c * dy
        self.yaw_rad += extra_rad
        middle = (self._report_yaw_rad + self.yaw_rad) / 2
        self.x_m = self._report_x_m + dx + extra_m * cos(middle)
        self.y_m = self._report_y_m + dy + extra_m * sin(middle)


def _within(value: float, count: int, unit: float) -> float:
    """`value` clamped to the interval of values that round towards zero to this count of units.

    A count of 0 where two units or more were expected means that nothing moved: then it is 0.
    """
    if count == 0 and abs(value) >= 2 * unit:
        return 0.0
    low = (count - 1 if count <= 0 else count) * unit
    high = (count + 1 if count >= 0 else count) * unit
    return min(max(value, low), high)


def _chord_per_arc(turn_rad: float) -> float:
    """Length of an arc's chord as a share of the arc."""
    half = turn_rad / 2
    return sin(half) / half if abs(half) > 1e-6 else 1.0


def _clip(value: float, limit: float) -> float:
    return min(max(value, -limit), limit)


def _scaled(values: Sequence[float], limit: float) -> tuple[float, ...]:
    """All values by one share, so that none exceeds the limit."""
    most = max(abs(value) for value in values)
    return tuple(values) if most <= limit else tuple(limit / most * value for value in values)
