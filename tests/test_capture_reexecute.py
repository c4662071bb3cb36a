"""Re-execution: equal outputs where nothing has changed; otherwise a report of where, what and by how much."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import msgspec
import pytest
from capture_rig import Room, drive, record

from apps.captures.compare import difference
from apps.captures.reexecute import ReexecutionResult, reexecute
from apps.captures.rewrite import info_in, rewrite
from apps.cli.main import main
from cocoro import topics
from cocoro.capture.conventions import CaptureError
from cocoro.capture.reader import Capture, Record
from cocoro.clock import NS
from cocoro.core import Core, Output, Sample, Schedule, Take
from cocoro.messages import Detections, PlannerStatus
from services.capture.keys import QueuedMessage, lossy
from services.capture.packing import Packer
from services.capture.writer import CaptureWriter, FileLimits
from services.perception import service as perception
from services.planning import service as planning
from services.planning.config import PlanningConfig

GOLDEN = Path(__file__).parent / "golden" / "fetch.mcap"
TOLERANCE = 1e-3
"""Tolerance across machines: a thousandth of a number, or of 1 below 1. Another processor may add in another order."""


def again(path: Path, service: str, tolerance: float = 0.0) -> ReexecutionResult:
    with Capture.open(path) as capture:
        return reexecute([capture], service, tolerance)


def without(path: Path, out: Path, keep: Callable[[Record], bool], start_ns: int | None = None) -> Path:
    with Capture.open(path) as capture:
        return rewrite(capture, out, Packer("lz4"), keep=keep, start_ns=start_ns).path


def use_core(monkeypatch: pytest.MonkeyPatch, service: ModuleType, make: Callable[..., Core]) -> None:
    """Replace a service's core."""
    monkeypatch.setattr(service, "implementation", replace(service.implementation, core=make))


@pytest.mark.parametrize("service", ["perception", "planning"])
def test_the_golden_capture_is_executed_again_with_equal_outputs(service: str) -> None:
    """Where outputs are meant to change, tests/golden/make.py makes the capture anew."""
    result = again(GOLDEN, service, TOLERANCE)
    assert result.first is None, result.first
    assert result.not_executable == 0
    assert result.equal == result.steps > 250
    assert result.outputs > 100


def test_the_golden_capture_is_small() -> None:
    assert GOLDEN.stat().st_size < 1_000_000


# --- what is different is found -------------------------------------------------------------------


class Changed:
    """A core that changes its nth output of a type. Empty detections do not count."""

    def __init__(self, core: Core, change: Callable[[Any], None], kind: type, number: int) -> None:
        self.reads, self.schedule = core.reads, core.schedule
        self._core, self._change, self._kind, self._left = core, change, kind, number

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        outputs = self._core.step(inputs, now_ns)
        for output in outputs:
            if isinstance(output.message, self._kind) and getattr(output.message, "detections", True):
                self._left -= 1
                if self._left == 0:
                    self._change(output.message)
        return outputs


