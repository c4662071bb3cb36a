"""Whether perception is late."""

from __future__ import annotations

from collections import deque

from cocoro.clock import NS


class PerceptionWatch:
    """Whether perception is late, by the arrival of its messages, however slow it is and even if it sees nothing."""

    def __init__(self, least_s: float, periods: float) -> None:
        """Give perception `least_s` for a message, or `periods` of its own periods where that is longer."""
        self._least_ns = round(least_s * NS)
        self._periods = periods
        self.arrived_ns: int | None = None
        self._gaps_ns: deque[int] = deque(maxlen=5)
        self._first_ns = 0
        self._blind_since_ns: int | None = None

    def arrived(self, now_ns: int, stamp_ns: int) -> None:
        """Note that a frame's detections have arrived. The age of the first frame stands for the period, which is not
        known yet."""
        if self.arrived_ns is None:
            self._first_ns = max(now_ns - stamp_ns, 0)
        elif now_ns > self.arrived_ns:
            self._gaps_ns.append(now_ns - self.arrived_ns)
        self.arrived_ns = now_ns
        self._blind_since_ns = None

    def blind_s(self, now_ns: int) -> float | None:
        """The time, s, as `StateEstimator.blind_s` gives it; since the first call where nothing has arrived yet."""
        if self.arrived_ns is not None and 0 <= now_ns - self.arrived_ns <= self._patience_ns():
            return None
        if self._blind_since_ns is None or now_ns < self._blind_since_ns:
            self._blind_since_ns = now_ns
        return (now_ns - self._blind_since_ns) / NS

    def unheard_s(self, now_ns: int) -> float:
        """Time since the last arrival; since the first call of `blind_s` where nothing has arrived yet."""
        since_ns = self.arrived_ns if self.arrived_ns is not None else self._blind_since_ns
        return 0.0 if since_ns is None else max(now_ns - since_ns, 0) / NS

    def age_s(self, now_ns: int) -> float:
        """Time since the last arrival, less the extra time that a slow perception has."""
        if self.arrived_ns is None or now_ns < self.arrived_ns:
            return float("inf")
        return max(now_ns - self.arrived_ns - (self._patience_ns() - self._least_ns), 0) / NS

    def _patience_ns(self) -> int:
        # The median is robust against one pause and against two messages together.
        period_ns = sorted(self._gaps_ns)[len(self._gaps_ns) // 2] if self._gaps_ns else self._first_ns
        return max(self._least_ns, round(self._periods * period_ns))
