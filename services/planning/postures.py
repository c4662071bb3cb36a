"""Postures that the arm may babble into and paths between them, clear of the robot and the floor; and the draws."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np
import scipy  # loads its parts lazily: `scipy.stats` takes half a second

from cocoro.arrays import FloatArray
from cocoro.robot import Robot
from services.planning.clearance import Clearance, from_box_m
from services.planning.gaze import Gaze

RANGE_RAD = 2.62
"""The paper's range of each joint."""
MARGIN_M = 0.03
"""Clearance of a safe posture: the body may differ from the nominal model by a centimetre or two."""
WAY_RAD = 0.12
"""Largest step of a joint between the checked postures of a path."""
OWN_ARM_M = 0.02
"""Least distance of the hand from the hull of the upper arm."""


class Postures:
    """Judges postures (4,), rad, of the arm's joints in their order, with the hand level."""

    def __init__(self, robot: Robot, gaze: Gaze) -> None:
        """Raises ConfigError for a robot without a marker."""
        self._joints, self._roll = robot.arm.joints, robot.arm.roll
        limits = np.array([robot.joints[name].limits_rad for name in self._joints])
        self.ranges = np.clip(limits, -RANGE_RAD, RANGE_RAD)
        self._clearance = Clearance(robot)
        hull = robot.hull
        self._from_upper_arm_m = hull.tube[0].radius_m + OWN_ARM_M
        self._kinect = None if hull.kinect is None else np.array(hull.kinect)
        self._roll_rad = robot.claw.level_roll_rad
        self._upper = robot.chain(hull.tube[0].start), robot.chain(hull.tube[0].end)
        self._head = robot.camera_chain.position(robot.head_angles())
        marker = robot.the_marker
        self._marker = robot.chain(marker.link), np.array([*marker.position_m, 1.0])
        self._gaze = gaze
        self._nearest_m = robot.eye.min_range_m

    def marker_m(self, angles: Mapping[str, float]) -> tuple[float, float, float]:
        """The marker's nominal position (x, y, z), body frame, metres, for the angles of all joints."""
        chain, marker = self._marker
        x, y, z = (chain.pose(angles) @ marker)[:3].tolist()
        return x, y, z

    def safe(self, posture: FloatArray) -> bool:
        """Whether mount, chassis, floor and Kinect are further than the margin, and the hand from the upper arm."""
        angles = self._angles(posture)
        if self._clearance.of(angles) < MARGIN_M:
            return False
        centres, radii = self._clearance.hull(angles)
        if self._kinect is not None and from_box_m(centres, radii, self._kinect) < MARGIN_M:
            return False
        shoulder, elbow = (chain.position(angles) for chain in self._upper)
        along = elbow - shoulder
        on_hand = self._clearance.on_hand
        hand = centres[on_hand] - shoulder
        share = np.clip(hand @ along / (along @ along), -0.3, 1.0)  # the shoulder's bracket is behind the axis
        away = np.linalg.norm(hand - share[:, None] * along, axis=1) - radii[on_hand]
        return float(away.min()) > self._from_upper_arm_m

    def seeable(self, posture: FloatArray) -> bool:
        """Whether the camera might see the marker: in the picture, not too near, and not hidden by the hand (nominal
        model)."""
        chain, marker = self._marker
        pose = chain.pose(self._angles(posture))
        place = (pose @ marker)[:3]
        to_camera = self._head - place
        distance_m = float(np.linalg.norm(to_camera))
        # The link's y points from the roll axis to the marker.
        if distance_m <= self._nearest_m or float(pose[:3, 1] @ to_camera) <= -0.1 * distance_m:
            return False
        x, y, z = place.tolist()
        return self._gaze.shows((x, y, z))

    def clear_way(self, start: FloatArray, end: FloatArray) -> bool:
        """Whether all postures on the straight path in joint space are safe; the start need not be."""
        count = int(np.ceil(float(np.abs(end - start).max()) / WAY_RAD))
        return all(self.safe(start + (end - start) * step / count) for step in range(1, count + 1))

    def _angles(self, posture: FloatArray) -> dict[str, float]:
        return dict(zip(self._joints, posture.tolist(), strict=True)) | {self._roll: self._roll_rad}


def sobol(first: int, ranges: FloatArray) -> Iterator[tuple[int, FloatArray]]:
    """Sobol draws (Sobol 1967) from number `first` on, without end: (number, point (n,) within `ranges` (n, 2)).

    Equal numbers give equal points, so babbling can continue where it ended. Number 0 is a corner of the box.
    """
    engine = scipy.stats.qmc.Sobol(len(ranges), scramble=False)
    if first:
        engine.fast_forward(first)
    low, high = ranges.T
    number = first
    while True:
        # Two at a time: the engine warns about a single first draw, which is not balanced.
        for share in engine.random(2):
            yield number, np.asarray(low + share * (high - low))
            number += 1
