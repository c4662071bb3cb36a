"""The robot's body in PyBullet: its motors, its joints and where its links are."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from math import cos, sin
from pathlib import Path
from typing import NamedTuple

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.robot import Robot
from cocoro.units import Quaternion, Vec3
from sim.body import CHASSIS
from sim.bullet import Bullet
from sim.model import WHEELS, RobotModel, write_urdf
from sim.rigid import rotation, rotations
from sim.scene import Start
from sim.servos import Drive

WHEEL_TORQUE_NM = 1.0
"""At the rim 33 N a wheel: a third of the robot's weight. Ours; the maker gives none."""
WHEEL_LAG_RAD = 0.05
"""A blocked wheel is not wound up further behind its goal than this."""
REST_LAG_RAD = 0.0005
"""A wheel that is to stand, but is blocked before its goal, gives up what is more than this: it does not go on
pressing against what stopped it. Enough against creep."""
WHEEL_GAIN = 0.2
"""Share of a wheel's lag that is made up for in one step."""


class JointReading(NamedTuple):
    angle_rad: float
    speed_radps: float
    torque_nm: float


class Mechanism:
    """Loads the robot with its wheels on the floor at the start pose, the servos at the given angles."""

    def __init__(
        self, bullet: Bullet, robot: Robot, model: RobotModel, start: Start, angles_rad: Mapping[str, float]
    ) -> None:
        self._bullet = bullet
        half_turn = start.yaw_rad / 2
        with tempfile.TemporaryDirectory(prefix="cocoro-") as folder:
            self.body: int = bullet.loadURDF(
                str(write_urdf(model, Path(folder))),
                (*start.position_m, 0.0),
                (0.0, 0.0, sin(half_turn), cos(half_turn)),
                flags=bullet.URDF_USE_INERTIA_FROM_FILE
                | bullet.URDF_USE_IMPLICIT_CYLINDER
                | bullet.URDF_USE_SELF_COLLISION,
            )
        infos = [bullet.getJointInfo(self.body, i) for i in range(bullet.getNumJoints(self.body))]
        self.index: dict[str, int] = {CHASSIS: -1} | {info[12].decode(): info[0] for info in infos}
        self.link_names: dict[int, str] = {index: name for name, index in self.index.items()}
        self.joints = tuple(robot.joints)
        """The order of `read()`'s servo joints."""
        joint_of_link = {link.name: link.joint for link in robot.links.values() if link.joint}
        link_of_joint = {joint: link for link, joint in joint_of_link.items()}
        self._motors = {joint: self.index[link_of_joint[joint]] for joint in self.joints}
        self._wheels = tuple(self.index[wheel] for wheel in WHEELS)
        self._wheel_rad = [0.0, 0.0]
        self._wheel_goal_rad = [0.0, 0.0]
        self._read_indices = [*self._motors.values(), *self._wheels]
        # PyBullet tells the root's pose at its centre of mass.
        self._root_offset = np.array(bullet.getDynamicsInfo(self.body, -1)[3])
        self._link_indices = list(range(len(infos)))
        self._prepare(model, angles_rad)

    def drive(self, joint: str, drive: Drive) -> None:
        self._bullet.setJointMotorControl2(
            self.body,
            self._motors[joint],
            self._bullet.POSITION_CONTROL,
            targetPosition=drive.target_rad,
            force=drive.max_torque_nm,
            maxVelocity=drive.max_speed_radps,
        )

    def spin(self, left_radps: float, right_radps: float, dt_s: float) -> None:
        """Turn the wheels at these speeds for the next step, as a controller with encoders does: what a wheel
        lags or creeps in one step is made up for in the next."""
        for number, speed_radps in enumerate((left_radps, right_radps)):
            lag = self._wheel_goal_rad[number] - self._wheel_rad[number]
            lag = min(max(lag, -WHEEL_LAG_RAD), WHEEL_LAG_RAD)
            if speed_radps == 0.0 and abs(lag) > REST_LAG_RAD:
                lag *= 0.95
            goal = self._wheel_rad[number] + lag
            self._wheel_goal_rad[number] = goal + speed_radps * dt_s
            self._bullet.setJointMotorControl2(
                self.body,
                self._wheels[number],
                self._bullet.POSITION_CONTROL,
                targetPosition=goal,
                targetVelocity=speed_radps,
                positionGain=WHEEL_GAIN,
                velocityGain=1.0,
                force=WHEEL_TORQUE_NM,
            )

    def read(self) -> list[JointReading]:
        """All servo joints in the order of `joints`, then the left and the right wheel."""
        states = self._bullet.getJointStates(self.body, self._read_indices)
        self._wheel_rad = [state[0] for state in states[-2:]]
        return [JointReading(angle, speed, torque) for angle, speed, _, torque in states]

    def root(self) -> tuple[Vec3, Quaternion]:
        """Origin and orientation of the body frame in the world."""
        pose = self.root_pose()
        x, y, z = (float(value) for value in pose[:3, 3])
        return (x, y, z), self._bullet.getBasePositionAndOrientation(self.body)[1]

    def root_pose(self) -> FloatArray:
        """4 x 4 transform from the body frame to the world."""
        position, orientation = self._bullet.getBasePositionAndOrientation(self.body)
        pose = np.eye(4)
        pose[:3, :3] = rotation(orientation)
        pose[:3, 3] = np.array(position) - pose[:3, :3] @ self._root_offset
        return pose

    def link_poses(self) -> FloatArray:
        """Of every link in the world, shape (links + 1, 4, 4): row i is PyBullet's link i, the last the root."""
        states = self._bullet.getLinkStates(self.body, self._link_indices, computeForwardKinematics=1)
        poses = np.zeros((len(states) + 1, 4, 4))
        poses[:-1, :3, :3] = rotations(np.array([state[5] for state in states]))
        poses[:-1, :3, 3] = [state[4] for state in states]
        poses[:-1, 3, 3] = 1.0
        poses[-1] = self.root_pose()
        return poses

    def _prepare(self, model: RobotModel, angles_rad: Mapping[str, float]) -> None:
        bullet = self._bullet
        for link, friction in model.body.friction.items():
            bullet.changeDynamics(
                self.body,
                self.index[link],
                lateralFriction=friction.lateral,
                spinningFriction=friction.spinning,
                rollingFriction=friction.rolling,
                restitution=0.0,
            )
        bullet.changeDynamics(self.body, -1, linearDamping=0.0, angularDamping=0.0)
        pairs = {frozenset(pair) for pair in model.collision_pairs()}
        for one in model.links:
            for other in model.links:
                if one < other:
                    enabled = int(frozenset((one, other)) in pairs)
                    bullet.setCollisionFilterPair(self.body, self.body, self.index[one], self.index[other], enabled)
        for joint, index in self._motors.items():
            bullet.resetJointState(self.body, index, angles_rad[joint])
            bullet.changeDynamics(self.body, index, jointDamping=0.0)
