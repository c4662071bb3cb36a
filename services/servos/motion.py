"""The motion of a joint to its goal: the values for its servo's goal and speed registers. Pure.

The servo never gets the final goal, but a point `LEAD_S` of travel ahead of where the joint should be now, at the
commanded speed. So it moves as if it had the final goal, and stops by itself when the service dies. (Derived.)
"""

from __future__ import annotations

from math import radians

from cocoro.clock import NS
from cocoro.joints import Joint

LEAD_S = 0.2
REACH_RAD = 0.4
"""Upper bound for how far the point is ahead of the joint: more than any slope, so that a blocked joint pushes with its
full torque limit, but so little that it does not leap when it comes free."""
AT_GOAL_RAD = radians(0.59)
"""A joint this close to its goal, two counts of an AX-12, has arrived: it is not stopped when its command expires."""
HOLD_RADPS = 1.0
"""Speed at which a joint that was pushed away returns to where it is held."""


class JointMotion:
    """Every `now_ns` is the robot's clock. With `keeps_goal` (the hand) the goal outlives its command."""

    def __init__(self, joint: Joint, *, keeps_goal: bool) -> None:
        self.joint = joint
        self.goal_rad: float | None = None
        """None until the joint's position is known."""
        self._keeps_goal = keeps_goal
        self._speed_radps = HOLD_RADPS
        self._until_ns: int | None = None
        self._point_rad = 0.0
        """Where the joint should be now."""
        self._then_ns: int | None = None

    def command(self, goal_rad: float, speed_radps: float, position_rad: float, until_ns: int) -> None:
        """Go to a goal, clipped to the joint's limits, until `until_ns`; a speed of 0 holds the joint where it is."""
        if speed_radps == 0.0:
            if self._until_ns is not None or self.goal_rad is None:
                self.hold(position_rad)
            return
        if self.goal_rad is None:
            self._point_rad = position_rad
        low, high = self.joint.limits_rad
        self.goal_rad = min(max(goal_rad, low), high)
        self._speed_radps = min(speed_radps, self.joint.max_speed_radps)
        self._until_ns = until_ns

    def hold(self, position_rad: float) -> None:
        """Drop the command and stay at `position_rad`."""
        self.goal_rad = self._point_rad = position_rad
        self._speed_radps = HOLD_RADPS
        self._until_ns = None

    def forget_time(self) -> None:
        """The clock restarted: a running command expires."""
        self._then_ns = None
        if self._until_ns is not None:
            self._until_ns = -1

    def order(self, position_rad: float, now_ns: int) -> tuple[int, int] | None:
        """Goal position and moving speed to write now, counts; None while there is no goal."""
        if self.goal_rad is None:
            return None
        if self._until_ns is not None and now_ns > self._until_ns:
            self._until_ns = None
            if not self._keeps_goal and abs(self.goal_rad - position_rad) > AT_GOAL_RAD:
                self.hold(position_rad)
        dt_s = 0.0 if self._then_ns is None else max(now_ns - self._then_ns, 0) / NS
        self._then_ns = now_ns
        self._point_rad = _towards(self._point_rad, self.goal_rad, self._speed_radps * dt_s)
        self._point_rad = min(max(self._point_rad, position_rad - REACH_RAD), position_rad + REACH_RAD)
        ahead_rad = _towards(self._point_rad, self.goal_rad, self._speed_radps * LEAD_S)
        # 0 would mean full speed.
        units = self.joint.units
        speed = min(max(round(self._speed_radps / units.speed_radps), 1), units.fastest)
        return self.joint.to_count(ahead_rad), speed


def _towards(value: float, goal: float, step: float) -> float:
    return goal if abs(goal - value) <= step else value + (step if goal > value else -step)
