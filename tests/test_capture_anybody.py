"""MCAP files of other tools, trimmed or composed: what the commands report and make of them."""

from __future__ import annotations

import csv
import json
import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from capture_rig import all_of, drive, entry, record, writer
from mcap.reader import make_reader
from mcap.records import Attachment
from mcap.writer import CompressionType, IndexType, Writer

from apps.captures.export.files import file_name
from apps.captures.info import report
from apps.captures.replay import played_keys
from apps.cli.main import main
from cocoro.capture.player import Player
from cocoro.capture.reader import Capture


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(tmp_path_factory.mktemp("anybody") / "whole.mcap", drive)


def trimmed(whole: Path, out: Path, keep: int, library: str = "") -> Path:
    """A copy of a capture with every `keep`th message, by the package's writer; header and metadata are copied."""
    with whole.open("rb") as source, out.open("wb") as target:
        reader, copy = make_reader(source), Writer(target)
        header = reader.get_header()
        copy.start(header.profile, library or header.library)
        ids: dict[int, int] = {}
        for number, (schema, channel, message) in enumerate(reader.iter_messages()):
            if channel.id not in ids:
                assert schema is not None
                schema_id = copy.register_schema(schema.name, schema.encoding, schema.data)
                ids[channel.id] = copy.register_channel(
                    channel.topic, channel.message_encoding, schema_id, channel.metadata
                )
            if number % keep == 0:
                copy.add_message(
                    ids[channel.id], message.log_time, message.data, message.publish_time, message.sequence
                )
        for found in reader.iter_metadata():
            copy.add_metadata(found.name, found.metadata)
        copy.finish()
    return out


def info_of(path: Path, capsys: pytest.CaptureFixture[str], code: int = 0, *options: str) -> dict[str, Any]:
    capsys.readouterr()
    assert main(["capture", "info", str(path), "--json", *options]) == code
    found: dict[str, Any] = json.loads(capsys.readouterr().out)
    return found


