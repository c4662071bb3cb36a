"""Takes from the pixels of many regions at once what their objects are placed by: depths and evidence."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from cocoro.arrays import BoolArray, CodeArray, Float32Array, FloatArray, ImageArray, IntArray, median
from services.perception.image import Evidence, RgbdImage
from services.perception.region import MIN_DEPTH_PIXELS, MIN_DEPTH_SHARE, ColourRegion, depth_doubt_m, ring_px
from services.perception.segments import Segments

MAX_SURFACE_POINTS = 96
MAX_RAYS = 36
FEW = 12
"""The pixels around so many regions are found sooner for each region by itself than in the image."""
SMOOTHED_DOUBT = 0.7
"""Standard deviation of a surface point's depth, the mean of up to nine pixels, relative to that of one pixel. The mean
does not reduce what neighbours have in common: quantisation, and the grain of the sensor's pattern."""
_SQUARE = np.array([(du, dv) for dv in (-1, 0, 1) for du in (-1, 0, 1)], dtype=np.int32).T[:, :, None]


def middle_depths_m(found: Segments, codes: CodeArray, image: RgbdImage) -> FloatArray:
    """Depth of each region's visible surface, m, shape (n,): the median of its middle, or of all of it when the middle
    has too little data; NaN without enough. `codes` are its pixels' depth codes, shape (k,)."""
    count = len(found.start)
    area = found.area_px
    known = codes < image.no_depth_code
    unknown = np.flatnonzero(~known)
    data = area - np.bincount(found.own.take(unknown), minlength=count)
    enough = np.maximum(MIN_DEPTH_PIXELS, MIN_DEPTH_SHARE * area)
    left, top, right, bottom = found.bounds.astype(np.int32).T
    across, down = (right - left) // 4, (bottom - top) // 4
    for pixel, low, high in ((found.u, left + across, right - across), (found.v, top + down, bottom - down)):
        known &= pixel >= np.repeat(low, area)
        known &= pixel < np.repeat(high, area)
    within = np.flatnonzero(known)
    own = found.own.take(within)
    in_middle = np.bincount(own, minlength=count)
    # Codes rise with the depth.
    by_region = np.sort((own << 11) + codes.take(within))
    first = np.cumsum(in_middle) - in_middle
    depth_m = np.full(count, np.nan)
    usual = np.flatnonzero((data >= enough) & (in_middle >= enough / 2))
    low, high = first[usual] + (in_middle[usual] - 1) // 2, first[usual] + in_middle[usual] // 2
    table = image.registered_depth_m
    depth_m[usual] = (table[by_region[low] & 2047] + table[by_region[high] & 2047]) / np.float32(2)
    for region in np.flatnonzero((data >= enough) & (in_middle < enough / 2)).tolist():
        pixels = table[codes[found.start[region] : found.start[region] + area[region]]]
        depth_m[region] = median(pixels[np.isfinite(pixels)])
    return depth_m


