"""The floor that a search has seen, and the places from which the rest can be seen.

A cell counts as seen when floor was measured in it from near enough, twice, while the head hardly turned: then an
object there would have been found. Beside a wall no cell is sure: when all else was seen, the search looks at each
wall's foot from its own side. Places to look from are rated by casting rays through the floor map (next best view,
Connolly 1985; derived): things are opaque, and so is unseen floor beyond a margin.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, degrees, hypot
from typing import NamedTuple, TypeVar

import cv2
import numpy as np

from cocoro.arrays import BoolArray, FloatArray, IntArray
from cocoro.frames import Pose2
from cocoro.messages import Obstacles
from cocoro.robot import Robot
from services.planning.config import SearchConfig
from services.planning.floor_map import CELL_M, SIZE, FloorMap, overlap
from services.planning.gaze import Gaze
from services.planning.wall_feet import ANYWHERE, own_sides, sector

_STRETCH_BYTES = 6
_DOUBT = np.ones((3, 3), dtype=np.uint8)
"""A cell at the edge of what a scan shows does not count: the body's pose is off by a few centimetres."""
_SPREAD_DEG = (0.25, 0.75)
"""A stretch is a degree wide."""
_ENOUGH = 2
"""Scans that must show a cell's floor."""
_PATIENCE = 2
"""Looks that should have shown a cell and did not, after which it is given up."""
_BESIDE_CELLS = 2
"""Cells about an obstacle that belong to it: the map shows only what faces the robot."""
_FOOT_M = 3.0
"""Distance up to which the foot of a wall counts as seen."""
_ROW_RAD, _CAMERA_M = 0.0125, 0.73
"""Angle between two rows of a depth image's points, and the camera's height: shown floor ends up to a row before it
ends."""
_RAYS, _FINE_RAYS, _STEP_M = 120, 540, 0.075
_CORNER_CELLS = 4
"""Candidates are so many cells apart."""
_OPAQUE_CELLS = 1
_APART_M = 0.18
"""Places to look from are further than this from those that were looked from."""
_NEAREST_M = 0.30
"""Nearer floor is not visible from a place: the body hides it."""
_NEAR_M, _NEAR_SHARE = 1.0, 0.5
"""Floor nearer than this to a place to look from counts by this share."""
_TRIED = 12
"""The best places by coarse rays; the first of them that also shows something by fine rays is taken."""
_AREA_M2 = CELL_M**2

_Cells = TypeVar("_Cells", FloatArray, BoolArray)


class Viewpoint(NamedTuple):
    """A place to look from, odometry frame, m."""

    place_m: tuple[float, float]
    gain_m2: float
    """Unseen floor that can be seen from there."""
    middle_m: tuple[float, float]
    """The middle of that floor."""


class Rest(NamedTuple):
    """The floor within the search's radius that was not seen."""

    open_m2: float
    patches: tuple[tuple[float, float, float], ...]
    """Size, m2, and middle, odometry frame, m, of each patch that is not enclosed; the largest first."""
    enclosed_m2: float
    """Floor that obstacles enclose on all sides."""


