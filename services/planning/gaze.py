"""Where the camera looks, and what turns it: a neck, or the base of a robot whose camera is fixed on its body.

A direction is (pan, tilt), rad, up and to the left positive. A neck's is against the body. A base that serves as the
neck turns the body itself, so its pan is the heading of the camera in the odometry frame.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from math import asin, atan2, cos, inf, pi, sin, tan
from typing import Protocol

import numpy as np
from msgspec.structs import replace

from cocoro.arrays import BoolArray, FloatArray
from cocoro.frames import Pose2, wrap_rad
from cocoro.messages import BaseCommand, Motion
from cocoro.robot import Robot
from cocoro.units import Vec3
from services.planning.arm import ArmStep
from services.planning.config import HeadConfig
from services.planning.head import Aim, Sweep, behind_mount, glances, neck_glances, neck_sweep, round_sweep

_THERE_RAD = 0.05
_STILL_RADPS = 0.1
"""A base that turns more slowly shows no more blur than a head at rest."""

Direction = tuple[float, float]
Hull = tuple[FloatArray, FloatArray]
"""Centres (n, 3), body frame, m, and radii (n,), m, of balls."""


class Here(Protocol):
    """The robot's state in one step, and what it can do on the spot."""

    @property
    def angles(self) -> Mapping[str, float]:
        """Of all joints, rad."""

    @property
    def body(self) -> Pose2: ...

    @property
    def turning_radps(self) -> float:
        """Rate at which the base turns; infinite while that is not known."""

    def stand(self) -> BaseCommand: ...

    def still(self) -> ArmStep: ...

    @property
    def folded(self) -> bool:
        """Whether the arm is folded."""

    def fold(self) -> ArmStep:
        """A step of folding the arm."""

    def turn(self, left_rad: float, most_radps: float) -> BaseCommand:
        """Turn on the spot by the rest of an angle, at most so fast."""


class Gaze(Protocol):
    """What the planner knows of its camera's direction, and how it changes it."""

    joints: tuple[str, ...]
    """The joints that it commands, pan and tilt."""
    limits_rad: tuple[tuple[float, float], tuple[float, float]]
    """Of pan and tilt."""
    nearest_m: float
    """Nearer floor cannot be seen from a place, however the camera is turned there."""
    farthest_m: float
    hidden_by: str
    """What may hide floor that could be seen if the robot stood otherwise."""

    def on_body(self, angles: Mapping[str, float]) -> Direction:
        """How the camera is turned against the body, by the angles of all joints, rad."""

    def direction(self, angles: Mapping[str, float], body: Pose2) -> Direction:
        """Where the camera looks."""

    def at(self, point_m: Vec3, others_m: Sequence[Vec3], angles: Mapping[str, float], body: Pose2) -> Direction:
        """The direction, within the limits, for a picture that shows a point, body frame, m, and the first of the
        others that is near enough to it."""

    def shows(self, point_m: Vec3) -> bool:
        """Whether the camera can be turned, while the body stands as it does, so that a point, body frame, m, is in
        the picture."""

    def hides(self, bearing_rad: FloatArray, distance_m: FloatArray) -> BoolArray:
        """Mark the places on the floor, by bearing, rad, and distance, m, each (n,), body frame, that it cannot see
        from here; returns shape (n,)."""

    def hidden(self, centre_m: Vec3, half_m: tuple[float, float], hull: Callable[[], Hull]) -> bool:
        """Whether the robot's own arm may hide a part of a thing, body frame, m, with this half of its width and of its
        height. `hull()`: the arm's centres, (n, 3), body frame, m, and radii, (n,), m."""

    def reached(self, aim: Direction, here: Here) -> bool:
        """Whether the camera rests at a direction."""

    def sweep(self, here: Here) -> Sweep:
        """Aims that show the whole surroundings."""

    def glances(self, floor: FloatArray, here: Here) -> list[Aim]:
        """The way over parts of the floor: bearings, rad, and distances, m, of places (n, 2), body frame."""

    def turn(self, aim: Aim | None, here: Here) -> BaseCommand:
        """What the base does while the robot stands to look. None: it stays as it is."""

    def arm(self, here: Here) -> ArmStep:
        """What the arm does meanwhile, where it has nothing else to do."""

    def steered(self, motion: Motion) -> tuple[Motion, str]:
        """An operator's motion as this body can carry it out, and what it cannot, a sentence."""


def gaze_of(robot: Robot, config: HeadConfig) -> Gaze:
    """The gaze of a robot."""
    return Neck(robot, config) if robot.head is not None else BaseAsNeck(robot, config)


