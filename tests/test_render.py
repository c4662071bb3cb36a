"""The renderers: what stands where in the picture, exactly; and that both show the same world."""

from __future__ import annotations

import hashlib
import logging
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import pytest

from cocoro.errors import ConfigError
from cocoro.kinematics import Array
from cocoro.objects import Catalogue
from cocoro.robot import Camera, Robot
from sim.camera import moved
from sim.render import Images, Renderer, make_renderer
from sim.render import gl as gl_module
from sim.render.room import FLOOR_RGB, OTHER_TILE_RGB, walls
from sim.render.views import lamp_tint
from sim.visual import Visual

ROBOT = Robot.load()
CAMERA = ROBOT.camera.scaled(320, 240)


@dataclass(frozen=True)
class Lamp:
    ambient: float = 0.55
    diffuse: float = 0.45
    direction: tuple[float, float, float] = (0.3, 0.2, -1.0)
    temperature_k: float = 6500.0


RED_CAN = Visual("red", "cylinder", (0.033, 0.12), (0.8, 0.04, 0.05))
BLUE_BOX = Visual("blue", "box", (0.2, 0.3, 0.25), (0.04, 0.14, 0.75))
GREEN_BALL = Visual("green", "sphere", (0.05,), (0.03, 0.55, 0.1))
VISUALS = [RED_CAN, BLUE_BOX, GREEN_BALL]
PLACES = [(1.5, 0.0, 0.06), (1.8, 0.4, 0.125), (1.2, -0.3, 0.05)]


def at(*position_m: float) -> Array:
    pose = np.eye(4)
    pose[:3, 3] = position_m
    return pose


POSES = np.array([at(*place) for place in PLACES])


def head(tilt_rad: float = -0.45, pan_rad: float = 0.0) -> Array:
    angles = dict.fromkeys(ROBOT.joints, 0.0) | {"neck_tilt": tilt_rad, "neck_pan": pan_rad}
    return ROBOT.chain("camera").pose(angles)


def look(
    renderer: Renderer,
    camera_pose: Array | None = None,
    *,
    poses: Array = POSES,
    light: Lamp | None = None,
    projector: bool = False,
) -> Images:
    """A frame as the Kinect takes it, kept beyond the next one."""
    pose = head() if camera_pose is None else camera_pose
    images = renderer.render(
        poses,
        pose,
        moved(pose, np.array(ROBOT.kinect.depth_offset_m)),
        light or Lamp(),
        moved(pose, np.array(ROBOT.kinect.projector_offset_m)) if projector else None,
    )
    return Images(images.colour.copy(), images.depth_m.copy())


def gl_renderer(visuals: list[Visual], camera: Camera = CAMERA) -> Renderer:
    try:
        return make_renderer(visuals, camera, "moderngl")
    except ConfigError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def gl() -> Iterator[Renderer]:
    renderer = gl_renderer(VISUALS)
    yield renderer
    renderer.close()


@pytest.fixture(scope="module")
def tiny() -> Iterator[Renderer]:
    renderer = make_renderer(VISUALS, CAMERA, "tiny")
    yield renderer
    renderer.close()


@pytest.fixture(params=["moderngl", "tiny"])
def renderer(request: pytest.FixtureRequest) -> Renderer:
    fixture: Renderer = request.getfixturevalue("gl" if request.param == "moderngl" else "tiny")
    return fixture


def pixel_of(point_m: tuple[float, ...], camera_pose: Array, camera: Camera = CAMERA) -> tuple[float, float]:
    x, y, z, _ = np.linalg.inv(camera_pose) @ [*point_m, 1.0]
    return camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy


def reddish(colour: np.ndarray) -> np.ndarray:
    r, g, b = np.moveaxis(colour.astype(int), -1, 0)
    return (r > 2 * g + 20) & (r > 2 * b + 20)


