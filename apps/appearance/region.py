"""Finds the pixels of a new object: grown from a given pixel or box, or the blob that stands out most.

Colours are compared by their chromaticity 100 (a, b) / (L + 16). Less light on a surface scales L + 16, a and b alike,
so the chromaticity is the same on its lit side and in the shade (CIE 1976; derived).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cocoro.arrays import BoolArray, Float32Array, FloatArray, ImageArray, IntArray, MaskArray
from cocoro.errors import ConfigError
from services.perception.cielab import Lab, lab_of
from services.perception.image import PixelBox

ChromaArray = Float32Array

MIN_AREA_PX = 150.0
"""Least pixels of an object in a 640 x 480 picture; a can at 3.5 m has 220. Fewer give neither colour nor size."""
MAX_SHARE = 0.4
"""Greatest share of the picture that an object has; more is a background."""
DARKEST_L = 8.0
"""Below this lightness a colour is nearly all noise."""
GREY = 6.0
"""Below this chromaticity a colour is nearly grey, and its lightness is compared, too."""
GREY_LIGHTNESS = 9.0
TOLERANCE = (5.0, 14.0)
"""Least and greatest difference in chromaticity within one object, for a well-lit pixel."""
TOLERANCE_SHARE = 0.33
"""Tolerance as a share of the difference between the object and its surroundings."""
SEED_PX = 3
"""Radius of the seed around a given pixel, in a 640 x 480 picture."""
MIDDLE = 0.7
"""Share of the picture's width and height around its middle where an object is most likely; objects beyond it get a
lower score."""
CUT_PENALTY = 0.7
"""Share of its score that a blob at the picture's edge loses."""
STANDS_OUT = 10.0
"""Least difference in chromaticity (or thrice that in lightness) from the frequent colours of the picture's rim."""
KNOWN_PENALTY = 0.9
"""Share of its score that a blob of a known object's colours loses; it is rarely meant."""
LEAST_EXCESS = 0.15
"""Least share of a box's pixels by which one colour is more frequent inside than around it."""
LEAST_BACKGROUND = 0.03
"""Least share of the rim's pixels of a background colour; a rarer colour belongs to a thing at the rim."""
CELL = 4.0
"""Width of a cell of chromaticities when colours are counted."""


@dataclass(frozen=True)
class ObjectRegion:
    """The object's pixels in one picture."""

    mask: MaskArray
    """1 inside, (height, width); holes are filled, since a label on a can is a part of the can."""
    coloured: BoolArray
    """Pixels of the object's colour well inside of it, (height, width)."""
    box: PixelBox
    area_px: int
    cut: bool
    """Whether it touches the picture's edge, so that a part may be missing."""


class ColourField:
    """A smoothed picture with the CIELAB colour and chromaticity of each pixel."""

    def __init__(self, colour: ImageArray) -> None:
        """`colour` is RGB, (height, width, 3)."""
        self.height, self.width = colour.shape[:2]
        self.scale = float(np.sqrt(self.width * self.height / (640 * 480)))
        kernel = 5 if self.scale > 0.75 else 3
        self.lab: Lab = lab_of(np.asarray(cv2.medianBlur(np.ascontiguousarray(colour), kernel), dtype=np.uint8))
        light = self.lab[..., :1] + np.float32(16)
        self.chroma: ChromaArray = np.float32(100) * self.lab[..., 1:] / light
        self.doubt = np.maximum(np.float32(66) / light[..., 0], np.float32(1))
        """Noise of each pixel's chromaticity relative to a pixel of medium lightness, (height, width)."""
        self.lit: BoolArray = self.lab[..., 0] >= DARKEST_L


def at_pixel(picture: ColourField, u_px: int, v_px: int) -> ObjectRegion:
    """The object at a pixel (u right, v down). Raises ConfigError when none can be found there."""
    if not (0 <= u_px < picture.width and 0 <= v_px < picture.height):
        raise ConfigError(f"--at {u_px},{v_px} is outside of the picture, which has {picture.width} x {picture.height}")
    reach = max(round(SEED_PX * picture.scale), 1)
    rows = slice(max(v_px - reach, 0), v_px + reach + 1)
    columns = slice(max(u_px - reach, 0), u_px + reach + 1)
    seed = np.zeros((picture.height, picture.width), dtype=np.bool_)
    seed[rows, columns] = picture.lit[rows, columns]
    if not seed.any():
        raise ConfigError(f"--at {u_px},{v_px}: the picture is too dark there; point at a lighter place of the object")
    return _checked(picture, _grown(picture, seed), f"around {u_px},{v_px}")


