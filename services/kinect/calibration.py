"""A Kinect's lenses, how its two cameras stand to each other, and its depth curve, from views of a chessboard. Pure.

Each view is a colour picture and the raw depth that was taken with it, as a frame has them; nothing infrared is needed.
The colour camera comes from the corners (Zhang 2000, as OpenCV has it); it also tells how the board lay in each view.
Then the depth camera's lens and place and its curve are those with which the depths lie on those boards: least squares
over all views at once, in codes, where the sensor's noise is the same everywhere. What a view says little about is
held by what Kinects have in common, as priors; so are views from few sides no reason for a wild guess. (Derived; the
idea of planes is Herrera, Kannala and Heikkilä's, 2012.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan, pi
from typing import NamedTuple

import cv2
import numpy as np

from cocoro.arrays import BoolArray, CodeArray, Float32Array, FloatArray, ImageArray
from cocoro.errors import CocoroError
from cocoro.robot import LensValues, Robot
from cocoro.units import Vec3
from services.kinect.lens import Lens

LEAST_VIEWS = 6
LEAST_PIXELS = 100
"""Of depth on the board, in a view that is to count."""
PIXELS_A_VIEW = (60, 400)
"""First for a rough guess, then for all that there is to know."""
BORDER = 0.6
"""Squares around the outermost corners whose depth counts too: the board's edge is 1 away."""
MOST_COLOUR_PX, MOST_DEPTH_CODES = 1.0, 3.0
"""With a larger misfit it is no good calibration: a bent board, a wrong number of squares, a board that moved."""
NOISE_CODES = 2.0
"""More than a pixel's own noise: neighbours err together."""

HUBER = 2.0
MEDIAN_TO_SIGMA = 1.4826
ITERATIONS, SETTLED, SLOPE_STEP = 15, 1e-3, 1e-4
"""Steps are in sigmas of the priors."""

# Of Kinects in general: where the search begins, and how far it goes where no view says anything (one sigma).
FOCAL_PX, FOCAL_SIGMA_PX = 585.0, 15.0
MIDDLE_SIGMA_PX = 15.0
BEND_SIGMA = (0.1, 0.2)
TURN_SIGMA_RAD = 0.01
PLACE_SIGMA_M = 0.003
SCALE_SIGMA = 0.05
ENDLESS_SIGMA_CODES = 15.0


@dataclass(frozen=True)
class Board:
    """A chessboard by its inner corners, where four squares meet."""

    columns: int
    rows: int
    square_m: float

    @property
    def points_m(self) -> Float32Array:
        """Of the corners, row by row, in the board's plane: (columns * rows, 3)."""
        grid = np.mgrid[0 : self.columns, 0 : self.rows].T.reshape(-1, 2) * self.square_m
        return np.column_stack([grid, np.zeros(len(grid))]).astype(np.float32)

    def covers(self, points_m: FloatArray) -> BoolArray:
        """Whether points (n, 2) of its plane are on the board, and not near its edge."""
        squares = points_m / self.square_m
        ends = np.array([self.columns - 1 + BORDER, self.rows - 1 + BORDER])
        return np.asarray(((squares > -BORDER) & (squares < ends)).all(axis=1))


class BoardView(NamedTuple):
    corners_px: FloatArray
    """In the colour picture, in the order of the board's points: (n, 2)."""
    depth: CodeArray
    """Raw codes of the same moment, (height, width)."""


@dataclass(frozen=True)
class Calibration:
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
    """One sigma, as far as the views tell."""
    views: int

    def values(self) -> dict[str, float | tuple[float, ...]]:
        """For the table [kinect] of a robot's own file."""
        names = (
            "horizontal_fov_rad", "vertical_fov_rad", "depth_offset_m", "depth_curve", "colour_lens", "depth_lens",
            "depth_rotation_rad",
        )  # fmt: skip
        return {name: getattr(self, name) for name in names}


