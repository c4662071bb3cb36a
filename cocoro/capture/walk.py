"""Reads a file record by record and adds each record to the file's contents."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from functools import partial
from typing import Any

from mcap.opcode import Opcode
from mcap.records import (
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from cocoro.capture import mcap, mcap_reading
from cocoro.capture.contents import LARGEST_RECORD, Contents, Disk, MessageBlock, unpacked
from cocoro.capture.mcap import MAGIC, PREFIX, CutOffError, DamageError
from cocoro.capture.mcap_reading import KNOWN

RUN_BYTES = 1 << 20
"""A run of messages outside of chunks ends at this size, which bounds a reader's memory."""
HEAD_BYTES = 1 << 16
"""An attachment's head must fit into this."""
_SUMMARY = {
    Opcode.CHUNK_INDEX: ChunkIndex,
    Opcode.ATTACHMENT_INDEX: AttachmentIndex,
    Opcode.SUMMARY_OFFSET: SummaryOffset,
}
"""Records that only locate others."""


class Walk:
    """Adds records to `found`. `step` raises DamageError for a damaged record; what was read before stays."""

    def __init__(self, disk: Disk, found: Contents, check: bool, sure: bool = True) -> None:
        """Walk over a file's records and note them in `found`. With `check`, attachments are read and their checksums
        verified. Unless the caller is `sure` that the summary is undamaged, nothing is taken from it."""
        self.suspect: int | None = None
        """Offset of the first of the records just before this one that no checksum covers: of an unknown kind, or
        longer than its known fields. One of them may have a damaged length. None: no such record."""
        self._disk = disk
        self._found = found
        self._check = check
        self._sure = sure
        self._run_at = 0
        self._run_end = 0
        self._run_times: list[int] = []
        self._run_channels: set[int] = set()
        self._due: dict[int, list[tuple[int, int]]] = {}
        """Log time and offset of each message of the last chunk, by channel, until the channel's index is read."""
        self._kinds: dict[int, Callable[[bytes], int]] = {
            Opcode.SCHEMA: self._schema,
            Opcode.CHANNEL: self._channel,
            Opcode.STATISTICS: self._statistics,
            Opcode.MESSAGE_INDEX: self._message_index,
            Opcode.METADATA_INDEX: self._metadata_index,
            **{op: partial(_taken, kind) for op, kind in _SUMMARY.items()},
        }

    def through(self, start: int, end: int) -> None:
        """Read records from `start` to `end`, where one must begin. Raises DamageError."""
        at = start
        while at < end:
            at = self.step(at)
        if at > end:
            raise DamageError("a record overlaps the next one")
        self.finish()

    def jump(self) -> None:
        """Forget the records before this place, after some were skipped."""
        self.suspect, self._due = None, {}

    def finish(self) -> None:
        """Close the current run of messages outside of chunks."""
        if self._run_times:
            self._found.places.append(
                MessageBlock(
                    self._run_at, self._run_end - self._run_at, min(self._run_times), max(self._run_times),
                    frozenset(self._run_channels), loose=True,
                )
            )  # fmt: skip
            self._run_times, self._run_channels = [], set()

    def step(self, at: int) -> int:
        """Read one record. Returns the next one's offset, or the file's size after the footer. Raises DamageError."""
        op, length = PREFIX.unpack(self._disk.read_cached(at, PREFIX.size))
        end: int = at + PREFIX.size + length
        if end > self._disk.size:
            raise CutOffError("a record is cut off")
        start, taken = at + PREFIX.size, length
        if self._due and op != Opcode.MESSAGE_INDEX:
            self._found.problems.append(f"before byte {at} an index of messages is missing")
            self._due = {}
        if op == Opcode.MESSAGE:
            self._message(at, start, end)
        elif op == Opcode.CHUNK:
            taken = self._chunk(at, start, end)
        elif op == Opcode.ATTACHMENT:
            taken = self._attachment(at, start, end)
        elif op == Opcode.FOOTER:
            end = self._footer(start, end)
        elif op == Opcode.DATA_END:
            taken = self._data_end(at, self._disk.read_cached(start, min(length, HEAD_BYTES)))
        elif op == Opcode.HEADER and at == len(MAGIC):
            taken = mcap.parsed(Header, self._content(start, length))[1]
        elif op == Opcode.METADATA:
            taken = self._found.add_metadata(self._content(start, length), at)
        elif op in self._kinds:
            taken = self._kinds[op](self._content(start, length))
        elif op in (0, Opcode.HEADER):
            raise DamageError(f"a record of kind {op} does not belong there")
        else:
            taken = -1
        if taken == length:
            self.suspect = None
            return end
        if op != Opcode.CHUNK and _is_chunk(self._disk, start, length):
            raise DamageError("a record with the content of a chunk has another kind")
        if self._found.strict:
            self._found.problems.append(f"bytes {at} to {end} are not a record that a recorder writes")
        self.suspect = at if self.suspect is None else self.suspect
        if taken < 0:
            self._found.unknown[op] += 1
        return end

    def _content(self, start: int, length: int) -> bytes:
        if length > LARGEST_RECORD:
            raise DamageError("a record is larger than any can be")
        return self._disk.read_cached(start, length)

    # --- each kind --------------------------------------------------------------------------------

    def _message(self, at: int, start: int, end: int) -> None:
        if self._found.strict:
            raise DamageError("a message does not belong there")
        if end - start < mcap.MESSAGE_FIELDS.size:
            raise DamageError("a message is shorter than its head")
        channel_id, _, log_ns, _ = mcap.MESSAGE_FIELDS.unpack(self._disk.read_cached(start, mcap.MESSAGE_FIELDS.size))
        if at != self._run_end or self._run_end - self._run_at >= RUN_BYTES:
            self.finish()
        if not self._run_times:
            self._run_at = at
        self._run_end = end
        self._found.messages[channel_id] += 1
        self._run_times.append(log_ns)
        self._run_channels.add(channel_id)

    def _chunk(self, at: int, start: int, end: int) -> int:
        record = self._disk.read(start, end - start)
        raw, taken = unpacked(record, self._found.strict)
        index: dict[int, list[tuple[int, int]]] = defaultdict(list)
        times = []
        for op, content, offset in mcap.records(raw):
            if op == Opcode.MESSAGE:
                message = mcap.message(content)
                index[message.channel_id].append((message.log_ns, offset))
                times.append(message.log_ns)
            elif op == Opcode.SCHEMA:
                self._found.add_schema(content)
            elif op == Opcode.CHANNEL:
                self._found.add_channel(content)
        self._found.raw_bytes += len(raw)
        self._found.chunks += 1
        self._found.messages.update({channel: len(entries) for channel, entries in index.items()})
        if times:
            self._found.places.append(MessageBlock(at, end - at, min(times), max(times), frozenset(index)))
        if self._found.strict:
            self._due = index
            head, _ = mcap.ChunkHead.unpack(record)
            if times and (head.start_ns, head.end_ns) != (min(times), max(times)):
                self._found.problems.append(f"the times of the chunk at byte {at} differ from those of its messages")
        return taken

    def _message_index(self, content: bytes) -> int:
        taken = mcap_reading.check_message_index(content)
        if self._found.strict:
            channel, entries = mcap_reading.index_entries(content)
            if sorted(entries) != sorted(self._due.pop(channel, ())):
                place = self._found.places[-1].offset if self._found.places else 0
                self._found.problems.append(f"an index of the chunk at byte {place} differs from its messages")
        return taken

    def _attachment(self, at: int, start: int, end: int) -> int:
        head = self._disk.read_cached(start, min(end - start, HEAD_BYTES))
        index, data_at = mcap_reading.attachment_index(head, at, end - at)
        if self._check:
            try:
                mcap_reading.attachment(self._disk.read(start, end - start), self._found.strict)
            except DamageError as damage:  # the record's length is right, so reading can continue after it
                self._found.problems.append(f"bytes {at} to {end} are not readable: {damage}")
                return data_at + index.data_size + 4
        self._found.attachments.append(index)
        return data_at + index.data_size + 4

    def _schema(self, content: bytes) -> int:
        if self._found.data_end and not self._sure:
            return mcap.parsed(Schema, content)[1]
        return self._found.add_schema(content)

    def _channel(self, content: bytes) -> int:
        if self._found.data_end and not self._sure:
            return mcap.parsed(Channel, content)[1]
        return self._found.add_channel(content)

    def _statistics(self, content: bytes) -> int:
        parsed, taken = mcap.parsed(Statistics, content)
        if self._sure:
            self._found.statistics = parsed
        return taken

    def _metadata_index(self, content: bytes) -> int:
        parsed, taken = mcap.parsed(MetadataIndex, content)
        if self._sure:
            self._found.metadata_index[parsed.offset] = parsed.name
        return taken

    def _data_end(self, at: int, content: bytes) -> int:
        found, taken = mcap.parsed(DataEnd, content)
        self._found.data_end, self._found.data_crc = at, found.data_section_crc
        return taken

    def _footer(self, start: int, end: int) -> int:
        """Read the footer, which only the magic bytes may follow."""
        mcap.parsed(Footer, self._disk.read_cached(start, min(end - start, HEAD_BYTES)))
        if self._disk.read(end, len(MAGIC)) != MAGIC:
            raise DamageError("the file does not end after its footer")
        self._found.closed = True
        after = end + len(MAGIC)
        if after < self._disk.size:
            self._found.problems.append(f"bytes {after} to {self._disk.size} follow the file's end")
        return self._disk.size


def _taken(kind: Any, content: bytes) -> int:
    return mcap.parsed(kind, content)[1]


def _is_chunk(disk: Disk, start: int, length: int) -> bool:
    """Whether a record's content is an intact chunk with a right checksum."""
    try:
        head, _ = mcap.ChunkHead.unpack(disk.read_cached(start, min(length, mcap.LONGEST_CHUNK_HEAD)))
        if head.crc == 0 or head.compression not in KNOWN or head.packed_bytes > length:
            return False
        unpacked(disk.read(start, length), strict=False)
    except DamageError:
        return False
    return True
