"""The feet of walls: the floor beside obstacles, and the directions from which it must be seen.

The floor map shows an obstacle some centimetres wider than it is, and what is seen on one of its sides says nothing of
the other. So floor beside an obstacle counts as seen only from its own side. Directions are told apart by sectors of a
full turn; a set of sectors is an integer with one bit for each.
"""

from __future__ import annotations

import cv2
import numpy as np

from cocoro.arrays import BoolArray, FloatArray, IntArray

SECTORS = 60
ANYWHERE = (1 << SECTORS) - 1
"""The set of all sectors."""
_AWAY_CELLS = 4
"""Cells within which an obstacle's parts tell to which of its sides floor belongs."""


def sector(bearing_rad: FloatArray) -> IntArray:
    """The number of the sector in which each bearing, rad, lies; any shape."""
    number: IntArray = np.floor(bearing_rad / (2 * np.pi / SECTORS)).astype(np.int64) % SECTORS
    return number


def own_sides(occupied: BoolArray, gap_cells: int) -> IntArray:
    """For each cell (n, n), rows along x: the set of sectors from which it is seen from its own side of the obstacle
    beside it; 0 where it is not the foot of one. A foot lies `gap_cells` away from the occupied cells."""
    things = cv2.morphologyEx(occupied.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    inner, outer = (
        cv2.dilate(things, np.ones((2 * reach + 1,) * 2, np.uint8)).astype(bool) for reach in (gap_cells, gap_cells + 1)
    )
    x, y = (cv2.filter2D(things.astype(np.float64), -1, kernel) for kernel in (_AWAY_X, _AWAY_Y))
    return np.where(outer & ~inner, _OWN[sector(np.arctan2(y, x))], 0)


def _away_kernels() -> tuple[FloatArray, FloatArray]:
    """Kernels that add up, for a cell, the directions from the obstacles' cells near it, along x and along y."""
    reach = np.arange(-_AWAY_CELLS, _AWAY_CELLS + 1, dtype=np.float64)
    x, y = np.meshgrid(reach, reach, indexing="ij")
    share = 1.0 / np.maximum(x**2 + y**2, 1.0) ** 1.5
    return -x * share, -y * share


def _facing() -> IntArray:
    """For each sector the set of those within a quarter turn of it."""
    middles = (np.arange(SECTORS) + 0.5) * (2 * np.pi / SECTORS)
    own = np.cos(middles[:, None] - middles) > -1e-9
    sides: IntArray = (own.astype(np.int64) << np.arange(SECTORS)).sum(axis=1)
    return sides


_AWAY_X, _AWAY_Y = _away_kernels()
_OWN = _facing()
