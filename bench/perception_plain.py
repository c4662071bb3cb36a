"""Other ways to find the same objects, for the bench: plain OpenCV, and the paper's method in NumPy."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from bench.perception_scene import PAN, TILT, Scene, as_array
from cocoro.arrays import FloatArray, MaskArray
from cocoro.messages import Frame
from cocoro.robot import Robot

_AROUND = np.ones((3, 3), dtype=np.uint8)
_TILES = 5
_THRESHOLD_PX = 64
"""The paper's: an object is present when its fullest tile has more matching pixels."""


@dataclass(frozen=True)
class Found:
    """An object that was found."""

    label: str
    u_px: float
    v_px: float
    position_m: FloatArray | None
    """Its centre in the body frame, shape (3,)."""


class PlainOpenCV:
    """What an engineer writes with OpenCV: blur and HSV once, then for each object its range, opening, components, the
    median of the depth in the box's middle, back-projection, and the radius inwards.

    With `crop` components are sought in the mask's bounding box instead of the whole image, which is several times as
    fast. Depth is looked up where the depth camera sees the object, beside its place in the colour image.
    """

    def __init__(self, robot: Robot, scene: Scene, *, crop: bool) -> None:
        self._scene = scene
        self._crop = crop
        self._camera = robot.camera.scaled(scene.frames[0].width, scene.frames[0].height)
        self._head = robot.camera_chain.pose({"neck_pan": PAN, "neck_tilt": TILT})
        self._table = robot.depth_m(np.arange(2048, dtype=np.uint16))
        self._shift_px_m = -self._camera.fx * robot.eye.depth_offset_m[0]
        limits = [np.clip(np.rint(box), 0, 255) for box in scene.hsv]
        self._ranges = [(tuple(box[0].tolist()), tuple(box[1].tolist())) for box in limits]

    def __call__(self, frame: Frame) -> list[Found]:
        hsv = cv2.cvtColor(cv2.blur(as_array(frame), (3, 3)), cv2.COLOR_RGB2HSV)
        raw = np.frombuffer(frame.depth, dtype="<u2").reshape(frame.height, frame.width)
        found = []
        for known, (low, high) in zip(self._scene.catalogue, self._ranges, strict=True):
            mask = np.asarray(cv2.morphologyEx(cv2.inRange(hsv, low, high), cv2.MORPH_OPEN, _AROUND), dtype=np.uint8)
            left, top = 0, 0
            if self._crop:
                left, top, width, height = cv2.boundingRect(mask)
                if not width:
                    continue
                mask = mask[top : top + height, left : left + width]
            count, _, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8, ltype=cv2.CV_32S)
            if count < 2:
                continue
            best = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
            if stats[best, cv2.CC_STAT_AREA] < 32:
                continue
            x, y, width, height = stats[best, :4].tolist()
            box = left + x, top + y, left + x + width, top + y + height
            u, v = left + float(centres[best, 0]), top + float(centres[best, 1])
            depth_m = self._depth_m(raw, box)
            place = None if depth_m is None else self._place(u, v, depth_m, known.planar_radius_m)
            found.append(Found(known.label, u, v, place))
        return found

    def _depth_m(self, raw: np.ndarray, box: tuple[int, int, int, int]) -> float | None:
        """The median depth of the box's middle, m: first seen at a middle distance, then where that depth is."""
        left, top, right, bottom = box
        across, down = (right - left) // 4, (bottom - top) // 4
        depth_m: float | None = 1.6
        for _ in range(2):
            if depth_m is None:
                return None
            shift = round(self._shift_px_m / depth_m)
            middle = raw[top + down : bottom - down, max(left + across + shift, 0) : max(right - across + shift, 0)]
            codes = np.sort(middle.reshape(-1))
            valid = int(np.searchsorted(codes, 2047))
            depth_m = float(self._table[codes[valid // 2]]) if valid else None
        return depth_m

    def _place(self, u: float, v: float, depth_m: float, radius_m: float) -> FloatArray:
        ray = self._head[:3, :3] @ self._camera.ray(u, v)
        inwards: FloatArray = ray * (depth_m + radius_m)
        return inwards + self._head[:3, 3]


class PaperNumpy:
    """The paper's method by its text ('Object identification'), in NumPy: CIELAB once, by OpenCV as the text says; then
    for each object the matching pixels, the fullest of 5 x 5 tiles, medians, and the depth at the centroid's pixel."""

    def __init__(self, robot: Robot, scene: Scene) -> None:
        self._scene = scene
        self._table = robot.depth_m(np.arange(2048, dtype=np.uint16))
        self._camera = robot.camera.scaled(scene.frames[0].width, scene.frames[0].height)
        self._head = robot.camera_chain.pose({"neck_pan": PAN, "neck_tilt": TILT})
        scale, offset = np.array([255 / 100, 1.0, 1.0]), np.array([0.0, 128.0, 128.0])
        self._ranges = [
            np.clip(np.rint(np.array([known.lab[0].low, known.lab[0].high]) * scale + offset), 0, 255).astype(np.uint8)
            for known in scene.catalogue
        ]

    def __call__(self, frame: Frame) -> list[Found]:
        lab = np.asarray(cv2.cvtColor(as_array(frame), cv2.COLOR_RGB2Lab), dtype=np.uint8)
        channels = [np.ascontiguousarray(lab[..., number]) for number in range(3)]
        raw = np.frombuffer(frame.depth, dtype="<u2").reshape(frame.height, frame.width)
        found = []
        for known, (low, high) in zip(self._scene.catalogue, self._ranges, strict=True):
            mask = np.ones(raw.shape, dtype=np.bool_)
            for channel, least, most in zip(channels, low, high, strict=True):
                mask &= (channel >= least) & (channel <= most)
            if _fullest_tile(mask.view(np.uint8)) <= _THRESHOLD_PX:
                continue
            rows, columns = np.nonzero(mask)
            u, v = float(np.median(columns)), float(np.median(rows))
            depth_m = float(self._table[min(int(raw[int(v), int(u)]), 2047)])
            place = None
            if np.isfinite(depth_m):
                ray = self._head[:3, :3] @ self._camera.ray(u, v)
                place = ray * (depth_m + known.planar_radius_m) + self._head[:3, 3]
            found.append(Found(known.label, u, v, place))
        return found


def _fullest_tile(mask: MaskArray) -> int:
    """Number of matching pixels in the fullest tile."""
    rows, columns = (np.linspace(0, size, _TILES + 1).astype(int).tolist() for size in mask.shape)
    return max(
        int(np.count_nonzero(mask[top:bottom, left:right]))
        for top, bottom in pairwise(rows)
        for left, right in pairwise(columns)
    )


def memory_pass(frame: Frame) -> int:
    """Read the frame's colours and depths once: no method that looks at every pixel is faster."""
    colour = np.frombuffer(frame.colour, dtype=np.uint64)
    depth = np.frombuffer(frame.depth, dtype=np.uint64)
    return int(np.bitwise_or.reduce(colour)) | int(np.bitwise_or.reduce(depth))
