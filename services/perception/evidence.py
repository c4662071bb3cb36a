"""Takes from the pixels of many regions at once what their objects are placed by: depths and evidence."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from cocoro.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray, median
from services.perception.image import Evidence, RgbdImage
from services.perception.region import MIN_DEPTH_PIXELS, MIN_DEPTH_SHARE, depth_doubt_m, ring_px
from services.perception.runs import spread_out
from services.perception.segments import Segments

MAX_SURFACE_POINTS, MAX_OUTLINE_RAYS, MAX_FREE_RAYS = 48, 36, 24
"""More pieces of evidence place an object hardly better, and the time of many objects grows with them."""
SMOOTHED_DOUBT = 0.7
"""Standard deviation of a surface point's depth, the mean of up to nine pixels, relative to that of one pixel. The mean
does not reduce what neighbours have in common: quantisation, and the grain of the sensor's pattern."""


def middle_depths_m(found: Segments, image: RgbdImage) -> FloatArray:
    """Depth of each region's visible surface, m, shape (n,): the median of its middle, or of all of it when the middle
    has too little data; NaN without enough."""
    area = found.area_px
    codes = image.codes_at(found.runs.at)
    data = area - found.counted(np.flatnonzero(codes >= image.no_depth_code))[1]
    enough = np.maximum(MIN_DEPTH_PIXELS, MIN_DEPTH_SHARE * area)
    own, middle = _middle(found)
    of_middle = codes.take(middle)
    known = np.flatnonzero(of_middle < image.no_depth_code)
    own, of_middle = own.take(known), of_middle.take(known)
    in_middle = np.bincount(own, minlength=len(area))
    # By region, then by code, and codes rise with the depth: to sort numbers of 16 bits twice takes half of the time.
    by_code = np.argsort(of_middle, kind="stable")
    by_region = of_middle.take(by_code.take(np.argsort(own.astype(np.uint16).take(by_code), kind="stable")))
    first = np.cumsum(in_middle) - in_middle
    depth_m = np.full(len(area), np.nan)
    usual = np.flatnonzero((data >= enough) & (in_middle >= enough / 2))
    low, high = first[usual] + (in_middle[usual] - 1) // 2, first[usual] + in_middle[usual] // 2
    table = image.registered_depth_m
    depth_m[usual] = (table[by_region[low]] + table[by_region[high]]) / np.float32(2)
    for region in np.flatnonzero((data >= enough) & (in_middle < enough / 2)).tolist():
        pixels = table[codes[found.start[region] : found.start[region] + area[region]]]
        depth_m[region] = median(pixels[np.isfinite(pixels)])
    return depth_m


def _middle(found: Segments) -> tuple[IntArray, IntArray]:
    """The pixels in the middle of each region's bounds, by their indices, and each one's region, shape (k,)."""
    runs = found.runs
    left, top, right, bottom = found.bounds.T
    across, down = (right - left) // 4, (bottom - top) // 4
    middle = np.stack([left + across, top + down, right - across, bottom - down])
    left, top, right, bottom = middle.repeat(found.run_count, axis=1)
    begin = np.maximum(runs.left, left)
    length = np.minimum(runs.left + runs.length, right) - begin
    length[(runs.row < top) | (runs.row >= bottom)] = 0
    np.maximum(length, 0, out=length)
    own = np.arange(len(found.number)).repeat(found.run_count).repeat(length)
    return own, spread_out(runs.first + begin - runs.left, length)


def evidence_of(found: Segments, depth_m: FloatArray, reach_m: FloatArray, image: RgbdImage) -> Evidence:
    """The evidence of n regions with depth for fitting their objects. `depth_m` are the regions' from
    `middle_depths_m`, and `reach_m` how far their objects reach from their centres, m, shape (n,)."""
    count = len(found.start)
    at = found.runs.at
    edge = np.flatnonzero(~found.core)
    edge_first, edges = found.counted(edge)
    # On the surface: pixels of the core, where that is most of the region.
    thin = edges >= (found.area_px + 1) // 2
    surface = np.flatnonzero(found.core | np.repeat(thin, found.area_px) if thin.any() else found.core)
    own, within, picked = _spread(*found.counted(surface), MAX_SURFACE_POINTS)
    pixels = at.take(surface.take(picked))
    window_m = 1.5 * reach_m + depth_doubt_m(depth_m)
    depth, on_surface = _smoothed_m(pixels, depth_m.astype(np.float32)[own], window_m.astype(np.float32)[own], image)
    depth = np.where(on_surface, depth, np.float32(1))
    width = int(within.max()) + 1
    points_m = _placed(_directions(pixels, image) * depth, own * width + within, (count, width))
    certainty = _placed(
        (on_surface / (SMOOTHED_DOUBT * depth_doubt_m(depth)))[None], own * width + within, (count, width)
    )
    # Rays: along the edge, and around it.
    own_edge, within_edge, picked = _spread(edge_first, edges, MAX_OUTLINE_RAYS)
    inside = at.take(edge.take(picked))
    at_beside, depth_beside, first, counts = surroundings(found, image)
    own_beside, within_beside, beside = _spread(first, counts, MAX_FREE_RAYS)
    met = np.minimum(edges, MAX_OUTLINE_RAYS)
    rays = met + np.minimum(counts, MAX_FREE_RAYS)
    width = max(int(rays.max()), 1)  # without any ray, one of fill
    place = np.concatenate([own_edge * width + within_edge, own_beside * width + met[own_beside] + within_beside])
    free_to = depth_beside.take(beside)
    free_to -= 0.01 + depth_doubt_m(free_to)
    side = np.repeat(np.array([1.0, -1.0]), [len(inside), len(beside)])
    surface_count = np.bincount(own[on_surface], minlength=count)
    free_to_m = np.full((count, width), np.inf, dtype=np.float32)
    free_to_m.reshape(-1)[place[len(inside) :]] = free_to
    directions = _directions(np.concatenate([inside, at_beside.take(beside)]), image)
    return Evidence(
        points_m=points_m,
        certainty=certainty[0],
        rays=_placed(directions, place, (count, width)),
        side=_placed(side[None], place, (count, width))[0],
        free_to_m=free_to_m,
        surface_count=surface_count,
        count=surface_count + rays,
    )


