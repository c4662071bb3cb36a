"""The default detector: finds one connected blob of the object's colour whose size fits its distance.

Compared with the paper's detector: a second region of the same colour does not shift the centroid; noise is
removed; depth is registered and is the median of a window; patches and walls of the right colour are rejected by
size; a blob without depth is reported without depth.
"""

from __future__ import annotations

from math import isnan

import cv2
import numpy as np

from cocoro.arrays import BoolArray, CodeArray, FloatArray, IntArray
from cocoro.objects import Catalogue
from services.perception.colours import ColourTable
from services.perception.config import PerceptionConfig
from services.perception.evidence import evidence_of, middle_depths_m
from services.perception.image import ImageSighting, OwnEvidence, RgbdImage
from services.perception.pieces import OneObject, depth_of
from services.perception.region import ColourRegion, components
from services.perception.segments import Segments, segments
from services.perception.shapes import Shapes
from services.perception.sizes import SizeFit

SMALL = 0.75
"""Pictures of a smaller scale are small."""
_AROUND = np.ones((3, 3), dtype=np.uint8)


class BlobDetector:
    def __init__(self, catalogue: Catalogue, config: PerceptionConfig) -> None:
        self._labels = catalogue.labels
        self._config = config
        self._table = ColourTable(catalogue)
        self._shapes = Shapes(catalogue.objects)

    def detect(self, image: RgbdImage) -> list[ImageSighting]:
        codes = self._table.packed(image.colour)
        min_area_px = self._config.min_area_px * image.scale**2
        layers = [segments(codes, layer.table, number, min_area_px) for number, layer in enumerate(self._table.layers)]
        regions = [layer for layer in layers if layer is not None]
        if image.scale < SMALL:
            regions += self._thin(codes, regions, image, min_area_px)
        return self._sightings(Segments.joined(regions), image, min_area_px) if regions else []

    def _thin(self, codes: CodeArray, found: list[Segments], image: RgbdImage, min_area_px: float) -> list[Segments]:
        """The regions of objects without any so far, thinner than opening lets pass, as a distant object is in a small
        picture: what is beyond the outermost of its pixels counts as more of it."""
        seen = {number for layer in found for number in layer.number.tolist()}
        thin = []
        for place, layer in enumerate(self._table.layers):
            labels = layer.table.take(codes)
            # Most pixels have no object's colour, and are not counted.
            counts = np.bincount(labels[labels != 0], minlength=1)
            for label in (1 + np.flatnonzero(counts[1:] >= min_area_px)).tolist():
                if label - 1 in seen:
                    continue
                mask = (labels == label).view(np.uint8)
                left, top, width, height = cv2.boundingRect(mask)
                opened = cv2.morphologyEx(mask[top : top + height, left : left + width], cv2.MORPH_OPEN, _AROUND)
                parts = components(np.asarray(opened, dtype=np.uint8), (left, top), image, min_area_px)
                if parts:
                    masks, boxes = zip(*parts, strict=True)
                    same = np.ones(len(parts), dtype=np.int64)
                    thin.append(Segments.of_masks((label - 1) * same, place * same, masks, boxes, image.width))
        return thin

    def _sightings(self, found: Segments, image: RgbdImage, min_area_px: float) -> list[ImageSighting]:
        """The objects among the regions of all colours, in the catalogue's order.

        An object's only region, when it may be all of the object, is the object; this is decided for all such regions
        at once. The others, in several pieces, hidden in part or before something of their colour, are looked at one by
        one.
        """
        image.register(_with_margin(found.bounds, image))
        depth_m = middle_depths_m(found, image)
        fit = SizeFit(self._shapes.of(found.number), image.camera, self._config, min_area_px)
        diagonal_px = np.hypot(*(found.bounds[:, 2:] - found.bounds[:, :2]).T)
        alone = np.bincount(found.number)[found.number] == 1
        simple = alone & fit.whole(found.area_px, diagonal_px, depth_m)
        hidden = simple & fit.too_small(found.area_px, depth_m)
        for number in np.flatnonzero(hidden).tolist():
            hidden[number] = _region(found, number, image).hidden
        parts = [found.among(simple)] if simple.any() else []
        depth_m, hidden = depth_m[simple], hidden[simple]
        if not simple.all():
            others = self._one_by_one(found, sorted(set(found.number[~simple].tolist())), image, min_area_px)
            if others:
                numbers, regions = np.array(list(others)), list(others.values())
                layers = np.array([self._table.layer_of[number] for number in others])
                parts.append(
                    Segments.of_masks(
                        numbers, layers, [each.mask for each in regions], [each.box for each in regions], image.width
                    )
                )
                of_others = np.array([depth_of(region) for region in regions])
                fit = SizeFit(self._shapes.of(numbers), image.camera, self._config, min_area_px)
                small = fit.too_small(parts[-1].area_px, of_others).tolist()
                depth_m = np.append(depth_m, of_others)
                hidden = np.append(hidden, [less and each.hidden for less, each in zip(small, regions, strict=True)])
        return self._told(Segments.joined(parts), depth_m, hidden, image) if parts else []

    def _one_by_one(
        self, found: Segments, numbers: list[int], image: RgbdImage, min_area_px: float
    ) -> dict[int, ColourRegion]:
        """The region of each of the objects with these numbers that is seen."""
        seen = {}
        for number in numbers:
            regions = np.flatnonzero(found.number == number)
            largest_first = regions[np.argsort(-found.area_px[regions], kind="stable")].tolist()
            parts = [_region(found, region, image) for region in largest_first]
            fit = SizeFit(self._shapes.of(number), image.camera, self._config, min_area_px)
            best = OneObject(fit, float(self._shapes.reach_m[number])).among(parts)
            if best is not None:
                seen[number] = best
        return seen

    def _told(self, found: Segments, depth_m: FloatArray, hidden: BoolArray, image: RgbdImage) -> list[ImageSighting]:
        """The sightings of objects that are these regions, in the catalogue's order. `depth_m` are the regions' depths,
        m, NaN without, and `hidden` is whether something may hide a part of them, shape (n,)."""
        left, top, right, bottom = found.bounds.T
        cut = (left <= 1) | (top <= 1) | (right >= image.width - 1) | (bottom >= image.height - 1)
        deep = ~np.isnan(depth_m)
        evidence: list[OwnEvidence | None] = [None] * len(depth_m)
        if deep.any():
            all_evidence = evidence_of(
                found.among(deep), depth_m[deep], self._shapes.reach_m[found.number[deep]], image
            )
            for number, region in enumerate(np.flatnonzero(deep).tolist()):
                evidence[region] = OwnEvidence(all_evidence, number)
        columns = (*found.centre_px.T, found.area_px, found.bounds, depth_m, cut, hidden)
        numbers = found.number.tolist()
        rows = list(zip(*(column.tolist() for column in columns), evidence, strict=True))
        sightings = []
        for region in sorted(range(len(numbers)), key=numbers.__getitem__):
            u, v, area, (left, top, right, bottom), depth, beyond, part, seen = rows[region]
            sightings.append(
                ImageSighting(
                    label=self._labels[numbers[region]],
                    u_px=u,
                    v_px=v,
                    area_px=area,
                    box_px=(left, top, right, bottom),
                    depth_m=None if isnan(depth) else depth,
                    cut=beyond,
                    hidden=part,
                    evidence=seen,
                )
            )
        return sightings


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