class SeenFloor:
    """The seen floor of one search. Arrays have the shape (SIZE, SIZE), rows along x, and stay where they began."""

    def __init__(self, config: SearchConfig, robot: Robot, gaze: Gaze) -> None:
        self._config, self._gaze = config, gaze
        self._body_m, self._sight_m = robot.base.chassis_diameter_m / 2, min(config.sight_m, gaze.farthest_m)
        self._count, self._missed = (np.zeros((SIZE, SIZE), dtype=np.int8) for _ in range(2))
        self._from = np.zeros((SIZE, SIZE), dtype=np.int64)
        """The sectors (bits) from which a cell was seen."""
        self._feet = False
        """Whether the feet of obstacles are looked at, too: all other floor was seen."""
        self._doubt_m = np.full((SIZE, SIZE), np.inf)
        """By how much a cell's place was in doubt at the best of the scans that showed it."""
        self._corner: IntArray = np.zeros(2, dtype=np.int64)
        self._centre_m: tuple[float, float] | None = None
        self._avoided: list[tuple[float, float]] = []
        self.task_id = ""
        self.running = False
        """Whether a search goes on."""
        self.scans = 0
        """Depth images that this search has entered."""

    # --- updates ----------------------------------------------------------------------------------

    def end(self, task_id: str) -> None:
        """End the search; `task_id`: the task that goes on or begins."""
        self.running = False
        if task_id != self.task_id:
            self.task_id, self._centre_m = task_id, None

    def begin(self, body: Pose2) -> None:
        """Begin a search. It goes about the place where the task's first search began."""
        self.running = True
        if self._centre_m is None:
            self._centre_m = body.x_m, body.y_m
        self._corner = np.floor(np.array(self._centre_m) / CELL_M).astype(np.int64) - SIZE // 2
        self._count[:] = 0
        self._missed[:] = 0
        self._from[:] = 0
        self._feet = False
        self._doubt_m[:] = np.inf
        self.scans = 0
        self._avoided.clear()

    def clear(self) -> None:
        """Forget everything: the odometry frame is a new one."""
        self.running, self._centre_m = False, None

    def enter(self, seen: Obstacles, body: Pose2, turning_radps: float, doubt_m: float = 0.0) -> None:
        """Enter the floor of one depth image, taken from the body's pose while the camera turned at a rate. `doubt_m`:
        how far that floor may be from where it seems to be."""
        if not self.running or not seen.shown or turning_radps > self._config.turning_radps:
            return
        whole = len(seen.shown) // _STRETCH_BYTES * _STRETCH_BYTES
        shown = np.frombuffer(seen.shown[:whole], dtype="<u2").reshape(-1, 3) * (np.pi / 180, 0.001, 0.001)
        rays = np.repeat(shown, len(_SPREAD_DEG), axis=0)
        rays[:, 0] += np.tile(np.radians(_SPREAD_DEG), len(shown))
        rays[:, 0] += body.yaw_rad
        x, y = body.apply((*seen.origin_m, 0.0))[:2]
        cells = self._crossed(x, y, rays, self._config.sight_m)
        sure = cv2.erode(cells.astype(np.uint8), _DOUBT).astype(bool)
        self._doubt_m[sure] = np.minimum(self._doubt_m[sure], doubt_m)
        self._count[sure] = np.minimum(self._count[sure] + 1, _ENOUGH)
        rays[:, 2] += _ROW_RAD * (rays[:, 2] ** 2 / _CAMERA_M + _CAMERA_M)
        rows, columns = np.nonzero(self._crossed(x, y, rays, _FOOT_M))
        away_x, away_y = np.array([[x], [y]]) - (np.stack([rows, columns]) + self._corner[:, None] + 0.5) * CELL_M
        self._from[rows, columns] |= 1 << sector(np.arctan2(away_y, away_x))
        self.scans += 1

    def _crossed(self, x_m: float, y_m: float, rays: FloatArray, up_to_m: float) -> BoolArray:
        """The cells along rays (n, 3) from a place: bearing, rad, odometry frame, and begin and end, m."""
        steps = np.arange(0.0, up_to_m, CELL_M / 2)
        inside = (steps[None, :] >= rays[:, 1:2]) & (steps[None, :] <= rays[:, 2:3])
        flat = self._flat(x_m + (np.cos(rays[:, :1]) * steps)[inside], y_m + (np.sin(rays[:, :1]) * steps)[inside])
        cells = np.zeros(SIZE * SIZE, dtype=bool)
        cells[flat[flat >= 0]] = True
        return cells.reshape(SIZE, SIZE)

    def stand_at(self, body: Pose2) -> None:
        """Count the floor under the body as seen."""
        if self.running:
            self._count[self._disc(body.x_m, body.y_m, self._body_m)] = _ENOUGH

    def looked_from(self, body: Pose2, around: FloorMap, known: Sequence[tuple[float, ...]]) -> None:
        """Note that everything that can be seen from a pose was looked at; what is still unseen may stay hidden."""
        self._missed[self.shown(body, around, known)] += 1
        self.avoid((body.x_m, body.y_m))

    def avoid(self, place_m: tuple[float, float]) -> None:
        """Do not go to look from a place."""
        self._avoided.append(place_m)

    # --- queries ---------------------------------------------------------------------------------

    def unseen(self, around: FloorMap, known: Sequence[tuple[float, ...]]) -> BoolArray:
        """Floor within the radius that an object could stand on unseen, and that was not given up. `known`: discs
        (x, y, radius), odometry frame, m, of known objects."""
        return self._hidden(around, known) & (self._missed < _PATIENCE)

    def shown(self, body: Pose2, around: FloorMap, known: Sequence[tuple[float, ...]]) -> BoolArray:
        """The unseen floor that the camera should see when it looks about from a pose of the body."""
        cells = self.visible((body.x_m, body.y_m), around, known)
        rows, columns = np.nonzero(cells)
        bearing, distance = self.bearings(cells, body).T
        cells[rows, columns] = ~self._gaze.hides(bearing, distance)
        return cells

    def visible(self, place_m: tuple[float, float], around: FloorMap, known: Sequence[tuple[float, ...]]) -> BoolArray:
        """The unseen floor that should be visible from a place, odometry frame, however the robot stands there."""
        bearings = np.linspace(0.0, 2 * np.pi, _FINE_RAYS, endpoint=False)
        steps = np.arange(CELL_M, self._sight_m, CELL_M)
        flat, shown = self._cast(np.array([place_m], dtype=np.float64), bearings, steps, self._things(around, known))
        wanted = self._wanted(around, known).reshape(-1)[flat] & (1 << sector(bearings + np.pi))[:, None] > 0
        cells = np.zeros(SIZE * SIZE, dtype=bool)
        cells[flat[shown & wanted & (flat >= 0)]] = True
        return cells.reshape(SIZE, SIZE)

    @property
    def least_m2(self) -> float:
        """Least floor that is worth a look."""
        return self._config.least_foot_m2 if self._feet else self._config.least_m2

    def viewpoint(
        self, body: Pose2, costs_m: FloatArray, around: FloorMap, known: Sequence[tuple[float, ...]]
    ) -> Viewpoint | None:
        """The place from which the most unseen floor can be seen for the time that it takes to get there; None where
        no reachable place shows any. `costs_m`: length of the way to each cell of the floor map. Where the robot
        stands is such a place, too, if something can be seen when it turns round."""
        view = self._best_view(body, costs_m, around, known)
        if view is None and not self._feet:
            self._feet = True
            view = self._best_view(body, costs_m, around, known)
        return view

    def _best_view(
        self, body: Pose2, costs_m: FloatArray, around: FloorMap, known: Sequence[tuple[float, ...]]
    ) -> Viewpoint | None:
        unseen = self._wanted(around, known)
        if self._centre_m is None or not unseen.any():
            return None
        cost = self._aligned(around, costs_m, beyond=np.inf)
        grid = np.zeros((SIZE, SIZE), dtype=bool)
        grid[::_CORNER_CELLS, ::_CORNER_CELLS] = True
        reach_m = self._config.radius_m + self._config.outside_m
        grid &= np.isfinite(cost) & self._disc(*self._centre_m, reach_m)
        for place in self._avoided:
            grid &= ~self._disc(*place, _APART_M)
        rows, columns = np.nonzero(grid)
        places = np.asarray((np.stack([rows, columns], axis=1) + self._corner + 0.5) * CELL_M)
        bearings = np.linspace(0.0, 2 * np.pi, _RAYS, endpoint=False)
        steps = np.arange(_STEP_M, self._sight_m, _STEP_M)
        flat, shown = self._cast(places, bearings, steps, self._things(around, known))
        # The mount hides what is near, except ahead.
        share = np.where(steps < _NEAR_M, _NEAR_SHARE, 1.0) * steps * (2 * np.pi / _RAYS) * _STEP_M
        towards = (1 << sector(bearings + np.pi))[:, None]
        wanted = (unseen.reshape(-1)[flat] & towards > 0) & (flat >= 0) & shown
        gains = (wanted * share[None, None, :]).sum(axis=(1, 2))
        seconds = cost[rows, columns] / self._config.drive_mps + self._config.look_s
        rate = np.where(gains >= self.least_m2, gains / seconds, 0.0)
        here = (body.x_m, body.y_m)
        cells = self.visible(here, around, known)
        gain = float(cells.sum()) * _AREA_M2
        if gain >= self.least_m2:
            bearing, _ = self.bearings(cells, body).T
            turn = atan2(float(np.sin(bearing).sum()), float(np.cos(bearing).sum()))
            if gain / (abs(turn) / self._config.turn_radps + self._config.look_s) >= rate.max(initial=0.0):
                return Viewpoint(here, gain, self._middle(cells))
        for best in np.argsort(-rate, kind="stable")[:_TRIED]:
            if rate[best] <= 0.0:
                break
            cells = self.visible(_pair(places[best]), around, known)
            gain = float(cells.sum()) * _AREA_M2
            if gain >= self.least_m2:
                return Viewpoint(_pair(places[best]), gain, self._middle(cells))
        return None

    def _middle(self, cells: BoolArray) -> tuple[float, float]:
        return _pair((np.stack(np.nonzero(cells), axis=1).mean(axis=0) + self._corner + 0.5) * CELL_M)

    def rest(self, around: FloorMap, known: Sequence[tuple[float, ...]]) -> Rest:
        """The floor that was not seen, given up or not."""
        hidden = self._hidden(around, known)
        if self._feet:
            hidden |= _large(self._unseen_feet(around) > 0, self.least_m2)
        _, patches, stats, middles = cv2.connectedComponentsWithStats(hidden.astype(np.uint8), connectivity=8)
        seen = np.asarray(self._count >= _ENOUGH)
        found, enclosed = [], 0.0
        for number in range(1, len(stats)):
            patch = patches == number
            area = float(stats[number, cv2.CC_STAT_AREA]) * _AREA_M2
            edge = cv2.dilate(patch.astype(np.uint8), np.ones((3, 3), np.uint8)).astype(bool) & ~patch
            if not (edge & (seen | self._beyond())).any():
                enclosed += area
                continue
            column, row = middles[number]
            x, y = (np.array([row, column]) + self._corner + 0.5) * CELL_M
            found.append((area, float(x), float(y)))
        found.sort(reverse=True)
        return Rest(sum(area for area, _, _ in found), tuple(found), enclosed)

    def doubt_m(self, around: FloorMap, known: Sequence[tuple[float, ...]]) -> float:
        """By how much the place of some floor that was seen is in doubt."""
        seen = (self._count >= _ENOUGH) & ~self._beside(around, known) & ~self._beyond() & np.isfinite(self._doubt_m)
        return float(self._doubt_m[seen].max(initial=0.0))

    def bearings(self, cells: BoolArray, body: Pose2) -> FloatArray:
        """Bearing, rad, and distance, m, of cells, body frame, (n, 2)."""
        rows, columns = np.nonzero(cells)
        x, y = ((np.stack([rows, columns]) + self._corner[:, None] + 0.5) * CELL_M) - np.array([[body.x_m], [body.y_m]])
        bearing = (np.arctan2(y, x) - body.yaw_rad + np.pi) % (2 * np.pi) - np.pi
        return np.stack([bearing, np.hypot(x, y)], axis=1)

    # --- cells ------------------------------------------------------------------------------------

    def _beside(self, around: FloorMap, known: Sequence[tuple[float, ...]]) -> BoolArray:
        wide = np.ones((2 * _BESIDE_CELLS + 1,) * 2, dtype=np.uint8)
        occupied = self._aligned(around, around.occupied(), beyond=False)
        beside = cv2.dilate(occupied.astype(np.uint8), wide).astype(bool)
        for x, y, radius in known:
            beside |= self._disc(x, y, radius + CELL_M / 2)
        return np.asarray(beside)

    def _hidden(self, around: FloorMap, known: Sequence[tuple[float, ...]]) -> BoolArray:
        hidden = (self._count < _ENOUGH) & ~self._beside(around, known) & ~self._beyond()
        # Unseen floor narrower than two cells hides no object.
        block = hidden[:-1, :-1] & hidden[1:, :-1] & hidden[:-1, 1:] & hidden[1:, 1:]
        wide_enough = np.zeros_like(hidden)
        for row in (slice(None, -1), slice(1, None)):
            for column in (slice(None, -1), slice(1, None)):
                wide_enough[row, column] |= block
        return np.asarray(wide_enough)

    def _wanted(self, around: FloorMap, known: Sequence[tuple[float, ...]]) -> IntArray:
        """The sectors (bits) from which each cell is still to be seen."""
        wanted = np.where(self.unseen(around, known), ANYWHERE, 0)
        if self._feet:
            wanted |= np.where(self._missed < _PATIENCE, self._unseen_feet(around), 0)
        return wanted

    def _unseen_feet(self, around: FloorMap) -> IntArray:
        """The sectors (bits) from which the floor beside obstacles must be seen and was not: those on its side."""
        own = own_sides(self._aligned(around, around.occupied(), beyond=False), _OPAQUE_CELLS)
        return np.where(~self._beyond() & (self._from & own == 0), own, 0)

    def _beyond(self) -> BoolArray:
        assert self._centre_m is not None
        return ~self._disc(*self._centre_m, self._config.radius_m)

    def _things(self, around: FloorMap, known: Sequence[tuple[float, ...]]) -> BoolArray:
        cells = self._aligned(around, around.occupied(), beyond=False)
        for x, y, radius in known:
            cells = cells | self._disc(x, y, radius)
        return cells

    def _cast(
        self, places_m: FloatArray, bearings_rad: FloatArray, steps_m: FloatArray, things: BoolArray
    ) -> tuple[IntArray, BoolArray]:
        """Cells along rays from places (n, 2), as flat numbers (n, rays, steps), -1 beyond the grid, and whether each
        is shown."""
        x = places_m[:, 0, None, None] + np.cos(bearings_rad)[:, None] * steps_m
        y = places_m[:, 1, None, None] + np.sin(bearings_rad)[:, None] * steps_m
        flat = self._flat(x, y)
        opaque = cv2.dilate(things.astype(np.uint8), np.ones((2 * _OPAQUE_CELLS + 1,) * 2, np.uint8)).reshape(-1) > 0
        stopped = np.logical_or.accumulate(opaque[flat] | (flat < 0), axis=-1)
        unseen = (self._count.reshape(-1) < _ENOUGH)[flat] & (steps_m >= self._gaze.nearest_m)
        unknown = np.cumsum(unseen, axis=-1) * float(steps_m[1] - steps_m[0])
        far_enough = steps_m >= max(_NEAREST_M, self._gaze.nearest_m)
        return flat, ~stopped & (unknown <= self._config.margin_m) & far_enough

    def _flat(self, x_m: FloatArray, y_m: FloatArray) -> IntArray:
        rows = np.floor(x_m / CELL_M).astype(np.int64) - self._corner[0]
        columns = np.floor(y_m / CELL_M).astype(np.int64) - self._corner[1]
        inside = (rows >= 0) & (rows < SIZE) & (columns >= 0) & (columns < SIZE)
        return np.where(inside, rows * SIZE + columns, -1)

    def _aligned(self, around: FloorMap, cells: _Cells, *, beyond: float) -> _Cells:
        """Cells of the floor map in this grid."""
        moved = np.full_like(cells, beyond)
        to, source = overlap(around.corner - self._corner)
        moved[to] = cells[source]
        return moved

    def _disc(self, x_m: float, y_m: float, radius_m: float) -> BoolArray:
        rows = (np.arange(SIZE) + self._corner[0] + 0.5) * CELL_M - x_m
        columns = (np.arange(SIZE) + self._corner[1] + 0.5) * CELL_M - y_m
        disc: BoolArray = rows[:, None] ** 2 + columns[None, :] ** 2 <= radius_m**2
        return disc


