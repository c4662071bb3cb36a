"""Positions that perception computes from rendered scenes, against the truth."""

from math import cos, radians, sin

import numpy as np
import pytest
from numpy.typing import NDArray
from perception_scenes import CATALOGUE, MS, ROBOT, STAMP_NS, Scene, Thing, block, error_mm, facing, known, seen, the

from services.perception.config import PerceptionConfig
from services.perception.image import ImageSighting
from services.perception.localise import Localiser, first_guesses
from services.perception.rays import Rays
from services.perception.shapes import Shapes, Solids
from sim.kinds import Sensors
from sim.scene import Light

pytestmark = pytest.mark.sim

GREY = (0.5, 0.5, 0.5)
CAN = "red_can"
AIMS = ((0.0, 0.0), (0.2, 0.1), (-0.25, -0.12))
"""Pan and tilt relative to the object, rad."""


def errors_mm(
    distance_m: float, sensors: Sensors, size: tuple[int, int] = (640, 480), label: str = CAN
) -> NDArray[np.float64]:
    """Horizontal and vertical errors of one object at a distance, mm, shape (n, 2), for three bearings and three aims
    of the head."""
    errors: list[tuple[float, float]] = []
    for number, bearing in enumerate((-0.4, 0.1, 0.6)):
        thing = known(label, distance_m * cos(bearing), distance_m * sin(bearing))
        pan, tilt = facing(thing)
        with Scene([thing], sensors, number, *size) as scene:
            for right, up in AIMS:
                frame = scene.frame(pan + right, tilt + up, STAMP_NS + 1000 * MS * len(errors))
                errors.append(error_mm(the(label, seen(frame, pan + right, tilt + up)), thing))
    return np.array(errors)


@pytest.mark.parametrize(
    ("distance_m", "sensors", "mean_mm", "most_mm"),
    [
        (0.6, "ideal", 1.0, 2.0),
        (0.75, "ideal", 1.0, 2.0),
        (1.0, "ideal", 1.0, 2.0),
        (1.5, "ideal", 1.5, 3.0),
        (2.0, "ideal", 2.0, 4.0),
        (3.0, "ideal", 5.0, 10.0),
        (0.6, "real", 1.0, 2.0),
        (0.75, "real", 1.0, 2.0),
        (1.0, "real", 1.5, 3.0),
        (1.5, "real", 3.0, 6.0),
        (2.0, "real", 5.0, 10.0),
        (3.0, "real", 15.0, 30.0),
    ],
)
def test_a_cans_centre_is_known_to_millimetres(
    distance_m: float, sensors: Sensors, mean_mm: float, most_mm: float
) -> None:
    errors = errors_mm(distance_m, sensors)
    assert errors[:, 0].mean() < mean_mm
    assert errors.max() < most_mm


@pytest.mark.parametrize(("distance_m", "most_mm"), [(0.75, 2.0), (1.5, 8.0), (3.0, 50.0)])
def test_a_quarter_of_the_pixels_costs_little(distance_m: float, most_mm: float) -> None:
    assert errors_mm(distance_m, "real", (320, 240)).max() < most_mm


@pytest.mark.parametrize("label", CATALOGUE.labels)
def test_every_known_object_is_located(label: str) -> None:
    assert errors_mm(0.9, "real", label=label).max() < 3.0


@pytest.mark.parametrize("light", [
    Light(ambient=0.3, diffuse=0.7, temperature_k=5500),
    Light(ambient=0.8, diffuse=0.2, temperature_k=4600),
    Light(ambient=0.5, diffuse=0.5, temperature_k=8000),
    Light(ambient=0.4, diffuse=0.6, direction=(1.0, 1.0, -0.3)),
], ids=["contrast", "warm", "cold", "low side light"])  # fmt: skip
def test_changing_light_leaves_all_objects_found_and_placed(light: Light) -> None:
    things = [
        known("red_can", 1.5, 0.0),
        known("green_can", 1.6, -0.5),
        known("blue_can", 1.0, 0.4),
        known("yellow_ball", 1.1, 0.1),
        known("blue_ball", 1.3, -0.15),
        known("hand_marker", 0.9, -0.1, 0.1),
    ]
    for seed in range(2):
        with Scene(things, "real", seed, light=light) as scene:
            detections = seen(scene.frame(0.0, -0.45), 0.0, -0.45)
        for thing in things:
            assert max(error_mm(the(thing.name, detections), thing)) < 6.0, thing.name


