"""One MCAP file in the making: what is added is in the system's hands after each `flush`, whatever becomes of us.

By hand, because the package's writer has one level of zstd, puts frames and small messages into the same chunks, and
makes records as slowly as `cocoro.capture.mcap` says: a robot's messages take it 1.2 times as long with ideal sensors,
1.8 times with noisy ones (`python bench/capture_format.py files`).

A frame is copied once, to stand behind its message's head in one piece of memory, so writing 1.54 MB takes up to 3.08
MB more at the peak, with the packed bytes. That pays: joined and packed at once, a frame takes 1.46 ms (2.81 ms with
noisy sensors), and 1.76 ms (3.29 ms) when zstd is given head and payload one after the other
(`python bench/capture_format.py records`).
"""

from __future__ import annotations

import json
import os
import zlib
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path

import msgspec
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
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
from cocoro.capture.compression import Packer

PROFILE = "cocoro"
"""In the MCAP header: the conventions of docs/captures.md hold."""
MAKER = "cocoro"
"""The header's library begins with this in files that were written here."""
LIBRARY = f"{MAKER} {versions().get('cocoro-mesh', '')}".strip()
LARGE_BYTES = 64 * 1024
"""A payload from this size on gets a chunk of its own, so that readers of small things can pass it by."""
FULL_BYTES = 512 * 1024
"""A chunk of small messages is closed at this size."""


class KeyTally(msgspec.Struct):
    """Counts of one channel of a file."""

    messages: int = 0
    size_bytes: int = 0
    """Size of the payloads."""
    first_ns: int = 0
    last_ns: int = 0
    """Log times."""
    longest_gap_ns: int = 0
    """Between two messages' log times."""
    longest_gap_from_ns: int = 0

    def add(self, log_ns: int, size_bytes: int) -> None:
        if not self.messages:
            self.first_ns = log_ns
        elif log_ns - self.last_ns > self.longest_gap_ns:
            self.longest_gap_ns, self.longest_gap_from_ns = log_ns - self.last_ns, self.last_ns
        self.last_ns = log_ns
        self.messages += 1
        self.size_bytes += size_bytes


