"""The files that a recorder writes: their contents, when a new one begins, and what remains when the disk refuses."""

from __future__ import annotations

import errno
import json
import os
import shutil
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import pytest
from capture_rig import all_of, entry, frame, state, writer
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from message_samples import data_of

from apps.captures.compare import changes, known_to
from apps.captures.info import report
from apps.captures.rewrite import rewrite
from cocoro.capture.conventions import CaptureError
from cocoro.capture.folder import captures, make_room
from cocoro.capture.mcap import MESSAGE_HEAD
from cocoro.capture.mcap_reading import unpack
from cocoro.capture.reader import Capture
from cocoro.capture.types import Alive, LossyFrame, NotReadableError, schema_of
from cocoro.errors import ConfigError
from cocoro.messages import BaseState, Detections, Frame, Message, PlannerStatus
from cocoro.topics import TOPICS
from services.capture.file import LARGE_BYTES
from services.capture.keys import KeyFilter, lossy
from services.capture.packing import COMPRESSIONS, Compression, Packer, message_head
from services.capture.writer import FileLimits, Missing

BIG = msgspec.msgpack.encode(frame(7, 320, 240))


def test_what_goes_in_comes_out_to_the_byte_and_in_order(tmp_path: Path) -> None:
    written = writer(tmp_path)
    entries = [
        entry("kinect/frame" if n % 10 == 0 else "base/state", n, BIG if n % 10 == 0 else b"") for n in range(200)
    ]
    for each in entries:
        written.put(each)
        if each.sequence % 7 == 0:
            written.flush()
    written.close()
    found = all_of(written.file.path)
    assert [(r.key, r.sequence, r.log_ns, r.publish_ns, bytes(r.payload)) for r in found] == [e[:5] for e in entries]
    assert {r.key for r in all_of(written.file.path, "kinect/**")} == {"calliope/kinect/frame"}
    with Capture.open(written.file.path) as capture:
        span = list(capture.messages(start_ns=entries[50].log_ns, end_ns=entries[60].log_ns))
        assert [record.sequence for record in span] == list(range(50, 60))
        assert capture.whole


@pytest.mark.parametrize("compression", COMPRESSIONS)
def test_every_compression_gives_back_what_it_was_given(compression: Compression) -> None:
    for raw in (b"", b"a", bytes(100_000), os.urandom(100_000)):
        name, packed = Packer(compression).pack(raw)
        assert unpack(name, packed, len(raw)) == raw
        assert len(packed) <= len(raw)


