"""The simulated Kinect: a perfect camera with `ideal` sensors, and each error of a real one at its stated size."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest
import scipy  # whose parts are loaded by the workers that need them
from pictures import CAMERA, ROBOT, Lamp, profile, stripe
from robot_rig import RobotRig

import sim.service
from cocoro.arrays import FloatArray
from cocoro.errors import ConfigError
from cocoro.messages import Frame
from cocoro.robot import Camera
from cocoro.vloop import run_virtual
from sim.camera import SimKinect, moved
from sim.kinds import Sensors
from sim.render import Images, Lighting, Renderer, make_renderer
from sim.render.choice import RendererChoice
from sim.render.interface import Visual
from sim.sensor_effects import (
    NO_DATA,
)

WIDTH, HEIGHT = CAMERA.width, CAMERA.height
FRAME_NS = 33_333_333
NOTHING = np.empty((0, 4, 4))


LAMP = Lamp()


class Painted:
    """A renderer that returns given images."""

    name = "painted"

    def __init__(self, colour: np.ndarray | None = None, depth_m: float | np.ndarray = 1.0) -> None:
        self.camera = CAMERA
        self.colour = np.full((HEIGHT, WIDTH, 3), 128, np.uint8) if colour is None else colour
        self.depth_m = np.full((HEIGHT, WIDTH), depth_m, np.float32)
        self.projected: list[FloatArray | None] = []

    def render(
        self,
        poses: FloatArray,
        camera_pose: FloatArray,
        depth_camera_pose: FloatArray,
        light: Lighting,
        projector_pose: FloatArray | None = None,
    ) -> Images:
        self.projected.append(projector_pose)
        return Images(self.colour, self.depth_m)

    def close(self) -> None: ...


def kinect(renderer: Painted, sensors: Sensors = "real", seed: int = 0) -> SimKinect:
    return SimKinect(ROBOT, renderer, sensors=sensors, seed=seed, width=WIDTH, height=HEIGHT)


def colour_of(frame: Frame) -> np.ndarray:
    return np.frombuffer(frame.colour, np.uint8).reshape(frame.height, frame.width, 3)


def depth_of(frame: Frame) -> np.ndarray:
    return np.frombuffer(frame.depth, "<u2").reshape(frame.height, frame.width)


def shoot(camera: SimKinect, stamp_ns: int = 0, pose: FloatArray | None = None) -> Frame:
    return camera.capture(NOTHING, np.eye(4) if pose is None else pose, stamp_ns, LAMP)


# --- ideal ----------------------------------------------------------------------------------------


def test_ideal_colours_are_the_renderers_own() -> None:
    picture = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    np.testing.assert_array_equal(colour_of(shoot(kinect(Painted(picture), "ideal"))), picture)


def test_ideal_depth_is_the_formulas_code() -> None:
    depth = np.linspace(0.3, 4.5, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    codes = depth_of(shoot(kinect(Painted(depth_m=depth), "ideal"))).astype(int)
    formula = ROBOT.depth_code(depth.astype(float)).astype(int)
    agree = codes == formula
    assert agree.mean() > 0.99
    assert np.abs(codes - formula)[formula != NO_DATA].max() <= 1  # on the border between two codes
    a, b, c = ROBOT.eye.curve
    exact = b * (np.arctan(depth.astype(float) / a) - c)
    assert np.abs(codes - exact)[(depth > 0.501) & (depth < 3.499)].max() < 0.55
    assert (codes[(depth < 0.4999) | (depth > 3.5001)] == NO_DATA).all()


def test_ideal_depth_reads_back_within_half_a_step() -> None:
    depth = np.full((HEIGHT, WIDTH), np.inf, np.float32)
    depth[0, :4] = [0.5, 1.0, 2.0, 3.5]
    read = ROBOT.depth_m(depth_of(shoot(kinect(Painted(depth_m=depth), "ideal"))))
    np.testing.assert_allclose(read[0, :4], depth[0, :4], atol=0.021)
    np.testing.assert_allclose(read[0, :2], depth[0, :2], atol=0.002)
    assert np.isnan(read[1:]).all()


def test_an_ideal_frame_asks_for_no_projector_a_real_one_for_the_kinects_own() -> None:
    painted = Painted()
    pose = np.eye(4)
    pose[:3, :3] = scipy.spatial.transform.Rotation.from_euler("z", 90, degrees=True).as_matrix()
    shoot(kinect(painted, "ideal"), 0, pose)
    shoot(kinect(painted, "real"), 0, pose)
    none, projector = painted.projected
    assert none is None
    assert projector is not None
    np.testing.assert_allclose(projector[:3, 3], [0.0, ROBOT.eye.projector_offset_m[0], 0.0], atol=1e-12)


def test_a_frame_is_the_message_with_its_stamp_and_keeps_its_pixels() -> None:
    painted = Painted()
    camera = kinect(painted, "ideal")
    first = shoot(camera, 12_345)
    painted.colour[:] = 7
    painted.depth_m[:] = 2.0
    second = shoot(camera, 45_678)
    assert (colour_of(first) == 128).all()
    assert (depth_of(first) == ROBOT.depth_code(np.array(1.0))).all()
    sent = msgspec.msgpack.decode(msgspec.msgpack.encode(second), type=Frame)
    assert (sent.stamp_ns, sent.width, sent.height) == (45_678, WIDTH, HEIGHT)
    assert (colour_of(sent) == 7).all()


def test_the_renderers_size_must_be_the_kinects() -> None:
    with pytest.raises(ConfigError, match=r"320 x 240.*640 x 480"):
        SimKinect(ROBOT, Painted(), width=640, height=480)


@pytest.mark.sim
def test_a_simulator_that_ends_releases_what_it_drew_with(monkeypatch: pytest.MonkeyPatch) -> None:
    """Otherwise each rehearsal of a process would keep some megabytes."""
    closed: list[bool] = []

    def watched(visuals: Sequence[Visual], camera: Camera, choice: RendererChoice) -> Renderer:
        renderer = make_renderer(visuals, camera, choice)
        close = renderer.close
        monkeypatch.setattr(renderer, "close", lambda: closed.append(close() is None))
        return renderer

    monkeypatch.setattr(sim.service, "make_renderer", watched)

    async def scenario() -> None:
        async with RobotRig(services=("sim",)) as rig:
            await rig.advance(0.2)
            assert not closed

    run_virtual(scenario())
    assert closed == [True]


# --- colour of a real sensor ----------------------------------------------------------------------


def test_every_frame_has_noise_of_its_own() -> None:
    camera = kinect(Painted())
    one, other = (colour_of(shoot(camera, stamp)).astype(float) for stamp in (0, 1))
    correlation = np.corrcoef((one - one.mean((0, 1))).ravel(), (other - other.mean((0, 1))).ravel())[0, 1]
    assert abs(correlation) < 0.02


def test_exposure_and_white_balance_drift_within_their_limits_over_seconds() -> None:
    camera = kinect(Painted(), seed=5)
    means = np.array([colour_of(shoot(camera, t * 10**9)).mean((0, 1)) for t in range(60)]) / 128
    exposure, balance = means[:, 1], (means[:, 0] - means[:, 2]) / (2 * means[:, 1])
    assert np.abs(exposure - 1).max() < 0.105
    assert np.abs(balance).max() < 0.055
    assert np.ptp(exposure) > 0.12  # it does wander
    assert np.ptp(balance) > 0.06
    assert np.abs(np.diff(exposure)).max() < 0.08  # and takes seconds for it


# --- motion blur ----------------------------------------------------------------------------------


def test_a_still_camera_and_a_first_frame_are_sharp() -> None:
    painted = Painted(stripe(160))
    camera = kinect(painted)
    for stamp in (0, FRAME_NS):
        assert (profile(colour_of(shoot(camera, stamp)))[[150, 170]] < 30).all()
        assert profile(colour_of(shoot(camera, stamp)))[160] > 180


def test_a_moving_camera_is_blurred_but_not_after_a_gap_or_a_step_back_in_time() -> None:
    turned = np.eye(4)
    turned[:3, :3] = scipy.spatial.transform.Rotation.from_rotvec([0.0, 16 / CAMERA.fx, 0.0]).as_matrix()

    def peak(stamps: tuple[int, int]) -> float:
        camera = kinect(Painted(stripe(160)))
        shoot(camera, stamps[0])
        return float(profile(colour_of(shoot(camera, stamps[1], turned)))[160])

    assert peak((0, FRAME_NS)) < 60
    assert peak((0, 60 * FRAME_NS)) > 180
    assert peak((FRAME_NS, 0)) > 180


# --- depth of a real sensor -----------------------------------------------------------------------


@pytest.mark.parametrize("z_m", [0.6, 1.0, 2.0, 3.0])
def test_depth_noise_grows_with_the_square_of_the_distance(z_m: float) -> None:
    codes = depth_of(shoot(kinect(Painted(depth_m=z_m))))
    read = ROBOT.depth_m(codes[codes != NO_DATA]).astype(float)
    a, b, _ = ROBOT.eye.curve
    step_m = (z_m**2 + a**2) / (a * b)  # of the code at this depth; quantising adds step^2 / 12
    sigma_m = 0.0015 * z_m**2
    assert read.mean() == pytest.approx(z_m, abs=0.1 * step_m)
    assert read.std() == pytest.approx(np.hypot(sigma_m, step_m / 12**0.5), rel=0.05)


def test_depth_out_of_range_and_in_infrared_shadow_is_no_data() -> None:
    depth = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    depth[:, :40], depth[:, 40:80], depth[:, 80:120], depth[:, 120:160] = 0.45, 3.7, np.inf, -1.0
    codes = depth_of(shoot(kinect(Painted(depth_m=depth))))
    assert (codes[:, :160] == NO_DATA).mean() > 0.999
    assert (codes[:, 165:] != NO_DATA).all()


# --- determinism ----------------------------------------------------------------------------------


def fingerprint(frame: Frame) -> str:
    return hashlib.sha256(bytes(frame.colour) + bytes(frame.depth)).hexdigest()


def film(seed: int) -> list[str]:
    """Three frames of a turning camera in a real scene, with this machine's renderer."""
    camera_ = ROBOT.camera.scaled(160, 120)
    can = Visual("can", "cylinder", (0.033, 0.12), (0.8, 0.04, 0.05))
    renderer = make_renderer([can], camera_)
    camera = SimKinect(ROBOT, renderer, sensors="real", seed=seed, width=160, height=120)
    poses = np.eye(4)[None].copy()
    poses[0, :3, 3] = [1.2, 0.0, 0.06]
    prints = []
    for number in range(3):
        angles = dict.fromkeys(ROBOT.joints, 0.0) | {"neck_tilt": -0.45, "neck_pan": 0.03 * number}
        pose = ROBOT.chain("camera").pose(angles)
        prints.append(fingerprint(camera.capture(poses, pose, number * FRAME_NS, LAMP)))
    renderer.close()
    return prints


