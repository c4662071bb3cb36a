"""The records of an MCAP file (https://mcap.dev/spec), to and from bytes. Pure: no files, no policy.

Ours rather than the mcap package's, because a capture wants three things of its writer and reader that it does not
offer: a frame goes from the mesh to the disk without being copied, each chunk has the compression that suits it, and
a damaged file is read as far as its checksums vouch for it, never further.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from enum import IntEnum
from typing import NamedTuple

from cocoro.capture.errors import DamageError

MAGIC = b"\x89MCAP0\r\n"
Bytes = bytes | memoryview


class Op(IntEnum):
    HEADER = 0x01
    FOOTER = 0x02
    SCHEMA = 0x03
    CHANNEL = 0x04
    MESSAGE = 0x05
    CHUNK = 0x06
    MESSAGE_INDEX = 0x07
    CHUNK_INDEX = 0x08
    ATTACHMENT = 0x09
    ATTACHMENT_INDEX = 0x0A
    STATISTICS = 0x0B
    METADATA = 0x0C
    METADATA_INDEX = 0x0D
    SUMMARY_OFFSET = 0x0E
    DATA_END = 0x0F


PREFIX = struct.Struct("<BQ")
"""Opcode and length of what follows."""
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
"""The prefix, then channel, sequence, log time, publish time; the payload is the rest."""
_CHUNK_TIMES = struct.Struct("<QQQI")
_FOOTER = struct.Struct("<QQI")
FOOTER_LENGTH = PREFIX.size + _FOOTER.size


@dataclass(frozen=True)
class Schema:
    id: int
    name: str
    encoding: str
    data: bytes

    def pack(self) -> bytes:
        head = struct.pack("<H", self.id) + _string(self.name) + _string(self.encoding)
        return record(Op.SCHEMA, head, struct.pack("<I", len(self.data)), self.data)

    @classmethod
    def unpack(cls, content: Bytes) -> Schema:
        take = Take(content)
        return cls(take.number("<H"), take.string(), take.string(), take.bytes(take.number("<I")))


@dataclass(frozen=True)
class Channel:
    id: int
    schema_id: int
    """0: there is no schema."""
    topic: str
    encoding: str
    metadata: Mapping[str, str] = field(default_factory=dict)

    def pack(self) -> bytes:
        head = struct.pack("<HH", self.id, self.schema_id) + _string(self.topic) + _string(self.encoding)
        return record(Op.CHANNEL, head, _string_map(self.metadata))

    @classmethod
    def unpack(cls, content: Bytes) -> Channel:
        take = Take(content)
        ids = take.number("<H"), take.number("<H")
        return cls(*ids, take.string(), take.string(), take.string_map())


class Message(NamedTuple):
    """As it stands in a chunk."""

    channel_id: int
    sequence: int
    log_ns: int
    publish_ns: int
    payload: memoryview


@dataclass(frozen=True)
class ChunkHead:
    """What stands before a chunk's records."""

    start_ns: int
    end_ns: int
    raw_bytes: int
    crc: int
    """Of the records before compression; 0: there is none."""
    compression: str
    packed_bytes: int

    def pack(self) -> bytes:
        """With the record's prefix; the (packed) records follow."""
        times = _CHUNK_TIMES.pack(self.start_ns, self.end_ns, self.raw_bytes, self.crc)
        head = times + _string(self.compression) + struct.pack("<Q", self.packed_bytes)
        return PREFIX.pack(Op.CHUNK, len(head) + self.packed_bytes) + head

    @classmethod
    def unpack(cls, content: Bytes) -> tuple[ChunkHead, int]:
        """The head, and how long it is; `content` needs hold no more than the head."""
        take = Take(content)
        start_ns, end_ns, raw_bytes, crc = _CHUNK_TIMES.unpack(take.bytes(_CHUNK_TIMES.size))
        compression = take.string()
        return cls(start_ns, end_ns, raw_bytes, crc, compression, take.number("<Q")), take.at


LONGEST_CHUNK_HEAD = _CHUNK_TIMES.size + 4 + 16 + 8
"""Bytes, with a compression's name of up to 16."""


