"""The contents of an MCAP file and where they are, and whether the file's own counts and checksums agree with them."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Header, Metadata, Schema, Statistics

from cocoro.capture import mcap
from cocoro.capture.conventions import CHECKSUM, MAKER, PROFILE, TALLY, checksum
from cocoro.capture.mcap import MAGIC, PREFIX, CutOffError, DamageError
from cocoro.capture.mcap_reading import LARGEST_CHUNK, unpack

LARGEST_RECORD = 1 << 28
"""Bytes of records other than chunks, messages and attachments. A record that claims more is damaged."""
NEAR_BYTES = 1 << 18


class MessageBlock(NamedTuple):
    """A part of the file with messages: a chunk, or a run of message records outside of chunks."""

    offset: int
    length: int
    """Including the prefixes of its records."""
    start_ns: int
    end_ns: int
    channels: frozenset[int] | None
    """None: unknown until it is read."""
    loose: bool = False
    """It is a run outside of chunks."""
    indices: Mapping[int, int] | None = None
    """Where in the file the index of a channel's messages in this chunk is, by channel; None where none is stated."""


@dataclass
class Contents:
    """A file's schemas, channels, metadata and attachments, and the blocks of its messages."""

    profile: str = ""
    library: str = ""
    header_right: bool = True
    """False when the header's texts contain zeros, or it is longer than its known fields. Files of other writers may
    have both."""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    places: list[MessageBlock] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    """In the order of the file."""
    metadata_at: list[int] = field(default_factory=list)
    """The offset of each of them."""
    metadata_index: dict[int, str] = field(default_factory=dict)
    """Name by offset, from the summary's index of metadata."""
    attachments: list[AttachmentIndex] = field(default_factory=list)
    statistics: Statistics | None = None
    raw_bytes: int = 0
    """Uncompressed size of all chunks."""
    chunks: int = 0
    """Including chunks without messages."""
    messages: Counter[int] = field(default_factory=Counter)
    """Counted messages by channel; empty when the contents come from the summary."""
    closed: bool = False
    """The file has its footer, whatever else is damaged."""
    summarised: bool = False
    """The contents come from the file's summary, so not all of the file has been read."""
    data_end: int = 0
    """Offset of the DataEnd record; 0: none."""
    data_crc: int = 0
    """Checksum of all bytes before DataEnd; 0: none."""
    cut_bytes: int = 0
    """Bytes of an unfinished last record. A killed recorder leaves these, so they are no damage."""
    problems: list[str] = field(default_factory=list)
    unknown: Counter[int] = field(default_factory=Counter)
    """Records of kinds that MCAP does not define, by opcode."""

    @property
    def follows_conventions(self) -> bool:
        """The file follows the conventions of docs/captures.md."""
        return self.profile == PROFILE

    @property
    def strict(self) -> bool:
        """The file is by this project's recorder, so the strict rules apply: messages are in chunks; every chunk,
        metadata record and summary has its checksum; no record is longer than its fields; a closed file has
        statistics and a tally. A part of these that is missing or 0 is damaged."""
        return self.follows_conventions and self.library.startswith(MAKER)

    def add_schema(self, content: mcap.Bytes) -> int:
        schema, taken = mcap.parsed(Schema, content)
        self.schemas[schema.id] = schema
        return taken

    def add_channel(self, content: mcap.Bytes) -> int:
        channel, taken = mcap.parsed(Channel, content)
        self.channels[channel.id] = channel
        return taken

    def add_metadata(self, content: mcap.Bytes, at: int) -> int:
        """Returns the number of bytes that the record takes. Raises DamageError when a recorder's checksum is wrong."""
        found, taken = mcap.parsed(Metadata, content)
        if self.strict and found.metadata.get(CHECKSUM) != checksum(found.metadata):
            raise DamageError(f"the metadata {found.name!r} differs from what was written")
        self.metadata.append(found)
        self.metadata_at.append(at)
        return taken


class Disk:
    """Reads a file at any offset. Raises CutOffError where the file is too short."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self.size = os.fstat(fd).st_size
        self._near_at, self._near = 0, b""

    def read(self, offset: int, length: int) -> bytes:
        if offset < 0 or offset + length > self.size:
            raise CutOffError(f"{length} bytes at byte {offset} are beyond the file's end")
        data = os.pread(self._fd, length, offset)
        while len(data) < length:
            more = os.pread(self._fd, length - len(data), offset + len(data))
            if not more:
                raise CutOffError(f"the file was cut to less than {offset + length} bytes meanwhile")
            data += more
        return data

    def read_cached(self, offset: int, length: int) -> bytes:
        """Read through a block that is kept in memory, for many small reads in order. Not thread-safe."""
        at = offset - self._near_at
        if at < 0 or at + length > len(self._near):
            if length > NEAR_BYTES or offset + length > self.size:
                return self.read(offset, length)
            self._near_at, at = offset, 0
            self._near = self.read(offset, min(NEAR_BYTES, self.size - offset))
        return self._near[at : at + length]

    def checksum(self, start: int, end: int) -> int:
        crc = 0
        for at in range(start, end, 4 * NEAR_BYTES):
            crc = mcap.crc32(self.read(at, min(4 * NEAR_BYTES, end - at)), crc)
        return crc


def read_header(disk: Disk) -> Contents:
    """Contents with the file's header alone; empty when the header cannot be read."""
    try:
        op, length = PREFIX.unpack(disk.read(len(MAGIC), PREFIX.size))
        if op == Opcode.HEADER and length <= LARGEST_RECORD:
            header, taken = mcap.parsed(Header, disk.read(len(MAGIC) + PREFIX.size, length))
            right = taken == length and "\0" not in header.profile + header.library
            return Contents(header.profile, header.library, right)
    except DamageError:
        pass
    return Contents()