class Neck:
    """Pan and tilt joints turn the camera, whatever the base does."""

    def __init__(self, robot: Robot, config: HeadConfig) -> None:
        self._robot, self._config = robot, config
        self._chain = robot.camera_chain
        self.joints = self._pan, self._tilt = robot.head_joints
        self.limits_rad = robot.joints[self._pan].limits_rad, config.tilt_range_rad
        self.nearest_m, self.farthest_m = 0.0, inf
        self.hidden_by = "the camera's mount"
        self._half_view = _half_view_rad(robot, config)

    def on_body(self, angles: Mapping[str, float]) -> Direction:
        return angles[self._pan], angles[self._tilt]

    def direction(self, angles: Mapping[str, float], body: Pose2) -> Direction:
        return self.on_body(angles)

    def at_one(self, point_m: Vec3, start: Mapping[str, float]) -> Direction:
        """(pan, tilt), rad, within the limits, that bring a point (x, y, z), body frame, m, into the image's centre.

        Newton's method from the angles in `start` (derived): the neck's axes are nearly those of the image, so each
        angle is corrected by its own image angle.
        """
        pan, tilt = start.get(self._pan, 0.0), start.get(self._tilt, 0.0)
        point = np.array([*point_m, 1.0])
        (pan_min, pan_max), (tilt_min, tilt_max) = self.limits_rad
        for _ in range(5):
            pose = self._chain.pose(self._robot.head_angles(pan, tilt))
            x, y, z = pose[:3, :3].T @ (point[:3] - pose[:3, 3])
            if z < 1e-3:
                # Behind the camera: first turn by the bearing, with a level camera.
                pan, tilt = pan + atan2(-x, z), 0.0
                continue
            pan -= atan2(x, z * max(cos(tilt), 0.2))
            tilt -= atan2(y, z)
            tilt = min(max(tilt, tilt_min), tilt_max)
        pan = (pan + np.pi) % (2 * np.pi) - np.pi
        return float(min(max(pan, pan_min), pan_max)), float(min(max(tilt, tilt_min), tilt_max))

    def at(self, point_m: Vec3, others_m: Sequence[Vec3], angles: Mapping[str, float], body: Pose2) -> Direction:
        aim = self.at_one(point_m, angles)
        for other_m in others_m:
            other = self.at_one(other_m, angles)
            if all(abs(b - a) / 2 <= half for a, b, half in zip(aim, other, self._half_view, strict=True)):
                return (aim[0] + other[0]) / 2, (aim[1] + other[1]) / 2
        return aim

    def shows(self, point_m: Vec3) -> bool:
        return True

    def hides(self, bearing_rad: FloatArray, distance_m: FloatArray) -> BoolArray:
        low, high = self.limits_rad[0]
        return behind_mount(self._robot, np.clip(bearing_rad, low, high), bearing_rad, distance_m)

    def hidden(self, centre_m: Vec3, half_m: tuple[float, float], hull: Callable[[], Hull]) -> bool:
        return False  # a neck stands beside the arm and looks past it

    def reached(self, aim: Direction, here: Here) -> bool:
        pan, tilt = self.on_body(here.angles)
        return abs(aim[0] - pan) <= _THERE_RAD and abs(aim[1] - tilt) <= _THERE_RAD

    def sweep(self, here: Here) -> Sweep:
        return neck_sweep(self._config, self.on_body(here.angles)[0])

    def glances(self, floor: FloatArray, here: Here) -> list[Aim]:
        return neck_glances(self._config, self.on_body(here.angles)[0], floor)

    def turn(self, aim: Aim | None, here: Here) -> BaseCommand:
        return here.stand()

    def arm(self, here: Here) -> ArmStep:
        return here.still()

    def steered(self, motion: Motion) -> tuple[Motion, str]:
        return motion, ""


