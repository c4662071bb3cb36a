"""Perception's tunables, as a profile gives them."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from cocoro.topics import ARM_STATE
from cocoro.units import Positive, PositiveShare


class PerceptionConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Pixel counts are for a frame of 640 x 480 and are scaled with the frame's area."""

    detector: Literal["blob", "paper"] = "blob"
    objects: str | None = None
    """Path of the file of known objects; the project's own when there is none."""

    max_frame_age_s: Positive = 0.5
    """An older frame is not looked at."""
    bracket_wait_s: Annotated[float, Meta(ge=0)] = 0.05
    """How long a frame's detections wait for the head angles around its stamp; then they go out without position."""
    max_head_gap_s: Positive = ARM_STATE.max_age_s
    """Head angles are not interpolated across a longer silence of the arm's state."""

    min_area_px: Positive = 32.0
    """Smaller blobs are noise. A can at 3.5 m has 220 pixels, the hand's marker at 1 m 170."""
    min_share: PositiveShare = 0.5
    """Of the pixels that an object of that size has at that distance; with fewer it is another, smaller thing of that
    colour, unless something hides the rest."""
    min_hidden_share: PositiveShare = 0.08
    """The same where the image's edge or something nearer hides the rest."""
    max_share: Annotated[float, Meta(ge=1)] = 1.7
    """With more it is another, larger thing of that colour."""
    occluded_share: PositiveShare = 0.6
    """Below this share of the expected pixels a detection is noted 'occluded'."""

    paper_grid: Annotated[int, Meta(ge=1)] = 5
    """The paper's tiles along each side of the image."""
    paper_threshold_px: Positive = 64.0
    """The paper's: an object is present above so many matching pixels in its fullest tile."""

    floor_rate_hz: Positive = 10.0
    """How often the floor is scanned for what stands on it; no more than once a frame."""
    floor_range_m: Positive = 3.0
    floor_tolerance_m: Positive = 0.025
    floor_tolerance_per_m: Positive = 0.012
    """Lower than this, growing with the distance, counts as floor."""
    obstacle_height_m: Positive = 0.85
    """Higher than this the robot passes beneath."""
