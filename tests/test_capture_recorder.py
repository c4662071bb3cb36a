"""The recorder on the mesh: it receives everything, keeps what fits, counts the rest, and never delays the robot."""

from __future__ import annotations

import asyncio
import json
import os
import stat
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from capture_rig import ROBOT, STILL, Room, all_of, drive, entry, record, writer

from cocoro import topics
from cocoro.bus.base import Payload, Qos
from cocoro.bus.local import LocalMesh
from cocoro.capture.reader import Capture
from cocoro.clock import NS, FollowedClock
from cocoro.component import load
from cocoro.core import Sample, Schedule, Take
from cocoro.errors import CocoroError, RemoteError
from cocoro.messages import AboutReply, BaseState, CancelRequest, ClockTick, Recording, TaskReply
from cocoro.node import RECORDER_S, Node
from cocoro.testing import settle
from cocoro.vloop import run_virtual
from deploy import profiles
from deploy.processes import named
from services.capture.config import CaptureConfig, folder_of
from services.capture.file import LARGE_BYTES
from services.capture.sink import RESERVE_BYTES, Syncer, ThreadedSink
from services.capture.writer import CaptureWriter


def test_every_message_of_every_key_is_there_with_its_stamp_and_number(tmp_path: Path) -> None:
    path = record(tmp_path / "drive.mcap", drive)
    states = all_of(path, "base/state")
    assert [each.sequence for each in states] == list(range(100))
    with Capture.open(path) as capture:
        messages = [capture.read(each) for each in states]
        assert [message.odometry_m[0] for message in messages] == [tick / 50 for tick in range(100)]  # type: ignore[attr-defined]
        assert [each.publish_ns for each in states][1:] == [m.stamp_ns for m in messages][1:]  # type: ignore[attr-defined]
        assert len(list(capture.messages("kinect/frame"))) == 20
        assert {"calliope/base/health", "calliope/capture/recording"} <= set(capture.keys)


def test_keys_never_heard_of_are_recorded_too(tmp_path: Path) -> None:
    async def strangers(room: Room) -> None:
        bus = room.mesh.join()
        for key, payload in (
            ("calliope/lidar/scan", b"\x81\xa1r\x05"),
            ("calliope/a/b/c/d", b"\xc1"),
            ("other/x/y", b""),
        ):
            bus.publisher(key, Qos.STATE).put(payload)
        await asyncio.sleep(0.1)

    found = {each.key: bytes(each.payload) for each in all_of(record(tmp_path / "new.mcap", strangers))}
    assert found["calliope/lidar/scan"] == b"\x81\xa1r\x05"
    assert found["calliope/a/b/c/d"] == b"\xc1"
    assert "other/x/y" not in found


def test_requests_are_recorded_with_their_answers_refusals_and_errors(tmp_path: Path) -> None:
    async def ask(room: Room) -> None:
        async def cancel(request: CancelRequest) -> TaskReply:
            if request.task_id == "odd":
                raise CocoroError("that is odd")
            return TaskReply(accepted=False, text="nothing runs")

        async with room.node("executive") as executive, room.node("operator") as operator:
            executive.serve(topics.CANCEL, cancel)
            await operator.call(topics.CANCEL, CancelRequest(task_id="x"))
            with pytest.raises(RemoteError, match="that is odd"):
                await operator.call(topics.CANCEL, CancelRequest(task_id="odd"))
            await operator.bus.call("calliope/executive/cancel", b"\x91", 1.0)

    path = record(tmp_path / "ask.mcap", ask)
    with Capture.open(path) as capture:
        told = [capture.decode(each) for each in capture.messages("executive/requests")]
    told = [each for each in told if each["request"] == "executive/cancel"]
    assert told[0]["question"] == {"task_id": "x"}
    assert told[0]["answer"]["text"] == "nothing runs"
    assert told[1]["error"] == "that is odd"
    assert told[1]["answer"] is None
    assert "not a good CancelRequest" in told[2]["error"]


