"""How near the arm is to what it must not enter: the camera mount, the chassis and the floor.

The arm's hull is a chain of balls along its links; distances are to their surfaces (derived).
"""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, radians, sin

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.robot import Robot

TUBES = (
    # from, to, radius of the hull, balls
    ("shoulder", "elbow", 0.025, 5),
    ("elbow", "wrist_pitch", 0.025, 4),
    ("wrist_pitch", "wrist_roll", 0.025, 2),
    ("wrist_roll", "gripper", 0.030, 5),
)
_FINGER_TURN_RAD = {"claw_left": radians(80.0), "claw_right": radians(-80.0)}
"""From the claw's x axis to its finger (Tekkotsu Calliope5KP.kin)."""
_FINGER_M = 0.11
_FINGER_REACH = np.array([[0.0], [0.5 * _FINGER_M], [_FINGER_M]])
_FINGER_RADIUS_M = 0.02


class Clearance:
    def __init__(self, robot: Robot) -> None:
        self._shares = [np.linspace(0.0, 1.0, count)[:, None] for *_, count in TUBES]
        radii = [radius_m for *_, radius_m, count in TUBES for _ in range(count)]
        self._radii = np.array(radii + [_FINGER_RADIUS_M] * (len(_FINGER_REACH) * len(_FINGER_TURN_RAD)))
        self._tree = robot.tree(*(name for tube in TUBES for name in tube[:2]), *_FINGER_TURN_RAD)
        # A finger lies across its claw's own x axis, towards the hand's tip.
        self._fingers = {name: np.array([cos(turn), sin(turn), 0.0]) for name, turn in _FINGER_TURN_RAD.items()}
        self._mount_min = np.array(robot.kinect.mount_min_m)
        self._mount_max = np.array(robot.kinect.mount_max_m)
        self._chassis_radius_m = robot.base.chassis_diameter_m / 2
        self._chassis_top_m = robot.base.chassis_height_m + 0.03

    def hull(self, angles: Mapping[str, float]) -> tuple[FloatArray, FloatArray]:
        """Centres (n, 3) in the body frame and radii (n,) of the arm's balls. The claws' angles may be left out."""
        angles = dict.fromkeys(_FINGER_TURN_RAD, 0.0) | dict(angles)
        poses = self._tree.poses(angles)
        balls: list[FloatArray] = []
        for (start, end, *_), share in zip(TUBES, self._shares, strict=True):
            balls.append((1 - share) * poses[start][:3, 3] + share * poses[end][:3, 3])
        for name, turn in self._fingers.items():
            pose = poses[name]
            balls.append(pose[:3, 3] + _FINGER_REACH * (pose[:3, :3] @ turn))
        return np.concatenate(balls), self._radii

    def of(self, angles: Mapping[str, float]) -> float:
        """The least distance, metres; negative inside of something."""
        centres, radii = self.hull(angles)
        nearest = np.clip(centres, self._mount_min, self._mount_max)
        mount = np.linalg.norm(centres - nearest, axis=1) - radii
        floor = centres[:, 2] - radii
        over = np.maximum(np.hypot(centres[:, 0], centres[:, 1]) - self._chassis_radius_m, 0.0)
        above = np.maximum(centres[:, 2] - self._chassis_top_m, 0.0)
        # The upper arm turns on the chassis, which nothing can bring it nearer to.
        chassis = (np.hypot(over, above) - radii)[TUBES[0][3] :]
        return float(min(mount.min(), floor.min(), chassis.min()))
