"""The bench of a policy that is learned: what it reads of a dataset and of a picture, how it learns, what it writes."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from lerobot_rig import libraries

from apps.captures.export.lerobot_episodes import Episode as Recorded
from apps.captures.export.lerobot_episodes import RecordedTask
from apps.captures.export.lerobot_files import Dataset, Shape
from bench.policy_data import Episode, episodes_of, layout_of
from bench.policy_learned import SEEN_NOISE, Look
from bench.policy_scenes import scene_text
from bench.policy_training import begun, error, pairs_of, train, write
from cocoro.arrays import Float32Array, FloatArray, ImageArray
from cocoro.features import PICTURES, STATE, PolicyFeatures, names_of
from cocoro.robot import Robot
from services.policy.config import PolicyServiceConfig
from services.policy.loading import Policies

ROBOT = Robot.load()
WIDTH, HEIGHT = 160, 120
RED, PINK, GREY = (230, 10, 15), (240, 20, 150), (120, 110, 100)
NAMES = tuple(names_of(ROBOT))
CHUNK = 3


def looking(tilt_rad: float) -> Float32Array:
    """A state whose head is turned down."""
    angles = dict.fromkeys(ROBOT.joints, 0.0) | ROBOT.head_angles(0.2, tilt_rad)
    return np.array([*angles.values(), 0.0, 0.0], np.float32)


def picture(u_px: int, v_px: int, colour: tuple[int, int, int] = RED) -> ImageArray:
    """Grey with a coloured square of 5 pixels around a place."""
    shown = np.full((HEIGHT, WIDTH, 3), GREY, np.uint8)
    shown[v_px - 2 : v_px + 3, u_px - 2 : u_px + 3] = colour
    return shown


def made_up(seed: int, count: int = 6, rows: int = 20) -> list[Episode]:
    """Episodes of a rule: half of each of the first inputs, and never anything at the base."""
    draw = np.random.default_rng(seed)
    inputs = draw.normal(size=(count, rows, len(ROBOT.joints) + len(SEEN_NOISE)))
    actions = np.zeros((count, rows, len(NAMES)))
    actions[..., : len(ROBOT.joints)] = 0.5 * inputs[..., : len(ROBOT.joints)]
    return [Episode(*both) for both in zip(inputs, actions, strict=True)]


def place_px(place_m: tuple[float, float], state: FloatArray) -> tuple[int, int]:
    """The pixel in which a place on the floor appears."""
    pose = ROBOT.camera_chain.pose(dict(zip(ROBOT.joints, state.tolist(), strict=False)))
    x, y, z = pose[:3, :3].T @ (np.array([*place_m, 0.0]) - pose[:3, 3])
    camera = ROBOT.camera.scaled(WIDTH, HEIGHT)
    return round(camera.cx + camera.fx * x / z), round(camera.cy + camera.fy * y / z)


def test_what_is_red_in_a_picture_has_a_place_on_the_floor() -> None:
    state = looking(-0.6)
    look = Look(ROBOT, WIDTH, HEIGHT)
    place = 1.1, 0.25
    seen = look(state, picture(*place_px(place, state.astype(np.float64))))[len(ROBOT.joints) :]
    assert seen[0] == 1.0
    assert seen[1:3] == pytest.approx(place, abs=0.015)
    assert np.hypot(*seen[3:5]) < np.hypot(*seen[1:3])  # its lower edge is nearer
    assert len(look.noise) == len(look(state, picture(50, 50)))


@pytest.mark.parametrize("colour", [PINK, GREY, (40, 0, 0)])
def test_a_marker_the_floor_and_the_dark_are_not_red(colour: tuple[int, int, int]) -> None:
    seen = Look(ROBOT, WIDTH, HEIGHT)(looking(-0.6), picture(80, 60, colour))
    assert not seen[len(ROBOT.joints) :].any()


def test_a_chunk_has_the_actions_from_its_row_on_and_the_last_one_after_the_end() -> None:
    actions = np.arange(4.0)[:, None] * np.ones(2)
    pairs = pairs_of([Episode(np.zeros((4, 1)), actions)], CHUNK)
    assert pairs.chunks[:, ::2].tolist() == [[0, 1, 2], [1, 2, 3], [2, 3, 3], [3, 3, 3]]


def test_training_lowers_the_error_of_what_was_not_learned_from() -> None:
    draw = np.random.default_rng(0)
    pairs, others = pairs_of(made_up(1, count=30), 1), pairs_of(made_up(2), 1)
    network = begun(pairs, (16,), draw)
    before = error(network, others)
    train(network, pairs, 400, np.zeros(pairs.inputs.shape[1]), draw)
    assert error(network, others) < 0.5 * before


def test_the_policy_that_is_written_proposes_what_the_trained_network_does(tmp_path: Path) -> None:
    draw = np.random.default_rng(0)
    network = begun(pairs_of(made_up(1), CHUNK), (8,), draw)
    features = PolicyFeatures(
        state=NAMES, action=NAMES, rate_hz=10.0, chunk=CHUNK, every=2, width=WIDTH, height=HEIGHT, robot=ROBOT.name
    )
    source = write(tmp_path, "learned", network, features)
    assert not re.search(r"^(from|import) bench", (tmp_path / "learned.py").read_text(), re.MULTILINE)
    policy = Policies(ROBOT, PolicyServiceConfig(anything=True)).load(source)
    assert policy.features == features
    state, shown = looking(-0.5), picture(70, 40)
    proposed = policy.act({STATE: state, PICTURES: shown})
    wanted = network(Look(ROBOT, WIDTH, HEIGHT)(state, shown)[None])[0].reshape(CHUNK, -1)
    assert proposed is not None
    np.testing.assert_array_equal(proposed, wanted)
    assert np.ptp(wanted) > 0


def test_only_episodes_of_the_task_that_succeeded_are_learned_from(tmp_path: Path) -> None:
    libraries()
    folder = tmp_path / "dataset"
    folder.mkdir()
    written = Dataset(folder, Shape(ROBOT.name, NAMES, 10, 32, 16))
    tasks = (("fetch red_can", "done"), ("park", "done"), ("fetch red_can", "failed"), ("fetch red_can", "done"))
    for number, (text, outcome) in enumerate(tasks):
        values = np.full((3, len(NAMES)), number, np.float32)
        stamps = np.arange(3) * 100_000_000
        task = RecordedTask(str(number), text, 0, 200_000_000, outcome, "")
        shown = np.full((16, 32, 3), 50 * number, np.uint8)
        written.add(Recorded(task, "a.mcap", stamps, values, values + 10), iter([shown] * 3))
    written.close()
    layout = layout_of(folder)
    assert (layout.names, layout.rate_hz, layout.width, layout.height, layout.robot) == (
        NAMES,
        10.0,
        32,
        16,
        ROBOT.name,
    )
    found = episodes_of(folder, lambda state, shown: np.array([state[0], shown.mean()]), "fetch red_can")
    assert [one.actions[0, 0] for one in found] == [10.0, 13.0]
    assert [one.inputs[:, 0].tolist() for one in found] == [[0.0] * 3, [3.0] * 3]
    assert [one.inputs[0, 1] for one in found] == pytest.approx([0.0, 150.0], abs=6.0)  # a film loses a little


def test_a_scene_is_that_of_its_seed() -> None:
    assert scene_text(3) == scene_text(3) != scene_text(4)
