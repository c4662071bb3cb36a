"""How the eye is tilted beyond what the drawing of the neck says: from a target of known height on the floor.

An eye that is tilted too far up sees everything as if the room were turned about the neck's tilt axis: what is far away
too high, and what is below the eye too far away. The first tells the angle, the second is what driving by sight suffers
from (derived).
"""

from __future__ import annotations

from math import atan2, cos, hypot, sin

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.messages import FiniteVec3
from cocoro.robot import Robot


class CameraTilt:
    """Sees with the drawing of the neck, and knows by how much that is wrong."""

    def __init__(self, robot: Robot, tilt_rad: float = 0.0) -> None:
        """`tilt_rad`: by how much things are seen higher than they are, as an angle at the neck."""
        self._axis_x_m, _, self._axis_z_m = (
            robot.chain("neck_tilt").position({"neck_pan": 0.0, "neck_tilt": 0.0}).tolist()
        )
        self.tilt_rad = tilt_rad

    def straight(self, seen_m: FiniteVec3) -> FiniteVec3:
        """Where something is that is seen at a place; body frame."""
        if self.tilt_rad == 0.0:
            return seen_m
        x, y, up = seen_m[0] - self._axis_x_m, seen_m[1], seen_m[2] - self._axis_z_m
        level = hypot(x, y)
        c, s = cos(self.tilt_rad), sin(self.tilt_rad)
        share = (c * level + s * up) / max(level, 1e-6)
        return self._axis_x_m + share * x, share * y, self._axis_z_m + c * up - s * level

    def heights(self, seen_m: FloatArray) -> FloatArray:
        """How high things are above the floor that are seen at places (b, 3); shape (b,)."""
        level = np.hypot(seen_m[:, 0] - self._axis_x_m, seen_m[:, 1])
        up = seen_m[:, 2] - self._axis_z_m
        return np.asarray(self._axis_z_m + np.cos(self.tilt_rad) * up - np.sin(self.tilt_rad) * level)

    def tilt_of(self, seen_m: FiniteVec3, height_m: float) -> float:
        """What one sighting of something of a known height says of the tilt, radians."""
        level, up = hypot(seen_m[0] - self._axis_x_m, seen_m[1]), seen_m[2] - self._axis_z_m
        # It is turned up to where it is seen from where it is: as far from the axis, at the known height.
        away = hypot(level, up)
        true_up = height_m - self._axis_z_m
        return atan2(up, level) - atan2(true_up, max(away**2 - true_up**2, 1e-9) ** 0.5)
