"""Rotation matrices of quaternions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cocoro.arrays import FloatArray


def rotation(quaternion: Sequence[float]) -> FloatArray:
    """Rotation matrix, (3, 3), of one unit quaternion (x, y, z, w)."""
    x, y, z, w = quaternion
    return np.array(
        (
            (1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)),
            (2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)),
            (2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)),
        )
    )


def rotations(quaternions: FloatArray) -> FloatArray:
    """Rotation matrices, (n, 3, 3), of unit quaternions (x, y, z, w), (n, 4)."""
    x, y, z, w = quaternions.T
    rows = np.empty((len(quaternions), 3, 3))
    rows[:, 0, 0] = 1 - 2 * (y * y + z * z)
    rows[:, 0, 1] = 2 * (x * y - z * w)
    rows[:, 0, 2] = 2 * (x * z + y * w)
    rows[:, 1, 0] = 2 * (x * y + z * w)
    rows[:, 1, 1] = 1 - 2 * (x * x + z * z)
    rows[:, 1, 2] = 2 * (y * z - x * w)
    rows[:, 2, 0] = 2 * (x * z - y * w)
    rows[:, 2, 1] = 2 * (y * z + x * w)
    rows[:, 2, 2] = 1 - 2 * (x * x + y * y)
    return rows