def test_liveliness_is_recorded_as_it_changes_and_each_service_says_what_it_was_started_with(tmp_path: Path) -> None:
    async def come_and_go(room: Room) -> None:
        for _ in range(2):
            async with room.node(
                "base", module="parts.base", config=CaptureConfig(keep_gb=3.0), latency_s=0.25
            ) as base:
                base.ready()
                await asyncio.sleep(0.5)
            await asyncio.sleep(0.5)

    path = record(tmp_path / "alive.mcap", come_and_go)
    with Capture.open(path) as capture:
        alive = [capture.read(each).alive for each in capture.messages("base/alive")]  # type: ignore[attr-defined]
        told = capture.metadata["service/base"]
        description = capture.metadata["robot"]["description"]
    assert alive == [True, False, True, False]
    assert told["module"] == "parts.base"
    assert json.loads(told["config"])["keep_gb"] == 3.0
    assert float(told["latency_s"]) == 0.25
    assert "numpy" in json.loads(told["versions"])
    assert json.loads(description)["name"] == "calliope"


def test_a_service_that_is_too_busy_at_its_start_is_asked_again(tmp_path: Path) -> None:
    async def busy(room: Room) -> None:
        async def answer(_: str, __: Payload) -> bytes:
            asked.append(room.clock.now_ns())
            if len(asked) == 1:
                await asyncio.sleep(60.0)
            return msgspec.msgpack.encode(AboutReply(service="base", robot="calliope", module="parts.slow"))

        bus = room.mesh.join()
        bus.serve("calliope/base/about", answer)
        bus.declare_alive("calliope/base/alive")
        await asyncio.sleep(10.0)

    asked: list[int] = []
    path = record(tmp_path / "busy.mcap", busy)
    assert len(asked) == 2
    with Capture.open(path) as capture:
        assert capture.metadata["service/base"]["module"] == "parts.slow"


def test_it_tells_simulated_time_by_what_it_hears_and_is_not_woken_for_it_besides(tmp_path: Path) -> None:
    async def scenario() -> None:
        mesh, clock = LocalMesh(), FollowedClock()
        key = topics.CLOCK.key("calliope")
        component = load(named("capture"))
        config = component.config(file=str(tmp_path / "time.mcap"))
        async with Node("capture", mesh.join(), clock, ROBOT, config=config) as node:
            recording = asyncio.ensure_future(component.run(node, config))
            ticks = mesh.join().publisher(key, Qos.STATE)
            await settle()
            ticks.put(msgspec.msgpack.encode(ClockTick(stamp_ns=70 * NS, incarnation=1)))
            ticks.put(b"\xc1 no clock")
            await settle()
            assert 70 * NS <= node.now_ns() < 71 * NS
            mesh.join().declare_alive("calliope/base/alive")
            await settle()
            recording.cancel()
            await asyncio.gather(recording, return_exceptions=True)
            assert key not in [subscription.keyexpr for subscription in mesh.subscriptions]

    asyncio.run(scenario())
    (alive,) = all_of(tmp_path / "time.mcap", "base/alive")
    assert 70 * NS <= alive.publish_ns < 71 * NS
    assert [bytes(each.payload) for each in all_of(tmp_path / "time.mcap", "sim/clock")][1:] == [b"\xc1 no clock"]


def test_what_is_not_wanted_is_not_recorded(tmp_path: Path) -> None:
    path = record(tmp_path / "few.mcap", drive, only=("base/**", "frames"), without=("*/health",))
    assert {each.key.partition("/")[2] for each in all_of(path)} == {
        "base/state",
        "base/alive",
        "kinect/frame",
        "base/requests",
    }


def test_two_recordings_of_one_scenario_are_equal_to_the_byte(tmp_path: Path) -> None:
    first = record(tmp_path / "same.mcap", drive).read_bytes()
    (tmp_path / "same.mcap").unlink()
    assert record(tmp_path / "same.mcap", drive).read_bytes() == first


def test_what_never_arrived_is_counted_by_key(tmp_path: Path) -> None:
    async def lossy(room: Room) -> None:
        put = room.mesh.join().publisher("calliope/base/state", Qos.STATE).put
        for seq in (0, 1, 4, 5, 9):
            put(msgspec.msgpack.encode(BaseState(seq=seq, incarnation=7, odometry_m=(0.0, 0.0), **STILL)))
        put(msgspec.msgpack.encode(BaseState(seq=0, incarnation=8, odometry_m=(0.0, 0.0), **STILL)))
        await asyncio.sleep(1.5)

    path = record(tmp_path / "lossy.mcap", lossy)
    with Capture.open(path) as capture:
        assert json.loads(capture.metadata["tally"]["lost"]) == {"calliope/base/state": 5}
        newest = [capture.read(each) for each in capture.messages("capture/recording")][-1]
        assert isinstance(newest, Recording)
        assert newest.lost == {"calliope/base/state": 5}


