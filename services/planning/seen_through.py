"""Whether a depth image looks through a place at which something stood: what is seen farther away is proof that it is
gone (derived from the visibility test of range images, Curless and Levoy 1996)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from cocoro.arrays import BoolArray, FloatArray, IntArray
from cocoro.robot import Robot

ROWS, COLUMNS, STEP_M = 30, 40, 0.014
"""Blocks of `Obstacles.nearest`, and the depth of one step."""
VIEW_BYTES = ROWS * COLUMNS
RANGE_M = (0.6, 3.2)
"""Depths between which the sensor would have seen what stands there."""
NEAR_FLOOR_M = 0.15
"""Below this height floor that is seen tells whether something stands."""
BEYOND_M, BEYOND_PER_M = 0.10, 0.03
"""A surface that is farther than a place by more than this is behind it; it grows with the place's depth, as the noise,
the head angles' error and the drift of the odometry do."""
_SIDE, _SHADOW = 1, 3
"""Blocks to each side in which something near the place keeps it; and in which something before it may cast the
infrared shadow that leaves the place without data."""
_SAMPLES = 5


class SeenThrough(NamedTuple):
    """The evidence of one depth image about n places, each field an array (n,)."""

    gone: BoolArray
    """Surfaces behind the place are seen where it would hide them."""
    empty: BoolArray
    """There is no data where the place would give some: it is gone and everything behind it is out of range, or it
    reflects nothing from here."""


class DepthView:
    """One depth image and the pose that it was taken from."""

    def __init__(self, robot: Robot, nearest: bytes, angles_rad: Mapping[str, float]) -> None:
        """`nearest`: as in `Obstacles`; `angles_rad`: the joints at its stamp, by name."""
        self._camera = robot.camera.scaled(COLUMNS, ROWS)
        pose = robot.camera_chain.pose(angles_rad)
        self._turn = pose[:3, :3]
        self._origin = pose[:3, 3] + self._turn @ np.array(robot.eye.depth_offset_m)
        depth = np.frombuffer(nearest, dtype=np.uint8).reshape(ROWS, COLUMNS) * STEP_M
        self._depth = np.where(depth > 0.0, depth, np.nan)

    def look(self, places_m: FloatArray, lowest_m: FloatArray, highest_m: FloatArray) -> SeenThrough:
        """Judge things at places (n, 2), body frame, m, that reach from `lowest_m` to `highest_m` (n,).

        At least two of five heights of a thing must be in the picture and in the sensor's range. Heights near the
        floor do not count where the thing reaches higher: the floor just behind them is no proof.
        """
        shares = np.linspace(0.0, 1.0, _SAMPLES)
        lowest = np.maximum(lowest_m, np.minimum(highest_m, NEAR_FLOOR_M))
        heights = lowest[:, None] + shares * (highest_m - lowest)[:, None]
        points = np.concatenate([np.repeat(places_m[:, None, :], _SAMPLES, axis=1), heights[:, :, None]], axis=2)
        x, y, depth = np.moveaxis((points - self._origin) @ self._turn, 2, 0)
        safe = np.maximum(depth, 0.1)
        column = np.rint(self._camera.cx + self._camera.fx * x / safe).astype(np.int64)
        row = np.rint(self._camera.cy + self._camera.fy * y / safe).astype(np.int64)
        visible = (depth > RANGE_M[0]) & (depth < RANGE_M[1])
        visible &= (column >= 0) & (column < COLUMNS) & (row >= 0) & (row < ROWS)
        seen = self._around(row, column, _SIDE)
        margin = BEYOND_M + BEYOND_PER_M * depth
        # A comparison with NaN, which is no data, is false.
        at_or_before = (seen < (depth + margin)[:, :, None]).any(axis=2)
        behind = seen[:, :, _SIDE] >= depth + margin
        through = visible & ~at_or_before & behind
        dark = visible & ~at_or_before & np.isnan(seen[:, :, _SIDE])
        if dark.any():
            dark &= ~(self._around(row, column, _SHADOW) < (depth - margin)[:, :, None]).any(axis=2)
        count = visible.sum(axis=1)
        gone = (count >= 2) & (through.sum(axis=1) == count)
        empty = (count >= 2) & ~gone & ((through | dark).sum(axis=1) == count)
        return SeenThrough(gone, empty)

    def _around(self, row: IntArray, column: IntArray, side: int) -> FloatArray:
        """Depths of the blocks up to `side` beside those given (n, k), shape (n, k, 2 side + 1)."""
        beside = np.clip(column[:, :, None] + np.arange(-side, side + 1), 0, COLUMNS - 1)
        rows = np.clip(row, 0, ROWS - 1)[:, :, None]
        found: FloatArray = self._depth[rows, beside]
        return found
