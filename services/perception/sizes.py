"""Compares the sizes of regions with those of known objects at the regions' distances."""

from __future__ import annotations

from typing import Any

import numpy as np

from cocoro.robot import Camera
from services.perception.config import PerceptionConfig
from services.perception.shapes import Shapes, counted_px

NEAREST_M = 0.3
"""The size limit of a blob without depth is the object's size at this distance. Nearer objects hardly fit into the
image."""
MAX_STRETCH = 1.5
"""Largest ratio of a blob's diagonal to that of the whole object's outline."""
NEARLY_WHOLE = 0.85
"""A region with a smaller share of the whole object's pixels may be hidden in part."""


class SizeFit:
    """Compares a region with an object, or n regions with one object each. Areas, px, diagonals, px, and depths, m, NaN
    without, are numbers or arrays of shape (n,), like the attributes of the shapes; so are the answers."""

    def __init__(self, shapes: Shapes, camera: Camera, config: PerceptionConfig, min_area_px: float) -> None:
        self._shapes = shapes
        self._config = config
        self._focal2 = camera.fx * camera.fy
        self._min_area_px = min_area_px

    def _pixels(self, area_m2: Any, depth_m: Any) -> Any:
        return counted_px(area_m2 * self._focal2 / (depth_m + self._shapes.radius_m) ** 2)

    def expected_px(self, depth_m: Any) -> Any:
        """Number of pixels of the object at that depth, in the middle between its largest and its smallest view."""
        return self._pixels(np.sqrt(self._shapes.least_m2 * self._shapes.greatest_m2), depth_m)

    def too_large(self, area_px: Any, diagonal_px: Any, depth_m: Any) -> Any:
        depth_m = np.where(np.isnan(depth_m), NEAREST_M, depth_m)
        most_px = MAX_STRETCH * 2 * self._shapes.reach_m * np.sqrt(self._focal2) / depth_m + 4
        most = self._config.max_share * self._pixels(self._shapes.greatest_m2, depth_m)
        return (area_px > most) | (diagonal_px > most_px)

    def too_small(self, area_px: Any, depth_m: Any, share: float = NEARLY_WHOLE) -> Any:
        """Whether it has less than `share` of the pixels that the whole object would have at its depth; never without
        depth."""
        return area_px < share * self._pixels(self._shapes.least_m2, depth_m)

    def whole(self, area_px: Any, diagonal_px: Any, depth_m: Any) -> Any:
        """Whether it may be the whole object. A region without depth is when it is not too large."""
        large_enough = (area_px >= self._min_area_px) & ~self.too_small(area_px, depth_m, self._config.min_share)
        return large_enough & ~self.too_large(area_px, diagonal_px, depth_m)

    def partly_hidden(self, area_px: Any, depth_m: Any) -> Any:
        """Whether it is large enough to be part of the object, if the rest is beyond the image's edge or behind
        something nearer."""
        small = self.too_small(area_px, depth_m, self._config.min_hidden_share)
        return (area_px >= 2 * self._min_area_px) & ~small
