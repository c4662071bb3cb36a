"""Occasions are recorded whole and in a file of their own; of the rest, large messages are recorded now and then."""

from __future__ import annotations

import asyncio
import os
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import pytest
from capture_rig import STILL, Room, all_of
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader
from msgspec import structs

from apps.captures.info import missing_of, report
from apps.captures.recorded import Once
from cocoro import topics
from cocoro.bus.base import Qos
from cocoro.capture.folder import RecordingFolder, captures, make_room, parsed_name, pin_of
from cocoro.capture.occasion import Occasion, occasion_of
from cocoro.capture.reader import Capture
from cocoro.clock import NS
from cocoro.messages import BaseState, Health, Latch, Recording, ServoState, TaskState, TopicHealth
from cocoro.node import Node
from cocoro.vloop import run_virtual
from deploy import profiles
from services.capture.config import CaptureConfig
from services.capture.keys import QueuedMessage, info_of
from services.capture.occasions import Watch
from services.capture.packing import Compression, Packer
from services.capture.thinning import ThinningLimits, ThinningWriter
from services.capture.writer import FileLimits, Missing

HAND = ("wrist_roll", "claw_left", "claw_right")
LARGE = os.urandom(70_000)


class Heard:
    """A watch, and what it says: news and kind of each occasion."""

    def __init__(self) -> None:
        self.news: list[tuple[str, str]] = []
        self.last: Occasion | None = None
        self.watch = Watch("calliope", self._hear)

    def _hear(self, what: str, occasion: Occasion) -> None:
        self.news.append((what, occasion.kind))
        self.last = occasion

    def see(self, topic: topics.Topic[Any], message: Any, at_s: float) -> None:
        self.watch.look(round(at_s * NS))
        self.watch.see(topic.key("calliope"), msgspec.msgpack.encode(message), round(at_s * NS))

    def look(self, at_s: float) -> list[tuple[str, str]]:
        self.watch.look(round(at_s * NS))
        return self.news


def task(task_id: str = "", outcome: Any = None, **fields: Any) -> TaskState:
    return TaskState(task_id=task_id, task="fetch" if task_id else "", label="red_can", outcome=outcome, **fields)


def hand(*angles: float) -> ServoState:
    return ServoState(joints=HAND, position_rad=angles, speed_radps=(0.0,) * 3, load=(0.0,) * 3)


# --- what is an occasion ----------------------------------------------------------------------------


def test_a_task_is_one_from_its_first_state_until_a_while_after_its_outcome() -> None:
    heard = Heard()
    heard.see(topics.TASK, TaskState(), 0.0)
    heard.see(topics.TASK, task("one"), 1.0)
    heard.see(topics.TASK, task("one"), 90.0)
    heard.see(topics.TASK, task("one", "failed", reason="lost: it is gone", elapsed_s=89.0), 90.5)
    assert heard.look(95.0) == [("begin", "task"), ("note", "task")]
    assert heard.look(96.0)[-1] == ("end", "task")
    assert heard.last is not None
    assert (heard.last.what, heard.last.label, heard.last.outcome) == ("fetch red_can", "fetch-red_can", "failed")
    heard.see(topics.TASK, task("one", "failed"), 97.0)  # it is repeated until the next one
    assert len(heard.look(200.0)) == 3


def test_a_task_whose_executive_is_gone_is_none_any_more() -> None:
    heard = Heard()
    heard.see(topics.TASK, task("one"), 1.0)
    heard.watch.alive("executive", False, 2 * NS)
    assert heard.look(2.5) == [("begin", "task")]
    heard.look(3.0)
    assert heard.look(8.5)[-1] == ("end", "task")
    assert heard.last is not None
    assert heard.last.outcome == ""
    assert "executive is gone" in heard.last.notes[-1].text


@pytest.mark.parametrize("later", [TaskState(), task("two", "done"), task("two")], ids=["none", "ended", "running"])
def test_a_task_whose_end_was_not_heard_is_over_when_another_state_comes(later: TaskState) -> None:
    heard = Heard()
    heard.see(topics.TASK, task("one"), 1.0)
    heard.see(topics.TASK, later, 2.0)
    if later.outcome is None and later.task_id:
        heard.see(topics.TASK, task("two", "done"), 3.0)
    assert heard.look(9.0)[-1] == ("end", "task")


def test_a_task_by_the_name_of_nothing_is_one_all_the_same() -> None:
    heard = Heard()
    heard.see(topics.TASK, TaskState(task_id="one", task="idle"), 1.0)
    assert heard.last is not None
    assert heard.last.label == "task-idle"


