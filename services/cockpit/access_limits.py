"""Limits of the cockpit's clients: budgets that refill with time, and the log lines of what was refused.

The cockpit is one event loop that also answers STOP. So what a client may cost is decided before its request is read
(`access_door`), and what is refused is logged in a line for each kind and client, never in one for each request.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Hashable
from typing import NamedTuple

log = logging.getLogger("cocoro.cockpit.access")

Clock = Callable[[], float]
"""Seconds that nobody can set back."""


class Rate(NamedTuple):
    """So many a second in the long run, and so many at once."""

    per_s: float
    burst: float


class DoorLimits(NamedTuple):
    """What connections may cost."""

    connections: int = 96
    """Open at once."""
    each: int = 32
    """Of one address; on loopback, of one user."""
    takes: Rate = Rate(40.0, 80.0)
    """New connections of one address or user."""
    takes_all: Rate = Rate(100.0, 200.0)
    refusals: Rate = Rate(1000.0, 500.0)
    """Beyond that the door is closed for SHUT_S, and the kernel lets others wait."""
    handshakes: int = 8
    """TLS handshakes at once."""
    bytes: Rate = Rate(24 * 1024.0, 128 * 1024.0)
    """Received in one connection, which is read no faster. The page sends 8 KiB/s while somebody drives."""
    first_s: float = 10.0
    """Until the first request is whole."""
    idle_s: float = 20.0
    """Between two requests."""
    stalled_s: float = 15.0
    """For so long a client may take nothing of what waits for it."""
    overfed_s: float = 10.0
    """For so long a client may send more than `bytes` without a break."""


class Bucket:
    """A budget: `take` succeeds `rate.burst` times at once, and `rate.per_s` times a second in the long run."""

    __slots__ = ("_at_s", "_left", "_rate")

    def __init__(self, rate: Rate, now_s: float) -> None:
        self._rate = rate
        self._left = rate.burst
        self._at_s = now_s

    def take(self, now_s: float, count: float = 1.0) -> bool:
        """Takes `count`, or nothing where there is less."""
        self._refill(now_s)
        if self._left < count:
            return False
        self._left -= count
        return True

    def owe(self, now_s: float, count: float) -> float:
        """Takes `count` in any case; returns the seconds until the debt is paid, 0 when there is none."""
        self._refill(now_s)
        self._left -= count
        return max(0.0, -self._left / self._rate.per_s)

    def full(self, now_s: float) -> bool:
        self._refill(now_s)
        return self._left >= self._rate.burst

    def _refill(self, now_s: float) -> None:
        self._left = min(self._rate.burst, self._left + (now_s - self._at_s) * self._rate.per_s)
        self._at_s = now_s


class Budgets:
    """A bucket for each key. At most `keys` of them are kept: a full bucket is as good as none, and when all are in
    use, the one that was made first goes."""

    def __init__(self, rate: Rate, clock: Clock = time.monotonic, keys: int = 1024) -> None:
        self._rate, self._clock, self._keys = rate, clock, keys
        self._buckets: dict[Hashable, Bucket] = {}

    def take(self, key: Hashable, count: float = 1.0) -> bool:
        now_s = self._clock()
        return self._bucket(key, now_s).take(now_s, count)

    def owe(self, key: Hashable, count: float) -> float:
        now_s = self._clock()
        return self._bucket(key, now_s).owe(now_s, count)

    def _bucket(self, key: Hashable, now_s: float) -> Bucket:
        found = self._buckets.get(key)
        if found is None:
            if len(self._buckets) >= self._keys:
                self._forget(now_s)
            found = self._buckets[key] = Bucket(self._rate, now_s)
        return found

    def _forget(self, now_s: float) -> None:
        for key in [key for key, bucket in self._buckets.items() if bucket.full(now_s)]:
            del self._buckets[key]
        while len(self._buckets) >= self._keys:
            del self._buckets[next(iter(self._buckets))]


class Audit:
    """Logs who was refused what: the first time at once, then every `every_s` with the number of times since."""

    def __init__(self, clock: Clock = time.monotonic, *, every_s: float = 10.0, kinds: int = 256) -> None:
        self._clock, self._every_s, self._kinds = clock, every_s, kinds
        self._seen: dict[tuple[str, str], tuple[float, int]] = {}
        """By client and kind: when its next line may come, and how often it was refused since the last one."""
        self.refusals = 0
        self._untold, self._untold_due_s = 0, 0.0

    def refused(self, who: str, what: str, detail: str = "") -> None:
        """`who` is the client's address and key, `what` the kind of refusal, `detail` what this one asked for."""
        self.refusals += 1
        now_s, key = self._clock(), (who, what)
        due_s, count = self._seen.get(key, (now_s, 0))
        if key not in self._seen and len(self._seen) >= self._kinds:
            self._tell_due(now_s)
            if len(self._seen) >= self._kinds:
                self._untold += 1
                return
        if now_s < due_s:
            self._seen[key] = (due_s, count + 1)
            return
        self._seen[key] = (now_s + self._every_s, 0)
        self._line(who, what, detail, count)

    def done(self, who: str, what: str) -> None:
        """Something that an operator wants to read later, such as a login."""
        log.info("%s: %s", _plain(who), _plain(what))

    def tell(self) -> None:
        """Logs the numbers that are due. Called now and then, so that the last refusals of a flood are told, too."""
        now_s = self._clock()
        self._tell_due(now_s)
        if self._untold and now_s >= self._untold_due_s:
            log.warning("refused: %d times more, of too many clients to name each", self._untold)
            self._untold, self._untold_due_s = 0, now_s + self._every_s

    def _tell_due(self, now_s: float) -> None:
        """Logs the numbers of those whose line is due, and forgets those that have not come again."""
        for (who, what), (due_s, count) in list(self._seen.items()):
            if now_s < due_s:
                continue
            if count:
                self._seen[who, what] = (now_s + self._every_s, 0)
                self._line(who, what, "", count - 1)
            else:
                del self._seen[who, what]

    def _line(self, who: str, what: str, detail: str, more: int) -> None:
        times = f", {more} times more in {self._every_s:.0f} s" if more else ""
        log.warning("refused: %s: %s%s%s", _plain(who), what, f" ({_plain(detail)})" if detail else "", times)


def _plain(text: str) -> str:
    """A client's text for one line of a log: no control characters, no flood."""
    return "".join(c if c.isprintable() else "?" for c in text[:120])
