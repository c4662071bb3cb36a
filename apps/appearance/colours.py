"""Finds the colours of a new object: from the pixels of one picture to boxes in CIELAB that hold in other light."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from cocoro.arrays import Float32Array, ImageArray
from cocoro.errors import ConfigError
from cocoro.objects import LabBox, ObjectSpec
from services.perception.cielab import Lab, in_boxes, lab_of

EDGES_L = (8.0, 12.0, 20.0, 30.0, 40.0, 50.0, 60.0, 75.0, 99.0)
"""Limits of lightness, with one box between each two: chroma falls with lightness, so a single box would contain many
other colours, too."""
BRIGHTNESS = np.geomspace(0.4, 1.8, 15)
"""Brightness of other light relative to the picture's, from deep shade to a lamp nearby."""
TINTS = np.linspace(-0.14, 0.14, 5)
"""Tint of other light: red is raised and blue lowered by this share. Lamps of 4500 K and 6500 K differ by 0.15."""
MARGIN = 2.0
"""Margin in a and b for the noise that remains after the detector's 3 x 3 mean."""
QUANTILES = (0.01, 0.99)
MIN_SAMPLES = 40
"""Least number of samples for a box."""
MOST_PIXELS = 600
LEAST_SPREAD = 3.0
MAX_SPREADS = 3.0
"""Pixels whose chromaticity differs by more than this many spreads are reflections, labels or noise."""
SHARED = 0.01
"""A box with a larger share of a known object's colours is used only where the detector checks shapes."""
NEARLY_GREY = 8.0
"""Below this chromaticity a colour is that of walls, floors and the robot itself."""

ColourSamples = ImageArray


class ColourRange(NamedTuple):
    """Colours of a new object, in the form of a row of the catalogue."""

    lab: tuple[LabBox, ...]
    lab_by_shape: tuple[LabBox, ...]
    rgb: tuple[float, float, float]
    samples: Lab
    """Its colours in simulated other light, CIELAB, (n, 3); the boxes contain most of them."""
    chromaticity: float

    @property
    def boxes(self) -> tuple[LabBox, ...]:
        return self.lab + self.lab_by_shape


class ColourOverlap(NamedTuple):
    """Common colours of a new object and a known one."""

    label: str
    of_new: float
    """Share of the new object's colours that match the known one."""
    of_known: float
    """Share of the known object's colours that match the new one."""


def range_of(pixels: ImageArray, known: Iterable[ObjectSpec] = ()) -> ColourRange:
    """The colours of an object from its pixels, RGB, (n, 3). Raises ConfigError when the pixels are too dark."""
    own = _typical(pixels)
    samples = lab_of(in_other_light(own))
    boxes = [box for box in (_box(samples, low, high) for low, high in pairwise(EDGES_L)) if box is not None]
    if not boxes:
        raise ConfigError("the object is too dark in the picture to find its colour: give it more light")
    others = tuple(known)
    shared = [_is_shared(box, samples, others) for box in boxes]
    if all(shared):  # no box is its own: use all of them, and `overlaps` gives the warning
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
    """The pixels, RGB, (n, 3), in darker, brighter, warmer and colder light, (m, 3), clipped as a sensor does."""
    gains = np.array([[k * (1 + tint), k, k * (1 - tint)] for k in BRIGHTNESS for tint in TINTS])
    values = pixels[:, None, :].astype(np.float64) * gains
    return np.asarray(np.clip(np.rint(values), 0, 255), dtype=np.uint8).reshape(-1, 3)


def overlaps(found: ColourRange, known: Iterable[ObjectSpec]) -> list[ColourOverlap]:
    """The known objects that have colours in common with the new one, the largest overlap first."""
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
    """The pixels (n, 3) without those of another colour, thinned to about MOST_PIXELS."""
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
    """RGB of the brightest pixels, each 0 to 1."""
    bright = pixels.max(axis=1)
    red, green, blue = (float(value) for value in np.median(pixels[bright >= np.quantile(bright, 0.97)], axis=0) / 255)
    return round(red, 3), round(green, 3), round(blue, 3)
