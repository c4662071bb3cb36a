"""Calibrates a Kinect from views of a chessboard: lenses, relative pose of its two cameras, and depth curve. Pure.

A view is a colour image and the raw depth of the same moment, as in a frame; no infrared images are needed. The colour
camera is calibrated from the board's corners (Zhang 2000, in OpenCV), which also gives the board's pose in each view.
Then the depth camera's lens, pose and curve are fitted so that the depths lie on these boards: least squares over all
views together, in codes, in which the sensor's noise is the same everywhere. Priors, from what Kinects have in common,
hold the parameters that the views determine badly. (Derived; the use of planes follows Herrera, Kannala and Heikkilä
2012.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan, pi
from typing import NamedTuple

import cv2
import numpy as np

from cocoro.arrays import BoolArray, CodeArray, Float32Array, FloatArray, ImageArray
from cocoro.cameras import LensValues
from cocoro.errors import CocoroError
from cocoro.robot import Robot
from cocoro.units import Vec3
from services.kinect.lens import Lens

LEAST_VIEWS = 6
LEAST_PIXELS = 100
"""Least number of depth pixels on the board in a view that counts."""
PIXELS_PER_VIEW = (60, 400)
"""Number of depth pixels in the first, rough fit and in the final one."""
BORDER = 0.6
"""Border around the outermost corners, in squares, whose depth counts too. The board's edge is 1 square away."""
MOST_COLOUR_PX, MOST_DEPTH_CODES = 1.0, 3.0
"""A larger misfit means a bad calibration: the board was bent, moved, or has another number of squares."""
NOISE_CODES = 2.0
"""Standard deviation of a code; more than a pixel's own noise, since neighbours have a common error."""

HUBER = 2.0
MEDIAN_TO_SIGMA = 1.4826
ITERATIONS, SETTLED, SLOPE_STEP = 15, 1e-3, 1e-4
"""The fit's steps are in units of the priors' standard deviations."""

# Priors: typical values of Kinects, from which the fit starts, and their standard deviations.
FOCAL_PX, FOCAL_SIGMA_PX = 585.0, 15.0
MIDDLE_SIGMA_PX = 15.0
BEND_SIGMA = (0.1, 0.2)
TURN_SIGMA_RAD = 0.01
PLACE_SIGMA_M = 0.003
SCALE_SIGMA = 0.05
ENDLESS_SIGMA_CODES = 15.0


@dataclass(frozen=True)
class Board:
    """A chessboard. Its inner corners are the points where four squares meet."""

    columns: int
    rows: int
    square_m: float

    @property
    def points_m(self) -> Float32Array:
        """Corners in the board's plane, row by row: (columns * rows, 3), m."""
        grid = np.mgrid[0 : self.columns, 0 : self.rows].T.reshape(-1, 2) * self.square_m
        return np.column_stack([grid, np.zeros(len(grid))]).astype(np.float32)

    def covers(self, points_m: FloatArray) -> BoolArray:
        """Mark the points (n, 2), m, of the board's plane that are on the board and not near its edge; shape (n,)."""
        squares = points_m / self.square_m
        ends = np.array([self.columns - 1 + BORDER, self.rows - 1 + BORDER])
        return np.asarray(((squares > -BORDER) & (squares < ends)).all(axis=1))


class BoardView(NamedTuple):
    """The board in a colour image, and the depth image of the same moment."""

    corners_px: FloatArray
    """Corners in the colour image, in the order of `Board.points_m`: (n, 2)."""
    depth: CodeArray
    """Raw codes, (height, width)."""


@dataclass(frozen=True)
class Calibration:
    """A calibration, its misfits, and the standard deviation of the depth camera's place."""

    colour_lens: LensValues
    depth_lens: LensValues
    depth_offset_m: Vec3
    depth_rotation_rad: Vec3
    depth_curve: Vec3
    horizontal_fov_rad: float
    vertical_fov_rad: float
    colour_misfit_px: float
    depth_misfit_codes: float
    offset_doubt_m: Vec3
    """Standard deviation of `depth_offset_m`, from views and priors."""
    views: int

    def values(self) -> dict[str, float | tuple[float, ...]]:
        """The values for the row of the camera in a robot's own file."""
        names = (
            "horizontal_fov_rad", "vertical_fov_rad", "depth_offset_m", "depth_curve", "colour_lens", "depth_lens",
            "depth_rotation_rad",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names}


def find_corners(colour: ImageArray, board: Board, *, quick: bool = False) -> FloatArray | None:
    """Find the board's corners in an image (height, width, 3): (n, 2), pixels; None when some are not visible. `quick`
    leaves out the refinement to a fraction of a pixel."""
    grey = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=0)
    if not found:
        return None
    if not quick:
        # The window is half the smallest distance of two corners, so that it stays within a corner's four squares.
        places = np.asarray(corners, float).reshape(board.rows, board.columns, 2)
        distances = [np.linalg.norm(np.diff(places, axis=axis), axis=2).min() for axis in (0, 1)]
        reach = int(max(2, min(min(distances) / 2, 9)))
        enough = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
        corners = cv2.cornerSubPix(grey, corners, (reach, reach), (-1, -1), enough)
    return np.asarray(corners, float).reshape(-1, 2)


