"""Reaching: the hand moves in cylindrical coordinates about the arm base's axis by the damped pseudo-inverse of the
Jacobian (Nakamura and Hanafusa 1986), within the joint limits. It is the paper's 'Motor planning for reaching' with the
Jacobian of the model in use."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import asin, atan2, cos, hypot, sin
from typing import NamedTuple, Protocol

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.frames import wrap_rad
from cocoro.robot import Robot


class HandPose(NamedTuple):
    """Position of the pads' centre and pitch of the hand, about the arm base's vertical axis."""

    radius_m: float
    azimuth_rad: float
    """Body frame: 0 is straight ahead."""
    height_m: float
    """Above the floor."""
    pitch_rad: float
    """Pitch of the hand's axis, up positive."""

    def towards(self, goal: HandPose, step_m: float, step_rad: float) -> HandPose:
        """A pose nearer to the goal: no coordinate moves further than its step, and all arrive together."""
        gaps = [g - v for g, v in zip(goal, self, strict=True)]
        gaps[1] = wrap_rad(gaps[1])
        scale = max(
            1.0,
            hypot(gaps[0], gaps[2]) / step_m,
            abs(gaps[1]) * max(self.radius_m, 0.1) / step_m,
            abs(gaps[3]) / step_rad,
        )
        return HandPose(*(v + gap / scale for v, gap in zip(self, gaps, strict=True)))


class HandModel(Protocol):
    """Kinematics of the pads' centre, nominal or learned. Angles are by joint, rad."""

    def pose(self, angles: Mapping[str, float]) -> FloatArray:
        """Transform (4, 4) from the hand's frame to the body frame, metres."""

    def position(self, angles: Mapping[str, float]) -> FloatArray:
        """Position (3,), body frame, metres."""

    def jacobian(self, angles: Mapping[str, float], joints: Iterable[str]) -> FloatArray:
        """Jacobian (6, n), as `Chain.jacobian`: m/rad and rad/rad."""


class Reacher:
    """Forward and inverse kinematics of the hand, nominal or learned."""

    def __init__(self, robot: Robot, damping: float) -> None:
        self.joints = robot.arm.joints
        self._rigid = robot.chain(robot.arm.tip)
        self._pad: HandModel = self._rigid
        self.azimuth = robot.arm.azimuth
        self._axis = robot.chain(robot.link_of(self.azimuth)).position({self.azimuth: 0.0})
        self.upright = robot.poses["upright"] | {robot.arm.roll: robot.claw.level_roll_rad}
        """Angles, rad, with the hand in front of the robot: the start of iterations, which stay in that family."""
        self._limits = np.array([robot.joints[name].limits_rad for name in self.joints])
        self._damping = damping * damping * np.eye(4)

    def use(self, hand: HandModel | None) -> None:
        """Reach with this model; None is the nominal one."""
        self._pad = hand if hand is not None else self._rigid

    def position(self, angles: Mapping[str, float]) -> FloatArray:
        """Position (3,) of the pads' centre, body frame, metres."""
        return self._pad.position(angles)

    def pose(self, angles: Mapping[str, float]) -> HandPose:
        transform = self._pad.pose(angles)
        x, y, z = transform[:3, 3] - self._axis * [1, 1, 0]
        return HandPose(hypot(x, y), atan2(y, x), float(z), asin(min(max(float(transform[2, 2]), -1.0), 1.0)))

    def point(self, pose: HandPose) -> FloatArray:
        """Position (3,) of a hand pose, body frame, metres."""
        return np.array(
            [
                self._axis[0] + pose.radius_m * cos(pose.azimuth_rad),
                self._axis[1] + pose.radius_m * sin(pose.azimuth_rad),
                pose.height_m,
            ]
        )

    def seen_from_arm(self, point_m: tuple[float, float, float]) -> tuple[float, float, float]:
        """(radius_m, azimuth_rad, height_m) about the arm base's axis of a point (x, y, z), body frame, metres."""
        x, y = point_m[0] - self._axis[0], point_m[1] - self._axis[1]
        return hypot(x, y), atan2(y, x), point_m[2]

    def step(self, angles: Mapping[str, float], pose: HandPose) -> FloatArray:
        """Angles (n,), rad, of the arm's joints in their order, one step nearer to a hand pose; of more joints than
        four the change is the smallest.

        A joint that a step would carry over its limit is put on the limit and the others are solved again.
        """
        transform = self._pad.pose(angles)
        jac6 = self._pad.jacobian(angles, self.joints)
        along = transform[:3, 2]
        level = max(float(np.sqrt(max(1.0 - along[2] ** 2, 0.0))), 0.1)
        pitch_row = (jac6[3] * along[1] - jac6[4] * along[0]) / level  # how its axis, turned by a joint, rises
        jac = np.vstack([jac6[:3], 0.2 * pitch_row])
        error = np.empty(4)
        error[:3] = self.point(pose) - transform[:3, 3]
        # A radian of pitch weighs as much as 0.2 m of position.
        error[3] = 0.2 * (pose.pitch_rad - asin(min(max(float(along[2]), -1.0), 1.0)))
        start = np.array([angles[name] for name in self.joints])
        free = np.ones(len(start), dtype=bool)
        change = np.zeros(len(start))
        for _ in start:
            part = jac[:, free]
            rest = error - jac[:, ~free] @ change[~free]
            change[free] = part.T @ np.linalg.solve(part @ part.T + self._damping, rest)
            goal = start + change
            over = free & ((goal < self._limits[:, 0]) | (goal > self._limits[:, 1]))
            if not over.any():
                break
            change[over] = np.clip(goal[over], self._limits[over, 0], self._limits[over, 1]) - start[over]
            free &= ~over
        return start + change

    def solve(self, angles: Mapping[str, float], pose: HandPose) -> dict[str, float] | None:
        """Joint angles, rad, for a hand pose, iterated from `angles`; None if it is out of reach (5 mm, 3 degrees)."""
        trial = dict(angles)
        for _ in range(60):
            trial.update(zip(self.joints, self.step(trial, pose).tolist(), strict=True))
            have = self.pose(trial)
            off_m = float(np.linalg.norm(self.point(have) - self.point(pose)))
            if off_m < 0.002 and abs(have.pitch_rad - pose.pitch_rad) < 0.02:
                return {name: trial[name] for name in self.joints}
        if off_m < 0.005 and abs(have.pitch_rad - pose.pitch_rad) < 0.05:
            return {name: trial[name] for name in self.joints}
        return None
