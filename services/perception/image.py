"""One frame as arrays: colour, and depth as the colour camera sees it."""

from __future__ import annotations

from functools import cached_property
from math import ceil, floor, sqrt

import numpy as np

from cocoro.arrays import CodeArray, Float32Array, ImageArray
from cocoro.messages import Frame
from cocoro.robot import Camera, Robot

PixelBox = tuple[int, int, int, int]
"""left, top, right, bottom in pixels; right and bottom exclusive."""


class RgbdImage:
    """Colour (height, width, 3) and raw depth codes (height, width) of one frame: views, nothing is copied."""

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
        """The colour camera at this frame's resolution."""
        return self._robot.camera.scaled(self.width, self.height)

    @property
    def scale(self) -> float:
        """Pixels a pixel of 640 x 480: 1.0 there, 0.5 at 320 x 240."""
        return sqrt(self.width * self.height / (640 * 480))

    def clip(self, box: PixelBox, margin: int = 0) -> PixelBox:
        """The box grown by a margin, within the image."""
        left, top, right, bottom = box
        return (
            max(left - margin, 0),
            max(top - margin, 0),
            min(right + margin, self.width),
            min(bottom + margin, self.height),
        )

    def unregistered_depth_m(self, u: int, v: int) -> float | None:
        """The depth image's own value at a pixel, as if both cameras stood in one place; None without data."""
        depth = float(self._robot.depth_m(self.raw_depth[v : v + 1, u : u + 1])[0, 0])
        return depth if np.isfinite(depth) else None

    def depth_m(self, box: PixelBox) -> Float32Array:
        """Depth along the optical axis at the colour pixels of a box, shape (bottom - top, right - left).

        The depth camera stands beside the colour camera, so each depth pixel of the neighbourhood is carried to
        the colour pixel where its point appears; where several arrive the nearest hides the others. NaN where
        none does: no data, an infrared shadow, or a crack between two carried pixels.
        """
        left, top, right, bottom = box
        camera = self.camera
        ox, oy, oz = self._robot.kinect.depth_offset_m
        # A point at depth z moves by f * offset / z pixels between the two images: at most so at the nearest depth.
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
