"""The index of a capture's chunks waits on the disk, and is what the mcap package would write."""

from __future__ import annotations

import errno
import os
import tracemalloc
from pathlib import Path

import pytest
from mcap.records import ChunkIndex

from cocoro.capture.mcap import ChunkHead
from services.capture.chunk_index import WAITING_BYTES, ChunkIndices
from services.capture.file import CaptureFile, packed
from services.capture.packing import Packer

HEAD = ChunkHead(start_ns=1, end_ns=2, raw_bytes=900, crc=7, compression="zstd", packed_bytes=400)
OFFSETS = {3: 5_000, 9: 5_060}


def record(at: int) -> ChunkIndex:
    return ChunkIndex(
        chunk_length=450, chunk_start_offset=at, compression="zstd", compressed_size=400, message_end_time=2,
        message_index_length=120, message_index_offsets=OFFSETS, message_start_time=1, uncompressed_size=900,
    )  # fmt: skip


def add(indices: ChunkIndices, number: int) -> None:
    for at in range(number):
        indices.add(HEAD, at, 450, OFFSETS, 120)


@pytest.mark.parametrize("number", [0, 1, 3_000])
def test_they_are_the_records_of_the_package_in_order(tmp_path: Path, number: int) -> None:
    indices = ChunkIndices(tmp_path)
    add(indices, number)
    assert indices.count == number
    assert indices.all() == b"".join(packed(record(at)) for at in range(number))
    indices.close()


def test_memory_does_not_grow_with_the_capture_and_nothing_stays_beside_it(tmp_path: Path) -> None:
    indices = ChunkIndices(tmp_path)
    add(indices, 2_000)
    tracemalloc.start()
    before = tracemalloc.get_traced_memory()[0]
    add(indices, 20_000)
    grown = tracemalloc.get_traced_memory()[0] - before
    tracemalloc.stop()
    assert grown < 3 * WAITING_BYTES < len(indices.all()) / 8
    assert list(tmp_path.iterdir()) == []
    indices.close()


def test_a_full_disk_loses_none_of_them(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    room = [WAITING_BYTES // 2]
    write = os.pwrite

    def little(fd: int, data: bytes, at: int) -> int:
        if not room[0]:
            raise OSError(errno.ENOSPC, "no space left on device")
        done, room[0] = write(fd, data[: room[0]], at), 0
        return done

    indices = ChunkIndices(tmp_path)
    monkeypatch.setattr(os, "pwrite", little)
    add(indices, 2_000)
    room[0] = 10
    add(indices, 1)
    monkeypatch.setattr(os, "pwrite", write)
    add(indices, 1_000)
    assert indices.all() == b"".join(packed(record(at)) for at in [*range(2_000), 0, *range(1_000)])
    indices.close()


def test_a_file_that_cannot_be_begun_leaves_nothing_open(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_fd: int, _parts: object) -> int:
        raise OSError(errno.ENOSPC, "no space left on device")

    monkeypatch.setattr(os, "writev", full)
    before = len(list(Path("/proc/self/fd").iterdir()))
    with pytest.raises(OSError, match="no space"):
        CaptureFile(tmp_path / "a.mcap", Packer("zstd"))
    assert len(list(Path("/proc/self/fd").iterdir())) == before
    assert list(tmp_path.iterdir()) == []
