"""The faults of a real Kinect, one function or small class each. Pixels in, pixels out."""

from __future__ import annotations

from math import log2, pi, sin
from typing import Any, NamedTuple, cast

import cv2
import numpy as np
from numpy.typing import NDArray

from cocoro.arrays import CodeArray, Float32Array, FloatArray, ImageArray
from cocoro.robot import Camera, Robot

NO_DATA = 2047
STEPS_PER_M = 16_000
"""Resolution of the coder's table: a twelfth of the finest depth code (0.75 mm at 0.5 m)."""
EDGE_CODES = 8
"""Depth codes between neighbours that make an edge. A plane seen from the Kinect's height changes by under 1 code
a row at any distance, since codes run with 1 / z as a plane's pixels do; 8 codes are 5 cm at 1.5 m."""
EDGE_LOSS = 0.02
"""Share of edge pixels without data."""
MOST_STAGES = 6
"""Of the blur, for 64 samples along the path of a pixel; on a path of more pixels they come apart."""


class DepthCoder:
    """Metres to raw 11-bit codes by a table of the robot's own formula: equal to it within a tenth of a code."""

    def __init__(self, robot: Robot) -> None:
        last = np.iinfo(np.uint16).max
        self._table = robot.depth_code(np.arange(last + 1) / STEPS_PER_M)
        self._top_m = np.float32(last / STEPS_PER_M)

    def codes(self, depth_m: Float32Array) -> CodeArray:
        """Codes of the same shape; 2047 out of range, for infinity and for negative metres."""
        steps = np.clip(depth_m, np.float32(0), self._top_m)
        steps *= np.float32(STEPS_PER_M)
        steps += np.float32(0.5)
        return self._table.take(steps.astype(np.uint16))


NOISE_OFFSETS = 1 << 18
"""Noise is drawn once, this much more than a frame of it, and each frame takes a window at a place of its own:
drawing 1.2 million normals for every frame would cost more than rendering it."""


class DepthNoise:
    """Gaussian noise that grows with the square of the distance, as it does where disparity is what is measured."""

    def __init__(self, rng: np.random.Generator, shape: tuple[int, int], sigma_per_m: float) -> None:
        self._shape = shape
        self._size = shape[0] * shape[1]
        self._bank = np.float32(sigma_per_m) * rng.standard_normal(self._size + NOISE_OFFSETS, dtype=np.float32)

    def add(self, depth_m: Float32Array, rng: np.random.Generator) -> Float32Array:
        """z + sigma z^2 times a normal draw a pixel; negative metres (no light there) become 0."""
        start = int(rng.integers(NOISE_OFFSETS))
        noise = self._bank[start : start + self._size].reshape(self._shape)
        z = np.clip(depth_m, np.float32(0), np.float32(10))  # beyond any range; infinity has no square
        return z + z * z * noise


class ByteNoise:
    """Gaussian noise on every byte of a picture, rounded; bytes stop at 0 and 255, as a sensor saturates."""

    def __init__(self, rng: np.random.Generator, pixels: int, sigma: float) -> None:
        self._size = 3 * pixels
        bank = np.rint(sigma * rng.standard_normal(self._size + NOISE_OFFSETS, dtype=np.float32))
        # Apart, what is added and what is taken away fit in bytes, and OpenCV's saturating sums do the rest.
        self._more = np.maximum(bank, 0).astype(np.uint8)
        self._less = np.maximum(-bank, 0).astype(np.uint8)

    def add(self, image: ImageArray, rng: np.random.Generator) -> ImageArray:
        start = int(rng.integers(NOISE_OFFSETS))
        more = self._more[start : start + self._size].reshape(image.shape)
        less = self._less[start : start + self._size].reshape(image.shape)
        return _bytes(cv2.subtract(cv2.add(image, more), less))


class Drift:
    """A value that wanders smoothly within +-`size`: two sines whose periods have no common multiple near, the
    slower one going from end to end in `swing_s`; phases drawn from the run's seed."""

    def __init__(self, rng: np.random.Generator, size: float, swing_s: float) -> None:
        self._size = size
        self._period_s = 2 * swing_s
        self._phases = rng.uniform(0, 2 * pi, 2)

    def at(self, time_s: float) -> float:
        slow = sin(2 * pi * time_s / self._period_s + self._phases[0])
        fast = sin(2 * pi * time_s * 1.618 / self._period_s + self._phases[1])
        return self._size * (0.7 * slow + 0.3 * fast)


