"""The robot's body in PyBullet: its motors, joints and link poses."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from math import cos, sin
from pathlib import Path

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.robot import Robot
from cocoro.units import Quaternion, Vec3
from sim.body import CHASSIS
from sim.bullet import Bullet
from sim.model import RobotModel, write_urdf
from sim.rigid import rotation, rotations
from sim.scene import Start
from sim.servos import Drive

WHEEL_TORQUE_NM = 1.0
"""Torque of a wheel: 33 N at its rim, a third of the robot's weight. Chosen; the maker publishes none."""
WHEEL_LAG_RAD = 0.05
"""Upper bound for how far a blocked wheel lags behind its goal."""
REST_LAG_RAD = 0.0005
"""Upper bound for the lag of a wheel that is commanded to stand: a blocked wheel then stops pressing against the
obstacle, while the wheel still does not creep."""
WHEEL_GAIN = 0.2
"""Share of a wheel's lag that one step corrects."""
JOINT_GAIN = 0.1
"""Share of a joint's way to its goal that one step covers, within its speed limit; PyBullet's default."""
NO_LIMIT_RADPS = -1.0
"""PyBullet's value for a motor without a speed limit."""

_LEVEL = (0.0, 0.0, 0.0, 1.0)

JointReading = tuple[float, float, float]
"""Angle, rad; speed, rad/s; torque of the motor, N m."""


class Mechanism:
    """The robot, loaded with its wheels on the floor at the start pose and its servos at `angles_rad`."""

    def __init__(
        self, bullet: Bullet, robot: Robot, model: RobotModel, start: Start, angles_rad: Mapping[str, float]
    ) -> None:
        self._bullet = bullet
        self._set_motor = bullet.raw("setJointMotorControl2")
        self._position_control: int = bullet.POSITION_CONTROL
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
        self.joints = tuple(name for name, joint in robot.joints.items() if joint.group is not None)
        """Servo joints that a group commands, in the order of `read()`."""
        joint_of_link = {link.name: link.joint for link in robot.links.values() if link.joint}
        link_of_joint = {joint: link for link, joint in joint_of_link.items()}
        self._motors = {joint: self.index[link_of_joint[joint]] for joint in self.joints}
        self._wheels = tuple(self.index[wheel] for wheel in model.body.wheels)
        self._hubs = [self.index[extra.name] for extra in model.body.extras if extra.kind == "hub"]
        self._wheel_rad = [0.0] * len(self._wheels)
        self._wheel_goal_rad = [0.0] * len(self._wheels)
        self._read_indices = [*self._motors.values(), *self._wheels]
        # PyBullet gives the pose of the root's principal axes of inertia.
        info = bullet.getDynamicsInfo(self.body, -1)
        self._root_offset = np.array(info[3])
        self._root_turned: Quaternion | None = None if tuple(info[4]) == _LEVEL else tuple(info[4])
        self._link_indices = list(range(len(infos)))
        self._prepare(model, angles_rad)

    def roll_on_floor_alone(self, others: Iterable[int]) -> None:
        """Let omni wheels pass through other bodies: the chassis meets those, which is at least as wide as the wheels,
        but not as the balls of which the wheels are the middle."""
        if self._hubs:
            for other in others:
                for wheel in self._wheels:
                    self._bullet.setCollisionFilterPair(self.body, other, wheel, -1, 0)

    def drive(self, joint: str, drive: Drive) -> None:
        target_rad, max_speed_radps, max_torque_nm = drive
        self._control(self._motors[joint], target_rad, 0.0, max_torque_nm, JOINT_GAIN, 1.0, max_speed_radps)

    def spin(self, speeds_radps: Iterable[float], dt_s: float) -> None:
        """Turn the wheels at these speeds for the next step, as a controller with encoders does: the lag of one step is
        corrected in the next."""
        self._centre_hubs()
        for number, speed_radps in enumerate(speeds_radps):
            lag = self._wheel_goal_rad[number] - self._wheel_rad[number]
            lag = min(max(lag, -WHEEL_LAG_RAD), WHEEL_LAG_RAD)
            if speed_radps == 0.0 and abs(lag) > REST_LAG_RAD:
                lag *= 0.95
            goal = self._wheel_rad[number] + lag
            self._wheel_goal_rad[number] = goal + speed_radps * dt_s
            self._control(self._wheels[number], goal, speed_radps, WHEEL_TORQUE_NM, WHEEL_GAIN, 1.0, NO_LIMIT_RADPS)

    def _centre_hubs(self) -> None:
        """Set the hubs of omni wheels back to their places on the body, with the speeds that they have."""
        for hub in self._hubs:
            speed_mps = self._bullet.getJointState(self.body, hub)[1]
            self._bullet.resetJointState(self.body, hub, 0.0, speed_mps)

    def _control(
        self,
        motor: int,
        target_rad: float,
        target_radps: float,
        max_torque_nm: float,
        position_gain: float,
        velocity_gain: float,
        max_speed_radps: float,
    ) -> None:
        """Give a motor its target. By place and without the wrapper of `Bullet`: by name takes twice as long, and this
        is called several times in each step."""
        self._set_motor(
            self.body, motor, self._position_control, target_rad, target_radps, max_torque_nm, position_gain,
            velocity_gain, max_speed_radps, self._bullet.client,
        )  # fmt: skip

    def read(self) -> list[JointReading]:
        """Readings of the servo joints in the order of `joints`, then of the wheels in that of the base's drive."""
        states = self._bullet.getJointStates(self.body, self._read_indices)
        self._wheel_rad = [state[0] for state in states[len(self.joints) :]]
        return [(angle, speed, torque) for angle, speed, _, torque in states]

    def root(self) -> tuple[Vec3, Quaternion]:
        """World position (m) and orientation (x, y, z, w) of the body frame."""
        pose = self.root_pose()
        x, y, z = (float(value) for value in pose[:3, 3])
        return (x, y, z), self._orientation(self._bullet.getBasePositionAndOrientation(self.body)[1])

    def _orientation(self, axes: Quaternion) -> Quaternion:
        """The body frame's orientation by that of its principal axes of inertia."""
        if self._root_turned is None:
            return axes
        back = self._bullet.invertTransform((0.0, 0.0, 0.0), self._root_turned)[1]
        turned: Quaternion = self._bullet.multiplyTransforms((0.0, 0.0, 0.0), axes, (0.0, 0.0, 0.0), back)[1]
        return turned

    def root_pose(self) -> FloatArray:
        """World pose of the body frame, (4, 4)."""
        position, orientation = self._bullet.getBasePositionAndOrientation(self.body)
        pose = np.zeros((4, 4))
        pose[:3, :3] = rotation(self._orientation(orientation))
        pose[:3, 3] = np.array(position) - pose[:3, :3] @ self._root_offset
        pose[3, 3] = 1.0
        return pose

    def link_poses(self) -> FloatArray:
        """World poses of all links, (links + 1, 4, 4): row i is PyBullet's link i, the last row the root."""
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
        for hub in self._hubs:
            bullet.setJointMotorControl2(self.body, hub, bullet.VELOCITY_CONTROL, force=0.0)
            bullet.changeDynamics(self.body, hub, jointDamping=0.0)
        for joint, index in self._motors.items():
            bullet.resetJointState(self.body, index, angles_rad[joint])
            bullet.changeDynamics(self.body, index, jointDamping=0.0)
