"""Geometry for viewers: poses of the robot's links, points of a depth image, quaternions."""

from __future__ import annotations

from collections.abc import Mapping
from math import cos, sin

import numpy as np

from cocoro.arrays import Float32Array, FloatArray, ImageArray
from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.kinematics import Tree
from cocoro.messages import BaseState, Frame, ServoState, Truth
from cocoro.robot import Robot
from cocoro.units import Quaternion, Vec3

POINTS_PERIOD_NS = NS // 10
"""Least time between two clouds of points. With one for each frame they would be nine tenths of a viewer's file."""


def quaternion(turn: FloatArray) -> Quaternion:
    """The quaternion x, y, z, w of a rotation matrix, shape (3, 3). Shepperd's method: the largest component comes
    first."""
    xx, yy, zz = turn[0, 0], turn[1, 1], turn[2, 2]
    squares = np.array([1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz, 1 + xx + yy + zz])
    largest = int(np.argmax(squares))
    sums = np.array(
        [
            [squares[0], turn[0, 1] + turn[1, 0], turn[0, 2] + turn[2, 0], turn[2, 1] - turn[1, 2]],
            [turn[0, 1] + turn[1, 0], squares[1], turn[1, 2] + turn[2, 1], turn[0, 2] - turn[2, 0]],
            [turn[0, 2] + turn[2, 0], turn[1, 2] + turn[2, 1], squares[2], turn[1, 0] - turn[0, 1]],
            [turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1], squares[3]],
        ]
    )
    row = sums[largest] / (2 * np.sqrt(squares[largest]))
    return float(row[0]), float(row[1]), float(row[2]), float(row[3])


def about_z(yaw_rad: float) -> Quaternion:
    return 0.0, 0.0, sin(yaw_rad / 2), cos(yaw_rad / 2)


def rotated(by: Quaternion, place: Vec3) -> Vec3:
    """A vector rotated by a quaternion."""
    axis, w = np.array(by[:3]), by[3]
    vector = np.array(place)
    turned = vector + 2 * np.cross(axis, np.cross(axis, vector) + w * vector)
    return float(turned[0]), float(turned[1]), float(turned[2])


def conjugate(turn: Quaternion) -> Quaternion:
    return -turn[0], -turn[1], -turn[2], turn[3]


def in_body(truth: Truth, place_m: Vec3) -> Vec3:
    """A place in the world frame, m, by the simulator's true pose of the body in the body frame, m."""
    x, y, z = (there - here for there, here in zip(place_m, truth.body_m, strict=True))
    return rotated(conjugate(truth.body_orientation), (x, y, z))


class Posture:
    """The robot's last reported pose and joint angles."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.body = Pose2()
        """Pose in the odometry frame."""
        self.angles_rad: dict[str, float] = {}
        self._tree = Tree(robot.links, robot.links)
        self._parents = {name: link.parent for name, link in robot.links.items()}

    def move(self, base: BaseState) -> None:
        self.body = Pose2(*base.odometry_m, base.odometry_yaw_rad)

    def bend(self, servos: ServoState) -> None:
        self.angles_rad.update(zip(servos.joints, servos.position_rad, strict=True))

    def links(self) -> dict[str, FloatArray]:
        """Each link's pose in the body frame, 4 x 4, m; empty until every joint has been reported."""
        if not self.robot.joints.keys() <= self.angles_rad.keys():
            return {}
        return {name: pose for name, pose in self._tree.poses(self.angles_rad).items() if name in self._parents}

    def bones(self, links: Mapping[str, FloatArray]) -> list[tuple[Vec3, Vec3]]:
        """Line from each link's parent to the link, in the body frame, m."""
        found = []
        for name, pose in links.items():
            parent = links.get(self._parents[name])
            start = np.zeros(3) if parent is None else parent[:3, 3]
            found.append((_vec3(start), _vec3(pose[:3, 3])))
        return found


def points(frame: Frame, robot: Robot, step: int) -> tuple[Float32Array, ImageArray]:
    """Points of the depth image, shape (n, 3), m, in the colour camera's frame (x right, y down, z forward), and their
    RGB colours, shape (n, 3); none without depth. Every `step`th row and column is used."""
    if not frame.has_depth:
        return np.zeros((0, 3), dtype=np.float32), np.zeros((0, 3), dtype=np.uint8)
    camera = robot.camera.scaled(frame.width, frame.height)
    raw = np.frombuffer(frame.depth, dtype="<u2").reshape(frame.height, frame.width)[::step, ::step]
    depth = robot.depth_m(raw)
    rows, columns = np.nonzero(np.isfinite(depth))
    z = depth[rows, columns]
    x = (columns * step - np.float32(camera.cx)) * z / np.float32(camera.fx)
    y = (rows * step - np.float32(camera.cy)) * z / np.float32(camera.fy)
    places = np.stack((x, y, z), axis=1).astype(np.float32) + np.array(robot.eye.depth_offset_m, dtype=np.float32)
    u = np.rint(places[:, 0] * camera.fx / places[:, 2] + camera.cx).astype(np.int32)
    v = np.rint(places[:, 1] * camera.fy / places[:, 2] + camera.cy).astype(np.int32)
    seen = (u >= 0) & (u < frame.width) & (v >= 0) & (v < frame.height)
    colour = np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)
    return places[seen], colour[v[seen], u[seen]]


def _vec3(place: FloatArray) -> Vec3:
    return float(place[0]), float(place[1]), float(place[2])
