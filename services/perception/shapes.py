"""The known shapes as signed distances, for fitting them to points and for knowing how large they look."""

from __future__ import annotations

from math import hypot, pi, sqrt

import numpy as np
from numpy.typing import NDArray

from cocoro.objects import KnownObject

Points = NDArray[np.float64]


def signed_distance(known: KnownObject, offsets_m: Points) -> tuple[Points, Points]:
    """Distance (n,) from the upright object's surface, negative inside, and its gradient (n, 3).

    `offsets_m` (n, 3) are points relative to the object's centre, z up. A box, whose yaw nobody knows, counts as
    the cylinder of equal base and height.
    """
    if known.shape == "sphere":
        length = np.linalg.norm(offsets_m, axis=1)
        return length - known.planar_radius_m, offsets_m / np.maximum(length, 1e-9)[:, None]
    planar = np.hypot(offsets_m[:, 0], offsets_m[:, 1])
    beside = planar - known.planar_radius_m
    above = np.abs(offsets_m[:, 2]) - known.size_m[2] / 2
    # Beyond the rim both count; elsewhere the nearer of mantle and lid alone.
    beyond = (beside > 0) & (above > 0)
    corner = np.hypot(beside, above)
    distance = np.where(beyond, corner, np.maximum(beside, above))
    share = np.maximum(corner, 1e-9)
    radial = np.where(beyond, beside / share, beside >= above)
    vertical = np.where(beyond, above / share, beside < above)
    gradient = np.empty_like(offsets_m)
    gradient[:, :2] = offsets_m[:, :2] * (radial / np.maximum(planar, 1e-9))[:, None]
    gradient[:, 2] = vertical * np.sign(offsets_m[:, 2])
    return distance, gradient


def reach_m(known: KnownObject) -> float:
    """Radius of the ball around the object."""
    if known.shape == "sphere":
        return known.planar_radius_m
    return hypot(known.planar_radius_m, known.size_m[2] / 2)


def seen_area_m2(known: KnownObject, elevation_sine: float) -> float:
    """Area of the object's silhouette (orthographic), seen from `elevation_sine` above the horizontal (0 to 1)."""
    radius = known.planar_radius_m
    if known.shape == "sphere":
        return pi * radius**2
    level = sqrt(1.0 - elevation_sine**2)
    return 2 * radius * known.size_m[2] * level + pi * radius**2 * elevation_sine


def area_range_m2(known: KnownObject) -> tuple[float, float]:
    """Least and greatest silhouette between the level view and 60 degrees from above."""
    areas = [seen_area_m2(known, sine) for sine in (0.0, 0.3, 0.5, 0.7, 0.866)]
    return min(areas), max(areas)
