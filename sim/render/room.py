"""The room around every scene: a grey floor, light walls, a ceiling. Nothing in it has an object's colour.

The floor is the physics' floor (z = 0). The walls only close the picture: nothing collides with them, and they
stand out of the depth camera's range of anything near the middle of the room.
"""

from __future__ import annotations

from typing import NamedTuple

HALF_WIDTH_M = 10.0
HEIGHT_M = 3.0

Rgb = tuple[float, float, float]


class RoomColours(NamedTuple):
    floor: Rgb = (0.50, 0.49, 0.47)
    floor_other: Rgb = (0.54, 0.53, 0.51)
    """Every other tile of 0.5 m."""
    wall: Rgb = (0.70, 0.70, 0.69)
    skirting: Rgb = (0.42, 0.42, 0.42)
    ceiling: Rgb = (0.80, 0.80, 0.79)


TILE_M = 0.5
SKIRTING_M = 0.12
COLOURS = RoomColours()
