"""Where a picture's pixels are: the camera's pose at the picture's stamp, and the body's in the odometry frame."""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.history import History
from cocoro.messages import PlannerStatus, ServoState
from cocoro.robot import Camera, Robot
from cocoro.units import Vec2, Vec3

GAP_NS = NS // 4
"""Two samples that are further apart say nothing of the time between them."""
NEAREST_M = 0.05
"""Nearer to the camera's plane nothing is projected."""
FAR_M = 6.0
"""Further away a place on the floor is not told: a pixel is too large there."""


class Place(NamedTuple):
    """The camera and the body at one time."""

    camera: Camera
    pose: FloatArray
    """Of the camera in the body frame, 4 x 4, m."""
    body: FloatArray | None
    """x, y (m) and yaw (rad) of the body in the odometry frame; None while nobody tells it."""

    def pixel_of_body(self, position_m: Vec3, width: int, height: int) -> tuple[float, float] | None:
        """The pixel of a place in the body frame, in a picture of that size; None when the camera does not see it."""
        in_camera = self.pose[:3, :3].T @ (np.array(position_m) - self.pose[:3, 3])
        if in_camera[2] < NEAREST_M:
            return None
        camera = self.camera.scaled(width, height)
        u = camera.cx + camera.fx * float(in_camera[0] / in_camera[2])
        v = camera.cy + camera.fy * float(in_camera[1] / in_camera[2])
        return (round(u, 1), round(v, 1)) if -0.5 <= u < width - 0.5 and -0.5 <= v < height - 0.5 else None

    def pixel_of_floor(self, position_m: Vec3, width: int, height: int) -> tuple[float, float] | None:
        """The same of a place in the odometry frame."""
        if self.body is None:
            return None
        x, y, yaw = self.body
        ahead, left = position_m[0] - x, position_m[1] - y
        turned = cos(yaw) * ahead + sin(yaw) * left, cos(yaw) * left - sin(yaw) * ahead
        return self.pixel_of_body((*turned, position_m[2]), width, height)

    def floor_at(self, u: float, v: float, width: int, height: int) -> Vec2 | None:
        """The place on the floor that a pixel shows, odometry frame, m; None above the horizon, too far away, or while
        the body's pose is unknown."""
        if self.body is None:
            return None
        ray = self.pose[:3, :3] @ self.camera.scaled(width, height).ray(u, v)
        if ray[2] >= 0.0:
            return None
        ahead, left, _ = (float(each) for each in self.pose[:3, 3] - ray * (self.pose[2, 3] / ray[2]))
        if (ahead * ahead + left * left) ** 0.5 > FAR_M:
            return None
        x, y, yaw = (float(each) for each in self.body)
        return x + cos(yaw) * ahead - sin(yaw) * left, y + sin(yaw) * ahead + cos(yaw) * left


class Sight:
    """Keeps head and body of the last seconds."""

    def __init__(self, robot: Robot) -> None:
        self._camera = robot.camera
        self._chain = robot.camera_chain
        self._head = History(len(self._chain.joints))
        self._body = History(3, angular=(2,))

    def take_joints(self, arm: ServoState) -> None:
        """Take the head's angles out of a servo group's state."""
        angles = dict(zip(arm.joints, arm.position_rad, strict=True))
        if all(joint in angles for joint in self._chain.joints):
            self._head.add(arm.stamp_ns, [angles[joint] for joint in self._chain.joints], arm.incarnation)

    def take_pose(self, plan: PlannerStatus) -> None:
        """Take the body's pose."""
        if plan.body_m is not None:
            self._body.add(plan.stamp_ns, (*plan.body_m, plan.body_yaw_rad), plan.incarnation)

    def at(self, stamp_ns: int) -> Place | None:
        """Camera and body at the stamp; the newest angles and pose that are known when the stamp is later by little.
        None while the head's angles are unknown."""
        angles = _at(self._head, stamp_ns)
        if angles is None:
            return None
        pose = self._chain.pose(dict(zip(self._chain.joints, angles, strict=True)))
        return Place(self._camera, pose, _at(self._body, stamp_ns))


def _at(history: History, stamp_ns: int) -> FloatArray | None:
    newest = history.newest
    if newest is not None and newest[0] <= stamp_ns < newest[0] + GAP_NS:
        return newest[1]
    return history.at(stamp_ns, GAP_NS)
