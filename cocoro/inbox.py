"""What a node receives on one topic: checked at the border, counted, handed to its readers."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from typing import Any, Generic, TypeVar

import msgspec

from cocoro.bus.base import Payload, Subscription
from cocoro.clock import NS, Clock, is_fresh
from cocoro.messages import Message, TopicHealth
from cocoro.topics import CLOCK, Qos, Topic

M = TypeVar("M", bound=Message)


class Rate:
    """Counts, and the rate over the last health period."""

    def __init__(self) -> None:
        self.count = 0
        self._counted = 0
        self._since_ns: int | None = None

    def take(self, now_ns: int) -> float:
        """Per second since the last call."""
        since_ns, counted = self._since_ns, self._counted
        self._since_ns, self._counted = now_ns, self.count
        if since_ns is None or now_ns <= since_ns:
            return 0.0
        return (self.count - counted) * NS / (now_ns - since_ns)


class Source:
    """One publisher's key, as its reader follows it."""

    def __init__(self) -> None:
        self.incarnation = -1
        self.seq = -1
        self.gaps = 0


class Inbox(Generic[M]):
    """All that arrives on one topic's keys; every reader of the topic in this node hangs on the one inbox."""

    def __init__(self, topic: Topic[M], keyexpr: str, clock: Clock) -> None:
        self.topic = topic
        self.keyexpr = keyexpr
        self.rate = Rate()
        self.rejected = 0
        self.unread = 0
        """Samples that a `Latest` overwrote before they were read."""
        self.last_error = ""
        self.newest_stamp_ns: int | None = None
        self.subscription: Subscription | None = None
        self._decoder = msgspec.msgpack.Decoder(topic.type)
        self._clock = clock
        self._sources: dict[str, Source] = {}
        self._readers: list[Callable[[str, M], None]] = []

    def add(self, reader: Callable[[str, M], None]) -> None:
        """`reader(key, message)` is called for each good message, in order per key."""
        self._readers.append(reader)

    def remove(self, reader: Callable[[str, M], None]) -> None:
        if reader in self._readers:
            self._readers.remove(reader)

    def deliver(self, key: str, payload: Payload) -> None:
        """The bus's callback: a bad payload is counted and dropped, whatever it is."""
        if len(payload) > self.topic.max_bytes:
            self._reject(f"{len(payload)} bytes, at most {self.topic.max_bytes} are taken")
            return
        try:
            message = self._decoder.decode(payload)
        except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
            self._reject(str(error))
            return
        if not self._in_order(key, message) or not self._timely(message):
            return
        self.rate.count += 1
        self.newest_stamp_ns = message.stamp_ns
        for reader in list(self._readers):
            reader(key, message)

    def _in_order(self, key: str, message: M) -> bool:
        source = self._sources.setdefault(key, Source())
        if message.incarnation != source.incarnation:
            source.incarnation, source.seq = message.incarnation, message.seq
            return True
        if message.seq <= source.seq:
            self._reject(f"sequence number {message.seq} after {source.seq}")
            return False
        source.gaps += message.seq - source.seq - 1
        source.seq = message.seq
        return True

    def _timely(self, message: M) -> bool:
        """A command beyond its age must not act, however it got here; nor one from the future."""
        if self.topic.qos is not Qos.COMMAND or self.topic.name == CLOCK.name:
            return True
        now_ns = self._clock.now_ns()
        if not is_fresh(message.stamp_ns, now_ns, self.topic.max_age_s):
            self._reject(f"stale: stamped {(now_ns - message.stamp_ns) / NS:.3f} s ago")
            return False
        return True

    def _reject(self, why: str) -> None:
        self.rejected += 1
        self.last_error = why

    def health(self, now_ns: int) -> TopicHealth:
        overwritten = self.subscription.skipped if self.subscription is not None else 0
        gaps = sum(source.gaps for source in self._sources.values())
        return TopicHealth(
            key=self.keyexpr,
            direction="in",
            count=self.rate.count,
            rate_hz=self.rate.take(now_ns),
            age_s=None if self.newest_stamp_ns is None else (now_ns - self.newest_stamp_ns) / NS,
            skipped=overwritten + self.unread,
            lost=max(gaps - overwritten, 0),
            rejected=self.rejected,
            last_error=self.last_error,
        )


class Latest(Generic[M]):
    """The newest message of a topic."""

    def __init__(self, inbox: Inbox[M], clock: Clock) -> None:
        self._inbox = inbox
        self._clock = clock
        self._message: M | None = None
        self._read = True
        self._changed = asyncio.Event()
        inbox.add(self._take)

    def _take(self, _key: str, message: M) -> None:
        if not self._read:
            self._inbox.unread += 1
        self._message = message
        self._read = False
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    @property
    def value(self) -> M | None:
        """The newest, however old; None before the first."""
        self._read = True
        return self._message

    def fresh(self, max_age_s: float | None = None) -> M | None:
        """The newest unless it is older than `max_age_s` (the topic's maximum age by default), or of another epoch."""
        message = self.value
        limit_s = self._inbox.topic.max_age_s if max_age_s is None else max_age_s
        if message is None or not is_fresh(message.stamp_ns, self._clock.now_ns(), limit_s):
            return None
        return message

    async def next(self) -> M:
        """Wait for a message that is newer than what is here now."""
        await self._changed.wait()
        message = self.value
        assert message is not None
        return message


class Stream(Generic[M]):
    """Every message of a topic, in order: `async for message in stream`. Nothing is dropped; `limit` guards
    against a reader that has died: beyond it the oldest go, and `overflowed` says so."""

    def __init__(self, inbox: Inbox[M], limit: int = 100_000) -> None:
        self._inbox = inbox
        self._limit = limit
        self._waiting: deque[M] = deque()
        self._arrived = asyncio.Event()
        self.overflowed = 0
        inbox.add(self._take)

    def _take(self, _key: str, message: M) -> None:
        if len(self._waiting) >= self._limit:
            self._waiting.popleft()
            self.overflowed += 1
        self._waiting.append(message)
        self._arrived.set()

    async def next(self) -> M:
        while not self._waiting:
            self._arrived.clear()
            await self._arrived.wait()
        return self._waiting.popleft()

    async def __aiter__(self) -> AsyncIterator[M]:
        while True:
            yield await self.next()

    def close(self) -> None:
        self._inbox.remove(self._take)


class Intake:
    """Gathers for a core what arrived since its last step, in order of arrival; of a `latest` topic the newest."""

    def __init__(self, limit: int = 4096) -> None:
        self._limit = limit
        self._samples: dict[int, tuple[Topic[Any], Message]] = {}
        self._next = 0
        self._last_of: dict[str, int] = {}

    def reader(
        self, topic: Topic[M], inbox: Inbox[M], take_all: bool, wake: Callable[[], None] | None
    ) -> Callable[[str, M], None]:
        def take(_key: str, message: M) -> None:
            if not take_all:
                older = self._last_of.get(topic.name)
                if older is not None and self._samples.pop(older, None) is not None:
                    inbox.unread += 1
                self._last_of[topic.name] = self._next
            elif len(self._samples) >= self._limit:
                del self._samples[next(iter(self._samples))]
                inbox.unread += 1
            self._samples[self._next] = (topic, message)
            self._next += 1
            if wake is not None:
                wake()

        return take

    def take(self) -> list[tuple[Topic[Any], Message]]:
        samples = list(self._samples.values())
        self._samples.clear()
        self._last_of.clear()
        return samples
