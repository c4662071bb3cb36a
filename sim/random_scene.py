"""Random scenes: known objects and obstacles around the robot, drawn from the run's seed."""

from __future__ import annotations

from math import cos, hypot, pi, radians, sin
from pathlib import Path

import numpy as np

from cocoro.errors import ConfigError, choice_of
from cocoro.objects import Catalogue, ObjectSpec
from cocoro.robot import Robot
from sim.rooms import draw_room
from sim.scaled import SCALED, nearer, scale_of
from sim.scene import Light, Obstacle, Scene, SceneObject, load_scene
from sim.seeds import stream

NAME = "random"
ROOMS, EMPTY = "rooms", "rooms-empty"
DISTANCE_M = (0.8, 2.0)
BEARING_DEG = 120.0
APART_M = 0.25
_SIGHT_M = 0.06
"""Least distance of an obstacle's edge from the line of sight between robot and object."""
_BESIDE_M = 0.22
"""Least distance of an obstacle's edge from an object's centre."""
_BY_ROBOT_M = 0.30
"""Least distance of an obstacle's edge from the robot's centre."""
_TRIES = 2000


def random_scene(seed: int, target: str = "", catalogue: Catalogue | None = None, *, scale: float = 1.0) -> Scene:
    """Draw a scene: 1 to 4 known objects, 0.8 to 2.0 m away, within 120 degrees to either side and at least 0.25 m
    apart; for half of the seeds also 1 or 2 obstacles beside the lines of sight.

    At least one object fits into the hand. `target` is always among them: it takes the place of the first object, so
    that the places do not depend on the target. `catalogue` holds the known objects; None is the project's own.
    `scale`: of all distances from the robot. Raises ConfigError for a target that is no known object.
    """
    rng = stream(seed, "random scene")
    catalogue = Catalogue.load() if catalogue is None else catalogue
    graspable = [known for known in catalogue.targets if known.graspable]
    first = graspable[int(rng.integers(len(graspable)))]
    others = [known for known in catalogue.targets if known.label != first.label]
    rng.shuffle(others)
    chosen = [first, *others[: int(rng.integers(0, 4))]]
    if target:
        wanted = catalogue.get(target)
        if wanted is None:
            raise ConfigError(f"scene random: no known object {target!r}; {choice_of(target, catalogue.labels)}")
        if wanted not in chosen:
            chosen[0] = wanted
    places = _places(rng, len(chosen), scale)
    objects = tuple(_object(known, place) for known, place in zip(chosen, places, strict=True))
    count = int(rng.integers(1, 3)) if rng.random() < 0.5 else 0
    obstacles: list[Obstacle] = []
    while len(obstacles) < count:
        obstacles.append(_obstacle(rng, places, obstacles, scale))
    light = Light(ambient=float(rng.uniform(0.45, 0.65)), temperature_k=float(rng.uniform(4500, 6500)))
    return Scene(name=NAME, objects=objects, obstacles=tuple(obstacles), light=light)


def room_scene(seed: int, target: str = "", catalogue: Catalogue | None = None, *, empty: bool = False) -> Scene:
    """Draw a room: 1 to 3 walls, and a known object that fits into the hand, 0.9 to 1.9 m away in any direction, behind
    a wall that hides it from the start.

    `empty`: the same walls without the object. `target`, if given, takes the place of the object that is drawn. Raises
    ConfigError for a target that is no known object.
    """
    rng = stream(seed, "room")
    catalogue = Catalogue.load() if catalogue is None else catalogue
    graspable = [known for known in catalogue.targets if known.graspable]
    chosen = graspable[int(rng.integers(len(graspable)))]
    if target and not empty:
        wanted = catalogue.get(target)
        if wanted is None:
            raise ConfigError(f"scene {ROOMS}: no known object {target!r}; {choice_of(target, catalogue.labels)}")
        chosen = wanted
    walls, place = draw_room(rng, chosen)
    light = Light(ambient=float(rng.uniform(0.45, 0.65)), temperature_k=float(rng.uniform(4500, 6500)))
    objects = () if empty else (_object(chosen, place),)
    return Scene(name=EMPTY if empty else ROOMS, objects=objects, obstacles=walls, light=light)


