"""A rendered scene with up to 64 known objects of as many colours, all in view and none hidden.

The colours are chosen to be told apart under the exposure and white balance that the simulated Kinect drifts through,
by boxes in CIELAB as by boxes in HSV, so that every method that is compared can find every object.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cocoro.arrays import BoolArray, FloatArray, ImageArray
from cocoro.messages import Frame
from cocoro.objects import Catalogue, LabBox, ObjectSpec
from cocoro.robot import Robot
from services.perception.cielab import lab_of
from sim.camera import EXPOSURE_DRIFT, WHITE_BALANCE_DRIFT, SimKinect
from sim.render import make_renderer
from sim.render.interface import Visual
from sim.scene import Light

MOST = 64
PAN, TILT = 0.0, 0.1
PERIOD_NS = 33_333_333
_COLUMNS, _ROWS = 8, 8
_CAN = 0.033, 0.12
_BALL = (0.035,)
_GREY = 14
"""Least chroma: walls, floor and robot have less."""
_LIGHT = Light(ambient=1.0, diffuse=0.0, temperature_k=6500.0)
_MARGIN_LAB, _MARGIN_HSV = (2.0, 3.0, 3.0), (3.0, 14.0, 10.0)
"""For noise and for the width of a cell of the colour table."""


@dataclass(frozen=True)
class Bounds:
    """The colours of an object under all light of the scene, as a box in CIELAB and one in OpenCV's 8-bit HSV."""

    rgb: tuple[float, float, float]
    lab: FloatArray
    hsv: FloatArray
    """Least and greatest value of each channel, shape (2, 3)."""


@dataclass(frozen=True)
class Scene:
    """Frames of known objects, with the truth."""

    catalogue: Catalogue
    hsv: list[FloatArray]
    """Each object's box in HSV, shape (2, 3)."""
    places_m: FloatArray
    """The objects' centres in the body frame, shape (n, 3)."""
    frames: list[Frame]


def _bounds(rgb: tuple[float, float, float]) -> Bounds | None:
    """The colour's bounds; None where it is nearly grey, too dark, overexposed, or across the end of the hues."""
    gains = np.array(
        [
            (1 + exposure) * np.array([1 + white, 1.0, 1 - white])
            for exposure in np.linspace(-EXPOSURE_DRIFT, EXPOSURE_DRIFT, 5)
            for white in np.linspace(-WHITE_BALANCE_DRIFT, WHITE_BALANCE_DRIFT, 3)
        ]
    )
    seen = np.clip(np.rint(255 * np.array(rgb) * gains), 0, 255).astype(np.uint8)
    lab = lab_of(seen).astype(np.float64)
    hsv = np.asarray(cv2.cvtColor(seen[None], cv2.COLOR_RGB2HSV), dtype=np.float64)[0]
    if np.hypot(lab[:, 1], lab[:, 2]).min() < _GREY or lab[:, 0].min() < 15 or np.ptp(hsv[:, 0]) > 60:
        return None
    boxes = [
        np.stack([values.min(axis=0) - margin, values.max(axis=0) + margin])
        for values, margin in ((lab, _MARGIN_LAB), (hsv, _MARGIN_HSV))
    ]
    if boxes[1][0, 0] < 0 or boxes[1][1, 0] > 179:
        return None
    return Bounds(rgb, *boxes)


def colours(count: int) -> list[Bounds]:
    """So many colours of which no two have boxes that overlap, neither in CIELAB nor in HSV. Raises ValueError where
    there are not so many.

    Takes the colour that excludes the fewest others, again and again.
    """
    levels = np.linspace(0.08, 0.88, 12).tolist()
    every = [bounds for r in levels for g in levels for b in levels if (bounds := _bounds((r, g, b))) is not None]
    alike = _overlap(np.array([each.lab for each in every])) | _overlap(np.array([each.hsv for each in every]))
    left = np.ones(len(every), dtype=np.bool_)
    chosen: list[Bounds] = []
    while left.any() and len(chosen) < count:
        excluded = np.where(left, (alike & left).sum(axis=1), len(every) + 1)
        best = int(excluded.argmin())
        chosen.append(every[best])
        left &= ~alike[best]
    if len(chosen) < count:
        raise ValueError(f"{len(chosen)} colours that can be told apart, not {count}")
    return chosen


def _overlap(boxes: FloatArray) -> BoolArray:
    """Which of the boxes (n, 2, 3) have a common part; shape (n, n)."""
    common = (boxes[:, None, 0] <= boxes[:, 1]) & (boxes[:, 0] <= boxes[:, None, 1])
    every: BoolArray = np.all(common, axis=-1)
    return every


def known_objects(count: int) -> tuple[Catalogue, list[FloatArray]]:
    """So many known objects, cans and balls in turns, and each one's box in HSV, shape (2, 3)."""
    objects, hsv = [], []
    for number, bounds in enumerate(colours(MOST)[:count]):
        can = number % 2 == 0
        limits = np.array([(0.0, -128.0, -128.0), (100.0, 127.0, 127.0)])
        low, high = np.clip(bounds.lab, limits[0], limits[1]).tolist()
        objects.append(
            ObjectSpec(
                label=f"{'can' if can else 'ball'}_{number}",
                shape="cylinder" if can else "sphere",
                radius_m=_CAN[0] if can else _BALL[0],
                height_m=_CAN[1] if can else None,
                rgb=bounds.rgb,
                lab=(LabBox(tuple(low), tuple(high)),),
            )
        )
        hsv.append(bounds.hsv)
    return Catalogue(tuple(objects)), hsv


def scene(robot: Robot, count: int, frames: int, size: tuple[int, int] = (640, 480)) -> Scene:
    """A scene of `count` objects, at most `MOST`, in so many frames, each with noise of its own."""
    catalogue, hsv = known_objects(count)
    camera = robot.camera.scaled(*size)
    head = robot.camera_chain.pose({"neck_pan": PAN, "neck_tilt": TILT})
    draws = np.random.default_rng(4)
    cells = draws.permutation(_COLUMNS * _ROWS)[:count]
    poses, visuals = np.tile(np.eye(4), (count, 1, 1)), []
    for pose, cell, known in zip(poses, cells.tolist(), catalogue, strict=True):
        can = known.shape == "cylinder"
        depth_m = draws.uniform(1.6, 2.2) if can else draws.uniform(1.2, 1.8)
        u = (cell % _COLUMNS + 0.5) * size[0] / _COLUMNS
        v = (cell // _COLUMNS + 0.5) * size[1] / _ROWS
        pose[:3, 3] = head[:3, :3] @ (camera.ray(u, v) * depth_m) + head[:3, 3]
        visuals.append(Visual(known.label, known.shape, _CAN if can else _BALL, known.rgb))
    renderer = make_renderer(visuals, camera)
    with SimKinect(robot, renderer, sensors="real", seed=1, width=size[0], height=size[1]) as kinect:
        taken = [kinect.capture(poses, head, (number + 1) * PERIOD_NS, _LIGHT) for number in range(frames)]
    return Scene(catalogue, hsv, poses[:, :3, 3], taken)


def as_array(frame: Frame) -> ImageArray:
    """The frame's colours, RGB, shape (height, width, 3)."""
    return np.frombuffer(frame.colour, dtype=np.uint8).reshape(frame.height, frame.width, 3)
