"""One publisher's stream on one key, as a reader follows it: what is next, what was lost, what cannot be traffic.

A message is judged by its incarnation and sequence number against those of the last one that was taken:

- another incarnation is another publisher, or the same one started again: it is followed at once, and nothing is lost;
- the next number is taken; a higher one is taken and those in between count as lost, unless it is a jump that cannot be
  traffic: by more than `FREE_JUMP`, and by more than `MARGIN` times what the topic's rate gives in the time between the
  two stamps. Such a message is rejected, and only itself: the stream goes on where it was;
- the same number or a lower one was repeated, replayed or overtaken: it is rejected.

When `FOLLOWED_AFTER` messages in a row are rejected so, with no other in between, and agree with one another (each
number higher than the one before, by no more than `FREE_JUMP`, each stamp not older), the stream is followed where they
are: it began anew there, or the number before them was the wrong one. Messages with lower numbers must also be stamped
later than the last one that was taken, so a burst of old messages is never followed. What a wrong number had counted as
lost is taken back.
"""

from __future__ import annotations

from typing import NamedTuple

from cocoro.clock import CLOCKS_APART_NS, NS

FREE_JUMP = 1000
"""Messages that may be lost at once whatever the time between."""
MARGIN = 4.0
"""A topic may be published so many times faster than its nominal rate."""
ANY_HZ = 1000.0
"""The rate that is taken for topics that have none."""
FOLLOWED_AFTER = 3


class _Run(NamedTuple):
    """Rejected messages in a row that agree with one another."""

    length: int
    first: int
    seq: int
    stamp_ns: int


class Source:
    """One key. The reader sets `seq` and `stamp_ns` to those of each message that it takes."""

    __slots__ = ("_assumed", "_before", "_run", "_untimely", "gaps", "incarnation", "seq", "stamp_ns", "troubled")

    def __init__(self) -> None:
        self.incarnation = -1
        self.seq = -1
        self.stamp_ns = 0
        self.gaps = 0
        """Messages that were lost."""
        self.troubled = False
        """Something was rejected since the last message that was taken: call `settle` with the next one."""
        self._run: _Run | None = None
        self._untimely = 0
        self._before, self._assumed = -1, 0
        """The number before the last jump, and what it counted as lost."""

    def begin(self, incarnation: int) -> None:
        """Follow another publisher."""
        self.incarnation = incarnation
        self._before, self._assumed = -1, 0

    def settle(self) -> None:
        """A message is taken."""
        self.troubled = False
        self._run = None
        self._untimely = 0

    def refuse(self, incarnation: int, seq: int) -> None:
        """A message was rejected for what it says, so its number is no loss when it is missing later."""
        if incarnation == self.incarnation and 0 < seq - self.seq <= FREE_JUMP:
            self._untimely += 1
            self.troubled = True

    def jump(self, seq: int, stamp_ns: int, rate_hz: float, latest_ns: int | None) -> int | None:
        """Judge a number that is not the next one. `latest_ns`: the latest time that it can be on the reader's clock.

        Returns by how much the count of lost messages changes, or None when the message is to be rejected.
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
        if self._before < run.first <= self.seq:  # so it was the last jump that was wrong
            lost += run.first - self._before - 1 - self._assumed if self._assumed else 0
        self._before, self._assumed = -1, 0
        return lost

    def _joined(self, seq: int, stamp_ns: int, latest_ns: int | None) -> _Run | None:
        """The run with this message in it; None when no run can begin with it."""
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
        """What is wrong with a rejected number."""
        wrong = "cannot be traffic" if seq > self.seq else "was there before"
        return f"sequence number {seq} after {self.seq} {wrong}"