def calibrate(views: Sequence[BoardView], board: Board, robot: Robot) -> Calibration:
    """Calibrate from views. Raises CocoroError, with what to do, when there are too few or they are inconsistent."""
    if len(views) < LEAST_VIEWS:
        raise CocoroError(
            f"the whole board is visible in {len(views)} views; at least {LEAST_VIEWS} are needed, 15 are good"
        )
    height, width = views[0].depth.shape
    misfit_px, matrix, distortion, turns, places = cv2.calibrateCamera(
        [board.points_m] * len(views),
        [view.corners_px.astype(np.float32) for view in views],
        (width, height),
        np.eye(3),
        np.zeros(5),
        flags=cv2.CALIB_FIX_K3,
    )
    if misfit_px > MOST_COLOUR_PX:
        raise CocoroError(
            f"the corners miss a flat board's by {misfit_px:.1f} pixels: is it flat, did it keep still, is it"
            f" {board.columns} x {board.rows} inner corners?"
        )
    boards = [_BoardPose.of(turn, place) for turn, place in zip(turns, places, strict=True)]
    depth = _DepthFit(views, boards, board, robot)
    camera, doubt, misfit_codes = depth.fit()
    if misfit_codes > MOST_DEPTH_CODES:
        raise CocoroError(
            f"the depths miss the boards by {misfit_codes:.1f} codes: is a square {1000 * board.square_m:g} mm, did the"
            " board keep still?"
        )
    fx, fy, cx, cy = float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
    k1, k2, p1, p2, k3 = (float(value) for value in np.asarray(distortion).ravel()[:5])
    return Calibration(
        colour_lens=(fx, fy, cx, cy, k1, k2, p1, p2, k3),
        depth_lens=camera.lens,
        depth_offset_m=_vec3(camera.place_m),
        depth_rotation_rad=_vec3(camera.turn_rad),
        depth_curve=camera.curve,
        horizontal_fov_rad=2 * atan(width / 2 / fx),
        vertical_fov_rad=2 * atan(height / 2 / fy),
        colour_misfit_px=float(misfit_px),
        depth_misfit_codes=misfit_codes,
        offset_doubt_m=_vec3(doubt),
        views=len(views),
    )


class _BoardPose(NamedTuple):
    """A board's pose in the colour camera's frame: its point p is at `rotation @ p + place`."""

    rotation: FloatArray
    place: FloatArray

    @classmethod
    def of(cls, turn: cv2.typing.MatLike, place: cv2.typing.MatLike) -> _BoardPose:
        return cls(np.asarray(cv2.Rodrigues(turn)[0], float), np.asarray(place, float).ravel())

    @property
    def plane(self) -> FloatArray:
        """The board's plane: normal, and distance along it, (4,)."""
        normal = self.rotation[:, 2]
        return np.append(normal, normal @ self.place)


