"""Contacts: PyBullet's contact points by the names of the description and the scene."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from math import atan2, degrees
from typing import Any

import numpy as np

from cocoro.arrays import FloatArray
from sim.base import Bumper
from sim.body import CHASSIS
from sim.stage import FLOOR

BUMPER_HALF_DEG = 90.0
"""The bumper covers the front half of the chassis."""
BUMPER_OVERLAP_DEG = 20.0
"""A contact within this angle of straight ahead closes both switches."""

ContactPair = tuple[str, str]


def touching_pairs(
    points: Iterable[tuple[Any, ...]], robot_body: int, link_names: Mapping[int, str], names: Mapping[int, str]
) -> tuple[frozenset[ContactPair], list[tuple[float, float, float]]]:
    """Pairs of names in contact, and the world points (m) at which something touches the chassis.

    A robot link comes first in a pair; of two links, the one further from the root. Only contacts with a force count,
    not bodies that are merely near.
    """
    pairs: set[ContactPair] = set()
    on_chassis: list[tuple[float, float, float]] = []
    for point in points:
        if point[9] <= 0.0:
            continue
        (body_a, body_b), (link_a, link_b) = point[1:3], point[3:5]
        one = link_names[link_a] if body_a == robot_body else names[body_a]
        other = link_names[link_b] if body_b == robot_body else names[body_b]
        if body_b == robot_body and (body_a != robot_body or link_a < link_b):
            one, other = other, one
        pairs.add((one, other))
        if body_a != body_b and one == CHASSIS and other != FLOOR:
            on_chassis.append(point[5])
    return frozenset(pairs), on_chassis


def bumper(points_m: Iterable[tuple[float, float, float]], body_pose: FloatArray) -> Bumper:
    """The bumper's switches that these contact points on the chassis close. `points_m`: world points; `body_pose`: (4,
    4)."""
    left = right = False
    for point in points_m:
        x, y, _ = body_pose[:3, :3].T @ (np.array(point) - body_pose[:3, 3])
        bearing_deg = degrees(atan2(y, x))
        if abs(bearing_deg) <= BUMPER_HALF_DEG:
            left |= bearing_deg >= -BUMPER_OVERLAP_DEG
            right |= bearing_deg <= BUMPER_OVERLAP_DEG
    return Bumper(left, right)


def collisions(
    pairs: Iterable[ContactPair],
    links: frozenset[str],
    rolling: frozenset[str],
    claws: frozenset[str],
    objects: frozenset[str],
) -> tuple[str, ...]:
    """Unwanted contacts of the robot as 'link~other', sorted: all except wheels and casters on the floor, claws on an
    object, and the claws on each other."""
    return tuple(
        sorted(
            f"{one}~{other}"
            for one, other in pairs
            if one in links
            and not (one in rolling and other == FLOOR)
            and not (one in claws and (other in objects or other in claws))
        )
    )