def read_chunk(disk: Disk, at: int, strict: bool, exactly: bool = False) -> tuple[int, bytes | memoryview]:
    """Returns the length of the chunk record at an offset, and the records in it, checked by their checksum.

    `strict` as in `unpacked`. With `exactly`, a chunk without a checksum must not be longer than its fields. Raises
    DamageError.
    """
    op, length = PREFIX.unpack(disk.read(at, PREFIX.size))
    if op != Opcode.CHUNK or length > disk.size - at - PREFIX.size or length > LARGEST_CHUNK:
        raise DamageError("it is damaged, or cut off")
    raw, taken = unpacked(content := disk.read(at + PREFIX.size, length), strict)
    if exactly and taken != length and mcap.ChunkHead.unpack(content)[0].crc == 0:
        raise DamageError("its stated lengths disagree")
    return PREFIX.size + length, raw


def unpacked(content: bytes, strict: bool) -> tuple[bytes | memoryview, int]:
    """Returns the records in a chunk, and the number of bytes of `content` that the chunk takes.

    A `strict` chunk must have records and a checksum, and nothing after them: otherwise zeros in its head would turn it
    into an empty chunk without a checksum. Raises DamageError.
    """
    record = memoryview(content)
    head, start = mcap.ChunkHead.unpack(record)
    if start + head.packed_bytes > len(record):
        raise DamageError("its stated lengths disagree")
    raw = unpack(head.compression, record[start : start + head.packed_bytes], head.raw_bytes)
    taken = start + head.packed_bytes
    if strict and (not raw or taken != len(record)):
        raise DamageError("its stated lengths disagree")
    if head.crc != mcap.crc32(raw) and (strict or head.crc != 0):  # 0: no checksum, which recorders never write
        raise DamageError("its checksum is wrong")
    return raw, taken


def read_block(disk: Disk, place: MessageBlock, strict: bool) -> bytes | memoryview:
    """Returns the records of a block. Raises DamageError."""
    return disk.read(place.offset, place.length) if place.loose else read_chunk(disk, place.offset, strict)[1]


RECORDERS_NAMES = ("run", "robot", "profile", TALLY)
"""Metadata that every recorder writes, besides `service/<name>`."""


def compare(found: Contents) -> None:
    """Add contradictions to the file's problems, and remove metadata that is not as it was written."""
    _keep_written(found)
    found.problems += _contradictions(found)
    if not found.strict or not found.closed:
        return
    if found.statistics is None and not found.problems:
        found.problems.append("its statistics are missing, which every recorder writes")
    if all(each.name != TALLY for each in found.metadata):
        found.problems.append(f"its metadata {TALLY!r} is missing, which every recorder writes")


def miscounted(
    statistics: Statistics, counts: Mapping[int, int], channels: Collection[int], of_all: bool
) -> Iterator[str]:
    """Describes differences between the statistics and the counted messages: of the whole file when `counts` are
    `of_all` channels, otherwise by channel. A file may have the first number without the second."""
    counted = sum(counts.values())
    if of_all and statistics.message_count != counted:
        yield f"its statistics have {statistics.message_count} messages, and {counted} can be read"
        return
    stated = statistics.channel_message_counts
    for channel in sorted(channels) if stated else ():
        expected, readable = stated.get(channel, 0), counts.get(channel, 0)
        if expected != readable:
            yield f"its statistics have {expected} messages of channel {channel}, and {readable} can be read"


def _contradictions(found: Contents) -> Iterator[str]:
    """Compares what was read front to back with the statistics. Contents from the summary have been compared with them
    already."""
    stated = found.statistics
    if stated is None or found.summarised:
        return
    yield from miscounted(stated, found.messages, found.channels.keys() | found.messages.keys(), of_all=True)
    for expected, readable, words in (
        (stated.schema_count, len(found.schemas), "schemas"),
        (stated.channel_count, len(found.channels), "channels"),
        (stated.chunk_count, found.chunks, "chunks"),
        (stated.attachment_count, len(found.attachments), "attachments"),
        (stated.metadata_count, len(found.metadata), "metadata records"),
    ):
        if expected != readable:
            yield f"its statistics have {expected} {words}, and {readable} can be read"


def _keep_written(found: Contents) -> None:
    """A damaged header makes a recorder's file look like another writer's, whose metadata need no checksums. So when
    one record has a recorder's checksum, every record with a checksum or a recorder's name must have the right one.
    Names are not covered by the checksum; they are compared with the summary's index."""
    sealed = any(each.metadata.get(CHECKSUM) == checksum(each.metadata) for each in found.metadata)
    kept: list[tuple[int, Metadata]] = []
    if not sealed:
        return
    if not found.header_right:
        found.problems.append("the file's header is damaged")
    for at, each in zip(found.metadata_at, found.metadata, strict=True):
        needless = CHECKSUM not in each.metadata and not _recorders_name(each.name)
        right = needless or each.metadata.get(CHECKSUM) == checksum(each.metadata)
        if right and _named(found.metadata_index, at, each.name):
            kept.append((at, each))
        else:
            found.problems.append(f"the metadata {each.name!r} at byte {at} differs from what was written")
    found.metadata_at, found.metadata = [at for at, _ in kept], [each for _, each in kept]


def _recorders_name(name: str) -> bool:
    return name in RECORDERS_NAMES or name.startswith("service/")


def _named(stated: Mapping[int, str], at: int, name: str) -> bool:
    """Whether the index has this name at this offset, or anywhere when bytes before the record are missing and it has
    moved. True without an index."""
    return not stated or (stated[at] == name if at in stated else name in stated.values())
