"""The scene in PyBullet: floor, objects and obstacles, their poses and movements."""

from __future__ import annotations

from itertools import pairwise
from math import cos, sin

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.units import Vec3
from sim.bullet import Bullet
from sim.render.interface import Visual
from sim.rigid import rotations
from sim.scene import Obstacle, Scene, SceneObject

FLOOR = "floor"
CAN_FRICTION = 0.9
CAN_SPINNING_M = 0.01
ROLLING_M = 0.0005
BALL_ROLLING_M = 0.002
"""Keeps a ball at rest on a level floor."""


class Stage:
    """Floor, objects and obstacles. Names: 'floor', an object's label, 'obstacle_1' and so on."""

    def __init__(self, bullet: Bullet, scene: Scene) -> None:
        self._bullet = bullet
        self._movers: list[tuple[int, Mover]] = []
        self.labels: list[str] = []
        """Objects first, then obstacles, in the order of `visuals`."""
        self.bodies: dict[str, int] = {
            FLOOR: bullet.createMultiBody(0.0, bullet.createCollisionShape(bullet.GEOM_PLANE))
        }
        bullet.changeDynamics(self.bodies[FLOOR], -1, lateralFriction=1.0, restitution=0.0)
        self.visuals: list[Visual] = []
        for item in scene.objects:
            self._add(item.label, item, scene, 0.0, 0.0 if item.kinematic else item.mass_kg)
            if item.path_m:
                points = [
                    scene.to_world(_with_height(point, item.centre_m[2])) for point in (item.position_m, *item.path_m)
                ]
                self._movers.append((self.bodies[item.label], Mover(points, item.speed_mps, item.path_loop)))
        for number, obstacle in enumerate(scene.obstacles, 1):
            self._add(f"obstacle_{number}", obstacle, scene, obstacle.yaw_rad, 0.0)
        self.object_count = len(scene.objects)

    def move(self, time_s: float, dt_s: float) -> None:
        """Place the objects that move by themselves for `time_s`, with the velocity that takes them along for
        `dt_s`."""
        for body, mover in self._movers:
            here, there = mover.at(time_s), mover.at(time_s + dt_s)
            self._bullet.resetBasePositionAndOrientation(body, here, (0.0, 0.0, 0.0, 1.0))
            self._bullet.resetBaseVelocity(body, (there - here) / dt_s, (0.0, 0.0, 0.0))

    def pose(self, label: str) -> tuple[Vec3, tuple[float, float, float, float]]:
        """World position of the centre, m, and orientation (x, y, z, w)."""
        position, orientation = self._bullet.getBasePositionAndOrientation(self.bodies[label])
        return position, orientation

    def poses(self) -> FloatArray:
        """World poses of all bodies except the floor, (n, 4, 4), in the order of `visuals`."""
        poses = np.zeros((len(self.labels), 4, 4))
        poses[:, 3, 3] = 1.0
        if self.labels:
            placed = [self.pose(label) for label in self.labels]
            poses[:, :3, 3] = [position for position, _ in placed]
            poses[:, :3, :3] = rotations(np.array([orientation for _, orientation in placed]))
        return poses

    def _add(self, label: str, item: SceneObject | Obstacle, scene: Scene, yaw_rad: float, mass_kg: float) -> None:
        bullet, sizes = self._bullet, item.dimensions_m
        if item.shape == "box":
            shape = bullet.createCollisionShape(bullet.GEOM_BOX, halfExtents=[size / 2 for size in sizes])
        elif item.shape == "cylinder":
            shape = bullet.createCollisionShape(bullet.GEOM_CYLINDER, radius=sizes[0], height=sizes[1])
        else:
            shape = bullet.createCollisionShape(bullet.GEOM_SPHERE, radius=sizes[0])
        half_turn = (scene.robot.yaw_rad + yaw_rad) / 2
        body = bullet.createMultiBody(
            mass_kg,
            shape,
            -1,
            scene.to_world(item.centre_m),
            (0.0, 0.0, sin(half_turn), cos(half_turn)),
        )
        bullet.changeDynamics(
            body,
            -1,
            lateralFriction=CAN_FRICTION,
            spinningFriction=CAN_SPINNING_M,
            rollingFriction=BALL_ROLLING_M if item.shape == "sphere" else ROLLING_M,
            restitution=0.0,
        )
        self.bodies[label] = body
        self.labels.append(label)
        self.visuals.append(Visual(label, item.shape, sizes, item.colour))


class Mover:
    """A point that moves along waypoints at a constant speed."""

    def __init__(self, points: list[Vec3], speed_mps: float, loop: bool) -> None:
        corners = [np.array(point) for point in points]
        if loop:
            corners.append(corners[0])
        self._legs: list[tuple[float, FloatArray, FloatArray]] = []
        start_s = 0.0
        for one, other in pairwise(corners):
            length_m = float(np.linalg.norm(other - one))
            if length_m > 0.0:
                self._legs.append((start_s, one, (other - one) / length_m * speed_mps))
                start_s += length_m / speed_mps
        self._end_s = start_s
        self._last = corners[-1]
        self._loop = loop

    def at(self, time_s: float) -> FloatArray:
        """World position at `time_s`, (3,), m."""
        if self._loop and self._end_s:
            time_s %= self._end_s
        if time_s >= self._end_s:
            return self._last
        start_s, origin, velocity = next(leg for leg in reversed(self._legs) if leg[0] <= time_s)
        return origin + velocity * (time_s - start_s)


def _with_height(place: tuple[float, ...], height_m: float) -> Vec3:
    return place[0], place[1], place[2] if len(place) == 3 else height_m
