"""Images of chessboards by a Kinect with given lenses, drawn by ray tracing, so that every parameter is known."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from cocoro.arrays import BoolArray, CodeArray, FloatArray, ImageArray
from cocoro.cameras import LensValues
from cocoro.units import Vec3
from services.kinect.calibration import Board
from services.kinect.lens import Lens

WALL_M = 3.2
WIDTH, HEIGHT = 640, 480
FINE = 2
"""Rays across a colour pixel."""


@dataclass(frozen=True)
class Eyes:
    """The true parameters of a Kinect."""

    colour: LensValues
    depth: LensValues
    turn_rad: Vec3
    place_m: Vec3
    curve: Vec3

    @property
    def turn(self) -> FloatArray:
        return np.asarray(cv2.Rodrigues(np.array(self.turn_rad))[0], float)

    def code(self, depth_m: FloatArray) -> FloatArray:
        a, b, c = self.curve
        return b * (np.arctan(depth_m / a) - c)


def lying(turn_rad: Vec3, middle_m: Vec3, board: Board) -> tuple[FloatArray, FloatArray]:
    """Rotation and place of a board with this centre."""
    rotation = np.asarray(cv2.Rodrigues(np.array(turn_rad))[0], float)
    half = np.array([board.columns - 1, board.rows - 1, 0.0]) * board.square_m / 2
    return rotation, np.array(middle_m) - rotation @ half


class Painter:
    def __init__(self, eyes: Eyes, board: Board, seed: int = 0) -> None:
        self._eyes, self._board = eyes, board
        self._rng = np.random.default_rng(seed)
        self._colour_rays = Lens(eyes.colour).rays(_grid(FINE))
        self._depth_rays = Lens(eyes.depth).rays(_grid(1)) @ eyes.turn.T

    def colour(self, rotation: FloatArray, place: FloatArray) -> ImageArray:
        """The colour image, with a little noise."""
        squares, _ = self._meet(self._colour_rays, np.zeros(3), rotation, place)
        inside = self._inside(squares)
        dark = (np.floor(squares).astype(int).sum(axis=1) % 2 == 0) & inside
        grey = np.where(inside, np.where(dark, 30.0, 225.0), 120.0)
        fine = grey.reshape(HEIGHT, FINE, WIDTH, FINE).mean(axis=(1, 3))
        noisy = fine[..., None] + self._rng.normal(0.0, 2.0, (HEIGHT, WIDTH, 3))
        picture: ImageArray = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
        return picture

    def depth(self, rotation: FloatArray, place: FloatArray) -> CodeArray:
        """The depth image of the board in front of a wall, with noise of one code."""
        eyes = self._eyes
        squares, away = self._meet(self._depth_rays, np.array(eyes.place_m), rotation, place)
        wall = (WALL_M - eyes.place_m[2]) / self._depth_rays[:, 2]
        depth_m = np.where(self._inside(squares), away, wall)
        codes = np.rint(eyes.code(depth_m) + self._rng.normal(0.0, 0.7, len(depth_m)))
        return np.clip(codes, 0, 2047).astype(np.uint16).reshape(HEIGHT, WIDTH)

    def _meet(
        self, rays: FloatArray, start: FloatArray, rotation: FloatArray, place: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Intersections of rays with the board's plane, in squares from its first corner, and their distances along the
        rays."""
        normal = rotation[:, 2]
        away = normal @ (place - start) / (rays @ normal)
        points = (start + rays * away[:, None] - place) @ rotation
        return points[:, :2] / self._board.square_m, away

    def _inside(self, squares: FloatArray) -> BoolArray:
        inside: BoolArray = np.all((squares > -1) & (squares < [self._board.columns, self._board.rows]), axis=1)
        return inside


def _grid(fine: int) -> FloatArray:
    """Centres of the pixels' parts, row by row: (n, 2)."""
    v, u = np.mgrid[0 : HEIGHT * fine, 0 : WIDTH * fine]
    return (np.column_stack([u.ravel(), v.ravel()]) + 0.5) / fine - 0.5
