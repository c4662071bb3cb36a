"""Finding what is whole in a file of records: by its summary where there is one, else from front to back.

Nothing is believed that no checksum vouches for, but for the framing of records; where that breaks, the next chunk
is searched for whose checksum is right.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from cocoro.capture import mcap
from cocoro.capture.compression import LARGEST_CHUNK, unpack
from cocoro.capture.errors import CutOffError, DamageError
from cocoro.capture.file import CHECKSUM, PROFILE, checksum
from cocoro.capture.mcap import MAGIC, PREFIX, Op

LARGEST_SUMMARY = 1 << 30
LARGEST_RECORD = 1 << 26
"""Of records other than chunks."""
_SEARCHED = 1 << 20
_MARKS = (struct.pack("<I", 4) + b"zstd", struct.pack("<I", 3) + b"lz4", struct.pack("<I", 0))
"""A chunk's compression, as it stands in its head."""
_MARK_AT = PREFIX.size + 28


class ChunkPlace(NamedTuple):
    """Where a chunk is, and what is in it."""

    offset: int
    length: int
    """Of the record, its prefix included."""
    start_ns: int
    end_ns: int
    channels: frozenset[int] | None
    """None: not known without looking."""


@dataclass
class Contents:
    """What a file has."""

    schemas: dict[int, mcap.Schema] = field(default_factory=dict)
    channels: dict[int, mcap.Channel] = field(default_factory=dict)
    chunks: list[ChunkPlace] = field(default_factory=list)
    metadata: list[mcap.Metadata] = field(default_factory=list)
    statistics: mcap.Statistics | None = None
    whole: bool = False
    """The file was closed, and its summary is as it was written."""
    cut_bytes: int = 0
    """At the end, of a record that was never finished: what the death of a recorder leaves, so no damage."""
    problems: list[str] = field(default_factory=list)
    foreign: bool = False
    """It has messages outside of chunks, which captures never do."""
    ours: bool = False
    """It was written by a recorder, so each metadata record has its checksum."""


class Disk:
    """A file to read from at any place. Shorter than wanted is damage, not an error of the disk's."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self.size = os.fstat(fd).st_size

    def read(self, offset: int, length: int) -> bytes:
        if offset < 0 or offset + length > self.size:
            raise CutOffError(f"{length} bytes at byte {offset} are beyond the file's end")
        data = os.pread(self._fd, length, offset)
        while len(data) < length:
            more = os.pread(self._fd, length - len(data), offset + len(data))
            if not more:
                raise CutOffError(f"the file has become shorter than {offset + length} bytes")
            data += more
        return data


def contents(disk: Disk) -> Contents:
    """Raises DamageError when it is no MCAP file at all."""
    if disk.size == 0:
        raise DamageError("the file is empty")
    if disk.size < len(MAGIC) or disk.read(0, len(MAGIC)) != MAGIC:
        raise DamageError("this is no MCAP file")
    try:
        return _by_summary(disk)
    except DamageError as damage:
        found = scan(disk)
        if str(damage):
            found.problems.insert(0, str(damage))
        return found


# --- by the summary -------------------------------------------------------------------------------


def _by_summary(disk: Disk) -> Contents:
    tail = mcap.FOOTER_LENGTH + len(MAGIC)
    if disk.size < len(MAGIC) + tail or disk.read(disk.size - len(MAGIC), len(MAGIC)) != MAGIC:
        raise DamageError("")  # it was never closed, which is no damage: what there is is as good as ever
    footer_at = disk.size - tail
    head = disk.read(footer_at, mcap.FOOTER_LENGTH)
    if PREFIX.unpack_from(head) != (Op.FOOTER, mcap.FOOTER_LENGTH - PREFIX.size):
        raise DamageError("the file's footer is damaged")
    footer = mcap.Footer.unpack(head[PREFIX.size :])
    if footer.summary_start == 0 or footer.crc == 0:
        raise DamageError("the file has no summary, or one without a checksum")
    if not len(MAGIC) <= footer.summary_start <= footer_at or footer_at - footer.summary_start > LARGEST_SUMMARY:
        raise DamageError("the file's footer is damaged")
    summary = disk.read(footer.summary_start, footer_at - footer.summary_start)
    if not footer.vouches_for(summary):
        raise DamageError("the file's summary is damaged")
    found = Contents(whole=True, ours=_profile(disk) == PROFILE)
    indices = []
    for op, content, _ in mcap.records(summary):
        if op == Op.SCHEMA:
            _add_schema(found, content)
        elif op == Op.CHANNEL:
            _add_channel(found, content)
        elif op == Op.STATISTICS:
            found.statistics = mcap.Statistics.unpack(content)
        elif op == Op.CHUNK_INDEX:
            chunk = mcap.ChunkIndex.unpack(content)
            channels = frozenset(chunk.index_offsets) or None
            found.chunks.append(ChunkPlace(chunk.offset, chunk.length, chunk.start_ns, chunk.end_ns, channels))
        elif op == Op.METADATA_INDEX:
            indices.append(mcap.MetadataIndex.unpack(content))
    if found.statistics is None or found.statistics.chunks != len(found.chunks):
        raise DamageError("the file's summary does not list its chunks")
    for index in indices:
        try:
            _read_metadata(disk, index, found)
        except DamageError as damage:
            found.problems.append(f"metadata {index.name!r} at byte {index.offset}: {damage}")
    return found


def _read_metadata(disk: Disk, index: mcap.MetadataIndex, found: Contents) -> None:
    if index.length > LARGEST_RECORD:
        raise DamageError("no record is so large")
    there = list(mcap.records(disk.read(index.offset, index.length)))
    if [op for op, _, _ in there] != [Op.METADATA]:
        raise DamageError("it is not there")
    _add_metadata(found, there[0][1])
    if found.metadata[-1].name != index.name:
        del found.metadata[-1]
        raise DamageError("it is not there")


def _profile(disk: Disk) -> str:
    """Whose conventions hold, by the file's header."""
    try:
        op, length = PREFIX.unpack(disk.read(len(MAGIC), PREFIX.size))
        return mcap.Take(disk.read(len(MAGIC) + PREFIX.size, length)).string() if op == Op.HEADER else ""
    except DamageError:
        return ""


