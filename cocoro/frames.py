"""The common reference frame: egocentric spherical coordinates, and planar poses for odometry.

Body frame: x forward, y left, z up, origin on the floor between the drive wheels. Angles are
counter-clockwise seen from above, in radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, hypot, pi, sin, sqrt
from typing import NamedTuple

from cocoro.units import Vec3


def wrap_rad(angle_rad: float) -> float:
    """The equivalent angle in (-pi, pi]."""
    turns = (angle_rad + pi) % (2 * pi) - pi
    return pi if turns == -pi else turns


class Spherical(NamedTuple):
    """Egocentric spherical coordinates, as in the paper ('Localisation')."""

    rho_m: float
    """Distance from the frame's origin."""
    azimuth_rad: float
    """Left of straight ahead is positive."""
    elevation_rad: float
    """Above the horizontal plane is positive."""


def to_spherical(position_m: Sequence[float]) -> Spherical:
    """Cartesian (x, y, z) to spherical. The origin itself has all three zero."""
    x, y, z = position_m
    planar = hypot(x, y)
    return Spherical(sqrt(x * x + y * y + z * z), atan2(y, x), atan2(z, planar))


def to_cartesian(spherical: Spherical) -> Vec3:
    """Spherical to Cartesian (x, y, z) in metres."""
    rho, azimuth, elevation = spherical
    planar = rho * cos(elevation)
    return planar * cos(azimuth), planar * sin(azimuth), rho * sin(elevation)


class Pose2(NamedTuple):
    """Pose of a child frame in its parent frame on the plane of the floor: an element of SE(2).

    With the body's odometry as `odom_from_body`: `odom_from_body.apply(p)` is where a point that the body
    sees at p is in the odometry frame, and `later.inverse().compose(earlier)` carries what was seen from the
    earlier pose to the body as it stands at the later one.
    """

    x_m: float = 0.0
    y_m: float = 0.0
    yaw_rad: float = 0.0
    """Not wrapped by `compose`, so that a sum of turns stays one; `wrap_rad` wraps it."""

    def compose(self, child: Pose2) -> Pose2:
        """The grandchild's pose in this pose's parent: a_from_b.compose(b_from_c) is a_from_c."""
        c, s = cos(self.yaw_rad), sin(self.yaw_rad)
        return Pose2(
            self.x_m + c * child.x_m - s * child.y_m,
            self.y_m + s * child.x_m + c * child.y_m,
            self.yaw_rad + child.yaw_rad,
        )

    def inverse(self) -> Pose2:
        """The parent's pose in the child: a_from_b.inverse() is b_from_a."""
        c, s = cos(self.yaw_rad), sin(self.yaw_rad)
        return Pose2(-c * self.x_m - s * self.y_m, s * self.x_m - c * self.y_m, -self.yaw_rad)

    def apply(self, point_m: Sequence[float]) -> Vec3:
        """A point (x, y, z) of the child frame, in the parent frame; z is kept."""
        x, y, z = point_m
        c, s = cos(self.yaw_rad), sin(self.yaw_rad)
        return self.x_m + c * x - s * y, self.y_m + s * x + c * y, z

    def rotate(self, vector: Sequence[float]) -> Vec3:
        """A free vector (a velocity, say) of the child frame, in the parent frame; the origin plays no part."""
        x, y, z = vector
        c, s = cos(self.yaw_rad), sin(self.yaw_rad)
        return c * x - s * y, s * x + c * y, z
