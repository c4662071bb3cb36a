"""The default detector: finds one connected blob of the object's colour whose size fits its distance.

Compared with the paper's detector: a second region of the same colour does not shift the centroid; noise is
removed; depth is registered and is the median of a window; patches and walls of the right colour are rejected by
size; a blob without depth is reported without depth.
"""

from __future__ import annotations

from math import isnan

import numpy as np

from cocoro.arrays import BoolArray, Float32Array, FloatArray, IntArray
from cocoro.objects import Catalogue
from services.perception.colours import ColourTable
from services.perception.config import PerceptionConfig
from services.perception.evidence import evidences, middle_depths_m
from services.perception.image import ImageSighting, RgbdImage
from services.perception.pieces import OneObject, depth_of
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
        hidden = simple & fit.too_small(found.area_px, depth_m)
        for number in np.flatnonzero(hidden).tolist():
            hidden[number] = _region(found, number, image).hidden
        chosen = np.flatnonzero(simple)
        sightings = self._told(found, chosen, depth_px, depth_m, hidden, image) if len(chosen) else {}
        others = self._one_by_one(found, np.unique(found.number[~simple]), image, min_area_px)
        if others:
            regions = list(others.values())
            joined = Segments.of(
                np.array(list(others)), [region.mask for region in regions], [region.box for region in regions]
            )
            depth_px = image.registered_depth_m.take(image.codes_at(joined.u, joined.v))
            depth_m = np.array([depth_of(region) for region in regions])
            fit = SizeFit(self._shapes.of(joined.number), image.camera, self._config, min_area_px)
            small = fit.too_small(joined.area_px, depth_m)
            hidden = np.array([doubtful and region.hidden for doubtful, region in zip(small, regions, strict=True)])
            sightings.update(self._told(joined, np.arange(len(regions)), depth_px, depth_m, hidden, image))
        return sightings

    def _one_by_one(
        self, found: Segments, numbers: IntArray, image: RgbdImage, min_area_px: float
    ) -> dict[int, ColourRegion]:
        """The region of each of the objects with these numbers that is seen."""
        seen = {}
        for number in numbers.tolist():
            regions = np.flatnonzero(found.number == number)
            largest_first = regions[np.argsort(-found.area_px[regions], kind="stable")].tolist()
            parts = [_region(found, region, image) for region in largest_first]
            fit = SizeFit(self._shapes.of(number), image.camera, self._config, min_area_px)
            best = OneObject(fit, float(self._shapes.reach_m[number])).among(parts)
            if best is not None:
                seen[number] = best
        return seen

    def _told(
        self,
        found: Segments,
        chosen: IntArray,
        depth_px: Float32Array,
        depth_m: FloatArray,
        hidden: BoolArray,
        image: RgbdImage,
    ) -> dict[int, ImageSighting]:
        """The sightings of objects that are the regions `chosen`, by their numbers in the catalogue. `depth_px` are the
        depths of all pixels, m, shape (k,); `depth_m` the regions', m, and `hidden` whether they may be hidden in part,
        shape (n,)."""
        u_px, v_px = (np.add.reduceat(each, found.start)[chosen] / found.area_px[chosen] for each in (found.u, found.v))
        seen = evidences(found, chosen, depth_px, depth_m, self._shapes.reach_m[found.number], image)
        left, top, right, bottom = found.bounds[chosen].T
        cut = (left <= 1) | (top <= 1) | (right >= image.width - 1) | (bottom >= image.height - 1)
        columns = (
            found.number[chosen],
            u_px,
            v_px,
            found.area_px[chosen],
            found.bounds[chosen],
            depth_m[chosen],
            cut,
            hidden[chosen],
        )
        rows = zip(*(column.tolist() for column in columns), seen, strict=True)
        return {
            number: ImageSighting(
                label=self._labels[number],
                u_px=u,
                v_px=v,
                area_px=area,
                box_px=(box[0], box[1], box[2], box[3]),
                depth_m=None if isnan(depth) else depth,
                cut=beyond,
                hidden=part,
                evidence=evidence,
            )
            for number, u, v, area, box, depth, beyond, part, evidence in rows
        }


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
