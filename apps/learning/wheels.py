"""The distance between the wheels, from a target that was seen before and after the wheels turned.

Between the two sightings the body turns by dtheta and its origin moves along the arc. With the roads s_l and s_r of the
wheels, (s_r - s_l) = L dtheta. The way along the arc, d = (s_l + s_r) / 2, is known, so the second sighting is turned
and moved back by it; dtheta is the angle at which its bearing is that of the first (derived).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, cos, sin

import numpy as np

from apps.learning.dataset import WheelRow
from cocoro.arrays import FloatArray
from cocoro.frames import wrap_rad
from cocoro.units import Vec2

LEAST_TURN_RAD = 0.10
"""A trial that turned less is not used: errors of the bearings would count as much as the turn."""
_ITERATIONS = 20


def turn_between(before_m: Vec2, after_m: Vec2, way_m: float) -> float:
    """The turn (rad, counter-clockwise) of a body that drove an arc of length `way_m` between two sightings of one
    standing target, each in the body frame of its time. A fixed point; it converges since the way is short against
    the target's distance."""
    turn = wrap_rad(atan2(before_m[1], before_m[0]) - atan2(after_m[1], after_m[0]))
    for _ in range(_ITERATIONS):
        chord_m = way_m * (sin(turn / 2) / (turn / 2) if abs(turn) > 1e-9 else 1.0)
        x, y = before_m[0] - chord_m * cos(turn / 2), before_m[1] - chord_m * sin(turn / 2)
        turn = wrap_rad(atan2(y, x) - atan2(after_m[1], after_m[0]))
    return turn


def separation_of(trial: WheelRow) -> float | None:
    """The distance by one trial, metres; None where it turned too little."""
    turn = turn_between(trial.before_m, trial.after_m, (trial.left_m + trial.right_m) / 2)
    if abs(turn) < LEAST_TURN_RAD:
        return None
    return (trial.right_m - trial.left_m) / turn


@dataclass(frozen=True)
class WheelFit:
    """The fit to all trials."""

    separation_m: float
    """The learned wheel distance: the one that turns the robot."""
    sigma_m: float
    """Its standard deviation, by the scatter of the trials."""
    median_m: float
    """The paper's estimate: the median over the trials."""
    estimates_m: tuple[float, ...]
    """The distance by each trial that turned enough."""
    left_scale: float = 1.0
    right_scale: float = 1.0
    """True travel of each wheel over the commanded one."""


def fit_wheels(trials: Sequence[WheelRow]) -> WheelFit | None:
    """The paper's median, and a fit to all trials; None without a trial that turned enough.

    The fit estimates the two wheels' scales beside the distance: a wheel that rolls 1% further than its nominal radius
    bends a straight path, which a median over forward and reverse trials cannot distinguish from another distance. Each
    trial gives two equations: bearing and distance of the target over the floor (Gauss-Newton with Huber weights;
    equations derived). `separation_m` is the distance over the mean scale, which turns the robot and which odometry and
    navigation need.
    """
    estimates = [(separation_of(trial), trial) for trial in trials]
    useful = [value for value, _ in estimates if value is not None]
    if not useful:
        return None
    median = float(np.median(useful))
    if len(useful) < 4:
        return WheelFit(median, float("nan"), median, tuple(useful))
    state, sigma = _solve(trials, np.array([1.0 / median, 0.0, 0.0]))
    # The turn of opposite travels s: 2 s (1 + mean) / L.
    inverse, left, right = state.tolist()
    return WheelFit(1.0 / inverse, sigma / inverse**2, median, tuple(useful), 1.0 + left, 1.0 + right)


_PRIOR = np.diag([0.0, 1.0 / 0.02, 1.0 / 0.02])
"""The scales are within a few hundredths of one."""
_BEARING_RAD, _RANGE_M = 0.006, 0.008
"""Standard deviations of a sighting while the robot stands, from backlash and depth noise."""


def _solve(trials: Sequence[WheelRow], state: FloatArray) -> tuple[FloatArray, float]:
    """The fitted state (3,): mean scale / L in 1/m, left and right scale less one; and the deviation of the first."""
    for _ in range(_ITERATIONS):
        residual = _residuals(trials, state)
        slope = np.stack([(_residuals(trials, state + step) - residual) / 1e-5 for step in 1e-5 * np.eye(3)], axis=1)
        weight = 1.0 / np.maximum(np.abs(residual) / 1.5, 1.0)
        rows = slope * weight[:, None]
        normal = rows.T @ slope + _PRIOR**2
        move = np.linalg.solve(normal, -(rows.T @ residual + _PRIOR**2 @ state))
        state = state + move
        if float(np.abs(move).max()) < 1e-9:
            break
    scatter = float(np.sqrt(np.mean(np.minimum(np.abs(residual), 3.0) ** 2)))
    return state, scatter * float(np.sqrt(np.linalg.inv(normal)[0, 0]))


def _residuals(trials: Sequence[WheelRow], state: FloatArray) -> FloatArray:
    """Normalised residuals (2 b,) of the target's second position, in bearing and distance, for a state (3,)."""
    inverse, left, right = state.tolist()
    found = []
    for trial in trials:
        left_m, right_m = (1 + left) * trial.left_m, (1 + right) * trial.right_m
        mean = 1 + (left + right) / 2
        turn = (right_m - left_m) * inverse / mean
        way_m = (left_m + right_m) / 2
        chord_m = way_m * (sin(turn / 2) / (turn / 2) if abs(turn) > 1e-9 else 1.0)
        x, y = trial.before_m[0] - chord_m * cos(turn / 2), trial.before_m[1] - chord_m * sin(turn / 2)
        bearing = wrap_rad(atan2(y, x) - turn - atan2(trial.after_m[1], trial.after_m[0]))
        far = float(np.hypot(x, y) - np.hypot(*trial.after_m))
        found += [bearing / _BEARING_RAD, far / _RANGE_M]
    return np.array(found)
