"""The default detector: finds one connected blob of the object's colour whose size fits its distance.

Compared with the paper's detector: a second region of the same colour does not shift the centroid; noise is
removed; depth is registered and is the median of a window; patches and walls of the right colour are rejected by
size; a blob without depth is reported without depth.
"""

from __future__ import annotations

from math import log, sqrt

import cv2
import numpy as np

from cocoro.arrays import MaskArray
from cocoro.objects import Catalogue, ObjectSpec
from services.perception.colours import ColourTable
from services.perception.config import PerceptionConfig
from services.perception.image import ImageSighting, PixelBox, RgbdImage
from services.perception.region import ColourRegion, components
from services.perception.shapes import area_range_m2, counted_px, reach_m

NEAREST_M = 0.3
"""The size limit of a blob without depth is the object's size at this distance. Nearer objects hardly fit into the
image."""
MAX_STRETCH = 1.5
"""Largest ratio of a blob's diagonal to that of the whole object's outline."""


class BlobDetector:
    def __init__(self, catalogue: Catalogue, config: PerceptionConfig) -> None:
        self._catalogue = catalogue
        self._config = config
        self._table = ColourTable(catalogue)

    def detect(self, image: RgbdImage) -> list[ImageSighting]:
        classes = self._table.classify(image.colour)
        # Rows and columns that contain each object's colours, in one pass for all objects.
        rows, columns = np.bitwise_or.reduce(classes, axis=1), np.bitwise_or.reduce(classes, axis=0)
        sightings = []
        for bit, known in enumerate(self._catalogue):
            own = classes.dtype.type(1 << bit)
            across, down = np.flatnonzero(columns & own), np.flatnonzero(rows & own)
            if len(across) and len(down):
                left, top = int(across[0]), int(down[0])
                crop = classes[top : int(down[-1]) + 1, left : int(across[-1]) + 1] & own
                sighting = self._find(known, (crop != 0).view(np.uint8), (left, top), image)
                if sighting is not None:
                    sightings.append(sighting)
        return sightings

    def _find(
        self, known: ObjectSpec, mask: MaskArray, origin: tuple[int, int], image: RgbdImage
    ) -> ImageSighting | None:
        """Find one object. `mask` has its matching pixels, shape (height, width), and covers the part of the image
        whose first pixel is `origin`, (column, row)."""
        parts = _clean_components(mask, origin, image, self._config.min_area_px * image.scale**2)
        if not parts:
            return None
        fit = _SizeFit(known, image, self._config)
        regions: list[ColourRegion] = []
        plausible: list[ColourRegion] = []
        for part in parts:
            region = ColourRegion(*part, image)
            if fit.too_large(region):
                pieces = [ColourRegion(*piece, image) for piece in region.split_by_depth()]
                regions += pieces
                plausible += [piece for piece in pieces if fit.whole(piece)]
            else:
                regions.append(region)
                if fit.whole(region) or fit.partly_hidden(region):
                    plausible.append(region)
        if not plausible:
            return None
        best = fit.completed(max(plausible, key=fit.score), regions)
        return ImageSighting(
            label=known.label,
            u_px=best.u_px,
            v_px=best.v_px,
            area_px=best.area_px,
            box_px=best.bounds,
            depth_m=best.depth_m,
            cut=best.cut,
            hidden=fit.too_small(best) and best.hidden,
            evidence=best.evidence(reach_m(known)),
        )


class _SizeFit:
    """Compares a region's size with that of one known object at the region's distance."""

    def __init__(self, known: ObjectSpec, image: RgbdImage, config: PerceptionConfig) -> None:
        camera = image.camera
        self._config = config
        self._focal2 = camera.fx * camera.fy
        self._least_m2, self._greatest_m2 = area_range_m2(known)
        self._reach_m = reach_m(known)
        self._inwards_m = known.planar_radius_m
        self._min_area_px = config.min_area_px * image.scale**2

    def _pixels(self, area_m2: float, depth_m: float) -> float:
        return counted_px(area_m2 * self._focal2 / (depth_m + self._inwards_m) ** 2)

    def _diagonal_px(self, depth_m: float) -> float:
        return MAX_STRETCH * 2 * self._reach_m * sqrt(self._focal2) / depth_m + 4

    def too_large(self, region: ColourRegion) -> bool:
        depth_m = region.depth_m or NEAREST_M
        most = self._config.max_share * self._pixels(self._greatest_m2, depth_m)
        return region.area_px > most or region.diagonal_px > self._diagonal_px(depth_m)

    def whole(self, region: ColourRegion) -> bool:
        """Whether it may be the whole object. A region without depth passes if it is not too large."""
        if region.area_px < self._min_area_px or self.too_large(region):
            return False
        return not self.too_small(region, self._config.min_share)

    def partly_hidden(self, region: ColourRegion) -> bool:
        """Whether it may be part of the object, with the rest beyond the image's edge or behind something nearer."""
        if region.area_px < 2 * self._min_area_px or self.too_small(region, self._config.min_hidden_share):
            return False
        return region.cut or region.hidden

    def too_small(self, region: ColourRegion, share: float = 0.85) -> bool:
        """Whether it has less than `share` of the pixels that the whole object would have at its depth."""
        return region.depth_m is not None and region.area_px < share * self._pixels(self._least_m2, region.depth_m)

    def score(self, region: ColourRegion) -> tuple[bool, float, int]:
        """Greater is better: regions with depth first, then those closest to the expected size."""
        if region.depth_m is None:
            return False, 0.0, region.area_px
        expected_px = self._pixels(sqrt(self._least_m2 * self._greatest_m2), region.depth_m)
        # In half-octave steps, so that among regions of about the right size the largest, the nearest, wins.
        return True, -round(2 * abs(log(region.area_px / expected_px, 2))), region.area_px

    def completed(self, best: ColourRegion, regions: list[ColourRegion]) -> ColourRegion:
        """The region joined with other pieces of the same object, which something in front of it separates."""
        for other in regions:
            if other is best or best.depth_m is None or other.depth_m is None:
                continue
            if abs(other.depth_m - best.depth_m) < self._reach_m:
                both = _union(best, other)
                if not self.too_large(both):
                    best = both
        return best


def _clean_components(
    mask: MaskArray, origin: tuple[int, int], image: RgbdImage, min_area_px: float
) -> list[tuple[MaskArray, PixelBox]]:
    """The mask's connected regions, after opening has removed specks and threads of noise."""
    if cv2.countNonZero(mask) < min_area_px:
        return []
    opened = cv2.morphologyEx(mask, cv2.MORPH_OPEN, np.ones((3, 3), dtype=np.uint8))
    return components(np.asarray(opened, dtype=np.uint8), origin, image, min_area_px)


def _union(a: ColourRegion, b: ColourRegion) -> ColourRegion:
    box = (
        min(a.box[0], b.box[0]),
        min(a.box[1], b.box[1]),
        max(a.box[2], b.box[2]),
        max(a.box[3], b.box[3]),
    )
    mask = np.zeros((box[3] - box[1], box[2] - box[0]), dtype=np.uint8)
    for region in (a, b):
        left, top = region.box[0] - box[0], region.box[1] - box[1]
        height, width = region.mask.shape
        mask[top : top + height, left : left + width] |= region.mask
    return ColourRegion(mask, box, a.image)