@dataclass(frozen=True)
class ChunkIndex:
    start_ns: int
    end_ns: int
    offset: int
    length: int
    """Of the whole chunk record, its prefix included."""
    index_offsets: Mapping[int, int]
    """Where each channel's message index stands; so also which channels the chunk has."""
    index_length: int
    compression: str
    packed_bytes: int
    raw_bytes: int

    def pack(self) -> bytes:
        offsets = b"".join(struct.pack("<HQ", *pair) for pair in self.index_offsets.items())
        return record(
            Op.CHUNK_INDEX,
            struct.pack("<QQQQI", self.start_ns, self.end_ns, self.offset, self.length, len(offsets)),
            offsets,
            struct.pack("<Q", self.index_length),
            _string(self.compression),
            struct.pack("<QQ", self.packed_bytes, self.raw_bytes),
        )

    @classmethod
    def unpack(cls, content: Bytes) -> ChunkIndex:
        take = Take(content)
        start_ns, end_ns, offset, length = (take.number("<Q") for _ in range(4))
        pairs = take.bytes(take.number("<I"))
        if len(pairs) % 10:
            raise DamageError("a chunk index has half an entry")
        offsets = dict(struct.iter_unpack("<HQ", pairs))
        index_length, compression = take.number("<Q"), take.string()
        sizes = take.number("<Q"), take.number("<Q")
        return cls(start_ns, end_ns, offset, length, offsets, index_length, compression, *sizes)


@dataclass(frozen=True)
class Statistics:
    messages: int
    schemas: int
    channels: int
    metadata: int
    chunks: int
    start_ns: int
    end_ns: int
    by_channel: Mapping[int, int]
    attachments: int = 0

    def pack(self) -> bytes:
        counts = b"".join(struct.pack("<HQ", *pair) for pair in self.by_channel.items())
        numbers = (self.schemas, self.channels, self.attachments, self.metadata, self.chunks)
        times = (self.start_ns, self.end_ns, len(counts))
        return record(Op.STATISTICS, struct.pack("<QHIIIIQQI", self.messages, *numbers, *times), counts)

    @classmethod
    def unpack(cls, content: Bytes) -> Statistics:
        take = Take(content)
        messages, schemas = take.number("<Q"), take.number("<H")
        channels, attachments, metadata, chunks = (take.number("<I") for _ in range(4))
        start_ns, end_ns = take.number("<Q"), take.number("<Q")
        pairs = take.bytes(take.number("<I"))
        if len(pairs) % 10:
            raise DamageError("the statistics have half an entry")
        by_channel = dict(struct.iter_unpack("<HQ", pairs))
        return cls(messages, schemas, channels, metadata, chunks, start_ns, end_ns, by_channel, attachments)


class Metadata(NamedTuple):
    name: str
    entries: Mapping[str, str]

    def pack(self) -> bytes:
        return record(Op.METADATA, _string(self.name), _string_map(self.entries))

    @classmethod
    def unpack(cls, content: Bytes) -> Metadata:
        take = Take(content)
        return cls(take.string(), take.string_map())


class MetadataIndex(NamedTuple):
    offset: int
    length: int
    name: str

    def pack(self) -> bytes:
        return record(Op.METADATA_INDEX, struct.pack("<QQ", self.offset, self.length), _string(self.name))

    @classmethod
    def unpack(cls, content: Bytes) -> MetadataIndex:
        take = Take(content)
        return cls(take.number("<Q"), take.number("<Q"), take.string())


def header(profile: str, library: str) -> bytes:
    return record(Op.HEADER, _string(profile), _string(library))


def message_index(channel_id: int, entries: list[tuple[int, int]]) -> bytes:
    """`entries` are log time and offset in the chunk's records before compression."""
    packed = b"".join(struct.pack("<QQ", *entry) for entry in entries)
    return record(Op.MESSAGE_INDEX, struct.pack("<HI", channel_id, len(packed)), packed)


