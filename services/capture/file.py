"""Writes one MCAP file. After each `flush` the operating system has everything that was added.

The file is encoded here because the `mcap` package's writer takes 1.2 times (ideal sensors) to 1.8 times (real
sensors) the processor time, 1.2 to 1.4 times without frames (`python -m bench capture-format files`). It also has
one zstd level and mixes frames with small messages in one chunk.
"""

from __future__ import annotations

import json
import os
import struct
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from cocoro.about import versions
from cocoro.capture import mcap
from cocoro.capture.conventions import CHECKSUM, MAKER, PROFILE, TALLY, KeyTally, checksum, tally_names
from services.capture.chunk_index import ChunkIndices
from services.capture.packing import PackedMessage, Packer, message_head

LIBRARY = f"{MAKER} {versions().get('cocoro-mesh', '')}".strip()
LARGE_BYTES = 64 * 1024
"""A payload of this size or more gets a chunk of its own, so that readers of small messages can skip it."""
FULL_BYTES = 512 * 1024
"""A chunk of small messages is closed at this size."""


class _Chunk:
    """The chunk that is being filled."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.places: dict[int, list[int]] = defaultdict(list)
        """Per channel: log time and offset, alternating, one pair per message."""
        self.size_bytes = 0
        self.start_ns = 0
        self.end_ns = 0
        self.declares = False
        """It has schemas or channels."""


class CaptureFile:
    """Appends to a new file. Methods raise OSError when the disk refuses; the file then ends with its last complete
    record and is readable. Not thread-safe, except `fileno`."""

    def __init__(self, path: Path, packer: Packer, profile: str = PROFILE) -> None:
        """Raises FileExistsError when the file exists."""
        self.path = path
        self.size_bytes = 0
        self.raw_bytes = 0
        """Uncompressed size of the chunks."""
        self.tallies: dict[int, KeyTally] = {}
        """By channel number."""
        self._packer = packer
        self._profile = profile
        self._fd = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o644)
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._metadata: list[MetadataIndex] = []
        self._attached: list[AttachmentIndex] = []
        self._chunk = _Chunk()
        self._pending: list[bytes] = []
        """Schemas and channels to write at the start of the next chunk."""
        try:
            self._chunks = ChunkIndices(path.parent)
            try:
                self._write([mcap.MAGIC, packed(Header(profile, LIBRARY))])
            except OSError:
                self._chunks.close()
                raise
        except OSError:
            os.close(self._fd)
            path.unlink()
            raise

    def fileno(self) -> int:
        return self._fd

    @property
    def attachments(self) -> int:
        """Number of attachments."""
        return len(self._attached)

    def schema(self, schema: Schema) -> None:
        """Declare a schema before its first channel. A known id is ignored."""
        if schema.id not in self._schemas:
            self._schemas[schema.id] = schema
            self._pending.append(packed(schema))

    def channel(self, channel: Channel) -> None:
        """Declare a channel before its first message. A known id is ignored."""
        if channel.id not in self._channels:
            self._channels[channel.id] = channel
            self.tallies[channel.id] = KeyTally()
            self._pending.append(packed(channel))

    def add(self, channel_id: int, sequence: int, log_ns: int, publish_ns: int, payload: bytes) -> None:
        """Add a message of a declared channel. Log times must not decrease."""
        if len(payload) >= LARGE_BYTES:
            self._flush_declarations()
            self._add_packed(self._packer.message(channel_id, sequence, log_ns, publish_ns, payload, self._pending))
            return
        head = message_head(channel_id, sequence, log_ns, publish_ns, len(payload))
        self.tallies[channel_id].add(log_ns, len(payload))
        chunk = self._chunk
        if not chunk.parts:
            chunk.start_ns = log_ns
        chunk.end_ns = log_ns
        self._declare_in(chunk)
        chunk.places[channel_id] += (log_ns, chunk.size_bytes)
        chunk.parts += (head, payload)
        chunk.size_bytes += len(head) + len(payload)
        if chunk.size_bytes >= FULL_BYTES:
            self.flush()

    def add_packed(self, packed: PackedMessage) -> None:
        """Append a message, as `add` does, that the packer has packed already."""
        self._flush_declarations()
        self._add_packed(self._packer.behind(self._pending, packed) if self._pending else packed)

    def _add_packed(self, packed: PackedMessage) -> None:
        """Write a chunk with one message, and before it what was pending."""
        self._pending.clear()
        self.tallies[packed.channel_id].add(packed.log_ns, packed.payload_bytes)
        head = mcap.ChunkHead(
            packed.log_ns, packed.log_ns, packed.raw_bytes, packed.crc, packed.compression, len(packed.data)
        )
        self._write_chunk(head, packed.data, {packed.channel_id: [packed.log_ns, packed.message_at]})

    def _flush_declarations(self) -> None:
        """A message must not come before its channel, which may be in the chunk of small messages."""
        if self._chunk.parts and (self._pending or self._chunk.declares):
            self._declare_in(self._chunk)
            self.flush()

    def _declare_in(self, chunk: _Chunk) -> None:
        if self._pending:
            chunk.parts += self._pending
            chunk.size_bytes += sum(map(len, self._pending))
            chunk.declares = True
            self._pending.clear()

    def flush(self) -> None:
        """Hand everything to the operating system, so that the death of this process loses nothing of it."""
        chunk, self._chunk = self._chunk, _Chunk()
        if chunk.parts:
            raw = b"".join(chunk.parts)
            name, packed = self._packer.pack_small(raw)
            head = mcap.ChunkHead(chunk.start_ns, chunk.end_ns, len(raw), mcap.crc32(raw), name, len(packed))
            self._write_chunk(head, packed, chunk.places)

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record, with a checksum where the file has this project's profile; MCAP itself has none for
        metadata."""
        written = {**entries, CHECKSUM: checksum(entries)} if self._profile == PROFILE else dict(entries)
        record = packed(Metadata(name, written))
        self._metadata.append(MetadataIndex(self.size_bytes, len(record), name))
        self._write([record])

    def attachment(self, found: Attachment) -> None:
        record = packed(found)
        index = AttachmentIndex(
            self.size_bytes, len(record), found.log_time, found.create_time, len(found.data), found.name,
            found.media_type,
        )  # fmt: skip
        self._write([record])
        self._attached.append(index)

    def tally(
        self, dropped: Mapping[str, int], lost: Mapping[str, int], left_out: Mapping[str, int] | None = None
    ) -> None:
        """Write the counts by channel, and the missing messages by key. To be called before `finish`."""
        self.flush()
        names = tally_names(self._channels)
        tallies = {names[channel_id]: msgspec.to_builtins(tally) for channel_id, tally in self.tallies.items()}
        entries = {"keys": json.dumps(tallies), "dropped": json.dumps(dict(dropped)), "lost": json.dumps(dict(lost))}
        if left_out:
            entries["left_out"] = json.dumps(dict(left_out))
        self.metadata(TALLY, entries)

    def finish(self) -> int:
        """Write the summary and footer. Returns the file descriptor, which the caller syncs and closes."""
        self.flush()
        if self._pending:  # channels without messages
            self._write(self._pending)
            self._pending.clear()
        self._write(self._ending())
        self._chunks.close()
        return self._fd

    def abandon(self) -> None:
        """Close the file as it is: readable, but without summary."""
        self._chunks.close()
        os.close(self._fd)

    # --- writing ----------------------------------------------------------------------------------

    def _write_chunk(self, chunk: mcap.ChunkHead, packed: bytes, index: Mapping[int, list[int]]) -> None:
        head = chunk_head(chunk)
        length = len(head) + len(packed)
        offsets, entries, at = {}, [], self.size_bytes + length
        for channel_id, places in index.items():
            offsets[channel_id] = at
            entries.append(message_index(channel_id, places))
            at += len(entries[-1])
        offset = self.size_bytes
        self._write([head, packed, b"".join(entries)])
        self._chunks.add(chunk, offset, length, offsets, at - offset - length)
        self.raw_bytes += chunk.raw_bytes

    def _ending(self) -> list[bytes]:
        end = packed(DataEnd(0))  # no checksum over all data: each chunk has its own
        start = self.size_bytes + len(end)
        sections = [
            (Opcode.SCHEMA, packed(*self._schemas.values())),
            (Opcode.CHANNEL, packed(*self._channels.values())),
            (Opcode.STATISTICS, packed(self._statistics())),
            (Opcode.CHUNK_INDEX, self._chunks.all()),
            (Opcode.ATTACHMENT_INDEX, packed(*self._attached)),
            (Opcode.METADATA_INDEX, packed(*self._metadata)),
        ]
        offsets, at = [], start
        for op, section in sections:
            if section:
                offsets.append(SummaryOffset(op, at, len(section)))
            at += len(section)
        summary = b"".join([*(section for _, section in sections), packed(*offsets)])
        return [end, summary, footer(summary, start, at), mcap.MAGIC]

    def _statistics(self) -> Statistics:
        busy = [tally for tally in self.tallies.values() if tally.messages]
        return Statistics(
            message_count=sum(tally.messages for tally in busy),
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            attachment_count=len(self._attached),
            metadata_count=len(self._metadata),
            chunk_count=self._chunks.count,
            message_start_time=min((tally.first_ns for tally in busy), default=0),
            message_end_time=max((tally.last_ns for tally in busy), default=0),
            channel_message_counts={id: tally.messages for id, tally in self.tallies.items()},
        )

    def _write(self, parts: Sequence[bytes | memoryview]) -> None:
        """Write all parts or none: on an error the file is cut back to its size before."""
        left = [memoryview(part) for part in parts if len(part)]
        try:
            while left:
                written = os.writev(self._fd, left)
                while left and written >= len(left[0]):
                    written -= len(left.pop(0))
                if written:
                    left[0] = left[0][written:]
        except OSError:
            os.ftruncate(self._fd, self.size_bytes)
            os.lseek(self._fd, self.size_bytes, os.SEEK_SET)
            raise
        self.size_bytes += sum(map(len, parts))


