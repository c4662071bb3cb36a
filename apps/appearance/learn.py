"""Learns an object's row of the catalogue from one view of it, with warnings for the person who decides to save it."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import cv2
import numpy as np

from apps.appearance.colours import NEARLY_GREY, ColourOverlap, ColourRange, overlaps, range_of
from apps.appearance.region import ColourField, ObjectRegion, at_pixel, in_box, most_salient
from apps.appearance.size import MeasuredSize, ObjectShape, guessed_shape, size_of, surface_depth_m
from cocoro.arrays import BoolArray, CodeArray, FloatArray, ImageArray
from cocoro.errors import ConfigError
from cocoro.objects import Catalogue, ObjectSpec
from cocoro.robot import Robot
from services.perception.cielab import in_boxes, lab_of, matches
from services.perception.image import PixelBox

GRASPABLE_WIDTH_M = (0.02, 0.075)
"""Least and greatest width that the claws reach around."""
GRASPABLE_HEIGHT_M = 0.045
"""Least height of a graspable object; the claws close above a lower one."""
FEW_PX = 600.0
"""Pixels of a 640 x 480 picture; with fewer, the size has an error of more than a few per cent."""
ELSEWHERE_PX = 32.0
"""Pixels of a 640 x 480 picture; the detector ignores smaller blobs of the new colour."""
SIZES: dict[ObjectShape, int] = {"sphere": 1, "cylinder": 2, "box": 3}
"""Number of lengths that `--size` has for a shape."""
MAX_OBJECTS = 32
"""Capacity of the detector's colour table."""


@dataclass(frozen=True)
class ObjectView:
    """One view of the object."""

    colour: ImageArray
    """RGB, (height, width, 3)."""
    robot: Robot
    raw_depth: CodeArray | None = None
    """Raw picture of the depth camera, (height, width), codes; None for a picture file."""
    camera_pose: FloatArray | None = None
    """Camera frame to body frame, (4, 4), m; None when the pose of the head is unknown."""


@dataclass(frozen=True)
class ObjectHints:
    """Facts that the person states about the object; None for what is to be found in the picture."""

    label: str
    at_px: tuple[int, int] | None = None
    box_px: PixelBox | None = None
    shape: ObjectShape | None = None
    size_m: tuple[float, ...] | None = None
    """Lengths in m: sphere diameter; cylinder diameter, height; box x, y, z."""
    distance_m: float | None = None
    """Distance from the camera to the object's surface, for a picture without depth."""
    graspable: bool | None = None
    mass_kg: float | None = None


@dataclass(frozen=True)
class LearnedObject:
    """The learned row of the catalogue, and how it was found."""

    known: ObjectSpec
    region: ObjectRegion
    range: ColourRange
    measured: MeasuredSize | None
    """None when the person stated the size."""
    overlaps: tuple[ColourOverlap, ...]
    matched: BoolArray
    """Pixels with one of its colours in the smoothed picture, (height, width)."""
    elsewhere: int
    """Number of matched blobs that are not the object."""
    warnings: tuple[str, ...]

    @property
    def matched_share(self) -> float:
        """Share of the object's own pixels that match."""
        return float(self.matched[self.region.mask > 0].mean())


def learn(view: ObjectView, hints: ObjectHints, catalogue: Catalogue) -> LearnedObject:
    """Finds the object in the view and learns its colours and size.

    Raises ConfigError when no object can be found, its size is unknown, or the catalogue is full.
    """
    others = [known for known in catalogue if known.label != hints.label]
    if len(others) >= MAX_OBJECTS:
        raise ConfigError(
            f"{len(others)} known objects, and the detector takes at most {MAX_OBJECTS}: remove one from the catalogue"
        )
    picture = ColourField(view.colour)
    region = _region(picture, hints, others)
    smooth = np.asarray(cv2.blur(np.ascontiguousarray(view.colour), (3, 3)), dtype=np.uint8)
    found = range_of(smooth[region.coloured], others)
    camera = view.robot.camera.scaled(picture.width, picture.height)
    shape = hints.shape or _shape_of(hints.size_m) or guessed_shape(region, camera)
    measured = None if hints.size_m is not None else _measured(view, hints, region, shape)
    known = _row(hints, shape, measured, found)
    common = tuple(overlaps(found, others))
    matched = in_boxes(found.boxes, lab_of(smooth))
    elsewhere = _blobs_beside(matched, region, picture.scale)
    few = region.area_px < FEW_PX * picture.scale**2
    warnings = [
        *_colour_warnings(found, common, elsewhere),
        *(["it touches the picture's edge, so the learned size lacks the part that is cut off"] if region.cut else []),
        *([f"it has only {region.area_px} pixels, so its size is inexact"] if few and measured is not None else []),
        *(["the camera is assumed to look horizontally; give --size if it did not"]
          if measured is not None and view.camera_pose is None and shape != "sphere" else []),
    ]  # fmt: skip
    return LearnedObject(known, region, found, measured, common, matched, elsewhere, tuple(warnings))


