"""The errors of a real Kinect, each in one function or small class. Pictures are (height, width[, 3]) arrays."""

from __future__ import annotations

from math import log2, pi, sin
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from cocoro.arrays import CodeArray, Float32Array, FloatArray, ImageArray, median
from cocoro.robot import Camera, Robot

NO_DATA = 2047
"""A Kinect's code of no data."""
STEPS_PER_M = 16_000
"""Resolution of the coder's table: a twelfth of the smallest step of the depth codes (0.75 mm at 0.5 m)."""
EDGE_CODES = 8
"""Difference of neighbouring depth codes that makes an edge: 8 codes are 5 cm at 1.5 m. The floor seen from the
Kinect's height changes by less than 1 code per row at any distance, since both the codes and the rows of a plane are
linear in 1 / z."""
EDGE_MM = 50
"""The same in millimetres."""
EDGE_LOSS = 0.02
"""Share of edge pixels that have no data."""
MOST_STAGES = 6
"""Upper bound for the stages of the blur: 64 samples along a pixel's path. On longer paths the samples come apart."""


class DepthCoder:
    """Converts metres to raw 11-bit codes by a table of the robot's formula; the error is below a tenth of a code."""

    def __init__(self, robot: Robot) -> None:
        last = np.iinfo(np.uint16).max
        self._table = robot.depth_code(np.arange(last + 1) / STEPS_PER_M)
        self._top_m = np.float32(last / STEPS_PER_M)

    def codes(self, depth_m: Float32Array) -> CodeArray:
        """Codes (height, width) of depths, m; that of no data for depths out of range, infinity and negative metres."""
        steps = np.clip(depth_m, np.float32(0), self._top_m)
        steps *= np.float32(STEPS_PER_M)
        steps += np.float32(0.5)
        return self._table.take(steps.astype(np.uint16))


NOISE_OFFSETS = 1 << 18
"""Number of places in the noise bank where a frame's noise may begin. The bank is drawn once, since drawing 1.2 million
normals for every frame would cost more than rendering it."""


class DepthNoise:
    """Gaussian noise that grows with the square of the depth, as it does when disparity is measured."""

    def __init__(self, rng: np.random.Generator, shape: tuple[int, int], sigma_per_m: float) -> None:
        self._shape = shape
        self._size = shape[0] * shape[1]
        self._bank = np.float32(sigma_per_m) * rng.standard_normal(self._size + NOISE_OFFSETS, dtype=np.float32)

    def add(self, depth_m: Float32Array, rng: np.random.Generator) -> Float32Array:
        """Add sigma z^2 times a normal draw to each pixel (height, width), m; negative metres (no light) become 0."""
        start = int(rng.integers(NOISE_OFFSETS))
        noise = self._bank[start : start + self._size].reshape(self._shape)
        z = np.clip(depth_m, np.float32(0), np.float32(10))  # 10 m is out of range; infinity has no square
        return z + z * z * noise


class ByteNoise:
    """Rounded Gaussian noise on every byte of a picture; values saturate at 0 and 255."""

    def __init__(self, rng: np.random.Generator, pixels: int, sigma: float) -> None:
        self._size = 3 * pixels
        bank = np.rint(sigma * rng.standard_normal(self._size + NOISE_OFFSETS, dtype=np.float32))
        # Positive and negative parts are kept apart as bytes, for OpenCV's saturating addition and subtraction.
        self._more = np.maximum(bank, 0).astype(np.uint8)
        self._less = np.maximum(-bank, 0).astype(np.uint8)

    def add(self, image: ImageArray, rng: np.random.Generator) -> ImageArray:
        """Add noise to a picture (height, width, 3)."""
        start = int(rng.integers(NOISE_OFFSETS))
        more = self._more[start : start + self._size].reshape(image.shape)
        less = self._less[start : start + self._size].reshape(image.shape)
        return _bytes(cv2.subtract(cv2.add(image, more), less))


class Drift:
    """A value that varies smoothly within +-`size`: the sum of two sines with incommensurate periods. The slower one
    goes from one extreme to the other in `swing_s`. The phases are random."""

    def __init__(self, rng: np.random.Generator, size: float, swing_s: float) -> None:
        self._size = size
        self._period_s = 2 * swing_s
        self._phases = rng.uniform(0, 2 * pi, 2)

    def at(self, time_s: float) -> float:
        slow = sin(2 * pi * time_s / self._period_s + self._phases[0])
        fast = sin(2 * pi * time_s * 1.618 / self._period_s + self._phases[1])
        return self._size * (0.7 * slow + 0.3 * fast)