def find_corners(colour: ImageArray, board: Board, *, quick: bool = False) -> FloatArray | None:
    """The board's corners in a picture, (n, 2) pixels; None where not all of them are seen."""
    grey = cv2.cvtColor(colour, cv2.COLOR_RGB2GRAY)
    found, corners = cv2.findChessboardCornersSB(grey, (board.columns, board.rows), flags=0)
    if not found:
        return None
    if not quick:
        # Half the shorter way to a neighbour: no further than its own four squares.
        places = np.asarray(corners, float).reshape(board.rows, board.columns, 2)
        ways = [np.linalg.norm(np.diff(places, axis=axis), axis=2).min() for axis in (0, 1)]
        reach = int(max(2, min(min(ways) / 2, 9)))
        enough = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 50, 1e-3)
        corners = cv2.cornerSubPix(grey, corners, (reach, reach), (-1, -1), enough)
    return np.asarray(corners, float).reshape(-1, 2)


def calibrate(views: Sequence[BoardView], board: Board, robot: Robot) -> Calibration:
    """Raises CocoroError where the views are too few or do not go together, with what to do."""
    if len(views) < LEAST_VIEWS:
        raise CocoroError(f"the whole board is seen in {len(views)} views; {LEAST_VIEWS} are the least, 15 are good")
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
    boards = [_Lying.of(turn, place) for turn, place in zip(turns, places, strict=True)]
    depth = _DepthFit(views, boards, board, robot)
    guess, doubt, misfit_codes = depth.fit()
    if misfit_codes > MOST_DEPTH_CODES:
        raise CocoroError(
            f"the depths miss the boards by {misfit_codes:.1f} codes: is a square {1000 * board.square_m:g} mm, did the"
            " board keep still?"
        )
    fx, fy, cx, cy = float(matrix[0, 0]), float(matrix[1, 1]), float(matrix[0, 2]), float(matrix[1, 2])
    k1, k2, p1, p2, k3 = (float(value) for value in np.asarray(distortion).ravel()[:5])
    return Calibration(
        colour_lens=(fx, fy, cx, cy, k1, k2, p1, p2, k3),
        depth_lens=guess.lens,
        depth_offset_m=_vec3(guess.place_m),
        depth_rotation_rad=_vec3(guess.turn_rad),
        depth_curve=guess.curve,
        horizontal_fov_rad=2 * atan(width / 2 / fx),
        vertical_fov_rad=2 * atan(height / 2 / fy),
        colour_misfit_px=float(misfit_px),
        depth_misfit_codes=misfit_codes,
        offset_doubt_m=_vec3(doubt),
        views=len(views),
    )


class _Lying(NamedTuple):
    """How a board lies before the colour camera: a point p of its plane is at `rotation @ p + place`."""

    rotation: FloatArray
    place: FloatArray

    @classmethod
    def of(cls, turn: cv2.typing.MatLike, place: cv2.typing.MatLike) -> _Lying:
        return cls(np.asarray(cv2.Rodrigues(turn)[0], float), np.asarray(place, float).ravel())

    @property
    def plane(self) -> FloatArray:
        """Its normal, and the distance along it, (4,)."""
        normal = self.rotation[:, 2]
        return np.append(normal, normal @ self.place)