def _region(picture: ColourField, hints: ObjectHints, others: list[ObjectSpec]) -> ObjectRegion:
    if hints.at_px is not None:
        return at_pixel(picture, *hints.at_px)
    if hints.box_px is not None:
        return in_box(picture, hints.box_px)
    known = np.zeros((picture.height, picture.width), dtype=np.bool_)
    for other in others:
        known |= matches(other, picture.lab)
    return most_salient(picture, known)


# --- its size -------------------------------------------------------------------------------------


def _shape_of(size_m: tuple[float, ...] | None) -> ObjectShape | None:
    """The shape that has this number of lengths."""
    return None if size_m is None else next(shape for shape, sizes in SIZES.items() if sizes == len(size_m))


def _measured(view: ObjectView, hints: ObjectHints, region: ObjectRegion, shape: ObjectShape) -> MeasuredSize:
    depth_m = hints.distance_m
    if depth_m is None and view.raw_depth is None:
        raise ConfigError(
            "the object's size cannot be measured in a picture without depth: give --size 0.066x0.12 (diameter x height"
            " in metres; one number for a ball, three for a box), or its distance with --distance"
        )
    if depth_m is None and view.raw_depth is not None:
        depth_m = surface_depth_m(view.raw_depth, region, view.robot)
        if depth_m is None:
            raise ConfigError(
                "the camera has no depth at the object: place it 0.6 to 2 m away from the camera, or give --size"
            )
    assert depth_m is not None
    camera = view.robot.camera.scaled(view.colour.shape[1], view.colour.shape[0])
    return size_of(region, camera, depth_m, shape, view.camera_pose)


def _row(hints: ObjectHints, shape: ObjectShape, measured: MeasuredSize | None, found: ColourRange) -> ObjectSpec:
    if hints.size_m is not None:
        sizes = hints.size_m
        if _shape_of(sizes) != shape:
            raise ConfigError(f"--size: a {shape} has {SIZES[shape]} lengths, not {len(sizes)}")
        width_m, height_m = sizes[0], sizes[-1]
        box_m = (sizes[0], sizes[1], sizes[2]) if len(sizes) == 3 else None
    else:
        assert measured is not None
        width_m, height_m = round(measured.width_m, 3), round(measured.height_m, 3)
        box_m = (width_m, width_m, height_m)
    round_shape = shape != "box"
    narrow_m = width_m if round_shape or box_m is None else min(box_m[:2])
    fits = GRASPABLE_WIDTH_M[0] <= narrow_m <= GRASPABLE_WIDTH_M[1] and height_m >= GRASPABLE_HEIGHT_M
    volume_m3 = (pi / 6 if shape == "sphere" else pi / 4 if round_shape else 1.0) * width_m * narrow_m * height_m
    return ObjectSpec(
        label=hints.label,
        shape=shape,
        radius_m=width_m / 2 if round_shape else None,
        height_m=height_m if shape == "cylinder" else None,
        box_m=box_m if shape == "box" else None,
        mass_kg=hints.mass_kg or max(round(500.0 * volume_m3, 2), 0.01),
        graspable=fits if hints.graspable is None else hints.graspable,
        rgb=found.rgb,
        lab=found.lab,
        lab_by_shape=found.lab_by_shape,
    )


# --- warnings -----------------------------------------------------------------------------------


def _blobs_beside(matched: BoolArray, region: ObjectRegion, scale: float) -> int:
    near = np.asarray(cv2.dilate(region.mask, np.ones((7, 7), dtype=np.uint8)))
    beside = (matched & (near == 0)).astype(np.uint8)
    opened = cv2.morphologyEx(beside, cv2.MORPH_OPEN, np.ones((3, 3), dtype=np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(np.asarray(opened, dtype=np.uint8), connectivity=8)
    return int(np.count_nonzero(stats[1:, cv2.CC_STAT_AREA] >= ELSEWHERE_PX * scale**2))


def _colour_warnings(found: ColourRange, common: tuple[ColourOverlap, ...], elsewhere: int) -> list[str]:
    warnings = []
    if found.chromaticity < NEARLY_GREY:
        warnings.append("its colour is nearly grey, like walls, floors and the robot, so it will be seen everywhere")
    warnings += [
        f"{overlap.label} has colours in common with it: {overlap.of_new:.0%} of its colours match "
        f"{overlap.label}, {overlap.of_known:.0%} of {overlap.label}'s match it; only shape and size distinguish them"
        for overlap in common
    ]
    if elsewhere:
        places = "one more place" if elsewhere == 1 else f"{elsewhere} more places"
        warnings.append(
            f"{places} in this picture {'has' if elsewhere == 1 else 'have'} its colour (red in the picture)"
        )
    return warnings