class _Chunk:
    """A chunk that is being gathered."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.places: dict[int, list[int]] = defaultdict(list)
        """By channel: log time and offset of one message after another."""
        self.size_bytes = 0
        self.start_ns = 0
        self.end_ns = 0


class CaptureFile:
    """Append to a new file. Raises OSError when the disk does not take it; the file then ends with its last whole
    record, and can be read. One thread at a time, but for `fileno`."""

    def __init__(self, path: Path, packer: Packer, profile: str = PROFILE) -> None:
        """The file must not exist yet."""
        self.path = path
        self.size_bytes = 0
        self.raw_bytes = 0
        """Size of the chunks before compression."""
        self.tallies: dict[int, KeyTally] = {}
        """By channel."""
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
        """Schemas and channels that the next chunk begins with."""
        try:
            self._write([mcap.MAGIC, mcap.packed(Header(profile, LIBRARY))])
        except OSError:
            self.abandon()
            path.unlink()
            raise

    def fileno(self) -> int:
        return self._fd

    @property
    def attachments(self) -> int:
        """How many it has."""
        return len(self._attached)

    def schema(self, schema: Schema) -> None:
        """Make a schema known, before its first channel. One of an id that is known already is passed by."""
        if schema.id not in self._schemas:
            self._schemas[schema.id] = schema
            self._pending.append(mcap.packed(schema))

    def channel(self, channel: Channel) -> None:
        """Make a channel known, before its first message. One of an id that is known already is passed by."""
        if channel.id not in self._channels:
            self._channels[channel.id] = channel
            self.tallies[channel.id] = KeyTally()
            self._pending.append(mcap.packed(channel))

    def add(self, channel_id: int, sequence: int, log_ns: int, publish_ns: int, payload: bytes) -> None:
        """A message of a channel that is known. Log times must not go back."""
        head = mcap.message_head(
            channel_id, sequence & 0xFFFFFFFF, log_ns, max(publish_ns, 0) & (1 << 64) - 1, len(payload)
        )
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
        """Give everything to the system: the death of this process loses nothing of it."""
        chunk, self._chunk = self._chunk, _Chunk()
        if chunk.parts:
            self._write_chunk(b"".join(chunk.parts), chunk.places, chunk.start_ns, chunk.end_ns)

    def metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record; by this project's conventions with a checksum over it, since MCAP gives it none."""
        told = {**entries, CHECKSUM: checksum(entries)} if self._profile == PROFILE else dict(entries)
        packed = mcap.packed(Metadata(name, told))
        self._metadata.append(MetadataIndex(self.size_bytes, len(packed), name))
        self._write([packed])

    def attachment(self, found: Attachment) -> None:
        packed = mcap.packed(found)
        index = AttachmentIndex(
            self.size_bytes, len(packed), found.log_time, found.create_time, len(found.data), found.name,
            found.media_type,
        )  # fmt: skip
        self._write([packed])
        self._attached.append(index)

    def tally(self, dropped: Mapping[str, int], lost: Mapping[str, int]) -> None:
        """Write what there is of each key, and what by key is missing; before `finish`."""
        self.flush()
        names = tally_names(self._channels)
        told = {names[channel_id]: msgspec.to_builtins(tally) for channel_id, tally in self.tallies.items()}
        entries = {"keys": json.dumps(told), "dropped": json.dumps(dict(dropped)), "lost": json.dumps(dict(lost))}
        self.metadata(TALLY, entries)

    def finish(self) -> int:
        """Make the file whole, with its summary. Returns its descriptor, to be synced and closed."""
        self.flush()
        if self._pending:  # of channels that have no messages
            self._write(self._pending)
            self._pending.clear()
        self._write(self._ending())
        return self._fd

    def abandon(self) -> None:
        """Close the file as it is: readable, but without a summary."""
        os.close(self._fd)

    # --- writing ----------------------------------------------------------------------------------

    def _write_chunk(self, raw: bytes, index: Mapping[int, list[int]], start_ns: int, end_ns: int) -> None:
        name, packed = self._packer.pack(raw)
        head = mcap.ChunkHead(start_ns, end_ns, len(raw), zlib.crc32(raw), name, len(packed)).pack()
        length = len(head) + len(packed)
        offsets, entries, at = {}, [], self.size_bytes + length
        for channel_id, places in index.items():
            offsets[channel_id] = at
            entries.append(mcap.message_index(channel_id, places))
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
        end = mcap.packed(DataEnd(0))  # without a checksum over all the data: each chunk has its own
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
        summary = mcap.ended(builder) + mcap.packed(*offsets)
        return [end, summary, mcap.footer(summary, start, offsets_start), mcap.MAGIC]

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
        """All of it, or none: what the disk took of it before it refused is taken back."""
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


TALLY = "tally"
"""The metadata record that a whole file ends with: what it has of each key, and what is missing."""


def tally_names(channels: Mapping[int, Channel]) -> dict[int, str]:
    """The name of each channel in the tally, by its number: its key, or KEY#NUMBER where a key has several."""
    counts = Counter(channel.topic for channel in channels.values())
    return {
        id: channel.topic if counts[channel.topic] == 1 else f"{channel.topic}#{id}" for id, channel in channels.items()
    }


CHECKSUM = "crc32"
"""The metadata entry with the checksum of the others."""


def checksum(entries: Mapping[str, str]) -> str:
    """Over names and values, sorted by name, each followed by a zero byte."""
    crc = 0
    for name in sorted(entries):
        if name != CHECKSUM:
            crc = zlib.crc32(f"{name}\0{entries[name]}\0".encode(), crc)
    return f"{crc:08x}"
