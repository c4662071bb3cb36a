"""Where the head looks: sweeping when the target is lost, fixating it when it is seen."""

from __future__ import annotations

from collections.abc import Mapping
from math import atan2, cos

import numpy as np

from cocoro.robot import Robot
from services.planning.config import HeadConfig

PAN, TILT = "neck_pan", "neck_tilt"


class Gaze:
    """Solves for the pan and tilt that bring a point of the body frame into the centre of the image."""

    def __init__(self, robot: Robot, config: HeadConfig) -> None:
        self._chain = robot.chain("camera")
        self._limits = [robot.joints[PAN].limits_rad, config.tilt_range_rad]

    def at(self, point_m: tuple[float, float, float], start: Mapping[str, float]) -> tuple[float, float]:
        """(pan, tilt) in radians, within the limits; Newton's method from the present angles (derived): the neck's axes
        are nearly those of the image, so each angle is corrected by its own image angle."""
        pan, tilt = start.get(PAN, 0.0), start.get(TILT, 0.0)
        point = np.array([*point_m, 1.0])
        for _ in range(5):
            pose = self._chain.pose({PAN: pan, TILT: tilt})
            x, y, z = pose[:3, :3].T @ (point[:3] - pose[:3, 3])
            if z < 1e-3:
                # Behind the camera: turn by the bearing first, from a level look.
                pan, tilt = pan + atan2(-x, z), 0.0
                continue
            pan -= atan2(x, z * max(cos(tilt), 0.2))
            tilt -= atan2(y, z)
            tilt = min(max(tilt, self._limits[1][0]), self._limits[1][1])
        (pan_min, pan_max), (tilt_min, tilt_max) = self._limits
        pan = (pan + np.pi) % (2 * np.pi) - np.pi
        return float(min(max(pan, pan_min), pan_max)), float(min(max(tilt, tilt_min), tilt_max))


class Sweep:
    """A fixed pattern over the whole pan range at two tilts, one for the floor far off, one for the floor near by.
    What lies ahead comes first: a little to one side, all the way to the other, back at the near tilt, and last what is
    left of the first side."""

    def __init__(self, config: HeadConfig, pan_rad: float) -> None:
        self._config = config
        side = 1.0 if pan_rad >= 0 else -1.0
        reach, ahead = side * config.sweep_pan_rad, side * config.sweep_ahead_rad
        far, near = config.sweep_tilts_rad
        self._corners = [(ahead, far), (-reach, far), (-reach, near), (reach, near), (reach, far), (ahead, far)]
        self.swept = 0
        """Corners that were reached."""

    @property
    def done(self) -> bool:
        return self.swept >= len(self._corners)

    @property
    def share(self) -> float:
        return self.swept / len(self._corners)

    def next(self, pan_rad: float, tilt_rad: float) -> tuple[float, float]:
        """(pan, tilt) to go to now."""
        while not self.done:
            pan, tilt = self._corners[self.swept]
            if abs(pan - pan_rad) > 0.05 or abs(tilt - tilt_rad) > 0.05:
                return pan, tilt
            self.swept += 1
        return self._corners[-1]
