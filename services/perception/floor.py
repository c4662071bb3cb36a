"""Finds obstacles and free floor in a depth image.

Each depth pixel of a coarse grid becomes a point in the body frame. Near the floor's height it is floor, above it
an obstacle. The tolerance grows with the distance, as the sensor's noise and the error of the head angles do
(derived).
"""

from __future__ import annotations

import numpy as np

from cocoro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from cocoro.messages import Obstacles, ServoState
from cocoro.robot import Robot
from services.perception.config import PerceptionConfig
from services.perception.image import RgbdImage

CELL_M = 0.04
_RAY_DEG = 2.0
_BEFORE_M = 0.06
"""Free floor ends this far before an obstacle."""
_MIN_POINTS = 2
"""Fewer points above the floor in a cell are noise."""
_MOST_CELLS = 600
BLOCKS = 30, 40
"""Rows and columns of the blocks whose nearest depth is told."""
STEP_M = 0.014
_RAYS = round(360 / _RAY_DEG)
_ROW_RAD, _CAMERA_M = 0.0125, 0.73
"""Angle between two rows of the grid, and the camera's height."""
_NEAR_M = 1.0
"""Nearer, neighbouring pixels may be more than a degree apart."""
_BEYOND_M = 100.0
"""More than any distance."""
_GAP = 2.2
"""Floor is shown without a gap where two pixels are less than so many rows apart."""


