"""The floor that the camera saw, by the simulator's truth. A search's statements about the floor are judged by it."""

from __future__ import annotations

from math import cos, sin

import cv2
import msgspec
import numpy as np

from cocoro.arrays import BoolArray, FloatArray
from cocoro.clock import NS
from cocoro.messages import TrueObject, Truth
from cocoro.robot import Robot
from sim.rigid import rotation
from sim.scene import Obstacle, Scene, SceneObject

CELL_M = 0.05
EVERY_NS = NS // 10
BODY_ROOM_M = 0.04
"""Least distance between the body and obstacles at a pose that the robot can take."""
POSES_M = 0.10
"""Distance between the poses that are tried for a cell that was not seen."""
EYE_M = 0.73
"""Height of the camera above the floor at these poses."""
LEAST_M = 0.25
"""From nearer the camera does not see the floor."""


class Coverage(msgspec.Struct, frozen=True, kw_only=True):
    """Cells of 5 cm of the floor about the robot's first place, except those under obstacles and objects."""

    radius_m: float
    cells: int
    seen: int
    """The camera had the cell's centre in its picture, in its depth range and not hidden, or the body stood on it."""
    unseeable: int
    """Not seen, and not visible from any pose that the robot could have reached."""
    missed: int
    """Not seen, though a pose would have shown it."""
    hiding: int
    """Missed cells in squares of two by two that were all missed: an object can stand there unseen."""
    missed_at_m: tuple[tuple[float, float], ...]
    """Some of the missed cells, in the robot's frame at the start."""


