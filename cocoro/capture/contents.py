"""The contents of an MCAP file: what it has, and at which byte."""

from __future__ import annotations

import os
import zlib
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import AttachmentIndex, Channel, Header, Metadata, Schema, Statistics

from cocoro.capture import mcap
from cocoro.capture.conventions import CHECKSUM, MAKER, PROFILE, TALLY, checksum
from cocoro.capture.mcap import LARGEST_CHUNK, MAGIC, PREFIX, CutOffError, DamageError, unpack

LARGEST_RECORD = 1 << 28
"""Bytes of records other than chunks, messages and attachments; what claims to be larger is damaged."""
NEAR_BYTES = 1 << 18


class MessageBlock(NamedTuple):
    """Where messages are: a chunk, or a run of messages that are in none."""

    offset: int
    length: int
    """With the prefixes of its records."""
    start_ns: int
    end_ns: int
    channels: frozenset[int] | None
    """None: not known without looking."""
    loose: bool = False
    """It is no chunk."""


@dataclass
class Contents:
    """A file's schemas, channels, metadata and attachments, and the places of its messages."""

    profile: str = ""
    library: str = ""
    header_right: bool = True
    """False where the header has zeros in its texts, or is longer than its fields: by others it may be."""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    places: list[MessageBlock] = field(default_factory=list)
    metadata: list[Metadata] = field(default_factory=list)
    """As they stand in the file."""
    metadata_at: list[int] = field(default_factory=list)
    """The place of each of them."""
    metadata_told: dict[int, str] = field(default_factory=dict)
    """Place and name of each, as the summary's index of them has it."""
    attachments: list[AttachmentIndex] = field(default_factory=list)
    statistics: Statistics | None = None
    raw_bytes: int = 0
    """Size of all chunks before compression."""
    chunks: int = 0
    """With those that have no messages."""
    messages: Counter[int] = field(default_factory=Counter)
    """By channel, how many were counted; none where this was taken from the summary."""
    closed: bool = False
    """It has its end, whatever else is wrong with it."""
    summarised: bool = False
    """This was taken from the file's summary, so not all of the file has been read."""
    data_end: int = 0
    """Where the record of this name is; 0 where there is none."""
    data_crc: int = 0
    """Checksum of all bytes before it; 0: its writer gave none."""
    cut_bytes: int = 0
    """At the end, of a record that was never finished: what the death of a recorder leaves, so no damage."""
    problems: list[str] = field(default_factory=list)
    unknown: Counter[int] = field(default_factory=Counter)
    """By opcode, records of kinds that are not MCAP's own."""

    @property
    def follows_page(self) -> bool:
        """The conventions of docs/captures.md hold."""
        return self.profile == PROFILE

    @property
    def ours(self) -> bool:
        """It was written by a recorder. So messages are in chunks; every chunk, the summary and each metadata record
        have their checksum; no record is longer than its fields; and a file that was closed has statistics and a
        tally. What is missing of these, or 0, is damage."""
        return self.follows_page and self.library.startswith(MAKER)

    def add_schema(self, content: mcap.Bytes) -> int:
        schema, taken = mcap.parsed(Schema, content)
        self.schemas[schema.id] = schema
        return taken

    def add_channel(self, content: mcap.Bytes) -> int:
        channel, taken = mcap.parsed(Channel, content)
        self.channels[channel.id] = channel
        return taken

    def add_metadata(self, content: mcap.Bytes, at: int) -> int:
        """How many bytes of it the record at a place takes. Raises DamageError where a recorder's checksum is wrong."""
        found, taken = mcap.parsed(Metadata, content)
        if self.ours and found.metadata.get(CHECKSUM) != checksum(found.metadata):
            raise DamageError(f"the metadata {found.name!r} is not what was written")
        self.metadata.append(found)
        self.metadata_at.append(at)
        return taken


class Disk:
    """A file to read from at any place. Shorter than wanted is damage, not an error of the disk's."""

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
                raise CutOffError(f"the file has become shorter than {offset + length} bytes")
            data += more
        return data

    def near(self, offset: int, length: int) -> bytes:
        """Read from a block that is kept: for many small pieces in order. Not for use by two threads at once."""
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
            crc = zlib.crc32(self.read(at, min(4 * NEAR_BYTES, end - at)), crc)
        return crc


def begun(disk: Disk) -> Contents:
    """Contents with the file's header; an empty one where it cannot be read."""
    try:
        op, length = PREFIX.unpack(disk.read(len(MAGIC), PREFIX.size))
        if op == Opcode.HEADER and length <= LARGEST_RECORD:
            header, taken = mcap.parsed(Header, disk.read(len(MAGIC) + PREFIX.size, length))
            right = taken == length and "\0" not in header.profile + header.library
            return Contents(header.profile, header.library, right)
    except DamageError:
        pass
    return Contents()


