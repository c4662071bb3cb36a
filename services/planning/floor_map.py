"""Map of the floor around the robot: free, occupied, or not seen yet.

An evidence grid in the odometry frame (derived from occupancy grids, Elfes 1989): rays over free floor decrease the
evidence of their cells, points above the floor increase it. The map moves with the robot; cells beyond its edge are
dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin

import cv2
import numpy as np

from cocoro.arrays import BoolArray, FloatArray, IntArray
from cocoro.frames import Pose2
from cocoro.messages import Obstacles

CELL_M = 0.05
SIZE = 160
"""Cells along each side: 8 m."""
_HIT, _FREE, _MOST, _LEAST, _OCCUPIED = 2, 1, 8, -4, 4
_EDGE_CELLS = 40
"""The map moves when the robot is nearer to its edge than this."""


class FloorMap:
    def __init__(self) -> None:
        self._evidence = np.zeros((SIZE, SIZE), dtype=np.int8)
        self._looked = np.zeros((SIZE, SIZE), dtype=bool)
        self._corner = np.array([-SIZE // 2, -SIZE // 2])
        """Index of the array's first cell, counted in cells from the odometry frame's origin."""
        self.changes = 0
        """Number of updates."""

    def clear(self) -> None:
        self._evidence[:] = 0
        self._looked[:] = False
        self.changes += 1

    # --- updates ----------------------------------------------------------------------------------

    def enter(self, seen: Obstacles, body: Pose2, own: tuple[FloatArray, FloatArray] | None) -> None:
        """Enter one depth image's floor and obstacles, seen from the body's pose in the odometry frame.

        `own`: centres (n, 3) and radii (n,) of the robot's own hull, body frame, metres; points inside are dropped.
        """
        self._follow(body)
        origin = np.array(body.apply((*seen.origin_m, 0.0))[:2])
        if seen.free:
            self._add(self._along(np.array(seen.free), origin, body.yaw_rad), -_FREE)
        if seen.points_m:
            points = np.array(seen.points_m)
            if own is not None:
                points = points[~_inside(points, *own)]
            c, s = cos(body.yaw_rad), sin(body.yaw_rad)
            turned = points[:, :2] @ np.array([[c, s], [-s, c]])
            self._add(turned + np.array([body.x_m, body.y_m]), _HIT)
        self.changes += 1

    def bump(self, places_m: Sequence[tuple[float, float]]) -> None:
        """Mark places (odometry frame) as occupied because the robot touched something there."""
        for _ in range(3):
            self._add(np.array(places_m), _HIT)
        self.changes += 1

    def pass_over(self, place_m: tuple[float, float]) -> None:
        """Count the floor within 10 cm of a place (odometry frame) as seen."""
        self._looked |= self._disc(*place_m, 0.10)

    @staticmethod
    def _along(rays: FloatArray, origin: FloatArray, yaw_rad: float) -> FloatArray:
        """Points (n, 2), odometry frame, every cell along the rays (m, 3): bearing rad, near m, far m."""
        steps = np.arange(0.0, float(rays[:, 2].max()), CELL_M)
        inside = (steps[None, :] >= rays[:, 1:2]) & (steps[None, :] <= rays[:, 2:3])
        directions = np.stack([np.cos(rays[:, 0] + yaw_rad), np.sin(rays[:, 0] + yaw_rad)], axis=1)
        points: FloatArray = (origin + directions[:, None, :] * steps[None, :, None])[inside]
        return points

    def _add(self, points_m: FloatArray, evidence: int) -> None:
        """Add evidence to the cells of points (n, 2), once per cell."""
        index = self._index(points_m)
        index = index[((index >= 0) & (index < SIZE)).all(axis=1)]
        flat = np.unique(index[:, 0] * SIZE + index[:, 1])
        cells = self._evidence.reshape(-1)
        cells[flat] = np.clip(cells[flat] + evidence, _LEAST, _MOST)
        self._looked.reshape(-1)[flat] = True

    def _follow(self, body: Pose2) -> None:
        at = self._index(np.array([[body.x_m, body.y_m]]))[0]
        if ((at >= _EDGE_CELLS) & (at < SIZE - _EDGE_CELLS)).all():
            return
        shift = at - SIZE // 2
        evidence, looked = np.zeros_like(self._evidence), np.zeros_like(self._looked)
        to, source = overlap(-shift)
        evidence[to] = self._evidence[source]
        looked[to] = self._looked[source]
        self._evidence, self._looked = evidence, looked
        self._corner = self._corner + shift

    # --- queries ---------------------------------------------------------------------------------

    def _index(self, points_m: FloatArray) -> IntArray:
        index: IntArray = np.floor(np.asarray(points_m)[:, :2] / CELL_M).astype(np.int64) - self._corner
        return index

    @property
    def corner(self) -> IntArray:
        """Index of the map's first cell, (2,), counted in cells from the odometry frame's origin."""
        return self._corner

    def centre(self, row: int, column: int) -> tuple[float, float]:
        """A cell's centre (x, y), odometry frame, metres."""
        x, y = ((np.array([row, column]) + self._corner) + 0.5) * CELL_M
        return float(x), float(y)

    def cell(self, x_m: float, y_m: float) -> tuple[int, int] | None:
        """The (row, column) of a place, odometry frame; None beyond the map."""
        row, column = self._index(np.array([[x_m, y_m]]))[0]
        return (int(row), int(column)) if 0 <= row < SIZE and 0 <= column < SIZE else None

    def occupied(self, ignore: Sequence[tuple[float, float, float]] = ()) -> BoolArray:
        """Occupied cells, (SIZE, SIZE), rows along x. Discs (x, y, radius) in `ignore` (metres) count as free."""
        cells: BoolArray = self._evidence >= _OCCUPIED
        for x, y, radius in ignore:
            cells &= ~self._disc(x, y, radius)
        return cells

    def looked_at(self) -> BoolArray:
        """Cells that were seen, (SIZE, SIZE)."""
        return self._looked

    def add_discs(self, cells: BoolArray, discs: Sequence[tuple[float, float, float]]) -> BoolArray:
        """The cells (SIZE, SIZE) with discs (x, y, radius), odometry frame, metres, added."""
        for x, y, radius in discs:
            cells = cells | self._disc(x, y, radius)
        return cells

    def _disc(self, x_m: float, y_m: float, radius_m: float) -> BoolArray:
        rows = (np.arange(SIZE) + self._corner[0] + 0.5) * CELL_M - x_m
        columns = (np.arange(SIZE) + self._corner[1] + 0.5) * CELL_M - y_m
        disc: BoolArray = rows[:, None] ** 2 + columns[None, :] ** 2 <= radius_m**2
        return disc


