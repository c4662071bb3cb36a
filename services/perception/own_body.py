"""Where the robot sees itself: the part of the picture that its parked arm, and what stands on its body, take up."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import cos, radians, sin

import cv2
import numpy as np

from cocoro.arrays import BoolArray, FloatArray
from cocoro.description import Part
from cocoro.robot import Camera, Robot

_AROUND = np.ones((3, 3), dtype=np.uint8)
_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
_JAW_ANGLES = 5
_ALONG = (0.0, 0.7, 1.4)
"""Places along a finger, in lengths of its pad."""
_LEAST_M = 0.02


def own_picture(robot: Robot, camera: Camera, angles_rad: Mapping[str, float]) -> BoolArray:
    """The pixels of the camera, (height, width), that show the robot itself at these angles of its joints, by name, and
    a pixel around them. The jaws may be anywhere; joints that are not named are at 0."""
    angles = dict.fromkeys(robot.joints, 0.0) | dict(angles_rad)
    into = np.linalg.inv(robot.camera_chain.pose(angles))
    mask = np.zeros((camera.height, camera.width), dtype=np.uint8)
    for points in _bodies(robot, angles):
        x, y, z = into[:3, :3] @ points.T + into[:3, 3:]
        if (z < _LEAST_M).all():
            continue
        z = np.maximum(z, _LEAST_M)  # what reaches behind the camera is drawn as if it began there
        pixels = np.stack([camera.cx + camera.fx * x / z, camera.cy + camera.fy * y / z], axis=1)
        outline = cv2.convexHull(np.clip(np.rint(pixels), -1e4, 1e4).astype(np.int32))
        cv2.fillConvexPoly(mask, outline, (1,))
    return np.asarray(cv2.dilate(mask, _AROUND), dtype=np.bool_)


def _bodies(robot: Robot, angles: Mapping[str, float]) -> Iterator[FloatArray]:
    """Points (n, 3), body frame, m, around each part of the robot except what carries the camera."""
    for part in robot.solid.part:
        if part.link != robot.eye.link:
            pose = np.eye(4) if part.link == "body" else robot.chain(part.link).pose(angles)
            yield (np.array(part.position_m) + _CORNERS * _sides(part)) @ pose[:3, :3].T + pose[:3, 3]
    lengths = robot.claw.pad_length_m * np.array(_ALONG)[:, None]
    swings = {jaw: np.linspace(*robot.joints[jaw].limits_rad, _JAW_ANGLES) for jaw in robot.jaws}
    for link, turn_deg in robot.hull.finger_turn_deg.items():
        along = lengths * np.array([cos(radians(turn_deg)), sin(radians(turn_deg)), 0.0])
        points = []
        for number in range(_JAW_ANGLES):
            pose = robot.chain(link).pose(dict(angles) | {jaw: float(at[number]) for jaw, at in swings.items()})
            points.append(along @ pose[:3, :3].T + pose[:3, 3])
        middle = np.concatenate(points)
        yield np.concatenate([middle + corner * 2 * robot.hull.finger_radius_m for corner in _CORNERS])


def _sides(part: Part) -> FloatArray:
    """The sides of the box around a part, in its link's axes, m, (3,)."""
    if part.shape == "box":
        return np.array(part.size_m)
    if part.shape == "sphere":
        return np.full(3, 2 * part.size_m[0])
    radius_m, height_m = part.size_m
    sides = np.full(3, 2 * radius_m)
    sides["xyz".index(part.axis)] = height_m
    return sides
