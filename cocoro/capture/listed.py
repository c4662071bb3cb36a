"""What is known of a capture from its name and the ends of its file, without its messages.

The ends alone are read, so that a list of hundreds of captures takes a fraction of a second.
"""

from __future__ import annotations

import struct
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import msgspec
from mcap.opcode import Opcode
from mcap.records import Footer, Metadata, MetadataIndex, Statistics, SummaryOffset

from cocoro.capture import mcap
from cocoro.capture.folder import IDLE, CaptureName, is_pinned
from cocoro.capture.mcap import MAGIC, PREFIX, DamageError
from cocoro.capture.occasion import OCCASION, Note, Occasion, occasion_of
from cocoro.clock import NS

_LARGEST_END = 1 << 26
"""The end of a file that is read at most; a larger one is damaged."""


class ListedCapture(msgspec.Struct, kw_only=True):
    """One capture of a list."""

    name: str
    """For commands in place of the file: latest, latest-1, idle, ..."""
    file: str
    size_bytes: int
    pinned: bool
    closed: bool
    """False: it is still being written, or its recorder was killed."""
    robot: str = ""
    began_ns: int = 0
    """Unix time of the first message; 0: unknown."""
    duration_s: float = 0.0
    messages: int = 0
    what: str = ""
    """The task with its target, or another occasion; '' when nothing happened, or the recorder did not tell."""
    task_id: str = ""
    outcome: str = ""
    reason: str = ""
    notes: tuple[Note, ...] = ()
    """Faults, stops and motion."""


class Ends:
    """The facts in a capture's beginning and end, without its messages."""

    def __init__(self, path: Path) -> None:
        self.statistics: Statistics | None = None
        self.occasion: Occasion | None = None
        with suppress(OSError, DamageError, struct.error), path.open("rb") as stream:
            if not self._read_end(stream, path.stat().st_size):
                self._read_beginning(stream)

    @property
    def closed(self) -> bool:
        return self.statistics is not None

    def _read_end(self, stream: BinaryIO, size: int) -> bool:
        length = mcap.FOOTER_LENGTH + len(MAGIC)
        if size < len(MAGIC) + length:
            return False
        stream.seek(size - length)
        end = stream.read(length)
        if end[-len(MAGIC) :] != MAGIC or end[0] != Opcode.FOOTER:
            return False
        footer, _ = mcap.parsed(Footer, end[PREFIX.size : -len(MAGIC)])
        groups = _part(stream, footer.summary_offset_start, size - length)
        for op, content, _ in mcap.records(groups):
            if op != Opcode.SUMMARY_OFFSET:
                continue
            group, _ = mcap.parsed(SummaryOffset, content)
            if group.group_opcode not in (Opcode.STATISTICS, Opcode.METADATA_INDEX):
                continue
            for kind, record, _ in mcap.records(
                _part(stream, group.group_start, group.group_start + group.group_length)
            ):
                if kind == Opcode.STATISTICS:
                    self.statistics, _ = mcap.parsed(Statistics, record)
                else:
                    index, _ = mcap.parsed(MetadataIndex, record)
                    if index.name == OCCASION:
                        self._take(_part(stream, index.offset, index.offset + index.length)[PREFIX.size :])
        return self.closed

    def _read_beginning(self, stream: BinaryIO) -> None:
        """The occasion as it began: a recorder writes it before the first message."""
        stream.seek(len(MAGIC))
        while len(head := stream.read(PREFIX.size)) == PREFIX.size:
            op, length = PREFIX.unpack(head)
            if op not in (Opcode.HEADER, Opcode.METADATA) or length > _LARGEST_END:
                return
            content = stream.read(length)
            if op == Opcode.METADATA:
                self._take(content)

    def _take(self, content: bytes) -> None:
        found, _ = mcap.parsed(Metadata, content)
        if found.name == OCCASION:
            self.occasion = occasion_of({name: text for name, text in found.metadata.items() if name != "crc32"})


def _part(stream: BinaryIO, start: int, end: int) -> bytes:
    if not 0 <= end - start <= _LARGEST_END:
        raise DamageError("the end of the file is damaged")
    stream.seek(start)
    return stream.read(end - start)


def listed_capture(name: str, path: Path, parsed: CaptureName) -> ListedCapture:
    """The facts of one file; `name` is what commands call it, `parsed` the parts of its file's name."""
    ends = Ends(path)
    capture = ListedCapture(
        name=name, file=str(path), size_bytes=size_of(path), pinned=is_pinned(path), closed=ends.closed,
        robot=parsed.robot,
    )  # fmt: skip
    if (stated := ends.statistics) is not None:
        capture.began_ns, capture.messages = stated.message_start_time, stated.message_count
        capture.duration_s = (stated.message_end_time - stated.message_start_time) / NS
    if (occasion := ends.occasion) is not None:
        capture.what, capture.task_id, capture.outcome = occasion.what, occasion.task_id, occasion.outcome
        capture.reason, capture.notes = occasion.reason, occasion.notes
    capture.what = capture.what or ("" if parsed.label == IDLE else parsed.label)
    return capture


def size_of(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0
