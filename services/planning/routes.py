"""Cheapest paths over the free floor for the round body, at a distance from obstacles (Dijkstra 1959)."""

from __future__ import annotations

from typing import Any

import numpy as np
import scipy  # which loads its parts when they are needed: a robot that never meets a detour does without
from numpy.typing import NDArray

from cocoro.arrays import FloatArray
from services.planning.floor_map import CELL_M, SIZE, ClearanceField, FloorMap

_STEPS = ((1, 0), (0, 1), (1, 1), (1, -1))


class Routes:
    """All cheapest paths from one place over the present map."""

    def __init__(
        self, floor: FloorMap, field: ClearanceField, start_m: tuple[float, float], radius_m: float, comfort_m: float
    ) -> None:
        """Cells nearer than `radius_m` to an obstacle are closed, nearer than `comfort_m` they cost more. Cells around
        the start are open where they are no nearer to an obstacle than the start, so that the robot can leave."""
        self._floor = floor
        cost = np.where(
            field.metres >= radius_m, 1.0 + 3.0 * np.clip((comfort_m - field.metres) / comfort_m, 0.0, 1.0), np.inf
        )
        start = floor.cell(*start_m)
        self._predecessors: NDArray[np.int32] | None = None
        self._distance: FloatArray = np.full(SIZE * SIZE, np.inf)
        if start is None:
            return
        row, column = start
        here = (slice(max(row - 4, 0), row + 5), slice(max(column - 4, 0), column + 5))
        leave_m = min(float(field.metres[start]), radius_m - CELL_M / 2)
        cost[here] = np.where(np.isfinite(cost[here]) | (field.metres[here] < leave_m), cost[here], 6.0)
        start_at = np.array([row * SIZE + column])
        distance, predecessors = scipy.sparse.csgraph.dijkstra(
            _graph(cost), directed=False, indices=start_at, return_predecessors=True
        )
        self._distance, self._predecessors = distance[0], predecessors[0]

    def cost(self, x_m: float, y_m: float) -> float:
        """Cost of the path to a place, in metres of clear floor; infinite where there is no path."""
        cell = self._floor.cell(x_m, y_m)
        return float(self._distance[cell[0] * SIZE + cell[1]]) if cell is not None else float("inf")

    def costs(self) -> FloatArray:
        """`cost` of the path to every cell, (SIZE, SIZE)."""
        return self._distance.reshape(SIZE, SIZE)

    def path(self, x_m: float, y_m: float) -> list[tuple[float, float]]:
        """Cell centres from the start to a place, odometry frame, metres; empty where there is no path."""
        cell = self._floor.cell(x_m, y_m)
        if cell is None or self._predecessors is None:
            return []
        at = cell[0] * SIZE + cell[1]
        if not np.isfinite(self._distance[at]):
            return []
        path = []
        while at >= 0:
            path.append(self._floor.centre(at // SIZE, at % SIZE))
            at = int(self._predecessors[at])
        path.reverse()
        return path


def _graph(cost: FloatArray) -> Any:
    """Sparse graph over cells with costs (SIZE, SIZE): an edge costs the mean of its two cells times its length."""
    numbers = np.arange(SIZE * SIZE).reshape(SIZE, SIZE)
    rows, columns, weights = [], [], []
    for down, right in _STEPS:
        left = slice(0, SIZE - right) if right >= 0 else slice(-right, SIZE)
        shifted = slice(right, SIZE) if right >= 0 else slice(0, SIZE + right)
        one, other = numbers[: SIZE - down, left], numbers[down:, shifted]
        weight = (cost[: SIZE - down, left] + cost[down:, shifted]) / 2 * np.hypot(down, right) * CELL_M
        open_ = np.isfinite(weight)
        rows.append(one[open_])
        columns.append(other[open_])
        weights.append(weight[open_])
    entries: Any = (np.concatenate(weights), (np.concatenate(rows), np.concatenate(columns)))
    return scipy.sparse.coo_array(entries, shape=(SIZE * SIZE, SIZE * SIZE)).tocsr()
