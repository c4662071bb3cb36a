"""The tables of a robot description that say how it sees and grasps: head, camera, marker, claw, and the arm's hull."""

from __future__ import annotations

from math import radians
from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro.units import Positive, Vec3

LensValues = tuple[float, float, float, float, float, float, float, float, float]
"""fx, fy, cx, cy in pixels, then OpenCV's distortion coefficients k1, k2, p1, p2, k3."""


class Head(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The joints that turn the camera. Without this table it is fixed on the body, and the base turns to look about."""

    pan: str
    """About the vertical, counter-clockwise positive."""
    tilt: str
    """Up positive."""


class Kinect(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    width: int
    height: int
    rate_hz: Positive
    horizontal_fov_rad: Positive
    vertical_fov_rad: Positive
    depth_offset_m: Vec3
    projector_offset_m: Vec3
    min_range_m: Positive
    max_range_m: Positive
    depth_curve: Vec3
    mount_min_m: Vec3 | None = None
    mount_max_m: Vec3 | None = None
    """The box that holds the camera up, body frame, which arm and hand must not enter; both corners or none."""
    colour_lens: LensValues | None = None
    depth_lens: LensValues | None = None
    """Calibration of both lenses. The driver rectifies its images; readers of frames use the fields of view above."""
    depth_rotation_rad: Vec3 = (0.0, 0.0, 0.0)
    """Rotation vector from the depth camera's frame to the colour camera's."""
    link: str = "camera"  # what it was called before it could be called otherwise
    """The link that carries it, whose frame is the colour camera's: x right, y down, z forward."""

    @property
    def mount(self) -> tuple[Vec3, Vec3] | None:
        """The corners of the mount's box; None where nothing is to be kept clear of."""
        low_m, high_m = self.mount_min_m, self.mount_max_m
        return None if low_m is None or high_m is None else (low_m, high_m)


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
