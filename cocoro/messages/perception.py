"""What perception finds in a frame."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro.messages.common import Count, Finite, FiniteVec2, FiniteVec3, Message


class Detection(msgspec.Struct, kw_only=True):
    """One known object in one frame."""

    label: str
    u_px: Finite
    v_px: Finite
    """Centroid in the colour image, pixels right and down from the top left pixel's centre."""
    area_px: Count
    box_px: tuple[int, int, int, int]
    """left, top, right, bottom of the matching pixels, right and bottom exclusive."""
    depth_m: Finite | None = None
    """Along the optical axis, of the visible surface; None when the depth image has none there."""
    position_m: FiniteVec3 | None = None
    """The object's centre (visible surface carried inwards by the known radius), body frame as the body
    stood at the frame's stamp; None without depth or without head angles for that stamp."""
    note: str = ""
    """Why there is no position, or what makes it doubtful: 'no depth', 'no head angles', 'occluded', 'cut'."""


class Detections(Message):
    """All known objects in one frame. `stamp_ns` is the frame's stamp, not the time of publishing."""

    frame_seq: Count
    frame_incarnation: Count
    width: int
    height: int
    pan_rad: Finite | None = None
    tilt_rad: Finite | None = None
    """The head angles that were used: interpolated at the frame's stamp."""
    detections: tuple[Detection, ...] = ()


class Obstacles(Message):
    """What stands on the floor and where the floor is free, from one depth image; known objects included.
    `stamp_ns` is the frame's. Body frame as the body stood then."""

    points_m: Annotated[tuple[FiniteVec3, ...], Meta(max_length=4096)] = ()
    """One a floor cell of 4 cm in which something stands: its middle x, y, and the height of the highest point seen."""
    free: Annotated[tuple[FiniteVec3, ...], Meta(max_length=1024)] = ()
    """Rays over free floor from `origin_m`: bearing (rad, body frame), and from which to which distance (m) the floor
    is seen; a ray ends before the first thing that stands in it."""
    origin_m: FiniteVec2 = (0.0, 0.0)
    """Where the camera stood, on the floor."""