class _DepthCamera(NamedTuple):
    """The depth camera with the fit's 14 parameters: fx, fy, cx, cy, k1, k2; rotation; place; scale; code at infinity.

    The curve z = a tan(code / b + c) is almost a * b / (endless - code), where `endless` is the code at infinity. So
    only scale (a * b) and `endless` are fitted, and `a` is kept.
    """

    values: FloatArray
    a: float

    @property
    def lens(self) -> LensValues:
        fx, fy, cx, cy, k1, k2 = (float(value) for value in self.values[:6])
        return fx, fy, cx, cy, k1, k2, 0.0, 0.0, 0.0

    @property
    def turn_rad(self) -> FloatArray:
        """Rotation vector of the depth camera in the colour camera's frame, (3,)."""
        return self.values[6:9]

    @property
    def place_m(self) -> FloatArray:
        """Place of the depth camera in the colour camera's frame, (3,)."""
        return self.values[9:12]

    @property
    def curve(self) -> Vec3:
        scale, endless = (float(value) for value in self.values[12:])
        b = scale / self.a
        return self.a, b, pi / 2 - endless / b

    def along(self, pixels: FloatArray, planes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Intersect the rays of pixels (n, 2) with planes (n, 4) in the colour camera's frame: points (n, 3), m, in
        that frame, and depths (n,), m, in the depth camera's."""
        rays = Lens(self.lens).rays(pixels) @ np.asarray(cv2.Rodrigues(self.turn_rad)[0], float).T
        normals = planes[:, :3]
        depth = (planes[:, 3] - normals @ self.place_m) / (normals * rays).sum(axis=1)
        return self.place_m + rays * depth[:, None], depth

    def codes(self, depth_m: FloatArray) -> FloatArray:
        """Codes of depths (n,), m."""
        a, b, c = self.curve
        codes: FloatArray = b * (np.arctan(depth_m / a) - c)
        return codes


class _DepthFit:
    """Fits the depth camera to the boards' poses."""

    def __init__(self, views: Sequence[BoardView], boards: Sequence[_BoardPose], board: Board, robot: Robot) -> None:
        self._views, self._boards, self._board = views, boards, board
        kinect = robot.eye
        a, b, c = kinect.curve
        self._a = a
        scale = a * b
        middle = (kinect.width - 1) / 2, (kinect.height - 1) / 2
        start = (
            FOCAL_PX, FOCAL_PX, *middle, 0.0, 0.0, 0.0, 0.0, 0.0, *kinect.depth_offset_m, scale, b * (pi / 2 - c),
        )  # fmt: skip
        sigma = (
            FOCAL_SIGMA_PX, FOCAL_SIGMA_PX, MIDDLE_SIGMA_PX, MIDDLE_SIGMA_PX, *BEND_SIGMA,
            *(TURN_SIGMA_RAD,) * 3, *(PLACE_SIGMA_M,) * 3, SCALE_SIGMA * scale, ENDLESS_SIGMA_CODES,
        )  # fmt: skip
        self._start, self._sigma = np.array(start), np.array(sigma)

    def fit(self) -> tuple[_DepthCamera, FloatArray, float]:
        """The depth camera, the standard deviation of its place (3,), m, and the misfit in codes."""
        steps = np.zeros(len(self._start))
        for count in PIXELS_PER_VIEW:  # the pixels that show the board depend on the camera
            seen = self._on_boards(self._camera(steps), count)
            steps, information = self._descend(steps, *seen)
        camera = self._camera(steps)
        doubt = np.sqrt(np.diag(np.linalg.inv(information))) * self._sigma
        misfit = float(np.median(np.abs(self._misfits(steps, *seen)))) * NOISE_CODES
        return camera, doubt[9:12], MEDIAN_TO_SIGMA * misfit

    def _camera(self, steps: FloatArray) -> _DepthCamera:
        """The depth camera whose parameters are `steps` (14,) standard deviations from the start."""
        return _DepthCamera(self._start + steps * self._sigma, self._a)

    def _descend(
        self, steps: FloatArray, pixels: FloatArray, codes: FloatArray, planes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Minimise by Gauss-Newton with Huber weights and priors; returns the steps (14,) and the information matrix
        (14, 14) there."""
        for _ in range(ITERATIONS):
            misfits = self._misfits(steps, pixels, codes, planes)
            slopes = np.empty((len(misfits), len(steps)))
            for number in range(len(steps)):
                beside = steps.copy()
                beside[number] += SLOPE_STEP
                slopes[:, number] = (self._misfits(beside, pixels, codes, planes) - misfits) / SLOPE_STEP
            weighted = slopes * (HUBER / np.maximum(np.abs(misfits), HUBER))[:, None]
            information = weighted.T @ slopes + np.eye(len(steps))
            move = np.linalg.solve(information, -weighted.T @ misfits - steps)
            steps = steps + move
            if float(np.abs(move).max()) < SETTLED:
                break
        return steps, information

    def _misfits(self, steps: FloatArray, pixels: FloatArray, codes: FloatArray, planes: FloatArray) -> FloatArray:
        """Misfit of each pixel, in standard deviations of the noise: (n,)."""
        camera = self._camera(steps)
        _, depth_m = camera.along(pixels, planes)
        return (camera.codes(depth_m) - codes) / NOISE_CODES

    def _on_boards(self, camera: _DepthCamera, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """The depth pixels that show the boards: pixels (n, 2), their codes (n,), and the boards' planes (n, 4). Raises
        CocoroError when there are too few views with depth."""
        parts = []
        for view, board in zip(self._views, self._boards, strict=True):
            v, u = np.nonzero(view.depth[::2, ::2] < 2047)
            v, u = 2 * v, 2 * u  # a quarter of them is enough
            pixels = np.column_stack([u, v]).astype(float)
            planes = np.broadcast_to(board.plane, (len(pixels), 4))
            points, depth_m = camera.along(pixels, planes)
            on_board = self._board.covers(((points - board.place) @ board.rotation)[:, :2])
            codes = view.depth[v, u].astype(float)
            # Codes far from the expected ones are not the board: a hand in front of it, or the background beside it.
            near = on_board & (depth_m > 0) & (np.abs(camera.codes(np.maximum(depth_m, 0.1)) - codes) < 60)
            chosen = np.flatnonzero(near)
            if len(chosen) >= LEAST_PIXELS:
                chosen = chosen[:: max(len(chosen) // count, 1)]
                parts.append((pixels[chosen], codes[chosen], planes[chosen]))
        if len(parts) < LEAST_VIEWS:
            raise CocoroError(
                f"the board has depth in {len(parts)} views; at least {LEAST_VIEWS} are needed: hold it 0.6 to 3 m"
                " away, and print it without glossy black"
            )
        pixels, codes, planes = (np.concatenate(each) for each in zip(*parts, strict=True))
        return pixels, codes, planes


def _vec3(values: FloatArray) -> Vec3:
    x, y, z = (float(value) for value in values)
    return x, y, z
