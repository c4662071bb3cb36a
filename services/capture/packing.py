"""Packs messages as they are in a capture.

A large payload is packed where it is, and its message's head is put before it afterwards (`behind_start`). To join both
first takes a frame's size in memory, and some more time (`python -m bench capture-format records`).

Compression is measured on frames of the simulated Kinect, 1.5 MB each, on one core (`python -m bench capture
frames`): zstd at level 1 makes ideal frames 25 times smaller in 1.0 ms and noisy ones 2.1 times in 2.1 ms; lz4 11
times in 0.6 ms and 1.3 times in 0.9 ms. docs/captures.md compares recorders with each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple, get_args

import lz4.frame
import zstandard
from mcap.opcode import Opcode

from cocoro.capture import mcap

Compression = Literal["zstd", "lz4", "none"]
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)
WORTH = 0.95
"""A chunk that does not shrink to this share of its size is stored uncompressed, so that reading it is free."""
QUICK = zstandard.ZstdCompressionParameters.from_level(1, window_log=17, hash_log=12, chain_log=12, min_match=7)
"""zstd level 1 with a table that fits the level 1 cache, and without short matches: 6% less time for frames at the
same size."""
QUICKEST = zstandard.ZstdCompressionParameters.from_level(
    1, window_log=17, hash_log=12, chain_log=12, min_match=7, target_length=1
)
"""Level 0 here: as QUICK, but bytes that repeat nowhere are stored as they are, such as those of a noisy picture."""
SMALL_LEVEL = 3
"""zstd level of small messages at least. It makes those of 0.1 s 8% smaller than QUICK, for 0.01% of a core."""


_Pack = Callable[[bytes | memoryview], bytes]


class Packer:
    """Compresses chunks. Not thread-safe."""

    def __init__(self, compression: Compression, level: int = 1) -> None:
        """`level` is the zstd level: 0 is fastest, 1 fast, 19 thorough."""
        self._name = "" if compression == "none" else compression
        self._pack: _Pack | None = None
        self._pack_small: _Pack | None = None
        if compression == "zstd":
            quick = {"compression_params": QUICK if level else QUICKEST} if level <= 1 else {"level": level}
            self._pack = zstandard.ZstdCompressor(**quick).compress
            self._pack_small = zstandard.ZstdCompressor(level=max(level, SMALL_LEVEL)).compress
        elif compression == "lz4":
            self._pack = self._pack_small = lz4.frame.compress

    def pack(self, raw: bytes) -> tuple[str, bytes]:
        """Returns the compression's name in MCAP ('' for none) and the compressed bytes."""
        return self._by(self._pack, raw)

    def pack_small(self, raw: bytes) -> tuple[str, bytes]:
        """Compress small messages as `pack` does others."""
        return self._by(self._pack_small, raw)

    def _by(self, pack: _Pack | None, raw: bytes) -> tuple[str, bytes]:
        if pack is None:
            return "", raw
        packed = pack(raw)
        return (self._name, packed) if len(packed) < WORTH * len(raw) else ("", raw)

    def message(
        self, channel_id: int, sequence: int, log_ns: int, publish_ns: int, payload: bytes, before: Sequence[bytes] = ()
    ) -> PackedMessage:
        """A message as a chunk of its own, behind the records `before`."""
        start = b"".join((*before, message_head(channel_id, sequence, log_ns, publish_ns, len(payload))))
        raw_bytes, crc = len(start) + len(payload), mcap.crc32(payload, mcap.crc32(start))
        return PackedMessage(channel_id, log_ns, len(payload), raw_bytes, crc, *self._pack_behind(start, payload))

    def _pack_behind(self, start: bytes, payload: bytes) -> tuple[str, bytes]:
        """Compress `start` and a large payload as one piece."""
        if self._name == "zstd":
            name, packed = self.pack(payload)
            if not name:
                return name, b"".join((start, payload))
            if whole := behind_start(start, packed):
                return name, whole
        return self.pack(b"".join((start, payload)))

    def behind(self, before: Sequence[bytes], packed: PackedMessage) -> PackedMessage:
        """Pack a chunk again with the records `before` in front of it."""
        raw = b"".join((*before, _unpacked(packed.compression, packed.data)))
        return PackedMessage(*packed[:3], len(raw), mcap.crc32(raw), *self.pack(raw))


class PackedMessage(NamedTuple):
    """A message as a chunk of its own, for any file in which its channel has this number."""

    channel_id: int
    log_ns: int
    payload_bytes: int
    raw_bytes: int
    crc: int
    compression: str
    data: bytes

    @property
    def message_at(self) -> int:
        """Offset of the message in the uncompressed chunk."""
        return self.raw_bytes - mcap.MESSAGE_HEAD.size - self.payload_bytes


_HEADER_BYTES = {0x80: 10, 0xA0: 9}
"""Length of a zstd frame's header by its descriptor (the fifth byte), of those that end with a content size of 4 bytes
and have no checksum at the end: with a window, and without, where the window is the content."""
_LONGEST_START = 1 << 15
"""Bytes; a block may be as long as the window."""


def behind_start(start: bytes, frame: bytes) -> bytes:
    """The zstd frame of `start` and the content of `frame` after it, without packing that again: `start` becomes a
    block that is not compressed (RFC 8878, 3.1.1). Matches are distances back, so those of the later blocks stay right.

    Returns b"" for a frame whose header has another form than zstd writes for large payloads, or a long start.
    """
    header_bytes = _HEADER_BYTES.get(frame[4])
    if header_bytes is None or len(start) > _LONGEST_START:
        return b""
    size_at = header_bytes - 4
    content_bytes = int.from_bytes(frame[size_at:header_bytes], "little") + len(start)
    block_head = (len(start) << 3).to_bytes(3, "little")  # neither the last block, nor compressed
    rest = memoryview(frame)[header_bytes:]
    return b"".join((frame[:size_at], content_bytes.to_bytes(4, "little"), block_head, start, rest))


def _unpacked(compression: str, data: bytes) -> bytes:
    if not compression:
        return data
    unpack = zstandard.ZstdDecompressor().decompress if compression == "zstd" else lz4.frame.decompress
    raw: bytes = unpack(data)
    return raw


def message_head(channel_id: int, sequence: int, log_ns: int, publish_ns: int, payload_bytes: int) -> bytes:
    """Encode a message's prefix and fields; the payload follows. About 4 times as fast as the package on messages of
    220 bytes."""
    length = mcap.MESSAGE_FIELDS.size + payload_bytes
    sequence, publish_ns = sequence & 0xFFFFFFFF, max(publish_ns, 0) & (1 << 64) - 1
    return mcap.MESSAGE_HEAD.pack(Opcode.MESSAGE, length, channel_id, sequence, log_ns, publish_ns)