def read_chunk(disk: Disk, at: int, ours: bool, exactly: bool = False) -> tuple[int, bytes | memoryview]:
    """The length of the chunk record at a place, and the records in it, as their checksum vouches for them; `ours` as
    for `unpacked`. With `exactly` one without a checksum must not be longer than its fields. Raises DamageError."""
    op, length = PREFIX.unpack(disk.read(at, PREFIX.size))
    if op != Opcode.CHUNK or length > disk.size - at - PREFIX.size or length > LARGEST_CHUNK:
        raise DamageError("it is damaged, or cut off")
    raw, taken = unpacked(content := disk.read(at + PREFIX.size, length), ours)
    if exactly and taken != length and mcap.ChunkHead.unpack(content)[0].crc == 0:
        raise DamageError("its length contradicts itself")
    return PREFIX.size + length, raw


def unpacked(content: bytes, ours: bool) -> tuple[bytes | memoryview, int]:
    """The records in a chunk, from its record's content, and how many bytes of that it takes. One of `ours`, a
    recorder's, has records and their checksum, and nothing after them: zeros in its head would else make it a chunk
    without records that has no checksum. Raises DamageError."""
    record = memoryview(content)
    head, start = mcap.ChunkHead.unpack(record)
    if start + head.packed_bytes > len(record):
        raise DamageError("its length contradicts itself")
    raw = unpack(head.compression, record[start : start + head.packed_bytes], head.raw_bytes)
    taken = start + head.packed_bytes
    if ours and (not raw or taken != len(record)):
        raise DamageError("its length contradicts itself")
    if head.crc != zlib.crc32(raw) and (ours or head.crc != 0):  # 0: its writer gave none, which recorders never do
        raise DamageError("its checksum is wrong")
    return raw, taken


def read_block(disk: Disk, place: MessageBlock, ours: bool) -> bytes | memoryview:
    """The records of a place; `ours` as for `unpacked`."""
    return disk.read(place.offset, place.length) if place.loose else read_chunk(disk, place.offset, ours)[1]


RECORDERS_NAMES = ("run", "robot", "profile", TALLY)
"""Metadata that every recorder writes; beside these, `service/` and a service's name."""


def compare(found: Contents) -> None:
    """Add to the file's problems what does not agree, and take away metadata that is not what was written."""
    _keep_written(found)
    found.problems += _contradictions(found)
    if not found.ours or not found.closed:
        return
    if found.statistics is None and not found.problems:
        found.problems.append("its statistics are missing, which every recorder writes")
    if all(each.name != TALLY for each in found.metadata):
        found.problems.append(f"its metadata {TALLY!r} is missing, which every recorder writes")


def miscounted(
    statistics: Statistics, counts: Mapping[int, int], channels: Collection[int], of_all: bool
) -> Iterator[str]:
    """In words, where the statistics say another number of messages than was counted: in the whole file, when the
    counts are `of_all` channels, else by channel. Files may state the first without the second."""
    counted = sum(counts.values())
    if of_all and statistics.message_count != counted:
        yield f"its statistics say {statistics.message_count} messages, and {counted} can be read"
        return
    told = statistics.channel_message_counts
    for channel in sorted(channels) if told else ():
        said, has = told.get(channel, 0), counts.get(channel, 0)
        if said != has:
            yield f"its statistics say {said} messages of channel {channel}, and {has} can be read"


def _contradictions(found: Contents) -> Iterator[str]:
    """Whatever was read from front to back is held against the statistics; what was taken from the summary has been."""
    told = found.statistics
    if told is None or found.summarised:
        return
    yield from miscounted(told, found.messages, found.channels.keys() | found.messages.keys(), of_all=True)
    for said, has, words in (
        (told.schema_count, len(found.schemas), "schemas"),
        (told.channel_count, len(found.channels), "channels"),
        (told.chunk_count, found.chunks, "chunks"),
        (told.attachment_count, len(found.attachments), "attachments"),
        (told.metadata_count, len(found.metadata), "metadata records"),
    ):
        if said != has:
            yield f"its statistics say {said} {words}, and {has} can be read"


def _keep_written(found: Contents) -> None:
    """A header that is damaged makes a recorder's file look like another's, whose metadata need no checksums. So where
    one record has the checksum of a recorder, each that has one, or has a name that recorders give, is held against it.
    A record's name is in no checksum, so it is held against the summary's index."""
    sealed = any(each.metadata.get(CHECKSUM) == checksum(each.metadata) for each in found.metadata)
    kept: list[tuple[int, Metadata]] = []
    if not sealed:
        return
    if not found.header_right:
        found.problems.append("the file's header is damaged")
    for at, each in zip(found.metadata_at, found.metadata, strict=True):
        needless = CHECKSUM not in each.metadata and not _recorders_name(each.name)
        right = needless or each.metadata.get(CHECKSUM) == checksum(each.metadata)
        if right and _named(found.metadata_told, at, each.name):
            kept.append((at, each))
        else:
            found.problems.append(f"the metadata {each.name!r} at byte {at} is not what was written")
    found.metadata_at, found.metadata = [at for at, _ in kept], [each for _, each in kept]


def _recorders_name(name: str) -> bool:
    return name in RECORDERS_NAMES or name.startswith("service/")


def _named(told: Mapping[int, str], at: int, name: str) -> bool:
    """Whether the index, if there is one, has a record of this name: at this place, or where records were moved
    because bytes before them are missing, at any."""
    return not told or (told[at] == name if at in told else name in told.values())
