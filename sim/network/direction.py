"""One direction between two hosts: delays, loses, queues and cuts packets. Pure: the caller gives the time."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from math import inf, isfinite
from random import Random
from typing import Literal, NamedTuple

NS_PER_MS = 1e6
BITS_NS = 8e9
"""A packet of N bytes takes N * BITS_NS / rate_bps nanoseconds."""


@dataclass(frozen=True)
class Settings:
    """How a direction carries packets. Raises ValueError for what no direction can do."""

    delay_ms: float = 0.0
    jitter_ms: float = 0.0
    """The delay is drawn anew for each packet, and never negative: from `delay_ms` plus or minus this, or with this
    standard deviation."""
    distribution: Literal["uniform", "normal"] = "uniform"
    reorder: bool = False
    """Whether a packet may overtake another one. Otherwise a packet waits for those before it, so jitter makes the
    mean delay longer where packets follow one another faster than it."""
    loss: float = 0.0
    """Probability that a packet is lost."""
    rate_bps: float | None = None
    """Bit/s of whole IP packets; None is without limit."""
    queue_bytes: int = 256 * 1024
    """What may wait for `rate_bps`, with the packet that is being sent; a packet that finds no room is dropped."""

    def __post_init__(self) -> None:
        if not (0 <= self.delay_ms < inf and 0 <= self.jitter_ms < inf):
            raise ValueError(f"delay_ms={self.delay_ms}, jitter_ms={self.jitter_ms}: give finite times of at least 0")
        if not 0 <= self.loss <= 1:
            raise ValueError(f"loss={self.loss}: give a probability, 0 to 1")
        if self.rate_bps is not None and not (isfinite(self.rate_bps) and self.rate_bps > 0):
            raise ValueError(f"rate_bps={self.rate_bps}: give a finite rate above 0, or None for no limit")
        if self.queue_bytes < 1:
            raise ValueError(f"queue_bytes={self.queue_bytes}: give at least 1")
        if self.distribution not in ("uniform", "normal"):
            raise ValueError(f"distribution={self.distribution!r}: give 'uniform' or 'normal'")

    @property
    def longest_ms(self) -> float:
        """What a delay hardly ever exceeds."""
        return self.delay_ms + self.jitter_ms * (1 if self.distribution == "uniform" else 3)


class Counts(NamedTuple):
    """What became of the packets of a direction, or of several directions, since the network was made."""

    delivered: int = 0
    lost: int = 0
    """By the probability of loss."""
    overflowed: int = 0
    """Found no room in the queue of a limited rate."""
    cut: int = 0
    """Sent or under way during a cut."""
    underway: int = 0

    def __add__(self, other: Counts) -> Counts:  # type: ignore[override]
        return Counts(*(ours + theirs for ours, theirs in zip(self, other, strict=True)))

    @property
    def sent(self) -> int:
        return sum(self)


class Direction:
    """Two queues: packets wait for the rate, then they are under way until they are due. Times are nanoseconds of a
    steady clock."""

    def __init__(self, seed: str) -> None:
        self.settings = Settings()
        self._losses = Random(f"{seed} losses")  # its own, so that jitter does not change which packets are lost
        self._delays = Random(f"{seed} delays")
        self._cut_until_ns: float = 0
        self._waiting: deque[bytes] = deque()
        self._waiting_bytes = 0
        self._sent_ns: float = 0
        """When the first that waits will have been sent."""
        self._underway: list[tuple[float, int, bytes]] = []
        """A heap of due time, number and packet."""
        self._number = 0
        self._latest_ns: float = 0
        """The latest due time."""
        self._delivered = self._lost = self._overflowed = self._cut = 0

    @property
    def counts(self) -> Counts:
        underway = len(self._waiting) + len(self._underway)
        return Counts(self._delivered, self._lost, self._overflowed, self._cut, underway)

    # --- packets ------------------------------------------------------------------------------------

    def put(self, packet: bytes, now_ns: float) -> bool:
        """Take a packet from the sender. True when it is to be delivered now; it is counted as that."""
        if now_ns < self._cut_until_ns:
            self._cut += 1
            return False
        settings = self.settings
        if settings.loss and self._losses.random() < settings.loss:
            self._lost += 1
            return False
        if settings.rate_bps is None:
            if not (settings.delay_ms or settings.jitter_ms or self._underway):
                self._delivered += 1
                return True
            self._send(packet, now_ns)
            return False
        self._transmit(now_ns)
        if self._waiting and self._waiting_bytes + len(packet) > settings.queue_bytes:
            self._overflowed += 1
            return False
        if not self._waiting:
            self._sent_ns = now_ns + len(packet) * BITS_NS / settings.rate_bps
        self._waiting.append(packet)
        self._waiting_bytes += len(packet)
        return False

    def take(self, now_ns: float) -> list[bytes]:
        """The packets that are due, in the order of their delivery; they are counted as delivered."""
        self._transmit(now_ns)
        due = []
        while self._underway and self._underway[0][0] <= now_ns:
            due.append(heappop(self._underway)[2])
        self._delivered += len(due)
        return due

    @property
    def next_ns(self) -> float:
        """When `take` must be called next; infinite while no packet is here."""
        next_ns = self._underway[0][0] if self._underway else inf
        return min(next_ns, self._sent_ns) if self._waiting else next_ns

    def _transmit(self, now_ns: float) -> None:
        """Send what waited and has had its time at the rate."""
        while self._waiting and self._sent_ns <= now_ns:
            packet = self._waiting.popleft()
            self._waiting_bytes -= len(packet)
            self._send(packet, self._sent_ns)
            if self._waiting:
                self._sent_ns += self._duration_ns(self._waiting[0])

    def _duration_ns(self, packet: bytes) -> float:
        rate_bps = self.settings.rate_bps
        return 0.0 if rate_bps is None else len(packet) * BITS_NS / rate_bps

    def _send(self, packet: bytes, sent_ns: float) -> None:
        settings = self.settings
        delay_ms = settings.delay_ms
        if settings.jitter_ms:
            drawn = self._delays.uniform(-1, 1) if settings.distribution == "uniform" else self._delays.gauss(0, 1)
            delay_ms = max(0.0, delay_ms + settings.jitter_ms * drawn)
        due_ns = sent_ns + delay_ms * NS_PER_MS
        if not settings.reorder and self._underway:
            due_ns = max(due_ns, self._latest_ns)
        self._latest_ns = max(due_ns, self._latest_ns) if self._underway else due_ns
        self._number += 1
        heappush(self._underway, (due_ns, self._number, packet))

    # --- changes ------------------------------------------------------------------------------------

    def change(self, settings: Settings, now_ns: float) -> None:
        """Carry packets by new settings from now on. Those under way come no later than if they were sent now, and
        those that wait go on at the new rate."""
        self._transmit(now_ns)
        self.settings = settings
        if self._waiting:
            self._sent_ns = min(self._sent_ns, now_ns + self._duration_ns(self._waiting[0]))
            self._transmit(now_ns)
        limit_ns = now_ns + settings.longest_ms * NS_PER_MS
        self._underway = [(min(due_ns, limit_ns), number, packet) for due_ns, number, packet in self._underway]
        heapify(self._underway)
        self._latest_ns = min(self._latest_ns, limit_ns)

    def cut(self, until_ns: float) -> None:
        """Lose all packets until a time, also those that are here."""
        self._cut += len(self._waiting) + len(self._underway)
        self._waiting.clear()
        self._waiting_bytes = 0
        self._underway.clear()
        self._cut_until_ns = until_ns

    def heal(self) -> None:
        self._cut_until_ns = 0
