"""A search: the floor that counts as seen, the places from which it sees the rest, and its report."""

from __future__ import annotations

from math import hypot
from types import SimpleNamespace
from typing import Any

import numpy as np
from depth_room import Box, Room, box

from cocoro.arrays import FloatArray
from cocoro.frames import Pose2
from cocoro.messages.actions import Explore
from services.planning.behaviours.looking import Exploring
from services.planning.config import PlanningConfig
from services.planning.seen_floor import describe
from services.planning.surroundings import Surroundings

PANS = np.linspace(-2.6, 2.6, 7)
TILTS = (-0.30, -0.92)
WALL = box(0.9, 0.0, 1.2, 0.0, 0.8)


def searching(boxes: list[Box]) -> Room:
    """A room in which a search has begun, and the robot has looked all around."""
    room = Room(boxes)
    room.seen.begin(Pose2())
    look_around(room, Pose2())
    return room


def look_around(room: Room, body: Pose2) -> None:
    room.seen.stand_at(body)
    for tilt in TILTS:
        for pan in PANS:
            room.look(0.2, float(pan), tilt, body)
    room.seen.looked_from(body, room.floor, ())


def counted(room: Room, place: tuple[float, float]) -> bool:
    """Whether the floor at a place is no longer to be seen."""
    seen = room.seen
    row, column = divmod(int(seen._flat(np.array([place[0]]), np.array([place[1]]))[0]), 160)
    return not seen.unseen(room.floor, ())[row, column]


def test_floor_behind_a_wall_was_not_seen_and_floor_beside_it_was() -> None:
    room = searching([WALL])
    assert counted(room, (0.6, 0.0))
    assert counted(room, (1.2, 1.1))
    assert not counted(room, (1.4, 0.0))
    patches = room.seen.rest(room.floor, ()).patches
    assert any(hypot(x - 1.5, y) < 0.2 and area > 0.8 for area, x, y in patches)
    assert describe(room.seen.rest(room.floor, ()), Pose2()).split(",")[0].endswith("ahead")


def test_floor_beyond_a_low_thing_was_seen_except_in_its_shadow() -> None:
    room = searching([box(0.9, 0.0, 0.3, 0.0, 0.15)])
    assert counted(room, (1.6, 0.0))
    assert not counted(room, (1.16, 0.0))


def test_what_the_camera_passes_quickly_was_not_seen() -> None:
    room = Room([])
    room.seen.begin(Pose2())
    room.look(1.0, turning_radps=2.0)
    assert not counted(room, (1.2, 0.0))
    room.look(1.0)
    assert counted(room, (1.2, 0.0))


def test_floor_behind_the_mount_is_not_shown_until_the_robot_has_turned() -> None:
    room = Room([])
    room.seen.begin(Pose2())
    behind = room.seen._flat(np.array([-0.4]), np.array([0.0]))[0]
    assert room.seen.visible((0.0, 0.0), room.floor, ()).reshape(-1)[behind]
    assert not room.seen.shown(Pose2(), room.floor, ()).reshape(-1)[behind]
    assert room.seen.shown(Pose2(0.0, 0.0, 3.1), room.floor, ()).reshape(-1)[behind]


def costs(room: Room, body: Pose2) -> FloatArray:
    around = Surroundings("hand_marker")
    around.floor = room.floor
    return around.routes(around.fields("", (), room.now_ns).body, body, 0.215, 0.45).costs()


def test_going_from_place_to_place_all_floor_is_seen_in_the_end() -> None:
    room, body = searching([WALL]), Pose2()
    for _looks in range(12):
        view = room.seen.viewpoint(body, costs(room, body), room.floor, ())
        if view is None:
            break
        x, y = view.place_m
        assert hypot(x, y) <= 2.3
        turn = np.arctan2(view.middle_m[1] - y, view.middle_m[0] - x)
        body = Pose2(x, y, float(turn))
        look_around(room, body)
    rest = room.seen.rest(room.floor, ())
    assert view is None
    assert (rest.patches, rest.enclosed_m2) == ((), 0.0)


