"""Known shapes as signed distances, for fitting to points, and their expected size in the image.

Shapes stand upright: cylinders, and spheres, which are cylinders without lids whose radius is measured in all
directions. A box counts as the cylinder of equal base area and height, since its yaw is unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi
from typing import Any

import numpy as np

from cocoro.arrays import BoolArray, Float32Array, FloatArray
from cocoro.objects import ObjectSpec

NO_LID_M = 1e6
"""Half height of a shape without a lid: more than any height."""


class Shapes:
    """The shapes of n objects; each attribute has the shape (n,)."""

    def __init__(self, objects: Sequence[ObjectSpec]) -> None:
        self.radius_m: FloatArray = np.array([known.planar_radius_m for known in objects])
        """Radius of the shape seen from above."""
        self.height_m: FloatArray = np.array([known.size_m[2] for known in objects])
        self.sphere: BoolArray = np.array([known.shape == "sphere" for known in objects], dtype=np.bool_)
        self.reach_m: FloatArray = np.where(self.sphere, self.radius_m, np.hypot(self.radius_m, self.height_m / 2))
        """Radius of the circumscribed sphere."""
        # For elevations from 0 to 60 degrees.
        areas = np.array([self.seen_area_m2(sine) for sine in (0.0, 0.3, 0.5, 0.7, 0.866)])
        self.least_m2: FloatArray = areas.min(axis=0)
        """Smallest silhouette from usual elevations."""
        self.greatest_m2: FloatArray = areas.max(axis=0)
        """Largest silhouette from usual elevations."""

    def __len__(self) -> int:
        return len(self.radius_m)

    def of(self, numbers: Any) -> Shapes:
        """The shapes of the objects with these numbers (m,). For one number the attributes are numbers."""
        some = Shapes.__new__(Shapes)
        for name, values in vars(self).items():
            setattr(some, name, values[numbers])
        return some

    def seen_area_m2(self, elevation_sine: Any) -> FloatArray:
        """Area of each object's orthographic silhouette, m2, (n,), seen from `elevation_sine` (0 to 1) above the
        horizontal, a number or of shape (n,)."""
        level = np.sqrt(1.0 - elevation_sine**2)
        base = pi * self.radius_m**2
        side = 2 * self.radius_m * self.height_m * level
        return np.where(self.sphere, base, side + base * elevation_sine)


class Solids:
    """The surfaces of n objects, to measure points against."""

    def __init__(self, shapes: Shapes) -> None:
        self.radius: Float32Array = shapes.radius_m.astype(np.float32)[:, None]
        self.half_height: Float32Array = np.where(shapes.sphere, NO_LID_M, shapes.height_m / 2).astype(np.float32)[
            :, None
        ]
        """Both m, (n, 1)."""
        self.across: Float32Array = np.ones((3, len(shapes), 1), dtype=np.float32)
        """1 for the directions in which the radius is measured, 0 for others, (3, n, 1)."""
        self.across[2, :, 0] = shapes.sphere

    def distance(self, offsets_m: Float32Array) -> Float32Array:
        """Signed distances of points from the surfaces, m, negative inside, shape (n, k), by their offsets from the
        centres, z up, m, shape (3, n, k)."""
        return self.gradient(offsets_m)[0]

    def gradient(self, offsets_m: Float32Array) -> tuple[Float32Array, Float32Array]:
        """`distance` for offsets (3, n, k), and its gradient along x, y and z, shape (3, n, k)."""
        along = offsets_m * self.across
        planar = np.sqrt(np.add.reduce(along * along, axis=0))
        beside = planar - self.radius
        above = np.abs(offsets_m[2])
        above -= self.half_height
        # Outside, the distances from side and lid that are positive count; inside, the nearer one of both.
        radial = beside * (beside >= np.minimum(above, 0))
        vertical = above * (above > np.minimum(beside, 0))
        length = np.sqrt(radial * radial + vertical * vertical)
        length += np.float32(1e-12)
        distance = np.copysign(length, np.maximum(beside, above))
        radial /= distance * np.maximum(planar, np.float32(1e-9))
        along *= radial
        along[2] += np.copysign(vertical / distance, offsets_m[2])
        return distance, along


def counted_px(area_px: Any) -> Any:
    """Number of pixels that are found of an outline that encloses `area_px`, for areas of any shape: about half of
    those along the edge are blended with the background or removed by cleaning. Measured on rendered frames."""
    return area_px - np.minimum(2.0 * np.sqrt(area_px), 0.5 * area_px)
