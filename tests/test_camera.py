"""The simulated Kinect: a perfect camera as `ideal`, and each of a real one's faults at its stated size."""

from __future__ import annotations

import hashlib
import subprocess
import sys
from dataclasses import dataclass
from math import log2

import msgspec
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cocoro.errors import ConfigError
from cocoro.kinematics import Array
from cocoro.messages import Frame
from cocoro.robot import Camera, Robot
from sim.camera import COLOUR_SIGMA, EXPOSURE_S, Kinect, moved
from sim.realism import Sensors
from sim.render import Images, Light, make_renderer
from sim.seeds import stream
from sim.sensor_effects import (
    EDGE_CODES,
    NO_DATA,
    ByteNoise,
    DepthCoder,
    DepthNoise,
    Drift,
    Motion,
    blur_along_motion,
    drop_edges,
    motion_between,
    scale_channels,
)
from sim.visual import Visual

ROBOT = Robot.load()
WIDTH, HEIGHT = 320, 240
CAMERA = ROBOT.camera.scaled(WIDTH, HEIGHT)
FRAME_NS = 33_333_333
NOTHING = np.empty((0, 4, 4))


@dataclass(frozen=True)
class Lamp:
    ambient: float = 0.55
    diffuse: float = 0.45
    direction: tuple[float, float, float] = (0.3, 0.2, -1.0)
    temperature_k: float = 6500.0


LAMP = Lamp()


class Painted:
    """A renderer that shows whatever it was given."""

    name = "painted"

    def __init__(self, colour: np.ndarray | None = None, depth_m: float | np.ndarray = 1.0) -> None:
        self.camera = CAMERA
        self.colour = np.full((HEIGHT, WIDTH, 3), 128, np.uint8) if colour is None else colour
        self.depth_m = np.full((HEIGHT, WIDTH), depth_m, np.float32)
        self.projected: list[Array | None] = []

    def render(
        self,
        poses: Array,
        camera_pose: Array,
        depth_camera_pose: Array,
        light: Light,
        projector_pose: Array | None = None,
    ) -> Images:
        self.projected.append(projector_pose)
        return Images(self.colour, self.depth_m)

    def close(self) -> None: ...


def kinect(renderer: Painted, sensors: Sensors = "real", seed: int = 0) -> Kinect:
    return Kinect(ROBOT, renderer, sensors=sensors, seed=seed, width=WIDTH, height=HEIGHT)


def colour_of(frame: Frame) -> np.ndarray:
    return np.frombuffer(frame.colour, np.uint8).reshape(frame.height, frame.width, 3)


def depth_of(frame: Frame) -> np.ndarray:
    return np.frombuffer(frame.depth, "<u2").reshape(frame.height, frame.width)


def shoot(camera: Kinect, stamp_ns: int = 0, pose: Array | None = None) -> Frame:
    return camera.capture(NOTHING, np.eye(4) if pose is None else pose, stamp_ns, LAMP)


# --- ideal ----------------------------------------------------------------------------------------


def test_ideal_colours_are_the_renderers_own() -> None:
    picture = np.random.default_rng(1).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    np.testing.assert_array_equal(colour_of(shoot(kinect(Painted(picture), "ideal"))), picture)


