"""Map of the floor around the robot: free, occupied, or not seen yet.

An evidence grid in the odometry frame (derived from occupancy grids, Elfes 1989). Points above the floor increase the
evidence of their cells, and the map keeps the heights between which they were seen. Evidence decreases where it is
contradicted: free floor is seen in the cell of low evidence, or the depth image looks through the cell at the heights
of the evidence. So what has moved leaves nothing behind, and what stands above the floor stays.
Known objects do not enter: the memory has their places. The map moves with the robot; cells beyond its edge are
dropped.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, sin
from typing import NamedTuple

import cv2
import numpy as np

from cocoro.arrays import BoolArray, FloatArray, IntArray
from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.messages import Obstacles
from cocoro.units import Vec3
from services.planning.seen_through import NEAR_FLOOR_M, DepthView

CELL_M = 0.05
SIZE = 160
"""Cells along each side: 8 m."""
_HIT, _FREE, _MOST, _LEAST, _OCCUPIED = 2, 1, 8, -4, 4
_EDGE_CELLS = 40
"""The map moves when the robot is nearer to its edge than this."""
_SPREAD_RAD = np.radians((-2 / 3, 0.0, 2 / 3))
_EMPTY_NS = NS // 2
"""Where the depth image has no data in place of what stood there, evidence decreases once in this time."""
_OLD_NS = 120 * NS
"""Evidence that nothing has confirmed for so long is dropped, and its cell counts as not seen."""
_TOUCHED_NS = 20 * NS
"""What the bumper touched stays for so long whatever is seen there: the camera may not see it."""
_MARGIN_M = 0.06
"""Margin about a known object for the cells' size, the depth's noise, and the error of its place."""


class Solid(NamedTuple):
    """A known object where it was seen."""

    place_m: Vec3
    """Its centre, odometry frame."""
    radius_m: float
    height_m: float

    def holds(self, places_m: FloatArray, lowest_m: FloatArray, highest_m: FloatArray) -> BoolArray:
        """Mark the things at places (n, 2), odometry frame, m, between two heights (n,) that are part of it; (n,)."""
        x, y, z = self.place_m
        half_m = self.height_m / 2 + _MARGIN_M
        beside: BoolArray = np.hypot(places_m[:, 0] - x, places_m[:, 1] - y) < self.radius_m + _MARGIN_M
        return beside & (lowest_m > z - half_m) & (highest_m < z + half_m)


class FloorMap:
    def __init__(self) -> None:
        self._evidence = np.zeros((SIZE, SIZE), dtype=np.int8)
        self._looked = np.zeros((SIZE, SIZE), dtype=bool)
        self._lowest, self._highest = np.zeros((2, SIZE, SIZE))
        """Heights between which the evidence was seen, m."""
        self._confirmed_ns = np.zeros((SIZE, SIZE), dtype=np.int64)
        self._now_ns = 0
        self._corner = np.array([-SIZE // 2, -SIZE // 2])
        """Index of the array's first cell, counted in cells from the odometry frame's origin."""
        self.changes = 0
        """Number of updates."""

    def clear(self) -> None:
        self._evidence[:] = 0
        self._looked[:] = False
        self._confirmed_ns[:] = 0
        self.changes += 1

    # --- updates ----------------------------------------------------------------------------------

    def enter(
        self,
        seen: Obstacles,
        body: Pose2,
        own: tuple[FloatArray, FloatArray] | None,
        known: Sequence[Solid] = (),
        view: DepthView | None = None,
    ) -> None:
        """Enter one depth image's floor and obstacles, seen from the body's pose in the odometry frame.

        `own`: centres (n, 3) and radii (n,) of the robot's own hull, body frame, metres; points inside are dropped.
        `known`: known objects; what the map shows of them is dropped. `view`: the image itself.
        """
        self._follow(body)
        empty_due = seen.stamp_ns // _EMPTY_NS != self._now_ns // _EMPTY_NS
        self._now_ns = seen.stamp_ns
        origin = np.array(body.apply((*seen.origin_m, 0.0))[:2])
        if seen.free:
            # Thin things are seen by the image itself; without it they must do with the floor around them.
            up_to_m = NEAR_FLOOR_M if view is not None else np.inf
            self._free(self._crossed(np.array(seen.free), origin, body.yaw_rad), up_to_m)
        if seen.points_m:
            points = np.array(seen.points_m)
            lowest = np.array(seen.lowest_m) if len(seen.lowest_m) == len(points) else points[:, 2]
            if own is not None:
                others = ~inside(points, *own)
                points, lowest = points[others], lowest[others]
            c, s = cos(body.yaw_rad), sin(body.yaw_rad)
            places = points[:, :2] @ np.array([[c, s], [-s, c]]) + np.array([body.x_m, body.y_m])
            strange = np.ones(len(points), dtype=bool)
            for solid in known:
                strange &= ~solid.holds(places, lowest, points[:, 2])
            self._hit(places[strange], lowest[strange], points[strange, 2])
        self._doubt(body, known, view, empty_due=empty_due)
        self.changes += 1

    def _hit(self, places_m: FloatArray, lowest_m: FloatArray, highest_m: FloatArray) -> None:
        """Add evidence at places (n, 2), odometry frame, between two heights (n,)."""
        index = self._index(places_m)
        inside = ((index >= 0) & (index < SIZE)).all(axis=1)
        rows, columns = index[inside].T
        fresh = self._evidence[rows, columns] <= 0
        self._lowest[rows[fresh], columns[fresh]], self._highest[rows[fresh], columns[fresh]] = np.inf, -np.inf
        np.minimum.at(self._lowest, (rows, columns), lowest_m[inside])
        np.maximum.at(self._highest, (rows, columns), highest_m[inside])
        self._confirmed_ns[rows, columns] = np.maximum(self._confirmed_ns[rows, columns], self._now_ns)
        self._add(places_m, _HIT)

    def _free(self, cells: IntArray, up_to_m: float) -> None:
        """Decrease the evidence of cells in which floor is seen (flat numbers, each once), unless it begins above the
        floor or reaches higher than `up_to_m`."""
        evidence, lowest, highest = (array.reshape(-1) for array in (self._evidence, self._lowest, self._highest))
        above = (lowest[cells] > NEAR_FLOOR_M) | (highest[cells] > up_to_m)
        above |= self._confirmed_ns.reshape(-1)[cells] > self._now_ns
        above &= evidence[cells] > 0
        flat = cells[~above]
        evidence[flat] = np.maximum(evidence[flat] - _FREE, _LEAST)
        self._looked.reshape(-1)[cells] = True

    def _doubt(self, body: Pose2, known: Sequence[Solid], view: DepthView | None, *, empty_due: bool) -> None:
        """Decrease evidence that this image contradicts, and drop that of known objects and what is old."""
        rows, columns = np.nonzero(self._evidence > 0)
        places = ((np.stack([rows, columns], axis=1) + self._corner) + 0.5) * CELL_M
        lowest, highest = self._lowest[rows, columns], self._highest[rows, columns]
        for solid in known:
            theirs = solid.holds(places, lowest, highest)
            self._evidence[rows[theirs], columns[theirs]] = 0
            self._confirmed_ns[rows[theirs], columns[theirs]] = 0
        age_ns = self._now_ns - self._confirmed_ns[rows, columns]
        old = age_ns > _OLD_NS
        self._evidence[rows[old], columns[old]] = 0
        self._looked[rows[old], columns[old]] = False
        if view is None:
            return
        c, s = cos(body.yaw_rad), sin(body.yaw_rad)
        here = (places - np.array([body.x_m, body.y_m])) @ np.array([[c, -s], [s, c]])
        through = view.look(here, lowest, highest)
        less = (through.gone | (through.empty & empty_due)) & (age_ns > 0)
        self._evidence[rows[less], columns[less]] = np.maximum(self._evidence[rows[less], columns[less]] - _FREE, 0)

    def bump(self, places_m: Sequence[tuple[float, float]], height_m: float | None = None) -> None:
        """Mark places (odometry frame) as occupied because the robot touched something there.

        `height_m`: of the touch, where it is only concluded, as that of a held-up arm is; what is seen there may
        contradict it at once. None: of the bumper.
        """
        places, height = np.array(places_m), np.full(len(places_m), height_m or 0.0)
        for _ in range(3):
            self._hit(places, height, height)
        if height_m is None:
            index = self._index(places)
            rows, columns = index[((index >= 0) & (index < SIZE)).all(axis=1)].T
            self._confirmed_ns[rows, columns] = self._now_ns + _TOUCHED_NS
        self.changes += 1

    def pass_over(self, place_m: tuple[float, float]) -> None:
        """Count the floor within 10 cm of a place (odometry frame) as seen."""
        self._looked |= self._disc(*place_m, 0.10)

    def _crossed(self, rays: FloatArray, origin: FloatArray, yaw_rad: float) -> IntArray:
        """The map's cells along the rays (m, 3): bearing rad, near m, far m, from a place in the odometry frame; flat
        numbers. A ray stands for 2 degrees, so it is spread, or cells between two rays would be left out."""
        rays = np.repeat(rays, len(_SPREAD_RAD), axis=0)
        rays[:, 0] += np.tile(_SPREAD_RAD, len(rays) // len(_SPREAD_RAD))
        # A ray that is longer than the map's diagonal, by whatever mistake, must not take memory for its length.
        steps = np.arange(0.0, min(float(rays[:, 2].max()), 1.5 * SIZE * CELL_M), CELL_M)
        ray, step = np.nonzero((steps >= rays[:, 1:2]) & (steps <= rays[:, 2:3]))
        bearing, away = rays[:, 0] + yaw_rad, steps[step]
        row, column = (
            np.floor((start + direction[ray] * away) / CELL_M).astype(np.int64) - first
            for start, direction, first in zip(origin, (np.cos(bearing), np.sin(bearing)), self._corner, strict=True)
        )
        inside = (row >= 0) & (row < SIZE) & (column >= 0) & (column < SIZE)
        crossed = np.zeros(SIZE * SIZE, dtype=bool)
        crossed[row[inside] * SIZE + column[inside]] = True
        return np.flatnonzero(crossed)

    def _add(self, points_m: FloatArray, evidence: int) -> None:
        """Add evidence to the cells of points (n, 2), once per cell."""
        index = self._index(points_m)
        index = index[((index >= 0) & (index < SIZE)).all(axis=1)]
        flat = index[:, 0] * SIZE + index[:, 1]
        cells = self._evidence.reshape(-1)
        # A cell that has several points is written several times, with the same value.
        cells[flat] = np.clip(cells[flat] + evidence, _LEAST, _MOST)
        self._looked.reshape(-1)[flat] = True

    def _follow(self, body: Pose2) -> None:
        at = self._index(np.array([[body.x_m, body.y_m]]))[0]
        if ((at >= _EDGE_CELLS) & (at < SIZE - _EDGE_CELLS)).all():
            return
        shift = at - SIZE // 2
        to, source = overlap(-shift)
        for cells in (self._evidence, self._looked, self._lowest, self._highest, self._confirmed_ns):
            moved = np.zeros_like(cells)
            moved[to] = cells[source]
            cells[:] = moved
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

    def taller(self, points_m: FloatArray) -> BoolArray:
        """Mark the points (n, 3), odometry frame, m, where something was seen to reach higher; returns shape (n,)."""
        index = self._index(points_m)
        inside = ((index >= 0) & (index < SIZE)).all(axis=1)
        taller = np.zeros(len(index), dtype=bool)
        rows, columns = index[inside].T
        stands = self._evidence[rows, columns] >= _OCCUPIED
        taller[inside] = stands & (self._highest[rows, columns] > points_m[inside, 2] - CELL_M / 2)
        return taller

    def looked_at(self) -> BoolArray:
        """Cells that were seen, (SIZE, SIZE)."""
        return self._looked

    def add_discs(self, cells: BoolArray, discs: Sequence[tuple[float, float, float]]) -> BoolArray:
        """The cells (SIZE, SIZE) with discs (x, y, radius), odometry frame, metres, added."""
        for x, y, radius in discs:
            disc = self._disc(x, y, radius)
            if not disc.any() and (cell := self.cell(x, y)) is not None:
                disc[cell] = True  # a thin thing may stand between the centres of all cells
            cells = cells | disc
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


def inside(points: FloatArray, centres: FloatArray, radii: FloatArray) -> BoolArray:
    """Mark the points (n, 3) that lie, seen from above, within any of the balls (m, 3), (m,); returns shape (n,)."""
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
