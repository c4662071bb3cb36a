"""`cocoro learn` on files alone, and how babbling is shown."""

from __future__ import annotations

import json
from math import cos, sin
from pathlib import Path

import pytest
from learning_arm import sightings

from apps.cli.babble import BabbleDisplay
from apps.cli.main import main
from apps.cli.progress import SilentDisplay
from apps.learning.collector import Coverage, HandCollector, WheelCollector, collector
from apps.learning.dataset import HandRow, SampleFile, WheelRow, hand_header, wheel_header
from apps.learning.study import BEST
from cocoro.learning import model
from cocoro.learning.handmap import NominalModel
from cocoro.messages import HandSample, TaskState, WheelTrial
from cocoro.robot import Robot
from cocoro.topics import HAND_SAMPLES

JOINTS = ("arm_base", "shoulder", "elbow", "wrist_pitch")


@pytest.fixture
def arm_file(tmp_path: Path, robot: Robot) -> Path:
    path = tmp_path / "arm.jsonl"
    seen = sightings(robot, draws=60)
    header = hand_header(robot, NominalModel(robot).joints, robot.claw.level_roll_rad)
    with SampleFile(path, HandRow, robot, header) as writer:
        writer.append(
            HandRow(
                stamp_ns=number, draw=int(draw), angles_rad=tuple(angles), head_rad=(0.0, -0.5), seen_m=tuple(place),
                area_px=300,
            )
            for number, (angles, place, draw) in enumerate(
                zip(seen.angles_rad.tolist(), seen.places_m.tolist(), seen.draws, strict=True)
            )
        )  # fmt: skip
    return path


def trial(number: int, turned_rad: float) -> WheelTrial:
    """A trial of a body whose wheel distance is the nominal one."""
    before = (1.5, 0.0)
    c, s = cos(turned_rad), sin(turned_rad)
    after = (1.5 * c, -1.5 * s)
    return WheelTrial(
        trial=number, left_mps=-0.1, right_mps=0.1, way_m=0.0, turned_rad=turned_rad, before_m=before, after_m=after
    )


def test_an_arms_samples_become_a_model_with_every_method_measured(
    arm_file: Path, tmp_path: Path, robot: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    made = tmp_path / "model.json"
    assert main(["learn", "arm", str(arm_file), "--model", str(made), "--method", BEST.name, "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["chosen"] == BEST.name
    by_name = {score["name"]: score["held_out_m"] for score in report["scores"]}
    assert by_name[BEST.name] < 0.6 * by_name["the nominal model with its best constant offset"]
    arm = model.load(made, robot).arm
    assert arm is not None
    assert arm.training.scores["held_out_rms_m"] == by_name[BEST.name]
    assert arm.training.samples == report["samples"]


def test_the_report_is_a_table_for_people(arm_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    made = str(tmp_path / "model.json")
    assert main(["learn", "arm", str(arm_file), "--model", made, "--method", BEST.name]) == 0
    out = capsys.readouterr().out
    assert "HELD OUT, MM" in out
    assert f"> {BEST.name}" in out
    assert "is written" in out


def test_wheels_are_learned_into_the_same_model(
    arm_file: Path, tmp_path: Path, robot: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    made, wheels = tmp_path / "model.json", tmp_path / "wheels.jsonl"
    with WheelCollector(wheels, robot) as kept:
        for number in range(8):
            kept.take(trial(number, (-1) ** number * 0.5))
    assert main(["learn", "arm", str(arm_file), "--model", str(made), "--method", BEST.name]) == 0
    assert main(["learn", "wheels", str(wheels), "--model", str(made)]) == 0
    assert "WHEEL DISTANCE" in capsys.readouterr().out
    learned = model.load(made, robot)
    assert learned.arm is not None
    assert learned.wheels is not None
    assert learned.wheels.separation_m == pytest.approx(robot.base.wheel_separation_m, abs=1e-4)


def test_mistakes_are_said_in_one_line(
    arm_file: Path, tmp_path: Path, robot: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    few = tmp_path / "few.jsonl"
    few.write_bytes(b"".join(arm_file.read_bytes().splitlines(keepends=True)[:20]))
    straight = tmp_path / "straight.jsonl"
    with SampleFile(straight, WheelRow, robot, wheel_header(robot)):
        pass
    (tmp_path / "broken.json").write_text("{")
    for arguments, text in (
        (["learn", "arm", str(tmp_path / "none")], "No such file"),
        (["learn", "arm", str(few)], "too few"),
        (["learn", "arm", str(arm_file), "--method", "magic"], "no method 'magic'"),
        (["learn", "wheels", str(arm_file)], "not cocoro.wheel-trials"),
        (["learn", "wheels", str(straight)], "no trial in it turned"),
        (["learn", "arm", str(arm_file), "--method", BEST.name, "--model", str(tmp_path / "broken.json")], "damaged"),
    ):
        assert main(arguments) == 2
        said = capsys.readouterr().err
        assert text in said
        assert said.startswith("cocoro: ")


def test_coverage_is_the_share_of_sightings_that_came_where_others_had_been() -> None:
    coverage = Coverage()
    assert coverage.share == 0.0
    for place in ((0.01, 0.01, 0.01), (0.02, 0.02, 0.02), (0.53, 0.0, 0.0), (0.54, 0.01, 0.01), (0.9, 0.9, 0.9)):
        coverage.add(place)
    assert coverage.share == pytest.approx(1 - 1 / 5)


def test_what_was_reported_is_kept_and_gone_on_with(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "arm.jsonl"
    angles = dict.fromkeys((*JOINTS, "neck_pan", "neck_tilt", "wrist_roll", "claw_left", "claw_right"), 0.1)
    with HandCollector(path, robot) as kept:
        assert kept.next == 1
        kept.take(HandSample(stamp_ns=5, draw=17, angles_rad=angles, seen_m=(0.4, 0.0, 0.2), area_px=90))
        kept.take(trial(3, 0.5))  # none of its own
    with collector(HAND_SAMPLES, path, robot) as again:
        assert len(again) == 1
        assert again.next == 18


def test_wheel_trials_go_on_with_a_new_pair(tmp_path: Path, robot: Robot) -> None:
    path = tmp_path / "wheels.jsonl"
    with WheelCollector(path, robot) as kept:
        first = kept.next
        kept.take(trial(4, 0.5))
        assert first == 2
        assert kept.next == 6
        assert kept.summary == "1 trials, 0.1 turns in all"


def test_progress_has_a_bar_the_coverage_and_the_time_that_is_left(tmp_path: Path, robot: Robot) -> None:
    angles = dict.fromkeys((*JOINTS, "neck_pan", "neck_tilt"), 0.1)
    with HandCollector(tmp_path / "arm.jsonl", robot) as kept:
        view = BabbleDisplay(SilentDisplay(), kept, 200)
        assert "left" not in view.text(0.0)
        for number in range(50):
            kept.take(HandSample(stamp_ns=number, draw=1, angles_rad=angles, seen_m=(0.4, 0.0, 0.2), area_px=90))
        text = view.text(30.0)
        assert text.startswith("[#####...............] 50 of 200: 50 samples, coverage 100%")
        assert text.endswith("1 min 30 s left")
        state = TaskState(task="babble-arm", phase="babble-arm", elapsed_s=30.0, text="50 of 200 samples, draw 9")
        view.show(state)
        assert state.text == text