def evidence_of(found: Segments, depth_m: FloatArray, reach_m: FloatArray, image: RgbdImage) -> Evidence:
    """The evidence of n regions with depth for fitting their objects. `depth_m` are the regions' from
    `middle_depths_m`, and `reach_m` how far their objects reach from their centres, m, shape (n,)."""
    count = len(found.start)
    edge = np.flatnonzero(~found.core)
    edge_first = np.searchsorted(edge, found.start)
    edges = np.searchsorted(edge, found.start + found.area_px) - edge_first
    # On the surface: pixels of the core, where that is most of the region.
    own, within, pixels = _spread(found.start, found.area_px, MAX_SURFACE_POINTS)
    u, v = found.u.take(pixels), found.v.take(pixels)
    window_m = 1.5 * reach_m + depth_doubt_m(depth_m)
    depth, on_surface = _smoothed_m(u, v, depth_m.astype(np.float32)[own], window_m.astype(np.float32)[own], image)
    on_surface &= found.core.take(pixels) | (edges >= (found.area_px + 1) // 2)[own]
    depth = np.where(on_surface, depth, np.float32(1))
    width = int(within.max()) + 1
    points_m = _placed(_directions(u, v, image) * depth, own * width + within, (count, width))
    certainty = _placed(
        (on_surface / (SMOOTHED_DOUBT * depth_doubt_m(depth)))[None], own * width + within, (count, width)
    )
    # Rays: along the edge, and around it.
    own_edge, within_edge, picked = _spread(edge_first, edges, MAX_RAYS)
    inside = edge.take(picked)
    u_beside, v_beside, depth_beside, first, counts = surroundings(found, image)
    own_beside, within_beside, beside = _spread(first, counts, MAX_RAYS)
    u = np.concatenate([found.u.take(inside), u_beside.take(beside)])
    v = np.concatenate([found.v.take(inside), v_beside.take(beside)])
    met = np.minimum(edges, MAX_RAYS)
    rays = met + np.minimum(counts, MAX_RAYS)
    width = max(int(rays.max()), 1)  # without any ray, one of fill
    place = np.concatenate([own_edge * width + within_edge, own_beside * width + met[own_beside] + within_beside])
    free_to = depth_beside.take(beside)
    free_to -= 0.01 + depth_doubt_m(free_to)
    side = np.repeat(np.array([1.0, -1.0]), [len(inside), len(beside)])
    surface_count = np.bincount(own[on_surface], minlength=count)
    free_to_m = np.full((count, width), np.inf, dtype=np.float32)
    free_to_m.reshape(-1)[place[len(inside) :]] = free_to
    return Evidence(
        points_m=points_m,
        certainty=certainty[0],
        rays=_placed(_directions(u, v, image), place, (count, width)),
        side=_placed(side[None], place, (count, width))[0],
        free_to_m=free_to_m,
        surface_count=surface_count,
        count=surface_count + rays,
    )


def _spread(first: IntArray, available: IntArray, at_most: int) -> tuple[IntArray, IntArray, IntArray]:
    """Evenly chosen members, at most so many, of each of n groups of consecutive numbers, `available` from `first` on:
    each one's group, how manieth it is in it, and its number; shape (m,)."""
    taken = np.minimum(available, at_most)
    ends = np.cumsum(taken)
    group = np.repeat(np.arange(len(first)), taken)
    within = np.arange(len(group)) - np.repeat(ends - taken, taken)
    return group, within, first[group] + within * available[group] // taken[group]


def _directions(u: NDArray[np.int32], v: NDArray[np.int32], image: RgbdImage) -> Float32Array:
    """Directions of pixels with z = 1, shape (3, m)."""
    camera = image.camera
    out = np.ones((3, len(u)), dtype=np.float32)
    out[0] = (u - camera.cx) / camera.fx
    out[1] = (v - camera.cy) / camera.fy
    return out


def _placed(values: Any, place: IntArray, shape: tuple[int, int]) -> Float32Array:
    """An array (c, *shape) with values (c, m) in places of the flattened `shape`, (m,), and zeros elsewhere."""
    out = np.zeros((len(values), shape[0] * shape[1]), dtype=np.float32)
    out[:, place] = values
    return out.reshape(-1, *shape)


def _smoothed_m(
    u: NDArray[np.int32], v: NDArray[np.int32], near_m: Float32Array, window_m: Float32Array, image: RgbdImage
) -> tuple[Float32Array, BoolArray]:
    """Depth at pixels, m: the mean of a square of 3 x 3 around each, of what is within `window_m` of `near_m`; and
    whether the pixel itself is. All of shape (m,)."""
    columns = np.clip(u + _SQUARE[0], 0, image.width - 1)
    rows = np.clip(v + _SQUARE[1], 0, image.height - 1)
    depth = image.registered_depth_m.take(image.codes_at(columns, rows))
    near = np.abs(depth - near_m) < window_m
    total = np.where(near, depth, np.float32(0)).sum(axis=0)
    return total / np.maximum(np.count_nonzero(near, axis=0), 1).astype(np.float32), near[4]


def surroundings(found: Segments, image: RgbdImage) -> tuple[IntArray, IntArray, Float32Array, IntArray, IntArray]:
    """Columns, rows and depths, m, of the pixels around regions, as in `ColourRegion.surroundings`, that have a depth,
    and where each region's begin among them and how many it has. Pixels around two regions are of both."""
    if len(found.start) <= FEW:
        parts = [_around_one(found, region, image) for region in range(len(found.start))]
    else:
        layers = sorted(set(found.layer.tolist()))
        parts = [_around(found, np.flatnonzero(found.layer == layer), image) for layer in layers]
    at, owner = (np.concatenate(each) for each in zip(*parts, strict=True))
    v = at // image.width
    u = at - v * image.width
    codes = image.codes_at(u, v)
    order = np.argsort(owner, kind="stable")
    order = order[codes.take(order) < image.no_depth_code]
    counts = np.bincount(owner.take(order), minlength=len(found.start))
    return (
        u.take(order),
        v.take(order),
        image.registered_depth_m.take(codes.take(order)),
        np.cumsum(counts) - counts,
        counts,
    )


def _around_one(found: Segments, region: int, image: RgbdImage) -> tuple[IntArray, NDArray[np.uint8]]:
    """`_around` for one region."""
    left, top, right, bottom = found.bounds[region].tolist()
    left, top, right, bottom = box = image.clip((left, top, right, bottom), ColourRegion.margin_px(image))
    mask = found.mask(region, box)
    at = np.flatnonzero(_dilated(mask, 2 * ring_px(image) + 1) != _dilated(mask, 3))
    v = at // (right - left)
    return (v + top) * image.width + (at - v * (right - left)) + left, np.full(len(at), region, dtype=np.uint8)


def _around(found: Segments, regions: IntArray, image: RgbdImage) -> tuple[IntArray, NDArray[np.uint8]]:
    """The pixels around regions of one layer, by their index in the flattened image, and each one's region."""
    margin = ColourRegion.margin_px(image)
    bounds = found.bounds[regions]
    left, top = np.maximum(bounds[:, :2].min(axis=0) - margin, 0).tolist()
    right = min(int(bounds[:, 2].max()) + margin, image.width)
    bottom = min(int(bounds[:, 3].max()) + margin, image.height)
    names = np.zeros(len(found.start), dtype=np.uint8)
    names[regions] = 1 + np.arange(len(regions))
    named = np.zeros((bottom - top, right - left), dtype=np.uint8)
    width = right - left
    name_px = np.repeat(names, found.area_px)
    place = (found.v - top) * width + (found.u - left)
    if len(regions) < len(names):
        mine = np.flatnonzero(name_px)
        place, name_px = place.take(mine), name_px.take(mine)
    named.reshape(-1)[place] = name_px
    ring = 2 * ring_px(image) + 1
    outer, inner = _dilated(named, ring), _dilated(named, 3)
    at = np.flatnonzero(outer != inner)
    owner = outer.reshape(-1).take(at)
    if _may_touch(bounds, ring):
        # Of two regions the greater number wins; once more with the numbers in reverse.
        reverse = np.negative(named)
        outer2, inner2 = np.negative(_dilated(reverse, ring)), np.negative(_dilated(reverse, 3))
        again = np.flatnonzero((outer2 != inner2) & (outer2 != outer))
        at, owner = np.concatenate([at, again]), np.concatenate([owner, outer2.reshape(-1).take(again)])
        order = np.argsort(at, kind="stable")
        at, owner = at.take(order), owner.take(order)
    v = at // width
    return (v + top) * image.width + (at - v * width) + left, regions.take(owner.astype(np.intp) - 1).astype(np.uint8)


def _may_touch(bounds: IntArray, within_px: int) -> bool:
    """Whether any two of the boxes (n, 4) are less than so many pixels apart."""
    low, high = bounds[:, None, :2] - within_px, bounds[:, None, 2:] + within_px
    touch = ((low < bounds[:, 2:]) & (bounds[:, :2] < high)).all(axis=2)
    return bool(np.count_nonzero(touch) > len(bounds))


def _dilated(named: ImageArray, size: int) -> ImageArray:
    """Each pixel's greatest number in a square of so many pixels around it."""
    return np.asarray(cv2.dilate(named, np.ones((size, size), dtype=np.uint8)), dtype=np.uint8)
