"""Zeros in a file. In a recorder's own file they are damage, even where MCAP lets 0 mean "not checked" or "none"; in a
file of another program they are damage where the statistics contradict them. An intact file is never called
damaged."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from capture_rig import all_of, drive, entry, record, writer
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel
from mcap.writer import CompressionType, Writer

from apps.captures.info import report
from apps.captures.rewrite import rewrite
from cocoro.capture.mcap import MAGIC, PREFIX
from cocoro.capture.reader import Capture
from services.capture.file import CaptureFile
from services.capture.packing import Packer
from services.capture.writer import FileLimits, sync_and_close

pytestmark = pytest.mark.sweep

CHUNK_CRC = PREFIX.size + 24
"""Offset of the checksum, 4 bytes, in a chunk record."""
FOOTER = PREFIX.size + 20 + len(MAGIC)
"""Offset of the footer from the file's end."""


class Part(NamedTuple):
    """One record of a file, with its prefix."""

    op: int
    start: int
    end: int


def parts(data: bytes, *ops: Opcode) -> list[Part]:
    found, at = [], len(MAGIC)
    while at < len(data) - len(MAGIC):
        op, length = PREFIX.unpack_from(data, at)
        found.append(Part(op, at, at + PREFIX.size + length))
        at = found[-1].end
    return [part for part in found if not ops or part.op in ops]


def zeroed(data: bytes, start: int, length: int) -> bytes:
    end = min(start + length, len(data))
    return data[:start] + bytes(end - start) + data[end:]


def problems(path: Path, data: bytes, check: bool = False) -> list[str]:
    """The problems after every message was read; with `check`, after every byte was."""
    path.write_bytes(data)
    with Capture.open(path) as capture:
        list(capture.messages())
        if check:
            capture.check()
        return capture.problems


def resealed(data: bytes, summary: bytes) -> bytes:
    """The file with another summary and its right checksum."""
    start = parts(data, Opcode.DATA_END)[0].end
    footer = data[-FOOTER:][: PREFIX.size] + struct.pack("<QQ", start, 0)
    return data[:start] + summary + footer + struct.pack("<I", zlib.crc32(summary + footer)) + MAGIC


@pytest.fixture(scope="module", params=["zstd", "lz4", "none"])
def packed(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recorder's file of a quarter of a second."""

    async def short(room: Any) -> None:
        await drive(room, 0.25)

    return record(tmp_path_factory.mktemp("zeros") / "whole.mcap", short, compression=request.param).read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A recorder's file with two uncompressed chunks."""
    return made(tmp_path_factory.mktemp("zeros"))


def made(folder: Path) -> bytes:
    written = writer(folder, compression="none")
    written.remember("run", {"robot": "calliope"})
    written.remember("service/base", {"module": "services.base"})
    for n in range(20):
        written.put(entry("base/state", n))
        if n == 9:
            written.flush()
    written.close()
    return written.file.path.read_bytes()


# --- chunks ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [1, 4, 8, 16, 40, 512, 4096])
@pytest.mark.parametrize("state", ["whole", "killed"])
def test_zeros_anywhere_over_a_chunks_head_lose_nothing_unsaid(
    state: str, length: int, packed: bytes, tmp_path: Path
) -> None:
    """Zeros from the middle of the head on make a chunk without records and checksum."""
    path, (first, *_, last) = tmp_path / "zeros.mcap", parts(packed, Opcode.CHUNK)
    data = packed if state == "whole" else packed[: last.end]
    path.write_bytes(data)
    everything = set(all_of(path))
    for start in range(first.start, first.start + 60):
        path.write_bytes(zeroed(data, start, length))
        with Capture.open(path) as capture:
            found = {record._replace(payload=memoryview(bytes(record.payload))) for record in capture.messages()}
            assert found <= everything
            unfinished = state == "whole" and not capture.closed
            assert found == everything or capture.problems or unfinished, start - first.start


def test_a_chunk_that_says_it_has_no_checksum_is_damaged_in_a_recorders_file(whole: bytes, tmp_path: Path) -> None:
    path = tmp_path / "zeros.mcap"
    for chunk in parts(whole, Opcode.CHUNK):
        data = zeroed(whole, chunk.start + CHUNK_CRC, 4)
        for spoilt in (data, zeroed(data, chunk.end - 8, 4), data[: parts(whole, Opcode.DATA_END)[0].start]):
            (problem,) = {each.partition(": ")[2] for each in problems(path, spoilt) if "checksum" in each}
            assert problem == "its checksum is wrong"
            assert len(all_of(path)) < 20


def test_a_chunks_times_that_are_zeros_are_told_by_check(whole: bytes, tmp_path: Path) -> None:
    chunk = parts(whole, Opcode.CHUNK)[1]
    data = zeroed(whole, chunk.start + PREFIX.size, 16)
    (problem,) = problems(tmp_path / "zeros.mcap", data, check=True)
    assert "times" in problem
    assert f"byte {chunk.start} " in problem
    assert len(all_of(tmp_path / "zeros.mcap")) == 20


def test_an_index_of_messages_that_is_zeros_or_missing_is_told_by_check(whole: bytes, tmp_path: Path) -> None:
    path, chunk, index = tmp_path / "x.mcap", *parts(whole, Opcode.CHUNK, Opcode.MESSAGE_INDEX)[:2]
    words = f"an index of the chunk at byte {chunk.start} differs from its messages"
    for start, length in ((index.start + PREFIX.size, 2), (index.start + PREFIX.size + 6, 16), (index.end - 1, 1)):
        spoilt = zeroed(whole, start, length)
        if spoilt != whole:
            assert words in problems(path, spoilt, check=True)
            assert len(all_of(path)) == 20
    killed = whole[: parts(whole, Opcode.DATA_END)[0].start]
    (problem,) = problems(path, killed[: index.start] + killed[index.end :])
    assert "index" in problem
    assert f"byte {index.start} " in problem


# --- the end --------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("start", "length", "words"),
    [
        (PREFIX.size, 8, "the file's footer is damaged"),
        (PREFIX.size, 16, "the file's footer is damaged"),
        (PREFIX.size + 16, 4, "the file's summary is damaged"),
    ],
    ids=["summary's place", "both places", "checksum"],
)
def test_zeros_in_the_footer_are_told(start: int, length: int, words: str, packed: bytes, tmp_path: Path) -> None:
    path = tmp_path / "zeros.mcap"
    assert words in problems(path, zeroed(packed, len(packed) - FOOTER + start, length))


