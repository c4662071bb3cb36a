"""Odometry of a Create: integrated wheel commands, corrected by its coarse reports.

A Create reports its path in whole millimetres and its turn in whole degrees since the last request, and drops the rest
(iRobot Create Open Interface, packets 19 and 20). Requested often, a slow arc reads as straight ahead; requested
rarely, the pose lags. Between reports the commanded wheel speeds are therefore integrated, with the Create's own ramp,
and the integral since the last report is clamped into the interval that the report allows (derived; the problem is
known from other drivers of this base).
"""

from __future__ import annotations

from math import cos, sin

from cocoro.description import Base

REPORT_PERIOD_S = 0.2
"""Period of requests for path and turn: at 5 Hz the unit of a report is small against its value."""
MILLIMETRE_M = 1e-3
DEGREE_RAD = 0.017453292519943295


class WheelRamp:
    """Wheel speeds that follow the commanded ones: clipped, with limited acceleration."""

    def __init__(self, base: Base) -> None:
        self._limit_mps = base.max_wheel_speed_mps
        self._acceleration_mps2 = base.wheel_acceleration_mps2
        self.left_mps = 0.0
        self.right_mps = 0.0

    def advance(self, left_mps: float, right_mps: float, dt_s: float) -> None:
        """One time step towards the commanded speeds."""
        reach = self._acceleration_mps2 * dt_s
        self.left_mps += _clip(_clip(left_mps, self._limit_mps) - self.left_mps, reach)
        self.right_mps += _clip(_clip(right_mps, self._limit_mps) - self.right_mps, reach)


class Odometry:
    """The body's pose in the frame in which it started, and its speeds."""

    def __init__(self, base: Base) -> None:
        self._separation_m = base.wheel_separation_m
        self.x_m = 0.0
        self.y_m = 0.0
        self.yaw_rad = 0.0
        self.speed_mps = 0.0
        self.turn_rate_radps = 0.0
        self._way_m = 0.0
        self._turn_rad = 0.0
        self._report_x_m = 0.0
        self._report_y_m = 0.0
        self._report_yaw_rad = 0.0

    def advance(self, left_m: float, right_m: float, dt_s: float) -> None:
        """Advance the pose by the arc that the wheels' travel in `dt_s` gives."""
        way_m = (left_m + right_m) / 2
        turn_rad = (right_m - left_m) / self._separation_m
        heading = self.yaw_rad + turn_rad / 2
        chord_m = way_m * _chord_per_arc(turn_rad)
        self.x_m += chord_m * cos(heading)
        self.y_m += chord_m * sin(heading)
        self.yaw_rad += turn_rad
        self._way_m += way_m
        self._turn_rad += turn_rad
        self.speed_mps = way_m / dt_s
        self.turn_rate_radps = turn_rad / dt_s

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
