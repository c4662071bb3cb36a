"""The hand-eye map: where the hand's marker is seen for the arm's joint angles, with its exact Jacobian.

A network alone, as the paper has it, or the same network as what the drawing leaves unexplained; its outputs
Cartesian or egocentric spherical. All positions are in the body frame as the robot's own eye has it: what the camera
says through the drawing of the neck. So a target and a hand that are seen in one place are one place, however the
camera is mounted.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.frames import Spherical, to_cartesian
from cocoro.learning.network import HyperplaneRbf
from cocoro.learning.nominal_model import NominalModel

Coordinates = Literal["cartesian", "spherical"]


class HandMap:
    """Angles are in the order of `joints`; places in metres."""

    def __init__(
        self,
        drawing: NominalModel,
        network: HyperplaneRbf,
        *,
        over_drawing: bool = True,
        coordinates: Coordinates = "cartesian",
    ) -> None:
        self.drawing = drawing
        self.network = network
        self.over_drawing = over_drawing
        self.coordinates: Coordinates = coordinates
        self.joints = drawing.joints

    def targets(self, angles_rad: FloatArray, places_m: FloatArray) -> FloatArray:
        """What the network is to give for postures (b, n) whose hand is at places (b, 3); shape (b, 3)."""
        if not self.over_drawing:
            return spherical_of(places_m) if self.coordinates == "spherical" else np.asarray(places_m)
        drawn = self.drawing.predict(angles_rad)
        if self.coordinates == "cartesian":
            return np.asarray(places_m - drawn)
        gap = spherical_of(places_m) - spherical_of(drawn)
        gap[:, 1] = np.remainder(gap[:, 1] + np.pi, 2 * np.pi) - np.pi
        return np.asarray(gap)

    def predict(self, angles_rad: FloatArray) -> FloatArray:
        """Where the marker is seen, for postures (b, n); shape (b, 3)."""
        given = self.network.predict(angles_rad)
        if not self.over_drawing:
            return cartesian_of(given) if self.coordinates == "spherical" else np.asarray(given)
        drawn = self.drawing.predict(angles_rad)
        if self.coordinates == "cartesian":
            return np.asarray(drawn + given)
        return cartesian_of(spherical_of(drawn) + given)

    def at(self, angles_rad: FloatArray) -> FloatArray:
        """For one posture (n,), shape (3,)."""
        if self.over_drawing and self.coordinates == "cartesian":  # the one that is asked for all the time
            return np.asarray(self.drawing.at(angles_rad) + self.network.at(angles_rad))
        return np.asarray(self.predict(angles_rad[None])[0])

    def jacobian(self, angles_rad: FloatArray) -> FloatArray:
        """d place / d angle at one posture (n,), Cartesian, metres a radian, shape (3, n)."""
        slope = self.network.jacobian(angles_rad)
        if self.coordinates == "cartesian":
            return self.drawing.jacobian(angles_rad) + slope if self.over_drawing else slope
        given = self.network.at(angles_rad)
        if self.over_drawing:
            drawn = self.drawing.at(angles_rad)
            slope = slope + np.linalg.solve(spherical_slope(drawn), self.drawing.jacobian(angles_rad))
            given = given + spherical_of(drawn[None])[0]
        return np.asarray(spherical_slope(np.array(to_cartesian(Spherical(*given)))) @ slope)


def spherical_of(places_m: FloatArray) -> FloatArray:
    """(x, y, z) to (rho, azimuth, elevation), row by row, as `cocoro.frames.to_spherical` has it; shape (b, 3)."""
    x, y, z = places_m.T
    planar = np.hypot(x, y)
    return np.stack([np.hypot(planar, z), np.arctan2(y, x), np.arctan2(z, planar)], axis=1)


def cartesian_of(spherical: FloatArray) -> FloatArray:
    """(rho, azimuth, elevation) to (x, y, z), row by row; shape (b, 3)."""
    rho, azimuth, elevation = spherical.T
    planar = rho * np.cos(elevation)
    return np.stack([planar * np.cos(azimuth), planar * np.sin(azimuth), rho * np.sin(elevation)], axis=1)


def spherical_slope(place_m: FloatArray) -> FloatArray:
    """d (x, y, z) / d (rho, azimuth, elevation) at a place (3,), shape (3, 3). Singular on the body's vertical axis, so
    that axis counts as a millimetre away."""
    x, y, z = place_m.tolist()
    planar = max(float(np.hypot(x, y)), 1e-3)
    rho = max(float(np.hypot(planar, z)), 1e-3)
    return np.array([[x / rho, -y, -z * x / planar], [y / rho, x, -z * y / planar], [z / rho, 0.0, planar]])
