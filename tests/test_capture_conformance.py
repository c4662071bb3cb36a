"""MCAP files of other programs: the reader here finds what the mcap package finds, before and after a repair."""

from __future__ import annotations

from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Attachment, Channel, Message, Metadata, Schema
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, IndexType, Writer
from mcap_conformance import CONTENTS, MAGIC, made, variants

from apps.captures.info import report
from apps.captures.rewrite import rewrite
from apps.cli.main import main
from cocoro.capture.conventions import checksum
from cocoro.capture.reader import Capture
from services.capture.packing import Packer

FILES = dict(variants())


class Known(NamedTuple):
    """The contents of a file."""

    messages: list[tuple[int, int, int, int, bytes]]
    """Channel, sequence, times and payload, in the order of log times, then of the file."""
    channels: dict[int, Channel]
    schemas: dict[int, Schema]
    metadata: list[Metadata]
    attachments: list[Attachment]


def by_package(data: bytes) -> Known:
    """Read front to back, as the package's readers without an index do."""
    known = Known([], {}, {}, [], [])
    for record in StreamReader(BytesIO(data), validate_crcs=True).records:
        if isinstance(record, Channel):
            known.channels[record.id] = record
        elif isinstance(record, Schema):
            known.schemas[record.id] = record
        elif isinstance(record, Metadata):
            known.metadata.append(record)
        elif isinstance(record, Attachment):
            known.attachments.append(record)
    told = NonSeekingReader(BytesIO(data)).iter_messages()
    return known._replace(messages=[_told(message) for _, _, message in told])


def _told(message: Message) -> tuple[int, int, int, int, bytes]:
    return message.channel_id, message.sequence, message.log_time, message.publish_time, message.data


def here(path: Path) -> Known:
    with Capture.open(path) as capture:
        messages = [(r.channel, r.sequence, r.log_ns, r.publish_ns, bytes(r.payload)) for r in capture.messages()]
        attachments = [capture.attachment(index) for index in capture.attachments]
        metadata = [Metadata(name, entries) for name, entries in capture.metadata_records]
        assert capture.problems == []
        assert capture.ending == ""
        return Known(messages, capture.channels, capture.schemas, metadata, attachments)


def test_the_set_has_all_its_files_and_each_is_another() -> None:
    assert len(FILES) == len(set(FILES.values())) == 416
    assert {name.partition("-")[0] for name in FILES} == set(CONTENTS)


@pytest.mark.parametrize("content", CONTENTS)
def test_every_file_of_the_conformance_set_is_read_as_the_package_reads_it_before_and_after_repair(
    content: str, tmp_path: Path
) -> None:
    names = [name for name in FILES if name.partition("-")[0] == content]
    assert names
    for name in names:
        path, repaired = tmp_path / f"{name}.mcap", tmp_path / f"{name}.repaired.mcap"
        path.write_bytes(FILES[name])
        known = by_package(FILES[name])
        assert here(path) == known, name
        with Capture.open(path) as capture:
            for check in (False, True):
                found = report(capture, check)
                assert (found.problems, found.ending, found.notes) == ((), "", ()), name
                assert found.messages == len(known.messages), name
                assert [key.messages for key in found.keys] == [len(known.messages)] * len(known.channels), name
                assert [one.name for one in found.attachments] == [one.name for one in known.attachments], name
            done = rewrite(capture, repaired, Packer("zstd"))
        assert done.problems == ()
        assert here(repaired) == known, name
        assert by_package(repaired.read_bytes()) == known, name
        _check_indexed(repaired.read_bytes(), known)


def _check_indexed(data: bytes, known: Known) -> None:
    """A repaired file has indices, so the package's indexed reader finds everything."""
    reader = make_reader(BytesIO(data), validate_crcs=True)
    summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(known.messages)
    assert [_told(message) for _, _, message in reader.iter_messages()] == known.messages
    assert list(reader.iter_metadata()) == known.metadata
    assert list(reader.iter_attachments()) == known.attachments