class _Guess(NamedTuple):
    """The depth camera, made of the search's 14 numbers: fx, fy, cx, cy, k1, k2; turn; place; scale and endless code.

    z = a tan(code / b + c) is all but a * b / (endless - code), with the code of the endlessly far: only these two are
    searched for, and `a` stays as it is.
    """

    values: FloatArray
    a: float

    @property
    def lens(self) -> LensValues:
        fx, fy, cx, cy, k1, k2 = (float(value) for value in self.values[:6])
        return fx, fy, cx, cy, k1, k2, 0.0, 0.0, 0.0

    @property
    def turn_rad(self) -> FloatArray:
        return self.values[6:9]

    @property
    def place_m(self) -> FloatArray:
        return self.values[9:12]

    @property
    def curve(self) -> Vec3:
        scale, endless = (float(value) for value in self.values[12:])
        b = scale / self.a
        return self.a, b, pi / 2 - endless / b

    def along(self, pixels: FloatArray, planes: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Where the pixels' (n, 2) rays meet planes (n, 4) of the colour camera's frame, (n, 3), and at which depth of
        the depth camera's."""
        rays = Lens(self.lens).rays(pixels) @ np.asarray(cv2.Rodrigues(self.turn_rad)[0], float).T
        normals = planes[:, :3]
        depth = (planes[:, 3] - normals @ self.place_m) / (normals * rays).sum(axis=1)
        return self.place_m + rays * depth[:, None], depth

    def codes(self, depth_m: FloatArray) -> FloatArray:
        a, b, c = self.curve
        codes: FloatArray = b * (np.arctan(depth_m / a) - c)
        return codes


class _DepthFit:
    def __init__(self, views: Sequence[BoardView], boards: Sequence[_Lying], board: Board, robot: Robot) -> None:
        self._views, self._boards, self._board = views, boards, board
        kinect = robot.kinect
        a, b, c = kinect.depth_curve
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

    def fit(self) -> tuple[_Guess, FloatArray, float]:
        """The depth camera, the doubt of its place (m, one sigma), and the misfit in codes."""
        steps = np.zeros(len(self._start))
        for count in PIXELS_A_VIEW:  # which pixels show the board depends on the guess
            seen = self._on_boards(self._guess(steps), count)
            steps, information = self._descend(steps, *seen)
        guess = self._guess(steps)
        doubt = np.sqrt(np.diag(np.linalg.inv(information))) * self._sigma
        misfit = float(np.median(np.abs(self._misfits(steps, *seen)))) * NOISE_CODES
        return guess, doubt[9:12], MEDIAN_TO_SIGMA * misfit

    def _guess(self, steps: FloatArray) -> _Guess:
        """So many sigmas from the start, for each of its numbers."""
        return _Guess(self._start + steps * self._sigma, self._a)

    def _descend(
        self, steps: FloatArray, pixels: FloatArray, codes: FloatArray, planes: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Gauss-Newton with Huber weights and the priors; where it settles, and the information there."""
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
        """Of each pixel, in sigmas."""
        guess = self._guess(steps)
        _, depth_m = guess.along(pixels, planes)
        return (guess.codes(depth_m) - codes) / NOISE_CODES

    def _on_boards(self, guess: _Guess, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Pixels (n, 2), codes (n,) and planes (n, 4) of the depth that shows the boards."""
        parts = []
        for view, board in zip(self._views, self._boards, strict=True):
            v, u = np.nonzero(view.depth[::2, ::2] < 2047)
            v, u = 2 * v, 2 * u  # a quarter of them is enough
            pixels = np.column_stack([u, v]).astype(float)
            planes = np.broadcast_to(board.plane, (len(pixels), 4))
            points, depth_m = guess.along(pixels, planes)
            on_board = self._board.covers(((points - board.place) @ board.rotation)[:, :2])
            codes = view.depth[v, u].astype(float)
            # A hand before the board, or what is behind it where the guess is still off, is not the board.
            near = on_board & (depth_m > 0) & (np.abs(guess.codes(np.maximum(depth_m, 0.1)) - codes) < 60)
            chosen = np.flatnonzero(near)
            if len(chosen) >= LEAST_PIXELS:
                chosen = chosen[:: max(len(chosen) // count, 1)]
                parts.append((pixels[chosen], codes[chosen], planes[chosen]))
        if len(parts) < LEAST_VIEWS:
            raise CocoroError(
                f"there is depth on the board in {len(parts)} views; {LEAST_VIEWS} are the least: hold it 0.6 to 3 m"
                " away, no black that shines"
            )
        pixels, codes, planes = (np.concatenate(each) for each in zip(*parts, strict=True))
        return pixels, codes, planes


def _vec3(values: FloatArray) -> Vec3:
    x, y, z = (float(value) for value in values)
    return x, y, z