def check_message_index(content: Bytes) -> None:
    """Raises DamageError for what can be none."""
    if len(content) < 6 or struct.unpack_from("<I", content, 2)[0] != len(content) - 6 or (len(content) - 6) % 16:
        raise DamageError("a message index has a wrong length")


def summary_offset(group: Op, start: int, length: int) -> bytes:
    return record(Op.SUMMARY_OFFSET, struct.pack("<BQQ", group, start, length))


def data_end() -> bytes:
    """Without a checksum over all the data: each chunk has its own."""
    return record(Op.DATA_END, bytes(4))


def footer(summary: bytes, summary_start: int, offsets_start: int) -> bytes:
    """`summary` is the whole of the summary section, whose checksum goes in here."""
    head = PREFIX.pack(Op.FOOTER, _FOOTER.size) + struct.pack("<QQ", summary_start, offsets_start)
    return head + struct.pack("<I", zlib.crc32(head, zlib.crc32(summary)))


class Footer(NamedTuple):
    summary_start: int
    offsets_start: int
    crc: int

    @classmethod
    def unpack(cls, content: Bytes) -> Footer:
        if len(content) != _FOOTER.size:
            raise DamageError("the footer has a wrong length")
        return cls(*_FOOTER.unpack(content))

    def vouches_for(self, summary: bytes) -> bool:
        """Whether the summary section is what it was when it was written; True when the writer gave no checksum."""
        head = PREFIX.pack(Op.FOOTER, _FOOTER.size) + struct.pack("<QQ", self.summary_start, self.offsets_start)
        return self.crc in (0, zlib.crc32(head, zlib.crc32(summary)))


def record(op: Op, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return PREFIX.pack(op, len(content)) + content


def records(content: Bytes) -> Iterator[tuple[int, memoryview, int]]:
    """Opcode, content and offset of each record in a run of them. Raises DamageError where one does not fit."""
    view = memoryview(content)
    at = 0
    while at < len(view):
        if at + PREFIX.size > len(view):
            raise DamageError(f"a record is cut off at byte {at}")
        op, length = PREFIX.unpack_from(view, at)
        start = at + PREFIX.size
        if length > len(view) - start:
            raise DamageError(f"a record at byte {at} is longer than what holds it")
        yield op, view[start : start + length], at
        at = start + length


def channel_of(content: memoryview) -> int:
    """From a message record's content, before the rest of it is looked at."""
    if len(content) < 2:
        raise DamageError("a message is shorter than its head")
    return content[0] | content[1] << 8


def message(content: memoryview) -> Message:
    """From a message record's content."""
    if len(content) < MESSAGE_HEAD.size - PREFIX.size:
        raise DamageError("a message is shorter than its head")
    channel_id, sequence, log_ns, publish_ns = struct.unpack_from("<HIQQ", content)
    return Message(channel_id, sequence, log_ns, publish_ns, content[MESSAGE_HEAD.size - PREFIX.size :])


class Take:
    """Takes values off bytes, one after another. Whatever does not fit raises DamageError."""

    def __init__(self, content: Bytes) -> None:
        self.at = 0
        self._content = memoryview(content)

    def bytes(self, count: int) -> bytes:
        if count > len(self._content) - self.at:
            raise DamageError("a record ends in the middle of a field")
        self.at += count
        return bytes(self._content[self.at - count : self.at])

    def number(self, form: str) -> int:
        number: int = struct.unpack(form, self.bytes(struct.calcsize(form)))[0]
        return number

    def string(self) -> str:
        try:
            return str(self.bytes(self.number("<I")), "utf-8")
        except UnicodeDecodeError as error:
            raise DamageError("a text is not UTF-8") from error

    def string_map(self) -> dict[str, str]:
        inner = Take(self.bytes(self.number("<I")))
        found: dict[str, str] = {}
        while inner.at < len(inner._content):
            name = inner.string()
            found[name] = inner.string()
        return found


def _string(text: str) -> bytes:
    data = text.encode()
    return struct.pack("<I", len(data)) + data


def _string_map(entries: Mapping[str, str]) -> bytes:
    data = b"".join(_string(name) + _string(value) for name, value in entries.items())
    return struct.pack("<I", len(data)) + data
