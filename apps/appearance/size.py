"""Measures a new object from its outline, its depth and the camera's direction."""

from __future__ import annotations

from math import acos, pi
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from apps.appearance.region import ObjectRegion
from cocoro.arrays import CodeArray, FloatArray
from cocoro.robot import Camera, Robot

ObjectShape = Literal["cylinder", "sphere", "box"]

MIN_DEPTH_SHARE = 0.3
"""Least share of the region's pixels that must have a depth."""
ROUND = 0.845
"""Share of its box that a region fills: a disc 0.785, an upright can 0.9 or more."""
ROUND_ASPECT = 0.85
"""Least ratio of a ball's width and height."""


class MeasuredSize(NamedTuple):
    shape: ObjectShape
    width_m: float
    height_m: float
    distance_m: float
    """Distance from the camera to the object's middle."""


def surface_depth_m(raw_depth: CodeArray, region: ObjectRegion, robot: Robot) -> float | None:
    """Depth of the visible surface along the colour camera's optical axis; None when too few pixels have a depth.

    `raw_depth` are codes, (height, width). The depth camera stands beside the colour camera, so each of its pixels is
    projected into the colour picture, where the nearest of several hides the others.
    """
    height, width = raw_depth.shape
    camera = robot.camera.scaled(width, height)
    ox, oy, oz = robot.eye.depth_offset_m
    depth = robot.depth_m(raw_depth)
    rows, columns = np.nonzero(np.isfinite(depth))
    z = depth[rows, columns].astype(np.float64)
    u = ((columns - camera.cx) * z + camera.fx * ox) / (z + oz) + camera.cx
    v = ((rows - camera.cy) * z + camera.fy * oy) / (z + oz) + camera.cy
    column, row = np.rint(u).astype(np.int64), np.rint(v).astype(np.int64)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    projected = np.full(width * height, np.inf)
    np.minimum.at(projected, row[inside] * width + column[inside], z[inside] + oz)
    own = projected.reshape(height, width)[region.mask > 0]
    own = own[np.isfinite(own)]
    if len(own) < MIN_DEPTH_SHARE * region.area_px:
        return None
    return float(np.median(own))


def guessed_shape(region: ObjectRegion, camera: Camera) -> ObjectShape:
    """A sphere when the outline is round, otherwise a cylinder; a box looks like one, so the person must state it."""
    left, top, right, bottom = region.box
    across, down = (right - left) / camera.fx, (bottom - top) / camera.fy
    fills = region.area_px / ((right - left) * (bottom - top))
    return "sphere" if fills < ROUND and min(across, down) / max(across, down) > ROUND_ASPECT else "cylinder"


def size_of(
    region: ObjectRegion, camera: Camera, depth_m: float, shape: ObjectShape, pose: FloatArray | None = None
) -> MeasuredSize:
    """Width and height of an upright object whose visible surface is at `depth_m` along the optical axis.

    The outline is that of the object's middle, one radius behind the surface. Seen from above at an angle e, a cylinder
    of height h and radius r has an outline of height h cos e + 2 r sin e (orthographic; derived). `pose`, (4, 4), is
    camera frame (x right, y down, z forward) to body frame; without it the camera is assumed to look horizontally.
    """
    left, top, right, bottom = region.box
    middle = (left + right - 1) / 2, (top + bottom - 1) / 2
    ray = camera.ray(*middle)
    stretch = float(np.linalg.norm(ray))
    across = _width_px(region, shape) / camera.fx / stretch
    down = _angle(camera.ray(middle[0], top - 0.5), camera.ray(middle[0], bottom - 0.5))
    surface_m = depth_m * stretch
    if shape == "sphere":
        angle = 2 * np.sqrt(region.area_px / (pi * camera.fx * camera.fy)) / stretch**1.5
        radius_m = surface_m * np.sin(angle / 2) / (1 - np.sin(angle / 2))
        return MeasuredSize(shape, 2 * radius_m, 2 * radius_m, surface_m + radius_m)
    radius_m = surface_m * across / 2 / (1 - across / 2)
    distance_m = surface_m + radius_m
    sine = 0.0
    if pose is not None:
        direction = pose[:3, :3] @ ray / stretch
        sine = float(np.clip(-direction[2], 0.0, 0.95))
    height_m = (down * distance_m - 2 * radius_m * sine) / np.sqrt(1 - sine**2)
    return MeasuredSize(shape, 2 * float(radius_m), max(float(height_m), 0.01), float(distance_m))


def _width_px(region: ObjectRegion, shape: ObjectShape) -> float:
    """Width of an upright object in pixels: the median over the rows of its middle half."""
    left, top, right, bottom = region.box
    quarter = (bottom - top) // 4
    rows = region.mask[top + quarter : bottom - quarter or bottom, left:right]
    widths = np.count_nonzero(rows, axis=1)
    return float(np.median(widths)) if shape != "sphere" and len(widths) else float(right - left)


def _angle(a: FloatArray, b: FloatArray) -> float:
    return acos(min(max(float(a @ b / np.linalg.norm(a) / np.linalg.norm(b)), -1.0), 1.0))


def outline_of(region: ObjectRegion) -> list[NDArray[np.int32]]:
    """The region's outlines in OpenCV's form, (n, 1, 2) pixels each."""
    outlines, _ = cv2.findContours(region.mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return [np.asarray(outline, dtype=np.int32) for outline in outlines]
