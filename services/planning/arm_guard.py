"""What an arm must not come near to that moves by somebody else's joint goals: obstacles, and the robot itself.

The hand's paths of the planner keep to where none of that is; joint goals of a policy may lead anywhere. What
`ArmController` checks in every step, mount, chassis and floor, is not checked here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.frames import Pose2
from cocoro.robot import Robot
from cocoro.units import Vec3
from services.planning.caution import ArmHull, room_m
from services.planning.clearance import Clearance, from_box_m
from services.planning.config import PlanningConfig
from services.planning.surroundings import Fields

HELD_M = 0.06
"""Radius of the ball that stands for what the hand holds."""


class ArmGuard:
    def __init__(self, robot: Robot, config: PlanningConfig, clearance: Clearance) -> None:
        hull = robot.hull
        self._config = config
        self._clearance = clearance
        self._chassis_m = robot.base.chassis_diameter_m / 2
        self._housing = None if hull.kinect is None else np.array(hull.kinect)
        self._upper = robot.chain(hull.tube[0].start), robot.chain(hull.tube[0].end)
        self._upper_m = hull.tube[0].radius_m

    def why_not(
        self,
        now: Mapping[str, float],
        then: Mapping[str, float],
        held_m: tuple[Vec3, Vec3] | None,
        poses: Sequence[Pose2],
        fields: Fields,
    ) -> str:
        """Why the arm must not go on from the angles of all joints `now` to those `then`, rad; '' when it may. What is
        too near already may go away. `held_m`: the places of what the hand holds at both, body frame. `poses`: of the
        body meanwhile, odometry frame."""
        own_m = self.own_m(then)
        if own_m < self._config.arm.clearance_m and own_m < self.own_m(now) - 1e-6:
            return "the arm cannot go there: the robot is in its way"
        here, there = self._hulls(now, then, held_m)
        if not len(here.radii_m):
            return ""
        now_m = room_m(here, poses[0], fields)
        then_m = np.min([room_m(there, pose, fields) for pose in poses], axis=0)
        if (then_m < np.minimum(now_m - 1e-6, self._config.by_hand.hull_m)).any():
            return "the arm cannot go there: something is in its way"
        return ""

    def own_m(self, angles: Mapping[str, float]) -> float:
        """Least distance of the hull from the camera's housing, and of the hand from the upper arm, m."""
        centres, radii = self._clearance.hull(angles)
        start, end = (chain.position(angles) for chain in self._upper)
        along, on_hand = end - start, self._clearance.on_hand
        hand: FloatArray = centres[on_hand] - start
        share = np.clip(hand @ along / (along @ along), 0.0, 1.0)
        upper_m = np.linalg.norm(hand - share[:, None] * along, axis=1) - radii[on_hand] - self._upper_m
        least_m = float(upper_m.min())
        return least_m if self._housing is None else min(least_m, from_box_m(centres, radii, self._housing))

    def _hulls(
        self, now: Mapping[str, float], then: Mapping[str, float], held_m: tuple[Vec3, Vec3] | None
    ) -> tuple[ArmHull, ArmHull]:
        """The balls that are beyond the body at one of both postures."""
        hulls = []
        for number, angles in enumerate((now, then)):
            centres, radii = self._clearance.hull(angles)
            if held_m is not None:
                centres, radii = np.vstack([centres, held_m[number]]), np.append(radii, HELD_M)
            hulls.append((centres, radii))
        beyond = np.any([np.hypot(c[:, 0], c[:, 1]) + r > self._chassis_m for c, r in hulls], axis=0)
        low_m = self._config.by_hand.low_m
        here, there = (ArmHull(c[beyond, :2], r[beyond], c[beyond, 2] - r[beyond] < low_m) for c, r in hulls)
        return here, there
