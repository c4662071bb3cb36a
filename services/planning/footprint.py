"""The floor that body and hand take, and whether it is free along a way."""

from __future__ import annotations

from math import hypot
from typing import Literal

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.frames import Pose2
from cocoro.robot import Robot
from services.planning.config import NavigationConfig
from services.planning.surroundings import Fields, placed

ArmOut = Literal["last", "out", "folded"]
"""Where the arm is extended on a drive: on the last stretch, all the way, or nowhere."""


class Footprint:
    def __init__(self, robot: Robot, config: NavigationConfig, aim_m: tuple[float, float], arm: ArmOut) -> None:
        """`aim_m`: where the hand's target ends, body frame."""
        self._config = config
        self._arm_out = arm == "out"
        self.body_m = robot.base.chassis_diameter_m / 2
        reach = () if arm == "folded" else np.arange(0.22, aim_m[0] + 0.09, 0.04)
        self.arm: FloatArray = np.array([[x, aim_m[1]] for x in reach]).reshape(-1, 2)
        """The hand with open claws along the arm's line in front of the robot, (n, 2), body frame, m."""

    def free(self, poses: list[Pose2], fields: Fields, share: float, arm_from_m: float) -> bool:
        """Whether body and (over the last `arm_from_m`) hand pass all poses with this share of their margins."""
        centres = np.array([[pose.x_m, pose.y_m] for pose in poses])
        clearance = fields.body.at(centres) - self.body_m
        # The robot may always leave the place where it stands.
        leaving = np.hypot(*(centres - centres[0]).T) < 0.10
        if (clearance[~leaving] < share * self._config.clearance_m).any():
            return False
        end = centres[-1]
        half_m = self._config.hand_half_width_m * (0.4 + 0.6 * share)
        for pose in [*poses[::3], poses[-1]]:
            near_end = hypot(pose.x_m - end[0], pose.y_m - end[1]) <= (0.02 if self._arm_out else arm_from_m)
            if not self.arm_free(pose, fields, half_m, near_end=near_end):
                return False
        return True

    def free_stretch(self, stretch: list[Pose2], fields: Fields) -> bool:
        centres = np.array([[pose.x_m, pose.y_m] for pose in stretch])
        if (fields.body.at(centres) < self.body_m + self._config.clearance_m).any():
            return False
        half_m = self._config.hand_half_width_m + 0.01
        last = len(stretch) - 1
        return all(
            self.arm_free(pose, fields, half_m, near_end=not self._arm_out or number == last)
            for number, pose in enumerate(stretch)
        )

    def arm_free(self, pose: Pose2, fields: Fields, half_m: float, *, near_end: bool) -> bool:
        """Whether the hand passes a pose. Carried high it passes over known objects; near the end it is low."""
        if not len(self.arm) or not (near_end or self._arm_out):
            return True
        field = fields.arm if self._arm_out and not near_end else fields.body
        return not (field.at(placed(self.arm, pose)) < half_m).any()

    def may_turn(self, turn_rad: float, body: Pose2, fields: Fields) -> bool:
        """Whether the extended arm meets nothing while the robot turns on the spot; the body is round."""
        if not self._arm_out or not len(self.arm):
            return True
        now_m = float(fields.arm.at(placed(self.arm, body)).min())
        turns = np.linspace(0.0, turn_rad, max(2, round(abs(turn_rad) / 0.1)))
        poses = [Pose2(body.x_m, body.y_m, body.yaw_rad + float(turned)) for turned in turns]
        least_m = min(float(fields.arm.at(placed(self.arm, pose)).min()) for pose in poses)
        return least_m >= min(self._config.hand_half_width_m * 0.7, now_m)