class CameraMotion(NamedTuple):
    """The camera's motion during the exposure, in its own frame."""

    rotation_rad: FloatArray
    """Rotation vector, (3,)."""
    translation_m: FloatArray

    def homography(self, share: float, plane_m: float, camera: Camera) -> FloatArray:
        """Homography (3, 3) from pixels `share` of the exposure later than its middle (-0.5 to 0.5) to pixels at the
        middle. Exact for a plane that faces the camera at `plane_m`."""
        move = _rodrigues(share * self.rotation_rad)
        move[:, 2] += share * self.translation_m / plane_m
        k = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        pixels: FloatArray = k @ move @ np.linalg.inv(k)
        return pixels


def motion_between(before: FloatArray, now: FloatArray, exposures: float) -> CameraMotion:
    """The motion during an exposure, from the camera's poses (4, 4) at the previous frame and at this one.

    `exposures` is the length of the exposure as a share of the time between the two frames.
    """
    step = before[:3, :3].T @ now[:3, :3]
    shift = before[:3, :3].T @ (now[:3, 3] - before[:3, 3])
    return CameraMotion(exposures * _rodrigues(step).reshape(3), exposures * shift)


def blur_along_motion(image: ImageArray, motion: CameraMotion, depth_m: Float32Array, camera: Camera) -> ImageArray:
    """Blur a picture (height, width, 3) by averaging it over the exposure along each pixel's path.

    `depth_m`: depth picture (height, width), m; negative and infinite values are allowed.

    The path is that of a plane facing the camera at the picture's median depth. That is exact for the camera's
    rotation, which makes nearly all of the blur, and good for its translation where things are near that depth. Objects
    that move by themselves are not blurred.

    The mean of n samples along the path takes log2(n) stages: each averages the picture with a copy of itself that is
    moved twice as far as in the stage before.
    """
    plane_m = _median_depth(depth_m)

    def at(share: float) -> FloatArray:
        return motion.homography(share, plane_m, camera)

    length_px = _longest_path(at(-0.5), at(0.5), camera)
    if length_px < 1.0:
        return image
    stages = min(max(round(log2(length_px)), 1), MOST_STAGES)
    samples = 2**stages
    for stage in range(stages - 1):
        image = _mean(image, _warped(image, at(2**stage / samples)))
    # The mean now covers half of the path, starting at 0; two copies placed about the middle cover all of it.
    first = -(samples - 1) / (2 * samples)
    return _mean(_warped(image, at(first)), _warped(image, at(first + 0.5)))


def drop_edges(codes: CodeArray, rng: np.random.Generator, no_data: int = NO_DATA, edge: int = EDGE_CODES) -> CodeArray:
    """Remove the data of 2 percent of the pixels (height, width) at depth edges (next to a much nearer or farther
    pixel, or to one without data). Changes and returns its argument. `edge`: difference of neighbouring codes that
    makes one."""
    spread = cv2.morphologyEx(codes, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    edges = np.flatnonzero(spread > edge)
    codes.reshape(-1)[edges[rng.random(edges.size) < EDGE_LOSS]] = no_data
    return codes


def scale_channels(image: ImageArray, gains: FloatArray) -> ImageArray:
    """Multiply each channel of a picture (height, width, 3) by its gain (3,); rounds and saturates."""
    return _bytes(cv2.transform(image, np.diag(gains)))


def _rodrigues(rotation: FloatArray) -> FloatArray:
    """Convert a rotation vector (3,) to its matrix (3, 3), or a matrix to its vector (3, 1)."""
    return np.asarray(cv2.Rodrigues(rotation)[0], np.float64)


def _bytes(image: NDArray[Any]) -> ImageArray:
    """Cast: OpenCV's type hints do not say that these functions keep the element type."""
    return cast(ImageArray, image)


def _mean(one: ImageArray, other: ImageArray) -> ImageArray:
    return _bytes(cv2.addWeighted(one, 0.5, other, 0.5, 0))


def _warped(image: ImageArray, homography: FloatArray) -> ImageArray:
    """Warp a picture by a homography (3, 3) with the nearest pixel; the margin repeats the border.

    Interpolation would triple the time for a mean that is smooth anyway: compared with pictures rendered at 64 moments
    of the exposure the error is 0.5 of 255 without and 0.4 with interpolation, and 2.3 without any blur.
    """
    size, flags = (image.shape[1], image.shape[0]), cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return _bytes(cv2.warpPerspective(image, homography, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def _longest_path(first: FloatArray, last: FloatArray, camera: Camera) -> float:
    """Largest distance (pixels) between where two homographies put the picture's centre and corners."""
    w, h = camera.width - 1.0, camera.height - 1.0
    points = np.array([[w / 2, h / 2, 1], [0, 0, 1], [w, 0, 1], [0, h, 1], [w, h, 1]]).T
    a, b = first @ points, last @ points
    return float(np.linalg.norm(a[:2] / a[2] - b[:2] / b[2], axis=0).max())


def _median_depth(depth_m: Float32Array) -> float:
    """Median depth of a coarse grid of pixels, clipped to 0.3 to 100 m."""
    grid = np.abs(depth_m[::16, ::16])
    return float(np.clip(np.float32(median(grid)), 0.3, 100.0))