def find_scene(name_or_path: str, seed: int, target: str = "", objects: str = "", robot: Robot | None = None) -> Scene:
    """A random scene for the names `random`, `rooms` and `rooms-empty`, otherwise the scene that `load_scene` finds.
    `paper-scaled` and `random-scaled` are at the distances of the robot's arm. `objects` is the robot's file of known
    objects, '' the project's own. Raises ConfigError."""
    catalogue = Catalogue.load(Path(objects) if objects else None)
    if name_or_path in (NAME, NAME + SCALED):
        scale = 1.0 if name_or_path == NAME else scale_of(robot)
        return random_scene(seed, target, catalogue, scale=scale)
    if name_or_path == "paper" + SCALED:
        return nearer(load_scene("paper", seed, catalogue), scale_of(robot), catalogue)
    if name_or_path in (ROOMS, EMPTY):
        return room_scene(seed, target, catalogue, empty=name_or_path == EMPTY)
    return load_scene(name_or_path, seed, catalogue)


def _places(rng: np.random.Generator, count: int, scale: float) -> list[tuple[float, float]]:
    places: list[tuple[float, float]] = []
    while len(places) < count:
        distance, bearing = scale * rng.uniform(*DISTANCE_M), radians(rng.uniform(-BEARING_DEG, BEARING_DEG))
        place = (distance * cos(bearing), distance * sin(bearing))
        if all(hypot(place[0] - x, place[1] - y) >= APART_M for x, y in places):
            places.append(place)
    return places


def _object(known: ObjectSpec, place: tuple[float, float]) -> SceneObject:
    return SceneObject(
        label=known.label,
        shape=known.shape,
        radius_m=known.radius_m,
        height_m=known.height_m,
        size_m=known.box_m,
        mass_kg=known.mass_kg,
        rgb=known.rgb,
        position_m=place,
    )


def _obstacle(
    rng: np.random.Generator, objects: list[tuple[float, float]], others: list[Obstacle], scale: float
) -> Obstacle:
    for _ in range(_TRIES):
        distance, bearing = scale * rng.uniform(0.6, 1.8), radians(rng.uniform(-BEARING_DEG, BEARING_DEG))
        x, y = distance * cos(bearing), distance * sin(bearing)
        width, depth, height = (float(v) for v in rng.uniform((0.12, 0.12, 0.20), (0.35, 0.35, 0.60)))
        reach = hypot(width, depth) / 2
        clear = distance - reach >= _BY_ROBOT_M
        for ox, oy in objects:
            clear &= hypot(x - ox, y - oy) - reach >= _BESIDE_M
            clear &= _off_line((x, y), (ox, oy)) - reach >= _SIGHT_M
        for other in others:
            other_x, other_y = other.position_m
            clear &= hypot(x - other_x, y - other_y) >= 0.5
        if clear:
            grey = float(rng.uniform(0.35, 0.75))
            return Obstacle(
                shape="box",
                size_m=(width, depth, height),
                rgb=(grey, 0.9 * grey, 0.75 * grey),
                position_m=(x, y),
                yaw_rad=float(rng.uniform(-pi, pi)),
            )
    # Four objects around the robot may leave no room for a box; a thin post behind it always fits.
    return Obstacle(shape="cylinder", radius_m=0.05, height_m=0.4, rgb=(0.5, 0.45, 0.4), position_m=(-1.2, 0.0))


def _off_line(point: tuple[float, float], end: tuple[float, float]) -> float:
    """Distance of a point from the segment between the origin and `end`, m."""
    length2 = end[0] ** 2 + end[1] ** 2
    share = min(max((point[0] * end[0] + point[1] * end[1]) / length2, 0.0), 1.0)
    return hypot(point[0] - share * end[0], point[1] - share * end[1])
