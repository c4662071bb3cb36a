"""From one look at a new object to its row of the catalogue, with all that a person wants to know before it is kept."""

from __future__ import annotations

from dataclasses import dataclass
from math import pi

import cv2
import numpy as np

from apps.appearance.ranges import NEARLY_GREY, ColourOverlap, ColourRange, overlaps, range_of
from apps.appearance.region import ColourField, ObjectRegion, PixelBox, at_pixel, in_box, most_salient
from apps.appearance.size import MeasuredSize, ObjectShape, guessed_shape, size_of, surface_depth_m
from cocoro.arrays import BoolArray, CodeArray, FloatArray, ImageArray
from cocoro.colour import in_boxes, lab_of, matches
from cocoro.errors import ConfigError
from cocoro.objects import Catalogue, ObjectSpec
from cocoro.robot import Robot

GRASPABLE_WIDTH_M = (0.02, 0.075)
GRASPABLE_HEIGHT_M = 0.045
"""What the claws reach around, and what they do not close above."""
FEW_PX = 600.0
"""Of 640 x 480: with fewer pixels the size is off by more than a few per cent."""
ELSEWHERE_PX = 32.0
"""Of 640 x 480: a smaller blob of the new colour elsewhere is passed over by the detector."""
SIZES: dict[ObjectShape, int] = {"sphere": 1, "cylinder": 2, "box": 3}
"""How many lengths a shape has, as the person gives them."""
MAX_OBJECTS = 32
"""As many as the detector's colour table holds."""


@dataclass(frozen=True)
class ObjectView:
    """One look at the object."""

    colour: ImageArray
    """RGB, (height, width, 3)."""
    robot: Robot
    raw_depth: CodeArray | None = None
    """The depth camera's own view, (height, width); None for a mere picture."""
    camera_pose: FloatArray | None = None
    """4 x 4, camera frame to body frame; None when nobody knows how the head stood."""


@dataclass(frozen=True)
class ObjectHints:
    """What the person says of it."""

    label: str
    at_px: tuple[int, int] | None = None
    box_px: PixelBox | None = None
    shape: ObjectShape | None = None
    size_m: tuple[float, ...] | None = None
    """Sphere: diameter; cylinder: diameter, height; box: x, y, z."""
    distance_m: float | None = None
    """From the camera to the object's surface, for a picture without depth."""
    graspable: bool | None = None
    mass_kg: float | None = None


@dataclass(frozen=True)
class LearnedObject:
    """What was learnt, and what is to be said of it."""

    known: ObjectSpec
    region: ObjectRegion
    range: ColourRange
    measured: MeasuredSize | None
    """None when the person gave the size."""
    overlaps: tuple[ColourOverlap, ...]
    matched: BoolArray
    """(height, width): pixels of the picture that have one of its colours, as the detector smooths them."""
    elsewhere: int
    """Blobs of them that are not the object."""
    warnings: tuple[str, ...]

    @property
    def matched_share(self) -> float:
        """Of the object's own pixels."""
        return float(self.matched[self.region.mask > 0].mean())


def learn(look: ObjectView, wanted: ObjectHints, catalogue: Catalogue) -> LearnedObject:
    """Raises ConfigError when there is no object to be told in the picture, or its size is not known."""
    others = [known for known in catalogue if known.label != wanted.label]
    if len(others) >= MAX_OBJECTS:
        raise ConfigError(f"there are {len(others)} known objects already, {MAX_OBJECTS} is all that can be told apart")
    picture = ColourField(look.colour)
    region = _region(picture, wanted, others)
    smooth = np.asarray(cv2.blur(np.ascontiguousarray(look.colour), (3, 3)), dtype=np.uint8)
    found = range_of(smooth[region.coloured], others)
    camera = look.robot.camera.scaled(picture.width, picture.height)
    shape = wanted.shape or _shape_of(wanted.size_m) or guessed_shape(region, camera)
    measured = None if wanted.size_m is not None else _measured(look, wanted, region, shape)
    known = _row(wanted, shape, measured, found)
    common = tuple(overlaps(found, others))
    matched = in_boxes(found.boxes, lab_of(smooth))
    elsewhere = _blobs_beside(matched, region, picture.scale)
    few = region.area_px < FEW_PX * picture.scale**2
    warnings = [
        *_colour_warnings(found, common, elsewhere),
        *(["it touches the picture's edge: its size is too small by what is cut off"] if region.cut else []),
        *([f"it has only {region.area_px} pixels: its size is rough"] if few and measured is not None else []),
        *(["the camera is taken to look level: say --size if it did not"]
          if measured is not None and look.camera_pose is None and shape != "sphere" else []),
    ]  # fmt: skip
    return LearnedObject(known, region, found, measured, common, matched, elsewhere, tuple(warnings))


