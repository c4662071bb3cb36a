"""Finds an object among several regions of its colour: pieces of it, and other things."""

from __future__ import annotations

from math import log, nan

import numpy as np

from services.perception.region import ColourRegion
from services.perception.sizes import SizeFit


class OneObject:
    """Finds one object among regions of its colour."""

    def __init__(self, fit: SizeFit, reach_m: float) -> None:
        """The object reaches `reach_m` from its centre."""
        self._fit = fit
        self._reach_m = reach_m

    def among(self, parts: list[ColourRegion]) -> ColourRegion | None:
        """The object's region; None when none is plausible. `parts` are the regions, the largest first."""
        regions: list[ColourRegion] = []
        plausible: list[ColourRegion] = []
        for part in parts:
            if self._too_large(part):
                pieces = [ColourRegion(*piece, part.image) for piece in part.split_by_depth()]
                regions += pieces
                plausible += [piece for piece in pieces if self._whole(piece)]
            else:
                regions.append(part)
                if self._whole(part) or self._partly_hidden(part):
                    plausible.append(part)
        if not plausible:
            return None
        return self._completed(max(plausible, key=self._score), regions)

    def _too_large(self, region: ColourRegion) -> bool:
        return bool(self._fit.too_large(region.area_px, region.diagonal_px, depth_of(region)))

    def _whole(self, region: ColourRegion) -> bool:
        return bool(self._fit.whole(region.area_px, region.diagonal_px, depth_of(region)))

    def _partly_hidden(self, region: ColourRegion) -> bool:
        return bool(self._fit.partly_hidden(region.area_px, depth_of(region))) and (region.cut or region.hidden)

    def _score(self, region: ColourRegion) -> tuple[bool, float, int]:
        """Greater is better: regions with depth first, then those closest to the expected size."""
        if region.depth_m is None:
            return False, 0.0, region.area_px
        expected_px = float(self._fit.expected_px(region.depth_m))
        # In half-octave steps, so that among regions of about the right size the largest, the nearest, wins.
        return True, -round(2 * abs(log(region.area_px / expected_px, 2))), region.area_px

    def _completed(self, best: ColourRegion, regions: list[ColourRegion]) -> ColourRegion:
        """The region joined with other pieces of the same object, which something in front of it separates."""
        for other in regions:
            if other is best or best.depth_m is None or other.depth_m is None:
                continue
            if abs(other.depth_m - best.depth_m) < self._reach_m:
                both = _union(best, other)
                if not self._too_large(both):
                    best = both
        return best


def depth_of(region: ColourRegion) -> float:
    """The region's depth, m; NaN without one."""
    return nan if region.depth_m is None else region.depth_m


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
