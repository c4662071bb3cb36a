"""The files of MCAP's conformance set, made anew from its published rules: every sensible combination of six contents
and the features that a writer may use or leave out."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from itertools import combinations
from typing import NamedTuple

MAGIC = b"\x89MCAP0\r\n"
PADDING = b"\x01\xff\xff"
"""Put at the end of records, which readers have to pass by: a later version of MCAP may have fields there."""

CHUNKS, CHUNK_INDEX, MESSAGE_INDEX = "ch", "chx", "mx"
SCHEMAS_AGAIN, CHANNELS_AGAIN, STATISTICS, OFFSETS = "rsh", "rch", "st", "sum"
ATTACHMENT_INDEX, METADATA_INDEX, PADDED = "ax", "mdx", "pad"
FEATURES = (
    ATTACHMENT_INDEX, CHUNKS, CHUNK_INDEX, METADATA_INDEX, MESSAGE_INDEX, PADDED, CHANNELS_AGAIN, SCHEMAS_AGAIN,
    STATISTICS, OFFSETS,
)  # fmt: skip
SUMMARISED = {CHUNK_INDEX, SCHEMAS_AGAIN, CHANNELS_AGAIN, METADATA_INDEX, ATTACHMENT_INDEX, STATISTICS}
"""Features that put something into the summary, so that there is something to give offsets of."""


class Content(NamedTuple):
    """The contents of a file's records, without opcode and length."""

    schema: bytes = b""
    channel: bytes = b""
    messages: tuple[tuple[int, bytes], ...] = ()
    """Log time and content."""
    attachment: bytes = b""
    metadata: bytes = b""


def _text(text: str) -> bytes:
    return struct.pack("<I", len(text)) + text.encode()


def _sized(data: bytes) -> bytes:
    return struct.pack("<I", len(data)) + data


def _channel(schema_id: int, encoding: str, metadata: bytes) -> bytes:
    return struct.pack("<HH", 1, schema_id) + _text("example") + _text(encoding) + _sized(metadata)


def _message(sequence: int, log_time: int, publish_time: int) -> tuple[int, bytes]:
    return log_time, struct.pack("<HIQQ", 1, sequence, log_time, publish_time) + b"\1\2\3"


_WITH_SCHEMA = _channel(1, "a", _text("foo") + _text("bar"))
_SCHEMA = struct.pack("<H", 1) + _text("Example") + _text("c") + _sized(b"\4\5\6")
_ATTACHMENT_HEAD = struct.pack("<QQ", 2, 1) + _text("myFile") + _text("application/octet-stream")
_ATTACHMENT = _ATTACHMENT_HEAD + struct.pack("<Q", 3) + b"\1\2\3"

CONTENTS = {
    "NoData": Content(),
    "OneMessage": Content(_SCHEMA, _WITH_SCHEMA, (_message(10, 2, 1),)),
    "OneSchemalessMessage": Content(b"", _channel(0, "text", b""), (_message(10, 2, 1),)),
    "OneAttachment": Content(attachment=_ATTACHMENT + struct.pack("<I", zlib.crc32(_ATTACHMENT))),
    "OneMetadata": Content(metadata=_text("myMetadata") + _sized(_text("foo") + _text("bar"))),
    "TenMessages": Content(
        _SCHEMA, _WITH_SCHEMA, tuple(_message(n, at, at) for n, at in enumerate((0, 2, 1, 3, 3, 5, 4, 7, 8, 9)))
    ),
}  # fmt: skip


def variants() -> Iterator[tuple[str, bytes]]:
    """Each file's name, without its ending, and its bytes."""
    for name, content in CONTENTS.items():
        for count in range(len(FEATURES) + 1):
            for features in map(frozenset, combinations(FEATURES, count)):
                if _sensible(content, features):
                    yield "-".join([name, *sorted(features)]), made(content, features)


def _sensible(content: Content, features: frozenset[str]) -> bool:
    needs = {
        ATTACHMENT_INDEX: bool(content.attachment),
        METADATA_INDEX: bool(content.metadata),
        SCHEMAS_AGAIN: bool(content.schema),
        CHANNELS_AGAIN: bool(content.channel),
        CHUNKS: bool(content.messages),
        CHUNK_INDEX: CHUNKS in features,
        MESSAGE_INDEX: CHUNKS in features,
        OFFSETS: bool(features & SUMMARISED),
    }
    return all(needs.get(feature, True) for feature in features)