def test_a_sequence_number_that_cannot_be_right_is_no_loss(tmp_path: Path) -> None:
    async def leaping(room: Room) -> None:
        put = room.mesh.join().publisher("calliope/base/state", Qos.STATE).put
        for seq in (0, 1, 1 << 62, 2, 3, 5):
            put(msgspec.msgpack.encode(BaseState(seq=seq, incarnation=7, odometry_m=(0.0, 0.0), **STILL)))
        await asyncio.sleep(0.1)

    path = record(tmp_path / "leaping.mcap", leaping)
    assert len(all_of(path, "base/state")) == 6
    with Capture.open(path) as capture:
        assert json.loads(capture.metadata["tally"]["lost"]) == {"calliope/base/state": 1}


def test_a_fault_of_the_disk_is_told_on_the_mesh_and_the_robot_goes_on(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    told: list[Recording] = []
    health: list[Any] = []

    async def scenario(room: Room) -> None:
        async with room.node("operator") as operator:
            operator.on(topics.RECORDING.of("capture"), told.append)
            operator.on(topics.HEALTH.of("capture"), health.append)
            states = operator.stream(topics.BASE_STATE)
            await drive(room, 2.0)
            assert [(await states.next()).seq for _ in range(100)] == list(range(100))

    run_virtual(Room().recorded({"folder": str(tmp_path / "file" / "captures")}, scenario))
    assert "recording has stopped" in told[-1].fault
    assert health[-1].state == "degraded"
    assert str(tmp_path) in health[-1].faults[0]


def test_a_full_disk_in_the_middle_of_a_run_is_told_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[Recording] = []

    async def scenario(room: Room) -> None:
        async with room.node("operator") as operator:
            operator.on(topics.RECORDING.of("capture"), told.append)
            await drive(room, 1.0)
            monkeypatch.setattr("services.capture.file.os.writev", _refuse)
            await drive(room, 1.0)

    run_virtual(Room().recorded({"file": str(tmp_path / "full.mcap")}, scenario))
    assert [bool(each.fault) for each in told] == sorted(bool(each.fault) for each in told)
    assert "No space left on device" in told[-1].fault
    with Capture.open(tmp_path / "full.mcap") as capture:
        assert capture.problems == []
        assert len(list(capture.messages("base/state"))) >= 45


def _refuse(*_: object) -> int:
    raise OSError(28, "No space left on device")


# --- off the loop ---------------------------------------------------------------------------------


class Stalled:
    """A disk that does not answer until it is released."""

    def __init__(self, folder: Path) -> None:
        self.go = threading.Event()
        self._folder = folder

    def make(self, release: Callable[[int], None] | None) -> CaptureWriter:
        self.go.wait()
        return writer(self._folder)


def test_while_the_disk_stalls_memory_is_bounded_and_large_messages_are_dropped_before_small_ones(
    tmp_path: Path,
) -> None:
    stalled = Stalled(tmp_path)
    sink = ThreadedSink(stalled.make, capacity_bytes=10 * LARGE_BYTES, flush_s=0.1, sync_s=0.5)
    large, small = bytes(LARGE_BYTES), b"small"
    taken = [sink.offer(entry("kinect/frame", n, large)) for n in range(20)]
    assert taken == [True] * 10 + [False] * 10
    assert all(sink.offer(entry("base/state", n, small)) for n in range(20, 1000))
    assert not sink.offer(entry("base/state", 1000, bytes(RESERVE_BYTES)))
    assert sink.progress().waiting_bytes <= 10 * LARGE_BYTES + RESERVE_BYTES
    stalled.go.set()
    sink.close()
    assert sink.progress().waiting_bytes == 0
    found = all_of(tmp_path / "one-1.mcap")
    assert [each.sequence for each in found] == [*range(10), *range(20, 1000)]


def test_what_is_given_after_a_fault_is_forgotten(tmp_path: Path) -> None:
    def fail(_: object) -> CaptureWriter:
        raise ZeroDivisionError("a bug")

    sink = ThreadedSink(fail, capacity_bytes=10, flush_s=0.1, sync_s=0.5)
    sink._thread.join()
    assert all(sink.offer(entry("base/state", n, bytes(100))) for n in range(100))
    assert "ZeroDivisionError: a bug" in sink.progress().fault
    sink.close()


@pytest.mark.parametrize("sync_s", [0.2, CaptureConfig().sync_s, 0.8])
def test_the_disk_is_made_sure_of_at_least_once_a_second(sync_s: float, tmp_path: Path) -> None:
    waited_s = 0.0
    at_s: list[float] = []

    def wait(_: threading.Event, seconds: float) -> bool:
        nonlocal waited_s
        waited_s += seconds
        return waited_s > 10.0

    with (tmp_path / "file").open("wb") as file:
        syncer = Syncer(sync_s, file.fileno, lambda _: at_s.append(waited_s), wait)
        syncer.run()
    assert syncer.count == len(at_s) >= 10
    assert max(b - a for a, b in zip([0.0, *at_s], at_s, strict=False)) <= 1.0


def test_a_whole_file_is_synced_before_it_is_let_go(tmp_path: Path) -> None:
    synced: list[tuple[int, bool]] = []
    syncer = Syncer(0.5, lambda: None, lambda fd: synced.append((fd, stat.S_ISDIR(os.fstat(fd).st_mode))))
    files = [writer(tmp_path / str(n), release=syncer.release) for n in range(2)]
    numbers = [each.file.fileno() for each in files]
    for each in files:
        each.close()
    assert synced == []
    syncer.close()
    folders, whole = synced[:2], synced[2:]
    assert all(is_folder for _, is_folder in folders)  # so that the files' names survive a loss of power
    assert whole == [(number, False) for number in numbers]
    assert all_of(tmp_path / "0" / "one-1.mcap") == []


def test_steps_that_are_to_be_recorded_begin_when_a_recorder_hears_them() -> None:
    class Counter:
        reads: Mapping[Any, Take] = {}
        schedule = Schedule(10.0)

        def step(self, inputs: Sequence[Sample], now_ns: int) -> tuple[()]:
            begun.append(now_ns)
            return ()

    begun: list[int] = []

    async def scenario(with_recorder: bool) -> None:
        room = Room()
        async with room.node("planning", record_steps=True) as node:
            driving = asyncio.ensure_future(node.drive(Counter()))
            await asyncio.sleep(1.0)
            if with_recorder:
                room.mesh.join().declare_alive("calliope/tape/recorder")
            await asyncio.sleep(RECORDER_S)
            driving.cancel()

    run_virtual(scenario(True))
    assert begun[0] == NS
    begun.clear()
    run_virtual(scenario(False))
    assert begun[0] == round(RECORDER_S * NS)


@pytest.mark.parametrize("name", ["robot", "sim", "sim-wire"])
def test_the_recorder_is_part_of_every_profile_that_has_a_robot(name: str) -> None:
    profile = profiles.read(name)
    assert profile.processes[0] == "capture"  # started first, stopped last
    assert all(profile.launch(service).record_steps for service in ("perception", "planning"))


def test_captures_go_where_operator_or_environment_say(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("COCORO_CAPTURE_DIR", raising=False)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "state"))
    assert folder_of(CaptureConfig()) == tmp_path / "state" / "cocoro" / "captures"
    monkeypatch.setenv("COCORO_CAPTURE_DIR", str(tmp_path / "env"))
    assert folder_of(CaptureConfig()) == tmp_path / "env"
    assert folder_of(CaptureConfig(folder=str(tmp_path / "said"))) == tmp_path / "said"


def test_a_node_answers_what_it_was_started_with() -> None:
    async def scenario() -> None:
        room = Room()
        async with room.node("base") as base, room.node("operator") as operator:
            base.ready()
            reply = await operator.call(topics.ABOUT.of("base"), topics.ABOUT.request())
            assert reply.service == "base"
            assert reply.description["name"] == "calliope"

    run_virtual(scenario())
