"""Whether the robot's own arm stands between its camera and a thing."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial

from cocoro.objects import ObjectSpec
from cocoro.robot import Robot
from cocoro.units import Vec3
from services.planning.clearance import Clearance
from services.planning.gaze import Gaze
from services.planning.surroundings import OBJECT_M

SEEN_WHOLE = 3
"""Sightings that showed a thing whole, after which its place is known better than by a part of it."""


class OwnArm:
    def __init__(self, robot: Robot, gaze: Gaze, known: Mapping[str, ObjectSpec]) -> None:
        """`known`: the known objects by label, for their sizes."""
        self._gaze, self._known = gaze, known
        self._clearance = Clearance(robot)

    def hides(self, label: str, centre_m: Vec3, angles: Mapping[str, float]) -> bool:
        """Whether the arm may hide a part of a thing with its centre there, body frame, m, for the angles of all
        joints, rad. The middle of the part that is left is not the thing's, even where too little is hidden to be
        noted."""
        item = self._known.get(label)
        half_m = (OBJECT_M, OBJECT_M) if item is None else (item.planar_radius_m, item.size_m[2] / 2)
        return self._gaze.hidden(centre_m, half_m, partial(self._clearance.hull, angles))
