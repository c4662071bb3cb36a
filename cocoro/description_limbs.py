"""The tables of a robot description that say how it looks and grasps: head, marker, claw, and the arm's hull."""

from __future__ import annotations

from math import radians
from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro.units import Positive, Vec3


class Head(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The joints that turn the camera. Without this table it is fixed on the body, and the base turns to look about."""

    pan: str
    """About the vertical, counter-clockwise positive."""
    tilt: str
    """Up positive."""


class Reach(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Where the arm works: distances of `arm.tip` from the axis of the arm's first joint, and heights.

    Without this table the planner takes those of its own settings, which are a Calliope's. What a profile sets there
    counts before either."""

    grasp_radius_m: Positive
    """Preferred distance of a target for grasping."""
    grasp_radius_range_m: tuple[Positive, Positive]
    touch_radius_range_m: tuple[Positive, Positive]
    retreat_radius_m: Positive
    """Where the hand waits behind a target before it closes in: the smallest distance that the arm reaches."""
    travel_radius_m: Positive
    travel_height_m: Positive
    """Where the hand is carried empty."""
    carry_radius_m: Positive
    carry_rise_m: Positive
    """Height at which an object is carried above where it was grasped."""

    def __post_init__(self) -> None:
        for name in ("grasp_radius_range_m", "touch_radius_range_m"):
            low, high = getattr(self, name)
            if not low < high:
                raise ValueError(f"reach.{name} must rise, not {[low, high]}")


class Marker(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The ball on the hand that babbling looks at; `position_m` is in the link's frame."""

    link: str
    radius_m: Positive
    position_m: Vec3


class Claw(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One or two jaws. With one, the other finger is fixed on the hand."""

    pad_length_m: Positive
    """Length of a finger and of the pad along it."""
    open_sign: dict[str, float]
    """By joint, the sign of the angles towards which it opens. The x axis of the link that it moves points away from
    the other finger at angle 0."""
    level_roll_deg: float
    """The hand's roll at which the claws lie level, for upright targets; the marker then stands above the hand."""
    pad_gap_m: Positive
    """Distance of the pads at angle 0 of the claws, at which they are parallel."""
    pad_height_m: Positive
    pad_thickness_m: Positive
    fixed_pad_m: float | None = None
    """With one jaw: distance of the fixed pad's face from the axis of `arm.tip`, on the side away from the jaw."""
    open_deg: Positive | None = None
    """How far a jaw opens to go around a thing; None: as the planner's settings say, which are a Calliope's."""

    @property
    def jaw_pad_m(self) -> float:
        """Distance of a moving pad's face from the axis of `arm.tip` at angle 0."""
        return self.pad_gap_m / 2 if self.fixed_pad_m is None else self.pad_gap_m - self.fixed_pad_m

    @property
    def open_rad(self) -> float | None:
        return None if self.open_deg is None else radians(self.open_deg)

    @property
    def level_roll_rad(self) -> float:
        return radians(self.level_roll_deg)


class Tube(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A stretch of the arm's hull: balls evenly spaced from one link's origin to another's, both ends included."""

    name: str
    start: str
    end: str
    radius_m: Positive
    balls: Annotated[int, Meta(ge=2)]


class Hull(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """The space that arm and hand take up, and the Kinect's housing, for keeping them apart."""

    kinect_min_m: Vec3 | None = None
    kinect_max_m: Vec3 | None = None
    """A box, body frame, that holds the Kinect's housing at every head angle; both corners or none."""
    finger_radius_m: Positive
    finger_turn_deg: dict[str, float]
    """By claw link, the angle in its x-y plane from its x axis to its finger."""
    tube: Annotated[list[Tube], Meta(min_length=1)]
    """From the chassis out. The first one turns on the chassis and is not checked against it."""

    @property
    def kinect(self) -> tuple[Vec3, Vec3] | None:
        """The corners of the box that holds the Kinect's housing; None where nothing is to be kept clear of."""
        if self.kinect_min_m is None or self.kinect_max_m is None:
            return None
        return self.kinect_min_m, self.kinect_max_m
