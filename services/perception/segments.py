"""Finds the connected regions of all objects' colours in a frame at once.

Opening removes specks and threads of noise: what stays of a colour are its squares of 3 x 3 pixels. Each such square
holds one pixel of every third row and column, so those pixels alone tell where in the frame to look.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from cocoro.arrays import BoolArray, CodeArray, ImageArray, IntArray
from services.perception.registration import PixelBox

STEP_PX = 3
MOST_OF_ONE = 8
"""Number of regions of one object that are looked at, the largest ones."""
_AROUND = np.ones((3, 3), dtype=np.uint8)


@dataclass(frozen=True)
class Segments:
    """The n regions of a layer's objects, after opening, and their k pixels, region by region and row by row."""

    number: IntArray
    """The object's number in the catalogue, shape (n,)."""
    start: IntArray
    """Index of a region's first pixel, shape (n,)."""
    area_px: IntArray
    """Number of pixels, shape (n,)."""
    bounds: IntArray
    """Left, top, right, bottom, px; right and bottom are exclusive; shape (n, 4)."""
    u: NDArray[np.int32]
    v: NDArray[np.int32]
    """Each pixel's column and row in the image, shape (k,)."""
    core: BoolArray
    """Whether all pixels around a pixel belong to the region, too; shape (k,)."""

    layer: IntArray
    """The layer of the object's colours, shape (n,)."""

    @classmethod
    def of_masks(
        cls, number: IntArray, layer: IntArray, masks: Sequence[ImageArray], boxes: Sequence[PixelBox]
    ) -> Segments:
        """The regions of objects with these numbers and layers, (n,), by their masks, non-zero inside, and the masks'
        boxes."""
        pixels = [np.nonzero(mask) for mask in masks]
        core = np.concatenate(
            [np.asarray(cv2.erode(mask, _AROUND))[at] != 0 for mask, at in zip(masks, pixels, strict=True)]
        )
        u, v = (
            [(at[1 - axis] + box[axis]).astype(np.int32) for at, box in zip(pixels, boxes, strict=True)]
            for axis in (0, 1)
        )
        bounds = [(x.min(), y.min(), x.max() + 1, y.max() + 1) for x, y in zip(u, v, strict=True)]
        area = np.array([len(x) for x in u])
        return cls(
            number, np.cumsum(area) - area, area, np.array(bounds), np.concatenate(u), np.concatenate(v), core, layer
        )

    @classmethod
    def joined(cls, parts: Sequence[Segments]) -> Segments:
        """The regions of all parts, of which there is at least one."""
        if len(parts) == 1:
            return parts[0]
        whole = cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(cls)))
        return replace(whole, start=np.cumsum(whole.area_px) - whole.area_px)

    def among(self, chosen: BoolArray) -> Segments:
        """Some of the regions, by `chosen`, (n,)."""
        if chosen.all():
            return self
        pixels = np.repeat(chosen, self.area_px)
        area = self.area_px[chosen]
        return Segments(
            self.number[chosen],
            np.cumsum(area) - area,
            area,
            self.bounds[chosen],
            self.u[pixels],
            self.v[pixels],
            self.core[pixels],
            self.layer[chosen],
        )

    @property
    def own(self) -> IntArray:
        """Each pixel's region, shape (k,)."""
        return np.repeat(np.arange(len(self.area_px)), self.area_px)

    def mask(self, region: int, box: PixelBox) -> ImageArray:
        """The region's pixels in a box that contains it: 1 inside, 0 outside; shape (bottom - top, right - left)."""
        left, top, right, bottom = box
        mask = np.zeros((bottom - top, right - left), dtype=np.uint8)
        pixels = slice(self.start[region], self.start[region] + self.area_px[region])
        mask[self.v[pixels] - top, self.u[pixels] - left] = 1
        return mask