class ClearanceField:
    """Distance from any place to the nearest occupied cell (`metres`, (SIZE, SIZE))."""

    def __init__(self, floor: FloorMap, occupied: BoolArray) -> None:
        self._floor = floor
        free = (~occupied).astype(np.uint8)
        distance = cv2.distanceTransform(free, cv2.DIST_L2, cv2.DIST_MASK_PRECISE) if occupied.any() else None
        self.metres: FloatArray = (
            np.full((SIZE, SIZE), 9.0)
            if distance is None
            # Distances between cell centres, less half the occupied cell.
            else np.maximum(np.asarray(distance, dtype=np.float64) * CELL_M - CELL_M / 2, 0.0)
        )

    def at(self, places_m: FloatArray) -> FloatArray:
        """Distances (n,), metres, at places (n, 2), odometry frame; 9 m beyond the map."""
        index = self._floor._index(places_m)
        inside = ((index >= 0) & (index < SIZE)).all(axis=1)
        clearance = np.full(len(index), 9.0)
        clearance[inside] = self.metres[index[inside, 0], index[inside, 1]]
        return clearance


def _inside(points: FloatArray, centres: FloatArray, radii: FloatArray) -> BoolArray:
    """Which points (n, 3) lie within any of the balls (m, 3), (m,) seen from above, shape (n,)."""
    gaps = np.linalg.norm(points[:, None, :2] - centres[None, :, :2], axis=2) - radii[None, :]
    inside: BoolArray = (gaps < 0.0).any(axis=1)
    return inside


def overlap(shift: IntArray) -> tuple[tuple[slice, slice], tuple[slice, slice]]:
    """Destination and source slices for an array that moves by `shift` (2,) cells."""
    to, source = [], []
    for step in shift:
        step = int(step)
        to.append(slice(max(step, 0), max(SIZE + min(step, 0), 0)))
        source.append(slice(max(-step, 0), max(SIZE - max(step, 0), 0)))
    return (to[0], to[1]), (source[0], source[1])