def test_the_emergency_stop_is_one_and_its_state_after_a_start_is_none() -> None:
    heard = Heard()
    heard.see(topics.LATCH, Latch(state="unknown"), 0.0)
    heard.see(topics.LATCH, Latch(state="released"), 0.2)
    assert heard.look(0.4) == []
    heard.see(topics.LATCH, Latch(state="latched", by="eva"), 1.0)
    assert heard.look(1.2) == [("begin", "stop")]
    assert heard.last is not None
    assert heard.last.what == "emergency stop latched by eva"
    assert heard.look(7.0)[-1] == ("end", "stop")


def test_a_fault_is_one_when_it_is_new() -> None:
    heard = Heard()
    health = topics.HEALTH.of("arm")
    for second in range(30):
        heard.see(health, Health(service="arm", state="ready", faults=(f"elbow: {second} bad packets",)), second)
    assert heard.look(30.0) == [("begin", "fault"), ("end", "fault")]
    late = TopicHealth(key="calliope/arm/command", direction="in", fault="arm/command of planning: 1 rejected: stale")
    heard.see(health, Health(service="arm", state="ready", topics=(late,), faults=(late.fault,)), 30.5)
    assert heard.look(30.6) == [("begin", "fault"), ("end", "fault")]  # a late message is none
    heard.see(health, Health(service="arm", state="degraded", text="no link"), 31.0)
    assert heard.look(31.0)[2:] == [("begin", "fault")]


