"""Distance of the arm from what it must not enter: the camera mount, the chassis and the floor.

The arm's hull is a chain of balls along its links (`hull` in the robot description); distances are to their surfaces
(derived).
"""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, radians, sin

import numpy as np

from cocoro.arrays import BoolArray, FloatArray
from cocoro.robot import Robot

ON_CHASSIS_M = 0.03
"""Height of what is mounted on top of the chassis."""
_ALONG_FINGER = np.array([[0.0], [0.5], [1.0]])
"""Places of a finger's balls, as shares of its length."""


def from_box_m(centres: FloatArray, radii: FloatArray, box: FloatArray) -> float:
    """The least distance, m, of balls from a box of two corners (2, 3)."""
    return float((np.linalg.norm(centres - np.clip(centres, box[0], box[1]), axis=1) - radii).min())


class Clearance:
    """The hull of one robot, and its distances."""

    def __init__(self, robot: Robot) -> None:
        hull = robot.hull
        self._tubes = [(tube.start, tube.end, np.linspace(0.0, 1.0, tube.balls)[:, None]) for tube in hull.tube]
        self._finger_reach = robot.claw.pad_length_m * _ALONG_FINGER
        # A finger lies across its claw's own x axis, towards the hand's tip.
        turns_rad = {name: radians(turn_deg) for name, turn_deg in hull.finger_turn_deg.items()}
        self._fingers = {name: np.array([cos(turn), sin(turn), 0.0]) for name, turn in turns_rad.items()}
        self._at_zero = dict.fromkeys(robot.jaws, 0.0)
        radii = [tube.radius_m for tube in hull.tube for _ in range(tube.balls)]
        self._radii = np.array(radii + [hull.finger_radius_m] * (len(_ALONG_FINGER) * len(self._fingers)))
        self._tree = robot.tree(*(name for tube in hull.tube for name in (tube.start, tube.end)), *self._fingers)
        self._mount = None if robot.eye.mount is None else np.array(robot.eye.mount)
        self._chassis_radius_m = robot.base.chassis_diameter_m / 2
        self._chassis_top_m = robot.base.chassis_height_m + ON_CHASSIS_M
        on_hand = [robot.arm.roll in robot.chain(tube.start).joints for tube in hull.tube]
        hand = [on for on, tube in zip(on_hand, hull.tube, strict=True) for _ in range(tube.balls)]
        self.on_hand: BoolArray = np.array(hand + [True] * (len(self._radii) - len(hand)))
        """Which of the hull's balls belong to the hand, shape (n,)."""
        self._beyond_chassis = hull.tube[0].balls
        """Index of the first ball that is checked against the chassis: the first tube turns on it."""

    def hull(self, angles: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
        """Centres, shape (n, 3), body frame, metres, and radii, shape (n,), metres, of the hull's balls.

        `angles`: radians, of every joint of the arm; a claw's is taken to be 0 where it is missing.
        """
        angles = self._at_zero | dict(angles)
        poses = self._tree.poses(angles)
        balls: list[FloatArray] = []
        for start, end, share in self._tubes:
            balls.append((1 - share) * poses[start][:3, 3] + share * poses[end][:3, 3])
        for name, turn in self._fingers.items():
            pose = poses[name]
            balls.append(pose[:3, 3] + self._finger_reach * (pose[:3, :3] @ turn))
        return np.concatenate(balls), self._radii

    def of(self, angles: Mapping[str, float]) -> float:
        """The least distance, metres, of the hull from mount, chassis and floor; negative inside of one of them.

        `angles`: as for `hull`.
        """
        centres, radii = self.hull(angles)
        floor = centres[:, 2] - radii
        over = np.maximum(np.hypot(centres[:, 0], centres[:, 1]) - self._chassis_radius_m, 0.0)
        above = np.maximum(centres[:, 2] - self._chassis_top_m, 0.0)
        chassis = (np.hypot(over, above) - radii)[self._beyond_chassis :]
        least_m = float(min(floor.min(), chassis.min()))
        return least_m if self._mount is None else min(least_m, from_box_m(centres, radii, self._mount))