def floor_depth(camera: Camera, camera_pose: Array) -> Array:
    """Along the optical axis to z = 0 in every pixel's direction, by the camera's own `ray`."""
    across = np.array([camera.ray(u, 0) for u in range(camera.width)])
    down = np.array([camera.ray(0, v) for v in range(camera.height)])
    up = camera_pose[2, :3]
    slope = up[0] * across[None, :, 0] + up[1] * down[:, None, 1] + up[2]
    return np.where(slope < 0, -camera_pose[2, 3] / np.minimum(slope, -1e-9), np.inf)


# --- geometry -------------------------------------------------------------------------------------


def test_a_pixel_shows_what_its_ray_hits(renderer: Renderer) -> None:
    depth_pose = moved(head(), np.array(ROBOT.kinect.depth_offset_m))
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
    # 25 mm to the left of the colour camera, so the can is further right in its picture.
    shift_px = CAMERA.fx * 0.025 / images.depth_m[row, 160]
    assert depth_u.mean() + 100 - red_u.mean() == pytest.approx(shift_px, abs=0.6)


def test_the_surface_is_where_the_primitive_ends(renderer: Renderer) -> None:
    pose = head()
    for visual, place, toward in ((BLUE_BOX, PLACES[1], 0.1), (GREEN_BALL, PLACES[2], 0.05)):
        depth_pose = moved(pose, np.array(ROBOT.kinect.depth_offset_m))
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


def to_lab(rgb: Array) -> Array:
    import cv2

    pixel: Array = cv2.cvtColor(rgb.astype(np.float32).reshape(1, 1, 3), cv2.COLOR_RGB2LAB)[0, 0].astype(float)
    return pixel


# --- the infrared projector -----------------------------------------------------------------------


def test_without_a_projector_depth_has_no_shadows(renderer: Renderer) -> None:
    assert (look(renderer).depth_m > 0).all()


def test_the_projectors_shadow_lies_left_of_a_near_thing_as_wide_as_the_disparity(renderer: Renderer) -> None:
    # The projector stands to the right of the depth camera, so what it misses is to the left.
    images = look(renderer, projector=True)
    u, v = pixel_of((1.8 - 0.1, 0.4, 0.2), moved(head(), np.array(ROBOT.kinect.depth_offset_m)))
    row = images.depth_m[round(v)]
    shaded = np.flatnonzero(row[: round(u)] < 0)
    box_m = row[round(u)]
    behind_m = -row[shaded].mean()
    assert behind_m > box_m + 0.2
    left_edge = shaded.max() + 1
    assert np.abs(row[left_edge] - box_m) < 0.05  # the shadow ends where the box begins
    assert len(shaded) == pytest.approx(CAMERA.fx * 0.075 * (1 / box_m - 1 / behind_m), abs=1.5)
    right = row[round(u) : round(u) + 60]
    assert (right > 0).all()


def test_shadow_has_the_metres_of_what_it_lies_on(renderer: Renderer) -> None:
    plain = look(renderer).depth_m
    np.testing.assert_array_equal(np.abs(look(renderer, projector=True).depth_m), plain)


@pytest.mark.parametrize("tilt_rad", [-0.2, -0.6, -1.0])
def test_a_plane_does_not_shade_itself(renderer: Renderer, tilt_rad: float) -> None:
    far = POSES.copy()
    far[:, 0, 3] = -5.0
    assert (look(renderer, head(tilt_rad), poses=far, projector=True).depth_m > 0).all()


# --- two renderers, one world ---------------------------------------------------------------------


def away_from_edges(depth_m: np.ndarray) -> np.ndarray:
    import cv2

    spread = cv2.morphologyEx(1 / np.abs(depth_m), cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8))
    flat: np.ndarray = spread < 0.02
    return flat


