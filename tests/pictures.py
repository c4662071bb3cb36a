"""A small world to render, for the tests of the renderers."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest

from cocoro.arrays import FloatArray
from cocoro.errors import ConfigError
from cocoro.robot import Camera, Robot
from sim.camera import moved
from sim.render import Images, Renderer, make_renderer
from sim.render.interface import Visual

ROBOT = Robot.load()
CAMERA = ROBOT.camera.scaled(320, 240)


@dataclass(frozen=True)
class Lamp:
    ambient: float = 0.55
    diffuse: float = 0.45
    direction: tuple[float, float, float] = (0.3, 0.2, -1.0)
    temperature_k: float = 6500.0


RED_CAN = Visual("red", "cylinder", (0.033, 0.12), (0.8, 0.04, 0.05))
BLUE_BOX = Visual("blue", "box", (0.2, 0.3, 0.25), (0.04, 0.14, 0.75))
GREEN_BALL = Visual("green", "sphere", (0.05,), (0.03, 0.55, 0.1))
VISUALS = [RED_CAN, BLUE_BOX, GREEN_BALL]
PLACES = [(1.5, 0.0, 0.06), (1.8, 0.4, 0.125), (1.2, -0.3, 0.05)]


def at(*position_m: float) -> FloatArray:
    pose = np.eye(4)
    pose[:3, 3] = position_m
    return pose


POSES = np.array([at(*place) for place in PLACES])


def head(tilt_rad: float = -0.45, pan_rad: float = 0.0) -> FloatArray:
    angles = dict.fromkeys(ROBOT.joints, 0.0) | {"neck_tilt": tilt_rad, "neck_pan": pan_rad}
    return ROBOT.chain("camera").pose(angles)


def look(
    renderer: Renderer,
    camera_pose: FloatArray | None = None,
    *,
    poses: FloatArray = POSES,
    light: Lamp | None = None,
    projector: bool = False,
) -> Images:
    """A frame, copied so that it survives the next one."""
    pose = head() if camera_pose is None else camera_pose
    images = renderer.render(
        poses,
        pose,
        moved(pose, np.array(ROBOT.eye.depth_offset_m)),
        light or Lamp(),
        moved(pose, np.array(ROBOT.eye.projector_offset_m)) if projector else None,
    )
    return Images(images.colour.copy(), images.depth_m.copy())


def gl_renderer(visuals: list[Visual], camera: Camera = CAMERA) -> Renderer:
    try:
        return make_renderer(visuals, camera, "moderngl")
    except ConfigError as error:
        pytest.skip(str(error))


@cache
def renderer_of(name: str) -> Renderer:
    """One renderer of each kind for all tests of the process."""
    return gl_renderer(VISUALS) if name == "moderngl" else make_renderer(VISUALS, CAMERA, "tiny")


def pixel_of(point_m: tuple[float, ...], camera_pose: FloatArray, camera: Camera = CAMERA) -> tuple[float, float]:
    x, y, z, _ = np.linalg.inv(camera_pose) @ [*point_m, 1.0]
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def reddish(colour: np.ndarray) -> np.ndarray:
    r, g, b = (colour[..., channel].astype(int) for channel in range(3))
    return np.logical_and(r > 2 * g + 20, r > 2 * b + 20)


def floor_depth(camera: Camera, camera_pose: FloatArray) -> FloatArray:
    """Depth of the floor (z = 0) in every pixel, (height, width), m, by the camera's `ray`."""
    across = np.array([camera.ray(u, 0) for u in range(camera.width)])
    down = np.array([camera.ray(0, v) for v in range(camera.height)])
    up = camera_pose[2, :3]
    slope = up[0] * across[None, :, 0] + up[1] * down[:, None, 1] + up[2]
    return np.where(slope < 0, -camera_pose[2, 3] / np.minimum(slope, -1e-9), np.inf)


def stripe(column: int) -> np.ndarray:
    """A black image with one bright column."""
    picture = np.zeros((CAMERA.height, CAMERA.width, 3), np.uint8)
    picture[:, column] = 252
    return picture


def profile(picture: np.ndarray) -> np.ndarray:
    """The red channel of the middle row."""
    return picture[CAMERA.height // 2, :, 0].astype(float)