@pytest.mark.parametrize("library", ["", "mcap-python/1"], ids=["header copied", "header its own"])
def test_the_tally_of_another_file_is_not_believed(
    library: str, whole: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = trimmed(whole, tmp_path / "trimmed.mcap", 3, library)
    count = len(all_of(path))
    assert 0 < count < len(all_of(whole)) / 2
    for options in ((), ("--check",)):
        found = info_of(path, capsys, 0, *options)
        assert (found["messages"], found["checked"], found["problems"]) == (count, True, [])
        assert sum(key["messages"] for key in found["keys"]) == count
        assert found["notes"] == ["its metadata 'tally' belongs to another file, so the messages were counted"]
    assert main(["capture", "info", str(path)]) == 0
    assert "note: its metadata 'tally' belongs to another file" in capsys.readouterr().out
    assert main(["capture", "repair", str(path), "--out", str(path.with_suffix(".repaired.mcap"))]) == 0
    again = info_of(path.with_suffix(".repaired.mcap"), capsys)
    assert (again["messages"], again["checked"], again["notes"]) == (count, False, [])


def test_the_tally_of_the_file_itself_is_believed(whole: Path) -> None:
    with Capture.open(whole) as capture:
        quick, read = report(capture), report(capture, check=True)
    assert (quick.checked, read.checked, quick.notes, read.notes) == (False, True, (), ())
    assert (quick.keys, quick.messages, quick.raw_bytes) == (read.keys, read.messages, read.raw_bytes)


def test_as_many_messages_of_other_payloads_do_not_have_the_first_ones_sizes(tmp_path: Path) -> None:
    """The copied tally agrees with the statistics, but not with the chunks."""
    written = writer(tmp_path)
    for n in range(50):
        written.put(entry("base/state", n))
    written.close()
    with written.file.path.open("rb") as source, (tmp_path / "other.mcap").open("wb") as target:
        reader, copy = make_reader(source), Writer(target)
        copy.start("cocoro")
        channel = copy.register_channel("calliope/base/state", "msgpack", copy.register_schema("BaseState", "x", b""))
        for _, _, message in reader.iter_messages():
            copy.add_message(channel, message.log_time, message.data + b"more", message.publish_time, message.sequence)
        for found in reader.iter_metadata():
            copy.add_metadata(found.name, found.metadata)
        copy.finish()
    with Capture.open(tmp_path / "other.mcap") as capture:
        (key,) = report(capture).keys
        assert key.size_bytes == sum(len(each.payload) for each in capture.messages())


def test_statistics_that_are_not_so_are_told(tmp_path: Path) -> None:
    written = writer(tmp_path)
    for n in range(50):
        written.put(entry("base/state", n))
    written.file.tallies[1].messages += 7
    written.close()
    with Capture.open(written.file.path) as capture:
        found = report(capture, check=True)
        (filtered,) = (list(capture.messages("base/state")),)
    assert found.messages == len(filtered) == 50
    assert found.problems == ("its statistics have 57 messages, and 50 can be read",)


# --- messages outside of chunks -------------------------------------------------------------------


def loose(path: Path, count: int = 1000, **options: Any) -> Path:
    """Messages of two channels in turn, some of them late, with metadata and an attachment in between."""
    with path.open("wb") as target:
        made = Writer(target, use_chunking=False, **options)
        made.start("ros2", "somebody")
        channels = [made.register_channel(f"/{name}", "json", 0) for name in ("a", "b")]
        for n in range(count):
            log_ns = 1000 + n - 30 * (n % 7 == 6)
            made.add_message(channels[n % 2], log_ns, json.dumps({"n": n}).encode(), 5 * n, n)
            if n == count // 2:
                made.add_metadata("tally", {"crc32": "not a checksum", "mine": "yes"})
                made.add_attachment(3, 4, "../notes.txt", "text/plain", b"some notes")
        made.finish()
    return path


@pytest.mark.parametrize(
    "options", [{}, {"index_types": IndexType.NONE}, {"use_statistics": False}, {"enable_data_crcs": True}], ids=str
)
def test_messages_outside_of_chunks_are_told_kept_and_read_in_order(
    options: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = loose(tmp_path / "loose.mcap", **options)
    with path.open("rb") as stream:
        known = [(c.topic, m.log_time, m.sequence, m.data) for _, c, m in make_reader(stream).iter_messages()]
    for check in ((), ("--check",)):
        found = info_of(path, capsys, 0, *check)
        assert (found["messages"], found["problems"], found["notes"]) == (1000, [], [])
        assert [(key["key"], key["messages"], key["encoding"]) for key in found["keys"]] == [
            ("/a", 500, "json"), ("/b", 500, "json"),
        ]  # fmt: skip
    assert main(["capture", "repair", str(path)]) == 0
    assert "loose.repaired.mcap: 1000 messages, 1 attachments" in capsys.readouterr().out
    for each in (path, path.with_suffix(".repaired.mcap")):
        assert [(r.key, r.log_ns, r.sequence, bytes(r.payload)) for r in all_of(each)] == known
        with Capture.open(each) as capture:
            assert [record.sequence for record in capture.messages("/b", start_ns=1100, end_ns=1110)] == [
                sequence for topic, at, sequence, _ in known if topic == "/b" and 1100 <= at < 1110
            ]
            assert capture.profile == "ros2"
            assert capture.metadata_records == [("tally", {"crc32": "not a checksum", "mine": "yes"})]
            assert [capture.attachment(index).data for index in capture.attachments] == [b"some notes"]
    with path.with_suffix(".repaired.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        assert [(c.topic, m.log_time, m.sequence, m.data) for _, c, m in reader.iter_messages()] == known
        assert [found.metadata for found in reader.iter_metadata()] == [{"crc32": "not a checksum", "mine": "yes"}]


def test_an_unfinished_file_without_chunks_is_read_up_to_its_last_whole_record(tmp_path: Path) -> None:
    data = loose(tmp_path / "loose.mcap").read_bytes()
    path = tmp_path / "killed.mcap"
    path.write_bytes(data[: len(data) // 3])
    with Capture.open(path) as capture:
        sequences = sorted(record.sequence for record in capture.messages())
        assert sequences == list(range(len(sequences)))
        assert 300 < len(sequences) < 400
        assert (capture.problems, capture.closed) == ([], False)
        assert capture.cut_bytes > 0


# --- two channels of one topic --------------------------------------------------------------------


@pytest.fixture
def twofold(tmp_path: Path) -> Path:
    """One topic with two channels, MessagePack and JSON: as many messages of different sizes, and different schemas."""
    path = tmp_path / "twofold.mcap"
    with path.open("wb") as target:
        made = Writer(target, compression=CompressionType.LZ4)
        made.start("cocoro")
        packed = made.register_channel("calliope/arm2/x", "msgpack", made.register_schema("X", "jsonschema", b"{}"))
        plain = made.register_channel("calliope/arm2/x", "json", made.register_schema("X", "other", b"{}"), {"a": "b"})
        for n in range(20):
            if n % 4:
                made.add_message(plain, 10 * n, json.dumps({"n": n}).encode(), 10 * n, n)
            else:
                made.add_message(packed, 10 * n, b"\x81\xa1n" + bytes([n]), 10 * n, n)
        made.add_metadata("run", {"robot": "calliope"})
        made.finish()
    return path


def test_two_channels_of_one_topic_stay_two_when_told_and_repaired(
    twofold: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    repaired = twofold.with_suffix(".repaired.mcap")
    assert main(["capture", "repair", str(twofold), "--out", str(repaired)]) == 0
    capsys.readouterr()
    for path in (twofold, repaired):
        keys = info_of(path, capsys)["keys"]
        assert [(key["channel"], key["encoding"], key["messages"], key["size_bytes"]) for key in keys] == [
            (1, "msgpack", 5, 20), (2, "json", 15, sum(len(json.dumps({"n": n})) for n in range(20) if n % 4)),
        ]  # fmt: skip
        assert main(["capture", "info", str(path)]) == 0
        out = capsys.readouterr().out
        assert "arm2/x#1 " in out
        assert "arm2/x#2 " in out
        with Capture.open(path) as capture:
            assert [capture.decode(record) for record in capture.messages()] == [{"n": n} for n in range(20)]
            assert capture.channels[2].metadata == {"a": "b"}
            schemas = [capture.schema(channel) for channel in (1, 2)]
            assert [schema and schema.encoding for schema in schemas] == ["jsonschema", "other"]
    assert info_of(repaired, capsys)["checked"] is False  # by its tally, which has both channels
    assert all_of(repaired) == all_of(twofold)


def test_two_channels_of_one_topic_stay_two_when_a_part_is_repaired(
    twofold: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for number, options in enumerate((["--only", "arm2/**"], ["--to", "0.0000001"])):
        out = twofold.with_name(f"{number}.mcap")
        assert main(["capture", "repair", str(twofold), "--out", str(out), *options]) == 0
        assert [key["channel"] for key in info_of(out, capsys)["keys"]] == [1, 2]


def test_two_channels_of_one_topic_stay_two_in_tables_and_for_foxglove(
    twofold: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["export", str(twofold), "--csv", str(tmp_path / "csv")]) == 0
    assert sorted(path.name for path in (tmp_path / "csv").iterdir()) == ["arm2_x#1.csv", "arm2_x#2.csv"]
    with (tmp_path / "csv" / "arm2_x#1.csv").open(newline="") as file:
        assert [row["n"] for row in csv.DictReader(file)] == ["0", "4", "8", "12", "16"]
    pytest.importorskip("foxglove", reason="foxglove-sdk is an extra, and not installed here")
    from apps.captures.export import foxglove

    with Capture.open(twofold) as capture:
        foxglove.export(capture, tmp_path / "fox.mcap")
    with (tmp_path / "fox.mcap").open("rb") as stream:
        told = [(channel.id, schema and schema.encoding) for schema, channel, _ in make_reader(stream).iter_messages()]
    assert sorted(set(told), key=str) == [(1, "jsonschema"), (2, "other")]
    assert len(told) == 20


def test_both_channels_of_a_topic_are_played_and_what_a_recorder_noted_is_not(tmp_path: Path) -> None:
    path = tmp_path / "noted.mcap"
    with path.open("wb") as target:
        made = Writer(target)
        made.start("cocoro")
        told = [{}, {"publisher": "recorder"}, {"publisher": "arm2"}]
        ids = [made.register_channel("calliope/arm2/x", "msgpack", 0, metadata) for metadata in told]
        for n in range(9):
            made.add_message(ids[n % 3], n, b"\xc0", n, n)
        made.add_metadata("run", {"robot": "calliope"})
        made.finish()
    with Capture.open(path) as capture:
        keys = played_keys(capture, (), hardware=False)
        assert keys == {"calliope/arm2/x"}
        player = Player(capture, keys.__contains__)
        player.due(0.0)
        played: list[int] = [0, *(record.sequence for record in player.due(1.0))]
        assert played == [0, 2, 3, 5, 6, 8]


# --- attachments ----------------------------------------------------------------------------------


@pytest.fixture
def attached(tmp_path: Path) -> Path:
    path = tmp_path / "attached.mcap"
    with path.open("wb") as target:
        made = Writer(target)
        made.start("somebodys")
        names = ("notes.txt", "../../notes.txt", "/etc/passwd", "", "..", "a\0b", "x" * 300)
        for number, name in enumerate(names):
            made.add_attachment(number, 7, name, "text/plain", f"the {number}th".encode())
        made.finish()
    return path


def _attachments(path: Path) -> Iterator[Attachment]:
    with path.open("rb") as stream:
        yield from make_reader(stream).iter_attachments()


def test_attachments_are_told_and_kept(attached: Path, capsys: pytest.CaptureFixture[str]) -> None:
    found = info_of(attached, capsys)
    assert found["attachments"][0] == {
        "name": "notes.txt", "media_type": "text/plain", "size_bytes": 7, "log_ns": 7, "created_ns": 0,
    }  # fmt: skip
    assert len(found["attachments"]) == 7
    assert main(["capture", "info", str(attached)]) == 0
    assert "attachment: notes.txt, text/plain, 7 bytes" in capsys.readouterr().out
    assert main(["capture", "repair", str(attached)]) == 0
    assert list(_attachments(attached.with_suffix(".repaired.mcap"))) == list(_attachments(attached))


def test_attachments_become_files_in_their_folder_and_nowhere_else(
    attached: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "out" / "deep"
    assert main(["export", str(attached), "--attachments", str(folder)]) == 0
    assert f"{folder}: 7 attachments" in capsys.readouterr().out
    contents = {path.name: path.read_text() for path in folder.iterdir()}
    assert contents == {
        "notes.txt": "the 0th", "notes-2.txt": "the 1th", "passwd": "the 2th", "attachment": "the 3th",
        "attachment-2": "the 4th", "a_b": "the 5th", "x" * 200: "the 6th",
    }  # fmt: skip
    assert sorted(path.name for path in tmp_path.iterdir()) == ["attached.mcap", "out"]
    assert main(["export", str(attached), "--attachments", str(folder)]) == 1
    assert "exists; remove it" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "plain"),
    [("a/b/", "b"), ("a\\b.png", "b.png"), ("...", "attachment"), ("ä" * 150, "ä" * 100), ("\x1b[2J", "_[2J")],
)
def test_a_name_becomes_one_that_a_file_can_have(name: str, plain: str) -> None:
    assert file_name(name) == plain


# --- what is no file, and no time -----------------------------------------------------------------


def test_a_pipe_or_a_device_is_refused_without_being_opened(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    os.mkfifo(tmp_path / "pipe")
    for path, kind in ((tmp_path / "pipe", "a pipe"), (Path("/dev/zero"), "a device")):
        for command in (["capture", "info"], ["capture", "repair"], ["replay"], ["export", "--csv", str(tmp_path)]):
            assert main([*command, str(path)]) == 2
            err = capsys.readouterr().err
            assert f"{path} is {kind} and no file" in err
            assert len(err.splitlines()) == 1


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--from", "-3"], "--from -3: give seconds from the capture's start, 0 or more"),
        (["--to", "-1"], "--to -1: give seconds from the capture's start, 0 or more"),
        (["--from", "nan"], "--from nan: give seconds"),
        (["--to", "inf"], "--to inf: give seconds"),
        (["--from", "900"], "--from 900: "),
        (["--from", "1", "--to", "1"], "--to 1: it is exclusive and must be later than --from 1"),
        (["--to", "0"], "--to 0: it is exclusive and must be later than the capture's start"),
    ],
)
@pytest.mark.parametrize("command", [["replay"], ["capture", "repair"]], ids=["replay", "repair"])
def test_a_part_that_cannot_be_is_told_by_its_number(
    command: list[str], options: list[str], words: str, whole: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*command, str(whole), *options]) == 2
    err = capsys.readouterr().err
    assert words in err
    assert len(err.splitlines()) == 1
    assert not whole.with_suffix(".repaired.mcap").exists()
