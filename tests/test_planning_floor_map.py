"""The floor map: what moves leaves nothing behind, and what stands stays."""

from __future__ import annotations

import pytest
from depth_room import Room, box

from cocoro.frames import Pose2
from cocoro.messages import Obstacles
from services.planning.floor_map import FloorMap, Solid

SOMEBODY = box(1.5, 0.0, 0.35, 0.0, 1.7, depth=0.3)
WALL = box(2.8, 0.0, 3.0, 0.0, 2.0)
PLACE = (1.55, 0.0)


@pytest.mark.parametrize("behind", [[WALL], []], ids=["a wall behind", "nothing in range behind"])
@pytest.mark.parametrize("tilt", [0.0, -0.3])
def test_somebody_who_has_gone_is_forgotten_where_the_camera_looks(behind: list, tilt: float) -> None:  # type: ignore[type-arg]
    room = Room([SOMEBODY, *behind])
    room.look(2.0, tilt=tilt)
    assert room.occupied(PLACE) >= 4
    room.boxes.remove(SOMEBODY)
    room.look(3.0, tilt=tilt)
    assert room.occupied(PLACE) == 0


def test_nobody_is_forgotten_who_is_hidden_too_near_or_out_of_the_picture() -> None:
    room = Room([SOMEBODY, WALL])
    room.look(2.0)
    before = room.occupied(PLACE)
    screen = box(0.9, 0.0, 1.6, 0.0, 1.5)
    room.boxes.append(screen)
    room.look(3.0)
    assert room.occupied(PLACE) == before, "hidden by a screen"
    room.boxes = [SOMEBODY, WALL]
    room.look(3.0, pan=1.5)
    assert room.occupied(PLACE) == before, "beside the picture"
    room.look(3.0, body=Pose2(1.15))
    assert room.occupied(PLACE) >= before, "nearer than the camera measures"


