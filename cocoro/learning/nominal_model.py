"""The arm as its drawing has it, for many postures at once: where the hand's marker would be."""

from __future__ import annotations

import hashlib

import msgspec
import numpy as np

from cocoro.arrays import FloatArray
from cocoro.kinematics import turn_z
from cocoro.robot import Robot

PRIMING_A_JOINT = 10
"""10 values a joint: the paper's 10,000 rigid-body points for the arm's four."""


def arm_joints(robot: Robot) -> tuple[str, ...]:
    """The joints that carry the marker about and are servos of the arm: all but the wrist roll."""
    return tuple(name for name in robot.chain(robot.marker.link).joints if robot.joints[name].network == "arm")


_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


class NominalModel:
    """Rigid-body forward kinematics of the marker; angles are in the order of `joints`."""

    def __init__(self, robot: Robot, roll_rad: float | None = None) -> None:
        """`roll_rad`: the wrist roll; None is the one at which the claws lie level, which babbling keeps."""
        roll_rad = robot.claw.level_roll_rad if roll_rad is None else roll_rad
        self.roll_rad = roll_rad
        self.joints = arm_joints(robot)
        self.limits_rad = np.array([robot.joints[name].limits_rad for name in self.joints])
        self._chain = robot.chain(robot.marker.link)
        self._marker = np.array([*robot.marker.position_m, 1.0])
        self._rest = {name: roll_rad for name in self._chain.joints if name not in self.joints}
        self._steps: list[tuple[FloatArray, int, float]] = []
        """For each joint from the body on: the fixed transform before it, which of `joints` it is, its offset."""
        rows = []
        name = robot.marker.link
        while name != "body":
            rows.append(robot.links[name])
            name = robot.links[name].parent
        before = np.eye(4)
        for row in reversed(rows):
            before = before @ row.fixed()
            if row.joint in self.joints:
                self._steps.append((before, self.joints.index(row.joint), row.offset_rad))
                before = np.eye(4)
            elif row.joint is not None:
                before = before @ turn_z(self._rest[row.joint] + row.offset_rad)
        self._marker = before @ self._marker

    def predict(self, angles_rad: FloatArray) -> FloatArray:
        """Marker positions, body frame, metres, for postures (b, n); shape (b, 3)."""
        points = np.broadcast_to(self._marker[:3], (len(angles_rad), 3))
        for fixed, which, offset_rad in reversed(self._steps):
            turn = angles_rad[:, which] + offset_rad
            c, s = np.cos(turn), np.sin(turn)
            x, y, z = points.T
            points = np.stack([c * x - s * y, s * x + c * y, z], axis=1) @ fixed[:3, :3].T + fixed[:3, 3]
        return np.asarray(points)

    def at(self, angles_rad: FloatArray) -> FloatArray:
        """For one posture (n,), shape (3,)."""
        total = np.eye(4)
        for fixed, which, offset_rad in self._steps:
            total = total @ fixed @ turn_z(float(angles_rad[which]) + offset_rad)
        return np.asarray((total @ self._marker)[:3])

    def jacobian(self, angles_rad: FloatArray) -> FloatArray:
        """d position / d angle at one posture (n,), metres a radian, shape (3, n)."""
        total = np.eye(4)
        axes, origins = np.empty((len(self.joints), 3)), np.empty((len(self.joints), 3))
        for fixed, which, offset_rad in self._steps:
            total = total @ fixed
            axes[which], origins[which] = total[:3, 2], total[:3, 3]
            total = total @ turn_z(float(angles_rad[which]) + offset_rad)
        arms = (total @ self._marker)[:3] - origins
        # The cross product, by hand: np.cross takes as long as all the rest.
        return np.asarray((axes[:, _NEXT] * arms[:, _LAST] - axes[:, _LAST] * arms[:, _NEXT]).T)

    def priming(self, count: int = PRIMING_A_JOINT, reach_rad: float = 2.62) -> tuple[FloatArray, FloatArray]:
        """Evenly spaced postures and the marker's places in them: (count ** n, n) and (count ** n, 3).

        As the paper has them, over +-2.62 rad a joint whatever its limits; shuffled, always the same way, because a
        single pass over a sorted grid would end in one corner of it.
        """
        axis = np.linspace(-reach_rad, reach_rad, count)
        grid = np.stack(np.meshgrid(*[axis] * len(self.joints), indexing="ij"), axis=-1).reshape(-1, len(self.joints))
        grid = grid[np.random.default_rng(0).permutation(len(grid))]
        return grid, self.predict(grid)


def fingerprint_of(robot: Robot) -> str:
    """A fingerprint of what positions and turns are computed with: links, zeros of the joints, marker, wheels, camera.
    Descriptions that agree in these have equal fingerprints. Fields with their default value are left out, so that a
    field that is added to descriptions later does not change the fingerprint."""
    data = robot.to_data()
    drawing = {
        "link": data["link"],
        "joint": [(row["name"], row["direction"], row["centre_count"]) for row in data["joint"]],
        "marker": data["marker"],
        "base": [data["base"][name] for name in ("wheel_separation_m", "wheel_radius_m")],
        "kinect": {
            field.name: data["kinect"][field.name]
            for field in msgspec.structs.fields(robot.kinect)
            if field.required or getattr(robot.kinect, field.name) != field.default
        },
    }
    return hashlib.sha256(msgspec.json.encode(drawing, order="deterministic")).hexdigest()[:16]
