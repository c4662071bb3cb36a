"""What a node receives on one topic: checked at the border, counted, handed to its readers."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from math import inf
from typing import Any, Generic, TypeVar

import msgspec

from cocoro.bus.base import Payload, Qos, Subscription
from cocoro.clock import CLOCKS_APART_NS, NS, Clock, is_fresh, latest_ns
from cocoro.messages import Message, TopicHealth
from cocoro.source import ANY_HZ, Source
from cocoro.topics import CLOCK, Topic
from cocoro.trouble import Trouble

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


class Inbox(Generic[M]):
    """All that arrives on one topic's keys; every reader of the topic in this node hangs on the one inbox.

    What is rejected is counted and dropped, and never the reason to reject what comes after it:

    - what is malformed, of the wrong type, or larger than the topic's row allows;
    - a command that is older than its row allows, a command or state that is stamped more than CLOCKS_APART_NS ahead of
      this reader's clock (events are told whenever they come, and the clock's own key is judged by `judge`);
    - what is out of sequence, by the rules of `cocoro.source`.
    """

    def __init__(self, topic: Topic[M], keyexpr: str, clock: Clock, *, onlooker: bool = False) -> None:
        """An onlooker acts on nothing: it takes messages whatever their stamps."""
        self.topic = topic
        self.keyexpr = keyexpr
        self.rate = Rate()
        self.rejected = 0
        self.unread = 0
        """Samples that a `Latest` overwrote before they were read."""
        self.last_error = ""
        self.newest_stamp_ns: int | None = None
        self.subscription: Subscription | None = None
        self.judge: Callable[[M], str] | None = None
        """Says why a message that is in order is not to be taken all the same ('' when it is)."""
        self.trouble = Trouble(topic)
        self._decoder = msgspec.msgpack.Decoder(topic.type)
        self._clock = clock
        self._sources: dict[str, Source] = {}
        self._readers: list[Callable[[str, M], None]] = []
        timeless = onlooker or topic.name == CLOCK.name
        self._expires = topic.qos is Qos.COMMAND and not timeless
        self._horizon_ns: float = inf if timeless or topic.qos is Qos.EVENT else 0
        """What is stamped up to here is surely not ahead of the clock; it is looked at again when something is not."""

    def add(self, reader: Callable[[str, M], None]) -> None:
        """`reader(key, message)` is called for each good message, in order per key."""
        self._readers.append(reader)

    def remove(self, reader: Callable[[str, M], None]) -> None:
        if reader in self._readers:
            self._readers.remove(reader)

    def deliver(self, key: str, payload: Payload) -> None:
        """The bus's callback: a bad payload is counted and dropped, whatever it is."""
        if len(payload) > self.topic.max_bytes:
            self._reject(key, f"{len(payload)} bytes, at most {self.topic.max_bytes} are taken")
            return
        try:
            message = self._decoder.decode(payload)
        except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
            self._reject(key, str(error))
            return
        source = self._sources.get(key)
        if source is None:
            source = self._sources[key] = Source()
        seq, stamp_ns = message.seq, message.stamp_ns
        if self._expires:
            now_ns = self._clock.now_ns()
            if not is_fresh(stamp_ns, now_ns, self.topic.max_age_s):
                self._refuse(key, source, message, _untimely(stamp_ns - now_ns))
                return
        elif stamp_ns > self._horizon_ns and (ahead_ns := self._ahead_ns(stamp_ns)) > CLOCKS_APART_NS:
            self._refuse(key, source, message, _untimely(ahead_ns))
            return
        lost: int | None = 0
        if message.incarnation != source.incarnation:
            source.begin(message.incarnation)
        elif seq != source.seq + 1:
            lost = source.jump(seq, stamp_ns, self.topic.rate_hz or ANY_HZ, latest_ns(self._clock))
            if lost is None:
                self._reject(key, source.why(seq))
                return
        if self.judge is not None and (why := self.judge(message)):
            self._refuse(key, source, message, why)
            return
        source.seq, source.stamp_ns = seq, stamp_ns
        if lost:
            source.gaps += lost
        if source.troubled:
            source.settle()
        if self.trouble.since_s is not None:
            self.trouble.ends()
        self.rate.count += 1
        self.newest_stamp_ns = stamp_ns
        for reader in list(self._readers):
            reader(key, message)

    def _ahead_ns(self, stamp_ns: int) -> int:
        """How far a stamp is ahead of the clock; 0 when the clock has not started."""
        now_ns = latest_ns(self._clock)
        if now_ns is None:
            return 0
        self._horizon_ns = now_ns + CLOCKS_APART_NS
        return stamp_ns - now_ns

    def _refuse(self, key: str, source: Source, message: M, why: str) -> None:
        source.refuse(message.incarnation, message.seq)
        self._reject(key, why)

    def _reject(self, key: str, why: str) -> None:
        self.rejected += 1
        self.last_error = why
        self.trouble.grows(key)

    def health(self, now_ns: int) -> TopicHealth:
        overwritten = self.subscription.skipped if self.subscription is not None else 0
        gaps = sum(source.gaps for source in self._sources.values())
        if self._horizon_ns < inf:
            self._horizon_ns = 0  # a clock that began anew may be far before it
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
            fault=self.trouble.told(self.rejected, self.last_error),
            unreadable=self.trouble.unreadable,
        )


def _untimely(ahead_ns: int) -> str:
    if ahead_ns > 0:
        return f"stamped {ahead_ns / NS:.3f} s ahead; clocks may be {CLOCKS_APART_NS / NS:g} s apart"
    return f"stale: stamped {-ahead_ns / NS:.3f} s ago"


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
