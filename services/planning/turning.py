"""The base's odometry, with what is known of its errors taken out."""

from __future__ import annotations

from math import cos, sin

from cocoro.frames import Pose2
from cocoro.messages import BaseState
from services.planning.pose_matching import Constants


class Turning:
    """The base's odometry with a learned wheel distance in place of the nominal one, and without its known errors.

    The base computes its heading from the wheels' travel and the nominal distance; here it is scaled, and with it the
    direction of each stretch of its path. Path length and speed do not depend on the distance.
    """

    def __init__(self) -> None:
        self.ratio = 1.0
        """Nominal over learned wheel distance; 1 while nothing is learned."""
        self.constants = Constants()
        """Errors that the sight of walls has shown."""
        self._before: BaseState | None = None
        self._pose = Pose2()

    def pose(self, state: BaseState) -> Pose2:
        """The body's pose in the odometry frame. Call it once for each state, in order."""
        raw = Pose2(*state.odometry_m, state.odometry_yaw_rad)
        before, self._before = self._before, state
        anew = before is None or before.incarnation != state.incarnation or state.stamp_ns < before.stamp_ns
        if anew or before is None:
            self._pose = raw
            return raw
        then = Pose2(*before.odometry_m, before.odometry_yaw_rad)
        if self.ratio == 1.0 and not any(self.constants) and self._pose == then:
            self._pose = raw
            return raw
        step = then.inverse().compose(raw)
        # The chord is half the turn off the heading at its start, so another turn changes its direction.
        extra_rad = (self.ratio - 1.0) * step.yaw_rad
        c, s = cos(extra_rad / 2), sin(extra_rad / 2)
        bent = Pose2(c * step.x_m - s * step.y_m, s * step.x_m + c * step.y_m, step.yaw_rad + extra_rad)
        self._pose = self._pose.compose(self.constants.step(bent))
        return self._pose
