"""The position of the hand's marker for the arm's joint angles: by the nominal model, and by the learned hand-eye map.

The map is a network alone, as in the paper, or a network of what the nominal model leaves unexplained. Its outputs are
Cartesian or egocentric spherical. All positions are in the body frame as the robot's camera sees it: what the camera
measures, transformed by the nominal model of the neck. A target and a hand that are seen in one place are therefore in
one place, however the camera is mounted.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from typing import Any, Literal

import msgspec
import numpy as np

from cocoro.arrays import FloatArray
from cocoro.cameras import CameraRow
from cocoro.frames import Spherical, to_cartesian
from cocoro.kinematics import turn_z
from cocoro.learning.network import HyperplaneRbf
from cocoro.robot import Robot

Coordinates = Literal["cartesian", "spherical"]

PRIMING_A_JOINT = 10
"""Values per joint; 10,000 postures for the arm's four joints, as in the paper."""
_NEXT, _LAST = [1, 2, 0], [2, 0, 1]


def arm_joints(robot: Robot) -> tuple[str, ...]:
    """The arm's joints that move the marker; the hand's roll is none of them. Raises ConfigError for a robot without
    a marker."""
    return tuple(name for name in robot.chain(robot.the_marker.link).joints if name in robot.arm.joints)


def fingerprint_of(robot: Robot) -> str:
    """Fingerprint of the geometry that positions are computed with: links, joint zeros, marker, wheels, camera.

    Descriptions that agree in these have equal fingerprints. Fields with their default value are left out, so that a
    field that is added to descriptions later does not change the fingerprint.
    """
    data = robot.to_data()
    geometry = {
        "link": data["link"],
        "joint": [(one.name, one.direction, one.centre_count) for one in robot.joints.values()],
        "marker": data["marker"],
        "base": [
            data["base"][name] for name in ("wheel_separation_m", "wheel_radius_m", "wheel") if data["base"][name]
        ],
        "kinect": _camera(robot.eye),
    }
    return hashlib.sha256(msgspec.json.encode(geometry, order="deterministic")).hexdigest()[:16]


_OF_EVERY_CAMERA = (
    "width", "height", "rate_hz", "horizontal_fov_rad", "vertical_fov_rad", "min_range_m", "max_range_m",
    "depth_offset_m", "projector_offset_m", "depth_curve",
)  # fmt: skip
_FORMER = {"link": "camera", "depth": "kinect"}
"""Values that had no field before, or were its default."""


def _camera(row: CameraRow) -> dict[str, Any]:
    """The camera's part of the fingerprint, in the form that descriptions with one camera had."""
    defaults = {field.name: _FORMER.get(field.name, field.default) for field in msgspec.structs.fields(row)}
    return {
        name: value
        for name, value in msgspec.to_builtins(row).items()
        if name in _OF_EVERY_CAMERA or (name != "name" and getattr(row, name) != defaults[name])
    }


class NominalModel:
    """Rigid-body forward kinematics of the marker by the robot description, for many postures at once.

    Angles are in radians, in the order of `joints` (n of them); positions in metres, body frame.
    """

    def __init__(self, robot: Robot, roll_rad: float | None = None) -> None:
        """`roll_rad`: the hand's roll; None is the one at which the claws lie level, which babbling keeps.
        Raises ConfigError for a robot without a marker."""
        marker = robot.the_marker
        roll_rad = robot.claw.level_roll_rad if roll_rad is None else roll_rad
        self.roll_rad = roll_rad
        self.joints = arm_joints(robot)
        self._roll = robot.arm.roll
        self.limits_rad = np.array([robot.joints[name].limits_rad for name in self.joints])
        self._chain = robot.chain(marker.link)
        self._marker = np.array([*marker.position_m, 1.0])
        self._rest = {name: roll_rad for name in self._chain.joints if name not in self.joints}
        self._steps: list[tuple[FloatArray, int, float]] = []
        """For each joint from the body on: the fixed transform before it (4, 4), its index in `joints`, its offset."""
        rows = []
        name = marker.link
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

    def posture(self, angles_rad: Mapping[str, float]) -> FloatArray:
        """The angles (n,) of `joints` among those of all joints by name, rad."""
        return np.array([angles_rad[name] for name in self.joints])

    def holds_at(self, angles_rad: Mapping[str, float], tolerance_rad: float) -> bool:
        """Whether the hand is rolled as this model takes it to be. `angles_rad`: of all joints, by name."""
        return abs(angles_rad[self._roll] - self.roll_rad) <= tolerance_rad

    def predict(self, angles_rad: FloatArray) -> FloatArray:
        """Marker positions (b, 3) for postures (b, n)."""
        points = np.broadcast_to(self._marker[:3], (len(angles_rad), 3))
        for fixed, which, offset_rad in reversed(self._steps):
            turn = angles_rad[:, which] + offset_rad
            c, s = np.cos(turn), np.sin(turn)
            x, y, z = points.T
            points = np.stack([c * x - s * y, s * x + c * y, z], axis=1) @ fixed[:3, :3].T + fixed[:3, 3]
        return np.asarray(points)

    def at(self, angles_rad: FloatArray) -> FloatArray:
        """Marker position (3,) for one posture (n,)."""
        total = np.eye(4)
        for fixed, which, offset_rad in self._steps:
            total = total @ fixed @ turn_z(float(angles_rad[which]) + offset_rad)
        return np.asarray((total @ self._marker)[:3])

    def jacobian(self, angles_rad: FloatArray) -> FloatArray:
        """Jacobian of the marker position at one posture (n,), shape (3, n), m/rad."""
        total = np.eye(4)
        axes, origins = np.empty((len(self.joints), 3)), np.empty((len(self.joints), 3))
        for fixed, which, offset_rad in self._steps:
            total = total @ fixed
            axes[which], origins[which] = total[:3, 2], total[:3, 3]
            total = total @ turn_z(float(angles_rad[which]) + offset_rad)
        arms = (total @ self._marker)[:3] - origins
        # The cross product, written out: np.cross takes as long as all the rest.
        return np.asarray((axes[:, _NEXT] * arms[:, _LAST] - axes[:, _LAST] * arms[:, _NEXT]).T)

    def priming(
        self, count: int = PRIMING_A_JOINT, reach_rad: float = 2.62, *, shuffled: bool = True
    ) -> tuple[FloatArray, FloatArray]:
        """Evenly spaced postures (count ** n, n) and their marker positions (count ** n, 3), for priming a network.

        As in the paper they cover +-`reach_rad` of every joint, whatever its limits. Their order is a fixed shuffle,
        because a single pass over a sorted grid ends in one corner of it; `shuffled=False` is that order.
        """
        axis = np.linspace(-reach_rad, reach_rad, count)
        grid = np.stack(np.meshgrid(*[axis] * len(self.joints), indexing="ij"), axis=-1).reshape(-1, len(self.joints))
        if shuffled:
            grid = grid[np.random.default_rng(0).permutation(len(grid))]
        return grid, self.predict(grid)


