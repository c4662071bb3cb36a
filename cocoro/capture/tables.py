"""A capture as columns: every topic as NumPy arrays, pictures one by one.

    with Tables.open(path) as capture:
        base = capture["base/state"]
        plt.plot(base["time_s"], base["speed_mps"])
        for frame in capture.frames():
            print(frame.stamp_ns, frame.width)

Messages are found by the file's indices and decoded many at once: in about half of the time of a loop over messages
(`python -m bench open`). A field's column is made when it is used first.
"""

from __future__ import annotations

import gc
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import msgspec
import numpy as np

from cocoro.bus.base import Qos
from cocoro.capture.columns import Column, Columns, MissingColumnError
from cocoro.capture.contents import miscounted
from cocoro.capture.former import todays_name
from cocoro.capture.mcap import DamageError
from cocoro.capture.reader import Capture, Record
from cocoro.capture.types import MSGPACK, MessageHead
from cocoro.clock import NS
from cocoro.errors import choice_of
from cocoro.installed import topic_named
from cocoro.messages import Frame
from cocoro.topics import FRAME

AT_ONCE = 4096
"""Messages that are decoded together; where one does not fit its type, so many are decoded one by one."""
HEAD = ("log_ns", "time_s")


_Taken = tuple[int, memoryview]
"""Log time and payload of a message."""


