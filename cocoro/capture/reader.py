"""Reading captures, whole or not, ours or others'. Channels are told apart by their numbers: a key may have several.

    with Capture.open(path) as capture:
        for record in capture.messages("base/state", "kinect/frame"):
            print(record.log_ns, record.key, capture.decode(record))

What cannot be read is passed by and told of in `capture.problems`; whoever has read a capture looks there at the end.

By hand, because the package's readers end at the first damage, know channels only from the summary where there is one,
and copy every payload: they take 1.0 to 1.4 times as long for frames, 1.5 to 2.0 times for small messages
(`python bench/capture_format.py files`).
"""

from __future__ import annotations

import heapq
import json
import os
import stat
from collections import Counter, deque
from collections.abc import Collection, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import msgspec
from mcap.opcode import Opcode
from mcap.records import Attachment, AttachmentIndex, Channel, Schema, Statistics

from cocoro.capture import mcap
from cocoro.capture.contents import Contents, Disk, MessageBlock, miscounted, read_block
from cocoro.capture.conventions import CHECKSUM, TALLY, CaptureError, NotAFileError, checksum
from cocoro.capture.mcap import DamageError
from cocoro.capture.scan import contents, front_to_back
from cocoro.capture.types import JSON, MSGPACK, NotReadableError, reader_of
from cocoro.keys import matches

Raw = bytes | memoryview
AHEAD = 4
"""Chunks that are read before they are asked for."""
MOST_PROBLEMS = 20
"""Told one by one; of further ones there is a count."""


class Record(NamedTuple):
    """One message, as it was recorded."""

    key: str
    log_ns: int
    publish_ns: int
    sequence: int
    payload: memoryview
    channel: int
    """Its number."""