def in_box(picture: ColourField, box: PixelBox) -> ObjectRegion:
    """The object that fills most of a box, found by the colour that is most frequent inside compared with around it.

    Raises ConfigError for an impossible box, or when no colour in it stands out.
    """
    left, top, right, bottom = box
    if not (0 <= left < right <= picture.width and 0 <= top < bottom <= picture.height):
        raise ConfigError(
            f"--box {left},{top},{right},{bottom} is not a box within {picture.width} x {picture.height} pixels"
        )
    inside = np.zeros((picture.height, picture.width), dtype=np.bool_)
    inside[top:bottom, left:right] = True
    across, down = max((right - left) // 3, 4), max((bottom - top) // 3, 4)
    around = np.zeros_like(inside)
    around[max(top - down, 0) : bottom + down, max(left - across, 0) : right + across] = True
    around &= ~inside
    own, others = _counted(picture, inside & picture.lit), _counted(picture, around & picture.lit)
    excess = own - others
    if excess.max() < LEAST_EXCESS:
        raise ConfigError("--box: no colour in it differs from its surroundings; point at the object with --at U,V")
    seed = inside & _of_cell(picture, int(np.argmax(excess)))
    return _checked(picture, _grown(picture, seed & picture.lit, inside), "in the box")


def most_salient(picture: ColourField, known: BoolArray | None = None) -> ObjectRegion:
    """The uniform blob that stands out most, preferably near the picture's middle and of no known object.

    `known` marks the pixels with colours of known objects, (height, width). Raises ConfigError when nothing stands out.
    """
    rim = np.ones((picture.height, picture.width), dtype=np.bool_)
    edge = max(picture.width // 16, 2), max(picture.height // 16, 2)
    rim[edge[1] : -edge[1], edge[0] : -edge[0]] = False
    difference = _difference_from(picture, rim & picture.lit)
    candidates = np.asarray((difference > STANDS_OUT * picture.doubt) & picture.lit)
    best: tuple[float, BoolArray] | None = None
    for blob, middle in _blobs(candidates, picture):
        region = _grown(picture, blob)
        if region is None or region.area_px > MAX_SHARE * rim.size:
            continue
        off = np.hypot((middle[0] / picture.width - 0.5) / MIDDLE, (middle[1] / picture.height - 0.5) / MIDDLE) * 2
        spread = float(picture.chroma[region.coloured].std(axis=0).max())
        strength = float(np.median(difference[region.coloured]))
        score = np.sqrt(region.area_px) * strength * np.exp(-(off**2)) / (3.0 + spread)
        if region.cut:
            score *= 1.0 - CUT_PENALTY
        if known is not None:
            score *= 1.0 - KNOWN_PENALTY * float(known[region.coloured].mean())
        if best is None or score > best[0]:
            best = float(score), blob
    if best is None:
        raise ConfigError("nothing in the picture stands out; point at the object with --at U,V or --box L,T,R,B")
    return _checked(picture, _grown(picture, best[1]), "in the middle")


# --- growing --------------------------------------------------------------------------------------


def _grown(picture: ColourField, seed: BoolArray, within: BoolArray | None = None) -> ObjectRegion | None:
    """All connected pixels of the seed's colour; None when hardly any are left."""
    centre = np.median(picture.chroma[seed], axis=0)
    lightness = float(np.median(picture.lab[..., 0][seed]))
    distance = np.linalg.norm(picture.chroma - centre, axis=-1) / picture.doubt
    grey = float(np.linalg.norm(centre)) < GREY
    lightness_like = np.abs(picture.lab[..., 0] - lightness) < GREY_LIGHTNESS

    def part(tolerance: float) -> tuple[BoolArray, MaskArray | None]:
        like = (distance < tolerance) & picture.lit
        if grey:
            like &= lightness_like
        if within is not None:
            like &= within
        return like, _connected(like, seed)

    like, mask = part(TOLERANCE[0])
    if mask is None:
        return None
    around = _ring(mask, picture) & picture.lit
    if around.any():  # the surroundings are known: set the tolerance by their difference
        between = float(np.median(distance[around]))
        like, mask = part(float(np.clip(TOLERANCE_SHARE * between, *TOLERANCE)))
        if mask is None:
            return None
    left, top, width, height = cv2.boundingRect(mask)
    inner = np.asarray(cv2.erode(mask, np.ones((5, 5), dtype=np.uint8)), dtype=np.bool_) & like
    coloured = inner if np.count_nonzero(inner) >= 30 else np.asarray((mask > 0) & like)
    return ObjectRegion(
        mask=mask,
        coloured=coloured,
        box=(left, top, left + width, top + height),
        area_px=int(np.count_nonzero(mask)),
        cut=left <= 1 or top <= 1 or left + width >= picture.width - 1 or top + height >= picture.height - 1,
    )


def _connected(like: BoolArray, seed: BoolArray) -> MaskArray | None:
    """The connected part with most of the seed's pixels, its holes filled."""
    opened = cv2.morphologyEx(like.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), dtype=np.uint8))
    count, labels = cv2.connectedComponents(np.asarray(opened, dtype=np.uint8), connectivity=4, ltype=cv2.CV_32S)
    own = np.bincount(np.asarray(labels)[seed], minlength=count)
    own[0] = 0
    if own.max() == 0:
        return None
    part = (np.asarray(labels) == int(np.argmax(own))).astype(np.uint8)
    outlines, _ = cv2.findContours(part, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(cv2.drawContours(np.zeros_like(part), outlines, -1, 1, cv2.FILLED), dtype=np.uint8)


def _ring(mask: MaskArray, picture: ColourField) -> BoolArray:
    """A ring around a region, beyond the pixels that are blended with it."""
    near, far = (2 * round(reach * picture.scale) + 1 for reach in (3, 9))
    outer = cv2.dilate(mask, np.ones((far, far), dtype=np.uint8))
    inner = cv2.dilate(mask, np.ones((near, near), dtype=np.uint8))
    return np.asarray((outer > 0) & (inner == 0), dtype=np.bool_)


def _checked(picture: ColourField, region: ObjectRegion | None, where: str) -> ObjectRegion:
    least = MIN_AREA_PX * picture.scale**2
    if region is None or region.area_px < least:
        size = 0 if region is None else region.area_px
        raise ConfigError(
            f"the object {where} has {size} pixels of one colour, and {least:.0f} are needed: bring it nearer, "
            "into better light, or point at another place of it"
        )
    if region.area_px > MAX_SHARE * picture.width * picture.height:
        raise ConfigError(
            f"the region {where} has {region.area_px} pixels, so it is background: point at the object with --at U,V"
        )
    return region


# --- frequent colours, and colours that stand out -------------------------------------------------

_CELLS = 64


def _cells(picture: ColourField) -> IntArray:
    """Index of each pixel's cell of chromaticities, (height, width)."""
    cell = np.clip(np.rint(picture.chroma / CELL).astype(np.int64) + _CELLS // 2, 0, _CELLS - 1)
    return np.asarray(cell[..., 0] * _CELLS + cell[..., 1])


def _counted(picture: ColourField, where: BoolArray) -> FloatArray:
    """Share of the pixels in each cell and its neighbours, (cells,)."""
    counts = np.bincount(_cells(picture)[where], minlength=_CELLS**2).reshape(_CELLS, _CELLS).astype(np.float32)
    summed = np.asarray(cv2.boxFilter(counts, -1, (3, 3), normalize=False), dtype=np.float64)
    return np.asarray(summed.reshape(-1) / max(int(np.count_nonzero(where)), 1))


def _of_cell(picture: ColourField, cell: int) -> BoolArray:
    """Pixels in a cell or next to it, (height, width)."""
    cells = _cells(picture)
    row, column = divmod(cell, _CELLS)
    return (np.abs(cells // _CELLS - row) <= 1) & (np.abs(cells % _CELLS - column) <= 1)


def _difference_from(picture: ColourField, rim: BoolArray) -> Float32Array:
    """Distance of each pixel's colour from the nearest frequent colour of the rim's pixels, (height, width)."""
    colours = np.concatenate([picture.chroma, picture.lab[..., :1] / 3], axis=-1)
    samples = np.ascontiguousarray(colours[rim][:: max(np.count_nonzero(rim) // 4000, 1)])
    if len(samples) < 8:
        return np.full(rim.shape, np.float32(99))
    cv2.setRNGSeed(1)  # for the initial clusters, so that equal pictures give equal objects
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 20, 0.5)
    _, nearest, centres = cv2.kmeans(samples, 6, np.empty(0, dtype=np.int32), criteria, 2, cv2.KMEANS_PP_CENTERS)
    shares = np.bincount(np.asarray(nearest).reshape(-1), minlength=6) / len(samples)
    frequent = [centre for centre, share in zip(np.asarray(centres), shares, strict=True) if share >= LEAST_BACKGROUND]
    distances = [np.linalg.norm(colours - centre, axis=-1) for centre in frequent]
    return np.asarray(np.min(distances, axis=0), dtype=np.float32)


def _blobs(candidates: BoolArray, picture: ColourField) -> list[tuple[BoolArray, tuple[float, float]]]:
    """The largest connected blobs, (height, width) each, and their middles in pixels."""
    opened = cv2.morphologyEx(candidates.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), dtype=np.uint8))
    _, labels, stats, middles = cv2.connectedComponentsWithStats(np.asarray(opened, dtype=np.uint8), connectivity=4)
    found = []
    for i in 1 + np.argsort(-stats[1:, cv2.CC_STAT_AREA], kind="stable")[:12]:
        u, v = (float(value) for value in middles[i])
        if stats[i, cv2.CC_STAT_AREA] >= MIN_AREA_PX * picture.scale**2 / 2:
            found.append((np.asarray(labels == i), (u, v)))
    return found
