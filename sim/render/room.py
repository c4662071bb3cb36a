"""The room around every scene: a grey floor, light walls and a ceiling, none in the colour of an object.

The floor is that of the physics (z = 0). The walls are only drawn: nothing collides with them, and from the middle of
the room they are beyond the depth camera's range.
"""

from __future__ import annotations

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.robot import Camera
from cocoro.units import Vec3
from sim.render.interface import Visual

HALF_WIDTH_M = 10.0
HEIGHT_M = 3.0
TILE_M = 0.5
FLOOR_RGB: Vec3 = (0.49, 0.49, 0.485)
OTHER_TILE_RGB: Vec3 = (0.53, 0.53, 0.525)
_WALL_RGB: Vec3 = (0.72, 0.72, 0.71)
_SKIRTING_RGB: Vec3 = (0.40, 0.40, 0.40)
_CEILING_RGB: Vec3 = (0.85, 0.85, 0.84)
_THICK_M = 0.1
_SKIRTING_M = 0.12
WALL_PARTS_M = _THICK_M / 4
"""How far the skirting boards stand out from the walls."""


def walls() -> list[tuple[Visual, Vec3]]:
    """Walls, skirting boards and ceiling, each with the world position of its centre, m."""
    long, half = 2 * HALF_WIDTH_M, HALF_WIDTH_M + _THICK_M / 2
    parts = [(Visual("ceiling", "box", (long, long, _THICK_M), _CEILING_RGB), (0.0, 0.0, HEIGHT_M + _THICK_M / 2))]
    for x, y in ((half, 0.0), (-half, 0.0), (0.0, half), (0.0, -half)):
        for name, rgb, height, thick in (
            ("wall", _WALL_RGB, HEIGHT_M, _THICK_M),
            ("skirting", _SKIRTING_RGB, _SKIRTING_M, 1.5 * _THICK_M),
        ):
            size = (thick, long, height) if x else (long, thick, height)
            parts.append((Visual(name, "box", size, rgb), (x, y, height / 2)))
    return parts


def nearest_wall_m(camera: Camera, pose: FloatArray) -> float:
    """A lower bound of the depth at which the camera at `pose` (4, 4) sees walls and ceiling, m; infinite for none.

    A ray's part along a world axis is linear in the pixel, so a plane is nearest in a corner of the picture.
    """
    right, bottom = camera.width - 0.5, camera.height - 0.5
    rays = np.array([camera.ray(u, v) for u in (-0.5, right) for v in (-0.5, bottom)]) @ pose[:3, :3].T
    inside = HALF_WIDTH_M - WALL_PARTS_M
    gaps_m = np.array([(inside, inside, HEIGHT_M)]) - pose[:3, 3] * np.array([(1, 1, 1), (-1, -1, 0)])
    towards = np.array([rays.max(axis=0), -rays.min(axis=0)])
    towards[1, 2] = 0.0  # below is the floor
    seen = towards > 0
    return float(np.max([0.0, (np.maximum(gaps_m, 0.0)[seen] / towards[seen]).min()])) if seen.any() else float("inf")
