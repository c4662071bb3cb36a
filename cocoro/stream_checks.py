"""Checks of what arrives on one topic: sequence numbers per publisher, and whether the topic can still be read.

A message is judged by its incarnation and sequence number against those of the last accepted one of its key:

- Another incarnation is another publisher, or the same one restarted: it is followed at once, and nothing is lost. For
  commands the reader waits until the former publisher's last one has expired (see `cocoro.inbox`).
- The next number is accepted. A higher one is accepted too, and the numbers between count as lost, unless the jump
  cannot be traffic: by more than `FREE_JUMP`, and by more than `MARGIN` times what the topic's rate gives in the time
  between the two stamps. Such a message alone is rejected; the stream goes on where it was.
- The same number or a lower one was repeated, replayed or overtaken: it is rejected.

After `FOLLOWED_AFTER` such rejections in a row that agree with one another (each number higher than the one before by
at most `FREE_JUMP`, each stamp not older), the stream continues at those messages: it was restarted there, or the
number before them was the wrong one. Messages with lower numbers must also be stamped later than the last accepted one,
so a burst of old messages is never followed. Losses that a wrong number caused are taken back.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable
from math import inf
from typing import Any, NamedTuple

from cocoro.clock import CLOCKS_APART_NS, NS
from cocoro.topics import Topic

FREE_JUMP = 1000
"""Messages that may be lost at once, whatever the time between."""
MARGIN = 4.0
"""Highest rate of a topic, as a multiple of its nominal rate."""
ANY_HZ = 1000.0
"""The rate that is assumed for topics without one."""
FOLLOWED_AFTER = 3
UNREADABLE_S, UNREADABLE_PERIODS, UNREADABLE_COUNT = 0.6, 6, 3
"""A topic with a rate is unreadable when for both this time and this number of its periods nothing was accepted, and at
least this many messages were rejected. A restarted stream is followed sooner than that."""
UNTIMELY_S = 5.0
"""The same time for messages that are good but late or ahead: where processor time is short they may be so for seconds,
and the robot stands meanwhile."""
REPORTED_S = 10.0
"""The reader's health reports a rejected message for this long."""


class _Run(NamedTuple):
    """Successive rejected messages that agree with one another."""

    length: int
    first: int
    seq: int
    stamp_ns: int


