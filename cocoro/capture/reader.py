"""Reading captures, whole or not, ours or others'.

    with Capture.open(path) as capture:
        for record in capture.messages("base/state", "kinect/frame"):
            print(record.log_ns, record.key, capture.decode(record))

What cannot be read is passed by and told of in `capture.problems`; whoever has read a capture looks there at the end.
"""

from __future__ import annotations

import heapq
import json
import os
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cached_property
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

import msgspec

from cocoro.bus.keys import matches
from cocoro.capture import mcap
from cocoro.capture.errors import CaptureError, DamageError
from cocoro.capture.keys import JSON, MSGPACK
from cocoro.capture.scan import ChunkPlace, Contents, Disk, contents, read_chunk
from cocoro.capture.types import NotReadableError, reader_of

Chunk = tuple[int, bytes | memoryview]
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
        if self._contents.foreign:
            self._problem("it has messages outside of chunks, which are passed by")

    @classmethod
    def open(cls, path: Path) -> Capture:
        """Raises CaptureError when it is no MCAP file, or cannot be read at all."""
        try:
            fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        except OSError as error:
            raise CaptureError(f"{path} cannot be read: {error.strerror}") from error
        return cls(path, fd)

    # --- what it is -------------------------------------------------------------------------------

    @property
    def whole(self) -> bool:
        """It was closed by its writer, and nothing of it has been found to be damaged so far."""
        return self._contents.whole and not self._problems

    @property
    def closed(self) -> bool:
        """It has its summary. A recorder that was killed, or still writes, leaves none."""
        return self._contents.whole

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
        """What could not be read, as far as it was tried."""
        more = [f"and {self._untold} more of the kind"] if self._untold else []
        return [*self._problems, *more]

    @property
    def size_bytes(self) -> int:
        return self._disk.size

    @property
    def chunks(self) -> tuple[ChunkPlace, ...]:
        return tuple(self._contents.chunks)

    @property
    def statistics(self) -> mcap.Statistics | None:
        """By the summary."""
        return self._contents.statistics

    @cached_property
    def channels(self) -> dict[int, mcap.Channel]:
        return dict(sorted(self._contents.channels.items()))

    @cached_property
    def keys(self) -> dict[str, mcap.Channel]:
        """Every key with its channel."""
        return {channel.topic: channel for channel in self.channels.values()}

    def schema(self, key: str) -> mcap.Schema | None:
        return self._contents.schemas.get(self.keys[key].schema_id)

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """By name; of several of one name the newest."""
        return {name: dict(entries) for name, entries in self._contents.metadata}

    def every_metadata(self, name: str) -> list[dict[str, str]]:
        """All of one name, in the order in which they were written."""
        return [dict(entries) for other, entries in self._contents.metadata if other == name]

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
        return min((chunk.start_ns for chunk in self._contents.chunks), default=0)

    @property
    def end_ns(self) -> int:
        return max((chunk.end_ns for chunk in self._contents.chunks), default=0)

    # --- its messages -----------------------------------------------------------------------------

    def messages(self, *keys: str, start_ns: int | None = None, end_ns: int | None = None) -> Iterator[Record]:
        """In order of their log times; those of one time as they stand in the file.

        `keys` are key expressions, with or without the robot's name; none means all. Times are log times, the end
        exclusive.
        """
        wanted = {id for id, channel in self.channels.items() if not keys or self._matches(channel.topic, keys)}
        places = sorted(self._contents.chunks, key=lambda place: (place.start_ns, place.offset))
        places = [
            place
            for place in places
            if (start_ns is None or place.end_ns >= start_ns)
            and (end_ns is None or place.start_ns < end_ns)
            and (place.channels is None or place.channels & wanted or not place.channels <= self.channels.keys())
        ]
        waiting: list[tuple[int, int, int, Record]] = []
        for number, (place, chunk) in enumerate(self._read_ahead(places)):
            while waiting and waiting[0][0] < place.start_ns:
                yield heapq.heappop(waiting)[3]
            for order, message in enumerate(self._chunk_messages(place, chunk, wanted)):
                if (start_ns is None or message.log_ns >= start_ns) and (end_ns is None or message.log_ns < end_ns):
                    record = self._record(message)
                    heapq.heappush(waiting, (message.log_ns, number, order, record))
        while waiting:
            yield heapq.heappop(waiting)[3]

    def _matches(self, key: str, wanted: tuple[str, ...]) -> bool:
        return any(matches(expr, key) or matches(f"{self.robot}/{expr}", key) for expr in wanted)

    def _record(self, message: mcap.Message) -> Record:
        topic = self.channels[message.channel_id].topic
        return Record(topic, message.log_ns, message.publish_ns, message.sequence, message.payload)

    def _read_ahead(self, places: list[ChunkPlace]) -> Iterator[tuple[ChunkPlace, Future[Chunk]]]:
        """Read and unpack in a thread what is wanted next, while this one works on what it has."""
        with ThreadPoolExecutor(1, "capture reader") as pool:
            ahead: deque[tuple[ChunkPlace, Future[Chunk]]] = deque()
            try:
                for place in places:
                    ahead.append((place, pool.submit(read_chunk, self._disk, place.offset)))
                    if len(ahead) > AHEAD:
                        yield ahead.popleft()
                while ahead:
                    yield ahead.popleft()
            finally:
                pool.shutdown(cancel_futures=True)

    def _chunk_messages(self, place: ChunkPlace, chunk: Future[Chunk], wanted: set[int]) -> Iterator[mcap.Message]:
        try:
            _, raw = chunk.result()
            for op, content, _ in mcap.records(raw):
                if op != mcap.Op.MESSAGE:
                    continue
                channel_id = mcap.channel_of(content)
                if channel_id in wanted:
                    yield mcap.message(content)
                elif channel_id not in self.channels:
                    self._problem(f"a message is of channel {channel_id}, which the file does not tell of")
        except DamageError as damage:
            self._problem(f"the chunk at byte {place.offset} ({place.length} bytes) is passed by: {damage}")
        except OSError as error:
            raise CaptureError(f"{self.path} cannot be read: {error.strerror}") from error

    def _problem(self, text: str) -> None:
        if text in self._problems:
            return
        if len(self._problems) < MOST_PROBLEMS:
            self._problems.append(text)
        else:
            self._untold += 1

    # --- what they mean ---------------------------------------------------------------------------

    def decode(self, record: Record) -> Any:
        """A message as plain data: MessagePack and JSON as maps, anything else as bytes. Raises DamageError."""
        encoding = self.keys[record.key].encoding
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
        schema = self.schema(record.key)
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
