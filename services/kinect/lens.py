"""Rectification: makes the images of a real Kinect those of the description's ideal cameras.

Readers of frames assume one pinhole model for both images, and a depth camera beside the colour camera that looks in
the same direction. A real Kinect's lenses distort, their centres and focal lengths differ, and one camera is turned
against the other by a fraction of a degree. Once that is measured (`services.kinect.calibration`), it is corrected
here, where frames enter the system. (Derived.)
"""

from __future__ import annotations

from math import pi

import cv2
import numpy as np

from cocoro.arrays import Float32Array, FloatArray
from cocoro.robot import Camera, Robot
from services.kinect.device import RawFrame

Maps = tuple[cv2.typing.MatLike, cv2.typing.MatLike]
NO_DATA = 2047
MATTERS_CODES = 0.5
"""A smaller correction is lost in rounding."""


class Lens:
    """A lens in OpenCV's model. `values` as in a robot's file: fx, fy, cx, cy in pixels, then k1, k2, p1, p2, k3."""

    def __init__(self, values: tuple[float, ...]) -> None:
        fx, fy, cx, cy = values[:4]
        self.matrix: FloatArray = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
        self.distortion: FloatArray = np.array(values[4:])

    @classmethod
    def of(cls, camera: Camera) -> Lens:
        """The lens of an ideal pinhole camera."""
        return cls((camera.fx, camera.fy, camera.cx, camera.cy, 0.0, 0.0, 0.0, 0.0, 0.0))

    def pixels(self, rays: FloatArray) -> FloatArray:
        """Pixels (n, 2) of directions (n, 3) in the camera's frame."""
        points, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), self.matrix, self.distortion)
        return np.asarray(points, float).reshape(-1, 2)

    def rays(self, pixels: FloatArray) -> FloatArray:
        """Directions (n, 3) of pixels (n, 2), with z = 1."""
        points = cv2.undistortPoints(pixels.reshape(-1, 1, 2), self.matrix, self.distortion).reshape(-1, 2)
        return np.column_stack([points, np.ones(len(points))])


class Straightener:
    """Rectifies the frames of one robot's Kinect. Without measured lenses it changes nothing."""

    def __init__(self, robot: Robot) -> None:
        kinect = robot.eye
        target = robot.camera
        shape = target.height, target.width
        v, u = np.mgrid[0 : target.height, 0 : target.width].astype(float)
        rays = Lens.of(target).rays(np.column_stack([u.ravel(), v.ravel()]))
        self._colour: Maps | None = None
        if kinect.colour_lens is not None:
            self._colour = _maps(Lens(kinect.colour_lens).pixels(rays), shape)
        self._depth: Maps | None = None
        self._move: tuple[Float32Array, Float32Array] | None = None
        if kinect.depth_lens is not None:
            turn, _ = cv2.Rodrigues(np.array(kinect.depth_rotation_rad))
            turned = rays @ turn  # the inverse rotation: into the depth camera's frame
            self._depth = _maps(Lens(kinect.depth_lens).pixels(turned), shape, nearest=True)
            # A point's depth differs along the turned axis by the factor `gain`. Codes are almost linear in 1 / z.
            _, b, c = kinect.curve
            endless = b * (pi / 2 - c)
            gain = turned[:, 2].reshape(shape).astype(np.float32)
            if float(np.abs(gain - 1.0).max()) * endless > MATTERS_CODES:
                self._move = gain, np.float32(endless) * (np.float32(1.0) - gain) + np.float32(0.5)

    @property
    def idle(self) -> bool:
        """Whether no lens was measured."""
        return self._colour is None and self._depth is None

    def __call__(self, frame: RawFrame) -> RawFrame:
        """Rectify a frame: colour with interpolation, depth from the nearest pixel, since the mean of two depths means
        nothing at an edge."""
        colour, depth = frame.colour, frame.depth
        if self._colour is not None:
            colour = np.asarray(cv2.remap(colour, self._colour[0], self._colour[1], cv2.INTER_LINEAR), np.uint8)
        if depth is not None and self._depth is not None:
            u, v = self._depth
            carried = cv2.remap(depth, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=NO_DATA)
            depth = np.asarray(carried, np.uint16)
            if self._move is not None:
                gain, shift = self._move
                moved = (depth * gain + shift).astype(np.uint16)
                depth = np.where(depth >= NO_DATA, np.uint16(NO_DATA), moved)
        return RawFrame(frame.stamp_ns, colour, depth)


def _maps(
    pixels: FloatArray, shape: tuple[int, int], *, nearest: bool = False
) -> tuple[cv2.typing.MatLike, cv2.typing.MatLike]:
    u, v = (pixels[:, axis].reshape(shape).astype(np.float32) for axis in (0, 1))
    return cv2.convertMaps(u, v, cv2.CV_16SC2, nninterpolation=nearest)
