"""Receives one topic: checks and counts its messages, and hands them to the topic's readers."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Callable
from math import inf
from typing import Generic, TypeVar

import msgspec

from cocoro.bus.base import Payload, Qos, Subscription
from cocoro.clock import CLOCKS_APART_NS, NS, Clock, is_fresh
from cocoro.health import Rate
from cocoro.messages import Message, TopicHealth
from cocoro.stream_checks import ANY_HZ, RejectionMonitor, SequenceTracker
from cocoro.topics import CLOCK, Topic

M = TypeVar("M", bound=Message)


class Inbox(Generic[M]):
    """Everything that arrives on one topic's keys, for all readers of the topic in one participant.

    A rejected message is counted and dropped, and is no reason to reject the messages after it. Rejected are:

    - messages that are malformed, of the wrong type, or larger than the topic allows;
    - commands that are older than the topic allows, and commands, states and frames that are stamped more than
      CLOCKS_APART_NS ahead of the reader's clock (events are accepted at any time, and `judge` decides on clock ticks);
    - commands of a second publisher while the first one's are fresh: nobody obeys two masters;
    - messages out of sequence, by the rules of `cocoro.stream_checks`.
    """

    def __init__(self, topic: Topic[M], keyexpr: str, clock: Clock, *, onlooker: bool = False) -> None:
        """An onlooker acts on nothing, so it accepts any stamp."""
        self.topic = topic
        self.keyexpr = keyexpr
        self.rate = Rate()
        self.rejected = 0
        self.expired = 0
        """Of the rejected messages: commands that were good and came too late."""
        self.unread = 0
        """Messages that a newer one replaced before a reader took them."""
        self.last_error = ""
        self.newest_stamp_ns: int | None = None
        self.subscription: Subscription | None = None
        self.judge: Callable[[M], str] | None = None
        """A further check: returns why a message that is in sequence is to be rejected, '' otherwise."""
        self.rejections = RejectionMonitor(topic)
        self._decode = msgspec.msgpack.Decoder(topic.type).decode
        self._clock = clock
        self._trackers: dict[str, SequenceTracker] = {}
        self._readers: tuple[Callable[[str, M], None], ...] = ()
        timeless = onlooker or topic.name == CLOCK.name
        self._max_bytes = topic.max_bytes
        self._max_age_ns = topic.max_age_s * NS
        self._expires = topic.qos is Qos.COMMAND and not timeless
        self._horizon_ns: float = inf if timeless or topic.qos is Qos.EVENT else 0
        """Stamps up to here are not ahead of the clock; renewed when a later one arrives. Saves reading the clock."""

    def add(self, reader: Callable[[str, M], None]) -> None:
        """`reader(key, message)` is called for each good message, in order per key."""
        self._readers = (*self._readers, reader)

    def remove(self, reader: Callable[[str, M], None]) -> None:
        self._readers = tuple(each for each in self._readers if each != reader)

    @property
    def is_read(self) -> bool:
        """Whether it has any reader."""
        return bool(self._readers)

    def deliver(self, key: str, payload: Payload) -> None:
        """The bus's callback. A payload that cannot be accepted is counted and dropped."""
        if len(payload) > self._max_bytes:
            self._reject(key, f"{len(payload)} bytes, at most {self.topic.max_bytes} are taken")
            return
        try:
            message = self._decode(payload)
        except (msgspec.MsgspecError, ValueError, RecursionError, OverflowError) as error:
            self._reject(key, str(error))
            return
        tracker = self._trackers.get(key)
        if tracker is None:
            tracker = self._trackers[key] = SequenceTracker()
        seq, stamp_ns = message.seq, message.stamp_ns
        if self._expires:
            now_ns = self._clock.now_ns()
            age_ns = now_ns - stamp_ns
            if not -CLOCKS_APART_NS <= age_ns <= self._max_age_ns:  # `is_fresh`, without the call: for each message
                self.expired += age_ns > 0
                self._refuse(key, tracker, message, _untimely(-age_ns))
                return
            if (
                message.incarnation != tracker.incarnation
                and tracker.seq >= 0
                and is_fresh(tracker.stamp_ns, now_ns, self.topic.max_age_s)
            ):
                self._reject(key, f"publisher {message.incarnation:x} commands while {tracker.incarnation:x} does")
                return
        elif stamp_ns > self._horizon_ns and (ahead_ns := self._ahead_ns(stamp_ns)) > CLOCKS_APART_NS:
            self._refuse(key, tracker, message, _untimely(ahead_ns))
            return
        lost: int | None = 0
        if message.incarnation != tracker.incarnation:
            tracker.begin(message.incarnation)
        elif seq != tracker.seq + 1:
            lost = tracker.jump(seq, stamp_ns, self.topic.rate_hz or ANY_HZ, self._clock.latest_ns())
            if lost is None:
                self._reject(key, tracker.why(seq))
                return
        if self.judge is not None and (why := self.judge(message)):
            self._refuse(key, tracker, message, why)
            return
        tracker.seq, tracker.stamp_ns = seq, stamp_ns
        if lost:
            tracker.gaps += lost
        if tracker.troubled:
            tracker.settle()
        if self.rejections.since_s is not None:
            self.rejections.accepted()
        self.rate.count += 1
        self.newest_stamp_ns = stamp_ns
        for reader in self._readers:
            reader(key, message)

    def _ahead_ns(self, stamp_ns: int) -> int:
        """The time by which a stamp is ahead of the clock, ns; 0 when the clock has not started."""
        now_ns = self._clock.latest_ns()
        if now_ns is None:
            return 0
        self._horizon_ns = now_ns + CLOCKS_APART_NS
        return stamp_ns - now_ns

    def _refuse(self, key: str, tracker: SequenceTracker, message: M, why: str) -> None:
        tracker.refuse(message.incarnation, message.seq)
        self._reject(key, why, untimely=self.judge is None)

    def _reject(self, key: str, why: str, untimely: bool = False) -> None:
        self.rejected += 1
        self.last_error = why
        self.rejections.rejected(key, untimely)

    def health(self, now_ns: int) -> TopicHealth:
        overwritten = self.subscription.skipped if self.subscription is not None else 0
        gaps = sum(tracker.gaps for tracker in self._trackers.values())
        if self._horizon_ns < inf:
            self._horizon_ns = 0  # the clock may have jumped back far before it
        return TopicHealth(
            key=self.keyexpr,
            direction="in",
            count=self.rate.count,
            rate_hz=self.rate.take(now_ns),
            age_s=None if self.newest_stamp_ns is None else (now_ns - self.newest_stamp_ns) / NS,
            skipped=overwritten + self.unread,
            lost=max(gaps - overwritten, 0),
            rejected=self.rejected,
            expired=self.expired,
            last_error=self.last_error,
            fault=self.rejections.fault(self.rejected, self.last_error),
            unreadable=self.rejections.unreadable,
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
        self._changed = asyncio.Event()
        inbox.add(self._take)

    def _take(self, _key: str, message: M) -> None:
        self._message = message
        changed, self._changed = self._changed, asyncio.Event()
        changed.set()

    @property
    def value(self) -> M | None:
        """The newest message, however old; None before the first."""
        return self._message

    def fresh(self, max_age_s: float | None = None) -> M | None:
        """The newest message; None when it is older than `max_age_s` (default: the topic's) or of another epoch."""
        message = self.value
        limit_s = self._inbox.topic.max_age_s if max_age_s is None else max_age_s
        if message is None or not is_fresh(message.stamp_ns, self._clock.now_ns(), limit_s):
            return None
        return message

    async def next(self) -> M:
        """Waits for the next message to arrive."""
        await self._changed.wait()
        message = self.value
        assert message is not None
        return message

    def close(self) -> None:
        """Takes no more messages."""
        self._inbox.remove(self._take)


class Stream(Generic[M]):
    """Every message of a topic, in order: `async for message in stream`.

    At most `limit` messages wait; beyond it the oldest are dropped and counted in `overflowed`, which only a reader
    that no longer reads can reach."""

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
