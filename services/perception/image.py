"""A frame as arrays, with depth as the colour camera sees it."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import ceil, floor, sqrt
from typing import Protocol

import numpy as np

from cocoro.arrays import CodeArray, Float32Array, FloatArray, ImageArray
from cocoro.messages import Frame
from cocoro.robot import Camera, Robot

PixelBox = tuple[int, int, int, int]
"""left, top, right, bottom, px; right and bottom are exclusive."""


class RgbdImage:
    """One frame: `colour` is RGB, uint8, shape (height, width, 3); `raw_depth` are the sensor's codes, uint16, shape
    (height, width). Both are views of the message."""

    def __init__(self, colour: ImageArray, raw_depth: CodeArray, robot: Robot) -> None:
        self.colour = colour
        self.raw_depth = raw_depth
        self.height, self.width = raw_depth.shape
        self._robot = robot

    @classmethod
    def of(cls, frame: Frame, robot: Robot) -> RgbdImage:
        shape = frame.height, frame.width
        colour = np.frombuffer(frame.colour, dtype=np.uint8).reshape(*shape, 3)
        return cls(colour, np.frombuffer(frame.depth, dtype="<u2").reshape(shape), robot)

    @cached_property
    def camera(self) -> Camera:
        """The colour camera's parameters at this frame's resolution."""
        return self._robot.camera.scaled(self.width, self.height)

    @property
    def scale(self) -> float:
        """Resolution relative to 640 x 480: 0.5 at 320 x 240."""
        return sqrt(self.width * self.height / (640 * 480))

    def clip(self, box: PixelBox, margin: int = 0) -> PixelBox:
        """The box, grown by a margin, px, and clipped to the image."""
        left, top, right, bottom = box
        return (
            max(left - margin, 0),
            max(top - margin, 0),
            min(right + margin, self.width),
            min(bottom + margin, self.height),
        )

    def unregistered_depth_m(self, u: int, v: int) -> float | None:
        """Depth at a pixel of the depth image, m, ignoring the offset between the cameras; None without data."""
        depth = float(self._robot.depth_m(self.raw_depth[v : v + 1, u : u + 1])[0, 0])
        return depth if np.isfinite(depth) else None

    def depth_m(self, box: PixelBox) -> Float32Array:
        """Depth along the optical axis at the colour pixels of a box, m, shape (bottom - top, right - left).

        The depth camera is beside the colour camera, so each depth pixel of the neighbourhood is moved to the
        colour pixel that shows its point; where several meet, the nearest counts. NaN without data, in an infrared
        shadow, and in cracks between moved pixels.
        """
        left, top, right, bottom = box
        camera = self.camera
        ox, oy, oz = self._robot.kinect.depth_offset_m
        # A point at depth z moves by f * offset / z pixels between the two images, and farthest at the nearest depth.
        nearest_m = self._robot.kinect.min_range_m
        shift_u, shift_v = camera.fx * ox / nearest_m, camera.fy * oy / nearest_m
        spare = ceil(abs(oz) / nearest_m * self.width) + 1
        source_left, source_top, source_right, source_bottom = self.clip(
            (
                left + floor(min(-shift_u, 0)) - spare,
                top + floor(min(-shift_v, 0)) - spare,
                right + ceil(max(-shift_u, 0)) + spare,
                bottom + ceil(max(-shift_v, 0)) + spare,
            )
        )
        raw = self.raw_depth[source_top:source_bottom, source_left:source_right]
        depth = self._robot.depth_m(raw)
        rows, columns = np.nonzero(np.isfinite(depth))
        z = depth[rows, columns]
        z_colour = z + np.float32(oz)
        u = ((columns + np.float32(source_left - camera.cx)) * z + np.float32(camera.fx * ox)) / z_colour
        v = ((rows + np.float32(source_top - camera.cy)) * z + np.float32(camera.fy * oy)) / z_colour
        column = np.rint(u + np.float32(camera.cx - left)).astype(np.int32)
        row = np.rint(v + np.float32(camera.cy - top)).astype(np.int32)
        width, height = right - left, bottom - top
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        out = np.full(width * height, np.inf, dtype=np.float32)
        np.minimum.at(out, row[inside] * width + column[inside], z_colour[inside])
        out[np.isinf(out)] = np.nan
        return out.reshape(height, width)


@dataclass(frozen=True)
class Evidence:
    """An object's extent by the depth image, in the colour camera's frame (x right, y down, z forward)."""

    surface_m: FloatArray
    """Points on its visible surface, m, shape (n, 3)."""
    outline: FloatArray
    """Directions with z = 1 of its outermost pixels, shape (k, 3); each ray meets the object."""
    beside: FloatArray
    """Directions with z = 1 of pixels just outside of its outline with known depth, shape (m, 3)."""
    free_to_m: FloatArray
    """Depth to which each ray of `beside` is known to be free, m, shape (m,)."""

    @property
    def count(self) -> int:
        return len(self.surface_m) + len(self.outline) + len(self.beside)


@dataclass(frozen=True)
class ImageSighting:
    label: str
    u_px: float
    v_px: float
    area_px: int
    box_px: PixelBox
    depth_m: float | None
    """Depth of the visible surface along the optical axis."""
    cut: bool = False
    """It touches the image's edge."""
    hidden: bool = False
    """It is smaller than the whole object, and something nearer may hide the rest."""
    evidence: Evidence | None = None
    """None from a detector that uses the centroid alone."""


class Detector(Protocol):
    def detect(self, image: RgbdImage) -> list[ImageSighting]:
        """The known objects in the image, at most one per label, in the catalogue's order."""
