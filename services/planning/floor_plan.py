"""The floor map and the way on it as a message, for who looks on: twice a second, as much of it as was seen."""

from __future__ import annotations

from math import ceil
from typing import NamedTuple

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.messages import LARGEST, FloorPlan
from cocoro.topics import FLOOR_PLAN
from cocoro.units import Vec2
from services.planning.floor_map import CELL_M, FloorMap

_PERIOD_NS = round(NS / (FLOOR_PLAN.rate_hz or 1.0))
_PLACES = 256
"""Places of a way that are published; of a longer one, each second or third."""


class Way(NamedTuple):
    """Where a course goes at present, odometry frame, m."""

    goal_m: Vec2
    places_m: FloatArray
    """From the robot on, (n, 2)."""

    def thinned(self) -> tuple[Vec2, ...]:
        """At most `_PLACES` of its places, to the millimetre; the last one is among them."""
        places = self.places_m[:: -max(ceil(len(self.places_m) / _PLACES), 1)][::-1]
        return tuple((x, y) for x, y in _within(places))


class FloorPlanner:
    """Makes the message when it is due."""

    def __init__(self) -> None:
        self._period: int | None = None

    def due(self, now_ns: int) -> bool:
        """Whether this is the first step, or the first one of a period. Periods are counted from the robot's time zero,
        so that a planner that is executed again from the middle of a run makes them at the same steps."""
        period, self._period = self._period, now_ns // _PERIOD_NS
        return period != self._period

    @staticmethod
    def made(floor: FloorMap, way: Way | None) -> FloorPlan:
        """The message of a map and of the way that a course takes on it."""
        looked, occupied = floor.looked_at(), floor.occupied()
        known = looked | occupied
        rows, columns = np.flatnonzero(known.any(axis=1)), np.flatnonzero(known.any(axis=0))
        goal_m = way.goal_m if way is not None else None
        places_m = way.thinned() if way is not None else ()
        if not rows.size:
            return FloorPlan(cell_m=CELL_M, way_m=places_m, goal_m=goal_m)
        part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        cells = np.where(occupied[part], np.uint8(2), looked[part].view(np.uint8))
        [(x, y)] = _within((floor.corner + np.array([[rows[0], columns[0]]])) * CELL_M)
        return FloorPlan(
            cell_m=CELL_M,
            origin_m=(x, y),
            width=cells.shape[0],
            height=cells.shape[1],
            cells=cells.T.tobytes(),
            way_m=places_m,
            goal_m=goal_m,
        )


def _within(places_m: FloatArray) -> list[list[float]]:
    """Places (n, 2), to the millimetre, within the bounds of messages, whatever the odometry says."""
    places: list[list[float]] = np.clip(np.round(places_m, 3), -LARGEST, LARGEST).tolist()
    return places
