"""Finds the contents of an MCAP file: from its summary where that is reliable, otherwise front to back.

A summary is reliable when its checksum (if any) is right, and it lists as many schemas, channels, chunks, attachments
and metadata as its statistics say and the file has. Records between the listed chunks are read one by one. Any other
file is read front to back, which is slower; such a file need not be damaged.

Where the framing of records breaks, reading resumes at the next chunk with a right checksum. The `mcap` package stops
at the first damage.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Footer, MetadataIndex, Statistics

from cocoro.capture import mcap, mcap_reading
from cocoro.capture.contents import Contents, Disk, MessageBlock, compare, read_chunk, read_header
from cocoro.capture.mcap import MAGIC, PREFIX, CutOffError, DamageError
from cocoro.capture.walk import Walk

LARGEST_SUMMARY = 1 << 30
_SEARCHED = 1 << 20
_MARKS = (struct.pack("<I", 4) + b"zstd", struct.pack("<I", 3) + b"lz4", struct.pack("<I", 0))
"""A chunk's compression, as its head encodes it."""
_MARK_AT = PREFIX.size + 28
_MCAPS = frozenset(Opcode)
_FOOTER_DAMAGED = "the file's footer is damaged"


class _UnsureError(Exception):
    """The summary is not complete. The text is empty unless that is damage."""


def contents(disk: Disk) -> Contents:
    """Raises DamageError for a file that is not MCAP."""
    if disk.size == 0:
        raise DamageError("the file is empty")
    if disk.size < len(MAGIC) or disk.read(0, len(MAGIC)) != MAGIC:
        raise DamageError("this is no MCAP file")
    try:
        found = _by_summary(disk)
    except (_UnsureError, DamageError) as reason:
        found = front_to_back(disk)
        if isinstance(reason, _UnsureError) and str(reason):
            found.problems.insert(0, str(reason))
        return found
    compare(found)
    return found


# --- by the summary -------------------------------------------------------------------------------


def _by_summary(disk: Disk) -> Contents:
    """Raises _UnsureError, or DamageError for damage that reading front to back will find as well."""
    found, indices = read_header(disk), []
    summary, summary_start = _summary(disk, found.strict)
    for op, content, _ in mcap.records(summary):
        if op == Opcode.SCHEMA:
            found.add_schema(content)
        elif op == Opcode.CHANNEL:
            found.add_channel(content)
        elif op == Opcode.STATISTICS:
            found.statistics, _ = mcap.parsed(Statistics, content)
        elif op == Opcode.CHUNK_INDEX:
            indices.append(mcap_reading.chunk_index(content))
        elif op == Opcode.METADATA_INDEX:
            index, _ = mcap.parsed(MetadataIndex, content)
            found.metadata_index[index.offset] = index.name
        elif op not in _MCAPS:
            found.unknown[op] += 1
    if found.statistics is None:
        raise _UnsureError
    indices.sort(key=lambda index: index.chunk_start_offset)
    _between_chunks(disk, found, indices, summary_start)
    found.chunks += len(indices)
    found.places += map(_place, indices)
    found.places.sort()
    found.raw_bytes += sum(index.uncompressed_size for index in indices)
    stated = found.statistics
    listed = (
        stated.schema_count,
        stated.channel_count,
        stated.chunk_count,
        stated.attachment_count,
        stated.metadata_count,
    )
    if listed != (len(found.schemas), len(found.channels), found.chunks, len(found.attachments), len(found.metadata)):
        raise _UnsureError
    found.messages.clear()
    if any(place.channels is not None and not place.channels <= found.channels.keys() for place in found.places):
        raise _UnsureError
    found.closed = found.summarised = True
    return found


def _footer(disk: Disk, strict: bool) -> tuple[Footer, int]:
    """Returns the footer and the offset of its record. Raises _UnsureError for a file without footer or summary; in a
    `strict` file a missing summary is damage."""
    if not _ends(disk):
        raise _UnsureError  # never closed, or the footer has unknown fields; neither is damage
    at = disk.size - mcap.FOOTER_LENGTH - len(MAGIC)
    footer, _ = mcap.parsed(Footer, disk.read(at + PREFIX.size, mcap.FOOTER_LENGTH - PREFIX.size))
    if footer.summary_start == 0:
        raise _UnsureError(_FOOTER_DAMAGED if strict else "")
    return footer, at