class Tables(Mapping[str, Columns]):
    """A capture by topic (the key without the robot). `open` makes one; close it, or use it in a `with` statement."""

    def __init__(self, capture: Capture) -> None:
        self.capture = capture
        """The capture as messages, with everything else that is in its file."""
        self._large = {FRAME.name} | {
            name for name in self._names if (topic := topic_named(name)) is not None and topic.qos is Qos.FRAME
        }
        self._columns: dict[str, Columns] = {}

    @classmethod
    def open(cls, path: Path) -> Tables:
        """Raises CaptureError when the file cannot be read or is not MCAP."""
        return cls(Capture.open(path))

    # --- what it is -------------------------------------------------------------------------------

    @property
    def path(self) -> Path:
        return self.capture.path

    @property
    def robot(self) -> str:
        """The robot's name."""
        return self.capture.robot

    @property
    def duration_s(self) -> float:
        return (self.capture.end_ns - self.capture.start_ns) / NS

    @property
    def problems(self) -> list[str]:
        """Unreadable parts and messages so far, in words; they are left out."""
        return self.capture.problems

    @property
    def _names(self) -> dict[str, tuple[int, ...]]:
        """The channels of each topic."""
        prefix = f"{self.robot}/"
        return {key.removeprefix(prefix): channels for key, channels in self.capture.keys.items()}

    def __repr__(self) -> str:
        return f"<{self.path.name}: {self.robot}, {self.duration_s:.1f} s, {len(self)} topics>"

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __contains__(self, topic: object) -> bool:
        return topic in self._names

    # --- columns ----------------------------------------------------------------------------------

    def __getitem__(self, topic: str) -> Columns:
        """A topic's messages in the order of their log times: `log_ns` (time of recording, ns), `time_s` (the same
        since the capture's begin), then the fields of the message. Of pictures these are the times and numbers alone;
        see `frames`.

        Raises MissingColumnError for a topic that the capture has not, CaptureError when the disk fails.
        """
        if topic not in self._columns:
            self.load(topic)
        return self._columns[topic]

    def load(self, *topics: str) -> None:
        """Reads these topics in one pass over the file; a topic that is asked for by itself takes a pass of its own.
        Raises what `[]` raises."""
        with _uncollected():
            self._load(topics)

    def _load(self, topics: tuple[str, ...]) -> None:
        wanted = {topic: self._channels(topic) for topic in topics if topic not in self._columns}
        small = {topic: channels for topic, channels in wanted.items() if topic not in self._large}
        taken = self._take({channel for channels in small.values() for channel in channels}) if small else {}
        for topic, channels in wanted.items():
            if topic in self._large:
                self._columns[topic] = self._of_frames(channels)
            else:
                self._columns[topic] = self._of(topic, {channel: taken.pop(channel) for channel in channels})

    def _channels(self, topic: str) -> tuple[int, ...]:
        channels = self._names.get(topic)
        if channels is None:
            raise MissingColumnError(f"{self.path}: no topic {topic!r}; {choice_of(topic, self._names)}")
        return channels

    def _of(self, topic: str, channels: Mapping[int, list[_Taken]]) -> Columns:
        taken = [(channel, one) for channel, each in channels.items() for one in each]
        if len(channels) > 1:
            taken.sort(key=lambda each: each[1][0])
        messages: list[Any] = []
        log_ns: list[int] = []
        start = 0
        while start < len(taken):  # runs of one channel, whose messages have one type
            end = start
            while end < len(taken) and end - start < AT_ONCE and taken[end][0] == taken[start][0]:
                end += 1
            part = [one for _, one in taken[start:end]]
            for one, message in zip(part, self._decoded(topic, taken[start][0], part), strict=True):
                if message is not None:
                    messages.append(message)
                    log_ns.append(one[0])
            start = end
        return Columns(self._times(log_ns), messages)

    def _times(self, log_ns: list[int]) -> dict[str, Column]:
        when = np.array(log_ns, dtype=np.int64)
        return dict(zip(HEAD, (when, (when - self.capture.start_ns) / NS), strict=True))

    def _take(self, channels: Collection[int]) -> dict[int, list[_Taken]]:
        """All messages of these channels, in one pass, each channel's in the order of their log times."""
        for by_index in (True, False):
            found: dict[int, list[_Taken]] = {channel: [] for channel in channels}
            for channel, log_ns, payload in self.capture.payloads(found, by_index=by_index):
                found[channel].append((log_ns, payload))
            wrong = self._miscounted({channel: len(taken) for channel, taken in found.items()})
            if not wrong:  # else an index may be wrong
                break
        for text in wrong:
            self.capture.add_problem(text)
        for taken in found.values():
            taken.sort(key=itemgetter(0))  # of equal times the file's order stays
        return found

    def _miscounted(self, counts: Mapping[int, int]) -> list[str]:
        stated = self.capture.statistics
        return [] if stated is None else [*miscounted(stated, counts, counts, of_all=False)]

    # --- decoding ---------------------------------------------------------------------------------

    def _decoded(self, topic: str, channel: int, taken: list[_Taken]) -> list[Any]:
        """The messages, as today's type of the topic where it is known; None for each that cannot be read."""
        if self.capture.channels[channel].message_encoding == MSGPACK:
            try:
                return _together(taken, self._type(topic, channel))
            except (msgspec.MsgspecError, ValueError, RecursionError):
                pass  # at least one of them does not fit
        return [self._one(topic, channel, one) for one in taken]

    def _type(self, topic: str, channel: int) -> Any:
        known, schema = topic_named(topic), self.capture.schema(channel)
        if known is None or (schema is not None and todays_name(schema.name) != known.type.__name__):
            return dict[str, Any]
        return known.type

    def _one(self, topic: str, channel: int, taken: _Taken) -> Any:
        record = Record(self.capture.channels[channel].topic, taken[0], taken[0], 0, taken[1], channel)
        try:
            if self._type(topic, channel) != dict[str, Any]:
                return self.capture.read(record)
            message = self.capture.decode(record)
        except DamageError as damage:
            self.capture.add_problem(f"a message of {topic} is left out: {damage}")
            return None
        return (
            {str(name): value for name, value in message.items()} if isinstance(message, dict) else {"value": message}
        )

    # --- pictures ---------------------------------------------------------------------------------

    def frames(
        self, topic: str = FRAME.name, *, start_s: float | None = None, end_s: float | None = None
    ) -> Iterator[Frame]:
        """The frames of a topic, one at a time; `start_s` and `end_s` count from the capture's begin. Those that cannot
        be read are left out. Raises MissingColumnError for a topic that the capture has not."""
        channels = self._channels(topic)
        begin_ns = self.capture.start_ns
        between = (None if at_s is None else begin_ns + round(at_s * NS) for at_s in (start_s, end_s))
        start_ns, end_ns = between
        return self._frames(self.capture.messages(channels=channels, start_ns=start_ns, end_ns=end_ns))

    def _frames(self, records: Iterator[Record]) -> Iterator[Frame]:
        for record in records:
            try:
                frame = self.capture.read(record)
            except DamageError as damage:
                self.capture.add_problem(str(damage))
                continue
            if isinstance(frame, Frame):
                yield frame

    def _of_frames(self, channels: tuple[int, ...]) -> Columns:
        """Times and numbers of pictures, without their pixels."""
        taken = sorted(((log_ns, head) for log_ns, head in self._heads(channels)), key=itemgetter(0))
        heads = [head for _, head in taken]
        return Columns(self._times([log_ns for log_ns, _ in taken]), heads)

    def _heads(self, channels: tuple[int, ...]) -> Iterator[tuple[int, MessageHead]]:
        decode = msgspec.msgpack.Decoder(MessageHead).decode
        for _, log_ns, payload in self.capture.payloads(channels):
            try:
                yield log_ns, decode(payload)
            except (msgspec.MsgspecError, ValueError, RecursionError) as error:
                self.capture.add_problem(f"a frame is left out: {error}")

    # --- its end ----------------------------------------------------------------------------------

    def close(self) -> None:
        self.capture.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@contextmanager
def _uncollected() -> Iterator[None]:
    """Without the collector of cycles, which would look at all messages again and again while their number grows; there
    are no cycles in messages."""
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def _together(taken: list[_Taken], kind: Any) -> list[Any]:
    """Messages that are decoded in one call, as the items of one array."""
    whole = b"".join((b"\xdd", len(taken).to_bytes(4, "big"), *(payload for _, payload in taken)))
    found: list[Any] = msgspec.msgpack.Decoder(list[kind]).decode(whole)
    return found
