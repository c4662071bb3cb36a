"""Finds the connected regions of all objects' colours in a frame at once.

Opening removes specks and threads of noise: what stays of a colour are its squares of 3 x 3 pixels. Each such square
holds one pixel of every third row and column, so those pixels alone tell where in the frame to look.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cocoro.arrays import BoolArray, CodeArray, FloatArray, ImageArray, IntArray
from services.perception.registration import PixelBox
from services.perception.runs import Runs, run_ends, spread_out

STEP_PX = 3
MOST_OF_ONE = 8
"""Number of regions of one object that are looked at, the largest ones."""
SHORT_PX = 1 << 20
"""Parts of a smaller picture are numbered by 16 bits, which takes less time: of parts made of squares of 3 x 3 pixels,
with a row or column between two of them, it has at most one for each 16 pixels."""
_AROUND = np.ones((3, 3), dtype=np.uint8)


@dataclass(frozen=True)
class Segments:
    """The n regions of a layer's objects, after opening, and their m runs and k pixels, region by region and row by
    row."""

    number: IntArray
    """The object's number in the catalogue, shape (n,)."""
    layer: IntArray
    """The layer of the object's colours, shape (n,)."""
    area_px: IntArray
    """Number of pixels, shape (n,)."""
    bounds: IntArray
    """Left, top, right, bottom, px; right and bottom are exclusive; shape (n, 4)."""
    centre_px: FloatArray
    """Mean column and row of the pixels, shape (n, 2)."""
    run_count: IntArray
    """Number of runs, shape (n,)."""
    runs: Runs
    core: BoolArray
    """Whether all pixels around a pixel belong to the region, too; shape (k,)."""

    @classmethod
    def of_runs(cls, number: IntArray, layer: IntArray, runs: Runs, first: IntArray, core: BoolArray) -> Segments:
        """The regions whose runs begin at `first`, (n,)."""
        run_count = _counts(first, len(runs.length))
        area = np.add.reduceat(runs.length, first)
        right = runs.left + runs.length
        bounds = np.stack(
            [
                np.minimum.reduceat(runs.left, first),
                runs.row.take(first),
                np.maximum.reduceat(right, first),
                runs.row.take(first + run_count - 1) + 1,
            ],
            axis=1,
        )
        twice = runs.length * np.stack([runs.left + right - 1, 2 * runs.row])
        centre = np.add.reduceat(twice, first, axis=1) / (2 * area)
        return cls(number, layer, area, bounds, centre.T, run_count, runs, core)

    @classmethod
    def of_masks(
        cls,
        number: IntArray,
        layer: IntArray,
        masks: Sequence[ImageArray],
        boxes: Sequence[PixelBox],
        image_width: int,
    ) -> Segments:
        """The regions of objects with these numbers and layers, (n,), by their masks, 1 inside, and the masks'
        boxes."""
        parts, cores = [], []
        for mask, (left, top, _, _) in zip(masks, boxes, strict=True):
            framed = _framed(mask)
            parts.append(Runs.of(*run_ends(framed), framed.shape[1], (left - 1, top), image_width))
            cores.append(np.asarray(cv2.erode(mask, _AROUND))[mask != 0] != 0)
        counts = np.array([len(runs.length) for runs in parts])
        return cls.of_runs(number, layer, Runs.joined(parts), np.cumsum(counts) - counts, np.concatenate(cores))

    @classmethod
    def joined(cls, parts: Sequence[Segments]) -> Segments:
        """The regions of all parts, of which there is at least one."""
        if len(parts) == 1:
            return parts[0]
        arrays = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("number", "layer", "area_px", "bounds", "centre_px", "run_count", "core")
        }
        return cls(**arrays, runs=Runs.joined([part.runs for part in parts]))

    def among(self, chosen: BoolArray) -> Segments:
        """Some of the regions, by `chosen`, (n,)."""
        if chosen.all():
            return self
        return Segments(
            self.number[chosen],
            self.layer[chosen],
            self.area_px[chosen],
            self.bounds[chosen],
            self.centre_px[chosen],
            self.run_count[chosen],
            self.runs.among(np.repeat(chosen, self.run_count)),
            self.core[np.repeat(chosen, self.area_px)],
        )

    @cached_property
    def start(self) -> IntArray:
        """Index of a region's first pixel, shape (n,)."""
        return self.area_px.cumsum() - self.area_px

    def counted(self, pixels: IntArray) -> tuple[IntArray, IntArray]:
        """Of some pixels by their ascending indices: each region's first one among them, and its number of them,
        (n,)."""
        first = np.searchsorted(pixels, self.start)
        return first, _counts(first, len(pixels))

    def mask(self, region: int, box: PixelBox) -> ImageArray:
        """The region's pixels in a box that contains it: 1 inside, 0 outside; shape (bottom - top, right - left)."""
        left, top, right, bottom = box
        mask = np.zeros((bottom - top, right - left), dtype=np.uint8)
        first = int(self.run_count[:region].sum())
        runs = self.runs.among(slice(first, first + int(self.run_count[region])))
        mask.reshape(-1)[spread_out((runs.row - top) * (right - left) + runs.left - left, runs.length)] = 1
        return mask


