"""The floor that was seen by the truth, and the random rooms that hide their object."""

from __future__ import annotations

from math import cos, pi, sin

import numpy as np
import pytest

from cocoro.errors import ConfigError
from cocoro.messages import TrueObject, Truth
from cocoro.robot import Robot
from sim.coverage import Coverage, CoverageJudge
from sim.random_scene import find_scene
from sim.scene import Obstacle, Scene

ROBOT = Robot.load()
NS = 1_000_000_000
UPRIGHT = (0.0, 0.0, 0.0, 1.0)
TURNS = tuple((0.0, 0.0, sin(turn / 2), cos(turn / 2)) for turn in (0.0, pi / 2, pi, -pi / 2))


def judged(*walls: Obstacle, places: tuple[tuple[float, float], ...] = ((0.0, 0.0),)) -> Coverage:
    """Coverage of a room seen from some places, at each with the head all around and the body in four directions."""
    judge = CoverageJudge(ROBOT, Scene(name="room", obstacles=walls), 1.5)
    objects = tuple(
        TrueObject(label=f"obstacle_{n}", kind="obstacle", position_m=wall.centre_m, orientation=UPRIGHT, touching=())
        for n, wall in enumerate(walls, 1)
    )
    stamp_ns = 0
    for x, y in places:
        for orientation in TURNS:
            for tilt in (-0.3, -0.7, -1.1):
                for pan in np.linspace(-2.6, 2.6, 9):
                    stamp_ns += NS
                    joints = dict.fromkeys(ROBOT.joints, 0.0) | {"neck_pan": float(pan), "neck_tilt": tilt}
                    judge.feed(
                        Truth(
                            stamp_ns=stamp_ns,
                            body_m=(x, y, 0.0),
                            body_orientation=orientation,
                            joints_rad=joints,
                            objects=objects,
                        )
                    )
    result = judge.result()
    assert result is not None
    return result


def wall(x: float, y: float, size: tuple[float, float, float]) -> Obstacle:
    return Obstacle(shape="box", size_m=size, position_m=(x, y))


def test_an_empty_room_is_seen_from_where_the_robot_stands_when_it_turns_round() -> None:
    result = judged()
    assert (result.seen, result.missed, result.unseeable) == (result.cells, 0, 0)


def test_floor_behind_a_wall_is_missed_until_it_is_looked_at_from_there() -> None:
    hidden = judged(wall(0.8, 0.0, (0.1, 0.8, 0.8)))
    assert hidden.missed > 50
    assert 50 < hidden.hiding <= hidden.missed
    assert all(x > 0.7 for x, _ in hidden.missed_at_m)
    assert judged(wall(0.8, 0.0, (0.1, 0.8, 0.8)), places=((0.0, 0.0), (1.2, 0.9), (1.2, -0.9))).missed == 0


def test_floor_inside_of_closed_walls_cannot_be_seen_and_is_told_apart() -> None:
    box = (
        wall(0.9, 0.3, (0.7, 0.1, 1.5)),
        wall(0.9, -0.3, (0.7, 0.1, 1.5)),
        wall(0.6, 0.0, (0.1, 0.5, 1.5)),
        wall(1.2, 0.0, (0.1, 0.5, 1.5)),
    )
    result = judged(*box, places=((0.0, 0.0), (0.9, 1.0), (0.9, -1.0), (1.8, 0.0)))
    assert 60 < result.unseeable < 140
    assert result.missed == 0


def test_a_room_hides_its_object_from_the_start_and_the_seed_draws_it_again() -> None:
    for seed in range(6):
        room = find_scene("rooms", seed)
        assert room == find_scene("rooms", seed)
        assert 1 <= len(room.obstacles) <= 3
        assert all(0.6 <= item.dimensions_m[0] <= 1.5 for item in room.obstacles)
        empty = find_scene("rooms-empty", seed)
        assert (empty.objects, empty.obstacles) == ((), room.obstacles)
        x, y = room.objects[0].position_m[:2]
        turned = tuple(
            TrueObject(
                label=f"obstacle_{n}",
                kind="obstacle",
                position_m=item.centre_m,
                orientation=(0.0, 0.0, float(np.sin(item.yaw_rad / 2)), float(np.cos(item.yaw_rad / 2))),
                touching=(),
            )
            for n, item in enumerate(room.obstacles, 1)
        )
        start = Truth(body_m=(0.0, 0.0, 0.0), body_orientation=UPRIGHT, joints_rad={}, objects=turned)
        judge = CoverageJudge(ROBOT, room, 2.0)
        assert judge._hidden(start, np.array([0.0, 0.0, 0.73]), np.array([[x, y, 0.0], [x, y, 0.06]])).all()


def test_a_room_has_the_wanted_object_or_none_that_is_unknown() -> None:
    assert find_scene("rooms", 3, "blue_can").objects[0].label == "blue_can"
    with pytest.raises(ConfigError, match="no known object 'blue_cann'"):
        find_scene("rooms", 3, "blue_cann")