class HandMap:
    """The map from joint angles, rad, in the order of `joints`, to the position at which the marker is seen.

    Positions are in the body frame, m.
    """

    def __init__(
        self,
        nominal: NominalModel,
        network: HyperplaneRbf,
        *,
        over_nominal: bool = True,
        coordinates: Coordinates = "cartesian",
    ) -> None:
        self.nominal = nominal
        self.network = network
        self.over_nominal = over_nominal
        self.coordinates: Coordinates = coordinates
        self.joints = nominal.joints

    def targets(self, angles_rad: FloatArray, places_m: FloatArray) -> FloatArray:
        """The network's target outputs (b, 3) for postures (b, n) with the marker at positions (b, 3)."""
        if not self.over_nominal:
            return spherical_of(places_m) if self.coordinates == "spherical" else np.asarray(places_m)
        base = self.nominal.predict(angles_rad)
        if self.coordinates == "cartesian":
            return np.asarray(places_m - base)
        gap = spherical_of(places_m) - spherical_of(base)
        gap[:, 1] = np.remainder(gap[:, 1] + np.pi, 2 * np.pi) - np.pi
        return np.asarray(gap)

    def predict(self, angles_rad: FloatArray) -> FloatArray:
        """Marker positions (b, 3) for postures (b, n)."""
        given = self.network.predict(angles_rad)
        if not self.over_nominal:
            return cartesian_of(given) if self.coordinates == "spherical" else np.asarray(given)
        base = self.nominal.predict(angles_rad)
        if self.coordinates == "cartesian":
            return np.asarray(base + given)
        return cartesian_of(spherical_of(base) + given)

    def at(self, angles_rad: FloatArray) -> FloatArray:
        """Marker position (3,) for one posture (n,)."""
        if self.over_nominal and self.coordinates == "cartesian":  # the planner's case
            return np.asarray(self.nominal.at(angles_rad) + self.network.at(angles_rad))
        return np.asarray(self.predict(angles_rad[None])[0])

    def jacobian(self, angles_rad: FloatArray) -> FloatArray:
        """Jacobian of the Cartesian marker position at one posture (n,), shape (3, n), m/rad."""
        slope = self.network.jacobian(angles_rad)
        if self.coordinates == "cartesian":
            return self.nominal.jacobian(angles_rad) + slope if self.over_nominal else slope
        given = self.network.at(angles_rad)
        if self.over_nominal:
            base = self.nominal.at(angles_rad)
            slope = slope + np.linalg.solve(spherical_slope(base), self.nominal.jacobian(angles_rad))
            given = given + spherical_of(base[None])[0]
        return np.asarray(spherical_slope(np.array(to_cartesian(Spherical(*given)))) @ slope)


def spherical_of(places_m: FloatArray) -> FloatArray:
    """(x, y, z) in metres to (rho, azimuth, elevation) in metres and radians, each (b, 3): `to_spherical` for rows."""
    x, y, z = places_m.T
    planar = np.hypot(x, y)
    return np.stack([np.hypot(planar, z), np.arctan2(y, x), np.arctan2(z, planar)], axis=1)


def cartesian_of(spherical: FloatArray) -> FloatArray:
    """(rho, azimuth, elevation) in metres and radians to (x, y, z) in metres, each (b, 3)."""
    rho, azimuth, elevation = spherical.T
    planar = rho * np.cos(elevation)
    return np.stack([planar * np.cos(azimuth), planar * np.sin(azimuth), rho * np.sin(elevation)], axis=1)


def spherical_slope(place_m: FloatArray) -> FloatArray:
    """d (x, y, z) / d (rho, azimuth, elevation) at a position (3,) in metres, shape (3, 3).

    It is singular on the body's vertical axis, so positions count as at least a millimetre away from that axis.
    """
    x, y, z = place_m.tolist()
    planar = max(float(np.hypot(x, y)), 1e-3)
    rho = max(float(np.hypot(planar, z)), 1e-3)
    return np.array([[x / rho, -y, -z * x / planar], [y / rho, x, -z * y / planar], [z / rho, 0.0, planar]])