def _region(picture: ColourField, wanted: ObjectHints, others: list[ObjectSpec]) -> ObjectRegion:
    if wanted.at_px is not None:
        return at_pixel(picture, *wanted.at_px)
    if wanted.box_px is not None:
        return in_box(picture, wanted.box_px)
    known = np.zeros((picture.height, picture.width), dtype=np.bool_)
    for other in others:
        known |= matches(other, picture.lab)
    return most_salient(picture, known)


# --- its size -------------------------------------------------------------------------------------


def _shape_of(size_m: tuple[float, ...] | None) -> ObjectShape | None:
    """The shape that has as many sizes as are given."""
    return None if size_m is None else next(shape for shape, sizes in SIZES.items() if sizes == len(size_m))


def _measured(look: ObjectView, wanted: ObjectHints, region: ObjectRegion, shape: ObjectShape) -> MeasuredSize:
    depth_m = wanted.distance_m
    if depth_m is None and look.raw_depth is None:
        raise ConfigError(
            "a picture does not tell how large the object is: say --size 0.066x0.12 (diameter x height, metres; one "
            "number for a ball, three for a box), or how far away it was with --distance"
        )
    if depth_m is None and look.raw_depth is not None:
        depth_m = surface_depth_m(look.raw_depth, region, look.robot)
        if depth_m is None:
            raise ConfigError(
                "there is no depth where the object is: place it 0.6 to 2 m away from the camera, or say its --size"
            )
    assert depth_m is not None
    camera = look.robot.camera.scaled(look.colour.shape[1], look.colour.shape[0])
    return size_of(region, camera, depth_m, shape, look.camera_pose)


def _row(wanted: ObjectHints, shape: ObjectShape, measured: MeasuredSize | None, found: ColourRange) -> ObjectSpec:
    if wanted.size_m is not None:
        sizes = wanted.size_m
        if _shape_of(sizes) != shape:
            raise ConfigError(f"--size: a {shape} has {SIZES[shape]} sizes, not {len(sizes)}")
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
        label=wanted.label,
        shape=shape,
        radius_m=width_m / 2 if round_shape else None,
        height_m=height_m if shape == "cylinder" else None,
        box_m=box_m if shape == "box" else None,
        mass_kg=wanted.mass_kg or max(round(500.0 * volume_m3, 2), 0.01),
        graspable=fits if wanted.graspable is None else wanted.graspable,
        rgb=found.rgb,
        lab=found.lab,
        lab_by_shape=found.lab_by_shape,
    )


# --- what is to be said ---------------------------------------------------------------------------


def _blobs_beside(matched: BoolArray, region: ObjectRegion, scale: float) -> int:
    near = np.asarray(cv2.dilate(region.mask, np.ones((7, 7), dtype=np.uint8)))
    beside = (matched & (near == 0)).astype(np.uint8)
    opened = cv2.morphologyEx(beside, cv2.MORPH_OPEN, np.ones((3, 3), dtype=np.uint8))
    _, _, stats, _ = cv2.connectedComponentsWithStats(np.asarray(opened, dtype=np.uint8), connectivity=8)
    return int(np.count_nonzero(stats[1:, cv2.CC_STAT_AREA] >= ELSEWHERE_PX * scale**2))


def _colour_warnings(found: ColourRange, common: tuple[ColourOverlap, ...], elsewhere: int) -> list[str]:
    told = []
    if found.chromaticity < NEARLY_GREY:
        told.append("its colour is nearly grey, as walls, floors and the robot itself are: it will be seen everywhere")
    told += [
        f"{overlap.label} has colours in common with it: {overlap.of_new:.0%} of its own would pass for "
        f"{overlap.label}, {overlap.of_known:.0%} of {overlap.label}'s for it; then only shape and size tell them apart"
        for overlap in common
    ]
    if elsewhere:
        places = "one more place" if elsewhere == 1 else f"{elsewhere} more places"
        told.append(f"{places} in this picture {'has' if elsewhere == 1 else 'have'} its colour (red in the picture)")
    return told