@pytest.mark.parametrize(
    ("what", "near"),
    [
        (box(2.0, 0.0, 0.02, 0.0, 0.9, depth=0.02), (2.0, 0.0)),
        (box(1.6, 0.3, 0.6, 0.50, 0.52, depth=0.3), (1.75, 0.3)),
        (box(1.2, -0.2, 0.8, 0.0, 0.08, depth=0.3), (1.25, -0.2)),
    ],
    ids=["a post of 2 cm", "a board 0.5 m above the floor", "a step of 8 cm"],
)
def test_what_stands_stays_however_it_is_looked_at(what: object, near: tuple[float, float]) -> None:
    room = Room([what, WALL], noise=0.0015)  # type: ignore[list-item]
    room.look(2.0)
    before = room.occupied(near)
    assert before >= 1
    for turn in range(12):
        body = Pose2(0.02 * turn, 0.01 * (turn % 5), 0.03 * (turn % 7) - 0.1)
        room.look(0.4, pan=0.25 * (turn % 5 - 2), tilt=-0.15 * (turn % 6), body=body)
        assert room.occupied(near) >= max(before // 2, 1), f"look {turn}"


def test_a_board_stays_while_the_camera_sees_only_the_floor_below_it() -> None:
    room = Room([box(1.2, 0.0, 0.8, 0.55, 0.60, depth=0.4)])
    room.look(2.0, tilt=-0.2)
    before = room.occupied((1.3, 0.0))
    assert before >= 3
    room.look(5.0, tilt=-0.9)
    assert room.occupied((1.3, 0.0)) == before


def test_the_noise_of_far_floor_is_no_obstacle() -> None:
    room = Room([], noise=0.0015)
    for turn in range(20):
        room.look(0.4, pan=0.1 * (turn % 9 - 4), tilt=-0.1 - 0.05 * (turn % 4))
        assert room.occupied((0.0, 0.0), within_m=4.0) <= 2


def test_evidence_that_nothing_confirms_is_dropped_after_two_minutes_and_counts_as_not_seen() -> None:
    room = Room([SOMEBODY])
    room.look(2.0)
    before = room.occupied(PLACE)
    row, column = room.floor.cell(1.52, 0.0)  # type: ignore[misc]
    room.now_ns += 117 * 10**9
    room.look(0.2, pan=2.0)
    assert (room.occupied(PLACE), room.floor.looked_at()[row, column]) == (before, True)
    room.now_ns += 5 * 10**9
    room.look(0.2, pan=2.0)
    assert (room.occupied(PLACE), room.floor.looked_at()[row, column]) == (0, False)


def test_a_known_object_leaves_the_map_and_what_stands_beside_it_stays() -> None:
    ball = box(1.5, 0.0, 0.08, 0.66, 0.74, depth=0.08)
    pole = box(1.5, 0.3, 0.05, 0.0, 1.0, depth=0.05)
    room = Room([ball, pole, WALL])
    room.look(1.0, tilt=0.0)
    assert room.occupied((1.54, 0.0), within_m=0.12) >= 1, "not known yet"
    room.look(0.1, tilt=0.0, known=[Solid((1.54, 0.0, 0.70), 0.04, 0.08)])
    assert room.occupied((1.54, 0.0), within_m=0.12) == 0
    for tick in range(40):
        y = -0.02 * tick
        room.boxes[0] = box(1.5, y, 0.08, 0.66, 0.74, depth=0.08)
        room.look(0.1, tilt=0.0, known=[Solid((1.54, y, 0.70), 0.04, 0.08)])
    assert room.occupied((1.54, -0.4), within_m=0.5) == 0
    assert room.occupied((1.52, 0.3), within_m=0.1) >= 1


def test_a_wall_behind_a_known_object_is_no_part_of_it() -> None:
    can = box(1.4, 0.0, 0.066, 0.0, 0.12, depth=0.066)
    room = Room([can, box(1.5, 0.0, 2.0, 0.0, 0.5)])
    room.look(2.0, known=[Solid((1.433, 0.0, 0.06), 0.033, 0.12)])
    assert room.occupied((1.5, 0.0), within_m=0.06) >= 1


def test_what_the_bumper_touched_stays_for_20_s_where_the_camera_sees_nothing_but_floor() -> None:
    room = Room([WALL])
    room.look(0.2, tilt=-0.6)
    room.floor.bump([(1.02, 0.02)])
    room.look(19.0, tilt=-0.6)
    assert room.occupied((1.02, 0.02), within_m=0.1) == 1
    room.look(3.0, tilt=-0.6)
    assert room.occupied((1.02, 0.02), within_m=0.1) == 0


@pytest.mark.parametrize("height_m", [0.05, 0.35])
def test_what_held_up_the_hand_is_dropped_where_the_camera_looks_through_it(height_m: float) -> None:
    room = Room([WALL])
    room.look(0.2, tilt=-0.4)
    room.floor.bump([(1.32, 0.02)], height_m)
    room.look(1.0, pan=1.5)
    assert room.occupied((1.32, 0.02), within_m=0.1) == 1, "out of the picture"
    room.look(1.0, tilt=-0.4)
    assert room.occupied((1.32, 0.02), within_m=0.1) == 0


def test_what_held_up_the_hand_stays_where_something_is_seen_at_its_height() -> None:
    room = Room([box(1.3, 0.0, 0.4, 0.30, 0.40)])
    room.floor.bump([(1.32, 0.02)], 0.35)
    room.look(5.0, tilt=-0.4)
    assert room.occupied((1.32, 0.02), within_m=0.1) >= 1


@pytest.mark.parametrize("far_m", [1e4, 1e15, 1e300])
def test_a_ray_of_any_length_frees_the_map_to_its_edge_and_takes_no_memory_for_its_length(far_m: float) -> None:
    floors = [FloorMap(), FloorMap()]
    for floor, length_m in zip(floors, (30.0, far_m), strict=True):
        for _ in range(3):
            floor.enter(Obstacles(points_m=((1.5, 0.0, 0.2),), lowest_m=(0.01,)), Pose2(), None)
        assert floor.occupied().any()
        for _ in range(20):
            floor.enter(Obstacles(free=((0.0, 0.3, length_m),)), Pose2(), None)
    assert not floors[0].occupied().any()
    assert (floors[0].occupied() == floors[1].occupied()).all()
