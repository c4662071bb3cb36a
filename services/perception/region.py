"""A connected region of one colour, with the registered depth of itself and its surroundings."""

from __future__ import annotations

from functools import cached_property
from typing import Any

import cv2
import numpy as np

from cocoro.arrays import BoolArray, Float32Array, MaskArray, median
from services.perception.image import PixelBox, RgbdImage

MIN_DEPTH_PIXELS = 6
MIN_DEPTH_SHARE = 0.4
"""A region with depth on a smaller share of its pixels has none. Past an object that is too near to be measured, the
depth camera sees up to 25 mm of the background, 0.38 of a can, which is not the object's depth."""
NEARER_STEP_M = 0.015
"""Something nearer than the region by this much may hide part of it."""
NEARER_SHARE = 0.12
UNKNOWN_SHARE = 0.45
UNKNOWN_WITHIN_M = 1.0
"""Shares of the outline beside something nearer, or beside no data, from which more of the object may be hidden. No
data counts only beside regions within 1 m, where it may be the robot's own hand, too near to be measured; farther
away it is beyond the sensor's range. An infrared shadow takes a smaller share."""
_AROUND = np.ones((3, 3), dtype=np.uint8)


def depth_doubt_m(depth_m: Any) -> Any:
    """Standard deviation of a depth, m, for depths in m of any shape: the sensor's noise and quantisation, growing
    with its square."""
    return 0.003 + 0.0025 * depth_m**2


class ColourRegion:
    """A region of the image. `mask` is uint8, non-zero inside, shape of `box`; `box` is its place in the image with a
    margin, px."""

    def __init__(self, mask: MaskArray, box: PixelBox, image: RgbdImage) -> None:
        self.mask = mask
        self.box = box
        self.image = image
        moments = cv2.moments(mask, binaryImage=True)
        self.area_px = round(moments["m00"])
        self.u_px = moments["m10"] / moments["m00"] + box[0]
        self.v_px = moments["m01"] / moments["m00"] + box[1]
        left, top, width, height = cv2.boundingRect(mask)
        left, top = left + box[0], top + box[1]
        self.bounds: PixelBox = (left, top, left + width, top + height)

    @staticmethod
    def margin_px(image: RgbdImage) -> int:
        """The margin around a region: the ring of `surroundings` and one pixel."""
        return ring_px(image) + 2

    @property
    def diagonal_px(self) -> float:
        left, top, right, bottom = self.bounds
        return float(np.hypot(right - left, bottom - top))

    @property
    def cut(self) -> bool:
        """Whether the region touches the image's edge."""
        left, top, right, bottom = self.bounds
        return left <= 1 or top <= 1 or right >= self.image.width - 1 or bottom >= self.image.height - 1

    @cached_property
    def depth(self) -> Float32Array:
        """Registered depth of `box`, m; NaN without data."""
        return self.image.depth_m(self.box)

    @cached_property
    def depth_m(self) -> float | None:
        """Depth of the visible surface, m: the median of the region's middle, or of all of it when the middle has too
        little data. None without enough data."""
        inside = (self.mask > 0) & np.isfinite(self.depth)
        enough = max(MIN_DEPTH_PIXELS, MIN_DEPTH_SHARE * self.area_px)
        if np.count_nonzero(inside) < enough:
            return None
        left, top, right, bottom = (bound - start for bound, start in zip(self.bounds, self.box[:2] * 2, strict=True))
        across, down = (right - left) // 4, (bottom - top) // 4
        middle = np.zeros_like(inside)
        middle[top + down : bottom - down, left + across : right - across] = True
        middle &= inside
        window = middle if np.count_nonzero(middle) >= enough / 2 else inside
        return median(self.depth[window])

    @cached_property
    def surroundings(self) -> BoolArray:
        """A ring outside of the outline, shape of `box`, beyond blended pixels and the pixel that cleaning removes."""
        ring = 2 * ring_px(self.image) + 1
        outer = cv2.dilate(self.mask, np.ones((ring, ring), dtype=np.uint8))
        inner = cv2.dilate(self.mask, _AROUND)
        return np.asarray(outer, dtype=np.bool_) & ~np.asarray(inner, dtype=np.bool_)

    @cached_property
    def hidden(self) -> bool:
        """Something nearer is along enough of the outline to hide more of the object."""
        around = self.surroundings
        total = np.count_nonzero(around)
        if total == 0:
            return True
        own = np.where((self.mask > 0) & np.isfinite(self.depth), self.depth, np.float32(0))
        reach = 2 * ring_px(self.image) + 3
        beside = np.asarray(cv2.dilate(own, np.ones((reach, reach), dtype=np.uint8)))
        known = np.isfinite(self.depth)
        step = NEARER_STEP_M + depth_doubt_m(beside)
        nearer = np.count_nonzero(around & known & (self.depth < beside - step))
        unknown = int(np.count_nonzero(around & ~known))
        if self.depth_m is None or self.depth_m > UNKNOWN_WITHIN_M:
            unknown = 0
        return bool(nearer >= NEARER_SHARE * total or unknown >= UNKNOWN_SHARE * total)

    def split_by_depth(self) -> list[tuple[MaskArray, PixelBox]]:
        """The region cut where its depth jumps, for example an object before a wall of its colour."""
        depth = np.nan_to_num(self.depth, nan=0.0)
        far = np.asarray(cv2.dilate(depth, _AROUND))
        near = np.asarray(cv2.erode(np.where(depth > 0, depth, np.float32(99)), _AROUND))
        smooth = far - near < 0.03 + 4 * depth_doubt_m(far)
        return components(
            ((self.mask > 0) & smooth & (depth > 0)).astype(np.uint8), self.box[:2], self.image, self.area_px // 50
        )


def components(
    mask: MaskArray, origin: tuple[int, int], image: RgbdImage, min_area_px: float, at_most: int = 8
) -> list[tuple[MaskArray, PixelBox]]:
    """The largest connected regions of a mask, each with a margin, and their boxes in the image. `mask` covers the
    part of the image whose first pixel is `origin`, (column, row)."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_32S)
    by_area = 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA], kind="stable")  # label 0 is the background
    found = []
    for i in by_area[:at_most]:
        left, top, width, height, area = (int(value) for value in stats[i])
        if area < min_area_px:
            break
        own = (origin[0] + left, origin[1] + top, origin[0] + left + width, origin[1] + top + height)
        box = image.clip(own, ColourRegion.margin_px(image))
        out = np.zeros((box[3] - box[1], box[2] - box[0]), dtype=np.uint8)
        inner = out[own[1] - box[1] : own[3] - box[1], own[0] - box[0] : own[2] - box[0]]
        inner[:] = labels[top : top + height, left : left + width] == i
        found.append((out, box))
    return found


def ring_px(image: RgbdImage) -> int:
    return 3 if image.scale > 0.75 else 2
