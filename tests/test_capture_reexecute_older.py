"""Re-execution of captures that an older version recorded: other fields, other settings."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from test_capture_reexecute import GOLDEN, TOLERANCE, again

from apps.captures.recorded import origins
from apps.captures.reexecute import describe_result
from apps.captures.rewrite import info_in
from apps.rehearsal.lockstep import LockstepPlanner
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture
from cocoro.messages import BaseCommand
from cocoro.robot import Robot
from services.capture.keys import QueuedMessage
from services.capture.packing import Packer
from services.capture.writer import CaptureWriter, FileLimits
from services.planning.core import PlanningCore


def of_an_older_version(out: Path, change: Callable[[dict[str, Any]], None] = lambda _: None) -> Path:
    """The golden capture as if the planner's status had no `model` and another field, an object no `sigma_m`, an intent
    its action's name and fields beside each other, and a command of the base the speeds of its wheels."""
    base = Robot.load().base

    def older(name: str, payload: bytes) -> bytes:
        if name == "BaseCommand":
            left_mps, right_mps = base.drive.wheels_of(msgspec.msgpack.decode(payload, type=BaseCommand))
            command = {**msgspec.msgpack.decode(payload), "left_mps": left_mps, "right_mps": right_mps}
            for field in ("ahead_mps", "turn_radps", "aside_mps"):
                command.pop(field, None)
            return msgspec.msgpack.encode(command)
        if name == "Intent":
            intent = msgspec.msgpack.decode(payload)
            asked = intent.pop("action")
            return msgspec.msgpack.encode({**intent, "behaviour": asked.pop("action"), **asked})
        if name != "PlannerStatus":
            return payload
        status = msgspec.msgpack.decode(payload)
        del status["model"]
        for known in (*status["known"], *filter(None, [status["target"]])):
            del known["sigma_m"]
        change(status)
        return msgspec.msgpack.encode({**status, "mood": "good"})

    with Capture.open(GOLDEN) as capture:
        infos = {key: info_in(capture, capture.keys[key][0]) for key in capture.keys}
        schema = infos["calliope/planning/status"].schema
        assert schema is not None
        then = json.loads(schema.data)
        del then["properties"]["model"]
        del then["$defs"]["TargetEstimate"]["properties"]["sigma_m"]
        then["properties"]["mood"] = {"type": "string"}
        for key, names in (
            ("calliope/executive/intent", {"action": "behaviour"}),
            ("calliope/base/command", {"ahead_mps": "left_mps", "turn_radps": "right_mps"}),
        ):
            kind = infos[key].schema
            assert kind is not None
            shape = json.loads(kind.data)
            for name, former in names.items():
                shape["properties"][former] = shape["properties"].pop(name)
            infos[key] = infos[key]._replace(schema=kind._replace(data=json.dumps(shape).encode()))
        infos["calliope/planning/status"] = infos["calliope/planning/status"]._replace(
            schema=schema._replace(data=json.dumps(then).encode())
        )
        written = CaptureWriter(lambda _: out, Packer("lz4"), FileLimits(), lambda key, _: infos[key])
        for name, entries in capture.metadata.items():
            written.remember(name, entries)
        for each in capture.messages():
            kind = infos[each.key].schema
            payload = older("" if kind is None else kind.name, bytes(each.payload))
            written.put(QueuedMessage(each.key, each.sequence, each.log_ns, each.publish_ns, payload))
        written.close()
    return out


def test_outputs_of_an_older_version_are_compared_by_the_fields_that_both_have(
    tmp_path: Path,
) -> None:
    path = of_an_older_version(tmp_path / "older.mcap")
    result = again(path, "planning", TOLERANCE)
    assert result.first is None, result.first
    assert result.equal == result.steps > 250
    assert set(result.changed) == {
        "calliope/planning/status: mood is gone: ignored",
        "calliope/planning/status: model is new: gets its default",
        "calliope/planning/status: TargetEstimate.sigma_m is new: gets its default",
        "calliope/perception/detections: Detection.sigma_m is new: gets its default",
        "calliope/executive/intent: Intent has changed: its former shape is converted",
        "calliope/base/state: aside_mps is new: gets its default",
        "calliope/base/command: BaseCommand has changed: its former shape is converted",
    }
    assert any("changed since, calliope/planning/status: model is new" in line for line in describe_result(result))


def test_what_differs_is_found_in_a_capture_of_an_older_version_too(tmp_path: Path) -> None:
    def move(status: dict[str, Any]) -> None:
        for known in status["known"]:
            known["position_m"][0] += 0.25

    result = again(of_an_older_version(tmp_path / "older.mcap", move), "planning", TOLERANCE)
    assert result.first is not None
    assert result.first.text.startswith("planning/status: known[0].position_m[0] was ")


def started_otherwise(out: Path, change: Callable[[dict[str, Any]], object]) -> Path:
    """The golden capture as if the planner had had other settings."""
    with Capture.open(GOLDEN) as capture:
        infos = {key: info_in(capture, capture.keys[key][0]) for key in capture.keys}
        written = CaptureWriter(lambda _: out, Packer("lz4"), FileLimits(), lambda key, _: infos[key])
        for name, entries in capture.metadata.items():
            if name == "service/planning":
                config = json.loads(entries["config"])
                change(config)
                entries["config"] = json.dumps(config)
            written.remember(name, entries)
        for each in capture.messages():
            written.put(QueuedMessage(each.key, each.sequence, each.log_ns, each.publish_ns, bytes(each.payload)))
        written.close()
    return out


def test_a_setting_that_has_come_since_takes_its_default(tmp_path: Path) -> None:
    result = again(
        started_otherwise(tmp_path / "older.mcap", lambda config: config.pop("rate_hz")), "planning", TOLERANCE
    )
    assert result.equal == result.steps > 250


def test_a_setting_that_is_no_more_ends_it_with_its_name(tmp_path: Path) -> None:
    path = started_otherwise(tmp_path / "older.mcap", lambda config: config.update(mood=3))
    with pytest.raises(CaptureError, match=r"older\.mcap: the start of planning cannot be repeated: .*mood"):
        again(path, "planning")


@pytest.mark.parametrize(("coordination", "kind"), [("concurrent", PlanningCore), ("lockstep", LockstepPlanner)])
def test_the_planner_s_former_setting_coordination_chooses_the_core(
    coordination: str, kind: type[PlanningCore], tmp_path: Path
) -> None:
    path = started_otherwise(tmp_path / "older.mcap", lambda config: config.update(coordination=coordination))
    with Capture.open(path) as capture, origins([capture], "planning") as made:
        assert [type(origin.core()) for origin in made] == [kind]
