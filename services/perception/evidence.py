"""Takes from the pixels of many regions at once what their objects are placed by: depths and evidence."""

from __future__ import annotations

import cv2
import numpy as np

from cocoro.arrays import Float32Array, FloatArray, ImageArray, IntArray
from services.perception.image import Evidence, RgbdImage
from services.perception.region import (
    MIN_DEPTH_PIXELS,
    MIN_DEPTH_SHARE,
    ColourRegion,
    depth_doubt_m,
    ring_px,
)
from services.perception.segments import Segments

MAX_SURFACE_POINTS = 80
MAX_RAYS = 36


def middle_depths_m(found: Segments, depth_px: Float32Array) -> FloatArray:
    """Depth of each region's visible surface, m, shape (n,): the median of its middle, or of all of it when the middle
    has too little data; NaN without enough. `depth_px` are its pixels' depths, m, shape (k,)."""
    count = len(found.start)
    without = np.isnan(depth_px)
    known = found.area_px - np.bincount(found.own[without], minlength=count)
    enough = np.maximum(MIN_DEPTH_PIXELS, MIN_DEPTH_SHARE * found.area_px)
    # Twice the distance from the middle of the bounds, which are 2 n pixels wide, is at most the width less 2 n / 4.
    left, top, right, bottom = found.bounds.T
    across, down = (right - left) // 4, (bottom - top) // 4
    own = found.own
    middle = (found.u >= (left + across)[own]) & (found.u < (right - across)[own])
    middle &= (found.v >= (top + down)[own]) & (found.v < (bottom - down)[own])
    middle &= ~without
    within = np.flatnonzero(middle)
    own_within = own[within]
    in_middle = np.bincount(own_within, minlength=count)
    order = np.lexsort((depth_px[within], own_within))
    sorted_m = depth_px[within][order]
    first = np.cumsum(in_middle) - in_middle
    depth_m = np.full(count, np.nan)
    usual = np.flatnonzero((known >= enough) & (in_middle >= enough / 2) & (in_middle > 0))
    low, high = first[usual] + (in_middle[usual] - 1) // 2, first[usual] + in_middle[usual] // 2
    depth_m[usual] = (sorted_m[low] + sorted_m[high]) / np.float32(2)
    for region in np.flatnonzero((known >= enough) & (in_middle < enough / 2)).tolist():
        pixels = depth_px[found.start[region] : found.start[region] + found.area_px[region]]
        depth_m[region] = np.median(pixels[np.isfinite(pixels)])
    return depth_m


def evidences(
    found: Segments,
    chosen: IntArray,
    depth_px: Float32Array,
    depth_m: FloatArray,
    reach_m: FloatArray,
    image: RgbdImage,
) -> list[Evidence | None]:
    """The evidence of each chosen region for fitting its object; None without depth.

    `depth_px` are the pixels' depths, m, shape (k,); `depth_m` the regions' from `middle_depths_m` and `reach_m` how
    far their objects reach from their centres, m, shape (n,).
    """
    count = len(found.start)
    wanted = np.zeros(count, dtype=np.bool_)
    wanted[chosen] = True
    wanted &= ~np.isnan(depth_m)
    window_m = np.where(wanted, 1.5 * reach_m + depth_doubt_m(depth_m), -1.0).astype(np.float32)
    cores = np.bincount(found.own[found.core], minlength=count)
    use_core = cores > found.area_px // 2
    own = found.own
    on_surface = np.abs(depth_px - depth_m.astype(np.float32)[own]) < window_m[own]
    on_surface &= found.core | ~use_core[own]
    on_outline = ~found.core & wanted[own]
    end = found.start + found.area_px
    surface, surface_at, surface_px = _rays(
        found.u, found.v, depth_px, on_surface, found.start, end, MAX_SURFACE_POINTS, image
    )
    outline, outline_at, _ = _rays(found.u, found.v, depth_px, on_outline, found.start, end, MAX_RAYS, image)
    u, v, depth, first, last = _surroundings(found, wanted, image)
    beside, beside_at, _ = _rays(u, v, depth, ~np.isnan(depth), first, last, MAX_RAYS, image)
    surface_m = surface[:, :3] * _smoothed_m(surface_px, surface_at, depth_m, window_m, found, image)[:, None]
    free_to_m = beside[:, 3] - 0.01 - depth_doubt_m(beside[:, 3])
    return [
        Evidence(
            surface_m[surface_at[region] : surface_at[region + 1]],
            outline[outline_at[region] : outline_at[region + 1], :3],
            beside[beside_at[region] : beside_at[region + 1], :3],
            free_to_m[beside_at[region] : beside_at[region + 1]],
        )
        if wanted[region]
        else None
        for region in chosen.tolist()
    ]


