"""Packs messages as they are in a capture.

A frame is copied once, behind its message's head, so writing 1.54 MB needs up to 3.08 MB more memory at the peak,
packed bytes included. In return a frame that is joined and packed as one piece takes 1.74 ms (3.26 ms with noisy
sensors), against 1.99 ms (3.71 ms) when zstd gets head and payload one after the other (`python -m
bench capture-format records`).

Compression is measured on frames of the simulated Kinect, 1.5 MB each, on one core (`python -m bench capture
frames`): zstd at level 1 makes ideal frames 25 times smaller in 1.0 ms and noisy ones 2.1 times in 2.1 ms; lz4 11
times in 0.6 ms and 1.3 times in 0.9 ms. Both cost less than writing the bytes that they save.
"""

from __future__ import annotations

import zlib
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
SMALL_LEVEL = 3
"""zstd level of small messages at least. It makes those of 0.1 s 8% smaller than QUICK, for 0.01% of a core."""


_Pack = Callable[[bytes | memoryview], bytes]


class Packer:
    """Compresses chunks. Not thread-safe."""

    def __init__(self, compression: Compression, level: int = 1) -> None:
        """`level` is the zstd level: 1 is fast, 19 thorough."""
        self._name = "" if compression == "none" else compression
        self._pack: _Pack | None = None
        self._pack_small: _Pack | None = None
        if compression == "zstd":
            quick = {"compression_params": QUICK} if level == 1 else {"level": level}
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
        head = message_head(channel_id, sequence, log_ns, publish_ns, len(payload))
        raw = b"".join((*before, head, payload))
        return PackedMessage(channel_id, log_ns, len(payload), len(raw), zlib.crc32(raw), *self.pack(raw))

    def behind(self, before: Sequence[bytes], packed: PackedMessage) -> PackedMessage:
        """Pack a chunk again with the records `before` in front of it."""
        raw = b"".join((*before, _unpacked(packed.compression, packed.data)))
        return PackedMessage(*packed[:3], len(raw), zlib.crc32(raw), *self.pack(raw))


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