def test_the_first_difference_is_told_with_its_place_and_size(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def nudge(seen: Detections) -> None:
        seen.detections[0].u_px += 2.5

    make = perception.core
    use_core(monkeypatch, perception, lambda *args: Changed(make(*args), nudge, Detections, 20))
    result = again(GOLDEN, "perception", TOLERANCE)
    assert (result.differing, result.not_executable) == (1, 0)
    assert result.equal == result.steps - 1
    assert result.first is not None
    assert result.first.text.startswith("perception/detections: detections[0].u_px was ")
    assert result.first.text.endswith("by 2.5")
    assert not result.first.after_missing
    assert again(GOLDEN, "perception", 0.1).differing == 0
    arguments = ["capture", "reexecute", str(GOLDEN), "--service", "perception", "--tolerance", str(TOLERANCE)]
    assert main(arguments) == 1
    assert "1 steps differ" in capsys.readouterr().out


def test_a_topic_that_no_recorded_step_has_published_is_new_and_not_compared(monkeypatch: pytest.MonkeyPatch) -> None:
    class Sees(Changed):
        def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
            seen = Detections(frame_seq=0, frame_incarnation=0, width=1, height=1)
            return [*super().step(inputs, now_ns), Output(topics.DETECTIONS, seen)]

    make = planning.core
    use_core(monkeypatch, planning, lambda *args: Sees(make(*args), lambda _: None, Detections, 0))
    result = again(GOLDEN, "planning", TOLERANCE)
    assert result.differing == 0
    assert "perception/detections is new: not compared" in result.changed


def test_outputs_that_are_missing_or_too_many_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    class Mute(Changed):
        def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
            return [output for output in super().step(inputs, now_ns) if not isinstance(output.message, PlannerStatus)]

    make = planning.core
    use_core(monkeypatch, planning, lambda *args: Mute(make(*args), lambda _: None, PlannerStatus, 0))
    result = again(GOLDEN, "planning")
    assert result.equal == 0
    assert result.first is not None
    assert "planning/status" in result.first.text


def test_a_core_that_fails_now_differs(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: object) -> None:
        raise ZeroDivisionError("oh")

    make = planning.core
    use_core(monkeypatch, planning, lambda *args: Changed(make(*args), fail, PlannerStatus, 5))
    result = again(GOLDEN, "planning")
    assert result.differing >= 1
    assert result.first is not None
    assert "ZeroDivisionError: oh" in result.first.text


def test_equal_outputs_exit_with_0_and_json_says_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["capture", "reexecute", str(GOLDEN), "--service", "perception", "--tolerance", str(TOLERANCE)]
    assert main(arguments) == 0
    assert "every one equal" in capsys.readouterr().out
    assert main([*arguments, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["steps"] == told["equal"]
    assert main([*arguments, "--against", "nothing"]) == 0


# --- what cannot be executed is never equal -------------------------------------------------------


def test_a_step_whose_input_is_missing_is_counted_and_not_equal(tmp_path: Path) -> None:
    path = without(
        GOLDEN, tmp_path / "few.mcap", lambda each: not (each.key.endswith("/frame") and each.sequence == 12)
    )
    result = again(path, "perception", TOLERANCE)
    assert result.reasons["the capture lacks an input of kinect/frame"] == 1
    assert result.equal + result.differing + result.not_executable == result.steps
    assert result.not_executable >= 1


def test_a_step_whose_output_is_missing_is_not_equal_either(tmp_path: Path) -> None:
    path = without(
        GOLDEN, tmp_path / "few.mcap", lambda each: not (each.key.endswith("planning/status") and each.sequence == 30)
    )
    result = again(path, "planning", TOLERANCE)
    assert (result.not_executable, result.equal) == (1, result.steps - 1)
    assert result.reasons == {"the capture lacks an output on planning/status": 1}


def test_steps_before_the_capture_began_are_counted_as_not_executable(tmp_path: Path) -> None:
    with Capture.open(GOLDEN) as capture:
        start_ns = capture.start_ns + 2 * NS
    path = without(GOLDEN, tmp_path / "late.mcap", lambda _: True, start_ns)
    result = again(path, "perception", TOLERANCE)
    assert result.reasons["its record is missing"] > 50
    assert result.first is None or result.first.after_missing


def test_lossy_frames_are_no_inputs(tmp_path: Path) -> None:
    path = tmp_path / "lossy.mcap"
    with Capture.open(GOLDEN) as capture:
        infos = {key: info_in(capture, capture.keys[key][0]) for key in capture.keys}
        out = CaptureWriter(lambda _: path, Packer("lz4"), FileLimits(), lambda key, _: infos[key], prepare=lossy(80))
        for name, entries in capture.metadata.items():
            out.remember(name, entries)
        for each in capture.messages():
            out.put(QueuedMessage(each.key, each.sequence, each.log_ns, each.publish_ns, bytes(each.payload)))
        out.close()
    result = again(path, "perception", TOLERANCE)
    assert result.reasons == {"the capture lacks an input of kinect/frame": result.not_executable}
    assert result.not_executable > 50


def test_a_repeated_message_does_not_take_the_place_of_the_one_that_was_consumed(tmp_path: Path) -> None:
    """Readers reject it by its number, whatever its content."""
    path = tmp_path / "repeated.mcap"
    with Capture.open(GOLDEN) as capture:
        infos = {key: info_in(capture, capture.keys[key][0]) for key in capture.keys}
        out = CaptureWriter(lambda _: path, Packer("lz4"), FileLimits(), lambda key, _: infos[key])
        for name, entries in capture.metadata.items():
            out.remember(name, entries)
        for each in capture.messages():
            message = QueuedMessage(each.key, each.sequence, each.log_ns, each.publish_ns, bytes(each.payload))
            out.put(message)
            if each.key.endswith("base/state"):
                wrong = msgspec.msgpack.decode(each.payload) | {"odometry_m": (9.0, 9.0)}
                out.put(message._replace(payload=msgspec.msgpack.encode(wrong)))
        out.close()
    result = again(path, "planning", TOLERANCE)
    assert result.equal == result.steps > 200


@pytest.mark.parametrize(
    ("service", "words"),
    [
        ("executive", "has no pure core"),
        ("nobody", "no configuration of nobody; services with one: arm, base, capture, executive"),
        ("planning", r"no steps of planning; set record_steps = true"),
    ],
)
def test_a_capture_that_does_not_have_what_it_takes_is_told_of(service: str, words: str, tmp_path: Path) -> None:
    path = without(GOLDEN, tmp_path / "less.mcap", lambda each: not each.key.endswith("/steps"))
    with Capture.open(path) as capture, pytest.raises(CaptureError, match=words):
        reexecute([capture], service)


# --- a core of a third party, over restarts -------------------------------------------------------


class Adder:
    """Counts the states since its start."""

    reads: Mapping[Any, Take] = {topics.BASE_STATE: "all"}
    schedule = Schedule(None, (topics.BASE_STATE,))

    def __init__(self) -> None:
        self._count = 0

    def step(self, inputs: Sequence[Sample], now_ns: int) -> Sequence[Output]:
        self._count += len(inputs)
        return [Output(topics.PLAN, PlannerStatus(why=f"{self._count} states"))]


def test_each_start_of_a_service_is_a_new_core(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def twice(room: Room) -> None:
        for _ in range(2):
            node = room.node("planning", record_steps=True, module=planning.__name__, config=PlanningConfig())
            async with node:
                driving = asyncio.ensure_future(node.drive(Adder()))
                await drive(room, 1.0, frames=False)
                driving.cancel()

    path = record(tmp_path / "twice.mcap", twice)
    use_core(monkeypatch, planning, lambda *_: Adder())
    result = again(path, "planning")
    assert result.steps == result.equal > 80
    only = Adder()
    use_core(monkeypatch, planning, lambda *_: only)
    assert again(path, "planning").differing > 40


def test_the_latency_of_a_service_is_in_the_stamps_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    async def slow(room: Room) -> None:
        node = room.node(
            "planning", record_steps=True, module=planning.__name__, config=PlanningConfig(), latency_s=0.05
        )
        async with node:
            driving = asyncio.ensure_future(node.drive(Adder()))
            await drive(room, 1.0, frames=False)
            driving.cancel()

    path = record(tmp_path / "slow.mcap", slow)
    use_core(monkeypatch, planning, lambda *_: Adder())
    assert again(path, "planning").differing == 0


# --- equal by meaning -----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("recorded", "now", "tolerance", "words"),
    [
        ({"a": 1.0}, {"a": 1}, 0.0, ""),
        ({"a": [1, {"b": 2.0}]}, {"a": [1, {"b": 2.5}]}, 0.0, "a[1].b was 2.0 and is 2.5, by 0.5"),
        ({"a": 1000.0}, {"a": 1000.9}, 1e-3, ""),
        ({"a": 1000.0}, {"a": 1001.1}, 1e-3, "a was 1000.0 and is 1001.1, by 1.1"),
        ({"stamp_ns": 10**9}, {"stamp_ns": 10**9 + 1}, 1e-3, "stamp_ns was"),
        ({"a": [1, 2]}, {"a": [1]}, 0.0, "a (its length) was 2 and is 1"),
        ({"a": 1}, {}, 0.0, "a was 1 and is absent"),
        ({"a": float("nan")}, {"a": float("nan")}, 0.0, ""),
        ({"a": None}, {"a": 0.0}, 1.0, "a was None and is 0.0"),
        ({"a": True}, {"a": 1}, 0.0, "a was True and is 1"),
        ({"why": "0.500 m to go"}, {"why": "0.5001 m to go"}, 1e-3, ""),
        ({"why": "0.5 m to go"}, {"why": "0.5 m to come"}, 1e-3, "why was '0.5 m to go'"),
        ({"why": "0.5 m"}, {"why": "0.50 m"}, 0.0, "why was '0.5 m'"),
    ],
)
def test_messages_are_compared_by_meaning(recorded: Any, now: Any, tolerance: float, words: str) -> None:
    found = difference(recorded, now, tolerance)
    assert (found.text if found else "").startswith(words)
    assert bool(found) is bool(words)
