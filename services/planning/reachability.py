"""Whether a target can be grasped from where the robot stands: by the kinematics it reaches with, and, where it has
learned them, by where the hand was ever seen."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from cocoro.learning.handmap import HandMap
from cocoro.learning.reachability import Reach, ReachMesh
from cocoro.units import Vec3
from services.planning.config import Arm
from services.planning.reach import ARM, LEVEL_ROLL_RAD, HandPose, Reacher

BEYOND_M = 0.15
"""Further than this beyond all places where the hand was seen, what was learned of it says nothing."""
RETREAT_STEP_M, RETREAT_STEPS = 0.005, 8
RETREAT_ROOM_M = 0.01
"""The arm must fold in further than to where it waits, lest it waits at its limits."""
RETREAT_HEIGHTS_M = (0.045, 0.08)
_UPRIGHT = {"arm_base": -0.087, "shoulder": 0.66, "elbow": -1.6, "wrist_pitch": 0.77, "wrist_roll": LEVEL_ROLL_RAD}
"""Elbow up, hand before the robot: where the search for joint angles starts, so that it stays in that family."""


class Grasp(NamedTuple):
    """Where the hand has to go for a target: behind it, and around it."""

    behind: HandPose
    around: HandPose


class Reachability:
    def __init__(self, config: Arm, reacher: Reacher) -> None:
        self._config = config
        self._reacher = reacher
        self._seen: tuple[HandMap, ReachMesh] | None = None
        self._retreat_m: float | None = None

    def use(self, learned: HandMap | None, mesh: ReachMesh | None) -> None:
        """Judge by where the hand was seen, too, from now on; None: by the kinematics alone."""
        self._seen = (learned, mesh) if learned is not None and mesh is not None else None
        self._retreat_m = None  # the kinematics may have changed, too

    @property
    def retreat_m(self) -> float:
        """Where the hand waits behind a target, from the arm base's axis: no nearer than the arm folds."""
        if self._retreat_m is None:
            self._retreat_m = self._retreat()
        return self._retreat_m

    def _retreat(self) -> float:
        """The configured radius, or as much more as the kinematics that it reaches with want: a hand that is learned to
        be further out than its drawing has it folds less far in."""
        config = self._config
        for more in range(RETREAT_STEPS):
            radius = config.retreat_radius_m + more * RETREAT_STEP_M
            poses = [HandPose(radius - RETREAT_ROOM_M, 0.0, height, config.pitch_rad) for height in RETREAT_HEIGHTS_M]
            if all(self._reacher.solve(_UPRIGHT, pose) is not None for pose in poses):
                return radius
        return config.retreat_radius_m

    def grasp(self, target_m: Vec3) -> Grasp:
        """The hand poses for a target's centre (body frame), reachable or not."""
        config = self._config
        radius, azimuth, height = self._reacher.seen_from_arm(target_m)
        low, high = config.grasp_height_range_m
        height = min(max(height, low), high)
        behind = HandPose(self.retreat_m, azimuth, height, config.pitch_rad)
        return Grasp(behind, behind._replace(radius_m=radius))

    def why_not(self, target_m: Vec3, *, touching: bool = False) -> str:
        """Why a target cannot be grasped from here, or just touched; '' when it can."""
        config = self._config
        radius_range_m = config.touch_radius_range_m if touching else config.grasp_radius_range_m
        radius, azimuth, height = self._reacher.seen_from_arm(target_m)
        for name, value, (low, high), unit in (
            ("radius", radius, radius_range_m, "m from the arm base"),
            ("azimuth", azimuth, config.grasp_azimuth_range_rad, "rad from the arm base"),
        ):
            if not low <= value <= high:
                return f"its {name} is {value:.2f} {unit}, reachable is {low:.2f} to {high:.2f}"
        if height > config.grasp_height_range_m[1]:
            return f"it is {height:.2f} m high, reachable is up to {config.grasp_height_range_m[1]:.2f}"
        grasp = self.grasp(target_m)
        start = _UPRIGHT | {"arm_base": _UPRIGHT["arm_base"] + azimuth}
        around = self._reacher.solve(start, grasp.around)
        if around is None or self._reacher.solve(start, grasp.behind) is None:
            return "the joint limits do not let the hand there"
        if self._seen is not None:
            learned, mesh = self._seen
            # In a gap between sightings, and a little beyond them, it may try: there the drawing still serves.
            place = learned.at(np.array([around[name] for name in ARM]))
            if mesh.verdict(place) is Reach.OUTSIDE and mesh.nearest_m(place) > BEYOND_M:
                return "the hand was never seen anywhere near"
        return ""
