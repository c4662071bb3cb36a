"""The renderers: the infrared projector's shadow, agreement of both renderers, equal bytes in every process, and the
case without OpenGL."""

from __future__ import annotations

import hashlib
import logging
import subprocess
import sys
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pictures import (
    CAMERA,
    PLACES,
    POSES,
    ROBOT,
    VISUALS,
    gl_renderer,
    head,
    look,
    pixel_of,
    renderer_of,
)

from cocoro.errors import ConfigError
from sim.camera import moved
from sim.render import Images, Renderer, make_renderer
from sim.render import gl as gl_module

pytestmark = pytest.mark.sim

# --- the infrared projector -----------------------------------------------------------------------


def test_without_a_projector_depth_has_no_shadows(renderer: Renderer) -> None:
    assert (look(renderer).depth_m > 0).all()


def test_the_projectors_shadow_lies_left_of_a_near_thing_as_wide_as_the_disparity(renderer: Renderer) -> None:
    # The projector is to the right of the depth camera, so the area without light is to the left.
    images = look(renderer, projector=True)
    u, v = pixel_of((1.8 - 0.1, 0.4, 0.2), moved(head(), np.array(ROBOT.eye.depth_offset_m)))
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

    spread = cv2.morphologyEx(1 / np.abs(depth_m), cv2.MORPH_GRADIENT, np.ones((5, 5), np.uint8))
    flat: np.ndarray = spread < 0.02
    return flat


def test_both_renderers_show_the_same_world_up_to_shading(gl: Renderer) -> None:
    one, other = look(gl, projector=True), look(renderer_of("tiny"), projector=True)
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
from pictures import CAMERA, VISUALS, look, make_renderer
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


@pytest.mark.process
def test_equal_inputs_give_equal_bytes_in_another_process(renderer: Renderer) -> None:
    program = FRAME_OF_ITS_OWN.format(tests=str(__file__.rpartition("/")[0]), choice=renderer.name)
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split()[-1] == fingerprint(look(renderer, projector=True))


def test_any_resolution_shows_the_same_view(gl: Renderer) -> None:
    small = gl_renderer(VISUALS, replace(CAMERA.scaled(160, 120)))
    coarse = look(small).depth_m
    fine = look(gl).depth_m
    small.close()
    u, v = pixel_of((1.7, 0.4, 0.15), moved(head(), np.array(ROBOT.eye.depth_offset_m)))
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


@pytest.mark.process
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

    monkeypatch.setattr(gl_module, "context", refuse)
    with caplog.at_level(logging.WARNING):
        renderer = make_renderer([], CAMERA)
    renderer.close()
    assert renderer.name == "tiny"
    assert len(caplog.records) == 1
    assert "eglInitialize failed" in caplog.text
    with pytest.raises(ConfigError, match="apt install"):
        make_renderer([], CAMERA, "moderngl")