@pytest.mark.parametrize("level", [0, 1, 3, 19])
@pytest.mark.parametrize("size", [LARGE_BYTES, 2 * LARGE_BYTES, 2 * LARGE_BYTES + 1, 20 * LARGE_BYTES])
@pytest.mark.parametrize("before", [(), (b"records" * 1000,), (bytes(LARGE_BYTES),)])
def test_a_large_message_is_packed_with_what_stands_before_it(level: int, size: int, before: tuple[bytes, ...]) -> None:
    packer = Packer("zstd", level)
    for payload in (bytes(range(256)) * (size // 256) + bytes(size % 256), os.urandom(size // 2) * 2):
        packed = packer.message(3, 7, 11, 13, payload, before)
        raw = unpack(packed.compression, packed.data, packed.raw_bytes)
        assert raw == b"".join((*before, message_head(3, 7, 11, 13, len(payload)), payload))
        assert packed.raw_bytes == len(raw)
        assert packed.crc == zlib.crc32(raw)
        assert raw[packed.message_at + MESSAGE_HEAD.size :] == payload


def test_the_mcap_library_reads_it_as_a_whole_indexed_file(tmp_path: Path) -> None:
    written = writer(tmp_path, missing=lambda: Missing({"calliope/kinect/frame": 3}, {}))
    written.remember("run", {"robot": "calliope"})
    for n in range(100):
        written.put(entry("base/state", n))
    written.put(entry("kinect/frame", 100, BIG))
    written.close()
    with written.file.path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == 101
        assert {channel.topic: channel.message_encoding for channel in summary.channels.values()} == {
            "calliope/base/state": "msgpack", "calliope/kinect/frame": "msgpack",
        }  # fmt: skip
        records = list(reader.iter_messages())
        schema, channel, _ = records[0]
        assert schema is not None
        assert (schema.name, channel.topic) == ("BaseState", "calliope/base/state")
        times = [message.log_time for _, _, message in records]
        assert times == sorted(times)
        assert {record.name for record in reader.iter_metadata()} == {"run", "tally"}
        tally = next(record.metadata for record in reader.iter_metadata() if record.name == "tally")
        assert json.loads(tally["dropped"]) == {"calliope/kinect/frame": 3}


def test_each_type_of_the_mesh_has_a_schema_that_is_an_object_with_binary_pixels() -> None:
    for topic in TOPICS:
        kind: type[Message] = topic.type
        schema = json.loads(schema_of(kind).data)
        assert schema["type"] == "object"
        assert "stamp_ns" in schema["properties"]
    pixels = json.loads(schema_of(Frame).data)["properties"]["colour"]
    assert pixels == {"type": "string", "contentEncoding": "binary"}


@settings(max_examples=20)
@given(st.sampled_from(TOPICS).flatmap(lambda topic: st.tuples(st.just(topic.type), data_of(topic.type))))
def test_a_types_schema_knows_all_that_its_messages_have(made: tuple[type[Message], Any]) -> None:
    kind, data = made
    plain = json.loads(msgspec.json.encode(msgspec.convert(data, kind, builtin_types=(bytes, memoryview))))
    assert known_to(schema_of(kind).data, plain) == plain


def test_fields_that_a_schema_does_not_have_are_left_out_wherever_they_are() -> None:
    schema = json.loads(schema_of(PlannerStatus).data)
    del schema["properties"]["model"]
    del schema["$defs"]["TargetEstimate"]["properties"]["age_s"]
    target = {"label": "red_can", "age_s": 1.0, "position_m": [1.0, 2.0, 3.0]}
    status = {"model": "learned", "target": target, "known": [target, target], "why": "so"}
    less = {"label": "red_can", "position_m": [1.0, 2.0, 3.0]}
    expected = {"target": less, "known": [less, less], "why": "so"}
    assert known_to(json.dumps(schema).encode(), status) == expected
    assert known_to(b"no schema", status) == status


def test_keys_never_heard_of_are_kept_as_what_they_seem_to_be(tmp_path: Path) -> None:
    written = writer(tmp_path)
    payloads = {"arm2/x": b"\x81\xa1a\x01", "web/y": b'{"a": 1}', "raw/z": b"\xc1\xc1\xff"}
    for number, (key, payload) in enumerate(payloads.items()):
        written.put(entry(key, number, payload))
    written.close()
    with Capture.open(written.file.path) as capture:
        assert {channel.topic: channel.message_encoding for channel in capture.channels.values()} == {
            "calliope/arm2/x": "msgpack", "calliope/web/y": "json", "calliope/raw/z": "application/octet-stream",
        }  # fmt: skip
        assert [capture.decode(record) for record in capture.messages()] == [{"a": 1}, {"a": 1}, b"\xc1\xc1\xff"]


# --- one file after another -----------------------------------------------------------------------


@pytest.mark.parametrize("limits", [FileLimits(file_bytes=4000), FileLimits(file_s=0.5)], ids=["by size", "by time"])
def test_rotation_loses_nothing_and_every_file_is_whole_in_itself(tmp_path: Path, limits: FileLimits) -> None:
    written = writer(tmp_path, limits)
    written.remember("run", {"robot": "calliope"})
    for n in range(500):
        written.put(entry("base/state", n, os.urandom(50)))
        if n % 10 == 9:
            written.flush()
    written.close()
    files = sorted(tmp_path.glob("*.mcap"), key=lambda path: int(path.stem.split("-")[1]))
    assert len(files) > 3
    sequences = []
    for path in files:
        with Capture.open(path) as capture:
            assert capture.whole
            assert capture.robot == "calliope"
            sequences += [record.sequence for record in capture.messages()]
    assert sequences == list(range(500))
    assert written.messages == 500
    assert written.size_bytes == sum(path.stat().st_size for path in files)


def test_two_recorders_that_begin_in_the_same_moment_write_beside_each_other(tmp_path: Path) -> None:
    both = [writer(tmp_path), writer(tmp_path)]
    for n, written in enumerate(both):
        written.put(entry("base/state", n, b"state"))
        written.close()
    files = list(tmp_path.glob("*.mcap"))
    assert len(files) == 2
    assert sorted(sequence for path in files for sequence in [record.sequence for record in all_of(path)]) == [0, 1]


def test_the_oldest_captures_make_room_and_nothing_else_does(tmp_path: Path) -> None:
    names = [f"calliope-2026010{day}T000000Z-001.mcap" for day in range(1, 5)]
    for name in (*names, "calliope-notes.mcap", "other-20260101T000000Z-001.mcap"):
        (tmp_path / name).write_bytes(bytes(1000))
    assert [path.name for path in make_room(tmp_path, "calliope", 2500).gone] == names[:2]
    assert [path.name for path in captures(tmp_path, "calliope")] == names[2:]
    make_room(tmp_path, "calliope", 0)
    assert {path.name for path in tmp_path.iterdir()} == {
        names[3], "calliope-notes.mcap", "other-20260101T000000Z-001.mcap",
    }  # fmt: skip


# --- when the disk refuses ------------------------------------------------------------------------


class Disk:
    """A disk with room for so many bytes. A write that does not fit is done in part, as on a real disk."""

    def __init__(self, room: int) -> None:
        self.room = room
        self._writev = os.writev

    def writev(self, fd: int, parts: Sequence[bytes | memoryview]) -> int:
        data = b"".join(bytes(part) for part in parts)[: self.room]
        if not data:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.room -= len(data)
        return self._writev(fd, [data])


def test_a_full_disk_ends_the_recording_with_a_readable_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    disk = Disk(40_000)
    monkeypatch.setattr("services.capture.file.os.writev", disk.writev)
    written = writer(tmp_path)
    flushed = -1

    def fill() -> None:
        nonlocal flushed
        for n in range(100_000):
            written.put(entry("base/state", n, os.urandom(100)))
            if n % 10 == 9:
                written.flush()
                flushed = n

    with pytest.raises(CaptureError, match=r"one-1\.mcap: No space left on device$"):
        fill()
    found = all_of(written.file.path)
    assert [record.sequence for record in found] == list(range(flushed + 1))
    with Capture.open(written.file.path) as capture:
        assert capture.problems == []


def test_recording_stops_before_the_disk_is_full(tmp_path: Path) -> None:
    total = shutil.disk_usage(tmp_path).total
    written = writer(tmp_path, FileLimits(min_free_bytes=2 * total))
    written.put(entry("base/state", 0))
    with pytest.raises(CaptureError, match="MB are free; make room"):
        written.flush()
    with Capture.open(written.file.path) as capture:
        assert capture.whole
        assert len(list(capture.messages())) == 1


def test_a_folder_that_cannot_be_written_to_is_told_of(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(CaptureError, match=r"one-1\.mcap: Not a directory"):
        writer(tmp_path / "file" / "folder")


# --- what a reader makes of it --------------------------------------------------------------------


def test_a_file_that_was_never_closed_is_read_up_to_its_last_flush_and_mended(tmp_path: Path) -> None:
    written = writer(tmp_path)
    written.remember("run", {"robot": "calliope"})
    for n in range(100):
        written.put(entry("base/state", n))
        if n == 79:
            written.flush()
    killed = tmp_path / "killed.mcap"
    shutil.copy(written.file.path, killed)
    with Capture.open(killed) as capture:
        assert not capture.closed
        assert capture.problems == []
        assert capture.robot == "calliope"
        assert [record.sequence for record in capture.messages()] == list(range(80))
        done = rewrite(capture, tmp_path / "whole.mcap", Packer("lz4"))
    assert done.messages == 80
    assert done.problems == ()
    with Capture.open(done.path) as capture:
        assert capture.whole
        assert capture.metadata["run"] == {"robot": "calliope"}
        assert [bytes(record.payload) for record in capture.messages()] == [state(n) for n in range(80)]


def test_info_counts_rates_gaps_and_losses(tmp_path: Path) -> None:
    missing = Missing({"calliope/base/state": 2}, {"calliope/base/state": 5})
    written = writer(tmp_path, missing=lambda: missing)
    for n in (*range(50), *range(80, 100)):
        written.put(entry("base/state", n))
    written.close()
    with Capture.open(written.file.path) as capture:
        for check in (False, True):
            found = report(capture, check)
            (key,) = found.keys
            assert found.checked is check
            assert (found.messages, key.messages) == (70, 70)
            assert key.type == "BaseState"
            assert key.rate_hz == pytest.approx(69 / 0.99)
            assert (key.longest_gap_s, key.longest_gap_from_s) == pytest.approx((0.31, 0.49))
            assert (key.dropped, key.lost, key.changed) == (2, 5, ())


class Older(msgspec.Struct, kw_only=True):
    """A BaseState of an earlier version: it lacks some of today's fields and has one that is gone."""

    stamp_ns: int = 0
    seq: int = 0
    incarnation: int = 0
    odometry_m: tuple[float, float] = (0.0, 0.0)
    odometry_yaw_rad: float = 0.0
    speed_mps: float = 0.0
    turn_rate_radps: float | str = 0.0
    horn: bool = True


def test_an_old_capture_is_read_by_the_stated_rules(tmp_path: Path) -> None:
    written = writer(tmp_path)
    old = schema_of(Older)._replace(name="BaseState")
    for number, older in enumerate((Older(odometry_m=(1.0, 2.0)), Older(turn_rate_radps="fast"))):
        each = entry("base/state", number, msgspec.msgpack.encode(older))
        info = written._info(each.key, each.payload)._replace(schema=old)
        written.put(each._replace(info=info))
    written.close()
    with Capture.open(written.file.path) as capture:
        good, bad = capture.messages()
        assert capture.read(good) == BaseState(
            odometry_m=(1.0, 2.0), odometry_yaw_rad=0, speed_mps=0, turn_rate_radps=0
        )
        with pytest.raises(NotReadableError, match="turn_rate_radps"):
            capture.read(bad)
        assert capture.decode(bad)["turn_rate_radps"] == "fast"
        (key,) = report(capture).keys
    assert "horn is gone: ignored" in key.changed
    assert "battery_v is new: gets its default" in key.changed
    assert "turn_rate_radps has changed" in key.changed


def test_a_new_field_without_a_default_makes_old_messages_unreadable_as_that_type() -> None:
    (change,) = (c for c in changes(schema_of(Alive).data, schema_of(Detections).data) if c.text.startswith("width"))
    assert not change.readable
    assert "no default" in change.text
    assert changes(schema_of(Alive).data, schema_of(Alive).data) == []


def test_lossy_frames_look_like_the_frames_and_keep_their_depth(tmp_path: Path) -> None:
    written = writer(tmp_path, prepare=lossy(90))
    smooth = bytes((row + column) // 2 for row in range(120) for column in range(160) for _ in range(3))
    depth = bytes(2 * 160 * 120)
    sent = Frame(width=160, height=120, colour=memoryview(smooth), depth=memoryview(depth), seq=4, stamp_ns=99)
    written.put(entry("kinect/frame", 4, msgspec.msgpack.encode(sent)))
    written.put(entry("base/state", 5))
    written.close()
    with Capture.open(written.file.path) as capture:
        kept, _ = capture.messages()
        schema = capture.schema(kept.channel)
        assert schema is not None
        assert schema.name == LossyFrame.__name__
        assert len(kept.payload) < len(smooth) + len(depth)
        looks = capture.read(kept)
    assert isinstance(looks, Frame)
    assert (looks.seq, looks.stamp_ns, bytes(looks.depth)) == (4, 99, depth)
    assert max(abs(a - b) for a, b in zip(bytes(looks.colour), smooth, strict=True)) < 16


@pytest.mark.parametrize(
    ("only", "without", "chosen"),
    [
        ([], [], {"base/state", "kinect/frame", "base/health"}),
        ([], ["frames"], {"base/state", "base/health"}),
        (["base/**"], ["*/health"], {"base/state"}),
        (["calliope/*/health"], [], {"base/health"}),
    ],
)
def test_an_operator_chooses_keys_by_expressions(only: list[str], without: list[str], chosen: set[str]) -> None:
    choice = KeyFilter("calliope", only, without)
    assert {key for key in ("base/state", "kinect/frame", "base/health") if f"calliope/{key}" in choice} == chosen


@pytest.mark.parametrize("text", ["", "a//b", "base/st*"])
def test_what_is_no_key_expression_is_told_of(text: str) -> None:
    with pytest.raises(ConfigError, match="no key expression"):
        KeyFilter("calliope", [text])