@pytest.mark.parametrize("speed_radps", [0.5, 1.0])
def test_a_turning_heads_motion_blur_leaves_a_near_can_in_place(speed_radps: float) -> None:
    can = known(CAN, 1.5, 0.1)
    pan, tilt = facing(can)
    with Scene([can], "real") as scene:
        scene.frame(pan - speed_radps / 30, tilt, STAMP_NS)
        frame = scene.frame(pan, tilt, STAMP_NS + 1_000_000_000 // 30)
    assert error_mm(the(CAN, seen(frame, pan, tilt)), can)[0] < 5.0


@pytest.mark.parametrize(("area_px", "is_told"), [(300, False), (2500, True)], ids=["a part", "whole"])
def test_what_seems_to_be_a_part_of_something_that_reaches_into_the_floor_is_no_such_thing(
    area_px: int, is_told: bool
) -> None:
    """The visible part of a can behind the arm may be as round as a ball."""
    localiser = Localiser(ROBOT, CATALOGUE, PerceptionConfig().occluded_share)
    camera = ROBOT.camera
    head_rad = np.array([0.3, -0.6])
    into_floor = np.linalg.inv(localiser.camera_pose(head_rad)) @ [1.05, 0.35, -0.07, 1.0]
    x, y, z, _ = into_floor.tolist()
    u, v = x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy
    sighting = ImageSighting("blue_ball", u, v, area_px, (0, 0, 30, 30), z, hidden=True)
    assert bool(localiser.locate([sighting], camera, head_rad)) == is_told


# --- hidden in part -------------------------------------------------------------------------------

NEAR = known(CAN, 0.75, 0.0)


@pytest.mark.parametrize("size", [(640, 480), (320, 240)], ids=["640x480", "320x240"])
@pytest.mark.parametrize(
    "cover",
    [
        block(0.68, -0.03, 0.05, (0.02, 0.04, 0.10), GREY),
        block(0.68, 0.03, 0.05, (0.02, 0.04, 0.10), GREY),
        block(0.62, 0.05, 0.10, (0.02, 0.10, 0.20), GREY),
        block(0.62, -0.05, 0.10, (0.02, 0.10, 0.20), GREY),
        block(0.62, 0.00, 0.06, (0.02, 0.20, 0.12), GREY),
        block(0.62, 0.00, 0.17, (0.02, 0.30, 0.02), GREY),
    ],
    ids=["right finger", "left finger", "left half", "right half", "bottom", "bar across"],
)
def test_a_body_before_the_can_does_not_move_its_axis(cover: Thing, size: tuple[int, int]) -> None:
    pan, tilt = 0.0, -0.7
    with Scene([NEAR], "real", 1, *size) as scene:
        free = the(CAN, seen(scene.frame(pan, tilt), pan, tilt))
    with Scene([NEAR, cover], "real", 1, *size) as scene:
        hidden = the(CAN, seen(scene.frame(pan, tilt), pan, tilt))
    assert hidden.area_px < 0.9 * free.area_px
    assert abs(hidden.u_px - free.u_px) + abs(hidden.v_px - free.v_px) > 1.0  # the visible centroid moves
    assert error_mm(hidden, NEAR)[0] < 4.0


def test_the_papers_way_moves_where_the_shape_fit_does_not() -> None:
    cover = block(0.62, 0.05, 0.10, (0.02, 0.10, 0.20), GREY)
    with Scene([NEAR, cover]) as scene:
        frame = scene.frame(0.0, -0.7)
    plain = error_mm(the(CAN, seen(frame, 0.0, -0.7, detector="paper")), NEAR)[0]
    fitted = error_mm(the(CAN, seen(frame, 0.0, -0.7)), NEAR)[0]
    assert plain > 10.0
    assert fitted < 2.0


def test_an_object_cut_by_the_images_edge_is_placed_by_what_is_left() -> None:
    pan, tilt = 0.0, -0.42
    with Scene([NEAR], "real") as scene:
        found = the(CAN, seen(scene.frame(pan, tilt), pan, tilt))
    assert found.note == "cut"
    assert error_mm(found, NEAR)[0] < 4.0


# --- what else has its colour ---------------------------------------------------------------------

RED = CATALOGUE[CAN].rgb


@pytest.mark.parametrize(
    "other",
    [
        block(1.0, -0.3, 0.02, (0.03, 0.03, 0.04), RED),
        block(1.8, -0.4, 0.30, (0.02, 0.05, 0.05), RED),
        block(1.8, 0.0, 0.30, (0.05, 1.50, 0.60), RED),
        block(1.2, -0.4, 0.15, (0.30, 0.30, 0.30), RED),
    ],
    ids=["small block", "patch in the air", "wall behind", "large box"],
)
def test_other_red_things_do_not_draw_the_can_away(other: Thing) -> None:
    can = known(CAN, 1.2, 0.1)
    with Scene([can, other], "real") as scene:
        found = the(CAN, seen(scene.frame(0.0, -0.45), 0.0, -0.45))
    assert max(error_mm(found, can)) < 3.0


def test_a_red_patch_alone_is_no_can() -> None:
    with Scene([block(1.8, -0.4, 0.3, (0.02, 0.05, 0.05), RED)], "real") as scene:
        assert seen(scene.frame(0.0, -0.45), 0.0, -0.45).detections == ()


# --- one colour, two shapes ------------------------------------------------------------------------

BLUE = CATALOGUE["blue_can"].rgb


def blue_ball(x: float, y: float, z: float = 0.04) -> Thing:
    """A ball of the blue can's colour."""
    return Thing("blue_ball", "sphere", (0.04,), BLUE, (x, y, z))


@pytest.mark.parametrize("sensors", ["ideal", "real"])
@pytest.mark.parametrize("distance_m", [0.6, 1.0, 1.5, 2.0])
def test_a_ball_as_blue_as_the_can_is_known_by_its_shape(distance_m: float, sensors: Sensors) -> None:
    for number, thing in enumerate(
        (blue_ball(distance_m, 0.1), blue_ball(distance_m, 0.1, 0.7), known("blue_can", distance_m, 0.1))
    ):
        pan, tilt = facing(thing)
        with Scene([thing], sensors, number) as scene:
            detections = seen(scene.frame(pan, tilt), pan, tilt)
        assert [d.label for d in detections.detections] == [thing.name]
        assert error_mm(the(thing.name, detections), thing)[0] < 2.0 + 3.0 * distance_m**2


def test_side_by_side_each_keeps_its_name() -> None:
    things = [blue_ball(1.2, -0.2), known("blue_can", 1.2, 0.2)]
    with Scene(things, "real") as scene:
        detections = seen(scene.frame(0.0, -0.5), 0.0, -0.5)
    for thing in things:
        assert max(error_mm(the(thing.name, detections), thing)) < 4.0


@pytest.mark.parametrize("left_m", [0.05, 0.04, 0.03])
def test_a_half_hidden_can_is_not_taken_for_a_ball(left_m: float) -> None:
    can = known("blue_can", 0.75, 0.0)
    cover = block(0.62, left_m, 0.10, (0.02, 0.10, 0.20), GREY)
    with Scene([can, cover], "real") as scene:
        detections = seen(scene.frame(0.0, -0.7), 0.0, -0.7)
    assert [d.label for d in detections.detections] == ["blue_can"]
    assert error_mm(the("blue_can", detections), can)[0] < 4.0


# --- the shapes themselves ------------------------------------------------------------------------


def offsets_from_centre(points: NDArray[np.float64]) -> NDArray[np.float32]:
    """Points (k, 3) as offsets of one object, shape (3, 1, k)."""
    return points.T[:, None, :].astype(np.float32)


@pytest.mark.parametrize("label", ["red_can", "yellow_ball"])
def test_distances_are_zero_on_the_surface_and_grow_by_the_metre_outwards(label: str) -> None:
    surface = Solids(Shapes([CATALOGUE[label]]))
    points = offsets_from_centre(np.random.default_rng(3).uniform(-0.2, 0.2, (500, 3)))
    distance, gradient = surface.gradient(points)
    np.testing.assert_allclose(distance, surface.distance(points), atol=1e-6)
    np.testing.assert_allclose(np.linalg.norm(gradient, axis=0), 1.0, atol=1e-5)
    np.testing.assert_allclose(surface.distance(points - distance * gradient), 0.0, atol=1e-6)


def test_a_can_is_inside_within_its_radius_and_half_height() -> None:
    surface = Solids(Shapes([CATALOGUE[CAN]]))
    inside = np.array([[0.0, 0.0, 0.0], [0.03, 0.0, 0.0], [0.0, 0.0, 0.055], [0.0, 0.032, -0.059]])
    outside = np.array([[0.034, 0.0, 0.0], [0.0, 0.0, 0.061], [0.03, 0.03, 0.0]])
    assert (surface.distance(offsets_from_centre(inside)) < 0).all()
    assert (surface.distance(offsets_from_centre(outside)) > 0).all()
    corner = offsets_from_centre(np.array([[0.043, 0.0, 0.06 + 0.01]]))
    assert surface.distance(corner).item() == pytest.approx(np.hypot(0.01, 0.01), abs=1e-6)


@pytest.mark.parametrize("label", ["red_can", "yellow_ball"])
def test_where_a_ray_is_deepest_in_a_shape_is_where_small_steps_along_it_find_it(label: str) -> None:
    draws = np.random.default_rng(5)
    surface = Solids(Shapes([CATALOGUE[label]]))
    camera = np.array([-1.0, 0.2, 0.4])
    aims = draws.uniform(-0.05, 0.05, (400, 3)) - camera
    free_to = np.full((1, 400), np.inf, dtype=np.float32)
    free_to[0, ::4] = draws.uniform(0.9, 1.1, 100)
    directions, eye = offsets_from_centre(aims), offsets_from_centre(camera[None])
    found = surface.distance(Rays(surface, directions, free_to).nearest(eye))[0]
    steps = np.minimum(np.linspace(0.8, 1.2, 4001)[:, None], free_to)
    along = [surface.distance((eye + step * directions).astype(np.float32))[0] for step in steps]
    deepest = np.min(along, axis=0)
    meets = deepest < 0
    assert 100 < np.count_nonzero(meets) < 390
    np.testing.assert_allclose(found[meets], deepest[meets], atol=1e-4)  # the length of a step
    assert (found[~meets] > 0).all()
    assert (found[~meets] < 1.5 * deepest[~meets] + 1e-4).mean() > 0.9


def test_the_first_guess_pushes_the_surface_inwards_by_the_radius() -> None:
    pose = ROBOT.chain("camera").pose({"neck_pan": 0.0, "neck_tilt": radians(-50)})
    surface = np.array([[0.0, 0.0, 0.7]] * 2)
    points = surface @ pose[:3, :3].T + pose[:3, 3]
    can, ball = first_guesses(Shapes([CATALOGUE[CAN], CATALOGUE["yellow_ball"]]), surface, pose) - points
    assert can == pytest.approx([0.033, 0.0, 0.0], abs=1e-9)
    assert ball == pytest.approx(0.03 * pose[:3, 2], abs=1e-9)
