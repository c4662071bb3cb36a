"""An operator of the simulated robot in tests: commands, arm angles by least squares, a complete grasp."""

from __future__ import annotations

from collections.abc import Mapping
from math import asin, atan2, cos, pi, radians

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.joints import GROUPS
from cocoro.messages import ServoCommand, TrueObject, Truth
from cocoro.robot import Robot
from sim.judge import Judge
from sim.scene import Obstacle, Scene, SceneObject
from sim.world import World

ROBOT = Robot.load()
EMPTY = Scene(name="empty")
ARM = ("arm_base", "shoulder", "elbow", "wrist_pitch")
LEVEL = {"wrist_roll": pi / 2}
OPEN = {"claw_left": -radians(20), "claw_right": radians(20)}
SHUT = {"claw_left": radians(15), "claw_right": -radians(15)}
READY = {"arm_base": 0.0, "shoulder": 1.2, "elbow": -1.8, "wrist_pitch": 0.5}
"""A posture above the floor in front of the robot, where the search for arm angles starts."""
COMMAND_EVERY = 5


class Operator:
    """Commands a world at 48 Hz and feeds a judge."""

    def __init__(self, world: World, judge: Judge | None = None) -> None:
        self.world = world
        self.judge = judge
        self.seen: set[str] = set()
        """The collisions so far."""
        world.set_latch("released")

    def run(
        self,
        seconds: float,
        *,
        arm: Mapping[str, float] | None = None,
        hand: Mapping[str, float] | None = None,
        wheels_mps: tuple[float, float] | None = None,
        speed_radps: float = 1.5,
    ) -> None:
        for step in range(round(seconds * 240)):
            if step % COMMAND_EVERY == 0:
                for name, goals in zip(GROUPS, (arm, hand), strict=True):
                    if goals:
                        self.world.command_servos(
                            name,
                            ServoCommand(
                                joints=tuple(goals),
                                goal_rad=tuple(goals.values()),
                                speed_radps=(speed_radps,) * len(goals),
                            ),
                        )
                if wheels_mps:
                    self.world.command_base(self.world.robot.drive.command_of(wheels_mps))
            self.world.step()
            if step % 8 == 7:
                truth = self.world.truth()
                self.seen.update(truth.collisions)
                if self.judge:
                    self.judge.feed(truth)

    def reach(
        self, start_m: FloatArray, end_m: FloatArray, pitch_rad: float, seconds: float, arm: Mapping[str, float]
    ) -> dict[str, float]:
        """Move the pad centre along a line; returns the arm's angles at its end."""
        angles = dict(arm)
        points = 8
        for point in range(1, points + 1):
            angles = arm_angles(start_m + (end_m - start_m) * point / points, pitch_rad, angles)
            self.run(seconds / points, arm=angles)
        return angles


def arm_angles(target_m: FloatArray, pitch_rad: float, start: Mapping[str, float]) -> dict[str, float]:
    """Damped least squares: arm angles that bring the pad centre to a point of the body frame, the roll axis
    pitched by this angle (up positive), the claws level."""
    chain = ROBOT.chain("pad_centre")
    angles = {**start, **LEVEL}
    for _ in range(100):
        pose = chain.pose(angles)
        axis, pitch = pose[:3, 2], asin(pose[2, 2])
        error = np.append(target_m - pose[:3, 3], 0.3 * (pitch_rad - pitch))
        if np.linalg.norm(error) < 1e-5:
            return {joint: angles[joint] for joint in ARM}
        jacobian = chain.jacobian(angles, ARM)
        turn = np.cross(jacobian[3:].T, axis)[:, 2] / cos(pitch)
        rows = np.vstack([jacobian[:3], 0.3 * turn])
        move = rows.T @ np.linalg.solve(rows @ rows.T + 1e-5 * np.eye(4), error)
        move *= min(1.0, 0.2 / float(np.abs(move).max()))
        for joint, by in zip(ARM, move, strict=True):
            low, high = ROBOT.joints[joint].limits_rad
            angles[joint] = min(max(angles[joint] + float(by), low), high)
    raise AssertionError(f"no arm angles for {target_m}")


def can(x_m: float, y_m: float, mass_kg: float = 0.2) -> SceneObject:
    return SceneObject(
        label="red_can", shape="cylinder", radius_m=0.033, height_m=0.12, position_m=(x_m, y_m), mass_kg=mass_kg
    )


def scene_with(*objects: SceneObject, obstacles: tuple[Obstacle, ...] = ()) -> Scene:
    return Scene(name="test", objects=objects, obstacles=obstacles)


def the_can(world: World) -> TrueObject:
    return world.truth().objects[0]


def yaw_of(truth: Truth) -> float:
    return 2.0 * atan2(truth.body_orientation[2], truth.body_orientation[3])


def grasp_and_lift(
    world: World, at_m: tuple[float, float], pitch_rad: float, judge: Judge, height_m: float = 0.06
) -> Operator:
    """Open the hand, reach along the ground to `at_m`, close, lift to 0.25 m and wait 3 s."""
    x, y = at_m
    operator = Operator(world, judge)
    before, there, high = (
        np.array(point) for point in ([x - 0.09, y, height_m + 0.005], [x, y, height_m], [x - 0.1, y, 0.25])
    )
    above = before + np.array([0.02, 0.0, 0.14])
    angles = arm_angles(above, pitch_rad, READY)
    operator.run(2.5, arm=angles, hand={**LEVEL, **OPEN})
    angles = operator.reach(above, before, pitch_rad, 1.0, angles)
    angles = operator.reach(before, there, pitch_rad, 1.5, angles)
    operator.run(0.3, arm=angles)
    operator.run(1.0, hand=SHUT)
    angles = operator.reach(there, high, pitch_rad, 2.0, angles)
    operator.run(3.0, arm=angles)
    return operator