def test_zeros_in_the_statistics_and_in_the_checksum_over_them_are_told(whole: bytes, tmp_path: Path) -> None:
    statistics = parts(whole, Opcode.STATISTICS)[0]
    data = zeroed(zeroed(whole, statistics.start + PREFIX.size, 8), len(whole) - len(MAGIC) - 4, 4)
    assert "the file's summary is damaged" in problems(tmp_path / "zeros.mcap", data)
    assert len(all_of(tmp_path / "zeros.mcap")) == 20


def test_statistics_or_a_tally_that_are_missing_are_told_in_a_recorders_file(whole: bytes, tmp_path: Path) -> None:
    ends, path = parts(whole), tmp_path / "missing.mcap"
    summary = ends[[part.op for part in ends].index(Opcode.DATA_END) + 1 : -1]
    kept = b"".join(whole[part.start : part.end] for part in summary if part.op != Opcode.STATISTICS)
    assert problems(path, resealed(whole, kept)) == ["its statistics are missing, which every recorder writes"]
    assert len(all_of(path)) == 20
    file = CaptureFile(tmp_path / "tally.mcap", Packer("zstd"))
    file.channel(Channel(1, "a", "json", {}, 0))
    file.add(1, 0, 1, 1, b"{}")
    sync_and_close(file.finish())
    with Capture.open(file.path) as capture:
        assert capture.problems == ["its metadata 'tally' is missing, which every recorder writes"]


# --- metadata, header, attachments ----------------------------------------------------------------


def test_a_name_of_metadata_that_is_zeros_is_told_and_not_given(whole: bytes, tmp_path: Path) -> None:
    path, found = tmp_path / "zeros.mcap", parts(whole, Opcode.METADATA)
    for part in found:
        (length,) = struct.unpack_from("<I", whole, part.start + PREFIX.size)
        data = zeroed(whole, part.start + PREFIX.size + 4 + length - 1, 1)
        assert any(f"at byte {part.start} differs from what was written" in each for each in problems(path, data))
        with Capture.open(path) as capture:
            assert len(capture.metadata) == len(found) - 1


@pytest.mark.parametrize("kept", ["whole", "killed"])
def test_metadata_are_held_against_their_checksums_where_the_header_is_damaged(
    kept: str, whole: bytes, tmp_path: Path
) -> None:
    path, data = tmp_path / "flipped.mcap", bytearray(whole)
    if kept == "killed":
        del data[parts(whole, Opcode.DATA_END)[0].start :]
    data[data.index(b"cocoro")] ^= 1
    assert problems(path, bytes(data)) == []
    for at in (data.index(b"services.base"), data.index(b"crc32", data.index(b"service/base"))):
        spoilt = bytearray(data)
        spoilt[at] ^= 1
        assert any("'service/base'" in each for each in problems(path, bytes(spoilt)))
        with Capture.open(path) as capture:
            assert "service/base" not in capture.metadata
            assert "run" in capture.metadata


