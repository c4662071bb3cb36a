"""What really became of a pursuit, by the simulator's truth alone."""

from __future__ import annotations

from math import hypot

import msgspec
import numpy as np

from cocoro.arrays import FloatArray
from cocoro.messages import TrueObject, Truth
from cocoro.robot import Robot
from sim.rigid import rotation
from sim.scene import Scene


class Pursuit(msgspec.Struct, frozen=True, kw_only=True):
    """Of a follow task, from the moment that following began."""

    mean_gap_m: float
    """From the robot's centre to the target's nearest edge, level."""
    max_gap_m: float
    min_gap_m: float
    lost_s: float
    """The longest time in which the camera did not have the target's centre in its picture."""
    contacts: int
    """Times that the robot began to touch anything but the floor."""


class PursuitJudge:
    """Feed it every truth; `begin` when following begins. Raises KeyError for a target that the scene has not."""

    def __init__(self, robot: Robot, scene: Scene, target: str) -> None:
        self._camera = robot.camera
        self._chain = robot.chain("camera")
        self._radius_m = scene.object(target).dimensions_m[0]
        self._target = target
        self._begun = False
        self._gaps_m: list[float] = []
        self._seen_ns: int | None = None
        self._longest_ns = 0
        self._touching: frozenset[str] = frozenset()
        self._contacts = 0

    def begin(self) -> None:
        self._begun = True

    def feed(self, truth: Truth) -> None:
        if not self._begun:
            return
        target = next(item for item in truth.objects if item.label == self._target)
        level = hypot(target.position_m[0] - truth.body_m[0], target.position_m[1] - truth.body_m[1])
        self._gaps_m.append(level - self._radius_m)
        if self._seen_ns is None or self._in_picture(truth, target):
            self._seen_ns = truth.stamp_ns
        self._longest_ns = max(self._longest_ns, truth.stamp_ns - self._seen_ns)
        touching = frozenset(truth.collisions)
        self._contacts += len(touching - self._touching)
        self._touching = touching

    def _in_picture(self, truth: Truth, target: TrueObject) -> bool:
        body = np.eye(4)
        body[:3, :3] = rotation(truth.body_orientation)
        body[:3, 3] = truth.body_m
        pose: FloatArray = body @ self._chain.pose(truth.joints_rad)
        x, y, z = pose[:3, :3].T @ (np.array(target.position_m) - pose[:3, 3])
        if z <= 0:
            return False
        u, v = self._camera.cx + self._camera.fx * x / z, self._camera.cy + self._camera.fy * y / z
        return bool(0 <= u < self._camera.width and 0 <= v < self._camera.height)

    def result(self) -> Pursuit:
        gaps = self._gaps_m or [float("nan")]
        return Pursuit(
            mean_gap_m=float(np.mean(gaps)),
            max_gap_m=max(gaps),
            min_gap_m=min(gaps),
            lost_s=self._longest_ns / 1e9,
            contacts=self._contacts,
        )
