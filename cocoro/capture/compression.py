"""How chunks are packed: `zstd`, `lz4` or not at all, as MCAP names them.

Measured on frames of the simulated Kinect, 1.5 MB each, one core (bench/capture.py): zstd at level 1 makes ideal frames
25 times smaller in 1.0 ms and noisy ones 2.1 times in 2.1 ms; lz4 11 times in 0.6 ms and 1.3 times in 0.9 ms.
Both cost less than writing the bytes that they save, so frames are packed too.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, get_args

import lz4.frame
import zstandard

from cocoro.capture.errors import DamageError

Compression = Literal["zstd", "lz4", "none"]
COMPRESSIONS: tuple[Compression, ...] = get_args(Compression)
KNOWN = ("", "zstd", "lz4")
"""As they stand in a chunk."""

LARGEST_CHUNK = 4 << 30
"""Bytes, before compression and after, as the mcap package has it; what claims to be larger is damaged."""
WORTH = 0.95
"""What does not become smaller than this share of itself is stored as it is: then reading it costs nothing."""


QUICK = zstandard.ZstdCompressionParameters.from_level(1, window_log=17, hash_log=12, chain_log=12, min_match=7)
"""Level 1 with a table that fits a processor's nearest memory, and no short matches: for frames 6% less time, and
nothing lost in size."""


class Packer:
    """Packs chunks. Not for use by two threads at once."""

    def __init__(self, compression: Compression, level: int = 1) -> None:
        """`level` is zstd's: 1 is quick, 19 is thorough."""
        self._name = "" if compression == "none" else compression
        self._pack: Callable[[bytes | memoryview], bytes] | None = None
        if compression == "zstd" and level == 1:
            self._pack = zstandard.ZstdCompressor(compression_params=QUICK).compress
        elif compression == "zstd":
            self._pack = zstandard.ZstdCompressor(level=level).compress
        elif compression == "lz4":
            self._pack = lz4.frame.compress

    def pack(self, raw: bytes) -> tuple[str, bytes]:
        """The compression's name in MCAP ('' for none), and the packed bytes."""
        if self._pack is None:
            return "", raw
        packed = self._pack(raw)
        return (self._name, packed) if len(packed) < WORTH * len(raw) else ("", raw)


def unpack(name: str, packed: bytes | memoryview, raw_bytes: int) -> bytes | memoryview:
    """The bytes before compression. Raises DamageError when they cannot be had or are not as many as said."""
    if raw_bytes > LARGEST_CHUNK:
        raise DamageError(f"a chunk claims to have {raw_bytes} bytes")
    try:
        raw = _unpack(name, packed, raw_bytes)
    except (zstandard.ZstdError, RuntimeError, EOFError, MemoryError, ValueError) as error:
        raise DamageError(f"a chunk cannot be unpacked: {error}") from error
    if len(raw) != raw_bytes:
        raise DamageError(f"a chunk has {len(raw)} bytes instead of {raw_bytes}")
    return raw


def _unpack(name: str, packed: bytes | memoryview, raw_bytes: int) -> bytes | memoryview:
    if name == "":
        return packed
    if name == "zstd":
        if zstandard.frame_content_size(packed) not in (-1, raw_bytes):  # before so much memory is asked for
            raise DamageError("a chunk contradicts itself on its size")
        return zstandard.ZstdDecompressor().decompress(packed, max_output_size=raw_bytes)
    if name == "lz4":
        # One byte more than it should have shows that it has too many, and no more of them are made.
        return bytes(lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=raw_bytes + 1))
    raise DamageError(f"a chunk is compressed by {name!r}, which is not known here")
