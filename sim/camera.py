"""The simulated Kinect, or another such camera: turns rendered images into what the sensor would deliver.

`ideal` sensors only quantise. `real` ones add the sensor's errors: each is one function here or in `sensor_effects`,
its strength a constant with its source. Random draws depend only on the run's seed and the frame's stamp, so a frame
does not depend on the number of frames before it. Motion blur is the exception: it needs the previous frame's pose.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from cocoro.arrays import Float32Array, FloatArray, ImageArray
from cocoro.errors import ConfigError
from cocoro.messages import Frame
from cocoro.robot import Robot
from sim.kinds import Sensors
from sim.memory import keep_freed_memory
from sim.render import Lighting, Renderer
from sim.seeds import stream
from sim.sensor_effects import (
    EDGE_CODES,
    EDGE_MM,
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
"""In indoor light the Kinect's colour camera exposes for its whole frame period."""
MAX_FRAME_GAP_S = 0.5
"""Two poses further apart in time than this do not tell the motion during the exposure."""
COLOUR_SIGMA = 4.0
"""Standard deviation of each pixel and channel, of 255. Chosen for the simulated robot."""
DEPTH_SIGMA_PER_M = 0.0015
"""Standard deviation of depth divided by z squared: constant noise of the disparity (Khoshelham and Oude Elberink 2012
measured 0.00143 for this sensor)."""
EXPOSURE_DRIFT = 0.10
WHITE_BALANCE_DRIFT = 0.05
DRIFT_S = 5.0
"""Time from one extreme to the other."""


class _Errors(NamedTuple):
    """What is drawn once for a sensor, from the run's seed; none of it changes."""

    colour_noise: ByteNoise
    depth_noise: DepthNoise
    exposure: Drift
    white_balance: Drift


@lru_cache(maxsize=3)
def _errors(seed: int, width: int, height: int) -> _Errors:
    """Kept for the next sensor with this seed and size, since to draw a million numbers takes as long as ten frames."""
    rng = stream(seed, "kinect")
    return _Errors(
        ByteNoise(rng, width * height, COLOUR_SIGMA),
        DepthNoise(rng, (height, width), DEPTH_SIGMA_PER_M),
        Drift(rng, EXPOSURE_DRIFT, DRIFT_S),
        Drift(rng, WHITE_BALANCE_DRIFT, DRIFT_S),
    )


class SimKinect:
    """Takes frames of the world that a renderer draws. A context manager, which closes the renderer.

    Args:
        robot: gives the Kinect's range and depth curve, and the places of its depth camera and projector.
        renderer: made for `robot.camera.scaled(width, height)`.
        sensors: `ideal` for a perfect camera, `real` for one with this sensor's errors.
        seed: seed of the run, from which every random draw comes.

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
        self._depth_offset_m = np.array(robot.eye.depth_offset_m)
        self._projector_offset_m = np.array(robot.eye.projector_offset_m)
        self._no_data = robot.eye.no_depth_code
        self._edge = EDGE_MM if robot.eye.depth == "mm" else EDGE_CODES
        self._coder = DepthCoder(robot) if robot.sees_depth else None
        self._before: tuple[int, FloatArray] | None = None
        keep_freed_memory()
        if self._real:
            self._errors = _errors(seed, width, height)

    def __enter__(self) -> SimKinect:
        return self

    def __exit__(self, *_: object) -> None:
        self._renderer.close()

    def expose(self, poses: FloatArray, camera_pose: FloatArray, stamp_ns: int, light: Lighting) -> Callable[[], Frame]:
        """Expose a frame as `capture` does; the function that is returned gives it when it is to be delivered."""
        frame = self.capture(poses, camera_pose, stamp_ns, light)
        return lambda: frame

    def capture(self, poses: FloatArray, camera_pose: FloatArray, stamp_ns: int, light: Lighting) -> Frame:
        """Take the frame whose exposure has its middle at `stamp_ns`.

        Args:
            poses: world poses of the visuals, (n, 4, 4).
            camera_pose: world pose of the colour camera's optical frame, (4, 4).
        """
        images = self._renderer.render(
            poses,
            camera_pose,
            moved(camera_pose, self._depth_offset_m),
            light,
            moved(camera_pose, self._projector_offset_m) if self._real else None,
        )
        rng = stream(self._seed, f"kinect frame {stamp_ns}") if self._real else None
        if rng is not None:
            colour = self._expose(images.colour, images.depth_m, camera_pose, stamp_ns, rng)
        else:
            colour = images.colour.copy()
        depth = self._depth(images.depth_m, rng)
        self._before = (stamp_ns, camera_pose.copy())
        return Frame(
            stamp_ns=stamp_ns,
            width=self._width,
            height=self._height,
            colour=colour.reshape(-1).data,
            depth=depth,
        )

    def _expose(
        self,
        colour: ImageArray,
        depth_m: Float32Array,
        camera_pose: FloatArray,
        stamp_ns: int,
        rng: np.random.Generator,
    ) -> ImageArray:
        """Apply the colour camera's errors: motion blur, exposure, white balance and noise. (height, width, 3), RGB."""
        if self._before is not None:
            gap_s = (stamp_ns - self._before[0]) / 1e9
            if 0 < gap_s <= MAX_FRAME_GAP_S:
                motion = motion_between(self._before[1], camera_pose, EXPOSURE_S / gap_s)
                colour = blur_along_motion(colour, motion, depth_m, self._renderer.camera)
        time_s = stamp_ns / 1e9
        exposure, balance = 1 + self._errors.exposure.at(time_s), self._errors.white_balance.at(time_s)
        gains = np.array([exposure * (1 + balance), exposure, exposure * (1 - balance)])
        return self._errors.colour_noise.add(scale_channels(colour, gains), rng)

    def _depth(self, depth_m: Float32Array, rng: np.random.Generator | None) -> memoryview:
        """The depth of a `Frame`, of depth (height, width), m: noise is added before quantising; there is no data out
        of range, in the projector's shadow (negative metres) and for some pixels on edges. Without `rng` it is only
        quantised."""
        if self._coder is None:
            return memoryview(b"")
        if rng is None:
            codes = self._coder.codes(depth_m)
        else:
            codes = self._coder.codes(self._errors.depth_noise.add(depth_m, rng))
            codes = drop_edges(codes, rng, self._no_data, self._edge)
        return codes.astype("<u2", copy=False).reshape(-1).view(np.uint8).data


def moved(camera_pose: FloatArray, offset_m: FloatArray) -> FloatArray:
    """Camera pose (4, 4), shifted by `offset_m` (3,) in the camera's frame."""
    pose = camera_pose.copy()
    pose[:3, 3] += camera_pose[:3, :3] @ offset_m
    return pose
