"""From pixel to motor: the times of each stage, from what a capture links."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from apps.captures.latency import Latency, latency
from apps.captures.rewrite import info_in
from apps.cli.main import main
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture, Record
from cocoro.topics import BASE_COMMAND, DETECTIONS, FRAME, STEPS, Topic
from services.capture.keys import QueuedMessage
from services.capture.packing import Packer
from services.capture.writer import CaptureWriter, FileLimits

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"
MS = 1_000_000


def golden(
    path: Path, late_ms: Callable[[Record], float] = lambda _: 0.0, keep: Callable[[Record], bool] = lambda _: True
) -> Path:
    """The golden capture with some messages received later."""
    with Capture.open(GOLDEN) as capture:
        infos = {key: info_in(capture, capture.keys[key][0]) for key in capture.keys}
        out = CaptureWriter(lambda _: path, Packer("lz4"), FileLimits(), lambda key, _: infos[key])
        for name, entries in capture.metadata.items():
            out.remember(name, entries)
        for each in filter(keep, capture.messages()):
            log_ns = each.log_ns + round(late_ms(each) * MS)
            out.put(QueuedMessage(each.key, each.sequence, log_ns, each.publish_ns, bytes(each.payload)))
        out.close()
    return path


def of(record: Record, topic: Topic[Any]) -> bool:
    return record.key.endswith(f"/{topic.name}")


def found(path: Path) -> Latency:
    with Capture.open(path) as capture:
        return latency([capture])


def medians(of: Latency) -> dict[str, float]:
    return {stage.name: stage.median_ms for stage in of.stages}


def test_each_stage_is_from_one_message_to_the_next_that_used_it(tmp_path: Path) -> None:
    # In the golden capture, of virtual time, detections come at once, and the planner steps at once.
    late = {DETECTIONS.name: 4.0, BASE_COMMAND.name: 7.0}
    told = found(golden(tmp_path / "late.mcap", lambda record: late.get(record.key.partition("/")[2], 0.0)))
    assert medians(told) == pytest.approx({"perception": 4.0, "planning": 3.0, "pixel to motor": 7.0}, abs=0.001)
    assert (told.frames, told.seen) == (60, 60)
    assert 40 < told.used < 60, "the wheels are commanded in a part of the task"


def test_one_late_message_is_the_worst_and_not_the_median(tmp_path: Path) -> None:
    told = found(golden(tmp_path / "one.mcap", lambda one: 15.0 * (of(one, DETECTIONS) and one.sequence == 30)))
    perception = told.stages[0]
    assert perception.median_ms < 0.001
    assert 0.001 < perception.p99_ms < perception.worst_ms == pytest.approx(15.0, abs=0.001)


def test_a_command_that_the_capture_lacks_gives_no_time(tmp_path: Path) -> None:
    told = found(golden(tmp_path / "half.mcap", keep=lambda one: not of(one, BASE_COMMAND) or one.sequence < 100))
    assert 0 < told.used < found(GOLDEN).used
    assert medians(told) == pytest.approx(medians(found(GOLDEN)), abs=0.001)


@pytest.mark.parametrize(
    ("topic", "named"),
    [(FRAME, FRAME.name), (DETECTIONS, DETECTIONS.name), (STEPS.of("planning"), "steps of planning")],
)
def test_what_the_capture_lacks_is_named(tmp_path: Path, topic: Topic[Any], named: str) -> None:
    path = golden(tmp_path / "less.mcap", keep=lambda record: not of(record, topic))
    with pytest.raises(CaptureError, match=f"it has no {named}"):
        found(path)


def test_the_command_tells_it_as_a_table_and_as_json(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["capture", "latency", str(GOLDEN)]) == 0
    said = capsys.readouterr().out
    assert "pixel to motor" in said
    assert "60 frames, 60 became detections" in said
    assert main(["capture", "latency", str(GOLDEN), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert [stage["name"] for stage in told["stages"]] == ["perception", "planning", "pixel to motor"]


def test_a_robot_that_stood_still_has_no_times(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = golden(tmp_path / "still.mcap", keep=lambda record: not of(record, BASE_COMMAND))
    assert main(["capture", "latency", str(path)]) == 1
    assert "0 led to a wheel command" in capsys.readouterr().out
