"""Writes one MCAP file. After each `flush` the operating system has everything that was added.

The file is encoded here because the `mcap` package's writer takes 1.2 times (ideal sensors) to 1.8 times (real
sensors) the processor time, 1.2 to 1.4 times without frames (`python bench/capture_format.py files`). It also has
one zstd level and mixes frames with small messages in one chunk.

A frame is copied once, behind its message's head, so writing 1.54 MB needs up to 3.08 MB more memory at the peak,
packed bytes included. In return a frame that is joined and packed as one piece takes 1.74 ms (3.26 ms with noisy
sensors), against 1.99 ms (3.71 ms) when zstd gets head and payload one after the other (`python
bench/capture_format.py records`).

Compression is measured on frames of the simulated Kinect, 1.5 MB each, on one core (`python bench/capture.py
frames`): zstd at level 1 makes ideal frames 25 times smaller in 1.0 ms and noisy ones 2.1 times in 2.1 ms; lz4 11
times in 0.6 ms and 1.3 times in 0.9 ms. Both cost less than writing the bytes that they save.
"""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Literal, get_args

import lz4.frame
import msgspec
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
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

Compression = Literal["zstd", "lz4", "none"]
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)
WORTH = 0.95
"""A chunk that does not shrink to this share of its size is stored uncompressed, so that reading it is free."""
QUICK = zstandard.ZstdCompressionParameters.from_level(1, window_log=17, hash_log=12, chain_log=12, min_match=7)
"""zstd level 1 with a table that fits the level 1 cache, and without short matches: 6% less time for frames at the
same size."""


class Packer:
    """Compresses chunks. Not thread-safe."""

    def __init__(self, compression: Compression, level: int = 1) -> None:
        """`level` is the zstd level: 1 is fast, 19 thorough."""
        self._name = "" if compression == "none" else compression
        self._pack: Callable[[bytes | memoryview], bytes] | None = None
        if compression == "zstd" and level == 1:
            self._pack = zstandard.ZstdCompressor(compression_params=QUICK).compress
        elif compression == "zstd":
            self._pack = zstandard.ZstdCompressor(level=level).compress
        elif compression == "lz4":
            self._pack = lz4.frame.compress

    def pack(self, raw: bytes) -> tuple[str, bytes]:
        """Returns the compression's name in MCAP ('' for none) and the compressed bytes."""
        if self._pack is None:
            return "", raw
        packed = self._pack(raw)
        return (self._name, packed) if len(packed) < WORTH * len(raw) else ("", raw)


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
        self._chunks: list[ChunkIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._attached: list[AttachmentIndex] = []
        self._chunk = _Chunk()
        self._pending: list[bytes] = []
        """Schemas and channels to write at the start of the next chunk."""
        try:
            self._write([mcap.MAGIC, packed(Header(profile, LIBRARY))])
        except OSError:
            self.abandon()
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
        head = message_head(channel_id, sequence & 0xFFFFFFFF, log_ns, max(publish_ns, 0) & (1 << 64) - 1, len(payload))
        self.tallies[channel_id].add(log_ns, len(payload))
        if len(payload) >= LARGE_BYTES:
            raw = b"".join((*self._pending, head, payload))
            at = len(raw) - len(head) - len(payload)
            self._pending.clear()
            self._write_chunk(raw, {channel_id: [log_ns, at]}, log_ns, log_ns)
            return
        chunk = self._chunk
        if not chunk.parts:
            chunk.start_ns = log_ns
        chunk.end_ns = log_ns
        chunk.parts += self._pending
        chunk.size_bytes += sum(map(len, self._pending))
        self._pending.clear()
        chunk.places[channel_id] += (log_ns, chunk.size_bytes)
        chunk.parts += (head, payload)
        chunk.size_bytes += len(head) + len(payload)
        if chunk.size_bytes >= FULL_BYTES:
            self.flush()

    def flush(self) -> None:
        """Hand everything to the operating system, so that the death of this process loses nothing of it."""
        chunk, self._chunk = self._chunk, _Chunk()
        if chunk.parts:
            self._write_chunk(b"".join(chunk.parts), chunk.places, chunk.start_ns, chunk.end_ns)

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
        return self._fd

    def abandon(self) -> None:
        """Close the file as it is: readable, but without summary."""
        os.close(self._fd)

    # --- writing ----------------------------------------------------------------------------------

    def _write_chunk(self, raw: bytes, index: Mapping[int, list[int]], start_ns: int, end_ns: int) -> None:
        name, packed = self._packer.pack(raw)
        head = chunk_head(mcap.ChunkHead(start_ns, end_ns, len(raw), zlib.crc32(raw), name, len(packed)))
        length = len(head) + len(packed)
        offsets, entries, at = {}, [], self.size_bytes + length
        for channel_id, places in index.items():
            offsets[channel_id] = at
            entries.append(message_index(channel_id, places))
            at += len(entries[-1])
        offset = self.size_bytes
        self._write([head, packed, b"".join(entries)])
        self._chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=offset,
                compression=name,
                compressed_size=len(packed),
                message_end_time=end_ns,
                message_index_length=at - offset - length,
                message_index_offsets=offsets,
                message_start_time=start_ns,
                uncompressed_size=len(raw),
            )
        )
        self.raw_bytes += len(raw)

    def _ending(self) -> list[bytes]:
        end = packed(DataEnd(0))  # no checksum over all data: each chunk has its own
        start = self.size_bytes + len(end)
        groups: list[tuple[Opcode, Sequence[McapRecord]]] = [
            (Opcode.SCHEMA, list(self._schemas.values())),
            (Opcode.CHANNEL, list(self._channels.values())),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._chunks),
            (Opcode.ATTACHMENT_INDEX, self._attached),
            (Opcode.METADATA_INDEX, self._metadata),
        ]
        builder, offsets = RecordBuilder(), []
        for op, records in groups:
            before = builder.count
            for record in records:
                record.write(builder)
            if records:
                offsets.append(SummaryOffset(op, start + before, builder.count - before))
        offsets_start = start + builder.count
        summary = ended(builder) + packed(*offsets)
        return [end, summary, footer(summary, start, offsets_start), mcap.MAGIC]

    def _statistics(self) -> Statistics:
        busy = [tally for tally in self.tallies.values() if tally.messages]
        return Statistics(
            message_count=sum(tally.messages for tally in busy),
            schema_count=len(self._schemas),
            channel_count=len(self._channels),
            attachment_count=len(self._attached),
            metadata_count=len(self._metadata),
            chunk_count=len(self._chunks),
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


def message_head(channel_id: int, sequence: int, log_ns: int, publish_ns: int, payload_bytes: int) -> bytes:
    """Encode a message's prefix and fields; the payload follows. About 4 times as fast as the package on messages of
    220 bytes."""
    length = mcap.MESSAGE_FIELDS.size + payload_bytes
    return mcap.MESSAGE_HEAD.pack(Opcode.MESSAGE, length, channel_id, sequence, log_ns, publish_ns)


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
