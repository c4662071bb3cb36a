"""The renderers: exact geometry, and light."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pictures import (
    BLUE_BOX,
    CAMERA,
    GREEN_BALL,
    PLACES,
    POSES,
    ROBOT,
    Lamp,
    at,
    floor_depth,
    gl_renderer,
    head,
    look,
    pixel_of,
    reddish,
)

from cocoro.arrays import FloatArray
from cocoro.objects import Catalogue
from sim.camera import moved
from sim.render import Images, Renderer, make_renderer
from sim.render import gl as gl_module
from sim.render.interface import Visual
from sim.render.room import FLOOR_RGB, OTHER_TILE_RGB, nearest_wall_m, walls
from sim.render.views import lamp_tint

pytestmark = pytest.mark.sim

# --- geometry -------------------------------------------------------------------------------------


def test_a_pixel_shows_what_its_ray_hits(renderer: Renderer) -> None:
    depth_pose = moved(head(), np.array(ROBOT.eye.depth_offset_m))
    expected = floor_depth(CAMERA, depth_pose)
    error = np.abs(look(renderer).depth_m - expected)
    bare = np.zeros(error.shape, bool)
    bare[170:, 110:130] = True  # floor alone, from near to far
    bare[60:75, 230:300] = True
    assert expected[bare].min() < 1.0
    assert expected[bare].max() > 1.8
    assert error[bare].max() < 2e-4


def test_scaling_a_camera_keeps_the_rays_of_its_edges() -> None:
    full, half = ROBOT.camera, ROBOT.camera.scaled(320, 240)
    assert full.cx == pytest.approx(319.5)
    np.testing.assert_allclose(full.ray(-0.5, -0.5), half.ray(-0.5, -0.5))
    np.testing.assert_allclose(full.ray(639.5, 479.5), half.ray(319.5, 239.5))
    np.testing.assert_allclose(full.ray(0.5, 0.5), half.ray(0, 0))  # one pixel covers two of the other


def test_a_can_straight_ahead_is_in_the_middle_and_stands_on_the_floor(renderer: Renderer) -> None:
    v, u = np.nonzero(reddish(look(renderer).colour))
    assert u.mean() == pytest.approx(CAMERA.cx, abs=0.5)
    bottom = pixel_of((1.5 - 0.033, 0.0, 0.0), head())[1]
    top = pixel_of((1.5 + 0.033, 0.0, 0.12), head())[1]
    assert v.max() == pytest.approx(bottom, abs=1.0)
    assert v.min() == pytest.approx(top, abs=1.0)
    left, right = (pixel_of((1.5, side, 0.06), head())[0] for side in (0.033, -0.033))
    assert u.max() - u.min() + 1 == pytest.approx(right - left, abs=1.0)


def test_left_is_left_and_near_is_low(renderer: Renderer) -> None:
    colour = look(renderer).colour.astype(int)
    blue_v, blue_u = np.nonzero(colour[..., 2] > 2 * colour[..., 0] + 20)
    green_v, green_u = np.nonzero(colour[..., 1] > 2 * colour[..., 0] + 20)
    assert blue_u.mean() < CAMERA.cx - 30 < CAMERA.cx + 30 < green_u.mean()  # y = +0.4 is to the left
    assert green_v.mean() > blue_v.mean()


def test_the_depth_camera_sees_from_its_own_place(gl: Renderer) -> None:
    images = look(gl)
    _, red_u = np.nonzero(reddish(images.colour))
    row = round(pixel_of((1.5, 0.0, 0.09), head())[1])
    floor = floor_depth(CAMERA, head())[row]
    _, depth_u = np.nonzero((np.abs(images.depth_m[[row]] - floor) > 0.05)[:, 100:220])
    # The depth camera is 25 mm to the left of the colour camera, so the can is further right in its image.
    shift_px = CAMERA.fx * 0.025 / images.depth_m[row, 160]
    assert depth_u.mean() + 100 - red_u.mean() == pytest.approx(shift_px, abs=0.6)


def test_the_surface_is_where_the_primitive_ends(renderer: Renderer) -> None:
    pose = head()
    for visual, place, toward in ((BLUE_BOX, PLACES[1], 0.1), (GREEN_BALL, PLACES[2], 0.05)):
        depth_pose = moved(pose, np.array(ROBOT.eye.depth_offset_m))
        centre = np.array(place)
        if visual.shape == "box":
            surface = centre - [toward, 0.0, 0.0]
        else:
            outward = depth_pose[:3, 3] - centre
            surface = centre + toward * outward / np.linalg.norm(outward)
        u, v = pixel_of(tuple(surface), depth_pose)
        seen = look(renderer).depth_m[round(v), round(u)]
        assert seen == pytest.approx((np.linalg.inv(depth_pose) @ [*surface, 1.0])[2], abs=2e-3)


def test_where_there_is_nothing_depth_is_infinite(renderer: Renderer) -> None:
    outside = head(tilt_rad=0.0)
    outside[:3, 3] += [20.0, 0.0, 0.0]  # out of the room, looking away from it
    assert np.isinf(look(renderer, outside).depth_m[: CAMERA.height // 2]).all()


def test_a_visual_that_moves_moves_in_the_picture(renderer: Renderer) -> None:
    poses = POSES.copy()
    poses[0, 1, 3] = 0.2
    _, before = np.nonzero(reddish(look(renderer).colour))
    _, after = np.nonzero(reddish(look(renderer, poses=poses).colour))
    expected = pixel_of((1.5, 0.2, 0.06), head())[0] - pixel_of((1.5, 0.0, 0.06), head())[0]
    assert after.mean() - before.mean() == pytest.approx(expected, abs=0.5)


def test_a_turned_box_shows_its_long_side(gl: Renderer) -> None:
    poses = POSES.copy()
    poses[1, :3, :3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]

    def width_px(images: Images) -> int:
        _, u = np.nonzero(images.colour[..., 2].astype(int) > 2 * images.colour[..., 0].astype(int) + 20)
        return int(np.ptp(u))

    assert width_px(look(gl)) > 1.2 * width_px(look(gl, poses=poses))


def test_a_size_that_does_not_fit_the_shape_is_refused() -> None:
    with pytest.raises(ValueError, match=r"'wrong'.*cylinder"):
        make_renderer([Visual("wrong", "cylinder", (1.0,), (0, 0, 0))], CAMERA, "tiny")


def test_an_empty_world_is_a_room(renderer: Renderer) -> None:
    empty = make_renderer([], CAMERA, "tiny") if renderer.name == "tiny" else gl_renderer([])
    images = look(empty, poses=np.empty((0, 4, 4)), projector=True)
    empty.close()
    spread = images.colour.astype(int).max(axis=2) - images.colour.astype(int).min(axis=2)
    assert spread.max() < 10  # greys only
    assert (images.depth_m > 0).all()


# --- light ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("direction", [(x, y, -1.0) for x in (-0.6, 0.6) for y in (-0.6, 0.6)])
def test_a_shadow_falls_where_the_light_goes(gl: Renderer, direction: tuple[float, float, float]) -> None:
    poses = POSES.copy()
    poses[2] = at(1.2, -0.2, 0.25)  # the ball in the air, so that it hides no place of the floor
    there = (1.2 + 0.25 * direction[0], -0.2 + 0.25 * direction[1], 0.0)
    opposite = (1.2 - 0.25 * direction[0], -0.2 - 0.25 * direction[1], 0.0)
    down = head(tilt_rad=-0.7, pan_rad=-0.2)
    picture = look(gl, down, poses=poses, light=Lamp(direction=direction)).colour.astype(int)
    shaded, lit = (picture[round(v), round(u)].sum() for u, v in (pixel_of(there, down), pixel_of(opposite, down)))
    assert shaded < 0.8 * lit


def test_beyond_the_shadow_map_all_is_lit(gl: Renderer) -> None:
    far = look(gl, head(tilt_rad=-0.2)).colour[60:110].astype(int)
    near = look(gl, head(tilt_rad=-0.2)).colour[200:].astype(int)
    assert far.mean() == pytest.approx(near.mean(), rel=0.08)


def test_a_warm_lamp_makes_warm_pictures(renderer: Renderer) -> None:
    warm = look(renderer, light=Lamp(temperature_k=3500.0)).colour[-40:].mean(axis=(0, 1))
    white = look(renderer, light=Lamp(temperature_k=6500.0)).colour[-40:].mean(axis=(0, 1))
    cold = look(renderer, light=Lamp(temperature_k=9000.0)).colour[-40:].mean(axis=(0, 1))
    assert warm[0] / warm[2] > 1.3 * white[0] / white[2]
    assert cold[0] / cold[2] < white[0] / white[2]
    np.testing.assert_allclose(lamp_tint(6500.0), 1.0)


def test_half_the_light_is_half_as_bright(renderer: Renderer) -> None:
    full = look(renderer, light=Lamp(0.5, 0.4)).colour[-40:].mean()
    half = look(renderer, light=Lamp(0.25, 0.2)).colour[-40:].mean()
    assert half == pytest.approx(full / 2, rel=0.03)


def test_nothing_in_the_room_has_the_colour_of_a_known_object() -> None:
    boxes = [(np.array(box.low), np.array(box.high)) for known in Catalogue.load() for box in known.lab]
    greys = [FLOOR_RGB, OTHER_TILE_RGB, *(visual.rgb for visual, _ in walls())]
    for temperature_k in (3000.0, 4300.0, 5500.0, 6500.0, 8000.0):
        for light in np.linspace(0.2, 1.2, 11):
            for grey in greys:
                lab = to_lab(np.clip(np.array(grey) * light * lamp_tint(temperature_k), 0, 1))
                assert not any(((low <= lab) & (lab <= high)).all() for low, high in boxes), (grey, lab)


def to_lab(rgb: FloatArray) -> FloatArray:

    pixel: FloatArray = cv2.cvtColor(rgb.astype(np.float32).reshape(1, 1, 3), cv2.COLOR_RGB2LAB)[0, 0].astype(float)
    return pixel


# --- what is left out where it cannot be seen -----------------------------------------------------

PLACES_IN_THE_ROOM = ((0.0, -0.2, 0.0), (7.5, 0.0, 0.0), (7.5, 0.3, 2.0), (-8.0, 0.2, 1.0), (0.0, 0.6, 0.4))
"""x of the robot, m; tilt and pan of its head, rad."""


def head_at(x_m: float, tilt_rad: float, pan_rad: float) -> FloatArray:
    pose = head(tilt_rad, pan_rad)
    pose[0, 3] += x_m
    return pose


@pytest.mark.parametrize("place", PLACES_IN_THE_ROOM)
def test_no_wall_is_nearer_than_the_bound_of_the_nearest(gl: Renderer, place: tuple[float, float, float]) -> None:
    pose = head_at(*place)
    far = POSES.copy()
    far[:, 2, 3] = -5.0  # the things are below the floor
    seen = gl.render(far, pose, pose, Lamp()).depth_m
    wall = np.abs(seen - floor_depth(CAMERA, pose)) > 0.05
    assert wall.any()
    assert nearest_wall_m(CAMERA, pose) <= seen[wall].min() + 1e-3
    assert nearest_wall_m(CAMERA, pose) > 0.8 * seen[wall].min()


@pytest.mark.parametrize("place", PLACES_IN_THE_ROOM)
def test_walls_that_no_shadow_reaches_look_as_if_their_shadows_were_looked_up(
    gl: Renderer, monkeypatch: pytest.MonkeyPatch, place: tuple[float, float, float]
) -> None:
    pose = head_at(*place)
    quick = look(gl, pose, projector=True)
    monkeypatch.setattr(gl_module, "_reaches_walls", lambda *_: True)
    monkeypatch.setattr(gl_module, "PROJECTOR_REACH_M", np.inf)
    whole = look(gl, pose, projector=True)
    np.testing.assert_array_equal(quick.colour, whole.colour)
    np.testing.assert_array_equal(np.abs(quick.depth_m), np.abs(whole.depth_m))
    differs = np.signbit(quick.depth_m) != np.signbit(whole.depth_m)
    assert not (differs & (whole.depth_m > -ROBOT.eye.max_range_m)).any()
