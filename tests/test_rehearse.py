"""Rehearsals: the whole robot in one process, judged by the truth, and repeatable to the last bit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest
from robot_rig import RobotRig
from spelled import asked

import cocoro
from apps.rehearsal.rehearse import rehearse
from apps.rehearsal.request import RehearsalRequest
from cocoro import topics
from cocoro.core import Core
from cocoro.errors import ConfigError
from cocoro.objects import Catalogue
from cocoro.robot import Robot
from cocoro.testing import execute_again, in_virtual_time
from services.perception.config import PerceptionConfig
from services.perception.core import PerceptionCore
from services.planning.config import PlanningConfig
from services.planning.core import PlanningCore

pytestmark = pytest.mark.sim

ONLY_GREEN = """
name = "only green"
[[object]]
label = "green_can"
shape = "cylinder"
radius_m = 0.033
height_m = 0.12
position_m = [1.2, -0.4]
"""


def small(task: str = "fetch", label: str = "red_can", **more: Any) -> RehearsalRequest:
    """A request for a rehearsal with small frames, at half their rate."""
    return RehearsalRequest(task=asked(task, label).task, width=320, height=240, frame_rate_hz=15.0, **more)


REAL = small(sensors="real", seed=3)


@pytest.fixture(scope="module")
def fetched() -> dict[str, Any]:
    """The red can of the paper's scene, with real sensors."""
    return rehearse(REAL)


def test_a_fetched_can_is_truly_held_and_nothing_else_was_touched(fetched: dict[str, Any]) -> None:
    assert (fetched["outcome"], fetched["reason"]) == ("done", "")
    truth = fetched["truth"]
    assert truth["held"]
    assert truth["lifted_m"] > 0.10
    assert truth["target_moved_m"] < 0.03
    assert (truth["knocked_over"], truth["collisions"]) == ((), ())


def test_the_result_says_what_was_done_and_how_long_each_part_took(fetched: dict[str, Any]) -> None:
    assert fetched.keys() >= {"task", "label", "seed", "outcome", "reason", "sim_s", "wall_s", "phases", "truth"}
    assert [phase["name"] for phase in fetched["phases"]] == ["search", "approach", "reach", "grasp", "lift", "hold"]
    assert sum(phase["sim_s"] for phase in fetched["phases"]) == pytest.approx(fetched["sim_s"], abs=0.05)
    assert fetched["wall_s"] > 0.0


def test_equal_requests_give_equal_results_whatever_the_sensors_draw(fetched: dict[str, Any]) -> None:
    assert rehearse(REAL) | {"wall_s": 0} == fetched | {"wall_s": 0}


def test_in_lock_step_the_same_robot_is_slower(fetched: dict[str, Any]) -> None:
    lockstep = rehearse(msgspec.structs.replace(REAL, lockstep=True))
    assert lockstep["outcome"] == "done"
    assert lockstep["truth"]["held"]
    assert lockstep["sim_s"] > fetched["sim_s"] + 1.0


def test_what_is_not_there_is_not_found_and_the_robot_stands(tmp_path: Path) -> None:
    scene = tmp_path / "green.toml"
    scene.write_text(ONLY_GREEN)
    result = rehearse(small(scene=str(scene), seen_within_m=2.0))
    assert result["outcome"] == "failed"
    assert result["reason"].startswith("not_found: every place within 2.0 m where red_can could stand was seen")
    floor = result["seen_floor"]
    assert floor["missed"] <= 3, "of 5,000 cells: the rim of the can and a strip of its shadow"
    assert floor["hiding"] == 0
    assert floor["cells"] - floor["seen"] - floor["unseeable"] == floor["missed"]
    assert result["sim_s"] < 90.0
    assert not result["truth"]["collisions"]
    assert not result["truth"]["knocked_over"]


def test_what_cannot_be_asked_is_refused() -> None:
    with pytest.raises(cocoro.TaskRefusedError, match=r"unknown object 'teapot'; known are .*red_can"):
        rehearse(small(label="teapot"))
    with pytest.raises(cocoro.TaskRefusedError, match="the hand holds nothing"):
        rehearse(small(task="put-down", label=""))
    with pytest.raises(ConfigError, match=r"--latency planing: no such service; known are .*planning"):
        rehearse(small(latency={"planing": 0.1}))


def test_parking_needs_nothing_to_be_seen_and_tasks_come_one_after_the_other() -> None:
    result = rehearse(small(task="park", label="", scene="follow", wait_s=3.0, then=({"task": "park"},), trace=True))
    assert (result["outcome"], result["truth"]["collisions"]) == ("done", ())
    assert [(step["task"], step["outcome"]) for step in result["tasks"]] == [("park", "done")] * 2
    assert result["trace"]["time_s"][-1] > 2.9, "the world ran for 3 s before"


def test_a_rehearsal_is_of_the_robot_that_is_described(tmp_path: Path) -> None:
    own = tmp_path / "own.toml"
    own.write_text("[base]\nwheel_separation_m = 0.3\n")
    result = rehearse(small(task="park", label="", measured=str(own)))
    assert (result["outcome"], result["body"]["wheel_separation_m"]) == ("done", 0.3)
    with pytest.raises(ConfigError, match=r"robot description .*nothing\.toml"):
        rehearse(small(description=str(tmp_path / "nothing.toml")))


# --- exact re-execution ---------------------------------------------------------------------------


@in_virtual_time
async def test_cores_executed_again_over_what_they_consumed_give_the_same_to_the_last_bit() -> None:
    sensors = {"sim": {"width": 320, "height": 240, "frame_rate_hz": 15.0, "sensors": "real", "seed": 1}}
    async with RobotRig(record_steps=True, settings=sensors) as rig:
        done = await rig.run("fetch", "red_can")
        assert done.outcome == "done"
        samples = rig.tap.samples()
        cores: dict[str, Core] = {
            "planning": PlanningCore(Robot.load(), PlanningConfig()),
            "perception": PerceptionCore(Robot.load(), PerceptionConfig(), Catalogue.load()),
        }
        for name, core in cores.items():
            records = rig.tap.messages(topics.STEPS.of(name))
            executed = execute_again(core, records, samples)
            assert len(executed) > 20 * done.elapsed_s  # of perception 15 detections and 10 scans a second
            different = [step.topic for step in executed if step.again != step.recorded]
            assert different == [], name
