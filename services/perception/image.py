"""A frame as arrays, with depth as the colour camera sees it."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from math import sqrt
from typing import NamedTuple, Protocol

import numpy as np

from cocoro.arrays import CodeArray, Float32Array, ImageArray, IntArray
from cocoro.messages import Frame
from cocoro.robot import Camera, Robot
from services.perception.registration import PixelBox, Registration, registration

__all__ = ["Detector", "Evidence", "ImageSighting", "OwnEvidence", "PixelBox", "RgbdImage"]

_BOX_IS_WIDER_PX, _PIXEL_COSTS, _BOXES_COST_PX = 30, 2.3, 20000
"""Boxes are registered separately in the time of one box with so many times their pixels, each box so much wider, and
so many pixels more."""


class RgbdImage:
    """One frame: `colour` is RGB, uint8, shape (height, width, 3); `raw_depth` are the sensor's codes, uint16, shape
    (height, width). Both are views of the message."""

    def __init__(self, colour: ImageArray, raw_depth: CodeArray, robot: Robot) -> None:
        self.colour = colour
        self.raw_depth = raw_depth
        self.height, self.width = raw_depth.shape
        self._robot = robot
        self._registered: CodeArray = raw_depth
        self._registered_boxes: list[PixelBox] = []

    @classmethod
    def of(cls, frame: Frame, robot: Robot) -> RgbdImage:
        shape = frame.height, frame.width
        colour = np.frombuffer(frame.colour, dtype=np.uint8).reshape(*shape, 3)
        if not frame.has_depth:
            return cls(colour, np.full(shape, robot.eye.no_depth_code, dtype=np.uint16), robot)
        return cls(colour, np.frombuffer(frame.depth, dtype="<u2").reshape(shape), robot)

    @cached_property
    def camera(self) -> Camera:
        """The colour camera's parameters at this frame's resolution."""
        return self._robot.camera.scaled(self.width, self.height)

    @property
    def _registration(self) -> Registration:
        return registration(self._robot, self.width, self.height)

    @property
    def no_depth_code(self) -> int:
        """The least code of `codes_at` that stands for no data; so do all greater ones."""
        return self._registration.no_data

    @property
    def registered_depth_m(self) -> Float32Array:
        """Depth of each code of `codes_at`, m, shape (65536,); NaN for those without data."""
        return self._registration.table

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
        """Depth along the optical axis at the colour pixels of a box, m, shape (bottom - top, right - left); NaN
        without data, in an infrared shadow, and in cracks between moved pixels."""
        left, top, right, bottom = box
        for done in self._registered_boxes:
            if done[0] <= left and done[1] <= top and right <= done[2] and bottom <= done[3]:
                return self._registration.depth_m(self._registered[top:bottom, left:right])
        return self._registration.depth_m(self._registration.codes(self.raw_depth, box))

    def register(self, boxes: IntArray) -> None:
        """Compute the depth at the colour pixels of boxes, shape (n, 4), for `depth_m` and `codes_at`."""
        left, top = boxes[:, :2].min(axis=0).tolist()
        right, bottom = boxes[:, 2:].max(axis=0).tolist()
        separately = int(((boxes[:, 2] - boxes[:, 0] + _BOX_IS_WIDER_PX) * (boxes[:, 3] - boxes[:, 1])).sum())
        if _PIXEL_COSTS * separately + _BOXES_COST_PX < (right - left) * (bottom - top):
            self._registered = self._registration.codes_in_boxes(self.raw_depth, boxes)
            self._registered_boxes = [(a, b, c, d) for a, b, c, d in boxes.tolist()]
        else:
            self._registered = np.full(self.raw_depth.shape, self._robot.eye.no_depth_code, dtype=np.uint16)
            box = left, top, right, bottom
            self._registered[top:bottom, left:right] = self._registration.codes(self.raw_depth, box)
            self._registered_boxes = [box]

    def codes_at(self, at: IntArray) -> CodeArray:
        """Codes of the depth at colour pixels by their places in the flattened image; those of no data outside of
        registered boxes. Places before the first pixel and after the last one count as these."""
        codes: CodeArray = self._registered.reshape(-1).take(at, mode="clip")
        return codes


@dataclass(frozen=True)
class Evidence:
    """The extent of n objects by the depth image, in the colour camera's frame (x right, y down, z forward). Objects
    with less of it than others have fill, of certainty 0."""

    points_m: Float32Array
    """Points on the visible surfaces, m, shape (3, n, k)."""
    certainty: Float32Array
    """Inverse standard deviation of a point's distance from the surface, 1/m, shape (n, k)."""
    rays: Float32Array
    """Directions with z = 1, shape (3, n, m): of outermost pixels, whose rays meet the object, and of pixels just
    outside of its outline with known depth."""
    side: Float32Array
    """1 for rays that meet the object, -1 for those beside it, 0 for fill, shape (n, m)."""
    free_to_m: Float32Array
    """Depth to which rays beside it are known to be free, m, infinite for the others, shape (n, m)."""
    surface_count: IntArray
    """Number of points, shape (n,)."""
    count: IntArray
    """Number of points and rays, shape (n,)."""

    def of(self, objects: list[int]) -> Evidence:
        """The evidence of some of the objects."""
        if objects == list(range(len(self.count))):
            return self
        values = (getattr(self, field.name) for field in fields(self))
        return Evidence(*(value[:, objects] if value.ndim == 3 else value[objects] for value in values))


class OwnEvidence(NamedTuple):
    """The evidence of one object among those of a frame."""

    frame: Evidence
    number: int


class ImageSighting(NamedTuple):
    """A known object in the image."""

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
    evidence: OwnEvidence | None = None
    """None from a detector that uses the centroid alone."""


class Detector(Protocol):
    def detect(self, image: RgbdImage) -> list[ImageSighting]:
        """The known objects in the image, at most one per label, in the catalogue's order."""