class Capture:
    """Make it with `open`; close it, or use it in `with`."""

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
        self._untold = 0

    @classmethod
    def open(cls, path: Path) -> Capture:
        """Raises CaptureError when it is no MCAP file, or cannot be read at all; NotAFileError for what is no file."""
        try:
            mode = path.stat().st_mode
            if not stat.S_ISREG(mode) and not stat.S_ISDIR(mode):  # opening one may block, or do something
                raise NotAFileError(
                    f"{path} is {_kind(mode)} and no file; copy what it gives into a file, and name that"
                )
            fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
        except OSError as error:
            raise CaptureError(f"{path} cannot be read: {error.strerror}") from error
        return cls(path, fd)

    # --- what it is -------------------------------------------------------------------------------

    @property
    def whole(self) -> bool:
        """It was closed by its writer, and nothing of it has been found to be damaged so far."""
        return self._contents.closed and not self._problems

    @property
    def closed(self) -> bool:
        """It has its end. A recorder that was killed, or still writes, leaves none."""
        return self._contents.closed

    @property
    def summarised(self) -> bool:
        """Its contents were taken from its summary, so not all of it has been read."""
        return self._contents.summarised

    @property
    def follows_page(self) -> bool:
        """Its profile says that the conventions of docs/captures.md hold."""
        return self._contents.follows_page

    @property
    def profile(self) -> str:
        return self._contents.profile

    @property
    def ending(self) -> str:
        """In words, why it may be shorter than the run was; '' when it was closed."""
        if self.closed:
            return ""
        cut = f" (of its last record there are {self.cut_bytes} bytes and not the rest)" if self.cut_bytes else ""
        return f"not closed: it is still being written, or its recorder was killed or had no room left{cut}"

    @property
    def cut_bytes(self) -> int:
        """At its end, of a record that was never finished."""
        return self._contents.cut_bytes

    @property
    def problems(self) -> list[str]:
        """Parts that could not be read, and counts that are not so, as far as it was tried, in words."""
        more = [f"and {self._untold} more of the kind"] if self._untold else []
        return [*self._problems, *more]

    @property
    def size_bytes(self) -> int:
        return self._disk.size

    @property
    def notes(self) -> list[str]:
        """Records that are passed by without being damaged, in words."""
        kinds = self._contents.unknown
        if not kinds:
            return []
        names = ", ".join(f"{op:#04x}" for op in sorted(kinds))
        return [f"{kinds.total()} records of kinds that are not MCAP's own ({names}) are passed by"]

    @property
    def places(self) -> tuple[MessageBlock, ...]:
        """Where its messages are, in the order of the file."""
        return tuple(self._contents.places)

    @property
    def statistics(self) -> Statistics | None:
        """Counts that the file states in its summary; None where it has none."""
        return self._contents.statistics

    @property
    def chunk_bytes(self) -> int:
        """Size of all chunks before compression."""
        return self._contents.raw_bytes

    @cached_property
    def channels(self) -> dict[int, Channel]:
        """By number, also those without messages."""
        return dict(sorted(self._contents.channels.items()))

    @cached_property
    def keys(self) -> dict[str, tuple[int, ...]]:
        """Every key with the numbers of its channels."""
        found: dict[str, tuple[int, ...]] = {}
        for id, channel in self.channels.items():
            found[channel.topic] = (*found.get(channel.topic, ()), id)
        return found

    @property
    def schemas(self) -> dict[int, Schema]:
        return dict(self._contents.schemas)

    def schema(self, channel: int) -> Schema | None:
        """The schema of a channel; None where it has none."""
        return self._contents.schemas.get(self.channels[channel].schema_id)

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """By name, without checksums; of several of one name the newest."""
        return {found.name: _unsealed(found.metadata) for found in self._contents.metadata}

    def every_metadata(self, name: str) -> list[dict[str, str]]:
        """All of one name, in the order in which they were written, without checksums."""
        return [_unsealed(found.metadata) for found in self._contents.metadata if found.name == name]

    @property
    def metadata_records(self) -> list[tuple[str, dict[str, str]]]:
        """All but the tally, as they stand in the file and in that order."""
        return [
            (found.name, dict(found.metadata))
            for found in self._contents.metadata
            if found.name != TALLY or not self.follows_page
        ]

    @property
    def attachments(self) -> tuple[AttachmentIndex, ...]:
        """The index of each attachment: its names, times and size, and its place in the file."""
        return tuple(self._contents.attachments)

    def attachment(self, index: AttachmentIndex) -> Attachment:
        """Read one attachment with its data. Raises DamageError where its checksum is wrong."""
        content = self._disk.read(index.offset, index.length)
        return mcap.attachment(content[mcap.PREFIX.size :], self._contents.ours)

    @cached_property
    def robot(self) -> str:
        """The robot's name: keys begin with it. '' when the capture does not say, and its keys begin differently."""
        told = self.metadata.get("run", {}).get("robot")
        if told is not None:
            return told
        names = {key.partition("/")[0] for key in self.keys if "/" in key}
        return names.pop() if len(names) == 1 else ""

    @property
    def start_ns(self) -> int:
        """The first log time; 0 of an empty capture."""
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
        """In order of their log times; those of one time as they stand in the file.

        `keys` are key expressions, with or without the robot's name; none means all. Times are log times, the end
        exclusive. Of `channels`, if they are given, and no others.
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
        for place, raw in self._read_ahead(places):
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
        """Look at what reading messages does not look at: the checksums of all the data and of attachments, and of a
        recorder's file every record, from front to back. What is wrong is in `problems` then. Raises CaptureError."""
        found = self._contents
        try:
            if found.ours and found.summarised:
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

    def _read_ahead(self, places: list[MessageBlock]) -> Iterator[tuple[MessageBlock, Future[Raw]]]:
        """Read and unpack in a thread what is wanted next, while this one works on what it has."""
        with ThreadPoolExecutor(1, "capture reader") as pool:
            ahead: deque[tuple[MessageBlock, Future[Raw]]] = deque()
            try:
                for place in places:
                    ahead.append((place, pool.submit(read_block, self._disk, place, self._contents.ours)))
                    if len(ahead) > AHEAD:
                        yield ahead.popleft()
                while ahead:
                    yield ahead.popleft()
            finally:
                pool.shutdown(cancel_futures=True)

    def _messages_in(self, place: MessageBlock, raw: Future[Raw], wanted: set[int]) -> Iterator[mcap.McapMessage]:
        try:
            for op, content, _ in mcap.records(raw.result()):
                if op != Opcode.MESSAGE:
                    continue
                channel_id = mcap.channel_of(content)
                if channel_id in wanted:
                    yield mcap.message(content)
                elif channel_id not in self.channels:
                    self.add_problem(f"a message is of channel {channel_id}, which the file does not tell of")
        except DamageError as damage:
            kind = "run of messages" if place.loose else "chunk"
            self.add_problem(f"the {kind} at byte {place.offset} ({place.length} bytes) is passed by: {damage}")
        except OSError as error:
            raise CaptureError(f"{self.path} cannot be read: {error.strerror}") from error

    def add_problem(self, text: str) -> None:
        """Have it told of something that could not be read."""
        if text in self._problems:
            return
        if len(self._problems) < MOST_PROBLEMS:
            self._problems.append(text)
        else:
            self._untold += 1

    # --- what they mean ---------------------------------------------------------------------------

    def decode(self, record: Record) -> Any:
        """A message as plain data: MessagePack and JSON as maps, anything else as bytes. Raises DamageError."""
        encoding = self.channels[record.channel].message_encoding
        try:
            if encoding == MSGPACK:
                return msgspec.msgpack.decode(record.payload)
            if encoding == JSON:
                return json.loads(bytes(record.payload))
        except (msgspec.MsgspecError, ValueError, RecursionError) as error:
            raise DamageError(f"{record.key} {record.sequence}: the payload is no {encoding}: {error}") from error
        return bytes(record.payload)

    def read(self, record: Record) -> msgspec.Struct:
        """A message as today's type of its key, by the rules of `cocoro.capture.schema`. Raises NotReadableError."""
        schema = self.schema(record.channel)
        read = reader_of(record.key.removeprefix(f"{self.robot}/"), None if schema is None else schema.name)
        if read is None:
            raise NotReadableError(f"{record.key}: no type is known for it here")
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
    """Without the checksum that recorders put there; an entry of that name that is none stays."""
    return {name: value for name, value in entries.items() if name != CHECKSUM or value != checksum(entries)}


def _kind(mode: int) -> str:
    """Name the kind of something that is no file."""
    if stat.S_ISFIFO(mode):
        return "a pipe"
    return "a socket" if stat.S_ISSOCK(mode) else "a device"