def made(content: Content, features: frozenset[str]) -> bytes:
    """One file."""
    file = _File(features)
    file.add(0x01, _text("") + _text(""))
    summary: dict[int, bytes] = {0x03: b"", 0x04: b"", 0x0B: b"", 0x0D: b"", 0x0A: b"", 0x08: b""}
    """By opcode, in the order in which the groups stand there."""
    if CHUNKS in features:
        summary[0x08] = file.chunk(content)
    else:
        file.run(content)
    if content.attachment:
        at, length = file.add(0x09, content.attachment)
        index = struct.pack("<QQ", at, length) + _ATTACHMENT_HEAD[:16] + struct.pack("<Q", 3) + _ATTACHMENT_HEAD[16:]
        summary[0x0A] = index if ATTACHMENT_INDEX in features else b""
    if content.metadata:
        at, length = file.add(0x0C, content.metadata)
        summary[0x0D] = struct.pack("<QQ", at, length) + _text("myMetadata") if METADATA_INDEX in features else b""
    summary[0x03] = content.schema if SCHEMAS_AGAIN in features else b""
    summary[0x04] = content.channel if CHANNELS_AGAIN in features else b""
    summary[0x0B] = _statistics(content, features) if STATISTICS in features else b""
    file.end(summary)
    return bytes(file.data)


def _statistics(content: Content, features: frozenset[str]) -> bytes:
    times = [log_time for log_time, _ in content.messages] or [0]
    counts = (
        len(content.messages), bool(content.schema), bool(content.channel), bool(content.attachment),
        bool(content.metadata), CHUNKS in features, min(times), max(times),
    )  # fmt: skip
    by_channel = struct.pack("<HQ", 1, len(content.messages)) if content.messages else b""
    return struct.pack("<QHIIIIQQ", *counts) + _sized(by_channel)


class _File:
    def __init__(self, features: frozenset[str]) -> None:
        self.data = bytearray(MAGIC)
        self._features = features
        self._padding = PADDING if PADDED in features else b""

    def add(self, op: int, content: bytes, padded: bool = True) -> tuple[int, int]:
        """A record; where it stands, and how long it is."""
        at = len(self.data)
        content += self._padding if padded else b""
        self.data += struct.pack("<BQ", op, len(content)) + content
        return at, len(self.data) - at

    def run(self, content: Content) -> None:
        """Schema, channel and messages, one after another. Nothing can be told from a message's data, so it has no
        padding."""
        for op, one in ((0x03, content.schema), (0x04, content.channel)):
            if one:
                self.add(op, one)
        for _, message in content.messages:
            self.add(0x05, message, padded=False)

    def chunk(self, content: Content) -> bytes:
        """Schema, channel and messages in a chunk; neither the chunk nor its records have padding. Returns its index,
        if it is to have one."""
        inner = _File(frozenset())
        inner.run(content)
        records = bytes(inner.data[len(MAGIC) :])
        times = [log_time for log_time, _ in content.messages]
        head = struct.pack("<QQQI", min(times), max(times), len(records), zlib.crc32(records)) + _text("")
        at, length = self.add(0x06, head + struct.pack("<Q", len(records)) + records, padded=False)
        offsets, index_length = b"", 0
        if MESSAGE_INDEX in self._features:
            step = 9 + len(content.messages[0][1])
            first = len(records) - step * len(times)
            entries = b"".join(struct.pack("<QQ", time, first + step * n) for n, time in enumerate(times))
            index_at, index_length = self.add(0x07, struct.pack("<H", 1) + _sized(entries))
            offsets = struct.pack("<HQ", 1, index_at)
        if CHUNK_INDEX not in self._features:
            return b""
        told = struct.pack("<QQQQ", min(times), max(times), at, length) + _sized(offsets)
        return told + struct.pack("<Q", index_length) + _text("") + struct.pack("<QQ", len(records), len(records))

    def end(self, summary: dict[int, bytes]) -> None:
        """The end of the data, the summary, the footer."""
        self.add(0x0F, struct.pack("<I", zlib.crc32(self.data)), padded=False)
        start = len(self.data)
        groups = [(op, *self.add(op, content)) for op, content in summary.items() if content]
        offsets_start = len(self.data) if OFFSETS in self._features else 0
        if OFFSETS in self._features:
            for op, at, length in groups:
                self.add(0x0E, struct.pack("<BQQ", op, at, length))
        footer = struct.pack("<BQQQ", 0x02, 20, start if groups else 0, offsets_start)
        self.data += footer + struct.pack("<I", zlib.crc32(footer, zlib.crc32(self.data[start:]))) + MAGIC
