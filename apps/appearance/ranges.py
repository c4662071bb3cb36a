"""Which colours are the new object's: from the pixels of one picture to boxes in CIELAB that hold in other light."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cocoro.arrays import Float32Array, ImageArray
from cocoro.colour import Lab, in_boxes, lab_of
from cocoro.errors import ConfigError
from cocoro.objects import LabBox, ObjectSpec

EDGES_L = (8.0, 12.0, 20.0, 30.0, 40.0, 50.0, 60.0, 75.0, 99.0)
"""One box between each two: chroma falls with lightness, so one box for all would hold many other colours too."""
BRIGHTNESS = np.geomspace(0.4, 1.8, 15)
"""Of other light, relative to the picture's: into deep shade, and up to a lamp nearby."""
TINTS = np.linspace(-0.14, 0.14, 5)
"""Of other light: red by so much more and blue by so much less. A lamp of 4500 K against one of 6500 K has +-0.15."""
MARGIN = 2.0
"""In a and b, for the noise that is left after the detector's 3 x 3 mean."""
QUANTILES = (0.01, 0.99)
MIN_SAMPLES = 40
"""In a box, or there is none for that lightness."""
MOST_PIXELS = 600
LEAST_SPREAD = 3.0
MAX_SPREADS = 3.0
"""Pixels whose chromaticity is off by more of the spread are reflections, labels, noise."""
SHARED = 0.01
"""A box of which a known object has more than this counts only for a detector that tells shapes apart."""
NEARLY_GREY = 8.0
"""Chromaticity below which a colour is that of walls, floors and the robot itself."""

ColourSamples = ImageArray


class ColourRange(NamedTuple):
    """The colours of a new object, as a row of the catalogue has them."""

    lab: tuple[LabBox, ...]
    lab_by_shape: tuple[LabBox, ...]
    rgb: tuple[float, float, float]
    samples: Lab
    """Its colours in all sorts of light, (n, 3): what the boxes are drawn around."""
    chromaticity: float

    @property
    def boxes(self) -> tuple[LabBox, ...]:
        return self.lab + self.lab_by_shape


class ColourOverlap(NamedTuple):
    """What a new object and a known one have in common."""

    label: str
    of_new: float
    """Share of the new object's colours that would pass for the known one's."""
    of_known: float
    """Share of the known one's that would pass for the new object's."""


def range_of(pixels: ImageArray, known: Iterable[ObjectSpec] = ()) -> ColourRange:
    """The range that an object has whose pixels (n, 3), RGB, are these. Raises ConfigError when they are too dark."""
    own = _typical(pixels)
    samples = lab_of(in_other_light(own))
    boxes = [box for box in (_box(samples, low, high) for low, high in pairwise(EDGES_L)) if box is not None]
    if not boxes:
        raise ConfigError("the object is too dark in the picture to tell its colour: it wants more light")
    others = tuple(known)
    shared = [_is_shared(box, samples, others) for box in boxes]
    if all(shared):  # nothing is its alone: then at least the boxes are told, and the overlap is
        shared = [False] * len(boxes)
    lab = lab_of(own[None])[0]
    return ColourRange(
        lab=tuple(box for box, is_shared in zip(boxes, shared, strict=True) if not is_shared),
        lab_by_shape=tuple(box for box, is_shared in zip(boxes, shared, strict=True) if is_shared),
        rgb=_full_light(own),
        samples=samples,
        chromaticity=float(np.linalg.norm(np.median(_chromaticity(lab), axis=0))),
    )


def in_other_light(pixels: ImageArray) -> ColourSamples:
    """The pixels (n, 3) as they would be in darker, brighter, warmer and colder light; (m, 3), nothing saturated
    that would not be, as a sensor clips."""
    gains = np.array([[k * (1 + tint), k, k * (1 - tint)] for k in BRIGHTNESS for tint in TINTS])
    values = pixels[:, None, :].astype(np.float64) * gains
    return np.asarray(np.clip(np.rint(values), 0, 255), dtype=np.uint8).reshape(-1, 3)


def overlaps(found: ColourRange, known: Iterable[ObjectSpec]) -> list[ColourOverlap]:
    """With each known object that has any colours in common with it, the most first."""
    common = []
    for other in known:
        boxes = other.lab + other.lab_by_shape
        theirs = lab_of(in_other_light(np.rint(255 * np.array([other.rgb])).astype(np.uint8)))
        theirs = theirs[in_boxes(boxes, theirs)]
        of_new = float(in_boxes(boxes, found.samples).mean())
        of_known = float(in_boxes(found.boxes, theirs).mean()) if len(theirs) else 0.0
        if max(of_new, of_known) > SHARED:
            common.append(ColourOverlap(other.label, of_new, of_known))
    return sorted(common, key=lambda overlap: -max(overlap.of_new, overlap.of_known))


def _typical(pixels: ImageArray) -> ImageArray:
    """Some of the pixels, without those that have another colour."""
    chromaticity = _chromaticity(lab_of(pixels[None])[0])
    off = np.linalg.norm(chromaticity - np.median(chromaticity, axis=0), axis=-1)
    spread = max(1.4826 * float(np.median(off)), LEAST_SPREAD)
    kept = pixels[off < MAX_SPREADS * spread]
    return np.ascontiguousarray(kept[:: max(len(kept) // MOST_PIXELS, 1)], dtype=np.uint8)


def _chromaticity(lab: Lab) -> Float32Array:
    return np.asarray(100 * lab[..., 1:] / (lab[..., :1] + 16), dtype=np.float32)


def _box(samples: Lab, low_l: float, high_l: float) -> LabBox | None:
    inside = samples[(samples[:, 0] >= low_l) & (samples[:, 0] < high_l)]
    if len(inside) < MIN_SAMPLES:
        return None
    low = np.floor(np.quantile(inside, QUANTILES[0], axis=0) - MARGIN)
    high = np.ceil(np.quantile(inside, QUANTILES[1], axis=0) + MARGIN)
    bottom = max(low_l, float(low[0]))
    top = min(high_l, max(float(high[0]), bottom + 1.0))
    a, b = ((max(float(low[i]), -128.0), min(float(high[i]), 127.0)) for i in (1, 2))
    return LabBox(low=(bottom, a[0], b[0]), high=(top, a[1], b[1]))


def _is_shared(box: LabBox, samples: Lab, known: Iterable[ObjectSpec]) -> bool:
    inside = samples[in_boxes([box], samples)]
    return any(in_boxes(other.lab, inside).mean() > SHARED for other in known)


def _full_light(pixels: ImageArray) -> tuple[float, float, float]:
    """The surface's colour as its brightest pixels have it: 0 to 1 a channel."""
    bright = pixels.max(axis=1)
    red, green, blue = (float(value) for value in np.median(pixels[bright >= np.quantile(bright, 0.97)], axis=0) / 255)
    return round(red, 3), round(green, 3), round(blue, 3)