def _spread(first: IntArray, available: IntArray, at_most: int) -> tuple[IntArray, IntArray, IntArray]:
    """Evenly chosen members, at most so many, of each of n groups of consecutive numbers, `available` from `first` on:
    each one's group, how manieth it is in it, and its number; shape (m,)."""
    taken = np.minimum(available, at_most)
    group = np.arange(len(first)).repeat(taken)
    within = spread_out(np.zeros_like(taken), taken)
    return group, within, first[group] + within * available[group] // taken[group]


def _directions(at: IntArray, image: RgbdImage) -> Float32Array:
    """Directions of pixels with z = 1, shape (3, m)."""
    camera = image.camera
    v = at // image.width
    out = np.ones((3, len(at)), dtype=np.float32)
    out[0] = (at - v * image.width - camera.cx) / camera.fx
    out[1] = (v - camera.cy) / camera.fy
    return out


def _placed(values: Any, place: IntArray, shape: tuple[int, int]) -> Float32Array:
    """An array (c, *shape) with values (c, m) in places of the flattened `shape`, (m,), and zeros elsewhere."""
    out = np.zeros((len(values), shape[0] * shape[1]), dtype=np.float32)
    out[:, place] = values
    return out.reshape(-1, *shape)


def _smoothed_m(
    at: IntArray, near_m: Float32Array, window_m: Float32Array, image: RgbdImage
) -> tuple[Float32Array, BoolArray]:
    """Depth at pixels, m: the mean of a square of 3 x 3 around each, of what is within `window_m` of `near_m`; and
    whether the pixel itself is. All of shape (m,)."""
    # Beyond the image's sides a square goes on in the next row, where hardly anything is as far away.
    square = np.add.outer((-image.width, 0, image.width), (-1, 0, 1)).reshape(-1, 1)
    depth = image.registered_depth_m.take(image.codes_at(at + square))
    near = np.abs(depth - near_m) < window_m
    total = np.where(near, depth, np.float32(0)).sum(axis=0)
    return total / np.maximum(np.count_nonzero(near, axis=0), 1).astype(np.float32), near[4]


def surroundings(found: Segments, image: RgbdImage) -> tuple[IntArray, Float32Array, IntArray, IntArray]:
    """Places in the flattened image and depths, m, of the pixels around regions, as in `ColourRegion.surroundings`,
    that have a depth, and where each region's begin among them and how many it has. Pixels around two regions are of
    both."""
    # All regions in one picture, side by side.
    margin = ring_px(image) + 1
    left, top, right, bottom = found.bounds.T
    widths = right - left + 2 * margin
    height, width = int((bottom - top).max()) + 2 * margin, int(widths.sum())
    across, down = widths.cumsum() - widths + margin - left, margin - top
    picture = np.zeros((height, width), dtype=np.uint8)
    moved = (down * width + across).repeat(found.run_count)
    picture.reshape(-1)[spread_out(found.runs.row * width + found.runs.left + moved, found.runs.length)] = 1
    around = _dilated(picture, 2 * ring_px(image) + 1) != _dilated(picture, 3)
    own = np.arange(len(widths)).repeat(widths)
    u = np.arange(width) - across.take(own)
    if min(left.min(), top.min(), image.width - right.max(), image.height - bottom.max()) < margin:
        v = np.arange(height)[:, None] - down
        around &= (u >= 0) & (u < image.width) & ((v >= 0) & (v < image.height)).take(own, axis=1)
    pixels = np.flatnonzero(around)
    row = pixels // width
    column = pixels - row * width
    at = row * image.width + (u - down.take(own) * image.width).take(column)
    codes = image.codes_at(at)
    known = np.flatnonzero(codes < image.no_depth_code)
    own = own.take(column.take(known))
    known = known.take(np.argsort(own, kind="stable"))
    counts = np.bincount(own, minlength=len(widths))
    return at.take(known), image.registered_depth_m.take(codes.take(known)), counts.cumsum() - counts, counts


def _dilated(named: ImageArray, size: int) -> ImageArray:
    """Each pixel's greatest number in a square of so many pixels around it."""
    return np.asarray(cv2.dilate(named, np.ones((size, size), dtype=np.uint8)), dtype=np.uint8)
