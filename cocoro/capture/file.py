"""One MCAP file in the making: what is added is in the system's hands after each `flush`, whatever becomes of us."""

from __future__ import annotations

import os
import zlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import msgspec

from cocoro.capture import mcap
from cocoro.capture.compression import Packer
from cocoro.capture.mcap import Op
from cocoro.capture.schema import TypeSchema

PROFILE = "cocoro"
"""In the MCAP header: the conventions of docs/captures.md hold."""
LARGE_BYTES = 64 * 1024
"""A payload from this size on gets a chunk of its own, so that readers of small things can pass it by."""
FULL_BYTES = 512 * 1024
"""A chunk of small messages is closed at this size."""


class KeyTally(msgspec.Struct):
    """What a file has of one key."""

    messages: int = 0
    size_bytes: int = 0
    """Of the payloads."""
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
    """What is being gathered."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.places: dict[int, list[tuple[int, int]]] = defaultdict(list)
        """By channel: log time and offset of each message."""
        self.size_bytes = 0
        self.start_ns = 0
        self.end_ns = 0


class CaptureFile:
    """Append to a new file. Raises OSError when the disk does not take it; the file then ends with its last whole
    record, and can be read. One thread at a time, but for `fileno`."""

    def __init__(self, path: Path, packer: Packer, library: str) -> None:
        """The file must not exist yet."""
        self.path = path
        self.size_bytes = 0
        self.raw_bytes = 0
        """Of the chunks, before compression."""
        self.tallies: dict[str, KeyTally] = {}
        self._packer = packer
        self._fd = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_CLOEXEC, 0o644)
        self._schemas: dict[tuple[str, bytes], mcap.Schema] = {}
        self._channels: dict[str, mcap.Channel] = {}
        self._chunks: list[mcap.ChunkIndex] = []
        self._metadata: list[mcap.MetadataIndex] = []
        self._chunk = _Chunk()
        self._pending: list[bytes] = []
        """Schemas and channels that the next chunk begins with."""
        try:
            self._write([mcap.MAGIC, mcap.header(PROFILE, library)])
        except OSError:
            self.abandon()
            path.unlink()
            raise

    def fileno(self) -> int:
        return self._fd

    def has(self, key: str) -> bool:
        return key in self._channels

    def channel(self, key: str, encoding: str, schema: TypeSchema | None, metadata: Mapping[str, str]) -> None:
        """Make a key known, before its first message."""
        schema_id = 0
        if schema is not None:
            known = self._schemas.get((schema.name, schema.data))
            if known is None:
                known = mcap.Schema(len(self._schemas) + 1, schema.name, schema.encoding, schema.data)
                self._schemas[schema.name, schema.data] = known
                self._pending.append(known.pack())
            schema_id = known.id
        channel = mcap.Channel(len(self._channels) + 1, schema_id, key, encoding, metadata)
        self._channels[key] = channel
        self.tallies[key] = KeyTally()
        self._pending.append(channel.pack())

    def add(self, key: str, sequence: int, log_ns: int, publish_ns: int, payload: bytes) -> None:
        """A message of a key that is known. Log times must not go back."""
        channel_id = self._channels[key].id
        length = mcap.MESSAGE_HEAD.size - mcap.PREFIX.size + len(payload)
        head = mcap.MESSAGE_HEAD.pack(
            Op.MESSAGE, length, channel_id, sequence & 0xFFFFFFFF, log_ns, max(publish_ns, 0) & (1 << 64) - 1
        )
        self.tallies[key].add(log_ns, len(payload))
        if len(payload) >= LARGE_BYTES:
            raw = b"".join((*self._pending, head, payload))
            at = len(raw) - len(head) - len(payload)
            self._pending.clear()
            self._write_chunk(raw, {channel_id: [(log_ns, at)]}, log_ns, log_ns)
            return
        chunk = self._chunk
        if not chunk.parts:
            chunk.start_ns = log_ns
        chunk.end_ns = log_ns
        chunk.parts += self._pending
        chunk.size_bytes += sum(map(len, self._pending))
        self._pending.clear()
        chunk.places[channel_id].append((log_ns, chunk.size_bytes))
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
        """Write a metadata record, with a checksum over it, since MCAP gives it none."""
        packed = mcap.Metadata(name, {**entries, CHECKSUM: checksum(entries)}).pack()
        self._metadata.append(mcap.MetadataIndex(self.size_bytes, len(packed), name))
        self._write([packed])

    def finish(self) -> int:
        """Make the file whole, with its summary. Returns its descriptor, to be synced and closed."""
        self.flush()
        self._write(self._ending())
        return self._fd

    def abandon(self) -> None:
        """Close the file as it is: readable, but without a summary."""
        os.close(self._fd)

    # --- writing ----------------------------------------------------------------------------------

    def _write_chunk(self, raw: bytes, index: Mapping[int, list[tuple[int, int]]], start_ns: int, end_ns: int) -> None:
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
            mcap.ChunkIndex(
                start_ns, end_ns, offset, length, offsets, at - offset - length, name, len(packed), len(raw)
            )
        )
        self.raw_bytes += len(raw)

    def _ending(self) -> list[bytes]:
        end = mcap.data_end()
        start = self.size_bytes + len(end)
        groups: list[tuple[Op, Sequence[Any]]] = [
            (Op.SCHEMA, list(self._schemas.values())),
            (Op.CHANNEL, list(self._channels.values())),
            (Op.STATISTICS, [self._statistics()]),
            (Op.CHUNK_INDEX, self._chunks),
            (Op.METADATA_INDEX, self._metadata),
        ]
        summary, offsets = b"", b""
        for op, items in groups:
            packed = b"".join(item.pack() for item in items)
            if packed:
                offsets += mcap.summary_offset(op, start + len(summary), len(packed))
            summary += packed
        offsets_start = start + len(summary)
        summary += offsets
        return [end, summary, mcap.footer(summary, start, offsets_start), mcap.MAGIC]

    def _statistics(self) -> mcap.Statistics:
        tallies = self.tallies
        busy = [tally for tally in tallies.values() if tally.messages]
        return mcap.Statistics(
            messages=sum(tally.messages for tally in busy),
            schemas=len(self._schemas),
            channels=len(self._channels),
            metadata=len(self._metadata),
            chunks=len(self._chunks),
            start_ns=min((tally.first_ns for tally in busy), default=0),
            end_ns=max((tally.last_ns for tally in busy), default=0),
            by_channel={self._channels[key].id: tally.messages for key, tally in tallies.items()},
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


CHECKSUM = "crc32"
"""The metadata entry with the checksum of the others."""


def checksum(entries: Mapping[str, str]) -> str:
    """Over names and values, sorted by name, each followed by a zero byte."""
    crc = 0
    for name in sorted(entries):
        if name != CHECKSUM:
            crc = zlib.crc32(f"{name}\0{entries[name]}\0".encode(), crc)
    return f"{crc:08x}"
