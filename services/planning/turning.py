"""The base's odometry with a learned distance of the wheels in place of the drawing's.

It corrects the base's heading (`odometry_yaw_rad`) and turn rate, which the base makes of its wheels' roads with the
distance that it was told, and by the heading the direction of every stretch of its way (`odometry_m`). How far it
drove, and its speed, do not hang on that distance.
"""

from __future__ import annotations

from math import cos, sin

from cocoro.frames import Pose2
from cocoro.messages import BaseState


class Turning:
    """Carries a pose along by what the base reports, each turn scaled. While nothing is learned, the base's own."""

    def __init__(self) -> None:
        self.ratio = 1.0
        """The drawing's distance of the wheels over the learned one."""
        self._before: BaseState | None = None
        self._pose = Pose2()

    def pose(self, state: BaseState) -> Pose2:
        """Where the body stands, in the odometry frame; called once for each state, in order."""
        raw = Pose2(*state.odometry_m, state.odometry_yaw_rad)
        before, self._before = self._before, state
        anew = before is None or before.incarnation != state.incarnation or state.stamp_ns < before.stamp_ns
        if anew or before is None:
            self._pose = raw
            return raw
        then = Pose2(*before.odometry_m, before.odometry_yaw_rad)
        if self.ratio == 1.0 and self._pose == then:
            self._pose = raw
            return raw
        step = then.inverse().compose(raw)
        # The chord lies half the turn off the heading at its start: with another turn it lies otherwise.
        extra_rad = (self.ratio - 1.0) * step.yaw_rad
        c, s = cos(extra_rad / 2), sin(extra_rad / 2)
        bent = Pose2(c * step.x_m - s * step.y_m, s * step.x_m + c * step.y_m, step.yaw_rad + extra_rad)
        self._pose = self._pose.compose(bent)
        return self._pose

    def rate_radps(self, state: BaseState) -> float:
        """How fast the body turns."""
        return self.ratio * state.turn_rate_radps