# --- from front to back ---------------------------------------------------------------------------


def scan(disk: Disk) -> Contents:
    """Read everything, and keep what is whole."""
    found = Contents(ours=_profile(disk) == PROFILE)
    at = len(MAGIC)
    while at < disk.size:
        try:
            at = _step(disk, at, found)
        except DamageError as damage:
            after = _search(disk, at + 1)
            if after == disk.size and isinstance(damage, CutOffError):
                found.cut_bytes = disk.size - at
                break
            found.problems.append(f"bytes {at} to {after} are not readable: {damage}")
            at = after
    return found


def _step(disk: Disk, at: int, found: Contents) -> int:
    """Take in one record. Where the next one is; the file's size at the end of the data. Raises DamageError."""
    op, length = PREFIX.unpack(disk.read(at, PREFIX.size))
    end: int = at + PREFIX.size + length
    if end > disk.size:
        raise CutOffError("a record is cut off")
    if op == Op.CHUNK:
        _add_chunk(disk, at, found)
        return end
    if length > LARGEST_RECORD:
        raise DamageError("no record is so large")
    content = disk.read(at + PREFIX.size, length)
    if op == Op.DATA_END and length == 4:
        return disk.size
    if op == Op.SCHEMA:
        _add_schema(found, content)
    elif op == Op.CHANNEL:
        _add_channel(found, content)
    elif op == Op.METADATA:
        _add_metadata(found, content)
    elif op == Op.MESSAGE:
        mcap.message(memoryview(content))
        found.foreign = True
    elif op == Op.MESSAGE_INDEX:
        mcap.check_message_index(content)
    elif op == Op.ATTACHMENT:
        if struct.unpack("<I", content[-4:])[0] not in (0, zlib.crc32(content[:-4])):
            raise DamageError("an attachment's checksum is wrong")
    elif op != Op.HEADER or at != len(MAGIC):
        raise DamageError(f"a record of kind {op} has no place there")
    return end


def _add_chunk(disk: Disk, at: int, found: Contents) -> None:
    length, raw = read_chunk(disk, at)
    channels, times = set(), []
    for op, content, _ in mcap.records(raw):
        if op == Op.SCHEMA:
            _add_schema(found, content)
        elif op == Op.CHANNEL:
            _add_channel(found, content)
        elif op == Op.MESSAGE:
            message = mcap.message(content)
            channels.add(message.channel_id)
            times.append(message.log_ns)
    if times:
        found.chunks.append(ChunkPlace(at, length, min(times), max(times), frozenset(channels)))


def _search(disk: Disk, start: int) -> int:
    """Where the next chunk is that is right; the file's size when there is none."""
    overlap = mcap.LONGEST_CHUNK_HEAD + PREFIX.size
    for block_at in range(start, disk.size, _SEARCHED):
        block = disk.read(block_at, min(_SEARCHED + overlap, disk.size - block_at))
        for candidate in _candidates(block):
            at = block_at + candidate
            try:
                read_chunk(disk, at)
            except DamageError:
                continue
            return at
    return disk.size


def _candidates(block: bytes) -> Iterator[int]:
    """Where in these bytes a chunk may begin, in order."""
    places = set()
    for mark in _MARKS:
        at = block.find(mark)
        while at >= 0:
            start = at - _MARK_AT
            if start >= 0 and block[start] == Op.CHUNK:
                places.add(start)
            at = block.find(mark, at + 1)
    return iter(sorted(places))


def read_chunk(disk: Disk, at: int) -> tuple[int, bytes | memoryview]:
    """The length of the chunk record at a place, and the records in it, as their checksum vouches for them."""
    op, length = PREFIX.unpack(disk.read(at, PREFIX.size))
    if op != Op.CHUNK or length > disk.size - at - PREFIX.size or length > LARGEST_CHUNK:
        raise DamageError("it is damaged, or cut off")
    record = memoryview(disk.read(at + PREFIX.size, length))
    head, start = mcap.ChunkHead.unpack(record)
    if start + head.packed_bytes != length:
        raise DamageError("its length contradicts itself")
    raw = unpack(head.compression, record[start:], head.raw_bytes)
    if head.crc not in (0, zlib.crc32(raw)):  # 0: its writer gave none
        raise DamageError("its checksum is wrong")
    return PREFIX.size + length, raw


# --- what is found --------------------------------------------------------------------------------


def _add_schema(found: Contents, content: bytes | memoryview) -> None:
    schema = mcap.Schema.unpack(content)
    found.schemas[schema.id] = schema


def _add_channel(found: Contents, content: bytes | memoryview) -> None:
    channel = mcap.Channel.unpack(content)
    found.channels[channel.id] = channel


def _add_metadata(found: Contents, content: bytes | memoryview) -> None:
    name, entries = mcap.Metadata.unpack(content)
    told = dict(entries)
    known = told.pop(CHECKSUM, None)
    if known != checksum(entries) and (found.ours or known is not None):
        raise DamageError(f"the metadata {name!r} is not what was written")
    found.metadata.append(mcap.Metadata(name, told))
