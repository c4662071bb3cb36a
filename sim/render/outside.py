"""Pictures for people: the simulated world from outside, with soft shadows and without jagged edges.

A picture is the mean of several drawings. Each has the camera moved by a part of a pixel, and another light: a lamp
that is no point, or a part of the sky. So shadows have soft edges, and corners are darker.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import cos, pi, sin, sqrt, tan
from typing import NamedTuple

import numpy as np

from cocoro.arrays import Float32Array, FloatArray, ImageArray
from cocoro.robot import Camera
from cocoro.units import Vec3
from sim.render.choice import RendererChoice, make_renderer
from sim.render.gl import GlRenderer
from sim.render.interface import Visual

VIEW_RAD = 0.66
"""Height of the picture as an angle, 38 degrees."""
SOFT = 0.06
"""Half width of the lamp, seen from the scene, rad."""
LAMP_SHARE = 0.62
"""Share of the lamp in the light; the rest is sky."""
SKY_AMBIENT = 0.35
"""Share of the sky's light that reaches every place, as light from the walls does."""
LAMP_K, SKY_K = 5600.0, 7600.0
"""Colour temperatures: a warm lamp, a cool sky."""
BRIGHTEN = 1.9
"""Power of the tone curve, which brightens the middle and keeps what is white and what is black."""
GOLDEN = (sqrt(5) - 1) / 2
FAST, FINE = 4, 48
"""Drawings for each picture of a long film, and of a small one to show."""


class OutsideLight(NamedTuple):
    """See `interface.Lighting`."""

    ambient: float
    diffuse: float
    direction: Vec3
    temperature_k: float = 6500.0


class OutsideRenderer:
    """Draws the visuals that it was made with, as GlRenderer and TinyRenderer do."""

    def __init__(
        self,
        visuals: Sequence[Visual],
        width: int,
        height: int,
        samples: int = FAST,
        choice: RendererChoice = "auto",
    ) -> None:
        """`samples`: drawings for each picture. The slow renderer makes one, without shadows."""
        focal = height / 2 / tan(VIEW_RAD / 2)
        self.camera = Camera(width=width, height=height, fx=focal, fy=focal, cx=(width - 1) / 2, cy=(height - 1) / 2)
        self._renderer = make_renderer(visuals, self.camera, choice)
        self._samples = samples

    def picture(self, poses: FloatArray, camera_pose: FloatArray, about_m: FloatArray, lamp: Vec3) -> ImageArray:
        """A picture, RGB, (height, width, 3). `about_m` is the point (3,) around which there are shadows, `lamp` the
        direction in which its light travels."""
        if not isinstance(self._renderer, GlRenderer):
            light = OutsideLight(0.5, 0.5, lamp)
            return _toned(self._renderer.render(poses, camera_pose, camera_pose, light).colour.astype(np.float32))
        sums = np.zeros((self.camera.height, self.camera.width, 3), np.float32)
        lights = _lights(self._samples, lamp)
        self._renderer.place(poses)
        for number, (light, share) in enumerate(lights):
            shift = ((number + 0.5) / len(lights) - 0.5, (number * GOLDEN) % 1.0 - 0.5)
            self._renderer.draw(camera_pose, light, about_m, shift)
            sums += share * self._renderer.picture()
        return _toned(sums)

    def close(self) -> None:
        self._renderer.close()


def _toned(light: Float32Array) -> ImageArray:
    """The picture of a light, (height, width, 3), 0 to 255."""
    dark = np.clip(1.0 - light / 255.0, 0.0, 1.0)
    picture: ImageArray = np.rint(255.0 * (1.0 - dark**BRIGHTEN)).astype(np.uint8)
    return picture


def _lights(samples: int, lamp: Vec3) -> list[tuple[OutsideLight, float]]:
    """The lights of the drawings of one picture, and each one's share in it."""
    towards = np.array(lamp) / np.linalg.norm(lamp)
    across = np.cross(towards, (0.0, 0.0, 1.0))
    across = across / np.linalg.norm(across) if np.linalg.norm(across) > 1e-6 else np.array((1.0, 0.0, 0.0))
    axes = across, np.cross(towards, across)
    sky = samples // 2 if samples >= 8 else 0
    lamps = samples - sky
    ambient = 0.0 if sky else 1.0 - LAMP_SHARE
    found = []
    for number in range(lamps):
        turn, reach = 2 * pi * number * GOLDEN, SOFT * sqrt((number + 0.5) / lamps)
        direction = towards + reach * (cos(turn) * axes[0] + sin(turn) * axes[1])
        share = (LAMP_SHARE if sky else 1.0) / lamps
        found.append((OutsideLight(ambient, 1.0 - ambient, _vec3(direction), LAMP_K), share))
    for number in range(sky):
        turn, down = 2 * pi * number * GOLDEN, sqrt((number + 0.5) / sky)  # even over the sky's part above the floor
        direction = np.array((down * cos(turn), down * sin(turn), -sqrt(max(1 - down * down, 0.02))))
        found.append((OutsideLight(SKY_AMBIENT, 1.0 - SKY_AMBIENT, _vec3(direction), SKY_K), (1.0 - LAMP_SHARE) / sky))
    return found


def look_at(eye_m: FloatArray, point_m: FloatArray) -> FloatArray:
    """World pose (4, 4) of a level camera (x right, y down, z forward) at `eye_m` (3,) that looks at `point_m` (3,)."""
    forward = (point_m - eye_m) / np.linalg.norm(point_m - eye_m)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, :3] = np.column_stack([right, np.cross(forward, right), forward])
    pose[:3, 3] = eye_m
    return pose


def _vec3(values: FloatArray) -> Vec3:
    x, y, z = values.tolist()
    return x, y, z
