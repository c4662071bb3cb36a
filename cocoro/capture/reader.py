"""Reads captures, also damaged and unfinished ones, and MCAP files of other programs.

    with Capture.open(path) as capture:
        for record in capture.messages("base/state", "kinect/frame"):
            print(record.log_ns, record.key, capture.decode(record))

Channels are identified by number: a key may have several. `capture.problems` lists the unreadable parts so far.

The `mcap` package's readers stop at the first damage, know channels only from the summary, and copy every payload. They
take 1.0 to 1.4 times as long for frames, 1.5 to 2.0 times for small messages (`python -m bench capture-format files`).
"""

from __future__ import annotations

import heapq
import json
import os
import stat
from collections import Counter
from collections.abc import Collection, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from errno import ENOENT
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import msgspec
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Schema, Statistics

from cocoro.capture import bulk, mcap, mcap_reading
from cocoro.capture.ahead import Raw, read_ahead
from cocoro.capture.contents import Contents, Disk, MessageBlock, miscounted
from cocoro.capture.conventions import CHECKSUM, LEFT_OUT, TALLY, CaptureError, NotAFileError, checksum
from cocoro.capture.mcap import DamageError
from cocoro.capture.scan import contents, front_to_back
from cocoro.capture.types import JSON, MSGPACK, NotReadableError, reader_of
from cocoro.keys import matches

MOST_PROBLEMS = 20
"""Further problems are counted, not listed."""


class Record(NamedTuple):
    """A recorded message."""

    key: str
    log_ns: int
    publish_ns: int
    sequence: int
    payload: memoryview
    channel: int
    """The channel's number in the file."""


