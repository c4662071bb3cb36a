"""Takes the messages of a few channels from a chunk by its message indices, without looking at the others.

A chunk of 0.1 s has some 80 messages. To look at each of them takes longer than to unpack the chunk.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator, Mapping

from mcap.opcode import Opcode

from cocoro.capture import mcap
from cocoro.capture.contents import Disk, MessageBlock, read_block
from cocoro.capture.mcap import MESSAGE_FIELDS, MESSAGE_HEAD, PREFIX, DamageError

Payload = tuple[int, int, memoryview]
"""Channel, log time, and payload."""
_INDEX_HEAD = struct.Struct("<BQHI")
_ENTRY = struct.Struct("<QQ")
_NEAR_BYTES = _INDEX_HEAD.size + 32 * _ENTRY.size
"""Of an index these are read at once; most are shorter."""


class _UnsureError(Exception):
    """An index does not fit its chunk."""


def payloads(
    disk: Disk, place: MessageBlock, channels: Collection[int], strict: bool, by_index: bool
) -> Iterator[Payload]:
    """The messages of these channels in a block, in the order of the file, or by channels. Raises DamageError, after
    those before the damage."""
    raw = memoryview(read_block(disk, place, strict))
    if by_index and place.indices is not None:
        try:
            found = [each for channel in channels for each in _indexed(disk, place.indices, raw, channel)]
        except (_UnsureError, DamageError):  # read it without
            pass
        else:
            yield from found
            return
    yield from mcap.payloads(raw, channels)


def _indexed(disk: Disk, indices: Mapping[int, int], raw: memoryview, channel: int) -> Iterator[Payload]:
    at = indices.get(channel)
    if at is None:
        return
    record = disk.read(at, min(_NEAR_BYTES, disk.size - at))
    if len(record) < _INDEX_HEAD.size:
        raise _UnsureError
    op, _, of, length = _INDEX_HEAD.unpack_from(record)
    if op != Opcode.MESSAGE_INDEX or of != channel or length % _ENTRY.size:
        raise _UnsureError
    end = _INDEX_HEAD.size + length
    if len(record) < end:
        record = disk.read(at, end)
    last = len(raw) - MESSAGE_HEAD.size
    for stated_ns, offset in _ENTRY.iter_unpack(record[_INDEX_HEAD.size : end]):
        if offset > last:
            raise _UnsureError
        kind, size, owner, _, log_ns, _ = MESSAGE_HEAD.unpack_from(raw, offset)
        stop = offset + PREFIX.size + size
        if kind != Opcode.MESSAGE or owner != channel or log_ns != stated_ns or size < MESSAGE_FIELDS.size:
            raise _UnsureError
        if stop > len(raw):
            raise _UnsureError
        yield channel, log_ns, raw[offset + MESSAGE_HEAD.size : stop]
