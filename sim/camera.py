"""The simulated Kinect: from a perfect look at the world to what the sensor would have delivered.

`ideal` quantises and nothing else. `real` adds what a rendered picture lacks; each effect is one function here
or in `sensor_effects`, its strength a constant with its source. Every draw depends on the run's seed and the
frame's stamp alone, so a frame does not depend on how many were taken before it (but for the motion blur,
which needs the pose of the frame before).
"""

from __future__ import annotations

import numpy as np

from cocoro.arrays import CodeArray, Float32Array, FloatArray, ImageArray
from cocoro.errors import ConfigError
from cocoro.messages import Frame
from cocoro.robot import Robot
from sim.realism import Sensors
from sim.render import Lighting, Renderer
from sim.seeds import stream
from sim.sensor_effects import (
    ByteNoise,
    DepthCoder,
    DepthNoise,
    Drift,
    blur_along_motion,
    drop_edges,
    motion_between,
    scale_channels,
)

EXPOSURE_S = 1 / 30
"""The Kinect's colour camera exposes for the whole of its frame period in a room's light."""
MAX_FRAME_GAP_S = 0.5
"""Two poses further apart than this say nothing about the motion while the shutter was open."""
COLOUR_SIGMA = 4.0
"""Of 255, a pixel and channel. Decided for the simulated robot."""
DEPTH_SIGMA_PER_M = 0.0015
"""Depth noise grows with z squared, as it must where disparity has constant noise (Khoshelham and Oude Elberink
2012 measured 0.00143 for this sensor)."""
EXPOSURE_DRIFT = 0.10
WHITE_BALANCE_DRIFT = 0.05
DRIFT_S = 5.0
"""From one extreme to the other."""


class SimKinect:
    """Takes frames of the world that a renderer draws.

    Args:
        robot: whose Kinect it is: range, depth curve, where depth camera and projector stand.
        renderer: made for `robot.camera.scaled(width, height)`.
        sensors: `ideal` for a perfect camera, `real` for this one's faults.
        seed: of the run; every random draw comes from it.

    Raises ConfigError when the renderer draws pictures of another size.
    """

    def __init__(
        self,
        robot: Robot,
        renderer: Renderer,
        *,
        sensors: Sensors = "ideal",
        seed: int = 0,
        width: int = 640,
        height: int = 480,
    ) -> None:
        camera = renderer.camera
        if (camera.width, camera.height) != (width, height):
            raise ConfigError(
                f"the renderer draws {camera.width} x {camera.height} pixels, the Kinect is to deliver"
                f" {width} x {height}: make it with robot.camera.scaled({width}, {height})"
            )
        self._renderer = renderer
        self._width, self._height = width, height
        self._real = sensors == "real"
        self._seed = seed
        self._depth_offset_m = np.array(robot.kinect.depth_offset_m)
        self._projector_offset_m = np.array(robot.kinect.projector_offset_m)
        self._coder = DepthCoder(robot)
        self._before: tuple[int, FloatArray] | None = None
        _keep_freed_memory()
        if self._real:
            rng = stream(seed, "kinect")
            self._colour_noise = ByteNoise(rng, width * height, COLOUR_SIGMA)
            self._depth_noise = DepthNoise(rng, (height, width), DEPTH_SIGMA_PER_M)
            self._exposure = Drift(rng, EXPOSURE_DRIFT, DRIFT_S)
            self._white_balance = Drift(rng, WHITE_BALANCE_DRIFT, DRIFT_S)

    def capture(self, poses: FloatArray, camera_pose: FloatArray, stamp_ns: int, light: Lighting) -> Frame:
        """The frame whose exposure has its middle at `stamp_ns`.

        Args:
            poses: of the visuals in the world, (n, 4, 4).
            camera_pose: of the colour camera's optical frame in the world, (4, 4).
        """
        images = self._renderer.render(
            poses,
            camera_pose,
            moved(camera_pose, self._depth_offset_m),
            light,
            moved(camera_pose, self._projector_offset_m) if self._real else None,
        )
        if self._real:
            rng = stream(self._seed, f"kinect frame {stamp_ns}")
            colour = self._expose(images.colour, images.depth_m, camera_pose, stamp_ns, rng)
            depth = self._measure(images.depth_m, rng)
        else:
            colour = images.colour.copy()
            depth = self._coder.codes(images.depth_m)
        self._before = (stamp_ns, camera_pose.copy())
        return Frame(
            stamp_ns=stamp_ns,
            width=self._width,
            height=self._height,
            colour=colour.reshape(-1).data,
            depth=depth.astype("<u2", copy=False).reshape(-1).view(np.uint8).data,
        )

    def _expose(
        self,
        colour: ImageArray,
        depth_m: Float32Array,
        camera_pose: FloatArray,
        stamp_ns: int,
        rng: np.random.Generator,
    ) -> ImageArray:
        """What the colour sensor makes of the light: smeared by the motion, scaled by exposure and white
        balance, with noise."""
        if self._before is not None:
            gap_s = (stamp_ns - self._before[0]) / 1e9
            if 0 < gap_s <= MAX_FRAME_GAP_S:
                motion = motion_between(self._before[1], camera_pose, EXPOSURE_S / gap_s)
                colour = blur_along_motion(colour, motion, depth_m, self._renderer.camera)
        time_s = stamp_ns / 1e9
        exposure, balance = 1 + self._exposure.at(time_s), self._white_balance.at(time_s)
        gains = np.array([exposure * (1 + balance), exposure, exposure * (1 - balance)])
        return self._colour_noise.add(scale_channels(colour, gains), rng)

    def _measure(self, depth_m: Float32Array, rng: np.random.Generator) -> CodeArray:
        """What the depth camera reports: noise before quantising; nothing out of range, in the projector's
        shadow (negative metres) and here and there on edges."""
        return drop_edges(self._coder.codes(self._depth_noise.add(depth_m, rng)), rng)


def moved(camera_pose: FloatArray, offset_m: FloatArray) -> FloatArray:
    """The pose of something that looks the same way as the camera from `offset_m` (3,) in its frame."""
    pose = camera_pose.copy()
    pose[:3, 3] += camera_pose[:3, :3] @ offset_m
    return pose


def _keep_freed_memory() -> None:
    """Have the C library keep what is freed for the next frame, instead of giving it back to the system and
    faulting in fresh pages 30 times a second, which would cost as much as the depth picture does. glibc raises its
    limit to the size of the largest block that was freed; elsewhere this does nothing."""
    largest = np.empty(31 * 1024 * 1024, np.uint8)
    del largest