class SequenceTracker:
    """Follows one key. The reader sets `seq` and `stamp_ns` to those of each accepted message."""

    __slots__ = ("_assumed", "_before", "_run", "_untimely", "gaps", "incarnation", "seq", "stamp_ns", "troubled")

    def __init__(self) -> None:
        self.incarnation = -1
        self.seq = -1
        self.stamp_ns = 0
        self.gaps = 0
        """Lost messages."""
        self.troubled = False
        """A message was rejected since the last accepted one: call `settle` with the next accepted one."""
        self._run: _Run | None = None
        self._untimely = 0
        self._before, self._assumed = -1, 0
        """The number before the last jump, and the losses that the jump counted."""

    def begin(self, incarnation: int) -> None:
        """Follows another publisher."""
        self.incarnation = incarnation
        self._before, self._assumed = -1, 0

    def settle(self) -> None:
        """A message was accepted."""
        self.troubled = False
        self._run = None
        self._untimely = 0

    def refuse(self, incarnation: int, seq: int) -> None:
        """A message was rejected for another reason than its number, so its number does not count as lost later."""
        if incarnation == self.incarnation and 0 < seq - self.seq <= FREE_JUMP:
            self._untimely += 1
            self.troubled = True

    def jump(self, seq: int, stamp_ns: int, rate_hz: float, latest_ns: int | None) -> int | None:
        """Judges a number that is not the next one. `latest_ns`: upper bound of the reader's clock (`Clock.latest_ns`).

        Returns the change of the count of lost messages, or None when the message is to be rejected.
        """
        step = seq - self.seq
        if 0 < step <= FREE_JUMP or FREE_JUMP < step <= MARGIN * rate_hz * (stamp_ns - self.stamp_ns) / NS:
            lost = max(step - 1 - self._untimely, 0)
            self._before, self._assumed = self.seq, lost
            return lost
        self.troubled = True
        run = self._joined(seq, stamp_ns, latest_ns)
        if run is None or run.length < FOLLOWED_AFTER:
            self._run = run
            return None
        lost = run.seq - run.first + 1 - run.length
        if self._before < run.first <= self.seq:  # the last jump was wrong
            lost += run.first - self._before - 1 - self._assumed if self._assumed else 0
        self._before, self._assumed = -1, 0
        return lost

    def _joined(self, seq: int, stamp_ns: int, latest_ns: int | None) -> _Run | None:
        """The run that ends with this message; None when no run can begin with it."""
        horizon_ns = None if latest_ns is None else latest_ns + CLOCKS_APART_NS
        if horizon_ns is not None and stamp_ns > horizon_ns:
            return None
        trusted = horizon_ns is None or self.stamp_ns <= horizon_ns
        if seq <= self.seq and trusted and stamp_ns <= self.stamp_ns:
            return None
        run = self._run
        if run is not None and 0 < seq - run.seq <= FREE_JUMP and stamp_ns >= run.stamp_ns:
            return _Run(run.length + 1, run.first, seq, stamp_ns)
        return _Run(1, seq, seq, stamp_ns)

    def why(self, seq: int) -> str:
        """The reason for which a sequence number was rejected."""
        wrong = "cannot be traffic" if seq > self.seq else "was there before"
        return f"sequence number {seq} after {self.seq} {wrong}"


class RejectionMonitor:
    """Decides from rejected and accepted messages whether a topic can be read, and words the fault.

    The `Inbox` calls `rejected` and `accepted`.
    """

    def __init__(self, topic: Topic[Any]) -> None:
        self.unreadable = False
        self.since_s: float | None = None
        """Time of the first rejection since the last accepted message; None when there was none."""
        self.changed: Callable[[], None] | None = None
        """Called when the topic becomes unreadable, and when it can be read again."""
        self._publisher = topic.publisher
        self._limit_s = max(UNREADABLE_S, UNREADABLE_PERIODS / topic.rate_hz) if topic.rate_hz else inf
        self._key = ""
        self._newest_s = -inf
        self._run = 0

    def rejected(self, key: str, untimely: bool = False) -> None:
        """A message on `key` was rejected; `untimely`: for its stamp."""
        self._newest_s = now_s = _now_s()
        self._key = key
        if self.since_s is None:
            self.since_s, self._run = now_s, 0
        self._run += 1
        limit_s = max(self._limit_s, UNTIMELY_S) if untimely else self._limit_s
        if not self.unreadable and self._run >= UNREADABLE_COUNT and now_s - self.since_s >= limit_s:
            self._set(True)

    def accepted(self) -> None:
        """A message was accepted after a rejection."""
        self.since_s = None
        if self.unreadable:
            self._set(False)

    def _set(self, unreadable: bool) -> None:
        self.unreadable = unreadable
        if self.changed is not None:
            self.changed()

    def fault(self, rejected: int, why: str) -> str:
        """The key and publisher at fault, the count and the reason; '' when nothing was rejected in `REPORTED_S`."""
        if _now_s() - self._newest_s > REPORTED_S:
            return ""
        _, _, name = self._key.partition("/")
        publisher = name.partition("/")[0] if self._publisher == "*" else self._publisher
        return f"{name} of {publisher}: {rejected} rejected: {why}"


def _now_s() -> float:
    """The loop's time (real and steady, or virtual). Not the robot's clock: that may be what cannot be read."""
    try:
        return asyncio.get_running_loop().time()
    except RuntimeError:  # a reader without a loop
        return time.monotonic()
