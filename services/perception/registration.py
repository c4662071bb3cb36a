"""Moves a depth image's pixels to the colour pixels that show the same points ("registration").

The depth camera is beside the colour camera, so a depth pixel moves by an amount that depends on its depth. Where
several pixels meet, the nearest counts.
"""

from __future__ import annotations

from functools import lru_cache
from math import ceil, floor

import cv2
import numpy as np

from cocoro.arrays import CodeArray, Float32Array, IntArray
from cocoro.robot import Camera, Robot
from cocoro.units import Vec3
from services.perception.runs import spread_out

PixelBox = tuple[int, int, int, int]
"""left, top, right, bottom, px; right and bottom are exclusive."""
_ROWS = 48
CODES = 65536
"""Number of codes of two bytes."""


@lru_cache(maxsize=8)
def registration(robot: Robot, width: int, height: int) -> Registration:
    """The registration of a robot's frames of `width` x `height` pixels."""
    return Registration(robot, width, height, robot.eye.depth_offset_m)


class Registration:
    """Registers parts of depth images of one size."""

    def __init__(self, robot: Robot, width: int, height: int, offset_m: Vec3) -> None:
        """For a robot's frames of `width` x `height` pixels; `offset_m` is the depth camera's place in the colour
        camera's frame."""
        self._camera: Camera = robot.camera.scaled(width, height)
        self._offset_m = offset_m
        self._nearest_m = max(robot.eye.min_range_m, 0.1)
        self._none = robot.eye.no_depth_code
        self._depth: Float32Array = robot.depth_m(np.arange(CODES, dtype=np.uint16))
        self.table: Float32Array = self._depth + np.float32(self._offset_m[2])
        """Depth in the colour camera's frame of each code, m, shape (65536,); NaN without data."""
        ox, oy, oz = self._offset_m
        self._sideways = oy == 0.0 and oz == 0.0
        known = np.isfinite(self._depth)
        self.no_data = int(np.count_nonzero(known))
        """The least code that stands for no data; so do all greater ones."""
        shift_px = self._camera.fx * ox / np.where(known, self._depth, np.inf)
        shift: IntArray = np.rint(shift_px).astype(np.int64)
        self._most_px = int(np.abs(shift).max())
        self._shift_table = shift.view(np.float64)
        """How far each code's pixels move, px, as integers that OpenCV, whose tables hold none of 64 bits, copies."""

    def depth_m(self, codes: CodeArray) -> Float32Array:
        """Depth of registered codes, m, in their shape; NaN without data."""
        return self.table.take(codes)

    def codes(self, raw_depth: CodeArray, box: PixelBox) -> CodeArray:
        """The depth codes at the colour pixels of a box, shape (bottom - top, right - left): of the point that the
        colour pixel shows; that of no data or more without data, in an infrared shadow, and in cracks between moved
        pixels. `raw_depth` is the depth camera's image, shape (height, width)."""
        return self._moved_sideways(raw_depth, box) if self._sideways else self.codes_generally(raw_depth, box)

    def _moved_sideways(self, raw_depth: CodeArray, box: PixelBox) -> CodeArray:
        """For cameras exactly side by side: pixels stay in their rows, and each code moves by an amount of its own.

        Nearer pixels move farther. So of pixels that meet, those that come from farther away are nearer: written last,
        they replace the others. Pixels without data stay in place, so that any other one replaces them.
        """
        left, top, right, bottom = box
        most = self._most_px
        to_left = self._offset_m[0] < 0
        first, last = (left, right + most) if to_left else (left - most, right)
        first, last = max(first, 0), min(last, self._camera.width)
        columns = np.arange(most, most + last - first)
        width = last - first + 2 * most
        out = np.full((bottom - top, width), self._none, dtype=np.uint16)
        step = 1 if to_left else -1
        # Some rows at a time, which stay in the processor's cache.
        start = columns[::step] + np.arange(0, min(_ROWS, bottom - top) * width, width)[:, None]
        for row in range(0, bottom - top, _ROWS):
            part = np.ascontiguousarray(raw_depth[top + row : min(top + row + _ROWS, bottom), first:last][:, ::step])
            place = np.asarray(cv2.LUT(part, self._shift_table)).view(np.int64)
            place += start[: len(part)]
            out[row : row + _ROWS].reshape(-1)[place] = part
        return out[:, most + left - first : most + right - first]

    def codes_in_boxes(self, raw_depth: CodeArray, boxes: IntArray) -> CodeArray:
        """`codes` for boxes (n, 4), in the shape of the image; beside them any codes. For some small
        boxes of a large image; all pixels cost less in one box."""
        if not self._sideways:
            out = np.full(raw_depth.shape, self._none, dtype=np.uint16)
            for left, top, right, bottom in boxes.tolist():
                box = left, top, right, bottom
                out[top:bottom, left:right] = self.codes_generally(raw_depth, box)
            return out
        # As for one box, row by row; of boxes that overlap, the last one has all that comes from farthest away.
        height, width = raw_depth.shape
        most, to_left = self._most_px, self._offset_m[0] < 0
        left, top, right, bottom = boxes[boxes[:, 2 if to_left else 0].argsort(kind="stable")].T
        rows = bottom - top
        first = left if to_left else np.maximum(left - most, 0)
        count = ((np.minimum(right + most, width) if to_left else right) - first).repeat(rows)
        row = spread_out(top, rows)
        pixels = spread_out(row * width + first.repeat(rows), count)
        beyond = (row * most + (most if to_left else 0)).repeat(count)  # each row has room beyond the image's edge
        if not to_left:
            pixels, beyond = pixels[::-1], beyond[::-1]
        codes = raw_depth.reshape(-1).take(pixels)
        place = np.asarray(cv2.LUT(codes, self._shift_table)).reshape(-1).view(np.int64)
        place += pixels
        place += beyond
        wide = np.full((height, width + most), self._none, dtype=np.uint16)
        wide.reshape(-1)[place] = codes
        return np.ascontiguousarray(wide[:, most:] if to_left else wide[:, :width])

    def codes_generally(self, raw_depth: CodeArray, box: PixelBox) -> CodeArray:
        """`codes` for any offset between the cameras; takes several times as long."""
        left, top, right, bottom = box
        camera = self._camera
        ox, oy, oz = self._offset_m
        # A point at depth z moves by f * offset / z pixels between the two images, and farthest at the nearest depth.
        shift_u, shift_v = camera.fx * ox / self._nearest_m, camera.fy * oy / self._nearest_m
        spare = ceil(abs(oz) / self._nearest_m * camera.width) + 1
        source_left = max(left + floor(min(-shift_u, 0)) - spare, 0)
        source_top = max(top + floor(min(-shift_v, 0)) - spare, 0)
        raw = raw_depth[
            source_top : bottom + ceil(max(-shift_v, 0)) + spare, source_left : right + ceil(max(-shift_u, 0)) + spare
        ]
        codes = np.minimum(raw, self._none)
        z = self._depth.take(codes)
        rows, columns = np.nonzero(np.isfinite(z))
        z, codes = z[rows, columns], codes[rows, columns]
        z_colour = z + np.float32(oz)
        u = ((columns + np.float32(source_left - camera.cx)) * z + np.float32(camera.fx * ox)) / z_colour
        v = ((rows + np.float32(source_top - camera.cy)) * z + np.float32(camera.fy * oy)) / z_colour
        column = np.rint(u + np.float32(camera.cx - left)).astype(np.int64)
        row = np.rint(v + np.float32(camera.cy - top)).astype(np.int64)
        width, height = right - left, bottom - top
        inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
        out = np.full(width * height, self._none, dtype=np.uint16)
        np.minimum.at(out, row[inside] * width + column[inside], codes[inside])
        return out.reshape(height, width)