def segments(codes: CodeArray, table: ImageArray, layer: int, min_area_px: float) -> Segments | None:
    """The regions of at least so many pixels; None without any. `codes` are from `ColourTable.packed`, shape (height,
    width); `table` is the layer's."""
    rect = _where(codes, table)
    if rect is None:
        return None
    left, top, right, bottom = rect
    labels = table.take(codes[top:bottom, left:right])
    _close(labels, rect, codes.shape)
    # Where the least and the greatest label around a pixel are equal, all are.
    least, greatest = cv2.erode(labels, _AROUND), cv2.dilate(labels, _AROUND)
    core = cv2.bitwise_and(least, cv2.compare(least, greatest, cv2.CMP_EQ))
    opened = np.asarray(cv2.dilate(core, _AROUND), dtype=np.uint8)
    count, connected = cv2.connectedComponents(opened, connectivity=8, ltype=cv2.CV_32S)
    if count < 2:
        return None
    parts: NDArray[np.int32] = np.asarray(connected, dtype=np.int32)
    at = np.flatnonzero(opened != 0)
    order, start, area = _grouped(parts.reshape(-1).take(at), count)
    label = opened.reshape(-1).take(at.take(order))
    mixed = np.flatnonzero(np.minimum.reduceat(label, start) != np.maximum.reduceat(label, start))
    if len(mixed):
        _split(parts, opened, (1 + mixed).tolist(), count)
        each, again = np.unique(parts.reshape(-1).take(at), return_inverse=True)
        order, start, area = _grouped(again + 1, 1 + len(each))
        label = opened.reshape(-1).take(at.take(order))
    number = label.take(start).astype(np.int64) - 1
    kept = _largest(number, np.where(area >= min_area_px, area, 0))
    if not kept.all():
        order, number = order[np.repeat(kept, area)], number[kept]
        area = area[kept]
        start = np.cumsum(area) - area
    if not len(area):
        return None
    pixels = at.take(order)
    place = pixels.astype(np.int32)
    v = place // (right - left)
    u = place - v * (right - left)
    u += left
    v += top
    # Within a region pixels are row by row.
    bounds = np.stack(
        [
            np.minimum.reduceat(u, start),
            v.take(start),
            np.maximum.reduceat(u, start) + 1,
            v.take(start + area - 1) + 1,
        ],
        axis=1,
    ).astype(np.int64)
    inside = np.asarray(core).reshape(-1).take(pixels) != 0
    return Segments(number, start, area, bounds, u, v, inside, np.full(len(area), layer))


def _where(codes: CodeArray, table: ImageArray) -> PixelBox | None:
    """A box that holds all regions, with a pixel around them; None when there are none."""
    height, width = codes.shape
    # The first and the last two pixels of a row count as a square of three, since opening ignores what is beyond.
    first_row, first_column = (0 if size % STEP_PX == 1 else 1 for size in (height, width))
    seen = table.take(codes[first_row::STEP_PX, first_column::STEP_PX])
    rows = np.flatnonzero(np.bitwise_or.reduce(seen, axis=1))
    if not len(rows):
        return None
    columns = np.flatnonzero(np.bitwise_or.reduce(seen, axis=0))
    return (
        max(first_column + STEP_PX * int(columns[0]) - STEP_PX, 0),
        max(first_row + STEP_PX * int(rows[0]) - STEP_PX, 0),
        min(first_column + STEP_PX * int(columns[-1]) + STEP_PX + 1, width),
        min(first_row + STEP_PX * int(rows[-1]) + STEP_PX + 1, height),
    )


def _close(labels: ImageArray, rect: PixelBox, shape: tuple[int, ...]) -> None:
    """Clear the outermost pixels of a part of the image, except along the image's own edges: opening must not take what
    is beyond the part for more of the same."""
    left, top, right, bottom = rect
    if left > 0:
        labels[:, 0] = 0
    if top > 0:
        labels[0] = 0
    if right < shape[1]:
        labels[:, -1] = 0
    if bottom < shape[0]:
        labels[-1] = 0


def _grouped(parts: NDArray[np.int32] | IntArray, count: int) -> tuple[IntArray, IntArray, IntArray]:
    """The order that sorts pixels by their part, 1 to `count` - 1, and each part's first place in it and length."""
    keys = parts.astype(np.uint16) if count <= 65536 else parts  # short ones are sorted faster
    order = np.argsort(keys, kind="stable")
    start = np.searchsorted(keys.take(order), np.arange(1, count + 1))
    return order, start[:-1], np.diff(start)


def _split(parts: NDArray[np.int32], labels: ImageArray, mixed: list[int], count: int) -> None:
    """Give each object's share of the parts that several objects' regions make together, where they touch, numbers of
    their own, from `count` on."""
    for part in mixed:
        inside = parts == part
        for label in np.unique(labels[inside]).tolist():
            found, shares = cv2.connectedComponents((inside & (labels == label)).view(np.uint8), connectivity=8)
            shares = np.asarray(shares)
            parts[shares > 0] = shares[shares > 0] + (count - 1)
            count += found - 1


def _largest(number: IntArray, area: IntArray) -> BoolArray:
    """Which regions have an area and are among the `MOST_OF_ONE` largest of their object, shape (n,)."""
    kept: BoolArray = area > 0
    for crowded in np.flatnonzero(np.bincount(number[kept]) > MOST_OF_ONE).tolist():
        own = np.flatnonzero(kept & (number == crowded))
        kept[own[np.argsort(-area[own], kind="stable")[MOST_OF_ONE:]]] = False
    return kept
