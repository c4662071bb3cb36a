"""Samples and models on disk: whole after any end, and refused with one line when they are not what they should be."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from pathlib import Path

import msgspec
import numpy as np
import pytest
from learning_arm import sightings

from apps.learning import dataset
from apps.learning.dataset import HandRow, SampleFile, WheelRow, hand_header, wheel_header
from apps.learning.study import BEST, PAPER, fit
from cocoro.errors import ConfigError, RefusedError
from cocoro.learning import model
from cocoro.learning.handmap import NominalModel
from cocoro.learning.model import Training, WheelModel
from cocoro.robot import Robot

TRAINING = Training(data="0123456789abcdef", samples=600, method=BEST.name, scores={"held_out_rms_m": 0.0035})


def row(draw: int) -> HandRow:
    return HandRow(
        stamp_ns=draw * 1_000_000, draw=draw, angles_rad=(0.1, 0.2, 0.3, 0.4), head_rad=(0.0, -0.5),
        seen_m=(0.4, -0.1, 0.2), area_px=300,
    )  # fmt: skip


def opened(path: Path, robot: Robot) -> SampleFile[HandRow]:
    return SampleFile(path, HandRow, robot, hand_header(robot, NominalModel(robot).joints, np.pi / 2))


# --- samples ----------------------------------------------------------------------------------------


def test_samples_are_read_as_they_were_written_and_go_on_where_they_ended(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "deep" / "arm.jsonl"
    with opened(path, robot) as writer:
        writer.append([row(1), row(2)])
    with opened(path, robot) as writer:
        assert writer.rows == [row(1), row(2)]
        writer.append([row(3)])
    recorded = dataset.read(path, HandRow, robot)
    assert recorded.rows == [row(1), row(2), row(3)]
    assert recorded.header.joints == ("arm_base", "shoulder", "elbow", "wrist_pitch")


def test_any_tool_reads_them_line_by_line(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "arm.jsonl"
    with opened(path, robot) as writer:
        writer.append([row(1)])
    header, sample = map(json.loads, path.read_text().splitlines())
    assert header["format"] == "cocoro.hand-samples"
    assert header["version"] == 1
    assert sample["seen_m"] == [0.4, -0.1, 0.2]


KILLED = """
import sys
from pathlib import Path
from apps.learning.dataset import HandRow, SampleFile, hand_header
from cocoro.learning.handmap import NominalModel
from cocoro.robot import Robot

robot = Robot.load()
with SampleFile(Path(sys.argv[1]), HandRow, robot, hand_header(robot, NominalModel(robot).joints, 1.57)) as writer:
    for draw in range(1_000_000):
        writer.append([HandRow(stamp_ns=draw, draw=draw, angles_rad=(0.0,) * 4, head_rad=(0.0, 0.0),
                               seen_m=(0.1, 0.2, 0.3), area_px=1)])
        print(draw, flush=True)