class FloorScanner:
    def __init__(self, robot: Robot, config: PerceptionConfig) -> None:
        self._robot = robot
        self._config = config
        self._offset_m = np.array(robot.eye.depth_offset_m)
        self._directions: dict[tuple[int, int], FloatArray] = {}

    def sample(self, image: RgbdImage) -> Float32Array | None:
        """Depth on a coarse grid of 80 x 60 pixels at any resolution, m, shape (rows, columns); NaN without data."""
        step = max(image.width // 80, 1)
        return self._robot.depth_m(image.raw_depth[step // 2 :: step, step // 2 :: step])

    def nearest(self, image: RgbdImage) -> bytes:
        """`Obstacles.nearest` of a frame: from every pixel, so that nothing is too thin to be seen."""
        rows, columns = (
            np.arange(blocks) * size // blocks for blocks, size in zip(BLOCKS, image.raw_depth.shape, strict=True)
        )
        # Codes rise with the depth, and that of no data is the highest.
        height, width = image.raw_depth.shape
        if height % BLOCKS[0] == 0:  # several times as fast
            strips = image.raw_depth.reshape(BLOCKS[0], -1, width).min(axis=1)
        else:
            strips = np.minimum.reduceat(image.raw_depth, rows, axis=0)
        codes = np.minimum.reduceat(strips, columns, axis=1)
        steps = np.clip(self._robot.depth_m(codes) / STEP_M, 1.0, 255.0)
        nearest: bytes = np.nan_to_num(steps, nan=0.0).astype(np.uint8).tobytes()
        return nearest

    def scan(self, depth_m: Float32Array, width: int, height: int, camera_pose: FloatArray) -> Obstacles:
        """Obstacles and free floor in the body frame, without a stamp and without `nearest`.

        `depth_m` is from `sample`, m, shape (rows, columns), of a frame of `width` x `height` pixels. `camera_pose`
        is the colour camera's pose in the body frame, 4 x 4, m.
        """
        config = self._config
        rotation = camera_pose[:3, :3]
        origin = camera_pose[:3, 3] + rotation @ self._offset_m
        rays = self._rays(depth_m.shape, width, height)
        seen = np.isfinite(depth_m)
        points = (rays[seen] * depth_m[seen][:, None]) @ rotation.T + origin
        level = points[:, :2] - origin[:2]
        distance = np.hypot(level[:, 0], level[:, 1])
        near = distance <= config.floor_range_m
        points, level, distance = points[near], level[near], distance[near]
        tolerance = config.floor_tolerance_m + config.floor_tolerance_per_m * distance
        floor = np.abs(points[:, 2]) <= tolerance
        standing = (points[:, 2] > tolerance) & (points[:, 2] < config.obstacle_height_m)
        return told(points, level, floor, standing, origin)

    def watch(self, state: ServoState) -> None:
        """Take note of the arm's angles. What the arm hides or pretends, depth shows by itself."""

    def _rays(self, shape: tuple[int, ...], width: int, height: int) -> FloatArray:
        """Directions of the grid's pixels in the depth camera's frame, z = 1, shape (rows, columns, 3)."""
        rays = self._directions.get((width, height))
        if rays is None:
            camera = self._robot.camera.scaled(width, height)
            step = max(width // 80, 1)
            v, u = np.mgrid[0 : shape[0], 0 : shape[1]] * step + step // 2
            rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)
            self._directions[(width, height)] = rays
        return rays


def told(points: FloatArray, level: FloatArray, floor: BoolArray, standing: BoolArray, origin: FloatArray) -> Obstacles:
    """The message of points (n, 3), body frame, m, that show the floor or what stands on it, each (n,); without a
    stamp. `level` (n, 2) are the points as seen from `origin` (3,), the camera's place."""
    distance = np.hypot(level[:, 0], level[:, 1])
    cells, heights, lowest = _cells(points[standing])
    bearing = np.arctan2(level[:, 1], level[:, 0])
    ray = np.floor(np.degrees(bearing) / _RAY_DEG).astype(np.int64) % _RAYS
    return Obstacles(
        points_m=tuple(
            (round(x, 3), round(y, 3), round(z, 3)) for (x, y), z in zip(cells.tolist(), heights.tolist(), strict=True)
        ),
        lowest_m=tuple(round(z, 3) for z in lowest.tolist()),
        free=_free(ray, distance, floor, standing),
        shown=_shown(bearing, distance, floor),
        origin_m=(float(origin[0]), float(origin[1])),
    )


def _cells(points: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Centres of the floor cells with enough points, m, shape (n, 2), and the heights of the highest and the lowest
    point in each, m, shape (n,). `points` has shape (k, 3), m."""
    if not len(points):
        return np.zeros((0, 2)), np.zeros(0), np.zeros(0)
    cells = np.floor(points[:, :2] / CELL_M).astype(np.int64)
    # By x, then by y: one number for each cell, since NumPy's `unique` of rows takes ten times as long.
    place = cells - cells.min(axis=0)
    key = place[:, 0] * (1 + place[:, 1].max()) + place[:, 1]
    order = np.argsort(key, kind="stable")
    key = key[order]
    start = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    enough = np.flatnonzero(np.diff(np.append(start, len(key))) >= _MIN_POINTS)[:_MOST_CELLS]
    heights = points[order, 2]
    highest, lowest = np.maximum.reduceat(heights, start), np.minimum.reduceat(heights, start)
    centres = (cells[order[start[enough]]] + 0.5) * CELL_M
    return np.asarray(centres, dtype=np.float64), highest[enough], lowest[enough]


def _free(
    ray: IntArray, distance: FloatArray, floor: BoolArray, standing: BoolArray
) -> tuple[tuple[float, float, float], ...]:
    """Bearing, rad, and the nearest and farthest free floor, m, of each ray with floor; a ray ends before the first
    obstacle."""
    nearest, farthest = np.full(_RAYS, np.inf), np.zeros(_RAYS)
    np.minimum.at(nearest, ray[floor], distance[floor])
    np.maximum.at(farthest, ray[floor], distance[floor])
    ends = np.full(_RAYS, np.inf)
    np.minimum.at(ends, ray[standing], distance[standing] - _BEFORE_M)
    farthest = np.minimum(farthest, ends)
    bearings = np.radians((np.arange(_RAYS) + 0.5) * _RAY_DEG)
    rays = np.flatnonzero(farthest > nearest)
    found = zip(bearings[rays].tolist(), nearest[rays].tolist(), farthest[rays].tolist(), strict=True)
    return tuple((round(bearing, 4), round(near, 3), round(far, 3)) for bearing, near, far in found)


def _shown(bearing_rad: FloatArray, distance_m: FloatArray, floor: BoolArray) -> bytes:
    """`Obstacles.shown` by the points' bearings and distances (n,) from the camera."""
    runs: list[FloatArray] = []
    for part, width_deg in ((distance_m < _NEAR_M, 2), (distance_m >= _NEAR_M, 1)):
        degree = np.floor(np.degrees(bearing_rad[part]) / width_deg).astype(np.int64) * width_deg % 360
        # By degree, then by distance: one sort is cheaper than two.
        order = np.argsort(degree * _BEYOND_M + distance_m[part], kind="stable")
        degree, away, flat = degree[order], distance_m[part][order], floor[part][order]
        if not flat.any():
            continue
        begins = np.ones(len(degree), dtype=bool)
        rows_m = _GAP * _ROW_RAD * (away[1:] ** 2 / _CAMERA_M + _CAMERA_M)
        begins[1:] = (degree[1:] != degree[:-1]) | ~flat[:-1] | (np.diff(away) > rows_m)
        begins &= flat
        ends = np.append(begins[1:] | ~flat[1:], True) & flat
        first, last = np.flatnonzero(begins), np.flatnonzero(ends)
        long = last > first
        first, last = first[long], last[long]
        runs.extend(
            np.stack([(degree[first] + more) % 360, away[first], away[last]], axis=1) for more in range(width_deg)
        )
    if not runs:
        return b""
    found = np.concatenate(runs)
    data: bytes = np.round(found * (1.0, 1000.0, 1000.0)).astype("<u2").tobytes()
    return data