class CameraMotion(NamedTuple):
    """How the camera moves while the shutter is open, in its own frame."""

    rotation_rad: FloatArray
    """Rotation vector, (3,)."""
    translation_m: FloatArray

    def homography(self, share: float, plane_m: float, camera: Camera) -> FloatArray:
        """Where in the picture at mid-exposure the pixels are that the camera sees `share` of the exposure later
        (-0.5 to 0.5): 3 x 3, on pixel coordinates. Exact for a plane that faces the camera at `plane_m`."""
        move = _rodrigues(share * self.rotation_rad)
        move[:, 2] += share * self.translation_m / plane_m
        k = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
        pixels: FloatArray = k @ move @ np.linalg.inv(k)
        return pixels


def motion_between(before: FloatArray, now: FloatArray, exposures: float) -> CameraMotion:
    """The motion of one exposure, from the camera's poses at the previous frame and at this one.

    `exposures` is the exposure's length as a share of the time between the two.
    """
    step = before[:3, :3].T @ now[:3, :3]
    shift = before[:3, :3].T @ (now[:3, 3] - before[:3, 3])
    return CameraMotion(exposures * _rodrigues(step).reshape(3), exposures * shift)


def blur_along_motion(image: ImageArray, motion: CameraMotion, depth_m: Float32Array, camera: Camera) -> ImageArray:
    """The mean of the picture over the exposure, each pixel smeared along its own path.

    The path is that of a plane facing the camera at the picture's median depth: exact for the camera's
    turning, which makes nearly all of the blur, and right for its translation where things stand near that
    distance. Objects that move by themselves are not blurred, nor is depth.

    A mean of n samples along the path takes log2(n) steps: each averages the picture with itself moved by twice
    as far as the step before.
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
    # So far the mean runs from 0 to half of the path; two copies of it, placed about the middle, are the whole.
    first = -(samples - 1) / (2 * samples)
    return _mean(_warped(image, at(first)), _warped(image, at(first + 0.5)))


def drop_edges(codes: CodeArray, rng: np.random.Generator) -> CodeArray:
    """The codes with 2 percent of the pixels at depth edges (next to something much nearer or farther, or to no
    data) gone. Changes and returns its argument."""
    spread = cv2.morphologyEx(codes, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8))
    edges = np.flatnonzero(spread > EDGE_CODES)
    codes.reshape(-1)[edges[rng.random(edges.size) < EDGE_LOSS]] = NO_DATA
    return codes


def scale_channels(image: ImageArray, gains: FloatArray) -> ImageArray:
    """Each channel times its gain (3,), rounded, saturating."""
    return _bytes(cv2.transform(image, np.diag(gains)))


def _rodrigues(rotation: FloatArray) -> FloatArray:
    """A rotation vector (3,) to its matrix, or a matrix to its vector (3, 1)."""
    return np.asarray(cv2.Rodrigues(rotation)[0], np.float64)


def _bytes(image: NDArray[Any]) -> ImageArray:
    """OpenCV's own types do not say that bytes stay bytes."""
    return cast(ImageArray, image)


def _mean(one: ImageArray, other: ImageArray) -> ImageArray:
    return _bytes(cv2.addWeighted(one, 0.5, other, 0.5, 0))


def _warped(image: ImageArray, homography: FloatArray) -> ImageArray:
    """Each pixel takes the one that is nearest to its place under the homography; the margin repeats the border.

    Interpolating would triple the time for a mean that is smooth anyway: against pictures rendered at 64 moments of
    the exposure the error is 0.5 of 255 with and 0.4 without the rounding, 2.3 for no blur at all.
    """
    size, flags = (image.shape[1], image.shape[0]), cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return _bytes(cv2.warpPerspective(image, homography, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))


def _longest_path(first: FloatArray, last: FloatArray, camera: Camera) -> float:
    """Pixels between where two homographies put the middle and the corners of the picture."""
    w, h = camera.width - 1.0, camera.height - 1.0
    points = np.array([[w / 2, h / 2, 1], [0, 0, 1], [w, 0, 1], [0, h, 1], [w, h, 1]]).T
    a, b = first @ points, last @ points
    return float(np.linalg.norm(a[:2] / a[2] - b[:2] / b[2], axis=0).max())


def _median_depth(depth_m: Float32Array) -> float:
    """Of a coarse grid; far away where the picture has nothing."""
    grid = np.abs(depth_m[::16, ::16])
    return float(np.clip(np.median(grid), 0.3, 100.0))
