"""Samples of a worn arm for the learning tests: its true kinematics with a little noise, draw by draw."""

from __future__ import annotations

import numpy as np

from apps.learning.sightings import Sightings
from cocoro.arrays import FloatArray
from cocoro.learning.handmap import NominalModel
from cocoro.robot import Robot
from sim.realism import body_of

NOISE_M = 0.002


def sightings(robot: Robot, *, seed: int = 0, draws: int = 150, each: int = 4, noise_m: float = NOISE_M) -> Sightings:
    """Sample random moves through the arm's range, with several frames of each."""
    rng = np.random.default_rng(seed)
    true = NominalModel(body_of(robot, "worn", seed).robot)
    low, high = true.limits_rad.T
    # the part of the range that the camera sees
    low, high = low + 0.3 * (high - low), high - 0.3 * (high - low)
    corners = rng.uniform(low, high, (draws + 1, 4))
    share = np.arange(1, each + 1) / each
    angles = (corners[:-1, None] + share[:, None] * np.diff(corners, axis=0)[:, None]).reshape(-1, 4)
    places = true.predict(angles) + rng.normal(0.0, noise_m / np.sqrt(3), (len(angles), 3))
    return Sightings(angles, places, np.repeat(np.arange(draws), each))


def slope_by_differences(function: object, at: FloatArray, step: float = 1e-6) -> FloatArray:
    """The Jacobian of `function.at` by central differences, (outputs, inputs)."""
    columns = [
        (function.at(at + step * axis) - function.at(at - step * axis)) / (2 * step)  # type: ignore[attr-defined]
        for axis in np.eye(len(at))
    ]
    return np.stack(columns, axis=1)
