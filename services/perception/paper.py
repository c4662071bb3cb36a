"""The paper's detector (section 'Object identification'), as a baseline.

CIELAB ranges; the image in 5 x 5 tiles; an object is present when its fullest tile has more than 64 matching
pixels; the centroid is the median of all matching pixels, and the depth is the depth image's value at that pixel.
Its weaknesses are kept: two regions of one colour give a centroid between them, and depth is not registered.
"""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np

from cocoro.arrays import ImageArray
from cocoro.objects import Catalogue, ObjectSpec
from services.perception.config import PerceptionConfig
from services.perception.image import ImageSighting, RgbdImage


class PaperDetector:
    def __init__(self, catalogue: Catalogue, config: PerceptionConfig) -> None:
        self._catalogue = catalogue
        self._config = config

    def detect(self, image: RgbdImage) -> list[ImageSighting]:
        lab = np.asarray(cv2.cvtColor(image.colour, cv2.COLOR_RGB2Lab), dtype=np.uint8)
        found = (self._find(known, lab, image) for known in self._catalogue)
        return [sighting for sighting in found if sighting is not None]

    def _find(self, known: ObjectSpec, lab: ImageArray, image: RgbdImage) -> ImageSighting | None:
        mask = np.zeros(lab.shape[:2], dtype=np.uint8)
        for box in known.lab:
            mask |= np.asarray(cv2.inRange(lab, _eight_bit(box.low), _eight_bit(box.high)), dtype=np.uint8)
        if _fullest_tile(mask, self._config.paper_grid) <= self._config.paper_threshold_px * image.scale**2:
            return None
        rows, columns = np.nonzero(mask)
        u, v = float(np.median(columns)), float(np.median(rows))
        return ImageSighting(
            label=known.label,
            u_px=u,
            v_px=v,
            area_px=len(rows),
            box_px=(int(columns.min()), int(rows.min()), int(columns.max()) + 1, int(rows.max()) + 1),
            depth_m=image.unregistered_depth_m(int(u), int(v)),
        )


def _eight_bit(lab: tuple[float, float, float]) -> tuple[float, float, float]:
    """CIELAB in OpenCV's 8-bit form."""
    return lab[0] * 255 / 100, lab[1] + 128, lab[2] + 128


def _fullest_tile(mask: ImageArray, grid: int) -> int:
    height, width = mask.shape
    rows = np.linspace(0, height, grid + 1).astype(int)
    columns = np.linspace(0, width, grid + 1).astype(int)
    return max(
        cv2.countNonZero(mask[top:bottom, left:right])
        for top, bottom in pairwise(rows)
        for left, right in pairwise(columns)
    )
