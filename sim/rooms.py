"""Random rooms: walls, and one known object that none of the robot's looks from the start can show."""

from __future__ import annotations

from math import cos, pi, sin

import cv2
import numpy as np

from cocoro.arrays import BoolArray, FloatArray
from cocoro.objects import ObjectSpec
from sim.scene import Obstacle

WALLS = (1, 3)
LENGTH_M, THICKNESS_M, HEIGHT_M = (0.6, 1.5), (0.04, 0.10), (0.35, 0.90)
DISTANCE_M = (0.9, 1.9)
BY_ROBOT_M = 0.36
"""Least distance of a wall from the robot's centre."""
BESIDE_M = 0.20
"""Least distance of a wall from the object's centre."""
_EYE_M, _NECK_M = 0.74, 0.09
"""The camera's height, and its greatest distance from the body's axis."""
_ROOM_M, _HAND_ROOM_M = 0.25, 0.16
"""Least distances of walls from the body's centre on its way, and from the line on which the hand comes."""
_FROM_M, _TO_M = 1.05, 0.60
"""Distances of the body's centre from the object at which the last stretch begins and ends."""
_CELL_M, _HALF_M = 0.06, 3.0


def draw_room(rng: np.random.Generator, known: ObjectSpec) -> tuple[tuple[Obstacle, ...], tuple[float, float]]:
    """Walls, and a place for a known object in the robot's frame at the start: hidden from the start, and within reach
    from a pose to which the body can drive."""
    while True:
        distance, bearing = rng.uniform(*DISTANCE_M), rng.uniform(-pi, pi)
        place = distance * cos(bearing), distance * sin(bearing)
        along, aside = rng.uniform(BY_ROBOT_M, distance - BESIDE_M), rng.uniform(-0.25, 0.25)
        first = (
            along * cos(bearing) - aside * sin(bearing),
            along * sin(bearing) + aside * cos(bearing),
        )
        walls = [_wall(rng, first, bearing + pi / 2 + rng.uniform(-0.5, 0.5))]
        for _ in range(int(rng.integers(WALLS[0] - 1, WALLS[1]))):
            away, where = rng.uniform(0.6, 2.3), rng.uniform(-pi, pi)
            walls.append(_wall(rng, (away * cos(where), away * sin(where)), rng.uniform(-pi, pi)))
        origin, goal = np.zeros((1, 2)), np.array([place])
        if min(float(_from_wall(wall, origin)[0]) for wall in walls) < BY_ROBOT_M:
            continue
        if min(float(_from_wall(wall, goal)[0]) for wall in walls) < BESIDE_M:
            continue
        if _hidden(walls, known, place) and _in_reach(walls, place):
            return tuple(walls), place


def _wall(rng: np.random.Generator, place: tuple[float, float], yaw_rad: float) -> Obstacle:
    length, thickness, height = (float(rng.uniform(*span)) for span in (LENGTH_M, THICKNESS_M, HEIGHT_M))
    grey = float(rng.uniform(0.4, 0.75))
    return Obstacle(
        shape="box",
        size_m=(length, thickness, height),
        rgb=(grey, 0.95 * grey, 0.85 * grey),
        position_m=(float(place[0]), float(place[1])),
        yaw_rad=float(yaw_rad),
    )


def _in_wall(wall: Obstacle, places_m: FloatArray) -> FloatArray:
    """Places (n, 2) in the wall's frame."""
    c, s = cos(wall.yaw_rad), sin(wall.yaw_rad)
    turned: FloatArray = (places_m - np.array(wall.position_m)) @ np.array([[c, -s], [s, c]])
    return turned


def _from_wall(wall: Obstacle, places_m: FloatArray) -> FloatArray:
    """Distances (n,) of places (n, 2) from a wall."""
    beyond = np.maximum(np.abs(_in_wall(wall, places_m)) - np.array(wall.dimensions_m[:2]) / 2, 0.0)
    return np.asarray(np.hypot(*beyond.T))


def _hidden(walls: list[Obstacle], known: ObjectSpec, place: tuple[float, float]) -> bool:
    """Whether the walls hide all of the object from every place of the camera."""
    turns = np.linspace(0.0, 2 * pi, 8, endpoint=False)
    rim = known.planar_radius_m * np.stack([np.cos(turns), np.sin(turns)], axis=1) + np.array(place)
    rims = [np.column_stack([rim, np.full(len(rim), height)]) for height in (0.0, known.size_m[2] / 2, known.size_m[2])]
    points = np.concatenate(rims)
    for turn in turns:
        eye = np.array([_NECK_M * cos(turn), _NECK_M * sin(turn), _EYE_M])
        if not np.any([_crosses(wall, eye, points) for wall in walls], axis=0).all():
            return False
    return True


def _crosses(wall: Obstacle, eye: FloatArray, points: FloatArray) -> BoolArray:
    """Whether a wall hides points (n, 3) from an eye (3,): their line is inside of it somewhere."""
    shares = np.linspace(0.02, 0.98, 97)[:, None, None]
    along = eye + shares * (points - eye)
    flat = _in_wall(wall, along.reshape(-1, 3)[:, :2]).reshape(*along.shape[:2], 2)
    half = np.array(wall.dimensions_m[:2]) / 2
    inside = np.all(np.abs(flat) <= half, axis=2) & (along[:, :, 2] <= wall.dimensions_m[2])
    return np.asarray(inside.any(axis=0))


def _in_reach(walls: list[Obstacle], place: tuple[float, float]) -> bool:
    """Whether the body can drive to a line on which the hand reaches the object."""
    steps = np.arange(-_HALF_M, _HALF_M, _CELL_M)
    grid = np.stack(np.meshgrid(steps, steps, indexing="ij"), axis=-1)
    free = np.hypot(grid[..., 0] - place[0], grid[..., 1] - place[1]) > _ROOM_M
    for wall in walls:
        free &= (_from_wall(wall, grid.reshape(-1, 2)) > _ROOM_M).reshape(free.shape)
    _, parts = cv2.connectedComponents(free.astype(np.uint8), connectivity=4)
    middle = len(steps) // 2
    if not free[middle, middle]:
        return False
    for turn in np.linspace(0.0, 2 * pi, 24, endpoint=False):
        line = np.array(place) + np.linspace(0.05, _FROM_M, 22)[:, None] * np.array([cos(turn), sin(turn)])
        gaps = np.min([_from_wall(wall, line) for wall in walls], axis=0)
        away = np.hypot(*(line - np.array(place)).T)
        if (gaps < np.where(away > _TO_M - 0.05, _ROOM_M + 0.04, _HAND_ROOM_M)).any():
            continue
        row, column = np.round((line[-1] + _HALF_M) / _CELL_M).astype(int)
        if 0 <= row < len(steps) and 0 <= column < len(steps) and parts[row, column] == parts[middle, middle]:
            return True
    return False