def test_both_renderers_show_the_same_world_up_to_shading(gl: Renderer, tiny: Renderer) -> None:
    one, other = look(gl, projector=True), look(tiny, projector=True)
    inside = away_from_edges(one.depth_m) & away_from_edges(other.depth_m)
    near = inside & (np.abs(one.depth_m) < 3.5)
    assert near.mean() > 0.6
    assert np.abs(np.abs(one.depth_m) - np.abs(other.depth_m))[near].max() < 0.02
    assert ((one.depth_m < 0) != (other.depth_m < 0)).mean() < 0.002
    for place in PLACES:
        u, v = (round(x) for x in pixel_of(place, head()))
        a, b = one.colour[v, u].astype(float), other.colour[v, u].astype(float)
        assert np.argmax(a) == np.argmax(b)
        np.testing.assert_allclose(a / a.sum(), b / b.sum(), atol=0.03)
        assert a.sum() == pytest.approx(b.sum(), rel=0.35)


FRAME_OF_ITS_OWN = """
import hashlib, sys
sys.path.insert(0, {tests!r})
from test_render import VISUALS, CAMERA, look, make_renderer
images = look(make_renderer(VISUALS, CAMERA, {choice!r}), projector=True)
print(hashlib.sha256(images.colour.tobytes() + images.depth_m.tobytes()).hexdigest())
"""


def fingerprint(images: Images) -> str:
    return hashlib.sha256(images.colour.tobytes() + images.depth_m.tobytes()).hexdigest()


def test_equal_inputs_give_equal_bytes_whatever_was_drawn_before(renderer: Renderer) -> None:
    first = fingerprint(look(renderer, projector=True))
    look(renderer, head(-1.0, 0.5))
    assert fingerprint(look(renderer, projector=True)) == first
    other = make_renderer(VISUALS, CAMERA, "tiny" if renderer.name == "tiny" else "moderngl")
    look(other, head(-0.2))
    assert fingerprint(look(other, projector=True)) == first
    assert fingerprint(look(renderer, projector=True)) == first  # two side by side do not disturb one another
    other.close()
    assert fingerprint(look(renderer, projector=True)) == first


def test_equal_inputs_give_equal_bytes_in_another_process(renderer: Renderer) -> None:
    program = FRAME_OF_ITS_OWN.format(tests=str(__file__.rpartition("/")[0]), choice=renderer.name)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == fingerprint(look(renderer, projector=True))


def test_any_resolution_shows_the_same_view(gl: Renderer) -> None:
    small = gl_renderer(VISUALS, replace(CAMERA.scaled(160, 120)))
    coarse = look(small).depth_m
    fine = look(gl).depth_m
    small.close()
    u, v = pixel_of((1.7, 0.4, 0.15), moved(head(), np.array(ROBOT.kinect.depth_offset_m)))
    assert coarse[round((v - 0.5) / 2), round((u - 0.5) / 2)] == pytest.approx(fine[round(v), round(u)], abs=0.01)


# --- where OpenGL is missing ----------------------------------------------------------------------

NO_LIBRARY = """
import logging
logging.basicConfig(format="%(levelname)s %(message)s")
from sim.render import gl, make_renderer
from cocoro.robot import Robot
gl.LIBRARIES["libgl"] = "libGL-that-is-not-there.so.1"
print(make_renderer([], Robot.load().camera).name)
"""


def test_a_missing_library_means_one_warning_and_the_slow_renderer() -> None:
    done = subprocess.run([sys.executable, "-c", NO_LIBRARY], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["tiny"]
    assert "Traceback" not in done.stderr
    (warning,) = [line for line in done.stderr.splitlines() if line.startswith("WARNING")]
    assert "apt install libegl1 libgl1 libgl1-mesa-dri" in warning


def test_a_context_that_cannot_be_made_is_said_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse() -> None:
        raise Exception("eglInitialize failed")  # what glcontext raises is a plain Exception

    monkeypatch.setattr(gl_module, "_context", refuse)
    with caplog.at_level(logging.WARNING):
        renderer = make_renderer([], CAMERA)
    renderer.close()
    assert renderer.name == "tiny"
    assert len(caplog.records) == 1
    assert "eglInitialize failed" in caplog.text
    with pytest.raises(ConfigError, match="apt install"):
        make_renderer([], CAMERA, "moderngl")
