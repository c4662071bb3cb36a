"""The default detector: finds one connected blob of the object's colour whose size fits its distance.

Compared with the paper's detector: a second region of the same colour does not shift the centroid; noise is
removed; depth is registered and is the median of a window; patches and walls of the right colour are rejected by
size; a blob without depth is reported without depth.
"""

from __future__ import annotations

from math import log

import numpy as np

from cocoro.arrays import Float32Array, FloatArray, IntArray
from cocoro.objects import Catalogue
from services.perception.colours import ColourTable
from services.perception.config import PerceptionConfig
from services.perception.evidence import evidences, middle_depths_m
from services.perception.image import ImageSighting, RgbdImage
from services.perception.region import ColourRegion
from services.perception.segments import Segments, segments
from services.perception.shapes import Shapes
from services.perception.sizes import SizeFit


class BlobDetector:
    def __init__(self, catalogue: Catalogue, config: PerceptionConfig) -> None:
        self._labels = catalogue.labels
        self._config = config
        self._table = ColourTable(catalogue)
        self._shapes = Shapes(catalogue.objects)

    def detect(self, image: RgbdImage) -> list[ImageSighting]:
        codes = self._table.packed(image.colour)
        min_area_px = self._config.min_area_px * image.scale**2
        layers = [segments(codes, layer.table, min_area_px) for layer in self._table.layers]
        found = [layer for layer in layers if layer is not None]
        if not found:
            return []
        image.register(_with_margin(np.concatenate([layer.bounds for layer in found]), image))
        sightings: dict[int, ImageSighting] = {}
        for layer in found:
            sightings.update(self._sightings(layer, image, min_area_px))
        return [sightings[number] for number in sorted(sightings)]

    def _sightings(self, found: Segments, image: RgbdImage, min_area_px: float) -> dict[int, ImageSighting]:
        """The objects among a layer's regions, by their number in the catalogue.

        An object's only region, when it may be all of the object, is the object; this is decided for all such regions
        at once. The others, in several pieces, hidden in part or before something of their colour, are looked at one by
        one.
        """
        depth_px = image.registered_depth_m.take(image.codes_at(found.u, found.v))
        depth_m = middle_depths_m(found, depth_px)
        fit = SizeFit(self._shapes.of(found.number), image.camera, self._config, min_area_px)
        diagonal_px = np.hypot(*(found.bounds[:, 2:] - found.bounds[:, :2]).T)
        alone = np.bincount(found.number)[found.number] == 1
        simple = alone & fit.whole(found.area_px, diagonal_px, depth_m)
        sightings = self._simple(np.flatnonzero(simple), found, depth_px, depth_m, fit, image)
        for number in np.unique(found.number[~simple]).tolist():
            regions = np.flatnonzero(found.number == number)
            largest_first = regions[np.argsort(-found.area_px[regions], kind="stable")]
            parts = [_region(found, region, image) for region in largest_first.tolist()]
            own_fit = SizeFit(self._shapes.of(number), image.camera, self._config, min_area_px)
            sighting = _OneObject(self._labels[number], own_fit).find(parts, float(self._shapes.reach_m[number]))
            if sighting is not None:
                sightings[number] = sighting
        return sightings

    def _simple(
        self,
        chosen: IntArray,
        found: Segments,
        depth_px: Float32Array,
        depth_m: FloatArray,
        fit: SizeFit,
        image: RgbdImage,
    ) -> dict[int, ImageSighting]:
        """The sightings of regions, `chosen`, each of which may be all of an object."""
        u_px, v_px = (np.add.reduceat(each, found.start)[chosen] / found.area_px[chosen] for each in (found.u, found.v))
        seen = evidences(found, chosen, depth_px, depth_m, self._shapes.reach_m[found.number], image)
        left, top, right, bottom = found.bounds[chosen].T
        cut = (left <= 1) | (top <= 1) | (right >= image.width - 1) | (bottom >= image.height - 1)
        doubtful = fit.too_small(found.area_px, depth_m)[chosen]
        rows = zip(
            chosen.tolist(),
            found.number[chosen].tolist(),
            u_px.tolist(),
            v_px.tolist(),
            found.area_px[chosen].tolist(),
            found.bounds[chosen].tolist(),
            depth_m[chosen].tolist(),
            cut.tolist(),
            doubtful.tolist(),
            seen,
            strict=True,
        )
        return {
            number: ImageSighting(
                label=self._labels[number],
                u_px=u,
                v_px=v,
                area_px=area,
                box_px=(box[0], box[1], box[2], box[3]),
                depth_m=None if depth != depth else depth,
                cut=beyond,
                hidden=small and _region(found, region, image).hidden,
                evidence=evidence,
            )
            for region, number, u, v, area, box, depth, beyond, small, evidence in rows
        }


