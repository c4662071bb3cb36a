"""Known shapes as signed distances, for fitting to points, and their expected size in the image."""

from __future__ import annotations

from math import hypot, pi, sqrt

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.objects import ObjectSpec


def distance_from(known: ObjectSpec, offsets_m: FloatArray) -> FloatArray:
    """Signed distance from the upright object's surface, m, negative inside, shape (...). `offsets_m` are points
    relative to its centre, z up, shape (..., 3).

    A box counts as the cylinder of equal base area and height, since its yaw is unknown.
    """
    squares = offsets_m * offsets_m
    planar2 = squares[..., 0] + squares[..., 1]
    if known.shape == "sphere":
        from_centre: FloatArray = np.sqrt(planar2 + squares[..., 2])
        return from_centre - known.planar_radius_m
    beside = np.sqrt(planar2) - known.planar_radius_m
    above = np.abs(offsets_m[..., 2]) - known.size_m[2] / 2
    outside: FloatArray = np.sqrt(np.maximum(beside, 0.0) ** 2 + np.maximum(above, 0.0) ** 2)
    return outside + np.minimum(np.maximum(beside, above), 0.0)


def signed_distance(known: ObjectSpec, offsets_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """`distance_from` for points of shape (n, 3): distances, m, shape (n,), and their gradient, shape (n, 3)."""
    if known.shape == "sphere":
        length = np.sqrt((offsets_m * offsets_m).sum(axis=1))
        return length - known.planar_radius_m, offsets_m / np.maximum(length, 1e-9)[:, None]
    planar = np.sqrt(offsets_m[:, 0] ** 2 + offsets_m[:, 1] ** 2)
    beside = planar - known.planar_radius_m
    above = np.abs(offsets_m[:, 2]) - known.size_m[2] / 2
    radial, vertical = np.maximum(beside, 0.0), np.maximum(above, 0.0)
    outside = np.sqrt(radial * radial + vertical * vertical)
    within = np.maximum(beside, above)
    # Inside, the nearer one of side and lid counts.
    deep = within <= 0.0
    mantle = beside >= above
    share = np.where(deep, 1.0, outside)
    radial = np.where(deep, mantle, radial / share)
    vertical = np.where(deep, ~mantle, vertical / share)
    gradient = np.empty_like(offsets_m)
    gradient[:, :2] = offsets_m[:, :2] * (radial / np.maximum(planar, 1e-9))[:, None]
    gradient[:, 2] = np.copysign(vertical, offsets_m[:, 2])
    return outside + np.minimum(within, 0.0), gradient


def reach_m(known: ObjectSpec) -> float:
    """Radius of the circumscribed sphere, m."""
    if known.shape == "sphere":
        return known.planar_radius_m
    return hypot(known.planar_radius_m, known.size_m[2] / 2)


def seen_area_m2(known: ObjectSpec, elevation_sine: float) -> float:
    """Area of the object's orthographic silhouette, m2, seen from `elevation_sine` (0 to 1) above the horizontal."""
    radius = known.planar_radius_m
    if known.shape == "sphere":
        return pi * radius**2
    level = sqrt(1.0 - elevation_sine**2)
    return 2 * radius * known.size_m[2] * level + pi * radius**2 * elevation_sine


def counted_px(area_px: float) -> float:
    """Number of pixels that are found of an outline that encloses `area_px`: about half of those along the edge are
    blended with the background or removed by cleaning. Measured on rendered frames."""
    return area_px - min(2.0 * sqrt(area_px), 0.5 * area_px)


def area_range_m2(known: ObjectSpec) -> tuple[float, float]:
    """Smallest and largest silhouette, m2, for elevations from 0 to 60 degrees."""
    areas = [seen_area_m2(known, sine) for sine in (0.0, 0.3, 0.5, 0.7, 0.866)]
    return min(areas), max(areas)