def test_each_side_of_a_wall_is_looked_at_from_that_side() -> None:
    room, body = searching([box(0.7, 0.0, 0.5, 0.0, 0.10, 0.05)]), Pose2()
    behind = [(0.875, y) for y in np.arange(-0.2, 0.21, 0.05)]
    assert all(counted(room, place) for place in behind), "over the wall the floor was seen"
    places = []
    for _looks in range(6):
        view = room.seen.viewpoint(body, costs(room, body), room.floor, ())
        if view is None:
            break
        x, y = view.place_m
        places.append(view.place_m)
        body = Pose2(x, y, float(np.arctan2(view.middle_m[1] - y, view.middle_m[0] - x)))
        look_around(room, body)
    assert view is None
    assert any(x > 0.75 for x, _ in places)


def test_a_foot_that_no_place_shows_is_told() -> None:
    room = searching([box(0.7, 0.0, 0.5, 0.0, 0.10, 0.05)])
    too_far = Pose2(-3.0, 0.0)
    assert room.seen.viewpoint(too_far, np.full((160, 160), np.inf), room.floor, ()) is None
    assert any(x > 0.75 and abs(y) < 0.3 for _, x, y in room.seen.rest(room.floor, ()).patches)


def test_floor_that_walls_enclose_is_told_apart() -> None:
    tall = 0.85
    walls = [
        box(1.0, 0.0, 0.8, 0.0, tall, 0.1),
        box(1.6, 0.0, 0.8, 0.0, tall, 0.1),
        box(1.0, 0.35, 0.1, 0.0, tall, 0.7),
        box(1.0, -0.35, 0.1, 0.0, tall, 0.7),
    ]
    room = searching(walls)
    for body in (Pose2(1.3, 1.3, -1.57), Pose2(2.3, 0.0, 3.1), Pose2(1.3, -1.3, 1.57)):
        look_around(room, body)
    rest = room.seen.rest(room.floor, ())
    assert 0.02 < rest.enclosed_m2 < 0.3
    assert all(hypot(x - 1.3, y) > 0.4 for _, x, y in rest.patches)


def test_a_second_search_of_a_task_begins_anew_about_the_same_place() -> None:
    room = Room([])
    room.seen.begin(Pose2())
    room.look(0.3)
    room.seen.end("")
    room.seen.begin(Pose2(1.0, 0.0))
    assert not counted(room, (1.2, 0.0))
    assert counted(room, (2.5, 0.0)), "the radius counts from where the task began"


def test_a_robot_that_did_not_know_its_place_does_not_say_that_it_saw_every_place() -> None:
    room = Room([])
    snapshot: Any = SimpleNamespace(
        estimator=SimpleNamespace(seen=room.seen),
        actuators=SimpleNamespace(config=PlanningConfig()),
        stands_around=(room.floor, ()),
        body=Pose2(),
    )
    exploring = Exploring(Explore(label="red_can"))
    for doubt_m in (0.3, 0.1):
        room.doubt_m = doubt_m
        room.seen.begin(Pose2())
        for body in (Pose2(), Pose2(1.0, 0.0, 3.1), Pose2(-1.0, 0.0, 0.0)):
            look_around(room, body)
        said = exploring._nothing_left(snapshot)
        assert said.startswith("every place within 2.0 m where red_can could stand was seen") == (doubt_m < 0.25)
        assert ("knew its place only to 0.6 m" in said) == (doubt_m > 0.25)


def test_a_doubt_about_floor_beyond_the_radius_does_not_count() -> None:
    room = Room([])
    room.seen.begin(Pose2())
    room.doubt_m = 0.5
    room.look(0.3, body=Pose2(1.9, 0.0, 0.0))
    assert counted(room, (3.0, 0.0))
    assert room.seen.doubt_m(room.floor, ()) == 0.0


def test_floor_that_is_seen_again_from_a_place_better_known_is_less_in_doubt() -> None:
    room = Room([])
    room.seen.begin(Pose2())
    for doubt_m, expected_m in ((0.3, 0.3), (0.1, 0.1), (0.5, 0.1)):
        room.doubt_m = doubt_m
        room.look(0.3, 0.0, -0.6)
        assert room.seen.doubt_m(room.floor, ()) == expected_m
    room.look(0.3, 1.5, -0.6)
    assert room.seen.doubt_m(room.floor, ()) == 0.5
