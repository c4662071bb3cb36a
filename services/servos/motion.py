"""One joint's way to its goal: what is written into its servo's goal and speed registers. Pure.

The servo is never told the far goal. It is told a point on the way, `LEAD_S` of travel ahead of where it should be by
now, at the speed that was commanded: so it moves as if it had been told the goal, and stops by itself when whoever
tells it dies. (Derived.)
"""

from __future__ import annotations

from cocoro.clock import NS
from cocoro.robot import SERVO_COUNT_RAD, Joint
from services.servos import table

LEAD_S = 0.2
REACH_RAD = 0.4
"""No further than this ahead of where the joint is: beyond any slope, so that it pushes with all it may, and not so far
that it leaps when what blocked it gives way."""
AT_GOAL_COUNTS = 2
"""A joint that near to its goal has arrived: it is not stopped when its command expires."""
HOLD_RADPS = 1.0
"""How fast a held joint goes back to where it is held."""


class JointMotion:
    """Told the robot's time with every call. With `keeps_goal` (the hand) a command that expires still counts."""

    def __init__(self, joint: Joint, *, keeps_goal: bool) -> None:
        self.joint = joint
        self.goal_rad: float | None = None
        """None until it is known where the joint is."""
        self._keeps_goal = keeps_goal
        self._speed_radps = HOLD_RADPS
        self._until_ns: int | None = None
        self._point_rad = 0.0
        """Where the joint should be by now."""
        self._then_ns: int | None = None

    def command(self, goal_rad: float, speed_radps: float, position_rad: float, until_ns: int) -> None:
        """Go to a goal within the joint's limits, until then; a speed of 0 holds where the joint is."""
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
        """Stay there, whatever was commanded."""
        self.goal_rad = self._point_rad = position_rad
        self._speed_radps = HOLD_RADPS
        self._until_ns = None

    def forget_time(self) -> None:
        """The clock began anew."""
        self._then_ns = None
        if self._until_ns is not None:
            self._until_ns = -1

    def order(self, position_rad: float, now_ns: int) -> tuple[int, int] | None:
        """Goal position and moving speed to write now, in counts; None when nothing is known to be told."""
        if self.goal_rad is None:
            return None
        if self._until_ns is not None and now_ns > self._until_ns:
            self._until_ns = None
            if not self._keeps_goal and abs(self.goal_rad - position_rad) > AT_GOAL_COUNTS * SERVO_COUNT_RAD:
                self.hold(position_rad)
        dt_s = 0.0 if self._then_ns is None else max(now_ns - self._then_ns, 0) / NS
        self._then_ns = now_ns
        self._point_rad = _towards(self._point_rad, self.goal_rad, self._speed_radps * dt_s)
        self._point_rad = min(max(self._point_rad, position_rad - REACH_RAD), position_rad + REACH_RAD)
        ahead_rad = _towards(self._point_rad, self.goal_rad, self._speed_radps * LEAD_S)
        # 0 would be as fast as it can.
        speed = min(max(round(self._speed_radps / table.SPEED_RADPS), 1), table.FASTEST)
        return self.joint.to_count(ahead_rad), speed


def _towards(value: float, goal: float, step: float) -> float:
    return goal if abs(goal - value) <= step else value + (step if goal > value else -step)
