"""What a robot need not have: a mount about its camera, a marker on its hand."""

from __future__ import annotations

from pathlib import Path

import pytest
from bodies import DESCRIPTION, without_line, without_mount_and_marker, without_neck, without_table, written

import cocoro
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro.learning.handmap import NominalModel, fingerprint_of
from cocoro.robot import Robot
from services.executive.tasks import BabbleArmTask, FetchTask
from services.planning.clearance import Clearance
from services.planning.config import PlanningConfig
from services.planning.core import PlanningCore
from sim.body import body_of_parts
from sim.realism import body_of


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> str:
    return written(tmp_path_factory.mktemp("body"), without_mount_and_marker())


@pytest.fixture(scope="module")
def bare(file: str) -> Robot:
    return Robot.load(Path(file))


@pytest.mark.sim
def test_a_robot_without_mount_and_marker_fetches(file: str) -> None:
    result = rehearse(
        RehearsalRequest(
            task=FetchTask(label="red_can"), description=file, body="worn", width=320, height=240, frame_rate_hz=15.0
        )
    )
    assert (result["outcome"], result["reason"]) == ("done", "")
    assert result["truth"]["held"]


@pytest.mark.sim
def test_a_task_that_looks_at_the_marker_is_refused_with_the_reason(file: str) -> None:
    with pytest.raises(cocoro.NotAbleError, match="calliope has no marker on its hand that its camera could see; babb"):
        rehearse(RehearsalRequest(task=BabbleArmTask(count=1), description=file, width=160, height=120))


def test_where_no_mount_is_the_arm_keeps_off_nothing(bare: Robot, robot: Robot) -> None:
    into_mount = robot.poses["park"] | {robot.arm.azimuth: 2.6, robot.arm.roll: 0.0}
    assert Clearance(robot).of(into_mount) < 0.0
    assert Clearance(bare).of(into_mount) > 0.0


def test_the_simulator_builds_no_part_that_is_not_there(bare: Robot, robot: Robot) -> None:
    def names(of: Robot) -> set[str]:
        return {part.name for parts in body_of_parts(of).parts.values() for part in parts}

    assert names(robot) - names(bare) == {"mount", "marker"}
    assert body_of_parts(bare).mass_kg == pytest.approx(body_of_parts(robot).mass_kg)
    assert body_of(bare, "worn", 1).robot.marker is None


def test_a_hand_without_a_marker_is_not_learned_from_sight(bare: Robot) -> None:
    with pytest.raises(cocoro.ConfigError, match=r"no marker on its hand: its description has no table \[marker\]"):
        NominalModel(bare)
    assert PlanningCore(bare, PlanningConfig(see_hand=True)).learned.hand is None
    assert fingerprint_of(bare) != fingerprint_of(Robot.load())


def test_a_description_without_a_part_is_recorded_as_it_is(bare: Robot) -> None:
    again = Robot.from_data(bare.to_data())
    assert (again.marker, again.eye.mount, again.hull.kinect) == (None, None, None)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        (without_line(DESCRIPTION, "mount_max_m"), r"camera kinect: mount_min_m: a box has two corners"),
        (without_line(DESCRIPTION, "kinect_min_m"), r"hull\.kinect_min_m: a box has two corners, and one of them is"),
        (without_table(DESCRIPTION, "head"), r"the joint 'neck_pan' turns it, but there is no \[head\]"),
        (DESCRIPTION.replace('pan = "neck_pan"', 'pan = "neck_tilt"'), "'neck_pan' turns it, which is none of"),
        (DESCRIPTION.replace('tilt = "neck_tilt"', 'tilt = "arm_base"'), "'neck_tilt' turns it, which is none"),
        (without_neck().replace("[marker]", '[head]\npan = "arm_base"\ntilt = "elbow"\n\n[marker]'),
         "head: the joint 'arm_base' does not turn the camera"),
    ],
)  # fmt: skip
def test_a_contradiction_is_named(text: str, error: str, tmp_path: Path) -> None:
    with pytest.raises(cocoro.ConfigError, match=error):
        Robot.load(Path(written(tmp_path, text)))
