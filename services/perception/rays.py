"""Where rays from the camera come nearest to upright shapes, or go deepest into them, in closed form.

A ray's points are told by the way along it, measured across the shape: from above for a cylinder, in all directions for
a sphere. A ray is deepest inside of the side where it is nearest to the axis. Where the lid is nearer than the side, it
goes deeper towards the middle height, until both are equally far, but not beyond the side.
"""

from __future__ import annotations

import numpy as np

from cocoro.arrays import Float32Array
from services.perception.shapes import Solids

_TINY = np.float32(1e-9)


class Rays:
    """Rays from the camera, as many for each of n shapes."""

    def __init__(self, solids: Solids, directions: Float32Array, free_to: Float32Array) -> None:
        """`directions` have the shape (3, n, m), z up; the rays are known to be free up to `free_to` of their length,
        (n, m), infinite where that is unknown."""
        across = directions * solids.across
        length = np.sqrt(np.maximum(np.add.reduce(across * across, axis=0), _TINY))
        self._solids = solids
        self._directions = directions / length
        self._across = across / length
        self._free_to = free_to * length
        self._slope = np.abs(self._directions[2])

    def nearest(self, camera: Float32Array) -> Float32Array:
        """The point in each ray's free part that is nearest to its shape, or deepest in it, relative to the shape's
        centre, m, shape (3, n, m). `camera` is the camera's place, relative to the centres, shape (3, n, 1)."""
        solids, slope = self._solids, self._slope
        beside_axis = -np.add.reduce(self._across * camera, axis=0)
        flat = camera * solids.across
        off_axis2 = np.maximum(np.add.reduce(flat * flat, axis=0) - beside_axis * beside_axis, 0)
        height = beside_axis * self._directions[2]
        height += camera[2]
        # At x from the axis the side is as near as the lid: sqrt(off_axis2 + x * x) = lid - slope * x.
        lid = np.maximum(np.abs(height) - (solids.half_height - solids.radius), 0)
        nearer2 = np.maximum(lid * lid - off_axis2, 0)
        further = nearer2 / (lid * slope + np.sqrt(nearer2 + slope * slope * off_axis2) + _TINY)
        np.minimum(further, np.sqrt(np.maximum(solids.radius * solids.radius - off_axis2, 0)), out=further)
        beside_axis -= np.copysign(further, height * self._directions[2])
        np.minimum(beside_axis, self._free_to, out=beside_axis)
        points: Float32Array = beside_axis * self._directions
        points += camera
        return points