"""


@pytest.mark.process
def test_killed_in_the_middle_nothing_that_was_appended_is_lost(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "arm.jsonl"
    command = [sys.executable, "-c", KILLED, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        for line in process.stdout:
            if int(line) == 200:
                process.send_signal(signal.SIGKILL)
                break
        said = [200, *map(int, process.stdout.read().split())]
    writer = SampleFile(path, HandRow, robot, hand_header(robot, NominalModel(robot).joints, 1.57))
    with writer:
        draws = [sample.draw for sample in writer.rows]
        assert draws[: said[-1] + 1] == list(range(said[-1] + 1))
        writer.append([row(9)])
    assert dataset.read(path, HandRow, robot).rows[-1] == row(9)


def test_a_line_that_was_being_written_is_cut_off(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "arm.jsonl"
    with opened(path, robot) as writer:
        writer.append([row(1), row(2)])
    path.write_bytes(path.read_bytes()[:-20])
    assert dataset.read(path, HandRow).rows == [row(1)]
    with opened(path, robot) as writer:
        writer.append([row(5)])
    assert dataset.read(path, HandRow).rows == [row(1), row(5)]


def test_two_do_not_write_one_file(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "arm.jsonl"
    with opened(path, robot), pytest.raises(RefusedError, match="another process is writing"):
        opened(path, robot)


def test_equal_samples_have_equal_fingerprints(tmp_path: Path, robot: Robot) -> None:
    prints = []
    for name, draws in (("a", (1, 2)), ("b", (1, 2)), ("c", (1, 3))):
        with opened(tmp_path / name, robot) as writer:
            writer.append(map(row, draws))
        prints.append(dataset.read(tmp_path / name, HandRow).fingerprint)
    assert prints[0] == prints[1] != prints[2]


def test_samples_of_another_kind_robot_or_description_are_refused(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "arm.jsonl"
    with opened(path, robot):
        pass
    other = robot.with_base(wheel_separation_m=0.3)
    data = robot.to_data() | {"name": "robbie"}
    with pytest.raises(ConfigError, match=r"holds cocoro\.hand-samples, not cocoro\.wheel-trials"):
        dataset.read(path, WheelRow)
    with pytest.raises(ConfigError, match="another description"):
        dataset.read(path, HandRow, other)
    with pytest.raises(ConfigError, match="of robot 'calliope', this one is 'robbie'"):
        dataset.read(path, HandRow, Robot.from_data(data))
    with pytest.raises(ConfigError, match="holds cocoro"):
        SampleFile(path, WheelRow, robot, wheel_header(robot))


@pytest.mark.parametrize(
    ("content", "text"),
    [
        (b"", "it is empty"),
        (b"not json\n", "not a file of samples"),
        (b'{"format":"cocoro.hand-samples","version":9,"robot":"calliope","drawing":""}\n', "version 9"),
    ],
)
def test_what_is_no_file_of_samples_is_refused(tmp_path: Path, content: bytes, text: str) -> None:
    path = tmp_path / "arm.jsonl"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=text):
        dataset.read(path, HandRow)


def test_a_damaged_line_is_named(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "arm.jsonl"
    with opened(path, robot) as writer:
        writer.append([row(1), row(2)])
    lines = path.read_bytes().splitlines(keepends=True)
    path.write_bytes(b"".join([lines[0], b'{"stamp_ns": "soon"}\n', lines[2]]))
    with pytest.raises(ConfigError, match=r"line 2: "):
        dataset.read(path, HandRow)
    with pytest.raises(ConfigError, match="No such file"):
        dataset.read(tmp_path / "nowhere", HandRow)


# --- models -----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def learned(robot: Robot) -> model.BodyModel:
    seen = sightings(robot, draws=60)
    arm = model.arm_model(fit(BEST, NominalModel(robot), seen), np.pi / 2, seen.places_m, TRAINING)
    return msgspec.structs.replace(
        model.empty(robot), arm=arm, wheels=WheelModel(separation_m=0.2575, training=TRAINING)
    )


@pytest.mark.parametrize("method", [BEST, PAPER], ids=lambda method: method.name)
def test_a_map_computes_the_same_after_it_was_saved(
    tmp_path: Path, robot: Robot, method: object, learned: model.BodyModel
) -> None:
    seen = sightings(robot, draws=60)
    before = fit(method, NominalModel(robot), seen)  # type: ignore[arg-type]
    arm = model.arm_model(before, np.pi / 2, seen.places_m, TRAINING)
    model.save(msgspec.structs.replace(learned, arm=arm), tmp_path / "model.json")
    loaded = model.load(tmp_path / "model.json", robot)
    assert loaded.arm is not None
    after = model.hand_map(loaded.arm, robot)
    assert np.array_equal(before.predict(seen.angles_rad), after.predict(seen.angles_rad))
    assert loaded.arm.training.scores == {"held_out_rms_m": 0.0035}
    assert np.allclose(loaded.arm.seen_m, seen.places_m, atol=1e-4)
    assert loaded.wheels == learned.wheels


def test_a_model_may_lack_what_was_not_learned(robot: Robot) -> None:
    assert model.decode(model.encode(model.empty(robot)), robot, "here").arm is None


def _edited(data: bytes, **changes: object) -> bytes:
    return json.dumps(json.loads(data) | changes).encode()


def test_every_wrong_model_is_refused_in_one_line_that_says_why(robot: Robot, learned: model.BodyModel) -> None:
    good = model.encode(learned)
    flipped = good.replace(b'"separation_m":0.2575', b'"separation_m":0.2775')
    assert flipped != good
    other = Robot.from_data(robot.to_data() | {"name": "robbie"})
    redrawn = robot.with_base(wheel_radius_m=0.04)
    assert learned.arm is not None
    assert learned.wheels is not None
    short = msgspec.structs.replace(learned.arm, weights=learned.arm.weights[:-1])
    for data, who, text in (
        (b"", robot, "damaged or no model"),
        (good[: len(good) // 2], robot, "damaged or no model"),
        (b"\x00\xff", robot, "damaged or no model"),
        (b"[1, 2]", robot, "damaged or no model"),
        (flipped, robot, "checksum"),
        (_edited(good, format="holiday photos"), robot, "not a cocoro.model"),
        (_edited(good, version=0), robot, "older version, 0"),
        (_edited(good, version=2), robot, "newer version, 2"),
        (good, other, "of robot 'calliope', this one is 'robbie'"),
        (good, redrawn, "another description"),
        (model.encode(msgspec.structs.replace(learned, arm=short)), robot, "do not fit together"),
        (model.encode(msgspec.structs.replace(
            learned, wheels=msgspec.structs.replace(learned.wheels, separation_m=-1.0))), robot, "separation_m"),
    ):  # fmt: skip
        with pytest.raises(ConfigError, match=text) as refused:
            model.decode(data, who, "m.json")
        assert str(refused.value).startswith("model m.json: ")
        assert "\n" not in str(refused.value)


def test_a_model_file_that_is_not_there_is_refused(tmp_path: Path, robot: Robot) -> None:
    with pytest.raises(ConfigError, match="No such file"):
        model.load(tmp_path / "none.json", robot)
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="model "):
        model.save(model.empty(robot), tmp_path / "file" / "model.json")


def test_saving_replaces_a_file_whole(tmp_path: Path, robot: Robot, learned: model.BodyModel) -> None:
    path = tmp_path / "model.json"
    model.save(learned, path)
    model.save(model.empty(robot), path)
    assert model.load(path, robot) == model.empty(robot)
    assert [file.name for file in tmp_path.iterdir()] == ["model.json"]
