"""Frames for perception's tests: painted ones, which need no renderer, and rendered ones with their truth."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import atan2, hypot

import numpy as np

from cocoro.core import Sample
from cocoro.messages import Detection, Detections, Frame, ServoState
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.topics import ARM_STATE, FRAME
from services.perception.config import PerceptionConfig
from services.perception.core import PerceptionCore
from sim.camera import SimKinect
from sim.kinds import Sensors
from sim.render import make_renderer
from sim.render.interface import Visual
from sim.scene import Light

ROBOT = Robot.load()
CATALOGUE = Catalogue.load()
HEAD = ("neck_pan", "neck_tilt")
MS = 1_000_000
STAMP_NS = 10_000 * MS
CAMERA_HEIGHT_M = 0.70


class Canvas:
    """A painted frame: flat rectangles that face the camera, before a grey wall."""

    def __init__(self, width: int = 640, height: int = 480, wall_m: float | None = 3.0) -> None:
        self.camera = ROBOT.camera.scaled(width, height)
        self.colour = np.full((height, width, 3), 128, dtype=np.uint8)
        self.depth_m = np.full((height, width), np.inf if wall_m is None else wall_m)

    def rectangle(
        self,
        label: str,
        centre_px: tuple[float, float],
        depth_m: float | None,
        size_m: tuple[float, float] | None = None,
        seen_at_m: float | None = None,
    ) -> None:
        """Paint an object's colour, as large as its outline at that depth; without depth, as at `seen_at_m`. In the
        depth image it is shifted by the offset between the cameras."""
        known = CATALOGUE[label]
        apparent_m = depth_m if seen_at_m is None else seen_at_m
        assert apparent_m is not None
        width_m, height_m = size_m or (known.size_m[0], known.size_m[2])
        half = self.camera.fx * width_m / apparent_m / 2, self.camera.fy * height_m / apparent_m / 2
        left, right = round(centre_px[0] - half[0]), round(centre_px[0] + half[0])
        top, bottom = max(round(centre_px[1] - half[1]), 0), round(centre_px[1] + half[1])
        self.colour[top:bottom, max(left, 0) : right] = np.round(255 * np.array(known.rgb) * 0.8)
        shift = round(-self.camera.fx * ROBOT.eye.depth_offset_m[0] / apparent_m)
        depth = np.nan if depth_m is None else depth_m
        self.depth_m[top:bottom, max(left + shift, 0) : max(right + shift, 0)] = depth

    def frame(self, stamp_ns: int = STAMP_NS, **more: int) -> Frame:
        height, width = self.depth_m.shape
        codes = ROBOT.depth_code(np.nan_to_num(self.depth_m, nan=0.0, posinf=99.0))
        return Frame(
            stamp_ns=stamp_ns,
            width=width,
            height=height,
            colour=self.colour.copy().reshape(-1).data,
            depth=codes.astype("<u2").reshape(-1).view(np.uint8).data,
            **more,
        )


@dataclass
class Thing:
    """One visual of a rendered scene. Known objects have their label's shape and colour."""

    name: str
    shape: str
    size_m: tuple[float, ...]
    rgb: tuple[float, float, float]
    position_m: tuple[float, float, float]


def known(label: str, x: float, y: float, z: float | None = None) -> Thing:
    """A known object that stands on the floor, or has its centre at z."""
    row = CATALOGUE[label]
    assert row.radius_m is not None
    size = (row.radius_m,) if row.height_m is None else (row.radius_m, row.height_m)
    return Thing(label, row.shape, size, row.rgb, (x, y, row.size_m[2] / 2 if z is None else z))


def block(x: float, y: float, z: float, size_m: tuple[float, float, float], rgb: tuple[float, float, float]) -> Thing:
    return Thing("block", "box", size_m, rgb, (x, y, z))


def facing(thing: Thing) -> tuple[float, float]:
    """Pan and tilt that bring a thing near the image's centre, rad."""
    x, y, z = thing.position_m
    return atan2(y, x), -atan2(CAMERA_HEIGHT_M - z, hypot(x, y))


@dataclass
class Scene:
    """A rendered scene, seen from the robot's head."""

    things: list[Thing]
    sensors: Sensors = "ideal"
    seed: int = 0
    width: int = 640
    height: int = 480
    light: Light = field(default_factory=Light)

    def __post_init__(self) -> None:
        visuals = [Visual(t.name, t.shape, t.size_m, t.rgb) for t in self.things]  # type: ignore[arg-type]
        self._renderer = make_renderer(visuals, ROBOT.camera.scaled(self.width, self.height))
        self._kinect = SimKinect(
            ROBOT, self._renderer, sensors=self.sensors, seed=self.seed, width=self.width, height=self.height
        )
        self._chain = ROBOT.chain("camera")
        self._poses = np.tile(np.eye(4), (len(self.things), 1, 1))
        self._poses[:, :3, 3] = [thing.position_m for thing in self.things]

    def __enter__(self) -> Scene:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def frame(self, pan: float, tilt: float, stamp_ns: int = STAMP_NS) -> Frame:
        pose = self._chain.pose({"neck_pan": pan, "neck_tilt": tilt})
        return self._kinect.capture(self._poses, pose, stamp_ns, self.light)


def perception(**config: object) -> PerceptionCore:
    return PerceptionCore(ROBOT, PerceptionConfig(**config), CATALOGUE)  # type: ignore[arg-type]


def head_at(stamp_ns: int, pan: float = 0.0, tilt: float = 0.0, incarnation: int = 0) -> Sample:
    """The arm network's state, with the joints in another order than the neck's."""
    state = ServoState(
        stamp_ns=stamp_ns,
        incarnation=incarnation,
        joints=("elbow", "neck_tilt", "neck_pan"),
        position_rad=(1.0, tilt, pan),
        speed_radps=(0.0,) * 3,
        load=(0.0,) * 3,
    )
    return Sample(ARM_STATE, state)


def seen(frame: Frame, pan: float = 0.0, tilt: float = 0.0, **config: object) -> Detections:
    """Perception's detections in one frame, with the head still."""
    around = [head_at(frame.stamp_ns + offset * MS, pan, tilt) for offset in (-10, 10)]
    outputs = perception(**config).step([*around, Sample(FRAME, frame)], frame.stamp_ns + 20 * MS)
    message = outputs[0].message
    assert isinstance(message, Detections)
    return message


def the(label: str, detections: Detections) -> Detection:
    """The one detection of a label."""
    found = [detection for detection in detections.detections if detection.label == label]
    assert len(found) == 1, f"{label}: {[d.label for d in detections.detections]}"
    return found[0]


def error_mm(detection: Detection, thing: Thing) -> tuple[float, float]:
    """Horizontal and vertical error of the position, mm."""
    assert detection.position_m is not None, detection.note
    dx, dy, dz = (1e3 * (a - b) for a, b in zip(detection.position_m, thing.position_m, strict=True))
    return hypot(dx, dy), abs(dz)