def _summary(disk: Disk, strict: bool) -> tuple[bytes, int]:
    """Returns the summary section, checked by its checksum, and its offset. A `strict` summary must have a checksum.
    Raises _UnsureError."""
    footer, footer_at = _footer(disk, strict)
    if not len(MAGIC) <= footer.summary_start <= footer_at or footer_at - footer.summary_start > LARGEST_SUMMARY:
        raise _UnsureError(_FOOTER_DAMAGED)
    summary = disk.read(footer.summary_start, footer_at - footer.summary_start)
    if not mcap_reading.checksum_is_right(footer, summary, strict):
        raise _UnsureError("the file's summary is damaged")
    return summary, footer.summary_start


def _summary_is_right(disk: Disk, strict: bool) -> bool:
    try:
        _summary(disk, strict)
    except (_UnsureError, DamageError):
        return False
    return True


def _between_chunks(disk: Disk, found: Contents, indices: list[ChunkIndex], end: int) -> None:
    """Read everything outside of the chunks that the summary lists."""
    walk, at = Walk(disk, found, check=False), len(MAGIC)
    for index in indices:
        if index.message_start_time == index.message_end_time == 0:
            continue  # times of 0 may mean "no messages", so the chunk is read
        walk.through(at, index.chunk_start_offset)
        at = index.chunk_start_offset + index.chunk_length + index.message_index_length
    indices[:] = [index for index in indices if index.message_start_time or index.message_end_time]
    walk.through(at, end)


def _place(index: ChunkIndex) -> MessageBlock:
    channels = frozenset(index.message_index_offsets) or None
    return MessageBlock(
        index.chunk_start_offset, index.chunk_length, index.message_start_time, index.message_end_time, channels,
        indices=index.message_index_offsets or None,
    )  # fmt: skip


# --- from front to back ---------------------------------------------------------------------------


def front_to_back(disk: Disk) -> Contents:
    """Read everything, and keep what is intact."""
    found = _scanned(disk)
    compare(found)
    return found


def _scanned(disk: Disk) -> Contents:
    found = read_header(disk)
    found.closed = _ends(disk)
    walk, at = Walk(disk, found, check=True, sure=_summary_is_right(disk, found.strict)), len(MAGIC)
    while at < disk.size:
        try:
            at = walk.step(at)
        except DamageError as damage:
            start = at if walk.suspect is None else walk.suspect
            after = _search(disk, start + 1, found.strict)
            if after == disk.size and isinstance(damage, CutOffError) and not found.closed:
                found.cut_bytes = disk.size - at
                break
            found.problems.append(f"bytes {start} to {after} are not readable: {damage}")
            walk.jump()
            at = after
    walk.finish()
    return found


def _ends(disk: Disk) -> bool:
    """Whether a footer of the known length ends the file."""
    tail = disk.read(
        max(disk.size - mcap.FOOTER_LENGTH - len(MAGIC), 0), min(disk.size, mcap.FOOTER_LENGTH + len(MAGIC))
    )
    return tail.endswith(MAGIC) and tail.startswith(PREFIX.pack(Opcode.FOOTER, mcap.FOOTER_LENGTH - PREFIX.size))


def _search(disk: Disk, start: int, strict: bool) -> int:
    """The offset of the next intact chunk, or the file's size."""
    overlap = mcap.LONGEST_CHUNK_HEAD + PREFIX.size
    for block_at in range(start, disk.size, _SEARCHED):
        block = disk.read(block_at, min(_SEARCHED + overlap, disk.size - block_at))
        for candidate in _candidates(block):
            at = block_at + candidate
            try:
                read_chunk(disk, at, strict, exactly=True)
            except DamageError:
                continue
            return at
    return disk.size


def _candidates(block: bytes) -> Iterator[int]:
    """Offsets in `block` at which a chunk may begin, in order."""
    places = set()
    for mark in _MARKS:
        at = block.find(mark)
        while at >= 0:
            start = at - _MARK_AT
            if start >= 0 and block[start] == Opcode.CHUNK:
                places.add(start)
            at = block.find(mark, at + 1)
    return iter(sorted(places))
