"""Finds free floor by its colour, for a camera without depth.

The colour that most of the picture's lower edge has is the floor's: at the robot's start nothing else may stand there.
Later it follows slowly changing light, but a picture whose lower edge has another colour shows no floor at all. In each
column of a coarse grid the floor is free from the lower edge up to the first pixel of another colour: there something
stands, or lies, or throws a shadow, which no colour tells apart. Beyond it nothing is known. (Derived; floor by the
colour of a reference area: Ulrich and Nourbakhsh 2000.)

Where the robot sees its own parked arm nothing is known, and the floor is free from above that.
"""

from __future__ import annotations

import cv2
import numpy as np

from cocoro.arrays import BoolArray, Float32Array, FloatArray
from cocoro.messages import Obstacles, ServoState
from cocoro.robot import Robot
from services.perception.config import PerceptionConfig
from services.perception.floor import FloorScanner, told
from services.perception.image import RgbdImage
from services.perception.own_body import own_picture

STRIP = 0.25
"""Part of the picture's height, from its lower edge, whose colour is the floor's."""
LEAST_SHARE = 0.4
"""Least share of that strip that must have one colour."""
BIN_LAB = np.array([6.0, 5.0, 5.0])
CHROMA, LIGHTNESS = 7.0, 12.0
"""Greatest differences, CIELAB, from the floor's colour."""
FOLLOW = 0.1
"""Share by which the floor's colour follows that of one picture."""
STANDS_M = (0.03, 0.10)
"""Heights that are told of something that stands on the floor: its true height no colour shows."""
FOLDED_RAD = 0.1
"""An arm further than this from its parked pose may be in the picture: then no floor is told."""


class ColourFloorScanner(FloorScanner):
    """As `FloorScanner`, of pictures without depth."""

    def __init__(self, robot: Robot, config: PerceptionConfig) -> None:
        super().__init__(robot, config)
        self._parked = {name: angle for name, angle in robot.poses["park"].items() if name in robot.group_joints("arm")}
        self._folded = False
        self._colour: FloatArray | None = None
        """CIELAB, (3,); None before the first picture that shows floor."""
        self._own: dict[tuple[int, int], BoolArray] = {}
        """By the grid's size, the pixels that show the robot itself."""

    def watch(self, state: ServoState) -> None:
        angles = dict(zip(state.joints, state.position_rad, strict=True))
        if self._parked.keys() <= angles.keys():
            self._folded = all(abs(angles[name] - angle) <= FOLDED_RAD for name, angle in self._parked.items())

    def sample(self, image: RgbdImage) -> Float32Array | None:
        """Whether the pixels of the coarse grid have the floor's colour, 1 or 0, and NaN where the robot sees itself,
        shape (rows, columns); None while the floor's colour is not seen, or the arm is not parked."""
        if not self._folded:
            return None
        step = max(image.width // 80, 1)
        size = len(range(step // 2, image.width, step)), len(range(step // 2, image.height, step))
        small = np.asarray(cv2.resize(image.colour, size, interpolation=cv2.INTER_AREA), dtype=np.float32)
        lab = np.asarray(cv2.cvtColor(small / np.float32(255), cv2.COLOR_RGB2LAB), dtype=np.float64)
        own = self._own_picture(*size)
        strip = slice(-max(round(STRIP * len(lab)), 1), None)
        seen = _usual(lab[strip][~own[strip]])
        if seen is None or (self._colour is not None and not _alike(seen, self._colour)):
            return None
        self._colour = seen if self._colour is None else self._colour + FOLLOW * (seen - self._colour)
        alike = (_alike(lab, self._colour) | own).astype(np.uint8)
        return np.where(own, np.float32(np.nan), np.asarray(cv2.medianBlur(alike, 3), dtype=np.float32))

    def _own_picture(self, columns: int, rows: int) -> BoolArray:
        size = columns, rows
        if size not in self._own:
            camera, park = self._robot.camera.scaled(columns, rows), self._robot.poses["park"]
            self._own[size] = own_picture(self._robot, camera, park)
        return self._own[size]

    def nearest(self, image: RgbdImage) -> bytes:
        return b""

    def scan(self, depth_m: Float32Array, width: int, height: int, camera_pose: FloatArray) -> Obstacles:
        """As of `FloorScanner`, but `depth_m` is from this class's `sample`."""
        origin = camera_pose[:3, 3]
        rays = self._rays(depth_m.shape, width, height) @ camera_pose[:3, :3].T
        with np.errstate(divide="ignore", invalid="ignore"):
            places = rays * np.where(rays[..., 2] < 0.0, -origin[2] / rays[..., 2], np.inf)[..., None]
        away = np.hypot(places[..., 0], places[..., 1])
        reach_m = min(self._config.floor_range_m, self._robot.eye.max_range_m)
        other = depth_m < 0.5
        # From the lower edge up: floor until the first pixel of another colour.
        before = ~np.logical_or.accumulate(other[::-1], axis=0)[::-1]
        foot = other & np.roll(before, -1, axis=0)
        foot[-1] = other[-1]
        near = away <= reach_m
        floor, standing = places[before & near & np.isfinite(depth_m)], places[foot & near]
        points = np.concatenate([floor, *(standing + np.array([0.0, 0.0, height_m]) for height_m in STANDS_M)]) + origin
        flat = np.arange(len(points)) < len(floor)
        level = points[:, :2] - origin[:2]
        return told(points, level, flat, ~flat, origin)


def _usual(lab: FloatArray) -> FloatArray | None:
    """The colour that most pixels (n, 3) have; None where no colour has enough of them."""
    if not len(lab):
        return None
    bins, counts = np.unique(np.floor(lab / BIN_LAB), axis=0, return_counts=True)
    middle = (bins[counts.argmax()] + 0.5) * BIN_LAB
    own = lab[_alike(lab, middle)]
    return own.mean(axis=0) if len(own) > LEAST_SHARE * len(lab) else None


def _alike(lab: FloatArray, colour: FloatArray) -> BoolArray:
    """Whether colours (..., 3) are that one; shape (...)."""
    off = np.asarray(lab - colour)
    alike: BoolArray = (np.hypot(off[..., 1], off[..., 2]) <= CHROMA) & (np.abs(off[..., 0]) <= LIGHTNESS)
    return alike
