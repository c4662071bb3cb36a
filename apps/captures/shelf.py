"""The captures on this machine: names in place of their files, what happened in each, and pins.

It reads the ends of files only, so that a list of hundreds of captures takes a fraction of a second.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

import msgspec
from mcap.opcode import Opcode
from mcap.records import Footer, Metadata, MetadataIndex, Statistics, SummaryOffset

from apps.captures.names import LATEST, shelf
from cocoro.capture import mcap
from cocoro.capture.mcap import MAGIC, PREFIX, DamageError
from cocoro.clock import NS
from services.capture.folder import IDLE, captures, is_pinned, parsed_name
from services.capture.occasions import OCCASION, Note, Occasion, occasion_of

_COUNTED = re.compile(r"(?P<name>.+)-(?P<back>\d{1,4})")
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


def listed(robot: str | None = None) -> Iterator[ListedCapture]:
    """The captures of this machine, the newest first, each with what happened in it."""
    for name, path in shelf(robot):
        parsed, ends = parsed_name(path), Ends(path)
        assert parsed is not None
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
        yield capture


def run_until(path: Path) -> list[Path]:
    """The captures of a file's run in its folder, in order, up to it; the file alone when no recorder named it."""
    wanted = parsed_name(path)
    if wanted is None:
        return [path]
    return [
        each
        for each in captures(path.parent, wanted.robot)
        if (name := parsed_name(each)) and name.run == wanted.run and name.number <= wanted.number
    ]


def size_of(path: Path) -> int:
    try:
        return path.stat().st_size
    except OSError:
        return 0


def find(text: str) -> Path:
    """The file of a name: a path, a file's name in the folder of captures, `latest` or `idle`, a task (`fetch`,
    `fetch red_can`), `stop`, `fault` or `motion`, each with `-N` for the Nth before it, or a task's id.

    A path comes first: a text with a folder, with the ending .mcap, or of an MCAP file in the current directory. A text
    that is none of these is returned as a path, so that reading it fails.
    """
    path = Path(text)
    with suppress(OSError, ValueError):
        if path.exists() and not path.is_dir() and (path.parts[:-1] or path.suffix == ".mcap" or _is_mcap(path)):
            return path
    there = shelf()
    for name, found in there:
        if text in (name, found.name):
            return found
    if text == LATEST and there:  # only such in which nothing happened
        return there[0][1]
    if (found_by := _by_label(text, there)) is not None:
        return found_by
    for _, found in there:
        if _label(found) in ("", IDLE):
            continue
        if (occasion := Ends(found).occasion) is not None and text == occasion.task_id:
            return found
    return path


def _is_mcap(path: Path) -> bool:
    if not path.is_file():
        return False
    with path.open("rb") as stream:
        return stream.read(len(MAGIC)) == MAGIC


def _by_label(text: str, there: Sequence[tuple[str, Path]]) -> Path | None:
    """The newest capture of a task, with or without its target."""
    wanted = "-".join(text.split())
    counted = _COUNTED.fullmatch(wanted)
    tries = [(wanted, 0), *([(counted["name"], int(counted["back"]))] if counted else [])]
    for name, back in tries:
        found = [path for _, path in there if name == (label := _label(path)) or label.startswith(f"{name}-")]
        if back < len(found):
            return found[back]
    return None


def _label(path: Path) -> str:
    name = parsed_name(path)
    return "" if name is None else name.label