def test_zeros_in_a_recorders_header_are_told(whole: bytes, tmp_path: Path) -> None:
    header = parts(whole, Opcode.HEADER)[0]
    for start in range(header.start, header.end):
        for length in (1, 4, 16):
            data = zeroed(whole, start, length)
            if data != whole:
                assert problems(tmp_path / "zeros.mcap", data), (start, length)


def test_an_attachment_without_its_checksum_is_damaged_in_a_repaired_file_of_a_recorders(
    whole: bytes, tmp_path: Path
) -> None:
    path = tmp_path / "attached.mcap"
    file = CaptureFile(path, Packer("zstd"))
    file.attachment(Attachment(1, 2, "notes.txt", "text/plain", b"some notes"))
    file.tally({}, {})
    sync_and_close(file.finish())
    data = path.read_bytes()
    assert problems(path, data, check=True) == []
    end = parts(data, Opcode.ATTACHMENT)[0].end
    for start in (end - 4, end - 8):
        assert any("attachment 'notes.txt'" in each for each in problems(path, zeroed(data, start, end - start), True))


# --- of other recorders ------------------------------------------------------------------------------------


def others(path: Path, **options: Any) -> bytes:
    """A file of two channels in two chunks, without checksums."""
    with path.open("wb") as target:
        written = Writer(target, enable_crcs=False, chunk_size=200, compression=CompressionType.NONE, **options)
        written.start("theirs", "somebody")
        channels = [written.register_channel(f"/{name}", "json", 0) for name in "ab"]
        for n in range(20):
            written.add_message(channels[n % 2], n + 1, json.dumps({"n": n}).encode(), n + 1, n)
        written.finish()
    return path.read_bytes()


def emptied(data: bytes) -> bytes:
    """The first chunk zeroed from its head on, which makes it a chunk without records."""
    chunk = parts(data, Opcode.CHUNK)[0]
    return zeroed(data, chunk.start + PREFIX.size, chunk.end - chunk.start - PREFIX.size)


def test_statistics_that_contradict_what_was_read_are_told_of_anybodys_file(tmp_path: Path) -> None:
    path = tmp_path / "others.mcap"
    data = others(path)
    assert problems(path, data, check=True) == []
    path.write_bytes(emptied(data))
    for read in (Capture.messages, lambda capture: capture.messages("/a")):
        reading: Callable[[Capture], Any] = read
        with Capture.open(path) as capture:
            assert capture.summarised
            count = len(list(reading(capture)))
            (problem,) = capture.problems
        which = "of channel 1, " if read is not Capture.messages else ""
        assert problem.startswith("its statistics have ")
        assert problem.endswith(f"{which or 'messages, '}and {count} can be read")
    with Capture.open(path) as capture:
        found = report(capture)
        assert found.problems
        assert rewrite(capture, tmp_path / "out.mcap", Packer("zstd")).problems == found.problems


def test_a_file_of_others_without_statistics_has_none_to_contradict(tmp_path: Path) -> None:
    path = tmp_path / "others.mcap"
    data = others(path, use_statistics=False)
    assert problems(path, data, check=True) == []
    assert problems(path, emptied(data), check=True) == []
    assert 0 < len(all_of(path)) < 20


# --- what is whole --------------------------------------------------------------------------------


def test_no_file_of_a_recorder_is_called_damaged(packed: bytes, tmp_path: Path) -> None:
    path, again = tmp_path / "whole.mcap", tmp_path / "again.mcap"
    assert problems(path, packed, check=True) == []
    with Capture.open(path) as capture:
        assert rewrite(capture, again, Packer("lz4")).problems == ()
    assert problems(again, again.read_bytes(), check=True) == []
    limits = FileLimits(file_s=0.05)
    written = writer(tmp_path, limits)
    for n in range(40):
        written.put(entry("base/state", n))
    written.close()
    rotated = sorted(tmp_path.glob("one-*.mcap"))
    assert len(rotated) == 8
    for one in rotated:
        assert problems(one, one.read_bytes(), check=True) == []


def test_a_killed_recorders_file_is_unfinished_and_nothing_else_wherever_it_ends(packed: bytes, tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    ends = [part.end for part in parts(packed) if part.end < len(packed) - len(MAGIC)]
    for end in sorted({at + more for at in ends for more in (0, 1, 9, 30) if at + more < len(packed) - 1}):
        assert problems(path, packed[:end], check=True) == []
        with Capture.open(path) as capture:
            assert not capture.closed
            assert report(capture, check=True).problems == ()