class BaseAsNeck:
    """The camera is fixed on the body, which turns to look about. It does so only where a behaviour stands to look,
    with the arm folded: then the round body needs no more room than it stands on."""

    joints: tuple[str, ...] = ()

    def __init__(self, robot: Robot, config: HeadConfig) -> None:
        self._robot, self._config = robot, config
        pose = robot.camera_chain.pose({})
        self._into_camera = np.linalg.inv(pose)
        x, y, self._up_m = pose[:3, 3].tolist()
        self._place = pose[:3, 3]
        along = pose[:3, 2]
        self._on_body = atan2(along[1], along[0]), asin(min(max(float(along[2]), -1.0), 1.0))
        self._ahead_m = x * cos(self._on_body[0]) + y * sin(self._on_body[0])
        self.limits_rad = (-pi, pi), (self._on_body[1], self._on_body[1])
        self._half_view = _half_view_rad(robot, config)
        self.nearest_m, self.farthest_m = self._floor_m()
        self.hidden_by = "the robot itself"

    def _floor_m(self) -> tuple[float, float]:
        """Distances from the body's centre between which the picture's middle column shows the floor."""
        tilt, half = self._on_body[1], self._half_view[1]
        if half <= tilt:
            return inf, inf  # it looks above the floor
        reach = self._robot.eye.min_range_m
        near_m = max(self._up_m / tan(min(half - tilt, pi / 2)), max(reach**2 - self._up_m**2, 0.0) ** 0.5)
        far_m = self._up_m / tan(-tilt - half) if -tilt - half > 0.0 else inf
        return self._ahead_m + near_m, self._ahead_m + far_m

    def on_body(self, angles: Mapping[str, float]) -> Direction:
        return self._on_body

    def direction(self, angles: Mapping[str, float], body: Pose2) -> Direction:
        return wrap_rad(body.yaw_rad + self._on_body[0]), self._on_body[1]

    def at(self, point_m: Vec3, others_m: Sequence[Vec3], angles: Mapping[str, float], body: Pose2) -> Direction:
        return wrap_rad(body.yaw_rad + atan2(point_m[1], point_m[0])), self._on_body[1]

    def shows(self, point_m: Vec3) -> bool:
        x, y, z, _ = self._into_camera @ np.array([*point_m, 1.0])
        wide, high = self._half_view
        return bool(z > 0.0 and abs(atan2(x, z)) <= wide and abs(atan2(y, z)) <= high)

    def hides(self, bearing_rad: FloatArray, distance_m: FloatArray) -> BoolArray:
        ahead = np.full(len(bearing_rad), self._on_body[0])  # it turns there together with its mount
        beyond = (distance_m < self.nearest_m) | (distance_m > self.farthest_m)
        return np.asarray(beyond | behind_mount(self._robot, ahead, ahead, distance_m))

    def hidden(self, centre_m: Vec3, half_m: tuple[float, float], hull: Callable[[], Hull]) -> bool:
        (centres, radii), (wide_m, high_m) = hull(), half_m
        for up_m in (-high_m, 0.0, high_m):
            way = np.array([*centre_m[:2], centre_m[2] + up_m]) - self._place
            along = np.clip((centres - self._place) @ way / (way @ way), 0.0, 1.0)
            off_m = np.linalg.norm(centres - self._place - along[:, None] * way, axis=1)
            if (off_m < radii + wide_m).any():
                return True
        return False

    def reached(self, aim: Direction, here: Here) -> bool:
        pan, _ = self.direction(here.angles, here.body)
        return abs(here.turning_radps) < _STILL_RADPS and abs(wrap_rad(aim[0] - pan)) <= _THERE_RAD

    def sweep(self, here: Here) -> Sweep:
        return round_sweep(self._config, *self.direction(here.angles, here.body))

    def glances(self, floor: FloatArray, here: Here) -> list[Aim]:
        pan, tilt = self.direction(here.angles, here.body)
        way = glances(self._config, self._on_body[0], [(tilt, floor)], pi)
        return [aim._replace(pan_rad=aim.pan_rad + pan - self._on_body[0]) for aim in way]

    def turn(self, aim: Aim | None, here: Here) -> BaseCommand:
        if aim is None or not here.folded:
            return here.stand()
        left_rad = wrap_rad(aim[0] - self.direction(here.angles, here.body)[0])
        return here.turn(left_rad, min(aim[2], self._config.body_turn_radps))

    def arm(self, here: Here) -> ArmStep:
        return here.fold()

    def steered(self, motion: Motion) -> tuple[Motion, str]:
        why_not = "the camera is fixed on the body: it cannot be tilted" if motion.tilt_radps else ""
        turn = motion.turn_radps + motion.pan_radps
        return replace(motion, turn_radps=turn, pan_radps=0.0, tilt_radps=0.0), why_not


def _half_view_rad(robot: Robot, config: HeadConfig) -> tuple[float, float]:
    """Half of the picture's width and height, without its edge."""
    kinect, margin = robot.eye, config.view_margin_rad
    return kinect.horizontal_fov_rad / 2 - margin, kinect.vertical_fov_rad / 2 - margin