def packed(*records: McapRecord) -> bytes:
    """Encode records with their prefixes."""
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return ended(builder)


def ended(builder: RecordBuilder) -> bytes:
    """Returns the bytes that a builder has gathered, and empties it."""
    data: bytes = builder.end()
    return data


def footer(summary: bytes, summary_start: int, offsets_start: int) -> bytes:
    """Encode the footer with the checksum of the whole summary section."""
    return packed(Footer(summary_start, offsets_start, mcap.footer_crc(summary, summary_start, offsets_start)))


def message_index(channel_id: int, entries: Sequence[int]) -> bytes:
    """Encode a channel's message index. `entries` alternates log time and offset in the uncompressed chunk. 9 times as
    fast as the package on indices of 20 messages."""
    content = struct.pack(f"<HI{len(entries)}Q", channel_id, 8 * len(entries), *entries)
    return mcap.PREFIX.pack(Opcode.MESSAGE_INDEX, len(content)) + content


def chunk_head(head: mcap.ChunkHead) -> bytes:
    """Encode a chunk's prefix and head; the packed records follow."""
    name = head.compression.encode()
    fields = mcap.CHUNK_FIELDS.pack(head.start_ns, head.end_ns, head.raw_bytes, head.crc, len(name))
    content = fields + name + mcap.LENGTH.pack(head.packed_bytes)
    return mcap.PREFIX.pack(Opcode.CHUNK, len(content) + head.packed_bytes) + content