class CoverageJudge:
    """Feed it every truth from the begin of the search on. Of the robot's own parts only the camera's mount hides
    floor."""

    def __init__(self, robot: Robot, scene: Scene, radius_m: float) -> None:
        self._robot, self._scene, self._radius_m = robot, scene, radius_m
        self._chain = robot.camera_chain
        self._depth_offset_m = np.array(robot.eye.depth_offset_m)
        self._start: FloatArray | None = None
        self._cells_m = np.zeros((0, 2))
        self._seen = np.zeros(0, dtype=bool)
        self._due_ns: int | None = None
        self._newest: Truth | None = None

    def feed(self, truth: Truth) -> None:
        if self._due_ns is not None and 0 <= truth.stamp_ns - self._due_ns + EVERY_NS < EVERY_NS:
            return
        self._due_ns = truth.stamp_ns + EVERY_NS
        self._newest = truth
        if self._start is None:
            self._begin(truth)
        left = np.flatnonzero(~self._seen)
        if len(left):
            self._seen[left] = self._sees(truth, self._cells_m[left])

    def _begin(self, truth: Truth) -> None:
        steps = np.arange(-self._radius_m, self._radius_m + CELL_M, CELL_M)
        x, y = (part.reshape(-1) for part in np.meshgrid(steps, steps, indexing="ij"))
        inside = np.hypot(x, y) <= self._radius_m
        self._start = np.array([*truth.body_m[:2], _yaw(truth)])
        self._cells_m = np.stack([x[inside], y[inside]], axis=1) + self._start[:2]
        covered = np.zeros(len(self._cells_m), dtype=bool)
        for item in truth.objects:
            covered |= _stands_on(self._solid(item), item, self._cells_m, 0.0)
        self._cells_m = self._cells_m[~covered]
        self._seen = np.zeros(len(self._cells_m), dtype=bool)

    def _solid(self, item: TrueObject) -> SceneObject | Obstacle:
        if item.kind == "object":
            return self._scene.object(item.label)
        return self._scene.obstacles[int(item.label.removeprefix("obstacle_")) - 1]

    def _sees(self, truth: Truth, cells_m: FloatArray) -> BoolArray:
        """Mark the places on the floor (n, 2), world frame, m, that are seen now; returns shape (n,)."""
        body = np.eye(4)
        body[:3, :3] = rotation(truth.body_orientation)
        body[:3, 3] = truth.body_m
        pose: FloatArray = body @ self._chain.pose(truth.joints_rad)
        eye = pose[:3, 3] + pose[:3, :3] @ self._depth_offset_m
        points = np.column_stack([cells_m, np.zeros(len(cells_m))])
        local = (points - eye) @ pose[:3, :3]
        z = np.maximum(local[:, 2], 1e-6)
        camera, kinect = self._robot.camera, self._robot.eye
        u, v = camera.cx + camera.fx * local[:, 0] / z, camera.cy + camera.fy * local[:, 1] / z
        seen: BoolArray = (local[:, 2] >= kinect.min_range_m) & (local[:, 2] <= kinect.max_range_m)
        seen &= (u >= 0) & (u <= camera.width - 1) & (v >= 0) & (v <= camera.height - 1)
        shown = np.flatnonzero(seen)
        seen[shown] = ~self._hidden(truth, eye, points[shown])
        if kinect.mount is not None:
            low, high = np.array(kinect.mount)
            turn = body[:3, :3]
            shown = np.flatnonzero(seen)
            seen[shown] = ~_meets_box(
                (eye - body[:3, 3]) @ turn, (points[shown] - body[:3, 3]) @ turn, (low + high) / 2, (high - low) / 2
            )
        under: BoolArray = np.hypot(*(cells_m - body[:2, 3]).T) <= self._robot.base.chassis_diameter_m / 2
        return seen | under

    def _hidden(self, truth: Truth, eye: FloatArray, points: FloatArray) -> BoolArray:
        """Mark the points (n, 3), world frame, m, that something hides from a place (3,); returns shape (n,)."""
        hidden = np.zeros(len(points), dtype=bool)
        for item in truth.objects:
            solid = self._solid(item)
            turn, centre = rotation(item.orientation), np.array(item.position_m)
            one, others = (eye - centre) @ turn, (points - centre) @ turn
            sizes = solid.dimensions_m
            if solid.shape == "box":
                hidden |= _meets_box(one, others, np.zeros(3), np.array(sizes) / 2)
            elif solid.shape == "cylinder":
                hidden |= _meets_post(one, others, sizes[0], sizes[1] / 2)
            else:
                hidden |= _meets_post(one, others, sizes[0], sizes[0])
        return hidden

    def result(self) -> Coverage | None:
        """None without a truth."""
        if self._newest is None or self._start is None:
            return None
        left = self._cells_m[~self._seen]
        seeable = self._seeable(left)
        c, s = cos(self._start[2]), sin(self._start[2])
        missed = (left[seeable] - self._start[:2]) @ np.array([[c, -s], [s, c]])
        return Coverage(
            radius_m=self._radius_m,
            cells=len(self._cells_m),
            seen=int(self._seen.sum()),
            unseeable=int((~seeable).sum()),
            missed=int(seeable.sum()),
            hiding=_in_squares(left[seeable] - self._start[:2]),
            missed_at_m=tuple((round(x, 2), round(y, 2)) for x, y in missed[:: max(len(missed) // 12, 1)].tolist()),
        )

    def _seeable(self, cells_m: FloatArray) -> BoolArray:
        """Mark the cells (n, 2), world frame, m, that a pose within the robot's reach would show; shape (n,)."""
        assert self._newest is not None
        assert self._start is not None
        seeable = np.zeros(len(cells_m), dtype=bool)
        if not len(cells_m):
            return seeable
        reach_m = self._radius_m + 1.0
        steps = np.arange(-reach_m, reach_m + POSES_M, POSES_M)
        grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
        places = grid.reshape(-1, 2) + self._start[:2]
        room_m = self._robot.base.chassis_diameter_m / 2 + BODY_ROOM_M
        free = np.ones(len(places), dtype=bool)
        for item in self._newest.objects:
            free &= ~_stands_on(self._solid(item), item, places, room_m)
        free[np.hypot(*(places - self._start[:2]).T) <= POSES_M] = True
        _, parts = cv2.connectedComponents(free.reshape(grid.shape[:2]).astype(np.uint8), connectivity=4)
        middle = len(steps) // 2
        reached = places[(parts == parts[middle, middle]).reshape(-1)]
        for place in reached:
            left = np.flatnonzero(~seeable)
            away = np.hypot(*(cells_m[left] - place).T)
            left = left[(away >= LEAST_M) & (away <= self._robot.eye.max_range_m - 0.2)]
            points = np.column_stack([cells_m[left], np.zeros(len(left))])
            seeable[left] = ~self._hidden(self._newest, np.array([*place, EYE_M]), points)
        return seeable


def _in_squares(cells_m: FloatArray) -> int:
    """The number of cells of (n, 2) that belong to a square of two by two."""
    cells = {(x, y) for x, y in np.rint(cells_m / CELL_M).astype(np.int64).tolist()}
    squares = [{(x, y), (x + 1, y), (x, y + 1), (x + 1, y + 1)} for x, y in cells]
    return len(set().union(*(square for square in squares if square <= cells)))


def _yaw(truth: Truth) -> float:
    turn = rotation(truth.body_orientation)
    return float(np.arctan2(turn[1, 0], turn[0, 0]))


def _stands_on(solid: SceneObject | Obstacle, item: TrueObject, places_m: FloatArray, room_m: float) -> BoolArray:
    """Mark the places (n, 2), world frame, m, that are nearer than `room_m` to the floor under a thing; (n,)."""
    x, y, z = item.position_m
    sizes = solid.dimensions_m
    if z > solid.standing_height_m + 0.3:  # it hangs in the air
        return np.zeros(len(places_m), dtype=bool)
    away = places_m - np.array([x, y])
    if solid.shape != "box":
        return np.asarray(np.hypot(*away.T) <= sizes[0] + room_m)
    turn = rotation(item.orientation)[:2, :2]
    beyond = np.maximum(np.abs(away @ turn) - np.array(sizes[:2]) / 2, 0.0)
    return np.asarray(np.hypot(*beyond.T) <= room_m)


def _meets_box(eye: FloatArray, points: FloatArray, centre: FloatArray, half: FloatArray) -> BoolArray:
    """Whether the lines from `eye` (3,) to points (n, 3) meet a box, all in its directions (Kay and Kajiya 1986)."""
    way = points - eye
    way = np.where(np.abs(way) < 1e-9, 1e-9, way)
    one, other = (centre - half - eye) / way, (centre + half - eye) / way
    first, last = np.minimum(one, other).max(axis=1), np.maximum(one, other).min(axis=1)
    return np.asarray((first < last) & (last > 0.0) & (first < 1.0 - 1e-3))


def _meets_post(eye: FloatArray, points: FloatArray, radius_m: float, half_height_m: float) -> BoolArray:
    """Whether the lines from `eye` (3,) to points (n, 3) meet an upright cylinder about the origin."""
    way = points - eye
    level2 = np.maximum((way[:, :2] ** 2).sum(axis=1), 1e-12)
    nearest = -(way[:, :2] @ eye[:2]) / level2
    miss2 = ((eye[:2] + nearest[:, None] * way[:, :2]) ** 2).sum(axis=1)
    half = np.sqrt(np.maximum(radius_m**2 - miss2, 0.0) / level2)
    first, last = np.clip(nearest - half, 0.0, 1.0 - 1e-3), np.clip(nearest + half, 0.0, 1.0 - 1e-3)
    heights = eye[2] + np.stack([first, last]) * way[:, 2]
    level = (heights.min(axis=0) < half_height_m) & (heights.max(axis=0) > -half_height_m)
    return np.asarray((miss2 < radius_m**2) & (first < last) & level)