@pytest.mark.parametrize("name", sorted({name.partition("-")[0] for name in FILES}))
def test_the_commands_call_none_of_them_damaged(name: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    fullest = max((one for one in FILES if one.partition("-")[0] == name), key=len)
    for variant in (name, fullest):
        path = tmp_path / f"{variant}.mcap"
        path.write_bytes(FILES[variant])
        assert main(["capture", "info", "--check", str(path)]) == 0
        assert "whole, every byte read" in capsys.readouterr().out
        assert main(["capture", "repair", str(path)]) == 0
        assert "missing" not in capsys.readouterr().out


# --- what the set does not have -------------------------------------------------------------------


def _records(data: bytes) -> Iterator[bytes]:
    """Each record of a file, with its prefix."""
    at = len(MAGIC)
    while at < len(data) - len(MAGIC):
        end = at + 9 + int.from_bytes(data[at + 1 : at + 9], "little")
        yield data[at:end]
        at = end


@pytest.mark.parametrize("features", [(), ("ch",), ("ch", "pad")], ids=["loose", "chunk", "padded"])
def test_records_of_kinds_that_are_not_mcaps_own_are_passed_by_and_told(
    features: tuple[str, ...], tmp_path: Path
) -> None:
    plain = made(CONTENTS["TenMessages"], frozenset(features))
    private = b"\x80" + (5).to_bytes(8, "little") + b"mine!"
    parts = [part for part in _records(plain) if part[0] not in (0x02, 0x0F)]
    path = tmp_path / "private.mcap"
    path.write_bytes(MAGIC + private.join([*parts, b""]))
    ends = b"".join(part for part in _records(plain) if part[0] in (0x02, 0x0F))
    path.write_bytes(path.read_bytes() + bytes(ends[:9]) + bytes(4) + ends[13:] + MAGIC)
    known = by_package(path.read_bytes())
    assert len(known.messages) == 10
    assert here(path) == known
    with Capture.open(path) as capture:
        (note,) = report(capture, check=True).notes
        done = rewrite(capture, tmp_path / "out.mcap", Packer("zstd"))
    assert note.startswith(f"{len(parts)} records ")
    assert "0x80" in note
    assert done.notes == (note,)
    assert here(tmp_path / "out.mcap") == known


def test_a_chunk_whose_kind_was_changed_is_damage_and_no_private_record(tmp_path: Path) -> None:
    data = bytearray(made(CONTENTS["TenMessages"], frozenset(("ch",))))
    data[data.index(b"\x06\xcd")] = 0x86
    path = tmp_path / "changed.mcap"
    path.write_bytes(data)
    with Capture.open(path) as capture:
        assert list(capture.messages()) == []
        (problem,) = capture.problems
    assert "a record with the content of a chunk" in problem


def test_the_checksum_of_all_the_data_is_looked_at_by_check(tmp_path: Path) -> None:
    data = bytearray(made(CONTENTS["TenMessages"], frozenset()))
    data[data.rindex(b"\1\2\3")] ^= 1
    path = tmp_path / "flipped.mcap"
    path.write_bytes(data)
    with Capture.open(path) as capture:
        assert report(capture, check=True).problems == ("the checksum of all the data is wrong",)


def test_an_attachment_that_is_damaged_is_told_and_left_out(tmp_path: Path) -> None:
    for features in (("ax", "st"), ()):
        data = bytearray(made(CONTENTS["OneAttachment"], frozenset(features)))
        data[data.index(b"\1\2\3", 60)] ^= 1
        path, out = tmp_path / f"{len(features)}.mcap", tmp_path / f"{len(features)}.out.mcap"
        path.write_bytes(data)
        with Capture.open(path) as capture:
            assert any("checksum of the attachment 'myFile'" in each for each in report(capture, check=True).problems)
            done = rewrite(capture, out, Packer("zstd"))
        assert (done.attachments, len(done.problems)) == (0, len(report_of(path).problems))
        assert here_attachments(out) == []


def report_of(path: Path) -> Any:
    with Capture.open(path) as capture:
        return report(capture, check=True)


def here_attachments(path: Path) -> list[Attachment]:
    with Capture.open(path) as capture:
        return [capture.attachment(index) for index in capture.attachments]


# --- whatever a writer does -----------------------------------------------------------------------

OPTIONS = st.fixed_dictionaries(
    {
        "chunk_size": st.sampled_from([1, 100, 1 << 20]),
        "compression": st.sampled_from(list(CompressionType)),
        "index_types": st.sampled_from([IndexType.ALL, IndexType.NONE, *(IndexType.ALL & ~one for one in IndexType)]),
        **{
            name: st.booleans()
            for name in (
                "repeat_channels", "repeat_schemas", "use_chunking", "use_statistics", "use_summary_offsets",
                "enable_crcs", "enable_data_crcs",
            )
        },
    }
)  # fmt: skip
MESSAGE = st.tuples(st.just("message"), st.integers(0, 3), st.integers(0, 50), st.binary(max_size=40))
OTHERS = st.tuples(st.sampled_from(["metadata", "attachment"]), st.text(max_size=3), st.integers(0, 9), st.binary())


@settings(max_examples=150, deadline=None)
@given(options=OPTIONS, acts=st.lists(MESSAGE | OTHERS, max_size=25), profile=st.sampled_from(["", "ros2", "cocoro"]))
def test_whatever_the_package_writes_is_read_as_the_package_reads_it_before_and_after_repair(
    tmp_path_factory: pytest.TempPathFactory, options: dict[str, Any], acts: list[Any], profile: str
) -> None:
    if not options["use_chunking"]:  # the package's checksum over all data lacks channels that it has not flushed
        options["enable_data_crcs"] = False
    stream, folder = BytesIO(), tmp_path_factory.mktemp("any")
    written = Writer(stream, **options)
    written.start(profile)
    schemas = [0, written.register_schema("S", "jsonschema", b"{}"), written.register_schema("S", "other", b"")]
    for n, schema in enumerate((*schemas, 1)):  # two topics with two channels each
        written.register_channel(f"/topic{n % 2}", "json", schema, {"n": str(n)})
    written.add_message(1, 20, b"", 20)  # without a message the package loses the channels
    for n, (kind, which, number, data) in enumerate(acts):
        if kind == "message":
            written.add_message(which + 1, number, data, n, n)
        elif kind == "metadata":
            written.add_metadata(which, {"number": str(number), "crc32": data.hex()})
        else:
            written.add_attachment(number, n, which, "text/plain", data)
    written.finish()
    known = by_package(stream.getvalue())
    path, repaired = folder / "any.mcap", folder / "repaired.mcap"
    path.write_bytes(stream.getvalue())
    assert here(path) == known
    with Capture.open(path) as capture:
        for check in (False, True):
            found = report(capture, check)
            assert (found.problems, found.notes, found.messages) == ((), (), len(known.messages))
        rewrite(capture, repaired, Packer("lz4"))
    again = here(repaired)
    if profile == "cocoro":  # its conventions require a checksum in each metadata record
        known = known._replace(metadata=[_sealed(found) for found in known.metadata])
    assert again == known
    assert by_package(repaired.read_bytes())._replace(metadata=known.metadata) == known


def _sealed(found: Metadata) -> Metadata:
    return Metadata(found.name, {**found.metadata, "crc32": checksum(found.metadata)})