def test_a_service_that_goes_is_one_unless_it_comes_back_at_once_or_the_robot_is_stopped() -> None:
    heard = Heard()
    heard.watch.alive("base", False, 0)
    heard.watch.alive("base", True, NS // 2)
    assert heard.look(5.0) == []
    heard.watch.alive("base", False, 6 * NS)
    heard.watch.close(round(6.5 * NS))
    assert heard.look(6.6) == []
    assert heard.look(7.0) == [("begin", "fault")]


@pytest.mark.parametrize("topic", [topics.ARM_STATE, topics.HAND_STATE, topics.BASE_STATE], ids=lambda each: each.name)
def test_motion_is_one_and_trembling_is_none(topic: topics.Topic[Any]) -> None:
    def state(moved: float) -> Any:
        if topic is topics.BASE_STATE:
            return BaseState(odometry_m=(0.0, 0.0), **STILL | {"speed_mps": moved / 10})
        return hand(0.0, moved, -moved)

    heard = Heard()
    for tick in range(100):
        heard.see(topic, state(0.03 * (tick % 2)), tick / 50)
    assert heard.look(2.0) == []
    heard.see(topic, state(0.2), 2.02)
    assert heard.look(2.1) == [("begin", "motion")]


def test_what_a_file_says_of_its_occasion_is_read_back() -> None:
    heard = Heard()
    heard.see(topics.TASK, task("17"), 1.0)  # an id that looks like a number
    heard.see(topics.LATCH, Latch(state="released"), 1.0)
    heard.see(topics.LATCH, Latch(state="latched"), 2.0)
    heard.see(topics.TASK, task("17", "cancelled", reason='stop: "now"'), 2.5)
    assert heard.last is not None
    assert occasion_of(heard.last.entries()) == heard.last
    assert occasion_of({"kind": "another program's"}) is None


# --- what is recorded -------------------------------------------------------------------------------


async def stand(room: Room, executive: Node, seconds: float, running: str = "", hz: int = 10) -> None:
    """A robot that stands still: states, and large messages of which no table knows, `hz` times a second."""
    put = room.mesh.join().publisher("calliope/lidar/scan", Qos.STATE).put
    async with room.node("base") as base:
        base.ready()
        for _ in range(round(seconds * hz)):
            base.publish(topics.BASE_STATE, BaseState(odometry_m=(0.0, 0.0), **STILL))
            put(LARGE)
            if running:
                executive.publish(topics.TASK, task(running))
            await asyncio.sleep(1 / hz)


async def one_task(room: Room, before_s: float = 40.0) -> None:
    async with room.node("executive") as executive:
        executive.ready()
        await stand(room, executive, before_s)
        await stand(room, executive, 4.0, "one")
        executive.publish(topics.TASK, task("one", "done", elapsed_s=4.0))
        await stand(room, executive, 10.0)


def recorded(folder: Path, scenario: Any, **settings: Any) -> list[Path]:
    run_virtual(Room().recorded({"folder": str(folder), **settings}, scenario))
    return captures(folder, "calliope")


def span_s(path: Path, key: str) -> tuple[float, float, int]:
    """First and last log time of a key, and its messages."""
    found = all_of(path, key)
    return found[0].log_ns / NS, found[-1].log_ns / NS, len(found)


def test_a_task_has_a_file_of_its_own_with_everything_of_the_seconds_before_it(tmp_path: Path) -> None:
    idle, fetch, after = recorded(tmp_path, one_task)
    assert fetch.name.endswith("-002-fetch-red_can.mcap")
    for key in ("lidar/scan", "base/state"):
        first_s, last_s, count = span_s(fetch, key)
        assert (first_s, last_s) == pytest.approx((37.0, 48.9), abs=0.2)
        assert count == pytest.approx(120, abs=2)
    assert span_s(idle, "base/state")[1] == pytest.approx(40.0, abs=0.2)  # a crash before the task loses no state
    assert span_s(after, "base/state")[0] == pytest.approx(49.0, abs=0.2)
    with Capture.open(fetch) as capture:
        occasion = occasion_of(capture.metadata["occasion"])
        assert capture.whole
    assert occasion is not None
    assert (occasion.task_id, occasion.outcome, occasion.elapsed_s) == ("one", "done", 4.0)
    with Capture.open(after) as capture:
        assert "occasion" not in capture.metadata


def test_while_nothing_happens_what_is_large_is_left_out_and_no_loss(tmp_path: Path) -> None:
    idle, *_ = recorded(tmp_path, one_task, idle_period_s=10.0)
    scans = all_of(idle, "lidar/scan")
    assert [round(each.log_ns / NS) for each in scans] == [0, 10, 20, 30]
    assert len(all_of(idle, "base/state")) == pytest.approx(400, abs=2)
    with Capture.open(idle) as capture:
        missing = missing_of(capture)
        ((start_ns, end_ns),) = capture.left_out
        for check in (False, True):
            found = report(capture, check)
            (lidar,) = [key for key in found.keys if key.key.endswith("lidar/scan")]
            assert not found.problems
            assert (lidar.lost, lidar.dropped, lidar.left_out) == (0, 0, missing.left_out[lidar.key])
            assert any("were left out" in note for note in found.notes)
    assert missing.left_out["calliope/lidar/scan"] + len(scans) == pytest.approx(370, abs=2)
    assert (start_ns / NS, end_ns / NS) == pytest.approx((0.1, 37.0), abs=0.2)


@pytest.mark.parametrize(("compression", "kept"), [("zstd", 30), ("lz4", 30), ("none", 2)])
def test_what_waits_is_packed_as_its_file_packs_it(tmp_path: Path, compression: Compression, kept: int) -> None:
    """30 scans of 100 kB wait in 300 kB, and come out as they were."""
    folder = RecordingFolder(tmp_path, "calliope", datetime(2026, 1, 1, tzinfo=UTC), None, 0)
    held = ThinningLimits(before_s=3.0, before_bytes=300_000, period_s=30.0, idle_file_s=3600.0)
    written = ThinningWriter(
        folder, "calliope", held, Packer(compression), FileLimits(), lambda key, data: info_of(key, "calliope", data),
        lambda: Missing({}, {}),
    )  # fmt: skip
    scans = [bytes([number]) * 100_000 for number in range(40)]
    for number, scan in enumerate(scans):
        if number == 30:
            written.tell("begin", Occasion(kind="stop", what="stop", label="stop", began_ns=0))
        for key, payload in (("arm/health", b"\xc0"), ("lidar/scan", b"\xc0"), ("lidar/scan", scan)):
            at_ns = NS + len(payload) + number * NS // 10
            written.put(QueuedMessage(f"calliope/{key}", number, at_ns, at_ns, payload))
    written.close()
    idle, stop = captures(tmp_path, "calliope")
    whole = [each.payload for each in all_of(stop, "lidar/scan") if len(each.payload) > 1]
    assert whole == scans[30 - kept :]
    for path in (idle, stop):
        with Capture.open(path) as capture:
            assert not report(capture, check=True).problems
        with path.open("rb") as stream:  # another reader, front to back: each message comes after its channel
            declared = set()
            for record in StreamReader(stream, validate_crcs=True).records:
                declared.update([record.id] if isinstance(record, Channel) else [])
                assert not isinstance(record, Message) or record.channel_id in declared


def test_the_run_has_every_message_once_although_files_overlap(tmp_path: Path) -> None:
    found = []
    once = Once()
    for path in recorded(tmp_path, one_task):
        found += [each.sequence for each in once.each(all_of(path, "base/state"))]
    assert len(found) == pytest.approx(540, abs=1)


def test_a_task_right_after_another_has_its_own_file_too(tmp_path: Path) -> None:
    async def two(room: Room) -> None:
        async with room.node("executive") as executive:
            executive.ready()
            for name in ("one", "two"):
                await stand(room, executive, 4.0, name)
                executive.publish(topics.TASK, task(name, "done"))
                await stand(room, executive, 1.0)

    _, one, two_ = recorded(tmp_path, two)
    assert span_s(one, "lidar/scan")[:2] == pytest.approx((0.0, 5.0), abs=0.2)
    assert span_s(two_, "lidar/scan")[:2] == pytest.approx((4.0, 10.0), abs=0.2)
    with Capture.open(one) as capture:
        occasion = occasion_of(capture.metadata["occasion"])
    assert occasion is not None
    assert (occasion.task_id, occasion.outcome) == ("one", "done")


def test_everything_is_recorded_where_the_profile_wants_it(tmp_path: Path) -> None:
    whole = recorded(tmp_path / "whole", one_task, idle_period_s=0.0)
    assert len(all_of(whole[0], "lidar/scan")) == pytest.approx(400, abs=2)
    (single,) = recorded(tmp_path / "single", one_task, per_occasion=False)
    assert len(all_of(single, "lidar/scan")) == pytest.approx(540, abs=2)


def test_the_mesh_hears_what_is_recorded_whole_and_where(tmp_path: Path) -> None:
    told: list[Recording] = []

    async def scenario(room: Room) -> None:
        async with room.node("operator") as operator:
            operator.on(topics.RECORDING.of("capture"), told.append)
            await one_task(room, 5.0)

    recorded(tmp_path, scenario)
    tasks = [each for each in told if each.task_id == "one"]
    assert {(each.occasion, Path(each.file).name[-23:]) for each in tasks} == {
        ("fetch red_can", "-002-fetch-red_can.mcap")
    }
    assert told[-1].task_id == ""
    assert told[-1].left_out
    assert max(each.rate_bytes_per_s for each in told) > 100_000
    assert {each.free_bytes for each in told} == {0}  # the disk is none of virtual time's


# --- what makes room --------------------------------------------------------------------------------


def test_captures_in_which_nothing_happened_make_room_first_and_pinned_ones_never(tmp_path: Path) -> None:
    labels = ("-fetch", "-idle", "-idle", "-motion", "", "-fault", "-idle", "-idle")  # one of a former recorder
    for day, label in enumerate(labels, 1):
        path = tmp_path / f"calliope-2026010{day}T000000Z-001{label}.mcap"
        path.write_bytes(bytes(1000))
    pin_of(tmp_path / "calliope-20260102T000000Z-001-idle.mcap").touch()
    order = []
    for keep in range(7000, -1, -1000):
        kept = make_room(tmp_path, "calliope", keep)
        order += [f"{path.name[16]}{parsed_name(path).label}" for path in kept.gone]  # type: ignore[union-attr]
    assert order == ["3idle", "4motion", "1fetch", "5", "7idle"]
    assert pin_of(tmp_path / "calliope-20260102T000000Z-001-idle.mcap").exists()
    assert len(captures(tmp_path, "calliope")) == 3  # the pinned one, the newest fault, the newest of all


def test_yesterdays_task_is_still_there_after_a_day_of_nothing_under_the_simulators_budget(tmp_path: Path) -> None:
    """Each file is filled up to the 300 MB that an hour may take; the task's file has twice that."""
    started = datetime(2026, 1, 1, tzinfo=UTC)
    keep_bytes = round(5e9)
    assert profiles.read("sim").config("capture", CaptureConfig).keep_gb == 5.0
    folder = RecordingFolder(tmp_path, "calliope", started, keep_bytes, 0)
    limits = FileLimits(file_bytes=2e9, file_s=600.0)
    held = ThinningLimits(before_s=3.0, before_bytes=1 << 20, period_s=30.0, idle_file_s=3600.0)
    written = ThinningWriter(
        folder, "calliope", held, Packer("none"), limits, lambda key, data: info_of(key, "calliope", data),
        lambda: Missing({}, {}),
    )  # fmt: skip
    watch = Watch("calliope", lambda what, occasion: written.tell(what, structs.replace(occasion)))
    begun = written.file.path
    for minute in range(26 * 60):
        state = task("one") if 60 <= minute < 63 else task("one", "done") if minute >= 63 else task()
        payload, at_ns = msgspec.msgpack.encode(state), minute * 60 * NS
        written.put(QueuedMessage(topics.TASK.key("calliope"), minute, at_ns, at_ns, payload))
        watch.see(topics.TASK.key("calliope"), payload, at_ns)
        watch.look(at_ns + 30 * NS)
        if written.file.path != begun:
            os.truncate(begun, round(6e8 if "fetch" in begun.name else 3e8))
            begun = written.file.path
    written.close()
    left = captures(tmp_path, "calliope")
    assert left[0].name.endswith("-fetch-red_can.mcap")
    assert sum(path.stat().st_size for path in left) < keep_bytes + 4e8
    assert 8 < len(folder.deleted) < 14
    assert not any("fetch" in name for name in folder.deleted)