def _large(cells: BoolArray, least_m2: float) -> BoolArray:
    """The cells that belong to a patch of at least a size."""
    _, patches, stats, _ = cv2.connectedComponentsWithStats(cells.astype(np.uint8), connectivity=8)
    large = stats[:, cv2.CC_STAT_AREA] * _AREA_M2 > least_m2 - _AREA_M2 / 2
    large[0] = False
    return np.asarray(large[patches])


def describe(rest: Rest, body: Pose2) -> str:
    """The unseen patches, as the robot stands now: '0.8 m2 at 1.4 m to the left, 0.3 m2 at 2.0 m behind'."""
    told = []
    for area, x_m, y_m in rest.patches[:3]:
        x, y, _ = body.inverse().apply((x_m, y_m, 0.0))
        told.append(f"{area:.2f} m2 at {hypot(x, y):.1f} m {_side(degrees(atan2(y, x)))}")
    more = len(rest.patches) - len(told)
    return ", ".join(told) + (f" and {more} smaller" if more > 0 else "")


def _side(bearing_deg: float) -> str:
    side, away = "left" if bearing_deg > 0 else "right", abs(bearing_deg)
    if away < 22.5:
        return "ahead"
    if away > 157.5:
        return "behind"
    if away < 67.5:
        return f"ahead to the {side}"
    return f"to the {side}" if away <= 112.5 else f"behind to the {side}"


def _pair(place: FloatArray) -> tuple[float, float]:
    x, y = place.tolist()
    return x, y
