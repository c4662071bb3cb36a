"""A room of boxes on a floor, as the depth camera sees it and as perception reports it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cocoro.arrays import FloatArray
from cocoro.clock import NS
from cocoro.frames import Pose2
from cocoro.messages import Obstacles
from cocoro.robot import Robot
from services.perception.config import PerceptionConfig
from services.perception.floor import FloorScanner
from services.perception.image import RgbdImage
from services.planning.config import HeadConfig, SearchConfig
from services.planning.floor_map import FloorMap, Solid
from services.planning.gaze import gaze_of
from services.planning.seen_floor import SeenFloor
from services.planning.seen_through import DepthView

ROBOT = Robot.load()
WIDTH, HEIGHT = 160, 120
RATE_HZ = 10
Box = tuple[tuple[float, float, float], tuple[float, float, float]]
"""Its lowest and its highest corner, odometry frame, m."""


def box(x: float, y: float, width: float, bottom: float, top: float, depth: float = 0.1) -> Box:
    """A box whose front is at `x`."""
    return (x, y - width / 2, bottom), (x + depth, y + width / 2, top)


@dataclass
class Room:
    """Looks at the room ten times a second and enters what it sees in a floor map."""

    boxes: list[Box]
    noise: float = 0.0
    """Standard deviation of the depth at 1 m, m; it grows with the square."""

    def __post_init__(self) -> None:
        self.floor = FloorMap()
        self.doubt_m = 0.0
        self.seen = SeenFloor(SearchConfig(), ROBOT, gaze_of(ROBOT, HeadConfig()))
        self.now_ns = NS
        self._scanner = FloorScanner(ROBOT, PerceptionConfig())
        self._draws = np.random.default_rng(1)
        camera = ROBOT.camera.scaled(WIDTH, HEIGHT)
        v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
        self._rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)

    def look(
        self,
        seconds: float,
        pan: float = 0.0,
        tilt: float = -0.4,
        body: Pose2 = Pose2(),  # noqa: B008 - immutable
        known: Sequence[Solid] = (),
        turning_radps: float = 0.0,
    ) -> None:
        angles = dict.fromkeys(ROBOT.joints, 0.0) | {"neck_pan": pan, "neck_tilt": tilt}
        pose = ROBOT.chain("camera").pose(angles)
        depth = np.minimum(self._depth(pose, body), 9.0)
        for _ in range(round(seconds * RATE_HZ)):
            self.now_ns += NS // RATE_HZ
            seen = self._obstacles(depth, pose)
            self.floor.enter(seen, body, None, known, DepthView(ROBOT, seen.nearest, angles))
            self.seen.enter(seen, body, turning_radps, self.doubt_m)

    def occupied(self, near: tuple[float, float], within_m: float = 0.25) -> int:
        """The number of occupied cells near a place."""
        cells = np.argwhere(self.floor.occupied())
        centres = np.array([self.floor.centre(row, column) for row, column in cells]).reshape(-1, 2)
        return int((np.hypot(centres[:, 0] - near[0], centres[:, 1] - near[1]) <= within_m).sum())

    def _obstacles(self, depth: FloatArray, pose: FloatArray) -> Obstacles:
        if self.noise:
            depth = depth + self._draws.normal(size=depth.shape) * self.noise * depth**2
        raw = ROBOT.depth_code(depth)
        image = RgbdImage(np.zeros((HEIGHT, WIDTH, 3), np.uint8), raw, ROBOT)
        grid = self._scanner.sample(image)
        assert grid is not None
        seen = self._scanner.scan(grid, WIDTH, HEIGHT, pose)
        seen.stamp_ns, seen.nearest = self.now_ns, self._scanner.nearest(image)
        return seen

    def _depth(self, pose: FloatArray, body: Pose2) -> FloatArray:
        c, s = np.cos(body.yaw_rad), np.sin(body.yaw_rad)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        origin = turn @ (pose[:3, 3] + pose[:3, :3] @ np.array(ROBOT.eye.depth_offset_m))
        origin = origin + np.array([body.x_m, body.y_m, 0.0])
        rays = self._rays @ (turn @ pose[:3, :3]).T
        with np.errstate(divide="ignore", invalid="ignore"):
            floor = -origin[2] / rays[..., 2]
            depth: FloatArray = np.where(floor > 0.0, floor, np.inf)
            for low, high in self.boxes:
                sides = np.sort(np.stack([(np.array(low) - origin) / rays, (np.array(high) - origin) / rays]), axis=0)
                enters, leaves = sides[0].max(axis=-1), sides[1].min(axis=-1)
                depth = np.where((enters < leaves) & (enters > 0.0), np.minimum(depth, enters), depth)
        return depth
