"""Perception's configuration: the `[service.perception]` table of a profile."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from cocoro.topics import ARM_STATE
from cocoro.units import Positive, PositiveShare


class PerceptionConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Pixel counts are for frames of 640 x 480 and are scaled with the frame's area."""

    detector: Literal["blob", "paper"] = "blob"
    objects: str | None = None
    """Path of a catalogue file; the project's own by default."""

    max_frame_age_s: Positive = 0.5
    """Older frames are ignored."""
    bracket_wait_s: Annotated[float, Meta(ge=0)] = 0.05
    """Longest time that a frame's detections wait for the head angles around its stamp. Then they are published
    without positions."""
    max_head_gap_s: Positive = ARM_STATE.max_age_s
    """Longest gap in the arm's states across which head angles are interpolated."""

    min_area_px: Positive = 32.0
    """Smaller blobs are noise. A can at 3.5 m has 220 pixels, the hand's marker at 1 m 170."""
    min_share: PositiveShare = 0.5
    """Least share of the pixels that the object would have at its distance. A smaller blob is another, smaller thing,
    unless the object is partly hidden."""
    min_hidden_share: PositiveShare = 0.08
    """As `min_share`, for an object that the image's edge or something nearer hides in part."""
    max_share: Annotated[float, Meta(ge=1)] = 1.7
    """Largest such share. A larger blob is another, larger thing."""
    occluded_share: PositiveShare = 0.6
    """Below this share of the expected pixels a detection is noted 'occluded'."""

    paper_grid: Annotated[int, Meta(ge=1)] = 5
    """Number of the paper's tiles along each side of the image."""
    paper_threshold_px: Positive = 64.0
    """The paper's threshold: an object is present when its fullest tile has more matching pixels."""

    floor_rate_hz: Positive = 10.0
    """Rate of the floor scans; at most one per frame."""
    floor_range_m: Positive = 3.0
    floor_tolerance_m: Positive = 0.025
    floor_tolerance_per_m: Positive = 0.012
    """Heights below the tolerance, which grows with the distance, count as floor."""
    obstacle_height_m: Positive = 0.85
    """The robot passes below anything higher."""
