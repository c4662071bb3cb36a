"""The arm's true shape, finer than the planner's hull: points on the surfaces of the simulated body's parts."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.description import Part
from cocoro.robot import Robot
from sim.body import body_of_parts, pose_of

LINKS = ("shoulder", "elbow", "wrist_pitch", "wrist_roll", "claw_left", "claw_right")
STEP_M = 0.006


class ArmShape:
    def __init__(self, robot: Robot) -> None:
        parts = body_of_parts(robot).parts
        self._points = {link: np.vstack([_surface(part) for part in parts[link] if part.solid]) for link in LINKS}
        self._chains = {link: robot.chain(link) for link in LINKS}
        self._low, self._high = np.array(robot.eye.mount_min_m), np.array(robot.eye.mount_max_m)

    def points(self, angles_rad: Mapping[str, float]) -> FloatArray:
        """Positions of the points in the body frame, (n, 3), m."""
        placed = []
        for link, points in self._points.items():
            pose = self._chains[link].pose(angles_rad)
            placed.append(points @ pose[:3, :3].T + pose[:3, 3])
        return np.vstack(placed)

    def depth_in_mount_m(self, angles_rad: Mapping[str, float]) -> float:
        """Depth of the deepest point inside the camera's mount, m; 0 when all are outside."""
        points = self.points(angles_rad)
        inside = np.minimum(points - self._low, self._high - points).min(axis=1)
        return float(max(inside.max(), 0.0))

    def lowest_m(self, angles_rad: Mapping[str, float]) -> float:
        return float(self.points(angles_rad)[:, 2].min())


def _surface(part: Part) -> FloatArray:
    """Points on a part's surface at most `STEP_M` apart, in its link's frame."""
    if part.shape == "box":
        points = _box(part.size_m)
    elif part.shape == "cylinder":
        points = _cylinder(*part.size_m)
    else:
        points = _cylinder(part.size_m[0], 2 * part.size_m[0])
    pose = pose_of(part)
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _box(size_m: tuple[float, ...]) -> FloatArray:
    axes = [np.linspace(-size / 2, size / 2, max(2, round(size / STEP_M) + 1)) for size in size_m]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    on_face = (np.abs(np.abs(grid) - np.array(size_m) / 2) < 1e-9).any(axis=1)
    return np.asarray(grid[on_face])


def _cylinder(radius_m: float, height_m: float) -> FloatArray:
    around = np.linspace(0, 2 * np.pi, max(8, round(2 * np.pi * radius_m / STEP_M)), endpoint=False)
    along = np.linspace(-height_m / 2, height_m / 2, max(2, round(height_m / STEP_M) + 1))
    angle, z = (values.ravel() for values in np.meshgrid(around, along))
    return np.column_stack([radius_m * np.cos(angle), radius_m * np.sin(angle), z])