def test_ideal_depth_is_the_formulas_code() -> None:
    depth = np.linspace(0.3, 4.5, HEIGHT * WIDTH, dtype=np.float32).reshape(HEIGHT, WIDTH)
    codes = depth_of(shoot(kinect(Painted(depth_m=depth), "ideal"))).astype(int)
    formula = ROBOT.depth_code(depth).astype(int)
    agree = codes == formula
    assert agree.mean() > 0.99
    assert np.abs(codes - formula)[formula != NO_DATA].max() <= 1  # on the border between two codes
    a, b, c = ROBOT.kinect.depth_curve
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
    pose[:3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    shoot(kinect(painted, "ideal"), 0, pose)
    shoot(kinect(painted, "real"), 0, pose)
    assert painted.projected[0] is None
    np.testing.assert_allclose(painted.projected[1][:3, 3], [0.0, ROBOT.kinect.projector_offset_m[0], 0.0], atol=1e-12)


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
        Kinect(ROBOT, Painted(), width=640, height=480)


# --- colour, as a real sensor sees it -------------------------------------------------------------


def test_colour_noise_has_its_size_and_no_bias() -> None:
    noise = ByteNoise(stream(0, "test"), WIDTH * HEIGHT, COLOUR_SIGMA)
    grey = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
    added = noise.add(grey, stream(0, "frame")).astype(float) - 128
    assert added.mean() == pytest.approx(0.0, abs=0.05)
    assert added.std() == pytest.approx(COLOUR_SIGMA, rel=0.02)
    beside = np.corrcoef(added[:, :-1].ravel(), added[:, 1:].ravel())[0, 1]
    assert abs(beside) < 0.02


def test_colour_noise_stops_at_black_and_white() -> None:
    noise = ByteNoise(stream(0, "test"), WIDTH * HEIGHT, COLOUR_SIGMA)
    white = noise.add(np.full((HEIGHT, WIDTH, 3), 255, np.uint8), stream(0, "frame"))
    black = noise.add(np.zeros((HEIGHT, WIDTH, 3), np.uint8), stream(0, "frame"))
    assert (white.min(), white.max()) > (200, 254)
    assert (black.min(), black.max()) < (1, 55)


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


def test_drift_is_smooth_and_differs_from_run_to_run() -> None:
    times = np.arange(0, 60, 1 / 30)
    one, other = (Drift(stream(seed, "drift"), 0.1, 5.0) for seed in (1, 2))
    values = np.array([one.at(t) for t in times])
    assert np.abs(values).max() <= 0.1
    assert np.abs(np.diff(values)).max() < 0.004
    assert np.abs(values - [other.at(t) for t in times]).max() > 0.05


def test_gains_scale_each_channel_and_saturate() -> None:
    picture = np.full((2, 2, 3), 200, np.uint8)
    np.testing.assert_array_equal(scale_channels(picture, np.array([1.1, 1.0, 1.5]))[0, 0], [220, 200, 255])


# --- motion blur ----------------------------------------------------------------------------------


def stripe(column: int) -> np.ndarray:
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    picture[:, column] = 252
    return picture


def profile(picture: np.ndarray) -> np.ndarray:
    return picture[HEIGHT // 2, :, 0].astype(float)


@pytest.mark.parametrize("length_px", [3, 5, 10, 18, 30])
def test_a_turning_camera_smears_along_its_turn_as_far_as_the_picture_moved(length_px: int) -> None:
    turn_rad = length_px / CAMERA.fx
    motion = Motion(np.array([0.0, turn_rad, 0.0]), np.zeros(3))
    smeared = profile(blur_along_motion(stripe(160), motion, np.ones((HEIGHT, WIDTH), np.float32), CAMERA))
    lit = np.flatnonzero(smeared)
    assert np.ptp(lit) + 1 == pytest.approx(length_px, abs=2)
    assert (lit * smeared[lit]).sum() / smeared.sum() == pytest.approx(160, abs=1.0)  # the stamp is mid-exposure
    assert smeared.sum() == pytest.approx(252, rel=0.25)  # light is spread, neither made nor lost


def test_the_path_across_the_turn_is_not_smeared() -> None:
    motion = Motion(np.array([16 / CAMERA.fy, 0.0, 0.0]), np.zeros(3))  # nodding: up and down
    smeared = profile(blur_along_motion(stripe(160), motion, np.ones((HEIGHT, WIDTH), np.float32), CAMERA))
    assert np.ptp(np.flatnonzero(smeared)) <= 1


def test_driving_forward_smears_the_margin_and_not_the_middle() -> None:
    motion = Motion(np.zeros(3), np.array([0.0, 0.0, 0.06]))
    near = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    middle = profile(blur_along_motion(stripe(160), motion, near, CAMERA))
    margin = profile(blur_along_motion(stripe(300), motion, near, CAMERA))
    assert np.count_nonzero(middle) <= 2
    assert np.ptp(np.flatnonzero(margin)) + 1 == pytest.approx(0.06 * 140, abs=2)


def test_what_is_farther_is_smeared_less_by_driving() -> None:
    motion = Motion(np.zeros(3), np.array([0.03, 0.0, 0.0]))
    widths = [
        np.count_nonzero(
            profile(blur_along_motion(stripe(160), motion, np.full((HEIGHT, WIDTH), far_m, np.float32), CAMERA))
        )
        for far_m in (0.6, 1.2, 3.0)
    ]
    assert widths[0] > widths[1] > widths[2]


def test_the_blur_is_what_the_renderer_would_have_seen_over_the_exposure() -> None:
    can = Visual("can", "cylinder", (0.033, 0.12), (0.8, 0.04, 0.05))
    renderer = make_renderer([can], CAMERA)
    if renderer.name == "tiny":
        pytest.skip("64 pictures of the slow renderer")
    poses = np.eye(4)[None].copy()
    poses[0, :3, 3] = [1.4, 0.05, 0.06]
    angles = dict.fromkeys(ROBOT.joints, 0.0) | {"neck_tilt": -0.45}
    middle = ROBOT.chain("camera").pose(angles)

    def turned(share: float) -> Array:
        pose = middle.copy()
        pose[:3, :3] = middle[:3, :3] @ Rotation.from_rotvec(share * np.array([0.01, 0.05, 0.01])).as_matrix()
        return pose

    shares = (np.arange(64) + 0.5) / 64 - 0.5
    seen = np.mean([renderer.render(poses, turned(s), middle, LAMP).colour.astype(float) for s in shares], axis=0)
    sharp, depth = renderer.render(poses, middle, middle, LAMP)
    blurred = blur_along_motion(sharp, motion_between(turned(-1.0), middle, 1.0), depth, CAMERA)
    renderer.close()
    inner = (slice(30, -30), slice(30, -30))
    assert np.abs(blurred - seen)[inner].mean() < 0.35 * np.abs(sharp - seen)[inner].mean()


def test_the_exposure_is_a_share_of_the_time_between_frames() -> None:
    before, now = np.eye(4), np.eye(4)
    now[:3, :3] = Rotation.from_rotvec([0.0, 0.06, 0.0]).as_matrix()
    motion = motion_between(before, now, EXPOSURE_S / (1 / 15))
    np.testing.assert_allclose(motion.rotation_rad, [0.0, 0.03, 0.0], atol=1e-12)


def test_a_still_camera_and_a_first_frame_are_sharp() -> None:
    painted = Painted(stripe(160))
    camera = kinect(painted)
    for stamp in (0, FRAME_NS):
        assert (profile(colour_of(shoot(camera, stamp)))[[150, 170]] < 30).all()
        assert profile(colour_of(shoot(camera, stamp)))[160] > 180


def test_a_moving_camera_is_blurred_but_not_after_a_gap_or_a_step_back_in_time() -> None:
    turned = np.eye(4)
    turned[:3, :3] = Rotation.from_rotvec([0.0, 16 / CAMERA.fx, 0.0]).as_matrix()

    def peak(stamps: tuple[int, int]) -> float:
        camera = kinect(Painted(stripe(160)))
        shoot(camera, stamps[0])
        return float(profile(colour_of(shoot(camera, stamps[1], turned)))[160])

    assert peak((0, FRAME_NS)) < 60
    assert peak((0, 60 * FRAME_NS)) > 180
    assert peak((FRAME_NS, 0)) > 180


def test_the_number_of_samples_is_bounded_however_fast_the_head_turns() -> None:
    motion = Motion(np.array([0.0, 1.2, 0.0]), np.zeros(3))
    picture = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    blurred = blur_along_motion(picture, motion, np.ones((HEIGHT, WIDTH), np.float32), CAMERA)
    assert blurred.shape == picture.shape
    assert blurred.std() < picture.std() / log2(8)


# --- depth, as a real sensor measures it ----------------------------------------------------------


@pytest.mark.parametrize("z_m", [0.6, 1.0, 2.0, 3.0])
def test_depth_noise_grows_with_the_square_of_the_distance(z_m: float) -> None:
    codes = depth_of(shoot(kinect(Painted(depth_m=z_m))))
    read = ROBOT.depth_m(codes[codes != NO_DATA]).astype(float)
    a, b, _ = ROBOT.kinect.depth_curve
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


def test_two_percent_of_the_edge_pixels_are_lost_and_none_elsewhere() -> None:
    codes = np.full((480, 640), 700, np.uint16)
    codes[:, ::8] = 700 + 10 * EDGE_CODES
    flat = np.full((480, 640), 700, np.uint16)
    lost = drop_edges(codes, stream(0, "edges")) == NO_DATA
    edges = np.zeros(lost.shape, bool)
    edges[:, ::8] = edges[:, 1::8] = edges[:, 7::8] = True
    assert not lost[~edges].any()
    assert lost[edges].mean() == pytest.approx(0.02, abs=0.002)
    assert (drop_edges(flat, stream(0, "edges")) == 700).all()


def test_a_slanted_floor_with_noise_is_no_edge() -> None:
    # Level gaze from the Kinect's height: the steepest codes a floor can show.
    rows = np.arange(1, HEIGHT // 2 + 1)
    z = (0.73 * CAMERA.fy / rows)[:, None].repeat(WIDTH, axis=1).astype(np.float32)
    z = np.vstack([z, z])
    noisy = DepthNoise(stream(0, "noise"), z.shape, 0.0015).add(z, stream(0, "frame"))
    codes = DepthCoder(ROBOT).codes(noisy)
    inside = codes[2:118, 2:-2] != NO_DATA
    after = drop_edges(codes.copy(), stream(0, "edges"))[2:118, 2:-2]
    border = 12  # rows about the ends of the range, where neighbours have no data
    ranged = np.flatnonzero(inside.all(axis=1))
    assert (after[ranged[border:-border]] != NO_DATA).all()


# --- determinism ----------------------------------------------------------------------------------


def fingerprint(frame: Frame) -> str:
    return hashlib.sha256(bytes(frame.colour) + bytes(frame.depth)).hexdigest()


def film(seed: int) -> list[str]:
    """Three frames of a turning camera over a real scene, with the renderer that this machine has."""
    camera_ = ROBOT.camera.scaled(160, 120)
    can = Visual("can", "cylinder", (0.033, 0.12), (0.8, 0.04, 0.05))
    renderer = make_renderer([can], camera_)
    camera = Kinect(ROBOT, renderer, sensors="real", seed=seed, width=160, height=120)
    poses = np.eye(4)[None].copy()
    poses[0, :3, 3] = [1.2, 0.0, 0.06]
    prints = []
    for number in range(3):
        angles = dict.fromkeys(ROBOT.joints, 0.0) | {"neck_tilt": -0.45, "neck_pan": 0.03 * number}
        pose = ROBOT.chain("camera").pose(angles)
        prints.append(fingerprint(camera.capture(poses, pose, number * FRAME_NS, LAMP)))
    renderer.close()
    return prints


def test_one_seed_gives_one_film_another_seed_another() -> None:
    assert film(3) == film(3)
    assert not set(film(3)) & set(film(4))


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


@pytest.mark.parametrize("size", [(640, 480), (320, 240)])
def test_both_frame_sizes_show_the_can_where_it_is(size: tuple[int, int]) -> None:
    camera_: Camera = ROBOT.camera.scaled(*size)
    can = Visual("can", "cylinder", (0.033, 0.12), (0.8, 0.04, 0.05))
    renderer = make_renderer([can], camera_)
    camera = Kinect(ROBOT, renderer, sensors="real", width=size[0], height=size[1])
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
    depth_pose = moved(pose, np.array(ROBOT.kinect.depth_offset_m))
    x, y, z, _ = np.linalg.inv(depth_pose) @ [1.2, 0.2, 0.06, 1.0]
    code = depth_of(frame)[round(camera_.fy * y / z + camera_.cy), round(camera_.fx * x / z + camera_.cx)]
    assert ROBOT.depth_m(code) == pytest.approx(z - 0.03, abs=0.02)