class Capture:
    """An open capture file. `open` makes one; close it, or use it in a `with` statement."""

    def __init__(self, path: Path, fd: int) -> None:
        self.path = path
        self._fd = fd
        try:
            self._disk = Disk(fd)
            self._contents: Contents = contents(self._disk)
        except DamageError as damage:
            os.close(fd)
            raise CaptureError(f"{path}: {damage}") from damage
        except OSError as error:
            os.close(fd)
            raise CaptureError(f"{path} cannot be read: {error.strerror}") from error
        self._problems = list(self._contents.problems)
        self._not_listed = 0

    @classmethod
    def open(cls, path: Path) -> Capture:
        """Raises CaptureError when the file cannot be read or is not MCAP, NotAFileError for a pipe or a device."""
        try:
            mode = path.stat().st_mode
            if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):  # opening a device may block
                raise NotAFileError(f"{path} is {_kind(mode)} and no file; copy its output into a file, and name that")
            fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError as error:
            hint = "" if path.suffix or error.errno != ENOENT else "; `cocoro capture list` shows those with a name"
            raise CaptureError(f"{path} cannot be read: {error.strerror}{hint}") from error
        return cls(path, fd)

    # --- what it is -------------------------------------------------------------------------------

    @property
    def whole(self) -> bool:
        """The file was closed by its writer, and no damage has been found so far."""
        return self._contents.closed and not self._problems

    @property
    def closed(self) -> bool:
        """The file has its footer, which a recorder that was killed or is still running leaves out."""
        return self._contents.closed

    @property
    def summarised(self) -> bool:
        """The contents come from the file's summary, so not all of it has been read."""
        return self._contents.summarised

    @property
    def follows_conventions(self) -> bool:
        """The file follows the conventions of docs/captures.md, as its profile says."""
        return self._contents.follows_conventions

    @property
    def profile(self) -> str:
        return self._contents.profile

    @property
    def ending(self) -> str:
        """The reason, in words, for which the capture may be shorter than the run; '' for a closed file."""
        if self.closed:
            return ""
        cut = f" (the last record is cut off after {self.cut_bytes} bytes)" if self.cut_bytes else ""
        return f"not closed: it is still being written, or its recorder was killed or ran out of room{cut}"

    @property
    def cut_bytes(self) -> int:
        """Bytes of an unfinished last record."""
        return self._contents.cut_bytes

    @property
    def problems(self) -> list[str]:
        """Unreadable parts and wrong counts so far, in words."""
        more = [f"and {self._not_listed} more problems"] if self._not_listed else []
        return [*self._problems, *more]

    @property
    def size_bytes(self) -> int:
        return self._disk.size

    @property
    def notes(self) -> list[str]:
        """Records that were skipped without being damaged, in words."""
        kinds = self._contents.unknown
        if not kinds:
            return []
        names = ", ".join(f"{op:#04x}" for op in sorted(kinds))
        return [f"{kinds.total()} records of kinds that are not MCAP's own ({names}) are skipped"]

    @cached_property
    def left_out(self) -> tuple[tuple[int, int], ...]:
        """Log times between which large messages were left out by intention; each end is exclusive."""
        try:
            stated = msgspec.json.decode(self.metadata[LEFT_OUT]["stretches"], type=list[tuple[int, int | None]])
        except (KeyError, msgspec.MsgspecError):
            return ()
        here = ((start, self.end_ns if end is None else end) for start, end in stated)
        return tuple(each for each in here if each[1] > self.start_ns and each[0] < self.end_ns)

    @property
    def places(self) -> tuple[MessageBlock, ...]:
        """The parts of the file that hold messages, in the order of the file."""
        return tuple(self._contents.places)

    @property
    def statistics(self) -> Statistics | None:
        """The counts that the file's summary states; None without a summary."""
        return self._contents.statistics

    @property
    def chunk_bytes(self) -> int:
        """Uncompressed size of all chunks."""
        return self._contents.raw_bytes

    @cached_property
    def channels(self) -> dict[int, Channel]:
        """All channels by their number, including those without messages."""
        return dict(sorted(self._contents.channels.items()))

    @cached_property
    def keys(self) -> dict[str, tuple[int, ...]]:
        """Each key with the numbers of its channels."""
        found: dict[str, tuple[int, ...]] = {}
        for id, channel in self.channels.items():
            found[channel.topic] = (*found.get(channel.topic, ()), id)
        return found

    @property
    def schemas(self) -> dict[int, Schema]:
        return dict(self._contents.schemas)

    def schema(self, channel: int) -> Schema | None:
        """A channel's schema; None when it has none."""
        return self._contents.schemas.get(self.channels[channel].schema_id)

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Metadata by name, without checksums; the newest where a name occurs several times."""
        return {found.name: _unsealed(found.metadata) for found in self._contents.metadata}

    def every_metadata(self, name: str) -> list[dict[str, str]]:
        """All metadata of one name, in the order of writing, without checksums."""
        return [_unsealed(found.metadata) for found in self._contents.metadata if found.name == name]

    @property
    def metadata_records(self) -> list[tuple[str, dict[str, str]]]:
        """Name and entries of all metadata except the tally, in the order of the file, with checksums."""
        return [
            (found.name, dict(found.metadata))
            for found in self._contents.metadata
            if found.name != TALLY or not self.follows_conventions
        ]

    @property
    def attachments(self) -> tuple[AttachmentIndex, ...]:
        """Index of each attachment: name, times, size and place in the file."""
        return tuple(self._contents.attachments)

    def attachment(self, index: AttachmentIndex) -> Attachment:
        """Read one attachment with its data. Raises DamageError when its checksum is wrong."""
        content = self._disk.read(index.offset, index.length)
        return mcap_reading.attachment(content[mcap.PREFIX.size :], self._contents.strict)

    @cached_property
    def robot(self) -> str:
        """The robot's name, with which its keys begin; '' when the capture names none and its keys have several."""
        name = self.metadata.get("run", {}).get("robot")
        if name is not None:
            return name
        names = {key.partition("/")[0] for key in self.keys if "/" in key}
        return names.pop() if len(names) == 1 else ""

    @property
    def start_ns(self) -> int:
        """First log time; 0 for an empty capture."""
        return min((place.start_ns for place in self._contents.places), default=0)

    @property
    def end_ns(self) -> int:
        return max((place.end_ns for place in self._contents.places), default=0)

    # --- its messages -----------------------------------------------------------------------------

    def messages(
        self,
        *keys: str,
        start_ns: int | None = None,
        end_ns: int | None = None,
        channels: Collection[int] | None = None,
    ) -> Iterator[Record]:
        """Messages in the order of their log times, then in the order of the file.

        `keys` are key expressions, with or without the robot's name; none means all. `channels` restricts to these
        numbers. `start_ns` and `end_ns` are log times; the end is exclusive. Raises CaptureError when the disk fails.
        """
        wanted = {
            id
            for id, channel in self.channels.items()
            if (not keys or self._matches(channel.topic, keys)) and (channels is None or id in channels)
        }
        places = sorted(self._contents.places, key=lambda place: (place.start_ns, place.offset))
        places = [
            place
            for place in places
            if (start_ns is None or place.end_ns >= start_ns)
            and (end_ns is None or place.start_ns < end_ns)
            and (place.channels is None or place.channels & wanted or not place.channels <= self.channels.keys())
        ]
        waiting: list[tuple[int, int, int, Record]] = []
        counts: Counter[int] = Counter()
        for place, raw in read_ahead(self._disk, places, self._contents.strict):
            while waiting and waiting[0][0] < place.start_ns:
                yield heapq.heappop(waiting)[3]
            for order, message in enumerate(self._messages_in(place, raw, wanted)):
                counts[message.channel_id] += 1
                if (start_ns is None or message.log_ns >= start_ns) and (end_ns is None or message.log_ns < end_ns):
                    record = self._record(message)
                    heapq.heappush(waiting, (message.log_ns, place.offset, order, record))
        if start_ns is None and end_ns is None and self.statistics is not None:
            for text in miscounted(self.statistics, counts, wanted, of_all=wanted == self.channels.keys()):
                self.add_problem(text)
        while waiting:
            yield heapq.heappop(waiting)[3]

    def check(self) -> None:
        """Verify the checksum over all data, the attachments, and a recorder's file front to back. Adds to `problems`.
        Raises CaptureError when the disk fails."""
        found = self._contents
        try:
            if found.strict and found.summarised:
                for problem in front_to_back(self._disk).problems:
                    self.add_problem(problem)
            if found.data_crc and self._disk.checksum(0, found.data_end) != found.data_crc:
                self.add_problem("the checksum of all the data is wrong")
            for index in found.attachments:
                try:
                    self.attachment(index)
                except DamageError as damage:
                    self.add_problem(f"at byte {index.offset}: {damage}")
        except DamageError as damage:
            self.add_problem(str(damage))
        except OSError as error:
            raise CaptureError(f"{self.path} cannot be read: {error.strerror}") from error

    def _matches(self, key: str, wanted: tuple[str, ...]) -> bool:
        return any(matches(expr, key) or matches(f"{self.robot}/{expr}", key) for expr in wanted)

    def _record(self, message: mcap.McapMessage) -> Record:
        channel_id, sequence, log_ns, publish_ns, payload = message
        return Record(self.channels[channel_id].topic, log_ns, publish_ns, sequence, payload, channel_id)

    def _messages_in(self, place: MessageBlock, raw: Future[Raw], wanted: set[int]) -> Iterator[mcap.McapMessage]:
        with self._skipping(place):
            for op, content, _ in mcap.records(raw.result()):
                if op != Opcode.MESSAGE:
                    continue
                channel_id = mcap.channel_of(content)
                if channel_id in wanted:
                    yield mcap.message(content)
                elif channel_id not in self.channels:
                    self.add_problem(f"a message belongs to channel {channel_id}, which the file does not declare")

    def payloads(self, channels: Collection[int], *, by_index: bool = True) -> Iterator[bulk.Payload]:
        """Channel, log time and payload of each message of these channels; each channel's in the order of the file:
        `messages` for who takes them all at once. `by_index` looks only where a chunk's indices say that they are.
        Raises CaptureError when the disk fails."""
        for place in self._contents.places:
            if place.channels is None or not place.channels.isdisjoint(channels):
                with self._skipping(place):
                    yield from bulk.payloads(self._disk, place, channels, self._contents.strict, by_index)

    @contextmanager
    def _skipping(self, place: MessageBlock) -> Iterator[None]:
        """Notes a damaged block, whose rest is skipped."""
        try:
            yield
        except DamageError as damage:
            kind = "run of messages" if place.loose else "chunk"
            self.add_problem(f"the {kind} at byte {place.offset} ({place.length} bytes) is skipped: {damage}")
        except OSError as error:
            raise CaptureError(f"{self.path} cannot be read: {error.strerror}") from error

    def add_problem(self, text: str) -> None:
        """Add an unreadable part to `problems`."""
        if text in self._problems:
            return
        if len(self._problems) < MOST_PROBLEMS:
            self._problems.append(text)
        else:
            self._not_listed += 1

    # --- what they mean ---------------------------------------------------------------------------

    def decode(self, record: Record) -> Any:
        """A message as plain data: maps for MessagePack and JSON, otherwise bytes. Raises DamageError."""
        encoding = self.channels[record.channel].message_encoding
        try:
            if encoding == MSGPACK:
                return msgspec.msgpack.decode(record.payload)
            if encoding == JSON:
                return json.loads(bytes(record.payload))
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise DamageError(f"{record.key} {record.sequence}: the payload is not {encoding}: {error}") from error
        return bytes(record.payload)

    def read(self, record: Record) -> msgspec.Struct:
        """A message as today's type of its key, by the rules of `cocoro.capture.types`. Raises NotReadableError."""
        schema = self.schema(record.channel)
        read = reader_of(record.key.removeprefix(f"{self.robot}/"), None if schema is None else schema.name)
        if read is None:
            raise NotReadableError(f"{record.key}: its type is unknown")
        try:
            return read(record.payload)
        except (msgspec.MsgspecError, ValueError, RecursionError, DamageError) as error:
            raise NotReadableError(f"{record.key} {record.sequence}: {error}") from error

    # --- its end ----------------------------------------------------------------------------------

    def close(self) -> None:
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def __enter__(self) -> Capture:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def _unsealed(entries: dict[str, str]) -> dict[str, str]:
    """Entries without a recorder's checksum; another program's entry of that name stays."""
    return {name: value for name, value in entries.items() if name != CHECKSUM or value != checksum(entries)}


def _kind(mode: int) -> str:
    """A file kind in words."""
    if stat.S_ISFIFO(mode):
        return "a pipe"
    return "a socket" if stat.S_ISSOCK(mode) else "a device"
