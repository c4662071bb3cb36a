"""The index of a capture's chunks, which MCAP wants at the end of the file.

It grows by 90 bytes with each chunk, so by 9 MB an hour with 30 frames a second, and by 70 MB an hour as the
package's objects: a recorder that runs for a day would hold more than a gigabyte of them. So it waits in a file without
a name beside the capture, which is gone when the recorder ends, however it ends.
"""

from __future__ import annotations

import os
import struct
import tempfile
from collections.abc import Mapping
from pathlib import Path

from mcap.opcode import Opcode

from cocoro.capture import mcap

WAITING_BYTES = 64 * 1024
"""So much is gathered in memory before it is written."""


class ChunkIndices:
    """The encoded chunk indices of one capture, in order. Not thread-safe."""

    def __init__(self, folder: Path) -> None:
        """`folder` is the capture's. Raises OSError when the disk refuses a file."""
        self.count = 0
        with tempfile.TemporaryFile(dir=folder) as file:
            self._fd = os.dup(file.fileno())
        self._written = 0
        self._waiting = bytearray()

    def add(self, head: mcap.ChunkHead, at: int, length: int, offsets: Mapping[int, int], index_bytes: int) -> None:
        """Add a chunk's index.

        `at` and `length` are its place in the file, `offsets` the places of its message indices by channel number,
        and `index_bytes` the length of all of these, in bytes.
        """
        self._waiting += chunk_index(head, at, length, offsets, index_bytes)
        self.count += 1
        if len(self._waiting) >= WAITING_BYTES:
            self._write()

    def all(self) -> bytes:
        """All indices, encoded. Raises OSError."""
        parts: list[bytes] = []
        while (at := sum(map(len, parts))) < self._written:
            part = os.pread(self._fd, self._written - at, at)
            if not part:
                raise OSError(f"the index of chunks has lost {self._written - at} bytes")
            parts.append(part)
        return b"".join([*parts, self._waiting])

    def close(self) -> None:
        os.close(self._fd)

    def _write(self) -> None:
        """A disk that is full takes it later: then it waits in memory."""
        try:
            while self._waiting:
                done = os.pwrite(self._fd, self._waiting, self._written)
                self._written += done
                del self._waiting[:done]
        except OSError:
            return


def chunk_index(head: mcap.ChunkHead, at: int, length: int, offsets: Mapping[int, int], index_bytes: int) -> bytes:
    """Encode the record of a chunk's index, with its prefix."""
    name = head.compression.encode()
    places = b"".join(struct.pack("<HQ", channel_id, place) for channel_id, place in offsets.items())
    content = b"".join(
        (
            struct.pack("<QQQQI", head.start_ns, head.end_ns, at, length, len(places)),
            places,
            struct.pack("<QI", index_bytes, len(name)),
            name,
            struct.pack("<QQ", head.packed_bytes, head.raw_bytes),
        )
    )
    return mcap.PREFIX.pack(Opcode.CHUNK_INDEX, len(content)) + content
