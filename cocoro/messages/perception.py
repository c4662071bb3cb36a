"""Messages of perception: known objects and the floor in one frame."""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta

from cocoro.messages.common import Count, Finite, FiniteNonNegative, FiniteVec2, FiniteVec3, Message


class Detection(msgspec.Struct, kw_only=True):
    """One known object in one frame."""

    label: str
    u_px: Finite
    v_px: Finite
    """Centroid in the colour image, pixels right and down from the top left pixel's centre."""
    area_px: Count
    box_px: tuple[int, int, int, int]
    """Bounding box of the matching pixels: left, top, right, bottom; right and bottom exclusive."""
    depth_m: Finite | None = None
    """Depth of the visible surface along the optical axis; None when the depth image has no value there."""
    position_m: FiniteVec3 | None = None
    """The object's centre (the visible surface moved inwards by the known radius) in the body frame at the frame's
    stamp; None without depth or without head angles for that stamp."""
    sigma_m: FiniteNonNegative | None = None
    """Standard deviation of the position along the line of sight, where it was found by colour alone: of what is alike
    from picture to picture, too, so that more pictures do not make it smaller. None of a position by depth, whose
    error the planner's settings have."""
    note: str = ""
    """Why the position is missing or doubtful: 'no depth', 'no head angles', 'occluded', 'cut'."""


class Detections(Message):
    """All known objects in one frame. `stamp_ns` is the frame's stamp."""

    frame_seq: Count
    frame_incarnation: Count
    width: int
    height: int
    pan_rad: Finite | None = None
    tilt_rad: Finite | None = None
    """Head angles, interpolated at the frame's stamp, by which the objects were localised. None without a neck."""
    detections: tuple[Detection, ...] = ()


class Obstacles(Message):
    """Occupied and free floor in one depth image; known objects count as occupied. `stamp_ns` is the frame's stamp, and
    coordinates are in the body frame at that stamp."""

    points_m: Annotated[tuple[FiniteVec3, ...], Meta(max_length=4096)] = ()
    """One point for each occupied floor cell of 4 cm: x, y of its middle, z of the highest point in it."""
    lowest_m: Annotated[tuple[Finite, ...], Meta(max_length=4096)] = ()
    """Height of the lowest point in each cell of `points_m`; empty in captures of before it was measured."""
    nearest: bytes = b""
    """Nearest depth (m) in each block of the depth image, row by row from its top left: 30 rows of 40 blocks, one byte
    each, in steps of 14 mm rounded down; 0 where no pixel of the block has data."""
    free: Annotated[tuple[FiniteVec3, ...], Meta(max_length=1024)] = ()
    """Rays over free floor from `origin_m`: bearing (rad, body frame), nearest and farthest distance (m) at which the
    floor is visible. A ray ends before the first obstacle on it."""
    shown: Annotated[bytes, Meta(max_length=6144)] = b""
    """Visible floor, also beyond things: bearing (degree), nearest and farthest distance (mm) of each stretch, 2 bytes
    each, lowest first."""
    origin_m: FiniteVec2 = (0.0, 0.0)
    """The camera's position, projected on the floor."""