def segments(codes: CodeArray, table: ImageArray, layer: int, min_area_px: float) -> Segments | None:
    """The regions of at least so many pixels; None without any. `codes` are from `ColourTable.packed`, shape (height,
    width); `table` is the layer's."""
    rect = _where(codes, table)
    if rect is None:
        return None
    left, top, right, bottom = rect
    labels = np.asarray(cv2.LUT(codes[top:bottom, left:right], table), dtype=np.uint8)
    _close(labels, rect, codes.shape)
    # Where the least and the greatest label around a pixel are equal, all are.
    least, greatest = cv2.erode(labels, _AROUND), cv2.dilate(labels, _AROUND)
    core = _framed(np.asarray(cv2.bitwise_and(least, cv2.compare(least, greatest, cv2.CMP_EQ)), dtype=np.uint8))
    opened = np.asarray(cv2.dilate(core, _AROUND), dtype=np.uint8)
    opened[:, 0] = opened[:, -1] = 0
    short = opened.size < SHORT_PX
    count, parts = cv2.connectedComponents(opened, connectivity=8, ltype=cv2.CV_16U if short else cv2.CV_32S)
    if count < 2:
        return None
    parts = np.asarray(parts)
    begin, end = run_ends(opened)
    label, part = opened.reshape(-1).take(begin), parts.reshape(-1).take(begin)
    order, first = _grouped(label, part)
    if len(first) != count - 1:  # some parts are of several objects, which touch
        often = np.bincount(part.take(order.take(first)))
        _split(parts, opened, np.flatnonzero(often > 1).tolist(), count)
        order, first = _grouped(label, parts.reshape(-1).take(begin))
    begin, end = begin.take(order), end.take(order)
    number = label.take(order.take(first)).astype(np.int64) - 1
    area = np.add.reduceat(end - begin, first)
    kept = _largest(number, np.where(area >= min_area_px, area, 0))
    if not kept.all():
        counts = _counts(first, len(begin))
        runs_kept, counts = np.repeat(kept, counts), counts[kept]
        begin, end, number, first = begin[runs_kept], end[runs_kept], number[kept], np.cumsum(counts) - counts
    if not len(number):
        return None
    inside = core.reshape(-1).take(spread_out(begin, end - begin)) != 0
    runs = Runs.of(begin, end, opened.shape[1], (left - 1, top), codes.shape[1])
    return Segments.of_runs(number, np.full(len(number), layer), runs, first, inside)


def _counts(first: IntArray, total: int) -> IntArray:
    """The sizes of groups that begin at `first` and follow one another up to `total`."""
    counts = np.empty_like(first)
    np.subtract(first[1:], first[:-1], out=counts[:-1])
    counts[-1] = total - first[-1]
    return counts


def _framed(picture: ImageArray) -> ImageArray:
    """The picture with a column of background at either side, so that no run goes on in the next row."""
    return np.asarray(cv2.copyMakeBorder(picture, 0, 0, 1, 1, cv2.BORDER_CONSTANT, value=0), dtype=np.uint8)


def _where(codes: CodeArray, table: ImageArray) -> PixelBox | None:
    """A box that holds all regions, with a pixel around them; None when there are none."""
    height, width = codes.shape
    # The first and the last two pixels of a row count as a square of three, since opening ignores what is beyond.
    first_row, first_column = (0 if size % STEP_PX == 1 else 1 for size in (height, width))
    seen = cv2.LUT(np.ascontiguousarray(codes[first_row::STEP_PX, first_column::STEP_PX]), table)
    left, top, columns, rows = cv2.boundingRect(seen)
    if not rows:
        return None
    return (
        max(first_column + STEP_PX * left - STEP_PX, 0),
        max(first_row + STEP_PX * top - STEP_PX, 0),
        min(first_column + STEP_PX * (left + columns) + 1, width),
        min(first_row + STEP_PX * (top + rows) + 1, height),
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


def _grouped(label: ImageArray, part: NDArray[Any]) -> tuple[IntArray, IntArray]:
    """The order that sorts runs by their labels, then by their connected parts, and where in it each part of a label
    begins."""
    by_part = np.argsort(part, kind="stable")
    order = by_part.take(np.argsort(label.take(by_part), kind="stable"))
    label, part = label.take(order), part.take(order)
    changes = np.flatnonzero((part[1:] != part[:-1]) | (label[1:] != label[:-1]))
    return order, np.append(0, changes + 1)


def _split(parts: NDArray[Any], labels: ImageArray, mixed: list[int], count: int) -> None:
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