@pytest.mark.sim
def test_one_seed_gives_one_film_another_seed_another() -> None:
    assert film(3) == film(3)
    assert not set(film(3)) & set(film(4))


@pytest.mark.process
@pytest.mark.sim
def test_another_process_takes_the_same_film() -> None:
    program = (
        f"import sys; sys.path.insert(0, {__file__.rpartition('/')[0]!r}); import test_camera as t; print(*t.film(3))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stdout.split() == film(3)


def test_a_frames_noise_does_not_depend_on_how_many_were_taken_before() -> None:
    often, once = kinect(Painted()), kinect(Painted())
    for number in range(5):
        shoot(often, number * FRAME_NS)
    assert fingerprint(shoot(often, 5 * FRAME_NS)) == fingerprint(shoot(once, 5 * FRAME_NS))


@pytest.mark.sim
@pytest.mark.parametrize("size", [(640, 480), (320, 240)])
def test_both_frame_sizes_show_the_can_where_it_is(size: tuple[int, int]) -> None:
    camera_: Camera = ROBOT.camera.scaled(*size)
    can = Visual("can", "cylinder", (0.033, 0.12), (0.8, 0.04, 0.05))
    renderer = make_renderer([can], camera_)
    camera = SimKinect(ROBOT, renderer, sensors="real", width=size[0], height=size[1])
    poses = np.eye(4)[None].copy()
    poses[0, :3, 3] = [1.2, 0.2, 0.06]
    pose = ROBOT.chain("camera").pose(dict.fromkeys(ROBOT.joints, 0.0) | {"neck_tilt": -0.45})
    frame = camera.capture(poses, pose, 0, LAMP)
    renderer.close()
    r, g, b = np.moveaxis(colour_of(frame).astype(int), -1, 0)
    v, u = np.nonzero((r > 2 * g + 10) & (r > 2 * b + 10))
    x, y, z, _ = np.linalg.inv(pose) @ [1.2, 0.2, 0.06, 1.0]
    assert u.mean() == pytest.approx(camera_.fx * x / z + camera_.cx, abs=1.5)
    assert v.mean() == pytest.approx(camera_.fy * y / z + camera_.cy, abs=3)
    ray = camera_.ray(u.mean(), v.mean())
    assert abs(np.cross(ray / np.linalg.norm(ray), [x, y, z])).max() < 0.012  # the ray passes the can's middle
    depth_pose = moved(pose, np.array(ROBOT.eye.depth_offset_m))
    x, y, z, _ = np.linalg.inv(depth_pose) @ [1.2, 0.2, 0.06, 1.0]
    code = depth_of(frame)[round(camera_.fy * y / z + camera_.cy), round(camera_.fx * x / z + camera_.cx)]
    assert ROBOT.depth_m(code) == pytest.approx(z - 0.03, abs=0.02)
