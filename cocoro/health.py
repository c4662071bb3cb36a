"""Measurements for a node's health message: counts and rates, loop periods, CPU and memory."""

from __future__ import annotations

import logging
import resource
import sys
import time
from collections import deque
from typing import TYPE_CHECKING

from cocoro.clock import NS
from cocoro.messages import LoopHealth

if TYPE_CHECKING:
    import psutil

log = logging.getLogger(__name__)

WINDOW_S = 10.0


class Rate:
    """A count, and its rate over the last health period."""

    def __init__(self) -> None:
        self.count = 0
        self._counted = 0
        self._since_ns: int | None = None

    def take(self, now_ns: int) -> float:
        """Counts per second since the last call; 0 at the first."""
        since_ns, counted = self._since_ns, self._counted
        self._since_ns, self._counted = now_ns, self.count
        if since_ns is None or now_ns <= since_ns:
            return 0.0
        return (self.count - counted) * NS / (now_ns - since_ns)


class Recent:
    """Sum of the amounts that were added within the last `window_s`, for faults that are reported for a while after
    they happened. Any clock will do, but always the same one."""

    def __init__(self, window_s: float = WINDOW_S) -> None:
        self._window_ns = round(window_s * NS)
        self._amounts: deque[tuple[int, int]] = deque()
        self._total = 0

    def add(self, amount: int, now_ns: int) -> None:
        if amount > 0:
            self._amounts.append((now_ns, amount))
            self._total += amount

    def total(self, now_ns: int) -> int:
        """The sum now. A clock that jumped back empties the window."""
        while self._amounts and not 0 <= now_ns - self._amounts[0][0] <= self._window_ns:
            self._total -= self._amounts.popleft()[1]
        return self._total


class LoopMeter:
    """Periods, step times and overruns of one loop; `health` covers the time since its last call."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.overruns = 0
        self.periods_ms: deque[float] = deque(maxlen=4096)
        self.steps_ms: deque[float] = deque(maxlen=4096)
        self._last_ns: int | None = None

    def began(self, now_ns: int) -> None:
        if self._last_ns is not None and now_ns >= self._last_ns:
            self.periods_ms.append((now_ns - self._last_ns) / 1e6)
        self._last_ns = now_ns

    def health(self) -> LoopHealth:
        periods, steps = sorted(self.periods_ms), sorted(self.steps_ms)
        self.periods_ms.clear()
        self.steps_ms.clear()
        mean_ms = sum(periods) / len(periods) if periods else 0.0
        return LoopHealth(
            name=self.name,
            rate_hz=1e3 / mean_ms if mean_ms > 0 else 0.0,
            period_median_ms=quantile(periods, 0.5),
            period_p99_ms=quantile(periods, 0.99),
            step_median_ms=quantile(steps, 0.5),
            overruns=self.overruns,
        )


def quantile(ordered: list[float], share: float) -> float:
    """The number below which a share of sorted numbers lies, linearly interpolated; 0 when there are none. It needs no
    NumPy, which operators' commands do not import, and whose own imports masked arrays."""
    if not ordered:
        return 0.0
    place = share * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (place - low) * (ordered[high] - ordered[low])


class ProcessMeter:
    """CPU share and resident memory of this process."""

    def __init__(self) -> None:
        import psutil

        self._cpu_s, self._at_s = time.process_time(), time.monotonic()
        self._process: psutil.Process | None = None
        try:
            self._process = psutil.Process()
            self._process.memory_info()
        except (psutil.Error, OSError) as error:
            log.warning("/proc cannot be read (%s): health reports the peak memory of this process", error)
            self._process = None

    def take(self) -> tuple[float, float]:
        """(share of one core since the last call, resident memory in MB); the peak memory where /proc is missing."""
        cpu_s, at_s = time.process_time(), time.monotonic()
        share = (cpu_s - self._cpu_s) / max(at_s - self._at_s, 1e-6)
        self._cpu_s, self._at_s = cpu_s, at_s
        return share, self._rss_mb()

    def _rss_mb(self) -> float:
        if self._process is not None:
            return float(self._process.memory_info().rss) / 1e6
        unit = 1 if sys.platform == "darwin" else 1024  # getrusage(2)
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * unit / 1e6
