"""The errors of a real Kinect, each at its stated size."""

from __future__ import annotations

from math import log2

import numpy as np
import pytest
import scipy  # whose parts are loaded by the workers that need them
from pictures import CAMERA, ROBOT, Lamp, profile, stripe

from cocoro.arrays import FloatArray
from sim.camera import COLOUR_SIGMA, EXPOSURE_S
from sim.render import make_renderer
from sim.render.interface import Visual
from sim.seeds import stream
from sim.sensor_effects import (
    EDGE_CODES,
    NO_DATA,
    ByteNoise,
    CameraMotion,
    DepthCoder,
    DepthNoise,
    Drift,
    blur_along_motion,
    drop_edges,
    motion_between,
    scale_channels,
)

WIDTH, HEIGHT = CAMERA.width, CAMERA.height


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
    assert white.min() > 220  # nothing wrapped round
    assert (white == 255).mean() == pytest.approx(0.55, abs=0.02)  # and the brighter half is cut
    assert black.max() < 35
    assert (black == 0).mean() == pytest.approx(0.55, abs=0.02)


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


@pytest.mark.parametrize("length_px", [3, 5, 10, 18, 30])
def test_a_turning_camera_smears_along_its_turn_as_far_as_the_picture_moved(length_px: int) -> None:
    turn_rad = length_px / CAMERA.fx
    motion = CameraMotion(np.array([0.0, turn_rad, 0.0]), np.zeros(3))
    smeared = profile(blur_along_motion(stripe(160), motion, np.ones((HEIGHT, WIDTH), np.float32), CAMERA))
    lit = np.flatnonzero(smeared)
    assert np.ptp(lit) + 1 == pytest.approx(length_px, abs=2)
    assert (lit * smeared[lit]).sum() / smeared.sum() == pytest.approx(160, abs=1.0)  # the stamp is mid-exposure
    assert smeared.sum() == pytest.approx(252, rel=0.25)  # light is spread, neither made nor lost


def test_the_path_across_the_turn_is_not_smeared() -> None:
    motion = CameraMotion(np.array([16 / CAMERA.fy, 0.0, 0.0]), np.zeros(3))  # nodding: up and down
    smeared = profile(blur_along_motion(stripe(160), motion, np.ones((HEIGHT, WIDTH), np.float32), CAMERA))
    assert np.ptp(np.flatnonzero(smeared)) <= 1


def test_driving_forward_smears_the_margin_and_not_the_middle() -> None:
    motion = CameraMotion(np.zeros(3), np.array([0.0, 0.0, 0.06]))
    near = np.full((HEIGHT, WIDTH), 1.0, np.float32)
    middle = profile(blur_along_motion(stripe(160), motion, near, CAMERA))
    margin = profile(blur_along_motion(stripe(300), motion, near, CAMERA))
    assert np.count_nonzero(middle) <= 2
    assert np.ptp(np.flatnonzero(margin)) + 1 == pytest.approx(0.06 * 140, abs=2)


def test_what_is_farther_is_smeared_less_by_driving() -> None:
    motion = CameraMotion(np.zeros(3), np.array([0.03, 0.0, 0.0]))
    widths = [
        np.count_nonzero(
            profile(blur_along_motion(stripe(160), motion, np.full((HEIGHT, WIDTH), far_m, np.float32), CAMERA))
        )
        for far_m in (0.6, 1.2, 3.0)
    ]
    assert widths[0] > widths[1] > widths[2]


@pytest.mark.sim
def test_the_blur_is_what_the_renderer_would_have_seen_over_the_exposure() -> None:
    can = Visual("can", "cylinder", (0.033, 0.12), (0.8, 0.04, 0.05))
    renderer = make_renderer([can], CAMERA)
    if renderer.name == "tiny":
        pytest.skip("64 pictures of the slow renderer")
    poses = np.eye(4)[None].copy()
    poses[0, :3, 3] = [1.4, 0.05, 0.06]
    angles = dict.fromkeys(ROBOT.joints, 0.0) | {"neck_tilt": -0.45}
    middle = ROBOT.chain("camera").pose(angles)

    def turned(share: float) -> FloatArray:
        pose = middle.copy()
        pose[:3, :3] = (
            middle[:3, :3]
            @ scipy.spatial.transform.Rotation.from_rotvec(share * np.array([0.01, 0.05, 0.01])).as_matrix()
        )
        return pose

    shares = (np.arange(64) + 0.5) / 64 - 0.5
    seen = np.mean([renderer.render(poses, turned(s), middle, Lamp()).colour.astype(float) for s in shares], axis=0)
    sharp, depth = renderer.render(poses, middle, middle, Lamp())
    blurred = blur_along_motion(sharp, motion_between(turned(-1.0), middle, 1.0), depth, CAMERA)
    renderer.close()
    inner = (slice(30, -30), slice(30, -30))
    assert np.abs(blurred - seen)[inner].mean() < 0.35 * np.abs(sharp - seen)[inner].mean()


def test_the_exposure_is_a_share_of_the_time_between_frames() -> None:
    before, now = np.eye(4), np.eye(4)
    now[:3, :3] = scipy.spatial.transform.Rotation.from_rotvec([0.0, 0.06, 0.0]).as_matrix()
    motion = motion_between(before, now, EXPOSURE_S / (1 / 15))
    np.testing.assert_allclose(motion.rotation_rad, [0.0, 0.03, 0.0], atol=1e-12)


def test_the_number_of_samples_is_bounded_however_fast_the_head_turns() -> None:
    motion = CameraMotion(np.array([0.0, 1.2, 0.0]), np.zeros(3))
    picture = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)
    blurred = blur_along_motion(picture, motion, np.ones((HEIGHT, WIDTH), np.float32), CAMERA)
    assert blurred.shape == picture.shape
    assert blurred.std() < picture.std() / log2(8)


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
    # A level camera at the Kinect's height: the largest change of codes that a floor can show.
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