class _OneObject:
    """Finds one object among regions of its colour."""

    def __init__(self, label: str, fit: SizeFit) -> None:
        self._label = label
        self._fit = fit

    def find(self, parts: list[ColourRegion], reach_m: float) -> ImageSighting | None:
        """`parts` are the regions, the largest first; the object reaches `reach_m` from its centre."""
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
        best = self._completed(max(plausible, key=self._score), regions, reach_m)
        return ImageSighting(
            label=self._label,
            u_px=best.u_px,
            v_px=best.v_px,
            area_px=best.area_px,
            box_px=best.bounds,
            depth_m=best.depth_m,
            cut=best.cut,
            hidden=bool(self._fit.too_small(best.area_px, _depth_m(best))) and best.hidden,
            evidence=best.evidence(reach_m),
        )

    def _too_large(self, region: ColourRegion) -> bool:
        return bool(self._fit.too_large(region.area_px, region.diagonal_px, _depth_m(region)))

    def _whole(self, region: ColourRegion) -> bool:
        return bool(self._fit.whole(region.area_px, region.diagonal_px, _depth_m(region)))

    def _partly_hidden(self, region: ColourRegion) -> bool:
        return bool(self._fit.partly_hidden(region.area_px, _depth_m(region))) and (region.cut or region.hidden)

    def _score(self, region: ColourRegion) -> tuple[bool, float, int]:
        """Greater is better: regions with depth first, then those closest to the expected size."""
        if region.depth_m is None:
            return False, 0.0, region.area_px
        expected_px = float(self._fit.expected_px(region.depth_m))
        # In half-octave steps, so that among regions of about the right size the largest, the nearest, wins.
        return True, -round(2 * abs(log(region.area_px / expected_px, 2))), region.area_px

    def _completed(self, best: ColourRegion, regions: list[ColourRegion], reach_m: float) -> ColourRegion:
        """The region joined with other pieces of the same object, which something in front of it separates."""
        for other in regions:
            if other is best or best.depth_m is None or other.depth_m is None:
                continue
            if abs(other.depth_m - best.depth_m) < reach_m:
                both = _union(best, other)
                if not self._too_large(both):
                    best = both
        return best


def _depth_m(region: ColourRegion) -> float:
    """The region's depth, m; NaN without one."""
    return float("nan") if region.depth_m is None else region.depth_m


def _region(found: Segments, number: int, image: RgbdImage) -> ColourRegion:
    left, top, right, bottom = found.bounds[number].tolist()
    box = image.clip((left, top, right, bottom), ColourRegion.margin_px(image))
    return ColourRegion(found.mask(number, box), box, image)


def _with_margin(bounds: IntArray, image: RgbdImage) -> IntArray:
    """The boxes (n, 4), px, of regions with these bounds: grown by a margin and clipped to the image."""
    margin = ColourRegion.margin_px(image)
    lowest, highest = np.array([0, 0]), np.array([image.width, image.height])
    return np.concatenate(
        [np.maximum(bounds[:, :2] - margin, lowest), np.minimum(bounds[:, 2:] + margin, highest)], axis=1
    )


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