def _rays(
    u: IntArray,
    v: IntArray,
    depth: Float32Array,
    where: np.ndarray,
    first: IntArray,
    last: IntArray,
    at_most: int,
    image: RgbdImage,
) -> tuple[FloatArray, list[int], IntArray]:
    """Directions with z = 1, and depth, m, of at most so many of the pixels in `where` of each of n groups, shape (m, 4);
    the index of each group's first ray, and m; and the rays' pixels, shape (m,). The group i has the pixels from
    `first[i]` to before `last[i]`."""
    at = np.flatnonzero(where)
    begin, end = np.searchsorted(at, first), np.searchsorted(at, last)
    available = end - begin
    taken = np.minimum(available, at_most)
    offsets = np.concatenate([[0], np.cumsum(taken)])
    group = np.repeat(np.arange(len(first)), taken)
    within = np.arange(offsets[-1]) - offsets[:-1][group]
    pixels = at[begin[group] + within * available[group] // taken[group]]
    camera = image.camera
    out = np.empty((len(pixels), 4))
    out[:, 0] = (u[pixels] - camera.cx) / camera.fx
    out[:, 1] = (v[pixels] - camera.cy) / camera.fy
    out[:, 2] = 1.0
    out[:, 3] = depth[pixels]
    return out, offsets.tolist(), pixels


def _smoothed_m(
    pixels: IntArray, first: list[int], depth_m: FloatArray, window_m: Float32Array, found: Segments, image: RgbdImage
) -> Float32Array:
    """Depth at pixels on surfaces, m, (m,): the mean of a square of 3 x 3 around each, of what is on the surface."""
    own = np.repeat(np.arange(len(depth_m)), np.diff(first))
    columns = np.clip(found.u[pixels] + np.array([-1, 0, 1] * 3)[:, None], 0, image.width - 1)
    rows = np.clip(found.v[pixels] + np.repeat([-1, 0, 1], 3)[:, None], 0, image.height - 1)
    depth = image.registered_depth_m.take(image.codes_at(columns, rows))
    near = np.abs(depth - depth_m.astype(np.float32)[own]) < window_m[own]
    return np.where(near, depth, np.float32(0)).sum(axis=0) / np.count_nonzero(near, axis=0)


def _surroundings(
    found: Segments, wanted: np.ndarray, image: RgbdImage
) -> tuple[IntArray, IntArray, Float32Array, IntArray, IntArray]:
    """Columns, rows and depths, m, of the pixels around the wanted regions, as in `ColourRegion.surroundings`, and
    where each region's begin and end among them. Pixels around two regions are of both."""
    margin = ColourRegion.margin_px(image)
    left, top = np.maximum(found.bounds[:, :2].min(axis=0) - margin, 0).tolist()
    right = min(int(found.bounds[:, 2].max()) + margin, image.width)
    bottom = min(int(found.bounds[:, 3].max()) + margin, image.height)
    names = np.zeros(len(wanted), dtype=np.uint8)
    names[wanted] = np.arange(1, np.count_nonzero(wanted) + 1)
    named = np.zeros((bottom - top, right - left), dtype=np.uint8)
    name_px = names[found.own]
    named.reshape(-1)[(found.v - top) * (right - left) + (found.u - left)] = name_px
    ring = 2 * ring_px(image) + 1
    outer, inner = _spread(named, ring), _spread(named, 3)
    at = np.flatnonzero(outer != inner)
    owner = outer.reshape(-1)[at]
    # Of two regions the greatest number wins; once more with the numbers in reverse.
    reverse = np.negative(named)
    outer2, inner2 = np.negative(_spread(reverse, ring)), np.negative(_spread(reverse, 3))
    again = np.flatnonzero((outer2 != inner2) & (outer2 != outer))
    if len(again):
        at = np.concatenate([at, again])
        owner = np.concatenate([owner, outer2.reshape(-1)[again]])
        order = np.lexsort((at, owner))
    else:
        order = np.argsort(owner, kind="stable")
    at, owner = at[order], owner[order]
    v = at // (right - left)
    u = at - v * (right - left) + left
    v += top
    depth = image.registered_depth_m.take(image.codes_at(u, v))
    places = np.searchsorted(owner, names), np.searchsorted(owner, names, side="right")
    first = np.where(wanted, places[0], 0)
    return u, v, depth, first, np.where(wanted, places[1], 0)


def _spread(named: ImageArray, size: int) -> ImageArray:
    """Each pixel's greatest number in a square of so many pixels around it."""
    return np.asarray(cv2.dilate(named, np.ones((size, size), dtype=np.uint8)), dtype=np.uint8)
