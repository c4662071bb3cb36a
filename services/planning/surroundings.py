"""Obstacles for body and arm: the floor map together with the known objects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cocoro.arrays import BoolArray, FloatArray
from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.messages import TargetEstimate
from cocoro.units import Vec3
from services.planning.floor_map import ClearanceField, FloorMap
from services.planning.floor_plan import Way
from services.planning.routes import Routes

_KEEP_NS = NS // 10
OBJECT_M = 0.033
"""Radius with which an object of unknown size counts as an obstacle: that of the cans."""
_SMEAR_M = 0.09
"""Margin by which the map may show an object wider than it is: cell size, depth noise, odometry drift."""


class Fields(NamedTuple):
    """Distances to obstacles, for the body and for the raised arm."""

    body: ClearanceField
    """All obstacles except the target."""
    arm: ClearanceField
    """All obstacles except the known objects, which the raised arm passes over."""


class Surroundings:
    def __init__(self, marker: str, radii_m: Mapping[str, float] | None = None) -> None:
        """`marker`: the label of the ball on the robot's own hand; `radii_m`: of the known objects, by label."""
        self._marker = marker
        self._radii_m = radii_m or {}
        self.floor = FloorMap()
        self.way: Way | None = None
        """The way of the course that is under way, for who looks on."""
        self._fields: Fields | None = None
        self._built: tuple[int, str] | None = None
        self._built_ns = 0

    def clear(self) -> None:
        self.floor.clear()
        self._fields = None

    def fields(
        self,
        label: str,
        known: Sequence[TargetEstimate],
        now_ns: int,
        ignore: Sequence[tuple[float, float, float]] = (),
    ) -> Fields:
        """Clearances for going to `label` ('' for nowhere), rebuilt at most at 10 Hz and only when the map has changed.

        `ignore`: discs (x, y, radius), odometry frame, metres, that count as free.
        """
        what = (self.floor.changes, label)
        stale = self._built is None or self._built[1] != label or now_ns - self._built_ns >= _KEEP_NS
        if self._fields is None or (stale and what != self._built):
            discs = {
                item.label: (*item.odometry_position_m[:2], self._radii_m.get(item.label, OBJECT_M))
                for item in known
                if item.label != self._marker
            }
            seen = [(x, y, radius + _SMEAR_M) for x, y, radius in discs.values()]
            target = [(x, y, radius + _SMEAR_M) for name, (x, y, radius) in discs.items() if name == label]
            others = [disc for name, disc in discs.items() if name != label]
            body = self.floor.add_discs(self.floor.occupied([*target, *ignore]), others)
            arm = self.floor.occupied(seen)
            self._fields = Fields(ClearanceField(self.floor, body), ClearanceField(self.floor, arm))
            self._built, self._built_ns = what, now_ns
        return self._fields

    def discs(self, known: Sequence[TargetEstimate]) -> tuple[tuple[float, float, float], ...]:
        """The floor (x, y, radius), odometry frame, metres, that known objects stand on."""
        return tuple(
            (*item.odometry_position_m[:2], self._radii_m.get(item.label, OBJECT_M))
            for item in known
            if item.label != self._marker
        )

    def unseen(self, places_m: FloatArray) -> BoolArray:
        """Mark the places (n, 2), odometry frame, m, that were not seen yet; returns shape (n,)."""
        looked = self.floor.looked_at()
        hidden = []
        for x, y in places_m:
            cell = self.floor.cell(float(x), float(y))
            hidden.append(cell is not None and not looked[cell])
        return np.array(hidden, dtype=bool)

    def sees(self, from_m: Vec3, to_m: Vec3) -> bool:
        """Whether nothing on the map hides a place from another, both odometry frame, m. What stands within 0.2 m of
        the first or 0.1 m of the second does not count."""
        start, end = np.array(from_m), np.array(to_m)
        away_m = float(np.hypot(*(end - start)[:2]))
        shares = np.arange(0.2, away_m - 0.1, 0.02) / max(away_m, 1e-6)
        return not self.floor.taller(start + shares[:, None] * (end - start)).any()

    def routes(self, field: ClearanceField, body: Pose2, radius_m: float, comfort_m: float) -> Routes:
        return Routes(self.floor, field, (body.x_m, body.y_m), radius_m, comfort_m)


def placed(points_m: FloatArray, pose: Pose2) -> FloatArray:
    """Points (n, 2), metres, of the pose's frame in its parent frame; shape (n, 2)."""
    c, s = np.cos(pose.yaw_rad), np.sin(pose.yaw_rad)
    moved: FloatArray = points_m @ np.array([[c, s], [-s, c]]) + np.array([pose.x_m, pose.y_m])
    return moved


def swept_by(hulls: Sequence[tuple[FloatArray, FloatArray]]) -> FloatArray:
    """Floor positions (n, 2), body frame, 3 cm apart, under a motion given as hulls: centres (m, 3) and radii (m,)."""
    points = np.concatenate([centres[:, :2] for centres, _ in hulls])
    cells: Mapping[tuple[int, int], None] = dict.fromkeys(
        (round(x / 0.03), round(y / 0.03)) for x, y in points.tolist()
    )
    return np.array(list(cells), dtype=np.float64) * 0.03
